"""What a run takes, by its sizes: the model that comes with the package."""

import pytest

from tetopt.engine import cost
from tetopt.engine.cost import RunSize

SIZE = RunSize(1_000_000, 800_000, 5000, 16, 2, has_region=True, has_memberships=True, is_drawn=True)


def test_the_model_is_complete_and_sane():
    """Each term has a cost that is no less than 0, and none is left over; errors are stated."""
    model = cost.cost_model()
    assert set(model.seconds) == {*cost.once_terms(SIZE), *cost.swept_terms(SIZE)}
    assert set(model.bytes) == set(cost.memory_terms(SIZE))
    assert min(*model.seconds.values(), *model.bytes.values()) >= 0.0
    assert 0.0 < model.parallel_fraction <= 1.0
    assert model.calibration_seconds > 0.0
    assert model.seconds_factor > 1.0
    assert 0.0 < model.bytes_fraction


@pytest.mark.parametrize("mode", ["graded", "uniform", "paper", "start"])
@pytest.mark.parametrize("name", ["n_read", "n_voxels", "n_nodes", "iterations", "n_channels", "runs", "is_drawn"])
def test_more_takes_no_less(mode, name):
    """Time grows with each size; so does memory, of which iterations take none."""
    less = SIZE._replace(mode=mode, is_drawn=False)
    more = less._replace(**{name: True if name == "is_drawn" else 2 * getattr(less, name)})
    for ndim in (2, 3):
        first, second = (cost.predicted(size._replace(ndim=ndim)) for size in (less, more))
        assert second.seconds >= first.seconds
        assert second.seconds > first.seconds or name in ("n_read", "n_voxels", "n_channels")  # may cost nothing
        assert second.peak_bytes >= first.peak_bytes


def test_what_is_swept():
    """1000 nodes in 20^3 voxels: facets cross 10 x 20 x 20 rows, in each iteration and run, for each channel more."""
    size = RunSize(0, 8000, 1000, 10)
    known = {"graded_cells": 60_000.0, "graded_rows": 40_000.0}
    others = {"runs": (2, 2.0), "iterations": (30, 3.0), "elongation": (8.0, 4.0)}
    terms = {name: value for name, value in cost.swept_terms(size).items() if value}
    assert terms == pytest.approx(known)
    for name, (value, factor) in others.items():
        assert cost.swept_terms(size._replace(**{name: value}))["graded_rows"] == pytest.approx(40_000.0 * factor)
    assert cost.swept_terms(size._replace(n_channels=3, mode="paper"))["channel_rows"] == pytest.approx(80_000.0)


def test_voxels_and_channels_cost_something():
    """At least where many of them are read and kept."""
    small, large = RunSize(10**4, 10**4, 5000, 16), RunSize(10**7, 10**7, 5000, 16, 9, has_memberships=True)
    assert cost.predicted(large).seconds > cost.predicted(small).seconds + 1.0
    assert cost.predicted(large).peak_bytes > cost.predicted(small).peak_bytes + 5e8


def test_bounds_are_above_predictions():
    """What refuses a run is more than what it will take besides what there is."""
    for n_voxels, n_channels, n_nodes in ((10**5, 1, 1000), (10**7, 5, 100_000), (10**6, 40, 10)):
        terms = cost.memory_terms(RunSize(0, n_voxels, n_nodes, 16, n_channels))
        costs = cost.cost_model().bytes
        expected = sum(costs[name] * terms[name] for name in ("channel_voxels", "cells"))
        assert cost.meshing_bytes(n_voxels, n_channels, n_nodes) > 1.2 * expected
    assert cost.next_bytes(0) == 0.0
    assert 0.0 < cost.next_bytes(1000) < cost.meshing_bytes(0, 0, 1000)


def test_threads_divide_the_sweeps_and_speed_all():
    one, two, fast = cost.predicted(SIZE), cost.predicted(SIZE, threads=2), cost.predicted(SIZE, speed=2.0)
    assert one.cpu_seconds == two.cpu_seconds == one.seconds
    assert 0.5 * one.seconds < two.seconds < one.seconds
    assert fast.seconds == pytest.approx(0.5 * one.seconds)
    assert one.peak_bytes == two.peak_bytes == fast.peak_bytes
