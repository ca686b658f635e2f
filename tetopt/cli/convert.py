"""``tetopt convert``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tetopt.cli.console import print_line, show_event
from tetopt.cli.options import NumberOptions, mesh_and_image
from tetopt.cli.solver import print_model
from tetopt.commands.conversion import convert_file
from tetopt.commands.voxel_fields import is_image_name, write_on_image
from tetopt.errors import InputError
from tetopt.io.formats import FORMATS, format_of
from tetopt.io.images import OUTPUT_SUFFIXES
from tetopt.io.meshes import MESH_SUFFIXES
from tetopt.job.events import Event, listen_with
from tetopt.job.options import (
    LabelChoice,
    LabelledPart,
    MeshPart,
    MoveOptions,
    Option,
    SolverOptions,
    VoxelOptions,
    given_options,
)
from tetopt.system.files import check_output


def convert_command(
    paths: Annotated[
        list[Path],
        Option(
            "[IMAGE] MESH OUT",
            f"The mesh, and the file to write: {', '.join(FORMATS)}, or an image: "
            f"{', '.join(OUTPUT_SUFFIXES)}. An image before them is that of `image`.",
            is_argument=True,
        ),
    ],
    image_path: Annotated[
        Path | None,
        Option("IMAGE", "Apply mappings to this image, not to the mesh file's means.", "image"),
    ] = None,
    results_path: Annotated[
        Path | None,
        Option(
            "JOB.frd", "Add CalculiX's results for this mesh (VTK formats and images).", "results"
        ),
    ] = None,
    *,
    part: LabelledPart,
    choice: LabelChoice,
    solver: SolverOptions,
    voxels: VoxelOptions,
    move: MoveOptions,
    numbers: NumberOptions,
) -> int:
    """Write a mesh for a solver, in the format of OUT's suffix, or a field of it on the voxels
    of an image.
    """
    if len(paths) < 2:
        raise InputError(f"expected MESH and OUT, the file to write, got only {paths[0]}")
    mesh_path, image_path = mesh_and_image(paths[:-1], image_path)
    output = paths[-1]
    is_image = is_image_name(paths[-1])
    _check_options(output, voxels if not is_image else None, part, choice, solver, move)
    if output.exists() and not numbers.force and output.suffix.lower() in MESH_SUFFIXES:
        raise InputError(
            f"{output}: exists, and is the file to write: MESH comes first (are {mesh_path} and "
            f"{output} swapped?); `force` replaces it"
        )
    output = check_output(output, OUTPUT_SUFFIXES if is_image else tuple(FORMATS), numbers.force)
    numbers.check()
    with listen_with(_show):
        if is_image:
            numbers.save(
                write_on_image(
                    mesh_path,
                    output,
                    voxels,
                    field=solver.written_fields,
                    like=image_path,
                    results=results_path,
                    space=solver.space,
                    part=part,
                )
            )
            return 0
        converted = convert_file(
            mesh_path,
            output,
            solver=solver,
            part=part,
            choice=choice,
            image=image_path,
            results=results_path,
            move=move,
        )
    numbers.save(converted.numbers)
    print_model(output, converted.model, converted.options)
    return 0


def _check_options(
    output: Path,
    voxels: VoxelOptions | None,
    part: LabelledPart,
    choice: LabelChoice,
    solver: SolverOptions,
    move: MoveOptions,
) -> None:
    """Raise InputError for an option of images with a mesh's file, which has `voxels`, or the
    other way round.
    """
    if voxels is not None:
        try:
            format_of(output)
        except InputError as error:
            raise InputError(f"{error}; of images, {', '.join(OUTPUT_SUFFIXES)}") from error
        wrong = given_options(voxels)
        what = "a mesh's file; name an image, such as field.nii.gz"
    else:
        own = replace(part, registered=False, **vars(MeshPart()))
        wrong = given_options(own) | given_options(choice) | given_options(move)
        wrong |= given_options(replace(solver, space="ras", written_fields=None))
        what = "an image, on all voxels of `like`"
    if wrong:
        raise InputError(f"--{next(iter(wrong))}: has no effect on {output}, {what}")


def _show(event: Event) -> None:
    """Show an event; the magnitudes of results go to standard output."""
    if event.kind == "progress":
        print_line(event.text)
    else:
        show_event(event)
