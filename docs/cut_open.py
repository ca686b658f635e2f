"""A mesh of tetrahedra cut open: its cells in the grey of their means and in the colours of their
labels.

The README's picture of a brain, `docs/pictures/organ.png`, is one. Image and labels are of the same
voxels.

    python docs/cut_open.py organ.vtu --image T1.nii.gz --labels tissues.nii.gz -o organ.png
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyvista
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tetopt import (
    Image,
    InputError,
    LabelTable,
    Mesh,
    cell_labels,
    cell_moments,
    load_image,
    load_mesh,
)
from tetopt.job.mesh_file import label_table
from tetopt.model.label_names import NO_TABLE
from tetopt.report.colours import grey_limits, label_colours, legend_patches
from tetopt.report.figures import LETTER_INCHES, save_figure
from tetopt.report.scene import Draw, View, cutaway, put_scene, view_of
from tetopt.system.files import check_output


def main(argv: Sequence[str] | None = None) -> int:
    """Draw the picture; 0 when it is written, 2 with one line on an input to mend."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mesh", type=Path, help="mesh of tetrahedra")
    parser.add_argument("--image", type=Path, required=True, help="volume it was made of")
    parser.add_argument(
        "--labels", type=Path, help="labels of its voxels; cells of label 0 are left out"
    )
    parser.add_argument(
        "--label-names",
        type=Path,
        help="their names and colours; by default those in the mesh's file",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="PNG")
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    options = parser.parse_args(argv)
    try:
        path = check_output(options.output, (".png",), options.force)
        labels, loaded = (
            None if options.labels is None else load_image(options.labels),
            load_mesh(options.mesh),
        )
        table = label_table(options.label_names, loaded, options.labels)
        save_cutaway(path, load_image(options.image), loaded.mesh, labels, table)
    except InputError as error:
        print(f"cut_open: {error}", file=sys.stderr)
        return 2
    print(f"{path}: {options.mesh.name}, cut open")
    return 0


def save_cutaway(
    path: str | Path,
    image: Image,
    mesh: Mesh,
    labels: Image | None = None,
    table: LabelTable = NO_TABLE,
) -> None:
    """PNG of a mesh with its right, front, upper octant taken away: cells in the grey of their
    means, with edges.

    Parameters
    ----------
    path : str or Path
    image : Image
    mesh : Mesh
        Tetrahedra.
    labels : Image, optional
        Whole numbers from 0. Cells of label 0, the background, are left out, and beside the greys
        the cells are shown in the colours of their labels, the same as in
        `tetopt.report.figures.label_figure`.
    table : LabelTable
        Names and colours of labels.

    Raises
    ------
    InputError
        A mesh of triangles, labels that are not whole numbers or all 0, or as
        `tetopt.energy.sampling.cell_moments`.
    """
    of_cell = (
        np.ones(len(mesh.cells), dtype=np.int64) if labels is None else cell_labels(labels, mesh)
    )
    chosen = of_cell > 0
    if not chosen.any():
        raise InputError(
            "labels: expected cells with a label above 0, got background alone; leave the labels "
            "out"
        )
    used, compact = np.unique(mesh.cells[chosen], return_inverse=True)
    part = Mesh(mesh.points[used], compact.reshape(-1, mesh.ndim + 1))
    view = view_of(part, cell_moments(image, mesh).mean[chosen], "mean of the image in each cell")
    pictures = [(view.title, photograph(cutaway(view, grey_limits([view.values]))))]
    handles = []
    if labels is not None:
        view = view_of(part, of_cell[chosen].astype(np.float64), "label of each cell")
        numbers = np.arange(int(labels.data.max()) + 1)
        colours = label_colours(numbers, table.colours)
        pictures.append((view.title, photograph(labelled_cutaway(view, colours))))
        shown = np.bincount(view.values.astype(np.int64), minlength=len(numbers))
        handles = legend_patches(numbers, colours, shown, table.names)
    height, width = pictures[0][1].shape[:2]
    beside = LETTER_INCHES * max(
        (10 + len(str(handle.get_label())) for handle in handles), default=0
    )
    figure = Figure(
        figsize=(5.6 * len(pictures) + beside, 5.6 * height / width + 0.4), layout="constrained"
    )
    for axes, (title, pixels) in zip(
        figure.subplots(1, len(pictures), squeeze=False)[0], pictures, strict=True
    ):
        axes.imshow(pixels)
        axes.set_title(title, fontsize=11)
        axes.set_axis_off()
    if handles:
        figure.legend(
            handles=handles, loc="outside right upper", fontsize=9, frameon=False, title="label"
        )
    save_figure(figure, path, dpi=200)


def labelled_cutaway(view: View, colours: NDArray[np.float64]) -> Draw:
    """The surface of an opened mesh, each cell in the colour of its label, with the cells' edges.

    The view's values are labels; `colours` (largest label + 1, 3) as of
    `tetopt.report.colours.label_colours`.
    """
    surface = pyvista.PolyData.from_regular_faces(view.points, view.triangles)
    surface.cell_data["colour"] = np.rint(255.0 * colours[view.values.astype(np.int64)]).astype(
        np.uint8
    )
    return lambda plotter: plotter.add_mesh(
        surface,
        scalars="colour",
        rgb=True,
        show_edges=True,
        edge_color="#202020",
        line_width=1,
        ambient=0.35,
    )


def photograph(draw: Draw) -> NDArray[np.uint8]:
    """A scene by itself, (rows, columns, 3) red, green and blue, cut to what is not white."""
    with pyvista.vtk_verbosity("off"):
        plotter = pyvista.Plotter(off_screen=True, window_size=(1650, 1500))
        plotter.set_background("white")
        put_scene(plotter, draw)
        pixels = plotter.screenshot(None, return_img=True)
        plotter.close()
    is_drawn = (pixels < 255).any(axis=2)
    rows, columns = (np.flatnonzero(is_drawn.any(axis=axis)) for axis in (1, 0))
    return pixels[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


if __name__ == "__main__":
    sys.exit(main())
