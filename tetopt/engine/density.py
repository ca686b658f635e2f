"""Nodes put in and taken out where that lowers E: edges split at their middle, edges collapsed into one of their ends.

What a split or a collapse is worth is measured with the same energy as every other move. Splits always lower E_D and
collapses raise it, so it takes a number of nodes to weigh one against the other: nodes are exchanged, the cheapest
collapses for the splits that are worth more, at most as many as nodes are wanted. On a graded mesh (see
`tetopt.engine.complex.shape_energy`) a node's cells cost the same shape energy wherever it is, so that what is
exchanged is error of the image.

Each node looks at the edges to its neighbours and keeps its best split and its best collapse, all nodes at once; moves
are then made one after the other, the most worth first, each only if no cell around it has changed since. A move works
on a node's ring, so one code serves triangles and tetrahedra.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from tetopt.energy.sampling import few_threads
from tetopt.engine.complex import (
    Complex,
    Measure,
    NodeRings,
    cell_energy,
    cell_quality,
    cell_squares,
    content,
    corner_of,
    energies,
    facet_of,
    grown,
    has_node,
    image_energy,
    least_cosine,
    load,
    load_cell,
    measure_facet,
    node_rings,
    outward,
    put_flux,
    quality_up_to,
    shape_energy,
    shape_of_cell,
    sum_up,
    tet_quality,
    wrong_side,
)
from tetopt.engine.flips import close_gaps
from tetopt.engine.smooth import Blocks, blocks, colours_of, ring_energy
from tetopt.engine.surface import Sides, faces_up, put_on_surface, ring_faces_up, uphill_at

LEAST_GAIN = 1e-3  # of a node's mean share of E: an exchange of two nodes that is worth less is not made
LEAST_OVER_NOISE = (
    20.0  # of the noise's variance: likewise; about what the luckiest of thousands of edges wins in noise
)
ASTRAY = 0.25  # of an edge on a mask's surface: the furthest from its middle that a node is put
SHIFT = 0.1  # of the ring's volume: what a collapse on a mask's surface may add or take
NEIGHBOURS = 128  # edges of a node that are looked at, at most


class Exchanged(NamedTuple):
    """What `exchange` returns."""

    held: Complex
    is_frozen: NDArray[np.bool_]  # (N', 4)
    source: NDArray[np.int64]  # (N',) number of each node before; -1 for new ones
    is_touched: NDArray[np.bool_]  # (N',) nodes with a cell that has changed
    n_split: int
    n_collapsed: int


class Limits(NamedTuple):
    """On the edges that moves may make, mm."""

    shortest: float
    longest: NDArray[np.float64]  # (N,) at each node
    noise: float  # variance of the image's noise: what chance alone wins is not worth a node


def exchange(
    held: Complex, is_frozen: NDArray[np.bool_], measure: Measure, sides: Sides, n_nodes: int, most: int,
    limits: Limits,
) -> Exchanged:  # fmt: skip
    """One round of splits and collapses towards `n_nodes` nodes, and of exchanges of a node for another.

    Beyond those that the number asks for, up to `most` nodes are exchanged, as far as each lowers E. One round doubles
    the nodes at most. `held` and `is_frozen` (N, 4) are out of date afterwards.
    """
    n_before = len(held.ticks)
    more, most = min(max(n_nodes - n_before, -n_before), n_before), min(most, n_before)
    rings, groups = node_rings(held), blocks(held.ticks)
    held = roomy(held, n_before, 16 * (max(more, 0) + most))
    is_frozen = np.concatenate([is_frozen, np.zeros_like(is_frozen)])
    # Splits pay where the error is, collapses where it is not: half of the nodes are asked for each, unless many more,
    # or fewer, are wanted. It costs no E_D that could be measured, and half of the time.
    error = _ring_errors(held, n_before, measure.n_channels)
    middle = np.median(error)
    may_split = (error >= middle) | (more > n_before // 8)
    may_collapse = (error <= middle) | (more < -(n_before // 8))
    gain, split = best_splits(held, rings, is_frozen, measure, sides, may_split, limits.shortest)
    dearest = np.inf if more < 0 else float(np.sort(gain)[-max(most // 4, 1)])
    cost, collapse = best_collapses(
        held, rings, groups, is_frozen, measure, sides, dearest, may_collapse, limits.longest
    )
    in_, out = np.lexsort((np.arange(n_before), -gain)), np.lexsort((np.arange(n_before), cost))
    in_, out = in_[gain[in_] > -np.inf], out[cost[out] < np.inf]
    E_G, squares = energies(held, measure.n_channels)
    least = LEAST_GAIN * (measure.geometry * E_G + measure.image * squares) / n_before
    least = max(least, LEAST_OVER_NOISE * measure.image * limits.noise)
    is_dirty = np.zeros(len(held.cells), dtype=np.bool_)
    n_split, n_collapsed = make_exchanges(
        held, rings, is_frozen, measure, sides, in_, split, gain, out, collapse, cost, more, most, least, is_dirty
    )
    return _compacted(held, is_frozen, is_dirty, n_before, n_split, n_collapsed)


def _ring_errors(held: Complex, n_nodes: int, n_channels: int) -> NDArray[np.float64]:
    """Sum of squares around the cells' means over the cells around each node, (N,)."""
    cells = held.cells[: held.n_cells[0]]
    squares = np.repeat(cell_squares(held, n_channels), cells.shape[1])
    return np.bincount(cells.ravel(), squares, n_nodes).astype(np.float64)


def roomy(held: Complex, n_nodes: int, n_cells: int) -> Complex:
    """The complex with room for that many more nodes and cells; further rows of `ticks` are not nodes yet."""
    if len(held.cells) - held.n_cells[0] < n_cells:
        held = grown(held, n_cells)
    more = np.zeros((n_nodes, 3), dtype=held.ticks.dtype)
    return held._replace(ticks=np.concatenate([held.ticks, more]))


def _compacted(
    held: Complex, is_frozen: NDArray[np.bool_], is_dirty: NDArray[np.bool_], n_before: int, n_split: int,
    n_collapsed: int,
) -> Exchanged:  # fmt: skip
    """Nodes without cells left out, and the others numbered anew in their order."""
    n_cells = int(held.n_cells[0])
    cells = held.cells[:n_cells]
    is_used = np.zeros(n_before + n_split, dtype=bool)
    is_used[cells] = True
    number = np.cumsum(is_used) - 1
    held.cells[:n_cells] = number[cells]
    kept = np.flatnonzero(is_used)
    is_touched = np.zeros(len(kept), dtype=bool)
    is_touched[held.cells[:n_cells][is_dirty[:n_cells]]] = True
    return Exchanged(
        held._replace(ticks=held.ticks[kept]), is_frozen[kept], np.where(kept < n_before, kept, -1), is_touched,
        n_split, n_collapsed,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def make_exchanges(
    held: Complex, rings: NodeRings, is_frozen: NDArray, measure: Measure, sides: Sides, in_: NDArray, split: NDArray,
    gain: NDArray, out: NDArray, collapse: NDArray, cost: NDArray, more: int, most: int, least: float,
    is_dirty: NDArray,
) -> tuple:  # fmt: skip
    """Split edges of the nodes `in_`, or collapse the nodes `out`, until there are `more` nodes; then do both in pairs.

    In their order, and each only if none of its cells has changed; at most `most` pairs, each of which lowers E by more
    than `least`. Returns how many were split and collapsed.
    """
    n_nodes = len(rings.start) - 1
    n_split, n_collapsed, s, c = 0, 0, 0, 0
    while True:
        is_pair = n_split - n_collapsed == more
        if is_pair and min(n_split, n_collapsed) >= most:
            break
        does_split, does_collapse = is_pair or n_split - n_collapsed < more, is_pair or n_split - n_collapsed > more
        if does_split:
            while s < len(in_) and not _can_split(held, rings, in_[s], is_dirty):
                s += 1
            if s == len(in_):
                break
            _mark_edge(held, rings, in_[s], split[in_[s]], is_dirty, True)  # its partner is to be somewhere else
        if does_collapse:
            while c < len(out) and not _is_clean(rings, out[c], is_dirty):
                c += 1
        if does_collapse and (c == len(out) or (is_pair and gain[in_[s]] - cost[out[c]] <= least)):
            if does_split:
                _mark_edge(held, rings, in_[s], split[in_[s]], is_dirty, False)
            break
        if does_split:
            a, b, p = in_[s], split[in_[s]], n_nodes + n_split
            _put_middle(held, rings, is_frozen, sides, a, b, p, measure)
            split_edge(held, rings, a, b, p, is_dirty, measure)
            n_split += 1
        if does_collapse:
            collapse_edge(held, rings, out[c], collapse[out[c]], is_dirty, measure)
            n_collapsed += 1
    close_gaps(held, is_dirty)
    return n_split, n_collapsed


@njit(cache=True, error_model="numpy")
def _mark_edge(held: Complex, rings: NodeRings, a: int, b: int, is_dirty: NDArray, value: bool) -> None:
    for r in range(rings.start[a], rings.start[a + 1]):
        if has_node(held.cells, rings.cells[r], b):
            is_dirty[rings.cells[r]] = value


@njit(cache=True, error_model="numpy")
def _is_clean(rings: NodeRings, node: int, is_dirty: NDArray) -> bool:
    return not is_dirty[rings.cells[rings.start[node] : rings.start[node + 1]]].any()


@njit(cache=True, error_model="numpy")
def _can_split(held: Complex, rings: NodeRings, a: int, is_dirty: NDArray) -> bool:
    """Whether the cells around a are as they were, and there is room for more."""
    size = rings.start[a + 1] - rings.start[a]
    return held.n_cells[0] + size <= len(held.cells) and _is_clean(rings, a, is_dirty)


@njit(cache=True, error_model="numpy")
def _sides_of_edge(held: Complex, rings: NodeRings, sides: Sides, a: int, b: int) -> int:
    """The box's sides that an edge lies in, bit d for axis d, and bit 3 if it is on the boundary elsewhere.

    Asked are the boundary's facets at the edge, not its ends: they may lie in a side to which the edge is a crease.
    """
    found, t = 0, held.ticks
    for r in range(rings.start[a], rings.start[a + 1]):
        cell = rings.cells[r]
        if not has_node(held.cells, cell, b):
            continue
        for k in range(held.cells.shape[1]):
            if held.across[cell, k] >= 0 or held.cells[cell, k] == a or held.cells[cell, k] == b:
                continue
            side = 3
            for d in range(3):
                at = t[a, d]
                is_flat = at == sides.low[d] or at == sides.high[d]
                for m in range(held.cells.shape[1]):
                    is_flat = is_flat and (m == k or t[held.cells[cell, m], d] == at)
                if is_flat:
                    side = d
            found |= 1 << side
    return found


@njit(cache=True, error_model="numpy")
def _put_middle(
    held: Complex, rings: NodeRings, is_frozen: NDArray, sides: Sides, a: int, b: int, p: int, measure: Measure
) -> bool:
    """Put the node p at the middle of an edge, or on the surface beside it.

    False if that is on a boundary that is to stay, or the surface is not found.
    """
    found = _sides_of_edge(held, rings, sides, a, b)
    for d in range(3):
        held.ticks[p, d] = (held.ticks[a, d] + held.ticks[b, d]) >> 1
        is_frozen[p, d] = (found >> d) & 1 == 1
    is_frozen[p, 3] = found >= 8
    if found > 0 and sides.is_fixed:
        return False
    if found < 8:
        return True
    if not sides.has_surface:
        return False
    x, uphill = np.empty((4, 3)), np.empty((2, 3))
    load(x, 1, held.ticks, p, a, measure)
    if not put_on_surface(uphill, held.ticks, p, is_frozen, sides, measure):
        return False
    load(x, 2, held.ticks, p, a, measure)
    away = (x[2, 0] - x[1, 0]) ** 2 + (x[2, 1] - x[1, 1]) ** 2 + (x[2, 2] - x[1, 2]) ** 2
    if away > ASTRAY * ASTRAY * squared_length(x, held, a, b, measure):
        return False
    uphill_at(uphill, held.ticks, p, sides, measure)
    for r in range(rings.start[a], rings.start[a + 1]):
        cell = rings.cells[r]
        for k in range(held.cells.shape[1]):
            is_outer = held.across[cell, k] < 0 and held.cells[cell, k] not in (a, b)
            if is_outer and has_node(held.cells, cell, b):
                for node in (a, b):
                    if not faces_up(x, held, cell, k, node, p, uphill, sides, measure):
                        return False
    return True


def mend(
    held: Complex, is_frozen: NDArray[np.bool_], measure: Measure, sides: Sides, bad: NDArray[np.int64], target: float
) -> Exchanged:
    """For each bad cell the collapse or split of one of its edges that leaves the best worst angle, if any is better.

    Quality is minus the cosine of the smallest dihedral angle, counted up to `target`. Cells of `bad` come worst first.
    """
    n_before = len(held.ticks)
    rings = node_rings(held)
    held = roomy(held, len(bad), 16 * len(bad))
    is_frozen = np.concatenate([is_frozen, np.zeros((len(bad), 4), dtype=bool)])
    is_dirty = np.zeros(len(held.cells), dtype=np.bool_)
    n_split, n_collapsed = _mend(held, rings, is_frozen, measure, sides, bad, target, is_dirty)
    return _compacted(held, is_frozen, is_dirty, n_before, n_split, n_collapsed)


@njit(cache=True, error_model="numpy")
def _mend(
    held: Complex, rings: NodeRings, is_frozen: NDArray, measure: Measure, sides: Sides, bad: NDArray, target: float,
    is_dirty: NDArray,
) -> tuple:  # fmt: skip
    x = np.empty((4, 3))
    n_split, n_collapsed, n_nodes = 0, 0, len(rings.start) - 1
    for cell in bad:
        best, best_a, best_b, is_split = 1e-4, -1, -1, False  # the least gain
        for i in range(4):
            a = held.cells[cell, i]
            if is_dirty[cell] or not _is_clean(rings, a, is_dirty):
                continue
            for j in range(4):
                b, p = held.cells[cell, j], n_nodes + n_split
                if i == j:
                    continue
                gain = _lift_by_collapse(x, held, rings, is_frozen, sides, a, b, measure, target)
                if gain > best:
                    best, best_a, best_b, is_split = gain, a, b, False
                if i < j and _can_split(held, rings, a, is_dirty):
                    may_split = _put_middle(held, rings, is_frozen, sides, a, b, p, measure)
                    gain = _lift_by_split(x, held, rings, a, b, p, measure, target) if may_split else -1.0
                    if gain > best:
                        best, best_a, best_b, is_split = gain, a, b, True
        if best_a >= 0 and is_split:
            p = n_nodes + n_split
            _put_middle(held, rings, is_frozen, sides, best_a, best_b, p, measure)
            split_edge(held, rings, best_a, best_b, p, is_dirty, measure)
            n_split += 1
        elif best_a >= 0:
            collapse_edge(held, rings, best_a, best_b, is_dirty, measure)
            n_collapsed += 1
    close_gaps(held, is_dirty)
    return n_split, n_collapsed


@njit(cache=True, error_model="numpy")
def _lift_by_collapse(
    x: NDArray, held: Complex, rings: NodeRings, is_frozen: NDArray, sides: Sides, a: int, b: int, measure: Measure,
    target: float,
) -> float:  # fmt: skip
    """By how much the worst quality around a grows if a is joined to b."""
    t = held.ticks
    if not may_join(t, is_frozen, a, b):
        return -1.0
    here0, here1, here2 = t[a, 0], t[a, 1], t[a, 2]
    old, new, size = target, target, 0.0
    for r in range(rings.start[a], rings.start[a + 1]):
        old = min(old, cell_quality(x, held, rings.cells[r], measure))
        size += content(x, 4)
    t[a, 0], t[a, 1], t[a, 2] = t[b, 0], t[b, 1], t[b, 2]
    for r in range(rings.start[a], rings.start[a + 1]):
        if new > old and not has_node(held.cells, rings.cells[r], b):
            c = held.cells[rings.cells[r]]
            new = min(new, tet_quality(x, held, c[0], c[1], c[2], c[3], measure))
    is_whole = new > old and _keeps_domain(x, held, rings, is_frozen, a, b, size, sides, measure)
    t[a, 0], t[a, 1], t[a, 2] = here0, here1, here2
    return new - old if is_whole else -1.0


@njit(cache=True, error_model="numpy")
def _lift_by_split(
    x: NDArray, held: Complex, rings: NodeRings, a: int, b: int, p: int, measure: Measure, target: float
) -> float:
    """By how much the worst quality around the edge (a, b) grows if it is split at p."""
    old, new = target, target
    for r in range(rings.start[a], rings.start[a + 1]):
        cell = rings.cells[r]
        if has_node(held.cells, cell, b):
            old = min(old, cell_quality(x, held, cell, measure))
            for node in (a, b):
                if not _shape_with(x, held, cell, node, p, measure) < np.inf:
                    return -1.0
                new = min(new, least_cosine(x))
    return new - old


# Splits.


def best_splits(
    held: Complex, rings: NodeRings, is_frozen: NDArray[np.bool_], measure: Measure, sides: Sides,
    is_wanted: NDArray[np.bool_], shortest: float,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:  # fmt: skip
    """How much E falls if the best edge of each node that is wanted is split, (N,), and where that leads, (N,).

    -inf and -1 where none can be split above the floor, without an edge under `shortest` mm; an edge of two nodes that
    are wanted counts for the lower one.
    Rows N to 2 N of `held.ticks` and `is_frozen` are written to.
    """
    n_nodes = len(is_wanted)
    gain, split = np.full(n_nodes, -np.inf), np.full(n_nodes, -1, dtype=np.int64)
    with few_threads(n_nodes * 20):
        _fill_splits(gain, split, held, rings, is_frozen, measure, sides, is_wanted, shortest)
    return gain, split


@njit(cache=True, parallel=True, error_model="numpy")
def _fill_splits(
    gain: NDArray, split: NDArray, held: Complex, rings: NodeRings, is_frozen: NDArray, measure: Measure, sides: Sides,
    is_wanted: NDArray, shortest: float,
) -> None:  # fmt: skip
    for node in prange(len(gain)):
        if is_wanted[node]:
            _best_split(np.int64(node), gain, split, held, rings, is_frozen, measure, sides, is_wanted, shortest)


@njit(cache=True, error_model="numpy")
def _best_split(
    a: int, gain: NDArray, split: NDArray, held: Complex, rings: NodeRings, is_frozen: NDArray, measure: Measure,
    sides: Sides, is_wanted: NDArray, shortest: float,
) -> None:  # fmt: skip
    n_nodes = len(is_wanted)
    x, near = np.empty((4, 3)), np.empty(NEIGHBOURS, dtype=np.int64)
    for number in range(_neighbours(near, held, rings, a)):
        b, p = near[number], n_nodes + a
        if (b < a and is_wanted[b]) or squared_length(x, held, a, b, measure) < 4.0 * shortest * shortest:
            continue
        is_there = _put_middle(held, rings, is_frozen, sides, a, b, p, measure)
        if is_there and _is_long(x, held, rings, a, b, p, shortest, measure):
            worth = worth_of_split(x, held, rings, a, b, p, measure, gain[a])
            if worth > gain[a]:
                gain[a], split[a] = worth, b


@njit(cache=True, error_model="numpy")
def _is_long(
    x: NDArray, held: Complex, rings: NodeRings, a: int, b: int, p: int, shortest: float, measure: Measure
) -> bool:
    """Whether no edge from p to the other corners of the cells around the edge (a, b) is shorter than that."""
    if shortest <= 0.0:
        return True
    for r in range(rings.start[a], rings.start[a + 1]):
        cell = rings.cells[r]
        if has_node(held.cells, cell, b):
            for k in range(held.cells.shape[1]):
                if squared_length(x, held, p, held.cells[cell, k], measure) < shortest * shortest:
                    return False
    return True


@njit(cache=True, error_model="numpy")
def _neighbours(near: NDArray, held: Complex, rings: NodeRings, node: int) -> int:
    """The nodes that share a cell with `node`, to `near`, as many as it takes; how many."""
    count = 0
    for r in range(rings.start[node], rings.start[node + 1]):
        for k in range(held.cells.shape[1]):
            other = held.cells[rings.cells[r], k]
            is_new = other != node
            for m in range(count):
                is_new = is_new and near[m] != other
            if is_new and count < len(near):
                near[count] = other
                count += 1
    return count


@njit(cache=True, error_model="numpy")
def worth_of_split(
    x: NDArray, held: Complex, rings: NodeRings, a: int, b: int, p: int, measure: Measure, least_gain: float
) -> float:
    """How much E falls if the edge (a, b) is split at p; -inf if it cannot be, or by less than `least_gain`."""
    n = held.cells.shape[1]
    old, shape = 0.0, 0.0
    for r in range(rings.start[a], rings.start[a + 1]):
        cell = rings.cells[r]
        if not has_node(held.cells, cell, b):
            continue
        old += cell_energy(held, cell, measure)
        least = measure.floor if n == 4 else -1.0
        if least > -1.0:
            shape_of_cell(x, held.ticks, held.cells, cell, measure)
            least = min(least, quality_up_to(x, measure))
        for node in (a, b):
            shape += measure.geometry * _shape_with(x, held, cell, node, p, measure)
            if not shape < np.inf:
                return -np.inf
            if least > -1.0 and quality_up_to(x, measure) < least:
                return -np.inf
    if old - shape <= least_gain and measure.surface == 0.0:
        return -np.inf
    if measure.image == 0.0:
        return old - shape
    new, misfit, D = shape, 0.0, held.sums.shape[1]
    flux, sums = np.empty((1, 1, D)), np.empty((2, D))
    for r in range(rings.start[a], rings.start[a + 1]):
        cell = rings.cells[r]
        if has_node(held.cells, cell, b):
            i, j = corner_of(held.cells, cell, a), corner_of(held.cells, cell, b)
            _put_flux_with(flux, held, cell, i, b, p, measure)
            for d in range(D):
                sums[0, d] = held.fluxes[cell, j, d] + flux[0, 0, d]
                sums[1, d] = held.fluxes[cell, i, d] - flux[0, 0, d]
            for k in range(n):
                if k not in (i, j):
                    for half, node in ((0, b), (1, a)):
                        _put_flux_with(flux, held, cell, k, node, p, measure)
                        for d in range(D):
                            sums[half, d] += flux[0, 0, d]
            for half in range(2):
                new += measure.image * image_energy(sums, half, measure.n_channels)
                misfit += wrong_side(sums, half, measure)
            misfit -= wrong_side(held.sums, cell, measure)
            if old - new <= least_gain and measure.surface == 0.0:  # else the misfit may fall yet
                return -np.inf
    worth = old - new - misfit
    return worth if worth > least_gain else -np.inf


@njit(cache=True, error_model="numpy")
def _shape_with(x: NDArray, held: Complex, cell: int, node: int, p: int, measure: Measure) -> float:
    """Shape energy of a cell with p in the place of its corner `node`; the corners are left in x."""
    k = corner_of(held.cells, cell, node)
    base = held.cells[cell, 0] if k > 0 else p
    for m in range(held.cells.shape[1]):
        load(x, m, held.ticks, p if m == k else held.cells[cell, m], base, measure)
    return shape_energy(x, held.cells.shape[1], measure.power, measure.is_graded)


@njit(cache=True, error_model="numpy")
def _put_flux_with(flux: NDArray, held: Complex, cell: int, k: int, node: int, p: int, measure: Measure) -> None:
    """Flux of facet k of a cell with p in the place of `node`, outwards, to flux[0, 0, :]."""
    a, b, c = outward(held.cells, cell, k)
    a, b, c = p if a == node else a, p if b == node else b, p if c == node and c >= 0 else c
    put_flux(flux, 0, 0, held.ticks, a, b, c, measure)


@njit(cache=True, error_model="numpy")
def split_edge(held: Complex, rings: NodeRings, a: int, b: int, p: int, is_dirty: NDArray, measure: Measure) -> None:
    """Each cell of the edge (a, b) becomes two: it keeps a, with p for b; a new one has b, with p for a."""
    n = held.cells.shape[1]
    first, last = rings.start[a], rings.start[a + 1]
    x, new = np.empty((4, 3)), np.full(last - first, -1, dtype=np.int64)
    for r in range(first, last):
        if has_node(held.cells, rings.cells[r], b):
            new[r - first] = held.n_cells[0]
            held.n_cells[0] += 1
    for r in range(first, last):
        cell, other = rings.cells[r], new[r - first]
        if other < 0:
            continue
        i, j = corner_of(held.cells, cell, a), corner_of(held.cells, cell, b)
        held.cells[other] = held.cells[cell]
        held.across[other] = held.across[cell]
        held.fluxes[other] = held.fluxes[cell]
        held.cells[other, i] = p
        beyond = held.across[cell, i]
        if beyond >= 0:
            held.across[beyond, facet_of(held.cells, held.across, beyond, cell)] = other
        held.across[other, j] = cell
        for k in range(n):
            if k not in (i, j) and held.across[cell, k] >= 0:
                for s in range(first, last):
                    if rings.cells[s] == held.across[cell, k]:
                        held.across[other, k] = new[s - first]
    for r in range(first, last):  # only now: the old corners have told the new neighbours
        cell, other = rings.cells[r], new[r - first]
        if other < 0:
            continue
        i, j = corner_of(held.cells, cell, a), corner_of(held.cells, cell, b)
        held.cells[cell, j] = p
        held.across[cell, i] = other
        for child, back in ((cell, i), (other, j)):
            for k in range(n):
                if measure.image > 0.0 and (k == back or k not in (i, j)):
                    measure_facet(held, child, k, measure)
            held.E_shape[child] = shape_of_cell(x, held.ticks, held.cells, child, measure)
            sum_up(held.sums, held.fluxes, child)
            is_dirty[child] = True


# Collapses.


def best_collapses(
    held: Complex,
    rings: NodeRings,
    groups: Blocks,
    is_frozen: NDArray[np.bool_],
    measure: Measure,
    sides: Sides,
    dearest: float,
    is_wanted: NDArray[np.bool_],
    longest: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """How much E rises if each node that is wanted is joined to its best neighbour, (N,), and which that is, (N,).

    inf and -1 where there is none that leaves a mesh above the floor, or for `dearest` at most.
    """
    n_nodes = len(rings.start) - 1
    cost, collapse = np.full(n_nodes, np.inf), np.full(n_nodes, -1, dtype=np.int64)
    bare = measure._replace(image=0.0)
    for chosen in colours_of(held, rings, groups):
        with few_threads(len(chosen) * 10_000):
            _fill_collapses(
                cost,
                collapse,
                held,
                rings,
                groups,
                chosen,
                is_frozen,
                measure,
                bare,
                sides,
                dearest,
                is_wanted,
                longest,
            )
    return cost, collapse


@njit(cache=True, parallel=True, error_model="numpy")
def _fill_collapses(
    cost: NDArray, collapse: NDArray, held: Complex, rings: NodeRings, groups: Blocks, chosen: NDArray,
    is_frozen: NDArray, measure: Measure, bare: Measure, sides: Sides, dearest: float, is_wanted: NDArray,
    longest: NDArray,
) -> None:  # fmt: skip
    for number in prange(len(chosen)):
        for at in range(groups.start[chosen[number]], groups.start[chosen[number] + 1]):
            if is_wanted[groups.nodes[at]]:
                _best_collapse(
                    groups.nodes[at], cost, collapse, held, rings, is_frozen, measure, bare, sides, dearest, longest
                )


@njit(cache=True, error_model="numpy")
def _best_collapse(
    a: int, cost: NDArray, collapse: NDArray, held: Complex, rings: NodeRings, is_frozen: NDArray, measure: Measure,
    bare: Measure, sides: Sides, dearest: float, longest: NDArray,
) -> None:  # fmt: skip
    """The neighbour to which `a` is best joined. It is moved there and back: cells of other groups do not see it."""
    if is_frozen[a, 0] and is_frozen[a, 1] and is_frozen[a, 2]:
        return
    n, t = held.cells.shape[1], held.ticks
    first, last = rings.start[a], rings.start[a + 1]
    x, near, shapes = np.empty((4, 3)), np.empty(NEIGHBOURS, dtype=np.int64), np.full(NEIGHBOURS, np.inf)
    trial, fluxes = np.empty(last - first), np.empty((last - first, n, held.fluxes.shape[2]))
    old, least, size = 0.0, measure.floor if n == 4 else -1.0, 0.0
    for r in range(first, last):
        old += cell_energy(held, rings.cells[r], measure)
        load_cell(x, t, held.cells, rings.cells[r], measure)
        size += content(x, n)
        if least > -1.0:
            least = min(least, quality_up_to(x, measure))
    here0, here1, here2 = t[a, 0], t[a, 1], t[a, 2]
    count = _neighbours(near, held, rings, a)
    best = old + dearest
    for number in range(count):  # shapes are cheap, and a lower bound
        b = near[number]
        if may_join(t, is_frozen, a, b) and _is_short(x, held, near, count, a, b, longest, measure):
            t[a, 0], t[a, 1], t[a, 2] = t[b, 0], t[b, 1], t[b, 2]
            shapes[number] = ring_energy(best, least, trial, fluxes, x, a, held, rings, bare, b)
            if shapes[number] < np.inf and not _keeps_domain(x, held, rings, is_frozen, a, b, size, sides, measure):
                shapes[number] = np.inf
            t[a, 0], t[a, 1], t[a, 2] = here0, here1, here2
    for _ in range(count):
        number = int(np.argmin(shapes))
        if not shapes[number] < best:
            break
        b, value = near[number], shapes[number]
        shapes[number] = np.inf
        if measure.image > 0.0:
            t[a, 0], t[a, 1], t[a, 2] = t[b, 0], t[b, 1], t[b, 2]
            value = ring_energy(best, least, trial, fluxes, x, a, held, rings, measure, b)
            t[a, 0], t[a, 1], t[a, 2] = here0, here1, here2
        if value < best:
            best, cost[a], collapse[a] = value, value - old, b


@njit(cache=True, error_model="numpy")
def squared_length(x: NDArray, held: Complex, a: int, b: int, measure: Measure) -> float:
    """Squared distance of two nodes, mm^2."""
    load(x, 0, held.ticks, b, a, measure)
    return x[0, 0] * x[0, 0] + x[0, 1] * x[0, 1] + x[0, 2] * x[0, 2]


@njit(cache=True, error_model="numpy")
def _is_short(
    x: NDArray, held: Complex, near: NDArray, count: int, a: int, b: int, longest: NDArray, measure: Measure
) -> bool:
    """Whether no edge from b to a neighbour of a is longer than the bound at its ends, or than the longest was."""
    old = 0.0
    for m in range(count):
        old = max(old, squared_length(x, held, a, near[m], measure))
    for m in range(count):
        square = squared_length(x, held, b, near[m], measure)
        if square > old and square > min(longest[b], longest[near[m]]) ** 2:
            return False
    return True


@njit(cache=True, error_model="numpy")
def may_join(ticks: NDArray, is_frozen: NDArray, a: int, b: int) -> bool:
    """Whether a may go where b is: it has to stay in the sides of the box that it is in, and on the surface.

    The ring would lose volume otherwise (`_keeps_size`), which costs more to find out.
    """
    may = not is_frozen[a, 3] or is_frozen[b, 3]
    for d in range(3):
        may = may and (not is_frozen[a, d] or (is_frozen[b, d] and ticks[a, d] == ticks[b, d]))
    return may


@njit(cache=True, error_model="numpy")
def _keeps_domain(
    x: NDArray, held: Complex, rings: NodeRings, is_frozen: NDArray, a: int, b: int, size: float, sides: Sides,
    measure: Measure,
) -> bool:  # fmt: skip
    """Whether the mesh still covers what it should with a at the place of b; `size` is n! times the ring's volume."""
    if not is_frozen[a, 3]:
        return _keeps_size(x, held, rings, a, b, size, measure)
    return (
        _keeps_size(x, held, rings, a, b, size, measure, SHIFT)
        and _is_linked(held, rings, a, b)
        and ring_faces_up(x, np.empty((2, 3)), held, rings, a, b, sides, measure)
    )


@njit(cache=True, error_model="numpy")
def _is_linked(held: Complex, rings: NodeRings, a: int, b: int) -> bool:
    """Whether a boundary edge may be collapsed without closing a hole or a gap (Dey et al. 1999).

    It has to lie on the boundary, and a node next to both of its ends must be so by a cell with both, on the boundary
    by a facet with both.
    """
    near, n = np.empty(NEIGHBOURS, dtype=np.int64), held.cells.shape[1]
    edge = _is_outer(held, rings, a, b, -1)
    for number in range(_neighbours(near, held, rings, a)):
        c = near[number]
        has_both, is_next = False, False
        for r in range(rings.start[b], rings.start[b + 1]):
            if has_node(held.cells, rings.cells[r], c):
                is_next = True
                has_both = has_both or has_node(held.cells, rings.cells[r], a)
        if c == b or not is_next:
            continue
        if not has_both:
            return False
        are_outer = n == 4 and _is_outer(held, rings, a, c, -1) and _is_outer(held, rings, b, c, -1)
        if are_outer and not _is_outer(held, rings, a, b, c):
            return False
    return edge


@njit(cache=True, error_model="numpy")
def _is_outer(held: Complex, rings: NodeRings, a: int, b: int, c: int) -> bool:
    """Whether a facet of the boundary has the nodes a and b, and c unless that is -1."""
    for r in range(rings.start[a], rings.start[a + 1]):
        cell = rings.cells[r]
        if has_node(held.cells, cell, b) and (c < 0 or has_node(held.cells, cell, c)):
            for k in range(held.cells.shape[1]):
                node = held.cells[cell, k]
                if held.across[cell, k] < 0 and node not in (a, b, c):
                    return True
    return False


@njit(cache=True, error_model="numpy")
def _keeps_size(
    x: NDArray, held: Complex, rings: NodeRings, a: int, b: int, size: float, measure: Measure, part: float = 1e-9
) -> bool:
    """Whether the cells around a, moved to b, fill what they filled: n! times their volume is `size`.

    All cells positive, they fan out from b over the ring's hull; so this holds unless the domain itself is not convex
    there.
    """
    total = 0.0
    for r in range(rings.start[a], rings.start[a + 1]):
        if not has_node(held.cells, rings.cells[r], b):
            load_cell(x, held.ticks, held.cells, rings.cells[r], measure)
            total += content(x, held.cells.shape[1])
    return abs(total - size) <= part * size


@njit(cache=True, error_model="numpy")
def collapse_edge(held: Complex, rings: NodeRings, a: int, b: int, is_dirty: NDArray, measure: Measure) -> None:
    """Node a becomes b: cells with both go, and the others around a have b instead."""
    n = held.cells.shape[1]
    first, last = rings.start[a], rings.start[a + 1]
    x = np.empty((4, 3))
    for r in range(first, last):
        cell = rings.cells[r]
        is_dirty[cell] = True
        if not has_node(held.cells, cell, b):
            continue
        # What lay beyond its facets opposite a and b are neighbours now.
        i, j = corner_of(held.cells, cell, a), corner_of(held.cells, cell, b)
        of_b, of_a = held.across[cell, i], held.across[cell, j]
        if of_a >= 0:
            k = facet_of(held.cells, held.across, of_a, cell)
            held.across[of_a, k] = of_b
        if of_b >= 0:
            held.across[of_b, facet_of(held.cells, held.across, of_b, cell)] = of_a
    for r in range(first, last):
        cell = rings.cells[r]
        if has_node(held.cells, cell, b):
            held.cells[cell, 0] = -1
            continue
        i = corner_of(held.cells, cell, a)
        held.cells[cell, i] = b
        for k in range(n):
            if measure.image > 0.0 and k != i:
                measure_facet(held, cell, k, measure)
        held.E_shape[cell] = shape_of_cell(x, held.ticks, held.cells, cell, measure)
        sum_up(held.sums, held.fluxes, cell)
