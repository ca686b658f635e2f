"""``tetopt cohort``: many subjects, each as `tetopt mesh` alone would mesh it, on the workers of a cluster."""

from __future__ import annotations

import contextlib
import secrets
import shlex
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from tetopt.budget import available_bytes, memory_words
from tetopt.cli.cohort_plan import (
    PlannedSubject,
    checked_suffix,
    chosen,
    entries_of,
    subjects_of,
    with_places,
    with_states,
)
from tetopt.cli.console import log, out, show_error, show_warning
from tetopt.cli.options import CohortOptions, SubjectsArgument
from tetopt.cluster.crew import counted
from tetopt.cluster.tasks import SchedulerLost
from tetopt.cluster.workers import Folders, Need, check_choice, local_share, workers
from tetopt.cohort.layout import (
    LOGS_NAME,
    PAGE_NAME,
    TABLE_NAME,
    WORK_NAME,
    begin,
    check_out,
    description,
    failure_path,
    locked,
    not_our_files,
    restore,
)
from tetopt.cohort.numbers import collect
from tetopt.cohort.page import save_cohort_files
from tetopt.cohort.run import Ended, SubjectTask
from tetopt.cohort.schedule import run_all
from tetopt.cohort.subjects import TABLE_SUFFIXES, Problems, key, write_table
from tetopt.engine.cost import Prediction, RunSize, calibrated_speed, predicted
from tetopt.errors import InputError
from tetopt.io.files import checked_output
from tetopt.io.images import file_shape
from tetopt.job.events import listened
from tetopt.job.inputs import read_mesh
from tetopt.job.options import RunOptions, SizeOptions
from tetopt.job.plan import with_numbers
from tetopt.job.predict import size_by_headers, size_of_run
from tetopt.job.source import read_source

NAMED_FAILURES = 20  # on the terminal: the table and the page have all
MOST_BESIDE = 200  # subjects of a run beside others in one folder, each with a lock: a process has 1024 files at most
PAGE_SECONDS = 60.0  # between the table and page of a run under way and the next: nobody looks more often
PAGE_SHARE = 0.05  # of the run's time that they may take
LIKE_READS = 8  # subjects of a kind that are read to see what headers do not tell: half a minute of large ones


class Estimate(NamedTuple):
    """What the subjects that are to be run are predicted to take."""

    each: dict[str, Prediction]  # by key, on one thread

    def largest(self) -> float:
        """Bytes of the one that takes most, 0 of none."""
        return max((prediction.peak_bytes for prediction in self.each.values()), default=0.0)

    def seconds(self) -> float:
        """Of all, one after the other."""
        return sum(prediction.seconds for prediction in self.each.values())


def cohort_command(
    context: typer.Context,
    subjects: SubjectsArgument,
    cohort: CohortOptions,
    options: RunOptions,
) -> int:
    """Mesh many subjects of a table or a BIDS folder, on this machine or a cluster; go on where it ended."""
    check_choice(cohort.count, cohort.scheduler, cohort.cluster, "cohort")
    suffix = checked_suffix(cohort.mesh_format)
    place = cohort.output
    if options.threads is not None and options.threads < 1:
        raise InputError(f"--threads: expected 1 or more, got {options.threads}")
    if cohort.collect and (cohort.write_table is not None or cohort.dry_run or cohort.retry_failed):
        raise InputError("--collect runs nothing; leave it out, or --write-table, --dry-run and --retry-failed")
    if cohort.write_table is not None:
        checked_output(cohort.write_table, TABLE_SUFFIXES)
    check_out(place)
    if (place / WORK_NAME).is_dir() and cohort.write_table is None and not cohort.dry_run:
        with locked(place, []):  # said here as well, as the plan of many subjects takes minutes
            pass
    try:
        rows = subjects_of(subjects, cohort)
        if cohort.collect:
            return _collected(place, subjects, [key(row) for row in rows])
        entries = entries_of(rows, options, place, suffix, log.print)
        to_run = with_places(chosen(entries, cohort.retry_failed), place)
    except Problems as problems:
        for line in problems.lines:
            show_error(line)
        log.print(f"nothing was run: {len(problems.lines)} to mend")
        return 2
    if cohort.write_table is not None:
        write_table(cohort.write_table, [entry.row() for entry in entries])
        out.print(escape(f"{cohort.write_table}: {len(rows)} subjects"))
        return 0
    _say_plan(entries, to_run, cohort.retry_failed)
    estimate = estimated(to_run)
    if cohort.dry_run:
        _say_estimate(to_run, estimate, cohort, options.threads)
        return 0
    keys = [entry.key for entry in entries]
    alone = keys if cohort.participants and len(keys) <= MOST_BESIDE else None  # beside runs of others, one folder's
    _begin(place, subjects)
    with locked(place, alone):
        restore(place, alone)
        # Once more: another run may have ended since.
        to_run = chosen(with_states(to_run, place, suffix, lambda _: None), cohort.retry_failed)
        for entry in entries:
            if entry.state.status in ("done", "missed"):  # what failed since was of other options or inputs
                failure_path(place, entry.key).unlink(missing_ok=True)
        try:
            if to_run:
                _run(to_run, estimate, cohort, suffix, options.threads)
        finally:  # also on Ctrl-C: what is done is seen
            restore(place, alone)
            code = _close(place, keys)
            _say_rerun(code, context.obj)
    return code


def _begin(place: Path, subjects: Path) -> None:
    begin(place, description("Tetrahedral meshes by tetopt", [subjects.absolute().as_uri()]))


def _collected(place: Path, subjects: Path, keys: list[str]) -> int:
    """The table and the page of what is there, with nothing run; the exit code."""
    if problems := [wrong for key in keys if (wrong := not_our_files(place, key)) is not None]:
        raise Problems(problems)
    _begin(place, subjects)
    with locked(place):
        restore(place)
        return _close(place, keys)


def _say_plan(entries: Sequence[PlannedSubject], to_run: Sequence[PlannedSubject], only_failed: bool) -> None:
    """How many subjects there are of each kind, and why the ones are run that are there already."""
    counts = Counter[str](entry.state.status for entry in entries)
    words = {"done": "done", "missed": "done, but a promise missed", "failed": "failed", "changed": "changed"}
    parts = [f"{counts[name]} {text}" for name, text in words.items() if counts[name]]
    parts += [f"{counts['missing']} not yet run"] if counts["missing"] else []
    log.print(f"{counted(len(entries), 'subject')}: {', '.join(parts)}; {len(to_run)} to run")
    reasons = Counter((e.state.status, e.state.why) for e in to_run if e.state.status in ("changed", "failed"))
    for (status, why), number in reasons.most_common(NAMED_FAILURES):
        log.print(escape(f"  {number} {status}: {why}"))
    if only_failed and counts["changed"]:
        show_warning(f"{counts['changed']} subjects stay as they are, of other options or inputs (--retry-failed)")


def estimated(entries: Sequence[PlannedSubject]) -> Estimate:
    """What subjects are predicted to take, each on one thread: by their headers, and some of each kind as they are.

    Of the same kind are those of as many files and the same options; of one whose images have several shapes, one of
    each shape is read, up to `LIKE_READS`, as what labels take differs more between than within.
    """
    speed = calibrated_speed() if entries else 1.0
    like: dict[tuple[object, ...], dict[tuple[int, ...], RunSize]] = {}
    reads: Counter[tuple[object, ...]] = Counter()
    each = {}
    for entry in entries:
        job = entry.job
        files = len(job.images), job.mask is None, job.labels is None
        kind = (*files, job.background, *(getattr(job, field.name) for field in fields(SizeOptions)))
        known = like.setdefault(kind, {})
        try:
            shape = file_shape(job.images[0]) or ()
            if shape not in known and reads[kind] < LIKE_READS:
                reads[kind] += 1
                if (size := _read_size(entry)) is not None:
                    known[shape] = size
            nearest = known.get(shape) or next(iter(known.values()), None)
            each[entry.key] = predicted(size_by_headers(entry.plan, nearest), 1, speed)
        except InputError:  # its run will say it
            continue
    return Estimate(each)


def _read_size(entry: PlannedSubject) -> RunSize | None:
    """The sizes of a run whose files are read; None if they cannot be, which its run will say."""
    try:
        with listened(lambda event: None), contextlib.redirect_stderr(StringIO()):
            source = read_source(entry.job, entry.job.label_names)
            plan, _ = with_numbers(entry.plan, source.content)
            begun = plan.job.start
            n_started = None if begun is None else len(read_mesh(begun).mesh.points)
    except (InputError, OSError):
        return None
    return size_of_run(plan, source.content, source.contrasts[0], n_started)


def _need(n_tasks: int, estimate: Estimate, cohort: CohortOptions, threads: int | None) -> Need:
    """What workers are to have room for: on this machine not for what is larger than all of it, and will not begin."""
    sizes = [each.peak_bytes for each in estimate.each.values()]
    free = available_bytes()
    if free is not None and cohort.scheduler is None and cohort.cluster is None:
        sizes = [each for each in sizes if each <= free]
    return Need(n_tasks, max(sizes, default=0.0), threads)


def _say_estimate(
    to_run: Sequence[PlannedSubject], estimate: Estimate, cohort: CohortOptions, threads: int | None
) -> None:
    """What would be run, and what it takes."""
    for entry in to_run:
        if (one := estimate.each.get(entry.key)) is None:
            out.print(escape(f"{entry.key}: sizes unknown: its image cannot be read"))
        else:
            out.print(escape(f"{entry.key}: {one.seconds:.0f} s on a thread, {memory_words(one.peak_bytes)}"))
    whole = f"in all {_time(estimate.seconds())} on one thread, at most {memory_words(estimate.largest())} each"
    if cohort.cluster is not None or cohort.scheduler is not None or not to_run:
        out.print(f"{whole}; divided by as many as the cluster runs at a time" if to_run else "nothing to run")
        return
    share = local_share(_need(len(to_run), estimate, cohort, threads), cohort.count)
    out.print(f"{whole}; on this machine {share.workers} at a time: about {_time(estimate.seconds() / share.workers)}")


def _run(
    to_run: Sequence[PlannedSubject], estimate: Estimate, cohort: CohortOptions, suffix: str, threads: int | None
) -> None:
    """Run the subjects; what becomes of each is said."""
    place = cohort.output.absolute()
    work = place / WORK_NAME
    alive = work / f"run-{secrets.token_hex(4)}"
    alive.touch()
    need = _need(len(to_run), estimate, cohort, threads)
    try:
        with workers(
            need,
            Folders(work, place / LOGS_NAME),
            count=cohort.count,
            scheduler=cohort.scheduler,
            cluster=cohort.cluster,
        ) as pool:
            log.print(escape(pool.words))
            jobs = [_job(entry, estimate, place, suffix, pool.threads, alive.name) for entry in to_run]
            jobs.sort(key=lambda job: -job.seconds)  # so that no long one is left alone at the end
            refresh = _refresher(place)
            try:
                with _progress(jobs, pool.slots()) as show:
                    for ended in run_all(jobs, pool.client, pool.slots, pool.bytes):
                        show(ended)
                        refresh()
            finally:  # before the workers are closed, which give up what they run as soon as they see it
                alive.unlink(missing_ok=True)
    except SchedulerLost as lost:
        show_error(f"{lost}; what was finished is in its place")


def _refresher(place: Path) -> Callable[[], None]:
    """A function that writes the table and the page of what is there by now, now and then."""
    last, spent = time.monotonic(), 0.0

    def refresh() -> None:
        nonlocal last, spent
        begun = time.monotonic()
        if begun - last > max(PAGE_SECONDS, spent / PAGE_SHARE):
            save_cohort_files(place, collect(place))
            last = time.monotonic()
            spent = last - begun

    return refresh


def _job(entry: PlannedSubject, estimate: Estimate, place: Path, suffix: str, threads: int, run: str) -> SubjectTask:
    one = estimate.each.get(entry.key, Prediction(0.0, 0.0, 0.0))
    return SubjectTask(entry.key, entry.words(), str(place), suffix, threads, one.peak_bytes, one.seconds, run)


@contextlib.contextmanager
def _progress(jobs: Sequence[SubjectTask], n_at_once: int) -> Iterator[Callable[[Ended], None]]:
    """A function that shows how a subject ended: a bar on a terminal, else a line; both with an estimate of the end."""
    begun = time.monotonic()
    left = {job.key: max(job.seconds, 1.0) for job in jobs}
    total, n_failed = sum(left.values()), 0
    at_first = f"about {_time(total / max(n_at_once, 1))} left, as predicted"

    def words(ended: Ended) -> str:
        left.pop(ended.key, None)
        rest = sum(left.values())
        spent = time.monotonic() - begun
        about = f", about {_time(spent * rest / max(total - rest, 1.0))} left" if left else ""
        return f"{n_failed} failed{about}"

    def line(ended: Ended) -> str:
        what = {"done": "done", "missed": f"a promise is missed: {ended.reason}"}.get(ended.status, ended.reason)
        memory = f", {memory_words(ended.peak_bytes)}" if ended.peak_bytes else ""
        return f"{ended.key}: {what} ({ended.seconds:.0f} s{memory})"

    if log.is_terminal:
        columns = TextColumn("subjects"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[words]}")
        with Progress(*columns, console=log) as bar:
            task = bar.add_task("", total=len(jobs), words=at_first)

            def show(ended: Ended) -> None:
                nonlocal n_failed
                n_failed += ended.status == "failed"
                if ended.status != "done":
                    bar.console.print(escape(line(ended)))
                bar.update(task, advance=1, words=words(ended))

            yield show
    else:
        log.print(at_first)

        def show_line(ended: Ended) -> None:
            nonlocal n_failed
            n_failed += ended.status == "failed"
            rest = words(ended)
            log.print(escape(f"{line(ended)}; {len(jobs) - len(left)} of {len(jobs)}, {rest}"))

        yield show_line


def _close(place: Path, keys: list[str]) -> int:
    """Write the table and the page, and say what there is; the exit code."""
    rows = collect(place, keys)
    save_cohort_files(place, rows)
    own = [row for row in rows if row.key in set(keys)]
    counts = Counter[str](row.status for row in own)
    for row in [row for row in own if row.status == "failed"][:NAMED_FAILURES]:
        log.print(escape(f"{row.key}: {row.reason}"))
    words = {"done": "done", "missed": "done, but a promise missed", "failed": "failed", "missing": "not run"}
    parts = [f"{counts[name]} {text}" for name, text in words.items() if counts[name]]
    out.print(f"{counted(len(own), 'subject')}: {', '.join(parts)}")
    if len(rows) > len(own):
        log.print(
            escape(
                f"{counted(len(rows) - len(own), 'subject')} more in {place}, from other tables, are shown with these"
            )
        )
    for name in (PAGE_NAME, TABLE_NAME):
        out.print(escape(str(place / name)))
    return 1 if counts["failed"] or counts["missing"] else 0


def _say_rerun(code: int, arguments: Sequence[str]) -> None:
    if code:
        words = " ".join(map(shlex.quote, arguments))
        log.print(escape(f"to go on with what is missing or failed, and with that alone: tetopt {words}"))


def _time(seconds: float) -> str:
    """A time in words."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
