"""3-D pictures, rendered off screen by pyvista."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyvista

from tetopt.errors import InputError
from tetopt.geometry.simplex import centroids
from tetopt.geometry.topology import boundary_facets, facets
from tetopt.mesh import Mesh
from tetopt.report.figures import FIGURE_SUFFIXES, MESH_LINE
from tetopt.system.arrays import Floats, Ints
from tetopt.system.files import check_suffix, written_whole

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

    A scene is a function that adds its parts to a plotter, such as the result of `cutaway`.
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
