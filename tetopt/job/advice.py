"""Events on the mesh of a run: violated requirements, and oddities."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tetopt.engine.loop import MeshingResult
from tetopt.engine.meshing import Mode
from tetopt.engine.requirements import LABEL_VOXELS
from tetopt.engine.surface import MOST_MEETING
from tetopt.io.label_tables import LabelTable
from tetopt.job.events import note, violated, warning
from tetopt.job.inputs import listed
from tetopt.job.options import Method
from tetopt.measure.fidelity import MaskFidelity
from tetopt.model.labels import label_words
from tetopt.start.label_sizes import SizesByLabel
from tetopt.start.sizes import LONG_EDGE, EdgeRatios, Sizes

LABEL_DICE = 0.5  # of a label with its cells: below it the cells hardly represent the label
NODES_MISSED = 0.01  # of the requested number of nodes: a larger miss is reported
ENERGY_RISE = 1e-3  # relative: E is reported if it ended higher above its least value
LENGTH_ROUNDING = 1e-3  # relative: the tolerance of edges to their limits
TARGETS_MISSED = 0.1  # of the edges: a larger fraction far over their targets is reported
FAR_VOXELS = 1.5  # between the surfaces of mesh and mask, 95th percentile: above it, details of the mask are lost
EULER_FRACTION = 0.5  # of the mask's Euler number: the mesh's may differ by this much
EULER_USUAL = 8  # smaller Euler numbers are treated as this one, since single holes depend on the cell size
TOLD_BELOW_FRACTION = 0.02  # of a label's volume: a smaller part with too few cells across is not reported
EMPTY_CELLS = 0.02  # of the cells: if more contain no voxel, there are too many for the image
THICK_SLICES = 2.0  # times a voxel's shortest edge: if slices are this far apart, cells lie between them


def tell_violated(result: MeshingResult, measured: dict[str, Any], word: str = "mask") -> dict[str, str]:
    """Report and return, by name, the violated requirements (`tetopt.engine.requirements`), including large labels
    without cells.

    Lesser deviations are warnings. `word` is the name of the meshed region in messages.
    """
    lost = dict(_lost(measured))
    of_result = {name: words for name, words in result.violated.items() if name not in lost}
    problems = {name: words.replace("the mask", f"the {word}") for name, words in (of_result | lost).items()}
    for name, words in problems.items():
        violated(words, name)
    _warn_of_mask(measured.get("mask"), word)
    if n_dropped := measured.get("dropped_components"):
        warning(
            f"dropped {n_dropped} connected components of the mesh that the {word} does not have (`keep_components` "
            "keeps them)"
        )
    return problems


def _lost(measured: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield, by name, labels of more than 200 voxels without a cell; warn of smaller ones, and of poor overlap."""
    labels = measured.get("labels", [])
    lost = [row for row in labels if row.is_lost]
    words = {row.label: label_words(row.label, measured.get("label_names", {})) for row in labels}
    large = [words[row.label] for row in lost if row.voxels > LABEL_VOXELS]
    if large:
        words_of_large = f"no cell has label {', '.join(large)}, of more than {LABEL_VOXELS} voxels"
        yield "labels", f"{words_of_large}; allow more nodes, or a higher `label_weight`"
    if small := [words[row.label] for row in lost if row.voxels <= LABEL_VOXELS]:
        warning(f"no cell has label {', '.join(small)}, of {LABEL_VOXELS} voxels or fewer")
    poor = [words[row.label] for row in labels if row.voxels > LABEL_VOXELS and row.dice < LABEL_DICE]
    if poor := [label for label in poor if label not in large]:
        warning(
            f"Dice below {LABEL_DICE} for label {listed(poor, 5)}: elements are too large, or this is "
            "not a label image; allow more nodes, or follow every voxel with `smooth_interfaces` 0"
        )


def _warn_of_mask(mask: MaskFidelity | None, word: str) -> None:
    if mask is None:
        return
    if mask.components > mask.mesh_components:  # more components of the mesh than of the mask violate a requirement
        warning(
            f"the {word} has {mask.components} connected components, the mesh {mask.mesh_components}: elements are too "
            f"large for the {word}'s detail; allow more nodes"
        )
    if (far := max(mask.distance_p95, mask.reverse_p95)) > FAR_VOXELS:
        warning(
            f"the mesh's boundary and the {word}'s surface are {far:.1f} voxels apart at the 95th percentile, "
            f"{max(mask.distance_mean, mask.reverse_mean):.1f} on average: elements are too large for the details; "
            "allow more nodes"
        )
    if abs(mask.mesh_euler - mask.euler) > EULER_FRACTION * max(abs(mask.euler), EULER_USUAL):
        warning(
            f"the Euler number of the {word}'s surface is {mask.euler}, that of the mesh's boundary {mask.mesh_euler}: "
            f"their holes and handles differ; allow more nodes"
        )


def warn_of_result(
    result: MeshingResult, method: Method, mode: Mode, n_nodes: int, nodes: int | None, measured: dict[str, Any],
    spacing: NDArray[np.float64],
) -> None:  # fmt: skip
    """Warn of results that are valid but probably not intended.

    The mesh has `n_nodes`, where a graded mesh should have `nodes`; `measured` holds the counts, and `spacing` (n,)
    the edges of the image's voxels, mm.
    """
    if nodes is not None and abs(n_nodes - nodes) > NODES_MISSED * nodes:
        remedy = "use more iterations, a `k_D` above 0, or larger sizes"
        if (needed := measured.get("nodes_of_sizes")) and needed > nodes:
            remedy = f"the target sizes need about {needed}; set `nodes` to that, or use larger sizes"
        warning(f"{n_nodes} nodes instead of {nodes}: {remedy}")
    lowest, first, last = min(row.E for row in result.history), result.history[0], result.history[-1]
    if last.E > lowest * (1.0 + ENERGY_RISE) and method == "paper":
        warning(
            f"E ended at {last.E:.4f}, above its minimum {lowest:.4f}: a tessellation in the first n_t iterations "
            "raised it; `retessellate` accept keeps only those that lower it"
        )
    if mode == "start" and last.E_D > first.E_D * (1.0 + ENERGY_RISE):
        rise = f"to {last.E_D / first.E_D:.3f} times its initial value" if first.E_D > 0.0 else "from 0"
        warning(f"E_D rose {rise}, as shapes were improved at its expense; increase `k_D`")
    n_empty = measured.get("cells_without_voxel", 0)
    if n_empty > EMPTY_CELLS * len(result.mesh.cells):
        remedy = "reduce `nodes`"
        if spacing.max() >= THICK_SLICES * spacing.min():
            remedy = f"slices are {spacing.max():.3g} mm apart, so some cells lie between them"
        warning(
            f"{n_empty} of {len(result.mesh.cells)} cells contain no voxel centre: these contribute nothing to E_D and "
            f"take the nearest voxel's value; {remedy}"
        )
    if crowded := measured.get("nodes_of_many_labels"):
        warning(
            f"more than {MOST_MEETING} labels meet at {crowded} nodes; only the first {MOST_MEETING} determine "
            "where these nodes lie"
        )


def tell_label_sizes(made: SizesByLabel, cells_across: float | None, table: LabelTable) -> None:
    """Report the nodes that sizes by label take, and the labels with too few cells across, the thinnest first."""
    larger = "" if made.scale == 1.0 else f"; with fewer nodes, edges are {made.scale:.2f} times as long"
    note(f"sizes by label require about {made.nodes} nodes{larger}")
    below = [each for each in made.layers if each.below >= TOLD_BELOW_FRACTION]
    if below and cells_across is not None:
        rows = [
            f"{table.names.get(each.label, each.label)} in {each.below:.0%} of its volume (half of it under "
            f"{each.thickness[1]:.3g} mm thick, {each.cells_across:.2g} cells across)"
            for each in below
        ]
        note(f"fewer than {cells_across:g} cells across: {listed(rows)}")


def warn_of_sizes(sizes: Sizes, shortest: float, longest: float, edges: EdgeRatios | None) -> None:
    """Warn of size limits and targets that the edges, from shortest to longest, mm, do not meet."""
    if sizes.longest is not None and longest > sizes.longest * (1.0 + LENGTH_ROUNDING):
        warning(
            f"the longest edge is {longest:.4g} mm, {longest / sizes.longest - 1.0:.0%} over `edge_max` "
            f"{sizes.longest:g}: splits and collapses respect it, but nodes move apart; lower it"
        )
    if shortest < sizes.smallest * (1.0 - LENGTH_ROUNDING):
        warning(
            f"the shortest edge is {shortest:.4g} mm, {1.0 - shortest / sizes.smallest:.0%} under `size_min` "
            f"{sizes.smallest:g}: splits respect it, but nodes move together; raise it"
        )
    if edges is not None and edges.above > TARGETS_MISSED:
        warning(
            f"{edges.above:.0%} of the edges are longer than {LONG_EDGE:.2f} times their target size; allow more "
            "nodes, or use larger sizes"
        )
