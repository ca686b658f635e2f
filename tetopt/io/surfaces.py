"""Triangle surfaces as STL and PLY files."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.surface import Surface, surface_of
from tetopt.io.files import written_whole
from tetopt.model.model import Model, half_turn

SURFACE_SUFFIXES = (".stl", ".ply")

# 3D Slicer looks for this in an STL file's header and in each comment of a PLY file, and takes points for LPS, x and y
# negated, where it finds nothing: Slicer/Slicer, Libs/MRML/Core/vtkMRMLModelStorageNode.cxx,
# GetCoordinateSystemFromFileHeader; https://discourse.slicer.org/t/10446.
SPACE_KEY = "SPACE="

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
PLY_FACE = np.dtype([("count", "u1"), ("nodes", "<i4", 3)])


class SurfaceCheck(NamedTuple):
    """What trimesh finds in a surface file."""

    is_watertight: bool  # each edge in exactly two triangles
    is_winding_consistent: bool  # which run along it in opposite ways
    volume: float  # mm^3, positive where normals point out
    area: float  # mm^2
    n_pieces: int  # closed surfaces that are not connected; a cavity's wall counts as one


def save_surface(path: str | Path, surface: Surface, about: str = "", space: str = "ras") -> None:
    """Write a binary STL or PLY file, by the name's suffix, whole or not at all.

    World coordinates in mm; with `space` "lps", x and y change sign. The header says which in the words that 3D
    Slicer looks for; then `about`, in one line of ASCII, of which STL keeps the first 60 characters. PLY holds every
    bit of the points and their order; STL rounds to float32. Replaces an existing file; ask
    `tetopt.io.files.checked_output` first.

    Raises
    ------
    InputError
        Another suffix.
    """
    path = Path(path)
    writers = {".stl": _stl, ".ply": _ply}
    if path.suffix.lower() not in writers:
        raise InputError(f"{path}: expected a surface named {' or '.join(SURFACE_SUFFIXES)}")
    if space == "lps":
        surface = surface._replace(points=half_turn(surface.points))
    whole = writers[path.suffix.lower()](surface, about, space)
    with written_whole(path) as temporary:
        temporary.write_bytes(whole)


def boundary_stl(model: Model) -> bytes:
    """The model's boundary, watertight, as the bytes of an STL file; nothing else of the model is in it."""
    return _stl(*_boundary(model))


def boundary_ply(model: Model) -> bytes:
    """The model's boundary, watertight, as the bytes of a PLY file; nothing else of the model is in it."""
    return _ply(*_boundary(model))


def _boundary(model: Model) -> tuple[Surface, str, str]:
    """The surface, what its file says of it, and the space of its points."""
    if model.mesh.ndim != 3:
        raise InputError("surface: expected tetrahedra, whose boundary is a surface, got triangles")
    surface = surface_of(model.mesh.points, model.mesh.cells, np.arange(len(model.mesh.cells)))
    return surface, str(model.about.get("image", "")), model.space


def checked_surface(path: str | Path) -> SurfaceCheck:
    """Read a surface file with trimesh, which welds nodes of the same place, and look whether it is closed.

    Raises
    ------
    InputError
        A missing file, or one that holds no triangles or cannot be read.
    """
    import trimesh  # takes most of a second

    if not Path(path).is_file():
        raise InputError(f"{path}: no such surface file")
    try:
        surface = trimesh.load_mesh(path)
        n_triangles = len(surface.faces)
    except Exception as error:  # trimesh raises whatever it pleases on damaged files
        raise InputError(f"{path}: cannot be read as a surface ({type(error).__name__}); damaged?") from error
    if n_triangles == 0:
        raise InputError(f"{path}: expected a surface of triangles, found none; damaged?")
    return SurfaceCheck(
        bool(surface.is_watertight),
        bool(surface.is_winding_consistent),
        float(surface.volume),
        float(surface.area),
        int(surface.body_count),
    )


def _plain(about: str) -> str:
    """One line of ASCII."""
    return " ".join(about.encode("ascii", "replace").decode().split())


def _stl(surface: Surface, about: str, space: str) -> bytes:
    # A binary file must not begin with "solid", by which some readers know a file of text.
    header = f"tetopt {SPACE_KEY}{space.upper()} mm {_plain(about)}".encode()[:80].ljust(80)
    triangles = np.zeros(len(surface.triangles), dtype=STL_TRIANGLE)
    corners = surface.points[surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["corners"] = corners
    return header + np.uint32(len(triangles)).astype("<u4").tobytes() + triangles.tobytes()


def _ply(surface: Surface, about: str, space: str) -> bytes:
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {SPACE_KEY}{space.upper()}",
        f"comment tetopt; mm; {_plain(about)}".rstrip("; "),
        f"element vertex {len(surface.points)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(surface.triangles)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    faces = np.empty(len(surface.triangles), dtype=PLY_FACE)
    faces["count"], faces["nodes"] = 3, surface.triangles
    return "\n".join(header).encode() + surface.points.astype("<f8").tobytes() + faces.tobytes()
