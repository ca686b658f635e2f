"""A model from a mesh and what a user says of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.simplex import volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.averages import DEFAULT_AVERAGE, cell_values, cell_young, element_young, node_young, parse_average
from tetopt.model.fields import cell_fields
from tetopt.model.labels import TABLE_TEXT, table_of_words
from tetopt.model.laws import ByLabel, Law, has_column, law_values, parse_any_law, young_from
from tetopt.model.loads import parse_loads
from tetopt.model.materials import DEFAULT_NU, Spacing, binned, by_label, density_of, materials
from tetopt.model.model import Model
from tetopt.model.sets import Box, Sets, box_of, standard_sets, with_requested


def model_of(
    mesh: Mesh,
    image: Image | None = None,
    *,
    young: str | float | NDArray[np.float64] | Law | ByLabel = None,
    nu: str | float | NDArray[np.float64] | Law | ByLabel = None,
    density: str | float | NDArray[np.float64] | Law | ByLabel = None,
    average: str = DEFAULT_AVERAGE,
    sets: Iterable[str] = (),
    loads: Iterable[str] = (),
    bins: int | None = None,
    spacing: Spacing = "equal",
    order: int = 1,
    cell_data: dict[str, NDArray] | None = None,
    known_sets: Sets | None = None,
    box: Box | None = None,
    about: dict[str, Any] | None = None,
) -> Model:
    """All that a solver is told of a mesh, for `tetopt.save_model` and `Model.to_skfem`.

    Parameters
    ----------
    mesh : Mesh
        Points in world mm.
    image : Image, optional
        Its intensities are what laws are of, and its box's faces become sets.
    young, nu : number, (M,) array, law or text, optional
        Young's modulus, kPa, above 0, and Poisson's ratio, above -1 and below 0.5: one for all cells, one for each, or
        a law of the intensity or of the label (`tetopt.model.laws.parse_any_law`), of which with an image an average
        over the voxels of the cell is taken, and else its value at the cell's "mean". Without `young` the model has
        no materials; without `nu` it is the column "nu" of the file that `young` names, or 0.45.
    density : number, (M,) array, law or text, optional
        kg/m3, above 0, likewise; without it the column "density" of the file that `young` names, or none. Gravity
        needs it.
    average : str
        Of a law of Young's modulus over the voxels, see `tetopt.model.averages.parse_average`; "mean" is Eq. (2).
        With "gauss" and quadratic cells moduli vary in a cell for `tetopt.fem.solution.solved_model`; files have one.
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
    order : {1, 2}
        2: straight-edged quadratic cells in the file, where a format has them.
    cell_data : dict, optional
        What is known of each cell, by name; "mean" and "label" are used. By default `tetopt.cell_fields`.
    known_sets : Sets, optional
        Sets that came with the mesh, instead of the standard ones.
    box : Box, optional
        Of the image that the mesh was made from; by default of `image`.
    about : dict, optional
        Texts for the file's head. Its "label_table" (`tetopt.model.labels.table_words`) is what labels are called, in
        laws and in the standard sets.

    Returns
    -------
    Model
        For `save_model` or `Model.to_skfem`.

    Raises
    ------
    InputError
        As the functions named above; a dimension or an order that there is not; gravity without a density.

    See Also
    --------
    save_model : Writes it for a solver.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.model_of(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> tetopt.save_model("ball.inp", model)  # for CalculiX or Abaqus

    Moduli by label:

    >>> labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    >>> data = {"label": tetopt.cell_labels(labels, mesh)}
    >>> tetopt.model_of(mesh, young="1=10,*=2", cell_data=data).materials.young.tolist()
    [2.0, 10.0]
    """
    if order not in (1, 2):
        raise InputError(f"order: expected 1 or 2, got {order}")
    parse_average(average)
    if image is not None and image.ndim != mesh.ndim:
        raise InputError(f"image: expected a {mesh.ndim}-D one, as the mesh is, got a {image.ndim}-D one")
    cell_data = cell_fields(mesh, image) if cell_data is None else dict(cell_data)
    mean = cell_data.get("mean")
    mean = mean if mean is not None and mean.ndim == 1 else None
    labels = labels_of(cell_data, len(mesh.cells))
    names = table_of_words((about or {}).get(TABLE_TEXT)).names
    if nu is None:
        nu = young if isinstance(young, str) and has_column(young, "nu") else DEFAULT_NU
    if density is None and isinstance(young, str) and has_column(young, "density"):
        density = young
    if known_sets is None:
        box = box_of(image) if box is None and image is not None else box
        known_sets = standard_sets(mesh, box, labels, names)
    all_sets = with_requested(mesh, known_sets, sets, mean)
    table, nodal, at_gauss = None, None, None
    if young is not None:
        nodal, at_gauss = _varying_moduli(young, mesh, image, average, order)
        if bins is not None and nodal is not None:
            raise InputError(f"bins: moduli that vary in a cell have no groups; take another average than {average}")
        at_gauss = None if bins is not None else at_gauss
        cells = _Cells(mesh, image, mean, labels, names)
        moduli = _values(young, "young", cells, average)
        ratios = _values(nu, "nu", cells)
        masses = None if density is None else _values(density, "density", cells)
        table = materials(moduli, ratios, len(mesh.cells), masses)
        if bins is not None:
            table = binned(table, volumes(mesh.points, mesh.cells), bins, spacing)
    elif bins is not None:
        raise InputError("bins: there are no moduli to group; give --young")
    elif density is not None:
        raise InputError("density: a material has a modulus, too; give --young")
    parsed = parse_loads(loads, mesh, all_sets)
    if any(load.kind == "gravity" for load in parsed):
        density_of(table)  # or it is refused
    return Model(
        mesh, cell_data, all_sets, table, parsed, order, node_young=nodal, gauss_young=at_gauss, about=dict(about or {})
    )


def labels_of(cell_data: dict[str, NDArray], n_cells: int) -> NDArray[np.int64] | None:
    """The field "label", (M,) int64, if it is there and holds whole numbers from 0, as other programs' may not."""
    labels = cell_data.get("label")
    if labels is None or labels.shape != (n_cells,) or not np.isfinite(labels).all():
        return None
    whole = labels.astype(np.int64)
    return whole if (whole == labels).all() and whole.min() >= 0 else None


def _varying_moduli(
    young: Any, mesh: Mesh, image: Image | None, average: str, order: int
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """`node_young`, and moduli at Gauss points, of a law of the intensity; None but where the average has them."""
    law: Any = parse_any_law(young) if isinstance(young, str) else young
    place = parse_average(average).place
    if image is None or not (callable(law) or np.ndim(law) == 2):
        return None, None
    return (
        node_young(image, mesh, law) if place == "nodes" else None,
        element_young(image, mesh, law, average, order) if place == "gauss" and order == 2 else None,
    )


class _Cells(NamedTuple):
    """What laws are of."""

    mesh: Mesh
    image: Image | None
    mean: NDArray[np.float64] | None  # (M,)
    labels: NDArray[np.int64] | None  # (M,)
    names: dict[int, str]  # of labels


def _values(value: Any, name: str, cells: _Cells, average: str = "mean") -> NDArray[np.float64]:
    """The value of each cell, or one for all."""
    law: Any = parse_any_law(value, name) if isinstance(value, str) else value
    if not callable(law) and not isinstance(law, ByLabel) and np.ndim(law) < 2:
        return np.asarray(law, dtype=np.float64)
    if isinstance(law, ByLabel):
        return by_label(law, cells.labels, cells.names)
    if cells.image is not None:  # the law of each voxel, and then the average, as Eq. (2) wants it
        by_voxel = (cells.image, cells.mesh, law)
        return cell_young(*by_voxel, average) if name == "young" else cell_values(*by_voxel)
    if cells.mean is None:
        raise InputError(f"{name}: a law of the intensity, but the mesh has no means; give the image (--image)")
    if name == "young" and average != DEFAULT_AVERAGE:
        raise InputError(f"average: {average} is over the image's voxels; give the image (--image)")
    # The law of each cell's mean: the same only where the law is linear over the cell.
    return young_from(law, cells.mean) if name == "young" else law_values(law, cells.mean)
