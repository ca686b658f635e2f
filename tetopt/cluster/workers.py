"""Dask's workers: processes of this machine, those of a cluster that runs, or jobs of a batch system.

A task is given names of files. What keeps tasks within memory is how many of them there are at a time: that is decided
here, from what the largest is predicted to need. Where a task watches a process of its own, as a cohort's does, its
worker is small whatever the task, and a limit of its memory would say nothing about that of the process. A worker that
runs tasks itself has a limit, which its nanny and the system enforce.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tetopt.cluster.crew import (
    DASHBOARD_ADDRESS,
    MEMORY_MARGIN,
    About,
    Folders,
    Need,
    Newcomers,
    Workers,
    beginning,
    counted,
)
from tetopt.cluster.jobs import configuration, submitted
from tetopt.errors import InputError
from tetopt.system.budget import available_bytes, memory_words
from tetopt.system.extras import install_hint
from tetopt.system.interpreter import THREADS_NAME, safe_path

CONNECT_SECONDS = 10  # until a scheduler that does not answer is given up: dask's own is 30
CLOSE_SECONDS = 1.0  # for a worker to end by itself, and as much until one that is killed is gone: dask's own is 5
# A nanny starts its worker again, on a busy machine for longer than the 15 s after which dask would close both.
LOST_SETTINGS = {"distributed.deploy.lost-worker-timeout": "24h"}
LOGGER_NAMES = ("distributed", "dask_jobqueue", "bokeh", "tornado", "asyncio")  # of what speaks in dask
DASK_PACKAGES = ("distributed", "dask-jobqueue", "bokeh", "cryptography")  # of the extras "cohort" and "blocks"


@contextmanager
def workers(
    need: Need, folders: Folders, *, count: int | None, scheduler: str | None, cluster: Path | None
) -> Iterator[Workers]:
    """Workers for as long as the block lasts; none is left after it, however it ends, nor what they wrote into `work`.

    A worker that dies fails its task with `distributed.KilledWorker` at once (with `scheduler`, as often as its own
    configuration says), so that who submits decides whether it is run again.

    Parameters
    ----------
    need : Need
    folders : Folders
        Both are there.
    count : int, optional
        The most tasks at a time on this machine, or jobs of a batch system; not with `scheduler`.
    scheduler : str, optional
        The address of a scheduler that runs, as "tcp://host:8786"; certificates are those of dask's configuration.
    cluster : Path, optional
        A file of dask-jobqueue's configuration, see `tetopt.cluster.jobs`.

    Yields
    ------
    Workers

    Raises
    ------
    InputError
        dask is not installed; a scheduler that does not answer; workers of another version, that do not see `work` or
        have too little memory (also while the block lasts, from `slots`); a file that is none, or asks for too little.
    """
    check_choice(count, scheduler, cluster, "blocks" if need.is_within else "cohort")
    with ExitStack() as stack:
        stack.enter_context(_quiet(folders.logs / "dask.log"))
        if scheduler is not None:
            yield _connected(stack, need, folders, scheduler)
        elif cluster is not None:
            yield submitted(stack, need, folders, cluster, count)
        else:
            yield _local(stack, need, folders, count)


def check_choice(count: int | None, scheduler: str | None, cluster: Path | None, extra: str) -> None:
    """InputError for what `workers` refuses at once: to be called before images are read and anything is written.

    A scheduler is asked, for `CONNECT_SECONDS` at most. `extra` is that of tetopt's which installs what the caller
    needs: "cohort" or "blocks".
    """
    check_installed(extra)
    if scheduler is not None and cluster is not None:
        raise InputError("`scheduler`, `cluster`: expected one of them, got both")
    if scheduler is not None and count is not None:
        raise InputError("`workers`: expected none with `scheduler`, whose workers are there; start more of them")
    if cluster is not None:
        configuration(cluster)
    if scheduler is not None:
        with _answering(scheduler):
            asyncio.run(_reached(scheduler))


def check_installed(extra: str) -> None:
    """InputError where dask.distributed and what belongs to it is not installed, which an extra of tetopt's is for."""
    before = signal.getsignal(signal.SIGINT)
    try:
        import cryptography  # noqa: F401
        import dask_jobqueue  # noqa: F401, which ends the program by sys.exit at Ctrl-C as soon as it is imported
        import distributed  # noqa: F401
    except ImportError as error:
        hint = install_hint(extra, *DASK_PACKAGES)
        raise InputError(f"{error.name} is not installed, by which dask runs tasks; {hint}") from error
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)


class Share(NamedTuple):
    """How this machine is divided."""

    workers: int  # each with one task at a time
    threads: int  # of each task
    bytes: float  # for each task
    limit: float  # of a worker in all


def shares(need: Need, count: int | None, cores: int, free: float) -> Share:
    """As many workers as cores, memory (bytes that are free), `count` and tasks allow, at least one."""
    per_task = need.limit_for(MEMORY_MARGIN * need.task_bytes)
    most = [need.n_tasks, cores // (need.threads or 1)]
    if free < float("inf"):
        most.append(int(free / per_task))
    if count is not None:
        most.append(count)
    number = max(1, min(most))
    limit = min(free / number, need.most_bytes or float("inf"))
    return Share(number, need.threads or max(1, cores // number), need.room_of(limit), limit)


def local_share(need: Need, count: int | None) -> Share:
    """How this machine, as affinity and containers leave it, is divided."""
    from dask.system import CPU_COUNT

    return shares(need, count, CPU_COUNT, float(available_bytes()))


def _local(stack: ExitStack, need: Need, folders: Folders, count: int | None) -> Workers:
    """A cluster within this machine, on its loopback, with certificates of its own: others here cannot submit code."""
    import dask
    from distributed import Client, LocalCluster

    share = local_share(need, count)
    stack.enter_context(safe_path())
    stack.enter_context(dask.config.set(need.settings() | LOST_SETTINGS))
    own_folder = folders.work / "dask"
    stack.callback(shutil.rmtree, own_folder, ignore_errors=True)
    # Where a task is a process of its own the worker is small, and its limit would not be that process's.
    limit = int(share.limit) if need.is_within and share.limit < float("inf") else 0
    cluster = stack.enter_context(
        LocalCluster(
            n_workers=share.workers,
            threads_per_worker=1,  # tasks at a time
            security=True,
            memory_limit=limit,
            local_directory=str(own_folder),
            dashboard_address=DASHBOARD_ADDRESS,
            env={THREADS_NAME: str(share.threads)} if need.is_within else None,
        )
    )
    if need.is_within:
        stack.callback(cluster.sync, _closed, cluster)
    client = stack.enter_context(Client(cluster))
    client.register_plugin(beginning(need.is_within, folders.logs / "dask.log"))
    words = f"{counted(share.workers, 'worker')} of {counted(share.threads, 'thread')}"
    if share.bytes < float("inf"):
        words += f" and {memory_words(share.bytes)}"
    words += f"; dashboard {client.dashboard_link}"
    return Workers(client, lambda: sum(client.nthreads().values()), share.threads, share.bytes, words, share.limit)


async def _closed(cluster: Any) -> None:
    """Soon, whatever runs there: of tasks that workers run themselves, those left lose nothing but time."""
    await asyncio.gather(*(nanny.close(timeout=CLOSE_SECONDS) for nanny in cluster.workers.values()))


# ---- A cluster that runs


def _connected(stack: ExitStack, need: Need, folders: Folders, address: str) -> Workers:
    """The workers of a scheduler that others started."""
    from distributed import Client

    with _answering(address), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of versions that differ: what matters of them is checked, in one line
        client = stack.enter_context(Client(address, timeout=CONNECT_SECONDS))
    newcomers = Newcomers(client, need, folders.work)
    stack.callback(newcomers.probe.unlink, missing_ok=True)
    slots = newcomers.slots()
    if slots == 0:
        raise InputError(f"`scheduler`: {address} has no workers; start some: dask worker {address}")
    threads = need.threads or _threads_each(list(newcomers.known.values()))
    n_bytes = min(map(newcomers.room_of, newcomers.known.values()), default=float("inf"))
    words = f"{counted(len(newcomers.known), 'worker')} at {address}, {counted(slots, 'task')} at a time of "
    words += counted(threads, "thread")
    limit = min((about.n_bytes for about in newcomers.known.values()), default=float("inf"))
    return Workers(client, newcomers.slots, threads, n_bytes, f"{words}; dashboard {client.dashboard_link}", limit)


@contextmanager
def _answering(address: str) -> Iterator[None]:
    """InputError where a connection to a scheduler fails in the block."""
    try:
        yield
    except MemoryError as error:  # the first bytes of another service's answer, read as the length of a message
        raise InputError(
            f"`scheduler`: {address} is not a dask scheduler, another service answers there; expected the address of "
            "a dask scheduler that runs, as tcp://host:8786"
        ) from error
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split()) or f"nothing within {CONNECT_SECONDS:g} s"
        raise InputError(
            f"`scheduler`: {address} does not answer ({reason[:200]}); expected the address of a dask scheduler that "
            "runs, as tcp://host:8786"
        ) from error


async def _reached(address: str) -> None:
    """A connection, closed again. A client that cannot make one may be left half begun, and hangs when collected."""
    from distributed.comm import connect
    from distributed.security import Security

    async with asyncio.timeout(CONNECT_SECONDS):  # dask's own ends before the first words of the other side
        comm = await connect(address, timeout=CONNECT_SECONDS, **Security().get_connection_args("client"))
        await comm.close()


def _threads_each(abouts: list[About]) -> int:
    """Of each host its cores by the tasks that run there at a time; the fewest of all hosts."""
    hosts: dict[str, list[About]] = {}
    for about in abouts:
        hosts.setdefault(about.host, []).append(about)
    shares_of_hosts = [some[0].cores // sum(about.n_threads for about in some) for some in hosts.values()]
    return max(1, min(shares_of_hosts, default=1))


# ---- What dask says


@contextmanager
def _quiet(log: Path) -> Iterator[None]:
    """What dask's loggers say goes into a file, which is made when there is something, and not to the terminal."""
    import distributed  # noqa: F401  (it puts the handlers there that are taken away here)

    handler = logging.FileHandler(log, delay=True, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s %(levelname)s %(message)s"))
    before = []
    for name in [*LOGGER_NAMES, *list(logging.root.manager.loggerDict)]:
        logger = logging.getLogger(name)
        if name in LOGGER_NAMES or (name.split(".")[0] in LOGGER_NAMES and logger.handlers):
            before.append((logger, logger.handlers, logger.propagate))
            logger.handlers, logger.propagate = [handler], False
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Port .* is already in use")  # of the dashboard, where another run's is
            yield
    finally:
        for logger, handlers, propagate in before:
            logger.handlers, logger.propagate = handlers, propagate
        handler.close()
