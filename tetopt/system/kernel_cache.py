"""numba's cache of compiled functions, in a folder of their own sources, where only this user may
write.

Code that cannot be read is compiled again, and code that cannot be written, because the disk is
full or the folder is gone, is not kept; in both cases a one-line `RuntimeWarning` is issued once.

This relies on internals of numba. Where numba lacks a name, or on request (`IS_PLAIN`), functions
are compiled and kept only with numba's documented features.
"""

from __future__ import annotations

import contextlib
import os
import warnings
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numba

try:
    from numba.core.caching import FunctionCache
    from numba.core.options import DefaultOptions
except ImportError:  # reported by `MISSING` below
    FunctionCache = DefaultOptions = object

from tetopt.system.cache import own_folder

INSIDE_OPTIONS = ("_nrt", "forceinline", "no_cfunc_wrapper", "no_cpython_wrapper")
INSIDE = (
    (FunctionCache, ("flush", "load_overload", "save_overload")),
    (DefaultOptions, INSIDE_OPTIONS),
    (numba.njit(lambda: None), ("_cache",)),
)
MISSING = sorted(name for owner, names in INSIDE for name in names if not hasattr(owner, name))
# True if functions are compiled with documented features of numba only.
IS_PLAIN = (
    bool(MISSING) or os.environ.get("TETOPT_PLAIN_NUMBA") == "1" or bool(numba.config.DISABLE_JIT)
)
PLAIN_NOTICE = (
    "kernels take longer to compile: tetopt cannot use the internals of numba "
    f"{numba.__version__} ({{}})"
)
NOT_KEPT = "compiled kernels cannot be kept, so later runs compile them again: {}"


@cache
def checksum() -> str:
    """Return the checksum of the sources of all kernels and their constants; code of other
    sources is not reused.
    """
    folder, total = Path(__file__).parents[1], 0
    patterns = [
        "system/kernel*.py",
        *(f"{room}/*.py" for room in ("geometry", "energy", "engine", "start", "contents")),
    ]
    for path in sorted(path for pattern in patterns for path in folder.glob(pattern)):
        total = zlib.crc32(path.read_bytes(), total)
    return f"{total:08x}"


class NotKeptWarning(RuntimeWarning):
    """Compiled code cannot be written for later runs."""


@cache  # once each
def warn(notice: str, kind: type[RuntimeWarning] = RuntimeWarning) -> None:
    """Warn of a failure of the cache, once per process."""
    warnings.warn(notice, kind, stacklevel=3)


class KeptCache(FunctionCache):
    """numba's cache of a function, which does without files that it cannot read or write."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code compiled for a signature, or None."""
        try:
            return super().load_overload(sig, target_context)
        except OSError:  # writing either repairs this or issues a warning
            return None
        except Exception as error:  # of any kind, from pickle
            warn(
                f"recompiling kernels: the cache {self.cache_path} has damaged files "
                f"({type(error).__name__})"
            )
            with contextlib.suppress(OSError):  # as above
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code compiled for a signature, if possible."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            warn(NOT_KEPT.format(error), NotKeptWarning)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate as `numba.njit` does; `cache=True` keeps the code in the folder of this version
    of all kernels.
    """
    if IS_PLAIN:
        return plain_njit(**options)
    is_kept = options.pop("cache", False)

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if is_kept:
            with _keep_in(_own_folder("linked")) as is_there:
                try:
                    dispatcher._cache = KeptCache(function) if is_there else dispatcher._cache
                # no locator: the folder is gone or no longer writable
                except RuntimeError as error:
                    warn(NOT_KEPT.format(error), NotKeptWarning)
        return dispatcher

    return compiled


def plain_njit(*signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate as `njit` does, without undocumented options and with numba's own cache."""
    known = {name: value for name, value in options.items() if name not in INSIDE_OPTIONS}

    def compiled(function: Callable[..., Any]) -> Any:
        with _keep_in(_own_folder("plain") if known.get("cache") else None) as is_there:
            return numba.njit(*signature, **known | {"cache": is_there})(function)

    return compiled


@contextlib.contextmanager
def _keep_in(folder: Path | None) -> Iterator[bool]:
    """Have numba keep the functions that are decorated within the block in a folder; give
    whether there is one.
    """
    before = numba.config.CACHE_DIR
    if folder is not None:
        numba.config.CACHE_DIR = str(folder)
    try:
        yield folder is not None
    finally:
        numba.config.CACHE_DIR = before


@cache
def _own_folder(kind: str) -> Path | None:
    """Return the folder of the code of these sources, "linked" or "plain"; None without one.

    numba's keys include neither the code of other files nor bounds checks.
    """
    try:
        return own_folder(f"{kind}-{checksum()}{'-checked' * bool(numba.config.BOUNDSCHECK)}")
    except OSError as error:
        warn(NOT_KEPT.format(error), NotKeptWarning)
        return None


if MISSING and not numba.config.DISABLE_JIT:
    warn(PLAIN_NOTICE.format(f"no {', '.join(MISSING)}"))
