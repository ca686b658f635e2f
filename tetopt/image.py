"""The image: a scalar field on voxels with its place in the world, in memory or stored."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError
from tetopt.interop import notebook
from tetopt.system.budget import check_memory
from tetopt.system.public import unmasked

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
READ_BYTES = 2**28  # most of a stored volume read at a time: 128 planes of 1024^2 voxels of 16 bits
# processed at a time: half a megabyte per field, which fits into a processor's cache
PIECE_VOXELS = 2**16
LOADED_BYTES = 16.0  # per voxel while all are read: as stored, and as floats of either size

Box = tuple[slice, slice, slice]


@dataclass(frozen=True, eq=False)
class Image:
    """Scalar intensities h on a grid of voxels, in two or three dimensions.

    Voxel *centres* sit at the integer indices (the NIfTI convention), so the domain runs from index
    -0.5 to ``shape - 0.5`` along every axis. The affine maps indices to world millimetres, RAS+ in
    3-D; it may flip, rotate, shear and scale each axis differently. The voxels are in memory, or
    stay in their file (`Image.stored`, `tetopt.open_stored`) and are read box by box.

    Parameters
    ----------
    data : (s_0, ..., s_{n-1}) array of real numbers
        Intensities, n = 2 or 3. Kept as float32 if that is lossless, else as float64; read-only.
    affine : (n+1, n+1) array, optional
        Homogeneous map from index to world coordinates in mm, by default the identity (1 mm voxel).
        Float64, read-only.

    Raises
    ------
    InputError
        Wrong number of axes, an empty axis, complex, RGB, masked or non-finite data, or an affine
        that is singular or has the wrong size.

    See Also
    --------
    load_image : Read an image from a file.
    open_stored : Open an image and leave its voxels in the file.

    Examples
    --------
    >>> image = tetopt.Image(np.zeros((4, 5, 6)), np.diag([2.0, 2.0, 3.0, 1.0]))
    >>> image.ndim, image.spacing.tolist(), round(image.voxel_volume, 6)
    (3, [2.0, 2.0, 3.0], 12.0)
    """

    voxels: Any  # `data`, or a stored array that is sliced box by box
    affine: NDArray[np.float64]

    def __init__(self, data: ArrayLike, affine: ArrayLike | None = None) -> None:
        checked = _checked_data(data)
        affine = checked_affine(
            np.eye(checked.ndim + 1) if affine is None else affine, checked.ndim
        )
        vars(self).update(voxels=checked, affine=affine, data=checked)

    def __reduce__(self) -> tuple[Any, ...]:
        """Check and lock the arrays of a copy, or of an unpickled image, again: pickle keeps
        neither.
        """
        return Image.stored if self.is_stored else Image, (self.voxels, self.affine)

    @classmethod
    def stored(cls, voxels: Any, affine: ArrayLike | None = None) -> Image:
        """Make a 3-D image whose voxels stay in their array, which need not fit into memory.

        Parameters
        ----------
        voxels : array of three axes
            Any object with a `shape` and a `dtype` that returns an array of numbers for a tuple of
            slices: an array of zarr, dask or h5py, or a memory-mapped numpy array. Values are
            checked as they are read.
        affine : (4, 4) array, optional
            As for `Image`.

        Returns
        -------
        Image
            The image, with nothing read yet.

        Raises
        ------
        InputError
            A number of axes other than three, an empty axis, or an invalid affine.

        Examples
        --------
        >>> voxels = np.memmap("scan.raw", dtype=np.int16, mode="w+", shape=(64, 64, 64))
        >>> stored = tetopt.Image.stored(voxels, np.diag([0.5, 0.5, 0.5, 1.0]))
        >>> stored.shape, stored.box((0, 0, 0), (8, 8, 8)).shape
        ((64, 64, 64), (8, 8, 8))
        """
        shape = tuple(int(size) for size in voxels.shape)
        if len(shape) != 3 or 0 in shape:
            raise InputError(f"image: expected three non-empty axes, got shape {shape}")
        image = cls.__new__(cls)
        vars(image).update(
            voxels=voxels, affine=checked_affine(np.eye(4) if affine is None else affine, 3)
        )
        return image

    @cached_property
    def data(self) -> NDArray[np.floating]:
        """All intensities, as in `Image(data)`; a stored image reads them at first use and keeps
        them.
        """
        check_memory(
            LOADED_BYTES * prod(self.shape), f"image: {self._size()}", "read it box by box"
        )
        whole = _checked_data(self.read((0,) * self.ndim, self.shape))
        vars(self).update(voxels=whole)  # later boxes come from memory
        return whole

    @cached_property
    def range(self) -> tuple[float, float]:
        """The smallest and largest intensity, cached like the next three, as each takes a pass
        over all voxels.
        """
        return float(self.data.min()), float(self.data.max())

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
    def is_stored(self) -> bool:
        """True if the voxels are stored outside memory and have not been read as a whole."""
        return "data" not in vars(self)

    @property
    def in_memory(self) -> Image | None:
        """The image itself, or None if its voxels are only stored."""
        return None if self.is_stored else self

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along each axis."""
        return tuple(int(size) for size in self.voxels.shape)

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
        return (
            transformed(np.asarray(index, dtype=np.float64), self.affine[:-1, :-1])
            + self.affine[:-1, -1]
        )

    def to_index(self, points: ArrayLike) -> NDArray[np.float64]:
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
        return transformed(
            shifted, np.asarray(np.linalg.inv(self.affine[:-1, :-1]), dtype=np.float64)
        )

    def read(self, start: Sequence[int], stop: Sequence[int]) -> NDArray:
        """Read the voxels of a box of indices into memory, in the stored type.

        Parameters
        ----------
        start, stop : (n,) sequences of int
            The first index of the box along each axis, and the one after its last.

        Returns
        -------
        (stop - start) array
            The voxels; a view if they are in memory.

        Examples
        --------
        >>> stored = tetopt.Image.stored(np.arange(64, dtype=np.int16).reshape(4, 4, 4))
        >>> stored.read((0, 0, 0), (1, 2, 4)).tolist()
        [[[0, 1, 2, 3], [4, 5, 6, 7]]]
        """
        return np.asarray(
            self.voxels[tuple(slice(int(a), int(b)) for a, b in zip(start, stop, strict=True))]
        )

    def box(self, start: Sequence[int], stop: Sequence[int]) -> Image:
        """Read a box of indices as an image in memory; every voxel keeps its place in the world.

        Parameters
        ----------
        start, stop : (n,) sequences of int
            The first index of the box along each axis, and the one after its last.

        Returns
        -------
        Image
            The box.

        Raises
        ------
        InputError
            Values that are invalid for an `Image`, such as NaN.

        Examples
        --------
        >>> stored = tetopt.Image.stored(np.arange(64, dtype=np.int16).reshape(4, 4, 4))
        >>> corner = stored.box((2, 2, 2), (4, 4, 4))
        >>> corner.to_world([0, 0, 0]).tolist() == stored.to_world([2, 2, 2]).tolist()
        True
        """
        affine = self.affine.copy()
        affine[:-1, -1] = self.to_world(start)
        return Image(self.read(start, stop), affine)

    @property
    def box_bytes(self) -> float:
        """Memory that iterating over `boxes` takes, bytes."""
        return 2.0 * READ_BYTES if self.is_stored else 0.0

    def boxes(self) -> Iterator[Box]:
        """Iterate over the voxels in boxes of whole rows, plane by plane; a 2-D image is one plane
        of a volume.

        Boxes in memory are small. Stored ones are as thick as chunks and take at most `READ_BYTES`,
        except that a row is always read whole.

        Returns
        -------
        iterator of three slices
            Slices along the axes of a volume; a 2-D image is its first plane.

        Examples
        --------
        >>> voxels = np.memmap("scan.raw", dtype=np.int16, mode="w+", shape=(64, 64, 64))
        >>> stored = tetopt.Image.stored(voxels)
        >>> list(stored.boxes())
        [(slice(0, 64, None), slice(0, 64, None), slice(0, 64, None))]
        """
        s0, s1, s2 = shape = (1,) * (3 - self.ndim) + self.shape
        if not self.is_stored:
            return _boxes(shape, max(PIECE_VOXELS // (s1 * s2), 1), s1)
        chunks = getattr(self.voxels, "chunks", None)
        most_rows = max(READ_BYTES // (s2 * np.dtype(self.voxels.dtype).itemsize), 1)
        if chunks:
            # dask lists all chunk sizes along each axis.
            n_planes, step = (
                min(int(np.max(sizes)), s) for sizes, s in zip(chunks[:2], (s0, s1), strict=True)
            )
        elif _is_first_axis_fastest(self.voxels):
            n_planes, step = s0, 1
        else:
            n_planes, step = max(min(s0, most_rows // s1), 1), 1
        n_planes = min(n_planes, most_rows)
        n_rows = most_rows // n_planes
        return _boxes(shape, n_planes, min(n_rows // step * step or n_rows, s1))

    def __repr__(self) -> str:
        values = "stored" if self.is_stored else f"{self.range[0]:.4g} to {self.range[1]:.4g}"
        return f"Image({self._size()}, {self.voxels.dtype}, {values})"

    def _size(self) -> str:
        """Number and size of voxels."""
        counts, sides = (
            " x ".join(f"{each:.4g}" for each in numbers) for numbers in (self.shape, self.spacing)
        )
        return f"{counts} voxels of {sides} mm"

    def _repr_html_(self) -> str:
        """Numbers and the middle slice, for a notebook; a stored image shows neither intensities
        nor a picture.
        """
        rows = [("size", self._size()), ("kind", str(self.voxels.dtype))]
        if self.is_stored:
            return notebook.card_html("Image", rows, "")
        rows.insert(
            1, ("intensities", f"{self.range[0]:.4g} to {self.range[1]:.4g}, mean {self.mean:.4g}")
        )
        return notebook.card_html("Image", rows, notebook.slice_html(self.data, self.affine))


def transformed(vectors: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply each of the vectors (..., n) by `matrix` (n, n), term by term in the order of the
    columns.

    BLAS is not used, as its rounding depends on the number of threads: a mesh must be the same to
    the last bit on every machine.
    """
    product = vectors[..., :1] * matrix[:, 0]
    for column in range(1, matrix.shape[1]):
        product = product + vectors[..., column : column + 1] * matrix[:, column]
    return product


def _checked_data(data: ArrayLike) -> NDArray[np.floating]:
    """Return a read-only float32 or float64 C-ordered copy of `data`; raise InputError if it
    cannot be an image.
    """
    try:
        data = unmasked("image data", data)
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
    is_bad = ~np.isfinite(data)
    if is_bad.any():
        check_finite(int(np.count_nonzero(is_bad)), tuple(int(i) for i in np.argwhere(is_bad)[0]))
    values = _as_lossless_float(data)
    check_intensities(float(values.min()), float(values.max()))
    values.setflags(write=False)
    return values


def check_in_memory(image: Image, what: str, remedy: str) -> None:
    """Raise InputError unless the voxels are in memory, as `what` requires; `remedy` names an
    alternative.
    """
    if image.is_stored:
        raise InputError(f"{what} of an image in memory, but this image is stored; {remedy}")


def check_kind(dtype: np.dtype) -> None:
    """Raise InputError unless the voxels are real numbers."""
    if dtype.names is not None or dtype.kind == "O":
        raise InputError(
            f"image data: expected one number per voxel, got {dtype}; convert RGB to grey first"
        )
    if dtype.kind == "c":
        raise InputError(
            "image data: expected real numbers, got complex ones; compute the magnitude first"
        )
    if dtype.kind not in "buif":
        raise InputError(f"image data: expected numbers, got dtype {dtype}")


def check_finite(n_bad: int, first: tuple[int, ...]) -> None:
    """Raise InputError if `n_bad` voxels are not finite, the first at this index."""
    if n_bad > 0:
        raise InputError(
            f"image data: {n_bad} voxels are NaN or infinite, the first at index {first}; "
            "replace them first, for "
            "example with the background's value"
        )


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
    if np.array_equal(single, data):
        return single
    return np.array(data, dtype=np.float64, order="C")


def checked_affine(affine: ArrayLike, n: int) -> NDArray[np.float64]:
    """Return a read-only copy of the affine; raise InputError unless it is (n+1, n+1), finite,
    homogeneous, regular.
    """
    try:
        affine = np.array(unmasked("affine", affine), dtype=np.float64)
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


def _check_extents(
    columns: NDArray[np.float64], lengths: NDArray[np.float64], origin: NDArray[np.float64]
) -> None:
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


def _is_first_axis_fastest(voxels: Any) -> bool:
    """True if a mapped array is stored in NIfTI order, which scatters planes along the first
    axis over the file.
    """
    strides = getattr(voxels, "strides", None)
    return strides is not None and abs(strides[0]) < abs(strides[-1])


def _boxes(shape: Sequence[int], n_planes: int, n_rows: int) -> Iterator[Box]:
    """Boxes of up to `n_planes` planes and `n_rows` rows, with all columns."""
    for i in range(0, shape[0], n_planes):
        for j in range(0, shape[1], n_rows):
            yield (
                slice(i, min(i + n_planes, shape[0])),
                slice(j, min(j + n_rows, shape[1])),
                slice(0, shape[2]),
            )


def pieces(shape: Sequence[int]) -> Iterator[Box]:
    """Divide a box of voxels (P, R, K) into boxes of whole rows: plane by plane, and rows in
    order.
    """
    n_rows = min(shape[1], max(PIECE_VOXELS // shape[2], 1))
    return _boxes(shape, max(PIECE_VOXELS // (n_rows * shape[2]), 1), n_rows)
