"""Scenes of a volume's slices with a structure, its surface or a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyvista
from scipy import ndimage

from tetopt.geometry.topology import boundary_facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.report.colours import grey_limits
from tetopt.report.scene import SCENE_VIEWPOINT, Draw
from tetopt.system.arrays import Bools, Ints

STRUCTURE_COLOUR = "#d95f02"  # orange, which stands out from the grey slices behind it


def structure_before_slices(image: Image, mesh: Mesh, chosen: Ints) -> Draw:
    """Return a scene of the boundary of chosen cells in front of the volume's middle slices, on
    the box's far sides.
    """
    surface = pyvista.PolyData.from_regular_faces(mesh.points, boundary_facets(mesh.cells[chosen]))
    return _before_slices(image, surface, show_edges=True, edge_color="#402000", line_width=1)


def isosurface_before_slices(image: Image, surface: pyvista.PolyData) -> Draw:
    """Return a scene of an isosurface of the voxels in front of the same slices."""
    return _before_slices(image, surface, smooth_shading=True)


def _before_slices(image: Image, surface: pyvista.PolyData, **look: Any) -> Draw:
    def draw(plotter: pyvista.Plotter) -> None:
        _add_slices(plotter, image, [_far_side(image, axis) for axis in range(3)])
        plotter.add_mesh(surface, color=STRUCTURE_COLOUR, ambient=0.25, **look)

    return draw


def slices_in_mesh(image: Image, mesh: Mesh) -> Draw:
    """Return a scene of the volume's middle slices in place, with the edges of cells below the
    horizontal one.
    """
    middle = image.to_world((np.array(image.shape) - 1.0) / 2.0)

    def draw(plotter: pyvista.Plotter) -> None:
        _add_slices(plotter, image, [image.shape[axis] // 2 for axis in range(3)])
        part = mesh.cells[mesh.points[mesh.cells].mean(axis=1)[:, 2] < middle[2]]
        edges = pyvista.PolyData.from_regular_faces(
            mesh.points, boundary_facets(part)
        ).extract_all_edges()
        plotter.add_mesh(edges, color="#2060c0", line_width=1.5)

    return draw


def dark_structure_surface(image: Image, below: float, near: Bools) -> pyvista.PolyData:
    """Return the surface at level `below` of the dark structures within the mask `near`, world mm.

    Voxels below the level are eroded by one voxel, which separates the ventricles from the sulci.
    The connected component with most voxels in `near`, and those with at least a tenth of that, are
    dilated again, and marching cubes run on the intensities of the voxels in and next to them.
    Without such components the surface has no points.
    """
    is_dark = image.data < below
    pieces, _ = ndimage.label(ndimage.binary_erosion(is_dark))
    votes = np.bincount(pieces[near & (pieces > 0)], minlength=2)
    chosen = np.flatnonzero(votes > 0.1 * votes.max())
    kept = ndimage.binary_dilation(np.isin(pieces, chosen), iterations=2, mask=is_dark)
    h = np.where(ndimage.binary_dilation(kept) | ~is_dark, image.data, image.data.max())
    grid = pyvista.ImageData(dimensions=image.shape)
    grid.point_data["h"] = h.astype(np.float64).ravel(order="F")
    return grid.contour([below], scalars="h", method="flying_edges").transform(
        image.affine, inplace=False
    )


def _far_side(image: Image, axis: int) -> float:
    """Return the index along one axis of the box's side that is farther from the camera."""
    outward = image.affine[:3, axis] @ np.asarray(SCENE_VIEWPOINT)
    return -0.5 if outward > 0.0 else image.shape[axis] - 0.5


def _add_slices(plotter: pyvista.Plotter, image: Image, places: Sequence[float]) -> None:
    """Add the middle slice across each index axis, drawn at an index of `places` along that
    axis.
    """
    limits = grey_limits([image.data], brightest=99.8)
    for axis, at in enumerate(places):
        plotter.add_mesh(
            _slice_sheet(image, axis, at),
            scalars="h",
            cmap="gray",
            clim=limits,
            show_scalar_bar=False,
            lighting=False,
        )


def _slice_sheet(image: Image, axis: int, at: float) -> pyvista.StructuredGrid:
    """Return the middle slice across an index axis, moved to index `at`, in world mm, with one
    facet per pixel.
    """
    pixels = np.take(image.data, image.shape[axis] // 2, axis=axis)
    corners = [np.arange(s + 1) - 0.5 for s in image.shape]
    corners[axis] = np.array([at])
    index = np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1)
    world = image.to_world(index)
    sheet = pyvista.StructuredGrid(world[..., 0], world[..., 1], world[..., 2])
    sheet.cell_data["h"] = pixels.ravel(order="F")
    return sheet
