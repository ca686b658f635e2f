"""The folder of compiled kernels: next to the package, else the user's cache, else a temporary one
for this process.

numba runs the code that it reads there. World-writable folders are therefore not used, whoever owns
them, and the code is in subfolders that nobody but their owner can enter.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

BESIDE = Path(__file__).parents[1] / "__pycache__"


class Place(NamedTuple):
    """The place of compiled code."""

    folder: Path | None  # None if there is none
    notice: str | None  # a message for the user if kernels are not kept for later runs


@cache
def place_cache() -> Place:
    """Return the first of these folders that can be written: NUMBA_CACHE_DIR alone, or `BESIDE` and
    the user's cache.

    Otherwise there is a temporary one, which processes started by this one use as well.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    folders = [Path(chosen)] if chosen else [BESIDE, _user_cache() / "numba"]
    refusals = [(folder, _refusal(folder)) for folder in folders]
    if usable := [folder for folder, refusal in refusals if refusal is None]:
        return Place(usable[0], None)
    temporary = None
    with contextlib.suppress(OSError):  # no folder is writable
        temporary = Path(tempfile.mkdtemp(prefix="tetopt-kernels-"))
    if temporary is not None:
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        os.environ["NUMBA_CACHE_DIR"] = str(temporary)
    return Place(
        temporary,
        "each run recompiles the kernels, which takes "
        f"{'half a minute' if temporary else 'a minute'}: "
        f"{' and '.join(f'{folder} {refusal}' for folder, refusal in refusals)}; "
        "set NUMBA_CACHE_DIR to a folder that only you can write",
    )


def own_folder(name: str) -> Path | None:
    """Return the subfolder of this name, which only this user may enter; create it if missing.

    Raises
    ------
    OSError
        It cannot be created, or another user could have written to it.
    """
    if (place := place_cache().folder) is None:
        return None
    folder = place / name
    folder.mkdir(mode=0o700, exist_ok=True)
    status = os.lstat(folder)  # which does not follow links
    is_private = stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o077
    if os.name == "posix" and not (is_private and status.st_uid == os.geteuid()):
        raise PermissionError(f"another user could have written those in {folder}; remove it")
    return folder


def _user_cache() -> Path:
    """Return the user's cache folder, as numba determines it."""
    home = Path(os.path.expanduser("~"))  # "~" itself if there is no home
    home = home if home.is_absolute() else Path(os.devnull)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")


def _refusal(folder: Path) -> str | None:
    """Return why a folder cannot hold the cache; create it if missing and write to it:
    permissions do not suffice.
    """
    try:
        for part in [*reversed(folder.parents), folder]:
            if not part.exists():
                part.mkdir(mode=0o755, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        is_open = os.name == "posix" and folder.stat().st_mode & stat.S_IWOTH
    except OSError:
        return "is not writable"
    return "is world-writable" if is_open else None
