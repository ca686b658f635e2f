"""Early ends of a command: Ctrl-C, SIGTERM, which schedulers send, and SIGHUP, which a closing
terminal sends.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from tetopt.cli.console import log, say
from tetopt.system.files import present_outputs

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
SIGNAL_CODE = 128  # plus a signal's number: the exit code that shells give to a process it ended
INTERRUPTED_CODE = SIGNAL_CODE + signal.SIGINT  # commands and typer return it after any of them


class _Ending:
    """The signals received, and whether the next one is deferred: one instance for the whole
    process.
    """

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.is_deferred = False
        self.is_told = False

    def on_signal(self, number: int, _frame: FrameType | None) -> None:
        self.numbers.append(number)
        if self.is_deferred and len(self.numbers) == 1:
            log.print(
                "interrupted: finishing the current nodes, then writing the mesh (interrupt "
                "again to end at once)"
            )
            return
        if self.is_deferred:
            log.print("interrupted again: unwritten results are discarded")
        raise KeyboardInterrupt


_ending = _Ending()


@contextmanager
def signals_heard() -> Iterator[None]:
    """Handle signals: the first raises KeyboardInterrupt, or, within `mesh_kept`, only makes
    `is_ended` true.

    An ignored signal remains ignored, as SIGHUP under nohup and SIGINT in the background.
    """
    before: dict[Any, Any] = {}
    _ending.numbers.clear()
    _ending.is_deferred = _ending.is_told = False
    try:
        for number in SIGNALS:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, _ending.on_signal)
    except ValueError:  # not in the main thread, where signals do not arrive either
        pass
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def mesh_kept() -> Iterator[Callable[[], None]]:
    """Defer the first signal until the mesh is written, once the function that this yields has
    been called.
    """

    def begin() -> None:
        _ending.is_deferred = True

    try:
        yield begin
    finally:
        _ending.is_deferred = False


def is_ended() -> bool:
    """Return whether a signal has requested the end."""
    return bool(_ending.numbers)


def tell_end() -> int:
    """Print, once, which signal ended the command and which outputs exist; return the exit code."""
    code = signal_code()
    outputs = present_outputs()
    if not _ending.is_told:
        _ending.is_told = True
        name = "Ctrl-C" if code == INTERRUPTED_CODE else signal.Signals(code - SIGNAL_CODE).name
        names = "" if outputs is None else ", ".join(map(str, outputs.written)) or "nothing"
        # A command without checked outputs has printed what exists.
        say(
            f"ended by {name}"
            + (f"; written: {names}" if outputs is not None and outputs.places else "")
        )
    return code


def signal_code() -> int:
    """Return the exit code for the first signal received, or that of Ctrl-C if there was none."""
    return SIGNAL_CODE + _ending.numbers[0] if _ending.numbers else INTERRUPTED_CODE
