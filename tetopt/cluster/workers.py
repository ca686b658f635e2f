"""Dask workers: processes on this machine, those of a running cluster, or jobs of a batch system.

Tasks receive names of files. The number of simultaneous tasks keeps them within memory, and is chosen here from the
prediction for the largest one. If a task watches a separate process, as in a cohort, its worker is always small, and a
memory limit of the worker would not apply to the process. A worker that runs tasks itself has a limit, which its nanny
and the system enforce.
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

CONNECT_SECONDS = 10  # timeout of a scheduler that does not answer: dask's default is 30
CLOSE_SECONDS = 1.0  # for a worker to end by itself, and again until a killed one is gone: dask's default is 5
# A nanny restarts its worker, on a busy machine for longer than the 15 s after which dask would close both.
LOST_SETTINGS = {"distributed.deploy.lost-worker-timeout": "24h"}
LOGGER_NAMES = ("distributed", "dask_jobqueue", "bokeh", "tornado", "asyncio")  # loggers of dask and its libraries
DASK_PACKAGES = ("distributed", "dask-jobqueue", "bokeh", "cryptography")  # of the extras "cohort" and "blocks"


@contextmanager
def workers(
    need: Need, folders: Folders, *, count: int | None, scheduler: str | None, cluster: Path | None
) -> Iterator[Workers]:
    """Provide workers for the block; after it, however it ends, no worker and none of their files in `work` remain.

    A worker that dies fails its task with `distributed.KilledWorker` at once (with `scheduler`, by its own
    configuration), so that the caller decides whether to run it again.

    Parameters
    ----------
    need : Need
    folders : Folders
        Existing folders.
    count : int, optional
        Maximum number of simultaneous tasks on this machine, or of jobs of a batch system; not with `scheduler`.
    scheduler : str, optional
        Address of a running scheduler, as "tcp://host:8786"; certificates are from dask's configuration.
    cluster : Path, optional
        A file of dask-jobqueue's configuration, see `tetopt.cluster.jobs`.

    Yields
    ------
    Workers

    Raises
    ------
    InputError
        dask is not installed; a scheduler does not answer; workers have another version, cannot access `work` or have
        too little memory (also during the block, from `slots`); a file is invalid, or requests too little.
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
    """Raise InputError for what `workers` rejects at once; call it before images are read and anything is written.

    A scheduler is contacted, for `CONNECT_SECONDS` at most. `extra` is tetopt's extra that installs the caller's
    dependencies: "cohort" or "blocks".
    """
    check_installed(extra)
    if scheduler is not None and cluster is not None:
        raise InputError("`scheduler`, `cluster`: expected only one of them, got both")
    if scheduler is not None and count is not None:
        raise InputError("`workers`: expected none with `scheduler`, which has its own workers; start more of those")
    if cluster is not None:
        configuration(cluster)
    if scheduler is not None:
        with _answering(scheduler):
            asyncio.run(_reached(scheduler))


def check_installed(extra: str) -> None:
    """Raise InputError if dask.distributed and its companions, from an extra of tetopt's, are not installed."""
    before = signal.getsignal(signal.SIGINT)
    try:
        import cryptography  # noqa: F401
        import dask_jobqueue  # noqa: F401, which makes Ctrl-C end the program by sys.exit once imported
        import distributed  # noqa: F401
    except ImportError as error:
        hint = install_hint(extra, *DASK_PACKAGES)
        raise InputError(f"{error.name} is not installed, but dask needs it to run tasks; {hint}") from error
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)


class Share(NamedTuple):
    """The division of this machine."""

    workers: int  # each with one task at a time
    threads: int  # of each task
    bytes: float  # for each task
    limit: float  # total of a worker


def shares(need: Need, count: int | None, cores: int, free: float) -> Share:
    """Return as many workers as cores, free memory in bytes, `count` and tasks allow, at least one."""
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
    """Divide this machine, within its affinity and container limits."""
    from dask.system import CPU_COUNT

    return shares(need, count, CPU_COUNT, float(available_bytes()))


def _local(stack: ExitStack, need: Need, folders: Folders, count: int | None) -> Workers:
    """Start a cluster on this machine's loopback, with its own certificates, so that other users cannot submit code."""
    import dask
    from distributed import Client, LocalCluster

    share = local_share(need, count)
    stack.enter_context(safe_path())
    stack.enter_context(dask.config.set(need.settings() | LOST_SETTINGS))
    own_folder = folders.work / "dask"
    stack.callback(shutil.rmtree, own_folder, ignore_errors=True)
    # If a task is a separate process, the worker is small, and its limit would not apply to the process.
    limit = int(share.limit) if need.is_within and share.limit < float("inf") else 0
    cluster = stack.enter_context(
        LocalCluster(
            n_workers=share.workers,
            threads_per_worker=1,  # simultaneous tasks
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
    """Close soon, whatever runs there: unfinished tasks within workers only lose time."""
    await asyncio.gather(*(nanny.close(timeout=CLOSE_SECONDS) for nanny in cluster.workers.values()))


# ---- A running cluster


def _connected(stack: ExitStack, need: Need, folders: Folders, address: str) -> Workers:
    """Return the workers of an existing scheduler."""
    from distributed import Client

    with _answering(address), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on different versions: relevant ones are checked with one message
        client = stack.enter_context(Client(address, timeout=CONNECT_SECONDS))
    newcomers = Newcomers(client, need, folders.work)
    stack.callback(newcomers.probe.unlink, missing_ok=True)
    slots = newcomers.slots()
    if slots == 0:
        raise InputError(f"`scheduler`: {address} has no workers; start some with: dask worker {address}")
    threads = need.threads or _threads_each(list(newcomers.known.values()))
    n_bytes = min(map(newcomers.room_of, newcomers.known.values()), default=float("inf"))
    words = f"{counted(len(newcomers.known), 'worker')} at {address}, {counted(slots, 'task')} of "
    words += f"{counted(threads, 'thread')} at a time"
    limit = min((about.n_bytes for about in newcomers.known.values()), default=float("inf"))
    return Workers(client, newcomers.slots, threads, n_bytes, f"{words}; dashboard {client.dashboard_link}", limit)


@contextmanager
def _answering(address: str) -> Iterator[None]:
    """Raise InputError if a connection to a scheduler fails in the block."""
    try:
        yield
    except MemoryError as error:  # another service's first bytes, read as the length of a message
        raise InputError(
            f"`scheduler`: {address} is another service, not a dask scheduler; expected the address of a running "
            "dask scheduler, such as tcp://host:8786"
        ) from error
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split()) or f"no reply within {CONNECT_SECONDS:g} s"
        raise InputError(
            f"`scheduler`: {address} does not answer ({reason[:200]}); expected the address of a running dask "
            "scheduler, such as tcp://host:8786"
        ) from error


async def _reached(address: str) -> None:
    """Open and close a connection, as a client that cannot connect may remain half started and hang when collected."""
    from distributed.comm import connect
    from distributed.security import Security

    async with asyncio.timeout(CONNECT_SECONDS):  # dask's own timeout ends before the first reply
        comm = await connect(address, timeout=CONNECT_SECONDS, **Security().get_connection_args("client"))
        await comm.close()


def _threads_each(abouts: list[About]) -> int:
    """Return cores per simultaneous task of a host, the minimum over all hosts."""
    hosts: dict[str, list[About]] = {}
    for about in abouts:
        hosts.setdefault(about.host, []).append(about)
    shares_of_hosts = [some[0].cores // sum(about.n_threads for about in some) for some in hosts.values()]
    return max(1, min(shares_of_hosts, default=1))


# ---- Output of dask


@contextmanager
def _quiet(log: Path) -> Iterator[None]:
    """Redirect dask's loggers from the terminal to a file, which is created on the first message."""
    import distributed  # noqa: F401  (it adds the handlers that are removed here)

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
            warnings.filterwarnings("ignore", "Port .* is already in use")  # of the dashboard, if another run uses it
            yield
    finally:
        for logger, handlers, propagate in before:
            logger.handlers, logger.propagate = handlers, propagate
        handler.close()
