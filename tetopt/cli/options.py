"""Options of the commands, as records of annotated fields, and how typer takes them.

A command is a function of records; `from_records` makes of it the function of single options that typer wants, each
record's options in a panel of the help. The help's words stand here alone.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache, wraps
from pathlib import Path
from typing import Annotated, Any, ClassVar, cast, get_args, get_type_hints

import typer
from typer.models import OptionInfo

from tetopt.cli.console import with_hyphens
from tetopt.errors import InputError
from tetopt.io.files import checked_output, name_files
from tetopt.io.formats import FORMATS
from tetopt.job.options import (
    AVERAGE_OPTION,
    IMAGE_FILES,
    ClusterOption,
    ForceOption,
    ImagePart,
    JsonOption,
    LabelNamesOption,
    Option,
    RunOptions,
    SchedulerOption,
    SpaceOption,
    kinds_of,
    near_hint,
    option_name,
)
from tetopt.public import LARGEST_INTEGER


def option(metavar: str | None, text: str, *names: str, **more: Any) -> Any:
    """`typer.Option` in one line: what its value is called, and what the help says of it."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


ImageArgument = Annotated[Path, typer.Argument(metavar="IMAGE", help=IMAGE_FILES)]
MeshArgument = Annotated[
    Path, typer.Argument(metavar="MESH", help="VTU, VTK or gmsh MSH file of tetrahedra or triangles.")
]
AverageOption = Annotated[str, AVERAGE_OPTION]
PredictOption = Annotated[
    bool, typer.Option("--predict", help="Tell how long the run takes and how much memory, and write nothing.")
]


@dataclass(frozen=True, kw_only=True)
class LabelledPart(ImagePart):
    """Which part of an image file is read, and what gives labels to a mesh that was made without."""

    labels: Annotated[
        Path | None, option("LABELS", "Label image: a cell gets the label of most of its voxels, for laws and sets.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class NumberOptions:
    """The file of all numbers beside what a command prints."""

    json_path: JsonOption = None
    force: ForceOption = False

    def checked(self) -> Path | None:
        """The file, if there is to be one; InputError if it may not be written."""
        return None if self.json_path is None else checked_output(self.json_path, (".json",), self.force)


@dataclass(frozen=True, kw_only=True)
class SurfacePart:
    """Which surface `tetopt surface` writes, and how its points are."""

    below: Annotated[float | None, option("T", "Of the largest connected set of cells with a mean below T.")] = None
    label: Annotated[str | None, option("L", "Of all cells with this label, by number or name.")] = None
    cell_set: Annotated[str | None, option("NAME", "Of a named set of cells.", "--set")] = None
    boundary: Annotated[
        bool, typer.Option("--boundary", help="Of the whole mesh; with --interfaces, the boundary as well as these.")
    ] = False
    interface: Annotated[str | None, option("J,K", "What lies between two labels, out of J; it may be open.")] = None
    interfaces: Annotated[
        bool,
        typer.Option(
            "--interfaces",
            help="All interfaces of labels as one surface, each triangle with the labels on its two sides.",
        ),
    ] = False
    space: SpaceOption = "ras"
    label_names: LabelNamesOption = None


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


def option_words(options: dict[str, Any]) -> list[str]:
    """Options as `given_options` returns them, without arguments, as the words of a command."""
    words = []
    for name, value in options.items():
        if value is True:
            words.append(f"--{name}")
        else:
            words += [f"--{name}={each}" for each in (value if isinstance(value, list) else [value])]
    return words


SubjectsArgument = Annotated[
    Path,
    typer.Argument(metavar="SUBJECTS", help="A table, .tsv or .csv: subject, image, ...; or a BIDS folder."),
]


@dataclass(frozen=True, kw_only=True)
class CohortOptions:
    """What of a cohort is run, where, and by whom."""

    panel: ClassVar[str] = "The cohort"
    output: Annotated[
        Path, option("OUT", "The folder of all outputs; that of an earlier run goes on.", "-o", "--output")
    ]
    suffix: Annotated[
        str, option("WORD", 'Of a BIDS folder: the images\' suffix, with entities before it "acq-mprage_T1w".')
    ] = "T1w"
    participants: Annotated[
        list[str] | None, option("LABEL", "Of the subjects only this one. May be repeated.", "--participant-label")
    ] = None
    sessions: Annotated[
        list[str] | None, option("LABEL", "Of the sessions only this one. May be repeated.", "--session-label")
    ] = None
    mesh_format: Annotated[str, option("SUFFIX", f"Of the meshes' files: {', '.join(FORMATS)}.", "--format")] = ".vtu"
    write_table: Annotated[
        Path | None, option("TABLE", "Write what would be run as a table, .tsv or .csv, and run nothing.")
    ] = None
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Tell what would be run, why, and what it takes; run nothing.")
    ] = False
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Run only those that failed; what has changed stays as it is.")
    ] = False
    collect: Annotated[
        bool, typer.Option("--collect", help="Write the table and the page of what is there; run nothing.")
    ] = False
    count: Annotated[
        int | None, option("N", "So many subjects at a time, or jobs of a --cluster, at most.", "--workers", min=1)
    ] = None
    scheduler: SchedulerOption = None
    cluster: ClusterOption = None


@cache  # as is what else takes as long, since each of 20,000 subjects may have options of its own
def record_names() -> dict[str, bool]:
    """The options of `RunOptions` by their names on the command line, and whether each is a switch, without a value."""
    return {option_name(name, kind): get_args(kind)[0] is bool for name, kind in kinds_of(RunOptions).items()}


def with_options(options: RunOptions, texts: dict[str, str]) -> RunOptions:
    """The options with other values of options, as texts by their names on the command line.

    A switch is on by "1", "true" or "yes" and off by "0", "false" or "no"; several values of an option that may be
    repeated stand between semicolons.

    Raises
    ------
    InputError
        An option that there is not, or a value that is none of it.
    """
    names = record_names()
    words = []
    for name, text in texts.items():
        if name not in names:
            raise InputError(f"{name}: is no option of tetopt mesh" + near_hint(name, names))
        if not names[name]:
            several = name in ("set", "load")
            parts = [part.strip() for part in text.split(";") if part.strip()] if several else [text]
            words += [f"--{name}={part}" for part in parts]
        elif text.lower() in ("1", "true", "yes"):
            words.append(f"--{name}")
        elif text.lower() not in ("0", "false", "no"):
            raise InputError(f'{name}: expected true or false, got "{text}"')
    try:
        parsed = _parsed(tuple(words))
    except InputError:
        raise InputError("; ".join(_wrong_values(texts))) from None
    kinds = kinds_of(RunOptions)
    return replace(
        options, **{name: getattr(parsed, name) for name, kind in kinds.items() if option_name(name, kind) in texts}
    )


def _wrong_values(texts: dict[str, str]) -> Iterator[str]:
    """Which of the options' texts are no values of theirs, in words."""
    for name, text in ((name, text) for name, text in texts.items() if not record_names()[name]):
        try:
            _parsed((f"--{name}={text}",))
        except InputError:
            point = text.replace(",", ".")
            is_comma = point != text and re.fullmatch(r"-?[0-9]*\.[0-9]+", point)
            yield f'{name}: "{text}" is no value of it' + (f"; write {point}" if is_comma else "")


def _parsed(words: tuple[str, ...]) -> RunOptions:
    """The options that words of a command line come to."""
    parsed: list[RunOptions] = []
    try:
        _parser()(list(words), standalone_mode=False, obj=parsed)
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        raise InputError(str(error.format_message())) from error
    return parsed[0]


@cache
def _parser() -> Any:
    """A command that puts the options that its words come to into its context's list."""

    def command(context: typer.Context, options: RunOptions) -> int:
        context.obj.append(options)
        return 0

    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(from_records(command))
    return typer.main.get_command(app)


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

    parameters = [each for name, default in defaults.items() for each in _parameters(name, kinds[name], default)]
    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return called


def _parameters(name: str, kind: Any, default: Any, panel: str | None = None) -> Iterator[inspect.Parameter]:
    """The parameters that stand for one of a command, or for a field of a record."""
    if not is_dataclass(kind):
        annotation = _typed(name, kind, panel)
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        return
    record = cast(type, kind)
    for field in fields(record):
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        own = kinds_of(record)[field.name]
        yield from _parameters(field.name, own, default, _panel_of(record, field.name) or panel)


def _panel_of(record: type, name: str) -> str | None:
    """The panel of the help that a field of a record stands in: that of the first class with one that brings it."""
    bringing = [each for each in reversed(record.__mro__) if name in getattr(each, "__dataclass_fields__", {})]
    return next((each.panel for each in bringing if hasattr(each, "panel")), None)


def _typed(name: str, kind: Any, panel: str | None) -> Any:
    """The annotation as typer takes it, its option in a panel of the help; arguments have one of their own."""
    own = next((each for each in get_args(kind)[1:] if isinstance(each, Option | OptionInfo)), None)
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
