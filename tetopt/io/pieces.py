"""A mesh's file in pieces, each with points of its own: cut by its cells' parts, and joined again to the last bit.

Where cells have whole numbers called `part`, the cells of each are a piece. The numbers of its points and cells in the
whole mesh are data GlobalPointIds and GlobalCellIds, as VTK calls them; sets are of the numbers in the whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from tetopt.conversions import VTK_KINDS
from tetopt.errors import InputError
from tetopt.io.raw import RawGrid
from tetopt.io.read_vtk import plain_arrays
from tetopt.io.text import free_text
from tetopt.io.vtk import CELLS_PREFIX, FACETS_PREFIX, model_grid
from tetopt.model.model import Model

PART_FIELD, POINT_IDS, CELL_IDS, GHOST_FIELD = "part", "GlobalPointIds", "GlobalCellIds", "vtkGhostType"
MOST_PIECES = 2**16  # of a file: more than any cluster has cores for one job, and as many files as a folder takes well
DUPLICATE_BIT = 1  # VTK's, of cells that are another piece's and only repeated here


def model_pieces(model: Model) -> Iterator[RawGrid]:
    """All of a model, as `tetopt.io.vtk.model_grid` has it: a piece for each value of `part`, or one for all.

    Field data are in the first; its texts, which tell units and axes, in each of the others, too.

    Raises
    ------
    InputError
        More than `MOST_PIECES` parts.
    """
    types = np.full(len(model.mesh.cells), VTK_KINDS[model.mesh.ndim, model.order], dtype=np.uint8)
    grid = RawGrid(**plain_arrays(model_grid(model)), cell_types=types)
    part = _whole_numbers(grid.cell_data.get(PART_FIELD))
    numbers, sizes = np.unique(np.zeros(1) if part is None else part, return_counts=True)
    if part is None or len(numbers) == 1:
        yield grid
        return
    if len(numbers) > MOST_PIECES:
        raise InputError(
            f'cell data "{PART_FIELD}": expected at most {MOST_PIECES} parts, got {len(numbers)}; call it otherwise'
        )
    grid = grid._replace(point_data=_freed(grid.point_data, POINT_IDS), cell_data=_freed(grid.cell_data, CELL_IDS))
    texts = {n: v for n, v in grid.field_data.items() if not n.startswith((FACETS_PREFIX, CELLS_PREFIX))}
    for chosen in np.split(np.argsort(part, kind="stable"), np.cumsum(sizes)[:-1]):
        yield _piece(grid, chosen)
        grid = grid._replace(field_data=texts)


def _whole_numbers(values: NDArray | None) -> NDArray | None:
    """The values, if they are one whole number for each cell."""
    if values is None or values.ndim != 1 or not np.isfinite(values).all() or (values != np.rint(values)).any():
        return None
    return values


def _freed(data: dict[str, NDArray], name: str) -> dict[str, NDArray]:
    """The data, of which one that is called `name` is called otherwise."""
    return {free_text(name, data) if each == name else each: values for each, values in data.items()}


def _piece(grid: RawGrid, chosen: NDArray[np.int64]) -> RawGrid:
    """Some cells, all of one kind, and their points."""
    cells = grid.connectivity.reshape(len(grid.cell_types), -1)[chosen]
    nodes, local = np.unique(cells, return_inverse=True)
    return RawGrid(
        grid.points[nodes],
        local.ravel(),
        np.arange(len(chosen) + 1) * cells.shape[1],
        grid.cell_types[chosen],
        {name: values[nodes] for name, values in grid.point_data.items()} | {POINT_IDS: nodes},
        {name: values[chosen] for name, values in grid.cell_data.items()} | {CELL_IDS: chosen},
        grid.field_data,
    )


def joined(pieces: Sequence[RawGrid]) -> RawGrid:
    """One grid of all pieces; cells that a piece only repeats (VTK's ghosts) are left out.

    Points are the same where their GlobalPointIds are, if each of these lies at one place, else where their coordinates
    are, in different pieces. Points and cells are in the order of their numbers, if they have any.

    Parameters
    ----------
    pieces : sequence of RawGrid
        At least one. Data that not every piece has, of the same type, are left out, which a note tells.

    Raises
    ------
    InputError
        A cell of a piece uses a node that the piece does not have.
    """
    pieces = [each for piece in pieces if len((each := _without_ghosts(piece)).cell_types)] or list(pieces[:1])
    if len(pieces) == 1:
        return pieces[0]
    for k, piece in enumerate(pieces):
        if len(nodes := piece.connectivity) and not (nodes.min() >= 0 and nodes.max() < len(piece.points)):
            raise InputError(f"damaged: cells of piece {k} use nodes that it does not hold")
    point_data, lost_at_points = _common([piece.point_data for piece in pieces])
    cell_data, lost_in_cells = _common([piece.cell_data for piece in pieces])
    points, counts = np.concatenate([piece.points for piece in pieces]), [len(piece.points) for piece in pieces]
    same = _same_by_ids(points, point_data.get(POINT_IDS))
    if same is not None:
        del point_data[POINT_IDS]
    first, number = _same_by_place(points, counts) if same is None else same
    starts = np.cumsum([0, *counts[:-1]])
    nodes = np.concatenate([piece.connectivity + start for piece, start in zip(pieces, starts, strict=True)])
    sizes = np.concatenate([np.diff(piece.offsets) for piece in pieces])
    begins = np.cumsum([0, *(len(piece.connectivity) for piece in pieces[:-1])])
    at = np.concatenate([piece.offsets[:-1] + begin for piece, begin in zip(pieces, begins, strict=True)])
    order = np.arange(len(sizes))
    ids = cell_data.get(CELL_IDS)
    if ids is not None and ids.ndim == 1 and ids.dtype.kind in "iu" and len(np.unique(ids)) == len(ids):
        order = np.argsort(ids)
        del cell_data[CELL_IDS]
    offsets = np.concatenate([[0], np.cumsum(sizes[order])])
    listed = np.repeat(at[order] - offsets[:-1], sizes[order]) + np.arange(offsets[-1])
    fields: dict[str, NDArray] = {}
    for piece in pieces:
        fields |= {name: values for name, values in piece.field_data.items() if name not in fields}
    lost = ", ".join(dict.fromkeys(lost_at_points + lost_in_cells))
    return RawGrid(
        points[first],
        number[nodes[listed]],
        offsets,
        np.concatenate([piece.cell_types for piece in pieces])[order],
        {name: values[first] for name, values in point_data.items()},
        {name: values[order] for name, values in cell_data.items()},
        fields,
        (f"data left out, as not every piece has them, of one type: {lost}",) if lost else (),
    )


def _without_ghosts(piece: RawGrid) -> RawGrid:
    """The piece without the cells that another one has; their points stay, as nodes that no cell uses may."""
    marks = piece.cell_data.get(GHOST_FIELD)
    if marks is None or marks.ndim != 1 or marks.dtype.kind not in "iu":
        return piece
    own = np.flatnonzero((marks & DUPLICATE_BIT) == 0)
    sizes = np.diff(piece.offsets)[own]
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    listed = np.repeat(piece.offsets[:-1][own] - offsets[:-1], sizes) + np.arange(offsets[-1])
    return piece._replace(
        connectivity=piece.connectivity[listed],
        offsets=offsets,
        cell_types=piece.cell_types[own],
        cell_data={name: values[own] for name, values in piece.cell_data.items() if name != GHOST_FIELD},
    )


def _common(data: Sequence[dict[str, NDArray]]) -> tuple[dict[str, NDArray], list[str]]:
    """Data of all pieces in turn, of those that every piece has alike; and the names of the others."""
    kinds = [{name: (values.dtype.str, values.shape[1:]) for name, values in each.items()} for each in data]
    alike = [name for name in kinds[0] if all(each.get(name) == kinds[0][name] for each in kinds)]
    others = [name for each in data for name in each if name not in alike and name != GHOST_FIELD]
    return {name: np.concatenate([each[name] for each in data]) for name in alike}, list(dict.fromkeys(others))


def _same_by_ids(
    points: NDArray[np.float64], ids: NDArray | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """For each point that is left the first that was listed, and of all listed its number; None if the ids are none."""
    if ids is None or ids.ndim != 1 or ids.dtype.kind not in "iu":
        return None
    _, first, number = np.unique(ids, return_index=True, return_inverse=True)
    return (first, number) if np.array_equal(points[first][number], points) else None


def _same_by_place(points: NDArray[np.float64], counts: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """As `_same_by_ids`, by coordinates: the k-th point at a place of one piece is the k-th there of the others."""
    of_piece = np.repeat(np.arange(len(counts)), counts)
    order = np.lexsort((of_piece, *points.T))
    is_elsewhere = np.ones(len(points), dtype=bool)
    is_elsewhere[1:] = (np.diff(points[order], axis=0) != 0).any(axis=1)
    is_new = is_elsewhere.copy()
    is_new[1:] |= np.diff(of_piece[order]) != 0
    row = np.arange(len(points))
    rank = row - np.maximum.accumulate(np.where(is_new, row, 0))  # among those of its piece there
    key = np.empty((len(points), 2), dtype=np.int64)
    key[order] = np.column_stack([np.cumsum(is_elsewhere), rank])
    _, first, which = np.unique(key @ np.array([len(points), 1]), return_index=True, return_inverse=True)
    place = np.empty(len(first), dtype=np.int64)
    place[np.argsort(first)] = np.arange(len(first))  # numbered as they are listed
    return np.sort(first), place[which]
