"""The reference's pages of commands: one for each, with every argument and option of its help."""

import re
import sys
from pathlib import Path

import pytest

from tetopt.cli import main
from tetopt.cli.app import COMMANDS, SHOWN_OPTIONS

pytestmark = pytest.mark.full

DOCS = Path(__file__).resolve().parents[1] / "docs"
sys.path.insert(0, str(DOCS / "_extensions"))
command_pages = pytest.importorskip("command_pages")


@pytest.mark.parametrize("command", [*COMMANDS, "bids"])
def test_page(command):
    """The page has the command's synopsis and, if it takes any, its parameters; the list of
    pages names it.
    """
    page = (DOCS / "reference" / "commands" / f"{command}.md").read_text(encoding="utf-8")
    assert f"```{{synopsis}} {command}\n" in page
    assert (f"```{{parameters}} {command}\n" in page) == bool(command_pages.parameters(command))
    assert "**Exit codes.**" in page
    index = (DOCS / "reference" / "commands" / "index.md").read_text(encoding="utf-8")
    assert f"\n{command}\n" in index


@pytest.mark.parametrize("command", ["mesh", "fem", "compare", "warm-up"])
def test_options_are_those_of_the_help(command, capsys, monkeypatch):
    """Every option that the whole help prints is on the page, and no other."""
    monkeypatch.setenv("COLUMNS", "200")
    main([command, "--help-all" if command in SHOWN_OPTIONS else "--help"])
    rows = re.findall(
        r"^│ [* ]{0,3}((?:--?[a-z][a-z-]* +)+)", capsys.readouterr().out, re.MULTILINE
    )
    of_help = {name for row in rows for name in row.split()} - {"--help", "-h"}
    assert "--force" in of_help or command == "warm-up"
    names = " ".join(
        each.names for each in command_pages.parameters(command) if each.panel != "Arguments"
    )
    assert set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", names)) == of_help


def test_kinds_and_defaults():
    """What a value is and its default are those of the command's signature."""
    by_name = {
        each.names: each
        for command in ("mesh", "compare", "fem")
        for each in command_pages.parameters(command)
    }
    assert by_name["--iterations I"].kind == "an integer, 0 or more"
    assert by_name["--iterations I"].panel == "Optimisation"
    assert by_name["--method fast|paper"].kind == "one of fast, paper; by default `fast`"
    assert by_name["--max-seconds S"].kind == "a number; by default `3600`"
    assert by_name["--conditioning, --no-conditioning"].kind == "a switch"
    assert command_pages.synopsis("mesh") == "tetopt mesh IMAGE... -o MESH [OPTIONS]"


def test_marked():
    """Signs that mean something in Markdown are escaped; what is quoted and options are code."""
    text = 'a*b <c>, "0.5 + 0.01*h", --load, -o, two-way, [d]'
    assert (
        command_pages.marked(text) == r"a\*b \<c\>, `0.5 + 0.01*h`, `--load`, `-o`, two-way, \[d\]"
    )


def test_all_commands_are_listed():
    """Each with a link to its page and its line."""
    lines = command_pages.listed()
    assert len(lines) == len(COMMANDS) + 1
    assert (
        "- [`tetopt phantom`](phantom.md): Write a phantom as an image of known shapes and "
        "intensities." in lines
    )
    assert lines[-1].startswith(
        "- [`python -m tetopt.bids`](bids.md): `tetopt cohort` with the arguments"
    )
