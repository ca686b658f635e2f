"""Tissue probabilities instead of labels, as a user types them."""

import json

import nibabel
import numpy as np
import pytest
from commands import assert_refused, exit_code, numbers_in
from shapes import distance

import tetopt

pytestmark = pytest.mark.full

SHAPE = (16, 16, 16)
R = distance(SHAPE, 7.3, 7.6, 7.2)
INNER, OUTER = (1.0 / (1.0 + np.exp(2.0 * (R - radius))) for radius in (3.5, 6.0))
ROWS = np.stack([OUTER - INNER, INNER]).astype(np.float32)


@pytest.fixture
def folder(tmp_path):
    """A contrast, two tissues in files of their own and in one, in bytes, and their labels."""
    tetopt.save_image(tmp_path / "a.nii.gz", tetopt.Image(100.0 * INNER + 50.0 * OUTER))
    for name, row in zip(("grey", "white"), ROWS, strict=True):
        tetopt.save_image(tmp_path / f"{name}.nii.gz", tetopt.Image(row))
    nibabel.save(nibabel.Nifti1Image(np.moveaxis(ROWS, 0, 3), np.eye(4)), tmp_path / "both.nii.gz")
    bytes_ = np.rint(255.0 * ROWS).astype(np.uint8)
    nibabel.save(
        nibabel.Nifti1Image(np.moveaxis(bytes_, 0, 3), np.eye(4)), tmp_path / "bytes.nii.gz"
    )
    labels = np.concatenate([1.0 - ROWS.sum(axis=0, keepdims=True), ROWS]).argmax(axis=0)
    tetopt.save_image(tmp_path / "l.nii.gz", tetopt.Image(1.0 * labels))
    return tmp_path


LATTICE = ["--spacing", "3", "--iterations", "0"]
FEW = ["--nodes", "250", "--iterations", "3"]


def words(folder, *more, image="a.nii.gz", name="m", size=LATTICE):
    """`tetopt mesh` of the image, by default as a lattice."""
    outputs = ["-o", folder / f"{name}.vtu", "--json", folder / f"{name}.json", "--force"]
    return ["mesh", folder / image, *size, *outputs, *more]


def both(folder):
    return f"{folder / 'grey.nii.gz'},{folder / 'white.nii.gz'}"


def test_files_name_the_labels_and_quality_takes_their_largest(folder, capsys):
    assert exit_code(*words(folder, "--tissues", both(folder), "--figures", folder / "figs")) == 0
    assert (folder / "figs" / "labels.png").is_file()
    loaded, numbers = tetopt.load_mesh(folder / "m.vtu"), numbers_in(folder / "m.json")
    assert set(loaded.cell_data["label"]) == {0, 1, 2}
    assert loaded.label_table.names == {1: "grey", 2: "white"}
    assert {"grey", "white"} <= set(loaded.sets.cells)
    assert numbers["inputs"]["tissues"] == ["grey.nii.gz", "white.nii.gz"]
    assert set(numbers["inputs"]["sha256"]) == {"grey.nii.gz", "white.nii.gz"}
    assert [name for name, _ in numbers["request"]["files"]["tissues"]] == [
        "grey.nii.gz",
        "white.nii.gz",
    ]
    given = [
        "--image",
        folder / "a.nii.gz",
        "--labels",
        folder / "l.nii.gz",
        "--json",
        folder / "q.json",
        "--check",
    ]
    assert exit_code("quality", folder / "m.vtu", *given) == 0
    assert numbers_in(folder / "q.json")["labels"] == numbers["labels"]


def test_files_volumes_of_one_and_their_labels_are_the_same_mesh(folder):
    given = {
        "m": ["--tissues", both(folder)],
        "n": ["--tissues", folder / "both.nii.gz"],
        "o": ["--labels", folder / "l.nii.gz"],
    }
    for name, more in given.items():
        assert exit_code(*words(folder, *more, name=name, size=FEW)) == 0
    first, second, third = (tetopt.load_mesh(folder / f"{name}.vtu") for name in given)
    for other in (second, third):
        np.testing.assert_array_equal(first.mesh.points, other.mesh.points)
        np.testing.assert_array_equal(first.cell_data["label"], other.cell_data["label"])
    assert second.label_table.names == {1: "tissue 1", 2: "tissue 2"}


def test_volumes_and_names_as_they_are_given(folder):
    (folder / "t.csv").write_text("label,name\n1,core\n2,cortex\n")
    volumes = f"{folder / 'both.nii.gz'}:1, {folder / 'both.nii.gz'}:0"
    assert exit_code(*words(folder, "--tissues", volumes, "--label-names", folder / "t.csv")) == 0
    table = tetopt.load_mesh(folder / "m.vtu").label_table
    assert table.names == {1: "core", 2: "cortex"}
    rows = {row["label"]: row["voxels"] for row in numbers_in(folder / "m.json")["labels"]}
    assert rows[1] == (tetopt.load_image(folder / "l.nii.gz").data == 2).sum()


def test_bytes_and_other_grids_are_told(folder, capsys):
    assert (
        exit_code(*words(folder, "--tissues", folder / "bytes.nii.gz", "--crop", "0:16,0:16,1:16"))
        == 0
    )
    assert capsys.readouterr().err.count("read as probabilities times 255") == 2
    fine = tetopt.Image(ROWS[0], np.diag([1.0, 1.0, 1.1, 1.0]))
    tetopt.save_image(folder / "grey.nii.gz", fine)
    assert exit_code(*words(folder, "--tissues", both(folder))) == 0
    said = capsys.readouterr().err
    assert "grey.nii.gz: resampled to the image's grid (linear)\n" in said
    assert "white.nii.gz: resampled" not in said


def test_the_image_may_be_one_of_them(folder, capsys):
    assert exit_code(*words(folder, "--tissues", both(folder), image="white.nii.gz")) == 0
    assert (
        "the image is also one of the tissues: only the tissues are used\n"
        in capsys.readouterr().err
    )
    assert numbers_in(folder / "m.json")["inputs"]["weights"] == [0.0]


def test_what_cannot_be(folder, capfd):
    def refused(match, *more):
        assert_refused(capfd, words(folder, *more), match)

    refused(
        "--labels and --tissues: give only one",
        "--labels",
        folder / "l.nii.gz",
        "--tissues",
        both(folder),
    )
    refused("--merge: needs --labels", "--tissues", both(folder), "--merge", "aseg")
    refused("--label-weight: needs --labels", "--label-weight", "2")
    refused(
        "--tissues: expected different files",
        "--tissues",
        f"{folder / 'grey.nii.gz'},{folder / 'grey.nii.gz'}",
    )
    refused("--tissues: expected different files", "--tissues", f"{folder / 'grey.nii.gz'},")
    refused("gone.nii.gz", "--tissues", folder / "gone.nii.gz")
    for values, match in (
        (100.0 * ROWS[0], "grey.nii.gz: expected probabilities from 0 to 1, got .* to 84"),
        (ROWS[0] - 0.5, "grey.nii.gz: expected probabilities from 0 to 1, got -0.5"),
        (ROWS[0, 0], "grey.nii.gz: expected 3 axes like the image's"),
        (
            np.where(R < 3.0, np.nan, ROWS[0]),
            "grey.nii.gz: .*NaN|grey.nii.gz: .*not finite|grey.nii.gz",
        ),
    ):
        nibabel.save(
            nibabel.Nifti1Image(values.astype(np.float32), np.eye(4)), folder / "grey.nii.gz"
        )
        refused(match, "--tissues", both(folder))
    far = np.diag([1.0, 1.0, 1.0, 1.0])
    far[:3, 3] = 500.0
    tetopt.save_image(folder / "grey.nii.gz", tetopt.Image(ROWS[0], far))
    refused(
        "grey.nii.gz: expected it to cover at least half of the image's voxels",
        "--tissues",
        both(folder),
    )


def test_a_job_takes_a_list(folder):
    files = [folder / "grey.nii.gz", folder / "white.nii.gz"]
    job = tetopt.Job(images=folder / "a.nii.gz", output=folder / "m.vtu", tissues=files)
    assert str(job.tissues) == both(folder)
    assert tetopt.Job.from_json(job.to_json()) == job


def test_a_cohort_finds_those_of_each_subject(folder, scheduler):
    (folder / "s.tsv").write_text(
        "subject\timage\ttissues\n1\ta.nii.gz\tgrey.nii.gz, "
        "white.nii.gz\n2\ta.nii.gz\tn/a\n3\ta.nii.gz\tgrey.nii.gz\n"
    )
    for name in ("grey", "white"):
        (folder / f"sub-2_{name}.nii.gz").write_bytes((folder / f"{name}.nii.gz").read_bytes())
    pattern = ",".join(f"{folder}/sub-{{subject}}_{name}.nii.gz" for name in ("grey", "white"))
    few = [*LATTICE, "--scheduler", scheduler, "--tissues", pattern]
    assert exit_code("cohort", folder / "s.tsv", "-o", folder / "out", *few) == 0
    runs = [json.loads(path.read_text()) for path in sorted((folder / "out").rglob("*_mesh.json"))]
    assert [run["label_names"] for run in runs] == [
        {"1": "grey", "2": "white"},
        {"1": "sub-2_grey", "2": "sub-2_white"},
        {"1": "grey"},
    ]


def test_a_missing_tissue_of_a_cohort_is_named_before_it_runs(folder, capfd):
    (folder / "s.tsv").write_text("subject\timage\ttissues\n1\ta.nii.gz\tgrey.nii.gz,gone.nii.gz\n")
    assert exit_code("cohort", folder / "s.tsv", "-o", folder / "out") == 2
    assert "gone.nii.gz does not exist" in capfd.readouterr().err
