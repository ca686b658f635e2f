"""Quadratic cells with curved edges: rules of integration, Jacobian determinants, what a mesh
takes.
"""

from itertools import product
from math import factorial

import numpy as np
import pytest
from meshes import with_bent_edges
from models import ball_mesh
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
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
    assert (places > 0.0).all()
    assert (weights > 0.0).all()
    assert n == 1 or CURVED_POINTS[len(weights)] == n
    for powers in product(range(6), repeat=n + 1):
        if sum(powers) == 5:
            mean = factorial(n) * np.prod([factorial(power) for power in powers]) / factorial(n + 5)
            assert (weights * np.prod(places ** np.array(powers), axis=1)).sum() == pytest.approx(
                mean, rel=1e-13
            )


@pytest.mark.parametrize("n", [2, 3])
def test_the_determinant_is_how_the_map_to_the_world_grows(n):
    """Beside differences of the map by the shape functions, and bounded from below."""
    mesh = with_bent_edges(ball_mesh(n), 0.08)
    nodes, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    rng = np.random.default_rng(1)
    places = rng.dirichlet(np.ones(n + 1), 20)
    ratios = jacobian_ratios(nodes, cells, places)
    straight, step = np.eye(n + 1) - 1.0 / (n + 1), 1e-5
    for cell, place in product(range(0, len(cells), 41), range(3)):
        moved = [places[place] + sign * step * (straight[1:] - straight[0]) for sign in (1.0, -1.0)]
        ahead, behind = (shape_values(each, 2) @ nodes[cells[cell]] for each in moved)
        corners = mesh.points[mesh.cells[cell]]
        expected = np.linalg.det((ahead - behind) / (2.0 * step)) / np.linalg.det(
            corners[1:] - corners[0]
        )
        assert ratios[cell, place] == pytest.approx(expected, rel=1e-8)
    bounds = jacobian_bounds(nodes, cells)
    assert (bounds <= ratios.min(axis=1) + 1e-12).all()
    assert (bounds < 0.9).any()
    flat = quadratic(mesh.points, mesh.cells)
    assert_allclose(jacobian_bounds(*flat), 1.0, rtol=1e-12)
    assert_allclose(jacobian_ratios(*flat, places), 1.0, rtol=1e-12)


def test_the_bound_is_the_determinant_at_corners():
    """A corner's Bernstein coefficient is the determinant there: of one folded corner the bound
    is no less.
    """
    mesh = tetopt.Mesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]])
    edges = numbered_edges(mesh.cells)[0]
    midpoints = mesh.points[edges].mean(axis=1)
    # of the edge from 0 to 1: at 0 the map has the slope 4 x 0.2 - 1, at 1 3 - 4 x 0.2
    midpoints[0, 0] = 0.2
    nodes, cells = quadratic(mesh.points, mesh.cells, midpoints)
    assert jacobian_ratios(nodes, cells, np.eye(4))[0, :2].tolist() == pytest.approx([-0.2, 2.2])
    assert jacobian_bounds(nodes, cells)[0] == pytest.approx(-0.2)
    folded = tetopt.Mesh(mesh.points, mesh.cells, midpoints)
    assert scaled_jacobians(folded)[0] == pytest.approx(-0.2)
    assert tetopt.check_mesh(mesh) == []
    assert tetopt.check_mesh(folded) == [
        "quadratic cells folded by their mid-edge nodes: 1, the first [0]"
    ]


def test_midpoints_that_a_mesh_does_not_take():
    points, cells = [[0, 0], [1, 0], [0, 1]], [[0, 1, 2]]
    with pytest.raises(
        tetopt.InputError,
        match=r"expected 3 x 2 finite coordinates, one row per edge, got \(2, 2\)",
    ):
        tetopt.Mesh(points, cells, [[0, 0], [1, 1]])
    with pytest.raises(tetopt.InputError, match="expected 3 x 2 finite"):
        tetopt.Mesh(points, cells, [[0, 0], [1, 1], [np.nan, 0]])
    with pytest.raises(tetopt.InputError, match="expected an array of numbers"):
        tetopt.Mesh(points, cells, "middle")
    assert tetopt.Mesh(points, cells).midpoints is None


@pytest.mark.parametrize("n", [2, 3])
def test_volumes_of_curved_cells(n):
    """By the rule, which is exact for the determinant's degree, of cells with all edges bent."""
    mesh = with_bent_edges(ball_mesh(n), 0.08)
    nodes, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    places, weights = curved_rule(n)
    straight = tetopt.Mesh(mesh.points, mesh.cells).cell_volumes
    expected = straight * (jacobian_ratios(nodes, cells, places) @ weights)
    assert_allclose(mesh.cell_volumes, expected, rtol=1e-12)
    assert np.abs(mesh.cell_volumes / straight - 1.0).max() > 0.05
    quality = tetopt.quality(mesh.points, mesh.cells, mesh.midpoints)
    assert quality.volume == pytest.approx(mesh.cell_volumes.sum())
    assert quality.smallest_volume == mesh.cell_volumes.min()
    assert quality._replace(volume=0.0, smallest_volume=0.0) == tetopt.quality(
        mesh.points, mesh.cells
    )._replace(volume=0.0, smallest_volume=0.0)


@pytest.mark.parametrize("n", [2, 3])
def test_pieces_of_curved_cells(n):
    """They fill a mesh again, each in its cell, on all nodes of order 2; of straight cells they
    are equal.
    """
    mesh = with_bent_edges(ball_mesh(n), 0.05)
    pieces, n_pieces = mesh.straight_pieces()
    assert (n_pieces, len(pieces.cells)) == (2**n, 2**n * len(mesh.cells))
    assert tetopt.check_mesh(pieces) == []
    nodes, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    assert_array_equal(pieces.points, nodes)
    assert all(
        set(own) <= set(whole)
        for own, whole in zip(pieces.cells, np.repeat(cells, n_pieces, axis=0), strict=True)
    )
    straight = tetopt.Mesh(mesh.points, mesh.cells)
    assert straight.straight_pieces() == (straight, 1)
    assert mesh.straight_pieces()[0] is pieces  # made once
    assert all(each.cell_volumes is each.cell_volumes for each in (mesh, straight))
    assert not any(each.cell_volumes.flags.writeable for each in (mesh, straight))
    middles = mesh.points[numbered_edges(mesh.cells)[0]].mean(axis=1)
    equal = tetopt.Mesh(mesh.points, mesh.cells, middles).straight_pieces()[0].cell_volumes
    assert_allclose(equal, np.repeat(straight.cell_volumes, n_pieces) / n_pieces, rtol=1e-9)


def test_pieces_of_a_folded_cell_are_straight():
    """Its edges, and no others, so that cells beside it still meet it."""
    mesh = with_bent_edges(ball_mesh(), 0.05)
    midpoints, (edges, number) = mesh.midpoints.copy(), numbered_edges(mesh.cells)
    cell, edge = 7, number[7, 0]
    a, b = mesh.points[edges[edge]]
    midpoints[edge] = a + 1.4 * (b - a)
    pieces = tetopt.Mesh(mesh.points, mesh.cells, midpoints).straight_pieces()[0]
    assert tetopt.check_mesh(pieces) == []
    shown, straight = pieces.points[len(mesh.points) :], mesh.points[edges].mean(axis=1)
    assert_array_equal(shown[number[cell]], straight[number[cell]])
    assert 0.5 < (shown == midpoints).all(axis=1).mean() < 1.0
