"""Transforms of registrations move points as SimpleITK does, and FSL's and AFNI's as nitransforms.

Points and images are RAS+ here, LPS in ITK.
"""

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from nitransforms.linear import Affine
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from tetopt import Image, InputError, load_transform

LPS = np.array([-1.0, -1.0, 1.0])
SIZE, SPACING, ORIGIN = [20, 24, 18], [2.0, 2.5, 3.0], [-20.0, -30.0, -25.0]
rng = np.random.default_rng(7)


def affine_of_itk():
    A = sitk.AffineTransform(3)
    A.SetMatrix((np.eye(3) + 0.1 * rng.normal(size=(3, 3))).ravel())
    A.SetTranslation([12.3, -45.678, 7.9])
    A.SetCenter([33.3, -21.7, 65.1])
    return A


def field_image():
    """A smooth field of displacements of up to some mm on an oblique grid."""
    shifts = 60.0 * gaussian_filter(rng.normal(size=(*SIZE[::-1], 3)), (3, 3, 3, 0))
    image = sitk.GetImageFromArray(shifts, isVector=True)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(sitk.Euler3DTransform((0, 0, 0), 0.1, 0.2, -0.3).GetMatrix())
    return image


def dense(image):
    return sitk.DisplacementFieldTransform(sitk.Image(image))


def points_in(image, margin=0.0, count=1000):
    """Points within a field's outer voxels, to their faces."""
    index = rng.uniform(margin - 0.499, np.array(SIZE) - 0.501 - margin, size=(count, 3))
    return LPS * [image.TransformContinuousIndexToPhysicalPoint(each) for each in index]


def by_itk(transform, points):
    return LPS * [transform.TransformPoint(each) for each in LPS * points]


RIGID = {
    "affine": affine_of_itk(),
    "euler": sitk.Euler3DTransform((10, 20, 30), 0.1, 0.2, -0.3, (1, 2, 3)),
    "versor": sitk.VersorRigid3DTransform((1, 2, 3), 0.4, (9, 8, 7), (3, 4, 5)),
    "similarity": sitk.Similarity3DTransform(1.2, (1, 2, 3), 0.4, (9, 8, 7), (3, 4, 5)),
    "shift": sitk.TranslationTransform(3, (1, 2, 3)),
}
ZYX = sitk.Euler3DTransform((10, 20, 30), 0.1, 0.2, -0.3, (1, 2, 3))
ZYX.SetComputeZYX(True)


@pytest.mark.parametrize("suffix", [".mat", ".tfm", ".txt", ".h5"])
@pytest.mark.parametrize("name", [*RIGID, "zyx"])
def test_linear_transforms_move_points_as_itk_does(here, name, suffix):
    transform, points = RIGID.get(name, ZYX), 100.0 * rng.normal(size=(1000, 3))
    sitk.WriteTransform(transform, f"t{suffix}")
    moved = load_transform(f"t{suffix}")(points)
    assert_allclose(moved, by_itk(transform, points), rtol=0, atol=1e-10)
    assert_allclose(load_transform(f"t{suffix}", inverse=True)(moved), points, rtol=0, atol=1e-10)


def test_a_dense_field_moves_points_as_itk_does_to_its_faces(here):
    image = field_image()
    sitk.WriteImage(image, "warp.nii.gz")
    read = sitk.ReadImage("warp.nii.gz")  # whose place, in 32 bits, ITK makes orthogonal again
    points = points_in(read)
    moved = load_transform("warp.nii.gz")(points)
    assert np.abs(moved - points).max() > 3.0
    assert_allclose(moved, by_itk(dense(read), points), rtol=0, atol=1e-6)


def test_displacements_of_intent_1006_are_ras_as_in_itk(here):
    sitk.WriteImage(field_image(), "warp.nii")
    image = nibabel.load("warp.nii")
    image.header["intent_code"] = 1006
    nibabel.save(image, "other.nii")
    read = sitk.ReadImage("other.nii")
    points = points_in(read)
    assert_allclose(load_transform("other.nii")(points), by_itk(dense(read), points), atol=1e-6)


def test_a_composite_and_the_same_files_in_ants_order_move_points_as_itk_does(here):
    """ITK's composite applies the transform that was added last to points first: ANTs writes the
    affine first, and is given the warp first.
    """
    image, A = field_image(), RIGID["affine"]
    sitk.WriteImage(image, "warp.nii.gz")
    read = sitk.ReadImage("warp.nii.gz")
    both = sitk.CompositeTransform([A, dense(read)])
    sitk.WriteTransform(both, "both.h5")
    sitk.WriteTransform(A, "affine.mat")
    points = points_in(read)
    expected = by_itk(both, points)
    assert_allclose(load_transform("both.h5")(points), expected, rtol=0, atol=1e-9)
    assert_allclose(load_transform("warp.nii.gz", "affine.mat")(points), expected, atol=1e-6)
    with pytest.raises(InputError, match=r"^warp\.nii\.gz: its field does not cover \d+ of 1000"):
        load_transform("affine.mat", "warp.nii.gz")(points)


def test_an_inverse_undoes_a_field_and_an_affine(here):
    image = field_image()
    sitk.WriteTransform(sitk.CompositeTransform([RIGID["affine"], dense(image)]), "both.h5")
    points = points_in(image, margin=3.0)
    moved = load_transform("both.h5")(points)
    assert_allclose(load_transform("both.h5", inverse=True)(moved), points, rtol=0, atol=1e-8)


def test_a_fold_has_no_inverse(here):
    image = field_image()
    folded = sitk.GetImageFromArray(8.0 * sitk.GetArrayFromImage(image), isVector=True)
    folded.CopyInformation(image)
    sitk.WriteImage(folded, "warp.nii.gz")
    with pytest.raises(InputError, match=r"no inverse at \d+ of 1000 points: it folds"):
        load_transform("warp.nii.gz", inverse=True)(points_in(image))


def mapped(matrix, points):
    """In 64 bits; nitransforms' own maps are in 32."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def oblique(flip, shape):
    turn = np.array(sitk.Euler3DTransform((0, 0, 0), 0.1, 0.2, -0.3).GetMatrix()).reshape(3, 3)
    affine = np.eye(4)
    affine[:3] = np.column_stack([turn * [flip * 2.0, 2.5, 3.0], [5.0, -7.0, 9.0]])
    return Image(np.zeros(shape), affine)


@pytest.mark.parametrize("flips", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_fsl_matrices_move_points_as_nitransforms_does(here, flips):
    """Its two images have x flipped where the determinant is positive."""
    fixed, moving = oblique(flips[0], (20, 24, 18)), oblique(flips[1], (31, 17, 22))
    theirs = [nibabel.Nifti1Image(each.data, each.affine) for each in (fixed, moving)]
    matrix = np.eye(4)
    matrix[:3] += 0.1 * rng.normal(size=(3, 4))
    np.savetxt("flirt.mat", matrix, fmt="%.10f")
    expected = Affine.from_filename("flirt.mat", fmt="fsl", reference=theirs[0], moving=theirs[1])
    points = 50.0 * rng.normal(size=(1000, 3))
    move = load_transform("flirt.mat", fixed=fixed, moving=moving)
    assert_allclose(move(points), mapped(expected.matrix, points), rtol=0, atol=1e-9)


def test_afni_matrices_move_points_as_nitransforms_does(here):
    rows = np.eye(3, 4) + 0.1 * rng.normal(size=(3, 4))
    text = "# 3dAllineate matrices (DICOM-to-DICOM, row-by-row):\n"
    with open("a.aff12.1D", "w") as file:
        file.write(text + " ".join(f"{each:.12g}" for each in rows.ravel()) + "\n")
    points = 50.0 * rng.normal(size=(1000, 3))
    expected = mapped(Affine.from_filename("a.aff12.1D", fmt="afni").matrix, points)
    assert_allclose(load_transform("a.aff12.1D")(points), expected, rtol=0, atol=1e-9)


def spm_deformation(name, affine, shape, move, about="Deformation"):
    """A field of places, as SPM's Segment and Normalise write."""
    index = np.moveaxis(np.indices(shape), 0, -1)
    places = move(index @ affine[:3, :3].T + affine[:3, 3])
    header = nibabel.Nifti1Header()
    header["descrip"] = about
    header.set_data_dtype(np.float64)
    nibabel.save(nibabel.Nifti1Image(places[:, :, :, None], affine, header), name)


@pytest.mark.parametrize(
    ("name", "about"), [("y_T1.nii", "Deformation"), ("d.nii", "Deformation"), ("iy_T1.nii", "")]
)
def test_spm_deformations_have_the_places_themselves(here, name, about):
    affine = oblique(1, (1, 1, 1)).affine.astype(np.float32).astype(float)
    A = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    spm_deformation(name, affine, (12, 11, 10), lambda x: x @ A + [5.0, 0.0, -3.0], about)
    points = rng.uniform(0, 9, size=(1000, 3)) @ affine[:3, :3].T + affine[:3, 3]
    moved = load_transform(name)(points)
    assert_allclose(moved, points @ A + [5.0, 0.0, -3.0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("shift", [0.0, 40.0])
def test_displacements_with_the_name_of_spm_s_places_are_refused(here, shift):
    """Also large ones, which alone would be places within the image."""
    image = field_image()
    moved = sitk.GetImageFromArray(sitk.GetArrayFromImage(image) + shift, isVector=True)
    moved.CopyInformation(image)
    sitk.WriteImage(moved, "y_to_x_1Warp.nii.gz")
    with pytest.raises(InputError, match=r"named as SPM's deformation .* give .* another name"):
        load_transform("y_to_x_1Warp.nii.gz")


def test_niftyreg_s_deformation_is_refused(here):
    spm_deformation("cpp.nii", np.eye(4), (5, 5, 5), lambda x: x, about="")
    image = nibabel.load("cpp.nii")
    image.header.set_intent("vector", name="NREG_TRANS")
    nibabel.save(image, "cpp.nii.gz")
    with pytest.raises(InputError, match=r"got NiftyReg's \(NREG_TRANS\); write .*reg_transform"):
        load_transform("cpp.nii.gz")


def write(name, text):
    with open(name, "wb") as file:
        file.write(text if isinstance(text, bytes) else text.encode())
    return name


def saved(values, name="f.nii.gz", intent=1007):
    image = nibabel.Nifti1Image(values, np.eye(4))
    image.header["intent_code"] = intent
    nibabel.save(image, name)
    return name


def of_itk(transform, name):
    sitk.WriteTransform(transform, name)
    return name


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: "none.mat", "none.mat: no such file; expected a transform"),
        (lambda: write("t.mat", "1 0 0 0 0 1 0 0"), "expected a transform of ITK.*got 8 numbers"),
        (lambda: write("t.txt", "a b c"), "damaged; copy it again .*could not convert"),
        (lambda: write("t.mat", b"\x00\x01"), "t.mat: truncated or damaged"),
        (lambda: write("t.h5", "no"), "t.h5: truncated or damaged"),
        (lambda: write("a.1D", "1 0 0 0 0 1 0 0 0 0 0 0"), "its matrix is singular"),
        (lambda: write("f.mat", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"), "pass `fixed` and `image`"),
        (lambda: of_itk(sitk.AffineTransform(2), "t.tfm"), "expected a transform in 3-D"),
        (lambda: of_itk(sitk.ScaleTransform(3), "t.mat"), "ScaleTransform: no such transform"),
        (lambda: saved(np.zeros((4, 4, 4))), r"expected a dense field, .*got \(4, 4, 4\)"),
        (lambda: saved(np.zeros((4, 4, 4, 3))), r"got \(4, 4, 4, 3\); of fnirt"),
        (lambda: saved(np.zeros((4, 4, 4, 1, 3)), intent=0), "vectors' axes are not stated"),
        (lambda: write("f.nii.gz", "no"), "f.nii.gz: truncated or damaged"),
    ],
)
def test_bad_files_are_refused_in_one_line(here, make, words):
    name = make()
    with pytest.raises(InputError, match=words) as caught:
        load_transform(name)
    assert str(caught.value).startswith(name)
    assert "\n" not in str(caught.value)


def text_of_itk(kind, values, fixed):
    lines = "#Insight Transform File V1.0\n#Transform 0\n"
    words = [
        f"{name}: {' '.join(map(str, each))}\n"
        for name, each in zip(("Parameters", "FixedParameters"), (values, fixed), strict=True)
    ]
    return f"{lines}Transform: {kind}_double_3_3\n{''.join(words)}"


UNIT = [1, 0, 0, 0, 1, 0, 0, 0, 1]


@pytest.mark.parametrize(
    ("kind", "values", "fixed", "words"),
    [
        *[
            ("AffineTransform", [*UNIT, 1, 2, 3, 4][:n], [0] * 3, f"expected 12 .*got {n} and 3")
            for n in (9, 10, 11, 13)
        ],
        ("AffineTransform", [*UNIT, 1, 2, 3], [], "12 parameters and 3 fixed ones, got 12 and 0"),
        ("AffineTransform", [*UNIT, 1, 2, 3], [1], "got 12 and 1"),
        ("Euler3DTransform", [0, 0], [0] * 3, "6 parameters and 3 or 4 fixed ones, got 2 and 3"),
        ("Similarity3DTransform", [0] * 6, [0] * 3, "expected 7 parameters .*got 6"),
        ("TranslationTransform", [1], [], "expected 3 parameters .*got 1"),
        ("VersorRigid3DTransform", [1, 1, 0, 0, 0, 0], [0] * 3, "norm up to 1, got 1.414"),
        ("DisplacementFieldTransform", [0] * 23, [2, 2, 2, 0, 0, 0, 1, 1, 1, *UNIT], "per voxel"),
        ("DisplacementFieldTransform", [0] * 24, [2, 2, 2] + [0] * 15, "singular"),
        ("DisplacementFieldTransform", [0] * 24, [2, 2, 2], "18 fixed ones, got 24 and 3"),
        ("DisplacementFieldTransform", [0] * 24, [8, 1], "18 fixed ones, got 24 and 2"),
    ],
)
def test_other_numbers_of_parameters_are_refused(here, kind, values, fixed, words):
    with pytest.raises(InputError, match=rf"^t\.tfm: .*{words}"):
        load_transform(write("t.tfm", text_of_itk(kind, values, fixed)))


def test_a_transposed_matrix_is_refused(here):
    name = write("f.mat", "1 0 0 0 0 1 0 0 0 0 1 0 5 6 7 1")
    with pytest.raises(InputError, match=r"last row is 0 0 0 1, got .*5\.0, 6\.0, 7\.0"):
        load_transform(name, fixed=oblique(1, (4, 4, 4)), moving=oblique(1, (4, 4, 4)))


def test_hdf5_without_h5py_names_it(here, monkeypatch):
    sitk.WriteTransform(RIGID["shift"], "t.h5")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r't\.h5: transforms in HDF5 need h5py; pip install "h5py"'
    ):
        load_transform("t.h5")
