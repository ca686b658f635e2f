"""The folder of compiled kernels: next to the package, else the user's cache, else a temporary one for this process.

Kernels next to the package are always read.
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

# Modes of new folders and files, whatever the umask: only the owner may write.
FOLDER_MODE, FILE_MODE = 0o755, 0o644


class Place(NamedTuple):
    """The place where numba keeps compiled code."""

    folder: Path | None  # None if there is none
    notice: str | None  # a message for the user if kernels are not kept for later runs


@cache
def place_cache() -> Place:
    """Make sure that numba finds a folder for its cache, at least a temporary one.

    numba looks in NUMBA_CACHE_DIR, else next to the source, else in the user's cache folder, and runs the code that it
    reads there. World-writable folders are therefore not used, whoever owns them. Subfolders, and the folder next to
    the source, must not be writable by anyone else at all (`untrusted`).
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    beside = Path(__file__).parents[1] / "__pycache__"
    folders = [Path(chosen)] if chosen else [beside, _user_cache() / "numba"]
    refusals = [(folder, _refusal(folder, is_within=folder == beside)) for folder in folders]
    usable = [folder for folder, refusal in refusals if refusal is None]
    if usable:
        if not chosen and usable[0] != folders[0]:
            _point_numba_to(usable[0])
        return Place(usable[0], None)
    temporary = None
    with contextlib.suppress(OSError):  # no folder is writable
        temporary = Path(tempfile.mkdtemp(prefix="tetopt-kernels-"))
    if temporary is not None:
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        _point_numba_to(temporary)
    return Place(
        temporary,
        f"each run recompiles the kernels, which takes {'half a minute' if temporary else 'a minute'}: "
        f"{' and '.join(f'{folder} {refusal}' for folder, refusal in refusals)}; "
        "set NUMBA_CACHE_DIR to a folder that only you can write",
    )


def untrusted(status: os.stat_result) -> str | None:
    """Return why a file or folder of the cache is not trusted, in words; None if it is.

    Trusted owners are this user, root and the owner of the package: they may run code in this process anyway. The
    status comes from `os.lstat`, because links are not followed.
    """
    if os.name != "posix":
        return None
    if stat.S_ISLNK(status.st_mode):
        return "is a link"
    if status.st_uid not in (os.geteuid(), 0, os.stat(__file__).st_uid):
        return f"belongs to user {status.st_uid}"
    is_open = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return "is writable by users other than its owner" if is_open else None


def _point_numba_to(folder: Path) -> None:
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)


def _user_cache() -> Path:
    """Return the user's cache folder, as numba determines it."""
    home = Path(os.path.expanduser("~"))  # "~" itself if there is no home
    home = home if home.is_absolute() else Path(os.devnull)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")


def _refusal(folder: Path, *, is_within: bool) -> str | None:
    """Return why a folder cannot hold the cache; create it if missing and write to it, as permissions do not suffice.

    `is_within`: the folder holds the files themselves, not subfolders with them.
    """
    try:
        for part in [*reversed(folder.parents), folder]:
            if not part.exists():
                part.mkdir(mode=FOLDER_MODE, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if is_within:
            return untrusted(os.lstat(folder))
        is_open = os.name == "posix" and folder.stat().st_mode & stat.S_IWOTH
    except OSError:
        return "is not writable"
    return "is world-writable" if is_open else None
