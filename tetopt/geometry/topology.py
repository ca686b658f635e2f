"""Who touches whom: facets, rings, colours and connected sets, from cells alone."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tetopt.geometry.simplex import facet_nodes


class Rings(NamedTuple):
    """The cells around each node, Omega_i, as compressed rows.

    The cells of node i are ``cells[start[i]:start[i + 1]]``, ascending.
    """

    start: NDArray[np.int64]  # (N+1,)
    cells: NDArray[np.int64]  # (M * (n+1),)


class Facets(NamedTuple):
    """The distinct facets of a mesh and the cells on their sides."""

    nodes: NDArray[np.int64]  # (F, n), each row ascending
    cells: NDArray[np.int64]  # (F, 2), the second is -1 on the boundary
    n_cells: NDArray[np.int64]  # (F,), cells that share it: 1 or 2 in a conforming mesh


def rings(cells: NDArray[np.integer], n_nodes: int) -> Rings:
    """The 1-ring of cells around each of `n_nodes` nodes."""
    order = np.argsort(cells.ravel(), kind="stable")
    counts = np.bincount(cells.ravel(), minlength=n_nodes)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Rings(start, (order // cells.shape[1]).astype(np.int64))


def facets(cells: NDArray[np.integer]) -> Facets:
    """Distinct facets of (M, n+1) cells, in lexicographic order of their sorted nodes."""
    n = cells.shape[1] - 1
    every = np.sort(cells[:, facet_nodes(n)].reshape(-1, n), axis=1).astype(np.int64)
    owner = np.repeat(np.arange(len(cells), dtype=np.int64), n + 1)
    order = np.lexsort(every.T[::-1])
    every, owner = every[order], owner[order]
    is_first = np.concatenate([[True], (every[1:] != every[:-1]).any(axis=1)])
    first = np.flatnonzero(is_first)
    n_cells = np.diff(np.append(first, len(every)))
    second = np.where(n_cells > 1, owner[np.minimum(first + 1, len(owner) - 1)], -1)
    return Facets(every[first], np.column_stack([owner[first], second]), n_cells)


def boundary_facets(cells: NDArray[np.integer]) -> NDArray[np.int64]:
    """Nodes of the facets that belong to one cell only, (B, n) int64, turned to face outwards.

    For positively oriented cells the returned triangles (edges in 2-D) have their normal pointing out.
    """
    n = cells.shape[1] - 1
    every = cells[:, facet_nodes(n)].reshape(-1, n).astype(np.int64)
    # Facet i of a positively oriented simplex, its nodes in ascending local order, faces outwards for even i in
    # 2-D (node order then runs counter-clockwise) and for even i in 3-D; odd ones need two nodes swapped.
    is_odd = np.tile(np.arange(n + 1) % 2 == 1, len(cells))
    every[is_odd, :2] = every[is_odd, 1::-1]
    key = np.sort(every, axis=1)
    order = np.lexsort(key.T[::-1])
    key = key[order]
    same_as_next = np.concatenate([(key[1:] == key[:-1]).all(axis=1), [False]])
    is_single = ~same_as_next & ~np.concatenate([[False], same_as_next[:-1]])
    return every[np.sort(order[is_single])]


def node_colours(cells: NDArray[np.integer], around: Rings) -> NDArray[np.int64]:
    """A colour for each node, (N,) int64 from 0, such that no two nodes of one cell share one.

    Greedy in node order, so the same mesh always gets the same colours. Nodes of one colour can move at the
    same time: their rings have no cell in common.
    """
    return _greedy_colours(np.ascontiguousarray(cells, dtype=np.int64), around.start, around.cells)


@numba.njit(cache=True)
def _greedy_colours(cells: NDArray, start: NDArray, ring_cells: NDArray) -> NDArray:
    n_nodes = len(start) - 1
    colours = np.full(n_nodes, -1, dtype=np.int64)
    taken_by = np.full(n_nodes + 1, -1, dtype=np.int64)  # the last node that saw this colour beside it
    for node in range(n_nodes):
        for r in range(start[node], start[node + 1]):
            for k in range(cells.shape[1]):
                other = colours[cells[ring_cells[r], k]]
                if other >= 0:
                    taken_by[other] = node
        colour = 0
        while taken_by[colour] == node:
            colour += 1
        colours[node] = colour
    return colours


def components(cells: NDArray[np.integer]) -> NDArray[np.int64]:
    """Number of the connected set each cell belongs to, (M,) int64; cells that share a facet are connected.

    Sets are numbered from 0 in the order of their first cell.
    """
    sides = facets(cells).cells
    sides = sides[sides[:, 1] >= 0]
    graph = coo_array((np.ones(len(sides), dtype=np.int8), (sides[:, 0], sides[:, 1])), shape=(len(cells),) * 2)
    _, number = connected_components(graph, directed=False)
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
