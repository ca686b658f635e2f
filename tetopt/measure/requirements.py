"""Check the requirements of `tetopt mesh` on a mesh of any origin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.energy.discretization import content_E_D
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.engine.requirements import MASK_DICE, checked, requested, violated_box
from tetopt.errors import warn
from tetopt.image import Image
from tetopt.mesh import Mesh


def judged(
    mesh: Mesh,
    content: Content,
    labels: NDArray[np.int64] | None = None,
    *,
    min_dihedral: float = 0.0,
    target_error: float | None = None,
    is_filled: bool = False,
    dice: float | None = None,
    is_initial: bool = False,
) -> MeshingResult:
    """Treat a mesh as the result of a run, with the `violated` and `fraction` that the run would
    have.

    Parameters
    ----------
    mesh : Mesh
    content : Content
        What the mesh represents.
    labels : (M,) int64, optional
        Label of each cell.
    min_dihedral : float
        The minimum dihedral angle, degrees; 0 for none.
    target_error : float, optional
        The allowed unexplained fraction of the variance.
    is_filled : bool
        True if the mesh should fill the image's box.
    dice : float, optional
        Dice of the mesh with the mask, over the whole mesh; by default over the content's voxels,
        around the mask.
    is_initial : bool
        True if the run made no iteration, which the remedies then name.

    Returns
    -------
    MeshingResult
        The result; its history has one row, with E_D and the number of voxels.

    Raises
    ------
    InputError
        As for `tetopt.energy.sampling.cell_moments`.
    """
    E_D, n_voxels = content_E_D(content, mesh)
    row = IterationRecord(
        int(not is_initial), np.nan, np.nan, E_D, 0.0, False, len(mesh.cells), n_voxels, 0.0
    )
    result = MeshingResult(mesh, [row], "iterations", mesh, labels=labels)
    result = checked(result, content, min_dihedral, mesh, dice)
    result = requested(result, content, target_error, is_filled)
    beyond = violated_box(mesh, content.given) if is_filled or content.region is not None else {}
    return result._replace(violated={**result.violated, **beyond})


def warn_of_other_mask(mesh: Mesh, mask: Image | None) -> None:
    """Warn if a mesh hardly overlaps with a mask: cells elsewhere take the values of its nearest
    voxels.
    """
    if mask is None:
        return
    inside = mask.data >= INSIDE_FRACTION
    n_both = int((inside & (cell_of_voxel(mask, mesh.straight_pieces()[0]) >= 0)).sum())
    n_covered = float(mesh.cell_volumes.sum()) / mask.voxel_volume
    dice = 2.0 * n_both / (n_covered + int(inside.sum()))
    if dice < MASK_DICE:
        warn(
            f"mesh and mask overlap with a Dice of only {dice:.2g}, and cells elsewhere take "
            "values of the mask's "
            "nearest voxels; was the mesh built within another mask, or within none?"
        )
