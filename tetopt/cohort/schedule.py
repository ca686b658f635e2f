"""Subjects are given to workers as these have room, and those that a worker took with it once more.

No more tasks are under way than run at the same time: what a worker takes with it when it dies is then what ran there,
and the scheduler holds as little of 20,000 subjects as of 20.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from tetopt.budget import memory_words
from tetopt.cohort.run import MOST_ATTEMPTS, Ended, Job, run_subject, set_down
from tetopt.errors import InputError
from tetopt.study.endings import last_line

WAIT_SECONDS = 1.0  # between two looks at the workers, which come and go
LOST_WORDS = "the scheduler of the cluster does not answer any more"


class SchedulerLost(InputError):
    """The scheduler does not answer any more."""


def run_all(
    jobs: Sequence[Job],
    client: Any,
    slots: Callable[[], int],
    room: float,
    task: Callable[[Job], Ended] = run_subject,
) -> Iterator[Ended]:
    """Run subjects on a cluster of dask's; how each ended, as they do.

    Parameters
    ----------
    jobs : sequence of Job
        In the order in which they begin.
    client : distributed.Client
    slots : callable
        How many may run at the same time, asked again and again.
    room : float
        Bytes of memory that one may take; a subject that is predicted to take more does not begin.
    task : callable
        What is run of each; it can be pickled.

    Raises
    ------
    SchedulerLost
        The scheduler is gone; what was finished is in its place.
    """
    from distributed import CancelledError, wait

    waiting: deque[tuple[Job, int]] = deque()
    for job in jobs:
        if job.n_bytes <= room:
            waiting.append((job, 1))
            continue
        reason = f"is predicted to take {memory_words(job.n_bytes)} of memory, a worker has {memory_words(room)}"
        yield _failed(job, f"{reason}; ask for fewer nodes, or for larger workers", 0)
    running: dict[Any, tuple[Job, int]] = {}
    while waiting or running:
        _check_scheduler(client)
        n_slots = _answer(slots) if waiting else 0
        while waiting and len(running) < n_slots:
            job, attempt = waiting.popleft()
            running[client.submit(task, job, key=f"{job.key}-{job.run}-{attempt}", pure=False)] = job, attempt
        if not running:  # jobs of a batch system may come in hours
            time.sleep(WAIT_SECONDS)
            continue
        with suppress(TimeoutError, CancelledError):  # dask's word for some of them; each is looked at below
            wait(list(running), timeout=WAIT_SECONDS, return_when="FIRST_COMPLETED")
        for future in [each for each in running if each.status != "pending"]:
            if future.status != "finished":
                _check_scheduler(client)  # a client that loses it cancels what it waits for
            job, attempt = running.pop(future)
            if future.status == "finished":
                yield _answer(future.result)
            elif attempt < MOST_ATTEMPTS:
                waiting.appendleft((job, attempt + 1))
            else:
                yield _failed(job, _cause(future), attempt)


def _check_scheduler(client: Any) -> None:
    if client.status != "running":
        raise SchedulerLost(LOST_WORDS)


def _answer(question: Callable[[], Any]) -> Any:
    """What the scheduler says, which may be lost just then, before its client knows."""
    try:
        return question()
    except OSError as error:
        raise SchedulerLost(LOST_WORDS) from error


def _cause(future: Any) -> str:
    """Why a future has no result, in one line."""
    from distributed import KilledWorker

    error = None if future.status == "cancelled" else future.exception()
    if error is None or isinstance(error, KilledWorker):
        return f"the worker that ran it ended, {MOST_ATTEMPTS} times, as systems do to those that take too much memory"
    return last_line(" ".join(f"{type(error).__name__}: {error}".split()))


def _failed(job: Job, reason: str, attempts: int) -> Ended:
    ended = Ended(job.key, "failed", reason, 0.0, 0)
    set_down(Path(job.out), job, ended, attempts)
    return ended
