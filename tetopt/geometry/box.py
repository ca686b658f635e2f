"""The box of an image: its sides, the places on them, and the correspondence of its axes to the
world's.

Index coordinates: voxel centres are whole numbers, so that the box runs from -0.5 to s - 0.5 along
an axis of s voxels.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tetopt.system.arrays import Bools, Floats, Ints

# A place this near to a side lies on it. Reading a file and converting its points to index
# coordinates moves them by some 1e-12 voxel (1e-7 of the coordinate in mm where a file holds
# float32), and no mesh has cells as thin as this.
ON_SIDE_VOXELS = 1e-6


def box_sides(shape: tuple[int, ...]) -> Floats:
    """Index coordinates of the two sides across each axis, (n, 2)."""
    return np.column_stack([np.full(len(shape), -0.5), np.array(shape) - 0.5])


def is_on_sides(
    places: NDArray[Any], sides: NDArray[Any], tolerance: float = ON_SIDE_VOXELS
) -> Bools:
    """True where places (..., n) lie on the sides (n, 2) of a box, (..., n, 2); exactly if
    `tolerance` is 0.

    Examples
    --------
    >>> is_on_sides(np.array([[-0.5, 1.0], [2.5, 1.5]]), box_sides((3, 2))).tolist()
    [[[True, False], [False, False]], [[False, True], [False, True]]]
    """
    return np.abs(places[..., None] - sides) <= tolerance


def facets_on_sides(
    places: NDArray[Any],
    nodes: Ints,
    sides: NDArray[Any],
    tolerance: float = ON_SIDE_VOXELS,
) -> Bools:
    """True where all nodes of facets `nodes` (F, n), at places (N, n), lie on a side, (F, n, 2)."""
    is_on: Bools = np.all(is_on_sides(places, sides, tolerance)[nodes], axis=1)
    return is_on


def upright_axis(affine: Floats) -> int:
    """The index axis that corresponds to the last world axis: z in 3-D, from inferior to
    superior, and y in 2-D.
    """
    return world_axes(affine).index(len(affine) - 2)


def world_axes(affine: Floats) -> tuple[int, ...]:
    """The world axis that corresponds to each index axis, by the largest sum of cosines; each
    occurs once.
    """
    cosines = _cosines(affine)

    def alignment(order: tuple[int, ...]) -> tuple[float, float]:
        chosen = cosines[list(order), range(len(order))]
        # Rounded, so that the first order wins where several are as good, as in a turn by 45
        # degrees.
        return round(float(chosen.sum()), 9), round(float(chosen.prod()), 9)

    return max(permutations(range(len(cosines))), key=alignment)


def _cosines(affine: Floats) -> Floats:
    """Absolute cosines between world axes (rows) and index axes (columns), (n, n)."""
    columns = affine[:-1, :-1]
    return np.abs(columns / np.sqrt((columns**2).sum(axis=0)))
