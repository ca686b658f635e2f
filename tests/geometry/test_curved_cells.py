"""Quadratic cells with curved edges: rules of integration, Jacobian determinants, what a mesh
takes.
"""

from itertools import product
from math import factorial

import numpy as np
import pytest
from meshes import both_dimensions, with_bent_edges
from models import ball_mesh
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt import Mesh, check_mesh
from tetopt.geometry.check import scaled_jacobians
from tetopt.geometry.quadratic import (
    CURVED_POINTS,
    curved_rule,
    jacobian_bounds,
    jacobian_ratios,
    numbered_edges,
    quadratic,
    shape_values,
)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_rule_is_of_degree_5(n):
    """Of monomials of barycentric coordinates the mean is n! a! b! ... / (n + a + b + ...)!."""
    places, weights = curved_rule(n)
    assert places.min() > 0.0 < weights.min()
    assert n == 1 or CURVED_POINTS[len(weights)] == n
    for powers in product(range(6), repeat=n + 1):
        if sum(powers) == 5:
            mean = factorial(n) * np.prod([factorial(power) for power in powers]) / factorial(n + 5)
            by_rule = weights @ np.prod(places ** np.array(powers), axis=1)
            assert by_rule == pytest.approx(mean, rel=1e-13)


def bent(n, fraction=0.08):
    """A ball of curved cells, the same of straight ones, and the former's nodes and cells."""
    mesh = with_bent_edges(ball_mesh(n), fraction)
    curved = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    return mesh, Mesh(mesh.points, mesh.cells), *curved


@both_dimensions
def test_the_determinant_is_how_the_map_to_the_world_grows(n):
    """Beside differences of the map by the shape functions, and bounded from below."""
    mesh, _, nodes, cells = bent(n)
    places = np.random.default_rng(1).dirichlet(np.ones(n + 1), 20)
    ratios = jacobian_ratios(nodes, cells, places)
    ways, step = np.eye(n + 1)[1:] - np.eye(n + 1)[0], 1e-5
    for cell, place in product(range(0, len(cells), 41), range(3)):
        ahead, behind = (
            shape_values(places[place] + sign * step * ways, 2) @ nodes[cells[cell]]
            for sign in (1.0, -1.0)
        )
        corners = mesh.points[mesh.cells[cell]]
        grown, flat = (ahead - behind) / (2.0 * step), corners[1:] - corners[0]
        expected = np.linalg.det(grown) / np.linalg.det(flat)
        assert ratios[cell, place] == pytest.approx(expected, rel=1e-8)
    bounds = jacobian_bounds(nodes, cells)
    assert (bounds <= ratios.min(axis=1) + 1e-12).all()
    assert (bounds < 0.9).any()
    flat = quadratic(mesh.points, mesh.cells)
    for of_flat in (jacobian_bounds(*flat), jacobian_ratios(*flat, places)):
        assert_allclose(of_flat, 1.0, rtol=1e-12)


def test_the_bound_is_the_determinant_at_corners():
    """A corner's Bernstein coefficient is the determinant there: of one folded corner the bound
    is no less.
    """
    mesh = Mesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]])
    edges = numbered_edges(mesh.cells)[0]
    midpoints = mesh.points[edges].mean(axis=1)
    # of the edge from 0 to 1: at 0 the map has the slope 4 x 0.2 - 1, at 1 3 - 4 x 0.2
    midpoints[0, 0] = 0.2
    nodes, cells = quadratic(mesh.points, mesh.cells, midpoints)
    assert jacobian_ratios(nodes, cells, np.eye(4))[0, :2].tolist() == pytest.approx([-0.2, 2.2])
    assert jacobian_bounds(nodes, cells)[0] == pytest.approx(-0.2)
    folded = Mesh(mesh.points, mesh.cells, midpoints)
    assert scaled_jacobians(folded)[0] == pytest.approx(-0.2)
    assert check_mesh(mesh) == []
    assert check_mesh(folded) == [
        "quadratic cells folded by their mid-edge nodes: 1, the first [0]"
    ]


@pytest.mark.parametrize(
    ("midpoints", "words"),
    [
        ([[0, 0], [1, 1]], r"3 x 2 finite coordinates, .*, got \(2, 2\)"),
        ([[0, 0], [1, 1], [np.nan, 0]], "3 x 2 finite"),
        ("middle", "an array of numbers"),
    ],
)
def test_midpoints_that_a_mesh_does_not_take(midpoints, words):
    with pytest.raises(tetopt.InputError, match=f"expected {words}"):
        Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]], midpoints)


@both_dimensions
def test_volumes_of_curved_cells(n):
    """By the rule, which is exact for the determinant's degree, of cells with all edges bent."""
    mesh, straight, nodes, cells = bent(n)
    places, weights = curved_rule(n)
    growth = jacobian_ratios(nodes, cells, places) @ weights
    assert_allclose(mesh.cell_volumes, straight.cell_volumes * growth, rtol=1e-12)
    assert np.abs(growth - 1.0).max() > 0.05
    quality, flat = (
        tetopt.quality(each.points, each.cells, each.midpoints) for each in (mesh, straight)
    )
    assert quality.volume == pytest.approx(mesh.cell_volumes.sum())
    assert quality.smallest_volume == mesh.cell_volumes.min()
    none = {"volume": 0.0, "smallest_volume": 0.0}
    assert quality._replace(**none) == flat._replace(**none)


@both_dimensions
def test_pieces_of_curved_cells(n):
    """They fill a mesh again, each in its cell, on all nodes of order 2; of straight cells they
    are equal.
    """
    mesh, straight, nodes, cells = bent(n, 0.05)
    pieces, n_pieces = mesh.straight_pieces()
    assert (n_pieces, len(pieces.cells)) == (2**n, 2**n * len(mesh.cells))
    assert check_mesh(pieces) == []
    assert_array_equal(pieces.points, nodes)
    wholes = np.repeat(cells, n_pieces, axis=0)
    assert (pieces.cells[:, :, None] == wholes[:, None]).any(axis=2).all()
    assert straight.straight_pieces() == (straight, 1)
    assert mesh.straight_pieces()[0] is pieces  # made once
    for each in (mesh, straight):
        assert each.cell_volumes is each.cell_volumes
        assert not each.cell_volumes.flags.writeable
    middles = mesh.points[numbered_edges(mesh.cells)[0]].mean(axis=1)
    equal = Mesh(mesh.points, mesh.cells, middles).straight_pieces()[0].cell_volumes
    assert_allclose(equal, np.repeat(straight.cell_volumes, n_pieces) / n_pieces, rtol=1e-9)


def test_pieces_of_a_folded_cell_are_straight():
    """Its edges, and no others, so that cells beside it still meet it."""
    mesh = with_bent_edges(ball_mesh(), 0.05)
    midpoints, (edges, number) = mesh.midpoints.copy(), numbered_edges(mesh.cells)
    cell, edge = 7, number[7, 0]
    a, b = mesh.points[edges[edge]]
    midpoints[edge] = a + 1.4 * (b - a)
    pieces = Mesh(mesh.points, mesh.cells, midpoints).straight_pieces()[0]
    assert check_mesh(pieces) == []
    shown, straight = pieces.points[len(mesh.points) :], mesh.points[edges].mean(axis=1)
    assert_array_equal(shown[number[cell]], straight[number[cell]])
    assert 0.5 < (shown == midpoints).all(axis=1).mean() < 1.0
