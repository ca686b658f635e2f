"""The command as its tests call it."""

import json
import re

from models import sample_image

import tetopt
from tetopt.cli import main


def exit_code(*words):
    """What `tetopt` with these words, or paths, returns."""
    return main([str(word) for word in words])


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
        "--spacing",
        "8",
        "--iterations",
        "0",
    ]


def numbers_in(path):
    """What a JSON file holds."""
    return json.loads(path.read_text())


def assert_refused(capfd, arguments, match, code=2):
    assert exit_code(*arguments) == code
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    assert captured.err.startswith("tetopt: ")
    assert re.search(match, captured.err), captured.err
