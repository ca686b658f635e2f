"""Options of the commands, as records of annotated fields, and how typer takes them.

A command is a function of records; `from_records` makes of it the function of single options that typer wants, each
record's options in a panel of the help. The help's words stand here alone.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, cast, get_args, get_type_hints

import typer
from typer.models import OptionInfo

from tetopt.cli.console import OPTION_NAMES, with_hyphens
from tetopt.errors import InputError
from tetopt.job.options import (
    IMAGE_FILES,
    ForceOption,
    JsonOption,
    LabelNamesOption,
    Option,
    kinds_of,
    option_name,
)
from tetopt.system.files import checked_output, name_files
from tetopt.system.public import LARGEST_INTEGER


def option(metavar: str | None, text: str, *names: str, **more: Any) -> Any:
    """`typer.Option` in one line: what its value is called, and what the help says of it."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


ImageArgument = Annotated[Path, typer.Argument(metavar="IMAGE", help=IMAGE_FILES)]
MeshArgument = Annotated[
    Path, typer.Argument(metavar="MESH", help="VTU, VTK or gmsh MSH file of tetrahedra or triangles.")
]
PredictOption = Annotated[
    bool, typer.Option("--predict", help="Tell how long the run takes and how much memory, and write nothing.")
]


@dataclass(frozen=True, kw_only=True)
class NumberOptions:
    """The file of all numbers beside what a command prints."""

    json_path: JsonOption = None
    force: ForceOption = False

    def checked(self) -> Path | None:
        """The file, if there is to be one; InputError if it may not be written."""
        return None if self.json_path is None else checked_output(self.json_path, (".json",), self.force)


@dataclass(frozen=True, kw_only=True)
class ShownOptions:
    """How `tetopt view` shows a mesh, and where."""

    html: Annotated[Path | None, option("OUT.html", "Write the page there, and open no browser.", "--html")] = None
    screenshot: Annotated[Path | None, option("OUT.png", "Write how it opens as a picture, and open no browser.")] = (
        None
    )
    field: Annotated[
        str | None, option("NAME", "Colour by this at first: mean, label, von_mises, ... (default: the first).")
    ] = None
    limits: Annotated[
        str | None,
        option("LOW,HIGH", "What its colours go from and to (default: all but 1 % at either end).", "--range"),
    ] = None
    label_names: LabelNamesOption = None


def from_records(command: Callable[..., int]) -> Callable[..., int]:
    """The command as a function of single options, for typer: the fields of its records in the records' places.

    A record is a dataclass; the records in it count as part of it. Its `panel`, if it has one, is the title of its
    options in the help.
    """
    kinds = get_type_hints(command, include_extras=True)
    defaults = {name: each.default for name, each in inspect.signature(command).parameters.items()}

    @wraps(command)
    def called(**values: Any) -> int:
        name_files(values.values())
        for name, value in values.items():
            if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
                raise InputError(f"{name.replace('_', '-')}: expected a number that 64 bits hold, got a longer one")
        return command(**{name: _of_values(kinds[name], name, values) for name in defaults})

    leaves = [each for name, default in defaults.items() for each in _leaves(name, kinds[name], default)]
    options = {name: long for name, kind, *_ in leaves if (long := _long_name(name, kind)) is not None}
    OPTION_NAMES.update({long[2:].replace("-", "_"): long for long in options.values()} | options)
    parameters = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=_typed(name, kind, panel))
        for name, kind, default, panel in leaves
    ]
    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return called


def _leaves(name: str, kind: Any, default: Any, panel: str | None = None) -> Iterator[tuple[str, Any, Any, str | None]]:
    """What stands for a parameter of a command, or for a field of a record: names, kinds, defaults and panels."""
    if not is_dataclass(kind):
        yield name, kind, default, panel
        return
    record = cast(type, kind)
    for field in fields(record):
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        own = kinds_of(record)[field.name]
        yield from _leaves(field.name, own, default, _panel_of(record, field.name) or panel)


def _long_name(name: str, kind: Any) -> str | None:
    """What the command line calls an option, with hyphens before it; None for what is no option."""
    own = _option_in(kind)
    if isinstance(own, Option):
        return f"--{option_name(name, kind)}"
    if own is None:
        return None
    names = [each for each in (own.default, *(own.param_decls or ())) if isinstance(each, str)]  # the first as well
    return next((each for each in names if each.startswith("--")), f"--{name.replace('_', '-')}")


def _option_in(kind: Any) -> Option | OptionInfo | None:
    """What an annotation says of its option, if it is one."""
    return next((each for each in get_args(kind)[1:] if isinstance(each, Option | OptionInfo)), None)


def _panel_of(record: type, name: str) -> str | None:
    """The panel of the help that a field of a record stands in: that of the first class with one that brings it."""
    bringing = [each for each in reversed(record.__mro__) if name in getattr(each, "__dataclass_fields__", {})]
    return next((each.panel for each in bringing if hasattr(each, "panel")), None)


def _typed(name: str, kind: Any, panel: str | None) -> Any:
    """The annotation as typer takes it, its option in a panel of the help; arguments have one of their own."""
    own = _option_in(kind)
    if isinstance(own, Option):
        text = with_hyphens(own.text)
        if own.is_argument:
            return Annotated[get_args(kind)[0], typer.Argument(metavar=own.metavar, help=text)]
        names = [f"-{own.letter}"] * bool(own.letter) + [f"--{option_name(name, kind)}"]
        made = option(own.metavar, text, *names, min=own.least)
    elif own is None or panel is None:
        return kind
    else:
        made = copy(own)
    made.rich_help_panel = panel
    return Annotated[get_args(kind)[0], made]


def _of_values(kind: Any, name: str, values: dict[str, Any]) -> Any:
    """A parameter's value: one of `values`, or the record that is made of them."""
    if not is_dataclass(kind):
        return values[name]
    kinds = kinds_of(cast(type, kind))
    return cast(Callable[..., Any], kind)(**{each: _of_values(own, each, values) for each, own in kinds.items()})
