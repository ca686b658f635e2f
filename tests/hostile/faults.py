"""Each step of writing a file, by number: made to fail once, or to be the last thing that a process
does.

As SQLite's tests have it: what happens at step 1, at step 2, and so on, until a run has fewer steps
than that.
"""

import builtins
import errno
import io
import os
import sys
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np

# Of each function of `os` that changes what is in folders, the argument that is a path or an open
# file.
STEPS = (
    "open",
    "fsync",
    "replace",
    "rename",
    "unlink",
    "remove",
    "chmod",
    "chown",
    "mkdir",
    "rmdir",
)
ALLOCATIONS = (
    "empty",
    "zeros",
    "ones",
    "full",
    "empty_like",
    "zeros_like",
    "arange",
    "concatenate",
    "column_stack",
)
FULL_DISK = OSError(errno.ENOSPC, "No space left on device")


class Steps:
    """Counts the steps that touch a folder; before number `at` it calls `act` with the step's name,
    once.

    With `is_half`, a write does half of its work before.
    """

    def __init__(self, folder, at, act):
        self.folder, self.at, self.act = os.path.realpath(folder), at, act
        self.count, self.reached = 0, None

    def step(self, name, before=lambda: None):
        self.count += 1
        if self.count == self.at:
            self.reached = name
            before()
            self.act(name)

    def is_inside(self, place):
        if isinstance(place, int):
            try:
                place = os.readlink(f"/proc/self/fd/{place}")
            except OSError:
                return False
        place = os.path.abspath(os.fspath(place))
        return place == self.folder or place.startswith(self.folder + os.sep)

    @contextmanager
    def watched(self):
        """Within it the steps count."""
        with contextlib_stack(
            *(
                mock.patch.object(os, name, self._of_system(name))
                for name in STEPS
                if hasattr(os, name)
            ),
            mock.patch.object(io, "open", self._opening(io.open)),
            mock.patch.object(builtins, "open", self._opening(builtins.open)),
        ):
            yield self

    def _of_system(self, name):
        real = getattr(os, name)

        def stepped(first, *others, **options):
            if self.is_inside(first):
                self.step(
                    f"{name} folder"
                    if name in ("open", "fsync") and self._is_folder(first)
                    else name
                )
            return real(first, *others, **options)

        return stepped

    def _is_folder(self, place):
        return os.path.isdir(f"/proc/self/fd/{place}" if isinstance(place, int) else place)

    def _opening(self, real):
        def opened(file, mode="r", *others, **options):
            is_written = (
                not isinstance(file, int) and set(mode) & set("wax+") and self.is_inside(file)
            )
            if is_written:
                self.step("open to write")
            stream = real(file, mode, *others, **options)
            return _Written(stream, self) if is_written else stream

        return opened


class _Written:
    """A file whose writes are steps."""

    def __init__(self, stream, steps):
        self._stream, self._steps = stream, steps

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def __enter__(self):
        self._stream.__enter__()
        return self

    def __exit__(self, *about):
        return self._stream.__exit__(*about)

    def write(self, data):
        def half():
            self._stream.write(data[: len(data) // 2])
            self._stream.flush()

        self._steps.step("write", half)
        return self._stream.write(data)


class Allocations:
    """Counts arrays that tetopt's own code lays out; number `at` does not fit."""

    def __init__(self, at):
        self.at, self.count, self.reached = at, 0, None

    @contextmanager
    def watched(self):
        """Within it they count."""
        with contextlib_stack(
            *(mock.patch.object(np, name, self._counted(name)) for name in ALLOCATIONS)
        ):
            yield self

    def _counted(self, name):
        real = getattr(np, name)

        def counted(*arguments, **options):
            caller = sys._getframe(1).f_globals.get("__name__", "")
            if caller.startswith("tetopt"):
                self.count += 1
                if self.count == self.at:
                    self.reached = f"{caller}: {name}"
                    raise MemoryError(f"Unable to allocate an array ({name})")
            return real(*arguments, **options)

        return counted


@contextmanager
def contextlib_stack(*patches):
    """All of them at once; what is real is looked up before the first is put in place."""
    from contextlib import ExitStack

    with ExitStack() as stack:
        for patch in patches:
            stack.enter_context(patch)
        yield


def left_in(folder):
    """Names of all files under a folder, with their bytes."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file()
    }
