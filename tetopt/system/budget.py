"""Available memory, and checks that reject work that needs more, before it starts.

The limits of a control group (containers, clusters) and of the machine kill a process without a
message, so they must be checked in advance. Those of a process (`ulimit -v`) make an allocation
fail, which is reported when it happens.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from math import floor, inf, log10
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

BYTES_PER_GB = 1e9  # decimal, as for files
# the unit of ru_maxrss, see getrusage(2)
MAXRSS_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024
PROC_FOLDER = Path("/proc")
GROUP_FOLDER = Path("/sys/fs/cgroup")
UNLIMITED_BYTES = 1 << 60  # control groups write "no limit" as a number near 2^63
_LIMIT: ContextVar[float] = ContextVar("limit", default=inf)  # the user's, bytes


class MemoryShortage(InputError):
    """A step needs more memory than is free."""


def memory_words(n_bytes: float) -> str:
    """Format a number of bytes."""
    size, unit = (BYTES_PER_GB, "GB") if n_bytes >= 1e8 else (1e6, "MB")
    return f"{float(f'{n_bytes / size:.3g}'):g} {unit}"


def at_most(count: float, noun: str = "") -> str:
    """Advise a number that is within a limit, rounded down to two digits: "use at most 120000
    nodes".
    """
    step = 10 ** max(floor(log10(max(count, 1.0))) - 1, 0)
    return f"use at most {max(floor(count / step), 0) * step} {noun}".rstrip()


def check_memory(
    n_bytes: float, what: str, advice: str | Callable[[float], str], *, can_stop: bool = False
) -> None:
    """Raise `MemoryShortage` if the next step needs more memory than is available, or than the
    user's limit (`limit_memory`) leaves.

    Parameters
    ----------
    n_bytes : float
        Memory that the step needs in addition to what this process has.
    what : str
        The step with its sizes; begins the message.
    advice : str or callable
        The remedy; ends the message. A function returns it for the bytes that the step may take.
    can_stop : bool
        True for a step that ends itself at the user's limit.
    """
    free = available_bytes()
    limit = inf if can_stop else _LIMIT.get()
    room = limit - resident_bytes()
    remedy = advice(min(free, room)) if callable(advice) else advice
    if n_bytes > free:
        raise MemoryShortage(
            f"{what}: needs about {memory_words(n_bytes)} of memory, but only "
            f"{memory_words(free)} is free; {remedy}"
        )
    if n_bytes > room:
        raise MemoryShortage(
            f"{what}: needs about {memory_words(n_bytes + limit - room)} of memory in total, but "
            f"only {memory_words(limit)} is allowed; {remedy}"
        )


@contextmanager
def limit_memory(n_bytes: float | None) -> Iterator[None]:
    """Limit the total memory of this process, within a context; None sets no limit."""
    token = _LIMIT.set(inf if n_bytes is None else n_bytes)
    try:
        yield
    finally:
        _LIMIT.reset(token)


class MemoryLimit(NamedTuple):
    """The user's memory limit, and the additional memory that the next steps of a run may take."""

    n_bytes: float
    next_bytes: float

    def is_reached(self) -> bool:
        """Return whether the run must end so as not to exceed the limit."""
        return resident_bytes() + self.next_bytes > self.n_bytes


def available_bytes() -> int:
    """Return the memory available without swapping, within all limits."""
    import psutil

    free = psutil.virtual_memory().available
    of_group = _group_bytes()
    return max(0, free if of_group is None else min(free, of_group))


def resident_bytes() -> int:
    """Return the resident memory of this process."""
    import psutil

    return psutil.Process().memory_info().rss


def address_bytes() -> int:
    """Return the address space in use by this process; 0 where the system does not report it.

    Children that read a file call this, so it does without psutil, whose import would take a tenth
    of their time.
    """
    try:
        pages = (PROC_FOLDER / "self" / "statm").read_text(encoding="ascii").split()[0]
    except OSError:
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def peak_bytes() -> int:
    """Return the peak memory of this process; 0 if the system does not report it.

    On Linux this is VmHWM, not ru_maxrss, which starts at the memory of the parent that started the
    process.
    """
    try:
        status = (PROC_FOLDER / "self" / "status").read_text(encoding="ascii", errors="replace")
    except OSError:
        status = ""
    if (row := re.search(r"^VmHWM:\s+(\d+) kB", status, re.M)) is not None:
        return 1024 * int(row.group(1))
    return 0 if resource is None else _maxrss(resource.RUSAGE_SELF)


def return_freed() -> None:
    """Return freed memory to the system, of which glibc keeps arrays of up to 32 MB; other C
    libraries do without.
    """
    if (
        sys.platform == "linux"
        and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None
    ):
        trim(0)


def forget_peak() -> None:
    """Lower this process's peak to its present memory, for a new task; only on Linux, proc(5)."""
    with suppress(OSError):
        (PROC_FOLDER / "self" / "clear_refs").write_text("5", encoding="ascii")


def family_peak_bytes() -> int:
    """Return the peak memory of this process and of the children that it has waited for."""
    return max(peak_bytes(), 0 if resource is None else _maxrss(resource.RUSAGE_CHILDREN))


def _maxrss(who: int) -> int:
    return resource.getrusage(who).ru_maxrss * MAXRSS_UNIT_BYTES


def _group_bytes() -> int | None:
    """Return what the control groups (version 2 or 1) of this process leave; the file cache
    counts as free.
    """
    try:
        rows = (PROC_FOLDER / "self" / "cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    rooms = []
    for row in rows:
        _, controllers, path = row.split(":", 2)
        if controllers == "":
            root = GROUP_FOLDER
            names = ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            root = GROUP_FOLDER / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        folder = root / path.lstrip("/")
        # A container sees its own group as the root, whatever its path is outside; the limits of
        # parents apply too.
        for at in {
            root,
            *(part for part in (folder, *folder.parents) if part.is_relative_to(root)),
        }:
            room = _group_room(at, *names)
            if room is not None:
                rooms.append(room)
    return min(rooms, default=None)


def _group_room(folder: Path, limit_name: str, used_name: str, cached_name: str) -> int | None:
    try:
        limit = (folder / limit_name).read_text(encoding="ascii").strip()
        used = int((folder / used_name).read_text(encoding="ascii"))
        cached = re.search(
            rf"^{cached_name} (\d+)", (folder / "memory.stat").read_text(encoding="ascii"), re.M
        )
    except OSError:
        return None
    if not limit.isdigit() or int(limit) > UNLIMITED_BYTES:
        return None
    return int(limit) - used + (int(cached.group(1)) if cached else 0)
