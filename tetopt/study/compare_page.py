"""The page of `tetopt compare`, rendered from report.json: headline, each group of measures, provenance.

The text is in `compare.html`, and in `compare_parts.html` and `compare_labels.html`, which it includes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from tetopt.report.page import package_text, rendered, write_page
from tetopt.study.compare_criteria import (
    GROUPS,
    Criterion,
    CriterionEntry,
    criteria,
    entries_of,
    entry,
    fem_error,
    fem_ratios,
    loss_text,
    number_text,
    of_order,
    short_text,
    undecided,
    winners,
)
from tetopt.study.compare_headline import headline
from tetopt.study.compare_labels import labels_of
from tetopt.study.compare_report import ORDER_WORDS, Curve, PipelineResult, Report, averages_of
from tetopt.study.pipelines import UNTIMED_STEPS

ARROWS = {-1: " ↓", 1: " ↑", 0: ""}
GROUP_PICTURES = {  # stems of pictures' names, by the group of their section
    "Image": ("slices", "quadratic", "cutaways"),
    "Labels": ("labels",),
    "Shape": ("histograms",),
    "Simulation": ("curves", "solve_time", "tradeoff"),
    "Cost": ("timing",),
}


def save_compare_page(path: Path, report: Report, pictures: Sequence[tuple[Path, str]]) -> None:
    """Write the comparison as one HTML file without outside references, whole or not at all.

    Parameters
    ----------
    path : Path
    report : Report
        Content of `report.json`; every number on the page is one of its numbers, rounded to four digits, or computed
        from them, and nothing is measured here.
    pictures : sequence of (PNG path, caption)
        Each is shown in its section of `GROUP_PICTURES`.
    """
    content = rendered(
        "study/compare.html", report=report, first=headline(report), nus=fem_ratios(report), order_words=ORDER_WORDS,
        groups=[_group(report, name) for name in GROUPS], labels=labels_of(report),
        shown=lambda stems: [each for stem in stems for each in pictures if Path(each[0]).stem == stem],
        best_variants=list(_best_variants(report)), equal_times=equal_times(report),
        orders=[(order, of_order(report, order)) for order in ORDER_WORDS], untimed=UNTIMED_STEPS,
        machine=", ".join(f"{key} {_text(value)}" for key, value in report.machine.items()),
        pipelines=[[each.title, each.about] for each in report.pipelines],
        options=[[name, _text(value)] for name, value in report.options._asdict().items()],
        number_text=number_text, short_text=short_text, text=_text, winners=winners, numbered=_numbered,
    )  # fmt: skip
    write_page(path, f"tetopt compared on {report.image.source.name}", content, package_text("study/compare.css"))


def _numbered(content: str) -> Markup:
    """Number the captions of the page for citation, including folded ones."""
    for tag, word in (("caption", "Table"), ("figcaption", "Figure")):
        numbers = count(1)
        content = re.sub(f"<{tag}>", lambda match: f"{match[0]}{word} {next(numbers)}. ", content)  # noqa: B023
    return Markup(content)


class MeasureCell(NamedTuple):
    """A pipeline's entry for a measure."""

    pipeline: PipelineResult
    entry: CriterionEntry
    kinds: str  # classes of the markup
    mark: str  # "" without


class MeasureRow(NamedTuple):
    """A measure of all pipelines."""

    part: str  # the heading before it, "" if it is that of the row above
    title: str
    cells: list[MeasureCell]


def _group(report: Report, name: str) -> dict[str, Any]:
    """Return a section of measures: its rows, the folded ones, and what each does not capture."""
    rows = [row for row in criteria(report) if row.group == name]
    blind = dict.fromkeys((row.title, row.blind) for row in rows if row.blind)
    shown, details = (
        measure_rows(report, [row for row in rows if row.is_detail == is_one]) for is_one in (False, True)
    )
    return {"name": name, "rows": shown, "details": details, "blind": list(blind), "pictures": GROUP_PICTURES[name]}


def measure_rows(report: Report, rows: Sequence[Criterion]) -> list[MeasureRow]:
    """Return the rows of a table of these measures; none for those that no pipeline has."""
    lines, part = [], None
    for row in rows:
        entries = entries_of(row, report)
        if any(each.value is not None for each in entries):
            head = "" if row.part in (part, row.group) else row.part
            lines.append(MeasureRow(head, row.title + ARROWS[row.better], list(_cells(row, report, entries))))
            part = row.part
    return lines


def _cells(row: Criterion, report: Report, entries: Sequence[CriterionEntry]) -> Iterator[MeasureCell]:
    best = winners(row.better, [each.value for each in entries])
    open_words = _open_win(row, report, entries, best)
    for number, (pipeline, each) in enumerate(zip(of_order(report, row.order), entries, strict=True)):
        kinds, mark = pipeline.kind, ""
        if number in best and open_words:
            mark = open_words
        elif number in best:
            kinds, mark = f"{kinds} best", "best" if len(best) == 1 else "best, tied"
        elif best and pipeline.kind == "tetopt" and (top := entries[best[0]].value) is not None:
            why = undecided(row, report, number, best[0])
            kinds += "" if why else " lost"
            mark = loss_text(each.value, top) + (why and f", {why}")
        yield MeasureCell(pipeline, each, kinds, mark)


def _open_win(row: Criterion, report: Report, entries: Sequence[CriterionEntry], best: Sequence[int]) -> str:
    """Return why the best value of a row has no verdict over the next; "" if it has one, or is shared."""
    others = [place for place, each in enumerate(entries) if each.value is not None and place not in best]
    if len(best) != 1 or not others:
        return ""
    after = max(others, key=lambda place: row.better * (entries[place].value or 0.0))
    return undecided(row, report, best[0], after)


class Variant(NamedTuple):
    """A way to solve a mesh, and its error."""

    pipeline: PipelineResult
    order: int
    average: str
    error: float


def _variants(report: Report, nu: str, name: str) -> list[Variant]:
    """Return every pipeline with every order and average, the smallest error first."""
    rows = [
        Variant(pipeline, order, average, value)
        for order in ORDER_WORDS
        for average in averages_of(report.options)
        for pipeline in of_order(report, order)
        if (value := entry(fem_error(nu, average, name), pipeline).value) is not None
    ]
    return sorted(rows, key=lambda row: row.error)


def _best_variants(report: Report) -> Iterator[tuple[str, Variant, float | None, list[Variant]]]:
    """Yield, for each Poisson's ratio, mesh, cells and moduli of the best displacement, its energy error, and others.

    The others are the best with cells of the other order, and of each pipeline of another kind.
    """
    for nu in fem_ratios(report):
        rows = _variants(report, nu, "displacement")
        if rows:
            best = rows[0]
            others = [next((row for row in rows if row.order != best.order), None)]
            others += [
                next((row for row in rows if row.pipeline.name == name), None)
                for name in dict.fromkeys(row.pipeline.name for row in rows if row.pipeline.kind != best.pipeline.kind)
            ]
            loss = entry(fem_error(nu, best.average, "strain_energy"), best.pipeline).value
            yield nu, best, loss, [row for k, row in enumerate(others) if row is not None and row not in others[:k]]


def equal_times(report: Report) -> list[list[str]]:
    """Return rows of pipeline, nu, solve seconds of the linear mesh, its displacement error and the quadratic one."""
    curves = {(curve.name, curve.order): curve for curve in report.curves}
    rows = []
    for pipeline in report.pipelines:
        quadratic = curves.get((pipeline.name, 2))
        for nu in fem_ratios(report):
            if pipeline.median is None or quadratic is None or nu not in pipeline.median.measurement.fem:
                continue
            linear = pipeline.median.measurement.fem[nu].averages[report.options.average]
            error = _error_at(quadratic, nu, report.options.average, linear.seconds)
            numbers = (linear.seconds, linear.errors.displacement, error)
            rows.append([pipeline.title, nu, *map(number_text, numbers)])
    return rows


def _error_at(curve: Curve, nu: str, average: str, seconds: float) -> float | None:
    """Interpolate the displacement error on a curve at a time between two of its meshes; None beyond them."""
    solved = [point.fem[nu].averages[average] for point in curve.points if nu in point.fem]
    points = sorted((each.seconds, each.errors.displacement) for each in solved if each.errors.displacement)
    if not points or not points[0][0] <= seconds <= points[-1][0]:
        return None
    x, y = np.log(np.array(points, dtype=np.float64)).T
    return float(np.exp(np.interp(np.log(seconds), x, y)))


def _text(value: Any, between: str = ", ") -> str:
    """Format any setting as text, with sequences joined."""
    if isinstance(value, list | tuple):
        return between.join(_text(item) for item in value) or "none"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "none" if value is None else str(value)
    return f"{value:.10g}"
