"""3-D pictures, rendered off screen by pyvista."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyvista
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from scipy import ndimage

from tetopt.geometry.topology import boundary_facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.report.colours import LISTED_LABELS, grey_limits, plain_text
from tetopt.report.exhibit import COLOUR_MAP, NO_VALUE, Exhibit, Field, first_axis, warp_factors
from tetopt.report.figures import FIGURE_SUFFIXES, MESH_LINE
from tetopt.report.viewer import View
from tetopt.system.files import check_suffix, written_whole

STRUCTURE_COLOUR = "#d95f02"  # orange, which stands out from the grey slices behind it
SCENE_VIEWPOINT = (0.9, 1.25, 0.7)  # position of the camera, RAS: on the right, in front and above
GLASS_OPACITY = 0.6  # of the cells' colours over the image: colours are distinct, and voxels remain visible
ABOVE_IMAGE = 1e-3  # distance of the cells in a section from the image there, as a fraction of the mesh's extent
SCENE_ZOOM = 1.05  # times the size at which the scene surely fits
BAR_FRACTION, LEGEND_FRACTION = 0.1, 0.2  # of the picture's width, for a colour bar or legend beside the scene
Draw = Callable[[pyvista.Plotter], object]  # adds a scene's parts to a plotter


def save_scenes(path: str | Path, scenes: Sequence[tuple[str, Draw]], columns: int | None = None) -> None:
    """Write a PNG of scenes with titles, seen from the same side, in one row or in rows of `columns`.

    A scene is a function that adds its parts to a plotter, such as the result of `structure_before_slices`.
    """
    # Without a display, VTK issues a warning before it renders off screen.
    with written_whole(check_suffix(path, FIGURE_SUFFIXES)) as temporary, pyvista.vtk_verbosity("off"):
        columns = min(columns or len(scenes), len(scenes))
        rows = -(-len(scenes) // columns)
        plotter = pyvista.Plotter(
            off_screen=True, shape=(rows, columns), border=False, window_size=(1100 * columns, 1000 * rows)
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
    """Draw a scene in the plotter's current part, and move the camera to the viewpoint of all scenes."""
    draw(plotter)
    plotter.view_vector(SCENE_VIEWPOINT, viewup=(0.0, 0.0, 1.0))
    plotter.camera.zoom(SCENE_ZOOM * (1.0 - abs(plotter.camera.GetWindowCenter()[0])))


def structure_before_slices(image: Image, mesh: Mesh, chosen: NDArray[np.int64]) -> Draw:
    """Return a scene of the boundary of chosen cells in front of the volume's middle slices, on the box's far sides."""
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
    """Return a scene of the volume's middle slices in place, with the edges of cells below the horizontal one."""
    middle = image.to_world((np.array(image.shape) - 1.0) / 2.0)

    def draw(plotter: pyvista.Plotter) -> None:
        _add_slices(plotter, image, [image.shape[axis] // 2 for axis in range(3)])
        part = mesh.cells[mesh.points[mesh.cells].mean(axis=1)[:, 2] < middle[2]]
        edges = pyvista.PolyData.from_regular_faces(mesh.points, boundary_facets(part)).extract_all_edges()
        plotter.add_mesh(edges, color="#2060c0", line_width=1.5)

    return draw


def cutaway(view: View, limits: tuple[float, float]) -> Draw:
    """Return a scene of the surface of an opened mesh, shaded by cell values between `limits`, with edges."""
    # The darkest grey is not quite black, so that light still shows the orientation of a facet.
    shown = (limits[0] - 0.25 * (limits[1] - limits[0]), limits[1])
    surface = pyvista.PolyData.from_regular_faces(view.points, view.triangles)
    surface.cell_data["h"] = view.values
    return lambda plotter: plotter.add_mesh(
        surface, scalars="h", cmap="gray", clim=shown, show_scalar_bar=False, show_edges=True, edge_color=MESH_LINE,
        line_width=1, ambient=0.3,
    )  # fmt: skip


def opened_mesh(shown: Exhibit) -> Draw:
    """Return the initial scene of `tetopt view`: the mesh cut across its middle, coloured by its first field.

    The image is drawn in the cut. A mesh with displacements is drawn deformed, without the undeformed image.
    """
    field, (factor, _) = shown.fields[0], warp_factors(shown)
    u = next(iter(shown.displacements.values()), None)
    points = shown.mesh.points if u is None else shown.mesh.points + factor * u
    image = shown.image if u is None else None
    axis = first_axis(shown)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    grid = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: shown.mesh.cells}, points)
    look: dict[str, Any] = {"scalars": "value", "show_scalar_bar": False, "show_edges": True, "edge_color": MESH_LINE}
    if field.categories:
        grid.cell_data["value"] = _label_colours(field)
        look["rgb"] = True
    else:
        (grid.cell_data if field.nodes is None else grid.point_data)["value"] = (
            field.values if field.nodes is None else field.nodes
        )
        look |= {"cmap": COLOUR_MAP, "clim": field.limits, "nan_color": NO_VALUE}

    def draw(plotter: pyvista.Plotter) -> None:
        plotter.enable_parallel_projection()  # keeps all of it in the picture
        plotter.camera.SetWindowCenter(LEGEND_FRACTION if field.categories else BAR_FRACTION, 0.0)
        plane = {"normal": np.eye(3)[axis], "origin": middle}
        behind, section = grid.extract_surface(algorithm="dataset_surface").clip(**plane), grid.slice(**plane)
        if behind.n_cells:
            plotter.add_mesh(behind, ambient=0.2, **look)
        if section.n_cells:
            # Nearer to the camera than the image, which would hide it where both are equally near.
            glass = section.translate(ABOVE_IMAGE * np.ptp(points, axis=0).max() * plane["normal"])
            plotter.add_mesh(glass, lighting=False, opacity=1.0 if image is None else GLASS_OPACITY, **look)
        if image is not None:
            plotter.add_mesh(
                plane_slice(image, axis, middle[axis]), scalars="h", cmap="gray", lighting=False,
                clim=grey_limits([image.data.astype(np.float64)]), show_scalar_bar=False,
            )  # fmt: skip
        _add_key(plotter, field)

    return draw


def _label_colours(field: Field) -> NDArray[np.uint8]:
    """Return the red, green and blue of each cell's label (M, 3); `NO_VALUE` for values that are not labels."""
    colours = np.tile(np.rint(255.0 * np.array(to_rgb(NO_VALUE))), (len(field.values), 1))
    for label, colour in field.categories:
        colours[field.values == label] = np.rint(255.0 * np.array(to_rgb(colour)))
    return colours.astype(np.uint8)


def _add_key(plotter: pyvista.Plotter, field: Field) -> None:
    """Add a colour bar, or a legend of the labels with most cells."""
    title = plain_text(f"{field.name} ({field.unit})" if field.unit else field.name)
    if not field.categories:
        mapper = pyvista.DataSetMapper()
        mapper.lookup_table = pyvista.LookupTable(COLOUR_MAP, scalar_range=field.limits)
        plotter.add_scalar_bar(
            title=title, mapper=mapper, color="black", fmt="%.4g", vertical=True, position_x=0.86, position_y=0.63,
            height=0.35, width=0.06, title_font_size=18, label_font_size=16, render=False,
        )  # fmt: skip
        return
    most = sorted(field.categories, key=lambda entry: -np.count_nonzero(field.values == entry[0]))[:LISTED_LABELS]
    entries = [
        [plain_text(f" {label} {field.names.get(label, '')}".rstrip()), colour] for label, colour in sorted(most)
    ]
    if len(field.categories) > LISTED_LABELS:
        entries.append([f" and {len(field.categories) - LISTED_LABELS} more", "#555555"])
    plotter.add_legend(entries, bcolor="white", face="rectangle", size=(0.2, 0.03 * len(entries)))


def plane_slice(image: Image, axis: int, at: float) -> pyvista.PolyData:
    """Return the image in a world plane: a polygon for each voxel that the plane cuts.

    Parameters
    ----------
    image : Image
        Three-dimensional.
    axis : int
        World axis normal to the plane, 0 for R-L, 1 for A-P, 2 for S-I.
    at : float
        Position of the plane on this axis, mm.

    Returns
    -------
    pyvista.PolyData
        World coordinates, mm, with cell data `h`, the voxels' values.
    """
    voxels = pyvista.ImageData(dimensions=np.array(image.shape) + 1, origin=(-0.5, -0.5, -0.5))
    voxels.cell_data["h"] = image.data.ravel(order="F")
    # The index of a point in the plane; halfway between two layers of voxels the upper one is shown.
    inside = np.linalg.inv(image.affine[:3, :3])[:, axis] * (at - image.affine[axis, 3]) + 1e-6
    return voxels.slice(normal=image.affine[axis, :3], origin=inside).transform(image.affine, inplace=False)


def dark_structure_surface(image: Image, below: float, near: NDArray[np.bool_]) -> pyvista.PolyData:
    """Return the surface at level `below` of the dark structures within the mask `near`, world mm.

    Voxels below the level are eroded by one voxel, which separates the ventricles from the sulci. The connected
    component with most voxels in `near`, and those with at least a tenth of that, are dilated again, and marching cubes
    run on the intensities of the voxels in and next to them. Without such components the surface has no points.
    """
    is_dark = image.data < below
    pieces, _ = ndimage.label(ndimage.binary_erosion(is_dark))
    votes = np.bincount(pieces[near & (pieces > 0)], minlength=2)
    chosen = np.flatnonzero(votes > 0.1 * votes.max())
    kept = ndimage.binary_dilation(np.isin(pieces, chosen), iterations=2, mask=is_dark)
    h = np.where(ndimage.binary_dilation(kept) | ~is_dark, image.data, image.data.max())
    grid = pyvista.ImageData(dimensions=image.shape)
    grid.point_data["h"] = h.astype(np.float64).ravel(order="F")
    return grid.contour([below], scalars="h", method="flying_edges").transform(image.affine, inplace=False)


def _far_side(image: Image, axis: int) -> float:
    """Return the index along one axis of the box's side that is farther from the camera."""
    outward = image.affine[:3, axis] @ np.asarray(SCENE_VIEWPOINT)
    return -0.5 if outward > 0.0 else image.shape[axis] - 0.5


def _add_slices(plotter: pyvista.Plotter, image: Image, places: Sequence[float]) -> None:
    """Add the middle slice across each index axis, drawn at an index of `places` along that axis."""
    limits = grey_limits([image.data], brightest=99.8)
    for axis, at in enumerate(places):
        plotter.add_mesh(
            _slice_sheet(image, axis, at), scalars="h", cmap="gray", clim=limits, show_scalar_bar=False, lighting=False
        )


def _slice_sheet(image: Image, axis: int, at: float) -> pyvista.StructuredGrid:
    """Return the middle slice across an index axis, moved to index `at`, in world mm, with one facet per pixel."""
    pixels = np.take(image.data, image.shape[axis] // 2, axis=axis)
    corners = [np.arange(s + 1) - 0.5 for s in image.shape]
    corners[axis] = np.array([at])
    index = np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1)
    world = image.to_world(index)
    sheet = pyvista.StructuredGrid(world[..., 0], world[..., 1], world[..., 2])
    sheet.cell_data["h"] = pixels.ravel(order="F")
    return sheet
