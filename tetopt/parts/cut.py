"""Assignment of cells to parts in each round, and joining of the parts.

Parts are boxes of about equal work: planes divide the cells' centroids along one axis after the
other into slabs of equal weight (recursive coordinate bisection, Berger and Bokhari 1987, with more
than two slabs at a time). A part's surface follows its cells. The planes move every round, so that
nodes that a part shared with others, and could not move, are inside a part in the next round. A
space-filling curve through the cells (Morton's) would need only one sort, but its parts have ragged
surfaces or two components, and boxes of voxels up to the whole volume.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Shift of the planes along every axis in each round, as a fraction of a slab's width.
ROUND_SHIFTS = (0.0, 0.5, 0.25, 0.75)


class Shared(NamedTuple):
    """A mesh on a grid of ticks, and the part of each cell."""

    ticks: NDArray[np.int64]  # (N, 3)
    cells: NDArray[np.int64]  # (M, 4)
    part: NDArray[np.int64]  # (M,) from 0, each with at least one cell


class Piece(NamedTuple):
    """One part of a mesh."""

    ticks: NDArray[np.int64]  # (n, 3)
    cells: NDArray[np.int64]  # (m, 4) rows of `ticks`
    nodes: NDArray[np.int64]  # (n,) their rows in the whole mesh


def counts_of(n_parts: int, lengths: Sequence[float]) -> tuple[int, ...]:
    """Return the number of slabs along each axis that gives at least `n_parts` parts as close to
    cubes as possible.

    Examples
    --------
    >>> counts_of(4, (200.0, 230.0, 190.0)), counts_of(12, (10.0, 20.0, 10.0))
    ((2, 2, 1), (2, 3, 2))
    """
    counts = np.ones(len(lengths), dtype=np.int64)
    while np.prod(counts) < n_parts:
        counts[np.argmax(np.asarray(lengths) / counts)] += 1
    return tuple(int(count) for count in counts)


def cut(
    centroids: NDArray[np.float64],
    weights: NDArray[np.float64],
    counts: Sequence[int],
    shift: float,
) -> NDArray[np.int64]:
    """Return the part of each cell, (M,) int64, numbered from 0 without gaps.

    Parameters
    ----------
    centroids : (M, 3) float64
        Centroids of the cells, in any unit.
    weights : (M,) float64
        Work of each cell.
    counts : sequence of three int
        Slabs along each axis.
    shift : float
        Position of the first plane, 0 to 1 slab. Unless it is 0, each divided axis has one more
        slab, and its first and last slabs are smaller.
    """
    part = np.zeros(len(centroids), dtype=np.int64)
    for axis, count in enumerate(counts):
        if count == 1:
            continue
        # Within each part so far, sort cells by position along the axis, ties by number.
        order = np.lexsort((centroids[:, axis], part))
        total = np.cumsum(weights[order])
        start = np.flatnonzero(np.diff(part[order], prepend=-1))
        before = np.repeat(
            np.concatenate([[0.0], total[start[1:] - 1]]), np.diff(np.append(start, len(order)))
        )
        whole = np.bincount(part, weights)
        at = (total - 0.5 * weights[order] - before) / whole[part[order]]  # 0 to 1 within its part
        slab = np.empty(len(order), dtype=np.int64)
        slab[order] = np.floor(at * count + (1.0 - shift) * (shift > 0.0)).astype(np.int64)
        part = part * (count + 1) + slab
    return np.unique(part, return_inverse=True)[1].astype(np.int64)


def pieces(mesh: Shared) -> list[Piece]:
    """Return the parts of a mesh; nodes and cells keep the order of the whole mesh."""
    order = np.argsort(mesh.part, kind="stable")
    bounds = np.searchsorted(mesh.part[order], np.arange(mesh.part.max() + 2))
    result = []
    for first, last in pairwise(bounds):
        nodes, cells = np.unique(mesh.cells[order[first:last]], return_inverse=True)
        result.append(
            Piece(mesh.ticks[nodes], cells.reshape(-1, mesh.cells.shape[1]).astype(np.int64), nodes)
        )
    return result


def joined(ticks: Sequence[NDArray[np.int64]], cells: Sequence[NDArray[np.int64]]) -> Shared:
    """Join parts: shared nodes, which are in the same place, become one.

    Nodes and cells are numbered part by part; a shared node belongs to the first of its parts.
    """
    every = np.concatenate(ticks)
    # Whole rows are compared: ticks are below 2^31, so that three of them would take 93 bits in a
    # single key.
    _, first, inverse = np.unique(every, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    number = rank[inverse.ravel()]
    offsets = np.cumsum([0, *map(len, ticks[:-1])])
    whole = np.concatenate(
        [number[each + offset] for each, offset in zip(cells, offsets, strict=True)]
    )
    part = np.repeat(np.arange(len(cells)), [len(each) for each in cells])
    return Shared(every[np.sort(first)], whole, part)
