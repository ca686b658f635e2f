"""Subjects as tasks of workers: outcomes, and records of failures that workers caused."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tetopt.cluster.tasks import is_lost, lost_words, outcomes
from tetopt.cohort.run import MOST_ATTEMPTS, Ended, SubjectTask, run_subject, set_down
from tetopt.io.text import last_line
from tetopt.system.budget import memory_words


def run_all(
    jobs: Sequence[SubjectTask],
    client: Any,
    slots: Callable[[], int],
    room: float,
    task: Callable[[SubjectTask], Ended] = run_subject,
) -> Iterator[Ended]:
    """Run subjects on a dask cluster; yield outcomes as they come.

    Parameters
    ----------
    jobs : sequence of SubjectTask
        Tasks in the order in which they begin.
    client : distributed.Client
    slots : callable
        Returns the number of simultaneous tasks; called repeatedly.
    room : float
        Bytes of memory for one task; a subject that needs more does not begin.
    task : callable
        Function to run for each; it can be pickled.

    Raises
    ------
    SchedulerLost
        The scheduler is gone; finished subjects are kept.
    """
    fitting = [job for job in jobs if job.n_bytes <= room]
    for job in jobs:
        if job.n_bytes > room:
            reason = f"needs {memory_words(job.n_bytes)} of memory, but a worker has {memory_words(room)}"
            yield _failed(job, f"{reason}; reduce the number of nodes, or use larger workers", 0)
    tasks = [(f"{job.key}-{job.run}", job) for job in fitting]
    for outcome in outcomes(client, slots, task, tasks, MOST_ATTEMPTS, repeats=Exception):
        if outcome.error is None:
            yield outcome.result
        else:
            yield _failed(fitting[outcome.number], _cause(outcome.error), outcome.attempts)


def _cause(error: BaseException) -> str:
    """Return the reason why a subject has no result, without line breaks."""
    if is_lost(error):
        return lost_words(MOST_ATTEMPTS)
    return last_line(" ".join(f"{type(error).__name__}: {error}".split()))


def _failed(job: SubjectTask, reason: str, attempts: int) -> Ended:
    ended = Ended(job.key, "failed", reason, 0.0, 0)
    set_down(Path(job.out), job, ended, attempts)
    return ended
