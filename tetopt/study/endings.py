"""Failures of a peer: a crash, or a missing installation; and the last line of its output."""

from __future__ import annotations

from tetopt.errors import InputError
from tetopt.io.text import plain

AFTER_CRASHES = "try another number of classes or nodes, or your own labels"
LINE_CHARACTERS = 300  # of another program's line in a message, at most


class NotInstalled(InputError):
    """A peer is not installed on this machine, and was never run."""


class Crashed(InputError):
    """A signal ended a program of a pipeline; another run may succeed."""


def last_line(text: str) -> str:
    """Return the last non-empty line of another program's output, safe for a terminal."""
    lines = text.strip().splitlines()
    line = plain(" ".join(lines[-1].split())) if lines else ""
    return line if len(line) <= LINE_CHARACTERS else line[:LINE_CHARACTERS] + "..."
