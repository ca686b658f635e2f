"""The image: a scalar field on voxels with its place in the world."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt import notebook
from tetopt.errors import InputError

SINGULAR_DETERMINANT = 1e-6  # of the axes' directions: with less they do not span the space
# Of a voxel's longest to its shortest extent, shear included: slices of 10 mm with pixels of 0.1 mm have 100. At a
# million the lattice has more cells across one voxel than fit memory.
MOST_ASPECT = 1000.0
LENGTH_RANGE = (1e-9, 1e9)  # mm, of a voxel's edge: their fifth powers, E_G, are far from where doubles end
MOST_OFFSET = 1e9  # voxels from the world's origin: beyond, coordinates have no ten millionth of a voxel left
# Of intensities, and of their range: squares, summed over 2^31 voxels, stay within doubles that have all their digits.
INTENSITY_RANGE = (1e-152, 1e148)


class VoxelGrid:
    """Where voxels lie in the world: what an `Image` shares with images that are read in parts.

    Voxel *centres* sit at the integer indices (the NIfTI convention), so the domain runs from index -0.5 to
    ``shape - 0.5`` along every axis.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> image.ndim, image.spacing.tolist(), round(image.volume)
    (3, [4.0, 4.0, 4.0], 262144)
    """

    affine: NDArray[np.float64]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along each axis."""
        raise NotImplementedError

    @property
    def ndim(self) -> int:
        """Number of axes n, 2 or 3."""
        return len(self.shape)

    @property
    def spacing(self) -> NDArray[np.float64]:
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

    def to_world(self, index: ArrayLike) -> NDArray[np.float64]:
        """World coordinates of index coordinates.

        Parameters
        ----------
        index : (..., n) array
            Voxel centres have whole numbers.

        Returns
        -------
        (..., n) float64
            World mm, RAS+ in 3-D.

        Examples
        --------
        >>> image = tetopt.Image(np.zeros((4, 5, 6)), np.diag([2.0, 2.0, 3.0, 1.0]))
        >>> image.to_world([[0, 0, 1], [-0.5, -0.5, -0.5]])  # a voxel's centre, and the box's corner
        array([[ 0. ,  0. ,  3. ],
               [-1. , -1. , -1.5]])
        """
        return transformed(np.asarray(index, dtype=np.float64), self.affine[:-1, :-1]) + self.affine[:-1, -1]

    def to_index(self, points: ArrayLike) -> NDArray[np.float64]:
        """Index coordinates of world points, the inverse of `to_world`.

        Parameters
        ----------
        points : (..., n) array
            World mm, RAS+ in 3-D.

        Returns
        -------
        (..., n) float64
            Voxel centres have whole numbers.

        Examples
        --------
        >>> image = tetopt.Image(np.zeros((4, 5, 6)), np.diag([2.0, 2.0, 3.0, 1.0]))
        >>> image.to_index([2.0, 4.0, 9.0])
        array([1., 2., 3.])
        """
        shifted = np.asarray(points, dtype=np.float64) - self.affine[:-1, -1]
        return transformed(shifted, np.asarray(np.linalg.inv(self.affine[:-1, :-1]), dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Image(VoxelGrid):
    """Scalar intensities h on a grid of voxels, in two or three dimensions.

    Voxel *centres* sit at the integer indices (the NIfTI convention), so the domain runs from index -0.5 to
    ``shape - 0.5`` along every axis. The affine takes indices to world millimetres, RAS+ in 3-D; it may flip,
    rotate, shear and scale each axis differently.

    Parameters
    ----------
    data : (s_0, ..., s_{n-1}) array of real numbers
        Intensities, n = 2 or 3. Kept as float32 where that loses nothing, else as float64; read-only.
    affine : (n+1, n+1) array, optional
        Index -> world mm, homogeneous. The identity (1 mm voxels) by default. Kept as float64; read-only.

    Raises
    ------
    InputError
        Wrong number of axes, an empty axis, complex, RGB or non-finite data, or an affine that is singular or
        of another size.

    See Also
    --------
    load_image : Read one from a file.

    Examples
    --------
    >>> image = tetopt.Image(np.zeros((4, 5, 6)), np.diag([2.0, 2.0, 3.0, 1.0]))
    >>> image.ndim, image.spacing.tolist(), round(image.voxel_volume, 6)
    (3, [2.0, 2.0, 3.0], 12.0)
    """

    data: NDArray[np.floating]
    affine: NDArray[np.float64]

    def __init__(self, data: ArrayLike, affine: ArrayLike | None = None) -> None:
        data = _checked_data(data)
        affine = checked_affine(np.eye(data.ndim + 1) if affine is None else affine, data.ndim)
        object.__setattr__(self, "data", data)
        object.__setattr__(self, "affine", affine)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along each axis."""
        return self.data.shape

    def __repr__(self) -> str:
        return f"Image({self._size()}, {self.data.dtype}, {self.data.min():.4g} to {self.data.max():.4g})"

    def _size(self) -> str:
        """Number and size of voxels."""
        counts, sides = (" x ".join(f"{each:.4g}" for each in numbers) for numbers in (self.shape, self.spacing))
        return f"{counts} voxels of {sides} mm"

    def _repr_html_(self) -> str:
        """Numbers and the middle slice, for a notebook."""
        low, high, mean = self.data.min(), self.data.max(), self.data.mean(dtype=np.float64)
        rows = [("size", self._size()), ("intensities", f"{low:.4g} to {high:.4g}, mean {mean:.4g}")]
        rows += [("kind", str(self.data.dtype))]
        return notebook.card_html("Image", rows, notebook.slice_html(self.data, self.affine))


def transformed(vectors: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """`matrix` (n, n) times each of the vectors (..., n), term by term in the order of the columns.

    Not by BLAS, whose rounding depends on the number of threads it finds: a mesh must come out the same to the
    last bit on every machine.
    """
    product = vectors[..., :1] * matrix[:, 0]
    for column in range(1, matrix.shape[1]):
        product = product + vectors[..., column : column + 1] * matrix[:, column]
    return product


def _checked_data(data: ArrayLike) -> NDArray[np.floating]:
    """A read-only float32 or float64 C-ordered copy of `data`; InputError for what cannot be an image."""
    try:
        data = np.asarray(data)
    except (TypeError, ValueError) as error:  # rows of different length; nibabel's images
        raise InputError(f"image data: expected an array of numbers, got {type(data).__name__} ({error})") from error
    check_kind(data.dtype)
    if data.ndim not in (2, 3):
        raise InputError(f"image data: expected 2 or 3 axes, got shape {data.shape}; pick one volume or slice")
    if 0 in data.shape:
        raise InputError(f"image data: every axis needs a voxel, got shape {data.shape}")
    is_bad = ~np.isfinite(data)
    if is_bad.any():
        check_finite(int(np.count_nonzero(is_bad)), tuple(int(i) for i in np.argwhere(is_bad)[0]))
    values = _as_lossless_float(data)
    check_intensities(float(values.min()), float(values.max()))
    values.setflags(write=False)
    return values


def check_kind(dtype: np.dtype) -> None:
    """InputError unless the voxels are real numbers."""
    if dtype.names is not None or dtype.kind == "O":
        raise InputError(f"image data: expected one number a voxel, got {dtype}; convert RGB to grey first")
    if dtype.kind == "c":
        raise InputError("image data: expected real numbers, got complex ones; take the magnitude first")
    if dtype.kind not in "buif":
        raise InputError(f"image data: expected numbers, got dtype {dtype}")


def check_finite(n_bad: int, first: tuple[int, ...]) -> None:
    """InputError if there are voxels without a number, the first of them at this index."""
    if n_bad > 0:
        raise InputError(
            f"image data: {n_bad} voxels are NaN or infinite, the first at index {first}; replace them (for example "
            "by the background's value) first"
        )


def check_intensities(low: float, high: float) -> None:
    """InputError for a range of intensities whose squares cannot be computed with."""
    least, most = INTENSITY_RANGE
    if max(abs(low), abs(high)) > most or 0.0 < high - low < least:
        raise InputError(
            f"image data: expected intensities up to {most:g} that differ by {least:g} at least, as their squares "
            f"overflow or vanish, got {low:g} to {high:g}; scale them"
        )


def _as_lossless_float(data: NDArray) -> NDArray[np.floating]:
    """C-ordered copy as float32 if every value survives, else as float64."""
    with np.errstate(over="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        single = np.array(data, dtype=np.float32, order="C")
    if np.array_equal(single, data):
        return single
    return np.array(data, dtype=np.float64, order="C")


def checked_affine(affine: ArrayLike, n: int) -> NDArray[np.float64]:
    """A read-only copy of the affine; InputError unless it is (n+1, n+1), finite, homogeneous and regular."""
    try:
        affine = np.array(affine, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"affine: expected a ({n + 1}, {n + 1}) array of numbers, got {affine!r}") from error
    if affine.shape != (n + 1, n + 1):
        raise InputError(f"affine: expected shape ({n + 1}, {n + 1}) for {n}-D data, got {affine.shape}")
    if not np.isfinite(affine).all():
        raise InputError(f"affine: every entry must be finite, got {affine.tolist()}")
    if not np.array_equal(affine[-1], np.eye(n + 1)[-1]):
        raise InputError(f"affine: the last row must be {np.eye(n + 1)[-1].tolist()}, got {affine[-1].tolist()}")
    columns = affine[:-1, :-1]
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(columns, axis=0)
    if lengths.max() > LENGTH_RANGE[1]:
        raise InputError(f"affine: expected voxels of up to {LENGTH_RANGE[1]:g} mm, got axes {columns.tolist()}")
    if lengths.min() == 0.0 or abs(np.linalg.det(columns / lengths)) < SINGULAR_DETERMINANT:
        raise InputError(
            f"affine: it is singular (voxel axes of lengths {lengths.tolist()} mm do not span {n}-D space); "
            "mend the file's header"
        )
    _check_extents(columns, lengths, affine[:-1, -1])
    affine.setflags(write=False)
    return affine


def _check_extents(columns: NDArray[np.float64], lengths: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
    """InputError unless voxels are of a size, a shape and in a place that can be computed with."""
    least, most = LENGTH_RANGE
    if lengths.min() < least:
        raise InputError(
            f"affine: expected voxels of {least:g} to {most:g} mm, got {lengths.tolist()} mm; mend the file's header"
        )
    extents = np.linalg.svd(columns, compute_uv=False)
    if extents[0] > MOST_ASPECT * extents[-1]:
        raise InputError(
            f"affine: expected voxels at most {MOST_ASPECT:g} times as long as thick, got {extents[0]:.4g} mm by "
            f"{extents[-1]:.4g} mm (edges of {lengths.tolist()} mm); mend the file's header, or resample it"
        )
    if np.abs(origin).max() > MOST_OFFSET * lengths.min():
        raise InputError(
            f"affine: expected the first voxel within {MOST_OFFSET:g} voxels of the world's origin, got "
            f"{origin.tolist()} mm; mend the file's header"
        )
