"""The labels' section of the comparison's page: who keeps them, which vanished, and a row for each."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from tetopt.report.page import paragraph_html, table_html
from tetopt.study.compare_criteria import (
    judged_labels,
    number_text,
    volume_error,
    voxels_by_label,
    which_labels,
    winners,
)
from tetopt.study.compare_report import LabelRow, PipelineResult, Report
from tetopt.study.compare_tables import TABLE_END, folded_html, table_head

UNFOLDED_LABELS = 12  # those whose rows are open to see: about a screen


class LabelMedians(NamedTuple):
    """What a pipeline's runs make of a label: medians, None where no run has a value."""

    dice: float | None
    surface_mean: float | None  # mm
    surface_p95: float | None  # mm
    volume_error: float | None  # fraction of the volume in the image
    mesh_components: float | None
    E_D_fraction: float | None
    area_ratio: float | None  # of its surface over that of its voxels smoothed
    folded: float | None  # fraction of its edges folded sharper than 60 degrees
    n_lost: int  # runs in which nothing carries it
    n_runs: int


def _label_medians(pipeline: PipelineResult, label: int) -> LabelMedians:
    rows = [row for run in pipeline.runs for row in run.measurement.labels if row.label == label]

    def median(value: Callable[[LabelRow], float | None]) -> float | None:
        values = [number for row in rows if (number := value(row)) is not None]
        return float(np.median(values)) if values else None

    names = ("dice", "surface_mean_mm", "surface_p95_mm", "mesh_components", "E_D_fraction", "area_ratio", "folded")
    dice, mean, p95, mesh_components, fraction, area, folded = (median(attrgetter(name)) for name in names)
    n_lost = sum(row.is_lost for row in rows)
    return LabelMedians(
        dice, mean, p95, median(volume_error), mesh_components, fraction, area, folded, n_lost, len(rows)
    )  # fmt: skip


def labels_html(report: Report, pictures: Sequence[str]) -> list[str]:
    """Vanished structures by name, the picture, then a row for each label, the worst first and the others folded."""
    done = [pipeline for pipeline in report.pipelines if pipeline.median is not None]
    voxels = voxels_by_label(report)
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
        "(vtkSurfaceNets3D), and fraction of its edges folded sharper than 60°. Labels on which "
        f"{done[first].title} has the lowest Dice come first."
    )
    heads = {label: _label_words(report, label) for label in voxels}
    words = [*_label_sentences(report), paragraph_html(how), _vanished_html(done, medians, voxels, heads), *pictures]
    words.append(_label_table_html(done, medians, voxels, {label: heads[label] for label in open_}))
    if folded:
        rest = _label_table_html(done, medians, voxels, {label: heads[label] for label in folded})
        words.append(folded_html(f"The other {len(folded)} labels", rest))
    components = {row.label: row.components for each in done for run in each.runs for row in run.measurement.labels}
    mesh_components = [["label", "in the image", *(pipeline.title for pipeline in done)]]
    fractions = [["label", "voxels", *(pipeline.title for pipeline in done)]]
    for label, rows in medians.items():
        mesh_components.append(
            [heads[label], str(components[label]), *(number_text(each.mesh_components) for each in rows)]
        )
        fractions.append([heads[label], str(voxels[label]), *(number_text(each.E_D_fraction) for each in rows)])
    words.append(folded_html("Connected components of each label", table_html(mesh_components)))
    words.append(folded_html("E_D in each label, fraction of the image's variance", table_html(fractions)))
    return words


def _label_table_html(
    done: Sequence[PipelineResult],
    medians: dict[int, list[LabelMedians]],
    voxels: dict[int, int],
    heads: dict[int, str],
) -> str:
    """A row for each label of `heads`, in words there, a column a pipeline; the best Dice of a row is marked."""
    lines = table_head("labels", "label", done)
    for label, words in heads.items():
        best = winners(1, [each.dice for each in medians[label]])
        cells = [
            f'<td class="{html.escape(pipeline.kind)}{" best" if number in best else ""}">{_label_cell(each)}</td>'
            for number, (pipeline, each) in enumerate(zip(done, medians[label], strict=True))
        ]
        head = f"{html.escape(words)}<small>{_voxels_text(voxels[label])}</small>"
        lines.append(f'<tr><th scope="row">{head}</th>{"".join(cells)}</tr>')
    return "\n".join([*lines, TABLE_END])


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


def _label_sentences(report: Report) -> list[str]:
    """Of labels that are given: on how many the first tetopt is no worse than each peer, and on which it is."""
    done = [pipeline for pipeline in report.pipelines if pipeline.median is not None]
    ours = [pipeline for pipeline in done if pipeline.kind == "tetopt"][:1]
    peers = [pipeline for pipeline in done if pipeline.kind == "peer"]
    judged = judged_labels(report)
    if report.labels is None or not judged:
        return []
    words = [line for own in ours for peer in peers for line in _label_verdict(own, peer, judged, report)]
    how = (
        "tetopt's own meshes, but not those of the paper's scheme, are to show the labels besides the image; E_D and "
        "the simulation judge the image alone."
    )
    return [*words, paragraph_html(how)] if ours else []


def _label_words(report: Report, label: int) -> str:
    return str(label) if report.labels is None else report.labels.words(label)


def _label_verdict(ours: PipelineResult, peer: PipelineResult, judged: Iterable[int], report: Report) -> Iterator[str]:
    pairs = {label: (_label_medians(ours, label), _label_medians(peer, label)) for label in judged}
    dice = [(round(own.dice or 0.0, 4), round(other.dice or 0.0, 4), label) for label, (own, other) in pairs.items()]
    worse = sorted((row for row in dice if row[0] < row[1]), key=lambda row: row[0] - row[1])
    farther = [label for label, (own, other) in pairs.items() if _is_farther(own.surface_mean, other.surface_mean)]
    title, other = html.escape(ours.title), html.escape(peer.title)
    yield (
        f"<p><strong>Of {len(pairs)} labels {which_labels(report)}, {title}'s Dice is at least {other}'s on "
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
