"""Pinches of a boundary, and the part of a mesh that has none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tetopt
from tetopt.geometry.check import manifold_problems
from tetopt.geometry.manifold import manifold_part
from tetopt.geometry.simplex import orient_cells, volumes
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


@pytest.mark.parametrize("other", [[0, 1, 4, 5], [0, 6, 5, 4]])
def test_of_two_cells_that_touch_the_larger_stays(other):
    """Two tetrahedra with an edge, or a node, in common."""
    points = np.array(
        [[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-2, 0, 0], [0, -2, 0], [0, 0, -1]]
    )
    mesh = tetopt.Mesh(points, orient_cells(points, np.array([[0, 2, 3, 1], other])))
    mesh = part_of(mesh, np.ones(2, dtype=bool))
    assert len(manifold_problems(mesh)) > 0
    assert kept_of(mesh).tolist() == [False, True]


def test_two_cavities_that_touch_in_a_node_are_joined():
    """The cells around the node are one fan, what is outside of them two."""
    mesh = box(3)
    node = int(np.argmin(np.linalg.norm(mesh.points - mesh.points.mean(axis=0), axis=1)))
    star = np.flatnonzero((mesh.cells == node).any(axis=1))
    along = (mesh.points[mesh.cells[star]].mean(axis=1) - mesh.points[node]).sum(axis=1)
    holes = star[[along.argmax(), along.argmin()]]
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
