"""Tissue probabilities instead of labels, as a user types them."""

from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_done, numbers_in, refusals, run_command
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
    """A contrast, two tissues in files of their own and in one, in bytes, their labels, and what
    is no probability.
    """
    far = np.eye(4)
    far[:3, 3] = 500.0
    labels = np.concatenate([1.0 - ROWS.sum(axis=0, keepdims=True), ROWS]).argmax(axis=0)
    for name, data, affine in (
        ("a", 100.0 * INNER + 50.0 * OUTER, np.eye(4)),
        ("grey", ROWS[0], np.eye(4)),
        ("white", ROWS[1], np.eye(4)),
        ("both", np.moveaxis(ROWS, 0, 3), np.eye(4)),
        ("bytes", np.rint(255.0 * np.moveaxis(ROWS, 0, 3)), np.eye(4)),
        ("l", labels, np.eye(4)),
        ("large", 100.0 * ROWS[0], np.eye(4)),
        ("negative", ROWS[0] - 0.5, np.eye(4)),
        ("plane", ROWS[0, 0], np.eye(4)),
        ("nan", np.where(R < 3.0, np.nan, ROWS[0]), np.eye(4)),
        ("far", ROWS[0], far),
    ):
        kind = np.uint8 if name == "bytes" else np.float32
        nibabel.save(nibabel.Nifti1Image(data.astype(kind), affine), f"{name}.nii.gz")


LATTICE = "--spacing 3 --iterations 0"
BOTH = "grey.nii.gz,white.nii.gz"


def mesh(more, image="a.nii.gz", name="m", size=LATTICE):
    """What `tetopt mesh` of the image, by default as a lattice, prints as errors."""
    words = f"mesh {image} {size} -o {name}.vtu --json {name}.json --force {more}"
    return run_command(words).err


def test_files_name_the_labels_and_quality_takes_their_largest():
    mesh(f"--tissues {BOTH} --figures figs")
    assert Path("figs/labels.png").is_file()
    loaded, numbers = load_mesh("m.vtu"), numbers_in("m.json")
    assert set(loaded.cell_data["label"]) == {0, 1, 2}
    assert loaded.label_table.names == {1: "grey", 2: "white"}
    assert {"grey", "white"} <= set(loaded.sets.cells)
    files = BOTH.split(",")
    assert numbers["inputs"]["tissues"] == list(numbers["inputs"]["sha256"]) == files
    assert [name for name, _ in numbers["request"]["files"]["tissues"]] == files
    assert_done("quality m.vtu --image a.nii.gz --labels l.nii.gz --json q.json --check")
    assert numbers_in("q.json")["labels"] == numbers["labels"]


def test_files_volumes_of_one_and_their_labels_are_the_same_mesh():
    meshes = []
    for words in (f"--tissues {BOTH}", "--tissues both.nii.gz", "--labels l.nii.gz"):
        mesh(words, size="--nodes 250 --iterations 3")
        meshes.append(load_mesh("m.vtu"))
    for other in meshes[1:]:
        assert_array_equal(meshes[0].mesh.points, other.mesh.points)
        assert_array_equal(meshes[0].cell_data["label"], other.cell_data["label"])
    assert meshes[1].label_table.names == {1: "tissue 1", 2: "tissue 2"}


def test_volumes_and_names_as_they_are_given():
    Path("t.csv").write_text("label,name\n1,core\n2,cortex\n")
    mesh("--tissues 'both.nii.gz:1, both.nii.gz:0' --label-names t.csv")
    assert load_mesh("m.vtu").label_table.names == {1: "core", 2: "cortex"}
    rows = {row["label"]: row["voxels"] for row in numbers_in("m.json")["labels"]}
    assert rows[1] == (tetopt.load_image("l.nii.gz").data == 2).sum()


def test_bytes_and_other_grids_are_told():
    said = mesh("--tissues bytes.nii.gz --crop 0:16,0:16,1:16")
    assert said.count("read as probabilities times 255") == 2
    save_image("grey.nii.gz", Image(ROWS[0], np.diag([1.0, 1.0, 1.1, 1.0])))
    said = mesh(f"--tissues {BOTH}")
    assert "grey.nii.gz: resampled to the image's grid (linear)\n" in said
    assert "white.nii.gz: resampled" not in said


def test_the_image_may_be_one_of_them():
    said = mesh(f"--tissues {BOTH}", image="white.nii.gz")
    assert "the image is also one of the tissues: only the tissues are used\n" in said
    assert numbers_in("m.json")["inputs"]["weights"] == [0.0]


test_refused = refusals(
    """
mesh a.nii.gz -o b.vtu --labels l.nii.gz --tissues grey.nii.gz,white.nii.gz
    --labels and --tissues: give only one
mesh a.nii.gz -o b.vtu --tissues grey.nii.gz,white.nii.gz --merge aseg
    --merge: needs --labels
mesh a.nii.gz -o b.vtu --label-weight 2
    --label-weight: needs --labels
mesh a.nii.gz -o b.vtu --tissues grey.nii.gz,grey.nii.gz
    --tissues: expected different files
mesh a.nii.gz -o b.vtu --tissues grey.nii.gz,
    --tissues: expected different files
mesh a.nii.gz -o b.vtu --tissues gone.nii.gz
    gone.nii.gz
mesh a.nii.gz -o b.vtu --tissues large.nii.gz,white.nii.gz
    large.nii.gz: expected probabilities from 0 to 1, got .* to 84
mesh a.nii.gz -o b.vtu --tissues negative.nii.gz,white.nii.gz
    negative.nii.gz: expected probabilities from 0 to 1, got -0.5
mesh a.nii.gz -o b.vtu --tissues plane.nii.gz,white.nii.gz
    plane.nii.gz: expected 3 axes like the image's
mesh a.nii.gz -o b.vtu --tissues far.nii.gz,white.nii.gz
    far.nii.gz: expected it to cover at least half of the image's voxels
"""
)


def test_a_job_takes_a_list():
    files = BOTH.split(",")
    job = tetopt.Job(images="a.nii.gz", output="m.vtu", tissues=files)
    assert str(job.tissues) == BOTH
    assert tetopt.Job.from_json(job.to_json()) == job


def test_a_cohort_finds_those_of_each_subject(scheduler):
    """A missing one is named before it runs."""
    table = "subject\timage\ttissues\n1\ta.nii.gz\tgrey.nii.gz,"
    Path("m.tsv").write_text(f"{table}gone.nii.gz\n")
    assert "gone.nii.gz does not exist" in run_command("cohort m.tsv -o out", code=2).err
    Path("s.tsv").write_text(f"{table} white.nii.gz\n2\ta.nii.gz\tn/a\n3\ta.nii.gz\tgrey.nii.gz\n")
    for name in ("grey", "white"):
        Path(f"sub-2_{name}.nii.gz").write_bytes(Path(f"{name}.nii.gz").read_bytes())
    pattern = ",".join(f"sub-{{subject}}_{name}.nii.gz" for name in ("grey", "white"))
    assert_done(f"cohort s.tsv -o out {LATTICE} --scheduler {scheduler} --tissues {pattern}")
    runs = [numbers_in(path) for path in sorted(Path("out").rglob("*_mesh.json"))]
    assert [run["label_names"] for run in runs] == [
        {"1": "grey", "2": "white"},
        {"1": "sub-2_grey", "2": "sub-2_white"},
        {"1": "grey"},
    ]
