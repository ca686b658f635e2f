"""``tetopt convert``."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from tetopt import Image, InputError
from tetopt.check import check_unfolded
from tetopt.cli.console import log, out
from tetopt.cli.options import LabelledPart, MeshArgument, NumberOptions, option
from tetopt.cli.solver import print_model
from tetopt.contents.align import resample_mask
from tetopt.contents.content import continued
from tetopt.io.abaqus import input_sets
from tetopt.io.files import checked_output, save_json
from tetopt.io.formats import FORMATS, format_of
from tetopt.io.frd import read_frd
from tetopt.io.images import sha256
from tetopt.io.vtk import VTK_SUFFIXES
from tetopt.job.inputs import image_and_others, read_mesh, warn_of_other_image, with_labels
from tetopt.job.model import (
    REACTIONS_TEXT,
    check_solver_options,
    completed,
    loads_of,
    save_for_solver,
    sets_and_table,
    solver_model,
    warn_of_units,
    with_chosen_sets,
    without_stale_results,
)
from tetopt.job.options import ImagePart, SolverOptions
from tetopt.model.fields import cell_fields, is_result, is_stress
from tetopt.model.file import MATERIAL_FIELDS, TEXTS_KEPT, MeshFile
from tetopt.model.sets import Sets, box_of, box_text, merged_sets
from tetopt.report.summary import model_summary, versions


def convert_command(
    mesh_path: MeshArgument,
    output: Annotated[
        Path, typer.Argument(metavar="OUT", help=f"The file to write: {', '.join(FORMATS)}.", show_default=False)
    ],
    image_path: Annotated[
        Path | None, option("IMAGE", "Take means and laws from this image, not from the mesh's file.", "--image")
    ] = None,
    mask_path: Annotated[Path | None, option("MASK", "With --image: only what lies in it counts.", "--mask")] = None,
    results_path: Annotated[
        Path | None,
        option("JOB.frd", "Bring CalculiX's results of this mesh back onto it (VTK's formats).", "--results"),
    ] = None,
    *,
    part: LabelledPart,
    solver: SolverOptions,
    numbers: NumberOptions,
) -> int:
    """Write a mesh for a solver: materials, named sets, loads, in the format of OUT's suffix."""
    format_of(output)
    output = checked_output(output, tuple(FORMATS), numbers.force)
    json_path = numbers.checked()
    if results_path is not None and output.suffix.lower() not in VTK_SUFFIXES:
        raise InputError(f"--results: expected OUT named {' or '.join(VTK_SUFFIXES)}, got {output}")
    needs_image = {"--mask": mask_path, "--volume": part.volume, "--crop": part.crop, "--slice": part.slice_}
    if image_path is None and (lost := [name for name, value in needs_image.items() if value is not None]):
        raise InputError(f"{lost[0]}: there is no --image")
    loaded = with_labels(_unfolded(mesh_path), part.labels)
    loaded = without_stale_results(loaded, solver) if results_path is None else _with_results(loaded, results_path)
    solver = replace(solver, order=_order_of(loaded, solver, output))
    check_solver_options(output, solver, has_materials="young" in loaded.cell_data)
    if image_path is None and solver.average is not None:
        raise InputError(f"--average: {solver.average} is over an image's voxels; give the image (--image)")
    if not solver.loads and not format_of(output).is_surface:
        solver = replace(solver, loads=loads_of(loaded))
    fields, box = dict(loaded.cell_data), loaded.box
    about = _texts_of(loaded, solver, has_new_results=results_path is not None)
    image: Image | None = None
    if image_path is not None:
        whole, image = _images(image_path, mask_path, part, loaded.mesh.ndim)
        if warn_of_other_image(loaded, mesh_path, image_path):
            about = {}
        fields |= cell_fields(loaded.mesh, image)
        box = box_of(whole) if box is None else box
        about |= {"image": image_path.name, "image_sha256": sha256(image_path)}
    if box is not None:
        about["box"] = box_text(box)
    if format_of(output).is_surface:  # which holds no materials
        fields = {name: values for name, values in fields.items() if name not in MATERIAL_FIELDS}
    known_sets, words = sets_and_table(loaded, box, fields, solver)
    model = solver_model(loaded.mesh, image, solver, fields, about | words, known_sets)
    warn_of_units(model)
    model = with_chosen_sets(completed(model, loaded, solver), output, solver)
    save_for_solver(output, model, solver)
    if json_path is not None:
        files = {"mesh": mesh_path.name, "output": output.name, "units": solver.units, "space": solver.space}
        files |= {} if results_path is None else {"results": results_path.name}
        files |= {} if part.labels is None else {"labels": part.labels.name}
        save_json(json_path, files | {"versions": versions()} | model_summary(model))
    print_model(output, model, solver)
    return 0


def _unfolded(path: Path) -> MeshFile:
    """A mesh from a file; InputError if its cells overlap."""
    loaded = read_mesh(path)
    check_unfolded(loaded.mesh, source=str(path))
    return loaded


def _texts_of(loaded: MeshFile, solver: SolverOptions, *, has_new_results: bool) -> dict[str, Any]:
    """The texts of the mesh's file that go on; the forces that hold sets, which are in RAS+ and mN, only as such."""
    is_as_solved = (solver.space, solver.units) == ("ras", "kPa") and not has_new_results
    names = [name for name in loaded.field_data if is_as_solved and re.fullmatch(REACTIONS_TEXT, name)]
    return {name: text for name in (*TEXTS_KEPT, *names) if (text := loaded.text(name)) is not None}


def _with_results(loaded: MeshFile, path: Path) -> MeshFile:
    """The mesh with a solver's results in place of earlier ones, of the order that was solved; they are printed."""
    results = read_frd(path, loaded.mesh)
    for note in results.notes:
        log.print(escape(f"{path}: {note}"))
    for name, values in results.point_data.items():
        if values.shape[1:] != (9,):  # tensors have their von Mises stress beside them
            largest = float(np.abs(values).max() if values.ndim == 1 else np.sqrt((values**2).sum(axis=1)).max())
            out.print(escape(f"{path.name}: {name} up to {largest:.4g} {'kPa' if is_stress(name) else 'mm'}"))
    cell_data, point_data = (
        {name: values for name, values in data.items() if not is_result(name)}
        for data in (loaded.cell_data, loaded.point_data)
    )
    sets = _sets_with_input(loaded, path.with_suffix(".inp"))
    return loaded._replace(
        cell_data=cell_data, point_data=point_data | results.point_data, order=results.order, sets=sets
    )


def _sets_with_input(loaded: MeshFile, path: Path) -> Sets:
    """The mesh's sets and those of the solver's input file, if it is there and of this mesh; a line."""
    from_input = input_sets(path, loaded.mesh) if path.is_file() else None
    if from_input is None:
        log.print(escape(f"{path}: not the input file of this mesh, or missing: its sets are not added"))
        return loaded.sets
    sets, renamed = merged_sets(loaded.sets, from_input)
    for old, new in renamed.items():
        log.print(escape(f'{path}: renamed set "{old}" to "{new}" (name already in use)'))
    return sets


def _order_of(loaded: MeshFile, solver: SolverOptions, output: Path) -> int:
    """The order of the cells to be written: as asked for, else as in the mesh's file, if the format has it."""
    form = format_of(output)
    if solver.order is not None or loaded.order == 1 or form.has_quadratic:
        return solver.order or loaded.order
    if not form.is_surface:
        log.print(escape(f"{output}: {form.what} has no quadratic cells; the mesh's are written as linear ones"))
    return 1


def _images(path: Path, mask_path: Path | None, part: ImagePart, ndim: int) -> tuple[Image, Image]:
    """The image as it is, and as it counts: beyond the mask continued by the nearest value inside."""
    whole, beside = image_and_others(path, part)
    if whole.ndim != ndim:
        raise InputError(f"{path}: expected a {ndim}-D image, as the mesh is, got a {whole.ndim}-D one")
    return whole, continued(whole, None if mask_path is None else beside(mask_path, resample_mask))
