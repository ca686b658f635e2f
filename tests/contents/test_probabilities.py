"""Labels from tissue probabilities."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt import Image
from tetopt.errors import InputError


def images(*arrays):
    return [Image(np.asarray(array, dtype=np.float32)) for array in arrays]


def test_each_voxel_has_the_most_probable_and_0_what_is_left():
    rng = np.random.default_rng(0)
    rows = rng.dirichlet(np.ones(5), size=(9, 8, 7)).transpose(3, 0, 1, 2)
    assert_array_equal(tetopt.tissue_labels(images(*rows[1:])).data, rows.argmax(axis=0))
    assert tetopt.tissue_labels(images([[0.5, 0.4]])).data.tolist() == [[0.0, 0.0]]


@pytest.mark.filterwarnings("ignore:tissues")
def test_the_first_of_equally_probable_tissues():
    assert tetopt.tissue_labels(images([[0.5, 0.4]], [[0.5, 0.4]])).data.tolist() == [[1.0, 1.0]]


def test_sums_above_1_are_told():
    tissues = images([[0.6, 0.005, 0.5]], [[0.6, 1.0, 0.2]])
    with pytest.warns(UserWarning, match=r"1 in 1 of 3 voxels \(up to 1.2\)"):
        assert tetopt.tissue_labels(tissues).data.tolist() == [[1.0, 2.0, 1.0]]


def test_bytes_are_taken_as_such():
    grey = Image(np.array([[0.0, 51.0], [204.0, 3.0]]))
    with pytest.warns(UserWarning, match="grey: .* 204 .* 255"):
        moved = tetopt.resample_tissue(grey, Image(np.zeros((2, 2))), "grey")
    assert_allclose(moved.data, [[0.0, 0.2], [0.8, 3.0 / 255.0]], rtol=1e-6)


@pytest.mark.parametrize("high", [256.0, 200.5, 1.01])
def test_other_scales_are_refused(high):
    image = Image(np.array([[0.0, high]]))
    with pytest.raises(InputError, match=f"c1: expected .* 0 to 1, got 0 to {high:g}; "):
        tetopt.resample_tissue(image, image, "c1")


def test_on_another_grid_they_are_linear():
    coarse = Image(np.array([[0.0, 1.0], [0.0, 1.0]]), np.diag([2.0, 2.0, 1.0]))
    fine = Image(np.zeros((3, 3)))
    assert_allclose(tetopt.resample_tissue(coarse, fine).data, [[0.0, 0.5, 1.0]] * 3)


EYE = Image(np.eye(4))


@pytest.mark.parametrize(
    ("tissues", "words"),
    [
        ([], "expected one image or more"),
        ([Image(2.0 * np.eye(4)), EYE], "number 1: .* 0 to 1, got 0 to 2"),
        ([EYE, Image(-np.eye(4))], "number 2: .* 0 to 1, got -1 to"),
        ([EYE, Image(np.zeros((3, 4)))], "number 2: expected the voxels of the first"),
        ([EYE, Image(np.eye(4), np.diag([1.0, 1.1, 1.0]))], "number 2: expected the voxels"),
    ],
)
def test_refused(tissues, words):
    with pytest.raises(InputError, match=f"tissues.*{words}"):
        tetopt.tissue_labels(tissues)


def test_a_tissue_that_is_nowhere_the_most_probable_is_named():
    with pytest.warns(UserWarning, match="label 3 is not the most probable in any voxel"):
        tetopt.tissue_labels(images(np.eye(3), 1.0 - np.eye(3), 0.1 * np.eye(3)))
