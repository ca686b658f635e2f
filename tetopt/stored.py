"""An image whose voxels stay where they are, in a file of chunks or one that is mapped, and are read box by box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError
from tetopt.image import Image, VoxelGrid, checked_affine


@dataclass(frozen=True, eq=False)
class StoredImage(VoxelGrid):
    """Scalar intensities h on a grid of voxels in three dimensions that need not fit into memory.

    Parameters
    ----------
    voxels : array of three axes
        Whatever has a `shape` and a `dtype` and gives an array of numbers for a tuple of slices: an array of zarr,
        dask or h5py, or a mapped one of numpy.
    affine : (4, 4) array, optional
        Index -> world mm, homogeneous, as an `Image`'s. The identity (1 mm voxels) by default. Read-only.

    Raises
    ------
    InputError
        Other than three axes, an empty axis, or an affine that no `Image` takes.

    See Also
    --------
    load_image : Reads one into memory.

    Examples
    --------
    >>> voxels = np.memmap("scan.raw", dtype=np.int16, mode="w+", shape=(64, 64, 64))
    >>> stored = tetopt.StoredImage(voxels, np.diag([0.5, 0.5, 0.5, 1.0]))
    >>> stored.shape, stored.box((0, 0, 0), (8, 8, 8)).shape
    ((64, 64, 64), (8, 8, 8))
    """

    voxels: Any
    affine: NDArray[np.float64]

    def __init__(self, voxels: Any, affine: ArrayLike | None = None) -> None:
        shape = tuple(int(size) for size in voxels.shape)
        if len(shape) != 3 or 0 in shape:
            raise InputError(f"image: expected three axes with a voxel at least, got shape {shape}")
        object.__setattr__(self, "voxels", voxels)
        object.__setattr__(self, "affine", checked_affine(np.eye(4) if affine is None else affine, 3))

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along each axis."""
        return tuple(int(size) for size in self.voxels.shape)

    def read(self, start: Sequence[int], stop: Sequence[int]) -> NDArray:
        """The voxels of a box of indices, in memory, as they are stored.

        Parameters
        ----------
        start, stop : (3,) sequences of int
            The first index of the box along each axis, and the one after its last.

        Returns
        -------
        (stop - start) array
            Of the type that is stored.

        Examples
        --------
        >>> stored = tetopt.StoredImage(np.arange(64, dtype=np.int16).reshape(4, 4, 4))
        >>> stored.read((0, 0, 0), (1, 2, 4)).tolist()
        [[[0, 1, 2, 3], [4, 5, 6, 7]]]
        """
        return np.asarray(self.voxels[tuple(slice(int(a), int(b)) for a, b in zip(start, stop, strict=True))])

    def box(self, start: Sequence[int], stop: Sequence[int]) -> Image:
        """The voxels of a box of indices as an image; every voxel keeps its place in the world.

        Parameters
        ----------
        start, stop : (3,) sequences of int
            The first index of the box along each axis, and the one after its last.

        Returns
        -------
        Image
            The box, in memory.

        Raises
        ------
        InputError
            Values that no `Image` takes, NaN among them.

        Examples
        --------
        >>> stored = tetopt.StoredImage(np.arange(64, dtype=np.int16).reshape(4, 4, 4))
        >>> corner = stored.box((2, 2, 2), (4, 4, 4))
        >>> corner.to_world([0, 0, 0]).tolist() == stored.to_world([2, 2, 2]).tolist()
        True
        """
        affine = self.affine.copy()
        affine[:-1, -1] = self.to_world(start)
        return Image(self.read(start, stop), affine)
