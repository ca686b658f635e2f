"""Meshes as VTU files, through pyvista."""

from __future__ import annotations

import contextlib
import json
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyvista
from numpy.typing import NDArray
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from tetopt.energy.sampling import cell_moments
from tetopt.errors import InputError
from tetopt.geometry.simplex import dihedral_angles, oriented, rho, volumes
from tetopt.image import Image
from tetopt.io.files import written_whole
from tetopt.mesh import Mesh

CELL_TYPES = {2: pyvista.CellType.TRIANGLE, 3: pyvista.CellType.TETRA}


class MeshFile(NamedTuple):
    """A mesh read from a file and what came with it."""

    mesh: Mesh
    cell_data: dict[str, NDArray]  # by name, one row a cell
    field_data: dict[str, NDArray]  # by name, of any length; bytes of UTF-8 have become one string
    n_turned: int  # cells that were oriented the other way in the file


def cell_fields(mesh: Mesh, image: Image | None = None) -> dict[str, NDArray]:
    """What the mesh file holds of each cell: volume, rho, min_dihedral, and mean, variance, n_voxels of the image.

    Volumes in mm^n, angles in degrees, intensities in the image's unit.
    """
    fields: dict[str, NDArray] = {}
    if image is not None:
        moments = cell_moments(image, mesh)
        fields |= {"mean": moments.mean, "variance": moments.variance, "n_voxels": moments.n_voxels}
    fields["volume"] = volumes(mesh.points, mesh.cells)
    fields["rho"] = rho(mesh.points, mesh.cells)
    fields["min_dihedral"] = dihedral_angles(mesh.points, mesh.cells).min(axis=1)
    return fields


def to_pyvista(mesh: Mesh, cell_data: dict[str, NDArray] | None = None) -> pyvista.UnstructuredGrid:
    """The mesh as a pyvista grid in world mm; a 2-D mesh lies in the plane z = 0."""
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.ndim] = mesh.points
    grid = pyvista.UnstructuredGrid({CELL_TYPES[mesh.ndim]: mesh.cells}, points)
    for name, values in (cell_data or {}).items():
        grid.cell_data[name] = values
    return grid


def save_mesh(
    path: str | Path,
    mesh: Mesh,
    cell_data: dict[str, NDArray] | None = None,
    about: dict[str, Any] | None = None,
    point_data: dict[str, NDArray] | None = None,
) -> None:
    """Write a VTU file, whole or not at all.

    Points in world mm (RAS+), cells positively oriented, `cell_data` and `point_data` by name; each entry of `about`
    becomes a field-data text, as JSON unless it is a string already. Texts are held as bytes of UTF-8: meshio refuses
    files with VTK's string arrays, and pyvista writes only ASCII into them. Replaces an existing file; ask
    `tetopt.io.files.checked_output` first.
    """
    grid = to_pyvista(mesh, cell_data)
    for name, values in (point_data or {}).items():
        grid.point_data[name] = values
    for name, value in (about or {}).items():
        text = value if isinstance(value, str) else json.dumps(value)
        grid.field_data[name] = np.frombuffer(text.encode(), dtype=np.uint8)
    # VTK writes into memory and Python to the disk: on a full one VTK reports nothing, or ends the process.
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetInputData(grid)
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()
    if not writer.Write():
        raise RuntimeError(f"{path}: VTK could not write the mesh")
    with written_whole(Path(path)) as temporary:
        temporary.write_bytes(writer.GetOutputString().encode())


def load_mesh(path: str | Path) -> MeshFile:
    """Read triangles or tetrahedra from a VTU or VTK file.

    Cells oriented the other way are turned and counted. A file of triangles is 2-D and must lie in the plane
    z = 0. Nodes that no cell uses are dropped.

    Raises
    ------
    InputError
        A missing or unreadable file, no cells, other or mixed cell types, triangles out of the plane, flat cells.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such mesh file")
    if path.suffix.lower() not in (".vtu", ".vtk"):
        raise InputError(f"{path}: expected a mesh named .vtu or .vtk")
    grid = _read_quietly(path)
    n = _dimension(path, grid)
    cells = np.asarray(grid.cells_dict[np.uint8(CELL_TYPES[n])], dtype=np.int64)
    points = np.asarray(grid.points, dtype=np.float64)
    if cells.min() < 0 or cells.max() >= len(points):
        raise InputError(
            f"{path}: its cells use nodes {cells.min()}..{cells.max()}, it holds 0..{len(points) - 1}; damaged?"
        )
    used, compact = np.unique(cells, return_inverse=True)
    if n == 2 and np.any(points[used, 2] != 0.0):
        raise InputError(f"{path}: a mesh of triangles must lie in the plane z = 0; surfaces in space are not meshed")
    points, cells = points[used, :n], compact.reshape(cells.shape)
    with np.errstate(invalid="ignore"):  # infinite coordinates, which Mesh refuses in words
        turned = oriented(points, cells)
    try:
        mesh = Mesh(points, turned)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    cell_data = {name: np.asarray(grid.cell_data[name]) for name in grid.cell_data}
    field_data = {name: _decoded(np.asarray(grid.field_data[name])) for name in grid.field_data}
    return MeshFile(mesh, cell_data, field_data, int((turned != cells).any(axis=1).sum()))


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


def _dimension(path: Path, grid: pyvista.UnstructuredGrid) -> int:
    types = set(np.unique(grid.celltypes).tolist())
    for n, cell_type in CELL_TYPES.items():
        if types == {int(cell_type)}:
            return n
    names = sorted(pyvista.CellType(t).name.lower() for t in types)
    raise InputError(f"{path}: expected only tetrahedra or only triangles, found {', '.join(names)}")
