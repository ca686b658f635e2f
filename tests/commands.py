"""The command as its tests call it."""

import io
import json
import os
import re
import shlex
import shutil
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest
from models import sample_image

import tetopt
from tetopt.cli import main


def separate(words):
    """The words of a command line: a string holds what a user types, a path is one word."""
    words = [words] if isinstance(words, str) else words
    return [
        part
        for word in words
        for part in (shlex.split(word) if isinstance(word, str) else [str(word)])
    ]


def exit_code(*words):
    """What `tetopt` with these words, or paths, returns."""
    return main(separate(words))


def assert_done(*words):
    assert exit_code(*words) == 0


def in_copy_of(name):
    """A fixture for a module: each test works in a folder of its own, with copies of the files
    that the fixture `name` has made; it returns names of what the test adds.
    """

    @pytest.fixture(autouse=True)
    def here(request, tmp_path):
        shutil.copytree(request.getfixturevalue(name), tmp_path, dirs_exist_ok=True)
        with chdir(tmp_path):
            before = set(os.listdir())
            yield lambda: sorted(set(os.listdir()) - before)

    return here


def mesh_words(image, folder, *options):
    """`tetopt mesh` of an image, to a.vtu and a.json in a folder."""
    return ["mesh", image, "-o", folder / "a.vtu", "--json", folder / "a.json", *options]


def labelled_lattice_words(folder):
    """`tetopt mesh` of an image and its labels, written to a folder, as a lattice of 60 nodes;
    no output yet.
    """
    image = sample_image(3)
    tetopt.save_image(folder / "a.nii.gz", image)
    tetopt.save_image(folder / "l.nii.gz", tetopt.Image(1.0 * (image.data > 30), image.affine))
    return [
        "mesh",
        folder / "a.nii.gz",
        "--labels",
        folder / "l.nii.gz",
        "--spacing 8 --iterations 0",
    ]


def numbers_in(path):
    """What a JSON file holds."""
    return json.loads(Path(path).read_text())


class Printed(NamedTuple):
    out: str
    err: str


def run_command(*words, code=0):
    """What `tetopt` prints, which returns the code, or 0 or 1 where that is None."""
    texts = [
        io.TextIOWrapper(io.BytesIO(), encoding="utf-8", newline="", write_through=True)
        for _ in range(2)
    ]
    with redirect_stdout(texts[0]), redirect_stderr(texts[1]):
        ended = exit_code(*words)
    printed = Printed(*[text.buffer.getvalue().decode() for text in texts])
    assert ended in ((0, 1) if code is None else (code,)), printed.err
    return printed


def assert_refuses(words, said, code=2):
    """A line says so, a part or pattern of which is known, and nothing is written."""
    files = files_here()
    out, err = run_command(*[words] if isinstance(words, str) else words, code=code)
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("tetopt: ")
    assert said in err or re.search(said, err), err
    assert files_here() == files


def assert_refused(capture, words, said, code=2):
    """`assert_refuses`; nothing else is printed, also by libraries."""
    capture.readouterr()
    assert_refuses(words, said, code)
    assert capture.readouterr() == ("", "")


def refusals(text):
    """A test of each command line of a text; the line after it has a part or pattern of what is
    said.
    """
    rows = re.findall(r"^(\S.*)\n +(.*)$", text, re.MULTILINE)

    @pytest.mark.parametrize(("words", "said"), rows, ids=[words for words, _ in rows])
    def test_refused(words, said, capfd):
        assert_refused(capfd, words, said)

    return test_refused


def files_here():
    """Those in the folder that a test works in, and their bytes; none in the repository, where
    others write.
    """
    if Path("pyproject.toml").exists():
        return {}
    return {path: path.is_file() and path.read_bytes() for path in Path().rglob("*")}
