"""Cells of order 1 and 2: nodes, shape functions, integration rules.

Order 1 has a node at each corner and linear displacements in a cell; order 2 adds a node in the
middle of each edge and has quadratic displacements. Edges are straight, so that a cell is the same
simplex in either order, unless their midpoints are given: such cells are isoparametric, and the
shape functions map the straight cell onto the curved one. Places within a cell are barycentric, (K,
n+1). See Zienkiewicz and Taylor, The Finite Element Method, volume 1, chapters 4 (shape functions)
and 5 (integration).
"""

from __future__ import annotations

from itertools import permutations, product
from math import factorial

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.simplex import determinants, outward_facet_nodes, volume_gradients, volumes
from tetopt.system.arrays import Floats, Ints

# Local corners of the edges whose midpoints are a tetrahedron's nodes 4 to 9, as in VTK, Abaqus and
# FEBio; the first three are a triangle's, nodes 3 to 5.
QUADRATIC_EDGES = np.array([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)])
# Local nodes of the straight cells into which a cell of order 2 is split, by dimension: one at each
# corner, the rest of a tetrahedron around the line between nodes 6 and 8.
STRAIGHT_PIECES = {
    2: np.array([(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)]),
    3: np.array(
        [
            (0, 4, 6, 7),
            (4, 1, 5, 8),
            (6, 5, 2, 9),
            (7, 8, 9, 3),
            (6, 8, 4, 5),
            (6, 8, 5, 9),
            (6, 8, 9, 7),
            (6, 8, 7, 4),
        ]
    ),
}
CURVED_POINTS = {7: 2, 14: 3}  # number of points of `curved_rule`: its dimension
ROOT_OF_15 = 15.0**0.5  # in the coordinates and weights of Radon's rule and Gauss's
# Points of `curved_rule` by dimension, each for all distinct permutations of its coordinates, with
# their weights.
CURVED_ORBITS: dict[int, list[tuple[tuple[float, ...], float]]] = {
    1: [((0.5, 0.5), 4.0 / 9.0), ((0.5 + 0.1 * ROOT_OF_15, 0.5 - 0.1 * ROOT_OF_15), 5.0 / 18.0)],
    2: [
        ((1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0), 0.225),
        (
            ((9.0 + 2.0 * ROOT_OF_15) / 21.0, *((6.0 - ROOT_OF_15) / 21.0,) * 2),
            (155.0 - ROOT_OF_15) / 1200.0,
        ),
        (
            ((9.0 - 2.0 * ROOT_OF_15) / 21.0, *((6.0 + ROOT_OF_15) / 21.0,) * 2),
            (155.0 + ROOT_OF_15) / 1200.0,
        ),
    ],
    3: [
        ((0.72179424906732632079, *(0.09273525031089122640,) * 3), 0.07349304311636194934),
        ((0.06734224221009817060, *(0.31088591926330060980,) * 3), 0.11268792571801585080),
        ((*(0.45449629587435035051,) * 2, *(0.04550370412564964949,) * 2), 0.04254602077708146644),
    ],
}


def cell_edges(n: int) -> Ints:
    """Local corners (E, 2) of the edges of a triangle (n = 2) or a tetrahedron, in the order of
    their nodes.
    """
    return QUADRATIC_EDGES[: n * (n + 1) // 2]


def edge_ends(cells: Ints) -> Ints:
    """The edges of cells (M, n+1), (M, 3 or 6, 2), each with the lower node first."""
    return np.sort(cells[:, cell_edges(cells.shape[1] - 1)], axis=2)


def numbered_edges(cells: Ints) -> tuple[Ints, Ints]:
    """The edges (E, 2) of cells (M, n+1), sorted by their ends, and the numbers (M, 3 or 6) of
    each cell's edges.
    """
    ends = edge_ends(cells)
    n_nodes = int(cells.max()) + 1
    # As single numbers: ten times faster than as pairs, at 112,000 tetrahedra.
    keys, number = np.unique(ends[..., 0] * n_nodes + ends[..., 1], return_inverse=True)
    return np.column_stack(np.divmod(keys, n_nodes)), number.reshape(len(cells), -1)


def quadratic(
    points: Floats,
    cells: Ints,
    midpoints: Floats | None = None,
) -> tuple[Floats, Ints]:
    """Nodes (N + E, n) and cells (M, 6 or 10) of order 2 from points (N, n) and cells (M, n+1).

    The points come first, then the midpoints (E, n) of the edges sorted by their ends (by default
    the edges are straight). A cell's corners come first, then the midpoints of `cell_edges`.
    """
    edges, number = numbered_edges(cells)
    if midpoints is None:
        midpoints = points[edges].mean(axis=1)
    return np.concatenate([points, midpoints]), np.column_stack([cells, len(points) + number])


def of_order(
    points: Floats,
    cells: Ints,
    order: int,
    midpoints: Floats | None = None,
) -> tuple[Floats, Ints]:
    """Nodes and cells of order 1 (the points and cells themselves) or 2; raise InputError for
    another order.
    """
    if order not in (1, 2):
        raise InputError(f"order: expected 1 or 2, got {order}")
    return (points, cells) if order == 1 else quadratic(points, cells, midpoints)


def node_count(points: Floats, cells: Ints, order: int) -> int:
    """Number of nodes of an order; order 2 includes the mid-edge nodes."""
    return len(of_order(points, cells, order)[0])


def quadratic_facet_nodes(cells: Ints, rows: Ints) -> Ints:
    """Nodes (K, 3 or 6) of facets (K, 2), rows of (cell, local corner opposite), of cells of order
    2.

    The corners come first, facing out, then the midpoints: for a triangle between its first and
    second, second and third, and third and first corners.
    """
    n = 2 if cells.shape[1] == 6 else 3
    of_edge = {
        frozenset(edge): n + 1 + number for number, edge in enumerate(cell_edges(n).tolist())
    }
    sides = [(0, 1), (1, 2), (2, 0)] if n == 3 else [(0, 1)]
    local = np.array(
        [
            [*corners, *(of_edge[frozenset((corners[a], corners[b]))] for a, b in sides)]
            for corners in outward_facet_nodes(n).tolist()
        ]
    )
    return cells[rows[:, :1], local[rows[:, 1]]]


def shape_values(places: Floats, order: int) -> Floats:
    """Shape functions at places (K, n+1) within a cell, (K, A), in the order of the cell's nodes.

    At a corner lambda (2 lambda - 1), in the middle of an edge 4 lambda_a lambda_b; for order 1
    lambda.
    """
    if order == 1:
        return places
    a, b = cell_edges(places.shape[1] - 1).T
    return np.column_stack([places * (2.0 * places - 1.0), 4.0 * places[:, a] * places[:, b]])


def shape_slopes(places: Floats, order: int) -> Floats:
    """Derivatives of the shape functions by the barycentric coordinates, (K, A, n+1).

    Multiplied by the gradients of the coordinates, (n+1, n), they give the shape functions'
    gradients in the world.
    """
    n_places, n_corners = places.shape
    if order == 1:
        return np.broadcast_to(np.eye(n_corners), (n_places, n_corners, n_corners))
    edges = cell_edges(n_corners - 1)
    slopes = np.zeros((n_places, n_corners + len(edges), n_corners))
    corners = np.arange(n_corners)
    slopes[:, corners, corners] = 4.0 * places - 1.0
    for node, (a, b) in enumerate(edges, start=n_corners):
        slopes[:, node, a] = 4.0 * places[:, b]
        slopes[:, node, b] = 4.0 * places[:, a]
    return slopes


def gauss_rule(n: int, order: int, is_curved: bool = False) -> tuple[Floats, Floats]:
    """Places (Q, n+1) and weights (Q,), which sum to 1, of the rule that integrates a cell's
    stiffness.

    One point for order 1; n + 1 for order 2, exact for polynomials of degree 2 such as the product
    of two strains. Point k lies nearest to corner k. Curved cells of order 2 use `curved_rule`.
    """
    if is_curved and order == 2:
        return curved_rule(n)
    if order == 1:
        return np.full((1, n + 1), 1.0 / (n + 1)), np.ones(1)
    near = (5.0 - np.sqrt(5.0)) / 20.0 if n == 3 else 1.0 / 6.0
    places = np.full((n + 1, n + 1), near)
    np.fill_diagonal(places, 1.0 - n * near)
    return places, np.full(n + 1, 1.0 / (n + 1))


def curved_rule(n: int) -> tuple[Floats, Floats]:
    """Places (Q, n+1) and weights (Q,), which sum to 1, of a rule of degree 5 with 3, 7 or 14
    points.

    It integrates curved cells exactly: a tetrahedron's volume is an integral of degree 3, its
    weight on a node of degree 5, the force of a uniform stress on a node of degree 3, so that patch
    tests hold. The rules are Gauss's, Radon's (Monatshefte fuer Mathematik 52, 1948, 286-300) and
    Walkington's (Carnegie Mellon University, research report 00-CNA-023, 2000).
    """
    places = [
        (place, weight)
        for point, weight in CURVED_ORBITS[n]
        for place in sorted(set(permutations(point)), reverse=True)
    ]
    return np.array([place for place, _ in places]), np.array([weight for _, weight in places])


def on_curved_rule(values: Floats) -> Floats:
    """Transfer values (M, n+1) of the parts of cells nearest to each corner to the points of
    `curved_rule`, (M, Q).

    A point equally near to several corners gets the mean of their values.
    """
    places = curved_rule(values.shape[1] - 1)[0]
    is_nearest = places == places.max(axis=1, keepdims=True)
    return np.einsum("qa,ca->cq", is_nearest / is_nearest.sum(axis=1, keepdims=True), values)


def jacobian_ratios(nodes: Floats, cells: Ints, places: Floats) -> Floats:
    """Jacobian determinants of quadratic cells (M, 6 or 10) at places (K, n+1), relative to
    straight cells, (M, K).

    The ratio of the local volume to that in the cell with the same corners and straight edges: 1
    everywhere in a straight cell; where it is 0 or less, the cell is folded and no solver accepts
    it.
    """
    corners = cells[:, : places.shape[1]]
    gradients = volume_gradients(nodes, corners) / volumes(nodes, corners)[:, None, None]
    maps = (mapped_slopes(nodes[cells], slopes @ gradients) for slopes in shape_slopes(places, 2))
    return np.stack([determinants(each) for each in maps], axis=1)


def curved_volumes(nodes: Floats, cells: Ints) -> Floats:
    """Volumes (areas in 2-D) of quadratic cells (M, 6 or 10), (M,), mm^n: exact, as the
    determinant is of degree n.
    """
    places, weights = curved_rule(nodes.shape[1])
    mean = (jacobian_ratios(nodes, cells, places) * weights).sum(axis=1)
    return volumes(nodes, cells[:, : nodes.shape[1] + 1]) * mean


def straight_pieces(points: Floats, cells: Ints, midpoints: Floats) -> tuple[Floats, Ints]:
    """Split cells (M, n+1) with curved edges at their midpoints: nodes of order 2, and 4 M or 8 M
    straight cells.

    Their facets lie nearer to curved ones than a straight cell's by a factor of four. The pieces of
    a cell follow each other. Where one would be flat or inverted, as in a folded cell, the edges of
    the cell become straight.
    """
    nodes, whole = quadratic(points, cells, midpoints)
    straight, n = quadratic(points, cells)[0], points.shape[1]
    while True:
        pieces = whole[:, STRAIGHT_PIECES[n]]
        is_flat = (
            volumes(nodes, pieces.reshape(-1, n + 1)).reshape(len(cells), -1).min(axis=1) <= 0.0
        )
        bent = whole[is_flat, n + 1 :]
        if (nodes[bent] == straight[bent]).all():
            return nodes, pieces.reshape(-1, n + 1)
        nodes[bent] = straight[bent]


def mapped_slopes(nodes: Floats, gradients: Floats) -> Floats:
    """Derivatives (M, n, n) of the map from straight to curved cells, from nodes and gradients
    (M, A, n).
    """
    return np.einsum("cai,caj->cij", nodes, gradients)


def jacobian_bounds(nodes: Floats, cells: Ints) -> Floats:
    """A lower bound (M,) of `jacobian_ratios` anywhere in quadratic cells (M, 6 or 10).

    The determinant is a polynomial of degree n, never below the least of its Bernstein
    coefficients: where these are positive, the cell is nowhere folded (Johnen, Remacle and Geuzaine
    2013, J. Comput. Phys. 233, 359-372).
    """
    n = nodes.shape[1]
    corners, edges = nodes[cells[:, : n + 1]], cell_edges(n)
    # control points of the cell in Bezier form, by pairs of corners
    controls = np.empty((len(cells), n + 1, n + 1, n))
    controls[:, range(n + 1), range(n + 1)] = corners
    middles = 2.0 * nodes[cells[:, n + 1 :]] - 0.5 * (
        corners[:, edges[:, 0]] + corners[:, edges[:, 1]]
    )
    controls[:, edges[:, 0], edges[:, 1]] = controls[:, edges[:, 1], edges[:, 0]] = middles
    # (M, n, n+1, n): slopes from corner 0, linear in the cell
    arms = 2.0 * (controls[:, 1:] - controls[:, :1])
    sums: dict[tuple[int, ...], list[Floats]] = {}
    for of_arm in product(range(n + 1), repeat=n):
        frames = np.stack([arms[:, axis, k] for axis, k in enumerate(of_arm)], axis=1)
        sums.setdefault(tuple(sorted(of_arm)), []).append(determinants(frames))
    least = np.min([np.mean(terms, axis=0) for terms in sums.values()], axis=0)
    return np.asarray(least / (factorial(n) * volumes(nodes, cells[:, : n + 1])))
