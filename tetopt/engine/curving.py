"""Mid-edge nodes of quadratic cells on smooth levels: on interfaces between labels, and on a mask's
surface.

The midpoint of an edge moves nearly the shortest way onto the levels on which its ends lie, like
nodes in `tetopt.engine.sliding`. No cell around it may come near to folding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.contents.domain import ON_SURFACE_VOXELS, levels
from tetopt.engine.sliding import (
    ASIDE_VOXELS,
    CURVE_STEPS,
    MOST_MEETING,
    NEAR_CURVE_VOXELS,
    PARALLEL_FRACTION,
)
from tetopt.geometry.box import box_sides, facets_on_sides, is_on_sides
from tetopt.geometry.quadratic import cell_edges, jacobian_bounds, numbered_edges
from tetopt.geometry.simplex import facet_nodes
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.arrays import Bools, Floats, Ints

LEAST_JACOBIAN = 0.2  # least ratio of a curved cell's Jacobian determinant to the straight cell's
# of an edge's length: a level farther from its middle belongs to another part of the surface
MOST_BENT = 0.25
# largest difference of levels at an edge's ends, twice an interface's distance, that cells follow
ENDS_VOXELS = 0.5
# least fraction of the way to the level; an edge that may not go so far stays straight
LEAST_PART = 0.25


class Curving(NamedTuple):
    """Numbers of curved and straight edges on interfaces between labels and on a mask's surface.

    Parameters
    ----------
    n_edges : int
        Edges on interfaces or the mask's surface.
    n_on_level : int
        Edges whose mid-edge node lies on the smooth level.
    n_part_way : int
        Edges whose mid-edge node goes half or a quarter of the way, as a cell would otherwise come
        near to folding.
    n_straight : int
        Other edges.
    farthest : float
        Largest distance of a mid-edge node from the straight edge's middle, mm.
    least_jacobian : float
        Lower bound of the Jacobian determinant anywhere in a cell, relative to the straight cell.

    Examples
    --------
    >>> labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    >>> result = tetopt.mesh_image(tetopt.content(labels, labels), 600, order=2)
    >>> result.curving.n_on_level > 50, result.curving.least_jacobian >= 0.2
    (True, True)
    """

    n_edges: int
    n_on_level: int
    n_part_way: int
    n_straight: int
    farthest: float
    least_jacobian: float


class _Surfaces(NamedTuple):
    """Levels onto which the midpoints of edges move."""

    fields: list[NDArray[np.float32]]  # levels
    # (K, Q, 2) pairs of levels to be equal; a second -1 stands for 0; -1, -1 for no pair
    pairs: Ints
    edges: Ints  # (K,) whose


def curve_mesh(mesh: Mesh, content: Content, labels: Ints | None) -> tuple[Mesh, Curving | None]:
    """Add midpoints to the mesh; those of edges on interfaces and on the mask's surface lie on the
    smooth levels.

    An edge stays straight if its ends are more than half a voxel off the mask's surface, or a
    quarter off an interface; if the level is not found within a quarter of the edge's length; or if
    a cell's Jacobian determinant could fall below a fifth of the straight cell's: all edges of such
    a cell go half the way, a quarter, or none of it.

    Parameters
    ----------
    mesh : Mesh
        The result of a run.
    content : Content
        The content of the mesh.
    labels : (M,) int64, optional
        Label of each cell.

    Returns
    -------
    Mesh, Curving or None
        The curved mesh and its numbers; the mesh itself and None for a content without mask and
        smooth labels.
    """
    has_labels = content.memberships is not None and labels is not None
    if not has_labels and content.region is None:
        return mesh, None
    edges, number = numbered_edges(mesh.cells)
    index = content.image.to_index(mesh.points)
    surfaces = _surfaces(mesh.cells, number, index, content, labels if has_labels else None)
    ends = edges[surfaces.edges]
    is_on = np.any(np.all(is_on_sides(index, box_sides(content.image.shape))[ends], axis=1), axis=2)
    middle = index[ends].mean(axis=1)
    at, is_found = _bring_places(
        surfaces, middle, _ways(content.image)[is_on @ (1 << np.arange(mesh.ndim))]
    )
    for end in ends.T:
        is_found &= (np.abs(_values(surfaces, index[end])) < ENDS_VOXELS).all(axis=1)
    off = (at - middle) @ content.image.affine[:-1, :-1].T
    length = np.linalg.norm(mesh.points[ends[:, 1]] - mesh.points[ends[:, 0]], axis=1)
    is_found &= np.linalg.norm(off, axis=1) <= MOST_BENT * length
    ways = np.zeros((len(edges), mesh.ndim))
    ways[surfaces.edges[is_found]] = off[is_found]
    part = np.zeros(len(edges))
    part[surfaces.edges[is_found]] = 1.0
    midpoints, least = _unfold_midpoints(mesh, edges, number, ways, part)
    n_curved, n_on_level = int((part > 0.0).sum()), int((part == 1.0).sum())
    farthest = float(np.linalg.norm(part[:, None] * ways, axis=1).max(initial=0.0))
    curving = Curving(
        len(ends), n_on_level, n_curved - n_on_level, len(ends) - n_curved, farthest, least
    )
    return (Mesh(mesh.points, mesh.cells, midpoints) if part.any() else mesh), curving


def _surfaces(
    cells: Ints,
    number: Ints,
    index: Floats,
    content: Content,
    labels: Ints | None,
) -> _Surfaces:
    """Levels on which the edges of cells, numbered (M, 3 or 6), lie, for labels (M,) and nodes
    at `index`.
    """
    fields: list[NDArray[np.float32]] = []
    n_edges = int(number.max()) + 1
    pairs = np.full((n_edges, MOST_MEETING, 2), -1)
    if labels is not None and (members := content.memberships) is not None:
        fields += list(members.levels)
        rank = np.searchsorted(members.labels, labels)
        # ascending: by edge, then by label
        met = np.unique(number * len(members.labels) + rank[:, None])
        edge, label = np.divmod(met, len(members.labels))
        first = np.searchsorted(edge, edge)
        place = np.arange(len(edge)) - first
        of_pair = np.column_stack([members.channel[label[first]], members.channel[label]])
        is_pair = (place > 0) & (place < MOST_MEETING) & (of_pair[:, 0] != of_pair[:, 1])
        pairs[edge[is_pair], place[is_pair] - 1] = of_pair[is_pair]
    if content.region is not None:
        of_cell = facets(cells)
        rows = np.argwhere(of_cell.n_cells[of_cell.of_cell] == 1)
        n = cells.shape[1] - 1
        corners = cells[rows[:, :1], np.array(facet_nodes(n))[rows[:, 1]]]
        is_side = facets_on_sides(index, corners, box_sides(content.image.shape)).any(axis=(1, 2))
        cell, opposite = rows[~is_side].T
        is_of_facet = (cell_edges(n) != opposite[:, None, None]).all(axis=2)
        pairs[number[cell][is_of_facet], -1] = len(fields), -1
        fields.append(content.region.level)
    chosen = np.flatnonzero((pairs[..., 0] >= 0).any(axis=1))
    return _Surfaces(fields, pairs[chosen], chosen)


def _ways(image: Image) -> Floats:
    """Maps (2^n, n, n) from the slope of a level, by index, to the shortest way up, for each set
    of fixed axes.
    """
    n = image.ndim
    ways = np.zeros((2**n, n, n))
    for number in range(2**n - 1):
        free = [axis for axis in range(n) if not number >> axis & 1]
        columns = image.affine[:n, free]
        ways[number][np.ix_(free, free)] = np.linalg.inv(columns.T @ columns)
    return ways


def _values(surfaces: _Surfaces, at: Floats) -> Floats:
    """Difference of the levels of each pair at places (K, n), (K, Q), voxels; 0 for no pair."""
    values = np.zeros(surfaces.pairs.shape[:2])
    for number, field in enumerate(surfaces.fields):
        for side, sign in enumerate((1.0, -1.0)):
            row, column = np.nonzero(surfaces.pairs[..., side] == number)
            values[row, column] += sign * levels(field, at[row])
    return values


def _bring_places(surfaces: _Surfaces, start: Floats, ways: Floats) -> tuple[Floats, Bools]:
    """Places (K, n) moved from `start` to where their pairs of levels are equal, and a mask of
    those that arrive.
    """
    at = start.copy()
    tolerance = np.where(
        (surfaces.pairs[..., 0] >= 0).sum(axis=1) == 1, ON_SURFACE_VOXELS, NEAR_CURVE_VOXELS
    )
    left = np.arange(len(at))
    for _ in range(CURVE_STEPS):
        here = surfaces._replace(pairs=surfaces.pairs[left])
        value = _values(here, at[left])
        is_off = (np.abs(value) >= tolerance[left, None]).any(axis=1)
        left, value, here = left[is_off], value[is_off], here._replace(pairs=here.pairs[is_off])
        if not len(left):
            break
        aside = ASIDE_VOXELS * np.eye(at.shape[1])
        slope = np.stack(
            [
                (_values(here, at[left] + step) - _values(here, at[left] - step))
                / (2.0 * ASIDE_VOXELS)
                for step in aside
            ],
            axis=2,
        )
        up = np.einsum("kij,kqj->kqi", ways[left], slope)
        steep = np.linalg.pinv(
            np.einsum("kpi,kqi->kpq", slope, up), rcond=PARALLEL_FRACTION, hermitian=True
        )
        at[left] -= np.einsum("kp,kpq,kqi->ki", value, steep, up)
    return at, np.all(np.abs(_values(surfaces, at)) < tolerance[:, None], axis=1)


def _unfold_midpoints(
    mesh: Mesh,
    edges: Ints,
    number: Ints,
    ways: Floats,
    part: Floats,
) -> tuple[Floats, float]:
    """Midpoints (E, n) moved a fraction of each way, and the least bound of a cell's Jacobian
    determinant.

    Where that bound is too small, fractions are reduced, in place.
    """
    straight = mesh.points[edges].mean(axis=1)
    bounds, left = np.ones(len(mesh.cells)), np.flatnonzero((part[number] > 0.0).any(axis=1))
    while len(left):
        midpoints = straight + part[:, None] * ways
        nodes = np.concatenate([mesh.points, midpoints])
        bounds[left] = jacobian_bounds(
            nodes, np.column_stack([mesh.cells[left], len(mesh.points) + number[left]])
        )
        is_changed = np.zeros(len(edges), dtype=bool)
        is_changed[number[bounds < LEAST_JACOBIAN]] = True
        is_changed &= part > 0.0
        part[is_changed] *= np.where(part[is_changed] > LEAST_PART, 0.5, 0.0)
        left = np.flatnonzero(is_changed[number].any(axis=1))
    return straight + part[:, None] * ways, float(bounds.min())
