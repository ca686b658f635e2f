"""The image: a scalar field on voxels with its place in the world."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError
from tetopt.interop import notebook
from tetopt.system.arrays import Floats, plain_array

# determinant of the axes' directions, below which they do not span the space
SINGULAR_DETERMINANT = 1e-6
# Ratio of a voxel's longest to its shortest extent, shear included: slices of 10 mm with pixels of
# 0.1 mm have 100. At a million the lattice has more cells across one voxel than fit into memory.
MOST_ASPECT = 1000.0
# mm, a voxel's edge: fifth powers, as in E_G, stay far within the range of doubles
LENGTH_RANGE = (1e-9, 1e9)
MOST_OFFSET = 1e9  # voxels from the world's origin: beyond, coordinates do not resolve 1e-7 voxel
# Limits for intensities and their range: squares summed over 2^31 voxels stay normal doubles.
INTENSITY_RANGE = (1e-152, 1e148)


@dataclass(frozen=True, eq=False)
class Image:
    """Scalar intensities h on a grid of voxels, in two or three dimensions.

    Voxel *centres* sit at the integer indices (the NIfTI convention), so the domain runs from index
    -0.5 to ``shape - 0.5`` along every axis. The affine maps indices to world millimetres, RAS+ in
    3-D; it may flip, rotate, shear and scale each axis differently.

    Parameters
    ----------
    data : (s_0, ..., s_{n-1}) array of real numbers
        Intensities, n = 2 or 3; NaN where there is no value. Kept as float32 if that is lossless,
        else as float64; read-only.
    affine : (n+1, n+1) array, optional
        Homogeneous map from index to world coordinates in mm, by default the identity (1 mm voxel).
        Float64, read-only.

    Raises
    ------
    InputError
        Wrong number of axes, an empty axis, complex, RGB, masked or infinite data, no value at
        all, or an affine that is singular or has the wrong size.

    See Also
    --------
    load_image : Read an image from a file.

    Examples
    --------
    >>> image = tetopt.Image(np.zeros((4, 5, 6)), np.diag([2.0, 2.0, 3.0, 1.0]))
    >>> image.ndim, image.spacing.tolist(), round(image.voxel_volume, 6)
    (3, [2.0, 2.0, 3.0], 12.0)
    """

    data: NDArray[np.floating]
    affine: Floats

    def __init__(self, data: ArrayLike, affine: ArrayLike | None = None) -> None:
        checked = _check_data(data)
        affine = check_affine(np.eye(checked.ndim + 1) if affine is None else affine, checked.ndim)
        vars(self).update(data=checked, affine=affine)

    def __reduce__(self) -> tuple[Any, ...]:
        """Check and lock the arrays of a copy, or of an unpickled image, again: pickle keeps
        neither.
        """
        return Image, (self.data, self.affine)

    @cached_property
    def range(self) -> tuple[float, float]:
        """The smallest and largest intensity, cached like the next four, as each takes a pass
        over all voxels.
        """
        return _range_of(self.data)

    @cached_property
    def has_gaps(self) -> bool:
        """True if a voxel has no value (NaN)."""
        return bool(np.isnan(self.data.min()))

    @cached_property
    def mean(self) -> float:
        """Mean of the intensities."""
        return float(np.mean(self.data, dtype=np.float64))

    @cached_property
    def variance(self) -> float:
        """Variance of the intensities, divided by the number of voxels."""
        with np.errstate(over="ignore"):
            return float(np.var(self.data, dtype=np.float64))

    @cached_property
    def is_whole(self) -> bool:
        """True if all intensities are whole numbers."""
        return np.array_equal(np.rint(self.data), self.data)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along each axis."""
        return self.data.shape

    @property
    def ndim(self) -> int:
        """Number of axes n, 2 or 3."""
        return len(self.shape)

    @property
    def spacing(self) -> Floats:
        """Length of a voxel's edge along each axis, (n,) float64, mm."""
        return np.sqrt((self.affine[:-1, :-1] ** 2).sum(axis=0))

    @property
    def voxel_volume(self) -> float:
        """Volume of one voxel, mm^n."""
        return float(abs(np.linalg.det(self.affine[:-1, :-1])))

    @property
    def volume(self) -> float:
        """Volume of the domain, index -0.5 to shape - 0.5, mm^n."""
        return self.voxel_volume * prod(self.shape)

    def to_world(self, index: ArrayLike) -> Floats:
        """World coordinates of index coordinates.

        Parameters
        ----------
        index : (..., n) array
            Index coordinates; voxel centres have whole numbers.

        Returns
        -------
        (..., n) float64
            World coordinates in mm, RAS+ in 3-D.

        Examples
        --------
        >>> image = tetopt.Image(np.zeros((4, 5, 6)), np.diag([2.0, 2.0, 3.0, 1.0]))
        >>> image.to_world([[0, 0, 1], [-0.5, -0.5, -0.5]])  # a voxel's centre, the box's corner
        array([[ 0. ,  0. ,  3. ],
               [-1. , -1. , -1.5]])
        """
        return _to_world(self.affine, index)

    def to_index(self, points: ArrayLike) -> Floats:
        """Index coordinates of world points, the inverse of `to_world`.

        Parameters
        ----------
        points : (..., n) array
            World coordinates in mm, RAS+ in 3-D.

        Returns
        -------
        (..., n) float64
            Index coordinates; voxel centres have whole numbers.

        Examples
        --------
        >>> image = tetopt.Image(np.zeros((4, 5, 6)), np.diag([2.0, 2.0, 3.0, 1.0]))
        >>> image.to_index([2.0, 4.0, 9.0])
        array([1., 2., 3.])
        """
        shifted = np.asarray(points, dtype=np.float64) - self.affine[:-1, -1]
        return transform_vectors(
            shifted, np.asarray(np.linalg.inv(self.affine[:-1, :-1]), dtype=np.float64)
        )

    def with_zeros(self) -> Image:
        """Return the image with 0 where it has no value, as a mask or labels have there.

        Returns
        -------
        Image
            The image itself if every voxel has a value.

        Examples
        --------
        >>> tetopt.Image([[1.0, np.nan]]).with_zeros().data.tolist()
        [[1.0, 0.0]]
        """
        return Image(np.nan_to_num(self.data), self.affine) if self.has_gaps else self

    def box(self, start: Sequence[int], stop: Sequence[int]) -> Image:
        """Return a box of indices as an image; every voxel keeps its place in the world.

        Parameters
        ----------
        start, stop : (n,) sequences of int
            The first index of the box along each axis, and the one after its last.

        Returns
        -------
        Image
            The box.

        Examples
        --------
        >>> image = tetopt.Image(np.arange(64).reshape(4, 4, 4))
        >>> corner = image.box((2, 2, 2), (4, 4, 4))
        >>> corner.to_world([0, 0, 0]).tolist() == image.to_world([2, 2, 2]).tolist()
        True
        """
        affine = shifted_affine(self.affine, start)
        return Image(self.data[tuple(map(slice, start, stop))], affine)

    def __repr__(self) -> str:
        values = f"{self.range[0]:.4g} to {self.range[1]:.4g}"
        return f"Image({self._size()}, {self.data.dtype}, {values})"

    def _size(self) -> str:
        """Number and size of voxels."""
        counts, sides = (
            " x ".join(f"{each:.4g}" for each in numbers) for numbers in (self.shape, self.spacing)
        )
        return f"{counts} voxels of {sides} mm"

    def _repr_html_(self) -> str:
        """Numbers and the middle slice, for a notebook."""
        values = f"{self.range[0]:.4g} to {self.range[1]:.4g}, mean {self.mean:.4g}"
        rows = [
            ("size", self._size()),
            ("intensities", values),
            ("kind", str(self.data.dtype)),
        ]
        return notebook.card_html("Image", rows, notebook.slice_html(self.data, self.affine))


def transform_vectors(vectors: Floats, matrix: NDArray[np.floating]) -> Floats:
    """Multiply each of the vectors (..., n) by `matrix` (n, n), term by term in the order of the
    columns.

    BLAS is not used, as its rounding depends on the number of threads: a mesh must be the same to
    the last bit on every machine.
    """
    product = vectors[..., :1] * matrix[:, 0]
    for column in range(1, matrix.shape[1]):
        product = product + vectors[..., column : column + 1] * matrix[:, column]
    return product


def _to_world(affine: Floats, index: ArrayLike) -> Floats:
    return (
        transform_vectors(np.asarray(index, dtype=np.float64), affine[:-1, :-1]) + affine[:-1, -1]
    )


def shifted_affine(affine: Floats, start: Sequence[int]) -> Floats:
    """Return the affine of the voxels from index `start` on."""
    shifted = affine.copy()
    shifted[:-1, -1] = _to_world(affine, start)
    return shifted


def check_image(what: str, image: Any) -> Image:
    """Return an image; TypeError for anything else."""
    if not isinstance(image, Image):
        raise TypeError(
            f"{what}: expected Image, got {type(image).__name__}; use tetopt.load_image(path) or "
            "tetopt.Image(array, affine)"
        )
    return image


def _check_data(data: ArrayLike) -> NDArray[np.floating]:
    """Return a read-only float32 or float64 C-ordered copy of `data`; raise InputError if it
    cannot be an image.
    """
    try:
        data = plain_array("image data", data)
    except InputError:
        raise
    except (TypeError, ValueError) as error:  # rows of different lengths, or a nibabel image
        raise InputError(
            f"image data: expected an array of numbers, got {type(data).__name__} ({error})"
        ) from error
    check_kind(data.dtype)
    if data.ndim not in (2, 3):
        raise InputError(
            f"image data: expected 2 or 3 axes, got shape {data.shape}; select one volume or slice"
        )
    if 0 in data.shape:
        raise InputError(
            f"image data: expected at least one voxel along every axis, got shape {data.shape}"
        )
    is_bad = np.isinf(data)
    if is_bad.any():
        first = tuple(int(i) for i in np.argwhere(is_bad)[0])
        raise InputError(
            f"image data: {np.count_nonzero(is_bad)} voxels are infinite, the first at "
            f"index {first}; replace them first, for example with the background's value"
        )
    values = _as_lossless_float(data)
    if np.isnan(values).all():
        raise InputError("image data: expected a value in some voxel, got NaN in all")
    check_intensities(*_range_of(values))
    values.setflags(write=False)
    return values


def _range_of(values: NDArray[np.floating]) -> tuple[float, float]:
    return float(np.fmin.reduce(values, axis=None)), float(np.fmax.reduce(values, axis=None))


def check_kind(dtype: np.dtype) -> None:
    """Raise InputError unless the voxels are real numbers."""
    if dtype.names is not None or dtype.kind == "O":
        raise InputError(
            f"image data: expected one number per voxel, got {dtype}; convert RGB to grey first"
        )
    if dtype.kind not in "buif":
        raise InputError(f"image data: expected real numbers, got dtype {dtype}")


def check_intensities(low: float, high: float) -> None:
    """Raise InputError for a range of intensities whose squares overflow or vanish."""
    least, most = INTENSITY_RANGE
    if max(abs(low), abs(high)) > most or 0.0 < high - low < least:
        raise InputError(
            f"image data: expected intensities up to {most:g} that differ by at least {least:g}, "
            "as "
            f"squares would overflow or vanish otherwise, got {low:g} to {high:g}; rescale them"
        )


def _as_lossless_float(data: NDArray) -> NDArray[np.floating]:
    """C-ordered copy as float32 if that is lossless, else as float64."""
    with np.errstate(over="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        single = np.array(data, dtype=np.float32, order="C")
    if np.array_equal(single, data) or np.array_equal(single, data, equal_nan=True):
        return single
    return np.array(data, dtype=np.float64, order="C")


def check_affine(affine: ArrayLike, n: int) -> Floats:
    """Return a read-only copy of the affine; raise InputError unless it is (n+1, n+1), finite,
    homogeneous, regular.
    """
    try:
        affine = np.array(plain_array("affine", affine), dtype=np.float64)
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(
            f"affine: expected a ({n + 1}, {n + 1}) array of numbers, got {affine!r}"
        ) from error
    if affine.shape != (n + 1, n + 1):
        raise InputError(
            f"affine: expected shape ({n + 1}, {n + 1}) for {n}-D data, got {affine.shape}"
        )
    if not np.isfinite(affine).all():
        raise InputError(f"affine: expected finite entries, got {affine.tolist()}")
    if not np.array_equal(affine[-1], np.eye(n + 1)[-1]):
        raise InputError(
            f"affine: expected the last row {np.eye(n + 1)[-1].tolist()}, got {affine[-1].tolist()}"
        )
    columns = affine[:-1, :-1]
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(columns, axis=0)
    if lengths.max() > LENGTH_RANGE[1]:
        raise InputError(
            f"affine: expected voxels of up to {LENGTH_RANGE[1]:g} mm, got axes {columns.tolist()}"
        )
    if lengths.min() == 0.0 or abs(np.linalg.det(columns / lengths)) < SINGULAR_DETERMINANT:
        raise InputError(
            f"affine: it is singular (voxel axes of lengths {lengths.tolist()} mm do not span "
            f"{n}-D space); "
            "correct the file's header"
        )
    _check_extents(columns, lengths, affine[:-1, -1])
    affine.setflags(write=False)
    return affine


def _check_extents(columns: Floats, lengths: Floats, origin: Floats) -> None:
    """Raise InputError unless the size, shape and position of voxels are within the limits."""
    least, most = LENGTH_RANGE
    if lengths.min() < least:
        raise InputError(
            f"affine: expected voxels of {least:g} to {most:g} mm, got {lengths.tolist()} mm; "
            "correct the file's header"
        )
    extents = np.linalg.svd(columns, compute_uv=False)
    if extents[0] > MOST_ASPECT * extents[-1]:
        raise InputError(
            f"affine: expected voxels at most {MOST_ASPECT:g} times as long as thick, got "
            f"{extents[0]:.4g} mm by "
            f"{extents[-1]:.4g} mm (edges of {lengths.tolist()} mm); correct the file's header, "
            "or resample the image"
        )
    if np.abs(origin).max() > MOST_OFFSET * lengths.min():
        raise InputError(
            f"affine: expected the first voxel within {MOST_OFFSET:g} voxels of the world's "
            "origin, got "
            f"{origin.tolist()} mm; correct the file's header"
        )
