"""Files to images: every voxel's value and place, and one line for every file that cannot be
used.
"""

import gzip
import hashlib
import itertools
import os
import re
import sys
import warnings
from pathlib import Path

import nibabel
import numpy as np
import PIL.Image
import pytest

from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io import images
from tetopt.io.images import (
    crop_image,
    file_shape,
    image_slice,
    load_image,
    parse_crop,
    parse_slice,
    save_image,
    sha256,
)
from tetopt.io.read_dicom import _unevenness

# Rotated, sheared, anisotropic and flipped (negative determinant), with an origin.
OBLIQUE = np.array(
    [
        [-0.75, 0.31, 1.10, 12.5],
        [0.12, 0.68, -0.90, -33.0],
        [0.05, -0.22, 5.10, 7.25],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
DAMAGED = "truncated or damaged"


def ramp(*shape, dtype=np.int16):
    """Every voxel another value, so that no swap of axes goes unseen."""
    return np.arange(np.prod(shape)).reshape(shape).astype(dtype)


def save_nifti(path, data, affine=OBLIQUE, **header):
    image = nibabel.Nifti1Image(data, affine)
    for name, value in header.items():
        image.header[name] = value
    nibabel.save(image, path)
    return path


def assert_refused(path, match, **options):
    """`load_image` raises InputError in one line, which starts with the path and goes on to
    match `match`.
    """
    with pytest.raises(InputError, match=re.escape(f"{path}: ") + ".*" + match) as caught:
        load_image(path, **options)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


# --------------------------------------------------------------------------------------------------
# NIfTI and MGZ


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "A.NII", "A.NII.GZ"])
def test_nifti_keeps_values_and_affine(tmp_path, name):
    data = ramp(3, 4, 5)
    path = save_nifti(tmp_path / name.lower(), data).rename(tmp_path / name)
    image = load_image(path)
    np.testing.assert_array_equal(image.data, data)
    assert image.data.dtype == np.float32
    # the header's precision
    np.testing.assert_array_equal(image.affine, OBLIQUE.astype(np.float32))


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.mgz", "a.nrrd", "a.mha", "a.png"])
def test_shape_without_voxels(tmp_path, name, monkeypatch):
    """The header tells it, or nothing does."""
    path = tmp_path / name
    if name.endswith(("nii", "gz", "mgz")):
        kind = nibabel.MGHImage if name.endswith("mgz") else nibabel.Nifti1Image
        nibabel.save(kind(np.zeros((5, 4, 3, 2), np.float32), np.eye(4)), path)
    elif name.endswith("png"):
        PIL.Image.fromarray(np.arange(20, dtype=np.uint8).reshape(5, 4)).save(path)
    else:
        sitk = pytest.importorskip("SimpleITK")
        sitk.WriteImage(sitk.GetImageFromArray(np.zeros((3, 4, 5), np.int16)), str(path))
    monkeypatch.setattr(images, "load_image", None)
    expected = {"png": None, "rrd": (5, 4, 3), "mha": (5, 4, 3)}.get(name[-3:], (5, 4, 3, 2))
    assert images.file_shape(path) == expected
    assert images.file_shape(tmp_path) is None  # DICOM, for all that is known
    if expected is not None:
        path.write_bytes(b"something else")
        with pytest.raises(InputError, match=rf"^{re.escape(str(path))}: \S+ [^\n]+$"):
            images.file_shape(path)


@pytest.mark.parametrize(
    "axes",
    [
        "kinds: list domain domain domain\nspace directions: none (1,0,0) (0,1,0) (0,0,1)",
        "kinds: vector space space space",
        "space directions: none (1,0,0) (0,1,0) (0,0,1)",
    ],
)
def test_axes_of_space_come_first_in_the_shape(tmp_path, axes):
    """Segments in layers and components stand first in an NRRD, and last in an image."""
    head = f"NRRD0004\ntype: uchar\ndimension: 4\nsizes: 2 5 4 3\nencoding: raw\n{axes}\n\n"
    (tmp_path / "a.nrrd").write_bytes(head.encode() + bytes(120))
    assert file_shape(tmp_path / "a.nrrd") == (5, 4, 3, 2)


PAIRS = {  # names of the two files as nibabel writes them, and renamed
    "plain": ("a.hdr", "a.img", "a.hdr", "a.img"),
    "packed": ("a.hdr.gz", "a.img.gz", "a.hdr.gz", "a.img.gz"),
    "header packed": ("a.hdr.gz", "a.img.gz", "a.hdr.gz", None),
    "voxels packed": ("a.hdr.gz", "a.img.gz", None, "a.img.gz"),
    "upper case": ("a.hdr", "a.img", "A.HDR", "A.IMG"),
}


@pytest.mark.parametrize("kind", [nibabel.Nifti1Pair, nibabel.Nifti2Pair])
@pytest.mark.parametrize("name", PAIRS)
def test_nifti_pair(tmp_path, name, kind):
    """Either file, whatever is packed: the voxels, place and shape; the checksum is of both."""
    *written, header, voxels = PAIRS[name]
    files = [tmp_path / each for each in written]
    kept = [
        tmp_path / (each or was.removesuffix(".gz"))
        for was, each in zip(written, (header, voxels), strict=True)
    ]
    nibabel.save(kind(ramp(3, 4, 5, 2), OBLIQUE), files[1])
    for file, path in zip(files, kept, strict=True):
        file.rename(path)
        if path.suffix != ".gz" and file.suffix == ".gz":
            path.write_bytes(gzip.decompress(path.read_bytes()))
    raw = [path.read_bytes() for path in kept]
    for k, path in enumerate(kept):
        image = load_image(path, volume=1)
        np.testing.assert_array_equal(image.data, ramp(3, 4, 5, 2)[..., 1])
        np.testing.assert_allclose(image.affine, OBLIQUE, rtol=1e-6)
        assert file_shape(path) == (3, 4, 5, 2)
        assert sha256(path) == hashlib.sha256(raw[k] + raw[1 - k]).hexdigest()
        assert_refused(path, "has 2 volumes")


@pytest.mark.parametrize(
    ("gone", "left", "words"),
    [
        ("a.img", "a.hdr", r"its voxels should be in a.img \(or a.img.gz\) next to it; copy both"),
        ("a.hdr", "a.img", r"its header, .* should be in a.hdr \(or a.hdr.gz\) next to it"),
    ],
)
def test_one_file_of_a_pair(tmp_path, gone, left, words):
    nibabel.save(nibabel.Nifti1Pair(ramp(3, 4, 5), OBLIQUE), tmp_path / "a.img")
    (tmp_path / gone).unlink()
    assert_refused(tmp_path / left, words)
    (tmp_path / gone).mkdir()
    assert_refused(tmp_path / left, f'its other file "{gone}" is a folder')


def test_damaged_pairs(tmp_path):
    path = tmp_path / "a.hdr"
    nibabel.save(nibabel.Nifti1Pair(ramp(3, 4, 5), OBLIQUE), tmp_path / "a.img")
    whole = (tmp_path / "a.img").read_bytes()
    (tmp_path / "a.img").write_bytes(whole[:-1])
    assert_refused(path, f"{DAMAGED}.*declares 3 x 4 x 5 voxels, 120 bytes, but the file has 119")
    (tmp_path / "a.img").write_bytes(whole + bytes(24))
    assert "24 more bytes after them" in warnings_of(path)[0]
    path.write_text("ENVI\nsamples = 3\n")
    assert_refused(path, f"{DAMAGED}, or not an image of this kind")
    for endianness in "<>":
        header = nibabel.AnalyzeHeader(endianness=endianness)
        header.set_data_shape((3, 4, 5))
        path.write_bytes(header.binaryblock)
        for each in (path, tmp_path / "a.img"):
            assert_refused(each, "an Analyze 7.5 image, whose format does not tell left from")


@pytest.mark.parametrize("name", ["A.Nii.GZ", "a.MGz"])
def test_suffix_in_any_case(tmp_path, name):
    kind = nibabel.MGHImage if "MG" in name else nibabel.Nifti1Image
    nibabel.save(kind(ramp(3, 4, 5, dtype=np.int32), np.eye(4)), tmp_path / name.lower())
    (tmp_path / name.lower()).rename(tmp_path / name)
    np.testing.assert_array_equal(load_image(tmp_path / name).data, ramp(3, 4, 5))


def test_a_gzip_file_is_unpacked_once(tmp_path, monkeypatch):
    path, blocks = save_nifti(tmp_path / "a.nii.gz", ramp(3, 4, 5, 2)), []
    read = gzip.GzipFile.read
    monkeypatch.setattr(gzip.GzipFile, "read", lambda *a: blocks.append(read(*a)) or blocks[-1])
    load_image(path, volume=0)
    # the header, and then the whole
    assert sum(map(len, blocks[1:])) == 352 + ramp(3, 4, 5, 2).nbytes


def test_path_may_be_a_string(tmp_path):
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5))
    np.testing.assert_array_equal(load_image(str(path)).data, ramp(3, 4, 5))


@pytest.mark.parametrize("flips", list(itertools.product([1.0, -1.0], repeat=3)))
def test_flipped_axes(tmp_path, flips):
    affine = np.diag([*flips, 1.0]) * np.array([2.0, 0.5, 4.0, 1.0])
    affine[:3, 3] = [1.0, 2.0, 3.0]
    image = load_image(save_nifti(tmp_path / "a.nii", ramp(3, 4, 5), affine))
    np.testing.assert_array_equal(image.affine, affine)
    np.testing.assert_array_equal(image.data, ramp(3, 4, 5))


def test_qform_where_there_is_no_sform(tmp_path):
    affine = np.array(
        [[0.0, -2.0, 0.0, 1.0], [3.0, 0.0, 0.0, 2.0], [0.0, 0.0, 4.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
    )
    file = nibabel.Nifti1Image(ramp(3, 4, 5), None)
    file.set_qform(affine, code=1)
    file.set_sform(None, code=0)
    nibabel.save(file, tmp_path / "a.nii")
    np.testing.assert_allclose(load_image(tmp_path / "a.nii").affine, affine, rtol=0, atol=1e-6)


def test_sform_wins_over_qform(tmp_path):
    file = nibabel.Nifti1Image(ramp(3, 4, 5), None)
    file.set_qform(np.diag([9.0, 9.0, 9.0, 1.0]), code=1)
    file.set_sform(np.diag([2.0, 3.0, 4.0, 1.0]), code=1)
    nibabel.save(file, tmp_path / "a.nii")
    np.testing.assert_array_equal(
        load_image(tmp_path / "a.nii").affine, np.diag([2.0, 3.0, 4.0, 1.0])
    )


def test_scaled_nifti(tmp_path):
    file = nibabel.Nifti1Image(ramp(3, 4, 5), OBLIQUE)
    file.header.set_slope_inter(0.5, -1024.0)
    nibabel.save(file, tmp_path / "a.nii.gz")
    stored = np.asarray(nibabel.load(tmp_path / "a.nii.gz").dataobj.get_unscaled())
    assert stored.dtype == np.int16
    image = load_image(tmp_path / "a.nii.gz")
    np.testing.assert_array_equal(image.data, 0.5 * stored - 1024.0)
    assert image.data.max() < 0  # the intercept did arrive


@pytest.mark.parametrize(
    ("unit", "mm"), [("unknown", 1.0), ("mm", 1.0), ("meter", 1000.0), ("micron", 0.001)]
)
def test_spatial_units(tmp_path, unit, mm):
    file = nibabel.Nifti1Image(ramp(3, 4, 5), np.diag([2.0, 3.0, 4.0, 1.0]))
    file.header.set_xyzt_units(unit)
    nibabel.save(file, tmp_path / "a.nii")
    np.testing.assert_array_equal(
        load_image(tmp_path / "a.nii").affine, np.diag([2 * mm, 3 * mm, 4 * mm, 1])
    )


def test_unit_outside_of_the_standard_is_mm(tmp_path):
    path = save_nifti(
        tmp_path / "a.nii", ramp(3, 4, 5), np.diag([2.0, 3.0, 4.0, 1.0]), xyzt_units=7
    )
    np.testing.assert_array_equal(load_image(path).affine, np.diag([2.0, 3.0, 4.0, 1.0]))


def test_integers_beyond_single_precision(tmp_path):
    data = ramp(3, 4, 5, dtype=np.int32) + 2**24
    image = load_image(save_nifti(tmp_path / "a.nii", data))
    np.testing.assert_array_equal(image.data, data)
    assert image.data.dtype == np.float64


def test_mgh_of_no_voxels_is_refused(tmp_path):
    (tmp_path / "a.mgh").write_bytes(b"\0\0\0\1" + bytes(400))
    with pytest.raises(InputError, match="not an image of this kind"):
        load_image(tmp_path / "a.mgh")


@pytest.mark.parametrize("name", ["a.mgz", "a.mgh", "A.MGZ", "a.Mgz"])
def test_mgh_round_trip(tmp_path, name):
    # MGH holds a rotation, voxel sizes and the centre; no shear.
    affine = np.array(
        [[-1.0, 0.0, 0.0, 10.0], [0.0, 0.0, 2.0, 20.0], [0.0, -0.5, 0.0, 30.0], [0, 0, 0, 1.0]]
    )
    data = ramp(3, 4, 6, dtype=np.float32)
    nibabel.save(nibabel.MGHImage(data, affine), tmp_path / name.lower())
    (tmp_path / name.lower()).rename(tmp_path / name)
    image = load_image(tmp_path / name)
    np.testing.assert_array_equal(image.data, data)
    np.testing.assert_array_equal(image.affine, affine)


def test_big_endian_file(data_dir):
    path = data_dir / "tiny_anatomical.nii"
    image = load_image(path)
    raw = np.fromfile(path, dtype=">i2", offset=352).reshape((33, 41, 25), order="F")
    np.testing.assert_array_equal(image.data, raw)
    assert (image.data.min(), image.data.max()) == (-610.0, 30393.0)
    assert image.data.dtype == np.dtype("=f4")
    np.testing.assert_array_equal(image.affine[:3, :3], np.diag([-2.0, 2.0, 2.0]))
    np.testing.assert_array_equal(image.affine, nibabel.load(path).affine)


def test_oblique_anisotropic_file(data_dir):
    path = data_dir / "brain_flair_oblique_aniso.nii.gz"
    image = load_image(path)
    np.testing.assert_array_equal(image.affine, nibabel.load(path).affine)
    np.testing.assert_allclose(image.spacing, [0.75, 0.75, 5.5], rtol=1e-3)
    assert image.shape == (320, 320, 26)


# --------------------------------------------------------------------------------------------------
# Volumes


@pytest.mark.parametrize("k", [0, 1])
def test_one_volume_of_a_4d_file(data_dir, k):
    path = data_dir / "example4d.nii.gz"
    file = nibabel.load(path)
    image = load_image(path, volume=k)
    np.testing.assert_array_equal(image.data, np.asanyarray(file.dataobj)[..., k])
    np.testing.assert_array_equal(image.affine, file.affine)


def test_4d_file_needs_a_volume(data_dir):
    assert_refused(
        data_dir / "example4d.nii.gz",
        "has 2 volumes; choose one from 0 to 1: `volume=k`, `volume` K",
    )


@pytest.mark.parametrize("k", [-1, 2])
def test_volume_out_of_range(data_dir, k):
    words = f"expected a volume from 0 to 1, got {k}: the file has 2 volumes"
    assert_refused(data_dir / "example4d.nii.gz", words, volume=k)


def test_other_volumes_are_not_read(tmp_path):
    """The first of three volumes can be had from an uncompressed file that ends after it."""
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5, 3))
    path.write_bytes(path.read_bytes()[: 352 + 3 * 4 * 5 * 2])
    np.testing.assert_array_equal(load_image(path, volume=0).data, ramp(3, 4, 5, 3)[..., 0])
    assert_refused(path, DAMAGED, volume=1)


def test_fourth_axis_runs_fastest(tmp_path):
    data = ramp(3, 4, 5, 2, 3)
    path = save_nifti(tmp_path / "a.nii", data)
    for k in range(6):
        np.testing.assert_array_equal(load_image(path, volume=k).data, data[..., k % 2, k // 2])
    assert_refused(path, "has 6 volumes")


def test_trailing_axes_of_length_one(tmp_path):
    # nibabel would drop the last ones itself, so the long one stands last.
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5, 1, 2))
    np.testing.assert_array_equal(load_image(path, volume=1).data, ramp(3, 4, 5, 1, 2)[..., 0, 1])
    path = save_nifti(tmp_path / "b.nii", ramp(3, 4, 5, 1, 1))
    assert nibabel.load(path).ndim == 5
    np.testing.assert_array_equal(load_image(path).data, ramp(3, 4, 5))


def test_volume_of_a_3d_file(tmp_path):
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5))
    np.testing.assert_array_equal(load_image(path, volume=0).data, ramp(3, 4, 5))
    assert_refused(path, "expected a volume from 0 to 0, got 1: the file has one volume", volume=1)


def test_one_slice_volume_stays_3d(tmp_path):
    assert load_image(save_nifti(tmp_path / "a.nii", ramp(3, 4, 1))).shape == (3, 4, 1)


def test_2d_nifti_is_a_plane(tmp_path):
    image = load_image(save_nifti(tmp_path / "a.nii", ramp(3, 4), np.diag([2.0, -3.0, 4.0, 1.0])))
    np.testing.assert_array_equal(image.data, ramp(3, 4))
    np.testing.assert_array_equal(image.affine, np.diag([2.0, -3.0, 1.0]))


# --------------------------------------------------------------------------------------------------
# NRRD, MetaImage and DICOM


@pytest.fixture(scope="module")
def sitk():
    return pytest.importorskip("SimpleITK")


def assert_placed_as_in_itk(image, reference):
    """Each corner voxel and a middle one: ITK's value and ITK's LPS point turned to RAS."""
    assert image.shape == reference.GetSize()
    for index in [
        *itertools.product(*((0, s - 1) for s in image.shape)),
        tuple(s // 2 for s in image.shape),
    ]:
        point = np.array(reference.TransformIndexToPhysicalPoint(index)) * [-1, -1, 1]
        np.testing.assert_allclose(image.to_world(index), point, rtol=0, atol=1e-9)
        assert image.data[index] == reference.GetPixel(index)


@pytest.mark.parametrize("name", ["ct_lung_small.mha", "prostate_phantom_subvolume.nrrd"])
def test_real_file_against_itk(data_dir, sitk, name):
    image = load_image(data_dir / name)
    reference = sitk.ReadImage(str(data_dir / name))
    assert_placed_as_in_itk(image, reference)
    np.testing.assert_array_equal(image.data.T, sitk.GetArrayFromImage(reference))


def oblique_sitk_image(sitk, data):
    image = sitk.GetImageFromArray(np.ascontiguousarray(data.T), isVector=False)
    image.SetSpacing([0.5, 0.75, 3.0])
    image.SetOrigin([10.0, -20.0, 30.0])
    image.SetDirection(rotation().ravel())
    return image


def rotation():
    """A rotation by 0.3 about z after one by 0.4 about x."""
    c, s, d, t = np.cos(0.3), np.sin(0.3), np.cos(0.4), np.sin(0.4)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array(
        [[1, 0, 0], [0, d, -t], [0, t, d]]
    )


@pytest.mark.parametrize("name", ["a.nrrd", "a.nhdr", "a.mha", "a.mhd", "A.MHA", "A.NRRD"])
def test_oblique_itk_formats(tmp_path, sitk, name):
    sitk.WriteImage(oblique_sitk_image(sitk, ramp(4, 5, 6)), str(tmp_path / name.lower()))
    (tmp_path / name.lower()).rename(tmp_path / name)
    image = load_image(tmp_path / name)
    assert_placed_as_in_itk(image, oblique_sitk_image(sitk, ramp(4, 5, 6)))
    np.testing.assert_array_equal(image.data, ramp(4, 5, 6))


@pytest.mark.parametrize("suffix", [".nrrd", ".mha"])
def test_same_world_as_nifti(tmp_path, sitk, suffix):
    """ITK writes one image in both formats; we read it back through two libraries to the same
    place.
    """
    for name in (f"a{suffix}", "a.nii"):
        sitk.WriteImage(oblique_sitk_image(sitk, ramp(4, 5, 6)), str(tmp_path / name))
    ours, theirs = load_image(tmp_path / f"a{suffix}"), load_image(tmp_path / "a.nii")
    np.testing.assert_array_equal(ours.data, theirs.data)
    np.testing.assert_allclose(ours.affine, theirs.affine, rtol=0, atol=1e-5)


def test_volume_of_a_4d_metaimage(tmp_path, sitk):
    data = ramp(3, 4, 5, 2)
    image = sitk.GetImageFromArray(np.ascontiguousarray(data.T), isVector=False)
    image.SetSpacing([2.0, 3.0, 4.0, 7.0])
    image.SetOrigin([10.0, 20.0, 30.0, 40.0])
    path = tmp_path / "a.mha"
    sitk.WriteImage(image, str(path))
    for k in (0, 1):
        loaded = load_image(path, volume=k)
        np.testing.assert_array_equal(loaded.data, data[..., k])
        np.testing.assert_array_equal(
            loaded.affine, [[-2, 0, 0, -10], [0, -3, 0, -20], [0, 0, 4, 30], [0, 0, 0, 1]]
        )
    assert_refused(path, "has 2 volumes")
    assert_refused(path, "got 2: the file has 2 volumes", volume=2)


def test_2d_metaimage(tmp_path, sitk):
    image = sitk.GetImageFromArray(np.ascontiguousarray(ramp(3, 4).T))
    image.SetSpacing([2.0, 3.0])
    sitk.WriteImage(image, str(tmp_path / "a.mha"))
    np.testing.assert_array_equal(load_image(tmp_path / "a.mha").data, ramp(3, 4))
    np.testing.assert_array_equal(load_image(tmp_path / "a.mha").affine, np.diag([-2.0, -3.0, 1.0]))


@pytest.mark.parametrize("suffix", [".nrrd", ".mha"])
def test_vector_pixels_are_refused(tmp_path, sitk, suffix):
    path = tmp_path / f"a{suffix}"
    sitk.WriteImage(
        sitk.GetImageFromArray(np.zeros((3, 4, 5, 3), np.uint8), isVector=True), str(path)
    )
    assert_refused(path, "one number per voxel, got 3")


def test_complex_metaimage_is_refused(tmp_path, sitk):
    path = tmp_path / "a.nrrd"
    sitk.WriteImage(sitk.Image([3, 4, 5], sitk.sitkComplexFloat32), str(path))
    assert_refused(path, "got complex ones|one number per voxel, got 2")


@pytest.mark.apart
@pytest.mark.parametrize("name", ["ct_lung_small.mha", "prostate_phantom_subvolume.nrrd"])
@pytest.mark.usefixtures("sitk")
def test_truncated_itk_file(data_dir, tmp_path, name):
    path = tmp_path / name
    path.write_bytes((data_dir / name).read_bytes()[:30000])
    assert_refused(path, DAMAGED)


@pytest.mark.apart
@pytest.mark.parametrize("suffix", [".nrrd", ".nhdr", ".mha", ".mhd", ".dcm"])
@pytest.mark.usefixtures("sitk")
def test_garbage_itk_file(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"hello " * 200)
    assert_refused(path, DAMAGED)


@pytest.mark.usefixtures("sitk")
def test_header_without_its_data_file(tmp_path):
    path = tmp_path / "a.mhd"
    path.write_text(
        "NDims = 3\nDimSize = 3 4 5\nElementType = MET_SHORT\nElementDataFile = gone.raw\n"
    )
    assert_refused(path, DAMAGED)


@pytest.mark.parametrize(
    ("name", "package"),
    [("a.nrrd", "SimpleITK"), ("a.mha", "SimpleITK"), ("a.dcm", "pydicom"), ("folder", "pydicom")],
)
def test_without_a_library(tmp_path, monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    else:
        path.write_bytes(b"hello")
    assert_refused(path, f'pip install "{package}(>=[0-9.]+)?"')


def test_nifti_does_not_need_simpleitk(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    assert load_image(save_nifti(tmp_path / "a.nii", ramp(3, 4, 5))).shape == (3, 4, 5)


def write_dicom(sitk, folder, data, *, uid="1.2.3.4", step=None, skip=(), turned=(), places=99):
    """A series of oblique slices, named in another order than they lie; returns the RAS affine."""
    folder.mkdir(exist_ok=True)
    spacing, origin, axes = np.array([0.5, 0.75, 3.0]), np.array([10.0, -20.0, 30.0]), rotation()
    step = axes[:, 2] * spacing[2] if step is None else step
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k in set(range(data.shape[2])) - set(skip):
        image = sitk.GetImageFromArray(np.ascontiguousarray(data[:, :, k].T)[None])
        in_plane = axes[:, [1, 2]] if k in turned else axes[:, :2]
        tags = {
            "0008|0016": "1.2.840.10008.5.1.4.1.1.4",
            "0008|0018": f"{uid}.{k + 1}",
            "0008|0060": "MR",
            "0020|000d": "1.2.3",
            "0020|000e": uid,
            "0020|0013": str(k + 1),
            "0020|0032": "\\".join(f"{x:.9f}" for x in origin + k % places * step),
            "0020|0037": "\\".join(f"{x:.11f}" for x in in_plane.T.ravel()),
        }
        for tag, value in tags.items():
            image.SetMetaData(tag, value)
        image.SetSpacing(spacing)
        writer.SetFileName(str(folder / f"{uid}_{(k * 7) % 11}.dcm"))
        writer.Execute(image)
    affine = np.eye(4)
    affine[:3, :3] = np.column_stack([axes[:, 0] * spacing[0], axes[:, 1] * spacing[1], step])
    affine[:3, 3] = origin
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine


def test_oblique_dicom_folder(tmp_path, sitk):
    affine = write_dicom(sitk, tmp_path / "d", ramp(6, 5, 4))
    image = load_image(tmp_path / "d")
    np.testing.assert_array_equal(image.data, ramp(6, 5, 4))
    np.testing.assert_allclose(image.affine, affine, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(load_image(tmp_path / "d", volume=0).data, ramp(6, 5, 4))
    assert_refused(tmp_path / "d", "expected a volume from 0 to 0", volume=1)


def test_tilted_gantry_keeps_its_shear(tmp_path, sitk):
    affine = write_dicom(sitk, tmp_path / "d", ramp(6, 5, 4), step=rotation() @ [0.0, 0.8, 3.0])
    image = load_image(tmp_path / "d")
    np.testing.assert_array_equal(image.data, ramp(6, 5, 4))
    np.testing.assert_allclose(image.affine, affine, rtol=0, atol=1e-7)


def test_single_dicom_file(tmp_path, sitk):
    affine = write_dicom(sitk, tmp_path / "d", ramp(6, 5, 4), skip=(0, 1, 2))
    path = next((tmp_path / "d").iterdir())
    for source in (path, tmp_path / "d"):
        image = load_image(source)
        np.testing.assert_array_equal(image.data, ramp(6, 5, 4)[:, :, 3:])
        np.testing.assert_allclose(
            image.to_world([0, 0, 0]), (affine @ [0, 0, 3, 1])[:3], rtol=0, atol=1e-7
        )
        np.testing.assert_allclose(image.affine[:3, :2], affine[:3, :2], rtol=0, atol=1e-7)


def test_missing_dicom_slice(tmp_path, sitk):
    write_dicom(sitk, tmp_path / "d", ramp(6, 5, 5), skip=(3,))
    said = (
        r"a step of 6 mm between slices 2 and 3, counted from 0, and 3 mm elsewhere: one is missing"
    )
    assert_refused(tmp_path / "d", rf"not evenly spaced \({said}")


def test_uneven_dicom_slices_in_words():
    # even, but not on a line
    points = np.column_stack([np.zeros(5), [0.0, 1.0, 2.0, 1.0, 0.0], 3.0 * np.arange(5)])
    off = np.abs(points[:, 1])
    assert (
        _unevenness(points, off)
        == "slice 2, counted from 0, is 2 mm off its even place between first and last"
    )
    points = np.outer([0.0, 3.0, 6.0, 9.0, 15.0, 24.0, 27.0], [0.0, 0.0, 1.0])
    assert "9 mm between slices 4 and 5, counted from 0, and 3 mm at most places" in _unevenness(
        points, off
    )


@pytest.mark.parametrize(("places", "words"), [(1, "1 position"), (2, "2 positions")])
def test_dicom_series_of_several_volumes(tmp_path, sitk, places, words):
    """Of one slice in time the first and last place are the same, which is no singular affine."""
    write_dicom(sitk, tmp_path / "d", ramp(6, 5, 4), places=places)
    assert_refused(
        tmp_path / "d", f"the 4 slices of this DICOM series have {words}: it has several volumes"
    )


def test_dicom_slices_that_are_not_parallel(tmp_path, sitk):
    write_dicom(sitk, tmp_path / "d", ramp(6, 5, 4), turned=(2,))
    assert_refused(tmp_path / "d", "not parallel")


@pytest.mark.apart
def test_damaged_dicom_slice_is_not_passed_over(tmp_path, sitk):
    write_dicom(sitk, tmp_path / "d", ramp(6, 5, 4))
    last = tmp_path / "d" / "1.2.3.4_10.dcm"  # slice 3
    last.write_bytes(last.read_bytes()[:-20])
    assert_refused(tmp_path / "d", f"1.2.3.4_10.dcm is {DAMAGED}")


def test_several_dicom_series(tmp_path, sitk):
    write_dicom(sitk, tmp_path / "d", ramp(6, 5, 4))
    write_dicom(sitk, tmp_path / "d", ramp(6, 5, 3), uid="1.2.3.5")
    assert_refused(
        tmp_path / "d",
        r"expected one DICOM series, got 2; .*1\.2\.3\.4 \(4 files\), 1\.2\.3\.5 \(3 files\)",
    )


def test_a_folder_above_dicom_series_lists_them(tmp_path, sitk):
    for name, count in (("t1", 4), ("flair", 3)):
        (tmp_path / "scan").mkdir(exist_ok=True)
        write_dicom(sitk, tmp_path / "scan" / name, ramp(6, 5, count))
    (tmp_path / "report.txt").write_text("nothing to see")
    assert_refused(
        tmp_path, r"choose one of its subfolders: scan.flair \(3 files\), scan.t1 \(4 files\)$"
    )


@pytest.mark.usefixtures("sitk")
def test_folder_without_dicom(tmp_path, capfd):
    assert_refused(tmp_path, "no DICOM series")
    assert capfd.readouterr().err == ""  # nor ITK's own warning


# --------------------------------------------------------------------------------------------------
# Pictures


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.tiff", "a.bmp", "A.PNG"])
def test_grey_picture(tmp_path, name):
    rows = ramp(3, 5, dtype=np.uint8)
    PIL.Image.fromarray(rows).save(tmp_path / name)
    image = load_image(tmp_path / name)
    np.testing.assert_array_equal(image.data, rows)
    np.testing.assert_array_equal(image.to_world([2, 0]), [0.0, 0.0])  # bottom left
    np.testing.assert_array_equal(image.to_world([0, 4]), [4.0, 2.0])  # top right
    np.testing.assert_array_equal(image.affine, [[0, 1, 0], [-1, 0, 2], [0, 0, 1]])


@pytest.mark.parametrize("name", ["a.jpg", "a.jpeg"])
def test_jpeg_picture(tmp_path, name):
    # blocks of 8: no loss
    rows = np.repeat(np.array([[0], [255]], np.uint8), 8, axis=0).repeat(16, axis=1)
    PIL.Image.fromarray(rows).save(tmp_path / name, quality=100)
    np.testing.assert_array_equal(load_image(tmp_path / name).data, rows)


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("a.png", ramp(3, 5, dtype=np.uint16) * 4000),
        ("a.tif", ramp(3, 5, dtype=np.uint16) * 4000),
        ("a.tif", ramp(3, 5, dtype=np.int32) * 100000 - 7),
        ("a.tif", ramp(3, 5, dtype=np.float32) / 7),
        ("a.png", ramp(3, 5) % 2 == 1),
    ],
    ids=["I;16 png", "I;16 tif", "I", "F", "1"],
)
def test_picture_modes(tmp_path, name, rows):
    PIL.Image.fromarray(rows).save(tmp_path / name)
    np.testing.assert_array_equal(load_image(tmp_path / name).data, rows)


def test_colour_picture_is_refused(tmp_path):
    colours = np.stack([ramp(3, 5, dtype=np.uint8)] * 3, axis=-1)
    colours[2, 4, 1] += 1  # one pixel, one step off grey
    path = tmp_path / "a.png"
    PIL.Image.fromarray(colours).save(path)
    assert_refused(path, "colour .*RGB.*convert it to grey")


def test_palette_picture_is_refused(tmp_path):
    path = tmp_path / "a.png"
    PIL.Image.fromarray(ramp(3, 5, dtype=np.uint8)).convert("P").save(path)
    assert_refused(path, "mode P.*convert it to grey")


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA"])
def test_grey_in_colour(tmp_path, mode):
    path = tmp_path / "a.png"
    PIL.Image.fromarray(ramp(3, 5, dtype=np.uint8)).convert(mode).save(path)
    assert PIL.Image.open(path).mode == mode
    np.testing.assert_array_equal(load_image(path).data, ramp(3, 5))


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_transparent_picture_is_refused(tmp_path, mode):
    path = tmp_path / "a.png"
    picture = PIL.Image.fromarray(ramp(3, 5, dtype=np.uint8)).convert(mode)
    picture.putalpha(PIL.Image.fromarray(np.full((3, 5), 254, np.uint8)))
    picture.save(path)
    assert_refused(path, "transparency.*convert it to grey")


def test_frames_of_a_tiff(tmp_path):
    path = tmp_path / "a.tif"
    frames = [PIL.Image.fromarray(ramp(3, 5, dtype=np.uint8) + k) for k in range(3)]
    frames[0].save(path, save_all=True, append_images=frames[1:])
    for k in range(3):
        np.testing.assert_array_equal(load_image(path, volume=k).data, ramp(3, 5) + k)
    pytest.importorskip("tifffile")
    assert_refused(path, "this stack of 3 slices states no voxel size")
    assert_refused(path, "got 3: the file has 3 volumes", volume=3)


@pytest.mark.parametrize(
    "name", ["a.png", pytest.param("a.tif", marks=pytest.mark.apart), "a.jpg", "a.bmp"]
)
def test_truncated_picture(tmp_path, name):
    rows = np.random.default_rng(0).integers(0, 255, (64, 64)).astype(np.uint8)
    PIL.Image.fromarray(rows).save(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    assert_refused(tmp_path / name, DAMAGED)


def test_picture_has_no_slices(tmp_path):
    PIL.Image.fromarray(ramp(3, 5, dtype=np.uint8)).save(tmp_path / "a.png")
    assert_refused(tmp_path / "a.png", "slice: expected a 3-D image", slice_=(0, 0))


# --------------------------------------------------------------------------------------------------
# Files that cannot be used


@pytest.mark.parametrize("name", ["a.nii.gz", "a.xyz", "folder/a.nii"])
def test_missing_file(tmp_path, name):
    assert_refused(tmp_path / name, "no such file or folder")


def test_unknown_suffix(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_bytes(b"hello")
    known = (
        ".nii.gz, .nii, .mgz, .mgh, .hdr, .img, .hdr.gz, .img.gz, .nrrd, .nhdr, .mha, .mhd, .zarr, "
        ".dcm, .png, .tif, .tiff, .jpg, .jpeg, .bmp"
    )
    assert_refused(path, f"unknown image format.*{re.escape(known)}, or a folder of DICOM files")


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".mgz", ".nrrd", ".dcm", ".png"])
def test_empty_file(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.touch()
    assert_refused(path, "the file is empty")


@pytest.mark.parametrize(
    "suffix",
    [".nii", ".mgh", ".png", pytest.param(".tif", marks=pytest.mark.apart), ".jpg", ".bmp"],
)
def test_garbage(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"hello " * 200)
    assert_refused(path, f"{DAMAGED}, or not an image of this kind")


def test_nii_gz_that_is_not_compressed(tmp_path):
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5)).rename(tmp_path / "a.nii.gz")
    assert_refused(path, r"not a gzip file; .* remove \.gz")


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nii", "a.mgz", "a.nrrd", "a.png"])
def test_web_page(tmp_path, name):
    (tmp_path / name).write_text("\n<!DOCTYPE HTML>\n<html><body>Please log in</body></html>")
    assert_refused(tmp_path / name, "this is an HTML page, not an image; download")


@pytest.mark.parametrize(
    ("name", "better"), [("b.c.nii", "b.c.nii.gz"), ("b.mgh", "b.mgz"), ("b.IMG", "b.img.gz")]
)
def test_gzip_file_of_another_name(tmp_path, name, better):
    save_nifti(tmp_path / "a.nii.gz", ramp(3, 4, 5)).rename(tmp_path / name)
    assert_refused(tmp_path / name, f"this is a gzip file; rename it to {re.escape(better)}$")


@pytest.mark.parametrize("kept", [0.99, 0.5, 0.001])
def test_truncated_nii_gz(data_dir, tmp_path, kept):
    whole = (data_dir / "hippocampus_001.nii.gz").read_bytes()
    path = tmp_path / "a.nii.gz"
    path.write_bytes(whole[: int(kept * len(whole))])
    assert_refused(path, f"{DAMAGED}; copy it again")


def test_flipped_bit_in_a_compressed_file(tmp_path):
    """Stored, not deflated, blocks: only the checksum behind the last voxel can tell."""
    plain = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5)).read_bytes()
    packed = bytearray(gzip.compress(plain, compresslevel=0))
    path = tmp_path / "a.nii.gz"
    path.write_bytes(packed)
    np.testing.assert_array_equal(load_image(path).data, ramp(3, 4, 5))
    packed[-20] ^= 1
    path.write_bytes(packed)
    assert_refused(path, f"{DAMAGED}; copy it again .*CRC")


@pytest.mark.parametrize("missing", [1, 100, 10000])
def test_truncated_nii(data_dir, tmp_path, missing):
    path = tmp_path / "a.nii"
    path.write_bytes((data_dir / "tiny_anatomical.nii").read_bytes()[:-missing])
    assert_refused(path, f"{DAMAGED}; copy it again")


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX permissions")
@pytest.mark.parametrize("name", ["a.nii", "folder"])
def test_permission_denied(tmp_path, name):
    pytest.importorskip("SimpleITK")
    path = tmp_path / name
    path.mkdir() if name == "folder" else save_nifti(path, ramp(3, 4, 5))
    path.chmod(0)
    # Root may read everything; be nobody for a moment.
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        assert_refused(path, "permission denied")
        with pytest.raises(InputError, match=re.escape(f"{path}: permission denied")):
            sha256(path)
    finally:
        if is_root:
            os.seteuid(0)
        path.chmod(0o700)


def test_complex_nifti(tmp_path):
    assert_refused(save_nifti(tmp_path / "a.nii", ramp(3, 4, 5, dtype=np.complex64)), "complex")


def test_rgb_nifti(tmp_path):
    data = np.zeros((3, 4, 5), dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")])
    assert_refused(save_nifti(tmp_path / "a.nii", data), "convert RGB to grey")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite(tmp_path, bad):
    data = ramp(3, 4, 5, dtype=np.float32)
    data[1, 2, 3] = bad
    assert_refused(
        save_nifti(tmp_path / "a.nii", data), r"1 voxels are NaN or infinite, .*\(1, 2, 3\)"
    )


@pytest.mark.parametrize("shape", [(3, 0, 5), (3, 4, 5, 0)])
def test_empty_axis(tmp_path, shape):
    assert_refused(
        save_nifti(tmp_path / "a.nii", np.zeros(shape, np.int16)),
        "at least one voxel along every|expected voxels along every axis",
    )


def test_one_axis(tmp_path):
    assert_refused(save_nifti(tmp_path / "a.nii", ramp(7)), "expected 2 or 3 axes")


@pytest.mark.parametrize(
    ("column", "match"),
    [([0.0, 0.0, 0.0], "singular"), ([-0.75, 0.12, 0.05], "singular"), ([np.nan] * 3, "finite")],
)
@pytest.mark.parametrize("shape", [(3, 4, 5), (3, 4)])
def test_singular_affine(tmp_path, column, match, shape):
    affine = OBLIQUE.copy()
    affine[:3, 1] = column
    file = nibabel.Nifti1Image(ramp(*shape), None)
    file.header["sform_code"] = 1
    for name, row in zip(("srow_x", "srow_y", "srow_z"), affine, strict=False):
        file.header[name] = row
    nibabel.save(file, tmp_path / "a.nii")
    assert_refused(tmp_path / "a.nii", f"affine.*{match}")


def test_cifti_has_no_grid(tmp_path):
    axes = [
        nibabel.cifti2.ScalarAxis(["a"]),
        nibabel.cifti2.BrainModelAxis.from_mask(np.ones(7), name="CORTEX_LEFT"),
    ]
    path = tmp_path / "a.dscalar.nii"
    nibabel.save(nibabel.Cifti2Image(np.zeros((1, 7)), axes), path)
    assert_refused(path, "voxel grid, got a Cifti2Image")


def test_constant_image_warns(tmp_path):
    path = save_nifti(tmp_path / "a.nii", np.full((3, 4, 5), 7, np.int16))
    with pytest.warns(
        UserWarning, match=re.escape(f"{path}: the image is 7 everywhere, so E_D is 0 everywhere")
    ):
        image = load_image(path)
    assert (image.data == 7).all()


def warnings_of(path):
    """The texts of `load_image`'s warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_image(path)
    # not nibabel's unclosed files
    return [str(each.message) for each in caught if each.category is UserWarning]


def test_no_orientation_warns(tmp_path):
    file = nibabel.Nifti1Image(ramp(3, 4, 5), None)
    nibabel.save(file, tmp_path / "a.nii.gz")
    (said,) = warnings_of(tmp_path / "a.nii.gz")
    assert said.startswith(
        f"{tmp_path / 'a.nii.gz'}: has no orientation: position and left/right are nibabel's guess;"
    )
    nibabel.save(nibabel.MGHImage(ramp(3, 4, 5), np.eye(4)), tmp_path / "a.mgh")
    assert warnings_of(tmp_path / "a.mgh") == []
    raw = bytearray((tmp_path / "a.mgh").read_bytes())
    raw[28:30] = b"\0\0"
    (tmp_path / "a.mgh").write_bytes(raw)
    (said,) = warnings_of(tmp_path / "a.mgh")
    assert "a.mgh: has no orientation: its voxel sizes" in said


@pytest.mark.parametrize(
    ("step", "match"), [(800.0, "4000 mm"), (0.1, "0.5 mm"), (600.0, None), (0.2, None)]
)
def test_box_of_another_unit_warns(tmp_path, step, match):
    affine = np.diag([step, step, step, 1.0])
    said = warnings_of(save_nifti(tmp_path / "a.nii", ramp(3, 4, 5), affine))
    assert (
        said == [] if match is None else f"a.nii: the longest side of its box is {match}" in said[0]
    )


def test_size_of_pictures_is_not_doubted(tmp_path):
    pixels = np.arange(3100, dtype=np.uint8)[None].repeat(2, axis=0)
    PIL.Image.fromarray(pixels).save(tmp_path / "a.png")
    assert warnings_of(tmp_path / "a.png") == []


def test_mended_header_is_a_warning_of_the_file(tmp_path, capfd):
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5), np.diag([1.0, 1.0, 1.0, 1.0]))
    raw = bytearray(path.read_bytes())
    raw[88:92] = bytes(4)  # pixdim[3]
    path.write_bytes(raw)
    (said,) = warnings_of(path)
    assert said.startswith(
        f"{path}: nibabel repaired its header (pixdim[1,2,3] should be non-zero; setting 0 dims "
        "to 1);"
    )
    raw[70:72] = (999).to_bytes(2, "little")  # datatype
    path.write_bytes(raw)
    assert_refused(path, "data code 999 not recognized")
    assert capfd.readouterr().err == ""  # nibabel's logger


def test_other_images_do_not_warn(tmp_path):
    data = np.zeros((3, 4, 5), np.int16)
    data[2, 3, 4] = 1
    path = save_nifti(tmp_path / "a.nii", data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_image(path)


# --------------------------------------------------------------------------------------------------
# Slices


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_aligned_slice_has_two_world_axes(axis):
    affine = np.diag([-2.0, 3.0, -0.5, 1.0])
    affine[:3, 3] = [5.0, 6.0, 7.0]
    image = Image(ramp(3, 4, 5), affine)
    plane = image_slice(image, axis, 2)
    others = [a for a in range(3) if a != axis]
    for index in np.ndindex(plane.shape):
        whole = np.insert(index, axis, 2)
        np.testing.assert_array_equal(plane.to_world(index), image.to_world(whole)[others])
        assert plane.data[index] == image.data[tuple(whole)]
    assert not np.signbit(plane.affine[plane.affine == 0]).any()


def test_slice_of_permuted_axes():
    """Array axes along world z, x, y: without axis 0 the plane is (x, y), without axis 2 it is
    (x, z).
    """
    affine = np.array(
        [[0.0, -2.0, 0.0, 5.0], [0.0, 0.0, 3.0, 6.0], [-4.0, 0.0, 0.0, 7.0], [0.0, 0.0, 0.0, 1.0]]
    )
    image = Image(ramp(3, 4, 5), affine)
    np.testing.assert_array_equal(
        image_slice(image, 0, 1).affine, [[-2, 0, 5], [0, 3, 6], [0, 0, 1]]
    )
    np.testing.assert_array_equal(
        image_slice(image, 2, 1).affine, [[0, -2, 5], [-4, 0, 7], [0, 0, 1]]
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_oblique_slice_keeps_lengths_and_angles(axis):
    image = Image(ramp(3, 4, 5), OBLIQUE)
    plane = image_slice(image, axis, 1)
    np.testing.assert_array_equal(plane.data, np.take(ramp(3, 4, 5), 1, axis))
    index = np.array(list(np.ndindex(plane.shape)))
    flat = plane.to_world(index)
    space = image.to_world(np.insert(index, axis, 1, axis=1))
    # All scalar products of differences, hence all lengths and angles.
    flat, space = flat - flat[0], space - space[0]
    np.testing.assert_allclose(flat @ flat.T, space @ space.T, rtol=0, atol=1e-11)


def test_parallel_slices_share_one_frame():
    """Two slices differ in their origin by the in-plane part of the step between them."""
    image = Image(ramp(3, 4, 5), OBLIQUE)
    first, second = image_slice(image, 2, 0), image_slice(image, 2, 1)
    np.testing.assert_array_equal(first.affine[:2, :2], second.affine[:2, :2])
    step = second.affine[:2, 2] - first.affine[:2, 2]
    in_plane = first.affine[:2, :2].T @ step  # scalar products with the voxel axes
    np.testing.assert_allclose(in_plane, OBLIQUE[:3, :2].T @ OBLIQUE[:3, 2], rtol=0, atol=1e-12)


def test_slice_frame_points_along_its_largest_component():
    angle = np.deg2rad(10)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    affine = np.eye(4)
    affine[:3, :3] = turn @ np.diag([-2.0, 3.0, 1.0])
    plane = image_slice(Image(ramp(3, 4, 5), affine), 2, 0)
    np.testing.assert_allclose(plane.affine, np.diag([-2.0, 3.0, 1.0]), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("axis", "index", "match"),
    [
        (3, 0, "expected axis 0, 1 or 2, got 3"),
        (-1, 0, "expected axis 0, 1 or 2, got -1"),
        (1, 4, "expected an index from 0 to 3 along axis 1, got 4"),
        (1, -1, "expected an index from 0 to 3 along axis 1, got -1"),
    ],
)
def test_slice_out_of_range(axis, index, match):
    with pytest.raises(InputError, match=match):
        image_slice(Image(ramp(3, 4, 5)), axis, index)


def test_slice_of_a_2d_image():
    with pytest.raises(InputError, match="slice: expected a 3-D image"):
        image_slice(Image(ramp(3, 4)), 0, 0)


# --------------------------------------------------------------------------------------------------
# Crops


@pytest.mark.parametrize("bounds", [[(1, 3), (0, 2), (2, 5)], [(None, None), (1, None), (None, 4)]])
def test_crop_leaves_voxels_where_they_are(bounds):
    image = Image(ramp(3, 4, 5), OBLIQUE)
    small = crop_image(image, bounds)
    start = np.array([b[0] or 0 for b in bounds])
    assert small.shape == tuple(
        len(range(s)[slice(*b)]) for s, b in zip(image.shape, bounds, strict=True)
    )
    for index in np.ndindex(small.shape):
        assert small.data[index] == image.data[tuple(index + start)]
        np.testing.assert_allclose(
            small.to_world(index), image.to_world(index + start), rtol=0, atol=1e-13
        )


def test_crop_of_a_2d_image():
    small = crop_image(Image(ramp(4, 5), np.diag([2.0, 3.0, 1.0])), [(1, 3), (2, None)])
    np.testing.assert_array_equal(small.data, ramp(4, 5)[1:3, 2:])
    np.testing.assert_array_equal(small.affine, [[2, 0, 2], [0, 3, 6], [0, 0, 1]])


def test_open_crop_is_the_image():
    image = Image(ramp(3, 4, 5), OBLIQUE)
    same = crop_image(image, [(None, None)] * 3)
    np.testing.assert_array_equal(same.data, image.data)
    np.testing.assert_array_equal(same.affine, image.affine)


@pytest.mark.parametrize(
    "ends", [(2, 2), (3, 2), (-1, 2), (0, 5), (4, None), (None, 0), (None, -1)]
)
def test_crop_out_of_range(ends):
    with pytest.raises(InputError, match="expected 0 <= start < stop <= 4 along axis 1"):
        crop_image(Image(ramp(3, 4, 5)), [(None, None), ends, (None, None)])


@pytest.mark.parametrize("n", [0, 2, 4])
def test_crop_with_another_number_of_axes(n):
    with pytest.raises(InputError, match=f"expected 3 ranges for shape .*, got {n}"):
        crop_image(Image(ramp(3, 4, 5)), [(None, None)] * n)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_load_with_volume_crop_and_slice(tmp_path, axis):
    """The same voxels at the same place as slicing the whole volume, with indices of the whole
    volume.
    """
    path = save_nifti(tmp_path / "a.nii", ramp(5, 6, 7, 2))
    bounds = [(1, 4), (2, None), (None, 6)]
    loaded = load_image(path, volume=1, crop=bounds, slice_=(axis, 3))
    plane = image_slice(load_image(path, volume=1), axis, 3)
    expected = crop_image(plane, bounds[:axis] + bounds[axis + 1 :])
    np.testing.assert_array_equal(loaded.data, expected.data)
    np.testing.assert_array_equal(loaded.affine, expected.affine)
    # And the documented order: crop first, then the slice of the crop.
    start = bounds[axis][0] or 0
    other_way = image_slice(load_image(path, volume=1, crop=bounds), axis, 3 - start)
    np.testing.assert_array_equal(loaded.data, other_way.data)
    np.testing.assert_allclose(loaded.affine, other_way.affine, rtol=0, atol=1e-13)


def test_load_with_crop_alone_or_slice_alone(tmp_path):
    path = save_nifti(tmp_path / "a.nii", ramp(5, 6, 7))
    np.testing.assert_array_equal(
        load_image(path, crop=[(1, 4), (2, 3), (None, None)]).data, ramp(5, 6, 7)[1:4, 2:3]
    )
    np.testing.assert_array_equal(load_image(path, slice_=(2, 6)).data, ramp(5, 6, 7)[..., 6])


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"slice_": (2, 7)}, "slice: expected an index from 0 to 6 along axis 2, got 7"),
        (
            {"crop": [(0, 9), (None, None), (None, None)]},
            "crop: expected .* <= 5 along axis 0, got 0:9",
        ),
        ({"crop": [(None, None), (None, None)]}, "crop: expected 3 ranges"),
        (
            {"crop": [(None, None)] * 2 + [(2, 5)], "slice_": (2, 5)},
            "index 5 .*outside the crop 2:5",
        ),
        (
            {"crop": [(None, None)] * 2 + [(2, 5)], "slice_": (2, 1)},
            "index 1 .*outside the crop 2:5",
        ),
    ],
)
def test_load_with_bad_parts(tmp_path, options, match):
    assert_refused(save_nifti(tmp_path / "a.nii", ramp(5, 6, 7)), match, **options)


# --------------------------------------------------------------------------------------------------
# Text and checksum


@pytest.mark.parametrize(
    ("text", "bounds"),
    [
        ("10:100,:,5:", [(10, 100), (None, None), (5, None)]),
        (":7,3:4", [(None, 7), (3, 4)]),
        (" 1 : 2 , : ", [(1, 2), (None, None)]),
    ],
)
def test_parse_crop(text, bounds):
    assert parse_crop(text) == bounds


@pytest.mark.parametrize(
    "text", ["", "5", "1:2,", "-1:2", "1:2:3", "a:b", "1.5:2", "1-2,3-4", "²:3", "1:2;3:4", "\n"]
)
def test_parse_crop_refuses(text):
    with pytest.raises(InputError, match=re.escape('such as "10:100,:,5:", got "')) as caught:
        parse_crop(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "pair"),
    [
        ("0=1", (0, 1)),
        ("1=20", (1, 20)),
        ("2=90", (2, 90)),
        ("i=1", (0, 1)),
        ("j=2", (1, 2)),
        (" k = 3 ", (2, 3)),
    ],
)
def test_parse_slice(text, pair):
    assert parse_slice(text) == pair


@pytest.mark.parametrize(
    "text", ["", "2", "3=1", "x=1", "z=90", "2=-1", "2=1.5", "2=", "=5", "ij=1", "2:90", "2=²"]
)
def test_parse_slice_refuses(text):
    with pytest.raises(InputError, match='such as "2=90" or "k=90", got "'):
        parse_slice(text)


def test_sha256_of_a_file(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert (
        sha256(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )


def test_sha256_of_a_real_file(data_dir):
    # from the data's README
    expected = "1c089f37b6597a38bb4157a1e1b3f7f13f1bc9d4e7a8cfdfaf91d85cd8f66594"
    assert sha256(str(data_dir / "tiny_anatomical.nii")) == expected


def test_sha256_of_a_folder(tmp_path):
    for name, content in (("b", b"second"), ("c", b"third"), ("a", b"first")):
        (tmp_path / name).write_bytes(content)
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "d").write_bytes(b"not read")
    assert sha256(tmp_path) == hashlib.sha256(b"firstsecondthird").hexdigest()


@pytest.mark.parametrize(("name", "data"), [("a.mhd", "a.raw"), ("a.nhdr", "a.raw")])
def test_sha256_of_a_header_is_that_of_its_voxels_too(tmp_path, sitk, name, data):
    """They lie in a file beside it, which may be another while the header stays the same."""
    sitk.WriteImage(sitk.GetImageFromArray(ramp(4, 5, 6)), str(tmp_path / name))
    header, voxels = (tmp_path / name).read_bytes(), (tmp_path / data).read_bytes()
    assert sha256(tmp_path / name) == hashlib.sha256(header + voxels).hexdigest()
    (tmp_path / name).write_bytes(b"no header")
    assert sha256(tmp_path / name) == hashlib.sha256(b"no header").hexdigest()


def test_sha256_of_nothing():
    with pytest.raises(InputError, match=r"^nowhere: no such file or folder"):
        sha256(Path("nowhere"))


@pytest.mark.parametrize("name", ["~a.nii", "~a.nii.gz", "~root/a.nii", "~\udc80.nii.gz"])
def test_a_name_that_begins_with_a_tilde_is_no_home(tmp_path, monkeypatch, name):
    """Not even of a user that there is: nibabel would read, and write, what lies there."""
    monkeypatch.chdir(tmp_path)
    Path("~root").mkdir()
    image = Image(np.arange(24.0).reshape(2, 3, 4))
    save_image(name, image)
    assert (tmp_path / name).is_file()
    assert np.array_equal(load_image(name).data, image.data)
    assert file_shape(Path(name)) == (2, 3, 4)
