"""Delaunay: Qhull's own cells on generic nodes, and no flat cell where there are ties."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import box_corners, random_affine
from naive import circumcentres
from scipy.spatial import Delaunay
from shapes import grid

from tetopt import Image, lattice_mesh
from tetopt.geometry.simplex import squared_edges, volumes
from tetopt.geometry.topology import facets
from tetopt.start.delaunay import delaunay

seeds = st.integers(0, 2**32 - 1)
dimensions = st.sampled_from([2, 3])
IDENTITY = {2: np.eye(3), 3: np.eye(4)}


def world(index, affine):
    return index @ affine[:-1, :-1].T + affine[:-1, -1]


def as_set(cells):
    return set(map(tuple, np.sort(cells, axis=1).tolist()))


def random_box_nodes(rng, n, n_nodes, per_wall=0.1):
    """Corners of a box, random nodes inside, some moved to a wall."""
    shape = rng.integers(3, 10, n)
    low, high = -0.5, shape - 0.5
    nodes = rng.uniform(low, high, (n_nodes, n))
    is_on_wall = rng.random(nodes.shape) < per_wall
    nodes = np.where(is_on_wall, np.where(rng.random(nodes.shape) < 0.5, low, high), nodes)
    return np.unique(np.vstack([box_corners(shape), nodes]), axis=0), shape


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
    index, shape = random_box_nodes(rng, n, 60)
    affine = random_affine(rng, n)
    cells = delaunay(index, affine)
    check_tiling(index, cells, (np.full(n, -0.5), shape - 0.5))
    assert (volumes(world(index, affine), cells) > 0).all()
    assert cells.dtype == np.int64


# Ties


@pytest.mark.parametrize("sizes", [(2, 2), (3, 4), (9, 9), (2, 2, 2), (4, 3, 5), (6, 6, 6)])
def test_a_cubic_grid_has_no_flat_cell(sizes):
    """Cells with corners on a unit cube have 1/2, or 1/6 or 1/3; Qhull by itself makes cells of
    0 here.
    """
    index = grid(sizes).reshape(-1, len(sizes))
    n = len(sizes)
    cells = delaunay(index, IDENTITY[n])
    check_tiling(index, cells, (np.zeros(n), np.array(sizes) - 1.0))
    v = volumes(index, cells)
    allowed = [1 / 2] if n == 2 else [1 / 6, 1 / 3]
    assert np.isclose(v[:, None], allowed).any(axis=1).all()
    assert (np.ptp(index[cells], axis=1) == 1).all()


@pytest.mark.parametrize(("n", "kind"), [(2, "criss-cross"), (3, "bcc"), (3, "five-tet")])
def test_nodes_of_lattices(n, kind):
    image = Image(
        np.zeros((12, 9, 10)[:n]), np.diag([-1.0, 1.0, 1.0, 1.0])[-n - 1 :, -n - 1 :] * 1.0
    )
    mesh = lattice_mesh(image, kind, blocks=(4, 3, 3)[:n])
    index = image.to_index(mesh.points)
    cells = delaunay(index, image.affine)
    check_tiling(index, cells, (np.full(n, -0.5), np.array(image.shape) - 0.5))
    smallest = volumes(mesh.points, mesh.cells).min()
    assert volumes(mesh.points, cells).min() > 0.3 * smallest
    centres = circumcentres(mesh.points, cells)
    radii = np.linalg.norm(mesh.points[cells[:, 0]] - centres, axis=1)
    distances = np.linalg.norm(mesh.points[None] - centres[:, None], axis=2)
    assert (distances >= radii[:, None] * (1 - 1e-5)).all()


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
    rng = np.random.default_rng(1)
    index, _ = random_box_nodes(rng, 3, 60)
    first, second = delaunay(index, np.eye(4)), delaunay(index.copy(), np.eye(4))
    np.testing.assert_array_equal(first, second)
    keys = np.sort(first, axis=1).tolist()
    assert keys == sorted(keys)


def test_far_from_the_origin_and_in_small_voxels_the_cells_are_the_same():
    rng = np.random.default_rng(2)
    index, _ = random_box_nodes(rng, 3, 60)
    far = np.eye(4)
    far[:3, 3] = 1e6
    small = np.diag([1e-3, 1e-3, 1e-3, 1.0])
    for affine in (far, small):
        assert as_set(delaunay(index, affine)) == as_set(delaunay(index, np.eye(4)))


def test_no_cells_for_nodes_in_a_plane_or_given_twice():
    flat = grid((3, 3, 1)).reshape(-1, 3)
    assert delaunay(flat, np.eye(4)) is None
    twice = np.vstack([grid((3, 3, 3)).reshape(-1, 3), [[1.0, 1.0, 1.0]]])
    assert delaunay(twice, np.eye(4)) is None
