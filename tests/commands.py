"""The command as its tests call it."""

import json

from tetopt.cli import main


def exit_code(*words):
    """What `tetopt` with these words, or paths, returns."""
    return main([str(word) for word in words])


def mesh_words(image, folder, *options):
    """`tetopt mesh` of an image, to a.vtu and a.json in a folder."""
    return ["mesh", image, "-o", folder / "a.vtu", "--json", folder / "a.json", *options]


def numbers_in(path):
    """What a JSON file holds."""
    return json.loads(path.read_text())
