"""One subject: a `Job` run by a worker, whose outputs are published together, or whose error is
returned as data.

The processes are dask's: it replaces a worker that ends, and runs its subject once more.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from tetopt.cohort.layout import FIGURES_NAME, WORK_NAME, failure_path, log_path, mesh_name, publish
from tetopt.errors import InputError, error_words
from tetopt.io.text import plain
from tetopt.job.events import Event
from tetopt.job.job import Job
from tetopt.job.options import JobOptions
from tetopt.job.run import Result, run
from tetopt.system.budget import forget_peak, memory_words
from tetopt.system.files import save_json, save_text
from tetopt.workers import Workers, memory_limit, run_tasks


class SubjectTask(NamedTuple):
    """A subject to mesh."""

    key: str
    job: JobOptions  # without outputs
    suffix: str  # of the mesh's file
    out: Path  # the cohort's folder
    n_bytes: float  # of memory, estimated; 0 if unknown
    command: str  # that does the same


class Ended(NamedTuple):
    """The outcome of a subject's run."""

    key: str
    status: Literal["done", "violated", "failed"]
    reason: str  # one line; empty for a subject that is done
    seconds: float
    peak_bytes: int  # of resident memory; 0 after a failure


def run_all(tasks: Sequence[SubjectTask], pool: Workers, out: Path) -> Iterator[Ended]:
    """Run subjects on workers, which all find the folder `out`; record failures, and yield
    outcomes as they come.
    """
    for task, ended, error in run_tasks(pool, run_subject, tasks, str(out)):
        if error is not None:
            ended = Ended(task.key, "failed", _reason(error), 0.0, 0)
        failure = failure_path(out, task.key)
        if ended.status == "failed":
            save_json(failure, {"key": task.key, "reason": ended.reason, "command": task.command})
        else:
            failure.unlink(missing_ok=True)
        yield ended


def run_subject(task: SubjectTask) -> Ended:
    """Mesh a subject and publish its outputs, or return its error; write the events of the run
    as its log.
    """
    begin, lines = time.monotonic(), list[str]()
    forget_peak()
    try:
        if task.n_bytes > (limit := memory_limit()):
            raise InputError(
                f"needs {memory_words(task.n_bytes)} of memory, but a worker has "
                f"{memory_words(limit)}; reduce the "
                "number of nodes, or use larger workers"
            )
        result = _mesh_subject(task, lines)
    except Exception as error:
        reason = _reason(error)
        lines.append(reason if _is_users(error) else traceback.format_exc())
        return Ended(task.key, "failed", reason, time.monotonic() - begin, 0)
    finally:
        save_text(log_path(task.out, task.key), "".join(f"{line}\n" for line in lines))
    status: Literal["violated", "done"] = "violated" if result.violated else "done"
    reason, peak = "; ".join(result.violated.values()), result.numbers["memory"]["peak_bytes"]
    return Ended(task.key, status, reason, time.monotonic() - begin, peak)


def _mesh_subject(task: SubjectTask, lines: list[str]) -> Result:
    """Run a subject's job in a folder of its own and publish what it writes; add the texts of
    its events to `lines`.
    """
    work = Path(tempfile.mkdtemp("", f"{task.key}.run-{os.getpid()}-", task.out / WORK_NAME))

    def hear(event: Event) -> None:
        if lines[-1:] != [event.text]:  # compiling kernels repeats its progress
            lines.append(event.text)

    def is_stopped() -> bool:
        work.stat()  # an error if the cohort was interrupted, which removes the folder
        return False

    try:
        mesh = work / mesh_name(task.key, task.suffix)
        outputs = {
            "output": mesh,
            "json_path": mesh.with_suffix(".json"),
            "figures": work / FIGURES_NAME,
        }
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: lines.append(str(message))
            result = run(Job(**vars(task.job) | outputs), hear, is_stopped)
        publish(work, task.out, task.key)
        return result
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _reason(error: BaseException) -> str:
    """Return an error as one line, with its kind if no user can be expected to know it."""
    words = error_words(error) if isinstance(error, Exception) else str(error)
    return plain(
        ("" if _is_users(error) else f"{type(error).__name__}: ") + " ".join(words.split())
    )


def _is_users(error: BaseException) -> bool:
    """Return whether an error is one that the user can fix, as for the command."""
    return isinstance(error, InputError | OSError | MemoryError)
