"""A run as one record: every option of `tetopt mesh`, validated, and converted to and from JSON."""

from __future__ import annotations

import inspect
import json
import os
import re
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from numbers import Integral, Real
from pathlib import Path
from textwrap import wrap
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np

from tetopt.errors import InputError
from tetopt.job.options import JobOptions, SizeOptions, kinds_of, near_hint, option_of
from tetopt.job.plan import plan_job
from tetopt.model.mappings import MAPPED_OPTIONS
from tetopt.system.arrays import Json
from tetopt.system.incoming import json_of

Record = TypeVar("Record")
LARGEST_INTEGER = 2**63 - 1  # numpy's largest: no count here exceeds it
FIRST = ("images", "output", "nodes", "mask", "labels", *kinds_of(SizeOptions))  # as users set them
SHOWN_LETTERS = 80  # characters of a value in a message
UNIT_WORDS = {"MM": " in mm", "GB": " in GB", "S": " in seconds"}  # units of numbers, by metavar
KIND_WORDS = {
    Path: "a path",
    float: "a number",
    int: "a whole number",
    str: "a string",
    bool: "True or False",
}


@dataclass(frozen=True, kw_only=True)
class Job(JobOptions):
    """A run of tetopt on files, with each option of `tetopt mesh` as a field.

    Mappings and loads are strings, as on the command line; a number is a mapping to one value. None
    means the default, which may depend on the image.

    Parameters
    ----------
    PARAMETERS

    Raises
    ------
    InputError
        Values have the wrong type, are out of range, or contradict each other, as far as no file
        has to be read.

    See Also
    --------
    run : Run it.

    Examples
    --------
    >>> job = tetopt.Job(images="T1.nii.gz", output="brain.vtu", nodes=5000, young="0.5 + 0.01*h")
    >>> tetopt.Job.from_json(job.to_json()) == job
    True
    >>> tetopt.Job(images="T1.nii.gz", output="brain.vtu", nodes=5000, target_error=0.1)
    Traceback (most recent call last):
    ...
    tetopt.errors.InputError: `nodes` and `target_error`: give only one of them
    """

    def __post_init__(self) -> None:
        """Convert values to the types of their fields, and reject invalid ones."""
        for name, kind in kinds_of(Job).items():
            object.__setattr__(self, name, of_option(name, kind, getattr(self, name)))
        plan_job(self, reads_files=False)

    def given(self) -> Json:
        """Return options that differ from the default, by name; paths as strings.

        Returns
        -------
        dict
            Values that JSON can hold.

        Examples
        --------
        >>> tetopt.Job(images="T1.nii.gz", output="brain.vtu", nodes=5000).given()
        {'images': ['T1.nii.gz'], 'nodes': 5000, 'output': 'brain.vtu'}
        """
        values = ((field, getattr(self, field.name)) for field in fields(self))
        return {field.name: _in_words(value) for field, value in values if value != field.default}

    def to_json(self) -> str:
        """Return the options as JSON, which `from_json` reads.

        Returns
        -------
        str
            An object of the options that differ from the default.

        Examples
        --------
        >>> tetopt.Job(images="T1.nii.gz", output="brain.vtu").to_json()
        '{"images": ["T1.nii.gz"], "output": "brain.vtu"}'
        """
        return json.dumps(self.given())

    @classmethod
    def from_json(cls, text: str) -> Job:
        """Create a job from JSON.

        Parameters
        ----------
        text : str
            An object of options, as from `to_json`.

        Returns
        -------
        Job

        Raises
        ------
        InputError
            The text is not JSON; an option is unknown, or a value invalid.

        Examples
        --------
        >>> text = '{"images": ["T1.nii.gz"], "output": "brain.vtu", "nodes": 300}'
        >>> tetopt.Job.from_json(text).nodes
        300
        """
        try:
            table = json_of(text)
        except ValueError as error:
            raise InputError(f"job: expected JSON ({error})") from error
        if not isinstance(table, dict):
            raise InputError(f"job: expected an object of options, got {type(table).__name__}")
        for name in table:
            if name not in kinds_of(cls):
                raise InputError(
                    f"job: unknown option {name[:80]!r}" + near_hint(name, kinds_of(cls))
                )
        if lost := [
            each.name for each in fields(cls) if each.default is MISSING and each.name not in table
        ]:
            raise InputError(f"job: missing {' and '.join(lost)}")
        return cls(**table)


def _signature() -> inspect.Signature:
    """Return the signature of a job in the order of FIRST; all options are keywords, so their
    order is free.
    """
    plain = inspect.signature(Job)
    parameters = plain.parameters
    return plain.replace(
        parameters=[parameters[name] for name in dict.fromkeys((*FIRST, *parameters))]
    )


def _parameters() -> str:
    """Return the options of a job for its docstring."""
    lines = []
    known = {field.name: field for field in fields(Job)}
    for name in Job.__signature__.parameters:  # type: ignore[attr-defined]
        field = known[name]
        kind = kinds_of(Job)[field.name]
        option = option_of(kind)
        words = _kind_words(get_args(kind)[0]) + UNIT_WORDS.get(option.metavar or "", "")
        if field.default is not MISSING:
            words += ", optional" if field.default is None else f", default {field.default!r}"
        lines += [
            f"{field.name} : {words}",
            *wrap(
                re.sub(r"\w+://\S*\w", r"``\g<0>``", option.text),
                108,
                initial_indent="    ",
                subsequent_indent="    ",
            ),
        ]
    return "\n".join(lines)


def _kind_words(kind: Any) -> str:
    """Return a type as docstrings name it."""
    own = get_args(kind)[0] if get_origin(kind) in (Union, UnionType) else kind
    if get_origin(own) is Literal:
        return "{" + ", ".join(map(repr, get_args(own))) + "}"
    return (
        f"list of {_kind_words(get_args(own)[0])}"
        if get_origin(own) is list
        else own.__name__.lower()
    )


Job.__signature__ = _signature()  # type: ignore[attr-defined]
if Job.__doc__:  # Python removes its indentation from 3.13 on
    Job.__doc__ = inspect.cleandoc(Job.__doc__).replace("PARAMETERS", _parameters())


def in_kinds(record: Callable[..., Record], values: Json) -> Record:
    """Create a record of options, converting values to the fields' types; raise InputError for
    an invalid one.
    """
    kinds = kinds_of(record)
    return record(**{name: of_option(name, kinds[name], value) for name, value in values.items()})


def of_option(name: str, kind: Any, value: Any) -> Any:
    """Convert a value to the type of an option, and check its minimum; raise InputError for an
    invalid one.
    """
    value = _of_kind(name, get_args(kind)[0], value)
    least = option_of(kind).least
    if value is not None and least is not None and value < least:
        raise InputError(f"`{name}`: expected {least} or more, got {value}")
    return value


def _of_kind(name: str, kind: Any, value: Any) -> Any:
    """Convert a value to the type of its field; raise InputError if it cannot be converted."""
    is_optional = get_origin(kind) in (Union, UnionType)
    if value is None and is_optional:
        return None
    own = get_args(kind)[0] if is_optional else kind
    # whose comparisons may overflow
    value = value.item() if isinstance(value, np.number) else value
    if get_origin(own) is list:
        (of_each,) = get_args(own)
        many = [value] if isinstance(value, str | Path) else value
        if not isinstance(many, list | tuple) or not many:
            raise InputError(
                f"`{name}`: expected {KIND_WORDS[of_each]} or a list of them, "
                f"got {_value_text(value)}"
            )
        return [_of_kind(name, of_each, each) for each in many]
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if (
        own is Path
        and isinstance(value, str | os.PathLike)
        and str(value)
        and "\0" not in str(value)
    ):
        return Path(value)
    if own is float and is_number:
        return float(value)
    if own is int and is_number and abs(value) <= LARGEST_INTEGER and float(value).is_integer():
        return int(value)
    if own is str and (
        isinstance(value, str) or (is_number and name in (*MAPPED_OPTIONS, "background", "bins"))
    ):
        if isinstance(value, str):
            return value
        # so that it is read back to its last bit
        return str(int(value)) if isinstance(value, Integral) else repr(float(value))
    if own is Path and name == "tissues" and isinstance(value, list | tuple) and value:
        return Path(",".join(str(_of_kind(name, own, each)) for each in value))
    if own is str and name == "weights" and isinstance(value, list | tuple):
        return ",".join(repr(_of_kind(name, float, each)).removesuffix(".0") for each in value)
    # a number of voxels in files of earlier versions
    if own is bool and (isinstance(value, bool) or (is_number and name == "smooth_interfaces")):
        return value != 0
    choices = get_args(own)
    if get_origin(own) is Literal and value in choices:
        return value
    expected = " or ".join(map(str, choices)) if choices else KIND_WORDS[own]
    raise InputError(f"`{name}`: expected {expected}, got {_value_text(value)}")


def _value_text(value: Any) -> str:
    """Format a value for a message."""
    text = repr(value)
    return text if len(text) <= SHOWN_LETTERS else f"{text[:SHOWN_LETTERS]}..."


def _in_words(value: Any) -> Any:
    """Convert a value to one that JSON can hold."""
    if isinstance(value, list):
        return [_in_words(each) for each in value]
    return str(value) if isinstance(value, Path) else value
