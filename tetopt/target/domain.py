"""The part of an image's box that a mesh is to cover: a mask's region, its surface smooth between the voxels.

The surface is the zero level of a function given at the voxel centres: the signed distance to the mask's surface in
voxels, negative inside, smoothed so that stairs of voxels become planes and curves, but never further from the mask's
own surface than a part of a voxel. Between voxel centres the function is linear along each axis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, maximum_filter

from tetopt.image import Image

HALF = 0.5  # of a mask: what is inside
SIGMA = 1.0  # voxels, of the Gaussian that takes the stairs
ASTRAY = 0.35  # voxels: the furthest that smoothing moves the surface
NEAR = 1e-3  # voxel: as near as this is on the surface


class Domain(NamedTuple):
    """A mask on the voxels of an image; made by `domain`."""

    inside: NDArray[np.bool_]  # voxels whose centres lie in the mask
    level: NDArray[np.float32]  # at voxel centres: distance to the surface in voxels, below 0 inside


def domain(mask: Image) -> Domain:
    """The region where a mask of values 0 to 1 is a half or more.

    A mask of two values is smoothed, except where it, or the gap beside it, is one or two voxels thick; one of
    fractions has its own surface between the voxels, and keeps it.
    """
    data = mask.data.astype(np.float64)
    inside = data >= HALF
    if inside.all():
        return Domain(inside, np.full(inside.shape, -float(max(inside.shape)), dtype=np.float32))
    within, without = distance_transform_edt(inside), distance_transform_edt(~inside)
    raw = np.where(inside, 0.5 - within, without - 0.5)
    if np.any((data > 0.0) & (data < 1.0)):
        level = np.where(np.abs(raw) < 1.0, np.clip(0.5 - data, -0.5, 0.5), raw)
    else:
        once = gaussian_filter(raw, SIGMA, mode="nearest")
        twice = once + gaussian_filter(raw - once, SIGMA, mode="nearest")  # what the first one took of curves, back
        room = np.minimum(maximum_filter(within, size=5), maximum_filter(without, size=5))
        astray = ASTRAY * np.clip(room - 1.0, 0.0, 1.0)
        level = np.clip(twice, raw - astray, raw + astray)
    return Domain(inside, level.astype(np.float32))


def levels(level: NDArray, index: NDArray[np.float64]) -> NDArray[np.float64]:
    """The level function at index coordinates (K, n), (K,)."""
    return np.asarray(map_coordinates(level, index.T, order=1, mode="nearest", output=np.float64))
