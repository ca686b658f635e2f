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
    if n_bytes > free:
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


def available_bytes() -> int:
    """Memory that could be had without swapping, within all limits."""
    import psutil

    rooms = [psutil.virtual_memory().available, _group_bytes(), *_process_bytes()]
    return max(0, min(room for room in rooms if room is not None))


def resident_bytes() -> int:
    """Memory that this process has now."""
    import psutil

    return psutil.Process().memory_info().rss


def address_bytes() -> int:
    """Address space that this process has taken; 0 where the system does not say.

    Children that read a file ask for it, so that psutil is not loaded for it: that takes a tenth of their time.
    """
    try:
        pages = (PROC_FOLDER / "self" / "statm").read_text(encoding="ascii").split()[0]
    except OSError:
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def peak_bytes(pid: int | None = None) -> int:
    """The most memory that a process has had, this one by default; 0 if it has ended, or the system does not say.

    On Linux VmHWM, not ru_maxrss: the latter begins at the memory of the parent that started the process.
    """
    try:
        status = (PROC_FOLDER / str(pid or "self") / "status").read_text(encoding="ascii", errors="replace")
    except OSError:
        status = ""
    if (row := re.search(r"^VmHWM:\s+(\d+) kB", status, re.M)) is not None:
        return 1024 * int(row.group(1))
    return 0 if resource is None or pid is not None else _maxrss(resource.RUSAGE_SELF)


def family_peak_bytes() -> int:
    """The most memory that this process has had, or one that it has waited for."""
    return max(peak_bytes(), 0 if resource is None else _maxrss(resource.RUSAGE_CHILDREN))


def _maxrss(who: int) -> int:
    return resource.getrusage(who).ru_maxrss * MAXRSS_UNIT_BYTES


def address_room() -> int | None:
    """Address space that this process may still take, where there is a limit to it."""
    rooms = _process_bytes()
    return min(rooms, default=None)


def _process_bytes() -> list[int]:
    """What the limits of this process leave, of each that is set."""
    names = {"RLIMIT_AS": "vms", "RLIMIT_DATA": "data"}
    limits = {used: resource.getrlimit(getattr(resource, name))[0] for name, used in names.items() if resource}
    if all(limit == resource.RLIM_INFINITY for limit in limits.values()):
        return []
    import psutil

    used_bytes = psutil.Process().memory_info()._asdict()
    return [
        limit - used_bytes[used]
        for used, limit in limits.items()
        if limit != resource.RLIM_INFINITY and used in used_bytes
    ]


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
