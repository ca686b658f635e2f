"""Results on one thread and on two, compared to the last bit."""

import numba
import numpy as np
import pytest


def assert_same_bits(run):
    """Of the arrays that a run returns, on one thread and twice on two."""
    if numba.config.DISABLE_JIT or numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("needs two threads to compare")
    before, results = numba.get_num_threads(), []
    try:
        for count in (1, 2, 2):
            numba.set_num_threads(count)
            results.append(b"".join(np.asarray(array).tobytes() for array in run()))
    finally:
        numba.set_num_threads(before)
    assert len(results[0]) > 100
    assert results[1:] == results[:1] * 2
