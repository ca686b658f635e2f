"""A picture of a few kB to judge one of hundreds of subjects at a glance: two slices along the
world's axes.

Slices follow the world's axes, not those of the voxels: a wrong affine is visible, whatever the
order of the voxels, and an oblique image appears rotated.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from scipy.ndimage import map_coordinates

from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.energy.sampling import cell_of_voxel
from tetopt.geometry.cut import plane_cut, triangle_cut
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.label_names import NO_TABLE, LabelTable
from tetopt.report.colours import grey_limits, label_colours
from tetopt.report.figures import MASK_LINE, MESH_LINE
from tetopt.system.arrays import Floats, Ints

SIDE_PIXELS = 128  # of a view: enough for a head, where a page has 500 of them
SAMPLES_PER_PIXEL = 2  # along each side: fine stripes would cause aliasing with single samples
MARGIN_FRACTION = 0.08  # of the mesh's largest side, on each side of it
# slabs across the mesh: it is cut in the fullest if its middle has less than half as much
SLAB_COUNT = 20
PALETTE_COLOURS = 32  # greys and oranges, enough for the eye: half of the bytes of 256
# width of edges times the root of the number of cut cells: a constant tint for any number
EDGE_POINTS = 4.0
LABEL_ALPHA = 0.45  # opacity of the cells' labels over the image
SIDE_LETTERS = ("LR", "PA")  # at the left and the right of a view along this world axis
LETTER_POINTS = 4.5  # 8 pixels, the smallest readable size
VIEW_AXES = {
    3: ((0, 1), (1, 2)),
    2: ((0, 1),),
}  # horizontal and vertical world axes: axial and sagittal views; a single view in 2-D


def thumbnail_png(
    image: Image,
    mesh: Mesh,
    mask: Image | None = None,
    labels: Image | None = None,
    of_cell: Ints | None = None,
    table: LabelTable = NO_TABLE,
) -> bytes:
    """Return slices of an image with its mesh as a PNG; the same inputs give the same bytes.

    A volume gives an axial slice on the left and a sagittal one on the right, 256 x 128 pixels,
    through the mesh's middle (or, if that is hollow, where most of it is); a 2-D image gives one
    view. Both have the same isotropic scale and are centred on the mesh: x from left to right (left
    of the patient on the left), y upwards or, in the sagittal view, to the right (back on the
    left), z upwards. Letters in the lower corners mark the sides: L and R, P and A. Pixels outside
    the image are black.

    Parameters
    ----------
    image : Image
    mesh : Mesh
        Drawn with orange edges and a stronger boundary.
    mask : Image, optional
        From 0 to 1; its outline is blue.
    labels : Image, optional
        Drawn in the colours of `tetopt.report.figures.label_figure`.
    of_cell : (M,) int64, optional
        Label of each cell, with `labels`: cells of labels other than 0 get their colours.
    table : LabelTable
        Colours of labels.
    """
    colours = None
    if labels is not None and of_cell is not None:
        present, row = np.unique(of_cell, return_inverse=True)
        colours = np.where(of_cell[:, None] > 0, label_colours(present, table.colours)[row], np.nan)
    views = _views(mesh)
    pixels = [_sample_view(image, view) for view in views]
    limits = _limits(image, mesh, mask, views, pixels)
    figure = Figure(figsize=(len(views), 1.0), dpi=SIDE_PIXELS, facecolor="black")
    for k, (view, values) in enumerate(zip(views, pixels, strict=True)):
        panel = figure.add_axes((k / len(views), 0.0, 1.0 / len(views), 1.0))
        panel.set_axis_off()
        look: dict[str, Any] = {"origin": "lower", "extent": view.extent, "cmap": "gray"}
        shown = np.nan_to_num(values, nan=limits[0])
        panel.imshow(shown.T, vmin=limits[0], vmax=limits[1], **look)
        if mask is not None:
            inside = np.nan_to_num(_sample_view(mask, view), nan=0.0)
            if inside.min() < 0.5 <= inside.max():
                panel.contour(
                    inside.T, levels=[0.5], extent=view.extent, colors=MASK_LINE, linewidths=1.0
                )
        _draw_mesh(panel, mesh, view, colours)
        panel.set_xlim(view.extent[:2])
        panel.set_ylim(view.extent[2:])
        if image.ndim == 3:
            _write_sides(panel, SIDE_LETTERS[view.axes[0]])
    return _png(figure)


class _View(NamedTuple):
    """A square around a place, along two world axes."""

    place: Floats
    axes: tuple[int, int]  # horizontal and vertical
    half: float  # mm, of its side

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Its ends along the horizontal and the vertical axis."""
        x, y = self.place[list(self.axes)].tolist()
        return x - self.half, x + self.half, y - self.half, y + self.half


def _views(mesh: Mesh) -> list[_View]:
    """Return the squares around a mesh that are drawn."""
    used = mesh.points[np.unique(mesh.cells)]
    low, high = used.min(axis=0), used.max(axis=0)
    half = (0.5 + MARGIN_FRACTION) * float((high - low).max())
    views = []
    for axes in VIEW_AXES[mesh.ndim]:
        place = (low + high) / 2.0
        if mesh.ndim == 3:
            across = _across(axes)
            place[across] = _fullest(mesh, across)
        views.append(_View(place, axes, half))
    return views


def _across(axes: tuple[int, int]) -> int:
    """Return the third world axis."""
    return 3 - sum(axes)


def _limits(
    image: Image,
    mesh: Mesh,
    mask: Image | None,
    views: Sequence[_View],
    pixels: Sequence[Floats],
) -> tuple[float, float]:
    """Return the values drawn black and white: of the pixels in the mesh and its mask."""
    inside = cell_of_voxel(image, mesh) >= 0
    covered = Image(
        inside if mask is None else inside & (mask.data >= INSIDE_FRACTION), image.affine
    )
    seen = [
        values[np.isfinite(values) & (_sample_view(covered, view) > 0.5)]
        for view, values in zip(views, pixels, strict=True)
    ]
    return grey_limits(
        [np.concatenate(seen)] if sum(map(len, seen)) else [np.zeros(1)], brightest=99.8
    )


def _write_sides(panel: Axes, letters: str) -> None:
    """Write the letters of the left and of the right side into the lower corners."""
    for letter, x in zip(letters, (0.04, 0.96), strict=True):
        panel.text(
            x,
            0.05,
            letter,
            transform=panel.transAxes,
            color="white",
            ha="center",
            va="center",
            fontsize=LETTER_POINTS,
        )


def _fullest(mesh: Mesh, axis: int) -> float:
    """Return the position of the cut along a world axis, mm: the mesh's middle, if that is not
    hollow.
    """
    x, v = mesh.points[mesh.cells][..., axis], volumes(mesh.points, mesh.cells)
    first, last = x.min(axis=1), x.max(axis=1)
    ends = np.linspace(first.min(), last.max(), SLAB_COUNT + 1)
    # Each cell's volume is spread evenly between its ends, so that a few large cells count as well
    # as many small ones.
    filled = np.diff(
        [float((v * np.clip((end - first) / (last - first), 0.0, 1.0)).sum()) for end in ends]
    )
    middle = SLAB_COUNT // 2
    if filled[middle - 1 : middle + 1].mean() >= 0.5 * filled.max():
        return float(ends[middle])
    slab = int(filled.argmax())
    return float(ends[slab : slab + 2].mean())


def _sample_view(image: Image, view: _View) -> Floats:
    """Sample the image in the pixels of a view; NaN outside the image."""
    n, place, (across, up) = SIDE_PIXELS * SAMPLES_PER_PIXEL, view.place, view.axes
    steps = (np.arange(n) + 0.5) / n * 2.0 * view.half - view.half
    points = np.broadcast_to(place, (n, n, len(place))).copy()
    points[..., across] += steps[:, None]
    points[..., up] += steps[None, :]
    index = np.moveaxis(image.to_index(points), -1, 0)
    sides = np.array(image.shape).reshape(-1, 1, 1)
    is_in = ((index >= -0.5) & (index <= sides - 0.5)).all(axis=0)
    values = map_coordinates(image.data, index, output=np.float64, order=1, mode="nearest")
    values[~is_in] = np.nan
    fine = values.reshape(SIDE_PIXELS, SAMPLES_PER_PIXEL, SIDE_PIXELS, SAMPLES_PER_PIXEL)
    averaged: Floats = fine.mean(axis=(1, 3))
    return averaged


def _draw_mesh(panel: Axes, mesh: Mesh, view: _View, colours: Floats | None) -> None:
    """Draw the cells that the plane of a view cuts, in their colours (M, 3) if any, and
    the mesh's boundary.
    """
    flat, (mesh, n_pieces) = list(view.axes), mesh.straight_pieces()
    if mesh.ndim == 2:
        corners, cells = mesh.points[mesh.cells], np.arange(len(mesh.cells))
        shared = facets(mesh.cells)
        boundary = mesh.points[shared.nodes[shared.n_cells == 1]]
    else:
        across = _across(view.axes)
        height = mesh.points[:, across] - view.place[across]
        corners, cells = plane_cut(mesh.points, mesh.cells, height)
        # The plane cuts all cells of a facet that it cuts, so these cells suffice to find the
        # boundary.
        shared = facets(mesh.cells[cells]) if len(cells) else facets(mesh.cells)
        boundary, _ = triangle_cut(mesh.points, shared.nodes[shared.n_cells == 1], height)
    polygons = corners[..., flat]
    if colours is not None:
        colours = colours[cells // n_pieces]
        is_shown = np.isfinite(colours[:, 0])
        faces = np.column_stack([colours[is_shown], np.full(is_shown.sum(), LABEL_ALPHA)])
        panel.add_collection(
            PolyCollection(list(polygons[is_shown]), facecolors=faces, edgecolors="none")
        )
    width = min(0.25, EDGE_POINTS / np.sqrt(max(len(polygons), 1)))  # points
    panel.add_collection(
        PolyCollection(list(polygons), facecolors="none", edgecolors=MESH_LINE, linewidths=width)
    )
    panel.add_collection(
        LineCollection(list(boundary[..., flat]), colors=MESH_LINE, linewidths=0.6)
    )


def _png(figure: Figure) -> bytes:
    """Encode a figure as a PNG with a palette."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    whole = PIL.Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    stream = io.BytesIO()
    whole.quantize(
        PALETTE_COLOURS, PIL.Image.Quantize.MEDIANCUT, dither=PIL.Image.Dither.NONE
    ).save(stream, "PNG", optimize=True)
    return stream.getvalue()
