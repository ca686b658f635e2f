"""``tetopt convert``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tetopt.cli.console import print_line, show_event
from tetopt.cli.options import NumberOptions, mesh_and_image
from tetopt.cli.solver import print_model
from tetopt.errors import InputError
from tetopt.io.formats import FORMATS, format_of
from tetopt.job.convert import convert_file
from tetopt.job.events import Event, listened
from tetopt.job.options import LabelledPart, Option, SolverOptions
from tetopt.system.files import checked_output


def convert_command(
    paths: Annotated[
        list[Path],
        Option(
            "[IMAGE] MESH OUT",
            f"The mesh, and the file to write: {', '.join(FORMATS)}. An image before them is that of `image`.",
            is_argument=True,
        ),
    ],
    image_path: Annotated[
        Path | None, Option("IMAGE", "Apply mappings to this image, not to the mesh file's means.", "image")
    ] = None,
    results_path: Annotated[
        Path | None,
        Option("JOB.frd", "Add CalculiX's results for this mesh (VTK formats only).", "results"),
    ] = None,
    *,
    part: LabelledPart,
    solver: SolverOptions,
    numbers: NumberOptions,
) -> int:
    """Write a mesh for a solver, with materials, named sets and loads, in the format of OUT's suffix."""
    if len(paths) < 2:
        raise InputError(f"expected MESH and OUT, the file to write, got only {paths[0]}")
    mesh_path, image_path = mesh_and_image(paths[:-1], image_path)
    output = paths[-1]
    format_of(output)
    output = checked_output(output, tuple(FORMATS), numbers.force)
    numbers.check()
    with listened(_show):
        converted = convert_file(mesh_path, output, solver=solver, part=part, image=image_path, results=results_path)
    numbers.save(converted.numbers)
    print_model(output, converted.model, converted.options)
    return 0


def _show(event: Event) -> None:
    """Show an event; the magnitudes of results go to standard output."""
    if event.kind == "progress":
        print_line(event.text)
    else:
        show_event(event)
