"""3-D pictures, rendered off screen by pyvista."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyvista
from scipy import ndimage

from tetopt.errors import InputError
from tetopt.geometry.simplex import centroids
from tetopt.geometry.topology import boundary_facets, facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.report.colours import grey_limits
from tetopt.report.figures import FIGURE_SUFFIXES, MESH_LINE
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.files import check_suffix, written_whole

STRUCTURE_COLOUR = "#d95f02"  # orange, which stands out from the grey slices behind it
SCENE_VIEWPOINT = (0.9, 1.25, 0.7)  # position of the camera, RAS: on the right, in front and above
SCENE_ZOOM = 1.05  # times the size at which the scene surely fits
Draw = Callable[[pyvista.Plotter], object]  # adds a scene's parts to a plotter


class View(NamedTuple):
    """A triangle surface to view."""

    title: str
    points: Floats  # (N, 3) world mm
    triangles: Ints  # (K, 3), normals pointing out
    values: Floats  # (K,) of each triangle's cell, drawn in grey


def view_of(mesh: Mesh, means: Floats, title: str, centre: Floats | None = None) -> View:
    """Return the surface of a mesh without its right, front, upper octant, which shows the inside.

    Parameters
    ----------
    mesh : Mesh
        Tetrahedra.
    means : (M,) float64
        The value of each cell; a triangle gets that of its cell.
    title : str
    centre : (3,) float64, optional
        Corner of the octant, world mm; by default the middle of the mesh's box. Cells whose
        centroids lie beyond it are removed whole; if that would be all cells, none is removed.

    Raises
    ------
    InputError
        The mesh has triangles, or the number of means is not that of cells.
    """
    if mesh.ndim != 3:
        raise InputError(f"{title}: expected a tetrahedral mesh, got triangles")
    if len(means) != len(mesh.cells):
        raise InputError(
            f"{title}: expected one mean for each of {len(mesh.cells)} cells, got {len(means)}"
        )
    if centre is None:
        centre = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2.0
    is_kept = (centroids(mesh.points, mesh.cells) <= centre).any(axis=1)
    if not np.any(is_kept):
        is_kept = np.full(len(mesh.cells), True)
    cells, values = mesh.cells[is_kept], np.asarray(means, dtype=np.float64)[is_kept]
    sides = facets(cells)
    used, triangles = np.unique(boundary_facets(cells), return_inverse=True)
    return View(
        title,
        mesh.points[used],
        triangles.reshape(-1, 3),
        values[sides.cells[sides.n_cells == 1, 0]],
    )


def save_scenes(
    path: str | Path, scenes: Sequence[tuple[str, Draw]], columns: int | None = None
) -> None:
    """Write a PNG of scenes with titles, seen from the same side, in one row or in rows of
    `columns`.

    A scene is a function that adds its parts to a plotter, such as the result of
    `structure_before_slices`.
    """
    # Without a display, VTK issues a warning before it renders off screen.
    with (
        written_whole(check_suffix(path, FIGURE_SUFFIXES)) as temporary,
        pyvista.vtk_verbosity("off"),
    ):
        columns = min(columns or len(scenes), len(scenes))
        rows = -(-len(scenes) // columns)
        plotter = pyvista.Plotter(
            off_screen=True,
            shape=(rows, columns),
            border=False,
            window_size=(1100 * columns, 1000 * rows),
        )
        plotter.set_background("white")
        for number, (title, draw) in enumerate(scenes):
            plotter.subplot(*divmod(number, columns))
            put_scene(plotter, draw)
            if title:
                plotter.add_text(title, font_size=14, color="black", position="upper_edge")
        plotter.screenshot(temporary)
        plotter.close()


def put_scene(plotter: pyvista.Plotter, draw: Draw) -> None:
    """Draw a scene in the plotter's current part, and move the camera to the viewpoint of all
    scenes.
    """
    draw(plotter)
    plotter.view_vector(SCENE_VIEWPOINT, viewup=(0.0, 0.0, 1.0))
    plotter.camera.zoom(SCENE_ZOOM)


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


def cutaway(view: View, limits: tuple[float, float]) -> Draw:
    """Return a scene of the surface of an opened mesh, shaded by cell values between `limits`,
    with edges.
    """
    # The darkest grey is not quite black, so that light still shows the orientation of a facet.
    shown = (limits[0] - 0.25 * (limits[1] - limits[0]), limits[1])
    surface = pyvista.PolyData.from_regular_faces(view.points, view.triangles)
    surface.cell_data["h"] = view.values
    return lambda plotter: plotter.add_mesh(
        surface,
        scalars="h",
        cmap="gray",
        clim=shown,
        show_scalar_bar=False,
        show_edges=True,
        edge_color=MESH_LINE,
        line_width=1,
        ambient=0.3,
    )


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
