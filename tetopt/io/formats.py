"""Every format that a model can be written in, by the suffix of the file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError
from tetopt.io.abaqus import abaqus
from tetopt.io.febio import febio
from tetopt.io.files import save_bytes
from tetopt.io.gmsh import gmsh22, gmsh41
from tetopt.io.medit import medit
from tetopt.io.mfem import mfem
from tetopt.io.sofa import sofa
from tetopt.io.surfaces import boundary_ply, boundary_stl
from tetopt.io.vtk import vtk, vtu
from tetopt.io.xdmf import xdmf
from tetopt.model.model import Model, in_space, in_units


class Format(NamedTuple):
    """What a suffix stands for."""

    what: str
    write: Callable[[Model], bytes]
    has_quadratic: bool = False
    runs: bool = False  # whether loads become a step that the solver runs; else they are words in the file
    is_surface: bool = False  # holds the boundary alone
    has_node_moduli: bool = False  # else a modulus that varies within cells is its mean over each
    has_large: bool = False  # whether a step can ask for large deformation


FORMATS = {
    ".vtu": Format("VTK, ParaView", vtu, has_quadratic=True, has_node_moduli=True),
    ".vtk": Format("legacy VTK, 3D Slicer", vtk, has_quadratic=True, has_node_moduli=True),
    ".xdmf": Format("XDMF with tags, FEniCSx", xdmf, has_quadratic=True, has_node_moduli=True),
    ".msh": Format("gmsh 4.1", gmsh41, has_quadratic=True),
    ".msh2": Format("gmsh 2.2", gmsh22, has_quadratic=True),
    ".inp": Format("Abaqus, CalculiX", abaqus, has_quadratic=True, runs=True, has_node_moduli=True, has_large=True),
    ".feb": Format("FEBio 4.0", febio, has_quadratic=True, runs=True, has_large=True),
    ".scn": Format("SOFA scene", sofa, runs=True),
    ".mfem": Format("MFEM mesh", mfem, has_quadratic=True),
    ".mesh": Format("medit", medit, has_quadratic=True),
    ".stl": Format("the boundary as STL", boundary_stl, is_surface=True),
    ".ply": Format("the boundary as PLY", boundary_ply, is_surface=True),
}


def format_of(path: Path) -> Format:
    """The format that a file's suffix asks for.

    Raises
    ------
    InputError
        An unknown suffix, with the known ones.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        known = ", ".join(f"{name} ({kind.what})" for name, kind in FORMATS.items())
        raise InputError(f"{path}: unknown suffix; known are {known}")
    return FORMATS[suffix]


def save_model(path: str | Path, model: Model, *, space: str = "ras", units: str = "kPa") -> None:
    """Write a model in the format of the file's suffix, whole or not at all.

    Replaces an existing file; ask `tetopt.io.files.checked_output` first.

    Parameters
    ----------
    path : str or Path
        See `FORMATS`.
    model : Model
    space : {"ras", "lps"}
        Convention of the file's coordinates; NIfTI's is RAS+, DICOM's, ITK's and 3D Slicer's files' LPS+.
    units : {"kPa", "MPa"}
        Unit of stress in the file; with mm, forces are then in mN or N.

    Raises
    ------
    InputError
        An unknown suffix, or what the format cannot carry.
    """
    path = Path(path)
    save_bytes(path, file_bytes(path, model, space=space, units=units))


def file_bytes(path: Path, model: Model, *, space: str = "ras", units: str = "kPa") -> bytes:
    """What `save_model` writes.

    Raises
    ------
    InputError
        As `save_model`.
    """
    kind = format_of(path)
    if model.order != 1 and not kind.has_quadratic:
        able = ", ".join(name for name, other in FORMATS.items() if other.has_quadratic)
        raise InputError(f"{path}: only {able} take quadratic cells; leave out --order 2")
    return kind.write(in_units(in_space(model, space), units))
