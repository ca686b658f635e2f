"""The page of `tetopt compare`: report.json rendered, winners marked, losses said, with pictures and 3-D views."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tetopt.report import viewer
from tetopt.report.page import paragraph_html, picture_html, section_html, table_html, write_page
from tetopt.report.viewer import View, views_html
from tetopt.study.compare_report import (
    ORDER_WORDS,
    Curve,
    LabelRow,
    PipelineResult,
    ReferenceGrid,
    Report,
    Run,
    averages_of,
)
from tetopt.study.pipelines import UNTIMED_STEPS

PLOT_STEMS = (
    "histograms",
    "curves",
    "solve_time",
    "tradeoff",
    "timing",
)  # of the pictures that come after the 3-D views
JUDGED_VOXELS = 500  # labels with more are judged; of smaller ones a mesh of few nodes can only keep some
COMPRESSION_ERRORS = (  # of the compression, and the fields of `tetopt.fem.reference.Errors`
    ("strain-energy", "strain_energy"),
    ("displacement", "displacement"),
    ("interface-strain", "interface_strain"),
)
UNFOLDED_LABELS = 12  # those whose rows are open to see: about a screen
SIZE_TOLERANCE = 1.1  # meshes whose numbers of nodes differ by a larger factor are not compared without a word


class Criterion(NamedTuple):
    """What a row of the headline table compares."""

    group: str
    title: str
    value: Callable[[Run], float | None]
    better: int  # -1 if smaller is better, +1 if larger, 0 if neither
    order: int = 1  # of the cells whose meshes are compared


class Entry(NamedTuple):
    """What a pipeline has for a criterion."""

    value: float | None  # median
    low: float | None
    high: float | None


def save_compare_page(path: Path, report: Report, pictures: Sequence[tuple[Path, str]], views: Sequence[View]) -> None:
    """Write the comparison as one HTML file without outside references, whole or not at all.

    Parameters
    ----------
    path : Path
    report : Report
        What `report.json` holds; every number on the page is one of these, rounded to four digits, or computed from
        them for the rows of label volumes, and nothing is measured here.
    pictures : sequence of (PNG path, caption)
        Those named as in `PLOT_STEMS` come after the 3-D views, "labels" stands with the labels, the others before.
    views : sequence of View
        Surfaces to turn; without any, the section is left out.
    """
    of_labels = [picture_html(*each) for each in pictures if Path(each[0]).stem == "labels"]
    before = [picture_html(*each) for each in pictures if Path(each[0]).stem not in (*PLOT_STEMS, "labels")]
    after = [picture_html(*each) for each in pictures if Path(each[0]).stem in PLOT_STEMS]
    sections = [
        ("Result", [*simulation_sentences(report), *_sentences(report), _headline_html(report), *_failures(report)]),
        ("The simulation, by cells and moduli", simulation_html(report)),
        ("Labels", _labels_html(report, of_labels)),
        ("The same slice through every mesh", before),
        ("Turn the meshes", [views_html(views)] if views else []),
        ("Shapes, errors by number of nodes, times", after),
        ("Seconds by step", [_seconds_html(report)]),
        ("Settings, versions and how to run it again", _settings_html(report)),
    ]
    parts = [section_html(title, content) for title, content in sections if content]
    write_page(path, f"tetopt compared on {report.image.source.name}", parts, _COMPARE_STYLE + viewer.VIEWS_STYLE)


# --------------------------------------------------------------------------------------------------
# Criteria and winners


def criteria(report: Report) -> list[Criterion]:
    """The rows of the headline table, in order."""
    errors = {"mean": "(i) mean", "harmonic_mean": "(ii) harmonic mean", "l2": "(iii) L2", "worst": "(iv) worst"}
    kinds = ("sliver", "cap", "needle", "wedge", "spade")
    return [
        Criterion("Image", "E_D, share of the image's variance", _at("E_D_share"), -1),
        Criterion("Image", "voxels outside the mesh", _at("n_missed_voxels"), -1),
        Criterion("Size", "nodes", _at("n_nodes"), 0),
        Criterion("Size", "tetrahedra", _at("n_cells"), 0),
        *(Criterion("Shape", f"{word} rho", _at("quality", f"{word}_rho"), 1) for word in ("mean", "p1", "min")),
        *(Criterion("Shape", f"error {title}", _at("quality", "errors", name), -1) for name, title in errors.items()),
        Criterion("Shape", "smallest dihedral angle, °", _at("quality", "min_dihedral"), 1),
        Criterion("Shape", "dihedral angle p1, °", _at("quality", "p1_dihedral"), 1),
        Criterion("Shape", "largest dihedral angle, °", _at("quality", "max_dihedral"), -1),
        Criterion("Shape", "cells under 10°", _at("quality", "n_under_10_degrees"), -1),
        *(Criterion("Shape", f"{kind}s", _at("quality", "kinds", kind), -1) for kind in kinds),
        *_label_criteria(report),
        *(criterion for nu in _ratios(report) for criterion in _fem_criteria(report, nu)),
        Criterion("Cost", "wall time, s", lambda run: run.seconds_total, -1),
        Criterion("Cost", "peak memory, MB", lambda run: run.peak_bytes * 1e-6, -1),
    ]


def _at(*keys: str) -> Callable[[Run], float | None]:
    """What stands at this place of a run's measurement; None where a table on the way has no such row."""

    def value(run: Run) -> Any:
        item: Any = run.measurement
        for key in keys:
            if item is not None:
                item = item.get(key) if isinstance(item, dict) else getattr(item, key)
        return item

    return value


def _label_criteria(report: Report) -> list[Criterion]:
    judged = _judged(report)

    def over(of: Callable[[list[float]], float], value: Callable[[LabelRow], Any]) -> Callable[[Run], float | None]:
        def of_run(run: Run) -> float | None:
            values = [value(row) for row in run.measurement.labels if row.label in judged]
            # Without a lost label, which has no surface, the mean over the others would flatter.
            return of(values) if values and None not in values else None

        return of_run

    def by_voxels(value: Callable[[LabelRow], Any]) -> Callable[[Run], float | None]:
        weighed = over(sum, lambda row: None if value(row) is None else judged[row.label] * value(row))
        total = sum(judged.values())
        return lambda run: None if (whole := weighed(run)) is None else whole / total

    def mean(values: list[float]) -> float:
        return sum(values) / len(values)

    def largest_error(values: list[float]) -> float:
        return max(map(abs, values))

    rows: list[tuple[str, Callable[[Run], float | None], int]] = [
        ("mean label Dice", over(mean, attrgetter("dice")), 1),
        ("smallest label Dice", over(min, attrgetter("dice")), 1),
        ("mean label surface distance, mm", over(mean, attrgetter("surface_mean_mm")), -1),
        ("label surface distance p95, mm", over(mean, attrgetter("surface_p95_mm")), -1),
        ("label area over smoothed voxels', mean by voxels", by_voxels(attrgetter("area_ratio")), 0),
        ("label edges folded over 60°, mean by voxels", by_voxels(attrgetter("folded")), -1),
        ("label edges in more than two facets", over(sum, attrgetter("nonmanifold_edges")), -1),
        ("of these, where two labels meet", over(sum, attrgetter("nonmanifold_edges_two_labels")), -1),
        ("largest label volume error", over(largest_error, _volume_error), -1),
        ("labels in more or fewer pieces", over(sum, lambda row: row.mesh_components != row.components), -1),
        ("labels lost (of any size)", _n_lost, -1),
    ]
    return [Criterion(f"Labels {_which(report)}", *row) for row in rows]


def _judged(report: Report) -> dict[int, int]:
    """Voxels of the labels that are judged: the large ones if there are any, and no given segmentation's background."""
    voxels = _voxels_by_label(report)
    if _has_background(report):
        del voxels[0]
    return {label: n for label, n in voxels.items() if n > JUDGED_VOXELS} or voxels


def _has_background(report: Report) -> bool:
    return report.labels is not None and {0} < set(_voxels_by_label(report))


def _which(report: Report) -> str:
    """Which labels are judged, in words."""
    is_large = any(n > JUDGED_VOXELS for n in _judged(report).values())
    size = f"above {JUDGED_VOXELS} voxels" if is_large else "of any size"
    return f"{size}, background 0 not counted" if _has_background(report) else size


def _voxels_by_label(report: Report) -> dict[int, int]:
    return {row.label: row.voxels for each in report.pipelines for run in each.runs for row in run.measurement.labels}


def _fem_criteria(report: Report, nu: str) -> list[Criterion]:
    rows = []
    for order, word in ORDER_WORDS.items():
        group = f"Compression, ν = {nu}, {word} cells"
        rows += [
            Criterion(group, f"{title} error", _error(nu, report.options.average, name), -1, order)
            for title, name in COMPRESSION_ERRORS
        ]
        rows += [
            Criterion(group, "λ max", _at("fem", nu, "lambda_max"), 0, order),
            Criterion(group, "condition number", _at("fem", nu, "cond"), -1, order),
            Criterion(group, "CG iterations", _at("fem", nu, "cg_iterations"), -1, order),
        ]
    return rows


def _error(nu: str, average: str, name: str) -> Callable[[Run], float | None]:
    return _at("fem", nu, "averages", average, "errors", name)


def _of_order(report: Report, order: int) -> list[PipelineResult]:
    """The pipelines with their meshes for cells of this order."""
    return report.pipelines if order == 1 else report.quadratic


def _entries(criterion: Criterion, report: Report) -> list[Entry]:
    """What each pipeline has for a criterion."""
    return [entry(criterion, pipeline) for pipeline in _of_order(report, criterion.order)]


def entry(criterion: Criterion, pipeline: PipelineResult) -> Entry:
    """Median and range over a pipeline's runs; all None if no run has a value."""
    values = [value for run in pipeline.runs if (value := criterion.value(run)) is not None]
    return Entry(float(np.median(values)), min(values), max(values)) if values else Entry(None, None, None)


def winners(better: int, values: Sequence[float | None]) -> list[int]:
    """Places of the best values, equal ones as printed included; none if fewer than two differ."""
    known = [(number, value) for number, value in enumerate(values) if value is not None]
    if better == 0 or len({number_text(value) for _, value in known}) < 2:
        return []
    best = max(known, key=lambda pair: better * pair[1])[1]
    return [number for number, value in known if number_text(value) == number_text(best)]


def number_text(value: float | None) -> str:
    """A number as the page prints it: whole ones in full, others to four digits; "–" for none."""
    if value is None:
        return "–"
    if float(value).is_integer() and abs(value) < 1e9:
        return str(int(value))
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def _loss(value: float | None, best: float) -> str:
    """How far tetopt is from the best, in words."""
    if value is None:
        return "no value"
    if best > 0.0 and value > 0.0:
        ratio = value / best
        # 1.0 and 0.99 of the best would hide which way a narrow loss goes.
        return f"{ratio:.3g}× best" if abs(ratio - 1.0) > 0.005 else f"within {max(abs(ratio - 1), 1e-4):.1%} of best"
    return f"{number_text(abs(value - best))} from best"


def _volume_error(row: LabelRow) -> float | None:
    """Of a label in the mesh, as a share of its volume in the image."""
    return row.mesh_volume_mm3 / row.volume_mm3 - 1.0 if row.volume_mm3 else None


def _n_lost(run: Run) -> int | None:
    labels = run.measurement.labels
    return sum(row.is_lost for row in labels) if labels else None


def _ratios(report: Report) -> list[str]:
    """Poisson's ratios of which any pipeline has a result."""
    return sorted({nu for each in report.pipelines for run in each.runs for nu in run.measurement.fem}, key=float)


# --------------------------------------------------------------------------------------------------
# The headline


def _headline_html(report: Report) -> str:
    pipelines = report.pipelines
    lines = _table_head("headline", "median of the runs", pipelines)
    group = None
    for criterion in criteria(report):
        entries = _entries(criterion, report)
        if all(each.value is None for each in entries):
            continue
        if criterion.group != group:
            group = criterion.group
            head = f'<th scope="rowgroup" colspan="{len(pipelines) + 1}"><span>{html.escape(group)}</span></th>'
            lines.append(f'<tbody><tr class="group">{head}</tr>')
        lines.append(_row_html(criterion, _of_order(report, criterion.order), entries))
    return "\n".join([*lines, "</table></div>", _HEADLINE_KEY])


def _table_head(kind: str, first: str, pipelines: Sequence[PipelineResult]) -> list[str]:
    """Lines of a table of a column for each pipeline, up to its body."""
    heads = "".join(_head_cell(pipeline) for pipeline in pipelines)
    row = f'<thead><tr><th scope="col">{first}</th>{heads}</tr></thead>'
    return [f'<div class="wide"><table class="{kind}">', row]


def _head_cell(pipeline: PipelineResult) -> str:
    notes = [pipeline.kind] if pipeline.kind != "tetopt" else []
    if pipeline.median is None:
        notes = [*notes, "failed"]
    elif pipeline.failure:
        notes = [*notes, "a run failed"]
    if len(pipeline.runs) > 1:
        notes = [*notes, f"{len(pipeline.runs)} runs"]
    note = f"<small>{html.escape(', '.join(notes))}</small>" if notes else ""
    return f'<th scope="col" class="{html.escape(pipeline.kind)}">{html.escape(pipeline.title)}{note}</th>'


def _row_html(criterion: Criterion, pipelines: Sequence[PipelineResult], entries: Sequence[Entry]) -> str:
    best = winners(criterion.better, [each.value for each in entries])
    cells = []
    is_lost = False
    for number, (pipeline, each) in enumerate(zip(pipelines, entries, strict=True)):
        kinds, mark = [pipeline.kind], ""
        if number in best:
            kinds.append("best")
            mark = '<b class="mark">best</b>' if len(best) == 1 else '<b class="mark">best, tied</b>'
        elif best and pipeline.kind == "tetopt":
            is_lost = True
            kinds.append("lost")
            top = entries[best[0]].value
            assert top is not None, "a winner has a value"
            mark = f'<b class="mark">loses: {html.escape(_loss(each.value, top))}</b>'
        cells.append(f'<td class="{html.escape(" ".join(kinds))}">{_value_html(pipeline, each)}{mark}</td>')
    arrow = {-1: " ↓", 1: " ↑", 0: ""}[criterion.better]
    row = '<tr class="loses">' if is_lost else "<tr>"
    return f'{row}<th scope="row">{html.escape(criterion.title)}{arrow}</th>{"".join(cells)}</tr>'


def _value_html(pipeline: PipelineResult, each: Entry) -> str:
    if pipeline.median is None:
        return '<span class="failed">failed</span>'
    text = f'<span class="value">{number_text(each.value)}</span>'
    is_range = each.value is not None and len(pipeline.runs) > 1
    return text + f"<small>{number_text(each.low)} to {number_text(each.high)}</small>" if is_range else text


def _sentences(report: Report) -> list[str]:
    """What to read first: where tetopt is best, where it loses and to whom, and what makes that uneven."""
    pipelines = report.pipelines
    words = _label_sentences(report)
    for number, pipeline in enumerate(pipelines):
        if pipeline.kind == "tetopt":
            if pipeline.median is not None:
                words += _verdict(report, number)
            else:
                words.append(f"<p><strong>{html.escape(pipeline.title)} failed.</strong></p>")
    failed = [each.title for each in pipelines if each.median is None and each.kind != "tetopt"]
    if failed:
        words.append(paragraph_html(f"Failed, see under the table: {', '.join(failed)}."))
    sizes = {each.title: each.median.measurement.n_nodes for each in pipelines if each.median is not None}
    if sizes and max(sizes.values()) > SIZE_TOLERANCE * min(sizes.values()):
        counts = ", ".join(f"{title} {number_text(nodes)}" for title, nodes in sizes.items())
        words.append(
            paragraph_html(
                f"The meshes differ in nodes ({counts}), and more nodes alone make E_D and the errors smaller; "
                "the curves below compare at equal nodes."
            )
        )
    return words


def _verdict(report: Report, number: int) -> list[str]:
    """Where the pipeline at this place of the list is best and where it loses, as two or three paragraphs."""
    pipelines = report.pipelines
    title = html.escape(pipelines[number].title)
    won: list[str] = []
    lost: dict[str, list[str]] = {}
    n_judged = n_lost_to_peers = 0
    for criterion in criteria(report):
        entries = _entries(criterion, report)
        best = winners(criterion.better, [each.value for each in entries])
        if not best:
            continue
        n_judged += 1
        name = re.sub(", (°|s|MB|mm)$", "", criterion.title)
        if criterion.group.startswith("Compression, "):
            name += f" ({criterion.group.removeprefix('Compression, ')})"
        if number in best:
            won.append(name)
            continue
        lost.setdefault(" and ".join(pipelines[k].title for k in best), []).append(name)
        rest = [None if pipelines[k].kind == "control" else each.value for k, each in enumerate(entries)]
        best_of_peers = winners(criterion.better, rest)
        n_lost_to_peers += bool(best_of_peers) and number not in best_of_peers
    if not n_judged:
        return [f"<p>Nothing to compare {title} with.</p>"]
    words = [f"<p><strong>{title} is best in {len(won)} of {n_judged} measures</strong>{_list(won)}.</p>"]
    if lost:
        items = "".join(f"<li>to {html.escape(to)}{_list(names)}</li>" for to, names in lost.items())
        n_lost = sum(len(names) for names in lost.values())
        words.append(f"<p><strong>It loses in {n_lost}:</strong></p><ul>{items}</ul>")
    if lost and any(each.kind == "control" for each in pipelines):
        words.append(
            f"<p>Without the controls, which do not see the image, it would lose in {n_lost_to_peers} of them.</p>"
        )
    return words


def _label_sentences(report: Report) -> list[str]:
    """Of labels that are given: on how many the first tetopt is no worse than each peer, and on which it is."""
    done = [pipeline for pipeline in report.pipelines if pipeline.median is not None]
    ours = [pipeline for pipeline in done if pipeline.kind == "tetopt"][:1]
    peers = [pipeline for pipeline in done if pipeline.kind == "peer"]
    judged = _judged(report)
    if report.labels is None or not judged:
        return []
    words = [line for own in ours for peer in peers for line in _label_verdict(own, peer, judged, report)]
    how = (
        "tetopt's own meshes, but not those of the paper's scheme, are to show the labels besides the image; E_D and "
        "the simulation judge the image alone."
    )
    return [*words, paragraph_html(how)] if ours else []


def _label_words(report: Report, label: int) -> str:
    return _text(label) if report.labels is None else report.labels.words(label)


def _label_verdict(ours: PipelineResult, peer: PipelineResult, judged: Iterable[int], report: Report) -> Iterator[str]:
    pairs = {label: (_label_medians(ours, label), _label_medians(peer, label)) for label in judged}
    dice = [(round(own.dice or 0.0, 4), round(other.dice or 0.0, 4), label) for label, (own, other) in pairs.items()]
    worse = sorted((row for row in dice if row[0] < row[1]), key=lambda row: row[0] - row[1])
    farther = [label for label, (own, other) in pairs.items() if _is_farther(own.surface_mean, other.surface_mean)]
    title, other = html.escape(ours.title), html.escape(peer.title)
    yield (
        f"<p><strong>Of {len(pairs)} labels {_which(report)}, {title}'s Dice is at least {other}'s on "
        f"{len(pairs) - len(worse)}</strong>, and its mean surface distance no larger on "
        f"{len(pairs) - len(farther)}.</p>"
    )
    if worse:
        names = ", ".join(f"{_label_words(report, k)} ({number_text(a)} against {number_text(b)})" for a, b, k in worse)
        yield f"<p>{title}'s Dice is below {other}'s on label {html.escape(names)}.</p>"
    if farther:
        names = html.escape(", ".join(_label_words(report, label) for label in farther))
        yield f"<p>{title}'s mean surface distance is larger than {other}'s on label {names}.</p>"


def _is_farther(value: float | None, other: float | None) -> bool:
    """Whether a distance is above another; where there is no surface it is above all others."""
    return other is not None and (value is None or value > other)


def _list(names: Sequence[str]) -> str:
    return f": {html.escape(', '.join(names))}" if names else ""


def _failures(report: Report) -> Iterator[str]:
    linear, quadratic = (_of_order(report, order) for order in ORDER_WORDS)
    for number, pipeline in enumerate([*linear, *quadratic]):
        title = html.escape(pipeline.title) + ("" if number < len(linear) else ", quadratic cells,")
        if pipeline.failure:
            what = " failed" if pipeline.median is None else ", a run failed"
            failure = html.escape(pipeline.failure)
            yield f'<p class="failed"><strong>{title}{what}:</strong> {failure}</p>'
        reason = None if pipeline.median is None else pipeline.median.measurement.not_compressed
        if reason is not None:
            yield f"<p><strong>{title} was not compressed:</strong> {html.escape(reason)}</p>"


# --------------------------------------------------------------------------------------------------
# Linear and quadratic cells, averages of moduli


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
    rows = []
    for order in ORDER_WORDS:
        for average in averages_of(report.options):
            criterion = Criterion("", "", _error(nu, average, name), -1, order)
            for pipeline, each in zip(_of_order(report, order), _entries(criterion, report), strict=True):
                if each.value is not None:
                    rows.append(Variant(pipeline, order, average, each.value))
    return sorted(rows, key=lambda row: row.error)


def simulation_sentences(report: Report) -> list[str]:
    """For each Poisson's ratio: with which mesh, cells and moduli the displacement is best, and the best of others."""
    words = []
    for nu in _ratios(report):
        rows = _variants(report, nu, "displacement")
        if not rows:
            continue
        best = rows[0]
        energy = _error(nu, best.average, "strain_energy")
        loss = entry(Criterion("", "", energy, -1, best.order), best.pipeline).value
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


def simulation_html(report: Report) -> list[str]:
    """A table of all errors, a row for each order of cells and average; and the errors at equal times of a solve."""
    ratios = _ratios(report)
    if not ratios:
        return []
    how = (
        "Linear cells on the mesh of so many nodes; quadratic cells on a coarser mesh of the same pipeline, which has "
        "as many nodes with those in the middle of its (straight) edges. Moduli of cells: the mean of Eq. (2)"
        + ("" if report.options.average == "mean" else f", and the average that was set, {report.options.average}")
        + "."
    )
    lines = _table_head("headline", "median of the runs", report.pipelines)
    for nu in ratios:
        for title, name in COMPRESSION_ERRORS:
            head = f"{title} error, ν = {nu}"
            lines.append(
                f'<tbody><tr class="group"><th scope="rowgroup" colspan="{len(report.pipelines) + 1}">'
                f"<span>{html.escape(head)}</span></th></tr>"
            )
            for order, word in ORDER_WORDS.items():
                for average in averages_of(report.options):
                    criterion = Criterion(head, f"{word} cells, {average}", _error(nu, average, name), -1, order)
                    entries = _entries(criterion, report)
                    if any(each.value is not None for each in entries):
                        lines.append(_row_html(criterion, _of_order(report, order), entries))
    parts = [paragraph_html(how), "\n".join([*lines, "</table></div>"])]
    times = equal_times(report)
    if times:
        again = (
            "At equal time: the seconds of the processor that the linear mesh takes for matrix and solve, its "
            "displacement error, and that of quadratic cells which take as long, between the two measured meshes that "
            "take less and more (logarithms, linearly); – where the curve does not reach so far."
        )
        names = ["pipeline", "ν", "seconds", "linear", "quadratic"]
        parts += [paragraph_html(again), table_html([names, *times])]
    return parts


def equal_times(report: Report) -> list[list[str]]:
    """Rows of pipeline, nu, seconds of the linear mesh's solve, its displacement error and the quadratic one then."""
    curves = {(curve.name, curve.order): curve for curve in report.curves}
    rows = []
    for pipeline in report.pipelines:
        quadratic = curves.get((pipeline.name, 2))
        for nu in _ratios(report):
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


# --------------------------------------------------------------------------------------------------
# Labels, times, settings


class LabelMedians(NamedTuple):
    """What a pipeline's runs make of a label: medians, None where no run has a value."""

    dice: float | None
    surface_mean: float | None  # mm
    surface_p95: float | None  # mm
    volume_error: float | None  # share of the volume in the image
    pieces: float | None
    E_D_share: float | None
    area_ratio: float | None  # of its surface over that of its voxels smoothed
    folded: float | None  # share of its edges folded sharper than 60 degrees
    n_lost: int  # runs in which nothing carries it
    n_runs: int


def _label_medians(pipeline: PipelineResult, label: int) -> LabelMedians:
    rows = [row for run in pipeline.runs for row in run.measurement.labels if row.label == label]

    def median(value: Callable[[LabelRow], float | None]) -> float | None:
        values = [number for row in rows if (number := value(row)) is not None]
        return float(np.median(values)) if values else None

    names = ("dice", "surface_mean_mm", "surface_p95_mm", "mesh_components", "E_D_share", "area_ratio", "folded")
    dice, mean, p95, pieces, share, area, folded = (median(attrgetter(name)) for name in names)
    n_lost = sum(row.is_lost for row in rows)
    return LabelMedians(
        dice, mean, p95, median(_volume_error), pieces, share, area, folded, n_lost, len(rows)
    )  # fmt: skip


def _labels_html(report: Report, pictures: Sequence[str]) -> list[str]:
    """Vanished structures by name, the picture, then a row for each label, the worst first and the others folded."""
    done = [pipeline for pipeline in report.pipelines if pipeline.median is not None]
    voxels = _voxels_by_label(report)
    if not voxels:
        return []
    medians = {label: [_label_medians(pipeline, label) for pipeline in done] for label in voxels}
    first = next((k for k, pipeline in enumerate(done) if pipeline.kind == "tetopt"), 0)
    order = sorted(voxels, key=lambda label: (medians[label][first].dice or 0.0, voxels[label]))
    open_, folded = order[:UNFOLDED_LABELS], order[UNFOLDED_LABELS:]
    origin = f"The labels of {report.labels.name}." if report.labels else "Classes of the voxels' intensities."
    how = (
        f"{origin} Each cell counts for the label that its mesher gives it, or else most of its voxels carry. In the "
        "table, for each label and mesh: Dice; mean and 95th percentile of the distance between the label's surfaces "
        "in mesh and image, both ways; error of its volume; area of its surface over that of its voxels smoothed "
        "(vtkSurfaceNets3D), and share of its edges folded sharper than 60°. Labels on which "
        f"{done[first].title} has the lowest Dice come first."
    )
    heads = {label: _label_words(report, label) for label in voxels}
    words = [paragraph_html(how), _vanished_html(done, medians, voxels, heads), *pictures]
    words.append(_label_table_html(done, medians, voxels, {label: heads[label] for label in open_}))
    if folded:
        rest = _label_table_html(done, medians, voxels, {label: heads[label] for label in folded})
        words.append(_folded(f"The other {len(folded)} labels", rest))
    components = {row.label: row.components for each in done for run in each.runs for row in run.measurement.labels}
    pieces = [["label", "in the image", *(pipeline.title for pipeline in done)]]
    shares = [["label", "voxels", *(pipeline.title for pipeline in done)]]
    for label, rows in medians.items():
        pieces.append([heads[label], str(components[label]), *(number_text(each.pieces) for each in rows)])
        shares.append([heads[label], str(voxels[label]), *(number_text(each.E_D_share) for each in rows)])
    words.append(_folded("Connected pieces of each label", table_html(pieces)))
    words.append(_folded("E_D in each label, share of the image's variance", table_html(shares)))
    return words


def _folded(title: str, content: str) -> str:
    return f"<details><summary>{html.escape(title)}</summary>{content}</details>"


def _label_table_html(
    done: Sequence[PipelineResult],
    medians: dict[int, list[LabelMedians]],
    voxels: dict[int, int],
    heads: dict[int, str],
) -> str:
    """A row for each label of `heads`, in words there, a column a pipeline; the best Dice of a row is marked."""
    lines = _table_head("headline labels", "label", done)
    lines[-1] += "<tbody>"
    for label, words in heads.items():
        best = winners(1, [each.dice for each in medians[label]])
        cells = [
            f'<td class="{html.escape(pipeline.kind)}{" best" if number in best else ""}">{_label_cell(each)}</td>'
            for number, (pipeline, each) in enumerate(zip(done, medians[label], strict=True))
        ]
        head = f"{html.escape(words)}<small>{_voxels_text(voxels[label])}</small>"
        lines.append(f'<tr><th scope="row">{head}</th>{"".join(cells)}</tr>')
    return "\n".join([*lines, "</tbody></table></div>"])


def _voxels_text(count: float) -> str:
    return f"{number_text(count)} voxel" + ("" if count == 1 else "s")


def _label_cell(each: LabelMedians) -> str:
    if each.n_lost and each.n_lost == each.n_runs:
        return '<span class="failed">lost</span>'
    # The same number of decimals everywhere, so that those of a row and a column are compared at a glance.
    parts = [f'<span class="value">{"–" if each.dice is None else f"{each.dice:.3f}"}</span>']
    if each.surface_mean is not None and each.surface_p95 is not None:
        parts.append(f"<small>{each.surface_mean:.2f} / {each.surface_p95:.2f} mm</small>")
    if each.volume_error is not None:
        percent = round(100.0 * each.volume_error, 1) + 0.0  # no -0.0
        parts.append(f"<small>vol. {percent:+.1f} %</small>".replace("-", "−"))
    if each.area_ratio is not None and each.folded is not None:
        parts.append(f"<small>area {each.area_ratio:.2f}, folded {100.0 * each.folded:.0f} %</small>")
    if each.n_lost:
        parts.append(f'<small class="failed">lost in {each.n_lost} of {each.n_runs} runs</small>')
    return "".join(parts)


def _vanished_html(
    done: Sequence[PipelineResult],
    medians: dict[int, list[LabelMedians]],
    voxels: dict[int, int],
    heads: dict[int, str],
) -> str:
    """Which labels no cell stands for, by pipeline."""
    items = []
    for number, pipeline in enumerate(done):
        lost = [(label, medians[label][number]) for label in voxels if medians[label][number].n_lost]
        if lost:
            names = ", ".join(
                f"label {heads[label]} ({_voxels_text(voxels[label])}"
                + (")" if each.n_lost == each.n_runs else f", in {each.n_lost} of {each.n_runs} runs)")
                for label, each in lost
            )
            items.append(f"<li>{html.escape(pipeline.title)}: {html.escape(names)}</li>")
    if not items:
        return "<p>No label vanished from any mesh.</p>"
    return f"<p><strong>Vanished from the mesh:</strong></p><ul>{''.join(items)}</ul>"


def _seconds_html(report: Report) -> str:
    rows = [["pipeline", "step", "seconds", "low to high", "remark"]]
    for pipeline in report.pipelines:
        median, low, high = pipeline.median, pipeline.low, pipeline.high
        if median is None or low is None or high is None:
            rows.append([pipeline.title, "–", "–", "", "failed"])
            continue
        for step, seconds in median.seconds.items():
            spread = f"{number_text(low.seconds[step])} to {number_text(high.seconds[step])}"
            spread = spread if len(pipeline.runs) > 1 else ""
            rows.append([pipeline.title, step, number_text(seconds), spread, UNTIMED_STEPS.get(step, "")])
    return table_html(rows)


def _settings_html(report: Report) -> list[str]:
    image, labels = report.image, report.labels
    shape, spacing = _text(image.shape, " × "), _text(image.spacing_mm, " × ")
    tables = {
        "Pipelines": [["pipeline", "what it is"], *([each.title, each.about] for each in report.pipelines)],
        "Data and machine": [
            ["what", "value"],
            ["image", f"{image.source.name}, {shape} voxels of {spacing} mm"],
            ["image's variance", number_text(image.variance)],
            ["image's SHA-256", image.source.sha256],
            ["labels", f"{labels.name} ({labels.kind})" if labels else "none given"],
            ["modulus", report.law],
            ["reference", _reference_text(report.reference)],
            ["machine", ", ".join(f"{key} {_text(value)}" for key, value in report.machine.items())],
            ["whole comparison, s", number_text(report.seconds)],
        ],
        "Options": [["option", "value"], *([name, _text(value)] for name, value in report.options._asdict().items())],
        "Versions": [["package", "version"], *([name, value] for name, value in report.versions.items())],
    }
    notes = [
        f"{pipeline.title}{'' if order == 1 else ', quadratic cells'}: {note}"
        for order in ORDER_WORDS
        for pipeline in _of_order(report, order)
        for note in pipeline.notes
    ]
    items = "".join(f"<li>{html.escape(note)}</li>" for note in notes)
    return [
        f"<p>To run it again:</p><pre>{html.escape(report.command)}</pre>",
        '<div class="settings">',
        *(table_html(rows, caption) for caption, rows in tables.items()),
        "</div>",
        f"<h3>Notes</h3><ul>{items}</ul>" if notes else "",
    ]


def _reference_text(reference: ReferenceGrid) -> str:
    energies = [f"ν {nu}: {number_text(row.strain_energy)}" for nu, row in reference.by_nu.items()]
    size = f"{_text(reference.shape, ' × ')} hexahedra, {reference.n_dofs} unknowns"
    own = [
        f"ν {nu}: {number_text(row.own_error.strain_energy)} and {number_text(row.own_error.displacement)}"
        for nu, row in reference.by_nu.items()
    ]
    return (
        f"{size}; {reference.note}; strain energy {', '.join(energies)}; at half the resolution the energy and the "
        f"displacement differ by {', '.join(own)}"
    )


def _text(value: Any, between: str = ", ") -> str:
    """Any setting as text, sequences joined."""
    if isinstance(value, list | tuple):
        return between.join(_text(item) for item in value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "none" if value is None else str(value)
    return f"{value:.10g}"


_HEADLINE_KEY = (
    '<p class="key">↓ smaller is better, ↑ larger is better; <b class="mark">best</b> marks the winner of a row and '
    "<b>loses</b> a tetopt that is not. Under a median of several runs its range, lowest to highest. Rows in which "
    "all are equal, or in which neither way is better, have no winner.</p>"
)
_COMPARE_STYLE = """
h1, p, li { overflow-wrap: anywhere; }
table.headline { border-collapse: separate; border-spacing: 0; width: 100%; }
.headline th, .headline td { vertical-align: top; padding: 0.25rem 0.5rem; background: #fff; white-space: nowrap; }
.headline thead th { border-bottom: 2px solid #444; white-space: normal; vertical-align: bottom; }
.headline th[scope=row] { font-weight: 400; }
.headline th:first-child { position: sticky; left: 0; z-index: 1; min-width: 9rem; white-space: normal; }
.headline .group th { padding-top: 1rem; color: #555; font-size: 0.85rem; border-bottom: 1px solid #999; }
.headline .group span { position: sticky; left: 0.5rem; }
.headline small { display: block; font-weight: 400; font-size: 0.75rem; color: #666; }
.headline .mark { display: block; font-size: 0.75rem; }
.headline td.tetopt { background: #f6f6f6; }
.headline td.best { background: #dcefe4; } td.best .value { font-weight: 700; }
.best .mark, .key .mark { color: #00593f; }
.headline td.lost { background: #fbe6dc; } .lost .mark { color: #a02c00; }
.labels td, .labels thead th { text-align: center; } .labels th:first-child { min-width: 5rem; text-align: left; }
.labels tbody tr > * { border-bottom: 1px solid #eee; } .labels small { line-height: 1.3; }
.labels small.failed { color: #a00000; } details th { white-space: normal; vertical-align: bottom; }
details { margin: 0.8rem 0; } summary { cursor: pointer; font-weight: 600; }
.failed { color: #a00000; } .key { color: #555; font-size: 0.85rem; }
pre { overflow-x: auto; background: #f4f4f4; padding: 0.7rem; white-space: pre-wrap; overflow-wrap: anywhere; }
.settings td { white-space: normal; overflow-wrap: anywhere; text-align: left; vertical-align: top; }
.settings th { text-align: left; } .settings td:first-child { overflow-wrap: normal; white-space: nowrap; }
@media screen and (max-width: 700px) {
  .headline th, .headline td { padding: 0.25rem 0.35rem; font-size: 0.85rem; }
  .headline th:first-child { min-width: 6.5rem; max-width: 7.5rem; }
}
@media print {
  .headline { font-size: 7.5pt; } .headline th, .headline td { padding: 0.08rem 0.3rem; }
  .headline small, .headline .mark { font-size: 6.5pt; }
  .headline .group th { padding-top: 0.3rem; } .headline td, .mark { print-color-adjust: exact; }
  .wide { overflow: visible; } thead { display: table-header-group; }
  .headline th:first-child, .headline .group span { position: static; }
}
"""
