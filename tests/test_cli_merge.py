"""Labels merged into tissues, as a user types it: in a run, its files, a cohort and the measures
of a mesh.
"""

from pathlib import Path

import numpy as np
import pytest
from commands import assert_done, numbers_in, refusals, run_command

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


LATTICE = "--spacing 4 --iterations 0"


def mesh(more="", image="a.nii.gz"):
    """What `tetopt mesh` of the labels as a lattice, to m.vtu and m.json, prints as errors."""
    words = f"mesh {image} --labels l.nii.gz {LATTICE} -o m.vtu --json m.json --force"
    return run_command(f"{words} {more}").err


def test_groups_reach_every_file():
    said = mesh("--merge 'white=2,41,16,85; grey=3,42; fluid=24; 7:rest=*'")
    assert (
        "merged: 1 label into 0, 4 labels into 1 (white), 2 labels into 2 (grey), 1 label into 3 "
        "(fluid), 3 labels into 7 (rest)" in said
    )
    loaded, numbers = load_mesh("m.vtu"), numbers_in("m.json")
    assert set(loaded.cell_data["label"]) == {0, 1, 2, 3, 7}
    names = {1: "white", 2: "grey", 3: "fluid", 7: "rest"}
    assert loaded.label_table.names == names
    assert set(names.values()) <= set(loaded.sets.cells)
    assert numbers["label_names"] == {str(label): name for label, name in names.items()}
    assert numbers["inputs"]["merged"]["516"] == 7
    assert {row["label"]: row["voxels"] for row in numbers["labels"]}[1] == 4 * 4 * 4 * 8
    assert_done("convert m.vtu m.inp --young white=2,grey=1,*=5 --json c.json")
    assert "ELSET=white\n" in Path("m.inp").read_text()


def test_quality_merges_the_same_labels_and_takes_merged_ones():
    mesh("--merge synthseg")
    rows = numbers_in("m.json")["labels"]
    save_image("five.nii.gz", tetopt.merge_labels(load_image("l.nii.gz"), "synthseg").labels)
    for labels in ("l.nii.gz", "five.nii.gz"):
        words = f"quality m.vtu --image a.nii.gz --labels {labels} --json q.json --force"
        assert "1 white" in run_command(words).out
        numbers = numbers_in("q.json")
        assert (numbers["labels"], numbers["label_names"]["5"]) == (rows, "soft")


def test_an_image_may_be_its_own_labels():
    said = mesh("--merge synthseg --figures figs", image="l.nii.gz")
    assert "the image is also the label image" in said
    # of tissues, not of the file's numbers
    assert load_mesh("m.vtu").cell_data["mean"].max() <= 5.0
    assert numbers_in("m.json")["inputs"]["weights"] == [0.0]


def test_labels_that_share_a_name():
    Path("t.csv").write_text("label,name\n2,white\n41,white\n16,white\n3,grey\n42,grey\n24,csf\n")
    assert (
        "merged labels with the same name: 16 into 2 (white), 41 into 2 (white), 42 into 3 (grey)\n"
        in mesh("--label-names t.csv")
    )
    loaded = load_mesh("m.vtu")
    assert set(loaded.cell_data["label"]) == {0, 2, 3, 24, 85, 502, 515, 516}
    assert loaded.label_table.names == {2: "white", 3: "grey", 24: "csf"}
    assert numbers_in("m.json")["inputs"]["merged"] == {"16": 2, "41": 2, "42": 3}


def test_groups_may_list_names_of_the_table():
    Path("t.csv").write_text("label,name\n2,L white\n41,R white\n3,grey\n42,grey\n24,csf\n")
    mesh("--merge 'white=L white, r white; grey=grey; rest=*' --label-names t.csv")
    expected = {"2": 1, "41": 1, "3": 2, "42": 2, "24": 3}
    assert numbers_in("m.json")["inputs"]["merged"].items() >= expected.items()


def test_a_group_without_a_label_is_told_but_not_of_a_table():
    said = mesh("--merge 'white=2,41; blood=9; rest=*'")
    assert "warning: --merge:" in said
    assert "has no label for blood" in said
    labels = load_image("l.nii.gz").data
    save_image("l.nii.gz", Image(np.where(labels > 500, 511, labels)))
    said = mesh("--merge synthseg")
    assert "1 label into 5 (soft)" in said
    assert "has no label for" not in said


def test_labels_beyond_the_image_are_told_unless_left_out_on_purpose():
    labels = load_image("l.nii.gz").data
    padded = np.pad(labels, ((0, 2), (0, 0), (0, 0)), constant_values=99)
    for name in ("l", "whole"):
        save_image(f"{name}.nii.gz", Image(padded))
    words = f"l.nii.gz: labels without a voxel in the image: 99 ({2 * labels[0].size} voxels)"
    assert words not in mesh("--merge 'white=99; rest=*'")
    assert words not in mesh(f"--crop :{len(labels)},:,:", image="whole.nii.gz")
    assert words in mesh()
    assert words in run_command("quality m.vtu --image a.nii.gz --labels l.nii.gz").err


test_refused = refusals(
    """
mesh a.nii.gz -o x.vtu --merge aseg
    --merge: needs --labels
mesh a.nii.gz -o x.vtu --labels l.nii.gz --merge white=2,41
    l.nii.gz: --merge: expected each label
mesh a.nii.gz -o x.vtu --labels l.nii.gz --merge a=2,3,16,24,41,42,85
    got no group for 502, 515, 516
mesh a.nii.gz -o x.vtu --labels l.nii.gz --merge asge
    got "asge"
mesh a.nii.gz -o x.vtu --labels l.nii.gz --merge gone.toml
    gone.toml
"""
)


def test_a_cohort_merges_by_an_option_and_by_a_column(scheduler):
    Path("g.toml").write_text('white = [2, 41]\nrest = "*"\n')
    Path("s.tsv").write_text(
        "subject\timage\tlabels\tmerge\n1\ta.nii.gz\tl.nii.gz\tn/a\n2\ta.nii.gz\tl.nii.gz\tg.toml\n"
    )
    assert_done(f"cohort s.tsv -o out --merge synthseg {LATTICE} --scheduler {scheduler}")
    by_option, by_column = map(numbers_in, sorted(Path("out").rglob("*_mesh.json")))
    assert by_option["label_names"]["4"] == "bone"
    assert by_column["label_names"] == {"1": "white", "2": "rest"}
    assert "merge" not in by_option["request"]["files"]
    assert by_column["request"]["files"]["merge"][0][0] == "g.toml"
