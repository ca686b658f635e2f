"""Criteria of a comparison: measures in four groups, their best values, and what each does not capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from tetopt.study.compare_report import ORDER_WORDS, LabelRow, PipelineResult, PipelineRun, Report, averages_of

GROUPS = ("Image", "Shape", "Simulation", "Cost")
JUDGED_VOXELS = 500  # labels with more are judged; a mesh of few nodes keeps only some smaller ones
COMPRESSION_ERRORS = (  # of the compression, and the fields of `tetopt.fem.reference.Errors`
    ("strain-energy", "strain_energy"),
    ("displacement", "displacement"),
    ("interface-strain", "interface_strain"),
)
MEBI_BYTES = 1e-6  # megabytes in a byte
FULL_DIGITS = (1e4, 1e9)  # numbers from the first are printed without a fraction, below the second in full
EQUAL_FRACTION = 0.005  # of a value: smaller differences do not count, and three digits do not show them


class Criterion(NamedTuple):
    """A row of a table."""

    group: str  # of `GROUPS`
    part: str  # its heading
    title: str
    value: Callable[[PipelineRun], float | None]
    better: int  # -1 if smaller is better, +1 if larger, 0 if neither
    order: int = 1  # of the cells whose meshes are compared
    is_detail: bool = False  # in the folded table
    is_headline: bool = False
    blind: str = ""  # what it does not capture, in a line
    is_timed: bool = False  # depends on the machine's load: no verdict without repeats
    is_error: bool = False  # against the reference
    own_change: float | None = None  # of the reference, from its half resolution; None if unknown


class CriterionEntry(NamedTuple):
    """A pipeline's value for a criterion."""

    value: float | None  # median
    low: float | None
    high: float | None

    @property
    def known(self) -> tuple[float, float, float] | None:
        """Median, lowest and highest value, if any."""
        return (
            None if self.value is None or self.low is None or self.high is None else (self.value, self.low, self.high)
        )


def criteria(report: Report) -> list[Criterion]:
    """Return the rows of all tables, in order."""
    ratios = fem_ratios(report)
    return [
        Criterion("Image", "Image", "E_D, fraction of the image's variance", _at("E_D_fraction"), -1, is_headline=True,
            blind="where the error is, and whether it matters there; noise within a cell counts like an edge"),
        Criterion("Image", "Image", "voxels outside the mesh", _at("n_missed_voxels"), -1, is_detail=True),
        *_label_criteria(report),
        *_shape_criteria(),
        *(row for nu in ratios for order in ORDER_WORDS for row in _fem_criteria(report, nu, order, nu == ratios[0])),
        Criterion("Cost", "Cost", "wall time, s", lambda run: run.seconds_total, -1, is_headline=True, is_timed=True,
            blind="the search for the number of nodes, and the loading of compiled code (both below)"),
        Criterion("Cost", "Cost", "peak memory, MB", lambda run: run.peak_bytes * MEBI_BYTES, -1, is_timed=True,
            blind="the fraction that the interpreter and its libraries take"),
        Criterion("Cost", "Cost", "nodes", _at("n_nodes"), 0),
        Criterion("Cost", "Cost", "tetrahedra", _at("n_cells"), 0),
    ]  # fmt: skip


def _at(*keys: str) -> Callable[[PipelineRun], float | None]:
    """Return a function for the value at this place of a run's measurement; None if a table lacks the row."""

    def value(run: PipelineRun) -> Any:
        item: Any = run.measurement
        for key in keys:
            if item is not None:
                item = item.get(key) if isinstance(item, dict) else getattr(item, key)
        return item

    return value


def _shape_criteria() -> list[Criterion]:
    def row(title: str, keys: tuple[str, ...], better: int, blind: str = "") -> Criterion:
        return Criterion("Shape", "Shape", title, _at("quality", *keys), better, is_detail=not blind, blind=blind)

    def bad_percent(run: PipelineRun) -> float:
        shape = run.measurement.quality
        return 100.0 * sum(shape.kinds.values()) / shape.n_cells

    errors = {"mean": "(i) mean", "harmonic_mean": "(ii) harmonic mean", "l2": "(iii) L2", "worst": "(iv) worst"}
    kinds = ("sliver", "cap", "needle", "wedge", "spade")
    return [
        row("mean rho", ("mean_rho",), 1, "the worst cells, on which a solver may fail (1/3: regular tetrahedron)"),
        row("p1 rho", ("p1_rho",), 1, "the worst 1 % of the cells"),
        row("smallest dihedral angle, °", ("min_dihedral",), 1, "how many cells come close (it is one angle)"),
        Criterion("Shape", "Shape", "bad cells (3 rho < 0.3), %", bad_percent, -1, is_headline=True,
            blind="how bad they are, and their kind; slivers harm a stiffness matrix more than needles (below)"),
        row("min rho", ("min_rho",), 1),
        *(row(f"error {title}", ("errors", name), -1) for name, title in errors.items()),
        row("dihedral angle p1, °", ("p1_dihedral",), 1),
        row("largest dihedral angle, °", ("max_dihedral",), -1),
        row("cells under 10°", ("n_under_10_degrees",), -1),
        *(row(f"{kind}s", ("kinds", kind), -1) for kind in kinds),
    ]  # fmt: skip


def _label_criteria(report: Report) -> list[Criterion]:
    judged = judged_labels(report)

    def over(
        of: Callable[[list[float]], float], value: Callable[[LabelRow], Any]
    ) -> Callable[[PipelineRun], float | None]:
        def of_run(run: PipelineRun) -> float | None:
            values = [value(row) for row in run.measurement.labels if row.label in judged]
            # A lost label has no surface; the mean over the others alone would be too good.
            return of(values) if values and None not in values else None

        return of_run

    def by_voxels(value: Callable[[LabelRow], Any]) -> Callable[[PipelineRun], float | None]:
        weighed = over(sum, lambda row: None if value(row) is None else judged[row.label] * value(row))
        total = sum(judged.values())
        return lambda run: None if (whole := weighed(run)) is None else whole / total

    def mean(values: list[float]) -> float:
        return sum(values) / len(values)

    def largest_error(values: list[float]) -> float:
        return max(map(abs, values))

    rows: list[tuple[str, Callable[[PipelineRun], float | None], int, str]] = [
        ("mean label Dice", over(mean, attrgetter("dice")), 1, "thin parts, which count only by volume"),
        ("smallest label Dice", over(min, attrgetter("dice")), 1, "all labels but one"),
        ("mean label surface distance, mm", over(mean, attrgetter("surface_mean_mm")), -1, "single spikes and holes"),
        ("label surface distance p95, mm", over(mean, attrgetter("surface_p95_mm")), -1, "the 5 % beyond it"),
        ("largest label volume error", over(largest_error, volume_error), -1, "where the volume is; lost and gained "
            "parts cancel each other"),
        ("labels lost (of any size)", _n_lost, -1, "labels that keep a single cell"),
        ("label area over smoothed voxels', weighted mean", by_voxels(attrgetter("area_ratio")), 0, ""),
        ("label edges folded over 60°, weighted mean", by_voxels(attrgetter("folded")), -1, ""),
        ("label edges in more than two facets", over(sum, attrgetter("nonmanifold_edges")), -1, ""),
        ("of these, where two labels meet", over(sum, attrgetter("nonmanifold_edges_two_labels")), -1, ""),
        ("labels with more or fewer components", over(sum, lambda row: row.mesh_components != row.components), -1, ""),
    ]  # fmt: skip
    part = f"Labels {which_labels(report)}"
    return [
        Criterion(
            "Image", part, title, value, better, is_detail=not blind, blind=blind,
            is_headline=title == "mean label Dice" and report.labels is not None,
        )
        for title, value, better, blind in rows
    ]  # fmt: skip


def judged_labels(report: Report) -> dict[int, int]:
    """Return the voxels of the judged labels: the large ones if any, without a given segmentation's background."""
    voxels = voxels_by_label(report)
    if _has_background(report):
        del voxels[0]
    return {label: n for label, n in voxels.items() if n > JUDGED_VOXELS} or voxels


def _has_background(report: Report) -> bool:
    return report.labels is not None and {0} < set(voxels_by_label(report))


def which_labels(report: Report) -> str:
    """Describe the judged labels."""
    is_large = any(n > JUDGED_VOXELS for n in judged_labels(report).values())
    size = f"above {JUDGED_VOXELS} voxels" if is_large else "of any size"
    return f"{size}, without background 0" if _has_background(report) else size


def voxels_by_label(report: Report) -> dict[int, int]:
    """Return the number of voxels of each label in the image."""
    return {row.label: row.voxels for each in report.pipelines for run in each.runs for row in run.measurement.labels}


def volume_error(row: LabelRow) -> float | None:
    """Return the volume error of a label in the mesh, as a fraction of its volume in the image."""
    return row.mesh_volume_mm3 / row.volume_mm3 - 1.0 if row.volume_mm3 else None


def _n_lost(run: PipelineRun) -> int | None:
    labels = run.measurement.labels
    return sum(row.is_lost for row in labels) if labels else None


def _fem_criteria(report: Report, nu: str, order: int, is_first: bool) -> list[Criterion]:
    """Return criteria for one Poisson's ratio and order of cells; the headline has the first ratio's displacement."""
    word, average = ORDER_WORDS[order], report.options.average
    part = f"Compression, ν = {nu}, {word} cells"
    blind = {
        "strain_energy": "errors that cancel each other (it is one number for the whole body)",
        "displacement": "strains, which may be wrong even if displacements are right",
        "interface_strain": "anything but the voxels next to interfaces of the labels or classes",
    }
    known = report.reference.by_nu.get(nu)
    own = {} if known is None else known.own_error._asdict()  # the reference's, without strain
    rows = [
        Criterion("Simulation", part, f"{title} error", fem_error(nu, average, name), -1, order,
            is_headline=is_first and name == "displacement", blind=blind[name],
            is_error=True, own_change=own.get(name))
        for title, name in COMPRESSION_ERRORS
    ]  # fmt: skip
    rows += [
        Criterion("Simulation", part, f"{title} error, moduli by {other}", fem_error(nu, other, name), -1, order,
            is_detail=True, is_error=True, own_change=own.get(name))
        for other in averages_of(report.options)
        if other != average
        for title, name in COMPRESSION_ERRORS
    ]  # fmt: skip
    more: list[tuple[str, Callable[[PipelineRun], float | None], int]] = [
        ("λ max", _at("fem", nu, "lambda_max"), 0),
        ("condition number", _at("fem", nu, "cond"), -1),
        ("CG iterations", _at("fem", nu, "cg_iterations"), -1),
    ]
    return rows + [Criterion("Simulation", part, *each, order, is_detail=True) for each in more]


def fem_error(nu: str, average: str, name: str) -> Callable[[PipelineRun], float | None]:
    """Return a function for an error of the compression, by its field's name."""
    return _at("fem", nu, "averages", average, "errors", name)


def fem_ratios(report: Report) -> list[str]:
    """Return the Poisson's ratios for which any pipeline has a result."""
    return sorted({nu for each in report.pipelines for run in each.runs for nu in run.measurement.fem}, key=float)


def of_order(report: Report, order: int) -> list[PipelineResult]:
    """Return the pipelines with their meshes for cells of this order."""
    return report.pipelines if order == 1 else report.quadratic


def entries_of(criterion: Criterion, report: Report) -> list[CriterionEntry]:
    """Return each pipeline's value for a criterion."""
    return [entry(criterion.value, pipeline) for pipeline in of_order(report, criterion.order)]


def entry(value_of: Callable[[PipelineRun], float | None], pipeline: PipelineResult) -> CriterionEntry:
    """Return median and range over a pipeline's runs; all None if no run has a value."""
    values = [value for run in pipeline.runs if (value := value_of(run)) is not None]
    return (
        CriterionEntry(float(np.median(values)), min(values), max(values))
        if values
        else CriterionEntry(None, None, None)
    )


def undecided(criterion: Criterion, report: Report, one: int, other: int) -> str:
    """Return why a difference between two pipelines is not due to their meshes; "" if it is."""
    a, b = (of_order(report, criterion.order)[place] for place in (one, other))
    if criterion.is_timed and len(a.runs) == len(b.runs) == 1:
        return "one run each"
    first, second = entry(criterion.value, a).value, entry(criterion.value, b).value
    if criterion.own_change is None or first is None or second is None:
        return ""
    is_below = abs(first - second) < criterion.own_change
    return f"less than the reference's own error, {short_text(criterion.own_change)}" if is_below else ""


def winners(better: int, values: Sequence[float | None]) -> list[int]:
    """Return the places of the best values, including ties as printed; none if fewer than two differ."""
    known = [(number, value) for number, value in enumerate(values) if value is not None]
    if better == 0 or len({number_text(value) for _, value in known}) < 2:
        return []
    best = max(known, key=lambda pair: better * pair[1])[1]
    return [number for number, value in known if number_text(value) == number_text(best)]


def number_text(value: float | None) -> str:
    """Format a number for the page: whole numbers in full, others to four digits; "–" for None."""
    if value is None:
        return "–"
    rounded, full = FULL_DIGITS
    if float(value).is_integer() and abs(value) < full:
        return str(int(value))
    return f"{value:.0f}" if rounded <= abs(value) < full else f"{value:.4g}"


def short_text(value: float | None) -> str:
    """Format a number to three digits, which repeated runs reproduce."""
    return "–" if value is None else number_text(float(f"{value:.3g}"))


def ratio_text(ratio: float) -> str:
    """Format a ratio to three digits, as "0.8×"."""
    return f"{short_text(ratio)}×"


def loss_text(value: float | None, best: float) -> str:
    """Describe the distance of a value from the best."""
    if value is None:
        return "no value"
    if best > 0.0 and value > 0.0:
        ratio = value / best
        far = abs(ratio - 1.0)
        return f"{ratio_text(ratio)} the best" if far > EQUAL_FRACTION else f"within {max(far, 1e-4):.1%} of the best"
    return f"{number_text(abs(value - best))} from the best"
