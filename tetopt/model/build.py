"""A model from a mesh and what a user says of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError, warn
from tetopt.geometry.simplex import volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.averages import DEFAULT_AVERAGE, cell_values, cell_young, element_young, node_young, parse_average
from tetopt.model.fields import cell_fields
from tetopt.model.file import (
    MATERIAL_FIELDS,
    TEXTS_KEPT,
    MeshFile,
    completed,
    loads_in,
    moduli_in,
    sets_beside,
    without_results,
)
from tetopt.model.labels import TABLE_TEXT, LabelTable, coloured, labels_of, table_of_words, table_words
from tetopt.model.loads import parse_load, parse_loads
from tetopt.model.mappings import ByLabel, ModulusMapping, has_column, mapped_values, parse_any_mapping, young_from
from tetopt.model.materials import DEFAULT_NU, Materials, Spacing, binned, by_label, density_of, materials
from tetopt.model.model import Model
from tetopt.model.sets import Box, Sets, box_of, box_text, standard_sets, with_requested


def build_model(
    mesh: Mesh | MeshFile,
    image: Image | None = None,
    *,
    young: str | float | NDArray[np.float64] | ModulusMapping | ByLabel = None,
    nu: str | float | NDArray[np.float64] | ModulusMapping | ByLabel = None,
    density: str | float | NDArray[np.float64] | ModulusMapping | ByLabel = None,
    average: str = DEFAULT_AVERAGE,
    sets: Iterable[str] = (),
    loads: Iterable[str] = (),
    bins: int | None = None,
    spacing: Spacing = "equal",
    order: int | None = None,
    cell_data: dict[str, NDArray] | None = None,
    known_sets: Sets | None = None,
    box: Box | None = None,
    about: dict[str, Any] | None = None,
) -> Model:
    """All that a solver is told of a mesh, for `tetopt.save_model` and `Model.to_skfem`.

    Parameters
    ----------
    mesh : Mesh or MeshFile
        Of a file (`tetopt.load_mesh`) what it holds goes into the model unless it is stated here: data of cells and
        nodes, labels and their names, sets, moduli, loads, the image's box, and texts of what it was made from. What a
        solver found stays if moduli and loads do.
    image : Image, optional
        Its intensities are what mappings are of, and its box's faces become sets.
    young, nu : number, (M,) array, mapping or text, optional
        Young's modulus, kPa, above 0, and Poisson's ratio, above -1 and below 0.5: one for all cells, one for each, or
        a mapping of the intensity or of the label (`tetopt.model.mappings.parse_any_mapping`), of which with an image
        an average over the voxels of the cell is taken, and else its value at the cell's "mean". Without `young` the
        model has no materials; without `nu` it is the column "nu" of the file that `young` names, or 0.45.
    density : number, (M,) array, mapping or text, optional
        kg/m3, above 0, likewise; without it the column "density" of the file that `young` names, or none. Gravity
        needs it.
    average : str
        Of a mapping of Young's modulus over the voxels, see `tetopt.model.averages.parse_average`; "mean" is Eq. (2).
        With "gauss" and quadratic cells moduli vary in a cell for `tetopt.fem.solution.solve`; files have one.
        Ratios and densities are always the mean.
    sets : iterable of str
        Further sets, see `tetopt.model.sets.with_requested`.
    loads : iterable of str
        See `tetopt.model.loads.parse_loads`.
    bins : int, optional
        Group cells into so many materials; the error that this makes is in the materials. See
        `tetopt.model.materials.binned`.
    spacing : {"equal", "quantile", "log"}
        How the bins divide the moduli.
    order : {1, 2}, optional
        By default the file's, or 1. 2: quadratic cells in the file, where a format has them, of straight edges unless
        the mesh has midpoints, as `mesh_image` with order 2 makes them on interfaces and on a mask's surface.
    cell_data : dict, optional
        What is known of each cell, by name; "mean" and "label" are used. By default `tetopt.cell_fields`, and what the
        file has.
    known_sets : Sets, optional
        Sets that came with the mesh, instead of the standard ones.
    box : Box, optional
        Of the image that the mesh was made from; by default of `image`.
    about : dict, optional
        Texts for the file's head. Its "label_table", a `LabelTable` or what `tetopt.model.labels.table_words` makes of
        one, is what labels are called, in mappings and in the standard sets.

    Returns
    -------
    Model
        For `save_model` or `Model.to_skfem`.

    Raises
    ------
    InputError
        As the functions named above; a dimension or an order that there is not; gravity without a density.

    Warns
    -----
    UserWarning
        Sets of the file that have to be called otherwise; loads or moduli of it that no longer fit.

    See Also
    --------
    save_model : Writes it for a solver.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> tetopt.save_model("ball.inp", model)  # for CalculiX or Abaqus

    Moduli by label:

    >>> labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    >>> data = {"label": tetopt.cell_labels(labels, mesh)}
    >>> tetopt.build_model(mesh, young="1=10,*=2", cell_data=data).materials.young.tolist()
    [2.0, 10.0]
    """
    loaded, loads = None, tuple(loads)
    if isinstance(mesh, MeshFile):
        loaded, is_of_file = _to_be_kept(mesh, [young, nu, density, bins], loads), young is None and bins is None
        mesh, order = loaded.mesh, loaded.order if order is None else order
        if cell_data is None:
            cell_data = loaded.cell_data | ({} if image is None else cell_fields(mesh, image))
        young, nu, density = moduli_in(cell_data, young, nu, density)
        cell_data = {name: values for name, values in cell_data.items() if name not in MATERIAL_FIELDS}
        loads = loads or _said(loads_in(loaded))
        box = loaded.box if box is None else box
        about = _texts_of(loaded, box) | (about or {})
    order = 1 if order is None else order
    if order not in (1, 2):
        raise InputError(f"order: expected 1 or 2, got {order}")
    parse_average(average)
    if image is not None and image.ndim != mesh.ndim:
        raise InputError(f"image: expected a {mesh.ndim}-D one, as the mesh is, got a {image.ndim}-D one")
    cell_data = cell_fields(mesh, image) if cell_data is None else dict(cell_data)
    labels = labels_of(cell_data, len(mesh.cells))
    about = _with_table_in_words(about or {}, labels)
    mean = cell_data.get("mean")
    mean = mean if mean is not None and mean.ndim == 1 else None
    cells = _ModelCells(mesh, image, mean, labels, table_of_words(about.get(TABLE_TEXT)).names)
    if known_sets is None:
        box = box_of(image) if box is None and image is not None else box
        known_sets = _sets(cells, box, cell_data, loaded, loads)
    all_sets = with_requested(mesh, known_sets, sets, mean)
    table, nodal, at_gauss = None, None, None
    if young is not None:
        nodal, at_gauss = _varying_moduli(young, mesh, image, average, order, bins)
        table = _materials(cells, young, nu, density, average)
        table = table if bins is None else binned(table, volumes(mesh.points, mesh.cells), bins, spacing)
    elif bins is not None:
        raise InputError("bins: there are no moduli to group; give `young`")
    elif density is not None:
        raise InputError("density: a material has a modulus, too; give `young`")
    parsed = parse_loads(loads, mesh, all_sets)
    if any(load.kind == "gravity" for load in parsed):
        density_of(table)  # or it is refused
    model = Model(mesh, cell_data, all_sets, table, parsed, order, node_young=nodal, gauss_young=at_gauss, about=about)
    return model if loaded is None else _said(completed(model, loaded, is_of_file=is_of_file))


def _said(answer: tuple[Any, str]) -> Any:
    """An answer, of which what was left out becomes a warning."""
    if answer[1]:
        warn(answer[1])
    return answer[0]


def _to_be_kept(loaded: MeshFile, mappings: list[Any], loads: Iterable[str]) -> MeshFile:
    """The file without what a solver found, if moduli, densities or loads are to be others."""
    return without_results(loaded) if loads or any(mapping is not None for mapping in mappings) else loaded


def _texts_of(loaded: MeshFile, box: Box | None) -> dict[str, Any]:
    """The texts of a mesh's file that go on into the model."""
    texts: dict[str, Any] = {name: text for name in TEXTS_KEPT if (text := loaded.text(name)) is not None}
    if loaded.label_table.names or loaded.label_table.colours:
        texts[TABLE_TEXT] = loaded.label_table
    return texts if box is None else texts | {"box": box_text(box)}


def _with_table_in_words(about: dict[str, Any], labels: NDArray[np.int64] | None) -> dict[str, Any]:
    """The texts with a table of labels as JSON can hold it, in which all labels of cells have a colour."""
    table = about.get(TABLE_TEXT)
    if table is None and labels is None:
        return dict(about)
    known = table if isinstance(table, LabelTable) else table_of_words(table)
    return about | {TABLE_TEXT: table_words(known if labels is None else coloured(known, labels))}


def _sets(
    cells: _ModelCells, box: Box | None, cell_data: dict[str, NDArray], loaded: MeshFile | None, loads: Iterable[str]
) -> Sets:
    """The standard sets, and those of the mesh's file beside them."""
    if loaded is None:
        return standard_sets(cells.mesh, box, cells.labels, cells.names)
    of_loads = {parse_load(text, cells.mesh.ndim).set_name for text in loads}
    former = loaded.label_table.names
    sets, renamed = sets_beside(cells.mesh, box, cell_data, loaded.sets, cells.names, former, of_loads)
    for old, new in renamed.items():
        warn(f'the mesh came with a set "{old}" of its own: it is {new} here')
    return sets


def _materials(cells: _ModelCells, young: Any, nu: Any, density: Any, average: str) -> Materials:
    """The materials of mappings; ratio and density by default of the columns of the file that the modulus names."""
    if nu is None:
        nu = young if isinstance(young, str) and has_column(young, "nu") else DEFAULT_NU
    if density is None and isinstance(young, str) and has_column(young, "density"):
        density = young
    moduli = _values(young, "young", cells, average)
    ratios = _values(nu, "nu", cells)
    masses = None if density is None else _values(density, "density", cells)
    return materials(moduli, ratios, len(cells.mesh.cells), masses)


def _varying_moduli(
    young: Any, mesh: Mesh, image: Image | None, average: str, order: int, bins: int | None
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """`node_young`, and moduli at Gauss points, of a mapping of the intensity; None but where the average has them."""
    mapping: Any = parse_any_mapping(young) if isinstance(young, str) else young
    place = parse_average(average).place
    if image is None or not (callable(mapping) or np.ndim(mapping) == 2):
        return None, None
    if place == "nodes" and bins is not None:
        raise InputError(f"bins: moduli that vary in a cell have no groups; take another average than {average}")
    return (
        node_young(image, mesh, mapping) if place == "nodes" else None,
        element_young(image, mesh, mapping, average, order)
        if place == "gauss" and order == 2 and bins is None
        else None,
    )


class _ModelCells(NamedTuple):
    """What mappings are of."""

    mesh: Mesh
    image: Image | None
    mean: NDArray[np.float64] | None  # (M,)
    labels: NDArray[np.int64] | None  # (M,)
    names: dict[int, str]  # of labels


def _values(value: Any, name: str, cells: _ModelCells, average: str = "mean") -> NDArray[np.float64]:
    """The value of each cell, or one for all."""
    mapping: Any = parse_any_mapping(value, name) if isinstance(value, str) else value
    if not callable(mapping) and not isinstance(mapping, ByLabel) and np.ndim(mapping) < 2:
        return np.asarray(mapping, dtype=np.float64)
    if isinstance(mapping, ByLabel):
        return by_label(mapping, cells.labels, cells.names)
    if cells.image is not None:  # the mapping of each voxel, and then the average, as Eq. (2) wants it
        by_voxel = (cells.image, cells.mesh, mapping)
        return cell_young(*by_voxel, average) if name == "young" else cell_values(*by_voxel)
    if cells.mean is None:
        raise InputError(f"{name}: a mapping of the intensity, but the mesh has no means; give the image (`image`)")
    if name == "young" and average != DEFAULT_AVERAGE:
        raise InputError(f"average: {average} is over the image's voxels; give the image (`image`)")
    # The mapping of each cell's mean: the same only where the mapping is linear over the cell.
    return young_from(mapping, cells.mean) if name == "young" else mapped_values(mapping, cells.mean)
