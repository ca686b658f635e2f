"""A file that is written, and read back before it takes its name."""

from __future__ import annotations

import errno
from pathlib import Path

from tetopt.system.files import written_whole

COMPARED_BYTES = 2**24  # of the file and of what was written, at a time: so much more memory


def save_checked(path: Path, whole: bytes) -> None:
    """Write a file, whole or not at all, and compare what reads back before it takes its name.

    Raises
    ------
    OSError
        As `tetopt.system.files.written_whole`; the file has other bytes.
    """
    with written_whole(path, len(whole)) as temporary:
        temporary.write_bytes(whole)
        with temporary.open("rb") as file:
            starts = range(0, len(whole) + 1, COMPARED_BYTES)
            is_same = all(file.read(COMPARED_BYTES) == whole[at : at + COMPARED_BYTES] for at in starts)
        if not is_same:
            raise OSError(errno.EIO, "what was written reads back otherwise; is the disk sound?")
