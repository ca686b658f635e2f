"""Resample masks, labels and further contrasts to an image's voxels, and separate foreground from
background.

Two files of one patient need not share their voxels, only the world: they are matched by their
affines, never by their shapes. The domain of a grid is the box of its voxels, from index -0.5 to
shape - 0.5.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.contents.labels import BACKGROUND_LABEL, check_labels, warn_of_absent
from tetopt.contents.memberships import finer_affine
from tetopt.contents.otsu import class_thresholds
from tetopt.errors import InputError, warn
from tetopt.geometry.box import box_sides
from tetopt.image import Image, transform_vectors
from tetopt.system.arrays import Bools, Floats, Ints

# two grids whose corners differ by no more are the same: headers hold single precision
SAME_GRID_VOXELS = 1e-4
SAME_BOX_VOXELS = 1.01  # the same of boxes: resampling rounds a box to whole voxels
LEAST_COVERED_FRACTION = 0.5  # of the image's voxel centres, which a further contrast must cover
LEAST_DARKER = 0.1  # of dark voxels: a CT's air beside a constant of -1000 has .24, an organ none
# Hounsfield units: air has -1000, lungs more than this, below which they count as emphysema
CT_AIR_BELOW = -950.0
# of the background's noise above its median, up to which voxels count as background
BACKGROUND_SIGMAS = 4.0
MAD_TO_SIGMA = 1.4826  # sigma of a normal distribution over its median absolute deviation
COARSER_STEP = 1e-3  # of a voxel by which one may exceed another's size and count as equal
LOST_FRACTION = 0.1  # of a label's volume, whose loss in resampling is reported
# times its connected components, above which a label's pieces after resampling are reported
PIECES_FACTOR = 2
REPORTED_LABELS = 5  # those that keep the least
SMALL_COMPONENT_FRACTION = 0.01  # of the largest component's voxels: smaller components are ignored
SUSPECT_VOXELS = 200  # of a bright piece: a larger one is hardly noise
KEEP_PIECES = "`labels` keep what they number; a `mask` replaces the rule"
# of the voxels: a background or foreground found without a level must have more
LEAST_CLASS_FRACTION = 0.001


def resample_mask(mask: Image, image: Image, name: str = "mask") -> Image:
    """Resample a mask to the image's voxels by nearest neighbour; 0 outside its box.

    Parameters
    ----------
    mask : Image
        Either two values, 0 and another above 0 (bool, 0 and 255), or fractions in [0, 1], a
        probability map whose border is the level 0.5. A single value above 0 is a mask, too: the
        whole box.
    image : Image
        Image with the target voxels.
    name : str, optional
        Name of the mask in messages, for example its file.

    Returns
    -------
    Image
        float32; 0 and 1 for a mask of two values, fractions for a probability map. The image's
        shape and affine.

    Raises
    ------
    InputError
        A number of axes different from the image's, other values, an empty mask, or a mask outside
        the image's box.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> image, fine = phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=2)
    >>> mask = tetopt.resample_mask(tetopt.Image(fine.data == 1, fine.affine), image)
    >>> mask.shape, np.unique(mask.data).tolist()
    ((16, 16, 16), [0.0, 1.0])
    """
    _check_axes(name, mask, image)
    inside = _mask_values(name, mask.with_zeros().data)
    moved = _values_at(Image(inside, mask.affine), image)
    if not (moved >= INSIDE_FRACTION).any():
        if (in_box(image, mask).astype(bool) & (inside >= INSIDE_FRACTION)).any():
            raise InputError(
                f"{name}: the mask is lost between the centres of the image's larger voxels"
            )
        raise InputError(
            f"{name}: the mask lies outside the image's box; {_both_boxes(mask, image)}"
        )
    _warn_of_loss(
        name,
        "the mask",
        Image(inside >= INSIDE_FRACTION, mask.affine),
        Image(moved >= INSIDE_FRACTION, image.affine),
    )
    return Image(moved, image.affine)


def is_in_mask(mask: Image, image: Image, name: str = "mask") -> Bools:
    """Return which of the image's voxels are in a mask as `resample_mask` takes it, whether or not
    all of it is there.
    """
    _check_axes(name, mask, image)
    inside = _mask_values(name, mask.with_zeros().data)
    return _values_at(Image(inside, mask.affine), image) >= INSIDE_FRACTION


def resample_labels(
    labels: Image, image: Image, name: str = "labels", *, may_miss: bool = False
) -> Image:
    """Resample labels to the image's voxels by nearest neighbour; 0 outside their box.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0 to `tetopt.contents.labels.LARGEST_LABEL`, 0 the background; values
        within 1e-3 of these are rounded, with a warning.
    image : Image
        Image with the target voxels.
    name : str, optional
        Name of the labels in messages.
    may_miss : bool, optional
        True if labels may lie outside the image's box on purpose: no warning of these.

    Returns
    -------
    Image
        Whole numbers, with the image's shape and affine.

    Raises
    ------
    InputError
        A number of axes different from the image's, invalid labels, or no label above 0 in the
        image's box.

    Warns
    -----
    UserWarning
        Values were rounded; labels have no voxel in the image's box; labels lose a tenth of their
        volume or fall into pieces, as the image's voxels are larger.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = tetopt.resample_labels(phantom.label_image(voxel_mm=2), phantom.image(voxel_mm=4))
    >>> labels.shape, np.unique(labels.data).tolist()
    ((16, 16, 16), [0.0, 1.0])
    """
    _check_axes(name, labels, image)
    labels = check_labels(name, labels, is_map=True)
    moved = _values_at(labels, image)
    if labels.data.max() == 0:
        raise InputError(
            f"{name}: expected labels above 0, got 0 in every voxel; is it the right file?"
        )
    if moved.max() == 0:
        if (labels.data * in_box(image, labels)).any():
            raise InputError(
                f"{name}: the labels are lost between the centres of the image's larger voxels"
            )
        raise InputError(
            f"{name}: no label above 0 lies in the image's box; {_both_boxes(labels, image)}"
        )
    if not (may_miss or is_same_grid(labels, image)):
        warn_of_absent(f"{name}: ", labels, in_box(image, labels).astype(bool), "image")
    _warn_of_loss(name, "label", labels, Image(moved, image.affine))
    return Image(moved, image.affine)


def divisions(image: Image, others: Iterable[Image]) -> tuple[int, ...]:
    """Return into how many parts along each axis to divide an image's voxels so that none is larger
    than the others'.

    An image's step along an axis is compared with the others' voxels that it passes, whatever their
    directions.
    """
    steps = [np.ones(image.ndim)]
    for other in others:
        passed = np.linalg.inv(other.affine[:-1, :-1]) @ image.affine[:-1, :-1]
        steps.append(np.sqrt((passed**2).sum(axis=0)))
    return tuple(int(k) for k in np.ceil(np.max(steps, axis=0) - COARSER_STEP))


def divide_voxels(image: Image, factors: Sequence[int]) -> Image:
    """Return the image on voxels divided by `factors` along the axes, each part with its voxel's
    value.
    """
    data = image.data
    for axis, factor in enumerate(factors):
        data = np.repeat(data, factor, axis)
    return image if max(factors) == 1 else Image(data, finer_affine(image.affine, factors))


def _warn_of_loss(name: str, word: str, labels: Image, moved: Image) -> None:
    """Warn of labels that vanish on the voxels of `moved`; on larger ones, also of those that lose
    volume or fall into pieces.
    """
    if is_same_grid(labels, moved) or is_same_grid(labels, moved, is_cropped=True):
        return
    inside = np.where(in_box(moved, labels), labels.data, 0.0)
    is_coarser = max(divisions(moved, [labels])) > 1
    lost: list[tuple[float, str]] = []
    for value in np.unique(inside[inside > 0.0]).tolist():
        before, after = inside == value, moved.data == value
        if after.any() and not is_coarser:
            continue
        volume = before.sum() * labels.voxel_volume
        kept = after.sum() * moved.voxel_volume / volume
        n_before, n_after = _n_pieces(before), _n_pieces(after)
        if kept < 1.0 - LOST_FRACTION or n_after > PIECES_FACTOR * n_before:
            which = word if word == "the mask" else f"{word} {value:.10g}"
            words = f"{which} keeps {kept:.0%} of its volume ({volume:.3g} mm{labels.ndim})"
            lost.append((kept, f"{words}, in {n_after} pieces instead of {n_before}"))
    if lost:
        listed = "; ".join(words for _, words in sorted(lost)[:REPORTED_LABELS])
        more = f"; and {len(lost) - REPORTED_LABELS} more" * (len(lost) > REPORTED_LABELS)
        sizes = [" x ".join(f"{edge:.3g}" for edge in each.spacing) for each in (labels, moved)]
        warn(
            f"{name}: resampled from voxels of {sizes[0]} mm to {sizes[1]} mm; {listed}{more}; "
            "resample the image to the finer voxels to keep them"
        )


def _n_pieces(is_in: Bools) -> int:
    """Number of face-connected components."""
    boxes = scipy.ndimage.find_objects(is_in.astype(np.int8))
    return int(scipy.ndimage.label(is_in[boxes[0]])[1]) if boxes else 0


def resample_contrast(other: Image, image: Image, name: str = "contrast") -> Image:
    """Resample a further contrast to the image's voxels: linear by the affines if the grids differ.

    Outside its box the nearest value continues.

    Parameters
    ----------
    other : Image
        Intensities.
    image : Image
        Image with the target voxels.
    name : str, optional
        Name of the contrast in messages.

    Returns
    -------
    Image
        The image's shape and affine.

    Raises
    ------
    InputError
        A number of axes different from the image's, or a box with fewer than half of the image's
        voxel centres.

    See Also
    --------
    content : Combine contrasts on the same voxels.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> t1, t2 = phantom.image(voxel_mm=4), phantom.image(voxel_mm=8)
    >>> tetopt.resample_contrast(t2, t1).shape
    (16, 16, 16)
    """
    _check_axes(name, other, image)
    if is_same_grid(other, image):
        return Image(other.data, image.affine)
    fraction = float(in_box(other, image).mean())
    if fraction < LEAST_COVERED_FRACTION:
        raise InputError(
            f"{name}: expected it to cover at least half of the image's voxels, got "
            f"{100 * fraction:.1f} %; "
            f"{_both_boxes(other, image)}"
        )
    if not other.has_gaps:
        return Image(_resample(other.data, other, image, 1, "nearest"), image.affine)
    # A voxel between one with a value and one without has a value if the former is nearer.
    is_gap = np.isnan(other.data)
    nearest = scipy.ndimage.distance_transform_edt(
        is_gap, other.spacing, return_distances=False, return_indices=True
    )
    moved = _resample(other.data[tuple(nearest)], other, image, 1, "nearest")
    moved[_resample(is_gap.astype(np.uint8), other, image, 0, "nearest") > 0] = np.nan
    return Image(moved, image.affine)


class Foreground(NamedTuple):
    """The foreground of an image, and its small pieces."""

    mask: Image  # float32, 0 and 1
    dropped: Ints  # voxels of each bright piece that is left out, descending
    kept: Ints  # voxels of each dark piece at the box's sides that stays, descending

    @property
    def words(self) -> str:
        """Describe the small pieces by number and volume; empty if there are none."""
        parts = (
            ("bright ones are removed", self.dropped),
            ("dark ones at the box's sides stay", self.kept),
        )
        size, unit = self.mask.voxel_volume, f"mm{self.mask.ndim}"
        words = [
            f"{what}: {len(voxels)}, {voxels.sum() * size:.3g} {unit} in all, the largest "
            f"{voxels[0] * size:.3g} {unit}"
            for what, voxels in parts
            if len(voxels)
        ]
        return f"pieces smaller than 1/100 of the largest: {'; '.join(words)}" if words else ""

    @property
    def is_suspect(self) -> bool:
        """True if a bright piece that is left out is too large for noise."""
        return bool(len(self.dropped) and self.dropped[0] > SUSPECT_VOXELS)


def foreground_mask(image: Image, level: float | None = None, labels: Image | None = None) -> Image:
    """Mask of the foreground, 0 and 1.

    Voxels at or below the level that are connected by faces to the box's sides are removed, so dark
    cavities inside remain. Voxels with a label above 0 always stay. Pieces with less than 1/100 of
    the largest one's voxels are treated as noise: bright ones without a label are removed, too, and
    without labels, dark ones at the box's sides stay, such as vessels, bone and gas cut by a face
    of the box. Pass a label image as `labels`, too, as ``labels=image``.

    Parameters
    ----------
    image : Image
        An image brighter than its background.
    level : float, optional
        `background_level` by default.
    labels : Image, optional
        Whole numbers from 0, on the image's voxels (see `resample_labels`).

    Returns
    -------
    Image
        float32, 0 and 1, the image's shape and affine.

    Raises
    ------
    InputError
        No background (see `background_level`), no foreground, or labels of another shape.

    Warns
    -----
    UserWarning
        A bright piece of more than 200 voxels is removed.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mask = tetopt.foreground_mask(image, 60.0)
    >>> int(mask.data.sum())  # voxels
    504
    >>> result = tetopt.mesh_image(tetopt.content(image, mask=mask), 200, iterations=4)
    >>> dict(result.violated)
    {}
    """
    if labels is not None and labels.shape != image.shape:
        raise InputError(
            f"labels: expected the image's shape {image.shape}, got {labels.shape}; resample "
            "them first"
        )
    front = foreground(image, level, labels)
    if front.is_suspect:
        warn(f"{front.words} ({KEEP_PIECES})")
    return front.mask


def foreground(image: Image, level: float | None = None, labels: Image | None = None) -> Foreground:
    """Find the foreground, and count its small pieces, as `foreground_mask` does."""
    limit = background_level(image) if level is None else float(level)
    is_labelled = np.zeros(image.shape, dtype=bool) if labels is None else labels.data > 0
    dark, sizes = _pieces(~(image.data > limit) & ~is_labelled)  # NaN, no value, is dark
    is_outer = np.zeros(len(sizes), dtype=bool)
    is_outer[_on_faces(dark)] = True
    sizes[~is_outer] = 0
    is_open = sizes >= (1.0 if labels is not None else _least_of(sizes))
    kept = sizes[~is_open]
    bright, sizes = _pieces(~is_open[dark])
    is_kept = sizes >= _least_of(sizes)
    is_kept[bright[is_labelled]] = True
    dropped = sizes[~is_kept]
    is_inside = is_kept[bright]
    fraction = float(is_inside.mean())
    least = LEAST_CLASS_FRACTION if level is None and labels is None else 0.0
    if not least < fraction < 1.0 - least:
        low, high = image.range
        instead = "" if labels is None else "; or give the labels as `mask`, with `mask_label`"
        raise InputError(
            f"`background` {'auto, ' * (level is None)}{limit:.4g}: {100.0 * fraction:.4g} % of "
            "the voxels would be foreground; choose a level between the background's and the "
            f"tissue's values (the image ranges from {low:g} to {high:g}){instead}"
        )
    mask = Image(is_inside, image.affine)
    return Foreground(mask, *(np.sort(voxels[voxels > 0])[::-1] for voxels in (dropped, kept)))


class FilledHoles(NamedTuple):
    """Labels without holes, and the holes."""

    labels: Image
    sizes: Ints  # (H,) voxels of each
    around: Ints  # (H,) the label that most of its faces touch


def fill_holes(labels: Image, label: int) -> FilledHoles:
    """Give a label to the voxels of label 0 that no path through faces of such voxels connects
    to the box's sides.
    """
    data = labels.data
    empty, sizes = _pieces(data == BACKGROUND_LABEL)
    sizes[_on_faces(empty)] = 0
    is_hole = sizes > 0
    is_inside = is_hole[empty]  # never at the box's sides, across which voxels would be rolled
    beside = [np.roll(data, step, axis)[is_inside] for axis in range(data.ndim) for step in (-1, 1)]
    touching = [np.column_stack([empty[is_inside], labels_there]) for labels_there in beside]
    pairs, counts = np.unique(np.concatenate(touching), axis=0, return_counts=True)
    pairs = pairs[np.lexsort([counts * (pairs[:, 1] != BACKGROUND_LABEL), pairs[:, 0]])]
    around = pairs[np.flatnonzero(np.diff(pairs[:, 0], append=-1)), 1]  # the last row of each hole
    dtype = np.result_type(data, np.min_scalar_type(label))
    filled = np.where(is_inside, np.array(label, dtype=dtype), data)
    return FilledHoles(Image(filled, labels.affine), sizes[is_hole], around.astype(np.int64))


def background_level(image: Image) -> float:
    """The highest intensity of the background, estimated on the faces of the box.

    Voxels on the faces that are darker than Otsu's threshold of the whole image are mostly
    background, although a face may cut the body. The level is their median plus 4 sigma, with sigma
    from the median absolute deviation, which is robust against body on the faces (Hampel, The
    influence curve and its role in robust estimation, JASA 69, 1974). The level of a constant
    background, as around an extracted brain, is its value; if a tenth of the other dark voxels are
    darker, or half are air of a CT, as beside padding, their level counts.

    Raises
    ------
    InputError
        The faces have no dark voxels, or these are not distinct: the level is not below Otsu's
        threshold.
    """
    low, high = image.range
    values = _on_faces(image.data)
    if 2 * np.count_nonzero(np.isnan(values)) > len(values):  # the background has no values
        return float(np.nextafter(image.data.dtype.type(low), -np.inf))
    if low == high:
        raise _no_background(f"every voxel has the value {low:g}")
    try:
        data = image.data.ravel()
        (threshold,) = class_thresholds(data[~np.isnan(data)] if image.has_gaps else data, 2)
    except InputError as error:
        raise _no_background(str(error)) from error
    dark = values[values <= threshold].astype(np.float64)
    if len(dark) == 0:
        raise _no_background(f"no voxel on the faces of the box is dark ({threshold:.4g} or less)")
    middle = np.median(dark)
    spread = np.median(np.abs(dark - middle))
    if spread == 0.0:
        others = image.data[(image.data <= threshold) & (image.data != middle)].astype(np.float64)
        of_others = np.median(others) if len(others) else np.inf
        n_darker = np.count_nonzero(others < middle)
        if n_darker > LEAST_DARKER * len(others) or of_others < CT_AIR_BELOW:
            middle, spread = of_others, np.median(np.abs(others - of_others))
    level = float(middle + BACKGROUND_SIGMAS * MAD_TO_SIGMA * spread)
    if level >= threshold:
        raise _no_background(
            f"the dark voxels on the faces of the box range up to {level:.4g}, which is not "
            "below the threshold "
            f"between dark and bright, {threshold:.4g}"
        )
    return level


def _no_background(reason: str) -> InputError:
    return InputError(
        f"`background` auto: no background found, as {reason}; give a value or omit `background`"
    )


def _check_axes(name: str, other: Image, image: Image) -> None:
    if other.ndim != image.ndim:
        raise InputError(
            f"{name}: expected {image.ndim} axes like the image's {image.shape}, got shape "
            f"{other.shape}; select one "
            "volume or slice"
        )


def _mask_values(name: str, data: NDArray[np.floating]) -> NDArray[np.float32]:
    """0 and 1, or fractions, as float32; raise InputError for an invalid or empty mask."""
    top = data.max()
    is_top = data == top
    if top > 0 and (is_top | (data == 0)).all():
        return is_top.astype(np.float32)
    if data.min() < 0 or top > 1:
        values = np.unique(data)
        some = ", ".join(f"{value:g}" for value in values[:5]) + (
            ", ..." if len(values) > 5 else ""
        )
        raise InputError(
            f"{name}: expected a mask (0 and one other value, or fractions from 0 to 1), got "
            f"{len(values)} values from "
            f"{values[0]:g} to {values[-1]:g} ({some}); choose labels with `mask_label`, or "
            "convert it to 0 and 1"
        )
    if top < INSIDE_FRACTION:
        largest = "0 in every voxel" if top == 0 else f"fractions up to {top:g}"
        raise InputError(
            f"{name}: the mask is empty: expected voxels of {INSIDE_FRACTION} or more, got "
            f"{largest}"
        )
    return data.astype(np.float32)


def _values_at(other: Image, image: Image) -> NDArray[np.floating]:
    """Values of `other` at the image's voxel centres: those of the voxels that contain them, 0
    outside.
    """
    return (
        other.data
        if is_same_grid(other, image)
        else _resample(other.data, other, image, 0, "grid-constant")
    )


def is_same_grid(other: Image, image: Image, *, is_cropped: bool = False) -> bool:
    """True if two images have the same voxels, to 1e-4 voxel; a cropped image has a part of the
    other's.
    """
    corners = _corners(image)
    offset = other.to_index(image.to_world(corners)) - corners
    start = np.rint(offset[0]) if is_cropped else np.zeros(image.ndim)
    is_within = bool((start >= 0.0).all() and (start + image.shape <= other.shape).all())
    return (is_within if is_cropped else other.shape == image.shape) and bool(
        np.abs(offset - start).max() <= SAME_GRID_VOXELS
    )


def other_box(grid: Any, image: Image, tolerance: float = SAME_BOX_VOXELS) -> str:
    """Return "A mm, got B mm", the extents of a grid's box and an image's, if these are different
    boxes, else "".

    The grid is an image, or a `Box`. Corners of the same box agree to `tolerance` voxels of the
    coarser one, in any order of the axes.
    """
    # the grid's, voxels
    steps = np.abs(np.linalg.inv(image.affine[:-1, :-1]) @ grid.affine[:-1, :-1]).max(axis=1)
    off = np.abs(image.to_index(_world_corners(grid))[..., None] - box_sides(image.shape))
    is_near = off <= tolerance * np.maximum(steps, 1.0)[:, None]
    return "" if is_near.any(axis=-1).all() else f"{_extent(grid)} mm, got {_extent(image)} mm"


def in_box(other: Image, image: Image) -> NDArray[np.uint8]:
    """1 at the image's voxel centres in the box of `other`, else 0, in the image's shape."""
    return _resample(np.ones(other.shape, dtype=np.uint8), other, image, 0, "grid-constant")


def _resample(data: NDArray, other: Image, image: Image, order: int, mode: str) -> NDArray:
    """`data`, on the grid of `other`, at the image's voxel centres.

    scipy's mode `grid-constant` fills a grid's outer half voxels from their own voxels; `constant`
    leaves them out.
    """
    n = image.ndim
    corner = other.to_index(image.to_world(np.vstack([np.zeros(n), np.eye(n)])))
    matrix, offset = (corner[1:] - corner[0]).T, corner[0]
    # on a grid shifted by half a voxel, all centres halfway between two voxels go to the upper one
    if order == 0:
        offset = offset + SAME_GRID_VOXELS
    return scipy.ndimage.affine_transform(
        data, matrix, offset, image.shape, data.dtype, order=order, mode=mode
    )


def _corners(grid: Any) -> Floats:
    """The corners of a grid's box, (2^n, n) indices."""
    return np.array(list(product(*box_sides(grid.shape))))


def _both_boxes(other: Image, image: Image) -> str:
    return (
        f"it spans {_extent(other)} mm, the image {_extent(image)} mm: do both use the same "
        "world coordinates?"
    )


def _world_corners(grid: Any) -> Floats:
    return transform_vectors(_corners(grid), grid.affine[:-1, :-1]) + grid.affine[:-1, -1]


def _extent(grid: Any) -> str:
    world = _world_corners(grid)
    low, high = world.min(axis=0), world.max(axis=0)
    decimals = max(1, 1 - int(np.floor(np.log10((high - low).min()))))  # more in micro-CT
    return " x ".join(f"{a:.{decimals}f}..{b:.{decimals}f}" for a, b in zip(low, high, strict=True))


def _on_faces(data: NDArray) -> NDArray:
    """The values of the voxels on all faces of the box, one face after the other."""
    return np.concatenate(
        [data.take(end, axis).ravel() for axis in range(data.ndim) for end in (0, -1)]
    )


def _pieces(is_in: Bools) -> tuple[NDArray[np.int32], Ints]:
    """Face-connected components, numbered from 1, and the number of voxels of each; 0 of the
    rest.
    """
    pieces, _ = scipy.ndimage.label(is_in)
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    return pieces, sizes


def _least_of(sizes: Ints) -> float:
    """The least number of voxels of a component that is not far smaller than the largest."""
    return max(1.0, SMALL_COMPONENT_FRACTION * float(sizes.max()))
