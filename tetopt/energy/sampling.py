"""From voxels to cells: which voxel centre lies in which cell, and the sums of h over each cell.

The contract: every voxel centre inside the mesh belongs to *exactly one* cell. Rounding cannot break it, because
nothing here rounds. Nodes are taken to voxel-index space and put on a fixed-point grid of 2**-bits voxels
(`to_ticks`; about 1e-6 voxel for a brain), so the side of a face on which a voxel centre lies is the sign of an
integer. A centre exactly on a face, edge or node goes to the cell that would hold it if it were shifted by
(eps^3, eps^2, eps) along the axes, eps infinitely small: one rule for all cells (simulation of simplicity,
Edelsbrunner and Muecke 1990), under which no centre ever lies on a face.

Cells are filled by scanlines along the last axis: on a row of voxels each face bounds the cell at one threshold,
a convex cell is therefore one run [low, high) of the row, and two cells that share a face share its threshold.
The threshold is found in float64 and settled in integers where the float comes too close to a voxel centre.

Triangles go through the same code as prisms one voxel thick: a leading axis with the single index 0 is added.
"""

from __future__ import annotations

from math import ceil, log2
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.mesh import Mesh

CHUNK = 64  # cells a parallel task takes at once; it owns the scratch they share


class CellMoments(NamedTuple):
    """What each cell holds of the image, one row a cell."""

    n_voxels: NDArray[np.int64]  # (M,) voxel centres inside
    mean: NDArray[np.float64]  # (M,) of h; in a cell without voxel centre, h at the centroid
    variance: NDArray[np.float64]  # (M,) of h around the mean, divided by n_voxels; 0 without voxel centre


def cell_moments(image: Image, mesh: Mesh) -> CellMoments:
    """Count, mean and variance of the voxels whose centres lie in each cell.

    The mean is the single value that stands for the cell in a finite-element model (Eq. 2). A cell smaller than
    a voxel may hold no voxel centre: its mean is h at the centroid (the nearest voxel's value) and its variance 0.

    Raises
    ------
    InputError
        Mesh and image of different dimension, a cell that is flat or inverted at the sampling's resolution, or
        a mesh far larger than the image.
    """
    grid = sampling_grid(image, mesh.points)
    ticks = to_ticks(image.to_index(mesh.points), grid)
    check_orientations(image, ticks, mesh.cells)
    sums = moment_sums(grid, ticks, mesh.cells)
    n_voxels = sums[:, 0].astype(np.int64)
    is_empty = n_voxels == 0
    share = 1.0 / np.maximum(sums[:, 0], 1.0)
    mean = grid.shift + sums[:, 1] * share
    variance = np.maximum(sums[:, 2] * share - (sums[:, 1] * share) ** 2, 0.0)
    mean[is_empty] = nearest_values(image, mesh.points[mesh.cells[is_empty]].mean(axis=1))
    return CellMoments(n_voxels, mean, variance)


def cell_of_voxel(image: Image, mesh: Mesh) -> NDArray[np.int64]:
    """Number of the cell that holds each voxel centre, int64 of the image's shape; -1 outside of the mesh.

    Raises
    ------
    InputError
        As `cell_moments`.
    """
    grid = sampling_grid(image, mesh.points)
    ticks = to_ticks(image.to_index(mesh.points), grid)
    check_orientations(image, ticks, mesh.cells)
    owner = np.full(grid.volume.shape, -1, dtype=np.int64)
    _paint_cells(owner, ticks, mesh.cells, grid.bits)
    return owner.reshape(image.shape)


def nearest_values(image: Image, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Value of the voxel nearest to each world point, (K,) float64; points outside take the border's."""
    index = np.rint(image.to_index(points)).astype(np.int64)
    index = np.clip(index, 0, np.array(image.shape) - 1)
    return image.data[tuple(index.T)].astype(np.float64)


class SamplingGrid(NamedTuple):
    """An image made ready for the kernels."""

    volume: NDArray[np.floating]  # (s_0, s_1, s_2); s_0 = 1 for a 2-D image
    bits: int  # node coordinates are integers in units of 2**-bits voxel
    shift: float  # taken off h before it is squared, so that sums of squares lose no digits


def sampling_grid(image: Image, points: NDArray[np.float64]) -> SamplingGrid:
    """The image and the fixed-point grid for nodes near `points`, (N, n) world mm.

    Differences of coordinates stay below 2**29 units, so that their products, areas and determinants are exact
    in 64- and 128-bit integers.

    Raises
    ------
    InputError
        Mesh and image differ in dimension, or the mesh reaches more than 2**20 voxels.
    """
    if points.shape[1] != image.ndim:
        raise InputError(
            f"mesh and image: expected the same dimension, got a {points.shape[1]}-D mesh and a {image.ndim}-D image"
        )
    index = image.to_index(points)
    reach = max(float(np.abs(index).max()), float(max(image.shape))) + 1.0
    bits = 28 - ceil(log2(reach))
    if bits < 8:
        raise InputError(
            f"mesh and image: the mesh reaches {reach:.3g} voxels from the image's origin; are both in the same mm?"
        )
    shape = (1,) * (3 - image.ndim) + image.shape
    return SamplingGrid(image.data.reshape(shape), bits, float(np.mean(image.data, dtype=np.float64)))


def to_ticks(index: NDArray[np.float64], grid: SamplingGrid) -> NDArray[np.int64]:
    """Fixed-point coordinates, (N, 3) int64, of index coordinates (N, n); 2-D gets a leading 0."""
    ticks = np.zeros((len(index), 3), dtype=np.int64)
    ticks[:, 3 - index.shape[1] :] = np.rint(index * 2.0**grid.bits).astype(np.int64)
    return ticks


def from_ticks(ticks: NDArray[np.int64], grid: SamplingGrid, n: int) -> NDArray[np.float64]:
    """Index coordinates, (N, n) float64, of fixed-point ones (N, 3); exact."""
    return ticks[:, 3 - n :].astype(np.float64) * 2.0**-grid.bits


def check_orientations(image: Image, ticks: NDArray[np.int64], cells: NDArray[np.int64]) -> None:
    """InputError unless every cell, positive in the world, is so on the fixed-point grid too."""
    hand = 1 if np.linalg.det(image.affine[:-1, :-1]) > 0 else -1
    wrong = np.flatnonzero(orientations(ticks, cells) != hand)
    if len(wrong):
        raise InputError(
            f"mesh: {len(wrong)} cells are flat or inverted to within a millionth of a voxel, the first are "
            f"{wrong[:5].tolist()}; remove or mend them before sampling"
        )


def orientations(ticks: NDArray[np.int64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sign of each cell's volume in index space, (M,) int64 in {-1, 0, 1}; exact."""
    return _orientations(ticks, np.ascontiguousarray(cells, dtype=np.int64))


def moment_sums(grid: SamplingGrid, ticks: NDArray[np.int64], cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Voxel count, sum of (h - shift) and sum of its square over each cell, (M, 3) float64.

    They add up: the sums of a set of cells are the sum of their rows. Counts are whole numbers, exact.
    """
    sums = np.empty((len(cells), 3))
    _fill_moment_sums(sums, grid.volume, ticks, np.ascontiguousarray(cells, dtype=np.int64), grid.bits, grid.shift)
    return sums


# Kernels. A cell's scratch is `corner` (4, 3) int64, its nodes in ticks; `normal` (4, 3) int64, an inward normal a
# face; `plane` (4, 3) float64, where the faces cut a row, as value and two slopes; `box` (3, 2) int64, the voxels
# it may hold; `order` (6,) int64, the faces that bound a row from below, from above, and those parallel to rows:
# order[0] of the first kind, order[1] of the first two, then their numbers, which also are the rows of `plane`.


@njit(cache=True)
def _dot_sign(normal: NDArray, face: int, d0: int, d1: int, d2: int) -> int:
    """Exact sign of normal . d, with |normal| < 2**60 and |d| < 2**30: the products need up to 90 bits.

    Each normal is cut into a high part and 30 low bits, and the two dot products are added with carry.
    """
    n0, n1, n2 = normal[face, 0], normal[face, 1], normal[face, 2]
    mask = (1 << 30) - 1
    low = (n0 & mask) * d0 + (n1 & mask) * d1 + (n2 & mask) * d2
    high = (n0 >> 30) * d0 + (n1 >> 30) * d1 + (n2 >> 30) * d2 + (low >> 30)
    if high > 0:
        return 1
    if high < 0:
        return -1
    return 1 if (low & mask) > 0 else 0


@njit(cache=True)
def _face_normal(normal: NDArray, face: int, corner: NDArray, n_corners: int) -> int:
    """Fill in the normal of the face opposite corner `face`, towards that corner; 0 if the cell is flat, else 1."""
    opposite = face
    if n_corners == 4:
        a, b, c = (face + 1) & 3, (face + 2) & 3, (face + 3) & 3
        e0 = corner[b, 0] - corner[a, 0]
        e1 = corner[b, 1] - corner[a, 1]
        e2 = corner[b, 2] - corner[a, 2]
        f0 = corner[c, 0] - corner[a, 0]
        f1 = corner[c, 1] - corner[a, 1]
        f2 = corner[c, 2] - corner[a, 2]
        normal[face, 0] = e1 * f2 - e2 * f1
        normal[face, 1] = e2 * f0 - e0 * f2
        normal[face, 2] = e0 * f1 - e1 * f0
    else:
        a, b = (face + 1) % 3, (face + 2) % 3
        normal[face, 0] = 0
        normal[face, 1] = corner[b, 2] - corner[a, 2]
        normal[face, 2] = corner[a, 1] - corner[b, 1]
    side = _dot_sign(
        normal,
        face,
        corner[opposite, 0] - corner[a, 0],
        corner[opposite, 1] - corner[a, 1],
        corner[opposite, 2] - corner[a, 2],
    )
    if side < 0:
        for d in range(3):
            normal[face, d] = -normal[face, d]
    return abs(side)


@njit(cache=True)
def cell_orientation(corner: NDArray, normal: NDArray, n_corners: int) -> int:
    """Sign of the volume of the cell in `corner`, in index space; uses row 0 of `normal`; exact."""
    if n_corners == 4:
        e0 = corner[1, 0] - corner[0, 0]
        e1 = corner[1, 1] - corner[0, 1]
        e2 = corner[1, 2] - corner[0, 2]
        f0 = corner[2, 0] - corner[0, 0]
        f1 = corner[2, 1] - corner[0, 1]
        f2 = corner[2, 2] - corner[0, 2]
        normal[0, 0] = e1 * f2 - e2 * f1
        normal[0, 1] = e2 * f0 - e0 * f2
        normal[0, 2] = e0 * f1 - e1 * f0
        return _dot_sign(
            normal,
            0,
            corner[3, 0] - corner[0, 0],
            corner[3, 1] - corner[0, 1],
            corner[3, 2] - corner[0, 2],
        )
    normal[0, 0] = 0
    normal[0, 1] = -(corner[1, 2] - corner[0, 2])
    normal[0, 2] = corner[1, 1] - corner[0, 1]
    return _dot_sign(normal, 0, 0, corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2])


@njit(cache=True)
def _is_past(normal: NDArray, face: int, corner: NDArray, a: int, bits: int, i: int, j: int, k: int) -> bool:
    """Whether voxel (i, j, k) is on or above the face, as seen along the row; exact."""
    side = _dot_sign(normal, face, (i << bits) - corner[a, 0], (j << bits) - corner[a, 1], (k << bits) - corner[a, 2])
    return side >= 0 if normal[face, 2] > 0 else side <= 0


@njit(cache=True)
def _exact_threshold(
    cut: float, error: float, normal: NDArray, face: int, corner: NDArray, a: int, bits: int, i: int, j: int,
    low: int, high: int,
) -> Any:  # fmt: skip
    """The first voxel in [low, high] of row (i, j) on or above the face; `cut` is where it is, give or take `error`."""
    if error < 0.25:
        if cut < low - 0.5:
            return low
        if cut > high + 0.5:
            return high
        nearest = np.int64(np.rint(cut))
        if abs(cut - nearest) <= error:
            threshold = nearest if _is_past(normal, face, corner, a, bits, i, j, nearest) else nearest + 1
        else:
            threshold = np.int64(np.ceil(cut))
        return min(max(threshold, low), high)
    while low < high:  # a face nearly parallel to the row: bisect
        middle = (low + high) >> 1
        if _is_past(normal, face, corner, a, bits, i, j, middle):
            high = middle
        else:
            low = middle + 1
    return low


@njit(cache=True)
def _prepare_cell(
    corner: NDArray, n_corners: int, bits: int, shape: tuple, normal: NDArray, plane: NDArray, box: NDArray,
    order: NDArray,
) -> float:  # fmt: skip
    """Fill the scratch for the cell in `corner`; the error bound of its cuts, or -1 if it can hold no voxel."""
    for d in range(3):
        low, high = corner[0, d], corner[0, d]
        for k in range(1, n_corners):
            low, high = min(low, corner[k, d]), max(high, corner[k, d])
        box[d, 0] = max(-((-low) >> bits), 0)
        box[d, 1] = min((high >> bits) + 1, shape[d])
        if box[d, 0] >= box[d, 1]:
            return -1.0
    scale = 2.0**-bits
    error = 0.0
    n_low, n_parallel = 0, 0
    for face in range(n_corners):
        if _face_normal(normal, face, corner, n_corners) == 0:
            return -1.0
        n_low += normal[face, 2] > 0
        n_parallel += normal[face, 2] == 0
    order[0] = n_low
    order[1] = n_corners - n_parallel
    at_low, at_high, at_parallel = 0, n_low, n_corners - n_parallel
    for face in range(n_corners):
        a = (face + 1) % n_corners
        a0, a1, a2 = corner[a, 0] * scale, corner[a, 1] * scale, corner[a, 2] * scale
        if normal[face, 2] == 0:
            row = at_parallel
            at_parallel += 1
            size = max(abs(normal[face, 0]), abs(normal[face, 1]))
            slope0, slope1, a2 = normal[face, 0] / size, normal[face, 1] / size, 0.0
        else:
            if normal[face, 2] > 0:
                row = at_low
                at_low += 1
            else:
                row = at_high
                at_high += 1
            slope0 = -(normal[face, 0] / normal[face, 2])
            slope1 = -(normal[face, 1] / normal[face, 2])
        order[2 + row] = face
        # The face cuts row (i, j) at a2 + slope0 (i - a0) + slope1 (j - a1); a parallel face has it on its inner
        # side where the same sum is positive. The rounding error of the sum is under 8 eps of its terms' absolute
        # sum; the bound kept is more than twice that.
        plane[row, 0] = a2 - slope0 * a0 - slope1 * a1
        plane[row, 1] = slope0
        plane[row, 2] = slope1
        size = abs(a2) + abs(slope0) * (abs(a0) + box[0, 1]) + abs(slope1) * (abs(a1) + box[1, 1])
        error = max(error, 4e-15 * (size + 1.0))
    return error


@njit(cache=True)
def _row_range(corner: NDArray, n_corners: int, bits: int, i: int, low: int, high: int) -> tuple:
    """Rows [low, high) that the cell can meet in the slice i, narrowed from its box by its edges; never too few.

    Half of the rows of a tetrahedron's box miss it; leaving them out took a sixth off a sweep of the descent.
    """
    if n_corners == 3:
        return low, high
    level = i << bits
    least, most = np.inf, -np.inf
    for a in range(3):
        for b in range(a + 1, 4):
            p, q = corner[a, 0], corner[b, 0]
            if (p <= level) != (q <= level):
                at = corner[a, 1] + (corner[b, 1] - corner[a, 1]) * ((level - p) / (q - p))
                least, most = min(least, at), max(most, at)
    if least > most:  # the slice only touches a corner
        return low, high
    scale = 2.0**-bits
    return max(low, np.int64(np.floor(least * scale - 1e-6))), min(high, np.int64(np.ceil(most * scale + 1e-6)) + 1)


@njit(cache=True)
def _float_run(
    plane: NDArray,
    n_low: int,
    n_cut: int,
    n_faces: int,
    error: float,
    low: float,
    high: float,
    i: int,
    j: int,
) -> tuple:
    """The run [first, last) of row (i, j) as floats settle it; last < first where they cannot.

    Kept to one array and scalars so that it is inlined: with all the scratch passed, a call cost 40 ns a row,
    more than the row's voxels.
    """
    for row in range(n_cut, n_faces):
        side = plane[row, 0] + plane[row, 1] * i + plane[row, 2] * j
        if side < -error:
            return 0, 0
        if side <= error:
            return 0, -1
    # The greatest lower and the least upper cut bound the run.
    for row in range(n_low):
        low = max(low, plane[row, 0] + plane[row, 1] * i + plane[row, 2] * j)
    for row in range(n_low, n_cut):
        high = min(high, plane[row, 0] + plane[row, 1] * i + plane[row, 2] * j)
    if low > high + 2.0 * error:
        return 0, 0
    first, last = np.ceil(low), np.ceil(high)
    up, down = first - low, last - high
    if up > error and up < 1.0 - error and down > error and down < 1.0 - error:
        return np.int64(first), np.int64(last)
    return 0, -1


@njit(cache=True)
def _exact_run(
    corner: NDArray, n_corners: int, bits: int, normal: NDArray, plane: NDArray, box: NDArray, order: NDArray,
    error: float, i: int, j: int,
) -> tuple:  # fmt: skip
    """The run [low, high) of voxels of row (i, j) whose centres lie in the prepared cell, settled in integers."""
    low, high = box[2, 0], box[2, 1]
    for row in range(n_corners):
        face = order[2 + row]
        a = (face + 1) % n_corners
        if row >= order[1]:  # parallel to the row, all of which is on one side
            side = _dot_sign(normal, face, (i << bits) - corner[a, 0], (j << bits) - corner[a, 1], 0)
            if side == 0:
                side = normal[face, 1] if normal[face, 1] != 0 else normal[face, 0]
            if side < 0:
                return 0, 0
            continue
        cut = plane[row, 0] + plane[row, 1] * i + plane[row, 2] * j
        threshold = _exact_threshold(cut, error, normal, face, corner, a, bits, i, j, box[2, 0], box[2, 1])
        if row < order[0]:
            low = max(low, threshold)
        else:
            high = min(high, threshold)
    return low, max(low, high)


@njit(cache=True)
def sum_cell(
    sums: NDArray,
    volume: NDArray,
    shift: float,
    corner: NDArray,
    n_corners: int,
    bits: int,
    normal: NDArray,
    plane: NDArray,
    box: NDArray,
    order: NDArray,
) -> None:
    """Write count, sum and sum of squares of h - shift over the cell in `corner` into `sums` (3,)."""
    count = 0
    first = 0.0
    second = 0.0
    error = _prepare_cell(corner, n_corners, bits, volume.shape, normal, plane, box, order)
    if error >= 0.0:
        least, most = (
            box[2, 0] - 0.5,
            box[2, 1] - 0.5,
        )  # halves, so that the box itself is never too close to call
        for i in range(box[0, 0], box[0, 1]):
            first_row, last_row = _row_range(corner, n_corners, bits, i, box[1, 0], box[1, 1])
            for j in range(first_row, last_row):
                low, high = _float_run(plane, order[0], order[1], n_corners, error, least, most, i, j)
                if high < low:
                    low, high = _exact_run(corner, n_corners, bits, normal, plane, box, order, error, i, j)
                for k in range(low, high):
                    h = volume[i, j, k] - shift
                    first += h
                    second += h * h
                count += high - low
    sums[0] = count
    sums[1] = first
    sums[2] = second


@njit(cache=True, parallel=True)
def _fill_moment_sums(sums: NDArray, volume: NDArray, ticks: NDArray, cells: NDArray, bits: int, shift: float) -> None:
    n_corners = cells.shape[1]
    n_chunks = (len(cells) + CHUNK - 1) // CHUNK
    for chunk in prange(n_chunks):
        corner = np.empty((4, 3), dtype=np.int64)
        normal = np.empty((4, 3), dtype=np.int64)
        plane = np.empty((4, 3))
        box = np.empty((3, 2), dtype=np.int64)
        order = np.empty(6, dtype=np.int64)
        for cell in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(cells))):
            for k in range(n_corners):
                for d in range(3):
                    corner[k, d] = ticks[cells[cell, k], d]
            sum_cell(sums[cell], volume, shift, corner, n_corners, bits, normal, plane, box, order)


@njit(cache=True)
def _paint_cells(owner: NDArray, ticks: NDArray, cells: NDArray, bits: int) -> None:
    n_corners = cells.shape[1]
    corner = np.empty((4, 3), dtype=np.int64)
    normal = np.empty((4, 3), dtype=np.int64)
    plane = np.empty((4, 3))
    box = np.empty((3, 2), dtype=np.int64)
    order = np.empty(6, dtype=np.int64)
    for cell in range(len(cells)):
        for k in range(n_corners):
            for d in range(3):
                corner[k, d] = ticks[cells[cell, k], d]
        error = _prepare_cell(corner, n_corners, bits, owner.shape, normal, plane, box, order)
        if error < 0.0:
            continue
        least, most = box[2, 0] - 0.5, box[2, 1] - 0.5
        for i in range(box[0, 0], box[0, 1]):
            first_row, last_row = _row_range(corner, n_corners, bits, i, box[1, 0], box[1, 1])
            for j in range(first_row, last_row):
                low, high = _float_run(plane, order[0], order[1], n_corners, error, least, most, i, j)
                if high < low:
                    low, high = _exact_run(corner, n_corners, bits, normal, plane, box, order, error, i, j)
                for k in range(low, high):
                    owner[i, j, k] = cell


@njit(cache=True)
def _orientations(ticks: NDArray, cells: NDArray) -> NDArray:
    signs = np.empty(len(cells), dtype=np.int64)
    corner = np.empty((4, 3), dtype=np.int64)
    normal = np.empty((4, 3), dtype=np.int64)
    for cell in range(len(cells)):
        for k in range(cells.shape[1]):
            for d in range(3):
                corner[k, d] = ticks[cells[cell, k], d]
        signs[cell] = cell_orientation(corner, normal, cells.shape[1])
    return signs
