"""Other Python processes, which compile kernels, read files, run pipelines and work on tasks.

None of them imports modules from the current folder, which may be as untrusted as its files. This
holds for processes started here, for those that they start, and for those of libraries.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# Numba reads this variable when it is imported. Those of BLAS, which dask sets to one, stay: its
# rounding depends on the number of threads.
THREADS_NAME = "NUMBA_NUM_THREADS"
# the same as python -P, inherited by all processes that a process starts
SAFE_PATH_NAME = "PYTHONSAFEPATH"


def python_command(*words: str) -> list[str]:
    """Return the command of this Python with these arguments."""
    return [sys.executable, "-P", *words]


def python_environment(**names: str) -> dict[str, str]:
    """Return the environment of such a process, which imports from the same folders as this one;
    adds `names`.
    """
    return (
        os.environ
        | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), SAFE_PATH_NAME: "1"}
        | names
    )


def others_environment() -> dict[str, str]:
    """Return the environment of a user's program, which may be in Python and import modules from
    its own folder.
    """
    return {name: value for name, value in os.environ.items() if name != SAFE_PATH_NAME}


@contextmanager
def safe_path() -> Iterator[None]:
    """Keep Python processes that libraries start within the block from importing modules of the
    current folder.
    """
    before = os.environ.get(SAFE_PATH_NAME)
    os.environ[SAFE_PATH_NAME] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH_NAME]
        else:
            os.environ[SAFE_PATH_NAME] = before
