"""Display of a run in a terminal: its stage, its progress, the clock."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from tetopt.cli.console import log, show_event
from tetopt.cli.ending import is_ended
from tetopt.engine.loop import IterationRecord
from tetopt.job.events import Event, Stage
from tetopt.job.mesh_stage import left_words
from tetopt.system.budget import memory_words, resident_bytes

# to the first line of a stage, if there is no terminal for a bar; each wait is twice the one before
LINE_SECONDS = 10.0


class Display:
    """The listener of a run: each stage has its bar or status on a terminal, and occasional lines
    elsewhere.

    `begin_keeping` is called as soon as there is a mesh worth keeping.
    """

    def __init__(self, begin_keeping: Callable[[], None]) -> None:
        self._begin_keeping = begin_keeping
        self._shown = ExitStack()
        self._held: list[Event] = []  # problems of the mesh: printed last, where they are seen
        self._is_writing = False
        self._tell: Callable[[Event], None] = lambda event: None
        self._begin = 0.0
        self._running = 0  # number of the iteration; 0 if none runs
        self._say = rare_lines()

    def end_stage(self) -> None:
        """End the display of a stage."""
        self._shown.close()

    def close(self) -> None:
        """End the display, and print the mesh's problems: violated requirements, then warnings."""
        self.end_stage()
        self._held.sort(key=lambda event: event.kind != "violated")
        while self._held:
            show_event(self._held.pop(0))

    def __call__(self, event: Event) -> None:
        """Show an event."""
        if event.kind == "started":
            self.end_stage()
            self._start(event.data, event.text)
        elif event.kind == "progress":
            self._tell(event)
        elif event.kind == "violated" or (event.kind == "warning" and self._is_writing):
            self._held.append(event)
        else:
            show_event(event)

    def is_over(self) -> bool:
        """Return whether a signal has requested the end; within an iteration, print its progress
        from time to time.
        """
        if self._running:
            self._say(
                f"  in iteration {self._running}, {_spent(time.perf_counter() - self._begin)}"
            )
        return is_ended()

    def _start(self, stage: Stage, text: str) -> None:
        if stage.name in ("read", "start", "write"):
            self._shown.enter_context(waiting(text))
        elif stage.name == "kernels":
            say = self._shown.enter_context(compiling(text))
            self._tell = lambda event: say(event.text)
        elif stage.name == "optimise":
            self._begin_keeping()
            self._begin, self._running, self._say = time.perf_counter(), 0, rare_lines()
            show = self._shown.enter_context(_bar(stage.number or 0, stage.most_seconds))

            def recorded(event: Event) -> None:
                number = event.data.iteration + 1
                self._running = number if number <= (stage.number or 0) else 0
                show(event.data)

            self._tell = recorded
        elif stage.name in ("measure", "round"):
            if stage.name == "round":
                self._begin_keeping()
            self._tell = self._shown.enter_context(_tasks_bar(text, stage.number or 0))
        if stage.name in ("optimised", "write"):
            self._running = 0
        self._is_writing = stage.name == "write"


@contextlib.contextmanager
def compiling(title: str) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the progress of compiling: a terminal's status beginning with
    `title`, else lines.
    """
    begin = time.perf_counter()
    with log.status(f"{title} ...") as status:
        say = rare_lines(is_first_said=True)

        def progress(words: str) -> None:
            status.update(f"{words} ...")
            say(f"{words} (stored for later runs), {time.perf_counter() - begin:.0f} s")

        yield progress


@contextlib.contextmanager
def waiting(words: str) -> Iterator[None]:
    """Show that work is in progress: a terminal's status, else occasional lines."""
    begin = time.perf_counter()
    is_done = threading.Event()

    def lines() -> None:
        wait = LINE_SECONDS
        while not is_done.wait(wait):
            log.print(f"{words}, {_spent(time.perf_counter() - begin)}")
            wait *= 2.0

    if log.is_terminal:
        with log.status(f"{words} ..."):
            yield
        return
    thread = threading.Thread(target=lines, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_done.set()
        thread.join()


def rare_lines(is_first_said: bool = False) -> Callable[[str], None]:
    """Return a function that prints lines if there is no terminal, ever more rarely."""
    last, wait = -np.inf if is_first_said else time.perf_counter(), LINE_SECONDS

    def say(words: str) -> None:
        nonlocal last, wait
        now = time.perf_counter()
        if not log.is_terminal and now - last >= wait:
            last, wait = now, 2.0 * wait
            log.print(words)

    return say


def _spent(seconds: float) -> str:
    """Time and memory in words."""
    return f"{seconds:.1f} s, {memory_words(resident_bytes())}"


@contextlib.contextmanager
def _bar(
    iterations: int, most_seconds: float | None
) -> Iterator[Callable[[IterationRecord], None]]:
    """Yield a function that shows each record, with the time left: a bar on a terminal, else a
    line.
    """
    history: list[IterationRecord] = []

    def words(row: IterationRecord) -> str:
        history.append(row)
        first = history[0]
        E_D = f"  E_D {row.E_D / first.E_D:.4f}" if first.E_D > 0.0 else ""
        return f"E {row.E:.4f}  E_G {row.E_G / first.E_G:.4f}{E_D}"

    def left() -> str:
        return left_words(history, iterations, most_seconds)

    if log.is_terminal:
        columns = (
            TextColumn("optimising"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[energies]}"),
        )
        with Progress(*columns, console=log, transient=True) as bar:
            task = bar.add_task("", total=iterations, energies="")
            yield lambda row: bar.update(
                task, completed=row.iteration, energies=words(row) + left()
            )
    else:
        with contextlib.ExitStack() as between:
            between.enter_context(waiting("preparing the optimisation"))

            def tell(row: IterationRecord) -> None:
                between.close()
                begin = f"iteration {row.iteration:3d}/{iterations}  {words(row)}"
                log.print(f"{begin}  {row.n_cells} cells  {_spent(row.seconds)}{left()}")
                if row.iteration == iterations:
                    between.enter_context(waiting("lifting flat cells and judging the mesh"))

            yield tell


@contextlib.contextmanager
def _tasks_bar(title: str, number: int) -> Iterator[Callable[[Event], None]]:
    """Yield a function that shows how many tasks have ended: a bar on a terminal, else lines."""
    if log.is_terminal:
        with Progress(
            TextColumn(title), BarColumn(), MofNCompleteColumn(), console=log, transient=True
        ) as bar:
            task = bar.add_task("", total=number)
            yield lambda event: bar.update(task, completed=event.data)
    else:
        log.print(title)
        say = rare_lines()
        yield lambda event: say(f"  {event.text}")
