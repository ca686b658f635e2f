"""Delaunay: Qhull's own cells on generic nodes, and no flat cell where there are ties."""

import numpy as np
import pytest
from hypothesis import given
from meshes import box_corners, dimensions, random_affine, seeds
from naive import circumcentres
from scipy.spatial import Delaunay, cKDTree
from shapes import grid

from tetopt import Image, lattice_mesh
from tetopt.geometry.simplex import squared_edges, volumes
from tetopt.geometry.topology import facets
from tetopt.start.delaunay import delaunay


def world(index, affine):
    return index @ affine[:-1, :-1].T + affine[:-1, -1]


def as_set(cells):
    return set(map(tuple, np.sort(cells, axis=1).tolist()))


def random_box_nodes(rng, n):
    """Corners of a box, random nodes inside, some moved to a wall; and the box's sides."""
    shape = rng.integers(3, 10, n)
    low, high = np.full(n, -0.5), shape - 0.5
    nodes = rng.uniform(low, high, (60, n))
    is_on_wall = rng.random(nodes.shape) < 0.1
    nodes = np.where(is_on_wall, np.where(rng.random(nodes.shape) < 0.5, low, high), nodes)
    return np.unique(np.vstack([box_corners(shape), nodes]), axis=0), (low, high)


def check_tiling(index, cells, box):
    """A conforming tiling of the box [low, high]: volume, facets, boundary, every node."""
    low, high = box
    v = np.abs(volumes(index, cells))
    assert v.min() > 0
    assert v.sum() == pytest.approx(np.prod(high - low), rel=1e-10)
    assert np.unique(cells).tolist() == list(range(len(index)))
    sides = facets(cells)
    assert sides.n_cells.max() <= 2
    walls = index[sides.nodes[sides.n_cells == 1]]
    assert ((walls == low).all(axis=1) | (walls == high).all(axis=1)).any(axis=1).all()


# Generic nodes: Delaunay is unique


@given(seeds, dimensions)
def test_generic_nodes_get_scipy_s_cells(seed, n):
    """Random nodes without a box around them: the cells as sets of nodes, in the world of a
    sheared affine.
    """
    rng = np.random.default_rng(seed)
    index, affine = rng.uniform(0, 10, (int(rng.integers(n + 3, 80)), n)), random_affine(rng, n)
    assert as_set(delaunay(index, affine)) == as_set(Delaunay(world(index, affine)).simplices)


@given(seeds, dimensions)
def test_cells_tile_the_box(seed, n):
    """With nodes on walls and edges, whatever the affine."""
    rng = np.random.default_rng(seed)
    index, sides = random_box_nodes(rng, n)
    affine = random_affine(rng, n)
    cells = delaunay(index, affine)
    check_tiling(index, cells, sides)
    assert (volumes(world(index, affine), cells) > 0).all()
    assert cells.dtype == np.int64


# Ties


@pytest.mark.parametrize("sizes", [(2, 2), (3, 4), (9, 9), (2, 2, 2), (4, 3, 5), (6, 6, 6)])
def test_a_cubic_grid_has_no_flat_cell(sizes):
    """Cells with corners on a unit cube have 1/2, or 1/6 or 1/3; Qhull by itself makes cells of
    0 here.
    """
    n = len(sizes)
    index = grid(sizes).reshape(-1, n)
    cells = delaunay(index, np.eye(n + 1))
    check_tiling(index, cells, (np.zeros(n), np.array(sizes) - 1.0))
    allowed = [1 / 2] if n == 2 else [1 / 6, 1 / 3]
    assert np.isclose(volumes(index, cells)[:, None], allowed).any(axis=1).all()
    assert (np.ptp(index[cells], axis=1) == 1).all()


@pytest.mark.parametrize(("n", "kind"), [(2, "criss-cross"), (3, "bcc"), (3, "five-tet")])
def test_nodes_of_lattices(n, kind):
    image = Image(np.zeros((12, 9, 10)[:n]), np.diag([-1.0, 1.0, 1.0, 1.0][-n - 1 :]))
    mesh = lattice_mesh(image, kind, blocks=(4, 3, 3)[:n])
    points, index = mesh.points, image.to_index(mesh.points)
    cells = delaunay(index, image.affine)
    check_tiling(index, cells, (np.full(n, -0.5), np.array(image.shape) - 0.5))
    assert volumes(points, cells).min() > 0.3 * mesh.cell_volumes.min()
    centres = circumcentres(points, cells)
    radii = np.linalg.norm(points[cells[:, 0]] - centres, axis=1)
    assert (cKDTree(points).query(centres)[0] >= radii * (1 - 1e-5)).all()


@given(seeds)
def test_no_cell_is_flat_on_jittered_and_plain_grids_of_any_affine(seed):
    """Some nodes moved, most not: ties and generic places side by side."""
    rng = np.random.default_rng(seed)
    index = grid((4, 4, 4)).reshape(-1, 3)
    is_inside = ((index > 0) & (index < 3)).all(axis=1) & (rng.random(64) < 0.5)
    index[is_inside] += rng.uniform(-0.2, 0.2, (is_inside.sum(), 3))
    affine = random_affine(rng, 3, is_sheared=False)
    cells = delaunay(index, affine)
    check_tiling(index, cells, (np.zeros(3), np.full(3, 3.0)))
    points = world(index, affine)
    assert (volumes(points, cells) > 1e-9 * squared_edges(points, cells).max(axis=1) ** 1.5).all()


# The same every time, and none where there is none


def test_the_same_nodes_get_the_same_cells_in_the_same_order():
    """And the same cells far from the origin and in small voxels."""
    index, _ = random_box_nodes(np.random.default_rng(2), 3)
    first, second = delaunay(index, np.eye(4)), delaunay(index.copy(), np.eye(4))
    np.testing.assert_array_equal(first, second)
    keys = np.sort(first, axis=1).tolist()
    assert keys == sorted(keys)
    far, small = np.eye(4), np.diag([1e-3, 1e-3, 1e-3, 1.0])
    far[:3, 3] = 1e6
    for affine in (far, small):
        assert as_set(delaunay(index, affine)) == as_set(first)


def test_no_cells_for_nodes_in_a_plane_or_given_twice():
    flat, whole = (grid((3, 3, n)).reshape(-1, 3) for n in (1, 3))
    for nodes in (flat, np.vstack([whole, [[1.0, 1.0, 1.0]]])):
        assert delaunay(nodes, np.eye(4)) is None
