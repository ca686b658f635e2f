"""The labels' section of the comparison's page: who keeps them, which vanished, and a row for each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from tetopt.study.compare_criteria import judged_labels, number_text, volume_error, voxels_by_label, which_labels
from tetopt.study.compare_report import LabelRow, PipelineResult, Report


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


class LabelLine(NamedTuple):
    """A label in all meshes."""

    label: int
    words: str  # with its name
    voxels: int
    medians: list[LabelMedians]  # by mesh


class LabelVerdict(NamedTuple):
    """tetopt's mesh beside a peer's, by their labels."""

    ours: str
    peer: str
    n_labels: int
    worse: list[str]  # labels with a lower Dice, both numbers behind them
    farther: list[str]  # those with a larger mean surface distance


class LabelSection(NamedTuple):
    """What the section shows."""

    done: list[PipelineResult]  # with a mesh
    first: str  # the one by whose Dice labels are ordered
    worst_first: list[LabelLine]
    verdicts: list[LabelVerdict]
    which: str  # are judged
    is_judged: bool
    vanished: list[tuple[str, list[tuple[LabelLine, LabelMedians]]]]  # by the pipeline's title
    components: list[list[str]]  # a table
    fractions: list[list[str]]  # a table of E_D's


def labels_of(report: Report) -> LabelSection | None:
    """What the section shows; None without labels."""
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
    lost = [[(line, line.medians[k]) for line in lines if line.medians[k].n_lost] for k in range(len(done))]
    components = {row.label: row.components for each in done for run in each.runs for row in run.measurement.labels}
    titles = [pipeline.title for pipeline in done]
    return LabelSection(
        done=done,
        first=titles[first],
        worst_first=sorted(lines, key=lambda line: (line.medians[first].dice or 0.0, line.voxels)),
        verdicts=[_verdict(own, peer, report) for own in ours for peer in peers] if judged else [],
        which=which_labels(report),
        is_judged=bool(judged and ours),
        vanished=[(title, rows) for title, rows in zip(titles, lost, strict=True) if rows],
        components=[["label", "in the image", *titles], *_rows(lines, components, attrgetter("mesh_components"))],
        fractions=[["label", "voxels", *titles], *_rows(lines, voxels_by_label(report), attrgetter("E_D_fraction"))],
    )


def _rows(
    lines: list[LabelLine], of_label: dict[int, int], value: Callable[[LabelMedians], float | None]
) -> Iterator[list[str]]:
    for line in lines:
        yield [line.words, str(of_label[line.label]), *(number_text(value(each)) for each in line.medians)]


def _label_words(report: Report, label: int) -> str:
    return str(label) if report.labels is None else report.labels.words(label)


def _verdict(ours: PipelineResult, peer: PipelineResult, report: Report) -> LabelVerdict:
    pairs = {label: (_label_medians(ours, label), _label_medians(peer, label)) for label in judged_labels(report)}
    dice = [(round(own.dice or 0.0, 4), round(other.dice or 0.0, 4), label) for label, (own, other) in pairs.items()]
    worse = sorted((row for row in dice if row[0] < row[1]), key=lambda row: row[0] - row[1])
    return LabelVerdict(
        ours.title, peer.title, len(pairs),
        [f"{_label_words(report, k)} ({number_text(a)} against {number_text(b)})" for a, b, k in worse],
        [
            _label_words(report, label) for label, (own, other) in pairs.items()
            if _is_farther(own.surface_mean, other.surface_mean)
        ],
    )  # fmt: skip


def _is_farther(value: float | None, other: float | None) -> bool:
    """Whether a distance is above another; where there is no surface it is above all others."""
    return other is not None and (value is None or value > other)
