"""Laws from intensity to modulus, and the modulus of a cell."""

import numpy as np
import pytest

import tetopt
from tetopt import Image, InputError, cell_moments, cell_of_voxel, lattice
from tetopt.model.laws import cell_young, inverse_strain, young_from, young_image

TABLE = [(-50.0, 2.0), (0.0, 1.0), (100.0, 5.0)]


def noise(shape, seed=0, affine=None):
    return Image(np.random.default_rng(seed).integers(0, 200, shape).astype(np.uint8), affine)


# Laws


def test_a_table_is_linear_between_its_pairs_and_constant_beyond_them():
    found = young_from(TABLE, [[-1e9, -50.0, -25.0], [50.0, 100.0, 1e9]])
    np.testing.assert_array_equal(found, [[2.0, 2.0, 1.5], [3.0, 5.0, 5.0]])
    np.testing.assert_array_equal(young_from(np.array(TABLE), [0.0]), [1.0])
    np.testing.assert_array_equal(young_from([(7.0, 3.0)], [-1.0, 7.0, 8.0]), [3.0, 3.0, 3.0])


def test_no_law_takes_the_intensity_itself_and_a_copy_of_it():
    intensities = np.array([0.0, 1.5, 7.0])
    found = young_from(None, intensities)
    np.testing.assert_array_equal(found, intensities)
    found[0] = 9.0
    assert intensities[0] == 0.0


def test_a_function_sees_float64_and_may_return_whole_numbers():
    seen = []

    def law(h):
        seen.append(h.dtype)
        return np.full(h.shape, 3)

    found = young_from(law, np.array([1, 2], dtype=np.uint8))
    assert seen == [np.float64]
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, [3.0, 3.0])


def test_a_function_equal_to_a_table_gives_the_same():
    h = np.linspace(-50.0, 100.0, 31)
    np.testing.assert_allclose(
        young_from(TABLE, h), young_from(lambda x: np.where(x < 0, 1.0 - x / 50.0, 1.0 + x / 25.0), h), rtol=1e-14
    )


# Images and cells


def test_the_modulus_image_keeps_its_place():
    affine = np.array([[2.0, 0.3, 0.0, 1.0], [0.0, -1.0, 0.1, 2.0], [0.0, 0.0, 3.0, 5.0], [0.0, 0.0, 0.0, 1.0]])
    image = noise((4, 5, 6), affine=affine)
    found = young_image(image, lambda h: 1.0 + h / 50.0)
    np.testing.assert_array_equal(found.affine, affine)
    np.testing.assert_array_equal(found.data, 1.0 + image.data.astype(np.float64) / 50.0)


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
    found = cell_young(image, mesh, lambda h: h**2)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_allclose(found - moments.mean**2, moments.variance, rtol=1e-9)
    np.testing.assert_allclose(cell_young(image, mesh), moments.mean, rtol=1e-14)


# Strain maps


def test_inverse_strain():
    found = inverse_strain(np.array([[0.02, -0.01], [0.0, 1e-9]], dtype=np.float32), floor=1e-3)
    np.testing.assert_allclose(found, [[50.0, 100.0], [1000.0, 1000.0]], rtol=1e-6)
    assert found.dtype == np.float64


def test_inverse_strain_is_a_law():
    image = Image(np.array([[0.01, -0.02], [0.0, 0.5]]))
    found = young_image(image, lambda strain: inverse_strain(strain, 0.005)).data
    np.testing.assert_allclose(found, [[100.0, 50.0], [200.0, 2.0]], rtol=1e-14)


# Messages


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (
            [(0, 1), (0, 2)],
            "law: intensities must increase, got 0 and then 0; sort the pairs and give each intensity once",
        ),
        (
            [(0, 1), (9, 2), (5, 3)],
            "law: intensities must increase, got 9 and then 5; sort the pairs and give each intensity once",
        ),
        ([], "law: expected pairs (intensity, kPa), got an array of shape (0,)"),
        ([1.0, 2.0], "law: expected pairs (intensity, kPa), got an array of shape (2,)"),
        ([(1, 2, 3)], "law: expected pairs (intensity, kPa), got an array of shape (1, 3)"),
        ("soft", "law: expected pairs (intensity, kPa), got 'soft'"),
        ([(0, 1), (1,)], "law: expected pairs (intensity, kPa), got [(0, 1), (1,)]"),
        ([(0, 1), (5, np.nan)], "law: every intensity and modulus must be finite, got [[0.0, 1.0], [5.0, nan]]"),
        (
            [(0, -1), (10, 9)],
            "modulus: expected 0 kPa or more, got 1 others, such as -1 at intensity 0; "
            "give a law (--young) that is positive over the image's range",
        ),
        (
            lambda h: 4.0 - h,
            "modulus: expected 0 kPa or more, got 2 others, such as -1 at intensity 5, -6 at intensity 10; "
            "give a law (--young) that is positive over the image's range",
        ),
        (
            lambda h: np.where(h > 5, np.inf, 1.0),
            "modulus: expected 0 kPa or more, got 1 others, such as inf at intensity 10; "
            "give a law (--young) that is positive over the image's range",
        ),
        (
            lambda h: h.sum(),
            "law: expected a function that returns one value for each intensity, got shape () for shape (3,)",
        ),
    ],
)
def test_messages_of_laws(law, message):
    with pytest.raises(InputError) as error:
        young_from(law, [0, 5, 10])
    assert str(error.value) == message


@pytest.mark.parametrize("floor", [0.0, -1.0, np.nan, np.inf])
def test_message_of_the_floor(floor):
    with pytest.raises(InputError) as error:
        inverse_strain([0.1], floor)
    assert str(error.value) == f"floor: expected a strain above 0, such as 0.001, got {floor}"


def test_message_of_strains():
    with pytest.raises(InputError) as error:
        inverse_strain([0.1, np.nan, np.inf], 1e-3)
    assert str(error.value) == "strain: 2 values are NaN or infinite; replace them, 0 stands for stiff"


def test_wide_fields_lose_no_digits():
    """Cell means of a field over twenty orders of magnitude against sums voxel by voxel; none is negative."""
    rng = np.random.default_rng(0)
    image = tetopt.Image(rng.uniform(0.0, 46.0, (14, 12, 13)))
    mesh = tetopt.lattice(image, nodes=80)
    found = cell_young(image, mesh, np.exp)
    owner = tetopt.cell_of_voxel(image, mesh)
    for cell in range(len(mesh.cells)):
        held = np.exp(image.data[owner == cell].astype(float))
        if len(held):
            assert found[cell] == pytest.approx(held.mean(), rel=1e-12)
