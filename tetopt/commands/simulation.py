"""Solution of a mesh's file with its loads, or of an image's box compressed as in the paper."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tetopt.commands.beside import check_part, stated_files, voxels_of
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.formats import save_model
from tetopt.io.images import sha256
from tetopt.job.events import warning, warnings_heard
from tetopt.job.mesh_file import read_mesh
from tetopt.job.options import LabelledPart, ModelOptions, stated_part
from tetopt.job.solver_files import (
    check_model_options,
    convert_model,
    large_words,
    with_chosen_sets,
)
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.model.file import MeshFile, loads_in, texts_of, without_results
from tetopt.model.loads import MOST_COMPRESSION_PERCENT, count_of_steps
from tetopt.model.model import Model, locking_words
from tetopt.model.sets import box_of, box_text
from tetopt.report.summary import model_summary, versions
from tetopt.system.arrays import Floats, Json

if TYPE_CHECKING:
    from tetopt.fem.conditioning import Conditioning
    from tetopt.fem.solution import Solution

# without a modulus, the image's intensities are the moduli, as in the paper
INTENSITY_MAPPING = "h"
PAPER_PERCENT = 1.0  # compression of the paper's test, only a scale for a linear law


class SolvedModel(NamedTuple):
    """The solution of a mesh."""

    model: Model
    options: ModelOptions  # with their defaults
    solutions: list[Solution]  # of each step
    extremes: Conditioning | None
    numbers: Json  # all numbers, as `tetopt fem --json` writes them


def solve_file(
    mesh: Path,
    image: Path | None = None,
    output: Path | None = None,
    *,
    model: ModelOptions,
    part: LabelledPart,
    compress: float | None = None,
    conditioning: bool | None = None,
) -> SolvedModel:
    """Solve a mesh with its loads, and write the results.

    Parameters
    ----------
    mesh : Path
    image : Path, optional
        Source of mappings. Without loads its box is compressed; without a mapping its intensities
        are the moduli.
    output : Path, optional
        A VTK file for the mesh with displacements, strains and stresses.
    model : ModelOptions
    part : LabelledPart
    compress : float, optional
        Compression of the box in percent, instead of other loads.
    conditioning : bool, optional
        Whether to compute the first step's condition number; by default only for a compressed box.

    Raises
    ------
    InputError
        Files cannot be read or do not belong together; the mesh has no moduli or loads, or is not
        fixed.
    """
    if image is not None:
        model = replace(
            model, young=model.young or INTENSITY_MAPPING, average=model.average or DEFAULT_AVERAGE
        )
    _check_options(image, compress, model, part)
    task = _model(mesh, image, model, part, compress)
    of_box = image is not None and not model.loads
    solutions, extremes = _solve_steps(task, of_box if conditioning is None else conditioning)
    if output is not None:
        save_model(output, with_chosen_sets(_with_results(task, solutions), output, model))
    _advise(task, solutions)
    options = {**asdict(model), "compress_percent": compress, **stated_part(part)}
    options["label_names"] = None if model.label_names is None else model.label_names.name
    files = {"mesh": mesh.name} | stated_files(part)
    if image is not None:
        files |= {"image": image.name, "image_sha256": sha256(image)}
    about = {**files, "versions": versions(), "options": options}
    numbers = {**about, **_numbers(task, solutions, extremes), **model_summary(task)}
    return SolvedModel(task, model, solutions, extremes, numbers)


def _check_options(
    image: Path | None, compress: float | None, model: ModelOptions, part: LabelledPart
) -> None:
    """Raise InputError for options that are invalid for any file."""
    if compress is not None and not 0.0 < compress <= MOST_COMPRESSION_PERCENT:
        most = f"{MOST_COMPRESSION_PERCENT:g}"
        raise InputError(
            f"`compress`: expected a percentage above 0 and up to {most}, got {compress:g}"
        )
    if compress is not None and model.loads:
        raise InputError(
            "`compress` and `loads`: combine them as `loads` compress:5% `loads` pressure:left:1.5"
        )
    check_part(image, part, part.labels)
    if image is None and model.average is not None and not model.fields:
        raise InputError("`average`: averages over an image's voxels; pass `image` or `fields`")
    check_model_options(model, has_materials=True)


def _fill_options(
    model: ModelOptions, loaded: MeshFile, image: Image | None, compress: float | None
) -> ModelOptions:
    """Return the options, completed from the mesh's file, or for an image's box from the paper's
    test.
    """
    if model.order is None:
        model = replace(model, order=loaded.order)
    if compress is not None or (image is not None and not model.loads):
        model = replace(
            model, loads=[f"compress:{PAPER_PERCENT if compress is None else compress!r}%"]
        )
    elif not model.loads:
        with warnings_heard():
            model = replace(model, loads=loads_in(loaded))
    if model.young is None and "young" not in loaded.cell_data:
        raise InputError(
            "the mesh's file has no moduli: pass `young`, such as `young` 3.5, or `image`"
        )
    if not model.loads:
        raise InputError(
            "the mesh's file has no loads, or its format keeps none: pass `loads`, such as `loads` "
            "compress:5%, or `loads` hold:inferior `loads` pressure:superior:1.5"
        )
    return model


def _check_box(image: Image, loaded: MeshFile) -> None:
    """Raise InputError unless the mesh fills the image's box, which is compressed."""
    from tetopt.fem.elasticity import box_faces, check_fills_box

    box_faces(image, loaded.mesh)
    check_fills_box(image, loaded.mesh)


def _model(
    path: Path, image: Path | None, model: ModelOptions, part: LabelledPart, compress: float | None
) -> Model:
    """Build the model to solve, of the mesh's file and the image."""
    read, of_box = without_results(read_mesh(path, part)), not model.loads
    loaded, what, is_other = voxels_of(read, path, image, part, part.labels, fills_box=of_box)
    about = texts_of(loaded, is_other=is_other)
    box = loaded.box
    whole = None
    if what is not None:
        whole = what.given
        if of_box:
            _check_box(whole, loaded)
        box = box_of(whole)
    about |= {} if box is None else {"box": box_text(box)}
    model = _fill_options(model, loaded, whole, compress)
    return convert_model(
        loaded, what, model, about, box, has_units=model.young != INTENSITY_MAPPING
    )


def _solve_steps(model: Model, is_conditioned: bool) -> tuple[list[Solution], Conditioning | None]:
    """Solve each step, and compute the conditioning of the first if requested."""
    from tetopt.fem.conditioning import conditioning
    from tetopt.fem.solution import solve

    try:
        solutions = [solve(model, step) for step in range(1, count_of_steps(model.loads) + 1)]
        return solutions, conditioning(solutions[0].system) if is_conditioned else None
    except RuntimeError as error:
        raise InputError(
            f"{error}; for this mesh the moduli differ too much, or nu is too close to 0.5"
        ) from error


def _with_results(model: Model, solutions: list[Solution]) -> Model:
    """Return the model with the solutions' fields, and the reactions among its texts."""
    from tetopt.fem.solution import solution_fields

    cell_data = dict(model.cell_data)
    point_data = dict(model.point_data)
    about = dict(model.about)
    for step, solution in enumerate(solutions, start=1):
        fields = solution_fields(model.mesh, solution, step)
        cell_data |= fields.cell_data
        point_data |= fields.point_data
        about["reactions" if step == 1 else f"reactions_step{step}"] = _lists(solution.reactions)
    return model._replace(cell_data=cell_data, point_data=point_data, about=about)


def _lists(reactions: dict[str, Floats]) -> dict[str, list[float]]:
    return {name: force.tolist() for name, force in reactions.items()}


def _advise(model: Model, solutions: list[Solution]) -> None:
    """Warn if the order is unsuitable for the material, or the displacements are too large for
    the method.
    """
    if words := locking_words(model):
        warning(words)
    moved = max(float(np.sqrt((solution.u**2).sum(axis=1).max())) for solution in solutions)
    remedy = "check loads and fixed sets, or write a file for CalculiX with `nonlinear`"
    if (
        large := large_words(model.mesh, moved, f"too large for this linear solution; {remedy}")
    ) is not None:
        warning(large)


def _numbers_of(solution: Solution) -> Json:
    """Return the numbers of a step for the JSON file."""
    from tetopt.fem.elasticity import cell_means
    from tetopt.fem.solution import von_mises

    return {
        "strain_energy": solution.strain_energy,
        "spring_energy": solution.spring_energy,
        "work": solution.work,
        "largest_displacement": float(np.sqrt((solution.u**2).sum(axis=1).max())),
        "largest_von_mises": float(cell_means(von_mises(solution.stress)).max()),
        "reactions": _lists(solution.reactions),
        "applied": solution.applied.tolist(),
        "iterations": solution.n_iterations,
    }


def _numbers(model: Model, solutions: list[Solution], extremes: Conditioning | None) -> Json:
    """Return all numbers for the JSON file; the strain energy is the first step's."""
    numbers: Json = {
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
        numbers |= {
            "lambda_max": extremes.lambda_max,
            "cond": extremes.cond,
            "cg_iterations": extremes.cg_iterations,
        }
    units = {
        "lambda_max": "mN/mm",
        "strain_energy": "uJ",
        "reactions": "mN",
        "largest_von_mises": "kPa",
    }
    return numbers | {"units": units}
