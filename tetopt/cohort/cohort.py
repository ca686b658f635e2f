"""A cohort from its table to its page: many runs of the same kind, each as one alone, on the workers of a cluster."""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tetopt.cluster.crew import counted
from tetopt.cluster.tasks import SchedulerLost
from tetopt.cluster.workers import Folders, check_choice, workers
from tetopt.cohort.estimate import Estimate, estimated, need_of
from tetopt.cohort.layout import (
    LOGS_NAME,
    WORK_NAME,
    begin,
    check_out,
    failure_path,
    locked,
    not_our_files,
    restore,
)
from tetopt.cohort.numbers import Row, collect
from tetopt.cohort.options import CohortOptions
from tetopt.cohort.page import STATUS_WORDS, save_cohort_files
from tetopt.cohort.plan import (
    PlannedSubject,
    checked_suffix,
    chosen,
    entries_of,
    subjects_of,
    with_places,
    with_states,
)
from tetopt.cohort.run import Ended, SubjectTask
from tetopt.cohort.schedule import run_all
from tetopt.cohort.subjects import TABLE_SUFFIXES, Problems, key, write_table
from tetopt.engine.cost import Prediction
from tetopt.errors import InputError
from tetopt.job.events import Listener, listened, note, progress, started, violated, warning
from tetopt.job.job import in_kinds
from tetopt.job.options import RunOptions, kinds_of, near_hint
from tetopt.system.budget import memory_words
from tetopt.system.files import checked_output

NAMED_FAILURES = 20  # in words: the table and the page have all
MOST_BESIDE = 200  # subjects of a run beside others in one folder, each with a lock: a process has 1024 files at most
PAGE_SECONDS = 60.0  # between the table and page of a run under way and the next: nobody looks more often
PAGE_FRACTION = 0.05  # of the run's time that they may take


class CohortPlan(NamedTuple):
    """What a cohort is to do."""

    subjects: Path  # the table or folder
    cohort: CohortOptions
    threads: int | None
    suffix: str  # of the meshes' files
    keys: list[str]  # of all subjects
    entries: list[PlannedSubject]  # likewise; none where the folder is only to be collected
    to_run: list[PlannedSubject]
    estimate: Estimate  # of these

    @property
    def place(self) -> Path:
        """The folder of all outputs."""
        return self.cohort.output


class CohortProgress(NamedTuple):
    """How far the runs of a cohort are."""

    ended: Ended  # the last one
    n_done: int
    n_subjects: int  # that are run
    n_failed: int
    seconds_left: float | None  # as far as can be told; None of the last one


def run_cohort(
    subjects: str | Path, output: str | Path, *, on: Listener | None = None, **options: Any
) -> dict[str, str]:
    """Mesh many subjects, each as `run` would: what `tetopt cohort` does.

    Parameters
    ----------
    subjects : str or Path
        A table, .tsv or .csv, with the columns subject, image, and any option of a `Job`; or a BIDS folder.
    output : str or Path
        The folder of all outputs; in that of an earlier run, what is done stays.
    on : callable, optional
        Gets each `Event`; without one warnings are Python's warnings.
    **options
        Of all subjects, those of a `Job` but images, outputs and parts; and of the cohort: `suffix`, `participants`,
        `sessions`, `mesh_format`, `write_table`, `dry_run`, `retry_failed`, `collect`, `workers`,
        `scheduler`, `cluster`.

    Returns
    -------
    dict
        By subject, as "sub-01_ses-a", what there is now: "done", "violated" (a mesh that violates a requirement),
        "failed" or "missing".

    Raises
    ------
    InputError
        All that is wrong with table and options, before the first run.

    See Also
    --------
    run : One of them.

    Notes
    -----
    Workers are processes that begin by importing your program: let it call this under ``if __name__ == "__main__":``.

    Examples
    --------
    >>> tetopt.save_image("ball.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    >>> with open("subjects.csv", "w") as table:
    ...     _ = table.write("subject,image,nodes\\n1,ball.nii.gz,60\\n")
    >>> tetopt.run_cohort("subjects.csv", "meshes", iterations=1, dry_run=True)
    {'sub-1': 'missing'}
    """
    values = {"output": output, **options}
    known = kinds_of(CohortOptions) | kinds_of(RunOptions)
    for name in values:
        if name not in known:
            raise InputError(f"run_cohort: has no option {name!r}" + near_hint(name, known))
    of_cohort = {name: value for name, value in values.items() if name in kinds_of(CohortOptions)}
    of_runs = {name: value for name, value in values.items() if name not in of_cohort}
    with listened(on):
        plan = plan_cohort(Path(subjects), in_kinds(CohortOptions, of_cohort), in_kinds(RunOptions, of_runs))
        if plan.cohort.write_table is not None or plan.cohort.dry_run:
            return {entry.key: entry.state.status for entry in plan.entries}
        rows = run_planned(plan)
        return {row.key: row.status for row in rows if row.key in set(plan.keys)}


def plan_cohort(subjects: Path, cohort: CohortOptions, options: RunOptions) -> CohortPlan:
    """What a cohort is to do, told; or, if that is asked for, the table of it written.

    Raises
    ------
    InputError
        Options that cannot be; `Problems` for all that is wrong with the subjects.
    """
    check_choice(cohort.workers, cohort.scheduler, cohort.cluster, "cohort")
    suffix = checked_suffix(cohort.mesh_format)
    place = cohort.output
    if options.threads is not None and options.threads < 1:
        raise InputError(f"`threads`: expected 1 or more, got {options.threads}")
    if cohort.collect and (cohort.write_table is not None or cohort.dry_run or cohort.retry_failed):
        raise InputError("`collect` runs nothing; leave it out, or `write_table`, `dry_run` and `retry_failed`")
    if cohort.write_table is not None:
        checked_output(cohort.write_table, TABLE_SUFFIXES)
    check_out(place)
    if (place / WORK_NAME).is_dir() and cohort.write_table is None and not cohort.dry_run:
        with locked(place, []):  # said here as well, as the plan of many subjects takes minutes
            pass
    rows = subjects_of(subjects, cohort)
    plan = CohortPlan(subjects, cohort, options.threads, suffix, [key(row) for row in rows], [], [], {})
    if cohort.collect:
        if problems := [wrong for each in plan.keys if (wrong := not_our_files(place, each)) is not None]:
            raise Problems(problems)
        return plan
    entries = entries_of(rows, options, place, suffix)
    to_run = with_places(chosen(entries, cohort.retry_failed), place)
    plan = plan._replace(entries=entries, to_run=to_run)
    if cohort.write_table is not None:
        write_table(cohort.write_table, [entry.row() for entry in entries])
        return plan
    _tell_plan(plan)
    return plan._replace(estimate=estimated(to_run))


def _tell_plan(plan: CohortPlan) -> None:
    """How many subjects there are of each kind, and why the ones are run that are there already."""
    counts = Counter[str](entry.state.status for entry in plan.entries)
    words = {name: STATUS_WORDS.get(name, name) for name in ("done", "violated", "failed", "changed")}
    words["missing"] = "not yet run"
    parts = [f"{counts[name]} {text}" for name, text in words.items() if counts[name]]
    note(f"{counted(len(plan.entries), 'subject')}: {', '.join(parts)}; {len(plan.to_run)} to run")
    reasons = Counter((e.state.status, e.state.why) for e in plan.to_run if e.state.status in ("changed", "failed"))
    for (status, why), number in reasons.most_common(NAMED_FAILURES):
        note(f"  {number} {status}: {why}")
    if plan.cohort.retry_failed and counts["changed"]:
        warning(f"{counts['changed']} subjects stay as they are, of other options or inputs (`retry_failed`)")


def run_planned(plan: CohortPlan) -> list[Row]:
    """Run what a plan has to be run, and write the table and the page of what there is then; their rows.

    They are told as a stage of their own, "collected", also where the run is interrupted.
    """
    place, keys, cohort = plan.place, plan.keys, plan.cohort
    # Beside runs of others, one folder's.
    alone = keys if plan.entries and cohort.participants and len(keys) <= MOST_BESIDE else None
    begin(place, [plan.subjects.absolute().as_uri()])
    with locked(place, alone):
        restore(place, alone)
        # Once more: another run may have ended since.
        to_run = chosen(with_states(plan.to_run, place, plan.suffix), cohort.retry_failed)
        for entry in plan.entries:
            if entry.state.status in ("done", "violated"):  # what failed since was of other options or inputs
                failure_path(place, entry.key).unlink(missing_ok=True)
        try:
            if to_run:
                _run(plan, to_run)
        finally:  # also on Ctrl-C: what is done is seen
            if plan.entries:
                restore(place, alone)
            rows = collect(place, keys)
            save_cohort_files(place, rows)
            started("collected")
            progress(f"table and page of {counted(len(rows), 'subject')}", rows)
    return rows


def _run(plan: CohortPlan, to_run: Sequence[PlannedSubject]) -> None:
    """Run the subjects; what becomes of each is told."""
    place, cohort, estimate = plan.place.absolute(), plan.cohort, plan.estimate
    work = place / WORK_NAME
    alive = work / f"run-{secrets.token_hex(4)}"
    alive.touch()
    need = need_of(len(to_run), estimate, cohort, plan.threads)
    try:
        with workers(
            need,
            Folders(work, place / LOGS_NAME),
            count=cohort.workers,
            scheduler=cohort.scheduler,
            cluster=cohort.cluster,
        ) as pool:
            note(pool.words)
            jobs = [_job(entry, estimate, place, plan.suffix, pool.threads, alive.name) for entry in to_run]
            jobs.sort(key=lambda job: -job.seconds)  # so that no long one is left alone at the end
            refresh, tell = _refresher(place), _teller(jobs, pool.slots())
            try:
                for ended in run_all(jobs, pool.client, pool.slots, pool.bytes):
                    tell(ended)
                    refresh()
            finally:  # before the workers are closed, which give up what they run as soon as they see it
                alive.unlink(missing_ok=True)
    except SchedulerLost as lost:
        violated(f"{lost}; what was finished is in its place")


def _refresher(place: Path) -> Callable[[], None]:
    """A function that writes the table and the page of what is there by now, now and then."""
    last, spent = time.monotonic(), 0.0

    def refresh() -> None:
        nonlocal last, spent
        begun = time.monotonic()
        if begun - last > max(PAGE_SECONDS, spent / PAGE_FRACTION):
            save_cohort_files(place, collect(place))
            last = time.monotonic()
            spent = last - begun

    return refresh


def _job(entry: PlannedSubject, estimate: Estimate, place: Path, suffix: str, threads: int, run: str) -> SubjectTask:
    one = estimate.get(entry.key, Prediction(0.0, 0.0, 0.0))
    return SubjectTask(entry.key, entry.words(), str(place), suffix, threads, one.peak_bytes, one.seconds, run)


def _teller(jobs: Sequence[SubjectTask], n_at_once: int) -> Callable[[Ended], None]:
    """A function that tells how a subject ended, and how much time the others may take; first that of all is told."""
    begun = time.monotonic()
    left = {job.key: max(job.seconds, 1.0) for job in jobs}
    total, n_failed = sum(left.values()), 0
    started("subjects", f"about {time_words(total / max(n_at_once, 1))} left, as predicted", len(jobs))

    def tell(ended: Ended) -> None:
        nonlocal n_failed
        n_failed += ended.status == "failed"
        left.pop(ended.key, None)
        rest = sum(left.values())
        seconds_left = (time.monotonic() - begun) * rest / max(total - rest, 1.0) if left else None
        what = {"done": "done", "violated": f"a requirement is violated: {ended.reason}"}.get(
            ended.status, ended.reason
        )
        memory = f", {memory_words(ended.peak_bytes)}" if ended.peak_bytes else ""
        at = CohortProgress(ended, len(jobs) - len(left), len(jobs), n_failed, seconds_left)
        progress(f"{ended.key}: {what} ({ended.seconds:.0f} s{memory})", at)

    return tell


def time_words(seconds: float) -> str:
    """A time in words."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
