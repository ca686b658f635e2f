"""A mesh's file, moved by a registration's transform, and how well it fits its new image."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from tetopt.contents.content import Content
from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.errors import InputError, prefix_errors
from tetopt.geometry.check import scaled_jacobians
from tetopt.geometry.quadratic import numbered_edges
from tetopt.geometry.untangle import untangle
from tetopt.io.text import count_text, list_names
from tetopt.io.transforms import Step, load_transform
from tetopt.job.aligned import read_image
from tetopt.job.events import note, progress, warning
from tetopt.job.options import WHOLE_BOX, MoveOptions
from tetopt.mesh import Mesh
from tetopt.model.fields import GAUSS_MODULI, cell_fields
from tetopt.model.file import (
    MASK_TEXT,
    MOVED,
    MOVED_FROM_MASK,
    PLACE_TEXT,
    TEXTS_KEPT,
    MeshFile,
    material_fields,
    without_results,
)
from tetopt.system.arrays import Arrays, Floats

IMAGE_FIELD = r"(mean|variance)(_\d+)?|n_voxels|min|max"  # of cells, by the old image
WORSE_FALL = 1e-3  # of Dice or correlation: a loss above rounding


def move_file(loaded: MeshFile, move: MoveOptions, image: Path | None) -> MeshFile:
    """Return a mesh's file with its nodes moved by the options' transforms; report the move.

    Cells, labels, sets, moduli and other scalars stay. Fields of the old image, results, vectors
    and tensors do not, nor do materials with fibres and the texts on the old image. Inverted cells
    are untangled, and folded quadratic cells get straight edges.

    Parameters
    ----------
    loaded : MeshFile
    move : MoveOptions
    image : Path, optional
        The moving image, for FSL's matrix.

    Raises
    ------
    InputError
        As for `load_transform` and `untangle`; an option without `transform`; a 2-D mesh.
    """
    if not move.transform:
        for name in ("inverse", "fixed"):
            if getattr(move, name) not in (None, False):
                raise InputError(f"`{name}`: needs `transform`")
        return loaded
    mesh = loaded.mesh
    if mesh.ndim != 3:
        raise InputError("`transform`: expected a mesh of tetrahedra, got triangles")
    fixed, moving = (
        read_image(path, WHOLE_BOX) if path and move.fixed and image else None
        for path in (move.fixed, image)
    )
    transform = load_transform(*move.transform, inverse=move.inverse, fixed=fixed, moving=moving)
    there = transform(mesh.points)
    with prefix_errors(list_names([str(path) for path in move.transform])):
        points, n_inverted = untangle(mesh.points, there, mesh.cells)
    moved = Mesh(points, mesh.cells, _moved_midpoints(mesh, transform, points, there))
    way = np.linalg.norm(points - mesh.points, axis=1)
    note(f"nodes moved by {way.mean():.3g} mm, up to {way.max():.3g} mm")
    if n_inverted:
        off = np.linalg.norm(points - there, axis=1)
        warning(
            f"the transform inverts {count_text(n_inverted, 'cell')}, which are untangled; "
            f"{np.count_nonzero(off)} nodes are off their places for it, up to {off.max():.3g} mm"
        )
    return _without_old(loaded._replace(mesh=moved))


def _moved_midpoints(mesh: Mesh, transform: Step, points: Floats, there: Floats) -> Floats | None:
    """Return the places of mid-edge nodes, those of folded cells in the middle of their edges."""
    if mesh.midpoints is None:
        return None
    ends, number = numbered_edges(mesh.cells)
    midpoints = transform(mesh.midpoints) + (points - there)[ends].mean(axis=1)
    while (is_folded := scaled_jacobians(Mesh(points, mesh.cells, midpoints)) <= 0.0).any():
        edges = np.unique(number[is_folded])
        midpoints[edges] = points[ends[edges]].mean(axis=1)
    return midpoints


def _without_old(loaded: MeshFile) -> MeshFile:
    """Return a moved mesh's file without what is of its old place or image; note it."""
    rest = without_results(loaded)
    # materials with fibres are of no use without them
    stale = material_fields(rest.cell_data) if "young_along" in rest.cell_data else set()
    cells, nodes = (
        {
            name: rows
            for name, rows in data.items()
            if (rows.ndim == 1 or name == GAUSS_MODULI)
            and not re.fullmatch(IMAGE_FIELD, name)
            and name not in stale
        }
        for data in (rest.cell_data, rest.point_data)
    )
    names = [*loaded.cell_data, *loaded.point_data]
    if lost := [name for name in dict.fromkeys(names) if name not in cells and name not in nodes]:
        note(f"left out, as of the old image or its axes: {list_names(lost)}")
    shapes: Arrays = cell_fields(loaded.mesh)
    cells |= {name: rows for name, rows in shapes.items() if name in cells}
    had_mask = {MASK_TEXT} & set(loaded.field_data) or loaded.text(PLACE_TEXT) == MOVED_FROM_MASK
    texts = {name: each for name, each in rest.field_data.items() if name not in TEXTS_KEPT}
    texts[PLACE_TEXT] = np.array([MOVED_FROM_MASK if had_mask else MOVED])
    return rest._replace(cell_data=cells, point_data=nodes, field_data=texts, box=None)


def tell_fit(before: MeshFile, mesh: Mesh, content: Content, name: object) -> None:
    """Report how well a mesh fits its new image before and after its move: Dice of the mask, else
    the correlation of the cells' means with those of the old image. Worse is a warning.
    """
    mean = before.cell_data.get("mean")
    if content.own_mask is None and mean is None:
        note(f"{name}: the move is not checked: pass `mask`, or a mesh with means of its image")
        return
    what = "correlation of the cells' means" if content.own_mask is None else "Dice of the mask"
    old, new = (_fit(each, mean, content) for each in (before.mesh, mesh))
    words = f"{name}: {what} {old:.3f} before the move, {new:.3f} after it"
    if new < old - WORSE_FALL:
        warning(
            f"{words}: worse. Nodes of the fixed image's mesh move by the map that resamples "
            "images from the moving to the fixed one; for the other way, pass `inverse`, or leave "
            "it out"
        )
    else:
        progress(words)


def _fit(mesh: Mesh, mean: Floats | None, content: Content) -> float:
    """Return the Dice or the correlation, 0 for a mesh elsewhere."""
    with suppress(InputError):
        if (mask := content.own_mask) is not None:
            is_in, is_of = mask.data > 0, cell_of_voxel(mask, mesh) >= 0
            return float(2.0 * (is_in & is_of).sum() / max(is_in.sum() + is_of.sum(), 1))
        assert mean is not None
        moments = cell_moments(content.own, mesh)
        has_voxels = moments.n_voxels > 0
        return float(np.corrcoef(mean[has_voxels], moments.mean[has_voxels])[0, 1])
    return 0.0
