"""Every format that a model can be written in, by the suffix of the file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from tetopt.errors import InputError, warn
from tetopt.io.abaqus import abaqus
from tetopt.io.febio import febio
from tetopt.io.gmsh import gmsh22, gmsh41
from tetopt.io.medit import medit
from tetopt.io.mfem import mfem
from tetopt.io.readback import save_checked
from tetopt.io.surfaces import boundary_ply, boundary_stl
from tetopt.io.text import file_name, legacy_name, names_apart, plain, short_name
from tetopt.io.vtk import VTK_SUFFIXES, vtk, vtu
from tetopt.io.vtkhdf import hdf_name, vtkhdf
from tetopt.io.xdmf import xdmf
from tetopt.mesh import Mesh
from tetopt.model.model import Model, in_space, in_units, locking_words
from tetopt.model.sets import MOST_LETTERS, SET_NAME, Sets


class Format(NamedTuple):
    """What a suffix stands for."""

    what: str
    write: Callable[[Model], bytes | str]
    has_quadratic: bool = False
    runs: bool = False  # whether loads become a step that the solver runs; else they are words in the file
    is_surface: bool = False  # holds the boundary alone
    has_node_moduli: bool = False  # else a modulus that varies within cells is its mean over each
    has_large: bool = False  # whether a step can ask for large deformation


FORMATS = {
    ".vtu": Format("VTK, ParaView", vtu, has_quadratic=True, has_node_moduli=True),
    ".vtk": Format("legacy VTK, 3D Slicer", vtk, has_quadratic=True, has_node_moduli=True),
    ".vtkhdf": Format("VTKHDF, ParaView", vtkhdf, has_quadratic=True, has_node_moduli=True),
    ".xdmf": Format("XDMF with tags, FEniCSx", xdmf, has_quadratic=True, has_node_moduli=True),
    ".msh": Format("gmsh 4.1", gmsh41, has_quadratic=True),
    ".msh2": Format("gmsh 2.2", gmsh22, has_quadratic=True),
    ".inp": Format("Abaqus, CalculiX", abaqus, has_quadratic=True, runs=True, has_node_moduli=True, has_large=True),
    ".feb": Format("FEBio 4.0", febio, has_quadratic=True, runs=True, has_large=True),
    ".mfem": Format("MFEM mesh", mfem, has_quadratic=True),
    ".mesh": Format("medit", medit, has_quadratic=True),
    ".stl": Format("the boundary as STL", boundary_stl, is_surface=True),
    ".ply": Format("the boundary as PLY", boundary_ply, is_surface=True),
}
# How formats whose readers take names of data of `MOST_NAME_CHARACTERS` show them.
SHOWN_NAMES = {".vtk": legacy_name, ".vtkhdf": hdf_name, ".msh": short_name, ".feb": short_name}


BUILT_IN = tuple(FORMATS)


def register_format(
    suffix: str, write: Callable[[Model], bytes | str], what: str = "another format", *, has_quadratic: bool = False,
    runs: bool = False, has_node_moduli: bool = False, has_large: bool = False,
) -> None:  # fmt: skip
    """Add a format that models are written in, for this process: by `save_model`, `run` and the command alike.

    Parameters
    ----------
    suffix : str
        Of its files, such as ".scn"; lower and upper case are the same.
    write : callable
        From a `Model` in the units and axes of the file to what is in it; text is encoded as UTF-8.
    what : str
        What the format is, for messages.
    has_quadratic : bool
        Whether it takes models of order 2; else they are refused, or written with linear cells.
    runs : bool
        Whether loads become a step that the solver runs; else the command says that they are words.
    has_node_moduli : bool
        Whether it takes moduli that vary within cells; else the command says that each cell has their mean.
    has_large : bool
        Whether a step can ask for large deformation.

    Raises
    ------
    InputError
        A suffix of another form, or of a format that tetopt has.

    See Also
    --------
    save_model : Writes a model in the format of its file's suffix.

    Examples
    --------
    >>> tetopt.register_format(".xyz", lambda model: "\\n".join(map(str, model.mesh.points.tolist())), "points")
    >>> tetopt.save_mesh("ball.xyz", tetopt.lattice_mesh(tetopt.load_phantom("sphere").image(voxel_mm=4), nodes=300))
    """
    suffix = suffix.lower()
    if not re.fullmatch(r"\.[a-z0-9_]+", suffix):
        raise InputError(f'suffix: expected a dot, then letters and digits, such as .scn, got "{plain(suffix)}"')
    if suffix in BUILT_IN:
        raise InputError(f"suffix: tetopt writes {suffix} itself ({FORMATS[suffix].what}); take another")
    FORMATS[suffix] = Format(what, write, has_quadratic, runs, False, has_node_moduli, has_large)


def format_of(path: Path) -> Format:
    """The format that a file's suffix asks for.

    Raises
    ------
    InputError
        An unknown suffix, with the known ones.
    """
    suffix = path.suffix.lower()
    if suffix == ".pvtu":
        raise InputError(f"{path}: .pvtu is not written; use .vtkhdf, one file of any size that ParaView reads")
    if suffix not in FORMATS:
        known = ", ".join(f"{name} ({kind.what})" for name, kind in FORMATS.items())
        raise InputError(f"{path}: unknown suffix; known are {known}")
    return FORMATS[suffix]


def save_model(path: str | Path, model: Model, *, space: str = "ras", units: str = "kPa") -> None:
    """Write a model in the format of the file's suffix, whole or not at all.

    What was written is compared with what reads back before the file takes its name.

    Names of data, and that of the image, stand in the file as `tetopt.io.text.plain` shows them, escaped in XML; gmsh
    has apostrophes for their quotes, and gmsh, legacy VTK, VTKHDF and FEBio their first 240 characters. Those that
    become the same are numbered, and a warning tells what changed. Replaces an
    existing file; ask `tetopt.system.files.checked_output` first.

    Parameters
    ----------
    path : str or Path
        Its suffix decides the format, see `tetopt.io.formats.FORMATS`.
    model : Model
        As `build_model` makes it.
    space : {"ras", "lps"}
        Convention of the file's coordinates; NIfTI's is RAS+, DICOM's, ITK's and 3D Slicer's files' LPS+.
    units : {"kPa", "MPa"}
        Unit of stress in the file; with mm, forces are then in mN or N.

    Raises
    ------
    InputError
        An unknown suffix, or what the format cannot carry; sets with names that some format cannot carry.
    OSError
        As `tetopt.io.readback.save_checked`.

    Warns
    -----
    UserWarning
        Data that have other names in the file; linear cells of a Poisson's ratio of 0.45 or more in a solver's file.

    See Also
    --------
    build_model : Makes a model.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> for name in ("ball.inp", "ball.feb", "ball.vtu"):  # CalculiX and Abaqus, FEBio, ParaView
    ...     tetopt.save_model(name, model)
    """
    path = Path(path)
    save_checked(path, file_bytes(path, model, space=space, units=units))
    is_for_solver = not format_of(path).is_surface and path.suffix.lower() not in VTK_SUFFIXES
    if is_for_solver and (words := locking_words(model)):
        warn(f"{path}: {words}")


def save_mesh(
    path: str | Path,
    mesh: Mesh,
    cell_data: dict[str, NDArray] | None = None,
    about: dict[str, Any] | None = None,
    point_data: dict[str, NDArray] | None = None,
    order: int = 1,
) -> None:
    """Write a mesh and its data in the format of the file's suffix (`FORMATS`), whole or not at all.

    Points in world mm (RAS+), cells positively oriented, of order 1 or 2, `cell_data` and `point_data` by name, the
    latter with a row for each mesh point or for each node of order 2; in VTK's formats each entry of `about` becomes a
    field-data text, as JSON unless it is a string already. `save_model` writes sets, materials and loads, too. Replaces
    an existing file; ask `tetopt.system.files.checked_output` first.

    Parameters
    ----------
    path : str or Path
        Its suffix decides the format, see `tetopt.io.formats.FORMATS`.
    mesh : Mesh
        Points in world mm.
    cell_data : dict of arrays, optional
        By name, one row a cell.
    about : dict, optional
        Texts for the file's head, by name.
    point_data : dict of arrays, optional
        By name, a row for each mesh point, or each node of order 2.
    order : {1, 2}
        2: quadratic cells, of straight edges unless the mesh has midpoints.

    Raises
    ------
    InputError
        As `save_model`.

    See Also
    --------
    load_mesh : Reads one.
    save_model : Writes sets, materials and loads, too.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> tetopt.save_mesh("ball.vtu", mesh, tetopt.cell_fields(mesh, image))
    >>> sorted(tetopt.load_mesh("ball.vtu").cell_data)
    ['max', 'mean', 'min', 'min_dihedral', 'n_voxels', 'rho', 'variance', 'volume']
    """
    save_model(
        path, Model(mesh, cell_data or {}, Sets({}, {}), order=order, about=about or {}, point_data=point_data or {})
    )


def file_bytes(path: Path, model: Model, *, space: str = "ras", units: str = "kPa") -> bytes:
    """What `save_model` writes.

    Raises
    ------
    InputError
        As `save_model`.
    """
    whole = format_of(path).write(_ready(path, model, space, units))
    return whole.encode() if isinstance(whole, str) else whole


def _ready(path: Path, model: Model, space: str, units: str) -> Model:
    """The model as it is to be written; InputError for what the format cannot carry."""
    kind = format_of(path)
    if model.order not in (1, 2):
        raise InputError(f"order: expected 1 or 2, got {model.order}")
    if model.order == 2 and not kind.has_quadratic:
        able = ", ".join(name for name, other in FORMATS.items() if other.has_quadratic)
        raise InputError(f"{path}: only {able} take quadratic cells; leave out `order` 2")
    return _named(path, in_units(in_space(model, space), units))


def _named(path: Path, model: Model) -> Model:
    """The model, its data called as the format can hold it, which a warning tells where it changes a name.

    Raises
    ------
    InputError
        Sets with names that not every format can carry, or that differ by case alone.
    """
    sets = [*model.sets.facets, *model.sets.cells]
    if odd := [name for name in sets if not SET_NAME.fullmatch(name)]:
        words = f"letters, digits, _ and -, got {plain(odd[0])!r}"
        raise InputError(f"{path}: the name of a set is a letter, then up to {MOST_LETTERS - 1} {words}")
    if len({name.lower() for name in sets}) < len(sets):
        twice = next(name for k, name in enumerate(sets) if name.lower() in {each.lower() for each in sets[:k]})
        raise InputError(f"{path}: two sets are called {twice}; call one of them otherwise")
    shown = SHOWN_NAMES.get(path.suffix.lower(), file_name)
    names = [names_apart(data, shown) for data in (model.cell_data, model.point_data, model.about)]
    if changed := [new for each in names for old, new in each.items() if old != new]:
        warn(f"{path}: data with names that it cannot hold are called {', '.join(changed)}")
    cell_data, point_data, about = (
        {new[name]: values for name, values in data.items()}
        for new, data in zip(names, (model.cell_data, model.point_data, model.about), strict=True)
    )
    return model._replace(cell_data=cell_data, point_data=point_data, about=about)
