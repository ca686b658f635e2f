"""Which label each cell has: labels whole, their interfaces short and manifold.

The labels minimise a Potts energy on the dual graph of a mesh that stays as it is (Boykov, Veksler, Zabih 2001),

    sum over cells of the volume of voxels that are not of the cell's label
    - sum over cells of the bias of the cell's label x its volume
    + sum over facets between cells of different labels of tension x area,

a surface tension in mm: how far a surface would move to save itself. A ball smaller than three of it in radius, or a
sheet thinner than two, costs more than it is worth. A label that is thinner than cells has most of the voxels in few
of them: its bias, one number, is raised until its cells have its volume. Between labels that touch nowhere in the
voxels, or at a few places, the tension is higher: cells between them get the label of the sheet that parts them there,
rather than tear it. From the labels that most voxels of each cell have, cells take
the label of a neighbour, the best move first, as long as the energy falls. Then components of cells that no component
of voxels justifies go to their neighbours, and what is not manifold is mended by the cells around it that cost least.

An interface is manifold at an edge or a node if, of each label there, the cells around it are one fan, and all
others, with the outside among them, are one, too: linked by facets that contain the edge or the node.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.engine.complex import has_node
from tetopt.geometry.simplex import facet_areas, regular_edge, volumes
from tetopt.geometry.topology import linked, stars
from tetopt.system.kernels import Bools1, Bools2, Floats1, Floats2, Ints1, Ints2, entry, helper, unit

TENSION_FRACTION = (
    0.1  # of the local edge: a regular cell with three facets against one label goes, unless nearly full of its own
)
LEAST_FRACTION = 0.5  # of a label's volume: tension takes no more, so that small labels do not wither away
LAST_FRACTION = 0.1  # of that: mending may take more in the end, rather than leave a pinch
# of the voxels of a component of cells that a component of voxels has at least, if it is to justify it
COMPONENT_FRACTION = 0.5
BRIDGE_RATIO = 3.0  # of the voxels lost with a component: what a bridge may cost; with 1 a coarse mesh loses half a rib
MENDING_ROUNDS = 6  # of fragments and mending, at most; the second mostly has nothing left to do
TWO_LABELS_WEIGHT = 20.0  # volumes of the cells around: what is not manifold between two labels goes at any cost
MORE_LABELS_WEIGHT = 0.3  # where more labels meet: edges go with it, and with 4 a tenth of small organs' Dice, too
APART_TENSION = 10.0  # times the usual, between labels that the voxels there keep apart
PLACE_TENSION = 3.0  # likewise, where they touch
APART_WEIGHT = 10.0  # where such labels meet at a node or an edge alone: a sheet between them is pierced
LEAST_CONTACT_FRACTION = 0.1  # of the surface of two labels: pairs that touch less do so at places, not everywhere
BALANCE_ROUNDS = 10  # of labelling and balancing, where no bias is known; more hardly change it
BALANCE_STEP = 3.0  # times the fraction of its volume that a label lacks: its bias rises so much,
LONGEST_BALANCE_STEP = 0.1  # at most,
FIRST_BALANCE_STEP = 0.2  # and so much where labels are given at once
# of a label's volume may go, and come, where labels are given anew with the bias that made up for losses since: in
# cells that are far larger than a label is thick such a bias gives or takes several times its volume
MOST_SWING = (0.15, 0.4)
SWING_ROUNDS = 4  # at most, in which they are given again
MOST_BIAS = 0.9  # of a cell's volume: a label of which a cell has less than a twentieth does not get it
LEAST_GAIN = 1e-9  # of a cell's volume: less than this is rounding
DOUBTFUL_STEPS = 8  # see `_count_steps`


class Contacts(NamedTuple):
    """Which labels touch in the voxels."""

    is_apart: Bools2  # (K, K) pairs that do not touch, or at few places alone
    is_place: Bools1  # (M,) cells that have a voxel at such a place


class LabelVoxels(NamedTuple):
    """What the voxels of labels say of any mesh; made by `label_voxels`."""

    components: list[NDArray[np.int64]]  # voxels in each component of each label, falling
    is_apart: NDArray[np.bool_]  # (K, K) as of `Contacts`
    places: NDArray[np.int64]  # voxels, as numbers of the flat grid, beside one of a label that is apart from theirs


class Labelling(NamedTuple):
    """The label of each cell, as rows of the labels, and what is left undone."""

    labels: NDArray[np.int64]  # (M,)
    n_moved: int  # cells whose label is not the one of most of their voxels
    n_nonmanifold_edges: int  # where only two labels meet; nodes in 2-D have no edges, 0
    n_nonmanifold_nodes: int
    components: NDArray[np.int64]  # (K,) components of cells, linked by facets
    lost: NDArray[np.int64]  # labels with voxels but without cells
    bias: NDArray[np.float64]  # (K,) of labels, with which they were found


class Dual(NamedTuple):
    """A mesh as its cells touch each other, and what each cell holds."""

    cells: Ints2  # (M, n+1)
    across: Ints2  # (M, n+1) the cell beyond each facet; -1 outside
    star_start: Ints1  # (N+1,)
    star_cells: Ints1  # (M (n+1),) the cells around each node, ascending
    size: Floats1  # (M,) volumes, mm^n
    scale: Floats1  # (N,) mean volume of the cells around each node
    tension: Floats2  # (M, n+1) what each facet costs between different labels, mm^n; 0 on the boundary
    first: Ints1  # (M+1,) where each cell's row of voxels begins
    row: Ints1  # labels in it
    volume: Floats1  # of their voxels in it, mm^n
    contacts: Contacts
    bias: Floats1  # (K,) what each label is worth besides, by volume; see `labelled`


def labelled(
    points: NDArray[np.float64], cells: NDArray[np.int64], across: NDArray[np.int64], counts: scipy.sparse.csr_array,
    components: list[NDArray], contacts: Contacts | None = None, bias: NDArray[np.float64] | None = None,
    weight: float | None = None,
) -> Labelling:  # fmt: skip
    """The label of each cell of a mesh: close to the voxels in it, interfaces short and manifold, no fragments.

    It ends, since every move but that of fragments lowers an energy, and fragments go at most `MENDING_ROUNDS` times.
    A label that most voxels of a cell have keeps a cell at least.

    Parameters
    ----------
    points : (N, n) float64
        Nodes, mm.
    cells : (M, n+1) int64
        Positively oriented.
    across : (M, n+1) int64
        The cell beyond each facet, opposite each corner; -1 outside.
    counts : (M, K) sparse array in rows
        Voxels of each label in each cell, with fractions of a voxel where a cell holds no centre. No row is empty.
    components : list of K arrays
        Voxels in each component of each label, falling: `voxel_components`. As many components of cells may stay.
    contacts : Contacts, optional
        Which labels the voxels keep apart; none by default.
    bias : (K,) float64, optional
        What each label is worth besides, as a fraction of a cell's volume; by default what keeps the labels' volumes,
        as far as it can: a label that is thinner than cells has most of the voxels in few of them. One that is given
        is kept, unless labels take far more than their volumes by it, or far less (`MOST_SWING`).
    weight : float, optional
        Surface tension, mm; by default `TENSION_FRACTION` of the mean edge of the two cells at each facet.

    Returns
    -------
    Labelling
    """
    dual, n_labels = _dual(points, cells, across, counts, contacts, weight), counts.shape[1]
    voxel = float(dual.volume.sum() / counts.sum())
    aim = np.bincount(dual.row, dual.volume, n_labels).astype(np.float64)
    least = LEAST_FRACTION * aim
    begin = _majority(dual)
    dual.bias[:] = _balance(dual, aim, least) if bias is None else bias
    if bias is not None and bias.any():
        labels = _without_swing(dual, aim, least, voxel, components)
    else:
        labels = _given(dual, least, voxel, components)
    faces, is_two = _nonmanifold(dual, labels)
    _, of_component = components_of(across, labels)
    return Labelling(
        labels,
        int((labels != begin).sum()),
        int((is_two & (faces[:, 1] >= 0)).sum()),
        int((is_two & (faces[:, 1] < 0)).sum()),
        np.bincount(of_component, minlength=n_labels),
        np.flatnonzero((aim > 0.0) & (np.bincount(labels, minlength=n_labels) == 0)),
        dual.bias,
    )


def _given(dual: Dual, least: NDArray[np.float64], voxel: float, components: list[NDArray]) -> NDArray[np.int64]:
    """Labels of cells, (M,), by the dual's bias."""
    labels = _majority(dual)
    if dual.bias.any():
        _keep_each(dual, labels)
    _settle(dual, labels, least, False)
    is_bridge = np.zeros(len(labels), dtype=bool)
    for _ in range(MENDING_ROUNDS):
        moved = _without_fragments(dual, labels, is_bridge, voxel, components)
        moved += _mended(dual, labels, is_bridge, least)
        moved += _settle(dual, labels, least, True)
        if moved == 0:
            break
    _mend_pairs(dual, labels, LAST_FRACTION * least)
    return labels


def _without_swing(
    dual: Dual, aim: NDArray[np.float64], least: NDArray[np.float64], voxel: float, components: list[NDArray]
) -> NDArray[np.int64]:
    """Labels, (M,), with as little volume as possible beyond `MOST_SWING` of `aim`; the dual's bias is theirs.

    The bias that made up for what labels have lost since they were given may be far too strong for labels given anew.
    """
    fewest = np.inf
    for _ in range(1 + SWING_ROUNDS):
        labels = _given(dual, least, voxel, components)
        volume = np.bincount(labels, dual.size, len(aim))
        near = np.clip(volume, (1.0 - MOST_SWING[0]) * aim, (1.0 + MOST_SWING[1]) * aim)
        beyond = float(np.abs(volume - near).sum())
        if beyond < fewest:
            best, bias, fewest = labels, dual.bias.copy(), beyond
        if beyond == 0.0:
            break
        dual.bias[:] = balanced(dual.bias, near, volume, FIRST_BALANCE_STEP)
    dual.bias[:] = bias
    return best


def unpinched(
    points: NDArray[np.float64], cells: NDArray[np.int64], across: NDArray[np.int64], counts: scipy.sparse.csr_array,
    contacts: Contacts | None, labels: NDArray[np.int64],
) -> NDArray[np.int64]:  # fmt: skip
    """Labels of cells, (M,), with as few changed as make interfaces of two labels manifold, whatever they cost.

    Arguments as of `labelled`; no label loses its last cell. What cannot be mended is left.
    """
    dual, labels = _dual(points, cells, across, counts, contacts, None), labels.copy()
    _mend_pairs(dual, labels, np.full(counts.shape[1], float(dual.size.min())))
    return labels


def _keep_each(dual: Dual, labels: NDArray[np.int64]) -> None:
    """Give labels without cells the one that has most of them, unless that is far more of others."""
    cell = np.repeat(np.arange(len(labels)), np.diff(dual.first))
    n_of = np.bincount(labels, minlength=len(dual.bias))
    for label in np.setdiff1d(dual.row, labels):
        place = np.flatnonzero(dual.row == label)
        place = place[np.argmax(dual.volume[place])]
        best = cell[place]
        if dual.volume[place] > 0.5 * (1.0 - MOST_BIAS) * dual.size[best] and n_of[labels[best]] > 1:
            n_of[labels[best]] -= 1
            labels[best] = label


def _balance(dual: Dual, aim: NDArray[np.float64], least: NDArray[np.float64]) -> NDArray[np.float64]:
    """The bias by which labels have most nearly their volumes `aim`: steps are halved where they went too far."""
    longest, before = np.full(len(aim), FIRST_BALANCE_STEP), np.zeros(len(aim))
    for _ in range(BALANCE_ROUNDS):
        labels = _majority(dual)
        _settle(dual, labels, least, False)
        step = balanced(dual.bias, aim, np.bincount(labels, dual.size, len(aim)), longest) - dual.bias
        longest = np.where(step * before < 0.0, 0.5 * longest, longest)
        before = np.clip(step, -longest, longest)
        dual.bias[:] += before
    return dual.bias


def balanced(
    bias: NDArray[np.float64], aim: NDArray, volume: NDArray, longest: NDArray | float = LONGEST_BALANCE_STEP
) -> NDArray[np.float64]:
    """The bias of each label, raised where its volume is below its aim, lowered where it is above; all (K,)."""
    missing = np.where(aim > 0.0, 1.0 - volume / np.where(aim > 0.0, aim, 1.0), 0.0)
    step = np.clip(BALANCE_STEP * missing, -longest, longest)
    return np.asarray(np.clip(bias + step, -MOST_BIAS, MOST_BIAS))


def voxel_components(partition: NDArray[np.int64], n_labels: int) -> list[NDArray[np.int64]]:
    """Voxels in each component of each label of a grid, falling; linked by faces."""
    boxes = scipy.ndimage.find_objects(partition + 1, n_labels)
    parts = [np.zeros(1, dtype=bool) if box is None else partition[box] == k for k, box in enumerate(boxes)]
    return [np.sort(np.bincount(scipy.ndimage.label(part)[0].ravel())[1:])[::-1] for part in parts]


def label_voxels(partition: NDArray[np.int64], spacing: NDArray[np.float64], n_labels: int) -> LabelVoxels:
    """Components of labels in the voxels of a grid, pairs that share hardly any area, and where those touch."""
    steps = [np.moveaxis(partition, d, 0) for d in range(partition.ndim)]
    area = np.zeros(n_labels * n_labels)
    for rows, step in zip(steps, spacing, strict=True):
        area += np.prod(spacing) / step * np.bincount((n_labels * rows[:-1] + rows[1:]).ravel(), minlength=len(area))
    area = area.reshape(n_labels, n_labels) + area.reshape(n_labels, n_labels).T
    np.fill_diagonal(area, 0.0)
    surface = area.sum(axis=1)
    is_apart = area < LEAST_CONTACT_FRACTION * np.minimum(surface[:, None], surface)
    np.fill_diagonal(is_apart, False)
    is_place = np.zeros(partition.shape, dtype=bool)
    for d, rows in enumerate(steps):
        is_met, here = is_apart[rows[:-1], rows[1:]], np.moveaxis(is_place, d, 0)
        here[:-1] |= is_met
        here[1:] |= is_met
    return LabelVoxels(voxel_components(partition, n_labels), is_apart, np.flatnonzero(is_place))


def components_of(across: NDArray[np.int64], labels: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The component of each cell, (M,), linked by facets between cells of one label; and each component's label."""
    one = np.repeat(np.arange(len(labels)), across.shape[1])
    other = across.ravel()
    is_link = (other > one) & (labels[one] == labels[other])
    n_pieces, number = linked(one[is_link], other[is_link], len(labels))
    of_component = np.empty(n_pieces, dtype=np.int64)
    of_component[number] = labels
    return number, of_component


def _dual(
    points: NDArray[np.float64], cells: NDArray[np.int64], across: NDArray[np.int64], counts: scipy.sparse.csr_array,
    contacts: Contacts | None, weight: float | None,
) -> Dual:  # fmt: skip
    assert (np.diff(counts.indptr) > 0).all(), "labelled: a cell without voxels has no fraction of any label"
    n, n_labels = points.shape[1], counts.shape[1]
    size, around = np.abs(volumes(points, cells)), stars(cells, len(points))
    scale = np.add.reduceat(np.append(size[around.cells], 0.0), around.start[:-1]) / np.maximum(
        np.diff(around.start), 1
    )
    tension = np.full(across.shape, weight)
    if weight is None:
        # The edge of a regular cell of that volume: thin cells do not make a surface dear.
        edge = regular_edge(size, n)
        tension = TENSION_FRACTION * 0.5 * (edge[:, None] + edge[across])
    tension = np.where(across >= 0, tension * facet_areas(points, cells), 0.0)
    voxel = size.sum() / counts.sum()
    return Dual(
        np.ascontiguousarray(cells, dtype=np.int64),
        np.ascontiguousarray(across, dtype=np.int64),
        around.start,
        around.cells,
        size,
        scale,
        tension,
        counts.indptr.astype(np.int64),
        counts.indices.astype(np.int64),
        voxel * counts.data.astype(np.float64),
        Contacts(np.zeros((n_labels, n_labels), dtype=bool), np.zeros(len(cells), dtype=bool))
        if contacts is None
        else contacts,
        np.zeros(n_labels),
    )


def _majority(dual: Dual) -> NDArray[np.int64]:
    """The label that most voxels of each cell have, of equally many the first."""
    labels = np.empty(len(dual.cells), dtype=np.int64)
    _fill_majority(labels, dual)
    return labels


@entry
def _fill_majority(labels: Ints1, dual: Dual) -> None:
    for cell in range(len(labels)):
        most = -np.inf
        for p in range(dual.first[cell], dual.first[cell + 1]):
            worth = dual.volume[p] + dual.bias[dual.row[p]] * dual.size[cell]
            if worth > most or (worth == most and dual.row[p] < labels[cell]):
                labels[cell], most = dual.row[p], worth


def _settle(dual: Dual, labels: NDArray[np.int64], least: NDArray[np.float64], is_careful: bool) -> int:
    """Cells take the label of a neighbour while the energy falls, the best moves first; how many did.

    Tension alone takes no label below its volume `least`. With care only where no label's topology changes.
    """
    room = np.bincount(labels, dual.size, len(least)) - least
    n_of = np.bincount(labels, minlength=len(least))
    total, gains, is_stale = 0, np.zeros(len(labels)), np.ones(len(labels), dtype=bool)
    while True:
        # Only cells that moved, and those beside them: of a head's 720,000 cells a fifth of the time of all of them.
        _fill_gains(gains, dual, labels, np.flatnonzero(is_stale))
        is_stale[:] = False
        active = np.flatnonzero(gains > LEAST_GAIN * dual.size)
        order = active[np.argsort(-gains[active], kind="stable")]
        moved = _settle_once(dual, labels, order, room, n_of, is_stale, is_careful)
        total += moved
        if moved == 0:
            return total


@helper
def _voxels(dual: Dual, cell: int, label: int) -> float:
    """Volume of the voxels of a label in a cell."""
    for p in range(dual.first[cell], dual.first[cell + 1]):
        if dual.row[p] == label:
            return dual.volume[p]
    return 0.0


@unit
def _price(dual: Dual, labels: Ints1, cell: int, label: int) -> float:
    """The part of the energy that a cell's label decides, less what it is at best, if its label were this."""
    price = -_voxels(dual, cell, label) - dual.bias[label] * dual.size[cell]
    for k in range(dual.across.shape[1]):
        other = dual.across[cell, k]
        if other >= 0 and labels[other] != label:
            is_apart = dual.contacts.is_apart[label, labels[other]]
            is_place = dual.contacts.is_place[cell] or dual.contacts.is_place[other]
            factor = 1.0 if not is_apart else PLACE_TENSION if is_place else APART_TENSION
            price += dual.tension[cell, k] * factor
    return price


@helper
def _best_label(dual: Dual, labels: NDArray, cell: int) -> tuple:
    """Of the labels of a cell's neighbours the one of least price, and what is gained by it; its own if nothing is."""
    own = _price(dual, labels, cell, labels[cell])
    best, gain = labels[cell], 0.0
    for k in range(dual.across.shape[1]):
        other = dual.across[cell, k]
        if other >= 0 and labels[other] != labels[cell] and labels[other] != best:
            more = own - _price(dual, labels, cell, labels[other])
            if more > gain or (more == gain and labels[other] < best):
                best, gain = labels[other], more
    return best, gain


@entry
def _fill_gains(gains: Floats1, dual: Dual, labels: Ints1, stale: Ints1) -> None:
    for cell in stale:
        gains[cell] = _best_label(dual, labels, cell)[1]


@entry
def _settle_once(
    dual: Dual, labels: Ints1, order: Ints1, room: Floats1, n_of: Ints1, is_stale: Bools1, is_careful: bool
) -> int:
    """The cells of `order` take the best label of a neighbour one after the other, where that gains still.

    Those that do, and the cells beside them, are marked in `is_stale`.
    """
    moved = 0
    for cell in order:
        old = labels[cell]
        new, gain = _best_label(dual, labels, cell)
        if not gain > LEAST_GAIN * dual.size[cell] or n_of[old] == 1:
            continue
        if room[old] < dual.size[cell] and _voxels(dual, cell, new) < _voxels(dual, cell, old):
            continue
        if is_careful and not keeps_topology(
            dual.cells, dual.across, labels, dual.star_start, dual.star_cells, cell, new
        ):
            continue
        labels[cell] = new
        room[old] -= dual.size[cell]
        room[new] += dual.size[cell]
        n_of[old] -= 1
        n_of[new] += 1
        moved += 1
        is_stale[cell] = True
        for k in range(dual.across.shape[1]):
            if dual.across[cell, k] >= 0:
                is_stale[dual.across[cell, k]] = True
    return moved


@unit
def keeps_topology(
    cells: Ints2, across: Ints2, labels: Ints1, star_start: Ints1, star_cells: Ints1, cell: int, label: int
) -> bool:
    """Whether a cell may have another label without changing the topology of its own label or of the new one.

    A simple point in a complex of simplices: of either label, what the cell shares with its other cells and what it
    shares with all that is not of it, the outside among them, are discs. Pinches are topology, too.
    """
    rest = (cells, across, labels, star_start, star_cells, cell)
    old = labels[cell]
    return (
        _is_disc(*rest, old, True)
        and _is_disc(*rest, old, False)
        and _is_disc(*rest, label, True)
        and _is_disc(*rest, label, False)
    )


@unit
def _is_disc(
    cells: Ints2, across: Ints2, labels: Ints1, star_start: Ints1, star_cells: Ints1, cell: int,
    label: int, is_of: bool,
) -> bool:  # fmt: skip
    """Whether what a cell shares with the other cells of a label, or with those of others and the outside, is a disc.

    It is a disc of facets if there is one of them and not all, and nothing else is shared. Facets opposite the corners
    S cover all of the cell's surface but what contains all of S: only cells around the simplex S share more.
    """
    n, first, n_shared = cells.shape[1], -1, 0
    is_shared = np.zeros(4, dtype=np.bool_)
    for k in range(n):
        other = across[cell, k]
        is_shared[k] = (labels[other] == label) == is_of if other >= 0 else not is_of
        if is_shared[k]:
            n_shared, first = n_shared + 1, k
    if n_shared == 0 or n_shared == n:
        return False
    node = cells[cell, first]
    for r in range(star_start[node], star_start[node + 1]):
        other = star_cells[r]
        if other == cell or not _has_corners(cells, other, cell, is_shared):
            continue
        if (labels[other] == label) == is_of:
            return False
        for k in range(n):  # the outside, beyond a facet that has all of S, too
            if not is_of and across[other, k] < 0 and not _is_opposite(cells, other, k, cell, is_shared):
                return False
    # The cell's own facets outside are shared already: none of them contains all of S.
    return True


@helper
def _has_corners(cells: NDArray, other: int, cell: int, is_one: NDArray) -> bool:
    """Whether a cell has those corners of another one."""
    has_all = True
    for k in range(cells.shape[1]):
        has_all = has_all and (not is_one[k] or has_node(cells, other, cells[cell, k]))
    return has_all


@helper
def _is_opposite(cells: NDArray, other: int, k: int, cell: int, is_one: NDArray) -> bool:
    """Whether facet k of a cell lies opposite one of those corners of another cell."""
    is_opposite = False
    for m in range(cells.shape[1]):
        is_opposite = is_opposite or (is_one[m] and cells[cell, m] == cells[other, k])
    return is_opposite


def _without_fragments(
    dual: Dual, labels: NDArray[np.int64], is_bridge: NDArray[np.bool_], voxel: float, components: list[NDArray]
) -> int:
    """Components of cells that no component of voxels justifies are bridged or go; how many cells took another label.

    The components of a label are ranked by the voxels of it that they hold. The first stays, and each further one of
    whose rank there is a component of voxels, not far smaller. The others are linked to one of the same label, or,
    where that costs more than `BRIDGE_RATIO` of the voxels that are then lost, given to their neighbours cell by cell.
    """
    number, of_component = components_of(dual.across, labels)
    cell = np.repeat(np.arange(len(labels)), np.diff(dual.first))
    is_own = dual.row == labels[cell]
    content = np.bincount(number[cell], np.where(is_own, dual.volume, 0.0), len(of_component))
    # What a cell would hold of the best other label: at most so much is lost if it goes.
    others = np.maximum.reduceat(np.where(is_own, 0.0, dual.volume), dual.first[:-1])
    most = BRIDGE_RATIO * (content - np.bincount(number, others, len(of_component)))
    order = np.lexsort((np.arange(len(of_component)), -content, of_component))
    rank = np.empty(len(of_component), dtype=np.int64)
    rank[order] = np.arange(len(of_component)) - np.searchsorted(of_component[order], of_component[order])
    ranked = zip(of_component, rank, content, strict=True)
    stays = [
        k == 0 or (k < len(components[p]) and voxel * components[p][k] >= COMPONENT_FRACTION * c) for p, k, c in ranked
    ]
    is_loose, moved = ~np.array(stays)[number], 0
    way, before, bridge = np.full(len(labels), np.inf), np.empty_like(labels), np.empty_like(labels)
    sorted_cells, n_of = np.argsort(number, kind="stable"), np.bincount(labels, minlength=len(components))
    start = np.searchsorted(number[sorted_cells], np.arange(len(of_component) + 1))
    for component in order[~np.array(stays)[order]]:
        own = sorted_cells[start[component] : start[component + 1]]
        if (labels[own] != of_component[component]).any():  # another bridge goes over it
            continue
        count = _bridge(bridge, way, before, dual, labels, own, most[component])
        n_taken = np.bincount(labels[bridge[:count]], minlength=len(components))
        if count > 0 and ((n_taken == 0) | (n_taken < n_of)).all():  # no label goes for it
            labels[bridge[:count]] = of_component[component]
            n_of -= n_taken
            n_of[of_component[component]] += count
            is_loose[bridge[:count]] = is_loose[own] = False
            is_bridge[bridge[:count]] = True
            moved += count
    return moved + _give_away(dual, labels, is_loose)


@entry
def _bridge(
    bridge: Ints1, way: Floats1, before: Ints1, dual: Dual, labels: Ints1, component: Ints1, most: float
) -> int:
    """The cells by which a component is linked to another of its label at least cost, below `most`; how many there are.

    Dijkstra's shortest path: a step costs what it costs that its cell has the label, all others as they are. `way` is
    infinite before and after.
    """
    label, end, count = labels[component[0]], -1, 0
    heap = [(0.0, component[0])]
    for cell in component:
        way[cell], before[cell] = 0.0, -1
        if cell != component[0]:
            heapq.heappush(heap, (0.0, cell))
    done = [component[0] for _ in range(0)]
    while len(heap) > 0 and end < 0:
        so_far, cell = heapq.heappop(heap)
        if so_far > way[cell]:
            continue
        if labels[cell] == label and before[cell] >= 0:
            end = cell
            break
        for k in range(dual.across.shape[1]):
            other = dual.across[cell, k]
            if other < 0:
                continue
            price = _price(dual, labels, other, label) - _price(dual, labels, other, labels[other])
            there = so_far + (0.0 if labels[other] == label else max(price, LEAST_GAIN * dual.size[other]))
            if there < way[other] and there < most:
                way[other], before[other] = there, cell
                done.append(other)
                heapq.heappush(heap, (there, other))
    while end >= 0 and before[before[end]] >= 0:
        end = before[end]
        bridge[count] = end
        count += 1
    for cell in done:
        way[cell] = np.inf
    for cell in component:
        way[cell] = np.inf
    return count


@entry
def _give_away(dual: Dual, labels: Ints1, is_loose: Bools1) -> int:
    """Loose cells take the label of least price among those of neighbours that are not, from the outside in."""
    total, moved = 0, 1
    while moved > 0:
        moved = 0
        for cell in range(len(labels)):
            if not is_loose[cell]:
                continue
            best, least = -1, np.inf
            for k in range(dual.across.shape[1]):
                other = dual.across[cell, k]
                if other >= 0 and not is_loose[other]:
                    price = _price(dual, labels, cell, labels[other])
                    if price < least or (price == least and labels[other] < best):
                        best, least = labels[other], price
            if best >= 0:
                labels[cell], is_loose[cell] = best, False
                moved += 1
        total += moved
    return total


# What is not manifold, at an edge (a, b) or a node (a, -1), and how it is mended.


class _Work(NamedTuple):
    """Room for the kernels below."""

    star: Ints1  # the cells around one node or edge
    label: Ints1  # the labels that these have, each once
    own: Ints1  # which of those each of them has
    beside: Ints2  # where in the star the cells beyond its facets are: its length for the outside, -1 if not around it
    root: Ints1  # of each of them, in the fan that it is in
    place: Ints1  # (M,) where a cell is in the star; -1 in between
    steps: Ints1  # (N,) between labels, at facets around the edge from one node to another; 0 in between


def _work(dual: Dual) -> _Work:
    widest = int(np.diff(dual.star_start).max())
    star, label, own, root = (np.empty(widest + 1, dtype=np.int64) for _ in range(4))
    beside, place = np.empty((widest, dual.cells.shape[1]), dtype=np.int64), np.full(len(dual.cells), -1)
    return _Work(star, label, own, beside, root, place, np.zeros(len(dual.scale), dtype=np.int64))


def _nonmanifold(
    dual: Dual, labels: NDArray[np.int64], is_near: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Edges (a, b) and nodes (a, -1) where a label's interface is not manifold, (F, 2), and where two labels meet.

    All of them, or those with a node that is near.
    """
    # As many as there can be; pages that are not written to take no room.
    faces = np.empty((len(dual.scale) + 6 * len(labels), 3), dtype=np.int64)
    is_near = np.ones(len(dual.scale), dtype=bool) if is_near is None else is_near
    faces = faces[: _find_nonmanifold(faces, dual, labels, is_near, _work(dual))].copy()
    return np.ascontiguousarray(faces[:, :2]), faces[:, 2] == 2


def _mended(dual: Dual, labels: NDArray[np.int64], is_bridge: NDArray[np.bool_], least: NDArray[np.float64]) -> int:
    """What is not manifold is mended where that lowers the energy; how many cells took another label.

    Bridges stay, and no label goes below its volume `least`.
    """
    total, moved, is_near = 0, 1, None
    room = np.bincount(labels, dual.size, len(least)) - least
    while moved > 0:
        faces, is_near = _nonmanifold(dual, labels, is_near)[0], np.zeros(len(dual.scale), dtype=bool)
        moved = _mend(dual, labels, room, is_bridge, faces, is_near, _work(dual))
        total += moved
    return total


def _mend_pairs(dual: Dual, labels: NDArray[np.int64], least: NDArray[np.float64]) -> None:
    """What is left where two labels meet is mended even if a bridge goes by it."""
    faces, is_two = _nonmanifold(dual, labels)
    room = np.bincount(labels, dual.size, len(least)) - least
    is_bridge, is_near = np.zeros(len(labels), dtype=bool), np.zeros(len(dual.scale), dtype=bool)
    _mend(dual, labels, room, is_bridge, faces[is_two], is_near, _work(dual))


@entry
def _find_nonmanifold(faces: Ints2, dual: Dual, labels: Ints1, is_near: Bools1, work: _Work) -> int:
    """The rows of `_nonmanifold` and the number of labels that meet there, (F, 3); their count."""
    count, is_around = 0, _around(dual, is_near)
    for a in range(len(is_around)):
        if not is_around[a]:
            continue
        fault, n_labels = _fault(dual, labels, a, -1, work) if is_near[a] else (0.0, 2)
        if n_labels == 1:
            continue
        if fault > 0.0:
            faces[count, 0], faces[count, 1], faces[count, 2] = a, -1, n_labels
            count += 1
        first, last = dual.star_start[a], dual.star_start[a + 1] if dual.cells.shape[1] == 4 else 0
        _count_steps(dual, labels, a, work.steps)
        for r in range(first, last):
            for k in range(4):
                b = dual.cells[dual.star_cells[r], k]
                if b <= a or work.steps[b] < DOUBTFUL_STEPS or not (is_near[a] or is_near[b]):
                    continue
                work.steps[b] = 0
                fault, n_labels = _fault(dual, labels, a, b, work)
                if fault > 0.0:
                    faces[count, 0], faces[count, 1], faces[count, 2] = a, b, n_labels
                    count += 1
        for r in range(first, last):
            for k in range(4):
                work.steps[dual.cells[dual.star_cells[r], k]] = 0
    return count


@helper
def _around(dual: Dual, is_near: NDArray) -> NDArray:
    """Whether a cell around each node has a node that is near."""
    is_around = np.zeros(len(is_near), dtype=np.bool_)
    for node in range(len(is_near)):
        for r in range(dual.star_start[node], dual.star_start[node + 1] if is_near[node] else 0):
            for k in range(dual.cells.shape[1]):
                is_around[dual.cells[dual.star_cells[r], k]] = True
    return is_around


@helper
def _count_steps(dual: Dual, labels: NDArray, a: int, steps: NDArray) -> None:
    """Add to `steps` of each node b how many facets around the edge (a, b) lie between labels, from either side.

    A facet outside counts once more, one between labels that are apart as many as are doubtful: with less than
    `DOUBTFUL_STEPS` labels are one fan each, and need no `_fault`: so that finding faults takes a fifth of the time.
    """
    for r in range(dual.star_start[a], dual.star_start[a + 1] if dual.cells.shape[1] == 4 else 0):
        cell = dual.star_cells[r]
        for k in range(4):
            other = dual.across[cell, k]
            if dual.cells[cell, k] == a or (other >= 0 and labels[other] == labels[cell]):
                continue
            is_apart = other >= 0 and dual.contacts.is_apart[labels[cell], labels[other]]
            for m in range(4):
                if m != k:
                    steps[dual.cells[cell, m]] += DOUBTFUL_STEPS if is_apart else 2 if other < 0 else 1


@helper
def _gather(dual: Dual, a: int, b: int, star: NDArray) -> int:
    """The cells around a node, or around an edge with b >= 0, and how many they are."""
    count = 0
    for r in range(dual.star_start[a], dual.star_start[a + 1]):
        if b < 0 or has_node(dual.cells, dual.star_cells[r], b):
            star[count] = dual.star_cells[r]
            count += 1
    return count


@unit
def _fault(dual: Dual, labels: Ints1, a: int, b: int, work: _Work) -> tuple[float, int]:
    """What is wrong at a node or an edge, in volumes of the cells around it: pinches, and false contact.

    The number of labels there comes second; with false contact, which is no matter of manifolds, three or more.
    """
    count = _gather(dual, a, b, work.star)
    n_labels = _tell_apart(labels, count, work)
    if n_labels == 1:
        return 0.0, 1
    excess = _excess(dual, labels, a, b, count, n_labels, work)
    fault = (TWO_LABELS_WEIGHT if n_labels == 2 else MORE_LABELS_WEIGHT) * excess
    if _has_false_contact(dual, count, n_labels, work):
        fault += APART_WEIGHT
        n_labels = n_labels if excess > 0 else max(n_labels, 3)
    return fault, n_labels


@helper
def _tell_apart(labels: NDArray, count: int, work: _Work) -> int:
    """How many labels the cells of a star have; which, and which of them each cell has, is noted."""
    n_labels, own = 0, 0
    for i in range(count):
        label = labels[work.star[i]]
        if i == 0 or work.label[own] != label:
            own = 0
            while own < n_labels and work.label[own] != label:
                own += 1
            if own == n_labels:
                work.label[own] = label
                n_labels += 1
        work.own[i] = own
    return n_labels


@helper
def _excess(dual: Dual, labels: NDArray, a: int, b: int, count: int, n_labels: int, work: _Work) -> int:
    """How many fans too many there are around a node or an edge, over all labels there.

    For each label, the fans of its cells less one and those of all others, the outside among them, less one.
    """
    steps, n_outer = 0, 0
    for i in range(count if b >= 0 else 0):
        for k in range(4):
            if dual.cells[work.star[i], k] != a and dual.cells[work.star[i], k] != b:
                other = dual.across[work.star[i], k]
                n_outer += other < 0
                steps += other >= 0 and labels[other] != labels[work.star[i]]
    if b >= 0 and n_outer <= 2:  # a ring of cells, or one that the outside closes: each of its arcs is a fan
        return steps + n_outer - 2 * n_labels
    is_open, excess = _link(dual, a, b, count, work), 0
    if n_labels == 2 and not is_open:  # what is not of the one label is of the other
        return 2 * (_fans(dual, count, 0, is_open, work) - 2)
    for own in range(n_labels):
        excess += _fans(dual, count, own, is_open, work) - 2
    return excess


@helper
def _link(dual: Dual, a: int, b: int, count: int, work: _Work) -> bool:
    """Note where in a star the cells beyond its facets are; whether one of them is outside."""
    is_open = False
    for i in range(count):
        work.place[work.star[i]] = i
    for i in range(count):
        cell = work.star[i]
        for k in range(dual.cells.shape[1]):
            other = dual.across[cell, k]
            is_around = dual.cells[cell, k] != a and dual.cells[cell, k] != b
            is_open = is_open or (is_around and other < 0)
            work.beside[i, k] = -1 if not is_around else count if other < 0 else work.place[other]
    for i in range(count):
        work.place[work.star[i]] = -1
    return is_open


@helper
def _has_false_contact(dual: Dual, count: int, n_labels: int, work: _Work) -> bool:
    """Whether labels of some cells meet that the voxels of all these cells keep apart."""
    is_false = False
    for i in range(n_labels):
        for j in range(i):
            is_false = is_false or dual.contacts.is_apart[work.label[i], work.label[j]]
    for i in range(count if is_false else 0):
        is_false = is_false and not dual.contacts.is_place[work.star[i]]
    return is_false


@helper
def _fans(dual: Dual, count: int, own: int, is_open: bool, work: _Work) -> int:
    """Fans of a label's cells in a star and of all others, the outside among them: linked by facets around it."""
    root, n_fans = work.root, count  # the last of the roots is the outside's
    for i in range(count + 1):
        root[i] = i
    for i in range(count):
        for k in range(dual.cells.shape[1]):
            j = work.beside[i, k]
            if j < i or (work.own[i] == own) != (j < count and work.own[j] == own):
                continue
            p, q = i, j
            while root[p] != p:
                p = root[p]
            while root[q] != q:
                q = root[q]
            if p != q:
                root[p] = q
                n_fans -= 1
    return n_fans + 1 if is_open else n_fans


@entry
def _mend(
    dual: Dual, labels: Ints1, room: Floats1, is_bridge: Bools1, faces: Ints2, is_near: Bools1, work: _Work
) -> int:
    """Each face that is not manifold takes the move that lowers the energy with what is not manifold most.

    Nodes of cells that changed are marked in `is_near`.
    """
    total, star, group = 0, np.empty_like(work.star), np.empty_like(work.star)
    for f in range(len(faces)):
        a, b = faces[f, 0], faces[f, 1]
        if _fault(dual, labels, a, b, work)[0] == 0.0:
            continue
        count = _gather(dual, a, b, star)
        best, best_from, best_label = -LEAST_GAIN * dual.scale[a], -1, -1
        for i in range(2 * count):
            size = _group(dual, labels, a, b, star[:count], i, group)
            if size == 0 or room[labels[group[0]]] < dual.size[group[:size]].sum() or is_bridge[group[:size]].any():
                continue
            new, change = _best_of_group(dual, labels, group[:size], star[:count], best, work)
            if new >= 0:
                best, best_from, best_label = change, i, new
        if best_from >= 0:
            size = _group(dual, labels, a, b, star[:count], best_from, group)
            volume = dual.size[group[:size]].sum()
            room[labels[group[0]]] -= volume
            room[best_label] += volume
            for cell in group[:size]:
                labels[cell] = best_label
                for k in range(dual.cells.shape[1]):
                    is_near[dual.cells[cell, k]] = True
            total += size
    return total


@unit
def _group(dual: Dual, labels: Ints1, a: int, b: int, star: Ints1, i: int, group: Ints1) -> int:
    """Cells that may change together: cell i of a star; for i beyond these, the fan of one label that it begins."""
    if i < len(star):
        group[0] = star[i]
        return 1
    first, count, done = star[i - len(star)], 1, 0
    group[0] = first
    while done < count:
        cell = group[done]
        done += 1
        for k in range(dual.cells.shape[1]):
            other = dual.across[cell, k]
            if dual.cells[cell, k] in (a, b) or other < 0 or labels[other] != labels[first]:
                continue
            is_new = True
            for j in range(count):
                is_new = is_new and group[j] != other
            if is_new:
                group[count] = other
                count += 1
            if other < first:
                return 0  # another cell begins it
    return count if count > 1 else 0


@unit
def _best_of_group(
    dual: Dual, labels: Ints1, group: Ints1, star: Ints1, least: float, work: _Work
) -> tuple[int, float]:
    """The label in the star that lowers the energy most if the group takes it, and the change: below `least`, or -1."""
    old, best, faces = labels[group[0]], -1, np.empty((0, 2), dtype=np.int64)
    before, pinches = 0.0, 0.0
    for j in range(len(star)):
        new = labels[star[j]]
        is_new = new != old and _touches(dual, labels, group, new)
        for i in range(j):
            is_new = is_new and labels[star[i]] != new
        if not is_new:
            continue
        if len(faces) == 0:
            faces = _closure(dual, group)
            before, pinches = _prices(dual, labels, group), _pinches(dual, labels, faces, 0.0, np.inf, work)
        for cell in group:
            labels[cell] = new
        change = _prices(dual, labels, group) - before - pinches
        if change < least:  # with all pinches gone
            change += _pinches(dual, labels, faces, change, least, work)
        for cell in group:
            labels[cell] = old
        if change < least:
            best, least = new, change
    return best, least


@helper
def _touches(dual: Dual, labels: NDArray, group: NDArray, label: int) -> bool:
    """Whether a cell of a label lies across a facet of the group."""
    for cell in group:
        for k in range(dual.across.shape[1]):
            if dual.across[cell, k] >= 0 and labels[dual.across[cell, k]] == label:
                return True
    return False


@helper
def _closure(dual: Dual, group: NDArray) -> NDArray:
    """Nodes (a, -1) and, in 3-D, edges (a, b) of some cells, each once, (F, 2)."""
    n = dual.cells.shape[1]
    faces, count = np.empty((len(group) * (n + n * (n - 1) // 2), 2), dtype=np.int64), 0
    for cell in group:
        for k in range(n):
            for m in range(k, n if n == 4 else k + 1):
                a, b = dual.cells[cell, k], dual.cells[cell, m]
                a, b = (a, -1) if k == m else (min(a, b), max(a, b))
                is_new = True
                for i in range(count):
                    is_new = is_new and (faces[i, 0] != a or faces[i, 1] != b)
                if is_new:
                    faces[count, 0], faces[count, 1] = a, b
                    count += 1
    return faces[:count]


@helper
def _prices(dual: Dual, labels: NDArray, group: NDArray) -> float:
    """The part of the energy that the label of a group of cells, one for all, decides."""
    total = 0.0
    for cell in group:
        total += _price(dual, labels, cell, labels[cell])
    return total


@unit
def _pinches(dual: Dual, labels: Ints1, faces: Ints2, others: float, most: float, work: _Work) -> float:
    """What these nodes and edges cost that are not manifold; or less, where that and the others' are `most` or more."""
    total = 0.0
    for f in range(len(faces)):
        total += _fault(dual, labels, faces[f, 0], faces[f, 1], work)[0] * dual.scale[faces[f, 0]]
        if others + total >= most:
            break
    return total
