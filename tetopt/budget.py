"""What memory there is, and that nothing is begun which needs more: it is said in one line, before it is taken.

Limits of a process (RLIMIT_AS, RLIMIT_DATA, as `ulimit` and schedulers set them) make an allocation fail. Those of a
control group (containers, clusters) and of the machine end the process without a word, so that only asking before
helps.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

BYTES_PER_GB = 1e9  # as of memory that is sold and of files
MAXRSS_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, as getrusage(2) has it
LIBRARY_ADDRESSES = 1.2e9  # libraries, stacks and buffers of threads, all kernels: 1.1 GB on two cores, of 0.3 in use
PROC_FOLDER = Path("/proc")
GROUP_FOLDER = Path("/sys/fs/cgroup")
UNLIMITED_BYTES = 1 << 60  # of a control group's: "no limit" is a number near 2^63 there


def memory_words(n_bytes: float) -> str:
    """A number of bytes in words."""
    return f"{n_bytes / BYTES_PER_GB:.3g} GB" if n_bytes >= 1e8 else f"{n_bytes / 1e6:.3g} MB"


def check_memory(n_bytes: float, what: str, advice: str, limit: float | None = None) -> None:
    """InputError if what is about to be done needs more memory than there is, or than `limit`, bytes.

    Parameters
    ----------
    n_bytes : float
        What it will need besides what this process has.
    what : str
        That needs it, with its sizes, as a message begins.
    advice : str
        What to do instead, as a message ends.
    limit : float, optional
        Of the user's own, of all that this process has.
    """
    free = available_bytes()
    if free is not None and n_bytes > free:
        raise InputError(
            f"{what}: needs about {memory_words(n_bytes)} of memory, {memory_words(free)} are free; {advice}"
        )
    if limit is not None and n_bytes + resident_bytes() > limit:
        raise InputError(
            f"{what}: needs about {memory_words(n_bytes + resident_bytes())} of memory in all, "
            f"{memory_words(limit)} are allowed; {advice}"
        )


class MemoryLimit(NamedTuple):
    """A limit of the user's own, and what the next steps of a run may take besides what there is."""

    n_bytes: float
    next_bytes: float

    def is_reached(self) -> bool:
        """Whether to end, lest it be exceeded."""
        return resident_bytes() + self.next_bytes > self.n_bytes


def check_addresses() -> None:
    """InputError where the limit of a process (`ulimit -v`) leaves too few addresses to load numba and the like.

    Libraries end the process where they find none: OpenBLAS and LLVM exit, others cannot be imported.
    """
    room = address_room()
    if room is not None and room < LIBRARY_ADDRESSES:
        raise InputError(
            f"the limit on this process leaves {memory_words(room)} of addresses, numba and the other libraries need "
            f"{memory_words(LIBRARY_ADDRESSES)}; raise it (ulimit -v, ulimit -d)"
        )


def available_bytes() -> int | None:
    """Memory that could be had without swapping, within all limits; None where the system does not say."""
    numbers = [_machine_bytes(), _group_bytes(), *_process_bytes()]
    known = [max(number, 0) for number in numbers if number is not None]
    return min(known, default=None)


def resident_bytes() -> int:
    """Memory that this process has now; where the system does not say, its peak."""
    resident = _statm_bytes(1)
    return peak_bytes() if resident is None else resident


def address_bytes() -> int:
    """Address space that this process has taken; 0 where the system does not say."""
    return _statm_bytes(0) or 0


def peak_bytes() -> int:
    """The most memory that this process has had; 0 where the system does not say.

    On Linux VmHWM, not ru_maxrss: the latter begins at the memory of the parent that started the process.
    """
    return status_bytes("VmHWM") or (
        0 if resource is None else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * MAXRSS_UNIT_BYTES
    )


def status_bytes(name: str, process: Path | None = None) -> int:
    """An entry of the status of a process, a folder of /proc, e.g. VmRSS: of this one, if none is named.

    0 if it has ended, or where the system does not say.
    """
    try:
        text = ((process or PROC_FOLDER / "self") / "status").read_text(encoding="ascii", errors="replace")
    except OSError:
        return 0
    row = re.search(rf"^{name}:\s+(\d+) kB", text, re.M)
    return 1024 * int(row.group(1)) if row is not None else 0


def _statm_bytes(column: int) -> int | None:
    """A column of this process's statm (proc_pid_statm(5)), in bytes; None where there is none."""
    try:
        pages = int((PROC_FOLDER / "self" / "statm").read_text(encoding="ascii").split()[column])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


def address_room() -> int | None:
    """Address space that this process may still take, where there is a limit to it."""
    rooms = _process_bytes()
    return min(rooms, default=None)


def _process_bytes() -> list[int]:
    """What the limits of this process leave, of each that is set."""
    rooms = []
    # The names of the limits, and which column of statm tells what is used.
    for name, column in (("RLIMIT_AS", 0), ("RLIMIT_DATA", 5)):
        if resource is None or not hasattr(resource, name):
            continue
        limit = resource.getrlimit(getattr(resource, name))[0]
        if limit == resource.RLIM_INFINITY:
            continue
        if (used := _statm_bytes(column)) is not None:
            rooms.append(limit - used)
    return rooms


def _machine_bytes() -> int | None:
    table = PROC_FOLDER / "meminfo"
    if table.is_file():
        row = re.search(r"^MemAvailable: +(\d+) kB", table.read_text(encoding="ascii"), re.M)
        if row is not None:
            return 1024 * int(row.group(1))
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _group_bytes() -> int | None:
    """What the control groups of this process leave, of version 2 or 1; what files take there can be had."""
    try:
        rows = (PROC_FOLDER / "self" / "cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    rooms = []
    for row in rows:
        _, controllers, path = row.split(":", 2)
        if controllers == "":
            root, names = GROUP_FOLDER, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            root = GROUP_FOLDER / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        folder = root / path.lstrip("/")
        # A container sees its own group as the root, whatever its path is called outside; parents limit, too.
        for at in {root, *(part for part in (folder, *folder.parents) if part.is_relative_to(root))}:
            room = _group_room(at, *names)
            if room is not None:
                rooms.append(room)
    return min(rooms, default=None)


def _group_room(folder: Path, limit_name: str, used_name: str, cached_name: str) -> int | None:
    try:
        limit = (folder / limit_name).read_text(encoding="ascii").strip()
        used = int((folder / used_name).read_text(encoding="ascii"))
        cached = re.search(rf"^{cached_name} (\d+)", (folder / "memory.stat").read_text(encoding="ascii"), re.M)
    except OSError:
        return None
    if not limit.isdigit() or int(limit) > UNLIMITED_BYTES:
        return None
    return int(limit) - used + (int(cached.group(1)) if cached else 0)
