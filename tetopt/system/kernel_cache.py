"""numba's cache of compiled functions, whose failures never end a run.

A file is read only if it has the checksum that was written with it; otherwise the function is compiled again, as code
from a damaged file would crash the process. A file that another user could have written is not read either: pickles
run code. Code that cannot be written, because the disk is full or the folder is gone, is not kept. In each of these
cases a one-line `RuntimeWarning` is issued once.

This relies on internals of numba. Where numba lacks a name, or on request (`IS_PLAIN`), functions are compiled and
kept only with numba's documented features, in a folder that only this user can open.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import pickle
import warnings
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

try:
    from numba.core.caching import FunctionCache, IndexDataCacheFile
    from numba.core.options import DefaultOptions
except ImportError:  # reported by `MISSING` below
    FunctionCache = IndexDataCacheFile = DefaultOptions = object

from tetopt.system.cache import FILE_MODE, FOLDER_MODE, place_cache, untrusted

INSIDE_OPTIONS = ("_nrt", "forceinline", "no_cfunc_wrapper", "no_cpython_wrapper")
FILE_METHODS = ("_data_path", "_dump", "_load_data", "_load_index", "_open_for_write", "_save_data", "_save_index")
INSIDE = (
    (FunctionCache, ("load_overload", "save_overload")),
    (IndexDataCacheFile, FILE_METHODS),
    (DefaultOptions, INSIDE_OPTIONS),
    (numba.njit(lambda: None), ("_cache",)),
)
MISSING = sorted(name for owner, names in INSIDE for name in names if not hasattr(owner, name))
# True if functions are compiled with documented features of numba only.
IS_PLAIN = bool(MISSING) or os.environ.get("TETOPT_PLAIN_NUMBA") == "1" or bool(numba.config.DISABLE_JIT)
PLAIN_NOTICE = f"kernels take longer to compile: tetopt cannot use the internals of numba {numba.__version__} ({{}})"
NOT_KEPT = "compiled kernels cannot be kept, so later runs compile them again: {}"


@cache
def checksum() -> str:
    """Return the checksum of the sources of all kernels and their constants; code of other sources is not reused."""
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


class DamagedFileError(Exception):
    """A file of the cache is damaged, or is not trusted."""


class SealedFile(IndexDataCacheFile):
    """numba's index of a function's compilations and its code files, each preceded by version and checksum.

    A code file also holds its key, because two processes that write at once may give the same name to different code.
    Missing code is looked up in `shipped`.
    """

    def __init__(self, folder: str, name: str, stamp: Any, shipped: SealedFile | None = None) -> None:
        super().__init__(folder, name, stamp)
        self._shipped = shipped

    def save(self, key: Any, data: Any) -> None:
        """Keep the code compiled for a key."""
        super().save(key, (key, data))

    def load(self, key: Any) -> Any:
        """Return the code compiled for a key, or None."""
        pair = super().load(key)
        if pair is not None and pair[0] == key:
            return pair[1]
        return None if self._shipped is None else self._shipped.load(key)

    def _load_index(self) -> dict[Any, str]:
        try:
            stamp, names = self._unsealed(self._index_path)
        except (FileNotFoundError, DamagedFileError):
            return {}
        return names if stamp == self._source_stamp else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        self._seal(self._index_path, (self._source_stamp, overloads))

    def _load_data(self, name: str) -> Any:
        try:
            return self._unsealed(self._data_path(name))
        except DamagedFileError:
            return None

    def _save_data(self, name: str, data: Any) -> None:
        self._seal(self._data_path(name), data)

    def _seal(self, path: str, data: Any) -> None:
        content = self._dump(data)
        if (words := untrusted(os.lstat(self._cache_path))) is not None:  # the file would not be read
            raise PermissionError(f"{self._cache_path} {words}")
        with self._open_for_write(path) as file:
            os.chmod(file.name, FILE_MODE)
            file.write(b"%s %08x\n" % (self._version.encode(), zlib.crc32(content)) + content)

    def _unsealed(self, path: str) -> Any:
        """Return the content of a file; warn and raise `DamagedFileError` if it is damaged."""
        head, _, content = self._trusted_bytes(path).partition(b"\n")
        version, _, checksum = head.partition(b" ")
        if version == self._version.encode() and checksum == b"%08x" % zlib.crc32(content):
            return pickle.loads(content)
        if not checksum or version == self._version.encode():
            warn(f"recompiling kernels: the cache {self._cache_path} has damaged files")
        raise DamagedFileError(path)

    def _trusted_bytes(self, path: str) -> bytes:
        """Return the bytes of a file; warn and raise `DamagedFileError` if another user could have written it."""
        for name in (path, self._cache_path):
            if (words := untrusted(os.lstat(name))) is not None:
                warn(
                    f"recompiling kernels: another user could have written those in {self._cache_path} "
                    f"({Path(name).name} {words}); remove that folder"
                )
                raise DamagedFileError(path)
        return Path(path).read_bytes()


class SealedCache(FunctionCache):
    """numba's cache of a function, which does without files that it cannot read or write."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        # Bounds checks are part of the compiled code, but not of numba's keys.
        kind = "-sb" if numba.config.BOUNDSCHECK else "-s"
        name, stamp = self._impl.filename_base + kind, self._impl.locator.get_source_stamp()
        # Kernels compiled when the package was installed, for all users or for a read-only container.
        shipped = SealedFile(str(Path(inspect.getfile(function)).parent / "__pycache__"), name, stamp)
        self._cache_file: Any = SealedFile(self._cache_path, name, stamp, shipped)
        with contextlib.suppress(OSError), os.scandir(self._cache_path) as entries:
            if not any(entries):  # numba has just created it, with the user's umask
                os.chmod(self._cache_path, FOLDER_MODE)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code compiled for a signature, or None."""
        try:
            return super().load_overload(sig, target_context)
        except OSError:  # writing either repairs this or issues a warning
            return None
        except (AttributeError, ImportError, TypeError) as error:  # from classes that no longer exist
            warn(f"recompiling kernels: their cache cannot be read: {error}")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code compiled for a signature, if possible."""
        try:
            super().save_overload(sig, data)
        except (AttributeError, OSError, TypeError) as error:
            warn(NOT_KEPT.format(error), NotKeptWarning)


def cache_of(function: Callable[..., Any]) -> Any:
    """Return the cache of a function that numba compiles; None if there is no folder for it."""
    if place_cache().folder is not None:
        try:
            return SealedCache(function)
        except RuntimeError:  # no locator: the folder is gone or no longer writable
            warn("recompiling kernels: the folder of their cache is no longer writable", NotKeptWarning)
        except (AttributeError, TypeError) as error:
            warn(NOT_KEPT.format(error), NotKeptWarning)
    return None


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate as `numba.njit` does; `cache=True` uses this cache."""
    if IS_PLAIN:
        return plain_njit(**options)
    is_kept = options.pop("cache", False)

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if is_kept and (kept := cache_of(function)) is not None:
            dispatcher._cache = kept
        return dispatcher

    return compiled


def plain_njit(*signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate as `numba.njit` does, without undocumented options; `cache=True` uses numba's own cache."""
    known = {name: value for name, value in options.items() if name not in INSIDE_OPTIONS}
    return numba.njit(*signature, **known | {"cache": known.get("cache", False) and has_own_folder()})


@cache
def has_own_folder() -> bool:
    """Point numba's own cache, which trusts its files, to a folder that only this user can open, if possible."""
    place = place_cache().folder
    if place is None or numba.config.DISABLE_JIT:
        return False
    # Its keys include neither the code of other files nor bounds checks.
    folder = place / f"plain-{checksum()}{'-checked' * bool(numba.config.BOUNDSCHECK)}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        status = os.lstat(folder)
        if untrusted(status) is None and (os.name != "posix" or status.st_mode & 0o077 == 0):
            numba.config.CACHE_DIR = str(folder)
            return True
    return False


if MISSING and not numba.config.DISABLE_JIT:
    warn(PLAIN_NOTICE.format(f"no {', '.join(MISSING)}"))
