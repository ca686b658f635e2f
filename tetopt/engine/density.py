"""Insert and remove nodes where that lowers E: split edges at their middle, or collapse them to one
of their ends.

The gain of a split or a collapse is measured with the same energy as every other move. Splits
always lower E_D and collapses raise it, so a number of nodes is needed to balance them: nodes are
exchanged, the cheapest collapses for splits with a larger gain, up to a requested number. On a
graded mesh (see `tetopt.engine.complex.shape_energy`) the cells of a node have the same shape
energy everywhere, so that exchanges trade only the error of the image.

Each node evaluates the edges to its neighbours and keeps its best split and its best collapse, all
nodes in parallel. Moves are then made one after the other, the largest gain first, each only if no
cell around it has changed. A move works on a node's star, so that the same code serves triangles
and tetrahedra.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.engine.complex import (
    NODE_ROWS,
    NodeStars,
    State,
    cell_cosine,
    cell_energy,
    cell_squares,
    corner_of,
    cosine_up_to_limit,
    energies,
    facet_of,
    grow_state,
    has_node,
    image_energy,
    is_interface,
    load,
    load_cell,
    measure_facet,
    node_stars,
    outward,
    place,
    put_flux,
    settle,
    shape_energy,
    shape_of_cell,
    signed_volume,
    tet_cosine,
    worst_cosine,
    wrong_side,
)
from tetopt.engine.flips import close_gaps
from tetopt.engine.sliding import (
    MOST_MEETING,
    faces_up,
    insert_label,
    is_among,
    put_on_surface,
    star_faces_up,
    uphill_at,
)
from tetopt.engine.smooth import (
    Blocks,
    blocks,
    colours_of,
    star_energy,
    star_misfit,
    star_shape,
    trial_of,
)
from tetopt.geometry.topology import compact
from tetopt.geometry.vectors import dot, minus, put_row, row
from tetopt.start.sizes import LONG_EDGE
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernels import (
    Bools1,
    Floats1,
    Floats2,
    Ints1,
    Ints2,
    entry,
    helper,
    pack_record,
    run,
    unit,
)

# Of a node's mean part of E: least gain of a split considered. The last one made in a round gains
# 0.4 to 0.8.
LEAST_SPLIT_FRACTION = 0.2
LEAST_EXCHANGE_FRACTION = 1e-3  # of a node's mean part of E: least gain of an exchange of two nodes
# Of the noise's variance: the same; about the largest gain by chance among thousands of edges in
# noise.
LEAST_OVER_NOISE = 20.0
# of an edge on a mask's surface: the farthest that a node is put from its middle
MIDDLE_SHIFT_FRACTION = 0.25
# of the star's volume: the largest change by a collapse on a mask's surface
SURFACE_VOLUME_FRACTION = 0.1
ROUNDING_FRACTION = 1e-9  # of the star's volume: the same elsewhere, where it is only rounding
MAX_NEIGHBOURS = 128  # most edges of a node that are evaluated
# Bonus for splitting an edge that is too long for its target, times the square of its length over
# the target: E starts at about 1, so that such splits come before all others, and E's digits are
# kept.
TARGET_CREDIT = 1e4
LEAST_LIFT_COSINE = 1e-4  # least growth of a worst angle's negative cosine for a move


class Exchanged(NamedTuple):
    """Result of `exchange` and `mend`."""

    state: State
    source: Ints  # (N',) number of each node before; -1 for new ones
    is_touched: Bools  # (N',) nodes with a cell that has changed
    n_split: int
    n_collapsed: int


class Limits(NamedTuple):
    """Limits that moves must respect."""

    shortest: float  # mm: no split makes a shorter edge
    longest: Floats1  # (N,) mm: no collapse makes a longer edge at a node
    noise: float  # variance of the image's noise: gains by chance are not worth a node
    target: Floats1  # (N,) mm: edges longer than sqrt 2 times this are split first
    dearest: float = np.inf  # largest rise of E in a collapse
    least: float = -np.inf  # E must fall by more in a split


class EdgeMoves(NamedTuple):
    """For each node the best split, or the best collapse, of one of its edges."""

    may_move: Bools1  # (N,) nodes to evaluate
    other: Ints1  # (N,) the edge's other end; -1 if no edge is allowed
    gain: Floats1  # (N,) reduction of E; negative if it rises, -inf without an edge


def exchange(state: State, n_nodes: int, most: int, limits: Limits) -> Exchanged:
    """One round of splits and collapses towards `n_nodes` nodes, and of exchanges of a node for
    another.

    Beyond the moves that the number requires, up to `most` nodes are exchanged if each exchange
    lowers E, or splits an edge that is too long for its target. One round at most doubles the
    nodes. Afterwards the complex of `state` is out of date.
    """
    n_before = len(state.complex.ticks)
    more, most = min(max(n_nodes - n_before, -n_before), n_before), min(most, n_before)
    stars, groups = node_stars(state), blocks(state.complex.ticks)
    state = roomy(state, n_before, 16 * (max(more, 0) + most))
    E_G, squares = energies(state)
    E = state.objective.geometry * E_G + state.objective.image * squares
    # Splits pay where the error is large, collapses where it is small: half of the nodes are
    # evaluated for each, unless many nodes must be inserted or removed. This raises E_D by no
    # measurable amount, and saves half of the time.
    error = _star_errors(state, n_before)
    middle = np.median(error)
    may_split = (error >= middle) | (more > n_before // 8) | too_long(state, limits.target)
    least = LEAST_SPLIT_FRACTION * E / n_before if more <= 0 else -np.inf
    splits = best_splits(state, stars, may_split, limits._replace(least=least))
    # edges that are too long are split at any cost
    is_sized = bool((splits.gain >= TARGET_CREDIT).any())
    in_ = _best_first(splits)
    dearest = (
        np.inf
        if more < 0 or is_sized
        else float(splits.gain[in_[: max(most // 4, 1)]].min(initial=np.inf))
    )
    may_collapse = (error <= middle) | (more < -(n_before // 8)) | is_sized
    collapses = best_collapses(state, stars, groups, may_collapse, limits._replace(dearest=dearest))
    least = max(
        LEAST_EXCHANGE_FRACTION * E / n_before,
        LEAST_OVER_NOISE * state.objective.image * limits.noise,
    )
    is_dirty = np.zeros(len(state.complex.cells), dtype=np.bool_)
    out = _best_first(collapses)
    n_split, n_collapsed = make_exchanges(
        state, stars, splits, collapses, in_, out, (more, most, least), is_dirty
    )
    return compact_state(state, is_dirty, n_before, n_split, n_collapsed)


def too_long(state: State, target: Floats) -> Bools:
    """Nodes with an edge longer than sqrt 2 times its target, (N,)."""
    is_one = np.zeros(len(target), dtype=np.bool_)
    if np.isfinite(target).any():
        _fill_too_long(is_one, state, target)
    return is_one


@entry
def _fill_too_long(is_one: Bools1, state: State, target: Floats1) -> None:
    cells = state.complex.cells
    for cell in range(state.complex.n_cells[0]):
        for i in range(cells.shape[1]):
            for j in range(i):
                a, b = cells[cell, i], cells[cell, j]
                if squared_ratio(state, a, b, target) > LONG_EDGE * LONG_EDGE:
                    is_one[a] = is_one[b] = True


@helper
def squared_ratio(state: State, a: int, b: int, target: NDArray) -> float:
    """Square of an edge's length over its target (the mean of both ends' targets); 0 without a
    target.
    """
    return squared_length(state, a, b) / (0.25 * (target[a] + target[b]) ** 2)


def _best_first(moves: EdgeMoves) -> Ints:
    """The nodes that have a move, the largest gain first."""
    order = np.lexsort((np.arange(len(moves.gain)), -moves.gain))
    return order[moves.gain[order] > -np.inf]


def _star_errors(state: State, n_nodes: int) -> Floats:
    """Sum of squares around the cells' means over the cells around each node, (N,)."""
    cells = state.complex.cells[: state.complex.n_cells[0]]
    squares = np.repeat(cell_squares(state), cells.shape[1])
    return np.bincount(cells.ravel(), squares, n_nodes).astype(np.float64)


def roomy(state: State, n_nodes: int, n_cells: int) -> State:
    """The state with space for more nodes and cells; the additional rows of `ticks` are not
    nodes yet.
    """
    if len(state.complex.cells) - state.complex.n_cells[0] < n_cells:
        state = grow_state(state, n_cells)
    ticks = np.concatenate([state.complex.ticks, np.zeros((n_nodes, 3), dtype=np.int64)])
    is_frozen = np.concatenate([state.complex.is_frozen, np.zeros((n_nodes, 4), dtype=np.bool_)])
    meeting = np.concatenate([state.complex.meeting, np.full((n_nodes, 4), -1, dtype=np.int64)])
    band, offset = (
        np.concatenate([rows, np.zeros(n_nodes)])
        for rows in (state.complex.band, state.complex.offset)
    )
    complex_ = state.complex._replace(
        ticks=ticks, is_frozen=is_frozen, meeting=meeting, band=band, offset=offset
    )
    return state._replace(complex=complex_)


def compact_state(
    state: State,
    is_dirty: Bools | None = None,
    n_before: int | None = None,
    n_split: int = 0,
    n_collapsed: int = 0,
) -> Exchanged:
    """Remove nodes without cells, and renumber the others in their order."""
    n_cells = int(state.complex.n_cells[0])
    is_dirty = np.zeros(n_cells, dtype=np.bool_) if is_dirty is None else is_dirty
    n_before = len(state.complex.ticks) if n_before is None else n_before
    cells = state.complex.cells[:n_cells]
    kept, cells[:] = compact(cells, n_before + n_split)
    is_touched = np.zeros(len(kept), dtype=bool)
    is_touched[cells[is_dirty[:n_cells]]] = True
    old = state.complex
    nodes = {name: getattr(old, name)[kept] for name in NODE_ROWS}
    complex_ = old._replace(**nodes)
    source = np.where(kept < n_before, kept, -1)
    return Exchanged(state._replace(complex=complex_), source, is_touched, n_split, n_collapsed)


@entry
def make_exchanges(
    state: State,
    stars: NodeStars,
    splits: EdgeMoves,
    collapses: EdgeMoves,
    in_: Ints1,
    out: Ints1,
    quota: tuple[int, int, float],
    is_dirty: Bools1,
) -> tuple[int, int]:
    """Split edges of the nodes `in_` or collapse the nodes `out` up to the quota; then do both in
    pairs.

    Moves are made in their order, each only if none of its cells has changed. The quota is the
    number of additional nodes, the largest number of pairs, and the least reduction of E by each
    pair. Returns the numbers of splits and collapses.
    """
    n_nodes = len(stars.start) - 1
    more, most, least = quota
    n_split, n_collapsed, s, c = 0, 0, 0, 0
    while True:
        is_pair = n_split - n_collapsed == more
        if is_pair and min(n_split, n_collapsed) >= most:
            break
        does_split, does_collapse = (
            is_pair or n_split - n_collapsed < more,
            is_pair or n_split - n_collapsed > more,
        )
        if does_split:
            while s < len(in_) and not _can_split(state, stars, in_[s], is_dirty):
                s += 1
            if s == len(in_):
                break
            # its partner must be elsewhere
            _mark_edge(state, stars, in_[s], splits.other[in_[s]], is_dirty, True)
        if does_collapse:
            while c < len(out) and not _can_collapse(
                state, stars, out[c], collapses.other[out[c]], is_dirty
            ):
                c += 1
        if does_collapse and (
            c == len(out) or (is_pair and splits.gain[in_[s]] + collapses.gain[out[c]] <= least)
        ):
            if does_split:
                _mark_edge(state, stars, in_[s], splits.other[in_[s]], is_dirty, False)
            break
        if does_split:
            a, b, p = in_[s], splits.other[in_[s]], n_nodes + n_split
            _put_middle(state, stars, a, b, p)
            split_edge(state, stars, a, b, p, is_dirty)
            n_split += 1
        if does_collapse:
            collapse_edge(state, stars, out[c], collapses.other[out[c]], is_dirty)
            n_collapsed += 1
    close_gaps(state, is_dirty)
    return n_split, n_collapsed


@helper
def _mark_edge(
    state: State, stars: NodeStars, a: int, b: int, is_dirty: NDArray, value: bool
) -> None:
    for r in range(stars.start[a], stars.start[a + 1]):
        if has_node(state.complex.cells, stars.cells[r], b):
            is_dirty[stars.cells[r]] = value


@helper
def _is_clean(stars: NodeStars, node: int, is_dirty: NDArray) -> bool:
    is_clean = True
    for r in range(stars.start[node], stars.start[node + 1]):
        is_clean = is_clean and not is_dirty[stars.cells[r]]
    return is_clean


@unit
def _can_collapse(state: State, stars: NodeStars, a: int, b: int, is_dirty: Bools1) -> bool:
    """True if nothing has changed around a and, on a mask's surface or between labels, around b and
    next to either.

    Two collapses, each allowed alone, may close a tunnel of four edges. A removed cell also takes
    facets of a surface from its neighbours.
    """
    if not _is_clean(stars, a, is_dirty):
        return False
    if state.complex.meeting[a, 1] < 0 and not state.complex.is_frozen[a, 3]:
        return True
    for node in (a, b):
        for r in range(stars.start[node], stars.start[node + 1]):
            if is_dirty[stars.cells[r]]:
                return False
            for other in state.complex.across[stars.cells[r]]:
                if other >= 0 and is_dirty[other]:
                    return False
    return True


@helper
def _can_split(state: State, stars: NodeStars, a: int, is_dirty: NDArray) -> bool:
    """True if the cells around a are unchanged and there is space for more."""
    size = stars.start[a + 1] - stars.start[a]
    return state.complex.n_cells[0] + size <= len(state.complex.cells) and _is_clean(
        stars, a, is_dirty
    )


@unit
def _sides_of_edge(state: State, stars: NodeStars, a: int, b: int) -> int:
    """The box's sides in which an edge lies, bit d for axis d, and bit 3 if it is on the boundary
    elsewhere.

    The boundary's facets at the edge decide, not its ends, which may lie in a side that the edge
    does not.
    """
    cells, t, sides = state.complex.cells, state.complex.ticks, 0
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if not has_node(cells, cell, b):
            continue
        for k in range(cells.shape[1]):
            if state.complex.across[cell, k] >= 0 or cells[cell, k] == a or cells[cell, k] == b:
                continue
            side = 3
            for d in range(3):
                at = t[a, d]
                is_flat = at == state.sides.low[d] or at == state.sides.high[d]
                for m in range(cells.shape[1]):
                    is_flat = is_flat and (m == k or t[cells[cell, m], d] == at)
                if is_flat:
                    side = d
            sides |= 1 << side
    return sides


@unit
def _put_middle(state: State, stars: NodeStars, a: int, b: int, p: int) -> bool:
    """Put the node p at the middle of an edge, or on the nearby surface.

    Returns False if it lies on a fixed boundary, or the surface is not reached.
    """
    ticks, cells, is_frozen = state.complex.ticks, state.complex.cells, state.complex.is_frozen
    sides = _sides_of_edge(state, stars, a, b)
    for d in range(3):
        ticks[p, d] = (ticks[a, d] + ticks[b, d]) >> 1
        is_frozen[p, d] = (sides >> d) & 1 == 1
    is_frozen[p, 3] = sides >= 8
    n_labels = labels_of_edge(state.complex.meeting[p], state, stars, a, b)
    if (sides > 0 and state.sides.is_fixed) or n_labels > MOST_MEETING:
        return False
    if sides < 8 and n_labels < 2:
        return True
    if sides >= 8 and not state.sides.has_surface:
        return False
    uphill, middle = np.zeros((7, 3)), place(ticks, p, a, state.objective)
    if not put_on_surface(uphill, state, p):
        return False
    shift = minus(place(ticks, p, a, state.objective), middle)
    if dot(shift, shift) > MIDDLE_SHIFT_FRACTION * MIDDLE_SHIFT_FRACTION * squared_length(
        state, a, b
    ):
        return False
    if sides < 8:
        return True
    uphill_at(uphill, state, p)
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        for k in range(cells.shape[1]):
            is_outer = state.complex.across[cell, k] < 0 and cells[cell, k] not in (a, b)
            if is_outer and has_node(cells, cell, b):
                for node in (a, b):
                    if not faces_up(state, cell, k, node, p, uphill):
                        return False
    return True


@unit
def labels_of_edge(meeting: Ints1, state: State, stars: NodeStars, a: int, b: int) -> int:
    """Write the labels around an edge to `meeting` (4,), rising, if there are 2 to 4, else -1;
    return their number.
    """
    count = 0
    for m in range(MOST_MEETING):
        meeting[m] = -1
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if not has_node(state.complex.cells, cell, b):
            continue
        count = insert_label(meeting, count, state.complex.labels[cell])
    if count == 1:
        meeting[0] = -1
    return count


def mend(state: State, bad: Ints, target: float) -> Exchanged:
    """For each bad cell make the collapse or split of an edge that leaves the best worst angle, if
    it improves.

    The measure is minus the cosine of the smallest dihedral angle, up to `target`. Cells of `bad`
    come worst first.
    """
    n_before = len(state.complex.ticks)
    stars = node_stars(state)
    state = roomy(state, len(bad), 16 * len(bad))
    is_dirty = np.zeros(len(state.complex.cells), dtype=np.bool_)
    n_split, n_collapsed = _mend(state, stars, bad, target, is_dirty)
    return compact_state(state, is_dirty, n_before, n_split, n_collapsed)


@entry
def _mend(
    state: State, stars: NodeStars, bad: Ints1, target: float, is_dirty: Bools1
) -> tuple[int, int]:
    cells, x = state.complex.cells, np.empty((4, 3))
    n_split, n_collapsed, n_nodes = 0, 0, len(stars.start) - 1
    for cell in bad:
        best, best_a, best_b, is_split = LEAST_LIFT_COSINE, -1, -1, False
        for i in range(4):
            a = cells[cell, i]
            if is_dirty[cell] or not _is_clean(stars, a, is_dirty):
                continue
            for j in range(4):
                b, p = cells[cell, j], n_nodes + n_split
                if i == j:
                    continue
                may_collapse = _can_collapse(state, stars, a, b, is_dirty)
                gain = _lift_by_collapse(x, state, stars, a, b, target) if may_collapse else -1.0
                if gain > best:
                    best, best_a, best_b, is_split = gain, a, b, False
                if i < j and _can_split(state, stars, a, is_dirty):
                    may_split = _put_middle(state, stars, a, b, p)
                    gain = _lift_by_split(x, state, stars, a, b, p, target) if may_split else -1.0
                    if gain > best:
                        best, best_a, best_b, is_split = gain, a, b, True
        if best_a >= 0 and is_split:
            p = n_nodes + n_split
            _put_middle(state, stars, best_a, best_b, p)
            split_edge(state, stars, best_a, best_b, p, is_dirty)
            n_split += 1
        elif best_a >= 0:
            collapse_edge(state, stars, best_a, best_b, is_dirty)
            n_collapsed += 1
    close_gaps(state, is_dirty)
    return n_split, n_collapsed


@helper
def _lift_by_collapse(
    x: NDArray, state: State, stars: NodeStars, a: int, b: int, target: float
) -> float:
    """Growth of the worst cosine around a if a is joined to b."""
    cells, t = state.complex.cells, state.complex.ticks
    if not may_join(state, a, b):
        return -1.0
    here, old, new, size = row(t, a), target, target, 0.0
    for r in range(stars.start[a], stars.start[a + 1]):
        old = min(old, cell_cosine(x, state, stars.cells[r]))
        size += signed_volume(x, 4)
    put_row(t, a, row(t, b))
    for r in range(stars.start[a], stars.start[a + 1]):
        if new > old and not has_node(cells, stars.cells[r], b):
            c = cells[stars.cells[r]]
            new = min(new, tet_cosine(x, state, c[0], c[1], c[2], c[3]))
    is_whole = new > old and _keeps_domain(x, state, stars, a, b, size)
    put_row(t, a, here)
    return new - old if is_whole else -1.0


@helper
def _lift_by_split(
    x: NDArray, state: State, stars: NodeStars, a: int, b: int, p: int, target: float
) -> float:
    """Growth of the worst cosine around the edge (a, b) if it is split at p."""
    old, new = target, target
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if has_node(state.complex.cells, cell, b):
            old = min(old, cell_cosine(x, state, cell))
            for node in (a, b):
                if not _shape_with(x, state, cell, node, p) < np.inf:
                    return -1.0
                new = min(new, worst_cosine(x))
    return new - old


# Splits.


def best_splits(state: State, stars: NodeStars, may_split: Bools, limits: Limits) -> EdgeMoves:
    """The best allowed split of an edge of each node, above the angle limit and without too short
    edges.

    An edge between two allowed nodes belongs to the lower one. Rows N to 2 N of `ticks` and
    `is_frozen` are written.
    """
    n_nodes = len(may_split)
    moves = EdgeMoves(may_split, np.full(n_nodes, -1, dtype=np.int64), np.full(n_nodes, -np.inf))
    run(_fill_splits, n_nodes, Splits(moves, state, stars, limits), n_nodes * 20)
    return moves


class Splits(NamedTuple):
    """Inputs and outputs of `best_splits`."""

    moves: EdgeMoves
    state: State
    stars: NodeStars
    limits: Limits


@unit
def _fill_splits(work: Splits, node: int) -> None:
    if work.moves.may_move[node]:
        _best_split(node, work.moves, work.state, work.stars, work.limits)


@unit
def _best_split(a: int, moves: EdgeMoves, state: State, stars: NodeStars, limits: Limits) -> None:
    x, near = np.empty((4, 3)), np.empty(MAX_NEIGHBOURS, dtype=np.int64)
    count, best = _neighbours(near, state.complex.cells, stars, a), limits.least
    bound = np.empty(MAX_NEIGHBOURS)
    for number in range(count):
        b = near[number]
        bound[number] = -np.inf
        if (b > a or not moves.may_move[b]) and squared_length(
            state, a, b
        ) >= 4.0 * limits.shortest * limits.shortest:
            ratio = squared_ratio(state, a, b, limits.target)
            bound[number] = TARGET_CREDIT * ratio if ratio > LONG_EDGE * LONG_EDGE else 0.0
            bound[number] += (
                np.inf if _may_fit(state, a, b) else _energy_of_edge(state, stars, a, b)
            )
    # Unless it may fit a mask, no edge gains more than its energy.
    for _ in range(count):
        number = int(np.argmax(bound[:count]))
        if not bound[number] > best:
            break
        b, p = near[number], len(moves.gain) + a
        bound[number] = -np.inf
        if _put_middle(state, stars, a, b, p) and _is_long(state, stars, a, b, p, limits.shortest):
            ratio = squared_ratio(state, a, b, limits.target)
            credit = TARGET_CREDIT * ratio if ratio > LONG_EDGE * LONG_EDGE else 0.0
            worth = worth_of_split(x, state, stars, a, b, p, best - credit) + credit
            if worth > best:
                best, moves.gain[a], moves.other[a] = worth, worth, b


@helper
def _may_fit(state: State, a: int, b: int) -> bool:
    """True if a split of the edge (a, b) may change the misfit to a mask: on its surface, where
    both ends lie.
    """
    is_frozen = state.complex.is_frozen
    return state.objective.surface > 0.0 and is_frozen[a, 3] and is_frozen[b, 3]


@helper
def _energy_of_edge(state: State, stars: NodeStars, a: int, b: int) -> float:
    """Energy of the cells around the edge (a, b)."""
    mesh, energy = state.complex, 0.0
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if has_node(mesh.cells, cell, b):
            energy += cell_energy(state, cell)
    return energy


@helper
def _is_long(state: State, stars: NodeStars, a: int, b: int, p: int, shortest: float) -> bool:
    """True if no edge from p to the other corners of the cells around the edge (a, b) is shorter
    than the limit.
    """
    cells = state.complex.cells
    if shortest <= 0.0:
        return True
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if has_node(cells, cell, b):
            for k in range(cells.shape[1]):
                if squared_length(state, p, cells[cell, k]) < shortest * shortest:
                    return False
    return True


@unit
def _neighbours(near: Ints1, cells: Ints2, stars: NodeStars, node: int) -> int:
    """Write the nodes that share a cell with `node` to `near`, as many as fit; return their
    number.
    """
    count = 0
    for r in range(stars.start[node], stars.start[node + 1]):
        for k in range(cells.shape[1]):
            other = cells[stars.cells[r], k]
            is_new = other != node
            for m in range(count):
                is_new = is_new and near[m] != other
            if is_new and count < len(near):
                near[count] = other
                count += 1
    return count


@unit
def worth_of_split(
    x: Floats2, state: State, stars: NodeStars, a: int, b: int, p: int, least_gain: float
) -> float:
    """Reduction of E by splitting the edge (a, b) at p; -inf if impossible or less than
    `least_gain`.
    """
    cells, fluxes, objective = state.complex.cells, state.complex.fluxes, state.objective
    n = cells.shape[1]
    old, shape = 0.0, 0.0
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if not has_node(cells, cell, b):
            continue
        old += cell_energy(state, cell)
        least = objective.angle_limit if n == 4 else -1.0
        if least > -1.0:
            shape_of_cell(x, state.complex.ticks, cells, cell, objective)
            least = min(least, cosine_up_to_limit(x, objective))
        for node in (a, b):
            shape += objective.geometry * _shape_with(x, state, cell, node, p)
            if not shape < np.inf:
                return -np.inf
            if least > -1.0 and cosine_up_to_limit(x, objective) < least:
                return -np.inf
    has_misfit = objective.surface > 0.0 and state.complex.is_frozen[p, 3]
    if old - shape <= least_gain and not has_misfit:
        return -np.inf
    if objective.image == 0.0:
        return old - shape
    new, misfit, D = shape, 0.0, state.complex.sums.shape[1]
    # Unless p was moved to a surface, the two halves of a facet of the edge make up all of it:
    # measure one of them.
    is_beside = state.complex.is_frozen[p, 3] or state.complex.meeting[p, 1] >= 0
    flux, sums = np.empty((1, 1, D)), np.empty((2, D))
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if has_node(cells, cell, b):
            i, j = corner_of(cells, cell, a), corner_of(cells, cell, b)
            _put_flux_with(flux, state, cell, i, b, p)
            for d in range(D):
                sums[0, d] = fluxes[cell, j, d] + flux[0, 0, d]
                sums[1, d] = fluxes[cell, i, d] - flux[0, 0, d]
            for k in range(n):
                if k not in (i, j):
                    _put_flux_with(flux, state, cell, k, b, p)
                    for d in range(D):
                        sums[0, d] += flux[0, 0, d]
                        sums[1, d] += 0.0 if is_beside else fluxes[cell, k, d] - flux[0, 0, d]
                    if is_beside:
                        _put_flux_with(flux, state, cell, k, a, p)
                        for d in range(D):
                            sums[1, d] += flux[0, 0, d]
            for half in range(2):
                new += objective.image * image_energy(
                    sums, half, state.complex.labels[cell], objective
                )
                misfit += wrong_side(sums, half, objective)
            misfit -= wrong_side(state.complex.sums, cell, objective)
            if old - new <= least_gain and not has_misfit:  # otherwise the misfit may still fall
                return -np.inf
    worth = old - new - misfit
    return worth if worth > least_gain else -np.inf


@unit
def _shape_with(x: Floats2, state: State, cell: int, node: int, p: int) -> float:
    """Shape energy of a cell with p in place of its corner `node`; the corners are written to x."""
    cells, objective = state.complex.cells, state.objective
    k = corner_of(cells, cell, node)
    base = cells[cell, 0] if k > 0 else p
    for m in range(cells.shape[1]):
        load(x, m, state.complex.ticks, p if m == k else cells[cell, m], base, objective)
    return shape_energy(x, cells.shape[1], objective.power, objective.is_graded)


@helper
def _put_flux_with(flux: NDArray, state: State, cell: int, k: int, node: int, p: int) -> None:
    """Write the outward flux of facet k of a cell with p in place of `node` to flux[0, 0, :]."""
    a, b, c = outward(state.complex.cells, cell, k)
    a, b, c = p if a == node else a, p if b == node else b, p if c == node and c >= 0 else c
    put_flux(flux, 0, 0, state.complex.ticks, a, b, c, state.objective)


@unit
def split_edge(state: State, stars: NodeStars, a: int, b: int, p: int, is_dirty: Bools1) -> None:
    """Split each cell of the edge (a, b): it keeps a, with p for b; a new one has b, with p for
    a.
    """
    cells, across, fluxes = state.complex.cells, state.complex.across, state.complex.fluxes
    n, first, last = cells.shape[1], stars.start[a], stars.start[a + 1]
    x, new = np.empty((4, 3)), np.full(last - first, -1, dtype=np.int64)
    for r in range(first, last):
        if has_node(cells, stars.cells[r], b):
            new[r - first] = state.complex.n_cells[0]
            state.complex.n_cells[0] += 1
    for r in range(first, last):
        cell, other = stars.cells[r], new[r - first]
        if other < 0:
            continue
        i, j = corner_of(cells, cell, a), corner_of(cells, cell, b)
        for k in range(n):  # numba compiles whole rows four times as long
            cells[other, k], across[other, k] = cells[cell, k], across[cell, k]
            for d in range(fluxes.shape[2]):
                fluxes[other, k, d] = fluxes[cell, k, d]
        state.complex.labels[other] = state.complex.labels[cell]
        cells[other, i] = p
        beyond = across[cell, i]
        if beyond >= 0:
            across[beyond, facet_of(across, beyond, cell)] = other
        across[other, j] = cell
        for k in range(n):
            if k not in (i, j) and across[cell, k] >= 0:
                for s in range(first, last):
                    if stars.cells[s] == across[cell, k]:
                        across[other, k] = new[s - first]
    # only now, as the search for new neighbours needed the old corners
    for r in range(first, last):
        cell, other = stars.cells[r], new[r - first]
        if other < 0:
            continue
        i, j = corner_of(cells, cell, a), corner_of(cells, cell, b)
        cells[cell, j] = p
        across[cell, i] = other
        for child, back in ((cell, i), (other, j)):
            for k in range(n):
                if state.objective.image > 0.0 and (k == back or k not in (i, j)):
                    measure_facet(state, child, k)
            settle(x, state, child)
            is_dirty[child] = True


# Collapses.


def best_collapses(
    state: State, stars: NodeStars, groups: Blocks, may_collapse: Bools, limits: Limits
) -> EdgeMoves:
    """The neighbour to which each allowed node is best joined, so that no flat cell remains."""
    n_nodes = len(may_collapse)
    moves = EdgeMoves(may_collapse, np.full(n_nodes, -1, dtype=np.int64), np.full(n_nodes, -np.inf))
    laid_out = pack_record(state), pack_record(stars), pack_record(groups)
    for chosen in colours_of(state, stars, groups):
        work = Collapses(moves, *laid_out, chosen, limits)
        run(_fill_collapses, len(chosen), work, len(chosen) * 10_000)
    return moves


class Collapses(NamedTuple):
    """Inputs and outputs of `best_collapses`, for the groups of one colour."""

    moves: EdgeMoves
    state: State
    stars: NodeStars
    groups: Blocks
    chosen: Ints1  # (G,) the groups
    limits: Limits


@unit
def _fill_collapses(work: Collapses, number: int) -> None:
    groups, block = work.groups, work.chosen[number]
    for at in range(groups.start[block], groups.start[block + 1]):
        if work.moves.may_move[groups.nodes[at]]:
            _best_collapse(groups.nodes[at], work.moves, work.state, work.stars, work.limits)


@unit
def _best_collapse(
    a: int, moves: EdgeMoves, state: State, stars: NodeStars, limits: Limits
) -> None:
    """The neighbour to which `a` is best joined; `a` moves there and back, unseen by cells of
    other groups.
    """
    cells, t, is_frozen, objective = (
        state.complex.cells,
        state.complex.ticks,
        state.complex.is_frozen,
        state.objective,
    )
    if is_frozen[a, 0] and is_frozen[a, 1] and is_frozen[a, 2]:
        return
    n, trial = cells.shape[1], trial_of(state, stars, a)
    near, shapes = np.empty(MAX_NEIGHBOURS, dtype=np.int64), np.full(MAX_NEIGHBOURS, np.inf)
    old, least, size = 0.0, objective.angle_limit if n == 4 else -1.0, 0.0
    for r in range(stars.start[a], stars.start[a + 1]):
        old += cell_energy(state, stars.cells[r])
        load_cell(trial.x, t, cells, stars.cells[r], objective)
        size += signed_volume(trial.x, n)
        if least > -1.0:
            least = min(least, cosine_up_to_limit(trial.x, objective))
    here, count, best = row(t, a), _neighbours(near, cells, stars, a), old + limits.dearest
    _, has_misfit = star_misfit(state, stars, a)
    for number in range(count):  # shapes are cheap, and a lower bound
        b = near[number]
        if may_join(state, a, b) and _is_short(state, near, count, a, b, limits.longest):
            put_row(t, a, row(t, b))
            shapes[number] = star_shape(
                trial, np.inf if has_misfit else best, least, a, state, stars, b
            )
            if shapes[number] < np.inf and not _keeps_domain(trial.x, state, stars, a, b, size):
                shapes[number] = np.inf
            put_row(t, a, here)
    for _ in range(count):
        number = int(np.argmin(shapes))
        if not shapes[number] < best:
            break
        b, value = near[number], shapes[number]
        shapes[number] = np.inf
        if objective.image > 0.0:
            put_row(t, a, row(t, b))
            value = star_energy(trial, best, least, a, state, stars, b)
            put_row(t, a, here)
        if value < best:
            best, moves.gain[a], moves.other[a] = value, old - value, b


@helper
def squared_length(state: State, a: int, b: int) -> float:
    """Squared distance of two nodes, mm^2."""
    u = place(state.complex.ticks, b, a, state.objective)
    return dot(u, u)


@unit
def _is_short(state: State, near: Ints1, count: int, a: int, b: int, longest: Floats1) -> bool:
    """True if no edge from b to a neighbour of a exceeds the bound at its ends, or the longest
    edge before.
    """
    old = 0.0
    for m in range(count):
        old = max(old, squared_length(state, a, near[m]))
    for m in range(count):
        square = squared_length(state, b, near[m])
        if square > old and square > min(longest[b], longest[near[m]]) ** 2:
            return False
    return True


@helper
def may_join(state: State, a: int, b: int) -> bool:
    """True if a may move to b: it must stay in its sides of the box and on its surfaces.

    Otherwise the star would lose volume (`_keeps_size`), which is more expensive to check.
    """
    ticks, is_frozen, meeting = state.complex.ticks, state.complex.is_frozen, state.complex.meeting
    may = not is_frozen[a, 3] or is_frozen[b, 3]
    for m in range(MOST_MEETING):
        may = may and (meeting[a, m] < 0 or is_among(meeting[a, m], meeting[b]))
    for d in range(3):
        may = may and (not is_frozen[a, d] or (is_frozen[b, d] and ticks[a, d] == ticks[b, d]))
    return may


@unit
def _keeps_domain(x: Floats2, state: State, stars: NodeStars, a: int, b: int, size: float) -> bool:
    """True if the mesh still covers its domain with a at b; `size` is n! times the star's
    volume.
    """
    if state.complex.meeting[a, 1] >= 0 and not _stays_between_labels(state, stars, a, b):
        return False
    if not state.complex.is_frozen[a, 3]:
        return _keeps_size(x, state, stars, a, b, size, ROUNDING_FRACTION)
    return (
        _keeps_size(x, state, stars, a, b, size, SURFACE_VOLUME_FRACTION)
        and _is_linked(state, stars, a, b)
        and star_faces_up(np.empty((2, 3)), state, stars, a, b)
    )


@unit
def _stays_between_labels(state: State, stars: NodeStars, a: int, b: int) -> bool:
    """True if a node between labels may be joined to b so that all labels keep their topology.

    All labels that meet at it must do so along the whole edge, which therefore lies on the same
    surface or curve. Facets between labels must fulfil the same condition as the boundary
    (`_is_linked`), and a curve of three edges is kept. No removed cell may have such facets
    opposite both ends: they would coincide, and a label's last cell might vanish.
    """
    cells, labels = state.complex.cells, state.complex.labels
    meeting, other = np.empty(MOST_MEETING, dtype=np.int64), np.empty(MOST_MEETING, dtype=np.int64)
    n_labels = labels_of_edge(meeting, state, stars, a, b)
    if n_labels > MOST_MEETING:
        return False
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if not is_among(labels[cell], meeting):
            return False
        if has_node(cells, cell, b) and _is_side(state, cell, a) and _is_side(state, cell, b):
            return False
    sides = _sides_of_edge(state, stars, a, b)
    for d in range(3):
        if state.complex.is_frozen[a, d] and (sides >> d) & 1 == 0:
            return False
    if n_labels > 2:
        near = np.empty(MAX_NEIGHBOURS, dtype=np.int64)
        for number in range(_neighbours(near, state.complex.cells, stars, a)):
            c = near[number]
            if (
                c != b
                and labels_of_edge(other, state, stars, a, c) > 2
                and labels_of_edge(other, state, stars, b, c) > 2
            ):
                return False
    return _is_linked(state, stars, a, b)


@helper
def _is_side(state: State, cell: int, node: int) -> bool:
    """True if a cell's facet opposite a node is on the boundary or between labels."""
    k = corner_of(state.complex.cells, cell, node)
    return state.complex.across[cell, k] < 0 or is_interface(state.complex, cell, k)


@unit
def _is_linked(state: State, stars: NodeStars, a: int, b: int) -> bool:
    """True if a boundary edge may be collapsed without closing a hole or a gap (Dey et al. 1999).

    It must lie on the boundary, and any common neighbour of its ends must share a cell with both
    or, on the boundary, a facet.
    """
    cells = state.complex.cells
    near, n = np.empty(MAX_NEIGHBOURS, dtype=np.int64), cells.shape[1]
    edge = _is_outer(state, stars, a, b, -1)
    for number in range(_neighbours(near, cells, stars, a)):
        c = near[number]
        has_both, is_next = False, False
        for r in range(stars.start[b], stars.start[b + 1]):
            if has_node(cells, stars.cells[r], c):
                is_next = True
                has_both = has_both or has_node(cells, stars.cells[r], a)
        if c == b or not is_next:
            continue
        if not has_both:
            return False
        are_outer = (
            n == 4 and _is_outer(state, stars, a, c, -1) and _is_outer(state, stars, b, c, -1)
        )
        if are_outer and not _is_outer(state, stars, a, b, c):
            return False
    return edge


@helper
def _is_outer(state: State, stars: NodeStars, a: int, b: int, c: int) -> bool:
    """True if a facet of the boundary or between labels has the nodes a and b, and c unless that
    is -1.
    """
    cells = state.complex.cells
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if has_node(cells, cell, b) and (c < 0 or has_node(cells, cell, c)):
            for k in range(cells.shape[1]):
                is_outer = state.complex.across[cell, k] < 0 or is_interface(state.complex, cell, k)
                if is_outer and cells[cell, k] not in (a, b, c):
                    return True
    return False


@unit
def _keeps_size(
    x: Floats2, state: State, stars: NodeStars, a: int, b: int, size: float, fraction: float
) -> bool:
    """True if the cells around a, moved to b, keep their volume up to a fraction; `size` is n!
    times the volume.

    If all cells are positive, they fan out from b over the star's hull, so this holds unless the
    domain is not convex there.
    """
    cells = state.complex.cells
    total = 0.0
    for r in range(stars.start[a], stars.start[a + 1]):
        if not has_node(cells, stars.cells[r], b):
            load_cell(x, state.complex.ticks, cells, stars.cells[r], state.objective)
            total += signed_volume(x, cells.shape[1])
    return abs(total - size) <= fraction * size


@unit
def collapse_edge(state: State, stars: NodeStars, a: int, b: int, is_dirty: Bools1) -> None:
    """Replace node a by b: cells with both are removed, and the other cells around a get b
    instead.
    """
    cells, across, x = state.complex.cells, state.complex.across, np.empty((4, 3))
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        is_dirty[cell] = True
        if has_node(cells, cell, b):
            # The cells beyond its facets opposite a and b become neighbours.
            of_b, of_a = (
                across[cell, corner_of(cells, cell, a)],
                across[cell, corner_of(cells, cell, b)],
            )
            if of_a >= 0:
                across[of_a, facet_of(across, of_a, cell)] = of_b
            if of_b >= 0:
                across[of_b, facet_of(across, of_b, cell)] = of_a
    for r in range(stars.start[a], stars.start[a + 1]):
        cell = stars.cells[r]
        if has_node(cells, cell, b):
            cells[cell, 0] = -1
            continue
        i = corner_of(cells, cell, a)
        cells[cell, i] = b
        for k in range(cells.shape[1]):
            if state.objective.image > 0.0 and k != i:
                measure_facet(state, cell, k)
        settle(x, state, cell)
