"""The box's sides and axes: worked by hand, and at the tolerance."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides, is_on_sides, upright_axis, world_axes


def test_sides_of_a_box():
    assert box_sides((4, 7, 1)).tolist() == [[-0.5, 3.5], [-0.5, 6.5], [-0.5, 0.5]]


@pytest.mark.parametrize(("fraction", "is_on"), [(0.0, True), (0.9, True), (1.1, False)])
def test_a_place_is_on_a_side_up_to_the_tolerance(fraction, is_on):
    off = fraction * ON_SIDE_VOXELS
    places = np.array([[-0.5 - off, 1.0], [3.5 + off, 6.5 - off]])
    expected = [[[is_on, False], [False, False]], [[False, is_on], [False, is_on]]]
    assert is_on_sides(places, box_sides((4, 7))).tolist() == expected


def test_whole_numbers_are_compared_exactly():
    sides = np.array([[-(2**60), 2**60]])
    places = np.array([[-(2**60)], [1 - 2**60], [2**60]])
    assert is_on_sides(places, sides, tolerance=0)[:, 0].tolist() == [
        [True, False],
        [False, False],
        [False, True],
    ]


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("seed", range(20))
def test_axes_are_assigned_by_the_largest_sum_of_cosines(seed, n):
    rng = np.random.default_rng(seed)
    affine = np.eye(n + 1)
    affine[:n, :n] = Rotation.random(random_state=seed).as_matrix()[:n, :n] + rng.uniform(
        -0.3, 0.3, (n, n)
    )
    axes = world_axes(affine)
    assert sorted(axes) == list(range(n))
    assert axes[upright_axis(affine)] == n - 1
    cosines = np.abs(affine[:n, :n] / np.linalg.norm(affine[:n, :n], axis=0))
    world, index = linear_sum_assignment(cosines, maximize=True)
    assert [axes[each] for each in index] == world.tolist()


def test_the_axis_that_rises_most_need_not_be_the_upright_one():
    """The first axis rises by 0.8 and the third by 0.65, but the third fits no other direction
    as well.
    """
    affine = np.eye(4)
    affine[:3, :3] = [[0.6, 0.0, 0.1], [0.0, 1.0, 0.75], [0.8, 0.0, 0.65]]
    assert (world_axes(affine), upright_axis(affine)) == ((0, 1, 2), 2)


def test_equally_good_assignments_keep_the_order_of_the_axes():
    for axis in range(3):
        affine = np.eye(4)
        affine[:3, :3] = Rotation.from_euler("xyz"[axis], 45, degrees=True).as_matrix()
        assert world_axes(affine) == (0, 1, 2)
