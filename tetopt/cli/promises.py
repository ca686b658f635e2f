"""What a mesh that `tetopt mesh` made must keep, and what is odd about it; both are said on standard error."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any

import tetopt
from tetopt import Mesh
from tetopt.cli.console import show_error, show_warning
from tetopt.cli.options import Method
from tetopt.engine.loop import Optimized
from tetopt.geometry.simplex import dihedral_angles, volumes
from tetopt.model.labels import label_words
from tetopt.target.content import Content

MASK_DICE = 0.9  # of a mesh with its mask, at least: below it the cells are larger than parts of the mask
LABEL_DICE = 0.5  # of a label with its cells: below it they hardly show the label
LABEL_VOXELS = 200  # a label of more may not be without cells
ANGLE_ROUNDING = 1e-6  # degrees by which a measured angle may miss the floor that the kernels kept in ticks
VOLUME_ROUNDING = 1e-9  # relative: the volume of cells that fill the box exactly, summed up
BOUNDARY_ROUNDING = 1e-6  # relative: likewise of cells within a boundary in the user's own digits
NODES_MISSED = 0.01  # of the number of nodes asked for: a larger miss is said
ENERGY_RISE = 1e-3  # relative: E that ended higher above its least value than this is said
EMPTY_CELLS = 0.02  # of the cells: if more hold no voxel, they are too many for the image


def check_promises(
    content: Content,
    result: Optimized,
    min_dihedral: float,
    target_error: float | None,
    measured: dict[str, Any],
    start: Mesh | None = None,
) -> int:
    """0 if the mesh covers what it should, keeps the floor on angles and has the target error; else 1, saying why.

    It should cover the mask, or what the user's own mesh `start` did, or the image's box.
    """
    problems = []
    if content.image.ndim == 3 and result.history[-1].iteration > 0:
        angles = dihedral_angles(result.mesh.points, result.mesh.cells).min(axis=1)
        if below := int((angles < min_dihedral - ANGLE_ROUNDING).sum()):
            remedy = "" if start is not None else "more nodes, "
            problems.append(
                f"{below} of {len(angles)} cells have an angle under {min_dihedral:g} degrees, down to "
                f"{angles.min():.2f}; allow {remedy}a lower --k-d, or a lower --min-dihedral"
            )
    share = result.history[-1].E_D / (content.variance * content.volume or 1.0)
    if target_error is not None and share > target_error:
        problems.append(
            f"{share:.4g} of the image's variance is left in the cells, more than {target_error:g}; allow smaller "
            "cells or more --iterations, or ask for a number of --nodes"
        )
    code = 0
    for problem in chain(problems, _lost(measured), _uncovered(content, result, start)):
        show_error(problem)
        code = 1
    return code


def _lost(measured: dict[str, Any]) -> Iterator[str]:
    """Labels of more than 200 voxels that no cell carries, a mask that the mesh hardly meets; warns of lesser ones."""
    labels, mask = measured.get("labels", []), measured.get("mask")
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
    if mask is not None and mask.dice < MASK_DICE:
        yield (
            f"the mesh and the mask overlap only by Dice {mask.dice:.3f}: cells are larger than parts of the mask; "
            "allow more nodes"
        )
    elif mask is not None and mask.components != mask.mesh_components:
        show_warning(
            f"the mask has {mask.components} pieces, the mesh {mask.mesh_components}: cells are as large "
            "as parts, or gaps, of the mask; allow more nodes"
        )


def _uncovered(content: Content, result: Optimized, start: Mesh | None) -> Iterator[str]:
    image, n_voxels = content.image, result.history[-1].n_voxels
    volume = float(volumes(result.mesh.points, result.mesh.cells).sum())
    if content.region is not None:
        if overlapping := n_voxels - int((tetopt.cell_of_voxel(image, result.mesh) >= 0).sum()):
            yield (
                f"cells overlap: together they hold {overlapping} voxels twice; allow more nodes, and please report "
                "this"
            )
    elif start is not None:
        before = float(volumes(start.points, start.cells).sum())
        gained = n_voxels - result.history[0].n_voxels
        if gained or abs(volume / before - 1.0) > BOUNDARY_ROUNDING:
            yield (
                f"the mesh no longer covers what it did: {gained:+d} voxels, its volume is {volume:.9g} of "
                f"{before:.9g} mm^{image.ndim}; please report this"
            )
    elif (missed := image.data.size - n_voxels) or abs(volume / image.volume - 1.0) >= VOLUME_ROUNDING:
        yield (
            f"the mesh does not cover the image: {missed} voxels are outside, its volume is {volume:.9g} of "
            f"{image.volume:.9g} mm^{image.ndim}; please report this"
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
