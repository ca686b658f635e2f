"""Matrix-free products with the stiffness of a grid of voxels, and the other kernels of a multigrid cycle.

All elements have the same shape, so that the stiffness is one element matrix times each voxel's modulus. Sums and
differences of the corners along each axis make that matrix sparse: the derivatives of the n-linear functions 1, x, y,
xy, ... about the voxel's centre are orthogonal unless they are equal. Of a hexahedron's 576 entries 45 remain if the
axes are at right angles, 167 otherwise.

Fields at nodes are (n, I, J, K), component by component, and moduli (I - 1, J - 1, K - 1); in 2-D the middle axis has
length 1 in both. Work proceeds row by row along the last axis. Slabs of planes are processed in two turns, in parallel
within each turn, and sums are taken plane by plane, so that results are the same on any number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from tetopt.energy.sampling import few_threads
from tetopt.system.kernel_cache import njit

CHUNK_VOXELS = 128  # of a row at a time: 48 such rows fit into the first-level cache
SLAB_PLANES = 4  # two slabs write to one plane in this many; more planes leave threads idle at the end
VOXELS_PER_TASK = 32  # for `few_threads`: a voxel takes about 20 ns, and waking a thread up to 1 ms if others run


class Terms(NamedTuple):
    """The entries of the element matrix of modulus 1 between modes; mode m of component d is row m n + d."""

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    value: NDArray[np.floating]


class Transfer(NamedTuple):
    """Linear interpolation along one axis, from coarse nodes to fine ones."""

    left: NDArray[np.int64]  # (fine + 1,) coarse node to the left of each fine node
    right: NDArray[np.int64]
    weight: NDArray[np.float32]  # weight of the right coarse node
    begin: NDArray[np.int64]  # range of fine nodes to which each coarse node contributes: begin to end
    end: NDArray[np.int64]


def element_terms(element: NDArray[np.float64]) -> Terms:
    """Entries of an element's stiffness (2^n, 2^n, n, n) between sums and differences of its corners."""
    n = element.shape[2]
    H = np.ones((1, 1))
    for _ in range(n):
        H = np.kron(H, np.array([[1.0, 1.0], [-1.0, 1.0]]))
    modes = np.einsum("ma,abij,kb->mikj", H, element, H).reshape(n * 2**n, -1) / 4.0**n
    row, column = np.nonzero(np.abs(modes) > 1e-13 * np.abs(modes).max())
    return Terms(row, column, modes[row, column])


def transfer(fine: int, coarse: int) -> Transfer:
    """Transfer between two numbers of voxels along the same side of the box; 0 stands for the axis missing in 2-D."""
    place = np.arange(fine + 1) * coarse / max(fine, 1)  # exact for whole numbers
    left = np.minimum(np.floor(place), max(coarse - 1, 0)).astype(np.int64)
    right = np.minimum(left + 1, coarse)
    weight = (place - left).astype(np.float32)
    index = np.arange(coarse + 1)
    return Transfer(left, right, weight, np.searchsorted(right, index), np.searchsorted(left, index, side="right"))


def add_product(out: NDArray, u: NDArray, young: NDArray, terms: Terms) -> None:
    """Add the stiffness times `u` to `out`, both (n, I, J, K), of the same dtype as `young` and the terms' values."""
    with few_threads(young.size // VOXELS_PER_TASK):
        _add_product(out, u, young, terms.row, terms.column, terms.value)


def product(a: NDArray, b: NDArray) -> float:
    """Inner product of two fields at nodes, in double precision."""
    with few_threads(a.size // VOXELS_PER_TASK):
        return float(_products(a, b).sum())


def smooth(d: NDArray, x: NDArray, r: NDArray, weight: NDArray, scale: NDArray, factors: tuple[float, float]) -> None:
    """One Chebyshev step: d becomes f_0 d + f_1 weight scale r, and is added to x; `weight` (I, J, K), `scale` (n,)."""
    with few_threads(weight.size // VOXELS_PER_TASK):
        _smooth(d, x, r, weight, scale, np.array(factors, dtype=d.dtype))


def restrict(coarse: NDArray, fine: NDArray, ways: tuple[Transfer, ...]) -> None:
    """Fill `coarse` with the transposed interpolation of `fine`; `ways` has a transfer for each of three axes."""
    i, j, k = ways
    with few_threads(fine[0].size // VOXELS_PER_TASK):
        _restrict(coarse, fine, i, j, k)


def prolong(d: NDArray, x: NDArray, coarse: NDArray, ways: tuple[Transfer, ...]) -> None:
    """Fill `d` with the interpolation of `coarse`, and add it to x."""
    i, j, k = ways
    with few_threads(d[0].size // VOXELS_PER_TASK):
        _prolong(d, x, coarse, i, j, k)


def advance(x: NDArray, r: NDArray, p: NDArray, q: NDArray, alpha: float) -> float:
    """Do a step of conjugate gradients: add alpha p to x, subtract alpha q from r; return the square of r's norm."""
    with few_threads(x.size // VOXELS_PER_TASK):
        return float(_advance(x, r, p, q, alpha).sum())


def turn(p: NDArray, z: NDArray, beta: float) -> None:
    """Set the next direction of conjugate gradients: p becomes z + beta p."""
    with few_threads(p.size // VOXELS_PER_TASK):
        _turn(p, z, beta)


# Kernels


@njit(cache=True, parallel=True)
def _add_product(out: NDArray, u: NDArray, young: NDArray, row: NDArray, column: NDArray, value: NDArray) -> None:
    n_slabs = (young.shape[0] + SLAB_PLANES - 1) // SLAB_PLANES
    # Slabs of a turn share no plane of nodes.
    for first in range(2):
        for slab in prange((n_slabs - first + 1) // 2):
            start = (2 * np.int64(slab) + first) * SLAB_PLANES
            _add_slab(out, u, young, row, column, value, start, min(start + SLAB_PLANES, young.shape[0]))


@njit(cache=True)
def _add_slab(
    out: NDArray, u: NDArray, young: NDArray, row: NDArray, column: NDArray, value: NDArray, start: int, end: int
) -> None:
    n = u.shape[0]
    chunk = min(CHUNK_VOXELS, young.shape[2])
    modes = np.empty((n * 2**n, chunk), u.dtype)
    forces = np.empty((n * 2**n, chunk), u.dtype)
    for i in range(start, end):
        for j in range(young.shape[1]):
            for k in range(0, young.shape[2], chunk):
                width = min(chunk, young.shape[2] - k)
                _modes(modes, u, i, j, k, width)
                forces[:, :width] = 0.0
                for t in range(len(row)):
                    _add_scaled(forces[row[t]], modes[column[t]], value[t], width)
                for m in range(len(forces)):
                    _multiply(forces[m], young[i, j, k : k + width], width)
                _add_forces(out, forces, i, j, k, width)


@njit(cache=True)
def _modes(modes: NDArray, u: NDArray, i: int, j: int, k: int, width: int) -> None:
    """Sums and differences of the corners of the voxels of a row, along the last axis first."""
    n = u.shape[0]
    for r in range(2 ** (n - 1)):
        for d in range(n):
            ends = u[d, i + (r >> (n - 2)), j + (r & (n - 2)), k : k + width + 1]
            total, change = modes[2 * r * n + d], modes[(2 * r + 1) * n + d]
            for q in range(width):
                total[q] = ends[q + 1] + ends[q]
                change[q] = ends[q + 1] - ends[q]
    for axis in range(1, n):
        for m in range(2**n):
            if not (m >> axis) & 1:
                for d in range(n):
                    a, b = modes[m * n + d], modes[(m + (1 << axis)) * n + d]
                    for q in range(width):
                        low = a[q]
                        a[q] = b[q] + low
                        b[q] = b[q] - low


@njit(cache=True)
def _add_forces(out: NDArray, forces: NDArray, i: int, j: int, k: int, width: int) -> None:
    """Add the transpose of `_modes` to the nodes; overwrites `forces`."""
    n = out.shape[0]
    for axis in range(1, n):
        for m in range(2**n):
            if not (m >> axis) & 1:
                for d in range(n):
                    a, b = forces[m * n + d], forces[(m + (1 << axis)) * n + d]
                    for q in range(width):
                        total = a[q]
                        a[q] = total - b[q]
                        b[q] = total + b[q]
    for r in range(2 ** (n - 1)):
        for d in range(n):
            ends = out[d, i + (r >> (n - 2)), j + (r & (n - 2)), k : k + width + 1]
            total, change = forces[2 * r * n + d], forces[(2 * r + 1) * n + d]
            for q in range(width):
                ends[q] += total[q] - change[q]
            _add_sum(ends[1:], total, change, width)


@njit(cache=True)
def _add_sum(out: NDArray, a: NDArray, b: NDArray, width: int) -> None:
    for q in range(width):
        out[q] += a[q] + b[q]


@njit(cache=True)
def _add_scaled(out: NDArray, a: NDArray, factor: float, width: int) -> None:
    for q in range(width):
        out[q] += factor * a[q]


@njit(cache=True)
def _multiply(out: NDArray, a: NDArray, width: int) -> None:
    for q in range(width):
        out[q] *= a[q]


@njit(cache=True, parallel=True)
def _products(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """Inner product of each plane."""
    sums = np.zeros(a.shape[1])
    for i in prange(a.shape[1]):
        lanes = np.zeros(a.shape[3])
        for d in range(a.shape[0]):
            for j in range(a.shape[2]):
                _add_squares(lanes, a[d, i, j], b[d, i, j])
        total = 0.0
        for k in range(len(lanes)):
            total += lanes[k]
        sums[i] = total
    return sums


@njit(cache=True)
def _add_squares(lanes: NDArray, a: NDArray, b: NDArray) -> None:
    for k in range(len(lanes)):
        lanes[k] += a[k] * np.float64(b[k])


@njit(cache=True, parallel=True)
def _advance(x: NDArray, r: NDArray, p: NDArray, q: NDArray, alpha: float) -> NDArray[np.float64]:
    sums = np.zeros(x.shape[1])
    for i in prange(x.shape[1]):
        lanes = np.zeros(x.shape[3])
        for d in range(x.shape[0]):
            for j in range(x.shape[2]):
                _add_scaled(x[d, i, j], p[d, i, j], alpha, len(lanes))
                _add_scaled(r[d, i, j], q[d, i, j], -alpha, len(lanes))
                _add_squares(lanes, r[d, i, j], r[d, i, j])
        total = 0.0
        for k in range(len(lanes)):
            total += lanes[k]
        sums[i] = total
    return sums


@njit(cache=True, parallel=True)
def _turn(p: NDArray, z: NDArray, beta: float) -> None:
    for i in prange(p.shape[1]):
        for d in range(p.shape[0]):
            for j in range(p.shape[2]):
                _scale_and_add(p[d, i, j], z[d, i, j], beta)


@njit(cache=True)
def _scale_and_add(p: NDArray, z: NDArray, beta: float) -> None:
    for k in range(len(p)):
        p[k] = z[k] + beta * p[k]


@njit(cache=True, parallel=True)
def _smooth(d: NDArray, x: NDArray, r: NDArray, weight: NDArray, scale: NDArray, factors: NDArray) -> None:
    for i in prange(d.shape[1]):
        for c in range(d.shape[0]):
            for j in range(d.shape[2]):
                _smooth_row(d[c, i, j], r[c, i, j], weight[i, j], factors[0], factors[1] * scale[c])
                _add_row(x[c, i, j], d[c, i, j])


@njit(cache=True)
def _smooth_row(d: NDArray, r: NDArray, weight: NDArray, old: float, new: float) -> None:
    for k in range(len(d)):
        d[k] = old * d[k] + new * weight[k] * r[k]


@njit(cache=True)
def _add_row(x: NDArray, d: NDArray) -> None:
    for k in range(len(x)):
        x[k] += d[k]


@njit(cache=True, parallel=True)
def _restrict(coarse: NDArray, fine: NDArray, along_i: Transfer, along_j: Transfer, along_k: Transfer) -> None:
    for i in prange(coarse.shape[1]):
        line = np.empty(fine.shape[3], fine.dtype)
        for d in range(coarse.shape[0]):
            for j in range(coarse.shape[2]):
                line[:] = 0.0
                for a in range(along_i.begin[i], along_i.end[i]):
                    for b in range(along_j.begin[j], along_j.end[j]):
                        part = _part(along_i, a, np.int64(i)) * _part(along_j, b, j)
                        _add_scaled(line, fine[d, a, b], part, len(line))
                row = coarse[d, i, j]
                row[:] = 0.0
                for k in range(len(line)):
                    row[along_k.left[k]] += (np.float32(1.0) - along_k.weight[k]) * line[k]
                    row[along_k.right[k]] += along_k.weight[k] * line[k]


@njit(cache=True)
def _part(way: Transfer, fine: int, coarse: int) -> np.float32:
    """The weight of a coarse node in a fine one."""
    part = np.float32(0.0)
    if way.left[fine] == coarse:
        part += np.float32(1.0) - way.weight[fine]
    if way.right[fine] == coarse:
        part += way.weight[fine]
    return part


@njit(cache=True, parallel=True)
def _prolong(d: NDArray, x: NDArray, coarse: NDArray, along_i: Transfer, along_j: Transfer, along_k: Transfer) -> None:
    for i in prange(d.shape[1]):
        line = np.empty(coarse.shape[3], d.dtype)
        for c in range(d.shape[0]):
            for j in range(d.shape[2]):
                line[:] = 0.0
                for a in range(along_i.left[i], along_i.right[i] + 1):
                    for b in range(along_j.left[j], along_j.right[j] + 1):
                        part = _part(along_i, np.int64(i), a) * _part(along_j, j, b)
                        _add_scaled(line, coarse[c, a, b], part, len(line))
                row = d[c, i, j]
                for k in range(len(row)):
                    w = along_k.weight[k]
                    row[k] = (np.float32(1.0) - w) * line[along_k.left[k]] + w * line[along_k.right[k]]
                _add_row(x[c, i, j], row)
