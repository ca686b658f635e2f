"""The command as its tests call it."""

import json
import os
import re
import shlex
import shutil
from contextlib import chdir
from pathlib import Path

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


def assert_refused(capture, words, said, code=2):
    """A line says so, a part or pattern of which is known, and nothing is written."""
    capture.readouterr()
    files = files_here()
    assert main(separate(words)) == code
    captured = capture.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    assert captured.err.startswith("tetopt: ")
    assert said in captured.err or re.search(said, captured.err), captured.err
    assert files_here() == files


def files_here():
    """Those in the folder that a test works in; none in the repository, where others write."""
    return set() if Path("pyproject.toml").exists() else set(Path().rglob("*"))
