"""Writing of files that are read back before they take their name."""

from __future__ import annotations

import errno
from pathlib import Path

from tetopt.system.files import written_whole

COMPARED_BYTES = 2**24  # compared at a time, which limits additional memory


def save_checked(path: Path, whole: bytes) -> None:
    """Write a file, whole or not at all, and compare it with what reads back before it takes its
    name.

    Raises
    ------
    OSError
        For the reasons of `tetopt.system.files.written_whole`; the file reads back differently.
    """
    with written_whole(path, len(whole)) as temporary:
        temporary.write_bytes(whole)
        with temporary.open("rb") as file:
            starts = range(0, len(whole) + 1, COMPARED_BYTES)
            is_same = all(
                file.read(COMPARED_BYTES) == whole[at : at + COMPARED_BYTES] for at in starts
            )
        if not is_same:
            raise OSError(
                errno.EIO, "the file reads back differently from what was written; check the disk"
            )
