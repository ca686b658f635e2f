"""Moduli of cells: means over their voxels.

Eq. (2) wants the *mean of the modulus field* over each cell. A law from intensity to modulus is therefore applied to
the voxels first and the mean taken afterwards; the law of the mean intensity is another number wherever the law is
curved and the cell is not uniform.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.energy.sampling import cell_of_voxel, nearest_values, ranges_of
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.laws import Law, law_values, young_from


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
    return _cell_means(young_image(image, law), mesh)


def cell_values(image: Image, mesh: Mesh, law: Law) -> NDArray[np.float64]:
    """`cell_young` of any quantity, which may be negative, such as Poisson's ratio.

    Raises
    ------
    InputError
        As `law_values` and `tetopt.energy.sampling.cell_of_voxel`; values that are not finite.
    """
    values = law_values(law, image.data)
    if not np.isfinite(values).all():
        at = image.data[~np.isfinite(values)].ravel()[0]
        raise InputError(f"law: it has no value at intensity {at:g}; give one defined over the image's whole range")
    return _cell_means(Image(values, image.affine), mesh)


def _cell_means(field: Image, mesh: Mesh) -> NDArray[np.float64]:
    # Summed voxel by voxel. `cell_moments` takes differences of sums over rows, whose rounding would drown the soft
    # cells of a field that spans ten orders of magnitude.
    owner = cell_of_voxel(field, mesh).ravel()
    inside = owner >= 0
    n_voxels = np.bincount(owner[inside], minlength=len(mesh.cells))
    total = np.bincount(owner[inside], weights=field.data.ravel()[inside], minlength=len(mesh.cells))
    # Within their range, so that a cell of equal values has exactly that value: constants stay one material.
    low, high = ranges_of(owner, field.data.ravel(), len(mesh.cells))
    means = np.clip(total / np.maximum(n_voxels, 1), low, high)
    is_empty = n_voxels == 0
    means[is_empty] = nearest_values(field, mesh.points[mesh.cells[is_empty]].mean(axis=1))
    return means
