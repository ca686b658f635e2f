"""Labels merged into tissues, as a user types it: in a run, its files, a cohort and the measures
of a mesh.
"""

import json

import numpy as np
import pytest
from commands import exit_code, numbers_in

import tetopt

pytestmark = pytest.mark.full

NESTED = np.array([[2, 3, 24, 24], [41, 42, 24, 0], [16, 85, 24, 0], [502, 515, 516, 0]])


@pytest.fixture
def folder(tmp_path):
    """Labels of blocks of 4 voxels, and an image of the same size."""
    data = np.kron(NESTED[:, :, None].repeat(2, axis=2), np.ones((4, 4, 4)))
    tetopt.save_image(tmp_path / "l.nii.gz", tetopt.Image(data))
    tetopt.save_image(tmp_path / "a.nii.gz", tetopt.Image(100.0 * data + np.arange(8.0)))
    return tmp_path


def words(folder, *more, image="a.nii.gz"):
    """`tetopt mesh` of the labels as a lattice."""
    lattice = [
        "--spacing",
        "4",
        "--iterations",
        "0",
        "-o",
        folder / "m.vtu",
        "--json",
        folder / "m.json",
        "--force",
    ]
    return ["mesh", folder / image, "--labels", folder / "l.nii.gz", *lattice, *more]


def refused(capsys, *arguments):
    capsys.readouterr()
    assert exit_code(*arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_groups_reach_every_file(folder, capsys):
    merge = "white=2,41,16,85; grey=3,42; fluid=24; 7:rest=*"
    assert exit_code(*words(folder, "--merge", merge)) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert (
        "merged: 1 label into 0, 4 labels into 1 (white), 2 labels into 2 (grey), 1 label into 3 "
        "(fluid)" in told
    )
    assert "3 labels into 7 (rest)" in told
    loaded = tetopt.load_mesh(folder / "m.vtu")
    assert set(loaded.cell_data["label"]) == {0, 1, 2, 3, 7}
    assert loaded.label_table.names == {1: "white", 2: "grey", 3: "fluid", 7: "rest"}
    assert {"white", "grey", "fluid", "rest"} <= set(loaded.sets.cells)
    numbers = numbers_in(folder / "m.json")
    assert numbers["label_names"] == {"1": "white", "2": "grey", "3": "fluid", "7": "rest"}
    assert numbers["inputs"]["merged"]["516"] == 7
    rows = {row["label"]: row for row in numbers["labels"]}
    assert rows[1]["voxels"] == 4 * 4 * 4 * 8
    young = ["--young", "white=2,grey=1,*=5", "--json", folder / "c.json"]
    assert exit_code("convert", folder / "m.vtu", folder / "m.inp", *young) == 0
    assert "ELSET=white\n" in (folder / "m.inp").read_text()


def test_quality_merges_the_same_labels_and_takes_merged_ones(folder, capsys):
    assert exit_code(*words(folder, "--merge", "synthseg")) == 0
    rows = numbers_in(folder / "m.json")["labels"]
    merged = tetopt.merge_labels(tetopt.load_image(folder / "l.nii.gz"), "synthseg").labels
    tetopt.save_image(folder / "five.nii.gz", merged)
    for labels in ("l.nii.gz", "five.nii.gz"):
        given = [
            "--image",
            folder / "a.nii.gz",
            "--labels",
            folder / labels,
            "--json",
            folder / "q.json",
            "--force",
        ]
        assert exit_code("quality", folder / "m.vtu", *given) == 0
        assert "1 white" in capsys.readouterr().out
        numbers = numbers_in(folder / "q.json")
        assert numbers["labels"] == rows
        assert numbers["label_names"]["5"] == "soft"


def test_an_image_may_be_its_own_labels(folder, capsys):
    assert (
        exit_code(
            *words(folder, "--merge", "synthseg", "--figures", folder / "figs", image="l.nii.gz")
        )
        == 0
    )
    assert "the image is also the label image" in capsys.readouterr().err
    loaded = tetopt.load_mesh(folder / "m.vtu")
    assert loaded.cell_data["mean"].max() <= 5.0  # of tissues, not of the file's numbers
    assert numbers_in(folder / "m.json")["inputs"]["weights"] == [0.0]


def test_labels_that_share_a_name(folder, capsys):
    (folder / "t.csv").write_text(
        "label,name\n2,white\n41,white\n16,white\n3,grey\n42,grey\n24,csf\n"
    )
    assert exit_code(*words(folder, "--label-names", folder / "t.csv")) == 0
    said = capsys.readouterr().err
    assert (
        "merged labels with the same name: 16 into 2 (white), 41 into 2 (white), 42 into 3 (grey)\n"
        in said
    )
    loaded = tetopt.load_mesh(folder / "m.vtu")
    assert set(loaded.cell_data["label"]) == {0, 2, 3, 24, 85, 502, 515, 516}
    assert loaded.label_table.names == {2: "white", 3: "grey", 24: "csf"}
    assert numbers_in(folder / "m.json")["inputs"]["merged"] == {"16": 2, "41": 2, "42": 3}


def test_groups_may_list_names_of_the_table(folder):
    (folder / "t.csv").write_text("label,name\n2,L white\n41,R white\n3,grey\n42,grey\n24,csf\n")
    given = [
        "--merge",
        "white=L white, r white; grey=grey; rest=*",
        "--label-names",
        folder / "t.csv",
    ]
    assert exit_code(*words(folder, *given)) == 0
    merged = numbers_in(folder / "m.json")["inputs"]["merged"]
    assert {old: merged[old] for old in ("2", "41", "3", "42", "24")} == {
        "2": 1,
        "41": 1,
        "3": 2,
        "42": 2,
        "24": 3,
    }


def test_a_group_without_a_label_is_told_but_not_of_a_table(folder, capsys):
    assert exit_code(*words(folder, "--merge", "white=2,41; blood=9; rest=*")) == 0
    assert "warning: --merge:" in (said := capsys.readouterr().err)
    assert "has no label for blood" in said
    labels = tetopt.load_image(folder / "l.nii.gz")
    tetopt.save_image(
        folder / "l.nii.gz", tetopt.Image(np.where(labels.data > 500, 511, labels.data))
    )
    assert exit_code(*words(folder, "--merge", "synthseg")) == 0
    assert "1 label into 5 (soft)" in (said := capsys.readouterr().err)
    assert "has no label for" not in said


def test_labels_beyond_the_image_are_told_unless_left_out_on_purpose(folder, capsys):
    image = tetopt.load_image(folder / "a.nii.gz")
    labels = np.pad(
        tetopt.load_image(folder / "l.nii.gz").data, ((0, 2), (0, 0), (0, 0)), constant_values=99
    )
    tetopt.save_image(folder / "l.nii.gz", tetopt.Image(labels, image.affine))
    tetopt.save_image(folder / "whole.nii.gz", tetopt.Image(labels, image.affine))
    said = f"l.nii.gz: labels without a voxel in the image: 99 ({2 * labels[0].size} voxels)"
    crop = f":{len(labels) - 2},:,:"
    for more, name, is_told in (
        ([], "a.nii.gz", True),
        (["--merge", "white=99; rest=*"], "a.nii.gz", False),
        (["--crop", crop], "whole.nii.gz", False),
    ):
        assert exit_code(*words(folder, *more, image=name)) == 0
        assert (said in capsys.readouterr().err.replace("\n  ", " ")) == is_told
    assert exit_code(*words(folder)) == 0
    capsys.readouterr()
    files = ["--image", folder / "a.nii.gz", "--labels", folder / "l.nii.gz"]
    assert exit_code("quality", folder / "m.vtu", *files) == 0
    assert said in capsys.readouterr().err.replace("\n  ", " ")


def test_what_cannot_be_merged(folder, capsys):
    assert "--merge: needs --labels" in refused(
        capsys, "mesh", folder / "a.nii.gz", "-o", folder / "x.vtu", "--merge", "aseg"
    )
    assert "l.nii.gz: --merge: expected each label" in refused(
        capsys, *words(folder, "--merge", "white=2,41")
    )
    assert "got no group for 502, 515, 516" in refused(
        capsys, *words(folder, "--merge", "a=2,3,16,24,41,42,85")
    )
    assert 'got "asge"' in refused(capsys, *words(folder, "--merge", "asge"))
    assert "gone.toml" in refused(capsys, *words(folder, "--merge", folder / "gone.toml"))
    assert not (folder / "x.vtu").exists()


def test_a_cohort_merges_by_an_option_and_by_a_column(folder, scheduler):
    (folder / "g.toml").write_text('white = [2, 41]\nrest = "*"\n')
    (folder / "s.tsv").write_text(
        "subject\timage\tlabels\tmerge\n1\ta.nii.gz\tl.nii.gz\tn/a\n2\ta.nii.gz\tl.nii.gz\tg.toml\n"
    )
    lattice = ["--spacing", "4", "--iterations", "0", "--scheduler", scheduler]
    assert (
        exit_code("cohort", folder / "s.tsv", "-o", folder / "out", "--merge", "synthseg", *lattice)
        == 0
    )
    runs = {
        path.parent.name: json.loads(path.read_text())
        for path in sorted((folder / "out").rglob("*_mesh.json"))
    }
    names = [run["label_names"] for run in runs.values()]
    assert names[0]["4"] == "bone"
    assert names[1] == {"1": "white", "2": "rest"}
    files = [run["request"]["files"].get("merge") for run in runs.values()]
    assert files[0] is None
    assert files[1][0][0] == "g.toml"
