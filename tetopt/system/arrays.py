"""Arrays of the user's as arrays of numbers."""

from __future__ import annotations

from operator import index
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Shape = tuple[int, ...]  # numbers of voxels along the axes
Arrays = dict[str, NDArray]  # by name: fields of cells or of nodes
Json = dict[str, Any]  # an object of JSON, or what one states: values by name


def plain_array(what: str, values: ArrayLike) -> NDArray:
    """Return values as an array; InputError for masked ones, whose hidden numbers numpy would
    use, and for complex ones, of which it would drop the imaginary part.
    """
    if isinstance(values, np.ma.MaskedArray) and (
        n_masked := int(np.ma.getmaskarray(values).sum())
    ):
        raise InputError(
            f"{what}: got {n_masked} masked values; replace them by numbers first, as by "
            "array.filled(0)"
        )
    array = np.asarray(values)
    if array.dtype.kind == "c":
        raise InputError(
            f"{what}: expected real numbers, got complex ones; compute the magnitude first"
        )
    return array


def whole_number(what: str, value: SupportsIndex) -> int:
    """Return a value as int; TypeError if it is none."""
    try:
        return index(value)
    except TypeError as error:
        raise TypeError(f"{what}: expected a whole number, got {value!r}") from error


def simplex_arrays(
    what: str, points: ArrayLike, cells: ArrayLike, n_corners: int | None = None
) -> tuple[Floats, Ints]:
    """Return copies of points (N, n) and of the cells between them, (M, n+1) or (M, n_corners).

    Raises
    ------
    InputError
        Wrong shapes, non-finite points, no cells, or indices that are not integers or out of range.
    """
    try:
        places = np.array(plain_array(f"{what} points", points), dtype=np.float64, order="C")
        nodes = plain_array(f"{what} cells", cells)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{what}: expected arrays of numbers for points and cells ({error})"
        ) from error
    if places.ndim != 2 or places.shape[1] not in (2, 3):
        raise InputError(f"{what} points: expected shape (N, 2) or (N, 3), got {places.shape}")
    width = n_corners or places.shape[1] + 1
    if nodes.ndim != 2 or nodes.shape[1] != width or len(nodes) == 0:
        raise InputError(f"{what} cells: expected shape (M, {width}) with M > 0, got {nodes.shape}")
    if not np.issubdtype(nodes.dtype, np.integer):
        raise InputError(f"{what} cells: expected integers, got {nodes.dtype}")
    if not np.isfinite(places).all():
        first = int(np.flatnonzero(~np.isfinite(places).all(axis=1))[0])
        raise InputError(
            f"{what} points: expected finite coordinates, but node {first} is "
            f"{places[first].tolist()}"
        )
    if nodes.min() < 0 or nodes.max() >= len(places):
        raise InputError(
            f"{what} cells: expected indices in 0..{len(places) - 1}, got "
            f"{nodes.min()}..{nodes.max()}"
        )
    return places, np.array(nodes, dtype=np.int64, order="C")
