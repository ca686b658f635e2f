"""What is needed of dask's workers, what there is of them, and what is looked at when one comes."""

from __future__ import annotations

import os
import secrets
import socket
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from tetopt.errors import InputError
from tetopt.system.budget import memory_words
from tetopt.system.child import end_with_parent, limit_self

MEMORY_MARGIN = 1.35  # of a task's memory over its prediction, which may be 25 % too low: 1 / 0.75
WORKER_BYTES = 1.5e8  # of a dask worker itself with its nanny: 65 MB each, and what they exchange
# The same of one that runs tasks itself: 240 MB with all kernels loaded, its nanny, zarr and buffers of threads.
WITHIN_BYTES = 4e8
# Of its limit, at which a nanny ends a worker: 5 % are left for what is taken until it looks again, 0.1 s later.
TERMINATE_FRACTION = 0.95
# Dask's configuration of its own scheduler: a worker that dies fails its task at once.
SCHEDULER_SETTINGS = {"distributed.scheduler.allowed-failures": 0}
# Where workers run tasks themselves: these hold nothing that dask could put elsewhere, so that there is one limit, and
# a process that is in a kernel, which lets no other thread of Python run, is not taken for dead.
WITHIN_SETTINGS = {f"distributed.worker.memory.{name}": False for name in ("target", "spill", "pause")} | {
    "distributed.worker.memory.terminate": TERMINATE_FRACTION,
    "distributed.scheduler.worker-ttl": None,
}
# Dask's own port, which its users know, or another where that is taken; to this machine only: it shows tasks' names.
DASHBOARD_ADDRESS = "127.0.0.1:8787"


class Need(NamedTuple):
    """What is needed of workers."""

    n_tasks: int  # that are to be run
    task_bytes: float  # of the largest, predicted, 0 if nothing is known
    threads: int | None  # for each task, None: its part of the cores
    is_within: bool = False  # tasks are run by the workers themselves, in whose processes kernels stay loaded
    most_bytes: float | None = None  # of a worker of this machine, which its tasks share

    def settings(self) -> dict[str, Any]:
        """Of dask's configuration, where its scheduler is ours."""
        return SCHEDULER_SETTINGS | (WITHIN_SETTINGS if self.is_within else {})

    def limit_for(self, task_bytes: float) -> float:
        """Memory of a worker whose task may take so much, bytes."""
        if self.is_within:
            return (task_bytes + WITHIN_BYTES) / TERMINATE_FRACTION
        return task_bytes + WORKER_BYTES

    def room_of(self, limit: float) -> float:
        """Memory for the task of a worker that has so much in all, bytes."""
        return max(0.0, limit * TERMINATE_FRACTION - WITHIN_BYTES if self.is_within else limit - WORKER_BYTES)


class Folders(NamedTuple):
    """Where workers put what they need."""

    work: Path  # temporary files; every worker must see it
    logs: Path  # what dask and the batch system's jobs have to say


class Workers(NamedTuple):
    """Workers that run, or that have been asked for."""

    client: Any  # distributed.Client
    slots: Callable[[], int]  # how many tasks may run now; asked again as long as there are some to begin
    threads: int  # for each task
    bytes: float  # memory that one task may take, infinite if nothing is known
    words: str  # one line to print
    limit: float = float("inf")  # memory of a worker in all


class About(NamedTuple):
    """What a worker says of itself."""

    version: str  # of tetopt
    python: str
    probe: str | None  # what it reads in the client's folder
    host: str
    cores: int
    n_threads: int
    n_bytes: float  # its limit, infinite if it has none

    @classmethod
    def of(cls, probe: Path, dask_worker: Any = None) -> About:
        """That of the process that calls it, in a worker by `distributed.Client.run`."""
        from dask.system import CPU_COUNT

        try:
            text: str | None = probe.read_text(encoding="ascii")
        except OSError:
            text = None
        limit = None if dask_worker is None else dask_worker.memory_manager.memory_limit
        return cls(
            version=version("tetopt"),
            python=".".join(map(str, sys.version_info[:2])),
            probe=text,
            host=socket.gethostname(),
            cores=CPU_COUNT,
            n_threads=1 if dask_worker is None else dask_worker.state.nthreads,
            n_bytes=limit or float("inf"),
        )


class Newcomers:
    """Workers that have been looked at, so that each is once: a cluster's come and go."""

    def __init__(self, client: Any, need: Need, folder: Path) -> None:
        self.client, self.need = client, need
        self.known: dict[str, About] = {}
        self.token = secrets.token_hex(8)
        self.probe = folder / f"seen-{os.getpid()}"
        self.probe.write_text(self.token, encoding="ascii")

    def slots(self) -> int:
        """The threads of all workers that are there, of which those not yet seen are looked at first."""
        threads = self.client.nthreads()
        new = [address for address in threads if address not in self.known]
        if new:
            answers = self.client.run(About.of, self.probe, workers=new, on_error="return")
            for address, about in sorted(answers.items()):
                if isinstance(about, OSError):  # it has gone meanwhile
                    continue
                self._check(address, about)
                self.known[address] = about
        return sum(threads.values())

    def room_of(self, about: About) -> float:
        """Memory that one task may take there, bytes."""
        share = about.n_bytes / about.n_threads
        return self.need.room_of(share) if self.need.is_within else share

    def _check(self, address: str, about: Any) -> None:
        ours = About.of(self.probe)
        if not isinstance(about, About):
            raise InputError(
                f"worker {address}: expected one that has tetopt {ours.version}, got "
                f"{type(about).__name__}: {str(about).splitlines()[0] if str(about) else ''}; install it there"
            )
        for name, here, there in (
            ("tetopt", ours.version, about.version),
            ("Python", ours.python, about.python),
        ):
            if here != there:
                raise InputError(
                    f"worker {address} on {about.host}: expected {name} {here} as here, got {there}; "
                    "install the same there"
                )
        if about.probe != self.token:
            raise InputError(
                f"worker {address} on {about.host}: does not see {self.probe.parent}; "
                "expected an output folder on a file system that all workers share"
            )
        if self.need.is_within and about.n_threads > 1:  # kernels take all of a process's threads
            raise InputError(
                f"worker {address} on {about.host}: expected one that runs one task at a time, got "
                f"{about.n_threads}; start it with dask worker --nthreads 1 --nworkers {about.n_threads}"
            )
        share = self.room_of(about)
        if share < self.need.task_bytes:
            fitting = int(about.n_bytes / self.need.task_bytes)
            advice = f"dask worker --nthreads {fitting}" if fitting else "a larger --memory-limit"
            raise InputError(
                f"worker {address} on {about.host}: has {memory_words(share)} for each of {about.n_threads} tasks, "
                f"the largest needs about {memory_words(self.need.task_bytes)}; start it with {advice}"
            )


def beginning(is_within: bool, log: Path | None = None) -> Any:
    """A plugin that sets up workers as they begin, also those that are started again.

    With `is_within` an allocation that would take a worker over its limit of memory fails, where systems have that, and
    a worker ends with its nanny, whatever it does just then. A nanny ends its worker after the fact, when it next
    looks. RLIMIT_DATA counts what the process may write to and has not got from a file, touched or not; files' pages,
    which can be had again, count for the nanny alone. What a worker would write to the terminal goes to the end of
    `log`.
    """
    from distributed import WorkerPlugin

    class Beginning(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            if log is not None:
                descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
                os.dup2(descriptor, 1)
                os.dup2(descriptor, 2)
                os.close(descriptor)
            if is_within:
                end_with_parent()
                if limit := worker.memory_manager.memory_limit:
                    limit_self("RLIMIT_DATA", limit)

    return Beginning()


def dashboard_link(client: Any) -> str:
    """The page that answers there; dask's own words have the scheduler's name in it."""
    return f"http://127.0.0.1:{client.scheduler_info()['services']['dashboard']}/status"


def counted(number: int, noun: str) -> str:
    """A number of things in words."""
    return f"{number} {noun}{'s' * (number != 1)}"
