"""Meshes from files and into them: VTU and VTK through pyvista, gmsh's MSH through meshio."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import meshio
import numpy as np
import pyvista
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.simplex import oriented
from tetopt.io.files import written_whole
from tetopt.io.vtk import add_texts, box_in, sets_in, to_pyvista, vtu_bytes
from tetopt.mesh import Mesh
from tetopt.model.sets import NAME, Box, Sets, rows_of

SUFFIXES = (".vtu", ".vtk", ".msh")
# Cells that a mesh is made of, or that may lie on it.
DIMENSIONS = {"vertex": 0, "poly_vertex": 0, "line": 1, "poly_line": 1, "triangle": 2, "tetra": 3}


class MeshFile(NamedTuple):
    """A mesh read from a file and what came with it."""

    mesh: Mesh  # RAS+ mm
    cell_data: dict[str, NDArray]  # by name, one row a cell
    field_data: dict[str, NDArray]  # by name, of any length; bytes of UTF-8 have become one string
    n_turned: int  # cells that were oriented the other way in the file
    n_left: int = 0  # cells of lower dimension, triangles on tetrahedra among them, that were left out
    sets: Sets = Sets({}, {})
    box: Box | None = None  # of the image that the mesh was made from
    space: str = "ras"  # of the file: from "lps" the mesh has been turned to RAS+


class _Raw(NamedTuple):
    """A file's cells by kind, before any question is asked."""

    points: NDArray[np.float64]  # (N, 3)
    cells: dict[str, NDArray[np.int64]]
    cell_data: dict[str, dict[str, NDArray]]  # by name, then kind
    field_data: dict[str, NDArray]
    groups: dict[str, tuple[str, NDArray[np.int64]]]  # named cells: their kind, which ones
    space: str


def save_mesh(
    path: str | Path,
    mesh: Mesh,
    cell_data: dict[str, NDArray] | None = None,
    about: dict[str, Any] | None = None,
    point_data: dict[str, NDArray] | None = None,
) -> None:
    """Write a VTU file, whole or not at all.

    Points in world mm (RAS+), cells positively oriented, `cell_data` and `point_data` by name; each entry of `about`
    becomes a field-data text, as JSON unless it is a string already. `tetopt.save_model` writes more, and other
    formats. Replaces an existing file; ask `tetopt.io.files.checked_output` first.
    """
    grid = to_pyvista(mesh, cell_data)
    for name, values in (point_data or {}).items():
        grid.point_data[name] = values
    add_texts(grid, about or {})
    with written_whole(Path(path)) as temporary:
        temporary.write_bytes(vtu_bytes(grid))


def load_mesh(path: str | Path) -> MeshFile:
    """Read triangles or tetrahedra from a VTU, VTK or gmsh MSH file.

    Cells oriented the other way are turned and counted; cells of lower dimension are left out and counted, and so are
    nodes that no cell uses. Without tetrahedra, a file of triangles is 2-D and must lie in the plane z = 0. Coordinates
    are taken for RAS+ unless the file says LPS, as those of `tetopt convert --space lps` and of 3D Slicer do; these are
    turned. Physical groups of gmsh's become sets.

    Raises
    ------
    InputError
        A missing or unreadable file, no cells, other cell types, triangles out of the plane, flat cells.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such mesh file")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: expected a mesh named {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    raw = _read_msh(path) if path.suffix.lower() == ".msh" else _read_vtk(path)
    kind = _kind_of_cells(path, raw)
    n = DIMENSIONS[kind]
    cells, points = raw.cells[kind], raw.points
    if cells.min() < 0 or cells.max() >= len(points):
        raise InputError(
            f"{path}: its cells use nodes {cells.min()}..{cells.max()}, it holds 0..{len(points) - 1}; damaged?"
        )
    used, compact = np.unique(cells, return_inverse=True)
    if n == 2 and np.any(points[used, 2] != 0.0):
        raise InputError(f"{path}: a mesh of triangles must lie in the plane z = 0; surfaces in space are not meshed")
    if n == 3 and raw.space == "lps":
        points = points * np.array([-1.0, -1.0, 1.0]) + 0.0  # + 0.0: no -0
    corners, cells = points[used, :n], compact.reshape(cells.shape)
    with np.errstate(invalid="ignore"):  # infinite coordinates, which Mesh refuses in words
        turned = oriented(corners, cells)
    try:
        mesh = Mesh(corners, turned)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    is_turned = (turned != cells).any(axis=1)
    return MeshFile(
        mesh,
        {name: values[kind] for name, values in raw.cell_data.items() if kind in values},
        raw.field_data,
        int(is_turned.sum()),
        sum(len(others) for name, others in raw.cells.items() if name != kind),
        _sets(raw, mesh, kind, used, bool(is_turned.any())),
        box_in(raw.field_data),
        raw.space,
    )


def _kind_of_cells(path: Path, raw: _Raw) -> str:
    if unknown := sorted(set(raw.cells) - set(DIMENSIONS)):
        raise InputError(f"{path}: expected linear tetrahedra, or triangles, found {', '.join(unknown)}")
    kind = max(raw.cells, key=lambda name: DIMENSIONS[name], default="none")
    if kind not in ("tetra", "triangle"):
        raise InputError(
            f"{path}: expected tetrahedra or triangles, found {', '.join(sorted(raw.cells)) or 'no cells'}"
        )
    return kind


def _sets(raw: _Raw, mesh: Mesh, kind: str, used: NDArray[np.int64], is_any_turned: bool) -> Sets:
    """The sets of a file of ours, or gmsh's named groups of cells and of facets."""
    own = sets_in(raw.field_data)
    if own.facets or own.cells:
        if is_any_turned:  # then the file has been changed, and a row's local node may be another
            return Sets({}, own.cells)
        return own
    place = np.full(len(raw.points), -1)
    place[used] = np.arange(len(used))
    sets = Sets({}, {})
    for name, (group_kind, members) in raw.groups.items():
        if not NAME.fullmatch(name):
            continue
        if group_kind == kind:
            sets.cells[name] = np.sort(members)
        elif DIMENSIONS[group_kind] == DIMENSIONS[kind] - 1:
            rows = rows_of(mesh, place[raw.cells[group_kind][members]])
            if len(rows):
                sets.facets[name] = rows
    return sets


def _read_msh(path: Path) -> _Raw:
    """gmsh's file through meshio, whose complaints become one InputError."""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
            warnings.simplefilter("ignore")
            found = meshio.gmsh.read(path)
    except Exception as error:  # meshio raises whatever it stumbles over
        raise InputError(f"{path}: cannot be read as a gmsh mesh ({type(error).__name__})") from error
    kinds = list(dict.fromkeys(block.type for block in found.cells))
    of_kind = {kind: [k for k, block in enumerate(found.cells) if block.type == kind] for kind in kinds}
    cells = {
        kind: np.concatenate([found.cells[k].data for k in blocks]).astype(np.int64) for kind, blocks in of_kind.items()
    }
    cell_data = {
        name: {kind: np.concatenate([values[k] for k in blocks]) for kind, blocks in of_kind.items()}
        for name, values in found.cell_data.items()
    }
    groups: dict[str, tuple[str, NDArray[np.int64]]] = {}
    for name, (tag, dimension) in found.field_data.items():
        for kind, blocks in of_kind.items():
            if DIMENSIONS.get(kind) == dimension:
                chosen = np.concatenate([_in_group(found, name, int(tag), k) for k in blocks])
                groups[name] = kind, np.flatnonzero(chosen)
    points = np.zeros((len(found.points), 3))
    points[:, : found.points.shape[1]] = found.points
    return _Raw(points, cells, cell_data, {}, groups, "ras")


def _in_group(found: meshio.Mesh, name: str, tag: int, block: int) -> NDArray[np.bool_]:
    """Which cells of a block belong to a physical group."""
    is_in = np.zeros(len(found.cells[block].data), dtype=bool)
    members = found.cell_sets.get(name)
    if members is not None and members[block] is not None:  # version 4, where a cell may be in several
        is_in[np.asarray(members[block], dtype=np.int64)] = True
    elif "gmsh:physical" in found.cell_data:
        is_in = np.asarray(found.cell_data["gmsh:physical"][block]) == tag
    return is_in


def _read_vtk(path: Path) -> _Raw:
    grid = _read_quietly(path)
    names = {int(kind): pyvista.CellType(kind).name.lower() for kind in np.unique(grid.celltypes)}
    if set(names.values()) <= set(DIMENSIONS):  # pyvista takes other kinds apart only if they have fixed sizes
        cells = {names[int(kind)]: np.asarray(nodes, dtype=np.int64) for kind, nodes in grid.cells_dict.items()}
    else:
        cells = {name: np.empty((0, 1), dtype=np.int64) for name in names.values()}
    cell_data = {
        name: {kind: np.asarray(grid.cell_data[name])[grid.celltypes == number] for number, kind in names.items()}
        for name in grid.cell_data
    }
    field_data = {name: _decoded(np.asarray(grid.field_data[name])) for name in grid.field_data}
    return _Raw(np.asarray(grid.points, dtype=np.float64), cells, cell_data, field_data, {}, _space(path, field_data))


def _space(path: Path, field_data: dict[str, NDArray]) -> str:
    """Whether a file says that its coordinates are LPS: in our words, or in 3D Slicer's."""
    words = " ".join(str(field_data[name].ravel()[0]) for name in ("space", "SPACE") if name in field_data)
    if path.suffix.lower() == ".vtk":
        with path.open("rb") as file:
            words += (
                file.read(600).partition(b"\n")[2].partition(b"\n")[0].partition(b"SPACE=")[2][:3].decode("latin-1")
            )
    return "lps" if "lps" in words.lower() else "ras"


def _decoded(values: NDArray) -> NDArray:
    """`values`; if they are bytes of UTF-8, as `save_mesh` writes texts, that text as an array of one string."""
    if values.dtype != np.uint8:
        return values
    try:
        return np.array([values.tobytes().decode()])
    except UnicodeDecodeError:
        return values


def _read_quietly(path: Path) -> pyvista.UnstructuredGrid:
    """pyvista's reading, with VTK's complaints turned into one InputError."""
    try:
        with _vtk_errors() as errors:
            grid = pyvista.read(path)
    except Exception as error:  # VTK's readers raise whatever they please on damaged files
        raise InputError(f"{path}: cannot be read as a VTK mesh ({type(error).__name__})") from error
    if errors:
        raise InputError(f"{path}: damaged, or not a VTK mesh ({' '.join(errors[0].split())})")
    if not isinstance(grid, pyvista.UnstructuredGrid) or grid.n_cells == 0:
        raise InputError(f"{path}: expected an unstructured grid with cells, found {type(grid).__name__}; damaged?")
    return grid


@contextlib.contextmanager
def _vtk_errors() -> Iterator[list[str]]:
    """VTK's errors, instead of on the screen: pyvista passes them to the root logger and on as warnings."""
    errors: list[str] = []

    def caught(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.ERROR:
            errors.append(record.getMessage())
        return False

    root = logging.getLogger()
    root.addFilter(caught)
    try:
        with warnings.catch_warnings(), pyvista.vtk_verbosity("off"):
            warnings.simplefilter("ignore")
            yield errors
    finally:
        root.removeFilter(caught)
