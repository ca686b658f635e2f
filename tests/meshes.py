"""Tiny meshes with a drawing of their numbering, and random ones; all positively oriented.

Each is a pair: points (N, n), cells (M, n+1).
"""

from __future__ import annotations

from functools import lru_cache
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import strategies as st
from naive import barycentric_functions, dot
from scipy.spatial import Delaunay

from tetopt.geometry.check import scaled_jacobians
from tetopt.geometry.quadratic import numbered_edges
from tetopt.geometry.simplex import orient_cells, volumes
from tetopt.mesh import Mesh

# Single triangles
#
#     2
#     |\        equilateral: edge 1
#     | \       right: legs 3 and 4, so inradius 1 and circumradius 2.5
#     0--1      obtuse: angles 120, 30, 30 degrees, the two equal edges 1

EQUILATERAL = (np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]]), np.array([[0, 1, 2]]))
RIGHT_TRIANGLE = (np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]), np.array([[0, 1, 2]]))
OBTUSE_TRIANGLE = (np.array([[0.0, 0.0], [1.0, 0.0], [-0.5, np.sqrt(0.75)]]), np.array([[0, 1, 2]]))

# Single tetrahedra
#
#       3
#      /|\      regular: edge sqrt(8), four corners of a cube of edge 2
#     0-|-2     cube corner: the node 0 at the origin, three edges of length 1 at right angles
#      \|/      obtuse: as the cube corner, but node 3 raised over (-1, -1), outside of the base
#       1

REGULAR_TET = (
    np.array([[1.0, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]),
    np.array([[0, 1, 2, 3]]),
)
CUBE_CORNER = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]]))
OBTUSE_TET = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, -1, 1]]), np.array([[0, 1, 2, 3]]))

# Two triangles, and two tetrahedra on either side of the triangle 0 1 2
#
#     3---2            3
#     |0 /|           /|\    cell 0 is 0 1 2 3
#     | / |          0-1-2
#     |/ 1|           \|/    cell 1 is 0 2 1 4
#     0---1            4

TWO_TRIANGLES = (np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), np.array([[0, 2, 3], [0, 1, 2]]))
TWO_TETS = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.25, 1], [0.25, 0.25, -1]]),
    np.array([[0, 1, 2, 3], [0, 2, 1, 4]]),
)

# A square cut into four by its centre (node 4), and two such squares that share the edge 1 4
#
#     3-------2        3-------4-------5
#     |\  2  /|        |\     /|\     /|
#     | \   / |        |  \ /  |  \ /  |
#     |3  4  1|        |   6   |   7   |
#     | /   \ |        |  / \  |  / \  |
#     |/  0  \|        |/     \|/     \|
#     0-------1        0-------1-------2

SQUARE = (
    np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]]),
    np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]),
)
TWO_SQUARES = (
    np.array([[0.0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1], [0.5, 0.5], [1.5, 0.5]]),
    np.array(
        [[0, 1, 6], [1, 4, 6], [4, 3, 6], [3, 0, 6], [1, 2, 7], [2, 5, 7], [5, 4, 7], [4, 1, 7]]
    ),
)

# The unit cube in five: node 4x + 2y + z at (x, y, z); the regular cell 0 on the even corners 0 3 5
# 6, then the corners 1, 2, 4 and 7.
#
#        3-------7
#       /|      /|      z
#      1-------5 |      | y
#      | 2-----|-6      |/
#      |/      |/       0--x
#      0-------4

FIVE_TET_CUBE = (
    np.array(list(product((0.0, 1.0), repeat=3))),
    np.array([[0, 3, 5, 6], [1, 0, 3, 5], [2, 0, 6, 3], [4, 0, 5, 6], [7, 3, 6, 5]]),
)

# Bad tetrahedra, each as (points, kind); t is small. In the drawings all four nodes lie (almost) in
# the page.
#
#     sliver      cap         spade       wedge       needle
#     3---2         2           2           2         0-1------2-3
#     |\ /|        / \         / \         / \        (spread along
#     | X |       / 3 \       /   \       /   \        a line, twisted)
#     |/ \|      /     \     /     \     /     \
#     0---1     0-------1   0---3---1   0------1,3


def sliver(t):
    """Around the equator of a sphere, lifted up and down in turn by t.

    Angles: acos(1 / (1 + 4 t^2)) at the four edges around, pi - 2 atan(2 t) at the two diagonals.
    """
    return np.array([[1.0, 0, t], [0, 1.0, -t], [-1.0, 0, t], [0, -1.0, -t]])


def cap(t):
    """An equilateral triangle of inradius 1 and a node t above its centre: angles atan(t) at the
    base.
    """
    turns = np.radians([0.0, 120.0, 240.0])
    base = np.column_stack([2 * np.cos(turns), 2 * np.sin(turns), np.zeros(3)])
    return np.vstack([base, [0.0, 0.0, t]])


def spade(t):
    """A triangle of height 2 and a node t above the middle of its base: angles atan(t sqrt(5) /
    2) at its sides.
    """
    return np.array([[-1.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, 0, t]])


def wedge(t):
    """A triangle with a corner doubled, t apart, upright: the angle at the far edge 0 1 is 2
    atan(t / 2 sqrt 3).
    """
    return np.array(
        [[-1.0, 0, 0], [1.0, 0, 0], [0, np.sqrt(3.0), t / 2], [0, np.sqrt(3.0), -t / 2]]
    )


def needle(t):
    """Two short crossed edges of length t, 1 apart: the angles at them are 2 atan(t / 2)."""
    return np.array([[-t / 2, 0, 0], [t / 2, 0, 0], [0, -t / 2, 1.0], [0, t / 2, 1.0]])


BAD_TETS = {"sliver": sliver, "cap": cap, "spade": spade, "wedge": wedge, "needle": needle}


def single(points):
    """The mesh of one cell on its n+1 points, positively oriented."""
    points = np.asarray(points, dtype=np.float64)
    return points, orient_cells(points, np.arange(len(points))[None])


# By dimension: single cells, and everything conforming
SINGLE = {
    2: [EQUILATERAL, RIGHT_TRIANGLE, OBTUSE_TRIANGLE],
    3: [REGULAR_TET, CUBE_CORNER, OBTUSE_TET],
}
SMALL = {
    2: [*SINGLE[2], TWO_TRIANGLES, SQUARE, TWO_SQUARES],
    3: [*SINGLE[3], TWO_TETS, FIVE_TET_CUBE],
}
ALL_SMALL = [*SMALL[2], *SMALL[3]]


# Random things; rng is a numpy Generator, seeded by hypothesis

seeds = st.integers(0, 2**32 - 1)
dimensions = st.sampled_from([2, 3])
both_dimensions = pytest.mark.parametrize("n", [2, 3])


def random_rotation(rng, n):
    """A rotation of n-space."""
    q, r = np.linalg.qr(rng.normal(size=(n, n)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.sign(np.linalg.det(q))
    return q


def random_affine(rng, n, *, is_sheared=True):
    """Voxels of unequal size, 0.3 to 5 mm, rotated, flipped along some axes, sheared, and moved
    by up to 100 mm.
    """
    columns = np.diag(rng.choice([-1.0, 1.0], n) * np.exp(rng.uniform(np.log(0.3), np.log(5.0), n)))
    if is_sheared:
        columns = (np.eye(n) + np.triu(rng.uniform(-0.6, 0.6, (n, n)), 1)) @ columns
    affine = np.eye(n + 1)
    affine[:n, :n] = random_rotation(rng, n) @ columns
    affine[:n, n] = rng.uniform(-100.0, 100.0, n)
    return affine


def box_corners(shape):
    """Corners of the image's box in index coordinates, (2^n, n)."""
    return np.array(list(product(*[(-0.5, s - 0.5) for s in shape])))


def split_box(rng, shape, n_nodes, step=0.5):
    """A conforming mesh of an image's box in index space; nodes put in are multiples of `step`, 1,
    1/2, 1/4 voxel.

    The box cut along its diagonal, then nodes put in one by one: every cell that holds the new
    node, on its boundary too, is replaced by the cells that have the node in place of one corner.
    Barycentric coordinates are exact, so it is a tiling whatever the nodes, and it is full of thin
    cells and of ties.
    """
    n = len(shape)
    scale = max(round(1 / step), 2)
    low, high = -scale // 2, np.array(shape) * scale - scale // 2
    points, cells = [], []
    for axes in permutations(range(n)):
        corner = np.full(n, low)
        path = [tuple(corner.tolist())]
        for axis in axes:
            corner[axis] = high[axis]
            path.append(tuple(corner.tolist()))
        cells.append(path)
    points = list(dict.fromkeys(p for cell in cells for p in cell))
    for _ in range(n_nodes):
        node = rng.integers(low, high + 1)
        node = tuple((node // scale * scale + scale if step == 1 else node).tolist())
        if node not in points:
            points.append(node)
            cells = [part for cell in cells for part in _split(cell, node)]
    number = {p: k for k, p in enumerate(points)}
    points = np.array(points) / scale
    return points, orient_cells(points, np.array([[number[p] for p in cell] for cell in cells]))


@lru_cache(10_000)  # most cells are asked for again at the next node
def _functions(cell):
    return barycentric_functions(cell)


def _split(cell, node):
    """The cells into which a node splits a cell: the cell itself if the node is outside."""
    sides = [dot(gradient, node) + constant for gradient, constant in _functions(tuple(cell))]
    if min(sides) < 0:
        return [cell]
    return [
        [node if k == i else p for k, p in enumerate(cell)]
        for i, side in enumerate(sides)
        if side > 0
    ]


def delaunay_box(rng, shape, n_nodes):
    """A Delaunay mesh of an image's box in index space: random nodes inside and on the walls,
    nothing snapped.
    """
    low, high = -0.5, np.array(shape) - 0.5
    nodes = rng.uniform(low, high, (n_nodes, len(shape)))
    is_on_wall = rng.random(nodes.shape) < 0.15
    nodes = np.where(is_on_wall, np.where(rng.random(nodes.shape) < 0.5, low, high), nodes)
    points = np.unique(np.vstack([box_corners(shape), nodes]), axis=0)
    cells = Delaunay(points).simplices
    cells = cells[np.abs(volumes(points, cells)) > 1e-12]  # Qhull's flat cells on the walls
    return points, orient_cells(points, cells)


def mesh_edges(mesh):
    """Ends and lengths of a mesh's edges."""
    ends = numbered_edges(mesh.cells)[0]
    return ends, np.linalg.norm(np.diff(mesh.points[ends], axis=1)[:, 0], axis=1)


def with_bent_edges(mesh, fraction):
    """The mesh with midpoints moved at random by about a fraction of the edge, or less where a
    cell would fold.
    """
    edges, lengths = mesh_edges(mesh)
    ends = mesh.points[edges]
    moves = np.random.default_rng(6).normal(size=(len(edges), mesh.ndim)) * lengths[:, None]
    while True:
        bent = Mesh(mesh.points, mesh.cells, ends.mean(axis=1) + fraction * moves)
        if scaled_jacobians(bent).min() > 0.2:
            return bent
        fraction *= 0.8
