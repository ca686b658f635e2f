"""The image: its place in the world, what it holds, and every message."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import random_affine
from numpy.testing import assert_allclose, assert_array_equal

from tetopt import Image, InputError
from tetopt.image import transform_vectors

seeds = st.integers(0, 2**32 - 1)
dimensions = st.sampled_from([2, 3])

OBLIQUE = np.array(
    [[0.0, -2.0, 0.0, 10.0], [3.0, 0.0, 0.0, -20.0], [0.0, 0.0, -5.0, 30.0], [0, 0, 0, 1]]
)


def test_sizes_of_a_flipped_and_turned_image():
    image = Image(np.zeros((4, 5, 6)), OBLIQUE)
    assert (image.ndim, image.shape, image.spacing.tolist()) == (3, (4, 5, 6), [3, 2, 5])
    sizes = image.voxel_volume, image.volume
    assert sizes == pytest.approx((30, 30 * 120), rel=1e-15)


def test_sheared_voxels_have_the_parallelepiped_s_volume():
    image = Image(np.zeros((2, 2)), [[2.0, 1.0, 0], [0, 3.0, 0], [0, 0, 1]])
    assert image.voxel_volume == pytest.approx(6)
    assert image.spacing == pytest.approx([2, np.sqrt(10)])


def test_default_is_a_voxel_of_1_mm_with_its_centre_at_the_origin():
    image = Image(np.zeros((3, 4)))
    assert_array_equal(image.affine, np.eye(3))
    assert image.to_world([0, 0]).tolist() == [0, 0]
    assert image.volume == 12


def test_to_world_by_hand():
    image = Image(np.zeros((4, 5, 6)), OBLIQUE)
    assert image.to_world([1, 2, 3]).tolist() == [10 - 4, -20 + 3, 30 - 15]
    assert image.to_index([6, -17, 15]).tolist() == [1, 2, 3]
    for shape in ((2, 7, 3), (0, 3)):
        assert image.to_world(np.zeros(shape)).shape == image.to_index(np.zeros(shape)).shape
        assert image.to_world(np.zeros(shape)).shape == shape


@given(seeds, dimensions)
def test_to_index_inverts_to_world(seed, n):
    rng = np.random.default_rng(seed)
    image = Image(np.zeros((3,) * n), random_affine(rng, n))
    index = rng.uniform(-50, 200, (20, n))
    assert_allclose(image.to_index(image.to_world(index)), index, atol=1e-10)
    homogeneous = np.column_stack([index, np.ones(20)]) @ image.affine.T
    assert_allclose(image.to_world(index), homogeneous[:, :n], rtol=1e-12, atol=1e-12)


@given(seeds, dimensions)
def test_transformed_is_a_matrix_product_row_by_row(seed, n):
    """To rounding; and a vector's result has the same bits alone and among others, which BLAS
    does not promise.
    """
    rng = np.random.default_rng(seed)
    matrix, vectors = rng.normal(size=(n, n)), rng.normal(size=(37, n))
    product = transform_vectors(vectors, matrix)
    assert_allclose(product, vectors @ matrix.T, rtol=1e-12, atol=1e-14)
    for vector, row in zip(vectors, product, strict=True):
        assert_array_equal(transform_vectors(vector, matrix), row)


# What is kept


@pytest.mark.parametrize(
    ("kind", "values", "kept"),
    [
        ("u1", [0, 255], "f4"),
        ("i2", [-32768, 32767], "f4"),
        ("?", [True, False], "f4"),
        ("f8", [0.5, 3e38], "f8"),  # 3e38 is not a float32
        ("f8", [0.5, 2.0**120], "f4"),
        ("i4", [2**24, 2**24 + 1], "f8"),
        ("f8", [0.1, 0.2], "f8"),
        ("f4", [0.1, 0.2], "f4"),
        ("f8", [1e147, 0.0], "f8"),
        ("f2", [0.5, 65504], "f4"),
        (">f4", [1.0, 2.0], "f4"),
        (None, [1, 2], "f4"),
    ],
)
def test_values_are_kept_as_float32_where_that_loses_nothing(kind, values, kept):
    data = [values] if kind is None else np.array([values], dtype=kind)
    image = Image(data)
    assert image.data.dtype == np.dtype(kept)
    assert image.data.dtype.isnative
    assert_array_equal(image.data, np.asarray(data))
    assert image.data.flags.c_contiguous


def test_arrays_are_copied_and_read_only():
    data, affine = np.zeros((3, 3), dtype=np.float32), np.eye(3)
    image = Image(data, affine)
    data[:] = affine[:] = 7
    assert (image.data == 0).all()
    assert_array_equal(image.affine, np.eye(3))
    for array in (image.data, image.affine):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    with pytest.raises(AttributeError):
        image.data = data


def test_fortran_order_and_negative_strides_are_read_right():
    data = np.arange(24.0).reshape(2, 3, 4)
    for view in (np.asfortranarray(data), data[::-1, :, ::-1], data.T):
        assert_array_equal(Image(view).data, view)


# Messages


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (np.zeros(5), "expected 2 or 3 axes"),
        (np.float64(3), "expected 2 or 3 axes"),
        (np.zeros((2, 2, 2, 2)), "expected 2 or 3 axes"),
        (np.zeros((3, 0)), "at least one voxel along every axis"),
        (np.zeros((2, 2), dtype=complex), "magnitude"),
        (np.zeros((2, 2), dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")]), "RGB"),
        (np.array([[None, 1], [2, 3]]), "one number per voxel"),
        (np.array([["a", "b"]]), "expected real numbers"),
        (np.array([["2020-01-01"]], dtype="M8[D]"), "expected real numbers"),
    ],
)
def test_data_that_is_no_image_is_refused(data, message):
    with pytest.raises(InputError, match=message):
        Image(data)


@pytest.mark.parametrize("value", [np.inf, -np.inf])
def test_the_first_voxel_that_is_infinite_is_named(value):
    data = np.zeros((3, 4))
    data[1, 2] = data[2, 3] = value
    with pytest.raises(InputError, match=r"2 voxels are infinite, the first at index \(1, 2\)"):
        Image(data)


def test_a_voxel_may_have_no_value():
    image = Image(np.array([[1.0, np.nan], [3.0, 2.0]]))
    assert image.data.dtype == np.float32
    assert (image.has_gaps, image.range) == (True, (1.0, 3.0))
    assert image.with_zeros().data.tolist() == [[1.0, 0.0], [3.0, 2.0]]
    whole = image.with_zeros()
    assert not whole.has_gaps
    assert whole.with_zeros() is whole


@pytest.mark.parametrize(
    ("affine", "message"),
    [
        (np.eye(4), r"expected shape \(3, 3\)"),
        (np.eye(2), r"expected shape \(3, 3\)"),
        (np.diag([1.0, np.nan, 1.0]), "finite"),
        (np.diag([1.0, 2.0, 2.0]), "last row"),
        ([[1, 0, 0], [0, 1, 0], [0.1, 0, 1]], "last row"),
        (np.diag([1.0, 0.0, 1.0]), "singular"),
        ([[1, 2, 0], [2, 4, 0], [0, 0, 1]], "singular"),
        ([[1, 1, 0], [1, 1 + 1e-7, 0], [0, 0, 1]], "singular"),
        ("affine", "array of numbers"),
        ([[1, 2], [3]], "array of numbers"),
    ],
)
def test_an_affine_that_places_nothing_is_refused(affine, message):
    with pytest.raises(InputError, match=message):
        Image(np.zeros((2, 2)), affine)


@pytest.mark.parametrize("sizes", [(1e-6, 1e-6, 1e-6), (0.1, 0.1, 10.0)])
def test_real_extremes_of_voxels(sizes):
    """Micrometres in metres, which are not singular; slices of 10 mm with pixels of 0.1 mm."""
    image = Image(np.zeros((2, 2, 2)), np.diag([*sizes, 1.0]))
    assert image.spacing.tolist() == list(sizes)
    assert image.voxel_volume == pytest.approx(np.prod(sizes))


@pytest.mark.parametrize("factor", [1e-151, 1e147])
def test_intensities_whose_squares_can_be_summed(factor):
    assert Image(np.array([[0.0, 1.0]]) * factor).data.max() == factor


@pytest.mark.parametrize(
    "values", [(0.0, 1e-300), (0.0, 1e300), (-1e200, 0.0), (5e-324, 0.0), (1e300, 1e300)]
)
def test_intensities_whose_squares_cannot_be_summed(values):
    with pytest.raises(
        InputError, match=r"intensities up to 1e\+148 that differ by at least 1e-152, .*rescale"
    ):
        Image(np.array([values]))


SHEARED, FAR = np.eye(4), np.eye(4)
SHEARED[:3, 2] = 1.0, 0.0, 1e-4
FAR[0, 3] = 1e12
FLAT = "at most 1000 times as long as thick, got"


@pytest.mark.parametrize(
    ("affine", "message"),
    [
        (np.diag([1.0, 1.0, 1e6, 1.0]), rf"{FLAT} 1e\+06 mm by 1 mm"),
        (np.diag([1.0, 1.0, 1e-6, 1.0]), f"{FLAT} 1 mm by 1e-06 mm"),
        (np.diag([1.0, 1.0, 1e20, 1.0]), r"voxels of up to 1e\+09 mm"),
        (np.diag([1.0, 1.0, 1e300, 1.0]), r"voxels of up to 1e\+09 mm"),
        (np.diag([1e-30, 1e-30, 1e-30, 1.0]), "expected voxels of 1e-09 to"),
        (np.diag([5e-324, 1.0, 1.0, 1.0]), "expected voxels of 1e-09 to|singular"),
        (SHEARED, f"{FLAT} 1.414 mm by 7.071e-05 mm"),
        (FAR, "within 1e.09 voxels of the world"),
    ],
)
def test_voxels_that_cannot_be_computed_with(affine, message):
    with pytest.raises(InputError, match=message) as caught:
        Image(np.zeros((2, 2, 2)), affine)
    assert "\n" not in str(caught.value)
