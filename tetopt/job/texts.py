"""Options of runs as texts: the words of a command line, and the cells of a table."""

from __future__ import annotations

import re
from dataclasses import replace
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from tetopt.errors import InputError
from tetopt.job.options import Option, RunOptions, kinds_of, near_hint, option_name, option_of
from tetopt.system.public import LARGEST_INTEGER


def option_words(options: dict[str, Any]) -> list[str]:
    """Convert options of `given_options`, without arguments, to the words of a command."""
    words = []
    for name, value in options.items():
        if value is True:
            words.append(f"--{name}")
        else:
            words += [f"--{name}={each}" for each in (value if isinstance(value, list) else [value])]
    return words


def with_options(options: RunOptions, texts: dict[str, str]) -> RunOptions:
    """Return the options with some values replaced by texts, by names of the command line.

    A switch is on by "1", "true" or "yes" and off by "0", "false" or "no"; several values of an option that may be
    repeated are separated by semicolons.

    Raises
    ------
    InputError
        An unknown option, or an invalid value.
    """
    kinds = {option_name(name, kind): (name, kind) for name, kind in kinds_of(RunOptions).items()}
    values: dict[str, Any] = {}
    wrong = []
    for name, text in texts.items():
        if name not in kinds:
            raise InputError(f"{name}: not an option of tetopt mesh" + near_hint(name, kinds))
        field, kind = kinds[name]
        try:
            values[field] = _value_of(name, get_args(kind)[0], option_of(kind), text)
        except InputError:  # from a switch
            raise
        except ValueError:
            point = text.replace(",", ".")
            is_comma = point != text and re.fullmatch(r"-?[0-9]*\.[0-9]+", point)
            wrong.append(f'{name}: invalid value "{text}"' + (f"; write {point}" if is_comma else ""))
    if wrong:
        raise InputError("; ".join(wrong))
    return replace(options, **values)


def _value_of(name: str, kind: Any, option: Option, text: str) -> Any:
    """Convert a text to an option's value; raise ValueError if it is invalid."""
    own = get_args(kind)[0] if get_origin(kind) in (Union, UnionType) else kind
    if own is bool:
        if text.lower() not in ("1", "true", "yes", "0", "false", "no"):
            raise InputError(f'{name}: expected true or false, got "{text}"')
        return text.lower() in ("1", "true", "yes")
    if get_origin(own) is list:
        return [part.strip() for part in text.split(";") if part.strip()] or None
    if own is int:
        text = re.sub(r"\.0+$", "", text)  # as spreadsheets write whole numbers
    value: Any = text if get_origin(own) is Literal else own(text)
    least = -LARGEST_INTEGER if option.least is None else option.least
    is_choice = get_origin(own) is not Literal or value in get_args(own)
    is_small = own is not int or least <= value <= LARGEST_INTEGER
    if not (is_choice and is_small):
        raise ValueError(text)
    return value
