"""Tasks are given to workers as these have room, and those that a worker took with it again.

No more tasks are under way than run at the same time: what a worker takes with it when it dies is then what ran there,
and the scheduler holds as little of 20,000 tasks as of 20.
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

WAIT_SECONDS = 1.0  # between two looks at the workers, which come and go
LAST_SECONDS = 60.0  # for tasks that run when the others are given up, most of which have the better part behind them
TASK_ATTEMPTS = 3  # of a task whose worker ends: the first may be an accident, the second of what came before it
LOST_WORDS = "the scheduler of the cluster does not answer any more"
MEMORY_TOPIC = "worker-restart-memory"  # dask's: of the workers that nannies end at their limit

FULL_NUMBERS = (errno.ENOSPC, errno.EDQUOT)  # of errors: no space on the disk, or none for this user


class SchedulerLost(InputError):
    """The scheduler does not answer any more."""


class TaskOutcome(NamedTuple):
    """How a task ended."""

    number: int  # in the sequence of tasks
    result: Any  # None if there is an error
    error: BaseException | None  # the function's own, or dask's if the workers that ran it ended
    attempts: int


class Done(NamedTuple):
    """A task that is done."""

    name: Any
    result: Any
    seconds: float
    worker: str  # its address
    peak_bytes: int  # the most memory that its process has had, 0 where the system does not say


def run_tasks(
    workers: Workers,
    function: Callable[[Any], Any],
    names: Sequence[Any],
    *,
    attempts: int = TASK_ATTEMPTS,
    is_over: Callable[[], bool] = lambda: False,
    last_seconds: float = LAST_SECONDS,
) -> Iterator[Done]:
    """Run tasks within workers; each that is done, as they end.

    Parameters
    ----------
    workers : Workers
        Of a need that `is_within`.
    function : callable
        What is run of each name; it can be pickled. What it gives back is small: what is large lies in files.
    names : sequence
        In the order in which they begin, of files for instance; they are pickled, and said in messages.
    attempts : int
        The most of a task whose worker ends.
    is_over : callable
        Asked about once a second: once it is true no task begins any more.
    last_seconds : float
        From then on for those that run; what has not ended by then is left, and said nothing of.

    Raises
    ------
    InputError
        The workers that ran a task ended as often as `attempts` says; the function's own; that a task found no memory
        or no space on the disk. Other tasks that run are left then.
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
    """How each task ended, as they do; of `tasks` keys, unique to the scheduler, and what `task` is called with.

    Those whose worker ended are repeated, and those with an error of the type `repeats`, before others begin.
    `slots` says how many may run at the same time, and is asked again and again; `is_over` and `last_seconds` are those
    of `run_tasks`.

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
        if not running:  # jobs of a batch system may come in hours
            if waiting:
                time.sleep(WAIT_SECONDS)
            continue
        with suppress(TimeoutError, CancelledError):  # dask's word for some of them; each is looked at below
            wait(list(running), timeout=WAIT_SECONDS, return_when="FIRST_COMPLETED")
        for future in [each for each in running if each.status != "pending"]:
            number, attempt = running[future]
            if future.status != "finished":
                _check_scheduler(client)  # a client that loses it cancels what it waits for
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
    """Whether a task ended with its worker, and not by itself."""
    from distributed import CancelledError, KilledWorker

    return isinstance(error, CancelledError | KilledWorker)


def lost_words(attempts: int) -> str:
    """Why a task that `is_lost` as often has no result."""
    times = f", {attempts} times" if attempts > 1 else ""
    return f"the worker that ran it ended{times}, as systems do to those that take too much memory"


def _measured(function: Callable[[Any], Any], threads: int, name: Any) -> Done:
    """What a worker runs."""
    from distributed import get_worker

    limit_threads(threads)
    begin = time.monotonic()
    result = function(name)
    return Done(name, result, time.monotonic() - begin, get_worker().address, peak_bytes())


def limit_threads(number: int) -> None:
    """Numba's threads from now on, in this thread of Python: so many, or fewer if the process has no more."""
    import numba

    # What the environment says by now: the main program may have loaded numba before dask set it.
    numba.config.reload_config()
    numba.set_num_threads(min(number, numba.config.NUMBA_NUM_THREADS))


def _raise(workers: Workers, name: Any, error: BaseException, attempts: int) -> NoReturn:
    """The error of a task, in one line where the user can do something about it."""
    what = plain(str(name))
    limit = memory_words(workers.limit) if workers.limit < float("inf") else "there is"
    advice = "give workers more, or make the tasks smaller"
    if is_lost(error):
        ended_at_limit = {event["worker"] for _, event in _answer(partial(workers.client.get_events, MEMORY_TOPIC))}
        last = getattr(getattr(error, "last_worker", None), "address", None)
        if last in ended_at_limit:
            raise InputError(f"{what}: takes more memory than a worker may, {limit} with its own; {advice}") from error
        raise InputError(f"{what}: {lost_words(attempts)}; {advice}") from error
    if isinstance(error, MemoryError):
        reason = plain(" ".join(str(error).split())) or "an allocation failed"
        raise InputError(
            f"{what}: takes more memory than a worker may, {limit} with its own ({reason}); {advice}"
        ) from error
    if isinstance(error, OSError) and error.errno in FULL_NUMBERS:
        raise InputError(f"{what}: {plain(str(error))}; free some space, and run this again") from error
    raise error


def _check_scheduler(client: Any) -> None:
    if client.status != "running":
        raise SchedulerLost(LOST_WORDS)


def _answer(question: Callable[[], Any]) -> Any:
    """What the scheduler says, which may be lost just then, before its client knows."""
    try:
        return question()
    except OSError as error:
        raise SchedulerLost(LOST_WORDS) from error
