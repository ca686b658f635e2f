"""Sections of tetrahedra by a plane: corners from the twin, areas from the box."""

import naive
import numpy as np
import pytest
from hypothesis import given
from meshes import TWO_TETS, seeds, split_box
from numpy.testing import assert_allclose, assert_array_equal

from tetopt.geometry.cut import plane_cut


def sorted_rows(rows):
    return sorted(np.round(np.asarray(rows), 9).tolist())


def test_a_node_on_the_plane_counts_as_above():
    points, cells = TWO_TETS  # the shared triangle lies in z = 0
    below, above = (plane_cut(points, cells, sign * points[:, 2]) for sign in (1.0, -1.0))
    assert (below.cells.tolist(), above.cells.tolist()) == ([1], [0])
    a, b, c, d = above.corners[0]  # cell 0 is cut in the shared triangle itself
    assert 0.5 * np.linalg.norm(np.cross(c - a, d - b)) == pytest.approx(0.5)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_plane_that_misses_cuts_nothing(side):
    cut = plane_cut(*TWO_TETS, np.full(5, side))
    assert (cut.corners.shape, cut.cells.shape) == ((0, 4, 3), (0,))


@given(seeds)
def test_corners_are_those_of_the_twin(seed):
    """Also of single cells of every pattern of signs, with nodes on the plane."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(40, 3))
    cells = np.arange(40).reshape(10, 4)
    height = rng.choice([-2.0, -1.0, -0.3, 0.0, 0.2, 1.0], 40)
    cut, twin = plane_cut(points, cells, height), naive.plane_cut(points, cells, height)
    assert cut.cells.tolist() == sorted(twin)
    for cell, corners in zip(cut.cells.tolist(), cut.corners, strict=True):
        distinct = corners if len(twin[cell]) == 4 else corners[:3]
        assert sorted_rows(distinct) == sorted_rows(twin[cell])
        if len(twin[cell]) == 3:
            assert_array_equal(corners[2], corners[3])


@given(seeds)
def test_polygons_are_convex(seed):
    """Their corners, which the twin has in no order, go around."""
    rng = np.random.default_rng(seed)
    points, cells = split_box(rng, (4, 5, 3), 6)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    height = (points - np.array([1.5, 2, 1]) - rng.uniform(-0.5, 0.5, 3)) @ normal
    cut = plane_cut(points, cells, height)
    corners = cut.corners
    assert_allclose((corners - points[0]) @ normal, -height[0], atol=1e-12)
    ahead = np.roll(corners, -1, axis=1) - corners
    turns = np.cross(ahead, np.roll(ahead, -1, axis=1)) @ normal
    assert ((turns > -1e-9).all(axis=1) | (turns < 1e-9).all(axis=1)).all()
