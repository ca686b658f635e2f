"""Cleaning of what a mesh's file holds: ghosts, nodes at one place, repeated cells, labels."""

from __future__ import annotations

import re

import numpy as np
import scipy

from tetopt.errors import InputError
from tetopt.geometry.quadratic import cell_edges
from tetopt.geometry.topology import boundary_facets, connected_sets, facets
from tetopt.io.raw import Raw
from tetopt.io.text import list_names
from tetopt.mesh import Mesh
from tetopt.model.label_names import LABEL_FIELD, labels_of
from tetopt.system.arrays import Arrays, Bools, Floats, Ints

GHOST_FIELD = "vtkGhostType"
# VTK's bits of cells that are elsewhere in the file, or not part of the mesh: DUPLICATECELL,
# REFINEDCELL, HIDDENCELL
GHOST_BITS = 1 | 8 | 32
# of the largest coordinate: a few roundings to single precision, or the sixth digit of a text
MERGE_FRACTION = 1e-6
# of the shortest edge at both nodes, so that no two nodes of a tiny cell are merged
MERGE_EDGE_FRACTION = 1e-3
# To find cells that touch others without common nodes: as many facets of the boundary, and nearest
# cells of the boundary for each; a point outside a facet, in sizes of it
PROBED_FACETS, PROBED_CELLS, PROBE_FRACTION = 4000, 32, 0.01
# Names of cell data with labels, in lower case without spaces and underscores, the most specific
# ones first.
LABEL_NAMES = """
label labels medit:ref gmsh:physical tissue tissues tissuetype regionid modelregionid region regions
materialid materialids matid material materials subdomain subdomains subdomainid domain domains
domainid cellentityids attribute attributes partid elemtag celltags cellmarkers segmentation seg tag
tags ref
"""


def without_ghosts(raw: Raw) -> Raw:
    """Return a file's contents without cells that VTK's ghost array marks as copies or hidden."""
    ghosts = raw.cell_data.get(GHOST_FIELD)
    if ghosts is None:
        return raw
    is_kept = {
        kind: (values.astype(np.int64) & GHOST_BITS).reshape(len(values), -1)[:, 0] == 0
        for kind, values in ghosts.items()
    }
    words = f"ghost cells ({GHOST_FIELD}): copies of other pieces' cells, or hidden"
    cell_data = {name: each for name, each in raw.cell_data.items() if name != GHOST_FIELD}
    return _with_rows(raw._replace(cell_data=cell_data), is_kept, words)


def without_copies(raw: Raw, kind: str) -> Raw:
    """Return a file's contents with one cell of a type for those with the same nodes."""
    cells = np.sort(raw.cells[kind], axis=1)
    order = np.lexsort(cells.T)  # stable: the first of its copies comes first
    is_first = np.append(True, (cells[order[1:]] != cells[order[:-1]]).any(axis=1))
    first = np.empty_like(order)
    first[order] = order[is_first][np.cumsum(is_first) - 1]
    groups = [  # which keep the cells that copies stand for
        group._replace(members=np.unique(first[group.members])) if group.kind == kind else group
        for group in raw.groups
    ]
    every = np.arange(len(cells))
    of_cells = {name: each[kind] for name, each in raw.cell_data.items() if kind in each}
    words = f"cells that repeat the nodes of others{_differing_words(of_cells, every, first)}"
    return _with_rows(raw._replace(groups=groups), {kind: first == every}, words)


def _differing_words(data: Arrays, those: Ints, first: Ints) -> str:
    """Return the end of a note on rows that `first` ones stand for: data that differ, if any."""
    differing = [
        name
        for name, values in data.items()
        if not np.array_equal(values[first], values[those], equal_nan=values.dtype.kind == "f")
    ]
    return f"; their {list_names(differing)} differ: using the first" if differing else ""


def _with_rows(raw: Raw, is_kept: dict[str, Bools], words: str) -> Raw:
    """Return a file's contents with the cells of some types that are kept, and a note on others."""
    n_left = sum(int((~each).sum()) for each in is_kept.values())
    if n_left == 0:
        return raw

    def own_rows(by_kind: Arrays) -> Arrays:
        rows = {
            kind: each[is_kept[kind]] if kind in is_kept else each for kind, each in by_kind.items()
        }
        return {kind: each for kind, each in rows.items() if len(each)}

    groups = []
    for group in raw.groups:
        if (each := is_kept.get(group.kind)) is not None:
            own = group.members[each[group.members]]
            group = group._replace(members=(np.cumsum(each) - 1)[own])
        groups.append(group)
    return raw._replace(
        cells=own_rows(raw.cells),
        middles=own_rows(raw.middles),
        cell_data={name: own_rows(by_kind) for name, by_kind in raw.cell_data.items()},
        groups=groups,
        notes=(*raw.notes, f"left out {n_left} {words}"),
    )


def with_merged_nodes(raw: Raw, kind: str) -> Raw:
    """Return a file's contents with one node for those that coincide within rounding.

    Parameters
    ----------
    raw : Raw
    kind : str
        The type of the mesh's cells.
    """
    points = raw.points
    corners = raw.cells[kind]
    middles = raw.middles.get(kind, np.empty((len(corners), 0), dtype=np.int64))
    nodes = np.concatenate([each.ravel() for each in (*raw.cells.values(), middles)])
    if nodes.min() < 0 or nodes.max() >= len(points):
        return raw  # refused when the mesh is made
    used = np.flatnonzero(np.bincount(nodes, minlength=len(points)))
    if not np.isfinite(points[used]).all():
        return raw  # as well
    tolerance = MERGE_FRACTION * float(np.abs(points[used]).max())
    # built in half the time
    tree = scipy.spatial.KDTree(points[used], compact_nodes=False, balanced_tree=False)
    pairs = used[tree.query_pairs(tolerance, output_type="ndarray")]
    if len(pairs):
        apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
        shortest = _shortest_edges(points, corners, middles)[pairs].min(axis=1)
        pairs = pairs[apart <= MERGE_EDGE_FRACTION * shortest]
    if not len(pairs):
        return raw
    count, number = connected_sets(pairs[:, 0], pairs[:, 1], len(points))
    first = np.full(count, len(points))
    np.minimum.at(first, number, np.arange(len(points)))
    to = first[number]
    words = f"merged {len(points) - count} nodes with others at the same place"
    words += _differing_words(raw.point_data, used, to[used])
    return raw._replace(
        cells={name: to[rows] for name, rows in raw.cells.items()},
        middles={name: to[rows] for name, rows in raw.middles.items()},
        notes=(*raw.notes, words),
    )


def _shortest_edges(points: Floats, corners: Ints, middles: Ints) -> Floats:
    """Return the length of the shortest edge at each point, (P,); half of it at its middle."""
    shortest = np.full(len(points), np.inf)
    for place, (start, end) in enumerate(cell_edges(corners.shape[1] - 1)):
        length = np.linalg.norm(points[corners[:, start]] - points[corners[:, end]], axis=1)
        for nodes in (corners[:, start], corners[:, end], *middles[:, place : place + 1].T):
            np.minimum.at(shortest, nodes, 0.5 * length)
    return shortest


def apart_words(mesh: Mesh, is_ours: bool) -> tuple[str, ...]:
    """Return remarks on pieces that share no nodes and, unless the mesh is one of tetopt's, on
    cells that touch or overlap without common nodes.
    """
    n = mesh.ndim
    starts, ends = mesh.cells[:, :n].ravel(), mesh.cells[:, 1:].ravel()
    count, number = connected_sets(starts, ends, len(mesh.points))
    sizes = np.bincount(number[mesh.cells[:, 0]], mesh.cell_volumes)
    pieces = (
        f"{count} pieces share no nodes, so that no force passes between them; the largest has "
        f"{sizes.max() / sizes.sum():.1%} of the volume"
    )
    share = 0.0 if is_ours else _covered_fraction(mesh)
    touching = (
        "cells touch or overlap others without common nodes, so that no force passes there: at "
        f"{share:.1%} of the boundary's facets"
    )
    return (*[pieces] * (count > 1), *[touching] * (share > 0.0))


def _covered_fraction(mesh: Mesh) -> float:
    """Return the fraction of some boundary facets with another cell just outside their centre."""
    shared = facets(mesh.cells)
    outer = boundary_facets(mesh.cells, shared)
    if not len(outer):  # every cell is there twice
        return 0.0
    cells = mesh.cells[np.unique(shared.cells[shared.n_cells == 1, 0])]
    corners = mesh.points[outer[:: -(-len(outer) // PROBED_FACETS)]]
    sides = corners[:, 1:] - corners[:, :1]
    if mesh.ndim == 3:
        normals = np.cross(sides[:, 0], sides[:, 1])
        normals /= np.sqrt(np.linalg.norm(normals, axis=1, keepdims=True)) + np.finfo(float).tiny
    else:
        normals = sides[:, 0, ::-1] * [1.0, -1.0]
    probes = corners.mean(axis=1) + PROBE_FRACTION * normals
    tree = scipy.spatial.KDTree(mesh.points[cells].mean(axis=1))
    near = tree.query(probes, k=min(PROBED_CELLS, len(cells)))[1].reshape(len(probes), -1)
    first, *others = np.moveaxis(mesh.points[cells[near]], 2, 0)
    edges = np.stack([other - first for other in others], axis=-1)
    weights = np.linalg.solve(edges, (probes[:, None] - first)[..., None])[..., 0]
    is_inside = (weights > 0.0).all(axis=2) & (weights.sum(axis=2) < 1.0)
    return float(is_inside.any(axis=1).mean())


def with_labels(
    cell_data: Arrays, n_cells: int, name: str | None
) -> tuple[Arrays, tuple[str, ...]]:
    """Return cell data with the labels as field "label", and a note on the field they are from.

    Parameters
    ----------
    cell_data : dict of arrays of numbers
    n_cells : int
    name : str, optional
        The field of labels; by default the first of `LABEL_NAMES` that has any but 0.

    Raises
    ------
    InputError
        The named field does not exist, or is not one whole number from 0 for each cell.
    """
    fields = {}
    for each, values in cell_data.items():
        column = values.reshape(-1) if values.shape[1:] == (1,) else values
        if (labels := labels_of({LABEL_FIELD: column}, n_cells)) is not None:
            fields[each] = labels
    if name is not None:
        if name not in fields:
            raise InputError(
                f'`label_field`: expected a cell field of whole numbers from 0, got "{name}"; '
                f"there are {list_names([*fields]) or 'none'}"
            )
        return cell_data | {LABEL_FIELD: fields[name]}, ()
    # a material of a modulus is a bin, not a tissue
    known = {
        re.sub("[ _]", "", each.lower()): each
        for each, labels in sorted(fields.items(), key=lambda item: item[0] == LABEL_FIELD)
        if labels.any() and not ("young" in cell_data and each == "material")
    }
    names = [known[each] for each in LABEL_NAMES.split() if each in known]
    notes = []
    if LABEL_FIELD in cell_data.keys() - fields.keys():
        notes.append(
            f'cell field "{LABEL_FIELD}" is not used: expected one whole number from 0 for each '
            "cell"
        )
    if not names:
        return cell_data | {name: fields[name] for name in fields.keys() & {LABEL_FIELD}}, (*notes,)
    first, *others = names
    if first != LABEL_FIELD:
        words = f'labels are those of cell field "{first}"'
        words += f"; `label_field` takes another, {list_names(others)}" if others else ""
        notes.append(words)
    rest = {each: values for each, values in cell_data.items() if each != LABEL_FIELD}
    return {LABEL_FIELD: fields[first]} | rest, (*notes,)
