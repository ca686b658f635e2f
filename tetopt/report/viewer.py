"""An interactive 3-D view embedded in a page: opened meshes as data, drawn by `viewer.js` in the browser's WebGL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.simplex import centroids
from tetopt.geometry.topology import boundary_facets, facets
from tetopt.io.text import plain
from tetopt.mesh import Mesh
from tetopt.report.colours import grey_limits
from tetopt.report.page import data_html, packed, rendered, script_html


class View(NamedTuple):
    """A triangle surface to view."""

    title: str
    points: NDArray[np.float64]  # (N, 3) world mm
    triangles: NDArray[np.int64]  # (K, 3), normals pointing out
    values: NDArray[np.float64]  # (K,) of each triangle's cell, drawn in grey


def view_of(mesh: Mesh, means: NDArray[np.float64], title: str, centre: NDArray[np.float64] | None = None) -> View:
    """Return the surface of a mesh without its right, front, upper octant, which shows the inside.

    Parameters
    ----------
    mesh : Mesh
        Tetrahedra.
    means : (M,) float64
        The value of each cell; a triangle gets that of its cell.
    title : str
    centre : (3,) float64, optional
        Corner of the octant, world mm; by default the middle of the mesh's box. Cells whose centroids lie beyond it are
        removed whole; if that would be all cells, none is removed.

    Raises
    ------
    InputError
        The mesh has triangles, or the number of means is not that of cells.
    """
    if mesh.ndim != 3:
        raise InputError(f"{title}: expected a tetrahedral mesh, got triangles")
    if len(means) != len(mesh.cells):
        raise InputError(f"{title}: expected one mean for each of {len(mesh.cells)} cells, got {len(means)}")
    if centre is None:
        centre = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2.0
    is_kept = (centroids(mesh.points, mesh.cells) <= centre).any(axis=1)
    if not np.any(is_kept):
        is_kept = np.full(len(mesh.cells), True)
    cells, values = mesh.cells[is_kept], np.asarray(means, dtype=np.float64)[is_kept]
    sides = facets(cells)
    used, triangles = np.unique(boundary_facets(cells), return_inverse=True)
    return View(title, mesh.points[used], triangles.reshape(-1, 3), values[sides.cells[sides.n_cells == 1, 0]])


def views_html(views: Sequence[View]) -> Markup:
    """Return views side by side that turn together, as markup with data and script, without external references.

    A browser without WebGL 2 or scripts shows a message.
    """
    if not views:
        return Markup()
    titles, data = [plain(view.title) for view in views], data_html("views-data", _views_data(views))
    return rendered("report/viewer.html", titles=titles, data=data, script=script_html("viewer"))


def _views_data(views: Sequence[View]) -> list[dict[str, Any]]:
    """Encode views in a common box: positions as 16-bit fractions of its half diagonal, values as bytes of a range."""
    corners = np.concatenate([view.points for view in views])
    low, high = corners.min(axis=0), corners.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2.0, 1e-300)
    darkest, brightest = grey_limits([view.values for view in views])
    data = []
    for view in views:
        places = np.rint((view.points - (low + high) / 2.0) / radius * 32767.0)
        tones = np.rint(np.clip((view.values - darkest) / (brightest - darkest), 0.0, 1.0) * 255.0)
        data.append(
            {"points": packed(places, "<i2"), "triangles": packed(view.triangles, "<u4"), "tones": packed(tones, "u1")}
        )
    return data
