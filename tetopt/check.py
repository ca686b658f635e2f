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

    In a mesh every node is used, and no two lie in the same place; every cell is positively oriented, has distinct
    corners and is there once; every facet is in one or two cells, which lie on its two sides (so the mesh conforms and
    does not fold); the boundary is closed, and one piece. With an image also the boundary's facets lie on the faces of
    its box, and the cells' volumes add up to it.

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
    problems = [*_problems_of_nodes(mesh), *_problems_of_cells(mesh)]
    if not problems:  # what follows takes sound cells for granted
        problems = _problems_of_facets(mesh, is_whole)
    if not problems and image is not None:
        problems = _problems_with_box(mesh, image)
    return problems


def _first(numbers: NDArray) -> str:
    """How many there are, and the first of them, for a message."""
    return f"{len(numbers)}, the first {numbers[:5].tolist()}"


def _problems_of_nodes(mesh: Mesh) -> list[str]:
    problems = []
    unused = np.flatnonzero(np.bincount(mesh.cells.ravel(), minlength=len(mesh.points)) == 0)
    if len(unused):
        problems.append(f"nodes that no cell uses: {_first(unused)}")
    order = np.lexsort(mesh.points.T)
    same = (mesh.points[order[1:]] == mesh.points[order[:-1]]).all(axis=1)
    if same.any():
        pairs = np.column_stack([order[:-1], order[1:]])[same]
        problems.append(f"pairs of nodes in one place: {_first(np.sort(pairs, axis=1))}")
    return problems


def _problems_of_cells(mesh: Mesh) -> list[str]:
    problems = []
    ordered = np.sort(mesh.cells, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(repeated):
        problems.append(f"cells with a corner twice: {_first(repeated)}")
    flat = np.flatnonzero(~(volumes(mesh.points, mesh.cells) > 0.0))
    if len(flat):
        problems.append(f"cells that are flat or inverted: {_first(flat)}")
    _, index, counts = np.unique(ordered, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        problems.append(f"cells that are there more than once: {_first(np.sort(index[counts > 1]))}")
    return problems


def _problems_of_facets(mesh: Mesh, is_whole: bool) -> list[str]:
    problems = []
    pairs = folded(mesh.cells)
    if len(pairs):
        problems.append(
            f"facets whose cells lie on one side of them, or of more than two cells; cells: {_first(pairs)}"
        )
    shared = facets(mesh.cells)
    outer = shared.nodes[shared.n_cells == 1]
    if mesh.ndim == 3:  # every edge of the boundary's triangles belongs to an even number of them
        edges = np.sort(outer[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1)
        kinds, counts = np.unique(edges, axis=0, return_counts=True)
    else:
        kinds, counts = np.unique(outer, return_counts=True)
        kinds = kinds[:, None]
    if (counts % 2).any():
        problems.append(f"places where the boundary is open; nodes: {_first(kinds[counts % 2 == 1])}")
    pieces = components(mesh.cells)
    if is_whole and pieces.max() > 0:
        sizes = np.bincount(pieces)
        problems.append(f"pieces that share no facet: {len(sizes)}, of {np.sort(sizes)[::-1][:5].tolist()} cells")
    return problems


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


def _problems_with_box(mesh: Mesh, image: Image) -> list[str]:
    problems = []
    outer, is_on_box = facets_on_box(mesh, image)
    if not is_on_box.all():
        problems.append(f"boundary facets off the faces of the image's box; nodes: {_first(outer[~is_on_box])}")
    filled = filled_share(mesh, image)
    if abs(filled - 1.0) > 1e-9:
        problems.append(f"volume: {filled:.12g} of the image's box")
    return problems
