"""Check the arguments of all public functions by their annotations, with a one-line message for a mistake.

Functions check ranges (which exclude NaN), shapes and consistency themselves. Checking only Images, Meshes and other
records would take a third of this code, but 227 of the 1505 wrong calls in tests/system/test_public.py would end in an
AttributeError, a ValueError, an IndexError, a KeyError or an OverflowError from inner functions.
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
        check_arguments(function, signature.bind(*args, **options).arguments)
        return function(*args, **options)

    return call


def check_arguments(function: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Raise InputError unless the arguments, by name, have the types that the function's annotations name.

    Checked annotations are Images, Meshes and other records, numbers, strings, paths, arrays, sequences and dicts of
    these, and classes of the function's module. All others are ignored.
    """
    for name, value in arguments.items():
        parameter = inspect.signature(function).parameters[name]
        if value is not parameter.default and parameter.kind is not parameter.VAR_KEYWORD:
            names = inspect.unwrap(function).__globals__  # not those of a decorator's module
            _check(f"{function.__name__}: {name}", str(parameter.annotation), value, names)


def _check(what: str, annotation: str, value: Any, names: dict[str, Any]) -> None:
    """Raise InputError unless `value` has one of the types between the annotation's bars, or one of them is unknown."""
    kinds = re.split(r" \| (?![^\[]*\])", annotation)
    answers = [_is_of(kind, value, names) for kind in kinds]
    if True in answers or None in answers:
        if "Sizes" in kinds and isinstance(value, tuple):  # a record whose constructor checks nothing
            for field, kind in type(value).__annotations__.items():
                _check(f"{what}.{field}", getattr(kind, "__forward_arg__", str(kind)), getattr(value, field), names)
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
        return _is_array(value) and (head not in TABLE_WORDS or (isinstance(value, np.ndarray) and value.ndim == 2))
    if head in ("dict", "Mapping"):
        return isinstance(value, dict if head == "dict" else Mapping)
    if head == "Callable":
        return callable(value)
    if head in ("Sequence", "Iterable", "tuple"):
        if isinstance(value, str) or not isinstance(value, Iterable):
            return False
        item = inner.split(",")[0]
        return not isinstance(value, list | tuple) or all(_is_of(item, each, names) is not False for each in value)
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
    except (TypeError, ValueError):  # rows of different lengths, or an object that numpy cannot convert
        return False


def _shown(value: Any) -> str:
    """Format a value for a message: numbers and short strings themselves, otherwise their type."""
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        return f"a number of {value.bit_length()} bits"
    if isinstance(value, bool | int | float | str | np.number | None):
        text = ascii(value) if isinstance(value, str) else str(value)
        return text if len(text) <= 80 else f"{text[:77]}..."
    if type(value) in (list, tuple):  # no record
        return f"{type(value).__name__} of {', '.join(sorted({type(each).__name__ for each in value})) or 'nothing'}"
    return f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")
