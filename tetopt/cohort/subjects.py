"""Subjects of a cohort: their images and options, read from and written to a table."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from difflib import get_close_matches
from functools import partial
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError
from tetopt.io.label_tables import is_preset_table
from tetopt.job.events import note
from tetopt.job.options import RunOptions, kinds_of, option_name
from tetopt.model.mappings import FILES_IN_TEXTS, named_file
from tetopt.system.files import save_text
from tetopt.system.incoming import text_of

TABLE_SUFFIXES = (".tsv", ".csv")
SUBJECT_COLUMNS = ("subject", "participant_id")  # the second is from BIDS
SESSION_COLUMNS = ("session", "session_id")
# of `tetopt mesh`, with files
FILE_OPTIONS = ("mask", "labels", "tissues", "sizing", "start", "transform", "fixed", "label_names")
SEPARATORS = {"tissues": ",", "transform": ";"}  # of several files of an option
# of participants in BIDS and other tables; some resemble options, as site does set
NOTE_COLUMNS = ("age", "sex", "handedness", "group", "site", "weight", "height", "strain")
LEAST_RESEMBLANCE = 0.75  # of difflib's ratio: a column like an option is one with a slip
NO_VALUES = ("", "n/a")  # of an empty cell; the second is from BIDS
LEFT_OUT = "#"  # prefix of columns that are the user's notes
IMAGE_PATTERN = re.compile(r"image(?:_([1-9][0-9]{0,2}))?$")
# of a subject's key: file systems allow names of 255 bytes, and the longest adds 40
KEY_LETTERS = 200
GLOB_LETTERS = "*?["


class Subject(NamedTuple):
    """A subject, or one of its sessions, with its own files and options."""

    subject: str  # without "sub-"
    session: str  # without "ses-"; empty for none
    images: tuple[Path, ...]
    options: dict[str, str]  # by the names of `tetopt mesh`, with underscores, as text
    place: str  # its place in the table, for messages
    notes: dict[str, str] = {}  # noqa: RUF012 - never modified; by columns that are no options


class Problems(InputError):
    """All problems of a cohort, a line each."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("; ".join(lines))
        self.lines = list(lines)


def label_of(name: str) -> str:
    """Convert a name to a BIDS label, which has only letters and digits.

    BIDS 1.10, Common principles, https://bids-specification.readthedocs.io: entities' labels are
    alphanumeric.
    """
    return re.sub("[^0-9A-Za-z]", "", name)


def key(subject: Subject) -> str:
    """Return the base name of a subject's files, e.g. "sub-01_ses-a"."""
    session = f"_ses-{label_of(subject.session)}" if subject.session else ""
    return f"sub-{label_of(subject.subject)}{session}"


def read_table(path: Path) -> list[Subject]:
    """Read the subjects of a table, a line each; its first line has the columns' names.

    `subject` (or `participant_id`), `session`, `image`, `image_2` and so on, `mask`, `labels`, and
    any other option of `tetopt mesh` for the subject alone; other columns are notes, unless their
    names resemble an option's. Paths are relative to the table. Empty cells and "n/a" are ignored,
    as are columns whose names begin with #.

    Raises
    ------
    Problems
        All problems of the table itself.
    """
    folder = path.parent.resolve()
    names, *lines = table_cells(path)
    columns = _columns(path, names)
    notes = [name for name in columns if _is_note(name)]
    problems: list[str] = []
    subjects: list[Subject] = []
    for number, line in lines:
        place = f"{path}, line {number}"
        if len(line) != len(columns):
            problems.append(
                f"{place}: expected {len(columns)} cells as in the first line, got {len(line)}"
            )
            continue
        cells = {
            name: cell
            for name, cell in zip(columns, line, strict=True)
            if name and cell not in NO_VALUES
        }
        images = sorted(filter(IMAGE_PATTERN.match, cells), key=lambda name: (len(name), name))
        if missing := [name for name in ("subject", "image") if name not in cells]:
            problems.append(f"{place}: missing {' and '.join(missing)}")
            continue
        options = {
            name: cell
            for name, cell in cells.items()
            if name not in ("subject", "session", *images, *notes)
        }
        subjects.append(
            Subject(
                cells["subject"].removeprefix("sub-"),
                cells.get("session", "").removeprefix("ses-"),
                tuple(_absolute(folder, cells[name]) for name in images),
                with_files(options, partial(_absolute, folder)),
                place,
                {name: cells[name] for name in notes if name in cells},
            )
        )
    if problems:
        raise Problems(problems)
    if notes:
        note(
            f"{path}: columns that are no options of tetopt mesh, and go into the cohort's table: "
            f"{', '.join(notes)}"
        )
    if not subjects:
        raise InputError(
            f"{path}: expected a line for each subject below the column names, got none"
        )
    return subjects


def name_problems(subjects: Iterable[Subject]) -> Iterator[str]:
    """Yield the problems of the subjects' names: empty, too long, repeated, with and without a
    session.
    """
    places: dict[str, str] = {}
    for each in subjects:
        if not label_of(each.subject) or (each.session and not label_of(each.session)):
            yield f"{each.place}: expected letters or digits in the names of subject and session"
            continue
        name = key(each)
        if len(name) > KEY_LETTERS:
            words = f"{name[:20]}... has {len(name)} characters and is used in file names"
            yield f"{each.place}: {words}; expected at most {KEY_LETTERS}"
            continue
        if name in places:
            yield (
                f"{each.place}: {name} is also used by {places[name]}; make subject or "
                "session unique"
            )
        places.setdefault(name, each.place)
    for name, place in places.items():
        if "_ses-" in name and name.partition("_")[0] in places:
            bare = name.partition("_")[0]
            yield (
                f"{place}: {name} has a session, but {bare} ({places[bare]}) has none; give "
                "both a session"
            )


def write_table(path: Path, subjects: Sequence[Subject]) -> None:
    """Write the subjects as a table for `read_table`, whole or not at all."""
    folder = path.parent.resolve()
    n_images = max((len(each.images) for each in subjects), default=1)
    images = ["image", *(f"image_{number}" for number in range(2, n_images + 1))]
    options = sorted(
        {name for each in subjects for name in each.options},
        key=lambda name: (name not in FILE_OPTIONS, name),
    )
    session = ["session"] if any(each.session for each in subjects) else []
    notes = dict.fromkeys(name for each in subjects for name in each.notes)
    columns = ["subject", *session, *images, *options, *notes]
    stream = StringIO()
    writer = csv.DictWriter(
        stream,
        columns,
        restval="n/a",
        lineterminator="\n",
        delimiter="\t" if path.suffix.lower() == ".tsv" else ",",
    )
    writer.writeheader()
    for each in subjects:
        row = {"subject": each.subject, **({"session": each.session} if each.session else {})}
        row |= {
            name: os.path.relpath(image, folder)
            for name, image in zip(images, each.images, strict=False)
        }
        row |= each.notes
        writer.writerow(row | with_files(each.options, partial(os.path.relpath, start=folder)))
    save_text(path, stream.getvalue())


def with_files(options: dict[str, str], function: Callable[[str], Path | str]) -> dict[str, str]:
    """Return options with the results of a function in place of the files that they name."""
    changed = {}
    for name, text in options.items():
        if name in FILE_OPTIONS:
            separator = SEPARATORS.get(name, "\0")
            files = text.split(separator)
            changed[name] = separator.join(
                file if is_preset_table(Path(file)) else str(function(file.strip()))
                for file in files
            )
        elif name in FILES_IN_TEXTS and named_file(text) is not None:
            changed[name] = str(function(text))
    return options | changed


def matching(pattern: str, subject: Subject) -> Path:
    """Return the one file of this subject that a pattern matches, or the pattern itself.

    {subject} and {session} are its names as in `key`; without a session, "ses-{session}" is removed
    with the "_" or "/" before or after it. *, ? and [...] are as in a shell.

    Raises
    ------
    InputError
        Several files match, or a placeholder is unknown.
    """
    words = pattern
    if unknown := [
        name
        for name in re.findall(r"\{[a-z_]+\}", pattern)
        if name not in ("{subject}", "{session}")
    ]:
        raise InputError(
            f"{pattern}: unknown placeholder {unknown[0]}; use {{subject}} and {{session}}"
        )
    if not subject.session:
        words = re.sub(r"_ses-\{session\}|ses-\{session\}[_/]?", "", words)
    words = words.replace("{subject}", label_of(subject.subject)).replace(
        "{session}", label_of(subject.session)
    )
    path = Path(words).absolute()
    if path.exists() or not any(letter in words for letter in GLOB_LETTERS):
        return path
    matches = sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor))))
    if len(matches) > 1:
        named = ", ".join(match.name for match in matches[:3])
        raise InputError(f"{path}: expected one file, got {len(matches)}: {named}")
    return (*matches, path)[0]


def _is_note(column: str) -> bool:
    """Return whether a column is neither an option nor of a name that resembles one."""
    options = {
        option_name(name, kind).replace("-", "_") for name, kind in kinds_of(RunOptions).items()
    }
    is_known = not column or column in ("subject", "session", *options)
    if is_known or IMAGE_PATTERN.match(column):
        return False
    return column in NOTE_COLUMNS or not get_close_matches(column, options, 1, LEAST_RESEMBLANCE)


def table_cells(path: Path) -> list[tuple[int, list[str]]]:
    """Return the non-empty lines of a table with their numbers, as cells."""
    text = text_of(path, "table of subjects")
    first = text.partition("\n")[0]
    separator = (
        "\t" if path.suffix.lower() == ".tsv" else ";" if ";" in first and "," not in first else ","
    )
    reader = csv.reader(StringIO(text, newline=""), delimiter=separator, strict=True)
    try:
        lines = [
            (reader.line_num, [cell.strip() for cell in line])
            for line in reader
            if any(map(str.strip, line))
        ]
    except csv.Error as error:
        raise InputError(
            f"{path}, line {reader.line_num}: expected a table, got {error}; correct that line"
        ) from error
    if not lines:
        raise InputError(
            f"{path}: expected a line of column names, such as subject and image, got an empty file"
        )
    return lines


def _columns(path: Path, first: tuple[int, list[str]]) -> list[str]:
    """Return the columns by their internal names; "" for ignored ones."""
    columns = []
    for cell in first[1]:
        name = cell.lower().replace("-", "_")
        name = (
            "subject" if name in SUBJECT_COLUMNS else "session" if name in SESSION_COLUMNS else name
        )
        columns.append("" if name.startswith(LEFT_OUT) else name)
    named = [name for name in columns if name]
    if twice := sorted({name for name in named if named.count(name) > 1}):
        raise InputError(
            f"{path}: the column {twice[0]} occurs {named.count(twice[0])} times; keep one"
        )
    if missing := [name for name in ("subject", "image") if name not in named]:
        separator = "tabs" if path.suffix.lower() == ".tsv" else "commas"
        raise InputError(
            f"{path}: expected columns subject and image, separated by {separator}, got "
            f"{', '.join(named) or 'none'}; "
            f"missing {' and '.join(missing)}"
        )
    return columns


def _absolute(folder: Path, cell: str) -> Path:
    return Path(os.path.normpath(folder / Path(cell).expanduser()))
