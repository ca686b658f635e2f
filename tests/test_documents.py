"""What the documents tell a reader to type is what tetopt takes: Start is run and prints what it
shows, all the rest is parsed to the end.
"""

import ast
import re
import shlex
from pathlib import Path

import pytest
import typer

import tetopt
from tetopt.cli import main
from tetopt.cli.app import COMMANDS, loaded_command

pytestmark = pytest.mark.deep

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = sorted(
    page
    for page in DOCS.rglob("*.md")
    if "_build" not in page.parts and "gallery" not in page.parts
)
LESSON = [DOCS / "start" / f"{name}.md" for name in ("install", "first_mesh", "what_came_out")]
SHOWN = re.compile(r"^(`{3,}|~{3,})(bash|python|text)$\n(.*?)^\1$", re.DOTALL | re.MULTILINE)
COST = re.compile(r"\d+(\.\d+)? (s|GB|MB)\b")
FENCE = re.compile(r"^(`{3,}|~{3,})(bash|python)$\n(.*?)^\1$", re.DOTALL | re.MULTILINE)


def blocks(page, language):
    """The text of each block of code of this language on a page."""
    return [
        text
        for _, name, text in FENCE.findall(page.read_text(encoding="utf-8"))
        if name == language
    ]


def commands_in(text):
    """The words after `tetopt` of each command; a line that ends in a backslash goes on."""
    lines = text.replace("\\\n", " ").splitlines()
    return [
        words[1:]
        for words in (shlex.split(line, comments=True) for line in lines)
        if words[:1] == ["tetopt"]
    ]


def commands(page):
    """Those of all of a page's bash blocks."""
    return commands_in("\n".join(blocks(page, "bash")))


def names_of_tetopt(tree):
    """What a program takes from tetopt, as dotted names: `tetopt.x` and `from tetopt.y import
    x`.
    """
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id == "tetopt"
        ):
            yield node.attr


@pytest.fixture(scope="module")
def parsers():
    """Of each command its parser, made once, as the command line makes it."""
    made = {}

    def parser(name):
        if name not in made:
            app = typer.Typer(add_completion=False)
            app.command(name)(loaded_command(name))
            made[name] = typer.main.get_command(app)
        return made[name]

    return parser


@pytest.mark.parametrize(
    "page", [page for page in PAGES if commands(page)], ids=lambda page: page.stem
)
def test_commands_are_parsed(page, parsers):
    """An option that is gone, a value of another kind, an argument too many: all refused by the
    parser.
    """
    for name, *words in commands(page):
        if name != "--version":
            assert name in COMMANDS, name
            parsers(name).make_context(name, words)


def test_a_command_that_is_wrong_is_refused(parsers):
    for wrong in (["--nodes", "many"], ["--no-such-option"]):
        with pytest.raises(Exception, match=wrong[0].strip("-")):
            parsers("mesh").make_context("mesh", ["a.nii", "-o", "a.vtu", *wrong])


@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.stem
)
def test_programs_are_compiled_and_their_names_exist(page):
    for program in blocks(page, "python"):
        for name in names_of_tetopt(ast.parse(program, page.name)):
            assert hasattr(tetopt, name), f"tetopt.{name}"


def test_the_lesson_runs(tmp_path, monkeypatch, capsys):
    """Start, from its first command to its last program: the output has each line that it shows,
    but for times, memory and sizes of files. Programs that mesh get fewer nodes.
    """
    monkeypatch.chdir(tmp_path)
    printed = ""
    for page in LESSON:
        for _, language, text in SHOWN.findall(page.read_text(encoding="utf-8")):
            if language == "bash":
                for words in commands_in(text):
                    if words[0] != "warm-up":
                        assert main(words) == 0, words
            elif language == "python":
                exec(compile(text.replace("5000", "150"), page.name, "exec"), {})
            else:
                lines = COST.sub("#", printed).splitlines()
                missing = set(COST.sub("#", text).splitlines()) - {"..."} - set(lines)
                assert not missing, page.name
            printed += "".join(capsys.readouterr())
    written = {path.name for path in tmp_path.iterdir()} - {"T1.nii.gz"}
    pictures = {"slice.png", "rho.png", "energies.png", "thumbnail.png"}
    assert (
        written
        == {"brain.vtu", "brain_too.vtu", "brain_job.inp", "run.json", "look.html"} | pictures
    )
