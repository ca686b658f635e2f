"""Where compiled kernels are kept: beside the package, else in the user's cache, else only as long as the process."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from functools import cache
from pathlib import Path


@cache
def place_cache() -> str | None:
    """See to it that numba finds a folder for its cache; what to tell the user if that is only a temporary one.

    numba refuses to load a function whose result it cannot keep anywhere. It looks in NUMBA_CACHE_DIR, else beside the
    source, else in the user's cache folder.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    folders = [Path(chosen)] if chosen else [Path(__file__).parent / "__pycache__", _user_cache() / "numba"]
    if any(_can_be_written(folder) for folder in folders):
        return None
    temporary = tempfile.mkdtemp(prefix="tetopt-kernels-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = temporary
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = temporary
    return (
        f"kernels are compiled anew in each run, half a minute: {' and '.join(map(str, folders))} cannot be written; "
        "set NUMBA_CACHE_DIR to a folder that can"
    )


def _user_cache() -> Path:
    """As numba has it."""
    home = Path(os.path.expanduser("~"))
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")


def _can_be_written(folder: Path) -> bool:
    """Whether a folder takes new files, made if it is not there, as numba tries it: rights alone do not tell."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
