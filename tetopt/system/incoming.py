"""What comes in stays data, and bounded: regular files only, texts and tables of a size that can be meant."""

from __future__ import annotations

import csv
import json
import os
import stat
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tetopt.errors import InputError

TEXT_BYTES = 2**26  # 67 MB: the longest table of labels that is known, FreeSurfer's, has 0.1
LARGEST_NUMBER = 1e300  # of a table: its square root is still far beyond anything measured, and its float is finite
# What stands in a file's place and is none; a pipe that nobody writes to blocks for ever, /dev/zero never ends.
KINDS_OF_FILES = {
    stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder", stat.S_IFLNK: "a link",
}  # fmt: skip
# How tetopt opens its own files: not through a link, and without waiting at a pipe. Windows has neither flag.
UNFOLLOWED = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def irregular(path: Path, *, follow: bool = True) -> str | None:
    """What `path` is if it is there and no regular file: "a pipe", "a device", "a folder", unfollowed also "a link".

    Raises
    ------
    OSError
        Nothing is there, or it may not be looked at.
    """
    mode = path.stat(follow_symlinks=follow).st_mode
    return None if stat.S_ISREG(mode) else KINDS_OF_FILES.get(stat.S_IFMT(mode), "no regular file")


def regular_file(path: str | Path, noun: str) -> Path:
    """`path`, where a file is to be read; asked before it is opened, as opening a pipe may block for ever.

    Parameters
    ----------
    path : str or Path
    noun : str
        What is expected, as "mesh file".

    Raises
    ------
    InputError
        Nothing is there, it may not be looked at, or it is no regular file.
    """
    if not isinstance(path, str | Path):
        raise InputError(f"expected the path of a {noun}, got {type(path).__name__}")
    path = Path(path)
    try:
        other = irregular(path)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such file; expected a {noun}") from None
    except (OSError, ValueError) as error:  # ValueError: a zero among the letters
        raise InputError(f"{path}: cannot be opened ({getattr(error, 'strerror', None) or error})") from error
    if other == "a folder":
        raise InputError(f"{path}: no such file, it is a folder; expected a {noun}")
    if other is not None:
        raise InputError(f"{path}: expected a regular file, got {other}; copy what it gives into a file")
    return path


def own_bytes(path: Path, most_bytes: int = TEXT_BYTES) -> bytes:
    """The content of a file that tetopt wrote; links are not followed, as tetopt makes none.

    Raises
    ------
    OSError
        Nothing is there, or it cannot be read.
    InputError
        A link, no regular file, or one of more bytes.
    """
    if (other := irregular(path, follow=False)) is not None:
        raise InputError(f"{path}: expected a regular file, got {other}; replace it by the file itself, or remove it")
    with open(os.open(path, os.O_RDONLY | UNFOLLOWED), "rb") as stream:
        whole = stream.read(most_bytes + 1)
    if len(whole) > most_bytes:
        raise InputError(f"{path}: expected at most {most_bytes} bytes, got {_size(path)}; remove it")
    return whole


def text_of(path: str | Path, noun: str) -> str:
    """The text of a file in UTF-8, with or without a mark at its beginning.

    Raises
    ------
    InputError
        As `regular_file`; it may not be read, is longer than `TEXT_BYTES`, or is not UTF-8.
    """
    path = regular_file(path, noun)
    try:
        with path.open("rb") as stream:
            raw = stream.read(TEXT_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read, {error.strerror}; expected a {noun}") from error
    if len(raw) > TEXT_BYTES:
        raise InputError(f"{path}: expected a {noun} of at most {TEXT_BYTES / 1e6:.0f} MB, got {_size(path)}")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        advice = ', in Excel as "CSV UTF-8"' if path.suffix.lower() == ".csv" else ""
        raise InputError(
            f"{path}: expected text in UTF-8, not at byte {error.start}; save the {noun} again{advice}"
        ) from error


def toml_of(path: str | Path, noun: str) -> dict[str, Any]:
    """The table in a TOML file, of numbers that a float can be.

    Raises
    ------
    InputError
        As `text_of`; not TOML, nested too deeply, or with a number beyond `LARGEST_NUMBER`.
    """
    text = text_of(path, noun)
    try:
        table = tomllib.loads(text)
        _check_numbers(table)
    except ValueError as error:  # also int's, of more digits than it converts
        raise InputError(f"{path}: expected TOML, got {_short(error)}; mend that place") from error
    except RecursionError as error:
        raise InputError(f"{path}: expected TOML, got brackets nested too deeply") from error
    return table


def rows_of(path: Path, noun: str, heads: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Names and what each has, of TOML's keys or of rows of CSV, between commas, semicolons or tabs.

    In CSV the separator is the first of these that there is. Lines that are empty or begin with # are left out, and so
    is a first row whose second cell is one of `heads`.

    Raises
    ------
    InputError
        As `toml_of` or `text_of`; a row of one cell alone.
    """
    if path.suffix.lower() == ".toml":
        table = toml_of(path, noun)
        return [(name, list(map(str, each if isinstance(each, list) else [each]))) for name, each in table.items()]
    text = text_of(path, noun)
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = next((letter for letter in "".join(lines) if letter in ",;\t"), ",")
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator, skipinitialspace=True)]
    except csv.Error as error:
        raise InputError(f"{path}: expected rows of a {noun}, got {_short(error)}") from error
    if rows and rows[0][1:] and rows[0][1].lower() in heads:
        del rows[0]
    if short := [row for row in rows if not "".join(row[1:])]:
        raise InputError(f'{path}: expected rows of a name and what it has, got "{separator.join(short[0])[:80]}"')
    return [(row[0], [cell for cell in row[1:] if cell]) for row in rows]


def json_of(text: str) -> Any:
    """What a text in JSON stands for, of numbers that a float can be.

    Raises
    ------
    ValueError
        Not JSON, nested too deeply, or with a number beyond `LARGEST_NUMBER`.
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


def _size(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.0f} MB"
