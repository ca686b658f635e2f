"""What all readers of images share: which volume of several, and in words what is wrong with a file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tetopt.budget import check_memory
from tetopt.errors import InputError

IMAGE_BYTES = 8  # of a voxel of an `Image`, at most
# What to do about a file that ends too soon, and about one that may never have been an image.
DAMAGED_FILE = "the file is truncated or damaged; copy it again"
UNREADABLE_FILE = "truncated or damaged, or not an image of this kind; copy it again, or check its name"


def volume_index(trailing: tuple[int, ...], volume: int | None) -> tuple[int, ...]:
    """Index into the axes beyond the third (or beyond a picture's two) of the volume asked for."""
    count = math.prod(int(size) for size in trailing)
    if count <= 0:
        raise InputError(f"every axis needs a voxel, got trailing axes of lengths {trailing}")
    if volume is None and count > 1:
        raise InputError(
            f"the file holds {count} volumes; choose one, 0 to {count - 1}: `volume=k`, "
            "`--volume K` for the first image of a command, `FILE:K` for others"
        )
    volume = 0 if volume is None else volume
    if not 0 <= volume < count:
        volumes = "one volume" if count == 1 else f"{count} volumes"
        raise InputError(f"volume {volume} asked for, but the file holds {volumes}; choose from 0 to {count - 1}")
    return tuple(int(i) for i in np.unravel_index(volume, trailing, order="F"))


def check_room(sizes: Sequence[int], value_bytes: int) -> None:
    """InputError if one volume, of its first three axes, does not fit memory, as it is read and as an `Image`."""
    count = math.prod(sizes[:3])
    shape = " x ".join(str(size) for size in sizes[:3])
    check_memory(count * (value_bytes + IMAGE_BYTES), f"its {shape} voxels", "crop or resample it first")


def one_line(words: object) -> str:
    """Text of a library on one line."""
    return " ".join(str(words).split())
