"""Pictures and the page of the reproduced paper: renderings of what `tetopt.experiments.paper` found."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tetopt.geometry.quality import rho_histogram
from tetopt.image import Image
from tetopt.io.files import written_whole
from tetopt.mesh import Mesh
from tetopt.optimize.paper import Record


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
        axes = figure.add_subplot(1, len(rows) + 1, number + 2, projection="3d")
        x, y = np.meshgrid(places, places, indexing="ij")
        axes.plot_surface(x, y, E, cmap="viridis", alpha=0.85, linewidth=0)
        axes.scatter([found[0]], [found[1]], [E_found], color="red", s=45, depthshade=False, zorder=10)
        axes.set_title(f"k_D = {k_D:g}: lowest {E.min():.3f}, found {E_found:.3f}", fontsize=10)
        axes.view_init(elev=38, azim=-60)
    return figure


def save_page(path: Path, title: str, sections: Sequence[dict[str, Any]]) -> None:
    """One HTML file without outside references, whole or not at all.

    Each section has a `title`, a `text`, optionally `tables` (rows of cells, the first the heading) and `pictures`
    (PNG paths with captions).
    """
    parts = [_HEAD.replace("TITLE", html.escape(title))]
    for section in sections:
        parts.append(f"<section><h2>{html.escape(section['title'])}</h2><p>{html.escape(section['text'])}</p>")
        parts += [_table(rows) for rows in section.get("tables", ()) if rows]
        for picture, caption in section.get("pictures", ()):
            data = base64.b64encode(Path(picture).read_bytes()).decode("ascii")
            alt = html.escape(caption)
            parts.append(
                f'<figure><img alt="{alt}" src="data:image/png;base64,{data}"><figcaption>{alt}</figcaption></figure>'
            )
        parts.append("</section>")
    parts.append("</main></body></html>\n")
    with written_whole(path) as temporary:
        temporary.write_text("\n".join(parts), encoding="utf-8")


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *body = rows
    lines = [
        "<div class='wide'><table><thead><tr>",
        *(f"<th>{html.escape(c)}</th>" for c in head),
        "</tr></thead><tbody>",
    ]
    for row in body:
        lines += ["<tr>", *(f"<td>{html.escape(c)}</td>" for c in row), "</tr>"]
    return "".join([*lines, "</tbody></table></div>"])


_HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>TITLE</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 0; }
main { max-width: 1100px; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; border-top: 1px solid #ddd; padding-top: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.92rem; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #eee; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } td:last-child { white-space: normal; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; } figcaption { color: #555; font-size: 0.9rem; }
@media print { section { break-inside: avoid; } }
</style></head><body><main><h1>TITLE</h1>"""
