"""The discretization energy E_D, Eq. (3), and the combined energy E, Eq. (4)."""

from __future__ import annotations

import numpy as np

from tetopt.contents.content import Content
from tetopt.energy.sampling import (
    cell_moments,
    channel_grid,
    check_orientations,
    moment_sums,
    to_ticks,
)
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.arrays import Floats


def cell_E_D(image: Image, mesh: Mesh) -> Floats:
    """Each cell's contribution to E_D, (M,) float64, intensity^2 mm^n.

    E_D = sum_j integral over cell j of (h - hbar_j)^2, with h constant on a voxel, each voxel
    counted whole in the cell that contains its centre, and hbar_j the cell's mean. So E_D lies
    between 0 and the image's variance times its volume, the value of a single cell around
    everything. Cells without a voxel centre have 0.

    Raises
    ------
    InputError
        As for `tetopt.energy.sampling.cell_moments`.
    """
    moments = cell_moments(image, mesh)
    return moments.n_voxels * moments.variance * image.voxel_volume


def E_D(image: Image, mesh: Mesh) -> float:
    """The discretization energy of equation (3), intensity^2 mm^n.

    The sum over cells of the integral of (h - hbar)^2, where hbar is the mean of h over the cell. h
    is constant on a voxel, and each voxel counts fully in the cell that contains its centre. E_D
    lies between 0 and the image's variance times its volume.

    Parameters
    ----------
    image : Image
        The intensities h, with the dimension of the mesh.
    mesh : Mesh
        Points in world coordinates, mm; curved edges count as straight.

    Returns
    -------
    float
        intensity^2 mm^n.

    Raises
    ------
    InputError
        As for `cell_moments`.

    See Also
    --------
    cell_moments : Compute the mean and variance of each cell.
    E_G : Compute the energy of the cells' shapes.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> whole = float(image.data.var()) * image.volume  # the value of a single cell
    >>> print(f"{tetopt.E_D(image, mesh) / whole:.2f}")
    0.07
    >>> graded = tetopt.mesh_image(image, 300, iterations=4).mesh
    >>> print(f"{tetopt.E_D(image, graded) / whole:.3f}")
    0.003
    """
    return float(cell_E_D(image, mesh).sum())


def unexplained_variance(content: Content, mesh: Mesh) -> float | None:
    """Return the unexplained variance: the fraction of the variance of the voxels in cells that is
    left within cells.

    It is over all channels, from 0 to 1. Unlike E_D it has no penalty for voxels on the wrong side
    of a mask's surface. None if these voxels are equal, or if there are none.

    Raises
    ------
    InputError
        As for `tetopt.energy.sampling.cell_moments`.
    """
    sums, within = _channel_sums(content, mesh)
    count = np.maximum(sums[:, :1], 1.0)
    means = sums[:, _columns(content)] / count
    weights = np.where(sums[:, :1] > 0.0, count, 0.0)
    middle = (weights * means).sum(axis=0) / max(float(weights.sum()), 1.0)
    between = float((weights * (means - middle) ** 2).sum())
    left = float(within.sum())
    return left / (left + between) if left + between > 0.0 else None


def _columns(content: Content) -> list[int]:
    """Return the columns of `moment_sums` with the sums of the channels' values."""
    return [1, *range(3, 2 + content.n_channels)]


def _channel_sums(content: Content, mesh: Mesh) -> tuple[Floats, Floats]:
    """Return the sums over each cell (M, D), see `moment_sums`, and its sum of squares about its
    means (M,).
    """
    grid = channel_grid(content, mesh.points)
    ticks = to_ticks(content.image.to_index(mesh.points), grid)
    check_orientations(content.image, ticks, mesh.cells)
    sums = moment_sums(grid, ticks, mesh.cells)
    squares = sums[:, 2] - (sums[:, _columns(content)] ** 2).sum(axis=1) / np.maximum(
        sums[:, 0], 1.0
    )
    return sums, np.where(sums[:, 0] > 0.0, np.maximum(squares, 0.0), 0.0)


def content_E_D(content: Content, mesh: Mesh) -> tuple[float, int]:
    """E_D of a mesh over all channels of a content, intensity^2 mm^n, and the number of voxels in
    its cells.

    A run's history records this value: with a mask, each voxel on the wrong side of its surface
    adds `Content.wrong_side`.

    Raises
    ------
    InputError
        As for `tetopt.energy.sampling.cell_moments`.
    """
    sums, within = _channel_sums(content, mesh)
    squares = float(within.sum())
    if content.region is not None:  # the last column: voxels outside minus voxels inside
        squares += content.wrong_side * (content.n_voxels + int(sums[:, -1].sum()))
    return squares * content.unit * content.image.voxel_volume, int(sums[:, 0].sum())


def combine_energies(E_G: float, E_D: float, E_G0: float, E_D0: float, k_D: float) -> float:
    """E = (1 - k_D) E_G / E_G0 + k_D E_D / E_D0, Eq. (4) normalised by the initial mesh as in
    Section 4.

    On a constant image E_D0 = 0; the second term is then 0.
    """
    return (1.0 - k_D) * E_G / E_G0 + (k_D * E_D / E_D0 if E_D0 > 0.0 else 0.0)
