"""Exact distances of many points from triangles, by bins of the triangles' bounding box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tetopt.geometry.vectors import cross, dot, minus, over, row, scale_vector
from tetopt.system.arrays import Floats, Ints
from tetopt.system.kernels import Floats1, Floats2, Ints1, Ints2, entry, helper, run, unit

# exponent of the number of triangles for bins along the longest side, with a few triangles in each
BINS_POWER = 0.37
# of a triangle's longest edge, squared: with a shorter normal it counts as its edges
FLAT_NORMAL = 2e-6
POINTS_PER_TASK = 64  # points that a parallel task handles at once


class _Search(NamedTuple):
    """The squared distances to fill in, and their inputs."""

    squares: Floats1
    points: Floats2
    nodes: Floats2
    facets: Ints2  # three nodes a triangle
    start: Ints1  # of each bin in `listed`, and the end of the last
    listed: Ints1  # triangles, bin after bin
    counts: Ints1  # bins along each axis
    low: Floats1
    size: float  # a bin's edge


def triangle_distances(points: Floats, nodes: Floats, facets: Ints) -> Floats:
    """Distance of points (K, 3) from the nearest of one or more triangles (T, 3) of nodes (P, 3):
    (K,), in their unit.

    Flat triangles count as their edges, or as a single point.
    """
    is_used = np.zeros(len(nodes), dtype=bool)
    is_used[facets] = True
    low = nodes[is_used].min(axis=0)
    extent = nodes[is_used].max(axis=0) - low
    size = float(extent.max()) / len(facets) ** BINS_POWER or 1.0
    counts = (extent / size).astype(np.int64) + 1
    bins, facets = ((nodes - low) / size).astype(np.int64), np.ascontiguousarray(facets)
    start = np.zeros(counts.prod() + 2, dtype=np.int64)
    _list_by_bin(start[2:], np.empty(0, dtype=np.int64), bins, facets, counts)
    np.cumsum(start, out=start)
    listed = np.empty(start[-1], dtype=np.int64)
    # moves each bin's start to that of the next one
    _list_by_bin(start[1:], listed, bins, facets, counts)
    squares = np.full(len(points), np.inf)
    points, nodes = np.ascontiguousarray(points), np.ascontiguousarray(nodes)
    work = _Search(squares, points, nodes, facets, start[:-1], listed, counts, low, size)
    run(_fill_squares, -(-len(points) // POINTS_PER_TASK), work)
    return np.sqrt(squares)


# Kernels.


@entry
def _list_by_bin(place: Ints1, listed: Ints1, bins: Ints2, facets: Ints2, counts: Ints1) -> None:
    """Count the triangles whose bounding boxes reach each bin, or list them, starting at the place
    of each bin.

    `bins` (P, 3) are those of the triangles' nodes.
    """
    for triangle in range(len(facets)):
        a, b, c = (
            row(bins, facets[triangle, 0]),
            row(bins, facets[triangle, 1]),
            row(bins, facets[triangle, 2]),
        )
        for i in range(min(a[0], b[0], c[0]), max(a[0], b[0], c[0]) + 1):
            for j in range(min(a[1], b[1], c[1]), max(a[1], b[1], c[1]) + 1):
                for k in range(min(a[2], b[2], c[2]), max(a[2], b[2], c[2]) + 1):
                    at = (i * counts[1] + j) * counts[2] + k
                    if len(listed) > 0:
                        listed[place[at]] = triangle
                    place[at] += 1


@helper
def _edge_square(p: tuple, along: tuple) -> float:
    """Squared distance of p from the segment between 0 and `along`."""
    # 1e-300, chosen: against division by 0
    fraction = min(max(dot(p, along) / max(dot(along, along), 1e-300), 0.0), 1.0)
    way = minus(p, scale_vector(fraction, along))
    return float(dot(way, way))


@helper
def _triangle_square(p: tuple, a: tuple, b: tuple, c: tuple) -> float:
    """Squared distance of p from a triangle: at its foot in the plane if that is inside, else
    from the edges.
    """
    pa, ab, ac, bc = minus(p, a), minus(b, a), minus(c, a), minus(c, b)
    normal = cross(ab, ac)
    square = dot(normal, normal)
    longest = max(dot(ab, ab), dot(ac, ac), dot(bc, bc))
    if square > (FLAT_NORMAL * longest) ** 2:
        at_b, at_c = dot(cross(pa, ac), normal), dot(cross(ab, pa), normal)
        if at_b >= 0.0 and at_c >= 0.0 and at_b + at_c <= square:
            return float(dot(pa, over(normal, np.sqrt(square))) ** 2)
    return min(_edge_square(pa, ab), _edge_square(pa, ac), _edge_square(minus(p, b), bc))


@helper
def _bin_square(work: _Search, p: tuple, at: int, least: float) -> float:
    """Squared distance of p from the triangles of a bin, or the least so far if that is smaller."""
    for place in range(work.start[at], work.start[at + 1]):
        facet = row(work.facets, work.listed[place])
        a, b, c = row(work.nodes, facet[0]), row(work.nodes, facet[1]), row(work.nodes, facet[2])
        least = min(least, _triangle_square(p, a, b, c))
    return least


@helper
def _gap(x: float, place: int) -> float:
    """Squared distance of x, in bins, from the bin of a place, along one axis."""
    return float(max(place - x, x - place - 1.0, 0.0) ** 2)


@helper
def _nearest_square(work: _Search, p: tuple) -> float:
    """Squared distance of p: search rings of bins around the nearest one until none can be
    nearer.
    """
    least, counts, size = np.inf, work.counts, work.size
    x = over(minus(p, (work.low[0], work.low[1], work.low[2])), size)
    at_i = int(min(max(x[0], 0.0), counts[0] - 1.0))
    at_j = int(min(max(x[1], 0.0), counts[1] - 1.0))
    at_k = int(min(max(x[2], 0.0), counts[2] - 1.0))
    for ring in range(max(counts[0], counts[1], counts[2])):
        if least <= ((ring - 1) * size) ** 2:
            break
        for i in range(max(at_i - ring, 0), min(at_i + ring + 1, counts[0])):
            for j in range(max(at_j - ring, 0), min(at_j + ring + 1, counts[1])):
                is_side = abs(i - at_i) == ring or abs(j - at_j) == ring
                beside = _gap(x[0], i) + _gap(x[1], j)
                for k in range(at_k - ring, at_k + ring + 1, 1 if is_side else 2 * ring):
                    if 0 <= k < counts[2] and (beside + _gap(x[2], k)) * size**2 < least:
                        least = _bin_square(work, p, (i * counts[1] + j) * counts[2] + k, least)
    return least


@unit
def _fill_squares(work: _Search, chunk: int) -> None:
    for number in range(
        chunk * POINTS_PER_TASK, min((chunk + 1) * POINTS_PER_TASK, len(work.points))
    ):
        work.squares[number] = _nearest_square(work, row(work.points, number))
