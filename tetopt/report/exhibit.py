"""What `tetopt view` shows, in a page (`tetopt.report.explore`) or in a window (`tetopt.report.window`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.fields import cell_fields
from tetopt.report.colours import grey_limits, label_colours
from tetopt.target.content import LARGEST_LABEL

COLOUR_MAP = "viridis"  # perceptually even
MOST_CATEGORIES = 128  # Whole numbers with more values than this are a quantity: no list of colours that long is read.
NO_VALUE = "#aaaaaa"  # of cells whose value is not a number
OUTLIERS_PERCENT = 1.0  # of the cells, at either end of a field: their values do not stretch its colours
# The fields that tetopt writes: they are quantities, even where their values are whole numbers.
FIELD_UNITS = {
    "mean": "intensity", "variance": "intensity²", "n_voxels": "voxels", "min": "intensity", "max": "intensity",
    "volume": "mm³", "rho": "0 to 1/3", "min_dihedral": "degrees", "young": "kPa",
}  # fmt: skip


class Field(NamedTuple):
    """One number a cell, and how it is coloured."""

    name: str
    unit: str  # "" where none is known
    values: NDArray[np.float32]  # (M,)
    limits: tuple[float, float]  # between which the colour map runs; always apart
    categories: list[tuple[int, str]]  # value and colour "#rrggbb" of labels, ascending; empty for a quantity


class Exhibit(NamedTuple):
    """A mesh of tetrahedra to look at, and all that is shown with it."""

    mesh: Mesh
    fields: list[Field]  # at least one
    skipped: list[str]  # names of cell data that are not shown
    image: Image | None  # 3-D
    title: str
    sets: dict[str, NDArray]  # (K, 3) integer: the nodes of facets, by name


def exhibit(
    mesh: Mesh,
    cell_data: dict[str, NDArray],
    image: Image | None = None,
    title: str = "mesh",
    facet_sets: dict[str, NDArray] | None = None,
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

    Raises
    ------
    InputError
        A mesh of triangles, a field of another length than there are cells, an image that is not 3-D, a facet set that
        is not triples of the mesh's nodes.
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
    fields = [_field(name, values) for name, values in (scalars or cell_fields(mesh, image)).items()]
    skipped = [name for name in cell_data if name not in scalars]
    return Exhibit(mesh, fields, skipped, image, title, _checked_sets(mesh, facet_sets or {}))


def _field(name: str, values: NDArray) -> Field:
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    values = np.where(np.isfinite(values), values, np.nan).astype(np.float32)
    finite = values[np.isfinite(values)].astype(np.float64)
    if len(finite) == 0:
        return Field(name, FIELD_UNITS.get(name, ""), values, (0.0, 1.0), [])
    low, high = (float(limit) for limit in np.percentile(finite, [OUTLIERS_PERCENT, 100.0 - OUTLIERS_PERCENT]))
    limits = (low, high) if high > low else grey_limits([finite])
    return Field(name, FIELD_UNITS.get(name, ""), values, limits, [] if name in FIELD_UNITS else _categories(finite))


def _categories(values: NDArray[np.float64]) -> list[tuple[int, str]]:
    """Labels and their colours; none if values are not whole, or negative, or too many for a list of colours."""
    if (values != np.rint(values)).any() or values.min() < 0 or values.max() > LARGEST_LABEL:
        return []
    labels = np.unique(values).astype(np.int64)
    if len(labels) > MOST_CATEGORIES:
        return []
    colours = label_colours(Image(values[:, None]))
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
