"""A pipeline in a separate process: its memory is separate, and a crash or runaway ends only the
process.

The child is ``python -m tetopt.study.pipeline_process FOLDER``; job and result are files in a
temporary folder. The parent watches the resident memory of the child and its processes instead of
setting RLIMIT_AS: numba, VTK and the allocators reserve far more address space than they use, so
such a limit would end runs that need little memory.
"""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError
from tetopt.io.text import last_line
from tetopt.job.events import note
from tetopt.mesh import Mesh
from tetopt.study.endings import AFTER_CRASHES, Crashed
from tetopt.study.pipelines import PipelineInput, Produced
from tetopt.system.arrays import Ints
from tetopt.system.budget import family_peak_bytes
from tetopt.system.child import POLL_SECONDS, family_bytes, signal_words, start_child, watch_child
from tetopt.system.interpreter import python_command, python_environment

SMOOTHING_FACTOR = 2.0  # `smoothing` of the run that follows a crash


class Outcome(NamedTuple):
    """The outcome of a run."""

    mesh: Mesh | None  # None after a failure
    seconds: dict[str, float]  # by step, in their order; empty after a failure
    peak_bytes: int  # largest resident memory of the child, interpreter and libraries included
    notes: list[str]
    failure: str | None  # one line; None without a failure
    is_crash: bool = False  # a failure that another run may not have
    labels: Ints | None = None  # of each cell, if the pipeline sets labels


def run_in_child(
    pipeline: Callable[[PipelineInput], Produced],
    job: PipelineInput,
    title: str,
    *,
    max_seconds: float,
    max_bytes: int | None,
) -> Outcome:
    """Run a pipeline in a child process, within limits; the mesh has the same bits as in this
    process.

    A run ended by a foreign signal (a crash, or the system short of memory) is repeated once, with
    smoother surfaces, as fTetWild crashes at random and on rough ones.

    Parameters
    ----------
    pipeline : callable
        The function of a `tetopt.study.pipelines.Pipeline`, or any other that can be pickled. Its
        temporary files, and those of the programs it runs, are in a folder that is always removed
        with the child.
    job : PipelineInput
    title : str
        Name of the pipeline in notes.
    max_seconds : float
        Wall time of one run, including the child's start, after which it is killed with all its
        processes.
    max_bytes : int or None
        Resident memory at which it is killed. It is checked twenty times a second, so a fast run
        may exceed it slightly.

    Returns
    -------
    Outcome
        Crashes, the time and memory limits, exceptions and missing packages are a `failure`, not an
        exception.
    """
    first = _run_once(pipeline, job, max_seconds, max_bytes)
    if not first.is_crash:
        return first
    crash = first.failure or ""
    note(f"{title}: {crash}; running it again, with smoother surfaces")
    again = _run_once(pipeline, job._replace(smoothing=SMOOTHING_FACTOR), max_seconds, max_bytes)
    again = again._replace(peak_bytes=max(first.peak_bytes, again.peak_bytes))
    if again.failure is None:
        words = (
            f"the first run {crash}; this is the second, with surfaces {SMOOTHING_FACTOR:g} "
            "times as smooth"
        )
        return again._replace(notes=[words, *again.notes])
    failure = f"twice {crash}" if again.failure == crash else f"{crash}; then {again.failure}"
    return again._replace(failure=f"{failure}; {AFTER_CRASHES}" if again.is_crash else failure)


def _run_once(
    pipeline: Callable[[PipelineInput], Produced],
    job: PipelineInput,
    max_seconds: float,
    max_bytes: int | None,
) -> Outcome:
    deadline = time.monotonic() + max_seconds

    def passed(peak: int) -> str | None:
        """Return the message of a limit that the run exceeds; None without one."""
        if max_bytes is not None and peak > max_bytes:
            return (
                f"too much memory: {peak / 1e6:.0f} MB resident, {max_bytes / 1e6:.0f} MB allowed"
            )
        return (
            f"out of time: killed after {max_seconds:g} s" if time.monotonic() >= deadline else None
        )

    with tempfile.TemporaryDirectory(prefix="tetopt-") as name:
        folder = Path(name)
        (folder / "job.pickle").write_bytes(pickle.dumps((pipeline, job)))
        command = python_command("-m", "tetopt.study.pipeline_process", str(folder))
        with open(folder / "stderr.txt", "wb") as errors:
            environment = python_environment(TMPDIR=name)
            with start_child(
                command, environment, folder, stdout=subprocess.DEVNULL, stderr=errors
            ) as child:
                peak, limit = watch_child(child, POLL_SECONDS, family_bytes, passed)
        return _outcome(folder, child.returncode, peak, limit)


def _outcome(folder: Path, code: int, peak: int, limit: str | None) -> Outcome:
    result, own_failure = folder / "result.pickle", folder / "failure.json"
    if limit is not None:
        return Outcome(None, {}, peak, [], limit)
    if code == 0 and result.is_file():
        (mesh, seconds, notes, labels), own_peak = pickle.loads(result.read_bytes())
        return Outcome(mesh, seconds, max(peak, own_peak), notes, None, labels=labels)
    if (words := signal_words(code)) is not None:
        return Outcome(None, {}, peak, [], f"crashed: {words}", is_crash=True)
    is_crash, text = False, (folder / "stderr.txt").read_text(encoding="utf-8", errors="replace")
    if own_failure.is_file():
        is_crash, text = json.loads(own_failure.read_text(encoding="ascii"))
    return Outcome(
        None,
        {},
        peak,
        [],
        last_line(text) or f"ended with exit code {code} and no message",
        is_crash,
    )


def main(folder: Path) -> None:
    """Run the job in the folder, and write its result, or the reason of its failure."""
    try:
        pipeline, job = pickle.loads((folder / "job.pickle").read_bytes())
        produced = pipeline(job)
        (folder / "result.pickle").write_bytes(pickle.dumps((produced, family_peak_bytes())))
    except Exception as error:
        words = " ".join(str(error).split())
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        failure = [isinstance(error, Crashed), kind + words]
        (folder / "failure.json").write_text(json.dumps(failure), encoding="ascii")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
