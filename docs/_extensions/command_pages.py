"""Pages of commands, made of the command line itself when the site is built, so that they cannot go
stale.

The directive `synopsis` says what a command does and how it is called, `parameters` lists its
arguments and options panel by panel, each with its kind and default; "bids" is ``python -m
tetopt.bids``. `commands` lists all commands.
"""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from typer.models import ArgumentInfo

from tetopt import bids
from tetopt.cli import main
from tetopt.cli.app import COMMANDS, help_line, loaded_command

BIDS = "bids"  # the page of what containers run
HELP = "--help"  # said once, on the page of all commands


class Parameter(NamedTuple):
    """An argument or option, as its page says it."""

    panel: str
    names: str  # with what its value is called
    text: str
    kind: str  # what a value is, and the default


def parameters(command: str) -> list[Parameter]:
    """Arguments and options of a command in the order of its help, but for `--help`."""
    return list(
        _of_argparse(bids._parser()) if command == BIDS else map(_of_typer, _signature(command))
    )


def synopsis(command: str) -> str:
    """The line that a command is called by: its arguments and the options that it needs."""
    if command == BIDS:
        return bids.USAGE
    own = _signature(command)
    needed = [each.default is inspect.Parameter.empty for each in own]
    names = [_of_typer(each).names for each in own]
    words = [
        name if is_needed else f"[{name}]"
        for name, is_needed, each in zip(names, needed, own, strict=True)
        if _is_argument(each)
    ]
    words += [
        name.split(", ")[0]
        for name, is_needed, each in zip(names, needed, own, strict=True)
        if is_needed and not _is_argument(each)
    ]
    return " ".join(["tetopt", command, *words, "[OPTIONS]"])


def _signature(command: str) -> list[inspect.Parameter]:
    """What typer makes the command of, but for its own context."""
    own = inspect.signature(loaded_command(command), eval_str=True).parameters.values()
    return [each for each in own if get_args(each.annotation)]


def _is_argument(parameter: inspect.Parameter) -> bool:
    return isinstance(_info(parameter), ArgumentInfo)


def _info(parameter: inspect.Parameter) -> Any:
    return get_args(parameter.annotation)[1]


def _of_typer(parameter: inspect.Parameter) -> Parameter:
    info, kind, default = _info(parameter), get_args(parameter.annotation)[0], parameter.default
    is_needed = default is inspect.Parameter.empty
    if _is_argument(parameter):
        return Parameter(
            "Arguments", info.metavar, info.help or "", "" if is_needed else "optional"
        )
    # In an annotation typer takes an option's first name for a default.
    names = [*([info.default] if isinstance(info.default, str) else []), *(info.param_decls or ())]
    spelled = [each for name in names for each in name.split("/")]
    is_switch = bool in _each(kind)
    choices = _choices(kind)
    value = "" if is_switch else f" {info.metavar or '|'.join(choices)}"
    words = _kind(kind, choices, info.min)
    if is_needed:
        words += ", required"
    elif default not in (None, "", False) and "by default" not in info.help:
        words += f"; by default {_shown(default)}"
    with_values = ", ".join(f"{name}{value}" for name in spelled)
    return Parameter(info.rich_help_panel or "Options", with_values, info.help, words)


def _kind(kind: Any, choices: list[str], low: float | None) -> str:
    """What a value of a type is, in words."""
    several = [each for each in get_args(kind) if each is not type(None)]
    if not choices and several:
        return _kind(several[0], choices, low)
    words = {
        int: "an integer",
        float: "a number",
        str: "a string",
        Path: "a path",
        bool: "a switch",
    }
    return (f"one of {', '.join(choices)}" if choices else words[kind]) + (
        "" if low is None else f", {low:g} or more"
    )


def _each(kind: Any) -> list[Any]:
    return [kind, *get_args(kind)]


def _choices(kind: Any) -> list[str]:
    """The words that an option takes, if it takes a few only."""
    return [
        str(word) for each in _each(kind) if get_origin(each) is Literal for word in get_args(each)
    ]


def _shown(value: Any) -> str:
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def _of_argparse(parser: argparse.ArgumentParser) -> Iterator[Parameter]:
    places = {
        "BIDS_DIR": "The folder of the dataset.",
        "OUT": "The folder of all outputs.",
        "{participant,group}": "The level: the meshes of subjects, or the table and the page of "
        "all of them.",
    }
    for name, text in places.items():
        yield Parameter("Arguments", name, text, "")
    for each in parser._actions:
        if HELP in each.option_strings:
            continue
        value = f" {each.metavar} ..." if each.nargs == "+" else ""
        names = ", ".join(f"{name}{value}" for name in each.option_strings)
        text = (each.help or "").strip()
        kind = "one or more texts" if value else "a switch"
        yield Parameter("Options", names, f"{text[:1].upper()}{text[1:].rstrip('.')}.", kind)


def marked(text: str) -> str:
    """A help text as Markdown: what is quoted and what are options as code, and no other sign
    with a meaning.
    """
    parts = re.split(r'("[^"]+"|`[^`]+`|(?<![\w-])--?[a-z][a-z-]*(?![\w-]))', text)
    escaped = [re.sub(r"([\\*_<>\[\]{}|~$#`])", r"\\\1", part) for part in parts[::2]]
    code = [
        f"`{part.strip('`')}`" if not part.startswith('"') else f"`{part[1:-1]}`"
        for part in parts[1::2]
    ]
    return "".join(a + b for a, b in zip(escaped, [*code, ""], strict=True))


class SynopsisDirective(SphinxDirective):
    """What a command does, and how it is called."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes in the page's place."""
        name = self.arguments[0]
        _note_sources(self)
        words = summary(name) if name == BIDS else inspect.getdoc(loaded_command(name)) or ""
        return self.parse_text_to_nodes(
            "\n".join([marked(words), "", "```text", synopsis(name), "```"])
        )


class ParametersDirective(SphinxDirective):
    """All arguments and options of a command, a section for each panel."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes in the page's place."""
        name = self.arguments[0]
        _note_sources(self)
        lines = [f"```{{program}} {'tetopt.bids' if name == BIDS else f'tetopt {name}'}", "```", ""]
        for title in _panels(name):
            lines += [f"## {title}", ""]
            for each in [each for each in parameters(name) if each.panel == title]:
                kind = f" *{each.kind[:1].upper()}{each.kind[1:]}.*" if each.kind else ""
                lines += [f"```{{option}} {each.names}", "", marked(each.text) + kind, "```", ""]
        return self.parse_text_to_nodes("\n".join(lines), allow_section_headings=True)


def _note_sources(directive: SphinxDirective) -> None:
    """Rewrite the page if the command line has changed since."""
    for path in sorted(Path(inspect.getfile(main)).parent.glob("*.py")):
        directive.env.note_dependency(str(path))


def _panels(name: str) -> list[str]:
    """The panels of a command: arguments and general options before its others."""
    panels = list(dict.fromkeys(each.panel for each in parameters(name)))
    first = [each for each in ("Arguments", "Options") if each in panels]
    return [*first, *(each for each in panels if each not in first)]


def summary(name: str) -> str:
    """Return a command as one line."""
    return (
        help_line(name)
        if name in COMMANDS
        else (bids.__doc__ or "").splitlines()[0].split(": ", 1)[1]
    )


class CommandsDirective(SphinxDirective):
    """All commands, each with its line and a link to its page."""

    def run(self) -> list[nodes.Node]:
        """The nodes in the page's place."""
        _note_sources(self)
        return self.parse_text_to_nodes("\n".join(listed()))


def listed() -> list[str]:
    """A line of Markdown for each command."""
    names = {**{name: f"tetopt {name}" for name in COMMANDS}, BIDS: "python -m tetopt.bids"}
    return [f"- [`{words}`]({name}.md): {marked(summary(name))}" for name, words in names.items()]


def setup(app: Sphinx) -> dict[str, bool]:
    """The directives."""
    app.add_directive("synopsis", SynopsisDirective)
    app.add_directive("parameters", ParametersDirective)
    app.add_directive("commands", CommandsDirective)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
