"""The surfaces between the labels of a mesh's cells, and where they are no manifolds.

A facet between two labels is in the surface of both, turned out of either; on the boundary the other is
`OUTSIDE_LABEL`, which has a surface as labels do. A ridge is where facets of a surface meet: an edge of triangles, a
node of segments. In a manifold without a rim two facets meet at each ridge, and those around a node are one fan.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.geometry.simplex import facet_nodes
from tetopt.geometry.topology import Facets

OUTSIDE_LABEL = -1  # what lies beyond the boundary, among labels, which are 0 and more


class LabelSurfaces(NamedTuple):
    """The surface of each label, facet by facet."""

    label: NDArray[np.int64]  # (S,), `OUTSIDE_LABEL` for the boundary seen from without
    beyond: NDArray[np.int64]  # (S,), the label on the other side
    nodes: NDArray[np.int64]  # (S, n), turned to face out of the label


class Ridges(NamedTuple):
    """Where the facets of each label's surface meet, those of each label apart."""

    label: NDArray[np.int64]  # (R,)
    nodes: NDArray[np.int64]  # (R, n-1), ascending
    n_facets: NDArray[np.int64]  # (R,), of that label that meet there
    n_labels: NDArray[np.int64]  # (R,), that meet there, `OUTSIDE_LABEL` among them
    of_facet: NDArray[np.int64]  # (S, n), ridge opposite each of a facet's nodes


class Fans(NamedTuple):
    """The nodes of each label's surface."""

    label: NDArray[np.int64]  # (P,)
    node: NDArray[np.int64]  # (P,)
    n_fans: NDArray[np.int64]  # (P,), connected sets of the label's facets around it, over the ridges that end there
    n_labels: NDArray[np.int64]  # (P,), that meet there, `OUTSIDE_LABEL` among them


def label_surfaces(shared: Facets, of_cell: NDArray[np.integer]) -> LabelSurfaces:
    """The facets of each label's surface.

    Parameters
    ----------
    shared : Facets
        Of a conforming mesh, see `tetopt.geometry.topology.facets`.
    of_cell : (M,) integers
        Label of each cell, 0 or more.
    """
    sides = np.where(shared.cells >= 0, of_cell[shared.cells], OUTSIDE_LABEL).astype(np.int64)
    between = np.flatnonzero(sides[:, 0] != sides[:, 1])
    first = shared.cells[between, 0]
    is_outward = (shared.sign[first] * (shared.of_cell[first] == between[:, None])).sum(axis=1, keepdims=True) > 0
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
    key = (surfaces.label[:, None] - OUTSIDE_LABEL) * step + place
    distinct, of_facet, n_facets = np.unique(key.ravel(), return_inverse=True, return_counts=True)
    label, place = np.divmod(distinct, step)
    at = place[:, None] if n == 2 else np.column_stack(np.divmod(place, base))
    return Ridges(label + OUTSIDE_LABEL, at, n_facets, _times(place), of_facet.reshape(-1, n))


def surface_fans(surfaces: LabelSurfaces, ridges: Ridges) -> Fans:
    """The fans around each node of each label's surface, by label."""
    n = surfaces.nodes.shape[1]
    local = np.array(facet_nodes(n - 1))
    # A corner is a facet at one of its nodes; those of two facets that share a ridge are linked at each of its ends.
    order = np.argsort(surfaces.nodes[:, local], axis=2)
    corner = np.arange(len(surfaces.nodes))[:, None, None] * n + np.take_along_axis(
        np.broadcast_to(local, order.shape), order, axis=2
    )
    by_ridge = np.argsort(ridges.of_facet.ravel(), kind="stable")
    ridge, ends = ridges.of_facet.ravel()[by_ridge], corner.reshape(-1, n - 1)[by_ridge]
    is_same = ridge[1:] == ridge[:-1]
    link = (ends[:-1][is_same].ravel(), ends[1:][is_same].ravel())
    graph = scipy.sparse.coo_array((np.ones(len(link[0]), dtype=np.int8), link), shape=(surfaces.nodes.size,) * 2)
    n_fans, fan = scipy.sparse.csgraph.connected_components(graph, directed=False)
    base = int(surfaces.nodes.max(initial=0)) + 1
    key = np.empty(n_fans, dtype=np.int64)
    key[fan] = ((surfaces.label[:, None] - OUTSIDE_LABEL) * base + surfaces.nodes).ravel()
    distinct, count = np.unique(key, return_counts=True)
    label, node = np.divmod(distinct, base)
    return Fans(label + OUTSIDE_LABEL, node, count, _times(node))


def _times(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """How often each value occurs in all, at each."""
    _, which, count = np.unique(values, return_inverse=True, return_counts=True)
    return count[which]
