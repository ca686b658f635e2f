"""One subject: meshed by its own process, whose outputs are published together, or whose failure is recorded.

A worker of dask runs it. It exchanges only names and numbers; data are in files.
"""

from __future__ import annotations

import os
import shlex
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from tetopt.cohort.layout import (
    FIGURES_NAME,
    WORK_NAME,
    failure_path,
    log_path,
    mesh_name,
    numbers_of,
    publish,
    subject_folder,
)
from tetopt.errors import InputError
from tetopt.io.text import last_line
from tetopt.system.budget import memory_words, peak_bytes
from tetopt.system.child import signal_words, started, watched
from tetopt.system.files import save_json, save_text
from tetopt.system.interpreter import python_command, python_environment
from tetopt.workers import WorkerEnded, Workers, memory_limit, run_tasks

LOOK_SECONDS = 0.2  # between two checks of a run: a hundredth of the shortest expected run
MOST_ATTEMPTS = 2  # of a run that a signal ends: the second may find enough memory
GIVEN_UP, TOO_LARGE = "given up", "exceeded its worker's memory limit"
LARGER_WORKERS = "reduce the number of nodes, or use larger workers"
ERROR_MARK = "tetopt: "  # prefix of a line that states why a run failed
WARNING_MARK = "tetopt: warning: "
THREAD_NAMES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class SubjectTask(NamedTuple):
    """A subject to mesh."""

    key: str
    words: tuple[str, ...]  # arguments of `tetopt mesh`, without outputs
    out: str  # the cohort's folder
    suffix: str  # of the mesh's file
    threads: int
    n_bytes: float  # of memory, estimated; 0 if unknown
    run: str  # name of a file in the work directory: once it is removed, the run is abandoned


class Ended(NamedTuple):
    """The outcome of a subject's run."""

    key: str
    status: Literal["done", "violated", "failed", "given up"]
    reason: str  # one line; empty without a failure
    seconds: float
    peak_bytes: int  # of resident memory


def run_all(
    jobs: Sequence[SubjectTask], pool: Workers, mark: Path, task: Callable[[SubjectTask], Ended] | None = None
) -> Iterator[Ended]:
    """Run subjects on workers, which all must find the file `mark`; yield outcomes as they come.

    `task` is `run_subject`, or another function that can be pickled.
    """
    for job, ended, error in run_tasks(pool, task or run_subject, jobs, str(mark)):
        if error is None:
            yield ended
            continue
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        failed = Ended(job.key, "failed", last_line(kind + " ".join(str(error).split())), 0.0, 0)
        set_down(Path(job.out), job, failed, error.times if isinstance(error, WorkerEnded) else 1)
        yield failed


def run_subject(job: SubjectTask) -> Ended:
    """Mesh a subject; a run that a signal ends is repeated once, unless its worker has too little memory."""
    begin, limit = time.monotonic(), memory_limit()
    if job.n_bytes > limit:
        reason = f"needs {memory_words(job.n_bytes)} of memory, but a worker has {memory_words(limit)}"
        ended = Ended(job.key, "failed", f"{reason}; {LARGER_WORKERS}", 0.0, 0)
        set_down(Path(job.out), job, ended, 0)
        return ended
    for attempt in range(1, MOST_ATTEMPTS + 1):
        ended, is_crash = _attempt(job, begin, attempt, limit)
        if not is_crash:
            break
    if ended.status == "failed":
        set_down(Path(job.out), job, ended, attempt)
    return ended


def set_down(out: Path, job: SubjectTask, ended: Ended, attempts: int) -> None:
    """Write a file with a subject's failure."""
    save_json(
        failure_path(out, job.key),
        {
            "key": job.key,
            "reason": ended.reason,
            "attempts": attempts,
            "seconds": ended.seconds,
            "peak_bytes": ended.peak_bytes,
            "predicted_bytes": job.n_bytes,
            "command": shlex.join(["tetopt", "mesh", "-o", f"{job.key}{job.suffix}", *job.words]),
        },
    )


def _attempt(job: SubjectTask, begin: float, attempt: int, limit: float) -> tuple[Ended, bool]:
    """Run once; return the outcome, and whether a foreign signal ended it."""
    out = Path(job.out)
    work = out / WORK_NAME / f"{job.key}.{job.run}.{os.getpid()}"
    shutil.rmtree(work, ignore_errors=True)
    (work / FIGURES_NAME).mkdir(parents=True)
    mesh = work / mesh_name(job.key, job.suffix)
    outputs = ["-o", str(mesh), "--json", str(mesh.with_suffix(".json")), "--figures", str(work / FIGURES_NAME)]
    command = python_command("-m", "tetopt", "mesh", *outputs, *job.words)
    environment = python_environment(**dict.fromkeys(THREAD_NAMES, str(job.threads)), COLUMNS="120")
    log, run = log_path(out, job.key), out / WORK_NAME / job.run
    if attempt == 1:
        log.unlink(missing_ok=True)
    with (
        log.open("ab") as stream,
        started(command, environment, work, stdout=stream, stderr=stream) as child,
    ):
        peak, ending = watched(
            child, LOOK_SECONDS, peak_bytes,
            lambda peak: GIVEN_UP if not run.exists() else TOO_LARGE if peak > limit else None,
        )  # fmt: skip
    seconds = time.monotonic() - begin
    if ending is not None:
        shutil.rmtree(work, ignore_errors=True)
        if ending == GIVEN_UP:
            return Ended(job.key, "given up", GIVEN_UP, seconds, peak), False
        reason = f"{TOO_LARGE} of {memory_words(limit)}; {LARGER_WORKERS}"
        return Ended(job.key, "failed", reason, seconds, peak), False
    numbers = numbers_of(mesh.with_suffix(".json"))
    if child.returncode in (0, 1) and numbers is not None and mesh.is_file():
        publish(work, out, job.key)
        text = log.read_text(encoding="utf-8", errors="replace")
        save_text(log, text.replace(str(work), str(subject_folder(out, job.key))))  # the present place of its files
        failure_path(out, job.key).unlink(missing_ok=True)
        violated = "; ".join((numbers.get("violated") or {}).values())
        return Ended(
            job.key, "violated" if violated else "done", violated, seconds, numbers["memory"]["peak_bytes"]
        ), False
    shutil.rmtree(work, ignore_errors=True)
    words = signal_words(child.returncode)
    reason = _reason(log, child.returncode) if words is None else f"ended by {words}"
    if words is not None and "SIGKILL" in words:
        reason += f", possibly because memory ran out; it used {peak / 1e9:.2g} GB"
    return Ended(job.key, "failed", reason, seconds, peak), words is not None


def _reason(log: Path, code: int) -> str:
    """Return the reason why a run ended: the last error line, or else the last line."""
    text = log.read_text(encoding="utf-8", errors="replace")
    errors = [
        line.removeprefix(ERROR_MARK)
        for line in text.splitlines()
        if line.startswith(ERROR_MARK) and not line.startswith(WARNING_MARK)
    ]
    return last_line(errors[-1] if errors else text) or f"ended with exit code {code} and no message"
