"""Reading of AFNI and MINC (nibabel), GIPL and legacy VTK (SimpleITK), VTI (VTK), and arrays of
numpy; all but the last in a separate process.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np

from tetopt.errors import InputError
from tetopt.io.apart import read_apart
from tetopt.io.read_itk import check_itk, volume_of
from tetopt.io.stacks import spacing_of
from tetopt.io.units import note_size
from tetopt.io.volumes import (
    UNREADABLE_FILE,
    Reader,
    Request,
    Voxels,
    check_room,
    note,
    one_line,
    volume_index,
)

AFNI = re.compile(r"(.*)\.(head|brik|brik\.gz)", re.IGNORECASE | re.DOTALL)  # two files of a name
# The first values in a .vtk file
VALUES_OF_CELLS = re.compile(
    rb"# vtk(?:(?!^POINT_DATA).)*?^CELL_DATA\s", re.IGNORECASE | re.DOTALL | re.MULTILINE
)
LEGACY_BYTES = 4096  # more than a header without arrays has
IN_LPS = "its format does not tell left from right: assuming LPS, as ITK does"
IN_RAS = "its format does not tell left from right: assuming RAS, as in tetopt's .vtu"


def _reads(library: str, read: Callable[..., Any], words: str) -> Any:
    """Return a reader by a library, with a note on directions."""

    def read_file(path: Path, request: Request) -> Voxels:
        if library == "SimpleITK":
            check_itk()
        size = sum(file.stat().st_size for file in (path, *_other_files(path)))
        data, affine = read_apart(read, path, request.volume, size=size, library=library)
        note(words)
        note_size(data.shape, affine, None)
        return data, affine

    return read_file


def read_array(path: Path, request: Request) -> Voxels:
    """Return an array of numpy, and an affine of its spacing; InputError without a leading path."""
    try:
        data = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise InputError(f"{UNREADABLE_FILE} ({one_line(error)})") from error
    if request.spacing_mm is None:
        raise InputError("an array states no voxel size; give it by `spacing_mm`, mm")
    check_room(data.shape, data.dtype.itemsize)
    data = data[(..., *volume_index(data.shape[3:], request.volume))]
    note("an array has no place: assuming RAS axes, and the first voxel at the origin")
    return data, np.diag([*spacing_of(request.spacing_mm, data.ndim), 1.0])


def _other_files(path: Path) -> list[Path]:
    """Return the other file of AFNI's two."""
    own = AFNI.fullmatch(path.name)
    pairs = [(file, AFNI.fullmatch(file.name)) for file in path.parent.iterdir() if own]
    return [file for file, each in pairs if each and own and each[1] == own[1] and file != path]


# In the child


def _legacy_of(path: str, volume: int | None) -> Voxels:
    """Return data and affine by SimpleITK, which takes values of cells in .vtk for those of
    points.
    """
    with open(path, "rb") as file:
        has_cells = VALUES_OF_CELLS.match(file.read(LEGACY_BYTES))
    if has_cells:
        raise InputError(
            "its values are of cells (CELL_DATA), expected POINT_DATA; save it as .vti, where "
            "both are read"
        )
    voxels: Voxels = volume_of(path, volume, False, False)
    return voxels


def _grid_of(path: str, volume: int | None) -> Voxels:
    """Return data and affine by nibabel, whose axes are RAS+."""
    file: Any = nibabel.load(path)
    if path.lower().endswith(".mnc") and len(file.shape) > 3:  # time comes first there
        raise InputError(f"expected 3 axes, got {len(file.shape)}; choose a time with mincreshape")
    index = volume_index(file.shape[3:], volume)
    check_room(file.shape, np.dtype(np.float64).itemsize)
    return np.asanyarray(file.dataobj[(..., *index)]), np.array(file.affine)


def _vti_of(path: str, volume: int | None) -> Voxels:
    """Return data and affine by VTK; values of points lie at these, those of cells in their
    middles.
    """
    import pyvista

    grid: Any = pyvista.read(path)
    arrays = [
        (f"{name} of {at}", values, shift)
        for at, shift in (("point", 0.0), ("cell", 0.5))
        for name, values in getattr(grid, f"{at}_data").items()
        if values.ndim == 1 and not name.startswith("vtk")
    ]
    if not arrays:
        raise InputError(
            "expected an array with one number per point or cell (no RGB or vectors), found "
            f"{', '.join(grid.array_names) or 'none'}; convert it to grey first"
        )
    names = ", ".join(name for name, *_ in arrays)
    _, values, shift = arrays[volume_index((len(arrays),), volume, names)[0]]
    shape = np.array(grid.dimensions)
    affine = np.array(grid.index_to_physical_matrix)
    affine[:3, 3] += affine[:3, :3] @ (np.array(grid.extent[::2]) + shift * (shape > 1))
    shape = np.maximum(shape - round(2.0 * shift), 1)
    return np.asarray(values).reshape(shape, order="F"), affine


GRIDS = Reader(
    (".head", ".brik", ".brik.gz", ".mnc"),
    _reads("nibabel", _grid_of, ""),
    other_files=_other_files,
)
LEGACY = Reader((".gipl", ".gipl.gz", ".vtk"), _reads("SimpleITK", _legacy_of, IN_LPS))
VTI = Reader((".vti",), _reads("VTK", _vti_of, IN_RAS))
ARRAYS = Reader((".npy",), read_array, has_spacing=False)
