"""Interfaces between labels: their cells, their sliding nodes, and their part of E.

The label of a cell follows from its voxels, tension and topology (`tetopt.engine.labelling`).
"""

from __future__ import annotations

import itertools

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
    label_cells,
    mend_labels,
    unfit_labels,
)
from tetopt.engine.sliding import MOST_MEETING, insert_label
from tetopt.geometry.manifold import OUTSIDE_LABEL, pinches
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.arrays import Floats, Ints
from tetopt.system.kernels import entry
from tetopt.system.slabs import count_pairs, over_slabs

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
    across = state.complex.across[: len(mesh.cells)]
    contents = cell_contents(content.image, smooth.memberships, mesh, voxels)
    rows = label_cells(
        mesh.points, mesh.cells, across, contents, voxels.components, smooth.keeps_volumes
    )
    return follow_labels(state, content, smooth, rows)


def follow_labels(state: State, content: Content, smooth: SmoothLabels, rows: Ints) -> State:
    """The state with labels for cells, (M,) rows of the content's labels, whose interfaces follow
    the voxels', and an objective that penalises other labels' voxels.
    """
    members, own_channel, own_value, _ = smooth
    image = content.image
    state.complex.labels[: len(rows)] = rows
    objective = state.objective._replace(
        n_means=int(content.n_contrasts),
        own_column=np.where(own_channel == 0, 1, 2 + own_channel),
        own_value=own_value.astype(np.float64),
    )
    levels = members.levels.reshape(-1, *(1,) * (3 - image.ndim), *image.shape)
    state = state._replace(
        objective=objective, sides=state.sides._replace(levels=levels, channel=members.channel)
    )
    meet_everywhere(state)
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
    aim = image.voxel_volume * np.array([sizes.sum() for sizes in voxels.components])
    is_unfit = unfit_labels(labels, mesh.cell_volumes, aim)
    if is_unfit.any() or any(
        (places.labels[:, 0] != OUTSIDE_LABEL).any()
        for places in pinches(facets(mesh.cells), labels)
    ):
        contents = cell_contents(image, members, mesh, voxels)
        labels[:] = mend_labels(mesh.points, mesh.cells, across, contents, labels, aim)
        meet_everywhere(state)


def cell_contents(image: Image, members: Memberships, mesh: Mesh, voxels: LabelVoxels) -> Contents:
    """Voxels of each label in each cell, contacts of labels, and their pieces; cells with few
    centres are sampled.

    A cell of a thin sheet may contain one centre, or none. Levels are sampled at the centres of
    equal parts.
    """
    shape, inner = (len(mesh.cells), len(members.labels)), PART_CENTRES[image.ndim]
    owner = cell_of_voxel(image, mesh).ravel()
    centres = count_pairs(owner, members.partition.ravel(), shape)
    n_owned = centres.sum(axis=1)
    is_sampled = n_owned < FEWEST_CENTRES
    sampled, index = np.flatnonzero(is_sampled), image.to_index(mesh.points)

    def sample(first: int, stop: int) -> Ints:
        return labels_at(members, index, mesh.cells[sampled[first:stop]], inner)

    most = 1 + len(sampled) // SAMPLED_AT_ONCE
    there = over_slabs(sample, len(sampled), len(inner) * len(sampled), most)
    of_sample = np.repeat(sampled, len(inner))
    samples = count_pairs(of_sample, np.concatenate(there).ravel(), shape)
    # Not 1 per centre: among cells of about `FEWEST_CENTRES`, those with more centres than their
    # volume are counted.
    each = mesh.cell_volumes / image.voxel_volume / np.where(is_sampled, len(inner), n_owned)
    counts = _diagonal(each) @ (_diagonal(~is_sampled) @ centres + samples)
    # Samples may miss a label of a voxel or two, so its centres count.
    is_unseen = counts.sum(axis=0) < SAMPLED_FRACTION * centres.sum(axis=0)
    counts = counts + _diagonal(is_sampled) @ centres @ _diagonal(is_unseen)
    counts.eliminate_zeros()
    counts.sort_indices()
    is_place = np.zeros(shape[0] + 1, dtype=bool)
    is_place[owner[voxels.places]] = True
    pieces, holder = voxels.pieces, owner[voxels.pieces.voxels]
    piece, cell = pieces.piece[holder >= 0], holder[holder >= 0]
    in_cells = scipy.sparse.csr_array(
        (np.ones(len(cell)), (piece, cell)), shape=(len(pieces.label), shape[0])
    )
    return Contents(counts, Contacts(voxels.is_apart, is_place[:-1].copy()), in_cells, pieces.label)


def _diagonal(values: NDArray) -> scipy.sparse.csr_array:
    return scipy.sparse.diags_array(values.astype(np.float64), format="csr")


def _samples(n: int, parts: int) -> Floats:
    """Barycentric places (S, n+1): the points that divide a simplex's edges into parts, moved
    inside.
    """
    whole = np.array(
        [each for each in itertools.product(range(parts + 1), repeat=n + 1) if sum(each) == parts]
    )
    return (whole + 0.5) / (parts + 0.5 * (n + 1))


# 15 and 20 barycentric places in a cell, by dimension
PART_CENTRES = {2: _samples(2, 4), 3: _samples(3, 3)}


def crowded_nodes(cells: Ints, of_cell: Ints) -> int:
    """Nodes with more labels than they can be moved onto (`MOST_MEETING`); cells (M, n+1), their
    labels (M,).
    """
    pairs = np.unique(np.column_stack([cells.ravel(), np.repeat(of_cell, cells.shape[1])]), axis=0)
    return int((np.bincount(pairs[:, 0]) > MOST_MEETING).sum())


def meet_everywhere(state: State) -> None:
    """Store the labels of the cells around each node."""
    _meet_everywhere(state, node_stars(state))


@entry
def _meet_everywhere(state: State, stars: NodeStars) -> None:
    for node in range(len(state.complex.ticks)):
        meeting, count = state.complex.meeting[node], 0
        for m in range(MOST_MEETING):
            meeting[m] = -1
        for r in range(stars.start[node], stars.start[node + 1]):
            count = insert_label(meeting, count, state.complex.labels[stars.cells[r]])
        if count == 1:
            meeting[0] = -1
