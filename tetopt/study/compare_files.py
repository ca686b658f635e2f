"""The comparison from files to files: `report.json`, the meshes, the pictures and `report.html`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tetopt.commands.beside import image_and_labels
from tetopt.energy.sampling import cell_moments
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.formats import save_mesh
from tetopt.io.images import sha256
from tetopt.job.events import note
from tetopt.job.mesh_file import label_table
from tetopt.measure.segmentation import threshold_image
from tetopt.model.fields import cell_fields
from tetopt.model.label_names import LABEL_FIELD, table_of_labels
from tetopt.model.mappings import parse_mapping
from tetopt.report.figures import save_figure
from tetopt.study import compare
from tetopt.study.compare import MadeMesh
from tetopt.study.compare_figures import (
    cutaways,
    histograms_figure,
    labels_figure,
    slices_figure,
    timing_figure,
)
from tetopt.study.compare_page import save_compare_page
from tetopt.study.compare_report import ORDER_WORDS, ImageSource, LabelSource, Report
from tetopt.study.options import CompareOptions
from tetopt.study.program import pipelines_with
from tetopt.system.files import check_outputs, results_folder, save_json

# File and caption of each picture, in the order of the page.
COMPARE_PICTURES = {
    "slices.png": "The same slice through every mesh; the mean of the image in each cell; E_D of "
    "each cell",
    "quadratic.png": "The same slice through the coarser meshes whose quadratic cells have "
    "equally many nodes in total",
    "cutaways.png": "Cutaways, cells shaded by mean intensity",
    "labels.png": "Every label, by size: Dice, and mean distance between its surfaces in mesh "
    "and image, with labels "
    "of most voxels (filled) and the mesh's own (open); lost labels have Dice 0 and no distance",
    "histograms.png": "Radius ratio rho and dihedral angles",
    "timing.png": "Seconds by step",
}
COMPARE_FILES = ("report.json", "report.html", *COMPARE_PICTURES)


def compare_image(
    image_path: Path, output: Path, options: CompareOptions, command: str, *, force: bool = False
) -> Report:
    """Compare, write report.json, report.html, the pictures and the meshes into a folder; return
    report.json's content.

    Notes report the progress to the listener of `tetopt.job.events.listen_with`.

    Parameters
    ----------
    image_path, output : Path
    options : CompareOptions
    command : str
        Command that the report states for running it again.
    force : bool
        Replace the files of an earlier comparison.

    Raises
    ------
    InputError
        Options contradict each other; files cannot be read or written; the image is no volume;
        labels have another shape; pipelines do not exist, or all failed.
    """
    settings = options.settings()
    names, known = set(settings.pipelines), pipelines_with(settings.programs)
    if not names or not names <= set(known) or len(names) < len(settings.pipelines):
        raise InputError(
            f"pipelines: expected some of {', '.join(known)}, each once, got "
            f'"{",".join(settings.pipelines)}"'
        )
    image, labels = image_and_labels(image_path, options.labels, options.part)
    mapping, words = (
        compare.default_mapping(image)
        if options.young is None
        else (parse_mapping(options.young), options.young)
    )
    source = ImageSource(
        image_path.name, sha256(image_path), options.part.volume, options.part.crop
    )
    of_labels = _label_source(options.labels, labels, options.label_names)
    comparison = compare.Comparison(
        image, labels, mapping, settings, source, of_labels, words, command
    )
    mesh_names = [_mesh_name(name, order) for name in settings.pipelines for order in ORDER_WORDS]
    paths = check_outputs(results_folder(output), [*COMPARE_FILES, *mesh_names], force)
    classes = threshold_image(image, settings.classes) if labels is None else labels
    report, made = compare.run(comparison, classes)
    if not made[1]:
        how = "; ".join(f"{each.title}: {each.failure}" for each in report.pipelines)
        raise InputError(f"compare: all pipelines failed, so there is no report: {how}")
    note("writing report, meshes, pictures and page")
    save_json(paths["report.json"], report)
    meshes = {
        _mesh_name(name, order): each for order, of in made.items() for name, each in of.items()
    }
    for name, each in meshes.items():
        own = {} if each.labels is None else {LABEL_FIELD: each.labels}
        save_mesh(paths[name], each.mesh, cell_fields(each.mesh, image) | own)
    drawn = _draw(paths, report, image, made)
    for name in set(paths) - {
        "report.json",
        "report.html",
        *meshes,
        *drawn,
    }:  # of the comparison that this one replaces
        paths[name].unlink(missing_ok=True)
    save_compare_page(
        paths["report.html"], report, [(paths[name], COMPARE_PICTURES[name]) for name in drawn]
    )
    return report


def _mesh_name(name: str, order: int) -> str:
    """Return the file of a pipeline's mesh."""
    return f"{name}.vtu" if order == 1 else f"{name}.{ORDER_WORDS[order]}.vtu"


def _label_source(
    path: Path | None, labels: Image | None, names: Path | None
) -> LabelSource | None:
    """Return the labels' file with their names; raise InputError for names without labels."""
    if names is not None and labels is None:
        raise InputError("`label_names`: needs `labels`")
    if path is None or labels is None:
        return None
    there = table_of_labels(
        label_table(names, labels_path=path), np.unique(labels.data).astype(np.int64).tolist()
    )
    return LabelSource(path.name, sha256(path), there.names)


def _draw(
    paths: dict[str, Path], report: Report, image: Image, made: dict[int, dict[str, MadeMesh]]
) -> list[str]:
    """Write the pictures; return their names, in the order of the page."""
    titles = {each.name: each.title for each in report.pipelines}
    titled = {
        order: [(titles[name], each.mesh) for name, each in of.items()]
        for order, of in made.items()
    }
    means = {
        order: [cell_moments(image, mesh).mean for _, mesh in meshes]
        for order, meshes in titled.items()
    }
    cutaways(titled[1], means[1], paths["cutaways.png"])
    figures = {
        "slices.png": slices_figure(image, titled[1], means[1]),
        "labels.png": labels_figure(report),
        "histograms.png": histograms_figure(report),
        "timing.png": timing_figure(report),
    }
    if titled[2]:
        figures["quadratic.png"] = slices_figure(image, titled[2], means[2])
    for name, figure in figures.items():
        save_figure(figure, paths[name])
    return [name for name in COMPARE_PICTURES if name in {"cutaways.png", *figures}]
