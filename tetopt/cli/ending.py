"""How a command ends before its time: Ctrl-C, SIGTERM, which schedulers send, and SIGHUP, of a terminal that closes."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from tetopt.cli.console import log

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
SIGNAL_CODE = 128  # and a signal's number: the exit code that shells give to what it ended
INTERRUPTED_CODE = SIGNAL_CODE + signal.SIGINT  # what commands and typer return after any of them


class _Ending:
    """The signals that came, and whether the next one is to be waited with: one of them for the whole process."""

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.is_deferred = False

    def on_signal(self, number: int, _frame: FrameType | None) -> None:
        self.numbers.append(number)
        if self.is_deferred and len(self.numbers) == 1:
            log.print("interrupted: finishing the current nodes, then writing the mesh (again to give up)")
            return
        if self.is_deferred:
            log.print("interrupted again: what is not yet written is given up")
        raise KeyboardInterrupt


_ending = _Ending()


@contextmanager
def signals_heard() -> Iterator[None]:
    """Within it the first signal raises KeyboardInterrupt, or, within `mesh_kept`, only `is_ended`.

    A signal that is ignored remains so, as SIGHUP under nohup and SIGINT in the background.
    """
    before: dict[Any, Any] = {}
    _ending.numbers.clear()
    _ending.is_deferred = False
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
    """Once the function that it gives was called, there is a mesh: the first signal waits until that is written."""

    def begin() -> None:
        _ending.is_deferred = True

    try:
        yield begin
    finally:
        _ending.is_deferred = False


def is_ended() -> bool:
    """Whether a signal has asked for the end."""
    return bool(_ending.numbers)


def signal_name() -> str:
    """What has ended the command, in words."""
    code = signal_code()
    return "Ctrl-C" if code == INTERRUPTED_CODE else signal.Signals(code - SIGNAL_CODE).name


def signal_code() -> int:
    """The exit code after the first signal that came, that of Ctrl-C if none did."""
    return SIGNAL_CODE + _ending.numbers[0] if _ending.numbers else INTERRUPTED_CODE
