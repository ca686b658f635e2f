"""Distances from triangles against their slow twin; that of flat ones is in
tests/measure/test_fidelity.py.
"""

import naive
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from tetopt.geometry.nearest import triangle_distances


def test_distances_against_twin():
    """Of points near to, amid and far from many small triangles and a few that cross the whole
    box.
    """
    rng = np.random.default_rng(0)
    sizes = np.where(np.arange(150) < 5, 10.0, 0.3)[:, None, None]
    corners = rng.uniform(-10.0, 10.0, (150, 1, 3)) * [1.0, 0.7, 0.1] + sizes * rng.normal(
        size=(150, 3, 3)
    )
    points = np.vstack(
        [corners[:20].mean(axis=1), rng.normal(0.0, 10.0, (20, 3)), rng.normal(0.0, 100.0, (10, 3))]
    )
    expected = [min(naive.facet_distance(p, c) for c in corners) for p in points]
    facets = np.arange(450).reshape(150, 3) + 1  # after an unused node, far away
    distances = triangle_distances(
        points, np.vstack([[[1e6, -1e6, 0.0]], corners.reshape(-1, 3)]), facets
    )
    assert_allclose(distances, expected, rtol=1e-9, atol=1e-9)


def test_a_point_for_all_triangles():
    """Triangles that are one point have a bin, too."""
    facets = np.zeros((2, 3), dtype=np.int64)
    assert_array_equal(
        triangle_distances(np.array([[3.0, 4.0, 0.0]]), np.zeros((1, 3)), facets), [5.0]
    )
