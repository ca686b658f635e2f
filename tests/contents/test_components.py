"""Components of voxels against scipy's."""

import numpy as np
import pytest
import scipy

from tetopt.contents.labels import counted_components


@pytest.mark.parametrize("shape", [(9, 8, 7), (1, 6, 20), (12, 1, 1), (15, 14)])
@pytest.mark.parametrize("has_corners", [False, True])
def test_components_against_scipy(shape, has_corners):
    rng, structure = np.random.default_rng(len(shape)), np.ones((3,) * len(shape)) if has_corners else None
    for fraction in (0.0, 0.05, 0.2, 0.4, 0.7, 1.0):
        inside, is_met = rng.random(shape) < fraction, rng.random(shape) < 0.1
        number, n = scipy.ndimage.label(inside, structure)
        n_met = len(np.unique(number[inside & is_met]))
        assert counted_components(inside, is_met, has_corners=has_corners) == (n, n_met)
