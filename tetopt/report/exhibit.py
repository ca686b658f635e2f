"""What `tetopt view` shows, in a page (`tetopt.report.explore`) or a picture (`tetopt.report.scene.opened_mesh`)."""

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
from tetopt.model.labels import NO_TABLE, LabelTable, table_of_labels
from tetopt.report.colours import grey_limits, label_colours

COLOUR_MAP = "viridis"  # perceptually even
MOST_CATEGORIES = 128  # Whole numbers with more values than this are a quantity: no list of colours that long is read.
NO_VALUE = "#aaaaaa"  # of cells whose value is not a number
OUTLIERS_PERCENT = 1.0  # of the cells, at either end of a field: their values do not stretch its colours
# The fields that tetopt writes: they are quantities, even where their values are whole numbers.
FIELD_UNITS = {
    "mean": "intensity", "variance": "intensity²", "n_voxels": "voxels", "min": "intensity", "max": "intensity",
    "volume": "mm³", "rho": "0 to 1/3", "min_dihedral": "degrees", "young": "kPa", "displacement": "mm",
    "von_mises": "kPa", "von_mises_nodes": "kPa", "young_nodes": "kPa", "density": "kg/m³",
}  # fmt: skip
LABEL_FIELD = "label"  # the cell data that a table's names and colours are of, and that labels are chosen by
DISPLACEMENT = "displacement"  # the point data by which the mesh is deformed
STEP_NAME = re.compile(r"(.+)_step([1-9]\d*)")  # of results of the second and further steps
ROUNDED_FRACTION = 1e-9  # of the upper limit: a lower one within it is 0 but for rounding
SEEN_FRACTION = 0.05  # of the mesh's diagonal: about so long the largest displacement is drawn at first, to be seen
MOST_TIMES = 5.0  # that: the cells' shapes are lost beyond
ROUND_NUMBERS = (1.0, 2.0, 5.0, 10.0)  # of which, and powers of ten, a factor is one


class Field(NamedTuple):
    """One number a cell or a node, and how it is coloured."""

    name: str
    unit: str  # "" where none is known
    values: NDArray[np.float32]  # (M,); of a field at the nodes the mean of each cell's corners
    limits: tuple[float, float]  # between which the colour map runs; always apart
    categories: list[tuple[int, str]]  # value and colour "#rrggbb" of labels, ascending; empty for a quantity
    nodes: NDArray[np.float32] | None = None  # (N,), to be interpolated; None for a field of the cells
    step: int = 0  # of a load, from 1; 0 for what is of none, or of the only one
    names: dict[int, str] = {}  # noqa: RUF012 - nobody changes it; what categories are called


class Exhibit(NamedTuple):
    """A mesh of tetrahedra to look at, and all that is shown with it."""

    mesh: Mesh
    fields: list[Field]  # at least one
    skipped: list[str]  # names of data that are not shown
    image: Image | None  # 3-D
    title: str
    sets: dict[str, NDArray]  # (K, 3) integer: the nodes of facets, by name
    displacements: dict[int, NDArray[np.float64]]  # (N, 3) mm by step; of the only one under 0
    n_nodes: int  # of cells of order 2 more than the mesh's, which alone are drawn
    reactions: dict[int, dict[str, list[float]]]  # by step likewise, and set: (3,) mN that hold it


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
    """What is shown of a mesh and its data.

    Parameters
    ----------
    mesh : Mesh
        Tetrahedra, world mm (RAS+).
    cell_data : dict of arrays of M rows
        By name, as `tetopt.load_mesh` returns them. Data of one number a cell are fields: those of whole numbers from
        0 with up to `MOST_CATEGORIES` values are labels, all others quantities. Without any, the fields of
        `tetopt.cell_fields` are taken.
    image : Image, optional
        To be shown in the plane of the cut.
    title : str
    facet_sets : dict of (K, 3) integer, optional
        Triples of nodes to be highlighted, by name.
    point_data : dict of arrays of N rows or more, optional
        By name; the first N rows are the mesh's nodes', what follows (the middles of quadratic cells' edges) is not
        drawn. Data of one number a node are quantities. "displacement" (3 columns, mm) deforms the mesh, and its length
        is a field; with "displacement_step2" and so on there are steps, and data with such an end are of that step.
    reactions : dict, optional
        By step, from 1, and facet set: the force that holds it, three numbers, mN.
    table : LabelTable
        Names and colours of the labels in the data "label".

    Raises
    ------
    InputError
        A mesh of triangles, a field of another length than there are cells, or of less than there are nodes, an image
        that is not 3-D, a facet set that is not triples of the mesh's nodes.
    """
    if mesh.ndim != 3:
        raise InputError(
            "view: expected a mesh of tetrahedra, got one of triangles; open a plane mesh in a program such as ParaView"
        )
    if image is not None and image.ndim != 3:
        raise InputError(f"view: expected a 3-D image beside a mesh of tetrahedra, got a {image.ndim}-D one")
    for name, values in cell_data.items():
        if len(values) != len(mesh.cells):
            raise InputError(
                f"view: expected one row of {name!r} for each of {len(mesh.cells)} cells, got {len(values)}; "
                "pass the data of this mesh"
            )
    arrays = {name: np.asarray(values) for name, values in cell_data.items()}
    scalars = {name: values for name, values in arrays.items() if values.ndim == 1 and values.dtype.kind in "buif"}
    at_nodes, displacements, others = _nodal(mesh, point_data or {})
    fields = [_field(name, values[mesh.cells].mean(axis=1), values) for name, values in at_nodes.items()]
    fields += [
        _field(name, values, table=table if name == LABEL_FIELD else NO_TABLE)
        for name, values in (scalars or cell_fields(mesh, image)).items()
    ]
    skipped = [name for name in cell_data if name not in scalars] + others
    if len(displacements) > 1:
        skipped = list(dict.fromkeys(STEP_NAME.sub(r"\1", name) for name in skipped))
    checked = _checked_sets(mesh, facet_sets or {})
    forces = {step if len(displacements) > 1 else 0: by_set for step, by_set in (reactions or {}).items()}
    n_nodes = max([len(mesh.points), *(len(rows) for rows in (point_data or {}).values())])
    shown = _by_step(fields, displacements)
    return Exhibit(mesh, shown, skipped, image, title, checked, displacements, n_nodes, forces)


def opened_on(shown: Exhibit, name: str | None = None, limits: tuple[float, float] | None = None) -> Exhibit:
    """The exhibit with a field of this name as the first, in whose colours it opens, and these limits of its colours.

    Raises
    ------
    InputError
        No field of that name; limits that are not apart, or of labels, which have a colour each.
    """
    names = [field.name for field in shown.fields]
    if name is not None and name not in names:
        raise InputError(f'field: the mesh has no "{name}"; it has {", ".join(dict.fromkeys(names))}')
    fields = sorted(shown.fields, key=lambda field: field.name != (names[0] if name is None else name))
    if limits is not None:
        if not -np.inf < limits[0] < limits[1] < np.inf:
            raise InputError(f"range: expected LOW,HIGH with LOW below HIGH, got {limits[0]:g},{limits[1]:g}")
        if fields[0].categories:
            raise InputError(f'range: "{fields[0].name}" are labels, which have a colour each; give a `field`')
        first = fields[0].name
        fields = [field._replace(limits=limits) if field.name == first else field for field in fields]
    return shown._replace(fields=fields)


def warp_factors(shown: Exhibit) -> tuple[float, float]:
    """By what displacements are multiplied at first, so that they are seen (1 or more), and at most."""
    largest = max((float(np.sqrt((u**2).sum(axis=1)).max()) for u in shown.displacements.values()), default=0.0)
    diagonal = float(np.sqrt((np.ptp(shown.mesh.points, axis=0) ** 2).sum()))
    if largest <= ROUNDED_FRACTION * diagonal:  # it rests
        return 1.0, MOST_TIMES
    factor = SEEN_FRACTION * diagonal / largest
    power = 10.0 ** np.floor(np.log10(factor))
    first = max(1.0, power * min(ROUND_NUMBERS, key=lambda number: abs(np.log(factor / power / number))))
    return float(first), MOST_TIMES * float(first)


def first_axis(shown: Exhibit) -> int:
    """The axis across which the first cut is: it is then the largest or, of a deformed mesh, shows the most of it."""
    if not shown.displacements:
        return int(np.argmin(np.ptp(shown.mesh.points, axis=0)))
    return int(np.argmin(np.abs(next(iter(shown.displacements.values()))).sum(axis=0)))


def _nodal(
    mesh: Mesh, point_data: dict[str, NDArray]
) -> tuple[dict[str, NDArray], dict[int, NDArray[np.float64]], list[str]]:
    """Numbers by name, the lengths of displacements first; displacements by step; the names of what is left."""
    numbers: dict[str, NDArray] = {}
    displacements: dict[int, NDArray[np.float64]] = {}
    others = []
    for name, rows in point_data.items():
        if len(rows) < len(mesh.points):
            raise InputError(
                f"view: expected one row of {name!r} for each of {len(mesh.points)} nodes, got {len(rows)}; "
                "pass the data of this mesh"
            )
        values = np.asarray(rows)[: len(mesh.points)]
        match = STEP_NAME.fullmatch(name)
        if (match[1] if match else name) == DISPLACEMENT and values.shape[1:] == (3,) and np.isfinite(values).all():
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


def _by_step(fields: list[Field], displacements: dict[int, NDArray[np.float64]]) -> list[Field]:
    """The fields with the steps that they are of; those of a step without its number in the name."""
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


def _field(name: str, values: NDArray, nodes: NDArray | None = None, table: LabelTable = NO_TABLE) -> Field:
    """A field of the cells, or of the nodes with its mean over the corners of each cell."""
    values, at_nodes = _single(values), None if nodes is None else _single(nodes)
    shown = values if at_nodes is None else at_nodes
    finite = shown[np.isfinite(shown)].astype(np.float64)
    unit = FIELD_UNITS.get(STEP_NAME.sub(r"\1", name), "")
    if len(finite) == 0:
        return Field(name, unit, values, (0.0, 1.0), [], at_nodes)
    low, high = (float(limit) for limit in np.percentile(finite, [OUTLIERS_PERCENT, 100.0 - OUTLIERS_PERCENT]))
    low = 0.0 if abs(low) < ROUNDED_FRACTION * high else low
    limits = (low, high) if high > low else grey_limits([finite])
    is_quantity = unit or at_nodes is not None
    categories = [] if is_quantity else _categories(finite, table)
    names = table_of_labels(table, [label for label, _ in categories]).names
    return Field(name, unit, values, limits, categories, at_nodes, names=names)


def _single(values: NDArray) -> NDArray[np.float32]:
    """In single precision, NaN where a value is infinite."""
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)


def _categories(values: NDArray[np.float64], table: LabelTable) -> list[tuple[int, str]]:
    """Labels and their colours; none if values are not whole, or negative, or too many for a list of colours."""
    if (values != np.rint(values)).any() or values.min() < 0 or values.max() > LARGEST_LABEL:
        return []
    labels = np.unique(values).astype(np.int64)
    if len(labels) > MOST_CATEGORIES:
        return []
    colours = label_colours(Image(values[:, None]), table.colours)
    return [(int(label), to_hex(colours[label])) for label in labels]


def _checked_sets(mesh: Mesh, facet_sets: dict[str, NDArray]) -> dict[str, NDArray]:
    """The sets as arrays; InputError unless each is triples (K, 3) of the mesh's nodes."""
    sets = {name: np.asarray(nodes) for name, nodes in facet_sets.items()}
    last = len(mesh.points) - 1
    for name, nodes in sets.items():
        if nodes.ndim != 2 or nodes.shape[1] != 3 or nodes.dtype.kind not in "iu":
            raise InputError(
                f"facet set {name!r}: expected (K, 3) whole numbers, the nodes of each facet, got {nodes.shape} of "
                f"{nodes.dtype}"
            )
        if nodes.size and not (nodes.min() >= 0 and nodes.max() <= last):
            raise InputError(
                f"facet set {name!r}: expected nodes 0..{last}, got {nodes.min()}..{nodes.max()}; pass the sets of "
                "this mesh"
            )
    return sets
