"""Local thickness of labels: the diameter of the largest ball within a label that covers a place.

The local thickness of Hildebrand and Ruegsegger (1997, J. Microsc. 185, 67) is measured between the
smooth surfaces of labels (`tetopt.contents.memberships`) rather than between voxels: a sheet of 1.5
voxels has 1.5, where distances of voxel centres would give 1 or 2. At a voxel in the middle of its
label, the diameter is the shortest of the 13 chords through it along axes and diagonals, times the
cosine of its angle with the surfaces' normals (the mean of both ends). A chord ends where another
label's level becomes as small; between facets, it ends where it crosses one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from math import prod
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from tetopt.contents.memberships import Memberships
from tetopt.geometry.vectors import cross, dot, minus, row, scale_vector
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.budget import check_memory
from tetopt.system.kernel_cache import njit
from tetopt.system.slabs import over_slabs

# percentiles over a label's voxels that describe its thickness
THICKNESS_PERCENTILES = (5.0, 50.0, 95.0)
THICKNESS_BYTES = 19.0  # per voxel: chords, thickness, the labels, and the labels within a region
BOUND_BYTES = 8.0  # per voxel: limits of balls, and the labels
STEP_BYTES, CROSSING_BYTES = 1.0, 2.0  # per direction, and voxel of the slabs in work
BEYOND_REGION = -1  # stands for a label beyond the region
NO_CROSSING = 2**16 - 1  # marks a step that no facet crosses
COSINE_STEPS = 256  # steps of a cosine; a crossing is a multiple of as many steps
# planes of a slab, at least: crossings and steps are counted in those around it, too
SLAB_PLANES = 80
MOST_STEPS = 255  # counted steps within a label
# between the shortest chord and a normal; smaller at creases, which have no normal
LEAST_COSINE = 0.75
BESIDE_FRACTION = 1e-9  # of a triangle's size: places this little outside count as inside
ABOVE_LIMIT = 1.0 + 1e-9  # times an upper limit of a chord: above it, however rounded
# largest difference of the two ways along the shortest chord through a middle
OFF_MIDDLE_STEPS = 1.01


class _Labels(NamedTuple):
    """Labels on a grid, as passed to kernels."""

    # (s_0, s_1, s_2) row of the label; -1 beyond the region; small, to fit into caches
    partition: NDArray[np.int16]
    levels: NDArray[np.float32]  # (C, s_0, s_1, s_2)
    channel: Ints  # (K,)
    # (D, s_0, s_1, s_2) place where facets cross each step up, 0 to 254, times 256, plus the cosine
    # of the angle, 0 to 255;
    crossing: NDArray[np.uint16]  # empty if there are levels


def local_thickness(
    members: Memberships,
    spacing: Floats,
    most: float,
    inside: Bools | None = None,
) -> NDArray[np.float32]:
    """The local thickness of each voxel's label.

    Parameters
    ----------
    members : Memberships
        Levels of K labels on a grid.
    spacing : (n,) float64
        Edges of its voxels, mm.
    most : float
        Upper limit of the thickness, mm; larger values are clipped.
    inside : (*shape) bool, optional
        The region of the labels; its surface ends them.

    Returns
    -------
    (*shape) float32
        mm; 0 beyond the region.

    Raises
    ------
    InputError
        Not enough memory for it.
    """
    _check_room(members.partition.shape, THICKNESS_BYTES, STEP_BYTES, spacing, 0.0)
    partition = (
        members.partition if inside is None else np.where(inside, members.partition, BEYOND_REGION)
    )
    labels, rays, whole = _labels_of(partition, members), _rays(spacing), _in_space(partition)
    chord, is_middle = np.zeros(whole, dtype=np.float32), np.zeros(whole, dtype=np.bool_)
    reach, n = int(most / rays[1][:, 1].min()) + 1, partition.ndim
    n_slabs = max(whole[3 - n] // SLAB_PLANES, numba.get_num_threads())
    _over_slabs(
        lambda slab: _fill_chords(chord, is_middle, labels, rays, most, reach, slab),
        whole,
        n,
        n_slabs,
    )
    thickness = chord.copy()
    _over_slabs(
        lambda slab: _spread_balls(thickness, chord, is_middle, labels.partition, rays[2], slab),
        whole,
        n,
    )
    return thickness.reshape(partition.shape)


def thickness_at(
    places: Ints,
    partition: NDArray[np.integer],
    surfaces: Memberships | Floats,
    spacing: Floats,
    most: float,
) -> NDArray[np.float32]:
    """Local thickness of labels at some voxels, the same as that of all.

    Parameters
    ----------
    places : (K,) int
        Indices of the voxels, flat.
    partition : (s_0, ..., s_{n-1}) array of int
        Label of each voxel's centre, any whole number from 0; -1 beyond the region.
    surfaces : Memberships or (F, n, n) float64
        Levels of the labels on this grid; or facets, such as those of a mesh: the nodes of each
        between two labels, mm from the centre of the first voxel, along the grid's axes.
    spacing : (n,) float64
        Edges of the voxels, mm.
    most : float
        Upper limit of the thickness, mm; larger values are clipped to it.

    Returns
    -------
    (K,) float32
        mm; 0 beyond the region.

    Raises
    ------
    InputError
        Not enough memory.
    """
    n, axis, rays, whole = partition.ndim, 3 - partition.ndim, _rays(spacing), _in_space(partition)
    at = np.stack(np.unravel_index(places, whole), axis=1)
    # a ball's centre is as far away as its radius, and its chords end as far away as its size
    beyond = 1.5 * most
    reach = int(beyond / float(min(spacing))) + 1
    levels, corners = (surfaces, None) if isinstance(surfaces, Memberships) else (None, surfaces)
    of_step = CROSSING_BYTES if levels is None else 0.0
    _check_room(partition.shape, BOUND_BYTES, of_step, spacing, beyond)
    corners = _in_planes(corners) if corners is not None and n == 2 else corners
    labels = _labels_of(partition, levels)
    balls, sizes = _ball_offsets(rays[2], most, axis), np.zeros(len(at), dtype=np.float32)

    def fill(slab: tuple[tuple[int, int], ...]) -> None:
        first, stop = slab[axis]
        ends = max(first - reach, 0), min(stop + reach, whole[axis])
        around = (slice(None),) * axis + (slice(*ends),)
        near = labels._replace(partition=labels.partition[around])
        if corners is None:
            near = near._replace(levels=near.levels[:, *around])
        else:  # 26 bytes a voxel
            crossing = np.full((len(rays[0]), *near.partition.shape), NO_CROSSING, np.uint16)
            _fill_crossings(crossing, corners, rays[0] * rays[2], rays[2], ends, axis)
            near = near._replace(crossing=crossing)
        own = (first <= at[:, axis]) & (at[:, axis] < stop)
        index = at[own]
        index[:, axis] -= ends[0]
        bound = np.full(near.partition.shape, np.inf, dtype=np.float32)
        sizes[own] = _thickness_near(index, near, rays, balls, most, bound)

    _over_slabs(fill, whole, n, max(whole[axis] // SLAB_PLANES, numba.get_num_threads()))
    return sizes


def _ball_offsets(edges: Floats, most: float, axis: int) -> tuple[Ints, Floats]:
    """Voxels (O, 3) in a ball of this size around one, in the plane if `axis` is 1, and the squares
    of their distances.
    """
    most_steps = (0.5 * most / edges).astype(int)
    most_steps[:axis] = 0
    offsets = np.indices(tuple(2 * most_steps + 1)).reshape(3, -1).T - most_steps
    squares = ((offsets * edges) ** 2).cumsum(axis=1)[:, 2]
    is_near = squares <= 0.25 * most * most
    return offsets[is_near], squares[is_near]


def _in_planes(segments: Floats) -> Floats:
    """Two triangles for each segment (F, 2, 2), of a rectangle across the plane."""
    flat = np.stack(
        [np.pad(segments, ((0, 0), (0, 0), (1, 0)), constant_values=x) for x in (-1.0, 1.0)],
        axis=2,
    )
    # below and above the first node, and then the second
    flat = flat.reshape(len(segments), 4, 3)
    return np.concatenate([flat[:, :3], flat[:, 1:]])


def _check_room(
    shape: tuple[int, ...], of_voxel: float, of_step: float, spacing: Floats, beyond: float
) -> None:
    """Check the memory for a grid, in bytes by voxel, and by direction in the slabs in work and
    `beyond` them, mm.
    """
    planes = 2.0 * beyond / float(min(spacing)) + SLAB_PLANES
    fraction = min(numba.get_num_threads() * planes / shape[0], 1.0)
    n_bytes = of_voxel + of_step * len(_rays(spacing)[0]) * fraction
    check_memory(n_bytes * prod(shape), "thickness of labels", "crop the image")


def _in_space(partition: NDArray) -> tuple[int, ...]:
    return (1,) * (3 - partition.ndim) + partition.shape


def _labels_of(partition: NDArray[np.integer], members: Memberships | None) -> _Labels:
    whole = _in_space(partition)
    return _Labels(
        partition.reshape(whole).astype(np.int16, copy=False),
        np.zeros((1, 1, 1, 1), np.float32)
        if members is None
        else members.levels.reshape(-1, *whole),
        np.zeros(1, dtype=np.int64) if members is None else members.channel,
        np.zeros((0, 1, 1, 1), np.uint16),
    )


def _over_slabs(
    fill: Callable[[tuple[tuple[int, int], ...]], None],
    whole: tuple[int, ...],
    n: int,
    most: int | None = None,
) -> None:
    """Call a function for each slab of a grid, on all threads; each call writes only to its
    slab.
    """
    box = [(0, size) for size in whole]
    over_slabs(
        lambda *ends: fill((*box[: 3 - n], ends, *box[4 - n :])), whole[3 - n], prod(whole), most
    )


def _rays(spacing: Floats) -> tuple[Ints, Floats, Floats]:
    """Steps (D, 3) along axes and diagonals, one of each opposite pair, the lengths of any number
    of each, and a voxel's edges.
    """
    n = len(spacing)
    edges = np.concatenate([np.ones(3 - n), spacing])
    steps = np.array(
        [
            s
            for s in itertools.product((-1, 0, 1), repeat=3)
            if s > (0, 0, 0) and not any(s[: 3 - n])
        ]
    )
    lengths = np.repeat(np.linalg.norm(steps * edges, axis=1)[:, None], MOST_STEPS, axis=1)
    return steps, np.cumsum(np.pad(lengths, ((0, 0), (1, 0))), axis=1), edges


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_chords(
    chord: NDArray,
    is_middle: NDArray,
    labels: _Labels,
    rays: tuple[NDArray, NDArray, NDArray],
    most: float,
    reach: int,
    slab: tuple[tuple[int, int], ...],
) -> None:
    """Fill in the shortest chord through each voxel of a slab, across its surfaces, and mark voxels
    in its middle.

    Ways begin after the steps that stay within the label, which are counted from voxel to voxel,
    from as many planes (rows in 2-D) beyond the slab as chords reach: a tenth of the time of
    walking from each voxel.
    """
    (steps, ways, _), partition = rays, labels.partition
    low, high = max(slab[1][0] - reach, 0), min(slab[1][1] + reach, partition.shape[1])
    before, after = max(slab[0][0] - reach, 0), min(slab[0][1] + reach, partition.shape[0])
    first, size, most_steps = (
        slab[0][0],
        (len(steps), high - low, partition.shape[2]),
        min(reach, MOST_STEPS),
    )
    up, beyond = (
        np.zeros((slab[0][1] - first, *size), dtype=np.uint8),
        np.zeros((2, *size), dtype=np.uint8),
    )
    part = partition[:, low:high]
    for i in range(after - 1, first - 1, -1):
        here = up[i - first] if i < slab[0][1] else beyond[i % 2]
        last = up[i + 1 - first] if i + 1 < slab[0][1] else beyond[(i + 1) % 2]
        _fill_steps(here, last, part, i, steps, most_steps)
    for i in range(before, slab[0][1]):
        down = beyond[i % 2]
        _fill_steps(down, beyond[(i + 1) % 2], part, i, -steps, most_steps)
        for j in range(slab[1][0], slab[1][1] if i >= first else slab[1][0]):
            for k in range(*slab[2]):
                if partition[i, j, k] < 0:
                    continue
                least, off_middle, shortest = most, np.inf, -1
                # a chord ends within a step of both voxels, if these are known
                for d in range(len(steps)):
                    n, m = up[i - first, d, j - low, k], down[d, j - low, k]
                    if max(n, m) < most_steps:
                        least = min(least, (ways[d, n + 1] + ways[d, m + 1]) * ABOVE_LIMIT)
                for d in range(len(steps)):
                    n, m = up[i - first, d, j - low, k], down[d, j - low, k]
                    if ways[d, n] + ways[d, m] >= least:
                        continue
                    step = row(steps, d)
                    forth = _way(labels, (i, j, k), (d, step), ways, n, least)
                    if forth + ways[d, m] >= least:
                        continue
                    step = (-step[0], -step[1], -step[2])
                    back = _way(labels, (i, j, k), (-1 - d, step), ways, m, least - forth)
                    if forth + back < least:
                        least, off_middle, shortest = (
                            forth + back,
                            abs(forth - back) / ways[d, 1],
                            d,
                        )
                chord[i, j, k] = _across(labels, (i, j, k), rays, shortest, least)
                is_middle[i, j, k] = off_middle <= OFF_MIDDLE_STEPS


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_steps(
    count: NDArray, last: NDArray, partition: NDArray, i: int, steps: NDArray, most: int
) -> None:
    """Count the steps (D, 3) from voxels of plane i that stay within their label, (D, s_1, s_2), up
    to `most`.

    It is `most`, too, where they leave the grid. `last` has the counts of the plane before, to
    which steps across planes lead, all of them in the same sense.
    """
    _, n_rows, n_columns = partition.shape
    for d in range(len(steps)):
        a, s, t = i + steps[d, 0], steps[d, 1], steps[d, 2]
        is_in = 0 <= a < len(partition)
        source, begin, size = count if a == i else last, max(-t, 0), n_columns - abs(t)
        for number in range(n_rows):
            j = n_rows - 1 - number if s > 0 or (s == 0 and t > 0) else number
            b = j + s
            if not (is_in and 0 <= b < n_rows):
                count[d, j] = most
                continue
            count[d, j, 0] = count[d, j, n_columns - 1] = most
            own, other = (
                partition[i, j, begin : begin + size],
                partition[a, b, begin + t : begin + t + size],
            )
            here, there = (
                count[d, j, begin : begin + size],
                source[d, b, begin + t : begin + t + size],
            )
            for m in range(size):
                at = size - 1 - m if t > 0 and b == j else m
                here[at] = min(there[at] + 1, most) if own[at] == other[at] else 0


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")
def _way(
    labels: _Labels,
    place: tuple[int, int, int],
    direction: tuple[int, tuple[int, int, int]],
    ways: NDArray,
    n: int,
    most: float,
) -> float:
    """Distance from a voxel's centre to its label's surface along steps, mm; infinite if the grid
    ends, or at `most`.

    `direction` is its number and its step; steps down have numbers -1 to -D. `ways` has the length
    of any number of steps along each, of which the first `n` stay within the label. It is inlined:
    a call would take twice as long as its body. Steps are tuples: views of arrays, which threads
    count together, doubled the time of all chords.
    """
    partition, levels, channel, crossing = labels
    (i, j, k), (d, step) = place, direction
    along = d if d >= 0 else -1 - d
    own, way, length = partition[i, j, k], ways[along, n], ways[along, 1]
    i, j, k = i + n * step[0], j + n * step[1], k + n * step[2]
    while way < most:
        a, b, c = i + step[0], j + step[1], k + step[2]
        is_in = (
            0 <= a < partition.shape[0]
            and 0 <= b < partition.shape[1]
            and 0 <= c < partition.shape[2]
        )
        if not is_in:
            return np.inf
        if partition[a, b, c] < 0:
            return way + 0.5 * length
        other = partition[a, b, c]
        if other != own and len(crossing) > 0:
            part = crossing[along, i, j, k] if d >= 0 else crossing[along, a, b, c]
            if part == NO_CROSSING:  # overlapping cells
                return way + 0.5 * length
            fraction = (part // COSINE_STEPS) / (COSINE_STEPS - 2.0)
            return float(way + length * (fraction if d >= 0 else 1.0 - fraction))
        if other != own:
            here = levels[channel[other], i, j, k] - levels[channel[own], i, j, k]
            there = levels[channel[own], a, b, c] - levels[channel[other], a, b, c]
            # 1e-6 of a level, chosen: against division by 0
            return float(way + length * here / max(here + there, 1e-6))
        i, j, k, way = a, b, c, way + length
    return np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _cosine(
    labels: _Labels,
    place: tuple[int, int, int],
    direction: tuple[int, tuple[int, int, int]],
    length: float,
    edges: NDArray,
) -> float:
    """Cosine of the angle between a way to the label's surface (`_way`) and the normal there; 1 if
    that is unknown.

    Between levels the normal is along the gradient of the other label's level.
    """
    partition, levels, channel, crossing = labels
    (i, j, k), (d, step) = place, direction
    a, b, c = i + step[0], j + step[1], k + step[2]
    while True:
        is_in = (
            0 <= a < partition.shape[0]
            and 0 <= b < partition.shape[1]
            and 0 <= c < partition.shape[2]
        )
        if not is_in or partition[a, b, c] < 0:
            return 1.0
        if partition[a, b, c] != partition[i, j, k]:
            break
        i, j, k, a, b, c = a, b, c, a + step[0], b + step[1], c + step[2]
    if len(crossing) > 0:
        part = crossing[d, i, j, k] if d >= 0 else crossing[-1 - d, a, b, c]
        return (
            1.0
            if part == NO_CROSSING
            else max((part % COSINE_STEPS) / (COSINE_STEPS - 1.0), LEAST_COSINE)
        )
    level, at = levels[channel[partition[a, b, c]]], (a, b, c)
    along, square = 0.0, 0.0
    for axis in range(3):
        low = at[axis] - (1 if at[axis] > 0 else 0)
        high = at[axis] + (1 if at[axis] + 1 < level.shape[axis] else 0)
        above = level[high if axis == 0 else a, high if axis == 1 else b, high if axis == 2 else c]
        below = level[low if axis == 0 else a, low if axis == 1 else b, low if axis == 2 else c]
        slope = (above - below) / (max(high - low, 1) * edges[axis])
        along += slope * step[axis] * edges[axis]
        square += slope * slope
    return max(abs(along) / (length * np.sqrt(square)), LEAST_COSINE) if square > 0.0 else 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _across(
    labels: _Labels,
    place: tuple[int, int, int],
    rays: tuple[NDArray, NDArray, NDArray],
    d: int,
    chord: float,
) -> float:
    """The length of a chord in direction d, -1 for none, across its label's surfaces."""
    if d < 0:
        return chord
    ways, edges, step = rays[1], rays[2], row(rays[0], d)
    forth = _cosine(labels, place, (d, step), ways[d, 1], edges)
    step = (-step[0], -step[1], -step[2])
    back = _cosine(labels, place, (-1 - d, step), ways[d, 1], edges)
    return chord * (0.5 * (forth + back))


@njit(cache=True, nogil=True, error_model="numpy")
def _chord_through(
    labels: _Labels,
    place: tuple[int, int, int],
    rays: tuple[NDArray, NDArray, NDArray],
    limits: tuple[float, float],
    first: int,
) -> tuple[float, bool, int]:
    """The shortest chord through a voxel as in `_fill_chords`, whether the voxel is in its middle,
    and its direction; or any chord shorter than the lower of the limits, which that in the `first`
    direction mostly is.
    """
    (steps, ways, _), (low, least) = rays, limits
    off_middle, shortest = np.inf, -1
    for number in range(-1, len(steps)):
        d = first if number < 0 else number
        step = row(steps, d)
        forth = _way(labels, place, (d, step), ways, 0, least)
        if forth >= least:
            continue
        step = (-step[0], -step[1], -step[2])
        back = _way(labels, place, (-1 - d, step), ways, 0, least - forth)
        if np.float32(forth + back) < low:
            return forth + back, True, d
        if number >= 0 and forth + back < least:
            least, off_middle, shortest = forth + back, abs(forth - back) / ways[d, 1], d
    chord = _across(labels, place, rays, shortest, least)
    return chord, off_middle <= OFF_MIDDLE_STEPS, max(shortest, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _thickness_near(
    places: NDArray,
    labels: _Labels,
    rays: tuple[NDArray, NDArray, NDArray],
    balls: tuple[NDArray, NDArray],
    most: float,
    bound: NDArray,
) -> NDArray:
    """`local_thickness` at voxels (K, 3): the size of the largest ball around a middle nearby, at
    `balls`' offsets (O, 3) with their squares, that covers each.

    `bound` is an upper limit of the size of each voxel's ball, infinite at first: most voxels need
    one direction of 13.
    """
    (offsets, squares), shape = balls, labels.partition.shape
    sizes, d = np.zeros(len(places), dtype=np.float32), 0
    for p in range(len(places)):
        i, j, k = row(places, p)
        own = labels.partition[i, j, k]
        if own < 0:
            continue
        size, _, d = _chord_through(labels, (i, j, k), rays, (0.0, most), d)
        sizes[p] = size
        for o in range(len(offsets)):
            a, b, c = i + offsets[o, 0], j + offsets[o, 1], k + offsets[o, 2]
            is_in = 0 <= a < shape[0] and 0 <= b < shape[1] and 0 <= c < shape[2]
            if sizes[p] >= np.float32(most):
                break
            if not is_in or labels.partition[a, b, c] != own or bound[a, b, c] <= sizes[p]:
                continue
            if squares[o] > (0.5 * bound[a, b, c]) ** 2:
                continue
            low = max(float(sizes[p]), 2.0 * np.sqrt(squares[o]))
            size, is_middle, d = _chord_through(labels, (a, b, c), rays, (low, most), d)
            bound[a, b, c] = size if is_middle else 0.0
            if bound[a, b, c] > sizes[p] and squares[o] <= (0.5 * bound[a, b, c]) ** 2:
                sizes[p] = bound[a, b, c]
    return sizes


@njit(cache=True, nogil=True, error_model="numpy")
def _spread_balls(
    thickness: NDArray,
    chord: NDArray,
    is_middle: NDArray,
    partition: NDArray,
    edges: NDArray,
    slab: tuple[tuple[int, int], ...],
) -> None:
    """Raise the thickness of a slab's voxels to the diameter of the largest ball around a middle
    that covers them.
    """
    for i in range(partition.shape[0]):
        for j in range(partition.shape[1]):
            for k in range(partition.shape[2]):
                if not is_middle[i, j, k]:
                    continue
                size, r = chord[i, j, k], 0.5 * chord[i, j, k]
                r0, r1, r2 = int(r / edges[0]), int(r / edges[1]), int(r / edges[2])
                for a in range(max(i - r0, slab[0][0]), min(i + r0 + 1, slab[0][1])):
                    x = 0.0 if a == i else ((a - i) * edges[0]) ** 2
                    for b in range(max(j - r1, slab[1][0]), min(j + r1 + 1, slab[1][1])):
                        y = x + ((b - j) * edges[1]) ** 2
                        if y > r * r:
                            continue
                        for c in range(max(k - r2, slab[2][0]), min(k + r2 + 1, slab[2][1])):
                            is_in = (
                                thickness[a, b, c] < size and y + ((c - k) * edges[2]) ** 2 <= r * r
                            )
                            if is_in and partition[a, b, c] == partition[i, j, k]:
                                thickness[a, b, c] = size


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_crossings(
    crossing: NDArray,
    corners: NDArray,
    ways: NDArray,
    edges: NDArray,
    ends: tuple[int, int],
    axis: int,
) -> None:
    """Find where triangles first cross the ways (D, 3), mm, up from voxel centres, in a slab across
    an axis.

    `crossing` has the planes of the slab alone.
    The cosine of the angle between way and normal is stored, too (`_Labels`).

    A triangle's height over a place is in lengths of its normal, which is not a unit vector.
    """
    first, last, rise = (
        np.zeros(3, dtype=np.int64),
        np.zeros(3, dtype=np.int64),
        np.zeros(len(ways)),
    )
    lengths, origin = np.sqrt((ways * ways).sum(axis=1)), np.zeros(3, dtype=np.int64)
    origin[axis] = ends[0]
    for facet in range(len(corners)):
        a, b, c = row(corners[facet], 0), row(corners[facet], 1), row(corners[facet], 2)
        for d in range(3):
            low, high = min(a[d], b[d], c[d]) / edges[d], max(a[d], b[d], c[d]) / edges[d]
            first[d], last[d] = max(int(np.ceil(low)) - 1, 0), int(np.floor(high)) + 1
            last[d] = min(last[d], crossing.shape[1 + d] - 1 + origin[d])
        first[axis], last[axis] = max(first[axis], ends[0]), min(last[axis], ends[1] - 1)
        u, v = minus(b, a), minus(c, a)
        normal = cross(u, v)
        for s in range(len(ways)):
            rise[s] = dot(normal, row(ways, s))
        steepest, size = np.abs(rise).max(), np.sqrt(dot(normal, normal))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    place = minus((i * edges[0], j * edges[1], k * edges[2]), a)
                    height = dot(normal, place)
                    if abs(height) > steepest:
                        continue
                    for s in range(len(ways)):
                        if height * rise[s] > 0.0 or abs(height) > abs(rise[s]) or rise[s] == 0.0:
                            continue
                        t = -height / rise[s]
                        if _is_within(minus(place, scale_vector(-t, row(ways, s))), u, v):
                            part = COSINE_STEPS * int((COSINE_STEPS - 2) * t + 0.5)
                            part += int(
                                (COSINE_STEPS - 1) * min(abs(rise[s]) / (size * lengths[s]), 1.0)
                                + 0.5
                            )
                            at = s, i - origin[0], j - origin[1], k - origin[2]
                            crossing[at] = min(crossing[at], np.uint16(part))


@njit(cache=True, nogil=True, error_model="numpy")
def _is_within(
    place: tuple[float, float, float], u: tuple[float, float, float], v: tuple[float, float, float]
) -> bool:
    """True if a place in the plane of a triangle (corners 0, u and v) lies inside it."""
    uu, vv, uv, along_u, along_v = dot(u, u), dot(v, v), dot(u, v), dot(u, place), dot(v, place)
    square = uu * vv - uv * uv
    first, second = vv * along_u - uv * along_v, uu * along_v - uv * along_u
    return bool(min(first, second, square - first - second) >= -BESIDE_FRACTION * square)
