"""The image, labels and mask beside a mesh's file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, continuation, continue_image
from tetopt.contents.labels import check_labels
from tetopt.errors import InputError, prefix_errors
from tetopt.geometry.check import filled_fraction
from tetopt.image import Image
from tetopt.job.aligned import (
    Align,
    Beside,
    image_and_others,
    mask_for,
    read_companion,
    read_image,
    read_mask,
    warn_of_other_world,
)
from tetopt.job.events import note
from tetopt.job.mesh_file import table_of_segmentation, warn_of_other_image
from tetopt.job.options import BoxPart, LabelledPart, MaskedPart, stated_part
from tetopt.measure.fidelity import cell_labels
from tetopt.measure.judge import warn_of_other_mask
from tetopt.model.file import (
    MASK_TEXT,
    MeshFile,
)
from tetopt.model.label_names import (
    LABEL_FIELD,
    TABLE_TEXT,
    table_words,
)
from tetopt.system.arrays import Json

FILLED_FRACTION = 1.0 - 1e-6  # of the image's box, by a mesh that was built to fill it
AFFINE_MM = 1e-4  # affines that differ by less are equal: files round them to 32 bits


def read_labels(path: Path, image: Image, part: BoxPart) -> Image:
    """Read the same part of a label image; raise InputError unless it lies on the image's
    voxels.
    """
    labels = read_image(path, replace(part, volume=None))
    if labels.shape != image.shape or not np.allclose(labels.affine, image.affine, atol=AFFINE_MM):
        raise InputError(
            f"{path}: expected labels on the image's grid, {image.shape} with its affine, got "
            f"{labels.shape}; resample them to the image first"
        )
    return check_labels(str(path), labels, is_map=True)


def image_and_labels(
    path: Path, labels_path: Path | None, part: BoxPart
) -> tuple[Image, Image | None]:
    """Read a volume, and labels on its voxels if there are any."""
    image = read_image(path, part)
    if image.ndim != 3:
        raise InputError(f"{path}: expected a volume, got a {image.ndim}-D image")
    return image, None if labels_path is None else read_labels(labels_path, image, part)


def check_part(image: Path | None, part: MaskedPart, labels: Path | None = None) -> None:
    """Raise InputError for options that select the voxels of an image if there is none; labels
    may have a mask.
    """
    needs_image: Json = {**stated_part(part), "registered": part.registered or None}
    needs_image |= {"mask": part.mask, "mask_label": part.mask_label} if labels is None else {}
    if image is None and (
        lost := [name for name, value in needs_image.items() if value is not None]
    ):
        raise InputError(f"`{lost[0]}`: needs `image`")


def stated_files(part: LabelledPart) -> Json:
    """Return the names of the files of labels and mask, if there are any, as numbers state them."""
    files = {"labels": part.labels, "mask": part.mask}
    return {name: path.name for name, path in files.items() if path is not None}


class MeshVoxels(NamedTuple):
    """A mesh's file, and the voxels beside it that count."""

    loaded: MeshFile  # with the labels of an image's voxels, if requested
    content: Content | None  # of the image, if there is one
    is_other: bool  # True if the mesh's file names another image


# reads the mask of the options, as `read_mask` does, once
Masks = Callable[[], dict[tuple[Path, Align], Image]]


def voxels_of(
    loaded: MeshFile,
    mesh: Path,
    image: Path | None,
    part: MaskedPart,
    labels: Path | None = None,
    *,
    fills_box: bool = False,
) -> MeshVoxels:
    """Read the image and the labels beside a mesh's file, without the voxels outside its mask.

    The mesh gets the majority labels of the voxels in its cells. With `fills_box`, the caller
    refuses a mesh that does not fill the image's box.

    Raises
    ------
    InputError
        As for `image_voxels`; the dimension of the labels differs from the mesh's.
    """
    content = None
    is_other = False
    masks = cache(partial(read_mask, part))
    if image is not None:
        content, is_other = image_voxels(loaded, mesh, image, part, masks, fills_box)
    if labels is not None:
        if image is not None:
            warn_of_other_world(image, labels)
        loaded, of_labels = _with_labels(loaded, labels, part, masks)
        if content is None:
            _warn_of_mask(loaded, of_labels, part)
    return MeshVoxels(loaded, content, is_other)


def image_voxels(
    loaded: MeshFile,
    mesh: Path,
    image: Path,
    part: MaskedPart,
    masks: Masks | None = None,
    fills_box: bool = False,
) -> tuple[Content, bool]:
    """Read the image beside a mesh's file, without the voxels outside its mask; True if the file
    names another one.

    The image's box is checked before the mask is read.

    Raises
    ------
    InputError
        As for `mask_for` and `warn_of_other_image`; the dimension of the image differs from the
        mesh's.
    """
    whole = read_image(image, part)
    if whole.ndim != loaded.mesh.ndim:
        raise InputError(
            f"{image}: expected a {loaded.mesh.ndim}-D image like the mesh, got a {whole.ndim}-D "
            "one"
        )
    is_other = warn_of_other_image(loaded, mesh, image, whole, is_registered=part.registered)
    whole, beside, _ = image_and_others(
        whole, image, part, read_mask(part) if masks is None else masks()
    )
    content = _within(whole, part, beside, loaded)
    _warn_of_mask(loaded, content, part)
    is_part = not fills_box and content.own_mask is None
    if is_part and filled_fraction(loaded.mesh, whole) < FILLED_FRACTION:
        note(
            f"{mesh}: has no mask and does not fill the image's box: cells at its boundary count "
            "voxels outside, too; pass `mask`"
        )
    return content, is_other


def _warn_of_mask(loaded: MeshFile, counted: Content, part: MaskedPart) -> None:
    if part.mask is not None and MASK_TEXT not in loaded.field_data:
        warn_of_other_mask(loaded.mesh, counted.own_mask)


def _within(image: Image, part: MaskedPart, beside: Beside, loaded: MeshFile) -> Content:
    """Return an image as given, and continued beyond the mask of the voxels that count for a
    mesh's file.
    """
    mask = mask_for(part, image, beside, loaded)
    beyond = None if mask is None else continuation(mask, image.spacing)
    return Content(continue_image(image, beyond), continuation=beyond, whole=image)


def _with_labels(
    loaded: MeshFile, path: Path, part: MaskedPart, masks: Masks
) -> tuple[MeshFile, Content]:
    """Return the mesh with the majority labels of an image's voxels, instead of the file's, and
    these voxels.
    """
    labels = check_labels(str(path), read_companion(path, part.spacing_mm), is_map=True)
    if labels.ndim != loaded.mesh.ndim:
        raise InputError(
            f"{path}: expected {loaded.mesh.ndim}-D labels like the mesh, got a {labels.ndim}-D "
            "image"
        )

    def beside(other: Path, aligned: Align) -> Image:
        return aligned(masks()[other, aligned], labels, str(other))

    with prefix_errors(path):
        counted = _within(labels, part, beside, loaded)
        fields = {**loaded.cell_data, LABEL_FIELD: cell_labels(counted.image, loaded.mesh)}
    own = table_of_segmentation(path)
    texts: Json = {TABLE_TEXT: table_words(own)} if own.names else {}
    inputs = {
        name: each
        for name, each in loaded.table("inputs").items()
        if name not in ("kept_labels", "filled_holes")
    }
    # of the labels that these replace
    texts |= {"inputs": inputs} if inputs else {}
    field_data = loaded.field_data | {
        name: np.array([json.dumps(words)]) for name, words in texts.items()
    }
    return loaded._replace(cell_data=fields, field_data=field_data), counted


def cell_field(loaded: MeshFile, path: Path, name: str) -> NDArray:
    """Return a field of a mesh's file, one number per cell; raise InputError with the known
    fields if it is missing.
    """
    known = [each for each, values in loaded.cell_data.items() if values.ndim == 1]
    if name not in known:
        raise InputError(f'{path}: has no cell field "{name}"; it has {", ".join(known) or "none"}')
    return loaded.cell_data[name]
