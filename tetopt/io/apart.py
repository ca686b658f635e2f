"""Reading untrusted files in a separate process, by compiled libraries that damaged files can
crash.

The child is ``python -P -m tetopt.io.apart``: it gets its job by standard input and returns arrays
by standard output, as a line of JSON and their bytes, so that nothing is executed here (no pickle).
Its memory is limited (RLIMIT_AS), so that excessive sizes in a header are rejected and not
allocated; its time is limited, too. It costs a third of a second, most of it for loading the
library, which the parent then need not load.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.volumes import collect_notes, note
from tetopt.system.arrays import Json
from tetopt.system.budget import address_bytes
from tetopt.system.child import limit_self, signal_words, start_child
from tetopt.system.interpreter import python_command, python_environment

# of memory for any file, after loading libraries: their buffers and small files
LEAST_BYTES = 2**31
# of additional memory per byte of the file: text grows eightfold, zlib on meshes tenfold
BYTES_A_BYTE = 64
# of memory per byte of voxels by the header: copies of the library, numpy and reordering
BYTES_A_VALUE_BYTE = 4
LEAST_SECONDS = 60.0  # for any file, also on a busy machine
SECONDS_A_BYTE = 1e-6  # 1 MB/s, a twentieth of the speed for the slowest of these files
ARRAY_MARK = "\0array"  # a name that no file contains
DEFLATE_RATIO = 1032  # zlib's maximum compression: a header that declares more is wrong


def read_apart(
    read: Callable[..., Any],
    path: Path,
    *rest: Any,
    size: int | None = None,
    value_bytes: int = 0,
    library: str,
) -> Any:
    """Call ``read(str(path), *rest)`` in a child process.

    Parameters
    ----------
    read : function
        A function of a module. Returns numbers, texts, None, arrays of numbers or texts, and lists,
        tuples and dicts of these; tuples come back as lists.
    path : Path
        The file or folder.
    *rest
        Values that JSON supports.
    size : int, optional
        Number of bytes to read, which determines the limits on memory and time; by default that of
        the file.
    value_bytes : int
        Size of the values by the header, checked by the caller, if known.
    library : str
        Name of the library that reads it, for the message.

    Raises
    ------
    InputError
        `read` raised it; or the child crashed, exceeded a limit, or raised another error.
    """
    size = path.stat().st_size if size is None else size
    most_bytes = LEAST_BYTES + BYTES_A_BYTE * size + BYTES_A_VALUE_BYTE * value_bytes
    seconds = LEAST_SECONDS + SECONDS_A_BYTE * (size + value_bytes)
    name = f"{read.__module__}:{read.__qualname__}"
    job = {
        "read": name,
        "path": str(path),
        "rest": rest,
        "bytes": most_bytes,
        "seconds": int(seconds),
    }
    deadline = time.monotonic() + seconds
    answer, code = _of_child(job, seconds)
    if answer is None:
        if time.monotonic() >= deadline or code == -getattr(signal, "SIGXCPU", 0):
            raise InputError(
                f"{library} did not read it within {seconds:.0f} s; it may be damaged or malicious"
            )
        ending = (signal_words(code) or f"exit code {code}").rpartition(", ")[2]
        raise InputError(
            f"{library} crashed on this file ({ending}; memory limit {most_bytes / 1e9:.1f} GB); "
            "the file is damaged: copy or export it again"
        )
    note(*answer.get("notes", ()))
    if "refused" in answer:
        raise InputError(answer["refused"])
    return answer["value"]


def _of_child(job: Json, seconds: float) -> tuple[Json | None, int]:
    """Return the answer of a child, None if it is incomplete, and its exit code; kill it after
    some seconds.
    """
    with start_child(
        python_command("-m", "tetopt.io.apart"),
        python_environment(),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        timer = threading.Timer(seconds, child.kill)
        timer.start()
        with contextlib.closing(child.stdout), contextlib.ExitStack() as stack:
            stack.callback(timer.cancel)
            with contextlib.suppress(BrokenPipeError):  # it ended early; its exit code tells why
                child.stdin.write(json.dumps(job).encode())
                child.stdin.close()
            return _receive_answer(child.stdout), child.wait()


# The answer: one line of JSON, followed by the arrays that it has marks for, in order.


def _sent(stream: IO[bytes], answer: Json) -> None:
    arrays: list[NDArray] = []

    def marked(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(value).__name__} cannot be sent")
        arrays.append(value)
        return {ARRAY_MARK: True}

    stream.write(json.dumps(answer, default=marked).encode() + b"\n")
    for each in arrays:
        np.lib.format.write_array(SimpleNamespace(write=stream.write), each, allow_pickle=False)
    stream.flush()


def _receive_answer(stream: IO[bytes]) -> Json | None:
    """Return the child's answer; None if it is incomplete."""
    line = stream.readline()
    pipe = SimpleNamespace(read=stream.read)

    def unmarked(table: Json) -> Any:
        if table.get(ARRAY_MARK) is not True:
            return table
        return np.lib.format.read_array(pipe, allow_pickle=False)

    if not line.endswith(b"\n"):
        return None
    try:
        return json.loads(line, object_hook=unmarked)
    except ValueError:  # the pipe ends within an array
        return None


# In the child


def _answer(job: Json) -> Json:
    """Read within the limits of the job; return the value, or why the file is refused."""
    module, _, name = job["read"].partition(":")
    try:
        read = getattr(importlib.import_module(module), name)
        limit_self("RLIMIT_AS", address_bytes() + job["bytes"])
        limit_self("RLIMIT_CPU", job["seconds"])
        limit_self("RLIMIT_CORE", 0)  # no core file with a patient's scan
        with collect_notes() as notes:
            value = read(job["path"], *job["rest"])
        return {"value": value, "notes": notes}
    except InputError as error:
        return {"refused": str(error)}
    except MemoryError:
        return {
            "refused": f"reading it needs more than {job['bytes'] / 1e9:.1f} GB of memory; is it "
            "damaged?"
        }
    except Exception as error:  # libraries raise any error on damaged files
        words = " ".join(str(error).split())
        return {
            "refused": f"truncated or damaged; copy it again ({type(error).__name__}: "
            f"{words[:200]})"
        }


def main() -> None:
    """Do the job given by standard input."""
    stream = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # libraries may write anything there
    job = json.loads(sys.stdin.buffer.read())
    answer = _answer(job)
    with contextlib.suppress(BrokenPipeError):  # the parent has ended
        _sent(stream, answer)
        stream.close()
    os._exit(0)  # skips the clean-up of a library whose memory the file may have damaged


if __name__ == "__main__":
    main()
