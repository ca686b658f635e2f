"""Requirements of dask workers, the workers themselves, and the checks of new ones."""

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
WORKER_BYTES = 1.5e8  # of a dask worker with its nanny: 65 MB each, and their messages
# Of a worker that runs tasks itself: 240 MB with all kernels loaded, its nanny, zarr and buffers of threads.
WITHIN_BYTES = 4e8
# Of its limit, where a nanny ends a worker: 5 % remain for allocations until the next check, 0.1 s later.
TERMINATE_FRACTION = 0.95
# Configuration of dask's scheduler: a worker that dies fails its task at once.
SCHEDULER_SETTINGS = {"distributed.scheduler.allowed-failures": 0}
# For workers that run tasks themselves: dask cannot move their data elsewhere, so there is one limit; and a process in
# a kernel, which blocks other Python threads, does not count as dead.
WITHIN_SETTINGS = {f"distributed.worker.memory.{name}": False for name in ("target", "spill", "pause")} | {
    "distributed.worker.memory.terminate": TERMINATE_FRACTION,
    "distributed.scheduler.worker-ttl": None,
}
# Dask's usual port, or another if that is in use; only for this machine, as it shows tasks' names.
DASHBOARD_ADDRESS = "127.0.0.1:8787"


class Need(NamedTuple):
    """Requirements of workers."""

    n_tasks: int  # to run
    task_bytes: float  # of the largest, predicted; 0 if unknown
    threads: int | None  # per task; None: its fraction of the cores
    is_within: bool = False  # workers run tasks in their own processes, where kernels stay loaded
    most_bytes: float | None = None  # of a worker on this machine, shared by its tasks

    def settings(self) -> dict[str, Any]:
        """Return settings of dask's configuration for tetopt's own scheduler."""
        return SCHEDULER_SETTINGS | (WITHIN_SETTINGS if self.is_within else {})

    def limit_for(self, task_bytes: float) -> float:
        """Return the memory of a worker for a task of this size, bytes."""
        if self.is_within:
            return (task_bytes + WITHIN_BYTES) / TERMINATE_FRACTION
        return task_bytes + WORKER_BYTES

    def room_of(self, limit: float) -> float:
        """Return the memory for a task of a worker with this total, bytes."""
        return max(0.0, limit * TERMINATE_FRACTION - WITHIN_BYTES if self.is_within else limit - WORKER_BYTES)


class Folders(NamedTuple):
    """Folders of workers."""

    work: Path  # temporary files; every worker must see it
    logs: Path  # output of dask and of the batch system's jobs


class Workers(NamedTuple):
    """Running or requested workers."""

    client: Any  # distributed.Client
    slots: Callable[[], int]  # returns the number of tasks that may run now; called again while tasks wait
    threads: int  # for each task
    bytes: float  # memory for one task; infinite if unknown
    words: str  # one line to print
    limit: float = float("inf")  # total memory of a worker


class About(NamedTuple):
    """A worker's description of itself."""

    version: str  # of tetopt
    python: str
    probe: str | None  # content that it reads in the client's folder
    host: str
    cores: int
    n_threads: int
    n_bytes: float  # its limit, infinite if it has none

    @classmethod
    def of(cls, probe: Path, dask_worker: Any = None) -> About:
        """Describe the calling process, in a worker by `distributed.Client.run`."""
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
    """Checked workers, so that each is checked once, as a cluster's workers come and go."""

    def __init__(self, client: Any, need: Need, folder: Path) -> None:
        self.client, self.need = client, need
        self.known: dict[str, About] = {}
        self.token = secrets.token_hex(8)
        self.probe = folder / f"seen-{os.getpid()}"
        self.probe.write_text(self.token, encoding="ascii")

    def slots(self) -> int:
        """Return the number of threads of all workers, after a check of new ones."""
        threads = self.client.nthreads()
        new = [address for address in threads if address not in self.known]
        if new:
            answers = self.client.run(About.of, self.probe, workers=new, on_error="return")
            for address, about in sorted(answers.items()):
                if isinstance(about, OSError):  # it has ended meanwhile
                    continue
                self._check(address, about)
                self.known[address] = about
        return sum(threads.values())

    def room_of(self, about: About) -> float:
        """Return the memory for one task there, bytes."""
        share = about.n_bytes / about.n_threads
        return self.need.room_of(share) if self.need.is_within else share

    def _check(self, address: str, about: Any) -> None:
        ours = About.of(self.probe)
        if not isinstance(about, About):
            raise InputError(
                f"worker {address}: expected one with tetopt {ours.version}, got "
                f"{type(about).__name__}: {str(about).splitlines()[0] if str(about) else ''}; install it there"
            )
        for name, here, there in (
            ("tetopt", ours.version, about.version),
            ("Python", ours.python, about.python),
        ):
            if here != there:
                raise InputError(
                    f"worker {address} on {about.host}: expected {name} {here} as here, got {there}; "
                    "install the same version there"
                )
        if about.probe != self.token:
            raise InputError(
                f"worker {address} on {about.host}: cannot access {self.probe.parent}; "
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
                f"but the largest needs about {memory_words(self.need.task_bytes)}; start it with {advice}"
            )


def beginning(is_within: bool, log: Path | None = None) -> Any:
    """Return a plugin that sets up workers as they start or restart.

    With `is_within`, an allocation beyond a worker's memory limit fails, on systems that support it, and a worker ends
    with its nanny. A nanny ends its worker only later, at its next check. RLIMIT_DATA counts writable memory not
    backed by files, touched or not; pages of files count only for the nanny. A worker's terminal output is appended to
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
    """Return the dashboard's local address; dask's own link contains the scheduler's name."""
    return f"http://127.0.0.1:{client.scheduler_info()['services']['dashboard']}/status"


def counted(number: int, noun: str) -> str:
    """Format a number of things."""
    return f"{number} {noun}{'s' * (number != 1)}"
