"""Jobs of a batch system as dask's workers, by dask-jobqueue and in its own configuration.

A job runs one task at a time, or `processes` of them, and what it asks for is what the largest task is predicted
to need. Jobs that end, by their wall time or otherwise, are replaced as long as there are tasks to begin.
"""

from __future__ import annotations

import re
import shlex
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from tetopt.cluster.crew import (
    DASHBOARD_ADDRESS,
    MEMORY_MARGIN,
    WITHIN_SETTINGS,
    Folders,
    Need,
    Newcomers,
    Workers,
    beginning,
    counted,
    dashboard_link,
)
from tetopt.errors import InputError
from tetopt.system.budget import memory_words
from tetopt.system.incoming import text_of
from tetopt.system.interpreter import SAFE_PATH_NAME, THREADS_NAME, python_command

YAML_LETTERS = 20_000  # of a configuration: those that are known have a thousand
YAML_BRACKETS = 500  # likewise: PyYAML's time grows with the square of brackets in one another, 4 s for 4000
JOBS_AT_ONCE = 20  # where `workers` does not say: a cluster's other users wait for as many cores
JOB_CORES = 4  # of a job where neither its file nor `threads` says
QUEUE_SECONDS = 5.0  # between two looks at the jobs: a scheduler starts them no faster
IDLE_SECONDS = 60.0  # without a task to begin, after which jobs that run none are given back
AGAIN_SECONDS = 60.0  # after a job that was refused when others were not, until the next is submitted
MOST_LOST = 3  # jobs that ended before their worker was there, one after the other: they are not going to be better
# Keys that dask-jobqueue still takes under their old names, with a warning.
OLD_KEYS = {"extra", "job-extra", "env-extra"}
# What must say the memory by the site's own words, as dask-jobqueue does not there.
MEMORY_KEYS = {"sge": "resource-spec", "oar": "memory-per-core-property-name"}
# In directives of a job neither blanks nor quotes can be relied on.
PLAIN_PATH = re.compile(r"[\w./+@=:,-]+")


class Request(NamedTuple):
    """What a job asks for."""

    cores: int
    bytes: float
    processes: int  # tasks at a time
    threads: int  # of each
    task_bytes: float  # that each may take
    exports: tuple[str, ...] = ()  # lines of its script: names in the environment of its workers


def submitted(stack: ExitStack, need: Need, folders: Folders, path: Path, count: int | None) -> Workers:
    """Workers that are jobs of a batch system, as a file says; they are asked for, and come when there is room.

    Raises
    ------
    InputError
        As `configuration` and `request`; the system's commands are not there; it does not take the first job; from
        `slots`: jobs end before their worker is there.
    """
    import dask
    from distributed import Client

    kind, settings = configuration(path)
    kinds = _kinds()
    command = shlex.split(kinds[kind].job_cls.submit_command)[0]
    if shutil.which(command) is None:
        raise InputError(f"{path}: {kind}: {command} is not there; run this where jobs are submitted")
    for folder in folders:
        if not PLAIN_PATH.fullmatch(str(folder)):
            raise InputError(
                f"{folder}: expected an output folder of letters, digits and ./+@=:,-_ alone with `cluster`, "
                "as directives of jobs take no others"
            )
    # Its own keys on top of the user's configuration of dask, as if they stood there.
    stack.enter_context(
        dask.config.set({f"jobqueue.{kind}.{key}": value for key, value in settings.items()} | need.settings())
    )
    job = request(path, kind, dask.config.get(f"jobqueue.{kind}"), need)
    own_folder = folders.work / "dask"
    own_folder.mkdir(mode=0o700, exist_ok=True)  # with the keys by which workers and scheduler know one another
    stack.callback(shutil.rmtree, own_folder, ignore_errors=True)
    cluster = stack.enter_context(cluster_of(path, kind, job, own_folder, folders.logs))
    client = stack.enter_context(Client(cluster))
    client.register_plugin(beginning(need.is_within))
    newcomers = Newcomers(client, need, folders.work)
    stack.callback(newcomers.probe.unlink, missing_ok=True)
    with _refused("`cluster`: the batch system takes no job"):
        cluster.sync(_first, cluster)
    n_jobs = min(count or JOBS_AT_ONCE, -(-need.n_tasks // job.processes))
    jobs = cluster.adapt(
        _demand(newcomers, folders.logs), minimum_jobs=1, maximum_jobs=n_jobs, interval=f"{QUEUE_SECONDS}s",
        worker_key=_job_of if job.processes > 1 else None,
    )  # fmt: skip
    walltime = dask.config.get(f"jobqueue.{kind}.walltime", None)
    words = (
        f"up to {counted(n_jobs, 'job')} of {kind}, each of {counted(job.cores, 'core')} and {memory_words(job.bytes)}"
        f"{f' for {walltime}' if walltime else ''}, with {counted(job.processes, 'task')} at a time of "
        f"{counted(job.threads, 'thread')}; logs in {folders.logs}; dashboard {dashboard_link(client)}"
    )
    return Workers(client, jobs.slots, job.threads, job.task_bytes, words, job.bytes / job.processes)


def configuration(path: Path) -> tuple[str, dict[str, Any]]:
    """The batch system that a file of dask-jobqueue's configuration names, and its settings.

    Parameters
    ----------
    path : Path
        YAML, as "jobqueue: {slurm: {queue: long, account: lab, walltime: '12:00:00'}}".

    Returns
    -------
    kind : str
        As "slurm".
    settings : dict
        With - for _ in their names.

    Raises
    ------
    InputError
        Not YAML, aliases in it, another system or key than there are, a value of another type.
    """
    table = _yaml_of(path)
    systems = table.get("jobqueue") if isinstance(table, dict) and set(table) == {"jobqueue"} else None
    if not isinstance(systems, dict) or len(systems) != 1:
        raise InputError(
            f"{path}: expected one batch system, as jobqueue: {{slurm: {{queue: long, walltime: '12:00:00'}}}}"
        )
    kind, raw = next(iter(systems.items()))
    kinds = _kinds()
    if kind not in kinds:
        raise InputError(f"{path}: jobqueue: expected one of {', '.join(sorted(kinds))}, got {_short(kind)}")
    if not isinstance(raw, dict | None):
        raise InputError(f"{path}: {kind}: expected keys with their values, got {_short(raw)}")
    defaults = _defaults()[kind]
    keys = sorted(set(defaults) - OLD_KEYS)
    settings: dict[str, Any] = {}
    for name, value in (raw or {}).items():
        key = name.replace("_", "-") if isinstance(name, str) else name
        if key not in keys:
            raise InputError(f"{path}: {kind}: expected keys of {', '.join(keys)}, got {_short(name)}")
        _check_value(f"{path}: {kind}: {key}", key, value, defaults[key])
        settings[key] = value
    return kind, settings


def request(path: Path, kind: str, settings: dict[str, Any], need: Need) -> Request:
    """What a job asks for: what its file says, and for the rest what a task needs.

    Raises
    ------
    InputError
        Fewer cores or less memory than a task needs, or no memory where dask-jobqueue cannot tell the system.
    """
    processes = settings["processes"] or 1
    cores = settings["cores"] or (need.threads or JOB_CORES) * processes
    threads = need.threads or cores // processes
    if threads * processes > cores or threads < 1:
        raise InputError(
            f"{path}: {kind}: cores: expected at least {max(threads, 1) * processes} for {processes} tasks "
            f"of {max(threads, 1)} threads, got {cores}; lower processes or `threads`"
        )
    least = need.limit_for(need.task_bytes) * processes
    asked_for = need.limit_for(MEMORY_MARGIN * need.task_bytes) * processes
    n_bytes = asked_for
    for key in ("memory", "job-mem", "mem"):  # for dask; what SLURM and LSF are asked for instead
        if settings.get(key) is not None:
            n_bytes = _bytes_of(f"{path}: {kind}: {key}", settings[key])
            if n_bytes < least:
                raise InputError(
                    f"{path}: {kind}: {key}: expected at least {memory_words(least)} for {processes} of the largest "
                    f"tasks at a time, got {settings[key]}; leave it out, and jobs ask for what tasks need"
                )
    if (name := MEMORY_KEYS.get(kind)) is not None and settings[name] is None:
        raise InputError(
            f"{path}: {kind}: expected {name}, by which a job asks for {memory_words(asked_for)} here "
            "(dask-jobqueue asks for none by itself), got none; your cluster's manual says how"
        )
    return Request(cores, n_bytes, processes, threads, need.room_of(n_bytes / processes), _exports(need, threads))


def _exports(need: Need, threads: int) -> tuple[str, ...]:
    """What workers are told by their environment; more where they run tasks themselves."""
    names: dict[str, Any] = {SAFE_PATH_NAME: 1}  # a job begins in a folder that may hold untrusted modules
    if need.is_within:
        names |= {f"DASK_{key.upper().replace('.', '__')}": value for key, value in WITHIN_SETTINGS.items()}
        names[THREADS_NAME] = threads
    return tuple(f"export {name}={value}" for name, value in names.items())


@contextmanager
def cluster_of(path: Path, kind: str, job: Request, folder: Path, logs: Path) -> Iterator[Any]:
    """A cluster of dask-jobqueue's without jobs yet; its scheduler is in this process, with certificates of its own.

    Their files lie in `folder` until the block ends.

    Raises
    ------
    InputError
        dask-jobqueue refuses its configuration.
    """
    import dask

    cls = _kinds()[kind]
    settings = dask.config.get(f"jobqueue.{kind}")
    with _refused(f"{path}: {kind}: dask-jobqueue refuses it"):
        cluster = cls(
            job_cls=_watched(cls.job_cls, folder, [*job.exports, *settings["job-script-prologue"]]),
            security=True,
            shared_temp_directory=str(folder),
            scheduler_options=(settings["scheduler-options"] or {}) | {"dashboard_address": DASHBOARD_ADDRESS},
            silence_logs="warning",
            cores=job.cores,
            memory=int(job.bytes),
            processes=job.processes,
            python=settings["python"] or shlex.join(python_command()),
            # dask's threads are tasks at a time; the last of two is taken.
            worker_extra_args=[*settings["worker-extra-args"], "--nthreads", "1"],
            log_directory=settings["log-directory"] or str(logs),
            job_name="tetopt" if settings["name"] == "dask-worker" else settings["name"],
        )
    try:
        with cluster:
            yield cluster
    finally:  # not when it is collected, which may be after its folder has gone
        for value in list(vars(cluster).values()):
            if isinstance(value, tempfile._TemporaryFileWrapper):
                value.close()


def _watched(job_cls: Any, folder: Path, prologue: list[str]) -> Any:
    """Jobs of which is known that they were not taken, or ended."""
    from distributed.core import Status

    class Watched(job_cls):
        def __init__(self, *arguments: Any, name: Any = None, **names: Any) -> None:
            self.ended = folder / f"{name}.ended"
            self.begun_at = time.monotonic()
            self.seen_at = float("inf")  # when one of its workers was there last
            lines = [f"trap 'touch {self.ended} 2>/dev/null' EXIT", *prologue]
            super().__init__(*arguments, name=name, job_script_prologue=lines, **names)

        def is_over(self) -> bool:
            """Whether it has ended; one that was not taken a while after, when the batch system may take another."""
            is_refused = self.status == Status.failed
            return time.monotonic() - self.begun_at > AGAIN_SECONDS if is_refused else self.ended.exists()

        async def start(self) -> None:
            self.ended.unlink(missing_ok=True)
            self.status = Status.failed  # until it is taken
            await super().start()

        async def close(self) -> None:
            await super().close()
            self.status = Status.closed  # which dask-jobqueue leaves out, and dask asserts

    return Watched


def _demand(newcomers: Newcomers, logs: Path) -> Any:
    """Dask's adaptive scaling, to as many jobs as there are tasks for: its scheduler knows only of those that run.

    Jobs that have ended make room for others, which dask leaves out where they ended before their workers came, or have
    several.
    """
    from dask import config
    from dask.utils import parse_timedelta
    from distributed import Adaptive

    # Of a job all of whose workers have gone; a nanny starts those again that crash, in a second.
    patience = parse_timedelta(config.get("distributed.deploy.lost-worker-timeout"))

    class Demand(Adaptive):
        cluster: Any
        asked_at = float("inf")
        n_lost = 0  # jobs that ended before their worker was there, since one was

        def slots(self) -> int:
            """How many tasks may run now; InputError if there is no hope that it becomes more than none."""
            self.asked_at = time.monotonic()
            slots = newcomers.slots()
            if slots == 0 and self.n_lost >= MOST_LOST:
                raise InputError(f"`cluster`: {self.n_lost} jobs ended as they began; their logs in {logs} say why")
            return slots

        async def target(self) -> int:
            """So many workers; asked every `QUEUE_SECONDS`."""
            now, over = time.monotonic(), []
            for name, job in self.cluster.workers.items():
                if {f"{name}{suffix}" for suffix in self.cluster.new_spec.get("group", [""])} & self.observed:
                    job.seen_at, self.n_lost = now, 0
                elif job.is_over() or now - job.seen_at > patience:
                    self.n_lost += job.ended.exists() and job.seen_at == float("inf")
                    over.append(name)
            await self.scale_down(over)
            if self.n_lost < MOST_LOST and now - self.asked_at < IDLE_SECONDS:
                return int(self.maximum)
            return sum(bool(worker.processing) for worker in self.cluster.scheduler.workers.values())

    return Demand


async def _first(cluster: Any) -> None:
    """Submit one job; of those of `scale` nobody hears that they are refused."""
    cluster.worker_spec.update(cluster.new_worker_spec())
    await cluster


def _job_of(worker: Any) -> str:
    """The job of a worker, one of several in it."""
    return str(worker.name).rpartition("-")[0]


def _kinds() -> dict[str, Any]:
    """The clusters of dask-jobqueue, by the names that its configuration has for them."""
    import dask_jobqueue

    clusters = [value for value in vars(dask_jobqueue).values() if getattr(value, "job_cls", None)]
    return {cluster.job_cls.config_name: cluster for cluster in clusters}


@cache
def _defaults() -> dict[str, dict[str, Any]]:
    """The keys of each system with their defaults, as dask-jobqueue comes with them."""
    import yaml

    return yaml.safe_load(files("dask_jobqueue").joinpath("jobqueue.yaml").read_text(encoding="utf-8"))["jobqueue"]


def _yaml_of(path: Path) -> Any:
    import yaml

    text = text_of(path, "file of dask-jobqueue's configuration")
    for most, count, noun in (
        (YAML_LETTERS, len(text), "letters"),
        (YAML_BRACKETS, text.count("[") + text.count("{"), "brackets"),
    ):
        if count > most:
            raise InputError(f"{path}: expected at most {most} {noun} of YAML, got {count}")
    try:
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, Loader=yaml.SafeLoader)):
            raise InputError(
                f"{path}: expected YAML without aliases (*name), which may stand for any amount; write it out"
            )
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"{path}: expected YAML, got {_short(error)}; mend that place") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{path}: expected YAML, got {_short(error)}") from error


def _check_value(what: str, key: str, value: Any, default: Any) -> None:
    """InputError where a value is of another type than its key's."""
    if key == "walltime" and not isinstance(value, str):
        raise InputError(
            f'{what}: expected it in quotes, as "12:00:00" (without, YAML reads seconds), got {_short(value)}'
        )
    if key in ("cores", "processes") and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
        raise InputError(f"{what}: expected a whole number above 0, got {_short(value)}")
    if key == "memory":
        _bytes_of(what, value)
    if isinstance(default, list) and not (isinstance(value, list) and all(isinstance(item, str) for item in value)):
        raise InputError(f"{what}: expected a list of texts, got {_short(value)}")
    if isinstance(default, dict) and not isinstance(value, dict):
        raise InputError(f"{what}: expected keys with their values, got {_short(value)}")
    if not isinstance(default, list | dict) and isinstance(value, list | dict):
        raise InputError(f"{what}: expected one value, got {_short(value)}")


def _bytes_of(what: str, value: Any) -> float:
    from dask.utils import parse_bytes

    try:
        n_bytes = float(parse_bytes(value)) if isinstance(value, str | int) and not isinstance(value, bool) else -1.0
    except (ValueError, OverflowError):
        n_bytes = -1.0
    if not n_bytes > 0.0:
        raise InputError(f'{what}: expected memory, as "8 GB", got {_short(value)}')
    return n_bytes


@contextmanager
def _refused(what: str) -> Iterator[None]:
    """InputError of one line for what dask-jobqueue raises, or a command of the batch system that it calls says."""
    try:
        yield
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        raise InputError(f"{what}: {_short(str(error).split('stderr:')[-1])}") from error


def _short(text: Any) -> str:
    words = " ".join(str(text).split())
    return words if len(words) <= 200 else f"{words[:197]}..."  # 200: a line or two of a terminal
