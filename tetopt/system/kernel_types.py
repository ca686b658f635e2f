"""Types of the arguments of kernels, from annotations: arrays, numbers, tuples and records
(NamedTuples of these).
"""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import Annotated, Any

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

SCALAR_TYPES = {int: types.int64, float: types.float64, bool: types.boolean, type(None): types.void}


def type_of(hint: Any, of_record: Callable[[Any], types.Type]) -> types.Type:
    """Return numba's type of an annotation: a number, an annotated array, a record, or a tuple
    of these.
    """
    if typing.get_origin(hint) is Annotated:
        return typing.get_args(hint)[1]
    if typing.get_origin(hint) is tuple:
        return types.BaseTuple.from_types(
            [type_of(part, of_record) for part in typing.get_args(hint)]
        )
    # of records, one for each thread; see `tetopt.system.kernels.own`
    if typing.get_origin(hint) is list:
        return of_record(typing.get_args(hint)[0])
    return SCALAR_TYPES[hint] if hint in SCALAR_TYPES else of_record(hint)


def by_value(record: type) -> types.BaseTuple:
    """Return numba's own type of a NamedTuple, which kernels pass by value."""
    hints = typing.get_type_hints(record, include_extras=True)
    return types.BaseTuple.from_types([type_of(hint, by_value) for hint in hints.values()], record)


def numpy_dtype(array: types.Array) -> np.dtype[Any]:
    """Return the numpy dtype of a numba array type."""
    return np.dtype(np.bool_ if array.dtype == types.boolean else array.dtype.name)


def check_array(value: Any, kind: types.Array, name: str) -> None:
    """Raise TypeError unless an array has the annotated type of a field."""
    if not (
        value.flags.c_contiguous and value.ndim == kind.ndim and value.dtype == numpy_dtype(kind)
    ):
        raise TypeError(f"{name}: expected {kind}, got {numba.typeof(value)}")


def cast(value: Any, kind: types.Type, name: str, number: int = 0) -> Any:
    """Cast a record or a field to its annotated type, for numba by value; a list gives its
    record with `number`.
    """
    if isinstance(value, list):
        value = value[number]
    if isinstance(kind, types.BaseTuple):
        record: Any = kind.instance_class
        if type(value) is not record:
            raise TypeError(f"{name}: expected {record.__name__}, got {value!r}")
        parts = zip(value, kind, record._fields, strict=True)
        return record(
            *(cast(part, of, f"{record.__name__}.{field}", number) for part, of, field in parts)
        )
    if isinstance(kind, types.Array):
        check_array(value, kind, name)
        return value if value.flags.writeable else _Unlocked(value).array
    return (
        bool(value)
        if kind == types.boolean
        else float(value)
        if kind == types.float64
        else int(value)
    )


class _Unlocked:
    """A read-only array that numba sees as writable, so that kernels are compiled only once."""

    def __init__(self, array: NDArray[Any]) -> None:
        self.source = array
        self.__array_interface__ = array.__array_interface__ | {"data": (array.ctypes.data, False)}
        self.array = np.asarray(self)
