"""A page to explore a mesh with: cut it, colour it, pick cells out, beside its image; drawn by `explore*.js` in WebGL.

One file without outside references, for someone who has nothing but a browser; `tetopt.report.window` is the same in
pyvista's window.
"""

from __future__ import annotations

import html
import string
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.fem.reference import averaged
from tetopt.image import Image
from tetopt.io.files import written_whole
from tetopt.mesh import Mesh
from tetopt.model.fields import cell_fields
from tetopt.report.colours import grey_limits, label_colours
from tetopt.report.page import data_html, packed, script_html
from tetopt.target.content import LARGEST_LABEL

PAGE_IMAGE_VOXELS = 2**24  # 16 MB, a byte each: an image with more is averaged
PAGE_SIDE_VOXELS = 2048  # along an axis of it: what nearly every graphics card takes
COLOUR_MAP = "viridis"  # perceptually even
MAX_LABELS = 128  # Whole numbers with more values than this are a quantity: no list of colours that long is read.
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


def scalar_fields(mesh: Mesh, cell_data: dict[str, NDArray], image: Image | None = None) -> list[Field]:
    """The fields of one number a cell, in their order; without any, those of `tetopt.cell_fields`.

    Whole numbers from 0 of up to `MAX_LABELS` values are labels; all others are quantities.

    Raises
    ------
    InputError
        A mesh of triangles, an image that is not 3-D, or a field of another length than there are cells.
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
    scalars = {name: values for name, values in cell_data.items() if _is_scalar(np.asarray(values))}
    return [_field(name, np.asarray(values)) for name, values in (scalars or cell_fields(mesh, image)).items()]


def _is_scalar(values: NDArray) -> bool:
    return values.ndim == 1 and values.dtype.kind in "buif"


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
    if len(labels) > MAX_LABELS:
        return []
    colours = label_colours(Image(values[:, None]))
    return [(int(label), to_hex(colours[label])) for label in labels]


def colour_table() -> NDArray[np.uint8]:
    """The colour map of quantities, (256, 3) red, green and blue."""
    return np.rint(255.0 * matplotlib.colormaps[COLOUR_MAP](np.linspace(0.0, 1.0, 256))[:, :3]).astype(np.uint8)


def save_explorer(
    path: str | Path,
    mesh: Mesh,
    cell_data: dict[str, NDArray],
    image: Image | None = None,
    title: str = "mesh",
    facet_sets: dict[str, NDArray] | None = None,
) -> None:
    """Write `explorer_html` as one file, whole or not at all.

    Replaces an existing file; ask `tetopt.io.files.checked_output` first. Raises as `explorer_html`.
    """
    page = explorer_html(mesh, cell_data, image, title, facet_sets)
    with written_whole(Path(path)) as temporary:
        temporary.write_text(page, encoding="utf-8")


def explorer_html(
    mesh: Mesh,
    cell_data: dict[str, NDArray],
    image: Image | None = None,
    title: str = "mesh",
    facet_sets: dict[str, NDArray] | None = None,
) -> str:
    """A page in which a mesh of tetrahedra is turned, cut, coloured by its fields and thresholded, beside its image.

    Everything is in the page, and it forbids itself all network access. A browser without WebGL 2 or scripts says so.
    1 M cells take 24 MB of it, each field 5 MB more, the image 1.3 bytes a voxel.

    Parameters
    ----------
    mesh : Mesh
        Tetrahedra, world mm (RAS+).
    cell_data : dict of arrays of M rows
        By name, as `tetopt.load_mesh` returns them; what has not one number a cell is not shown. Without any that
        has, the fields of `tetopt.cell_fields` are.
    image : Image, optional
        Shown in the plane of the cut, in grey from its 0.5 to its 99.5 percentile, each voxel where its affine puts
        it. Above `PAGE_IMAGE_VOXELS` neighbours are averaged, which the page says.
    title : str
    facet_sets : dict of (K, 3) integer, optional
        Triples of nodes to be highlighted, by name.

    Returns
    -------
    str
        HTML.

    Raises
    ------
    InputError
        A mesh of triangles, a field of another length than there are cells, an image that is not 3-D, a facet set that
        is not triples of the mesh's nodes.
    """
    fields = scalar_fields(mesh, cell_data, image)
    skipped = [name for name, values in cell_data.items() if not _is_scalar(np.asarray(values))]
    centre = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2.0
    data = {
        "centre": centre.tolist(),
        "points": packed(mesh.points - centre, "<f4"),
        "cells": packed(mesh.cells, "<u4"),
        "fields": [{**field._asdict(), "values": packed(field.values, "<f4")} for field in fields],
        "skipped": skipped,
        "colours": packed(colour_table(), "u1"),
        "image": None if image is None else _packed_image(image, centre),
        "sets": [
            {"name": name, "triangles": packed(nodes, "<u4")} for name, nodes in checked_sets(mesh, facet_sets).items()
        ],
        "noValue": NO_VALUE,
    }
    page = resources.files("tetopt.report").joinpath("explore.html").read_text(encoding="utf-8")
    script = script_html("webgl.js", "explore_mesh.js", "explore_gl.js", "explore.js")
    return string.Template(page).substitute(TITLE=html.escape(title), DATA=data_html("data", data), SCRIPT=script)


def _packed_image(image: Image, centre: NDArray[np.float64]) -> dict[str, Any]:
    """The image as bytes, the first axis fastest, with what takes a place relative to `centre` to its index."""
    shape = _shown_shape(image.shape)
    shown = image if shape == image.shape else averaged(image, shape)
    low, high = grey_limits([shown.data.astype(np.float64)])
    greys = np.rint(255.0 * np.clip((shown.data - low) / (high - low), 0.0, 1.0)).astype(np.uint8)
    to_index = np.linalg.inv(shown.affine)
    to_index[:3, 3] = shown.to_index(centre)
    corners = np.array(np.meshgrid(*([-0.5, size - 0.5] for size in shown.shape))).reshape(3, -1).T
    world = shown.to_world(corners) - centre
    return {
        "shape": shown.shape,
        "original": image.shape,
        "voxels": packed(greys.ravel(order="F"), "u1"),
        "toIndex": to_index.T.ravel().tolist(),  # by columns, as WebGL takes it
        "box": [world.min(axis=0).tolist(), world.max(axis=0).tolist()],
        "limits": [low, high],
    }


def _shown_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The image's own shape or, if it is too large for the page, a coarser one: the longest axes are divided first."""
    sizes = np.minimum(shape, PAGE_SIDE_VOXELS)
    longest = int(sizes.max())
    while np.prod(np.minimum(sizes, longest), dtype=np.int64) > PAGE_IMAGE_VOXELS:
        longest -= 1
    return tuple(np.minimum(sizes, longest).tolist())


def checked_sets(mesh: Mesh, facet_sets: dict[str, NDArray] | None) -> dict[str, NDArray]:
    """The sets as arrays; InputError unless each is triples (K, 3) of the mesh's nodes."""
    sets = {name: np.asarray(nodes) for name, nodes in (facet_sets or {}).items()}
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
