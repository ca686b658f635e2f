"""The reference that meshes are judged by: the same compression on a grid with an element to every voxel.

Elements are n-linear (hexahedra; quadrilaterals of plane stress in 2-D), parallelepipeds under the image's affine, each
with its voxel's modulus. All have one shape, so one element matrix serves for all, times the modulus.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.sparse import bsr_array, csr_array

from tetopt.energy.sampling import cell_of_voxel
from tetopt.errors import InputError
from tetopt.fem.elasticity import System, lame_constants, push_of, solved, strains
from tetopt.fem.rigidity import rigid_modes
from tetopt.geometry.box import box_sides, is_on_sides, upright_axis
from tetopt.image import Image
from tetopt.mesh import Mesh

INTERFACE_BAND_VOXELS = 2.0  # how near to an interface the strain there is judged


class Reference(NamedTuple):
    """The compression of a grid of voxels; what `reference` returns."""

    modulus: Image  # kPa, the grid's elements
    nu: float
    strain_energy: float  # uJ (a mm of thickness in 2-D)
    u: NDArray[np.float64]  # (K, n) mm, at the voxels' centres, in the image's order
    u_homogeneous: NDArray[np.float64]  # (K, n) mm, of the same block with one modulus everywhere
    strain: NDArray[np.float64]  # (K, n, n), at the voxels' centres
    n_dofs: int


class Errors(NamedTuple):
    """How far a mesh's solution is from the reference's, each relative; 0 is best."""

    strain_energy: float  # |E_strain - E_ref| / E_ref
    displacement: float | None  # RMS of u - u_ref, over RMS of u_ref - u_homogeneous; None if those two are the same
    interface_strain: float | None  # RMS of the strain's error near interfaces, over RMS of the strain there


def reference(modulus: Image, nu: float, percent: float = 1.0) -> Reference:
    """Hold the box's top, push its bottom in, both bonded: `tetopt.study.paper.simulate` on the voxels.

    Parameters
    ----------
    modulus : Image
        Young's modulus of each voxel, kPa, above 0.
    nu : float
        Poisson's ratio, -1 < nu < 0.5. Near 0.5 these elements are too stiff, as linear tetrahedra are, less so.
    percent : float
        How far the bottom is pushed in, of the distance between the faces; see `push_of`.

    Raises
    ------
    InputError
        A modulus that is not above 0, or nu out of range.
    RuntimeError
        As `tetopt.fem.elasticity.solved`.
    """
    young = modulus.data.astype(np.float64)
    if not (np.isfinite(young) & (young > 0.0)).all():
        raise InputError(f"modulus: expected moduli above 0 kPa in every voxel, got down to {young.min():g}")
    if not -1.0 < nu < 0.5:
        raise InputError(f"nu: expected -1 < nu < 0.5, got {nu}")
    K, u = _compressed(modulus, young, nu, percent)
    homogeneous = _compressed(modulus, np.ones_like(young), nu, percent)[1]
    dofs = u.ravel()
    shape = tuple(s + 1 for s in modulus.shape)
    centre, slope = _at_centres(u.reshape(*shape, -1), modulus)
    strain = 0.5 * (slope + slope.transpose(0, 2, 1))
    even = _at_centres(homogeneous.reshape(*shape, -1), modulus)[0]
    return Reference(modulus, nu, 0.5 * float(dofs @ (K @ dofs)), centre, even, strain, len(dofs))


def compare(exact: Reference, mesh: Mesh, u: NDArray[np.float64], strain_energy: float, labels: ArrayLike) -> Errors:
    """Errors of a mesh's displacements `u` (N, n) and energy against the reference, over voxel centres in the mesh.

    Parameters
    ----------
    exact : Reference
    mesh, u, strain_energy
        As `tetopt.fem.elasticity.compression` solved it, with the same `nu` and push.
    labels : array of the image's shape
        Materials: an interface is where a voxel's neighbour has another one. Its strain is measured at voxel centres
        up to `INTERFACE_BAND_VOXELS` away; the error is None where there is no interface.

    Raises
    ------
    InputError
        A mesh without any voxel centre.
    """
    owner = cell_of_voxel(exact.modulus, mesh).ravel()
    inside = np.flatnonzero(owner >= 0)
    if len(inside) == 0:
        raise InputError("mesh: no voxel centre of the reference lies in it")
    ours = _interpolated(exact.modulus, mesh, u, owner, inside)
    scale = _rms(exact.u[inside] - exact.u_homogeneous[inside])
    is_homogeneous = scale <= 1e-7 * _rms(exact.u[inside])  # all that is left is the solver's own
    is_near = near_interface(np.asarray(labels)).ravel()[inside]
    strain_error = None
    if is_near.any():
        voxels = inside[is_near]
        strain_error = _rms(strains(mesh, u)[owner[voxels]] - exact.strain[voxels]) / _rms(exact.strain[voxels])
    energy_error = abs(strain_energy / exact.strain_energy - 1.0)
    return Errors(energy_error, None if is_homogeneous else _rms(ours - exact.u[inside]) / scale, strain_error)


def near_interface(labels: NDArray) -> NDArray[np.bool_]:
    """Voxels whose centre is within `INTERFACE_BAND_VOXELS` of a facet between two labels, distances in voxels."""
    around = ndimage.generate_binary_structure(labels.ndim, 1)  # a voxel and those that it shares a facet with
    is_edge = ndimage.minimum_filter(labels, footprint=around) != ndimage.maximum_filter(labels, footprint=around)
    if not is_edge.any():
        return is_edge
    # A voxel at an interface has its centre half a voxel away from it.
    return ndimage.distance_transform_edt(~is_edge) <= INTERFACE_BAND_VOXELS - 0.5


def averaged(image: Image, shape: tuple[int, ...]) -> Image:
    """The image on a coarser grid over the same box: each new voxel is the mean over it, cut voxels by their share.

    Raises
    ------
    InputError
        Another number of axes, or more voxels along an axis than the image has.
    """
    n = image.ndim
    if len(shape) != n or any(not 1 <= c <= s for c, s in zip(shape, image.shape, strict=False)):
        raise InputError(f"averaged: expected up to {image.shape} voxels, got {shape}")
    data = image.data.astype(np.float64)
    for axis, (new, old) in enumerate(zip(shape, image.shape, strict=True)):
        ends = np.linspace(0.0, old, new + 1)
        overlap = np.minimum(ends[1:, None], np.arange(1, old + 1)) - np.maximum(ends[:-1, None], np.arange(old))
        share = np.maximum(overlap, 0.0) * (new / old)
        data = np.moveaxis(np.tensordot(share, data, axes=(1, axis)), 0, axis)
    size = np.array(image.shape) / np.array(shape)
    wider = np.eye(n + 1)
    wider[:n, :n] = np.diag(size)
    wider[:n, n] = (size - 1.0) / 2.0
    return Image(data, image.affine @ wider)


def nearest(image: Image, grid: Image) -> Image:
    """The image's values at the centres of another grid over the same box, each from the voxel around it."""
    places = [
        np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.int64), old - 1)
        for new, old in zip(grid.shape, image.shape, strict=True)
    ]
    return Image(image.data[np.ix_(*places)], grid.affine)


def _compressed(
    image: Image, young: NDArray[np.float64], nu: float, percent: float
) -> tuple[csr_array, NDArray[np.float64]]:
    """The stiffness matrix and the displacement of every node, (N, n) mm."""
    n = image.ndim
    shape = tuple(s + 1 for s in image.shape)
    K = grid_stiffness(image, young, nu)
    index = np.stack(np.meshgrid(*(np.arange(s) - 0.5 for s in shape), indexing="ij"), axis=-1).reshape(-1, n)
    points = image.to_world(index)
    axis = upright_axis(image.affine)
    is_on = is_on_sides(index, box_sides(image.shape))[:, axis].T
    bottom, top = is_on if image.affine[n - 1, axis] > 0.0 else is_on[::-1]
    prescribed = np.zeros((len(points), n))
    prescribed[bottom] = push_of(image, percent)
    is_free = np.repeat(~(bottom | top), n)
    free = np.flatnonzero(is_free)
    rows = K[free]
    values = prescribed.ravel()
    system = System(K, free, rows[:, free], -(rows @ values), values, rigid_modes(points), np.eye(n))
    return K, solved(system)


def grid_stiffness(image: Image, young: NDArray[np.float64], nu: float) -> csr_array:
    """Stiffness of the grid of voxels, nodes at their corners in C order, dofs node by node, mN/mm."""
    n = image.ndim
    element = element_stiffness(image.affine[:n, :n], nu)
    corners = list(product((0, 1), repeat=n))
    offsets = list(product((-1, 0, 1), repeat=n))
    shape = tuple(s + 1 for s in image.shape)
    blocks = np.zeros((*shape, len(offsets), n, n))
    for a, corner in enumerate(corners):
        here = blocks[tuple(slice(c, c + s) for c, s in zip(corner, image.shape, strict=True))]
        for b, other in enumerate(corners):
            slot = offsets.index(tuple(o - c for o, c in zip(other, corner, strict=True)))
            here[..., slot, :, :] += young[..., None, None] * element[a, b]
    place = np.stack(np.meshgrid(*(np.arange(s) for s in shape), indexing="ij"), axis=-1).reshape(-1, 1, n)
    neighbour = place + np.array(offsets)
    exists = ((neighbour >= 0) & (neighbour < shape)).all(axis=2)
    column = np.ravel_multi_index(np.where(exists[..., None], neighbour, 0).reshape(-1, n).T, shape)
    start = np.concatenate([[0], np.cumsum(exists.sum(axis=1))])
    data = blocks.reshape(-1, len(offsets), n, n)[exists]
    columns = column.reshape(exists.shape)[exists]
    return bsr_array((data, columns, start), shape=(n * len(place),) * 2).tocsr()


def element_stiffness(jacobian: NDArray[np.float64], nu: float) -> NDArray[np.float64]:
    """Stiffness of one element of modulus 1 between its corners, (2^n, 2^n, n, n); corners as `product((0, 1), ...)`.

    `jacobian` (n, n) takes a voxel's index axes to mm. By Gauss's rule of two points along each axis, exact here.
    """
    n = len(jacobian)
    corners = np.array(list(product((0, 1), repeat=n)))
    lame_1, mu = (float(constant[0]) for constant in lame_constants(np.ones(1), nu, n))
    size = abs(float(np.linalg.det(jacobian))) / 2**n  # of each Gauss point's share
    K = np.zeros((2**n, 2**n, n, n))
    for sign in product((-1.0, 1.0), repeat=n):
        at = 0.5 + np.array(sign) / np.sqrt(12.0)
        g = _shape_gradients(at, corners) @ np.linalg.inv(jacobian)
        outer = np.einsum("ai,bj->abij", g, g)
        dot = np.einsum("ai,bi->ab", g, g)
        K += size * (lame_1 * outer + mu * outer.transpose(0, 1, 3, 2) + mu * dot[..., None, None] * np.eye(n))
    return K


def _shape_gradients(at: NDArray[np.float64], corners: NDArray[np.int64]) -> NDArray[np.float64]:
    """Gradients of the n-linear hat functions at a point of the unit cube, (2^n, n), per unit of index."""
    factors = np.where(corners == 1, at, 1.0 - at)
    g = np.empty(corners.shape)
    for axis in range(len(at)):
        g[:, axis] = np.where(corners[:, axis] == 1, 1.0, -1.0) * np.delete(factors, axis, axis=1).prod(axis=1)
    return g


def _at_centres(u: NDArray[np.float64], image: Image) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacement (K, n) and its gradient (K, n, n), du_i / dx_k, at the voxels' centres from nodes (*shape+1, n)."""
    n = image.ndim
    corners = np.array(list(product((0, 1), repeat=n)))
    gradients = _shape_gradients(np.full(n, 0.5), corners) @ np.linalg.inv(image.affine[:n, :n])
    value, slope = np.zeros((*image.shape, n)), np.zeros((*image.shape, n, n))
    for corner, g in zip(corners, gradients, strict=True):
        part = u[tuple(slice(c, c + s) for c, s in zip(corner, image.shape, strict=True))]
        value += part / 2**n
        slope += part[..., :, None] * g
    return value.reshape(-1, n), slope.reshape(-1, n, n)


def _interpolated(
    image: Image, mesh: Mesh, u: NDArray[np.float64], owner: NDArray[np.int64], voxels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """A mesh's displacements at the centres of voxels, (K, n), linear in each cell."""
    n = mesh.ndim
    centres = image.to_world(np.stack(np.unravel_index(voxels, image.shape), axis=1).astype(np.float64))
    corners = mesh.points[mesh.cells]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    cell = owner[voxels]
    weights = np.empty((len(voxels), n + 1))
    weights[:, 1:] = np.einsum("kij,kj->ki", np.linalg.inv(edges)[cell], centres - corners[cell, 0])
    weights[:, 0] = 1.0 - weights[:, 1:].sum(axis=1)
    return np.einsum("ka,kai->ki", weights, u[mesh.cells[cell]])


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt((values**2).sum() / len(values)))
