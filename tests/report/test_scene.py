"""The surface of an opened mesh, as scenes in 3-D show it."""

import numpy as np
import pytest

import tetopt
from tetopt.errors import InputError
from tetopt.report.scene import view_of


@pytest.fixture(scope="module")
def opened():
    mesh = tetopt.lattice_mesh(tetopt.load_phantom("two_spheres").image(voxel_mm=4.0), nodes=400)
    means = np.random.default_rng(0).normal(size=len(mesh.cells))
    return mesh, means, view_of(mesh, means, "a lattice")


def test_the_surface_is_that_of_the_kept_cells(opened):
    """Its volume by the divergence theorem is theirs: closed, and turned outwards. A triangle has
    the value of its cell.
    """
    mesh, means, view = opened
    middle = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    corners = mesh.points[mesh.cells]
    kept = np.flatnonzero(~(corners.mean(axis=1) > middle).all(axis=1))
    assert len(kept) < len(mesh.cells)
    enclosed = np.linalg.det(view.points[view.triangles]).sum() / 6.0
    assert enclosed == pytest.approx(mesh.cell_volumes[kept].sum())
    cells_of = {}
    for cell in kept:
        for left_out in range(4):
            facet = map(tuple, np.delete(corners[cell], left_out, axis=0))
            cells_of.setdefault(frozenset(facet), []).append(cell)
    for triangle, value in zip(view.triangles, view.values, strict=True):
        (cell,) = cells_of[frozenset(map(tuple, view.points[triangle]))]
        assert value == means[cell]


def test_view_of_refuses(opened):
    mesh, means, _ = opened
    with pytest.raises(InputError, match="one mean for each"):
        view_of(mesh, means[:-1], "t")
    with pytest.raises(InputError, match="tetrahedra"):
        view_of(tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]]), np.zeros(1), "t")
