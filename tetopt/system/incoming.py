"""Safe reading of untrusted input: only regular files, and texts and tables of limited size."""

from __future__ import annotations

import csv
import json
import stat
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tetopt.errors import InputError

TEXT_BYTES = 2**26  # 67 MB: the longest known label table, FreeSurfer's, has 0.1 MB
# in a table: a finite float whose square root is far beyond any measured value
LARGEST_NUMBER = 1e300
# Entries that are not regular files: a pipe without a writer blocks for ever, and /dev/zero never
# ends.
KINDS_OF_FILES = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a link",
}


def irregular(path: Path, *, follow: bool = True) -> str | None:
    """Return the kind of an entry that is not a regular file: "a pipe", "a folder", without
    `follow` also "a link".

    Raises
    ------
    OSError
        The entry does not exist or is not accessible.
    """
    mode = path.stat(follow_symlinks=follow).st_mode
    return None if stat.S_ISREG(mode) else KINDS_OF_FILES.get(stat.S_IFMT(mode), "a special file")


def regular_file(path: str | Path, noun: str) -> Path:
    """Return `path` if it is a regular file; call it before opening, because opening a pipe may
    block for ever.

    Parameters
    ----------
    path : str or Path
    noun : str
        The expected kind of file, e.g. "mesh file".

    Raises
    ------
    InputError
        The file does not exist, is not accessible, or is not a regular file.
    """
    if not isinstance(path, str | Path):
        raise InputError(f"expected the path of a {noun}, got {type(path).__name__}")
    path = Path(path)
    try:
        other = irregular(path)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such file; expected a {noun}") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise InputError(
            f"{path}: cannot be opened ({getattr(error, 'strerror', None) or error})"
        ) from error
    if other == "a folder":
        raise InputError(f"{path}: expected a {noun}, got a folder")
    if other is not None:
        raise InputError(f"{path}: expected a regular file, got {other}; copy its data into a file")
    return path


def text_of(path: str | Path, noun: str) -> str:
    """Return the text of a UTF-8 file, with or without a byte-order mark.

    Raises
    ------
    InputError
        For the reasons of `regular_file`; the file cannot be read, exceeds `TEXT_BYTES`, or is not
        UTF-8.
    """
    path = regular_file(path, noun)
    try:
        with path.open("rb") as stream:
            raw = stream.read(TEXT_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a {noun}") from error
    if len(raw) > TEXT_BYTES:
        raise InputError(
            f"{path}: expected a {noun} of at most {TEXT_BYTES / 1e6:.0f} MB, got "
            f"{path.stat().st_size / 1e6:.0f} MB"
        )
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        advice = ', in Excel as "CSV UTF-8"' if path.suffix.lower() == ".csv" else ""
        raise InputError(
            f"{path}: expected UTF-8 text, got an invalid byte at {error.start}; save the {noun} "
            f"again{advice}"
        ) from error


def toml_of(path: str | Path, noun: str) -> dict[str, Any]:
    """Return the table in a TOML file, whose numbers must fit into a float.

    Raises
    ------
    InputError
        For the reasons of `text_of`; not TOML, nested too deeply, or a number beyond
        `LARGEST_NUMBER`.
    """
    text = text_of(path, noun)
    try:
        table = tomllib.loads(text)
        _check_numbers(table)
    except ValueError as error:  # also raised by int for too many digits
        raise InputError(
            f"{path}: expected TOML, got {_short(error)}; correct the file there"
        ) from error
    except RecursionError as error:
        raise InputError(f"{path}: expected TOML, got brackets nested too deeply") from error
    return table


def rows_of(path: Path, noun: str, heads: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return names and the values of each, from the keys of TOML or the rows of CSV.

    The separator of CSV is the first comma, semicolon or tab in the file. Empty lines and lines
    that begin with # are skipped, and so is a first row whose second cell is one of `heads`.

    Raises
    ------
    InputError
        For the reasons of `toml_of` or `text_of`; a row has only one cell.
    """
    if path.suffix.lower() == ".toml":
        table = toml_of(path, noun)
        return [
            (name, list(map(str, each if isinstance(each, list) else [each])))
            for name, each in table.items()
        ]
    text = text_of(path, noun)
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = next((letter for letter in "".join(lines) if letter in ",;\t"), ",")
    try:
        rows = [
            [cell.strip() for cell in row]
            for row in csv.reader(lines, delimiter=separator, skipinitialspace=True)
        ]
    except csv.Error as error:
        raise InputError(f"{path}: expected rows of a {noun}, got {_short(error)}") from error
    if rows and rows[0][1:] and rows[0][1].lower() in heads:
        del rows[0]
    if short := [row for row in rows if not "".join(row[1:])]:
        raise InputError(
            f'{path}: expected rows of a name and values, got "{separator.join(short[0])[:80]}"'
        )
    return [(row[0], [cell for cell in row[1:] if cell]) for row in rows]


def json_of(text: str) -> Any:
    """Parse a JSON text, whose numbers must fit into a float.

    Raises
    ------
    ValueError
        Not JSON, nested too deeply, or a number beyond `LARGEST_NUMBER`.
    """
    try:
        value = json.loads(text)
        _check_numbers(value)
    except RecursionError as error:
        raise ValueError("brackets nested too deeply") from error
    return value


def _check_numbers(value: Any) -> None:
    for number in _whole_numbers(value):
        if abs(number) > LARGEST_NUMBER:
            raise ValueError(f"a number of {len(str(abs(number)))} digits")


def _whole_numbers(value: Any) -> Iterator[int]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _whole_numbers(item)
    elif isinstance(value, int):
        yield value


def _short(error: Exception) -> str:
    words = " ".join(str(error).split())
    return words if len(words) <= 200 else f"{words[:197]}..."  # 200: a line or two of a terminal
