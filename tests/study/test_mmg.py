"""Mmg as a peer: it fills the box, keeps labels, and reaches the number of nodes."""

import sys

import numpy as np
import pytest

import tetopt
from tetopt.geometry.box import ON_SIDE_VOXELS
from tetopt.geometry.check import beyond_box
from tetopt.geometry.simplex import volumes
from tetopt.study import mmg
from tetopt.study.mmg import remesh_image
from tetopt.study.pipelines import PIPELINES, PipelineInput

needs_mmgpy = pytest.mark.skipif(
    PIPELINES["mmg"].missing is not None, reason="mmgpy is not installed"
)
PHANTOM = tetopt.load_phantom("two_spheres")
IMAGE, LABELS = PHANTOM.image(voxel_mm=4), PHANTOM.label_image(voxel_mm=4)


@needs_mmgpy
@pytest.mark.parametrize("labels", [LABELS, None])
def test_a_box_of_labelled_cells(labels, monkeypatch):
    """An oblique box is filled to the last digits; labels of the user's stay those, in their
    places.
    """
    turned = np.array(
        [[0.0, -4.0, 0.0, 3.0], [3.2, 0.0, -2.4, 5.0], [2.4, 0.0, 3.2, -7.0], [0.0, 0.0, 0.0, 1.0]]
    )
    image = tetopt.Image(IMAGE.data, turned)
    given = None if labels is None else tetopt.Image(7 * labels.data, turned)
    made = PIPELINES["mmg"].function(PipelineInput(image, given, 1000, classes=3))
    mesh = made.mesh
    is_near = len(mesh.points) == pytest.approx(1000, rel=0.05)
    assert is_near != ("requested: 1000" in made.notes[-1])
    assert len(mesh.points) == pytest.approx(1000, rel=0.2)
    assert volumes(mesh.points, mesh.cells).min() > 0.0
    assert volumes(mesh.points, mesh.cells).sum() == pytest.approx(image.volume, rel=1e-12)
    assert beyond_box(mesh, image).max() <= ON_SIDE_VOXELS
    if given is None:
        assert made.labels is None
        return
    rows = tetopt.label_fidelity(given, mesh, made.labels)
    assert [row.label for row in rows] == [0, 7, 14]
    assert min(row.overlap.dice for row in rows) > 0.8
    monkeypatch.setattr(mmg, "MMG_RUNS", 1)
    first, again = (
        PIPELINES["mmg"].function(PipelineInput(image, given, 1000, classes=3)).mesh
        for _ in range(2)
    )
    assert first.points.tobytes() == again.points.tobytes()


@needs_mmgpy
def test_what_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "mmgpy", None)
    with pytest.raises(tetopt.InputError, match=r"mmgpy: not installed; .* pip install"):
        remesh_image(IMAGE, LABELS, 100, 1, 1.0)
