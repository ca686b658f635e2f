"""Meshes from files and into them: VTU and VTK through pyvista, and gmsh's MSH."""

from __future__ import annotations

import contextlib
import logging
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyvista
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.simplex import oriented
from tetopt.io.files import written_whole
from tetopt.io.raw import CELL_DIMENSIONS, Raw
from tetopt.io.read_gmsh import read_msh
from tetopt.io.vtk import add_texts, box_in, sets_in, text_in, to_pyvista, vtu_bytes
from tetopt.mesh import Mesh
from tetopt.model.model import STRESS_UNITS, half_turn
from tetopt.model.sets import SET_NAME, Box, Sets, free_name, rows_of

MESH_SUFFIXES = (".vtu", ".vtk", ".msh", ".msh2")


class MeshFile(NamedTuple):
    """A mesh read from a file and what came with it."""

    mesh: Mesh  # RAS+ mm
    cell_data: dict[str, NDArray]  # by name, one row a cell; "young", if the file has it, in kPa
    field_data: dict[str, NDArray]  # by name, of any length; bytes of UTF-8 have become one string
    n_turned: int  # cells that were oriented the other way in the file
    n_left: int = 0  # cells of lower dimension, triangles on tetrahedra among them, that were left out
    sets: Sets = Sets({}, {})
    box: Box | None = None  # of the image that the mesh was made from
    space: str = "ras"  # of the file: from "lps" the mesh has been turned to RAS+
    notes: tuple[str, ...] = ()  # what was left out or renamed, a line each

    def text(self, name: str) -> str | None:
        """A text among the field data, if it is there."""
        return text_in(self.field_data, name)


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
    turned, and moduli that it holds in MPa taken to kPa. Cell data other than numbers are left out.

    The sets of a VTU or VTK file of ours are taken if its cells are still those that they were written for. gmsh's
    physical groups (files named .msh or .msh2) become sets, with names that every format can carry; in files of ours
    the cell sets are those that were written.

    Raises
    ------
    InputError
        A missing or unreadable file, no cells, other cell types, triangles out of the plane, flat cells.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such mesh file")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: expected a mesh named {', '.join(MESH_SUFFIXES[:-1])} or {MESH_SUFFIXES[-1]}")
    raw = read_msh(path) if path.suffix.lower() in (".msh", ".msh2") else _read_vtk(path)
    kind = _kind_of_cells(path, raw)
    n = CELL_DIMENSIONS[kind]
    cells, points = raw.cells[kind], raw.points
    if cells.min() < 0 or cells.max() >= len(points):
        raise InputError(
            f"{path}: its cells use nodes {cells.min()}..{cells.max()}, it holds 0..{len(points) - 1}; damaged?"
        )
    used, compact = np.unique(cells, return_inverse=True)
    if n == 2 and np.any(points[used, 2] != 0.0):
        raise InputError(f"{path}: a mesh of triangles must lie in the plane z = 0; surfaces in space are not meshed")
    if n == 3 and raw.space == "lps":
        points = half_turn(points)
    corners, cells = points[used, :n], compact.reshape(cells.shape)
    with np.errstate(invalid="ignore"):  # infinite coordinates, which Mesh refuses in words
        turned = oriented(corners, cells)
    try:
        mesh = Mesh(corners, turned)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    is_turned = (turned != cells).any(axis=1)
    cell_data, notes = _cell_data(raw, kind)
    cell_data, of_moduli = _in_kPa(cell_data, text_in(raw.field_data, "units") or "kPa")
    sets, of_sets = _sets_of_groups(raw, mesh, kind, used) if raw.groups else sets_in(raw.field_data, mesh)
    return MeshFile(
        mesh,
        cell_data,
        raw.field_data,
        int(is_turned.sum()),
        sum(len(others) for name, others in raw.cells.items() if name != kind),
        sets,
        box_in(raw.field_data, n),
        raw.space,
        notes + of_moduli + of_sets,
    )


def _in_kPa(cell_data: dict[str, NDArray], units: str) -> tuple[dict[str, NDArray], tuple[str, ...]]:
    """Cell data with the moduli in kPa; without them, and a note, if their unit is not known."""
    if "young" not in cell_data:
        return cell_data, ()
    if units in STRESS_UNITS:
        return cell_data | {"young": cell_data["young"] * STRESS_UNITS[units].kPa}, ()
    others = {name: values for name, values in cell_data.items() if name not in ("young", "nu", "material")}
    return others, (f'moduli left out, as their unit is neither {" nor ".join(STRESS_UNITS)}: "{units}"',)


def _kind_of_cells(path: Path, raw: Raw) -> str:
    if unknown := sorted(set(raw.cells) - set(CELL_DIMENSIONS)):
        raise InputError(f"{path}: expected linear tetrahedra, or triangles, found {', '.join(unknown)}")
    kind = max(raw.cells, key=lambda name: CELL_DIMENSIONS[name], default="none")
    if kind not in ("tetra", "triangle"):
        raise InputError(
            f"{path}: expected tetrahedra or triangles, found {', '.join(sorted(raw.cells)) or 'no cells'}"
        )
    return kind


def _cell_data(raw: Raw, kind: str) -> tuple[dict[str, NDArray], tuple[str, ...]]:
    """What is on the cells of this kind, and a note on what is no numbers."""
    values_of = {name: values[kind] for name, values in raw.cell_data.items() if kind in values}
    numbers = {name: values for name, values in values_of.items() if values.dtype.kind in "biuf"}
    others = ", ".join(name for name in values_of if name not in numbers)
    return numbers, (f"cell data left out, as they are no numbers: {others}",) if others else ()


def _sets_of_groups(raw: Raw, mesh: Mesh, kind: str, used: NDArray[np.int64]) -> tuple[Sets, tuple[str, ...]]:
    """gmsh's groups of cells and of facets, and notes on those whose names had to change."""
    place = np.full(len(raw.points), -1)
    place[used] = np.arange(len(used))
    sets, notes = Sets({}, {}), []
    taken: set[str] = set()
    n = CELL_DIMENSIONS[kind]
    groups = [group for group in raw.groups if n - 1 <= CELL_DIMENSIONS[group.kind] <= n]
    if "young" in raw.cell_data:  # of which materials are made anew, under the names of these groups
        groups = [group for group in groups if re.fullmatch(r"material_\d+", group.label) is None]
    # Groups that can keep their names come first, so that they do.
    for group in sorted(groups, key=lambda group: SET_NAME.fullmatch(group.label) is None):
        name = free_name(group.label, taken)
        if group.kind == kind:
            sets.cells[name] = group.members
        else:
            rows = rows_of(mesh, place[raw.cells[group.kind][group.members]])
            if len(rows) == 0:
                notes.append(f'"{group.label}" is left out: none of it is a facet of a cell')
                continue
            sets.facets[name] = rows
        taken.add(name.lower())
        if name != group.label:
            notes.append(f'"{group.label}" is the set {name} here')
    return sets, tuple(notes)


def _read_vtk(path: Path) -> Raw:
    grid = _read_quietly(path)
    names = {int(kind): pyvista.CellType(kind).name.lower() for kind in np.unique(grid.celltypes)}
    if set(names.values()) <= set(CELL_DIMENSIONS):  # pyvista takes other kinds apart only if they have fixed sizes
        cells = {names[int(kind)]: np.asarray(nodes, dtype=np.int64) for kind, nodes in grid.cells_dict.items()}
    else:
        cells = {name: np.empty((0, 1), dtype=np.int64) for name in names.values()}
    cell_data = {
        name: {kind: np.asarray(grid.cell_data[name])[grid.celltypes == number] for number, kind in names.items()}
        for name in grid.cell_data
    }
    field_data = {name: _decoded(np.asarray(grid.field_data[name])) for name in grid.field_data}
    return Raw(np.asarray(grid.points, dtype=np.float64), cells, cell_data, field_data, [], _space(path, field_data))


def _space(path: Path, field_data: dict[str, NDArray]) -> str:
    """Whether a file says that its coordinates are LPS: in our words, or in 3D Slicer's."""
    words = " ".join(text_in(field_data, name) or "" for name in ("space", "SPACE"))
    if path.suffix.lower() == ".vtk":
        with path.open("rb") as file:
            file.readline()
            words += file.readline(256).partition(b"SPACE=")[2][:3].decode("latin-1")
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
