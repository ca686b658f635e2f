"""Reading of 2-D pictures by Pillow, in a separate process."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.apart import read_apart
from tetopt.io.volumes import UNREADABLE_FILE, Voxels, volume_index
from tetopt.system.extras import install_hint

PICTURE_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
# Pillow goes by content, not by name; only these formats are tried (for PostScript it would start
# Ghostscript).
PICTURE_FORMATS = ("PNG", "TIFF", "JPEG", "BMP")
PHOTOMETRIC_TAG = 262  # 0 if 0 is white
MOST_PIXELS = 2**30  # in a frame: 32,768 squared, more than any slide scanner's plain picture


def read_picture(path: Path, volume: int | None) -> Voxels:
    """Return grey values (rows, columns) and affine of a frame; InputError without a leading
    path.
    """
    data = read_apart(frame_of, path, volume, value_bytes=MOST_PIXELS, library="Pillow")
    return data, np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, data.shape[0] - 1.0], [0.0, 0.0, 1.0]])


# In the child


def frame_of(path: str, volume: int | None) -> NDArray:
    """Return the grey values (rows, columns) of a picture's frame; in a child process."""
    import PIL.Image

    # replaced by our limit, as Pillow's first causes a warning and then an error
    PIL.Image.MAX_IMAGE_PIXELS = None
    try:
        picture = PIL.Image.open(path, formats=PICTURE_FORMATS)
    except PIL.UnidentifiedImageError as error:
        raise InputError(f"{UNREADABLE_FILE} (unknown to Pillow)") from error
    with picture:
        n_frames = getattr(picture, "n_frames", 1)
        if volume is None and n_frames > 1 and picture.format == "TIFF":
            hint = install_hint("tifffile")
            raise InputError(
                f"it has {n_frames} pages; choose one by `volume`, or read stacks with tifffile: "
                f"{hint}"
            )
        (frame,) = volume_index((n_frames,), volume)
        picture.seek(frame)
        width, height = picture.size
        if width * height > MOST_PIXELS:
            raise InputError(
                f"expected at most {MOST_PIXELS} pixels, got {height} x {width}; crop or "
                "resample it"
            )
        tags: Mapping[int, Any] = getattr(picture, "tag_v2", {})  # of TIFF alone
        # by Pillow, in no other mode
        is_inverted = tags.get(PHOTOMETRIC_TAG) == 0 and picture.mode in ("1", "L")
        values = np.asarray(picture)
        return _grey(~values if is_inverted else values, picture.mode)


def _grey(values: NDArray, mode: str) -> NDArray:
    """Return grey values (rows, columns); a colour picture must be grey and opaque throughout."""
    if mode in ("1", "L", "I", "F") or mode.startswith("I;16"):
        return values
    if mode in ("LA", "RGB", "RGBA"):
        opaque = "A" not in mode or bool((values[..., -1] == 255).all())
        colours = values[..., :3] if mode.startswith("RGB") else values[..., :1]
        if opaque and bool((colours == colours[..., :1]).all()):
            return values[..., 0]
    raise InputError(
        f"expected a grey picture, got colour or transparency (mode {mode}); convert it to grey "
        "first"
    )
