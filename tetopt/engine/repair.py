"""The floor on the dihedral angles: the worst cells mended one by one, whatever it does to E.

Moves are those of `tetopt.engine.flips` and `tetopt.engine.density` and displacements of single nodes, but judged
by the smallest dihedral angle of the cells they touch: a move is made only if that grows (Freitag and Ollivier-Gooch
1997), and of the moves of a cell the one that leaves the best worst angle, up to the floor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tetopt.engine.complex import (
    Complex,
    Measure,
    NodeRings,
    cell_quality,
    facet_of,
    grown,
    load_cell,
    node_rings,
    outward,
    tet_quality,
)
from tetopt.engine.density import mend
from tetopt.engine.flips import (
    EDGES,
    MOST,
    Cavity,
    best_triangulation,
    cavity,
    close_gaps,
    fill_side,
    flip_face,
    in_one_face,
    remove_edge,
    ring_of_edge,
)
from tetopt.engine.smooth import ring_energy, slid, store
from tetopt.engine.surface import Sides

ROUNDS = 40
STEPS = 7  # halvings of a node's displacement


class Repaired(NamedTuple):
    """What `repair` returns."""

    held: Complex
    is_frozen: NDArray[np.bool_]  # (N', 4)
    source: NDArray[np.int64]  # (N',) number of each node before; -1 for new ones
    n_below: int  # cells still under the floor
    n_moves: int


def qualities(held: Complex, measure: Measure) -> NDArray[np.float64]:
    """Minus the cosine of each cell's smallest dihedral angle."""
    found = np.empty(int(held.n_cells[0]))
    _fill_qualities(found, held, measure)
    return found


@njit(cache=True, error_model="numpy")
def _fill_qualities(found: NDArray, held: Complex, measure: Measure) -> None:
    x = np.empty((4, 3))
    for cell in range(len(found)):
        found[cell] = cell_quality(x, held, cell, measure)


def repair(held: Complex, is_frozen: NDArray[np.bool_], measure: Measure, sides: Sides, floor: float) -> Repaired:
    """Lift every cell's smallest dihedral angle to `floor`, degrees, as far as moves can.

    Rounds over the cells below, worst first: flips, then displacements of their nodes, and where neither helps nodes
    put in or taken out; until no cell is left, or a round changes nothing.
    """
    target = -np.cos(np.radians(floor))
    total = 0
    source = np.arange(len(held.ticks))
    for _ in range(ROUNDS):
        bad = _worst_first(held, measure, target)
        if len(bad) == 0:
            break
        if len(held.cells) - held.n_cells[0] < 4 * len(bad) + 64:
            held = grown(held)
        made = _reconnect(held, bad, measure, target)
        bad = _worst_first(held, measure, target)
        if len(bad):
            made += _displace(held, node_rings(held), bad, is_frozen, measure, sides, target)
        bad = _worst_first(held, measure, target)
        if made == 0 and len(bad):
            done = mend(held, is_frozen, measure, sides, bad, target)
            held, is_frozen, made = done.held, done.is_frozen, done.n_split + done.n_collapsed
            source = np.where(done.source >= 0, source[done.source], -1)
        total += made
        if made == 0:
            break
    return Repaired(held, is_frozen, source, len(_worst_first(held, measure, target)), total)


def worst_angles(held: Complex, measure: Measure, floor: float) -> int:
    """How many cells have a smallest dihedral angle under `floor` degrees."""
    return int((qualities(held, measure) < -np.cos(np.radians(floor))).sum())


def _worst_first(held: Complex, measure: Measure, target: float) -> NDArray[np.int64]:
    quality = qualities(held, measure)
    bad = np.flatnonzero(quality < target)
    return bad[np.lexsort((bad, quality[bad]))]


@njit(cache=True, error_model="numpy")
def _reconnect(held: Complex, bad: NDArray, measure: Measure, target: float) -> int:
    """For each bad cell the flip that leaves the best worst angle in its cavity, if it is better than before."""
    room = len(held.cells)
    work = cavity(room, held.fluxes.shape[2])
    is_changed = np.zeros(room, dtype=np.bool_)
    made = 0
    for number in range(len(bad)):
        cell = bad[number]
        if is_changed[cell] or held.n_cells[0] + 2 * MOST > room:
            continue
        best, choice = 1e-4, -1  # the least gain
        for k in range(4):
            if held.across[cell, k] >= 0:
                gain = _gain_of_face(work.x, held, cell, k, measure, target)
                if gain > best:
                    best, choice = gain, k
        for e in range(6):
            m, is_open = ring_of_edge(work.ring, work.around, held, cell, EDGES[e, 0], EDGES[e, 1])
            gain = _gain_of_edge(work, held, cell, e, m, is_open, measure, target)
            if gain > best:
                best, choice = gain, 4 + e
        if choice < 0:
            continue
        if choice < 4:
            flip_face(work, held, cell, choice, is_changed, measure)
        else:
            e = choice - 4
            m, is_open = ring_of_edge(work.ring, work.around, held, cell, EDGES[e, 0], EDGES[e, 1])
            _gain_of_edge(work, held, cell, e, m, is_open, measure, target)
            a, b = held.cells[cell, EDGES[e, 0]], held.cells[cell, EDGES[e, 1]]
            if measure.image > 0.0:
                work.is_side[:] = False
                for i in range(m - 1):
                    for j in range(i + 1, m):
                        fill_side(work, held, a, b, i, j, m, is_open, measure)
            remove_edge(work, held, a, b, m, is_open, is_changed, measure)
        made += 1
    close_gaps(held, is_changed)
    return made


@njit(cache=True, error_model="numpy")
def _gain_of_face(x: NDArray, held: Complex, cell: int, k: int, measure: Measure, target: float) -> float:
    """By how much the worst angle of the cavity (its minus cosine, up to the target) grows in a face flip."""
    other = held.across[cell, k]
    old = min(cell_quality(x, held, cell, measure), cell_quality(x, held, other, measure))
    u, v, w = outward(held.cells, cell, k)
    p, q = held.cells[cell, k], held.cells[other, facet_of(held.cells, held.across, other, cell)]
    new = target
    for a, b in ((u, v), (v, w), (w, u)):
        new = min(new, tet_quality(x, held, p, q, a, b, measure))
        if new <= old:
            return -1.0
    return new - old


@njit(cache=True, error_model="numpy")
def _gain_of_edge(
    work: Cavity, held: Complex, cell: int, e: int, m: int, is_open: int, measure: Measure, target: float
) -> float:
    """The same for the removal of an edge; `work.apex` holds the triangulation."""
    x, ring, around, cost, apex, shape = work.x, work.ring, work.around, work.cost, work.apex, work.triangle
    a, b = held.cells[cell, EDGES[e, 0]], held.cells[cell, EDGES[e, 1]]
    if m < 3 or (is_open == 1 and not in_one_face(held, a, b, ring[0], ring[m - 1], measure)):
        return -1.0
    old = 1.0
    for r in range(m - is_open):
        old = min(old, cell_quality(x, held, around[r], measure))
    # A steep sum stands for the worst: exp(-40 q) of the worst cell outweighs all others that are 3 degrees better.
    for i in range(m - 2):
        for k in range(i + 1, m - 1):
            for j in range(k + 1, m):
                above = tet_quality(x, held, ring[i], ring[k], ring[j], b, measure)
                below = tet_quality(x, held, ring[i], ring[j], ring[k], a, measure)
                shape[i, k, j] = np.inf
                if min(above, below) > old:
                    shape[i, k, j] = np.exp(-40.0 * above) + np.exp(-40.0 * below)
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
        new = min(new, tet_quality(x, held, ring[i], ring[k], ring[j], b, measure))
        new = min(new, tet_quality(x, held, ring[i], ring[j], ring[k], a, measure))
        stack[height, 0], stack[height, 1] = i, k
        stack[height + 1, 0], stack[height + 1, 1] = k, j
        height += 2
    return new - old


@njit(cache=True, error_model="numpy")
def _displace(
    held: Complex, rings: NodeRings, bad: NDArray, is_frozen: NDArray, measure: Measure, sides: Sides, target: float
) -> int:
    """Move the nodes of each bad cell so that the worst angle of their rings grows, up to the target."""
    x = np.empty((4, 3))
    made = 0
    for number in range(len(bad)):
        for k in range(4):
            if cell_quality(x, held, bad[number], measure) >= target:
                break
            if _lift(x, held, rings, held.cells[bad[number], k], is_frozen, measure, sides, target):
                made += 1
    return made


@njit(cache=True, error_model="numpy")
def _ring_quality(x: NDArray, held: Complex, rings: NodeRings, node: int, measure: Measure, least: float) -> float:
    """The worst of a ring's cells; -2 if one is flat or inverted, and anything below `least` once that is passed."""
    worst = 1.0
    for r in range(rings.start[node], rings.start[node + 1]):
        c = held.cells[rings.cells[r]]
        worst = min(worst, tet_quality(x, held, c[0], c[1], c[2], c[3], measure))
        if worst < least:
            return worst
    return worst


@njit(cache=True, error_model="numpy")
def _lift(
    x: NDArray, held: Complex, rings: NodeRings, node: int, is_frozen: NDArray, measure: Measure, sides: Sides,
    target: float,
) -> bool:  # fmt: skip
    """Search along 26 directions, with ever smaller steps, for a place where the ring's worst angle is larger."""
    t = held.ticks
    first, last = rings.start[node], rings.start[node + 1]
    begin = _ring_quality(x, held, rings, node, measure, -3.0)
    best = begin
    start0, start1, start2 = t[node, 0], t[node, 1], t[node, 2]
    if best >= target:
        return False
    # The first step: a fifth of the ring's mean edge.
    edge, count = 0.0, 0
    for r in range(first, last):
        load_cell(x, t, held.cells, rings.cells[r], measure)
        at = rings.corner[r]
        for k in range(4):
            if k != at:
                edge += np.sqrt((x[k, 0] - x[at, 0]) ** 2 + (x[k, 1] - x[at, 1]) ** 2 + (x[k, 2] - x[at, 2]) ** 2)
                count += 1
    step = 0.25 * edge / count
    P = sides.projections[is_frozen[node, 0] + 2 * is_frozen[node, 1] + 4 * is_frozen[node, 2]]
    normal, slides = np.empty((2, 3)), is_frozen[node, 3]
    scale = 2.0**-measure.bits
    for _ in range(STEPS):
        improved = True
        while improved and best < target:
            improved = False
            here0, here1, here2 = t[node, 0], t[node, 1], t[node, 2]
            there0, there1, there2 = here0, here1, here2
            for code in range(27):
                if code == 13:
                    continue
                d0, d1, d2 = float(code // 9 - 1), float(code // 3 % 3 - 1), float(code % 3 - 1)
                size = step / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2) / scale
                t[node, 0] = here0 + np.int64(np.rint(size * (P[0, 0] * d0 + P[0, 1] * d1 + P[0, 2] * d2)))
                t[node, 1] = here1 + np.int64(np.rint(size * (P[1, 0] * d0 + P[1, 1] * d1 + P[1, 2] * d2)))
                t[node, 2] = here2 + np.int64(np.rint(size * (P[2, 0] * d0 + P[2, 1] * d1 + P[2, 2] * d2)))
                if slides and not slid(x, normal, held, rings, node, is_frozen, sides, measure):
                    continue
                quality = _ring_quality(x, held, rings, node, measure, best)
                if quality > best + 1e-4:
                    best = quality
                    there0, there1, there2 = t[node, 0], t[node, 1], t[node, 2]
                    improved = True
            t[node, 0], t[node, 1], t[node, 2] = there0, there1, there2
        step *= 0.5
    if best <= begin:
        t[node, 0], t[node, 1], t[node, 2] = start0, start1, start2
        return False
    trial, fluxes = np.empty(last - first), np.empty((last - first, 4, held.fluxes.shape[2]))
    if not np.isfinite(ring_energy(np.inf, -1.0, trial, fluxes, x, node, held, rings, measure)):
        t[node, 0], t[node, 1], t[node, 2] = start0, start1, start2
        return False
    store(held, rings, node, trial, fluxes, measure)
    return True
