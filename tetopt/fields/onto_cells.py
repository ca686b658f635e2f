"""The values of a field on its own voxels in the cells of a mesh.

Each kind is averaged in numbers for which a mean has a meaning: scalars and vectors as they are,
directions by their dyads u u^T, which do not know signs, and tensors by their logarithms, whose
mean is positive (Arsigny et al., Magnetic Resonance in Medicine 56:411, 2006).
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.align import is_in_mask
from tetopt.energy.sampling import cell_of_voxel
from tetopt.errors import InputError
from tetopt.fields.field import COLUMNS, NINE_OF_SIX, ROWS, Field, Kind
from tetopt.geometry.simplex import centroids
from tetopt.image import Image, check_image
from tetopt.mesh import Mesh
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.slabs import over_slabs

LEAST_EIGENVALUE = 1e-3  # of a tensor's largest, chosen: far below tissue's, 0.05 and more
EIGEN_SWEEPS = 8  # at most, of rotations; 4 or 5 are usual
EIGEN_ROUNDING = 1e-20  # of the trace: a smaller rest has no effect on the least eigenvalue
ON_DIAGONAL, OFF_DIAGONAL = ([0, 1, 2], [0, 1, 2]), ([0, 0, 1], [1, 2, 2])  # of 3 x 3 matrices
AVERAGED_AT_ONCE = 1 << 12  # voxels, whose temporary arrays fit into a core's cache


class CellField(NamedTuple):
    """A field's values in the cells of a mesh.

    Parameters
    ----------
    values : (M,), (M, 3) or (M, 9) float64
        Scalars; vectors or unit directions, RAS+; tensors row by row, RAS+.
    coherence : (M,) float64 or None
        Of directions: the mean of the squared cosine between those of a cell's voxels and its own,
        1 where all are parallel, 1/3 where they have no direction in common.
    n_interpolated : int
        Cells without a voxel, interpolated at their centroids.
    n_filled : int
        Cells without data, which have the nearest cell's.
    n_repaired : int
        Tensors of voxels with an eigenvalue that is raised.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> tetopt.cell_field(image, mesh).coherence is None
    True
    """

    values: Floats
    coherence: Floats | None
    n_interpolated: int
    n_filled: int
    n_repaired: int


def cell_field(field: Image | Field, mesh: Mesh, mask: Image | None = None) -> CellField:
    """Average a field over its own voxels in each cell; the inverse of `field_on_image`.

    Each voxel centre belongs to one cell, exactly as in sampling (`cell_of_voxel`); curved cells
    are divided into straight pieces. Scalars and vectors are averaged; a direction is the main
    eigenvector of the mean dyad, its largest component positive; a tensor is the log-Euclidean
    mean, for which eigenvalues below a thousandth of the voxel's largest are raised to that.
    Voxels with NaN or outside the mask have no data, nor have directions of length 0 and tensors
    without a positive eigenvalue.

    Parameters
    ----------
    field : Image or Field
        Scalars, or vectors, directions or tensors, on any grid in the mesh's world.
    mesh : Mesh
        mm.
    mask : Image, optional
        Voxels that have data, on any grid.

    Returns
    -------
    CellField
        A cell without a voxel of the grid has the field interpolated linearly at its centroid,
        between voxels with data; a cell without data has that of the cell whose centroid is
        nearest.

    Raises
    ------
    InputError
        Another dimension than the mesh's; no voxel with data is near a cell; or the reasons of
        `cell_of_voxel` and `resample_mask`.

    See Also
    --------
    load_field : Read vectors, directions and tensors.
    field_on_image : The way back.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> voxels = np.zeros((8, 8, 8, 3)) + [0, 0, -2]
    >>> fibres = tetopt.Field(voxels, np.diag([8, 8, 8, 1]), "direction")
    >>> tetopt.cell_field(fibres, mesh).values[0].tolist()
    [0.0, 0.0, 1.0]
    """
    kind: Kind = field.kind if isinstance(field, Field) else "scalar"
    grid = field.grid if isinstance(field, Field) else check_image("field", field)
    if grid.ndim != mesh.ndim:
        raise InputError(f"field: expected a {mesh.ndim}-D one like the mesh, got {grid.ndim}-D")
    rows = field.data.reshape(grid.data.size, -1)
    is_in = None if mask is None else is_in_mask(mask, grid).ravel()
    pieces, n_pieces = mesh.straight_pieces()
    owner = cell_of_voxel(grid, pieces).ravel() // n_pieces
    voxels = np.flatnonzero(owner >= 0 if is_in is None else (owner >= 0) & is_in)
    features, n_repaired = _features(rows, kind, voxels)
    n_cells = len(mesh.cells)
    means = _means(features, owner[voxels], n_cells)
    del features
    middles = centroids(mesh.points, mesh.cells)
    small = np.flatnonzero(np.bincount(owner[owner >= 0], minlength=n_cells) == 0)
    means[:, small] = _features_at(rows, kind, grid, is_in, middles[small])
    is_known = np.isfinite(means[0])
    if not is_known.any():
        where = "" if mask is None else " in the mask"
        raise InputError(
            f"no voxel with data{where} lies in the mesh; do both use the same world coordinates?"
        )
    filled = np.flatnonzero(~is_known)
    known = np.flatnonzero(is_known)
    if len(filled):
        nearest = scipy.spatial.KDTree(middles[known]).query(middles[filled])[1]
        means[:, filled] = means[:, known[nearest]]
    values, coherence = _values(means, kind)
    return CellField(values, coherence, int(is_known[small].sum()), len(filled), n_repaired)


def field_words(own: CellField) -> str:
    """Return which cells and voxels have no data of their own, for a note; empty if all have."""
    words = {
        "cells without a voxel are interpolated": own.n_interpolated,
        "cells without data take the nearest cell's": own.n_filled,
        "tensors of voxels with an eigenvalue that is hardly positive are repaired": own.n_repaired,
    }
    return "; ".join(f"{count} {what}" for what, count in words.items() if count)


def _features(rows: NDArray, kind: Kind, voxels: Ints) -> tuple[Floats, int]:
    """Return the numbers to average (F, K) of voxels (K,), NaN without data, and how many tensors
    are repaired.

    Voxels are taken in parts of one size, so that results do not depend on the number of threads.
    """
    features = np.empty((rows.shape[1] if kind in ("scalar", "vector") else 6, len(voxels)))
    starts = range(0, len(voxels), AVERAGED_AT_ONCE)

    def fill(first: int, stop: int) -> int:
        n_repaired = 0
        for start in starts[first:stop]:
            part = slice(start, start + AVERAGED_AT_ONCE)
            components = rows[voxels[part]].T.astype(np.float64, order="C")
            components[:, np.isnan(components).any(axis=0)] = np.nan
            if kind == "tensor":
                features[:, part], is_repaired = _logarithms(components)
                n_repaired += int(is_repaired.sum())
            elif kind == "direction":
                with np.errstate(invalid="ignore"):  # 0 has none
                    unit = components / np.sqrt((components**2).sum(axis=0))
                features[:, part] = unit[ROWS] * unit[COLUMNS]
            else:
                features[:, part] = components
        return n_repaired

    return features, sum(over_slabs(fill, len(starts), features.size))


def _means(features: Floats, owner: Ints, n_cells: int) -> Floats:
    """Return the means (F, M) of features (F, K) over the voxels of each cell, NaN without data."""
    if (has_data := np.isfinite(features[0])).all():
        has_data = slice(None)
    own = owner[has_data]
    sums = np.stack([np.bincount(own, each[has_data], n_cells) for each in features])
    with np.errstate(invalid="ignore"):
        return sums / np.bincount(own, minlength=n_cells)


def _features_at(
    rows: NDArray, kind: Kind, grid: Image, is_in: Bools | None, points: Floats
) -> Floats:
    """Return the features (F, K) at world points (K, n), linear between the centres of voxels with
    data; NaN without any around, and outside the grid's box.
    """
    n = grid.ndim
    index = grid.to_index(points)
    is_outside = ((index < -0.5) | (index > np.array(grid.shape) - 0.5)).any(axis=1)
    low = np.floor(index).astype(np.int64)
    sums, weights = 0.0, np.zeros(len(points))
    for corner in product((0, 1), repeat=n):
        at = np.clip(low + corner, 0, np.array(grid.shape) - 1)
        voxels = np.ravel_multi_index(tuple(at.T), grid.shape)
        weight = np.abs(1 - np.array(corner) - (index - low)).prod(axis=1)
        features = _features(rows, kind, voxels)[0]
        weight[np.isnan(features[0]) | is_outside] = 0.0
        if is_in is not None:
            weight[~is_in[voxels]] = 0.0
        sums = sums + np.where(weight > 0.0, features, 0.0) * weight
        weights += weight
    with np.errstate(invalid="ignore"):
        return sums / weights


def _values(means: Floats, kind: Kind) -> tuple[Floats, Floats | None]:
    """Return the values of cells, and the coherence of directions, from means (F, M)."""
    if kind == "scalar":
        return means[0], None
    if kind == "vector":
        return np.ascontiguousarray(means.T), None
    values, vectors = _eigen(means)
    if kind == "tensor":
        return np.ascontiguousarray(_tensors_of(np.exp(values), vectors)[NINE_OF_SIX].T), None
    every = np.arange(means.shape[1])
    main = values.argmax(axis=0)
    unit = vectors[:, main, every]
    signs = np.sign(unit[np.abs(unit).argmax(axis=0), every])
    return np.ascontiguousarray((unit * signs).T), values[main, every]


def _logarithms(components: Floats) -> tuple[Floats, Bools]:
    """Return the logarithms (6, K) of tensors, NaN without a positive eigenvalue, and which have
    an eigenvalue that is raised.
    """
    values, vectors = _eigen(components)
    largest = values.max(axis=0)
    least = LEAST_EIGENVALUE * largest
    is_repaired = (values < least).any(axis=0) & (largest > 0.0)
    values = np.maximum(values, least)
    values[:, ~(largest > 0.0)] = np.nan
    return _tensors_of(np.log(values), vectors), is_repaired


def _tensors_of(values: Floats, vectors: Floats) -> Floats:
    """Return the tensors (6, K) of eigenvalues (3, K) and eigenvectors (3, 3, K), in columns."""
    scaled = vectors * values
    return np.stack(
        [(scaled[i] * vectors[j]).sum(axis=0) for i, j in zip(ROWS, COLUMNS, strict=True)]
    )


def _eigen(components: Floats) -> tuple[Floats, Floats]:
    """Return eigenvalues (3, K) and eigenvectors (3, 3, K), in columns, of tensors (6, K).

    Jacobi's rotations of all at a time take a third of LAPACK's time.
    """
    a = np.zeros((6, 3, components.shape[1]))  # tensors, and below them their eigenvectors
    a[:3] = components[NINE_OF_SIX].reshape(3, 3, -1)
    a[[3, 4, 5], [0, 1, 2]] = 1.0
    for _ in range(EIGEN_SWEEPS):
        size, rest = (np.abs(a[rows]).sum(axis=0) for rows in (ON_DIAGONAL, OFF_DIAGONAL))
        if not (rest > EIGEN_ROUNDING * size).any():
            break
        for p, q in zip(*OFF_DIAGONAL, strict=True):
            twice = 2.0 * a[p, q]
            gap = a[q, q] - a[p, p]
            gap += np.copysign(np.sqrt(gap**2 + twice**2), gap)
            tangent = twice / np.where(gap == 0.0, 1.0, gap)
            cosine = 1.0 / np.sqrt(1.0 + tangent**2)
            sine = tangent * cosine
            for rows in (a.swapaxes(0, 1), a):
                rows[p], rows[q] = (
                    cosine * rows[p] - sine * rows[q],
                    sine * rows[p] + cosine * rows[q],
                )
            a[[p, q], [q, p]] = 0.0
    return a[ON_DIAGONAL], a[3:]
