"""Delaunay tessellation of nodes that already fill a convex box."""

from __future__ import annotations

import numpy as np
import scipy

from tetopt.geometry.simplex import orient_cells
from tetopt.image import transform_vectors
from tetopt.system.arrays import Floats, Ints

TIE_BREAK = 1e-7  # of the squared typical edge


def delaunay(index: Floats, affine: Floats) -> Ints | None:
    """Delaunay cells of nodes in index space, with cospherical ties broken so that no cell is flat.

    The Delaunay tessellation is the lower hull of the nodes lifted to (x, |x|^2) (Brown 1979). The
    lift is linear in x apart from the height, so x may stay in index space, where the box's faces
    are coordinate planes and nodes on them are coplanar to the last bit, with |x|^2 measured in mm.
    Lattices are full of cospherical nodes, which Qhull turns into flat cells. Raising each node by
    a tiny fixed pseudo-random height (1e-7 of the squared typical edge; a regular triangulation
    with those weights) leaves no ties, moves no node, and makes Qhull faster. Cells that are
    Delaunay by more than that margin are not affected.

    Parameters
    ----------
    index : (N, n) float64
        Node positions, index coordinates, including the corners of their bounding box.
    affine : (n+1, n+1) float64
        Index -> world mm.

    Returns
    -------
    (M, n+1) int64 or None
        Cells, positively oriented in the world; None if Qhull fails or omits a node. The caller
        must check that they fill the box.
    """
    n = index.shape[1]
    centred = index - 0.5 * (index.min(axis=0) + index.max(axis=0))
    world = transform_vectors(centred, affine[:-1, :-1])
    extent = float(np.abs(world).max())
    typical_edge = extent / len(index) ** (1.0 / n)
    weights = np.random.default_rng(len(index)).random(len(index)) * TIE_BREAK * typical_edge**2
    height = (world**2).sum(axis=1) + weights
    height = (height - height.min()) / np.ptp(height)
    lifted = np.column_stack([centred / np.abs(centred).max(), height])
    try:
        hull = scipy.spatial.ConvexHull(lifted)
    except scipy.spatial.QhullError:
        return None
    # 0, up to rounding, for faces of the box, which are vertical
    is_lower = hull.equations[:, n] < -1e-9
    cells = orient_cells(world, hull.simplices[is_lower])
    # Qhull's order of cells depends on its version; a sorted one does not.
    cells = cells[np.lexsort(np.sort(cells, axis=1).T[::-1])]
    return cells if len(np.unique(cells)) == len(index) else None
