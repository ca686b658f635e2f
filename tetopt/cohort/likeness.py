"""How like a subject's thumbnail is to the others': what is turned, cut off or of another contrast is seen by it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from tetopt.report.thumbnail import SIDE_PIXELS

BLOCK_PIXELS = 4  # that are averaged along each side: the mesh's edges, which lie anywhere, are hardly seen then
MEDIAN_PICTURES = 1000  # of which the median is taken, evenly many of all: more change it by a hundredth
THUMBNAIL_BYTES = 32_768  # of one of ours at most: of noise they have half of that
PICTURE_SIZES = ((SIDE_PIXELS, SIDE_PIXELS), (2 * SIDE_PIXELS, SIDE_PIXELS))  # width and height, in 2-D and 3-D


def likenesses(paths: Sequence[Path | None]) -> list[float | None]:
    """The correlation of each picture with the median of all.

    Parameters
    ----------
    paths : sequence of Path or None
        Of thumbnails (`tetopt.report.thumbnail`).

    Returns
    -------
    list of float or None
        From -1 to 1, of grey levels averaged over blocks of 4 x 4 pixels, each picture's mean taken off and its
        norm made 1; None where there is no picture, no other of its size, or it is of one grey.
    """
    groups: dict[int, list[int]] = defaultdict(list)
    greys: dict[int, NDArray[np.float32]] = {}
    for place, path in enumerate(paths):
        if path is not None and (grey := _grey(path)) is not None:
            groups[len(grey)].append(place)
            greys[place] = grey
    likeness: list[float | None] = [None] * len(paths)
    for places in groups.values():
        if len(places) > 1:
            step = -(-len(places) // MEDIAN_PICTURES)
            usual = np.median([greys[place] for place in places[::step]], axis=0)
            usual = usual - usual.mean()
            if (size := float(np.linalg.norm(usual))) > 0.0:
                for place in places:
                    likeness[place] = float(greys[place] @ usual) / size
    return likeness


def _grey(path: Path) -> NDArray[np.float32] | None:
    """A picture's blocks (K,), of mean 0 and norm 1; None if it is none of ours, or the same everywhere."""
    try:
        if path.stat().st_size > THUMBNAIL_BYTES:
            return None
        with PIL.Image.open(path, formats=["PNG"]) as picture:
            if picture.size not in PICTURE_SIZES:
                return None
            grey = np.asarray(picture.convert("L"), dtype=np.float32)
    except (OSError, ValueError, SyntaxError):  # what Pillow says of a damaged PNG
        return None
    height, width = grey.shape
    blocks = grey.reshape(height // BLOCK_PIXELS, BLOCK_PIXELS, width // BLOCK_PIXELS, BLOCK_PIXELS).mean(axis=(1, 3))
    centred = (blocks - blocks.mean()).ravel()
    size = float(np.linalg.norm(centred))
    return centred / np.float32(size) if size > 0.0 else None
