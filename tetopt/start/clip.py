"""Clip a mesh of an image's box at the surface of a mask's region.

Nodes near the surface move onto it; then edges that still cross it are split there, so that every
cell lies on one side (after the isosurface stuffing of Labelle and Shewchuk 2007, for any mesh).
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.domain import ON_SURFACE_VOXELS, Region, levels
from tetopt.contents.labels import component_runs, voxel_euler
from tetopt.errors import InputError
from tetopt.geometry.box import box_sides, is_on_sides
from tetopt.geometry.quadratic import edge_ends
from tetopt.geometry.simplex import area_normals, centroids, regular_edge, squared_edges, volumes
from tetopt.geometry.topology import boundary_facets, cell_euler, compact, components
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.start.lattice import lattice_mesh
from tetopt.system.arrays import Bools, Floats, Ints

SNAP_FRACTION = 0.3  # of an edge: a node this near to the surface along it moves onto the surface
# of an edge: a node this near to the surface counts as on it, even if it cannot move there
TOUCH_FRACTION = 0.15
LEAST_FULLNESS = 0.2  # least `_fullness` of a cell when nodes move onto the surface
LATTICE_TRIALS = 4  # lattices tried for a number of nodes within a region
SNAP_STEPS = 8  # Newton steps towards the surface
VOLUME_POINTS = 2**16  # for the volume of cells outside a region: a tenth is exact to 0.1 % of all
# of the volume that facets cut off outside: without gaps, cells lie outside by 1.3 to 2.2 of it
OVERHANG_RATIO = 2.5
# of the usual slope, along the normal of a facet that cuts off volume: across a wall there is none
LEAST_RISE = 0.3
# Dice of a region and of that without details: of organs .95 or more, of walls .63 or less
LEAST_LIKE = 0.9
BISECTION_ROUNDS = 20  # along an edge that crosses the surface: to 1e-6 of its length


def clip_cells(mesh: Mesh, image: Image, region: Region) -> Mesh:
    """The part of a mesh of the image's box within the region, with nodes on its surface and whole
    cells.

    Raises
    ------
    InputError
        No cell remains: the region is thinner than the cells.
    """
    index = image.to_index(mesh.points)
    level = levels(region.level, index)
    level[np.abs(level) < ON_SURFACE_VOXELS] = 0.0
    # The surface changes only cells that share a node with one that it crosses, which are few in a
    # large mesh.
    is_inside, is_outside = _sides(level, mesh.cells)
    is_touched = np.zeros(len(level), dtype=bool)
    is_touched[mesh.cells[is_inside & is_outside]] = True
    near = np.flatnonzero(is_touched[mesh.cells].any(axis=1))
    index, level = _snap_nodes(index, level, mesh.cells[near], image, region)
    index, level, cells = _cut(index, level, mesh.cells, near, region)
    is_inside, is_outside = _sides(level, cells)
    is_flat = ~(is_inside | is_outside)
    is_inside[is_flat] = levels(region.level, index[cells[is_flat]].mean(axis=1)) < 0.0
    if not is_inside.any():
        raise InputError(
            "mask: it is thinner than the cells, so no cell is left inside; increase the number "
            "of nodes"
        )
    used, kept = compact(cells[is_inside], len(index))
    return Mesh(image.to_world(index[used]), kept)


def lost_fraction(mesh: Mesh, image: Image, region: Region) -> float:
    """Fraction of a region's volume, as of thin walls, without cells, apart from what a mesh's flat
    facets cut off.

    Facets with corners on a round surface have on average n / (n + 1) of the depth of their centres
    within it; those inside that cross a torn wall, along whose normals the level hardly changes,
    cut nothing off; those that cross it obliquely count. Cells that bridge gaps of the region do
    not make up for lost walls.
    """
    index = image.to_index(mesh.points)
    facets = boundary_facets(mesh.cells)
    centre = index[facets].mean(axis=1)
    is_open = ~is_on_sides(centre, box_sides(image.shape)).any(axis=(1, 2))
    centre, normal = centre[is_open], area_normals(index[facets[is_open]])
    level, slope = levels(region.level, centre), _slopes(region.level, centre)
    area = np.linalg.norm(normal, axis=1)
    # The level of a mask of fractions has their slope, which is less than 1 at a blurred surface.
    rise = np.linalg.norm(slope, axis=1) if len(slope) else 1.0  # a mask of the whole box has none
    least_rise = LEAST_RISE * min(float(np.median(rise)), 1.0) * area
    is_surface = (level > 0.0) | (np.abs((slope * normal).sum(axis=1)) >= least_rise)
    cut_off = np.where(is_surface, -area * level * image.ndim / (image.ndim + 1), 0.0)
    volume = mesh.cell_volumes / image.voxel_volume
    bridged = (
        _volume_outside(region, index[mesh.cells], volume)
        + OVERHANG_RATIO * np.minimum(cut_off, 0.0).sum()
    )
    covered = volume.sum() + cut_off.sum() - max(bridged, 0.0)
    return float(1.0 - covered / region.inside.sum())


def hole_numbers(mesh: Mesh, image: Image, region: Region) -> tuple[int, ...]:
    """Holes minus cavities of a mesh, of its region and, if they differ, of the region without
    details smaller than cells.

    Components of the region without the centroid of a cell do not count. Gaps are closed and
    details opened by boxes of half a cell's edge all around; without thin walls, which no such
    detail is, a region is still like itself (`LEAST_LIKE`).
    """
    index = np.rint(image.to_index(centroids(mesh.points, mesh.cells))).astype(np.int64)
    is_met, inside = np.zeros_like(region.inside), region.inside.copy()
    is_met[tuple(np.clip(index, 0, np.array(image.shape) - 1).T)] = True
    n_parts, lost = component_runs(inside, is_met)
    for _, row, begin, end in lost:
        inside.reshape(-1, inside.shape[-1])[row, begin:end] = False
    n_parts -= len(np.unique(lost[:, 0]))
    ours = int(components(mesh.cells).max()) + 1 - cell_euler(mesh.cells) // 2
    if ours == (own := n_parts - voxel_euler(inside) // 2):
        return ours, own
    reach = 0.5 * regular_edge(mesh.cell_volumes.mean(), mesh.ndim) / image.spacing
    size, voxels = 1 + 2 * np.rint(np.maximum(reach, 1.0)).astype(int), inside.view(np.uint8)
    closed = scipy.ndimage.grey_closing(voxels, size)
    others = [closed, *(scipy.ndimage.grey_opening(each, size) for each in (voxels, closed))]
    return (
        ours,
        own,
        *(
            int(scipy.ndimage.label(each)[1]) - voxel_euler(each > 0) // 2
            for each in others
            if 2.0 * (each & voxels).sum() >= LEAST_LIKE * (each.sum() + inside.sum())
        ),
    )


def misfit_of_holes(numbers: tuple[int, ...]) -> int:
    """Return by how much the first of `hole_numbers` is beyond the range of the others."""
    ours, *others = numbers
    return max(min(others) - ours, ours - max(others), 0)


def _volume_outside(region: Region, corners: Floats, volume: Floats) -> float:
    """Volume of the cells' parts outside a region, by points spread evenly over the volume of
    the cells, (M,).
    """
    ends = np.cumsum(volume)
    chosen = corners[
        np.searchsorted(ends, (np.arange(VOLUME_POINTS) + 0.5) / VOLUME_POINTS * ends[-1])
    ]
    # over their sums, uniform within a simplex
    weights = np.random.default_rng(0).exponential(size=chosen.shape[:2])
    points = (weights[:, :, None] * chosen).sum(axis=1) / weights.sum(axis=1, keepdims=True)
    return float(ends[-1] * np.mean(levels(region.level, points) > 0.0))


def _sides(level: Floats, cells: Ints) -> tuple[Bools, Bools]:
    """Masks of the cells with a node inside, and of those with a node outside, (M,) each."""
    of_cells = level[cells]
    return np.asarray(of_cells.min(axis=1) < 0.0), np.asarray(of_cells.max(axis=1) > 0.0)


def lattice_within(
    image: Image,
    region: Region | None,
    kind: str | None = None,
    *,
    nodes: int | None = None,
    spacing: float | None = None,
) -> Mesh:
    """`tetopt.lattice_mesh` of the image's box, clipped at the region's surface, with about `nodes`
    nodes.

    Raises
    ------
    InputError
        As for `tetopt.lattice_mesh` and `clip_cells`.
    """
    if region is None or nodes is None:
        mesh = lattice_mesh(image, kind, nodes=nodes, spacing=spacing)
        return mesh if region is None else clip_cells(mesh, image, region)
    # nodes of a lattice of the box
    in_box, nearest = nodes * region.inside.size / region.inside.sum(), list[Mesh]()
    for _ in range(LATTICE_TRIALS):
        mesh = clip_cells(lattice_mesh(image, kind, nodes=int(in_box)), image, region)
        nearest = [min([*nearest, mesh], key=lambda each: abs(len(each.points) - nodes))]
        in_box *= nodes / len(mesh.points)
    return nearest[0]


def _snap_nodes(
    index: Floats,
    level: Floats,
    cells: Ints,
    image: Image,
    region: Region,
) -> tuple[Floats, Floats]:
    """Move nodes that are near to the surface along an edge onto it, unless that flattens a
    cell.
    """
    edge = edge_ends(cells)
    edge = edge[level[edge].prod(axis=2) < 0.0]
    edge = np.column_stack(np.divmod(np.unique(edge @ [len(level), 1]), len(level)))  # each once
    part = _crossings(index[edge[:, 0]], index[edge[:, 1]], region)
    is_close = np.zeros(len(level), dtype=bool)
    is_close[edge[part < SNAP_FRACTION, 0]] = True
    is_close[edge[part > 1.0 - SNAP_FRACTION, 1]] = True
    close = np.flatnonzero(is_close)
    there, is_there = onto_surface(index[close], image, region)
    # The edges of a node that cannot get there on a short way are split instead.
    length = np.full(len(level), np.inf)
    np.minimum.at(
        length,
        edge.ravel(),
        np.repeat(np.linalg.norm(np.diff(index[edge], axis=1)[:, 0], axis=1), 2),
    )
    way = np.zeros(len(level))
    way[close] = np.linalg.norm(there - index[close], axis=1) / length[close]
    is_there &= way[close] < 2.0 * SNAP_FRACTION
    moved = index.copy()
    moved[close[is_there]] = there[is_there]
    way[close[~is_there]] = 0.0
    while True:
        flat = cells[_fullness(image.to_world(moved), cells) < LEAST_FULLNESS]
        furthest = flat[np.arange(len(flat)), way[flat].argmax(axis=1)]
        back = np.unique(furthest[way[furthest] > 0.0])
        if len(back) == 0:
            break
        moved[back], way[back] = index[back], 0.0
    level = np.where(way > 0.0, 0.0, level)
    # A node that remains very near to a crossing counts as on the surface; it gets there as soon as
    # it moves.
    still_crosses = level[edge].prod(axis=1) < 0.0
    edge, part = edge[still_crosses], part[still_crosses]
    level[edge[part < TOUCH_FRACTION, 0]] = 0.0
    level[edge[part > 1.0 - TOUCH_FRACTION, 1]] = 0.0
    return moved, level


def _fullness(points: Floats, cells: Ints) -> Floats:
    """Volume relative to the regular cell with the same sum of squared edges, (M,): 0 to 1,
    negative if inverted.
    """
    n = points.shape[1]
    regular = 2.0**0.5 / 12.0 / 6.0**1.5 if n == 3 else 3.0**0.5 / 4.0 / 3.0
    return volumes(points, cells) / (
        regular * squared_edges(points, cells).sum(axis=1) ** (0.5 * n)
    )


def onto_surface(index: Floats, image: Image, region: Region) -> tuple[Floats, Bools]:
    """Move points (K, n) to the surface, nearly the shortest way in mm; also return a mask of those
    that arrive, (K,).

    Those on the box's faces stay on them.
    """
    sides = box_sides(image.shape)
    is_free = ~is_on_sides(index, sides, tolerance=0.0).any(axis=2)
    metric = np.linalg.inv(image.affine[:-1, :-1].T @ image.affine[:-1, :-1])
    metric = metric / np.trace(metric)
    at = index.copy()
    for _ in range(SNAP_STEPS):
        value = levels(region.level, at)
        slope = _slopes(region.level, at) * is_free
        way = (slope @ metric) * is_free
        rate = (way * slope).sum(axis=1)
        step = np.divide(value, rate, out=np.zeros_like(value), where=rate > 1e-12)
        at = np.clip(at - step[:, None] * way, *sides.T)
    return at, np.abs(levels(region.level, at)) < ON_SURFACE_VOXELS


def _slopes(level: NDArray[np.float32], index: Floats) -> Floats:
    """Derivatives of the level function along the axes at index coordinates (K, n), (K, n)."""
    off = 0.25 * np.eye(index.shape[1])
    return np.stack(
        [2.0 * (levels(level, index + way) - levels(level, index - way)) for way in off], axis=1
    )


def _cut(
    index: Floats,
    level: Floats,
    cells: Ints,
    near: Ints,
    region: Region,
) -> tuple[Floats, Floats, Ints]:
    """Split every edge that crosses the surface there; `near` numbers the cells. Return nodes,
    their levels and cells.

    Each round splits every cell at the first of its crossing edges, in an order that is the same
    for all cells, so that two cells always cut the facet between them alike.
    """
    n_nodes = len(index)
    ends = edge_ends(cells[near])
    crosses = level[ends].prod(axis=2) < 0.0
    code = np.unique(ends[crosses] @ [n_nodes, 1])
    a, b = np.divmod(code, n_nodes)
    part = _crossings(index[a], index[b], region)[:, None]
    index = np.vstack([index, index[a] + part * (index[b] - index[a])])
    level = np.append(level, np.zeros(len(code)))
    near = near[crosses.any(axis=1)]
    done, open_cells = [np.delete(cells, near, axis=0)], cells[near]
    while len(open_cells):
        ends = edge_ends(open_cells)
        crosses = level[ends].prod(axis=2) < 0.0
        is_cut = crosses.any(axis=1)
        done.append(open_cells[~is_cut])
        cut = open_cells[is_cut]
        first = np.where(crosses[is_cut], ends[is_cut] @ [n_nodes, 1], n_nodes * n_nodes).min(
            axis=1
        )
        node = n_nodes + np.searchsorted(code, first)
        one, other = cut.copy(), cut.copy()
        one[cut == (first // n_nodes)[:, None]] = node
        other[cut == (first % n_nodes)[:, None]] = node
        open_cells = np.concatenate([one, other])
    return index, level, np.concatenate(done)


def _crossings(a: Floats, b: Floats, region: Region) -> Floats:
    """Fractions of the way from a to b (K, n) at which the surface crosses these edges, (K,), by
    bisection.
    """
    low, high = np.zeros(len(a)), np.ones(len(a))
    sign = np.sign(levels(region.level, a))
    for _ in range(BISECTION_ROUNDS):
        middle = 0.5 * (low + high)
        is_before = np.sign(levels(region.level, a + middle[:, None] * (b - a))) == sign
        low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
    return 0.5 * (low + high)
