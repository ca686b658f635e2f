"""Fidelity of a mesh to labels or a mask: overlaps, distances between surfaces, connected
components.

A label's surface in the image is its half level: marching cubes at 1/2 of the array that is 1 in
the label's voxels and 0 elsewhere. Its surface in the mesh consists of the facets between cells
with the label and other cells. The faces of the image's box belong to neither, and distances
exclude them, as the space behind them is unknown.

Distances are exact, from points spread evenly over one surface to the other, so that means and
percentiles are by area.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil
from threading import Lock
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.contents.labels import (
    BACKGROUND_LABEL,
    LARGEST_LABEL,
    LostComponent,
    check_labels,
    voxel_components,
    voxel_euler,
)
from tetopt.energy.sampling import Overlap, cell_moments, cell_of_voxel, nearest_voxels, overlap_of
from tetopt.errors import InputError
from tetopt.geometry.check import facets_on_box, outside_fraction
from tetopt.geometry.manifold import OUTSIDE_LABEL
from tetopt.geometry.nearest import triangle_distances
from tetopt.geometry.simplex import centroids, volumes
from tetopt.geometry.topology import Facets, cell_euler, components, facets
from tetopt.image import Image, check_image, transform_vectors
from tetopt.mesh import Mesh
from tetopt.system.arrays import Bools, Floats, Ints, plain_array
from tetopt.system.kernel_cache import njit
from tetopt.system.slabs import count_pairs, over_slabs, sum_over_slabs

POINTS_PER_CELL = 24  # points per cell for comparison with the voxels
CHUNK_CELLS = 4096  # compared at a time, as voxels near one another stay in a processor's cache
MOST_POINTS = 20_000  # on a surface, for measuring distances
FEWEST_POINTS = 1_000  # the least number on the larger of two surfaces
POINTS_PER_FACE = 4.0  # per area of a voxel's face: the half level bends no faster than that
# Steps of an even sequence in the unit square and cube: powers of 1/g with g^3 = g + 1 and g^4 = g
# + 1 (Roberts 2018).
EVEN_STEPS = {2: 0.7548776662466927 ** np.arange(1, 3), 3: 0.8191725133961645 ** np.arange(1, 4)}

ROW_KEYS = {  # of a label's numbers in run.json, if their names there differ from those in groups
    "mean": "distance_mean",
    "p95": "distance_p95",
    "max": "distance_max",
    "of_voxels": "thickness_voxels",
    "of_cells": "thickness_mesh",
}
# cells around it that a label or a component of one must be as large as to have a cell of its own
LEAST_CELLS = 2.0


class FacetSurface(NamedTuple):
    """Triangles in space, or segments in the plane; the surface may be open."""

    points: Floats  # (P, n)
    facets: Ints  # (T, n), indices of points; not oriented


class Thickness(NamedTuple):
    """Percentiles of a label's local thickness, by `tetopt.label_thickness`.

    Parameters
    ----------
    p5, p50, p95 : float
        The 5th percentile, the median and the 95th percentile over the voxel centres in the label,
        mm.
    limit : float
        Thickness beyond this is clipped, mm.

    Examples
    --------
    >>> Thickness(1.0, 1.5, 2.5).p50
    1.5
    """

    p5: float
    p50: float
    p95: float
    limit: float = np.inf


class LabelExtent(NamedTuple):
    """Sizes of a label in voxels and in cells. Volumes are areas in 2-D.

    Parameters
    ----------
    voxels : int
        Number of its voxels.
    covered_voxels : int
        Number of its voxels that cells should represent: those in the mesh or, with a mask, all.
    volume : float
        Volume of its voxels, mm^n.
    mesh_volume : float
        Volume of its cells, mm^n.
    n_cells : int
        Number of its cells.
    n_empty_cells : int
        Number of its cells without voxel centre.
    is_lost : bool
        True if no part of the mesh has the label.
    size_in_cells : float
        Volume of its largest connected component of voxels, relative to the mean cell around it;
        inf if not measured.
    one_layer_fraction : float
        Fraction of its cells' volume in cells whose nodes all lie on its surface, one cell thick;
        nan without cells, or if not measured.

    Examples
    --------
    >>> LabelExtent(voxels=8, covered_voxels=4, volume=16.0, mesh_volume=6.0).ratio
    0.75
    """

    voxels: int = 0
    covered_voxels: int = 0
    volume: float = 0.0
    mesh_volume: float = 0.0
    n_cells: int = 0
    n_empty_cells: int = 0
    is_lost: bool = False
    size_in_cells: float = np.inf
    one_layer_fraction: float = np.nan

    @property
    def ratio(self) -> float:
        """Ratio of the volume of its cells to that of its voxels that they should represent."""
        return self.mesh_volume / self.volume * self.voxels / max(self.covered_voxels, 1)

    @property
    def is_beyond(self) -> bool:
        """True if cells should represent less than half of its voxels, as most are outside."""
        return 2 * self.covered_voxels < self.voxels


class LabelPieces(NamedTuple):
    """Connected components of a label.

    Parameters
    ----------
    components : int
        Components of its voxels, linked by faces.
    mesh_components : int
        Components of its cells, linked by facets.
    lost_components : tuple of LostComponent
        Components of the voxels that cells should represent, none of which lies in a cell with the
        label, the largest first.
    large_components : int, optional
        Components of the voxels as large as `LEAST_CELLS` mean cells around them.

    Examples
    --------
    >>> LabelPieces(components=2, mesh_components=1).lost_components
    ()
    """

    components: int = 0
    mesh_components: int = 0
    lost_components: tuple[LostComponent, ...] = ()
    large_components: int | None = None


class LabelOverlap(NamedTuple):
    """Overlaps of a label's voxels with its cells, 0 to 1.

    Parameters
    ----------
    dice : float
        Dice of the voxels in its cells with its voxels.
    volume_dice : float
        Dice of its cells with its voxels as boxes, which cells as small as voxels cannot evade.
    dice_majority : float
        `dice` if each cell had the label of most of its voxels: what the mesh allows, whatever its
        labels.

    Examples
    --------
    >>> LabelOverlap(dice=0.9).dice
    0.9
    """

    dice: float = np.nan
    volume_dice: float = np.nan
    dice_majority: float = np.nan


class LabelDistance(NamedTuple):
    """Distances between a label's surfaces in the mesh and in the image, both ways, mm.

    Parameters
    ----------
    mean, p95 : float
        Their mean and 95th percentile; nan if one surface is missing.
    max : float
        The largest: it shows single spikes, unlike a percentile.

    Examples
    --------
    >>> LabelDistance(0.5, 1.0, 2.0).max
    2.0
    """

    mean: float = np.nan
    p95: float = np.nan
    max: float = np.nan


class LabelThickness(NamedTuple):
    """Thickness of a label, and of its cells.

    Parameters
    ----------
    of_voxels, of_cells : Thickness, optional
        Thickness of the smooth surface of its voxels, and of its cells; None if not measured, or
        without a voxel centre in them.
    edge : float
        Mean edge of the label's cells, mm: the median over its voxels in them; nan if not measured.
    cells_across : float
        Thickness of the label, up to ten voxels, over the mean edge of the cell there: the median
        over the same voxels.

    Examples
    --------
    >>> LabelThickness(edge=2.0, cells_across=1.5).of_cells is None
    True
    """

    of_voxels: Thickness | None = None
    of_cells: Thickness | None = None
    edge: float = np.nan
    cells_across: float = np.nan


class LabelInterface(NamedTuple):
    """Properties of a label's surface. In 2-D areas are lengths, and edges are nodes.

    Parameters
    ----------
    label : int
        The label's number.
    area : float
        Area of its closed surface in the mesh, with its faces on the image's box or a mask's
        surface, mm^(n-1).
    smooth_area : float
        Area of the closed smooth surface of its voxels, mm^(n-1).
    area_ratio : float
        Ratio of the two; nan without cells, or with fewer voxels than
        `tetopt.measure.interfaces.NET_VOXELS`.
    folded : float
        Fraction of the surface's edges at which it turns by more than 60 degrees; nan without
        cells.
    n_facets : int
        Number of facets of its surface.
    nonmanifold_edges : int
        Number of edges in more than two of its facets.
    nonmanifold_edges_two_labels : int
        Number of these edges around which it meets only one other label, or only the outside.
    nonmanifold_nodes : int
        Number of nodes around which its facets form more than one fan, over edges; 0 in 2-D.
    nonmanifold_nodes_two_labels : int
        Number of these nodes around which it meets only one other label, or only the outside.
    euler : int
        Euler number of its voxels' closed surface: 2 (components - holes + cavities); the same
        formula in 2-D.
    mesh_euler : int
        Euler number of its cells' closed surface.
    cavities : int
        Number of cavities in its voxels; 0 in 2-D, where they are holes.
    mesh_cavities : int
        Number of cavities in its cells; 0 in 2-D.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(labels, nodes=300)
    >>> background, ball = tetopt.label_interfaces(labels, mesh, tetopt.cell_labels(labels, mesh))
    >>> background.cavities, background.mesh_cavities, ball.euler
    (1, 1, 2)
    """

    label: int
    area: float
    smooth_area: float
    area_ratio: float
    folded: float
    n_facets: int
    nonmanifold_edges: int
    nonmanifold_edges_two_labels: int
    nonmanifold_nodes: int
    nonmanifold_nodes_two_labels: int
    euler: int
    mesh_euler: int
    cavities: int
    mesh_cavities: int


class LabelFidelity(NamedTuple):
    """Fidelity of the mesh to one label.

    Parameters
    ----------
    label : int
        The label's number.
    extent : LabelExtent
        Voxels, cells and volumes.
    pieces : LabelPieces
        Connected components.
    overlap : LabelOverlap
        Dice of voxels and cells.
    distance : LabelDistance
        Distances between the surfaces in mesh and image.
    thickness : LabelThickness
        Thickness, and cells across, by `tetopt.label_thickness`, if measured.
    surface : LabelInterface, optional
        Smoothness and topology of its surface, by `tetopt.label_interfaces`, if measured.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> ball = tetopt.label_fidelity(labels, tetopt.lattice_mesh(labels, nodes=300))[1]
    >>> ball.label, ball.extent.voxels, ball.pieces.components, ball.extent.is_lost
    (1, 552, 1, False)
    """

    label: int
    extent: LabelExtent = LabelExtent()
    pieces: LabelPieces = LabelPieces()
    overlap: LabelOverlap = LabelOverlap()
    distance: LabelDistance = LabelDistance()
    thickness: LabelThickness = LabelThickness()
    surface: LabelInterface | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the numbers of all groups but the surface's, as one row of run.json.

        Returns
        -------
        dict
            By name, such as "dice" and "mesh_volume".

        Examples
        --------
        >>> LabelFidelity(3, overlap=LabelOverlap(dice=0.9)).as_json()["dice"]
        0.9
        """
        groups = self.extent, self.pieces, self.overlap, self.distance, self.thickness
        numbers = {
            ROW_KEYS.get(name, name): value
            for each in groups
            for name, value in each._asdict().items()
        }
        return {"label": self.label, **numbers}


Made = TypeVar("Made")
CELLS = "cells of voxels"  # the name of `voxel_cells` among a mesh's attributes
_OWNING = Lock()  # held by the thread that owns voxels, as others need the same
RECORD = "voxels of labels"  # the name of a `VoxelRecord` among an image's attributes


class OwnedVoxels(NamedTuple):
    """Voxels with labels, and the cells that own them."""

    labels: Ints  # (K,) ascending
    rows: NDArray[np.integer]  # row of `labels` of each voxel; `OUTSIDE_LABEL` of those left out
    owner: NDArray[np.integer]  # cell of each voxel, -1 outside the mesh
    is_covered: Bools  # True for voxels that cells should represent
    outside: int  # row of the space outside the mesh
    affine: Floats


class MaskFidelity(NamedTuple):
    """Fidelity of a mesh to the mask that it should fill. Volumes are areas in 2-D.

    Distances are between the mesh's boundary and the mask's half level, off the faces of the box;
    nan if one is missing. They are in index space if in voxels, where every voxel is a unit cube,
    and in the world if in mm.

    Parameters
    ----------
    voxels : int
        Number of voxels of 1/2 or more.
    volume : float
        Volume of these voxels, mm^n.
    mesh_volume : float
        Volume of all cells, mm^n.
    dice : float
        Dice of the voxels inside the mesh with those of 1/2 or more, 0 to 1.
    distance_mean, distance_p95 : float
        Distance from the mesh's boundary to the mask's, voxels: the mean and the 95th percentile.
    reverse_mean, reverse_p95 : float
        Distance from the mask's boundary to the mesh's, voxels: the same.
    distance_mean_mm, distance_p95_mm, reverse_mean_mm, reverse_p95_mm : float
        The same four in mm.
    components : int
        Connected components of the voxels, linked by faces.
    mesh_components : int
        Connected components of the cells, linked by facets.
    euler, mesh_euler : int
        Euler numbers of the closed surfaces of these voxels and of the cells, faces of the box
        included: 2 (components - holes + cavities).
    lost_components : tuple of LostComponent
        Components of these voxels, none of which lies in a cell, the largest first.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> mask = tetopt.Image(labels.data == 1, labels.affine)
    >>> mesh_of_box = tetopt.lattice_mesh(labels, nodes=300)
    >>> box = tetopt.mask_fidelity(mask, mesh_of_box)
    >>> round(box.dice, 2), box.components, box.euler
    (0.24, 1, 2)
    """

    voxels: int
    volume: float
    mesh_volume: float
    dice: float
    distance_mean: float
    distance_p95: float
    reverse_mean: float
    reverse_p95: float
    distance_mean_mm: float
    distance_p95_mm: float
    reverse_mean_mm: float
    reverse_p95_mm: float
    components: int
    mesh_components: int
    euler: int
    mesh_euler: int
    lost_components: tuple[LostComponent, ...] = ()


def cell_labels(labels: Image, mesh: Mesh) -> Ints:
    """Label of each cell: the most frequent one of its voxels, the smallest of several.

    A cell without voxel centre has the label of the voxel nearest to its centroid.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0 to `tetopt.contents.labels.LARGEST_LABEL`.
    mesh : Mesh
        Points in world coordinates, mm; curved edges count as straight.

    Returns
    -------
    (M,) int64
        Label of each cell.

    Raises
    ------
    InputError
        Values that are not labels, or the reasons of `tetopt.energy.sampling.cell_moments`.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(labels, nodes=300)
    >>> of_cell = tetopt.cell_labels(labels, mesh)
    >>> np.bincount(of_cell).tolist()
    [1063, 137]
    """
    voxels = voxels_of(labels)
    outside_fraction(mesh, labels)
    nearest = nearest_voxels(labels, centroids(mesh.points, mesh.cells))
    nearest = voxels.rows[tuple(nearest.T)].astype(np.int64)
    return voxels.labels[_most_frequent(voxels.rows, cell_of_voxel(labels, mesh), nearest)]


def label_fidelity(
    labels: Image,
    mesh: Mesh,
    of_cell: ArrayLike | None = None,
    mask: Image | None = None,
    extents: Sequence[LabelFidelity] = (),
) -> list[LabelFidelity]:
    """Measure how well cells represent each label of an image.

    Without a mask, the space outside the mesh counts as label 0: its voxels get label 0, the mesh's
    boundary off the box is a surface between 0 and the labels inside, and label 0 is not lost
    there. With a mask, label 0 is a label like the others, and no label has the space outside.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0 to `tetopt.contents.labels.LARGEST_LABEL`.
    mesh : Mesh
        Points in world coordinates, mm; curved cells as their `Mesh.straight_pieces`, their volumes
        exact.
    of_cell : (M,) array of whole numbers, optional
        Label of each cell; `cell_labels` by default.
    mask : Image, optional
        Mask on the same voxels; only voxels of 1/2 or more count.
    extents : sequence of LabelFidelity, optional
        Volumes, components and Dice, if known: the `MeshingResult.extents` of these labels and
        this mesh.

    Returns
    -------
    list of LabelFidelity
        One for each label in the image, or in the mask, including 0, ascending.

    Raises
    ------
    InputError
        Values that are not labels, not one label per cell, a mask on other voxels, or the reasons
        of `tetopt.cell_moments`.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> image = phantom.image(voxel_mm=4)
    >>> result = tetopt.mesh_image(tetopt.content(image, labels), 300)
    >>> for each in tetopt.label_fidelity(labels, result.mesh, result.labels):
    ...     dice, off = each.overlap.dice, each.distance.mean
    ...     print(f"label {each.label}: Dice {dice:.2f}, off by {off:.1f} mm")
    label 0: Dice 1.00, off by 0.5 mm
    label 1: Dice 1.00, off by 0.5 mm
    """
    record = voxels_of(labels, mask)
    owner = voxel_cells(labels, mesh)
    of_cell = cell_labels(labels, mesh) if of_cell is None else check_cell_labels(of_cell, mesh)
    values, true, of_cell = record.labels, record.rows, record.rows_of(of_cell)
    outside = BACKGROUND_LABEL if mask is None else OUTSIDE_LABEL
    is_covered = (owner >= 0) | (mask is not None)
    voxels = OwnedVoxels(values, true, owner, is_covered, outside, labels.affine)
    overlaps = _label_overlaps(labels, mesh, voxels, of_cell)
    distances = _label_distances(labels, mesh, true, of_cell, outside)
    one_layer = one_layer_fractions(mesh, of_cell, facets(mesh.cells))
    boxes, rows = record.boxes, []
    if other := {known.label for known in extents}.difference(values.tolist()):
        raise InputError(f"extents: label {min(other)} is not in `labels`; measure them again")
    for known in extents or label_extents(voxels, mesh, of_cell):
        row = int(np.searchsorted(values, known.label))
        far = distances(row, cast("tuple[slice, ...]", boxes[row]))  # which has voxels
        rows.append(
            known._replace(
                extent=known.extent._replace(one_layer_fraction=one_layer.get(row, np.nan)),
                overlap=known.overlap._replace(
                    **{name: column[row].item() for name, column in overlaps.items()}
                ),
                distance=LabelDistance(
                    *_mean_and_p95(far), float(far.max()) if len(far) else np.nan
                ),
            )
        )
    return rows


def label_extents(voxels: OwnedVoxels, mesh: Mesh, row_of_cell: Ints) -> list[LabelFidelity]:
    """Measure the volumes and components of each label with a voxel, and its Dice: all that a
    verdict needs (`tetopt.measure.judge`).
    """
    true, painted = voxels.rows, painted_voxels(voxels.owner, row_of_cell, voxels.outside)
    n_labels = int(max(true.max(), row_of_cell.max())) + 1
    n_true, n_painted = (voxel_counts(rows, n_labels) for rows in (true, painted))
    n_cells = np.bincount(row_of_cell, minlength=n_labels)
    mesh_volume = np.bincount(row_of_cell, mesh.cell_volumes, n_labels)
    voxel_volume = abs(np.linalg.det(voxels.affine[:-1, :-1]))
    volume = n_true * voxel_volume
    # of voxels in no cell, that of a mean cell, in the last place
    shares = voxel_volume / np.append(mesh.cell_volumes, mesh.cell_volumes.mean())
    n_owned = np.bincount(voxels.owner[voxels.owner >= 0], minlength=len(row_of_cell))
    n_empty = np.bincount(row_of_cell[n_owned == 0], minlength=n_labels)
    dice = _voxel_dice(true, painted, n_true)
    measured = []
    for row, box in enumerate(scipy.ndimage.find_objects(true + 1)):
        if box is None:
            continue
        own, is_covered = true[box] == row, voxels.is_covered[box]
        is_met = own & (painted[box] == row)
        of_voxel = shares[voxels.owner[box]]
        n_components, lost = voxel_components(
            own, is_met | ~is_covered, voxels.affine, box, of_voxel
        )
        number = own if n_components == 1 else scipy.ndimage.label(own)[0]
        sizes = np.bincount(number[own], of_voxel[own])
        measured.append(
            LabelFidelity(
                int(voxels.labels[row]),
                extent=LabelExtent(
                    voxels=int(n_true[row]),
                    covered_voxels=int(np.count_nonzero(own & is_covered)),
                    volume=float(volume[row]),
                    mesh_volume=float(mesh_volume[row]),
                    n_cells=int(n_cells[row]),
                    n_empty_cells=int(n_empty[row]),
                    is_lost=bool(n_cells[row] == 0 and n_painted[row] == 0),
                    size_in_cells=float(sizes.max()),
                ),
                pieces=LabelPieces(
                    components=n_components,
                    mesh_components=_n_components(mesh.cells[row_of_cell == row]),
                    lost_components=lost,
                    large_components=int((sizes >= LEAST_CELLS).sum()),
                ),
                overlap=LabelOverlap(dice=float(dice[row])),
            )
        )
    return measured


def _label_overlaps(
    labels: Image, mesh: Mesh, voxels: OwnedVoxels, of_cell: Ints
) -> dict[str, NDArray]:
    """Overlaps of all labels but for Dice, by the names of `LabelOverlap`."""
    true, owner, outside = voxels.rows, voxels.owner, voxels.outside
    n_labels = int(max(true.max(), of_cell.max())) + 1
    n_true = voxel_counts(true, n_labels)
    pieces, n_pieces = mesh.straight_pieces()
    overlap, size, (overlap_beyond, size_beyond) = _overlaps(
        labels, true, pieces, np.repeat(of_cell, n_pieces), n_labels
    )
    is_outside = np.arange(n_labels) == outside
    both = overlap + is_outside * overlap_beyond
    total = n_true * labels.voxel_volume + (size + is_outside * size_beyond)
    of_most = _most_frequent(true, owner, of_cell)
    return {
        "volume_dice": 2.0 * both / np.where(total > 0.0, total, 1.0),
        "dice_majority": _voxel_dice(true, painted_voxels(owner, of_most, outside), n_true),
    }


def _label_distances(
    labels: Image,
    mesh: Mesh,
    true: NDArray[np.integer],
    label_of_cell: Ints,
    outside: int,
) -> Callable[[int, tuple[slice, ...]], Floats]:
    """Return a function that measures the distances between the surfaces of a label, by its row
    and the box of its voxels, both ways.
    """
    pieces, n_pieces = mesh.straight_pieces()
    of_piece, shared = np.repeat(label_of_cell, n_pieces), facets(pieces.cells)
    nodes, sides = _labels_beside_facets(labels, pieces, of_piece, shared, outside)
    face = _face(labels.voxel_volume, labels.ndim)

    def distances(row: int, box: tuple[slice, ...]) -> Floats:
        part, affine = _with_margin(labels, true, box)
        ours = FacetSurface(pieces.points, nodes[(sides == row).sum(axis=1) == 1])
        return np.concatenate(_distances(ours, half_level_surface(part == row, affine), face))

    return distances


def _overlaps(
    labels: Image,
    rows: NDArray[np.integer],
    mesh: Mesh,
    label_of_cell: Ints,
    n_labels: int,
) -> tuple[Floats, Floats, tuple[float, float]]:
    """Volume of each label's voxels in its cells, of these cells, and outside the mesh, of label 0
    and of all labels.

    Estimated from `POINTS_PER_CELL` points that fill each cell evenly.
    """
    n, size = mesh.ndim, volumes(mesh.points, mesh.cells)
    steps = np.sort(
        np.mod(0.5 + np.outer(np.arange(1, POINTS_PER_CELL + 1), EVEN_STEPS[3][:n]), 1.0), axis=1
    )
    # gaps between sorted numbers are uniform in a simplex
    weights = np.diff(steps, axis=1, prepend=0.0, append=1.0)
    own, none, inverse = (
        np.zeros(len(size)),
        np.zeros(len(size)),
        np.linalg.inv(labels.affine[:-1, :-1]),
    )
    for first in range(0, len(size), CHUNK_CELLS):
        part = slice(first, first + CHUNK_CELLS)
        corners, counts = (
            mesh.points[mesh.cells[part]],
            (own[part], none[part], label_of_cell[part]),
        )
        for weight in weights:
            places = np.einsum("k,mkn->mn", weight, corners)
            _count_labels(
                *counts, places, labels.affine[:-1, -1], inverse, rows.ravel(), rows.shape
            )
    overlap = np.bincount(label_of_cell, own * size / POINTS_PER_CELL, n_labels).astype(np.float64)
    rest = max(labels.volume - float(size.sum()), 0.0)
    background = float((rows == 0).sum()) * labels.voxel_volume - float(
        (none * size).sum() / POINTS_PER_CELL
    )
    filled = np.bincount(label_of_cell, size, n_labels).astype(np.float64)
    return overlap, filled, (min(max(background, 0.0), rest), rest)


@njit(cache=True, nogil=True)
def _count_labels(
    own: NDArray,
    none: NDArray,
    label_of_cell: NDArray,
    places: NDArray,
    origin: NDArray,
    inverse: NDArray,
    rows: NDArray,
    shape: tuple[int, ...],
) -> None:
    """Add 1 for each cell at whose place (M, n) is its label, and where label 0 is, as
    `nearest_values` finds them.
    """
    for cell in range(len(places)):
        at = 0
        for axis in range(places.shape[1]):
            index = (places[cell, 0] - origin[0]) * inverse[axis, 0]
            for column in range(1, places.shape[1]):
                index += (places[cell, column] - origin[column]) * inverse[axis, column]
            at = at * shape[axis] + min(max(int(np.rint(index)), 0), shape[axis] - 1)
        own[cell] += rows[at] == label_of_cell[cell]
        none[cell] += rows[at] == 0


def mask_fidelity(mask: Image, mesh: Mesh) -> MaskFidelity:
    """Measure how well a mesh fills a mask and follows its boundary.

    Parameters
    ----------
    mask : Image
        From 0, outside, to 1, inside; fractions are partial volumes.
    mesh : Mesh
        Points in world coordinates, mm; curved cells as their `Mesh.straight_pieces`, their volumes
        exact.

    Returns
    -------
    MaskFidelity
        Volumes, Dice, distances both ways, connected components, Euler numbers.

    Raises
    ------
    InputError
        A mask with other values, or the reasons of `tetopt.energy.sampling.cell_moments`.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> mask = tetopt.Image(labels.data == 1, labels.affine)
    >>> what = tetopt.content(phantom.image(voxel_mm=4), mask=mask)
    >>> fidelity = tetopt.mask_fidelity(mask, tetopt.mesh_image(what, 200).mesh)
    >>> print(f"Dice {fidelity.dice:.2f}, {fidelity.distance_mean:.2f} voxels off")
    Dice 1.00, 0.12 voxels off
    """
    low, high = mask.range
    if low < 0.0 or high > 1.0:
        raise InputError(
            f"mask: expected values from 0 to 1, got {low:g} to {high:g}; threshold or rescale "
            "it first"
        )
    pieces = mesh.straight_pieces()[0]
    is_filled = voxel_cells(mask, mesh) >= 0
    is_inside = mask.data >= INSIDE_FRACTION
    n_components, lost = voxel_components(is_inside, is_filled, mask.affine)
    n_inside, n_filled = int(is_inside.sum()), int(is_filled.sum())
    shared = facets(pieces.cells)
    outer, is_on_box = facets_on_box(pieces, mask, shared)
    ours = FacetSurface(mask.to_index(pieces.points), outer[~is_on_box])
    theirs = half_level_surface(mask.data, np.eye(mask.ndim + 1))
    there, back = _distances(ours, theirs, 1.0)
    there_mm, back_mm = _distances(
        FacetSurface(pieces.points, ours.facets),
        FacetSurface(mask.to_world(theirs.points), theirs.facets),
        _face(mask.voxel_volume, mask.ndim),
    )
    return MaskFidelity(
        n_inside,
        n_inside * mask.voxel_volume,
        float(mesh.cell_volumes.sum()),
        _dice(int((is_inside & is_filled).sum()), n_inside, n_filled),
        *_mean_and_p95(there),
        *_mean_and_p95(back),
        *_mean_and_p95(there_mm),
        *_mean_and_p95(back_mm),
        n_components,
        _n_components(mesh.cells, shared if pieces is mesh else None),
        voxel_euler(is_inside),
        cell_euler(pieces.cells, shared),
        lost,
    )


def half_level_surface(level: NDArray, affine: Floats) -> FacetSurface:
    """The surface where a field of 0 to 1 on voxels is 1/2, by marching cubes (marching squares in
    2-D).

    Beyond the outermost voxel centres the field is constant, so the surface continues straight to
    the faces of the box, ends there, and has no part on them.

    Parameters
    ----------
    level : (s_0, ..., s_{n-1}) array of numbers or bool
        The field; voxel centres sit at the integer indices.
    affine : (n+1, n+1) float64
        From index to world coordinates in mm.

    Returns
    -------
    FacetSurface
        World coordinates in mm, accurate to 1e-5 voxel; without facets if the field does not cross
        1/2.
    """
    import pyvista  # slow to load, and only needed with a mask or labels
    from vtkmodules.util.numpy_support import vtk_to_numpy

    level = np.asarray(level)
    n = level.ndim
    padded = np.pad(level, 1, mode="edge")
    grid = pyvista.ImageData(
        dimensions=padded.shape + (1,) * (3 - n), origin=(-1.0,) * n + (0.0,) * (3 - n)
    )
    grid.point_data["level"] = (padded.astype(np.uint8) if level.dtype == bool else padded).ravel(
        order="F"
    )
    surface = grid.contour(
        [INSIDE_FRACTION], scalars="level", compute_normals=False, compute_gradients=False
    )
    nodes = vtk_to_numpy(
        (surface.GetPolys() if n == 3 else surface.GetLines()).GetConnectivityArray()
    )
    # Between the outermost centres and their copies the field is constant along the axis: a point
    # of the surface at a copy, one voxel out, has the same coordinates along the other axes at the
    # face of the box, half a voxel out.
    index = np.clip(
        np.asarray(surface.points, dtype=np.float64)[:, :n], -0.5, np.array(level.shape) - 0.5
    )
    return FacetSurface(
        transform_vectors(index, affine[:-1, :-1]) + affine[:-1, -1],
        nodes.reshape(-1, n).astype(np.int64),
    )


def surface_distances(points: Floats, surface: FacetSurface) -> Floats:
    """Distance of points (K, n) from the nearest point of a surface, (K,) float64 in their unit;
    exact.

    The surface has at least one facet; flat facets count, too.
    """
    nodes, corners = surface
    if points.shape[1] == 2:  # segments are flat triangles
        points, nodes, corners = (
            *(np.pad(each, ((0, 0), (0, 1))) for each in (points, nodes)),
            corners[:, [0, 1, 1]],
        )
    return triangle_distances(points, nodes, corners)


def evenly_spread(surface: FacetSurface, count: int, areas: Floats | None = None) -> Floats:
    """`count` points on a surface, (count, n) float64, each for the same area (length in 2-D);
    deterministic.

    `areas` (T,) are its facets' areas, if known.

    The facets' areas are laid in a row, and point i falls into the i-th of `count` equal parts of
    it. Its place in the part varies from point to point: points in the middle could skip every
    second of equal facets.
    """
    points, nodes = surface
    place = np.arange(1, count + 1)[:, None] * EVEN_STEPS[points.shape[1]] % 1.0
    end = np.cumsum(surface_areas(surface) if areas is None else areas)
    at = np.searchsorted(end, (np.arange(count) + place[:, 0]) / count * end[-1], side="right")
    at, place = np.minimum(at, len(nodes) - 1), place[:, 1:]  # rounding may exceed the last
    is_beyond = place.sum(axis=1) > 1.0
    # from the far half of the parallelogram into the triangle
    place[is_beyond] = 1.0 - place[is_beyond]
    first = points[nodes[at, 0]]
    return first + ((points[nodes[at, 1:]] - first[:, None]) * place[..., None]).sum(axis=1)


@dataclass(frozen=True, eq=False)
class VoxelRecord:
    """What the voxels of labels are, whatever the mesh; made by `voxels_of`.

    It does not hold the image, which holds it: each would live until Python looks for cycles.
    """

    mask: Image | None
    labels: Ints  # (K,) ascending, with 0
    rows: NDArray[np.integer]  # row of `labels` of each voxel; `OUTSIDE_LABEL` beyond the mask

    @cached_property
    def boxes(self) -> list[tuple[slice, ...] | None]:
        """The box of each label's voxels; None without any."""
        boxes = scipy.ndimage.find_objects(self.rows + 1)
        return [*boxes, *[None] * (len(self.labels) - len(boxes))]

    def rows_of(self, of_cell: Ints) -> Ints:
        """Return the rows of cells' labels, further ones for labels without a voxel."""
        others = np.setdiff1d(of_cell, self.labels)
        is_known = np.isin(of_cell, self.labels)
        return np.where(
            is_known,
            np.searchsorted(self.labels, of_cell),
            len(self.labels) + np.searchsorted(others, of_cell),
        )

    def once(self, make: Callable[[VoxelRecord, Image], Made], labels: Image) -> Made:
        """Return what a function makes of the image's voxels, at its first call alone."""
        name = f"{make.__module__}.{make.__name__}"
        if name not in vars(self):
            vars(self)[name] = make(self, labels)
        return vars(self)[name]


def voxels_of(labels: Image, mask: Image | None = None) -> VoxelRecord:
    """Return the record of an image's labels within a mask: one for all measures of all meshes,
    kept with the image like its range.

    Raises
    ------
    InputError
        Values that are not labels, or a mask on other voxels.
    """
    record: VoxelRecord | None = vars(check_image("labels", labels)).get(RECORD)
    if record is None or record.mask is not mask:
        data = check_labels("labels", labels).data
        if mask is not None and mask.shape != labels.shape:
            raise InputError(
                f"mask: expected the labels' shape {labels.shape}, got {mask.shape}; resample it "
                "first"
            )
        if mask is not None:
            data = np.where(mask.data < INSIDE_FRACTION, OUTSIDE_LABEL, data)
        parts = over_slabs(lambda first, stop: np.unique(data[first:stop]), len(data), data.size)
        values = np.unique(np.concatenate([[OUTSIDE_LABEL, BACKGROUND_LABEL], *parts]))
        rows = np.empty(data.shape, dtype=_narrow(np.arange(len(values))).dtype)

        def fill(first: int, stop: int) -> None:
            rows[first:stop] = np.searchsorted(values, data[first:stop]) - 1

        over_slabs(fill, len(data), data.size)
        record = VoxelRecord(mask, values[1:].astype(np.int64), rows)
        vars(labels)[RECORD] = record
    return record


def voxel_cells(image: Image, mesh: Mesh) -> NDArray[np.int32]:
    """Number of the cell of each voxel, -1 outside the mesh; curved cells as their straight pieces.

    The last grid's are kept with the mesh, read-only, for all of its measures.
    """
    with _OWNING:
        grid = image.shape, image.affine.tobytes()
        known: tuple[Any, NDArray[np.int32]] | None = vars(mesh).get(CELLS)
        if known is None or known[0] != grid:
            pieces, n_pieces = mesh.straight_pieces()
            owner = cell_of_voxel(image, pieces).astype(np.int32) // np.int32(n_pieces)
            owner.setflags(write=False)
            vars(mesh)[CELLS] = known = grid, owner
        return known[1]


def _most_frequent(rows: NDArray[np.integer], owner: NDArray[np.integer], otherwise: Ints) -> Ints:
    """The most frequent row of the voxels of each cell, the smallest of equally frequent ones,
    or `otherwise` (M,).
    """
    counts = count_pairs(owner, rows, (len(otherwise), int(rows.max(initial=0)) + 1))
    cell = np.repeat(np.arange(len(otherwise)), np.diff(counts.indptr))
    order = np.lexsort((-counts.indices, counts.data, cell))  # the last of a cell is its row
    of_cell = otherwise.copy()
    of_cell[cell[order]] = counts.indices[order]
    return of_cell


def painted_voxels(owner: NDArray[np.integer], of_cell: Ints, outside: int) -> NDArray[np.integer]:
    """Row of the cell that owns each voxel, in the image's shape; `outside` where there is none."""
    table = _narrow(np.append(of_cell, outside))
    painted = np.empty(owner.shape, dtype=table.dtype)

    def fill(first: int, stop: int) -> None:  # in slabs, as indices become 64 bits wide
        painted[first:stop] = table[owner[first:stop]]

    over_slabs(fill, len(owner), owner.size)
    return painted


def _narrow(rows: NDArray[np.integer]) -> NDArray[np.integer]:
    """Whole numbers in 16 bits if they and the next one fit, else in 32."""
    return rows.astype(np.int16 if rows.max(initial=0) < 2**15 - 1 else np.int32)


def voxel_counts(rows: NDArray[np.integer], n: int) -> Ints:
    """Number of voxels of each row, (n,); -1 is no row."""

    def count(first: int, stop: int) -> Ints:
        return np.bincount(rows[first:stop].ravel() + 1, minlength=n + 1)[1:]

    return sum_over_slabs(count, len(rows), rows.size, n)


def _voxel_dice(true: NDArray[np.integer], painted: NDArray[np.integer], n_true: Ints) -> Floats:
    """Dice of the voxels of each label, (K,), with those that cells give it; `n_true` are the
    numbers of the former.
    """
    both = voxel_counts(np.where(true == painted, true, OUTSIDE_LABEL), len(n_true))
    return 2.0 * both / np.maximum(n_true + voxel_counts(painted, len(n_true)), 1)


def check_cell_labels(of_cell: ArrayLike, mesh: Mesh) -> Ints:
    """One label for each cell, (M,) int64; raise InputError unless all are whole numbers from 0
    to `LARGEST_LABEL`.
    """
    values = plain_array("of_cell", of_cell)
    if values.shape != (len(mesh.cells),):
        raise InputError(
            f"of_cell: expected one label for each of the mesh's {len(mesh.cells)} cells, got "
            f"shape {values.shape}"
        )
    if not ((np.rint(values) == values) & (values >= 0) & (values <= LARGEST_LABEL)).all():
        raise InputError(
            f"of_cell: labels must be whole numbers from 0 to {LARGEST_LABEL}, got "
            f"{values.min():g} to {values.max():g}"
        )
    return values.astype(np.int64)


def one_layer_fractions(mesh: Mesh, of_cell: Ints, shared: Facets) -> dict[int, float]:
    """Fraction of each label's volume in cells whose nodes all lie on its surface; `shared` are the
    mesh's facets.

    The surface separates the label's cells from everything else, including the outside of the mesh.
    """
    near, far = np.where(shared.cells >= 0, of_cell[shared.cells], -1).T
    is_surface = near != far
    near, far, nodes = near[is_surface], far[is_surface], shared.nodes[is_surface]
    size, fractions = mesh.cell_volumes, {}
    for label in np.unique(of_cell).tolist():
        is_on, is_own = np.zeros(len(mesh.points), dtype=bool), of_cell == label
        is_on[nodes[(near == label) | (far == label)]] = True
        is_single = is_on[mesh.cells[is_own]].all(axis=1)
        fractions[label] = float(size[is_own][is_single].sum() / size[is_own].sum())
    return fractions


def _labels_beside_facets(
    labels: Image, mesh: Mesh, of_cell: Ints, shared: Facets, outside: int
) -> tuple[Ints, Ints]:
    """All facets (F, n) and the labels on both sides (F, 2), the same label on both sides of the
    box.
    """
    sides = of_cell[shared.cells]
    is_outer = shared.n_cells == 1
    is_on_box = facets_on_box(mesh, labels, shared)[1]  # in the order of the facets
    sides[is_outer, 1] = np.where(is_on_box, sides[is_outer, 0], outside)
    return shared.nodes, sides


def _with_margin(
    labels: Image, data: NDArray[np.integer], box: tuple[slice, ...]
) -> tuple[NDArray[np.integer], Floats]:
    """The part of an array in a box with a margin of one voxel, where available, and the part's
    affine.
    """
    low = np.array([max(side.start - 1, 0) for side in box])
    affine = labels.affine.copy()
    affine[:-1, -1] = labels.to_world(low)
    return data[
        tuple(slice(first, side.stop + 1) for first, side in zip(low, box, strict=True))
    ], affine


def _face(voxel_volume: float, n: int) -> float:
    """Area (length in 2-D) of a face of a cube with the volume of a voxel."""
    return voxel_volume ** ((n - 1) / n)


def _distances(one: FacetSurface, other: FacetSurface, face: float) -> tuple[Floats, Floats]:
    """Distances from equally dense points on each of two surfaces to the other; none if a
    surface is empty.
    """
    if len(one.facets) == 0 or len(other.facets) == 0:
        return np.empty(0), np.empty(0)
    areas, areas_there = surface_areas(one), surface_areas(other)
    total, total_there = float(areas.sum()), float(areas_there.sum())
    largest = max(total, total_there)
    density = min(max(POINTS_PER_FACE / face, FEWEST_POINTS / largest), MOST_POINTS / largest)
    spread = evenly_spread(one, max(ceil(density * total), 1), areas)
    spread_there = evenly_spread(other, max(ceil(density * total_there), 1), areas_there)
    return surface_distances(spread, other), surface_distances(spread_there, one)


def surface_areas(surface: FacetSurface) -> Floats:
    """Area of each triangle, or length of each segment, (T,) float64."""
    if surface.points.shape[1] == 2:
        first, second = (surface.points[nodes].T for nodes in surface.facets.T)
        return np.hypot(*(second - first))
    x, y, z = facet_vectors(*surface).T
    return np.asarray(0.5 * np.sqrt(x**2 + y**2 + z**2))


@njit(cache=True, nogil=True)
def facet_vectors(points: NDArray, nodes: NDArray) -> NDArray:
    """Vectors (T, 3) across triangles (T, 3) of points (P, 3), as long as twice their areas."""
    vectors = np.empty((len(nodes), 3))
    for t in range(len(nodes)):
        a, b, c = nodes[t, 0], nodes[t, 1], nodes[t, 2]
        x, y, z = (
            points[b, 0] - points[a, 0],
            points[b, 1] - points[a, 1],
            points[b, 2] - points[a, 2],
        )
        u, v, w = (
            points[c, 0] - points[a, 0],
            points[c, 1] - points[a, 1],
            points[c, 2] - points[a, 2],
        )
        vectors[t, 0], vectors[t, 1], vectors[t, 2] = y * w - z * v, z * u - x * w, x * v - y * u
    return vectors


def _mean_and_p95(distances: Floats) -> tuple[float, float]:
    if len(distances) == 0:
        return np.nan, np.nan
    return float(distances.mean()), float(np.percentile(distances, 95.0))


def _dice(both: float, one: float, other: float) -> float:
    return float(2 * both / (one + other)) if one + other > 0 else 0.0


def _n_components(cells: Ints, shared: Facets | None = None) -> int:
    return int(components(cells, shared).max()) + 1 if len(cells) else 0


class ImageFit(NamedTuple):
    """Fit of the cells of a mesh to an image; curved edges count as straight."""

    E_D: float  # intensity^2 mm^n
    # over the voxels that the mesh covers; None if they are all equal
    E_D_fraction_of_variance: float | None
    n_voxels: int  # voxel centres inside
    n_empty_cells: int  # cells without voxel centre
    overlap: Overlap | None  # voxels that lie in several cells


def image_fit(image: Image, mesh: Mesh) -> ImageFit:
    """E_D of a mesh, absolute and as a fraction of the variance of the voxels that it covers.

    Raises
    ------
    InputError
        The mesh contains no voxel centre.
    """
    moments = cell_moments(image, mesh)
    E_D, n_voxels = (
        float((moments.n_voxels * moments.variance).sum()) * image.voxel_volume,
        int(moments.n_voxels.sum()),
    )
    if n_voxels == 0:
        raise InputError(
            "mesh and image: no voxel centre is inside the mesh; do both use the same world "
            "coordinates?"
        )
    n_empty = int((moments.n_voxels == 0).sum())
    return ImageFit(E_D, unexplained_of(*moments), n_voxels, n_empty, overlap_of(image, mesh))


def unexplained_of(n_voxels: Ints, mean: Floats, variance: Floats) -> float | None:
    """Return the fraction of the variance of the voxels in cells that is left within cells; None
    if they are equal.
    """
    within = float((n_voxels * variance).sum())
    middle = float((n_voxels * mean).sum()) / max(int(n_voxels.sum()), 1)
    total = within + float((n_voxels * (mean - middle) ** 2).sum())
    return within / total if total > 0.0 else None
