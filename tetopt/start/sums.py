"""Sums of an image's voxels over blocks, from one pass over slabs of them.

Sums are taken of the channels h' = (h - mean) / scale, at most 1, so that numbers of nodes do not
depend on the unit of intensity, and of their squares. Each row is added to its block voxel by
voxel, rows to their planes and planes to their blocks in order: the sums are the same to the last
bit however the volume is divided.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, undivide_voxels
from tetopt.contents.noise import NoiseSample, noise_planes, noise_sample, sampled_noise
from tetopt.errors import InputError
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernel_cache import njit

# processed at a time: half a megabyte per field, which fits into a processor's cache
PIECE_VOXELS = 2**16


class Channels(NamedTuple):
    """Scaling of values to channels, and numbers of these; made by `channels_of`."""

    means: list[float]  # means of the values, (C,)
    scale: float  # largest deviation of the values from the means
    noise: float  # variance
    step: float  # squared difference between the two sides of the mask's surface

    def scaled(self, values: NDArray, channel: int, inside: NDArray | None) -> Floats:
        """The channel's values minus their mean, scaled to at most 1; 0 outside the mask."""
        deviations = np.subtract(values, self.means[channel], dtype=np.float64, order="C")
        deviations /= self.scale
        if inside is not None:
            deviations *= inside
        return deviations


def channels_of(content: Content) -> Channels:
    """The channels of a content.

    Raises
    ------
    InputError
        Deviations whose squares overflow.
    """
    means, scale, size = [], 0.0, prod(content.image.shape)
    for number in range(content.n_channels):
        values = content.channel(number)
        values = values if values.ndim == 3 else values[None]
        rows = [np.array(plane, dtype=np.float64, order="C").sum(axis=-1) for plane in values]
        means.append(float(np.stack(rows).sum() / size))
        scale = max(scale, *(abs(float(end) - means[-1]) for end in (values.min(), values.max())))
    _check_squares(scale, size)
    scale = scale or 1.0
    result = Channels(
        means, scale, 0.0, 0.0 if content.region is None else content.wrong_side / scale**2
    )
    # The noise is estimated on scaled values, too, as the estimate would round differently
    # otherwise.
    inside = None if content.inside is None else undivide_voxels(content, content.inside)
    planes = None if inside is None else noise_planes(inside)
    within, noise = None if inside is None else noise_sample(inside, planes), 0.0
    for channel in range(content.n_contrasts):
        sample = noise_sample(undivide_voxels(content, content.channel(channel)), planes)
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
    lengths: list[Floats]
    inside: Floats | None  # voxels inside the mask; None without a mask
    second: Floats  # sums of all channels' squares
    firsts: list[Floats]  # sums of each channel

    def voxels(self, layers: slice) -> Floats:
        """Number of voxels of the blocks in these layers along the first axis."""
        product = self.lengths[0][layers]
        for length in self.lengths[1:]:
            product = product[..., None] * length
        return product

    def coarser(self) -> BlockSums:
        """The sums over blocks of twice the edge."""
        return BlockSums(
            [halve_totals(length, np.add) for length in self.lengths],
            None if self.inside is None else halve_totals(self.inside, np.add),
            halve_totals(self.second, np.add),
            [halve_totals(first, np.add) for first in self.firsts],
        )


def halve_totals(totals: NDArray, total_of: np.ufunc) -> NDArray:
    """Totals over blocks of twice the edge: of pairs along each axis in turn."""
    for axis in range(totals.ndim):
        pairs = np.moveaxis(totals, axis, 0)
        totals = np.moveaxis(total_of(pairs[0::2], pairs[1::2]), 0, axis)
    return totals


def block_starts(size: int, count: int) -> Ints:
    """The first voxel of each of `count` equal blocks along an axis; a voxel belongs to the block
    of its centre.

    If blocks are smaller than voxels, a block without centres starts where the next one does, or at
    the end.
    """
    return np.ceil(np.arange(count) * (size / count) - 0.5).astype(np.int64)


def block_sums(content: Content, channels: Channels, counts: Ints) -> BlockSums:
    """Sums over `counts` equal blocks along the axes, from one pass over the voxels."""
    shape = content.image.shape
    starts = [block_starts(size, count) for size, count in zip(shape, counts, strict=True)]
    lengths = [
        np.diff(start, append=size).astype(np.float64)
        for start, size in zip(starts, shape, strict=True)
    ]
    starts = [np.zeros(1, dtype=np.int64)] * (3 - len(shape)) + starts
    ends = np.append(starts[2], shape[-1])
    of_plane, of_row = (
        np.repeat(np.arange(len(length)), length.astype(np.int64))
        for length in [np.ones(1), *lengths][-3:-1]
    )
    n_fields = 1 + len(channels.means) + (content.inside is not None)
    totals = np.zeros((n_fields, *(len(start) for start in starts)))
    for planes, values, inside in _slabs_of(content):
        sums = np.zeros((n_fields, values.shape[1], *totals.shape[2:]))
        n_rows = max(PIECE_VOXELS // (values.shape[1] * shape[-1]), 1)
        for start in range(0, shape[-2], n_rows):
            rows = slice(start, start + n_rows)
            for field, total in zip(_fields(values, inside, channels, rows), sums, strict=True):
                _add_rows(field, of_row[rows], ends, total)
        for plane, block in enumerate(of_plane[planes]):
            totals[:, block] += sums[:, plane]
    totals = totals.reshape(n_fields, *counts)
    inside, firsts = (
        None if content.inside is None else totals[-1],
        list(totals[1 : 1 + len(channels.means)]),
    )
    return BlockSums(lengths, inside, totals[0], firsts)


def _slabs_of(content: Content) -> Iterator[tuple[slice, NDArray, Bools | None]]:
    """Planes of a volume, with their voxels (C, P, R, K) and the mask of those inside (P, R, K); a
    2-D image is one plane.
    """
    shape = content.image.shape
    n_planes = max(PIECE_VOXELS // prod(shape[-2:]), 1) if len(shape) == 3 else 1
    for start in range(0, shape[0] if len(shape) == 3 else 1, n_planes):
        planes = slice(start, start + n_planes)
        own = (planes,) if len(shape) == 3 else ()
        values = np.stack([content.channel(number, own) for number in range(content.n_channels)])
        inside = None if content.inside is None else content.inside[own].reshape(-1, *shape[-2:])
        yield planes, values.reshape(len(values), -1, *shape[-2:]), inside


def _fields(
    values: NDArray, inside: Bools | None, channels: Channels, rows: slice
) -> Iterator[Floats]:
    """The fields to sum over rows of a slab: squares, each channel, and with a mask 1 inside it."""
    within = None if inside is None else inside[:, rows]
    scaled = [channels.scaled(each[:, rows], number, within) for number, each in enumerate(values)]
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
