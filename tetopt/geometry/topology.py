"""Adjacency of cells and nodes: facets, stars, colours and connected sets, from cells alone."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.geometry.simplex import facet_nodes
from tetopt.system.arrays import Bools, Ints
from tetopt.system.kernel_cache import njit

MOST_BY_INSERTION = 100  # facets with the same lowest node; more are sorted
LARGEST_RATIO = 4  # largest node number over the number of nodes, beyond which nodes are renumbered


class Stars(NamedTuple):
    """The cells around each node, Omega_i, as compressed rows.

    The cells of node i are ``cells[start[i]:start[i + 1]]``, ascending.
    """

    start: Ints  # (N+1,)
    cells: Ints  # (M * (n+1),)


class Facets(NamedTuple):
    """The distinct facets of a mesh and the cells that they belong to."""

    nodes: Ints  # (F, n), each row ascending; rows in lexicographic order
    cells: Ints  # (F, 2), the second is -1 on the boundary
    n_cells: Ints  # (F,), number of cells that share it: 1 or 2 in a conforming mesh
    of_cell: Ints  # (M, n+1), the facet opposite each local node
    # (M, n+1), +1 where the facet's nodes as listed face out of the cell, else -1
    sign: Ints


def stars(cells: NDArray[np.integer], n_nodes: int) -> Stars:
    """The star of each of `n_nodes` nodes: the cells around it."""
    order, start = _by_number(np.ascontiguousarray(cells, dtype=np.int64).ravel(), n_nodes)
    return Stars(start, order // cells.shape[1])


@njit(cache=True, nogil=True)
def _by_number(numbers: NDArray, n: int) -> tuple[NDArray, NDArray]:
    """Stable order (K,) of numbers below `n`, and the start of each number in it, (n+1,)."""
    start = np.zeros(n + 2, dtype=np.int64)
    for number in numbers:
        start[number + 2] += 1
    for i in range(2, n + 2):
        start[i] += start[i - 1]
    order = np.empty(len(numbers), dtype=np.int64)
    for i in range(len(numbers)):
        order[start[numbers[i] + 1]] = i
        start[numbers[i] + 1] += 1
    return order, start[: n + 1]


def compact(cells: Ints, n_nodes: int) -> tuple[Ints, Ints]:
    """The nodes, out of `n_nodes`, that cells use, ascending, and the cells with nodes numbered
    among these.
    """
    is_used = np.zeros(n_nodes, dtype=bool)
    is_used[cells] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[cells]


def split_nodes(cells: Ints, part: Ints) -> tuple[Ints, Ints, Bools]:
    """Give the cells of each part nodes of their own; `part` (M,) numbers them from 0.

    Returns the previous number of each node, (N',), the cells with the new nodes, and a mask of
    the nodes that several parts had, (N',).
    """
    n_parts = int(part.max(initial=0)) + 1
    pairs, number = np.unique(cells * n_parts + part[:, None], return_inverse=True)
    before = pairs // n_parts
    return before, number.reshape(cells.shape), np.bincount(before)[before] > 1


def facets(cells: NDArray[np.integer]) -> Facets:
    """Distinct facets of positively oriented cells (M, n+1).

    A facet (a, b) faces the side to the right of a -> b in 2-D; (a, b, c) the side of (b - a) x (c
    - a) in 3-D.
    """
    rows, sign = _facet_rows(
        np.ascontiguousarray(cells, dtype=np.int64), np.array(facet_nodes(cells.shape[1] - 1))
    )
    order, is_first = lexicographic_order(rows)
    n_cells = np.diff(np.append(np.flatnonzero(is_first), len(order)))
    nodes, sides, of_cell = _listed_facets(order, is_first, rows, sign)
    return Facets(nodes, sides, n_cells, of_cell, sign)


@njit(cache=True, nogil=True)
def _facet_rows(cells: NDArray, local: NDArray) -> tuple[NDArray, NDArray]:
    """The nodes of all facets, each row ascending, (M (n+1), n), and the signs (M, n+1) of
    `Facets`.

    Facet k of a positively oriented simplex, its nodes in local order, faces outwards for even k.
    """
    n = local.shape[1]
    rows, sign = np.empty((cells.size, n), dtype=np.int64), np.empty(cells.shape, dtype=np.int64)
    for cell in range(len(cells)):
        for k in range(n + 1):
            row, turns = rows[cell * (n + 1) + k], 1 - 2 * (k % 2)
            for d in range(n):
                m, node = d, cells[cell, local[k, d]]
                while m > 0 and row[m - 1] > node:  # each exchange reverses the facet
                    row[m] = row[m - 1]
                    m, turns = m - 1, -turns
                row[m] = node
            sign[cell, k] = turns
    return rows, sign


def lexicographic_order(rows: Ints) -> tuple[Ints, Bools]:
    """Stable order of rows (K, n) of numbers from 0, and True for the first of equal rows in it."""
    if rows.max(initial=0) > LARGEST_RATIO * rows.size:
        rows = np.unique(rows, return_inverse=True)[1].reshape(rows.shape)
    order, start = _by_number(rows[:, 0], int(rows[:, 0].max(initial=-1)) + 1)
    return order, _sorted_within(order, start, rows)


@njit(cache=True, nogil=True)
def _sorted_within(order: NDArray, start: NDArray, rows: NDArray) -> NDArray:
    """Sort rows that begin with the same number by the others, in place; return the first of each
    kind, (K,).

    Insertion sort of about a dozen rows each; with the counting sort of the first numbers it takes
    a fifth of the time of sorting all.
    """
    is_first, base = np.ones(len(order), dtype=np.bool_), rows.max() + 1 if len(rows) > 0 else 1
    key = np.zeros(max(np.diff(start).max(), 1) if len(start) > 1 else 1, dtype=np.int64)
    for number in range(len(start) - 1):
        begin, size = start[number], start[number + 1] - start[number]
        for i in range(size):
            key[i] = 0
            for d in range(1, rows.shape[1]):
                key[i] = key[i] * base + rows[order[begin + i], d]
        if size > MOST_BY_INSERTION:
            place = np.argsort(key[:size], kind="mergesort")
            key[:size], order[begin : begin + size] = key[place], order[begin + place]
        for i in range(1, size if size <= MOST_BY_INSERTION else 0):
            own, of_own, m = order[begin + i], key[i], i
            while m > 0 and of_own < key[m - 1]:
                order[begin + m], key[m] = order[begin + m - 1], key[m - 1]
                m -= 1
            order[begin + m], key[m] = own, of_own
        for i in range(1, size):
            is_first[begin + i] = key[i - 1] < key[i]
    return is_first


@njit(cache=True, nogil=True)
def _listed_facets(
    order: NDArray, is_first: NDArray, rows: NDArray, sign: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Nodes, cells and facets by cell, as in `Facets`, from the order of the facets of all
    cells.
    """
    n_facets, n = is_first.sum(), rows.shape[1]
    nodes, of_cell = np.empty((n_facets, n), dtype=np.int64), np.empty(sign.shape, dtype=np.int64)
    sides, facet, n_here = np.full((n_facets, 2), -1, dtype=np.int64), -1, 0
    for i in range(len(order)):
        cell = order[i] // (n + 1)
        if is_first[i]:
            facet, n_here = facet + 1, 0
            for d in range(n):
                nodes[facet, d] = rows[order[i], d]
        if n_here < 2:
            sides[facet, n_here] = cell
        n_here += 1
        of_cell[cell, order[i] - cell * (n + 1)] = facet
    return nodes, sides, of_cell


def folded_groups(cells: NDArray[np.integer], shared: Facets | None = None) -> Ints:
    """Groups of cells that do not lie on opposite sides of the facet they share, (K, 2) int64, by
    facet.

    Positively oriented cells do so where the mesh folds over itself, or where three or more share a
    facet. Empty for a conforming mesh. `shared` are the cells' facets, if already known.
    """
    shared = facets(cells) if shared is None else shared
    sides = np.bincount(
        shared.of_cell.ravel(), weights=shared.sign.ravel(), minlength=len(shared.nodes)
    )
    return shared.cells[(shared.n_cells > 2) | ((shared.n_cells == 2) & (sides != 0.0))]


def boundary_facets(cells: NDArray[np.integer], shared: Facets | None = None) -> Ints:
    """Nodes of the facets that belong to one cell only, (B, n) int64, turned to face outwards.

    For positively oriented cells the normals of the returned triangles (edges in 2-D) point
    outwards. `shared` are the cells' facets, if already known.
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

    `start` and `star_cells` are the rows of `Stars`, cells int64 and contiguous. Greedy in node
    order, so that the same mesh always gets the same colours. Nodes of one colour can move at the
    same time: their stars share no cell.
    """
    n_nodes = len(start) - 1
    colours = np.full(n_nodes, -1, dtype=np.int64)
    # the last node with a neighbour of this colour
    taken_by = np.full(n_nodes + 1, -1, dtype=np.int64)
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


def connected_sets(one: Ints, other: Ints, n: int) -> tuple[int, Ints]:
    """Number of connected sets of n items linked in pairs one[i], other[i], and the set of each
    item, (n,).
    """
    graph = scipy.sparse.coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(n, n))
    count, number = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return int(count), number.astype(np.int64)


def components(cells: NDArray[np.integer], shared: Facets | None = None) -> Ints:
    """The connected set of each cell, (M,) int64; cells that share a facet are connected.

    Sets are numbered from 0 in the order of their first cell. `shared` are the cells' facets, if
    already known.
    """
    sides = (facets(cells) if shared is None else shared).cells
    sides = sides[sides[:, 1] >= 0]
    _, number = connected_sets(sides[:, 0], sides[:, 1], len(cells))
    _, first, inverse = np.unique(number, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def euler_characteristic(surface_facets: Ints) -> int:
    """Points minus edges plus triangles of a surface (T, 3); points minus segments of a curve
    (T, 2).
    """
    if len(surface_facets) == 0:
        return 0
    nodes, total = np.sort(surface_facets, axis=1).T, 0
    for size in range(1, len(nodes) + 1):
        chosen = np.array(list(combinations(range(len(nodes)), size)))
        is_new = lexicographic_order(
            np.column_stack([nodes[column].ravel() for column in chosen.T])
        )[1]
        total += (-1) ** (size - 1) * int(np.count_nonzero(is_new))
    return total


def cell_euler(cells: NDArray[np.integer], shared: Facets | None = None) -> int:
    """Euler number of the closed surface of cells that are connected by facets: 2 (components -
    holes + cavities).

    It is twice the Euler number of the enclosed solid: cells, minus facets between them, plus inner
    edges, minus inner nodes. In 2-D: cells, minus segments between them, plus inner nodes. `shared`
    are the cells' `facets`, if known.
    """
    shared = facets(cells) if shared is None else shared
    outer = euler_characteristic(boundary_facets(cells, shared))
    inner = euler_characteristic(shared.nodes) - outer
    return 2 * (len(cells) + (-1) ** (cells.shape[1] - 1) * inner)


def largest_component(cells: NDArray[np.integer], is_chosen: Bools) -> Ints:
    """Indices of the largest facet-connected set among the chosen cells, ascending; the first of
    equal sets.

    The paper displays the ventricles so, Fig. 3(f), choosing cells with a mean below a threshold.
    """
    chosen = np.flatnonzero(is_chosen)
    if len(chosen) == 0:
        return chosen
    number = components(cells[chosen])
    return chosen[number == np.bincount(number).argmax()]
