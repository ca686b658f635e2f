"""Cleaver: what can be tested without it, and with it where an ITK that it loads into is installed."""

import numpy as np
import pytest

import tetopt
from tetopt.geometry.simplex import volumes
from tetopt.study import cleaver
from tetopt.study.pipelines import PIPELINES, PipelineInput

PHANTOM = tetopt.load_phantom("sphere")
IMAGE, LABELS = PHANTOM.image(voxel_mm=4.0), PHANTOM.label_image(voxel_mm=4.0)


def test_unusable_package_is_told(monkeypatch):
    """Not installed; installed, but its import ends the interpreter."""
    monkeypatch.setattr(cleaver, "find_spec", lambda name: None)
    with pytest.raises(
        tetopt.InputError, match=r"itk-cleaver: not installed; install it with: pip install \"itk-cleaver\" "
    ):
        PIPELINES["cleaver"].function(PipelineInput(IMAGE, LABELS, 300))
    monkeypatch.setattr(cleaver, "find_spec", lambda name: name)
    python = cleaver._python
    monkeypatch.setattr(cleaver, "_python", lambda program: python("import os; os.kill(os.getpid(), 11)"))
    with pytest.raises(tetopt.InputError, match=r"importing it crashes Python \(signal 11, SIGSEGV\); install"):
        PIPELINES["cleaver"].function(PipelineInput(IMAGE, LABELS, 300))


def test_cube_holds_the_labels():
    """Isotropic, 2^k, and each voxel has the label of the image's voxel that it lies in."""
    labels = tetopt.Image(np.random.default_rng(0).integers(0, 4, (10, 6, 8)) * 3, np.diag([1.0, 2.0, 1.0, 1.0]))
    cube = cleaver.labels_in_cube(labels, labels, 0.2)
    n = cube.labels.shape[0]
    assert cube.labels.shape == (16, 16, 16)
    assert cube.voxel * n == pytest.approx(12.0)
    for place in np.ndindex(n, n, n):
        index = np.clip(np.rint((cube.origin + (np.array(place) + 0.5) * cube.voxel) / labels.spacing), 0, [9, 5, 7])
        assert cube.labels[place] * 3 == labels.data[tuple(index.astype(int))]


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        (tetopt.Image(np.zeros((3, 3, 3))), "labels: expected 3 axes and the image's shape"),
        (tetopt.Image(np.full(IMAGE.shape, 0.5)), "whole numbers, got fractions"),
        (tetopt.Image(np.zeros(IMAGE.shape)), "expected two or more, got one"),
    ],
)
def test_bad_labels(labels, words, monkeypatch):
    monkeypatch.setattr(cleaver, "find_spec", lambda name: name)
    with pytest.raises(tetopt.InputError, match=words):
        cleaver.stuffed(IMAGE, labels, 500)


@pytest.mark.slow
def test_sphere():
    pytest.importorskip("itk", reason="itk-cleaver is not installed")
    if cleaver._python("from itk import CleaverImageToMeshFilter").returncode != 0:
        pytest.skip("itk-cleaver cannot be loaded into this ITK")
    mesh = PIPELINES["cleaver"].function(PipelineInput(IMAGE, LABELS, 1500)).mesh
    assert volumes(mesh.points, mesh.cells).min() > 0.0
    assert volumes(mesh.points, mesh.cells).sum() == pytest.approx(IMAGE.volume, rel=1e-9)
    assert tetopt.cell_moments(IMAGE, mesh).n_voxels.sum() == IMAGE.data.size
