"""Remove cells within a mask: at pinches of the boundary, and in components that the mask does not have."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.domain import Region
from tetopt.geometry.manifold import manifold_part
from tetopt.geometry.simplex import centroids, volumes
from tetopt.geometry.topology import compact, components
from tetopt.image import Image
from tetopt.mesh import Mesh

# of the largest component of cells within a component of voxels: smaller ones are dropped
DROPPED_FRACTION = 0.1


class Carved(NamedTuple):
    """The cells that stay."""

    is_kept: NDArray[np.bool_]  # (M,)
    n_dropped: int  # dropped connected components


def carved(mesh: Mesh, image: Image, region: Region, keeps_components: bool = False) -> Carved:
    """Select the cells of a mesh to keep, so that its boundary is a manifold and its components are the mask's.

    Cells at pinches of the boundary are dropped (`manifold_part`). Within each face-connected component of voxels, the
    largest connected component of cells stays, and those of a tenth of its volume or more; with `keeps_components`
    all stay.
    """
    size = volumes(mesh.points, mesh.cells)
    is_kept = manifold_part(_welded(mesh), size)
    chosen = np.flatnonzero(is_kept)
    number = components(mesh.cells[chosen])
    volume = np.bincount(number, size[chosen])
    if keeps_components or len(volume) < 2:
        return Carved(is_kept, 0)
    home = _home(mesh, chosen, number, size, image, region)
    largest = np.zeros(home.max() + 1)
    np.maximum.at(largest, home, volume)
    is_dropped = (home == 0) | (volume < DROPPED_FRACTION * largest[home])
    is_dropped[np.argmax(volume)] = False
    is_kept[chosen[is_dropped[number]]] = False
    return Carved(is_kept, int(is_dropped.sum()))


def _welded(mesh: Mesh) -> NDArray[np.int64]:
    """The cells with one number for coincident nodes, where parts of a boundary may touch without sharing a node."""
    order = np.lexsort(mesh.points.T)
    is_new = np.append(True, (mesh.points[order[1:]] != mesh.points[order[:-1]]).any(axis=1))
    first = np.empty(len(order), dtype=np.int64)
    first[order] = order[np.flatnonzero(is_new)][np.cumsum(is_new) - 1]
    return first[mesh.cells]


def part_of(mesh: Mesh, is_kept: NDArray[np.bool_]) -> Mesh:
    """The mesh of the cells that stay, (M,), without unused nodes."""
    if is_kept.all():
        return mesh
    used, cells = compact(mesh.cells[is_kept], len(mesh.points))
    return Mesh(mesh.points[used], cells)


def n_components(region: Region) -> int:
    """Connected components of a mask's voxels, linked by faces."""
    return int(scipy.ndimage.label(region.inside)[1])


def _home(
    mesh: Mesh, chosen: NDArray[np.int64], number: NDArray[np.int64], size: NDArray[np.float64], image: Image,
    region: Region,
) -> NDArray[np.int64]:  # fmt: skip
    """The component of voxels, from 1, that contains most of each component of the chosen cells, (C,); 0 for none."""
    of_voxel, n_homes = scipy.ndimage.label(region.inside)
    index = np.rint(image.to_index(centroids(mesh.points, mesh.cells[chosen]))).astype(np.int64)
    at = of_voxel[tuple(np.clip(index, 0, np.array(image.shape) - 1).T)].astype(np.int64)
    fractions = scipy.sparse.coo_array((size[chosen], (number, at)), shape=(int(number.max()) + 1, n_homes + 1)).tocsr()
    fractions = fractions[:, 1:]  # a component that lies partly outside has its home inside
    home = np.zeros(fractions.shape[0], dtype=np.int64)
    has_home = np.diff(fractions.indptr) > 0
    home[has_home] = np.asarray(fractions.argmax(axis=1)).ravel()[has_home] + 1
    return home
