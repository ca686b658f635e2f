"""The modulus of a cell: the mean of the law over its voxels."""

import numpy as np
import pytest

import tetopt
from tetopt import Image, cell_moments, cell_of_voxel, lattice
from tetopt.model.averages import cell_young, young_image


def noise(shape, seed=0, affine=None):
    return Image(np.random.default_rng(seed).integers(0, 200, shape).astype(np.uint8), affine)


def test_the_modulus_image_keeps_its_place():
    affine = np.array([[2.0, 0.3, 0.0, 1.0], [0.0, -1.0, 0.1, 2.0], [0.0, 0.0, 3.0, 5.0], [0.0, 0.0, 0.0, 1.0]])
    image = noise((4, 5, 6), affine=affine)
    moduli = young_image(image, lambda h: 1.0 + h / 50.0)
    np.testing.assert_array_equal(moduli.affine, affine)
    np.testing.assert_array_equal(moduli.data, 1.0 + image.data.astype(np.float64) / 50.0)


@pytest.mark.parametrize("shape", [(24, 20), (14, 12, 10)])
def test_the_cell_s_modulus_is_the_mean_of_the_law_over_its_voxels(shape):
    """Eq. (2). For a linear law that is the law of the mean; for a convex one it is more, where h varies."""
    image = noise(shape)
    mesh = lattice(image, blocks=(2,) * len(shape))
    moments = cell_moments(image, mesh)
    assert moments.variance.min() > 0.0
    linear = cell_young(image, mesh, lambda h: 1.0 + h / 50.0)
    np.testing.assert_allclose(linear, 1.0 + moments.mean / 50.0, rtol=1e-12)
    owner = cell_of_voxel(image, mesh).ravel()
    squares = (image.data.astype(np.float64) ** 2).ravel()
    expected = np.bincount(owner, squares) / np.bincount(owner)
    moduli = cell_young(image, mesh, lambda h: h**2)
    np.testing.assert_allclose(moduli, expected, rtol=1e-12)
    np.testing.assert_allclose(moduli - moments.mean**2, moments.variance, rtol=1e-9)
    np.testing.assert_allclose(cell_young(image, mesh), moments.mean, rtol=1e-14)


def test_wide_fields_lose_no_digits():
    """Cell means of a field over twenty orders of magnitude against sums voxel by voxel; none is negative."""
    rng = np.random.default_rng(0)
    image = tetopt.Image(rng.uniform(0.0, 46.0, (14, 12, 13)))
    mesh = tetopt.lattice(image, nodes=80)
    moduli = cell_young(image, mesh, np.exp)
    owner = tetopt.cell_of_voxel(image, mesh)
    for cell in range(len(mesh.cells)):
        voxels = np.exp(image.data[owner == cell].astype(float))
        if len(voxels):
            assert moduli[cell] == pytest.approx(voxels.mean(), rel=1e-12)
