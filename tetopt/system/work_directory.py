"""Work directories: the files of unfinished runs on disk, which are not trusted until they are checked.

A cohort (OUT/.work) and a mesh in parts (MESH.work) each have one. Only the owner can open it
(0700), and its manifest lists the names that tetopt writes and removes there. A run begins only if it contains nothing
but files and folders with these names: no links, pipes, devices or other files. It is opened, checked and removed by
its descriptor, which no link can redirect; Windows has no descriptors of folders, so paths are checked there instead.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import stat
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError
from tetopt.system.files import TEMPORARY_LETTERS, save_json
from tetopt.system.incoming import KINDS_OF_FILES, UNFOLLOWED, irregular, own_bytes
from tetopt.system.lock import HAS_LOCKS, lock_file

HAS_DESCRIPTORS = hasattr(os, "O_DIRECTORY")  # of folders; Windows has none
MANIFEST_NAME, LOCK_NAME = "tetopt-manifest", "lock"
MANIFEST_BYTES = 10_000  # at most: tetopt's own have about 200
# Temporary names of `tetopt.system.files.written_whole`; a killed run leaves such files behind.
TEMPORARY = re.compile(rf"\.(.{{1,{TEMPORARY_LETTERS}}})\.[a-z0-9_]{{8}}.{{0,20}}")
# Files that systems create: files removed while open on NFS, and those of macOS's Finder.
SYSTEM_NAMES = r"\.nfs[0-9a-f]+|\.DS_Store"
ADVICE = "move it away and run this again"


class Layout(NamedTuple):
    """The names in a work directory, as regular expressions."""

    work: str  # a description of the run that it belongs to
    files: str
    folders: dict[str, str | None] = {}  # noqa: RUF012 (not changed): the names of the files in each; None: not opened

    def problem(self, name: str, mode: int) -> str | None:
        """Return what is wrong with an entry of this name and mode; None for one of tetopt's."""
        if any(re.fullmatch(folder, name) for folder in self.folders):
            return None if stat.S_ISDIR(mode) else f"expected a folder, got {_kind(mode)}"
        if re.fullmatch(f"{MANIFEST_NAME}|{SYSTEM_NAMES}|{self.files}", name) or self._is_temporary(name):
            return None if stat.S_ISREG(mode) else f"expected a regular file, got {_kind(mode)}"
        return f"not a file of tetopt's work directory ({self.work})"

    def _is_temporary(self, name: str) -> bool:
        match = TEMPORARY.fullmatch(name)
        return match is not None and (
            len(match[1]) == TEMPORARY_LETTERS or re.fullmatch(f"{MANIFEST_NAME}|{self.files}", match[1]) is not None
        )


class WorkDirectory(NamedTuple):
    """An open work directory."""

    path: Path
    layout: Layout
    descriptor: int | None  # None on Windows

    def check(self) -> None:
        """Check that everything in it is tetopt's.

        Raises
        ------
        InputError
            The manifest is missing or different; an entry is not listed in it; there is a link, pipe or device.
        """
        if not self.is_new():
            self._check_manifest()
        for name, mode in sorted(_modes(self.path, self.descriptor).items()):
            if (problem := self.layout.problem(name, mode)) is not None:
                raise InputError(f"{self.path / name}: {problem}; {ADVICE}")
            inner = next((files for each, files in self.layout.folders.items() if re.fullmatch(each, name)), None)
            if inner is not None:
                with _descriptor(self.path / name, name, self.descriptor) as descriptor:
                    _check_files(self.path / name, descriptor, Layout(self.layout.work, inner))

    def _check_manifest(self) -> None:
        try:
            listed = json.loads(own_bytes(self.path / MANIFEST_NAME, MANIFEST_BYTES))
        except FileNotFoundError:
            listed = None
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{self.path / MANIFEST_NAME}: cannot be read ({error}); {ADVICE}") from error
        if listed != self.layout._asdict():
            raise InputError(
                f"{self.path}: not a work directory of this version of tetopt ({self.layout.work}): "
                f"{MANIFEST_NAME} {'is missing' if listed is None else 'lists other names'}; {ADVICE}"
            )

    def is_new(self) -> bool:
        """Return whether it is empty, except for temporary files of a run that is creating it or was killed then."""
        own = self.own()
        return all(name in own and TEMPORARY.fullmatch(name) for name in _modes(self.path, self.descriptor))

    def own(self) -> dict[str, int]:
        """Return the modes of tetopt's own entries, by name."""
        modes = _modes(self.path, self.descriptor)
        return {name: mode for name, mode in modes.items() if self.layout.problem(name, mode) is None}

    def remove(self, name: str, mode: int) -> None:
        """Remove an entry of `own`; links within it are removed, not followed."""
        with suppress(FileNotFoundError):
            if stat.S_ISDIR(mode):
                shutil.rmtree(self._place(name), dir_fd=self.descriptor)
            else:
                os.unlink(self._place(name), dir_fd=self.descriptor)

    def _place(self, name: str) -> str:
        """Return the name of an entry relative to the descriptor, or its whole path without one."""
        return str(self.path / name) if self.descriptor is None else name

    def lock(self, stack: ExitStack, name: str, *, is_shared: bool, what: str) -> None:
        """Lock a file until the stack is unwound or the process ends; the file names the owner of the lock."""
        if not HAS_LOCKS:
            return
        handle = os.open(self._place(name), os.O_RDWR | os.O_CREAT | UNFOLLOWED, 0o600, dir_fd=self.descriptor)
        stream = stack.enter_context(os.fdopen(handle, "r+", encoding="utf-8", errors="replace"))
        if os.fstat(handle).st_nlink > 1:
            raise InputError(f"{self.path / name}: expected a file without hard links, got one with them; {ADVICE}")
        if not lock_file(stream, is_shared=is_shared):
            whose = stream.read(200).strip() or "another process"
            raise InputError(f"{what}: another run is writing there ({whose}); wait until it ends, or stop it")
        if not is_shared:
            stream.truncate(0)
            stream.write(f"process {os.getpid()} on {socket.gethostname()}\n")
            stream.flush()


def create(path: Path, layout: Layout) -> None:
    """Create a work directory with its manifest; an empty folder becomes one, anything else is left unchanged."""
    with suppress(FileExistsError):
        path.mkdir(mode=0o700)
    if irregular(path, follow=False) != "a folder":
        return
    with opened(path, layout) as work:
        if work.is_new():
            os.chmod(path if work.descriptor is None else work.descriptor, 0o700)
            save_json(path / MANIFEST_NAME, layout._asdict())


@contextmanager
def locked(path: Path, layout: Layout, what: Path, keys: Sequence[str] | None = None) -> Iterator[None]:
    """Lock a work directory, created if missing, for a single run; with `keys`, runs of other keys may share it.

    A lock ends with its process, even if the process is killed.

    Raises
    ------
    InputError
        Another run holds it or one of the keys, which the message reports for `what`; it contains entries that are
        not tetopt's, or a lock file with a hard link, through which another file would be changed.
    """
    create(path, layout)
    with ExitStack() as stack:
        work = stack.enter_context(opened(path, layout))
        work.check()
        work.lock(stack, LOCK_NAME, is_shared=keys is not None, what=str(what))
        for key in keys or ():
            work.lock(stack, f"{key}.lock", is_shared=False, what=f"{what}: {key}")
        yield


@contextmanager
def opened(path: Path, layout: Layout) -> Iterator[WorkDirectory]:
    """Open a work directory, unchecked.

    Raises
    ------
    InputError
        It is a link, is not a folder, or cannot be opened.
    """
    with _descriptor(path, str(path)) as descriptor:
        yield WorkDirectory(path, layout, descriptor)


def discard(path: Path, layout: Layout) -> list[str]:
    """Remove a work directory; entries that are not tetopt's remain, with the folder, and their names are returned."""
    with opened(path, layout) as work:
        for name, mode in work.own().items():
            work.remove(name, mode)
        others = sorted(_modes(path, work.descriptor))
    if not others:
        path.rmdir()
    return others


def check_files(path: Path, work: str) -> None:
    """Raise InputError for a folder that is a link or contains anything but regular files."""
    with _descriptor(path, str(path)) as descriptor:
        _check_files(path, descriptor, Layout(work, ".+"))


def _check_files(path: Path, descriptor: int | None, layout: Layout) -> None:
    for name, mode in sorted(_modes(path, descriptor).items()):
        if (problem := layout.problem(name, mode)) is not None:
            raise InputError(f"{path / name}: {problem}; {ADVICE}")


@contextmanager
def _descriptor(path: Path, name: str, parent: int | None = None) -> Iterator[int | None]:
    """Open a descriptor of the folder with this name in the parent's, or with this path; None on Windows."""
    try:
        kind = irregular(path, follow=False) or "a file"
        if kind != "a folder":
            raise InputError(f"{path}: expected a folder, got {kind}; {ADVICE}")
        descriptor = os.open(name, os.O_DIRECTORY | UNFOLLOWED, dir_fd=parent) if HAS_DESCRIPTORS else None
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}; {ADVICE}") from error
    try:
        yield descriptor
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _modes(path: Path, descriptor: int | None) -> dict[str, int]:
    """Return the modes of the entries of a folder, by name, without following links."""
    modes = {}
    with os.scandir(path if descriptor is None else descriptor) as entries:
        for entry in entries:
            with suppress(FileNotFoundError):  # another run has removed it in between
                modes[entry.name] = entry.stat(follow_symlinks=False).st_mode
    return modes


def _kind(mode: int) -> str:
    return KINDS_OF_FILES.get(stat.S_IFMT(mode), "a file")
