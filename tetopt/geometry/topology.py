"""Who touches whom: facets, stars, colours and connected sets, from cells alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.geometry.simplex import facet_nodes
from tetopt.system.kernel_cache import njit


class Stars(NamedTuple):
    """The cells around each node, Omega_i, as compressed rows.

    The cells of node i are ``cells[start[i]:start[i + 1]]``, ascending.
    """

    start: NDArray[np.int64]  # (N+1,)
    cells: NDArray[np.int64]  # (M * (n+1),)


class Facets(NamedTuple):
    """The distinct facets of a mesh and the cells that they belong to."""

    nodes: NDArray[np.int64]  # (F, n), each row ascending; rows in lexicographic order
    cells: NDArray[np.int64]  # (F, 2), the second is -1 on the boundary
    n_cells: NDArray[np.int64]  # (F,), cells that share it: 1 or 2 in a conforming mesh
    of_cell: NDArray[np.int64]  # (M, n+1), the facet opposite each local node
    sign: NDArray[np.int64]  # (M, n+1), +1 where the facet's nodes as listed face out of the cell, else -1


def stars(cells: NDArray[np.integer], n_nodes: int) -> Stars:
    """The star of each of `n_nodes` nodes: the cells around it."""
    order = np.argsort(cells.ravel(), kind="stable")
    counts = np.bincount(cells.ravel(), minlength=n_nodes)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Stars(start, (order // cells.shape[1]).astype(np.int64))


def compact(cells: NDArray[np.int64], n_nodes: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The nodes, of `n_nodes`, that cells use, ascending, and the cells by the places of their nodes among these."""
    is_used = np.zeros(n_nodes, dtype=bool)
    is_used[cells] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[cells]


def facets(cells: NDArray[np.integer]) -> Facets:
    """Distinct facets of positively oriented cells (M, n+1).

    A facet (a, b) faces the side to the right of a -> b in 2-D; (a, b, c) the side of (b - a) x (c - a) in 3-D.
    """
    n = cells.shape[1] - 1
    nodes = np.array(facet_nodes(n))
    # Facet k of a positively oriented simplex, its nodes in local order, faces outwards for even k.
    sign = np.broadcast_to(np.where(np.arange(n + 1) % 2 == 0, 1, -1), cells.shape)
    columns = [cells[:, nodes[:, d]].astype(np.int64) for d in range(n)]  # of the nodes of all facets
    for i, k in ((0, 1), (1, 2), (0, 1))[: 2 * n - 3]:  # sorted by exchanges, each of which turns the facet around
        sign = np.where(columns[i] < columns[k], sign, -sign)
        columns[i], columns[k] = np.minimum(columns[i], columns[k]), np.maximum(columns[i], columns[k])
    columns = [column.ravel() for column in columns]
    order, is_first = lexicographic_order(columns)
    of_cell = np.empty(len(order), dtype=np.int64)
    of_cell[order] = np.cumsum(is_first) - 1
    first = np.flatnonzero(is_first)
    n_cells = np.diff(np.append(first, len(order)))
    owner = order // (n + 1)
    second = np.where(n_cells > 1, owner[np.minimum(first + 1, len(owner) - 1)], -1)
    sides = np.column_stack([owner[first], second])
    listed = np.column_stack([column[order[first]] for column in columns])
    return Facets(listed, sides, n_cells, of_cell.reshape(cells.shape), sign)


def lexicographic_order(columns: list[NDArray[np.int64]]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Stable order of rows of node numbers, (n,) columns (K,), and whether each row in it is the first of its kind."""
    base = max(int(column.max()) for column in columns) + 1
    if base ** len(columns) >= 2**63:
        order = np.lexsort(columns[::-1])
        is_new = [column[order[1:]] != column[order[:-1]] for column in columns]
        return order, np.concatenate([[True], np.logical_or.reduce(is_new)])
    key = columns[0].copy()  # one number a row: ten times faster
    for column in columns[1:]:
        key = key * base + column
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    return order, np.concatenate([[True], ordered[1:] != ordered[:-1]])


def folded(cells: NDArray[np.integer], shared: Facets | None = None) -> NDArray[np.int64]:
    """Groups of cells that do not lie on opposite sides of the facet they share, (K, 2) int64, by facet.

    Of positively oriented cells: where the mesh folds over itself, or three cells and more share a facet. Empty for a
    conforming mesh. `shared` are the cells' facets where they are known already.
    """
    shared = facets(cells) if shared is None else shared
    sides = np.bincount(shared.of_cell.ravel(), weights=shared.sign.ravel(), minlength=len(shared.nodes))
    return shared.cells[(shared.n_cells > 2) | ((shared.n_cells == 2) & (sides != 0.0))]


def boundary_facets(cells: NDArray[np.integer], shared: Facets | None = None) -> NDArray[np.int64]:
    """Nodes of the facets that belong to one cell only, (B, n) int64, turned to face outwards.

    For positively oriented cells the returned triangles (edges in 2-D) have their normal pointing out. `shared` are
    the cells' facets where they are known already.
    """
    shared = facets(cells) if shared is None else shared
    is_outer = shared.n_cells == 1
    outer = shared.nodes[is_outer]
    sign = np.empty(len(shared.nodes), dtype=np.int64)
    sign[shared.of_cell] = shared.sign
    is_inward = sign[is_outer] < 0
    outer[is_inward, :2] = outer[is_inward, 1::-1]
    return outer


@njit(cache=True)
def greedy_colours(cells: NDArray, start: NDArray, star_cells: NDArray) -> NDArray:
    """A colour for each node, (N,) int64 from 0, such that no two nodes of one cell share one.

    `start` and `star_cells` are the rows of `Stars`, cells int64 and contiguous. Greedy in node order, so the same mesh
    always gets the same colours. Nodes of one colour can move at the same time: their stars have no cell in common.
    """
    n_nodes = len(start) - 1
    colours = np.full(n_nodes, -1, dtype=np.int64)
    taken_by = np.full(n_nodes + 1, -1, dtype=np.int64)  # the last node that saw this colour beside it
    for node in range(n_nodes):
        for r in range(start[node], start[node + 1]):
            for k in range(cells.shape[1]):
                other = colours[cells[star_cells[r], k]]
                if other >= 0:
                    taken_by[other] = node
        colour = 0
        while taken_by[colour] == node:
            colour += 1
        colours[node] = colour
    return colours


def linked(one: NDArray[np.int64], other: NDArray[np.int64], n: int) -> tuple[int, NDArray[np.int64]]:
    """How many connected sets n things fall into, of which one[i] and other[i] are linked, and each thing's, (n,)."""
    graph = scipy.sparse.coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(n, n))
    count, number = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return int(count), number.astype(np.int64)


def components(cells: NDArray[np.integer]) -> NDArray[np.int64]:
    """Number of the connected set each cell belongs to, (M,) int64; cells that share a facet are connected.

    Sets are numbered from 0 in the order of their first cell.
    """
    sides = facets(cells).cells
    sides = sides[sides[:, 1] >= 0]
    _, number = linked(sides[:, 0], sides[:, 1], len(cells))
    _, first, inverse = np.unique(number, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def largest_component(cells: NDArray[np.integer], is_chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Indices of the largest facet-connected set among the chosen cells, ascending; the first of equals.

    The paper's display of the ventricles, Fig. 3(f): chosen are the cells with a mean below a threshold.
    """
    chosen = np.flatnonzero(is_chosen)
    if len(chosen) == 0:
        return chosen
    number = components(cells[chosen])
    return chosen[number == np.bincount(number).argmax()]
