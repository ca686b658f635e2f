"""Arrays as the lines of a text file, fast and without loss; foreign text as a line that does no harm."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Container, Iterable
from html import escape  # not of xml.sax, which loads urllib.request and all that goes through a network, 0.02 s
from itertools import accumulate, chain, count
from urllib.parse import quote

from numpy.typing import NDArray

NUMBERS_PER_LINE = 16  # Abaqus takes no more
# Of a field's name where readers have lines of 256 characters: gmsh's, and legacy VTK's, percent-encoded there.
MOST_NAME_CHARACTERS = 240
UNNAMED_FIELD = "unnamed"  # VTK cannot read a file again that has a field without a name


def rows(*columns: NDArray, separator: str = " ") -> str:
    """One line for each row of the arrays side by side, each (K,) or (K, w); floats so that they read back the same.

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
    r"""Foreign text on one line of printable characters, for terminals, comments and names of all kinds.

    What is not printed is shown as Python escapes it: line breaks, control characters, marks that turn the direction of
    writing, and lone surrogates, as which bytes of a file's name come that are no UTF-8. Spaces of any width stay.

    Examples
    --------
    >>> print(plain("a\x1b[31mb\n"), plain("\u202egnp.exe"), plain("\udcff.nii"), plain("100 %"))
    a\x1b[31mb\n \u202egnp.exe \udcff.nii 100 %
    """
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() or unicodedata.category(letter) == "Zs" else _escaped(letter) for letter in text
    )


def _escaped(letter: str) -> str:
    return letter.encode("unicode_escape").decode("ascii")


def file_name(name: str) -> str:
    """A field's name as every format can hold it: `plain`, and not without a letter."""
    return plain(name) if name.strip() else UNNAMED_FIELD


def short_name(name: str) -> str:
    """The first letters of a `file_name`, as many as fit into `MOST_NAME_CHARACTERS`, percent-encoded."""
    name = file_name(name)
    if len(name) <= MOST_NAME_CHARACTERS and len(quote(name)) <= MOST_NAME_CHARACTERS:
        return name
    sizes = accumulate(len(quote(letter)) for letter in name[:MOST_NAME_CHARACTERS])
    return name[: sum(size <= MOST_NAME_CHARACTERS for size in sizes)]


def legacy_name(name: str) -> str:
    """A `short_name` without braces, which VTK's writer of legacy files takes for its own marks, and ends at.

    Examples
    --------
    >>> legacy_name("{a}")
    '(a)'
    """
    return short_name(name).translate(str.maketrans("{}", "()"))


def names_apart(names: Iterable[str], shown: Callable[[str], str]) -> dict[str, str]:
    """What each of some names becomes: `shown` of it, numbered where another is called so.

    Those that can keep their names do.

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
    """The text, numbered from 2 where it is taken."""
    return next(each for each in chain([text], (f"{text}_{number}" for number in count(2))) if each not in taken)


def comment_lines(lines: Iterable[str], mark: str = "") -> str:
    """A line for each of some texts, whatever they hold, that begins with a format's mark of comments."""
    return "".join(f"{mark}{plain(line)}\n" for line in lines)


def xml_comment(lines: Iterable[str]) -> str:
    """Lines as a comment of XML, which has no two hyphens in one, and holds no control characters."""
    return f"<!--\n{re.sub('-(?=-)', '- ', comment_lines(lines))}-->\n"


def xml_attribute(text: str) -> str:
    """Text as it stands between an attribute's double quotes."""
    return escape(plain(text), quote=False).replace('"', "&quot;")


def blocks(numbers: NDArray, separator: str = " ") -> str:
    """A list of numbers, `NUMBERS_PER_LINE` in a line."""
    texts = list(map(repr, numbers.tolist()))
    starts = range(0, len(texts), NUMBERS_PER_LINE)
    return "".join(f"{separator.join(texts[start : start + NUMBERS_PER_LINE])}\n" for start in starts)
