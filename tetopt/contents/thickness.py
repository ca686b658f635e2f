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
from math import prod
from typing import NamedTuple

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.memberships import Memberships
from tetopt.geometry.vectors import cross, dot, minus, row, scale_vector
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.budget import check_memory
from tetopt.system.kernel_cache import njit
from tetopt.system.slabs import over_slabs

# percentiles over a label's voxels that describe its thickness
THICKNESS_PERCENTILES = (5.0, 50.0, 95.0)
THICKNESS_BYTES = 8.0  # per voxel: thickness, the labels, and the labels within a region
# per voxel of the slabs in work: chords, their directions and middles; crossings, per direction
SLAB_BYTES, CROSSING_BYTES = 10.0, 2.0
BEYOND_REGION = -1  # stands for a label beyond the region
NO_CROSSING = 2**16 - 1  # marks a step that no facet crosses
COSINE_STEPS = 256  # steps of a cosine; a crossing is a multiple of as many steps
# planes of a slab, at least: runs are followed, and crossings counted, in those around it, too
SLAB_PLANES = 80
GRADIENT_VOXELS = 2  # beyond a voxel of another label: a voxel next to it, and one next to that
NO_RUN = -1  # a run that begins beyond the grid or the reach of chords
# between the shortest chord and a normal; smaller at creases, which have no normal
LEAST_COSINE = 0.75
BESIDE_FRACTION = 1e-9  # of a triangle's size: places this little outside count as inside
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
    partition: NDArray[np.integer],
    surfaces: Memberships | Floats,
    spacing: Floats,
    most: float,
) -> NDArray[np.float32]:
    """The local thickness of each voxel's label.

    Parameters
    ----------
    partition : (s_0, ..., s_{n-1}) array of int
        Label of each voxel's centre, any whole number from 0; -1 beyond the region, whose surface
        ends labels.
    surfaces : Memberships or (F, n, n) float64
        Levels of the labels on this grid; or facets, such as those of a mesh: the nodes of each
        between two labels, mm from the centre of the first voxel, along the grid's axes.
    spacing : (n,) float64
        Edges of the voxels, mm.
    most : float
        Upper limit of the thickness, mm; larger values are clipped to it.

    Returns
    -------
    (s_0, ..., s_{n-1}) float32
        mm; 0 beyond the region.

    Raises
    ------
    InputError
        Not enough memory.
    """
    n, axis, rays = partition.ndim, 3 - partition.ndim, _rays(spacing, most)
    # a ball's centre is as far away as its radius, and its chords end as far away as its size
    radius = int(0.5 * most / float(min(spacing))) + 1
    reach = radius + rays[1].shape[1]
    levels, corners = (surfaces, None) if isinstance(surfaces, Memberships) else (None, surfaces)
    _check_room(partition.shape, reach, 0 if levels is not None else len(rays[0]))
    corners = _in_planes(corners) if corners is not None and n == 2 else corners
    rows = partition.reshape((1,) * axis + partition.shape)
    thickness = np.full(rows.shape, 0.0 if rows.flat[0] < 0 else most, dtype=np.float32)
    # No chord lies beyond the box of all labels but that in the corner; gradients look as far.
    box = tuple(
        slice(max(side.start - GRADIENT_VOXELS, 0), min(side.stop + GRADIENT_VOXELS, size))
        for extent in scipy.ndimage.find_objects((rows != rows.flat[0]).view(np.int8))
        for side, size in zip(extent, rows.shape, strict=True)
    )

    def fill(first: int, stop: int) -> None:
        ends = max(first - reach, 0), min(stop + reach, n_planes)
        begin = box[axis].start
        around = (*box[:axis], slice(begin + ends[0], begin + ends[1]), *box[axis + 1 :])
        near = _Labels(
            np.ascontiguousarray(rows[around], dtype=np.int16),
            np.zeros((1, 1, 1, 1), np.float32)
            if levels is None
            else np.ascontiguousarray(levels.levels.reshape(-1, *rows.shape)[:, *around]),
            np.zeros(1, dtype=np.int64) if levels is None else levels.channel,
            np.zeros((0, 1, 1, 1), np.uint16),
        )
        if corners is not None:  # 26 bytes a voxel
            crossing = np.full((len(rays[0]), *near.partition.shape), NO_CROSSING, np.uint16)
            origin = np.array([side.start for side in around])
            _fill_crossings(crossing, corners, rays[0] * rays[2], rays[2], origin)
            near = near._replace(crossing=crossing)
        slab = first - ends[0], stop - ends[0]
        wide = max(slab[0] - radius, 0), min(slab[1] + radius, ends[1] - ends[0])
        thick = _thickness(_chords(near, rays, most, axis, wide), near, rays, (axis, *slab))
        own = (*box[:axis], slice(begin + first, begin + stop), *box[axis + 1 :])
        thickness[own] = thick[(slice(None),) * axis + (slice(*slab),)]

    if box:
        n_planes = box[axis].stop - box[axis].start
        n_slabs = max(n_planes // SLAB_PLANES, numba.get_num_threads())
        over_slabs(fill, n_planes, thickness.size, n_slabs)
    return thickness.reshape(partition.shape)


def rows_within(partition: NDArray[np.integer], inside: Bools | None) -> NDArray[np.integer]:
    """Rows of voxels' labels, `BEYOND_REGION` beyond a region."""
    return partition if inside is None else np.where(inside, partition, BEYOND_REGION)


def _in_planes(segments: Floats) -> Floats:
    """Two triangles for each segment (F, 2, 2), of a rectangle across the plane."""
    flat = np.stack(
        [np.pad(segments, ((0, 0), (0, 0), (1, 0)), constant_values=x) for x in (-1.0, 1.0)],
        axis=2,
    )
    # below and above the first node, and then the second
    flat = flat.reshape(len(segments), 4, 3)
    return np.concatenate([flat[:, :3], flat[:, 1:]])


def _check_room(shape: tuple[int, ...], reach: int, n_crossings: int) -> None:
    """Check the memory for a grid, and for the slabs in work with the planes around them."""
    planes = numba.get_num_threads() * (SLAB_PLANES + 2.0 * reach)
    of_slab = (SLAB_BYTES + n_crossings * CROSSING_BYTES) * min(planes / shape[0], 1.0)
    n_bytes = (THICKNESS_BYTES + of_slab) * prod(shape)
    check_memory(n_bytes, "thickness of labels", "crop the image")


def _rays(spacing: Floats, most: float) -> tuple[Ints, Floats, Floats]:
    """Steps (D, 3) along axes and diagonals, one of each opposite pair and each after the last in
    the order of voxels, the lengths of any number of each up to `most`, and a voxel's edges.
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
    lengths, n_steps = np.linalg.norm(steps * edges, axis=1), int(most / min(spacing)) + 1
    lengths = np.repeat(lengths[:, None], n_steps, axis=1)
    return steps, np.cumsum(np.pad(lengths, ((0, 0), (1, 0))), axis=1), edges


@njit(cache=True, nogil=True, error_model="numpy")
def _chords(
    labels: _Labels,
    rays: tuple[NDArray, NDArray, NDArray],
    most: float,
    axis: int,
    ends: tuple[int, int],
) -> tuple[NDArray, NDArray, NDArray]:
    """Length of the shortest chord through each voxel of a slab across an axis, its direction, -1
    for none below `most`, and True in its middle.

    A chord passes through a run of voxels of one label. Each voxel knows how many of its run come
    before it, and how far before the first one the surface is: those of the plane, the row and the
    voxel before are known already. Where a run ends, its voxels get its chord.
    """
    (steps, ways, _), partition = rays, labels.partition
    n_planes, n_rows, n_columns = partition.shape
    least, best = np.full(partition.size, most), np.full(partition.size, -1, dtype=np.int8)
    is_middle = np.zeros(partition.size, dtype=np.bool_)
    # of the last two planes
    before = np.empty((2, n_rows, n_columns), dtype=np.int16)
    begin = np.empty((2, n_rows, n_columns))
    for d in range(len(steps)):
        (s, t, u), length = row(steps, d), ways[d, 1]
        stride = (s * n_rows + t) * n_columns + u
        before[:] = NO_RUN
        for i in range(n_planes):
            a = i - s
            for j in range(n_rows):
                b, here, n_here = j - t, partition[i, j], before[i % 2, j]
                n_here[:] = NO_RUN
                if a < 0 or b < 0 or b >= n_rows:
                    continue
                there, n_there = partition[a, b], before[a % 2, b]
                begin_here, begin_there = begin[i % 2, j], begin[a % 2, b]
                for k in range(max(u, 0), n_columns + min(u, 0)):
                    c = k - u
                    n = n_there[c]
                    if here[k] == there[c]:
                        if n >= 0 and ways[d, n] < most:
                            n_here[k], begin_here[k] = n + 1, begin_there[c]
                        continue
                    end, begin_here[k] = _surface_between(labels, (a, b, c), (i, j, k), d, length)
                    if here[k] >= 0:
                        n_here[k] = 0
                    chord = most if n < 0 else ways[d, n] + end + begin_there[c]
                    if chord >= most:
                        continue
                    uneven = (end - begin_there[c]) / length - n
                    v = (a * n_rows + b) * n_columns + c
                    for m in range(n + 1):
                        place = a - m * s if axis == 0 else b - m * t
                        if chord < least[v] and ends[0] <= place < ends[1]:
                            least[v], best[v] = chord, d
                            is_middle[v] = abs(uneven + 2 * m) <= OFF_MIDDLE_STEPS
                        v -= stride
    shape = partition.shape
    return least.reshape(shape), best.reshape(shape), is_middle.reshape(shape)


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, error_model="numpy")
def _surface_between(
    labels: _Labels,
    here: tuple[int, int, int],
    there: tuple[int, int, int],
    d: int,
    length: float,
) -> tuple[float, float]:
    """Distances from a voxel, and from the next one in direction d, of another label, to the
    surface between them, mm.
    """
    partition, levels, channel, crossing = labels
    one, other = partition[here], partition[there]
    part = crossing[d, here[0], here[1], here[2]] if len(crossing) > 0 else NO_CROSSING
    if one < 0 or other < 0 or (len(crossing) > 0 and part == NO_CROSSING):  # cells overlap
        return 0.5 * length, 0.5 * length
    if len(crossing) > 0:
        fraction = (part // COSINE_STEPS) / (COSINE_STEPS - 2.0)
        return length * fraction, length * (1.0 - fraction)
    own, next_one = levels[channel[one]], levels[channel[other]]
    first, second = next_one[here] - own[here], own[there] - next_one[there]
    total = max(first + second, 1e-6)  # of a level, chosen: against division by 0
    return length * first / total, length * second / total


@njit(cache=True, nogil=True, error_model="numpy")
def _cosine(
    labels: _Labels,
    place: tuple[int, int, int],
    direction: tuple[int, tuple[int, int, int]],
    length: float,
    edges: NDArray,
) -> float:
    """Cosine of the angle between a way to the label's surface and the normal there; 1 if
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
    """The length of a chord in direction d across its label's surfaces."""
    ways, edges, step = rays[1], rays[2], row(rays[0], d)
    forth = _cosine(labels, place, (d, step), ways[d, 1], edges)
    step = (-step[0], -step[1], -step[2])
    back = _cosine(labels, place, (-1 - d, step), ways[d, 1], edges)
    return chord * (0.5 * (forth + back))


@njit(cache=True, nogil=True, error_model="numpy")
def _thickness(
    chords: tuple[NDArray, NDArray, NDArray],
    labels: _Labels,
    rays: tuple[NDArray, NDArray, NDArray],
    slab: tuple[int, int, int],
) -> NDArray:
    """Thickness at a slab's voxels, 0 elsewhere: the diameter of the largest ball around a middle
    that covers them, or their own chord.
    """
    (least, best, is_middle), partition, edges = chords, labels.partition, rays[2]
    (axis, first, stop), shape = slab, partition.shape
    thickness = np.zeros(shape, dtype=np.float32)
    low, high = (first if axis == 0 else 0), (stop if axis == 0 else shape[0])
    bottom, top = (first if axis == 1 else 0), (stop if axis == 1 else shape[1])
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                if not is_middle[i, j, k]:
                    continue
                place, own = (i, j, k), partition[i, j, k]
                size = np.float32(_across(labels, place, rays, best[place], least[place]))
                square = 0.25 * size * size
                r0, r1 = int(0.5 * size / edges[0]), int(0.5 * size / edges[1])
                for a in range(max(i - r0, low), min(i + r0 + 1, high)):
                    rest = square - ((a - i) * edges[0]) ** 2
                    for b in range(max(j - r1, bottom), min(j + r1 + 1, top)):
                        width = rest - ((b - j) * edges[1]) ** 2
                        if width < 0.0:
                            continue
                        r2 = int(np.sqrt(width) / edges[2])
                        sizes, labels_there = thickness[a, b], partition[a, b]
                        for c in range(max(k - r2, 0), min(k + r2 + 1, shape[2])):
                            if sizes[c] < size and labels_there[c] == own:
                                sizes[c] = size
    for i in range(low, high):
        for j in range(bottom, top):
            for k in range(shape[2]):
                chord = least[i, j, k]
                if partition[i, j, k] < 0 or thickness[i, j, k] >= chord:
                    continue
                if best[i, j, k] >= 0:
                    chord = _across(labels, (i, j, k), rays, best[i, j, k], chord)
                thickness[i, j, k] = max(thickness[i, j, k], np.float32(chord))
    return thickness


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_crossings(
    crossing: NDArray,
    corners: NDArray,
    ways: NDArray,
    edges: NDArray,
    origin: NDArray,
) -> None:
    """Find where triangles first cross the ways (D, 3), mm, up from the voxels' centres, of which
    the first is at `origin` (3,).

    The cosine of the angle between way and normal is stored, too (`_Labels`). A triangle's height
    over a place is in lengths of its normal, which is not a unit vector.
    """
    first, last, rise = (
        np.zeros(3, dtype=np.int64),
        np.zeros(3, dtype=np.int64),
        np.zeros(len(ways)),
    )
    lengths = np.sqrt((ways * ways).sum(axis=1))
    for facet in range(len(corners)):
        a, b, c = row(corners[facet], 0), row(corners[facet], 1), row(corners[facet], 2)
        for d in range(3):
            low, high = min(a[d], b[d], c[d]) / edges[d], max(a[d], b[d], c[d]) / edges[d]
            first[d], last[d] = max(int(np.ceil(low)) - 1, origin[d]), int(np.floor(high)) + 1
            last[d] = min(last[d], crossing.shape[1 + d] - 1 + origin[d])
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
