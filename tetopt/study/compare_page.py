"""The page of `tetopt compare`: the table, the pictures, notes and provenance. Its text is in
`compare.html`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, groupby
from pathlib import Path
from typing import Any

from tetopt.report.page import package_text, render_page, write_page
from tetopt.study.compare_report import Report
from tetopt.study.compare_table import Column, columns_of, number_text, rows_of

TABLE_COLUMNS = 16  # of a table that fits into 1,400 pixels


def save_compare_page(path: Path, report: Report, pictures: Sequence[tuple[Path, str]]) -> None:
    """Write the comparison as one HTML file without outside references, whole or not at all.

    Parameters
    ----------
    path : Path
    report : Report
        Content of `report.json`, of which the page shows numbers, rounded to four digits, and means
        over labels.
    pictures : sequence of (PNG path, caption)
    """
    columns = columns_of(report)
    tables: list[list[list[Column]]] = [[]]
    for _, members in groupby(columns, key=lambda column: column.group):
        group = list(members)
        if sum(map(len, tables[-1])) + len(group) > TABLE_COLUMNS:
            tables.append([])
        tables[-1].append(group)
    content = render_page(
        "study/compare.html",
        report=report,
        tables=[(groups, rows_of(report, [*chain(*groups)])) for groups in tables],
        remarks=remarks(report),
        pictures=pictures,
        number_text=number_text,
        text=_text,
    )
    title = f"tetopt compared on {report.image.source.name}"
    write_page(path, title, content, package_text("study/compare.css"))


def remarks(report: Report) -> list[str]:
    """Return lines on runs that failed or crashed, on meshes that were not compressed, and the
    notes of the runs.
    """
    lines = []
    for title, each in report.meshes():
        if each.failure is not None and each.median is not None:
            lines.append(f"{title}: a run failed: {each.failure}")
        if each.median is not None and each.median.measurement.not_compressed is not None:
            lines.append(f"{title}: not compressed: {each.median.measurement.not_compressed}")
        lines += [f"{title}: {note}" for note in each.notes]
    return lines


def _text(value: Any, between: str = ", ") -> str:
    """Format any setting as text, with sequences joined."""
    if isinstance(value, list | tuple):
        return between.join(_text(item) for item in value) or "none"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "none" if value is None else str(value)
    return f"{value:.10g}"
