"""A pipeline in a process of its own: its memory is its own, and when it crashes or runs wild, only it ends.

The child is ``python -m tetopt.study.child FOLDER``; job and result are files in a temporary folder. Its memory,
with that of the processes it starts, is watched from the parent as resident pages (VmRSS in /proc), not limited by
RLIMIT_AS: numba, VTK and the allocators reserve far more address space than they ever touch, so a limit on that would
end runs that need little.

What a child starts is its own, too, whatever process group or session that makes for itself: it counts for the
limits, and ends with the child. Where the parent is killed and can see to nothing any more, a shell that waits for its
end does.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.budget import MAXRSS_UNIT_BYTES, peak_bytes, status_bytes
from tetopt.errors import InputError
from tetopt.interpreter import python_command, python_environment
from tetopt.mesh import Mesh
from tetopt.study.endings import Crashed, NotInstalled, last_line, signal_words
from tetopt.study.pipelines import Job, Produced

POLL_SECONDS = 0.05  # between two looks at a child's memory: a fraction of what even a short run takes
KILL_ROUNDS = 40  # of looking for what is left of a child, `POLL_SECONDS` apart: what was killed may have forked before
MARK_NAME = "TETOPT_CHILD"  # in the environment of whatever a child starts: the child's folder
# Waits until its standard input closes, which the parent's end does, however it comes.
WATCHDOG = 'read -r _; kill -9 -"$1"; sleep 0.2; rm -rf "$2"'

Reason = Literal["crash", "limit", "missing", "error"]  # of a failure; "missing": it is not installed
CRASH_CODE, MISSING_CODE = 93, 94  # of a child whose pipeline says so: codes that no program ends with by itself


class Outcome(NamedTuple):
    """What became of a run."""

    mesh: Mesh | None  # None after a failure
    seconds: dict[str, float]  # by step, in their order; empty after a failure
    peak_bytes: int  # largest resident memory of the child, interpreter and libraries included
    notes: list[str]
    failure: str | None  # one line, None if all went well
    reason: Reason | None = None  # of the failure
    crashes: tuple[str, ...] = ()  # of this run and of the one that it repeats
    labels: NDArray[np.int64] | None = None  # of each cell, if the pipeline gives them any


def run_in_child(
    pipeline: Callable[[Job], Produced],
    job: Job,
    *,
    max_seconds: float = float("inf"),
    max_bytes: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Outcome:
    """Run a pipeline in a child process, within limits; the mesh has the same bits as in this process.

    A run that is ended by a signal which is not ours (a crash; the system, short of memory) is repeated once: fTetWild
    crashes at random.

    Parameters
    ----------
    pipeline : callable
        The function of a `tetopt.study.pipelines.Pipeline`, or any other that can be pickled. Its temporary files, and
        those of programs that it runs, lie in a folder that goes away with the child, however it ends.
    job : Job
    max_seconds : float
        Wall time of one run, the child's start included, after which it is killed with all that it started.
    max_bytes : int, optional
        Resident memory at which it is killed. It is looked at twenty times a second (Linux only: elsewhere there is
        no limit), so a fast run may pass it by a little.
    say : callable
        Called with a line when a run is repeated.

    Returns
    -------
    Outcome
        A crash, the time or memory limit, an exception and a missing package are a `failure`, not an exception.

    Raises
    ------
    InputError
        A limit that is not above 0.
    """
    if not max_seconds > 0.0 or (max_bytes is not None and max_bytes <= 0):
        raise InputError(f"limits: expected more than 0 seconds and bytes, got {max_seconds} s and {max_bytes} bytes")
    first = _run_once(pipeline, job, max_seconds, max_bytes)
    if first.reason != "crash":
        return first
    crash = first.failure or ""
    say(f"{crash}; once more")
    again = _run_once(pipeline, job, max_seconds, max_bytes)
    again = again._replace(peak_bytes=max(first.peak_bytes, again.peak_bytes), crashes=(*first.crashes, *again.crashes))
    if again.failure is None:
        return again._replace(notes=[f"the first run {crash}; this is the second", *again.notes])
    return again._replace(failure=f"twice {crash}" if again.failure == crash else f"{crash}; then {again.failure}")


def _run_once(pipeline: Callable[[Job], Produced], job: Job, max_seconds: float, max_bytes: int | None) -> Outcome:
    with tempfile.TemporaryDirectory(prefix="tetopt-") as name:
        folder = Path(name)
        (folder / "job.pickle").write_bytes(pickle.dumps((pipeline, job)))
        with open(folder / "stderr.txt", "wb") as errors:
            child = subprocess.Popen(
                python_command("-m", "tetopt.study.child", str(folder)),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=python_environment(**{"TMPDIR": name, MARK_NAME: name}),
                start_new_session=True,  # a group of its own, killed as a whole
            )
        try:
            with _guarded(child, folder):
                peak, limit = _watched(child, max_seconds, max_bytes)
        finally:  # also on Ctrl-C, which the child's own group does not get
            _kill_all(child, folder)
        return _outcome(folder, child.returncode, peak, limit)


@contextlib.contextmanager
def _guarded(child: subprocess.Popen, folder: Path) -> Iterator[None]:
    """A shell beside that ends the child's group, and takes its folder away, if this process ends before the block."""
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


def _watched(child: subprocess.Popen, max_seconds: float, max_bytes: int | None) -> tuple[int, str | None]:
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


def _own_peak_bytes() -> int:
    """Largest resident memory of this process or of one it has waited for."""
    return max(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * MAXRSS_UNIT_BYTES, peak_bytes())


def _kill_all(child: subprocess.Popen, folder: Path) -> None:
    """End whatever is left of the child and of all that it started, and collect the child."""
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


def _outcome(folder: Path, code: int, peak: int, limit: str | None) -> Outcome:
    if limit is None and code == 0 and (folder / "result.pickle").is_file():
        (mesh, seconds, notes, labels), own_peak = pickle.loads((folder / "result.pickle").read_bytes())
        # Checked, and its arrays locked again: pickle does not keep that.
        return Outcome(Mesh(mesh.points, mesh.cells), seconds, max(peak, own_peak), notes, None, labels=labels)
    if limit is not None:
        return Outcome(None, {}, peak, [], limit, "limit")
    if (words := signal_words(code)) is not None:
        failure, code = f"crashed: {words}", CRASH_CODE
    else:
        line = last_line((folder / "stderr.txt").read_text(encoding="utf-8", errors="replace"))
        failure = line or f"ended with exit code {code} and no message"
    reason: Reason = "crash" if code == CRASH_CODE else "missing" if code == MISSING_CODE else "error"
    return Outcome(None, {}, peak, [], failure, reason, crashes=(failure,) if reason == "crash" else ())


def main(folder: Path) -> int:
    """Run the job in the folder; the exit code, and what went wrong as the last line on stderr.

    0 with a result there, `CRASH_CODE`, `MISSING_CODE`, 2 for other bad input, 1 for any other exception.
    """
    try:
        pipeline, job = pickle.loads((folder / "job.pickle").read_bytes())
        produced = pipeline(job)
        (folder / "result.pickle").write_bytes(pickle.dumps((produced, _own_peak_bytes())))
    except InputError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return CRASH_CODE if isinstance(error, Crashed) else MISSING_CODE if isinstance(error, NotInstalled) else 2
    except Exception as error:
        traceback.print_exc()
        print(f"{type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
