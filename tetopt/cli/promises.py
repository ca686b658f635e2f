"""What a mesh that `tetopt mesh` made must keep, and what is odd about it; both are said on standard error."""

from __future__ import annotations

from typing import Any

import tetopt
from tetopt import Mesh
from tetopt.cli.console import log, show_warning
from tetopt.cli.options import Method
from tetopt.engine.loop import Optimized
from tetopt.geometry.simplex import dihedral_angles, volumes
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
    image = content.image
    below = 0
    if image.ndim == 3 and result.history[-1].iteration > 0:
        angles = dihedral_angles(result.mesh.points, result.mesh.cells).min(axis=1)
        below = int((angles < min_dihedral - ANGLE_ROUNDING).sum())
    if below:
        remedy = "" if start is not None else "more nodes, "
        log.print(
            f"[bold red]tetopt:[/] {below} of {len(angles)} cells have an angle under {min_dihedral:g} degrees, "
            f"down to {angles.min():.2f}; allow {remedy}a lower --k-d, or a lower --min-dihedral"
        )
    share = result.history[-1].E_D / (content.variance * content.volume or 1.0)
    is_above = target_error is not None and share > target_error
    if is_above:
        log.print(
            f"[bold red]tetopt:[/] {share:.4g} of the image's variance is left in the cells, more than "
            f"{target_error:g}; allow smaller cells or more --iterations, or ask for a number of --nodes"
        )
    is_lost = _says_what_is_lost(measured)
    if content.region is not None:
        n_voxels = result.history[-1].n_voxels
        overlapping = n_voxels - int((tetopt.cell_of_voxel(image, result.mesh) >= 0).sum())
        if overlapping:
            log.print(
                f"[bold red]tetopt:[/] cells overlap: together they hold {overlapping} voxels twice; allow more nodes, "
                "and please report this"
            )
        return 1 if below or is_above or is_lost or overlapping else 0
    if start is not None:
        before, after = (float(volumes(mesh.points, mesh.cells).sum()) for mesh in (start, result.mesh))
        gained = result.history[-1].n_voxels - result.history[0].n_voxels
        if gained or abs(after / before - 1.0) > BOUNDARY_ROUNDING:
            log.print(
                f"[bold red]tetopt:[/] the mesh no longer covers what it did: {gained:+d} voxels, its volume is "
                f"{after:.9g} of {before:.9g} mm^{image.ndim}; please report this"
            )
            return 1
        return 1 if below or is_lost else 0
    covered = float(volumes(result.mesh.points, result.mesh.cells).sum())
    missed = image.data.size - result.history[-1].n_voxels
    if missed == 0 and abs(covered / image.volume - 1.0) < VOLUME_ROUNDING:
        return 1 if below or is_above or is_lost else 0
    log.print(
        f"[bold red]tetopt:[/] the mesh does not cover the image: {missed} voxels are outside, "
        f"its volume is {covered:.9g} of {image.volume:.9g} mm^{image.ndim}; please report this"
    )
    return 1


def _says_what_is_lost(measured: dict[str, Any]) -> bool:
    """Name labels of more than 200 voxels that no cell carries, or hardly any, and say where a mask is not met.

    Whether a promise is missed: such a label is lost, or the mesh has little in common with the mask.
    """
    lost = [row for row in measured.get("labels", []) if row.is_lost]
    large = [str(row.label) for row in lost if row.voxels > LABEL_VOXELS]
    if large:
        log.print(
            f"[bold red]tetopt:[/] no cell has label {', '.join(large)}, of more than {LABEL_VOXELS} voxels; allow "
            "more nodes, or a higher --label-weight"
        )
    if small := [str(row.label) for row in lost if row.voxels <= LABEL_VOXELS]:
        show_warning(f"no cell has label {', '.join(small)}, of {LABEL_VOXELS} voxels or fewer")
    poor = [str(row.label) for row in measured.get("labels", []) if row.voxels > LABEL_VOXELS and row.dice < LABEL_DICE]
    if poor := [label for label in poor if label not in large]:
        first = ", ".join(poor[:5]) + (f" and {len(poor) - 5} more" if len(poor) > 5 else "")
        show_warning(f"Dice below {LABEL_DICE} for label {first}: cells are too large for them, or these are no labels")
    mask = measured.get("mask")
    if mask is not None and mask.dice < MASK_DICE:
        log.print(
            f"[bold red]tetopt:[/] the mesh and the mask overlap only by Dice {mask.dice:.3f}: cells are larger "
            "than parts of the mask; allow more nodes"
        )
        return True
    if mask is not None and mask.components != mask.mesh_components:
        show_warning(
            f"the mask has {mask.components} pieces, the mesh {mask.mesh_components}: cells are as large "
            "as parts, or gaps, of the mask; allow more nodes"
        )
    return bool(large)


def warn_of_result(result: Optimized, method: Method, nodes: int | None, n_empty: int) -> None:
    """Say what is allowed but hardly meant; a graded mesh was to have `nodes`, `n_empty` cells hold no voxel."""
    n_nodes = len(result.mesh.points)
    if nodes is not None and abs(n_nodes - nodes) > NODES_MISSED * nodes:
        show_warning(f"{n_nodes} nodes instead of {nodes}: more iterations, or a --k-d above 0, come nearer")
    lowest, last = min(row.E for row in result.history), result.history[-1].E
    if last > lowest * (1.0 + ENERGY_RISE) and method is Method.paper:
        show_warning(
            f"E ended at {last:.4f}, above {lowest:.4f} on the way: a tessellation taken in the first n_t iterations "
            "raised it; --retessellate accept takes only those that lower it"
        )
    if n_empty > EMPTY_CELLS * len(result.mesh.cells):
        show_warning(
            f"{n_empty} of {len(result.mesh.cells)} cells hold no voxel centre: E_D does not see them, and their "
            "values are the nearest voxel's; ask for fewer nodes"
        )
