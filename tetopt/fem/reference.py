"""The reference for errors of meshes: the same compression on a grid with one element per voxel.

Elements are those of `tetopt.fem.hexahedra`, each with its voxel's modulus.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product as combinations_of
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.sparse import csr_array

from tetopt.contents.align import divide_voxels
from tetopt.energy.sampling import cell_of_voxel
from tetopt.errors import InputError
from tetopt.fem.elasticity import elements_of, order_of, push_of
from tetopt.fem.hexahedra import shape_gradients, solve_between_plates, stiffness_product
from tetopt.geometry.box import upright_axis
from tetopt.geometry.quadratic import shape_slopes, shape_values
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.on_image import places_in_cells
from tetopt.system.arrays import Bools, Floats, Ints, Shape

# ratio of successive voxel sizes tried for the grid, which misses the limit by less than 6 %
STEP_GROWTH = 1.02
INTERFACE_BAND_VOXELS = 2.0  # distance from an interface within which its strain is compared
# compared at a time, so that a volume of millions takes no more memory than its solution
VOXELS_AT_ONCE = 2**18


class OwnError(NamedTuple):
    """Relative differences of the solution at half the resolution from the reference's, as in
    `Errors`.

    If errors are proportional to the voxels' size, the reference's own error is about as large; if
    to its square, a third of it.
    """

    strain_energy: float
    displacement: float | None


class Reference(NamedTuple):
    """The compression of a grid of voxels; the result of `reference`."""

    modulus: Image  # kPa, of the grid's elements
    nu: float
    strain_energy: float  # uJ (per mm of thickness in 2-D)
    u: Floats  # (*shape + 1, n) mm, at the voxels' corners
    u_homogeneous: Floats  # the same for the block with one modulus everywhere
    own_error: OwnError
    n_iterations: int

    @property
    def n_dofs(self) -> int:
        """Number of displacements of all nodes, including prescribed ones."""
        return self.u.size


class Errors(NamedTuple):
    """Relative errors of a mesh's solution against the reference; 0 is best."""

    strain_energy: float  # |E_strain - E_ref| / E_ref
    # RMS of u - u_ref, over RMS of u_ref - u_homogeneous; None if these two are equal
    displacement: float | None
    # RMS of the strain's error near interfaces, over RMS of the strain there
    interface_strain: float | None


def reference(modulus: Image, nu: float, percent: float = 1.0) -> Reference:
    """Fix the box's top and push its bottom in, both bonded: `simulate` of scripts/paper on the
    voxels.

    Parameters
    ----------
    modulus : Image
        Young's modulus of each voxel, kPa, above 0.
    nu : float
        Poisson's ratio, -1 < nu < 0.5. Near 0.5 these elements are too stiff, although less so than
        linear tetrahedra.
    percent : float
        Displacement of the bottom, in per cent of the distance between the faces; see `push_of`.

    Raises
    ------
    InputError
        A modulus that is not above 0, or too little memory.
    RuntimeError
        As for `tetopt.fem.elasticity.solve_system`.
    """
    if not (modulus.data > 0.0).all():
        raise InputError(
            "modulus: expected values above 0 kPa in every voxel, got as low as "
            f"{modulus.data.min():g}"
        )
    push = push_of(modulus, percent)
    u, n_iterations = _compress_grid(modulus, nu, push)
    half = average_voxels(modulus, tuple(max(1, s // 2) for s in modulus.shape))
    u_half, _ = _compress_grid(half, nu, push)
    even = u
    if modulus.data.min() < modulus.data.max():
        even, _ = _compress_grid(Image(np.ones(modulus.shape), modulus.affine), nu, push)
    energy = _strain_energy(modulus, nu, u)
    half_energy = _strain_energy(half, nu, u_half)
    error, scale = (
        _squares(u - other) for other in (interpolate_nodes(u_half, modulus.shape), even)
    )
    is_homogeneous = scale <= 1e-14 * _squares(u)  # only the solver's error remains
    own = OwnError(
        abs(half_energy / energy - 1.0), None if is_homogeneous else float(np.sqrt(error / scale))
    )
    return Reference(modulus, nu, energy, u, even, own, n_iterations)


def _compress_grid(modulus: Image, nu: float, push: Floats) -> tuple[Floats, int]:
    """Displacements of the nodes with the bottom pushed in and the top fixed, and the number of
    iterations.
    """
    n = modulus.ndim
    axis = upright_axis(modulus.affine)
    u = np.zeros((*(s + 1 for s in modulus.shape), n))
    bottom = 0 if modulus.affine[n - 1, axis] > 0.0 else -1
    np.moveaxis(u, axis, 0)[bottom] = push
    return u, solve_between_plates(modulus, nu, u)


def _strain_energy(modulus: Image, nu: float, u: Floats) -> float:
    return 0.5 * float((u * stiffness_product(modulus, nu, u)).sum())


def interpolate_nodes(u: Floats, shape: Shape) -> Floats:
    """Displacements of a grid's nodes at the nodes of another grid of this shape over the same
    box.
    """
    factors = [(new + 1) / old for new, old in zip(shape, u.shape, strict=False)]
    return ndimage.zoom(u, [*factors, 1.0], order=1, mode="nearest")


def compare(
    exact: Reference, mesh: Mesh, u: Floats, strain_energy: float, labels: ArrayLike
) -> Errors:
    """Compare a mesh's displacements and energy with the reference, over voxel centres in the mesh.

    Parameters
    ----------
    exact : Reference
    mesh, u, strain_energy
        The solution from `tetopt.fem.elasticity.compression` with the same `nu` and push; `u` has a
        row for each node of order 1 or 2. Displacement and strain are those of the cell at each
        voxel's centre.
    labels : array of the image's shape
        Materials: an interface is where neighbouring voxels have different ones. Its strain is
        compared at voxel centres up to `INTERFACE_BAND_VOXELS` away; the error is None without
        interfaces.

    Raises
    ------
    InputError
        A mesh without voxel centres, or with curved cells, for which voxels are not located.
    """
    if mesh.midpoints is not None and order_of(mesh, u) == 2:
        raise InputError(
            "compare: expected straight edges, got a mesh with midpoints; solve Mesh(points, cells)"
        )
    owner = cell_of_voxel(exact.modulus, mesh).ravel()
    inside = np.flatnonzero(owner >= 0)
    if len(inside) == 0:
        raise InputError("mesh: no voxel centre of the reference lies inside the mesh")
    is_near = near_interface(np.asarray(labels)).ravel()
    elements = elements_of(mesh, order_of(mesh, u))
    order = order_of(mesh, u)
    error, scale, size, strain_error, strain_size = np.zeros(5)
    for begin in range(0, len(inside), VOXELS_AT_ONCE):
        voxels = inside[begin : begin + VOXELS_AT_ONCE]
        cell = owner[voxels]
        near = is_near[voxels]
        there, strain = at_centres(exact.modulus, exact.u, voxels)
        index = np.stack(np.unravel_index(voxels, exact.modulus.shape), axis=1)
        places = places_in_cells(mesh, cell, exact.modulus.to_world(index))
        of_cells = u[elements.cells[cell]]
        error += _squares(np.einsum("ka,kai->ki", shape_values(places, order), of_cells) - there)
        scale += _squares(there - at_centres(exact.modulus, exact.u_homogeneous, voxels)[0])
        size += _squares(there)
        slopes = shape_slopes(places[near], order)
        by_place = np.einsum("kai,kab->kib", of_cells[near], slopes)
        slope = by_place @ elements.gradients[cell[near]]
        own_strain = 0.5 * (slope + slope.transpose(0, 2, 1))
        strain_error += _squares(own_strain - strain[near])
        strain_size += _squares(strain[near])
    is_homogeneous = scale <= 1e-14 * size  # only the solver's error remains
    return Errors(
        abs(strain_energy / exact.strain_energy - 1.0),
        None if is_homogeneous else float(np.sqrt(error / scale)),
        float(np.sqrt(strain_error / strain_size)) if is_near[inside].any() else None,
    )


def at_centres(image: Image, u: Floats, voxels: Ints) -> tuple[Floats, Floats]:
    """Displacement (K, n) and strain (K, n, n) at the centres of voxels with these flat indices,
    from nodes' `u`.
    """
    n = image.ndim
    corners = np.array(list(combinations_of((0, 1), repeat=n)))
    gradients = shape_gradients(np.full(n, 0.5), corners) @ np.linalg.inv(image.affine[:n, :n])
    place = np.unravel_index(voxels, image.shape)
    value = np.zeros((len(voxels), n))
    slope = np.zeros((len(voxels), n, n))
    for corner, g in zip(corners, gradients, strict=True):
        part = u[tuple(axis + c for axis, c in zip(place, corner, strict=True))]
        value += part / 2**n
        slope += part[:, :, None] * g
    return value, 0.5 * (slope + slope.transpose(0, 2, 1))


def near_interface(labels: NDArray) -> Bools:
    """Mask of voxels whose centre is within `INTERFACE_BAND_VOXELS` voxels of a facet between
    two labels.
    """
    around = ndimage.generate_binary_structure(labels.ndim, 1)  # a voxel and its face neighbours
    is_edge = ndimage.minimum_filter(labels, footprint=around) != ndimage.maximum_filter(
        labels, footprint=around
    )
    if not is_edge.any():
        return is_edge
    # A voxel at an interface has its centre half a voxel away from it.
    return ndimage.distance_transform_edt(~is_edge) <= INTERFACE_BAND_VOXELS - 0.5


def average_voxels(image: Image, shape: Shape) -> Image:
    """The image on a coarser grid over the same box: means over new voxels, with cut voxels
    weighted by their fraction.

    `shape` has at most as many voxels along each axis as the image.
    """
    data = image.data.astype(np.float64)
    for axis, (new, old) in enumerate(zip(shape, image.shape, strict=True)):
        rows = np.moveaxis(data, axis, 0)
        means = _fractions(new, old) @ rows.reshape(old, -1)
        data = np.moveaxis(means.reshape(new, *rows.shape[1:]), 0, axis)
    n = image.ndim
    size = np.array(image.shape) / np.array(shape)
    scaling = np.diag([*size, 1.0])
    scaling[:n, n] = (size - 1.0) / 2.0
    return Image(data, image.affine @ scaling)


def _fractions(new: int, old: int) -> csr_array:
    """Fraction of each new voxel's length in each old one, (new, old)."""
    ends = np.union1d(np.arange(new + 1) * old / new, np.arange(old + 1.0))
    middle = 0.5 * (ends[1:] + ends[:-1])
    length = np.diff(ends)
    row = np.minimum((middle * new / old).astype(np.int64), new - 1)
    return csr_array((length * new / old, (row, middle.astype(np.int64))), shape=(new, old))


def reference_shape(shape: Sequence[int], spacing: Floats, dofs: int) -> Shape:
    """The finest grid of nearly cubic voxels over the image's box with at most `dofs`, no finer
    than the image.
    """
    n = len(shape)
    size = np.array(shape) * spacing
    step = spacing.min()
    while True:
        coarse = np.clip(np.rint(size / np.maximum(step, spacing)), 1, shape).astype(int)
        if n * np.prod(coarse + 1) <= dofs:
            return tuple(int(c) for c in coarse)
        step *= STEP_GROWTH


def refine_voxels(image: Image, shape: Shape) -> Image:
    """The same field on evenly divided voxels, about `shape` along the axes.

    All voxels have the same number of parts, so that means over parts of the box are those of the
    field. Values at the centres of another grid (`nearest`) use some voxels more often: MNI152 at 2
    mm, sampled at 1 mm, has a mean modulus that is 0.6 % too high, as large as the measured errors.
    """
    return divide_voxels(
        image,
        [max(int(np.rint(new / old)), 1) for new, old in zip(shape, image.shape, strict=True)],
    )


def nearest(image: Image, grid: Image) -> Image:
    """The image's values at the centres of another grid over the same box, each from the voxel
    that contains it.
    """
    places = [
        np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.int64), old - 1)
        for new, old in zip(grid.shape, image.shape, strict=True)
    ]
    return Image(image.data[np.ix_(*places)], grid.affine)


def _squares(values: Floats) -> float:
    return float((values**2).sum())
