"""The box's sides and axes: worked by hand, and at the tolerance."""

import numpy as np
import pytest
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
    assert is_on_sides(places, sides, tolerance=0)[:, 0].tolist() == [[True, False], [False, False], [False, True]]


@pytest.mark.parametrize("seed", range(5))
def test_the_upright_axis_stands_for_the_last_world_axis(seed):
    rng = np.random.default_rng(seed)
    affine = np.eye(4)
    affine[:3, :3] = Rotation.random(random_state=seed).as_matrix() @ np.diag(rng.uniform(0.5, 3.0, 3))
    axes, up = world_axes(affine), upright_axis(affine)
    assert sorted(axes) == [0, 1, 2]
    assert axes[up] == 2
    rises = np.abs(affine[2, :3]) / np.linalg.norm(affine[:3, :3], axis=0)
    assert rises[up] == rises.max()
