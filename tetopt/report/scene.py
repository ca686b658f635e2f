"""Pictures in three dimensions, rendered off screen by pyvista."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyvista
from numpy.typing import NDArray

from tetopt.geometry.topology import boundary_facets
from tetopt.image import Image
from tetopt.io.files import written_whole
from tetopt.mesh import Mesh

SURFACE = "#d95f02"


def facets_surface(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> pyvista.PolyData:
    """Triangles (K, 3) between points (N, 3) as a pyvista surface."""
    return pyvista.PolyData.from_regular_faces(points, triangles)


def structure_picture(path: str | Path, image: Image, mesh: Mesh, chosen: NDArray[np.int64]) -> None:
    """PNG of the boundary of the chosen cells in front of three slices of the volume, as Fig. 3(e, f).

    The slices pass through the middle of the box; edges of the structure's facets are drawn.
    """
    surface = facets_surface(mesh.points, boundary_facets(mesh.cells[chosen]))
    limits = np.percentile(image.data, [0.5, 99.8])
    # Without a display VTK complains of the missing one before it renders off screen.
    with written_whole(Path(path)) as temporary, pyvista.vtk_verbosity("off"):
        plotter = pyvista.Plotter(off_screen=True, window_size=(1100, 1000))
        plotter.set_background("white")
        for axis in range(3):
            plotter.add_mesh(
                _slice_sheet(image, axis), scalars="h", cmap="gray", clim=limits, show_scalar_bar=False, lighting=False
            )
        plotter.add_mesh(surface, color=SURFACE, show_edges=True, edge_color="#402000", line_width=1, ambient=0.25)
        plotter.view_vector((0.9, 1.25, 0.7), viewup=(0.0, 0.0, 1.0))
        plotter.camera.zoom(1.05)
        plotter.screenshot(temporary)
        plotter.close()


def _slice_sheet(image: Image, axis: int) -> pyvista.StructuredGrid:
    """The slice on the far side of the box across one index axis, in world mm, one facet a pixel."""
    at = 0 if image.to_world(np.eye(3)[axis])[axis] > image.to_world(np.zeros(3))[axis] else image.shape[axis] - 1
    middle = image.shape[axis] // 2
    pixels = np.take(image.data, middle, axis=axis)
    corners = [np.arange(s + 1) - 0.5 for s in image.shape]
    corners[axis] = np.array([at + 0.0])
    index = np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1)
    world = image.to_world(index)
    sheet = pyvista.StructuredGrid(world[..., 0], world[..., 1], world[..., 2])
    sheet.cell_data["h"] = pixels.ravel(order="F")
    return sheet
