"""Materials: Young's modulus and Poisson's ratio of each cell, and their grouping into fewer
materials.

Linear elasticity at the undeformed state: isotropic, which one modulus per cell, Eq. (2),
describes, or transversely isotropic about a direction, the fibres. Then `young` (E) and `nu` hold
across the fibres, `young_along` (E_a) and `shear_along` (G_a) along them, and `nu` is also the
ratio of the strain across to that along under tension along them. In the fibres' axes, the first
along them, the strains are

    e_1 = s_1 / E_a - nu (s_2 + s_3) / E_a,   2 e_12 = s_12 / G_a,
    e_2 = s_2 / E - nu s_3 / E - nu s_1 / E_a,   2 e_23 = s_23 2 (1 + nu) / E.
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
UNIT_ROUNDING = 4.0 * np.finfo(np.float64).eps  # of the length of a unit vector
Spacing = Literal["equal", "quantile", "log"]
SPACINGS = get_args(Spacing)


class BinningError(NamedTuple):
    """The error of bins: of moduli, relative to those of cells, or of fibres, in degrees.

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


class Along(NamedTuple):
    """The fibres of materials, or of each cell; across them are the isotropic constants.

    Parameters
    ----------
    young_along, shear_along : (K,) or (M,) float64
        Young's modulus along fibres, and the shear modulus between them and the directions across,
        in the unit of those across.
    fibre : (M, 3) float64
        Unit vector along the fibres of each cell; 0 in isotropic cells.

    Examples
    --------
    >>> mesh = tetopt.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    >>> model = tetopt.build_model(mesh, young=3, fibre=[[0, 0, 2]], young_along=9)
    >>> model.materials.along.fibre.tolist()
    [[0.0, 0.0, 1.0]]
    """

    young_along: Floats
    shear_along: Floats
    fibre: Floats


ALONG_FIELDS = Along._fields  # cell data in tetopt's files


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
    along : Along, optional
        Fibres, across which `young` and `nu` then hold.
    fibre_binning : BinningError, optional
        The error of directions, if they were grouped.

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
    along: Along | None = None
    fibre_binning: BinningError | None = None

    def fields(self) -> Arrays:
        """Values of each cell, as files have them.

        Returns
        -------
        dict of (M,) arrays
            `young`, `nu`, `material`, counted from 1, and, if known, `density`; with fibres
            `young_along`, `shear_along` and `fibre`, (M, 3).

        Examples
        --------
        >>> sorted(materials(3.0, 0.45, 10).fields())
        ['material', 'nu', 'young']
        """
        fields: Arrays = {"young": self.young[self.of_cell], "nu": self.nu[self.of_cell]}
        fields["material"] = self.of_cell + 1
        if self.density is not None:
            fields["density"] = self.density[self.of_cell]
        return fields if (along := along_of(self)) is None else fields | along._asdict()


def along_of(table: Materials) -> Along | None:
    """Return the fibres of each cell; None without fibres."""
    if (of := table.along) is None:
        return None
    return Along(of.young_along[table.of_cell], of.shear_along[table.of_cell], of.fibre)


def unit_directions(vectors: ArrayLike) -> Floats:
    """Return vectors (M, 3) of length 1; 0 for those of length 0, or with NaN."""
    vectors = np.asarray(vectors, dtype=np.float64)
    length = np.sqrt((vectors**2).sum(axis=1, keepdims=True))
    is_vector = np.isfinite(length) & (length > 0.0)
    # so that directions that are read back stay as they are
    is_scaled = is_vector & (np.abs(length - 1.0) > UNIT_ROUNDING)
    return np.where(is_vector, vectors, 0.0) / np.where(is_scaled, length, 1.0)


def is_fibrous(table: Materials, members: Ints) -> bool:
    """Return whether any of some cells has fibres."""
    return table.along is not None and bool(table.along.fibre[members].any())


def engineering_constants(table: Materials) -> dict[str, Floats]:
    """Return constants of the materials, (K,), in the fibres' axes, of which the first is along
    them: moduli E1 and E2 = E3, G12 = G31 and G23; ratios v = v12 = v13 = v23 and v31; none
    without fibres.
    """
    if (along := table.along) is None:
        return {}
    return {
        "E1": along.young_along,
        "E2": table.young,
        "v": table.nu,
        "v31": table.nu * (table.young / along.young_along),
        "G12": along.shear_along,
        "G23": table.young / (2.0 * (1.0 + table.nu)),
    }


def axes_across(fibre: Floats) -> Floats:
    """Return a second axis for each direction, (M, 3): that of the world with the least part along
    it; not perpendicular to it.
    """
    return np.eye(3)[np.abs(fibre).argmin(axis=1)]


def materials(
    young: ArrayLike,
    nu: ArrayLike,
    n_cells: int,
    density: ArrayLike | None = None,
    along: Along | None = None,
) -> Materials:
    """Group cells of equal moduli, ratio and density into materials.

    Parameters
    ----------
    young, nu : (M,) arrays, or one number for all
        Above 0; above -1 and below 0.5.
    n_cells : int
    density : (M,) array, or one number for all, optional
        kg/m3, above 0.
    along : Along, optional
        See `check_along`.

    Raises
    ------
    InputError
        Values are out of range, or their number is not that of the cells; no material has such
        moduli.
    """
    columns = [_of_cells("young", young, n_cells), _of_cells("nu", nu, n_cells)]
    check_young(columns[0])
    check_nu(columns[1])
    if density is not None:
        masses = _of_cells("density", density, n_cells)
        columns.append(
            check_cells("density", masses, masses > 0.0, "kg/m3 above 0", "water has 1000")
        )
    if along is not None:
        along = check_along(along, columns[0], columns[1])
        columns += along[:2]
    kinds, of_cell = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
    columns = [column.copy() for column in kinds.T]
    of_cell = of_cell.ravel().astype(np.int64)
    along = None if along is None else Along(columns[-2], columns[-1], along.fibre)
    mass = None if density is None else columns[2]
    return Materials(columns[0], columns[1], of_cell, None, mass, along)


def check_along(along: Along, young: Floats, nu: Floats) -> Along:
    """Return the fibres of cells, with unit vectors and, in cells whose direction is 0 or NaN, the
    isotropic moduli of `young` and `nu`, (M,).

    Raises
    ------
    InputError
        Another number of moduli or directions; a modulus that is not above 0; an elasticity tensor
        that is not positive definite; no cell has a direction.
    """
    n_cells = len(young)
    if np.shape(along.fibre) != (n_cells, 3):
        raise InputError(
            f"fibre: expected three numbers for each of {n_cells} tetrahedra, got shape "
            f"{np.shape(along.fibre)}"
        )
    fibre = unit_directions(along.fibre)
    is_along = fibre.any(axis=1)
    if not is_along.any():
        raise InputError("fibre: expected directions, got only 0 or NaN")
    stiff, shear = (
        np.where(is_along, _of_cells(name, own, n_cells), isotropic)
        for name, own, isotropic in zip(
            ALONG_FIELDS, along, (young, young / (2.0 * (1.0 + nu))), strict=False
        )
    )
    least = 2.0 * nu**2 * young / (1.0 - nu)
    expected = f"moduli above 2 nu^2 young / (1 - nu), up to {least.max():.4g} kPa here"
    hint = "otherwise the elasticity tensor is not positive definite"
    check_cells("young_along", stiff, stiff > least, expected, hint)
    check_cells("shear_along", shear, shear > 0.0, "moduli above 0 kPa", hint)
    return Along(stiff, shear, fibre)


def without_moduli(table: Materials) -> Materials:
    """Return materials by ratio and density only, without fibres; their moduli are 1."""
    density = None if table.density is None else table.density[table.of_cell]
    return materials(1.0, table.nu[table.of_cell], len(table.of_cell), density)


def scale_moduli(table: Materials, factor: float) -> Materials:
    """Return the materials with all moduli multiplied, for another unit."""
    if (along := table.along) is not None:
        along = Along(along.young_along * factor, along.shear_along * factor, along.fibre)
    return table._replace(young=table.young * factor, along=along)


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
    unchanged if there are at most `count` of them; otherwise they are binned in the same way, as
    are moduli along fibres, and directions become those of at most `count` groups
    (`group_directions`). A material is a combination of bins.

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
    along = along_of(exact)
    of_fibres = None
    if along is not None:
        moduli = [_bin_means(each, volumes, count, spacing) for each in along[:2]]
        for new, old in zip(moduli, along[:2], strict=True):
            off = np.maximum(off, np.abs(new - old) / old)
        fibre, angle = group_directions(along.fibre, count)
        along = Along(moduli[0], moduli[1], fibre)
        of_fibres = BinningError(float((angle * volumes).sum() / volumes.sum()), float(angle.max()))
    error = BinningError(float((off * volumes).sum() / volumes.sum()), float(off.max()))
    binned = materials(fewer, ratios, len(young), density, along)
    return binned._replace(binning=error, fibre_binning=of_fibres)


def group_directions(fibre: Floats, count: int) -> tuple[Floats, Floats]:
    """Return directions (M, 3) of at most `count` groups, and the angle of each cell to its own,
    (M,) degrees; signs do not matter, and cells without a direction keep none.

    A group has the direction that is farthest from those of all groups before: the largest angle is
    at most twice the least possible (T.F. Gonzalez, Theoretical Computer Science 38, 1985,
    293-306), whereas groups of least mean angle turned single cells by 58 degrees.
    """
    is_along = fibre.any(axis=1)
    own = fibre[is_along]
    nearest, cosine = own, np.full(len(own), -1.0)
    for _ in range(count if len(own) else 0):
        axis = own[cosine.argmin()]
        towards = np.abs((own * axis).sum(axis=1))  # not by BLAS, which rounds by threads
        nearest = np.where((towards > cosine)[:, None], axis, nearest)
        cosine = np.maximum(cosine, towards)
        if cosine.min() > 1.0 - UNIT_ROUNDING:
            break
    sign = np.where((own * nearest).sum(axis=1) < 0.0, -1.0, 1.0)
    chord = np.sqrt(((own - sign[:, None] * nearest) ** 2).sum(axis=1))
    grouped, angle = fibre.copy(), np.zeros(len(fibre))
    grouped[is_along], angle[is_along] = nearest, np.degrees(2.0 * np.arcsin(0.5 * chord))
    return grouped, angle


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
