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
from tetopt.cli.options import NumberOptions, option
from tetopt.energy.sampling import Overlap, overlap_of
from tetopt.engine.loop import MeshingResult
from tetopt.incoming import json_of
from tetopt.io.files import save_json
from tetopt.job.advice import tell_violated
from tetopt.job.inputs import label_table, read_mesh, warn_of_other_image
from tetopt.job.options import ImagePart, LabelNamesOption, SourceOptions
from tetopt.job.source import Source, read_source, whose_variance
from tetopt.measure.fidelity import LabelFidelity
from tetopt.measure.quality import quality
from tetopt.measure.requirements import judged
from tetopt.model.file import MeshFile
from tetopt.report.summary import fidelity, size_summary
from tetopt.report.tables import add_quality, new_table


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
            "--check",
            help="Is it a mesh, with a manifold boundary? With --image, does it fill the box, and meet what its "
            "run was asked for? Exit 1 if not.",
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
    source, result, fit = None, None, None
    measured: dict[str, Any] = {}
    if image_path is not None:
        source = _source(loaded, image_path, mask_path, labels_path, part)
        fit, result, measured = _measured(loaded, source)
        measured |= _names(measured.get("labels", []), label_table(label_names, loaded).names)
        warn_of_other_image(loaded, mesh_path, image_path)
        report |= {**measured, "image": image_path.name, "fit": fit}
        _add_fit(table, fit, source, _left_out(loaded, source))
    problems, remarks = _checked(loaded, source) if check else ([], [])
    report |= {"problems": problems, "remarks": remarks} if check else {}
    report |= {"missed": dict(result.missed)} if check and result is not None else {}
    if json_path is not None:
        save_json(json_path, report)
    out.print(table)
    print_fidelity(measured, loaded.mesh.ndim, "mask" if source is None else source.mask_word)
    if check:
        _say_checked(mesh_path, loaded, source, problems, remarks)
    overlap = None if fit is None else fit.overlap
    if overlap is not None:
        show_error(f"{mesh_path}: {overlap}")
    if source is None or result is None:
        return 1 if problems else 0
    known = ("overlap", "manifold") if problems else ("overlap",)  # with the cells' or nodes' numbers
    missed = {name: words for name, words in result.missed.items() if name not in known}
    if not check:  # what makes the numbers above meaningless
        missed, measured = {name: words for name, words in missed.items() if name == "mask"}, {}
    result = result._replace(missed=missed)
    return max(int(bool(problems) or overlap is not None), int(bool(tell_violated(result, measured, source.mask_word))))


def _source(loaded: MeshFile, image: Path, mask: Path | None, labels: Path | None, part: ImagePart) -> Source:
    """What the mesh is measured on: the files named here, weighed as the mesh's file says that they were."""
    inputs = _texts(loaded, "inputs")
    level, tension, weight = (_number(inputs.get(name)) for name in ("background", "smooth_interfaces", "label_weight"))
    weights = inputs.get("weights")
    own = _number(weights[0]) if isinstance(weights, list) and len(weights) == 1 else None
    options = SourceOptions(
        images=[image], mask=mask, labels=labels, **vars(part),
        background=None if mask is not None or level is None else repr(level),
        weights=None if labels is None or own is None else repr(own),
        label_weight=None if labels is None else weight,
        smooth_interfaces=None if labels is None else tension,
        keep_components=False,
    )  # fmt: skip
    return read_source(options)


def _measured(loaded: MeshFile, source: Source) -> tuple[Fit, MeshingResult, dict[str, Any]]:
    """How well the cells fit the image; the mesh as the result of a run; how well mask, labels and image are met."""
    mesh, of_cell = loaded.mesh, loaded.cell_data.get("label")
    fit = image_fit(source.image, mesh)
    result = judged(mesh, source.content, of_cell, **_requirements(loaded, source))
    is_uniform = source.content.variance == 0.0
    fit = fit._replace(E_D=result.history[-1].E_D, E_D_share_of_variance=None if is_uniform else result.share)
    measured = fidelity(source.labels, source.mask, mesh, of_cell)
    if not (source.content.is_plain and source.content.region is None):
        measured["contrasts"] = source.by_contrast(tetopt.cell_moments(source.image, mesh)._asdict())
    return fit, result, measured


def _requirements(loaded: MeshFile, source: Source) -> dict[str, Any]:
    """What the run that made the mesh was asked for, as its file says; another program's mesh only fills the box."""
    options = _texts(loaded, "options")  # of ours alone with a method
    is_kept = options.get("method") == "fast" and options.get("iterations") != 0
    return {
        "min_dihedral": _number(options.get("min_dihedral")) or 0.0 if is_kept else 0.0,
        "target_error": None if _left_out(loaded, source) else _number(options.get("target_error")),
        "is_filled": "method" in options and _fills_box(loaded, source),
    }


def _left_out(loaded: MeshFile, source: Source) -> list[str]:
    """What counted for the run that made the mesh, as its file says, and does not here."""
    inputs, there = _texts(loaded, "inputs"), {"mask": source.mask, "labels": source.labels}
    left_out = [name for name, image in there.items() if image is None and inputs.get(name) is not None]
    images = inputs.get("images")
    return left_out + ["other images"] * (isinstance(images, list) and len(images) > 1)


def _fills_box(loaded: MeshFile, source: Source | None) -> bool:
    """Whether the mesh should fill the image's box: not within a mask, and not of another mesh's domain."""
    is_masked = _was_masked(loaded) or (source is not None and source.mask is not None)
    return not is_masked and _texts(loaded, "options").get("start") is None


def _number(value: Any) -> float | None:
    """A number of a mesh's file; None for anything else."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _checked(loaded: MeshFile, source: Source | None) -> tuple[list[str], list[str]]:
    """What is wrong with a mesh; and if nothing is, what is no fault, and yet good to know.

    That are interfaces of labels which are not manifolds; of a run that smoothed them, it is wrong.
    """
    image, mask = (None, None) if source is None else (source.contrasts[0], source.mask)
    is_whole = mask is None and not _was_masked(loaded)
    is_filled = _fills_box(loaded, source)
    problems, touching = tetopt.check_mesh(loaded.mesh, image, is_whole=is_whole, is_filled=is_filled), []
    labels = loaded.cell_data.get("label")
    if problems or labels is None:
        return problems, []
    if labels.ndim == 1 and ((np.rint(labels) == labels) & (labels >= 0)).all():
        touching = manifold_problems(loaded.mesh, labels)
    is_smooth = (_number(_texts(loaded, "inputs").get("smooth_interfaces")) or 0.0) > 0.0
    return (touching, []) if is_smooth else ([], touching)


def _say_checked(
    path: Path, loaded: MeshFile, source: Source | None, problems: Sequence[str], remarks: Sequence[str]
) -> None:
    for remark in remarks:
        show_warning(f"{path}: {remark}")
    for problem in problems:
        show_error(f"{path}: {problem}")
    if not problems:
        words = ", in one piece" + (", fills the box" if source is not None and _fills_box(loaded, source) else "")
        is_masked = _was_masked(loaded) or (source is not None and source.mask is not None)
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


def _add_fit(table: Table, fit: Fit, source: Source, left_out: list[str]) -> None:
    """Rows of how well cells fit an image, without what the run that made the mesh had besides."""
    table.add_row("E_D", f"{fit.E_D:.6g}")
    if fit.E_D_share_of_variance is not None:
        words = f", without its {' and '.join(left_out)}" if left_out else ""
        table.add_row(f"E_D, share of {whose_variance(source.content)}{words}", f"{fit.E_D_share_of_variance:.5f}")
    table.add_row("voxels inside", f"{fit.n_voxels} of {source.contrasts[0].data.size}")
    table.add_row("cells without a voxel", str(fit.n_empty_cells))


def _was_masked(loaded: MeshFile) -> bool:
    """Whether the file says that it was made within a mask or without a background."""
    inputs = _texts(loaded, "inputs")
    return inputs.get("mask") is not None or inputs.get("background") is not None


def _texts(loaded: MeshFile, name: str) -> dict[str, Any]:
    """A table among the texts of the mesh's file; empty without one, or if it is another program's."""
    try:
        table = json_of(loaded.text(name) or "{}")
    except ValueError:
        return {}
    return table if isinstance(table, dict) else {}


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
