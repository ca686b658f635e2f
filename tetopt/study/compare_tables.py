"""Tables of the comparison's page: a column for each pipeline, a row for each measure, the best marked."""

from __future__ import annotations

import html
from collections.abc import Sequence

from tetopt.study.compare_criteria import (
    Criterion,
    CriterionEntry,
    entries_of,
    loss_text,
    number_text,
    of_order,
    undecided,
    winners,
)
from tetopt.study.compare_report import PipelineResult, Report


def measures_html(report: Report, rows: Sequence[Criterion], caption: str) -> str:
    """Markup of a table of these measures, under the headings of their parts; "" if no pipeline has any."""
    lines, part = [], None
    for row in rows:
        entries = entries_of(row, report)
        if all(each.value is None for each in entries):
            continue
        if row.part not in (part, row.group):
            span = len(report.pipelines) + 1
            head = f'<th scope="rowgroup" colspan="{span}"><span>{html.escape(row.part)}</span></th>'
            lines.append(f'<tr class="part">{head}</tr>')
        part = row.part
        lines.append(_row_html(row, report, entries))
    if not lines:
        return ""
    return "\n".join([*table_head("measures", "median of the runs", report.pipelines, caption), *lines, TABLE_END])


def table_head(kind: str, first: str, pipelines: Sequence[PipelineResult], caption: str = "") -> list[str]:
    """Lines of a table with a column for each pipeline, up to the first row of its body; `TABLE_END` ends it."""
    heads = "".join(_head_cell(pipeline) for pipeline in pipelines)
    title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    row = f'<thead><tr><th scope="col">{first}</th>{heads}</tr></thead><tbody>'
    return [f'<div class="wide"><table class="{kind}">{title}', row]


TABLE_END = "</tbody></table></div>"


def folded_html(title: str, content: str) -> str:
    """Markup of what is opened by a click on its title; "" without content."""
    return f"<details><summary>{html.escape(title)}</summary>{content}</details>" if content else ""


def _head_cell(pipeline: PipelineResult) -> str:
    notes = [pipeline.kind] if pipeline.kind != "tetopt" else []
    if pipeline.median is None:
        notes = [*notes, _absence(pipeline)]
    elif pipeline.failure:
        notes = [*notes, "a run failed"]
    if len(pipeline.runs) > 1:
        notes = [*notes, f"{len(pipeline.runs)} runs"]
    note = f"<small>{html.escape(', '.join(notes))}</small>" if notes else ""
    return f'<th scope="col" class="{html.escape(pipeline.kind)}">{html.escape(pipeline.title)}{note}</th>'


def _absence(pipeline: PipelineResult) -> str:
    return "not installed" if pipeline.reason == "missing" else "failed"


def _row_html(row: Criterion, report: Report, entries: Sequence[CriterionEntry]) -> str:
    best = winners(row.better, [each.value for each in entries])
    open_words = _open_win(row, report, entries, best)
    cells = []
    for number, (pipeline, each) in enumerate(zip(of_order(report, row.order), entries, strict=True)):
        kinds, mark = [pipeline.kind], ""
        if number in best and open_words:
            mark = f'<b class="mark">{html.escape(open_words)}</b>'
        elif number in best:
            kinds.append("best")
            mark = '<b class="mark">best</b>' if len(best) == 1 else '<b class="mark">best, tied</b>'
        elif best and pipeline.kind == "tetopt" and (top := entries[best[0]].value) is not None:
            why = undecided(row, report, number, best[0])
            kinds += [] if why else ["lost"]
            mark = f'<b class="mark">{html.escape(loss_text(each.value, top) + (why and f", {why}"))}</b>'
        cells.append(f'<td class="{html.escape(" ".join(kinds))}">{_value_html(pipeline, each)}{mark}</td>')
    arrow = {-1: " ↓", 1: " ↑", 0: ""}[row.better]
    return f'<tr><th scope="row">{html.escape(row.title)}{arrow}</th>{"".join(cells)}</tr>'


def _open_win(row: Criterion, report: Report, entries: Sequence[CriterionEntry], best: Sequence[int]) -> str:
    """Why the best value of a row is no verdict over the one after it; "" where it is one, or shared."""
    others = [place for place, each in enumerate(entries) if each.value is not None and place not in best]
    if len(best) != 1 or not others:
        return ""
    after = max(others, key=lambda place: row.better * (entries[place].value or 0.0))
    return undecided(row, report, best[0], after)


def _value_html(pipeline: PipelineResult, each: CriterionEntry) -> str:
    if pipeline.median is None:
        return f'<span class="failed">{_absence(pipeline)}</span>'
    text = f'<span class="value">{number_text(each.value)}</span>'
    is_range = each.value is not None and len(pipeline.runs) > 1
    return text + f"<small>{number_text(each.low)} to {number_text(each.high)}</small>" if is_range else text
