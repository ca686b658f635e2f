"""Check the requirements of `tetopt mesh` on a mesh of any origin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.energy.discretization import content_E_D
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.engine.requirements import checked, requested, violated_box
from tetopt.mesh import Mesh


def judged(
    mesh: Mesh,
    content: Content,
    labels: NDArray[np.int64] | None = None,
    *,
    min_dihedral: float = 0.0,
    target_error: float | None = None,
    is_filled: bool = False,
) -> MeshingResult:
    """Treat a mesh as the result of a run, with the `violated` and `fraction` that the run would have.

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
    row = IterationRecord(1, np.nan, np.nan, E_D, 0.0, False, len(mesh.cells), n_voxels, 0.0)
    result = checked(MeshingResult(mesh, [row], "iterations", mesh, labels=labels), content, min_dihedral, mesh)
    result = requested(result, content, target_error, is_filled)
    beyond = violated_box(mesh, content.image) if is_filled or content.region is not None else {}
    return result._replace(violated={**result.violated, **beyond})
