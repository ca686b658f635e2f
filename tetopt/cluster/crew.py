"""What is needed of dask's workers, what there is of them, and what is looked at when one comes."""

from __future__ import annotations

import os
import secrets
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import tetopt
from tetopt.budget import memory_words
from tetopt.errors import InputError

MEMORY_MARGIN = 1.35  # of a task's memory over its prediction, which may be 25 % too low: 1 / 0.75
WORKER_BYTES = 1.5e8  # of a dask worker itself with its nanny: 65 MB each, and what they exchange
DASHBOARD_PORT = 8787  # dask's own, which its users know; another where that is taken


class Need(NamedTuple):
    """What is needed of workers."""

    n_tasks: int  # that are to be run
    task_bytes: float  # of the largest, predicted, 0 if nothing is known
    threads: int | None  # for each task, None: its share of the cores


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
            version=tetopt.__version__,
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
        share = about.n_bytes / about.n_threads
        if share < self.need.task_bytes:
            fitting = int(about.n_bytes / self.need.task_bytes)
            advice = f"dask worker --nthreads {fitting}" if fitting else "a larger --memory-limit"
            raise InputError(
                f"worker {address} on {about.host}: has {memory_words(share)} for each of {about.n_threads} tasks, "
                f"the largest needs about {memory_words(self.need.task_bytes)}; start it with {advice}"
            )


def slots_of(client: Any) -> int:
    """The threads of all workers that are there: each runs one task at a time."""
    return sum(client.nthreads().values())


def dashboard_address() -> str:
    """Where the dashboard answers, to this machine only: it shows the tasks' names."""
    with socket.socket() as one:
        try:
            one.bind(("127.0.0.1", DASHBOARD_PORT))
        except OSError:
            return "127.0.0.1:0"
    return f"127.0.0.1:{DASHBOARD_PORT}"


def dashboard_link(client: Any) -> str:
    """The page that answers at `dashboard_address`; dask's own words have the scheduler's name in it."""
    return f"http://127.0.0.1:{client.scheduler_info()['services']['dashboard']}/status"


def counted(number: int, noun: str) -> str:
    """A number of things in words."""
    return f"{number} {noun}{'s' * (number != 1)}"
