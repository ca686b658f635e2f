"""Problems of a finished mesh, as one list, worst first: violated requirements, failed
measurements, and oddities.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

from tetopt.contents.labels import BACKGROUND_LABEL, COMPONENT_VOXELS
from tetopt.engine.aim import Mode
from tetopt.engine.loop import MeshingResult
from tetopt.engine.sliding import MOST_MEETING
from tetopt.io.text import count_text, list_names
from tetopt.job.events import note, report_violation, warning
from tetopt.job.options import Method
from tetopt.measure.fidelity import (
    LEAST_CELLS,
    LabelFidelity,
    LabelInterface,
    LabelPieces,
    MaskFidelity,
)
from tetopt.measure.judge import (
    FOREGROUND,
    LABEL_VOXELS,
    MORE_NODES,
    Requirements,
    faulty_labels,
    is_pocket,
    is_shown,
)
from tetopt.model.averages import EMPTY_FRACTION
from tetopt.model.label_names import count_of_labels, label_words
from tetopt.start.label_sizes import SizesByLabel
from tetopt.start.octree import is_for_walls
from tetopt.start.sizes import LONG_EDGE, EdgeRatios, Sizes
from tetopt.system.arrays import Floats, Json

# Of the cells, over the voxels': other volumes are told beside the verdict.
NEAR_VOLUME, NEAR_MASK = (0.85, 1.15), (0.95, 1.05)
POCKETS = "voxels without a label, enclosed or bright"  # label 0 where a background was removed
FOREGROUND_REMEDY = (
    "if it holds more than the body, as a table, use a higher `background` or a `mask`; otherwise "
    f"{MORE_NODES}"
)
Wanted = Literal["smaller", "larger"]
# Requirements whose sentences ask for smaller cells.
SMALLER_CELLS: Mapping[str, Wanted] = dict.fromkeys(
    ("min_dihedral", "overlap", "mask", "components", "euler", "manifold", "labels", "error"),
    "smaller",
)
THICK_SLICES = 2.0  # times a voxel's shortest edge: so far apart, cells lie between slices


# Thresholds of oddities, chosen; beyond 1.5 voxels, details of a mask are lost.
TIMES_VOLUME = 2.0  # of a label's cells over its voxels', or the other way round, the larger
LEAST_DICE = 0.5  # of a large label
LACKING_ACROSS = 0.1  # fraction of the requested cells across a label
FAR_VOXELS = 1.5  # between the surfaces of mesh and mask, 95th percentile
MISSED_NODES = 0.01  # fraction of the requested number of nodes
ENERGY_RISE = 1e-3  # of E above its least value, of E_D above its first, relative
EDGE_MISS = 1e-3  # of the longest or shortest edge beyond its limit, relative
LONG_FRACTION = 0.1  # of the edges, far over their targets


class Problem(NamedTuple):
    """A violated requirement or failed measurement, which has a name, or an oddity of a valid
    mesh.
    """

    text: str
    remedy: str = ""
    name: str | None = None
    wants: Wanted | None = None  # cells, if the remedy is followed
    is_failure: bool = False  # not of a requirement; its text says what failed

    @property
    def words(self) -> str:
        """The sentence, with its remedy."""
        return f"{self.text}; {self.remedy}" if self.remedy else self.text


def find_odd_labels(
    rows: Iterable[LabelFidelity],
    value: Callable[[LabelFidelity], float],
    limit: float,
    words: Callable[[LabelFidelity], str],
    text: str,
    remedy: str = "",
    most: int = sys.maxsize,
    unhelped: frozenset[int] = frozenset(),
) -> Iterator[Problem]:
    """Yield a problem if a value of labels is above its limit: `text` with their number as `{0}`
    and `most` of them as `{1}`, the worst first.

    It has no remedy if all of them are `unhelped`; any remedy takes smaller cells.
    """
    odd = sorted((row for row in rows if value(row) > limit), key=value, reverse=True)
    if odd:
        named = text.format(
            count_text(len(odd), "label"), list_names([words(row) for row in odd], most)
        )
        is_helped = bool(remedy) and any(row.label not in unhelped for row in odd)
        yield Problem(named, remedy, wants="smaller") if is_helped else Problem(named)


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
    requirements: Mapping[str, str], measured: Json, required: Requirements
) -> Iterator[Problem]:
    """Yield violated `requirements` (`tetopt.measure.judge`), and lesser deviations from mask and
    labels; `required` has the words for them.
    """
    for name, words in requirements.items():
        yield Problem(words, name=name, wants=SMALLER_CELLS.get(name))
    yield from _of_labels(measured, required)
    yield from _of_mask(measured.get("mask"), required)
    if n_dropped := measured.get("dropped_components"):
        yield Problem(
            f"dropped {n_dropped} small connected components of the mesh that are not separate in "
            f"the {required.region}{_dropped_words(measured)}",
            "`keep_components` keeps them",
        )


def _dropped_words(measured: Json) -> str:
    """Describe the volume of dropped components, in voxels, by label if there are labels."""
    mask, volumes = measured.get("mask"), measured.get("dropped_volumes")
    if mask is None or not volumes:
        return ""
    voxels = {int(label): volume * mask.voxels / mask.volume for label, volume in volumes.items()}
    names = measured.get("label_names", {})
    rows = [f"label {label_words(label, names)} {size:.3g}" for label, size in voxels.items()]
    of_labels = f" ({list_names(rows)})" if measured.get("labels") else ""
    return f", as large as {sum(voxels.values()):.3g} voxels{of_labels}"


def _of_labels(measured: Json, required: Requirements) -> Iterator[Problem]:
    """Yield small labels without a cell, and labels of poor volume or overlap, beyond those that
    violate the requirement.
    """
    labels = measured.get("labels", [])
    faulty = set(faulty_labels(labels, required))
    judged = [row for row in labels if row.label not in faulty and not is_pocket(row, required)]
    others = [row for row in judged if not row.extent.is_beyond]
    for row in labels:
        if is_pocket(row, required) and row.overlap.dice < LEAST_DICE:
            count = count_text(row.pieces.components, "piece")
            yield Problem(
                f"Dice {row.overlap.dice:.2f} for label {required.label_words(row.label)}, "
                f"{row.extent.voxels} voxels in {count}",
                "leave them out: `keep_labels` names the tissues, `background` auto keeps fewer",
            )
    there = [row for row in others if row.extent.covered_voxels and row.extent.mesh_volume > 0.0]
    large = [row for row in others if row.extent.voxels >= LABEL_VOXELS]
    # more nodes do not help crumbs of voxels
    unhelped = frozenset(
        row.label for row in labels if row.extent.voxels < COMPONENT_VOXELS * row.pieces.components
    )

    def words(row: LabelFidelity) -> str:
        return required.label_words(row.label)

    yield from find_odd_labels(
        (row for row in judged if row.label != BACKGROUND_LABEL),
        lambda row: row.extent.is_beyond,
        0,
        words,
        "the mesh covers a part of the labels' image: of {}, less than half lies in it: {}",
        most=5,
    )
    yield from find_odd_labels(
        others,
        lambda row: row.extent.is_lost,
        0,
        words,
        f"no cell has label {{1}}, of fewer than {LABEL_VOXELS} voxels in the mesh, or in pieces "
        f"smaller than {LEAST_CELLS:g} cells",
    )
    yield from find_odd_labels(
        there,
        lambda row: max(row.extent.ratio, 1.0 / row.extent.ratio),
        TIMES_VOLUME,
        lambda row: f"{words(row)} ({row.extent.ratio:.3g})",
        f"{{}} with more than {TIMES_VOLUME:g} times the volume of the voxels, or less than half "
        "(ratio in brackets): {}",
        MORE_NODES,
        unhelped=unhelped,
    )
    yield from find_odd_labels(
        large,
        lambda row: 1.0 - row.overlap.dice,
        1.0 - LEAST_DICE,
        words,
        f"Dice below {LEAST_DICE:g} for label {{1}}",
        f"{MORE_NODES}, or check that these are labels, not intensities",
        5,
    )


def required_of(word: str, names: Mapping[int, str], remedy: str = "") -> Requirements:
    """Return the words for a verdict: of the meshed region, and of labels by their names."""
    usual = FOREGROUND_REMEDY if word == FOREGROUND else MORE_NODES
    pockets = {BACKGROUND_LABEL: POCKETS} if word == FOREGROUND else {}
    known = {**names, **pockets}
    return Requirements(
        region=word, label_words=lambda label: label_words(label, known), remedy=remedy or usual
    )


def beyond_requirements(measured: Mapping[str, Any], word: str = "mask") -> dict[str, str]:
    """Describe what requirements allow of the mask, with its name `word`, and of labels, by what it
    means; empty if there is none.

    Labels are counted, and the worst named, among all labels; of label 0, only the volume counts.
    """
    beyond, of_labels = dict[str, str](), dict[str, list[tuple[float, str, str]]]()
    if (mask := measured.get("mask")) is not None:
        of_mask = [
            f"{what} ({words})"
            for what, _, words in _faults(mask, mask.mesh_volume / mask.volume, NEAR_MASK)
        ]
        beyond = {f"not all of the {word} fits": f"{word}: {'; '.join(of_mask)}"} if of_mask else {}
    rows, names = measured.get("labels", []), measured.get("label_names", {})
    for row in rows:
        extent = row.extent
        ratio = 1.0 if extent.is_beyond else extent.ratio
        is_whole = extent.covered_voxels == extent.voxels
        faults = _faults(row.pieces, ratio, NEAR_VOLUME, row.surface, is_whole)
        for what, rank, words in faults:
            if row.label != BACKGROUND_LABEL or "volume" in what:
                name = label_words(row.label, names)
                of_labels.setdefault(what, []).append((rank, f"{name} ({words})", name))
    n_all = count_of_labels([row.label for row in rows])
    texts = [
        f"{len(some)} {what}: {list_names([each for _, each, _ in sorted(some)], 5)}"
        for what, some in of_labels.items()
    ]
    names_of = dict.fromkeys(name for some in of_labels.values() for _, _, name in sorted(some))
    what = f"not all labels fit: {list_names(list(names_of), 5)}"
    return beyond | ({what: f"labels: of {n_all}, {'; '.join(texts)}"} if texts else {})


def _faults(
    row: LabelPieces | MaskFidelity,
    ratio: float,
    near: tuple[float, float],
    surface: LabelInterface | None = None,
    is_whole: bool = True,
) -> Iterator[tuple[str, float, str]]:
    """Yield kinds of faults of a label or mask, with the use for which they matter, each with a
    rank, the least for the worst, and numbers.

    `ratio` is that of its cells' volume to its voxels', usually within `near`; `is_whole` if all
    voxels count.
    """
    n_all, n_pieces = row.components, row.mesh_components
    lost, n_kept = list(filter(is_shown, row.lost_components)), n_all - len(row.lost_components)
    if isinstance(row, LabelPieces) and row.large_components is not None:
        n_kept = row.large_components - len(lost)
    if not near[0] <= ratio <= near[1]:
        what = "with less than {:g} or more than {:g} times the volume of voxels".format(*near)
        what = f"{what} (matters for stiffness and mass)"
        yield what, min(ratio, 1.0 / max(ratio, near[0])), f"{ratio:.3g}"
    if lost:
        voxels = sum(each.voxels for each in lost)
        what = "with components without a cell (matters if these carry load)"
        yield what, -voxels, f"{len(lost)} of {n_all}, voxels: {voxels}"
    if n_pieces > max(n_all, 1) or (is_whole and 0 < n_pieces < n_kept):
        which, rank = ("more", -n_pieces) if n_pieces > n_all else ("fewer", n_pieces - n_kept)
        what = f"with {which} pieces of cells than of voxels (matters for what is connected)"
        n_due = n_all if which == "more" else n_kept  # lost and small ones are not due
        yield what, rank, f"{n_pieces} for {n_due}{f' of {n_all}' * (n_due < n_all)}"
    if surface is not None and is_whole and n_pieces and surface.mesh_cavities < surface.cavities:
        n_left, n_all = surface.mesh_cavities, surface.cavities
        what = "with fewer cavities in cells than in voxels (matters for fluid in them)"
        yield what, n_left - n_all, f"{n_left} of {n_all}"


def _of_mask(mask: MaskFidelity | None, required: Requirements) -> Iterator[Problem]:
    if mask is None:
        return
    word = required.region
    if mask.components > mask.mesh_components:  # fewer violate a requirement
        yield Problem(
            f"the {word} has {mask.components} connected components, the mesh "
            f"{mask.mesh_components}: elements are too large for the {word}'s detail",
            required.remedy,
            wants="smaller",
        )
    p95, mean = (
        max(mask.distance_p95, mask.reverse_p95),
        max(mask.distance_mean, mask.reverse_mean),
    )
    if p95 > FAR_VOXELS:
        yield Problem(
            f"the mesh's boundary and the {word}'s surface are {p95:.1f} voxels apart at the 95th "
            f"percentile, {mean:.1f} on average: elements are too large for the details",
            required.remedy,
            wants="smaller",
        )


def of_result(
    result: MeshingResult,
    method: Method,
    mode: Mode,
    n_nodes: int,
    nodes: int | None,
    measured: Json,
    k_D: float | None = None,
    has_sizes: bool = False,
) -> Iterator[Problem]:
    """Yield oddities of results that are valid but probably not intended.

    The mesh has `n_nodes`, where a graded mesh should have `nodes`; `measured` holds the counts.
    """
    if nodes is not None:
        yield from _of_nodes(result, mode, n_nodes, nodes, measured, k_D, has_sizes)
    least = min(row.E for row in result.history)
    first, last = result.history[0], result.history[-1]
    if method == "paper" and last.E > (1.0 + ENERGY_RISE) * least:
        yield Problem(
            f"E ended at {last.E:.4f}, above its minimum {least:.4f}: a tessellation in the first "
            "n_t iterations raised it",
            "`retessellate` accept keeps only those that lower it",
        )
    if mode == "start" and last.E_D > (1.0 + ENERGY_RISE) * first.E_D:
        times = f"to {last.E_D / first.E_D:.3f} times its initial value" if first.E_D else "from 0"
        what = "E_D, with voxels on the wrong side of the mask," if "mask" in measured else "E_D"
        yield Problem(
            f"{what} rose {times}, as shapes were improved at its expense", "increase `k_D`"
        )
    if n_crowded := measured.get("nodes_of_many_labels"):
        yield Problem(
            f"more than {MOST_MEETING} labels meet at {n_crowded} nodes; only the first "
            f"{MOST_MEETING} determine where these nodes lie"
        )


def _of_nodes(
    result: MeshingResult,
    mode: Mode,
    n_nodes: int,
    nodes: int,
    measured: Json,
    k_D: float | None,
    has_sizes: bool,
) -> Iterator[Problem]:
    """Yield the miss of a requested number of nodes, with its reason."""
    if abs(n_nodes - nodes) <= MISSED_NODES * nodes:
        return
    n_initial, needed = len(result.initial.points), measured.get("nodes_of_sizes") or 0
    text, remedy = f"{n_nodes} nodes instead of {nodes}", ""
    if (
        mode == "graded"
        and "mask" in measured
        and n_nodes > nodes
        and is_for_walls(n_initial, nodes)
    ):
        text += f" (the initial mesh has {n_initial}, to keep thin walls of the mask)"
    wants: Wanted | None = None
    if needed > nodes:
        text += f": the target sizes need about {needed}"
        remedy, wants = "set `nodes` to that, or use larger sizes", "smaller"
    elif n_nodes < nodes and has_most_empty(result, measured.get("cells_without_voxel", 0)):
        text, wants = f"{text}: most cells contain no voxel centre", "larger"
    elif result.history[-1].iteration == 0:
        text += ", as no iteration was made"
        remedy = "allow some `iterations`"
    else:
        size: Wanted = "smaller" if n_nodes < nodes else "larger"
        remedies = ["more iterations"] * (result.ended == "iterations")
        remedies += ["a `k_D` above 0"] * (k_D == 0.0) + [f"{size} sizes"] * has_sizes
        remedy = f"use {' or '.join(remedies)}" if remedies else ""
        wants = size if has_sizes else None
    yield Problem(text, remedy, wants=wants)


def has_most_empty(result: MeshingResult, n_empty: int) -> bool:
    """Return whether `n_empty` cells, which contain no voxel centre, are more than half of all."""
    return 2 * n_empty > len(result.mesh.cells)


def of_empty(
    result: MeshingResult,
    is_free: bool,
    n_empty: int,
    spacing: Floats,
    is_masked: bool = False,
    has_moduli: bool = False,
) -> Iterator[Problem]:
    """Yield a problem if many cells contain no voxel centre; `spacing` (n,) are the edges of the
    voxels, mm.

    `is_free` is True if the number of nodes can be chosen; `is_masked` if a mask determines the
    domain, so that the image may be of no importance, and fewer nodes are no remedy; `has_moduli`
    if moduli come from the image's voxels.
    """
    n_cells = len(result.mesh.cells)
    if n_empty <= EMPTY_FRACTION * n_cells:
        return
    more = ", which is harmless unless moduli come from the image" if is_masked else ""
    more = ", also for their moduli" if has_moduli else more
    is_thick = spacing.max() >= THICK_SLICES * spacing.min()
    if is_thick:
        more += f"; slices are {spacing.max():.3g} mm apart, so some cells lie between them"
    words = (
        f"{n_empty} of {n_cells} cells contain no voxel centre: these contribute nothing to E_D "
        f"and take the nearest voxel's value{more}"
    )
    is_helped = is_free and not is_masked and not is_thick
    remedies = ["reduce `nodes`"] * is_helped
    remedies += ["take the image linear between voxels (`average` linear)"] * has_moduli
    yield Problem(words, " or ".join(remedies), wants="larger" if is_helped else None)


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
    tissues = [row for row in labels if row.label != BACKGROUND_LABEL]
    yield from find_odd_labels(
        tissues,
        lambda row: 1.0 - row.thickness.cells_across / cells_across,
        LACKING_ACROSS,
        lambda row: (
            f"{label_words(row.label, names)} {row.thickness.cells_across:.2g} (edges "
            f"{row.thickness.edge:.2g} mm)"
        ),
        f"fewer than {cells_across:g} cells across: {{1}}",
        MORE_NODES,
        5,
    )


def of_sizes(
    sizes: Sizes, shortest: float, longest: float, edges: EdgeRatios | None
) -> Iterator[Problem]:
    """Yield size limits and targets that the edges, from shortest to longest, mm, do not meet."""
    if (most := sizes.longest) is not None and longest > (1.0 + EDGE_MISS) * most:
        yield Problem(
            f"the longest edge is {longest:.4g} mm, {longest / most - 1.0:.0%} over `edge_max` "
            f"{most:g}: splits and collapses respect it, but nodes move apart",
            "lower it",
        )
    if (least := sizes.smallest) and shortest < (1.0 - EDGE_MISS) * least:
        yield Problem(
            f"the shortest edge is {shortest:.4g} mm, {1.0 - shortest / least:.0%} under "
            f"`size_min` {least:g}: splits respect it, but nodes move together"
        )
    if edges is not None and edges.above > LONG_FRACTION:
        yield Problem(
            f"{edges.above:.0%} of the edges are longer than {LONG_EDGE:.2f} times their target "
            "size",
            f"{MORE_NODES}, or use larger sizes",
            wants="smaller",
        )
