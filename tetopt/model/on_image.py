"""Fields of a mesh on the voxels of an image, and an image moved by a displacement."""

from __future__ import annotations

from math import prod
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from tetopt.energy.sampling import cell_of_voxel, nearest_voxels, overlap_of
from tetopt.errors import InputError
from tetopt.geometry.quadratic import edge_ends, of_order, shape_slopes, shape_values
from tetopt.geometry.simplex import volume_gradients, volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.arrays import Floats, Ints, plain_array
from tetopt.system.slabs import over_slabs

# whose nodes' values are gathered: 30 numbers each for a vector field of order 2
EVALUATED_AT_ONCE = 1 << 16
PLACE_STEPS = 20  # at most, for a voxel's place in a curved cell; 3 to 5 are usual
# of a curved cell's edge: distance of a place from its voxel's centre at which steps end
PLACE_ROUNDING = 1e-12
FOLDED_MISS = 1e-6  # of an edge: farther off, the cell is folded there

At = Literal["cells", "nodes"]


def field_on_image(
    mesh: Mesh, values: ArrayLike, image: Image, *, at: At | None = None, outside: float = np.nan
) -> Floats:
    """Evaluate a field of a mesh, such as a displacement, at the voxel centres of an image.

    Each voxel belongs to one cell, exactly as in sampling (`cell_of_voxel`). It gets the value of
    that cell or, for values at nodes, what the shape functions of order 1 or 2 give at its centre.

    Parameters
    ----------
    mesh : Mesh
        mm. For values of order 2, cells are curved if the mesh has midpoints.
    values : (M, ...), (N, ...) or (N + E, ...) array of numbers
        One row per cell, per corner node, or per node of order 2, in the order of
        `tetopt.geometry.quadratic.quadratic` (as in the `point_data` of a `MeshFile` and in
        `Solution.u`).
    image : Image
        The voxels: any image in the mesh's world, also finer or coarser than the meshed one. Its
        intensities are not used.
    at : {"cells", "nodes"}, optional
        What the rows belong to; only needed if there are as many cells as nodes.
    outside : float
        Value of voxels outside the mesh.

    Returns
    -------
    (s_0, ..., s_{n-1}, ...) float64
        The image's axes, then those of a row. Vectors keep their axes, those of the world.

    Raises
    ------
    InputError
        No voxel lies in the mesh; another number of rows, or as many cells as nodes without `at`;
        values that are not numbers; a curved cell that is folded; or the reasons of
        `cell_of_voxel`.

    See Also
    --------
    warped_image : Move an image by a displacement.
    cell_moments : Means of an image's voxels over cells, the way back.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> height = tetopt.field_on_image(mesh, mesh.points[:, 2], image)
    >>> bool(np.allclose(height[5, 7], image.to_world(np.argwhere(image.data > -1))[:16, 2]))
    True
    """
    rows = plain_array("values", values)
    if at not in (None, "cells", "nodes"):
        raise InputError(f'at: expected "cells" or "nodes", got {at!r}')
    if rows.ndim == 0 or rows.dtype.kind not in "biuf":
        raise InputError(
            f"values: expected an array of numbers, got {rows.dtype} of shape {rows.shape}"
        )
    order = _order_of(mesh, len(rows), at)
    rows = rows.reshape(len(rows), -1).astype(np.float64)
    # Curved edges matter for order 2 alone: as in sampling, other fields are those of straight
    # cells.
    is_curved = order == 2 and mesh.midpoints is not None
    pieces, n_pieces = mesh.straight_pieces() if is_curved else (mesh, 1)
    owner = cell_of_voxel(image, pieces).ravel()
    if len(inside := np.flatnonzero(owner >= 0)) == 0:
        raise InputError(
            "image: no voxel centre is inside the mesh; do both use the same world coordinates?"
        )
    result = np.full((len(owner), rows.shape[1]), outside)
    if order == 0:
        result[inside] = rows[owner[inside]]
    else:
        nodes, cells = of_order(mesh.points, mesh.cells, order, mesh.midpoints)

        def fill(first: int, stop: int) -> None:
            part = inside[first:stop]
            own = owner[part] // n_pieces
            index = np.stack(np.unravel_index(part, image.shape), axis=1)
            places = _places(
                mesh, own, image.to_world(index), nodes[cells[own]] if is_curved else None
            )
            result[part] = np.einsum("ka,kac->kc", shape_values(places, order), rows[cells[own]])

        n_numbers = len(inside) * cells.shape[1] * rows.shape[1]
        over_slabs(fill, len(inside), n_numbers, 1 + len(inside) // EVALUATED_AT_ONCE)
    return result.reshape(*image.shape, *np.shape(values)[1:])


def _order_of(mesh: Mesh, n_rows: int, at: At | None) -> int:
    """The order of a field's nodes by its number of rows, or 0 for one of cells."""
    n_nodes = len(mesh.points)
    n_cells = len(mesh.cells)
    ends = edge_ends(mesh.cells).reshape(-1, 2)
    n_edges = len(np.unique(ends[:, 0] * n_nodes + ends[:, 1]))
    counts = [(0, "cells", n_cells), (1, "nodes", n_nodes), (2, "nodes", n_nodes + n_edges)]
    orders = [order for order, where, count in counts if count == n_rows and at in (None, where)]
    if not orders:
        kinds = (
            f"{n_cells} cells"
            if at == "cells"
            else f"{n_nodes} nodes or {n_nodes + n_edges} of order 2"
        )
        expected = kinds if at is not None else f"{n_cells} cells, {kinds}"
        raise InputError(f"values: expected a row for each of {expected}, got {n_rows}")
    if len(orders) > 1:
        raise InputError(
            f'values: the mesh has {n_rows} cells and as many nodes; pass at="cells" or at="nodes"'
        )
    return orders[0]


def places_in_cells(mesh: Mesh, own: Ints, world: Floats) -> Floats:
    """Return the barycentric places (K, n+1) of points (K, n), mm, in their straight cells (K,)."""
    corners = mesh.cells[own]
    slopes = volume_gradients(mesh.points, corners) / volumes(mesh.points, corners)[:, None, None]
    places = np.empty(corners.shape)
    places[:, 1:] = np.einsum("kad,kd->ka", slopes[:, 1:], world - mesh.points[corners[:, 0]])
    places[:, 0] = 1.0 - places[:, 1:].sum(axis=1)
    return places


def _places(
    mesh: Mesh,
    own: Ints,
    world: Floats,
    around: Floats | None,
) -> Floats:
    """Return `places_in_cells`, of cells with nodes (K, A, n) if curved."""
    places = places_in_cells(mesh, own, world)
    if around is None or len(own) == 0:
        return places
    edge = np.linalg.norm(around[:, 1] - around[:, 0], axis=1)
    for _ in range(PLACE_STEPS):
        missing = world - np.einsum("ka,kad->kd", shape_values(places, 2), around)
        miss = np.linalg.norm(missing, axis=1) / edge
        if miss.max() <= PLACE_ROUNDING:
            break
        by_place = np.einsum("kab,kad->kdb", shape_slopes(places, 2), around)
        step = np.linalg.solve(by_place[:, :, 1:] - by_place[:, :, :1], missing[..., None])[..., 0]
        places[:, 1:] += step
        places[:, 0] -= step.sum(axis=1)
    if not miss.max() <= FOLDED_MISS:
        raise InputError(
            f"mesh: curved cell {own[np.argmax(miss)]} is folded; straighten it, or mesh with "
            "order 1"
        )
    return places


def warped_image(
    mesh: Mesh,
    displacement: ArrayLike,
    image: Image,
    like: Image | None = None,
    *,
    is_nearest: bool = False,
    outside: float = 0.0,
) -> Image:
    """Move an image by a displacement of a mesh's nodes.

    Each voxel centre within the deformed mesh gets the image's value at the place that has moved
    there, if that lies in the image: linear between voxel centres.

    Parameters
    ----------
    mesh : Mesh
        The mesh before the displacement, mm.
    displacement : (N, n) or (N + E, n) array
        Displacement of the corner nodes, or of the nodes of order 2, mm, along the world's axes.
    image : Image
        The image to move.
    like : Image, optional
        The voxels of the result; those of `image` by default.
    is_nearest : bool
        Take the value of the nearest voxel, as for labels.
    outside : float
        Value of other voxels.

    Returns
    -------
    Image
        The moved image.

    Raises
    ------
    InputError
        Rows for other nodes or axes; a displacement that turns cells inside out; or the reasons of
        `field_on_image`.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> moved = tetopt.warped_image(mesh, np.full((len(mesh.points), 3), [8.0, 0.0, 0.0]), image)
    >>> bool(np.allclose(moved.data[2:], image.data[:-2]))
    True
    """
    for name, each in (("image", image), ("like", image if like is None else like)):
        if each.ndim != mesh.ndim:
            raise InputError(
                f"{name}: expected a {mesh.ndim}-D image like the mesh, got a {each.ndim}-D one"
            )
    if not np.isfinite(outside):
        raise InputError(f"outside: expected a finite number in a moved image, got {outside}")
    u = plain_array("displacement", displacement).astype(np.float64)
    like = image if like is None else like
    n_nodes = len(mesh.points)
    if u.ndim != 2 or u.shape[1] != mesh.ndim:
        raise InputError(
            f"displacement: expected {mesh.ndim} numbers for each node, got an array of shape "
            f"{u.shape}"
        )
    order = _order_of(mesh, len(u), "nodes")
    before = of_order(mesh.points, mesh.cells, order, mesh.midpoints)[0]
    after = before + u
    try:
        moved = Mesh(after[:n_nodes], mesh.cells, after[n_nodes:] if order == 2 else None)
    except InputError as error:
        raise InputError(f"displacement: the deformed mesh is no mesh: {error}") from error
    if (overlap := overlap_of(like, moved.straight_pieces()[0])) is not None:
        raise InputError(f"displacement: in the deformed mesh {overlap}")
    places = field_on_image(moved, before, like, at="nodes").reshape(-1, mesh.ndim)
    inside = np.flatnonzero(np.isfinite(places[:, 0]))
    index = image.to_index(places[inside])
    is_there = ((index >= -0.5) & (index <= np.array(image.shape) - 0.5)).all(axis=1)
    inside = inside[is_there]
    index = index[is_there]
    if len(inside) == 0:
        raise InputError(
            "image: no voxel of it is inside the mesh; do both use the same world coordinates?"
        )
    values = np.full(prod(like.shape), outside)
    if is_nearest:
        values[inside] = image.data[tuple(nearest_voxels(image, places[inside]).T)]
    else:
        values[inside] = scipy.ndimage.map_coordinates(
            image.data, index.T, np.float64, order=1, mode="nearest"
        )
    return Image(values.reshape(like.shape), like.affine)
