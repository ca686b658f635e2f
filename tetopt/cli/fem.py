"""``tetopt fem``: compress a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

import tetopt
from tetopt import InputError, save_mesh
from tetopt.cli.console import out
from tetopt.cli.inputs import check_no_input, read_image, read_mesh
from tetopt.cli.options import CropOption, ForceOption, ImageArgument, JsonOption, SliceOption, VolumeOption
from tetopt.io.files import checked_output, save_json
from tetopt.io.images import sha256
from tetopt.model.materials import DEFAULT_NU
from tetopt.report.summary import versions
from tetopt.report.tables import new_table


def fem_command(
    image_path: ImageArgument,
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU, VTK or MSH file that fills the image's box.")],
    young: Annotated[
        str | None,
        typer.Option(
            metavar="LAW",
            help='Modulus in kPa by intensity: a table "0:1,100:5", interpolated, or a formula of h, such as '
            '"0.5 + 0.01*h" or "1/max(abs(h), 0.001)" of a strain image. Default: the intensity.',
        ),
    ] = None,
    nu: Annotated[float, typer.Option(metavar="NU", help="Poisson's ratio, above -1 and below 0.5.")] = DEFAULT_NU,
    compress: Annotated[float, typer.Option(metavar="PERCENT", help="How far the bottom is pushed in.")] = 1.0,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="PRESSED.vtu", help="Write the mesh with displacements and strains."),
    ] = None,
    volume: VolumeOption = None,
    crop: CropOption = None,
    slice_: SliceOption = None,
    json_path: JsonOption = None,
    force: ForceOption = False,
) -> int:
    """Compress a mesh, one modulus a cell: conditioning of the stiffness matrix, strain energy, CG iterations.

    The face of the image's box with the largest z is held, the one opposite is pushed in along z; both are bonded:
    their nodes cannot slide sideways. In 2-D y takes the place of z, in plane stress, 1 mm thick. Linear cells lock
    near nu = 0.5: above 0.49 they are far too stiff.
    """
    from tetopt.fem.elasticity import strains
    from tetopt.model.laws import parse_law
    from tetopt.study.paper import simulate

    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    if output is not None:
        output = checked_output(output, (".vtu",), force)
        check_no_input(output, mesh_path)
    if not 0.0 < compress <= 50.0:
        raise InputError(f"--compress: expected a percentage above 0 and up to 50, got {compress:g}")
    law = None if young is None else parse_law(young)
    image = read_image(image_path, volume, crop, slice_)
    loaded = read_mesh(mesh_path)
    try:
        found, pressed = simulate(image, loaded.mesh, nu=nu, percent=compress, law=law)
    except RuntimeError as error:
        raise InputError(f"{error}; the moduli differ too much, or nu is too near 0.5, for this mesh") from error
    if output is not None:
        fields = {"young": found.young, "strain": strains(loaded.mesh, pressed.u).reshape(len(found.young), -1)}
        save_mesh(output, loaded.mesh, fields, {"tetopt": tetopt.__version__}, {"displacement": pressed.u})
    table = new_table("", escape(mesh_path.name))
    table.add_row("nodes", str(len(loaded.mesh.points)))
    table.add_row("modulus of the cells, kPa", f"{found.young.min():.4g} to {found.young.max():.4g}")
    unit = "mN/mm" if loaded.mesh.ndim == 3 else "mN/mm per mm of thickness"
    table.add_row(f"largest eigenvalue of the stiffness, {unit}", f"{found.lambda_max:.6g}")
    table.add_row("condition number, 2-norm", f"{found.cond:.6g}")
    table.add_row("Jacobi CG iterations to 1e-10", str(found.cg_iterations))
    table.add_row(f"strain energy at {compress:g} %, uJ", f"{found.strain_energy:.6g}")
    out.print(table)
    if json_path is not None:
        options = {
            "young": young, "nu": nu, "compress_percent": compress, "volume": volume, "crop": crop, "slice": slice_
        }  # fmt: skip
        files = {"image": image_path.name, "image_sha256": sha256(image_path), "mesh": mesh_path.name}
        size = {"n_nodes": len(loaded.mesh.points), "n_cells": len(loaded.mesh.cells)}
        numbers = {key: value for key, value in found._asdict().items() if key != "young"}
        moduli = {"young_kPa_min": found.young.min(), "young_kPa_max": found.young.max()}
        units = {"lambda_max": "mN/mm", "strain_energy": "uJ"}
        save_json(
            json_path,
            {**files, "versions": versions(), "options": options, **size, **moduli, **numbers, "units": units},
        )
    return 0
