"""The mesh: points and the simplices between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError
from tetopt.geometry.simplex import volumes


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the plane (n = 2) or tetrahedra in space (n = 3).

    Parameters
    ----------
    points : (N, n) array of float64
        Node positions in world mm (RAS+ in 3-D). Read-only.
    cells : (M, n+1) array of int64
        Node indices of each cell, positively oriented: the vectors from the first node to the others form a
        right-handed frame. Read-only.

    Raises
    ------
    InputError
        Wrong shapes, non-finite points, no cells, indices out of range, or a cell that is flat or inverted
        (`tetopt.geometry.simplex.oriented` turns inverted ones).

    Examples
    --------
    >>> mesh = Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    >>> mesh.ndim, len(mesh.cells)
    (2, 1)
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int64]

    def __init__(self, points: ArrayLike, cells: ArrayLike) -> None:
        try:
            points = np.array(points, dtype=np.float64, order="C")
            cells = np.asarray(cells)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"mesh: expected arrays of numbers, points and cells ({error})") from error
        if points.ndim != 2 or points.shape[1] not in (2, 3):
            raise InputError(f"mesh points: expected shape (N, 2) or (N, 3), got {points.shape}")
        n = points.shape[1]
        if cells.ndim != 2 or cells.shape[1] != n + 1 or len(cells) == 0:
            raise InputError(f"mesh cells: expected shape (M, {n + 1}) with M > 0, got {cells.shape}")
        if not np.issubdtype(cells.dtype, np.integer):
            raise InputError(f"mesh cells: expected integers, got {cells.dtype}")
        cells = np.array(cells, dtype=np.int64, order="C")
        if not np.isfinite(points).all():
            first = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
            raise InputError(f"mesh points: every coordinate must be finite, node {first} is {points[first].tolist()}")
        if cells.min() < 0 or cells.max() >= len(points):
            raise InputError(f"mesh cells: indices must lie in 0..{len(points) - 1}, got {cells.min()}..{cells.max()}")
        v = volumes(points, cells)
        if (v <= 0.0).any():
            bad = np.flatnonzero(v <= 0.0)
            raise InputError(
                f"mesh cells: {len(bad)} of {len(cells)} are flat or inverted, the first are {bad[:5].tolist()}; "
                "orient them or mend the mesh"
            )
        points.setflags(write=False)
        cells.setflags(write=False)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "cells", cells)

    @property
    def ndim(self) -> int:
        """Number of space dimensions n, 2 or 3."""
        return self.points.shape[1]
