"""Pictures of meshes and runs, drawn by matplotlib without a display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from scipy.ndimage import distance_transform_edt, uniform_filter

from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.errors import InputError
from tetopt.geometry.box import world_axes
from tetopt.geometry.check import facets_on_box
from tetopt.geometry.cut import plane_cut, triangle_cut
from tetopt.geometry.simplex import rho
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.measure.fidelity import cell_labels, half_level_surface
from tetopt.measure.quality import BAD_SHAPE, quality_errors, rho_histogram
from tetopt.mesh import Mesh
from tetopt.model.label_names import NO_TABLE, LabelTable
from tetopt.model.materials import unit_directions
from tetopt.report.colours import (
    LISTED_LABELS,
    UNCOVERED_COLOUR,
    grey_limits,
    label_colours,
    legend_patches,
)
from tetopt.report.tables import nodes_in_words
from tetopt.system.arrays import Floats, Ints
from tetopt.system.files import check_suffix, written_whole

matplotlib.use("agg")
FIGURE_SUFFIXES = (".png",)
# Colours of histograms and curves: grey, then ColorBrewer's Dark2, which the colour-blind can
# distinguish.
CURVE_COLOURS = ("#7f7f7f", "#d95f02", "#1b9e77", "#7570b3")
MESH_LINE = "#ffb000"  # orange, visible on every grey
MASK_LINE = "#1e90ff"  # blue, which the colour-blind can distinguish from the orange
DETAIL_VOXELS = 25  # along the side of an enlarged region: single voxels remain visible in 5 inches
SLICE_WIDTH_INCHES = 4.2  # of the widest slice in a figure of several planes: two fill a page
SLICES_HEIGHT_INCHES = 12.0  # of all its planes, one above the other, which fit on a page
LETTER_INCHES = 0.075  # width of a letter in a legend, in 9 points
FIBRE_FRACTION = 0.8  # of a section's mean radius: half of a line along fibres
FRAME_FRACTION = 0.1  # of a mesh's larger side in a slice: the image that is shown around it
NUMBER_RADIUS_FRACTION = 0.014  # of a slice's width: the radius of a label's number in 5 points


def save_figure(figure: Figure, path: str | Path, dpi: int = 150) -> None:
    """Write a PNG, whole or not at all; InputError for another suffix."""
    with written_whole(check_suffix(path, FIGURE_SUFFIXES)) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png", bbox_inches="tight", facecolor="white")


def save_run_figures(
    paths: Sequence[Path],
    image: Image,
    initial: Mesh,
    result: MeshingResult,
    start: str = "lattice",
    whole: Image | None = None,
    mask: Image | None = None,
    table: LabelTable | None = None,
    fibre: Floats | None = None,
) -> None:
    """Write three PNGs of a run: slice with mesh before and after, rho histograms before and after,
    energies.

    `paths` are their names, and `start` names the initial mesh. If `image`
    is extended beyond a mask, `whole` is the image to show; the colours of a label map are those of
    the `table`; `fibre` (M, 3) are directions in the result's cells.
    """
    first, last = result.history[0], result.history[-1]
    fit = f"{last.E_D / first.E_D:.3f} of the initial E_D" if first.E_D > 0.0 else "constant image"
    before = f"{start}, {nodes_in_words(initial, result.order)}"
    after = f"optimised, {fit}"
    meshes = [(before, initial), (after, result.mesh)]
    shown = image if whole is None else whole
    save_figure(slice_figure(shown, meshes, image, mask, table, fibre), paths[0])
    save_figure(histogram_figure(meshes), paths[1])
    save_figure(energy_figure(result.history), paths[2])


def slice_figure(
    image: Image,
    meshes: Sequence[tuple[str, Mesh]],
    means_of: Image | None = None,
    mask: Image | None = None,
    table: LabelTable | None = None,
    fibre: Floats | None = None,
) -> Figure:
    """Draw a slice of the volume with the section of each mesh, and below it the mean of each cell,
    or, of a label map with this `table`, the label of most of its voxels.

    It is the middle slice across the axis nearest to the world's z (an axial slice), or the mesh's
    middle one if the mesh does not reach it, as far as the meshes reach. Black and white are those
    of the voxels in the last mesh and its mask. The means are those of `means_of`, by default of
    the image itself. In their row, parts of the image that a mesh does not cover are light blue.
    Directions `fibre` (M, 3) in the cells of the last mesh are lines over its means: red from left
    to right, green from back to front, blue upwards, shorter out of the slice.
    """
    view = SliceView(image, None, _slice_through(meshes[-1][1], image))
    sections = [view.section(mesh) for _, mesh in meshes]
    window = view.window([polygons for polygons, _ in sections])
    width, height = window[1] - window[0]
    figure = Figure(figsize=(5.2 * len(meshes), 10.0 * height / width + 1.0), layout="constrained")
    grid = figure.subplots(2, len(meshes), squeeze=False)
    limits = limits_within(image, meshes[-1][1], [view], mask)
    values = np.unique(image.data).astype(np.int64) if table is not None else np.empty(0, int)
    colours = label_colours(values, {} if table is None else table.colours)
    for column, ((title, mesh), (polygons, cells)) in enumerate(zip(meshes, sections, strict=True)):
        over, flat = grid[:, column]
        if table is None:
            view.show_pixels(over, limits)
            means = cell_moments(image if means_of is None else means_of, mesh).mean
            fill_cells(flat, polygons, means[cells], "gray", limits)
            flat.set_title("mean of the image in each cell", fontsize=10)
        else:
            view.show_labels(over, colours[np.searchsorted(values, view.pixels)])
            rows = np.searchsorted(values, cell_labels(image, mesh)[cells])
            look: Any = {"facecolors": colours[rows], "edgecolors": "black", "linewidths": 0.2}
            flat.add_collection(PolyCollection(list(polygons), **look))
            flat.set_facecolor(UNCOVERED_COLOUR)
            flat.set_title("label of most voxels in each cell", fontsize=10)
        draw_edges(over, polygons)
        if fibre is not None and mesh is meshes[-1][1]:
            view.draw_directions(flat, polygons, fibre[cells])
        over.set_title(title + _curved_words(mesh), fontsize=11)
        for axes in (over, flat):
            view.frame(axes, window)
    return figure


def _curved_words(mesh: Mesh) -> str:
    """Return a line for the title of a slice through curved cells."""
    return (
        ""
        if mesh.midpoints is None
        else f"\ncurved cells drawn as {mesh.straight_pieces()[1]} straight ones"
    )


def _slice_through(mesh: Mesh, image: Image) -> int | None:
    """Return the index of the middle slice of a mesh that does not reach the image's middle one;
    None otherwise.
    """
    if image.ndim == 2:
        return None
    across = world_axes(image.affine).index(2)
    along, last = image.to_index(mesh.points)[:, across], image.shape[across] - 1
    if along.min() <= image.shape[across] // 2 <= along.max():
        return None
    return int(np.clip(np.rint(0.5 * (along.min() + along.max())), 0, last))


def limits_within(
    image: Image, mesh: Mesh, views: Sequence[SliceView], mask: Image | None = None
) -> tuple[float, float]:
    """Return the values drawn black and white in views of an image: those of the voxels in the
    mesh and its mask.
    """
    inside = cell_of_voxel(image, mesh) >= 0
    inside &= True if mask is None else mask.data >= INSIDE_FRACTION
    pixels = [view.pixels for view in views]
    if not inside.all():
        covered = Image(inside, image.affine)
        pixels = [
            view.pixels[SliceView(covered, view.across, view.index).pixels > 0.0] for view in views
        ]
    if sum(map(np.size, pixels)) == 0:
        pixels = [image.data[inside] if inside.any() else image.data]
    return grey_limits(pixels, brightest=99.8)


def draw_edges(axes: Axes, polygons: Floats) -> None:
    """Draw the edges of a section's polygons over a slice."""
    # Each line belongs to two polygons and is drawn twice. Where there are many, lines of full
    # width (in points) would hide the image.
    width = min(0.6, 20.0 / np.sqrt(max(len(polygons), 1)))
    axes.add_collection(
        PolyCollection(list(polygons), facecolors="none", edgecolors=MESH_LINE, linewidths=width)
    )


def fill_cells(
    axes: Axes,
    polygons: Floats,
    values: Floats,
    colours: str,
    limits: tuple[float, float],
) -> PolyCollection:
    """Fill a section's polygons with values (K,) in the colours of a map, and the rest with
    light blue.
    """
    # With antialiasing, the background would show along each border as a light seam.
    painted = PolyCollection(
        list(polygons), array=values, cmap=colours, edgecolors="none", antialiaseds=False
    )
    painted.set_clim(*limits)
    axes.set_facecolor(UNCOVERED_COLOUR)
    axes.add_collection(painted)
    return painted


def label_figure(
    labels: Image,
    mesh: Mesh,
    of_cell: Ints | None = None,
    image: Image | None = None,
    table: LabelTable = NO_TABLE,
    order: int = 1,
) -> Figure:
    """Draw the labels of voxels and those of cells side by side, in the same colours and in three
    planes.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0 to `tetopt.contents.labels.LARGEST_LABEL`.
    mesh : Mesh
    of_cell : (M,) int64, optional
        Label of each cell; by default that of most of its voxels
        (`tetopt.measure.fidelity.cell_labels`).
    image : Image, optional
        On the labels' voxels. A third column shows it with the interfaces of the cells' labels,
        each in the colour of the adjacent label with fewer cells.
    table : LabelTable
        Names and colours of labels.
    order : {1, 2}
        Of the cells, for the number of nodes.

    Returns
    -------
    Figure
        The axial, coronal and sagittal middle slices of the volume, one above the other and in one
        scale; a 2-D image is shown whole. The legend lists the labels that cover most; if it cannot
        list all, numbers are also written into the picture of the voxels where they fit.

    Raises
    ------
    InputError
        For the reasons of `tetopt.measure.fidelity.cell_labels`.
    """
    of_cell = cell_labels(labels, mesh) if of_cell is None else of_cell
    values = np.unique(np.concatenate([np.unique(labels.data).astype(np.int64), of_cell]))
    # rows of these, of which there are fewer than numbers
    of_cell = np.searchsorted(values, of_cell)
    colours = label_colours(values, table.colours)
    views = _middle_views(Image(np.searchsorted(values, labels.data), labels.affine))
    pixels = [view.pixels.astype(np.int64) for view in views]
    cuts = [view.section(mesh) for view in views]
    shown = _count_rows(pixels, len(colours)) + (
        _count_rows([of_cell[cells] for _, cells in cuts], len(colours)) > 0
    )
    width, heights = max(view.size[0] for view in views), [view.size[1] for view in views]
    inches = min(SLICE_WIDTH_INCHES / width, SLICES_HEIGHT_INCHES / sum(heights))  # per mm
    handles, n_columns = (
        legend_patches(values, colours, shown, table.names),
        2 if image is None else 3,
    )
    beside = 1.1 + LETTER_INCHES * max(len(str(handle.get_label())) for handle in handles)
    figure = Figure(
        figsize=(n_columns * inches * width + beside, inches * sum(heights) + 0.6),
        layout="constrained",
    )
    grid = figure.subplots(len(views), n_columns, squeeze=False, height_ratios=heights)
    for (left, right, *_), view, numbers, (polygons, cells) in zip(
        grid, views, pixels, cuts, strict=True
    ):
        view.show_labels(left, colours[numbers])
        if np.count_nonzero(shown) > LISTED_LABELS:
            _write_numbers(left, view, numbers, values, colours, NUMBER_RADIUS_FRACTION * width)
        line = min(0.2, 10.0 / np.sqrt(max(len(polygons), 1)))  # points
        right.add_collection(
            PolyCollection(
                list(polygons),
                facecolors=colours[of_cell[cells]],
                edgecolors="black",
                linewidths=line,
            )
        )
        for axes in (left, right):
            view.frame(axes)
    grid[0, 0].set_title("labels of the voxels", fontsize=11)
    grid[0, 1].set_title(
        f"labels of the cells, {nodes_in_words(mesh, order)}{_curved_words(mesh)}", fontsize=11
    )
    if image is not None:
        _draw_interfaces(list(grid[:, 2]), image, mesh, of_cell, colours)
        grid[0, 2].set_title("interfaces of the cells over the image", fontsize=11)
    figure.legend(
        handles=handles, loc="outside right upper", fontsize=9, frameon=False, title="label"
    )
    return figure


def _draw_interfaces(
    column: Sequence[Axes],
    image: Image,
    mesh: Mesh,
    of_cell: Ints,
    colours: Floats,
) -> None:
    """Draw the middle slices of the image, and over them the sections of interfaces between the
    cells' labels.
    """
    views = _middle_views(image)
    limits = limits_within(image, mesh, views)
    n_cells = np.bincount(of_cell, minlength=len(colours))
    for axes, view in zip(column, views, strict=True):
        lines, sides = view.interfaces(mesh, of_cell)
        rarer = np.take_along_axis(sides, n_cells[sides].argmin(axis=1)[:, None], axis=1).ravel()
        view.show_pixels(axes, limits)
        # A dark line beneath makes light colours visible on white.
        axes.add_collection(
            LineCollection(list(lines), colors="black", linewidths=1.6, capstyle="round")
        )
        axes.add_collection(
            LineCollection(list(lines), colors=colours[rarer], linewidths=1.1, capstyle="round")
        )
        view.frame(axes)


def _count_rows(arrays: Sequence[Ints], n: int) -> Ints:
    """Count the rows of labels, 0 to n - 1, in all arrays together."""
    return np.bincount(np.concatenate([array.ravel() for array in arrays]), minlength=n)


def _write_numbers(
    axes: Axes,
    view: SliceView,
    pixels: Ints,
    values: Ints,
    colours: Floats,
    room: float,
) -> None:
    """Write the number of each label except 0 at its widest place in the slice, if a circle of
    `room` mm fits there.
    """
    for row in np.unique(pixels[values[pixels] > 0]):
        # The transform measures the distance to the nearest outside centre, half a pixel beyond the
        # border.
        depth = (
            distance_transform_edt(np.pad(pixels == row, 1), view.steps)[1:-1, 1:-1]
            - 0.5 * view.steps.min()
        )
        deepest = np.unravel_index(depth.argmax(), depth.shape)
        if depth[deepest] >= room:
            is_dark = colours[row] @ (0.299, 0.587, 0.114) < 0.5
            x, y = (np.array(deepest) + 0.5) * view.steps
            colour = "white" if is_dark else "black"
            axes.text(x, y, f"{values[row]}", color=colour, ha="center", va="center", fontsize=5)


def boundary_figure(
    image: Image,
    mask: Image,
    mesh: Mesh,
    word: str,
) -> Figure:
    """Draw the outline of a mask and the boundary of a mesh over the axial slice in the middle of
    the mask, and an enlarged detail of both.

    Parameters
    ----------
    image : Image
    mask : Image
        From 0, outside, to 1, inside, on the image's voxels. Its outline is the level 1/2,
        interpolated linearly between voxel centres.
    mesh : Mesh
        Its boundary is drawn, except on the faces of the image's box.
    word : str
        Name of the mask in the legend.

    Returns
    -------
    Figure
        The slice, and the square of 25 voxels in it with the longest outline, with the cells'
        edges.

    Raises
    ------
    InputError
        The shape of the mask differs from the image's.
    """
    if mask.shape != image.shape:
        raise InputError(
            f"mask: expected the image's shape {image.shape}, got {mask.shape}; resample it"
        )
    view = SliceView(image, None, None)
    if view.across is not None:
        filled = np.unique(np.nonzero(mask.data >= 0.5)[view.across])
        view = SliceView(image, None, int(filled[len(filled) // 2]) if len(filled) else None)
    outline = _half_level(SliceView(mask, view.across, view.index))
    boundary = view.boundary(mesh)
    low, high = _longest_part(outline, view)
    figure = Figure(
        figsize=(5.2 + 5.2 * view.aspect, 5.2 * view.aspect + 0.7), layout="constrained"
    )
    whole, detail = figure.subplots(1, 2, width_ratios=(1.0, view.aspect))
    limits = limits_within(image, mesh, [view], mask)
    for axes, width in ((whole, 0.7), (detail, 1.8)):
        view.show_pixels(axes, limits)
        view.frame(axes)
        # The outline is wider, so that it remains visible on both sides of the boundary.
        axes.add_collection(LineCollection(list(outline), colors=MASK_LINE, linewidths=2.0 * width))
        axes.add_collection(LineCollection(list(boundary), colors=MESH_LINE, linewidths=width))
    polygons, _ = view.section(mesh)
    detail.add_collection(
        PolyCollection(list(polygons), facecolors="none", edgecolors=MESH_LINE, linewidths=0.4)
    )
    whole.add_patch(
        Rectangle((low[0], low[1]), *(high - low), fill=False, edgecolor="white", linewidth=1.2)
    )
    detail.set_xlim(low[0], high[0])
    detail.set_ylim(low[1], high[1])
    lines = (
        (MASK_LINE, f"outline of the {word}"),
        (MESH_LINE, f"boundary of the mesh{_curved_words(mesh)}"),
    )
    handles = [Line2D([], [], color=colour, linewidth=2.0, label=label) for colour, label in lines]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=10, frameon=False)
    return figure


def _half_level(view: SliceView) -> Floats:
    """Return the level 1/2 of the pixels as segments (K, 2, 2), picture mm; see
    `half_level_surface`.
    """
    affine = np.diag([*view.steps, 1.0])
    affine[:2, 2] = 0.5 * view.steps
    outline = half_level_surface(view.pixels, affine)
    return outline.points[outline.facets]


def _longest_part(outline: Floats, view: SliceView) -> tuple[Floats, Floats]:
    """Return the corners, in picture mm, of the square of `DETAIL_VOXELS` voxels that holds most
    of the outline.
    """
    length = np.zeros(view.pixels.shape)
    pixel = (outline.mean(axis=1) / view.steps).astype(np.int64)
    # Lengths are measured along the nearer axis, so that straight lines through the square count
    # the same in any direction, and only bent ones count more.
    np.add.at(length, tuple(pixel.T), np.abs(outline[:, 1] - outline[:, 0]).max(axis=1))
    side = np.minimum(DETAIL_VOXELS * view.steps.max(), view.size)
    around = uniform_filter(length, np.rint(side / view.steps).astype(np.int64), mode="constant")
    best = (
        np.array(np.unravel_index(around.argmax(), around.shape))
        if len(outline)
        else np.array(around.shape) // 2
    )
    low = np.clip((best + 0.5) * view.steps - 0.5 * side, 0.0, view.size - side)
    return low, low + side


class SliceView:
    """One slice of an image in a standard orientation: right, front and top of the patient on
    fixed sides.
    """

    def __init__(self, image: Image, axis: int | None, index: int | None) -> None:
        self.image = image
        nearest = world_axes(image.affine)
        if image.ndim == 2:
            self.across, self.index = None, 0
        else:
            self.across = nearest.index(2) if axis is None else axis
            self.index = image.shape[self.across] // 2 if index is None else index
        inside = [a for a in range(image.ndim) if a != self.across]
        self.axes = sorted(inside, key=lambda a: nearest[a])  # horizontal, vertical
        self.flip = [image.affine[nearest[a], a] < 0 for a in self.axes]
        self.letters = [
            ("LR", "PA", "IS")[nearest[a]] if image.ndim == 3 else "" for a in self.axes
        ]
        pixels = (
            image.data if self.across is None else np.take(image.data, self.index, axis=self.across)
        )
        pixels = pixels if self.axes == inside else pixels.T
        self.pixels = np.flip(pixels, axis=tuple(np.flatnonzero(self.flip)))
        self.steps = image.spacing[self.axes]  # mm, of a pixel
        self.size = [image.shape[a] * image.spacing[a] for a in self.axes]
        self.extent = (0.0, self.size[0], 0.0, self.size[1])
        self.aspect = self.size[1] / self.size[0]

    def show_pixels(self, axes: Axes, limits: tuple[float, float]) -> None:
        """Draw the pixels in grey, black and white at the `limits`."""
        axes.imshow(
            self.pixels.T,
            origin="lower",
            extent=self.extent,
            cmap="gray",
            vmin=limits[0],
            vmax=limits[1],
        )

    def show_labels(self, axes: Axes, colours: Floats) -> None:
        """Draw the pixels in these colours, (*shape, 3 or 4)."""
        look: Any = {"origin": "lower", "extent": self.extent, "interpolation": "nearest"}
        axes.imshow(np.swapaxes(colours, 0, 1), **look)

    def section(self, mesh: Mesh) -> tuple[Floats, Ints]:
        """Return the polygons (K, 3 or 4, 2) of the mesh in the slice, in picture mm, and their
        cells (K,).
        """
        pieces, n_pieces = mesh.straight_pieces()
        index = self.image.to_index(pieces.points)
        if self.across is None:
            corners, cells = index[pieces.cells], np.arange(len(pieces.cells))
        else:
            corners, cells = plane_cut(index, pieces.cells, index[:, self.across] - self.index)
        return self._flat(corners), cells // n_pieces

    def boundary(self, mesh: Mesh) -> Floats:
        """Return the mesh's boundary in the slice, off the image's box, as segments (K, 2, 2),
        picture mm.
        """
        pieces = mesh.straight_pieces()[0]
        index = self.image.to_index(pieces.points)
        outer, is_on_box = facets_on_box(pieces, self.image)
        if self.across is None:
            return self._flat(index[outer[~is_on_box]])
        return self._flat(
            triangle_cut(index, outer[~is_on_box], index[:, self.across] - self.index)[0]
        )

    def interfaces(self, mesh: Mesh, of_cell: Ints) -> tuple[Floats, Ints]:
        """Return the interfaces between labels as segments (K, 2, 2), picture mm, and their two
        labels (K, 2).
        """
        pieces, n_pieces = mesh.straight_pieces()
        index, shared = self.image.to_index(pieces.points), facets(pieces.cells)
        of_cell = np.repeat(of_cell, n_pieces)
        is_between = (shared.n_cells == 2) & (
            of_cell[shared.cells[:, 0]] != of_cell[shared.cells[:, 1]]
        )
        nodes, sides = shared.nodes[is_between], of_cell[shared.cells[is_between]]
        if self.across is None:
            return self._flat(index[nodes]), sides
        lines, triangles = triangle_cut(index, nodes, index[:, self.across] - self.index)
        return self._flat(lines), sides[triangles]

    def _flat(self, index: Floats) -> Floats:
        """Convert index coordinates (..., n) to positions in the picture (..., 2), mm."""
        flat = (index[..., self.axes] + 0.5) * self.steps
        return np.where(self.flip, self.size - flat, flat)

    def draw_directions(self, axes: Axes, polygons: Floats, vectors: Floats) -> None:
        """Draw directions (K, 3) as coloured lines across polygons."""
        units = unit_directions(vectors)
        index = units @ np.linalg.inv(self.image.affine[:3, :3]).T
        flat = index[:, self.axes] * self.steps * np.where(self.flip, -1.0, 1.0)
        middle = polygons.mean(axis=1)
        radius = np.sqrt(((polygons - middle[:, None]) ** 2).sum(axis=2)).mean(axis=1)
        ends = flat * (FIBRE_FRACTION * radius)[:, None]
        lines = np.stack([middle - ends, middle + ends], axis=1)
        for colour, width in (("black", 1.4), (np.abs(units), 0.9)):
            axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=width))

    def window(self, polygons: Sequence[Floats]) -> Floats:
        """Return the corners of the part of the slice around polygons (K, 3 or 4, 2), (2, 2) mm."""
        points = np.concatenate([each.reshape(-1, 2) for each in polygons])
        size = np.array(self.size)
        if len(points) == 0:
            return np.stack([0.0 * size, size])
        low, high = points.min(axis=0), points.max(axis=0)
        margin = FRAME_FRACTION * (high - low).max()
        return np.stack([np.maximum(low - margin, 0.0), np.minimum(high + margin, size)])

    def frame(self, axes: Axes, window: Floats | None = None) -> None:
        """Frame the slice, or a window of it, in one scale, with the patient's sides as letters
        instead of ticks.
        """
        (x_low, y_low), (x_high, y_high) = (0.0, 0.0), self.size
        if window is not None:
            (x_low, y_low), (x_high, y_high) = window.tolist()
        axes.set_xlim(x_low, x_high)
        axes.set_ylim(y_low, y_high)
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
        places = ((0.02, 0.5), (0.98, 0.5), (0.5, 0.02), (0.5, 0.98))
        for letter, place in zip("".join(self.letters), places, strict=False):
            axes.text(
                *place,
                letter,
                transform=axes.transAxes,
                color="white",
                ha="center",
                va="center",
                fontsize=9,
                bbox={"facecolor": "black", "alpha": 0.5, "linewidth": 0, "pad": 1.5},
            )


def _middle_views(image: Image) -> list[SliceView]:
    """Return the axial, coronal and sagittal middle slices; a 2-D image as a whole."""
    if image.ndim == 2:
        return [SliceView(image, None, None)]
    return [SliceView(image, world_axes(image.affine).index(world), None) for world in (2, 1, 0)]


def histogram_figure(meshes: Sequence[tuple[str, Mesh]]) -> Figure:
    """Draw normalised rho histograms of meshes over each other, as in Fig. 1(d), with the
    paper's four errors.
    """
    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    axes = figure.subplots()
    for colour, (title, mesh) in zip(CURVE_COLOURS, meshes, strict=False):
        fraction, edges = rho_histogram(mesh.points, mesh.cells)
        errors = quality_errors(mesh.points, mesh.cells)
        shape = rho(mesh.points, mesh.cells)
        n_bad = int((mesh.ndim * shape < BAD_SHAPE).sum())  # often too few for a visible bar
        label = (
            f"{title}: mean {shape.mean():.3f}, {n_bad} bad cells; errors (i) {errors.mean:.4f}, "
            f"(ii) {errors.harmonic_mean:.4f}, (iii) {errors.l2:.4g}, (iv) {errors.worst:.4f}"
        )
        axes.stairs(fraction, edges, fill=True, alpha=0.35, color=colour)
        axes.stairs(fraction, edges, color=colour, linewidth=1.6, label=label)
    n = meshes[0][1].ndim
    axes.axvline(1.0 / n, color="black", linewidth=0.8, linestyle=":")
    axes.set_xlim(0.0, 1.0 / n * 1.02)
    axes.set_xlabel(f"rho = inradius / circumradius (1/{n} for a regular cell)")
    axes.set_ylabel("fraction of cells")
    # where no bar can overlap it
    figure.legend(loc="outside upper center", fontsize=8, frameon=False)
    return figure


def energy_figure(history: Sequence[IterationRecord]) -> Figure:
    """Draw E, E_G and E_D relative to the initial mesh, and the relative movement of nodes, by
    iteration; Fig. 1(c).
    """
    figure = Figure(figsize=(7.5, 5.6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    iterations = [row.iteration for row in history]
    first = history[0]
    curves = [
        ("E, combined (Eq. 4)", [row.E for row in history]),
        ("E_G, shape", [row.E_G / first.E_G for row in history]),
    ]
    if first.E_D > 0.0:
        curves.append(("E_D, image", [row.E_D / first.E_D for row in history]))
    for colour, (label, values) in zip(("black", *CURVE_COLOURS[1:]), curves, strict=False):
        top.plot(
            iterations,
            values,
            marker="o",
            markersize=3,
            color=colour,
            label=f"{label}: {values[-1]:.3f}",
        )
    top.set_ylabel("relative to the initial mesh")
    top.set_ylim(bottom=0.0)
    top.legend(fontsize=9, frameon=False)
    if len(history) > 1:
        movements = [max(row.movement, 1e-16) for row in history[1:]]  # above 0, for the logarithm
        bottom.semilogy(iterations[1:], movements, color="black", marker="o", markersize=3)
    bottom.set_ylabel("relative movement")
    bottom.set_xlabel("iteration (shaded: reconnected)")
    bottom.set_xlim(-0.5, iterations[-1] + 0.5)
    bottom.xaxis.get_major_locator().set_params(integer=True)
    for row in history:
        if row.is_retessellated:
            for axes in (top, bottom):
                axes.axvspan(
                    row.iteration - 0.5, row.iteration + 0.5, color="#dddddd", linewidth=0, zorder=0
                )
    return figure
