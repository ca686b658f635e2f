"""Jobs of a batch system as dask workers, by dask-jobqueue and with its configuration.

A job runs one task at a time, or `processes` of them, and requests the predicted resources of the largest task. Jobs
that end, by their wall time or otherwise, are replaced while tasks wait.
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

YAML_LETTERS = 20_000  # of a configuration: known ones have a thousand
YAML_BRACKETS = 500  # of a configuration: PyYAML's time grows with the square of nested brackets, 4 s for 4000
JOBS_AT_ONCE = 20  # without `workers`: other users wait for these cores
JOB_CORES = 4  # of a job, unless its file or `threads` sets them
QUEUE_SECONDS = 5.0  # between two checks of jobs: a scheduler starts them no faster
IDLE_SECONDS = 60.0  # without waiting tasks, after which idle jobs are released
AGAIN_SECONDS = 60.0  # between a rejected job, if others were accepted, and the next submission
MOST_LOST = 3  # consecutive jobs that ended before their worker came: further ones would, too
# Keys that dask-jobqueue still accepts under old names, with a warning.
OLD_KEYS = {"extra", "job-extra", "env-extra"}
# Keys that request memory in a site's own form, where dask-jobqueue does not.
MEMORY_KEYS = {"sge": "resource-spec", "oar": "memory-per-core-property-name"}
# Directives of a job may not support blanks or quotes.
PLAIN_PATH = re.compile(r"[\w./+@=:,-]+")


class Request(NamedTuple):
    """Resources of a job."""

    cores: int
    bytes: float
    processes: int  # tasks at a time
    threads: int  # of each
    task_bytes: float  # of each task
    exports: tuple[str, ...] = ()  # lines of its script: its workers' environment variables


def submitted(stack: ExitStack, need: Need, folders: Folders, path: Path, count: int | None) -> Workers:
    """Request workers that are jobs of a batch system, by a file; they start when the system has room.

    Raises
    ------
    InputError
        As `configuration` and `request`; the system's commands are missing; it rejects the first job; from `slots`:
        jobs end before their worker starts.
    """
    import dask
    from distributed import Client

    kind, settings = configuration(path)
    kinds = _kinds()
    command = shlex.split(kinds[kind].job_cls.submit_command)[0]
    if shutil.which(command) is None:
        raise InputError(f"{path}: {kind}: command {command} not found; run this where jobs are submitted")
    for folder in folders:
        if not PLAIN_PATH.fullmatch(str(folder)):
            raise InputError(
                f"{folder}: with `cluster`, the path of the output folder may contain only letters, digits and "
                "./+@=:,-_, since job directives contain it"
            )
    # Its own keys override the user's configuration of dask.
    stack.enter_context(
        dask.config.set({f"jobqueue.{kind}.{key}": value for key, value in settings.items()} | need.settings())
    )
    job = request(path, kind, dask.config.get(f"jobqueue.{kind}"), need)
    own_folder = folders.work / "dask"
    own_folder.mkdir(mode=0o700, exist_ok=True)  # with the keys of workers and scheduler
    stack.callback(shutil.rmtree, own_folder, ignore_errors=True)
    cluster = stack.enter_context(cluster_of(path, kind, job, own_folder, folders.logs))
    client = stack.enter_context(Client(cluster))
    client.register_plugin(beginning(need.is_within))
    newcomers = Newcomers(client, need, folders.work)
    stack.callback(newcomers.probe.unlink, missing_ok=True)
    with _refused("`cluster`: the batch system rejects jobs"):
        cluster.sync(_first, cluster)
    n_jobs = min(count or JOBS_AT_ONCE, -(-need.n_tasks // job.processes))
    jobs = cluster.adapt(
        _demand(newcomers, folders.logs), minimum_jobs=1, maximum_jobs=n_jobs, interval=f"{QUEUE_SECONDS}s",
        worker_key=_job_of if job.processes > 1 else None,
    )  # fmt: skip
    walltime = dask.config.get(f"jobqueue.{kind}.walltime", None)
    words = (
        f"up to {counted(n_jobs, 'job')} of {kind}, each of {counted(job.cores, 'core')} and {memory_words(job.bytes)}"
        f"{f' for {walltime}' if walltime else ''}, with {counted(job.processes, 'task')} of "
        f"{counted(job.threads, 'thread')} at a time; logs in {folders.logs}; dashboard {dashboard_link(client)}"
    )
    return Workers(client, jobs.slots, job.threads, job.task_bytes, words, job.bytes / job.processes)


def configuration(path: Path) -> tuple[str, dict[str, Any]]:
    """Read the batch system and its settings from a file of dask-jobqueue's configuration.

    Parameters
    ----------
    path : Path
        YAML, as "jobqueue: {slurm: {queue: long, account: lab, walltime: '12:00:00'}}".

    Returns
    -------
    kind : str
        As "slurm".
    settings : dict
        Settings with - for _ in their names.

    Raises
    ------
    InputError
        The file is not YAML or has aliases; a system or key is unknown; a value has another type.
    """
    table = _yaml_of(path)
    systems = table.get("jobqueue") if isinstance(table, dict) and set(table) == {"jobqueue"} else None
    if not isinstance(systems, dict) or len(systems) != 1:
        raise InputError(
            f"{path}: expected one batch system, such as jobqueue: {{slurm: {{queue: long, walltime: '12:00:00'}}}}"
        )
    kind, raw = next(iter(systems.items()))
    kinds = _kinds()
    if kind not in kinds:
        raise InputError(f"{path}: jobqueue: expected one of {', '.join(sorted(kinds))}, got {_short(kind)}")
    if not isinstance(raw, dict | None):
        raise InputError(f"{path}: {kind}: expected key-value pairs, got {_short(raw)}")
    defaults = _defaults()[kind]
    keys = sorted(set(defaults) - OLD_KEYS)
    settings: dict[str, Any] = {}
    for name, value in (raw or {}).items():
        key = name.replace("_", "-") if isinstance(name, str) else name
        if key not in keys:
            raise InputError(f"{path}: {kind}: unknown key {_short(name)}; expected one of {', '.join(keys)}")
        _check_value(f"{path}: {kind}: {key}", key, value, defaults[key])
        settings[key] = value
    return kind, settings


def request(path: Path, kind: str, settings: dict[str, Any], need: Need) -> Request:
    """Return the resources of a job: those in its file, and otherwise what a task needs.

    Raises
    ------
    InputError
        There are fewer cores or less memory than a task needs, or no memory where dask-jobqueue cannot request it.
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
    for key in ("memory", "job-mem", "mem"):  # for dask; SLURM's and LSF's requests
        if settings.get(key) is not None:
            n_bytes = _bytes_of(f"{path}: {kind}: {key}", settings[key])
            if n_bytes < least:
                raise InputError(
                    f"{path}: {kind}: {key}: expected at least {memory_words(least)} for {processes} of the largest "
                    f"tasks at a time, got {settings[key]}; omit it to let jobs request what tasks need"
                )
    if (name := MEMORY_KEYS.get(kind)) is not None and settings[name] is None:
        raise InputError(
            f"{path}: {kind}: expected {name} to request {memory_words(asked_for)} per job "
            "(dask-jobqueue does not do this by itself), got none; see your cluster's manual"
        )
    return Request(cores, n_bytes, processes, threads, need.room_of(n_bytes / processes), _exports(need, threads))


def _exports(need: Need, threads: int) -> tuple[str, ...]:
    """Return the workers' environment variables; more if they run tasks themselves."""
    names: dict[str, Any] = {SAFE_PATH_NAME: 1}  # a job's current folder may contain untrusted modules
    if need.is_within:
        names |= {f"DASK_{key.upper().replace('.', '__')}": value for key, value in WITHIN_SETTINGS.items()}
        names[THREADS_NAME] = threads
    return tuple(f"export {name}={value}" for name, value in names.items())


@contextmanager
def cluster_of(path: Path, kind: str, job: Request, folder: Path, logs: Path) -> Iterator[Any]:
    """Create a dask-jobqueue cluster without jobs; its scheduler is in this process, with its own certificates.

    Their files are in `folder` until the block ends.

    Raises
    ------
    InputError
        dask-jobqueue rejects its configuration.
    """
    import dask

    cls = _kinds()[kind]
    settings = dask.config.get(f"jobqueue.{kind}")
    with _refused(f"{path}: {kind}: dask-jobqueue rejects it"):
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
            # dask's threads are simultaneous tasks; the last of two values is used.
            worker_extra_args=[*settings["worker-extra-args"], "--nthreads", "1"],
            log_directory=settings["log-directory"] or str(logs),
            job_name="tetopt" if settings["name"] == "dask-worker" else settings["name"],
        )
    try:
        with cluster:
            yield cluster
    finally:  # not when it is collected, possibly after its folder was removed
        for value in list(vars(cluster).values()):
            if isinstance(value, tempfile._TemporaryFileWrapper):
                value.close()


def _watched(job_cls: Any, folder: Path, prologue: list[str]) -> Any:
    """Return a class of jobs that records rejected and ended jobs."""
    from distributed.core import Status

    class Watched(job_cls):
        def __init__(self, *arguments: Any, name: Any = None, **names: Any) -> None:
            self.ended = folder / f"{name}.ended"
            self.begun_at = time.monotonic()
            self.seen_at = float("inf")  # time of the last contact with one of its workers
            lines = [f"trap 'touch {self.ended} 2>/dev/null' EXIT", *prologue]
            super().__init__(*arguments, name=name, job_script_prologue=lines, **names)

        def is_over(self) -> bool:
            """Return whether it has ended; a rejected job ends after a while, when the system may accept another."""
            is_refused = self.status == Status.failed
            return time.monotonic() - self.begun_at > AGAIN_SECONDS if is_refused else self.ended.exists()

        async def start(self) -> None:
            self.ended.unlink(missing_ok=True)
            self.status = Status.failed  # until it is accepted
            await super().start()

        async def close(self) -> None:
            await super().close()
            self.status = Status.closed  # dask-jobqueue omits it, and dask asserts it

    return Watched


def _demand(newcomers: Newcomers, logs: Path) -> Any:
    """Return dask's adaptive scaling to the number of waiting tasks, as its scheduler knows only running ones.

    Ended jobs are replaced, which dask does not do for jobs that ended before their workers came, or with several
    workers.
    """
    from dask import config
    from dask.utils import parse_timedelta
    from distributed import Adaptive

    # After the last worker of a job has gone; a nanny restarts crashed workers within a second.
    patience = parse_timedelta(config.get("distributed.deploy.lost-worker-timeout"))

    class Demand(Adaptive):
        cluster: Any
        asked_at = float("inf")
        n_lost = 0  # jobs that ended before their worker came, since the last that came

        def slots(self) -> int:
            """Return the number of tasks that may run now; raise InputError if it will remain 0."""
            self.asked_at = time.monotonic()
            slots = newcomers.slots()
            if slots == 0 and self.n_lost >= MOST_LOST:
                raise InputError(f"`cluster`: {self.n_lost} jobs ended right after starting; see their logs in {logs}")
            return slots

        async def target(self) -> int:
            """Return the number of workers; called every `QUEUE_SECONDS`."""
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
    """Submit one job, as `scale` does not report rejected jobs."""
    cluster.worker_spec.update(cluster.new_worker_spec())
    await cluster


def _job_of(worker: Any) -> str:
    """Return the job of a worker, which may be one of several in it."""
    return str(worker.name).rpartition("-")[0]


def _kinds() -> dict[str, Any]:
    """Return the clusters of dask-jobqueue, by their names in its configuration."""
    import dask_jobqueue

    clusters = [value for value in vars(dask_jobqueue).values() if getattr(value, "job_cls", None)]
    return {cluster.job_cls.config_name: cluster for cluster in clusters}


@cache
def _defaults() -> dict[str, dict[str, Any]]:
    """Return the keys of each system with dask-jobqueue's defaults."""
    import yaml

    return yaml.safe_load(files("dask_jobqueue").joinpath("jobqueue.yaml").read_text(encoding="utf-8"))["jobqueue"]


def _yaml_of(path: Path) -> Any:
    import yaml

    text = text_of(path, "file of dask-jobqueue's configuration")
    for most, count, noun in (
        (YAML_LETTERS, len(text), "characters"),
        (YAML_BRACKETS, text.count("[") + text.count("{"), "brackets"),
    ):
        if count > most:
            raise InputError(f"{path}: expected at most {most} {noun} of YAML, got {count}")
    try:
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, Loader=yaml.SafeLoader)):
            raise InputError(
                f"{path}: expected YAML without aliases (*name), which may expand without limit; write out their values"
            )
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"{path}: expected YAML, got {_short(error)}; correct it there") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{path}: expected YAML, got {_short(error)}") from error


def _check_value(what: str, key: str, value: Any, default: Any) -> None:
    """Raise InputError if a value has another type than its key's."""
    if key == "walltime" and not isinstance(value, str):
        raise InputError(
            f'{what}: expected a quoted time such as "12:00:00" (unquoted, YAML reads seconds), got {_short(value)}'
        )
    if key in ("cores", "processes") and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
        raise InputError(f"{what}: expected a whole number above 0, got {_short(value)}")
    if key == "memory":
        _bytes_of(what, value)
    if isinstance(default, list) and not (isinstance(value, list) and all(isinstance(item, str) for item in value)):
        raise InputError(f"{what}: expected a list of strings, got {_short(value)}")
    if isinstance(default, dict) and not isinstance(value, dict):
        raise InputError(f"{what}: expected key-value pairs, got {_short(value)}")
    if not isinstance(default, list | dict) and isinstance(value, list | dict):
        raise InputError(f"{what}: expected one value, got {_short(value)}")


def _bytes_of(what: str, value: Any) -> float:
    from dask.utils import parse_bytes

    try:
        n_bytes = float(parse_bytes(value)) if isinstance(value, str | int) and not isinstance(value, bool) else -1.0
    except (ValueError, OverflowError):
        n_bytes = -1.0
    if not n_bytes > 0.0:
        raise InputError(f'{what}: expected an amount of memory such as "8 GB", got {_short(value)}')
    return n_bytes


@contextmanager
def _refused(what: str) -> Iterator[None]:
    """Raise one-line InputErrors for errors of dask-jobqueue, or of the batch system's commands."""
    try:
        yield
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        raise InputError(f"{what}: {_short(str(error).split('stderr:')[-1])}") from error


def _short(text: Any) -> str:
    words = " ".join(str(text).split())
    return words if len(words) <= 200 else f"{words[:197]}..."  # 200: one or two lines of a terminal
