"""The polygons in which a plane cuts tetrahedra, and the segments in which it cuts triangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tetopt.geometry.simplex import Cells, Points
from tetopt.system.arrays import Floats, Ints


class Cut(NamedTuple):
    """Polygons of three or four corners; a triangle repeats its last corner."""

    corners: Floats  # (K, 4, w), in the coordinates given to `plane_cut`
    cells: Ints  # (K,) the cell each one comes from


# Corners of the section as pairs of local nodes, in order around it, by which nodes lie above the
# plane (bit k: node k). One node apart gives a triangle, two a quadrilateral.
CUT_SECTIONS = np.zeros((16, 4, 2), dtype=np.int64)
for _alone in range(4):
    _others = [k for k in range(4) if k != _alone]
    _pairs = [(_alone, k) for k in (*_others, _others[-1])]
    CUT_SECTIONS[1 << _alone] = CUT_SECTIONS[15 - (1 << _alone)] = _pairs
for _a, _b in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
    _c, _d = (k for k in range(4) if k not in (_a, _b))
    CUT_SECTIONS[(1 << _a) + (1 << _b)] = [(_a, _c), (_a, _d), (_b, _d), (_b, _c)]


def plane_cut(points: Points, cells: Cells, height: Floats) -> Cut:
    """Cut the cells by the plane height = 0.

    Parameters
    ----------
    points : (N, w) float64
        Node coordinates, or any other values that are linear in each cell.
    cells : (M, 4) integer
    height : (N,) float64
        Signed distance of each node from the plane, in any unit; a node on the plane counts as
        above.

    Returns
    -------
    Cut
        One polygon for each cell that has nodes on both sides, in the cells' order.
    """
    is_above = height >= 0.0
    pattern = (is_above[cells] << np.arange(4)).sum(axis=1)
    cut = np.flatnonzero((pattern > 0) & (pattern < 15))
    pairs = CUT_SECTIONS[pattern[cut]]  # (K, 4, 2)
    ends = np.take_along_axis(cells[cut][:, None, :], pairs, axis=2)
    low, high = height[ends[..., 0]], height[ends[..., 1]]
    fraction = (low / (low - high))[..., None]
    return Cut(points[ends[..., 0]] * (1.0 - fraction) + points[ends[..., 1]] * fraction, cut)


def triangle_cut(points: Floats, triangles: Ints, height: Floats) -> tuple[Floats, Ints]:
    """Segments (K, 2, 3) in which the plane height = 0 cuts triangles, and the numbers (K,) of
    these.

    A node on the plane counts as above it.
    """
    is_above = height[triangles] >= 0.0
    n_above = is_above.sum(axis=1)
    # the node with no other on its side
    alone = (is_above == (n_above == 1)[:, None]).argmax(axis=1)
    turned = np.take_along_axis(triangles, (alone[:, None] + np.arange(3)) % 3, axis=1)[
        (n_above % 3) > 0
    ]
    one, others = turned[:, :1], turned[:, 1:]
    fraction = (height[one] / (height[one] - height[others]))[..., None]
    return points[one] * (1.0 - fraction) + points[others] * fraction, np.flatnonzero(n_above % 3)
