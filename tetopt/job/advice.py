"""Problems of a finished mesh, as one list, worst first: violated requirements, failed
measurements, and oddities.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.labels import BACKGROUND_LABEL
from tetopt.engine.loop import MeshingResult
from tetopt.engine.meshing import Mode
from tetopt.engine.sliding import MOST_MEETING
from tetopt.job.events import note, report_violation, warning
from tetopt.job.inputs import list_names
from tetopt.job.options import Method
from tetopt.measure.fidelity import LabelFidelity, MaskFidelity
from tetopt.measure.interfaces import LabelInterface
from tetopt.measure.judge import LABEL_VOXELS, Requirements, faulty_labels
from tetopt.model.label_names import count_of_labels, label_words
from tetopt.start.label_sizes import SizesByLabel
from tetopt.start.octree import is_for_walls
from tetopt.start.sizes import LONG_EDGE, EdgeRatios, Sizes

# Of the cells, over the voxels': other volumes are told beside the verdict.
NEAR_VOLUME, NEAR_MASK = (0.85, 1.15), (0.95, 1.05)
VOLUME_RATIO = 2.0  # of a label's cells to its voxels, or the other way round: more is reported
LABEL_DICE = 0.5  # of a label with its cells: below it the cells hardly represent the label
NODES_MISSED = 0.01  # of the requested number of nodes: a larger miss is reported
ENERGY_RISE = 1e-3  # relative: E is reported if it ended higher above its least value
LENGTH_ROUNDING = 1e-3  # relative: the tolerance of edges to their limits
TARGETS_MISSED = 0.1  # of the edges: a larger fraction far over their targets is reported
# between the surfaces of mesh and mask, 95th percentile: above it, details of the mask are lost
FAR_VOXELS = 1.5
# of the requested cells across: with fewer, at the label's median, they are reported
ACROSS_MET = 0.9
# of the cells: if more contain no voxel centre, there are too many for the image
EMPTY_CELLS = 0.02
POCKETS = "voxels without a label, enclosed or bright"  # label 0 where a background was removed
# Requirements whose sentences ask for smaller cells.
SMALLER_CELLS: Mapping[str, Literal["smaller"]] = dict.fromkeys(
    ("min_dihedral", "overlap", "mask", "components", "manifold", "labels", "error"), "smaller"
)
# times a voxel's shortest edge: if slices are this far apart, cells lie between them
THICK_SLICES = 2.0


class Problem(NamedTuple):
    """A violated requirement or failed measurement, which has a name, or an oddity of a valid
    mesh.
    """

    text: str
    remedy: str = ""
    name: str | None = None
    wants: Literal["smaller", "larger"] | None = None  # cells, if the remedy is followed
    is_failure: bool = False  # not of a requirement; its text says what failed

    @property
    def words(self) -> str:
        """The sentence, with its remedy."""
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


def order_problems(problems: Iterable[Problem]) -> list[Problem]:
    """Return problems with the worst first: the violated, then the others in their order.

    The first one that wants smaller or larger cells decides: those that want the opposite lose
    their remedy.
    """
    ranked = sorted(problems, key=lambda each: each.name is None)
    aim = next((each.wants for each in ranked if each.wants is not None), None)
    return [each if each.wants in (None, aim) else each._replace(remedy="") for each in ranked]


def sentences(problems: Iterable[Problem]) -> dict[str, str]:
    """Return, by name, a sentence on each problem that has one; joined if several have the same
    name.
    """
    named: dict[str, str] = {}
    for each in problems:
        if each.name is not None:
            named[each.name] = (
                f"{named[each.name]}; {each.words}" if each.name in named else each.words
            )
    return named


def tell(problems: Iterable[Problem]) -> None:
    """Report problems in this order."""
    for each in problems:
        if each.name is None:
            warning(each.words)
        else:
            report_violation(each.words, None if each.is_failure else each.name)


def failures(failed: Mapping[str, str], known: Iterable[Problem]) -> Iterator[Problem]:
    """Yield a problem for each failed measurement or picture, with its reason."""
    names = {each.name for each in known}
    for name, reason in failed.items():
        left = (
            "the mesh's file has no cell means"
            if name == "fields"
            else "all other numbers are written"
        )
        verb = "drawn" if name == "figures" else "measured"
        own = f"{name}_{verb}" if name in names else name  # a requirement may have the same name
        yield Problem(f"{name} could not be {verb}: {reason}; {left}", name=own, is_failure=True)


def unmet_requirements(
    requirements: Mapping[str, str], measured: dict[str, Any], word: str = "mask"
) -> Iterator[Problem]:
    """Yield violated `requirements` (`tetopt.measure.judge`), and lesser deviations from mask and
    labels. `word` is the name of the meshed region in messages.
    """
    for name, words in requirements.items():
        yield Problem(words, name=name, wants=SMALLER_CELLS.get(name))
    yield from _lost_labels(measured, word)
    yield from _of_mask(measured.get("mask"), word)
    if n_dropped := measured.get("dropped_components"):
        text = (
            f"dropped {n_dropped} small connected components of the mesh that are not "
            f"separate in the {word}"
        )
        yield Problem(f"{text}{_dropped_words(measured)}", "`keep_components` keeps them")


def _dropped_words(measured: dict[str, Any]) -> str:
    """Describe the volume of dropped components, in voxels, by label if there are labels."""
    mask, volumes = measured.get("mask"), measured.get("dropped_volumes")
    if mask is None or not volumes:
        return ""
    voxels = {int(label): volume * mask.voxels / mask.volume for label, volume in volumes.items()}
    names = measured.get("label_names", {})
    rows = [f"label {label_words(label, names)} {size:.3g}" for label, size in voxels.items()]
    of_labels = f" ({list_names(rows)})" if measured.get("labels") else ""
    return f", as large as {sum(voxels.values()):.3g} voxels{of_labels}"


def _lost_labels(measured: dict[str, Any], word: str) -> Iterator[Problem]:
    """Yield small labels without a cell, and labels of poor volume or overlap, beyond those that
    violate the requirement.
    """
    labels = measured.get("labels", [])
    required = required_of(word, measured.get("label_names", {}))
    words = {row.label: required.label_words(row.label) for row in labels}
    ratios = {row: row.volume_ratio for row in labels}

    def smaller(rows: Iterable[LabelFidelity], remedy: str) -> dict[str, Any]:
        is_helped = any(row.label not in required.unhelped for row in rows)
        return {"remedy": remedy, "wants": "smaller"} if is_helped else {}

    faulty = set(faulty_labels(labels))
    others = [row for row in labels if row.label not in faulty]
    if small := [words[row.label] for row in others if row.is_lost]:
        yield Problem(
            f"no cell has label {', '.join(small)}, of fewer than {LABEL_VOXELS} voxels in the mesh"
        )
    there = [row for row in others if row.covered_voxels and row.mesh_volume > 0.0]
    far = [row for row in there if max(ratios[row], 1.0 / ratios[row]) > VOLUME_RATIO]
    if far := sorted(far, key=lambda row: -max(ratios[row], 1.0 / ratios[row])):
        worst = ", ".join(f"{words[row.label]} ({ratios[row]:.3g})" for row in far)
        count = "1 label" if len(far) == 1 else f"{len(far)} labels"
        text = (
            f"{count} with more than {VOLUME_RATIO:g} times the volume of the voxels, or "
            "less than half"
        )
        yield Problem(f"{text} (ratio in brackets): {worst}", **smaller(far, "allow more nodes"))
    poor = [row for row in others if row.voxels >= LABEL_VOXELS and row.dice < LABEL_DICE]
    if poor:
        names = list_names([words[row.label] for row in poor], 5)
        remedy = "allow more nodes, or check that these are labels, not intensities"
        yield Problem(f"Dice below {LABEL_DICE} for label {names}", **smaller(poor, remedy))


def required_of(word: str, names: Mapping[int, str]) -> Requirements:
    """Return the words for a verdict: of the meshed region, and of labels by their names.

    More nodes are no remedy for label 0 within a foreground: it has the voxels that are no
    background.
    """
    pockets = {BACKGROUND_LABEL: POCKETS} if word == "foreground" else {}
    known = {**names, **pockets}
    return Requirements(
        region=word,
        label_words=lambda label: label_words(label, known),
        unhelped=frozenset(pockets),
    )


def beyond_requirements(measured: Mapping[str, Any], word: str = "mask") -> dict[str, str]:
    """Describe what requirements allow of the mask, with its name `word`, and of labels, by what it
    means; empty if there is none.

    Labels are counted, and the worst named, among all labels; of label 0, only the volume counts.
    """
    beyond, of_labels = dict[str, str](), dict[str, list[tuple[float, str]]]()
    if (mask := measured.get("mask")) is not None:
        of_mask = [
            f"{what} ({words})"
            for what, _, words in _faults(mask, mask.mesh_volume / mask.volume, NEAR_MASK)
        ]
        beyond = {f"not all of the {word} fits": f"{word}: {'; '.join(of_mask)}"} if of_mask else {}
    rows, names = measured.get("labels", []), measured.get("label_names", {})
    surfaces = {each.label: each for each in measured.get("interfaces", [])}
    for row in rows:
        ratio = row.volume_ratio if row.covered_voxels else 1.0
        faults = _faults(
            row, ratio, NEAR_VOLUME, surfaces.get(row.label), row.covered_voxels == row.voxels
        )
        for what, rank, words in faults:
            if row.label != BACKGROUND_LABEL or "volume" in what:
                of_labels.setdefault(what, []).append(
                    (rank, f"{label_words(row.label, names)} ({words})")
                )
    n_all = count_of_labels([row.label for row in rows])
    texts = [
        f"{len(some)} {what}: {list_names([each for _, each in sorted(some)], 5)}"
        for what, some in of_labels.items()
    ]
    return beyond | (
        {"not all labels fit": f"labels: of {n_all}, {'; '.join(texts)}"} if texts else {}
    )


def _faults(
    row: LabelFidelity | MaskFidelity,
    ratio: float,
    near: tuple[float, float],
    surface: LabelInterface | None = None,
    is_whole: bool = True,
) -> Iterator[tuple[str, float, str]]:
    """Yield kinds of faults of a label or mask, each with a rank, the least for the worst, and
    numbers.

    `ratio` is that of its cells' volume to its voxels', usually within `near`; `is_whole` if all
    voxels count.
    """
    n_lost, n_pieces = len(row.lost_components), row.mesh_components
    voxels, n_kept = sum(each.voxels for each in row.lost_components), row.components - n_lost
    if not near[0] <= ratio <= near[1]:
        what = "with less than {:g} or more than {:g} times the volume of voxels".format(*near)
        yield what, min(ratio, 1.0 / max(ratio, near[0])), f"{ratio:.3g}"
    if n_lost:
        yield (
            "with components without a cell",
            -voxels,
            f"{n_lost} of {row.components}, voxels: {voxels}",
        )
    if n_pieces > max(n_kept, 1):
        yield "with more pieces of cells than of voxels", -n_pieces, f"{n_pieces}"
    if is_whole and 0 < n_pieces < n_kept:
        yield (
            "with fewer pieces of cells than of voxels",
            n_pieces - n_kept,
            f"{n_pieces} of {n_kept}",
        )
    if surface is not None and is_whole and n_pieces and surface.mesh_cavities < surface.cavities:
        n_left, n_all = surface.mesh_cavities, surface.cavities
        yield "with fewer cavities in cells than in voxels", n_left - n_all, f"{n_left} of {n_all}"


def _of_mask(mask: MaskFidelity | None, word: str) -> Iterator[Problem]:
    if mask is None:
        return
    remedy = "allow more nodes"
    # more components of the mesh than of the mask violate a requirement
    if mask.components > mask.mesh_components:
        text = (
            f"the {word} has {mask.components} connected components, the mesh "
            f"{mask.mesh_components}: elements are"
        )
        yield Problem(f"{text} too large for the {word}'s detail", remedy, wants="smaller")
    if (far := max(mask.distance_p95, mask.reverse_p95)) > FAR_VOXELS:
        text = (
            f"the mesh's boundary and the {word}'s surface are {far:.1f} voxels apart at the "
            "95th percentile, "
            f"{max(mask.distance_mean, mask.reverse_mean):.1f} on average: elements are too "
            "large for the details"
        )
        yield Problem(text, remedy, wants="smaller")


def of_result(
    result: MeshingResult,
    method: Method,
    mode: Mode,
    n_nodes: int,
    nodes: int | None,
    measured: dict[str, Any],
    k_D: float | None = None,
    has_sizes: bool = False,
) -> Iterator[Problem]:
    """Yield oddities of results that are valid but probably not intended.

    The mesh has `n_nodes`, where a graded mesh should have `nodes`; `measured` holds the counts.
    """
    if nodes is not None and abs(n_nodes - nodes) > NODES_MISSED * nodes:
        n_initial = len(result.initial.points)
        for_walls = (
            mode == "graded"
            and "mask" in measured
            and n_nodes > nodes
            and is_for_walls(n_initial, nodes)
        )
        text = f"{n_nodes} nodes instead of {nodes}"
        text += (
            f" (the initial mesh has {n_initial}, to keep thin walls of the mask)"
            if for_walls
            else ""
        )
        if (needed := measured.get("nodes_of_sizes")) and needed > nodes:
            remedy = "set `nodes` to that, or use larger sizes"
            yield Problem(f"{text}: the target sizes need about {needed}", remedy, wants="smaller")
        elif n_nodes < nodes and has_most_empty(result, measured.get("cells_without_voxel", 0)):
            yield Problem(f"{text}: most cells contain no voxel centre", wants="larger")
        elif result.history[-1].iteration == 0:
            yield Problem(f"{text}, as no iteration was made", "allow some `iterations`")
        else:
            wants: Literal["smaller", "larger"] = "smaller" if n_nodes < nodes else "larger"
            remedies = ["more iterations"] * (result.ended == "iterations") + [
                "a `k_D` above 0"
            ] * (k_D == 0.0)
            remedy = " or ".join([*remedies, *[f"{wants} sizes"] * has_sizes])
            yield Problem(
                text, f"use {remedy}" if remedy else "", wants=wants if has_sizes else None
            )
    lowest, first, last = (
        min(row.E for row in result.history),
        result.history[0],
        result.history[-1],
    )
    if last.E > lowest * (1.0 + ENERGY_RISE) and method == "paper":
        text = (
            f"E ended at {last.E:.4f}, above its minimum {lowest:.4f}: a tessellation in the "
            "first n_t iterations"
        )
        yield Problem(f"{text} raised it", "`retessellate` accept keeps only those that lower it")
    if mode == "start" and last.E_D > first.E_D * (1.0 + ENERGY_RISE):
        rise = (
            f"to {last.E_D / first.E_D:.3f} times its initial value"
            if first.E_D > 0.0
            else "from 0"
        )
        what = "E_D, with voxels on the wrong side of the mask," if "mask" in measured else "E_D"
        yield Problem(
            f"{what} rose {rise}, as shapes were improved at its expense", "increase `k_D`"
        )
    if crowded := measured.get("nodes_of_many_labels"):
        text = (
            f"more than {MOST_MEETING} labels meet at {crowded} nodes; only the first "
            f"{MOST_MEETING} determine"
        )
        yield Problem(f"{text} where these nodes lie")


def has_most_empty(result: MeshingResult, n_empty: int) -> bool:
    """Return whether `n_empty` cells, which contain no voxel centre, are more than half of all."""
    return 2 * n_empty > len(result.mesh.cells)


def of_empty(
    result: MeshingResult,
    is_free: bool,
    n_empty: int,
    spacing: NDArray[np.float64],
    is_masked: bool = False,
) -> Iterator[Problem]:
    """Yield a problem if many cells contain no voxel centre; `spacing` (n,) are the edges of the
    voxels, mm.

    `is_free` is True if the number of nodes can be chosen; `is_masked` if a mask determines the
    domain, so that the image may be of no importance, and fewer nodes are no remedy.
    """
    n_cells = len(result.mesh.cells)
    if n_empty <= EMPTY_CELLS * n_cells:
        return
    text = (
        f"{n_empty} of {n_cells} cells contain no voxel centre: these contribute nothing to E_D "
        "and take the nearest "
        "voxel's value"
    ) + ", which is harmless unless moduli come from the image" * is_masked
    if spacing.max() >= THICK_SLICES * spacing.min():
        yield Problem(
            f"{text}; slices are {spacing.max():.3g} mm apart, so some cells lie between them"
        )
    elif is_free and not is_masked:
        yield Problem(text, "reduce `nodes`", wants="larger")
    else:
        yield Problem(text)


def tell_label_sizes(sizes: SizesByLabel) -> None:
    """Report the nodes that sizes by label take; what the mesh has is measured afterwards
    (`of_layers`).

    With more nodes, cells elsewhere are smaller, which takes more still, unless they have a size of
    their own.
    """
    is_least = sizes.scale > 1.0 and sizes.sizes.edge_size is None
    which, enough = (
        ("at least", " (leave out `nodes` to have enough)") if is_least else ("about", "")
    )
    larger = (
        ""
        if sizes.scale == 1.0
        else f"; with fewer nodes, edges are {sizes.scale:.2f} times as long"
    )
    note(f"sizes by label require {which} {sizes.nodes} nodes{enough}{larger}")


def of_layers(
    labels: Iterable[LabelFidelity], cells_across: float, names: Mapping[int, str]
) -> Iterator[Problem]:
    """Yield labels with fewer cells across than requested, in the mesh as measured, the worst
    first.
    """
    thin = [
        row
        for row in labels
        if row.label != BACKGROUND_LABEL and row.cells_across < ACROSS_MET * cells_across
    ]
    if thin:
        rows = [
            f"{label_words(row.label, names)} {row.cells_across:.2g} (edges {row.edge:.2g} mm)"
            for row in sorted(thin, key=lambda row: row.cells_across)
        ]
        text = f"fewer than {cells_across:g} cells across: {list_names(rows, 5)}"
        yield Problem(text, "allow more nodes", wants="smaller")


def of_sizes(
    sizes: Sizes, shortest: float, longest: float, edges: EdgeRatios | None
) -> Iterator[Problem]:
    """Yield size limits and targets that the edges, from shortest to longest, mm, do not meet."""
    if sizes.longest is not None and longest > sizes.longest * (1.0 + LENGTH_ROUNDING):
        text = (
            f"the longest edge is {longest:.4g} mm, {longest / sizes.longest - 1.0:.0%} over "
            "`edge_max` "
            f"{sizes.longest:g}: splits and collapses respect it, but nodes move apart"
        )
        yield Problem(text, "lower it")
    if shortest < sizes.smallest * (1.0 - LENGTH_ROUNDING):
        text = (
            f"the shortest edge is {shortest:.4g} mm, {1.0 - shortest / sizes.smallest:.0%} "
            "under `size_min` "
            f"{sizes.smallest:g}: splits respect it, but nodes move together"
        )
        yield Problem(text, "raise it")
    if edges is not None and edges.above > TARGETS_MISSED:
        text = (
            f"{edges.above:.0%} of the edges are longer than {LONG_EDGE:.2f} times their "
            "target size"
        )
        yield Problem(text, "allow more nodes, or use larger sizes", wants="smaller")
