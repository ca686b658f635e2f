"""Headline of a comparison: tetopt against the best peer in a few numbers, and where it is behind.

It is the same on the page, in the terminal and in report.json.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

from tetopt.study.compare_criteria import (
    EQUAL_FRACTION,
    GROUPS,
    Criterion,
    CriterionEntry,
    criteria,
    entries_of,
    number_text,
    of_order,
    ratio_text,
    short_text,
    undecided,
    winners,
)
from tetopt.study.compare_report import ORDER_WORDS, Measurement, PipelineResult, Report
from tetopt.study.endings import AFTER_CRASHES

SIZE_TOLERANCE = 1.1  # a larger factor between numbers of nodes is remarked

Verdict = Literal["better", "worse", "no different", "no verdict"]


class Claim(NamedTuple):
    """A measure of tetopt's mesh and that of another."""

    group: str
    measure: str
    smaller_is_better: bool
    ours: CriterionEntry
    other: CriterionEntry
    other_title: str
    other_kind: str  # "peer", "control", or "tetopt" for another of its own meshes
    ratio: float | None  # tetopt's over the other's; None if one is 0 or missing
    verdict: Verdict  # on tetopt; "no different" within the runs' ranges, or by less than `EQUAL_FRACTION`
    beside: list[str]  # context: why there is no verdict, the reference's own change, nodes
    own_change: float | None  # of the reference from its half resolution; None if unknown, and for other measures
    blind: str  # what the measure does not capture

    @property
    def factor(self) -> float:
        """Factor by which the two differ, at least 1."""
        return math.inf if self.ratio is None else max(self.ratio, 1.0 / self.ratio)

    @property
    def is_lost(self) -> bool:
        """True if tetopt's number is worse, by any amount."""
        if self.ours.value is None or self.other.value is None:
            return self.ours.value is None
        return self.ours.value > self.other.value if self.smaller_is_better else self.ours.value < self.other.value

    @property
    def ratio_words(self) -> str:
        """The ratio to three digits, or the difference if there is no ratio."""
        if self.ratio is not None:
            return ratio_text(self.ratio)
        if self.ours.value is None or self.other.value is None:
            return "–"
        return f"{self.ours.value - self.other.value:+.3g}".replace("-", "−")


class Headline(NamedTuple):
    """The first section of the page."""

    title: str  # the compared pipelines, and those that failed
    remarks: list[str]  # numbers of nodes, and of runs
    claims: list[Claim]  # tetopt against the best peer of each measure
    behind: list[Claim]  # measures, except details, in which another mesh is better, by group, the worst first

    def behind_peers(self) -> list[Claim]:
        """Claims in which a peer is better."""
        return [claim for claim in self.behind if claim.other_kind == "peer"]

    def behind_others(self) -> list[Claim]:
        """Claims in which a control, or another of tetopt's own meshes, is better."""
        return [claim for claim in self.behind if claim.other_kind != "peer"]


def headline(report: Report) -> Headline:
    """Return the headline of a comparison."""
    ours = our_place(report)
    peers = [place for place, each in enumerate(report.pipelines) if each.kind == "peer" and each.median is not None]
    title, remarks = _title(report, ours, peers), _remarks(report, ours, peers)
    if ours is None:
        return Headline(title, remarks, [], [])
    rows = [row for row in criteria(report) if not row.is_detail and row.better]
    claims = [claim for row in rows if row.is_headline for claim in _claims(report, row, ours, peers)]
    others = [place for place in range(len(report.pipelines)) if place not in (ours, *peers)]
    every = [
        claim
        for row in rows
        for places in (peers, others if row.group != "Cost" else [])  # pipelines that ignore the image cost nothing
        for claim in _claims(report, row, ours, places)
    ]
    behind = [claim for claim in every if claim.verdict == "worse"]
    behind.sort(key=lambda claim: (GROUPS.index(claim.group), -claim.factor))
    return Headline(title, [*remarks, *_undecided_remark(every)], claims, behind)


def our_place(report: Report) -> int | None:
    """Return the pipeline of the headline: tetopt with its defaults, else the first of its meshes."""
    done = [place for place, each in enumerate(report.pipelines) if each.kind == "tetopt" and each.median is not None]
    return min(done, key=lambda place: report.pipelines[place].name != "tetopt", default=None)


def _claims(report: Report, row: Criterion, ours: int, places: list[int]) -> Iterator[Claim]:
    """Yield the claim on one measure, against the best mesh at these places, if any has a value."""
    entries = entries_of(row, report)
    known = [place for place in places if entries[place].value is not None]
    if not known:
        return
    best = max(known, key=lambda place: row.better * (entries[place].value or 0.0))
    own, other = entries[ours], entries[best]
    is_ratio = own.value is not None and other.value is not None and own.value > 0.0 and other.value > 0.0
    why = undecided(row, report, ours, best)
    verdict = _verdict(row, own, other)
    if why and verdict != "no different":
        verdict = "no verdict"
    title = row.title if row.part in GROUPS or row.group == "Image" else f"{row.title}, {row.part.split(', ', 1)[1]}"
    yield Claim(
        row.group, title, row.better < 0, own, other, report.pipelines[best].title, report.pipelines[best].kind,
        own.value / other.value if is_ratio and own.value and other.value else None,
        verdict, _beside(row, of_order(report, row.order), (ours, best), why if verdict == "no verdict" else ""),
        row.own_change, row.blind,
    )  # fmt: skip


def _beside(row: Criterion, pipelines: list[PipelineResult], places: tuple[int, int], why: str) -> list[str]:
    """Return the context of a claim: why it has no verdict, the reference's own change, both numbers of nodes."""
    words = [why] if why else []
    if row.is_error and not why:  # which states it
        change = "not known" if row.own_change is None else short_text(row.own_change)
        words.append(f"reference's own error {change}")
    nodes = [number_text(each.n_nodes) for place in places if (each := _measured(pipelines[place])) is not None]
    if len(set(nodes)) > 1:
        words.append(f"nodes {' and '.join(nodes)}")
    return words


def _measured(pipeline: PipelineResult) -> Measurement | None:
    return None if pipeline.median is None else pipeline.median.measurement


def _undecided_remark(claims: list[Claim]) -> Iterator[str]:
    """Yield a remark on peers' better numbers without a verdict, so that every loss is stated."""
    lost = [
        f"{claim.measure} ({claim.ratio_words}, {claim.beside[0]})"
        for claim in claims
        if claim.verdict == "no verdict" and claim.other_kind == "peer" and claim.is_lost
    ]
    if lost:
        yield f"A peer is better, but without a verdict: {'; '.join(lost)}."


def _verdict(row: Criterion, own: CriterionEntry, other: CriterionEntry) -> Verdict:
    if own.known is None or other.known is None:  # the other is known: a claim is against a mesh with a value
        return "worse"
    (value, low, high), (others, lowest, highest) = own.known, other.known
    if row.is_timed and low == high and others > 0.0:  # of one run: it scatters at least like the other's
        low, high = (value * each / others for each in (lowest, highest))
    is_near = abs(value - others) <= EQUAL_FRACTION * max(abs(value), abs(others))
    best = winners(row.better, [value, others])
    if is_near or len(best) != 1 or (low <= highest and lowest <= high):
        return "no different"
    return "better" if best == [0] else "worse"


def failure_words(each: PipelineResult) -> str:
    """Describe a failed pipeline, or one that is not installed."""
    if each.reason == "missing":
        return f"{each.title} is not installed"
    is_crash = each.reason == "crash"  # and was run again
    how = each.failure
    if is_crash:
        how = (how or "no run").removeprefix("twice ").removeprefix("crashed: ").removesuffix(f"; {AFTER_CRASHES}")
    return f"{each.title} failed{' twice' if is_crash else ''} ({how})"


def _title(report: Report, ours: int | None, peers: list[int]) -> str:
    tried = [each for each in report.pipelines if each.kind == "peer"]
    void = [failure_words(each) for each in tried if each.median is None]
    if ours is None:
        failed = [failure_words(each) for each in report.pipelines if each.kind == "tetopt"]
        return f"no tetopt mesh to compare: {'; '.join(failed) or 'none of its pipelines was requested'}"
    title = report.pipelines[ours].title
    if not peers:
        return f"{title} against no peer: {'; '.join(void) or 'none was requested'}"
    names = " and ".join(report.pipelines[place].title for place in peers)
    return "; ".join([f"{title} against {names} at {report.options.nodes} nodes", *void])


def _remarks(report: Report, ours: int | None, peers: list[int]) -> list[str]:
    places = [] if ours is None else [ours, *peers]
    remarks = []
    for order, word in ORDER_WORDS.items():
        shown = [of_order(report, order)[place] for place in places]
        sizes = {each.title: each.median.measurement.n_nodes for each in shown if each.median is not None}
        if sizes:
            counts = ", ".join(f"{title} {number_text(nodes)}" for title, nodes in sizes.items())
            is_equal = max(sizes.values()) <= SIZE_TOLERANCE * min(sizes.values())
            more = "" if is_equal else "; more nodes alone reduce E_D and the errors, see the curves"
            remarks.append(f"{'Nodes' if is_equal else 'The meshes differ in nodes'}, {word} cells: {counts}{more}.")
    if places:
        runs = ", ".join(f"{report.pipelines[place].title} {len(report.pipelines[place].runs)}" for place in places)
        remarks.append(
            f"Runs: {runs}. Numbers are medians; a difference within the runs' ranges, or below "
            f"{EQUAL_FRACTION:.1%}, does not count; a single run has no range. An error has no verdict if the "
            "meshes differ by less than the reference differs from its solution at half the resolution. Time and "
            "memory of single runs have no verdict either."
        )
    for order, word in ORDER_WORDS.items():
        for each in of_order(report, order):
            where = each.title if order == 1 else f"{each.title}, {word} cells"
            n_again = len(each.crashes) - (each.reason == "crash") * 2
            if n_again > 0:
                times = "once" if n_again == 1 else f"{n_again} times"
                remarks.append(f"{where}: crashed {times}, and was run again ({each.crashes[0]}).")
            if each.failure is not None and (each.median is not None or (order == 2 and each.reason != "missing")):
                how = "a run failed" if each.median is not None else "failed"
                remarks.append(f"{where}: {how}: {each.failure}.")
    return remarks
