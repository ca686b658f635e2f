"""Workers of dask, on this machine or of a running scheduler, and the tasks that they run.

dask distributes tasks, restarts workers that die, and ends those that exceed their memory limit.
Tasks exchange names of files, which every worker can access.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import resource_tracker
from typing import Any, NamedTuple

from tetopt.errors import InputError
from tetopt.io.text import count_text
from tetopt.system.budget import available_bytes, memory_words
from tetopt.system.extras import install_hint
from tetopt.system.interpreter import THREADS_NAME, safe_path

MEMORY_MARGIN = 1.35  # of a task's memory over its prediction, which may be 25 % too low: 1 / 0.75
PAUSE_SECONDS = 0.1  # between two checks of running tasks
CONNECT_SECONDS = 10  # timeout of a scheduler that does not answer: dask's default is 30
MEMORY_TOPIC = "worker-restart-memory"  # dask's topic for workers that nannies end at their limit
LOCAL_SETTINGS = {
    "distributed.scheduler.allowed-failures": 1,  # a task whose worker dies is repeated once
    # a process in a kernel blocks other threads, but is not dead
    "distributed.scheduler.worker-ttl": None,
    "distributed.worker.memory.pause": False,  # the only task of a worker must end
    # A nanny restarts its worker, on a busy machine for longer than the 15 s after which dask would
    # close both.
    "distributed.deploy.lost-worker-timeout": "24h",
}


class SchedulerLost(InputError):
    """The scheduler no longer answers."""


class UnfitWorker(InputError):
    """A worker has other versions, other files, or several tasks in one process."""


class WorkerEnded(InputError):
    """A worker ended each time that it ran a task."""


class Share(NamedTuple):
    """The division of this machine."""

    workers: int  # each with one task at a time
    threads: int  # of each task
    bytes: float  # memory limit of each worker


class Workers(NamedTuple):
    """Running workers."""

    client: Any  # distributed.Client
    threads: int  # for each task

    def slots(self) -> int:
        """Return the number of simultaneous tasks, as workers come and go."""
        return sum(self.client.nthreads().values())

    def words(self) -> str:
        """Describe the workers in one line."""
        tasks, threads = count_text(self.slots(), "task"), count_text(self.threads, "thread")
        return f"{tasks} at a time, each of {threads}"


def check_workers(count: int | None, scheduler: str | None) -> None:
    """Raise InputError for what `workers` rejects; call it before images are read and anything is
    written.

    A scheduler is contacted, for `CONNECT_SECONDS` at most.
    """
    if find_spec("distributed") is None:
        raise InputError(
            "distributed is not installed, but dask needs it to run tasks; "
            f"{install_hint('distributed')}"
        )
    if scheduler is not None and count is not None:
        raise InputError(
            "`workers`: expected none with `scheduler`, which has its own workers; start more of "
            "those"
        )
    if scheduler is not None:
        _check_scheduler(scheduler)


def share_of(n_tasks: int, worker_bytes: float, count: int | None, threads: int | None) -> Share:
    """Divide this machine, within its affinity and container limits, among at least one worker.

    Parameters
    ----------
    n_tasks : int
    worker_bytes : float
        Memory of a worker with the largest task, bytes.
    count, threads : int, optional
        Maximum number of workers; threads of each task instead of its fraction of the cores.
    """
    from dask.system import CPU_COUNT

    free = available_bytes()
    number = max(
        1, min(n_tasks, CPU_COUNT // (threads or 1), int(free / worker_bytes), count or n_tasks)
    )
    return Share(number, threads or max(1, CPU_COUNT // number), free / number)


@contextmanager
def workers(share: Share, scheduler: str | None, threads: int | None) -> Iterator[Workers]:
    """Provide the workers of a scheduler at an address, or local ones, which end with the block.

    Each task has the `threads`, without them one thread of a scheduler's worker. Call
    `check_workers` before.
    """
    import dask
    from distributed import Client, LocalCluster

    if scheduler is not None:
        _check_scheduler(scheduler)
        with Client(scheduler, timeout=CONNECT_SECONDS) as client:
            yield Workers(client, threads or 1)
        return
    with safe_path(), dask.config.set(LOCAL_SETTINGS), ExitStack() as stack:
        with _signals_deferred():
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=share.workers,
                    threads_per_worker=1,  # simultaneous tasks
                    memory_limit=int(share.bytes),
                    dashboard_address="127.0.0.1:0",
                    env={THREADS_NAME: str(share.threads)},
                    silence_logs=logging.CRITICAL,
                    # keeps other users of this machine out; not False
                    security=find_spec("cryptography") is not None or None,
                )
            )
            client = stack.enter_context(Client(cluster))
        yield Workers(client, share.threads)


@contextmanager
def _signals_deferred() -> Iterator[None]:
    """Defer Ctrl-C and SIGTERM to the end of the block, and keep Ctrl-C for good from the processes
    that it starts.

    dask prints where a signal meets it while it begins, and each of its processes does: a terminal
    sends Ctrl-C to all. They inherit the mask, those that replace them, too, and end with this one.
    """
    if threading.current_thread() is not threading.main_thread() or os.name == "nt":
        yield
        return
    came = list[int]()
    resource_tracker.ensure_running()  # its start would end the mask of the thread
    handlers = {
        number: signal.signal(number, lambda number, _: came.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for each in came:
            signal.raise_signal(each)


def memory_limit() -> float:
    """Return the memory limit of the calling worker, bytes; infinite without one."""
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:  # not in a worker
        return float("inf")
    return worker.memory_manager.memory_limit or float("inf")


def run_tasks(
    pool: Workers, function: Callable[[Any], Any], names: Sequence[Any], mark: str
) -> Iterator[tuple[Any, Any, BaseException | None]]:
    """Run tasks; yield the name of each as it ends, its result, and its error: the function's, or
    `WorkerEnded`.

    As many tasks are submitted as may run: a worker that dies then takes no other tasks with it.

    Parameters
    ----------
    pool : Workers
    function : callable
        Function to run for each name; it can be pickled.
    names : sequence
        Names, for example of files, in the order in which tasks begin.
    mark : str
        Path of a file or folder, which every worker must find.

    Raises
    ------
    UnfitWorker
        A worker cannot run tasks; other running tasks are dropped.
    SchedulerLost
        The scheduler is gone.
    """
    task = partial(_run, _versions(), mark, pool.threads, function)
    waiting, running = list(reversed(names)), dict[Any, Any]()
    try:
        while waiting or running:
            for _ in range(min(len(waiting), pool.slots() - len(running)) if waiting else 0):
                name = waiting.pop()
                running[pool.client.submit(task, name, pure=False)] = name
            for future in [each for each in running if each.done()]:
                name, error = running.pop(future), _error_of(pool.client, future)
                yield name, None if error else future.result(), error
            time.sleep(PAUSE_SECONDS)
    except OSError as error:
        raise SchedulerLost("the scheduler no longer answers") from error


def _run(versions: str, mark: str, threads: int, function: Callable[[Any], Any], name: Any) -> Any:
    """Run a task in a worker, with this number of threads."""
    import numba
    from distributed import get_worker

    worker, wrong = get_worker(), ""
    if _versions() != versions:
        wrong = f"expected {versions} as here, got {_versions()}; install the same versions there"
    elif not os.path.exists(mark):
        wrong = (
            f"cannot access {mark}; expected an output folder on a file system that all "
            "workers share"
        )
    elif (n_tasks := worker.state.nthreads) > 1:
        wrong = (
            f"expected one task at a time, got {n_tasks}; use dask worker --nthreads 1 "
            f"--nworkers {n_tasks}"
        )
    if wrong:
        raise UnfitWorker(f"worker {worker.address}: {wrong}")
    # the main program may have loaded numba before dask set the environment
    numba.config.reload_config()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    return function(name)


def _versions() -> str:
    return (
        f"tetopt {version('tetopt')} and Python {sys.version_info.major}.{sys.version_info.minor}"
    )


def _error_of(client: Any, future: Any) -> BaseException | None:
    """Return the error of a task; raise those that concern all tasks."""
    from distributed import KilledWorker

    if future.status == "cancelled":
        raise ConnectionError("a client that loses its scheduler cancels its tasks")
    error = future.exception()
    if isinstance(error, UnfitWorker):
        raise error
    if not isinstance(error, KilledWorker):
        return error
    last = error.last_worker
    at_limit = {event["worker"] for _, event in client.get_events(MEMORY_TOPIC)}
    reason = "because it exceeded" if last.address in at_limit else "possibly because it exceeded"
    limit = (
        f"its limit of {memory_words(last.memory_limit)}"
        if last.memory_limit
        else "the available memory"
    )
    return WorkerEnded(f"its worker ended, {error.allowed_failures + 1} times, {reason} {limit}")


def _check_scheduler(address: str) -> None:
    """Raise InputError if a scheduler does not answer."""
    try:
        asyncio.run(_reached(address))
    except (OSError, ValueError, TypeError, RuntimeError, MemoryError) as error:
        # MemoryError: another service's first bytes, read as the length of a message.
        reason = " ".join(str(error).split()) or f"no reply of dask's within {CONNECT_SECONDS:g} s"
        raise InputError(
            f"`scheduler`: {address} does not answer ({reason[:200]}); expected the address of a "
            "running dask "
            "scheduler, such as tcp://host:8786"
        ) from error


async def _reached(scheduler: str) -> None:
    """Open and close a connection, as a client that cannot connect may remain half started and
    hang when collected.
    """
    from distributed.comm import connect
    from distributed.security import Security

    async with asyncio.timeout(CONNECT_SECONDS):  # dask's own timeout ends before the first reply
        comm = await connect(
            scheduler, timeout=CONNECT_SECONDS, **Security().get_connection_args("client")
        )
        await comm.close()
