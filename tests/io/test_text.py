"""Foreign text made harmless."""

import sys
import unicodedata

import pytest

from tetopt.io.text import last_line, plain


@pytest.mark.parametrize(
    "name", ["", "T1w", "Größe µm", "名前", "a\u00a0b", "[red]x[/]", '<x a="b">', "=1+2", "\\n"]
)
def test_printable_text_stays(name):
    assert plain(name) == name


def test_what_is_not_printed_is_shown():
    assert plain("a\0b\x1b[31m\n\r\t\x7f\x9b") == r"a\x00b\x1b[31m\n\r\t\x7f\x9b"
    assert (
        plain("\u2028\u2029\u202e\u2066\ufeff\udcff\udc80")
        == r"\u2028\u2029\u202e\u2066\ufeff\udcff\udc80"
    )


@pytest.mark.full
def test_of_all_letters_only_harmless_ones_are_left():
    """Whatever comes in, what comes out can be encoded, and breaks, erases or turns no line."""
    shown = plain("".join(map(chr, range(sys.maxunicode + 1))))
    assert len(shown.splitlines()) == 1
    shown.encode()
    kinds = {unicodedata.category(letter) for letter in set(shown)}
    assert not kinds & {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}


def test_last_lines():
    assert last_line("a\n  b\tc \x1b[31m\n\n") == r"b c \x1b[31m"
    assert last_line("\n") == ""
    assert last_line("x" * 1000) == "x" * 300 + "..."
