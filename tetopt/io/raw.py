"""What a mesh's file holds, before anything of it is checked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# The dimension of each kind of cell that a mesh may consist of, or that may lie on it.
CELL_DIMENSIONS = {"vertex": 0, "poly_vertex": 0, "line": 1, "poly_line": 1, "triangle": 2, "tetra": 3}


class Group(NamedTuple):
    """Cells of one kind that gmsh's file calls by a name."""

    label: str  # in the file
    kind: str
    members: NDArray[np.int64]  # ascending


class Raw(NamedTuple):
    """A file's cells by kind."""

    points: NDArray[np.float64]  # (N, 3)
    cells: dict[str, NDArray[np.int64]]
    cell_data: dict[str, dict[str, NDArray]]  # by name, then kind
    field_data: dict[str, NDArray]
    groups: list[Group]
    space: str
