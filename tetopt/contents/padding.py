"""Padding of CT: voxels outside a scanner's field of view, or a resampled volume, with a value far
below that of air.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.system.arrays import Bools

PADDING_BELOW = -1100.0  # Hounsfield units: air has -1000, and its noise is hardly lower
LEAST_PADDED, LEAST_PADDED_VOXELS = 0.001, 20  # fraction of the voxels, and number
LEAST_COMMON = 0.2  # part of the low voxels that has a level's value, rounded
LEAST_CONSTANT = 0.5  # part near the levels: a map that falls smoothly has none
LEVEL_RINGING = 0.05  # of a level, by splines
MOST_OTHERS = 0.1  # part of the low voxels elsewhere; splines of order 5 ring in half of that
EDGE_VOXELS = 3  # beside padding, of which interpolation changes some
AIR_BELOW = -800.0  # lungs included
LEAST_AIR = 0.25  # part of the voxels beside padding; an organ that was cut out has less


def replace_padding(data: NDArray, is_padding: Bools | None = None) -> tuple[NDArray, str]:
    """Give voxels of padding values like those beside it, noise included: no edge is left, and no
    peak in the histogram.

    The values are drawn at random, always the same, from the darker half of those beside it, which
    a body at the padding does not change, and its mirror image about the median.

    Parameters
    ----------
    data : (s_0, ..., s_{n-1}) array of numbers
    is_padding : (s_0, ..., s_{n-1}) bool, optional
        The padding that the file states. By default, voxels below -1100 connected to those of a
        constant level on the box's sides, which most of those below -1100 have or are close to, if
        a quarter of those beside are air.

    Returns
    -------
    (s_0, ..., s_{n-1}) array, str
        The data, and a note; the data itself, and an empty text, if there is no padding. A constant
        level without air beside it, as around an organ that was cut out, stays, with a note.
    """
    if is_padding is not None:
        beside = _values_beside(data, is_padding, 1)
    else:
        is_padding = _low_levels(data)
        beside = _values_beside(data, is_padding, EDGE_VOXELS)
        is_air = beside < AIR_BELOW
        if len(beside) and np.count_nonzero(is_air) < LEAST_AIR * len(beside):
            words = f"{is_padding.mean():.1%} of its voxels have values down to"
            words += f" {data[is_padding].min():g}, without air beside them: exclude them by `mask`"
            return data, f"{words} or `background`"
        beside = beside[is_air]
    if len(beside) == 0:
        return data, ""
    middle = np.median(beside)
    half = beside[beside <= middle]
    values = np.concatenate([half, 2.0 * middle - half])
    data = data.copy()
    words = (
        f"{is_padding.mean():.1%} of its voxels, down to {data[is_padding].min():g}, are padding"
    )
    data[is_padding] = np.random.default_rng(0).choice(values, np.count_nonzero(is_padding))
    return data, f"{words}: they get values of the air beside them, about {middle:g}"


def _values_beside(data: NDArray, is_padding: Bools, steps: int) -> NDArray:
    if not is_padding.any():  # most images: importing scipy.ndimage takes .3 s
        return data[:0]
    return data[scipy.ndimage.binary_dilation(is_padding, iterations=steps) & ~is_padding]


def _low_levels(data: NDArray) -> Bools:
    """Return the voxels of constant levels far below air that start at the box's sides, and what
    interpolation made of their edges; none if there are no such levels.
    """
    is_low = data < PADDING_BELOW
    least = max(LEAST_PADDED * data.size, LEAST_PADDED_VOXELS)
    none: Bools = np.zeros(data.shape, dtype=bool)
    n_low = np.count_nonzero(is_low)
    if n_low < least:
        return none
    values, counts = np.unique(np.round(data[is_low]), return_counts=True)
    levels = values[counts >= max(LEAST_COMMON * n_low, least)]
    is_level = is_low & np.isin(np.round(data), levels)
    if not any(is_level.take([0, -1], axis).any() for axis in range(data.ndim)):
        return none
    is_close = np.zeros_like(none)
    for level in levels:
        is_close |= np.abs(data - level) <= LEVEL_RINGING * abs(level)
    is_close &= is_low
    is_edge = scipy.ndimage.binary_dilation(is_close, iterations=EDGE_VOXELS)
    n_others = np.count_nonzero(is_low & ~is_edge)
    most = max(least, MOST_OTHERS * n_low)
    if np.count_nonzero(is_close) < LEAST_CONSTANT * n_low or n_others >= most:
        return none
    padding: Bools = scipy.ndimage.binary_propagation(is_level, mask=is_low)
    return padding
