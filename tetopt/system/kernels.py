"""Compiled kernels: each is compiled once, separately, and receives records by address.

numba recompiles a function inside every function that calls it, and passes a record of thirty
arrays as three hundred numbers. Here a *unit* is compiled on its own, with a signature from its
annotations, and is called through a linker symbol, as C calls a function in another file; a
*record* (a NamedTuple of arrays, numbers and records) is a block of memory that is passed by
address. *Helpers* are plain numba functions that are compiled into the units that use them; Python
calls *entries*; and a parallel loop runs a unit for each number of a range (`run`).

Symbols and addresses use internals of numba (`tetopt.system.kernel_links`). If these fail the test
below, or on request, kernels are plain numba functions with the same signatures that take records
by value: slower, with identical results.

docs/develop/kernels.md gives the gain of each of these.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import threading
import time
import typing
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from types import CellType, FunctionType
from typing import Annotated, Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.extending import overload, typeof_impl
from numpy.typing import NDArray

from tetopt.system.cache import place_cache
from tetopt.system.child import start_child
from tetopt.system.interpreter import python_command, python_environment
from tetopt.system.kernel_cache import (
    IS_PLAIN,
    PLAIN_NOTICE,
    NotKeptWarning,
    checksum,
    njit,
    plain_njit,
    warn,
)
from tetopt.system.kernel_types import by_value, cast, type_of
from tetopt.system.lock import lock_file

# Arrays in the signatures of units and in records, by number of axes; the last axis is contiguous.
Floats1 = Annotated[NDArray[np.float64], types.float64[::1]]
Floats2 = Annotated[NDArray[np.float64], types.float64[:, ::1]]
Floats3 = Annotated[NDArray[np.float64], types.float64[:, :, ::1]]
Floats4 = Annotated[NDArray[np.float64], types.float64[:, :, :, ::1]]
Singles3 = Annotated[NDArray[np.float32], types.float32[:, :, ::1]]
Singles4 = Annotated[NDArray[np.float32], types.float32[:, :, :, ::1]]
Shorts4 = Annotated[NDArray[np.int32], types.int32[:, :, :, ::1]]
Ints1 = Annotated[NDArray[np.int64], types.int64[::1]]
Ints2 = Annotated[NDArray[np.int64], types.int64[:, ::1]]
Ints3 = Annotated[NDArray[np.int64], types.int64[:, :, ::1]]
Ints4 = Annotated[NDArray[np.int64], types.int64[:, :, :, ::1]]
Bools1 = Annotated[NDArray[np.bool_], types.boolean[::1]]
Bools2 = Annotated[NDArray[np.bool_], types.boolean[:, ::1]]
Bools3 = Annotated[NDArray[np.bool_], types.boolean[:, :, ::1]]

# In the cache's folder, shared by all runs of this installation: other installations compile other
# files.
LOCK_NAME = f"compiling-{zlib.crc32(str(Path(__file__).parents[1]).encode()):08x}.lock"
PIECES_PER_THREAD = 8  # pieces of a plain loop, as some take longer than others
# Work for one more thread, about that of 2000 fluxes: waking it for a mesh of a hundred cells costs
# more, and on a busy machine 61 nodes took 20 times as long on two threads as on one.
THREAD_WORK = 2000
POLLED_SECONDS = 0.1  # between polls of compiling processes
LONGEST_WAIT_SECONDS = 600.0  # for another run to compile: all kernels take 145 s on a busy machine
MOST_COMPILING = 4  # processes at most: each imports numba first, 1 s and 200 MB

_LINKING = threading.RLock()  # one Python thread links at a time, and the others call its code
_links: list[Any] = []  # the result of `links`, once it is known


def links() -> Any:
    """Return `kernel_links` if it passes its test, which runs once; otherwise None, and kernels
    are plain numba.
    """
    with _LINKING:
        if not _links:
            _links.append(None)
            if not IS_PLAIN:
                try:
                    _links[0] = import_module("tetopt.system.kernel_links")
                    check_links()
                # any kind: numba's internals may be gone, or behave differently
                except Exception as error:
                    _unlink(error)
    return _links[0]


def _unlink(error: Exception) -> None:
    """Turn all kernels into plain numba functions, as linking fails."""
    _links[:] = [None]
    warn(PLAIN_NOTICE.format(f"{type(error).__name__}: {error}".splitlines()[0]))
    for kernel in ALL_KERNELS:
        for name in ("signature", "dispatcher", "compiled", "type", "symbol", "address", "loop"):
            vars(kernel).pop(name, None)
        kernel.is_linked = False


def pack_record(value: Any) -> Any:
    """Lay out a record for kernels; return any other value, including a laid-out record,
    unchanged.
    """
    if links() is None and hasattr(value, "kept"):  # laid out before a later kernel failed to link
        value = value.kept[0]
    if numba.config.DISABLE_JIT or not (isinstance(value, tuple) and hasattr(value, "_fields")):
        return value
    return (
        cast(value, by_value(type(value)), "argument") if links() is None else links().Packed(value)
    )


ALL_KERNELS: list[Any] = []  # all kernels of the modules imported so far
_LOOPING = threading.Lock()  # held while a loop runs, where numba's threads can serve only one


ALLOCATING_NAMES = frozenset(
    ("empty", "empty_like", "full", "zeros", "ones", "array", "arange", "copy")
)


def _global_values(function: Any) -> list[Any]:
    """Return the global values that a function names."""
    return [function.__globals__.get(name) for name in function.__code__.co_names]


def _counts(function: Callable[..., Any]) -> bool:
    """Return whether numba must count references to arrays in a function: it creates some, or a
    helper returns some.

    Counting is atomic and happens twice per call; it took a third of a sweep and half of a pass of
    flips.
    """
    if ALLOCATING_NAMES.intersection(function.__code__.co_names):
        return True
    inner = [value.py_func for value in _global_values(function) if hasattr(value, "py_func")]
    return any(_returns_arrays(part) for part in [function, *inner])


def _returns_arrays(function: Callable[..., Any]) -> bool:
    result = function.__annotations__.get("return")
    return result not in ("None", "bool", "int", "float", "Any") and not str(result).startswith(
        "tuple"
    )


def _version_function(function: Callable[..., Any], **values: Any) -> Callable[..., Any]:
    """Return a copy of a function that closes over the checksum of all kernels, with its own global
    values.

    numba's cache is keyed by the code and closure of a single function, so it would otherwise
    return a function that was compiled with older versions of others.
    """
    code = function.__code__.replace(co_freevars=("checksum",))
    version = FunctionType(
        code, function.__globals__ | values, function.__name__, None, (CellType(checksum()),)
    )
    version.__qualname__, version.__module__ = function.__qualname__, function.__module__
    return version


class Kernel:
    """A function that numba compiles with a signature from its annotations."""

    type: types.Type  # how other kernels call it

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.__name__, self.__doc__, self.__module__ = (
            function.__name__,
            function.__doc__,
            function.__module__,
        )
        self.room = self.__module__.rpartition(".")[2]
        self.is_linked = False
        ALL_KERNELS.append(self)

    @cached_property
    def signature(self) -> Any:
        """The signature for numba, from the annotations."""
        hints = typing.get_type_hints(self.function, include_extras=True)
        of_record = by_value if links() is None else links().record_type
        result = type_of(hints.pop("return"), of_record)
        return result(*(type_of(hint, of_record) for hint in hints.values()))

    def link(self) -> None:
        """Add its symbol to the linker, after those of the units that it calls."""
        if self.is_linked:
            return
        with _LINKING:
            numba.get_num_threads()  # adds the threads' own functions to the linker
            for unit in units_of(self.function):
                unit.link()
            try:
                self._make_known()
            except Exception as error:  # any kind, as in `links`
                if links() is None:
                    raise
                _unlink(error)
                self.link()
            self.is_linked = True

    def _make_known(self) -> None:
        """Compile it, and add its own symbol to the linker; an entry has none, and Python's
        first call compiles it.
        """

    @cached_property
    def dispatcher(self) -> Any:
        """The numba dispatcher by which Python calls it."""
        # with separate caches: only one has symbols
        compiled_by = plain_njit if links() is None else njit
        return compiled_by(cache=True, error_model="numpy", nogil=True)(
            _version_function(self.function)
        )

    def __call__(self, *values: Any) -> Any:
        """Call it from Python: links the units that it calls, and lays out records."""
        self.link()
        return self.dispatcher(*map(pack_record, values))

    @cached_property
    def compiled(self) -> Any:
        """The dispatcher whose code other kernels or Python call, compiled now or loaded from
        the cache.
        """
        self.dispatcher.compile(self.signature.args)
        return self.dispatcher

    @property
    def was_cached(self) -> bool:
        """True if it was compiled before this process started."""
        return bool(sum(self.compiled.stats.cache_hits.values()) > 0)


class Unit(Kernel):
    """A function compiled on its own, which other kernels call through its symbol. From Python
    it acts as an entry.
    """

    @cached_property
    def symbol(self) -> str:
        """The name of its linker symbol."""
        return f"{self.__module__}.{self.__name__}.{checksum()}"

    @cached_property
    def type(self) -> types.Type:
        """The numba type by which other kernels call it."""
        if links() is None:
            return types.Dispatcher(self.compiled)
        return links().function_type(self.symbol, self.function, self.signature)

    @cached_property
    def compiled(self) -> Any:
        """The dispatcher for callers in machine code only."""
        if links() is None:
            options = {"cache": True, "error_model": "numpy", "nogil": True}
            return plain_njit(self.signature, **options)(_version_function(self.function))
        dispatcher = _machine_code(cache=True, _nrt=_counts(self.function))(
            _version_function(self.function)
        )
        dispatcher.compile(self.signature)
        return dispatcher

    @cached_property
    def address(self) -> int:
        """The address of its code."""
        return links().address_of(self.compiled)

    @cached_property
    def loop(self) -> Any:
        """A plain function that calls it for a record and a range of numbers, and returns how
        many calls fail.
        """
        version = _version_function(_loop, _task=self)
        version.__qualname__ = f"_loop.{self.symbol}"
        signature = types.int64(self.signature.args[0], types.int64, types.int64)
        return plain_njit(signature, cache=True, nogil=True)(version)

    def _make_known(self) -> None:
        if links() is None:
            _ = self.compiled
        else:
            links().add_symbol(self.symbol, self.address)


class Entry(Kernel):
    """A function that Python calls."""

    @cached_property
    def type(self) -> types.Type:
        """The numba type by which other kernels call it."""
        return types.Dispatcher(self.dispatcher)


@typeof_impl.register(Unit)
@typeof_impl.register(Entry)
def _typeof_kernel(kernel: Kernel, _context: Any) -> types.Type:
    return kernel.type


def units_of(function: Callable[..., Any]) -> Iterator[Unit]:
    """Yield the units that a function calls, directly or through its helpers."""
    for part in _parts(function):
        yield from (value for value in _global_values(part) if isinstance(value, Unit))


def _parts(function: Callable[..., Any]) -> list[Any]:
    """Return a function and the helpers that are compiled into it."""
    parts: list[Any] = [function]
    for part in parts:
        for value in _global_values(part):
            is_entry = isinstance(value, Entry)
            if is_entry or hasattr(value, "py_func"):
                inner = value.function if is_entry else value.py_func
                if inner not in parts:
                    parts.append(inner)
    return parts


# Compilation in several processes.


def link(kernels: Sequence[Any], progress: Callable[[str], None] | None = None) -> None:
    """Link kernels and the units that they call; compile those missing from the cache in several
    processes.

    `progress` is called with progress messages if anything has to be compiled.
    """
    if numba.config.DISABLE_JIT:
        return
    say = progress or (lambda words: None)
    order = list(dict.fromkeys(inner for kernel in kernels for inner in _callees_first(kernel)))
    n_ready = _n_kept(order, 0)
    if n_ready < len(order):
        place = place_cache()
        if place.notice is not None:
            warn(place.notice)
        say(f"compiling the kernels, {n_ready + 1} of {len(order)}")
        if place.folder is not None and links() is not None:
            with _only_compiler(place.folder, say) as has_waited:
                if has_waited:
                    n_ready = _n_kept(order, n_ready + 1)
                _compile_apart(order, n_ready + 1, place.folder, say)
    for number, kernel in enumerate(order):
        kernel.link()
        if not kernel.was_cached and number > n_ready:
            say(f"compiling the kernels, {number + 1} of {len(order)}")


def _n_kept(order: Sequence[Any], first: int) -> int:
    """Return the number of kernels before the next one that is neither cached nor compiled;
    compile that one.
    """
    for number, kernel in enumerate(order[first:], start=first):
        # by this process, so that later calls need not look for it
        is_compiled = "compiled" in vars(kernel)
        kernel.link()
        if not (is_compiled or kernel.was_cached):
            return number
    return len(order)


@contextlib.contextmanager
def _only_compiler(folder: Path, say: Callable[[str], None]) -> Iterator[bool]:
    """Wait until no other run compiles into this folder, to avoid double work; return whether
    one did.
    """
    has_waited = False
    try:
        lock = (folder / LOCK_NAME).open("ab")
    except OSError:  # then both runs compile
        yield False
        return
    with lock:
        give_up = time.monotonic() + LONGEST_WAIT_SECONDS
        with contextlib.suppress(OSError):  # a file system without locks
            while time.monotonic() < give_up and not lock_file(lock):
                has_waited = True
                say("waiting for another run, which compiles the kernels")
                time.sleep(POLLED_SECONDS)
        yield has_waited


def roots() -> list[Kernel]:
    """Return the kernels that no other kernel calls, among all modules imported so far."""
    called = {inner for kernel in ALL_KERNELS for inner in units_of(kernel.function)}
    return [kernel for kernel in ALL_KERNELS if kernel not in called]


def _callees_first(kernel: Any) -> Iterator[Any]:
    for inner in units_of(kernel.function):
        yield from _callees_first(inner)
    yield kernel


def _compile_apart(
    order: Sequence[Any], first: int, folder: Path, say: Callable[[str], None]
) -> None:
    """Compile kernels from the `first` into the cache, in one process per core and at most
    `MOST_COMPILING`.
    """
    kernels = order[first:]
    n_processes = min(MOST_COMPILING, os.cpu_count() or 1)
    if n_processes < 2 or not kernels or not sys.executable:
        return
    sizes = {
        kernel: sum(len(part.__code__.co_code) for part in _parts(kernel.function))
        for kernel in kernels
    }
    names = [
        f"{kernel.__module__}:{kernel.__name__}"
        for kernel in sorted(kernels, key=sizes.__getitem__, reverse=True)
    ]
    with contextlib.ExitStack() as stack:
        try:
            claims = stack.enter_context(tempfile.TemporaryDirectory(prefix="tetopt-", dir=folder))
        except OSError:  # then the caller compiles everything
            return
        # Only this process reacts to Ctrl-C, and then ends the others.
        code = (
            "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "
            f"from tetopt.system.kernels import compile_named; compile_named({names!r}, "
            f"{claims!r}, {os.getpid()})"
        )
        command, environment = python_command("-c", code), python_environment()
        processes = [
            stack.enter_context(start_child(command, environment)) for _ in range(n_processes)
        ]
        while any(process.poll() is None for process in processes):
            say(f"compiling the kernels, {first + len(os.listdir(claims))} of {len(order)}")
            time.sleep(POLLED_SECONDS)


def compile_named(names: Sequence[str], claims: str, parent: int) -> None:
    """Compile kernels, given as `module:name`, into numba's cache unless another process has
    claimed them.

    The symbols that they call are placeholders here, so none may be called in this process. It ends
    when `parent` ends, or when code cannot be kept; `parent` then compiles the rest and warns the
    user.
    """
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", NotKeptWarning)
    chosen = [getattr(import_module(name.split(":")[0]), name.split(":")[1]) for name in names]
    numba.get_num_threads()
    for kernel in ALL_KERNELS:
        if isinstance(kernel, Unit):
            links().add_symbol(kernel.symbol, 1)
    for number, kernel in enumerate(chosen):
        if os.getppid() != parent and sys.platform != "win32":  # where a launcher is in between
            return
        with contextlib.suppress(FileExistsError):
            try:
                (Path(claims) / str(number)).touch(exist_ok=False)
                _ = kernel.compiled
            except (NotKeptWarning, FileNotFoundError):
                return


_task: Any = None  # a unit; each compiled function below gets its own, see `_version_function`
_fails: Any = None


def _loop(values: Any, first: int, last: int) -> int:
    n_failed = 0
    for number in range(first, last):
        try:
            _task(values, number)
        except Exception:
            n_failed += 1
    return n_failed


def _run_plain(task: Unit, n: int, values: Any) -> int:
    """Call a unit on Python threads, as numba's own take no records; return how many calls fail."""
    n_threads, loop = numba.get_num_threads(), task.loop
    step = max(1, n // (PIECES_PER_THREAD * n_threads))

    def fraction(thread: int) -> int:
        record = cast(values, task.signature.args[0], task.__name__, thread)
        return sum(
            loop(record, first, min(first + step, n))
            for first in range(thread * step, n, n_threads * step)
        )

    with ThreadPoolExecutor(n_threads) as threads:
        return sum(threads.map(fraction, range(n_threads)))


def _run_linked(task: int, values: int, n: int) -> int:
    taken = np.zeros(1, dtype=np.int64)
    return int(links().run(task, values, n, taken.ctypes.data, numba.get_num_threads()))


def _n_failed(task: Any, n: int, values: Any) -> int:
    if links() is None:
        return _run_plain(task, n, values)
    laid_out = pack_record(values)
    if laid_out.type != task.signature.args[0]:
        raise TypeError(
            f"{task.__name__}: expected a {task.signature.args[0]}, got a {laid_out.type}"
        )
    with _LOOPING if numba.threading_layer() == "workqueue" else contextlib.nullcontext():
        return _run_linked(task.address, laid_out.address, n)


def run(task: Any, n: int, values: Any, work: int = sys.maxsize) -> None:
    """Call a unit `task(values, number)` for all numbers below n, on numba's threads, at most one
    per `THREAD_WORK` of the `work`.

    `values` is a record. The calls must be independent. If one fails, MemoryError is raised, the
    only error of units.
    """
    if numba.config.DISABLE_JIT:
        for number in range(n):
            task(values, number)
        return
    task.link()
    threads = numba.get_num_threads()
    numba.set_num_threads(min(threads, 1 + work // THREAD_WORK))
    try:
        n_failed = _n_failed(task, n, values)
    finally:
        numba.set_num_threads(threads)
    if n_failed > 0:
        raise MemoryError(
            f"{task.__name__}: {n_failed} of {n} calls could not allocate their arrays"
        )


# For functions that Python does not call.
_machine_code = partial(njit, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


def unit(function: Callable[..., Any]) -> Any:
    """Compile a function on its own; its annotations are its signature."""
    return function if numba.config.DISABLE_JIT else Unit(function)


def entry(function: Callable[..., Any]) -> Any:
    """Compile a function that Python calls."""
    return function if numba.config.DISABLE_JIT else Entry(function)


def helper(function: Callable[..., Any]) -> Any:
    """Compile a function into each function that calls it."""
    return _machine_code(_nrt=_counts(function))(function)


# a helper that numba inlines itself, before LLVM
inlined = njit(error_model="numpy", inline="always")


def own(records: Any) -> Any:
    """Return the record of the thread that runs a task, from a list with one per thread."""
    return records[0]


@overload(own, strict=False)  # otherwise annotations count as names of arguments
def _own_compiled(records: Any) -> Any:
    if isinstance(records, types.BaseTuple):  # by value, already the thread's own; see `_run_plain`
        return lambda records: records
    nth = links().nth
    return lambda records: nth(records, numba.get_thread_id())


# Test of the internals of numba.


class _Row(NamedTuple):
    x: Floats1
    factor: float


class _Rows(NamedTuple):
    row: _Row
    length: int


def _multiply(rows: _Rows, number: int) -> None:
    if number < 0:
        raise MemoryError
    factors = np.full(rows.length, rows.row.factor)
    rows.row.x[number] *= factors[number]


def _call(rows: Any, address: int, place: int) -> tuple[bool, bool]:
    _task(rows, 0)
    return _fails(address, place, 1), _fails(address, place, -1)


def check_links() -> None:
    """Compile a unit of nested records that allocates; call it by symbol, by address, and in the
    parallel loop.

    Raises an error of any kind if one of these fails.
    """
    multiplied = Unit(_multiply)
    ALL_KERNELS.remove(multiplied)
    multiplied._make_known()
    called = njit(cache=True)(_version_function(_call, _task=multiplied, _fails=links().fails))
    x = np.ones(3)
    rows = pack_record(_Rows(_Row(x, 2.0), len(x)))
    failures = called(rows, multiplied.address, rows.address)
    n_threads = numba.get_num_threads()
    # OpenMP starts no threads then, which a fork of the user's would not survive
    numba.set_num_threads(1)
    try:
        n_failed = _run_linked(multiplied.address, rows.address, len(x))
    finally:
        numba.set_num_threads(n_threads)
    if failures != (False, True) or n_failed != 0 or x.tolist() != [4.0, 4.0, 2.0]:
        raise RuntimeError(
            f"a unit changed ones to {x}, its failures are {failures} and {n_failed}"
        )
