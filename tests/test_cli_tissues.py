"""Tissue probabilities instead of labels, as a user types them."""

import json
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_done, assert_refused, exit_code, numbers_in
from numpy.testing import assert_array_equal
from shapes import distance

import tetopt
from tetopt import Image, load_mesh, save_image

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]

SHAPE = (16, 16, 16)
R = distance(SHAPE, 7.3, 7.6, 7.2)
INNER, OUTER = (1.0 / (1.0 + np.exp(2.0 * (R - radius))) for radius in (3.5, 6.0))
ROWS = np.stack([OUTER - INNER, INNER]).astype(np.float32)


@pytest.fixture(autouse=True)
def folder(here):
    """A contrast, two tissues in files of their own and in one, in bytes, and their labels."""
    save_image("a.nii.gz", Image(100.0 * INNER + 50.0 * OUTER))
    for name, row in zip(("grey", "white"), ROWS, strict=True):
        save_image(f"{name}.nii.gz", Image(row))
    nibabel.save(nibabel.Nifti1Image(np.moveaxis(ROWS, 0, 3), np.eye(4)), "both.nii.gz")
    bytes_ = np.rint(255.0 * ROWS).astype(np.uint8)
    nibabel.save(nibabel.Nifti1Image(np.moveaxis(bytes_, 0, 3), np.eye(4)), "bytes.nii.gz")
    labels = np.concatenate([1.0 - ROWS.sum(axis=0, keepdims=True), ROWS]).argmax(axis=0)
    save_image("l.nii.gz", Image(1.0 * labels))


LATTICE = "--spacing 3 --iterations 0"
FEW = "--nodes 250 --iterations 3"


def words(more, image="a.nii.gz", name="m", size=LATTICE):
    """`tetopt mesh` of the image, by default as a lattice."""
    return f"mesh {image} {size} -o {name}.vtu --json {name}.json --force {more}"


BOTH = "grey.nii.gz,white.nii.gz"


def test_files_name_the_labels_and_quality_takes_their_largest(capsys):
    assert_done(words(f"--tissues {BOTH} --figures figs"))
    assert Path("figs/labels.png").is_file()
    loaded, numbers = load_mesh("m.vtu"), numbers_in("m.json")
    assert set(loaded.cell_data["label"]) == {0, 1, 2}
    assert loaded.label_table.names == {1: "grey", 2: "white"}
    assert {"grey", "white"} <= set(loaded.sets.cells)
    assert numbers["inputs"]["tissues"] == ["grey.nii.gz", "white.nii.gz"]
    assert set(numbers["inputs"]["sha256"]) == {"grey.nii.gz", "white.nii.gz"}
    assert [name for name, _ in numbers["request"]["files"]["tissues"]] == [
        "grey.nii.gz",
        "white.nii.gz",
    ]
    assert_done("quality m.vtu --image a.nii.gz --labels l.nii.gz --json q.json --check")
    assert numbers_in("q.json")["labels"] == numbers["labels"]


def test_files_volumes_of_one_and_their_labels_are_the_same_mesh():
    given = {
        "m": f"--tissues {BOTH}",
        "n": "--tissues both.nii.gz",
        "o": "--labels l.nii.gz",
    }
    for name, more in given.items():
        assert_done(words(more, name=name, size=FEW))
    first, second, third = (load_mesh(f"{name}.vtu") for name in given)
    for other in (second, third):
        assert_array_equal(first.mesh.points, other.mesh.points)
        assert_array_equal(first.cell_data["label"], other.cell_data["label"])
    assert second.label_table.names == {1: "tissue 1", 2: "tissue 2"}


def test_volumes_and_names_as_they_are_given():
    Path("t.csv").write_text("label,name\n1,core\n2,cortex\n")
    assert_done(words("--tissues 'both.nii.gz:1, both.nii.gz:0' --label-names t.csv"))
    table = load_mesh("m.vtu").label_table
    assert table.names == {1: "core", 2: "cortex"}
    rows = {row["label"]: row["voxels"] for row in numbers_in("m.json")["labels"]}
    assert rows[1] == (tetopt.load_image("l.nii.gz").data == 2).sum()


def test_bytes_and_other_grids_are_told(capsys):
    assert_done(words("--tissues bytes.nii.gz --crop 0:16,0:16,1:16"))
    assert capsys.readouterr().err.count("read as probabilities times 255") == 2
    fine = Image(ROWS[0], np.diag([1.0, 1.0, 1.1, 1.0]))
    save_image("grey.nii.gz", fine)
    assert_done(words(f"--tissues {BOTH}"))
    said = capsys.readouterr().err
    assert "grey.nii.gz: resampled to the image's grid (linear)\n" in said
    assert "white.nii.gz: resampled" not in said


def test_the_image_may_be_one_of_them(capsys):
    assert_done(words(f"--tissues {BOTH}", image="white.nii.gz"))
    assert (
        "the image is also one of the tissues: only the tissues are used\n"
        in capsys.readouterr().err
    )
    assert numbers_in("m.json")["inputs"]["weights"] == [0.0]


def test_what_cannot_be(capfd):
    def refused(match, more):
        assert_refused(capfd, words(more), match)

    refused("--labels and --tissues: give only one", f"--labels l.nii.gz --tissues {BOTH}")
    refused("--merge: needs --labels", f"--tissues {BOTH} --merge aseg")
    refused("--label-weight: needs --labels", "--label-weight 2")
    refused("--tissues: expected different files", "--tissues grey.nii.gz,grey.nii.gz")
    refused("--tissues: expected different files", "--tissues grey.nii.gz,")
    refused("gone.nii.gz", "--tissues gone.nii.gz")
    for values, match in (
        (100.0 * ROWS[0], "grey.nii.gz: expected probabilities from 0 to 1, got .* to 84"),
        (ROWS[0] - 0.5, "grey.nii.gz: expected probabilities from 0 to 1, got -0.5"),
        (ROWS[0, 0], "grey.nii.gz: expected 3 axes like the image's"),
        (
            np.where(R < 3.0, np.nan, ROWS[0]),
            "grey.nii.gz: .*NaN|grey.nii.gz: .*not finite|grey.nii.gz",
        ),
    ):
        nibabel.save(nibabel.Nifti1Image(values.astype(np.float32), np.eye(4)), "grey.nii.gz")
        refused(match, f"--tissues {BOTH}")
    far = np.diag([1.0, 1.0, 1.0, 1.0])
    far[:3, 3] = 500.0
    save_image("grey.nii.gz", Image(ROWS[0], far))
    refused(
        "grey.nii.gz: expected it to cover at least half of the image's voxels",
        f"--tissues {BOTH}",
    )


def test_a_job_takes_a_list():
    files = ["grey.nii.gz", "white.nii.gz"]
    job = tetopt.Job(images="a.nii.gz", output="m.vtu", tissues=files)
    assert str(job.tissues) == BOTH
    assert tetopt.Job.from_json(job.to_json()) == job


def test_a_cohort_finds_those_of_each_subject(scheduler):
    Path("s.tsv").write_text(
        "subject\timage\ttissues\n1\ta.nii.gz\tgrey.nii.gz, "
        "white.nii.gz\n2\ta.nii.gz\tn/a\n3\ta.nii.gz\tgrey.nii.gz\n"
    )
    for name in ("grey", "white"):
        Path(f"sub-2_{name}.nii.gz").write_bytes(Path(f"{name}.nii.gz").read_bytes())
    pattern = ",".join(f"sub-{{subject}}_{name}.nii.gz" for name in ("grey", "white"))
    assert_done(f"cohort s.tsv -o out {LATTICE} --scheduler {scheduler} --tissues {pattern}")
    runs = [json.loads(path.read_text()) for path in sorted(Path("out").rglob("*_mesh.json"))]
    assert [run["label_names"] for run in runs] == [
        {"1": "grey", "2": "white"},
        {"1": "sub-2_grey", "2": "sub-2_white"},
        {"1": "grey"},
    ]


def test_a_missing_tissue_of_a_cohort_is_named_before_it_runs(capfd):
    Path("s.tsv").write_text("subject\timage\ttissues\n1\ta.nii.gz\tgrey.nii.gz,gone.nii.gz\n")
    assert exit_code("cohort s.tsv -o out") == 2
    assert "gone.nii.gz does not exist" in capfd.readouterr().err
