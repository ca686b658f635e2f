"""Planning of a cohort: all problems are found before the first run, and all are reported."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from tetopt.cohort.layout import mesh_name, numbers_path
from tetopt.cohort.options import CohortOptions
from tetopt.cohort.subject_states import SubjectState, state_of
from tetopt.cohort.subjects import (
    FILE_OPTIONS,
    SEPARATORS,
    Problems,
    Subject,
    key,
    label_of,
    matching,
    name_problems,
    read_table,
    with_files,
)
from tetopt.errors import InputError
from tetopt.io.formats import BUILT_IN
from tetopt.io.label_tables import is_preset_table
from tetopt.job.events import note, warning
from tetopt.job.option_values import file_and_volume, tissue_files
from tetopt.job.options import JobOptions, RunOptions, given_options
from tetopt.job.plan import Plan, changed_options, plan_job
from tetopt.job.request import job_request
from tetopt.job.texts import option_words, with_options
from tetopt.model.mappings import FILES_IN_TEXTS


class PlannedSubject(NamedTuple):
    """A subject of the cohort, with the plan of its run."""

    subject: Subject
    key: str
    plan: Plan  # of its run, as far as known without its files
    state: SubjectState

    def row(self) -> Subject:
        """Return the subject with the files that patterns match."""
        files = _file_texts(self.plan.bare)
        return self.subject._replace(options=self.subject.options | files)

    def words(self) -> tuple[str, ...]:
        """Return the arguments of `tetopt mesh`, without outputs and threads."""
        options = given_options(self.plan.bare)
        for name in ("images", "output", "threads"):
            options.pop(name, None)
        return (*option_words(options), "--", *map(str, self.subject.images))


def subjects_of(path: Path, cohort: CohortOptions) -> list[Subject]:
    """Return the selected rows of a table or a BIDS folder; raise InputError if there are none."""
    if path.is_dir():
        from tetopt.cohort.bids_folder import bids_subjects

        return bids_subjects(path, cohort.suffix, cohort.participants or (), cohort.sessions or ())
    if path.suffix.lower() not in (".tsv", ".csv"):
        raise InputError(f"{path}: expected a table, .tsv or .csv, or a BIDS folder")
    subjects = read_table(path)
    for kind, chosen in (("subject", cohort.participants), ("session", cohort.sessions)):
        if chosen is not None:
            names = {label_of(name.removeprefix("sub-").removeprefix("ses-")) for name in chosen}
            if lost := sorted(names - {label_of(getattr(each, kind)) for each in subjects}):
                raise Problems([f"{path}: has no {kind} {name}" for name in lost])
            subjects = [each for each in subjects if label_of(getattr(each, kind)) in names]
    if not subjects:
        raise InputError(f"{path}: no subject has that session")
    return subjects


def suffix_of_meshes(text: str) -> str:
    """Return the suffix of meshes' files; raise InputError for an unknown one."""
    suffix = text.lower() if text.startswith(".") else f".{text.lower()}"
    if suffix not in BUILT_IN:  # subjects are run by separate processes, which know only these
        raise InputError(f"`mesh_format`: expected one of {', '.join(BUILT_IN)}, got {text}")
    return suffix


def entries_of(
    subjects: Sequence[Subject], options: RunOptions, out: Path, suffix: str
) -> list[PlannedSubject]:
    """Return the subjects with their options and states.

    Missing files of some subjects are warned of: their runs fail.

    Raises
    ------
    Problems
        All problems of all subjects.
    """
    lost = list[tuple[str, str]]()
    problems = [("", line) for line in name_problems(subjects)]
    texts = {name: text for name in FILES_IN_TEXTS if (text := getattr(options, name)) is not None}
    # a worker may have another current folder
    placed: dict[str, Any] = dict(with_files(texts, os.path.abspath))
    options, entries = replace(options, **placed), []
    for subject in subjects:
        try:
            plan = _plan_subject(subject, options, Path(f"mesh{suffix}"))
        except InputError as error:
            problems.append((subject.place, str(error)))
            continue
        lost += [(subject.place, words) for words in _missing(plan.job)]
        entries.append(PlannedSubject(subject, key(subject), plan, SubjectState("missing", "")))
    if problems or len({place for place, _ in lost}) == len(subjects):
        raise Problems(list(_lines([*problems, *lost])))
    for line in _lines(lost):
        warning(f"{line}; without it the subject fails")
    if (n_there := sum(numbers_path(out, entry.key).is_file() for entry in entries)) > 0:
        note(f"comparing inputs and options of {n_there} existing subjects with the requested ones")
    return with_states(entries, out, suffix)


def _lines(problems: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield a line for each problem (place, words); problems with the same words share a line
    with the first place.
    """
    places: dict[str, list[str]] = {}
    for place, words in problems:
        places.setdefault(words, []).append(place)
    for words, own in places.items():
        more = f" and {len(own) - 1} more" if len(own) > 1 else ""
        yield f"{own[0]}{more}: {words}" if own[0] else words


def _plan_subject(subject: Subject, options: RunOptions, output: Path) -> Plan:
    """Plan a subject with its files and options; raise InputError for invalid options."""
    texts = with_files(_file_texts(options), partial(matching, subject=subject)) | subject.options
    if "threads" in subject.options:
        raise InputError(
            "threads: all subjects use the same number, set by `threads`; remove the column"
        )
    own = with_options(options, {name.replace("_", "-"): text for name, text in texts.items()})
    job = JobOptions(**vars(own), images=list(subject.images), output=output)
    return plan_job(job, reads_files=True)


def _file_texts(options: RunOptions | JobOptions) -> dict[str, str]:
    """Return the files among a run's options, as the cells of a table."""
    values = {name: getattr(options, name) for name in FILE_OPTIONS}
    return {
        name: SEPARATORS[name].join(map(str, value)) if isinstance(value, list) else str(value)
        for name, value in values.items()
        if value is not None
    }


def _missing(job: JobOptions) -> Iterator[str]:
    """Yield the problems of a subject's files: missing, broken links, or empty."""
    named = [("image", path) for path in job.images]
    whole = {
        name: path
        for name in FILE_OPTIONS
        if (path := getattr(job, name)) is not None
        and name not in SEPARATORS
        and not is_preset_table(path)
    }
    named += [*whole.items(), *(("tissues", path) for path in tissue_files(job.tissues))]
    named += [("transform", path) for path in job.transform or []]
    for number, (name, path) in enumerate(named):
        file = path if number == 0 else file_and_volume(path)[0]  # --volume applies to the first
        try:
            if not os.path.lexists(file):
                yield f"{name}: {path} does not exist"
            elif not file.exists():
                yield f"{name}: {path} is a broken link; was its content fetched (datalad get)?"
            elif file.is_file() and file.stat().st_size == 0:
                yield f"{name}: {path} is empty"
        except OSError as error:
            yield f"{name}: {path} cannot be opened: {error.strerror}"


def with_states(entries: list[PlannedSubject], out: Path, suffix: str) -> list[PlannedSubject]:
    """Return the subjects with their states; checksums are computed only if there is a mesh to
    compare with.
    """

    def state(entry: PlannedSubject) -> PlannedSubject:
        request = None
        if numbers_path(out, entry.key).is_file():
            try:
                request = job_request(
                    changed_options(entry.plan.bare, output=Path(mesh_name(entry.key, suffix)))
                )
            except InputError as error:  # a file is missing by now
                return entry._replace(state=SubjectState("failed", str(error)))
        return entry._replace(state=state_of(out, entry.key, request))

    with ThreadPoolExecutor() as pool:
        return list(pool.map(state, entries))


def choose_subjects(entries: Iterable[PlannedSubject], only_failed: bool) -> list[PlannedSubject]:
    """Return the subjects to run."""
    statuses = ("failed",) if only_failed else ("missing", "failed", "changed")
    return [entry for entry in entries if entry.state.status in statuses]
