"""Triangle surfaces as STL, PLY, VTP and VTK files; all except STL can store integers for each
triangle.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.surface import Surface
from tetopt.interop.conversions import check_fields
from tetopt.io.text import plain
from tetopt.io.vtk import LEGACY_VERSION, written_bytes, xml_bytes
from tetopt.model.model import SPACES, half_turn
from tetopt.model.sets import MOST_LETTERS, SET_NAME
from tetopt.system.arrays import simplex_arrays
from tetopt.system.files import save_bytes

if TYPE_CHECKING:
    import pyvista

SURFACE_SUFFIXES = (".stl", ".ply", ".vtp", ".vtk")
LABELLED_SUFFIXES = SURFACE_SUFFIXES[1:]  # formats with labels of triangles

# 3D Slicer looks for this in the header of an STL or VTK file, in the comments of a PLY file, or
# for a text of this name in a VTP file; if it is missing, Slicer assumes LPS, with x and y negated:
# Slicer/Slicer, Libs/MRML/Core/vtkMRMLModelStorageNode.cxx, GetCoordinateSystemFromFileHeader and
# ...FromFieldData; https://discourse.slicer.org/t/10446.
SPACE_KEY = "SPACE="

Labels = Mapping[str, NDArray[np.integer]]  # by name, one 32-bit number per triangle

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
PLY_FACE = np.dtype([("count", "u1"), ("nodes", "<i4", 3)])


class SurfaceCheck(NamedTuple):
    """Properties of a surface file, computed by trimesh."""

    is_watertight: bool  # each edge in exactly two triangles
    is_winding_consistent: bool  # which traverse it in opposite directions
    volume: float  # mm^3, positive if normals point outwards
    area: float  # mm^2
    n_pieces: int  # number of disconnected closed surfaces; the wall of a cavity counts as one


def save_surface(
    path: str | Path,
    surface: Surface,
    about: str = "",
    space: str = "ras",
    labels: Labels | None = None,
) -> None:
    """Write a binary STL, PLY, VTP or VTK file, by the name's suffix, whole or not at all.

    The header states the coordinates' convention in 3D Slicer's form. All formats except STL, which
    rounds to float32, keep every bit of the points and their order. Replaces an existing file; call
    `tetopt.system.files.check_output` first.

    Parameters
    ----------
    path : str or Path
        Its name ends in .stl, .ply, .vtp or .vtk.
    surface : Surface
        World coordinates in mm, RAS+.
    about : str, optional
        One line of ASCII for the header; STL keeps the first 60 characters, VTP nothing.
    space : {"ras", "lps"}
        Convention of the file's coordinates; with "lps" the signs of x and y are reversed.
    labels : dict of (K,) arrays of integers, optional
        Labels of triangles, by name: face properties in PLY, cell data in VTK's formats.

    Raises
    ------
    InputError
        The suffix is unknown; labels are given for an STL file, which cannot store them, or do not
        fit the triangles.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> is_ball = tetopt.cell_moments(image, mesh).mean > 60.0
    >>> surface = tetopt.extract_surface(mesh.points, mesh.cells, is_ball)
    >>> tetopt.save_surface("ball.ply", surface, about="a ball", space="lps")
    """
    path = Path(path)
    writers = {".stl": _stl, ".ply": _ply, ".vtp": _vtp, ".vtk": _vtk}
    if path.suffix.lower() not in writers:
        raise InputError(f"{path}: expected a name ending in {' or '.join(SURFACE_SUFFIXES)}")
    if labels and path.suffix.lower() not in LABELLED_SUFFIXES:
        raise InputError(
            f"{path}: STL cannot store labels of triangles; use {' or '.join(LABELLED_SUFFIXES)}"
        )
    if odd := [name for name in labels or {} if not SET_NAME.fullmatch(name)]:
        raise InputError(
            f"{path}: expected label names of up to {MOST_LETTERS} letters, digits, _ or -, the "
            f'first a letter, got "{plain(odd[0])}"; rename them'
        )
    surface, labels = _check_arrays(path, surface, labels)
    if space not in SPACES:
        raise InputError(f"space: expected {' or '.join(SPACES)}, got {plain(space)}")
    if space == "lps":
        surface = surface._replace(points=half_turn(surface.points))
    whole = writers[path.suffix.lower()](surface, f"mm {about}", space, labels)
    save_bytes(path, whole)


def _check_arrays(path: Path, surface: Surface, labels: Labels | None) -> tuple[Surface, Labels]:
    """Return the surface and labels as arrays; InputError for triangles or labels that do not
    fit.
    """
    points, triangles = simplex_arrays(f"{path}: surface", surface.points, surface.triangles, 3)
    if points.shape[1] != 3:
        raise InputError(f"{path}: expected points in space, got shape {points.shape}")
    arrays = check_fields(f"{path}: labels", labels, len(triangles))
    range_ = np.iinfo(np.int32)
    for name, values in arrays.items():
        if (
            values.ndim != 1
            or values.dtype.kind not in "iu"
            or values.min() < range_.min
            or values.max() > range_.max
        ):
            raise InputError(
                f"{path}: labels: {name}: expected a 32-bit integer for each of {len(triangles)} "
                "triangles"
            )
    return surface._replace(points=points, triangles=triangles), arrays


def check_surface(path: str | Path) -> SurfaceCheck:
    """Read a surface file, merge nodes in the same place, and check whether it is closed, by
    trimesh.

    trimesh reads STL and PLY, VTK reads the other formats.

    Raises
    ------
    InputError
        The file is missing, has no triangles, or cannot be read.
    """

    if not Path(path).is_file():
        raise InputError(f"{path}: no such surface file")
    try:
        surface = (
            _from_vtk(Path(path))
            if Path(path).suffix.lower() in (".vtp", ".vtk")
            else _from_trimesh(Path(path))
        )
        n_triangles = len(surface.faces)
    except Exception as error:  # trimesh raises any error on damaged files
        raise InputError(
            f"{path}: cannot be read as a surface ({type(error).__name__}); damaged?"
        ) from error
    if n_triangles == 0:
        raise InputError(f"{path}: expected a surface of triangles, found none; is it damaged?")
    return SurfaceCheck(
        bool(surface.is_watertight),
        bool(surface.is_winding_consistent),
        float(surface.volume),
        float(surface.area),
        int(surface.body_count),
    )


def _from_trimesh(path: Path) -> Any:
    """Read the triangles of an STL or PLY file; it is opened here, as trimesh cannot open names
    that are not UTF-8.
    """
    import trimesh

    with path.open("rb") as stream:
        return trimesh.load_mesh(stream, file_type=path.suffix[1:].lower())


def _from_vtk(path: Path) -> Any:
    """Read the triangles of a VTK or VTP file as a trimesh."""
    import pyvista
    import trimesh
    from vtkmodules.vtkIOLegacy import vtkPolyDataReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = (vtkXMLPolyDataReader if path.suffix.lower() == ".vtp" else vtkPolyDataReader)()
    # bytes, for names that are not UTF-8
    reader.SetFileName(os.fsencode(path))  # type: ignore[arg-type]
    reader.Update()
    grid = pyvista.wrap(reader.GetOutput())
    return trimesh.Trimesh(np.asarray(grid.points, dtype=np.float64), grid.regular_faces)


def _ascii_line(about: str) -> str:
    """Convert a text to one line of ASCII."""
    return plain(" ".join(about.split())).encode("ascii", "replace").decode()


def _stl(surface: Surface, about: str, space: str, labels: Labels) -> bytes:
    # A binary file must not begin with "solid", by which some readers recognise text files.
    header = f"tetopt {SPACE_KEY}{space.upper()} {_ascii_line(about)}".encode()[:80].ljust(80)
    triangles = np.zeros(len(surface.triangles), dtype=STL_TRIANGLE)
    corners = surface.points[surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["corners"] = corners
    return header + np.uint32(len(triangles)).astype("<u4").tobytes() + triangles.tobytes()


def _ply(surface: Surface, about: str, space: str, labels: Labels) -> bytes:
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {SPACE_KEY}{space.upper()}",
        f"comment tetopt; {_ascii_line(about)}",
        f"element vertex {len(surface.points)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(surface.triangles)}",
        "property list uchar int vertex_indices",
        *(f"property int {name}" for name in labels),
        "end_header\n",
    ]
    faces = np.empty(
        len(surface.triangles), dtype=[*PLY_FACE.descr, *((name, "<i4") for name in labels)]
    )
    faces["count"], faces["nodes"] = 3, surface.triangles
    for name, values in labels.items():
        faces[name] = values
    return "\n".join(header).encode() + surface.points.astype("<f8").tobytes() + faces.tobytes()


def _vtp(surface: Surface, about: str, space: str, labels: Labels) -> bytes:
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    grid = _grid(surface, labels)
    grid.field_data[SPACE_KEY.rstrip("=")] = [space.upper()]
    return xml_bytes(vtkXMLPolyDataWriter(), grid)


def _vtk(surface: Surface, about: str, space: str, labels: Labels) -> bytes:
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter

    writer = vtkPolyDataWriter()
    # a line of 256 characters
    writer.SetHeader(f"tetopt, {SPACE_KEY}{space.upper()} {_ascii_line(about)}"[:250])
    writer.SetFileVersion(LEGACY_VERSION)
    writer.SetFileTypeToBinary()
    return written_bytes(writer, _grid(surface, labels))


def _grid(surface: Surface, labels: Labels) -> pyvista.PolyData:
    import pyvista  # slow to import, and only needed here

    grid = pyvista.PolyData.from_regular_faces(surface.points, surface.triangles)
    for name, values in labels.items():
        grid.cell_data[name] = np.asarray(values, dtype=np.int32)
    return grid
