"""``tetopt fem``: compress a mesh."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

import tetopt
from tetopt import InputError, Mesh, save_mesh
from tetopt.cli.console import out
from tetopt.cli.inputs import check_no_input, read_image, read_mesh
from tetopt.cli.options import ImageArgument, ImagePart, LawOptions, NumberOptions, option
from tetopt.io.files import checked_output, save_json
from tetopt.io.images import sha256
from tetopt.model.averages import parse_average
from tetopt.report.summary import versions
from tetopt.report.tables import new_table

if TYPE_CHECKING:
    from tetopt.study.paper import Simulated


def fem_command(
    image_path: ImageArgument,
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU, VTK or MSH file that fills the image's box.")],
    compress: Annotated[float, option("PERCENT", "How far the bottom is pushed in.")] = 1.0,
    output: Annotated[
        Path | None, option("PRESSED.vtu", "Write the mesh with displacements and strains.", "-o", "--output")
    ] = None,
    *,
    moduli: LawOptions,
    part: ImagePart,
    numbers: NumberOptions,
) -> int:
    """Compress a mesh, one modulus a cell: conditioning of the stiffness matrix, strain energy, CG iterations.

    The face of the image's box with the largest z is held, the one opposite is pushed in along z; both are bonded:
    their nodes cannot slide sideways. In 2-D y takes the place of z, in plane stress, 1 mm thick. Linear cells lock
    near nu = 0.5: above 0.49 they are far too stiff.
    """
    from tetopt.fem.elasticity import strains
    from tetopt.model.laws import parse_law
    from tetopt.study.paper import simulate

    json_path = numbers.checked()
    if output is not None:
        output = checked_output(output, (".vtu",), numbers.force)
        check_no_input(output, mesh_path)
    if not 0.0 < compress <= 50.0:
        raise InputError(f"--compress: expected a percentage above 0 and up to 50, got {compress:g}")
    law = None if moduli.young is None else parse_law(moduli.young)
    parse_average(moduli.average)
    image = read_image(image_path, part)
    mesh = read_mesh(mesh_path).mesh
    try:
        simulation, pressed = simulate(image, mesh, moduli.nu, compress, law, moduli.average)
    except RuntimeError as error:
        raise InputError(f"{error}; the moduli differ too much, or nu is too near 0.5, for this mesh") from error
    if output is not None:
        fields = {"young": simulation.young, "strain": strains(mesh, pressed.u).reshape(len(simulation.young), -1)}
        save_mesh(output, mesh, fields, {"tetopt": tetopt.__version__}, {"displacement": pressed.u})
    _print(simulation, mesh, mesh_path.name, compress)
    if json_path is not None:
        options = {**asdict(moduli), "compress_percent": compress, **part.stated()}
        files = {"image": image_path.name, "image_sha256": sha256(image_path), "mesh": mesh_path.name}
        save_json(json_path, {**files, "versions": versions(), "options": options, **_numbers(simulation, mesh)})
    return 0


def _print(simulation: Simulated, mesh: Mesh, name: str, compress: float) -> None:
    """The table of a compression by so many per cent."""
    table = new_table("", escape(name))
    table.add_row("nodes", str(len(mesh.points)))
    table.add_row("modulus of the cells, kPa", f"{simulation.young.min():.4g} to {simulation.young.max():.4g}")
    unit = "mN/mm" if mesh.ndim == 3 else "mN/mm per mm of thickness"
    table.add_row(f"largest eigenvalue of the stiffness, {unit}", f"{simulation.lambda_max:.6g}")
    table.add_row("condition number, 2-norm", f"{simulation.cond:.6g}")
    table.add_row("Jacobi CG iterations to 1e-10", str(simulation.cg_iterations))
    table.add_row(f"strain energy at {compress:g} %, uJ", f"{simulation.strain_energy:.6g}")
    out.print(table)


def _numbers(simulation: Simulated, mesh: Mesh) -> dict[str, Any]:
    """The numbers of a compression for its JSON file."""
    size = {"n_nodes": len(mesh.points), "n_cells": len(mesh.cells)}
    moduli = {"young_kPa_min": simulation.young.min(), "young_kPa_max": simulation.young.max()}
    numbers = {key: value for key, value in simulation._asdict().items() if key != "young"}
    return {**size, **moduli, **numbers, "units": {"lambda_max": "mN/mm", "strain_energy": "uJ"}}
