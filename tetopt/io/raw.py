"""The contents of a mesh's file before any checks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.interop.conversions import CELL_DIMENSIONS, corner_kinds
from tetopt.system.arrays import Arrays, Floats, Ints


class RawGrid(NamedTuple):
    """A VTK unstructured grid as plain arrays."""

    points: Floats  # (N, 3)
    connectivity: Ints
    offsets: Ints  # (M + 1,), into the connectivity
    cell_types: NDArray[np.uint8]  # (M,)
    point_data: Arrays
    cell_data: Arrays
    field_data: Arrays
    notes: tuple[str, ...] = ()  # one line for each dropped item


class Group(NamedTuple):
    """A named group of cells of one type in a gmsh file."""

    label: str  # in the file
    kind: str
    members: Ints  # ascending
    number: int = 0  # in the file


class Raw(NamedTuple):
    """A file's cells by type."""

    points: Floats  # (N, 3)
    cells: dict[str, Ints]
    cell_data: dict[str, Arrays]  # by name, then type
    point_data: Arrays  # by name, one row per point
    field_data: Arrays
    groups: list[Group]
    space: str
    middles: dict[str, Ints] = {}  # noqa: RUF012 - never changed; see `by_corners`
    notes: tuple[str, ...] = ()  # one line for each dropped item


def main_kind(raw: Raw) -> str:
    """Return the type of cells of highest dimension."""
    return max(raw.cells, key=lambda name: CELL_DIMENSIONS.get(name, -1))


def by_corners(raw: Raw) -> Raw:
    """Rename quadratic cell types to the linear type of their corners; their mid-edge nodes become
    `middles`, by type.

    If a type occurs in both orders, the quadratic one keeps its name.
    """
    kinds = corner_kinds(raw.cells)
    n_corners = {corner: CELL_DIMENSIONS[corner] + 1 for corner in kinds.values()}

    def renamed(by_kind: Arrays) -> Arrays:
        return {kinds.get(kind, kind): values for kind, values in by_kind.items()}

    cells = {kind: nodes[:, : n_corners.get(kind)] for kind, nodes in renamed(raw.cells).items()}
    return raw._replace(
        cells=cells,
        cell_data={name: renamed(by_kind) for name, by_kind in raw.cell_data.items()},
        groups=[group._replace(kind=kinds.get(group.kind, group.kind)) for group in raw.groups],
        middles={corner: raw.cells[kind][:, n_corners[corner] :] for kind, corner in kinds.items()},
    )
