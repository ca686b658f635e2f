"""What a run tells while it goes on: data with a text, for a terminal, a notebook or a program to show."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal, NamedTuple

from tetopt.errors import warn

KERNEL_WORDS = "preparing the kernels (the first run compiles them, half a minute)"  # a stage of every run
Kind = Literal["started", "progress", "note", "warning", "violated"]
"""A stage begins; how far it is; a line to know; what is odd; a requirement that the mesh does not meet."""


ENDED_WORDS = {"max_seconds": "out of time", "max_gb": "no more memory is allowed", "stopped": "interrupted"}


class Stage(NamedTuple):
    """What a run begins with now."""

    name: str  # read, start, kernels, optimise, parts, write, ...
    number: int | None  # of iterations


class Event(NamedTuple):
    """One of the things that a run tells.

    Parameters
    ----------
    kind : {"started", "progress", "note", "warning", "violated"}
        A stage began; how far it is; a line to know; what is odd; a requirement that is not met.
    text : str
        On one line. Arguments of the job stand between backticks: "`nodes`".
    data : object
        Of "started" the `Stage`; of "progress" what that counts, such as an `IterationRecord`; of "violated" the
        requirement's name.

    Examples
    --------
    >>> tetopt.Event("note", "the image is its own labels: only these count").kind
    'note'
    """

    kind: Kind
    text: str
    data: Any = None


Listener = Callable[[Event], None]


def _unheard(event: Event) -> None:
    """Without a listener, warnings and violated requirements are Python's warnings, and nothing else is said."""
    if event.kind in ("warning", "violated"):
        warn(event.text)


_LISTENER: ContextVar[Listener] = ContextVar("listener", default=_unheard)


@contextmanager
def listened(listener: Listener | None) -> Iterator[None]:
    """Within it a listener gets the events; None leaves the one that there is."""
    token = _LISTENER.set(_LISTENER.get() if listener is None else listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def ended_words(ended: str, kept: str) -> str:
    """Why a run has ended before its last iteration, and what is kept of it."""
    if ended == "converged":
        return "converged: hardly anything changes any more"
    return f"{ENDED_WORDS[ended]}: {kept} is kept"


def started(stage: str, text: str = "", number: int | None = None) -> None:
    """Tell that a stage begins, which ends the one before, and how many iterations it has."""
    _LISTENER.get()(Event("started", text, Stage(stage, number)))


def progress(text: str, data: Any = None) -> None:
    """Tell how far the stage is."""
    _LISTENER.get()(Event("progress", text, data))


def note(text: str) -> None:
    """Tell something that is good to know."""
    _LISTENER.get()(Event("note", text))


def warning(text: str) -> None:
    """Tell something that is allowed, but hardly meant."""
    _LISTENER.get()(Event("warning", text))


def violated(text: str, name: str | None = None) -> None:
    """Tell what the mesh should be and is not; of a run's requirement with its name."""
    words = text if name is None else f"requirement violated: {name}: {text}"
    _LISTENER.get()(Event("violated", words, name))
