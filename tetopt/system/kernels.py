"""Compiled kernels: each is compiled once, apart from the others, and records go to them by address.

numba compiles a function again inside of every function that calls it, and passes a record of thirty arrays as three
hundred numbers. Here a *unit* is compiled on its own, with a signature from its annotations, and called through the
linker's symbol, as a function of another file is in C; a *record* (a NamedTuple of arrays, numbers and records) is a
block of memory whose address is passed. Helpers are plain numba functions that go into the units that use them;
*entries* are what Python calls; and a parallel loop is a unit run for each number of a range (`run`).

Symbols and addresses are the inside of numba (`tetopt.system.kernel_links`). Where that fails its test below, or on
request, kernels are plain functions of numba's, of the same signatures, that take records by value: slower, the same
bits.

docs/develop/kernels.md tells what each of these bought.
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

from tetopt.system.budget import address_room
from tetopt.system.cache import place_cache
from tetopt.system.child import started
from tetopt.system.interpreter import python_command, python_environment
from tetopt.system.kernel_cache import IS_PLAIN, PLAIN_NOTICE, NotKeptWarning, checksum, njit, plain_njit, warn
from tetopt.system.kernel_types import by_value, cast, type_of
from tetopt.system.lock import lock_file

# Arrays in the signatures of units and in records: of so many axes, the last one contiguous.
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

UNIT_BYTES = 1 << 25  # at once for all arrays that units make: a few KB each on each thread
# In the cache's folder, of all runs of this package: those of another one compile other files.
LOCK_NAME = f"compiling-{zlib.crc32(str(Path(__file__).parents[1]).encode()):08x}.lock"
PIECES_PER_THREAD = 8  # of a plain loop: some take longer than others
POLLED_SECONDS = 0.1  # between looks at processes that compile
LONGEST_WAIT_SECONDS = 600.0  # for another run's: all kernels take 145 s on a busy machine
MOST_COMPILING = 4  # processes at most: each loads numba first, 1 s and 200 MB


_LINKING = threading.RLock()  # of Python's threads one links at a time: the first's code is what others call
_links: list[Any] = []  # what `links` returns, once it is known


def links() -> Any:
    """Return `kernel_links` if it works, which is tested once; else None: kernels are plain `numba.njit`."""
    with _LINKING:
        if not _links:
            _links.append(None)
            if not IS_PLAIN:
                try:
                    _links[0] = import_module("tetopt.system.kernel_links")
                    check_links()
                except Exception as error:  # of any kind: what is imported may be gone, or do something else
                    _links[0] = None
                    warn(PLAIN_NOTICE.format(f"{type(error).__name__}: {error}".splitlines()[0]))
    return _links[0]


def packed(value: Any) -> Any:
    """A record laid out for kernels; anything else as it is, one that is laid out already among it."""
    if numba.config.DISABLE_JIT or not (isinstance(value, tuple) and hasattr(value, "_fields")):
        return value
    return cast(value, by_value(type(value)), "argument") if links() is None else links().Packed(value)


ALL_KERNELS: list[Any] = []  # all that were defined, in the modules imported so far
_LOOPING = threading.Lock()  # held by the one that runs a loop, where numba's threads can serve only one


ALLOCATING_NAMES = frozenset(("empty", "empty_like", "full", "zeros", "ones", "array", "arange", "copy"))


def _named(function: Any) -> list[Any]:
    """The global values that a function names."""
    return [function.__globals__.get(name) for name in function.__code__.co_names]


def _counts(function: Callable[..., Any]) -> bool:
    """Whether numba has to count references to arrays in a function: it makes some, or gets some from a helper.

    Counting is atomic, up and down at every call, and was a third of a sweep and half of a pass of flips.
    """
    if ALLOCATING_NAMES.intersection(function.__code__.co_names):
        return True
    inner = [value.py_func for value in _named(function) if hasattr(value, "py_func")]
    return any(_returns_arrays(part) for part in [function, *inner])


def _returns_arrays(function: Callable[..., Any]) -> bool:
    result = function.__annotations__.get("return")
    return result not in ("None", "bool", "int", "float", "Any") and not str(result).startswith("tuple")


def _versioned(function: Callable[..., Any], **values: Any) -> Callable[..., Any]:
    """A function for numba to compile that closes over the checksum of all kernels, with global values of its own.

    numba's cache is keyed by the code of one function and what that closes over, so that it would return a function
    compiled with others as they were before.
    """
    code = function.__code__.replace(co_freevars=("checksum",))
    version = FunctionType(code, function.__globals__ | values, function.__name__, None, (CellType(checksum()),))
    version.__qualname__, version.__module__ = function.__qualname__, function.__module__
    return version


class Kernel:
    """A function that numba compiles, with a signature from its annotations."""

    type: types.Type  # how other kernels call it

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.__name__, self.__doc__, self.__module__ = function.__name__, function.__doc__, function.__module__
        self.room = self.__module__.rpartition(".")[2]
        self.is_linked = False
        ALL_KERNELS.append(self)

    @cached_property
    def signature(self) -> Any:
        """numba's, of the annotations."""
        hints = typing.get_type_hints(self.function, include_extras=True)
        of_record = by_value if links() is None else links().record_type
        result = type_of(hints.pop("return"), of_record)
        return result(*(type_of(hint, of_record) for hint in hints.values()))

    def link(self) -> None:
        """Make its symbol known, and those of what it calls before."""
        if self.is_linked:
            return
        with _LINKING:
            numba.get_num_threads()  # the threads' own functions are known to the linker from then on
            for unit in units_of(self.function):
                unit.link()
            self._make_known()
            self.is_linked = True

    def _make_known(self) -> None:
        """Let the linker know its own symbol; an entry has none."""

    @cached_property
    def dispatcher(self) -> Any:
        """How Python calls it: numba's."""
        compiled_by = plain_njit if links() is None else njit  # their caches are apart: only one has symbols
        return compiled_by(cache=True, error_model="numpy")(_versioned(self.function))

    def __call__(self, *values: Any) -> Any:
        """Call it from Python: records are laid out for it, and the units that it calls are linked before."""
        self.link()
        _check_room()
        return self.dispatcher(*map(packed, values))

    @cached_property
    def compiled(self) -> Any:
        """The dispatcher whose code other kernels or Python call; compiled now, or taken from the cache."""
        self.dispatcher.compile(self.signature.args)
        return self.dispatcher

    @property
    def was_cached(self) -> bool:
        """Whether it was compiled before this process."""
        return bool(sum(self.compiled.stats.cache_hits.values()) > 0)


class Unit(Kernel):
    """A function compiled on its own, called by other kernels through its symbol. Called from Python it is an entry."""

    @cached_property
    def symbol(self) -> str:
        """Its name for the linker."""
        return f"{self.__module__}.{self.__name__}.{checksum()}"

    @cached_property
    def type(self) -> types.Type:
        """How other kernels call it."""
        if links() is None:
            return types.Dispatcher(self.compiled)
        return links().function_type(self.symbol, self.function, self.signature)

    @cached_property
    def compiled(self) -> Any:
        """The same for callers of machine code only."""
        if links() is None:
            options = {"cache": True, "error_model": "numpy", "nogil": True}
            return plain_njit(self.signature, **options)(_versioned(self.function))
        dispatcher = _machine_code(cache=True, _nrt=_counts(self.function))(_versioned(self.function))
        dispatcher.compile(self.signature)
        return dispatcher

    @cached_property
    def address(self) -> int:
        """Where it is in memory."""
        return links().address_of(self.compiled)

    @cached_property
    def loop(self) -> Any:
        """A plain function that calls it for a record and the numbers from one up to another: how many calls fail."""
        version = _versioned(_loop, _task=self)
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
        """How other kernels call it."""
        return types.Dispatcher(self.dispatcher)


@typeof_impl.register(Unit)
@typeof_impl.register(Entry)
def _typeof_kernel(kernel: Kernel, _context: Any) -> types.Type:
    return kernel.type


def units_of(function: Callable[..., Any]) -> Iterator[Unit]:
    """The units that a function calls, itself or by helpers that go into it."""
    for part in _parts(function):
        yield from (value for value in _named(part) if isinstance(value, Unit))


def _parts(function: Callable[..., Any]) -> list[Any]:
    """A function and the helpers that go into it."""
    parts: list[Any] = [function]
    for part in parts:
        for value in _named(part):
            is_entry = isinstance(value, Entry)
            if is_entry or hasattr(value, "py_func"):
                inner = value.function if is_entry else value.py_func
                if inner not in parts:
                    parts.append(inner)
    return parts


def _check_room() -> None:
    """MemoryError where a limit leaves too little for the arrays that units make, which are all small."""
    room = address_room()
    if room is not None and room < UNIT_BYTES:
        raise MemoryError(f"{room} bytes are left for kernels, which need {UNIT_BYTES}")


# Compiling in several processes.


def link(kernels: Sequence[Any], progress: Callable[[str], None] | None = None) -> None:
    """Link kernels and all that they call; what the cache does not hold is compiled in several processes.

    `progress` is called now and then with what is going on in words, if anything has to be compiled.
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
                _compile_apart(order[n_ready + 1 :], place.folder, say)
    for number, kernel in enumerate(order):
        kernel.link()
        if not kernel.was_cached and number > n_ready:
            say(f"compiling the kernels, {number + 1} of {len(order)}")


def _n_kept(order: Sequence[Any], first: int) -> int:
    """How many kernels from the first on need no compiling, up to the next that does, which is compiled by this."""
    for number, kernel in enumerate(order[first:], start=first):
        kernel.link()
        if not kernel.was_cached:
            return number
    return len(order)


@contextlib.contextmanager
def _only_compiler(folder: Path, say: Callable[[str], None]) -> Iterator[bool]:
    """Whether another run was compiling into this folder, for whose end this waits: not everything is done twice."""
    has_waited = False
    try:
        lock = (folder / LOCK_NAME).open("ab")
    except OSError:  # then both compile
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
    """The kernels that no other calls: those of all modules imported so far."""
    called = {inner for kernel in ALL_KERNELS for inner in units_of(kernel.function)}
    return [kernel for kernel in ALL_KERNELS if kernel not in called]


def _callees_first(kernel: Any) -> Iterator[Any]:
    for inner in units_of(kernel.function):
        yield from _callees_first(inner)
    yield kernel


def _compile_apart(kernels: Sequence[Any], folder: Path, say: Callable[[str], None]) -> None:
    """Compile kernels into the cache in as many processes as there are cores, up to `MOST_COMPILING`."""
    n_processes = min(MOST_COMPILING, os.cpu_count() or 1)
    if n_processes < 2 or not kernels or not sys.executable:
        return
    sizes = {kernel: sum(len(part.__code__.co_code) for part in _parts(kernel.function)) for kernel in kernels}
    names = [
        f"{kernel.__module__}:{kernel.__name__}" for kernel in sorted(kernels, key=sizes.__getitem__, reverse=True)
    ]
    with contextlib.ExitStack() as stack:
        try:
            claims = stack.enter_context(tempfile.TemporaryDirectory(prefix="tetopt-", dir=folder))
        except OSError:  # what cannot be shared is compiled by the caller
            return
        # Ctrl-C is for this process, which then ends the others.
        code = (
            "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "
            f"from tetopt.system.kernels import compile_named; compile_named({names!r}, {claims!r}, {os.getpid()})"
        )
        command, environment = python_command("-c", code), python_environment()
        processes = [stack.enter_context(started(command, environment)) for _ in range(n_processes)]
        while any(process.poll() is None for process in processes):
            say(f"compiling the kernels, {len(os.listdir(claims))} of {len(kernels)}")
            time.sleep(POLLED_SECONDS)


def compile_named(names: Sequence[str], claims: str, parent: int) -> None:
    """Compile kernels, `module:name` each, into numba's cache, unless another process has claimed them.

    They know only the names of what they call, so that none may be called in this process. It ends when `parent` has,
    or when nothing can be kept for that; the user is told by `parent`, which meets what is left.
    """
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", NotKeptWarning)
    chosen = [getattr(import_module(name.split(":")[0]), name.split(":")[1]) for name in names]
    numba.get_num_threads()
    for kernel in ALL_KERNELS:
        if isinstance(kernel, Unit):
            links().add_symbol(kernel.symbol, 1)
    for number, kernel in enumerate(chosen):
        if os.getppid() != parent and sys.platform != "win32":  # there a launcher stands between
            return
        with contextlib.suppress(FileExistsError):
            try:
                (Path(claims) / str(number)).touch(exist_ok=False)
                _ = kernel.compiled
            except (NotKeptWarning, FileNotFoundError):
                return


_task: Any = None  # a unit, of each function below that is compiled its own; see `_versioned`
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
    """How many calls of a unit fail, on threads of Python's: numba's own take no records."""
    n_threads, loop = numba.get_num_threads(), task.loop
    step = max(1, n // (PIECES_PER_THREAD * n_threads))

    def fraction(thread: int) -> int:
        record = cast(values, task.signature.args[0], task.__name__, thread)
        return sum(loop(record, first, min(first + step, n)) for first in range(thread * step, n, n_threads * step))

    with ThreadPoolExecutor(n_threads) as threads:
        return sum(threads.map(fraction, range(n_threads)))


def run(task: Any, n: int, values: Any) -> None:
    """Call a unit `task(values, number)` for all numbers up to n, on as many threads as numba is set to.

    `values` is a record. The calls must not depend on one another. MemoryError where one fails: units raise no other.
    """
    if numba.config.DISABLE_JIT:
        for number in range(n):
            task(values, number)
        return
    task.link()
    _check_room()
    if links() is None:
        n_failed = _run_plain(task, n, values)
    else:
        laid_out = packed(values)
        if laid_out.type != task.signature.args[0]:
            raise TypeError(f"{task.__name__}: expected a {task.signature.args[0]}, got a {laid_out.type}")
        with _LOOPING if numba.threading_layer() == "workqueue" else contextlib.nullcontext():
            n_failed = links().run(task.address, laid_out.address, n)
    if n_failed > 0:
        raise MemoryError(f"{task.__name__}: {n_failed} of {n} calls found no memory for their arrays")


# Of functions that Python does not call.
_machine_code = partial(njit, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


def unit(function: Callable[..., Any]) -> Any:
    """Compile a function on its own; its annotations are its signature."""
    return function if numba.config.DISABLE_JIT else Unit(function)


def entry(function: Callable[..., Any]) -> Any:
    """Compile a function that Python calls."""
    return function if numba.config.DISABLE_JIT else Entry(function)


def helper(function: Callable[..., Any]) -> Any:
    """What goes into the functions that call it."""
    return _machine_code(_nrt=_counts(function))(function)


inlined = njit(error_model="numpy", inline="always")  # likewise, as numba reads it, before LLVM does


def own(records: Any) -> Any:
    """The record of the thread that runs a task, of a list with one for each."""
    return records[0]


@overload(own, strict=False)  # else annotations count as names of arguments
def _own_compiled(records: Any) -> Any:
    if isinstance(records, types.BaseTuple):  # by value, of the thread alone; see `_run_plain`
        return lambda records: records
    nth = links().nth
    return lambda records: nth(records, numba.get_thread_id())


# Whether the inside of numba does what it is used for.


class _Row(NamedTuple):
    x: Floats1


def _double(row: _Row, number: int) -> None:
    if number < 0:
        raise MemoryError
    row.x[number] *= 2.0


def _double_both(row: Any, address: int, place: int) -> tuple[bool, bool]:
    _task(row, 0)
    return _fails(address, place, 1), _fails(address, place, -1)


def check_links() -> None:
    """Compile a unit and call it by its symbol and its address; an error of any kind if that fails."""
    doubled = Unit(_double)
    ALL_KERNELS.remove(doubled)
    doubled._make_known()
    both = njit(cache=True)(_versioned(_double_both, _task=doubled, _fails=links().fails))
    row = packed(_Row(np.ones(2)))
    failures = both(row, doubled.address, row.address)
    if failures != (False, True) or list(row.kept[0].x) != [2.0, 2.0]:
        raise RuntimeError(f"a unit doubled ones to {row.kept[0].x}, its failures are {failures}")
