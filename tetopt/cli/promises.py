"""What a mesh that `tetopt mesh` made must keep, and what is odd about it; both are said on standard error."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tetopt.cli.console import show_error, show_warning
from tetopt.cli.options import Method
from tetopt.engine.loop import Optimized
from tetopt.engine.promises import LABEL_VOXELS
from tetopt.measure.fidelity import MaskFidelity
from tetopt.model.labels import label_words

LABEL_DICE = 0.5  # of a label with its cells: below it they hardly show the label
NODES_MISSED = 0.01  # of the number of nodes asked for: a larger miss is said
ENERGY_RISE = 1e-3  # relative: E that ended higher above its least value than this is said
EMPTY_CELLS = 0.02  # of the cells: if more hold no voxel, they are too many for the image


def check_promises(result: Optimized, measured: dict[str, Any]) -> int:
    """0 if the mesh is all that it should be (`tetopt.engine.promises`), and each large label has cells; else 1.

    Each promise that is missed is said in a line of its own. Warns of lesser misses.
    """
    lost = list(_lost(measured))
    problems = [words for name, words in result.missed.items() if not (name == "labels" and lost)]
    for problem in (*problems, *lost):
        show_error(problem)
    _warn_of_mask(measured.get("mask"))
    return 1 if problems or lost else 0


def _lost(measured: dict[str, Any]) -> Iterator[str]:
    """Labels of more than 200 voxels that no cell carries, by name; warns of lesser ones, and of those hardly shown."""
    labels = measured.get("labels", [])
    lost = [row for row in labels if row.is_lost]
    words = {row.label: label_words(row.label, measured.get("label_names", {})) for row in labels}
    large = [words[row.label] for row in lost if row.voxels > LABEL_VOXELS]
    if large:
        yield (
            f"no cell has label {', '.join(large)}, of more than {LABEL_VOXELS} voxels; allow more nodes, or a higher "
            "--label-weight"
        )
    if small := [words[row.label] for row in lost if row.voxels <= LABEL_VOXELS]:
        show_warning(f"no cell has label {', '.join(small)}, of {LABEL_VOXELS} voxels or fewer")
    poor = [words[row.label] for row in labels if row.voxels > LABEL_VOXELS and row.dice < LABEL_DICE]
    if poor := [label for label in poor if label not in large]:
        first = ", ".join(poor[:5]) + (f" and {len(poor) - 5} more" if len(poor) > 5 else "")
        show_warning(
            f"Dice below {LABEL_DICE} for label {first}: cells are too large for them, or these are no labels; allow "
            "more nodes, or follow every voxel by --smooth-interfaces 0"
        )


def _warn_of_mask(mask: MaskFidelity | None) -> None:
    if mask is not None and mask.components != mask.mesh_components:
        show_warning(
            f"the mask has {mask.components} pieces, the mesh {mask.mesh_components}: cells are as large "
            "as parts, or gaps, of the mask; allow more nodes"
        )


def warn_of_result(result: Optimized, method: Method, n_nodes: int, nodes: int | None, n_empty: int) -> None:
    """Say what is allowed but hardly meant.

    There are `n_nodes` in all, where a graded mesh was to have `nodes`; `n_empty` cells hold no voxel.
    """
    if nodes is not None and abs(n_nodes - nodes) > NODES_MISSED * nodes:
        show_warning(
            f"{n_nodes} nodes instead of {nodes}: more iterations, a --k-d above 0, or larger sizes come nearer"
        )
    lowest, last = min(row.E for row in result.history), result.history[-1].E
    if last > lowest * (1.0 + ENERGY_RISE) and method == "paper":
        show_warning(
            f"E ended at {last:.4f}, above {lowest:.4f} on the way: a tessellation taken in the first n_t iterations "
            "raised it; --retessellate accept takes only those that lower it"
        )
    if n_empty > EMPTY_CELLS * len(result.mesh.cells):
        show_warning(
            f"{n_empty} of {len(result.mesh.cells)} cells hold no voxel centre: E_D does not see them, and their "
            "values are the nearest voxel's; ask for fewer nodes"
        )
