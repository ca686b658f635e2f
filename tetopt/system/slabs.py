"""Work on arrays in slabs along an axis, on all threads, where each call writes only to its slab;
and counts of pairs in one pass.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.system.arrays import Ints
from tetopt.system.kernel_cache import njit

SLABS_PER_THREAD = 16  # as some take longer than others, and temporaries are as large as a slab
# of a slab at least: waking a thread for fewer takes longer than their work
SLAB_ELEMENTS = 1 << 16

Result = TypeVar("Result")


def over_slabs(
    fill: Callable[[int, int], Result], n: int, n_elements: int, most: int | None = None
) -> list[Result]:
    """Call a function with the first position and the end of each of some slabs, and return its
    results in order.

    Parameters
    ----------
    fill : callable
        Function of two positions along the axis; called on several threads.
    n : int
        Length of the axis.
    n_elements : int
        Number of elements of the whole array, which determines the number of slabs.
    most : int, optional
        Largest number of slabs; `SLABS_PER_THREAD` for each thread by default.
    """
    n_threads = numba.get_num_threads()
    n_slabs = max(min(most or SLABS_PER_THREAD * n_threads, n_elements // SLAB_ELEMENTS, n), 1)
    ends = list(itertools.pairwise(np.linspace(0, n, n_slabs + 1).astype(int).tolist()))
    if n_threads == 1 or n_slabs == 1:
        return [fill(first, stop) for first, stop in ends]
    with ThreadPoolExecutor(n_threads) as threads:
        return list(threads.map(lambda slab: fill(*slab), ends))


def sum_over_slabs(
    count: Callable[[int, int], Ints], n: int, n_elements: int, n_counts: int
) -> Ints:
    """Sum the `n_counts` whole numbers that a function counts in each of some slabs; arguments as
    for `over_slabs`.

    The more numbers, the fewer slabs, so that all counts together take a byte per element at most.
    """
    return np.asarray(sum(over_slabs(count, n, n_elements, max(n_elements // (8 * n_counts), 1))))


def count_pairs(
    rows: NDArray[np.integer], columns: NDArray[np.integer], shape: tuple[int, int]
) -> scipy.sparse.csr_array:
    """Number of positions with each pair of values of two arrays of one shape, `shape` int64, such
    as voxels by cell and label; pairs with a negative number do not count.
    """
    first = np.full(shape[0], -1, dtype=np.int64)
    # unwritten pages take no memory
    row, column, after = np.empty((3, min(rows.size, shape[0] * shape[1])), dtype=np.int64)
    count = np.empty(len(row), dtype=np.int64)
    n = _count_pairs(first, row, column, after, count, rows.ravel(), columns.ravel())
    counts = scipy.sparse.coo_array((count[:n], (row[:n], column[:n])), shape=shape).tocsr()
    counts.sort_indices()
    return counts


@njit(cache=True, nogil=True)
def _count_pairs(
    first: NDArray,
    row: NDArray,
    column: NDArray,
    after: NDArray,
    count: NDArray,
    rows: NDArray,
    columns: NDArray,
) -> int:
    """Count into a chain of entries for each row; return the number of entries."""
    n = 0
    for v in range(len(rows)):
        if rows[v] < 0 or columns[v] < 0:
            continue
        at = first[rows[v]]
        while at >= 0 and column[at] != columns[v]:
            at = after[at]
        if at < 0:
            at = n
            n = n + 1
            row[at], column[at], count[at] = rows[v], columns[v], 0
            after[at], first[rows[v]] = first[rows[v]], at
        count[at] += 1
    return n
