"""The surfaces between the labels of a mesh's cells, and the places where they are not manifold.

A facet between two labels belongs to the surface of both and faces out of either; on the boundary
the other label is `OUTSIDE_LABEL`, which has a surface, too. Facets of a surface meet at ridges:
edges of triangles, nodes of segments. In a manifold without a rim two facets meet at each ridge,
and the facets around a node form one fan.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterable
from itertools import combinations
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from tetopt.geometry.simplex import facet_nodes
from tetopt.geometry.topology import Facets, connected_sets, facets, stars
from tetopt.system.arrays import Bools, Floats, Ints

_Key = TypeVar("_Key", bound=Hashable)

OUTSIDE_LABEL = -1  # stands for the space beyond the boundary; labels are 0 and more


class LabelSurfaces(NamedTuple):
    """The surface of each label, facet by facet."""

    label: Ints  # (S,), `OUTSIDE_LABEL` for the boundary seen from without
    beyond: Ints  # (S,), the label on the other side
    nodes: Ints  # (S, n), turned to face out of the label


class Ridges(NamedTuple):
    """Ridges at which facets of one label's surface meet, listed separately for each label."""

    label: Ints  # (R,)
    nodes: Ints  # (R, n-1), ascending
    n_facets: Ints  # (R,), facets of that label that meet there
    n_labels: Ints  # (R,), labels that meet there, including `OUTSIDE_LABEL`
    of_facet: Ints  # (S, n), ridge opposite each of a facet's nodes


class Fans(NamedTuple):
    """The nodes of each label's surface."""

    label: Ints  # (P,)
    node: Ints  # (P,)
    # (P,), connected sets of the label's facets around it, over the ridges that end there
    n_fans: Ints
    n_labels: Ints  # (P,), labels that meet there, including `OUTSIDE_LABEL`


def label_surfaces(shared: Facets, of_cell: NDArray[np.integer]) -> LabelSurfaces:
    """The facets of each label's surface.

    Parameters
    ----------
    shared : Facets
        Facets of a conforming mesh, see `tetopt.geometry.topology.facets`.
    of_cell : (M,) integers
        Label of each cell, 0 or more.
    """
    sides = np.where(shared.cells >= 0, of_cell[shared.cells], OUTSIDE_LABEL).astype(np.int64)
    between = np.flatnonzero(sides[:, 0] != sides[:, 1])
    first = shared.cells[between, 0]
    is_outward = (shared.sign[first] * (shared.of_cell[first] == between[:, None])).sum(
        axis=1, keepdims=True
    ) > 0
    nodes = shared.nodes[between]
    turned = nodes.copy()
    turned[:, :2] = nodes[:, 1::-1]
    near, far = sides[between].T
    return LabelSurfaces(
        np.concatenate([near, far]),
        np.concatenate([far, near]),
        np.vstack([np.where(is_outward, nodes, turned), np.where(is_outward, turned, nodes)]),
    )


def surface_ridges(surfaces: LabelSurfaces) -> Ridges:
    """The ridges of each label's surface, by label."""
    n = surfaces.nodes.shape[1]
    base = int(surfaces.nodes.max(initial=0)) + 1
    nodes = np.sort(surfaces.nodes[:, np.array(facet_nodes(n - 1))], axis=2)  # (S, n, n-1)
    place = nodes[..., 0] if n == 2 else nodes[..., 0] * base + nodes[..., 1]
    step = base ** (n - 1)
    # rows, as large labels would overflow the key
    labels, row = np.unique(surfaces.label, return_inverse=True)
    key = row.reshape(-1, 1) * step + place
    distinct, of_facet, n_facets = np.unique(key.ravel(), return_inverse=True, return_counts=True)
    row, place = np.divmod(distinct, step)
    at = place[:, None] if n == 2 else np.column_stack(np.divmod(place, base))
    return Ridges(labels[row], at, n_facets, _times(place), of_facet.reshape(-1, n))


def surface_fans(surfaces: LabelSurfaces, ridges: Ridges) -> Fans:
    """The fans around each node of each label's surface, by label."""
    n = surfaces.nodes.shape[1]
    local = np.array(facet_nodes(n - 1))
    # A corner is a facet at one of its nodes; those of two facets that share a ridge are linked at
    # each of its ends.
    order = np.argsort(surfaces.nodes[:, local], axis=2)
    corner = np.arange(len(surfaces.nodes))[:, None, None] * n + np.take_along_axis(
        np.broadcast_to(local, order.shape), order, axis=2
    )
    by_ridge = np.argsort(ridges.of_facet.ravel(), kind="stable")
    ridge, ends = ridges.of_facet.ravel()[by_ridge], corner.reshape(-1, n - 1)[by_ridge]
    is_same = ridge[1:] == ridge[:-1]
    n_fans, fan = connected_sets(
        ends[:-1][is_same].ravel(), ends[1:][is_same].ravel(), surfaces.nodes.size
    )
    base = int(surfaces.nodes.max(initial=0)) + 1
    key = np.empty(n_fans, dtype=np.int64)
    key[fan] = ((surfaces.label[:, None] - OUTSIDE_LABEL) * base + surfaces.nodes).ravel()
    distinct, count = np.unique(key, return_counts=True)
    label, node = np.divmod(distinct, base)
    return Fans(label + OUTSIDE_LABEL, node, count, _times(node))


class Pinches(NamedTuple):
    """Ridges, or nodes, at which a surface between exactly two labels is not a manifold."""

    labels: Ints  # (K, 2), ascending, may include `OUTSIDE_LABEL`
    nodes: Ints  # (K, n-1) of ridges, (K, 1) of nodes


def pinches(shared: Facets, of_cell: NDArray[np.integer]) -> tuple[Pinches, Pinches]:
    """Ridges in more than two facets of a surface, and nodes around which its facets form several
    fans.

    Surfaces end where three or more labels meet, so those places are skipped. Arguments as for
    `label_surfaces`.
    """
    surfaces = label_surfaces(shared, of_cell)
    ridges = surface_ridges(surfaces)
    fans = surface_fans(surfaces, ridges)
    both = []
    for label, nodes, is_bad in (
        (ridges.label, ridges.nodes, (ridges.n_facets > 2) & (ridges.n_labels == 2)),
        (fans.label, fans.node[:, None], (fans.n_fans > 1) & (fans.n_labels == 2)),
    ):
        rows = np.flatnonzero(is_bad)
        rows = rows[np.lexsort((label[rows], *nodes[rows].T[::-1]))]
        # The surfaces of the two labels have all facets there in common: each place is listed once
        # for either.
        both.append(Pinches(label[rows].reshape(-1, 2), nodes[rows[::2]]))
    return both[0], both[1]


def manifold_part(cells: Ints, size: Floats) -> Bools:
    """Select the cells to keep, (M,), so that the boundary of a conforming mesh is a manifold; few
    are dropped.

    Where several fans of cells surround an edge or a node of the boundary, the largest stays. Where
    the cells around a node form one fan but the outside does not, the cells between two parts of
    the outside are dropped.

    Parameters
    ----------
    cells : (M, n+1) int64
        Positively oriented.
    size : (M,) float64
        Volume of each cell.
    """
    shared, is_kept, n = facets(cells), np.ones(len(cells), dtype=bool), cells.shape[1] - 1
    at_ridges, at_nodes = pinches(shared, np.zeros(len(cells), dtype=np.int64))
    if len(at_ridges.nodes) + len(at_nodes.nodes) == 0:
        return is_kept
    sides = shared.cells[shared.of_cell]  # (M, n+1, 2)
    across = np.where(sides[..., 0] == np.arange(len(cells))[:, None], sides[..., 1], sides[..., 0])
    around = stars(cells, int(cells.max()) + 1)
    ridges, nodes = (deque(map(tuple, places.nodes.tolist())) for places in (at_ridges, at_nodes))
    while ridges or nodes:  # ridges first: at a node, those of the boundary are manifold
        place = ridges.popleft() if ridges else nodes.popleft()
        near = around.cells[around.start[place[0]] : around.start[place[0] + 1]].tolist()
        corners = {cell: cells[cell].tolist() for cell in near if is_kept[cell]}
        star = {
            cell: Corners(at, across[cell].tolist())
            for cell, at in corners.items()
            if set(place) <= set(at)
        }
        for cell in _cells_at_pinch(place, star, size):
            is_kept[cell] = False
            beyond = across[across[cell][across[cell] >= 0]]
            across[across[cell][across[cell] >= 0]] = np.where(beyond == cell, -1, beyond)
            nodes.extend((node,) for node in star[cell].nodes)
            if n == 3:
                ridges.extend(combinations(sorted(star[cell].nodes), 2))
    return is_kept


class Corners(NamedTuple):
    """A cell around a node or an edge."""

    nodes: list[int]
    across: list[int]  # cell beyond the facet opposite each node; -1 outside


def _cells_at_pinch(
    place: tuple[int, ...], star: dict[int, Corners], size: Floats
) -> Iterable[int]:
    """Cells of an edge's or a node's star to drop so that the boundary is a manifold there; none
    if it is.
    """
    links = {
        cell: [
            other
            for node, other in zip(*corners, strict=True)
            if node not in place and other in star
        ]
        for cell, corners in star.items()
    }
    fans = _connected_sets(links)
    if len(fans) > 1:
        largest = max(fans, key=lambda fan: (size[fan].sum(), -fan[0]))
        return [cell for fan in fans if fan is not largest for cell in fan]
    if len(place) > 1 or not star or len(next(iter(star.values())).nodes) == 3:
        return []  # around an edge, or a node of triangles, a fan has two ends or none
    # Facets of the boundary, by the node opposite; an edge that ends in the node links two.
    outer = [
        (cell, node)
        for cell, (nodes, across) in star.items()
        for node, other in zip(nodes, across, strict=True)
        if other < 0 and node not in place
    ]
    ends = {facet: {*star[facet[0]].nodes} - {facet[1], *place} for facet in outer}
    patches = _connected_sets(
        {facet: [other for other in outer if ends[facet] & ends[other]] for facet in outer}
    )
    if len(patches) < 2:
        return []
    return _way(
        links,
        {cell for cell, _ in patches[0]},
        {cell for patch in patches[1:] for cell, _ in patch},
    )


def _connected_sets(links: dict[_Key, list[_Key]]) -> list[list[_Key]]:
    """Connected sets of a graph, each starting with its first member."""
    sets: list[list[_Key]] = []
    seen: set[_Key] = set()
    for first in links:
        if first not in seen:
            members = [first]
            seen.add(first)
            for member in members:  # grows as it goes
                members += (
                    new := [other for other in dict.fromkeys(links[member]) if other not in seen]
                )
                seen.update(new)
            sets.append(members)
    return sets


def _way(links: dict[int, list[int]], begin: set[int], end: set[int]) -> list[int]:
    """The shortest path in a connected graph from one set of cells to another, including both
    ends.
    """
    before: dict[int, int | None] = dict.fromkeys(sorted(begin))
    for cell in (queue := list(before)):
        if cell in end:
            way = [cell]
            while (at := before[way[-1]]) is not None:
                way.append(at)
            return way
        new = [other for other in links[cell] if other not in before]
        before.update(dict.fromkeys(new, cell))
        queue += new
    return []


def _times(values: Ints) -> Ints:
    """The number of occurrences of each value, at each position."""
    _, which, count = np.unique(values, return_inverse=True, return_counts=True)
    return count[which]
