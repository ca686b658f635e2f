"""The rows of the comparison's tables, one for each measure, the best marked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from tetopt.study.compare_criteria import (
    Criterion,
    CriterionEntry,
    entries_of,
    loss_text,
    of_order,
    undecided,
    winners,
)
from tetopt.study.compare_report import PipelineResult, Report

ARROWS = {-1: " ↓", 1: " ↑", 0: ""}


class MeasureCell(NamedTuple):
    """What a pipeline has for a measure."""

    pipeline: PipelineResult
    entry: CriterionEntry
    kinds: str  # classes of the markup
    mark: str  # "" without


class MeasureRow(NamedTuple):
    """A measure of all pipelines."""

    part: str  # the heading before it, "" where it is the one of the row above
    title: str
    cells: list[MeasureCell]


def measure_rows(report: Report, rows: Sequence[Criterion]) -> list[MeasureRow]:
    """The rows of a table of these measures; none for those that no pipeline has."""
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
    """Why the best value of a row is no verdict over the one after it; "" where it is one, or shared."""
    others = [place for place, each in enumerate(entries) if each.value is not None and place not in best]
    if len(best) != 1 or not others:
        return ""
    after = max(others, key=lambda place: row.better * (entries[place].value or 0.0))
    return undecided(row, report, best[0], after)
