"""One run at a time in a folder: a lock ends with its process, also one that is killed."""

from __future__ import annotations

import os
import socket
from contextlib import ExitStack
from pathlib import Path
from typing import IO

from tetopt.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def lock(stack: ExitStack, path: Path, is_shared: bool, what: str) -> None:
    """Take the lock of a file, which is made, until the stack is unwound; who has it stands in the file.

    Raises
    ------
    InputError
        Another run has it, which is said of `what`.
    """
    if fcntl is None:
        return
    stream: IO[str] = stack.enter_context(path.open("a+", encoding="utf-8"))
    try:
        fcntl.flock(stream, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.seek(0)
        whose = stream.read(200).strip() or "another process"
        raise InputError(f"{what}: another run writes there ({whose}); wait for its end, or end it") from None
    if not is_shared:
        stream.truncate(0)
        stream.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        stream.flush()
