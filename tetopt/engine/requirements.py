"""The requirements of a mesh, measured on the mesh itself, independently of the engine.

A run that ends in time returns a mesh even if it does not meet them all; its result lists those that it violates, and
the command exits with status 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from math import prod

import numpy as np

from tetopt.contents.content import Content
from tetopt.contents.domain import Region
from tetopt.energy.discretization import unexplained
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS
from tetopt.geometry.check import beyond_box, manifold_problems
from tetopt.geometry.simplex import dihedral_angles, volumes
from tetopt.geometry.topology import components
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.start.carve import n_components

MASK_DICE = 0.9  # least Dice of a mesh with its mask, below which cells are too large for the mask's detail
LABEL_VOXELS = 200  # a label with more voxels must have cells that contain some
ANGLE_ROUNDING = 1e-6  # degrees by which a measured angle may be below the minimum that kernels enforce in ticks
VOLUME_ROUNDING = 1e-9  # relative: rounding of the total volume of cells that fill the box exactly
BEYOND_WORDS = "nodes lie up to {:.3g} voxels beyond the image's box; please report this"
BOUNDARY_ROUNDING = 1e-6  # relative: the same within a boundary with the user's digits


def checked(
    result: MeshingResult, content: Content, min_dihedral: float, start: Mesh, dice: float | None = None
) -> MeshingResult:
    """Add the requirements that a run's mesh violates to its result, each as a sentence.

    Parameters
    ----------
    result : MeshingResult
        The result of the run, of which mesh, history and labels are used.
    content : Content
        What the mesh represents.
    min_dihedral : float
        The minimum dihedral angle, degrees; 0 for none, and in 2-D.
    start : Mesh
        The mesh that the run began with, whose domain it should cover, if there is no mask.
    dice : float, optional
        Dice of the whole mesh with the mask; by default by the content's voxels, which a run's mesh does not leave.

    Returns
    -------
    MeshingResult
        With `violated`, empty if all are met. `min_dihedral`: tetrahedra with a smaller dihedral angle. `box`: nodes
        farther beyond the image's box than the initial mesh's. `cover`: voxels or volume lost or gained relative to the
        initial mesh. Within a mask, instead of the last, `overlap`: voxels that lie in
        two cells; `mask`: a Dice with the mask below 0.9; and `components`: more connected components than the mask.
        `manifold`: edges or nodes at which the boundary, within a mask, or the interface of two labels is not a
        manifold. `labels`: labels of more than 200 voxels none of which lies in a cell
        with that label. A requirement that cannot be checked, for lack
        of memory, counts as violated, with the reason, and the mesh is kept.
    """
    of_domain: dict[str, Callable[[], dict[str, str]]] = {"cover": lambda: _violated_cover(result, start)}
    if content.region is not None:
        of_domain = {
            "mask": partial(_violated_mask, content.image, content.region, result, dice),
            "components": partial(_violated_components, content.region, result.mesh),
        }
    checks: dict[str, Callable[[], dict[str, str]]] = {
        "min_dihedral": lambda: _violated_min_dihedral(result, min_dihedral),
        "box": lambda: violated_box(result.mesh, content.image, start),
        **of_domain,
        "manifold": lambda: _violated_manifold(content, result),
        "labels": lambda: _violated_labels(content, result),
    }
    violated: dict[str, str] = {}
    for name, check in checks.items():
        try:
            violated |= check()
        except InputError:
            raise
        except Exception as error:
            violated[name] = f"{name} could not be checked: {type(error).__name__} {error}".rstrip()
    return result._replace(violated=violated)


def violated_box(mesh: Mesh, image: Image, start: Mesh | None = None) -> dict[str, str]:
    """Nodes beyond an image's box, or farther beyond it than those of an initial mesh, if given."""
    beyond = float(beyond_box(mesh, image).max())
    allowed = 0.0 if start is None else max(float(beyond_box(start, image).max()), 0.0)
    return {"box": BEYOND_WORDS.format(beyond)} if beyond > allowed + ON_SIDE_VOXELS else {}


def checked_in_box(result: MeshingResult, grid: Image, min_dihedral: float) -> MeshingResult:
    """Like `checked`, for a mesh that fills the box of an image, whose voxels need not be in memory."""
    violated = _violated_min_dihedral(result, min_dihedral) | _uncovered(grid, result) | violated_box(result.mesh, grid)
    return result._replace(violated=violated)


def _violated_min_dihedral(result: MeshingResult, min_dihedral: float) -> dict[str, str]:
    mesh = result.mesh
    if mesh.ndim != 3:
        return {}
    angles = dihedral_angles(mesh.points, mesh.cells).min(axis=1)
    below = int((angles < min_dihedral - ANGLE_ROUNDING).sum())
    words = f"{below} of {len(angles)} cells have a dihedral angle below {min_dihedral:g} degrees, down to "
    first = "more `iterations`, as none was made" if result.history[-1].iteration == 0 else "more nodes, a lower `k_D`"
    words += f"{angles.min():.2f}; allow {first}, or a lower `min_dihedral`"
    return {"min_dihedral": words} if below else {}


def requested(result: MeshingResult, content: Content, target_error: float | None, is_filled: bool) -> MeshingResult:
    """Add requests to `mesh_image` that a run's result does not meet to its violated requirements.

    `error`: an unexplained variance above `target_error`. `cover`: uncovered voxels or volume, if the mesh should fill
    the image's box (`is_filled`). `manifold`: edges or nodes at which the boundary of the user's own mesh is none.
    """
    violated = dict(result.violated)
    fraction = unexplained_by(content, result.mesh, result.history[-1])
    if target_error is not None and fraction > target_error:
        violated["error"] = (
            f"{fraction:.4g} of the image's variance is unexplained, more than {target_error:g}; allow smaller "
            "cells or more iterations, or give a number of nodes"
        )
    violated |= _uncovered(content.image, result) if is_filled else {}
    if not is_filled and content.region is None and (problems := manifold_problems(result.mesh)):
        violated["manifold"] = "; ".join([*problems, "mend the initial mesh"])
    return result._replace(violated=violated, fraction=fraction)


def unexplained_by(content: Content, mesh: Mesh, record: IterationRecord) -> float:
    """Return the unexplained variance of a mesh with this record, `tetopt.energy.discretization.unexplained`; or 0."""
    if content.region is None and record.n_voxels == content.n_voxels:  # also if the voxels stay in their file
        return record.E_D / (content.variance * content.volume or 1.0)
    return unexplained(content, mesh) or 0.0


def _uncovered(image: Image, result: MeshingResult) -> dict[str, str]:
    outside, volume = prod(image.shape) - result.history[-1].n_voxels, _volume(result.mesh)
    if outside == 0 and abs(volume / image.volume - 1.0) < VOLUME_ROUNDING:
        return {}
    words = f"the mesh does not cover the image: {outside} voxels are outside, and its volume is {volume:.9g} of "
    return {"cover": f"{words}{image.volume:.9g} mm^{image.ndim}; please report this"}


def _violated_cover(result: MeshingResult, start: Mesh) -> dict[str, str]:
    before, volume = _volume(start), _volume(result.mesh)
    gained = result.history[-1].n_voxels - result.history[0].n_voxels
    if gained == 0 and abs(volume / before - 1.0) <= BOUNDARY_ROUNDING:
        return {}
    words = f"the mesh no longer covers its initial domain: {gained:+d} voxels, and its volume is {volume:.9g} of "
    return {"cover": f"{words}{before:.9g} mm^{start.ndim}; please report this"}


def _violated_mask(image: Image, region: Region, result: MeshingResult, dice: float | None) -> dict[str, str]:
    violated = {}
    is_covered, inside = cell_of_voxel(image, result.mesh) >= 0, region.inside
    if twice := result.history[-1].n_voxels - int(is_covered.sum()):
        violated["overlap"] = (
            f"cells overlap: {twice} voxels lie in two cells; allow more nodes, and please report this"
        )
    if dice is None:
        dice = 2.0 * int((is_covered & inside).sum()) / max(int(is_covered.sum() + inside.sum()), 1)
    if dice < MASK_DICE:
        violated["mask"] = (
            f"the mesh and the mask overlap with a Dice of only {dice:.3f}: cells are too large for the mask's detail; "
            "allow more nodes"
        )
    return violated


def _violated_components(region: Region, mesh: Mesh) -> dict[str, str]:
    n_cells = np.sort(np.bincount(components(mesh.cells)))[::-1]
    if len(n_cells) == 1 or len(n_cells) <= (n_mask := n_components(region)):
        return {}
    words = f"the mesh has {len(n_cells)} connected components, the mask {n_mask}; the smallest have"
    return {"components": f"{words} {', '.join(map(str, n_cells[:-4:-1]))} cells; allow more nodes"}


def _violated_manifold(content: Content, result: MeshingResult) -> dict[str, str]:
    problems = [] if content.region is None else manifold_problems(result.mesh)
    if result.labels is not None and content.memberships is not None:
        problems += manifold_problems(result.mesh, result.labels)
    return {"manifold": "; ".join([*problems, "allow more nodes"])} if problems else {}


def _violated_labels(content: Content, result: MeshingResult) -> dict[str, str]:
    members = content.memberships
    if members is None or result.labels is None:
        return {}
    owner = cell_of_voxel(content.image, result.mesh)
    is_inside = owner >= 0 if content.region is None else content.region.inside
    counts = np.bincount(members.partition[is_inside].ravel(), minlength=len(members.labels))
    is_right = (owner >= 0) & (members.labels[members.partition] == result.labels[owner])
    is_kept = np.bincount(members.partition[is_right].ravel(), minlength=len(members.labels)) > 0
    lost = members.labels[(counts > LABEL_VOXELS * members.parts) & ~is_kept]
    return (
        {"labels": f"{lost_words(map(str, lost))}; allow more nodes, or a higher `label_weight`"} if len(lost) else {}
    )


def lost_words(labels: Iterable[str]) -> str:
    """Say that large labels have no cells, or have them elsewhere alone."""
    return f"no voxel of label {', '.join(labels)}, of more than {LABEL_VOXELS} voxels, lies in a cell with that label"


def _volume(mesh: Mesh) -> float:
    return float(volumes(mesh.points, mesh.cells).sum())
