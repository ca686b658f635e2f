"""Exchange cells for others in the same cavity where that lowers the combined energy.

"Accept a tessellation only if it decreases the energy" (Section 4 of the paper), cell by cell. Two
moves reach every tetrahedralization of a small cavity: the face flip, which replaces the two
tetrahedra of a facet by three around a new edge (2-3), and the removal of an edge, which replaces
the m tetrahedra around it by the 2 (m - 2) of the best triangulation of their polygon (3-2, 4-4 and
higher), found by dynamic programming over the polygon's diagonals (Klincsek 1980; Shewchuk 2002).
An edge in a face of the box has an open polygon, closed by a segment in that face. In 2-D the edge
between two triangles is flipped.

Gains of moves are measured for all cells in parallel, each writing only its own row. Moves are then
made one after the other, the largest gain first, each only if no cell of its cavity has changed, so
that the result does not depend on the threads, and E falls by the measured gain.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from tetopt.energy.sampling import CELLS_PER_CHUNK
from tetopt.engine.complex import (
    Objective,
    State,
    cell_cosine,
    cell_energy,
    corner_of,
    facet_of,
    grow_state,
    image_energy,
    is_interface,
    load,
    outward,
    put_flux,
    settle,
    shape_of_triangle,
    tet_cosine,
    tet_energy,
    worst_cosine,
)
from tetopt.geometry.vectors import cross, difference, dot, row
from tetopt.system.arrays import Bools
from tetopt.system.kernels import (
    Bools1,
    Bools2,
    Bools3,
    Floats1,
    Floats2,
    Floats3,
    Ints1,
    Ints2,
    entry,
    helper,
    inlined,
    own,
    run,
    unit,
)

POLYGON_CORNERS = 7  # corners of the largest polygon around an edge to be triangulated
LEAST_FLIP_FRACTION = 1e-9  # of the cavity's energy: a smaller gain may be rounding
TET_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])  # between corners of a cell


class Cavity(NamedTuple):
    """Work space for one cavity."""

    x: Floats2  # (4, 3) corners of a cell
    # (POLYGON_CORNERS + 2, 3) corners of the cavity: the edge's a and b, then the polygon
    y: Floats2
    ring: Ints1  # (POLYGON_CORNERS,) the polygon's nodes
    around: Ints1  # (POLYGON_CORNERS,) the cells around the edge
    # (POLYGON_CORNERS, POLYGON_CORNERS) cost of the best triangulation between two corners
    cost: Floats2
    apex: Ints2  # (POLYGON_CORNERS, POLYGON_CORNERS) third corner of its triangle on them
    # (POLYGON_CORNERS, POLYGON_CORNERS, POLYGON_CORNERS) energy of the two cells over each triangle
    triangle: Floats3
    # (POLYGON_CORNERS, POLYGON_CORNERS, POLYGON_CORNERS) True if it includes the image
    is_measured: Bools3
    side_a: Floats3  # (POLYGON_CORNERS, POLYGON_CORNERS, D) fluxes of the facets (v_j, v_i, a)
    side_b: Floats3  # and (v_i, v_j, b)
    flux: Floats3  # (3, 1, D) fluxes of facets inside the cavity
    sums: Floats2  # (2, D) sums of two cells
    is_side: Bools2  # (POLYGON_CORNERS, POLYGON_CORNERS) True if these are measured
    stack: Ints2  # (2 POLYGON_CORNERS, 3)
    new: Ints1  # (2 POLYGON_CORNERS,) the cells that will fill the cavity
    free: Ints1  # (1 + R,) the number of unused cells, and these
    # (1,) number of leading cells with the first label; 0 if all around the edge have one label
    arc: Ints1


def cavity(n_free: int, D: int) -> Cavity:
    """Allocate a cavity, and space for the numbers of `n_free` unused cells; a flux has D
    numbers.
    """
    return Cavity(
        np.empty((4, 3)),
        np.empty((POLYGON_CORNERS + 2, 3)),
        np.empty(POLYGON_CORNERS, dtype=np.int64),
        np.empty(POLYGON_CORNERS, dtype=np.int64),
        np.empty((POLYGON_CORNERS, POLYGON_CORNERS)),
        np.empty((POLYGON_CORNERS, POLYGON_CORNERS), dtype=np.int64),
        np.empty((POLYGON_CORNERS, POLYGON_CORNERS, POLYGON_CORNERS)),
        np.empty((POLYGON_CORNERS, POLYGON_CORNERS, POLYGON_CORNERS), dtype=np.bool_),
        np.empty((POLYGON_CORNERS, POLYGON_CORNERS, D)),
        np.empty((POLYGON_CORNERS, POLYGON_CORNERS, D)),
        np.empty((3, 1, D)),
        np.empty((2, D)),
        np.empty((POLYGON_CORNERS, POLYGON_CORNERS), dtype=np.bool_),
        np.empty((2 * POLYGON_CORNERS, 3), dtype=np.int64),
        np.empty(2 * POLYGON_CORNERS, dtype=np.int64),
        np.zeros(1 + n_free, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
    )


def flip(
    state: State,
    is_dirty: Bools | None = None,
    passes: int = 50,
    is_touched: Bools | None = None,
) -> tuple[State, int]:
    """Make every move that lowers E until none remains, or for some passes; return the state and
    the number of moves.

    Only cavities with a cell marked in `is_dirty` (C,) are evaluated, by default all. Nodes of new
    cells are marked in `is_touched` (N,). The complex of the returned state may be a larger copy of
    the previous one, which is then out of date.
    """
    n_cells = int(state.complex.n_cells[0])
    dirty = np.zeros(len(state.complex.cells), dtype=np.bool_)
    dirty[:n_cells] = True if is_dirty is None else is_dirty
    n_moves = 0
    for _ in range(passes):
        if len(dirty) - n_cells < n_cells // 8 + 32:
            state = grow_state(state)
            dirty = np.concatenate(
                [dirty, np.zeros(len(state.complex.cells) - len(dirty), dtype=np.bool_)]
            )
        near = np.flatnonzero(dirty[:n_cells])
        gain, move = np.zeros(n_cells), np.full(n_cells, -1, dtype=np.int64)
        _evaluate(gain, move, near, dirty, state)
        order = near[move[near] >= 0]
        order = order[np.lexsort((order, -gain[order]))]
        dirty[near] = False
        work = cavity(len(state.complex.cells), state.complex.fluxes.shape[2])
        n_made = make_moves(order, move, dirty, state, work)
        if n_made == 0:
            break
        n_moves += n_made
        n_cells = int(state.complex.n_cells[0])
        if is_touched is not None:
            is_touched[state.complex.cells[:n_cells][dirty[:n_cells]]] = True
    return state, n_moves


def _evaluate(gain: NDArray, move: NDArray, near: NDArray, is_dirty: NDArray, state: State) -> None:
    """Write the best move of each of the cells `near`, those marked dirty, and its gain to `move`
    and `gain` (C,).

    The lowest dirty cell of each facet and edge evaluates it.
    """
    task = _evaluate_triangles if state.complex.cells.shape[1] == 3 else _evaluate_cells
    rooms = [cavity(0, state.complex.fluxes.shape[2]) for _ in range(get_num_threads())]
    work = Evaluation(gain, move, near, is_dirty, state, rooms)
    run(task, -(-len(near) // CELLS_PER_CHUNK), work, len(near) * 4)


class Evaluation(NamedTuple):
    """Inputs and outputs of the search for moves."""

    gain: Floats1  # (C,) gain of each cell's best move
    move: Ints1  # (C,) which
    near: Ints1  # the cells marked in `is_dirty`
    is_dirty: Bools1  # (C,) only cavities with one of these are evaluated
    state: State
    rooms: list[Cavity]  # one for each thread


@unit
def _evaluate_cells(search: Evaluation, chunk: int) -> None:
    """Evaluate moves: 0 to 3 flip that facet, 4 to 9 remove an edge of `TET_EDGES`."""
    gain, move, near, is_dirty, state = (
        search.gain,
        search.move,
        search.near,
        search.is_dirty,
        search.state,
    )
    work, complex_ = own(search.rooms), state.complex
    first = chunk * CELLS_PER_CHUNK
    for number in range(first, min(first + CELLS_PER_CHUNK, len(near))):
        cell = near[number]
        for k in range(4):
            other = complex_.across[cell, k]
            is_others = 0 <= other < cell and is_dirty[other]  # the cell beyond evaluates the facet
            if other >= 0 and not is_others and not is_interface(complex_, cell, k):
                worth = _worth_of_face(work, state, cell, k)
                if worth > gain[cell]:
                    gain[cell], move[cell] = worth, k
        for e in range(6):
            # the other two corners, opposite the edge's two facets
            i, j = TET_EDGES[5 - e, 0], TET_EDGES[5 - e, 1]
            one, other = complex_.across[cell, i], complex_.across[cell, j]
            if (0 <= one < cell and is_dirty[one]) or (0 <= other < cell and is_dirty[other]):
                continue  # a lower cell has the edge, too, and evaluates it
            i, j = TET_EDGES[e, 0], TET_EDGES[e, 1]
            m, is_open = ring_of_edge(
                work.ring, work.around, complex_.cells, complex_.across, cell, i, j, is_dirty
            )
            if m == 0:
                continue
            worth = _worth_of_edge(
                work, state, complex_.cells[cell, i], complex_.cells[cell, j], m, is_open
            )
            if worth > gain[cell]:
                gain[cell], move[cell] = worth, 4 + e


@unit
def _worth_of_face(work: Cavity, state: State, cell: int, k: int) -> float:
    """Reduction of E if the facet's two cells become three; 0 or less, or -inf, if it does not
    fall.
    """
    x, y = work.x, work.y
    other = state.complex.across[cell, k]
    u, v, w = outward(state.complex.cells, cell, k)
    p, q = (
        state.complex.cells[cell, k],
        state.complex.cells[other, facet_of(state.complex.across, other, cell)],
    )
    load(y, 0, state.complex.ticks, q, p, state.objective)
    load(y, 1, state.complex.ticks, u, p, state.objective)
    load(y, 2, state.complex.ticks, v, p, state.objective)
    load(y, 3, state.complex.ticks, w, p, state.objective)
    # Six times the volumes of the three cells (p, q, a, b): most facets fail here, before any root
    # is computed.
    at_q, at_u, at_v, at_w = row(y, 0), row(y, 1), row(y, 2), row(y, 3)
    V_uv, V_vw, V_wu = (
        dot(at_q, cross(at_u, at_v)),
        dot(at_q, cross(at_v, at_w)),
        dot(at_q, cross(at_w, at_u)),
    )
    if V_uv <= 0.0 or V_vw <= 0.0 or V_wu <= 0.0:
        return -np.inf
    old = cell_energy(state, cell) + cell_energy(state, other)
    limit = old * (1.0 - LEAST_FLIP_FRACTION)
    new = 0.0
    for volume, a, b in ((V_uv, 1, 2), (V_vw, 2, 3), (V_wu, 3, 1)):
        new += state.objective.geometry * tet_energy(
            volume, _squares_by_axis(y, 0, a, b), state.objective.power, state.objective.is_graded
        )
        if not new < limit:
            return -np.inf
    if state.objective.angle_limit > -1.0:
        least = min(
            state.objective.angle_limit, cell_cosine(x, state, cell), cell_cosine(x, state, other)
        )
        for a, b in ((u, v), (v, w), (w, u)):
            if tet_cosine(x, state, p, q, a, b) < least:
                return -np.inf
    if state.objective.image == 0.0:
        return old - new
    corner, spoke, sums = (u, v, w), work.flux, work.sums
    for r in range(3):
        put_flux(spoke, r, 0, state.complex.ticks, p, q, corner[r], state.objective)
    for r in range(3):
        s, a = (r + 1) % 3, corner[(r + 2) % 3]  # a: the remaining corner of the facet
        below, above = (
            corner_of(state.complex.cells, cell, a),
            corner_of(state.complex.cells, other, a),
        )
        for d in range(sums.shape[1]):
            outer = state.complex.fluxes[cell, below, d] + state.complex.fluxes[other, above, d]
            sums[0, d] = outer + spoke[s, 0, d] - spoke[r, 0, d]
        new += state.objective.image * image_energy(
            sums, 0, state.complex.labels[cell], state.objective
        )
        if not new < limit:
            return -np.inf
    return old - new


@inlined
def _squares_by_axis(y: NDArray, a: int, b: int, c: int) -> float:
    """Sum of the six squared edges of the tetrahedron of the origin and three rows, axis by
    axis.
    """
    S = 0.0
    for d in range(3):
        total = y[a, d] + y[b, d] + y[c, d]
        S += 4.0 * (y[a, d] * y[a, d] + y[b, d] * y[b, d] + y[c, d] * y[c, d]) - total * total
    return S


@unit
def ring_of_edge(
    ring: Ints1,
    around: Ints1,
    cells: Ints2,
    across: Ints2,
    cell: int,
    i: int,
    j: int,
    looks: Bools1,
) -> tuple[int, int]:
    """The cells around the edge of a cell between its corners i and j, and the polygon of their
    other corners.

    The polygon turns to the right about a to b: cell r has a, b, ring[r] and ring[r + 1]. Returns
    the polygon's number of corners, and 1 if it is open, that is, if the edge is on the boundary,
    with one cell fewer than corners. The number is 0 if it exceeds `POLYGON_CORNERS`, or if a lower
    cell marked in `looks` (C,) evaluates the edge; with (0,) none does.
    """
    a, b = cells[cell, i], cells[cell, j]
    # The other two corners, so that (a, b, v, w) is positively oriented.
    k, m = -1, -1
    for c in range(4):
        if c not in (i, j):
            if k < 0:
                k = c
            else:
                m = c
    parity = (i > j) ^ ((i + j) % 2 == 0)  # True if (i, j, k, m), k < m, is an odd permutation
    if parity:
        k, m = m, k
    v, w = cells[cell, k], cells[cell, m]
    # Backwards to the first cell, if the search meets the boundary.
    current, back = cell, v
    front = w
    steps = 0
    while True:
        before = across[current, corner_of(cells, current, front)]  # beyond the facet (a, b, back)
        if before < 0 or before == cell:
            break
        steps += 1
        if steps > POLYGON_CORNERS or (before < min(cell, len(looks)) and looks[before]):
            return 0, 0
        current, front, back = before, back, _fourth_node(cells, before, a, b, back)
    is_open = 1 if across[current, corner_of(cells, current, front)] < 0 else 0
    if is_open == 0:
        current, back, front = cell, v, w
    first = current
    count = 0
    ring[0] = back
    while True:
        if count + 1 + is_open > POLYGON_CORNERS:
            return 0, 0
        around[count] = current
        count += 1
        after = across[current, corner_of(cells, current, back)]  # beyond the facet (a, b, front)
        if after < 0:
            ring[count] = front
            return count + 1, 1
        if after == first:
            return count, 0
        if count == POLYGON_CORNERS or (after < min(cell, len(looks)) and looks[after]):
            return 0, 0
        ring[count] = front
        current, back, front = after, front, _fourth_node(cells, after, a, b, front)


@inlined
def _fourth_node(cells: NDArray, cell: int, a: int, b: int, c: int) -> int:
    """The corner of a tetrahedron other than a, b and c."""
    fourth = 0
    for k in range(4):
        if cells[cell, k] not in (a, b, c):
            fourth = cells[cell, k]
    return fourth


@helper
def in_one_face(state: State, a: int, b: int, c: int, d: int) -> bool:
    """True if four boundary nodes lie in one face of the box.

    False if the boundary is fixed, as its facets must stay, and for coplanar facets off the box's
    faces, which a part of a mesh may share with another part.
    """
    t, low, high = state.complex.ticks, state.sides.low, state.sides.high
    for axis in range(3):
        at = t[a, axis]
        is_side = not state.sides.is_fixed and (at == low[axis] or at == high[axis])
        if is_side and t[b, axis] == at and t[c, axis] == at and t[d, axis] == at:
            return True
    return False


@unit
def turn_to_arcs(work: Cavity, labels: Ints1, m: int, is_open: int) -> bool:
    """True if the edge whose cells are in `work` may be removed without changing the topology of
    labels.

    Either all of its cells have one label, or two or more cells of one label are followed by two or
    more of another. Then the polygon is rotated so that the first label's cells come first,
    `work.arc` of them, and the two facets between the labels are exchanged for those on the
    polygon's diagonal from its corner 0 to `work.arc`.
    """
    ring, around, n_cells = work.ring, work.around, m - is_open
    n_changes, first = 0, 0
    for r in range(1 if is_open == 1 else 0, n_cells):
        if labels[around[r]] != labels[around[(r - 1) % n_cells]]:
            n_changes += 1
            if n_changes == 1:
                first = r
    work.arc[0] = 0
    if n_changes == 0:
        return True
    if is_open == 1 or n_changes != 2:
        return False
    for r in range(m):
        work.stack[r, 0], work.stack[r, 1] = ring[(first + r) % m], around[(first + r) % m]
    for r in range(m):
        ring[r], around[r] = work.stack[r, 0], work.stack[r, 1]
    while labels[around[work.arc[0]]] == labels[around[0]]:
        work.arc[0] += 1
    return 2 <= work.arc[0] <= m - 2


@inlined
def joins_arcs(work: Cavity, i: int, k: int, j: int) -> bool:
    """True if a triangle i < k < j of the polygon would lie in two labels."""
    t = work.arc[0]
    return t > 0 and j > t and (0 < i < t or 0 < k < t)


@inlined
def _arc_of(work: Cavity, j: int) -> int:
    """The first cell around the edge with the label of the polygon's triangle whose last corner
    is j.
    """
    return work.arc[0] if 0 < work.arc[0] < j else 0


@helper
def _shape_of_ears(y: NDArray, m: int, limit: float, objective: Objective) -> float:
    """Least shape energy of two ears of a polygon, triangles of three successive corners."""
    low, lower = np.inf, np.inf
    for k in range(m):
        ear = _pair_shape(y, 2 + (k - 1) % m, 2 + k, 2 + (k + 1) % m, limit, objective)
        if ear < lower:
            low, lower = lower, ear
        elif ear < low:
            low = ear
    return low + lower


@unit
def _worth_of_edge(work: Cavity, state: State, a: int, b: int, m: int, is_open: int) -> float:
    """Reduction of E by removing the edge (a, b), -inf if impossible; `work.apex` then holds the
    diagonals.

    `ring_of_edge` has filled `work.ring` and `work.around`. apex[i, j] is the corner between i and
    j of the best triangulation's triangle on the diagonal (i, j).
    """
    y, ring, around = work.y, work.ring, work.around
    cost, apex, triangle = work.cost, work.apex, work.triangle
    if m < 3 or (is_open == 1 and not in_one_face(state, a, b, ring[0], ring[m - 1])):
        return -np.inf
    if not turn_to_arcs(work, state.complex.labels, m, is_open):
        return -np.inf
    old = 0.0
    for r in range(m - is_open):
        old += cell_energy(state, around[r])
    limit = old * (1.0 - LEAST_FLIP_FRACTION)
    for d in range(3):
        y[0, d] = 0.0
    load(y, 1, state.complex.ticks, b, a, state.objective)
    for r in range(m):
        load(y, 2 + r, state.complex.ticks, ring[r], a, state.objective)
    # A triangulation's shape energy alone is a cheap lower bound, and so is that of its two ears:
    # few edges pass them.
    if m > 4 and not _shape_of_ears(y, m, limit, state.objective) < limit:
        return -np.inf
    for i in range(m - 2):
        for k in range(i + 1, m - 1):
            for j in range(k + 1, m):
                triangle[i, k, j] = np.inf
                if not joins_arcs(work, i, k, j):
                    triangle[i, k, j] = _pair_shape(y, 2 + i, 2 + k, 2 + j, limit, state.objective)
    if not best_triangulation(cost, apex, triangle, m) < limit:
        return -np.inf
    # Angles come last: few edges get here, and angles take more time than energies (half of a pass,
    # if first).
    if state.objective.angle_limit > -1.0:
        least = state.objective.angle_limit
        for r in range(m - is_open):
            least = min(least, cell_cosine(work.x, state, around[r]))
        for i in range(m - 2):
            for k in range(i + 1, m - 1):
                for j in range(k + 1, m):
                    if (
                        triangle[i, k, j] < limit
                        and _pair_cosine(work.x, y, 2 + i, 2 + k, 2 + j) < least
                    ):
                        triangle[i, k, j] = np.inf
        if not best_triangulation(cost, apex, triangle, m) < limit:
            return -np.inf
    if state.objective.image == 0.0:
        return old - cost[0, m - 1]
    # Then the image, only for the triangles of the best triangulation, until it remains the best: a
    # triangle that is not measured has its least possible energy, so no better triangulation is
    # missed.
    for i in range(m):
        for k in range(m):
            work.is_side[i, k] = False
            for j in range(m):
                work.is_measured[i, k, j] = False
    while _measure_triangles(work, state, a, b, m, is_open):
        if not best_triangulation(cost, apex, triangle, m) < limit:
            return -np.inf
    return old - cost[0, m - 1]


@unit
def _measure_triangles(work: Cavity, state: State, a: int, b: int, m: int, is_open: int) -> bool:
    """Add the image energy to the triangles of the triangulation in `apex`; return True if any
    lacked it.
    """
    stack, side_a, side_b, ring = work.stack, work.side_a, work.side_b, work.ring
    stack[0, 0], stack[0, 1] = 0, m - 1
    height = 1
    is_new = False
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
        is_new = work.is_measured[i, k, j] = True
        for p, q in ((i, k), (k, j), (i, j)):
            fill_side(work, state, a, b, p, q, m, is_open)
        put_flux(work.flux, 0, 0, state.complex.ticks, ring[i], ring[k], ring[j], state.objective)
        for d in range(work.sums.shape[1]):
            u = work.flux[0, 0, d]
            work.sums[0, d] = side_b[i, k, d] + side_b[k, j, d] - side_b[i, j, d] - u
            work.sums[1, d] = side_a[i, k, d] + side_a[k, j, d] - side_a[i, j, d] + u
        label = state.complex.labels[work.around[_arc_of(work, j)]]
        work.triangle[i, k, j] += state.objective.image * (
            image_energy(work.sums, 0, label, state.objective)
            + image_energy(work.sums, 1, label, state.objective)
        )
    return is_new


@helper
def _pair_shape(y: NDArray, i: int, k: int, j: int, limit: float, objective: Objective) -> float:
    """Weighted shape energy of the tetrahedra (i, k, j, b) and (i, j, k, a) over a triangle of the
    polygon.

    Rows of `y`: a, b, then the polygon's corners. Infinite if one is inverted or flat or has more
    than `limit`.
    """
    u, v, to_a, to_b = (
        difference(y, k, i),
        difference(y, j, i),
        difference(y, 0, i),
        difference(y, 1, i),
    )
    n = cross(u, v)
    above, below = dot(n, to_b), -dot(n, to_a)
    if above <= 0.0 or below <= 0.0:
        return np.inf
    energy = objective.geometry * tet_energy(
        above, _edge_squares(u, v, to_b), objective.power, objective.is_graded
    )
    if not energy < limit:
        return np.inf
    energy += objective.geometry * tet_energy(
        below, _edge_squares(u, v, to_a), objective.power, objective.is_graded
    )
    return energy if energy < limit else np.inf


@inlined
def _edge_squares(u: tuple, v: tuple, w: tuple) -> float:
    """Sum of the six squared edges of the tetrahedron of the origin and three vectors."""
    base = u[0] * u[0] + u[1] * u[1] + u[2] * u[2] + v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    s = u[0] + v[0] + w[0], u[1] + v[1] + w[1], u[2] + v[2] + w[2]
    return 4.0 * (base + w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) - dot(s, s)


@helper
def _pair_cosine(x: NDArray, y: NDArray, i: int, k: int, j: int) -> float:
    """`worst_cosine` of the worse of the same two tetrahedra."""
    for d in range(3):
        x[0, d], x[1, d], x[2, d], x[3, d] = y[i, d], y[k, d], y[j, d], y[1, d]
    above = worst_cosine(x)
    for d in range(3):
        x[1, d], x[2, d], x[3, d] = y[j, d], y[k, d], y[0, d]
    return min(above, worst_cosine(x))


@unit
def best_triangulation(cost: Floats2, apex: Ints2, triangle: Floats3, m: int) -> float:
    """Least sum of `triangle[i, k, j]` over the triangulations of a polygon of m corners; `apex`
    is filled.
    """
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


@unit
def fill_side(
    work: Cavity, state: State, a: int, b: int, i: int, j: int, m: int, is_open: int
) -> None:
    """Fill in unknown fluxes of the facets (v_i, v_j, b) and (v_j, v_i, a): the old cells' on
    the polygon's sides.
    """
    if work.is_side[i, j]:
        return
    work.is_side[i, j] = True
    if j == i + 1 or (i == 0 and j == m - 1 and is_open == 0):
        r, sign = (i, 1.0) if j == i + 1 else (m - 1, -1.0)
        cell = work.around[r]
        for d in range(state.complex.fluxes.shape[2]):
            work.side_b[i, j, d] = (
                sign * state.complex.fluxes[cell, corner_of(state.complex.cells, cell, a), d]
            )
            work.side_a[i, j, d] = (
                sign * state.complex.fluxes[cell, corner_of(state.complex.cells, cell, b), d]
            )
        return
    for which in range(2):  # a single call that measures fluxes halves the code to compile
        p, q, end = (
            (work.ring[i], work.ring[j], b) if which == 0 else (work.ring[j], work.ring[i], a)
        )
        side = work.side_b if which == 0 else work.side_a
        put_flux(side, i, j, state.complex.ticks, p, q, end, state.objective)


@entry
def make_moves(order: Ints1, move: Ints1, is_dirty: Bools1, state: State, work: Cavity) -> int:
    """Make the moves of the cells in `order` whose cavities are unchanged; return their number.

    Cells of a changed cavity are marked dirty, and unused ones are removed at the end.
    """
    cells, across = state.complex.cells, state.complex.across
    room = len(cells)
    made = 0
    for number in range(len(order)):
        cell = order[number]
        if is_dirty[cell] or state.complex.n_cells[0] + 2 * POLYGON_CORNERS > room:
            continue
        if cells.shape[1] == 3:
            other = across[cell, move[cell]]
            if not is_dirty[other]:
                _turn_edge(state, cell, move[cell])
                is_dirty[cell] = is_dirty[other] = True
                made += 1
            continue
        if move[cell] < 4:
            if is_dirty[across[cell, move[cell]]]:
                continue
            flip_face(work, state, cell, move[cell], is_dirty)
        else:
            i, j = TET_EDGES[move[cell] - 4]
            m, is_open = ring_of_edge(
                work.ring, work.around, cells, across, cell, i, j, is_dirty[:0]
            )
            clean = m > 0
            for r in range(m - is_open):
                clean = clean and not is_dirty[work.around[r]]
            if not clean:
                continue
            a, b = cells[cell, i], cells[cell, j]
            _worth_of_edge(work, state, a, b, m, is_open)
            remove_edge(work, state, a, b, m, is_open, is_dirty)
        made += 1
    close_gaps(state, is_dirty)
    return made


@unit
def take_cells(work: Cavity, state: State, n_old: int, n_new: int, is_dirty: Bools1) -> None:
    """Write the numbers of the cells that fill a cavity to `work.new`: first its `n_old` cells in
    `work.around`.

    Further numbers are those of unused cells, or from the end; cells that become unused are marked
    by a corner of -1. All are marked dirty.
    """
    for r in range(max(n_old, n_new)):
        if r < n_old:
            cell = work.around[r]
            if r >= n_new:
                state.complex.cells[cell, 0] = -1
                work.free[0] += 1
                work.free[work.free[0]] = cell
        elif work.free[0] > 0:
            cell = work.free[work.free[0]]
            work.free[0] -= 1
        else:
            cell = state.complex.n_cells[0]
            state.complex.n_cells[0] += 1
        if r < n_new:
            work.new[r] = cell
        is_dirty[cell] = True


@unit
def flip_face(work: Cavity, state: State, cell: int, k: int, is_dirty: Bools1) -> None:
    """Replace two cells by three around the edge (p, q) between the corners opposite their facet
    (u, v, w).
    """
    cells, across, fluxes, objective = (
        state.complex.cells,
        state.complex.across,
        state.complex.fluxes,
        state.objective,
    )
    other = across[cell, k]
    u, v, w = outward(cells, cell, k)
    p, q = (cells[cell, k], cells[other, facet_of(across, other, cell)])
    label = state.complex.labels[cell]
    corner, D = (u, v, w), fluxes.shape[2]
    below, above = np.empty((3, D)), np.empty((3, D))  # fluxes of the facets opposite u, v, w
    under, over = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)  # the cells beyond them
    for r in range(3):
        i, j = corner_of(cells, cell, corner[r]), corner_of(cells, other, corner[r])
        under[r], over[r] = across[cell, i], across[other, j]
        for d in range(D):
            below[r, d], above[r, d] = fluxes[cell, i, d], fluxes[other, j, d]
    work.around[0], work.around[1] = cell, other
    take_cells(work, state, 2, 3, is_dirty)
    new = work.new
    spoke = work.flux
    for r in range(3):
        for d in range(D):
            spoke[r, 0, d] = 0.0
    if objective.image > 0.0:
        for r in range(3):
            put_flux(spoke, r, 0, state.complex.ticks, p, q, corner[r], objective)
    # The facets of the neighbours that lead here, before anything is overwritten.
    under_k, over_k = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for r in range(3):
        under_k[r] = over_k[r] = -1
        if under[r] >= 0:
            under_k[r] = facet_of(across, under[r], cell)
        if over[r] >= 0:
            over_k[r] = facet_of(across, over[r], other)
    for r in range(3):  # cell r: (p, q, corner r, corner r + 1), opposite corner r + 2
        s, t = (r + 1) % 3, (r + 2) % 3
        c = new[r]
        cells[c, 0], cells[c, 1], cells[c, 2], cells[c, 3] = (p, q, corner[r], corner[s])
        state.complex.labels[c] = label
        (across[c, 0], across[c, 1], across[c, 2], across[c, 3]) = (
            over[t],
            under[t],
            new[s],
            new[t],
        )
        for d in range(D):
            fluxes[c, 0, d], fluxes[c, 1, d] = above[t, d], below[t, d]
            fluxes[c, 2, d], fluxes[c, 3, d] = spoke[s, 0, d], -spoke[r, 0, d]
        join(across, c, 0, over[t], over_k[t])
        join(across, c, 1, under[t], under_k[t])
        settle(work.x, state, c)


@helper
def join(across: NDArray, cell: int, k: int, other: int, m: int) -> None:
    """Link facet k of a cell with facet m of another, or with the boundary if `other` is -1."""
    across[cell, k] = other
    if other >= 0:
        across[other, m] = cell


@helper
def _beyond_polygon(work: Cavity, state: State, node: int, n_cells: int) -> NDArray:
    """The cells beyond the sides of the polygon in `work`, over the node: row r (cell, its facet
    that leads here).

    Rows are -1 outside the mesh, and in the last row of an open polygon.
    """
    cells, across = state.complex.cells, state.complex.across
    beyond = np.empty((POLYGON_CORNERS, 2), dtype=np.int64)
    for r in range(POLYGON_CORNERS):
        beyond[r, 0] = beyond[r, 1] = -1
    for r in range(n_cells):
        cell = work.around[r]
        other = across[cell, corner_of(cells, cell, node)]
        if other >= 0:
            beyond[r, 0], beyond[r, 1] = other, facet_of(across, other, cell)
    return beyond


@unit
def remove_edge(
    work: Cavity, state: State, a: int, b: int, m: int, is_open: int, is_dirty: Bools1
) -> None:
    """Replace the cells around (a, b) by pairs over the triangles of the polygon in `work.apex`;
    see `_worth_of_edge`.

    The sides of its triangles have known fluxes, if the image has weight.
    Over the triangle (i, k, j), i < k < j: (v_i, v_k, v_j, b) and (v_i, v_j, v_k, a).
    """
    cells, across, ring, new = state.complex.cells, state.complex.across, work.ring, work.new
    labels = state.complex.labels
    one, other = labels[work.around[0]], labels[work.around[work.arc[0]]]
    # beyond the facets opposite b, on the side of a
    beyond_a = _beyond_polygon(work, state, b, m - is_open)
    beyond_b = _beyond_polygon(work, state, a, m - is_open)
    take_cells(work, state, m - is_open, 2 * (m - 2), is_dirty)
    # The triangle under each diagonal (i, j), numbered; its two cells are new[2 t] and new[2 t +
    # 1].
    stack = work.stack  # rows of i, j and (triangle above) * 4 + its facet towards this one
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, m - 1, -1
    height, count = 1, 0
    while height > 0:
        height -= 1
        i, j, up = stack[height]
        if j == i + 1:
            continue
        k, t = work.apex[i, j], count
        count += 1
        top, low = new[2 * t], new[2 * t + 1]  # of b, of a
        cells[top, 0], cells[top, 1], cells[top, 2], cells[top, 3] = ring[i], ring[k], ring[j], b
        cells[low, 0], cells[low, 1], cells[low, 2], cells[low, 3] = ring[i], ring[j], ring[k], a
        labels[top] = labels[low] = one if _arc_of(work, j) == 0 else other
        join(across, top, 3, low, 3)
        _put_pair_fluxes(work, state, top, low, i, k, j)
        # The side (i, j): the triangle above, or the cell beyond the closing side of the polygon.
        if up >= 0:
            facet = up % 4
            join(across, top, 1, new[2 * (up // 4)], facet)
            join(across, low, 2, new[2 * (up // 4) + 1], 0 if facet == 0 else 1)
        else:
            join(across, top, 1, beyond_b[m - 1, 0], beyond_b[m - 1, 1])
            join(across, low, 2, beyond_a[m - 1, 0], beyond_a[m - 1, 1])
        # The sides (i, k) and (k, j): a side of the polygon, or a diagonal that follows.
        for p, q, facet_top, facet_low in ((i, k, 2, 1), (k, j, 0, 0)):
            if q == p + 1:
                join(across, top, facet_top, beyond_b[p, 0], beyond_b[p, 1])
                join(across, low, facet_low, beyond_a[p, 0], beyond_a[p, 1])
            else:
                stack[height, 0], stack[height, 1], stack[height, 2] = p, q, 4 * t + facet_top
                height += 1
    for r in range(2 * count):
        settle(work.x, state, new[r])


@helper
def _put_pair_fluxes(
    work: Cavity, state: State, top: int, low: int, i: int, k: int, j: int
) -> None:
    """Write the fluxes of the two cells over the triangle (i, k, j); 0 inside the cavity if the
    image has no weight.
    """
    fluxes, side_a, side_b, ring = state.complex.fluxes, work.side_a, work.side_b, work.ring
    has_image = state.objective.image > 0.0
    for d in range(fluxes.shape[2]):
        work.flux[0, 0, d] = 0.0
    if has_image:
        put_flux(work.flux, 0, 0, state.complex.ticks, ring[i], ring[k], ring[j], state.objective)
    for d in range(fluxes.shape[2]):
        fluxes[top, 3, d], fluxes[low, 3, d] = -work.flux[0, 0, d], work.flux[0, 0, d]
        if has_image:
            fluxes[top, 0, d], fluxes[low, 0, d] = side_b[k, j, d], side_a[k, j, d]
            fluxes[top, 2, d], fluxes[low, 1, d] = side_b[i, k, d], side_a[i, k, d]
            fluxes[top, 1, d], fluxes[low, 2, d] = -side_b[i, j, d], -side_a[i, j, d]


@unit
def close_gaps(state: State, is_dirty: Bools1) -> None:
    """Move the last cells into the places of removed ones."""
    cells, across, fluxes, sums = (
        state.complex.cells,
        state.complex.across,
        state.complex.fluxes,
        state.complex.sums,
    )
    E_shape = state.complex.E_shape
    n = cells.shape[1]
    last = state.complex.n_cells[0] - 1
    cell = 0
    while cell <= last:
        if cells[cell, 0] >= 0:
            cell += 1
            continue
        while last > cell and cells[last, 0] < 0:
            last -= 1
        if last == cell:
            last -= 1
            break
        for k in range(n):  # to compile copies of whole rows takes numba four times as long
            cells[cell, k], across[cell, k] = cells[last, k], across[last, k]
            for d in range(sums.shape[1]):
                fluxes[cell, k, d] = fluxes[last, k, d]
        for d in range(sums.shape[1]):
            sums[cell, d] = sums[last, d]
        E_shape[cell] = E_shape[last]
        state.complex.labels[cell] = state.complex.labels[last]
        is_dirty[cell] = is_dirty[last]
        for k in range(n):
            other = across[cell, k]
            if other >= 0:
                across[other, facet_of(across, other, last)] = cell
        cells[last, 0] = -1
        last -= 1
    state.complex.n_cells[0] = last + 1


# Triangles.


@unit
def _evaluate_triangles(search: Evaluation, chunk: int) -> None:
    """Evaluate moves 0 to 2, which flip that edge."""
    gain, move, near, is_dirty, state = (
        search.gain,
        search.move,
        search.near,
        search.is_dirty,
        search.state,
    )
    x, sums, complex_ = np.empty((4, 3)), np.empty((2, state.complex.sums.shape[1])), state.complex
    first = chunk * CELLS_PER_CHUNK
    for number in range(first, min(first + CELLS_PER_CHUNK, len(near))):
        cell = near[number]
        for k in range(3):
            other = complex_.across[cell, k]
            # the triangle beyond evaluates the edge
            is_others = 0 <= other < cell and is_dirty[other]
            if other >= 0 and not is_others and not is_interface(complex_, cell, k):
                worth = _worth_of_turn(x, sums, state, cell, k)
                if worth > gain[cell]:
                    gain[cell], move[cell] = worth, k


@unit
def _worth_of_turn(x: Floats2, sums: Floats2, state: State, cell: int, k: int) -> float:
    """Reduction of E by flipping the edge (u, v) between two triangles to (p, q); -inf if
    impossible.
    """
    ticks, cells, across, fluxes = (
        state.complex.ticks,
        state.complex.cells,
        state.complex.across,
        state.complex.fluxes,
    )
    objective = state.objective
    other = across[cell, k]
    m = facet_of(across, other, cell)
    p, q = cells[cell, k], cells[other, m]
    u, v = cells[cell, (k + 1) % 3], cells[cell, (k + 2) % 3]
    old = cell_energy(state, cell) + cell_energy(state, other)
    limit = old * (1.0 - LEAST_FLIP_FRACTION)
    new = objective.geometry * shape_of_triangle(x, ticks, p, u, q, objective)
    if new < limit:
        new += objective.geometry * shape_of_triangle(x, ticks, p, q, v, objective)
    if not new < limit:
        return -np.inf
    if objective.image > 0.0:
        flux = np.empty((1, 1, sums.shape[1]))
        put_flux(flux, 0, 0, ticks, p, q, -1, objective)
        for d in range(sums.shape[1]):  # over the edges (p, u), (u, q), and (q, v), (v, p)
            sums[0, d] = (
                fluxes[cell, (k + 2) % 3, d] + fluxes[other, (m + 1) % 3, d] - flux[0, 0, d]
            )
            sums[1, d] = (
                fluxes[other, (m + 2) % 3, d] + fluxes[cell, (k + 1) % 3, d] + flux[0, 0, d]
            )
        label = state.complex.labels[cell]
        new += objective.image * (
            image_energy(sums, 0, label, objective) + image_energy(sums, 1, label, objective)
        )
    return old - new if new < limit else -np.inf


@unit
def _turn_edge(state: State, cell: int, k: int) -> None:
    """Replace triangles (p, u, v) and (q, v, u) by (p, u, q) and (p, q, v)."""
    ticks, cells, across, fluxes = (
        state.complex.ticks,
        state.complex.cells,
        state.complex.across,
        state.complex.fluxes,
    )
    objective = state.objective
    other = across[cell, k]
    m = facet_of(across, other, cell)
    p, q = cells[cell, k], cells[other, m]
    u, v = cells[cell, (k + 1) % 3], cells[cell, (k + 2) % 3]
    # Facets by their edge: (p, u), (u, q), (q, v), (v, p), and the cells beyond.
    at_pu, at_uq, at_qv, at_vp = (k + 2) % 3, (m + 1) % 3, (m + 2) % 3, (k + 1) % 3
    f_pu, f_vp = fluxes[cell, at_pu].copy(), fluxes[cell, at_vp].copy()
    f_uq, f_qv = fluxes[other, at_uq].copy(), fluxes[other, at_qv].copy()
    n_pu, n_vp = across[cell, at_pu], across[cell, at_vp]
    n_uq, n_qv = across[other, at_uq], across[other, at_qv]
    if n_uq >= 0:
        across[n_uq, facet_of(across, n_uq, other)] = cell
    if n_vp >= 0:
        across[n_vp, facet_of(across, n_vp, cell)] = other
    f = np.zeros((1, 1, fluxes.shape[2]))
    if objective.image > 0.0:
        put_flux(f, 0, 0, ticks, p, q, -1, objective)
    cells[cell, 0], cells[cell, 1], cells[cell, 2] = p, u, q
    cells[other, 0], cells[other, 1], cells[other, 2] = p, q, v
    across[cell, 0], across[cell, 1], across[cell, 2] = n_uq, other, n_pu
    across[other, 0], across[other, 1], across[other, 2] = n_qv, n_vp, cell
    for d in range(fluxes.shape[2]):
        fluxes[cell, 0, d], fluxes[cell, 1, d], fluxes[cell, 2, d] = (f_uq[d], -f[0, 0, d], f_pu[d])
        fluxes[other, 0, d], fluxes[other, 1, d], fluxes[other, 2, d] = (
            f_qv[d],
            f_vp[d],
            f[0, 0, d],
        )
    x = np.empty((4, 3))
    for c in (cell, other):
        settle(x, state, c)
