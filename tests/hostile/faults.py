"""Each step of writing a file, or each array, by number: made to fail once, or to be the last thing
that a process does.

As SQLite's tests have it: what happens at step 1, at step 2, and so on, until a run has fewer steps
than that.
"""

import builtins
import io
import os
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest import mock

import numpy as np

# Functions of `os` that change what is in folders; the first argument is a path or an open file.
STEPS = "open fsync link replace rename unlink remove chmod chown mkdir rmdir"
ALLOCATIONS = "empty zeros ones full empty_like zeros_like arange concatenate column_stack"


class Fault:
    """Counts what may fail; before number `at` it calls `act` with its name, once."""

    def __init__(self, at, act):
        self.at, self.act = at, act
        self.count, self.reached = 0, None

    def reach(self, name, before=None):
        self.count += 1
        if self.count == self.at:
            self.reached = name
            if before is not None:
                before()
            self.act(name)


@contextmanager
def steps_count(fault, folder):
    """Within it each step that touches a folder counts; a write that fails is half done."""
    folder = os.path.realpath(folder)

    def is_inside(place):
        if isinstance(place, int):
            try:
                place = os.readlink(f"/proc/self/fd/{place}")
            except OSError:
                return False
        place = os.path.abspath(os.fspath(place))
        return place == folder or place.startswith(folder + os.sep)

    def stepped(name, real):
        def step(place, *others, **options):
            if is_inside(place):
                path = f"/proc/self/fd/{place}" if isinstance(place, int) else place
                is_folder = name in ("open", "fsync") and os.path.isdir(path)
                fault.reach(f"{name} folder" if is_folder else name)
            return real(place, *others, **options)

        return step

    def opened(_, real):
        def step(file, mode="r", *others, **options):
            is_written = not isinstance(file, int) and set(mode) & set("wax+") and is_inside(file)
            if is_written:
                fault.reach("open to write")
            stream = real(file, mode, *others, **options)
            return _Written(stream, fault) if is_written else stream

        return step

    with (
        _patched(os, STEPS, stepped),
        _patched(io, "open", opened),
        _patched(builtins, "open", opened),
    ):
        yield fault


class _Written:
    """A file whose writes are steps."""

    def __init__(self, stream, fault):
        self._stream, self._fault = stream, fault

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

        self._fault.reach("write", half)
        return self._stream.write(data)


@contextmanager
def arrays_count(fault):
    """Within it each array counts that tetopt's own code lays out."""

    def counted(name, real):
        def allocated(*arguments, **options):
            caller = sys._getframe(1).f_globals.get("__name__", "")
            if caller.startswith("tetopt"):
                fault.reach(f"{caller}: {name}")
            return real(*arguments, **options)

        return allocated

    with _patched(np, ALLOCATIONS, counted):
        yield fault


@contextmanager
def _patched(module, names, wrapped):
    """Within it these functions of a module are wrapped."""
    with ExitStack() as stack:
        for name in names.split():
            real = getattr(module, name)
            stack.enter_context(mock.patch.object(module, name, wrapped(name, real)))
        yield


def left_in(folder):
    """Names of all files under a folder, with their bytes."""
    files = (path for path in sorted(Path(folder).rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}
