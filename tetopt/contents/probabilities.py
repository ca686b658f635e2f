"""Tissue probabilities as labels: a voxel has the most probable tissue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tetopt.contents.align import is_same_grid, resample_contrast
from tetopt.contents.labels import LARGEST_LABEL
from tetopt.errors import InputError, warn
from tetopt.image import Image

RANGE_TOLERANCE = 1e-3  # by which a probability may be below 0 or above 1, from rounding in files
# by which the sum may exceed 1 without a warning: rounding to bytes for six tissues
SUM_TOLERANCE = 0.02
BYTE_SCALE, PERCENT_SCALE = 255.0, 100.0  # whole numbers between them are probabilities times 255


def resample_tissue(tissue: Image, image: Image, name: str = "tissue") -> Image:
    """Return a tissue's probabilities on the image's voxels, interpolated linearly.

    Whole numbers with a maximum of 101 to 255, as in unscaled byte files, are divided by 255, with
    a warning.

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
    tissue = tissue.with_zeros()
    low, high = tissue.range
    if PERCENT_SCALE < high <= BYTE_SCALE and low >= 0.0 and tissue.is_whole:
        warn(f"{name}: whole numbers up to {high:g} are read as probabilities times 255")
        tissue = Image(tissue.data / BYTE_SCALE, tissue.affine)
    _check_range(name, tissue)
    return resample_contrast(tissue, image, name)


def tissue_labels(tissues: Sequence[Image]) -> Image:
    """Return the most probable tissue of each voxel: 1 to K, 0 where the remainder to 1 is larger.

    Warns of probabilities that sum to more than 1, and of tissues that are the most probable
    nowhere.

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
        No tissues, probabilities out of range, or different voxels.

    Examples
    --------
    >>> grey, white = (tetopt.Image(np.array([row])) for row in ([0.2, 0.5, 0.6], [0.1, 0.4, 0.7]))
    >>> tetopt.tissue_labels([grey, white]).data.tolist()
    [[0.0, 1.0, 2.0]]
    """
    if not 0 < len(tissues) <= LARGEST_LABEL:
        raise InputError(f"tissues: expected one image or more, got {len(tissues)}")
    labels, largest, total = np.zeros((3, *tissues[0].shape), dtype=np.float32)
    for number, tissue in enumerate(tissues, 1):
        name = f"tissues, number {number}"
        if tissue.shape != tissues[0].shape or not is_same_grid(tissue, tissues[0]):
            raise InputError(
                f"{name}: expected the voxels of the first; see tetopt.resample_tissue"
            )
        _check_range(name, tissue)
        fraction = np.clip(tissue.with_zeros().data, 0.0, 1.0)
        total += fraction
        labels[fraction > largest] = number
        np.maximum(largest, fraction, out=largest, casting="unsafe")
    labels[1.0 - total >= largest] = 0
    if n_over := int(np.count_nonzero(total > 1.0 + SUM_TOLERANCE)):
        warn(
            f"tissues: probabilities sum to more than 1 in {n_over} of {total.size} voxels (up "
            f"to {total.max():.3g})"
        )
    if lost := sorted(
        set(range(1, len(tissues) + 1)) - set(np.unique(labels).astype(int).tolist())
    ):
        warn(
            f"tissues: label {', '.join(map(str, lost))} is not the most probable in any voxel: "
            "no cell gets it"
        )
    return Image(labels, tissues[0].affine)


def _check_range(name: str, tissue: Image) -> None:
    low, high = tissue.range
    if low < -RANGE_TOLERANCE or high > 1.0 + RANGE_TOLERANCE:
        raise InputError(
            f"{name}: expected probabilities from 0 to 1, got {low:g} to {high:g}; first divide "
            "by the value that "
            "stands for 1, such as 100 or 255"
        )
