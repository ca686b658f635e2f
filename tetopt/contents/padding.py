"""Padding of CT: voxels outside a scanner's field of view, or a resampled volume, with a value far
below that of air.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.system.arrays import Bools

PADDING_BELOW = -1100.0  # Hounsfield units: air has -1000, and its noise is hardly lower
# voxels that have the least value: a fraction of all, and a number
LEAST_PADDED, LEAST_PADDED_VOXELS = 0.001, 20
AIR_BELOW = -500.0  # the median beside padding is that of air: around an organ cut out, it is not


def replace_padding(data: NDArray, is_padding: Bools | None = None) -> tuple[NDArray, str]:
    """Give voxels of padding values like those beside it, noise included: no edge is left, and no
    peak in the histogram.

    The values are drawn at random, always the same, from the darker half of those beside it, which
    a body at the padding does not change, and its mirror image about the median.

    Parameters
    ----------
    data : (s_0, ..., s_{n-1}) array of numbers
    is_padding : (s_0, ..., s_{n-1}) bool, optional
        The padding that the file states. By default, voxels below -1100 connected to those of the
        least value, if these are 20 and a thousandth of all or more, one of them is on the box's
        sides, and air (below -500) is beside them.

    Returns
    -------
    (s_0, ..., s_{n-1}) array, str
        The data, and a note; the data itself, and an empty text, if there is no padding.
    """
    most = np.inf
    if is_padding is None:
        low = data.min()
        if not low < PADDING_BELOW:
            return data, ""
        is_low = data == low
        sides = [is_low.take([0, -1], axis).any() for axis in range(data.ndim)]
        if is_low.sum() < max(LEAST_PADDED * data.size, LEAST_PADDED_VOXELS) or not any(sides):
            return data, ""
        is_padding = scipy.ndimage.binary_propagation(is_low, mask=data < PADDING_BELOW)
        most = AIR_BELOW
    beside = data[scipy.ndimage.binary_dilation(is_padding) & ~is_padding]
    if len(beside) == 0 or not (middle := np.median(beside)) <= most:
        return data, ""
    half = beside[beside <= middle]
    values = np.concatenate([half, 2.0 * middle - half])
    data = data.copy()
    words = (
        f"{is_padding.mean():.1%} of its voxels, down to {data[is_padding].min():g}, are padding"
    )
    data[is_padding] = np.random.default_rng(0).choice(values, np.count_nonzero(is_padding))
    return data, f"{words}: they get values of the air beside them, about {middle:g}"
