"""Tables of numbers for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from rich.markup import escape
from rich.table import Table

from tetopt.geometry.quadratic import node_count
from tetopt.measure.fidelity import LabelFidelity, MaskFidelity
from tetopt.measure.quality import Quality
from tetopt.mesh import Mesh


def new_table(*columns: str) -> Table:
    """A table with these heads: names to the left, numbers to the right."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right")
    return table


def nodes_in_words(mesh: Mesh, order: int) -> str:
    """How many nodes a mesh has: "4864 nodes", or of order 2 "716 corner nodes, 5012 in all"."""
    if order == 1:
        return f"{len(mesh.points)} nodes"
    return f"{len(mesh.points)} corner nodes, {node_count(mesh.points, mesh.cells, order)} in all"


def add_quality(table: Table, *meshes: Quality, in_all: Sequence[int] = ()) -> None:
    """Rows of the shape of one or several meshes, a column each; `in_all` are their nodes where cells are quadratic."""
    corners = [str(q.n_nodes) for q in meshes]
    table.add_row("corner nodes" if in_all else "nodes", *corners)
    if in_all:
        table.add_row("nodes in all", *map(str, in_all))
    rows: list[tuple[str, Callable[[Quality], str]]] = [
        ("cells", lambda q: str(q.n_cells)),
        ("volume, mm3" if meshes[0].ndim == 3 else "area, mm2", lambda q: f"{q.volume:.2f}"),
        ("rho, mean", lambda q: f"{q.mean_rho:.4f}"),
        ("rho, 1st percentile", lambda q: f"{q.p1_rho:.4f}"),
        ("rho, smallest", lambda q: f"{q.min_rho:.4f}"),
        ("rho error (i), mean", lambda q: f"{q.errors.mean:.4f}"),
        ("rho error (ii), harmonic mean", lambda q: f"{q.errors.harmonic_mean:.4f}"),
        ("rho error (iii), sum of squares", lambda q: f"{q.errors.l2:.4f}"),
        ("rho error (iv), worst", lambda q: f"{q.errors.worst:.4f}"),
        ("smallest angle, degrees", lambda q: f"{q.min_dihedral:.2f}"),
        ("largest angle, degrees", lambda q: f"{q.max_dihedral:.2f}"),
        ("edges, shortest, mm", lambda q: f"{q.min_edge:.4g}"),
        ("edges, longest, mm", lambda q: f"{q.max_edge:.4g}"),
        ("cells under 10 degrees", lambda q: str(q.n_under_10_degrees)),
        *((f"bad cells: {kind}s", lambda q, kind=kind: str(q.kinds[kind])) for kind in meshes[0].kinds),
    ]
    for name, text in rows:
        table.add_row(name, *(text(q) for q in meshes))


def mask_table(mask: MaskFidelity) -> Table:
    """How well a mesh fills its mask."""
    table = new_table("mask", "in voxels", "in the mesh")
    change = 100.0 * (mask.mesh_volume / mask.volume - 1.0)
    table.add_row("size, mm^n", f"{mask.volume:.1f}", f"{mask.mesh_volume:.1f} ({change:+.1f} %)")
    table.add_row("Dice, by voxels", "", f"{mask.dice:.4f}")
    table.add_row(
        "boundary to the mask's surface, mean, 95 %", f"{mask.distance_mean:.3f}, {mask.distance_p95:.3f} voxels",
        f"{mask.distance_mean_mm:.3f}, {mask.distance_p95_mm:.3f} mm",
    )  # fmt: skip
    table.add_row(
        "the mask's surface to the boundary, mean, 95 %", f"{mask.reverse_mean:.3f}, {mask.reverse_p95:.3f} voxels",
        f"{mask.reverse_mean_mm:.3f}, {mask.reverse_p95_mm:.3f} mm",
    )  # fmt: skip
    table.add_row("pieces", str(mask.components), str(mask.mesh_components))
    table.add_row("Euler number of the surface", str(mask.euler), str(mask.mesh_euler))
    return table


def label_table(rows: Sequence[LabelFidelity], names: Mapping[int, str]) -> Table:
    """How well a mesh represents labels, a row for each, with its name if it has one."""
    table = new_table(
        "label", "voxels", "size, mm^n", "cells", "their size", "more, %", "Dice", "by volume", "apart, mm", "95 %",
        "pieces", "of cells",
    )  # fmt: skip
    for row in rows:
        change = 100.0 * (row.mesh_volume / row.volume - 1.0)
        words = escape(f"{row.label} {names.get(row.label, '')}".strip())
        apart = (f"{mm:.3f}" if np.isfinite(mm) else "-" for mm in (row.distance_mean, row.distance_p95))
        table.add_row(
            words, str(row.voxels), f"{row.volume:.1f}", str(row.n_cells), f"{row.mesh_volume:.1f}",
            f"{change:+.1f}", f"{row.dice:.4f}", f"{row.volume_dice:.4f}", *apart, str(row.components),
            str(row.mesh_components),
        )  # fmt: skip
    return table
