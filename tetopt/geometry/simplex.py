"""Closed forms for triangles and tetrahedra, one row per cell.

Everywhere `points` is (N, n) float64 in mm and `cells` is (M, n+1) integer, n = 2 or 3.
"""

from __future__ import annotations

from itertools import combinations
from math import factorial

import numpy as np
from numpy.typing import NDArray

from tetopt.system.arrays import Floats, Ints

Points = Floats
Cells = NDArray[np.integer]
CELLS_AT_A_TIME = 2**13  # their corners fit into a processor's cache


def edge_pairs(n: int) -> list[tuple[int, int]]:
    """Local node pairs of the n(n+1)/2 edges of an n-simplex, in lexicographic order."""
    return list(combinations(range(n + 1), 2))


def facet_nodes(n: int) -> list[tuple[int, ...]]:
    """Local nodes of the n+1 facets of an n-simplex; facet i lies opposite node i."""
    return [tuple(k for k in range(n + 1) if k != i) for i in range(n + 1)]


def outward_facet_nodes(n: int) -> Ints:
    """Local nodes of each facet, facing out; for even k, `facet_nodes` of a positively oriented
    simplex do already.
    """
    return np.array(
        [
            nodes if k % 2 == 0 else (nodes[1], nodes[0], *nodes[2:])
            for k, nodes in enumerate(facet_nodes(n))
        ]
    )


def volumes(points: Points, cells: Cells) -> Floats:
    """Signed volumes (areas in 2-D), (M,) float64, mm^n; positive for a positively oriented
    cell.
    """
    result, columns = np.empty(len(cells)), np.ascontiguousarray(points.T)
    for start in range(0, len(cells), CELLS_AT_A_TIME):
        some = slice(start, start + CELLS_AT_A_TIME)
        # coordinate by coordinate takes half the time
        corners = columns[:, np.ascontiguousarray(cells[some].T)]
        result[some] = determinants((corners[:, 1:] - corners[:, :1]).T) / factorial(
            points.shape[1]
        )
    return result


def determinants(frames: Floats) -> Floats:
    """Determinants of (M, n, n) matrices, written out: exactly 0 where two rows are equal,
    unlike an LU's.
    """
    if frames.shape[1] == 2:
        return frames[:, 0, 0] * frames[:, 1, 1] - frames[:, 0, 1] * frames[:, 1, 0]
    (a, b, c), (d, e, f), (g, h, i) = (frames[:, row].T for row in range(3))
    return (a * (e * i - f * h) + c * (d * h - e * g)) + b * (f * g - d * i) + 0.0  # no -0


def orient_cells(points: Points, cells: Cells) -> Ints:
    """Copy of `cells`, (M, n+1) int64, with the last two nodes swapped where the signed volume
    is negative.
    """
    turned = np.array(cells, dtype=np.int64)
    is_negative = volumes(points, cells) < 0.0
    turned[is_negative, -2:] = turned[is_negative, :-3:-1]
    return turned


def centroids(points: Points, cells: Cells) -> Floats:
    """Mean of each cell's nodes, (M, n) float64, mm."""
    return points[cells].mean(axis=1)


def squared_edges(points: Points, cells: Cells) -> Floats:
    """Squared edge lengths, (M, n(n+1)/2) float64, mm^2, in the order of `edge_pairs`."""
    corners = points[cells]
    first, second = np.array(edge_pairs(points.shape[1])).T
    return ((corners[:, second] - corners[:, first]) ** 2).sum(axis=2)


def facet_areas(points: Points, cells: Cells) -> Floats:
    """Areas (edge lengths in 2-D) of each cell's facets, (M, n+1) float64, mm^(n-1); column i is
    opposite node i.
    """
    return np.stack(
        [np.sqrt(_dot(normal, normal)) for normal in _facet_normals(points, cells)], axis=1
    )


def area_normals(corners: Floats) -> Floats:
    """Normals (K, n) of facets with corners (K, n, n), as long as their areas, mm^2 (in 2-D mm).

    They point to the side from which three corners turn anticlockwise; in 2-D to the right of first
    to second.
    """
    edges = corners[:, 1:] - corners[:, :1]
    if corners.shape[2] == 3:
        return 0.5 * np.cross(edges[:, 0], edges[:, 1])
    return edges[:, 0, ::-1] * np.array([1.0, -1.0])


def regular_edge(size: Floats, n: int) -> Floats:
    """Edge, mm, of the regular n-simplex of a given volume, mm^n."""
    return (6.0 * 2.0**0.5 * size) ** (1 / 3) if n == 3 else (4.0 / 3.0**0.5 * size) ** 0.5


Vectors = list[Floats]  # n components, (M,) each: three times as fast as rows


def _corners(points: Points, cells: Cells) -> list[Vectors]:
    """Coordinates of each cell's corners, by corner."""
    axes = [np.ascontiguousarray(axis)[cells.T] for axis in points.T]
    return [[axis[k] for axis in axes] for k in range(cells.shape[1])]


def _minus(a: Vectors, b: Vectors) -> Vectors:
    return [x - y for x, y in zip(a, b, strict=True)]


def _dot(a: Vectors, b: Vectors) -> Floats:
    total = a[0] * b[0] + 0.0  # + 0.0 avoids -0, whose sign would change angles of flat cells
    for x, y in zip(a[1:], b[1:], strict=True):
        total += x * y
    return total


def _cross(a: Vectors, b: Vectors) -> Vectors:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _facet_normals(points: Points, cells: Cells) -> list[Vectors]:
    """Outward normals of positively oriented cells, as long as their facet's area, by the node
    opposite.
    """
    corners = _corners(points, cells)
    if points.shape[1] == 2:
        along = [_minus(corners[b], corners[a]) for a, b in ((1, 2), (2, 0), (0, 1))]
        return [[y, -x] for x, y in along]
    normals = []
    # ordered so that the product points outwards
    for a, b, c in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)):
        product = _cross(_minus(corners[b], corners[a]), _minus(corners[c], corners[a]))
        normals.append([0.5 * x for x in product])
    return normals


def volume_gradients(points: Points, cells: Cells) -> Floats:
    """Gradient of each cell's volume by each of its nodes, (M, n+1, n) float64, mm^(n-1).

    Moving node i along a vector d changes the volume by (area of the opposite facet) x (height
    gained) / n, so the gradient is minus the outward area normal over n.
    """
    normals = np.stack(
        [np.stack(normal, axis=1) for normal in _facet_normals(points, cells)], axis=1
    )
    return -normals / points.shape[1]


def rho(points: Points, cells: Cells) -> Floats:
    """Inradius over circumradius, (M,) float64 in [0, 1/n]: 1/n for the regular simplex, 0 for a
    flat one.

    The shape measure of Section 2.1. The inradius is n v / (sum of facet areas). In 2-D the
    circumradius is abc / 4v; in 3-D it is |a^2 (b x c) + b^2 (c x a) + c^2 (a x b)| / 12 v with the
    edges a, b, c from one node. Their quotient has v^2 in the numerator, so flat cells need no
    special case. Inverted cells get the value of their mirror image.
    """
    v = volumes(points, cells)
    if points.shape[1] == 2:
        lengths = np.sqrt(squared_edges(points, cells))
        below = lengths.sum(axis=1) * lengths.prod(axis=1)
        above = 8.0 * v**2
    else:
        corners = _corners(points, cells)
        a, b, c = (_minus(corner, corners[0]) for corner in corners[1:])
        aa, bb, cc = (_dot(x, x) for x in (a, b, c))
        products = zip(_cross(b, c), _cross(c, a), _cross(a, b), strict=True)
        numerator = [aa * x + bb * y + cc * z for x, y, z in products]
        below = facet_areas(points, cells).sum(axis=1) * np.sqrt(_dot(numerator, numerator))
        above = 36.0 * v**2
    return np.divide(above, below, out=np.zeros_like(v), where=below > 0.0)


def dihedral_angles(points: Points, cells: Cells) -> Floats:
    """Angles between facets, degrees: (M, 6) float64 in 3-D, by `edge_pairs`; (M, 3) in 2-D, by
    node.

    In 3-D entry k is the angle inside the cell at edge k; in 2-D entry i is the triangle's angle at
    node i. Flat cells have angles 0 and 180.
    """
    n = points.shape[1]
    normals = _facet_normals(points, cells)
    if n == 2:
        # the two edges that meet in node i lie opposite the two others
        pairs = [(1, 2), (2, 0), (0, 1)]
    else:
        # the facets at an edge lie opposite the two nodes it leaves out
        pairs = edge_pairs(3)[::-1]
    angles = np.empty((len(cells), len(pairs)))
    for column, (i, j) in enumerate(pairs):
        p, q = normals[i], normals[j]
        if n == 2:
            sine = np.abs(p[0] * q[1] - p[1] * q[0])
        else:
            product = _cross(p, q)
            sine = np.sqrt(_dot(product, product))
        # exact near 0 and 180, where arccos is not
        angles[:, column] = np.degrees(np.arctan2(sine, -_dot(p, q)))
    return angles
