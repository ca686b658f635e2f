"""A cohort from its table to its page: many independent runs on the workers of a cluster."""

from __future__ import annotations

import shlex
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tetopt.cohort.cohort_page import STATUS_WORDS, save_cohort_files
from tetopt.cohort.cohort_plan import (
    PlannedSubject,
    choose_subjects,
    entries_of,
    subjects_of,
    suffix_of_meshes,
    with_states,
)
from tetopt.cohort.estimate import Estimate, estimate_memory, share_for
from tetopt.cohort.layout import (
    WORK_NAME,
    begin,
    check_out,
    clean,
    failure_path,
    linked_place,
    notes_path,
    table_in,
)
from tetopt.cohort.numbers import Row, collect
from tetopt.cohort.options import CohortOptions
from tetopt.cohort.subject_runs import Ended, SubjectTask, run_all
from tetopt.cohort.subjects import TABLE_SUFFIXES, Problems, key, write_table
from tetopt.errors import InputError
from tetopt.io.text import count_text
from tetopt.job.events import (
    Listener,
    listen_with,
    note,
    progress,
    report_violation,
    start_stage,
    warning,
)
from tetopt.job.job import in_kinds
from tetopt.job.options import RunOptions, kinds_of, near_hint
from tetopt.job.plan import changed_options
from tetopt.system.budget import memory_words
from tetopt.system.files import check_output, save_json
from tetopt.system.work_directory import lock_directory
from tetopt.workers import SchedulerLost, check_workers, workers

NAMED_FAILURES = 20  # reasons printed: the table and the page have all
# subjects of a run next to others in the folder, with a lock each: a process may open 1024 files
MOST_BESIDE = 200
PAGE_SECONDS = 60.0  # between updates of the table and page during a run
PAGE_FRACTION = 0.05  # maximum fraction of the run's time for these updates


class CohortPlan(NamedTuple):
    """The plan of a cohort."""

    subjects: Path  # the table or folder
    cohort: CohortOptions
    threads: int | None
    suffix: str  # of the meshes' files
    keys: list[str]  # of all subjects
    entries: list[PlannedSubject]  # of all subjects; empty if the folder is only collected
    to_run: list[PlannedSubject]
    estimate: Estimate  # of the subjects to run


class CohortProgress(NamedTuple):
    """Progress of a cohort."""

    ended: Ended  # the last run
    n_done: int
    n_subjects: int  # to run
    n_failed: int
    seconds_left: float | None  # estimated; None for the last run


def run_cohort(
    subjects: str | Path, output: str | Path, *, on: Listener | None = None, **options: Any
) -> dict[str, str]:
    """Mesh many subjects, each with `run`, like `tetopt cohort`.

    Parameters
    ----------
    subjects : str or Path
        A table, .tsv or .csv, with the columns subject, image, and any option of a `Job`; or a BIDS
        folder.
    output : str or Path
        The folder of all outputs; finished subjects of an earlier run are kept.
    on : callable, optional
        Called with each `Event`; without it, warnings are Python's warnings.
    **options
        For all subjects, those of a `Job` except images and outputs; for the cohort:
        `suffix`, `participants`, `sessions`, `mesh_format`, `write_table`, `dry_run`,
        `retry_failed`, `collect`, `workers`, `scheduler`.

    Returns
    -------
    dict
        By subject, as "sub-01_ses-a", its status: "done", "violated" (the mesh violates a
        requirement), "failed" or "missing".

    Raises
    ------
    InputError
        All problems of the table and options, before the first run.

    See Also
    --------
    run : Mesh one subject.

    Notes
    -----
    Workers are processes that first import your program: call this function under ``if __name__ ==
    "__main__":``.

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
            raise InputError(f"run_cohort: unknown option {name!r}" + near_hint(name, known))
    of_cohort = {name: value for name, value in values.items() if name in kinds_of(CohortOptions)}
    of_runs = {name: value for name, value in values.items() if name not in of_cohort}
    with listen_with(on):
        plan = plan_cohort(
            Path(subjects), in_kinds(CohortOptions, of_cohort), in_kinds(RunOptions, of_runs)
        )
        if plan.cohort.write_table is not None or plan.cohort.dry_run:
            return {entry.key: entry.state.status for entry in plan.entries}
        rows = run_planned(plan)
        return {row.key: row.status for row in rows if row.key in set(plan.keys)}


def plan_cohort(subjects: Path, cohort: CohortOptions, options: RunOptions) -> CohortPlan:
    """Plan a cohort and report the plan; on request, write its table.

    Raises
    ------
    InputError
        Options are invalid; `Problems` lists all problems of the subjects.
    """
    check_workers(cohort.workers, cohort.scheduler)
    suffix = suffix_of_meshes(cohort.mesh_format)
    place = cohort.output
    if options.threads is not None and options.threads < 1:
        raise InputError(f"`threads`: expected 1 or more, got {options.threads}")
    if cohort.collect and (cohort.write_table is not None or cohort.dry_run or cohort.retry_failed):
        raise InputError(
            "`collect` runs no subjects; omit it, or `write_table`, `dry_run` and `retry_failed`"
        )
    if cohort.write_table is not None:
        check_output(cohort.write_table, TABLE_SUFFIXES)
    check_out(place)
    if (place / WORK_NAME).is_dir() and cohort.write_table is None and not cohort.dry_run:
        # checked here as well, as planning many subjects takes minutes
        with lock_directory(place / WORK_NAME, []):
            pass
    rows = subjects_of(subjects, cohort)
    plan = CohortPlan(
        subjects, cohort, options.threads, suffix, [key(row) for row in rows], [], [], {}
    )
    if cohort.collect:
        return plan
    entries = entries_of(rows, options, place, suffix)
    to_run = choose_subjects(entries, cohort.retry_failed)
    if links := [
        wrong for entry in to_run if (wrong := linked_place(place, entry.key)) is not None
    ]:
        raise Problems(list(dict.fromkeys(links)))
    plan = plan._replace(entries=entries, to_run=to_run)
    if cohort.write_table is not None:
        write_table(cohort.write_table, [entry.row() for entry in entries])
        return plan
    _tell_plan(plan)
    return plan._replace(estimate=estimate_memory(to_run))


def _tell_plan(plan: CohortPlan) -> None:
    """Report the number of subjects of each kind, and why existing ones are run again."""
    counts = Counter[str](entry.state.status for entry in plan.entries)
    words = {
        name: STATUS_WORDS.get(name, name) for name in ("done", "violated", "failed", "changed")
    }
    words["missing"] = "not yet run"
    parts = [f"{counts[name]} {text}" for name, text in words.items() if counts[name]]
    note(
        f"{count_text(len(plan.entries), 'subject')}: {', '.join(parts)}; {len(plan.to_run)} to run"
    )
    reasons = Counter(
        (e.state.status, e.state.why)
        for e in plan.to_run
        if e.state.status in ("changed", "failed")
    )
    for (status, why), number in reasons.most_common(NAMED_FAILURES):
        note(f"  {number} {status}: {why}")
    if plan.cohort.retry_failed and counts["changed"]:
        warning(f"{counts['changed']} subjects are out of date and were skipped (`retry_failed`)")


def run_planned(plan: CohortPlan) -> list[Row]:
    """Run a plan's subjects, write the table and the page of the folder, and return their rows.

    The rows are reported in a stage "collected", even if the run is interrupted.
    """
    place, keys, cohort = plan.cohort.output, plan.keys, plan.cohort
    # Other runs may use the same folder.
    alone = keys if plan.entries and cohort.participants and len(keys) <= MOST_BESIDE else None
    begin(place, [plan.subjects.absolute().as_uri()])
    with lock_directory(place / WORK_NAME, alone):
        clean(place, alone)
        # Again, as another run may have ended since.
        to_run = choose_subjects(with_states(plan.to_run, place, plan.suffix), cohort.retry_failed)
        for entry in plan.entries:
            if (table_in(notes := notes_path(place, entry.key)) or {}) != entry.subject.notes:
                save_json(notes, entry.subject.notes)
            # later failures had other options or inputs
            if entry.state.status in ("done", "violated"):
                failure_path(place, entry.key).unlink(missing_ok=True)
        try:
            if to_run:
                _run(plan, to_run)
        finally:  # also on Ctrl-C, to show what is done
            if plan.entries:
                clean(place, alone)
            rows = collect(place, keys)
            save_cohort_files(place, rows)
            start_stage("collected")
            progress(f"table and page of {count_text(len(rows), 'subject')}", rows)
    return rows


def _run(plan: CohortPlan, to_run: Sequence[PlannedSubject]) -> None:
    """Run the subjects, and report each outcome and the remaining time at the pace of those that
    ended.
    """
    place, cohort, n_tasks, n_failed = plan.cohort.output.absolute(), plan.cohort, len(to_run), 0
    share = share_for(n_tasks, plan.estimate, cohort, plan.threads)
    try:
        with workers(share, cohort.scheduler, plan.threads) as pool:
            note(pool.words())
            tasks = [_task(entry, plan.estimate, place, plan.suffix) for entry in to_run]
            # so that no large run remains alone at the end
            tasks.sort(key=lambda task: -task.n_bytes)
            start_stage(
                "subjects",
                f"{count_text(n_tasks, 'subject')}, {max(pool.slots(), 1)} at a time",
                n_tasks,
            )
            start = time.monotonic()
            for n_done, ended in enumerate(
                _with_pages(run_all(tasks, pool, place), place), start=1
            ):
                n_failed += ended.status == "failed"
                left = (
                    (time.monotonic() - start) * (n_tasks / n_done - 1.0)
                    if n_done < n_tasks
                    else None
                )
                progress(
                    _outcome_words(ended), CohortProgress(ended, n_done, n_tasks, n_failed, left)
                )
    except SchedulerLost as lost:
        report_violation(f"{lost}; finished subjects are kept")


def _outcome_words(ended: Ended) -> str:
    """Describe the outcome of a run in one line."""
    what = {"done": "done", "violated": f"requirement violated: {ended.reason}"}.get(
        ended.status, ended.reason
    )
    memory = f", {memory_words(ended.peak_bytes)}" if ended.peak_bytes else ""
    return f"{ended.key}: {what} ({ended.seconds:.0f} s{memory})"


def _with_pages(outcomes: Iterable[Ended], place: Path) -> Iterator[Ended]:
    """Pass outcomes on, and update the table and the page from time to time."""
    refresh_at = time.monotonic() + PAGE_SECONDS
    for ended in outcomes:
        yield ended
        if (start := time.monotonic()) > refresh_at:
            save_cohort_files(place, collect(place))
            refresh_at = start + max(PAGE_SECONDS, (time.monotonic() - start) / PAGE_FRACTION)


def _task(entry: PlannedSubject, estimate: Estimate, place: Path, suffix: str) -> SubjectTask:
    command = shlex.join(["tetopt", "mesh", "-o", f"{entry.key}{suffix}", *entry.words()])
    job = changed_options(entry.plan.bare, threads=None)  # its worker's
    return SubjectTask(entry.key, job, suffix, place, estimate.get(entry.key, 0.0), command)
