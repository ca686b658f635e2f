"""Construction of a model from a mesh and the user's choices."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tetopt.contents.align import is_in_mask
from tetopt.contents.content import Content, continue_image
from tetopt.contents.domain import mask_text
from tetopt.energy.sampling import cell_of_voxel, mask_of_values
from tetopt.engine.loop import MeshingResult
from tetopt.errors import InputError, Note, prefix_errors, warn
from tetopt.fields.field import Field
from tetopt.fields.onto_cells import cell_field, field_words
from tetopt.geometry.check import check_place
from tetopt.geometry.simplex import volumes
from tetopt.image import Image, check_image
from tetopt.measure.judge import warn_of_other_mask
from tetopt.mesh import Mesh
from tetopt.model.averages import (
    DEFAULT_AVERAGE,
    EMPTY_FRACTION,
    Images,
    cell_values,
    cell_young,
    element_young,
    finest_of,
    node_young,
    parse_average,
)
from tetopt.model.fields import (
    COHERENCE_SUFFIX,
    KINDS_TEXT,
    cell_fields,
    check_field_name,
    check_other_names,
    field_kinds,
)
from tetopt.model.file import (
    MASK_TEXT,
    OWN_MASK,
    MeshFile,
    complete_model,
    count_of_other_voxels,
    loads_in,
    mask_in,
    material_fields,
    moduli_in,
    own_mask,
    sets_beside,
    texts_of,
    without_stale_results,
    words_of_other_box,
)
from tetopt.model.formula import INTENSITY, Formula
from tetopt.model.label_names import (
    LABEL_FIELD,
    TABLE_TEXT,
    LabelTable,
    colour_labels,
    labels_of,
    table_of_words,
    table_words,
)
from tetopt.model.loads import parse_load, parse_loads
from tetopt.model.mappings import (
    MODULI,
    ByLabel,
    ModulusMapping,
    has_column,
    mapped_values,
    parse_any_mapping,
    young_from,
)
from tetopt.model.materials import (
    ALONG_FIELDS,
    DEFAULT_NU,
    Along,
    Spacing,
    bin_moduli,
    by_label,
    density_of,
    materials,
)
from tetopt.model.model import Model
from tetopt.model.sets import Box, Names, Sets, box_of, box_text, standard_sets, with_requested
from tetopt.system.arrays import Arrays, Floats, Ints, Json, plain_array


def build_model(
    mesh: Mesh | MeshFile | MeshingResult,
    image: Image | Content | None = None,
    *,
    young: str | float | Floats | ModulusMapping | ByLabel = None,
    nu: str | float | Floats | ModulusMapping | ByLabel = None,
    density: str | float | Floats | ModulusMapping | ByLabel = None,
    fibre: str | Floats | None = None,
    young_along: str | float | Floats | ModulusMapping | ByLabel = None,
    shear_along: str | float | Floats | ModulusMapping | ByLabel = None,
    average: str = DEFAULT_AVERAGE,
    fields: Mapping[str, Image | Field] | None = None,
    sets: Iterable[str] = (),
    loads: Iterable[str] = (),
    bins: int | None = None,
    spacing: Spacing = "equal",
    order: int | None = None,
    cell_data: Arrays | None = None,
    known_sets: Sets | None = None,
    box: Box | None = None,
    about: Json | None = None,
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
        (`tetopt.model.mappings.parse_any_mapping`), whose text may name the unit, "2.5*h MPa". With
        an image, a mapping of the intensity is averaged over the voxels of each cell; without, it
        is applied to the cell's "mean". Without `young` the model has no materials. `nu` defaults
        to the column "nu" of the file that `young` names, or to 0.45.
    density : number, (M,) array, mapping or str, optional
        Density, kg/m3, above 0, in the same forms; defaults to the column "density" of the file
        that `young` names, or to none. Gravity needs it.
    fibre : str or (M, 3) array, optional
        Directions of fibres, of any length and sign, or the name of such data of cells. The
        material is transversely isotropic about them, see `tetopt.model.materials`: `young` and
        `nu` then hold across the fibres, and moduli are constant within cells. Cells whose
        direction is 0 or NaN are isotropic.
    young_along, shear_along : number, (M,) array, mapping or str, optional
        With `fibre`: Young's modulus along the fibres, and the shear modulus between them and the
        directions across, kPa, in the forms of `young`; one of them may be left to its isotropic
        value, `young` or young / (2 (1 + nu)).
    average : str
        The average of Young's modulus over voxels, see `tetopt.model.averages.parse_average`;
        "mean" is Eq. (2). With "gauss" and quadratic cells, moduli vary within a cell in
        `tetopt.fem.solution.solve`, not in files. Ratios and densities are always averaged by the
        mean, with "linear" of images that are linear between voxel centres.
    fields : dict of str to Image or Field, optional
        Further images, and vectors, directions and tensors (`load_field`), on any grids in the
        world; cells get their values as data of these names (`cell_field`), and directions
        NAME_coherence. Mappings may use the names of images as they use h:
        ``young="3*mu"``. Such a mapping needs no `image` unless it names h. It is averaged over the
        voxels of the finest grid that it names (`tetopt.model.averages.cell_young`). A voxel of a
        field without a value (NaN), or outside the mesh's mask, has that of the nearest one.
    sets : iterable of str
        Additional sets, see `tetopt.model.sets.with_requested`.
    loads : iterable of str
        See `tetopt.model.loads.parse_loads`.
    bins : int, optional
        Group cells into at most this many materials; the resulting error is stored in the
        materials. See `tetopt.model.materials.bin_moduli`.
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
        `tetopt.model.label_names.table_words`, gives the names of labels in mappings and in the
        standard sets.

    Returns
    -------
    Model
        For `save_model` or `Model.to_skfem`.

    Raises
    ------
    InputError
        For the reasons of the functions named above; an invalid dimension or order; gravity without
        a density; an image beside a result of `mesh_image`; a field that lies elsewhere, or without
        a value in the mesh; fibres without moduli along them, or with moduli at nodes, or of a 2-D
        mesh; no such material.

    Warns
    -----
    UserWarning
        Sets of the file had to be renamed; its loads or moduli no longer fit; the content's mask is
        another one; part of the mesh lies outside the image or a field, has no value of a field, or
        is outside of the range of a mapping; cells have no direction.

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
    choices = Choices(young, nu, density, average, _texts(sets), _texts(loads), bins, spacing)
    choices = choices._replace(fields=fields or {}, fibre=fibre)
    choices = choices._replace(young_along=young_along, shear_along=shear_along)
    if isinstance(mesh, MeshingResult):
        mesh, image, order, cell_data = _of_result(mesh, image, order, cell_data)
    image, whole, about = _voxels(image, mesh, about or {})
    loaded = mesh if isinstance(mesh, MeshFile) else None
    mesh = mesh.mesh if isinstance(mesh, MeshFile) else mesh
    if whole is not None:
        check_place(mesh, whole)
    if loaded is not None:
        loaded = without_stale_results(loaded, is_stale=choices.is_new)
        box = loaded.box if box is None else box
        table = loaded.label_table
        of_box = {} if box is None else {"box": box_text(box)}
        of_labels = {TABLE_TEXT: table} if table.names or table.colours else {}
        about = texts_of(loaded) | of_labels | of_box | about
        order = loaded.order if order is None else order
        choices = choices._replace(loads=choices.loads or tuple(loads_in(loaded)))
    box = box_of(whole) if box is None and whole is not None else box
    choices = choices._replace(order=1 if order is None else order)
    if loaded is None:
        of_cells = cell_fields(mesh, image) if cell_data is None else dict(cell_data)
        cells = _cells_of(mesh, image, of_cells, about)
        if known_sets is None:
            known_sets = standard_sets(mesh, box, cells.labels, cells.names)
        return _model(cells, choices, of_cells, about, known_sets)
    if cell_data is None:
        cell_data = loaded.cell_data | ({} if image is None else cell_fields(mesh, image))
    return model_of_file(
        loaded._replace(cell_data=cell_data), image, choices, about, box, known_sets
    )


def _texts(words: str | Iterable[str]) -> tuple[str, ...]:
    return (words,) if isinstance(words, str) else tuple(words)


class Choices(NamedTuple):
    """What the user chooses for a model, as in `build_model`."""

    young: Any = None
    nu: Any = None
    density: Any = None
    average: str = DEFAULT_AVERAGE
    sets: Sequence[str] = ()
    loads: Sequence[str] = ()
    bins: int | None = None
    spacing: Spacing = "equal"
    order: int = 1
    units: str = "kPa"  # of moduli and pressures in texts without a unit
    fields: Mapping[str, Image | Field] = {}  # whose images mappings may name
    mask: Image | None = None  # of the fields' voxels, if the mesh's file has none
    fibre: Any = None
    young_along: Any = None
    shear_along: Any = None

    @property
    def is_new(self) -> bool:
        """True if results that were computed with a file's own moduli and loads no longer hold."""
        mappings = (self.young, self.nu, self.density, self.bins, self.fibre)
        return bool(self.loads) or any(each is not None for each in mappings)


def model_of_file(
    loaded: MeshFile,
    image: Image | None,
    choices: Choices,
    about: Json,
    box: Box | None,
    known_sets: Sets | None = None,
) -> Model:
    """Build the model of a mesh's file: what the choices leave open is the file's, except loads.

    The file's data of cells include those that the image gives. Warns of the file's data that are
    left out or renamed.
    """
    mesh = loaded.mesh
    fields = loaded.cell_data
    young, nu, density = moduli_in(fields, choices.young, choices.nu, choices.density)
    if nu is None and "nu" in fields:
        warn(f"ignored nu in the mesh's file; nu comes from `young`, or is {DEFAULT_NU:g}", Note)
    choices = _with_own_fibres(choices, fields)
    fields = {name: rows for name, rows in fields.items() if name not in material_fields(fields)}
    cells = _cells_of(mesh, image, fields, about)
    if known_sets is None:
        of_loads = {parse_load(text, mesh.ndim).set_name for text in choices.loads}
        former = loaded.label_table.names
        known_sets, renamed = sets_beside(
            mesh, box, fields, loaded.sets, cells.names, former, of_loads
        )
        for old, new in renamed.items():
            warn(f'renamed set "{old}" from the input mesh to "{new}" (name already in use)', Note)
    is_of_file = choices.young is None and choices.bins is None
    choices = choices._replace(young=young, nu=nu, density=density)
    model = _model(cells, choices, fields, about, known_sets)
    return complete_model(model, loaded, is_of_file=is_of_file)


def _model(
    cells: _ModelCells,
    choices: Choices,
    cell_data: Arrays,
    about: Json,
    known_sets: Sets,
) -> Model:
    """Build a model whose sets are those known and the chosen ones."""
    mesh = cells.mesh
    order = choices.order
    bins = choices.bins
    if order not in (1, 2):
        raise InputError(f"order: expected 1 or 2, got {order}")
    parse_average(choices.average)
    all_sets = with_requested(mesh, known_sets, choices.sets, cells.mean)
    mask = choices.mask if about.get(MASK_TEXT) is None else _mask_of(about)
    cell_data, about = with_cell_fields(mesh, choices.fields, mask, cell_data, about)
    table = None
    nodal = None
    at_gauss = None
    if choices.young is not None:
        laws = _laws(choices)
        cells = _with_fields(cells, _images_of(choices), laws, mask)
        nodal, at_gauss = _varying_moduli(cells, laws.young, choices)
        values: dict[str, Any] = {
            name: None if law is None else _values(law, name, cells, choices.average)
            for name, law in laws._asdict().items()
        }
        along = _along(mesh, choices, values, cell_data)
        n_cells = len(mesh.cells)
        table = materials(values["young"], values["nu"], n_cells, values["density"], along)
        _warn_of_isotropic(mesh, table.along)
        if bins is not None:
            table = bin_moduli(table, volumes(mesh.points, mesh.cells), bins, choices.spacing)
    elif bins is not None:
        raise InputError("bins: the model has no moduli to group; give `young`")
    elif choices.density is not None or choices.fibre is not None:
        name = "fibre" if choices.density is None else "density"
        raise InputError(f"{name}: a material also needs a modulus; give `young`")
    loads = parse_loads(choices.loads, mesh, all_sets, choices.units)
    if any(load.kind == "gravity" for load in loads):
        density_of(table)  # raises InputError without a density
    about = _with_table_in_words(about, cells.labels)
    return Model(
        mesh,
        cell_data,
        all_sets,
        table,
        loads,
        order,
        node_young=nodal,
        gauss_young=at_gauss,
        about=about,
    )


def _of_result(
    result: MeshingResult,
    image: Image | Content | None,
    order: int | None,
    cell_data: Arrays | None,
) -> tuple[Mesh, Content, int | None, Arrays]:
    """Return a result's mesh and content, and its order and data of cells, unless given."""
    mesh = result.mesh
    content = result.content
    if image is not None or content is None:
        raise InputError(
            "build_model: expected a result of `mesh_image` without an image, as it has its own; "
            "pass `result.mesh` with an image instead"
        )
    if cell_data is None:
        labels = {} if result.labels is None else {LABEL_FIELD: result.labels}
        cell_data = cell_fields(mesh, content) | labels
    return mesh, content, result.order if order is None else order, cell_data


def _voxels(
    image: Image | Content | None, mesh: Mesh | MeshFile, about: Json
) -> tuple[Image | None, Image | None, Json]:
    """Return the image with the voxels that count, the whole image, and the file's strings with
    one on the mask.
    """
    whole = image.given if isinstance(image, Content) else image
    whole = None if whole is None else check_image("image", whole)
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
    if whole is None:
        return None, None, about
    within = None if isinstance(mesh, Mesh) else own_mask(mesh, whole)
    within = within or mask_of_values(whole, mesh if isinstance(mesh, Mesh) else mesh.mesh)
    return continue_image(whole, within), whole, about


def _table_of(about: Json) -> LabelTable:
    """Return the label table among a model's texts."""
    table = about.get(TABLE_TEXT)
    return table if isinstance(table, LabelTable) else table_of_words(table)


def _with_table_in_words(about: Json, labels: Ints | None) -> Json:
    """Return the texts with a label table in JSON's types, in which all labels of cells have a
    colour.
    """
    if about.get(TABLE_TEXT) is None and labels is None:
        return dict(about)
    table = _table_of(about)
    return about | {
        TABLE_TEXT: table_words(table if labels is None else colour_labels(table, labels))
    }


class _Laws(NamedTuple):
    """The values or mappings of the choices, parsed; moduli in kPa."""

    young: Any
    nu: Any
    density: Any  # None for none
    young_along: Any  # None for isotropic ones
    shear_along: Any


def _laws(choices: Choices) -> _Laws:
    """Return the parsed choices; ratio and density default to columns of the file that the modulus
    names.
    """
    young = choices.young
    nu = choices.nu
    density = choices.density
    if nu is None:
        nu = young if isinstance(young, str) and has_column(young, "nu") else DEFAULT_NU
    if density is None and isinstance(young, str) and has_column(young, "density"):
        density = young
    return _Laws(
        *(
            parse_any_mapping(law, name, choices.units, _images_of(choices))
            if isinstance(law, str)
            else law
            for name, law in zip(
                _Laws._fields,
                (young, nu, density, choices.young_along, choices.shear_along),
                strict=True,
            )
        )
    )


def _with_own_fibres(choices: Choices, fields: Arrays) -> Choices:
    """Return the choices with the fibres of a mesh's file, if its moduli are kept, or if the name
    chosen is that of its fibres.
    """
    if "young_along" not in fields:
        return choices
    if isinstance(choices.fibre, str) and choices.fibre == "fibre":
        return choices._replace(fibre=fields.get("fibre", "fibre"))
    if choices.fibre is None and choices.young is None:
        own: dict[str, Any] = {name: fields[name] for name in ALONG_FIELDS if name in fields}
        return choices._replace(**own)
    warn("dropped the fibres of the mesh's file, as `young` or `fibre` replaces them", Note)
    return choices


def _directions(fibre: str | Floats, cell_data: Arrays) -> Floats:
    """Return directions, or the data of cells that they name."""
    if not isinstance(fibre, str):
        return fibre
    vectors = [name for name, rows in cell_data.items() if rows.shape[1:] == (3,)]
    if fibre not in vectors:
        raise InputError(
            f"fibre: expected data of cells with three numbers, such as "
            f"{', '.join(vectors) or 'of `fields`'}, got {fibre!r}"
        )
    return cell_data[fibre]


def _along(mesh: Mesh, choices: Choices, values: dict[str, Any], cell_data: Arrays) -> Along | None:
    """Return the fibres and the moduli along them, isotropic ones if not stated."""
    stated = {name: values[name] for name in ALONG_FIELDS[:2] if values[name] is not None}
    if choices.fibre is None:
        if stated:
            raise InputError(f"{next(iter(stated))}: needs the direction of fibres; give `fibre`")
        return None
    if not stated:
        raise InputError("fibre: needs a modulus along; give `young_along` or `shear_along`")
    if mesh.ndim != 3:
        raise InputError("fibre: expected a tetrahedral mesh, got triangles")
    if parse_average(choices.average).place == "nodes":
        raise InputError(
            "fibre: moduli along fibres are constant within cells; use an average other than nodes"
        )
    shear = values["young"] / (2.0 * (1.0 + values["nu"]))
    return Along(
        **{"young_along": values["young"], "shear_along": shear, **stated},
        fibre=_directions(choices.fibre, cell_data),
    )


def _warn_of_isotropic(mesh: Mesh, along: Along | None) -> None:
    """Warn of cells that have no direction beside others that have fibres."""
    is_isotropic = np.zeros(1) if along is None else ~along.fibre.any(axis=1)
    if is_isotropic.any():
        of_cells = volumes(mesh.points, mesh.cells)
        warn(
            f"fibre: {is_isotropic.sum()} of {len(mesh.cells)} cells, "
            f"{of_cells[is_isotropic].sum() / of_cells.sum():.1%} of the volume, have no "
            "direction: they are isotropic, with `young` and `nu`"
        )


def _with_fields(
    cells: _ModelCells, fields: Mapping[str, Image], laws: _Laws, mask: Image | None
) -> _ModelCells:
    """Return the cells with the fields that laws and ranges name, each with a value in every voxel.

    A voxel without one, or outside the mask, has that of the nearest other.
    """
    formulas = [law for law in laws if isinstance(law, Formula)]
    formulas += [law.outside for law in formulas if law.outside is not None]
    named = [each.names for each in formulas]
    images = dict(cells.images)
    for name in sorted(fields.keys() & frozenset().union(*named)):
        with prefix_errors(f"field {name}"):
            images[name] = _whole_field(name, fields[name], cells.mesh, mask)
    return cells._replace(images=images)


def _images_of(choices: Choices) -> dict[str, Image]:
    """Return the scalar fields."""
    return {name: each for name, each in choices.fields.items() if not isinstance(each, Field)}


def _mask_of(about: Json) -> Image | None:
    """Return the mask among a model's texts, if it is one of ours."""
    text = about[MASK_TEXT]
    return mask_in(json.loads(text) if isinstance(text, str) else text)


def with_cell_fields(
    mesh: Mesh,
    fields: Mapping[str, Image | Field],
    mask: Image | None,
    cell_data: Arrays,
    about: Json,
) -> tuple[Arrays, Json]:
    """Return the data of cells with the values of fields, and the texts with their kinds; tell
    cells and voxels without own data.
    """
    kinds = field_kinds(about.get(KINDS_TEXT))
    check_other_names({name: getattr(each, "kind", "scalar") for name, each in fields.items()})
    for name, field in fields.items():
        check_field_name(name)
        if isinstance(field, Field):
            grid, kinds[name] = field.grid, field.kind
        else:
            grid, kinds[name] = check_image(f"field {name}", field), "scalar"
        with prefix_errors(f"field {name}"):
            check_place(mesh, grid, f"field {name}")
            own = cell_field(field, mesh, mask)
        cell_data = {**cell_data, name: own.values}
        if own.coherence is not None:
            cell_data[f"{name}{COHERENCE_SUFFIX}"] = own.coherence
        if words := field_words(own):
            warn(f"field {name}: {words}", Note)
    return cell_data, about | ({KINDS_TEXT: kinds} if kinds else {})


def _whole_field(name: str, field: Image, mesh: Mesh, mask: Image | None) -> Image:
    """Return a field of which every voxel has a value; warn of voxels of the mesh that have none.

    Raises InputError for a field without a value in the mesh.
    """
    has_value = ~np.isnan(field.data)
    if field.has_gaps:
        is_good = has_value[cell_of_voxel(field, mesh) >= 0]
        if not is_good.all():
            warn(
                f"field {name}: {1.0 - is_good.mean():.1%} of the voxels in the mesh have no value "
                "(NaN) and take the nearest one's"
            )
    if mask is not None:
        has_value &= is_in_mask(mask, field, OWN_MASK)
    return field if has_value.all() else continue_image(field, Image(has_value, field.affine))


def _varying_moduli(
    cells: _ModelCells, young: Any, choices: Choices
) -> tuple[Floats | None, Floats | None]:
    """Return `node_young` and moduli at Gauss points from a mapping of images; None if the average
    has none.
    """
    average = choices.average
    place = parse_average(average).place
    if place not in ("nodes", "gauss") or not (callable(young) or np.ndim(young) == 2):
        return None, None
    images = None if choices.fibre is not None else _images_for(young, "young", cells)
    if images is None:
        return None, None
    if place == "nodes" and choices.bins is not None:
        raise InputError(
            "bins: moduli that vary within cells cannot be grouped; use an average other than "
            f"{average}"
        )
    if place == "nodes":
        return node_young(images, cells.mesh, young), None
    if choices.order == 2 and choices.bins is None:
        return None, element_young(images, cells.mesh, young, average, choices.order)
    return None, None


class _ModelCells(NamedTuple):
    """The data of cells that mappings are applied to."""

    mesh: Mesh
    images: Mapping[str, Image]  # by their names in formulas, "h" if there is an image
    mean: Floats | None  # (M,)
    labels: Ints | None  # (M,)
    names: Names  # of labels


def _cells_of(mesh: Mesh, image: Image | None, cell_data: Arrays, about: Json) -> _ModelCells:
    """Return a mesh's cells with the means, labels and names of labels in their data."""
    mean = cell_data.get("mean")
    mean = mean if mean is not None and mean.ndim == 1 else None
    labels = labels_of(cell_data, len(mesh.cells))
    images = {} if image is None else {INTENSITY: image}
    return _ModelCells(mesh, images, mean, labels, _table_of(about).names)


def _images_for(mapping: Any, name: str, cells: _ModelCells) -> Images | None:
    """Return the image, or images, that a mapping is applied to; None if it has no voxels."""
    if not isinstance(mapping, Formula) or mapping.names <= {INTENSITY}:
        return cells.images.get(INTENSITY)
    if missing := mapping.names - cells.images.keys():
        raise InputError(
            f"{name} depends on the intensity {''.join(missing)} beside fields; give the image "
            "(`image`)"
        )
    return {each: cells.images[each] for each in sorted(mapping.names)}


def _values(mapping: Any, name: str, cells: _ModelCells, average: str) -> Floats:
    """Return the value of each cell, or one for all; the average is of moduli alone, unless it is
    "linear".
    """
    if isinstance(mapping, dict):
        raise InputError(
            f"{name}: expected a number, array, mapping or text, got a dict; use "
            "tetopt.ByLabel(dict)"
        )
    if not callable(mapping) and not isinstance(mapping, ByLabel) and np.ndim(mapping) < 2:
        return plain_array(name, mapping).astype(np.float64)
    if isinstance(mapping, ByLabel):
        return by_label(mapping, cells.labels, cells.names)
    images = _images_for(mapping, name, cells)
    is_linear = parse_average(average).place == "linear"
    if images is not None:  # map each voxel, then average, as in Eq. (2)
        _warn_of_range(mapping, name, cells, is_linear=is_linear)
        if name in MODULI:
            if isinstance(images, Mapping) and not is_linear:
                _warn_of_empty_cells(cells.mesh, images)
            return cell_young(images, cells.mesh, mapping, average)
        return cell_values(images, cells.mesh, mapping, is_linear=is_linear)
    mean = _mean_for(name, cells)
    if name in MODULI and average != DEFAULT_AVERAGE:
        raise InputError(f"average: {average} needs the image's voxels; give the image (`image`)")
    # The mapping of each cell's mean equals the mean of the mapping only where the mapping is
    # linear.
    _warn_of_range(mapping, name, cells)
    return young_from(mapping, mean) if name in MODULI else mapped_values(mapping, mean)


def _mean_for(name: str, cells: _ModelCells) -> Floats:
    """Return the mean of each cell, which a mapping is applied to without an image."""
    if cells.mean is None:
        raise InputError(
            f"{name} depends on intensity, but the mesh has no cell means; give the image (`image`)"
        )
    return cells.mean


def _warn_of_empty_cells(mesh: Mesh, images: Mapping[str, Image]) -> None:
    """Warn if many cells contain no voxel of the grid on which a formula is averaged."""
    name = finest_of(images)
    owner = cell_of_voxel(images[name], mesh)
    empty = 1.0 - len(np.unique(owner[owner >= 0])) / len(mesh.cells)
    if empty > EMPTY_FRACTION:
        what = "the image" if name == INTENSITY else f"field {name}"
        warn(
            f"{empty:.0%} of the cells contain no voxel centre of {what} and take the nearest "
            "voxel's modulus; take it linear between voxels (`average` linear)"
        )


def _warn_of_range(mapping: Any, name: str, cells: _ModelCells, *, is_linear: bool = False) -> None:
    """Warn of the share of the mesh's volume outside of the range that a mapping states, on the
    grids that the range names.
    """
    if not isinstance(mapping, Formula) or mapping.outside is None:
        return
    images = _images_for(mapping.outside, name, cells)
    if images is None:
        outside = mapping.outside(_mean_for(name, cells))
    else:
        outside = cell_values(images, cells.mesh, mapping.outside, is_linear=is_linear)
    volumes = cells.mesh.cell_volumes
    if (share := float((volumes * outside).sum() / volumes.sum())) > 0.0:
        warn(
            f"{name}: {100.0 * share:.3g} % of the mesh's volume is outside of the range of the "
            f"mapping, {mapping.range_text}, which is extrapolated there"
        )
