"""Interfaces between labels: their cells, their sliding nodes, and their part of E.

The initial label of a cell follows from its voxels, tension and topology (`tetopt.engine.labelling`). From then on
labels change only with the mesh: cells next to an interface take the label of a neighbour if that lowers E and
preserves both labels' topology.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.content import Content, SmoothLabels
from tetopt.contents.memberships import Memberships, labels_at
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine.complex import NodeStars, State, facet_area, image_energy, node_stars, outward, pair_tension
from tetopt.engine.labelling import Contacts, LabelVoxels, balanced, keeps_topology, label_voxels, labelled, unpinched
from tetopt.engine.surface import MOST_MEETING
from tetopt.geometry.manifold import OUTSIDE_LABEL, pinches
from tetopt.geometry.simplex import facet_areas, regular_edge, volumes
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.kernel_cache import njit
from tetopt.system.kernels import Bools1, Floats1, Ints1, entry, helper, unit

FEWEST_CENTRES = 20  # of voxels that determine a cell's labels; in cells with fewer, levels are sampled
SAMPLED_FRACTION = 0.5  # of a label's voxels: if samples show less, its centres are counted, too
SAMPLED_AT_ONCE = 20_000  # cells per thread
BALANCE_LEAK = 0.8  # fraction of its bias that a label keeps if its volume is right, except for
SMALL_LOSS_FRACTION = 0.04  # of the volume: facets always cut it off round shapes, which would raise the bias forever
SPARED_LOSS_FRACTION = 0.08  # of a label's volume that is not restored: restoring all of it would cost position (Dice)
SHIFT_STEP = 0.5  # fraction of the shift that would restore the volume
MOST_SHIFT_FRACTION = 0.2  # largest shift, of the edge next to a label's surface
RELABELLING_PASSES = 10  # at most; the third usually changes nothing
LEAST_RELABELLING_FRACTION = 1e-9  # of the energies compared: a smaller gain may be rounding


def with_labels(
    state: State, content: Content, smooth: SmoothLabels, mesh: Mesh, voxels: LabelVoxels | None = None
) -> State:
    """The state with one of the content's labels for each cell, and an objective that penalises other labels' voxels.

    `voxels` is the information on the labels' voxels (`label_voxels`), if known. If cells already have labels, each
    label's bias is updated for the volume that it has lost or gained.
    """
    members, tension, own_channel, own_value, keeps_volumes, _ = smooth
    bias = None if keeps_volumes else np.zeros(len(members.labels))
    voxels = voxels or label_voxels(members.partition, content.image.spacing, len(members.labels))
    if len(state.objective.bias) > 0:
        state = with_balance(state, content, mesh)
        bias = state.objective.bias
    n_cells, image = len(mesh.cells), content.image
    across = state.complex.across[:n_cells]
    counts, contacts = cell_contents(image, members, mesh, voxels)
    made = labelled(mesh.points, mesh.cells, across, counts, voxels.components, contacts, bias)
    state.complex.labels[:n_cells] = made.labels
    step = image.voxel_volume ** (1.0 / image.ndim)
    objective = state.objective._replace(
        n_means=int(content.n_contrasts),
        own_column=np.where(own_channel == 0, 1, 2 + own_channel),
        own_value=own_value.astype(np.float64),
        bias=made.bias,
        shift=state.objective.shift if len(state.objective.shift) > 0 else np.zeros(len(made.bias)),
        tension=float(state.objective.image * tension * step / image.voxel_volume),
    )
    levels = members.levels.reshape(len(members.levels), *(1,) * (3 - image.ndim), *image.shape)
    state = state._replace(objective=objective, sides=state.sides._replace(levels=levels, channel=members.channel))
    _meet_everywhere(state, node_stars(state))
    return state


def with_balance(state: State, content: Content, mesh: Mesh) -> State:
    """The state with a higher bias for labels whose cells have less volume than their voxels, if volumes are preserved.

    Cells cannot restore the volume that nodes on a round surface cut off. A shift of the label's level therefore moves
    its surface outwards, or inwards if the label has far too much volume.
    """
    if content.smooth is None or not content.smooth.keeps_volumes:
        return state
    members = content.smooth.memberships
    rows = members.partition if content.inside is None else members.partition[content.inside]
    aim = content.image.voxel_volume * np.bincount(rows.ravel(), minlength=len(members.labels))
    size = np.abs(volumes(mesh.points, mesh.cells))
    volume = np.bincount(state.complex.labels[: len(size)], size, len(members.labels))
    is_small = np.abs(volume - aim) < SMALL_LOSS_FRACTION * aim
    bias = balanced(np.where(is_small, BALANCE_LEAK, 1.0) * state.objective.bias, aim, volume)
    shift = state.objective.shift
    if content.smooth.band > 0.0:
        spared = np.sign(aim - volume) * np.maximum(np.abs(aim - volume) - SPARED_LOSS_FRACTION * aim, 0.0)
        shift = _shifted(shift, spared, state, mesh, content.image.voxel_volume ** (1.0 / content.image.ndim))
    return state._replace(objective=state.objective._replace(bias=bias, shift=shift))


def _shifted(
    shift: NDArray[np.float64], missing: NDArray[np.float64], state: State, mesh: Mesh, step: float
) -> NDArray[np.float64]:
    """Outward shifts of labels' surfaces, (K,) voxels of `step` mm, that give labels their missing volume, mm^n."""
    labels, across = (array[: len(mesh.cells)] for array in (state.complex.labels, state.complex.across))
    is_between = (across >= 0) & (labels[across] != labels[:, None])
    beside, n = np.flatnonzero(is_between.any(axis=1)), mesh.points.shape[1]
    label, cells, n_labels = labels[beside], mesh.cells[beside], len(shift)
    area = np.bincount(label, (facet_areas(mesh.points, cells) * is_between[beside]).sum(axis=1), n_labels)
    number = np.maximum(np.bincount(label, minlength=n_labels), 1)
    size = np.bincount(label, np.abs(volumes(mesh.points, cells)), n_labels) / number
    most = MOST_SHIFT_FRACTION * regular_edge(size, n) / step
    way = SHIFT_STEP * missing / np.where(area > 0.0, area * step, np.inf)
    return np.asarray(np.clip(shift + way, -most, most))


def mend_pinches(state: State, image: Image, members: Memberships, mesh: Mesh, voxels: LabelVoxels) -> None:
    """Give cells other labels where an interface of two labels is not a manifold; no node moves."""
    labels, across = (array[: len(mesh.cells)] for array in (state.complex.labels, state.complex.across))
    of_ridges, of_nodes = pinches(facets(mesh.cells), labels)
    if any((places.labels[:, 0] != OUTSIDE_LABEL).any() for places in (of_ridges, of_nodes)):
        counts, contacts = cell_contents(image, members, mesh, voxels)
        labels[:] = unpinched(mesh.points, mesh.cells, across, counts, contacts, labels)
        _meet_everywhere(state, node_stars(state))


def cell_contents(
    image: Image, members: Memberships, mesh: Mesh, voxels: LabelVoxels
) -> tuple[scipy.sparse.csr_array, Contacts]:
    """Voxels of each label in each cell, (M, K), and contacts of labels; cells with few centres are sampled.

    A cell of a thin sheet may contain one centre, or none. Levels are sampled at the centres of equal parts.
    """
    n_cells, n_labels, inner = len(mesh.cells), len(members.labels), PART_CENTRES[image.ndim]
    owner, partition = cell_of_voxel(image, mesh).ravel(), members.partition.ravel()
    n_owned, n_of = np.zeros(n_cells, dtype=np.int64), np.zeros(n_labels, dtype=np.int64)
    _count_centres(n_owned, n_of, owner, partition)
    is_sampled = n_owned < FEWEST_CENTRES
    start = np.append(0, np.cumsum(np.where(is_sampled, len(inner), n_owned)))
    entries = np.empty(start[-1], dtype=np.int32)
    _place_centres(entries, start[:-1].copy(), owner, partition, is_sampled)
    sampled, index = np.flatnonzero(is_sampled), image.to_index(mesh.points)
    parts = np.array_split(sampled, 1 + len(sampled) // SAMPLED_AT_ONCE)
    with ThreadPoolExecutor(numba.get_num_threads()) as threads:
        rows = threads.map(lambda part: labels_at(members, index, mesh.cells[part], inner), parts)
        for part, there in zip(parts, rows, strict=True):
            entries[start[part, None] + np.arange(len(inner))] = there
    each = np.where(is_sampled, np.abs(volumes(mesh.points, mesh.cells)) / image.voxel_volume / len(inner), 1.0)
    first = np.zeros(n_cells + 1, dtype=np.int64)
    _count_kinds(first, entries, start, n_labels)
    np.cumsum(first, out=first)
    row, volume = np.empty(first[-1], dtype=np.int64), np.empty(first[-1])
    _sum_kinds(row, volume, first, entries, start, each, n_labels)
    counts = scipy.sparse.csr_array((volume, row, first), shape=(n_cells, n_labels))
    # Samples may miss a label of a voxel or two, so its centres count.
    is_unseen = np.bincount(row, volume, n_labels) < SAMPLED_FRACTION * n_of
    if is_unseen.any():
        centre = np.flatnonzero(is_unseen[partition] & (owner >= 0))
        centre = centre[is_sampled[owner[centre]]]
        at = owner[centre], partition[centre]
        counts = counts + scipy.sparse.csr_array((np.ones(len(centre)), at), shape=counts.shape)
    is_place = np.zeros(n_cells + 1, dtype=bool)
    is_place[owner[voxels.places]] = True
    return counts, Contacts(voxels.is_apart, is_place[:-1].copy())


@njit(cache=True, nogil=True)
def _count_centres(n_owned: NDArray, n_of: NDArray, owner: NDArray, partition: NDArray) -> None:
    """Count the voxel centres in each cell, and those of each label in any of them."""
    for v in range(len(owner)):
        if owner[v] >= 0:
            n_owned[owner[v]] += 1
            n_of[partition[v]] += 1


@njit(cache=True, nogil=True)
def _place_centres(entries: NDArray, end: NDArray, owner: NDArray, partition: NDArray, is_sampled: NDArray) -> None:
    for v in range(len(owner)):
        cell = owner[v]
        if cell >= 0 and not is_sampled[cell]:
            entries[end[cell]] = partition[v]
            end[cell] += 1


@njit(cache=True, nogil=True)
def _count_kinds(first: NDArray, entries: NDArray, start: NDArray, n_labels: int) -> None:
    """Count the labels present in each cell."""
    last = np.full(n_labels, -1, dtype=np.int64)
    for cell in range(len(start) - 1):
        for i in range(start[cell], start[cell + 1]):
            if last[entries[i]] != cell:
                last[entries[i]] = cell
                first[cell + 1] += 1


@njit(cache=True, nogil=True)
def _sum_kinds(
    row: NDArray, volume: NDArray, first: NDArray, entries: NDArray, start: NDArray, each: NDArray, n_labels: int
) -> None:
    total, last = np.zeros(n_labels), np.full(n_labels, -1, dtype=np.int64)
    for cell in range(len(start) - 1):
        end = first[cell]
        for i in range(start[cell], start[cell + 1]):
            label = entries[i]
            if last[label] != cell:
                last[label], total[label] = cell, 0.0
                m = end
                while m > first[cell] and row[m - 1] > label:  # in rising order
                    row[m] = row[m - 1]
                    m -= 1
                row[m] = label
                end += 1
            total[label] += each[cell]
        for m in range(first[cell], end):
            volume[m] = total[row[m]]


def _samples(n: int, parts: int) -> NDArray[np.float64]:
    """Barycentric places (S, n+1): the points that divide a simplex's edges into parts, moved inside."""
    whole = np.array([each for each in itertools.product(range(parts + 1), repeat=n + 1) if sum(each) == parts])
    return (whole + 0.5) / (parts + 0.5 * (n + 1))


PART_CENTRES = {2: _samples(2, 4), 3: _samples(3, 3)}  # 15 and 20 barycentric places in a cell, by dimension


def crowded_nodes(cells: NDArray[np.int64], of_cell: NDArray[np.int64]) -> int:
    """Nodes with more labels than they can be moved onto (`MOST_MEETING`); cells (M, n+1), their labels (M,)."""
    pairs = np.unique(np.column_stack([cells.ravel(), np.repeat(of_cell, cells.shape[1])]), axis=0)
    return int((np.bincount(pairs[:, 0]) > MOST_MEETING).sum())


@unit
def _meet(state: State, stars: NodeStars, node: int) -> None:
    """Store the labels of the cells around a node."""
    meeting, count = state.complex.meeting[node], 0
    for m in range(MOST_MEETING):
        meeting[m] = -1
    for r in range(stars.start[node], stars.start[node + 1]):
        label, is_new = state.complex.labels[stars.cells[r]], True
        for m in range(count):
            is_new = is_new and meeting[m] != label
        if is_new and count < MOST_MEETING:
            m = count
            while m > 0 and meeting[m - 1] > label:  # in rising order
                meeting[m] = meeting[m - 1]
                m -= 1
            meeting[m] = label
            count += 1
    if count == 1:
        meeting[0] = -1


@entry
def _meet_everywhere(state: State, stars: NodeStars) -> None:
    for node in range(len(state.complex.ticks)):
        _meet(state, stars, node)


def relabel(state: State, stars: NodeStars) -> int:
    """Let cells next to an interface take a neighbour's label if E falls and no topology changes; return the number."""
    n_cells, total = int(state.complex.n_cells[0]), 0
    gain, label, is_stale = np.zeros(n_cells), np.zeros(n_cells, dtype=np.int64), np.ones(n_cells, dtype=bool)
    for _ in range(RELABELLING_PASSES):
        # After the first pass only changed cells and their neighbours, in a sixth of the time of all cells.
        _find_relabellings(gain, label, state, np.flatnonzero(is_stale))
        is_stale[:] = False
        order = np.flatnonzero(gain > 0.0)
        moved = _relabel(order[np.lexsort((order, -gain[order]))], gain, label, is_stale, state, stars)
        total += moved
        if moved == 0:
            break
    return total


@unit
def _price(state: State, cell: int, label: int) -> float:
    """The part of E that depends on a cell's label."""
    mesh, objective = state.complex, state.objective
    price = objective.image * image_energy(mesh.sums, cell, label, objective)
    for k in range(mesh.cells.shape[1]):
        other = mesh.across[cell, k]
        if other >= 0 and mesh.labels[other] != label:
            a, b, c = outward(mesh.cells, cell, k)
            price += pair_tension(objective, label, mesh.labels[other]) * facet_area(mesh.ticks, a, b, c, objective)
    return price


@helper
def _find_relabelling(gain: NDArray, label: NDArray, state: State, cell: int) -> None:
    mesh = state.complex
    gain[cell], label[cell], own = 0.0, mesh.labels[cell], -1.0
    for k in range(mesh.cells.shape[1]):
        other = mesh.across[cell, k]
        if other < 0 or mesh.labels[other] == mesh.labels[cell]:
            continue
        if own < 0.0:
            own = _price(state, cell, mesh.labels[cell])
        objective, new, old = state.objective, mesh.labels[other], mesh.labels[cell]
        squares = objective.own_value[new] ** 2 + objective.own_value[old] ** 2
        favour = (objective.bias[new] - objective.bias[old]) * squares * objective.image * mesh.sums[cell, 0]
        more = own - _price(state, cell, new) + favour
        if more > max(gain[cell], LEAST_RELABELLING_FRACTION * own):
            gain[cell], label[cell] = more, mesh.labels[other]


@entry
def _find_relabellings(gain: Floats1, label: Ints1, state: State, stale: Ints1) -> None:
    for cell in stale:
        _find_relabelling(gain, label, state, cell)


@entry
def _relabel(order: Ints1, gain: Floats1, label: Ints1, is_stale: Bools1, state: State, stars: NodeStars) -> int:
    mesh, moved = state.complex, 0
    for cell in order:
        _find_relabelling(gain, label, state, cell)
        if gain[cell] > 0.0 and keeps_topology(
            mesh.cells, mesh.across, mesh.labels, stars.start, stars.cells, cell, label[cell]
        ):
            mesh.labels[cell], is_stale[cell] = label[cell], True
            for k in range(mesh.cells.shape[1]):
                _meet(state, stars, mesh.cells[cell, k])
                if mesh.across[cell, k] >= 0:
                    is_stale[mesh.across[cell, k]] = True
            moved += 1
    return moved
