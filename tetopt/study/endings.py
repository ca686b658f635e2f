"""How processes end, in words: by a signal, with a last line, or because a peer is not on this machine."""

from __future__ import annotations

import signal

from tetopt.errors import InputError
from tetopt.io.text import plain

# Of those that end a program which did not ask for it; a shell that ran it then ends with 128 more.
CRASH_SIGNALS = ("SIGILL", "SIGTRAP", "SIGABRT", "SIGBUS", "SIGFPE", "SIGKILL", "SIGSEGV")
SHELL_OFFSET = 128  # what a shell adds to a signal's number
LINE_CHARACTERS = 300  # of another program's line, at most: as much as a message can bear


class NotInstalled(InputError):
    """A peer that is not on this machine: nothing failed, it was never run."""


class Crashed(InputError):
    """A program that a pipeline runs was ended by a signal: another run may go well."""


def signal_words(code: int) -> str | None:
    """The signal that ended a process of this return code, as "signal 11, SIGSEGV"; None if it ended by itself.

    A negative code is that of the process itself; one of 128 more is what a shell makes of its program's crash.
    """
    number = -code if code < 0 else code - SHELL_OFFSET
    try:
        name = signal.Signals(number).name
    except ValueError:
        return f"signal {number}" if code < 0 else None
    return f"signal {number}, {name}" if code < 0 or name in CRASH_SIGNALS else None


def last_line(text: str) -> str:
    """The last line of another program's words that is not empty, fit for a terminal."""
    lines = text.strip().splitlines()
    line = plain(" ".join(lines[-1].split())) if lines else ""
    return line if len(line) <= LINE_CHARACTERS else line[:LINE_CHARACTERS] + "..."
