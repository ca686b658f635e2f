"""Interfaces between labels: their cells, their sliding nodes, and their part of E.

The label of a cell follows from its voxels, tension and topology (`tetopt.engine.labelling`).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.content import Content, SmoothLabels
from tetopt.contents.memberships import Memberships, labels_at
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine.complex import NodeStars, State, node_stars
from tetopt.engine.labelling import (
    Contacts,
    Contents,
    LabelVoxels,
    labelled,
    unfit_labels,
    unpinched,
)
from tetopt.engine.surface import MOST_MEETING
from tetopt.geometry.manifold import OUTSIDE_LABEL, pinches
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.kernel_cache import njit
from tetopt.system.kernels import entry, unit
from tetopt.system.slabs import over_slabs

# of voxels that determine a cell's labels; in cells with fewer, levels are sampled
FEWEST_CENTRES = 20
SAMPLED_FRACTION = 0.5  # of a label's voxels: if samples show less, its centres are counted, too
SAMPLED_AT_ONCE = 20_000  # cells per thread


def with_labels(
    state: State, content: Content, smooth: SmoothLabels, mesh: Mesh, voxels: LabelVoxels
) -> State:
    """The state with one of the content's labels for each cell, and an objective that penalises
    other labels' voxels.

    `voxels` is the information on the labels' voxels (`label_voxels`).
    """
    members, own_channel, own_value, keeps_volumes = smooth
    n_cells, image = len(mesh.cells), content.image
    across = state.complex.across[:n_cells]
    contents = cell_contents(image, members, mesh, voxels)
    state.complex.labels[:n_cells] = labelled(
        mesh.points, mesh.cells, across, contents, voxels.components, keeps_volumes
    )
    objective = state.objective._replace(
        n_means=int(content.n_contrasts),
        own_column=np.where(own_channel == 0, 1, 2 + own_channel),
        own_value=own_value.astype(np.float64),
    )
    levels = members.levels.reshape(len(members.levels), *(1,) * (3 - image.ndim), *image.shape)
    state = state._replace(
        objective=objective, sides=state.sides._replace(levels=levels, channel=members.channel)
    )
    _meet_everywhere(state, node_stars(state))
    return state


def mend_pinches(
    state: State, image: Image, members: Memberships, mesh: Mesh, voxels: LabelVoxels
) -> None:
    """Give cells other labels where an interface of two labels is no manifold, or cells are next to
    nothing of theirs.

    No node moves.
    """
    labels, across = (
        array[: len(mesh.cells)] for array in (state.complex.labels, state.complex.across)
    )
    of_ridges, of_nodes = pinches(facets(mesh.cells), labels)
    aim = image.voxel_volume * np.array([sizes.sum() for sizes in voxels.components])
    is_unfit = unfit_labels(labels, mesh.cell_volumes, aim)
    if is_unfit.any() or any(
        (places.labels[:, 0] != OUTSIDE_LABEL).any() for places in (of_ridges, of_nodes)
    ):
        contents = cell_contents(image, members, mesh, voxels)
        labels[:] = unpinched(mesh.points, mesh.cells, across, contents, labels, aim)
        _meet_everywhere(state, node_stars(state))


def cell_contents(image: Image, members: Memberships, mesh: Mesh, voxels: LabelVoxels) -> Contents:
    """Voxels of each label in each cell, contacts of labels, and their pieces; cells with few
    centres are sampled.

    A cell of a thin sheet may contain one centre, or none. Levels are sampled at the centres of
    equal parts.
    """
    n_cells, n_labels, inner = len(mesh.cells), len(members.labels), PART_CENTRES[image.ndim]
    owner, partition = cell_of_voxel(image, mesh).ravel(), members.partition.ravel()

    def count(first: int, stop: int) -> _Counted:
        counted = _Counted(
            first, stop, np.zeros(n_cells, dtype=np.int64), np.zeros(n_labels, dtype=np.int64)
        )
        _count_centres(counted.n_owned, counted.n_of, owner[first:stop], partition[first:stop])
        return counted

    counted = over_slabs(count, len(owner), len(owner), numba.get_num_threads())
    n_owned, n_of = (np.sum(each, axis=0) for each in list(zip(*counted, strict=True))[2:])
    is_sampled = n_owned < FEWEST_CENTRES
    start = np.append(0, np.cumsum(np.where(is_sampled, len(inner), n_owned)))
    entries = np.empty(start[-1], dtype=np.int32)
    # Each slab's centres of a cell follow those of the slabs before.
    places = np.cumsum([start[:-1], *(each.n_owned for each in counted[:-1])], axis=0)

    def place(first: int, stop: int) -> None:
        for each, at in zip(counted[first:stop], places[first:stop], strict=True):
            _place_centres(
                entries,
                at,
                owner[each.first : each.stop],
                partition[each.first : each.stop],
                is_sampled,
            )

    over_slabs(place, len(counted), len(owner))
    sampled, index = np.flatnonzero(is_sampled), image.to_index(mesh.points)

    def sample(first: int, stop: int) -> None:
        part = sampled[first:stop]
        entries[start[part, None] + np.arange(len(inner))] = labels_at(
            members, index, mesh.cells[part], inner
        )

    over_slabs(sample, len(sampled), len(inner) * len(sampled), 1 + len(sampled) // SAMPLED_AT_ONCE)
    # Not 1 per centre: among cells of about `FEWEST_CENTRES`, those with more centres than their
    # volume are counted.
    each = (
        np.abs(volumes(mesh.points, mesh.cells))
        / image.voxel_volume
        / np.where(is_sampled, len(inner), n_owned)
    )
    first = np.zeros(n_cells + 1, dtype=np.int64)
    over_slabs(
        lambda a, b: _count_kinds(first, entries, start, n_labels, (a, b)), n_cells, len(entries)
    )
    np.cumsum(first, out=first)
    row, volume = np.empty(first[-1], dtype=np.int64), np.empty(first[-1])
    over_slabs(
        lambda a, b: _sum_kinds(row, volume, first, entries, start, each, n_labels, (a, b)),
        n_cells,
        len(entries),
    )
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
    pieces, holder = voxels.pieces, owner[voxels.pieces.voxels]
    piece, cell = pieces.piece[holder >= 0], holder[holder >= 0]
    in_cells = scipy.sparse.csr_array(
        (np.ones(len(cell)), (piece, cell)), shape=(len(pieces.label), n_cells)
    )
    return Contents(counts, Contacts(voxels.is_apart, is_place[:-1].copy()), in_cells, pieces.label)


class _Counted(NamedTuple):
    """Voxel centres in a slab of the voxels."""

    first: int
    stop: int
    n_owned: NDArray[np.int64]  # (M,) in each cell
    n_of: NDArray[np.int64]  # (K,) of each label in any cell


@njit(cache=True, nogil=True)
def _count_centres(n_owned: NDArray, n_of: NDArray, owner: NDArray, partition: NDArray) -> None:
    """Count the voxel centres in each cell, and those of each label in any of them."""
    for v in range(len(owner)):
        if owner[v] >= 0:
            n_owned[owner[v]] += 1
            n_of[partition[v]] += 1


@njit(cache=True, nogil=True)
def _place_centres(
    entries: NDArray, end: NDArray, owner: NDArray, partition: NDArray, is_sampled: NDArray
) -> None:
    for v in range(len(owner)):
        cell = owner[v]
        if cell >= 0 and not is_sampled[cell]:
            entries[end[cell]] = partition[v]
            end[cell] += 1


@njit(cache=True, nogil=True)
def _count_kinds(
    first: NDArray, entries: NDArray, start: NDArray, n_labels: int, ends: tuple[int, int]
) -> None:
    """Count the labels present in each of some cells."""
    last = np.full(n_labels, -1, dtype=np.int64)
    for cell in range(*ends):
        for i in range(start[cell], start[cell + 1]):
            if last[entries[i]] != cell:
                last[entries[i]] = cell
                first[cell + 1] += 1


@njit(cache=True, nogil=True)
def _sum_kinds(
    row: NDArray,
    volume: NDArray,
    first: NDArray,
    entries: NDArray,
    start: NDArray,
    each: NDArray,
    n_labels: int,
    ends: tuple[int, int],
) -> None:
    total, last = np.zeros(n_labels), np.full(n_labels, -1, dtype=np.int64)
    for cell in range(*ends):
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
    """Barycentric places (S, n+1): the points that divide a simplex's edges into parts, moved
    inside.
    """
    whole = np.array(
        [each for each in itertools.product(range(parts + 1), repeat=n + 1) if sum(each) == parts]
    )
    return (whole + 0.5) / (parts + 0.5 * (n + 1))


# 15 and 20 barycentric places in a cell, by dimension
PART_CENTRES = {2: _samples(2, 4), 3: _samples(3, 3)}


def crowded_nodes(cells: NDArray[np.int64], of_cell: NDArray[np.int64]) -> int:
    """Nodes with more labels than they can be moved onto (`MOST_MEETING`); cells (M, n+1), their
    labels (M,).
    """
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
