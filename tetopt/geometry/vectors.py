"""Vectors of three numbers as tuples, so that kernels need not spell out every coordinate; integers
stay integers.

LLVM inlines these functions. Inlined by numba, before type inference, they were as fast, but all
kernels took a fifth longer to compile.
"""

from __future__ import annotations

from numpy.typing import NDArray

from tetopt.system.kernel_cache import njit


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def row(x: NDArray, i: int) -> tuple:
    """Row i of x (R, 3)."""
    return x[i, 0], x[i, 1], x[i, 2]


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def put_row(x: NDArray, i: int, u: tuple) -> None:
    """Write u to row i of x (R, 3)."""
    x[i, 0], x[i, 1], x[i, 2] = u


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def difference(x: NDArray, i: int, k: int) -> tuple:
    """Row i of x (R, 3) minus row k."""
    return x[i, 0] - x[k, 0], x[i, 1] - x[k, 1], x[i, 2] - x[k, 2]


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def minus(u: tuple, v: tuple) -> tuple:
    """u minus v."""
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def scale_vector(s: float, u: tuple) -> tuple:
    """s times u."""
    return s * u[0], s * u[1], s * u[2]


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def over(u: tuple, s: float) -> tuple:
    """u divided by s."""
    return u[0] / s, u[1] / s, u[2] / s


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def dot(u: tuple, v: tuple) -> float:
    """Dot product, summed from first to last."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def cross(u: tuple, v: tuple) -> tuple:
    """Cross product."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
def times(M: NDArray, u: tuple) -> tuple:
    """The matrix M (3, 3) times u."""
    return dot(row(M, 0), u), dot(row(M, 1), u), dot(row(M, 2), u)
