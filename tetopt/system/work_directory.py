"""Work directories: the folders of unfinished cohorts (OUT/.work), made by tetopt for its owner
alone. A lock file tells one from a folder of the user's.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from tetopt.errors import InputError
from tetopt.system.incoming import irregular
from tetopt.system.lock import HAS_LOCKS, lock_file

WORK_LOCK_NAME = "tetopt-lock"


def check(path: Path) -> None:
    """Raise InputError for anything but a work directory, or an empty folder, which may become
    one.
    """
    kind = irregular(path, follow=False) or "a file"
    if kind == "a folder" and any(path.iterdir()) and not (path / WORK_LOCK_NAME).is_file():
        kind = f"a folder without {WORK_LOCK_NAME}"
    elif kind == "a folder":
        return
    raise InputError(
        f"{path}: expected a work directory of tetopt's, got {kind}; move it away and run this "
        "again"
    )


def create(path: Path) -> None:
    """Create a work directory if it is missing; InputError for the reasons of `check`."""
    with suppress(FileExistsError):
        path.mkdir(mode=0o700)
    check(path)
    if not (path / WORK_LOCK_NAME).exists():
        path.chmod(0o700)
        (path / WORK_LOCK_NAME).touch()


@contextmanager
def lock_directory(path: Path, keys: Sequence[str] | None) -> Iterator[None]:
    """Lock a work directory, created if missing, for a single run; with `keys`, runs of other keys
    may share it.

    A lock ends with its process, even if the process is killed.

    Raises
    ------
    InputError
        For the reasons of `check`; another run holds it or one of the keys.
    """
    create(path)
    with ExitStack() as stack:
        _lock(stack, path / WORK_LOCK_NAME, str(path), is_shared=keys is not None)
        for key in keys or ():
            _lock(stack, path / f"{key}.lock", f"{path}: {key}", is_shared=False)
        yield


def _lock(stack: ExitStack, path: Path, what: str, *, is_shared: bool) -> None:
    """Lock a file until the stack is unwound; it names the run, unless others share the lock."""
    if path.is_symlink():  # another file would be emptied
        raise InputError(
            f"{path}: expected a regular file, got a link; move it away and run this again"
        )
    if not HAS_LOCKS:
        return
    stream = stack.enter_context(path.open("a+", encoding="utf-8", errors="replace"))
    if not lock_file(stream, is_shared=is_shared):
        stream.seek(0)
        whose = stream.read(200).strip() or "another process"
        raise InputError(
            f"{what}: another run is writing there ({whose}); wait until it ends, or stop it"
        )
    stream.truncate(0)
    if not is_shared:
        stack.callback(stream.truncate, 0)
        stream.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        stream.flush()
