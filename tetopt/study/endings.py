"""How a peer fails: it crashed, or it is not installed; and the last line of what it wrote."""

from __future__ import annotations

from tetopt.errors import InputError
from tetopt.io.text import plain

LINE_CHARACTERS = 300  # of another program's line, at most: as much as a message can bear


class NotInstalled(InputError):
    """A peer that is not on this machine: nothing failed, it was never run."""


class Crashed(InputError):
    """A program that a pipeline runs was ended by a signal: another run may go well."""


def last_line(text: str) -> str:
    """The last line of another program's words that is not empty, fit for a terminal."""
    lines = text.strip().splitlines()
    line = plain(" ".join(lines[-1].split())) if lines else ""
    return line if len(line) <= LINE_CHARACTERS else line[:LINE_CHARACTERS] + "..."
