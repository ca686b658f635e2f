"""The page of `tetopt compare`: report.json rendered: what matters, each group of measures, its origin."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tetopt.report import viewer
from tetopt.report.page import paragraph_html, picture_html, section_html, table_html, write_page
from tetopt.report.viewer import View, views_html
from tetopt.study.compare_criteria import (
    GROUPS,
    CriterionEntry,
    criteria,
    entry,
    fem_error,
    fem_ratios,
    number_text,
    of_order,
    short_text,
)
from tetopt.study.compare_headline import Claim, Headline, headline
from tetopt.study.compare_labels import labels_html
from tetopt.study.compare_report import (
    ORDER_WORDS,
    Curve,
    PipelineResult,
    ReferenceGrid,
    Report,
    averages_of,
)
from tetopt.study.compare_tables import TABLE_END, folded_html, measures_html
from tetopt.study.pipelines import UNTIMED_STEPS

GROUP_PICTURES = {  # by the stems of their names, in the sections of their groups
    "Image": ("slices", "quadratic", "cutaways"),
    "Labels": ("labels",),
    "Shape": ("histograms",),
    "Simulation": ("curves", "solve_time", "tradeoff"),
    "Cost": ("timing",),
}


def save_compare_page(path: Path, report: Report, pictures: Sequence[tuple[Path, str]], views: Sequence[View]) -> None:
    """Write the comparison as one HTML file without outside references, whole or not at all.

    Parameters
    ----------
    path : Path
    report : Report
        What `report.json` holds; every number on the page is one of these, rounded to four digits, or computed from
        them, and nothing is measured here.
    pictures : sequence of (PNG path, caption)
        Each stands in the section that `GROUP_PICTURES` has it in.
    views : sequence of View
        Surfaces to turn; without any, the section is left out.
    """
    shown = {
        group: [picture_html(*each) for stem in stems for each in pictures if Path(each[0]).stem == stem]
        for group, stems in GROUP_PICTURES.items()
    }
    before = {"Simulation": simulation_sentences(report)}
    after = {
        "Simulation": [folded_html("All cells and averages, and errors at equal time", _variants_html(report))],
        "Cost": [folded_html("Seconds by step", _seconds_html(report))],
    }
    sections = [("In short", _headline_html(headline(report), report))]
    for group in GROUPS:
        content = [*before.get(group, []), *_measures_html(report, group), *shown[group], *after.get(group, [])]
        sections.append((group, content))
        if group == "Image":
            sections.append(("Labels", labels_html(report, shown["Labels"])))
    sections += [
        ("Turn the meshes", [views_html(views)] if views else []),
        ("Where this comes from", _origin_html(report)),
    ]
    parts = _numbered([section_html(title, content) for title, content in sections if content])
    write_page(path, f"tetopt compared on {report.image.source.name}", parts, _COMPARE_STYLE + viewer.VIEWS_STYLE)


def _numbered(parts: list[str]) -> list[str]:
    """The page's parts with numbers before the captions, to cite them by; those that are folded away count, too."""
    for tag, word in (("caption", "Table"), ("figcaption", "Figure")):
        numbers = count(1)
        parts = [re.sub(f"<{tag}>", lambda match: f"{match[0]}{word} {next(numbers)}. ", part) for part in parts]  # noqa: B023
    return parts


# --------------------------------------------------------------------------------------------------
# What matters


def _headline_html(first: Headline, report: Report) -> list[str]:
    """The title, the few numbers, and group by group where tetopt is behind; then what makes that uneven."""
    parts = [f'<p class="title"><strong>{html.escape(first.title)}</strong></p>']
    image, shape = report.image, " × ".join(map(str, report.image.shape))
    about = f"{image.source.name}, {shape} voxels of {_text(image.spacing_mm, ' × ')} mm; {report.date}."
    parts.append(paragraph_html(about))
    parts.append(_claims_html(first.claims, "tetopt against the best peer of each measure", "best peer", True))
    behind = "Where tetopt is behind a peer, of all measures but details; in each group the worst first"
    parts.append(_claims_html(first.behind_peers(), behind, "best peer"))
    others = "Where tetopt is behind a control, which does not see the image, or another of its own meshes"
    parts.append(folded_html(others, _claims_html(first.behind_others(), others, "best of these")))
    if first.claims and not first.behind_peers():
        parts.append(paragraph_html("No peer is better, by a verdict, in any measure of the four groups."))
    return [*parts, *map(paragraph_html, [*first.remarks, *_not_compressed(report)])]


def _claims_html(claims: Sequence[Claim], caption: str, other: str, is_first: bool = False) -> str:
    """Markup of a table of claims, the page's first with what each does not see; "" without any."""
    if not claims:
        return ""
    heads = "".join(f'<th scope="col">{name}</th>' for name in ("measure", "tetopt", other, "tetopt over it"))
    lines = ['<div class="wide"><table class="claims">', f"<caption>{html.escape(caption)}</caption>"]
    rows = (_claim_html(claim, is_first) for claim in claims)
    lines += [f"<thead><tr>{heads}</tr></thead><tbody>", *rows, TABLE_END]
    return "\n".join(lines)


def _claim_html(claim: Claim, is_first: bool) -> str:
    arrow = "↓" if claim.smaller_is_better else "↑"
    words = {"better": "best", "worse": "lost", "no different": "", "no verdict": ""}
    blind = f"<small>does not see {html.escape(claim.blind)}</small>" if is_first else ""
    beside = "".join(f"<small>{html.escape(words)}</small>" for words in claim.beside)
    both = "".join(
        f"<td>{short_text(each.value)}{_range_html(each)}{name}</td>"
        for each, name in ((claim.ours, ""), (claim.other, f"<small>{html.escape(claim.other_title)}</small>"))
    )
    return (
        f'<tr><th scope="row"><small>{html.escape(claim.group)}</small>{html.escape(claim.measure)} {arrow}'
        f'{blind}</th>{both}<td class="{words[claim.verdict]}">'
        f'{claim.ratio_words}<b class="mark">{claim.verdict}</b>{beside}</td></tr>'
    )


def _range_html(each: CriterionEntry) -> str:
    return "" if each.low == each.high else f"<small>{short_text(each.low)} to {short_text(each.high)}</small>"


def _not_compressed(report: Report) -> Iterator[str]:
    for order, word in ORDER_WORDS.items():
        for each in of_order(report, order):
            reason = None if each.median is None else each.median.measurement.not_compressed
            if reason is not None:
                yield f"{each.title}{'' if order == 1 else f', {word} cells,'} was not compressed: {reason}"


# --------------------------------------------------------------------------------------------------
# The groups


def _measures_html(report: Report, group: str) -> list[str]:
    """The group's table, its details folded, and what its measures do not see."""
    rows = [row for row in criteria(report) if row.group == group]
    table = measures_html(report, [row for row in rows if not row.is_detail], f"{group}: the measures")
    details = measures_html(report, [row for row in rows if row.is_detail], f"{group}: details")
    blind = dict.fromkeys((row.title, row.blind) for row in rows if row.blind)
    items = "".join(f"<li>{html.escape(title)}: {html.escape(words)}</li>" for title, words in blind)
    key = _TABLE_KEY if group == GROUPS[0] else ""
    return [table, key, folded_html("More measures of this group", details),
        f'<div class="blind"><p>What these do not see:</p><ul>{items}</ul></div>' if table else ""]  # fmt: skip


class Variant(NamedTuple):
    """How a mesh is solved, and the error that comes of it."""

    pipeline: PipelineResult
    order: int
    average: str
    error: float

    @property
    def words(self) -> str:
        """With which cells and moduli."""
        return f"{self.pipeline.title}, {ORDER_WORDS[self.order]} cells, {self.average}"


def _variants(report: Report, nu: str, name: str) -> list[Variant]:
    """Every pipeline with every order and average, the smallest error first."""
    rows = [
        Variant(pipeline, order, average, value)
        for order in ORDER_WORDS
        for average in averages_of(report.options)
        for pipeline in of_order(report, order)
        if (value := entry(fem_error(nu, average, name), pipeline).value) is not None
    ]
    return sorted(rows, key=lambda row: row.error)


def simulation_sentences(report: Report) -> list[str]:
    """For each Poisson's ratio: with which mesh, cells and moduli the displacement is best, and the best of others."""
    words = []
    for nu in fem_ratios(report):
        rows = _variants(report, nu, "displacement")
        if not rows:
            continue
        best = rows[0]
        loss = entry(fem_error(nu, best.average, "strain_energy"), best.pipeline).value
        text = (
            f"At about {report.options.nodes} nodes in all and ν = {nu}, the displacement's error is smallest with "
            f"{best.words}: {number_text(best.error)} (strain energy {number_text(loss)})."
        )
        others = [next((row for row in rows if row.order != best.order), None)]
        others += [
            next((row for row in rows if row.pipeline.name == name), None)
            for name in dict.fromkeys(row.pipeline.name for row in rows if row.pipeline.kind != best.pipeline.kind)
        ]
        rest = [f"{row.words}: {number_text(row.error)}" for row in others if row is not None]
        words.append(f"<p><strong>{html.escape(text)}</strong>")
        if rest:
            also = f" The best with {ORDER_WORDS[3 - best.order]} cells, and of the others: "
            words[-1] += html.escape(also + "; ".join(dict.fromkeys(rest)))
        words[-1] += "</p>"
    return words


def _variants_html(report: Report) -> str:
    """What linear and quadratic cells are, and their displacement errors at equal times of a solve."""
    if not fem_ratios(report):
        return ""
    how = (
        "Linear cells on the mesh of so many nodes; quadratic cells on a coarser mesh of the same pipeline, which has "
        "as many nodes with those in the middle of its (straight) edges. Moduli of cells by "
        f"{report.options.average}; by Eq. (2)'s mean among the details above."
    )
    times = equal_times(report)
    if not times:
        return paragraph_html(how)
    again = (
        "At equal time: the seconds of the processor that the linear mesh takes for matrix and solve, its "
        "displacement error, and that of quadratic cells which take as long, between the two measured meshes that "
        "take less and more (logarithms, linearly); – where the curve does not reach so far."
    )
    names = ["pipeline", "ν", "seconds", "linear", "quadratic"]
    return "\n".join(
        [
            paragraph_html(how),
            paragraph_html(again),
            table_html([names, *times], "Error of displacement at equal time of a solve"),
        ]
    )


def equal_times(report: Report) -> list[list[str]]:
    """Rows of pipeline, nu, seconds of the linear mesh's solve, its displacement error and the quadratic one then."""
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
    """The displacement's error on a curve at a time between those of two of its meshes; None beyond them."""
    solved = [point.fem[nu].averages[average] for point in curve.points if nu in point.fem]
    points = sorted((each.seconds, each.errors.displacement) for each in solved if each.errors.displacement)
    if not points or not points[0][0] <= seconds <= points[-1][0]:
        return None
    x, y = np.log(np.array(points, dtype=np.float64)).T
    return float(np.exp(np.interp(np.log(seconds), x, y)))


def _seconds_html(report: Report) -> str:
    rows = [["pipeline", "step", "seconds", "low to high", "remark"]]
    for pipeline in report.pipelines:
        median, low, high = pipeline.median, pipeline.low, pipeline.high
        if median is None or low is None or high is None:
            rows.append([pipeline.title, "–", "–", "", "not installed" if pipeline.reason == "missing" else "failed"])
            continue
        for step, seconds in median.seconds.items():
            spread = f"{number_text(low.seconds[step])} to {number_text(high.seconds[step])}"
            spread = spread if len(pipeline.runs) > 1 else ""
            rows.append([pipeline.title, step, number_text(seconds), spread, UNTIMED_STEPS.get(step, "")])
    return table_html(rows, "Seconds by step, medians of the runs")


# --------------------------------------------------------------------------------------------------
# Where it comes from


def _origin_html(report: Report) -> list[str]:
    """The command, what cites it, data with checksums, pipelines, options, versions, machine and notes."""
    image, labels = report.image, report.labels
    shape, spacing = _text(image.shape, " × "), _text(image.spacing_mm, " × ")
    tables = {
        "Data and machine": [
            ["what", "value"],
            ["image", f"{image.source.name}, {shape} voxels of {spacing} mm"],
            ["image's SHA-256", image.source.sha256],
            ["part of it", f"volume {_text(image.source.volume)}, crop {_text(image.source.crop)}"],
            ["image's variance", number_text(image.variance)],
            ["labels", f"{labels.name} ({labels.kind})" if labels else "none given: classes of the intensities"],
            *([["labels' SHA-256", labels.sha256]] if labels else []),
            ["modulus", report.mapping],
            ["reference", _reference_text(report.reference)],
            ["machine", ", ".join(f"{key} {_text(value)}" for key, value in report.machine.items())],
            ["date", report.date],
            ["whole comparison, s", number_text(report.seconds)],
        ],
        "Pipelines": [["pipeline", "what it is"], *([each.title, each.about] for each in report.pipelines)],
        "Options": [["option", "value"], *([name, _text(value)] for name, value in report.options._asdict().items())],
        "Versions": [["package", "version"], *([name, value] for name, value in report.versions.items())],
    }
    notes = [
        f"{pipeline.title}{'' if order == 1 else ', quadratic cells'}: {note}"
        for order in ORDER_WORDS
        for pipeline in of_order(report, order)
        for note in pipeline.notes
    ]
    items = "".join(f"<li>{html.escape(note)}</li>" for note in notes)
    cite = (
        f"To cite: tetopt {report.versions.get('tetopt', '')}, comparison on {image.source.name} (SHA-256 "
        f"{image.source.sha256[:12]}), {report.date}; the method is of Goksel and Salcudean, MICCAI 2009. report.json "
        "beside this page has every number, of every run; runs/ has the meshes."
    )
    return [
        paragraph_html(cite),
        f"<p>To run it again:</p><pre>{html.escape(report.command)}</pre>",
        '<div class="settings">',
        *(table_html(rows, caption) for caption, rows in tables.items()),
        "</div>",
        folded_html("Notes of the runs", f"<ul>{items}</ul>" if notes else ""),
    ]


def _reference_text(reference: ReferenceGrid) -> str:
    energies = [f"ν {nu}: {number_text(row.strain_energy)}" for nu, row in reference.by_nu.items()]
    size = f"{_text(reference.shape, ' × ')} hexahedra, {reference.n_dofs} unknowns"
    own = [
        f"ν {nu}: {number_text(row.own_error.strain_energy)} and {number_text(row.own_error.displacement)}"
        for nu, row in reference.by_nu.items()
    ]
    return (
        f"{size}; {reference.note}; strain energy, µJ, {', '.join(energies)}; at half the resolution energy and "
        f"displacement differ by {', '.join(own)}"
    )


def _text(value: Any, between: str = ", ") -> str:
    """Any setting as text, sequences joined."""
    if isinstance(value, list | tuple):
        return between.join(_text(item) for item in value) or "none"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "none" if value is None else str(value)
    return f"{value:.10g}"


_TABLE_KEY = (
    '<p class="key">Here and below: ↓ smaller is better, ↑ larger is better; <b class="mark">best</b> marks the best '
    "of a row, and a tetopt that is not says by how much, red unless that decides nothing. Under a "
    "median of several runs its range. Rows in which all are equal, or neither way is better, have no best.</p>"
)
_COMPARE_STYLE = """
h1, p, li { overflow-wrap: anywhere; } .title { font-size: 1.15rem; }
table.measures, table.labels, table.claims { border-collapse: separate; border-spacing: 0; width: 100%; }
.measures th, .measures td, .labels th, .labels td, .claims th, .claims td {
  vertical-align: top; padding: 0.25rem 0.5rem; background: #fff; white-space: nowrap; }
.measures thead th, .labels thead th, .claims thead th {
  border-bottom: 2px solid #444; white-space: normal; vertical-align: bottom; }
th[scope=row] { font-weight: 400; }
.measures th:first-child, .labels th:first-child {
  position: sticky; left: 0; z-index: 1; min-width: 9rem; white-space: normal; }
.claims th:first-child { white-space: normal; min-width: 11rem; max-width: 24rem; }
.measures .part th { padding-top: 0.8rem; color: #555; font-size: 0.85rem; border-bottom: 1px solid #999; }
.measures .part span { position: sticky; left: 0.5rem; }
.measures small, .labels small, .claims small { display: block; font-weight: 400; font-size: 0.75rem; color: #666; }
.mark { display: block; font-size: 0.75rem; } .key .mark { display: inline; }
.measures td.tetopt { background: #f6f6f6; }
.measures td.best, .labels td.best, .claims td.best { background: #dcefe4; } td.best .value { font-weight: 700; }
.best .mark, .key .mark { color: #00593f; }
.measures td.lost, .claims td.lost { background: #fbe6dc; } .lost .mark { color: #a02c00; }
.labels td, .labels thead th { text-align: center; } .labels th:first-child { min-width: 5rem; text-align: left; }
.labels tbody tr > * { border-bottom: 1px solid #eee; } .labels small { line-height: 1.3; }
.labels small.failed { color: #a00000; } details th { white-space: normal; vertical-align: bottom; }
details { margin: 0.8rem 0; } summary { cursor: pointer; font-weight: 600; }
.failed { color: #a00000; } .key, .blind { color: #555; font-size: 0.85rem; } .blind ul, .blind p { margin: 0.2rem 0; }
pre { overflow-x: auto; background: #f4f4f4; padding: 0.7rem; white-space: pre-wrap; overflow-wrap: anywhere; }
.settings td { white-space: normal; overflow-wrap: anywhere; text-align: left; vertical-align: top; }
.settings th { text-align: left; } .settings td:first-child { overflow-wrap: normal; white-space: nowrap; }
@media screen and (max-width: 700px) {
  .measures th, .measures td, .labels th, .labels td { padding: 0.25rem 0.35rem; font-size: 0.85rem; }
  .measures th:first-child, .labels th:first-child { min-width: 6.5rem; max-width: 7.5rem; }
  .claims th:first-child { min-width: 8rem; max-width: 9rem; } .claims th, .claims td { padding: 0.25rem 0.3rem; }
}
@media print {
  .measures, .labels, .claims { font-size: 7.5pt; } .measures th, .measures td { padding: 0.08rem 0.3rem; }
  .measures small, .mark { font-size: 6.5pt; } .measures td, .mark { print-color-adjust: exact; }
  .wide { overflow: visible; } thead { display: table-header-group; }
  .measures th:first-child, .measures .part span { position: static; }
}
"""
