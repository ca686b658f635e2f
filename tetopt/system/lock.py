"""A lock on a file, which the system releases when the process ends."""

from __future__ import annotations

from typing import IO, Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

HAS_LOCKS = fcntl is not None


def lock_file(stream: IO[Any], *, is_shared: bool = False) -> bool:
    """Lock an open file until it is closed; return False if another process holds it. Nothing is
    locked on Windows.

    Raises
    ------
    OSError
        The file system has no locks.
    """
    if HAS_LOCKS:
        try:
            fcntl.flock(stream, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True
