"""Smoothness, connectivity and manifoldness of the surfaces of labels.

A label's surface consists of the facets between its cells and everything else: other labels, and
the outside of the mesh, so that it is closed. It is compared with a closed smooth surface of the
label's voxels: surface nets (Gibson 1998), relaxed within a voxel's diagonal, by VTK's
vtkSurfaceNets3D. As these shrink small shapes, a ball of radius 6 voxels to 0.87 of its area, the
area in 3-D is that at the voxels' volume: within 2 % for balls and tubes of radius 4 or more. The
rim of a thin sheet still retracts: a disc of radius 24, two voxels thick, has 0.93 of its area.

Connected components, holes and cavities are those of the label's inside, without its surface: cells
are connected by facets and voxels by faces (6 neighbours, and 26 outside), so that a ring that
closes only in an edge or a node has no hole.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.contents.labels import component_runs, voxel_euler
from tetopt.geometry.manifold import (
    LabelSurfaces,
    Ridges,
    label_surfaces,
    surface_fans,
    surface_ridges,
)
from tetopt.geometry.quadratic import edge_ends
from tetopt.geometry.topology import Facets, connected_sets, facets
from tetopt.image import Image, transform_vectors
from tetopt.measure.fidelity import (
    FacetSurface,
    LabelInterface,
    VoxelRecord,
    check_cell_labels,
    facet_vectors,
    surface_areas,
    voxels_of,
)
from tetopt.mesh import Mesh
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernel_cache import njit

# least turn of the normals at a folded ridge: a dihedral angle below 120 degrees
FOLD_DEGREES = 60.0
NET_ITERATIONS = 16  # of the relaxation of surface nets; these values are VTK's
# by dimension: with fewer voxels the nets shrink by half of their area or more
NET_VOXELS = {2: 34, 3: 200}
SHIFTED_VOLUME = 1e-3  # of the volume in a net, by which it is shifted to see how its area grows
# relative: the area of nets that enclose the voxels' volume this nearly is at most 0.7 % off
VOLUME_NEAR = 0.01
# times the volume in a net: a ball of radius 3 voxels takes 2.5, nets of specks have collapsed
MOST_GROWN = 3.0
NET_RELAXATION = 0.5  # fraction of the way to the neighbours' mean that a point moves in each


def label_interfaces(
    labels: Image, mesh: Mesh, of_cell: ArrayLike, mask: Image | None = None
) -> list[LabelInterface]:
    """Measure smoothness, connectivity and manifoldness of the surface of each label.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0 to `tetopt.contents.labels.LARGEST_LABEL`.
    mesh : Mesh
        A conforming mesh; areas and folds of curved cells are those of their
        `Mesh.straight_pieces`.
    of_cell : (M,) array of whole numbers
        Label of each cell, such as from `tetopt.measure.fidelity.cell_labels`.
    mask : Image, optional
        Mask on the same voxels; only voxels of 1/2 or more count.

    Returns
    -------
    list of LabelInterface
        One for each label in the image, or in the mask, including 0, ascending.

    Raises
    ------
    InputError
        Values that are not labels, not one label per cell, or a mask on other voxels.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> what = tetopt.content(phantom.image(voxel_mm=4), labels)
    >>> result = tetopt.mesh_image(what, 300, iterations=4)
    >>> ball = tetopt.label_interfaces(labels, result.mesh, result.labels)[1]
    >>> ball.nonmanifold_edges, ball.nonmanifold_nodes, ball.mesh_euler  # without handles
    (0, 0, 2)
    """
    voxels = voxels_of(labels, mask)
    of_cell = voxels.rows_of(check_cell_labels(of_cell, mesh))
    shared = facets(mesh.cells)
    surfaces = label_surfaces(shared, of_cell)
    ridges = surface_ridges(surfaces)
    fans = surface_fans(surfaces, ridges)
    n_labels = max(len(voxels.labels), int(of_cell.max()) + 1)

    def counts(which: Ints, weights: NDArray | None = None) -> NDArray:
        """Counts by label, without the outside."""
        return np.bincount(
            which[which >= 0], None if weights is None else weights[which >= 0], n_labels
        )

    edges, nodes = ridges.n_facets > 2, fans.n_fans > 1
    of_label = {
        "n_facets": counts(surfaces.label),
        "nonmanifold_edges": counts(ridges.label[edges]),
        "nonmanifold_edges_two_labels": counts(ridges.label[edges & (ridges.n_labels == 2)]),
        "nonmanifold_nodes": counts(fans.label[nodes]),
        "nonmanifold_nodes_two_labels": counts(fans.label[nodes & (fans.n_labels == 2)]),
        "mesh_euler": _cell_eulers(
            shared, mesh.cells, of_cell, counts(ridges.label), counts(fans.label)
        ),
        "mesh_cavities": _cell_cavities(shared, mesh.cells, of_cell, n_labels),
    }
    pieces, n_pieces = mesh.straight_pieces()
    if n_pieces > 1:  # topology is that of the cells
        surfaces = label_surfaces(facets(pieces.cells), np.repeat(of_cell, n_pieces))
        ridges = surface_ridges(surfaces)
    turns = _turns(pieces.points, surfaces, ridges)
    turns[ridges.nodes.min(axis=1) >= len(mesh.points)] = np.nan  # within a curved facet
    area = counts(surfaces.label, surface_areas(FacetSurface(pieces.points, surfaces.nodes)))
    n_folded = counts(ridges.label[turns > FOLD_DEGREES])
    n_paired = counts(ridges.label[np.isfinite(turns)])
    return [
        LabelInterface(
            area=float(area[row]),
            area_ratio=float(area[row]) / shape["smooth_area"]
            if area[row] > 0.0 and is_large
            else np.nan,
            folded=float(n_folded[row] / n_paired[row]) if n_paired[row] else np.nan,
            **shape,
            **{name: int(counted[row]) for name, counted in of_label.items()},
        )
        for row, is_large, shape in voxels.once(_voxel_shapes, labels)
    ]


def _voxel_shapes(voxels: VoxelRecord, image: Image) -> list[tuple[int, bool, dict[str, Any]]]:
    """Measure the closed smooth surface of each label's voxels: its row, whether it has enough for
    their volume, and its numbers.
    """
    rows = []
    for row, box in enumerate(voxels.boxes):
        if box is None:
            continue
        is_label = np.pad(voxels.rows[box] == row, 1)
        n_voxels = np.count_nonzero(is_label)
        is_large = bool(n_voxels >= NET_VOXELS[image.ndim])
        nets = smooth_surface(is_label, image.affine)
        smooth_area = (
            area_at_volume(nets, n_voxels * image.voxel_volume)
            if is_large
            else float(surface_areas(nets).sum())
        )
        numbers = {
            "label": int(voxels.labels[row]),
            "smooth_area": smooth_area,
            "euler": voxel_euler(is_label),
            "cavities": voxel_cavities(is_label),
        }
        rows.append((row, is_large, numbers))
    return rows


def smooth_surface(is_label: Bools, affine: Floats) -> FacetSurface:
    """Surface nets of a label's voxels, in mm, without the translation to their place in the world.

    Points of the nets move repeatedly halfway to their neighbours' mean, within a voxel's diagonal
    of their origin, with the same numbers as `pyvista.ImageDataFilters.contour_labels`; the same is
    done in the plane.

    Parameters
    ----------
    is_label : (s_0, ..., s_{n-1}) bool
        False in the outermost voxels; otherwise the surface is open there.
    affine : (n+1, n+1) float64
        From index to world coordinates in mm.
    """
    import pyvista  # slow to load, and only needed with labels
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkSurfaceNets2D, vtkSurfaceNets3D

    n = is_label.ndim
    grid = pyvista.ImageData(dimensions=is_label.shape + (1,) * (3 - n))
    grid.point_data["label"] = is_label.astype(np.uint8).ravel(order="F")
    grid.set_active_scalars("label")
    nets = vtkSurfaceNets2D() if n == 2 else vtkSurfaceNets3D()
    nets.SetInputData(grid)
    nets.SetBackgroundLabel(0)
    for value in (0, 1):  # without the first, VTK relaxes edges at which voxels touch differently
        nets.SetLabel(value, value)
    nets.SmoothingOn()
    smoother = nets.GetSmoother()
    smoother.SetNumberOfIterations(NET_ITERATIONS)
    smoother.SetRelaxationFactor(NET_RELAXATION)
    smoother.SetConstraintDistance(n**0.5)
    if isinstance(nets, vtkSurfaceNets3D):
        nets.AutomaticSmoothingConstraintsOff()
        nets.SetOutputMeshTypeToTriangles()
    with pyvista.vtk_verbosity("off"):
        nets.Update()
    surface = nets.GetOutput()
    nodes = vtk_to_numpy(
        (surface.GetPolys() if n == 3 else surface.GetLines()).GetConnectivityArray()
    )
    points = np.asarray(pyvista.wrap(surface).points, dtype=np.float64)[:, :n]
    return FacetSurface(
        transform_vectors(points, affine[:n, :n]), nodes.reshape(-1, n).astype(np.int64)
    )


def area_at_volume(surface: FacetSurface, volume: float) -> float:
    """Area of a closed, consistently oriented surface that is grown to enclose a volume; in 2-D of
    the surface itself.

    Area is a power of volume: 2/3 for a ball, 1/2 for a tube, 0 for a sheet. The power is that of a
    small shift along the nodes' normals.
    """
    points, nodes = surface
    if points.shape[1] == 2:
        return float(surface_areas(surface).sum())
    vectors = facet_vectors(points, nodes)
    area, enclosed = (
        float(surface_areas(surface).sum()),
        float((vectors * points[nodes[:, 0]]).sum()) / 6.0,
    )
    grown = min(volume / max(abs(enclosed), SHIFTED_VOLUME * volume), MOST_GROWN)
    if abs(grown - 1.0) < VOLUME_NEAR or not area > 0.0:
        return area
    sums = _node_sums(vectors, nodes, len(points))
    normals = sums / np.maximum(np.linalg.norm(sums, axis=1), np.finfo(np.float64).tiny)[:, None]
    shifted = FacetSurface(points + SHIFTED_VOLUME * enclosed / area * normals, nodes)
    return float(
        area * grown ** (np.log(surface_areas(shifted).sum() / area) / np.log1p(SHIFTED_VOLUME))
    )


@njit(cache=True, nogil=True)
def _node_sums(vectors: NDArray, nodes: NDArray, n_nodes: int) -> NDArray:
    """Sums (n_nodes, 3) of the vectors (T, 3) of the facets (T, 3) at each node."""
    sums = np.zeros((n_nodes, 3))
    for t in range(len(nodes)):
        for k in range(3):
            for axis in range(3):
                sums[nodes[t, k], axis] += vectors[t, axis]
    return sums


def voxel_cavities(is_label: Bools) -> int:
    """Number of enclosed components of the space around voxels, which corners connect; 0 in 2-D."""
    if is_label.ndim == 2:
        return 0
    outside = ~np.pad(is_label, 1)
    return component_runs(outside, outside, has_corners=True)[0] - 1


def _turns(points: Floats, surfaces: LabelSurfaces, ridges: Ridges) -> Floats:
    """Angle between the normals of the two facets at each ridge, (R,), degrees; nan with more
    facets.
    """
    corners = points[surfaces.nodes]
    along = corners[:, 1:] - corners[:, :1]
    if points.shape[1] == 2:
        normals = np.column_stack([along[:, 0, 1], -along[:, 0, 0]])
    else:
        normals = np.cross(along[:, 0], along[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(np.float64).tiny)[:, None]
    of_ridge = np.argsort(ridges.of_facet.ravel(), kind="stable") // points.shape[1]
    first = np.cumsum(ridges.n_facets) - ridges.n_facets
    paired = np.flatnonzero(ridges.n_facets == 2)
    cosine = (normals[of_ridge[first[paired]]] * normals[of_ridge[first[paired] + 1]]).sum(axis=1)
    turns = np.full(len(ridges.n_facets), np.nan)
    # 60 on lattices must not exceed 60
    turns[paired] = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).round(6)
    return turns


def _cell_eulers(
    shared: Facets,
    cells: Ints,
    of_cell: Ints,
    n_ridges: Ints,
    n_nodes: Ints,
) -> Ints:
    """`voxel_euler` of each label's cells: cells, minus facets between them, plus inner edges,
    minus inner nodes.

    `n_ridges` and `n_nodes` are those of each label's surface, which are not inner ones.
    """
    n, n_labels, base = cells.shape[1] - 1, len(n_nodes), int(cells.max()) + 1
    near, far = of_cell[shared.cells].T
    is_inner = (shared.n_cells == 2) & (near == far)
    total = np.bincount(of_cell, minlength=n_labels) - np.bincount(
        near[is_inner], minlength=n_labels
    )
    nodes = _distinct(of_cell[:, None] * base + cells) // base
    total -= (-1) ** (n + 1) * (np.bincount(nodes, minlength=n_labels) - n_nodes)
    if n == 3:
        ends = edge_ends(cells)
        edges = _distinct((of_cell[:, None] * base + ends[..., 0]) * base + ends[..., 1]) // base**2
        total += np.bincount(edges, minlength=n_labels) - n_ridges
    return 2 * total


def _distinct(numbers: Ints) -> Ints:
    """Distinct numbers, ascending; sorting takes less time than `np.unique`, which hashes them."""
    ordered = np.sort(numbers, axis=None)
    return ordered[np.append(True, ordered[1:] != ordered[:-1])]


def _cell_cavities(shared: Facets, cells: Ints, of_cell: Ints, n_labels: int) -> Ints:
    """`voxel_cavities` of each label's cells, where nodes connect the space around them.

    Cells connected by facets have one closed surface for each part of the space around them
    (Alexander's duality): all but one of these enclose a cavity. Facets of one such surface are
    linked by nodes.
    """
    if cells.shape[1] == 3:
        return np.zeros(n_labels, dtype=np.int64)
    near, far = shared.cells.T
    is_inner = (shared.n_cells == 2) & (of_cell[near] == of_cell[far])
    n_pieces, piece = connected_sets(near[is_inner], far[is_inner], len(cells))
    row, side = np.nonzero((shared.cells >= 0) & ~is_inner[:, None])
    cell = shared.cells[row, side]
    corners = piece[cell][:, None] + n_pieces * shared.nodes[row]
    corner = np.unique(corners, return_inverse=True)[1].reshape(corners.shape)
    n_surfaces, surface = connected_sets(
        corner[:, [0, 0]].ravel(), corner[:, 1:].ravel(), int(corner.max()) + 1
    )
    of_piece, of_surface = np.empty(n_pieces, dtype=np.int64), np.empty(n_surfaces, dtype=np.int64)
    of_piece[piece], of_surface[surface[corner[:, 0]]] = of_cell, of_cell[cell]
    return np.bincount(of_surface, minlength=n_labels) - np.bincount(of_piece, minlength=n_labels)
