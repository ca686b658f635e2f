"""Pinches of a boundary, and the part of a mesh that has none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tetopt
from tetopt.geometry.check import manifold_problems
from tetopt.geometry.manifold import manifold_part
from tetopt.geometry.simplex import volumes
from tetopt.start.carve import part_of


def box(n):
    """A criss-cross square, or a cube of five-tets, of 4 blocks an edge."""
    return tetopt.lattice_mesh(
        tetopt.Image(np.zeros((8,) * n)), "five-tet" if n == 3 else None, blocks=(4,) * n
    )


def kept_of(mesh):
    return manifold_part(mesh.cells, volumes(mesh.points, mesh.cells))


@pytest.mark.parametrize("n", [2, 3])
def test_a_manifold_keeps_all_cells(n):
    assert kept_of(box(n)).all()


@pytest.mark.parametrize("n_shared", [1, 2])
def test_of_two_cells_that_touch_the_larger_stays(n_shared):
    """Two tetrahedra with a node, or an edge, in common: 0 and 1 are shared."""
    points = np.array(
        [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-2, 0, 0], [0, -2, 0], [0, 0, -1]],
        dtype=float,
    )
    other = [0, 1, 4, 5] if n_shared == 2 else [0, 6, 5, 4]
    cells = np.array([[0, 2, 3, 1], other])
    cells[volumes(points, cells) < 0] = cells[volumes(points, cells) < 0][:, [1, 0, 2, 3]]
    mesh = tetopt.Mesh(*_compact(points, np.abs(cells)))
    assert len(manifold_problems(mesh)) > 0
    assert kept_of(mesh).tolist() == [False, True]


def _compact(points, cells):
    used, rows = np.unique(cells, return_inverse=True)
    points, rows = points[used], rows.reshape(cells.shape)
    is_left = np.linalg.det(points[rows[:, 1:]] - points[rows[:, :1]]) < 0
    rows[is_left] = rows[is_left][:, [1, 0, 2, 3]]
    return points, rows


def test_two_cavities_that_touch_in_a_node_are_joined():
    """The cells around the node are one fan, what is outside of them two."""
    mesh = box(3)
    node = int(np.argmin(np.linalg.norm(mesh.points - mesh.points.mean(axis=0), axis=1)))
    star = np.flatnonzero((mesh.cells == node).any(axis=1))
    centre = mesh.points[mesh.cells[star]].mean(axis=1) - mesh.points[node]
    holes = star[[int(np.argmax(centre.sum(axis=1))), int(np.argmin(centre.sum(axis=1)))]]
    holed = part_of(mesh, ~np.isin(np.arange(len(mesh.cells)), holes))
    assert any("touches itself" in line for line in manifold_problems(holed))
    left = part_of(holed, kept_of(holed))
    assert manifold_problems(left) == []
    assert len(holed.cells) - len(star) < len(left.cells) < len(holed.cells)


@given(seed=st.integers(0, 10_000), fraction=st.floats(0.3, 0.97), n=st.sampled_from([2, 3]))
def test_what_is_left_of_any_part_is_a_manifold(seed, fraction, n):
    mesh = box(n)
    is_in = np.random.default_rng(seed).random(len(mesh.cells)) < fraction
    is_in[0] = True
    chosen = part_of(mesh, is_in)
    is_kept = kept_of(chosen)
    assert is_kept.any()
    assert manifold_problems(part_of(chosen, is_kept)) == []
