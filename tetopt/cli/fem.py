"""``tetopt fem``: solve a mesh with its loads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.markup import escape

from tetopt import InputError
from tetopt.cli.console import print_table
from tetopt.cli.options import FilesArgument, NumberOptions, mesh_and_image
from tetopt.commands.simulation import PAPER_PERCENT, SolvedModel, solve_file
from tetopt.io.vtk import VTK_SUFFIXES
from tetopt.job.field_files import scalar_names
from tetopt.job.options import LabelledPart, ModelOptions, Option
from tetopt.model.mappings import ByLabel, parse_any_mapping
from tetopt.report.tables import new_table, nodes_in_words, range_words
from tetopt.system.arrays import Floats
from tetopt.system.files import check_output

STEPS_BESIDE = 3  # columns of a table
# of a force's largest component: less is the residual of an iterative solution
SHOWN_FRACTION = 1e-9


def fem_command(
    paths: FilesArgument,
    image_path: Annotated[
        Path | None,
        Option(
            "IMAGE",
            "Apply mappings to this image; optional if the file has moduli and loads.",
            "image",
        ),
    ] = None,
    compress: Annotated[
        float | None,
        Option(
            "PERCENT",
            f"Push the bottom in by PERCENT, top fixed (default {PAPER_PERCENT:g} with an IMAGE).",
        ),
    ] = None,
    conditioning: Annotated[
        bool | None,
        Option(
            None,
            "Condition number of the first step's stiffness (default: only when compressing an "
            "IMAGE's box).",
            "conditioning/--no-conditioning",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        Option("SOLVED.vtu", "Write displacements, strains and stresses on the mesh.", letter="o"),
    ] = None,
    *,
    model: ModelOptions,
    part: LabelledPart,
    numbers: NumberOptions,
) -> int:
    """Solve a mesh with its loads: displacements, stresses, strain energy, reactions.

    Linear elasticity, small displacements; in 2-D plane stress, 1 mm thick. Each step is an
    independent load case. With IMAGE and without loads, this is the paper's test: the face of the
    image's box with the largest z (y in 2-D) is fixed and the opposite face pushed in, both bonded;
    without --young the intensities are the moduli.
    """
    mesh_path, image_path = mesh_and_image(paths, image_path)
    numbers.check()
    if output is not None:
        output = check_output(output, VTK_SUFFIXES, numbers.force)
    elif model.written_sets is not None:
        raise InputError("--sets: no file is written; add -o SOLVED.vtu")
    files = (mesh_path, image_path, output)
    solved = solve_file(
        *files, model=model, part=part, compress=compress, conditioning=conditioning
    )
    for first in range(0, len(solved.solutions), STEPS_BESIDE):
        _print(mesh_path.name, solved, slice(first, first + STEPS_BESIDE))
    numbers.save(solved.numbers)
    return 0


def _of_what(solved: SolvedModel) -> Iterator[tuple[str, str]]:
    """Yield rows on the moduli: the mapping, its average, Poisson's ratios."""
    model = solved.model
    options = solved.options
    nu = solved.numbers["materials"]["nu"]
    yield (
        "modulus mapping",
        "from the mesh's file" if options.young is None else escape(options.young),
    )
    if model.materials is not None and (along := model.materials.along) is not None:
        shear = range_words(along.shear_along)
        yield "along fibres, kPa", f"{range_words(along.young_along)}, shear modulus {shear}"
    if model.node_young is not None:
        yield "modulus within a cell", "linear between its nodes"
    elif model.gauss_young is not None:
        yield "modulus within a cell", "one per Gauss point"
    elif options.average is not None and not isinstance(
        parse_any_mapping(str(options.young), fields=scalar_names(options.fields)), ByLabel
    ):
        yield "average over a cell", options.average
    yield "Poisson's ratio", range_words(nu)


def _print(name: str, solved: SolvedModel, shown: slice) -> None:
    """Print a table with a column for each of some steps; that of the first ones describes the
    model, too.
    """
    model = solved.model
    solutions = solved.solutions[shown]
    extremes = solved.extremes if shown.start == 0 else None
    names = [f"step {step}" for step in range(1, len(solved.solutions) + 1)]
    table = new_table(escape(name), *(names[shown] if len(names) > 1 else [""]))
    if shown.start == 0:
        moduli = [solutions[0].young.min(), solutions[0].young.max()]
        table.add_row(
            "size", f"{nodes_in_words(model.mesh, model.order)}, {len(model.mesh.cells)} cells"
        )
        table.add_row("modulus of the cells, kPa", f"{moduli[0]:.4g} to {moduli[1]:.4g}")
        for title, words in _of_what(solved):
            table.add_row(title, words)
    of_step = solved.numbers["steps"][shown]
    table.add_row(
        "largest displacement, mm", *(f"{each['largest_displacement']:.5g}" for each in of_step)
    )
    table.add_row(
        "largest von Mises stress of a cell, kPa",
        *(f"{each['largest_von_mises']:.5g}" for each in of_step),
    )
    table.add_row("strain energy, uJ", *(f"{each['strain_energy']:.8g}" for each in of_step))
    if any(solution.spring_energy for solution in solutions):
        table.add_row(
            "energy of the springs, uJ", *(f"{each['spring_energy']:.8g}" for each in of_step)
        )
    for set_name in dict.fromkeys(name for solution in solutions for name in solution.reactions):
        forces = (solution.reactions.get(set_name) for solution in solutions)
        row = ("" if force is None else _vector(force) for force in forces)
        table.add_row(f"reaction of {escape(set_name)}, mN", *row)
    table.add_row("sum of the other forces, mN", *(_vector(each.applied) for each in solutions))
    table.add_row(
        "multigrid CG iterations (0: factorised)", *(str(each.n_iterations) for each in solutions)
    )
    if extremes is not None:
        unit = "mN/mm" if model.mesh.ndim == 3 else "mN/mm per mm of thickness"
        table.add_row(f"largest eigenvalue of the stiffness, {unit}", f"{extremes.lambda_max:.6g}")
        table.add_row("condition number, 2-norm", f"{extremes.cond:.6g}")
        table.add_row("Jacobi CG iterations to 1e-10", str(extremes.cg_iterations))
    print_table(table)


def _vector(force: Floats) -> str:
    """Format the components of a force; those within rounding of the largest are 0."""
    shown = np.where(np.abs(force) > SHOWN_FRACTION * np.abs(force).max(), force, 0.0)
    return ", ".join(f"{part:.6g}" for part in shown)
