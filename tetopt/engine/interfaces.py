"""Interfaces between labels: which cells they lie between, where their nodes slide, and what E counts of them.

A cell begins with the label that the voxels in it, tension and topology ask for (`tetopt.engine.labelling`). From then
on labels change only with the mesh: cells beside an interface take the label of a neighbour where that lowers E and
leaves both labels' topology as it is.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.content import Content, SmoothLabels
from tetopt.contents.memberships import Memberships
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine.complex import NodeStars, State, facet_area, image_energy, node_stars, outward, pair_tension
from tetopt.engine.labelling import keeps_topology, labelled, unpinched, voxel_components
from tetopt.engine.surface import MOST_MEETING
from tetopt.geometry.manifold import OUTSIDE_LABEL, pinches
from tetopt.geometry.simplex import centroids, volumes
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.kernels import Floats1, Ints1, entry, helper, unit

RELABELLING_PASSES = 10  # at most; the third mostly changes nothing
LEAST_RELABELLING_FRACTION = 1e-9  # of the energies weighed: a smaller gain may be rounding


def with_labels(state: State, content: Content, smooth: SmoothLabels, mesh: Mesh) -> State:
    """The state with a label for each cell, of the content's, and an objective that counts what is not of it."""
    members, tension, own_channel, own_value = smooth
    components = voxel_components(members.partition, len(members.labels))
    n_cells, image = len(mesh.cells), content.image
    across = state.complex.across[:n_cells]
    state.complex.labels[:n_cells] = labelled(
        mesh.points, mesh.cells, across, cell_counts(image, members, mesh), components
    ).labels
    step = image.voxel_volume ** (1.0 / image.ndim)
    objective = state.objective._replace(
        n_means=int(content.n_contrasts),
        own_column=np.where(own_channel == 0, 1, 2 + own_channel),
        own_value=own_value.astype(np.float64),
        tension=float(state.objective.image * tension * step / image.voxel_volume),
    )
    levels = members.levels.reshape(len(members.levels), *(1,) * (3 - image.ndim), *image.shape)
    state = state._replace(objective=objective, sides=state.sides._replace(levels=levels, channel=members.channel))
    _meet_everywhere(state, node_stars(state))
    return state


def mend_pinches(state: State, image: Image, members: Memberships, mesh: Mesh) -> None:
    """Give cells other labels where an interface of two labels is not a manifold; no node moves."""
    labels, across = (array[: len(mesh.cells)] for array in (state.complex.labels, state.complex.across))
    of_ridges, of_nodes = pinches(facets(mesh.cells), labels)
    if any((places.labels[:, 0] != OUTSIDE_LABEL).any() for places in (of_ridges, of_nodes)):
        labels[:] = unpinched(mesh.points, mesh.cells, across, cell_counts(image, members, mesh), labels)
        _meet_everywhere(state, node_stars(state))


def cell_counts(image: Image, members: Memberships, mesh: Mesh) -> scipy.sparse.csr_array:
    """Voxels of each label in each cell, (M, K); of a cell without voxels its size in those of its centroid's label."""
    partition = members.partition
    owner, n_labels = cell_of_voxel(image, mesh).ravel(), len(members.labels)
    is_in, shape = owner >= 0, (len(mesh.cells), n_labels)
    counts = scipy.sparse.csr_array((np.ones(int(is_in.sum())), (owner[is_in], partition.ravel()[is_in])), shape=shape)
    empty = np.flatnonzero(counts.sum(axis=1) == 0.0)
    nearest = np.rint(image.to_index(centroids(mesh.points, mesh.cells[empty]))).astype(np.int64)
    nearest = np.clip(nearest, 0, np.array(image.shape) - 1)
    size = volumes(mesh.points, mesh.cells[empty]) / image.voxel_volume
    counts = counts + scipy.sparse.csr_array((size, (empty, partition[tuple(nearest.T)])), shape=shape)
    counts.sum_duplicates()
    return counts


def crowded_nodes(cells: NDArray[np.int64], of_cell: NDArray[np.int64]) -> int:
    """Nodes between more labels than they are brought to (`MOST_MEETING`); cells (M, n+1), their labels (M,)."""
    pairs = np.unique(np.column_stack([cells.ravel(), np.repeat(of_cell, cells.shape[1])]), axis=0)
    return int((np.bincount(pairs[:, 0]) > MOST_MEETING).sum())


@unit
def _meet(state: State, stars: NodeStars, node: int) -> None:
    """Note which labels the cells around a node have."""
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


def relabel(state: State) -> int:
    """Let cells beside an interface take a neighbour's label where E falls and no topology changes; how many did."""
    stars, total = node_stars(state), 0
    gain, label = np.zeros(int(state.complex.n_cells[0])), np.zeros(int(state.complex.n_cells[0]), dtype=np.int64)
    for _ in range(RELABELLING_PASSES):
        _find_relabellings(gain, label, state)
        order = np.flatnonzero(gain > 0.0)
        moved = _relabel(order[np.lexsort((order, -gain[order]))], gain, label, state, stars)
        total += moved
        if moved == 0:
            break
    return total


@unit
def _price(state: State, cell: int, label: int) -> float:
    """What a cell costs with a label, as far as the label matters."""
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
        more = own - _price(state, cell, mesh.labels[other])
        if more > max(gain[cell], LEAST_RELABELLING_FRACTION * own):
            gain[cell], label[cell] = more, mesh.labels[other]


@entry
def _find_relabellings(gain: Floats1, label: Ints1, state: State) -> None:
    for cell in range(len(gain)):
        _find_relabelling(gain, label, state, cell)


@entry
def _relabel(order: Ints1, gain: Floats1, label: Ints1, state: State, stars: NodeStars) -> int:
    mesh, moved = state.complex, 0
    for cell in order:
        _find_relabelling(gain, label, state, cell)
        if gain[cell] > 0.0 and keeps_topology(
            mesh.cells, mesh.across, mesh.labels, stars.start, stars.cells, cell, label[cell]
        ):
            mesh.labels[cell] = label[cell]
            for k in range(mesh.cells.shape[1]):
                _meet(state, stars, mesh.cells[cell, k])
            moved += 1
    return moved
