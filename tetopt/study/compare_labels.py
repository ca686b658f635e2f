"""The labels' section of the comparison's page: fidelity, lost labels, and a row for each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from tetopt.study.compare_criteria import judged_labels, number_text, volume_error, voxels_by_label, which_labels
from tetopt.study.compare_report import PipelineResult, Report

# Fields of `LabelRow` to show for each label, in addition to its volume error.
SHOWN_FIELDS = (
    "dice", "surface_mean_mm", "surface_p95_mm", "mesh_components", "E_D_fraction", "area_ratio", "folded",
    "one_layer_fraction", "excess_contact_mm2",
)  # fmt: skip


def _label_medians(pipeline: PipelineResult, label: int) -> dict[str, Any]:
    """Return a pipeline's results for a label: medians, None if no run has a value; number of runs that lose it."""
    rows = [row for run in pipeline.runs for row in run.measurement.labels if row.label == label]
    values = {name: [getattr(row, name) for row in rows] for name in SHOWN_FIELDS}
    values["volume_error"] = [volume_error(row) for row in rows]
    known = {name: [value for value in each if value is not None] for name, each in values.items()}
    medians = {name: float(np.median(each)) if each else None for name, each in known.items()}
    return {**medians, "n_lost": sum(row.is_lost for row in rows), "n_runs": len(rows)}


class LabelLine(NamedTuple):
    """A label in all meshes."""

    label: int
    words: str  # with its name
    voxels: int
    medians: list[dict[str, Any]]  # by mesh


def labels_of(report: Report) -> dict[str, Any] | None:
    """Return the section's content, by the names in its template; None without labels."""
    done = [pipeline for pipeline in report.pipelines if pipeline.median is not None]
    lines = [
        LabelLine(label, _label_words(report, label), n_voxels, [_label_medians(pipeline, label) for pipeline in done])
        for label, n_voxels in voxels_by_label(report).items()
    ]
    if not lines:
        return None
    first = next((k for k, pipeline in enumerate(done) if pipeline.kind == "tetopt"), 0)
    ours = [pipeline for pipeline in done if pipeline.kind == "tetopt"][:1]
    peers = [pipeline for pipeline in done if pipeline.kind == "peer"]
    judged = report.labels is not None and judged_labels(report)
    lost = [[(line, line.medians[k]) for line in lines if line.medians[k]["n_lost"]] for k in range(len(done))]
    components = {row.label: row.components for each in done for run in each.runs for row in run.measurement.labels}
    titles = [pipeline.title for pipeline in done]
    return {
        "done": done,  # with a mesh
        "first": titles[first],  # its Dice orders the labels
        "worst_first": sorted(lines, key=lambda line: (line.medians[first]["dice"] or 0.0, line.voxels)),
        "verdicts": [_verdict(own, peer, report) for own in ours for peer in peers] if judged else [],
        "which": which_labels(report),
        "is_judged": bool(judged and ours),
        "vanished": [(title, rows) for title, rows in zip(titles, lost, strict=True) if rows],
        "components": [["label", "in the image", *titles], *_rows(lines, components, "mesh_components")],
        "fractions": [["label", "voxels", *titles], *_rows(lines, voxels_by_label(report), "E_D_fraction")],
        "layers": [["label", "voxels", *titles], *_rows(lines, voxels_by_label(report), "one_layer_fraction")],
        "contacts": [["label", "voxels", *titles], *_rows(lines, voxels_by_label(report), "excess_contact_mm2")],
    }


def _rows(lines: list[LabelLine], of_label: dict[int, int], name: str) -> Iterator[list[str]]:
    for line in lines:
        yield [line.words, str(of_label[line.label]), *(number_text(each[name]) for each in line.medians)]


def _label_words(report: Report, label: int) -> str:
    return str(label) if report.labels is None else report.labels.words(label)


def _verdict(ours: PipelineResult, peer: PipelineResult, report: Report) -> dict[str, Any]:
    """Compare tetopt's mesh with a peer's: labels with lower Dice, the worst first, and those with larger distance."""
    pairs = {label: (_label_medians(ours, label), _label_medians(peer, label)) for label in judged_labels(report)}
    dice = [(round(a["dice"] or 0.0, 4), round(b["dice"] or 0.0, 4), label) for label, (a, b) in pairs.items()]
    worse = sorted((row for row in dice if row[0] < row[1]), key=lambda row: row[0] - row[1])
    farther = (label for label, (a, b) in pairs.items() if _is_farther(a["surface_mean_mm"], b["surface_mean_mm"]))
    return {
        "ours": ours.title,
        "peer": peer.title,
        "n_labels": len(pairs),
        "worse": [f"{_label_words(report, k)} ({number_text(a)} against {number_text(b)})" for a, b, k in worse],
        "farther": [_label_words(report, label) for label in farther],
    }


def _is_farther(value: float | None, other: float | None) -> bool:
    """Return whether a distance exceeds another; without a surface it exceeds all others."""
    return other is not None and (value is None or value > other)
