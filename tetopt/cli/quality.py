"""``tetopt quality``: measure a mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

import tetopt
from tetopt import Image, InputError, Mesh
from tetopt.check import manifold_problems
from tetopt.cli.console import out, print_fidelity, show_error, show_warning
from tetopt.cli.inputs import image_and_others, label_table, read_mesh, warn_of_other_image
from tetopt.cli.options import ImagePart, LabelNamesOption, NumberOptions, option
from tetopt.energy.sampling import Overlap, overlap_of
from tetopt.engine.promises import MASK_DICE
from tetopt.incoming import json_of
from tetopt.io.files import save_json
from tetopt.measure.fidelity import LabelFidelity
from tetopt.measure.interfaces import touching_voxels
from tetopt.measure.quality import quality
from tetopt.model.file import MeshFile
from tetopt.report.summary import fidelity, size_summary
from tetopt.report.tables import add_quality, new_table
from tetopt.target.align import aligned_labels, aligned_mask
from tetopt.target.content import continued
from tetopt.target.domain import INSIDE_SHARE


def quality_command(
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU, VTK or MSH file of tetrahedra or triangles.")],
    image_path: Annotated[Path | None, option("IMAGE", "Measure E_D against this image, too.", "--image")] = None,
    mask_path: Annotated[
        Path | None, option("MASK", "How well the boundary follows it; with --image.", "--mask")
    ] = None,
    labels_path: Annotated[
        Path | None, option("LABELS", "How well cells keep to them; with --image.", "--labels")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Is it a mesh, with a manifold boundary? With --image, does it fill the box? Exit 1 if not."
        ),
    ] = False,
    label_names: LabelNamesOption = None,
    *,
    part: ImagePart,
    numbers: NumberOptions,
) -> int:
    """Measure a mesh: shape, angles, bad cells, and how well its cells fit an image."""
    json_path = numbers.checked()
    _check_options(image_path, mask_path, labels_path, label_names)
    loaded = read_mesh(mesh_path)
    shape = quality(loaded.mesh.points, loaded.mesh.cells)
    size = size_summary(loaded.mesh, loaded.order)
    report: dict[str, Any] = {"mesh": mesh_path.name, "size": size, "quality": shape, "n_turned": loaded.n_turned}
    table = new_table("", escape(mesh_path.name))
    add_quality(table, shape, in_all=[size["n_nodes_in_all"]] if loaded.order == 2 else [])
    image: Image | None = None
    mask: Image | None = None
    fit: Fit | None = None
    measured: dict[str, Any] = {}
    if image_path is not None:
        image, beside = image_and_others(image_path, part)
        labels = None if labels_path is None else beside(labels_path, aligned_labels)
        mask = None if mask_path is None else beside(mask_path, aligned_mask)
        fit = image_fit(continued(image, mask), loaded.mesh)
        measured = fidelity(labels, mask, loaded.mesh, loaded.cell_data.get("label"))
        measured |= _names(measured.get("labels", []), label_table(label_names, loaded).names)
        warn_of_other_image(loaded, mesh_path, image_path)
        report |= {**measured, "image": image_path.name, "fit": fit}
        _add_fit(table, fit, image.data.size)
    is_masked = mask is not None or _was_masked(loaded)
    problems, remarks = _checked(loaded, image, mask, is_masked) if check else ([], [])
    report |= {"problems": problems, "remarks": remarks} if check else {}
    if json_path is not None:
        save_json(json_path, report)
    out.print(table)
    print_fidelity(measured, loaded.mesh.ndim)
    if check:
        _say_checked(mesh_path, image, is_masked, problems, remarks)
    if problems:
        return 1
    if mask is not None and measured["mask"].dice < MASK_DICE:
        show_error(f"the mesh and the mask overlap only by Dice {measured['mask'].dice:.3f}: is it of this mask?")
        return 1
    if fit is not None and fit.overlap is not None:
        show_error(f"{mesh_path}: {fit.overlap}")
        return 1
    return 0


def _checked(loaded: MeshFile, image: Image | None, mask: Image | None, is_masked: bool) -> tuple[list[str], list[str]]:
    """What is wrong with a mesh; and if nothing is, what is no fault, and yet good to know.

    That is a boundary which is no manifold where the mask's own voxels only touch, and interfaces of labels, which
    voxels seldom make manifolds.
    """
    n_touching = 0 if mask is None else touching_voxels(mask.data >= INSIDE_SHARE)
    problems = tetopt.check_mesh(
        loaded.mesh, image, is_whole=not is_masked, is_filled=not is_masked, is_manifold=n_touching == 0
    )
    if problems:
        return problems, []
    remarks = manifold_problems(loaded.mesh) if n_touching else []
    remarks = [f"{each}; the mask's voxels touch like that at {n_touching} edges and corners" for each in remarks]
    labels = loaded.cell_data.get("label")
    if labels is not None and labels.ndim == 1 and ((np.rint(labels) == labels) & (labels >= 0)).all():
        remarks += manifold_problems(loaded.mesh, labels)
    return [], remarks


def _say_checked(
    path: Path, image: Image | None, is_masked: bool, problems: Sequence[str], remarks: Sequence[str]
) -> None:
    for remark in remarks:
        show_warning(f"{path}: {remark}")
    for problem in problems:
        show_error(f"{path}: {problem}")
    if not problems:
        words = ", in one piece" if image is None else ", in one piece, fills the box"
        words = "; made within a mask, which may have pieces" if is_masked else words
        out.print(f"checked: conforming, oriented{words}")


def _check_options(image: Path | None, mask: Path | None, labels: Path | None, names: Path | None) -> None:
    """InputError for files without those that they belong to."""
    if image is None and (mask is not None or labels is not None):
        raise InputError("--mask and --labels: give the --image, too, on whose voxels they are compared")
    if names is not None and labels is None:
        raise InputError("--label-names: there are no --labels")


def _names(rows: Sequence[LabelFidelity], names: Mapping[int, str]) -> dict[str, dict[int, str]]:
    """What those of the labels that have a name are called, as "label_names"; nothing if none has."""
    of_rows = {row.label: names[row.label] for row in rows if row.label in names}
    return {"label_names": of_rows} if of_rows else {}


def _add_fit(table: Table, fit: Fit, n_voxels: int) -> None:
    """Rows of how well cells fit an image of so many voxels."""
    table.add_row("E_D", f"{fit.E_D:.6g}")
    if fit.E_D_share_of_variance is not None:
        table.add_row("E_D, share of the variance inside", f"{fit.E_D_share_of_variance:.5f}")
    table.add_row("voxels inside", f"{fit.n_voxels} of {n_voxels}")
    table.add_row("cells without a voxel", str(fit.n_empty_cells))


def _was_masked(loaded: MeshFile) -> bool:
    """Whether the file says that it was made within a mask or without a background."""
    try:
        inputs = json_of(loaded.text("inputs") or "{}")
        return inputs.get("mask") is not None or inputs.get("background") is not None
    except (ValueError, AttributeError):  # another program's
        return False


class Fit(NamedTuple):
    """How well the cells of a mesh fit an image."""

    E_D: float  # intensity^2 mm^n
    E_D_share_of_variance: float | None  # of the voxels that the mesh covers; None where they are all alike
    n_voxels: int  # voxel centres inside
    n_empty_cells: int  # cells without one
    overlap: Overlap | None  # voxels that lie in several cells


def image_fit(image: Image, mesh: Mesh) -> Fit:
    """E_D of a mesh, absolute and as share of the variance of the voxels that it covers.

    Raises
    ------
    InputError
        A mesh that covers none.
    """
    moments = tetopt.cell_moments(image, mesh)
    E_D = float((moments.n_voxels * moments.variance).sum()) * image.voxel_volume
    n_voxels = int(moments.n_voxels.sum())
    if n_voxels == 0:
        raise InputError("mesh and image: no voxel centre lies inside the mesh; do both lie in the same world mm?")
    mean = float((moments.n_voxels * moments.mean).sum()) / n_voxels
    spread = E_D + float((moments.n_voxels * (moments.mean - mean) ** 2).sum()) * image.voxel_volume
    n_empty = int((moments.n_voxels == 0).sum())
    return Fit(E_D, E_D / spread if spread > 0.0 else None, n_voxels, n_empty, overlap_of(image, mesh))
