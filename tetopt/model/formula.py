"""Formulas of the intensity h and of named fields, as written on a command line, parsed without
executing code.
"""

from __future__ import annotations

import ast
import operator
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from typing import Any

import numpy as np

from tetopt.errors import InputError
from tetopt.system.arrays import Floats

# far more than any real formula; Python's parser takes half a minute for a million
MOST_FORMULA_LETTERS = 10_000
MOST_NESTED_OPERATIONS = 100  # more than any real formula, and well within Python's recursion limit
FORMULA_FUNCTIONS: dict[str, tuple[Callable[..., Any], int]] = {
    "abs": (np.abs, 1),
    "sqrt": (np.sqrt, 1),
    "exp": (np.exp, 1),
    "log": (np.log, 1),
    "min": (np.minimum, 2),
    "max": (np.maximum, 2),
    "where": (np.where, 3),
}
BINARY_OPERATORS: dict[type[ast.operator], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
UNARY_OPERATORS: dict[type[ast.unaryop], Callable[..., Any]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
COMPARISONS: dict[type[ast.cmpop], Callable[..., Any]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
INTENSITY = "h"  # in formulas, of the image

Named = Mapping[str, Floats]  # values by name, in the same places


@dataclass(frozen=True, eq=False)
class Formula:
    """A function of named values, see `parse_formula`; callable, if it names no field.

    Parameters
    ----------
    names : frozenset of str
        "h" and the fields that it names, those of its range not among them unless it names none.
    function : callable
        From arrays by name to an array, or a number.
    outside : Formula, optional
        1 outside of the range that the text states after "for", else 0.
    range_text : str
        That range.
    """

    names: frozenset[str]
    function: Callable[[Named], Any]
    outside: Formula | None = None
    range_text: str = ""

    def __call__(self, h: Floats) -> Floats:
        """Return the values, float64, at intensities."""
        return self.at({INTENSITY: h})

    def at(self, values: Named) -> Floats:
        """Return the value, float64, in each place of the arrays by name, which have one shape."""
        shape = np.shape(next(iter(values.values())))
        with np.errstate(all="ignore"):  # undefined values are rejected where the modulus is used
            return np.array(np.broadcast_to(self.function(values), shape), dtype=np.float64)


def parse_formula(text: str, fields: Iterable[str] = ()) -> Formula:
    """Convert a formula of h, and of the fields of these names, to a function of their values;
    operators and precedence are Python's.

    Formulas contain numbers, ``h``, names of fields, ``+ - * / **``, brackets, ``abs``, ``sqrt``,
    ``exp`` and ``log`` of one argument, ``min`` and ``max`` of two, and ``where(condition, a, b)``.
    Comparisons (``0 < h <= 5``, with ``and`` and ``or``) are 1 where they hold, else 0; none is a
    formula. Where a formula is undefined (1/0, log of 0) the function returns inf or NaN.

    Raises
    ------
    InputError
        The text contains anything else.

    Examples
    --------
    >>> parse_formula("1 / max(abs(h), 0.001)")(np.array([0.02, -0.01, 0.0]))
    array([  50.,  100., 1000.])
    >>> parse_formula("where(h < 1, 2*h, 5)")(np.array([0.5, 1.0]))
    array([1., 5.])
    >>> parse_formula("3*mu", ["mu"]).at({"mu": np.array([2.0])})
    array([6.])
    """
    return _parse(text, frozenset({INTENSITY, *fields}))


def parse_range(text: str, fields: Iterable[str] = ()) -> Formula:
    """Convert a condition, such as ``0.1 < h <= 1.8``, to a formula that is 1 where it does not
    hold, else 0.

    Raises
    ------
    InputError
        The text is no comparison.

    Examples
    --------
    >>> parse_range("0.1 < h <= 1.8")(np.array([0.1, 1.0, 1.9]))
    array([1., 0., 1.])
    """
    condition = _parse(text, frozenset({INTENSITY, *fields}), is_condition=True)
    return Formula(condition.names, lambda values: 1.0 - condition.function(values))


def _parse(text: str, names: frozenset[str], *, is_condition: bool = False) -> Formula:
    if len(text) > MOST_FORMULA_LETTERS:
        raise InputError(
            f"formula: expected at most {MOST_FORMULA_LETTERS} characters, got "
            f'"{formula_text(text[:1000])}"'
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # for "1if h" Python only issues a warning
            tree = ast.parse(text.strip(), mode="eval").body
        if is_condition and not isinstance(tree, ast.Compare | ast.BoolOp):
            raise ValueError("no comparison")
        value = _compile_node(tree, text, names, int(is_condition))
    except (
        SyntaxError,
        SyntaxWarning,
        ValueError,
        OverflowError,
        RecursionError,
        MemoryError,
    ) as error:
        if isinstance(error, InputError):
            raise
        what = "a range, such as 0.1 < h <= 1.8, of" if is_condition else ""
        raise InputError(
            f"formula: expected {what}{' ' * is_condition}{_parts(names)}, got "
            f'"{formula_text(text)}"'
        ) from error
    used = {each.id for each in ast.walk(tree) if isinstance(each, ast.Name)}
    return Formula(names & used, value)


def _parts(names: frozenset[str]) -> str:
    """What a formula may contain, for a message."""
    known = ", ".join([INTENSITY, *sorted(names - {INTENSITY})])
    return f"numbers, {known}, + - * / **, brackets and {', '.join(FORMULA_FUNCTIONS)}"


def formula_text(text: str) -> str:
    """Format a formula on one line, truncated."""
    line = " ".join(text.split())
    return line if len(line) <= 60 else f"{line[:57]}..."


def _hints(node: ast.expr, names: frozenset[str]) -> str:
    """Return how to write what other programs write otherwise, for the end of a message."""
    inside = list(ast.walk(node))
    used = {each.id for each in inside if isinstance(each, ast.Name)}
    unknown = sorted(used - names - FORMULA_FUNCTIONS.keys())
    hints = [
        f"; write h for the intensity, or give `fields` {formula_text(each)}=FILE"
        for each in unknown[:1]
    ]
    hints += ["; write ** for powers"] * any(isinstance(each, ast.BitXor) for each in inside)
    if isinstance(node, ast.Compare | ast.BoolOp):
        hints.append("; a comparison is a condition of where(h < 1.2, 2*h, 3*h)")
    return "".join(hints)


def _compile_node(
    node: ast.expr, text: str, names: frozenset[str], depth: int
) -> Callable[[Named], Any]:
    """Convert a syntax tree to a function of values by name.

    InputError if the tree contains anything not allowed, or is deeper than
    `MOST_NESTED_OPERATIONS`.
    """
    if depth > MOST_NESTED_OPERATIONS:
        raise InputError(
            f"formula: expected at most {MOST_NESTED_OPERATIONS} nested operations, got "
            f'"{formula_text(text)}"'
        )
    match node:
        case ast.Constant(value=float() | int() as value) if not isinstance(value, bool):
            number = np.float64(value)  # OverflowError for integers beyond 1e308
            return lambda values: number
        case ast.Name(id=name) if name in names:
            return lambda values: values[name]
        case ast.BinOp(left=left, op=op, right=right) if type(op) in BINARY_OPERATORS:
            function = BINARY_OPERATORS[type(op)]
            operands = [left, right]
        case ast.UnaryOp(op=op, operand=operand) if type(op) in UNARY_OPERATORS:
            function = UNARY_OPERATORS[type(op)]
            operands = [operand]
        case ast.BoolOp(op=op, values=operands) if depth:
            function = _fold(np.logical_and if isinstance(op, ast.And) else np.logical_or)
        case ast.Compare(left=left, ops=ops, comparators=right) if depth and all(
            type(op) in COMPARISONS for op in ops
        ):
            function = _chain([COMPARISONS[type(op)] for op in ops])
            operands = [left, *right]
        case ast.Call(func=ast.Name(id=name), args=operands, keywords=[]) if (
            name in FORMULA_FUNCTIONS
        ):
            function, count = FORMULA_FUNCTIONS[name]
            if len(operands) != count:
                raise InputError(
                    f"formula: {name} takes {count} arguments, got {len(operands)} in "
                    f'"{formula_text(text)}"'
                )
        case _:
            part = ast.get_source_segment(text.strip(), node) or text
            raise InputError(
                f'formula: expected {_parts(names)}; cannot use "{formula_text(part)}"'
                f"{_hints(node, names)}"
            )
    inner = [_compile_node(operand, text, names, depth + 1) for operand in operands]
    return lambda values: function(*(value(values) for value in inner))


def _chain(compare: Sequence[Callable[..., Any]]) -> Callable[..., Any]:
    """Return a function that compares each value with the next one, as in 0 < h <= 5."""
    both = _fold(np.logical_and)
    return lambda *values: both(*map(lambda each, pair: each(*pair), compare, pairwise(values)))


def _fold(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of two as one of any number of values, with 0 and 1 for its truth."""
    return lambda *values: 1.0 * reduce(function, values)
