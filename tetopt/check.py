"""Is it a mesh? Questions whose answers a solver takes for granted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.box import box_sides, facets_on_sides
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import boundary_facets, components, facets, folded
from tetopt.image import Image
from tetopt.mesh import Mesh


def check_mesh(mesh: Mesh, image: Image | None = None, *, is_whole: bool = True) -> list[str]:
    """What is wrong with a mesh, one line each, the first offenders named; an empty list if nothing is.

    Asked are: every node used and none twice in the same place; every cell positively oriented, with distinct corners,
    and none doubled; every facet in one or two cells, which lie on its two sides (so the mesh conforms and does not
    fold); the boundary closed, and one piece. With an image also: the boundary's facets lie on the faces of its box,
    and the cells' volumes add up to it.

    Parameters
    ----------
    mesh : Mesh
    image : Image, optional
        The image whose box the mesh should fill. Without it overlaps of cells that share no facet are not found.
    is_whole : bool
        Whether it should be one piece; a mask may have several.

    Raises
    ------
    InputError
        Mesh and image of different dimension.
    """
    if image is not None and image.ndim != mesh.ndim:
        raise InputError(
            f"mesh and image: expected the same dimension, got a {mesh.ndim}-D mesh and a {image.ndim}-D image"
        )
    found = [*_nodes(mesh), *_cells(mesh)]
    if not found:  # what follows takes sound cells for granted
        found = _facets(mesh, is_whole)
    if not found and image is not None:
        found = _box(mesh, image)
    return found


def _first(numbers: NDArray) -> str:
    return f"{len(numbers)}, the first {numbers[:5].tolist()}"


def _nodes(mesh: Mesh) -> list[str]:
    found = []
    unused = np.flatnonzero(np.bincount(mesh.cells.ravel(), minlength=len(mesh.points)) == 0)
    if len(unused):
        found.append(f"nodes that no cell uses: {_first(unused)}")
    order = np.lexsort(mesh.points.T)
    same = (mesh.points[order[1:]] == mesh.points[order[:-1]]).all(axis=1)
    if same.any():
        pairs = np.column_stack([order[:-1], order[1:]])[same]
        found.append(f"pairs of nodes in one place: {_first(np.sort(pairs, axis=1))}")
    return found


def _cells(mesh: Mesh) -> list[str]:
    found = []
    ordered = np.sort(mesh.cells, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(repeated):
        found.append(f"cells with a corner twice: {_first(repeated)}")
    flat = np.flatnonzero(~(volumes(mesh.points, mesh.cells) > 0.0))
    if len(flat):
        found.append(f"cells that are flat or inverted: {_first(flat)}")
    _, index, counts = np.unique(ordered, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        found.append(f"cells that are there more than once: {_first(np.sort(index[counts > 1]))}")
    return found


def _facets(mesh: Mesh, is_whole: bool) -> list[str]:
    found = []
    pairs = folded(mesh.cells)
    if len(pairs):
        found.append(f"facets whose cells lie on one side of them, or of more than two cells; cells: {_first(pairs)}")
    shared = facets(mesh.cells)
    outer = shared.nodes[shared.n_cells == 1]
    if mesh.ndim == 3:  # every edge of the boundary's triangles belongs to an even number of them
        edges = np.sort(outer[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1)
        kinds, counts = np.unique(edges, axis=0, return_counts=True)
    else:
        kinds, counts = np.unique(outer, return_counts=True)
        kinds = kinds[:, None]
    if (counts % 2).any():
        found.append(f"places where the boundary is open; nodes: {_first(kinds[counts % 2 == 1])}")
    pieces = components(mesh.cells)
    if is_whole and pieces.max() > 0:
        sizes = np.bincount(pieces)
        found.append(f"pieces that share no facet: {len(sizes)}, of {np.sort(sizes)[::-1][:5].tolist()} cells")
    return found


def check_unfolded(mesh: Mesh) -> None:
    """InputError if cells overlap at a facet, or more than two share one.

    Raises
    ------
    InputError
        With the first cells that do.
    """
    pairs = folded(mesh.cells)
    if len(pairs):
        raise InputError(
            f"mesh: {len(pairs)} facets have cells that overlap there, as inverted ones do, or more than two; the "
            f"first are of cells {pairs[:3].tolist()}; mend the mesh"
        )


def facets_on_box(mesh: Mesh, image: Image) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Boundary facets, (B, n) nodes, and whether each lies on a face of the image's box, (B,)."""
    outer = boundary_facets(mesh.cells)
    is_on = facets_on_sides(image.to_index(mesh.points), outer, box_sides(image.shape))
    return outer, np.any(is_on, axis=(1, 2))


def filled_share(mesh: Mesh, image: Image) -> float:
    """The volume of the cells over that of the image's box; 1 where they fill it without overlaps."""
    return float(volumes(mesh.points, mesh.cells).sum()) / image.volume


def _box(mesh: Mesh, image: Image) -> list[str]:
    found = []
    outer, on_box = facets_on_box(mesh, image)
    if not on_box.all():
        found.append(f"boundary facets off the faces of the image's box; nodes: {_first(outer[~on_box])}")
    filled = filled_share(mesh, image)
    if abs(filled - 1.0) > 1e-9:
        found.append(f"volume: {filled:.12g} of the image's box")
    return found
