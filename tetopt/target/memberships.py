"""What labels mean between voxels: of each label a smooth level, whose smallest says which label a place has.

A label's level is the signed distance to its surface, in voxels, negative inside, so that the interface between
labels a and b is where their levels are equal. Since each place has the label of the smallest level, labels leave no
gaps and do not overlap, where three of them meet as well. Between voxel centres a level is linear along each axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, maximum_filter

from tetopt.image import Image
from tetopt.target.labels import check_labels, label_channels

FARTHEST_LEVEL = 6.0  # levels end there: nothing that moves by steps near an interface looks further
STAIRS_VOXELS = 1.0  # sigma of the Gaussian that takes the stairs of voxels off a label
MOST_MOVED_VOXELS = 0.45  # below a half, so that every voxel's centre keeps its label
SLACK_SLICES = 0.25  # added to the ratio of two spacings before it is cut to a whole number: 1.75 voxels become two


class Memberships(NamedTuple):
    """Of each label a level on a grid of voxel centres; made by `memberships`."""

    labels: NDArray[np.int64]  # (K,) values, rising, of those present
    channel: NDArray[np.int64]  # (K,) row of `levels` of each; labels nowhere near one another share one
    levels: NDArray[np.float32]  # (C, *shape) distance to the surface, voxels, below 0 inside
    partition: NDArray[np.int64]  # (*shape) row of `labels` of each voxel, that of the smallest level


def supersampling(spacing: NDArray[np.float64]) -> tuple[int, ...]:
    """Into how many a voxel of these edges (n,), mm, is divided along each axis, so that its parts are nearly cubes."""
    return tuple(max(1, int(ratio)) for ratio in np.asarray(spacing) / np.min(spacing) + SLACK_SLICES)


def finer(image: Image, factors: Sequence[int]) -> Image:
    """The image on voxels divided into so many along each axis; its box stays the same.

    Between the centres of two voxels intensities are linear; beyond the outermost they are constant.
    """
    data = image.data.astype(np.float64)
    for axis, factor in enumerate(factors):
        at = np.clip(finer_index(data.shape[axis], factor), 0.0, data.shape[axis] - 1.0)
        below = np.minimum(at.astype(np.int64), max(data.shape[axis] - 2, 0))
        share = (at - below).reshape((-1,) + (1,) * (data.ndim - 1 - axis))
        above = np.minimum(below + 1, data.shape[axis] - 1)
        data = np.take(data, below, axis) * (1.0 - share) + np.take(data, above, axis) * share
    return Image(data.astype(image.data.dtype), finer_affine(image.affine, factors))


def finer_index(n: int, factor: int) -> NDArray[np.float64]:
    """Where the centres of `n` voxels divided into `factor` each lie, (n * factor,), in the index of the whole ones."""
    return (np.arange(n * factor) + 0.5) / factor - 0.5


def finer_affine(affine: NDArray[np.float64], factors: Sequence[int]) -> NDArray[np.float64]:
    """The affine (n+1, n+1) of voxels divided into so many along each axis."""
    step = np.append(1.0 / np.asarray(factors, dtype=np.float64), 1.0)
    moved = affine * step
    moved[:-1, -1] += affine[:-1, :-1] @ (0.5 * step[:-1] - 0.5)
    return moved


def memberships(labels: Image, factors: Sequence[int] | None = None) -> Memberships:
    """Of each label the signed distance to its smooth surface, on the labels' voxels or on finer ones.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0.
    factors : sequence of int, optional
        Into how many a voxel is divided along each axis, as `supersampling` has them; 1 by default.

    Raises
    ------
    InputError
        Labels that are not whole numbers from 0.
    """
    check_labels("labels", labels)
    values, number = np.unique(labels.data.astype(np.int64), return_inverse=True)
    number = number.reshape(labels.shape)
    for axis, factor in enumerate(factors or ()):
        number = np.repeat(number, factor, axis)
    channel = label_channels(number, len(values))
    levels = np.stack([_level(channel[number] == c) for c in range(channel.max() + 1)])
    return Memberships(values, channel, levels, _partition(number, channel, levels))


def _level(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The smooth level of a label, or of several that are apart."""
    if inside.all():
        return np.full(inside.shape, -FARTHEST_LEVEL, dtype=np.float32)
    within, without = distance_transform_edt(inside), distance_transform_edt(~inside)
    raw = np.where(inside, 0.5 - within, without - 0.5)
    once = gaussian_filter(raw, STAIRS_VOXELS, mode="nearest")
    twice = once + gaussian_filter(raw - once, STAIRS_VOXELS, mode="nearest")
    room = np.minimum(maximum_filter(within, size=5), maximum_filter(without, size=5))
    most = MOST_MOVED_VOXELS * np.clip(room - 1.0, 0.0, 1.0)
    level = np.clip(twice, raw - most, raw + most)
    return np.clip(level, -FARTHEST_LEVEL, FARTHEST_LEVEL).astype(np.float32)


def _partition(number: NDArray[np.int64], channel: NDArray[np.int64], levels: NDArray[np.float32]) -> NDArray[np.int64]:
    """The label of the smallest level at each voxel; of labels that share a channel the one whose voxel it is."""
    smallest = levels.argmin(axis=0)
    assert np.array_equal(smallest, channel[number]), "a voxel's centre left its label"
    return number
