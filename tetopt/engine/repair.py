"""Enforce the minimum dihedral angle: mend the worst cells one by one, regardless of E.

Moves are those of `tetopt.engine.flips` and `tetopt.engine.density` and displacements of single
nodes, but their measure is the smallest dihedral angle of the affected cells: a move is made only
if that grows (Freitag and Ollivier-Gooch 1997), and each cell takes the move that leaves the best
worst angle, up to the minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.engine.complex import (
    NodeStars,
    State,
    cell_cosine,
    facet_of,
    grow_state,
    is_interface,
    load_cell,
    node_stars,
    outward,
    tet_cosine,
)
from tetopt.engine.density import LEAST_LIFT_COSINE, mend
from tetopt.engine.flips import (
    POLYGON_CORNERS,
    TET_EDGES,
    Cavity,
    best_triangulation,
    cavity,
    close_gaps,
    fill_side,
    flip_face,
    in_one_face,
    joins_arcs,
    remove_edge,
    ring_of_edge,
    turn_to_arcs,
)
from tetopt.engine.sliding import projection_at, slides
from tetopt.engine.smooth import slide_node, star_energy, store, trial_of
from tetopt.geometry.vectors import difference, dot, put_row, row, scale_vector, times
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernels import Bools1, Floats1, Floats2, Ints1, entry, helper, unit

REPAIR_ROUNDS = 40  # at most; a round without changes ends them earlier
DISPLACED_AT_ONCE = 200  # cells between two checks of the time: up to 0.1 s, at 0.4 ms each
STEP_HALVINGS = 7  # of a node's displacement
FIRST_STEP_EDGES = 0.25  # of the star's mean edge: the first displacement
# a steep sum approximates the worst cosine q: exp(-40 q) outweighs all that are 3 degrees better
WORST_WEIGHT = 40.0


class Repaired(NamedTuple):
    """Result of `repair`."""

    state: State
    source: Ints  # (N',) number of each node before; -1 for new ones
    n_below: int  # cells still below the minimum
    n_moves: int


def cell_cosines(state: State) -> Floats:
    """Minus the cosine of each cell's smallest dihedral angle."""
    cosines = np.empty(int(state.complex.n_cells[0]))
    _fill_cosines(cosines, state)
    return cosines


@entry
def _fill_cosines(cosines: Floats1, state: State) -> None:
    x = np.empty((4, 3))
    for cell in range(len(cosines)):
        cosines[cell] = cell_cosine(x, state, cell)


def repair(
    state: State,
    min_dihedral: float,
    is_over: Callable[[], bool] = lambda: False,
    reconnects: bool = True,
) -> Repaired:
    """Lift every cell's smallest dihedral angle to `min_dihedral`, degrees, as far as moves can.

    Each round treats the cells below, the worst first: by flips, then by displacements of their
    nodes and, if neither helps, by inserting or removing nodes. Rounds end when no cell remains,
    nothing changes, or `is_over` returns True. Unless it `reconnects`, nodes are displaced only.
    """
    target = -np.cos(np.radians(min_dihedral))
    source, n_moves = np.arange(len(state.complex.ticks)), 0
    # nodes that could not be displaced, while their stars stay the same
    is_stuck = np.zeros(len(source), dtype=bool)
    for _ in range(REPAIR_ROUNDS):
        bad = _worst_first(state, target)
        if len(bad) == 0 or is_over():
            break
        if len(state.complex.cells) - state.complex.n_cells[0] < 4 * len(bad) + 64:
            state = grow_state(state)
        before = state.complex.cells[: state.complex.n_cells[0]].copy()
        n_made = 0
        if reconnects:
            work = cavity(len(state.complex.cells), state.complex.fluxes.shape[2])
            n_made = _reconnect(state, bad, target, work)
        _free_changed(is_stuck, before, state.complex.cells[: state.complex.n_cells[0]])
        bad = _worst_first(state, target)
        if len(bad):
            n_made += _displace_until(state, bad, target, is_over, is_stuck)
        bad = _worst_first(state, target)
        if n_made == 0 and len(bad) and reconnects:
            mended = mend(state, bad, target)
            state, n_made = mended.state, mended.n_split + mended.n_collapsed
            source = np.where(mended.source >= 0, source[mended.source], -1)
            is_stuck = np.zeros(len(source), dtype=bool)
        if n_made == 0 and len(bad):  # nodes between labels may leave their surfaces
            is_stuck[:] = False
            n_made = _displace_until(_release_nodes(state), bad, target, is_over, is_stuck)
            is_stuck[:] = False
        n_moves += n_made
        if n_made == 0:
            break
    return Repaired(state, source, len(_worst_first(state, target)), n_moves)


def _free_changed(is_stuck: Bools, before: Ints, after: Ints) -> None:
    """Clear the marks of the nodes of cells that differ."""
    both = min(len(before), len(after))
    is_other = (before[:both] != after[:both]).any(axis=1)
    for nodes in (before[:both][is_other], after[:both][is_other], before[both:], after[both:]):
        is_stuck[nodes] = False


def _displace_until(
    state: State,
    bad: Ints,
    target: float,
    is_over: Callable[[], bool],
    is_stuck: Bools,
) -> int:
    """`_displace` until `is_over` returns True, as tens of thousands of cells far smaller than
    voxels took minutes.
    """
    stars, n_made = node_stars(state), 0
    for begin in range(0, len(bad), DISPLACED_AT_ONCE):
        if is_over():
            break
        n_made += _displace(state, stars, bad[begin : begin + DISPLACED_AT_ONCE], target, is_stuck)
    return n_made


def _release_nodes(state: State) -> State:
    """The state in which nodes between labels are off their surfaces; those on a mask's surface
    still slide on it.
    """
    return state._replace(
        complex=state.complex._replace(meeting=np.full_like(state.complex.meeting, -1))
    )


def n_cells_below(state: State, min_dihedral: float) -> int:
    """Number of cells with a dihedral angle below `min_dihedral` degrees."""
    return int((cell_cosines(state) < -np.cos(np.radians(min_dihedral))).sum())


def _worst_first(state: State, target: float) -> Ints:
    cosines = cell_cosines(state)
    bad = np.flatnonzero(cosines < target)
    return bad[np.lexsort((bad, cosines[bad]))]


@entry
def _reconnect(state: State, bad: Ints1, target: float, work: Cavity) -> int:
    """For each bad cell make the flip that leaves the best worst angle in its cavity, if it
    improves.
    """
    cells, across = state.complex.cells, state.complex.across
    room = len(cells)
    is_changed = np.zeros(room, dtype=np.bool_)
    n_made = 0
    for number in range(len(bad)):
        cell = bad[number]
        if is_changed[cell] or state.complex.n_cells[0] + 2 * POLYGON_CORNERS > room:
            continue
        best, choice = LEAST_LIFT_COSINE, -1
        for k in range(4):
            if across[cell, k] >= 0 and not is_interface(state.complex, cell, k):
                gain = _gain_of_face(work.x, state, cell, k, target)
                if gain > best:
                    best, choice = gain, k
        for e in range(6):
            i, j = TET_EDGES[e, 0], TET_EDGES[e, 1]
            m, is_open = ring_of_edge(
                work.ring, work.around, cells, across, cell, i, j, is_changed[:0]
            )
            gain = _gain_of_edge(work, state, cell, e, m, is_open, target)
            if gain > best:
                best, choice = gain, 4 + e
        if choice < 0:
            continue
        if choice < 4:
            flip_face(work, state, cell, choice, is_changed)
        else:
            e = choice - 4
            i, j = TET_EDGES[e, 0], TET_EDGES[e, 1]
            m, is_open = ring_of_edge(
                work.ring, work.around, cells, across, cell, i, j, is_changed[:0]
            )
            _gain_of_edge(work, state, cell, e, m, is_open, target)
            a, b = cells[cell, i], cells[cell, j]
            if state.objective.image > 0.0:
                for i in range(m):
                    for j in range(m):
                        work.is_side[i, j] = False
                for i in range(m - 1):
                    for j in range(i + 1, m):
                        fill_side(work, state, a, b, i, j, m, is_open)
            remove_edge(work, state, a, b, m, is_open, is_changed)
        n_made += 1
    close_gaps(state, is_changed)
    return n_made


@unit
def _gain_of_face(x: Floats2, state: State, cell: int, k: int, target: float) -> float:
    """Growth of the cavity's worst angle (its negative cosine, up to the target) by a face flip."""
    cells, across = state.complex.cells, state.complex.across
    other = across[cell, k]
    old = min(cell_cosine(x, state, cell), cell_cosine(x, state, other))
    u, v, w = outward(cells, cell, k)
    p, q = cells[cell, k], cells[other, facet_of(across, other, cell)]
    new = target
    for a, b in ((u, v), (v, w), (w, u)):
        new = min(new, tet_cosine(x, state, p, q, a, b))
        if new <= old:
            return -1.0
    return new - old


@unit
def _gain_of_edge(
    work: Cavity, state: State, cell: int, e: int, m: int, is_open: int, target: float
) -> float:
    """Growth of the worst angle by removing an edge; `work.apex` holds the triangulation."""
    cells = state.complex.cells
    x, ring, around, cost, apex, shape = (
        work.x,
        work.ring,
        work.around,
        work.cost,
        work.apex,
        work.triangle,
    )
    a, b = cells[cell, TET_EDGES[e, 0]], cells[cell, TET_EDGES[e, 1]]
    if m < 3 or (is_open == 1 and not in_one_face(state, a, b, ring[0], ring[m - 1])):
        return -1.0
    if not turn_to_arcs(work, state.complex.labels, m, is_open):
        return -1.0
    old = 1.0
    for r in range(m - is_open):
        old = min(old, cell_cosine(x, state, around[r]))
    for i in range(m - 2):
        for k in range(i + 1, m - 1):
            for j in range(k + 1, m):
                above = tet_cosine(x, state, ring[i], ring[k], ring[j], b)
                below = tet_cosine(x, state, ring[i], ring[j], ring[k], a)
                shape[i, k, j] = np.inf
                if min(above, below) > old and not joins_arcs(work, i, k, j):
                    shape[i, k, j] = np.exp(-WORST_WEIGHT * above) + np.exp(-WORST_WEIGHT * below)
    if not np.isfinite(best_triangulation(cost, apex, shape, m)):
        return -1.0
    new = target
    stack = work.stack
    stack[0, 0], stack[0, 1] = 0, m - 1
    height = 1
    while height > 0:
        height -= 1
        i, j = stack[height, 0], stack[height, 1]
        if j == i + 1:
            continue
        k = apex[i, j]
        new = min(new, tet_cosine(x, state, ring[i], ring[k], ring[j], b))
        new = min(new, tet_cosine(x, state, ring[i], ring[j], ring[k], a))
        stack[height, 0], stack[height, 1] = i, k
        stack[height + 1, 0], stack[height + 1, 1] = k, j
        height += 2
    return new - old


@entry
def _displace(state: State, stars: NodeStars, bad: Ints1, target: float, is_stuck: Bools1) -> int:
    """Move the nodes of each bad cell so that the worst angle of their stars grows, up to the
    target.

    A node that found no better place, marked in `is_stuck`, is tried again only after its star has
    changed: where the target is out of reach, most nodes of most cells fail, in each of some 20
    cells and in each round.
    """
    x, n_made = np.empty((4, 3)), 0
    for number in range(len(bad)):
        for k in range(4):
            if cell_cosine(x, state, bad[number]) >= target:
                break
            node = state.complex.cells[bad[number], k]
            if is_stuck[node]:
                continue
            is_stuck[node] = not _lift(x, state, stars, node, target)
            if not is_stuck[node]:
                n_made += 1
                for r in range(stars.start[node], stars.start[node + 1]):
                    for corner in range(4):
                        is_stuck[state.complex.cells[stars.cells[r], corner]] = False
    return n_made


@unit
def _star_cosine(x: Floats2, state: State, stars: NodeStars, node: int, least: float) -> float:
    """Worst cosine of a star's cells; -2 if one is flat or inverted, or some value below `least`
    if it falls below.
    """
    worst = 1.0
    for r in range(stars.start[node], stars.start[node + 1]):
        c = state.complex.cells[stars.cells[r]]
        worst = min(worst, tet_cosine(x, state, c[0], c[1], c[2], c[3]))
        if worst < least:
            return worst
    return worst


@unit
def _lift(x: Floats2, state: State, stars: NodeStars, node: int, target: float) -> bool:
    """Search around a node, with ever smaller steps, for a place where its star's worst angle is
    larger.
    """
    start, before = row(state.complex.ticks, node), _star_cosine(x, state, stars, node, -3.0)
    if before >= target:
        return False
    best, step, normal = before, _first_step(x, state, stars, node), np.zeros((7, 3))
    is_sliding = slides(normal, state, node)
    for _ in range(STEP_HALVINGS):
        is_better = True
        while is_better and best < target:
            cosine = _step_around(x, normal, is_sliding, state, stars, node, step, best)
            is_better, best = cosine > best, cosine
        step *= 0.5
    if best > before:
        trial = trial_of(state, stars, node)
        if np.isfinite(star_energy(trial, np.inf, -1.0, node, state, stars, -1)):
            store(trial, node, state, stars)
            return True
    put_row(state.complex.ticks, node, start)
    return False


@helper
def _first_step(x: NDArray, state: State, stars: NodeStars, node: int) -> float:
    """A quarter of the mean length of the edges from a node, each counted once per cell, mm."""
    total, count = 0.0, 0
    for r in range(stars.start[node], stars.start[node + 1]):
        load_cell(x, state.complex.ticks, state.complex.cells, stars.cells[r], state.objective)
        at = stars.corner[r]
        for k in range(4):
            if k != at:
                edge = difference(x, k, at)
                total += np.sqrt(dot(edge, edge))
                count += 1
    return FIRST_STEP_EDGES * total / count


@unit
def _step_around(
    x: Floats2,
    normal: Floats2,
    is_sliding: bool,
    state: State,
    stars: NodeStars,
    node: int,
    step: float,
    best: float,
) -> float:
    """Move a node by a step, mm, in the best of 26 directions for its star's cosine; return
    that, or `best`.
    """
    t, P, scale = state.complex.ticks, projection_at(state, node), 2.0**-state.objective.bits
    here = row(t, node)
    there = here
    for code in range(27):
        if code == 13:
            continue
        d = float(code // 9 - 1), float(code // 3 % 3 - 1), float(code % 3 - 1)
        way = scale_vector(step / np.sqrt(dot(d, d)) / scale, times(P, d))
        t[node, 0] = here[0] + np.int64(np.rint(way[0]))
        t[node, 1] = here[1] + np.int64(np.rint(way[1]))
        t[node, 2] = here[2] + np.int64(np.rint(way[2]))
        if is_sliding and not slide_node(normal, state, stars, node):
            continue
        cosine = _star_cosine(x, state, stars, node, best)
        if cosine > best + LEAST_LIFT_COSINE:
            best, there = cosine, row(t, node)
    put_row(t, node, there)
    return best
