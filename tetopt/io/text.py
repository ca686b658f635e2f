"""Conversion of arrays to lines of text, fast and lossless, and of untrusted text to safe lines."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Container, Iterable, Sequence

# not from xml.sax, which imports urllib.request and network modules, 0.02 s
from html import escape
from itertools import accumulate, chain, count
from urllib.parse import quote

from numpy.typing import NDArray

NAMES_LISTED = 8  # as many as fit on a line

NUMBERS_PER_LINE = 16  # the maximum in Abaqus
# In a field's name, as some readers have lines of 256 characters: gmsh, and legacy VTK,
# percent-encoded there.
MOST_NAME_CHARACTERS = 240
LINE_CHARACTERS = 300  # of another program's line in a message, at most
UNNAMED_FIELD = "unnamed"  # VTK cannot read back a file with a field without a name


def rows(*columns: NDArray, separator: str = " ") -> str:
    """Format arrays side by side, each (K,) or (K, w), as one line per row; floats read back
    unchanged.

    Examples
    --------
    >>> import numpy as np
    >>> print(rows(np.array([7, 8]), np.array([[0.1, 2.0], [1e-9, -3.5]])), end="")
    7 0.1 2.0
    8 1e-09 -3.5
    """
    single = [each for column in columns for each in ([column] if column.ndim == 1 else column.T)]
    texts = [map(repr, column.tolist()) for column in single]
    return "".join(f"{separator.join(row)}\n" for row in zip(*texts, strict=True))


def plain(text: str) -> str:
    r"""Convert untrusted text to one line of printable characters, for terminals, comments and
    names.

    Unprintable characters are shown as Python escapes: line breaks, control characters, marks that
    reverse the direction of writing, and lone surrogates from names of files that are not UTF-8.
    Spaces of any width are kept.

    Examples
    --------
    >>> print(plain("a\x1b[31mb\n"), plain("\u202egnp.exe"), plain("\udcff.nii"), plain("100 %"))
    a\x1b[31mb\n \u202egnp.exe \udcff.nii 100 %
    """
    if text.isprintable():
        return text
    return "".join(
        letter
        if letter.isprintable() or unicodedata.category(letter) == "Zs"
        else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )


def count_text(number: int, noun: str) -> str:
    """Format a number of things; "cavity" has the plural "cavities"."""
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number} {noun if number == 1 else plural}"


def last_line(text: str) -> str:
    """Return the last non-empty line of another program's output, safe for a terminal."""
    lines = text.strip().splitlines()
    line = plain(" ".join(lines[-1].split())) if lines else ""
    return line if len(line) <= LINE_CHARACTERS else line[:LINE_CHARACTERS] + "..."


def file_name(name: str) -> str:
    """Return a field's name as all formats support it: `plain` and not blank."""
    return plain(name) if name.strip() else UNNAMED_FIELD


def short_name(name: str) -> str:
    """Return as many letters of a `file_name` as fit into `MOST_NAME_CHARACTERS` when
    percent-encoded.
    """
    name = file_name(name)
    if len(name) <= MOST_NAME_CHARACTERS and len(quote(name)) <= MOST_NAME_CHARACTERS:
        return name
    sizes = accumulate(len(quote(letter)) for letter in name[:MOST_NAME_CHARACTERS])
    return name[: sum(size <= MOST_NAME_CHARACTERS for size in sizes)]


def legacy_name(name: str) -> str:
    """Return a `short_name` without braces, which VTK's legacy writer misreads as its own marks and
    crashes on.

    Examples
    --------
    >>> legacy_name("{a}")
    '(a)'
    """
    return short_name(name).translate(str.maketrans("{}", "()"))


def names_apart(names: Iterable[str], shown: Callable[[str], str]) -> dict[str, str]:
    """Map names to `shown` names, numbered if several would be equal.

    Names that need no change keep their form.

    Examples
    --------
    >>> names_apart(["a b", "A B", "a-b"], lambda name: name.lower().replace(" ", "-"))
    {'a b': 'a-b_2', 'A B': 'a-b_3', 'a-b': 'a-b'}
    """
    known = {name: shown(name) for name in names}
    taken = {name for name, text in known.items() if text == name}
    for name, text in known.items():
        if text == name:
            continue
        known[name] = free_text(text, taken)
        taken.add(known[name])
    return known


def free_text(text: str, taken: Container[str]) -> str:
    """Return the text, numbered from 2 if it is taken."""
    return next(
        each
        for each in chain([text], (f"{text}_{number}" for number in count(2)))
        if each not in taken
    )


def comment_lines(lines: Iterable[str], mark: str = "") -> str:
    """Format texts of any content as one comment line each, beginning with a format's comment
    mark.
    """
    return "".join(f"{mark}{plain(line)}\n" for line in lines)


def xml_comment(lines: Iterable[str]) -> str:
    """Format lines as an XML comment, which cannot contain two adjacent hyphens or control
    characters.
    """
    return f"<!--\n{re.sub('-(?=-)', '- ', comment_lines(lines))}-->\n"


def xml_attribute(text: str) -> str:
    """Escape a text for an attribute's double quotes."""
    return escape(plain(text), quote=False).replace('"', "&quot;")


def blocks(numbers: NDArray, separator: str = " ") -> str:
    """Format a list of numbers, `NUMBERS_PER_LINE` per line."""
    texts = list(map(repr, numbers.tolist()))
    starts = range(0, len(texts), NUMBERS_PER_LINE)
    return "".join(
        f"{separator.join(texts[start : start + NUMBERS_PER_LINE])}\n" for start in starts
    )


def list_names(names: Sequence[object], most: int = NAMES_LISTED) -> str:
    """Return the first names as a text, with the number of further ones."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(str, names[:most])) + more
