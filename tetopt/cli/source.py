"""What `tetopt mesh` meshes: contrasts, labels and mask, on the voxels of the first image."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tetopt import Image, InputError
from tetopt.cli.console import log
from tetopt.cli.inputs import file_and_volume, image_and_others
from tetopt.io.images import sha256
from tetopt.target.align import aligned_contrast, aligned_labels, aligned_mask, background_level, foreground
from tetopt.target.content import Content, content


class Source(NamedTuple):
    """What is meshed, and the files that it comes from."""

    paths: list[Path]  # of the contrasts
    wanted: Content
    contrasts: list[Image]  # on the first one's voxels
    labels: Image | None  # likewise
    mask: Image | None
    about: dict[str, Any]  # names, checksums and weights


def read_source(
    paths: list[Path], volume: int | None, crop: str | None, slice_: str | None, mask_path: Path | None,
    background: str | None, labels_path: Path | None, weights: str | None, label_weight: float | None,
) -> Source:  # fmt: skip
    """Images, labels and mask as the options ask for them, on the voxels of the first image."""
    if mask_path is not None and background is not None:
        raise InputError("--mask and --background: give one of them")
    if label_weight is not None and labels_path is None:
        raise InputError("--label-weight: there are no --labels")
    image, beside = image_and_others(paths[0], volume, crop, slice_)
    contrasts = [image, *(beside(path, aligned_contrast) for path in paths[1:])]
    labels = None if labels_path is None else beside(labels_path, aligned_labels)
    mask = None if mask_path is None else beside(mask_path, aligned_mask)
    level = None
    if background is not None:
        level = background_level(image) if background == "auto" else _number("--background", background)
        mask = foreground(image, level)
        log.print(
            f"background: up to {level:g}, as far as it reaches the box; {mask.data.mean():.1%} of the voxels are left"
        )
    counts = [1.0] * len(paths) if weights is None else [_number("--weights", part) for part in weights.split(",")]
    if weights is None and labels is not None and len(paths) == 1 and np.array_equal(labels.data, image.data):
        log.print("the image is its own labels: only these count")
        counts = [0.0]
    wanted = content(
        contrasts, labels, mask, weights=counts, label_weight=1.0 if label_weight is None else label_weight
    )
    about: dict[str, Any] = {"image": paths[0].name, "image_sha256": sha256(paths[0])}
    files = [*paths[1:], *(path for path in (mask_path, labels_path) if path is not None)]
    about["inputs"] = {
        "images": [path.name for path in paths], "weights": counts,
        "mask": None if mask_path is None else mask_path.name, "background": level,
        "labels": None if labels_path is None else labels_path.name,
        "label_weight": None if labels is None else label_weight,
        "sha256": {path.name: sha256(file_and_volume(path)[0]) for path in files},
    }  # fmt: skip
    return Source(paths, wanted, contrasts, labels, mask, about)


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f'{name}: expected a number, got "{text}"') from None
