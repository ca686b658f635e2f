"""Likeness of a subject's thumbnail to the others': it reveals flipped, cropped or different images."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from tetopt.report.thumbnail import SIDE_PIXELS
from tetopt.system.incoming import own_bytes

BLOCK_PIXELS = 4  # averaged along each side, which hides the edges of the mesh
MEDIAN_PICTURES = 1000  # evenly spaced, for the median: more change it by a hundredth
THUMBNAIL_BYTES = 32_768  # of one of tetopt's, at most: pictures of noise have half of that
PICTURE_SIZES = ((SIDE_PIXELS, SIDE_PIXELS), (2 * SIDE_PIXELS, SIDE_PIXELS))  # width and height, in 2-D and 3-D


class Likeness(NamedTuple):
    """Likeness of a picture to the median of all, as correlations from -1 to 1."""

    likeness: float
    left_right: float  # excess correlation with the median with left and right exchanged; usually below 0
    back_front: float  # with back and front exchanged
    upside_down: float  # with up and down exchanged; nan in 2-D, where front and back are up and down


def likenesses(paths: Sequence[Path | None]) -> list[Likeness | None]:
    """Compare each picture with the median of all.

    Parameters
    ----------
    paths : sequence of Path or None
        Thumbnails (`tetopt.report.thumbnail`).

    Returns
    -------
    list of Likeness or None
        Correlations of grey levels averaged over blocks of 4 x 4 pixels; None if there is no picture, no other of its
        size, or only one grey.
    """
    groups: dict[tuple[int, ...], list[int]] = defaultdict(list)
    greys: dict[int, NDArray[np.float32]] = {}
    for place, path in enumerate(paths):
        if path is not None and (grey := _grey(path)) is not None:
            groups[grey.shape].append(place)
            greys[place] = grey
    likeness: list[Likeness | None] = [None] * len(paths)
    for places in groups.values():
        step = -(-len(places) // MEDIAN_PICTURES)
        usual = np.median([greys[place] for place in places[::step]], axis=0)
        if len(places) > 1 and np.ptp(usual) > 0.0:
            turned = np.array([_centred(each).ravel() for each in (usual, *_turned(usual))])
            for place in places:
                own, *others = (turned @ greys[place].ravel()).tolist()
                margins = [other - own for other in others] + [float("nan")] * (4 - len(turned))
                likeness[place] = Likeness(own, *margins)
    return likeness


def _turned(picture: NDArray[np.floating]) -> list[NDArray[np.floating]]:
    """Return the picture with left and right, back and front and, in 3-D, up and down exchanged."""
    axial, sagittal = picture[:, : len(picture)], picture[:, len(picture) :]
    pairs = [(axial[:, ::-1], sagittal), (axial[::-1], sagittal[:, ::-1])]
    pairs += [(axial, sagittal[::-1])] if sagittal.size else []
    return [np.hstack(pair) for pair in pairs]


def _centred(picture: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the picture with mean 0 and norm 1; zeros for one grey."""
    centred = picture - picture.mean()
    return centred / (np.linalg.norm(centred) or 1.0)


def _grey(path: Path) -> NDArray[np.float32] | None:
    """Return a picture's blocks, (32, 32 or 64), with mean 0 and norm 1; None if it is not tetopt's, or constant."""
    try:
        with PIL.Image.open(BytesIO(own_bytes(path, THUMBNAIL_BYTES)), formats=["PNG"]) as picture:
            if picture.size not in PICTURE_SIZES:
                return None
            grey = np.asarray(picture.convert("L"), dtype=np.float32)
    except (OSError, ValueError, SyntaxError):  # Pillow's errors for a damaged PNG
        return None
    height, width = grey.shape
    blocks = grey.reshape(height // BLOCK_PIXELS, BLOCK_PIXELS, width // BLOCK_PIXELS, BLOCK_PIXELS).mean(axis=(1, 3))
    return _centred(blocks).astype(np.float32) if np.ptp(blocks) > 0.0 else None
