"""Other processes of Python, by which kernels are compiled, files read, pipelines run and tasks worked on.

None of them imports modules of the current folder, which may be as untrusted as its files: neither those that
are started here, nor what they start, nor those of libraries.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# Numba's, read as it is loaded. Not those of BLAS, which dask leaves one: its rounding depends on them.
THREADS_NAME = "NUMBA_NUM_THREADS"
SAFE_PATH_NAME = "PYTHONSAFEPATH"  # python -P, also of whatever a process starts


def python_command(*words: str) -> list[str]:
    """Return the command of this Python with these arguments."""
    return [sys.executable, "-P", *words]


def python_environment(**names: str) -> dict[str, str]:
    """Return the environment of such a process, which imports from where this one does, with `names` added."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), SAFE_PATH_NAME: "1"} | names


def others_environment() -> dict[str, str]:
    """Return the environment of a program of the user's, which may be Python and import what lies beside it."""
    return {name: value for name, value in os.environ.items() if name != SAFE_PATH_NAME}


@contextmanager
def safe_path() -> Iterator[None]:
    """Keep processes of Python that libraries start within the block from importing modules of the current folder."""
    before = os.environ.get(SAFE_PATH_NAME)
    os.environ[SAFE_PATH_NAME] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH_NAME]
        else:
            os.environ[SAFE_PATH_NAME] = before
