"""The box of an image: its sides, which of them a place is on, and which of its axes stands for which of the world's.

Index coordinates: voxel centres are whole numbers, so that the box runs from -0.5 to s - 0.5 along an axis of s voxels.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

# A place this near to a side lies on it. Reading a file and turning its points to index coordinates moves them by some
# 1e-12 voxel (1e-7 of the coordinate in mm where a file holds float32), and no mesh has cells as thin as this.
ON_SIDE_VOXELS = 1e-6


def box_sides(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Where the two sides across each axis lie, (n, 2) index coordinates."""
    return np.column_stack([np.full(len(shape), -0.5), np.array(shape) - 0.5])


def is_on_sides(places: NDArray[Any], sides: NDArray[Any], tolerance: float = ON_SIDE_VOXELS) -> NDArray[np.bool_]:
    """Whether places (..., n) lie on each of the sides (n, 2) of a box, (..., n, 2); exactly if `tolerance` is 0.

    Examples
    --------
    >>> is_on_sides(np.array([[-0.5, 1.0], [2.5, 1.5]]), box_sides((3, 2))).tolist()
    [[[True, False], [False, False]], [[False, True], [False, True]]]
    """
    return np.abs(places[..., None] - sides) <= tolerance


def facets_on_sides(
    places: NDArray[Any], nodes: NDArray[np.int64], sides: NDArray[Any], tolerance: float = ON_SIDE_VOXELS
) -> NDArray[np.bool_]:
    """Whether facets `nodes` (F, n) of places (N, n) lie on each of the sides with all of their nodes, (F, n, 2)."""
    is_on: NDArray[np.bool_] = np.all(is_on_sides(places, sides, tolerance)[nodes], axis=1)
    return is_on


def upright_axis(affine: NDArray[np.float64]) -> int:
    """The index axis nearest to the last world axis: z in 3-D, from inferior to superior, and y in 2-D."""
    return int(np.argmax(_cosines(affine)[-1]))


def world_axes(affine: NDArray[np.float64]) -> tuple[int, ...]:
    """The world axis that each index axis stands for, each one once.

    The last world axis goes to `upright_axis`, the others to those that they lie nearest to together.
    """
    cosines, up = _cosines(affine), upright_axis(affine)
    n = len(cosines)
    orders = [order for order in permutations(range(n)) if order[up] == n - 1]
    return max(orders, key=lambda order: float(np.prod(cosines[list(order), range(n)])))


def _cosines(affine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Absolute cosines between world axes (rows) and index axes (columns), (n, n)."""
    columns = affine[:-1, :-1]
    return np.abs(columns / np.sqrt((columns**2).sum(axis=0)))
