"""The internals of numba that kernels use: records passed by address, units called through linker
symbols.

Any version of numba may drop what this module imports. `tetopt.system.kernels` then does without
it.
"""

from __future__ import annotations

import inspect
import sys
import typing
from collections.abc import Callable
from functools import cache
from typing import Any

import llvmlite.binding as llvm
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

from tetopt.system.kernel_cache import checksum, njit
from tetopt.system.kernel_types import check_array, numpy_dtype, type_of

WORD_BYTES = 8  # size of a number, an address or a length in a record's memory


class RecordType(types.Type):
    """numba's type of a NamedTuple that is passed by address."""

    def __init__(self, record: type) -> None:
        self.record = record
        hints = typing.get_type_hints(record, include_extras=True)
        self.fields = {name: type_of(hint, record_type) for name, hint in hints.items()}
        self.offsets: dict[str, int] = {}
        self.n_words = 0
        for name, field in self.fields.items():
            self.offsets[name] = self.n_words
            self.n_words += 1 + 2 * field.ndim if isinstance(field, types.Array) else 1
        super().__init__(f"{record.__module__}.{record.__qualname__}-{checksum()}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by name for the keys of numba's cache: the record of another version may no
        longer exist.
        """
        return _type_of_name, (self.record.__module__, self.record.__qualname__, checksum())


def _type_of_name(module: str, name: str, version: str) -> types.Type:
    record = getattr(sys.modules.get(module), name, None)
    is_same = version == checksum() and record is not None
    return record_type(record) if is_same else types.Opaque(f"{module}.{name}-{version}")


@cache
def record_type(record: Any) -> RecordType:
    """Return the unique type of a NamedTuple."""
    return RecordType(record)


register_model(RecordType)(OpaqueModel)


@intrinsic
def nth(_context: Any, records: Any, number: Any) -> Any:
    """Return the record with a number from a list of records, given the address of the first."""

    def generate(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        step = ir.Constant(ir.IntType(64), WORD_BYTES * signature.return_type.n_words)
        return builder.gep(arguments[0], [builder.mul(arguments[1], step)])

    return records(records, types.int64), generate


@infer_getattr
class _RecordFields(AttributeTemplate):
    key = RecordType

    def generic_resolve(self, record: RecordType, name: str) -> types.Type | None:
        return record.fields.get(name)


@lower_getattr_generic(RecordType)
def _load_field(context: Any, builder: Any, record: RecordType, value: Any, name: str) -> Any:
    """Load a field of a record. LLVM learns that its memory is constant while kernels run, and
    hoists loads.
    """
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
        data, itemsize = (
            word(0, array.data.type),
            context.get_constant(types.intp, numpy_dtype(field).itemsize),
        )
        populate_array(array, data, shape, strides, itemsize, meminfo=None)
        return impl_ret_borrowed(context, builder, field, array._getvalue())
    if field == types.boolean:
        return builder.trunc(word(0), ir.IntType(1))
    return word(0, context.get_value_type(field))


class Packed:
    """A record laid out in memory for kernels, which get its address. It keeps alive everything
    it points to.
    """

    __slots__ = ("address", "kept", "type", "words")

    def __init__(self, record: Any) -> None:
        record_class: Any = type(record)
        self.type: RecordType = record_type(record_class)
        self.words = np.empty(self.type.n_words, dtype=np.int64)
        self.kept = record, [self._put(getattr(record, name), name) for name in self.type.fields]
        self.address = self.words.ctypes.data

    def _put(self, value: Any, name: str) -> Any:
        """Lay out one field; return the objects to keep alive for it in addition to the record."""
        field, first = self.type.fields[name], self.type.offsets[name]
        if isinstance(field, types.Array):
            check_array(value, field, f"{self.type.record.__name__}.{name}")
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
            inner = Packed(value) if isinstance(value, tuple) else value
            self._check(inner, name)
            self.words[first] = inner.address
            return inner
        elif field == types.float64:
            self.words[first : first + 1].view(np.float64)[0] = value
        else:
            self.words[first] = int(value)
        return None

    def _check(self, inner: Any, name: str) -> None:
        """Raise TypeError unless a field gets a record of its type: kernels would misread
        another record's memory.
        """
        if getattr(inner, "type", None) != self.type.fields[name]:
            raise TypeError(
                f"{self.type.record.__name__}.{name}: expected {self.type.fields[name]}, got "
                f"{inner!r}"
            )


@typeof_impl.register(Packed)
def _typeof_packed(value: Packed, _context: Any) -> types.Type:
    return value.type


@unbox(RecordType)
def _unbox_packed(_type: RecordType, value: Any, context: Any) -> NativeValue:
    number = context.pyapi.object_getattr_string(value, "address")
    address = context.pyapi.long_as_voidptr(number)
    context.pyapi.decref(number)
    return NativeValue(
        address, is_error=cgutils.is_not_null(context.builder, context.pyapi.err_occurred())
    )


@intrinsic
def fails(_context: Any, address: Any, values: Any, number: Any) -> Any:
    """Call the task at an address with the address of a record and a number; return whether it
    raised an error.
    """

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        convention, kinds = context.call_conv, (types.voidptr, types.int64)
        task = builder.inttoptr(
            arguments[0], convention.get_function_type(types.void, kinds).as_pointer()
        )
        record = builder.inttoptr(arguments[1], cgutils.voidptr_t)
        status, _ = convention.call_function(
            builder, task, types.void, kinds, [record, arguments[2]]
        )
        return status.is_error

    return types.boolean(types.int64, types.int64, types.int64), generate


@intrinsic
def take_number(_context: Any, place: Any) -> Any:
    """Return the number at an address and add 1 to it, as one step among all threads."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        number = builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())
        return builder.atomic_rmw("add", number, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(types.int64), generate


@njit()
def take_numbers(task: int, values: int, n: int, place: int) -> int:
    """Call the task for the numbers below n that no other thread takes first."""
    n_failed, number = 0, take_number(place)
    while number < n:
        n_failed += fails(task, values, number)
        number = take_number(place)
    return n_failed


# The only parallel loop: separate loops took 2 s each to compile. Threads take numbers one by one:
# by the time of each on one thread, a fixed half each would take 1.09 times as long on two.
@njit(cache=True, parallel=True)
def run(task: int, values: int, n: int, place: int, n_threads: int) -> int:
    """Call the task at an address for a record and all numbers below n; return how many calls
    fail.

    `place` is the address of an integer that is 0.
    """
    n_failed = 0
    for _ in prange(n_threads):
        n_failed += take_numbers(task, values, n, place)
    return n_failed


def function_type(symbol: str, function: Callable[..., Any], of_call: types.Type) -> types.Function:
    """Return the numba type that calls a function by its symbol and raises the errors that the
    function raises.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        convention = context.call_conv
        kind = convention.get_function_type(signature.return_type, signature.args)
        callee = cgutils.get_or_insert_function(builder.module, kind, symbol)
        status, value = convention.call_function(
            builder, callee, signature.return_type, signature.args, arguments
        )
        with cgutils.if_unlikely(builder, status.is_error):
            convention.return_status_propagate(builder, status)
        return value

    def typed(_context: Any, *_arguments: Any) -> Any:
        return of_call, generate

    parameters = inspect.signature(function).parameters.values()
    first = inspect.Parameter("_context", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    typed.__signature__ = inspect.Signature([first, *parameters])  # type: ignore[attr-defined]
    return types.Function(make_intrinsic_template(symbol, typed, symbol))


def address_of(dispatcher: Any) -> int:
    """Return the address of the code of a function with one signature."""
    (result,) = dispatcher.overloads.values()
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


def add_symbol(symbol: str, address: int) -> None:
    """Add a symbol to the linker; RuntimeError if that fails, because using the symbol would end
    the process.
    """
    llvm.add_symbol(symbol, address)
    if llvm.address_of_symbol(symbol) != address:
        raise RuntimeError(f"the linker has no symbol {symbol}")
