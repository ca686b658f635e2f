"""Labels merged into tissues, as a user types it: in a run, its files, a cohort and the measures
of a mesh.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import assert_done, assert_refused, exit_code, numbers_in

import tetopt
from tetopt import Image, load_image, load_mesh, save_image

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]

NESTED = np.array([[2, 3, 24, 24], [41, 42, 24, 0], [16, 85, 24, 0], [502, 515, 516, 0]])


@pytest.fixture(autouse=True)
def folder(here):
    """Labels of blocks of 4 voxels, and an image of the same size."""
    data = np.kron(NESTED[:, :, None].repeat(2, axis=2), np.ones((4, 4, 4)))
    save_image("l.nii.gz", Image(data))
    save_image("a.nii.gz", Image(100.0 * data + np.arange(8.0)))


def words(more="", image="a.nii.gz"):
    """`tetopt mesh` of the labels as a lattice."""
    lattice = "--spacing 4 --iterations 0 -o m.vtu --json m.json --force"
    return f"mesh {image} --labels l.nii.gz {lattice} {more}"


def refused(capsys, *arguments):
    capsys.readouterr()
    assert exit_code(*arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_groups_reach_every_file(capsys):
    merge = "white=2,41,16,85; grey=3,42; fluid=24; 7:rest=*"
    assert_done(words(f"--merge '{merge}'"))
    told = capsys.readouterr().err
    assert (
        "merged: 1 label into 0, 4 labels into 1 (white), 2 labels into 2 (grey), 1 label into 3 "
        "(fluid)" in told
    )
    assert "3 labels into 7 (rest)" in told
    loaded = load_mesh("m.vtu")
    assert set(loaded.cell_data["label"]) == {0, 1, 2, 3, 7}
    assert loaded.label_table.names == {1: "white", 2: "grey", 3: "fluid", 7: "rest"}
    assert {"white", "grey", "fluid", "rest"} <= set(loaded.sets.cells)
    numbers = numbers_in("m.json")
    assert numbers["label_names"] == {"1": "white", "2": "grey", "3": "fluid", "7": "rest"}
    assert numbers["inputs"]["merged"]["516"] == 7
    rows = {row["label"]: row for row in numbers["labels"]}
    assert rows[1]["voxels"] == 4 * 4 * 4 * 8
    assert_done("convert m.vtu m.inp --young white=2,grey=1,*=5 --json c.json")
    assert "ELSET=white\n" in Path("m.inp").read_text()


def test_quality_merges_the_same_labels_and_takes_merged_ones(capsys):
    assert_done(words("--merge synthseg"))
    rows = numbers_in("m.json")["labels"]
    merged = tetopt.merge_labels(load_image("l.nii.gz"), "synthseg").labels
    save_image("five.nii.gz", merged)
    for labels in ("l.nii.gz", "five.nii.gz"):
        given = [
            "--image a.nii.gz --labels",
            labels,
            "--json q.json --force",
        ]
        assert_done("quality m.vtu", *given)
        assert "1 white" in capsys.readouterr().out
        numbers = numbers_in("q.json")
        assert numbers["labels"] == rows
        assert numbers["label_names"]["5"] == "soft"


def test_an_image_may_be_its_own_labels(capsys):
    assert_done(words("--merge synthseg --figures figs", image="l.nii.gz"))
    assert "the image is also the label image" in capsys.readouterr().err
    loaded = load_mesh("m.vtu")
    assert loaded.cell_data["mean"].max() <= 5.0  # of tissues, not of the file's numbers
    assert numbers_in("m.json")["inputs"]["weights"] == [0.0]


def test_labels_that_share_a_name(capsys):
    Path("t.csv").write_text("label,name\n2,white\n41,white\n16,white\n3,grey\n42,grey\n24,csf\n")
    assert_done(words("--label-names t.csv"))
    said = capsys.readouterr().err
    assert (
        "merged labels with the same name: 16 into 2 (white), 41 into 2 (white), 42 into 3 (grey)\n"
        in said
    )
    loaded = load_mesh("m.vtu")
    assert set(loaded.cell_data["label"]) == {0, 2, 3, 24, 85, 502, 515, 516}
    assert loaded.label_table.names == {2: "white", 3: "grey", 24: "csf"}
    assert numbers_in("m.json")["inputs"]["merged"] == {"16": 2, "41": 2, "42": 3}


def test_groups_may_list_names_of_the_table():
    Path("t.csv").write_text("label,name\n2,L white\n41,R white\n3,grey\n42,grey\n24,csf\n")
    assert_done(words("--merge 'white=L white, r white; grey=grey; rest=*' --label-names t.csv"))
    merged = numbers_in("m.json")["inputs"]["merged"]
    assert {old: merged[old] for old in ("2", "41", "3", "42", "24")} == {
        "2": 1,
        "41": 1,
        "3": 2,
        "42": 2,
        "24": 3,
    }


def test_a_group_without_a_label_is_told_but_not_of_a_table(capsys):
    assert_done(words("--merge 'white=2,41; blood=9; rest=*'"))
    assert "warning: --merge:" in (said := capsys.readouterr().err)
    assert "has no label for blood" in said
    labels = load_image("l.nii.gz")
    save_image("l.nii.gz", Image(np.where(labels.data > 500, 511, labels.data)))
    assert_done(words("--merge synthseg"))
    assert "1 label into 5 (soft)" in (said := capsys.readouterr().err)
    assert "has no label for" not in said


def test_labels_beyond_the_image_are_told_unless_left_out_on_purpose(capsys):
    image = load_image("a.nii.gz")
    labels = np.pad(load_image("l.nii.gz").data, ((0, 2), (0, 0), (0, 0)), constant_values=99)
    save_image("l.nii.gz", Image(labels, image.affine))
    save_image("whole.nii.gz", Image(labels, image.affine))
    said = f"l.nii.gz: labels without a voxel in the image: 99 ({2 * labels[0].size} voxels)"
    for more, name, is_told in (
        ("", "a.nii.gz", True),
        ("--merge 'white=99; rest=*'", "a.nii.gz", False),
        (f"--crop :{len(labels) - 2},:,:", "whole.nii.gz", False),
    ):
        assert_done(words(more, image=name))
        assert (said in capsys.readouterr().err) == is_told
    assert_done(words())
    capsys.readouterr()
    assert_done("quality m.vtu --image a.nii.gz --labels l.nii.gz")
    assert said in capsys.readouterr().err


def test_what_cannot_be_merged(capsys):
    assert_refused(capsys, "mesh a.nii.gz -o x.vtu --merge aseg", "--merge: needs --labels")
    assert_refused(capsys, words("--merge white=2,41"), "l.nii.gz: --merge: expected each label")
    assert_refused(
        capsys,
        words("--merge a=2,3,16,24,41,42,85"),
        "got no group for 502, 515, 516",
    )
    assert_refused(capsys, words("--merge asge"), 'got "asge"')
    assert_refused(capsys, words("--merge gone.toml"), "gone.toml")


def test_a_cohort_merges_by_an_option_and_by_a_column(scheduler):
    Path("g.toml").write_text('white = [2, 41]\nrest = "*"\n')
    Path("s.tsv").write_text(
        "subject\timage\tlabels\tmerge\n1\ta.nii.gz\tl.nii.gz\tn/a\n2\ta.nii.gz\tl.nii.gz\tg.toml\n"
    )
    assert_done(
        f"cohort s.tsv -o out --merge synthseg --spacing 4 --iterations 0 --scheduler {scheduler}"
    )
    runs = {
        path.parent.name: json.loads(path.read_text())
        for path in sorted(Path("out").rglob("*_mesh.json"))
    }
    names = [run["label_names"] for run in runs.values()]
    assert names[0]["4"] == "bone"
    assert names[1] == {"1": "white", "2": "rest"}
    files = [run["request"]["files"].get("merge") for run in runs.values()]
    assert files[0] is None
    assert files[1][0][0] == "g.toml"
