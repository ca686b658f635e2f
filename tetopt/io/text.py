"""Arrays as the lines of a text file, fast and without loss; foreign text as a line that does no harm."""

from __future__ import annotations

import re
import unicodedata

from numpy.typing import NDArray

NUMBERS_PER_LINE = 16  # Abaqus takes no more


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


def xml_comment(lines: list[str]) -> str:
    """Lines as a comment of XML, which has no two hyphens in one."""
    text = re.sub("-(?=-)", "- ", "\n".join(lines))
    return f"<!--\n{text}\n-->\n"


def blocks(numbers: NDArray, separator: str = " ") -> str:
    """A list of numbers, `NUMBERS_PER_LINE` in a line."""
    texts = list(map(repr, numbers.tolist()))
    starts = range(0, len(texts), NUMBERS_PER_LINE)
    return "".join(f"{separator.join(texts[start : start + NUMBERS_PER_LINE])}\n" for start in starts)
