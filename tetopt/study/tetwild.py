"""fTetWild (Hu, Schneider, Wang, Zorin, Panozzo 2020) through pytetwild, on the soup of interfaces
and box.

One factor scales the sizing field and, with its 8th power, the envelope: if the interfaces alone
need more nodes than requested, only a wider envelope helps. Measurements behind the choices, with
E_D as a fraction of the image's variance:

- MNI T1, 4 classes, 5000 nodes. With an envelope of 1.35 mm, edges of 13, 25 and 49 mm give 16,755,
  15,951 and 15,635 nodes; with 3 mm and triangles of 16 mm, 4694 nodes: 0.0342 (`coarsen`: 3793
  nodes, 0.0391); currently (3.2 mm, triangles of 9.4 mm), 5090 nodes: 0.0312, mean rho 0.248,
  smallest angle 12.9 degrees, 173 s for 3 runs on a busy two-core machine.
- Sphere phantom, 1500 nodes, fixed envelope: 0.0093 uniform and 0.0092 with the sizing field at
  0.13 mm, 0.0149 and 0.0131 at 0.63 mm; coarser triangles 0.0137 and 0.0119. Currently: 0.0103,
  which tuning by hand can reduce by a tenth. Two spheres, currently: 0.0715 for 2 classes (too
  few), 0.0170 for 3, 0.0081 for 4.
- The soup, not `tetrahedralize_csg`, which accepts no sizing field, and needs 5566 nodes for the
  sphere at 0.0100, where the soup has 0.0103 with 1499.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tetopt.errors import InputError
from tetopt.geometry.quadratic import node_count
from tetopt.geometry.simplex import orient_cells, volumes
from tetopt.geometry.topology import boundary_facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.start.lattice import lattice_mesh
from tetopt.study.endings import import_peer
from tetopt.study.isosurfaces import Surfaces, compact_points
from tetopt.study.search import Response, corners_for, is_near, tries
from tetopt.system.arrays import Bools, Floats, Ints

TETWILD_RUNS = 6  # of one search, at most; each takes about as long as the result's
# measured slopes are -3 to -9
TETWILD_RESPONSE = Response(-5.0, -12.0, -2.0, step=1.5, after_failure=0.83)
# distance that fTetWild may move a surface, over the edge of regular cells, at factor 1
ENVELOPE_FRACTION = 0.2
# of the factor in the envelope: simple shapes, with small factors, are met closely
ENVELOPE_EXPONENT = 8.0
EDGE_GROWTH = 0.6  # mm by which edges lengthen per mm of distance from the interfaces
EDGE_RATIO = 3.0  # edge far away over edge at the interfaces
STOP_ENERGY = 10.0  # of fTetWild's cells (AMIPS; regular: 3), at which it stops: its default
# volume over the longest edge's cube (regular: 0.118) below which a cell is repaired
LEAST_SHAPE = 2e-3
# after the boundary is on the box; cells still inverted then cannot be repaired this way
UNTANGLING_ROUNDS = 60


class Filled(NamedTuple):
    """Result of `fill_image`."""

    mesh: Mesh
    n_runs: int  # of fTetWild
    search_seconds: float  # of the other runs, made to reach the number of nodes
    notes: list[str]


def node_spacing(image: Image, nodes: int) -> float:
    """Return the edge length, mm, at which regular tetrahedra fill the image's box with this
    many nodes.
    """
    return float((np.sqrt(2.0) * image.volume / nodes) ** (1.0 / 3.0))


def fill_image(image: Image, surfaces: Surfaces, nodes: int, order: int) -> Filled:
    """Fill the image's box with tetrahedra that have facets along the surfaces, and about `nodes`
    nodes.

    The factor on the sizing field and the envelope is searched, by secants of log nodes over log
    factor, until the number of nodes is within 5 % of the requested one, in at most 6 runs; the
    closest is used.

    Parameters
    ----------
    image : Image
        3-D image; its box is filled exactly.
    surfaces : Surfaces
        Surfaces of the same image.
    nodes : int
        Requested number of nodes, 8 or more.
    order : {1, 2}
        Order of the cells whose nodes are counted.

    Returns
    -------
    Filled
        Mesh in the world with positively oriented cells and its boundary on the box's faces; a note
        if the number of nodes was missed.

    Raises
    ------
    InputError
        pytetwild is not installed; no run's boundary could be moved onto the box
        without inverting a cell.
    """
    tetrahedralize = import_peer("pytetwild").tetrahedralize
    spacing = node_spacing(image, corners_for(nodes, order))

    def run(factor: float) -> tuple[Floats, Ints]:
        envelope = ENVELOPE_FRACTION * spacing * factor**ENVELOPE_EXPONENT
        return _run(tetrahedralize, surfaces, factor * spacing, envelope)

    runs = tries(
        run, lambda made: node_count(*made, order), nodes, TETWILD_RESPONSE, most=TETWILD_RUNS
    )
    notes: list[str] = []
    for each in runs:
        try:
            points, cells, _ = put_on_box(*each.result, surfaces.low, surfaces.high)
        except InputError as error:
            notes.append(f"dropped a run with {each.n_nodes} nodes: {error}")
            continue
        world = image.to_world(points / image.spacing)
        n_nodes = node_count(points, cells, order)
        if not is_near(n_nodes, nodes):
            notes.append(f"{n_nodes} nodes after {len(runs)} runs of fTetWild; requested: {nodes}")
        search = sum(other.seconds for other in runs) - each.seconds
        return Filled(Mesh(world, orient_cells(world, cells)), len(runs), search, notes)
    raise InputError(
        f"pytetwild: none of {len(runs)} meshes could be fitted to the box; request more nodes"
    )


def _run(
    tetrahedralize: Callable[..., tuple[NDArray, NDArray]],
    surfaces: Surfaces,
    edge: float,
    envelope: float,
) -> tuple[Floats, Ints]:
    """Run fTetWild once, in the box frame; return the cells inside the box and their nodes."""
    diagonal = float(np.linalg.norm(surfaces.high - surfaces.low))
    field = _sizing_field(surfaces, edge)
    points, cells = tetrahedralize(
        surfaces.points,
        surfaces.triangles.astype(np.int32),
        edge_length_abs=float(field[2].max()),
        epsilon=envelope / diagonal,
        stop_energy=STOP_ENERGY,
        # Unfiltered: winding numbers would drop the inside of nested or open interfaces. Cells
        # outside the box are dropped here.
        disable_filtering=True,
        quiet=True,
        bg_vertices=field[0],
        bg_tets=field[1],
        bg_values=field[2],
    )
    points, cells = inside_box(
        np.asarray(points, dtype=np.float64), cells, surfaces.low, surfaces.high
    )
    return points, orient_cells(points, cells)


def inside_box(
    points: Floats,
    cells: NDArray[np.integer],
    low: Floats,
    high: Floats,
) -> tuple[Floats, Ints]:
    """Return the cells with their centroid in the box, and their nodes."""
    middles = points[cells].mean(axis=1)
    return compact_points(points, cells[((middles > low) & (middles < high)).all(axis=1)])


def _sizing_field(surfaces: Surfaces, edge: float) -> tuple[NDArray, NDArray, NDArray]:
    """Return lattice points, tetrahedra and target edges: `edge` at the interfaces, growing with
    the distance.
    """
    size = surfaces.high - surfaces.low
    blocks = tuple(int(b) for b in np.clip(np.ceil(size / (0.75 * edge)), 2, 40))
    unit = lattice_mesh(Image(np.zeros((2, 2, 2))), "five-tet", blocks=blocks)
    middle = 0.5 * (surfaces.low + surfaces.high)
    # slightly larger than the box, for all nodes
    points = middle + 1.01 * ((unit.points + 0.5) / 2.0 - 0.5) * size
    facets = surfaces.points[surfaces.triangles[: -surfaces.n_box]]
    if len(facets) == 0:
        return points, unit.cells.astype(np.int32), np.full(len(points), edge)
    distance = cKDTree(np.vstack([facets.mean(axis=1), facets.reshape(-1, 3)])).query(points)[0]
    values = edge * np.minimum(
        1.0 + EDGE_GROWTH * np.maximum(distance - edge, 0.0) / edge, EDGE_RATIO
    )
    return points, unit.cells.astype(np.int32), values


def put_on_box(
    points: Floats,
    cells: Ints,
    low: Floats,
    high: Floats,
) -> tuple[Floats, Ints, Ints]:
    """Move a mesh's boundary, which runs along the box's faces within the envelope, exactly onto
    them.

    Each boundary facet moves to its nearest face. Cells that become flat (all four nodes on one
    face) are dropped; inverted cells are repaired by moving the nodes around them, those on a face
    within it.

    Parameters
    ----------
    points : (N, 3) float64, mm
    cells : (M, 4) int64
        Positively oriented.
    low, high : (3,) float64, mm
        Corners of the box.

    Returns
    -------
    points, cells
        Without unused nodes; all volumes are positive and add up to the box's.
    kept : (K,) int64
        Indices of these cells among the input's.

    Raises
    ------
    InputError
        A cell remains inverted, or the boundary does not match the box's.
    """
    points = points.copy()
    faces = np.stack([low, high])
    kept = np.arange(len(cells))
    while True:
        is_on = _box_faces_of_nodes(points, cells, faces)  # [node, side, axis]
        for side in (0, 1):
            points = np.where(is_on[:, side], faces[side], points)
        is_flat = is_on[cells].all(axis=1).reshape(-1, 6).any(axis=1)
        if not is_flat.any():
            break
        cells, kept = cells[~is_flat], kept[~is_flat]
    is_fixed = np.any(is_on[np.unique(cells)], axis=1)
    points, cells = compact_points(points, cells)
    points = _untangle(points, cells, is_fixed)
    v = volumes(points, cells)
    if v.min() <= 0.0:
        raise InputError(f"{int((v <= 0.0).sum())} cells are inverted on the box's faces")
    if abs(v.sum() / np.prod(high - low) - 1.0) > 1e-9:
        raise InputError(f"the cells fill {v.sum() / np.prod(high - low):.6f} of the box")
    return points, cells, kept


def _box_faces_of_nodes(points: Floats, cells: Ints, faces: Floats) -> Bools:
    """Mark the faces of the box that each node belongs on, (N, 2, 3) bool: the nearest to its
    boundary facets.
    """
    outer = boundary_facets(cells)
    off = np.abs(points[outer][:, :, None, :] - faces).max(axis=1).reshape(len(outer), 6)
    nearest = off.argmin(axis=1)
    is_on = np.zeros((len(points), 6), dtype=bool)
    is_on[outer.ravel(), np.repeat(nearest, 3)] = True
    return is_on.reshape(-1, 2, 3)


def _untangle(points: Floats, cells: Ints, is_fixed: Bools) -> Floats:
    """Move nodes of inverted and nearly flat cells until all volumes are positive, for at most
    `UNTANGLING_ROUNDS`.

    `is_fixed` (N, 3) marks fixed coordinates. A node moves part of the way to its neighbours'
    middle if the smallest relative volume around it (volume over its longest edge's cube) grows.
    """
    points = points.copy()
    around = [np.flatnonzero(False)] * len(points)
    for _ in range(UNTANGLING_ROUNDS):
        shape = _relative_volumes(points[cells])
        bad = np.flatnonzero(shape < LEAST_SHAPE)
        if len(bad) == 0:
            break
        has_moved = False
        for node in np.unique(cells[bad]):
            if is_fixed[node].all():
                continue
            if len(around[node]) == 0:
                around[node] = np.flatnonzero((cells == node).any(axis=1))
            has_moved |= _improve(points, cells[around[node]], int(node), ~is_fixed[node])
        if not has_moved:
            break
    return points


def _improve(points: Floats, star: Ints, node: int, is_free: Bools) -> bool:
    """Move one node to the best of a few nearby places; return whether it moved."""
    corners = points[star]
    is_node = star == node
    start = points[node].copy()
    others = corners[~is_node].reshape(-1, 3)
    radius = float(np.linalg.norm(others - start, axis=1).mean())
    middle = others.mean(axis=0)
    moves = [t * (middle - start) for t in (1.0, 0.5, 0.25, 0.1)]
    moves += [
        s * t * radius * np.eye(3)[axis]
        for t in (0.2, 0.05, 0.01)
        for axis in range(3)
        for s in (1.0, -1.0)
    ]
    best, best_shape = start, float(_relative_volumes(corners).min())
    for move in moves:
        place = start + np.where(is_free, move, 0.0)
        corners[is_node] = place
        shape = float(_relative_volumes(corners).min())
        if shape > best_shape:
            best, best_shape = place, shape
    points[node] = best
    return best is not start


def _relative_volumes(corners: Floats) -> Floats:
    """Return volume over the cube of the longest edge, (M,), for corners (M, 4, 3); negative if
    inverted.
    """
    frames = corners[:, 1:] - corners[:, :1]
    a, b, c = frames[:, 0], frames[:, 1], frames[:, 2]
    volume = (np.cross(a, b) * c).sum(axis=1) / 6.0
    edges = np.stack([a, b, c, b - a, c - a, c - b])
    return volume / np.maximum((edges**2).sum(axis=2).max(axis=0), 1e-300) ** 1.5
