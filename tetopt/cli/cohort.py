"""``tetopt cohort``: many subjects, each meshed as by `tetopt mesh`, on the workers of a
cluster.
"""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from tetopt.cli.console import in_options, log, print_line, show_error, show_event
from tetopt.cohort.cohort import (
    NAMED_FAILURES,
    CohortPlan,
    CohortProgress,
    plan_cohort,
    run_planned,
)
from tetopt.cohort.cohort_page import STATUS_WORDS
from tetopt.cohort.estimate import share_for
from tetopt.cohort.layout import PAGE_NAME, TABLE_NAME
from tetopt.cohort.numbers import Row
from tetopt.cohort.options import CohortOptions
from tetopt.cohort.subjects import Problems
from tetopt.io.text import count_text
from tetopt.job.events import Event, listen_with, time_words
from tetopt.job.options import Option, RunOptions
from tetopt.system.budget import memory_words


def cohort_command(
    context: typer.Context,
    subjects: Annotated[
        Path,
        Option(
            "SUBJECTS",
            "A .tsv or .csv table (subject, image, ...), or a BIDS folder.",
            is_argument=True,
        ),
    ],
    cohort: CohortOptions,
    options: RunOptions,
) -> int:
    """Mesh many subjects from a table or a BIDS folder, here or on a dask cluster; resume an
    interrupted run.
    """
    try:
        plan = plan_cohort(subjects, cohort, options)
    except Problems as problems:
        for line in problems.lines:
            show_error(line)
        log.print(f"nothing was run; problems to fix: {len(problems.lines)}")
        return 2
    if cohort.write_table is not None:
        print_line(f"{cohort.write_table}: {len(plan.entries)} subjects")
        return 0
    if cohort.dry_run:
        _say_estimate(plan)
        return 0
    display = _CohortDisplay(plan, [] if cohort.collect else context.obj)
    with listen_with(display):
        run_planned(plan)
    return display.code


def _say_estimate(plan: CohortPlan) -> None:
    """Print which subjects would be run, with their memory."""
    to_run = plan.to_run
    estimate = plan.estimate
    cohort = plan.cohort
    for entry in to_run:
        if (one := estimate.get(entry.key)) is None:
            print_line(f"{entry.key}: size unknown because its image cannot be read")
        else:
            print_line(f"{entry.key}: {memory_words(one)}")
    if not to_run:
        print_line("nothing to run")
        return
    whole = (
        f"{count_text(len(to_run), 'subject')}, up to about "
        f"{memory_words(max(estimate.values(), default=0.0))} each"
    )
    if cohort.scheduler is None:
        n_workers = share_for(len(to_run), estimate, cohort, plan.threads).workers
        whole += f"; {n_workers} at a time on this machine"
    print_line(whole)


class _CohortDisplay:
    """The listener of a cohort: a bar on a terminal, else a line for each subject; a summary at the
    end.

    `code` is then the exit code; `arguments`, if any, are shown as the command that resumes the
    run.
    """

    def __init__(self, plan: CohortPlan, arguments: Sequence[str]) -> None:
        self.code = 0
        self._plan, self._arguments = plan, arguments
        self._shown = ExitStack()
        self._bar = Progress(
            TextColumn("subjects"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[words]}"),
            console=log,
        )

    def __call__(self, event: Event) -> None:
        """Show an event."""
        if event.kind == "started" and event.data.name == "subjects":
            if log.is_terminal:
                self._shown.enter_context(self._bar)
                self._bar.add_task("", total=event.data.number, words=event.text)
            else:
                log.print(event.text)
        elif event.kind == "started":
            self._shown.close()
        elif event.kind == "progress" and isinstance(event.data, CohortProgress):
            self._show(event.data, escape(in_options(event.text)))
        elif event.kind == "progress":
            self._close(event.data)
        else:
            show_event(event)

    def _show(self, at: CohortProgress, line: str) -> None:
        """Show a subject's outcome."""
        about = "" if at.seconds_left is None else f", about {time_words(at.seconds_left)} left"
        words = f"{at.n_failed} failed{about}"
        if not log.is_terminal:
            log.print(f"{line}; {at.n_done} of {at.n_subjects}, {words}")
            return
        if at.ended.status != "done":
            log.print(line)
        self._bar.update(self._bar.task_ids[0], advance=1, words=words)

    def _close(self, rows: Sequence[Row]) -> None:
        """Print the summary of all subjects."""
        place = self._plan.cohort.output
        keys = set(self._plan.keys)
        own = [row for row in rows if row.key in keys]
        counts = Counter[str](row.status for row in own)
        for row in [row for row in own if row.status == "failed"][:NAMED_FAILURES]:
            log.print(escape(in_options(f"{row.key}: {row.reason}")))
        parts = [f"{counts[name]} {text}" for name, text in STATUS_WORDS.items() if counts[name]]
        print_line(f"{count_text(len(own), 'subject')}: {', '.join(parts)}")
        if n_more := len(rows) - len(own):
            more = (
                f"the page also shows {count_text(n_more, 'subject')} from other tables in {place}"
            )
            log.print(escape(more))
        for name in (PAGE_NAME, TABLE_NAME):
            print_line(str(place / name))
        self.code = int(bool(counts["failed"] or counts["missing"]))
        if self.code and self._arguments:
            words_again = " ".join(map(shlex.quote, self._arguments))
            log.print(
                escape(f"to run only the missing and failed subjects again: tetopt {words_again}")
            )
