"""Laws of smooth levels, which hold for any label."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from tetopt.contents.smoothing import FARTHEST_LEVEL, raw_level, smooth_level


def blob(shape, seed=0):
    """A label of no particular form, neither thin nor thick everywhere."""
    return gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.5) > 0.02


def level_of(inside):
    return smooth_level(inside, inside, None, (1,) * inside.ndim)


@pytest.mark.parametrize("shape", [(26, 22), (20, 18, 22)])
def test_turned_and_mirrored_voxels_have_the_same_level_turned(shape):
    """Without a preferred axis or direction."""
    inside = blob(shape)
    level, axes = level_of(inside), tuple(range(len(shape)))[::-1]
    assert_allclose(level_of(inside.transpose(axes)), level.transpose(axes), atol=2e-5)
    for axis in axes:
        assert_allclose(level_of(np.flip(inside, axis)), np.flip(level, axis), atol=2e-5)


@pytest.mark.parametrize("shape", [(26, 22), (20, 18, 22)])
def test_what_is_not_the_label_has_the_opposite_level(shape):
    inside = blob(shape, 1)
    level = level_of(inside)
    assert_allclose(level_of(~inside), -level, atol=2e-4)
    assert ((level < 0.0) == inside).all()
    assert np.abs(level).max() <= FARTHEST_LEVEL


def test_a_level_in_the_plane_is_that_of_a_column():
    """One code in 2-D and 3-D: far from the ends of a shape that does not change along an axis."""
    inside = blob((26, 22), 2)
    column = level_of(np.repeat(inside[None], 24, axis=0))
    assert_allclose(column[12], level_of(inside), atol=1e-3)


@pytest.mark.parametrize("normal", [(0.98, 0.2, 0.0), (0.9, 0.4, 0.17), (0.7, 0.6, 0.3)])
def test_a_tilted_plane_has_no_stairs(normal):
    """Its level is nearly the distance to it, where raw levels are half a voxel off."""
    at = np.indices((32, 32, 32)) - 15.5
    distance = np.tensordot(np.array(normal) / np.linalg.norm(normal), at, 1)
    inside, inner = distance < 0.0, (slice(8, -8),) * 3
    near = np.abs(distance[inner]) < 1.0
    smooth, raw = (
        np.abs(level[inner] - distance[inner])[near]
        for level in (level_of(inside), raw_level(inside))
    )
    assert smooth.max() < 0.15 < 0.45 < raw.max()
    assert smooth.mean() < 0.4 * raw.mean()


@pytest.mark.parametrize("thickness", [1, 2, 5])
def test_a_wall_and_a_gap_keep_their_thickness(thickness):
    """Along the middle of each, to a tenth of a voxel and in steps of the level's linear slope."""
    inside = np.zeros((24, 24, 24), dtype=bool)
    inside[10 : 10 + thickness] = True
    for each in (inside, ~inside):
        row = level_of(each)[:, 12, 12]
        at = np.flatnonzero(np.diff(np.signbit(row)))
        places = at + row[at] / (row[at] - row[at + 1])
        assert np.diff(places) == pytest.approx([thickness], abs=0.1)
