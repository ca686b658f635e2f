"""Meshes and models as VTK's files: XML (.vtu) and legacy (.vtk), through VTK's own writers.

Points in world mm, cells positively oriented, of one type. What is on each cell is cell data; with materials also
`young`, `nu` and `material`, from 1. Texts are field data, held as bytes of UTF-8: meshio refuses files with VTK's
string arrays, and pyvista writes only ASCII into them.

A facet set is field data "facets:NAME", rows (cell, local node opposite), and its nodes are point data "on_NAME", 1 or
0, to be seen in ParaView; a cell set is field data "cells:NAME", cell numbers from 0.

3D Slicer (`vtkMRMLModelStorageNode`) takes coordinates for LPS unless the head of a .vtk file says "SPACE=RAS", as ours
does, or a .vtu file has a string array SPACE, which ours cannot have: take .vtk there, or LPS.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pyvista
from numpy.typing import NDArray
from vtkmodules.vtkIOLegacy import vtkUnstructuredGridWriter
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from tetopt.mesh import Mesh
from tetopt.model.model import Model
from tetopt.model.sets import Box, Sets, nodes_of

CELL_TYPES = {2: pyvista.CellType.TRIANGLE, 3: pyvista.CellType.TETRA}
FACETS, CELLS, ON = "facets:", "cells:", "on_"
LEGACY = 42  # version 4.2: 5.1 is not read by older programs, 3D Slicer among them


def to_pyvista(mesh: Mesh, cell_data: dict[str, NDArray] | None = None) -> pyvista.UnstructuredGrid:
    """The mesh as a pyvista grid in world mm; a 2-D mesh lies in the plane z = 0."""
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.ndim] = mesh.points
    grid = pyvista.UnstructuredGrid({CELL_TYPES[mesh.ndim]: mesh.cells}, points)
    for name, values in (cell_data or {}).items():
        grid.cell_data[name] = values
    return grid


def vtu(model: Model) -> bytes:
    """A VTU file, exact, compressed."""
    return vtu_bytes(model_grid(model))


def vtk(model: Model) -> bytes:
    """A legacy VTK file, binary, since VTK rounds ASCII to eleven digits."""
    grid = model_grid(model)
    for name in grid.field_data:
        if np.asarray(grid.field_data[name]).dtype == np.int64:  # else "long", which is not the same everywhere
            grid.field_data[name] = np.asarray(grid.field_data[name]).astype(np.int32)
    writer = vtkUnstructuredGridWriter()
    writer.SetHeader(f"tetopt, mm, SPACE={model.space.upper()}")
    writer.SetFileVersion(LEGACY)
    writer.SetFileTypeToBinary()
    return _written(writer, grid)


def vtu_bytes(grid: pyvista.UnstructuredGrid) -> bytes:
    """A grid as the content of a VTU file."""
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetDataModeToBinary()
    return _written(writer, grid)


def _written(writer: Any, grid: pyvista.UnstructuredGrid) -> bytes:
    # VTK writes into memory and Python to the disk: on a full one VTK reports nothing, or ends the process.
    writer.SetInputData(grid)
    writer.WriteToOutputStringOn()
    if not writer.Write():
        raise RuntimeError("VTK could not write the mesh")
    if not isinstance(writer, vtkUnstructuredGridWriter):
        return writer.GetOutputString().encode()
    content = writer.GetOutputStdString()  # bytes, if they are no text
    return content if isinstance(content, bytes) else content.encode()


def model_grid(model: Model) -> pyvista.UnstructuredGrid:
    """All of a model on one grid."""
    grid = to_pyvista(model.mesh, model.cell_data)
    for name, rows in model.sets.facets.items():
        is_on = np.zeros(len(model.mesh.points), dtype=np.uint8)
        is_on[nodes_of(model.mesh, rows)] = 1
        grid.point_data[f"{ON}{name}"] = is_on
    texts = dict(model.about) | {"space": model.space}
    if model.materials is not None:
        of_cell = model.materials.of_cell
        grid.cell_data["young"] = model.materials.young[of_cell]
        grid.cell_data["nu"] = model.materials.nu[of_cell]
        grid.cell_data["material"] = of_cell + 1
        texts["units"] = model.units
    if model.loads:
        texts["loads"] = [[load.set_name, load.displacement.tolist()] for load in model.loads]
    add_texts(grid, texts)
    add_sets(grid, model.sets)
    return grid


def add_texts(grid: pyvista.UnstructuredGrid, texts: dict[str, Any]) -> None:
    """Each entry as field data, as JSON unless it is a string already."""
    for name, value in texts.items():
        text = value if isinstance(value, str) else json.dumps(value)
        grid.field_data[name] = np.frombuffer(text.encode(), dtype=np.uint8)


def add_sets(grid: pyvista.UnstructuredGrid, sets: Sets) -> None:
    """The sets as field data."""
    for name, rows in sets.facets.items():
        grid.field_data[f"{FACETS}{name}"] = rows
    for name, members in sets.cells.items():
        grid.field_data[f"{CELLS}{name}"] = members


def sets_in(field_data: dict[str, NDArray]) -> Sets:
    """The sets among a file's field data."""
    return Sets(
        {
            name.removeprefix(FACETS): values.reshape(-1, 2).astype(np.int64)
            for name, values in field_data.items()
            if name.startswith(FACETS)
        },
        {
            name.removeprefix(CELLS): values.ravel().astype(np.int64)
            for name, values in field_data.items()
            if name.startswith(CELLS)
        },
    )


def box_in(field_data: dict[str, NDArray]) -> Box | None:
    """The box of the image that a mesh was made from, if its file tells."""
    if "box" not in field_data:
        return None
    box = json.loads(str(field_data["box"][0]))
    return Box(tuple(box["shape"]), np.array(box["affine"]))


def box_text(box: Box) -> dict[str, Any]:
    """What `box_in` reads, for a mesh's `about`."""
    return {"shape": list(box.shape), "affine": box.affine.tolist()}
