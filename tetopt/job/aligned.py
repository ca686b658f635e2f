"""Images of a run, and other files on their voxels."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tetopt.contents.align import (
    divide_voxels,
    divisions,
    in_box,
    is_same_grid,
    other_box,
    resample_contrast,
    resample_mask,
)
from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.contents.labels import check_labels
from tetopt.contents.probabilities import resample_tissue
from tetopt.energy.sampling import mask_of_values
from tetopt.errors import InputError, Remark, prefix_errors
from tetopt.image import Image
from tetopt.io.images import load_image, parse_crop, parse_slice, part_of, reader_of
from tetopt.io.read_dicom import frame_of_reference
from tetopt.io.stacks import parse_spacing
from tetopt.io.text import list_names
from tetopt.job.events import note, warning
from tetopt.job.mesh_file import label_table
from tetopt.job.option_values import file_and_volume
from tetopt.job.options import BoxPart, ImagePart, MaskedPart, SourceOptions
from tetopt.model.file import MeshFile, count_of_other_voxels, own_mask
from tetopt.model.label_names import label_words, labels_named
from tetopt.system.arrays import Shape

# of a mask's or labels' voxels: grids' differences do not explain more outside the image
OUTSIDE_FRACTION = 0.02
# voxels, chosen: a run with labels takes 300 bytes per voxel, so up to 20 GB
MOST_DIVIDED = 2**26
MASK_LABELS_LISTED = 20  # in a message

Align = Callable[[Image, Image, str], Image]
Beside = Callable[[Path, Align], Image]
Originals = Mapping[tuple[Path, Align], Image]


def read_image(path: Path, part: BoxPart) -> Image:
    """Read the part of an image that the options select."""
    slice_ = part.slice_ if isinstance(part, ImagePart) else None
    return load_image(
        path,
        volume=part.volume,
        slice_=None if slice_ is None else parse_slice(slice_),
        crop=None if part.crop is None else parse_crop(part.crop),
        spacing_mm=None if part.spacing_mm is None else parse_spacing(part.spacing_mm),
    )


class Aligned(NamedTuple):
    """An image, and a function that reads other files and aligns them to it."""

    image: Image
    beside: Beside
    factors: Shape  # parts of the file's voxels along each axis


def image_and_others(image: Image, path: Path, part: ImagePart, originals: Originals) -> Aligned:
    """Divide the voxels of an image, the selected part of its file, to the size of the finest of
    labels and mask.
    """
    # A slice has no position across its plane: other files are aligned to the whole image, then
    # sliced.
    slice_ = None if part.slice_ is None else parse_slice(part.slice_)
    whole = coarse = (
        image if slice_ is None else read_image(path, replace(part, slice_=None, crop=None))
    )
    crop = None if part.crop is None else parse_crop(part.crop)
    finer = {other: each for (other, _), each in originals.items()}
    factors = _divisions(whole, finer, None if slice_ is None else slice_[0])
    if max(factors) > 1:
        whole = divide_voxels(whole, factors)
        if crop is not None:
            crop = [
                (None if a is None else a * f, None if b is None else b * f)
                for (a, b), f in zip(crop, factors, strict=True)
            ]
        image = whole if slice_ is None else part_of(whole, slice_, crop)

    def beside(other: Path, aligned: Align) -> Image:
        original = originals.get((other, aligned)) or read_companion(other, part.spacing_mm)
        warn_of_other_world(path, other)
        # A contrast is divided like the image, so that on the same voxels it keeps its values.
        grid = coarse if aligned is resample_contrast else whole
        moved = aligned(original, grid, str(other))
        moved = divide_voxels(moved, factors) if aligned is resample_contrast else moved
        is_cropped = slice_ is None and crop is not None
        if not is_same_grid(original, grid, is_cropped=is_cropped):
            is_linear = aligned in (resample_contrast, resample_tissue)
            _say_resampled(
                other, original, moved, coarse.shape, is_contrast=is_linear, is_cropped=is_cropped
            )
        return moved if slice_ is None else part_of(moved, slice_, crop)

    if slice_ is not None:
        factors = tuple(factor for axis, factor in enumerate(factors) if axis != slice_[0])
    return Aligned(image, beside, factors)


def warn_of_other_world(path: Path, other: Path) -> None:
    """Warn of two DICOM files whose positions are in different frames of reference."""
    one = frame_of_reference(file_and_volume(other)[0])
    two = None if one is None else frame_of_reference(path)
    if two is not None and one != two:
        warning(
            f"{other}: its positions are in another frame of reference than those of {path} "
            f"({one}, not {two}): the "
            "patient may have been moved between them; register it to the image first"
        )


def _divisions(image: Image, others: Mapping[Path, Image], across: int | None) -> Shape:
    """Return the parts of the image's voxels along each axis, with a message; fewer if there
    would be more than `MOST_DIVIDED`.

    Voxels are not divided along the axis `across` a slice.
    """
    finer = {path: other for path, other in others.items() if other.ndim == image.ndim}
    needed = [1 if axis == across else k for axis, k in enumerate(divisions(image, finer.values()))]
    factors = list(needed)
    while max(factors) > 1 and prod((*image.shape, *factors)) > MOST_DIVIDED:
        factors[int(np.argmax(factors))] -= 1
    if max(needed) > 1:
        names = list_names(
            [path for path, other in finer.items() if max(divisions(image, [other])) > 1]
        )
        note(
            f"{names}: finer than the image, whose voxels are divided by {_times(factors)}"
            + (
                f" instead of {_times(needed)}, for at most {MOST_DIVIDED} voxels"
                * (factors != needed)
            )
        )
    return tuple(factors)


def _times(factors: Sequence[int]) -> str:
    return " x ".join(map(str, factors))


def _say_resampled(
    path: Path,
    original: Image,
    moved: Image,
    shape: Shape,
    *,
    is_contrast: bool,
    is_cropped: bool,
) -> None:
    """Report that a file was resampled; warn of a mask or labels that seem to be of another scan.

    These are cut by the image's box, though the image is no crop of them, or have its own `shape`,
    before it was divided, and its directions in another place. Labels of FreeSurfer have their own
    directions.
    """
    note(
        f"{path}: resampled to the image's grid "
        f"({'linear' if is_contrast else 'nearest neighbour'})"
    )
    if is_contrast or is_cropped or is_same_grid(original, moved, is_cropped=True):
        return
    outside = 1.0 - float(
        in_box(moved, original)[original.data >= min(INSIDE_FRACTION, original.data.max())].mean()
    )
    cosines = [(each.affine[:-1, :-1] / each.spacing) for each in (original, moved)]
    is_alike = original.shape == shape and bool((np.prod(cosines, axis=0).sum(axis=0) > 0.5).all())
    is_moved = is_alike and bool(other_box(original, moved))
    if is_moved or outside > OUTSIDE_FRACTION:
        warning(
            f"{path}: {outside:.1%} of it lies outside the image; its box covers "
            f"{in_box(original, moved).mean():.1%} "
            f"of the image ({'same shape, ' * is_moved}different affine); is it from the same scan?"
        )


def read_companion(path: Path, spacing_mm: str | None = None, *, is_grid: bool = False) -> Image:
    """Read another file with the image, without the warning for a constant image, which sizes or a
    mask may be.

    Voxel sizes are for a stack or folder of slices; files of other formats have their own. Only the
    voxels of a grid count, which are those of any volume.
    """
    file, volume = file_and_volume(path)
    if is_grid and volume is None and reader_of(file).has_spacing:
        volume = 0
    spacing = None
    if spacing_mm is not None and not reader_of(file).has_spacing:
        spacing = parse_spacing(spacing_mm)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Remark)
        return load_image(file, volume=volume, spacing_mm=spacing)


def mask_for(
    options: MaskedPart | SourceOptions, image: Image, beside: Beside, loaded: MeshFile | None
) -> Image | None:
    """Read the mask of an image's voxels that count: the options', else the one that a mesh's file
    was built within, else of those with values.

    Warn if the two differ.

    Raises
    ------
    InputError
        The mask cannot be read, or is needed.
    """
    if options.mask is None:
        read_mask(options)
        if loaded is None:
            return None
        return own_mask(loaded, image) or mask_of_values(image, loaded.mesh)
    mask = beside(options.mask, resample_mask)
    if loaded is not None and (n_other := count_of_other_voxels(loaded, mask)):
        warning(
            f"{options.mask}: differs in {n_other} voxels from the mask that the mesh was built "
            "within"
        )
    return mask


def read_mask(
    options: MaskedPart | SourceOptions, names_of: Path | None = None
) -> dict[tuple[Path, Align], Image]:
    """Read the options' mask, of the voxels with `mask_label` if given, for `image_and_others`;
    none without one.

    Names of labels are those of the table `names_of`, or else of the mask's own file.

    Raises
    ------
    InputError
        The file cannot be read; it does not have a label, or its table a name.
    """
    path = options.mask
    words = options.mask_label
    if path is None:
        if words is not None:
            raise InputError("`mask_label`: needs `mask`")
        return {}
    mask = read_companion(path, getattr(options, "spacing_mm", None))
    if words is None:
        return {(path, resample_mask): mask}
    mask = check_labels(str(path), mask, is_map=True)
    names = label_table(names_of, labels_path=path).names
    present = np.unique(mask.data).astype(np.int64)
    chosen = list[int]()
    for word in words.split(","):
        with prefix_errors("`mask_label`"):
            labels = labels_named(word, names)
        if not np.isin(labels, present).any():
            listed_words = list_names(
                [label_words(label, names) for label in present.tolist()], MASK_LABELS_LISTED
            )
            raise InputError(
                f'`mask_label`: {path} has no voxel with label "{word.strip()}"; it has '
                f"{listed_words}"
            )
        chosen += labels
    return {(path, resample_mask): Image(np.isin(mask.data, chosen), mask.affine)}
