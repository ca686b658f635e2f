"""Checks of the properties of a mesh that solvers take for granted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError, warn
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides, facets_on_sides
from tetopt.geometry.manifold import OUTSIDE_LABEL, pinches
from tetopt.geometry.quadratic import (
    cell_edges,
    curved_rule,
    gauss_rule,
    jacobian_ratios,
    quadratic,
)
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import Facets, boundary_facets, components, facets, folded_groups
from tetopt.system.arrays import Bools, Floats, Ints

if TYPE_CHECKING:
    from tetopt.image import Image
    from tetopt.mesh import Mesh

LENGTH_UNITS = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "um": 1e-3}  # in mm
# A mesh this many times longer or shorter than the image is in another unit.
MOST_LENGTHS = 400.0
# of the boxes of mesh and image: a unit is possible, or it is likely
LEAST_OVERLAP, LIKELY_OVERLAP = 1e-3, 0.5
MM_OVERLAP = 0.2  # along each axis: with more, the mesh is that of a part, in mm
OUTSIDE_VOXELS = 1.0  # beyond the image's box, from which a node lies outside
# how far nodes of a file with few digits may lie beyond the box of a mesh that need not fill it
BOX_ROUNDING_VOXELS = 1e-3


def check_mesh(
    mesh: Mesh,
    image: Image | None = None,
    *,
    is_whole: bool = True,
    is_filled: bool = True,
    is_manifold: bool = True,
    of_cell: ArrayLike | None = None,
) -> list[str]:
    """List the defects of a mesh, one line each, with the first offenders; empty if there are none.

    In a sound mesh every node is used, and no two nodes coincide. Every cell is positively
    oriented, has distinct corners, occurs once, and is not folded by a mid-edge node. Every facet
    belongs to one or two cells, which lie on opposite sides of it, so that the mesh conforms and
    does not fold. The boundary is closed, a manifold (`manifold_problems`) and connected. With
    labels, their interfaces are manifolds, too. With an image, no node lies beyond its box; if the
    mesh fills the box, boundary facets lie on its faces and the cells' volumes add up to it.

    Parameters
    ----------
    mesh : Mesh
        Points in world coordinates, mm.
    image : Image, optional
        The image whose box the mesh should fill, or lie in. Overlaps of cells that share no facet
        are found only if the mesh should fill it.
    is_whole : bool
        Require one connected component; a mask may have several.
    is_filled : bool
        Require that it fills the image's box; the mesh of a mask only lies within it.
    is_manifold : bool
        Require that its boundary is a manifold; a mask's may not be.
    of_cell : (M,) array of whole numbers, optional
        Label of each cell, 0 or more.

    Returns
    -------
    list of str
        Empty if nothing is wrong.

    Raises
    ------
    InputError
        Mesh and image of different dimension, or labels that are not one whole number per cell.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> tetopt.check_mesh(mesh, image)
    []
    >>> for line in tetopt.check_mesh(tetopt.Mesh(mesh.points, mesh.cells[1:]), image):
    ...     print(line)
    edges where the boundary has more than two facets; nodes: 1, the first [[36, 42]]
    boundary facets off the faces of the image's box; nodes: 4, ...
    volume: 0.999166666667 of the image's box
    """
    if image is not None and image.ndim != mesh.ndim:
        raise InputError(
            f"mesh and image: expected the same dimension, got a {mesh.ndim}-D mesh and a "
            f"{image.ndim}-D image"
        )
    problems = [*_problems_of_nodes(mesh), *_problems_of_cells(mesh)]
    if not problems:  # the other checks assume sound cells
        problems = _problems_of_facets(mesh)
    if problems:
        return problems
    problems = _problems_of_curves(mesh) + (_problems_of_pieces(mesh) if is_whole else [])
    problems += manifold_problems(mesh) if is_manifold else []
    problems += [] if of_cell is None else manifold_problems(mesh, of_cell)
    problems += [] if image is None else _problems_with_box(mesh, image, is_filled)
    return problems


def _first(numbers: NDArray) -> str:
    """The count and the first numbers, for a message."""
    return f"{len(numbers)}, the first {numbers[:5].tolist()}"


def _problems_of_nodes(mesh: Mesh) -> list[str]:
    problems = []
    unused = np.flatnonzero(np.bincount(mesh.cells.ravel(), minlength=len(mesh.points)) == 0)
    if len(unused):
        problems.append(f"unused nodes: {_first(unused)}")
    order = np.lexsort(mesh.points.T)
    same = (mesh.points[order[1:]] == mesh.points[order[:-1]]).all(axis=1)
    if same.any():
        pairs = np.column_stack([order[:-1], order[1:]])[same]
        problems.append(f"pairs of nodes at the same position: {_first(np.sort(pairs, axis=1))}")
    return problems


def _problems_of_cells(mesh: Mesh) -> list[str]:
    problems = []
    ordered = np.sort(mesh.cells, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(repeated):
        problems.append(f"cells with a repeated corner: {_first(repeated)}")
    flat = np.flatnonzero(~(volumes(mesh.points, mesh.cells) > 0.0))
    if len(flat):
        problems.append(f"flat or inverted cells: {_first(flat)}")
    _, index, counts = np.unique(ordered, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        problems.append(f"duplicate cells: {_first(np.sort(index[counts > 1]))}")
    return problems


def scaled_jacobians(mesh: Mesh) -> Floats:
    """Least ratio of each quadratic cell's Jacobian determinant to the straight cell's, (M,); 0 or
    less if folded.

    Evaluated at corners, mid-edge nodes and the points of both integration rules of
    `tetopt.geometry.quadratic`.
    """
    n = mesh.ndim
    nodes, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    corners = np.eye(n + 1)
    middles = corners[cell_edges(n)].mean(axis=1)
    places = np.concatenate([corners, middles, gauss_rule(n, 2)[0], curved_rule(n)[0]])
    return jacobian_ratios(nodes, cells, places).min(axis=1)


def _problems_of_curves(mesh: Mesh) -> list[str]:
    if mesh.midpoints is None or not len(cells := np.flatnonzero(scaled_jacobians(mesh) <= 0.0)):
        return []
    return [f"quadratic cells folded by their mid-edge nodes: {_first(cells)}"]


def _problems_of_facets(mesh: Mesh) -> list[str]:
    problems = []
    shared = facets(mesh.cells)
    pairs = folded_groups(mesh.cells, shared)
    if len(pairs):
        problems.append(
            "facets with both cells on the same side, or with more than two cells; cells: "
            f"{_first(pairs)}"
        )
    outer = shared.nodes[shared.n_cells == 1]
    if mesh.ndim == 3:  # every edge of the boundary's triangles belongs to an even number of them
        edges = np.sort(outer[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1)
        kinds, counts = np.unique(edges, axis=0, return_counts=True)
    else:
        kinds, counts = np.unique(outer, return_counts=True)
        kinds = kinds[:, None]
    if (counts % 2).any():
        problems.append(
            f"places where the boundary is open; nodes: {_first(kinds[counts % 2 == 1])}"
        )
    return problems


def _problems_of_pieces(mesh: Mesh) -> list[str]:
    sizes = np.sort(np.bincount(components(mesh.cells)))[::-1]
    return (
        [f"components that share no facet: {len(sizes)}, of {sizes[:5].tolist()} cells"]
        if len(sizes) > 1
        else []
    )


def manifold_problems(mesh: Mesh, of_cell: ArrayLike | None = None) -> list[str]:
    """List where the boundary, or with labels an interface between two labels, is not a manifold,
    one line each.

    It is not a manifold at an edge (in 2-D a node) that belongs to more than two of its facets, and
    at a node around which its facets form several fans. Where three or more labels meet, or two at
    the boundary, interfaces end, and nothing is checked.

    Parameters
    ----------
    mesh : Mesh
        A conforming mesh without overlaps: each facet belongs to one or two cells.
    of_cell : (M,) array of whole numbers, optional
        Label of each cell, 0 or more.

    Raises
    ------
    InputError
        Labels that are not one whole number >= 0 per cell.
    """
    labels = np.zeros(len(mesh.cells), dtype=np.int64) if of_cell is None else np.asarray(of_cell)
    if (
        labels.shape != (len(mesh.cells),)
        or not ((np.rint(labels) == labels) & (labels >= 0)).all()
    ):
        raise InputError(
            f"of_cell: expected a whole number >= 0 for each of the mesh's {len(mesh.cells)} cells"
        )
    at_ridges, at_nodes = pinches(facets(mesh.cells), labels.astype(np.int64))
    whose = "the boundary" if of_cell is None else "the interface of two labels"
    problems = []
    for places, noun, words in (
        (at_ridges, "edges" if mesh.ndim == 3 else "nodes", "has more than two facets"),
        (at_nodes, "nodes", "touches itself"),
    ):
        is_meant = (places.labels[:, 0] == OUTSIDE_LABEL) == (of_cell is None)
        if is_meant.any():
            which = "" if of_cell is None else f" ({_most_frequent(places.labels[is_meant])})"
            problems.append(
                f"{noun} where {whose} {words}{which}; nodes: {_first(places.nodes[is_meant])}"
            )
    return problems


def _most_frequent(pairs: Ints) -> str:
    """The most frequent pairs of labels, with their counts, for a message."""
    kinds, counts = np.unique(pairs, axis=0, return_counts=True)
    most = np.argsort(-counts, kind="stable")[:3]
    words = [f"{kinds[k, 0]} and {kinds[k, 1]} at {counts[k]}" for k in most]
    return ", ".join([*words, *(["others"] if len(kinds) > len(most) else [])])


def check_unfolded(mesh: Mesh, shared: Facets | None = None, source: str = "mesh") -> None:
    """Raise InputError if cells overlap at a facet, or more than two share one; `shared` are its
    facets, if known.

    The message names the mesh by `source`.

    Raises
    ------
    InputError
        Cells overlap; the message names the first.
    """
    pairs = folded_groups(mesh.cells, shared)
    if len(pairs):
        raise InputError(
            f"{source}: at {len(pairs)} facets cells overlap (inverted cells do) or more than "
            "two cells meet; the "
            f"first belong to cells {pairs[:3].tolist()}; repair the mesh"
        )


def facets_on_box(mesh: Mesh, image: Image, shared: Facets | None = None) -> tuple[Ints, Bools]:
    """Boundary facets, (B, n) nodes, and True for those on a face of the image's box, (B,).

    `shared` are the mesh's facets, if already known.
    """
    outer = boundary_facets(mesh.cells, shared)
    is_on = facets_on_sides(image.to_index(mesh.points), outer, box_sides(image.shape))
    return outer, np.any(is_on, axis=(1, 2))


def filled_fraction(mesh: Mesh, image: Image) -> float:
    """Ratio of the cells' volume to that of the image's box; 1 if they fill it without overlaps."""
    return float(mesh.cell_volumes.sum()) / image.volume


def beyond_box(mesh: Mesh, image: Image) -> Floats:
    """Distance of each node beyond the image's box, voxels along an index axis, (N,); negative
    inside.
    """
    low, high = box_sides(image.shape).T
    index = image.to_index(mesh.points)
    return np.asarray(np.maximum(low - index, index - high).max(axis=1))


def outside_fraction(mesh: Mesh, image: Image) -> float:
    """Return the fraction of a mesh's nodes more than a voxel outside the image's box.

    Raises
    ------
    InputError
        Mesh and image of different dimension, in different places (no node lies in the image's
        box, or no voxel's centre in the mesh's), or of lengths that no unit of both explains.

    Warns
    -----
    UserWarning
        Another unit of the mesh would fit the image far better.
    """
    if mesh.ndim != image.ndim:
        raise InputError(f"expected a {image.ndim}-D mesh like the image, got a {mesh.ndim}-D mesh")
    outside = float((beyond_box(mesh, image) > OUTSIDE_VOXELS).mean())
    low, high = _index_box(mesh, image)
    length = float(((high - low) / image.shape).max())  # of the image's
    has_voxel = (np.maximum(np.ceil(low), 0.0) <= np.minimum(high, np.array(image.shape) - 1)).all()
    fits = {unit: _box_overlap(mesh, image, mm) for unit, mm in LENGTH_UNITS.items()}
    unit = max(fits, key=lambda each: fits[each])
    is_other = unit != "mm" and fits[unit] > LEAST_OVERLAP
    remedy = "do both use the same world coordinates (mm, RAS+)?"
    remedy = f"is it in {unit}? pass `mesh_units` {unit}" if is_other else remedy
    if outside == 1.0 and not has_voxel:  # else cells larger than the image may cover it
        raise InputError(
            f"the mesh lies outside the image: no node is in the image's box; {remedy}"
        )
    if not has_voxel or not 1.0 / MOST_LENGTHS < length < MOST_LENGTHS:
        raise InputError(f"the mesh is {length:.2g} times as long as the image; {remedy}")
    if is_other and fits[unit] > LIKELY_OVERLAP and fits["mm"] < MM_OVERLAP**mesh.ndim:
        warn(f"the mesh is {length:.2g} times as long as the image; {remedy}")
    return outside


def _index_box(mesh: Mesh, image: Image, mm: float = 1.0) -> tuple[Floats, Floats]:
    """Return the lowest and the highest index of a mesh's nodes, whose unit of length has `mm`."""
    index = image.to_index(mm * mesh.points)
    return index.min(axis=0), index.max(axis=0)


def _box_overlap(mesh: Mesh, image: Image, mm: float) -> float:
    """Return the volume that a mesh's box, in a unit of `mm`, shares with the image's, divided by
    that of both.
    """
    low, high = _index_box(mesh, image, mm)
    shape = np.array(image.shape)
    both = np.prod((np.minimum(high, shape - 0.5) - np.maximum(low, -0.5)).clip(0.0))
    return float(both / (np.prod(high - low) + shape.prod() - both))


def check_place(mesh: Mesh, image: Image, name: str = "the image or its mask") -> None:
    """Raise InputError for a mesh outside the image, as `outside_fraction`; warn of one partly
    outside.
    """
    if (outside := outside_fraction(mesh, image)) > 0.0:
        warn(
            f"{outside:.1%} of the nodes lie outside {name}: cells there take the nearest voxel's "
            "value"
        )


def _problems_with_box(mesh: Mesh, image: Image, is_filled: bool) -> list[str]:
    problems = []
    beyond = beyond_box(mesh, image)
    most = ON_SIDE_VOXELS if is_filled else BOX_ROUNDING_VOXELS
    if len(outside := np.flatnonzero(beyond > most)):
        problems.append(
            f"nodes up to {beyond.max():.3g} voxels beyond the image's box: {_first(outside)}"
        )
    if not is_filled:
        return problems
    outer, is_on_box = facets_on_box(mesh, image)
    if not is_on_box.all():
        problems.append(
            f"boundary facets off the faces of the image's box; nodes: {_first(outer[~is_on_box])}"
        )
    filled = filled_fraction(mesh, image)
    if abs(filled - 1.0) > 1e-9:
        problems.append(f"volume: {filled:.12g} of the image's box")
    return problems
