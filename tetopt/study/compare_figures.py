"""Pictures of a comparison of pipelines: slices through every mesh, histograms, curves, times, cutaways."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter
from numpy.typing import NDArray

from tetopt.energy.discretization import cell_E_D
from tetopt.errors import InputError
from tetopt.geometry.simplex import volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.report.colours import grey_limits, plain_text
from tetopt.report.figures import SliceView, draw_edges, fill_cells
from tetopt.report.scene import cutaway, save_scenes, view_of
from tetopt.study.compare_report import ORDER_WORDS, Curve, CurvePoint, Measurement, PipelineResult, PipelineRun, Report
from tetopt.study.pipelines import UNTIMED_STEPS

# Okabe and Ito's palette, safe for colour blindness, without its yellow, which is invisible on white.
LINE_COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
LINE_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LINE_DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (1, 2)))
BAR_HATCHES = ("", "//", "..", "xx", "\\\\", "oo", "--")
ERROR_TITLES = (
    ("strain_energy", "strain energy"),
    ("displacement", "displacement"),
    ("interface_strain", "strain at interfaces"),
)
Value = Callable[[Measurement], Any]
Place = tuple[float | None, float | None]  # of a point, across and up
SHORT_RANGE = 12.0  # ratio of the ends of a logarithmic axis: below it, powers of ten are too few ticks


def slices_figure(image: Image, meshes: Sequence[tuple[str, Mesh]], means: Sequence[NDArray[np.float64]]) -> Figure:
    """The image's middle axial slice and, next to it, each mesh in that slice: its edges, its means, its E_D.

    Parameters
    ----------
    image : Image
    meshes : sequence of (title, Mesh)
        One column each.
    means : sequence of (M,) float64
        Values that fill each mesh's cells, in the image's grey range.

    Returns
    -------
    Figure
        Three rows: edges over the image; cells filled with their means; E_D per mm^3 of each cell (the variance of
        the image inside it) on a common scale, so that a dark map is a good fit for any cell size. Where a mesh does
        not cover the image, the lower rows are light blue.

    Raises
    ------
    InputError
        There are no meshes, or their number differs from that of means.
    """
    if not meshes or len(meshes) != len(means):
        raise InputError(f"slices_figure: got {len(means)} arrays of means for {len(meshes)} meshes; give one for each")
    view = SliceView(image, None, None)
    width = 3.3 if len(meshes) > 2 else 4.6
    figure = Figure(figsize=(width * (len(meshes) + 1), 3.0 * width * view.aspect + 1.0), layout="constrained")
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
    for drawn, (title, _), (polygons, cells), mean, loss in zip(grid.T[1:], meshes, cuts, means, losses, strict=True):
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


def cutaways(meshes: Sequence[tuple[str, Mesh]], means: Sequence[NDArray[np.float64]], path: str | Path) -> None:
    """Write a PNG of every mesh without its right, front, upper octant, with edges, cells in the grey of their means.

    All are cut at the middle of the first mesh's box, up to three in a row. `means` as in `slices_figure`.
    """
    points = meshes[0][1].points
    centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
    views = [view_of(mesh, mean, title, centre) for (title, mesh), mean in zip(meshes, means, strict=True)]
    limits = grey_limits([view.values for view in views])
    save_scenes(path, [(view.title, cutaway(view, limits)) for view in views], columns=3 if len(views) != 4 else 2)


def histograms_figure(report: Report) -> Figure:
    """Plot fractions of cells by rho (left) and of dihedral angles (right) for the pipelines' median runs."""
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    panels = figure.subplots(1, 2)
    names = (
        ("rho_histogram", "rho = inradius / circumradius (1/3 for a regular cell)", "fraction of cells"),
        ("dihedral_histogram", "dihedral angle, degrees (70.5 in a regular cell)", "fraction of angles"),
    )
    for axes, (name, across, up) in zip(panels, names, strict=True):
        for number, pipeline, run in _finished(report):
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
    """Plot Dice (top) and mean surface distance in mm (bottom) of each label, the largest on the left, by pipeline.

    Values are medians over the runs; a lost label has Dice 0 and no distance. Grey bars separate labels.
    """
    finished = _finished(report)
    voxels = {row.label: row.voxels for _, _, run in finished for row in run.measurement.labels}
    order = sorted(voxels, key=lambda label: -voxels[label])
    figure = Figure(figsize=(max(8.0, 2.0 + 0.32 * len(order)), 7.2), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for axes, name in zip(panels, ("dice", "surface_mean_mm"), strict=True):
        for k in range(0, len(order), 2):
            axes.axvspan(k - 0.5, k + 0.5, color="#f1f1f1", zorder=0)
        for place, (number, pipeline, run) in enumerate(finished):
            values = {row.label: getattr(row, name) for row in run.measurement.labels}
            aside = 0.8 * ((place + 0.5) / len(finished) - 0.5)  # of a column, so that marks do not overlap
            points = [(k + aside, values[label]) for k, label in enumerate(order) if values.get(label) is not None]
            axes.plot(
                [x for x, _ in points], [y for _, y in points], linestyle="none", markersize=5, label=pipeline.title,
                marker=LINE_MARKERS[number % len(LINE_MARKERS)], color=_style(number)["color"],
            )  # fmt: skip
        axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    panels[0].set_ylabel("Dice")
    panels[0].set_ylim(-0.03, 1.03)
    panels[1].set_ylabel("mean surface distance, mm")
    panels[1].set_ylim(bottom=0.0)
    panels[1].set_xlim(-0.5, len(order) - 0.5)
    words = {label: plain_text(report.labels.words(label)) if report.labels else f"{label:.0f}" for label in order}
    panels[1].set_xticks(
        range(len(order)), [f"{words[label]} ({voxels[label]:.0f})" for label in order], rotation=90, fontsize=8
    )
    panels[1].set_xlabel("label (voxels)")
    _legend(figure, panels)
    return figure


def curves_figure(report: Report, *, is_by_time: bool = False) -> Figure:
    """Plot errors by number of nodes, or by solve time: a row for each Poisson's ratio, a column for each error.

    Axes are logarithmic, with the selected average of moduli; solid lines are quadratic cells, dashed lines linear
    ones. Without any finite-element result, plot E_D as a fraction of the image's variance by number of nodes.
    """
    ratios = sorted({nu for curve in report.curves for point in curve.points for nu in point.fem}, key=float)
    rows = max(len(ratios), 1)
    columns = len(ERROR_TITLES) if ratios else 1
    figure = Figure(figsize=(13.0 if ratios else 6.5, 3.9 * rows + 1.0), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for row, nu in enumerate(ratios):
        for axes, (name, title) in zip(grid[row], ERROR_TITLES, strict=True):
            _draw_curves(axes, report, _point_of_curve(report, nu, name, is_by_time))
            axes.set_title(f"{title}, ν = {nu}", fontsize=11)
        grid[row, 0].set_ylabel("relative error")
    if not ratios:
        _draw_curves(grid[0, 0], report, lambda point: (point.n_nodes, point.E_D_fraction))
        grid[0, 0].set_ylabel("E_D, fraction of the image's variance")
    for axes in grid[-1]:
        axes.set_xlabel("processor seconds, assembly and solve" if is_by_time and ratios else "nodes in all")
    _legend(figure, grid.ravel())
    return figure


def curve_title(curve: Curve) -> str:
    """Return the label of a line."""
    return f"{curve.title}, {ORDER_WORDS[curve.order]}"


def _point_of_curve(report: Report, nu: str, name: str, is_by_time: bool) -> Callable[[CurvePoint], Place]:
    def place(point: CurvePoint) -> Place:
        if nu not in point.fem:
            return None, None
        solved = point.fem[nu].averages[report.options.average]
        return solved.seconds if is_by_time else point.n_nodes, getattr(solved.errors, name)

    return place


def _draw_curves(axes: Axes, report: Report, place: Callable[[CurvePoint], Place]) -> None:
    """Draw a line per pipeline and order of cells, through `place(point)`; values without a logarithm are left out."""
    numbers = {pipeline.name: number for number, pipeline in enumerate(report.pipelines)}
    for curve in report.curves:
        places = [place(point) for point in curve.points]
        points = sorted((x, y) for x, y in places if x and y is not None and y > 0.0)
        if points:
            number = numbers.get(curve.name, len(numbers))
            colour = LINE_COLOURS[number % len(LINE_COLOURS)]
            axes.plot(
                *zip(*points, strict=True), label=curve_title(curve), color=colour, markersize=6,
                marker=LINE_MARKERS[number % len(LINE_MARKERS)], linestyle="-" if curve.order == 2 else "--",
                markerfacecolor=colour if curve.order == 2 else "white",
            )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        if high < SHORT_RANGE * low:
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
            axis.set_major_formatter("{x:g}")
        else:
            axis.set_major_formatter(LogFormatterSciNotation())
        axis.set_minor_formatter(NullFormatter())
    axes.grid(which="both", color="#e4e4e4", linewidth=0.6)


def tradeoff_figure(report: Report) -> Figure:
    """Plot the trade-offs of a graded mesh's options: E_D's fraction by mean rho, angles and, if simulated, errors.

    Each option is a line with its values, with a star at the defaults; other pipelines' medians are single points.
    """
    nus = sorted({nu for row in report.tradeoff for nu in row.measured.fem}, key=float)[:1]
    orders = sorted({row.order for row in report.tradeoff})
    average = report.options.average
    panels: list[tuple[str, int, Value]] = [
        ("mean rho (1/3: regular)", 1, lambda mesh: mesh.quality.mean_rho),
        ("dihedral angles: smallest (filled), 1st percentile (open)", 1, lambda mesh: mesh.quality.min_dihedral),
        *(
            (f"{title} error, ν = {nu}, {ORDER_WORDS[order]} cells", order, _error(nu, average, name))
            for order in orders
            for nu in nus
            for name, title in ERROR_TITLES
            if all(_error(nu, average, name)(row.measured) for row in report.tradeoff)
        ),
    ]
    columns = 3 if len(panels) > 2 else len(panels)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.9 * columns, 4.3 * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for number, (axes, (title, order, value)) in enumerate(zip(grid, panels, strict=False)):
        _draw_tradeoff(axes, report, order, value)
        if number == 1:
            _draw_tradeoff(axes, report, order, lambda mesh: mesh.quality.p1_dihedral, is_open=True)
            axes.set_ylim(bottom=0.0)
        axes.set_title(title, fontsize=10)
        axes.set_xscale("log")
        axes.set_xlabel("E_D, fraction of the image's variance")
        low, high = axes.get_xlim()
        if high < SHORT_RANGE * low:
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(which="both", color="#e4e4e4", linewidth=0.6)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    _legend(figure, grid[: len(panels)])
    return figure


def _error(nu: str, average: str, name: str) -> Value:
    return lambda mesh: getattr(mesh.fem[nu].averages[average].errors, name) if nu in mesh.fem else None


def _draw_tradeoff(axes: Axes, report: Report, order: int, value: Value, is_open: bool = False) -> None:
    """Draw a line through the meshes of each option, with its values; hollow and without text if open."""
    of_order = [row for row in report.tradeoff if row.order == order]
    options = list(dict.fromkeys(row.option for row in of_order))
    for number, option in enumerate(options):
        rows = [row for row in of_order if row.option == option]
        points = [(row.measured.E_D_fraction, value(row.measured)) for row in rows]
        style = _style(number) | ({"markerfacecolor": "white", "alpha": 0.6} if is_open else {"label": option})
        axes.plot(*zip(*points, strict=True), marker=LINE_MARKERS[number], markersize=5, linewidth=1.2, **style)
        for row, point in zip(rows, points, strict=True):
            if not (is_open or row.is_default):
                _annotate(axes, f"{row.value:.3g}", point, (4, 3), style["color"])
    default = next(row.measured for row in of_order if row.is_default)
    place: tuple[Any, Any] = (default.E_D_fraction, value(default))
    axes.plot(
        *place, marker="*", markersize=15, color="black", linestyle="none", zorder=5,
        markerfacecolor="white" if is_open else "black", label=None if is_open else "default",
    )  # fmt: skip
    for pipeline in report.pipelines if order == 1 else report.quadratic:
        run = pipeline.median
        if pipeline.kind != "tetopt" and run is not None and run.measurement.E_D_fraction:
            place = (run.measurement.E_D_fraction, value(run.measurement))
            if place[1] is None:  # not compressed
                continue
            axes.plot(*place, marker="x", color="#666666", markersize=6, zorder=4)
            if not is_open:
                _annotate(axes, pipeline.title, place, (5, -9), "#444444")


def _annotate(axes: Axes, text: str, point: tuple[Any, Any], offset: tuple[int, int], colour: Any) -> None:
    axes.annotate(text, point, xytext=offset, textcoords="offset points", fontsize=7, color=colour)


def timing_figure(report: Report) -> Figure:
    """Plot wall seconds of each pipeline's median run as a bar, stacked by step; failed pipelines have a text."""
    timed = [
        {} if pipeline.median is None else {k: v for k, v in pipeline.median.seconds.items() if k not in UNTIMED_STEPS}
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
                row, seconds, 0.62, left=left, color=LINE_COLOURS[(number + 1) % len(LINE_COLOURS)], edgecolor="white",
                hatch=BAR_HATCHES[number % len(BAR_HATCHES)], label=step,
            )  # fmt: skip
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


def _finished(report: Report) -> list[tuple[int, PipelineResult, PipelineRun]]:
    """Return the pipelines with a mesh: their places in the list, which select colours, and their median runs."""
    return [(number, each, each.median) for number, each in enumerate(report.pipelines) if each.median is not None]


def _style(number: int) -> dict[str, Any]:
    return {"color": LINE_COLOURS[number % len(LINE_COLOURS)], "linestyle": LINE_DASHES[number % len(LINE_DASHES)]}


def _legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """Add one legend above all panels, with each label once."""
    handles = {
        label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if handles:
        figure.legend(
            list(handles.values()), list(handles), loc="outside upper center", ncols=min(len(handles), 6), frameon=False
        )
