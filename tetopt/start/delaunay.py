"""Delaunay tessellation of nodes that already fill a convex box."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.geometry.simplex import oriented, volumes
from tetopt.image import transformed

TIE_BREAK = 1e-7  # of the squared typical edge


def delaunay(
    index: NDArray[np.float64], affine: NDArray[np.float64], tie_break: float = TIE_BREAK
) -> NDArray[np.int64] | None:
    """Delaunay cells of nodes given in index space, with cospherical ties broken so that no cell is flat.

    The Delaunay tessellation is the lower hull of the nodes lifted to (x, |x|^2) (Brown 1979). The lift is linear
    in x apart from the height, so x may stay in index space, where the box's faces are coordinate planes and
    nodes on them are coplanar to the last bit, with |x|^2 measured in mm. Lattices are full of cospherical nodes,
    of which Qhull makes flat cells; raising each node by a tiny fixed pseudo-random height (1e-7 of the squared
    typical edge; a regular triangulation with those weights) leaves no ties, moves no node, and Qhull runs faster.
    Positions that are Delaunay by more than that margin are not affected.

    Parameters
    ----------
    index : (N, n) float64
        Node positions, index coordinates; they fill their bounding box's corners.
    affine : (n+1, n+1) float64
        Index -> world mm.
    tie_break : float
        Largest weight, in units of the squared typical edge. Graded lattices want more of it: Qhull joins what it
        cannot tell apart in the whole box, and cuts that up with flat cells.

    Returns
    -------
    (M, n+1) int64 or None
        Cells, positively oriented in the world; None where Qhull fails or leaves a node out. Whether
        they fill the box is for the caller to check.
    """
    n = index.shape[1]
    centred = index - 0.5 * (index.min(axis=0) + index.max(axis=0))
    world = transformed(centred, affine[:-1, :-1])
    extent = float(np.abs(world).max())
    typical_edge = extent / len(index) ** (1.0 / n)
    weights = np.random.default_rng(len(index)).random(len(index)) * tie_break * typical_edge**2
    height = (world**2).sum(axis=1) + weights
    height = (height - height.min()) / np.ptp(height)
    lifted = np.column_stack([centred / np.abs(centred).max(), height])
    try:
        hull = scipy.spatial.ConvexHull(lifted)
    except scipy.spatial.QhullError:
        return None
    is_lower = hull.equations[:, n] < -1e-9  # faces of the box stand upright: 0 up to rounding
    cells = oriented(world, hull.simplices[is_lower])
    # Qhull's order of cells is its own; a sorted one does not depend on its version.
    cells = cells[np.lexsort(np.sort(cells, axis=1).T[::-1])]
    return cells if len(np.unique(cells)) == len(index) else None


def without_flat(points: NDArray[np.float64], cells: NDArray[np.int64], least: float) -> NDArray[np.int64]:
    """The tetrahedra with those of a volume below `least`, mm^3, taken away, as far as that goes, (M', 4).

    Where four nodes are the corners of a square, Qhull may cut it one way for the cells above and the other way for
    those below, with a flat cell in between (four of six million on an octree of a million nodes). If an edge of it has
    three cells around it in all, these become two without that edge (a 3-2 flip). One with two facets on the boundary
    is left out.
    """
    flat = cells[volumes(points, cells) < least]
    if len(flat) == 0:
        return cells
    is_near = np.isin(cells, flat).sum(axis=1) >= 2  # all that share an edge with a flat cell
    near = [frozenset(cell) for cell in cells[is_near].tolist()]
    for cell in map(frozenset, flat.tolist()):
        near = _without(points, near, cell, least)
    whole = np.concatenate([cells[~is_near], oriented(points, np.array([sorted(cell) for cell in near]))])
    return whole[np.lexsort(np.sort(whole, axis=1).T[::-1])]


def _without(
    points: NDArray[np.float64], cells: list[frozenset[int]], flat: frozenset[int], least: float
) -> list[frozenset[int]]:
    """The cells around a flat one without it; as they are where neither way is open."""
    outer = [node for node in flat if sum(flat - {node} <= cell for cell in cells) == 1]
    if len(outer) == 2:
        return [cell for cell in cells if cell != flat]
    for edge in combinations(sorted(flat), 2):
        around = [cell for cell in cells if cell.issuperset(edge)]
        ring = frozenset().union(*around) - set(edge)
        if len(around) != 3 or len(ring) != 3:
            continue
        new = [ring | {node} for node in edge]
        sizes = np.abs(volumes(points, np.array([sorted(cell) for cell in new])))
        if sizes.min() >= least:
            return [cell for cell in cells if cell not in around] + new
    return cells
