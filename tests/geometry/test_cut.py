"""Sections of tetrahedra by a plane: corners from the twin, areas from the box."""

import naive
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import TWO_TETS, split_box

from tetopt.geometry.cut import plane_cut

seeds = st.integers(0, 2**32 - 1)


def areas(corners):
    """Of the polygons (K, 4, 3), if they are convex and in order."""
    diagonals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return 0.5 * np.linalg.norm(diagonals, axis=1)


def sorted_rows(rows):
    return sorted(np.round(np.asarray(rows), 9).tolist())


def test_a_node_on_the_plane_counts_as_above():
    points, cells = TWO_TETS  # the shared triangle lies in z = 0
    assert plane_cut(points, cells, points[:, 2]).cells.tolist() == [1]
    assert plane_cut(points, cells, -points[:, 2]).cells.tolist() == [0]
    on = plane_cut(points, cells, -points[:, 2])
    assert areas(on.corners) == pytest.approx([0.5])  # cell 0 is cut in the shared triangle itself


def test_a_plane_that_misses_cuts_nothing():
    points, cells = TWO_TETS
    for side in (1.0, -1.0):
        cut = plane_cut(points, cells, np.full(5, side))
        assert cut.corners.shape == (0, 4, 3)
        assert cut.cells.shape == (0,)


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
            np.testing.assert_array_equal(corners[2], corners[3])


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
    np.testing.assert_allclose((corners - points[0]) @ normal, -height[0], atol=1e-12)
    ahead = np.roll(corners, -1, axis=1) - corners
    turns = np.cross(ahead, np.roll(ahead, -1, axis=1)) @ normal
    assert ((turns > -1e-9).all(axis=1) | (turns < 1e-9).all(axis=1)).all()
