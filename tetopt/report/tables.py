"""Tables of numbers for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from tetopt.contents.labels import BACKGROUND_LABEL
from tetopt.engine.curving import Curving
from tetopt.geometry.quadratic import node_count
from tetopt.io.text import count_text
from tetopt.measure.fidelity import LabelFidelity, MaskFidelity, Thickness
from tetopt.measure.quality import Quality
from tetopt.measure.thin import TOLERATED_CONTACT, LabelContact
from tetopt.mesh import Mesh
from tetopt.start.sizes import LONG_EDGE, SHORT_EDGE_FRACTION, EdgeRatios
from tetopt.system.arrays import Floats

WORST_ROWS = 5  # thin labels and pairs shown; run.json has all
WORST_LABELS = 12  # the same of labels
LONGEST_NAME = 24  # of a label with its number, characters
TOLD_CONTACT = 1.5  # of the voxels' contact: pairs with more are shown
# of the last contact shown: that of the largest ratio has as much, or is too small to matter
SOME_CONTACT = 0.25
THIN_ACROSS = 2.0  # cells: labels with fewer are thin
STRAIGHT_WORDS = (
    "Sizes are those of the curved cells; shapes, E_D and voxels are those of straight ones."
)
LARGE_SIZE = 1e4  # mm3 or mm2: larger labels are shown without decimals


def new_table(*columns: str | Text) -> Table:
    """Create a table with these headers: names left-aligned, numbers right-aligned."""
    table = Table(box=None, header_style="bold", pad_edge=False, caption_justify="left")
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right")
    return table


def size_words(ndim: int) -> str:
    """Return the name of a size, with its unit."""
    return "volume, mm3" if ndim == 3 else "area, mm2"


def size_text(number: float, decimals: int) -> str:
    """Format a length, area or volume with these decimals, or more for three significant digits;
    "-" if not finite.

    Examples
    --------
    >>> size_text(1234.56, 1), size_text(0.0579, 1), size_text(0.0, 1), size_text(2.5e-7, 2)
    ('1234.6', '0.0579', '0.0', '2.5e-07')
    """
    if not np.isfinite(number):
        return "-"
    digits = f"{number:.{decimals}f}"
    return f"{number:.3g}" if 0.0 < abs(number) < 10.0 ** (2 - decimals) else digits


def range_words(numbers: Floats) -> str:
    """Format the range of numbers, or the one number that all are."""
    low, high = numbers.min(), numbers.max()
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def nodes_in_words(mesh: Mesh, order: int) -> str:
    """Describe the number of nodes of a mesh: "4864 nodes", or for order 2 "716 corner nodes,
    5012 in all".
    """
    if order == 1:
        return f"{len(mesh.points)} nodes"
    return f"{len(mesh.points)} corner nodes, {node_count(mesh.points, mesh.cells, order)} in all"


def add_quality(
    table: Table,
    *meshes: Quality,
    in_all: Sequence[int] = (),
    jacobian: float | None = None,
    every: bool = False,
    is_curved: bool = False,
) -> None:
    """Add rows on the shape of one or more meshes, one column each; `in_all` are the numbers of
    nodes of quadratic meshes, `jacobian` is the smallest scaled Jacobian determinant of curved
    cells. `every` adds all measures of rho and the kinds of bad cells; `is_curved` a caption on
    what is measured of curved cells.
    """
    table.caption = STRAIGHT_WORDS if is_curved else None
    nodes = [str(q.n_nodes) for q in meshes]
    nodes = (
        [f"{whole} ({own} corners)" for whole, own in zip(in_all, nodes, strict=True)]
        if in_all
        else nodes
    )
    table.add_row("nodes", *nodes)
    rows: list[tuple[str, Callable[[Quality], str]]] = [
        ("cells", lambda q: str(q.n_cells)),
        (size_words(meshes[0].ndim), lambda q: size_text(q.volume, 2)),
        ("rho, mean", lambda q: f"{q.mean_rho:.4f}"),
        ("smallest angle, degrees", lambda q: f"{q.min_dihedral:.2f}"),
        ("largest angle, degrees", lambda q: f"{q.max_dihedral:.2f}"),
        ("cells below 10 degrees", lambda q: str(q.n_under_10_degrees)),
        ("edges, mm", lambda q: f"{q.min_edge:.4g} to {q.max_edge:.4g}"),
    ]
    if every:
        rows += [
            ("rho, 1st percentile", lambda q: f"{q.p1_rho:.4f}"),
            ("rho, smallest", lambda q: f"{q.min_rho:.4f}"),
            ("rho error (i), mean", lambda q: f"{q.errors.mean:.4f}"),
            ("rho error (ii), harmonic mean", lambda q: f"{q.errors.harmonic_mean:.4f}"),
            ("rho error (iii), sum of squares", lambda q: f"{q.errors.l2:.4f}"),
            ("rho error (iv), worst", lambda q: f"{q.errors.worst:.4f}"),
            *(
                (f"bad cells: {kind}s", lambda q, kind=kind: str(q.kinds[kind]))
                for kind in meshes[0].kinds
            ),
        ]
    for name, text in rows:
        table.add_row(name, *(text(q) for q in meshes))
    if jacobian is not None:
        table.add_row("scaled Jacobian of curved cells, smallest", f"{jacobian:.4f}")


def mask_table(mask: MaskFidelity, ndim: int, word: str) -> Table:
    """Return a table of how well a mesh fills its mask, which the table calls `word`."""
    table = new_table(word, "in voxels", "in the mesh")
    table.add_row(
        size_words(ndim),
        size_text(mask.volume, 1),
        f"{size_text(mask.mesh_volume, 1)} ({_change_text(mask.mesh_volume, mask.volume)} %)",
    )
    table.add_row("Dice, by voxels", "", f"{mask.dice:.4f}")
    for title, *distances in (
        (
            f"boundary to the {word}'s surface, mean, 95 %",
            mask.distance_mean,
            mask.distance_p95,
            mask.distance_mean_mm,
            mask.distance_p95_mm,
        ),
        (
            f"the {word}'s surface to the boundary, mean, 95 %",
            mask.reverse_mean,
            mask.reverse_p95,
            mask.reverse_mean_mm,
            mask.reverse_p95_mm,
        ),
    ):
        mean, p95 = (f"{voxels:.3f}" for voxels in distances[:2])
        mean_mm, p95_mm = (size_text(mm, 3) for mm in distances[2:])
        is_there = not np.isnan(distances).any()  # both surfaces exist off the faces of the box
        shown = (
            (f"{mean}, {p95} voxels", f"{mean_mm}, {p95_mm} mm")
            if is_there
            else ("one surface is missing", "")
        )
        table.add_row(title, *shown)
    table.add_row("connected components", str(mask.components), str(mask.mesh_components))
    table.add_row("Euler number of the surface", str(mask.euler), str(mask.mesh_euler))
    return table


def _change_text(new: float, old: float) -> str:
    """Format by how many percent a number is larger; never as -0.0."""
    return f"{round(100.0 * (new / old - 1.0), 1) + 0.0:+}"


def sizes_in_words(edges: EdgeRatios) -> str:
    """Describe how well the edges of a mesh match their target sizes."""
    return (
        f"ratio of edges to their target size: {edges.mean:.2f} on average; {edges.below:.1%} "
        "are below "
        f"{SHORT_EDGE_FRACTION:.2f}, "
        f"where the image needs smaller cells; {edges.above:.1%} are above {LONG_EDGE:.2f}"
    )


def curving_in_words(curving: Curving) -> str:
    """Describe the curved edges on interfaces and on a mask's surface."""
    return (
        f"{curving.n_on_level} of {curving.n_edges} edges on smooth surfaces have their mid-edge "
        "node on the surface, "
        f"{curving.n_part_way} are partly curved and {curving.n_straight} are straight; largest "
        "offset "
        f"{curving.farthest:.2g} mm from the straight edge, scaled Jacobian at least "
        f"{curving.least_jacobian:.2f}"
    )


def worst_labels(rows: Sequence[LabelFidelity], most: int | None = WORST_LABELS) -> list[int]:
    """Return the places of at most `most` labels, by default 12: the worst by Dice or volume if
    there are more, those outside the mesh last.
    """
    places = list(range(len(rows)))
    if most is None or len(rows) <= most:
        return places

    def fit(place: int) -> tuple[bool, float]:
        extent, dice = rows[place].extent, rows[place].overlap.dice
        volume, voxels = extent.mesh_volume, extent.volume
        return extent.is_beyond, min(dice, min(volume, voxels) / max(volume, voxels))

    return sorted(sorted(places, key=fit)[:most])


def label_table(rows: Sequence[LabelFidelity], names: Mapping[int, str], ndim: int) -> Table:
    """Return a table of how well a mesh represents labels.

    Each label has a row, with its name if any. "volume, %" is by how much its cells are larger than
    its voxels; the distance is that of their surfaces, and parts are connected components.
    """
    table = _table_of_labels(
        "voxels",
        size_words(ndim).replace(" ", "\n"),
        "cells",
        "volume,\n%",
        "Dice",
        "distance\n95 %, mm",
        "parts of\nvoxels",
        "of\ncells",
    )
    for row in rows:
        extent = row.extent
        size = size_text(extent.volume, 1 if extent.volume < LARGE_SIZE else 0)
        table.add_row(
            _label_words(row.label, names),
            str(extent.voxels),
            size,
            str(extent.n_cells),
            _change_text(extent.mesh_volume, extent.volume),
            f"{row.overlap.dice:.4f}",
            size_text(row.distance.p95, 3),
            str(row.pieces.components),
            str(row.pieces.mesh_components),
        )
    return table


def surface_table(rows: Sequence[LabelFidelity], names: Mapping[int, str]) -> Table:
    """Return a table of further measures of labels: Dice by volume and majority, distances,
    smoothness, topology.
    """
    table = _table_of_labels(
        "Dice by\nvolume",
        "Dice by\nmajority",
        "distance\nmean, mm",
        "largest,\nmm",
        "area\nratio",
        "folded,\n%",
        "edges in\n> 2 facets",
    )
    for row in rows:
        if row.surface is not None:
            table.add_row(
                _label_words(row.label, names),
                f"{row.overlap.volume_dice:.4f}",
                f"{row.overlap.dice_majority:.4f}",
                size_text(row.distance.mean, 3),
                size_text(row.distance.max, 3),
                _decimals(row.surface.area_ratio, 3),
                _decimals(100.0 * row.surface.folded, 1),
                str(row.surface.nonmanifold_edges),
            )
    return table


def _table_of_labels(*columns: str) -> Table:
    """Create a table with a row for each label, whose long names are cut."""
    table = new_table("label", *(Text(column) for column in columns))
    table.columns[0].overflow, table.columns[0].no_wrap, table.columns[0].max_width = (
        "ellipsis",
        True,
        LONGEST_NAME,
    )
    for column in table.columns:
        column.vertical = "bottom"
    for column in table.columns[1:]:
        column.no_wrap = True
    return table


def _decimals(number: float, count: int) -> str:
    return f"{number:.{count}f}" if np.isfinite(number) else "-"


def thin_table(rows: Sequence[LabelFidelity], names: Mapping[int, str]) -> Table | None:
    """Return a table of the `WORST_ROWS` labels with the largest one-layer fraction, worst first,
    then thinnest.

    Label 0 is not a tissue and is omitted, as are labels without a thickness, or with a median at
    its limit, or with `THIN_ACROSS` cells across or more; None if none is left.
    """
    there = [
        row
        for row in rows
        if row.extent.n_cells
        and row.label != BACKGROUND_LABEL
        and not row.thickness.cells_across >= THIN_ACROSS
        and (voxels := row.thickness.of_voxels) is not None
        and voxels.p50 < voxels.limit
    ]
    if not there:
        return None
    table = _table_of_labels(
        "in one\nlayer, %",
        "thickness of\nvoxels, mm",
        "of cells,\nmm",
        "edges,\nmm",
        "cells\nacross",
    )
    table.columns[0].header = "thin labels"

    def goodness(row: LabelFidelity) -> tuple[float, float, int]:
        voxels = row.thickness.of_voxels
        return (
            -row.extent.one_layer_fraction,
            np.inf if voxels is None else voxels.p50,
            row.label,
        )

    for row in sorted(there, key=goodness)[:WORST_ROWS]:
        *thick, edge, across = row.thickness
        table.add_row(
            _label_words(row.label, names),
            _decimals(100.0 * row.extent.one_layer_fraction, 1),
            *map(_percentiles_text, thick),
            size_text(edge, 2),
            _decimals(across, 1),
        )
    return table


def contact_table(
    contacts: Sequence[LabelContact], names: Mapping[int, str], ndim: int
) -> Table | None:
    """Return a table of pairs with over 1.5 times the contact of the voxels, largest excess first;
    None if empty.

    The last one is that of the largest ratio, unless it is among the others or its area is small.
    """
    more = [each for each in contacts if each.mesh_mm2 > TOLD_CONTACT * each.voxels_mm2]
    if not more:
        return None
    unit = "mm2" if ndim == 3 else "mm"
    table = new_table("contact", f"of cells, {unit}", f"of voxels, {unit}", "ratio")
    shown = sorted(more, key=lambda each: each.voxels_mm2 - each.mesh_mm2)[:WORST_ROWS]
    large = [
        each
        for each in more
        if each.voxels_mm2 and each.mesh_mm2 >= SOME_CONTACT * shown[-1].mesh_mm2
    ]
    worst = max(large, key=lambda each: each.ratio, default=shown[-1])
    for each in shown if worst in shown else [*shown[:-1], worst]:
        words = ", ".join(_label_words(label, names) for label in each.labels)
        ratio = _decimals(each.ratio, 2) if each.voxels_mm2 else "false"
        table.add_row(words, size_text(each.mesh_mm2, 1), size_text(each.voxels_mm2, 1), ratio)
    return table


def contacts_in_words(totals: Mapping[str, float], ndim: int) -> str:
    """Describe the excess contact between labels."""
    unit = "mm2" if ndim == 3 else "mm"
    return (
        f"contact beyond {TOLERATED_CONTACT:g} times that of the voxels: "
        f"{size_text(totals['excess_mm2'], 1)} {unit}, "
        f"including {size_text(totals['false_mm2'], 1)} {unit} between labels that do not touch "
        "in the voxels"
    )


def _percentiles_text(thickness: Thickness | None) -> str:
    """Return the median, and in brackets the 5th and 95th percentile."""
    if thickness is None:
        return "-"
    low, middle, high = (">= " * (mm >= thickness.limit) + size_text(mm, 2) for mm in thickness[:3])
    return f"{middle} ({low} to {high})"


def _label_words(label: int, names: Mapping[int, str]) -> str:
    return escape(f"{label} {names.get(label, '')}".strip())


def label_differences(rows: Sequence[LabelFidelity], names: Mapping[int, str]) -> list[str]:
    """Describe labels whose cells differ from their voxels in holes or cavities: one line each."""
    lines: list[str] = []
    for row in rows:
        if (surface := row.surface) is None:
            continue
        n_voxels, n_cells, *_ = row.pieces
        cavities, of_cells = surface.cavities, surface.mesh_cavities
        holes = n_voxels + cavities - surface.euler // 2
        parts = _surplus(n_cells + of_cells - surface.mesh_euler // 2 - holes, "hole")
        parts += _surplus(of_cells - cavities, "cavity")
        if parts and row.extent.n_cells:
            name = f" ({names[row.label]})" if row.label in names else ""
            lines.append(f"label {row.label}{name}: {'; '.join(parts)}")
    return lines


def _surplus(count: int, noun: str) -> list[str]:
    """Describe a surplus of cells over voxels; empty if there is none."""
    return [f"{count_text(abs(count), noun)} {'more' if count > 0 else 'fewer'}"] if count else []
