"""The part of an image's box that a mesh covers: a mask's region, with a surface that is smooth
between voxels.

The surface is the zero level of a function at the voxel centres: the signed distance to the mask's
surface in voxels, negative inside. Smoothing turns stairs of voxels into planes and curves,
preserves volumes, and leaves each voxel's centre on its side. Between voxel centres the function is
linear along each axis.
"""

from __future__ import annotations

import base64
import zlib
from math import prod
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.smoothing import FARTHEST_LEVEL, largest_around, raw_level, smooth_level
from tetopt.image import Image
from tetopt.system.arrays import Bools, Floats
from tetopt.system.budget import check_memory

INSIDE_FRACTION = 0.5  # the least value of a mask, 0 to 1, at which a voxel counts as inside
BEYOND_VOXELS = 4  # voxels beyond the box's sides that smoothing sees, as a box ends near its mask
ON_SURFACE_VOXELS = 1e-3  # a place whose level is this near to 0 lies on the surface


class Region(NamedTuple):
    """The part of an image's box that a mask covers; made by `region_of`."""

    inside: Bools  # voxels whose centres lie in the mask
    # at voxel centres: distance to the surface in voxels, below 0 inside
    level: NDArray[np.float32]


def region_of(mask: Image) -> Region:
    """The region where a mask of values 0 to 1 is 0.5 or more.

    A mask of two values has the smooth surface of a label
    (`tetopt.contents.smoothing.smooth_level`), except where it, or a gap in it, is one voxel thick.
    A mask of fractions defines its surface between the voxels and keeps it. Where the surface is
    far, the level counts voxels along the axis on which it is farthest.
    """
    data, inside = mask.data, mask.data >= INSIDE_FRACTION
    if inside.all():
        return Region(inside, np.full(inside.shape, -float(max(inside.shape)), dtype=np.float32))
    if np.any((data > 0.0) & (data < 1.0)):
        level = raw_level(inside)
        np.copyto(
            level,
            np.clip(0.5 - data.astype(np.float64), -0.5, 0.5),
            "same_kind",
            where=np.abs(level) < 1.0,
        )
    else:
        level = _smooth_level(inside)
    np.clip(level, -FARTHEST_LEVEL, FARTHEST_LEVEL, out=level)
    farther = scipy.ndimage.distance_transform_cdt(np.abs(level) >= FARTHEST_LEVEL)
    level += np.copysign(farther, level, dtype=np.float32)
    return Region(inside, level)


def _smooth_level(inside: Bools) -> NDArray[np.float32]:
    """The smooth level of a mask, but the raw one around sheets and gaps of one voxel, which
    smoothing would tear.
    """
    wide = np.pad(inside, BEYOND_VOXELS, "edge")
    level = smooth_level(wide, wide, None, (1,))
    is_single = np.zeros(wide.shape, dtype=bool)
    for side in (wide, ~wide):
        is_single |= side & ~largest_around(_open_mask(side), 1)
    part = (slice(BEYOND_VOXELS, -BEYOND_VOXELS),) * inside.ndim
    return np.where(largest_around(is_single, 1)[part], raw_level(inside), level[part])


def _open_mask(inside: Bools) -> Bools:
    """Voxels in cubes of two voxels a side that are inside: a tenth of the time of
    `scipy.ndimage.binary_opening`.
    """
    whole = inside
    for axis in range(inside.ndim):
        rows = np.moveaxis(whole, axis, 0)
        whole = np.moveaxis(rows[:-1] & rows[1:], 0, axis)
    for axis in range(inside.ndim):
        grown = np.zeros((*inside.shape[: axis + 1], *whole.shape[axis + 1 :]), dtype=bool)
        rows, part = np.moveaxis(grown, axis, 0), np.moveaxis(whole, axis, 0)
        rows[:-1] = part
        rows[1:] |= part
        whole = grown
    return whole


def levels(level: NDArray, index: Floats) -> Floats:
    """The level function at index coordinates (K, n), (K,)."""
    return np.asarray(
        scipy.ndimage.map_coordinates(level, index.T, order=1, mode="nearest", output=np.float64)
    )


def mask_text(mask: Image) -> dict[str, Any]:
    """Return the voxels of 0.5 or more for the header of a mesh's file, in the box around them;
    `mask_of` reads it.
    """
    inside = mask.data >= INSIDE_FRACTION
    around = scipy.ndimage.find_objects(inside.astype(np.int8))[0]
    part = mask.box([s.start for s in around], [s.stop for s in around])
    packed = zlib.compress(np.packbits(inside[around]).tobytes(), 9)
    return {
        "shape": list(part.shape),
        "affine": part.affine.tolist(),
        "inside": base64.b64encode(packed).decode("ascii"),
    }


def mask_of(text: dict[str, Any]) -> Image:
    """Return the mask that `mask_text` describes, on its own voxels.

    Raises
    ------
    ValueError, TypeError or KeyError
        The text is not such a description.
    """
    shape = tuple(map(int, text["shape"]))
    if min(shape) < 1:
        raise ValueError(f"expected voxels along each axis, got {shape}")
    n_bytes = -(-prod(shape) // 8)
    check_memory(64.0 * n_bytes, f"mask: {prod(shape)} voxels", "close other programs")
    unpacking = zlib.decompressobj()
    try:
        bits = unpacking.decompress(base64.b64decode(text["inside"], validate=True), n_bytes + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(bits) != n_bytes:
        raise ValueError(f"expected {n_bytes} bytes of voxels")
    inside = np.unpackbits(np.frombuffer(bits, dtype=np.uint8), count=prod(shape)).reshape(shape)
    return Image(inside, np.array(text["affine"], dtype=np.float64))
