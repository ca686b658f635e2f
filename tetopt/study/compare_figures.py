"""Pictures of a comparison of pipelines: slices through every mesh, cutaways, labels,
histograms, times.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tetopt.energy.discretization import cell_E_D
from tetopt.geometry.simplex import volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.report.colours import grey_limits, plain_text
from tetopt.report.figures import SliceView, draw_edges, fill_cells
from tetopt.report.scene import cutaway, save_scenes, view_of
from tetopt.study.compare_report import PipelineResult, PipelineRun, Report
from tetopt.study.pipelines import UNTIMED_STEPS
from tetopt.system.arrays import Floats

# Okabe and Ito's palette, safe for colour blindness, without its yellow, which is invisible on
# white.
LINE_COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
LINE_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LINE_DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (1, 2)))
BAR_HATCHES = ("", "//", "..", "xx", "\\\\", "oo", "--")


def slices_figure(
    image: Image, meshes: Sequence[tuple[str, Mesh]], means: Sequence[Floats]
) -> Figure:
    """The image's middle axial slice and, next to it, each mesh in that slice: its edges, its
    means, its E_D.

    Parameters
    ----------
    image : Image
    meshes : sequence of (title, Mesh)
        One column each; at least one.
    means : sequence of (M,) float64
        Values that fill each mesh's cells, in the image's grey range.

    Returns
    -------
    Figure
        Three rows: edges over the image; cells filled with their means; E_D per mm^3 of each cell
        (the variance of the image inside it) on a common scale, so that a dark map is a good fit
        for any cell size. Where a mesh does not cover the image, the lower rows are light blue.
    """
    view = SliceView(image, None, None)
    width = 3.3 if len(meshes) > 2 else 4.6
    figure = Figure(
        figsize=(width * (len(meshes) + 1), 3.0 * width * view.aspect + 1.0), layout="constrained"
    )
    grid = figure.subplots(3, len(meshes) + 1, squeeze=False)
    limits = grey_limits([np.asarray(view.pixels, dtype=np.float64)])
    cuts = [view.section(mesh) for _, mesh in meshes]
    losses = [cell_E_D(image, mesh) / volumes(mesh.points, mesh.cells) for _, mesh in meshes]
    shown = np.concatenate([loss[cells] for loss, (_, cells) in zip(losses, cuts, strict=True)])
    brightest = float(np.percentile(shown, 99.0)) if len(shown) else 0.0
    for row in (0, 1):
        view.show_pixels(grid[row, 0], limits)
        view.frame(grid[row, 0])
        grid[row, 0].set_title("image", fontsize=11)
    for drawn, (title, _), (polygons, cells), mean, loss in zip(
        grid.T[1:], meshes, cuts, means, losses, strict=True
    ):
        over, filled, mapped = drawn
        view.show_pixels(over, limits)
        draw_edges(over, polygons)
        over.set_title(title, fontsize=11)
        fill_cells(filled, polygons, np.asarray(mean)[cells], "gray", limits)
        painted = fill_cells(mapped, polygons, loss[cells], "magma", (0.0, brightest or 1.0))
        for axes in drawn:
            view.frame(axes)
    grid[1, 1].set_ylabel("mean in each cell")
    grid[2, 1].set_ylabel("E_D per mm³")
    grid[2, 0].set_axis_off()
    bar = figure.colorbar(painted, cax=grid[2, 0].inset_axes((0.62, 0.08, 0.1, 0.84)), extend="max")
    bar.set_label("E_D per mm³ of the cell (intensity²)", fontsize=9)
    bar.ax.yaxis.set_ticks_position("left")
    bar.ax.yaxis.set_label_position("left")
    return figure


def cutaways(meshes: Sequence[tuple[str, Mesh]], means: Sequence[Floats], path: str | Path) -> None:
    """Write a PNG of every mesh without its right, front, upper octant, with edges, cells in the
    grey of their means.

    All are cut at the middle of the first mesh's box, up to three in a row. `means` as in
    `slices_figure`.
    """
    points = meshes[0][1].points
    centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
    views = [
        view_of(mesh, mean, title, centre)
        for (title, mesh), mean in zip(meshes, means, strict=True)
    ]
    limits = grey_limits([view.values for view in views])
    save_scenes(
        path,
        [(view.title, cutaway(view, limits)) for view in views],
        columns=3 if len(views) != 4 else 2,
    )


def histograms_figure(report: Report) -> Figure:
    """Plot fractions of cells by rho (left) and of dihedral angles (right) for the pipelines'
    median runs.
    """
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    panels = figure.subplots(1, 2)
    names = (
        (
            "rho_histogram",
            "rho = inradius / circumradius (1/3 for a regular cell)",
            "fraction of cells",
        ),
        (
            "dihedral_histogram",
            "dihedral angle, degrees (70.5 in a regular cell)",
            "fraction of angles",
        ),
    )
    for axes, (name, across, up) in zip(panels, names, strict=True):
        for number, pipeline, run in _pipelines_with_mesh(report):
            edges, fraction = getattr(run.measurement, name)
            style = _style(number)
            if pipeline.kind == "tetopt":
                axes.stairs(fraction, edges, fill=True, alpha=0.18, color=style["color"])
            axes.stairs(fraction, edges, label=pipeline.title, linewidth=1.8, **style)
        axes.set_xlabel(across)
        axes.set_ylabel(up)
        axes.set_ylim(bottom=0.0)
    panels[0].axvline(1.0 / 3.0, color="black", linewidth=0.8, linestyle=":")
    panels[1].axvline(np.degrees(np.arccos(1.0 / 3.0)), color="black", linewidth=0.8, linestyle=":")
    panels[1].set_xticks(range(0, 181, 30))
    _legend(figure, panels)
    return figure


def labels_figure(report: Report) -> Figure:
    """Plot Dice (top) and mean surface distance in mm (bottom) of each label, the largest on the
    left, by pipeline.

    Filled marks are of labels of most voxels, open ones of the mesh's own. A lost label has Dice 0
    and no distance. Grey bars separate labels.
    """
    finished = _pipelines_with_mesh(report)
    voxels = {
        row.label: row.extent.voxels for _, _, run in finished for row in run.measurement.labels
    }
    order = sorted(voxels, key=lambda label: -voxels[label])
    figure = Figure(figsize=(max(8.0, 2.0 + 0.32 * len(order)), 7.2), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for axes, name in zip(panels, ("dice", "distance_mean"), strict=True):
        for k in range(0, len(order), 2):
            axes.axvspan(k - 0.5, k + 0.5, color="#f1f1f1", zorder=0)
        for place, (number, pipeline, run) in enumerate(finished):
            # of a column, so that marks do not overlap
            aside = 0.8 * ((place + 0.5) / len(finished) - 0.5)
            colour = _style(number)["color"]
            for rows, face in (
                (run.measurement.own_labels, "none"),
                (run.measurement.labels, colour),
            ):
                values = {row.label: row.as_json()[name] for row in rows}
                points = [
                    (k + aside, values[label]) for k, label in enumerate(order) if label in values
                ]
                axes.plot(
                    [x for x, _ in points],
                    [y for _, y in points],
                    linestyle="none",
                    markersize=5,
                    color=colour,
                    marker=LINE_MARKERS[number % len(LINE_MARKERS)],
                    markerfacecolor=face,
                    label=pipeline.title if rows is run.measurement.labels else None,
                )
        axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    panels[0].set_ylabel("Dice")
    panels[0].set_ylim(-0.03, 1.03)
    panels[1].set_ylabel("mean surface distance, mm")
    panels[1].set_ylim(bottom=0.0)
    panels[1].set_xlim(-0.5, len(order) - 0.5)
    words = {
        label: plain_text(report.labels.words(label)) if report.labels else f"{label:.0f}"
        for label in order
    }
    panels[1].set_xticks(
        range(len(order)),
        [f"{words[label]} ({voxels[label]:.0f})" for label in order],
        rotation=90,
        fontsize=8,
    )
    panels[1].set_xlabel("label (voxels)")
    _legend(figure, panels)
    return figure


def timing_figure(report: Report) -> Figure:
    """Plot wall seconds of each pipeline's median run as a bar, stacked by step; failed
    pipelines have a text.
    """
    timed = [
        {}
        if pipeline.median is None
        else {k: v for k, v in pipeline.median.seconds.items() if k not in UNTIMED_STEPS}
        for pipeline in report.pipelines
    ]
    steps = list(dict.fromkeys(step for seconds in timed for step in seconds))
    figure = Figure(figsize=(10.0, 0.62 * len(timed) + 1.6), layout="constrained")
    axes = figure.subplots()
    for row, (pipeline, seconds_by_step) in enumerate(zip(report.pipelines, timed, strict=True)):
        if pipeline.median is None:
            axes.text(0.0, row, " failed", va="center", color="#a00000")
            continue
        left = 0.0
        for step, seconds in seconds_by_step.items():
            number = steps.index(step)
            axes.barh(
                row,
                seconds,
                0.62,
                left=left,
                color=LINE_COLOURS[(number + 1) % len(LINE_COLOURS)],
                edgecolor="white",
                hatch=BAR_HATCHES[number % len(BAR_HATCHES)],
                label=step,
            )
            left += seconds
        axes.text(left, row, f" {pipeline.median.seconds_total:.3g} s", va="center", fontsize=10)
    axes.set_yticks(range(len(timed)), [pipeline.title for pipeline in report.pipelines])
    axes.set_ylim(len(timed) - 0.4, -0.6)  # the first at the top
    axes.margins(x=0.12)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("wall seconds, median run")
    axes.spines[["top", "right"]].set_visible(False)
    _legend(figure, [axes])
    return figure


def _pipelines_with_mesh(report: Report) -> list[tuple[int, PipelineResult, PipelineRun]]:
    """Return the pipelines with a mesh: their places in the list, which select colours, and
    their median runs.
    """
    return [
        (number, each, each.median)
        for number, each in enumerate(report.pipelines)
        if each.median is not None
    ]


def _style(number: int) -> dict[str, Any]:
    return {
        "color": LINE_COLOURS[number % len(LINE_COLOURS)],
        "linestyle": LINE_DASHES[number % len(LINE_DASHES)],
    }


def _legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """Add one legend above all panels, with each label once."""
    handles = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if handles:
        figure.legend(
            list(handles.values()),
            list(handles),
            loc="outside upper center",
            ncols=min(len(handles), 6),
            frameon=False,
        )
