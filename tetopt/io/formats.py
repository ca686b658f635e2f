"""The formats of model files, by suffix."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tetopt.errors import InputError, warn
from tetopt.interop.conversions import check_fields
from tetopt.io.abaqus import abaqus
from tetopt.io.febio import febio
from tetopt.io.gmsh import gmsh22, gmsh41
from tetopt.io.medit import medit
from tetopt.io.mfem import mfem
from tetopt.io.surfaces import SURFACE_SUFFIXES
from tetopt.io.text import file_name, legacy_name, names_apart, plain, short_name
from tetopt.io.vtk import VTK_SUFFIXES, vtk, vtu
from tetopt.io.xdmf import xdmf
from tetopt.mesh import Mesh
from tetopt.model.fields import node_field
from tetopt.model.file import MASK_TEXT, PLACE_TEXT, place_words
from tetopt.model.loads import known_set
from tetopt.model.materials import Materials
from tetopt.model.model import Model, in_space, in_units, locking_words
from tetopt.model.sets import MOST_LETTERS, SET_NAME, Sets, is_set
from tetopt.system.arrays import Arrays, Ints, Json, Shape
from tetopt.system.files import save_bytes


class Format(NamedTuple):
    """The format of a suffix."""

    what: str
    write: Callable[[Model], bytes | str]
    has_quadratic: bool = True
    # whether loads become a step that the solver runs; otherwise they are only text in the file
    runs: bool = False

    # otherwise a modulus that varies within cells is averaged over each
    has_node_moduli: bool = False
    has_large: bool = False  # whether a step can request large deformation
    has_fibres: bool = True  # otherwise materials with fibres are refused
    # those of `FIELDS` that commands write by default, "" if the format has no place for them
    fields: str = "all"


FORMATS = {
    ".vtu": Format("VTK, ParaView", vtu, has_node_moduli=True),
    ".vtk": Format("legacy VTK, 3D Slicer", vtk, has_node_moduli=True),
    ".xdmf": Format("XDMF with tags, FEniCSx", xdmf, has_node_moduli=True),
    ".msh": Format("gmsh 4.1", gmsh41, fields="none"),
    ".msh2": Format("gmsh 2.2", gmsh22, has_fibres=False, fields=""),
    ".inp": Format(
        "Abaqus, CalculiX", abaqus, runs=True, has_node_moduli=True, has_large=True, fields=""
    ),
    ".feb": Format("FEBio 4.0", febio, runs=True, has_large=True, fields=""),
    ".mfem": Format("MFEM mesh", mfem, has_fibres=False, fields=""),
    ".mesh": Format("medit", medit, has_fibres=False, fields=""),
}
FIELDS = ("none", "mean", "all")  # of cells, besides labels and results
# formats of 64-bit integers; others convert large ones to float64
EXACT_INTEGERS = (".vtu", ".xdmf")
MOST_OF_FLOATS = 2**53  # float64 holds all integers up to this one
FINITE_FORMATS = (".feb", ".xdmf")  # whose readers take no NaN
# How formats whose readers limit names of data to `MOST_NAME_CHARACTERS` show them.
SHOWN_NAMES = {".vtk": legacy_name, ".msh": short_name, ".feb": short_name}


BUILT_IN = tuple(FORMATS)


def register_format(
    suffix: str,
    write: Callable[[Model], bytes | str],
    what: str = "another format",
    *,
    has_quadratic: bool = False,
    runs: bool = False,
    has_node_moduli: bool = False,
    has_large: bool = False,
    has_fibres: bool = False,
) -> None:
    """Register a format for `save_model`, `run` and the command, in this process.

    Parameters
    ----------
    suffix : str
        Suffix of its files, such as ".scn"; case is ignored.
    write : callable
        Converts a `Model`, in the units and axes of the file, to its content; text is encoded as
        UTF-8.
    what : str
        Name of the format, for messages.
    has_quadratic : bool
        True if it supports models of order 2; otherwise they are rejected, or written with linear
        cells.
    runs : bool
        True if loads become a step that the solver runs; otherwise the command notes that they are
        only text.
    has_node_moduli : bool
        True if it supports moduli that vary within cells; otherwise the command notes that cells
        have their mean.
    has_large : bool
        True if a step can request large deformation.
    has_fibres : bool
        True if it supports transversely isotropic materials; otherwise they are rejected.

    Raises
    ------
    InputError
        The suffix has an invalid form, or belongs to a built-in format.

    See Also
    --------
    save_model : Write a model in the format of its file's suffix.

    Examples
    --------
    >>> def xyz(model):
    ...     return "\\n".join(map(str, model.mesh.points.tolist()))
    >>> tetopt.register_format(".xyz", xyz, "points")
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> tetopt.save_mesh("ball.xyz", tetopt.lattice_mesh(image, nodes=300))
    """
    suffix = suffix.lower()
    if not re.fullmatch(r"\.[a-z0-9_]+", suffix):
        raise InputError(
            f'suffix: expected a dot, then letters and digits, such as .scn, got "{plain(suffix)}"'
        )
    if suffix in BUILT_IN:
        raise InputError(
            f"suffix: {suffix} is a built-in format ({FORMATS[suffix].what}); choose another suffix"
        )
    FORMATS[suffix] = Format(
        what, write, has_quadratic, runs, has_node_moduli, has_large, has_fibres
    )


def format_of(path: Path) -> Format:
    """Return the format of a file's suffix.

    Raises
    ------
    InputError
        The suffix is unknown; the message lists the known ones.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        known = ", ".join(f"{name} ({kind.what})" for name, kind in FORMATS.items())
        what = f"{path}: unknown suffix; known suffixes are {known}"
        if suffix in SURFACE_SUFFIXES:
            what = f"{path}: no mesh's file, but a surface's; tetopt surface --boundary writes it"
        raise InputError(what)
    return FORMATS[suffix]


def save_model(path: str | Path, model: Model, *, space: str = "ras", units: str = "kPa") -> None:
    """Write a model in the format of the file's suffix, whole or not at all.

    The file is read back and compared before it takes its name.

    Names of data and of the image are written as `tetopt.io.text.plain` shows them, escaped in XML;
    gmsh files have apostrophes instead of their quotes, and gmsh, legacy VTK and FEBio files only
    their first 240 characters. Names that become equal are numbered, and a warning lists the
    changes. Replaces an existing file; call `tetopt.system.files.check_output` first.

    Parameters
    ----------
    path : str or Path
        Its suffix decides the format, see `tetopt.io.formats.FORMATS`.
    model : Model
        The result of `build_model`.
    space : {"ras", "lps"}
        Convention of the file's coordinates; NIfTI's is RAS+, DICOM's, ITK's and 3D Slicer's files'
        LPS+.
    units : {"kPa", "MPa", "Pa"}
        Unit of stress in the file: with mm and mN, mm and N, or m and N.

    Raises
    ------
    InputError
        The suffix is unknown; the format does not support the model; names of sets are not
        supported by all formats; data, sets or materials do not fit the mesh. Nothing is written
        then.
    OSError
        For the reasons of `tetopt.system.files.save_bytes`.

    Warns
    -----
    UserWarning
        Data are renamed in the file; a solver's file has linear cells with a Poisson's ratio of
        0.45 or more.

    See Also
    --------
    build_model : Build a model.

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
    save_bytes(path, file_bytes(path, model, space=space, units=units))
    if path.suffix.lower() not in VTK_SUFFIXES and (words := locking_words(model)):
        warn(f"{path}: {words}")


def save_mesh(
    path: str | Path,
    mesh: Mesh,
    cell_data: Arrays | None = None,
    about: Json | None = None,
    point_data: Arrays | None = None,
    order: int = 1,
) -> None:
    """Write a mesh and its data in the format of the file's suffix, whole or not at all.

    Points are in world coordinates, mm (RAS+); cells are positively oriented and of order 1 or 2.
    In VTK's formats each entry of `about` becomes a string in the field data, as JSON unless it is
    one already. `save_model` also writes sets, materials and loads. Replaces an existing file; call
    `tetopt.system.files.check_output` first.

    Parameters
    ----------
    path : str or Path
        Its suffix decides the format, see `tetopt.io.formats.FORMATS`.
    mesh : Mesh
        Points in world coordinates, mm.
    cell_data : dict of arrays of numbers, optional
        By name, one row per cell; rows of more than one axis are flattened.
    about : dict, optional
        Strings for the file's header, by name.
    point_data : dict of arrays of numbers, optional
        By name, one row per mesh point, or per node of order 2.
    order : {1, 2}
        2: quadratic cells, with straight edges unless the mesh has midpoints.

    Raises
    ------
    InputError
        For the reasons of `save_model`.

    See Also
    --------
    load_mesh : Read a mesh.
    save_model : Also write sets, materials and loads.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> tetopt.save_mesh("ball.vtu", mesh, tetopt.cell_fields(mesh, image))
    >>> sorted(tetopt.load_mesh("ball.vtu").cell_data)
    ['max', 'mean', 'min', 'min_dihedral', 'n_voxels', 'rho', 'variance', 'volume']
    """
    save_model(
        path,
        Model(
            mesh,
            cell_data or {},
            Sets({}, {}),
            order=order,
            about=about or {},
            point_data=point_data or {},
        ),
    )


def file_bytes(path: Path, model: Model, *, space: str = "ras", units: str = "kPa") -> bytes:
    """Return the bytes that `save_model` writes.

    Raises
    ------
    InputError
        For the reasons of `save_model`.
    """
    kind = format_of(path)
    if model.order not in (1, 2):
        raise InputError(f"order: expected 1 or 2, got {model.order}")
    if model.order == 2 and not kind.has_quadratic:
        able = ", ".join(name for name, other in FORMATS.items() if other.has_quadratic)
        raise InputError(f"{path}: only {able} support quadratic cells; omit `order` 2")
    if not kind.has_fibres and model.materials is not None and model.materials.along is not None:
        able = ", ".join(name for name, other in FORMATS.items() if other.has_fibres)
        raise InputError(f"{path}: only {able} support fibres; omit `fibre`")
    checked = _check_model(path, model)
    if PLACE_TEXT not in checked.about and not {MASK_TEXT, "options"}.isdisjoint(checked.about):
        of_place = {PLACE_TEXT: place_words(checked.mesh)}
        checked = checked._replace(about={**checked.about, **of_place})
    ready = in_units(in_space(checked, space), units)
    whole = kind.write(_rename_data(path, ready))
    return whole.encode() if isinstance(whole, str) else whole


def _check_model(path: Path, model: Model) -> Model:
    """Return the model with arrays of numbers for all data; InputError for data that do not fit the
    mesh or format.

    Models are records that anyone can build, and no writer checks them.
    """
    mesh = model.mesh
    n_cells = len(model.mesh.cells)
    cell_data = check_fields(f"{path}: cell_data", model.cell_data, n_cells)
    point_data = {
        name: node_field(values, mesh, model.order)
        for name, values in check_fields(f"{path}: point_data", model.point_data).items()
    }
    for name, values in (cell_data | point_data).items():
        most = np.iinfo(np.int64).max if path.suffix.lower() in EXACT_INTEGERS else MOST_OF_FLOATS
        if values.dtype.kind in "iu" and (values.max() > most or values.min() < -most):
            raise InputError(
                f"{path}: expected integers up to {most} in {plain(name)!r}, got {values.max()}; "
                "use .vtu"
            )
        if path.suffix.lower() in FINITE_FORMATS and not np.isfinite(values).all():
            raise InputError(
                f"{path}: expected finite numbers in {plain(name)!r}; remove this field, or use "
                ".vtu"
            )
    try:
        json.dumps(dict(model.about))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: about: expected strings, or values in JSON's types, by name ({error})"
        ) from error
    facets = _check_sets(
        path, model.sets.facets, (n_cells, mesh.ndim + 1), "facets as rows (cell, opposite node)"
    )
    cells = _check_sets(path, model.sets.cells, (n_cells,), "cells by number")
    for load in model.loads:
        if load.set_name:
            known_set(load.set_name, model.sets)
    if model.materials is not None:
        _check_materials(path, model.materials, n_cells)
    for moduli, n_rows in ((model.node_young, len(mesh.points)), (model.gauss_young, n_cells)):
        if moduli is not None and (
            len(moduli) != n_rows or not (np.isfinite(moduli) & (moduli > 0.0)).all()
        ):
            raise InputError(
                f"{path}: expected {n_rows} rows of moduli above 0 that vary within cells"
            )
    return model._replace(cell_data=cell_data, point_data=point_data, sets=Sets(facets, cells))


def _check_sets(
    path: Path, sets: Mapping[str, ArrayLike], ends: Shape, what: str
) -> dict[str, Ints]:
    """Return the sets as arrays; InputError unless each has ascending rows of integers from 0 to
    below `ends`.
    """
    arrays = {}
    for name, rows in sets.items():
        values = np.asarray(rows)
        if (
            values.ndim != len(ends)
            or values.shape[1:] not in ((), (2,))
            or not len(values)
            or not is_set(values, ends)
        ):
            raise InputError(
                f"{path}: set {plain(str(name))!r}: expected {what}, distinct integers from 0 to "
                f"{ends[0] - 1} in ascending order, got {values.dtype} of shape {values.shape}"
            )
        arrays[name] = values.astype(np.int64)
    return arrays


def _check_materials(path: Path, table: Materials, n_cells: int) -> None:
    """Raise InputError unless each cell has one of the materials, whose numbers are finite."""
    of_cell = np.asarray(table.of_cell)
    n_kinds = len(table.young)
    is_index = of_cell.dtype.kind in "iu" and of_cell.shape == (n_cells,)
    if not is_index or of_cell.min() < 0 or of_cell.max() >= n_kinds:
        raise InputError(
            f"{path}: materials: expected a number from 0 to {n_kinds - 1} for each of {n_cells} "
            "cells"
        )
    named = {name: getattr(table, name) for name in ("young", "nu", "density")}
    along = {} if table.along is None else table.along._asdict()
    if np.shape(along.pop("fibre", np.empty((n_cells, 3)))) != (n_cells, 3):
        raise InputError(f"{path}: materials: expected a direction of fibres for each cell")
    for name, values in (named | along).items():
        if values is not None and (np.shape(values) != (n_kinds,) or not np.isfinite(values).all()):
            raise InputError(
                f"{path}: materials: expected a finite {name} for each of {n_kinds} materials"
            )


def _rename_data(path: Path, model: Model) -> Model:
    """Rename data as the format requires; a warning lists the changed names.

    Raises
    ------
    InputError
        Names of sets are not supported by all formats, or differ only by case.
    """
    sets = [*model.sets.facets, *model.sets.cells]
    if odd := [name for name in sets if not SET_NAME.fullmatch(name)]:
        words = f"letters, digits, _ or -, the first a letter, got {plain(odd[0])!r}"
        raise InputError(f"{path}: expected set names of up to {MOST_LETTERS} {words}")
    counts = Counter(map(str.lower, sets))
    if twice := [name for name in sets if counts[name.lower()] > 1]:
        raise InputError(f"{path}: two sets have the name {twice[1]}; rename one of them")
    shown = SHOWN_NAMES.get(path.suffix.lower(), file_name)
    changed = list[str]()
    renamed = dict[str, Any]()
    for part in ("cell_data", "point_data", "about"):
        data = getattr(model, part)
        names = names_apart(data, shown)
        changed += [new for old, new in names.items() if old != new]
        renamed[part] = {names[name]: values for name, values in data.items()}
    if changed:
        warn(f"{path}: renamed data whose names the format does not support: {', '.join(changed)}")
    return model._replace(**renamed)
