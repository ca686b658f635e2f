"""Linear elasticity on a grid with one n-linear element per voxel, assembled and solved as meshes
are.

Elements are hexahedra (quadrilaterals of plane stress in 2-D), parallelepipeds under the image's
affine. All have the same shape, so that the stiffness between a node and each of its neighbours is
a sum over the voxels around both, each with its modulus. Two faces of the grid are plates, whose
displacements are prescribed. Only the blocks between the other nodes are stored.
"""

from __future__ import annotations

from itertools import product as combinations_of

import numpy as np
from scipy.sparse import bsr_array, csr_array

from tetopt.fem.elasticity import System, lame_constants, on_one_blas_thread, solve_in_steps
from tetopt.fem.rigidity import rigid_modes
from tetopt.geometry.box import upright_axis
from tetopt.image import Image
from tetopt.system.arrays import Floats, Ints, Shape
from tetopt.system.budget import at_most, check_memory

DOF_BYTES = 4800.0  # of memory per dof; 4,750 were measured at 12,000, 4,400 at 300,000


def element_stiffness(jacobian: Floats, nu: float) -> Floats:
    """Stiffness of one element of modulus 1 between its corners, (2^n, 2^n, n, n); corners as
    `product((0, 1), ...)`.

    `jacobian` (n, n) maps a voxel's index axes to mm. Gauss's rule with two points along each axis
    is exact here.
    """
    n = len(jacobian)
    corners = np.array(_corners(n))
    lame_1, mu = (float(constant[0]) for constant in lame_constants(np.ones(1), nu, n))
    size = abs(float(np.linalg.det(jacobian))) / 2**n  # volume of each Gauss point
    K = np.zeros((2**n, 2**n, n, n))
    for sign in combinations_of((-1.0, 1.0), repeat=n):
        at = 0.5 + np.array(sign) / np.sqrt(12.0)
        g = shape_gradients(at, corners) @ np.linalg.inv(jacobian)
        outer = np.einsum("ai,bj->abij", g, g)
        dot = np.einsum("ai,bi->ab", g, g)
        K += size * (
            lame_1 * outer
            + mu * outer.transpose(0, 1, 3, 2)
            + mu * dot[..., None, None] * np.eye(n)
        )
    return K


def shape_gradients(at: Floats, corners: Ints) -> Floats:
    """Slopes of the n-linear hat functions at a point of the unit cube, (2^n, n), per unit of
    index.
    """
    factors = np.where(corners == 1, at, 1.0 - at)
    g = np.empty(corners.shape)
    for axis in range(len(at)):
        g[:, axis] = np.where(corners[:, axis] == 1, 1.0, -1.0) * np.delete(
            factors, axis, axis=1
        ).prod(axis=1)
    return g


def stiffness_product(modulus: Image, nu: float, u: Floats) -> Floats:
    """The stiffness of the grid times displacements of its nodes, (*shape + 1, n), mN."""
    n = modulus.ndim
    out = np.zeros_like(u)
    of_corners = [_of_voxels(corner, modulus.shape) for corner in _corners(n)]
    for at, blocks in zip(of_corners, element_stiffness(modulus.affine[:n, :n], nu), strict=True):
        force = sum(
            np.einsum("ij,...j->...i", block, u[to])
            for to, block in zip(of_corners, blocks, strict=True)
        )
        out[at] += modulus.data[..., None] * force
    return out


@on_one_blas_thread
def solve_between_plates(modulus: Image, nu: float, u: Floats) -> int:
    """Solve for the displacements between plates on the two faces across the upright axis, without
    forces.

    Return the number of iterations, 0 if the matrix was factorised.

    Parameters
    ----------
    modulus : Image
        Young's modulus of each voxel, kPa, above 0.
    nu : float
        Poisson's ratio.
    u : (*shape + 1, n) array
        mm, world, at the voxels' corners, with the plates' displacements; those between are
        overwritten.

    Raises
    ------
    InputError
        Too little memory.
    RuntimeError
        As for `tetopt.fem.elasticity.solve_system`.
    """
    what = f"reference: {u.size:.4g} degrees of freedom"
    check_memory(
        DOF_BYTES * u.size, what, lambda room: f"{at_most(room / DOF_BYTES)} (`reference_dofs`)"
    )
    n = modulus.ndim
    inside = _between_plates(modulus)
    u[inside] = 0.0
    load = -stiffness_product(modulus, nu, u)[inside].ravel()
    if len(load) == 0:
        return 0
    index = np.moveaxis(np.indices(u.shape[:-1]), 0, -1)[inside].reshape(-1, n).astype(np.float64)
    K = free_stiffness(modulus, nu)
    modes = rigid_modes(modulus.to_world(index))
    solution, n_steps = solve_in_steps(
        System(K, np.arange(len(load)), K, load, np.zeros(len(load)), modes, np.eye(n))
    )
    u[inside] = solution.reshape(u[inside].shape)
    return n_steps


def free_stiffness(modulus: Image, nu: float) -> csr_array:
    """Stiffness between the nodes that are not on the plates, numbered in C order."""
    n = modulus.ndim
    shape = modulus.shape
    corners = _corners(n)
    element = element_stiffness(modulus.affine[:n, :n], nu)
    steps = list(combinations_of((-1, 0, 1), repeat=n))  # from a node to its neighbours and itself
    inside = _between_plates(modulus)
    # of nodes, with one row more around them
    number = np.full([s + 3 for s in shape], -1, dtype=np.int32)
    free = number[(slice(1, -1),) * n][inside]
    free[:] = np.arange(free.size).reshape(free.shape)
    column = np.empty((free.size, len(steps)), dtype=np.int32)
    block = np.empty((free.size, len(steps), n, n))
    for k, step in enumerate(steps):
        neighbour = np.roll(number, [-d for d in step], range(n))
        column[:, k] = neighbour[(slice(1, -1),) * n][inside].ravel()
        of_step = np.zeros((*(s + 1 for s in shape), n, n))
        for a, corner in enumerate(corners):
            other = tuple(c + d for c, d in zip(corner, step, strict=True))
            if other in corners:
                of_step[_of_voxels(corner, shape)] += (
                    modulus.data[..., None, None] * element[a, corners.index(other)]
                )
        block[:, k] = of_step[inside].reshape(-1, n, n)
    is_there = column >= 0
    starts = np.concatenate([[0], np.cumsum(is_there.sum(axis=1))]).astype(np.int32)
    return bsr_array(
        (block[is_there], column[is_there], starts), shape=(n * free.size,) * 2
    ).tocsr()


def _corners(n: int) -> list[Shape]:
    """Corners of an element, 0 or 1 along each axis."""
    return list(combinations_of((0, 1), repeat=n))


def _of_voxels(corner: Shape, shape: Shape) -> tuple[slice, ...]:
    """Where the nodes are, among all, that are this corner of each voxel."""
    return tuple(slice(c, c + s) for c, s in zip(corner, shape, strict=True))


def _between_plates(modulus: Image) -> tuple[slice, ...]:
    """Where the nodes are, among all, that are not on the plates."""
    plates = upright_axis(modulus.affine)
    return tuple(slice(1, -1) if axis == plates else slice(None) for axis in range(modulus.ndim))
