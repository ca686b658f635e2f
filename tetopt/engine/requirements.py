"""The requirements of a mesh, measured on the mesh itself, independently of the engine.

A run that ends in time returns a mesh even if it does not meet them all; its result lists those
that it violates, and the command exits with status 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from math import prod
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.contents.domain import Region
from tetopt.contents.labels import BACKGROUND_LABEL, LostComponent, voxel_components
from tetopt.contents.memberships import Memberships, supersampling
from tetopt.energy.discretization import unexplained
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine.labelling import COMPONENT_VOXELS
from tetopt.engine.loop import CUT_SHORT, IterationRecord, MeshingResult
from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS
from tetopt.geometry.check import beyond_box, manifold_problems
from tetopt.geometry.manifold import OUTSIDE_LABEL
from tetopt.geometry.simplex import dihedral_angles, edge_pairs, squared_edges
from tetopt.geometry.topology import components
from tetopt.image import Image, transformed
from tetopt.mesh import Mesh

# requirements on the voxels in cells, which curved edges change
OF_VOXELS = ("mask", "components", "labels")
# least Dice of a mesh with its mask, below which cells are too large for the mask's detail
MASK_DICE = 0.9
# a label with as many voxels must have cells that contain some, of about their volume
LABEL_VOXELS = 200
LARGE_COMPONENTS = f"of {COMPONENT_VOXELS} voxels or more"
LEAST_VOLUME, MOST_VOLUME = 0.6, 1.5  # of a label's cells, over its voxels'
LABEL_REMEDY = "allow more nodes, more `cells_across`, or a higher `label_weight`"
PIECES_REMEDY = (
    "allow more nodes, so that cells are smaller than these, or merge (`merge`) or "
    "clean labels of crumbs"
)
COMPONENTS_LISTED = 5  # of those without a cell
# degrees by which a measured angle may be below the minimum that kernels enforce in ticks
ANGLE_ROUNDING = 1e-6
VOLUME_ROUNDING = 1e-9  # relative: rounding of the total volume of cells that fill the box exactly
BEYOND_WORDS = "nodes lie up to {:.3g} voxels beyond the image's box; please report this"
# E_D falls with nodes^-0.57 on the MNI152 T1 from 1,500 to 5,400 nodes, ^-0.7 up to 40,000
ERROR_RATE = 0.6
ERROR_REACHED = 0.85  # of the target error: a run from here up to the target ends the search
ERROR_AIM = 0.5 * (1.0 + ERROR_REACHED)
BOUNDARY_ROUNDING = 1e-6  # relative: the same within a boundary with the user's digits


def checked(
    result: MeshingResult,
    content: Content,
    min_dihedral: float,
    start: Mesh,
    dice: float | None = None,
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
        Dice of the whole mesh with the mask; by default by the content's voxels, which a run's mesh
        does not leave.

    Returns
    -------
    MeshingResult
        With `violated`, empty if all are met. `min_dihedral`: tetrahedra with a smaller dihedral
        angle. `box`: nodes farther beyond the image's box than the initial mesh's. `cover`: voxels
        or volume lost or gained relative to the initial mesh. Within a mask, instead of the last,
        `overlap`: voxels that lie in two cells; `mask`: a Dice with the mask below 0.9; and
        `components`: more connected components than the mask, or components of the mask, or parts
        far from any cell, of 50 voxels or more without a cell. `manifold`: edges or nodes at which
        the boundary, within a mask, or the interface of two labels is not a manifold. `labels`:
        labels of 200 voxels or more none of which lies in a cell with that label, or whose cells
        have less than 0.6 or more than 1.5 times their volume, and components of labels of 50
        voxels or more without a cell. A requirement that cannot be checked, for lack of memory,
        counts as violated, with the reason, and the mesh is kept.
    """
    of_domain: dict[str, Callable[[], dict[str, str]]] = {
        "cover": lambda: _violated_cover(result, start)
    }
    pieces, n_pieces = result.mesh.straight_pieces()
    owner = cache(lambda: cell_of_voxel(content.image, pieces) // n_pieces)
    if (region := content.region) is not None:
        of_domain = {
            "mask": lambda: _violated_mask(region, result, owner(), dice),
            "components": lambda: _violated_components(content, region, result.mesh, owner()),
        }
    checks: dict[str, Callable[[], dict[str, str]]] = {
        "min_dihedral": lambda: _violated_min_dihedral(result, min_dihedral),
        "box": lambda: violated_box(result.mesh, content.image, start),
        **of_domain,
        "manifold": lambda: _violated_manifold(content, result),
        "labels": lambda: _violated_labels(content, result, owner),
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


def checked_curved(result: MeshingResult, content: Content) -> MeshingResult:
    """Check again, on the cells that order 2 has curved, which voxels and volumes they contain."""
    if result.mesh.midpoints is None:
        return result
    violated = {name: words for name, words in result.violated.items() if name not in OF_VOXELS}
    return result._replace(
        violated={**violated, **checked(result, content, 0.0, result.mesh).violated}
    )


def violated_box(mesh: Mesh, image: Image, start: Mesh | None = None) -> dict[str, str]:
    """Nodes beyond an image's box, or farther beyond it than those of an initial mesh, if given."""
    beyond = float(beyond_box(mesh, image).max())
    allowed = 0.0 if start is None else max(float(beyond_box(start, image).max()), 0.0)
    return {"box": BEYOND_WORDS.format(beyond)} if beyond > allowed + ON_SIDE_VOXELS else {}


def _violated_min_dihedral(result: MeshingResult, min_dihedral: float) -> dict[str, str]:
    mesh = result.mesh
    if mesh.ndim != 3:
        return {}
    angles = dihedral_angles(mesh.points, mesh.cells).min(axis=1)
    below = int((angles < min_dihedral - ANGLE_ROUNDING).sum())
    words = (
        f"{below} of {len(angles)} cells have a dihedral angle below {min_dihedral:g} "
        "degrees, down to "
    )
    first = (
        "more `iterations`, as none was made"
        if result.history[-1].iteration == 0
        else "more nodes, a lower `k_D`"
    )
    words += f"{angles.min():.2f}; allow {first}, or a lower `min_dihedral`"
    return {"min_dihedral": words} if below else {}


def requested(
    result: MeshingResult, content: Content, target_error: float | None, is_filled: bool
) -> MeshingResult:
    """Add requests to `mesh_image` that a run's result does not meet to its violated requirements.

    `error`: an unexplained variance above `target_error`. `cover`: uncovered voxels or volume, if
    the mesh should fill the image's box (`is_filled`). `manifold`: edges or nodes at which the
    boundary of the user's own mesh is none.
    """
    violated = dict(result.violated)
    fraction = unexplained_by(content, result.mesh, result.history[-1])
    if target_error is not None and fraction > target_error:
        ratio = float(f"{nodes_ratio(fraction, target_error):.2g}")
        rest = (
            f"as the run was cut short ({result.ended}); allow more time or memory, or raise "
            "`target_error`"
            if result.ended in CUT_SHORT
            else f"which requires about {ratio:g} times the nodes; allow more (`nodes_max`), "
            "smaller cells or more "
            "iterations, or raise `target_error`"
        )
        violated["error"] = (
            f"{fraction:.4g} of the image's variance is unexplained, more than {target_error:g}, "
            f"{rest}"
        )
    violated |= _uncovered(content.image, result) if is_filled else {}
    if not is_filled and content.region is None and (problems := manifold_problems(result.mesh)):
        violated["manifold"] = "; ".join([*problems, "mend the initial mesh"])
    return result._replace(violated=violated, fraction=fraction)


def nodes_ratio(fraction: float, target_error: float, rate: float = ERROR_RATE) -> float:
    """Return how many times the nodes that leave a fraction of the variance unexplained a target
    error takes.
    """
    return float((fraction / (ERROR_AIM * target_error)) ** (1.0 / rate))


def unexplained_by(content: Content, mesh: Mesh, record: IterationRecord) -> float:
    """Return the unexplained variance of a mesh with this record,
    `tetopt.energy.discretization.unexplained`; or 0.
    """
    # also if the voxels stay in their file
    if content.region is None and record.n_voxels == content.n_voxels:
        return record.E_D / (content.variance * content.volume or 1.0)
    return unexplained(content, mesh) or 0.0


def _uncovered(image: Image, result: MeshingResult) -> dict[str, str]:
    outside, volume = prod(image.shape) - result.history[-1].n_voxels, _volume(result.mesh)
    if outside == 0 and abs(volume / image.volume - 1.0) < VOLUME_ROUNDING:
        return {}
    words = (
        f"the mesh does not cover the image: {outside} voxels are outside, and its volume "
        f"is {volume:.9g} of "
    )
    return {"cover": f"{words}{image.volume:.9g} mm^{image.ndim}; please report this"}


def _violated_cover(result: MeshingResult, start: Mesh) -> dict[str, str]:
    before, volume = _volume(start), _volume(result.mesh)
    gained = result.history[-1].n_voxels - result.history[0].n_voxels
    if gained == 0 and abs(volume / before - 1.0) <= BOUNDARY_ROUNDING:
        return {}
    words = (
        f"the mesh no longer covers its initial domain: {gained:+d} voxels, and its volume "
        f"is {volume:.9g} of "
    )
    return {"cover": f"{words}{before:.9g} mm^{start.ndim}; please report this"}


def _violated_mask(
    region: Region, result: MeshingResult, owner: NDArray[np.int64], dice: float | None
) -> dict[str, str]:
    violated = {}
    is_covered, inside = owner >= 0, region.inside
    if result.mesh.midpoints is None and (
        twice := result.history[-1].n_voxels - int(is_covered.sum())
    ):
        violated["overlap"] = (
            f"cells overlap: {twice} voxels lie in two cells; allow more nodes, and please "
            "report this"
        )
    if dice is None:
        dice = 2.0 * int((is_covered & inside).sum()) / max(int(is_covered.sum() + inside.sum()), 1)
    if dice < MASK_DICE:
        violated["mask"] = (
            f"the mesh and the mask overlap with a Dice of only {dice:.3f}: cells are too large "
            "for the mask's detail; "
            "allow more nodes"
        )
    return violated


def _violated_components(
    content: Content, region: Region, mesh: Mesh, owner: NDArray[np.int64]
) -> dict[str, str]:
    n_cells, texts = np.sort(np.bincount(components(mesh.cells)))[::-1], []
    planes, affine = _own_voxels(content)
    n_mask, lost = voxel_components(region.inside[planes], owner[planes] >= 0, affine)
    if len(n_cells) > max(n_mask, 1):
        words = (
            f"the mesh has {len(n_cells)} connected components, the mask {n_mask}; the "
            "smallest have"
        )
        texts.append(f"{words} {', '.join(map(str, n_cells[:-4:-1]))} cells")
    large = [(each, "") for each in lost if each.voxels >= COMPONENT_VOXELS]
    texts += (
        [f"components of the mask {LARGE_COMPONENTS} without a cell: {_listed(large)}"]
        if large
        else []
    )
    bare = _bare_parts(mesh, region.inside[planes] & (owner[planes] < 0), affine)
    far = [(each, "") for each in bare if each.voxels >= COMPONENT_VOXELS]
    texts += (
        [f"parts of the mask {LARGE_COMPONENTS} with no cell near: {_listed(far)}"]
        if far and not large
        else []
    )
    return {"components": "; ".join([*texts, "allow more nodes"])} if texts else {}


def _bare_parts(
    mesh: Mesh, is_bare: NDArray[np.bool_], affine: NDArray[np.float64]
) -> tuple[LostComponent, ...]:
    """Components of a mask's voxels without a cell that lie farther from the nearest node than
    its longest edge.
    """
    ends, longest = mesh.cells[:, edge_pairs(mesh.ndim)], np.zeros(len(mesh.points))
    np.maximum.at(longest, ends, np.sqrt(squared_edges(mesh.points, mesh.cells))[:, :, None])
    index = np.argwhere(is_bare)
    places = transformed(index.astype(np.float64), affine[:-1, :-1]) + affine[:-1, -1]
    distance, node = scipy.spatial.cKDTree(mesh.points).query(places)
    is_far = np.zeros_like(is_bare)
    is_far[tuple(index[distance > longest[node]].T)] = True
    return voxel_components(is_far, np.zeros_like(is_far), affine)[1]


def _violated_manifold(content: Content, result: MeshingResult) -> dict[str, str]:
    problems = [] if content.region is None else manifold_problems(result.mesh)
    if result.labels is not None and content.memberships is not None:
        problems += manifold_problems(result.mesh, result.labels)
    return {"manifold": "; ".join([*problems, "allow more nodes"])} if problems else {}


class LabelFit(NamedTuple):
    """How a label's cells represent it, as far as a requirement."""

    label: int
    voxels: int  # of it that cells should represent
    volume_ratio: float  # of its cells to its voxels
    is_met: bool  # one of its voxels, or more, lies in a cell with the label
    components: tuple[LostComponent, ...]  # of its voxels, in which none does

    @property
    def is_lost(self) -> bool:
        """True for a large label without a cell, or with cells elsewhere."""
        return self.voxels >= LABEL_VOXELS and not self.is_met

    @property
    def is_off(self) -> bool:
        """True if a large label has cells of too much or too little volume."""
        return (
            self.voxels >= LABEL_VOXELS
            and self.is_met
            and not LEAST_VOLUME <= self.volume_ratio <= MOST_VOLUME
        )

    @property
    def is_faulty(self) -> bool:
        """True if the label violates the requirement."""
        return self.is_lost or self.is_off or len(self.pieces) > 0

    @property
    def pieces(self) -> tuple[LostComponent, ...]:
        """The large ones of a tissue that has cells elsewhere; those of the space between
        tissues do not count.
        """
        is_exempt = self.is_lost or self.label == BACKGROUND_LABEL
        return (
            ()
            if is_exempt
            else tuple(each for each in self.components if each.voxels >= COMPONENT_VOXELS)
        )


def label_faults(fits: Iterable[LabelFit], words: Mapping[int, str]) -> str:
    """Describe labels that violate the requirement, each by its words; empty if none does."""
    faulty, texts = [fit for fit in fits if fit.is_faulty], []
    if lost := [words[fit.label] for fit in faulty if fit.is_lost]:
        texts.append(
            f"no voxel of label {', '.join(lost)}, of {LABEL_VOXELS} voxels or more, lies in a "
            "cell with that label"
        )
    off = sorted(
        (fit for fit in faulty if fit.is_off), key=lambda fit: -abs(np.log(fit.volume_ratio))
    )
    if off:
        rows = ", ".join(f"{fit.volume_ratio:.3g} for label {words[fit.label]}" for fit in off)
        texts.append(
            f"the volume of cells is not {LEAST_VOLUME:g} to {MOST_VOLUME:g} times that of "
            f"voxels: {rows}"
        )
    pieces = [(each, f" of label {words[fit.label]}") for fit in faulty for each in fit.pieces]
    texts += (
        [f"components of labels {LARGE_COMPONENTS} without a cell: {_listed(pieces)}"]
        if pieces
        else []
    )
    return "; ".join(texts)


def label_remedy(fits: Iterable[LabelFit]) -> str:
    """Return what helps labels that violate the requirement.

    A higher weight hardly gives small components cells, at the expense of volumes: in the MNI152 T1
    with tissues and 5,000 nodes, weight 4 leaves 23 of 28 without a cell, and fluid with -23
    instead of -20 % of its volume; 20,000 nodes leave 2, and -10 %.
    """
    return PIECES_REMEDY if any(fit.pieces for fit in fits) else LABEL_REMEDY


def _listed(pieces: list[tuple[LostComponent, str]]) -> str:
    """List the largest components, each with words on it."""
    ranked = sorted(pieces, key=lambda piece: -piece[0].voxels)
    rows = [
        f"{each.voxels} voxels{words} at ({', '.join(f'{x:.4g}' for x in each.place)}) mm"
        for each, words in ranked[:COMPONENTS_LISTED]
    ]
    return ", ".join(rows) + (
        f" and {len(ranked) - len(rows)} more" if len(ranked) > len(rows) else ""
    )


def _violated_labels(
    content: Content, result: MeshingResult, owner: Callable[[], NDArray[np.int64]]
) -> dict[str, str]:
    if content.memberships is None or result.labels is None:
        return {}
    fits = _label_fits(content, content.memberships, result.mesh, result.labels, owner())
    text = label_faults(fits, {fit.label: str(fit.label) for fit in fits})
    return {"labels": f"{text}; {label_remedy(fits)}"} if text else {}


def _label_fits(
    content: Content,
    members: Memberships,
    mesh: Mesh,
    of_cell: NDArray[np.int64],
    owner: NDArray[np.int64],
) -> list[LabelFit]:
    """Compare each label with its cells, as `tetopt.measure.fidelity.label_fidelity` does."""
    planes, affine = _own_voxels(content)
    owner, rows = owner[planes], members.partition[planes]
    is_covered, outside = owner >= 0, BACKGROUND_LABEL
    if content.region is not None:
        is_covered, outside = content.region.inside[planes], OUTSIDE_LABEL
        rows = np.where(is_covered, rows, OUTSIDE_LABEL)
    painted = np.append(of_cell, outside)[owner]
    numbers, place = np.unique(of_cell, return_inverse=True)
    sizes = np.bincount(place, mesh.cell_volumes) / (content.image.voxel_volume * members.parts)
    n_in_cells, fits = dict(zip(numbers.tolist(), sizes.tolist(), strict=True)), []
    for row, box in enumerate(scipy.ndimage.find_objects(rows + 1)):
        if box is not None:
            label, own = int(members.labels[row]), rows[box] == row
            is_met, n_covered = painted[box] == label, int(np.count_nonzero(own & is_covered[box]))
            lost = voxel_components(own, is_met | ~is_covered[box], affine, box)[1]
            ratio = n_in_cells.get(label, 0.0) / max(n_covered, 1)
            fits.append(LabelFit(label, n_covered, ratio, bool((own & is_met).any()), lost))
    return fits


def _own_voxels(content: Content) -> tuple[tuple[slice, ...], NDArray[np.float64]]:
    """Select the voxels of a content that have the centres of its image's own voxels; also
    return their affine.
    """
    image, factors = content.image, (1,) * content.image.ndim
    if content.memberships is not None:
        factors = supersampling(content.given.spacing)
    affine = image.affine.copy()
    affine[:-1, -1] = image.to_world([factor // 2 for factor in factors])
    affine[:-1, :-1] *= factors
    return tuple(slice(factor // 2, None, factor) for factor in factors), affine


def _volume(mesh: Mesh) -> float:
    return float(mesh.cell_volumes.sum())
