"""Meshes and models as VTK's files: XML (.vtu) and legacy (.vtk), through VTK's own writers.

What they hold is in `tetopt.io.vtkhdf`, too.

Points in world mm, cells positively oriented, of one type: linear, or quadratic with straight edges, whose corners come
first among the points. What is on each cell is cell data, on each point point data; with materials there is cell data
`young`, `nu`, `material`, from 1, and, if there is one, `density`, kg/m3; of moduli that vary in a cell also
`young_gauss`, a column for each Gauss point of quadratic cells, or point data `young_nodes`. Texts are field data, held
as bytes of UTF-8: meshio refuses files with VTK's string arrays, and pyvista writes only ASCII into them. `loads` are
the words of `loads`.

A facet set is field data "facets:NAME", rows (cell, local node opposite), and its nodes are point data "on_NAME", 1 or
0, to be seen in ParaView; a cell set is field data "cells:NAME", cell numbers from 0. Other programs keep field data
when they change the cells: "cells_sha256" beside them tells the cells that the sets were written for.

3D Slicer (`vtkMRMLModelStorageNode`) takes coordinates for LPS unless the head of a .vtk file says "SPACE=RAS", as ours
does, or a .vtu file has a string array SPACE, which ours cannot have: take .vtk there, or LPS.
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
from tetopt.model.model import Model, elements, grid_fields
from tetopt.model.sets import SET_NAME, Box, Sets
from tetopt.system.incoming import json_of

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkDataSet, vtkUnstructuredGrid

VTK_SUFFIXES = (".vtu", ".vtk", ".vtkhdf")  # of files of ours that hold all of a model, and are read
# Names of field data in our files, see above.
FACETS_PREFIX, CELLS_PREFIX, CHECKSUM_NAME = "facets:", "cells:", "cells_sha256"
COMPRESSION_LEVEL = 2  # zlib's level: files are 3 % larger than by VTK's own, 5, and written in 0.4 of the time
LEGACY_VERSION = 42  # version 4.2: 5.1 is not read by older programs, 3D Slicer among them


def vtu(model: Model) -> bytes:
    """A VTU file, exact, compressed."""
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    return xml_bytes(vtkXMLUnstructuredGridWriter(), model_grid(model))


def vtk(model: Model) -> bytes:
    """A legacy VTK file, binary, since VTK rounds ASCII to eleven digits."""
    import pyvista
    from vtkmodules.vtkIOLegacy import vtkUnstructuredGridWriter

    grid = pyvista.wrap(model_grid(model))
    for data in (grid.point_data, grid.cell_data, grid.field_data):
        for name in data:
            data[name] = _without_int64(np.asarray(data[name]))
    writer = vtkUnstructuredGridWriter()
    writer.SetHeader(f"tetopt, mm, SPACE={model.space.upper()}")
    writer.SetFileVersion(LEGACY_VERSION)
    writer.SetFileTypeToBinary()
    return written_bytes(writer, grid)


def _without_int64(values: NDArray) -> NDArray:
    """Integers of 64 bits as ones of 32, or as floats if they do not fit.

    VTK writes them as "long", which is not the same everywhere, or, when they are a "long long" (as those that it has
    read from a VTU file are), as "vtktypeint64", which meshio does not know.
    """
    if values.dtype.kind not in "iu" or values.dtype.itemsize < 8:
        return values
    range_ = np.iinfo(np.int32)
    fits = values.size == 0 or (values.min() >= range_.min and values.max() <= range_.max)
    return values.astype(np.int32 if fits else np.float64)


def xml_bytes(writer: Any, grid: vtkDataSet) -> bytes:
    """A grid as what one of VTK's XML writers makes of it, whose arrays take the names that stand in the file."""
    for fields in (grid.GetCellData(), grid.GetPointData(), grid.GetFieldData()):
        for number in range(fields.GetNumberOfArrays()):
            array = fields.GetAbstractArray(number)
            array.SetName(name_in_xml(array.GetName()))  # VTK 9.7 writes them as they are
    writer.SetCompressionLevel(COMPRESSION_LEVEL)
    writer.SetDataModeToBinary()
    return written_bytes(writer, grid)


def name_in_xml(name: str) -> str:
    """A name as it stands in a file of VTK's: `tetopt.io.read_vtk` takes counts between apostrophes for the file's."""
    return xml_attribute(name).replace("'", "&apos;")


def written_bytes(writer: Any, grid: vtkDataSet) -> bytes:
    """What one of VTK's writers makes of a grid.

    VTK writes into memory and Python to the disk: on a full one VTK reports nothing, or ends the process.
    """
    writer.SetInputData(grid)
    writer.WriteToOutputStringOn()
    if not writer.Write():
        raise RuntimeError("VTK could not write the mesh")
    if writer.IsA("vtkXMLWriter"):
        return writer.GetOutputString().encode()
    text = writer.GetOutputStdString()  # bytes, if they are no text
    return text if isinstance(text, bytes) else text.encode()


def model_grid(model: Model) -> vtkUnstructuredGrid:
    """All of a model on one grid."""
    on_cells, on_nodes = grid_fields(model)
    grid = vtk_grid(*elements(model), VTK_KINDS[model.mesh.ndim, model.order], on_cells, on_nodes)
    texts = dict(model.about) | {"space": model.space}
    if model.materials is not None and model.materials.binning is not None:
        texts["binning"] = model.materials.binning._asdict()
    if model.materials is not None or model.loads or any(map(is_stress, [*model.cell_data, *model.point_data])):
        texts["units"] = model.units
    if model.loads:
        texts["loads"] = [load_words(load) for load in model.loads]
    add_texts(grid, texts)
    add_sets(grid, model.mesh, model.sets)
    return grid


def add_texts(grid: vtkUnstructuredGrid, texts: dict[str, Any]) -> None:
    """Each entry as field data, as JSON unless it is a string already."""
    for name, value in texts.items():
        text = value if isinstance(value, str) else json.dumps(value)
        add_array(grid.GetFieldData(), name, np.frombuffer(text.encode("utf-8", "backslashreplace"), dtype=np.uint8))


def add_sets(grid: vtkUnstructuredGrid, mesh: Mesh, sets: Sets) -> None:
    """The sets as field data, with the checksum of the cells that they are of."""
    for name, rows in sets.facets.items():
        add_array(grid.GetFieldData(), f"{FACETS_PREFIX}{name}", rows)
    for name, members in sets.cells.items():
        add_array(grid.GetFieldData(), f"{CELLS_PREFIX}{name}", members)
    if sets.facets or sets.cells:
        add_texts(grid, {CHECKSUM_NAME: _checksum(mesh)})


def sets_in(field_data: dict[str, NDArray], mesh: Mesh) -> tuple[Sets, tuple[str, ...]]:
    """The sets among a file's field data, if they were written for these cells; and what is left out, in words."""
    names = [name for name in field_data if name.startswith((FACETS_PREFIX, CELLS_PREFIX))]
    sets = Sets({}, {})
    if not names:
        return sets, ()
    if text_in(field_data, CHECKSUM_NAME) != _checksum(mesh):
        words = "sets left out, as the file does not tell that its cells are still those that they were written for"
        return sets, (f"{words}: {', '.join(name.partition(':')[2] for name in names)}",)
    unfit = []
    for key in names:
        prefix, name = key[: key.index(":") + 1], key.partition(":")[2]
        ends = (len(mesh.cells), mesh.ndim + 1) if prefix == FACETS_PREFIX else (len(mesh.cells),)
        is_free = name.lower() not in {each.lower() for part in sets for each in part}
        if not SET_NAME.fullmatch(name) or not is_free or not _is_set(field_data[key], ends):
            unfit.append(name)
        elif prefix == FACETS_PREFIX:
            sets.facets[name] = field_data[key].reshape(-1, 2).astype(np.int64)
        else:
            sets.cells[name] = field_data[key].ravel().astype(np.int64)
    words = "sets left out, as they are no ascending cells or facets, or have no name of their own"
    return sets, (f"{words}: {', '.join(unfit)}",) if unfit else ()


def _is_set(values: NDArray, ends: tuple[int, ...]) -> bool:
    """Whether these are rows of integers from 0 up to `ends`, ascending."""
    try:
        numbers = np.ravel_multi_index(tuple(values.reshape(-1, len(ends)).T), ends)
    except (TypeError, ValueError):
        return False
    return bool((np.diff(numbers) > 0).all())


def _checksum(mesh: Mesh) -> str:
    return hashlib.sha256(np.ascontiguousarray(mesh.cells, dtype="<i8").tobytes()).hexdigest()


def box_in(field_data: dict[str, NDArray], ndim: int) -> Box | None:
    """The box of the image that a mesh of so many dimensions was made from, if its file tells."""
    try:
        box = json_of(text_in(field_data, "box") or "")
        shape = tuple(box["shape"])
        affine = Image(np.zeros((1,) * ndim), np.array(box["affine"], dtype=np.float64)).affine  # which checks it
    except (TypeError, ValueError, KeyError, OverflowError, RecursionError):  # another program's "box"
        return None
    is_shape = len(shape) == ndim and all(type(size) is int and size > 0 for size in shape)
    return Box(shape, affine) if is_shape else None
