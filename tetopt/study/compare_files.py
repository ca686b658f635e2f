"""The comparison from files to files: `report.json`, and the pictures and `report.html` from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tetopt.energy.sampling import cell_moments
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.images import sha256
from tetopt.job.events import note
from tetopt.job.inputs import checked_outputs, image_and_labels, label_table
from tetopt.measure.segmentation import thresholded
from tetopt.mesh import Mesh
from tetopt.model.labels import table_of_labels
from tetopt.model.mappings import parse_mapping
from tetopt.report.figures import save_figure
from tetopt.study import compare
from tetopt.study.compare_figures import (
    curves_figure,
    cutaways,
    histograms_figure,
    labels_figure,
    slices_figure,
    timing_figure,
    tradeoff_figure,
)
from tetopt.study.compare_headline import headline
from tetopt.study.compare_page import save_compare_page
from tetopt.study.compare_report import ImageSource, LabelSource, Report, as_json
from tetopt.study.options import CompareOptions
from tetopt.study.program import pipelines_with
from tetopt.system.files import results_folder, save_json

# File and caption of each picture, in the order in which they are listed.
COMPARE_PICTURES = {
    "slices.png": "The same slice through every mesh; the mean of the image in each cell; E_D of each cell",
    "quadratic.png": "The same slice through the coarser meshes whose quadratic cells have equally many nodes in total",
    "cutaways.png": "Cutaways, cells shaded by mean intensity",
    "labels.png": "Every label, by size: Dice, and mean distance between its surfaces in mesh and image; lost labels "
    "have Dice 0 and no distance",
    "histograms.png": "Radius ratio rho and dihedral angles",
    "curves.png": "Error of the compression test by number of nodes, including mid-edge nodes of quadratic cells",
    "solve_time.png": "The same by processor seconds for assembly and solve, with the same multigrid for all",
    "tradeoff.png": "Trade-offs of tetopt's options, one at a time around the defaults (star), on the image alone: E_D "
    "against shape, the smallest and the 1st percentile of the dihedral angles, and the errors of the compression test",
    "timing.png": "Seconds by step",
}
COMPARE_FILES = ("report.json", "report.html", *COMPARE_PICTURES)


def compare_image(
    image_path: Path, output: Path, options: CompareOptions, command: str, *, resume: bool = False, force: bool = False
) -> Report:
    """Compare, write the files `COMPARE_FILES` into a folder, and return the content of `report.json`.

    Notes report the progress to the listener of `tetopt.job.events.listened`.

    Parameters
    ----------
    image_path, output : Path
    options : CompareOptions
    command : str
        Command that the report states for running it again.
    resume : bool
        Keep finished runs of the same image, settings and versions.
    force : bool
        Replace the files of an earlier comparison.

    Raises
    ------
    InputError
        Options contradict each other; files cannot be read or written; the image is no volume; labels have another
        shape; pipelines do not exist, or all failed.
    """
    settings = options.settings()
    image, labels = image_and_labels(image_path, options.labels, options.part)
    mapping, words = (
        compare.default_mapping(image) if options.young is None else (parse_mapping(options.young), options.young)
    )
    source = ImageSource(image_path.name, sha256(image_path), options.part.volume, options.part.crop)
    of_labels = _label_source(options.labels, labels, options.label_names)
    comparison = compare.Comparison(image, labels, mapping, settings, source, of_labels, words, command)
    paths = checked_outputs(results_folder(output), COMPARE_FILES, force or resume)
    if (output / "runs").is_dir() and not (resume or force):
        raise InputError(f"{output / 'runs'}: contains finished runs; `resume` keeps them, `force` starts over")
    names, known = set(settings.pipelines), pipelines_with(settings.programs)
    if not names or not names <= set(known) or len(names) < len(settings.pipelines):
        raise InputError(
            f'pipelines: expected some of {", ".join(known)}, each once, got "{",".join(settings.pipelines)}"'
        )
    classes = thresholded(image, settings.classes) if labels is None else labels
    report, meshes = compare.run(output, comparison, classes, resume=resume)
    if not meshes[1]:
        how = "; ".join(f"{each.title}: {each.failure}" for each in report.pipelines)
        raise InputError(f"compare: all pipelines failed, so there is no report: {how}")
    save_json(paths["report.json"], as_json(report) | {"headline": as_json(headline(report))})
    note("writing pictures and page")
    _draw(paths, report, image, meshes)
    return report


def _label_source(path: Path | None, labels: Image | None, names: Path | None) -> LabelSource | None:
    """Return the labels' file with their names; raise InputError for names without labels."""
    if names is not None and labels is None:
        raise InputError("`label_names`: needs `labels`")
    if path is None or labels is None:
        return None
    there = table_of_labels(label_table(names), np.unique(labels.data).astype(np.int64).tolist())
    return LabelSource(path.name, "given", sha256(path), there.names)


def _draw(paths: dict[str, Path], report: Report, image: Image, meshes: dict[int, dict[str, Mesh]]) -> None:
    shown = {each.name: each for each in report.pipelines}
    titled = {order: [(shown[name].title, mesh) for name, mesh in of.items()] for order, of in meshes.items()}
    means = {order: [cell_moments(image, mesh).mean for mesh in of.values()] for order, of in meshes.items()}
    cutaways(titled[1], means[1], paths["cutaways.png"])
    figures = {
        "slices.png": slices_figure(image, titled[1], means[1]),
        "labels.png": labels_figure(report),
        "histograms.png": histograms_figure(report),
        "curves.png": curves_figure(report),
        "solve_time.png": curves_figure(report, is_by_time=True),
        "timing.png": timing_figure(report),
    }
    if titled[2]:
        figures["quadratic.png"] = slices_figure(image, titled[2], means[2])
    if report.tradeoff:
        figures["tradeoff.png"] = tradeoff_figure(report)
    drawn = {"cutaways.png", *figures}
    for name in set(COMPARE_PICTURES) - drawn:  # existing ones belong to the report that this one replaces
        paths[name].unlink(missing_ok=True)
    for name, figure in figures.items():
        save_figure(figure, paths[name])
    pictures = [(paths[name], caption) for name, caption in COMPARE_PICTURES.items() if name in drawn]
    save_compare_page(paths["report.html"], report, pictures)
