"""The table of a comparison: a row for each mesh; columns of fidelity, shape, labels, simulation
and cost.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from tetopt.measure.fidelity import LabelFidelity
from tetopt.study.compare_report import Measurement, PipelineResult, PipelineRun, Report

JUDGED_VOXELS = 500  # labels with more are judged; a mesh of few nodes keeps only some smaller ones
MEBI_BYTES = 1e-6  # megabytes in a byte
# numbers from the first are printed without a fraction, below the second in full
FULL_DIGITS = (1e4, 1e9)
COMPRESSION_ERRORS = (  # of the compression, and the fields of `tetopt.fem.reference.Errors`
    ("energy", "strain_energy"),
    ("displacement", "displacement"),
    ("interface strain", "interface_strain"),
)
ARROWS = {-1: " ↓", 1: " ↑", 0: ""}
IMAGE_WORD = "{image}"  # in the command of a program that gets the image
Value = Callable[[PipelineRun], float | None]


class Column(NamedTuple):
    """A measure of all meshes."""

    group: str
    title: str
    value: Value
    better: int  # -1 if smaller is better, +1 if larger, 0 if neither
    is_short: bool = False  # also in the terminal
    least: float = 0.0  # the reference's own error, below which errors say nothing

    @property
    def heading(self) -> str:
        """The title, with an arrow towards better values."""
        return self.title + ARROWS[self.better]


class TableRow(NamedTuple):
    """A mesh: its numbers, or its failure."""

    title: str
    kind: str  # of its pipeline
    failure: str | None  # None if there are numbers
    cells: list[
        tuple[str, str]
    ]  # by column: the median run's number, and the range if runs differ; empty after failure


def columns_of(report: Report) -> list[Column]:
    """Return the columns for which any mesh has a number, in order."""
    runs = [run for _, each in report.meshes() for run in each.runs]
    ratios = sorted({nu for run in runs for nu in run.measurement.fem}, key=float)
    columns = [
        _measure(
            "Fidelity", "E_D, of the variance", lambda mesh: mesh.E_D_fraction, -1, is_short=True
        ),
        _measure("Fidelity", "voxels outside", lambda mesh: mesh.n_missed_voxels, -1),
        _measure("Shape", "mean rho", lambda mesh: mesh.quality.mean_rho, 1, is_short=True),
        _measure("Shape", "p1 rho", lambda mesh: mesh.quality.p1_rho, 1),
        _measure(
            "Shape", "smallest angle, °", lambda mesh: mesh.quality.min_dihedral, 1, is_short=True
        ),
        _measure(
            "Shape",
            "bad cells, %",
            lambda mesh: 100.0 * sum(mesh.quality.kinds.values()) / mesh.n_cells,
            -1,
        ),
        *_label_columns(report, "Labels of most voxels", lambda mesh: mesh.labels, is_short=True),
        *_label_columns(
            report, "Labels of the mesh itself", lambda mesh: mesh.own_labels, is_short=False
        ),
        *(
            Column(
                f"Error of the compression, ν = {nu}",
                title,
                _error(nu, name),
                -1,
                is_short=(k, name) == (0, "displacement"),
                least=_own_error(report, nu, name),
            )
            for k, nu in enumerate(ratios)
            for title, name in COMPRESSION_ERRORS
        ),
        Column("Cost", "seconds", lambda run: run.seconds_total, -1, is_short=True),
        Column("Cost", "MB", lambda run: run.peak_bytes * MEBI_BYTES, -1),
        _measure("Cost", "nodes", lambda mesh: mesh.n_nodes, 0, is_short=True),
        _measure("Cost", "cells", lambda mesh: mesh.n_cells, 0),
    ]
    return [
        column
        for column in columns
        if any(_finite_value(column.value(run)) is not None for run in runs)
    ]


def _measure(
    group: str,
    title: str,
    value: Callable[[Measurement], float | None],
    better: int,
    *,
    is_short: bool = False,
) -> Column:
    return Column(group, title, lambda run: value(run.measurement), better, is_short)


def _label_columns(
    report: Report,
    group: str,
    rows_of: Callable[[Measurement], list[LabelFidelity]],
    *,
    is_short: bool,
) -> list[Column]:
    """Return columns over the judged labels. A lost label has no surface, so that their mean has
    no number.
    """
    judged = labels_of_table(report)

    def over(
        of: Callable[[list[float]], float], value: Callable[[LabelFidelity], float]
    ) -> Callable[[Measurement], float | None]:
        def of_mesh(mesh: Measurement) -> float | None:
            values = [value(row) for row in rows_of(mesh) if row.label in judged]
            return of(values) if values else None

        return of_mesh

    def mean(values: list[float]) -> float:
        return sum(values) / len(values)

    def n_lost(mesh: Measurement) -> int | None:
        return sum(row.extent.is_lost for row in rows_of(mesh)) if rows_of(mesh) else None

    return [
        _measure(
            group, "mean Dice", over(mean, lambda row: row.overlap.dice), 1, is_short=is_short
        ),
        _measure(group, "smallest Dice", over(min, lambda row: row.overlap.dice), 1),
        _measure(group, "surface distance, mm", over(mean, lambda row: row.distance.mean), -1),
        _measure(
            group,
            "largest volume error, %",
            over(max, lambda row: 100.0 * abs(row.extent.mesh_volume / row.extent.volume - 1.0)),
            -1,
        ),
        _measure(group, "labels lost", n_lost, -1),
    ]


def labels_of_table(report: Report) -> set[int]:
    """Return the labels of the table: the large ones if any, without a given segmentation's
    background.
    """
    rows = [
        row for each in report.pipelines for run in each.runs[:1] for row in run.measurement.labels
    ]
    voxels = {row.label: row.extent.voxels for row in rows}
    if report.labels is not None and len(voxels) > 1:
        voxels.pop(0, None)
    return {label for label, n in voxels.items() if n > JUDGED_VOXELS} or set(voxels)


def _own_error(report: Report, nu: str, name: str) -> float:
    """Return the reference's own error; 0 if it is unknown."""
    energy = report.reference.by_nu.get(nu)
    return 0.0 if energy is None else getattr(energy.own_error, name, None) or 0.0


def _error(nu: str, name: str) -> Value:
    def value(run: PipelineRun) -> float | None:
        solved = run.measurement.fem.get(nu)
        return None if solved is None else getattr(solved.errors, name)

    return value


def short_table(report: Report) -> tuple[list[Column], list[TableRow], list[str]]:
    """Return the columns and rows for the terminal, and a line on each mark.

    Errors below the reference's own are blank. An E_D of a mesh that was made of labels alone has
    a star.
    """
    columns = [column for column in columns_of(report) if column.is_short]
    rows, notes = rows_of(report, columns), dict[str, str]()
    for row, (_, pipeline) in zip(rows, report.meshes(), strict=True):
        for k, column in enumerate(columns if row.cells else []):
            value = None if pipeline.median is None else column.value(pipeline.median)
            if value is not None and value < column.least:
                row.cells[k] = "", ""
                notes[column.group] = (
                    f"{column.group}, {column.title}: blank below the reference's own error, "
                    f"{number_text(column.least)}, which ranks no mesh"
                )
            elif "E_D" in column.title and row.kind == "peer" and IMAGE_WORD not in pipeline.about:
                row.cells[k] = f"{row.cells[k][0]}*", ""
                notes["E_D"] = "* E_D, of the variance: made from labels or classes alone"
    return columns, rows, list(notes.values())


def rows_of(report: Report, columns: list[Column]) -> list[TableRow]:
    """Return a row for each pipeline's mesh of linear cells, and then of quadratic ones."""
    return [_row(each, title, columns) for title, each in report.meshes()]


def _row(pipeline: PipelineResult, title: str, columns: list[Column]) -> TableRow:
    if pipeline.median is None:
        return TableRow(title, pipeline.kind, pipeline.failure, [])
    return TableRow(
        title, pipeline.kind, None, [_cell(pipeline, column.value) for column in columns]
    )


def _cell(pipeline: PipelineResult, value: Value) -> tuple[str, str]:
    """Return the number of the pipeline's median run, and the range of all its runs if it is
    one.
    """
    known = sorted(each for run in pipeline.runs if (each := _finite_value(value(run))) is not None)
    ends = [number_text(each) for each in (known[:1] + known[-1:])]
    text = "–" if pipeline.median is None else number_text(value(pipeline.median))
    return text, " to ".join(ends) if len(set(ends)) > 1 else ""


def _finite_value(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value


def number_text(value: float | None) -> str:
    """Format a number: whole numbers in full, others to four digits; "–" without a finite
    number.
    """
    if value is None or not math.isfinite(value):
        return "–"
    rounded, full = FULL_DIGITS
    if float(value).is_integer() and abs(value) < full:
        return str(int(value))
    return f"{value:.0f}" if rounded <= abs(value) < full else f"{value:.4g}"
