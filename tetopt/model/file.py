"""The contents of a mesh's file, and the parts of them that a model keeps."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.align import SAME_BOX_VOXELS, other_box, resample_mask
from tetopt.contents.domain import INSIDE_FRACTION, mask_of
from tetopt.errors import InputError, Note, warn
from tetopt.geometry.quadratic import numbered_edges
from tetopt.geometry.topology import compact
from tetopt.image import Image
from tetopt.interop import notebook
from tetopt.mesh import Mesh
from tetopt.model.fields import GAUSS_MODULI, KINDS_TEXT, NODE_MODULI, is_result
from tetopt.model.label_names import TABLE_TEXT, LabelTable, labels_of, table_of_words
from tetopt.model.loads import load_words, parse_load
from tetopt.model.mappings import check_young
from tetopt.model.materials import ALONG_FIELDS, BinningError
from tetopt.model.model import STRESS_UNITS, Model, half_turned, scale_load
from tetopt.model.sets import (
    Box,
    Names,
    Sets,
    boundary_rows,
    facet_triples,
    label_sets,
    merged_sets,
    rows_of,
    standard_names,
    standard_sets,
)
from tetopt.system.arrays import Arrays, Bools, Floats, Ints, Json
from tetopt.system.incoming import json_of

# cell data in tetopt's files
MATERIAL_FIELDS = ("young", "nu", "density", "material", GAUSS_MODULI, *ALONG_FIELDS)
# relative, between a cell's modulus and those at its Gauss points, in files of other units
MODULUS_ROUNDING = 1e-9
# text of a mesh's file: `tetopt.contents.domain.mask_text` of what the mesh was built within
MASK_TEXT = "mask"
OWN_MASK = "the mesh's own mask"
# text of a mesh's file: `place_words` of the built mesh, or that its nodes were moved since
PLACE_TEXT = "place"
MOVE_ROUNDING = 1e-6  # of a coordinate, relative to the largest
MOVED = "moved"
MOVED_FROM_MASK = f"{MOVED} from the mask"
# those that are kept in a new file
TEXTS_KEPT = ("image", "image_sha256", "inputs", "options", "violated", MASK_TEXT, KINDS_TEXT)
REACTIONS_TEXT = r"reactions(_step\d+)?"  # texts of a solved mesh's file


class MeshFile(NamedTuple):
    """A mesh read from a file, with the other contents of the file.

    Parameters
    ----------
    mesh : Mesh
        RAS+ mm.
    cell_data : dict of arrays
        By name, one row per cell; "young", if the file has it, in kPa.
    field_data : dict of arrays
        By name, of any length; UTF-8 bytes are decoded to one string.
    n_turned : int
        Number of cells that were inverted in the file.
    n_left : int
        Number of cells of lower dimension, such as triangles on tetrahedra, that were dropped.
    sets : Sets
        Sets of facets and cells, by name.
    box : Box, optional
        Box of the meshed image.
    space : {"ras", "lps"}
        Axes of the file; a mesh in "lps" has been transformed to RAS+.
    notes : tuple of str
        One line for each item that was dropped or renamed.
    order : {1, 2}
        Order of the file's cells; for order 2 the mesh has their corners.
    point_data : dict of arrays
        By name, one row per node of the order.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> tetopt.save_mesh("ball.vtk", mesh)
    >>> file = tetopt.load_mesh("ball.vtk")
    >>> len(file.mesh.cells), file.n_turned, file.space, file.order
    (1200, 0, 'ras', 1)
    """

    mesh: Mesh
    cell_data: Arrays
    field_data: Arrays
    n_turned: int
    n_left: int = 0
    sets: Sets = Sets({}, {})
    box: Box | None = None
    space: str = "ras"
    notes: tuple[str, ...] = ()
    order: int = 1
    point_data: Arrays = {}  # noqa: RUF012 - never changed

    @property
    def is_moved(self) -> bool:
        """True if another program moved nodes after tetopt had built the mesh."""
        return PLACE_TEXT in self.field_data

    @property
    def labels(self) -> Ints | None:
        """Labels of the cells, (M,), if there are any."""
        return labels_of(self.cell_data, len(self.mesh.cells))

    def text(self, name: str) -> str | None:
        """Return a string from the field data, if present.

        Parameters
        ----------
        name : str
            Name in the field data.

        Returns
        -------
        str or None
            None if it is missing or not a string.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> mesh = tetopt.lattice_mesh(image, nodes=300)
        >>> tetopt.save_mesh("ball.vtu", mesh, about={"subject": "sub-01"})
        >>> tetopt.load_mesh("ball.vtu").text("subject")
        'sub-01'
        """
        return text_in(self.field_data, name)

    def table(self, name: str) -> Json:
        """Return the table in a string of the field data that is JSON.

        Parameters
        ----------
        name : str
            Name in the field data.

        Returns
        -------
        dict
            Empty if it is missing, or another program's.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> mesh = tetopt.lattice_mesh(image, nodes=300)
        >>> tetopt.save_mesh("ball.vtu", mesh, about={"options": {"spacing": 8}})
        >>> tetopt.load_mesh("ball.vtu").table("options")
        {'spacing': 8}
        """
        try:
            table = json_of(self.text(name) or "{}")
        except ValueError:
            return {}
        return table if isinstance(table, dict) else {}

    def _repr_html_(self) -> str:
        """Show the contents of the file in a notebook, with the middle section shaded by cell
        means.
        """
        mesh = self.mesh
        labels = ", ".join(self.label_table.names.values())
        rows = [
            *notebook.mesh_rows(mesh.points, mesh.cells),
            ("data of cells", ", ".join(self.cell_data) or "none"),
            ("data of nodes", ", ".join(self.point_data) or "none"),
            ("sets", ", ".join([*self.sets.facets, *self.sets.cells]) or "none"),
            *[("labels", labels)] * bool(labels),
            *(("note", note) for note in self.notes),
        ]
        return notebook.card_html(
            "MeshFile",
            rows,
            notebook.section_html(mesh.points, mesh.cells, self.cell_data.get("mean")),
        )

    @property
    def label_table(self) -> LabelTable:
        """Names and colours of labels in the file; empty if there are none."""
        return table_in(self.text(TABLE_TEXT))


def text_in(field_data: Arrays, name: str) -> str | None:
    """Return a text from a file's field data, None if it is missing."""
    values = field_data.get(name, np.empty(0))
    return str(values.ravel()[0]) if values.dtype.kind == "U" and values.size else None


def place_words(mesh: Mesh) -> str:
    """Return the numbers of a mesh's nodes and cells, and a sum of its coordinates with weights
    that any move changes; rounding hardly does, as by other programs to single precision.
    """
    weights = np.sin(np.arange(mesh.points.size, dtype=np.float64) ** 2)
    total = (weights * mesh.points.ravel()).sum()  # not by BLAS, which rounds by threads
    return f"{len(mesh.points)} nodes, {len(mesh.cells)} cells: {total:.9g}"


def is_moved_from(words: str, mesh: Mesh) -> bool:
    """Return whether a mesh has nodes elsewhere than the one of `place_words`; False for other
    numbers of nodes or cells, as those that another program left may be in place.
    """
    before, _, total = words.partition(": ")
    now, _, own = place_words(mesh).partition(": ")
    rounding = MOVE_ROUNDING * np.abs(mesh.points).max() * np.sqrt(mesh.points.size)
    try:
        return before == now and not abs(float(total) - float(own)) <= rounding
    except ValueError:  # another program's
        return False


def texts_of(loaded: MeshFile, *, is_other: bool = False) -> Json:
    """Return the texts of a mesh's file to keep in another file; with another image, only those
    on the mesh's mask and place.
    """
    kept = (MASK_TEXT, PLACE_TEXT, KINDS_TEXT) if is_other else (*TEXTS_KEPT, PLACE_TEXT)
    return {name: text for name in kept if (text := loaded.text(name)) is not None}


def words_of_other_box(loaded: MeshFile, image: Image, tolerance: float = SAME_BOX_VOXELS) -> str:
    """Return `tetopt.contents.align.other_box` of the box in a mesh's file; "" if it has none."""
    box = loaded.box
    return "" if box is None or len(box.shape) != image.ndim else other_box(box, image, tolerance)


def count_of_other_voxels(loaded: MeshFile, mask: Image) -> int:
    """Return the number of voxels in which a mask differs from the one in a mesh's file; 0 if it
    contains none.
    """
    own = own_mask(loaded, mask) if MASK_TEXT in loaded.field_data else None
    return (
        0
        if own is None
        else int(((own.data >= INSIDE_FRACTION) != (mask.data >= INSIDE_FRACTION)).sum())
    )


def own_mask(loaded: MeshFile, image: Image) -> Image | None:
    """Return the mask that a mesh's file was built within, on an image's voxels; None for a whole
    box.

    A region without its background counts as a mask.

    Raises
    ------
    InputError
        The image's dimension differs from the mesh's; the file names a mask but does not contain
        it; the mask lies outside the image.
    """
    if image.ndim != loaded.mesh.ndim:
        raise InputError(
            f"image: expected a {loaded.mesh.ndim}-D image like the mesh, got a {image.ndim}-D one"
        )
    if MASK_TEXT in loaded.field_data and (mask := mask_in(loaded.table(MASK_TEXT))) is not None:
        return resample_mask(mask, image, OWN_MASK)
    inputs = loaded.table("inputs")
    name = inputs.get("mask")
    level = inputs.get("background")
    if loaded.text(PLACE_TEXT) == MOVED_FROM_MASK:
        raise InputError("its nodes were moved after meshing, away from its mask: pass `mask`")
    if name is None and level is None:
        return None
    name = f"the foreground above {level}" if name is None else f"the mask {name}"
    raise InputError(
        f"the mesh was built within {name}, which its file does not contain: pass `mask`, or in "
        "Python tetopt.content with the mask instead of the image"
    )


def mask_in(text: Json) -> Image | None:
    """Return the mask that a text of a mesh's file describes; None for another program's "mask"."""
    with suppress(ValueError, TypeError, KeyError, OverflowError):
        return mask_of(text)
    return None


def table_in(text: str | None) -> LabelTable:
    """Parse a label table written by `tetopt.model.label_names.table_words`; empty for any other
    text.
    """
    try:
        return table_of_words(json_of(text or "{}"))
    except ValueError:  # written by another program
        return table_of_words({})


def sets_beside(
    mesh: Mesh,
    box: Box | None,
    fields: Mapping[str, NDArray],
    own: Sets,
    names: Names,
    former: Names | None = None,
    kept: Iterable[str] = (),
) -> tuple[Sets, dict[str, str]]:
    """Return the standard sets together with the mesh's own, and the new names of own sets, by old
    name.

    `names` gives the names of labels. Own sets of labels and interfaces under their numbers or
    `former` names are dropped as duplicates, except those that loads refer to (`kept`).
    """
    labels = labels_of(fields, len(mesh.cells))
    if labels is not None and names and (own.facets or own.cells):
        for others in {id(each): each for each in ({}, former or {}) if each != names}.values():
            of_labels = label_sets(mesh, labels, others)
            own = Sets(
                *(
                    {
                        name: rows
                        for name, rows in mine.items()
                        if name in kept or not np.array_equal(rows, anew.get(name, np.empty(0)))
                    }
                    for mine, anew in zip(own, of_labels, strict=True)
                )
            )
    return merged_sets(standard_sets(mesh, box, labels, names, own.facets), own)


def loads_in(loaded: MeshFile) -> list[str]:
    """Return the loads in a file of tetopt's as text, in RAS+ and kPa, which it states; none, with
    a warning, if their sets no longer exist.
    """
    try:
        words = json_of(loaded.text("loads") or "[]")
        loads = [parse_load(text, loaded.mesh.ndim) for text in words]
    except (ValueError, TypeError, AttributeError):  # written by another program
        return []
    if lost := [
        load.set_name for load in loads if load.set_name and load.set_name not in loaded.sets.facets
    ]:
        words = f"dropped the file's loads: it no longer has the sets {', '.join(lost)}"
        warn(words, Note)
        return []
    units = STRESS_UNITS.get(loaded.text("units") or "", STRESS_UNITS["kPa"])
    turned = [half_turned(load) if loaded.space == "lps" else load for load in loads]
    scaled = (scale_load(load, units.kPa, units.mm) for load in turned)
    return [load_words(load, units="kPa") for load in scaled]


def material_fields(cell_data: Mapping[str, NDArray]) -> set[str]:
    """Return the names of data of cells that are of a file's materials: `MATERIAL_FIELDS`, but not
    a user's own directions.
    """
    is_own = "young_along" not in cell_data
    return set(MATERIAL_FIELDS) - (set(ALONG_FIELDS) if is_own else set())


def moduli_in(
    cell_data: Mapping[str, NDArray], young: Any, nu: Any, density: Any
) -> tuple[Any, Any, Any]:
    """Return mappings of modulus, ratio and density; without a modulus, missing ones are taken
    from the cells.
    """
    if young is not None or "young" not in cell_data:
        return young, nu, density
    stated = {"nu": nu, "density": density}
    for name, mapping in stated.items():
        if mapping is None and name in cell_data:
            stated[name] = np.asarray(cell_data[name], dtype=np.float64)
    return np.asarray(cell_data["young"], dtype=np.float64), stated["nu"], stated["density"]


def complete_model(model: Model, loaded: MeshFile, *, is_of_file: bool) -> Model:
    """Add the data that only the mesh's file has: data of nodes and, if the moduli are the
    file's, moduli that vary within cells and the binning error. Warn of data that do not fit.
    """
    model = model._replace(
        point_data={name: rows for name, rows in loaded.point_data.items() if name != NODE_MODULI}
    )
    if (table := model.materials) is None or not is_of_file:
        return model
    if (moduli := loaded.point_data.get(NODE_MODULI)) is not None:
        model = model._replace(node_young=check_young(moduli[: len(model.mesh.points)]))
    table = table._replace(binning=_binning_error(loaded))
    if table.along is not None:
        table = table._replace(fibre_binning=_binning_error(loaded, "fibre_binning"))
    at_gauss = _gauss_moduli(model, loaded)
    if at_gauss is None and model.order == 2 and GAUSS_MODULI in loaded.cell_data:
        words = "it does not match the cells and their moduli"
        warn(f"dropped {GAUSS_MODULI} from the mesh's file: {words}", Note)
    return model._replace(materials=table, gauss_young=at_gauss)


def _binning_error(loaded: MeshFile, name: str = "binning") -> BinningError | None:
    """Return the binning error in a file of tetopt's, None if there is none."""
    try:
        words = loaded.table(name)
        return BinningError(float(words["mean"]), float(words["largest"]))
    # missing, or written by another program
    except (ValueError, TypeError, KeyError):
        return None


def _gauss_moduli(model: Model, loaded: MeshFile) -> Floats | None:
    """Return the moduli at Gauss points (M, Q) in a file of tetopt's, if they still match its
    cells.
    """
    moduli = loaded.cell_data.get(GAUSS_MODULI)
    if moduli is None or model.order == 1 or model.materials is None:
        return None
    of_cell = model.materials.young[model.materials.of_cell]
    shape = (len(model.mesh.cells), model.mesh.ndim + 1)
    # A cell's own modulus is a mean of these; columns follow a cell's nodes, which reorienting
    # swaps.
    if moduli.shape == shape and not loaded.n_turned:
        low = moduli.min(axis=1)
        high = moduli.max(axis=1)
        if ((1.0 - MODULUS_ROUNDING) * low <= of_cell).all() and (
            of_cell <= (1.0 + MODULUS_ROUNDING) * high
        ).all():
            check_young(low)
            return np.asarray(moduli, dtype=np.float64)
    return None


def with_cells(loaded: MeshFile, labels: Ints, is_kept: Bools) -> MeshFile:
    """Return the mesh's file with a part of its cells, (M,), which have `labels`, (M,).

    Each interface of a label that stays with one that goes remains as a set of facets, with its
    name, as do parts of other sets.
    """
    mesh = loaded.mesh
    of_labels = label_sets(mesh, labels, loaded.label_table.names)
    named = {name for kind in of_labels for name in kind} | standard_names(mesh.ndim)
    facet_sets = {
        name: rows for name, rows in loaded.sets.facets.items() if name not in named
    } | of_labels.facets
    used, cells = compact(mesh.cells[is_kept], len(mesh.points))
    now = np.cumsum(is_kept) - 1
    number = numbered_edges(mesh.cells)[1]
    edges = np.unique(number[is_kept])  # in the order of the new mesh, as that of the nodes stays
    part = Mesh(mesh.points[used], cells, None if mesh.midpoints is None else mesh.midpoints[edges])
    facets: dict[str, Ints] = {}
    outer = {tuple(row) for row in boundary_rows(part).tolist()}
    for name, rows in facet_sets.items():
        gone = rows[~is_kept[rows[:, 0]]]
        # as seen from the other cell
        turned = rows_of(mesh, facet_triples(mesh.cells, gone)[:, ::-1])
        both = np.concatenate([rows[is_kept[rows[:, 0]]], turned[is_kept[turned[:, 0]]]])
        both = np.unique(np.column_stack([now[both[:, 0]], both[:, 1]]), axis=0)
        if len(both) and (name not in of_labels.facets or tuple(both[0].tolist()) in outer):
            facets[name] = both
    own = {
        name: now[rows[is_kept[rows]]]
        for name, rows in loaded.sets.cells.items()
        if name not in named
    }
    nodes = np.concatenate([used, len(mesh.points) + edges]) if loaded.order == 2 else used
    return loaded._replace(
        mesh=part,
        cell_data={name: rows[is_kept] for name, rows in loaded.cell_data.items()},
        point_data={name: rows[nodes] for name, rows in loaded.point_data.items()},
        sets=Sets(facets, {name: rows for name, rows in own.items() if len(rows)}),
    )


def without_results(loaded: MeshFile) -> MeshFile:
    """Return the mesh's file without solver results on cells and nodes."""
    cell_data, point_data = (
        {name: rows for name, rows in data.items() if not is_result(name)}
        for data in (loaded.cell_data, loaded.point_data)
    )
    return loaded._replace(cell_data=cell_data, point_data=point_data)


def without_stale_results(loaded: MeshFile, *, is_stale: bool) -> MeshFile:
    """Return the mesh's file without results and reactions if they hold no longer; warn of them."""
    if not is_stale:
        return loaded
    names = [name for data in (loaded.cell_data, loaded.point_data) for name in data]
    names = list(dict.fromkeys(filter(is_result, names)))
    texts = {
        name: text
        for name, text in loaded.field_data.items()
        if re.fullmatch(REACTIONS_TEXT, name) is None
    }
    if names or len(texts) < len(loaded.field_data):
        what = f"{', '.join(names) or 'reactions'}; tetopt fem computes them again"
        warn(f"dropped results computed with other moduli or loads: {what}", Note)
    return without_results(loaded)._replace(field_data=texts)
