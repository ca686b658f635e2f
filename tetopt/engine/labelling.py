"""Labels of cells: connected labels with short, manifold interfaces.

The labels minimise a Potts energy on the dual graph of a fixed mesh (Boykov, Veksler, Zabih 2001),

    sum over cells of the volume of voxels with other labels than the cell's
    - sum over cells of the bias of the cell's label x its volume
    + sum over facets between cells of different labels of tension x area,

where the tension, in mm, is the distance that a surface would move to reduce its area. A ball with
a radius below three tensions, or a sheet thinner than two, costs more than it gains. A label that
is thinner than cells has most of the voxels in few of them: its bias, one number, is in proportion
to the volume that its cells lack, up to a bound. The tension is higher between labels that touch
nowhere in the voxels, or only at a few places: cells between them get the label of the sheet that
separates them, which would tear otherwise. Starting from the label of most voxels in each cell,
cells take the label of a neighbour, the best move first, as long as the energy falls. Then
components of cells that no component of voxels justifies go to their neighbours, and places that
are not manifold are mended by the cheapest cells around them.

An interface is manifold at an edge or a node if, for each label there, its cells around it form one
fan, and all other cells including the outside form one fan, too: linked by facets that contain the
edge or the node.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.labels import COMPONENT_VOXELS
from tetopt.engine.complex import has_node
from tetopt.geometry.simplex import facet_areas, regular_edge, volumes
from tetopt.geometry.topology import stars
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernels import (
    Bools1,
    Bools2,
    Floats1,
    Floats2,
    Ints1,
    Ints2,
    entry,
    helper,
    unit,
)
from tetopt.system.slabs import over_slabs, sum_over_slabs

# of the local edge; with 0.1, white matter keeps .83, not .87, of its area (MNI152, 5,000)
TENSION_FRACTION = 0.05
FRAGMENT_FRACTION = 0.1  # of a label's volume: larger components of cells are not given away
# of the volume of a label, or of a mean cell if that is less: with no more, it is dropped
UNFIT_FRACTION = 0.3
# least voxels of a component of voxels, relative to those of a component of cells, to justify the
# latter
COMPONENT_FRACTION = 0.5
# cost of a bridge relative to the voxels lost otherwise; with 1 a coarse mesh loses half a rib
BRIDGE_RATIO = 3.0
MENDING_ROUNDS = 6  # of fragments and mending, at most; the second usually has nothing left to do
# volumes of the cells around: pinches between two labels are removed at any cost
TWO_LABELS_WEIGHT = 20.0
MORE_LABELS_WEIGHT = 2.0  # where more labels meet; with .3, fluid has twice as many pinches
APART_TENSION = 10.0  # times the usual, between labels that are separate in the voxels
PLACE_TENSION = 3.0  # the same, at places where they touch
# where such labels meet only at a node or an edge: a sheet between them is pierced
APART_WEIGHT = 10.0
# of the surface of two labels: pairs with less contact touch only at places
LEAST_CONTACT_FRACTION = 0.1
BALANCE_ROUNDS = 10  # of labelling and balancing; more hardly change it
FIRST_BALANCE_STEP = 0.2  # longest change of a bias in one of them, at first
# bias of a label over the fraction of its volume that it lacks, in cells labelled so far,
BIAS_PER_LOSS = 3.0
MOST_BIAS = 0.4  # of a cell's volume, at most, which bounds the overlap that volume costs, unless
# the loss but for a tenth is more: a label that would lose half of its volume or more gets it back
SPARED_LOSS = 0.1
LEAST_SHARE = 0.05  # of a cell's volume: a label with less of it does not get the cell
TRIED_CELLS = 5  # cells for a piece, the best first, tried for one that leaves interfaces manifold
# of the cell that it gets; with .2, fluid has a Dice of .634, not .639 (MNI152, 5,000 nodes)
PIECE_SHARE = 0.3
# of a label's volume, or a component's: a larger cell does not become its only one
MOST_FILLED = 1.5
LEAST_GAIN = 1e-9  # of a cell's volume: smaller gains are rounding
DOUBTFUL_STEPS = 8  # see `_count_steps`
STAR_CELLS = 100  # work per node in a search for faults, in the unit of `over_slabs`


class Pass(NamedTuple):
    """Limits of one pass of mending."""

    # of a label's volume near its surface, the most that its cells may lack and exceed
    loss: float
    gain: float
    is_wide: bool = False  # True: also where three or more labels meet
    has_pairs: bool = False  # True: two cells may change together
    has_contacts: bool = True  # False: labels that are apart may touch


# The first also limits what tension may take. With .1 and .2 of the whole volume in it, Dice of
# white matter is .866, not .884 (MNI152, 5,000 nodes), and ribs of a CT have .57 of their volume,
# not .68. With the last one of a labelling alone, a ball of 46 cells loses a third.
CHEAP_PASS = Pass(0.1, 0.05, is_wide=True)
LAST_PASSES = Pass(0.1, 0.2), Pass(0.35, 0.5), Pass(0.95, 2.0)
ANY_VOLUME = 1e9  # of the volume near a surface: at any cost
# of a finished mesh; false contact may forbid all moves that are left
FINAL_PASSES = (
    Pass(ANY_VOLUME, ANY_VOLUME, has_pairs=True),
    Pass(ANY_VOLUME, ANY_VOLUME, has_pairs=True, has_contacts=False),
)


class Pieces(NamedTuple):
    """Components of voxels that are to have a cell: of `COMPONENT_VOXELS` or more, but not the
    largest of a label.
    """

    label: Ints1  # (P,)
    voxels: Ints1  # (V,) flat indices of their voxels
    piece: Ints1  # (V,) the piece of each


class Contacts(NamedTuple):
    """Contacts of labels in the voxels."""

    is_apart: Bools2  # (K, K) pairs that do not touch, or only at few places
    is_place: Bools1  # (M,) cells with a voxel at such a place


class LabelVoxels(NamedTuple):
    """Information on the voxels of labels for any mesh; made by `label_voxels`."""

    components: list[Ints]  # voxels in each component of each label, descending
    pieces: Pieces
    is_apart: Bools  # (K, K) as in `Contacts`
    # flat indices of voxels next to one of a label that is apart from theirs
    places: Ints


class Contents(NamedTuple):
    """Information on the voxels in a mesh's cells; made by `interfaces.cell_contents`."""

    # (M, K) voxels of each label, with fractions of a voxel; no row is empty
    counts: scipy.sparse.csr_array
    contacts: Contacts | None = None
    pieces: scipy.sparse.csr_array | None = None  # (P, M) voxels of each of `Pieces`
    label_of_piece: Ints = np.empty(0, dtype=np.int64)  # (P,)


class Dual(NamedTuple):
    """Adjacency of a mesh's cells, and their voxels."""

    cells: Ints2  # (M, n+1)
    across: Ints2  # (M, n+1) the cell beyond each facet; -1 outside
    star_start: Ints1  # (N+1,)
    star_cells: Ints1  # (M (n+1),) the cells around each node, ascending
    size: Floats1  # (M,) volumes, mm^n
    scale: Floats1  # (N,) mean volume of the cells around each node
    # (M, n+1) cost of each facet between different labels, mm^n; 0 on the boundary
    tension: Floats2
    first: Ints1  # (M+1,) start of each cell's row of voxels
    row: Ints1  # labels in it
    volume: Floats1  # of their voxels in it, mm^n
    contacts: Contacts
    bias: Floats1  # (K,) bonus of each label, by volume; see `label_cells`


class Targets(NamedTuple):
    """Volumes of labels, (K,) mm^n."""

    volume: Floats1  # of their voxels
    near: Floats1  # of those near their surfaces
    fit: Floats1  # below which cells are next to nothing of a label, and of a mean cell

    def bounds(self, limits: Pass) -> Floats:
        """The least and largest volumes that a pass allows, (2, K)."""
        least = np.maximum(self.volume - limits.loss * self.near, self.fit)
        return np.stack([least, self.volume + limits.gain * self.near])


def label_cells(
    points: Floats,
    cells: Ints,
    across: Ints,
    contents: Contents,
    components: list[NDArray],
    keeps_volumes: bool = True,
) -> Ints:
    """Label each cell of a mesh close to its voxels, with short, manifold interfaces and without
    fragments.

    The iteration ends, since every move except that of fragments lowers an energy, and fragments
    are moved at most `MENDING_ROUNDS` times. A label that is the most frequent in some cell keeps
    at least one cell, unless its cells have next to nothing of it and of a mean cell
    (`UNFIT_FRACTION`). So does a large component of voxels that fills a good part of some cell of
    about its volume (`PIECE_SHARE`).

    Parameters
    ----------
    points : (N, n) float64
        Nodes, mm.
    cells : (M, n+1) int64
        Positively oriented.
    across : (M, n+1) int64
        The cell beyond each facet, opposite each corner; -1 outside.
    contents : Contents
        Voxels of each label, and of pieces of labels, in each cell.
    components : list of K arrays
        Voxels in each component of each label, descending: `label_voxels`. As many components of
        cells may stay.
    keeps_volumes : bool
        Give a bonus to labels that lack volume: a label that is thinner than cells has most of the
        voxels in few of them. The bonus is in proportion to the loss, so that the overlap that it
        costs is bounded (`MOST_BIAS`). Large components of voxels keep a cell, too.

    Returns
    -------
    (M,) int64
        The label of each cell, as rows of the labels.
    """
    dual = _dual(points, cells, across, contents)
    voxel = float(dual.volume.sum() / contents.counts.sum())
    targets = _targets(dual, np.bincount(dual.row, dual.volume, len(dual.bias)))
    labels = _settle_majority(dual, targets, voxel * contents.counts, keeps_volumes)
    marks = _marks(dual)
    _mend_cheaply(dual, labels, targets, voxel, components, marks)
    _give_away_unfit(dual, labels, targets.volume)
    is_kept = np.zeros(len(labels), dtype=bool)
    if keeps_volumes and contents.pieces is not None:
        rows = voxel * contents.pieces
        _give_cells(dual, labels, is_kept, rows, contents.label_of_piece, PIECE_SHARE)
    for limits in LAST_PASSES:
        mend(dual, labels, is_kept, targets, limits, marks)
    return labels


def mend_labels(
    points: Floats,
    cells: Ints,
    across: Ints,
    contents: Contents,
    labels: Ints,
    aim: Floats,
) -> Ints:
    """Labels of cells, (M,), with the fewest changes that make interfaces of two labels manifold,
    at any cost.

    Arguments as for `label_cells`, and the volume `aim`, (K,) mm^n, of each label's voxels. Labels
    that moves have left without a fit cell are dropped; no other becomes unfit. Pinches that cannot
    be mended remain.
    """
    labels, dual = labels.copy(), _dual(points, cells, across, contents)
    _give_away_unfit(dual, labels, aim)
    for limits in FINAL_PASSES:
        mend(dual, labels, np.zeros(len(labels), dtype=bool), _targets(dual, aim), limits)
    return labels


def mend(
    dual: Dual,
    labels: Ints,
    is_kept: Bools,
    targets: Targets,
    limits: Pass,
    marks: _Marks | None = None,
) -> None:
    """Mend places that are not manifold, if that lowers the energy.

    Cells of `is_kept`, (M,), stay, and labels keep within the limits of their volumes. With the
    marks of an earlier pass of the same bias and contacts, places are not tried where nothing has
    changed since they failed.
    """
    if not limits.has_contacts:
        dual = dual._replace(contacts=_no_contacts(len(labels), len(dual.bias)))
    marks = marks or _marks(dual)
    volume, (least, most) = _label_volumes(dual, labels), targets.bounds(limits)
    room = np.stack([volume - least, most - volume])
    marks.is_near[dual.cells[labels != marks.labels]] = True
    is_changed = marks.is_near[dual.cells].any(axis=1)
    marks.is_due[dual.cells[is_changed]] = True
    marks.rise[is_changed] = -np.inf
    marks.is_near[marks.is_due & ~marks.is_sound] = True
    while marks.is_near.any():
        faces, is_two = _nonmanifold(dual, labels, marks.is_near)
        marks.is_sound[marks.is_near] = True
        marks.is_sound[faces[faces >= 0]] = False
        marks.is_due[marks.is_near] = False  # all places at these nodes are tried
        marks.is_near[:] = False
        faces = faces if limits.is_wide else faces[is_two]
        _mend_places(dual, labels, room, is_kept, faces, limits.has_pairs, marks)
    marks.labels[:] = labels


def _targets(dual: Dual, aim: NDArray) -> Targets:
    """`Targets` of labels with the volume `aim`, (K,) mm^n.

    The volume near a label's surface is that of its voxels but for those in cells that, like all
    cells beside them, have most of it.
    """
    labels, cell = _majority(dual), np.repeat(np.arange(len(dual.cells)), np.diff(dual.first))
    beside = np.where(dual.across >= 0, labels[dual.across], labels[:, None])
    is_inner = (beside == labels[:, None]).all(axis=1)[cell] & (dual.row == labels[cell])
    inner = np.bincount(dual.row[is_inner], dual.volume[is_inner], len(aim))
    fit = np.maximum(_least_fit(dual.size, aim), dual.size.min())
    return Targets(aim, aim - inner, fit)


def _label_volumes(dual: Dual, labels: Ints) -> NDArray:
    """Volume of each label's cells, (K,) mm^n."""
    return np.bincount(labels, dual.size, len(dual.bias))


def _settle_majority(
    dual: Dual, targets: Targets, voxels: scipy.sparse.csr_array, keeps_volumes: bool
) -> Ints:
    """Labels of most of each cell's voxels, (M,), settled; `voxels` (M, K) in mm^n.

    If volumes are kept, labels get the bias that gives them nearly their volumes: in proportion to
    the fraction that their cells lack, in steps that are halved if they go too far; and a cell each
    where one fits. Tension leaves each label the least volume of `CHEAP_PASS`.
    """
    aim, least = targets.volume, targets.bounds(CHEAP_PASS)[0]
    longest, before = np.full(len(aim), FIRST_BALANCE_STEP), np.zeros(len(aim))
    of_labels, least_wrong = voxels.T.tocsr(), np.inf
    for _ in range(BALANCE_ROUNDS if keeps_volumes else 1):
        labels = _majority(dual)
        if keeps_volumes:
            nothing = np.zeros(len(labels), dtype=bool)
            _give_cells(dual, labels, nothing, of_labels, np.arange(len(aim)), LEAST_SHARE)
        _settle(dual, labels, least, False)
        volume = _label_volumes(dual, labels)
        wrong = float(np.abs(volume - aim).sum())
        if wrong < least_wrong:
            least_wrong, best, bias_of_best = wrong, labels, dual.bias.copy()
        loss = 1.0 - volume / np.where(aim > 0.0, aim, np.inf)
        bias = np.maximum(np.clip(BIAS_PER_LOSS * loss, 0.0, MOST_BIAS), loss - SPARED_LOSS)
        step = bias * (aim > 0.0) - dual.bias
        longest = np.where(step * before < 0.0, 0.5 * longest, longest)
        before = np.clip(step, -longest, longest)
        if not before.any():
            break
        dual.bias[:] += before
    dual.bias[:] = bias_of_best
    return best


def _mend_cheaply(
    dual: Dual,
    labels: Ints,
    targets: Targets,
    voxel: float,
    components: list[NDArray],
    marks: _Marks,
) -> None:
    """Remove fragments, and pinches where that is cheap, and settle; `voxel` in mm^n."""
    is_bridge = np.zeros(len(labels), dtype=bool)
    least = targets.bounds(CHEAP_PASS)[0]
    for _ in range(MENDING_ROUNDS):
        before = labels.copy(), is_bridge.copy()
        _without_fragments(dual, labels, is_bridge, targets.volume, voxel, components)
        mend(dual, labels, is_bridge, targets, CHEAP_PASS, marks)
        _settle(dual, labels, least, True)
        # what one step of a round changed, another undid
        if all(map(np.array_equal, before, (labels, is_bridge))):
            break


def unfit_labels(labels: Ints, size: Floats, aim: Floats) -> Bools:
    """Mask of labels, (K,), whose cells are next to nothing of their volume `aim`, (K,) mm^n,
    and of a mean cell.
    """
    volume = np.bincount(labels, size, len(aim))
    return (volume > 0.0) & (volume < _least_fit(size, aim))


def _least_fit(size: Floats, aim: Floats) -> Floats:
    return UNFIT_FRACTION * np.minimum(aim, size.mean())


def _give_away_unfit(dual: Dual, labels: Ints, aim: Floats) -> None:
    _give_away(dual, labels, unfit_labels(labels, dual.size, aim)[labels])


def _give_cells(
    dual: Dual,
    labels: Ints,
    is_kept: Bools,
    rows: scipy.sparse.csr_array,
    label_of_row: Ints,
    least_share: float,
) -> None:
    """Give each of some parts of labels without a cell of its label the cell that it fits best, if
    one does.

    `rows`, (R, M) mm^n, is what cells have of each part: at least a share of the cell. Cells with
    which interfaces remain manifold go first. These cells are marked in `is_kept`, (M,), as mending
    would give most others away again.
    """
    n_of, work = np.bincount(labels, minlength=len(dual.bias)), _work(dual)
    for row, label in enumerate(label_of_row):
        own = slice(rows.indptr[row], rows.indptr[row + 1])
        cells, volume = rows.indices[own], rows.data[own]
        if (labels[cells] == label).any():
            continue
        size = dual.size[cells]
        is_fit = (volume >= least_share * size) & (size <= MOST_FILLED * volume.sum())
        is_fit &= (n_of[labels[cells]] > 1) & ~is_kept[cells]
        if not is_fit.any():
            continue
        fit = cells[is_fit][np.argsort(-(2.0 * volume - size)[is_fit], kind="stable")]
        best = next(
            (cell for cell in fit[:TRIED_CELLS] if _is_manifold(dual, labels, cell, label, work)),
            fit[0],
        )
        n_of[[labels[best], label]] += -1, 1
        labels[best], is_kept[best] = label, True


@entry
def _is_manifold(dual: Dual, labels: Ints1, cell: int, label: int, work: _Work) -> bool:
    """True if interfaces of two labels are manifold at a cell's nodes and edges once it has this
    label.
    """
    old, faces, is_one = labels[cell], _closure(dual, np.array([cell])), True
    labels[cell] = label
    for f in range(len(faces)):
        fault, n_labels = _fault(dual, labels, faces[f, 0], faces[f, 1], work)
        is_one = is_one and (fault == 0.0 or n_labels != 2)
    labels[cell] = old
    return is_one


def _components(
    partition: NDArray[np.integer], n_labels: int, least: int
) -> tuple[list[Ints], Pieces]:
    """Number of voxels in each face-connected component of each label, descending; and pieces of
    `least` or more.
    """
    sizes = [np.empty(0, dtype=np.int64)] * n_labels
    label_of: list[int] = []
    voxels, piece = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for label, box in enumerate(scipy.ndimage.find_objects(partition + 1, n_labels)):
        if box is None:
            continue
        number = scipy.ndimage.label(partition[box] == label)[0]
        n_voxels = np.bincount(number.ravel())
        sizes[label] = np.sort(n_voxels[1:])[::-1]
        is_piece = n_voxels >= least
        is_piece[0] = is_piece[1 + int(np.argmax(n_voxels[1:]))] = False
        place = np.nonzero(is_piece[number])
        piece.append((len(label_of) - 1 + np.cumsum(is_piece))[number[place]])
        voxels.append(
            np.ravel_multi_index(
                [i + side.start for i, side in zip(place, box, strict=True)], partition.shape
            )
        )
        label_of += [label] * int(is_piece.sum())
    return sizes, Pieces(
        np.array(label_of, dtype=np.int64), np.concatenate(voxels), np.concatenate(piece)
    )


def label_voxels(
    partition: NDArray[np.integer], spacing: Floats, n_labels: int, parts: int = 1
) -> LabelVoxels:
    """Components of labels in the voxels of a grid, pairs that share hardly any area, and places
    where these touch.

    `partition` has -1 at voxels outside a mask, which neither link components nor touch a label.
    Voxels of the labels are divided into `parts` of its own.
    """
    n_rows, n_voxels = n_labels + 1, partition.size  # the last row: outside

    def count(first: int, stop: int) -> Ints:
        counts = np.empty((partition.ndim, n_rows * n_rows), dtype=np.int64)
        for d in range(partition.ndim):
            rows = np.moveaxis(partition[first : stop + (d == 0)], d, 0)
            pairs = n_rows * (rows[:-1] % n_rows) + rows[1:] % n_rows
            counts[d] = np.bincount(pairs.ravel(), minlength=counts.shape[1])
        return counts

    faces = np.prod(spacing) / spacing
    counts = sum_over_slabs(count, len(partition), n_voxels, partition.ndim * n_rows**2)
    area = (faces[:, None] * counts).sum(axis=0)
    area = area.reshape(n_rows, n_rows) + area.reshape(n_rows, n_rows).T
    np.fill_diagonal(area, 0.0)
    area[-1] = area[:, -1] = 0.0
    surface = area.sum(axis=1)
    is_apart = area < LEAST_CONTACT_FRACTION * np.minimum(surface[:, None], surface)
    np.fill_diagonal(is_apart, False)
    is_place = np.zeros(partition.shape, dtype=bool)

    def mark(first: int, stop: int) -> None:
        low = max(first - 1, 0)
        part = partition[low : stop + 1]
        is_met = np.zeros(part.shape, dtype=bool)
        for d in range(part.ndim):
            rows, here = np.moveaxis(part, d, 0), np.moveaxis(is_met, d, 0)
            is_between = is_apart[rows[:-1], rows[1:]]
            here[:-1] |= is_between
            here[1:] |= is_between
        is_place[first:stop] = is_met[first - low : stop - low]

    if is_apart.any():
        over_slabs(mark, len(partition), n_voxels)
    sizes, pieces = _components(partition, n_labels, parts * COMPONENT_VOXELS)
    return LabelVoxels(sizes, pieces, is_apart[:-1, :-1].copy(), np.flatnonzero(is_place))


def components_of(across: Ints, labels: Ints) -> tuple[Ints, Ints]:
    """The component of each cell, (M,), linked by facets between cells of one label; and each
    component's label.
    """
    number, stack = np.full(len(labels), -1), np.empty(len(labels), dtype=np.int64)
    of_component = np.empty(_number_components(number, stack, across, labels), dtype=np.int64)
    of_component[number] = labels
    return number, of_component


@entry
def _number_components(number: Ints1, stack: Ints1, across: Ints2, labels: Ints1) -> int:
    """Number components in the order of their first cells; return how many there are."""
    n_pieces = 0
    for first in range(len(labels)):
        if number[first] >= 0:
            continue
        number[first], stack[0], count = n_pieces, first, 1
        while count > 0:
            count -= 1
            cell = stack[count]
            for other in across[cell]:
                if other >= 0 and number[other] < 0 and labels[other] == labels[cell]:
                    number[other], stack[count] = n_pieces, other
                    count += 1
        n_pieces += 1
    return n_pieces


def _dual(
    points: Floats,
    cells: Ints,
    across: Ints,
    contents: Contents,
) -> Dual:
    counts = contents.counts
    assert (np.diff(counts.indptr) > 0).all(), (
        "label_cells: a cell without voxels has no fraction of any label"
    )
    n, n_labels = points.shape[1], counts.shape[1]
    size, around = np.abs(volumes(points, cells)), stars(cells, len(points))
    scale = np.add.reduceat(np.append(size[around.cells], 0.0), around.start[:-1]) / np.maximum(
        np.diff(around.start), 1
    )
    # The edge of a regular cell of that volume, so that thin cells do not make a surface expensive.
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
        contents.contacts or _no_contacts(len(cells), n_labels),
        np.zeros(n_labels),
    )


def _no_contacts(n_cells: int, n_labels: int) -> Contacts:
    return Contacts(np.zeros((n_labels, n_labels), dtype=bool), np.zeros(n_cells, dtype=bool))


def _majority(dual: Dual) -> Ints:
    """The most frequent label in each cell, the first of equally frequent ones."""
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


def _settle(dual: Dual, labels: Ints, least: Floats, is_careful: bool) -> None:
    """Let cells take a neighbour's label while the energy falls, the best moves first.

    Tension alone lowers no label below its volume `least`. If `is_careful`, no label's topology
    changes.
    """
    room, n_of = _label_volumes(dual, labels) - least, np.bincount(labels, minlength=len(least))
    gains, is_stale = np.zeros(len(labels)), np.ones(len(labels), dtype=bool)
    while is_stale.any():
        # Only changed cells and their neighbours: for a head's 720,000 cells a fifth of the time of
        # all.
        _fill_gains(gains, dual, labels, np.flatnonzero(is_stale))
        is_stale[:] = False
        active = np.flatnonzero(gains > LEAST_GAIN * dual.size)
        order = active[np.argsort(-gains[active], kind="stable")]
        _settle_once(dual, labels, order, room, n_of, is_stale, is_careful)


@helper
def _voxels(dual: Dual, cell: int, label: int) -> float:
    """Volume of the voxels of a label in a cell."""
    for p in range(dual.first[cell], dual.first[cell + 1]):
        if dual.row[p] == label:
            return dual.volume[p]
    return 0.0


@unit
def _price(dual: Dual, labels: Ints1, cell: int, label: int) -> float:
    """The part of the energy that depends on a cell's label, for this label, minus its least
    possible value.
    """
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
    """The cheapest label among a cell's neighbours, and its gain; the cell's own label if
    nothing is gained.
    """
    own, best, gain = np.inf, labels[cell], 0.0
    for k in range(dual.across.shape[1]):
        other = dual.across[cell, k]
        if other >= 0 and labels[other] != labels[cell] and labels[other] != best:
            own = _price(dual, labels, cell, labels[cell]) if own == np.inf else own
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
    dual: Dual,
    labels: Ints1,
    order: Ints1,
    room: Floats1,
    n_of: Ints1,
    is_stale: Bools1,
    is_careful: bool,
) -> None:
    """Let the cells of `order` take the best label of a neighbour one after the other, if that
    still gains.

    Changed cells and their neighbours are marked in `is_stale`.
    """
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
        is_stale[cell] = True
        for k in range(dual.across.shape[1]):
            if dual.across[cell, k] >= 0:
                is_stale[dual.across[cell, k]] = True


@unit
def keeps_topology(
    cells: Ints2,
    across: Ints2,
    labels: Ints1,
    star_start: Ints1,
    star_cells: Ints1,
    cell: int,
    label: int,
) -> bool:
    """True if a cell may get another label without changing the topology of its own label or the
    new one.

    This is a simple point in a complex of simplices: for either label, the cell's contacts with the
    label's other cells and with everything else including the outside are discs. Pinches are
    topology, too.
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
    cells: Ints2,
    across: Ints2,
    labels: Ints1,
    star_start: Ints1,
    star_cells: Ints1,
    cell: int,
    label: int,
    is_of: bool,
) -> bool:
    """True if a cell's contact with the other cells of a label, or with other labels and the
    outside, is a disc.

    It is a disc of facets if some but not all facets are shared, and nothing else is. Facets
    opposite the corners S cover the cell's surface except the faces that contain all of S: only
    cells around the simplex S share more.
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
        for k in range(n):  # also the outside, beyond a facet that contains all of S
            if (
                not is_of
                and across[other, k] < 0
                and not _is_opposite(cells, other, k, cell, is_shared)
            ):
                return False
    # The cell's own boundary facets are shared already: none of them contains all of S.
    return True


@helper
def _has_corners(cells: NDArray, other: int, cell: int, is_one: NDArray) -> bool:
    """True if a cell has these corners of another one."""
    has_all = True
    for k in range(cells.shape[1]):
        has_all = has_all and (not is_one[k] or has_node(cells, other, cells[cell, k]))
    return has_all


@helper
def _is_opposite(cells: NDArray, other: int, k: int, cell: int, is_one: NDArray) -> bool:
    """True if facet k of a cell lies opposite one of these corners of another cell."""
    is_opposite = False
    for m in range(cells.shape[1]):
        is_opposite = is_opposite or (is_one[m] and cells[cell, m] == cells[other, k])
    return is_opposite


def _without_fragments(
    dual: Dual,
    labels: Ints,
    is_bridge: Bools,
    aim: Floats,
    voxel: float,
    components: list[NDArray],
) -> None:
    """Bridge or relabel components of cells that no component of voxels justifies.

    A label's components are ranked by the number of its voxels that they contain. The first stays,
    and each further one if the component of voxels of the same rank is not far smaller. The others
    are linked to a component of the same label or, if that costs more than `BRIDGE_RATIO` of the
    voxels lost otherwise, go to their neighbours cell by cell; those with more than
    `FRAGMENT_FRACTION` of a label stay apart.
    """
    number, of_component = components_of(dual.across, labels)
    cell = np.repeat(np.arange(len(labels)), np.diff(dual.first))
    is_own = dual.row == labels[cell]
    content = np.bincount(number[cell], np.where(is_own, dual.volume, 0.0), len(of_component))
    # Volume of the best other label in a cell: an upper limit of the loss if it goes.
    others = np.maximum.reduceat(np.where(is_own, 0.0, dual.volume), dual.first[:-1])
    most = BRIDGE_RATIO * (content - np.bincount(number, others, len(of_component)))
    order = np.lexsort((np.arange(len(of_component)), -content, of_component))
    rank = np.empty(len(of_component), dtype=np.int64)
    rank[order] = np.arange(len(of_component)) - np.searchsorted(
        of_component[order], of_component[order]
    )
    ranked = zip(of_component, rank, content, strict=True)
    is_fragment = np.array(
        [
            k > 0 and (k >= len(components[p]) or voxel * components[p][k] < COMPONENT_FRACTION * c)
            for p, k, c in ranked
        ]
    )
    is_loose = is_fragment[number]
    way, before, bridge = np.full(len(labels), np.inf), np.empty_like(labels), np.empty_like(labels)
    sorted_cells, n_of = (
        np.argsort(number, kind="stable"),
        np.bincount(labels, minlength=len(components)),
    )
    start = np.searchsorted(number[sorted_cells], np.arange(len(of_component) + 1))
    for component in order[is_fragment[order]]:
        own = sorted_cells[start[component] : start[component + 1]]
        if (labels[own] != of_component[component]).any():  # another bridge crosses it
            continue
        count = _bridge(bridge, way, before, dual, labels, own, most[component])
        n_taken = np.bincount(labels[bridge[:count]], minlength=len(components))
        if count > 0 and ((n_taken == 0) | (n_taken < n_of)).all():  # no label vanishes for it
            labels[bridge[:count]] = of_component[component]
            n_of -= n_taken
            n_of[of_component[component]] += count
            is_loose[bridge[:count]] = is_loose[own] = False
            is_bridge[bridge[:count]] = True
        elif content[component] > FRAGMENT_FRACTION * aim[of_component[component]]:
            is_loose[own] = False
    _give_away(dual, labels, is_loose)


@entry
def _bridge(
    bridge: Ints1,
    way: Floats1,
    before: Ints1,
    dual: Dual,
    labels: Ints1,
    component: Ints1,
    most: float,
) -> int:
    """The cells that link a component to another one of its label at least cost, below `most`, and
    their number.

    Dijkstra's shortest path: the cost of a step is that of giving its cell the label, with all
    others unchanged. `way` is infinite before and after.
    """
    label, end, count = labels[component[0]], -1, 0
    heap, done = [(0.0, cell) for cell in component], list(component)  # ascending
    way[component], before[component] = 0.0, -1
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
            there = so_far + (
                0.0 if labels[other] == label else max(price, LEAST_GAIN * dual.size[other])
            )
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
    return count


@entry
def _give_away(dual: Dual, labels: Ints1, is_loose: Bools1) -> None:
    """Give loose cells the cheapest label among neighbours that are not loose, from the outside
    in.
    """
    has_moved = True
    while has_moved:
        has_moved = False
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
                labels[cell], is_loose[cell], has_moved = best, False, True


# Places that are not manifold, an edge (a, b) or a node (a, -1), and their repair.


class _Work(NamedTuple):
    """Work space for the kernels below."""

    star: Ints1  # the cells around one node or edge
    label: Ints1  # the distinct labels of these
    own: Ints1  # index of each cell's label among those
    root: Ints1  # root of each cell in its fan, or of each fan among linked ones
    fan: Ints1  # the fan of each cell, and the outside's
    fan_label: Ints1  # index of each fan's label; -1 for the outside
    # positions in the star of the cells beyond facets: its length for the outside, -1 if not in it
    beside: Ints2
    is_linked: Bools2  # fans with a common facet
    place: Ints1  # (M,) position of a cell in the star; -1 between calls
    # (N,) steps between labels at facets around the edge from one node to another; 0 between calls
    steps: Ints1


class _Marks(NamedTuple):
    """What is known of a mesh's places from earlier passes of mending."""

    labels: Ints1  # (M,) of cells after the last pass; -1 before the first
    # (M, n+1) least change of the energy if a cell gets the label across each facet
    rise: Floats2
    is_near: Bools1  # (N,) nodes of a changed cell: places there are to be searched
    is_sound: Bools1  # (N,) no place there is known to have a fault
    is_due: Bools1  # (N,) places there may be mended later
    work: _Work


def _marks(dual: Dual) -> _Marks:
    near, sound, due = np.zeros((3, len(dual.scale)), dtype=bool)
    labels, rise = np.full(len(dual.cells), -1), np.full(dual.cells.shape, -np.inf)
    return _Marks(labels, rise, near, sound, due, _work(dual))


def _work(dual: Dual) -> _Work:
    widest = int(np.diff(dual.star_start).max())
    star, label, own, root, fan, fan_label = np.empty((6, widest + 1), dtype=np.int64)
    return _Work(
        star,
        label,
        own,
        root,
        fan,
        fan_label,
        np.empty((widest, dual.cells.shape[1]), dtype=np.int64),
        np.empty((widest + 1, widest + 1), dtype=bool),
        np.full(len(dual.cells), -1),
        np.zeros(len(dual.scale), dtype=np.int64),
    )


def _nonmanifold(dual: Dual, labels: Ints, is_near: Bools) -> tuple[Ints, Bools]:
    """Edges (a, b) and nodes (a, -1) with a node marked near where a label's interface is not
    manifold, (F, 2), and a mask of two-label ones.
    """
    is_around = np.zeros_like(is_near)
    is_around[dual.cells[is_near[dual.cells].any(axis=1)]] = True

    def find(first: int, stop: int) -> Ints:
        # The largest possible number; unwritten pages take no memory.
        most = stop - first + dual.cells.shape[1] * (dual.star_start[stop] - dual.star_start[first])
        faces = np.empty((most, 3), dtype=np.int64)
        count = _find_nonmanifold(
            faces, dual, labels, is_near, is_around[first:stop], first, _work(dual)
        )
        return faces[:count].copy()

    faces = np.concatenate(over_slabs(find, len(is_near), STAR_CELLS * int(is_around.sum())))
    return np.ascontiguousarray(faces[:, :2]), faces[:, 2] == 2


@entry
def _find_nonmanifold(
    faces: Ints2,
    dual: Dual,
    labels: Ints1,
    is_near: Bools1,
    is_around: Bools1,
    start: int,
    work: _Work,
) -> int:
    """Write the rows of `_nonmanifold` at nodes from `start`, and the number of labels that meet
    there, (F, 3).

    Of these nodes, those that `is_around` marks are searched. Return the number of rows.
    """
    count = 0
    for a in range(start, start + len(is_around)):
        if not is_around[a - start]:
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
def _count_steps(dual: Dual, labels: NDArray, a: int, steps: NDArray) -> None:
    """Add to `steps` of each node b the number of facets around the edge (a, b) between labels,
    from either side.

    A boundary facet counts once more, a facet between labels that are apart as many as are
    doubtful. With fewer than `DOUBTFUL_STEPS`, labels are one fan each and need no `_fault`, so
    that finding faults takes a fifth of the time.
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
                    steps[dual.cells[cell, m]] += (
                        DOUBTFUL_STEPS if is_apart else 2 if other < 0 else 1
                    )


@helper
def _gather(dual: Dual, a: int, b: int, star: NDArray) -> int:
    """Write the cells around a node, or around an edge if b >= 0, to `star`; return their
    number.
    """
    count = 0
    for r in range(dual.star_start[a], dual.star_start[a + 1]):
        if b < 0 or has_node(dual.cells, dual.star_cells[r], b):
            star[count] = dual.star_cells[r]
            count += 1
    return count


@unit
def _fault(dual: Dual, labels: Ints1, a: int, b: int, work: _Work) -> tuple[float, int]:
    """Penalty for pinches and false contact at a node or an edge, in volumes of the cells around
    it.

    Also returns the number of labels there; three or more with false contact, which is not a
    question of manifolds.
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
    """Number of labels of the cells of a star; also store these labels, and the label of each
    cell.
    """
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
def _excess(
    dual: Dual, labels: NDArray, a: int, b: int, count: int, n_labels: int, work: _Work
) -> int:
    """Number of excess fans around a node or an edge, over all labels there.

    For each label, the fans of its cells minus one, plus those of all others including the outside
    minus one.
    """
    steps, n_outer = 0, 0
    for i in range(count if b >= 0 else 0):
        for k in range(4):
            if dual.cells[work.star[i], k] != a and dual.cells[work.star[i], k] != b:
                other = dual.across[work.star[i], k]
                n_outer += other < 0
                steps += other >= 0 and labels[other] != labels[work.star[i]]
    # a ring of cells, possibly closed by the outside: each of its arcs is a fan
    if b >= 0 and n_outer <= 2:
        return steps + n_outer - 2 * n_labels
    is_open = _link(dual, a, b, count, work)
    n_fans = _join_fans(dual, count, is_open, work)
    if n_labels == 2 and not is_open:  # cells without the one label have the other
        return 2 * (n_fans - 2)
    excess = n_fans - 2 * n_labels
    for own in range(n_labels):
        excess += _rest_fans(n_fans, own, is_open, work)
    return excess


@helper
def _link(dual: Dual, a: int, b: int, count: int, work: _Work) -> bool:
    """Store the positions in a star of the cells beyond its facets; return True if one is
    outside.
    """
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
    """True if labels of some cells meet that are separate in the voxels of all these cells."""
    is_false = False
    for i in range(n_labels):
        for j in range(i):
            is_false = is_false or dual.contacts.is_apart[work.label[i], work.label[j]]
    for i in range(count if is_false else 0):
        is_false = is_false and not dual.contacts.is_place[work.star[i]]
    return is_false


@helper
def _join_fans(dual: Dual, count: int, is_open: bool, work: _Work) -> int:
    """Number of fans of single labels in a star; also store the label of each, and which of them
    are linked.

    The outside follows as a further one, without a label.
    """
    root, n_fans = work.root, 0
    for i in range(count):
        root[i] = i
    for i in range(count):
        for k in range(dual.cells.shape[1]):
            j = work.beside[i, k]
            if i < j < count and work.own[i] == work.own[j]:
                p, q = _root(root, i), _root(root, j)
                root[max(p, q)] = min(p, q)  # a root comes first
    for i in range(count):
        if root[i] == i:
            work.fan[i], work.fan_label[n_fans] = n_fans, work.own[i]
            n_fans += 1
        else:
            work.fan[i] = work.fan[root[i]]
    n_linked = n_fans + 1 if is_open else n_fans
    work.fan[count], work.fan_label[n_fans] = n_fans, -1
    work.is_linked[:n_linked, :n_linked] = False
    for i in range(count):
        for k in range(dual.cells.shape[1]):
            if work.beside[i, k] >= 0:
                p, q = work.fan[i], work.fan[work.beside[i, k]]
                work.is_linked[p, q] = work.is_linked[q, p] = True
    return n_fans


@helper
def _root(root: NDArray, i: int) -> int:
    while root[i] != i:
        i = root[i]
    return i


@helper
def _rest_fans(n_fans: int, own: int, is_open: bool, work: _Work) -> int:
    """Fans of all that has not a label, including the outside; of the fans that `_join_fans`
    stored.
    """
    root, n_linked = work.root, n_fans + 1 if is_open else n_fans
    count = 0
    for p in range(n_linked):
        root[p] = p
        count += work.fan_label[p] != own
        for q in range(p if work.fan_label[p] != own else 0):
            if work.is_linked[p, q] and work.fan_label[q] != own:
                i, j = _root(root, p), _root(root, q)
                count -= i != j
                root[i] = j
    return count


@entry
def _mend_places(
    dual: Dual,
    labels: Ints1,
    room: Floats2,
    is_kept: Bools1,
    faces: Ints2,
    has_pairs: bool,
    marks: _Marks,
) -> None:
    """At each place that is not manifold, make the move that most lowers the energy including
    pinches.

    Moves are those of a cell or of a fan and, where none lowers the energy and if `has_pairs`, of
    two cells. Nodes of changed cells are marked near, and no longer sound. Nodes are marked due
    whose places may be mended later: those with a cell that has a node of a changed one, or that a
    label's room or a kept cell prevented.
    """
    star, group = np.empty_like(marks.work.star), np.empty_like(marks.work.star)
    for f in range(len(faces)):
        a, b = faces[f, 0], faces[f, 1]
        if _fault(dual, labels, a, b, marks.work)[0] == 0.0:
            continue
        count = _gather(dual, a, b, star)
        best, best_from, best_label = -LEAST_GAIN * dual.scale[a], -1, -1
        for i in range(2 * count + (count * count if has_pairs else 0)):
            if i >= 2 * count and best_from >= 0:
                break
            size = _group(dual, labels, a, b, star[:count], i, group)
            if size == 0:
                continue
            volume = dual.size[group[:size]].sum()
            if room[0, labels[group[0]]] < volume or is_kept[group[:size]].any():
                marks.is_due[a] = True
                continue
            can_grow = room[1] >= volume
            for cell in star[:count]:
                marks.is_due[a] = marks.is_due[a] or not can_grow[labels[cell]]
            new, change = _best_of_group(
                dual, labels, group[:size], star[:count], best, can_grow, marks
            )
            if new >= 0:
                best, best_from, best_label = change, i, new
        if best_from >= 0:
            size = _group(dual, labels, a, b, star[:count], best_from, group)
            volume = dual.size[group[:size]].sum()
            for label, gain in ((labels[group[0]], -volume), (best_label, volume)):
                room[0, label] += gain
                room[1, label] -= gain
            for cell in group[:size]:
                labels[cell] = best_label
                for k in range(dual.cells.shape[1]):
                    node = dual.cells[cell, k]
                    marks.is_near[node], marks.is_sound[node] = True, False
                    for r in range(dual.star_start[node], dual.star_start[node + 1]):
                        around = dual.star_cells[r]
                        for m in range(dual.cells.shape[1]):
                            marks.is_due[dual.cells[around, m]] = True
                            marks.rise[around, m] = -np.inf


@unit
def _group(dual: Dual, labels: Ints1, a: int, b: int, star: Ints1, i: int, group: Ints1) -> int:
    """Cells that may change together: cell i of a star, for larger i the fan of one label that
    starts there, or two.
    """
    if i < len(star):
        group[0] = star[i]
        return 1
    if i >= 2 * len(star):
        j, k = i // len(star) - 2, i % len(star)
        group[0], group[1] = star[j], star[k]
        return 2 if j < k and labels[star[j]] == labels[star[k]] else 0
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
                return 0  # it starts with another cell
    return count if count > 1 else 0


@unit
def _best_of_group(
    dual: Dual,
    labels: Ints1,
    group: Ints1,
    star: Ints1,
    least: float,
    can_grow: Bools1,
    marks: _Marks,
) -> tuple[int, float]:
    """The label in the place's star that may grow and lowers the energy most for the group, and the
    change.

    The label is -1 unless the change is below `least`.
    """
    old, best, faces = labels[group[0]], -1, np.empty((0, 2), dtype=np.int64)
    before, pinches, work = 0.0, 0.0, marks.work
    for j in range(len(star)):
        new = labels[star[j]]
        side = _side(dual, labels, group, new) if new != old and can_grow[new] else -1
        is_new = side >= 0 and (len(group) > 1 or marks.rise[group[0], side] < least)
        for i in range(j):
            is_new = is_new and labels[star[i]] != new
        if not is_new:
            continue
        if len(faces) == 0:
            faces = _closure(dual, group)
            before = _prices(dual, labels, group)
            for f in range(len(faces)):
                a, b = faces[f, 0], faces[f, 1]
                if marks.is_sound[a] or (b >= 0 and marks.is_sound[b]):
                    continue
                pinches += _fault(dual, labels, a, b, work)[0] * dual.scale[a]
        for cell in group:
            labels[cell] = new
        change = _prices(dual, labels, group) - before - pinches
        if change < least:  # if all pinches vanish
            change += _pinches(dual, labels, faces, change, least, work)
        if len(group) == 1:
            marks.rise[group[0], side] = change
        for cell in group:
            labels[cell] = old
        if change < least:
            best, least = new, change
    return best, least


@helper
def _side(dual: Dual, labels: NDArray, group: NDArray, label: int) -> int:
    """The first facet of a cell of the group with a cell of a label across it; -1 if none."""
    for cell in group:
        for k in range(dual.across.shape[1]):
            if dual.across[cell, k] >= 0 and labels[dual.across[cell, k]] == label:
                return k
    return -1


@helper
def _closure(dual: Dual, group: NDArray) -> NDArray:
    """Distinct nodes (a, -1) and, in 3-D, edges (a, b) of some cells, (F, 2)."""
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
    """The part of the energy that depends on the common label of a group of cells."""
    total = 0.0
    for cell in group:
        total += _price(dual, labels, cell, labels[cell])
    return total


@unit
def _pinches(
    dual: Dual, labels: Ints1, faces: Ints2, others: float, most: float, work: _Work
) -> float:
    """Penalty of these nodes and edges if not manifold; a lower bound once it and the others'
    reach `most`.
    """
    total = 0.0
    for f in range(len(faces)):
        total += _fault(dual, labels, faces[f, 0], faces[f, 1], work)[0] * dual.scale[faces[f, 0]]
        if others + total >= most:
            break
    return total
