"""Where compiled kernels are kept: beside the package, else in the user's cache, else only as long as the process.

Those beside the package are read in any case.
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

# Of what is made here, whatever the mask: only the owner may write.
FOLDER_MODE, FILE_MODE = 0o755, 0o644


class Place(NamedTuple):
    """Where numba keeps what it compiles."""

    folder: Path | None  # None: nowhere
    notice: str | None  # what to tell the user, if it is not kept for later runs


@cache
def place_cache() -> Place:
    """See to it that numba finds a folder for its cache, at least a temporary one.

    numba looks in NUMBA_CACHE_DIR, else beside the source, else in the user's cache folder. What it reads there is
    code that it runs: a folder that everybody may write is not used, whoever it belongs to. In folders within it, and
    beside the source, nobody else may write at all (`untrusted`).
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
    with contextlib.suppress(OSError):  # there is nowhere to write at all
        temporary = Path(tempfile.mkdtemp(prefix="tetopt-kernels-"))
    if temporary is not None:
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        _point_numba_to(temporary)
    return Place(
        temporary,
        f"kernels are compiled anew in each run, {'half a minute' if temporary else 'a minute'}: "
        f"{' and '.join(f'{folder} {refusal}' for folder, refusal in refusals)}; "
        "set NUMBA_CACHE_DIR to a folder that only you can write",
    )


def untrusted(status: os.stat_result) -> str | None:
    """Return who else can have written a file or folder of the cache, in words; None if nobody can.

    This user, root and the owner of the package can: each of them may run code in this process anyway. The status is
    that of `os.lstat`, as a link is not followed.
    """
    if os.name != "posix":
        return None
    if stat.S_ISLNK(status.st_mode):
        return "is a link"
    if status.st_uid not in (os.geteuid(), 0, os.stat(__file__).st_uid):
        return f"belongs to user {status.st_uid}"
    is_open = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return "can be written by others than its owner" if is_open else None


def _point_numba_to(folder: Path) -> None:
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)


def _user_cache() -> Path:
    """As numba has it."""
    home = Path(os.path.expanduser("~"))  # "~" itself where nobody knows one
    home = home if home.is_absolute() else Path(os.devnull)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")


def _refusal(folder: Path, *, is_within: bool) -> str | None:
    """Why a folder is none for the cache, made if it is not there; numba's way to see: rights alone do not tell.

    `is_within`: it has the files itself, not folders of them.
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
        return "cannot be written"
    return "can be written by everybody" if is_open else None
