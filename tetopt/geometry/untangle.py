"""Cells that a map of the nodes inverted, untangled with the nodes' connections as they are."""

from __future__ import annotations

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.simplex import volumes
from tetopt.system.arrays import Bools, Floats, Ints

UNTANGLE_ROUNDS = 200  # at most: each spreads a fold by one more layer of cells
MOST_INVERTED = 0.2  # of the cells: more belong to no registration of one subject to another
LEAST_FRACTION = (
    0.05  # of a cell's volume before, next to an inverted cell: less counts as inverted
)


def untangle(points: Floats, moved: Floats, cells: Ints) -> tuple[Floats, int]:
    """Return places near `moved` at which no cell is inverted, and the number of those that were.

    Nodes of inverted cells take the mean displacement of the nodes of the cells around them, which
    a fold of a registration's map lacks, and so do their neighbours in the next rounds while cells
    stay inverted. All other nodes stay at their places to the last bit.

    Parameters
    ----------
    points : (N, n) float64
        Places before, mm, of a mesh without inverted cells.
    moved : (N, n) float64
        Places after, mm.
    cells : (M, n+1) int64

    Raises
    ------
    InputError
        Many cells are inverted, as by a mirror or another space's map; or some stay inverted.
    """
    before, n_corners = volumes(points, cells), cells.shape[1]
    is_inverted = volumes(moved, cells) <= 0.0
    n_inverted = int(is_inverted.sum())
    if n_inverted > MOST_INVERTED * len(cells):
        raise InputError(
            f"inverts {n_inverted} of {len(cells)} cells: it mirrors (its determinant is negative) "
            "or folds the mesh's space; is it for these two images?"
        )
    shift, places, ends = moved - points, moved, cells.ravel()
    n_around = np.bincount(ends, minlength=len(points))[:, None]
    is_loose: Bools = np.zeros(len(points), dtype=bool)
    least = np.where(is_inverted, LEAST_FRACTION * before, 0.0)
    for _ in range(UNTANGLE_ROUNDS):
        is_bad = volumes(places, cells) <= least
        if not is_bad.any():
            return places, n_inverted
        is_loose[cells[is_bad]] = True
        of_cell = np.repeat(shift[cells].mean(axis=1), n_corners, axis=0)
        mean = np.column_stack([np.bincount(ends, each, len(points)) for each in of_cell.T])
        shift = np.where(is_loose[:, None], mean / np.maximum(n_around, 1), shift)
        places = np.where(is_loose[:, None], points + shift, moved)
    raise InputError(
        f"inverts {n_inverted} of {len(cells)} cells, and {int(is_bad.sum())} stay so: it folds "
        "the mesh's space; register again with more regularisation"
    )
