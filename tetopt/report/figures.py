"""Pictures of meshes and runs, drawn by matplotlib without a display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tetopt.energy.sampling import cell_moments
from tetopt.geometry.cut import plane_cut
from tetopt.geometry.quality import BAD_SHAPE, quality_errors, rho_histogram
from tetopt.geometry.simplex import rho
from tetopt.image import Image
from tetopt.io.files import written_whole
from tetopt.mesh import Mesh
from tetopt.optimize.paper import Optimized, Record

matplotlib.use("agg")
COLOURS = ("#7f7f7f", "#d95f02", "#1b9e77", "#7570b3")
MESH_LINE = "#ffb000"


def save_figure(figure: Figure, path: str | Path, dpi: int = 150) -> None:
    """Write a PNG, whole or not at all."""
    with written_whole(Path(path)) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png", bbox_inches="tight", facecolor="white")


def save_run_figures(
    paths: Sequence[Path], image: Image, initial: Mesh, result: Optimized, start: str = "lattice"
) -> None:
    """Three PNGs of a run: slice with mesh before and after, rho histograms before and after, energies.

    `start` is what the initial mesh is called.
    """
    first, last = result.history[0], result.history[-1]
    fit = f"{last.E_D / first.E_D:.3f} of its E_D" if first.E_D > 0.0 else "constant image"
    before = f"{start}, {len(initial.points)} nodes"
    after = f"optimised, {fit}"
    meshes = [(before, initial), (after, result.mesh)]
    save_figure(slice_figure(image, meshes), paths[0])
    save_figure(histogram_figure(meshes), paths[1])
    save_figure(energy_figure(result.history), paths[2])


def slice_figure(
    image: Image, meshes: Sequence[tuple[str, Mesh]], axis: int | None = None, index: int | None = None
) -> Figure:
    """A slice of the volume with each mesh cut through it, and below it the means the cells stand for.

    `axis` and `index` choose the slice in voxel indices; by default the axis nearest to the world's z (an axial
    slice), at its middle. A 2-D image is shown whole.
    """
    view = _View(image, axis, index)
    figure = Figure(figsize=(5.2 * len(meshes), 10.0 * view.aspect + 1.0), layout="constrained")
    grid = figure.subplots(2, len(meshes), squeeze=False)
    limits = np.percentile(view.pixels, [0.5, 99.8])
    if limits[0] == limits[1]:
        limits = np.array([limits[0] - 0.5, limits[0] + 0.5])
    for column, (title, mesh) in enumerate(meshes):
        polygons, cells = view.section(mesh)
        over, flat = grid[:, column]
        view.show_pixels(over, limits)
        # Each line is shared by two polygons; drawn once a polygon it is simply drawn twice.
        width = min(0.6, 20.0 / np.sqrt(len(polygons)))  # points; thinner before the lines hide the image
        over.add_collection(PolyCollection(list(polygons), facecolors="none", edgecolors=MESH_LINE, linewidths=width))
        over.set_title(title, fontsize=11)
        means = cell_moments(image, mesh).mean[cells]
        # Antialiased, each border would let the background shine through as a light seam.
        painted = PolyCollection(list(polygons), array=means, cmap="gray", edgecolors="none", antialiaseds=False)
        painted.set_clim(*limits)
        flat.add_collection(painted)
        flat.set_title("mean of the image in each cell", fontsize=10)
        for axes in (over, flat):
            view.frame(axes)
    return figure


class _View:
    """One slice of an image laid out for the eye: right, front and top of the patient on fixed sides."""

    def __init__(self, image: Image, axis: int | None, index: int | None) -> None:
        self.image = image
        columns = image.affine[:-1, :-1] / image.spacing
        nearest = _nearest_axes(columns)
        if image.ndim == 2:
            self.across, self.index = None, 0
        else:
            self.across = int(np.flatnonzero(nearest == 2)[0]) if axis is None else axis
            self.index = image.shape[self.across] // 2 if index is None else index
        inside = [a for a in range(image.ndim) if a != self.across]
        self.axes = sorted(inside, key=lambda a: nearest[a])  # horizontal, vertical
        self.flip = [columns[nearest[a], a] < 0 for a in self.axes]
        self.letters = ["LR", "PA", "IS"] if image.ndim == 3 else ["", ""]
        self.letters = [self.letters[nearest[a]] for a in self.axes]
        pixels = image.data if self.across is None else np.take(image.data, self.index, axis=self.across)
        pixels = pixels if self.axes == inside else pixels.T
        self.pixels = np.flip(pixels, axis=tuple(k for k in (0, 1) if self.flip[k]))
        self.size = [image.shape[a] * image.spacing[a] for a in self.axes]
        self.aspect = self.size[1] / self.size[0]

    def show_pixels(self, axes: Axes, limits: NDArray[np.float64]) -> None:
        extent = (0.0, self.size[0], 0.0, self.size[1])
        axes.imshow(self.pixels.T, origin="lower", extent=extent, cmap="gray", vmin=limits[0], vmax=limits[1])

    def section(self, mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Polygons (K, 3 or 4, 2) of the mesh in the slice, in picture mm, and their cells (K,)."""
        index = self.image.to_index(mesh.points)
        if self.across is None:
            corners, cells = index[mesh.cells], np.arange(len(mesh.cells))
        else:
            corners, cells = plane_cut(index, mesh.cells, index[:, self.across] - self.index)
        flat = (corners[..., self.axes] + 0.5) * self.image.spacing[self.axes]
        for k in (0, 1):
            if self.flip[k]:
                flat[..., k] = self.size[k] - flat[..., k]
        return flat, cells

    def frame(self, axes: Axes) -> None:
        axes.set_xlim(0.0, self.size[0])
        axes.set_ylim(0.0, self.size[1])
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
        for letter, place in zip(
            "".join(self.letters), ((0.02, 0.5), (0.98, 0.5), (0.5, 0.02), (0.5, 0.98)), strict=False
        ):
            axes.text(
                *place, letter, transform=axes.transAxes, color="white", ha="center", va="center", fontsize=9,
                bbox={"facecolor": "black", "alpha": 0.5, "linewidth": 0, "pad": 1.5},
            )  # fmt: skip


def _nearest_axes(columns: NDArray[np.float64]) -> NDArray[np.int64]:
    """The world axis nearest to each voxel axis, each taken once, the clearest first."""
    cosine = np.abs(columns)
    nearest = np.full(len(columns), -1)
    for _ in range(len(columns)):
        world, voxel = np.unravel_index(np.argmax(cosine), cosine.shape)
        nearest[voxel] = world
        cosine[world, :] = cosine[:, voxel] = -1.0
    return nearest


def histogram_figure(meshes: Sequence[tuple[str, Mesh]]) -> Figure:
    """Normalised rho histograms of meshes over each other, as Fig. 1(d), with the paper's four errors."""
    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    axes = figure.subplots()
    for colour, (title, mesh) in zip(COLOURS, meshes, strict=False):
        share, edges = rho_histogram(mesh.points, mesh.cells)
        errors = quality_errors(mesh.points, mesh.cells)
        shape = rho(mesh.points, mesh.cells)
        n_bad = int((mesh.ndim * shape < BAD_SHAPE).sum())  # too few for a bar to show
        label = (
            f"{title}: mean {shape.mean():.3f}, {n_bad} bad cells; errors (i) {errors.mean:.4f}, "
            f"(ii) {errors.harmonic_mean:.4f}, (iii) {errors.l2:.4g}, (iv) {errors.worst:.4f}"
        )
        axes.stairs(share, edges, fill=True, alpha=0.35, color=colour)
        axes.stairs(share, edges, color=colour, linewidth=1.6, label=label)
    n = meshes[0][1].ndim
    axes.axvline(1.0 / n, color="black", linewidth=0.8, linestyle=":")
    axes.set_xlim(0.0, 1.0 / n * 1.02)
    axes.set_xlabel(f"rho = inradius / circumradius (1/{n} for a regular cell)")
    axes.set_ylabel("share of cells")
    figure.legend(loc="outside upper center", fontsize=8, frameon=False)  # above, where no bar can cross it
    return figure


def energy_figure(history: Sequence[Record]) -> Figure:
    """E, E_G and E_D by iteration relative to the initial mesh, and the nodes' relative movement; Fig. 1(c)."""
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
    for colour, (label, values) in zip(("black", *COLOURS[1:]), curves, strict=False):
        top.plot(iterations, values, marker="o", markersize=3, color=colour, label=f"{label}: {values[-1]:.3f}")
    top.set_ylabel("relative to the initial mesh")
    top.set_ylim(bottom=0.0)
    top.legend(fontsize=9, frameon=False)
    if len(history) > 1:
        bottom.semilogy(
            iterations[1:],
            [max(row.movement, 1e-16) for row in history[1:]],
            color="black",
            marker="o",
            markersize=3,
        )
    bottom.set_ylabel("relative movement")
    bottom.set_xlabel("iteration (shaded: connected anew)")
    bottom.set_xlim(-0.5, iterations[-1] + 0.5)
    bottom.xaxis.get_major_locator().set_params(integer=True)
    for row in history:
        if row.is_retessellated:
            for axes in (top, bottom):
                axes.axvspan(row.iteration - 0.5, row.iteration + 0.5, color="#dddddd", linewidth=0, zorder=0)
    return figure
