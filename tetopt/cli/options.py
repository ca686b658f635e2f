"""Options of the commands, as records of annotated fields, and their conversion for typer.

A command is a function of records; `from_records` turns it into the function of single options that
typer expects, with each record's options in a panel of the help.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, cast, get_args, get_type_hints

import typer

from tetopt.cli.console import OPTION_NAMES, in_options
from tetopt.errors import InputError
from tetopt.io.meshes import MESH_SUFFIXES
from tetopt.job.job import of_option
from tetopt.job.options import (
    IMAGE_FILES,
    FieldsOption,
    ForceOption,
    JsonOption,
    LabelNamesOption,
    Option,
    has_option,
    kinds_of,
    option_name,
    option_of,
)
from tetopt.job.texts import value_of_text
from tetopt.system.arrays import Json
from tetopt.system.files import check_output, name_files, save_json

ImageArgument = Annotated[Path, Option("IMAGE", IMAGE_FILES, is_argument=True)]
MeshArgument = Annotated[
    Path,
    Option(
        "MESH",
        "VTU, VTK, MSH, INP, FEB, MESH or XDMF file of tetrahedra or triangles.",
        is_argument=True,
    ),
]
FilesArgument = Annotated[
    list[Path],
    Option(
        "[IMAGE] MESH",
        "VTU, VTK, MSH, INP, FEB, MESH or XDMF file of tetrahedra or triangles; an image before it "
        "is that of `image`.",
        is_argument=True,
    ),
]


@dataclass(frozen=True, kw_only=True)
class NumberOptions:
    """The file of all numbers of a command."""

    json_path: JsonOption = None
    force: ForceOption = False

    def check(self) -> None:
        """Raise InputError if the file may not be written."""
        if self.json_path is not None:
            check_output(self.json_path, (".json",), self.force)

    def save(self, numbers: Json) -> None:
        """Write the file if it was requested."""
        if self.json_path is not None:
            save_json(self.json_path, numbers)


@dataclass(frozen=True, kw_only=True)
class ShownOptions:
    """View settings of `tetopt view`, and its outputs."""

    html: Annotated[
        Path | None, Option("OUT.html", "Write the page to this file; open no browser.")
    ] = None
    fields: FieldsOption = None
    show: Annotated[
        str | None,
        Option(
            "NAME",
            "Field to colour by initially: mean, label, von_mises, ... (default: the first).",
        ),
    ] = None
    limits: Annotated[
        str | None,
        Option(
            "LOW,HIGH",
            "Range of the field's colours (default: all but 1 % at either end).",
            "range",
        ),
    ] = None
    label_names: LabelNamesOption = None


def mesh_and_image(files: list[Path], image: Path | None) -> tuple[Path, Path | None]:
    """Return the mesh and the image of a command with files "[IMAGE] MESH" and the option
    `image`.
    """
    *images, mesh = files
    images += [] if image is None else [image]
    if len(images) > 1:
        raise InputError(f"expected MESH and one image (`image`), got {len(images) + 1} files")
    if images and images[0].suffix.lower() in MESH_SUFFIXES:
        raise InputError(
            f"{images[0]}: expected an image beside {mesh}, got a mesh; give one mesh at a time"
        )
    return mesh, images[0] if images else None


def from_records(command: Callable[..., int]) -> Callable[..., int]:
    """Convert a command to a function of single options, for typer: records are replaced by their
    fields.

    A record is a dataclass; nested records are part of it. Its `panel`, if any, is the title of its
    options in the help.
    """
    kinds = get_type_hints(command, include_extras=True)
    defaults = {name: each.default for name, each in inspect.signature(command).parameters.items()}

    @wraps(command)
    def called(**values: Any) -> int:
        name_files(values.values())
        return command(**{name: _of_values(kinds[name], name, values) for name in defaults})

    leaves = [
        each for name, default in defaults.items() for each in _leaves(name, kinds[name], default)
    ]
    options = {
        name: f"--{option_name(name, kind)}" for name, kind, *_ in leaves if has_option(kind)
    }
    OPTION_NAMES.update({long[2:].replace("-", "_"): long for long in options.values()} | options)
    parameters = [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=default,
            annotation=_annotation_of(name, kind, default, panel),
        )
        for name, kind, default, panel in leaves
    ]
    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return called


def _leaves(
    name: str, kind: Any, default: Any, panel: str | None = None
) -> Iterator[tuple[str, Any, Any, str | None]]:
    """Yield the single options of a command's parameter or a record's field: names, kinds,
    defaults and panels.
    """
    if not is_dataclass(kind):
        yield name, kind, default, panel
        return
    record = cast(type, kind)
    for field in fields(record):
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        own = kinds_of(record)[field.name]
        yield from _leaves(field.name, own, default, _panel_of(record, field.name) or panel)


def _panel_of(record: type, name: str) -> str | None:
    """Return the help panel of a record's field: that of the first class that defines the field
    and has a panel.
    """
    bringing = [
        each
        for each in reversed(record.__mro__)
        if name in getattr(each, "__dataclass_fields__", {})
    ]
    return next((each.panel for each in bringing if hasattr(each, "panel")), None)


def _annotation_of(name: str, kind: Any, default: Any, panel: str | None) -> Any:
    """Return the annotation for typer, with the option's help panel; arguments have a panel of
    their own.
    """
    if not has_option(kind):
        return kind
    own = option_of(kind)
    about: Json = {"metavar": own.metavar, "help": in_options(own.text)}
    if own.is_argument:
        return Annotated[get_args(kind)[0], typer.Argument(**about)]
    long = option_name(name, kind)
    long = f"--{long}/--no-{long}" if default is True else f"--{long}"
    names = [f"-{own.letter}"] * bool(own.letter) + [long]
    # `of_option` has plainer words than typer for what is none
    value = get_args(kind)[0]
    if value in (int, float, int | None, float | None):
        about |= {
            "parser": str,
            "callback": lambda text: of_option(name, kind, value_of_text(value, text)),
        }
    return Annotated[value, typer.Option(*names, **about, min=own.least, rich_help_panel=panel)]


def _of_values(kind: Any, name: str, values: Json) -> Any:
    """Return a parameter's value: one of `values`, or a record built from them."""
    if not is_dataclass(kind):
        return values[name]
    kinds = kinds_of(cast(type, kind))
    return cast(Callable[..., Any], kind)(
        **{each: _of_values(own, each, values) for each, own in kinds.items()}
    )
