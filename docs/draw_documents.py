"""The drawings of the documents, from small runs on phantoms: docs/pictures is a folder of them.

    python docs/draw_documents.py -o docs/pictures --force
    python docs/draw_documents.py -o docs/pictures --force --only flip
    python docs/draw_documents.py -o docs/pictures --force --shrink compared/slices.png

With `--shrink` pictures of other commands are kept in a third of their bytes, with few colours;
`COMMANDS` says which command draws each.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import PIL.Image
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

import tetopt
from tetopt.energy.discretization import combine_energies
from tetopt.energy.sampling import cell_of_voxel
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.simplex import dihedral_angles, orient_cells, rho
from tetopt.measure.quality import cell_kinds
from tetopt.report.figures import CURVE_COLOURS, MESH_LINE, save_figure
from tetopt.system.files import check_output, save_bytes

# as many as the bytes allow, of PNGs whose pixels are numbers of colours
PALETTE_COLOURS = (256, 128, 64, 32)
LARGEST_BYTES = 250_000  # of a picture, so that a page loads at once
LARGEST_WIDTH = 1400  # pixels: the column of a page on a screen of twice the usual density
PICTURE_DPI = 140  # a figure of nine inches fills the column of a page on a screen of usual density
# The pictures that other commands draw, shown next to these.
COMMANDS = {
    "demo.png": "make measured, which shrinks slices.png of its comparison",
    "first_mesh.png": "tetopt mesh T1.nii.gz -o brain.vtu --nodes 5000 --figures ., then "
    "--shrink of slice.png",
    "organ.png": "python docs/cut_open.py organ.vtu --image T1.nii.gz --labels tissues.nii.gz, "
    "then --shrink",
    "view.png": "tetopt view brain.vtu --image T1.nii.gz --html look.html, photographed in a "
    "browser",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Draw the pictures; 0 when all are written, 2 with one line on an input to mend."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder that exists")
    parser.add_argument("--only", nargs="+", choices=sorted(PICTURES), help="these drawings alone")
    parser.add_argument(
        "--shrink",
        type=Path,
        nargs="+",
        help="instead: keep these PNGs in the folder, with few colours",
    )
    parser.add_argument("--force", action="store_true", help="replace existing outputs")
    options = parser.parse_args(argv)
    try:
        if options.shrink is not None:
            paths = [
                check_output(options.output / path.name, (".png",), options.force)
                for path in options.shrink
            ]
            for source, path in zip(options.shrink, paths, strict=True):
                shrink(source, path)
        else:
            names = options.only or list(PICTURES)
            paths = [
                check_output(options.output / f"{name}.png", (".png",), options.force)
                for name in names
            ]
            for name, path in zip(names, paths, strict=True):
                save_figure(PICTURES[name](), path, dpi=PICTURE_DPI)
                shrink(path, path)
    except tetopt.InputError as error:
        print(f"draw_documents: {error}", file=sys.stderr)
        return 2
    for path in paths:
        print(f"{path}: {path.stat().st_size / 1000.0:.0f} kB")
    return 0


def shrink(source: Path, path: Path) -> None:
    """Write the PNG of `source` to `path`, no wider than a page takes, with as many colours as
    the bytes allow.
    """
    with PIL.Image.open(source) as picture:
        whole = picture.convert("RGB")
    if whole.width > LARGEST_WIDTH:
        height = round(whole.height * LARGEST_WIDTH / whole.width)
        whole = whole.resize((LARGEST_WIDTH, height), PIL.Image.Resampling.LANCZOS)
    for count in PALETTE_COLOURS:
        content = io.BytesIO()
        few = whole.quantize(count, kmeans=4, dither=PIL.Image.Dither.NONE)
        few.save(content, format="PNG", optimize=True)
        if content.tell() <= LARGEST_BYTES:
            break
    save_bytes(path, content.getvalue())


def method_figure() -> Figure:
    """The paper's phantom: its lattice, after one and twenty iterations, and with nodes
    exchanged; next to it, E.
    """
    image = tetopt.load_phantom("fig2_2d").image()
    lattice = tetopt.lattice_mesh(image, nodes=113)
    moved = {n: tetopt.optimize(image, lattice, k_D=0.5, iterations=n) for n in (1, 20)}
    graded = tetopt.mesh_image(image, nodes=113)
    figure = Figure(figsize=(9.4, 5.9), layout="constrained")
    panels = figure.subplots(2, 3)
    panels[0, 0].imshow(
        image.data.T, origin="lower", cmap="gray", extent=_extent(image), vmin=0, vmax=255
    )
    panels[0, 0].set_title(f"the image, {image.shape[0]} x {image.shape[1]} pixels\n", fontsize=10)
    panels[0, 0].set_axis_off()
    meshes = [
        (panels[0, 1], lattice, "lattice"),
        (panels[0, 2], moved[1].mesh, "after 1 iteration"),
        (panels[1, 0], moved[20].mesh, "after 20 iterations"),
        (panels[1, 1], graded.mesh, "with nodes exchanged"),
    ]
    for axes, mesh, title in meshes:
        means_panel(
            axes,
            image,
            mesh,
            f"{title}: {len(mesh.points)} nodes\nE_D {fraction_of(image, mesh):.3f} of the "
            "variance",
        )
    energy = panels[1, 2]
    for result, colour, name in (
        (moved[20], CURVE_COLOURS[1], "nodes moved"),
        (graded, CURVE_COLOURS[2], "and exchanged"),
    ):
        rows = result.history
        energy.plot(
            [row.iteration for row in rows],
            [row.E for row in rows],
            "o-",
            color=colour,
            label=name,
            markersize=3,
        )
    energy.set_ylim(bottom=0.0)
    energy.set_xlabel("iteration")
    energy.set_title("E, of its initial mesh", fontsize=10)
    energy.legend(frameon=False, fontsize=9)
    return figure


def octree_figure() -> Figure:
    """A quadtree of the paper's phantom, the triangles of its corners, and the mesh that comes
    of it.
    """
    image = tetopt.load_phantom("fig2_2d").image()
    result = tetopt.mesh_image(image, nodes=400)
    assert result.initial is not None, "mesh_image returns the mesh that it began with"
    figure = Figure(figsize=(9.6, 3.7), layout="constrained")
    image_panel, first, last = figure.subplots(1, 3)
    for axes, mesh in ((image_panel, result.initial), (first, result.initial), (last, result.mesh)):
        title = f"{len(mesh.points)} nodes\nE_D {fraction_of(image, mesh):.4f} of the variance"
        if axes is image_panel:
            axes.imshow(
                image.data.T, origin="lower", cmap="gray", extent=_extent(image), vmin=0, vmax=255
            )
            axes.plot(*mesh.points.T, ".", color=MESH_LINE, markersize=3)
            axes.set_title("corners and centres of blocks\n", fontsize=10)
            axes.set_axis_off()
        else:
            means_panel(
                axes,
                image,
                mesh,
                ("initial mesh" if axes is first else "after 16 iterations") + ": " + title,
            )
    return figure


def move_figure() -> Figure:
    """One node's star across an edge of the image: E by the node's place, and the star before
    and after the move.
    """
    image = _half_bright()
    corners = np.array(
        [[1.0, 3.5], [5.5, 1.2], [10.5, 2.0], [12.6, 6.2], [9.8, 11.4], [4.6, 12.4], [1.4, 8.6]]
    )
    first = np.array([6.3, 6.2])
    x, y = np.meshgrid(np.linspace(2.0, 12.0, 81), np.linspace(2.0, 12.0, 81), indexing="ij")
    before = _star(corners, first)
    energies = np.full(x.shape, np.nan)
    for at in np.ndindex(x.shape):
        node = np.array([x[at], y[at]])
        # no triangle is turned over
        if (_signed_area(corners, np.roll(corners, -1, axis=0), node[None]) > 1.0).all():
            energies[at] = _star_energy(image, _star(corners, node), before)
    least = np.unravel_index(np.nanargmin(energies), energies.shape)
    after = _star(corners, np.array([x[least], y[least]]))
    figure = Figure(figsize=(9.4, 3.5), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    means_panel(left, image, before, "before: E = 1")
    lines = middle.contour(x, y, energies, np.arange(0.9, 1.6, 0.06), cmap="viridis")
    middle.clabel(lines, fontsize=7, fmt="%.2f")
    middle.triplot(*before.points.T, before.cells, color="#bbbbbb", linewidth=0.8)
    middle.annotate(
        "",
        after.points[-1],
        first,
        arrowprops={"arrowstyle": "->", "color": CURVE_COLOURS[1], "lw": 2},
    )
    middle.plot(*first, "o", color=CURVE_COLOURS[1])
    middle.set_aspect("equal")
    middle.set_axis_off()
    middle.set_title("E as a function of the node's position", fontsize=10)
    means_panel(right, image, after, f"after: E = {energies[least]:.2f}")
    return figure


def flip_figure() -> Figure:
    """The three ways to reconnect cells, each with E_D relative to its value before."""
    image = _half_bright()
    square = np.array([[1.5, 2.0], [11.5, 1.0], [12.5, 11.5], [2.0, 12.0]])
    middle = np.vstack([square, [[9.2, 5.75]]])
    wheel = np.vstack([square, [[4.2, 10.1]], [[9.2, 5.75]]])
    cases = [
        (
            "flip: the other diagonal",
            square,
            [[0, 1, 2], [0, 2, 3]],
            square,
            [[0, 1, 3], [1, 2, 3]],
        ),
        (
            "split: a node put into an edge",
            square,
            [[0, 1, 2], [0, 2, 3]],
            np.vstack([square, (square[0] + square[2]) / 2.0]),
            [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
        ),
        (
            "collapse: an edge shrunk into one of its ends",
            wheel,
            [[0, 1, 5], [0, 5, 4], [1, 2, 5], [5, 2, 4], [2, 3, 4], [3, 0, 4]],
            middle,
            [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
        ),
    ]
    figure = Figure(figsize=(9.4, 6.6), layout="constrained")
    for (title, *old_and_new), panels in zip(cases, figure.subplots(2, 3).T, strict=True):
        first = tetopt.E_D(image, tetopt.Mesh(*old_and_new[:2]))
        for axes, points, cells in zip(panels, old_and_new[::2], old_and_new[1::2], strict=True):
            mesh = tetopt.Mesh(points, cells)
            words = f"{title}\nbefore" if axes is panels[0] else "after"
            means_panel(
                axes,
                image,
                mesh,
                f"{words}: {len(points)} nodes, E_D {tetopt.E_D(image, mesh) / first:.2f}",
            )
            axes.plot(*mesh.points.T, "o", color=CURVE_COLOURS[1], markersize=4)
    return figure


def shapes_figure() -> Figure:
    """The regular tetrahedron and one of each kind of bad cell, with its rho and its angles."""
    root = np.sqrt(3.0)
    triangle = [[1.0, 0.0, 0.0], [-0.5, root / 2, 0.0], [-0.5, -root / 2, 0.0]]
    cells = {
        "good": [*triangle, [0.0, 0.0, np.sqrt(2.0)]],
        "needle": [[0.0, 0.16, 0.0], [0.14, -0.08, 0.05], [-0.14, -0.08, -0.05], [0.02, 0.03, 2.2]],
        "wedge": [*triangle[1:], [1.0, -0.11, 0.0], [1.0, 0.11, 0.06]],
        "cap": [*triangle, [0.0, 0.0, 0.2]],
        "spade": [*triangle, [0.26, 0.44, 0.2]],
        "sliver": [[1.0, 0.0, 0.06], [0.0, 1.0, -0.06], [-1.0, 0.0, 0.06], [0.0, -1.0, -0.06]],
    }
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    for number, (name, corners) in enumerate(cells.items()):
        points = np.array(corners)
        mesh = tetopt.Mesh(points, orient_cells(points, np.array([[0, 1, 2, 3]])))
        kind = cell_kinds(mesh.points, mesh.cells, rho(mesh.points, mesh.cells))[0]
        assert kind == name, f"the drawn {name} is none"
        angles = dihedral_angles(mesh.points, mesh.cells)
        title = (
            f"{'regular' if name == 'good' else name}: rho {rho(mesh.points, mesh.cells)[0]:.3f}\n"
            f"angles {angles.min():.0f} to {angles.max():.0f} degrees"
        )
        axes = figure.add_subplot(2, 3, number + 1, projection="3d")
        _draw_tetrahedron(axes, mesh.points, title)
    return figure


def exactness_figure() -> Figure:
    """Voxel centres in the colours of the cells that own them, some of them exactly on an edge;
    the rows of fluxes.
    """
    image = tetopt.Image(np.zeros((9, 9)), np.eye(3))
    points = np.array([[-0.5, -0.5], [8.5, -0.5], [8.5, 8.5], [-0.5, 8.5], [4.0, 4.0]])
    mesh = tetopt.Mesh(points, np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]))
    owner = cell_of_voxel(image, mesh)
    places = np.stack(np.indices(image.shape), axis=-1).reshape(-1, 2)
    colours = np.array(["#d95f02", "#1b9e77", "#7570b3", "#666666"])
    corners = points[mesh.cells]
    sides = np.stack(
        [_signed_area(corners[:, k], corners[:, (k + 1) % 3], places) for k in range(3)]
    )
    on_edge = (np.isclose(sides, 0.0) & (sides > -1e-9).all(axis=0)).any(axis=(0, 1))
    figure = Figure(figsize=(8.6, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
    for axes, is_shown in (
        (left, np.ones(len(places), dtype=bool)),
        (right, np.abs(places - 4).max(axis=1) < 3),
    ):
        axes.triplot(*points.T, mesh.cells, color="black", linewidth=0.8)
        axes.scatter(
            *places[is_shown].T, c=colours[owner.ravel()[is_shown]], s=40 if axes is left else 150
        )
        chosen = is_shown & on_edge
        axes.scatter(
            *places[chosen].T, s=130 if axes is left else 420, facecolors="none", edgecolors="black"
        )
        axes.set_aspect("equal")
        axes.set_axis_off()
    right.set_xlim(1.4, 6.6)
    right.set_ylim(1.4, 6.6)
    counts = np.bincount(owner.ravel())
    left.set_title(
        f"{' + '.join(map(str, counts))} = {counts.sum()} centres in 4 cells", fontsize=10
    )
    right.set_title("circled: centres exactly on an edge or a node", fontsize=10)
    return figure


def k_d_figure() -> Figure:
    """The same image, the same number of nodes, and four weights of the image."""
    image = tetopt.load_phantom("fig2_2d").image()
    figure = Figure(figsize=(10.4, 3.3), layout="constrained")
    for axes, k_D in zip(figure.subplots(1, 4), (0.0, 0.2, 0.5, 0.9), strict=True):
        mesh = tetopt.mesh_image(image, nodes=113, mode="uniform", k_D=k_D, iterations=20).mesh
        shape = tetopt.quality(mesh.points, mesh.cells)
        title = (
            f"k_D = {k_D:g}: E_D {fraction_of(image, mesh):.3f}\nmean rho {shape.mean_rho:.3f}, "
            "worst "
            f"{shape.min_rho:.3f}"
        )
        means_panel(axes, image, mesh, title)
    return figure


def order_figure() -> Figure:
    """As many nodes in all: in many linear triangles, and in few quadratic ones."""
    image = tetopt.load_phantom("fig2_2d").image()
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    for axes, order in zip(figure.subplots(1, 2), (1, 2), strict=True):
        mesh = tetopt.mesh_image(image, nodes=400, order=order).mesh
        nodes = mesh.points
        if order == 2:
            nodes, _ = quadratic(mesh.points, mesh.cells)
        kind = "linear" if order == 1 else "quadratic"
        means_panel(axes, image, mesh, f"{len(nodes)} nodes, {len(mesh.cells)} {kind} cells")
        axes.plot(*nodes.T, ".", color=CURVE_COLOURS[1], markersize=3)
    return figure


def fraction_of(image: tetopt.Image, mesh: tetopt.Mesh) -> float:
    """E_D over the image's variance times its volume."""
    return float(tetopt.E_D(image, mesh) / (image.data.var() * image.volume))


def means_panel(axes: Axes, image: tetopt.Image, mesh: tetopt.Mesh, title: str) -> None:
    """A mesh of triangles, each in the grey of its mean, with its edges."""
    means = tetopt.cell_moments(image, mesh).mean
    painted = PolyCollection(
        list(mesh.points[mesh.cells]),
        array=means,
        cmap="gray",
        edgecolors=MESH_LINE,
        linewidths=0.7,
    )
    painted.set_clim(0.0, 255.0)
    axes.add_collection(painted)
    axes.autoscale()
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)


def _extent(image: tetopt.Image) -> tuple[float, float, float, float]:
    """First and last border of the pixels of an image without rotation, mm, along x and y."""
    low = image.affine[:2, 2] - 0.5 * np.diag(image.affine)[:2]
    high = low + np.array(image.shape) * np.diag(image.affine)[:2]
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _half_bright() -> tetopt.Image:
    """140 x 140 pixels of 0.1 mm, dark below a slanted line and bright above it."""
    x, y = (0.1 * grid for grid in np.meshgrid(np.arange(140), np.arange(140), indexing="ij"))
    return tetopt.Image(np.where(x + 1.15 * y > 15.8, 225.0, 60.0), np.diag([0.1, 0.1, 1.0]))


def _star(corners: NDArray[np.float64], node: NDArray[np.float64]) -> tetopt.Mesh:
    """The triangles between a node, the last one, and the corners around it."""
    n = len(corners)
    cells = np.stack([np.arange(n), (np.arange(n) + 1) % n, np.full(n, n)], axis=1)
    return tetopt.Mesh(np.vstack([corners, node]), cells)


def _star_energy(image: tetopt.Image, star: tetopt.Mesh, first: tetopt.Mesh) -> float:
    """Eq. (4) of a star, k_D = 0.5, over what it was before the move."""
    E_G, E_G0 = (tetopt.E_G(mesh.points, mesh.cells) for mesh in (star, first))
    return combine_energies(E_G, tetopt.E_D(image, star), E_G0, tetopt.E_D(image, first), 0.5)


def _signed_area(
    a: NDArray[np.float64], b: NDArray[np.float64], places: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Twice the area of each triangle a, b, place: (M, 2), (M, 2), (P, 2) -> (M, P)."""
    edge, way = b - a, places[None] - a[:, None]
    return edge[:, None, 0] * way[..., 1] - edge[:, None, 1] * way[..., 0]


def _draw_tetrahedron(axes: Axes, points: NDArray[np.float64], title: str) -> None:
    """One tetrahedron of glass, corners (4, 3), all of them to one scale."""
    faces = [points[[0, 1, 2]], points[[0, 1, 3]], points[[0, 2, 3]], points[[1, 2, 3]]]
    axes.add_collection3d(
        Poly3DCollection(faces, facecolors="#1b9e7755", edgecolors="black", linewidths=1.2)
    )
    centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
    for name, middle in zip("xyz", centre, strict=True):
        getattr(axes, f"set_{name}lim")(middle - 0.85, middle + 0.85)
    axes.set_box_aspect((1, 1, 1), zoom=1.25)
    axes.view_init(elev=22, azim=-50)
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)


PICTURES: dict[str, Callable[[], Figure]] = {
    "method": method_figure,
    "octree": octree_figure,
    "move": move_figure,
    "flip": flip_figure,
    "shapes": shapes_figure,
    "exactness": exactness_figure,
    "k_d": k_d_figure,
    "order": order_figure,
}

if __name__ == "__main__":
    sys.exit(main())
