"""Events of a run: data with a line of text, which a terminal, a notebook or a program can show."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal, NamedTuple

from tetopt.errors import Note, warn

# a stage of every run
KERNEL_WORDS = "preparing the kernels (the first run compiles them, half a minute)"
Kind = Literal["started", "progress", "note", "warning", "violated"]
"""A stage begins; its progress; a note; an oddity; a requirement that the mesh does not meet."""


ENDED_WORDS = {
    "max_seconds": "out of time",
    "max_gb": "memory limit reached",
    "stopped": "interrupted",
}


class Stage(NamedTuple):
    """A stage that a run begins."""

    name: str  # read, start, kernels, optimise, measure, round, write, ...
    number: int | None  # of iterations, or of tasks
    most_seconds: float | None = None  # after which the stage ends, if limited


class Event(NamedTuple):
    """An event of a run.

    Parameters
    ----------
    kind : {"started", "progress", "note", "warning", "violated"}
        A stage begins; its progress; a note; an oddity; a requirement that is not met.
    text : str
        On one line. Arguments of the job are between backticks: "`nodes`".
    data : object
        For "started" the `Stage`; for "progress" the state, such as an `IterationRecord`; for
        "violated" the requirement's name.

    Examples
    --------
    >>> Event("note", "the image is also the label image: only the labels are used").kind
    'note'
    """

    kind: Kind
    text: str
    data: Any = None


Listener = Callable[[Event], None]


def _unheard(event: Event) -> None:
    """Turn warnings and violated requirements into Python's warnings, and ignore other events."""
    if event.kind in ("warning", "violated"):
        warn(event.text)


_LISTENER: ContextVar[Listener] = ContextVar("listener", default=_unheard)


@contextmanager
def listen_with(listener: Listener | None) -> Iterator[None]:
    """Send events to a listener within this context; None keeps the current listener."""
    token = _LISTENER.set(_LISTENER.get() if listener is None else listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def warnings_heard() -> Iterator[None]:
    """Report Python's warnings within this context as events."""
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    finally:
        for each in caught:
            (note if issubclass(each.category, Note) else warning)(str(each.message))


def ended_words(ended: str, kept: str, followed: str) -> str:
    """Return why a run ended before its last iteration, and what is kept; `followed` names
    surfaces.
    """
    if ended == "converged":
        return "converged: the mesh hardly changes any more"
    if ended == "risen":
        return "ended, as E no longer falls" + (f": nodes follow {followed}" if followed else "")
    return f"{ENDED_WORDS[ended]}: {kept} is kept"


def time_words(seconds: float) -> str:
    """Format a time."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def start_stage(
    stage: str, text: str = "", number: int | None = None, most_seconds: float | None = None
) -> None:
    """Report that a stage begins, which ends the previous one; `number` and `most_seconds` as in
    `Stage`.
    """
    _LISTENER.get()(Event("started", text, Stage(stage, number, most_seconds)))


def progress(text: str, data: Any = None) -> None:
    """Report the progress of the stage."""
    _LISTENER.get()(Event("progress", text, data))


def note(text: str) -> None:
    """Report a note."""
    _LISTENER.get()(Event("note", text))


def warning(text: str) -> None:
    """Report something valid that is probably not intended."""
    _LISTENER.get()(Event("warning", text))


def report_violation(text: str, name: str | None = None) -> None:
    """Report a violation; `name` is that of a run's requirement."""
    words = text if name is None else f"requirement violated: {name}: {text}"
    _LISTENER.get()(Event("violated", words, name))
