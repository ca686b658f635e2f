"""Shared code of image readers: a format's row in their table, choice of a volume, and messages
about damaged files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.fields.field import Convention
from tetopt.system.arrays import Floats, Shape
from tetopt.system.budget import check_memory

IMAGE_BYTES = 8  # per voxel of an `Image`, at most
# Messages for a file that ends too soon, and for one that may not be an image.
DAMAGED_FILE = "the file is truncated or damaged; copy it again"
TRAILING_BYTES = 2**24  # 17 MB after the last voxel: MGH's tags
# Stored numbers of so many bits, rescaled by whole numbers up to these, are exact in float32.
EXACT_BITS, LARGEST_SLOPE, LARGEST_INTERCEPT = 16, 64, 2**22
TOO_LONG = f"{DAMAGED_FILE} (it continues far after the last voxel, beyond byte {{}})"
UNREADABLE_FILE = (
    "truncated or damaged, or not an image of this kind; copy it again, or check its name"
)


Voxels = tuple[NDArray, Floats]  # data and affine
_NOTES: ContextVar[list[str]] = ContextVar("notes")


@contextmanager
def collect_notes() -> Iterator[list[str]]:
    """Collect what is noted within this context."""
    notes = list[str]()
    token = _NOTES.set(notes)
    try:
        yield notes
    finally:
        _NOTES.reset(token)


def note(*texts: str) -> None:
    """Note oddities of the file that is read, each once; nothing outside `collect_notes`, and no
    empty texts.
    """
    notes = _NOTES.get([])
    notes += [text for text in texts if text and text not in notes]


class Request(NamedTuple):
    """The part of a file to read, and voxel sizes for files that state none."""

    volume: int | None
    spacing_mm: float | Sequence[float] | None
    box: Callable[[Sequence[int]], list[tuple[int, int]]]  # of a volume with this shape


class Reader(NamedTuple):
    """A format of images: a row of the table in `tetopt.io.images`, from the module that reads it.

    Functions raise InputError without a leading path.

    Parameters
    ----------
    suffixes : tuple of str
        Its files end in one of these, in any case.
    read : function
        Returns data and affine for a path and a `Request`, 2-D or 3-D, and adds notes to a list.
    is_this : function, optional
        Returns whether a folder, or a file with no reader's suffix, has this format.
    shape : function, optional
        Returns the lengths of all axes from the header, the spatial ones first; by default None, as
        all would have to be read.
    other_files : function, optional
        Returns the files that belong to a file.
    has_spacing : bool
        Whether the format states voxel sizes.
    reads_crop, reads_slice : bool
        Whether it reads only the request's box for a crop, and for a slice.
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path, Request], Voxels]
    is_this: Callable[[Path], bool] = lambda _path: False
    shape: Callable[[Path], Shape | None] = lambda _path: None
    # of a pyramid, the numbers of voxels by the level's folder
    levels: Callable[[Path], Mapping[str, Shape]] = lambda _path: {}
    other_files: Callable[[Path], Sequence[Path]] = lambda _path: ()
    has_spacing: bool = True
    reads_crop: bool = False
    reads_slice: bool = False
    # all components (s_0, s_1, s_2, C), the affine, and what the file states of them
    components: Callable[[Path], tuple[NDArray, Floats, Convention]] | None = None


def volume_index(trailing: Sequence[int], volume: int | None, axes: str = "") -> Shape:
    """Return the index into the axes beyond the third (or beyond a picture's two) for the requested
    volume.

    `axes` lists their names and lengths, if they have names.
    """
    axes = f" along {axes}" if axes else ""
    count = math.prod(int(size) for size in trailing)
    if count <= 0:
        raise InputError(
            f"expected voxels along every axis, got trailing axes of lengths {trailing}"
        )
    if volume is None and count > 1:
        raise InputError(
            f"the file has {count} volumes{axes}; choose one from 0 to {count - 1}: `volume=k`, "
            "`volume` K for the first image of a command, FILE:K for others"
        )
    volume = 0 if volume is None else volume
    if not 0 <= volume < count:
        volumes = "one volume" if count == 1 else f"{count} volumes{axes}"
        raise InputError(
            f"expected a volume from 0 to {count - 1}, got {volume}: the file has {volumes}"
        )
    return tuple(int(i) for i in np.unravel_index(volume, trailing, order="F"))


def check_room(sizes: Sequence[int], value_bytes: int) -> None:
    """Raise InputError if one volume, the first three axes, does not fit into memory, as read
    and as an `Image`.
    """
    count = math.prod(sizes[:3])
    shape = " x ".join(str(size) for size in sizes[:3])
    check_memory(
        count * (value_bytes + IMAGE_BYTES), f"its {shape} voxels", "crop or resample it first"
    )


def exact_type(bits: int, scales: Iterable[tuple[float, float]]) -> type[np.floating[Any]]:
    """Return the type for stored whole numbers of so many bits, multiplied by slopes, plus
    intercepts.
    """
    is_exact = bits <= EXACT_BITS and all(
        slope == round(slope)
        and shift == round(shift)
        and abs(slope) <= LARGEST_SLOPE
        and abs(shift) <= LARGEST_INTERCEPT
        for slope, shift in scales
    )
    return np.float32 if is_exact else np.float64


def one_line(words: object) -> str:
    """Format a library's text on one line."""
    return " ".join(str(words).split())


def plane_affine(columns: Floats, origin: Floats) -> Floats:
    """Return the 2-D affine (3, 3) of a plane in 3-D with voxel steps `columns` (3, 2) and first
    voxel `origin`, mm.
    """
    if not np.isfinite(columns).all():
        raise InputError(f"affine: expected finite entries, got {columns.tolist()}")
    spanned = np.flatnonzero(columns.any(axis=1))
    if len(spanned) == 2:  # the plane of two world axes keeps their coordinates
        frame = np.eye(3)[:, spanned]
    else:
        frame, _ = np.linalg.qr(columns)
        frame *= np.sign(frame[np.abs(frame).argmax(axis=0), [0, 1]])
    affine = np.eye(3)
    affine[:2, :2] = frame.T @ columns
    affine[:2, 2] = frame.T @ origin
    return affine
