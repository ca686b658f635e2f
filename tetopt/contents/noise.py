"""How strong an image's noise is, from a sample of its planes."""

from __future__ import annotations

from math import prod
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

SAMPLED_VOXELS = 100_000  # of these the most frequent value is taken for the background's
NOISE_VOXELS = 1_000_000  # of these, or more, the noise is estimated; all of a smaller image's
MOST_LABEL_VALUES = 32  # an image of no more values than this is one of labels, and has no noise


class NoiseSample(NamedTuple):
    """Of an image's voxels, what its noise is estimated from; made by `noise_sample`."""

    values: NDArray  # (K,) every so many voxels one
    near: NDArray  # (3, P, ...) planes before others, these P themselves, and those after


def noise_level(data: NDArray, inside: NDArray[np.bool_] | None = None) -> float:
    """Standard deviation of the noise in an image's data, from what second differences along every axis leave of it.

    Structure wider than a voxel cancels in (1, -2, 1) taken along all axes (Immerkaer 1996, here in n-D); the lower
    quartile of its size is that of noise in most of the volume. A background of one value, cut out, does not count;
    what is left in less than a tenth of the voxels are edges, not noise, and labels have none. Noise that was smoothed
    is underestimated. With `inside` only the voxels there, and not beside others, are looked at. Of a large image these
    are about `NOISE_VOXELS`, in slices an odd number apart along the first axis: four real volumes came out within
    0.7 % of what all of their voxels say, to the last bit where intensities are whole numbers.
    """
    return sampled_noise(noise_sample(data), None if inside is None else noise_sample(inside).near)


def noise_places(shape: tuple[int, ...]) -> tuple[int, NDArray[np.int64]]:
    """How many voxels apart values are sampled, and the numbers of the planes that second differences are taken at.

    None of an image of less than three voxels along an axis.
    """
    size = prod(shape)
    step = max((size // NOISE_VOXELS - 1) // 2 * 2 + 1, 1)
    first, end = 1 + max(shape[0] - 3, 0) % step // 2, shape[0] - 1 if min(shape) >= 3 else 0
    return max(size // SAMPLED_VOXELS, 1), np.arange(first, end, step, dtype=np.int64)


def noise_sample(data: NDArray) -> NoiseSample:
    """The sample of voxels in memory."""
    stride, middles = noise_places(data.shape)
    return NoiseSample(data.ravel()[::stride], np.stack([data[middles + k] for k in (-1, 0, 1)]))


def sampled_noise(sample: NoiseSample, inside: NDArray[np.bool_] | None = None) -> float:
    """The same as `noise_level` from a sample; `inside` is of its planes, (3, P, ...)."""
    if sample.near.size == 0:
        return 0.0
    # An image of few values is one of labels, which have no noise.
    values, often = np.unique(sample.values, return_counts=True)
    if len(values) <= MOST_LABEL_VALUES:
        return 0.0
    before, at, after = sample.near.astype(np.float64, copy=False)
    rest = (after - at) - (at - before)
    for axis in range(1, at.ndim):
        rest = np.diff(rest, n=2, axis=axis)
    middle = (slice(None), *(slice(1, -1),) * (at.ndim - 1))
    is_counted = (rest != 0.0) | (at[middle] != values[often.argmax()])
    n_voxels = rest.size
    if inside is not None:
        n_voxels = int(inside[1].sum())
        is_counted &= scipy.ndimage.minimum_filter(inside.all(axis=0), (1, *(3,) * (at.ndim - 1)))[middle]
    size = np.abs(rest[is_counted])
    if np.count_nonzero(size) < 0.1 * n_voxels:
        return 0.0
    return float(np.quantile(size, 0.25) / 0.31864 / 6.0 ** (at.ndim / 2))
