"""Materials: Young's modulus and Poisson's ratio of each cell, and their grouping into fewer
materials.

Isotropic linear elasticity at the undeformed state, which one modulus per cell, Eq. (2), describes.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.energy.sampling import ranges_of
from tetopt.errors import InputError, Remark, warn
from tetopt.model.label_names import label_words, labels_named
from tetopt.model.mappings import ByLabel, check_cells, check_nu, check_young
from tetopt.model.sets import Names
from tetopt.system.arrays import Arrays, Floats, Ints

# Poisson's ratio of soft tissue that linear cells still represent: they lock closer to 0.5
DEFAULT_NU = 0.45
LABELS_LISTED = 8  # of labels without cells, in a message
Spacing = Literal["equal", "quantile", "log"]
SPACINGS = get_args(Spacing)


class BinningError(NamedTuple):
    """The error of the bins' moduli, relative to the moduli of cells.

    Parameters
    ----------
    mean : float
        The mean, weighted by volume.
    largest : float
        The maximum over all cells.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> error = tetopt.build_model(mesh, image, young="0.1*h", bins=3).materials.binning
    >>> error.mean < error.largest
    True
    """

    mean: float
    largest: float


class Materials(NamedTuple):
    """The distinct materials, softest first, and the material of each cell.

    Parameters
    ----------
    young : (K,) float64
        Young's modulus, in the model's unit of stress.
    nu : (K,) float64
        Poisson's ratio.
    of_cell : (M,) int64
        The material of each cell, 0 to K - 1.
    binning : BinningError, optional
        The error of the moduli, if they were grouped into bins.
    density : (K,) float64, optional
        kg/m3 in all systems of units.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> table = tetopt.build_model(mesh, image, young="0.1*h", bins=3).materials
    >>> table.young.round(1).tolist(), table.of_cell.shape, f"{table.binning.mean:.1%}"
    ([2.1, 6.1, 9.5], (1200,), '6.8%')
    """

    young: Floats
    nu: Floats
    of_cell: Ints
    binning: BinningError | None = None
    density: Floats | None = None

    def fields(self) -> Arrays:
        """Values of each cell, as files have them.

        Returns
        -------
        dict of (M,) arrays
            `young`, `nu`, `material`, counted from 1, and, if known, `density`.

        Examples
        --------
        >>> sorted(materials(3.0, 0.45, 10).fields())
        ['material', 'nu', 'young']
        """
        fields: Arrays = {"young": self.young[self.of_cell], "nu": self.nu[self.of_cell]}
        fields["material"] = self.of_cell + 1
        if self.density is not None:
            fields["density"] = self.density[self.of_cell]
        return fields


def materials(
    young: ArrayLike, nu: ArrayLike, n_cells: int, density: ArrayLike | None = None
) -> Materials:
    """Group cells of equal modulus, ratio and density into materials.

    Parameters
    ----------
    young, nu : (M,) arrays, or one number for all
        Above 0; above -1 and below 0.5.
    n_cells : int
    density : (M,) array, or one number for all, optional
        kg/m3, above 0.

    Raises
    ------
    InputError
        Values are out of range, or their number is not that of the cells.
    """
    columns = [_of_cells("young", young, n_cells), _of_cells("nu", nu, n_cells)]
    check_young(columns[0])
    check_nu(columns[1])
    if density is not None:
        masses = _of_cells("density", density, n_cells)
        columns.append(
            check_cells("density", masses, masses > 0.0, "kg/m3 above 0", "water has 1000")
        )
    kinds, of_cell = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
    columns = [column.copy() for column in kinds.T]
    of_cell = of_cell.ravel().astype(np.int64)
    return Materials(columns[0], columns[1], of_cell, None, *columns[2:])


def without_moduli(table: Materials) -> Materials:
    """Return materials by ratio and density only; their moduli are 1."""
    density = None if table.density is None else table.density[table.of_cell]
    return materials(1.0, table.nu[table.of_cell], len(table.of_cell), density)


def density_of(table: Materials | None) -> Floats:
    """Return the density of each material, (K,) kg/m3; InputError if there is none, because
    gravity needs it.
    """
    if table is None or table.density is None:
        raise InputError(
            "gravity: the cells have no density; give `density` in kg/m3, such as 1000"
        )
    return table.density


def _of_cells(name: str, values: ArrayLike, n_cells: int) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return np.full(n_cells, float(array))
    if array.shape != (n_cells,):
        raise InputError(
            f"{name}: expected one value for each of {n_cells} cells, got shape {array.shape}"
        )
    return array


def cells_of(table: Materials) -> list[Ints]:
    """Return the cells of each material, ascending."""
    ends = np.cumsum(np.bincount(table.of_cell, minlength=len(table.young)))
    return np.split(np.argsort(table.of_cell, kind="stable"), ends[:-1])


def by_label(
    mapping: ByLabel, labels: NDArray[np.integer] | None, names: Names | None = None
) -> Floats:
    """Return the value of each cell by its label, (M,) float64.

    Parameters
    ----------
    mapping : ByLabel
        A name in it refers to all labels with that name (`tetopt.model.label_names.labels_named`).
    labels : (M,) integers or None
    names : mapping of label to text, optional

    Raises
    ------
    InputError
        There are no labels; a label has no value or two; no label has a given name.
    """
    if labels is None:
        raise InputError("values by label: the mesh has no labels; give the label image (`labels`)")
    names = names or {}
    values: dict[int, float] = {}
    for key, value in mapping.values.items():
        for label in [key] if isinstance(key, int) else labels_named(key, names):
            if label in values:
                raise InputError(
                    f"values by label: label {label_words(label, names)} has two values; give "
                    "only one"
                )
            values[label] = value
    kinds, which = np.unique(labels, return_inverse=True)
    if unused := [label_words(label, names) for label in values if label not in kinds]:
        few, own = (", ".join(map(str, each[:LABELS_LISTED])) for each in (unused, kinds))
        text = (
            f"values by label: no cell has label {few} ({len(unused)} of {len(values)}); the "
            f"mesh has {own}"
        )
        warn(text, Remark)
    missing = [label_words(label, names) for label in kinds.tolist() if label not in values]
    if missing and mapping.rest is None:
        raise InputError(
            f"values by label: got {', '.join(map(str, mapping.values))}, but the mesh also has "
            f"{', '.join(missing)} "
            f"({len(missing)} more); give values for these, or *=VALUE for all others"
        )
    return np.array(
        [values.get(label, mapping.rest) for label in kinds.tolist()], dtype=np.float64
    )[which.ravel()]


def bin_moduli(
    exact: Materials, volumes: Floats, count: int, spacing: Spacing = "equal"
) -> Materials:
    """Group moduli into at most `count` bins.

    The modulus of a bin is the mean over its cells, weighted by volume. Ratios and densities are
    unchanged if there are at most `count` of them; otherwise they are binned in the same way. A
    material is a combination of bins.

    Parameters
    ----------
    exact : Materials
    volumes : (M,) float64
        Volumes of the cells.
    count : int
    spacing : {"equal", "quantile", "log"}
        Bins of equal width; with equal numbers of cells; of equal width in the logarithm.

    Raises
    ------
    InputError
        `count` is below 1, or `spacing` is unknown.
    """
    if count < 1:
        raise InputError(f"bins: expected 1 or more, got {count}")
    if spacing not in SPACINGS:
        raise InputError(f"bins: expected {', '.join(SPACINGS)}, got {spacing}")
    young = exact.young[exact.of_cell]
    nu = exact.nu[exact.of_cell]
    fewer = _bin_means(young, volumes, count, spacing)
    linear: Spacing = "quantile" if spacing == "quantile" else "equal"
    ratios = _bin_means(nu, volumes, count, linear)
    density = (
        None
        if exact.density is None
        else _bin_means(exact.density[exact.of_cell], volumes, count, linear)
    )
    off = np.abs(fewer - young) / young
    error = BinningError(float((off * volumes).sum() / volumes.sum()), float(off.max()))
    return materials(fewer, ratios, len(young), density)._replace(binning=error)


def _bin_means(values: Floats, volumes: Floats, count: int, spacing: Spacing) -> Floats:
    """Replace each value by the mean of its bin; up to `count` distinct values are unchanged."""
    if len(np.unique(values)) <= count:
        return values
    scaled = np.log(values) if spacing == "log" else values
    if spacing == "quantile":
        inner = np.quantile(scaled, np.arange(1, count) / count)
    else:
        inner = np.linspace(scaled.min(), scaled.max(), count + 1)[1:-1]
    which = np.searchsorted(inner, scaled, side="right")
    sizes = np.bincount(which, weights=volumes, minlength=count)
    total = np.bincount(which, weights=volumes * values, minlength=count)
    # Rounding may move a mean slightly out of its bin where all values are equal.
    low, high = ranges_of(which, values, count)
    with np.errstate(invalid="ignore"):  # bins without cells
        return np.clip(total / sizes, low, high)[which]
