"""Surfaces of sets of tetrahedra: closed and manifold whatever the set, around the same volume,
crossing nothing.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import CUBE_CORNER, FIVE_TET_CUBE, TWO_TETS, seeds
from numpy.testing import assert_allclose, assert_array_equal
from shapes import n_pieces, volume_and_area

from tetopt.errors import InputError
from tetopt.geometry.simplex import facet_areas, orient_cells, volumes
from tetopt.geometry.surface import SHIFT_FRACTION, extract_surface
from tetopt.geometry.topology import boundary_facets
from tetopt.image import Image
from tetopt.start.lattice import lattice_mesh

# Cells 0 1 2 3 and 0 1 4 5 share the edge 0 1, on either side of the plane x = 0; the third shares
# the node 3 alone.
TOUCHING_POINTS = np.array(
    [
        [0.0, -1, 0],
        [0, 1, 0],
        [1, 0, -1],
        [1, 0, 1],
        [-1, 0, -1],
        [-1, 0, 1],
        [1, 1, 3],
        [2, 0, 3],
        [1, -1, 3],
    ]
)


TOUCHING = (
    TOUCHING_POINTS,
    orient_cells(TOUCHING_POINTS, np.array([[0, 1, 2, 3], [0, 1, 5, 4], [3, 6, 7, 8]])),
)


def grid(blocks, kind="five-tet", noise=0.0, seed=0):
    """A lattice of unit cubes, its nodes moved a little, so that neighbouring facets lie in no
    common plane.
    """
    mesh = lattice_mesh(
        Image(np.zeros([2 * b for b in blocks]), np.diag([0.5, 0.5, 0.5, 1.0])), kind, blocks=blocks
    )
    points = mesh.points + np.random.default_rng(seed).normal(0.0, noise, mesh.points.shape)
    return points - points.min(axis=0), mesh.cells


def edges_of(triangles):
    """Directed edges, (3K, 2), three in a row for each triangle."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)


def assert_manifold(surface):
    """Each directed edge once, and once the other way; the triangles around each node are one
    cycle.
    """
    edges = [tuple(edge) for edge in edges_of(surface.triangles).tolist()]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
    assert set(surface.triangles.ravel().tolist()) == set(range(len(surface.points)))
    opposite = {}
    for a, b, c in surface.triangles.tolist():
        for node, start, end in ((a, b, c), (b, c, a), (c, a, b)):
            opposite.setdefault(node, {})[start] = end
    for ring in opposite.values():
        first = at = next(iter(ring))
        length = 0
        while length == 0 or at != first:
            at, length = ring[at], length + 1
        assert length == len(ring)


def surface_of(points, cells, chosen):
    """Manifold, distinct nodes even in float32, and the cells' volume, but for what the copies'
    shifts sweep.
    """
    surface = extract_surface(points, cells, chosen)
    assert_manifold(surface)
    assert len(np.unique(surface.points.astype(np.float32), axis=0)) == len(surface.points)
    volume, area = volume_and_area(surface)
    expected = volumes(points, cells[chosen]).sum()
    assert volume == pytest.approx(
        expected, abs=1.01 * surface.largest_shift * area + 1e-12 * expected
    )
    assert area > 0.0
    assert (surface.n_parted == 0) == (surface.largest_shift == 0.0)
    return surface


def counts(surface):
    """Parted places, pieces, and the Euler number V - E + F with E = 3 F / 2."""
    euler = len(surface.points) - len(surface.triangles) // 2
    return surface.n_parted, n_pieces(surface), euler


def n_crossings(surface):
    """Pairs of an edge and a triangle without a common node that cut each other, by brute force."""
    points, triangles = surface.points, surface.triangles
    edges = edges_of(triangles)
    edges = edges[edges[:, 0] < edges[:, 1]]
    crossings = 0
    a, b, c = points[triangles.T]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for edge in edges:
        u, v = points[edge]
        over_u, over_v = ((u - a) * normal).sum(axis=1), ((v - a) * normal).sum(axis=1)
        # Parts of one facet that was cut are flat, and their distances 1e-16, of either sign.
        may = (over_u * over_v < 0.0) & (np.maximum(abs(over_u), abs(over_v)) > 1e-9)
        may &= ~(triangles[:, :, None] == edge).any(axis=(1, 2))
        sides = [
            ((np.cross(p - u, q - u))[may] @ (v - u)) > 0.0 for p, q in ((a, b), (b, c), (c, a))
        ]
        crossings += int(((sides[0] == sides[1]) & (sides[1] == sides[2])).sum())
    return crossings


# --------------------------------------------------------------------------------------------------
# Where nothing touches


@pytest.mark.parametrize("mesh", [CUBE_CORNER, FIVE_TET_CUBE, TWO_TETS, grid((3, 2, 2), "bcc")])
def test_a_whole_mesh_has_its_boundary_facets(mesh):
    points, cells = mesh
    surface = surface_of(points, cells, np.ones(len(cells), dtype=bool))
    assert surface.triangles.dtype == np.int64

    def listed(places, triangles):  # by the places of their corners, the lowest first
        rows = [[tuple(p) for p in places[t].tolist()] for t in triangles]
        return sorted(min(row, row[1:] + row[:1], row[2:] + row[:2]) for row in rows)

    assert listed(surface.points, surface.triangles) == listed(points, boundary_facets(cells))
    assert (surface.n_parted, surface.largest_shift, n_pieces(surface)) == (0, 0.0, 1)


def test_mask_and_indices_in_any_order_mean_the_same():
    points, cells = grid((2, 2, 2))
    mask = np.arange(len(cells)) % 3 == 0
    one = extract_surface(points, cells, mask)
    other = extract_surface(points, cells, np.append(np.flatnonzero(mask)[::-1], 0))
    for a, b in zip(one, other, strict=True):
        assert_array_equal(a, b)


# --------------------------------------------------------------------------------------------------
# Where cells touch


@pytest.mark.parametrize(("chosen", "shared"), [([0, 1], [0, 1]), ([0, 2], [3])])
def test_cells_that_share_an_edge_or_a_node_come_apart(chosen, shared):
    points, cells = TOUCHING
    surface = surface_of(points, cells, chosen)
    assert (len(surface.points), len(surface.triangles)) == (8, 8)
    assert (surface.n_parted, n_pieces(surface)) == (len(shared), 2)
    least = heights(points, cells[chosen]).min()
    assert surface.largest_shift == pytest.approx(SHIFT_FRACTION * least)
    for node in shared:  # one copy keeps its place
        away = np.sort(np.linalg.norm(surface.points - points[node], axis=1))
        assert_allclose(away[:2], [0.0, surface.largest_shift], atol=1e-15)
    # Into the solid: no piece grows.
    assert volume_and_area(surface)[0] < volumes(points, cells[chosen]).sum()
    assert n_crossings(surface) == 0


def heights(points, cells):
    """The least height of each cell."""
    return 3.0 * volumes(points, cells) / facet_areas(points, cells).max(axis=1)


@pytest.mark.parametrize(("cubes", "characteristic", "parted"), [(8, 0, 0), (7, 2, 2)])
def test_a_ring_that_closes_in_an_edge_alone_opens(cubes, characteristic, parted):
    """Eight cubes around a hole are a ring. Without one at a corner its two neighbours share an
    edge, one cube long.
    """
    points, cells = grid((3, 3, 1))
    x, y, _ = np.floor(points[cells].mean(axis=1)).T
    is_chosen = ((x != 1) | (y != 1)) & ((x != 0) | (y != 0) | (cubes == 8))
    assert counts(surface_of(points, cells, is_chosen)) == (parted, 1, characteristic)


def edge_star(cells, a, b):
    """Cells around the edge a b in turn, each sharing a facet with the next."""
    left = [k for k, cell in enumerate(cells) if a in cell and b in cell]
    star = [left.pop(0)]
    while left:
        last = set(cells[star[-1]])
        star.append(left.pop(next(i for i, k in enumerate(left) if len(last & set(cells[k])) == 3)))
    return star


def block():
    """A mesh of bent cubes, and the number of the cell in its middle."""
    points, cells = grid((3, 3, 3), "bcc", noise=0.02)
    off = np.abs(points[cells].mean(axis=1) - points.mean(axis=0)).max(axis=1)
    return points, cells, off.argmin()


def test_an_edge_closed_at_both_ends_gets_two_middles():
    """Two cavities that share an edge become one: at neither end does the surface have several
    fans.
    """
    points, cells, middle = block()
    star = edge_star(cells.tolist(), *cells[middle][:2].tolist())
    is_chosen = ~np.isin(np.arange(len(cells)), [star[0], star[2]])
    surface = surface_of(points, cells, is_chosen)
    # Of the cavities' eight facets four are at the edge, each cut from its centroid into four.
    assert len(surface.triangles) - len(boundary_facets(cells)) == 4 + 4 * 4
    assert counts(surface) == (1, 2, 4)  # two spheres
    assert n_crossings(surface) == 0


def test_cavities_that_share_a_node_part_into_themselves():
    """The solid between them does not vanish: it grows into the narrower cavity."""
    points, cells, middle = block()
    common = np.isin(cells, cells[middle]).sum(axis=1)
    inner = ~np.isin(cells, boundary_facets(cells)).any(axis=1)
    for other in np.flatnonzero((common == 1) & inner):
        is_chosen = ~np.isin(np.arange(len(cells)), [middle, other])
        surface = surface_of(points, cells, is_chosen)
        assert counts(surface) == (1, 3, 6)
        assert volume_and_area(surface)[0] > volumes(points, cells[is_chosen]).sum()
        assert n_crossings(surface) == 0


@pytest.mark.parametrize(("scale", "place"), [(1e-2, 500.0), (1e-3, 500.0), (1.0, 1e4)])
def test_the_shift_is_felt_in_float32_and_turns_no_cell(scale, place):
    points, cells = TOUCHING[0] * scale + place, TOUCHING[1]
    surface = extract_surface(points, cells, [0, 1])
    assert len(np.unique(surface.points.astype(np.float32), axis=0)) == 8
    assert 16 * np.spacing(np.float32(place)) * 0.999 <= surface.largest_shift or scale == 1e-3
    assert surface.largest_shift <= 0.1001 * heights(points, cells[:2]).min()
    assert volume_and_area(surface)[0] > 0.7 * volumes(points, cells[:2]).sum()


# --------------------------------------------------------------------------------------------------
# Any set


@given(seeds, st.sampled_from(["five-tet", "bcc"]), st.sampled_from([0.1, 0.5, 0.9]))
def test_any_cells_of_a_lattice(seed, kind, fraction):
    points, cells = grid((3, 3, 2), kind, noise=0.05, seed=seed)
    is_chosen = np.random.default_rng(seed).random(len(cells)) < fraction
    is_chosen[0] = True
    surface = surface_of(points, cells, is_chosen)
    again = extract_surface(points, cells, is_chosen)
    assert surface.points.tobytes() == again.points.tobytes()


@pytest.mark.parametrize("kind", ["five-tet", "bcc"])
@pytest.mark.parametrize(("fraction", "seed"), [(0.1, 0), (0.9, 1)])
def test_parted_sheets_do_not_cross(kind, fraction, seed):
    """Nor do they in 999 of 1000 places of larger random sets; where fans wind around one
    another they may.
    """
    points, cells = grid((4, 4, 3), kind, noise=0.05, seed=seed)
    surface = extract_surface(
        points, cells, np.random.default_rng(seed).random(len(cells)) < fraction
    )
    assert surface.n_parted > 8
    assert n_crossings(surface) == 0


# --------------------------------------------------------------------------------------------------
# What cannot be done


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ([], "expected at least one cell"),
        (np.zeros(5, dtype=bool), "expected at least one cell"),
        (np.ones(4, dtype=bool), r"expected a mask of 5 cells, got shape \(4,\)"),
        ([0, 5], r"must lie in 0..4, got 0..5"),
        ([-1], r"must lie in 0..4, got -1..-1"),
        ([0.5], "got float64"),
    ],
)
def test_cells_that_cannot_be_chosen(chosen, words):
    with pytest.raises(InputError, match=words):
        extract_surface(*FIVE_TET_CUBE, chosen)


def test_triangles_and_folded_cells_are_refused():
    with pytest.raises(InputError, match="got cells of 3 nodes"):
        extract_surface(np.eye(3)[:, :2], np.array([[0, 1, 2]]), [0])
    points = np.vstack([CUBE_CORNER[0], [0.2, 0.2, 2.0], [0.1, 0.1, 3.0]])
    cells = np.array([[0, 1, 2, last] for last in (3, 4, 5)])
    for count in (2, 3):
        with pytest.raises(InputError, match="cells overlap"):
            extract_surface(points, cells[:count], range(count))
