"""The requirements of a mesh: what is measured for each, and the sentence on one that it violates.

`measure` takes a mesh's numbers, by the requirement that they are for, and `judge` compares them
with what is required. A run that ends in time returns a mesh even if it violates some: its result
lists them, and the command exits with status 1. Whoever asks about a mesh, of this run or of any
program, asks here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from math import prod
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.contents.labels import (
    BACKGROUND_LABEL,
    COMPONENT_VOXELS,
    LostComponent,
    voxel_components,
)
from tetopt.contents.memberships import supersampling
from tetopt.energy.discretization import content_E_D, unexplained_variance
from tetopt.energy.sampling import cell_of_voxel
from tetopt.errors import InputError, warn
from tetopt.geometry.check import BOX_ROUNDING_VOXELS, beyond_box, manifold_problems
from tetopt.geometry.manifold import OUTSIDE_LABEL
from tetopt.geometry.simplex import dihedral_angles, edge_pairs, squared_edges
from tetopt.geometry.topology import components
from tetopt.image import Image, transform_vectors
from tetopt.measure.fidelity import (
    LEAST_CELLS,
    LabelFidelity,
    OwnedVoxels,
    label_extents,
    voxel_cells,
)
from tetopt.mesh import Mesh
from tetopt.start.clip import hole_numbers, misfit_of_holes
from tetopt.system.arrays import Bools, Floats, Ints

# least Dice of a mesh with its mask, below which cells are too large for the mask's detail
MASK_DICE = 0.9
# below it, the mesh is of another mask: one that loses nearly all of a wall has .2 or more; chosen
OTHER_DICE = 0.1
# a label with as many voxels must have cells that contain some, of about their volume
LABEL_VOXELS = 200
LARGE_COMPONENTS = f"of {COMPONENT_VOXELS} voxels or more"
LEAST_VOLUME, MOST_VOLUME = 0.6, 1.5  # of a label's cells, over its voxels'
MORE_NODES = "allow more nodes"
LABEL_REMEDY = f"{MORE_NODES}, more `cells_across`, or a higher `label_weight`"
# A higher weight hardly gives small components cells, at the expense of volumes: in the MNI152 T1
# with tissues and 5,000 nodes, weight 4 leaves 23 of 28 without a cell, and fluid with -23 instead
# of -20 % of its volume; 20,000 nodes leave 2, and -10 %.
PIECES_REMEDY = (
    f"{MORE_NODES}, so that cells are smaller than these, or merge (`merge`) or "
    "clean labels of crumbs"
)
FOREGROUND = "foreground"  # the region of a removed background
COMPONENTS_LISTED = 5  # of those without a cell
# degrees by which a measured angle may be below the minimum that kernels enforce in ticks
ANGLE_ROUNDING = 1e-6
VOLUME_ROUNDING = 1e-9  # relative: rounding of the total volume of cells that fill the box exactly
BOUNDARY_ROUNDING = 1e-6  # relative: the same within a boundary with the user's digits
# E_D falls with nodes^-0.57 on the MNI152 T1 from 1,500 to 5,400 nodes, ^-0.7 up to 40,000
ERROR_RATE = 0.6
ERROR_REACHED = 0.85  # of the target error: a run from here up to the target ends the search
ERROR_AIM = 0.5 * (1.0 + ERROR_REACHED)


class Requirements(NamedTuple):
    """What a mesh must meet, and words for what is judged."""

    min_dihedral: float = 0.0  # degrees; 0 for none
    target_error: float | None = None  # the allowed unexplained fraction of the variance
    cut_short: str = ""  # the reason for the end of a run that was cut short
    is_initial: bool = False  # the run made no iteration
    region: str = "mask"  # the name of the meshed region
    label_words: Callable[[int], str] = str
    remedy: str = MORE_NODES  # if the region has more detail than cells


class Cover(NamedTuple):
    """The voxels and the volume of a mesh, against those of what it should cover."""

    what: str
    gained: int  # voxels
    volume: float  # mm^n
    before: float  # mm^n, of what it should cover
    ndim: int
    rounding: float  # relative, of the volume


class MaskComponents(NamedTuple):
    """Connected components of a mask and of the mesh within it."""

    mask: int
    n_cells: tuple[int, ...]  # of each component of the mesh, the largest first
    lost: tuple[LostComponent, ...]  # of the mask, without a cell
    bare: tuple[LostComponent, ...]  # of voxels far from any cell


def measure(
    mesh: Mesh,
    content: Content,
    labels: Ints | None = None,
    *,
    is_filled: bool = False,
    initial: Mesh | None = None,
    n_initial: int = 0,
    counted: tuple[float, int] | None = None,
    known: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """Measure what the requirements of a mesh are about, by their names.

    Parameters
    ----------
    mesh : Mesh
    content : Content
        What the mesh represents.
    labels : (M,) int64, optional
        Label of each cell.
    is_filled : bool
        True if the mesh should fill the image's box.
    initial : Mesh, optional
        The mesh that a run began with; without a mask, and if `is_filled` is False, its domain
        should still be covered.
    n_initial : int
        Number of voxels in its cells.
    counted : (float, int), optional
        E_D and the number of voxels in the cells, if known.
    known : mapping
        Measures that are taken already, such as the Dice of the whole mesh with the mask; here it
        is that by the content's voxels, which a run's mesh does not leave.

    Returns
    -------
    dict
        What is to be judged, without requirements that do not apply; the error in place of a
        measure that failed, as for lack of memory: the mesh is kept.

    Raises
    ------
    InputError
        As for `tetopt.energy.sampling.cell_moments`.
    """
    E_D, n_voxels = content_E_D(content, mesh) if counted is None else counted
    region, members = content.region, content.memberships
    owner = partial(voxel_cells, content.image, mesh)
    is_straight = mesh.straight_pieces()[0] is mesh
    straight = owner if is_straight else lambda: cell_of_voxel(content.image, mesh)
    measures: dict[str, Callable[[], Any]] = {}
    if mesh.ndim == 3:
        measures["min_dihedral"] = lambda: dihedral_angles(mesh.points, mesh.cells).min(axis=1)
    if is_filled or region is not None or initial is not None:
        measures["box"] = lambda: (
            float(beyond_box(mesh, content.given).max()),
            0.0 if initial is None else float(beyond_box(initial, content.given).max()),
        )
    if region is not None:
        inside = region.inside
        measures |= {
            "overlap": lambda: n_voxels - int((straight() >= 0).sum()),
            "mask": lambda: _dice(owner() >= 0, inside),
            "components": lambda: _mask_components(content, inside, mesh, owner()),
            "euler": lambda: hole_numbers(mesh, content.image, region),
        }
    elif is_filled or initial is not None:
        measures["cover"] = lambda: _cover(
            mesh, content.image, n_voxels, None if is_filled else initial, n_initial
        )
    measures["manifold"] = lambda: (
        [] if is_filled else manifold_problems(mesh),
        [] if labels is None or members is None else manifold_problems(mesh, labels),
        region is None,
    )
    if labels is not None and members is not None:
        measures["labels"] = lambda: _label_extents(content, mesh, labels, owner())
    measures["error"] = lambda: unexplained_by(content, mesh, E_D, n_voxels)
    taken = {name: _take_measure(each) for name, each in measures.items() if name not in known}
    return {**taken, **known}


def _take_measure(measure: Callable[[], Any]) -> Any:
    """Return a measure, or the error for which it cannot be taken."""
    try:
        return measure()
    except InputError:
        raise
    except Exception as error:
        return error


def judge(rows: dict[str, Any], required: Requirements) -> dict[str, str]:
    """Return, by name, a sentence on each requirement that measured `rows` violate.

    `min_dihedral`: tetrahedra with a smaller dihedral angle. `box`: nodes beyond the
    image's box. `cover`: voxels or volume lost or gained. Within a mask, instead of the last,
    `overlap`: voxels that lie in two cells; `mask`: a Dice with the mask below 0.9; below 0.1 the
    mesh is of another mask, and the next two, and `labels`, are not judged; `components`:
    more connected components than the mask, or components of the mask, or parts far from any cell,
    of 50 voxels or more without a cell; and `euler`: holes minus cavities other than those of the
    mask with and without details smaller than cells. `manifold`: edges or nodes at which the
    boundary, within a mask or of the user's own mesh, or the interface of two labels is not a
    manifold. `labels`: labels of 200 voxels or more without a cell at one of them, or with
    0.6 to 1.5 times their volume exceeded, or components of 50 voxels or more without a cell; not
    of components smaller than two mean cells around them, nor of label 0 in a foreground,
    or where most of it lies outside the mesh.
    `error`: more unexplained variance than allowed. One that cannot be checked counts as violated,
    with the reason.
    """
    violated = {}
    dice = rows.get("mask")
    is_other = isinstance(dice, float) and dice < OTHER_DICE
    for name, say in SENTENCES.items():
        if name not in rows or (is_other and name in OF_MASK):
            continue
        words = (
            f"{name} could not be checked: {type(rows[name]).__name__} {rows[name]}".rstrip()
            if isinstance(rows[name], Exception)
            else say(rows[name], required)
        )
        if words:
            violated[name] = words
    return violated


def _say_min_dihedral(angles: Floats, required: Requirements) -> str:
    below = int((angles < required.min_dihedral - ANGLE_ROUNDING).sum())
    first = (
        "more `iterations`, as none was made"
        if required.is_initial
        else "more nodes, a lower `k_D`"
    )
    words = (
        f"{below} of {len(angles)} cells have a dihedral angle below {required.min_dihedral:g} "
        f"degrees, down to {angles.min():.2f}; allow {first}, or a lower `min_dihedral`"
    )
    return words if below else ""


def _say_box(beyond: tuple[float, float], _: Requirements) -> str:
    if beyond[0] <= BOX_ROUNDING_VOXELS:
        return ""
    remedy = (
        "so do those of the initial mesh: mesh an image that holds it, or leave out its cells there"
        if beyond[1] > BOX_ROUNDING_VOXELS
        else "please report this"
    )
    return f"nodes lie up to {beyond[0]:.3g} voxels beyond the image's box; {remedy}"


def _say_cover(cover: Cover, _: Requirements) -> str:
    if cover.gained == 0 and abs(cover.volume / cover.before - 1.0) <= cover.rounding:
        return ""
    return (
        f"the mesh does not cover {cover.what}: {cover.gained:+d} voxels, and its volume is "
        f"{cover.volume:.9g} of {cover.before:.9g} mm^{cover.ndim}; please report this"
    )


def _say_overlap(twice: int, _: Requirements) -> str:
    words = f"cells overlap: {twice} voxels lie in two cells; {MORE_NODES}, and please report this"
    return words if twice else ""


def _say_mask(dice: float, required: Requirements) -> str:
    word, rest = required.region, f"; {required.remedy}"
    words = f"the mesh and the {word} overlap with a Dice of only {dice:.3f}: "
    if dice < OTHER_DICE:
        rest = f", or of a part of it; use the {word} that it was built within"
        words += f"the mesh is of another {word}"
    else:
        words += f"cells are too large for the {word}'s detail"
    return words + rest if dice < MASK_DICE else ""


def _say_components(parts: MaskComponents, required: Requirements) -> str:
    word, texts = required.region, []
    if len(parts.n_cells) > max(parts.mask, 1):
        smallest = ", ".join(map(str, parts.n_cells[:-4:-1]))
        texts.append(
            f"the mesh has {len(parts.n_cells)} connected components, the {word} {parts.mask}; the "
            f"smallest have {smallest} cells"
        )
    if large := [(each, "") for each in parts.lost if _is_large(each)]:
        texts.append(
            f"components of the {word} {LARGE_COMPONENTS} without a cell: {_list_components(large)}"
        )
    elif far := [(each, "") for each in parts.bare if _is_large(each)]:
        texts.append(
            f"parts of the {word} {LARGE_COMPONENTS} with no cell near: {_list_components(far)}"
        )
    return "; ".join([*texts, required.remedy]) if texts else ""


def _say_euler(numbers: tuple[int, ...], required: Requirements) -> str:
    ours, *others = numbers
    span = f"{min(others)} to {max(others)} with and without details smaller than cells"
    words = (
        f"the mesh has {ours} holes minus cavities, the {required.region} "
        f"{span if len({*others}) > 1 else others[0]}: holes are torn or lost, or cavities; "
        f"{required.remedy}"
    )
    return words if misfit_of_holes(numbers) else ""


def _say_manifold(problems: tuple[list[str], list[str], bool], required: Requirements) -> str:
    of_boundary, of_labels, is_own = problems
    remedy = "mend the initial mesh" if of_boundary and is_own else required.remedy
    texts = [*of_boundary, *of_labels]
    return "; ".join([*texts, remedy]) if texts else ""


def faulty_labels(rows: Iterable[LabelFidelity], required: Requirements) -> Iterator[int]:
    """Yield the labels that violate the requirement."""
    for row in rows:
        if not is_pocket(row, required) and (_is_absent(row) or _is_off(row) or _pieces(row)):
            yield row.label


def is_pocket(row: LabelFidelity, required: Requirements) -> bool:
    """Return whether a row is that of label 0 in a foreground, which is no tissue: the voxels that
    are no background.
    """
    return row.label == BACKGROUND_LABEL and required.region == FOREGROUND


def _is_judged(row: LabelFidelity) -> bool:
    """Return whether a label has voxels for a verdict, and a component that cells can show.

    Label 0 is that of the space outside the mesh, too: where most of it lies, it needs no cell.
    """
    is_space = row.label == BACKGROUND_LABEL and row.extent.is_beyond
    is_shown = row.extent.size_in_cells >= LEAST_CELLS
    return row.extent.covered_voxels >= LABEL_VOXELS and is_shown and not is_space


def _is_absent(row: LabelFidelity) -> bool:
    """Return whether a large label has no cell, or cells elsewhere."""
    return _is_judged(row) and row.overlap.dice == 0.0


def _is_off(row: LabelFidelity) -> bool:
    """Return whether a large label has cells of too much or too little volume."""
    is_right = LEAST_VOLUME <= row.extent.ratio <= MOST_VOLUME
    return _is_judged(row) and not (is_right or _is_absent(row))


def _pieces(row: LabelFidelity) -> list[LostComponent]:
    """Return the large lost components of a tissue that has cells elsewhere; those of the space
    between tissues do not count.
    """
    is_exempt = _is_absent(row) or row.label == BACKGROUND_LABEL
    return [] if is_exempt else [each for each in row.pieces.lost_components if _is_large(each)]


def is_shown(component: LostComponent) -> bool:
    """Return whether cells can show a component: it is as large as `LEAST_CELLS` of them."""
    return component.size_in_cells is None or component.size_in_cells >= LEAST_CELLS


def _is_large(component: LostComponent) -> bool:
    return component.voxels >= COMPONENT_VOXELS and is_shown(component)


def _likeness(row: LabelFidelity) -> float:
    """Return the smaller of the volumes of cells and voxels, relative to the larger."""
    return min(row.extent.ratio, 1.0 / max(row.extent.ratio, 1.0))


def _say_labels(rows: Sequence[LabelFidelity], required: Requirements) -> str:
    words, texts = required.label_words, list[str]()
    rows = [row for row in rows if not is_pocket(row, required)]
    if lost := [words(row.label) for row in rows if _is_absent(row)]:
        texts.append(
            f"no voxel of label {', '.join(lost)}, of {LABEL_VOXELS} voxels or more, lies in a "
            "cell with that label"
        )
    off = sorted(filter(_is_off, rows), key=_likeness)
    if off:
        ratios = ", ".join(f"{row.extent.ratio:.3g} for label {words(row.label)}" for row in off)
        texts.append(
            f"the volume of cells is not {LEAST_VOLUME:g} to {MOST_VOLUME:g} times that of "
            f"voxels: {ratios}"
        )
    if pieces := [(each, f" of label {words(row.label)}") for row in rows for each in _pieces(row)]:
        texts.append(
            f"components of labels {LARGE_COMPONENTS} without a cell, as large as "
            f"{LEAST_CELLS:g} cells around or more: {_list_components(pieces)}"
        )
    if texts:
        texts.append(PIECES_REMEDY if pieces else LABEL_REMEDY)
    return "; ".join(texts)


def _say_error(fraction: float, required: Requirements) -> str:
    target = required.target_error
    if target is None or fraction <= target:
        return ""
    ratio = float(f"{nodes_ratio(fraction, target):.2g}")
    rest = (
        f"as the run was cut short ({required.cut_short}); allow more time or memory"
        if required.cut_short
        else f"which requires about {ratio:g} times the nodes; allow more (`nodes_max`), smaller "
        "cells or more iterations"
    )
    return (
        f"{fraction:.4g} of the image's variance is unexplained, more than {target:g}, {rest}, or "
        "raise `target_error`"
    )


# The words on each requirement; empty if it is met.
SENTENCES: dict[str, Callable[[Any, Requirements], str]] = {
    "min_dihedral": _say_min_dihedral,
    "box": _say_box,
    "cover": _say_cover,
    "overlap": _say_overlap,
    "mask": _say_mask,
    "components": _say_components,
    "euler": _say_euler,
    "manifold": _say_manifold,
    "labels": _say_labels,
    "error": _say_error,
}


OF_MASK = {"components", "euler", "labels"}  # requirements that have no meaning in another mask


def nodes_ratio(fraction: float, target_error: float, rate: float = ERROR_RATE) -> float:
    """Return how many times the nodes that leave a fraction of the variance unexplained a target
    error takes.
    """
    return float((fraction / (ERROR_AIM * target_error)) ** (1.0 / rate))


def unexplained_by(content: Content, mesh: Mesh, E_D: float, n_voxels: int) -> float:
    """Return the unexplained variance of a mesh with this E_D and number of voxels in its cells,
    `tetopt.energy.discretization.unexplained_variance`; or 0.
    """
    # also if the voxels stay in their file
    if content.region is None and n_voxels == content.n_voxels:
        return E_D / (content.variance * content.volume or 1.0)
    return unexplained_variance(content, mesh) or 0.0


def _cover(mesh: Mesh, image: Image, n_voxels: int, initial: Mesh | None, n_initial: int) -> Cover:
    volume, n = float(mesh.cell_volumes.sum()), image.ndim
    if initial is None:
        gained = n_voxels - prod(image.shape)
        return Cover("the image", gained, volume, image.volume, n, VOLUME_ROUNDING)
    before = float(initial.cell_volumes.sum())
    gained = n_voxels - n_initial
    return Cover("its initial domain", gained, volume, before, n, BOUNDARY_ROUNDING)


def _dice(one: Bools, other: Bools) -> float:
    return 2.0 * int((one & other).sum()) / max(int(one.sum() + other.sum()), 1)


def _mask_components(
    content: Content, inside: Bools, mesh: Mesh, owner: NDArray[np.integer]
) -> MaskComponents:
    n_cells = np.sort(np.bincount(components(mesh.cells)))[::-1]
    planes, affine = _own_voxels(content)
    inside, is_met = inside[planes], owner[planes] >= 0
    n_mask, lost = voxel_components(inside, is_met, affine)
    bare = _bare_parts(mesh, inside & ~is_met, affine)
    return MaskComponents(n_mask, tuple(n_cells.tolist()), lost, bare)


def _bare_parts(mesh: Mesh, is_bare: Bools, affine: Floats) -> tuple[LostComponent, ...]:
    """Components of a mask's voxels without a cell that lie farther from the nearest node than
    its longest edge.
    """
    ends, longest = mesh.cells[:, edge_pairs(mesh.ndim)], np.zeros(len(mesh.points))
    np.maximum.at(longest, ends, np.sqrt(squared_edges(mesh.points, mesh.cells))[:, :, None])
    index = np.argwhere(is_bare)
    places = transform_vectors(index.astype(np.float64), affine[:-1, :-1]) + affine[:-1, -1]
    distance, node = scipy.spatial.cKDTree(mesh.points).query(places)
    is_far = np.zeros_like(is_bare)
    is_far[tuple(index[distance > longest[node]].T)] = True
    return voxel_components(is_far, np.zeros_like(is_far), affine)[1]


def _list_components(pieces: list[tuple[LostComponent, str]]) -> str:
    """List the largest components, each with words on it."""
    ranked = sorted(pieces, key=lambda piece: -piece[0].voxels)
    rows = [
        f"{each.voxels} voxels{words} at ({', '.join(f'{x:.4g}' for x in each.place)}) mm"
        for each, words in ranked[:COMPONENTS_LISTED]
    ]
    return ", ".join(rows) + (
        f" and {len(ranked) - len(rows)} more" if len(ranked) > len(rows) else ""
    )


def _label_extents(
    content: Content, mesh: Mesh, of_cell: Ints, owner: NDArray[np.integer]
) -> list[LabelFidelity]:
    """Measure each label on its own voxels, as `tetopt.measure.fidelity.label_fidelity` does."""
    planes, affine = _own_voxels(content)
    members = content.memberships
    assert members is not None
    labels, rows, owner = members.labels, members.partition[planes], owner[planes]
    is_covered, outside = owner >= 0, 0 if labels[0] == BACKGROUND_LABEL else OUTSIDE_LABEL
    if content.region is not None:
        is_covered, outside = content.region.inside[planes], OUTSIDE_LABEL
        rows = np.where(is_covered, rows, OUTSIDE_LABEL)
    at = np.searchsorted(labels, of_cell)
    is_known = labels[np.minimum(at, len(labels) - 1)] == of_cell
    voxels = OwnedVoxels(labels, rows, owner, is_covered, outside, affine)
    return label_extents(voxels, mesh, np.where(is_known, at, len(labels)))


def _own_voxels(content: Content) -> tuple[tuple[slice, ...], Floats]:
    """Select the voxels of a content that have the centres of its image's own voxels; also
    return their affine.
    """
    image, factors = content.image, (1,) * content.image.ndim
    if content.memberships is not None:
        factors = supersampling(content.given.spacing)
    affine = image.affine.copy()
    affine[:-1, -1] = image.to_world([factor // 2 for factor in factors])
    affine[:-1, :-1] = content.given.affine[:-1, :-1]
    return tuple(slice(factor // 2, None, factor) for factor in factors), affine


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
            "values of the mask's nearest voxels; was the mesh built within another mask, or "
            "within none?"
        )
