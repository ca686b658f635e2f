"""Conversion of a mesh's file for a solver."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tetopt.commands.beside import check_part, stated_files, voxels_of
from tetopt.contents.align import SMALL_COMPONENT_FRACTION
from tetopt.errors import InputError
from tetopt.geometry.check import check_unfolded
from tetopt.geometry.topology import components
from tetopt.io.formats import format_of
from tetopt.io.frd import read_frd
from tetopt.io.images import sha256
from tetopt.io.meshes import load_mesh
from tetopt.io.text import count_text, list_names
from tetopt.io.vtk import VTK_SUFFIXES
from tetopt.job.events import note, progress, warning, warnings_heard
from tetopt.job.mesh_file import read_mesh
from tetopt.job.moved import move_file, tell_fit
from tetopt.job.options import (
    ALL_LABELS,
    UNMOVED,
    LabelChoice,
    LabelledPart,
    MoveOptions,
    SolverOptions,
)
from tetopt.job.solver_files import (
    check_solver_options,
    choices_of,
    convert_model,
    large_words,
    save_for_solver,
    with_chosen_sets,
)
from tetopt.mesh import Mesh
from tetopt.model.fields import is_stress
from tetopt.model.file import (
    REACTIONS_TEXT,
    MeshFile,
    loads_in,
    texts_of,
    with_cells,
    without_results,
    without_stale_results,
)
from tetopt.model.label_names import kept_labels
from tetopt.model.loads import parse_load
from tetopt.model.model import Model
from tetopt.model.sets import (
    INTERFACE_PREFIX,
    Sets,
    box_of,
    box_text,
    label_set_names,
    merged_sets,
    standard_names,
)
from tetopt.report.summary import model_summary, versions
from tetopt.system.arrays import Bools, Ints, Json


class Converted(NamedTuple):
    """The result of a conversion."""

    model: Model
    options: SolverOptions  # with their defaults
    numbers: Json  # as `tetopt convert --json` writes them


def convert_file(
    mesh: Path,
    output: Path,
    *,
    solver: SolverOptions,
    part: LabelledPart,
    choice: LabelChoice = ALL_LABELS,
    image: Path | None = None,
    results: Path | None = None,
    move: MoveOptions = UNMOVED,
) -> Converted:
    """Write a mesh's file for a solver: materials, named sets, loads, in the format of the output's
    suffix.

    Parameters
    ----------
    mesh : Path
    output : Path
    solver : SolverOptions
    part : LabelledPart
    choice : LabelChoice
        Labels whose cells are written.
    image : Path, optional
        The source of means and mappings, instead of the mesh's file.
    results : Path, optional
        CalculiX's results for this mesh, to be added to it.
    move : MoveOptions
        Transforms that move the mesh to the image.

    Raises
    ------
    InputError
        Options are invalid; files cannot be read, or do not belong together.
    """
    if results is not None and output.suffix.lower() not in VTK_SUFFIXES:
        raise InputError(
            f"`results`: expected an output file {' or '.join(VTK_SUFFIXES)}, got {output}"
        )
    if move.transform and (results is not None or part.labels is not None):
        name = "labels" if results is None else "results"
        raise InputError(f"`transform` and `{name}`: convert first with one, then with the other")
    check_part(image, part, part.labels)
    before = read_mesh(mesh, part)
    check_unfolded(before.mesh, source=str(mesh))
    loaded = move_file(before, move, image)
    if results is None:
        with warnings_heard():
            is_stale = choices_of(solver).is_new
            loaded = without_stale_results(loaded, is_stale=is_stale)
    else:
        loaded = with_results(loaded, results)
    solver = replace(solver, order=_order_of(loaded, solver, output))
    loaded = _with_straight_edges(loaded) if solver.order == 1 else loaded
    check_solver_options(output, solver, has_materials="young" in loaded.cell_data)
    if image is None and solver.average is not None and not solver.fields:
        raise InputError(
            f"`average`: {solver.average} averages over voxels and needs an image; pass `image` or "
            "`fields`"
        )
    if not solver.loads:
        solver = replace(solver, loads=_loads_of_file(loaded, choice, move))
    loaded, what, is_other = voxels_of(loaded, mesh, image, part, part.labels)
    if move.transform and what is not None:
        tell_fit(before, loaded.mesh, what, image)
    loaded = _of_labels(loaded, choice)
    about = _texts_of(loaded, solver, has_new_results=results is not None)
    box = loaded.box
    if image is not None and what is not None:
        about = texts_of(loaded, is_other=True) if is_other else about
        about |= {"image": image.name, "image_sha256": sha256(image)}
        box = box_of(what.given) if box is None else box
    if box is not None:
        about["box"] = box_text(box)

    model = with_chosen_sets(convert_model(loaded, what, solver, about, box), output, solver)
    save_for_solver(output, model, solver)
    files: Json = {"mesh": mesh.name, "output": output.name}
    files |= {"units": solver.units, "space": solver.space}
    files |= {} if results is None else {"results": results.name}
    files |= stated_files(part)
    files |= {"transforms": [each.name for each in move.transform]} if move.transform else {}
    return Converted(model, solver, files | {"versions": versions()} | model_summary(model))


def _loads_of_file(loaded: MeshFile, choice: LabelChoice, move: MoveOptions) -> list[str] | None:
    """Return the loads of a mesh's file. Without some of its labels, their sets would be others,
    and moved by a transform, their vectors and lengths would be: warn instead.
    """
    with warnings_heard():
        loads = loads_in(loaded)
    parsed = [parse_load(text, loaded.mesh.ndim) for text in loads]
    if choice != ALL_LABELS and loads:
        reason, remedy = "were for all labels", "those of the rest"
    elif move.transform and any(len(load.numbers) > 1 and load.numbers.any() for load in parsed):
        reason, remedy = "have the old image's axes and lengths", "those of the new one"
    else:
        return loads
    warning(
        f"the file's loads {reason} and are left out: {list_names(loads)}; give {remedy} (`load`)"
    )
    return None


def _of_labels(loaded: MeshFile, choice: LabelChoice) -> MeshFile:
    """Return the mesh without the cells of labels that are left out; report it."""
    if choice == ALL_LABELS:
        return loaded
    labels = loaded.labels
    if labels is None:
        raise InputError("`keep_labels`, `drop_labels`: the cells have no labels; pass `labels`")
    present = np.unique(labels).tolist()
    names = loaded.label_table.names
    kept = kept_labels(choice.keep_labels, choice.drop_labels, present, names)
    is_kept = _without_crumbs(loaded.mesh, labels, np.isin(labels, kept))
    part = with_cells(loaded, labels, is_kept)
    left = [name for name in part.sets.facets if name.startswith(INTERFACE_PREFIX)]
    more = f"; their interfaces are sets: {list_names(left)}" if left else ""
    note(f"labels left out: {len(part.mesh.cells)} of {len(labels)} cells stay{more}")
    rebuilt = {*standard_names(loaded.mesh.ndim), *label_set_names(present, names).values()}
    for what, before, after in zip(("facets", "cells"), loaded.sets, part.sets, strict=True):
        for name, rows in before.items():
            count = len(after.get(name, ()))
            if count < len(rows) and name not in rebuilt and not name.startswith(INTERFACE_PREFIX):
                warning(
                    f'set "{name}" keeps {count} of its {len(rows)} {what}; the others are of '
                    "labels left out"
                )
    inputs = loaded.table("inputs") | {"kept_labels": kept}
    return part._replace(field_data=part.field_data | {"inputs": np.array([json.dumps(inputs)])})


def _without_crumbs(mesh: Mesh, labels: Ints, is_kept: Bools) -> Bools:
    """Return the cells that stay, (M,), without components that have little of any label; report
    these.

    No load or support would hold them: they hung on cells that are left out.
    """
    cells = np.flatnonzero(is_kept)
    volumes = mesh.cell_volumes
    number = components(mesh.cells[cells])
    share = np.zeros(number.max() + 1)
    for label in np.unique(labels[cells]):
        is_of = labels[cells] == label
        of_component = np.bincount(number[is_of], volumes[cells[is_of]], len(share))
        share = np.maximum(share, of_component / of_component.sum())
    crumbs = cells[share[number] < SMALL_COMPONENT_FRACTION]
    if len(crumbs):
        count = int((share < SMALL_COMPONENT_FRACTION).sum())
        volume = float(volumes[crumbs].sum())
        words = f"less than {SMALL_COMPONENT_FRACTION:.0%} of any label, are left out with them"
        note(
            f"{count_text(count, 'component')} ({count_text(len(crumbs), 'cell')}, {volume:.4g} "
            f"mm{mesh.ndim}), {words}"
        )
    is_kept = is_kept.copy()
    is_kept[crumbs] = False
    return is_kept


def _texts_of(loaded: MeshFile, solver: SolverOptions, *, has_new_results: bool) -> Json:
    """Return the texts of the mesh's file to keep; reactions, in RAS+ and mN, only if space and
    units are unchanged.
    """
    is_as_solved = (solver.space, solver.units) == ("ras", "kPa") and not has_new_results
    names = [
        name for name in loaded.field_data if is_as_solved and re.fullmatch(REACTIONS_TEXT, name)
    ]
    return texts_of(loaded) | {
        name: text for name in names if (text := loaded.text(name)) is not None
    }


def _with_straight_edges(loaded: MeshFile) -> MeshFile:
    """Return the mesh without curved edges, and the volumes of its cells; its other fields are
    of straight cells.
    """
    if loaded.mesh.midpoints is None:
        return loaded
    mesh = Mesh(loaded.mesh.points, loaded.mesh.cells)
    volumes = {"volume": mesh.cell_volumes} if "volume" in loaded.cell_data else {}
    return loaded._replace(mesh=mesh, cell_data=loaded.cell_data | volumes)


def with_results(loaded: MeshFile, path: Path) -> MeshFile:
    """Return the mesh with a solver's results instead of earlier ones, of the solved order;
    report the results.
    """
    results = read_frd(path, loaded.mesh)
    for line in results.notes:
        note(f"{path}: {line}")
    for name, values in results.point_data.items():
        if values.shape[1:] != (9,):  # tensors come with their von Mises stress
            largest = float(
                np.abs(values).max() if values.ndim == 1 else np.sqrt((values**2).sum(axis=1)).max()
            )
            progress(
                f"{path.name}: {name} up to {largest:.4g} {'kPa' if is_stress(name) else 'mm'}"
            )
            remedy = "check loads, units and fixed sets, unless the solver's was nonlinear"
            how = f"too large for a linear solution; {remedy}"
            if values.shape[1:] == (3,) and (words := large_words(loaded.mesh, largest, how)):
                warning(f"{path}: {name}: {words}")
    loaded = without_results(loaded)
    sets = _sets_with_input(loaded, path.with_suffix(".inp"))
    return loaded._replace(
        point_data=loaded.point_data | results.point_data, order=results.order, sets=sets
    )


def _sets_with_input(loaded: MeshFile, path: Path) -> Sets:
    """Return the mesh's sets and those of the solver's input file, if it exists and belongs to
    this mesh; note it.
    """
    is_of_mesh = False
    with suppress(InputError):
        of_input = load_mesh(path)
        is_of_mesh = np.array_equal(of_input.mesh.cells, loaded.mesh.cells)
    if not is_of_mesh:
        note(f"{path}: missing, or not the input file of this mesh; its sets are not added")
        return loaded.sets
    sets, renamed = merged_sets(loaded.sets, of_input.sets)
    for old, new in renamed.items():
        note(f'{path}: renamed set "{old}" to "{new}" (name already in use)')
    return sets


def _order_of(loaded: MeshFile, solver: SolverOptions, output: Path) -> int:
    """Return the order of the cells to write: as requested, else as in the mesh's file, if the
    format supports it.
    """
    form = format_of(output)
    if solver.order is not None or loaded.order == 1 or form.has_quadratic:
        return solver.order or loaded.order
    note(f"{output}: {form.what} has no quadratic cells; they are written as linear cells")
    return 1
