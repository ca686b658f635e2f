"""From intensities to Young's moduli.

Eq. (2) wants the *mean of the modulus field* over each cell. A law from intensity to modulus is therefore applied to
the voxels first and the mean taken afterwards (`young_image`, `cell_young`); the law of the mean intensity is another
number wherever the law is curved and the cell is not uniform.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.energy.sampling import cell_of_voxel, nearest_values
from tetopt.errors import InputError
from tetopt.fem.formula import parse_formula
from tetopt.image import Image
from tetopt.mesh import Mesh

Law = Callable[[NDArray[np.float64]], ArrayLike] | Sequence[Sequence[float]] | NDArray[np.floating] | None


def young_from(law: Law, intensities: ArrayLike) -> NDArray[np.float64]:
    """Young's modulus of each intensity, float64 of the same shape, kPa.

    Parameters
    ----------
    law : callable, (K, 2) table or None
        A function of a float64 array; or pairs (intensity, kPa), the intensities strictly increasing, between
        which the modulus is linear and beyond which it keeps the last pair's; or None: the intensity is the
        modulus.
    intensities : array of real numbers

    Raises
    ------
    InputError
        A table that is not of that kind, a function that returns another shape, or a modulus that is negative or
        not finite. A modulus of 0 is let through, as empty space inside a cell; a cell of nothing else is refused
        when the stiffness matrix is built.

    Examples
    --------
    >>> young_from([(0, 1.0), (100, 5.0)], [-10, 50, 100, 300])
    array([1., 3., 5., 5.])
    """
    intensities = np.asarray(intensities, dtype=np.float64)
    if law is None:
        young = intensities.copy()
    elif callable(law):
        young = np.asarray(law(intensities), dtype=np.float64)
        if young.shape != intensities.shape:
            raise InputError(
                f"law: expected a function that returns one modulus for each intensity, got shape {young.shape} "
                f"for shape {intensities.shape}"
            )
    else:
        table = _checked_table(law)
        young = np.interp(intensities, table[:, 0], table[:, 1])
    is_bad = ~(np.isfinite(young) & (young >= 0.0))
    if is_bad.any():
        at, first_of = np.unique(intensities[is_bad], return_index=True)
        pairs = zip(young[is_bad][first_of[:3]], at[:3], strict=True)
        first = ", ".join(f"{modulus:g} at intensity {intensity:g}" for modulus, intensity in pairs)
        raise InputError(
            f"modulus: expected 0 kPa or more, got {int(is_bad.sum())} others, such as {first}; "
            "give a law (--young) that is positive over the image's range"
        )
    return young


def parse_table(text: str) -> list[tuple[float, float]]:
    """Pairs of intensity and modulus as written on a command line, for `young_from`.

    Raises
    ------
    InputError
        The text is something else.

    Examples
    --------
    >>> parse_table("0:1, 100:5.5")
    [(0.0, 1.0), (100.0, 5.5)]
    """
    try:
        pairs = [tuple(float(number) for number in pair.split(":")) for pair in text.split(",")]
    except ValueError:
        pairs = []
    if not pairs or any(len(pair) != 2 for pair in pairs):
        raise InputError(f'modulus: expected pairs intensity:kPa, such as "0:1,100:5.5", got "{text}"')
    return [(pair[0], pair[1]) for pair in pairs]


def parse_law(text: str) -> Law:
    """A law from a command line: a table such as "0:1,100:5.5", or a formula of h, see `parse_formula`.

    Raises
    ------
    InputError
        As `parse_table` and `parse_formula`.
    """
    return parse_table(text) if ":" in text else parse_formula(text)


def young_image(image: Image, law: Law) -> Image:
    """The modulus field: `young_from` of every voxel, kPa, at the image's place in the world.

    It can be meshed in place of the image, so that the cells follow the moduli.

    Raises
    ------
    InputError
        As `young_from`.
    """
    return Image(young_from(law, image.data), image.affine)


def cell_young(image: Image, mesh: Mesh, law: Law = None) -> NDArray[np.float64]:
    """Modulus of each cell, (M,) float64, kPa: the mean of the modulus field over it, Eq. (2).

    A cell without voxel centre gets the modulus at its centroid, see `tetopt.energy.sampling.cell_moments`.

    Raises
    ------
    InputError
        As `young_from` and `tetopt.energy.sampling.cell_of_voxel`.
    """
    field = young_image(image, law)
    # Summed voxel by voxel. `cell_moments` takes differences of sums over rows, whose rounding would drown the soft
    # cells of a field that spans ten orders of magnitude.
    owner = cell_of_voxel(field, mesh).ravel()
    inside = owner >= 0
    n_voxels = np.bincount(owner[inside], minlength=len(mesh.cells))
    total = np.bincount(owner[inside], weights=field.data.ravel()[inside], minlength=len(mesh.cells))
    is_empty = n_voxels == 0
    young = total / np.maximum(n_voxels, 1)
    young[is_empty] = nearest_values(field, mesh.points[mesh.cells[is_empty]].mean(axis=1))
    return young


def inverse_strain(strain: ArrayLike, floor: float) -> NDArray[np.float64]:
    """1 / strain, an approximation of the elastic modulus from a strain map (Section 3), float64.

    It is the modulus in units of the stress, if that were the same everywhere: in kPa under a stress of 1 kPa.

    Parameters
    ----------
    strain : array of real numbers
        Compression and extension alike: the absolute value counts.
    floor : float
        Strains smaller than this, noise among them, count as this one, so the modulus is at most 1 / floor.

    Raises
    ------
    InputError
        A strain that is not finite, or a floor that is not above 0.

    Examples
    --------
    >>> inverse_strain([0.02, -0.01, 0.0], floor=0.001)
    array([  50.,  100., 1000.])
    """
    strain = np.asarray(strain, dtype=np.float64)
    if not (np.isfinite(floor) and floor > 0.0):
        raise InputError(f"floor: expected a strain above 0, such as 0.001, got {floor}")
    if not np.isfinite(strain).all():
        raise InputError(
            f"strain: {int((~np.isfinite(strain)).sum())} values are NaN or infinite; replace them, 0 stands for stiff"
        )
    return 1.0 / np.maximum(np.abs(strain), floor)


def _checked_table(law: ArrayLike) -> NDArray[np.float64]:
    """The (K, 2) table as float64; InputError unless finite and increasing."""
    try:
        table = np.asarray(law, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"law: expected pairs (intensity, kPa), got {law!r}") from error
    if table.ndim != 2 or table.shape[1] != 2 or len(table) == 0:
        raise InputError(f"law: expected pairs (intensity, kPa), got an array of shape {table.shape}")
    if not np.isfinite(table).all():
        raise InputError(f"law: every intensity and modulus must be finite, got {table.tolist()}")
    falls = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
    if len(falls):
        k = int(falls[0])
        raise InputError(
            f"law: intensities must increase, got {table[k, 0]:g} and then {table[k + 1, 0]:g}; "
            "sort the pairs and give each intensity once"
        )
    return table
