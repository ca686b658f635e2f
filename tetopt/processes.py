"""Processes with all that they start: watched, and ended together, however the one that started them ends.

What a process starts is its own, too, whatever process group or session that makes for itself: it counts for the
limits, and ends with it. Where the parent is killed and can see to nothing any more, a shell that waits for its end
does. Windows has neither groups nor that shell: there a process ends with those that descend from it, as far as they
are known when it does, and is left alone by a parent that is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tetopt.budget import status_bytes

POLL_SECONDS = 0.05  # between two looks at a child's memory: a fraction of what even a short run takes
KILL_ROUNDS = 40  # of looking for what is left of a child, `POLL_SECONDS` apart: what was killed may have forked before
MARK_NAME = "TETOPT_CHILD"  # in the environment of whatever a child starts: the child's folder
DEATH_OPTION = 1  # PR_SET_PDEATHSIG, of prctl(2)
# Waits until its standard input closes, which the parent's end does, however it comes.
WATCHDOG = 'read -r _; kill -9 -"$1"; sleep 0.2; rm -rf "$2"'


@contextlib.contextmanager
def started(
    command: Sequence[str], folder: Path, environment: dict[str, str], **streams: Any
) -> Iterator[subprocess.Popen]:
    """A process that ends, with all that it has started, when the block does; `returncode` is known then.

    Parameters
    ----------
    command : sequence of str
    folder : Path
        The process's own: it is removed where this process ends before the block.
    environment : dict
    **streams
        Of `subprocess.Popen`: `stdout`, `stderr`; it has no input.
    """
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        env=environment | {MARK_NAME: str(folder)},
        start_new_session=True,  # a group of its own, killed as a whole
        **streams,
    )
    try:
        with _guarded(child, folder):
            yield child
    finally:  # also on Ctrl-C, which the child's own group does not get
        _kill_all(child, folder)


@contextlib.contextmanager
def _guarded(child: subprocess.Popen, folder: Path) -> Iterator[None]:
    """A shell beside that ends the child's group, and takes its folder away, if this process ends before the block."""
    if sys.platform == "win32":
        yield
        return
    shell = subprocess.Popen(
        ["sh", "-c", WATCHDOG, "tetopt", str(child.pid), str(folder)],
        stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        yield
    finally:
        shell.kill()
        shell.wait()
        assert shell.stdin is not None, "opened above"
        shell.stdin.close()


def end_with_parent() -> None:
    """From now on this process is killed as soon as the one that started it ends, on Linux; elsewhere nothing happens.

    Where a thread started it, with that thread. A process sees such an end by itself only when it comes to look, which
    one in a compiled kernel does not.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DEATH_OPTION, signal.SIGKILL)


def watched(child: subprocess.Popen, max_seconds: float, max_bytes: int | None) -> tuple[int, str | None]:
    """Wait for the child; the largest resident memory seen, bytes, and the limit that it passed, if any."""
    deadline = time.monotonic() + max_seconds
    peak = 0
    while True:
        left = deadline - time.monotonic()
        try:
            child.wait(max(min(POLL_SECONDS, left), 0.0))
        except subprocess.TimeoutExpired:
            peak = max(peak, sum(status_bytes("VmRSS", each) for each in _family(child.pid)))
        else:
            return peak, None
        if max_bytes is not None and peak > max_bytes:
            return peak, f"too much memory: {peak / 1e6:.0f} MB resident, {max_bytes / 1e6:.0f} MB allowed"
        if left <= 0.0:
            return peak, f"out of time: killed after {max_seconds:g} s"


def _family(session: int) -> list[Path]:
    """What /proc has of the living processes of a session, and of all that descend from them."""
    parents, members = {}, set()
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it ended while we looked
            # After the name in brackets, which may hold anything: state, parent, group, session.
            state, parent, _, own = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if state not in "ZX":
                parents[int(folder.name)] = int(parent)
                members |= {int(folder.name)} if int(own) == session else set()
    size = -1
    while size != len(members):
        size = len(members)
        members |= {pid for pid, parent in parents.items() if parent in members}
    return [Path("/proc", str(pid)) for pid in members]


def _marked(folder: Path) -> list[Path]:
    """What /proc has of the living processes that were started for a child with this folder, also of orphans."""
    mark = os.fsencode(f"{MARK_NAME}={folder}")
    processes = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it ended while we looked, or is not ours to look at
            if mark in (process / "environ").read_bytes().split(b"\0"):  # empty of one that has ended
                processes.append(process)
    return processes


def _kill_all(child: subprocess.Popen, folder: Path) -> None:
    """End whatever is left of the child and of all that it started, and collect the child."""
    if sys.platform == "win32":
        if child.poll() is None:
            subprocess.run(["taskkill", "/F", "/T", "/PID", str(child.pid)], capture_output=True, check=False)
        child.kill()
        child.wait()
        return
    for _ in range(KILL_ROUNDS):
        with contextlib.suppress(ProcessLookupError):  # raised where it ended by itself and left nothing behind
            os.killpg(child.pid, signal.SIGKILL)
        processes = {*_family(child.pid), *_marked(folder)}
        for each in processes:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(int(each.name), signal.SIGKILL)
        child.wait()
        if not processes:
            break
        time.sleep(POLL_SECONDS)
