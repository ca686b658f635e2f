"""Pictures of the reproduced paper: renderings of what `tetopt.study.paper` found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tetopt.engine.loop import Record
from tetopt.image import Image
from tetopt.measure.quality import rho_histogram
from tetopt.mesh import Mesh


def relaxation_figure(initial: Mesh, final: Mesh, history: Sequence[Record]) -> Figure:
    """Fig. 1: the mesh before (a) and after (b), E_G and movement by iteration (c), rho histograms (d)."""
    figure = Figure(figsize=(13.5, 3.7), layout="constrained")
    panels = figure.subplots(1, 4)
    for axes, mesh, title in ((panels[0], initial, "(a) random nodes"), (panels[1], final, "(b) optimised")):
        axes.add_collection(PolyCollection(list(mesh.points[mesh.cells]), facecolors="none", edgecolors="black"))
        axes.autoscale()
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(title, fontsize=10)
    iterations = [row.iteration for row in history]
    panels[2].plot(iterations, [row.E_G / history[0].E_G for row in history], color="black", label="E_G, of initial")
    panels[2].set_ylim(bottom=0.0)
    panels[2].set_xlabel("iteration")
    movement = panels[2].twinx()
    movement.semilogy(iterations[1:], [row.movement for row in history[1:]], color="#d95f02", label="movement")
    movement.tick_params(axis="y", labelcolor="#d95f02")
    panels[2].set_title("(c) energy; movement in orange", fontsize=10)
    for mesh, colour in ((initial, "#7f7f7f"), (final, "#d95f02")):
        share, edges = rho_histogram(mesh.points, mesh.cells, bins=20)
        panels[3].stairs(share, edges, fill=True, alpha=0.35, color=colour)
        panels[3].stairs(share, edges, color=colour)
    panels[3].set_xlabel("rho")
    panels[3].set_title("(d) share of cells, initial grey", fontsize=10)
    return figure


def landscape_figure(
    image: Image, rows: Sequence[tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]]
) -> Figure:
    """Fig. 2(b): E over the centre node's place for several k_D, the minimum that the descent finds marked.

    `rows` hold k_D, places (K,), E (K, K), the found place (2,) and its E.
    """
    figure = Figure(figsize=(4.2 * (len(rows) + 1), 3.9), layout="constrained")
    axes = figure.add_subplot(1, len(rows) + 1, 1)
    corners = np.array(image.shape) - 0.5
    axes.imshow(image.data.T, origin="lower", cmap="gray", extent=(-0.5, corners[0], -0.5, corners[1]))
    centre = (corners - 0.5) / 2.0
    for x, y in ((-0.5, -0.5), (corners[0], -0.5), (-0.5, corners[1]), (corners[0], corners[1])):
        axes.plot([centre[0], x], [centre[1], y], color="#ffb000")
    axes.set_title("image and the four triangles", fontsize=10)
    for number, (k_D, places, E, found, E_found) in enumerate(rows):
        axes = figure.add_subplot(1, len(rows) + 1, number + 2, projection="3d", computed_zorder=False)
        x, y = np.meshgrid(places, places, indexing="ij")
        axes.plot_surface(x, y, E, cmap="viridis", alpha=0.85, linewidth=0, zorder=1)
        axes.scatter([found[0]], [found[1]], [E_found], color="red", s=60, depthshade=False, zorder=10)
        axes.set_xlabel("x, mm")
        axes.set_ylabel("y, mm")
        axes.set_title(f"k_D = {k_D:g}: lowest {E.min():.3f}, found {E_found:.3f}", fontsize=10)
        axes.view_init(elev=38, azim=-60)
    return figure
