"""What `tetopt cohort` is to do: all that can be refused before the first run is, and all of it is said."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from tetopt.cli.inputs import file_and_volume
from tetopt.cli.options import (
    CohortOptions,
    OutputOptions,
    Records,
    SourceOptions,
    given_options,
    option_words,
    with_options,
)
from tetopt.cli.plan import Plan, planned
from tetopt.cli.request import requested
from tetopt.cohort.layout import check_place, mesh_name, numbers_path
from tetopt.cohort.state import State, state_of, strangers
from tetopt.cohort.subjects import FILE_OPTIONS, Problems, Subject, doubled, key, label_of, matching, read_table
from tetopt.errors import InputError
from tetopt.io.formats import FORMATS
from tetopt.model.laws import LAW_OPTIONS, law_file

OPTION_NAMES = {name: name.replace("_", "-") for name in FILE_OPTIONS}


class Entry(NamedTuple):
    """A subject of the cohort, with all options of its run."""

    subject: Subject
    key: str
    records: Records
    plan: Plan  # of its run, as far as it is known without its files
    state: State

    @property
    def source(self) -> SourceOptions:
        """What of it is meshed."""
        return self.plan.source

    def row(self) -> Subject:
        """The subject with the files that patterns mean for it."""
        options = self.records.given()
        files = {name: options[OPTION_NAMES[name]] for name in FILE_OPTIONS if OPTION_NAMES[name] in options}
        return self.subject._replace(files=files)

    def words(self) -> tuple[str, ...]:
        """What follows `tetopt mesh`, without outputs and threads."""
        options = {name: value for name, value in self.records.given().items() if name != "threads"}
        return (*option_words(options), "--", *map(str, self.subject.images))


def subjects_of(path: Path, cohort: CohortOptions) -> list[Subject]:
    """The rows of a table, or of a BIDS folder, as far as they are chosen; InputError if there are none."""
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


def checked_suffix(text: str) -> str:
    """The suffix of meshes' files; InputError for one that is no format's."""
    suffix = text.lower() if text.startswith(".") else f".{text.lower()}"
    if suffix not in FORMATS:
        raise InputError(f"--format: expected one of {', '.join(FORMATS)}, got {text}")
    if FORMATS[suffix].write_files is not None:
        raise InputError(f"--format: a subject's mesh is one file, {suffix} is several; take .vtkhdf")
    return suffix


def entries_of(
    subjects: Sequence[Subject], records: Records, out: Path, suffix: str, say: Callable[[str], None]
) -> list[Entry]:
    """The subjects with their options, and what there is of each.

    Raises
    ------
    Problems
        All that is wrong, of all subjects.
    """
    problems = [("", line) for line in doubled(subjects)]
    plans = _Plans(records, suffix)
    entries = []
    for subject in subjects:
        try:
            own, plan = plans.of(subject)
        except InputError as error:
            problems.append((subject.place, str(error)))
            continue
        problems += [(subject.place, words) for words in _missing(plan.source, own)]
        if (stranger := strangers(out, key(subject))) is not None:
            problems.append(("", stranger))
        entries.append(Entry(subject, key(subject), own, plan, State("missing", "")))
    if problems:
        raise Problems(list(_lines(problems)))
    return with_states(entries, out, suffix, say)


def _lines(problems: Iterable[tuple[str, str]]) -> Iterator[str]:
    """A line for each problem, of (place, words); for those of the same words, one with the first place."""
    places: dict[str, list[str]] = {}
    for place, words in problems:
        places.setdefault(words, []).append(place)
    for words, own in places.items():
        more = f" and {len(own) - 1} more" if len(own) > 1 else ""
        yield f"{own[0]}{more}: {words}" if own[0] else words


class _Plans:
    """Plans of subjects; options that several share are checked once."""

    def __init__(self, records: Records, suffix: str) -> None:
        laws = {name: law_file(getattr(records.solver, name) or "") for name in LAW_OPTIONS}
        # A worker may be started in another folder.
        placed: dict[str, Any] = {name: str(file.absolute()) for name, file in laws.items() if file is not None}
        self._records, self._suffix = records._replace(solver=replace(records.solver, **placed)), suffix
        self._patterns = {
            name: path for name in FILE_OPTIONS if (path := records.given().get(OPTION_NAMES[name])) is not None
        }
        self._known: dict[Any, tuple[Records, Plan]] = {}

    def of(self, subject: Subject) -> tuple[Records, Plan]:
        """The options of a subject with its files, and its plan; InputError for options that cannot be."""
        files = {name: matching(str(pattern), subject) for name, pattern in self._patterns.items()} | subject.files
        kind = (tuple(sorted(subject.options.items())), tuple(sorted(files)), len(subject.images))
        if kind not in self._known:
            if "threads" in subject.options:
                raise InputError("threads: all subjects have the same number, of --threads; leave the column out")
            options = {name.replace("_", "-"): text for name, text in subject.options.items()}
            self._known[kind] = self._planned(_with_files(with_options(self._records, options), files), subject)
        records, plan = self._known[kind]
        records = _with_files(records, files)
        source = SourceOptions(images=list(subject.images), **vars(records.content))
        return records, plan._replace(source=source, sizes=replace(plan.sizes, sizing=records.sizes.sizing))

    def _planned(self, records: Records, subject: Subject) -> tuple[Records, Plan]:
        source = SourceOptions(images=list(subject.images), **vars(records.content))
        with tempfile.TemporaryDirectory(prefix="tetopt-") as folder:
            output = OutputOptions(
                mesh=Path(folder) / f"mesh{self._suffix}", json_path=Path(folder) / "mesh.json", figures=Path(folder)
            )
            return records, planned(source, *records[1:], output)


def _with_files(records: Records, files: dict[str, Path]) -> Records:
    """The records with these files."""
    own = {name: {field: path for field, path in files.items() if hasattr(record, field)}
           for name, record in records._asdict().items()}  # fmt: skip
    return Records(**{name: replace(record, **own[name]) for name, record in records._asdict().items()})


def _missing(source: SourceOptions, records: Records) -> Iterator[str]:
    """What is wrong with the files that a subject names: not there, or a text where an image should be."""
    named = [("image", path) for path in source.images]
    options = given_options(*records)
    named += [(name, options[OPTION_NAMES[name]]) for name in FILE_OPTIONS if OPTION_NAMES[name] in options]
    for number, (name, path) in enumerate(named):
        file = path if number == 0 else file_and_volume(path)[0]  # of the first, --volume tells which
        try:
            if not os.path.lexists(file):
                yield f"{name}: {path} is not there"
            elif not file.exists():
                yield f"{name}: {path} is a link to nothing; is its content fetched (datalad get)?"
            elif file.is_file() and file.stat().st_size == 0:
                yield f"{name}: {path} is empty"
        except OSError as error:
            yield f"{name}: {path} cannot be opened: {error.strerror}"


def with_states(entries: list[Entry], out: Path, suffix: str, say: Callable[[str], None]) -> list[Entry]:
    """The subjects with what there is of each; files are summed up where there is a mesh to compare with."""

    def state(entry: Entry) -> Entry:
        request = None
        if numbers_path(out, entry.key).is_file():
            output = OutputOptions(mesh=Path(mesh_name(entry.key, suffix)))
            request = requested(entry.source, *entry.records[1:], output)
        return entry._replace(state=state_of(out, entry.key, suffix, request))

    if (n_there := sum(numbers_path(out, entry.key).is_file() for entry in entries)) > 0:
        say(f"comparing the inputs and options of {n_there} subjects that are there with what is asked for")
    with ThreadPoolExecutor() as pool:
        return list(pool.map(state, entries))


def with_places(entries: list[Entry], out: Path) -> list[Entry]:
    """The subjects to be run; Problems for those whose folder a run cannot replace."""
    problems = []
    for entry in entries:
        try:
            check_place(out, entry.key)
        except InputError as error:
            problems.append(str(error))
    if problems:
        raise Problems(list(dict.fromkeys(problems)))
    return entries


def chosen(entries: Iterable[Entry], only_failed: bool) -> list[Entry]:
    """Those to be run."""
    statuses = ("failed",) if only_failed else ("missing", "failed", "changed")
    return [entry for entry in entries if entry.state.status in statuses]
