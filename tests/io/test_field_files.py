"""Vectors and tensors in files of the programs that own a convention, in the world's axes."""

from pathlib import Path

import dipy.io.utils
import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from dipy.reconst.utils import convert_tensors
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

import tetopt
from tetopt.fields.field import COLUMNS, NINE_OF_SIX, ROWS
from tetopt.io.images import save_voxels

SHAPE = (3, 4, 5)
TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def six():
    """World tensors, upper."""
    a = np.random.default_rng(0).normal(size=(*SHAPE, 3, 3))
    return (a @ np.swapaxes(a, -1, -2))[..., ROWS, COLUMNS].astype(np.float32)


def affine_of(sign=1.0):
    affine = np.eye(4)
    affine[:3, :3] = TURN @ np.diag([sign * 2.0, 2.5, 3.0])
    affine[:3, 3] = [5.0, -7.0, 11.0]
    return affine


def whole(rows):
    return rows[..., NINE_OF_SIX].reshape(*rows.shape[:-1], 3, 3)


def save(name, data, affine=None, intent=None):
    file = nibabel.Nifti1Image(data, affine_of() if affine is None else affine)
    if intent is not None:
        file.header.set_intent(intent)
    nibabel.save(file, name)


def nrrd(kinds, data, space="left-posterior-superior", more=""):
    """An NRRD file whose components come first, with the affine of `affine_of` in LPS."""
    affine = affine_of()
    if space.lower()[0] == "l":
        affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    *steps, origin = (f"({','.join(map(repr, each))})" for each in affine[:3].T.tolist())
    head = (
        f"NRRD0004\ntype: float\ndimension: 4\nspace: {space}\n"
        f"sizes: {data.shape[-1]} {' '.join(map(str, SHAPE))}\n"
        f"space directions: none {' '.join(steps)}\nkinds: {kinds} domain domain domain\n"
        f"endian: little\nencoding: raw\nspace origin: {origin}\n{more}\n"
    )
    values = np.moveaxis(data, -1, 0).astype("<f4")
    with open("a.nrrd", "wb") as stream:
        stream.write(head.encode() + values.tobytes(order="F"))


def test_fsl_flips_x_where_the_determinant_is_positive(six):
    """Two files of one subject, stored from left to right and from right to left."""
    v = six[..., :3]
    for sign, x in ((1.0, -1.0), (-1.0, 1.0)):
        affine = affine_of(sign)
        axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0) * [x, 1.0, 1.0]
        stored = v @ axes  # components along the axes, which are orthonormal
        save("V1.nii.gz", stored.astype(np.float32), affine)
        save("D.nii.gz", (axes.T @ whole(six) @ axes)[..., ROWS, COLUMNS], affine)
        directions = tetopt.load_field("V1.nii.gz", "direction@fsl")
        assert_allclose(directions.data, v, atol=1e-5)
        assert_allclose(directions.affine, affine, atol=1e-6)
        assert_allclose(tetopt.load_field("D.nii.gz", "tensor@fsl").data, six, atol=1e-5)


def test_dipy_writes_the_lower_triangle(six):
    """In five axes with the intent 1005, of which the order is known, and the axes are not."""
    lower = convert_tensors(six, "fsl", "dipy")
    nibabel.save(dipy.io.utils.nifti1_symmat(lower, affine_of()), "D.nii.gz")
    assert nibabel.load("D.nii.gz").shape == (*SHAPE, 1, 6)
    for kind in ("tensor@dipy", "tensor@ras", "tensor@ras-lower"):
        assert_array_equal(tetopt.load_field("D.nii.gz", kind).data, six)
    for kind, words in (
        ("tensor", "axes .* not stated; give them, as tensor@FRAME: @fsl, @dipy"),
        ("tensor@fsl", "states the order lower, but tensor@fsl is upper; .* tensor@fsl-lower"),
        ("tensor@mrtrix", "tensor@ras-lower"),
        ("vector@ras", "3 components for a vector, got 6"),
    ):
        with pytest.raises(tetopt.InputError, match=rf"D.nii.gz: .*{words}"):
            tetopt.load_field("D.nii.gz", kind)


def test_mrtrix_has_the_diagonal_first(six):
    save("D.nii", convert_tensors(six, "fsl", "mrtrix"))
    assert_array_equal(tetopt.load_field("D.nii", "tensor@mrtrix").data, six)
    with pytest.raises(tetopt.InputError, match="order of its six components is not stated"):
        tetopt.load_field("D.nii", "tensor@ras")


@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii.gz"])
def test_channels_of_itk_are_lps(six, suffix):
    image = sitk.GetImageFromArray(
        np.transpose(six[..., :3] * [-1.0, -1.0, 1.0], (2, 1, 0, 3)).astype(np.float32),
        isVector=True,
    )
    image.SetSpacing([2.0, 2.5, 3.0])
    image.SetDirection((np.diag([-1.0, -1.0, 1.0]) @ TURN).ravel().tolist())
    image.SetOrigin([-5.0, 7.0, 11.0])
    sitk.WriteImage(image, f"v{suffix}")
    field = tetopt.load_field(f"v{suffix}", "vector@itk")
    assert_array_equal(field.data, six[..., :3])
    assert_allclose(field.affine, affine_of(), atol=1e-6)


@pytest.mark.parametrize("space", ["left-posterior-superior", "RAS"])
def test_nrrd_states_axes_by_its_measurement_frame(six, space):
    """Its vectors are columns, which map components to the space of the file."""
    frame = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])
    words = " ".join(f"({','.join(map(str, column))})" for column in frame.T)
    sides = np.diag([-1.0, -1.0, 1.0] if space[0] == "l" else [1.0, 1.0, 1.0])
    back = np.linalg.inv(sides @ frame)
    rows = (back @ whole(six) @ back.T)[..., ROWS, COLUMNS]
    more = f"measurement frame: {words}\n"
    nrrd("3D-symmetric-matrix", rows, space, more)
    field = tetopt.load_field("a.nrrd", "tensor")
    assert_allclose(field.data, six, atol=1e-5)
    assert_allclose(field.affine, affine_of(), atol=1e-12)
    nrrd("vector", six[..., :3] @ back.T, space, more)
    assert_allclose(tetopt.load_field("a.nrrd", "vector").data, six[..., :3], atol=1e-5)
    sure = np.ones((*SHAPE, 1))
    sure[1, 2, 3] = 0.0
    nrrd("3D-masked-symmetric-matrix", np.concatenate([sure, rows], axis=-1), space, more)
    masked = tetopt.load_field("a.nrrd", "tensor").data
    assert_array_equal(np.isnan(masked).all(axis=-1), sure[..., 0] == 0.0)
    nrrd("3D-matrix", (back @ whole(six) @ back.T).reshape(*SHAPE, 9), space, more)
    assert_allclose(tetopt.load_field("a.nrrd", "tensor").data, six, atol=1e-5)
    nrrd("vector", six[..., :3], space)
    with pytest.raises(tetopt.InputError, match="axes of its components are not stated"):
        tetopt.load_field("a.nrrd", "direction")
    nrrd("vector", six[..., :3], space, "measurement frame: (1,0,0) (0,1,0)\n")
    with pytest.raises(tetopt.InputError, match="measurement frame: expected three vectors"):
        tetopt.load_field("a.nrrd", "direction")


@pytest.mark.parametrize(
    "words", ["(0,0,0) (0,0,0) (0,0,0)", "(1,0,0) (0,1,0) (1,1,0)", "(nan,0,0) (0,1,0) (0,0,1)"]
)
def test_a_measurement_frame_in_a_plane_is_refused(six, words):
    nrrd("vector", six[..., :3], more=f"measurement frame: {words}\n")
    with refusal("a.nrrd: measurement frame: expected three vectors, not in one plane"):
        tetopt.load_field("a.nrrd", "vector")


def test_axes_other_than_those_of_the_header_are_refused(six):
    """As is an order; the same axes may be given."""
    upright = "measurement frame: (1,0,0) (0,1,0) (0,0,1)\n"
    nrrd("vector", six[..., :3], more=upright)
    alone = tetopt.load_field("a.nrrd", "vector").data
    assert_array_equal(tetopt.load_field("a.nrrd", "vector@lps").data, alone)
    for kind in ("vector@ras", "vector@fsl"):
        with refusal(f"a.nrrd: its header states other axes .* than {kind}; give vector without"):
            tetopt.load_field("a.nrrd", kind)
    nrrd("list", six, more=upright)
    with refusal("order of its six components is not stated; give it, as tensor@lps-ORDER"):
        tetopt.load_field("a.nrrd", "tensor")
    with refusal("a.nrrd: its header states other axes"):
        tetopt.load_field("a.nrrd", "tensor@dipy")
    assert tetopt.load_field("a.nrrd", "tensor@itk").shape == SHAPE


def test_our_own_vectors_on_voxels_come_back(six):
    """As `tetopt convert mesh.vtu u.nii.gz --fields displacement` writes them."""

    image = tetopt.Image(np.zeros(SHAPE), affine_of())
    for name in ("u.nii.gz", "u.nrrd", "u.mgz"):
        save_voxels(Path(name), six[..., :3], image)
        field = tetopt.load_field(name, "vector@ras")
        assert_array_equal(field.data, six[..., :3])
        assert_allclose(field.affine, affine_of(), atol=1e-5)


@pytest.mark.parametrize(
    ("name", "data", "kind", "words"),
    [
        ("a.nii.gz", np.ones(SHAPE), "tensor@fsl", "6 components for a tensor, got 1"),
        ("a.nii.gz", np.ones((*SHAPE, 5)), "tensor@fsl", "6 components for a tensor, got 5"),
        ("a.nii.gz", np.ones((*SHAPE, 2, 3)), "vector@ras", "3 components for a vector, got 6"),
        ("a.nii.gz", np.ones((3, 4)), "vector@ras", "3 components for a vector, got"),
        ("a.nii.gz", np.full((*SHAPE, 3), np.nan), "vector@ras", "got NaN in all"),
        ("a.nii.gz", np.full((*SHAPE, 3), np.inf), "vector@ras", "finite"),
        ("a.nii.gz", np.arange(540.0).reshape(*SHAPE, 9), "tensor@ras", "symmetric tensors"),
        ("a.nii.gz", np.ones((*SHAPE, 3)), "vector", "axes of its components are not stated"),
        ("a.npy", np.ones((*SHAPE, 3)), "vector@ras", "expected one of .nii.gz, .*.mhd"),
        ("b.nii.gz", np.ones((*SHAPE, 3)), "vector@ras", "no such file"),
    ],
)
def test_bad_files_are_refused_in_one_line(name, data, kind, words):
    np.save("a.npy", data)
    save("a.nii.gz", data)
    with pytest.raises(tetopt.InputError, match=words) as raised:
        tetopt.load_field(name, kind)
    assert str(raised.value).startswith(f"{name}: ")
    assert "\n" not in str(raised.value)


def test_scalars_are_images(six):
    save("m.nii.gz", six[..., 0])
    assert_array_equal(tetopt.load_field("m.nii.gz").data, six[..., 0])
