"""Rigid motions, and a check that constraints prevent all of them.

The null space of a constrained stiffness matrix is known in advance. Without strain, cells that
share a facet move as one rigid body; so the motions without strain are rigid motions of the
facet-connected sets of cells such that sets that share a node agree there and prescribed
displacements are 0. This is a small eigenvalue problem with six unknowns per set, whose answer
identifies loose cells, where a solver would only return large numbers.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.sparse import block_array, coo_array, csr_array
from scipy.sparse.linalg import eigsh

from tetopt.errors import InputError
from tetopt.geometry.topology import components, connected_sets
from tetopt.system.arrays import Bools, Floats, Ints

# Least squared violation of all constraints by a rigid motion of size 1; less is rounding, and the
# motion is free.
LOOSE_VIOLATION = 1e-11


def rigid_modes(points: Floats) -> Floats:
    """Rigid motions of points (N, n) as dofs, (N*n, 3) in 2-D and (N*n, 6) in 3-D: translations,
    then rotations.

    Rotations are about the centre, with the root mean square of a translation by 1.
    """
    n = points.shape[1]
    arms = points - points.mean(axis=0)
    size = np.sqrt((arms**2).sum(axis=1).mean())
    return _rigid_rows(arms / (size if size > 0.0 else 1.0)).reshape(len(points) * n, -1)


def _rigid_rows(arms: Floats) -> Floats:
    """Displacements (K, n, n(n+1)/2) of points with given arms (K, n) by translations and
    infinitesimal rotations.
    """
    n = arms.shape[1]
    rows = np.zeros((len(arms), n, n * (n + 1) // 2))
    rows[:, range(n), range(n)] = 1.0
    for turn, (i, j) in enumerate(combinations(range(n), 2), start=n):
        rows[:, i, turn] = -arms[:, j]
        rows[:, j, turn] = arms[:, i]
    return rows


def check_held(points: Floats, cells: Ints, is_prescribed: Bools) -> None:
    """Raise InputError if any part of the mesh can move without strain, as K_ff is singular then.

    Cells (M, A) may have either order, with their corners first; `is_prescribed` (N, n) is also
    True for springs.

    Without strain, cells that share a facet move as one rigid body. So a motion without strain
    consists of rigid motions of the facet-connected sets of cells such that sets that share a node
    agree there and prescribed dofs are 0.
    """
    is_used = np.zeros(len(points), dtype=bool)
    is_used[cells] = True
    unused = np.flatnonzero(~is_used & ~is_prescribed.all(axis=1))
    if len(unused):
        raise InputError(
            f"mesh: {len(unused)} nodes belong to no cell, the first {unused[:5].tolist()}; "
            "remove them"
        )
    if not is_prescribed.any():
        raise InputError(
            "mesh: no displacement or spring constrains it, so it can move freely; fix or support "
            "at least one set, for example with hold:SET or spring:SET:K"
        )
    body = components(cells[:, : points.shape[1] + 1])
    _check_pieces(cells, body, is_prescribed)
    weakest, loose = _weakest_hold(points, cells, body, is_prescribed)
    if weakest < LOOSE_VIOLATION:
        inside = np.flatnonzero(body == loose)
        raise InputError(
            f"mesh: {len(inside)} cells around cell {inside[0]} (node {cells[inside[0], 0]}) can "
            "still rotate or slide as a whole, as too few nodes connect them; fix more nodes or "
            "keep the largest facet-connected set"
        )


def _check_pieces(cells: Ints, body: Ints, is_prescribed: Bools) -> None:
    """Raise InputError if a component of cells connected by nodes has no prescribed dof."""
    n_bodies = int(body.max()) + 1
    bodies = np.repeat(body, cells.shape[1]) + len(is_prescribed)
    label = connected_sets(cells.ravel(), bodies, len(is_prescribed) + n_bodies)[1][
        : len(is_prescribed)
    ]
    is_held = np.isin(label, label[is_prescribed.any(axis=1)])
    loose = np.flatnonzero(~is_held[cells[:, 0]])
    if len(loose):
        piece = loose[label[cells[loose, 0]] == label[cells[loose[0], 0]]]
        n_pieces = len(np.unique(label[cells[loose, 0]]))
        raise InputError(
            f"mesh: {n_pieces} components have no node that is fixed, displaced or on a spring; "
            f"the first has {len(piece)} cells around cell {piece[0]} (node {cells[piece[0], 0]}); "
            "fix it or remove it"
        )


def _weakest_hold(
    points: Floats,
    cells: Ints,
    body: Ints,
    is_prescribed: Bools,
) -> tuple[float, int]:
    """Smallest sum of squared violations by a rigid motion of size 1 of the bodies, and the body
    that it moves most.
    """
    n = points.shape[1]
    incidence = np.unique(cells * (int(body.max()) + 1) + body[:, None])
    node, of_body = np.divmod(incidence, int(body.max()) + 1)
    # Arms about each body's centre, in units of its size.
    count = np.bincount(of_body)
    centre = np.column_stack([np.bincount(of_body, points[node, d]) / count for d in range(n)])
    arms = points[node] - centre[of_body]
    arms /= np.sqrt(np.bincount(of_body, (arms**2).sum(axis=1)) / count)[of_body, None]
    rows = _rigid_rows(arms)
    r = rows.shape[2]
    is_first = np.concatenate([[True], node[1:] != node[:-1]])

    def spread(which: Ints) -> csr_array:
        """Displacements of the given incidences by the bodies' motions, one row per component."""
        column = of_body[which, None, None] * r + np.arange(r)
        at = (np.arange(len(which))[:, None] * n + np.arange(n))[:, :, None]
        at, column = np.broadcast_arrays(at, column)
        shape = (len(which) * n, len(count) * r)
        return coo_array((rows[which].ravel(), (at.ravel(), column.ravel())), shape=shape).tocsr()

    leading = np.flatnonzero(is_first)
    joint = np.flatnonzero(~is_first)
    violations = block_array(
        [
            [spread(leading)[is_prescribed[node[leading]].ravel()]],
            [spread(joint - 1) - spread(joint)],
        ],
        format="csr",
    )
    gram = (violations.T @ violations).tocsc()
    if gram.shape[0] <= 120:
        values, vectors = np.linalg.eigh(gram.toarray())
    else:
        start = np.random.default_rng(0).standard_normal(gram.shape[0])
        values, vectors = eigsh(gram, k=1, sigma=-1e-6, v0=start)
    moved = (vectors[:, 0].reshape(-1, r) ** 2).sum(axis=1)
    return float(values[0]), int(np.argmax(moved))
