"""Components of voxels, by runs of them, against scipy's."""

import numpy as np
import pytest
import scipy

from tetopt.contents.labels import component_runs, voxel_components


@pytest.mark.parametrize("shape", [(9, 8, 7), (1, 6, 20), (12, 1, 1), (15, 14)])
def test_components_against_scipy(shape):
    """Numbers of components over faces and over corners, and those over faces without a voxel
    that is met.
    """
    rng, corners = np.random.default_rng(len(shape)), np.ones((3,) * len(shape))
    for fraction in (0.0, 0.05, 0.2, 0.4, 0.7, 1.0):
        inside, is_met = rng.random(shape) < fraction, rng.random(shape) < 0.1
        assert (
            component_runs(inside, is_met, has_corners=True)[0]
            == scipy.ndimage.label(inside, corners)[1]
        )
        number, n_components = scipy.ndimage.label(inside)
        lost = []
        for component in set(range(1, n_components + 1)) - set(number[inside & is_met].tolist()):
            index = np.argwhere(number == component)
            away = ((index - index.mean(axis=0)) ** 2).sum(axis=1)
            lost.append((-len(index), component, index[away.argmin()].tolist()))
        expected = [(-size, tuple(place)) for size, _, place in sorted(lost)]
        found, rows = voxel_components(inside, is_met, np.eye(len(shape) + 1))
        assert found == n_components
        assert [(row.voxels, row.place) for row in rows] == expected
