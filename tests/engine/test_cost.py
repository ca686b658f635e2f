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
    assert 0.0 < model.parallel_share <= 1.0
    assert model.calibration_seconds > 0.0
    assert model.seconds_factor > 1.0
    assert 0.0 < model.bytes_share


@pytest.mark.parametrize("mode", ["graded", "uniform", "paper", "start"])
@pytest.mark.parametrize("name", ["n_read", "n_voxels", "n_nodes", "iterations", "n_channels", "runs", "is_drawn"])
def test_more_takes_no_less(mode, name):
    """Time grows with each size; so does memory, of which iterations take none."""
    less = SIZE._replace(mode=mode, is_drawn=False)
    more = less._replace(**{name: True if name == "is_drawn" else 2 * getattr(less, name)})
    for ndim in (2, 3):
        first, second = (cost.predicted(size._replace(ndim=ndim)) for size in (less, more))
        assert second.seconds > first.seconds or (mode, name) == ("paper", "n_channels")
        assert second.peak_bytes >= first.peak_bytes


def test_threads_divide_the_sweeps_and_speed_all():
    one, two, fast = cost.predicted(SIZE), cost.predicted(SIZE, threads=2), cost.predicted(SIZE, speed=2.0)
    assert one.cpu_seconds == two.cpu_seconds == one.seconds
    assert 0.5 * one.seconds < two.seconds < one.seconds
    assert fast.seconds == pytest.approx(0.5 * one.seconds)
    assert one.peak_bytes == two.peak_bytes == fast.peak_bytes
