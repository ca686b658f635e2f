"""What a mesh that `tetopt mesh` made must keep, and what is odd about it, said aloud."""

from __future__ import annotations

from typing import Any

import tetopt
from tetopt import Mesh
from tetopt.cli.console import log, show_warning
from tetopt.cli.options import Method
from tetopt.engine.loop import Optimized
from tetopt.geometry.simplex import dihedral_angles, volumes
from tetopt.target.content import Content

MISSED = 0.9  # Dice of a mesh with its mask: below, the mesh is not of the mask
POOR = 0.5  # Dice of a label that its cells hardly show
LARGE = 200  # voxels: a label of more may not be without cells


def check_promises(
    wanted: Content,
    result: Optimized,
    min_dihedral: float,
    target_error: float | None,
    found: dict[str, Any],
    start: Mesh | None = None,
) -> int:
    """0 if the mesh covers what it should, keeps the floor on angles and has the error asked; else 1, said aloud.

    It should cover the mask, or what the user's own mesh `start` did, or the image's box.
    """
    image = wanted.image
    below = 0
    if image.ndim == 3 and result.history[-1].iteration > 0:
        angles = dihedral_angles(result.mesh.points, result.mesh.cells).min(axis=1)
        below = int((angles < min_dihedral - 1e-6).sum())
    if below:
        remedy = "" if start is not None else "more nodes, "
        log.print(
            f"[bold red]tetopt:[/] {below} of {len(angles)} cells have an angle under {min_dihedral:g} degrees, "
            f"down to {angles.min():.2f}; allow {remedy}a lower --k-d, or a lower --min-dihedral"
        )
    share = result.history[-1].E_D / (wanted.variance * wanted.volume or 1.0)
    is_above = target_error is not None and share > target_error
    if is_above:
        log.print(
            f"[bold red]tetopt:[/] {share:.4g} of the image's variance is left in the cells, more than "
            f"{target_error:g}; allow smaller cells or more --iterations, or ask for a number of --nodes"
        )
    is_lost = _says_what_is_lost(found)
    if wanted.region is not None:
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
        if gained or abs(after / before - 1.0) > 1e-6:
            log.print(
                f"[bold red]tetopt:[/] the mesh no longer covers what it did: {gained:+d} voxels, its volume is "
                f"{after:.9g} of {before:.9g} mm^{image.ndim}; please report this"
            )
            return 1
        return 1 if below or is_lost else 0
    covered = float(volumes(result.mesh.points, result.mesh.cells).sum())
    missed = image.data.size - result.history[-1].n_voxels
    if missed == 0 and abs(covered / image.volume - 1.0) < 1e-9:
        return 1 if below or is_above or is_lost else 0
    log.print(
        f"[bold red]tetopt:[/] the mesh does not cover the image: {missed} voxels are outside, "
        f"its volume is {covered:.9g} of {image.volume:.9g} mm^{image.ndim}; please report this"
    )
    return 1


def _says_what_is_lost(found: dict[str, Any]) -> bool:
    """Name labels of more than 200 voxels that no cell carries, or hardly any, and say where a mask is not met.

    Whether a promise is missed: such a label is lost, or the mesh has little in common with the mask.
    """
    lost = [row for row in found.get("labels", []) if row.is_lost]
    large = [str(row.label) for row in lost if row.voxels > LARGE]
    if large:
        log.print(
            f"[bold red]tetopt:[/] no cell has label {', '.join(large)}, of more than {LARGE} voxels; allow more "
            "nodes, or a higher --label-weight"
        )
    if small := [str(row.label) for row in lost if row.voxels <= LARGE]:
        show_warning(f"no cell has label {', '.join(small)}, of {LARGE} voxels or fewer")
    poor = [str(row.label) for row in found.get("labels", []) if row.voxels > LARGE and row.dice < POOR]
    if poor := [label for label in poor if label not in large]:
        first = ", ".join(poor[:5]) + (f" and {len(poor) - 5} more" if len(poor) > 5 else "")
        show_warning(f"Dice below {POOR} for label {first}: cells are too large for them, or these are no labels")
    mask = found.get("mask")
    if mask is not None and mask.dice < MISSED:
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
    """Say what is allowed but hardly meant; `nodes` were asked of a graded mesh, `n_empty` cells hold no voxel."""
    found = len(result.mesh.points)
    if nodes is not None and abs(found - nodes) > 0.01 * nodes:
        show_warning(f"{found} nodes instead of {nodes}: more iterations, or a --k-d above 0, come nearer")
    lowest, last = min(row.E for row in result.history), result.history[-1].E
    if last > lowest * (1.0 + 1e-3) and method is Method.paper:
        show_warning(
            f"E ended at {last:.4f}, above {lowest:.4f} on the way: a tessellation taken in the first n_t iterations "
            "raised it; --retessellate accept takes only those that lower it"
        )
    if n_empty > 0.02 * len(result.mesh.cells):
        show_warning(
            f"{n_empty} of {len(result.mesh.cells)} cells hold no voxel centre: E_D does not see them, and their "
            "values are the nearest voxel's; ask for fewer nodes"
        )
