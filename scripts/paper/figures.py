"""Pictures of the paper's experiments, reproduced by `paper.experiments`, that no other command
draws.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from paper.experiments import Case, Landscape
from tetopt.measure.quality import rho_histogram

BEFORE_COLOUR, AFTER_COLOUR = "#7f7f7f", "#d95f02"


def relaxation_figure(case: Case) -> Figure:
    """Plot Fig. 1: the mesh before (a) and after (b), E_G and movement by iteration (c), rho
    histograms (d).
    """
    initial, final, history = case.initial, case.result.mesh, case.result.history
    figure = Figure(figsize=(13.5, 3.7), layout="constrained")
    panels = figure.subplots(1, 4)
    for axes, mesh, title in (
        (panels[0], initial, "(a) random nodes"),
        (panels[1], final, "(b) optimised"),
    ):
        axes.add_collection(
            PolyCollection(list(mesh.points[mesh.cells]), facecolors="none", edgecolors="black")
        )
        axes.autoscale()
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(title, fontsize=10)
    iterations = [row.iteration for row in history]
    panels[2].plot(
        iterations,
        [row.E_G / history[0].E_G for row in history],
        color="black",
        label="E_G, relative",
    )
    panels[2].set_ylim(bottom=0.0)
    panels[2].set_xlabel("iteration")
    movement = panels[2].twinx()
    movement.semilogy(
        iterations[1:], [row.movement for row in history[1:]], color=AFTER_COLOUR, label="movement"
    )
    movement.tick_params(axis="y", labelcolor=AFTER_COLOUR)
    panels[2].set_title("(c) energy; movement in orange", fontsize=10)
    for mesh, colour in ((initial, BEFORE_COLOUR), (final, AFTER_COLOUR)):
        fraction, edges = rho_histogram(mesh.points, mesh.cells, bins=20)
        panels[3].stairs(fraction, edges, fill=True, alpha=0.35, color=colour)
        panels[3].stairs(fraction, edges, color=colour)
    panels[3].set_xlabel("rho")
    panels[3].set_title("(d) fraction of cells, initial grey", fontsize=10)
    return figure


def landscape_figure(landscapes: Sequence[Landscape]) -> Figure:
    """Plot Fig. 2(b): E over the centre node's place for several k_D, with the minimum that the
    descent finds.
    """
    image, columns = landscapes[0].image, len(landscapes) + 1
    figure = Figure(figsize=(4.2 * columns, 3.9), layout="constrained")
    axes = figure.add_subplot(1, columns, 1)
    corners = np.array(image.shape) - 0.5
    axes.imshow(
        image.data.T, origin="lower", cmap="gray", extent=(-0.5, corners[0], -0.5, corners[1])
    )
    centre = (corners - 0.5) / 2.0
    for x, y in ((-0.5, -0.5), (corners[0], -0.5), (-0.5, corners[1]), (corners[0], corners[1])):
        axes.plot([centre[0], x], [centre[1], y], color="#ffb000")
    axes.set_title("image and the four triangles", fontsize=10)
    for number, (_, k_D, places, E, minimum, E_minimum) in enumerate(landscapes):
        axes = figure.add_subplot(1, columns, number + 2, projection="3d", computed_zorder=False)
        x, y = np.meshgrid(places, places, indexing="ij")
        axes.plot_surface(x, y, E, cmap="viridis", alpha=0.85, linewidth=0, zorder=1)
        axes.scatter(
            [minimum[0]], [minimum[1]], [E_minimum], color="red", s=60, depthshade=False, zorder=10
        )
        axes.set_xlabel("x, mm")
        axes.set_ylabel("y, mm")
        axes.set_title(f"k_D = {k_D:g}: lowest {E.min():.3f}, found {E_minimum:.3f}", fontsize=10)
        axes.view_init(elev=38, azim=-60)
    return figure
