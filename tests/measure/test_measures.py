"""Measures taken at the same time."""

import time
from functools import partial

import numba
import pytest

from tetopt.measure.measures import measured_each


def test_measures_keep_to_the_number_of_threads():
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        assert measured_each({"a": numba.get_num_threads, "b": numba.get_num_threads}, None) == {"a": 1, "b": 1}
    finally:
        numba.set_num_threads(before)


def test_the_first_error_ends_the_measures(monkeypatch):
    """Those that were not begun are not; with a place for reasons, all others are taken."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: 1)
    begun, broken, failed = [], {"a": lambda: 1 // 0}, {}
    others = {name: partial(begun.append, name) for name in "bcdefgh"}
    with pytest.raises(ZeroDivisionError):
        measured_each(broken | {"slow": partial(time.sleep, 0.3)} | others, None)
    assert begun == []
    assert measured_each(broken | others, failed) == dict.fromkeys(others)
    assert failed["a"].startswith("ZeroDivisionError")
