"""The noun of vectors and tensors on voxels, and what a file's components mean."""

import dipy.reconst.utils
import numpy as np
import pytest
from numpy.testing import assert_allclose

import tetopt
from tetopt.fields.field import NINE_OF_SIX, ORDERS, PROGRAMS, parse_kind, world_field


def test_a_field_is_checked_once_and_locked():
    field = tetopt.Field(np.ones((2, 3, 4, 6), np.float32), np.eye(4), "tensor")
    assert (field.shape, field.data.dtype, field.data.flags.writeable) == ((2, 3, 4), float, False)
    assert field.grid.shape == (2, 3, 4)
    for data, kind, words in (
        (np.ones((2, 3, 4, 3)), "tensor", r"\(s_0, s_1, s_2, 6\) for a tensor, got \(2, 3, 4, 3\)"),
        (np.ones((2, 3, 4)), "vector", r"3\) for a vector"),
        (np.full((2, 3, 4, 3), np.nan), "vector", "NaN in all"),
        (np.full((2, 3, 4, 3), np.inf), "vector", "finite"),
        (np.ones((2, 3, 4, 3)), "scalar", "vector, direction, tensor, got"),
    ):
        with pytest.raises(tetopt.InputError, match=words):
            tetopt.Field(data, np.eye(4), kind)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tensr", "scalar, vector, direction, tensor, got"),
        ("vector@", "@fsl, @dipy, @mrtrix, @itk, @voxel, @ras, @lps"),
        ("vector@lsp", "@lps"),
        ("vector@ras-upper", "@ras"),
        ("tensor@ras-", "@ras-upper"),
        ("tensor@fls-upper", "@fsl"),
        ("scalar@ras", "a scalar has no frame"),
    ],
)
def test_unknown_kinds_are_refused_by_name(text, words):
    with pytest.raises(tetopt.InputError, match=words):
        parse_kind(text)


@pytest.mark.parametrize("program", ["fsl", "dipy", "mrtrix"])
def test_the_orders_of_the_six_are_dipy_s(program):
    """DIPY converts between the programs' orders."""
    upper = np.random.default_rng(0).normal(size=(2, 2, 2, 6))
    theirs = dipy.reconst.utils.convert_tensors(upper, "fsl", program)
    assert_allclose(theirs[..., ORDERS[PROGRAMS[program][1]]], upper)


@pytest.mark.parametrize("axes", ["voxel", "fsl", "ras", "lps"])
def test_tensors_and_vectors_turn_alike(axes):
    """For any vector v, the tensor v v^T of a file is that of the world's v."""
    draw = np.random.default_rng(1)
    affine = np.eye(4)
    affine[:3, :3] = draw.normal(size=(3, 3))
    v = draw.normal(size=(2, 3, 4, 3))
    i, j = np.triu_indices(3)
    vector = world_field(v, affine, *parse_kind(f"vector@{axes}")).data
    for order, places in ORDERS.items():
        six = np.empty((2, 3, 4, 6))
        six[..., places] = v[..., i] * v[..., j]
        tensor = world_field(six, affine, *parse_kind(f"tensor@{axes}-{order}")).data
        dyad = vector[..., :, None] * vector[..., None, :]
        assert_allclose(tensor[..., NINE_OF_SIX].reshape(dyad.shape), dyad, rtol=1e-12, atol=1e-12)
