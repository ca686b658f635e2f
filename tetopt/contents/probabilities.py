"""Tissue probabilities instead of labels: a level for each tissue, with surfaces within voxels.

A voxel has the most probable tissue. Probabilities are linear between neighbouring voxel centres, and the surface of a
tissue is where it is as probable as the most probable of the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.align import resample_contrast
from tetopt.contents.labels import LARGEST_LABEL
from tetopt.contents.memberships import (
    FARTHEST_LEVEL,
    NO_ROOM,
    VOLUME_SIGMA,
    Memberships,
    finer,
    gathered,
    near_distance,
    with_volume,
)
from tetopt.errors import InputError, warn
from tetopt.image import Image
from tetopt.system.budget import check_memory

RANGE_TOLERANCE = 1e-3  # by which a probability may be below 0 or above 1, from rounding in files
SUM_TOLERANCE = 0.02  # by which the sum may exceed 1 without a warning: rounding to bytes for six tissues
BYTE_SCALE, PERCENT = 255.0, 100.0  # whole numbers between them are probabilities times 255
LEAST_STEP = 1e-3  # voxels between a centre and the surface
MOST_SHIFT = 0.2  # voxels, the largest correction of a volume in one step
VOLUME_STEPS = 2  # a third changes balls of 3 to 9 voxels by less than 0.1 %
BAND_STEPS, BAND_WIDTH = 5, 2.9  # sweeps, and the distance up to which they are complete: 5 steps along three axes


def resample_tissue(tissue: Image, image: Image, name: str = "tissue") -> Image:
    """Return a tissue's probabilities on the image's voxels, interpolated linearly if their grid differs.

    Whole numbers with a maximum of 101 to 255, as in unscaled byte files, are divided by 255, with a warning.

    Parameters
    ----------
    tissue : Image
        Probabilities from 0 to 1, or whole numbers up to 255.
    image : Image
        Image with the target voxels.
    name : str, optional
        Name of the tissue in messages.

    Returns
    -------
    Image
        Probabilities from 0 to 1, with the image's shape and affine.

    Raises
    ------
    InputError
        As for `resample_contrast`, or values out of range.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> ball = tetopt.Image(np.clip(image.data / image.data.max(), 0, 1), image.affine)
    >>> tetopt.resample_tissue(ball, image).shape
    (16, 16, 16)
    """
    low, high = tissue.range
    if PERCENT < high <= BYTE_SCALE and low >= 0.0 and tissue.is_whole:
        warn(f"{name}: whole numbers up to {high:g} are read as probabilities times 255")
        tissue = Image(tissue.data / BYTE_SCALE, tissue.affine)
    _check_range(name, tissue)
    return resample_contrast(tissue, image, name)


def tissue_labels(tissues: Sequence[Image]) -> Image:
    """Return the most probable tissue of each voxel: 1 to K in the given order, 0 where the remainder to 1 is larger.

    Parameters
    ----------
    tissues : sequence of Image
        Probabilities from 0 to 1 on the same voxels.

    Returns
    -------
    Image
        Whole numbers; the first of equally probable tissues, with 0 before all others.

    Raises
    ------
    InputError
        No tissues, probabilities out of range, or different shapes.

    Examples
    --------
    >>> grey, white = (tetopt.Image(np.array([row])) for row in ([0.2, 0.5, 0.6], [0.1, 0.4, 0.7]))
    >>> tetopt.tissue_labels([grey, white]).data.tolist()
    [[0.0, 1.0, 2.0]]
    """
    check_tissues(tissues)
    return Image(fractions(tissues).argmax(axis=0).astype(np.float32), tissues[0].affine)


def check_tissues(tissues: Sequence[Image]) -> None:
    """Raise InputError for invalid probabilities of tissues; warn where they sum to more than 1."""
    if not 0 < len(tissues) <= LARGEST_LABEL:
        raise InputError(f"tissues: expected one image or more, got {len(tissues)}")
    for number, tissue in enumerate(tissues, 1):
        name = f"tissues, number {number}"
        if tissue.shape != tissues[0].shape:
            raise InputError(f"{name}: expected shape {tissues[0].shape} like the first, got {tissue.shape}")
        _check_range(name, tissue)


def warn_of_sums(tissues: Sequence[Image]) -> None:
    """Warn of voxels whose probabilities sum to more than 1."""
    total = np.zeros(tissues[0].shape, dtype=np.float32)
    for tissue in tissues:
        total += tissue.data
    if n_over := int(np.count_nonzero(total > 1.0 + SUM_TOLERANCE)):
        warn(
            f"tissues: probabilities sum to more than 1 in {n_over} of {total.size} voxels (up to {total.max():.3g}); "
            "they are divided by their sum"
        )


def fractions(tissues: Sequence[Image]) -> NDArray[np.float32]:
    """Probabilities that sum to 1, (K+1, *shape): the remainder first, which is 0 where the others sum to more."""
    rows = np.empty((len(tissues) + 1, *tissues[0].shape), dtype=np.float32)
    for row, tissue in zip(rows[1:], tissues, strict=True):
        np.clip(tissue.data, 0.0, 1.0, out=row, casting="unsafe")
    total = rows[1:].sum(axis=0)
    rows[1:] /= np.maximum(total, 1.0)
    np.maximum(1.0 - total, 0.0, out=rows[0])
    return rows


def probable_memberships(tissues: Sequence[Image], factors: Sequence[int]) -> Memberships:
    """Signed distances to the surfaces of the tissues and the remainder, for those most probable somewhere.

    Parameters
    ----------
    tissues : sequence of Image
        Probabilities from 0 to 1, on the same voxels.
    factors : sequence of int
        Number of parts of a voxel along each axis, as from `supersampling`; probabilities are linear between centres.
    """
    n_voxels = tissues[0].data.size * int(np.prod(factors))
    check_memory(8.0 * (len(tissues) + 1) * n_voxels, f"{len(tissues)} tissues on {n_voxels} voxels", NO_ROOM)
    rows = fractions([finer(Image(tissue.data.astype(np.float32), tissue.affine), factors) for tissue in tissues])
    largest = rows.argmax(axis=0)
    values = np.flatnonzero(np.bincount(largest.ravel(), minlength=len(rows)))
    lost = sorted(set(range(1, len(rows))) - set(values.tolist()))
    if lost:
        warn(f"tissues: no cell gets label {', '.join(map(str, lost))}, which is not the most probable in any voxel")
    second = np.partition(rows, -2, axis=0)[-2]
    first = rows.max(axis=0)

    def level_in(row: int, box: tuple[slice, ...]) -> NDArray[np.float32]:
        inside = largest[box] == values[row]
        own = rows[values[row]][box]
        lead = np.where(inside, own - second[box], own - first[box])
        return _with_fractions(_distance(lead, inside), lead, inside)

    return gathered(values, np.searchsorted(values, largest), level_in, int(np.prod(factors)))


def _check_range(name: str, tissue: Image) -> None:
    low, high = tissue.range
    if low < -RANGE_TOLERANCE or high > 1.0 + RANGE_TOLERANCE:
        raise InputError(
            f"{name}: expected probabilities from 0 to 1, got {low:g} to {high:g}; first divide by the value that "
            "stands for 1, such as 100 or 255"
        )


def _with_fractions(
    level: NDArray[np.float32], lead: NDArray[np.float32], inside: NDArray[np.bool_]
) -> NDArray[np.float32]:  # fmt: skip
    """Adjust the level to the volume that the tissue has by its fractions of voxels; voxels keep their sides.

    Linear between centres, it would cut round shapes, such as 3 % of a ball with a radius of 6 voxels. Where the lead
    jumps from -1 to 1, the fraction of a voxel is the probability; where it rises slowly, its zero gives the fraction.
    """
    reach = scipy.ndimage.maximum_filter(lead, 3) - scipy.ndimage.minimum_filter(lead, 3)
    sharp = np.clip(reach - np.float32(1.0), 0.0, 1.0)
    flat = np.clip(0.5 - level, 0.0, 1.0)
    fraction = flat + sharp * (np.clip(0.5 + 0.5 * lead, 0.0, 1.0) - flat)
    for _ in range(VOLUME_STEPS):
        shift = np.clip(with_volume(level, fraction, VOLUME_SIGMA) - level, -MOST_SHIFT, MOST_SHIFT)
        moved = level + shift
        level = np.where(inside, np.minimum(moved, -LEAST_STEP), np.maximum(moved, LEAST_STEP))
    return np.clip(level, -FARTHEST_LEVEL, FARTHEST_LEVEL)


def _distance(lead: NDArray[np.float32], inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Signed distance, voxels, below 0 inside, to the zero of `lead`, which is linear between voxels and >= 0 inside.

    The first-order upwind solution of |grad d| = 1 (Sethian 1996, PNAS 93, 1591), in sweeps of all voxels. Along an
    axis that crosses the surface next to a voxel, the upwind place is the crossing, so that planes are exact there.
    """
    if inside.all():
        return np.full(inside.shape, -FARTHEST_LEVEL, dtype=np.float32)
    steps = [_crossing(lead, inside, axis) for axis in range(inside.ndim)]
    distance = np.full(inside.shape, FARTHEST_LEVEL, dtype=np.float32)
    for _ in range(BAND_STEPS):
        np.minimum(distance, _upwind(distance, steps), out=distance)
    far = near_distance(inside) + near_distance(~inside) - np.float32(0.5)
    distance = np.where(distance < BAND_WIDTH, distance, np.clip(far, BAND_WIDTH, FARTHEST_LEVEL))  # `far` is coarse
    return np.where(inside, -distance, distance)


def _crossing(lead: NDArray[np.float32], inside: NDArray[np.bool_], axis: int) -> NDArray[np.float32]:
    """Distance along an axis, in either direction, from each voxel's centre to the lead's zero; infinite beyond 1."""
    step = np.full(inside.shape, np.inf, dtype=np.float32)
    along, own, side = (np.moveaxis(each, axis, 0) for each in (step, lead, inside))
    is_crossed = side[1:] != side[:-1]
    one, other = np.abs(own[:-1][is_crossed]), np.abs(own[1:][is_crossed])
    at = np.clip((one + 1e-9) / (one + other + 2e-9), LEAST_STEP, 1.0 - LEAST_STEP)
    along[:-1][is_crossed] = at
    along[1:][is_crossed] = np.minimum(along[1:][is_crossed], 1.0 - at)
    return step


def _upwind(distance: NDArray[np.float32], steps: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Update the distance of each voxel from nearer places along the axes: crossings, or neighbours a step away."""
    near: list[tuple[NDArray, NDArray]] = []
    for axis, step in enumerate(steps):
        along = np.moveaxis(distance, axis, 0)
        least = np.full_like(distance, np.inf)
        own = np.moveaxis(least, axis, 0)
        own[1:] = along[:-1]
        np.minimum(own[:-1], along[1:], out=own[:-1])
        is_crossed = step <= 1.0
        least[is_crossed] = 0.0
        near.append((least, np.float32(1.0) / np.where(is_crossed, step, np.float32(1.0)) ** 2))
    for last in range(len(near) - 1, 0, -1):  # sorts them, faster than voxel by voxel
        for k in range(last):
            (low, weight), (high, other) = near[k], near[k + 1]
            is_less = low <= high
            near[k] = np.where(is_less, low, high), np.where(is_less, weight, other)
            near[k + 1] = np.where(is_less, high, low), np.where(is_less, other, weight)
    result: NDArray = near[0][0] + near[0][1] ** -0.5
    zeroth, first, second = near[0][1], near[0][1] * near[0][0], near[0][1] * near[0][0] ** 2
    with np.errstate(invalid="ignore"):  # axes of one voxel
        for value, weight in near[1:]:
            zeroth, first, second = zeroth + weight, first + weight * value, second + weight * value**2
            root = np.sqrt(np.maximum(first**2 - zeroth * (second - np.float32(1.0)), 0.0))
            result = np.where(result > value, (first + root) / zeroth, result)
    return result
