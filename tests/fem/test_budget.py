"""How fine a reference may be: the shape of its grid, the time it is predicted to take, and the memory."""

import numpy as np
import pytest

import tetopt
from tetopt.fem import budget
from tetopt.fem.budget import affordable_dofs, reference_shape


def test_reference_shape_is_as_fine_as_allowed():
    """No more dofs than allowed, no finer than the image, nearly cubic."""
    for shape, spacing, dofs in (((60, 50, 40), (1.0, 1.0, 1.0), 30_000), ((200, 180, 20), (0.5, 0.5, 5.0), 90_000)):
        coarse = reference_shape(shape, np.array(spacing), dofs)
        assert 3 * np.prod(np.array(coarse) + 1) <= dofs
        assert all(c <= s for c, s in zip(coarse, shape, strict=True))
        assert 3 * np.prod(np.array(coarse) + 1) > 0.7 * dofs
    assert reference_shape((9, 8, 7), np.ones(3), 10**9) == (9, 8, 7)


def image_of(shape):
    return tetopt.Image(np.random.default_rng(0).uniform(1.0, 10.0, shape))


@pytest.mark.full
def test_time_and_iterations_set_the_size(monkeypatch):
    """Seconds over those of an iteration of all references; no more than the image has, no less than a thousand."""
    image = image_of((40, 30, 35))
    whole = 3 * 41 * 31 * 36
    monkeypatch.setattr(budget, "seconds_of_iteration", lambda grid: 1e-6)
    monkeypatch.setattr(budget, "available_bytes", lambda: 10**15)
    one, two = (affordable_dofs(image, nus, 1.0).dofs for nus in ((0.3,), (0.3, 0.45)))
    assert 1_000 < two < 0.6 * one < whole
    assert affordable_dofs(image, (0.3,), 0.5).dofs == pytest.approx(one / 2, abs=1)
    assert affordable_dofs(image, (0.3,), 1e9) == (whole, False)
    assert affordable_dofs(image, (0.3,), 1e-9) == (1_000, False)


def test_memory_sets_the_size(monkeypatch):
    image = image_of((40, 30, 35))
    monkeypatch.setattr(budget, "seconds_of_iteration", lambda grid: 1e-12)
    monkeypatch.setattr(budget, "available_bytes", lambda: 5_000_000)
    dofs, is_short = affordable_dofs(image, (0.3,), 10.0)
    assert is_short
    assert dofs == int(budget.FREE_FRACTION * 5_000_000 / budget.DOF_BYTES)


def test_small_images_are_taken_whole():
    assert affordable_dofs(image_of((4, 5, 3)), (0.3,), 0.001) == (3 * 5 * 6 * 4, False)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_refuses_no_time(seconds):
    with pytest.raises(tetopt.InputError, match="expected more than 0 seconds"):
        affordable_dofs(image_of((4, 5, 3)), (0.3,), seconds)


def test_an_iteration_takes_time():
    assert 0.0 < budget.seconds_of_iteration(budget.grid_of(image_of((9, 9, 9)), 0.3)) < 1.0
