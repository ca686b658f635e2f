"""E_G: Eq. (1) as printed, and its scaling."""

import naive
import numpy as np
import pytest
from hypothesis import given
from meshes import (
    ALL_SMALL,
    BAD_TETS,
    dimensions,
    seeds,
    split_box,
)

from tetopt import E_G
from tetopt.energy.geometric import cell_E_G, volume_and_E_G
from tetopt.geometry.simplex import orient_cells, volumes

pytestmark = pytest.mark.kernel


# Closed forms


@given(seeds, dimensions)
def test_E_G_is_eq_1_as_printed(seed, n):
    rng = np.random.default_rng(seed)
    points, cells = split_box(rng, (3,) * n, int(rng.integers(1, 8)))
    assert E_G(points, cells) == pytest.approx(naive.E_G_as_printed(points, cells), rel=1e-13)


# Laws


@pytest.mark.parametrize("mesh", ALL_SMALL)
def test_E_G_far_from_the_origin_loses_nothing(mesh):
    """As printed it would: x^2 |Omega| is 1e12 times what is left."""
    points, cells = mesh
    grid = np.round(points * 2.0**30) / 2.0**30
    np.testing.assert_array_equal(cell_E_G(grid + 2.0**20, cells), cell_E_G(grid, cells))


@pytest.mark.parametrize("kind", BAD_TETS)
def test_E_G_of_flat_cells_is_0(kind):
    points, cells = BAD_TETS[kind](0.0), np.array([[0, 1, 2, 3]])
    with np.errstate(all="raise"):
        assert cell_E_G(points, cells).tolist() == [0]


# The kernel


def corners_of(points, cell):
    """As the kernel takes them: (4, 3), a triangle in coordinates 1 and 2, the rest of the array
    never read.
    """
    n = points.shape[1]
    corners = np.full((4, 3), np.nan)
    corners[: n + 1, 3 - n :] = points[cell]
    return corners


@given(seeds, dimensions)
def test_volume_and_E_G_of_one_cell(seed, n):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(8, n)) * np.exp(rng.uniform(-3, 3)) + rng.uniform(-100, 100, n)
    cells = orient_cells(points, np.array([rng.permutation(8)[: n + 1] for _ in range(5)]))
    for cell, v, energy in zip(cells, volumes(points, cells), cell_E_G(points, cells), strict=True):
        measured = volume_and_E_G(corners_of(points, cell), n + 1)
        assert measured == pytest.approx((v, energy), rel=1e-8)
        assert measured == pytest.approx(naive.volume_and_E_G(points[cell]), rel=1e-9)
        assert volume_and_E_G(corners_of(points, cell[::-1]), n + 1) == pytest.approx(
            measured, rel=1e-9
        )
