"""Submission of tasks to workers as these have room, and of tasks whose worker died.

Only running tasks are submitted: a worker that dies then loses only the tasks that ran there, and the scheduler holds
as little of 20,000 tasks as of 20.
"""

from __future__ import annotations

import errno
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple, NoReturn

from tetopt.cluster.crew import Workers
from tetopt.errors import InputError
from tetopt.io.text import plain
from tetopt.system.budget import memory_words, peak_bytes

WAIT_SECONDS = 1.0  # between two checks of the workers, which come and go
LAST_SECONDS = 60.0  # for tasks still running when the others are dropped, most of which are over half done
TASK_ATTEMPTS = 3  # of a task whose worker ends: the first end may be accidental, the second due to an earlier task
LOST_WORDS = "the cluster's scheduler no longer answers"
MEMORY_TOPIC = "worker-restart-memory"  # dask's topic for workers that nannies end at their limit

FULL_NUMBERS = (errno.ENOSPC, errno.EDQUOT)  # of errors: no space on the disk, or the user's quota exceeded


class SchedulerLost(InputError):
    """The scheduler no longer answers."""


class TaskOutcome(NamedTuple):
    """The outcome of a task."""

    number: int  # in the sequence of tasks
    result: Any  # None if there is an error
    error: BaseException | None  # the function's own, or dask's if the workers that ran it ended
    attempts: int


class Done(NamedTuple):
    """A finished task."""

    name: Any
    result: Any
    seconds: float
    worker: str  # its address
    peak_bytes: int  # maximum memory of its process; 0 if the system does not report it


def run_tasks(
    workers: Workers,
    function: Callable[[Any], Any],
    names: Sequence[Any],
    *,
    attempts: int = TASK_ATTEMPTS,
    is_over: Callable[[], bool] = lambda: False,
    last_seconds: float = LAST_SECONDS,
) -> Iterator[Done]:
    """Run tasks within workers; yield finished tasks as they end.

    Parameters
    ----------
    workers : Workers
        Workers for a need that `is_within`.
    function : callable
        Function to run for each name; it can be pickled. Its result is small; large data are in files.
    names : sequence
        Names, e.g. of files, in the order in which tasks begin; they are pickled, and shown in messages.
    attempts : int
        Maximum number of attempts of a task whose worker ends.
    is_over : callable
        Called about once a second: once it returns true, no further task begins.
    last_seconds : float
        Time from then on for running tasks; tasks that do not end by then are dropped silently.

    Raises
    ------
    InputError
        Workers ended during all `attempts` of a task; the function raised it; a task found no memory or no disk space.
        Other running tasks are then dropped.
    Exception
        Other errors of the function, at once.
    SchedulerLost
        The scheduler is gone.
    """
    run, kind = secrets.token_hex(4), getattr(function, "__name__", "task")
    tasks = [(f"{kind}-{run}-{number}", name) for number, name in enumerate(names)]
    task = partial(_measured, function, workers.threads)
    for outcome in outcomes(workers.client, workers.slots, task, tasks, attempts, is_over, last_seconds):
        if outcome.error is not None:
            _raise(workers, names[outcome.number], outcome.error, outcome.attempts)
        yield outcome.result


def outcomes(
    client: Any,
    slots: Callable[[], int],
    task: Callable[[Any], Any],
    tasks: Sequence[tuple[str, Any]],
    attempts: int,
    is_over: Callable[[], bool] = lambda: False,
    last_seconds: float = LAST_SECONDS,
    repeats: type[BaseException] | None = None,
) -> Iterator[TaskOutcome]:
    """Yield the outcomes of tasks as they end; `tasks` has keys, unique to the scheduler, and arguments of `task`.

    Tasks whose worker ended, or with an error of the type `repeats`, are repeated before others begin. `slots` returns
    the number of simultaneous tasks, and is called repeatedly; `is_over` and `last_seconds` are those of `run_tasks`.

    Raises
    ------
    SchedulerLost
        The scheduler is gone.
    """
    from distributed import CancelledError, wait

    waiting = deque((number, 1) for number in range(len(tasks)))
    running: dict[Any, tuple[int, int]] = {}
    end = float("inf")
    while waiting or (running and time.monotonic() < end):
        _check_scheduler(client)
        if end == float("inf") and is_over():
            end = time.monotonic() + last_seconds
        if end < float("inf"):
            waiting.clear()
        n_slots = _answer(slots) if waiting else 0
        while waiting and len(running) < n_slots:
            number, attempt = waiting.popleft()
            key, argument = tasks[number]
            running[client.submit(task, argument, key=f"{key}-{attempt}", pure=False)] = number, attempt
        if not running:  # jobs of a batch system may take hours to start
            if waiting:
                time.sleep(WAIT_SECONDS)
            continue
        with suppress(TimeoutError, CancelledError):  # dask raises it for some of them; each is checked below
            wait(list(running), timeout=WAIT_SECONDS, return_when="FIRST_COMPLETED")
        for future in [each for each in running if each.status != "pending"]:
            number, attempt = running[future]
            if future.status != "finished":
                _check_scheduler(client)  # a client that loses it cancels pending results
            del running[future]
            if future.status == "finished":
                yield TaskOutcome(number, _answer(future.result), None, attempt)
                continue
            error = CancelledError(future.key) if future.status == "cancelled" else future.exception()
            if attempt < attempts and (is_lost(error) or isinstance(error, repeats or ())):
                waiting.appendleft((number, attempt + 1))
            else:
                yield TaskOutcome(number, None, error, attempt)


def is_lost(error: BaseException) -> bool:
    """Return whether a task ended because its worker did."""
    from distributed import CancelledError, KilledWorker

    return isinstance(error, CancelledError | KilledWorker)


def lost_words(attempts: int) -> str:
    """Return the reason why a task with this many lost attempts has no result."""
    times = f", {attempts} times" if attempts > 1 else ""
    return f"its worker ended{times}, possibly because it used too much memory"


def _measured(function: Callable[[Any], Any], threads: int, name: Any) -> Done:
    """Run a task in a worker."""
    from distributed import get_worker

    limit_threads(threads)
    begin = time.monotonic()
    result = function(name)
    return Done(name, result, time.monotonic() - begin, get_worker().address, peak_bytes())


def limit_threads(number: int) -> None:
    """Set numba's number of threads in this Python thread, at most the process's own."""
    import numba

    # The environment's current value: the main program may have loaded numba before dask set it.
    numba.config.reload_config()
    numba.set_num_threads(min(number, numba.config.NUMBA_NUM_THREADS))


def _raise(workers: Workers, name: Any, error: BaseException, attempts: int) -> NoReturn:
    """Raise the error of a task, with a one-line message if the user can fix it."""
    what = plain(str(name))
    limit = memory_words(workers.limit) if workers.limit < float("inf") else "all available memory"
    advice = "give workers more memory, or make the tasks smaller"
    if is_lost(error):
        ended_at_limit = {event["worker"] for _, event in _answer(partial(workers.client.get_events, MEMORY_TOPIC))}
        last = getattr(getattr(error, "last_worker", None), "address", None)
        if last in ended_at_limit:
            raise InputError(
                f"{what}: needs, with its worker, more memory than a worker's limit of {limit}; {advice}"
            ) from error
        raise InputError(f"{what}: {lost_words(attempts)}; {advice}") from error
    if isinstance(error, MemoryError):
        reason = plain(" ".join(str(error).split())) or "an allocation failed"
        raise InputError(
            f"{what}: needs, with its worker, more memory than a worker's limit of {limit} ({reason}); {advice}"
        ) from error
    if isinstance(error, OSError) and error.errno in FULL_NUMBERS:
        raise InputError(f"{what}: {plain(str(error))}; free some space, and run this again") from error
    raise error


def _check_scheduler(client: Any) -> None:
    if client.status != "running":
        raise SchedulerLost(LOST_WORDS)


def _answer(question: Callable[[], Any]) -> Any:
    """Return the scheduler's answer; it may have been lost before its client knows."""
    try:
        return question()
    except OSError as error:
        raise SchedulerLost(LOST_WORDS) from error
