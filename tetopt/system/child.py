"""Child processes within limits: starting, watching and ending them, and describing how they ended.

A child with its own folder ends together with every process that it starts, whatever process group
or session those create for themselves; they also count towards the limits. If the parent is killed,
a shell that waits for its end cleans up. Windows has neither sessions nor that shell: there a child
ends together with its descendants, and survives a parent that is killed.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    # imported where it is used: many processes only look up a signal or set their own limits
    import psutil

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

POLL_SECONDS = 0.05  # between two polls of a child: a fraction of even a short run
# searches for remaining processes, `POLL_SECONDS` apart: a killed process may have forked before
KILL_ROUNDS = 40
# names the child's folder in the environment of every process that a child starts
MARK_NAME = "TETOPT_CHILD"
# Waits until its standard input closes, which happens when the parent ends for any reason.
WATCHDOG = 'read -r _; kill -9 -"$1"; sleep 0.2; rm -rf "$2"'
# Signals of a crash; a shell that ran the program then exits with 128 more.
CRASH_SIGNALS = ("SIGILL", "SIGTRAP", "SIGABRT", "SIGBUS", "SIGFPE", "SIGKILL", "SIGSEGV")
SHELL_OFFSET = 128  # what a shell adds to a signal's number


@contextlib.contextmanager
def start_child(
    command: Sequence[str], environment: dict[str, str], folder: Path | None = None, **streams: Any
) -> Iterator[subprocess.Popen]:
    """Run a child process within a block; at the end of the block it is killed and its `returncode`
    is set.

    Parameters
    ----------
    command : sequence of str
    environment : dict
    folder : Path, optional
        The child's own folder: every process that the child has started ends with it, also if this
        process is killed, in which case the folder is removed. Without a folder only the child
        itself is ended.
    **streams
        Arguments of `subprocess.Popen`: `stdin` (none by default), `stdout`, `stderr`.
    """
    child = subprocess.Popen(
        command,
        env=environment | ({} if folder is None else {MARK_NAME: str(folder)}),
        # its own group, which is killed as a whole and does not get Ctrl-C
        start_new_session=folder is not None,
        **{"stdin": subprocess.DEVNULL} | streams,
    )
    try:
        with _guard_child(child, folder):
            yield child
    finally:
        if folder is None:
            child.kill()
            child.wait()
        else:
            _kill_all(child, folder)


@contextlib.contextmanager
def _guard_child(child: subprocess.Popen, folder: Path | None) -> Iterator[None]:
    """Run a shell that kills the child's group and removes its folder if this process ends
    before the block does.
    """
    if folder is None or sys.platform == "win32":
        yield
        return
    shell = subprocess.Popen(
        ["sh", "-c", WATCHDOG, "tetopt", str(child.pid), str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield
    finally:
        shell.kill()
        shell.communicate()


def watch_child(
    child: subprocess.Popen,
    seconds: float,
    measure: Callable[[int], int],
    problem: Callable[[int], str | None],
) -> tuple[int, str | None]:
    """Wait for a child until it ends or there is a problem.

    Parameters
    ----------
    child : subprocess.Popen
    seconds : float
        Time between two polls.
    measure : callable
        Takes a process id and returns the memory of that process, bytes.
    problem : callable
        Takes the largest memory measured and returns a reason to stop waiting, or None.

    Returns
    -------
    int
        The largest memory measured.
    str or None
        The reason.
    """
    peak = 0
    while (reason := problem(peak)) is None:
        try:
            child.wait(seconds)
        except subprocess.TimeoutExpired:
            peak = max(peak, measure(child.pid))
        else:
            break
    return peak, reason


def family_bytes(pid: int) -> int:
    """Return the resident memory of a child with its own folder and of all processes that it has
    started.
    """
    import psutil

    total = 0
    for each in _family(pid):
        with contextlib.suppress(psutil.Error):  # it has ended meanwhile
            total += each.memory_info().rss
    return total


def _family(session: int) -> set[psutil.Process]:
    """Return the processes of a session and all their descendants, including zombies."""
    import psutil

    family: set[psutil.Process] = set()
    session_of = getattr(os, "getsid", int)  # on Windows each process is its own session
    for pid in psutil.pids():
        with contextlib.suppress(psutil.Error, OSError):  # it has ended meanwhile
            if session_of(pid) == session and (process := psutil.Process(pid)) not in family:
                family |= {process, *process.children(recursive=True)}
    return family


def _marked_processes(folder: Path) -> set[psutil.Process]:
    """Return the processes that were started for a child with this folder, including orphans."""
    import psutil

    processes = set()
    for process in psutil.process_iter():
        # it has ended meanwhile, or access is denied
        with contextlib.suppress(psutil.Error, OSError):
            if process.environ().get(MARK_NAME) == str(folder):
                processes.add(process)
    return processes


def _kill_all(child: subprocess.Popen, folder: Path) -> None:
    """Kill the child and all remaining processes that it started, and reap the child."""
    import psutil

    for _ in range(KILL_ROUNDS):
        n_left = 0
        for each in _family(child.pid) | _marked_processes(folder):
            with contextlib.suppress(psutil.Error):  # it has ended meanwhile, or access is denied
                n_left += each.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
                each.kill()
        child.wait()
        if not n_left:
            break
        time.sleep(POLL_SECONDS)


# In the child


def limit_self(name: str, value: float) -> None:
    """Lower a limit of this process, such as `RLIMIT_AS`, where the system has it."""
    if resource is None:
        return
    kind = getattr(resource, name)
    hard = resource.getrlimit(kind)[1]
    with contextlib.suppress(ValueError, OSError):  # macOS has no such memory limit
        resource.setrlimit(
            kind, (int(value if hard == resource.RLIM_INFINITY else min(value, hard)), hard)
        )


# How it ended


def signal_words(code: int) -> str | None:
    """Return the signal behind a return code, e.g. "signal 11, SIGSEGV"; None if the process exited
    by itself.

    A negative code comes from the process itself; a code above 128 comes from a shell whose program
    crashed.
    """
    number = -code if code < 0 else code - SHELL_OFFSET
    try:
        name = signal.Signals(number).name
    except ValueError:
        return f"signal {number}" if code < 0 else None
    return f"signal {number}, {name}" if code < 0 or name in CRASH_SIGNALS else None
