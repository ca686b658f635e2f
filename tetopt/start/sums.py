"""Sums of an image's voxels over blocks, from one pass over boxes of them, in memory or stored.

Of the voxels there are the channels h' = (h - mean) / scale, at most 1, so that numbers of nodes do not depend on the
unit of intensity, and their squares. Each row is added to its block voxel by voxel, rows to their planes and planes to
their blocks in their order: the sums are the same bits however the volume is cut into boxes.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.contents.noise import NoiseSample, noise_sample, sampled_noise
from tetopt.contents.statistics import mean_of, row_sums, statistics
from tetopt.errors import InputError
from tetopt.image import Box, pieces
from tetopt.system.kernel_cache import njit


class Channels(NamedTuple):
    """How values are made channels, and what is known of these; made by `channels_of`."""

    means: list[float]  # of the values, (C,)
    scale: float  # their largest deviation from them
    noise: float  # variance
    step: float  # squared difference between the two sides of the mask's surface

    def scaled(self, values: NDArray, channel: int, inside: NDArray | None) -> NDArray[np.float64]:
        """The channel's values less their mean, at most 1; 0 outside of the mask."""
        deviations = np.subtract(values, self.means[channel], dtype=np.float64, order="C")
        deviations /= self.scale
        if inside is not None:
            deviations *= inside
        return deviations


def channels_of(content: Content) -> Channels:
    """The channels of a content, from one pass over its voxels where they are stored and their statistics not known.

    Raises
    ------
    InputError
        Deviations whose squares overflow; of a stored image voxels that no `Image` takes.
    """
    is_known = content.statistics is not None or content.image.in_memory is None  # else half of it will do
    if content.is_plain and content.region is None and content.image.ndim == 3 and is_known:
        known = statistics(content.image) if content.statistics is None else content.statistics
        _check_squares(known.scale, content.n_voxels)
        return Channels([known.mean], known.scale, known.scaled_noise, 0.0)
    means, scale, size = [], 0.0, prod(content.image.shape)
    for values in content.values if content.image.ndim == 3 else content.values[:, None]:
        sums = [row_sums(np.array(plane, dtype=np.float64, order="C")) for plane in values]
        means.append(mean_of(np.stack(sums), size))
        scale = max(scale, *(abs(float(end) - means[-1]) for end in (values.min(), values.max())))
    _check_squares(scale, size)
    scale = scale or 1.0
    result = Channels(means, scale, 0.0, 0.0 if content.region is None else content.wrong_side / scale**2)
    # The noise is that of values at most 1, too: its estimate rounds differently otherwise.
    within = None if content.inside is None else noise_sample(content.inside)
    noise = 0.0
    for channel, values in enumerate(content.values[: content.n_contrasts]):
        sample = noise_sample(values)
        parts = zip(sample, (None, None) if within is None else within, strict=True)
        scaled = NoiseSample(*(result.scaled(part, channel, inside) for part, inside in parts))
        noise += sampled_noise(scaled, None if within is None else within.near) ** 2
    return result._replace(noise=float(noise))


def _check_squares(scale: float, n_voxels: int) -> None:
    """InputError if the squares of deviations up to this one may not be summed."""
    if not np.isfinite(scale * scale * n_voxels):
        raise InputError(f"image: squares of deviations up to {scale:.3g} overflow; rescale the image first")


class BlockSums(NamedTuple):
    """Sums over equal blocks, each of the blocks' shape."""

    lengths: list[NDArray[np.float64]]  # voxels along each axis, of the blocks at each place along it
    inside: NDArray[np.float64] | None  # voxels inside the mask; without one all are
    second: NDArray[np.float64]  # of all channels' squares
    firsts: list[NDArray[np.float64]]  # of each channel

    def voxels(self, layers: slice) -> NDArray[np.float64]:
        """All voxels of the blocks in these layers along the first axis."""
        product = self.lengths[0][layers]
        for length in self.lengths[1:]:
            product = product[..., None] * length
        return product

    def coarser(self) -> BlockSums:
        """Those of blocks of twice the edge."""
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
    """The first voxel of each of so many equal blocks along an axis: a voxel is where its centre is.

    Where blocks are smaller than voxels, one that has no centre starts where the next one does, or at the end.
    """
    return np.ceil(np.arange(count) * (size / count) - 0.5).astype(np.int64)


def block_sums(content: Content, channels: Channels, counts: NDArray[np.int64]) -> BlockSums:
    """Sums over so many equal blocks along each axis, from one pass over the voxels."""
    shape = content.image.shape
    starts = [block_starts(size, count) for size, count in zip(shape, counts, strict=True)]
    lengths = [np.diff(start, append=size).astype(np.float64) for start, size in zip(starts, shape, strict=True)]
    starts = [np.zeros(1, dtype=np.int64)] * (3 - len(shape)) + starts
    n_rows = shape[-2]
    of_plane, of_row = (
        np.repeat(np.arange(len(length)), length.astype(np.int64)) for length in [np.ones(1), *lengths][-3:-1]
    )
    n_fields = 1 + len(channels.means) + (content.inside is not None)
    totals = np.zeros((n_fields, *(len(start) for start in starts)))
    of_open = np.empty(0)  # sums of a block that goes on in the next box of the same planes
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
    inside, firsts = None if content.inside is None else totals[-1], list(totals[1 : 1 + len(channels.means)])
    return BlockSums(lengths, inside, totals[0], firsts)


def _boxes_of(content: Content) -> Iterator[tuple[Box, NDArray, NDArray[np.bool_] | None]]:
    """Boxes of whole rows, plane after plane: their voxels, (C, P, R, K), and which are inside, (P, R, K)."""
    image, channels, inside = content.image, content.channels, content.inside
    for box in image.boxes():
        own, shape = box[3 - image.ndim :], tuple(each.stop - each.start for each in box)
        if channels is None:
            values = image.read([each.start for each in own], [each.stop for each in own])
        else:
            values = channels[:, *own]
        yield box, values.reshape(-1, *shape), None if inside is None else inside[own].reshape(shape)


def _fields(
    values: NDArray, inside: NDArray[np.bool_] | None, channels: Channels, piece: Box
) -> Iterator[NDArray[np.float64]]:
    """What is summed of a piece of voxels: squares, each channel, and with a mask 1 inside of it."""
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

    `block_of_row` (R,) numbers its B; block c is of voxels ends[c] to before ends[c + 1], (C + 1,).
    """
    for p in range(field.shape[0]):
        for r in range(field.shape[1]):
            for c in range(len(ends) - 1):
                total = totals[p, block_of_row[r], c]
                for k in range(ends[c], ends[c + 1]):
                    total += field[p, r, k]
                totals[p, block_of_row[r], c] = total
