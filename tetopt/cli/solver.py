"""From a mesh to a file for a solver: what `tetopt mesh` and `tetopt convert` have in common."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

import tetopt
from tetopt import Image, InputError, Mesh, save_mesh
from tetopt.cli.console import error_words, log, out, print_wide, show_warning
from tetopt.cli.inputs import label_table
from tetopt.cli.options import ModelOptions, SolverOptions
from tetopt.io.files import kept_places
from tetopt.io.formats import FORMATS, file_bytes, format_of, save_model
from tetopt.io.gmsh import incomplete_groups
from tetopt.io.tags import group_of_zero, label_lines, numbered_parts
from tetopt.io.vtk import VTK_SUFFIXES
from tetopt.model.averages import DEFAULT_AVERAGE, parse_average
from tetopt.model.build import model_of
from tetopt.model.fields import GAUSS_MODULI, is_result
from tetopt.model.file import MATERIAL_FIELDS, MeshFile, loads_in, moduli_in, sets_beside
from tetopt.model.file import completed as with_rest_of_file
from tetopt.model.labels import TABLE_TEXT, labels_of, table_of_words, table_words
from tetopt.model.laws import parse_any_law
from tetopt.model.loads import (
    FACET_FORCES,
    SHOWN_LOAD_DIGITS,
    check_steps,
    count_of_steps,
    known_set,
    load_words,
    other_orders,
    parse_load,
)
from tetopt.model.materials import DEFAULT_NU, Materials, Spacing
from tetopt.model.model import SPACES, STRESS_UNITS, Model, element_facets, elements, odd_units
from tetopt.model.sets import (
    BOUNDARY_SET,
    Box,
    SetRequest,
    Sets,
    check_free_names,
    interface_names,
    label_set_names,
    parse_set,
    standard_names,
)
from tetopt.report.tables import new_table, nodes_in_words

REACTIONS_TEXT = r"reactions(_step\d+)?"  # of a solved mesh's file: the forces that hold sets
SET_GROUPS = ("labels", "interfaces", "boundary")  # of the sets that every mesh has
# Each is an array more on the nodes of a VTU or VTK file; labels and their sets can be made anew of its cells.
MANY_INTERFACES = 24
GMSH_SUFFIXES = (".msh", ".msh2")
CELL_NUMBERS = {".mfem": "attribute", ".mesh": "reference"}  # what the formats call the number of a cell
INTERFACE_PREFIX = "interface_"  # of the names of facet sets between two labels
LISTED_NAMES = 8  # of labels of one material: a line's worth
SLOW_MATERIALS = 30_000  # CalculiX takes three times as long with as many as there are cells (tests/benchmarks)


def check_solver_options(output: Path, solver: SolverOptions, has_materials: bool = False) -> None:
    """InputError for what is wrong whatever the mesh may be, raised before the work starts.

    Raises
    ------
    InputError
        A suffix, law, number of bins, unit or convention that there is not; what needs moduli without any.
    """
    form = format_of(output)
    if form.is_surface and (solver.young or solver.bins or solver.sets or solver.loads or solver.written_sets):
        raise InputError(f"{output}: holds the boundary alone; leave out --young, --bins, --set, --sets and --load")
    check_model_options(solver, has_materials)
    if solver.average is not None and solver.young is None:
        raise InputError("--average: there is no --young")
    if solver.units not in STRESS_UNITS:
        raise InputError(f"--units: expected {' or '.join(STRESS_UNITS)}, got {solver.units}")
    if solver.space not in SPACES:
        raise InputError(f"--space: expected {' or '.join(SPACES)}, got {solver.space}")
    if solver.nonlinear and not form.has_large:
        raise InputError(f"{output}: --nonlinear is for {', '.join(s for s, f in FORMATS.items() if f.has_large)} only")
    if solver.order == 2 and not form.has_quadratic:
        raise InputError(
            f"{output}: --order 2 is for {', '.join(s for s, f in FORMATS.items() if f.has_quadratic)} only"
        )


def check_model_options(options: ModelOptions, has_materials: bool) -> None:
    """InputError for what is wrong whatever mesh and file may be; `has_materials`: the mesh's file does, or an image.

    Raises
    ------
    InputError
        A law, average, number of bins or order that there is not; what needs moduli without any.
    """
    for name, law in (("young", options.young), ("nu", options.nu), ("density", options.density)):
        if law is not None:
            _check_law(law, name)
            if options.young is None and not has_materials:
                raise InputError(f"--{name}: there is no --young")
    parse_average(options.average or DEFAULT_AVERAGE)
    parsed_bins(options.bins)
    parsed_groups(options.written_sets)
    if options.order not in (None, 1, 2):
        raise InputError(f"--order: expected 1 or 2, got {options.order}")


def _check_law(text: str, name: str) -> None:
    """InputError that names the option, for a law that is none."""
    try:
        parse_any_law(text, name)
    except InputError as error:
        raise InputError(f"--{name}: {str(error).removeprefix('law: ')}") from error


def parsed_bins(text: str | None) -> tuple[int | None, Spacing]:
    """Number and spacing of bins, from "K", "K:quantile" or "K:log"."""
    if text is None:
        return None, "equal"
    count, _, spacing = text.partition(":")
    spacing = spacing or "equal"
    if re.fullmatch("0*[1-9][0-9]{0,8}", count) is None or spacing not in get_args(Spacing):
        raise InputError(f'--bins: expected K, K:quantile or K:log with K from 1 to 999999999, got "{text[:80]}"')
    return int(count), cast(Spacing, spacing)


def parsed_groups(text: str | None) -> tuple[str, ...]:
    """Which of `SET_GROUPS` are to be written, from "labels,interfaces,boundary", "all", or "none"."""
    if text in (None, "all"):
        return SET_GROUPS
    words = [] if text == "none" else [word.strip() for word in text.split(",")]
    if unknown := [word for word in words if word not in SET_GROUPS]:
        raise InputError(f'--sets: expected some of {", ".join(SET_GROUPS)}, or all, or none, got "{unknown[0]}"')
    return tuple(words)


def solver_model(
    mesh: Mesh, image: Image | None, solver: ModelOptions, cell_data: dict[str, NDArray], about: dict[str, Any],
    known_sets: Sets,
) -> Model:  # fmt: skip
    """The model that the options ask for, of a mesh with the sets `known_sets`."""
    young, nu, density = moduli_in(cell_data, solver.young, solver.nu, solver.density)
    is_of_file = solver.young is None and "young" in cell_data
    if not is_of_file and nu is None and "nu" in cell_data:
        log.print(f"nu: of --young or {DEFAULT_NU:g}; what the mesh's file has is left")
    fields = {name: values for name, values in cell_data.items() if name not in MATERIAL_FIELDS}
    bins, spacing = parsed_bins(solver.bins)
    model = model_of(
        mesh, image, young=young, nu=nu, density=density, average=solver.average or DEFAULT_AVERAGE,
        sets=solver.sets or (), loads=solver.loads or (), bins=bins, spacing=spacing, order=solver.order or 1,
        cell_data=fields, known_sets=known_sets, about={"tetopt": tetopt.__version__, **about},
    )  # fmt: skip
    return model._replace(is_nonlinear=isinstance(solver, SolverOptions) and solver.nonlinear)


def completed(model: Model, loaded: MeshFile, solver: ModelOptions) -> Model:
    """The model with what the mesh's file alone has; see `tetopt.model.file.completed`."""
    model, lost = with_rest_of_file(model, loaded, is_of_file=solver.young is None and solver.bins is None)
    if lost:
        log.print(lost)
    return model


def without_stale_results(loaded: MeshFile, solver: ModelOptions) -> MeshFile:
    """The mesh's file without what a solver found on it, if moduli, densities or loads are to be others; a line."""
    if not any((solver.young, solver.nu, solver.density, solver.bins, solver.loads)):
        return loaded
    names = [name for data in (loaded.cell_data, loaded.point_data) for name in data if is_result(name)]
    texts = {name: text for name, text in loaded.field_data.items() if re.fullmatch(REACTIONS_TEXT, name) is None}
    if not names and len(texts) == len(loaded.field_data):
        return loaded
    log.print(
        escape(f"left out, as they are of other moduli or loads: {', '.join(dict.fromkeys(names)) or 'reactions'}; ")
        + "tetopt fem finds them anew"
    )
    cell_data, point_data = (
        {name: rows for name, rows in data.items() if name not in names}
        for data in (loaded.cell_data, loaded.point_data)
    )
    return loaded._replace(cell_data=cell_data, point_data=point_data, field_data=texts)


def loads_of(loaded: MeshFile) -> list[str]:
    """The loads that a file of ours holds, see `tetopt.model.file.loads_in`; a line where they are left out."""
    loads, lost = loads_in(loaded)
    if lost:
        log.print(escape(lost))
    return loads


def all_sets(
    mesh: Mesh,
    box: Box | None,
    fields: dict[str, NDArray],
    own: Sets,
    names: Mapping[int, str],
    former: Mapping[int, str] | None = None,
    kept: Iterable[str] = (),
    is_told: bool = True,
) -> Sets:
    """`tetopt.model.file.sets_beside`; a line for each of the mesh's own that had to be called otherwise."""
    sets, renamed = sets_beside(mesh, box, fields, own, names, former, kept)
    if is_told:
        for old, new in renamed.items():
            log.print(f'the mesh came with a set "{old}" of its own: it is {new} here')
    return sets


def with_chosen_sets(model: Model, output: Path, options: ModelOptions) -> Model:
    """The model with those sets that its file is to get; a line if interfaces are left out unasked.

    Of the sets that every mesh has those of --sets are written, by default all, but into a file of VTK's no more
    interfaces than `MANY_INTERFACES`. Others, and those that loads name, always are.
    """
    groups = set(parsed_groups(options.written_sets))
    labels = labels_of(model.cell_data, len(model.mesh.cells))
    names = table_of_words(model.about.get(TABLE_TEXT)).names
    of_label = {} if labels is None else label_set_names(np.unique(labels).tolist(), names)
    pairs = [(a, b) for a in of_label for b in of_label if a < b]
    between = {*interface_names(pairs, of_label).values(), *(f"interface_{a}_{b}" for a, b in pairs)}
    interfaces = between & set(model.sets.facets)
    if options.written_sets is None and output.suffix.lower() in VTK_SUFFIXES and len(interfaces) > MANY_INTERFACES:
        log.print(
            f"{len(interfaces)} interfaces are not written as sets, which --sets all does; convert, fem and view have "
            "them anyway, from the cells' labels"
        )
        groups.discard("interfaces")
    left = set()
    for group, members in (
        ("labels", set(of_label.values())), ("interfaces", interfaces), ("boundary", standard_names(model.mesh.ndim)),
    ):  # fmt: skip
        left |= set() if group in groups else members
    left -= {load.set_name for load in model.loads}
    facets, cells = ({name: rows for name, rows in kind.items() if name not in left} for kind in model.sets)
    return model._replace(sets=Sets(facets, cells))


def sets_and_table(
    loaded: MeshFile, box: Box | None, fields: dict[str, NDArray], options: ModelOptions
) -> tuple[Sets, dict[str, Any]]:
    """The sets of a mesh's file, `all_sets`, and the texts of labels' names that go on into the next."""
    table, former = label_table(options.label_names, loaded), label_table(None, loaded)
    of_loads = {parse_load(text, loaded.mesh.ndim).set_name for text in options.loads or ()}
    sets = all_sets(loaded.mesh, box, fields, loaded.sets, table.names, former.names, of_loads)
    return sets, {TABLE_TEXT: table_words(table)} if table.names or table.colours else {}


def check_early(
    output: Path, solver: SolverOptions, ndim: int, low: float, build: Callable[[SolverOptions], Model]
) -> None:
    """InputError for what would be refused after the optimisation, as far as the initial mesh can tell.

    `low` is the image's least intensity; `build` makes a model of the initial mesh. Further sets, and interfaces, may
    have members in the final one alone: of them, and of loads on them, only the words and names are looked at.
    """
    requests = [parse_set(text, ndim) for text in solver.sets or ()]
    for request in requests:
        if request.kind == "below" and request.vectors[0][0] <= low:
            raise InputError(
                f"set {request.name}: no cell can have a mean below {request.vectors[0][0]:g}, the image begins at "
                f"{low:g}"
            )
    names = {name for request in requests for name in request.names()}
    loads = [parse_load(text, ndim) for text in solver.loads or ()]
    check_steps(loads)
    loaded = [load.set_name for load in loads]
    is_certain = not any(name in names or name.startswith(INTERFACE_PREFIX) for name in loaded)
    model = build(replace(solver, sets=None, loads=solver.loads if is_certain else None))
    warn_of_units(model._replace(loads=tuple(loads)))
    for request in requests:
        check_free_names(request, model.sets)
    for name in loaded:
        may_come = name.startswith(INTERFACE_PREFIX) and not other_orders(name, model.sets)
        if name and name not in names and not may_come:
            known_set(name, model.sets)
    for load in loads:
        if load.kind in FACET_FORCES and load.set_name.startswith(INTERFACE_PREFIX) and load.set_name not in names:
            raise InputError(
                f'load: the facets of "{load.set_name}" lie between two cells, where nothing outside can act '
                f"({load.kind}); take a set of the boundary, mesh one side alone (--mask), or move the set"
            )
    file_bytes(output, _with_names(model, requests), space=solver.space, units=solver.units)


def _with_names(model: Model, requests: Sequence[SetRequest]) -> Model:
    """The model with a facet and a cell under each name of a set that is asked for, so that a writer refuses it now."""
    facets, cells = dict(model.sets.facets), dict(model.sets.cells)
    for request in requests:
        *of_cells, of_facets = request.names()
        facets[of_facets] = model.sets.facets[BOUNDARY_SET][:1]
        cells |= {name: np.zeros(1, dtype=np.int64) for name in of_cells}
    return model._replace(sets=Sets(facets, cells))


def warn_of_units(model: Model) -> None:
    """A line for each quantity that seems to be in another unit than is expected."""
    for words in odd_units(model):
        show_warning(words)


def save_for_solver(output: Path, model: Model, solver: SolverOptions) -> None:
    """Write the file."""
    if model.materials is not None and len(model.materials.young) > SLOW_MATERIALS and output.suffix.lower() == ".inp":
        log.print(
            f"{len(model.materials.young)} materials make CalculiX some three times slower; --bins 32 groups them"
        )
    save_model(output, model, space=solver.space, units=solver.units)


def keep_early(output: Path, mesh: Mesh, labels: NDArray[np.int64] | None) -> Path | None:
    """Keep an optimised mesh beside its file until that is written, whatever may end the process before; the place."""
    early = next(kept_places(output, ".vtu"))
    try:
        save_mesh(early, mesh, {} if labels is None else {"label": labels})
    except (OSError, MemoryError) as error:
        log.print(escape(f"the optimised mesh cannot be kept before its file is written: {error_words(error)}"))
        return None
    return early


def drop_early(early: Path) -> None:
    """Remove what `keep_early` kept, as the mesh is elsewhere by now."""
    try:
        early.unlink(missing_ok=True)
    except OSError as error:
        log.print(
            escape(f"{early}: holds the nodes and cells of the mesh, too; it cannot be removed: {error.strerror}")
        )


def save_anyway(output: Path, mesh: Mesh, build: Callable[[], Model], error: Exception, early: Path | None) -> None:
    """Keep an optimised mesh whose file was refused or failed, as VTU: beside it, else in a temporary folder.

    `build` makes the model to keep; if that fails, too, the mesh is kept alone, as it is `early`, if that is a place.

    Raises
    ------
    InputError
        If `error` is one that the user can mend; it says where the mesh is.
    """
    places = chain([] if early is None else [early], kept_places(output, ".vtu"))
    kept = _kept_mesh(places, (lambda path: save_model(path, build()), lambda path: save_mesh(path, mesh)))
    where = "could not be kept anywhere" if kept is None else f"is in {kept}: go on from there with tetopt convert"
    if isinstance(error, InputError | OSError | MemoryError):
        raise InputError(f"{error_words(error)}; the optimised mesh {where}") from error
    log.print(escape(f"the optimised mesh {where}"))


def _kept_mesh(places: Iterable[Path], ways: Sequence[Callable[[Path], None]]) -> Path | None:
    """The first place where one of the ways to save a mesh does so, or where it was saved before."""
    for path in places:
        for save in ways:
            try:
                save(path)
            except Exception as error:  # told; what ended the run before is raised in the end
                log.print(escape(f"{path}: the optimised mesh cannot be kept here: {error_words(error)}"))
            else:
                return path
        if path.exists():
            return path
    return None


def print_model(output: Path, model: Model, solver: SolverOptions) -> None:
    """What is in the file: sets, materials and the error of binning, units, coordinates."""
    for line in _lines(output, model, solver):
        out.print(escape(line))
    if format_of(output).is_surface:
        return
    table, cells = new_table("set", "facets", "nodes", "cells"), elements(model)[1]
    for name, rows in model.sets.facets.items():
        table.add_row(escape(name), str(len(rows)), str(len(np.unique(element_facets(cells, rows)))), "")
    for name, members in model.sets.cells.items():
        table.add_row(escape(name), "", "", str(len(members)))
    print_wide(table)


def _materials_by_name(model: Model, materials: Materials) -> Iterator[str]:
    """A line for each material with the names of its labels, where labels have names and each is of one material."""
    labels, names = labels_of(model.cell_data, len(model.mesh.cells)), table_of_words(model.about.get(TABLE_TEXT)).names
    if labels is None or not names:
        return
    pairs = np.unique(np.column_stack([labels, materials.of_cell]), axis=0).tolist()
    if len(pairs) > len(np.unique(labels)):
        return
    for number, (young, nu) in enumerate(zip(materials.young, materials.nu, strict=True)):
        made_of = [names.get(label, str(label)) for label, material in pairs if material == number]
        more = f" and {len(made_of) - LISTED_NAMES} more" if len(made_of) > LISTED_NAMES else ""
        yield f"  {young:.4g} kPa, nu {nu:.4g}: {', '.join(made_of[:LISTED_NAMES])}{more}"


def _gmsh_lines(model: Model, suffix: str) -> Iterator[str]:
    """What gmsh's formats cannot hold as it is: loads, label 0, and, in 2.2, a facet in several groups."""
    if model.loads:
        yield f"loads are not read back from {suffix}: tetopt reads them from VTK files only"
    labels = labels_of(model.cell_data, len(model.mesh.cells))
    if labels is not None and labels.min() == 0:
        yield f"label 0 is physical group {group_of_zero(labels)}, as gmsh has no group 0"
    if suffix == ".msh2" and (short := incomplete_groups(model)):
        yield (
            f"gmsh 2.2 has one group per facet: those of smaller sets are missing from {', '.join(short)} (use .msh)"
        )


def _lines(output: Path, model: Model, solver: SolverOptions) -> Iterator[str]:
    form = format_of(output)
    materials = None if form.is_surface else model.materials
    if materials is not None:
        young, nu = materials.young, materials.nu
        ratios = f"{nu.min():.4g}" if nu.min() == nu.max() else f"{nu.min():.4g} to {nu.max():.4g}"
        count = f"{len(young)} material{'s' * (len(young) > 1)}"
        yield f"{count}, Young's modulus {young.min():.4g} to {young.max():.4g} kPa, nu {ratios}"
        yield from _materials_by_name(model, materials)
    if materials is not None and model.gauss_young is not None:
        yield (
            f"one modulus a cell, its geometric mean, and, for tetopt fem, one at each Gauss point ({GAUSS_MODULI})"
            if output.suffix.lower() in VTK_SUFFIXES
            else "one modulus a cell, its geometric mean; VTK's files have one at each Gauss point, too"
        )
    if materials is not None and materials.binning is not None:
        mean, largest = materials.binning.mean, materials.binning.largest
        yield f"bins: modulus off by {mean:.2%} in the mean by volume, {largest:.2%} at most"
    if model.node_young is not None and not form.is_surface:
        low, high = model.node_young.min(), model.node_young.max()
        yield (
            f"the modulus is linear within cells, {low:.4g} to {high:.4g} kPa at their corners"
            if form.has_node_moduli
            else "the format has one modulus a cell: the mean of what is linear between the corners"
        )
    for load in () if form.is_surface else model.loads:
        yield f"load: {load_words(load, SHOWN_LOAD_DIGITS)}"
    if (n_steps := count_of_steps(model.loads)) > 1 and not form.is_surface:
        yield f"{n_steps} steps, each from the undeformed state"
    if model.loads and not (form.runs or form.is_surface):
        yield "the format runs no step: the loads are in the file as text"
    if (suffix := output.suffix.lower()) in GMSH_SUFFIXES:
        yield from _gmsh_lines(model, suffix)
    elif suffix in CELL_NUMBERS:
        yield from label_lines(model, numbered_parts(model)[0], CELL_NUMBERS[suffix])
    low, high = model.mesh.points.min(axis=0), model.mesh.points.max(axis=0)
    ranges = zip("xyz", low, high, strict=False)
    yield (
        "the mesh lies at "
        + ", ".join(f"{axis} {a:.6g} to {b:.6g}" for axis, a, b in ranges)
        + (" mm (RAS)" if model.mesh.ndim == 3 else " mm in its plane")
    )
    space = f"{solver.space.upper()}+ mm" if model.mesh.ndim == 3 else "mm"
    if form.is_surface:
        yield f"{output}: {form.what}, {space}"
        return
    size = f"{nodes_in_words(model.mesh, model.order)}, {len(model.mesh.cells)} cells"
    yield f"{output}: {form.what}, {space}, {solver.units}, {size}"
