"""Thin labels: local thickness and contacts between labels, in voxels and mesh.

Both thicknesses are measured in the same way at the same voxel centres, between the labels' smooth
surfaces and between the facets of the mesh: the median for shells is within 3 % from voxels and 0.5
% from facets. A sheet that contains no voxel centre is missed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from tetopt.contents.content import Content
from tetopt.contents.labels import LARGEST_LABEL
from tetopt.contents.thickness import (
    BEYOND_REGION,
    THICKNESS_PERCENTILES,
    local_thickness,
    rows_within,
)
from tetopt.errors import InputError
from tetopt.geometry.manifold import OUTSIDE_LABEL
from tetopt.geometry.simplex import squared_edges
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.measure.fidelity import (
    FacetSurface,
    LabelThickness,
    Thickness,
    VoxelRecord,
    check_cell_labels,
    painted_voxels,
    surface_areas,
    voxel_cells,
    voxels_of,
)
from tetopt.mesh import Mesh
from tetopt.system.arrays import Floats, Ints

THICK_VOXELS = 10.0  # times a voxel's shortest edge, at which thickness is clipped
# mean ratio, over all directions, of a smooth surface to its voxels' faces
STAIRS = {2: np.pi / 4.0, 3: 2.0 / 3.0}
TOLERATED_CONTACT = 1.2  # times the voxels' contact: more in a mesh is excess
LABEL_BASE = LARGEST_LABEL + 1  # base of the number of a pair of labels


class LabelContact(NamedTuple):
    """Contact between two labels. In 2-D areas are lengths, mm.

    Parameters
    ----------
    labels : (int, int)
        The two labels, ascending.
    mesh_mm2 : float
        Area of the facets between their cells.
    voxels_mm2 : float
        Area of the faces between their voxels times 2/3 (pi/4 in 2-D), which estimates the smooth
        surface's area.
    ratio : float
        Ratio of the mesh's area to the voxels'; nan if their voxels do not touch.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(labels, nodes=300)
    >>> (contact,) = tetopt.label_contacts(labels, mesh, tetopt.cell_labels(labels, mesh))
    >>> contact.labels
    (0, 1)
    """

    labels: tuple[int, int]
    mesh_mm2: float
    voxels_mm2: float
    ratio: float


def label_contacts(
    labels: Image, mesh: Mesh, of_cell: ArrayLike, mask: Image | None = None
) -> list[LabelContact]:
    """Measure the contact area of each pair of labels, in the mesh and in the voxels.

    Facets on the mesh's boundary, and faces of voxels on the box or the mask's border, do not
    count.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0 to `tetopt.contents.labels.LARGEST_LABEL`.
    mesh : Mesh
        Points in world coordinates, mm; curved cells as their `Mesh.straight_pieces`.
    of_cell : (M,) array of whole numbers
        Label of each cell, such as from `tetopt.cell_labels`.
    mask : Image, optional
        Mask on the same voxels; only voxels of 1/2 or more count.

    Returns
    -------
    list of LabelContact
        One for each pair that touches in the mesh or in the voxels, ascending.

    Raises
    ------
    InputError
        Values that are not labels, not one label per cell, or a mask on other voxels.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> result = tetopt.mesh_image(tetopt.content(labels, labels), 300)
    >>> for each in tetopt.label_contacts(labels, result.mesh, result.labels):
    ...     print(each.labels, f"{each.ratio:.2f}")
    (0, 1) 1.04
    """
    in_voxels = voxels_of(labels, mask).once(_voxel_contacts, labels)
    of_cell = check_cell_labels(of_cell, mesh)
    pieces, n_pieces = mesh.straight_pieces()
    shared = facets(pieces.cells)
    sides = np.repeat(of_cell, n_pieces)[shared.cells]
    is_contact = (shared.n_cells == 2) & (sides[:, 0] != sides[:, 1])
    area = surface_areas(FacetSurface(pieces.points, shared.nodes[is_contact]))
    in_mesh = _by_pair(sides[is_contact, 0], sides[is_contact, 1], area)
    return [
        LabelContact(
            (pair // LABEL_BASE, pair % LABEL_BASE),
            in_mesh.get(pair, 0.0),
            in_voxels.get(pair, 0.0),
            in_mesh.get(pair, 0.0) / in_voxels[pair] if pair in in_voxels else np.nan,
        )
        for pair in sorted(in_mesh | in_voxels)
    ]


def contact_totals(contacts: Sequence[LabelContact]) -> dict[str, float]:
    """Contact area, mm^(n-1), of pairs that do not touch in the voxels, and in excess of 1.2
    times the voxels'.
    """
    return {
        "false_mm2": float(sum(each.mesh_mm2 for each in contacts if each.voxels_mm2 == 0.0)),
        "excess_mm2": float(
            sum(max(each.mesh_mm2 - TOLERATED_CONTACT * each.voxels_mm2, 0.0) for each in contacts)
        ),
    }


def _voxel_contacts(voxels: VoxelRecord, image: Image) -> dict[int, float]:
    """Contact area of each pair's voxels inside, as the area of smooth surfaces."""
    total = defaultdict[int, float](float)
    for axis, edge in enumerate(image.spacing):
        along = np.moveaxis(voxels.rows, axis, 0)
        is_contact = (along[:-1] != along[1:]) & (
            np.minimum(along[:-1], along[1:]) != OUTSIDE_LABEL
        )
        face = STAIRS[image.ndim] * float(np.prod(image.spacing)) / float(edge)
        sides = (voxels.labels[each[is_contact]] for each in (along[:-1], along[1:]))
        for pair, count in _by_pair(*sides).items():
            total[pair] += face * count
    return total


def _by_pair(one: NDArray, other: NDArray, weights: Floats | None = None) -> dict[int, float]:
    """Sums over pairs of labels, by the number of the pair."""
    pairs = np.minimum(one, other).astype(np.int64) * LABEL_BASE + np.maximum(one, other)
    numbers, place = np.unique(pairs, return_inverse=True)
    return dict(
        zip(
            numbers.tolist(),
            np.bincount(place, weights, len(numbers)).astype(float).tolist(),
            strict=True,
        )
    )


def label_thickness(what: Content, mesh: Mesh, of_cell: ArrayLike) -> dict[int, LabelThickness]:
    """Measure the thickness of each label, between smooth surfaces and in cells, and their edges.

    Parameters
    ----------
    what : Content
        A content with smooth labels: their levels give the smooth surfaces, and both are measured
        at its voxels (finer ones if slices are thick).
    mesh : Mesh
        Points in world coordinates, mm; curved cells as their `Mesh.straight_pieces`.
    of_cell : (M,) array of whole numbers
        Label of each cell.

    Returns
    -------
    dict
        The thickness of each label with a voxel or a voxel centre in its cells. Values are clipped
        at ten times a voxel's shortest edge. At a mask both end half a voxel beyond the last centre
        inside.

    Raises
    ------
    InputError
        A content without such labels, not one label per cell, or not enough memory.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> what = tetopt.content(phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=4))
    >>> result = tetopt.mesh_image(what, 300, iterations=4)
    >>> ball = tetopt.label_thickness(what, result.mesh, result.labels)[1]
    >>> f"{ball.of_voxels.p50:.0f} mm of voxels, {ball.of_cells.p50:.0f} mm of cells"
    '37 mm of voxels, 38 mm of cells'
    """
    of_cell = check_cell_labels(of_cell, mesh)
    members, grid = what.memberships, what.image
    if members is None:
        raise InputError(
            "content: expected labels with smooth interfaces, got none; use content(image, labels)"
        )
    most = THICK_VOXELS * float(min(grid.spacing))
    spacing = np.asarray(grid.spacing, dtype=np.float64)
    rows = rows_within(members.partition, what.inside)
    owner, (pieces, n_pieces) = voxel_cells(grid, mesh), mesh.straight_pieces()
    edge = np.sqrt(squared_edges(mesh.points, mesh.cells)).mean(axis=1)
    measured: dict[int, LabelThickness] = {}
    thickness = local_thickness(rows, members, spacing, most)
    for label, thick, cell in _of_each(rows, members.labels, thickness, owner):
        is_right = (cell >= 0) & (of_cell[cell] == label)
        edges = edge[cell[is_right]]
        medians = (
            float(np.median(x)) if len(x) else np.nan for x in (edges, thick[is_right] / edges)
        )
        measured[label] = LabelThickness(_percentiles(thick, most), None, *medians)
    values, row = np.unique(of_cell, return_inverse=True)
    rows = painted_voxels(owner, row, BEYOND_REGION)
    shared = facets(pieces.cells)
    sides = np.repeat(of_cell, n_pieces)[shared.cells]
    is_between = (shared.n_cells == 2) & (sides[:, 0] != sides[:, 1])
    corners = (grid.to_index(pieces.points) * spacing)[shared.nodes[is_between]]
    thickness = local_thickness(rows, corners, spacing, most)
    for label, thick in _of_each(rows, values, thickness):
        of_voxels = measured.get(label, LabelThickness())
        measured[label] = of_voxels._replace(of_cells=_percentiles(thick, most))
    return measured


def _of_each(rows: NDArray[np.integer], labels: Ints, *fields: NDArray) -> Iterator[Any]:
    """Yield each label that has voxels, by their rows, and the values of its voxels."""
    for row, box in enumerate(scipy.ndimage.find_objects(rows + 1)):
        if box is not None:
            is_own = rows[box] == row
            yield int(labels[row]), *(field[box][is_own] for field in fields)


def _percentiles(thickness: NDArray[np.float32], most: float) -> Thickness:
    low, middle, high = np.percentile(thickness, THICKNESS_PERCENTILES).tolist()
    return Thickness(low, middle, high, float(np.float32(most)))
