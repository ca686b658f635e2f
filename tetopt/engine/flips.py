"""Exchanging cells for others over the same cavity, where that lowers the combined energy.

"Accept a tessellation only if it decreases the energy" (Section 4 of the paper), cell by cell. Two moves reach every
tetrahedralization of a small cavity: the face flip, which replaces the two tetrahedra of a facet by three around a new
edge (2-3), and the removal of an edge, which replaces the m tetrahedra around it by the 2 (m - 2) of the best
triangulation of the polygon they leave (3-2, 4-4 and upwards), found by dynamic programming over the polygon's
diagonals (Klincsek 1980; Shewchuk 2002). An edge in a face of the box has an open polygon, closed by a segment in that
face. In 2-D the edge of two triangles is turned.

What a move is worth is measured for all cells at once, each writing only its own row. Moves are then made one after
the other, the most worth first, each only if no cell of its cavity has changed since; so the result does not depend on
the threads, and E falls by what was measured.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from tetopt.energy.sampling import few_threads
from tetopt.engine.complex import (
    Complex,
    Measure,
    cell_energy,
    cell_quality,
    corner_of,
    facet_of,
    grown,
    image_energy,
    least_cosine,
    load,
    outward,
    put_flux,
    shape_of_tet,
    shape_of_triangle,
    sum_up,
    tet_energy,
    tet_quality,
)

MOST = 7  # corners of the largest polygon around an edge that is triangulated anew
LEAST_GAIN = 1e-9  # of the cavity's energy: a smaller gain may be rounding
EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
CHUNK = 32


class Cavity(NamedTuple):
    """Room for one cavity at a time."""

    x: NDArray[np.float64]  # (4, 3) corners of a cell
    y: NDArray[np.float64]  # (MOST + 2, 3) corners of the cavity: of an edge a, b, then the polygon
    ring: NDArray[np.int64]  # (MOST,) the polygon's nodes
    around: NDArray[np.int64]  # (MOST,) the cells around the edge
    cost: NDArray[np.float64]  # (MOST, MOST) of the best triangulation between two corners
    apex: NDArray[np.int64]  # (MOST, MOST) the corner between them of its triangle
    triangle: NDArray[np.float64]  # (MOST, MOST, MOST) energy of the two cells over each triangle
    is_measured: NDArray[np.bool_]  # (MOST, MOST, MOST) whether the image is in it
    side_a: NDArray[np.float64]  # (MOST, MOST, D) fluxes of the facets (v_j, v_i, a)
    side_b: NDArray[np.float64]  # and (v_i, v_j, b)
    flux: NDArray[np.float64]  # (3, 1, D) of facets inside the cavity
    sums: NDArray[np.float64]  # (2, D) of two cells
    is_side: NDArray[np.bool_]  # (MOST, MOST) whether they are measured
    stack: NDArray[np.int64]  # (2 MOST, 3)
    new: NDArray[np.int64]  # (2 MOST,) the cells that will fill the cavity
    free: NDArray[np.int64]  # (1 + R,) how many cells were left over, and which


@njit(cache=True, error_model="numpy")
def cavity(n_free: int, D: int) -> Cavity:
    """Room for a cavity, and for the numbers of `n_free` cells left over; D numbers make a flux."""
    return Cavity(
        np.empty((4, 3)),
        np.empty((MOST + 2, 3)),
        np.empty(MOST, dtype=np.int64),
        np.empty(MOST, dtype=np.int64),
        np.empty((MOST, MOST)),
        np.empty((MOST, MOST), dtype=np.int64),
        np.empty((MOST, MOST, MOST)),
        np.empty((MOST, MOST, MOST), dtype=np.bool_),
        np.empty((MOST, MOST, D)),
        np.empty((MOST, MOST, D)),
        np.empty((3, 1, D)),
        np.empty((2, D)),
        np.empty((MOST, MOST), dtype=np.bool_),
        np.empty((2 * MOST, 3), dtype=np.int64),
        np.empty(2 * MOST, dtype=np.int64),
        np.zeros(1 + n_free, dtype=np.int64),
    )


def flip(
    held: Complex,
    measure: Measure,
    is_dirty: NDArray[np.bool_] | None = None,
    passes: int = 50,
    is_touched: NDArray[np.bool_] | None = None,
) -> tuple[Complex, int]:
    """Make every move that lowers E until none is left, or for some passes; the complex and the number of moves.

    Only cavities with one of the cells marked in `is_dirty` (C,) are looked at; all of them by default. Nodes of new
    cells are marked in `is_touched` (N,). The complex returned may be a wider copy of the one given, which is then out
    of date.
    """
    wanted = np.ones(int(held.n_cells[0]), dtype=np.bool_) if is_dirty is None else is_dirty
    is_dirty = np.zeros(len(held.cells), dtype=np.bool_)
    is_dirty[: len(wanted)] = wanted
    done = 0
    for _ in range(passes):
        if len(held.cells) - held.n_cells[0] < held.n_cells[0] // 8 + 32:
            held = grown(held)
            is_dirty = np.concatenate([is_dirty, np.zeros(len(held.cells) - len(is_dirty), dtype=np.bool_)])
        n_cells = int(held.n_cells[0])
        gain, move = np.zeros(n_cells), np.full(n_cells, -1, dtype=np.int64)
        _evaluate(gain, move, is_dirty, held, measure)
        order = np.flatnonzero(move >= 0)
        if len(order) == 0:
            break
        order = order[np.lexsort((order, -gain[order]))]
        is_dirty[:] = False
        made = make_moves(order, move, is_dirty, held, measure)
        done += made
        if made == 0:
            break
        if is_touched is not None:
            is_touched[held.cells[: held.n_cells[0]][is_dirty[: held.n_cells[0]]]] = True
    return held, done


def _evaluate(gain: NDArray, move: NDArray, is_dirty: NDArray, held: Complex, measure: Measure) -> None:
    """The move worth most of each cell, and its worth, to `move` (C,) and `gain` (C,)."""
    with few_threads(len(gain) * 4):
        kernel = _evaluate_triangles if held.cells.shape[1] == 3 else _evaluate_cells
        kernel(gain, move, is_dirty, held, measure)


# Both loops are in the parallel function itself: each level of calls is optimised again, 3 s of compiling.
@njit(cache=True, parallel=True, error_model="numpy")
def _evaluate_cells(gain: NDArray, move: NDArray, is_dirty: NDArray, held: Complex, measure: Measure) -> None:
    """Moves 0 to 3 flip that facet, 4 to 9 remove an edge of `EDGES`."""
    for chunk in prange((len(gain) + CHUNK - 1) // CHUNK):
        work = cavity(0, held.fluxes.shape[2])
        first: Any = np.int64(chunk) * CHUNK
        for cell in range(first, min(first + CHUNK, len(gain))):
            for k in range(4):
                other = held.across[cell, k]
                if other > cell and (is_dirty[cell] or is_dirty[other]):
                    worth = _worth_of_face(work, held, cell, k, measure)
                    if worth > gain[cell]:
                        gain[cell], move[cell] = worth, k
            for e in range(6):
                beyond, before = held.across[cell, EDGES[5 - e, 0]], held.across[cell, EDGES[5 - e, 1]]
                if 0 <= beyond < cell or 0 <= before < cell:
                    continue  # a lower cell has the edge too, and looks at it
                m, is_open = ring_of_edge(work.ring, work.around, held, cell, EDGES[e, 0], EDGES[e, 1], True)
                dirty = False
                for r in range(m - is_open):
                    dirty = dirty or is_dirty[work.around[r]]
                if not dirty:
                    continue
                a, b = held.cells[cell, EDGES[e, 0]], held.cells[cell, EDGES[e, 1]]
                worth = _worth_of_edge(work, held, a, b, m, is_open, measure)
                if worth > gain[cell]:
                    gain[cell], move[cell] = worth, 4 + e


@njit(cache=True, error_model="numpy")
def _worth_of_face(work: Cavity, held: Complex, cell: int, k: int, measure: Measure) -> float:
    """How much E falls if the facet's two cells become three; 0 or less, or -inf, if not."""
    x, y = work.x, work.y
    other = held.across[cell, k]
    u, v, w = outward(held.cells, cell, k)
    p, q = held.cells[cell, k], held.cells[other, facet_of(held.cells, held.across, other, cell)]
    load(y, 0, held.ticks, q, p, measure)
    load(y, 1, held.ticks, u, p, measure)
    load(y, 2, held.ticks, v, p, measure)
    load(y, 3, held.ticks, w, p, measure)
    # Six times the volumes of the three cells (p, q, a, b): most facets fail here, before any root is drawn.
    V_uv, V_vw, V_wu = _triple(y, 0, 1, 2), _triple(y, 0, 2, 3), _triple(y, 0, 3, 1)
    if V_uv <= 0.0 or V_vw <= 0.0 or V_wu <= 0.0:
        return -np.inf
    old = cell_energy(held, cell, measure) + cell_energy(held, other, measure)
    limit = old * (1.0 - LEAST_GAIN)
    new = 0.0
    for volume, a, b in ((V_uv, 1, 2), (V_vw, 2, 3), (V_wu, 3, 1)):
        new += measure.geometry * tet_energy(volume, _edge_squares(y, 0, a, b), measure.power, measure.is_graded)
        if not new < limit:
            return -np.inf
    if measure.floor > -1.0:
        least = min(measure.floor, cell_quality(x, held, cell, measure), cell_quality(x, held, other, measure))
        for a, b in ((u, v), (v, w), (w, u)):
            if tet_quality(x, held, p, q, a, b, measure) < least:
                return -np.inf
    if measure.image == 0.0:
        return old - new
    corner, spoke, sums = (u, v, w), work.flux, work.sums
    for r in range(3):
        put_flux(spoke, r, 0, held.ticks, p, q, corner[r], measure)
    for r in range(3):
        s, a = (r + 1) % 3, corner[(r + 2) % 3]  # a: the corner of the facet that is left out
        below, above = corner_of(held.cells, cell, a), corner_of(held.cells, other, a)
        for d in range(sums.shape[1]):
            sums[0, d] = (held.fluxes[cell, below, d] + held.fluxes[other, above, d]) + spoke[s, 0, d] - spoke[r, 0, d]
        new += measure.image * image_energy(sums, 0, measure.n_channels)
        if not new < limit:
            return -np.inf
    return old - new


@njit(cache=True, error_model="numpy", inline="always")
def _triple(y: NDArray, a: int, b: int, c: int) -> float:
    """Triple product of three rows."""
    return (
        y[a, 0] * (y[b, 1] * y[c, 2] - y[b, 2] * y[c, 1])
        + y[a, 1] * (y[b, 2] * y[c, 0] - y[b, 0] * y[c, 2])
        + y[a, 2] * (y[b, 0] * y[c, 1] - y[b, 1] * y[c, 0])
    )


@njit(cache=True, error_model="numpy", inline="always")
def _edge_squares(y: NDArray, a: int, b: int, c: int) -> float:
    """Sum of the six squared edges of the tetrahedron of the origin and three rows."""
    S = 0.0
    for d in range(3):
        total = y[a, d] + y[b, d] + y[c, d]
        S += 4.0 * (y[a, d] * y[a, d] + y[b, d] * y[b, d] + y[c, d] * y[c, d]) - total * total
    return S


@njit(cache=True, error_model="numpy")
def ring_of_edge(
    ring: NDArray, around: NDArray, held: Complex, cell: int, i: int, j: int, owned: bool = False
) -> tuple:
    """The cells around the edge of a cell between its corners i and j, and the polygon of their other corners.

    Turning from a to b to the right: cell r holds a, b, ring[r] and ring[r + 1]. Returns the polygon's number of
    corners, and 1 if it is open, that is if the edge is on the boundary; then there is one cell less than corners. The
    number is 0 if it would be more than `MOST` or, with `owned`, if `cell` is not the lowest of the cells.
    """
    a, b = held.cells[cell, i], held.cells[cell, j]
    # The other two corners, so that (a, b, v, w) is positively oriented.
    k, m = -1, -1
    for c in range(4):
        if c not in (i, j):
            if k < 0:
                k = c
            else:
                m = c
    parity = (i > j) ^ ((i + j) % 2 == 0)  # whether (i, j, k, m), k < m, is an odd permutation
    if parity:
        k, m = m, k
    v, w = held.cells[cell, k], held.cells[cell, m]
    # Backwards to the first cell, if the boundary is met.
    current, back = cell, v
    front = w
    steps = 0
    while True:
        before = held.across[current, corner_of(held.cells, current, front)]  # beyond the facet (a, b, back)
        if before < 0 or before == cell:
            break
        steps += 1
        if steps > MOST or (owned and before < cell):
            return 0, 0
        other = 0
        for c in range(4):
            node = held.cells[before, c]
            if node not in (a, b, back):
                other = node
        current, front, back = before, back, other
    is_open = 1 if held.across[current, corner_of(held.cells, current, front)] < 0 else 0
    if is_open == 0:
        current, back, front = cell, v, w
    first = current
    count = 0
    ring[0] = back
    while True:
        if count + 1 + is_open > MOST:
            return 0, 0
        around[count] = current
        count += 1
        after = held.across[current, corner_of(held.cells, current, back)]  # beyond the facet (a, b, front)
        if after < 0:
            ring[count] = front
            return count + 1, 1
        if after == first:
            return count, 0
        if count == MOST or (owned and after < cell):
            return 0, 0
        ring[count] = front
        other = 0
        for c in range(4):
            node = held.cells[after, c]
            if node not in (a, b, front):
                other = node
        current, back, front = after, front, other


@njit(cache=True, error_model="numpy")
def in_one_face(held: Complex, a: int, b: int, c: int, d: int, measure: Measure) -> bool:
    """Whether four boundary nodes have one index coordinate in common, so that they lie in one face of the box.

    Not if the boundary is to be kept: their facets are not to be exchanged then.
    """
    t = held.ticks
    for axis in range(3):
        at = t[a, axis]
        if not measure.is_kept and t[b, axis] == at and t[c, axis] == at and t[d, axis] == at:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _worth_of_edge(work: Cavity, held: Complex, a: int, b: int, m: int, is_open: int, measure: Measure) -> float:
    """How much E falls if the edge (a, b) is removed, -inf if it cannot be; `work.apex` then holds the diagonals.

    `ring_of_edge` has filled `work.ring` and `work.around`. apex[i, j] is the corner between i and j of the triangle on
    the diagonal (i, j), of the best triangulation.
    """
    y, ring, around = work.y, work.ring, work.around
    cost, apex, triangle = work.cost, work.apex, work.triangle
    if m < 3 or (is_open == 1 and not in_one_face(held, a, b, ring[0], ring[m - 1], measure)):
        return -np.inf
    old = 0.0
    for r in range(m - is_open):
        old += cell_energy(held, around[r], measure)
    limit = old * (1.0 - LEAST_GAIN)
    for d in range(3):
        y[0, d] = 0.0
    load(y, 1, held.ticks, b, a, measure)
    for r in range(m):
        load(y, 2 + r, held.ticks, ring[r], a, measure)
    # A triangulation's shape energy alone is a lower bound, and cheap; so are its two ears, triangles of three corners
    # in a row: few edges get past them.
    if m > 4:
        low, lower = np.inf, np.inf  # the two cheapest ears
        for k in range(m):
            i, j = (k - 1) % m, (k + 1) % m
            ear = _pair_shape(y, 2 + i, 2 + k, 2 + j, limit, measure)
            if ear < lower:
                low, lower = lower, ear
            elif ear < low:
                low = ear
        if not low + lower < limit:
            return -np.inf
    for i in range(m - 2):
        for k in range(i + 1, m - 1):
            for j in range(k + 1, m):
                triangle[i, k, j] = _pair_shape(y, 2 + i, 2 + k, 2 + j, limit, measure)
    if not best_triangulation(cost, apex, triangle, m) < limit:
        return -np.inf
    # The floor last: it is asked of few edges, and its angles cost more than energies (half of a pass, when first).
    if measure.floor > -1.0:
        least = measure.floor
        for r in range(m - is_open):
            least = min(least, cell_quality(work.x, held, around[r], measure))
        for i in range(m - 2):
            for k in range(i + 1, m - 1):
                for j in range(k + 1, m):
                    if triangle[i, k, j] < limit and _pair_quality(work.x, y, 2 + i, 2 + k, 2 + j) < least:
                        triangle[i, k, j] = np.inf
        if not best_triangulation(cost, apex, triangle, m) < limit:
            return -np.inf
    if measure.image == 0.0:
        return old - cost[0, m - 1]
    # Then the image, only for the triangles of the best triangulation, until it is the best with it: a triangle that
    # is not measured has its least possible energy, so no better triangulation is passed over.
    work.is_measured[:] = False
    work.is_side[:] = False
    while _measure_triangles(work, held, a, b, m, is_open, measure):
        if not best_triangulation(cost, apex, triangle, m) < limit:
            return -np.inf
    return old - cost[0, m - 1]


@njit(cache=True, error_model="numpy")
def _measure_triangles(work: Cavity, held: Complex, a: int, b: int, m: int, is_open: int, measure: Measure) -> bool:
    """Add their image energy to the triangles of the triangulation in `apex`; whether one had not had it."""
    stack, side_a, side_b, ring = work.stack, work.side_a, work.side_b, work.ring
    stack[0, 0], stack[0, 1] = 0, m - 1
    height = 1
    found = False
    while height > 0:
        height -= 1
        i, j = stack[height, 0], stack[height, 1]
        if j == i + 1:
            continue
        k = work.apex[i, j]
        stack[height, 0], stack[height, 1] = i, k
        stack[height + 1, 0], stack[height + 1, 1] = k, j
        height += 2
        if work.is_measured[i, k, j]:
            continue
        found = work.is_measured[i, k, j] = True
        for p, q in ((i, k), (k, j), (i, j)):
            fill_side(work, held, a, b, p, q, m, is_open, measure)
        put_flux(work.flux, 0, 0, held.ticks, ring[i], ring[k], ring[j], measure)
        for d in range(work.sums.shape[1]):
            u = work.flux[0, 0, d]
            work.sums[0, d] = side_b[i, k, d] + side_b[k, j, d] - side_b[i, j, d] - u
            work.sums[1, d] = side_a[i, k, d] + side_a[k, j, d] - side_a[i, j, d] + u
        work.triangle[i, k, j] += measure.image * (
            image_energy(work.sums, 0, measure.n_channels) + image_energy(work.sums, 1, measure.n_channels)
        )
    return found


@njit(cache=True, error_model="numpy")
def _pair_shape(y: NDArray, i: int, k: int, j: int, limit: float, measure: Measure) -> float:
    """Weighted shape energy of the tetrahedra (i, k, j, b) and (i, j, k, a) over a triangle of the polygon.

    Rows of `y`: a, b, then the polygon's corners. Infinite if one is inverted or flat or has more than `limit`.
    """
    u0, u1, u2 = y[k, 0] - y[i, 0], y[k, 1] - y[i, 1], y[k, 2] - y[i, 2]
    v0, v1, v2 = y[j, 0] - y[i, 0], y[j, 1] - y[i, 1], y[j, 2] - y[i, 2]
    n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    b0, b1, b2 = y[1, 0] - y[i, 0], y[1, 1] - y[i, 1], y[1, 2] - y[i, 2]
    above = n0 * b0 + n1 * b1 + n2 * b2
    a0, a1, a2 = y[0, 0] - y[i, 0], y[0, 1] - y[i, 1], y[0, 2] - y[i, 2]
    below = -(n0 * a0 + n1 * a1 + n2 * a2)
    if above <= 0.0 or below <= 0.0:
        return np.inf
    base = u0 * u0 + u1 * u1 + u2 * u2 + v0 * v0 + v1 * v1 + v2 * v2
    s0, s1, s2 = u0 + v0, u1 + v1, u2 + v2
    S = 4.0 * (base + b0 * b0 + b1 * b1 + b2 * b2) - ((s0 + b0) ** 2 + (s1 + b1) ** 2 + (s2 + b2) ** 2)
    energy = measure.geometry * tet_energy(above, S, measure.power, measure.is_graded)
    if not energy < limit:
        return np.inf
    S = 4.0 * (base + a0 * a0 + a1 * a1 + a2 * a2) - ((s0 + a0) ** 2 + (s1 + a1) ** 2 + (s2 + a2) ** 2)
    energy += measure.geometry * tet_energy(below, S, measure.power, measure.is_graded)
    if not energy < limit:
        return np.inf
    return energy


@njit(cache=True, error_model="numpy")
def _pair_quality(x: NDArray, y: NDArray, i: int, k: int, j: int) -> float:
    """`least_cosine` of the worse of the same two tetrahedra."""
    for d in range(3):
        x[0, d], x[1, d], x[2, d], x[3, d] = y[i, d], y[k, d], y[j, d], y[1, d]
    above = least_cosine(x)
    for d in range(3):
        x[1, d], x[2, d], x[3, d] = y[j, d], y[k, d], y[0, d]
    return min(above, least_cosine(x))


@njit(cache=True, error_model="numpy")
def best_triangulation(cost: NDArray, apex: NDArray, triangle: NDArray, m: int) -> float:
    """Least sum of `triangle[i, k, j]` over the triangulations of a polygon of m corners; `apex` is filled."""
    for i in range(m - 1):
        cost[i, i + 1] = 0.0
    for length in range(2, m):
        for i in range(m - length):
            j = i + length
            cost[i, j] = np.inf
            apex[i, j] = -1
            for k in range(i + 1, j):
                total = cost[i, k] + cost[k, j] + triangle[i, k, j]
                if total < cost[i, j]:
                    cost[i, j] = total
                    apex[i, j] = k
    return cost[0, m - 1]


@njit(cache=True, error_model="numpy")
def fill_side(
    work: Cavity, held: Complex, a: int, b: int, i: int, j: int, m: int, is_open: int, measure: Measure
) -> None:
    """Fluxes of the facets (v_i, v_j, b) and (v_j, v_i, a), unless known: on the polygon's sides the old cells'."""
    if work.is_side[i, j]:
        return
    work.is_side[i, j] = True
    if j == i + 1 or (i == 0 and j == m - 1 and is_open == 0):
        r, sign = (i, 1.0) if j == i + 1 else (m - 1, -1.0)
        cell = work.around[r]
        for d in range(held.fluxes.shape[2]):
            work.side_b[i, j, d] = sign * held.fluxes[cell, corner_of(held.cells, cell, a), d]
            work.side_a[i, j, d] = sign * held.fluxes[cell, corner_of(held.cells, cell, b), d]
        return
    for which in range(2):  # one place where the flux is measured: half the code to compile
        p, q, end = (work.ring[i], work.ring[j], b) if which == 0 else (work.ring[j], work.ring[i], a)
        side = work.side_b if which == 0 else work.side_a
        put_flux(side, i, j, held.ticks, p, q, end, measure)


@njit(cache=True, error_model="numpy")
def make_moves(order: NDArray, move: NDArray, is_dirty: NDArray, held: Complex, measure: Measure) -> int:
    """Make the moves of the cells in `order` whose cavities are as they were; the number made.

    Cells of a cavity that changed are marked dirty, and those left over are taken out at the end.
    """
    room = len(held.cells)
    work = cavity(room, held.fluxes.shape[2])
    made = 0
    for number in range(len(order)):
        cell = order[number]
        if is_dirty[cell] or held.n_cells[0] + 2 * MOST > room:
            continue
        if held.cells.shape[1] == 3:
            other = held.across[cell, move[cell]]
            if not is_dirty[other]:
                _turn_edge(held, cell, move[cell], measure)
                is_dirty[cell] = is_dirty[other] = True
                made += 1
            continue
        if move[cell] < 4:
            if is_dirty[held.across[cell, move[cell]]]:
                continue
            flip_face(work, held, cell, move[cell], is_dirty, measure)
        else:
            i, j = EDGES[move[cell] - 4]
            m, is_open = ring_of_edge(work.ring, work.around, held, cell, i, j)
            clean = m > 0
            for r in range(m - is_open):
                clean = clean and not is_dirty[work.around[r]]
            if not clean:
                continue
            a, b = held.cells[cell, i], held.cells[cell, j]
            _worth_of_edge(work, held, a, b, m, is_open, measure)
            remove_edge(work, held, a, b, m, is_open, is_dirty, measure)
        made += 1
    close_gaps(held, is_dirty)
    return made


@njit(cache=True, error_model="numpy")
def take_cells(work: Cavity, held: Complex, n_old: int, n_new: int, is_dirty: NDArray) -> None:
    """Numbers of the cells that fill a cavity, to `work.new`: first those that it had, `n_old` in `work.around`.

    Further ones are of cells left over before, or from the end; those left over now are marked by a corner of -1. All
    are marked dirty.
    """
    for r in range(max(n_old, n_new)):
        if r < n_old:
            cell = work.around[r]
            if r >= n_new:
                held.cells[cell, 0] = -1
                work.free[0] += 1
                work.free[work.free[0]] = cell
        elif work.free[0] > 0:
            cell = work.free[work.free[0]]
            work.free[0] -= 1
        else:
            cell = held.n_cells[0]
            held.n_cells[0] += 1
        if r < n_new:
            work.new[r] = cell
        is_dirty[cell] = True


@njit(cache=True, error_model="numpy")
def _finish(held: Complex, cell: int, measure: Measure, x: NDArray) -> None:
    """Sums and shape of a cell whose corners and fluxes are set."""
    c = held.cells[cell]
    held.E_shape[cell] = shape_of_tet(x, held.ticks, c[0], c[1], c[2], c[3], measure)
    sum_up(held.sums, held.fluxes, cell)


@njit(cache=True, error_model="numpy")
def flip_face(work: Cavity, held: Complex, cell: int, k: int, is_dirty: NDArray, measure: Measure) -> None:
    """Two cells become three around the edge (p, q) of the corners across their facet (u, v, w)."""
    other = held.across[cell, k]
    u, v, w = outward(held.cells, cell, k)
    p, q = held.cells[cell, k], held.cells[other, facet_of(held.cells, held.across, other, cell)]
    corner, D = np.array([u, v, w]), held.fluxes.shape[2]
    below, above = np.empty((3, D)), np.empty((3, D))  # fluxes of the facets opposite u, v, w
    under, over = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)  # the cells beyond them
    for r in range(3):
        i, j = corner_of(held.cells, cell, corner[r]), corner_of(held.cells, other, corner[r])
        under[r], over[r] = held.across[cell, i], held.across[other, j]
        below[r], above[r] = held.fluxes[cell, i], held.fluxes[other, j]
    work.around[0], work.around[1] = cell, other
    take_cells(work, held, 2, 3, is_dirty)
    new = work.new
    spoke = work.flux
    spoke[:] = 0.0
    if measure.image > 0.0:
        for r in range(3):
            put_flux(spoke, r, 0, held.ticks, p, q, corner[r], measure)
    # The facets of the neighbours that lead here, before anything is overwritten.
    under_k, over_k = np.full(3, -1, dtype=np.int64), np.full(3, -1, dtype=np.int64)
    for r in range(3):
        if under[r] >= 0:
            under_k[r] = facet_of(held.cells, held.across, under[r], cell)
        if over[r] >= 0:
            over_k[r] = facet_of(held.cells, held.across, over[r], other)
    for r in range(3):  # cell r: (p, q, corner r, corner r + 1), opposite corner r + 2
        s, t = (r + 1) % 3, (r + 2) % 3
        c = new[r]
        held.cells[c, 0], held.cells[c, 1], held.cells[c, 2], held.cells[c, 3] = p, q, corner[r], corner[s]
        held.across[c, 0], held.across[c, 1], held.across[c, 2], held.across[c, 3] = over[t], under[t], new[s], new[t]
        for d in range(D):
            held.fluxes[c, 0, d], held.fluxes[c, 1, d] = above[t, d], below[t, d]
            held.fluxes[c, 2, d], held.fluxes[c, 3, d] = spoke[s, 0, d], -spoke[r, 0, d]
        if over[t] >= 0:
            held.across[over[t], over_k[t]] = c
        if under[t] >= 0:
            held.across[under[t], under_k[t]] = c
        _finish(held, c, measure, work.x)


@njit(cache=True, error_model="numpy")
def remove_edge(
    work: Cavity, held: Complex, a: int, b: int, m: int, is_open: int, is_dirty: NDArray, measure: Measure
) -> None:
    """The cells around (a, b) become pairs over the triangles of the polygon in `work.apex`; see `_worth_of_edge`.

    The sides of its triangles have their fluxes, if the image counts.
    Over the triangle (i, k, j), i < k < j: (v_i, v_k, v_j, b) and (v_i, v_j, v_k, a).
    """
    side_a, side_b, ring, around = work.side_a, work.side_b, work.ring, work.around
    apex, new = work.apex, work.new
    # What lies beyond the polygon's sides, and by which facet it leads here.
    beyond_a, beyond_b = np.full((m, 2), -1, dtype=np.int64), np.full((m, 2), -1, dtype=np.int64)
    for r in range(m - is_open):
        cell = around[r]
        for which in range(2):
            k = corner_of(held.cells, cell, b if which == 0 else a)
            other = held.across[cell, k]
            if other >= 0:
                facet = facet_of(held.cells, held.across, other, cell)
                if which == 0:
                    beyond_a[r, 0], beyond_a[r, 1] = other, facet
                else:
                    beyond_b[r, 0], beyond_b[r, 1] = other, facet
    take_cells(work, held, m - is_open, 2 * (m - 2), is_dirty)
    # The triangle under each diagonal (i, j), numbered; its two cells are new[2 t] and new[2 t + 1].
    stack = work.stack  # of i, j and (triangle above) * 4 + its facet towards this one
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, m - 1, -1
    height, count = 1, 0
    while height > 0:
        height -= 1
        i, j, up = stack[height]
        if j == i + 1:
            continue
        k = apex[i, j]
        t = count
        count += 1
        top, low = new[2 * t], new[2 * t + 1]  # of b, of a
        held.cells[top, 0], held.cells[top, 1], held.cells[top, 2], held.cells[top, 3] = ring[i], ring[k], ring[j], b
        held.cells[low, 0], held.cells[low, 1], held.cells[low, 2], held.cells[low, 3] = ring[i], ring[j], ring[k], a
        held.across[top, 3], held.across[low, 3] = low, top
        work.flux[0] = 0.0
        if measure.image > 0.0:
            put_flux(work.flux, 0, 0, held.ticks, ring[i], ring[k], ring[j], measure)
        for d in range(held.fluxes.shape[2]):
            held.fluxes[top, 3, d], held.fluxes[low, 3, d] = -work.flux[0, 0, d], work.flux[0, 0, d]
            if measure.image > 0.0:
                held.fluxes[top, 0, d], held.fluxes[low, 0, d] = side_b[k, j, d], side_a[k, j, d]
                held.fluxes[top, 2, d], held.fluxes[low, 1, d] = side_b[i, k, d], side_a[i, k, d]
                held.fluxes[top, 1, d], held.fluxes[low, 2, d] = -side_b[i, j, d], -side_a[i, j, d]
        # The side (i, j): the triangle above, or beyond the closing side of the polygon.
        if up >= 0:
            held.across[top, 1], held.across[low, 2] = new[2 * (up // 4)], new[2 * (up // 4) + 1]
        elif is_open == 1:
            held.across[top, 1] = held.across[low, 2] = -1
        else:
            held.across[top, 1], held.across[low, 2] = beyond_b[m - 1, 0], beyond_a[m - 1, 0]
            if beyond_b[m - 1, 0] >= 0:
                held.across[beyond_b[m - 1, 0], beyond_b[m - 1, 1]] = top
            if beyond_a[m - 1, 0] >= 0:
                held.across[beyond_a[m - 1, 0], beyond_a[m - 1, 1]] = low
        if up >= 0:  # and back: the facet of the cells above that this one lies beyond
            facet = up % 4
            held.across[new[2 * (up // 4)], facet] = top
            held.across[new[2 * (up // 4) + 1], 0 if facet == 0 else 1] = low
        # The sides (i, k) and (k, j): a side of the polygon, or a diagonal still to come.
        for which in range(2):
            p, q = (i, k) if which == 0 else (k, j)
            facet_top, facet_low = (2, 1) if which == 0 else (0, 0)
            if q == p + 1:
                held.across[top, facet_top], held.across[low, facet_low] = beyond_b[p, 0], beyond_a[p, 0]
                if beyond_b[p, 0] >= 0:
                    held.across[beyond_b[p, 0], beyond_b[p, 1]] = top
                if beyond_a[p, 0] >= 0:
                    held.across[beyond_a[p, 0], beyond_a[p, 1]] = low
            else:
                stack[height, 0], stack[height, 1], stack[height, 2] = p, q, 4 * t + facet_top
                height += 1
    for r in range(2 * count):
        _finish(held, new[r], measure, work.x)


@njit(cache=True, error_model="numpy")
def close_gaps(held: Complex, is_dirty: NDArray) -> None:
    """Move the last cells into the places of those that were taken out."""
    n = held.cells.shape[1]
    last = held.n_cells[0] - 1
    cell = 0
    while cell <= last:
        if held.cells[cell, 0] >= 0:
            cell += 1
            continue
        while last > cell and held.cells[last, 0] < 0:
            last -= 1
        if last == cell:
            last -= 1
            break
        held.cells[cell] = held.cells[last]
        held.across[cell] = held.across[last]
        held.fluxes[cell] = held.fluxes[last]
        held.sums[cell] = held.sums[last]
        held.E_shape[cell] = held.E_shape[last]
        is_dirty[cell] = is_dirty[last]
        for k in range(n):
            other = held.across[cell, k]
            if other >= 0:
                held.across[other, facet_of(held.cells, held.across, other, last)] = cell
        held.cells[last, 0] = -1
        last -= 1
    held.n_cells[0] = last + 1


# Triangles.


@njit(cache=True, parallel=True, error_model="numpy")
def _evaluate_triangles(gain: NDArray, move: NDArray, is_dirty: NDArray, held: Complex, measure: Measure) -> None:
    """Moves 0 to 2 turn that edge."""
    for chunk in prange((len(gain) + CHUNK - 1) // CHUNK):
        x, sums = np.empty((4, 3)), np.empty((2, held.sums.shape[1]))
        first: Any = np.int64(chunk) * CHUNK
        for cell in range(first, min(first + CHUNK, len(gain))):
            for k in range(3):
                other = held.across[cell, k]
                if other > cell and (is_dirty[cell] or is_dirty[other]):
                    worth = _worth_of_turn(x, sums, held, cell, k, measure)
                    if worth > gain[cell]:
                        gain[cell], move[cell] = worth, k


@njit(cache=True, error_model="numpy")
def _worth_of_turn(x: NDArray, sums: NDArray, held: Complex, cell: int, k: int, measure: Measure) -> float:
    """How much E falls if the edge (u, v) between two triangles is turned to (p, q); -inf if it cannot be."""
    other = held.across[cell, k]
    m = facet_of(held.cells, held.across, other, cell)
    p, q = held.cells[cell, k], held.cells[other, m]
    u, v = held.cells[cell, (k + 1) % 3], held.cells[cell, (k + 2) % 3]
    old = cell_energy(held, cell, measure) + cell_energy(held, other, measure)
    limit = old * (1.0 - LEAST_GAIN)
    new = measure.geometry * shape_of_triangle(x, held.ticks, p, u, q, measure)
    if new < limit:
        new += measure.geometry * shape_of_triangle(x, held.ticks, p, q, v, measure)
    if not new < limit:
        return -np.inf
    if measure.image > 0.0:
        flux = np.empty((1, 1, sums.shape[1]))
        put_flux(flux, 0, 0, held.ticks, p, q, -1, measure)
        for d in range(sums.shape[1]):  # over the edges (p, u), (u, q), and (q, v), (v, p)
            sums[0, d] = held.fluxes[cell, (k + 2) % 3, d] + held.fluxes[other, (m + 1) % 3, d] - flux[0, 0, d]
            sums[1, d] = held.fluxes[other, (m + 2) % 3, d] + held.fluxes[cell, (k + 1) % 3, d] + flux[0, 0, d]
        new += measure.image * (image_energy(sums, 0, measure.n_channels) + image_energy(sums, 1, measure.n_channels))
    return old - new if new < limit else -np.inf


@njit(cache=True, error_model="numpy")
def _turn_edge(held: Complex, cell: int, k: int, measure: Measure) -> None:
    """Triangles (p, u, v) and (q, v, u) become (p, u, q) and (p, q, v)."""
    other = held.across[cell, k]
    m = facet_of(held.cells, held.across, other, cell)
    p, q = held.cells[cell, k], held.cells[other, m]
    u, v = held.cells[cell, (k + 1) % 3], held.cells[cell, (k + 2) % 3]
    # Facets by their edge: (p, u), (u, q), (q, v), (v, p), and the cells beyond.
    at_pu, at_uq, at_qv, at_vp = (k + 2) % 3, (m + 1) % 3, (m + 2) % 3, (k + 1) % 3
    f_pu, f_vp = held.fluxes[cell, at_pu].copy(), held.fluxes[cell, at_vp].copy()
    f_uq, f_qv = held.fluxes[other, at_uq].copy(), held.fluxes[other, at_qv].copy()
    n_pu, n_vp = held.across[cell, at_pu], held.across[cell, at_vp]
    n_uq, n_qv = held.across[other, at_uq], held.across[other, at_qv]
    if n_uq >= 0:
        held.across[n_uq, facet_of(held.cells, held.across, n_uq, other)] = cell
    if n_vp >= 0:
        held.across[n_vp, facet_of(held.cells, held.across, n_vp, cell)] = other
    f = np.zeros((1, 1, held.fluxes.shape[2]))
    if measure.image > 0.0:
        put_flux(f, 0, 0, held.ticks, p, q, -1, measure)
    held.cells[cell, 0], held.cells[cell, 1], held.cells[cell, 2] = p, u, q
    held.cells[other, 0], held.cells[other, 1], held.cells[other, 2] = p, q, v
    held.across[cell, 0], held.across[cell, 1], held.across[cell, 2] = n_uq, other, n_pu
    held.across[other, 0], held.across[other, 1], held.across[other, 2] = n_qv, n_vp, cell
    for d in range(held.fluxes.shape[2]):
        held.fluxes[cell, 0, d], held.fluxes[cell, 1, d], held.fluxes[cell, 2, d] = f_uq[d], -f[0, 0, d], f_pu[d]
        held.fluxes[other, 0, d], held.fluxes[other, 1, d], held.fluxes[other, 2, d] = f_qv[d], f_vp[d], f[0, 0, d]
    x = np.empty((4, 3))
    for c in (cell, other):
        held.E_shape[c] = shape_of_triangle(
            x, held.ticks, held.cells[c, 0], held.cells[c, 1], held.cells[c, 2], measure
        )
        sum_up(held.sums, held.fluxes, c)
