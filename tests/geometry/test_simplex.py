"""Volumes, radius ratios, circumcentres, angles and areas: closed forms first, then laws."""

import sys
from math import acos, asin, atan, degrees, sqrt

import naive
import numpy as np
import pytest
from hypothesis import given
from meshes import (
    ALL_SMALL,
    BAD_TETS,
    CUBE_CORNER,
    EQUILATERAL,
    OBTUSE_TET,
    OBTUSE_TRIANGLE,
    REGULAR_TET,
    RIGHT_TRIANGLE,
    TWO_TETS,
    dimensions,
    needle,
    seeds,
    single,
    sliver,
)
from numpy.testing import assert_allclose, assert_array_equal

from tetopt.geometry.simplex import (
    centroids,
    dihedral_angles,
    edge_pairs,
    facet_areas,
    facet_nodes,
    orient_cells,
    rho,
    squared_edges,
    volume_gradients,
    volumes,
)


def random_cells(seed, n, count=20):
    """`count` generic simplices, positively oriented, each on its own nodes."""
    points = np.random.default_rng(seed).normal(size=(count * (n + 1), n))
    return points, orient_cells(points, np.arange(len(points)).reshape(count, n + 1))


# Volumes


@given(seeds, dimensions)
def test_volumes_are_those_of_exact_arithmetic(seed, n):
    points, cells = random_cells(seed, n)
    cells = np.random.default_rng(seed).permuted(cells, axis=1)  # of either sign
    corners = naive.exactly(points)
    exact = [float(naive.signed_volume([corners[a] for a in cell])) for cell in cells]
    assert_allclose(volumes(points, cells), exact, rtol=1e-12, atol=1e-15)


def test_volumes_do_not_depend_on_how_many_are_taken_at_a_time(monkeypatch):
    points, cells = random_cells(3, 3)
    whole = volumes(points, cells)
    monkeypatch.setattr(sys.modules["tetopt.geometry.simplex"], "CELLS_AT_A_TIME", 2)
    assert_array_equal(volumes(points, cells), whole)


RANDOM = np.random.default_rng(1).normal(size=(4, 3))


LINE = np.arange(4.0)[:, None] * np.ones(3)


@pytest.mark.parametrize(
    ("function", "points", "cells"),
    [
        (volumes, RANDOM, [[0, 1, 2, 2], [0, 0, 1, 2], [3, 1, 3, 2]]),
        (volumes, RANDOM[:, :2], [[0, 1, 1], [0, 0, 1], [2, 1, 2]]),
        (rho, LINE, [[0, 1, 2, 3], [0, 0, 0, 0]]),
        (rho, LINE[:, :2], [[0, 1, 2], [1, 1, 1]]),
        *[(rho, make(0.0), [[0, 1, 2, 3]]) for make in BAD_TETS.values()],
    ],
)
def test_flat_cells_and_nodes_given_twice_have_exactly_0(function, points, cells):
    with np.errstate(all="raise"):
        assert (function(points, np.array(cells)) == 0.0).all()


@given(seeds, dimensions)
def test_oriented_swaps_the_last_two_nodes_of_negative_cells_only(seed, n):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, n))
    cells = np.array([rng.permutation(30)[: n + 1] for _ in range(20)])
    cells.setflags(write=False)
    turned, is_negative = orient_cells(points, cells), volumes(points, cells) < 0
    assert (volumes(points, turned) > 0).all()
    expected = cells.copy()
    expected[is_negative, -2:] = cells[is_negative][:, [-1, -2]]
    assert_array_equal(turned, expected)
    assert turned.dtype == np.int64


# Edges, facets, centroids


def test_squared_edges_follow_edge_pairs():
    assert edge_pairs(2) == [(0, 1), (0, 2), (1, 2)]
    assert edge_pairs(3) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert squared_edges(*RIGHT_TRIANGLE).tolist() == [[9, 16, 25]]
    assert squared_edges(*OBTUSE_TET).tolist() == [[1, 1, 3, 2, 6, 6]]
    assert squared_edges(*REGULAR_TET).tolist() == [[8] * 6]


def test_facet_areas_are_by_opposite_node():
    assert facet_nodes(2) == [(1, 2), (0, 2), (0, 1)]
    assert facet_nodes(3) == [(1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)]
    assert facet_areas(*RIGHT_TRIANGLE).tolist() == [[5, 4, 3]]
    assert facet_areas(*REGULAR_TET)[0] == pytest.approx([2 * sqrt(3)] * 4, rel=1e-15)
    assert facet_areas(*CUBE_CORNER)[0] == pytest.approx([sqrt(3) / 2, 0.5, 0.5, 0.5], rel=1e-15)
    assert facet_areas(*OBTUSE_TET)[0] == pytest.approx(
        [sqrt(11) / 2, sqrt(0.5), sqrt(0.5), 0.5], rel=1e-15
    )


def test_centroids():
    assert centroids(*RIGHT_TRIANGLE)[0] == pytest.approx([1, 4 / 3])
    assert centroids(*TWO_TETS) == pytest.approx(
        np.array([[0.3125, 0.3125, 0.25], [0.3125, 0.3125, -0.25]])
    )


# Volume gradients


@given(seeds, dimensions)
def test_volume_gradients_are_central_differences(seed, n):
    """Volume is linear in each coordinate of one node, so any step gives the exact derivative."""
    points, cells = random_cells(seed, n, count=3)
    gradients = volume_gradients(points, cells)
    for cell, node, axis in np.ndindex(gradients.shape):
        step = np.zeros_like(points)
        step[cells[cell, node], axis] = 0.5
        ahead, behind = volumes(points + step, cells), volumes(points - step, cells)
        assert gradients[cell, node, axis] == pytest.approx((ahead - behind)[cell], abs=1e-13)


@pytest.mark.parametrize(
    ("mesh", "value", "angles"),
    [
        (EQUILATERAL, 1 / 2, [60, 60, 60]),
        (RIGHT_TRIANGLE, 1 / 2.5, [90, degrees(acos(3 / 5)), degrees(acos(4 / 5))]),
        # r = 2 area / perimeter, R = 1
        (OBTUSE_TRIANGLE, sqrt(3) / 2 / (2 + sqrt(3)), [120, 30, 30]),
        (REGULAR_TET, 1 / 3, [degrees(acos(1 / 3))] * 6),
        # r = 1/(3 + sqrt 3), R = sqrt(3)/2
        (CUBE_CORNER, 2 / (3 + 3 * sqrt(3)), [90] * 3 + [degrees(acos(1 / sqrt(3)))] * 3),
        # R = sqrt(27)/2; facet normals (0, 0, -1), (0, -1, -1), (-1, 0, -1), (1, 1, 3) opposite
        # nodes 3, 2, 1, 0
        (
            OBTUSE_TET,
            2 / sqrt(27) / (1 + 2 * sqrt(2) + sqrt(11)),
            [135, 135, 120, degrees(acos(3 / sqrt(11))), *[degrees(acos(4 / sqrt(22)))] * 2],
        ),
    ],
)
def test_rho_and_dihedral_angles_of_single_cells(mesh, value, angles):
    assert rho(*mesh)[0] == pytest.approx(value, rel=2e-15)
    assert dihedral_angles(*mesh)[0] == pytest.approx(angles, rel=1e-14)


# rho


@given(seeds, dimensions)
def test_rho_is_inradius_over_circumradius(seed, n):
    points, cells = random_cells(seed, n)
    inradius = n * volumes(points, cells) / facet_areas(points, cells).sum(axis=1)
    circumradius = np.linalg.norm(points[cells[:, 0]] - naive.circumcentres(points, cells), axis=1)
    assert_allclose(rho(points, cells), inradius / circumradius, rtol=1e-7)
    assert (rho(points, cells) <= 1 / n + 1e-15).all()
    assert_allclose(rho(points, cells[:, ::-1]), rho(points, cells), rtol=1e-12)


@pytest.mark.parametrize("kind", BAD_TETS)
def test_rho_of_nearly_flat_cells_goes_to_zero_without_a_warning(kind):
    with np.errstate(all="raise"):
        values = [rho(*single(BAD_TETS[kind](t)))[0] for t in (1e-1, 1e-2, 1e-4, 1e-8, 1e-12)]
    assert (np.diff(values) < 0).all()
    assert 0 <= values[-1] < 1e-11


# Angles


@pytest.mark.parametrize("t", [0.3, 1e-3, 1e-9])
def test_dihedral_angles_of_slivers_and_needles_are_accurate(t):
    """By edges 01 02 03 12 13 23; arccos alone would give 0 for the sliver with t = 1e-9."""
    # acos(1 / (1 + 4 t^2)), accurate
    around = degrees(2 * asin(sqrt(2) * t / sqrt(1 + 4 * t * t)))
    across = 180 - degrees(2 * atan(2 * t))
    own = np.sort(dihedral_angles(*single(sliver(t)))[0])
    assert own == pytest.approx(sorted([around] * 4 + [across] * 2), rel=1e-6)
    angles = dihedral_angles(*single(needle(t)))[0]
    assert angles[[0, 5]] == pytest.approx([degrees(2 * atan(t / 2))] * 2, rel=1e-6)
    assert t > 0.01 or (angles[1:5] > 89.9).all()


def test_angles_of_flat_cells_are_0_and_180():
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    angles = np.sort(dihedral_angles(flat, np.array([[0, 1, 2, 3]]))[0])
    assert angles.tolist() == [0, 0, 0, 0, 180, 180]


# Laws


FUNCTIONS = [volumes, rho, dihedral_angles, facet_areas]


@pytest.mark.parametrize("mesh", ALL_SMALL)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_far_from_the_origin_nothing_is_lost(mesh, function):
    """1e6 mm away coordinates are exact to 1e-10 mm; so is everything made of them, and no more
    is lost.
    """
    points, cells = mesh
    shift = 2.0**20 * np.random.default_rng(3).choice([-1, 1], points.shape[1])
    grid = np.round(points * 2.0**30) / 2.0**30  # exact after the shift
    assert_array_equal(function(grid + shift, cells), function(grid, cells))


@pytest.mark.parametrize("n", [2, 3])
def test_no_cells_give_no_rows(n):
    points, cells = np.zeros((3, n)), np.empty((0, n + 1), dtype=np.int64)
    shapes = [function(points, cells).shape for function in FUNCTIONS]
    assert shapes == [(0,), (0,), (0, n * (n + 1) // 2), (0, n + 1)]
