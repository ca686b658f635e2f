"""Other processes of Python, by which kernels are compiled, files read and pipelines run."""

from __future__ import annotations

import os
import sys


def python_command(*words: str) -> list[str]:
    """This Python with these arguments.

    With -P: the modules of the current folder are not its own, which may be a stranger's as much as its files.
    """
    return [sys.executable, "-P", *words]


def python_environment(**names: str) -> dict[str, str]:
    """The environment of such a process: it imports from where this one does; `names` besides."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))} | names
