"""Construction of a model from a mesh and the user's choices."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, continued
from tetopt.contents.domain import mask_text
from tetopt.engine.loop import MeshingResult
from tetopt.errors import InputError, warn
from tetopt.geometry.simplex import volumes
from tetopt.image import Image
from tetopt.measure.requirements import warn_of_other_mask
from tetopt.mesh import Mesh
from tetopt.model.averages import (
    DEFAULT_AVERAGE,
    cell_values,
    cell_young,
    element_young,
    node_young,
    parse_average,
)
from tetopt.model.fields import cell_fields
from tetopt.model.file import (
    MASK_TEXT,
    MATERIAL_FIELDS,
    TEXTS_KEPT,
    MeshFile,
    completed,
    count_of_other_voxels,
    loads_in,
    moduli_in,
    own_mask,
    sets_beside,
    without_results,
    words_of_other_box,
)
from tetopt.model.labels import (
    TABLE_TEXT,
    LabelTable,
    coloured,
    labels_of,
    table_of_words,
    table_words,
)
from tetopt.model.loads import parse_load, parse_loads
from tetopt.model.mappings import (
    ByLabel,
    ModulusMapping,
    has_column,
    mapped_values,
    parse_any_mapping,
    young_from,
)
from tetopt.model.materials import (
    DEFAULT_NU,
    Materials,
    Spacing,
    binned,
    by_label,
    density_of,
    materials,
)
from tetopt.model.model import Model
from tetopt.model.sets import Box, Sets, box_of, box_text, standard_sets, with_requested


def build_model(
    mesh: Mesh | MeshFile | MeshingResult,
    image: Image | Content | None = None,
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
    """Build the model of a mesh for a solver, for `tetopt.save_model` and `Model.to_skfem`.

    Parameters
    ----------
    mesh : Mesh, MeshFile or MeshingResult
        A result of `mesh_image` comes with the image, mask and labels that it was made from. The
        contents of a file (`tetopt.load_mesh`) go into the model unless arguments replace them:
        data of cells and nodes, labels and their names, sets, moduli, loads, the image's box, and
        strings on its origin. Solver results are kept if moduli and loads are.
    image : Image or Content, optional
        Mappings are applied to its intensities, and the faces of its box become sets. For a mesh of
        a content, pass the content: its first contrast counts, and no voxel outside its mask. A
        MeshFile knows its mask; a MeshingResult has its content and takes no image.
    young, nu : number, (M,) array, mapping or str, optional
        Young's modulus, kPa, above 0, and Poisson's ratio, above -1 and below 0.5: one for all
        cells, one per cell, or a mapping of the intensity or of the label
        (`tetopt.model.mappings.parse_any_mapping`). With an image, a mapping of the intensity is
        averaged over the voxels of each cell; without, it is applied to the cell's "mean". Without
        `young` the model has no materials. `nu` defaults to the column "nu" of the file that
        `young` names, or to 0.45.
    density : number, (M,) array, mapping or str, optional
        Density, kg/m3, above 0, in the same forms; defaults to the column "density" of the file
        that `young` names, or to none. Gravity needs it.
    average : str
        The average of Young's modulus over voxels, see `tetopt.model.averages.parse_average`;
        "mean" is Eq. (2). With "gauss" and quadratic cells, moduli vary within a cell in
        `tetopt.fem.solution.solve`, not in files. Ratios and densities are always averaged by the
        mean.
    sets : iterable of str
        Additional sets, see `tetopt.model.sets.with_requested`.
    loads : iterable of str
        See `tetopt.model.loads.parse_loads`.
    bins : int, optional
        Group cells into at most this many materials; the resulting error is stored in the
        materials. See `tetopt.model.materials.binned`.
    spacing : {"equal", "quantile", "log"}
        The spacing of the bins.
    order : {1, 2}, optional
        By default the file's or the result's, or 1. 2: quadratic cells where a file format has
        them, with straight edges unless the mesh has midpoints; `mesh_image` with order 2 creates
        these on interfaces and a mask's surface.
    cell_data : dict, optional
        Data of each cell, by name; "mean" and "label" are used. By default `tetopt.cell_fields` and
        the data of the file.
    known_sets : Sets, optional
        Sets that replace the standard ones.
    box : Box, optional
        The box of the meshed image; by default that of `image`.
    about : dict, optional
        Strings for the file's header. Its "label_table", a `LabelTable` or the result of
        `tetopt.model.labels.table_words`, gives the names of labels in mappings and in the standard
        sets.

    Returns
    -------
    Model
        For `save_model` or `Model.to_skfem`.

    Raises
    ------
    InputError
        For the reasons of the functions named above; an invalid dimension or order; gravity without
        a density; an image beside a result of `mesh_image`.

    Warns
    -----
    UserWarning
        Sets of the file had to be renamed; its loads or moduli no longer fit; the content's mask is
        another one.

    See Also
    --------
    save_model : Write it for a solver.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> result = tetopt.mesh_image(image, 300, iterations=8)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(result, young="0.1*h", nu=0.45, loads=loads, order=2)
    >>> tetopt.save_model("ball.inp", model)  # for CalculiX or Abaqus

    Moduli by label:

    >>> labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> data = {"label": tetopt.cell_labels(labels, mesh)}
    >>> tetopt.build_model(mesh, young="1=10,*=2", cell_data=data).materials.young.tolist()
    [2.0, 10.0]
    """
    loaded, loads = None, tuple(loads)
    if isinstance(mesh, MeshingResult):
        mesh, image, order, cell_data = _of_result(mesh, image, order, cell_data)
    image, whole, about = _voxels(image, mesh, about or {})
    if isinstance(mesh, MeshFile):
        loaded, is_of_file = (
            _to_be_kept(mesh, [young, nu, density, bins], loads),
            young is None and bins is None,
        )
        mesh, order = loaded.mesh, loaded.order if order is None else order
        if cell_data is None:
            cell_data = loaded.cell_data | ({} if image is None else cell_fields(mesh, image))
        young, nu, density = moduli_in(cell_data, young, nu, density)
        cell_data = {
            name: values for name, values in cell_data.items() if name not in MATERIAL_FIELDS
        }
        loads = loads or _said(loads_in(loaded))
        box = loaded.box if box is None else box
        about = _texts_of(loaded, box) | about
    if (order := 1 if order is None else order) not in (1, 2):
        raise InputError(f"order: expected 1 or 2, got {order}")
    parse_average(average)
    if image is not None and image.ndim != mesh.ndim:
        raise InputError(
            f"image: expected a {mesh.ndim}-D image, like the mesh, got a {image.ndim}-D one"
        )
    cell_data = cell_fields(mesh, image) if cell_data is None else dict(cell_data)
    labels = labels_of(cell_data, len(mesh.cells))
    about = _with_table_in_words(about, labels)
    mean = means if (means := cell_data.get("mean")) is not None and means.ndim == 1 else None
    cells = _ModelCells(mesh, image, mean, labels, table_of_words(about.get(TABLE_TEXT)).names)
    if known_sets is None:
        box = box_of(whole) if box is None and whole is not None else box
        known_sets = _sets(cells, box, cell_data, loaded, loads)
    all_sets = with_requested(mesh, known_sets, sets, mean)
    table, nodal, at_gauss = None, None, None
    if young is not None:
        nodal, at_gauss = _varying_moduli(young, mesh, image, average, order, bins)
        table = _materials(cells, young, nu, density, average)
        table = (
            table
            if bins is None
            else binned(table, volumes(mesh.points, mesh.cells), bins, spacing)
        )
    elif bins is not None:
        raise InputError("bins: the model has no moduli to group; give `young`")
    elif density is not None:
        raise InputError("density: a material also needs a modulus; give `young`")
    parsed = parse_loads(loads, mesh, all_sets)
    if any(load.kind == "gravity" for load in parsed):
        density_of(table)  # raises InputError without a density
    model = Model(
        mesh,
        cell_data,
        all_sets,
        table,
        parsed,
        order,
        node_young=nodal,
        gauss_young=at_gauss,
        about=about,
    )
    return model if loaded is None else _said(completed(model, loaded, is_of_file=is_of_file))


def _of_result(
    result: MeshingResult,
    image: Image | Content | None,
    order: int | None,
    cell_data: dict[str, NDArray] | None,
) -> tuple[Mesh, Content, int | None, dict[str, NDArray]]:
    """Return a result's mesh and content, and its order and data of cells, unless given."""
    mesh, content = result.mesh, result.content
    if image is not None or content is None:
        raise InputError(
            "build_model: expected a result of `mesh_image` without an image, as it has its own; "
            "pass `result.mesh` "
            "with an image instead"
        )
    if cell_data is None:
        labels = {} if result.labels is None else {"label": result.labels}
        cell_data = cell_fields(mesh, content) | labels
    return mesh, content, result.order if order is None else order, cell_data


def _voxels(
    image: Image | Content | None, mesh: Mesh | MeshFile, about: dict[str, Any]
) -> tuple[Image | None, Image | None, dict[str, Any]]:
    """Return the image with the voxels that count, the whole image, and the file's strings with
    one on the mask.
    """
    whole = image.given if isinstance(image, Content) else image
    if (
        whole is not None
        and isinstance(mesh, MeshFile)
        and (words := words_of_other_box(mesh, whole))
    ):
        warn(
            f"image: its box differs from that of the mesh's image, {words}; is it registered to "
            "that image?"
        )
    if isinstance(image, Content) and (mask := image.own_mask) is not None:
        if isinstance(mesh, Mesh) or MASK_TEXT not in mesh.field_data:
            warn_of_other_mask(mesh if isinstance(mesh, Mesh) else mesh.mesh, mask)
        elif n_other := count_of_other_voxels(mesh, mask):
            warn(
                f"image: the content's mask differs in {n_other} voxels from the mask that the "
                "mesh was built within"
            )
        return image.own, whole, {MASK_TEXT: mask_text(mask), **about}
    within = None if whole is None or isinstance(mesh, Mesh) else own_mask(mesh, whole)
    return (whole if whole is None else continued(whole, within)), whole, about


def _said(answer: tuple[Any, str]) -> Any:
    """Return the value of an answer; warn of its note on dropped data."""
    if answer[1]:
        warn(answer[1])
    return answer[0]


def _to_be_kept(loaded: MeshFile, mappings: list[Any], loads: Iterable[str]) -> MeshFile:
    """Return the file without solver results if moduli, densities or loads change."""
    return (
        without_results(loaded)
        if loads or any(mapping is not None for mapping in mappings)
        else loaded
    )


def _texts_of(loaded: MeshFile, box: Box | None) -> dict[str, Any]:
    """Return the texts of a mesh's file that the model keeps."""
    texts: dict[str, Any] = {
        name: text for name in TEXTS_KEPT if (text := loaded.text(name)) is not None
    }
    if loaded.label_table.names or loaded.label_table.colours:
        texts[TABLE_TEXT] = loaded.label_table
    return texts if box is None else texts | {"box": box_text(box)}


def _with_table_in_words(about: dict[str, Any], labels: NDArray[np.int64] | None) -> dict[str, Any]:
    """Return the texts with a label table in JSON's types, in which all labels of cells have a
    colour.
    """
    table = about.get(TABLE_TEXT)
    if table is None and labels is None:
        return dict(about)
    known = table if isinstance(table, LabelTable) else table_of_words(table)
    return about | {TABLE_TEXT: table_words(known if labels is None else coloured(known, labels))}


def _sets(
    cells: _ModelCells,
    box: Box | None,
    cell_data: dict[str, NDArray],
    loaded: MeshFile | None,
    loads: Iterable[str],
) -> Sets:
    """Return the standard sets and those of the mesh's file."""
    if loaded is None:
        return standard_sets(cells.mesh, box, cells.labels, cells.names)
    of_loads = {parse_load(text, cells.mesh.ndim).set_name for text in loads}
    former = loaded.label_table.names
    sets, renamed = sets_beside(
        cells.mesh, box, cell_data, loaded.sets, cells.names, former, of_loads
    )
    for old, new in renamed.items():
        warn(f'renamed set "{old}" from the input mesh to "{new}" (name already in use)')
    return sets


def _materials(cells: _ModelCells, young: Any, nu: Any, density: Any, average: str) -> Materials:
    """Build materials from mappings; ratio and density default to columns of the file that the
    modulus names.
    """
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
    """Return `node_young` and moduli at Gauss points from a mapping of the intensity; None if
    the average has none.
    """
    mapping: Any = parse_any_mapping(young) if isinstance(young, str) else young
    place = parse_average(average).place
    if image is None or not (callable(mapping) or np.ndim(mapping) == 2):
        return None, None
    if place == "nodes" and bins is not None:
        raise InputError(
            "bins: moduli that vary within cells cannot be grouped; use an average other than "
            f"{average}"
        )
    return (
        node_young(image, mesh, mapping) if place == "nodes" else None,
        element_young(image, mesh, mapping, average, order)
        if place == "gauss" and order == 2 and bins is None
        else None,
    )


class _ModelCells(NamedTuple):
    """The data of cells that mappings are applied to."""

    mesh: Mesh
    image: Image | None
    mean: NDArray[np.float64] | None  # (M,)
    labels: NDArray[np.int64] | None  # (M,)
    names: dict[int, str]  # of labels


def _values(
    value: Any, name: str, cells: _ModelCells, average: str = "mean"
) -> NDArray[np.float64]:
    """Return the value of each cell, or one for all."""
    mapping: Any = parse_any_mapping(value, name) if isinstance(value, str) else value
    if isinstance(mapping, dict):
        raise InputError(
            f"{name}: expected a number, array, mapping or text, got a dict; use "
            "tetopt.ByLabel(dict)"
        )
    if not callable(mapping) and not isinstance(mapping, ByLabel) and np.ndim(mapping) < 2:
        return np.asarray(mapping, dtype=np.float64)
    if isinstance(mapping, ByLabel):
        return by_label(mapping, cells.labels, cells.names)
    if cells.image is not None:  # map each voxel, then average, as in Eq. (2)
        by_voxel = (cells.image, cells.mesh, mapping)
        return cell_young(*by_voxel, average) if name == "young" else cell_values(*by_voxel)
    if cells.mean is None:
        raise InputError(
            f"{name} depends on intensity, but the mesh has no cell means; give the image (`image`)"
        )
    if name == "young" and average != DEFAULT_AVERAGE:
        raise InputError(f"average: {average} needs the image's voxels; give the image (`image`)")
    # The mapping of each cell's mean equals the mean of the mapping only where the mapping is
    # linear.
    return (
        young_from(mapping, cells.mean) if name == "young" else mapped_values(mapping, cells.mean)
    )
