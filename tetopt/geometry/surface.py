"""The boundary of a set of tetrahedra as a watertight triangle surface.

Cells of the set that touch only in an edge or a node leave an edge with four triangles, or a node
with several fans of triangles. This module parts them: each sheet of the surface gets its own copy,
and copies are moved apart slightly, since readers of surface files weld nodes by their position.

Half-edge 3 t + k runs from corner k of triangle t to the next one; it and the corner it leaves
share that number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError
from tetopt.geometry.simplex import edge_pairs, facet_areas, volumes
from tetopt.geometry.topology import Facets, connected_sets, facets
from tetopt.system.arrays import Floats, Ints, plain_array, simplex_arrays

# The facet opposite each local node, its nodes turned to face out of a positively oriented cell.
OUTWARD_FACETS = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])

# Copies are moved by this fraction of the smallest height of the surrounding cells,
SHIFT_FRACTION = 2e-3
# or by so many float32 spacings, as binary STL is in float32,
SHIFT_SPACINGS = 16
# but never by more than this fraction of that height, so that no cell turns inside out.
LARGEST_SHIFT_FRACTION = 0.1

# Steps of the search for a direction inwards of a whole fan: with the mean of the normals instead,
# sheets of random sets of cells cross fifteen times as often; with three steps, about as rarely.
SEARCH_STEPS = 20

FOLDED_MESSAGE = (
    "surface: expected a conforming mesh, but some of the chosen cells overlap; "
    "see `tetopt quality --check`"
)


class Surface(NamedTuple):
    """Closed triangle surfaces in space.

    Parameters
    ----------
    points : (N, 3) float64
        World coordinates, mm.
    triangles : (K, 3) int64
        Normals point out of the solid.
    n_parted : int
        Nodes that have several copies, and edges that have several middles.
    largest_shift : float
        The largest displacement of a copy, mm; 0 if nothing was parted.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> whole = np.ones(len(mesh.cells), dtype=bool)
    >>> surface = tetopt.extract_surface(mesh.points, mesh.cells, whole)
    >>> surface.triangles.shape, surface.n_parted
    ((260, 3), 0)
    """

    points: Floats
    triangles: Ints
    n_parted: int
    largest_shift: float


class _Skin(NamedTuple):
    """The boundary as it is in the mesh, with the pairs of half-edges."""

    points: Floats  # (N, 3), all nodes of the mesh
    triangles: Ints  # (K, 3)
    normals: Floats  # (K, 3), unit vectors, outwards
    # (3K,), the half-edge on the other side, met by walking through the solid
    partner: Ints
    # (3K,), radians, 0 to 2 pi, between the two triangles through the solid
    angle: Floats
    # (N,), mm, the smallest height of the chosen cells around each node
    height: Floats


class _Sheets(NamedTuple):
    """Coincident fans or edges that must be moved apart."""

    points: Floats  # (S, 3), equal where `place` is
    place: Ints  # (S,)
    # (S,), the fraction of all directions that go into the solid, 0 to 1
    inside: Floats
    height: Floats  # (S,), mm, of the cells around
    normals: Floats  # (C, 3), unit vectors, of the triangles of all sheets
    sheet: Ints  # (C,), the sheet of each normal, ascending


def extract_surface(points: Floats, cells: NDArray[np.integer], chosen: ArrayLike) -> Surface:
    """Boundary of tetrahedra: closed, two triangles at each edge, one fan at each node.

    Where chosen cells touch only in a node or an edge, the sheets of the surface are separated. The
    flattest keeps its place; the others move into the narrower of their two sides, the narrowest
    farthest, by 1/500 of the smallest height of the surrounding cells, or as far as float32
    requires. So the solid separates there, and a ring closed only by an edge opens. A cavity's wall
    is a separate surface, with normals into the cavity.

    Parameters
    ----------
    points : (N, 3) array of float64
        Nodes in world coordinates, mm.
    cells : (M, 4) array of int
        Positively oriented tetrahedra of a conforming mesh.
    chosen : (M,) array of bool, or (C,) array of int
        The cells, as a mask or as indices.

    Returns
    -------
    Surface
        The surface; its points are renumbered.

    Raises
    ------
    InputError
        Triangles in the plane, no cell chosen, a mask of the wrong length, indices that are out of
        range or not integers, or overlapping cells.

    See Also
    --------
    save_surface : Write it to a file.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> is_ball = tetopt.cell_moments(image, mesh).mean > 60.0
    >>> surface = tetopt.extract_surface(mesh.points, mesh.cells, is_ball)
    >>> tetopt.save_surface("ball.stl", surface)
    """
    points, cells = simplex_arrays("extract_surface:", points, cells)
    skin = _skin(points, _chosen_cells(points, cells, chosen))
    fan = _fans(skin.partner)
    at = np.empty((fan.max() + 1, 3))
    at[fan] = points[skin.triangles.ravel()]

    copies, nodes = _split_nodes(skin, fan)
    at[copies], shift = _move_apart(nodes)
    doubled, edges = _split_edges(skin, fan)
    middles, edge_shift = _move_apart(edges)
    at, triangles = _with_middles(at, fan.reshape(-1, 3), doubled, skin.partner[doubled], middles)

    n_parted = len(np.unique(nodes.place)) + len(np.unique(edges.place))
    return Surface(at, triangles, n_parted, float(np.append(shift, edge_shift).max(initial=0.0)))


def _chosen_cells(points: NDArray, cells: NDArray, chosen: ArrayLike) -> Ints:
    if points.shape[1] != 3 or cells.shape[1] != 4:
        raise InputError(
            f"surface: expected tetrahedra in space, got cells of {cells.shape[1]} nodes; mesh a "
            "3-D image"
        )
    chosen = plain_array("surface", chosen)
    if chosen.dtype == np.bool_:
        if chosen.shape != (len(cells),):
            raise InputError(
                f"surface: expected a mask of {len(cells)} cells, got shape {chosen.shape}"
            )
        chosen = np.flatnonzero(chosen)
    if chosen.size == 0:
        raise InputError(
            "surface: expected at least one cell, got none; choose another threshold or label"
        )
    if not np.issubdtype(chosen.dtype, np.integer):
        raise InputError(f"surface: expected cells as a mask or as indices, got {chosen.dtype}")
    if chosen.min() < 0 or chosen.max() >= len(cells):
        raise InputError(
            f"surface: cell indices must lie in 0..{len(cells) - 1}, got "
            f"{chosen.min()}..{chosen.max()}"
        )
    is_chosen = np.zeros(len(cells), dtype=bool)
    is_chosen[chosen] = True
    return cells[is_chosen].astype(np.int64)


def _skin(points: Floats, cells: Ints) -> _Skin:
    shared = facets(cells)
    if (shared.n_cells > 2).any():
        raise InputError(FOLDED_MESSAGE)
    owner, opposite = np.nonzero(shared.n_cells[shared.of_cell] == 1)
    triangles = cells[owner[:, None], OUTWARD_FACETS[opposite]]
    a, b, c = points[triangles.T]
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    partner = _partners(cells, shared, triangles, shared.of_cell[owner, opposite])
    angle = _inner_angles(points, triangles, normals, partner)
    return _Skin(points, triangles, normals, partner, angle, _smallest_heights(points, cells))


def _partners(cells: Ints, shared: Facets, triangles: Ints, facet: Ints) -> Ints:
    """The half-edge paired with each one, (3K,); `facet` is each triangle's number among the
    facets.
    """
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    n_nodes = int(cells.max()) + 1
    key, edge, count = np.unique(
        _pair_key(start, end, n_nodes), return_inverse=True, return_counts=True
    )
    walk = np.zeros(len(start), dtype=np.int64)
    is_crowded = count[edge] > 2
    if is_crowded.any():
        crowded = np.flatnonzero(count > 2)
        where = np.searchsorted(crowded, edge[is_crowded])
        walk[is_crowded] = _walks(
            cells, shared, key[crowded], n_nodes, np.repeat(facet, 3)[is_crowded], where
        )
    one, other = np.lexsort((walk, edge)).reshape(-1, 2).T
    partner = np.empty(len(start), dtype=np.int64)
    partner[one], partner[other] = other, one
    if (start[partner] != end).any():
        raise InputError(FOLDED_MESSAGE)
    return partner


def _walks(
    cells: Ints,
    shared: Facets,
    crowded: Ints,
    n_nodes: int,
    facet: Ints,
    edge: Ints,
) -> Ints:
    """Number of the walk around an edge, from cell to cell through facets, that ends in each
    requested facet.

    `crowded` are the edges' keys, ascending, and `edge` are indices into it. Every walk has two
    ends.
    """
    is_end = np.zeros(n_nodes, dtype=bool)
    is_end[crowded // n_nodes] = is_end[crowded % n_nodes] = True
    steps = []
    # A cell leads from one facet at its edge to the other: they lie opposite its two nodes that are
    # not on the edge.
    for (i, j), (k, m) in zip(edge_pairs(3), reversed(edge_pairs(3)), strict=True):
        near = np.flatnonzero(is_end[cells[:, i]] & is_end[cells[:, j]])
        key = _pair_key(cells[near, i], cells[near, j], n_nodes)
        at = np.minimum(np.searchsorted(crowded, key), len(crowded) - 1)
        is_at, near = crowded[at] == key, near[crowded[at] == key]
        steps.append(shared.of_cell[near][:, [k, m]] * len(crowded) + at[is_at, None])
    state, step = np.unique(np.vstack(steps), return_inverse=True)
    one, other = step.reshape(-1, 2).T
    return connected_sets(one, other, len(state))[1][
        np.searchsorted(state, facet * len(crowded) + edge)
    ]


def _inner_angles(
    points: Floats,
    triangles: Ints,
    normals: Floats,
    partner: Ints,
) -> Floats:
    """`_Skin.angle`: pi where flat, less where the edge is convex."""
    along = (points[np.roll(triangles, -1, axis=1)] - points[triangles]).reshape(-1, 3)
    one, other = np.repeat(normals, 3, axis=0), normals[partner // 3]
    sine = (np.cross(one, other) * along).sum(axis=1) / np.linalg.norm(along, axis=1)
    return np.pi - np.arctan2(sine, (one * other).sum(axis=1))


def _smallest_heights(points: Floats, cells: Ints) -> Floats:
    """`_Skin.height`; infinite at nodes of no cell."""
    smallest = np.full(len(points), np.inf)
    of_cell = 3.0 * volumes(points, cells) / facet_areas(points, cells).max(axis=1)
    np.minimum.at(smallest, cells.ravel(), np.repeat(of_cell, 4))
    return smallest


def _fans(partner: Ints) -> Ints:
    """The fan of each corner, (3K,), numbered from 0: the corners met while turning around a
    node.
    """
    corner = np.arange(len(partner))
    before = corner - corner % 3 + (corner + 2) % 3
    return connected_sets(corner, partner[before], len(corner))[1]


def _split_nodes(skin: _Skin, fan: Ints) -> tuple[Ints, _Sheets]:
    """The fans at nodes with several fans, (S,), ascending, and these fans as sheets."""
    node = np.empty(fan.max() + 1, dtype=np.int64)
    node[fan] = skin.triangles.ravel()
    is_split = np.bincount(node)[node] > 1
    copies = np.flatnonzero(is_split)
    corners = np.flatnonzero(is_split[fan])
    corners = corners[np.argsort(fan[corners], kind="stable")]
    # Girard: the solid angle of a cone is the sum of the angles at its edges, less (edges - 2) pi.
    solid = (
        np.asarray(np.bincount(fan, weights=skin.angle - np.pi), dtype=np.float64)[copies]
        + 2.0 * np.pi
    )
    place = node[copies]
    sheet = np.searchsorted(copies, fan[corners])
    return copies, _Sheets(
        skin.points[place],
        place,
        solid / (4.0 * np.pi),
        skin.height[place],
        skin.normals[corners // 3],
        sheet,
    )


def _split_edges(skin: _Skin, fan: Ints) -> tuple[Ints, _Sheets]:
    """Half-edges, one per pair, whose two ends another pair joins as well, (S,), and these as
    sheets.

    Where a ring of cells closes in an edge, and cells around each end of the edge close it, too,
    neither end has several fans, but four triangles share the edge. A separate middle for each pair
    parts them.
    """
    half = np.flatnonzero(np.arange(len(fan)) < skin.partner)
    key = _pair_key(fan[half], fan[skin.partner[half]], fan.max() + 1)
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    is_doubled = count[place] > 1
    doubled, place = half[is_doubled], place[is_doubled]
    both = np.column_stack([doubled, skin.partner[doubled]])
    ends = skin.triangles.ravel()[both]
    return doubled, _Sheets(
        skin.points[ends].mean(axis=1),
        place,
        skin.angle[doubled] / (2.0 * np.pi),
        skin.height[ends].min(axis=1),
        skin.normals[both.ravel() // 3],
        np.repeat(np.arange(len(doubled)), 2),
    )


def _move_apart(sheets: _Sheets) -> tuple[Floats, Floats]:
    """New positions of the sheets, (S, 3), and their displacements, (S,), mm.

    The narrower sides of two sheets that do not cross are disjoint or nested. So each sheet may
    move into its own side if nested ones move farther, and the widest need not move at all.
    """
    if len(sheets.place) == 0:
        return sheets.points, np.zeros(0)
    narrow = np.minimum(sheets.inside, 1.0 - sheets.inside)
    order = np.lexsort((-narrow, sheets.place))
    _, first, count = np.unique(sheets.place[order], return_index=True, return_counts=True)
    rank, last = np.empty((2, len(order)), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(first, count)
    last[order] = np.repeat(count - 1, count)
    spacing = np.spacing(np.abs(sheets.points).max(axis=1).astype(np.float32)).astype(np.float64)
    farthest = np.maximum(SHIFT_FRACTION * sheets.height, SHIFT_SPACINGS * last * spacing)
    farthest = np.minimum(farthest, LARGEST_SHIFT_FRACTION * sheets.height)
    shift = farthest * rank / last
    sign = np.where(sheets.inside <= 0.5, -1.0, 1.0)
    return sheets.points + (sign * shift)[:, None] * _outwards(sheets.normals, sheets.sheet), shift


def _outwards(normals: Floats, sheet: Ints) -> Floats:
    """For each sheet, the unit vector that maximises the smallest dot product with its normals, (S,
    3).

    It points to the point of their convex hull nearest to the origin, which Frank-Wolfe steps
    approach.
    """
    start = np.flatnonzero(np.diff(sheet, prepend=-1))
    nearest = np.add.reduceat(normals, start) / np.diff(start, append=len(sheet))[:, None]
    lowest = np.empty(len(start), dtype=np.int64)
    for _ in range(SEARCH_STEPS):
        product = np.einsum("ij,ij->i", normals, nearest[sheet])
        is_lowest = product == np.minimum.reduceat(product, start)[sheet]
        lowest[sheet[is_lowest]] = np.flatnonzero(is_lowest)
        towards = normals[lowest] - nearest
        square = (towards**2).sum(axis=1)
        way = np.divide(
            -(nearest * towards).sum(axis=1), square, out=np.zeros_like(square), where=square > 0.0
        )
        nearest += np.clip(way, 0.0, 1.0)[:, None] * towards
    length = np.linalg.norm(nearest, axis=1, keepdims=True)
    # If the hull contains the origin, no direction is outwards of all normals, and any will do.
    nearest = np.where(length > 1e-9, nearest, normals[start])
    return nearest / np.linalg.norm(nearest, axis=1, keepdims=True)


def _with_middles(
    points: Floats,
    triangles: Ints,
    half: Ints,
    partner: Ints,
    middles: Floats,
) -> tuple[Floats, Ints]:
    """Insert middles of half-edges and their partners into points and triangles.

    Their triangles are split from the centroid to every corner and middle, whether they have one,
    two or three.
    """
    of_half = np.full(triangles.size, -1, dtype=np.int64)
    of_half[half] = of_half[partner] = len(points) + np.arange(len(middles))
    is_cut = (of_half.reshape(-1, 3) >= 0).any(axis=1)
    corner, middle = triangles[is_cut], of_half.reshape(-1, 3)[is_cut]
    after = np.roll(corner, -1, axis=1)
    centre = np.broadcast_to(
        len(points) + len(middles) + np.arange(len(corner))[:, None], corner.shape
    )
    has_middle = middle >= 0
    parts = np.stack([corner, np.where(has_middle, middle, after), centre], axis=-1).reshape(-1, 3)
    more = np.stack([middle, after, centre], axis=-1)[has_middle]
    centres = points[corner].mean(axis=1)
    return np.vstack([points, middles, centres]), np.vstack([triangles[~is_cut], parts, more])


def _pair_key(one: Ints, other: Ints, base: int) -> Ints:
    """One number for two numbers below `base`, whatever their order."""
    return np.minimum(one, other) * base + np.maximum(one, other)
