"""Meshes and models as VTK files: XML (.vtu) and legacy (.vtk), through VTK's own writers.

Points are in world coordinates, mm; cells are positively oriented and of one type: linear, or
quadratic with straight edges, with corners first among the points. Data of cells and points are
cell data and point data. Materials are cell data `young`, `nu`, `material` (from 1), and `density`,
kg/m3, if present; moduli that vary within a cell are also cell data `young_gauss`, with a column
for each Gauss point of quadratic cells, or point data `young_nodes`. Strings are field data, as
UTF-8 bytes: meshio rejects files with VTK's string arrays, and pyvista writes only ASCII to them.
`loads` contains loads in text form.

A facet set is field data "facets:NAME", rows (cell, local node opposite), and its nodes are point
data "on_NAME", 1 or 0, for ParaView; a cell set is field data "cells:NAME", cell numbers from 0.
Other programs keep field data when they change the cells: "cells_sha256" identifies the cells for
which the sets were written.

3D Slicer (`vtkMRMLModelStorageNode`) assumes LPS coordinates unless the header of a .vtk file has
"SPACE=RAS", as tetopt's files do, or a .vtu file has a string array SPACE, which tetopt's cannot
have: use .vtk there, or LPS.
"""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tetopt.image import Image
from tetopt.interop.conversions import VTK_KINDS, add_array, vtk_grid
from tetopt.io.text import xml_attribute
from tetopt.mesh import Mesh
from tetopt.model.fields import is_stress
from tetopt.model.file import text_in
from tetopt.model.loads import load_words
from tetopt.model.model import STRESS_UNITS, Model, elements, grid_fields
from tetopt.model.sets import SET_NAME, Box, Sets, is_set
from tetopt.system.arrays import Arrays
from tetopt.system.incoming import json_of

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkDataSet, vtkUnstructuredGrid

VTK_SUFFIXES = (".vtu", ".vtk")  # formats that contain a whole model and can be read back
# Names of field data in tetopt's files, see above.
FACETS_PREFIX, CELLS_PREFIX, CHECKSUM_NAME = "facets:", "cells:", "cells_sha256"
# of zlib: files are 3 % larger than with VTK's default, 5, and written in 0.4 of the time
COMPRESSION_LEVEL = 2
LEGACY_VERSION = 42  # version 4.2: older programs, including 3D Slicer, cannot read 5.1


def vtu(model: Model) -> bytes:
    """Return a VTU file, exact and compressed."""
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    return xml_bytes(vtkXMLUnstructuredGridWriter(), model_grid(model))


def vtk(model: Model) -> bytes:
    """Return a legacy VTK file; binary, because VTK rounds ASCII to eleven digits."""
    import pyvista
    from vtkmodules.vtkIOLegacy import vtkUnstructuredGridWriter

    grid = pyvista.wrap(model_grid(model))
    for data in (grid.point_data, grid.cell_data, grid.field_data):
        for name in data:
            data[name] = _without_int64(np.asarray(data[name]))
    writer = vtkUnstructuredGridWriter()
    writer.SetHeader(f"tetopt, {STRESS_UNITS[model.units].length}, SPACE={model.space.upper()}")
    writer.SetFileVersion(LEGACY_VERSION)
    writer.SetFileTypeToBinary()
    return written_bytes(writer, grid)


def _without_int64(values: NDArray) -> NDArray:
    """Convert 64-bit integers to 32 bits, or to floats if they do not fit.

    VTK writes them as "long", whose size depends on the platform, or, if they are a "long long"
    (e.g. from a VTU file), as "vtktypeint64", which meshio does not know.
    """
    if values.dtype.kind not in "iu" or values.dtype.itemsize < 8:
        return values
    range_ = np.iinfo(np.int32)
    fits = values.size == 0 or (values.min() >= range_.min and values.max() <= range_.max)
    return values.astype(np.int32 if fits else np.float64)


def xml_bytes(writer: Any, grid: vtkDataSet) -> bytes:
    """Return the output of a VTK XML writer for a grid, with escaped names of arrays."""
    for fields in (grid.GetCellData(), grid.GetPointData(), grid.GetFieldData()):
        for number in range(fields.GetNumberOfArrays()):
            array = fields.GetAbstractArray(number)
            array.SetName(name_in_xml(array.GetName()))  # VTK 9.7 does not escape them
    writer.SetCompressionLevel(COMPRESSION_LEVEL)
    writer.SetDataModeToBinary()
    return written_bytes(writer, grid)


def name_in_xml(name: str) -> str:
    """Escape a name for VTK's XML files; apostrophes, too, as `tetopt.io.read_vtk` checks counts
    between them.
    """
    return xml_attribute(name).replace("'", "&apos;")


def written_bytes(writer: Any, grid: vtkDataSet) -> bytes:
    """Return the output of a VTK writer for a grid.

    VTK writes to memory and Python to the disk: on a full disk, VTK reports nothing or ends the
    process.
    """
    writer.SetInputData(grid)
    writer.WriteToOutputStringOn()
    if not writer.Write():
        raise RuntimeError("VTK could not write the mesh")
    if writer.IsA("vtkXMLWriter"):
        return writer.GetOutputString().encode()
    text = writer.GetOutputStdString()  # bytes if it is not text
    return text if isinstance(text, bytes) else text.encode()


def model_grid(model: Model) -> vtkUnstructuredGrid:
    """Convert a whole model to one grid."""
    on_cells, on_nodes = grid_fields(model)
    grid = vtk_grid(*elements(model), VTK_KINDS[model.mesh.ndim, model.order], on_cells, on_nodes)
    texts = dict(model.about) | {"space": model.space}
    if model.materials is not None and model.materials.binning is not None:
        texts["binning"] = model.materials.binning._asdict()
    if model.materials is not None and model.materials.fibre_binning is not None:
        texts["fibre_binning"] = model.materials.fibre_binning._asdict()
    has_stresses = any(map(is_stress, [*model.cell_data, *model.point_data]))
    if (
        model.materials is not None
        or model.loads
        or has_stresses
        or STRESS_UNITS[model.units].mm != 1.0
    ):
        texts["units"] = model.units
    if model.loads:
        texts["loads"] = [load_words(load) for load in model.loads]
    add_texts(grid, texts)
    add_sets(grid, model.mesh, model.sets)
    return grid


def add_texts(grid: vtkUnstructuredGrid, texts: dict[str, Any]) -> None:
    """Add each entry as field data, as JSON unless it is a string already."""
    for name, value in texts.items():
        text = value if isinstance(value, str) else json.dumps(value)
        add_array(
            grid.GetFieldData(),
            name,
            np.frombuffer(text.encode("utf-8", "backslashreplace"), dtype=np.uint8),
        )


def add_sets(grid: vtkUnstructuredGrid, mesh: Mesh, sets: Sets) -> None:
    """Add the sets as field data, with the checksum of their cells."""
    for name, rows in sets.facets.items():
        add_array(grid.GetFieldData(), f"{FACETS_PREFIX}{name}", rows)
    for name, members in sets.cells.items():
        add_array(grid.GetFieldData(), f"{CELLS_PREFIX}{name}", members)
    if sets.facets or sets.cells:
        add_texts(grid, {CHECKSUM_NAME: _checksum(mesh)})


def sets_in(field_data: Arrays, mesh: Mesh) -> tuple[Sets, tuple[str, ...]]:
    """Return the sets in a file's field data, if they were written for these cells, and notes on
    dropped ones.
    """
    names = [name for name in field_data if name.startswith((FACETS_PREFIX, CELLS_PREFIX))]
    sets = Sets({}, {})
    if not names:
        return sets, ()
    if text_in(field_data, CHECKSUM_NAME) != _checksum(mesh):
        words = "dropped sets, as the cells may have changed since the sets were written"
        return sets, (f"{words}: {', '.join(name.partition(':')[2] for name in names)}",)
    unfit = []
    for key in names:
        prefix = key[: key.index(":") + 1]
        name = key.partition(":")[2]
        ends = (len(mesh.cells), mesh.ndim + 1) if prefix == FACETS_PREFIX else (len(mesh.cells),)
        is_free = name.lower() not in {each.lower() for part in sets for each in part}
        if not SET_NAME.fullmatch(name) or not is_free or not is_set(field_data[key], ends):
            unfit.append(name)
        elif prefix == FACETS_PREFIX:
            sets.facets[name] = field_data[key].reshape(-1, 2).astype(np.int64)
        else:
            sets.cells[name] = field_data[key].ravel().astype(np.int64)
    words = "dropped sets with invalid or repeated names, or without ascending cells or facets"
    return sets, (f"{words}: {', '.join(unfit)}",) if unfit else ()


def _checksum(mesh: Mesh) -> str:
    return hashlib.sha256(np.ascontiguousarray(mesh.cells, dtype="<i8").tobytes()).hexdigest()


def box_in(field_data: Arrays, ndim: int) -> Box | None:
    """Return the box of the meshed image from a file's field data, if present and valid."""
    try:
        box = json_of(text_in(field_data, "box") or "")
        shape = tuple(box["shape"])
        # checked by Image
        affine = Image(np.zeros((1,) * ndim), np.array(box["affine"], dtype=np.float64)).affine
    # another program's "box"
    except (TypeError, ValueError, KeyError, OverflowError, RecursionError):
        return None
    is_shape = len(shape) == ndim and all(type(size) is int and size > 0 for size in shape)
    return Box(shape, affine) if is_shape else None
