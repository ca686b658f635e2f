"""Matrix-free linear elasticity on a grid with one element per voxel.

The solver is conjugate gradients in double precision, preconditioned by a V-cycle of geometric multigrid in single
precision.

- Coarse grids fill the same box with half the voxels along an axis, rounded up, so that its sides, and the plates on
  two of them, stay in place; their voxels are larger accordingly, and nodes need not coincide. Axes whose voxels are
  twice as long as the shortest are not coarsened until the others have caught up. A coarse voxel has the mean modulus.
- Interpolation is linear along each axis, restriction its transpose.
- The smoother is a Chebyshev polynomial of the fourth kind (J. Lottes, Optimal polynomial smoothers for multigrid
  V-cycles, Numer. Linear Algebra Appl. 30, e2518, 2023) in D^-1 A, where D is the diagonal of A, in sheared grids up to
  the signs of the corners. It needs only the largest eigenvalue, which for any moduli is at most that of the element of
  modulus 1: sum x^T A_e x <= lambda sum x^T D_e x. Using the same polynomial before and after makes the cycle
  symmetric.
- The last grid has at most a hundred unknowns and is inverted.
"""

from __future__ import annotations

from itertools import product as combinations_of
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from tetopt.fem.elasticity import RESIDUAL_FRACTION, lame_constants
from tetopt.fem.voxel_kernels import (
    Terms,
    Transfer,
    add_product,
    advance,
    element_terms,
    product,
    prolong,
    restrict,
    smooth,
    transfer,
    turn,
)
from tetopt.geometry.box import upright_axis
from tetopt.image import Image

SMOOTHING_STEPS = 2  # products before the coarser grid, and as many after it
DENSE_UNKNOWNS = 100  # up to which a grid is the last one: few enough that LAPACK never uses several threads
ITERATION_LIMIT = 1000  # moduli over four orders of magnitude take a hundred
LONG_VOXEL = 2.0  # an axis with voxels this much longer than the shortest is not coarsened yet


class Grid(NamedTuple):
    """A box of voxels between two plates, the longest axis last; 2-D gets a middle axis of length 1."""

    young: NDArray[np.float64]  # (I, J, K) kPa
    jacobian: NDArray[np.float64]  # (n, n) index axes to mm, columns in the order of the axes
    nu: float
    plates: int  # axis of `young` across which the two plates lie
    order: tuple[int, ...]  # axis of the image for each axis

    @property
    def axes(self) -> list[int]:
        """Axes of `young` that are the image's."""
        return [0, 2] if len(self.order) == 2 else [0, 1, 2]

    def nodes(self) -> NDArray[np.float64]:
        """A field of zeros, (n, I + 1, J + 1, K + 1); its middle axis is 1 in 2-D."""
        n = len(self.order)
        return np.zeros((n, *(s + 1 if axis in self.axes else 1 for axis, s in enumerate(self.young.shape))))

    def in_image(self, u: NDArray) -> NDArray:
        """A field at nodes in the order of the image's axes, (*shape + 1, n); a view."""
        only = u if len(self.order) == 3 else u[:, :, 0]
        return np.moveaxis(only.transpose(0, *(1 + np.argsort(self.order))), 0, -1)

    def coarsened(self, shape: tuple[int, ...]) -> Grid:
        """The same box with fewer voxels, (I, J, K), and mean moduli."""
        ratio = (np.array(self.young.shape) / np.array(shape))[self.axes]
        return self._replace(young=block_means(self.young, shape), jacobian=self.jacobian * ratio)


class Level(NamedTuple):
    """One grid of the hierarchy; fields are (n, I + 1, J + 1, K + 1), the middle one 1 in 2-D."""

    young: NDArray[np.float32]
    terms: Terms  # of -A, so that a product subtracts A d from the residual
    weight: NDArray[np.float32]  # (I + 1, ...) 1 / sum of the moduli around each node, 0 on the plates
    scale: NDArray[np.float32]  # (n,) 1 / (the element's diagonal times the largest eigenvalue)
    ways: tuple[Transfer, ...]  # transfers to the next grid; empty for the last
    r: NDArray[np.float32]  # residual
    x: NDArray[np.float32]  # solution
    d: NDArray[np.float32]  # the last step


class Hierarchy(NamedTuple):
    """All grids of the preconditioner, from fine to coarse."""

    levels: list[Level]
    inverse: NDArray[np.float64]  # inverse for the last grid's free unknowns
    free: NDArray[np.int64]  # their places in its ravelled fields
    plates: int


class Work(NamedTuple):
    """Iterations and residual of a solution."""

    iterations: int
    residual: float  # relative to the load


def grid_of(modulus: Image, nu: float) -> Grid:
    """An image's voxels between plates on the two faces across its upright axis."""
    n, shape = modulus.ndim, modulus.shape
    last = int(np.argmax(shape))
    order = (*(axis for axis in range(n) if axis != last), last)
    young = np.ascontiguousarray(modulus.data.transpose(order), dtype=np.float64)
    own = [0, 1, 2] if n == 3 else [0, 2]
    plates = own[order.index(upright_axis(modulus.affine))]
    return Grid(young if n == 3 else young[:, None], modulus.affine[:n][:, list(order)], nu, plates, order)


def element_stiffness(jacobian: NDArray[np.float64], nu: float) -> NDArray[np.float64]:
    """Stiffness of one element of modulus 1 between its corners, (2^n, 2^n, n, n); corners as `product((0, 1), ...)`.

    `jacobian` (n, n) maps a voxel's index axes to mm. Gauss's rule with two points along each axis is exact here.
    """
    n = len(jacobian)
    corners = np.array(list(combinations_of((0, 1), repeat=n)))
    lame_1, mu = (float(constant[0]) for constant in lame_constants(np.ones(1), nu, n))
    size = abs(float(np.linalg.det(jacobian))) / 2**n  # volume of each Gauss point
    K = np.zeros((2**n, 2**n, n, n))
    for sign in combinations_of((-1.0, 1.0), repeat=n):
        at = 0.5 + np.array(sign) / np.sqrt(12.0)
        g = shape_gradients(at, corners) @ np.linalg.inv(jacobian)
        outer = np.einsum("ai,bj->abij", g, g)
        dot = np.einsum("ai,bi->ab", g, g)
        K += size * (lame_1 * outer + mu * outer.transpose(0, 1, 3, 2) + mu * dot[..., None, None] * np.eye(n))
    return K


def shape_gradients(at: NDArray[np.float64], corners: NDArray[np.int64]) -> NDArray[np.float64]:
    """Gradients of the n-linear hat functions at a point of the unit cube, (2^n, n), per unit of index."""
    factors = np.where(corners == 1, at, 1.0 - at)
    g = np.empty(corners.shape)
    for axis in range(len(at)):
        g[:, axis] = np.where(corners[:, axis] == 1, 1.0, -1.0) * np.delete(factors, axis, axis=1).prod(axis=1)
    return g


def stiffness_product(grid: Grid, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """The stiffness of the grid times a field of displacements, mN."""
    out = np.zeros_like(u)
    add_product(out, u, grid.young, element_terms(element_stiffness(grid.jacobian, grid.nu)))
    return out


def solve_voxels(grid: Grid, u: NDArray[np.float64], residual_fraction: float = RESIDUAL_FRACTION) -> Work:
    """Solve for the displacements `u` between the plates without forces; displacements of the plates stay fixed.

    Parameters
    ----------
    grid : Grid
        Moduli above 0.
    u : field of nodes
        mm, world, with the plates' displacements; values between them start the iteration. Overwritten.
    residual_fraction : float
        Target residual over load, where the load is the plates' force on the nodes next to them.

    Raises
    ------
    RuntimeError
        The residual stayed above ten times that, as it may if moduli differ by more than six orders of magnitude.
    """
    plates = grid.plates
    if grid.young.shape[plates] == 1:
        return Work(0, 0.0)
    alone = u.copy()
    np.moveaxis(alone, 1 + plates, 0)[1:-1] = 0.0
    load = _norm(_free(stiffness_product(grid, alone), plates))
    r = alone
    r[:] = -_free(stiffness_product(grid, u), plates)
    terms = element_terms(element_stiffness(grid.jacobian, grid.nu))
    hierarchy = multigrid_of(grid)
    p, q = np.zeros_like(u), np.empty_like(u)
    size, old, iterations = _norm(r), 1.0, 0
    while size > residual_fraction * load and iterations < ITERATION_LIMIT:
        z = preconditioned(hierarchy, r, size)
        now = product(r, z)
        turn(p, z, now / old if iterations else 0.0)
        old = now
        q[:] = 0.0
        add_product(q, p, grid.young, terms)
        _free(q, plates)
        size = np.sqrt(advance(u, r, p, q, now / product(p, q)))
        iterations += 1
    q[:] = 0.0
    add_product(q, u, grid.young, terms)
    residual = _norm(_free(q, plates))
    if not residual <= 10.0 * residual_fraction * load:
        raise RuntimeError(
            f"reference: not solved: the residual {residual:.3g} mN exceeds {10.0 * residual_fraction * load:.3g} mN"
        )
    return Work(iterations, residual / load)


def interpolated(u: NDArray[np.float64], coarse: Grid, fine: Grid) -> NDArray[np.float32]:
    """The displacements of a coarser grid at the nodes of a finer one, in single precision."""
    out, total = (fine.nodes().astype(np.float32) for _ in range(2))
    prolong(out, total, u.astype(np.float32), _ways(fine, coarse.young.shape))
    return out


def _ways(grid: Grid, shape: tuple[int, ...]) -> tuple[Transfer, ...]:
    """Transfers from a grid of that shape to `grid`."""
    pairs = enumerate(zip(grid.young.shape, shape, strict=True))
    return tuple(transfer(fine, coarse) if axis in grid.axes else transfer(0, 0) for axis, (fine, coarse) in pairs)


def multigrid_of(grid: Grid) -> Hierarchy:
    """The grids of the preconditioner, with moduli relative to the largest."""
    grid = grid._replace(young=grid.young / grid.young.max())
    levels: list[Level] = []
    while True:
        level = _level(grid)
        shape = coarser(grid)
        free = np.flatnonzero(np.broadcast_to(level.weight > 0.0, level.x.shape))
        if len(free) <= DENSE_UNKNOWNS or shape == grid.young.shape:
            return Hierarchy([*levels, level], _inverse(level, free), free, grid.plates)
        levels.append(level._replace(ways=_ways(grid, shape)))
        grid = grid.coarsened(shape)


def coarser(grid: Grid) -> tuple[int, ...]:
    """Voxels of the next grid: half along each axis whose voxels are not long, at least 2 between the plates."""
    shape = np.array(grid.young.shape)
    spacing = np.full(3, np.inf)
    spacing[grid.axes] = np.sqrt((grid.jacobian**2).sum(axis=0))
    can = shape > np.where(np.arange(3) == grid.plates, 2, 1)
    is_short = can & (spacing < LONG_VOXEL * spacing[can].min(initial=np.inf))
    return tuple(int(s) for s in np.where(is_short, (shape + 1) // 2, shape))


def block_means(data: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Means over the voxels of a coarser grid on the same box, with cut voxels weighted by their fraction."""
    for axis, (new, old) in enumerate(zip(shape, data.shape, strict=True)):
        if new != old:
            rows = np.moveaxis(data, axis, 0)
            means = _fractions(new, old) @ rows.reshape(old, -1)
            data = np.moveaxis(means.reshape(new, *rows.shape[1:]), 0, axis)
    return np.ascontiguousarray(data)


def _fractions(new: int, old: int) -> csr_array:
    """Fraction of each new voxel's length in each old one, (new, old)."""
    ends = np.union1d(np.arange(new + 1) * old / new, np.arange(old + 1.0))
    middle, length = 0.5 * (ends[1:] + ends[:-1]), np.diff(ends)
    row = np.minimum((middle * new / old).astype(np.int64), new - 1)
    return csr_array((length * new / old, (row, middle.astype(np.int64))), shape=(new, old))


def _level(grid: Grid) -> Level:
    n = len(grid.jacobian)
    element = element_stiffness(grid.jacobian, grid.nu)
    diagonal = np.einsum("aadd->d", element) / len(element)
    root = np.tile(np.sqrt(diagonal), len(element))
    matrix = element.transpose(0, 2, 1, 3).reshape(len(root), -1) / np.outer(root, root)
    terms = element_terms(element)
    zeros = grid.nodes()
    around = zeros[0].copy()
    for corner in combinations_of((0, 1), (0, 1) if n == 3 else (0,), (0, 1)):
        around[tuple(slice(c, c + s) for c, s in zip(corner, grid.young.shape, strict=True))] += grid.young
    weight = 1.0 / around
    np.moveaxis(weight, grid.plates, 0)[[0, -1]] = 0.0
    single = np.float32
    return Level(
        grid.young.astype(single), terms._replace(value=-terms.value.astype(single)), weight.astype(single),
        (1.0 / (diagonal * np.linalg.eigvalsh(matrix)[-1])).astype(single), (),
        *(zeros.astype(single) for _ in range(3)),
    )  # fmt: skip


def _inverse(level: Level, free: NDArray[np.int64]) -> NDArray[np.float64]:
    matrix = np.empty((len(free), len(free)))
    for column, place in enumerate(free):
        level.d[:], level.r[:] = 0.0, 0.0
        level.d.ravel()[place] = -1.0
        add_product(level.r, level.d, level.young, level.terms)
        matrix[column] = level.r.ravel()[free]
    return np.linalg.inv(0.5 * (matrix + matrix.T)).astype(np.float64)


def preconditioned(hierarchy: Hierarchy, residual: NDArray[np.float64], size: float) -> NDArray[np.float32]:
    """One V-cycle for the residual over its `size`, to stay in range of single precision; an array of the hierarchy."""
    finest = hierarchy.levels[0]
    np.divide(residual, size, out=finest.r, casting="unsafe")
    _cycle(hierarchy, 0)
    return finest.x


def _cycle(hierarchy: Hierarchy, depth: int) -> None:
    """Compute `x` of a level from its `r`, which is overwritten."""
    level = hierarchy.levels[depth]
    if depth == len(hierarchy.levels) - 1:
        level.x.ravel()[hierarchy.free] = (hierarchy.inverse * level.r.ravel()[hierarchy.free]).sum(axis=1)
        return
    level.x[:], level.d[:] = 0.0, 0.0
    for k in range(SMOOTHING_STEPS):
        smooth(level.d, level.x, level.r, level.weight, level.scale, chebyshev_factors(k))
        add_product(level.r, level.d, level.young, level.terms)
    below = hierarchy.levels[depth + 1]
    restrict(below.r, _free(level.r, hierarchy.plates), level.ways)
    _cycle(hierarchy, depth + 1)
    prolong(level.d, level.x, below.x, level.ways)
    for k in range(SMOOTHING_STEPS):
        add_product(level.r, level.d, level.young, level.terms)
        smooth(level.d, level.x, level.r, level.weight, level.scale, chebyshev_factors(k))


def chebyshev_factors(k: int) -> tuple[float, float]:
    """Factors of the last step and of D^-1 r / lambda in step k of Lottes' Algorithm 1, k from 0."""
    return (2.0 * k - 1.0) / (2.0 * k + 3.0) if k else 0.0, (8.0 * k + 4.0) / (2.0 * k + 3.0)


def _free(u: NDArray, plates: int) -> NDArray:
    """The same array, 0 on the plates."""
    np.moveaxis(u, 1 + plates, 0)[[0, -1]] = 0.0
    return u


def _norm(u: NDArray[np.float64]) -> float:
    return float(np.sqrt(product(u, u)))
