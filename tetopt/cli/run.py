"""One optimisation as a terminal shows it: kernels made ready, progress and the clock."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tetopt import Mesh
from tetopt.budget import MemoryLimit, memory_words, resident_bytes
from tetopt.cli.console import log
from tetopt.cli.ending import is_ended
from tetopt.engine.fast import prepare_kernels
from tetopt.engine.loop import Optimized, Record
from tetopt.engine.meshing import Mode, Run
from tetopt.target.content import Content

LONG_SECONDS = 3.0  # to make the kernels ready: they were compiled then, not loaded
LINE_SECONDS = 10.0  # between lines, where there is no terminal to show a bar on


def watched_run(
    run: Run, initial: Mesh, iterations: int, ends: float | None, limit: MemoryLimit | None = None
) -> Optimized:
    """A run with progress shown, ended in good order at a time, before a limit of memory, or by a signal.

    See `tetopt.cli.ending.is_ended`.
    """
    max_seconds = None if ends is None else max(ends - time.perf_counter(), 1e-9)
    begin, rows = time.perf_counter(), list[Record]()
    say = rare_lines()

    def is_stopped() -> bool:
        if rows:
            say(f"  in iteration {len(rows)}, {_spent(time.perf_counter() - begin)}")
        return is_ended() or (limit is not None and limit.is_reached())

    with _progress(iterations) as show:

        def recorded(row: Record) -> None:
            rows.append(row)
            show(row)

        result = run(max_seconds=max_seconds, callback=recorded, stop=is_stopped)
    if iterations == 0:  # the initial mesh itself, not its nodes put on the sampling grid
        result = result._replace(mesh=initial)
    if result.ended == "stopped" and not is_ended():
        result = result._replace(ended="max_gb")
    if result.ended != "iterations":
        words = {
            "converged": "converged: hardly anything changes any more",
            "max_seconds": "out of time: the mesh so far is kept",
            "max_gb": "no more memory is allowed: the mesh so far is kept",
            "stopped": "interrupted: the mesh so far is kept",
        }
        log.print(f"{words[result.ended]} (iteration {result.history[-1].iteration} of {iterations})")
    return result


def prepare(content: Content, k_D: float, mode: Mode) -> None:
    """Load the compiled kernels, or compile them, before the clock of the first iteration starts."""
    begin = time.perf_counter()
    with compiling("preparing the kernels (the first run compiles them, half a minute)") as progress:
        prepare_kernels(content, k_D, "paper" if mode == "paper" else "fast", mode == "graded", progress)
    seconds = time.perf_counter() - begin
    if seconds > LONG_SECONDS:
        log.print(f"kernels compiled in {seconds:.0f} s; later runs on images of this kind load them from the cache")


@contextlib.contextmanager
def compiling(title: str) -> Iterator[Callable[[str], None]]:
    """A function that shows how far compiling is: a terminal's status, which begins with `title`, else lines."""
    begin = time.perf_counter()
    with log.status(f"{title} ...") as status:
        say = rare_lines(is_first_said=True)

        def progress(words: str) -> None:
            status.update(f"{words} ...")
            say(f"{words} (of the first run only), {time.perf_counter() - begin:.0f} s")

        yield progress


@contextlib.contextmanager
def waiting(words: str) -> Iterator[None]:
    """Show that something is being done: a terminal's status, else a line from time to time."""
    begin, is_done = time.perf_counter(), threading.Event()

    def lines() -> None:
        while not is_done.wait(LINE_SECONDS):
            log.print(f"{words}, {_spent(time.perf_counter() - begin)}")

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
    """A function that prints lines where there is no terminal, at most one in `LINE_SECONDS`."""
    last = -np.inf if is_first_said else time.perf_counter()

    def say(words: str) -> None:
        nonlocal last
        now = time.perf_counter()
        if not log.is_terminal and now - last >= LINE_SECONDS:
            last = now
            log.print(words)

    return say


def _spent(seconds: float) -> str:
    """Time and memory in words."""
    return f"{seconds:.1f} s, {memory_words(resident_bytes())}"


@contextlib.contextmanager
def _progress(iterations: int) -> Iterator[Callable[[Record], None]]:
    """A function that shows each record: a bar with the remaining time on a terminal, else a line."""
    first: list[Record] = []

    def words(row: Record) -> str:
        first.append(row)
        E_D = f"  E_D {row.E_D / first[0].E_D:.4f}" if first[0].E_D > 0.0 else ""
        return f"E {row.E:.4f}  E_G {row.E_G / first[0].E_G:.4f}{E_D}"

    if log.is_terminal:
        columns = (
            TextColumn("optimising"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            TextColumn("{task.fields[energies]}"),
        )  # fmt: skip
        with Progress(*columns, console=log, transient=True) as bar:
            task = bar.add_task("", total=iterations, energies="")
            yield lambda row: bar.update(task, completed=row.iteration, energies=words(row))
    else:
        yield lambda row: log.print(
            f"iteration {row.iteration:3d}/{iterations}  {words(row)}  {row.n_cells} cells  {_spent(row.seconds)}"
        )
