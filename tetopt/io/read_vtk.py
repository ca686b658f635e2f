"""VTU and VTK files as they are read: by VTK in a process of its own, after their heads were looked at here."""

from __future__ import annotations

import mmap
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.apart import DEFLATE_RATIO, read_apart
from tetopt.io.raw import RawGrid

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid

# Counts in a VTU file's tags, and in the lines of a VTK file: each thing counted takes a byte at least.
XML_COUNT = re.compile(rb"<[^<>]{0,10000}?\b(NumberOf\w+)\s*=\s*[\"']\s*([-+]?\d+(?:\.\d*)?(?:[eE]\+?\d+)?)")
LEGACY_COUNT = re.compile(
    rb"^(POINTS|CELLS|CELL_TYPES|POINT_DATA|CELL_DATA|OFFSETS|VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS|[^\s]+ \d+)"
    rb"[ \t]+(-?\d+)(?=[ \t]*\r?\n|[ \t]+(?:\d+|[a-z_0-9]+)[ \t]*\r?\n)",
    re.M,
)
ENTITIES = re.compile(rb"<!(?:DOCTYPE|ENTITY)", re.I)


def read_vtk(path: Path) -> RawGrid:
    """The unstructured grid in a VTU or VTK file.

    Raises
    ------
    InputError
        Without the path before it: a damaged file, or one that VTK crashes at; another data set; counts that the file
        is too short for; a document type or entities; no cells.
    """
    check_counts(path)
    return checked_grid(*read_apart(arrays_of, path, library="VTK"))


def checked_grid(kind: str, errors: str, arrays: dict[str, Any]) -> RawGrid:
    """What `arrays_of` gives as a grid whose arrays fit one another.

    Raises
    ------
    InputError
        As `read_vtk`.
    """
    if errors:
        raise InputError(f"damaged, or not a VTK mesh ({errors})")
    if kind != "UnstructuredGrid" or not len(arrays.get("cell_types", ())):
        raise InputError(f"expected an unstructured grid with cells, found {kind}; damaged?")
    grid = RawGrid(**arrays)
    starts, n = grid.offsets, len(grid.cell_types)
    is_whole = len(starts) == n + 1 and starts[0] == 0 and starts[-1] <= len(grid.connectivity)
    is_whole &= all(len(each) == len(grid.points) for each in grid.point_data.values())
    is_whole &= all(len(each) == n for each in grid.cell_data.values())
    if not is_whole or (np.diff(starts) < 0).any():
        raise InputError("damaged: its cells, or its data, do not fit together")
    return grid


def check_counts(path: Path) -> None:
    """InputError if the head tells of more than the file can have."""
    size = path.stat().st_size
    if size == 0:
        raise InputError("damaged: the file is empty")
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as whole:
        is_xml = path.suffix.lower() == ".vtu"
        if is_xml and ENTITIES.search(whole):
            raise InputError("has a document type or entities, which no VTK file needs; not read")
        most = size * (DEFLATE_RATIO if is_xml and whole.find(b"compressor") >= 0 else 1)
        for match in (XML_COUNT if is_xml else LEGACY_COUNT).finditer(whole):
            name, number = match[1].decode("latin-1"), float(match[2])
            if not 0 <= number <= most:
                count = match[2][:40].decode()
                raise InputError(f"damaged: {name[:40]} is {count}, its {size} bytes can hold {most} at most")


# In the child


def arrays_of(path: str) -> tuple[str, str, dict[str, Any]]:
    """The kind of data set, VTK's first complaint, and the arrays of a `RawGrid`."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow, vtkUnsignedCharArray
    from vtkmodules.vtkIOLegacy import vtkDataSetReader
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    window = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(window)
    reader = vtkXMLUnstructuredGridReader() if path.lower().endswith(".vtu") else vtkDataSetReader()
    if isinstance(reader, vtkDataSetReader):
        for kind in ("Scalars", "Vectors", "Normals", "Tensors", "ColorScalars", "TCoords", "Fields"):
            getattr(reader, f"ReadAll{kind}On")()
    reader.SetFileName(os.fsencode(path))  # type: ignore[arg-type]  # as bytes names that are not UTF-8, too
    reader.Update()
    grid = reader.GetOutput()
    errors = _first_error(window.GetOutput())
    if grid is None or errors:
        return "nothing", errors or "nothing was read", {}
    kind = grid.GetClassName().removeprefix("vtk")
    if kind != "UnstructuredGrid" or grid.GetNumberOfCells() == 0:
        return kind, "", {}
    types = vtkUnsignedCharArray()
    types.DeepCopy(grid.GetCellTypesArray())  # which of cells of one kind may hold its number once
    return kind, "", plain_arrays(grid) | {"cell_types": vtk_to_numpy(types).astype(np.uint8)}


def plain_arrays(grid: vtkUnstructuredGrid) -> dict[str, Any]:
    """The arrays of a `RawGrid`, by name, of VTK's own, but for the types of cells."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    cells = grid.GetCells()
    return {
        "points": vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64),
        "connectivity": vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64),
        "offsets": vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64),
        "point_data": _data_of(grid.GetPointData()),
        "cell_data": _data_of(grid.GetCellData()),
        "field_data": _data_of(grid.GetFieldData()),
    }


def _first_error(output: str | bytes | None) -> str:
    """The first of VTK's errors, on one line, without where in VTK it was; empty without any."""
    text = output.decode("utf-8", "replace") if isinstance(output, bytes) else output or ""  # bytes if it is no UTF-8
    _, mark, rest = text.partition("ERROR: ")
    if not mark:
        return ""
    words = re.split(r"\n(?=ERROR|Warning|Generic)", rest)[0].partition("\n")[2] or rest
    return re.sub(r" ?\(0x[0-9a-f]+\)", "", " ".join(words.split()))[:300] or "an error without words"


def _data_of(data: Any) -> dict[str, NDArray]:
    """Arrays by name."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkBitArray, vtkDataArray, vtkStringArray, vtkUnsignedCharArray

    arrays = {}
    for k in range(data.GetNumberOfArrays()):
        array = data.GetAbstractArray(k)
        name = array.GetName() or f"Unnamed_{k}"
        if isinstance(array, vtkStringArray):
            texts = [array.GetValue(i) for i in range(array.GetNumberOfValues())]
            arrays[name] = np.array([text if isinstance(text, str) else repr(text) for text in texts], np.str_)
        elif isinstance(array, vtkDataArray):
            if isinstance(array, vtkBitArray):
                bits, array = array, vtkUnsignedCharArray()
                array.DeepCopy(bits)
            arrays[name] = vtk_to_numpy(array)
    return arrays
