"""From a mesh to a solver's file: code shared by runs, conversions and simulations."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast, get_args

import numpy as np

import tetopt
from tetopt.contents.content import Content
from tetopt.engine.loop import MeshingResult
from tetopt.errors import InputError, error_words
from tetopt.fields.field import Field
from tetopt.image import Image
from tetopt.io.formats import FIELDS, FORMATS, file_bytes, format_of, save_mesh, save_model
from tetopt.io.vtk import VTK_SUFFIXES
from tetopt.job.events import note, warning, warnings_heard
from tetopt.job.field_files import read_fields, scalar_names
from tetopt.job.mesh_file import check_mesh_place, label_table
from tetopt.job.options import ModelOptions, SolverOptions
from tetopt.mesh import Mesh
from tetopt.model.averages import DEFAULT_AVERAGE, parse_average
from tetopt.model.build import Choices, model_of_file
from tetopt.model.fields import cell_fields, is_result
from tetopt.model.file import MeshFile
from tetopt.model.label_names import LABEL_FIELD, TABLE_TEXT
from tetopt.model.loads import FACET_FORCES, check_steps, known_set, parse_load
from tetopt.model.mappings import MAPPED_OPTIONS, named_file, parse_any_mapping
from tetopt.model.materials import Spacing
from tetopt.model.model import SPACES, STRESS_UNITS, Model, odd_units
from tetopt.model.sets import (
    BOUNDARY_SET,
    INTERFACE_PREFIX,
    Box,
    SetRequest,
    Sets,
    check_free_names,
    interface_names,
    label_set_names,
    parse_set,
    places_in,
    standard_names,
)
from tetopt.system.arrays import Ints, Json
from tetopt.system.files import kept_places, output_place

MEAN_FIELD = r"mean(_\d+)?"  # of the image, and of further contrasts
SET_GROUPS = ("labels", "interfaces", "boundary")  # groups of the sets that every mesh has
# Each adds an array on the nodes of a VTU or VTK file; sets of labels can be rebuilt from the
# cells.
MANY_INTERFACES = 24
# of the mesh's length: larger displacements are not small, with strains of about 10 %
SMALL_FRACTION = 0.1
# CalculiX takes three times as long with one material per cell (benchmarks)
SLOW_MATERIALS = 30_000


def check_solver_options(
    output: Path,
    solver: SolverOptions,
    has_materials: bool = False,
    *,
    reads_files: bool = True,
) -> None:
    """Check the options that do not depend on the mesh, before the work starts; files that they
    name only if `reads_files`.

    Raises
    ------
    InputError
        An invalid suffix, mapping, number of bins, unit or convention; options that need moduli
        without any.
    """
    form = format_of(output)
    check_model_options(solver, has_materials, reads_files=reads_files)
    if solver.average is not None and solver.young is None:
        raise InputError("`average`: needs `young`")
    if solver.units not in STRESS_UNITS:
        raise InputError(f"`units`: expected one of {', '.join(STRESS_UNITS)}, got {solver.units}")
    if solver.written_fields is not None and (
        solver.written_fields not in FIELDS or not form.fields
    ):
        able = ", ".join(name for name, kind in FORMATS.items() if kind.fields)
        raise InputError(
            f"`written_fields`: expected {', '.join(FIELDS)} and a file {able}, got "
            f"{solver.written_fields} for {output}"
        )
    if solver.space not in SPACES:
        raise InputError(f"`space`: expected {' or '.join(SPACES)}, got {solver.space}")
    if solver.nonlinear and not form.has_large:
        raise InputError(
            f"{output}: `nonlinear` is for "
            f"{', '.join(s for s, f in FORMATS.items() if f.has_large)} only"
        )
    if solver.order == 2 and not form.has_quadratic:
        raise InputError(
            f"{output}: `order` 2 is for "
            f"{', '.join(s for s, f in FORMATS.items() if f.has_quadratic)} only"
        )


def check_model_options(
    options: ModelOptions, has_materials: bool, *, reads_files: bool = True
) -> None:
    """Check the options that do not depend on the mesh; files that they name only if `reads_files`.
    `has_materials` is that of the mesh's file, or an image.

    Raises
    ------
    InputError
        An invalid mapping, average, number of bins or order; options that need moduli without any.
    """
    scalars = scalar_names(options.fields)
    texts = ((name, getattr(options, name)) for name in MAPPED_OPTIONS)
    for name, text in texts:
        if text is None:
            continue
        if reads_files or named_file(text) is None:
            _check_mapping(text, name, scalars)
        if options.young is None and not has_materials:
            raise InputError(f"`{name}`: needs `young`")
    parse_average(options.average or DEFAULT_AVERAGE)
    parse_bins(options.bins)
    parse_groups(options.written_sets)
    if options.order not in (None, 1, 2):
        raise InputError(f"`order`: expected 1 or 2, got {options.order}")


def _check_mapping(text: str, name: str, scalars: list[str]) -> None:
    """Raise InputError with the option's name for an invalid mapping."""
    try:
        parse_any_mapping(text, name, fields=scalars)
    except InputError as error:
        raise InputError(f"`{name}`: {str(error).removeprefix('mapping: ')}") from error


def parse_bins(text: str | None) -> tuple[int | None, Spacing]:
    """Parse "K", "K:quantile" or "K:log" into the number and spacing of bins."""
    if text is None:
        return None, "equal"
    count, _, spacing = text.partition(":")
    spacing = spacing or "equal"
    if re.fullmatch("0*[1-9][0-9]{0,8}", count) is None or spacing not in get_args(Spacing):
        raise InputError(
            f'`bins`: expected K, K:quantile or K:log with K from 1 to 999999999, got "{text[:80]}"'
        )
    return int(count), cast(Spacing, spacing)


def parse_groups(text: str | None) -> tuple[str, ...]:
    """Parse the `SET_GROUPS` to write, from "labels,interfaces,boundary", "all", or "none"."""
    if text in (None, "all"):
        return SET_GROUPS
    words = [] if text == "none" else [word.strip() for word in text.split(",")]
    if unknown := [word for word in words if word not in SET_GROUPS]:
        raise InputError(
            f"`written_sets`: expected some of {', '.join(SET_GROUPS)}, or all, or none, got "
            f'"{unknown[0]}"'
        )
    return tuple(words)


def choices_of(options: ModelOptions) -> Choices:
    """Return what the options choose for a model."""
    bins, spacing = parse_bins(options.bins)
    return Choices(
        options.young,
        options.nu,
        options.density,
        options.average or DEFAULT_AVERAGE,
        options.sets or (),
        options.loads or (),
        bins,
        spacing,
        options.order or 1,
        options.units if isinstance(options, SolverOptions) else "kPa",
        fibre=options.fibre,
        young_along=options.young_along,
        shear_along=options.shear_along,
    )


def solver_model(
    loaded: MeshFile,
    image: Image | None,
    options: ModelOptions,
    about: Json,
    box: Box | None,
    fields: Mapping[str, Image | Field],
    mask: Image | None = None,
) -> Model:
    """Build the model of a mesh, with its data, sets and texts, with the options and their
    `fields`, as read, within the mask unless the texts have one.
    """
    about = {"tetopt": tetopt.__version__, **about}
    choices = choices_of(options)._replace(fields=fields, mask=mask)
    model = model_of_file(loaded, image, choices, about, box)
    return model._replace(is_nonlinear=isinstance(options, SolverOptions) and options.nonlinear)


def large_words(mesh: Mesh, moved: float, how: str) -> str | None:
    """Describe the largest displacement `moved`, mm, if it is not small against the mesh's length;
    `how` is the advice.

    Loads in other units, or a set that is not fixed, show in it first.
    """
    size = float(np.ptp(mesh.points, axis=0).max())
    if not moved > SMALL_FRACTION * size:
        return None
    return (
        f"the largest displacement, {moved:.4g} mm, is {moved / size:.0%} of the mesh's "
        f"length, {how}"
    )


def with_chosen_sets(model: Model, output: Path, options: ModelOptions) -> Model:
    """Return the model with the sets to write; note interfaces that are left out by default.

    Of the sets that every mesh has, those of `written_sets` are written, by default all, except
    more than `MANY_INTERFACES` interfaces in a VTK file. Other sets, and those that loads name, are
    always written.
    """
    groups = set(parse_groups(options.written_sets))
    labels = [] if model.labels is None else np.unique(model.labels).tolist()
    of_label = label_set_names(labels, model.label_names)
    pairs = [(a, b) for a in of_label for b in of_label if a < b]
    between = {
        *interface_names(pairs, of_label).values(),
        *(f"interface_{a}_{b}" for a, b in pairs),
    }
    interfaces = between & set(model.sets.facets)
    if (
        options.written_sets is None
        and output.suffix.lower() in VTK_SUFFIXES
        and len(interfaces) > MANY_INTERFACES
    ):
        note(
            f"{len(interfaces)} interfaces are not written as sets (`written_sets` all writes "
            "them); convert, fem and view derive them from the cells' labels"
        )
        groups.discard("interfaces")
    left = set() if "labels" in groups else set(of_label.values())
    left |= set() if "interfaces" in groups else interfaces
    left |= set() if "boundary" in groups else standard_names(model.mesh.ndim)
    left -= {load.set_name for load in model.loads}
    facets, cells = (
        {name: rows for name, rows in kind.items() if name not in left} for kind in model.sets
    )
    return model._replace(sets=Sets(facets, cells))


def convert_model(
    loaded: MeshFile,
    what: Content | None,
    options: ModelOptions,
    about: Json,
    box: Box | None,
    has_units: bool = True,
) -> Model:
    """Build the model of a mesh's file, keeping the file's own data, with the options; warn of
    implausible units.
    """
    image = None if what is None else what.image
    mask = None if what is None or not options.fields else what.own_mask
    if image is not None:
        check_mesh_place("mesh and image", loaded.mesh, image)
        cell_data = loaded.cell_data | cell_fields(loaded.mesh, image)
        loaded = loaded._replace(cell_data=cell_data)
    table = label_table(options.label_names, loaded)
    about = about | ({TABLE_TEXT: table} if table.names or table.colours else {})
    with warnings_heard():
        fields = read_fields(options.fields)
        model = solver_model(loaded, image, options, about, box, fields, mask)
    if has_units:
        warn_of_units(model)
    return model


def check_early(
    output: Path,
    solver: SolverOptions,
    ndim: int,
    low: float,
    build: Callable[[SolverOptions], Model],
) -> None:
    """Raise InputError for what would be rejected after the optimisation, as far as the initial
    mesh shows.

    `low` is the image's least intensity; `build` makes a model of the initial mesh. Requested sets,
    and interfaces, may be empty until the final mesh: of these, and of loads on them, only words
    and names are checked.
    """
    requests = [parse_set(text, ndim) for text in solver.sets or ()]
    for request in requests:
        if request.kind == "below" and request.vectors[0][0] <= low:
            raise InputError(
                f"set {request.name}: no cell can have a mean below {request.vectors[0][0]:g}, as "
                f"the image's minimum is {low:g}"
            )
    names = {name for request in requests for name in request.names()}
    loads = [parse_load(text, ndim) for text in solver.loads or ()]
    check_steps(loads)
    loaded = [load.set_name for load in loads]
    is_certain = not any(name in names or name.startswith(INTERFACE_PREFIX) for name in loaded)
    # the final mesh may have cells of further labels, and larger sides
    with warnings.catch_warnings(action="ignore"):
        model = build(replace(solver, sets=None, loads=solver.loads if is_certain else None))
    warn_of_units(model._replace(loads=tuple(loads)))
    known = model.sets
    for request in requests:
        check_free_names(request, known)
        for part in request.parts or (request,):
            if part.difference and INTERFACE_PREFIX not in part.difference.lower():
                places_in(part, known)
        known = Sets(
            known.facets | dict.fromkeys(request.names(), known.facets[BOUNDARY_SET]), known.cells
        )
    for name in loaded:
        if name and name not in names and not name.startswith(INTERFACE_PREFIX):
            known_set(name, model.sets)
    for load in loads:
        if (
            load.kind in FACET_FORCES
            and load.set_name.startswith(INTERFACE_PREFIX)
            and load.set_name not in names
        ):
            raise InputError(
                f'load: the facets of "{load.set_name}" lie between two cells, where no outside '
                f"force can act ({load.kind}); use a set on the boundary, leave out one side "
                "(`drop_labels`), or move the set"
            )
    file_bytes(output, _with_names(model, requests), space=solver.space, units=solver.units)


def _with_names(model: Model, requests: Sequence[SetRequest]) -> Model:
    """Return the model with a facet and a cell in each requested set, so that a writer rejects
    bad names now.
    """
    facets = dict(model.sets.facets)
    cells = dict(model.sets.cells)
    for request in requests:
        *of_cells, of_facets = request.names()
        facets[of_facets] = model.sets.facets[BOUNDARY_SET][:1]
        cells |= {name: np.zeros(1, dtype=np.int64) for name in of_cells}
    return model._replace(sets=Sets(facets, cells))


def warn_of_units(model: Model) -> None:
    """Warn of each quantity that seems to be in another unit than expected."""
    for words in odd_units(model):
        warning(words)


def save_for_solver(output: Path, model: Model, solver: SolverOptions) -> None:
    """Write the file with the fields of cells that the options or the format choose."""
    # a format without a place for them lists them
    choice = solver.written_fields or format_of(output).fields or "all"
    names = [name for name in model.cell_data if name != LABEL_FIELD and not is_result(name)]
    left = [
        name
        for name in names
        if choice == "none" or (choice == "mean" and not re.fullmatch(MEAN_FIELD, name))
    ]
    if left and solver.written_fields is None:
        note(
            f"{output}: {len(left)} fields of cells are not written (`written_fields` all "
            f"writes them): {', '.join(left)}"
        )
    model = model._replace(
        cell_data={name: rows for name, rows in model.cell_data.items() if name not in left}
    )
    if (
        model.materials is not None
        and len(model.materials.young) > SLOW_MATERIALS
        and output.suffix.lower() == ".inp"
    ):
        note(
            f"{len(model.materials.young)} materials make CalculiX about three times slower; "
            "`bins` 32 groups them"
        )
    save_model(output, model, space=solver.space, units=solver.units)


def keep_early(mesh: Mesh, labels: Ints | None, places: Iterable[Path]) -> Path | None:
    """Keep an optimised mesh in the first possible place until all is written, in case the
    process ends; return it.
    """
    data = {} if labels is None else {LABEL_FIELD: labels}
    reason = ""
    for place in places:
        try:
            save_mesh(place, mesh, data, order=1 if mesh.midpoints is None else 2)
        except (OSError, MemoryError, InputError) as error:  # as of a format that needs materials
            reason = error_words(error)
        else:
            return output_place(place)
    note(f"cannot save a copy of the optimised mesh: {reason}")
    return None


def drop_early(early: Path) -> None:
    """Remove the file of `keep_early`, as the mesh is saved elsewhere."""
    try:
        early.unlink(missing_ok=True)
    except OSError as error:
        note(f"{early}: this copy of the mesh cannot be removed ({error.strerror})")


def save_anyway(
    output: Path,
    result: MeshingResult,
    build: Callable[[], Model],
    error: Exception,
    early: Path | None,
) -> None:
    """Keep an optimised mesh whose file was rejected or failed, as VTU: in `early`, its copy, if
    there is one; else beside it, else in a temporary folder.

    `build` makes the model to keep; if that fails, the mesh and its labels are kept.

    Raises
    ------
    InputError
        If the user can fix `error`; the message says where the mesh is.
    """
    is_there = early is not None and early.is_file()  # and not gone with its folder
    kept = early if is_there else keep_early(result.mesh, result.labels, kept_places(output))
    where = "could not be saved anywhere"
    if kept is not None:
        where = f"is in {kept}: continue from there with tetopt convert"
        try:
            save_model(kept, build())
        except Exception as failed:  # noted; the earlier error is raised at the end
            note(f"{kept}: holds the mesh and the labels of its cells: {error_words(failed)}")
    if isinstance(error, InputError | OSError | MemoryError):
        raise InputError(f"{error_words(error)}; the optimised mesh {where}") from error
    note(f"the optimised mesh {where}")
