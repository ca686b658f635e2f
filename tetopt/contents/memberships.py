"""Labels between voxels: a smooth level for each label; each place has the label with the smallest
level.

A label's level is the signed distance to its surface, in voxels, negative inside, so that the
interface between labels a and b is where their levels are equal. Since each place has the label of
the smallest level, labels neither overlap nor leave gaps, even where three of them meet. Between
voxel centres a level is linear along each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import prod
from typing import NamedTuple

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.labels import check_labels, label_channels
from tetopt.contents.smoothing import (
    FARTHEST_DISTANCE,
    FARTHEST_LEVEL,
    NEAR_SURFACE,
    largest_around,
    smooth_level,
)
from tetopt.image import Image
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.budget import check_memory
from tetopt.system.kernel_cache import njit
from tetopt.system.slabs import over_slabs

# per voxel, in addition to levels: its label, the nearest label, and temporaries
PARTITION_BYTES = 40.0
NO_ROOM = "crop the image, or turn `smooth_interfaces` off"  # remedy in messages on memory
LARGE_BOX = 1 << 20  # voxels of a label's box from which its level is computed on all threads
AGREEMENT_ROUNDS = 8  # with none, ribs of a CT have .77 to .86 of their volume
AGREEMENT_FRACTION = 0.02  # of a label's volume, whose lack or excess between labels is corrected
# of the missing depth: levels of thin labels are flat, so that a whole step goes too far
AGREEMENT_STEP = 0.6
# voxels from a label within which its level is corrected, half of `APART_VOXELS` at most
AGREEMENT_REACH = 2
# of those near a label, about as many are sampled, at so many places
AGREEMENT_VOXELS, PLACES_PER_VOXEL = 20_000, 8
PLASTIC_RATIO = 1.2207440846057596  # root of x^4 = x + 1, of Roberts' sequence in three dimensions
ABSENT_DISTANCE = 1e4  # voxels to a label that is absent from a slice


class Memberships(NamedTuple):
    """Levels of labels on a grid of voxel centres; made by `memberships`."""

    labels: Ints  # (K,) labels present, ascending
    # (K,) row of `levels` for each label; labels nowhere near one another share one
    channel: Ints
    levels: NDArray[np.float32]  # (C, *shape) distance to the surface, voxels, below 0 inside
    partition: NDArray[np.integer]  # (*shape) row of `labels` with the smallest level at each voxel
    parts: int = 1  # voxels of this grid per voxel of the labels


def supersampling(spacing: Floats) -> tuple[int, ...]:
    """Number of parts along each axis that divide a voxel with edges (n,), mm, nearly into cubes.

    Odd numbers, so that a slice's plane goes through voxels' centres: 1, 3, 5, ..., whichever is
    nearest in ratio.
    """
    ratio = np.asarray(spacing) / np.min(spacing)
    odd = np.arange(1, ratio.max() + 4.0, 2.0)
    return tuple(int(f) for f in odd[np.searchsorted(np.sqrt(odd[:-1] * odd[1:]), ratio)])


def finer(image: Image, factors: Sequence[int]) -> Image:
    """The image on voxels divided by `factors` along the axes; its box stays the same.

    Between the centres of two voxels intensities are linear; beyond the outermost they are
    constant.
    """
    data = _spread(image.data.astype(np.float64), factors)
    return Image(data.astype(image.data.dtype), finer_affine(image.affine, factors))


def finer_index(n: int, factor: int) -> Floats:
    """Centres of `n` voxels divided into `factor` each, in index coordinates of the whole
    voxels, (n * factor,).
    """
    return (np.arange(n * factor) + 0.5) / factor - 0.5


def finer_affine(affine: Floats, factors: Sequence[int]) -> Floats:
    """The affine (n+1, n+1) of voxels divided by `factors` along the axes."""
    step = np.append(1.0 / np.asarray(factors, dtype=np.float64), 1.0)
    moved = affine * step
    moved[:-1, -1] += affine[:-1, :-1] @ (0.5 * step[:-1] - 0.5)
    return moved


def memberships(labels: Image, factors: Sequence[int] | None = None) -> Memberships:
    """Signed distance to the smooth surface of each label, on the labels' voxels or finer ones.

    Every voxel's centre keeps its label: on a slice's plane the surface stays between the same two
    voxel centres. Between divided slices it is interpolated by shape (Raya and Udupa 1990, IEEE
    Trans. Med. Imaging 9, 32), and smoothing may move it by one more fine voxel for each fine voxel
    of distance from the plane.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0.
    factors : sequence of int, optional
        Number of parts of a voxel along each axis, odd, as from `supersampling`; 1 by default.

    Raises
    ------
    InputError
        Labels that are not whole numbers from 0.
    """
    return memberships_of(
        *number_labels(check_labels("labels", labels)), tuple(factors or (1,) * labels.ndim)
    )


def number_labels(labels: Image) -> tuple[Ints, NDArray[np.integer]]:
    """Labels present, (K,), ascending, and the number of each voxel's among them; 16 bits if
    (K+1)^2 fits.
    """
    values = np.unique(labels.data)
    rows = np.empty(labels.shape, dtype=np.int16 if (len(values) + 1) ** 2 <= 1 << 15 else np.int32)

    # with `return_inverse`, voxels are sorted, in 12 times the time
    def fill(first: int, stop: int) -> None:
        rows[first:stop] = np.searchsorted(values, labels.data[first:stop])

    over_slabs(fill, len(rows), rows.size)
    return values.astype(np.int64), rows


def memberships_of(
    values: Ints, start: NDArray[np.integer], factors: tuple[int, ...]
) -> Memberships:
    """`memberships` of numbered labels."""
    assert all(factor % 2 == 1 for factor in factors), (
        f"factors: expected odd numbers, got {factors}"
    )
    raw, n_voxels = start, start.size * prod(factors)
    what = f"labels: {len(values)} labels on {n_voxels} voxels"
    if max(factors) > 1:
        what += f" (after division by {' x '.join(map(str, factors))})"
    check_memory(PARTITION_BYTES * n_voxels, what, NO_ROOM)
    off = None if max(factors) == 1 else np.zeros(start.shape, dtype=np.float32)
    for axis, factor in enumerate(factors):
        if off is not None and factor > 1:
            off = np.maximum(np.repeat(off, factor, axis), _off_planes(start, axis, factor))
            start = _between_slices(start, axis, factors)
            raw = np.repeat(raw, factor, axis)

    def level_in(row: int, box: tuple[slice, ...]) -> NDArray[np.float32]:
        inside = start[box] == row
        return smooth_level(
            inside,
            inside if raw is start else raw[box] == row,
            None if off is None else off[box],
            factors,
        )

    members = gather_levels(values, start, level_in, prod(factors))
    if off is not None and off.any():
        _merge_crumbs(members.levels, members.partition, members.channel, off == 0.0)
    elif len(values) > 2:
        _agree(members)
    return members


def _agree(members: Memberships) -> None:
    """Raise or lower levels, in place, until each label has its volume where its level is the
    smallest.

    Where two labels meet, their levels are opposite. Where more meet, each level alone has the
    volume of its label, but overlaps others: a rib between muscle and fat would lose a fifth. Every
    voxel's centre keeps its label.
    """
    due, partition = list(range(len(members.labels))), members.partition
    boxes = [_around(box, partition.shape) for box in scipy.ndimage.find_objects(partition + 1)]
    with ThreadPoolExecutor(numba.get_num_threads()) as threads:
        nears = list(threads.map(lambda row, box: _near(partition[box] == row), due, boxes))
        for _ in range(AGREEMENT_ROUNDS):
            steps = list(
                threads.map(lambda row: _missing_depth(members, row, boxes[row], nears[row]), due)
            )
            due = [row for row, step in zip(due, steps, strict=True) if step != 0.0]
            for row, step in zip(due, filter(None, steps), strict=True):
                level = members.levels[members.channel[row]][boxes[row]]
                is_near = _mask_of(nears[row], level.shape)
                is_own = partition[boxes[row]][is_near] == row
                moved = level[is_near] - np.float32(AGREEMENT_STEP * step)
                least, most = (
                    np.minimum(moved, -NEAR_SURFACE[0]),
                    np.maximum(moved, NEAR_SURFACE[0]),
                )
                level[is_near] = np.where(is_own, least, most)


def _near(inside: Bools) -> NDArray[np.uint8]:
    """Voxels so near to a label that no other label of its channel has its level there, as bits:
    boxes overlap.
    """
    return np.packbits(largest_around(inside, AGREEMENT_REACH))


def _mask_of(bits: NDArray[np.uint8], shape: tuple[int, ...]) -> Bools:
    return np.unpackbits(bits, count=prod(shape)).view(np.bool_).reshape(shape)


def _missing_depth(
    members: Memberships, row: int, box: tuple[slice, ...], near: NDArray[np.uint8]
) -> float:
    """Volume that a label lacks between labels, over its area, voxels; 0 if that is next to nothing
    of its volume.

    Sampled at places in voxels near the label, quasi-random (Roberts' sequence R3), as regular ones
    would miss layers.
    """
    inside = members.partition[box] == row
    place = np.flatnonzero(_mask_of(near, inside.shape))
    # not as a view, which keeps all
    place = place[:: max(len(place) // AGREEMENT_VOXELS, 1)].copy()
    is_own, n = inside.ravel()[place], inside.ndim
    at = np.stack(np.unravel_index(place, inside.shape), axis=1) + [side.start for side in box]
    index = np.repeat(at, PLACES_PER_VOXEL, axis=0)
    index = (
        index
        + (np.arange(1, len(index) + 1)[:, None] * PLASTIC_RATIO ** -np.arange(1.0, n + 1.0)) % 1.0
        - 0.5
    )
    cells = np.broadcast_to(np.arange(len(index))[:, None], (len(index), n + 1))
    fraction = (
        (labels_at(members, index, cells, np.eye(1, n + 1)) == row)
        .reshape(len(place), -1)
        .mean(axis=1)
    )
    lacking = float((is_own - fraction).sum())
    area = int(((fraction > 0.0) & (fraction < 1.0)).sum())
    return lacking / area if area and abs(lacking) > AGREEMENT_FRACTION * is_own.sum() else 0.0


def gather_levels(
    values: Ints,
    start: NDArray[np.integer],
    level_in: Callable[[int, tuple[slice, ...]], NDArray[np.float32]],
    parts: int,
) -> Memberships:
    """Collect the levels of labels in as few channels as possible, with the label of the smallest
    at each voxel.

    Parameters
    ----------
    values : (K,) int
        Labels, ascending.
    start : (*shape) int
        Initial row of `values` of each voxel.
    level_in : callable
        Function that returns the level of a row within a box of the voxels; called on several
        threads.
    parts : int
        Voxels per voxel of the labels.
    """
    channel = label_channels(start, len(values))
    what = f"labels: {len(values)} labels on {start.size} voxels"
    check_memory((PARTITION_BYTES + 4.0 * (channel.max() + 1)) * start.size, what, NO_ROOM)
    levels = np.full((channel.max() + 1, *start.shape), FARTHEST_LEVEL, dtype=np.float32)
    partition, smallest = start, None  # on undivided voxels every centre keeps its label
    if parts > 1:
        smallest, partition = np.full(start.shape, np.inf, dtype=np.float32), np.zeros_like(start)
    boxes = [_around(box, start.shape) for box in scipy.ndimage.find_objects(start + 1)]
    sizes = [prod(side.stop - side.start for side in box) for box in boxes]
    with ThreadPoolExecutor(numba.get_num_threads()) as threads:
        # Small labels take a thread each, large ones all threads, one after the other, as their
        # temporaries are large.
        small = {
            row: threads.submit(level_in, row, boxes[row])
            for row, n in enumerate(sizes)
            if n < LARGE_BOX
        }
        for row in range(len(values)):
            level = small.pop(row).result() if row in small else level_in(row, boxes[row])
            shared = levels[channel[row]][boxes[row]]
            np.minimum(shared, level, out=shared)
            if smallest is not None:
                least = smallest[boxes[row]]
                partition[boxes[row]][level < least] = row
                np.minimum(least, level, out=least)
            del level  # before the next one
    return Memberships(values, channel, levels, partition, parts)


def labels_at(
    members: Memberships,
    index: Floats,
    cells: Ints,
    places: Floats,
) -> Ints:
    """Rows of the labels with the smallest level at barycentric places (S, K) in cells (M, K), (M,
    S).

    Nodes lie at index positions (N, n).
    """
    shape = (1,) * (3 - index.shape[1]) + members.partition.shape
    node = np.zeros((len(index), 3))
    node[:, 3 - index.shape[1] :] = index
    row = np.empty((len(cells), len(places)), dtype=np.int64)
    _fill_labels(
        row,
        members.partition.reshape(shape),
        members.levels.reshape(-1, *shape),
        members.channel,
        node,
        cells,
        places,
    )
    return row


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_labels(
    row: NDArray,
    partition: NDArray,
    levels: NDArray,
    channel: NDArray,
    node: NDArray,
    cells: NDArray,
    places: NDArray,
) -> None:
    corner, fraction = np.empty((8, 3), dtype=np.int64), np.empty(3)
    for cell in range(len(cells)):
        for s in range(len(places)):
            for d in range(3):
                at = 0.0
                for k in range(cells.shape[1]):
                    at += places[s, k] * node[cells[cell, k], d]
                at = min(max(at, 0.0), partition.shape[d] - 1.0)
                low = min(int(at), max(partition.shape[d] - 2, 0))
                fraction[d] = at - low
                for m in range(8):
                    corner[m, d] = min(low + (m >> d & 1), partition.shape[d] - 1)
            row[cell, s] = _label_between(partition, levels, channel, corner, fraction)


@njit(cache=True, nogil=True)
def _label_between(
    partition: NDArray, levels: NDArray, channel: NDArray, corner: NDArray, fraction: NDArray
) -> int:
    """The label of smallest level among the voxels (8, 3) around a place, given as fractions
    from the first.
    """
    best, least, is_same = partition[corner[0, 0], corner[0, 1], corner[0, 2]], np.inf, True
    for m in range(1, 8):
        is_same = is_same and partition[corner[m, 0], corner[m, 1], corner[m, 2]] == best
    for m in range(8 * (not is_same)):
        label, level = partition[corner[m, 0], corner[m, 1], corner[m, 2]], 0.0
        for q in range(8):
            weight = 1.0
            for d in range(3):
                weight *= fraction[d] if q >> d & 1 else 1.0 - fraction[d]
            level += weight * levels[channel[label], corner[q, 0], corner[q, 1], corner[q, 2]]
        if level < least or (level == least and label < best):
            best, least = label, level
    return int(best)


def _around(box: tuple[slice, ...], shape: tuple[int, ...]) -> tuple[slice, ...]:
    """A label's box with a margin, beyond which its level is `FARTHEST_LEVEL`."""
    ends = ((max(s.start - FARTHEST_DISTANCE, 0), s.stop + FARTHEST_DISTANCE) for s in box)
    return tuple(slice(first, min(stop, n)) for (first, stop), n in zip(ends, shape, strict=True))


def _spread(data: NDArray, factors: Sequence[int]) -> NDArray:
    """Values at the centres of voxels divided by `factors` along the axes: linear, constant
    beyond the outermost.
    """
    for axis, factor in enumerate(factors):
        if factor > 1:
            n = data.shape[axis]
            at = np.clip(finer_index(n, factor), 0.0, n - 1.0)
            below = np.minimum(at.astype(np.int64), max(n - 2, 0))
            fraction = (
                (at - below).astype(data.dtype).reshape((-1,) + (1,) * (data.ndim - 1 - axis))
            )
            above = np.minimum(below + 1, n - 1)
            low = np.take(data, below, axis)
            data = low + (np.take(data, above, axis) - low) * fraction
    return data


def _off_planes(number: NDArray[np.integer], axis: int, factor: int) -> NDArray[np.float32]:
    """Distance of each divided voxel from its slice's plane, voxels, where slices differ; 0
    elsewhere.
    """
    n = number.shape[axis]
    along = np.arange(n * factor)
    away = along % factor - factor // 2
    beside = np.clip(along // factor + np.sign(away), 0, n - 1)
    differs = number.take(along // factor, axis) != number.take(beside, axis)
    return np.abs(away, dtype=np.float32).reshape((-1,) + (1,) * (number.ndim - 1 - axis)) * differs


def _merge_crumbs(
    levels: NDArray[np.float32],
    partition: NDArray[np.integer],
    channel: Ints,
    is_plane: Bools,
) -> None:
    """Merge components of a label between slices that reach no slice's plane into the nearest
    label, in place.

    The two labels' levels are exchanged there.
    """
    is_crumb = np.zeros(partition.shape, dtype=bool)
    for row, box in enumerate(scipy.ndimage.find_objects(partition + 1)):
        piece, n = scipy.ndimage.label(partition[box] == row)
        reaches = np.zeros(n + 1, dtype=bool)
        reaches[piece[is_plane[box]]] = True
        reaches[0] = True
        is_crumb[box] |= ~reaches[piece]
    if is_crumb.any():
        place = scipy.ndimage.distance_transform_edt(
            is_crumb, return_distances=False, return_indices=True
        )
        nearest = place[:, is_crumb]
        at, old, new = np.nonzero(is_crumb), partition[is_crumb], partition[tuple(nearest)]
        low, high = levels[(channel[old], *at)], levels[(channel[new], *at)]
        levels[(channel[old], *at)], levels[(channel[new], *at)] = high, low
        partition[is_crumb] = new


def _between_slices(
    number: NDArray[np.integer], axis: int, factors: Sequence[int]
) -> NDArray[np.integer]:
    """Labels on slices divided along one axis, interpolated by shape.

    Within a slice a label's level is the signed distance to its outline; between slices it is
    linear. A component that is absent from the next slice shrinks to its innermost point halfway.

    Parameters
    ----------
    number : (*shape) int
        Rows of labels.
    axis : int
        The divided axis.
    factors : sequence of int
        Factors of all axes; axes after `axis` are not divided yet, so that their voxels are longer
        by their factors.
    """
    length = [float(f) if i > axis else 1.0 for i, f in enumerate(factors)]
    length[axis] = ABSENT_DISTANCE
    divided = [factors[axis] if i == axis else 1 for i in range(number.ndim)]
    shape = tuple(n * f for n, f in zip(number.shape, divided, strict=True))
    smallest, partition = (
        np.full(shape, np.inf, dtype=np.float32),
        np.zeros(shape, dtype=number.dtype),
    )
    for row, box in enumerate(scipy.ndimage.find_objects(number + 1)):
        margin = tuple(
            slice(max(s.start - 1, 0), min(s.stop + 1, n))
            for s, n in zip(box, number.shape, strict=True)
        )
        fine = tuple(slice(s.start * f, s.stop * f) for s, f in zip(margin, divided, strict=True))
        level = _interpolate_level(number[margin] == row, axis, factors[axis], length)
        least = smallest[fine]
        partition[fine][level < least] = row
        np.minimum(least, level, out=least)
    return partition


def _interpolate_level(
    inside: Bools, axis: int, factor: int, length: Sequence[float]
) -> NDArray[np.float32]:
    """A label's level on slices divided along one axis."""
    inside = np.moveaxis(inside, axis, 0)
    length = [length[axis], *length[:axis], *length[axis + 1 :]]
    level, deepest = _outline_distance(inside, length)
    fine = np.repeat(level, factor, axis=0)
    middle = factor // 2
    for k in range(len(level) - 1):
        is_crossed = inside[k] != inside[k + 1]
        low, high = (
            np.where(is_crossed, np.clip(level[one], -most, most), level[one])
            for one, most in ((k, _rest(level, deepest, k + 1)), (k + 1, _rest(level, deepest, k)))
        )
        for step in range(1, factor):
            fine[k * factor + middle + step] = low + (high - low) * np.float32(step / factor)
    return np.moveaxis(fine, 0, axis)


def _rest(level: NDArray[np.float32], deepest: NDArray[np.float32], k: int) -> NDArray[np.float32]:
    """Largest distance of a slice from its outline where slice `k` is on the other side.

    A component of depth D that ends there is cut off at its depth d after the fraction t = sqrt(1 -
    (1 - d / D)^2) / 2 of the way, like half an ellipsoid that ends halfway. Linear from -d, the
    other level is d (1 / t - 1).
    """
    fraction = np.abs(level[k]) / deepest[k]
    return deepest[k] * (2.0 * np.sqrt(fraction / (2.0 - fraction)) - fraction)


def _outline_distance(
    inside: Bools, length: Sequence[float]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Signed distance to the outline within each slice, and the largest in each voxel's
    component.
    """
    link = np.zeros((3,) * inside.ndim)
    link[1] = [[0, 1, 0], [1, 1, 1], [0, 1, 0]] if inside.ndim == 3 else [1, 1, 1]
    level, deepest = (
        np.zeros(inside.shape, dtype=np.float32),
        np.zeros(inside.shape, dtype=np.float32),
    )
    for side, sign in ((inside, -1.0), (~inside, 1.0)):
        distance = np.minimum(
            scipy.ndimage.distance_transform_edt(side, length)
            if not side.all()
            else ABSENT_DISTANCE,
            ABSENT_DISTANCE,
        )
        piece, n = scipy.ndimage.label(side, link)
        largest = np.zeros(n + 1, dtype=np.float32)
        np.maximum.at(largest, piece, np.where(side, distance - 0.5, 0.0))
        level += np.where(side, sign * (distance - 0.5), 0.0).astype(np.float32)
        deepest += largest[piece]
    return level, deepest
