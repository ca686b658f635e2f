import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from shapes import OBLIQUE, distance, grid

import tetopt
from tetopt.target.memberships import finer, memberships, supersampling


def test_every_voxel_keeps_its_label():
    rng = np.random.default_rng(0)
    for shape in [(9, 10, 11), (17, 16)]:
        labels = rng.choice([0, 3, 4, 90], size=shape)
        members = memberships(tetopt.Image(labels))
        np.testing.assert_array_equal(members.labels, [0, 3, 4, 90])
        np.testing.assert_array_equal(members.labels[members.partition], labels)
        np.testing.assert_array_equal(members.levels.argmin(axis=0), members.channel[members.partition])


@pytest.mark.parametrize("radius", [6.0, 11.0])
def test_a_sphere_has_no_stairs(radius):
    centre = np.array([14.3, 15.1, 14.7])
    labels = tetopt.Image(np.where(distance((30, 30, 30), *centre) < radius, 7.0, 2.0))
    members = memberships(labels)
    way = np.random.default_rng(0).normal(size=(2000, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    level = members.levels[members.channel[1]] - members.levels[members.channel[0]]
    steps = np.linspace(-1.5, 1.5, 301)
    at = (centre + (radius + steps)[:, None, None] * way).reshape(-1, 3).T
    values = map_coordinates(level, at, order=1).reshape(len(steps), -1)
    off = steps[np.argmax(values > 0.0, axis=0)]
    assert np.abs(off).mean() < 0.09
    assert abs(off.mean()) < 0.06


def test_supersampling():
    assert supersampling(np.array([0.9, 0.9, 5.0])) == (1, 1, 5)
    assert supersampling(np.array([6.5, 1.0, 1.0])) == (7, 1, 1)
    assert supersampling(np.array([1.0, 1.4])) == (1, 1)


@pytest.mark.parametrize("factors", [(1, 1, 1), (1, 1, 5), (2, 1, 3)])
def test_finer_voxels_fill_the_same_box(factors):
    image = tetopt.Image(grid((4, 5, 6)) @ [1.0, -2.0, 3.0], OBLIQUE)
    fine = finer(image, factors)
    assert fine.shape == tuple(np.multiply(image.shape, factors))
    corners = np.array([[-0.5] * 3, np.array(image.shape) - 0.5])
    fine_corners = np.array([[-0.5] * 3, np.array(fine.shape) - 0.5])
    np.testing.assert_allclose(fine.to_world(fine_corners), image.to_world(corners), atol=1e-9)
    at = np.clip(image.to_index(fine.to_world(grid(fine.shape))), 0.0, np.array(image.shape) - 1.0)
    np.testing.assert_allclose(fine.data, at @ [1.0, -2.0, 3.0], atol=1e-5)
