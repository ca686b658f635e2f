"""Contents of the page of `tetopt view` (`tetopt.report.explore`)."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from tetopt.contents.labels import LARGEST_LABEL
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.fields import cell_fields
from tetopt.model.label_names import LABEL_FIELD, NO_TABLE, LabelTable, table_of_labels
from tetopt.model.materials import group_directions, unit_directions
from tetopt.report.colours import grey_limits, label_colours
from tetopt.system.arrays import Floats

COLOUR_MAP = "viridis"  # perceptually even
# whole numbers with more values are a quantity: a longer list of colours is unreadable
MOST_CATEGORIES = 128
MOST_DIRECTIONS = 64  # groups of directions, of which the farthest cell is 14 degrees away
NO_VALUE = "#aaaaaa"  # colour of cells whose value is NaN
# of the cells, at either end of a field, which do not affect its colour range
OUTLIERS_PERCENT = 1.0
# Fields that tetopt writes: they are quantities, even if their values are whole numbers.
FIELD_UNITS = {
    "mean": "intensity",
    "variance": "intensity²",
    "n_voxels": "voxels",
    "min": "intensity",
    "max": "intensity",
    "volume": "mm³",
    "rho": "0 to 1/3",
    "min_dihedral": "degrees",
    "young": "kPa",
    "displacement": "mm",
    "von_mises": "kPa",
    "von_mises_nodes": "kPa",
    "young_nodes": "kPa",
    "density": "kg/m³",
}
DISPLACEMENT = "displacement"  # the point data that deform the mesh
STEP_NAME = re.compile(r"(.+)_step([1-9]\d*)")  # of results of the second and further steps
ROUNDED_FRACTION = 1e-9  # of the upper limit: a smaller lower limit is 0 up to rounding
# of the mesh's diagonal: initial length of the largest displacement, so that it is visible
SEEN_FRACTION = 0.05
MOST_TIMES = 5.0  # the initial factor: beyond, cells lose their shapes
ROUND_NUMBERS = (1.0, 2.0, 5.0, 10.0)  # times powers of ten, the values of the factor


class ShownField(NamedTuple):
    """One number per cell or node, and its colouring."""

    name: str
    unit: str  # "" if unknown
    values: NDArray[np.float32]  # (M,); for a field of nodes, the mean of each cell's corners
    limits: tuple[float, float]  # the range of the colour map; always distinct
    # value and colour "#rrggbb" of labels, ascending; empty for a quantity
    categories: list[tuple[int, str]]
    nodes: NDArray[np.float32] | None = None  # (N,), interpolated; None for a field of cells
    step: int = 0  # load step, from 1; 0 without a step, or for the only one
    names: dict[int, str] = {}  # noqa: RUF012 - never changed; names of categories


class Exhibit(NamedTuple):
    """A tetrahedral mesh to view, and all data shown with it."""

    mesh: Mesh
    fields: list[ShownField]  # at least one
    skipped: list[str]  # names of data not shown
    image: Image | None  # 3-D
    title: str
    sets: dict[str, NDArray]  # (K, 3) integer: the nodes of facets, by name
    displacements: dict[int, Floats]  # (N, 3) mm by step; a single one under 0
    n_nodes: int  # includes the mid-edge nodes of order 2, which are not drawn
    # by the same steps and by set: its reaction, (3,) mN
    reactions: dict[int, dict[str, list[float]]]


def exhibit(
    mesh: Mesh,
    cell_data: dict[str, NDArray],
    image: Image | None = None,
    title: str = "mesh",
    facet_sets: dict[str, NDArray] | None = None,
    point_data: dict[str, NDArray] | None = None,
    reactions: dict[int, dict[str, list[float]]] | None = None,
    table: LabelTable = NO_TABLE,
) -> Exhibit:
    """Collect the contents of a view of a mesh and its data.

    Parameters
    ----------
    mesh : Mesh
        Tetrahedra, world mm (RAS+).
    cell_data : dict of arrays of M rows
        By name, as `tetopt.load_mesh` returns them. Data with one number per cell are fields: whole
        numbers from 0 with up to `MOST_CATEGORIES` values are labels, all others are quantities.
        Without any, the fields of `tetopt.cell_fields` are used. Those with three numbers are
        directions, of `MOST_DIRECTIONS` groups, in red (x), green (y) and blue (z).
    image : Image, optional
        Shown in the plane of the cut.
    title : str
    facet_sets : dict of (K, 3) integer, optional
        Triples of nodes to highlight, by name.
    point_data : dict of arrays of N rows or more, optional
        By name; the first N rows belong to the mesh's nodes, later ones (mid-edge nodes of
        quadratic cells) are not drawn. Data with one number per node are quantities. "displacement"
        (3 columns, mm) deforms the mesh, and its length is a field; "displacement_step2" and so on
        define steps, and data with such a suffix belong to that step.
    reactions : dict, optional
        Reaction by step, from 1, and facet set: three numbers, mN.
    table : LabelTable
        Names and colours of the labels in the data "label".

    Raises
    ------
    InputError
        The mesh has triangles; the image is not 3-D.
    """
    if mesh.ndim != 3:
        raise InputError(
            "view: expected a tetrahedral mesh, got triangles; open 2-D meshes in another "
            "program, such as ParaView"
        )
    if image is not None and image.ndim != 3:
        raise InputError(
            f"view: expected a 3-D image for a tetrahedral mesh, got a {image.ndim}-D one"
        )
    arrays = {name: np.asarray(values) for name, values in cell_data.items()}
    scalars = {
        name: values
        for name, values in arrays.items()
        if values.ndim == 1 and values.dtype.kind in "buif"
    }
    at_nodes, displacements, others = _nodal(mesh, point_data or {})
    fields = [
        _field(name, values[mesh.cells].mean(axis=1), values) for name, values in at_nodes.items()
    ]
    fields += [
        _field(name, values, table=table if name == LABEL_FIELD else NO_TABLE)
        for name, values in (scalars or cell_fields(mesh, image)).items()
    ]
    vectors = {
        name: values
        for name, values in arrays.items()
        if values.shape[1:] == (3,) and values.dtype.kind in "iuf"
    }
    fields += [_directions(name, values) for name, values in vectors.items()]
    skipped = [name for name in cell_data if name not in {**scalars, **vectors}] + others
    if len(displacements) > 1:
        skipped = list(dict.fromkeys(STEP_NAME.sub(r"\1", name) for name in skipped))
    forces = {
        step if len(displacements) > 1 else 0: by_set for step, by_set in (reactions or {}).items()
    }
    n_nodes = max([len(mesh.points), *(len(rows) for rows in (point_data or {}).values())])
    shown = _by_step(fields, displacements)
    return Exhibit(
        mesh, shown, skipped, image, title, facet_sets or {}, displacements, n_nodes, forces
    )


def opened_on(
    shown: Exhibit, name: str | None = None, limits: tuple[float, float] | None = None
) -> Exhibit:
    """Return the exhibit with the named field first, whose colours it opens with, and with these
    colour limits.

    Raises
    ------
    InputError
        No field has this name; the limits are not increasing, or are given for labels.
    """
    names = [field.name for field in shown.fields]
    if name is not None and name not in names:
        raise InputError(
            f'`show`: the mesh has no field "{name}"; it has {", ".join(dict.fromkeys(names))}'
        )
    fields = sorted(
        shown.fields, key=lambda field: field.name != (names[0] if name is None else name)
    )
    if limits is not None:
        if not -np.inf < limits[0] < limits[1] < np.inf:
            raise InputError(
                f"range: expected LOW,HIGH with LOW below HIGH, got {limits[0]:g},{limits[1]:g}"
            )
        if fields[0].categories:
            raise InputError(
                f'range: "{fields[0].name}" has labels, which have fixed colours; give another '
                "`show`"
            )
        first = fields[0].name
        fields = [
            field._replace(limits=limits) if field.name == first else field for field in fields
        ]
    return shown._replace(fields=fields)


def warp_factors(shown: Exhibit) -> tuple[float, float]:
    """Return the initial factor of displacements, 1 or more, which makes them visible, and the
    largest factor.
    """
    largest = max(
        (float(np.sqrt((u**2).sum(axis=1)).max()) for u in shown.displacements.values()),
        default=0.0,
    )
    diagonal = float(np.sqrt((np.ptp(shown.mesh.points, axis=0) ** 2).sum()))
    if largest <= ROUNDED_FRACTION * diagonal:  # undeformed
        return 1.0, MOST_TIMES
    factor = SEEN_FRACTION * diagonal / largest
    power = 10.0 ** np.floor(np.log10(factor))
    first = max(
        1.0, power * min(ROUND_NUMBERS, key=lambda number: abs(np.log(factor / power / number)))
    )
    return float(first), MOST_TIMES * float(first)


def first_axis(shown: Exhibit) -> int:
    """Return the axis of the first cut, which makes the section largest or shows most of a
    deformation.
    """
    if not shown.displacements:
        return int(np.argmin(np.ptp(shown.mesh.points, axis=0)))
    return int(np.argmin(np.abs(next(iter(shown.displacements.values()))).sum(axis=0)))


def loaded_side(shown: Exhibit) -> list[float]:
    """Return the direction of the side that moves most from the middle of the mesh, its largest
    component 1; zeros without a displacement.
    """
    middle = shown.mesh.points.mean(axis=0)
    side = np.zeros(3)
    for u in list(shown.displacements.values())[:1]:
        lengths = np.sqrt((u[: len(shown.mesh.points)] ** 2).sum(axis=1))
        side = (lengths[:, None] * (shown.mesh.points - middle)).sum(axis=0)
    return np.asarray(side / (np.abs(side).max() or 1.0)).tolist()


def _nodal(
    mesh: Mesh, point_data: dict[str, NDArray]
) -> tuple[dict[str, NDArray], dict[int, Floats], list[str]]:
    """Return numbers by name, lengths of displacements first; displacements by step; and the
    names of other data.
    """
    numbers: dict[str, NDArray] = {}
    displacements: dict[int, Floats] = {}
    others = []
    for name, rows in point_data.items():
        values = np.asarray(rows)[: len(mesh.points)]
        match = STEP_NAME.fullmatch(name)
        if (
            (match[1] if match else name) == DISPLACEMENT
            and values.shape[1:] == (3,)
            and np.isfinite(values).all()
        ):
            displacements[int(match[2]) if match else 1] = values.astype(np.float64)
            numbers[name] = np.sqrt((values.astype(np.float64) ** 2).sum(axis=1))
        elif values.ndim == 1 and values.dtype.kind in "buif":
            numbers[name] = values.astype(np.float64)
        else:
            others.append(name)
    numbers = dict(sorted(numbers.items(), key=lambda entry: not entry[0].startswith(DISPLACEMENT)))
    if len(displacements) == 1:
        displacements = {0: next(iter(displacements.values()))}
    return numbers, dict(sorted(displacements.items())), others


def _by_step(fields: list[ShownField], displacements: dict[int, Floats]) -> list[ShownField]:
    """Assign steps to fields, and remove the step number from their names."""
    if len(displacements) < 2:
        return fields
    matches = [STEP_NAME.fullmatch(field.name) for field in fields]
    repeated = {match[1] for match in matches if match and int(match[2]) in displacements}
    return [
        field._replace(name=match[1], step=int(match[2]))
        if match and int(match[2]) in displacements
        else field._replace(step=1 if field.name in repeated else 0)
        for field, match in zip(fields, matches, strict=True)
    ]


def _field(
    name: str, values: NDArray, nodes: NDArray | None = None, table: LabelTable = NO_TABLE
) -> ShownField:
    """Create a field of cells, or of nodes with its mean over the corners of each cell."""
    values, at_nodes = _single(values), None if nodes is None else _single(nodes)
    shown = values if at_nodes is None else at_nodes
    finite = shown[np.isfinite(shown)].astype(np.float64)
    unit = FIELD_UNITS.get(STEP_NAME.sub(r"\1", name), "")
    if len(finite) == 0:
        return ShownField(name, unit, values, (0.0, 1.0), [], at_nodes)
    low, high = (
        float(limit)
        for limit in np.percentile(finite, [OUTLIERS_PERCENT, 100.0 - OUTLIERS_PERCENT])
    )
    low = 0.0 if abs(low) < ROUNDED_FRACTION * high else low
    limits = (low, high) if high > low else grey_limits([finite])
    is_quantity = unit or at_nodes is not None
    categories = [] if is_quantity else _categories(finite, table)
    names = table_of_labels(table, [label for label, _ in categories]).names
    return ShownField(name, unit, values, limits, categories, at_nodes, names=names)


def _directions(name: str, vectors: NDArray) -> ShownField:
    """Create a field of the nearest of some directions; NaN in cells without one."""
    units, _ = group_directions(unit_directions(vectors), MOST_DIRECTIONS)
    largest = np.take_along_axis(units, np.abs(units).argmax(axis=1)[:, None], axis=1)
    kinds, which = np.unique(np.where(largest < 0.0, -units, units), axis=0, return_inverse=True)
    values = np.where(units.any(axis=1), which.ravel(), np.nan).astype(np.float32)
    present = np.flatnonzero(kinds.any(axis=1)).tolist()
    colours = [(k, to_hex(np.abs(kinds[k]).clip(max=1.0))) for k in present]
    names = {k: " ".join(f"{x:.2f}" for x in (kinds[k].round(2) + 0.0).tolist()) for k in present}
    return ShownField(name, "direction", values, (0.0, float(len(kinds))), colours, names=names)


def _single(values: NDArray) -> NDArray[np.float32]:
    """Convert to single precision; infinite values become NaN."""
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)


def _categories(values: Floats, table: LabelTable) -> list[tuple[int, str]]:
    """Return labels and their colours; none if values are negative, not whole, or too many for a
    list of colours.
    """
    if (values != np.rint(values)).any() or values.min() < 0 or values.max() > LARGEST_LABEL:
        return []
    labels = np.unique(values).astype(np.int64)
    if len(labels) > MOST_CATEGORIES:
        return []
    return list(
        zip(labels.tolist(), map(to_hex, label_colours(labels, table.colours)), strict=True)
    )
