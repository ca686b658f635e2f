"""Compiled kernels: each is compiled once, apart from the others, and records go to them by address.

numba compiles a function again inside of every function that calls it, and passes a record of thirty arrays as three
hundred numbers. Here a *unit* is compiled on its own, with a signature from its annotations, and called through the
linker's symbol, as a function of another file is in C; a *record* (a NamedTuple of arrays, numbers and records) is a
block of memory whose address is passed. Helpers are plain numba functions that go into the units that use them;
*entries* are what Python calls; and a parallel loop is a unit run for each number of a range (`run`).

docs/develop/kernels.md tells what each of these bought.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import subprocess
import sys
import tempfile
import threading
import time
import typing
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from functools import cache, cached_property, partial
from importlib import import_module
from pathlib import Path
from types import CellType, FunctionType
from typing import Annotated, Any

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.core import cgutils
from numba.core.datamodel.models import OpaqueModel
from numba.core.extending import register_model, typeof_impl, unbox
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr, make_intrinsic_template
from numba.extending import NativeValue, intrinsic
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

from tetopt.budget import address_room
from tetopt.cache import place_cache
from tetopt.interpreter import python_command, python_environment
from tetopt.kernel_cache import NotKeptWarning, njit, warn

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

SCALAR_TYPES = {int: types.int64, float: types.float64, bool: types.boolean, type(None): types.void}
UNIT_BYTES = 1 << 25  # at once for all arrays that units make: a few KB each on each thread
# In the cache's folder, of all runs of this package: those of another one compile other files.
LOCK_NAME = f"compiling-{zlib.crc32(str(Path(__file__).parent).encode()):08x}.lock"
POLLED_SECONDS = 0.1  # between looks at processes that compile
LONGEST_WAIT_SECONDS = 600.0  # for another run's: all kernels take 145 s on a busy machine
MOST_COMPILING = 4  # processes at most: each loads numba first, 1 s and 200 MB
WORD_BYTES = 8  # of a number, an address, or a length in a record's memory


@cache
def checksum() -> str:
    """Of the sources of all kernels and of their constants: what is compiled of others is not taken from the cache."""
    folder, total = Path(__file__).parent, 0
    for room in ("geometry", "energy", "engine", "start", "target"):
        for path in sorted((folder / room).glob("*.py")):
            total = zlib.crc32(path.read_bytes(), total)
    return f"{zlib.crc32(Path(__file__).read_bytes(), total):08x}"


# Records.


class RecordType(types.Type):
    """What numba knows of a NamedTuple whose address it gets."""

    def __init__(self, record: type) -> None:
        self.record = record
        self.fields = {name: type_of(hint) for name, hint in typing.get_type_hints(record, include_extras=True).items()}
        self.offsets: dict[str, int] = {}
        self.n_words = 0
        for name, field in self.fields.items():
            self.offsets[name] = self.n_words
            self.n_words += 1 + 2 * field.ndim if isinstance(field, types.Array) else 1
        super().__init__(f"{record.__module__}.{record.__qualname__}-{checksum()}")

    def __reduce__(self) -> tuple[Any, ...]:
        """In the keys of numba's cache, by name: the record of another version may be gone."""
        return _type_of_name, (self.record.__module__, self.record.__qualname__, checksum())


def _type_of_name(module: str, name: str, version: str) -> types.Type:
    record = getattr(sys.modules.get(module), name, None)
    is_same = version == checksum() and record is not None
    return record_type(record) if is_same else types.Opaque(f"{module}.{name}-{version}")


@cache
def record_type(record: Any) -> RecordType:
    """The one type of a NamedTuple."""
    return RecordType(record)


def type_of(hint: Any) -> types.Type:
    """numba's type of an annotation: a number, one of the arrays above, a record, or a tuple of these."""
    if typing.get_origin(hint) is Annotated:
        return typing.get_args(hint)[1]
    if typing.get_origin(hint) is tuple:
        return types.BaseTuple.from_types([type_of(part) for part in typing.get_args(hint)])
    if typing.get_origin(hint) is list:  # of records, of which kernels get the first; see `nth`
        return record_type(typing.get_args(hint)[0])
    return SCALAR_TYPES[hint] if hint in SCALAR_TYPES else record_type(hint)


def by_value(record: type) -> types.NamedTuple:
    """numba's own type of a NamedTuple, which kernels make and pass on in all its numbers."""
    hints = typing.get_type_hints(record, include_extras=True)
    return types.NamedTuple([type_of(hint) for hint in hints.values()], record)


register_model(RecordType)(OpaqueModel)


@intrinsic
def _nth(_context: Any, records: Any, number: Any) -> Any:
    def generate(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        step = ir.Constant(ir.IntType(64), WORD_BYTES * signature.return_type.n_words)
        return builder.gep(arguments[0], [builder.mul(arguments[1], step)])

    return records(records, types.int64), generate


def _entry_of(records: list[Any], number: int) -> Any:
    return records[number]


# The record of that number in a list of them, of which kernels have the address of the first.
nth = _entry_of if numba.config.DISABLE_JIT else _nth


@infer_getattr
class _RecordFields(AttributeTemplate):
    key = RecordType

    def generic_resolve(self, record: RecordType, name: str) -> types.Type | None:
        return record.fields.get(name)


@lower_getattr_generic(RecordType)
def _load_field(context: Any, builder: Any, record: RecordType, value: Any, name: str) -> Any:
    """A field of a record. Its memory never changes while kernels run, which LLVM is told: loads leave the loops."""
    field, first = record.fields[name], record.offsets[name]
    words = builder.bitcast(value, ir.IntType(64).as_pointer())
    constant = builder.module.add_metadata([])

    def word(number: int, of: Any = ir.IntType(64)) -> Any:  # noqa: B008
        place = builder.gep(words, [ir.Constant(ir.IntType(64), first + number)], inbounds=True)
        loaded = builder.load(builder.bitcast(place, of.as_pointer()))
        loaded.set_metadata("invariant.load", constant)
        return loaded

    if isinstance(field, types.Array):
        array, n = context.make_array(field)(context, builder), field.ndim
        shape, strides = [word(1 + d) for d in range(n)], [word(1 + n + d) for d in range(n)]
        data, itemsize = word(0, array.data.type), context.get_constant(types.intp, numpy_dtype(field).itemsize)
        populate_array(array, data, shape, strides, itemsize, meminfo=None)
        return impl_ret_borrowed(context, builder, field, array._getvalue())
    if field == types.boolean:
        return builder.trunc(word(0), ir.IntType(1))
    return word(0, context.get_value_type(field))


def numpy_dtype(array: types.Array) -> np.dtype[Any]:
    """The dtype of numpy of one of numba's types of arrays."""
    return np.dtype(np.bool_ if array.dtype == types.boolean else array.dtype.name)


class Packed:
    """A record laid out in memory, of which kernels get the address. It keeps what it points to."""

    __slots__ = ("address", "kept", "type", "words")

    def __init__(self, record: Any) -> None:
        record_class: Any = type(record)
        self.type: RecordType = record_type(record_class)
        self.words = np.empty(self.type.n_words, dtype=np.int64)
        self.kept = record, [self._put(getattr(record, name), name) for name in self.type.fields]
        self.address = self.words.ctypes.data

    def _put(self, value: Any, name: str) -> Any:
        """Lay out one field; what has to be kept for it besides the record itself."""
        field, first = self.type.fields[name], self.type.offsets[name]
        if isinstance(field, types.Array):
            if not (value.flags.c_contiguous and value.ndim == field.ndim and value.dtype == numpy_dtype(field)):
                raise TypeError(f"{self.type.record.__name__}.{name}: expected {field}, got {numba.typeof(value)}")
            self.words[first] = value.ctypes.data
            self.words[first + 1 : first + 1 + field.ndim] = value.shape
            self.words[first + 1 + field.ndim : first + 1 + 2 * field.ndim] = value.strides
        elif isinstance(value, list):
            rows = [Packed(record) for record in value]
            for row in rows:
                self._check(row, name)
            words = np.concatenate([row.words for row in rows])
            self.words[first] = words.ctypes.data
            return rows, words
        elif isinstance(field, RecordType):
            inner = packed(value)
            self._check(inner, name)
            self.words[first] = inner.address
            return inner
        elif field == types.float64:
            self.words[first : first + 1].view(np.float64)[0] = value
        else:
            self.words[first] = int(value)
        return None

    def _check(self, inner: Any, name: str) -> None:
        """TypeError unless a field gets the record that it is for: kernels would read another one's memory."""
        if getattr(inner, "type", None) != self.type.fields[name]:
            raise TypeError(f"{self.type.record.__name__}.{name}: expected {self.type.fields[name]}, got {inner!r}")


def packed(value: Any) -> Any:
    """A record laid out for kernels; anything else as it is, one that is laid out already among it."""
    if numba.config.DISABLE_JIT:
        return value
    return Packed(value) if isinstance(value, tuple) and hasattr(value, "_fields") else value


@typeof_impl.register(Packed)
def _typeof_packed(value: Packed, _context: Any) -> types.Type:
    return value.type


@unbox(RecordType)
def _unbox_packed(_type: RecordType, value: Any, context: Any) -> NativeValue:
    number = context.pyapi.object_getattr_string(value, "address")
    address = context.pyapi.long_as_voidptr(number)
    context.pyapi.decref(number)
    return NativeValue(address, is_error=cgutils.is_not_null(context.builder, context.pyapi.err_occurred()))


# Functions.

ALL_KERNELS: list[Any] = []  # all that were defined, in the modules imported so far
_LINKING = threading.RLock()  # of Python's threads one links at a time: the first's code is what others call
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
    inner = [value.py_func for value in _named(function) if isinstance(value, numba.core.dispatcher.Dispatcher)]
    return any(_returns_arrays(part) for part in [function, *inner])


def _returns_arrays(function: Callable[..., Any]) -> bool:
    result = function.__annotations__.get("return")
    return result not in ("None", "bool", "int", "float", "Any") and not str(result).startswith("tuple")


def _versioned(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function for numba to compile that closes over the checksum of all kernels.

    numba's cache is keyed by the code of one function and what that closes over, so that it would return a function
    compiled with others as they were before.
    """
    code = function.__code__.replace(co_freevars=("checksum",))
    version = FunctionType(code, function.__globals__, function.__name__, None, (CellType(checksum()),))
    version.__qualname__, version.__module__ = function.__qualname__, function.__module__
    return version


class Kernel:
    """A function that numba compiles, with a signature from its annotations."""

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
        result = type_of(hints.pop("return"))
        return result(*(type_of(hint) for hint in hints.values()))

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
        return njit(cache=True, error_model="numpy")(_versioned(self.function))

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
    def type(self) -> types.Function:
        """How other kernels call it: to numba an operation of its own, which raises what the unit raises."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            convention = context.call_conv
            kind = convention.get_function_type(signature.return_type, signature.args)
            function = cgutils.get_or_insert_function(builder.module, kind, self.symbol)
            status, value = convention.call_function(
                builder, function, signature.return_type, signature.args, arguments
            )
            with cgutils.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            return value

        def typed(_context: Any, *_arguments: Any) -> Any:
            return self.signature, generate

        parameters = inspect.signature(self.function).parameters.values()
        first = inspect.Parameter("_context", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        typed.__signature__ = inspect.Signature([first, *parameters])  # type: ignore[attr-defined]
        return types.Function(make_intrinsic_template(self, typed, self.symbol))

    @cached_property
    def compiled(self) -> Any:
        """The same for callers of machine code only."""
        dispatcher = _machine_code(cache=True, _nrt=_counts(self.function))(_versioned(self.function))
        dispatcher.compile(self.signature)
        return dispatcher

    @cached_property
    def address(self) -> int:
        """Where it is in memory."""
        (result,) = self.compiled.overloads.values()
        return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))

    def _make_known(self) -> None:
        llvm.add_symbol(self.symbol, self.address)


class Entry(Kernel):
    """A function that Python calls."""


@typeof_impl.register(Unit)
def _typeof_unit(unit: Unit, context: Any) -> types.Type:
    return unit.type


@typeof_impl.register(Entry)
def _typeof_entry(entry: Entry, context: Any) -> types.Type:
    return types.Dispatcher(entry.dispatcher)


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
            if is_entry or isinstance(value, numba.core.dispatcher.Dispatcher):
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
        if place.folder is not None:
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
        while fcntl is not None and time.monotonic() < give_up:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the system ends it with the process
                break
            except BlockingIOError:
                has_waited = True
                say("waiting for another run, which compiles the kernels")
                time.sleep(POLLED_SECONDS)
            except OSError:  # a file system without locks
                break
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
    processes: list[subprocess.Popen[bytes]] = []
    with contextlib.ExitStack() as stack:
        try:
            claims = stack.enter_context(tempfile.TemporaryDirectory(prefix="tetopt-", dir=folder))
        except OSError:  # what cannot be shared is compiled by the caller
            return
        # Ctrl-C is for this process, which then ends the others.
        code = (
            "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "
            f"from tetopt.kernels import compile_named; compile_named({names!r}, {claims!r}, {os.getpid()})"
        )
        try:
            command, environment = python_command("-c", code), python_environment()
            processes.extend(subprocess.Popen(command, env=environment) for _ in range(n_processes))
            while any(process.poll() is None for process in processes):
                say(f"compiling the kernels, {len(os.listdir(claims))} of {len(kernels)}")
                time.sleep(POLLED_SECONDS)
        finally:
            for process in processes:
                process.kill()
                process.wait()


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
            llvm.add_symbol(kernel.symbol, 1)
    for number, kernel in enumerate(chosen):
        if os.getppid() != parent and sys.platform != "win32":  # there a launcher stands between
            return
        with contextlib.suppress(FileExistsError):
            try:
                (Path(claims) / str(number)).touch(exist_ok=False)
                _ = kernel.compiled
            except (NotKeptWarning, FileNotFoundError):
                return


@intrinsic
def _fails(_context: Any, address: Any, values: Any, number: Any) -> Any:
    """Call the task at an address, with that of a record and a number: whether it raised an error."""

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        convention, kinds = context.call_conv, (types.voidptr, types.int64)
        task = builder.inttoptr(arguments[0], convention.get_function_type(types.void, kinds).as_pointer())
        record = builder.inttoptr(arguments[1], cgutils.voidptr_t)
        status, _ = convention.call_function(builder, task, types.void, kinds, [record, arguments[2]])
        return status.is_error

    return types.boolean(types.int64, types.int64, types.int64), generate


# The one parallel loop: each loop of its own took 2 s to compile.
@njit(cache=True, parallel=True)
def _run(task: int, values: int, n: int) -> int:
    n_failed = 0
    for number in prange(n):
        n_failed += _fails(task, values, np.int64(number))
    return n_failed


def run(task: Any, n: int, values: Any) -> None:
    """Call a unit `task(values, number)` for all numbers up to n, on as many threads as numba is set to.

    `values` is a record. The calls must not depend on one another. MemoryError where one fails: units raise no other.
    """
    if numba.config.DISABLE_JIT:
        for number in range(n):
            task(values, number)
        return
    task.link()
    laid_out = packed(values)
    if laid_out.type != task.signature.args[0]:
        raise TypeError(f"{task.__name__}: expected a {task.signature.args[0]}, got a {laid_out.type}")
    _check_room()
    with _LOOPING if numba.threading_layer() == "workqueue" else contextlib.nullcontext():
        n_failed = _run(task.address, laid_out.address, n)
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


@helper
def thread() -> int:
    """The number of the thread that runs a task."""
    return numba.get_thread_id()
