"""``tetopt fem``: solve a mesh with its loads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape

from tetopt import Image, InputError
from tetopt.cli.console import log, print_wide, show_warning
from tetopt.cli.options import LabelledPart, NumberOptions, option
from tetopt.io.files import checked_output, save_json
from tetopt.io.formats import save_model
from tetopt.io.images import sha256
from tetopt.io.vtk import VTK_SUFFIXES
from tetopt.job.inputs import read_image, read_mesh, warn_of_other_image, with_labels
from tetopt.job.model import (
    check_model_options,
    completed,
    loads_of,
    sets_and_table,
    solver_model,
    warn_of_units,
    with_chosen_sets,
)
from tetopt.job.options import ImagePart, ModelOptions, stated_part
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.model.fields import cell_fields, is_result
from tetopt.model.file import MeshFile
from tetopt.model.laws import ByLabel, parse_any_law
from tetopt.model.loads import MOST_COMPRESSION_PERCENT, count_of_steps
from tetopt.model.model import Model, locking_words
from tetopt.model.sets import box_of, box_text
from tetopt.report.summary import model_summary, versions
from tetopt.report.tables import new_table, nodes_in_words

if TYPE_CHECKING:
    from tetopt.fem.conditioning import Conditioning
    from tetopt.fem.solution import Solution

INTENSITY_LAW = "h"  # an image without --young: its intensities are the moduli, as in the paper
PAPER_PERCENT = 1.0  # how far the paper's test compresses, for a linear law only a scale
SHOWN_SHARE = 1e-9  # of a force's largest component: less is what an iterative solution leaves
SMALL_SHARE = 0.1  # of the mesh's length: displacements beyond it are not small, at strains of some 10 %


def fem_command(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="[IMAGE] MESH",
            help="VTU, VTK or MSH file; with moduli and loads it needs no more. Laws are of IMAGE's intensities.",
        ),
    ],
    compress: Annotated[
        float | None,
        option("PERCENT", f"Push the bottom in by this much, the top held (with IMAGE by default {PAPER_PERCENT:g})."),
    ] = None,
    conditioning: Annotated[
        bool | None,
        typer.Option(
            help="Condition number of the first step's stiffness (default: for the compression of an IMAGE's box)."
        ),
    ] = None,
    output: Annotated[
        Path | None, option("SOLVED.vtu", "Write displacements, strains and stresses on the mesh.", "-o", "--output")
    ] = None,
    *,
    model: ModelOptions,
    part: LabelledPart,
    numbers: NumberOptions,
) -> int:
    """Solve a mesh with its loads: displacements, stresses, strain energy, reactions.

    Linear elasticity, small displacements; in 2-D plane stress, 1 mm thick. Each step is a load case of its own.
    Without loads, and with IMAGE, it is the paper's test: the face of the image's box with the largest z (in 2-D y) is
    held and the one opposite pushed in, both bonded; without --young intensities are the moduli.
    """
    if len(paths) > 2:
        raise InputError(f"expected [IMAGE] MESH, got {len(paths)} files")
    image_path, mesh_path = (None, paths[0]) if len(paths) == 1 else (paths[0], paths[1])
    json_path = numbers.checked()
    if output is not None:
        output = checked_output(output, VTK_SUFFIXES, numbers.force)
    if image_path is not None:
        model = replace(model, young=model.young or INTENSITY_LAW, average=model.average or DEFAULT_AVERAGE)
    if output is None and model.written_sets is not None:
        raise InputError("--sets: no file is written; give -o SOLVED.vtu, too")
    _check_options(image_path, compress, model, part)
    image = None if image_path is None else read_image(image_path, part)
    loaded = with_labels(read_mesh(mesh_path), part.labels)
    if image_path is not None and image is not None:
        warn_of_other_image(loaded, mesh_path, image_path)
    of_box = image is not None and not model.loads
    if image is not None and of_box:
        _check_box(image, loaded)
    task = _model(loaded, image, _filled(model, loaded, image, compress))
    solutions, extremes = _solved(task, of_box if conditioning is None else conditioning)
    if output is not None:
        save_model(output, with_chosen_sets(_with_results(task, solutions), output, model))
    _advise(task, solutions)
    _print(mesh_path.name, task, model, solutions, extremes)
    if json_path is not None:
        options = {**asdict(model), "compress_percent": compress, **stated_part(part)}
        options["label_names"] = None if model.label_names is None else model.label_names.name
        files = {"mesh": mesh_path.name} | ({} if part.labels is None else {"labels": part.labels.name})
        if image_path is not None:
            files |= {"image": image_path.name, "image_sha256": sha256(image_path)}
        about = {**files, "versions": versions(), "options": options}
        save_json(json_path, {**about, **_numbers(task, solutions, extremes), **model_summary(task)})
    return 0


def _check_options(image_path: Path | None, compress: float | None, model: ModelOptions, part: ImagePart) -> None:
    """InputError for what is wrong whatever the files hold."""
    if compress is not None and not 0.0 < compress <= MOST_COMPRESSION_PERCENT:
        most = f"{MOST_COMPRESSION_PERCENT:g}"
        raise InputError(f"--compress: expected a percentage above 0 and up to {most}, got {compress:g}")
    if compress is not None and model.loads:
        raise InputError("--compress and --load: give one of them, as in --load compress:5% --load pressure:left:1.5")
    if image_path is None and (lost := [name for name, value in stated_part(part).items() if value is not None]):
        raise InputError(f"--{lost[0]}: there is no IMAGE, only a mesh")
    if image_path is None and model.average is not None:
        raise InputError("--average: it is over an image's voxels; give the IMAGE before the MESH")
    check_model_options(model, has_materials=True)


def _filled(model: ModelOptions, loaded: MeshFile, image: Image | None, compress: float | None) -> ModelOptions:
    """The options with what is left out taken from the mesh's file, or, of an image's box, from the paper's test."""
    if model.order is None:
        model = replace(model, order=loaded.order)
    if compress is not None or (image is not None and not model.loads):
        model = replace(model, loads=[f"compress:{PAPER_PERCENT if compress is None else compress!r}%"])
    elif not model.loads:
        model = replace(model, loads=loads_of(loaded))
    if model.young is None and "young" not in loaded.cell_data:
        raise InputError(
            "the mesh's file has no moduli: give --young, such as --young 3.5, or the IMAGE before the MESH"
        )
    if not model.loads:
        raise InputError(
            "the mesh's file has no loads: give --load, such as --load compress:5%, "
            "or --load hold:inferior --load pressure:superior:1.5"
        )
    return model


def _check_box(image: Image, loaded: MeshFile) -> None:
    """InputError unless the mesh fills the image's box: what is compressed is the box."""
    from tetopt.fem.elasticity import box_faces, check_fills_box

    box_faces(image, loaded.mesh)
    check_fills_box(image, loaded.mesh)


def _model(loaded: MeshFile, image: Image | None, options: ModelOptions) -> Model:
    """The mesh with all that it is solved with."""
    fields = {name: values for name, values in loaded.cell_data.items() if not is_result(name)}
    box = loaded.box if image is None else box_of(image)
    if image is not None:
        fields |= cell_fields(loaded.mesh, image)
    about = {} if box is None else {"box": box_text(box)}
    sets, words = sets_and_table(loaded, box, fields, options)
    others = {name: values for name, values in loaded.point_data.items() if not is_result(name)}
    model = solver_model(loaded.mesh, image, options, fields, about | words, sets)
    if options.young != INTENSITY_LAW:  # which has no units
        warn_of_units(model)
    return completed(model, loaded._replace(point_data=others), options)


def _solved(model: Model, is_conditioned: bool) -> tuple[list[Solution], Conditioning | None]:
    """Each step solved, and the conditioning of the first, if it is to be known."""
    from tetopt.fem.conditioning import conditioning
    from tetopt.fem.solution import solve

    try:
        solutions = [solve(model, step) for step in range(1, count_of_steps(model.loads) + 1)]
        return solutions, conditioning(solutions[0].system) if is_conditioned else None
    except RuntimeError as error:
        raise InputError(f"{error}; the moduli differ too much, or nu is too near 0.5, for this mesh") from error


def _with_results(model: Model, solutions: list[Solution]) -> Model:
    """The model with what was found on its cells and nodes, and the reactions among its texts."""
    from tetopt.fem.solution import solution_fields

    cell_data, point_data, about = dict(model.cell_data), dict(model.point_data), dict(model.about)
    for step, solution in enumerate(solutions, start=1):
        fields = solution_fields(model.mesh, solution, step)
        cell_data |= fields.cell_data
        point_data |= fields.point_data
        about["reactions" if step == 1 else f"reactions_step{step}"] = _lists(solution.reactions)
    return model._replace(cell_data=cell_data, point_data=point_data, about=about)


def _lists(reactions: dict[str, NDArray[np.float64]]) -> dict[str, list[float]]:
    return {name: force.tolist() for name, force in reactions.items()}


def _advise(model: Model, solutions: list[Solution]) -> None:
    """Lines where the cells are of the wrong order for the material, or the displacements too large for the method."""
    if words := locking_words(model):
        show_warning(words)
    size = float(np.ptp(model.mesh.points, axis=0).max())
    moved = max(float(np.sqrt((solution.u**2).sum(axis=1).max())) for solution in solutions)
    if moved > SMALL_SHARE * size:
        log.print(
            f"the largest displacement, {moved:.4g} mm, is {moved / size:.0%} of the mesh's length: small "
            "displacements, which this solves, no longer hold; look at the loads and at what is held, or write a file "
            "for CalculiX with --nonlinear"
        )


def _of_what(model: Model, options: ModelOptions) -> Iterator[tuple[str, str]]:
    """Rows that tell what the moduli are of: the law, how it was averaged, the ratios."""
    assert model.materials is not None, "it has been solved"
    yield "law of the modulus", "of the mesh's file" if options.young is None else escape(options.young)
    if model.node_young is not None:
        yield "modulus within a cell", "linear between its nodes"
    elif model.gauss_young is not None:
        yield "modulus within a cell", "one around each Gauss point"
    elif options.average is not None and not isinstance(parse_any_law(str(options.young)), ByLabel):
        yield "average over a cell", options.average
    low, high = model.materials.nu.min(), model.materials.nu.max()
    yield "Poisson's ratio", f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def _print(
    name: str, model: Model, options: ModelOptions, solutions: list[Solution], extremes: Conditioning | None
) -> None:
    """A table of a column for each step."""
    steps = [f"step {step}" for step in range(1, len(solutions) + 1)] if len(solutions) > 1 else [""]
    table = new_table(escape(name), *steps)
    moduli = [solutions[0].young.min(), solutions[0].young.max()]
    table.add_row("size", f"{nodes_in_words(model.mesh, model.order)}, {len(model.mesh.cells)} cells")
    table.add_row("modulus of the cells, kPa", f"{moduli[0]:.4g} to {moduli[1]:.4g}")
    for title, words in _of_what(model, options):
        table.add_row(title, words)
    of_step = [_numbers_of(solution) for solution in solutions]
    table.add_row("largest displacement, mm", *(f"{each['largest_displacement']:.5g}" for each in of_step))
    table.add_row("largest von Mises stress of a cell, kPa", *(f"{each['largest_von_mises']:.5g}" for each in of_step))
    table.add_row("strain energy, uJ", *(f"{each['strain_energy']:.8g}" for each in of_step))
    if any(solution.spring_energy for solution in solutions):
        table.add_row("energy of the springs, uJ", *(f"{each['spring_energy']:.8g}" for each in of_step))
    for set_name in dict.fromkeys(name for solution in solutions for name in solution.reactions):
        forces = (solution.reactions.get(set_name) for solution in solutions)
        row = ("" if force is None else _vector(force) for force in forces)
        table.add_row(f"reaction of {escape(set_name)}, mN", *row)
    table.add_row("sum of the other forces, mN", *(_vector(each.applied) for each in solutions))
    table.add_row("multigrid CG iterations (0: factorised)", *(str(each.n_iterations) for each in solutions))
    if extremes is not None:
        unit = "mN/mm" if model.mesh.ndim == 3 else "mN/mm per mm of thickness"
        table.add_row(f"largest eigenvalue of the stiffness, {unit}", f"{extremes.lambda_max:.6g}")
        table.add_row("condition number, 2-norm", f"{extremes.cond:.6g}")
        table.add_row("Jacobi CG iterations to 1e-10", str(extremes.cg_iterations))
    print_wide(table)


def _vector(force: NDArray[np.float64]) -> str:
    """The components of a force; what is rounding beside the largest is 0."""
    shown = np.where(np.abs(force) > SHOWN_SHARE * np.abs(force).max(), force, 0.0)
    return ", ".join(f"{part:.6g}" for part in shown)


def _numbers_of(solution: Solution) -> dict[str, Any]:
    """The numbers of a step for the JSON file."""
    from tetopt.fem.solution import von_mises

    return {
        "strain_energy": solution.strain_energy,
        "spring_energy": solution.spring_energy,
        "work": solution.work,
        "largest_displacement": float(np.sqrt((solution.u**2).sum(axis=1).max())),
        "largest_von_mises": float(von_mises(solution.stress).mean(axis=1).max()),
        "reactions": _lists(solution.reactions),
        "applied": solution.applied.tolist(),
        "iterations": solution.n_iterations,
    }


def _numbers(model: Model, solutions: list[Solution], extremes: Conditioning | None) -> dict[str, Any]:
    """All numbers for the JSON file; the strain energy is the first step's."""
    numbers: dict[str, Any] = {
        "n_nodes": len(model.mesh.points),
        "n_nodes_in_all": len(solutions[0].u),
        "n_cells": len(model.mesh.cells),
        "order": model.order,
        "young_kPa_min": float(solutions[0].young.min()),
        "young_kPa_max": float(solutions[0].young.max()),
        "strain_energy": solutions[0].strain_energy,
        "steps": [_numbers_of(solution) for solution in solutions],
    }
    if extremes is not None:
        numbers |= {"lambda_max": extremes.lambda_max, "cond": extremes.cond, "cg_iterations": extremes.cg_iterations}
    units = {"lambda_max": "mN/mm", "strain_energy": "uJ", "reactions": "mN", "largest_von_mises": "kPa"}
    return numbers | {"units": units}
