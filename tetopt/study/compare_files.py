"""The comparison as files: `report.json`, the pictures' data and `report.html` made from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tetopt.energy.sampling import cell_moments
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.files import checked_output, save_json
from tetopt.measure.segmentation import thresholded
from tetopt.mesh import Mesh
from tetopt.model.laws import Law
from tetopt.report.figures import save_figure
from tetopt.report.viewer import view_of
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
from tetopt.study.compare_page import save_compare_page

PICTURES = ("slices.png", "cutaways.png", "labels.png", "histograms.png", "curves.png", "tradeoff.png", "timing.png")


def outputs(folder: Path, force: bool) -> dict[str, Path]:
    """The files that `run` writes, by name, each checked; InputError as `checked_output`."""
    names = ("report.json", "report.html", *PICTURES)
    return {name: checked_output(folder / name, (Path(name).suffix,), force) for name in names}


def run(
    paths: dict[str, Path], about: dict[str, Any], image: Image, labels: Image | None, law: Law,
    settings: compare.Settings, say: compare.Say, *, resume: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Compare, write the files of `outputs`, return what `report.json` holds; arguments as `compare.run`.

    Raises
    ------
    InputError
        Not a volume, labels of another shape, pipelines that do not exist, or every pipeline failed.
    """
    if image.ndim != 3:
        raise InputError(f"compare: expected a volume, got a {image.ndim}-D image")
    known, asked = ", ".join(compare.SHOWN), ",".join(settings.pipelines)
    names = set(settings.pipelines)
    if not names or not names <= set(compare.SHOWN) or len(names) < len(settings.pipelines):
        raise InputError(f'pipelines: expected some of {known}, each once, got "{asked}"')
    classes = thresholded(image, settings.classes) if labels is None else labels
    results, meshes = compare.run(
        paths["report.json"].parent, about, image, labels, classes, law, settings, say, resume=resume
    )
    if not meshes:
        how = "; ".join(f"{p['title']}: {p['failure']}" for p in results["pipelines"])
        raise InputError(f"compare: every pipeline failed, nothing is reported: {how}")
    save_json(paths["report.json"], results)
    say("pictures and page")
    _draw(paths, results, image, meshes)
    return results


def _draw(paths: dict[str, Path], results: dict[str, Any], image: Image, meshes: dict[str, Mesh]) -> None:
    titled = [(compare.SHOWN[name].title, mesh) for name, mesh in meshes.items()]
    means = [cell_moments(image, mesh).mean for mesh in meshes.values()]
    save_figure(slices_figure(image, titled, means), paths["slices.png"])
    cutaways(titled, means, paths["cutaways.png"])
    save_figure(labels_figure(results), paths["labels.png"])
    save_figure(histograms_figure(results), paths["histograms.png"])
    save_figure(curves_figure(results), paths["curves.png"])
    save_figure(timing_figure(results), paths["timing.png"])
    if results["tradeoff"]:
        save_figure(tradeoff_figure(results), paths["tradeoff.png"])
    else:  # what lies there is of the report that this one replaces
        paths["tradeoff.png"].unlink(missing_ok=True)
    pictures = [
        (
            paths["slices.png"],
            "The same slice through every mesh; the mean of the image in each cell; E_D of each cell",
        ),
        (paths["cutaways.png"], "Cut open, cells in the grey of their mean"),
        (
            paths["labels.png"],
            "Every label, by size: Dice, and mean distance between its surfaces in mesh and image; lost labels have "
            "Dice 0 and no distance",
        ),
        (paths["histograms.png"], "Radius ratio rho and dihedral angles"),
        (paths["curves.png"], "Error of the compression test against the number of nodes"),
        (
            paths["tradeoff.png"],
            "What tetopt's options trade, one at a time around the defaults (star), on the image alone: E_D against "
            "shape, the smallest and the 1st percentile of the dihedral angles, and the errors of the compression test",
        ),
        (paths["timing.png"], "Seconds by step"),
    ]
    pictures = [each for each in pictures if results["tradeoff"] or each[0].stem != "tradeoff"]
    shown = [k for k, name in enumerate(meshes) if compare.SHOWN[name].kind != "control"] or [0]
    views = [view_of(titled[k][1], means[k], titled[k][0]) for k in shown]
    save_compare_page(paths["report.html"], results, pictures, views)
