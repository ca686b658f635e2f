"""How thick labels are at each place: of the largest ball within a label that covers it, the diameter.

The local thickness of Hildebrand and Ruegsegger (1997, J. Microsc. 185, 67), between the smooth surfaces of labels
(`tetopt.contents.memberships`) rather than between voxels: a sheet of 1.5 voxels has 1.5, where distances of voxels'
centres would give 1 or 2. At a voxel in the middle of its label the diameter is the shortest of the 13 chords
through it along axes and diagonals, each of which ends where another label's level is as small.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from tetopt.contents.memberships import Memberships
from tetopt.system.budget import check_memory
from tetopt.system.kernel_cache import njit

THICKNESS_BYTES = 16.0  # at each voxel: chords, thickness, the labels within a region
BEYOND_REGION = -1  # in place of a label: beyond the region
SLABS_PER_THREAD = 4  # of the grid for each thread: some take longer than others
OFF_MIDDLE_STEPS = 1.01  # by which the two ways along the shortest chord through a middle differ at most


class _Labels(NamedTuple):
    """Labels on a grid, as kernels take them."""

    partition: NDArray[np.int64]  # (s_0, s_1, s_2) row of the label; -1 beyond the region
    levels: NDArray[np.float32]  # (C, s_0, s_1, s_2)
    channel: NDArray[np.int64]  # (K,)


def local_thickness(
    members: Memberships, spacing: NDArray[np.float64], most: float, inside: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """The local thickness of each voxel's label.

    Parameters
    ----------
    members : Memberships
        Of K labels on a grid.
    spacing : (n,) float64
        Edges of its voxels, mm.
    most : float
        What is thicker counts as so thick, mm.
    inside : (*shape) bool, optional
        The region within which labels are; its surface ends them.

    Returns
    -------
    (*shape) float32
        mm; 0 beyond the region.

    Raises
    ------
    InputError
        There is no memory for it.
    """
    shape, n = members.partition.shape, members.partition.ndim
    check_memory(THICKNESS_BYTES * members.partition.size, "thickness of labels", "crop the image")
    whole = (1,) * (3 - n) + shape
    partition = members.partition if inside is None else np.where(inside, members.partition, BEYOND_REGION)
    labels = _Labels(
        np.ascontiguousarray(partition.reshape(whole)), members.levels.reshape(-1, *whole), members.channel
    )
    rays, edges = _rays(spacing)
    chord, is_middle = np.zeros(whole, dtype=np.float32), np.zeros(whole, dtype=np.bool_)
    ends = np.linspace(0, whole[3 - n], SLABS_PER_THREAD * numba.get_num_threads() + 1).astype(int).tolist()
    box = [(0, size) for size in whole]
    slabs = [(*box[: 3 - n], ends_of, *box[4 - n :]) for ends_of in itertools.pairwise(ends)]
    with ThreadPoolExecutor(numba.get_num_threads()) as threads:
        list(threads.map(lambda slab: _fill_chords(chord, is_middle, labels, rays, most, slab), slabs))
    thickness = chord.copy()
    _spread_balls(thickness, chord, is_middle, labels.partition, edges)
    return thickness.reshape(shape)


def _rays(spacing: NDArray[np.float64]) -> tuple[tuple[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]]:
    """Steps (D, 3) along axes and diagonals, one of each two that are opposite, their lengths, and a voxel's edges."""
    n = len(spacing)
    edges = np.concatenate([np.ones(3 - n), spacing])
    steps = np.array([s for s in itertools.product((-1, 0, 1), repeat=3) if s > (0, 0, 0) and not any(s[: 3 - n])])
    return (steps, np.linalg.norm(steps * edges, axis=1)), edges


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_chords(
    chord: NDArray, is_middle: NDArray, labels: _Labels, rays: tuple[NDArray, NDArray], most: float,
    slab: tuple[tuple[int, int], ...],
) -> None:  # fmt: skip
    """The shortest chord through each voxel of a slab, and whether it is in the middle of it."""
    steps, lengths = rays
    for i in range(*slab[0]):
        for j in range(*slab[1]):
            for k in range(*slab[2]):
                if labels.partition[i, j, k] < 0:
                    continue
                least, off_middle = most, np.inf
                for d in range(len(steps)):
                    forth = _way(labels, (i, j, k), steps[d], lengths[d], least)
                    if forth >= least:
                        continue
                    back = _way(labels, (i, j, k), -steps[d], lengths[d], least - forth)
                    if forth + back < least:
                        least, off_middle = forth + back, abs(forth - back) / lengths[d]
                chord[i, j, k] = least
                is_middle[i, j, k] = off_middle <= OFF_MIDDLE_STEPS


@njit(cache=True, nogil=True, error_model="numpy")
def _way(labels: _Labels, place: tuple[int, int, int], step: NDArray, length: float, most: float) -> float:
    """From a voxel's centre to its label's surface along steps of a length, mm; `most` or more if it is further."""
    partition, levels, channel = labels
    i, j, k = place
    row, way = partition[i, j, k], 0.0
    while way < most:
        a, b, c = i + step[0], j + step[1], k + step[2]
        is_in = 0 <= a < partition.shape[0] and 0 <= b < partition.shape[1] and 0 <= c < partition.shape[2]
        if not is_in or partition[a, b, c] < 0:
            return way + 0.5 * length
        other = partition[a, b, c]
        if other != row:
            here = levels[channel[other], i, j, k] - levels[channel[row], i, j, k]
            there = levels[channel[row], a, b, c] - levels[channel[other], a, b, c]
            return float(way + length * here / max(here + there, 1e-6))
        i, j, k, way = a, b, c, way + length
    return way


@njit(cache=True, error_model="numpy")
def _spread_balls(thickness: NDArray, chord: NDArray, is_middle: NDArray, partition: NDArray, edges: NDArray) -> None:
    """Raise each voxel's thickness to the diameter of the largest ball around a middle that covers it."""
    s0, s1, s2 = partition.shape
    for i in range(s0):
        for j in range(s1):
            for k in range(s2):
                if not is_middle[i, j, k]:
                    continue
                size, r = chord[i, j, k], 0.5 * chord[i, j, k]
                r0, r1, r2 = int(r / edges[0]), int(r / edges[1]), int(r / edges[2])
                for a in range(max(i - r0, 0), min(i + r0 + 1, s0)):
                    x = 0.0 if a == i else ((a - i) * edges[0]) ** 2
                    for b in range(max(j - r1, 0), min(j + r1 + 1, s1)):
                        y = x + ((b - j) * edges[1]) ** 2
                        for c in range(max(k - r2, 0), min(k + r2 + 1, s2)):
                            is_same = partition[a, b, c] == partition[i, j, k]
                            is_in = y + ((c - k) * edges[2]) ** 2 <= r * r
                            if is_same and is_in and thickness[a, b, c] < size:
                                thickness[a, b, c] = size
