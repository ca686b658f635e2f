"""The content of a mesh: one or several contrasts, labels and a mask on the voxels of one image.

E_D of Eq. (3) is summed over channels: the intensities of each contrast, and for each label a
channel that is 1 within it (one-hot), so that a cell with one value in all channels is one tissue.
Weights scale the channels: with weight 1, a channel's variance over the domain counts as much as
the first image's.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.domain import INSIDE_FRACTION, Region, region_of
from tetopt.contents.labels import BACKGROUND_LABEL, check_labels, label_channels, warn_of_absent
from tetopt.contents.memberships import (
    Memberships,
    finer,
    memberships,
    memberships_of,
    number_labels,
    supersampling,
)
from tetopt.contents.noise import noise_level
from tetopt.errors import InputError
from tetopt.image import Image, check_image
from tetopt.system.arrays import Bools, Floats, Ints

RARITY_POWER = 0.5  # exponent of a label's fraction of the voxels by which its voxels count less
SAME_PLACE_VOXELS = 1e-2  # voxel centres no farther apart coincide
STEPS_PER_SIGMA = 256.0  # least number of integer steps in a contrast's standard deviation
WEIGHT_RANGE = 1e-3, 1e3  # the least and largest weight other than 0
# margin around a mask: the reach of surface smoothing and of cells on the surface
MARGIN_VOXELS = 4
# weight of a voxel on the wrong side of the region's surface, in variances
WRONG_SIDE_VARIANCES = 4.0
# sums of squares along a row stay below this limit, so that 32 bits hold them exactly
ROW_SUM_LIMIT = 2.0**31


class Continuation(NamedTuple):
    """Source of the values beyond a mask's surface; made by `continuation`."""

    part: tuple[slice, ...]  # the voxels around the mask
    inside: Bools  # those that lie in it
    # (K,) flat index of the nearest voxel inside, for each one outside in C order
    nearest: NDArray[np.integer]


class Spread(NamedTuple):
    """Spread of an image's intensities."""

    mean: float
    low: float
    high: float
    variance: float


class SmoothLabels(NamedTuple):
    """Labels with smooth interfaces."""

    memberships: Memberships
    own_channel: Ints  # (K,) channel of each label
    own_value: NDArray[np.int32]  # (K,) value of its voxels in that channel
    keeps_volumes: bool  # True if labels thinner than cells keep their volume


class Content(NamedTuple):
    """The content that a mesh represents; made by `content`.

    Parameters
    ----------
    image : Image
        The voxels and the first contrast, restricted to the surroundings of the mask and divided if
        slices are thick.
    contrasts : (I, s_0, ..., s_{n-1}) array, optional
        Values that should be constant in a cell, in one unit, as whole numbers: a channel for each
        contrast. By default the image's intensities, which then are the only channel.
    rows : (s_0, ..., s_{n-1}) int, optional
        Number of each voxel's label.
    codes : (L, K) int32, optional
        Values of the labels in further channels, in the same unit.
    unit : float
        Squared intensity of the image that corresponds to a squared value of 1 in the channels.
    region : Region or None
        The region to cover; None for the image's box.
    continuation : Continuation, optional
        Continuation beyond the region's mask; see `tetopt.contents.content.continue_image`.
    smooth : SmoothLabels, optional
        Labels with smooth interfaces.
    keeps_components : bool
        Keep connected components of a mesh that the mask does not have.
    whole : Image, optional
        The first contrast as given, if `image` is another: a part of it, with other values beyond
        the mask, or divided.
    repeats : tuple of int
        Number of voxels along each axis that repeat one of the image's file; empty if none does.
    is_flat : bool
        Facets stay flat, so that nodes on a surface lie off it by what facets cut off. False for
        order 2: curved facets cut nothing off, and their corners lie on the surface.
    squared_spread : float, optional
        The variance of several channels, or within a region, once it is known: a pass over all
        voxels of each channel.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> what = tetopt.content(phantom.image(voxel_mm=4), labels)
    >>> what.n_voxels, what.n_contrasts, what.region is None
    (4096, 1, True)
    """

    image: Image
    contrasts: NDArray[np.int32] | None = None
    rows: NDArray[np.integer] | None = None
    codes: NDArray[np.int32] | None = None
    unit: float = 1.0
    region: Region | None = None
    continuation: Continuation | None = None
    smooth: SmoothLabels | None = None
    keeps_components: bool = False
    whole: Image | None = None
    repeats: tuple[int, ...] = ()
    is_flat: bool = True
    squared_spread: float | None = None

    @property
    def given(self) -> Image:
        """The first contrast as given."""
        return self.image if self.whole is None else self.whole

    @property
    def own(self) -> Image:
        """The first contrast on its own voxels, continued beyond the mask, around which alone
        voxels are kept.
        """
        return continue_image(self.given, None if self.whole is None else self.continuation)

    @property
    def own_mask(self) -> Image | None:
        """The mask on the voxels of `own`, 0 and 1; None for the image's box."""
        return (
            None if self.continuation is None else Image(self.continuation.inside, self.own.affine)
        )

    @property
    def memberships(self) -> Memberships | None:
        """Levels of the labels with smooth interfaces, if any."""
        return None if self.smooth is None else self.smooth.memberships

    @property
    def is_plain(self) -> bool:
        """True if the image's intensities are the only channel."""
        return self.contrasts is None

    @property
    def n_contrasts(self) -> int:
        """Number of leading channels that are images, not labels."""
        return 1 if self.contrasts is None else len(self.contrasts)

    @property
    def n_channels(self) -> int:
        """Number of channels."""
        return self.n_contrasts + (0 if self.codes is None else len(self.codes))

    def channel(self, number: int, part: tuple[slice, ...] = ()) -> NDArray:
        """One channel, or a part of it; those of labels are computed on demand.

        Parameters
        ----------
        number : int
            From 0 to `n_channels` - 1: first the contrasts.
        part : tuple of slice
            Part of the voxels; all by default.

        Returns
        -------
        (s_0, ..., s_{n-1}) array
            The values, of int32 unless the image's intensities are the only channel.

        Examples
        --------
        >>> phantom = tetopt.load_phantom("sphere")
        >>> what = tetopt.content(phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=4))
        >>> [len(np.unique(what.channel(number))) for number in range(what.n_channels)]
        [10, 2, 2]
        """
        if self.contrasts is None:
            return self.image.data[part]
        if self.rows is None or self.codes is None or number < self.n_contrasts:
            return self.contrasts[number][part]
        return self.codes[number - self.n_contrasts][self.rows[part]]

    @property
    def inside(self) -> Bools | None:
        """Mask of the voxels to cover; None for all."""
        return None if self.region is None else self.region.inside

    @property
    def n_voxels(self) -> int:
        """Number of voxels to cover."""
        return prod(self.image.shape) if self.region is None else int(self.region.inside.sum())

    @property
    def volume(self) -> float:
        """Volume to cover, mm^n."""
        return self.n_voxels * self.image.voxel_volume

    @property
    def variance(self) -> float:
        """Variance of all channels over the voxels to cover, intensity^2; times `volume` it is
        E_D of a single cell.
        """
        if self.is_plain and self.region is None:
            return self.image.variance
        if self.squared_spread is not None:
            return self.squared_spread
        return self.unit * sum(
            _variance(self.channel(number), self.region) for number in range(self.n_channels)
        )

    @property
    def spread(self) -> Spread:
        """Spread of the first contrast's intensities over its own voxels to cover."""
        if self.continuation is None:
            return Spread(self.given.mean, *self.given.range, self.given.variance)
        around = () if self.whole is None else self.continuation.part
        h = self.given.data[around][self.continuation.inside]
        return Spread(
            float(h.mean(dtype=np.float64)), float(h.min()), float(h.max()), _variance(h, None)
        )

    @property
    def wrong_side(self) -> float:
        """Penalty of a voxel on the wrong side of the region's surface, in squared units of the
        channels.
        """
        return WRONG_SIDE_VARIANCES * (self.variance / self.unit or 1.0)

    @property
    def noise(self) -> float:
        """Variance of the contrasts' noise, in the unit of the channels; labels have none."""
        inside = None if self.inside is None else undivide_voxels(self, self.inside)
        contrasts = map(self.channel, range(self.n_contrasts))
        return float(
            sum(noise_level(undivide_voxels(self, values), inside) ** 2 for values in contrasts)
        )


def content(
    images: Image | Sequence[Image],
    labels: Image | None = None,
    mask: Image | None = None,
    *,
    weights: Sequence[float] | None = None,
    label_weight: float = 1.0,
    smooth_interfaces: bool = True,
    keep_components: bool = False,
    keep_volumes: bool = True,
) -> Content:
    """Combine contrasts, labels and a mask for `mesh_image`, `octree_mesh` or `optimize`.

    Parameters
    ----------
    images : Image or sequence of Image
        Contrasts, all on the voxels of the first (`tetopt.contents.align` resamples them).
    labels : Image, optional
        Whole numbers from 0, on the same voxels.
    mask : Image, optional
        0 to 1 on the same voxels: the mesh covers the region of values of 0.5 or more, and its
        boundary follows that region's surface (`tetopt.contents.domain`). Outside, images and
        labels continue with the nearest value inside, so that values beyond the surface are
        ignored.
    weights : sequence of float, optional
        Weight of each image, 0.001 to 1000, 1 by default; 0 ignores an image. With weight 1 its
        variance counts as much as the first image's, whatever its scale.
    label_weight : float
        Weight of all labels together. Voxels of rare labels count more.
    smooth_interfaces : bool
        Labels are smooth between voxels (`tetopt.contents.memberships`), which are divided if
        slices are thick, and nodes between labels lie on their interfaces. If False, labels keep
        their stairs, and each cell gets the label of most of its voxels.
    keep_components : bool
        Keep connected components of the mesh that the mask does not have. By default small ones are
        dropped.
    keep_volumes : bool
        Preserve the volume of labels that are thinner than cells by giving them cells that other
        labels fill more. If False, they lose volume.

    Returns
    -------
    Content
        Input for `mesh_image`, `octree_mesh` or `optimize`, in place of an image.

    Raises
    ------
    InputError
        A voxel that counts has no value; images of different shapes, invalid weights, labels that
        are not whole numbers from 0, or only images and labels of weight 0.

    See Also
    --------
    resample_contrast, resample_labels, resample_mask : Resample images on other voxels.
    tissue_labels : Labels from tissue probabilities.
    foreground_mask : Mask of the foreground.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> t1, t2 = phantom.image(voxel_mm=4), phantom.image(voxel_mm=4, noise_sd=5)
    >>> what = tetopt.content([t1, t2], phantom.label_image(voxel_mm=4), weights=[1, 0.5])
    >>> result = tetopt.mesh_image(what, 300, iterations=4)
    >>> np.unique(result.labels).tolist()
    [0, 1]
    """
    images = [images] if isinstance(images, Image | np.ndarray) else list(images)
    weights = [1.0] * len(images) if weights is None else [float(w) for w in weights]
    _check(images, {"labels": labels, "mask": mask}, weights, label_weight)
    labels = None if labels is None else check_labels("labels", labels, is_map=True)
    mask = None if mask is None else mask.with_zeros()
    whole = images[0]
    images, labels, region, beyond = _within_mask(images, labels, mask)
    result = Content(
        images[0],
        region=region,
        continuation=beyond,
        keeps_components=keep_components,
        whole=whole,
    )
    if len(images) == 1 and labels is None and weights[0] > 0.0:
        return result if region is None else result._replace(squared_spread=result.variance)
    members, n_rows = None, 0
    rows: NDArray[np.integer] = np.empty(0, dtype=np.int16)
    if labels is not None and label_weight > 0.0:
        factors, (present, rows) = supersampling(labels.spacing), number_labels(labels)
        labels, n_rows = None, len(present)  # its memory is needed
        if smooth_interfaces:
            members = memberships_of(present, rows, factors)
            rows = members.partition
            if max(factors) > 1:
                images = [finer(image, factors) for image in images]
                region = None if region is None else _finer_region(region, factors)
    contrasts = _scale_contrasts(images, weights, region)
    codes = np.zeros((0, 1))
    if n_rows > 0:
        rows, codes = _one_hot(rows, n_rows, region)
        codes = np.sqrt(label_weight) * codes
    if len(contrasts) + len(codes) == 0:
        raise InputError(
            "weights: every image or label that varies has weight 0; give at least one a weight "
            "above 0"
        )
    values, whole_codes, scale = _whole_numbers(contrasts, images[0].shape, codes)
    unit = _variance(images[0].data, region) or 1.0
    result = result._replace(
        image=images[0],
        contrasts=values,
        rows=rows if n_rows > 0 else None,
        codes=whole_codes,
        unit=unit / scale**2,
        region=region,
    )
    result = result._replace(squared_spread=result.variance)
    if members is None:
        return result
    channel, value = len(contrasts) + codes.argmax(axis=0), whole_codes.max(axis=0)
    return result._replace(
        smooth=SmoothLabels(members, channel.astype(np.int64), value, keep_volumes)
    )


def _within_mask(
    images: list[Image], labels: Image | None, mask: Image | None
) -> tuple[list[Image], Image | None, Region | None, Continuation | None]:
    """Images and labels continued beyond the mask, if there is one, its region and continuation;
    raise InputError if no label is left.
    """
    region, beyond, whole = None, None, images[0]
    if mask is not None:
        beyond = continuation(mask, whole.spacing)
        region = region_of(_part(mask, beyond.part))
    images = [continue_image(image, beyond) for image in images]
    if mask is not None and labels is not None:
        warn_of_absent("", labels, mask.data >= INSIDE_FRACTION, "mask")
        labels = images[0] if labels is whole else continue_image(labels, beyond)
    if labels is not None and labels.data.max() == BACKGROUND_LABEL:
        where = "" if mask is None else " in the meshed region"
        raise InputError(
            f"labels: expected labels above 0{where}, got 0 in every voxel; is it the right file?"
        )
    return images, labels, region, beyond


def _finer_region(region: Region, factors: Sequence[int]) -> Region:
    """The region on divided voxels, with its surface interpolated between slices like labels."""
    if region.inside.all():
        inside = np.ones(
            [n * factor for n, factor in zip(region.inside.shape, factors, strict=True)], dtype=bool
        )
        return Region(inside, np.full(inside.shape, region.level.min(), dtype=np.float32))
    sides = memberships(Image(region.inside), factors)
    outside, within = sides.levels[sides.channel]
    return Region(sides.partition == 1, (0.5 * (within - outside)).astype(np.float32))


def _scale_contrasts(
    images: list[Image], weights: list[float], region: Region | None
) -> list[NDArray[np.float32]]:
    """The contrasts of weight above 0, minus their means and scaled to variance `weight`."""
    scaled = []
    for image, weight in zip(images, weights, strict=True):
        if weight == 0.0:
            continue
        data = image.data - np.mean(
            image.data if region is None else image.data[region.inside], dtype=np.float64
        )
        spread = _variance(data, region)
        if spread > 0.0:
            scaled.append((np.sqrt(weight / spread) * data).astype(np.float32))
    return scaled


def _whole_numbers(
    contrasts: list[NDArray[np.float32]], shape: tuple[int, ...], codes: Floats
) -> tuple[NDArray[np.int32], NDArray[np.int32], float]:
    """The contrasts, (I, *shape), and the values of labels, (L, K), as whole numbers, and their
    scale.

    If possible, their sums of squares along a row fit into 32 bits.
    """
    square = sum(float(np.abs(data).max()) ** 2 for data in contrasts) + float(
        (codes**2).max(initial=0.0)
    )
    # 0: a single label, alone
    fitting = float(np.sqrt(0.9 * ROW_SUM_LIMIT / (shape[-1] * (square or 1.0))))
    # If one voxel or a rare label is much larger than the rest, sums take 64 bits, to keep enough
    # levels.
    steps = [STEPS_PER_SIGMA / float(np.std(data, dtype=np.float64)) for data in contrasts]
    largest = max(
        [float(np.abs(data).max()) for data in contrasts] + [float(codes.max(initial=0.0))]
    )
    scale = min(max([fitting, *steps]), 2.0**30 / (largest or 1.0))
    values = np.empty((len(contrasts), *shape), dtype=np.int32)
    for row, data in zip(values, contrasts, strict=True):
        row[:] = np.rint(scale * data)
    return values, np.rint(scale * codes).astype(np.int32), scale


def undivide_voxels(what: Content, values: NDArray) -> NDArray:
    """Return one of each group of voxels that repeat one of the image's file."""
    return values[tuple(slice(None, None, factor) for factor in what.repeats)]


def plain(image: Image | Content) -> Content:
    """Content of a single image; a content is returned unchanged; TypeError for anything else."""
    if isinstance(image, Content):
        return image
    return Content(continue_image(check_image("image", image), None))


def own_image(image: Image | Content) -> Image:
    """Return the first contrast of a content on its own voxels, see `Content.own`; an image is
    returned unchanged.
    """
    return image.own if isinstance(image, Content) else check_image("image", image)


def _variance(values: NDArray, region: Region | None) -> float:
    with np.errstate(over="ignore"):
        return float(np.var(values if region is None else values[region.inside], dtype=np.float64))


def continuation(mask: Image, spacing: Floats) -> Continuation:
    """The voxels around a mask, with a margin, and their nearest voxels inside, for voxel edges
    (n,) in mm.

    Voxels farther away would only take time. Images on the same voxels share one continuation.

    Raises
    ------
    InputError
        Nothing inside the mask.
    """
    inside = mask.data >= INSIDE_FRACTION
    if not inside.any():
        raise InputError("mask: expected voxels of 0.5 or more, got none")
    box = scipy.ndimage.find_objects(inside.astype(np.int8))[0]
    ends = ((max(s.start - MARGIN_VOXELS, 0), s.stop + MARGIN_VOXELS) for s in box)
    part = tuple(
        slice(first, min(stop, n)) for (first, stop), n in zip(ends, mask.shape, strict=True)
    )
    inside = inside[part]
    if inside.all():
        return Continuation(part, inside, np.empty(0, dtype=np.int64))
    nearest = scipy.ndimage.distance_transform_edt(
        ~inside, spacing, return_distances=False, return_indices=True
    )
    flat = np.ravel_multi_index(tuple(nearest[:, ~inside]), inside.shape)
    return Continuation(part, inside, flat.astype(np.int32 if inside.size < 2**31 else np.int64))


def continue_image(image: Image, mask: Image | Continuation | None) -> Image:
    """Continue an image beyond a mask with the nearest value inside, as cells at the boundary
    represent the inside.

    Only the voxels around the mask are kept. Without a mask the image is returned unchanged.

    Raises
    ------
    InputError
        A voxel within the mask has no value.
    """
    if mask is None:
        check_values(image)
        return image
    beyond = continuation(mask, image.spacing) if isinstance(mask, Image) else mask
    part = _part(image, beyond.part)
    check_values(part, beyond.inside, [each.start for each in beyond.part])
    data, affine = part.data.copy(), part.affine
    del part  # a copy, too
    data[~beyond.inside] = data.ravel()[beyond.nearest]
    return Image(data, affine)


def check_values(
    image: Image, inside: Bools | bool = True, start: Sequence[int] | None = None
) -> None:
    """Raise InputError for a voxel without a value (NaN), of those that count; indices are from
    `start`, that of the first voxel.
    """
    if image.has_gaps and len(gaps := np.argwhere(np.isnan(image.data) & inside)):
        index = (gaps[0] + (0 if start is None else start)).tolist()
        place = ", ".join(f"{x:.5g}" for x in image.to_world(gaps[0]))
        raise InputError(
            f"image: {len(gaps)} voxels that count have no value (NaN), the first at index "
            f"{index}, ({place}) mm; pass a `mask` without them, or fill them in"
        )


def _part(image: Image, part: tuple[slice, ...]) -> Image:
    return image.box([s.start for s in part], [s.stop for s in part])


def check_weights(n_images: int, weights: list[float], label_weight: float) -> None:
    """Raise InputError for invalid weights of images and labels."""
    low, high = WEIGHT_RANGE
    if len(weights) != n_images or not all(w == 0.0 or low <= w <= high for w in weights):
        raise InputError(
            f"weights: expected one for each of {n_images} images, 0 or {low:g} to {high:g}, got "
            f"{weights}"
        )
    if not (label_weight == 0.0 or low <= label_weight <= high):
        raise InputError(f"label_weight: expected 0 or {low:g} to {high:g}, got {label_weight}")


def _check(
    images: list[Image],
    others: dict[str, Image | None],
    weights: list[float],
    label_weight: float,
) -> None:
    if not images:
        raise InputError("images: expected one or more, got none")
    first = images[0]
    named = [
        *(("images", image) for image in images),
        *((name, image) for name, image in others.items() if image is not None),
    ]
    for name, image in named:
        check_image(name, image)
        if image.shape != first.shape:
            raise InputError(
                f"{name}: expected shape {first.shape} like the first, got {image.shape}; see "
                "tetopt.resample_mask"
            )
        last = np.array(first.shape) - 1
        if (
            np.abs(first.to_index(image.to_world([0 * last, last])) - [0 * last, last]).max()
            > SAME_PLACE_VOXELS
        ):
            raise InputError(
                f"{name}: expected the same voxel grid as the first image's; see "
                "tetopt.resample_mask"
            )
    mask = others.get("mask")
    if mask is not None and not 0.0 <= mask.range[0] <= mask.range[1] <= 1.0:
        low, high = mask.range
        raise InputError(
            f"mask: expected values from 0 to 1, got {low:g} to {high:g}; threshold or rescale "
            "it first"
        )
    check_weights(len(images), weights, label_weight)


def _one_hot(
    rows: NDArray[np.integer], n_rows: int, region: Region | None
) -> tuple[NDArray[np.integer], Floats]:
    """Channels that distinguish K labels: each voxel's label, and the labels' values in C channels,
    (C, K).

    `rows` are numbers of the voxels' labels, below `n_rows`, of which K lie in the region. Each
    label has its value in one channel and 0 in the others. Labels that are nowhere near one another
    share a channel. The weight of a label's voxels is its fraction of the voxels to the power
    -`RARITY_POWER`, so that small labels are not sacrificed for the surfaces of large ones; the
    total variance is 1 (0 for one label).
    """
    counts = np.bincount(
        (rows if region is None else rows[region.inside]).ravel(), minlength=n_rows
    )
    present = np.flatnonzero(counts)
    if len(present) < n_rows:
        index = np.zeros(n_rows, dtype=rows.dtype)  # 0 beyond the region
        index[present] = np.arange(len(present))
        rows = index[rows]
    number, fraction = rows, counts[present] / counts.sum()
    size = fraction ** (-0.5 * RARITY_POWER)
    channel = label_channels(number, len(fraction))
    codes = np.where(channel == np.arange(channel.max() + 1)[:, None], size, 0.0)
    spread = float((codes**2 @ fraction - (codes @ fraction) ** 2).sum())
    return number, (codes / np.sqrt(spread) if len(fraction) > 1 else 0.0 * codes)
