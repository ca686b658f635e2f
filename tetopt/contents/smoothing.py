"""The smooth level of a label or a mask: the signed distance to a surface without the stairs of
voxels.

All passes over the voxels are kernels that fill slabs, so that one label takes all threads and the
temporaries of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.system.arrays import Bools
from tetopt.system.kernel_cache import njit
from tetopt.system.slabs import over_slabs

# levels are clipped there: nodes that move in steps near an interface need no larger ones
FARTHEST_LEVEL = 6.0
# voxels beyond which distances to a label are irrelevant, more than levels and smoothing use
FARTHEST_DISTANCE = 8
# voxels, sigma of the Gaussian where a label or gap is thin, and elsewhere
FINE_SIGMA, BROAD_SIGMA = 1.0, 3.0
# voxels from middle to surface of labels too thin for the broad Gaussian, and of thick ones
THIN_REACH = 4.0, 7.0
REACH_VOXELS = 6  # within which the middle of a label is looked for
VOLUME_SIGMA = 3.0  # voxels, least sigma of the Gaussian within which volumes are preserved
VOLUME_BLOCK = 2  # voxels: volumes are summed over blocks
# distance range of voxels next to the surface: below 1, and centres keep their label
NEAR_SURFACE = 0.05, 0.95
# voxels by which smoothing may change levels farther off: the error of distances to voxels
MOST_LIFTED = 1.0
# least slope of a level in measuring volumes; flatter levels are those of sheets of one voxel
LEAST_SLOPE = 0.3
FLOW_STEPS = 4  # more steps do not improve spheres of 3 to 20 voxels or shells of 2 to 6
FARTHEST_SQUARE = FARTHEST_DISTANCE**2
DISTANCES = np.sqrt(np.arange(FARTHEST_SQUARE + 1)).astype(np.float32)  # by their squares
# The distance to the voxels' surface by the squared distance to the nearest centre beyond it,
# negative inside.
RAW_LEVELS = np.concatenate([0.5 - DISTANCES[:0:-1], [np.float32(0.0)], DISTANCES[1:] - 0.5])
# Fraction of the broad Gaussian, by the squared distance from the middle to the surface.
BROAD_FRACTIONS = np.clip((DISTANCES - THIN_REACH[0]) / (THIN_REACH[1] - THIN_REACH[0]), 0.0, 1.0)


def smooth_level(
    inside: Bools,
    raw: Bools,
    off: NDArray[np.float32] | None,
    factors: Sequence[int],
) -> NDArray[np.float32]:
    """The smooth level of a label or a mask, (*shape) float32, clipped at `FARTHEST_LEVEL`.

    Smoothing removes stairs like biharmonic flow: 2 G - G^2, with a Gaussian G, preserves planes
    and quadrics. Each step then corrects volumes and returns voxels next to the surface to their
    own side, which undoes excessive smoothing. Where nothing is thin the Gaussian is broad, since
    the stairs of a nearly flat surface are.

    Parameters
    ----------
    inside : (*shape) bool
        Voxels of the label; between slices by shape.
    raw : (*shape) bool
        The same with the label of each voxel's slice, whose volume is preserved.
    off : (*shape) float32, optional
        Distance of each voxel from the plane of a slice, voxels; 0 between slices with the same
        label, and by default.
    factors : sequence of int
        Thickness of a slice along each axis, voxels.
    """
    if inside.all():
        return np.full(inside.shape, -FARTHEST_LEVEL, dtype=np.float32)
    n, whole = inside.ndim, (1,) * (3 - inside.ndim) + inside.shape
    within, without = _near_squares(inside), _near_squares(~inside)
    reach = np.minimum(
        largest_around(within, REACH_VOXELS), largest_around(without, REACH_VOXELS)
    ).reshape(whole)
    square = (without.view(np.int8) - within.view(np.int8)).reshape(whole)
    del within, without
    level, raw = _levels_of(square), raw.reshape(whole)
    off = np.zeros((0, 0, 0), dtype=np.float32) if off is None else off.reshape(whole)
    sigma = max(VOLUME_SIGMA, *factors)
    for _ in range(FLOW_STEPS):
        level = _step_flow(level, reach, n)
        _keep_volume(level, raw, sigma, square, off, n)
    # once more, between voxel centres: walls of two voxels would be 2 % too thick
    if max(factors) == 1:
        _keep_volume(level, raw, sigma, square, off, n, is_exact=True)
    return np.clip(level, -FARTHEST_LEVEL, FARTHEST_LEVEL, out=level).reshape(inside.shape)


def raw_level(inside: Bools) -> NDArray[np.float32]:
    """Distance to the nearest voxel centre on the other side less 0.5, voxels; negative inside,
    clipped where far.
    """
    return _levels_of(_near_squares(~inside).view(np.int8) - _near_squares(inside).view(np.int8))


def _levels_of(square: NDArray[np.int8]) -> NDArray[np.float32]:
    """`RAW_LEVELS` in slabs, as an index takes eight bytes a voxel."""
    level = np.empty(square.shape, dtype=np.float32)

    def fill(first: int, stop: int) -> None:
        level[first:stop] = RAW_LEVELS[square[first:stop] + np.int16(FARTHEST_SQUARE)]

    over_slabs(fill, len(level), level.size)
    return level


def _near_squares(inside: Bools) -> NDArray[np.uint8]:
    """Squares of distances to the nearest voxel centre outside; 0 outside, clipped where it is far.

    The least sum of squared steps, axis by axis (Felzenszwalb and Huttenlocher 2012). As only short
    steps matter, all are tried, in bytes: a tenth of the time of scipy's transform.
    """
    assert FARTHEST_SQUARE + (FARTHEST_DISTANCE - 1) ** 2 < 256
    square = np.where(inside, np.uint8(FARTHEST_SQUARE), np.uint8(0))
    for axis in range(square.ndim):
        before, least = np.moveaxis(square, axis, 0), np.moveaxis(square.copy(), axis, 0)
        for k in range(1, min(FARTHEST_DISTANCE, len(least))):
            moved = before + np.uint8(k * k)
            np.minimum(least[k:], moved[:-k], out=least[k:])
            np.minimum(least[:-k], moved[k:], out=least[:-k])
        square = np.moveaxis(least, 0, axis)
    return np.ascontiguousarray(square)


def largest_around(values: NDArray, reach: int) -> NDArray:
    """The largest of the values, from 0, within `reach` voxels along all axes.

    Of windows twice as long in each step: a tenth of the time of scipy's filter.
    """
    for axis in range(values.ndim):
        rows = np.moveaxis(values, axis, 0)
        n, width, length = len(rows), 2 * reach + 1, 1
        rows = np.concatenate([np.zeros_like(rows, shape=(reach, *rows.shape[1:])), rows])
        rows = np.concatenate([rows, np.zeros_like(rows, shape=(reach, *rows.shape[1:]))])
        while 2 * length <= width:
            rows = np.maximum(rows[:-length], rows[length:])
            length *= 2
        values = np.moveaxis(
            np.maximum(rows[:n], rows[width - length : width - length + n]), 0, axis
        )
    return np.ascontiguousarray(values)


def _step_flow(level: NDArray[np.float32], reach: NDArray[np.uint8], n: int) -> NDArray[np.float32]:
    """A step of the flow, with the broad Gaussian where nothing within `reach` is thin; the
    level is overwritten.
    """
    is_broad = BROAD_FRACTIONS[reach.max()] > 0.0
    broad = _flow_level(level, BROAD_SIGMA, n, np.empty_like(level)) if is_broad else None
    smooth = _flow_level(level, FINE_SIGMA, n, level)
    if broad is not None:
        _blend(smooth, broad, reach)
    return smooth


def _flow_level(
    level: NDArray[np.float32], sigma: float, n: int, rest: NDArray[np.float32]
) -> NDArray[np.float32]:
    """2 G - G^2 of a level (s_0, s_1, s_2), for the Gaussian G along its last n axes; `rest`
    gets what G removes.
    """
    weights = np.exp(-0.5 / (sigma * sigma) * np.arange(int(3.0 * sigma + 0.5) + 1) ** 2)
    weights /= np.concatenate([weights[:0:-1], weights]).sum()
    result = np.empty_like(level)

    def fill_once(first: int, stop: int) -> None:
        _fill_correlated(result[first:stop], level, weights, first, n)

    def add_again(first: int, stop: int) -> None:
        again = np.empty_like(rest[first:stop])
        _fill_correlated(again, rest, weights, first, n)
        result[first:stop] += again

    over_slabs(fill_once, len(level), level.size)
    over_slabs(
        lambda a, b: np.subtract(level[a:b], result[a:b], out=rest[a:b]), len(level), level.size
    )
    over_slabs(add_again, len(level), level.size)
    return result


@njit(cache=True, nogil=True)
def _fill_correlated(result: NDArray, data: NDArray, weights: NDArray, first: int, n: int) -> None:
    """Correlate `data` along its last n axes with symmetric `weights` (R+1,), from the middle;
    constant beyond faces.

    The planes of `result` are those of `data` from `first`. It equals `scipy.ndimage.correlate1d`
    along each axis to the last bit, with sums in float64 and in its order, but rows are done at
    once, and a plane along two axes while it is in the cache.
    """
    reach, (n_planes, n_rows, length) = len(weights) - 1, data.shape
    plane, total, wide = (
        np.empty((n_rows, length), dtype=np.float32),
        np.empty(length),
        np.empty(length + 2 * reach),
    )
    for p in range(len(result)):
        i = first + p
        for j in range(n_rows):
            here = data[i, j]
            for c in range(length):
                total[c] = here[c]
            if n == 3:
                for c in range(length):
                    total[c] *= weights[0]
                for m in range(reach, 0, -1):
                    low, high, weight = (
                        data[max(i - m, 0), j],
                        data[min(i + m, n_planes - 1), j],
                        weights[m],
                    )
                    for c in range(length):
                        total[c] += (np.float64(low[c]) + np.float64(high[c])) * weight
            for c in range(length):
                plane[j, c] = total[c]
        for j in range(n_rows):
            here, row = plane[j], result[p, j]
            for c in range(length):
                total[c] = here[c] * weights[0]
            for m in range(reach, 0, -1):
                low, high, weight = plane[max(j - m, 0)], plane[min(j + m, n_rows - 1)], weights[m]
                for c in range(length):
                    total[c] += (np.float64(low[c]) + np.float64(high[c])) * weight
            for c in range(length):
                wide[reach + c] = np.float32(total[c])
            wide[:reach], wide[reach + length :] = wide[reach], wide[reach + length - 1]
            for c in range(length):
                total[c] = wide[reach + c] * weights[0]
            for m in range(reach, 0, -1):
                low, high, weight = wide[reach - m :], wide[reach + m :], weights[m]
                for c in range(length):
                    total[c] += (low[c] + high[c]) * weight
            for c in range(length):
                row[c] = total[c]


def _blend(
    smooth: NDArray[np.float32], broad: NDArray[np.float32], reach: NDArray[np.uint8]
) -> None:
    """Replace a fraction of a level by that of the broad Gaussian, in place."""
    over_slabs(
        lambda a, b: _blend_planes(smooth[a:b], broad[a:b], reach[a:b]), len(smooth), smooth.size
    )


@njit(cache=True, nogil=True)
def _blend_planes(smooth: NDArray, broad: NDArray, reach: NDArray) -> None:
    for i in range(smooth.shape[0]):
        for j in range(smooth.shape[1]):
            for k in range(smooth.shape[2]):
                smooth[i, j, k] += BROAD_FRACTIONS[reach[i, j, k]] * (
                    broad[i, j, k] - smooth[i, j, k]
                )


def _keep_volume(
    level: NDArray[np.float32],
    raw: Bools,
    sigma: float,
    square: NDArray[np.int8],
    off: NDArray[np.float32],
    n: int,
    is_exact: bool = False,
) -> None:
    """Raise or lower the level smoothly, in place, so that it has the label's volume within
    `sigma`.

    It stays within the bounds of `_bounds`.
    """
    whole = level.shape
    blocks = [-(-size // VOLUME_BLOCK) for size in whole]
    missing, area = np.zeros(blocks, dtype=np.float32), np.zeros(blocks, dtype=np.float32)

    def fill_sums(first: int, stop: int) -> None:
        if is_exact:
            _add_between_centres(missing, area, level, raw, first, stop)
            return
        planes = VOLUME_BLOCK * first, min(VOLUME_BLOCK * stop, len(level))
        # with the level linear between centres
        mean = np.empty((planes[1] - planes[0], *whole[1:]), dtype=np.float32)
        _fill_correlated(mean, level, np.array([0.75, 0.125]), planes[0], n)
        _fill_block_sums(missing[first:stop], area[first:stop], level, mean, raw, planes[0])

    over_slabs(fill_sums, blocks[0], level.size)
    both = np.stack([missing, area]).reshape(2, *blocks[3 - n :])
    missing, area = np.concatenate(
        over_slabs(lambda a, b: _blur_sums(both[a:b], sigma), 2, level.size, 2)
    )
    lowered = np.where(
        area > 0.01 * VOLUME_BLOCK**n, missing / np.maximum(area, 1e-3), np.float32(0.0)
    )
    lowered = lowered.reshape(blocks)
    over_slabs(
        lambda first, stop: _lower(level, lowered, square, off, first, stop), len(level), level.size
    )


def _blur_sums(sums: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Fields of sums over blocks, (F, *shape), smoothed by a Gaussian of `sigma` voxels."""
    sigmas = [0.0] + [sigma / VOLUME_BLOCK] * (sums.ndim - 1)
    return scipy.ndimage.gaussian_filter(sums, sigmas, mode="constant", truncate=3.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_block_sums(
    missing: NDArray, area: NDArray, level: NDArray, mean: NDArray, raw: NDArray, first: int
) -> None:
    """Sum over blocks the volume that a level lacks compared with its label, and the voxels that
    its surface crosses.

    The fraction of a voxel inside follows from the level's mean over it and its slope. The blocks
    and the planes of `mean` begin at the plane `first`.
    """
    lacking, is_near = np.zeros((2, 2, 2), dtype=np.float32), np.zeros((2, 2, 2), dtype=np.float32)
    half, one = np.float32(0.5), np.float32(1.0)
    for a in range(missing.shape[0]):
        for b in range(missing.shape[1]):
            for c in range(missing.shape[2]):
                for i in range(2):
                    for j in range(2):
                        for k in range(2):
                            x, y, z = first + 2 * a + i, 2 * b + j, 2 * c + k
                            lacking[i, j, k] = is_near[i, j, k] = np.float32(0.0)
                            if x >= level.shape[0] or y >= level.shape[1] or z >= level.shape[2]:
                                continue
                            distance = mean[x - first, y, z]
                            # as the slope is 1 at most, others are full or empty anyway
                            if abs(distance) < half:
                                distance /= min(
                                    max(_slope(level, x, y, z), np.float32(LEAST_SLOPE)), one
                                )
                                is_near[i, j, k] = np.float32(abs(distance) < half)
                            filled = min(max(half - distance, np.float32(0.0)), one)
                            lacking[i, j, k] = np.float32(raw[x, y, z]) - filled
                missing[a, b, c], area[a, b, c] = _block_sum(lacking), _block_sum(is_near)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_between_centres(
    missing: NDArray, area: NDArray, level: NDArray, raw: NDArray, first: int, stop: int
) -> None:
    """Add the sums of `_fill_block_sums`, by octants of the cubes of eight voxel centres that the
    surface crosses.

    Only those of blocks from layer `first` to `stop`.

    Every centre is on its label's side, so other cubes lack nothing. The area counts by what a
    lower level would fill.
    """
    corner, value = np.empty((8, 3), dtype=np.int64), np.empty(8)
    for i in range(max(2 * first - 1, 0), min(2 * stop, max(level.shape[0] - 1, 1))):
        for j in range(max(level.shape[1] - 1, 1)):
            i1, j1 = min(i + 1, level.shape[0] - 1), min(j + 1, level.shape[1] - 1)
            low, high = _ends(level, i, j, i1, j1, 0)
            for k in range(max(level.shape[2] - 1, 1)):
                k1, low_before, high_before = min(k + 1, level.shape[2] - 1), low, high
                low, high = _ends(level, i, j, i1, j1, k1)
                if min(low_before, low) > 0.0 or max(high_before, high) < 0.0:
                    continue
                for m in range(8):
                    corner[m, 0] = i1 if m & 4 else i
                    corner[m, 1] = j1 if m & 2 else j
                    corner[m, 2] = k1 if m & 1 else k
                    value[m] = level[corner[m, 0], corner[m, 1], corner[m, 2]]
                for m in range(8):
                    x, y, z = corner[m, 0], corner[m, 1], corner[m, 2]
                    if not first <= x // 2 < stop:
                        continue
                    distance, slope = _in_octant(value, m)
                    filled = min(max(0.5 - distance, 0.0), 1.0)
                    missing[x // 2, y // 2, z // 2] += 0.125 * (raw[x, y, z] - filled)
                    area[x // 2, y // 2, z // 2] += 0.25 / slope * (abs(distance) < 0.5)


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _ends(level: NDArray, i: int, j: int, i1: int, j1: int, k: int) -> tuple[float, float]:
    """The least and the largest of four levels."""
    a, b, c, d = level[i, j, k], level[i, j1, k], level[i1, j, k], level[i1, j1, k]
    return min(min(a, b), min(c, d)), max(max(a, b), max(c, d))


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")
def _in_octant(value: NDArray, m: int) -> tuple[float, float]:
    """Distance of the middle of a cube's octant at corner m to the surface, in its edges, and
    the level's slope.
    """
    level, rise_x, rise_y, rise_z = 0.0, 0.0, 0.0, 0.0
    for q in range(8):
        x, y, z = (
            0.25 + 0.5 * ((q ^ m) & 4 == 0),
            0.25 + 0.5 * ((q ^ m) & 2 == 0),
            0.25 + 0.5 * ((q ^ m) & 1 == 0),
        )
        level += x * y * z * value[q]
        rise_x += y * z * (value[q] if q & 4 else -value[q])
        rise_y += x * z * (value[q] if q & 2 else -value[q])
        rise_z += x * y * (value[q] if q & 1 else -value[q])
    slope = max(np.sqrt(rise_x * rise_x + rise_y * rise_y + rise_z * rise_z), LEAST_SLOPE)
    return 2.0 * level / slope, slope


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _block_sum(values: NDArray) -> np.float32:
    low = (values[0, 0, 0] + values[1, 0, 0]) + (values[0, 1, 0] + values[1, 1, 0])
    return low + ((values[0, 0, 1] + values[1, 0, 1]) + (values[0, 1, 1] + values[1, 1, 1]))


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")
def _slope(level: NDArray, x: int, y: int, z: int) -> np.float32:
    """Length of the gradient, from the larger one-sided differences, as both sides cancel across
    a thin sheet.
    """
    here, square = level[x, y, z], np.float32(0.0)
    last = level.shape[0] - 1, level.shape[1] - 1, level.shape[2] - 1
    for axis in range(3):
        i, j, k = axis == 0, axis == 1, axis == 2
        at = x if i else y if j else z
        low = level[x - i, y - j, z - k] - here if at > 0 else np.float32(0.0)
        high = level[x + i, y + j, z + k] - here if at < last[axis] else np.float32(0.0)
        square += max(low * low, high * high)
    return np.sqrt(square)


@njit(cache=True, nogil=True, error_model="numpy")
def _lower(
    level: NDArray, lowered: NDArray, square: NDArray, off: NDArray, start: int, stop: int
) -> None:
    """Lower a level by values for blocks, linear between their centres, and keep it within
    bounds, in some planes.
    """
    first, part = (
        np.zeros((3, max(level.shape)), dtype=np.int64),
        np.zeros((3, max(level.shape)), dtype=np.float32),
    )
    for axis in range(3):
        n = lowered.shape[axis]
        for i in range(level.shape[axis] if level.shape[axis] > 1 else 0):
            at = min(max((i + 0.5) / VOLUME_BLOCK - 0.5, 0.0), n - 1.0)
            first[axis, i] = min(int(at), max(n - 2, 0))
            part[axis, i] = at - first[axis, i]
    row = np.empty(lowered.shape[2], dtype=np.float32)
    for x in range(start, stop):
        a, u = first[0, x], part[0, x]
        above = min(a + 1, lowered.shape[0] - 1)
        for y in range(level.shape[1]):
            b, v = first[1, y], part[1, y]
            beside = min(b + 1, lowered.shape[1] - 1)
            for c in range(len(row)):
                here = lowered[a, b, c] + (lowered[above, b, c] - lowered[a, b, c]) * u
                there = (
                    lowered[a, beside, c] + (lowered[above, beside, c] - lowered[a, beside, c]) * u
                )
                row[c] = here + (there - here) * v
            for z in range(level.shape[2]):
                c = first[2, z]
                here = row[c] + (row[min(c + 1, len(row) - 1)] - row[c]) * part[2, z]
                low, high = _bounds(
                    square[x, y, z], off[x, y, z] if len(off) > 0 else np.float32(0.0)
                )
                level[x, y, z] = min(max(level[x, y, z] - here, low), high)


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _bounds(square: int, off: float) -> tuple[Any, Any]:
    """The least and the largest level of a voxel `off` voxels from a slice's plane."""
    lifted, nearest, farthest = (
        np.float32(MOST_LIFTED),
        np.float32(NEAR_SURFACE[0]),
        np.float32(NEAR_SURFACE[1]),
    )
    raw = RAW_LEVELS[square + FARTHEST_SQUARE]
    size = abs(raw)
    least = max(size - lifted, nearest) - off
    most = (farthest if size <= np.float32(0.5) else size + lifted) + off
    return (-most, -least) if raw < 0.0 else (least, most)
