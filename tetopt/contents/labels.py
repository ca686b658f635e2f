"""Labels: whole numbers with a colour each, and their distribution among channels."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.image import Image

LARGEST_LABEL = 32_767  # largest signed 16-bit integer, the type of labels in many programs
APART_VOXELS = 4  # labels at least this far from one another may share a channel

# Okabe and Ito's, then always the colour farthest in CIELAB from all before, and twice as far from the background,
# black and white, as seen with normal, no red or no green cones (Machado et al. 2009): any two are 10 or more apart, of
# the first 20 any two 14, and all are 20 from the background.
LABEL_PALETTE = (
    "#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7", "#f0e442", "#0000ff", "#6969ff", "#5a00b4",
    "#963c1e", "#87d269", "#781e78", "#7896ff", "#f02d5a", "#a51e69", "#d200b4", "#004bff", "#b40f4b", "#f07887",
    "#e15a3c", "#690f96", "#3cf096", "#f0964b", "#1e4b2d", "#2d6978", "#c32d00", "#a52dd2", "#3c00d2", "#e178d2",
    "#f0d25a", "#a569d2", "#78b496", "#d2a5d2", "#870f2d", "#d2a578", "#965a3c", "#78d2f0", "#a569a5", "#d21e87",
)  # fmt: skip
LABEL_TINTS = (0.0, -0.4, 0.4)  # variants of the palette as it repeats: unchanged, mixed with black, mixed with white
BACKGROUND_LABEL = 0  # the label outside all tissues
BACKGROUND_COLOUR = "#e6e6e6"  # of that label


def check_labels(name: str, labels: Image) -> None:
    """Raise InputError unless the voxels are whole numbers from 0 to `LARGEST_LABEL`."""
    data = labels.data
    wrong = np.argwhere((data < 0) | (data > LARGEST_LABEL) | (np.rint(data) != data))
    if len(wrong):
        first = tuple(int(i) for i in wrong[0])
        raise InputError(
            f"{name}: labels must be whole numbers from 0 to {LARGEST_LABEL}; {len(wrong)} voxels have other "
            f"values, the first {data[first]:g} at {first}: is it a label image?"
        )


def label_channels(number: NDArray[np.int64], n_labels: int) -> NDArray[np.int64]:
    """A channel for each label: labels within `APART_VOXELS` voxels of one another have different ones."""
    shape = tuple(-(-s // APART_VOXELS) for s in number.shape)
    is_in, block = np.zeros((n_labels, int(np.prod(shape))), dtype=bool), np.arange(np.prod(shape)).reshape(shape)
    for place in itertools.product(range(APART_VOXELS), repeat=number.ndim):  # the voxels of all blocks in turn
        part = number[tuple(slice(first, None, APART_VOXELS) for first in place)]
        is_in[part, block[tuple(slice(n) for n in part.shape)]] = True
    is_beside = np.stack([scipy.ndimage.maximum_filter(row.reshape(shape), size=3).ravel() for row in is_in])
    touches = is_beside.astype(np.float32) @ is_in.T.astype(np.float32) > 0.0
    channel = np.full(n_labels, -1, dtype=np.int64)
    for label in np.argsort(-touches.sum(axis=1), kind="stable"):
        taken = set(channel[touches[label]].tolist())
        channel[label] = next(c for c in range(n_labels) if c not in taken)
    return channel


def hex_colour(text: Any) -> tuple[float, float, float] | None:
    """Red, green and blue, 0 to 1, of "#rrggbb"; None for any other text."""
    if not isinstance(text, str) or len(text) != 7 or text[0] != "#":
        return None
    try:
        parts = bytes.fromhex(text[1:])
    except ValueError:
        return None
    return (parts[0] / 255.0, parts[1] / 255.0, parts[2] / 255.0)


def colours_by_number(labels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Default colours (K, 3) of labels from 0: red, green and blue, 0 to 1; label 0 is light grey.

    They depend only on the number, so that a label has the same colour in every picture and file. Any two of as many
    successive labels as three palettes have different colours.
    """
    palette = np.array([hex_colour(text) for text in LABEL_PALETTE])
    rounds, place = np.divmod(labels - 1, len(palette))
    tint = np.array(LABEL_TINTS)[rounds % len(LABEL_TINTS)][:, None]
    mixed = (1.0 - np.abs(tint)) * palette[place] + np.maximum(tint, 0.0)
    mixed[labels == BACKGROUND_LABEL] = hex_colour(BACKGROUND_COLOUR)
    return np.rint(255.0 * mixed) / 255.0
