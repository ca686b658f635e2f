"""Options of runs as texts: the words of a command line, and the cells of a table."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import replace
from types import UnionType
from typing import Any, Union, get_args, get_origin

from tetopt.errors import InputError
from tetopt.job.job import of_option
from tetopt.job.options import RunOptions, kinds_of, near_hint, option_name
from tetopt.system.arrays import Json

SWITCH_WORDS = {
    **dict.fromkeys(("1", "true", "yes"), True),
    **dict.fromkeys(("0", "false", "no"), False),
}


def option_words(options: Json) -> list[str]:
    """Convert options of `given_options`, without arguments, to the words of a command."""
    words = []
    for name, value in options.items():
        if isinstance(value, bool):
            words.append(f"--{name if value else 'no-' + name}")
        else:
            words += [
                f"--{name}={each}" for each in (value if isinstance(value, list) else [value])
            ]
    return words


def with_options(options: RunOptions, texts: dict[str, str]) -> RunOptions:
    """Return the options with some values replaced by texts, by names of the command line.

    A switch is on by "1", "true" or "yes" and off by "0", "false" or "no"; several values of an
    option that may be repeated are separated by semicolons.

    Raises
    ------
    InputError
        An unknown option, or an invalid value.
    """
    kinds = {option_name(name, kind): (name, kind) for name, kind in kinds_of(RunOptions).items()}
    values: Json = {}
    wrong = []
    for name, text in texts.items():
        if name not in kinds:
            raise InputError(f"{name}: not an option of tetopt mesh" + near_hint(name, kinds))
        field, kind = kinds[name]
        try:
            values[field] = of_option(field, kind, value_of_text(get_args(kind)[0], text))
        except InputError as error:
            point = text.replace(",", ".")
            is_comma = point != text and re.fullmatch(r"-?[0-9]*\.[0-9]+", point)
            wrong.append(f"{error}" + (f"; write {point}" if is_comma else ""))
    if wrong:
        raise InputError("; ".join(wrong))
    return replace(options, **values)


def value_of_text(kind: Any, text: Any) -> Any:
    """Return the value of a kind that a text stands for; the text itself if it stands for none."""
    own = get_args(kind)[0] if get_origin(kind) in (Union, UnionType) else kind
    if own is bool:
        return SWITCH_WORDS.get(text.lower(), text)
    if get_origin(own) is list:
        return [part.strip() for part in text.split(";") if part.strip()] or None
    for convert in (own, float) if own in (int, float) else ():  # 5e3 is a whole number, too
        with suppress(ValueError, TypeError):
            return convert(text)
    return text
