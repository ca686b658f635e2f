"""Reading of VTU and VTK files by VTK in a separate process, whose limits end what a false
header asks for.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tetopt.errors import InputError
from tetopt.io.apart import read_apart
from tetopt.io.raw import RawGrid
from tetopt.system.arrays import Arrays, Json

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid


def read_vtk(path: Path) -> RawGrid:
    """Read the unstructured grid in a VTU or VTK file.

    Raises
    ------
    InputError
        Without a leading path: the file is damaged, or VTK crashes on it; it has another data set,
        or no cells.
    """
    return check_grid(*read_apart(arrays_of, path, library="VTK"))


def check_grid(kind: str, errors: str, arrays: Json) -> RawGrid:
    """Convert the result of `arrays_of` to a grid after checking that its arrays are consistent.

    Raises
    ------
    InputError
        For the reasons of `read_vtk`.
    """
    if errors:
        raise InputError(f"damaged, or not a VTK mesh ({errors})")
    if kind != "UnstructuredGrid" or not len(arrays.get("cell_types", ())):
        raise InputError(f"expected an unstructured grid with cells, found {kind}; damaged?")
    grid = RawGrid(**arrays)
    starts = grid.offsets
    n = len(grid.cell_types)
    is_whole = len(starts) == n + 1 and starts[0] == 0 and starts[-1] <= len(grid.connectivity)
    is_whole &= all(len(each) == len(grid.points) for each in grid.point_data.values())
    is_whole &= all(len(each) == n for each in grid.cell_data.values())
    if not is_whole or (np.diff(starts) < 0).any():
        raise InputError("damaged: its cells or data are inconsistent")
    return grid


# In the child


def arrays_of(path: str) -> tuple[str, str, Json]:
    """Return the type of data set, VTK's first error, and the arrays of a `RawGrid`."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import (
        vtkOutputWindow,
        vtkStringOutputWindow,
        vtkUnsignedCharArray,
    )
    from vtkmodules.vtkIOLegacy import vtkDataSetReader
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    window = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(window)
    reader = vtkXMLUnstructuredGridReader() if path.lower().endswith(".vtu") else vtkDataSetReader()
    if isinstance(reader, vtkDataSetReader):
        for kind in (
            "Scalars",
            "Vectors",
            "Normals",
            "Tensors",
            "ColorScalars",
            "TCoords",
            "Fields",
        ):
            getattr(reader, f"ReadAll{kind}On")()
    # bytes, for names that are not UTF-8
    reader.SetFileName(os.fsencode(path))  # type: ignore[arg-type]
    reader.Update()
    grid = reader.GetOutput()
    errors = _first_error(window.GetOutput())
    if grid is None or errors:
        return "nothing", errors or "nothing was read", {}
    kind = grid.GetClassName().removeprefix("vtk")
    if kind != "UnstructuredGrid" or grid.GetNumberOfCells() == 0:
        return kind, "", {}
    types = vtkUnsignedCharArray()
    types.DeepCopy(grid.GetCellTypesArray())  # VTK may store it only once for cells of one type
    return kind, "", plain_arrays(grid) | {"cell_types": vtk_to_numpy(types).astype(np.uint8)}


def plain_arrays(grid: vtkUnstructuredGrid) -> Json:
    """Return the arrays of a `RawGrid` by name, except for cell types."""
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
    """Return VTK's first error on one line, without its place in VTK; empty if there is none."""
    # bytes if not UTF-8
    text = output.decode("utf-8", "replace") if isinstance(output, bytes) else output or ""
    _, mark, rest = text.partition("ERROR: ")
    if not mark:
        return ""
    words = re.split(r"\n(?=ERROR|Warning|Generic)", rest)[0].partition("\n")[2] or rest
    return (
        re.sub(r" ?\(0x[0-9a-f]+\)", "", " ".join(words.split()))[:300]
        or "an error without a message"
    )


def _data_of(data: Any) -> Arrays:
    """Return arrays by name."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import (
        vtkBitArray,
        vtkDataArray,
        vtkStringArray,
        vtkUnsignedCharArray,
    )

    arrays = {}
    for k in range(data.GetNumberOfArrays()):
        array = data.GetAbstractArray(k)
        name = array.GetName() or f"Unnamed_{k}"
        if isinstance(array, vtkStringArray):
            texts = [array.GetValue(i) for i in range(array.GetNumberOfValues())]
            arrays[name] = np.array(
                [text if isinstance(text, str) else repr(text) for text in texts], np.str_
            )
        elif isinstance(array, vtkDataArray):
            if isinstance(array, vtkBitArray):
                bits = array
                array = vtkUnsignedCharArray()
                array.DeepCopy(bits)
            arrays[name] = vtk_to_numpy(array)
    return arrays
