"""A pipeline in a process of its own: its memory is its own, and when it crashes or runs wild, only it ends.

The child is ``python -m tetopt.study.child FOLDER``; job and result are files in a temporary folder. Its memory,
with that of the processes it starts, is watched from the parent as resident pages (VmRSS in /proc), not limited by
RLIMIT_AS: numba, VTK and the allocators reserve far more address space than they ever touch, so a limit on that would
end runs that need little.
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
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.budget import MAXRSS_UNIT_BYTES, peak_bytes
from tetopt.errors import InputError
from tetopt.mesh import Mesh
from tetopt.study.pipelines import Job, Produced

POLL_SECONDS = 0.05  # between two looks at a child's memory: a fraction of what even a short run takes


class Outcome(NamedTuple):
    """What became of a run."""

    mesh: Mesh | None  # None after a failure
    seconds: dict[str, float]  # by step, in their order; empty after a failure
    peak_bytes: int  # largest resident memory of the child, interpreter and libraries included
    notes: list[str]
    failure: str | None  # one line, None if all went well
    labels: NDArray[np.int64] | None = None  # of each cell, if the pipeline gives them any


def run_in_child(
    pipeline: Callable[[Job], Produced], job: Job, *, max_seconds: float, max_bytes: int | None = None
) -> Outcome:
    """Run a pipeline in a child process, within limits; the mesh has the same bits as in this process.

    Parameters
    ----------
    pipeline : callable
        The function of a `tetopt.study.pipelines.Pipeline`, or any other that can be pickled. Its temporary files, and
        those of programs that it runs, lie in a folder that goes away with the child, however it ends.
    job : Job
    max_seconds : float
        Wall time, the child's start included, after which its process group is killed.
    max_bytes : int, optional
        Resident memory at which it is killed. It is looked at twenty times a second (Linux only: elsewhere there is
        no limit), so a fast run may pass it by a little.

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
    with tempfile.TemporaryDirectory(prefix="tetopt-") as name:
        folder = Path(name)
        (folder / "job.pickle").write_bytes(pickle.dumps((pipeline, job)))
        with open(folder / "stderr.txt", "wb") as errors:
            child = subprocess.Popen(
                [sys.executable, "-m", "tetopt.study.child", str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                # The same modules as here.
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "TMPDIR": name},
                start_new_session=True,  # a group of its own, killed as a whole
            )
        try:
            peak, failure = _watched(child, max_seconds, max_bytes)
        finally:  # also on Ctrl-C, which the child's own group does not get
            _kill_group(child)
        return _outcome(folder, child.returncode, peak, failure)


def _watched(child: subprocess.Popen, max_seconds: float, max_bytes: int | None) -> tuple[int, str | None]:
    """Wait for the child; the largest resident memory seen, bytes, and the limit that it passed, if any."""
    deadline = time.monotonic() + max_seconds
    peak = 0
    while True:
        left = deadline - time.monotonic()
        try:
            child.wait(max(min(POLL_SECONDS, left), 0.0))
        except subprocess.TimeoutExpired:
            peak = max(peak, _group_bytes(child.pid))
        else:
            return peak, None
        if max_bytes is not None and peak > max_bytes:
            return peak, f"too much memory: {peak / 1e6:.0f} MB resident, {max_bytes / 1e6:.0f} MB allowed"
        if left <= 0.0:
            return peak, f"out of time: killed after {max_seconds:g} s"


def _group_bytes(group: int) -> int:
    """Resident memory of all processes of a group; 0 where the system has no /proc."""
    total = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            # After the name in brackets, which may hold anything: state, parent, group.
            if int((folder / "stat").read_text().rpartition(")")[2].split()[2]) == group:
                total += _status_bytes(folder, "VmRSS")
        except OSError:
            continue  # it ended while we looked
    return total


def _status_bytes(folder: Path, name: str) -> int:
    """An entry of a process's status in bytes, e.g. VmRSS; 0 if it has ended."""
    lines = (folder / "status").read_text().splitlines()
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:")), 0)


def _own_peak_bytes() -> int:
    """Largest resident memory of this process or of one it has waited for."""
    return max(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * MAXRSS_UNIT_BYTES, peak_bytes())


def _kill_group(child: subprocess.Popen) -> None:
    """End whatever is left of the child's process group, and collect the child."""
    with contextlib.suppress(ProcessLookupError):  # raised where it ended by itself and left nothing behind
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def _outcome(folder: Path, code: int, peak: int, failure: str | None) -> Outcome:
    if failure is None and code == 0:
        (mesh, seconds, notes, labels), own_peak = pickle.loads((folder / "result.pickle").read_bytes())
        # Checked, and its arrays locked again: pickle does not keep that.
        return Outcome(Mesh(mesh.points, mesh.cells), seconds, max(peak, own_peak), notes, None, labels)
    return Outcome(None, {}, peak, [], failure or _failure(code, folder / "stderr.txt"))


def _failure(code: int, errors: Path) -> str:
    """One line on a child that ended by itself, without a result."""
    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        return f"crashed: {name}"
    lines = errors.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else f"ended with exit code {code} and no message"


def main(folder: Path) -> int:
    """Run the job in the folder; exit code 0 with a result there, 2 for bad input, 1 for any other exception.

    The last line on stderr says what went wrong.
    """
    try:
        pipeline, job = pickle.loads((folder / "job.pickle").read_bytes())
        produced = pipeline(job)
        (folder / "result.pickle").write_bytes(pickle.dumps((produced, _own_peak_bytes())))
    except InputError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    except Exception as error:
        traceback.print_exc()
        print(f"{type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
