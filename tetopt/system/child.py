"""Child processes within limits: how they are started, watched and ended, and how they end, in words.

A child with a folder of its own ends with all that it starts, whatever process group or session that makes for itself:
it counts for the limits, too. Where the parent is killed and can see to nothing any more, a shell that waits for its
end does. Windows has neither sessions nor that shell: there a child ends with those that descend from it, and is left
alone by a parent that is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import psutil  # loaded where it is used: many processes only look up a signal or limit themselves

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

POLL_SECONDS = 0.05  # between two looks at a child: a fraction of what even a short run takes
KILL_ROUNDS = 40  # of looking for what is left of a child, `POLL_SECONDS` apart: what was killed may have forked before
MARK_NAME = "TETOPT_CHILD"  # in the environment of whatever a child starts: the child's folder
DEATH_OPTION = 1  # PR_SET_PDEATHSIG, of prctl(2)
# Waits until its standard input closes, which the parent's end does, however it comes.
WATCHDOG = 'read -r _; kill -9 -"$1"; sleep 0.2; rm -rf "$2"'
# Of those that end a program which did not ask for it; a shell that ran it then ends with 128 more.
CRASH_SIGNALS = ("SIGILL", "SIGTRAP", "SIGABRT", "SIGBUS", "SIGFPE", "SIGKILL", "SIGSEGV")
SHELL_OFFSET = 128  # what a shell adds to a signal's number


@contextlib.contextmanager
def started(
    command: Sequence[str], environment: dict[str, str], folder: Path | None = None, **streams: Any
) -> Iterator[subprocess.Popen]:
    """Run a child process within a block; it is killed at the block's end, and its `returncode` is known then.

    Parameters
    ----------
    command : sequence of str
    environment : dict
    folder : Path, optional
        The child's own: all that the child has started ends with it, also if this process is killed, and then the
        folder is removed. Without a folder the child ends alone.
    **streams
        Of `subprocess.Popen`: `stdin`, of which there is none by default, `stdout`, `stderr`.
    """
    child = subprocess.Popen(
        command,
        env=environment | ({} if folder is None else {MARK_NAME: str(folder)}),
        start_new_session=folder is not None,  # a group of its own, which is killed as a whole, and hears no Ctrl-C
        **{"stdin": subprocess.DEVNULL} | streams,
    )
    try:
        with _guarded(child, folder):
            yield child
    finally:
        if folder is None:
            child.kill()
            child.wait()
        else:
            _kill_all(child, folder)


@contextlib.contextmanager
def _guarded(child: subprocess.Popen, folder: Path | None) -> Iterator[None]:
    """A shell beside that ends the child's group, and takes its folder away, if this process ends before the block."""
    if folder is None or sys.platform == "win32":
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
        shell.communicate()


def watched(
    child: subprocess.Popen, seconds: float, measure: Callable[[int], int], problem: Callable[[int], str | None]
) -> tuple[int, str | None]:
    """Wait for a child until it ends or there is a problem.

    Parameters
    ----------
    child : subprocess.Popen
    seconds : float
        Between two looks at it.
    measure : callable
        The memory of the process of a number, bytes.
    problem : callable
        Gets the largest memory measured; a reason to wait no longer, or None.

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
    """Resident memory of a child with a folder of its own, and of all that it has started."""
    import psutil

    total = 0
    for each in _family(pid):
        with contextlib.suppress(psutil.Error):  # it has ended meanwhile
            total += each.memory_info().rss
    return total


def _family(session: int) -> set[psutil.Process]:
    """The processes of a session, and all that descend from them; zombies among the latter, too."""
    import psutil

    family: set[psutil.Process] = set()
    session_of = getattr(os, "getsid", int)  # on Windows each is alone
    for pid in psutil.pids():
        with contextlib.suppress(psutil.Error, OSError):  # it has ended meanwhile
            if session_of(pid) == session and (process := psutil.Process(pid)) not in family:
                family |= {process, *process.children(recursive=True)}
    return family


def _marked(folder: Path) -> set[psutil.Process]:
    """The processes that were started for a child with this folder, orphans among them."""
    import psutil

    processes = set()
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):  # it has ended meanwhile, or is not ours to look at
            if process.environ().get(MARK_NAME) == str(folder):
                processes.add(process)
    return processes


def _kill_all(child: subprocess.Popen, folder: Path) -> None:
    """End whatever is left of the child and of all that it started, and collect the child."""
    import psutil

    for _ in range(KILL_ROUNDS):
        n_left = 0
        for each in _family(child.pid) | _marked(folder):
            with contextlib.suppress(psutil.Error):  # it has ended meanwhile, or has other rights
                n_left += each.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
                each.kill()
        child.wait()
        if not n_left:
            break
        time.sleep(POLL_SECONDS)


# In the child


def limit_self(name: str, value: float) -> None:
    """Lower a limit of this process, as `RLIMIT_AS`, where the system has it."""
    if resource is None:
        return
    kind = getattr(resource, name)
    hard = resource.getrlimit(kind)[1]
    with contextlib.suppress(ValueError, OSError):  # macOS has no such limit of memory
        resource.setrlimit(kind, (int(value if hard == resource.RLIM_INFINITY else min(value, hard)), hard))


def end_with_parent() -> None:
    """From now on this process is killed as soon as the one that started it ends, on Linux; elsewhere nothing happens.

    Where a thread started it, with that thread. A process sees such an end by itself only when it comes to look, which
    one in a compiled kernel does not.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DEATH_OPTION, signal.SIGKILL)


# How it ended


def signal_words(code: int) -> str | None:
    """The signal that ended a process of this return code, as "signal 11, SIGSEGV"; None if it ended by itself.

    A negative code is that of the process itself; one of 128 more is what a shell makes of its program's crash.
    """
    number = -code if code < 0 else code - SHELL_OFFSET
    try:
        name = signal.Signals(number).name
    except ValueError:
        return f"signal {number}" if code < 0 else None
    return f"signal {number}, {name}" if code < 0 or name in CRASH_SIGNALS else None
