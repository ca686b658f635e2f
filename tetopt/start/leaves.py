"""Nodes and cells of an octree's leaves (in 2-D a quadtree's): corners and centres, joined by
templates.

Neighbouring leaves differ by at most one division, also across edges and corners: each edge of a
leaf has at most a node in its middle, each face at most one in its centre, and both sides of a face
divide it alike. The cells of a leaf share its centre. In 2-D their other nodes are the ends of an
edge, or of half an edge with a node in its middle. In 3-D they depend on the neighbour across a
face:

- A leaf of the same size: its centre, and two neighbouring nodes around the face. Without nodes in
  the middle of edges these are the four cells of a body-centred lattice.
- Smaller leaves: the node in the face's centre, and two neighbouring nodes around the face.
- A larger leaf, the outside of the box, or a leaf of the same size across a face with nodes in the
  middle of opposite edges: a triangle of the face.

If blocks are cubes, the cells are Delaunay and no dihedral angle is below 30 degrees.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from tetopt.geometry.simplex import orient_cells
from tetopt.system.arrays import Bools, Floats, Ints

# Around a square, in halves of its edge: corners, alternating with the middles of its edges.
FACE_RING = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]])
LEAVES_AT_A_TIME = 2**16  # leaves whose cells are assembled at a time


class LeafNodes(NamedTuple):
    """Distinct corners and centres of leaves in lexicographic order of their places; made by
    `leaf_nodes`.

    Places are in halves of the smallest leaves; a code combines the coordinates of a place into one
    number.
    """

    codes: Ints  # (N,) sorted
    steps: Ints  # (n,) change of the code by one step along each axis
    depth: int  # depth of the smallest leaves

    def places(self) -> Floats:
        """Places of the nodes, (N, n), in units of an undivided block."""
        along_axes, rest = [], self.codes
        for step in self.steps:
            along, rest = np.divmod(rest, step)
            along_axes.append(along)
        return np.stack(along_axes, axis=1) / 2.0 ** (self.depth + 1)

    def at(self, codes: Ints) -> Ints:
        """The nodes with these codes, -1 where there is none."""
        node = np.minimum(np.searchsorted(self.codes, codes), len(self.codes) - 1)
        return np.where(self.codes[node] == codes, node, -1)


def leaves_by_depth(divided: list[Bools], roots: tuple[int, ...]) -> Iterator[Ints]:
    """Places of the leaves of each depth, (K, n), the coarsest first."""
    blocks = np.argwhere(np.ones(roots, dtype=bool))
    half = np.argwhere(np.ones((2,) * len(roots), dtype=bool))
    for is_divided in divided:
        yield blocks[~is_divided[tuple(blocks.T)]]
        blocks = (2 * np.argwhere(is_divided)[:, None] + half).reshape(-1, len(roots))
    yield blocks


def leaf_nodes(
    divided: list[Bools],
    roots: tuple[int, ...],
    regions: Sequence[Bools] = (),
) -> LeafNodes:
    """Corners and centres of the leaves; with regions, given by depth, leaves outside are
    skipped.
    """
    n, depth = len(roots), len(divided)
    corner = np.stack(np.meshgrid(*[[0, 2]] * n, indexing="ij"), axis=-1).reshape(-1, n)
    of_leaf = np.vstack([corner, np.ones((1, n), dtype=np.int64)])  # in halves of a leaf
    size = (np.array(roots) << (depth + 1)) + 1
    steps = np.append(np.cumprod(size[:0:-1])[::-1], 1)
    codes = []
    for d, leaves in enumerate(leaves_by_depth(divided, roots)):
        inside = leaves[regions[d][tuple(leaves.T)]] if regions else leaves
        codes.append(((2 * inside @ steps)[:, None] + of_leaf @ steps << (depth - d)).ravel())
    ordered = np.concatenate(codes)
    ordered.sort()
    # `np.unique` uses hashes, which takes twenty times as long.
    return LeafNodes(ordered[np.append(True, ordered[1:] != ordered[:-1])], steps, depth)


def leaf_cells(
    divided: list[Bools],
    roots: tuple[int, ...],
    nodes: LeafNodes,
    points: Floats,
) -> Ints:
    """Positively oriented cells that fill the leaves, (M, n+1), sorted by their lowest nodes.

    `points` has the nodes' places in the world, (N, n).
    """
    cells = []
    for d, leaves in enumerate(leaves_by_depth(divided, roots)):
        for start in range(0, len(leaves), LEAVES_AT_A_TIME):
            some = leaves[start : start + LEAVES_AT_A_TIME]
            pieces = (_cells_in_plane if len(roots) == 2 else _cells)(some, nodes, d)
            cells += [orient_cells(points, piece) for piece in pieces]
    joined = np.concatenate(cells)
    del cells
    return joined[np.argsort(joined.min(axis=1), kind="stable")]


def _cells_in_plane(leaves: Ints, nodes: LeafNodes, depth: int) -> Iterator[Ints]:
    shift = nodes.depth - depth
    first = 2 * leaves @ nodes.steps
    ring = np.stack([nodes.at(first + step << shift) for step in FACE_RING @ nodes.steps], axis=1)
    yield _around(ring, nodes.at(first + nodes.steps.sum() << shift)[:, None])


def _cells(leaves: Ints, nodes: LeafNodes, depth: int) -> Iterator[Ints]:
    """The tetrahedra of leaves of one depth, face by face; the first of two leaves lists those
    between them.
    """
    first, shift = 2 * leaves @ nodes.steps, nodes.depth - depth
    centre = nodes.at(first + nodes.steps.sum() << shift)
    for axis in range(3):
        step, along = nodes.steps[axis], np.delete(nodes.steps, axis)
        for side in (-1, 1):
            face = first + (1 + side) * step
            ring = np.stack([nodes.at(face + more << shift) for more in FACE_RING @ along], axis=1)
            middle = nodes.at(face + along.sum() << shift)
            # Beyond the box this is the code of a place with odd and even coordinates, which has no
            # node.
            across = nodes.at(first + nodes.steps.sum() + 2 * side * step << shift)
            # The middles of opposite edges and the two centres form a square with two possible
            # diagonals: the one in the face gives more cells, and 1 % less E_D.
            is_square = (ring[:, [1, 5]].min(axis=1) >= 0) | (ring[:, [3, 7]].min(axis=1) >= 0)
            is_fine, is_even = middle >= 0, (middle < 0) & (across >= 0) & ~is_square
            yield _around(ring[is_fine], np.stack([centre, middle], axis=1)[is_fine])
            if side > 0:
                yield from _between(ring[is_even], np.stack([centre, across], axis=1)[is_even])
            is_odd = np.delete(leaves, axis, axis=1).sum(axis=1) % 2 == 1
            yield from _on_squares(ring, centre, is_odd, ~is_fine & ~is_even)


def _between(ring: Ints, ends: Ints) -> Iterator[Ints]:
    """Cells between the centres of two leaves, (K, 2), that share a face.

    Where a corner of the face lies between two mid-edge nodes, these three are cut off, as in
    Delaunay cells.
    """
    left = ring.copy()
    for k in (0, 2, 4, 6):
        triangle = ring[:, [k - 1, k, k + 1]]
        is_cut = triangle.min(axis=1) >= 0
        left[is_cut, k] = -1
        yield from (np.column_stack([end, triangle])[is_cut] for end in ends.T)
    yield _around(left, ends)


def _around(ring: Ints, tips: Ints) -> Ints:
    """Cells of the tips, (K, t), and any two neighbours in a ring, (K, 8), with -1 for missing
    nodes.
    """
    cells = []
    for k in range(8):
        first, second, third = ring[:, k], ring[:, (k + 1) % 8], ring[:, (k + 2) % 8]
        cells.append(
            np.column_stack([tips, first, np.where(second < 0, third, second)])[first >= 0]
        )
    return np.concatenate(cells)


def _on_squares(
    ring: Ints,
    centre: Ints,
    is_odd: Bools,
    chosen: Bools,
) -> Iterator[Ints]:
    """Cells of the centre and the triangles of the chosen squares.

    Diagonals of plain squares join the corners whose coordinates have an even sum: on a larger
    leaf's face they start from its centre, and on the box's sides they alternate.
    """
    has_middle = ring[:, 1::2] >= 0
    for mask in range(16):
        is_so = chosen & (has_middle == [mask >> k & 1 for k in range(4)]).all(axis=1)
        for turn in (0, 2) if mask == 0 else (0,):
            rows = np.flatnonzero(is_so if mask else is_so & (is_odd == (turn == 0)))
            for triangle in _triangles(mask) if len(rows) else ():
                slots = (np.array(triangle) + turn) % 8
                yield np.column_stack([centre[rows], ring[rows[:, None], slots]])


def _triangles(mask: int) -> Iterator[tuple[int, int, int]]:
    """Triangles of a square's ring; `mask` gives the edges with a node in the middle.

    The shortest diagonals come first, which cut off corners rather than middles and wide angles
    rather than sharp ones, so that no angle is below 26 degrees.
    """
    left = [k for k in range(8) if k % 2 == 0 or mask >> (k // 2) & 1]
    while len(left) > 2:
        ears = []
        for k, slot in enumerate(left):
            before, after = FACE_RING[left[k - 1]], FACE_RING[left[(k + 1) % len(left)]]
            (a, b), (c, d) = FACE_RING[slot] - before, after - before
            if a * d != b * c:
                ears.append((int(c * c + d * d), slot % 2, int(a * (a - c) + b * (b - d)), k))
        k = min(ears)[-1]
        yield left[k - 1], left[k], left[(k + 1) % len(left)]
        del left[k]
