"""``tetopt quality``: measure a mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

import tetopt
from tetopt import Image, InputError, Mesh
from tetopt.cli.console import log, out, print_fidelity
from tetopt.cli.inputs import image_and_others, read_mesh, warn_of_other_image
from tetopt.cli.options import CropOption, ForceOption, JsonOption, SliceOption, VolumeOption
from tetopt.io.files import checked_output, save_json
from tetopt.io.meshes import MeshFile
from tetopt.measure.quality import quality
from tetopt.report.summary import fidelity
from tetopt.report.tables import add_quality, new_table
from tetopt.target.align import aligned_labels, aligned_mask
from tetopt.target.content import continued


def quality_command(
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU, VTK or MSH file of tetrahedra or triangles.")],
    image_path: Annotated[
        Path | None, typer.Option("--image", metavar="IMAGE", help="Measure E_D against this image, too.")
    ] = None,
    mask_path: Annotated[
        Path | None, typer.Option("--mask", metavar="MASK", help="How well the boundary follows it; with --image.")
    ] = None,
    labels_path: Annotated[
        Path | None, typer.Option("--labels", metavar="LABELS", help="How well cells keep to them; with --image.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Is it a mesh? With --image, does it fill the box? Exit 1 if not.")
    ] = False,
    volume: VolumeOption = None,
    crop: CropOption = None,
    slice_: SliceOption = None,
    json_path: JsonOption = None,
    force: ForceOption = False,
) -> int:
    """Measure a mesh: shape, angles, bad cells, and how well its cells fit an image."""
    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    if image_path is None and (mask_path is not None or labels_path is not None):
        raise InputError("--mask and --labels: give the --image, too, on whose voxels they are compared")
    loaded = read_mesh(mesh_path)
    measured = quality(loaded.mesh.points, loaded.mesh.cells)
    found: dict[str, Any] = {}
    content: dict[str, Any] = {"mesh": mesh_path.name, "quality": measured, "n_turned": loaded.n_turned}
    table = new_table("", escape(mesh_path.name))
    add_quality(table, measured)
    if image_path is not None:
        image, beside = image_and_others(image_path, volume, crop, slice_)
        labels = None if labels_path is None else beside(labels_path, aligned_labels)
        mask = None if mask_path is None else beside(mask_path, aligned_mask)
        fit = image_fit(continued(image, mask), loaded.mesh)
        found = fidelity(labels, mask, loaded.mesh, loaded.cell_data.get("label"))
        content |= found
        warn_of_other_image(loaded, mesh_path, image_path)
        content |= {"image": image_path.name, "fit": fit}
        table.add_row("E_D", f"{fit['E_D']:.6g}")
        if fit["E_D_share_of_variance"] is not None:
            table.add_row("E_D, share of the variance inside", f"{fit['E_D_share_of_variance']:.5f}")
        table.add_row("voxels inside", f"{fit['n_voxels']} of {image.data.size}")
        table.add_row("cells without a voxel", str(fit["n_empty_cells"]))
    is_masked = mask_path is not None or _was_masked(loaded)
    is_box = image_path is not None and not is_masked
    problems = []
    if check:
        problems = tetopt.check_mesh(loaded.mesh, image if is_box else None, is_whole=not is_masked)
    if check:
        content["problems"] = problems
    if json_path is not None:
        save_json(json_path, content)
    out.print(table)
    print_fidelity(found)
    for problem in problems:
        log.print(f"[bold red]tetopt:[/] {escape(str(mesh_path))}: {escape(problem)}")
    if check and not problems:
        words = ", in one piece, fills the box" if is_box else ", in one piece"
        words = "; made within a mask, which may have pieces" if is_masked else words
        out.print(f"checked: conforming, oriented{words}")
    if problems:
        return 1
    if image_path is not None and fit["n_voxels"] > image.data.size:
        log.print(
            f"[bold red]tetopt:[/] cells overlap: together they hold {fit['n_voxels']} voxels, more than there are"
        )
        return 1
    return 0


def _was_masked(loaded: MeshFile) -> bool:
    """Whether the file says that it was made within a mask or without a background."""
    try:
        inputs = json.loads(loaded.text("inputs") or "{}")
        return inputs.get("mask") is not None or inputs.get("background") is not None
    except (ValueError, AttributeError, RecursionError):  # another program's
        return False


def image_fit(image: Image, mesh: Mesh) -> dict[str, Any]:
    """E_D of a mesh, absolute and as share of the variance of the voxels that it covers."""
    moments = tetopt.cell_moments(image, mesh)
    E_D = float((moments.n_voxels * moments.variance).sum()) * image.voxel_volume
    n_voxels = int(moments.n_voxels.sum())
    if n_voxels == 0:
        raise InputError("mesh and image: no voxel centre lies inside the mesh; do both lie in the same world mm?")
    mean = float((moments.n_voxels * moments.mean).sum()) / n_voxels
    spread = E_D + float((moments.n_voxels * (moments.mean - mean) ** 2).sum()) * image.voxel_volume
    return {
        "E_D": E_D,
        "E_D_share_of_variance": E_D / spread if spread > 0.0 else None,
        "n_voxels": n_voxels,
        "n_empty_cells": int((moments.n_voxels == 0).sum()),
    }
