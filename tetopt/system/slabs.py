"""Work on arrays in slabs along an axis, on all threads; each call writes only to its slab."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

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
    count: Callable[[int, int], NDArray[np.int64]], n: int, n_elements: int, n_counts: int
) -> NDArray[np.int64]:
    """Sum the `n_counts` whole numbers that a function counts in each of some slabs; arguments as
    for `over_slabs`.

    The more numbers, the fewer slabs, so that all counts together take a byte per element at most.
    """
    return np.asarray(sum(over_slabs(count, n, n_elements, max(n_elements // (8 * n_counts), 1))))
