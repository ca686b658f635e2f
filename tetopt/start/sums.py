"""Sums of an image's voxels over blocks, from one pass over boxes of them, in memory or stored.

Sums are taken of the channels h' = (h - mean) / scale, at most 1, so that numbers of nodes do not
depend on the unit of intensity, and of their squares. Each row is added to its block voxel by
voxel, rows to their planes and planes to their blocks in order: the sums are the same to the last
bit however the volume is divided into boxes.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, undivided
from tetopt.contents.noise import NoiseSample, noise_planes, noise_sample, sampled_noise
from tetopt.contents.statistics import mean_of, row_sums, statistics
from tetopt.errors import InputError
from tetopt.image import Box, pieces
from tetopt.system.kernel_cache import njit


class Channels(NamedTuple):
    """Scaling of values to channels, and numbers of these; made by `channels_of`."""

    means: list[float]  # means of the values, (C,)
    scale: float  # largest deviation of the values from the means
    noise: float  # variance
    step: float  # squared difference between the two sides of the mask's surface

    def scaled(self, values: NDArray, channel: int, inside: NDArray | None) -> NDArray[np.float64]:
        """The channel's values minus their mean, scaled to at most 1; 0 outside the mask."""
        deviations = np.subtract(values, self.means[channel], dtype=np.float64, order="C")
        deviations /= self.scale
        if inside is not None:
            deviations *= inside
        return deviations


def channels_of(content: Content) -> Channels:
    """The channels of a content; stored voxels without known statistics take one pass.

    Raises
    ------
    InputError
        Deviations whose squares overflow, or a stored image with voxels that are invalid for an
        `Image`.
    """
    # otherwise half of them suffice
    is_known = content.statistics is not None or content.image.in_memory is None
    if content.is_plain and content.region is None and content.image.ndim == 3 and is_known:
        known = statistics(content.image) if content.statistics is None else content.statistics
        _check_squares(known.scale, content.n_voxels)
        return Channels([known.mean], known.scale, known.scaled_noise, 0.0)
    means, scale, size = [], 0.0, prod(content.image.shape)
    for number in range(content.n_channels):
        values = content.channel(number)
        values = values if values.ndim == 3 else values[None]
        sums = [row_sums(np.array(plane, dtype=np.float64, order="C")) for plane in values]
        means.append(mean_of(np.stack(sums), size))
        scale = max(scale, *(abs(float(end) - means[-1]) for end in (values.min(), values.max())))
    _check_squares(scale, size)
    scale = scale or 1.0
    result = Channels(
        means, scale, 0.0, 0.0 if content.region is None else content.wrong_side / scale**2
    )
    # The noise is estimated on scaled values, too, as the estimate would round differently
    # otherwise.
    inside = None if content.inside is None else undivided(content, content.inside)
    planes = None if inside is None else noise_planes(inside)
    within, noise = None if inside is None else noise_sample(inside, planes), 0.0
    for channel in range(content.n_contrasts):
        sample = noise_sample(undivided(content, content.channel(channel)), planes)
        parts = zip(sample, (None, None) if within is None else within, strict=True)
        scaled = NoiseSample(*(result.scaled(part, channel, mask) for part, mask in parts))
        noise += sampled_noise(scaled, None if within is None else within.near) ** 2
    return result._replace(noise=float(noise))


def _check_squares(scale: float, n_voxels: int) -> None:
    """Raise InputError if sums of squares of deviations up to this one may overflow."""
    if not np.isfinite(scale * scale * n_voxels):
        raise InputError(
            f"image: squares of deviations up to {scale:.3g} overflow; rescale the image first"
        )


class BlockSums(NamedTuple):
    """Sums over equal blocks, each in the blocks' shape."""

    # voxels along each axis, for the blocks at each position on it
    lengths: list[NDArray[np.float64]]
    inside: NDArray[np.float64] | None  # voxels inside the mask; None without a mask
    second: NDArray[np.float64]  # sums of all channels' squares
    firsts: list[NDArray[np.float64]]  # sums of each channel

    def voxels(self, layers: slice) -> NDArray[np.float64]:
        """Number of voxels of the blocks in these layers along the first axis."""
        product = self.lengths[0][layers]
        for length in self.lengths[1:]:
            product = product[..., None] * length
        return product

    def coarser(self) -> BlockSums:
        """The sums over blocks of twice the edge."""
        return BlockSums(
            [halved(length, np.add) for length in self.lengths],
            None if self.inside is None else halved(self.inside, np.add),
            halved(self.second, np.add),
            [halved(first, np.add) for first in self.firsts],
        )


def halved(totals: NDArray, total_of: np.ufunc) -> NDArray:
    """Totals over blocks of twice the edge: of pairs along each axis in turn."""
    for axis in range(totals.ndim):
        pairs = np.moveaxis(totals, axis, 0)
        totals = np.moveaxis(total_of(pairs[0::2], pairs[1::2]), 0, axis)
    return totals


def block_starts(size: int, count: int) -> NDArray[np.int64]:
    """The first voxel of each of `count` equal blocks along an axis; a voxel belongs to the block
    of its centre.

    If blocks are smaller than voxels, a block without centres starts where the next one does, or at
    the end.
    """
    return np.ceil(np.arange(count) * (size / count) - 0.5).astype(np.int64)


def block_sums(content: Content, channels: Channels, counts: NDArray[np.int64]) -> BlockSums:
    """Sums over `counts` equal blocks along the axes, from one pass over the voxels."""
    shape = content.image.shape
    starts = [block_starts(size, count) for size, count in zip(shape, counts, strict=True)]
    lengths = [
        np.diff(start, append=size).astype(np.float64)
        for start, size in zip(starts, shape, strict=True)
    ]
    starts = [np.zeros(1, dtype=np.int64)] * (3 - len(shape)) + starts
    n_rows = shape[-2]
    of_plane, of_row = (
        np.repeat(np.arange(len(length)), length.astype(np.int64))
        for length in [np.ones(1), *lengths][-3:-1]
    )
    n_fields = 1 + len(channels.means) + (content.inside is not None)
    totals = np.zeros((n_fields, *(len(start) for start in starts)))
    of_open = np.empty(0)  # sums of a block that continues in the next box of the same planes
    for box, values, inside in _boxes_of(content):
        first, last = of_row[box[1].start], of_row[box[1].stop - 1]
        sums = np.zeros((n_fields, values.shape[1], last - first + 1, len(starts[2])))
        if box[1].start > 0 and of_row[box[1].start - 1] == first:
            sums[:, :, 0] = of_open
        for piece in pieces(values.shape[1:]):
            rows = of_row[box[1]][piece[1]] - first
            for field, total in zip(_fields(values, inside, channels, piece), sums, strict=True):
                _add_rows(field, rows, np.append(starts[2], shape[-1]), total[piece[0]])
        of_open = sums[:, :, -1]
        is_open = box[1].stop < n_rows and of_row[box[1].stop] == last
        n_done = sums.shape[2] - is_open
        for plane, block in enumerate(of_plane[box[0]]):
            totals[:, block, first : first + n_done] += sums[:, plane, :n_done]
    totals = totals.reshape(n_fields, *counts)
    inside, firsts = (
        None if content.inside is None else totals[-1],
        list(totals[1 : 1 + len(channels.means)]),
    )
    return BlockSums(lengths, inside, totals[0], firsts)


def _boxes_of(content: Content) -> Iterator[tuple[Box, NDArray, NDArray[np.bool_] | None]]:
    """Boxes of whole rows, plane by plane, with their voxels (C, P, R, K) and the mask of those
    inside (P, R, K).
    """
    image, inside = content.image, content.inside
    for box in image.boxes():
        own, shape = box[3 - image.ndim :], tuple(each.stop - each.start for each in box)
        if content.is_plain:
            values = image.read([each.start for each in own], [each.stop for each in own])
        else:
            values = np.stack(
                [content.channel(number, own) for number in range(content.n_channels)]
            )
        yield (
            box,
            values.reshape(-1, *shape),
            None if inside is None else inside[own].reshape(shape),
        )


def _fields(
    values: NDArray, inside: NDArray[np.bool_] | None, channels: Channels, piece: Box
) -> Iterator[NDArray[np.float64]]:
    """The fields to sum over a piece of voxels: squares, each channel, and with a mask 1 inside
    it.
    """
    within = None if inside is None else inside[piece]
    scaled = [channels.scaled(part[piece], channel, within) for channel, part in enumerate(values)]
    square = scaled[0] * scaled[0]
    for each in scaled[1:]:
        square += each * each
    yield square
    yield from scaled
    if within is not None:
        yield within.astype(np.float64)


@njit(cache=True, error_model="numpy")
def _add_rows(field: NDArray, block_of_row: NDArray, ends: NDArray, totals: NDArray) -> None:
    """Add each row of voxels (P, R, K) to its plane's sums over blocks (P, B, C), voxel by voxel.

    `block_of_row` (R,) is each row's block; block c has voxels ends[c] to ends[c + 1] - 1, (C +
    1,).
    """
    for p in range(field.shape[0]):
        for r in range(field.shape[1]):
            for c in range(len(ends) - 1):
                total = totals[p, block_of_row[r], c]
                for k in range(ends[c], ends[c + 1]):
                    total += field[p, r, k]
                totals[p, block_of_row[r], c] = total
