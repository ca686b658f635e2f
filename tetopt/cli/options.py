"""Options of the commands, as records of annotated fields, and how typer takes them.

A command is a function of records; `from_records` makes of it the function of single options that typer wants, each
record's options in a panel of the help. The help's words stand here alone.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, cast, get_args, get_type_hints

import typer

from tetopt.cli.console import OPTION_NAMES, with_hyphens
from tetopt.errors import InputError
from tetopt.job.options import (
    IMAGE_FILES,
    ForceOption,
    JsonOption,
    LabelNamesOption,
    Option,
    has_option,
    kinds_of,
    option_name,
    option_of,
)
from tetopt.system.files import checked_output, name_files, save_json
from tetopt.system.public import LARGEST_INTEGER

ImageArgument = Annotated[Path, Option("IMAGE", IMAGE_FILES, is_argument=True)]
MeshArgument = Annotated[
    Path, Option("MESH", "VTU, VTK or gmsh MSH file of tetrahedra or triangles.", is_argument=True)
]
PredictOption = Annotated[bool, Option(None, "Tell how long the run takes and how much memory, and write nothing.")]


@dataclass(frozen=True, kw_only=True)
class NumberOptions:
    """The file of all numbers beside what a command prints."""

    json_path: JsonOption = None
    force: ForceOption = False

    def check(self) -> None:
        """InputError if the file may not be written."""
        if self.json_path is not None:
            checked_output(self.json_path, (".json",), self.force)

    def save(self, numbers: dict[str, Any]) -> None:
        """Write the file, if there is to be one."""
        if self.json_path is not None:
            save_json(self.json_path, numbers)


@dataclass(frozen=True, kw_only=True)
class ShownOptions:
    """How `tetopt view` shows a mesh, and where."""

    html: Annotated[Path | None, Option("OUT.html", "Write the page there, and open no browser.")] = None
    screenshot: Annotated[Path | None, Option("OUT.png", "Write how it opens as a picture, and open no browser.")] = (
        None
    )
    field: Annotated[
        str | None, Option("NAME", "Colour by this at first: mean, label, von_mises, ... (default: the first).")
    ] = None
    limits: Annotated[
        str | None,
        Option("LOW,HIGH", "What its colours go from and to (default: all but 1 % at either end).", "range"),
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
    options = {name: f"--{option_name(name, kind)}" for name, kind, *_ in leaves if has_option(kind)}
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


def _panel_of(record: type, name: str) -> str | None:
    """The panel of the help that a field of a record stands in: that of the first class with one that brings it."""
    bringing = [each for each in reversed(record.__mro__) if name in getattr(each, "__dataclass_fields__", {})]
    return next((each.panel for each in bringing if hasattr(each, "panel")), None)


def _typed(name: str, kind: Any, panel: str | None) -> Any:
    """The annotation as typer takes it, its option in a panel of the help; arguments have one of their own."""
    if not has_option(kind):
        return kind
    own = option_of(kind)
    about: dict[str, Any] = {"metavar": own.metavar, "help": with_hyphens(own.text)}
    if own.is_argument:
        return Annotated[get_args(kind)[0], typer.Argument(**about)]
    names = [f"-{own.letter}"] * bool(own.letter) + [f"--{option_name(name, kind)}"]
    return Annotated[get_args(kind)[0], typer.Option(*names, **about, min=own.least, rich_help_panel=panel)]


def _of_values(kind: Any, name: str, values: dict[str, Any]) -> Any:
    """A parameter's value: one of `values`, or the record that is made of them."""
    if not is_dataclass(kind):
        return values[name]
    kinds = kinds_of(cast(type, kind))
    return cast(Callable[..., Any], kind)(**{each: _of_values(own, each, values) for each, own in kinds.items()})
