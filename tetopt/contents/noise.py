"""Strength of an image's noise, from a sample of its planes."""

from __future__ import annotations

from math import prod
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.system.arrays import Bools, Ints

SAMPLED_VOXELS = 100_000  # sample whose most frequent value counts as the background's
# least number of voxels for estimating the noise; a smaller image uses all
NOISE_VOXELS = 1_000_000
MOST_LABEL_VALUES = 32  # an image with no more distinct values holds labels, and has no noise


class NoiseSample(NamedTuple):
    """Voxels of an image from which its noise is estimated; made by `noise_sample`."""

    values: NDArray  # (K,) values at a regular spacing
    near: NDArray  # (3, P, ...) the planes before P planes, these planes, and those after


def noise_level(data: NDArray, inside: Bools | None = None) -> float:
    """Standard deviation of the noise in an image's data, estimated from second differences along
    every axis.

    Structure wider than a voxel cancels in (1, -2, 1) along all axes (Immerkaer 1996, here in n-D),
    and the lower quartile of the magnitude is that of noise in most of the volume. A constant
    background is ignored; differences in less than a tenth of the voxels are edges, not noise, and
    labels have none. Smoothed noise is underestimated. With `inside` only voxels there, with all
    neighbours inside, are used; without any, as in a mask of one plane, the noise is 0. A large
    image is sampled at about `NOISE_VOXELS`, in slices an odd number apart along the first axis:
    for four real volumes this was within 0.7 % of the estimate from all voxels, and equal to the
    last bit for whole numbers. If no such slice has a voxel to use, as many of those with most of
    them are sampled instead.
    """
    if inside is None:
        return sampled_noise(noise_sample(data))
    middles = noise_planes(inside)
    return sampled_noise(noise_sample(data, middles), noise_sample(inside, middles).near)


def noise_planes(inside: Bools) -> Ints:
    """Indices of the planes at which second differences are taken within a mask; none if no
    voxel is surrounded.
    """
    middles = noise_places(inside.shape)[1]
    if len(middles) == 0 or _surrounded_voxels(_near(inside, middles)).any():
        return middles
    within = scipy.ndimage.minimum_filter(inside, size=3)[(slice(1, -1),) * inside.ndim]
    counts = within.sum(axis=tuple(range(1, inside.ndim)))
    most = np.argsort(-counts, kind="stable")[: len(middles)]
    return 1 + np.sort(most[counts[most] > 0])


def noise_places(shape: tuple[int, ...]) -> tuple[int, Ints]:
    """Sampling distance of values, voxels, and indices of the planes at which second differences
    are taken.

    An image with fewer than three voxels along an axis has no such planes.
    """
    size = prod(shape)
    step = max((size // NOISE_VOXELS - 1) // 2 * 2 + 1, 1)
    first, end = 1 + max(shape[0] - 3, 0) % step // 2, shape[0] - 1 if min(shape) >= 3 else 0
    return max(size // SAMPLED_VOXELS, 1), np.arange(first, end, step, dtype=np.int64)


def noise_sample(data: NDArray, middles: Ints | None = None) -> NoiseSample:
    """The sample of voxels in memory; second differences are taken at the planes `middles`, if
    given.
    """
    stride, usual = noise_places(data.shape)
    return NoiseSample(data.ravel()[::stride], _near(data, usual if middles is None else middles))


def _near(data: NDArray, middles: Ints) -> NDArray:
    """Planes with the ones before and after, (3, P, ...)."""
    return np.stack([data[middles + k] for k in (-1, 0, 1)])


def _surrounded_voxels(near: Bools) -> Bools:
    """Voxels of the middle planes, but for those at their borders, with all neighbours inside,
    (P, ...).
    """
    middle = (slice(None), *(slice(1, -1),) * (near.ndim - 2))
    return np.asarray(
        scipy.ndimage.minimum_filter(near.all(axis=0), (1, *(3,) * (near.ndim - 2)))[middle]
    )


def sampled_noise(sample: NoiseSample, inside: Bools | None = None) -> float:
    """`noise_level` from a sample; `inside` covers its planes, (3, P, ...)."""
    if sample.near.size == 0:
        return 0.0
    # An image with few distinct values holds labels, which have no noise.
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
        is_counted &= _surrounded_voxels(inside)
    size = np.abs(rest[is_counted])
    if np.count_nonzero(size) < 0.1 * n_voxels:
        return 0.0
    return float(np.quantile(size, 0.25) / 0.31864 / 6.0 ** (at.ndim / 2))
