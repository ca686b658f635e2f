"""Check the arguments of all public functions by their annotations, with a one-line message for a
mistake.

Functions check ranges (which exclude NaN), shapes and consistency themselves. Checking only Images,
Meshes and other records would take a third of this code, but 227 of the 1505 wrong calls in
tests/system/test_public.py would end in an AttributeError, a ValueError, an IndexError, a KeyError
or an OverflowError from inner functions.
"""

from __future__ import annotations

import functools
import inspect
import numbers
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike, NDArray

import tetopt
from tetopt.errors import InputError

ARRAY_WORDS = ("ArrayLike", "NDArray", "Points", "Cells")  # annotations of arrays
TABLE_WORDS = ("Points", "Cells")  # those with two axes, which are not converted
# Remedies for messages: how to get an object of each class.
REMEDIES = {
    "Image": "use tetopt.load_image(path), tetopt.Image(array, affine), or the image of a Content",
    "Mesh": "use tetopt.load_mesh(path).mesh or tetopt.mesh_image(...).mesh",
    "Model": "use tetopt.build_model(mesh, ...)",
    "Solution": "use tetopt.solve(model)",
    "Surface": "use tetopt.extract_surface(points, cells, chosen)",
}
NAMES_OF_KINDS = {
    "int": "a whole number",
    "float": "a number",
    "str": "a string",
    "bool": "True or False",
    "Points": "an array with one row per point",
    "Cells": "an array with one row per cell",
}
LARGEST_INTEGER = 2**63 - 1  # numpy's largest: no count here exceeds it


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function so that `check_arguments` checks its arguments before each call."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        bound = signature.bind(*args, **options)
        check_arguments(function, bound.arguments)
        for name, value in bound.arguments.items():
            annotation = str(signature.parameters[name].annotation)
            is_whole = re.search(r"\bint\b", annotation) is not None and "float" not in annotation
            bound.arguments[name] = _with_plain_numbers(value, is_whole)
        return function(*bound.args, **bound.kwargs)

    return call


def unmasked(what: str, values: ArrayLike) -> NDArray:
    """Return values as an array; InputError for masked ones, whose hidden numbers numpy would
    use.
    """
    if isinstance(values, np.ma.MaskedArray) and (
        n_masked := int(np.ma.getmaskarray(values).sum())
    ):
        raise InputError(
            f"{what}: got {n_masked} masked values; replace them by numbers first, as by "
            "array.filled(0)"
        )
    return np.asarray(values)


def checked_simplices(
    what: str, points: ArrayLike, cells: ArrayLike, n_corners: int | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return copies of points (N, n) and of the cells between them, (M, n+1) or (M, n_corners).

    Raises
    ------
    InputError
        Wrong shapes, non-finite points, no cells, or indices that are not integers or out of range.
    """
    try:
        places = np.array(unmasked(f"{what} points", points), order="C")
        places = places.astype(None if places.dtype.kind == "c" else np.float64, copy=False)
        nodes = unmasked(f"{what} cells", cells)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{what}: expected arrays of numbers for points and cells ({error})"
        ) from error
    if places.ndim != 2 or places.shape[1] not in (2, 3) or places.dtype.kind == "c":
        got = (
            f"{places.dtype} of shape {places.shape}" if places.dtype.kind == "c" else places.shape
        )
        raise InputError(f"{what} points: expected shape (N, 2) or (N, 3), got {got}")
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


def _with_plain_numbers(value: Any, is_whole: bool) -> Any:
    """Convert numpy's numbers, also in records, lists and options, to Python's: sums of 8 or 16
    bits would overflow.
    """
    if isinstance(value, dict):
        return {key: _with_plain_numbers(each, False) for key, each in value.items()}
    if isinstance(value, tuple | list) and any(
        isinstance(each, np.number | float) for each in value
    ):
        plain = [_with_plain_numbers(each, is_whole) for each in value]
        return value._make(plain) if hasattr(value, "_make") else type(value)(plain)
    if isinstance(value, np.integer) or (
        is_whole and isinstance(value, float | np.floating) and value.is_integer()
    ):
        return int(value)
    return float(value) if isinstance(value, np.floating) else value


def check_arguments(function: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Raise InputError unless the arguments, by name, have the types that the function's
    annotations name.

    Checked annotations are Images, Meshes and other records, numbers, strings, paths, arrays,
    sequences and dicts of these, and classes of the function's module. All others are ignored.
    """
    for name, value in arguments.items():
        parameter = inspect.signature(function).parameters[name]
        if value is not parameter.default and parameter.kind is not parameter.VAR_KEYWORD:
            names = inspect.unwrap(function).__globals__  # not those of a decorator's module
            _check(f"{function.__name__}: {name}", str(parameter.annotation), value, names)
    if arguments.keys() >= {"points", "cells"}:
        checked_simplices(f"{function.__name__}:", arguments["points"], arguments["cells"])


def _check(what: str, annotation: str, value: Any, names: dict[str, Any]) -> None:
    """Raise InputError unless `value` has one of the types between the annotation's bars, or one
    of them is unknown.
    """
    kinds = re.split(r" \| (?![^\[]*\])", annotation)
    unmasked(what, value) if isinstance(value, np.ma.MaskedArray) else None
    answers = [_is_of(kind, value, names) for kind in kinds]
    if True in answers or None in answers:
        # a record whose constructor checks nothing
        if "Sizes" in kinds and isinstance(value, tuple):
            for field, kind in type(value).__annotations__.items():
                _check(
                    f"{what}.{field}",
                    getattr(kind, "__forward_arg__", str(kind)),
                    getattr(value, field),
                    names,
                )
        return
    expected = " or ".join(_in_words(kind, names) for kind in kinds)
    remedy = next((f"; {REMEDIES[kind]}" for kind in kinds if kind in REMEDIES), "")
    raise InputError(f"{what}: expected {expected}, got {_shown(value)}{remedy}")


def _is_of(kind: str, value: Any, names: dict[str, Any]) -> bool | None:
    """Return whether a value has a type; None if the type is unknown here."""
    head, _, inner = kind.rstrip("]").partition("[")
    if kind == "None":
        return value is None
    if kind in ("int", "float"):
        return _is_number(value, is_whole=kind == "int")
    if kind in ("str", "bool", "Path"):
        return isinstance(value, {"str": str, "bool": bool | np.bool_, "Path": Path}[kind])
    if head in ARRAY_WORDS:
        return _is_array(value) and (
            head not in TABLE_WORDS or (isinstance(value, np.ndarray) and value.ndim == 2)
        )
    if head in ("dict", "Mapping"):
        return isinstance(value, dict if head == "dict" else Mapping)
    if head == "Callable":
        return callable(value)
    if head in ("Sequence", "Iterable", "tuple"):
        if isinstance(value, str) or not isinstance(value, Iterable):
            return False
        item = inner.split(",")[0]
        return not isinstance(value, list | tuple) or all(
            _is_of(item, each, names) is not False for each in value
        )
    known = getattr(tetopt, kind) if kind in REMEDIES else names.get(kind)
    if get_origin(known) is Literal:  # the function itself checks the value
        return isinstance(value, str)
    return isinstance(value, known) if isinstance(known, type) else None


def _in_words(kind: str, names: dict[str, Any]) -> str:
    if get_origin(names.get(kind)) is Literal:
        return " or ".join(get_args(names[kind]))
    return NAMES_OF_KINDS.get(kind, kind.replace("Mapping[", "dict["))


def _is_number(value: Any, is_whole: bool) -> bool:
    if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Real):
        return False
    if isinstance(value, numbers.Integral):
        return abs(int(value)) <= LARGEST_INTEGER
    return float(value).is_integer() if is_whole else True


def _is_array(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "buif"
    # rows of different lengths, or an object that numpy cannot convert
    except (TypeError, ValueError):
        return False


def _shown(value: Any) -> str:
    """Format a value for a message: numbers and short strings themselves, otherwise their type."""
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        return f"a number of {value.bit_length()} bits"
    if isinstance(value, bool | int | float | str | np.number | None):
        text = ascii(value) if isinstance(value, str) else str(value)
        return text if len(text) <= 80 else f"{text[:77]}..."
    if type(value) in (list, tuple):  # no record
        return (
            f"{type(value).__name__} of "
            f"{', '.join(sorted({type(each).__name__ for each in value})) or 'nothing'}"
        )
    return f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")
