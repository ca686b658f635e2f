"""The folder of compiled kernels: next to the package, else the user's cache, else a temporary one
for this process.

numba runs the code that it reads there. World-writable folders are therefore not used, whoever owns
them, and the code is in subfolders that nobody but their owner can write to.
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
    """Return the subfolder of this name, created if missing, as a copy of the one in `BESIDE` if
    there is one.

    The latter has the kernels that `tetopt warm-up` compiled for all users, or for a read-only
    container.

    Raises
    ------
    OSError
        It cannot be created, or another user could have written to it.
    """
    if (place := place_cache().folder) is None:
        return None
    folder, shipped = place / name, BESIDE / name
    if not folder.exists():
        new = Path(tempfile.mkdtemp(prefix="tetopt-", dir=place))
        if shipped.is_dir():
            # it may not be read, or not be trusted: kernels are compiled again
            with contextlib.suppress(OSError):
                _check_trusted(shipped)
                shutil.copytree(shipped, new, dirs_exist_ok=True)
            new.chmod(0o700)
        try:
            new.rename(folder)
        except OSError:  # another process was faster
            shutil.rmtree(new)
    _check_trusted(folder)
    return folder


def share_with_all(folder: Path) -> None:
    """Let all users read a folder, but only its owner write to it."""
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755 if path.is_dir() else 0o644)


def _check_trusted(folder: Path) -> None:
    """Raise PermissionError if another user could have written to a folder that others can
    enter, or to its files.
    """
    is_closed = os.lstat(folder).st_mode & 0o077 == 0
    for path in [folder, *(() if is_closed else folder.rglob("*"))]:
        if (words := _distrust(os.lstat(path))) is not None:
            raise PermissionError(
                f"another user could have written those in {folder} ({path.name} {words})"
            )


def _distrust(status: os.stat_result) -> str | None:
    """Return why a file or folder is not trusted, in words; None if it is.

    Trusted owners are this user, root and the owner of the package: they may run code in this
    process anyway. The status comes from `os.lstat`, because links are not followed.
    """
    if os.name != "posix":
        return None
    if stat.S_ISLNK(status.st_mode):
        return "is a link"
    if status.st_uid not in (os.geteuid(), 0, os.stat(__file__).st_uid):
        return f"belongs to user {status.st_uid}"
    is_open = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return "is writable by users other than its owner" if is_open else None


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
