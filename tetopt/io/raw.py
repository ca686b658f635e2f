"""What a mesh's file holds, before anything of it is checked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.interop.conversions import CELL_DIMENSIONS, corner_kinds


class RawGrid(NamedTuple):
    """An unstructured grid of VTK's as plain arrays."""

    points: NDArray[np.float64]  # (N, 3)
    connectivity: NDArray[np.int64]
    offsets: NDArray[np.int64]  # (M + 1,), into the connectivity
    cell_types: NDArray[np.uint8]  # (M,)
    point_data: dict[str, NDArray]
    cell_data: dict[str, NDArray]
    field_data: dict[str, NDArray]
    notes: tuple[str, ...] = ()  # what was left out, a line each


class Group(NamedTuple):
    """Cells of one kind that gmsh's file calls by a name."""

    label: str  # in the file
    kind: str
    members: NDArray[np.int64]  # ascending
    number: int = 0  # in the file


class Raw(NamedTuple):
    """A file's cells by kind."""

    points: NDArray[np.float64]  # (N, 3)
    cells: dict[str, NDArray[np.int64]]
    cell_data: dict[str, dict[str, NDArray]]  # by name, then kind
    point_data: dict[str, NDArray]  # by name, a row a point
    field_data: dict[str, NDArray]
    groups: list[Group]
    space: str
    middles: dict[str, NDArray[np.int64]] = {}  # noqa: RUF012 - nobody changes it; see `by_corners`
    notes: tuple[str, ...] = ()  # what was left out, a line each


def by_corners(raw: Raw) -> Raw:
    """The cells of order 2 as what they are by their corners; the nodes on their edges are `middles`, by kind.

    Where a kind comes in both orders, that of order 2 keeps its name.
    """
    kinds = corner_kinds(raw.cells)
    n_corners = {corner: CELL_DIMENSIONS[corner] + 1 for corner in kinds.values()}

    def renamed(by_kind: dict[str, NDArray]) -> dict[str, NDArray]:
        return {kinds.get(kind, kind): values for kind, values in by_kind.items()}

    cells = {kind: nodes[:, : n_corners.get(kind)] for kind, nodes in renamed(raw.cells).items()}
    return raw._replace(
        cells=cells,
        cell_data={name: renamed(by_kind) for name, by_kind in raw.cell_data.items()},
        groups=[group._replace(kind=kinds.get(group.kind, group.kind)) for group in raw.groups],
        middles={corner: raw.cells[kind][:, n_corners[corner] :] for kind, corner in kinds.items()},
    )
