"""2-D pictures by Pillow, in a process of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.apart import read_apart
from tetopt.io.volumes import UNREADABLE_FILE, volume_index

PICTURE_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
# Pillow goes by what a file holds, not by its name; these alone are tried (of PostScript it would start Ghostscript).
PICTURE_FORMATS = ("PNG", "TIFF", "JPEG", "BMP")
MOST_PIXELS = 2**30  # of a frame: 32,768 squared, more than any slide scanner's file that is a plain picture


def read_picture(path: Path, volume: int | None, _notes: list[str]) -> tuple[NDArray, NDArray[np.float64]]:
    """Grey values (rows, columns) and affine of a frame; InputError without the path before it."""
    data = read_apart(_pixels_of, path, volume, value_bytes=MOST_PIXELS, library="Pillow")
    return data, np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, data.shape[0] - 1.0], [0.0, 0.0, 1.0]])


# In the child


def _pixels_of(path: str, volume: int | None) -> NDArray:
    import PIL.Image

    PIL.Image.MAX_IMAGE_PIXELS = None  # its own limit is told as a warning and then an error; ours is one line
    try:
        picture = PIL.Image.open(path, formats=PICTURE_FORMATS)
    except PIL.UnidentifiedImageError as error:
        raise InputError(f"{UNREADABLE_FILE} (Pillow knows no such picture)") from error
    with picture:
        (frame,) = volume_index((getattr(picture, "n_frames", 1),), volume)
        picture.seek(frame)
        width, height = picture.size
        if width * height > MOST_PIXELS:
            raise InputError(f"its {height} x {width} pixels are more than {MOST_PIXELS}; crop or resample it first")
        return _grey(np.asarray(picture), picture.mode)


def _grey(values: NDArray, mode: str) -> NDArray:
    """Grey values (rows, columns); of a colour picture only where it is grey and opaque throughout."""
    if mode in ("1", "L", "I", "F") or mode.startswith("I;16"):
        return values
    if mode in ("LA", "RGB", "RGBA"):
        opaque = "A" not in mode or bool((values[..., -1] == 255).all())
        colours = values[..., :3] if mode.startswith("RGB") else values[..., :1]
        if opaque and bool((colours == colours[..., :1]).all()):
            return values[..., 0]
    raise InputError(f"a colour or transparent picture (mode {mode}); convert it to grey first")
