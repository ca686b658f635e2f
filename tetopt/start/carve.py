"""Remove cells within a mask: at pinches of the boundary, and in small components that the mask
does not have.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from tetopt.contents.domain import Region
from tetopt.contents.memberships import Memberships
from tetopt.geometry.manifold import manifold_part
from tetopt.geometry.simplex import centroids, volumes
from tetopt.geometry.topology import compact, components
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.arrays import Bools, Floats, Ints

# of the largest component of cells within a component of voxels: smaller ones are dropped. A larger
# one is a part of the mask that cells do not join to the rest, which is better told (requirement
# `components`) than lost.
DROPPED_FRACTION = 0.01


class Carved(NamedTuple):
    """The cells that stay."""

    is_kept: Bools  # (M,)
    n_dropped: int  # dropped connected components
    volumes: dict[int, float]  # mm^n of these, by label; all of label 0 without labels


def carve_mesh(
    mesh: Mesh,
    image: Image,
    region: Region,
    keeps_components: bool = False,
    members: Memberships | None = None,
) -> Carved:
    """Select the cells of a mesh to keep, so that its boundary is a manifold and its components are
    the mask's.

    Cells at pinches of the boundary are dropped (`manifold_part`). Within each face-connected
    component of voxels, the largest connected component of cells stays, and those of a hundredth of
    its volume or more; with `keeps_components` all stay. With labels, `members`, a component with
    most of a label's volume stays, too.
    """
    size = volumes(mesh.points, mesh.cells)
    is_kept = manifold_part(_weld_cells(mesh), size)
    chosen = np.flatnonzero(is_kept)
    number = components(mesh.cells[chosen])
    volume = np.bincount(number, size[chosen])
    if keeps_components or len(volume) < 2:
        return Carved(is_kept, 0, {})
    index = np.rint(image.to_index(centroids(mesh.points, mesh.cells[chosen]))).astype(np.int64)
    voxel = tuple(np.clip(index, 0, np.array(image.shape) - 1).T)
    home = _home(voxel, number, size[chosen], region)
    largest = np.zeros(home.max() + 1)
    np.maximum.at(largest, home, volume)
    is_dropped = (home == 0) | (volume < DROPPED_FRACTION * largest[home])
    labels = np.zeros(1, dtype=np.int64) if members is None else members.labels
    row = np.zeros(len(chosen), dtype=np.int64) if members is None else members.partition[voxel]
    by_label = np.bincount(number * len(labels) + row, size[chosen], len(volume) * len(labels))
    by_label = by_label.reshape(len(volume), len(labels))
    if members is not None:
        is_dropped &= ~(by_label > 0.5 * by_label.sum(axis=0)).any(axis=1)
    is_dropped[np.argmax(volume)] = False
    is_kept[chosen[is_dropped[number]]] = False
    lost = by_label[is_dropped].sum(axis=0)
    return Carved(
        is_kept,
        int(is_dropped.sum()),
        dict(zip(labels[lost > 0].tolist(), lost[lost > 0].tolist(), strict=True)),
    )


def _weld_cells(mesh: Mesh) -> Ints:
    """The cells with one number for coincident nodes, where parts of a boundary may touch
    without sharing a node.
    """
    order = np.lexsort(mesh.points.T)
    is_new = np.append(True, (mesh.points[order[1:]] != mesh.points[order[:-1]]).any(axis=1))
    first = np.empty(len(order), dtype=np.int64)
    first[order] = order[np.flatnonzero(is_new)][np.cumsum(is_new) - 1]
    return first[mesh.cells]


def part_of(mesh: Mesh, is_kept: Bools) -> Mesh:
    """The mesh of the cells that stay, (M,), without unused nodes."""
    if is_kept.all():
        return mesh
    used, cells = compact(mesh.cells[is_kept], len(mesh.points))
    return Mesh(mesh.points[used], cells)


def _home(
    voxel: tuple[Ints, ...],
    number: Ints,
    size: Floats,
    region: Region,
) -> Ints:
    """The component of voxels, from 1, that contains most of each component of cells, (C,); 0 for
    none.

    Cells have a `number` of their component, a size, and a voxel at their centroid.
    """
    of_voxel, n_homes = scipy.ndimage.label(region.inside)
    at = of_voxel[voxel].astype(np.int64)
    fractions = scipy.sparse.coo_array(
        (size, (number, at)), shape=(int(number.max()) + 1, n_homes + 1)
    ).tocsr()
    fractions = fractions[:, 1:]  # a component that lies partly outside has its home inside
    home = np.zeros(fractions.shape[0], dtype=np.int64)
    has_home = np.diff(fractions.indptr) > 0
    home[has_home] = np.asarray(fractions.argmax(axis=1)).ravel()[has_home] + 1
    return home
