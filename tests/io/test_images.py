"""Files to images: every voxel's value and place, and one line for every file that cannot be
used.
"""

import gzip
import hashlib
import itertools
import os
import re
import sys
from io import BytesIO
from pathlib import Path

import nibabel
import numpy as np
import PIL.Image
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from readers import OBLIQUE, ramp, read_warned
from refusals import assert_refused, refusal

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

sitk = pytest.importorskip("SimpleITK")
DAMAGED = "truncated or damaged"
APART = pytest.mark.apart


def nifti(data, affine=OBLIQUE, **header):
    """The bytes of a file."""
    image = nibabel.Nifti1Image(data, affine)
    for name, value in header.items():
        image.header[name] = value
    return image.to_bytes()


def save_nifti(path, data, *args, **header):
    path.write_bytes(nifti(data, *args, **header))
    return path


# --------------------------------------------------------------------------------------------------
# NIfTI and MGZ

# MGH holds a rotation, voxel sizes and the centre; no shear.
ROTATED = np.array([[-1.0, 0, 0, 10], [0, 0, 2, 20], [0, -0.5, 0, 30], [0, 0, 0, 1]])
SIGNS = itertools.product([1.0, -1.0], repeat=3)


@pytest.mark.parametrize(
    ("name", "data", "affine"),
    [
        *((name, ramp(3, 4, 5), OBLIQUE) for name in ("a.nii", "a.nii.gz", "A.NII", "A.Nii.GZ")),
        *(
            (name, ramp(3, 4, 6, dtype=np.float32), ROTATED)
            for name in ("a.mgz", "a.mgh", "A.MGZ", "a.Mgz")
        ),
        *(("a.nii", ramp(3, 4, 5), np.diag([*signs, 1.0]) @ abs(ROTATED)) for signs in SIGNS),
        ("a.nii", ramp(3, 4, 1), OBLIQUE),
        ("a.nii", ramp(3, 4, 5, dtype=np.int32) + 2**24, OBLIQUE),  # beyond single precision
    ],
)
def test_values_and_affine(tmp_path, name, data, affine):
    kind = nibabel.MGHImage if "m" in name.lower() else nibabel.Nifti1Image
    nibabel.save(kind(data, affine), tmp_path / name.lower())
    (tmp_path / name.lower()).rename(tmp_path / name)
    image = load_image(str(tmp_path / name))
    assert_array_equal(image.data, data)
    assert image.data.dtype == (np.float64 if data.max() > 2**24 else np.float32)
    assert_array_equal(image.affine, affine.astype(np.float32))  # the header's precision


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.mgz", "a.nrrd", "a.mha", "a.png"])
def test_shape_without_voxels(tmp_path, name, monkeypatch):
    """The header tells it, or nothing does."""
    path = tmp_path / name
    if name.endswith(("nii", "gz")):
        kind = nibabel.MGHImage if name.endswith("mgz") else nibabel.Nifti1Image
        nibabel.save(kind(np.zeros((5, 4, 3, 2), np.float32), np.eye(4)), path)
    elif name.endswith("png"):
        PIL.Image.fromarray(ramp(5, 4, dtype=np.uint8)).save(path)
    else:
        sitk.WriteImage(sitk.GetImageFromArray(np.zeros((3, 4, 5), np.int16)), str(path))
    monkeypatch.setattr(images, "load_image", None)
    expected = {"png": None, "rrd": (5, 4, 3), "mha": (5, 4, 3)}.get(name[-3:], (5, 4, 3, 2))
    assert file_shape(path) == expected
    assert file_shape(tmp_path) is None  # DICOM, for all that is known
    if expected is not None:
        path.write_bytes(b"something else")
        assert_refused(path, r"\S+ ", file_shape)


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
    nibabel.save(kind(ramp(3, 4, 5, 2), OBLIQUE), tmp_path / written[1])
    kept = [tmp_path / (header or "a.hdr"), tmp_path / (voxels or "a.img")]
    for file, path in zip(written, kept, strict=True):
        raw = (tmp_path / file).read_bytes()
        (tmp_path / file).unlink()
        is_unpacked = file.endswith(".gz") and path.suffix != ".gz"
        path.write_bytes(gzip.decompress(raw) if is_unpacked else raw)
    for path, other in (kept, kept[::-1]):
        image = load_image(path, volume=1)
        assert_array_equal(image.data, ramp(3, 4, 5, 2)[..., 1])
        assert_allclose(image.affine, OBLIQUE, rtol=1e-6)
        assert file_shape(path) == (3, 4, 5, 2)
        whole = path.read_bytes() + other.read_bytes()
        assert sha256(path) == hashlib.sha256(whole).hexdigest()
        assert_refused(path, "has 2 volumes")


@pytest.mark.parametrize(("gone", "left"), [("a.img", "a.hdr"), ("a.hdr", "a.img")])
def test_one_file_of_a_pair(here, gone, left):
    nibabel.save(nibabel.Nifti1Pair(ramp(3, 4, 5), OBLIQUE), "a.img")
    (here / gone).unlink()
    assert_refused(left, rf"should be in {gone} \(or {gone}.gz\) next to it")
    (here / gone).mkdir()
    assert_refused(left, f'its other file "{gone}" is a folder')


def test_damaged_pairs(tmp_path):
    path, voxels = tmp_path / "a.hdr", tmp_path / "a.img"
    nibabel.save(nibabel.Nifti1Pair(ramp(3, 4, 5), OBLIQUE), voxels)
    whole = voxels.read_bytes()
    voxels.write_bytes(whole[:-1])
    assert_refused(path, f"{DAMAGED}.*declares 3 x 4 x 5 voxels, 120 bytes, but the file has 119")
    voxels.write_bytes(whole + bytes(24))
    assert "24 more bytes after them" in read_warned(path)[1][0]
    path.write_text("ENVI\nsamples = 3\n")
    assert_refused(path, f"{DAMAGED}, or not an image of this kind")


def test_a_gzip_file_is_unpacked_once(tmp_path, monkeypatch):
    path, blocks = tmp_path / "a.nii.gz", []
    path.write_bytes(gzip.compress(nifti(ramp(3, 4, 5, 2))))
    read = gzip.GzipFile.read
    monkeypatch.setattr(gzip.GzipFile, "read", lambda *a: blocks.append(read(*a)) or blocks[-1])
    load_image(path, volume=0)
    # the header, and then the whole
    assert sum(map(len, blocks[1:])) == 352 + ramp(3, 4, 5, 2).nbytes


def test_scaled_nifti(here):
    file = nibabel.Nifti1Image(ramp(3, 4, 5), OBLIQUE)
    file.header.set_slope_inter(0.5, -1024.0)
    nibabel.save(file, "a.nii.gz")
    stored = np.asarray(nibabel.load(here / "a.nii.gz").dataobj.get_unscaled())
    assert stored.dtype == np.int16
    image = load_image("a.nii.gz")
    assert_array_equal(image.data, 0.5 * stored - 1024.0)
    assert image.data.max() < 0  # the intercept did arrive


@pytest.mark.parametrize(("code", "mm"), [(0, 1.0), (1, 1000.0), (2, 1.0), (3, 0.001), (7, 1.0)])
def test_spatial_units(tmp_path, code, mm):
    """Unknown, metres, mm, micrometres, and none of the standard."""
    steps = np.array([2.0, 3.0, 4.0, 1.0])
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5), np.diag(steps), xyzt_units=code)
    assert_array_equal(load_image(path).affine, np.diag(steps * [mm, mm, mm, 1]))


def test_big_endian_file(data_dir):
    path = data_dir / "tiny_anatomical.nii"
    image = load_image(path)
    raw = np.fromfile(path, dtype=">i2", offset=352).reshape((33, 41, 25), order="F")
    assert_array_equal(image.data, raw)
    assert image.data.dtype == np.dtype("=f4")
    assert_array_equal(image.affine[:3, :3], np.diag([-2.0, 2.0, 2.0]))
    assert_array_equal(image.affine, nibabel.load(path).affine)


def test_oblique_anisotropic_file(data_dir):
    path = data_dir / "brain_flair_oblique_aniso.nii.gz"
    image = load_image(path)
    assert_array_equal(image.affine, nibabel.load(path).affine)
    assert_allclose(image.spacing, [0.75, 0.75, 5.5], rtol=1e-3)
    assert image.shape == (320, 320, 26)


# --------------------------------------------------------------------------------------------------
# Volumes


@pytest.mark.parametrize("more", [(), (2,), (2, 3), (1, 2), (1, 1)])
def test_volumes(tmp_path, more):
    """The fourth axis runs fastest; axes of length 1 are none."""
    count = int(np.prod(more))
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5, *more))
    expected = ramp(3, 4, 5, *more).reshape((3, 4, 5, count), order="F")
    for k in range(count):
        assert_array_equal(load_image(path, volume=k).data, expected[..., k])
    has = f"the file has {'one volume' if count == 1 else f'{count} volumes'}"
    for k in (-1, count):
        assert_refused(path, f"a volume from 0 to {count - 1}, got {k}: {has}", volume=k)
    if count == 1:
        assert_array_equal(load_image(path).data, expected[..., 0])
    else:
        assert_refused(path, f"has {count} volumes; choose one from 0 to {count - 1}: `volume=k`")


def test_other_volumes_are_not_read(tmp_path):
    """The first of three volumes can be had from an uncompressed file that ends after it."""
    path = save_nifti(tmp_path / "a.nii", ramp(3, 4, 5, 3))
    path.write_bytes(path.read_bytes()[: 352 + 3 * 4 * 5 * 2])
    assert_array_equal(load_image(path, volume=0).data, ramp(3, 4, 5, 3)[..., 0])
    assert_refused(path, DAMAGED, volume=1)


# --------------------------------------------------------------------------------------------------
# NRRD and MetaImage


def assert_placed_as_in_itk(image, reference):
    """Each corner voxel and a middle one: ITK's value and ITK's LPS point turned to RAS."""
    assert image.shape == reference.GetSize()
    middle = tuple(s // 2 for s in image.shape)
    for index in [*itertools.product(*((0, s - 1) for s in image.shape)), middle]:
        point = np.array(reference.TransformIndexToPhysicalPoint(index)) * [-1, -1, 1]
        assert_allclose(image.to_world(index), point, rtol=0, atol=1e-9)
    assert_array_equal(image.data.T, sitk.GetArrayFromImage(reference))


@pytest.mark.parametrize("name", ["ct_lung_small.mha", "prostate_phantom_subvolume.nrrd"])
def test_real_file_against_itk(data_dir, name):
    assert_placed_as_in_itk(load_image(data_dir / name), sitk.ReadImage(str(data_dir / name)))


def itk_image(data, **options):
    return sitk.GetImageFromArray(np.ascontiguousarray(data.T), isVector=False, **options)


@pytest.mark.parametrize("name", ["a.nrrd", "a.nhdr", "a.mha", "a.mhd", "A.MHA", "A.NRRD"])
def test_oblique_itk_formats(here, name):
    """Placed as ITK has it, and as nibabel reads the NIfTI file that ITK writes."""
    c, s, d, t = np.cos(0.3), np.sin(0.3), np.cos(0.4), np.sin(0.4)
    written = itk_image(ramp(4, 5, 6))
    written.SetSpacing([0.5, 0.75, 3.0])
    written.SetOrigin([10.0, -20.0, 30.0])
    written.SetDirection([c, -s * d, s * t, s, c * d, -c * t, 0.0, t, d])  # about x, then z
    for each in (name.lower(), "b.nii"):
        sitk.WriteImage(written, str(here / each))
    (here / name.lower()).rename(here / name)
    image = load_image(name)
    assert_placed_as_in_itk(image, written)
    assert_allclose(image.affine, nibabel.load(here / "b.nii").affine, rtol=0, atol=1e-5)


@pytest.mark.parametrize("n", [2, 4])
def test_metaimages_of_other_axes(tmp_path, n):
    data = ramp(3, 4, 5, 2)[(slice(None),) * n + (0,) * (4 - n)]
    image, path = itk_image(data), tmp_path / "a.mha"
    image.SetSpacing([2.0, 3.0, 4.0, 7.0][:n])
    image.SetOrigin([10.0, 20.0, 30.0, 40.0][:n])
    sitk.WriteImage(image, str(path))
    for volume in (None,) if n == 2 else (0, 1):
        loaded = load_image(path, volume=volume)
        assert_array_equal(loaded.data, data if n == 2 else data[..., volume])
        keep = [0, 1, 3] if n == 2 else [0, 1, 2, 3]
        affine = np.array([[-2, 0, 0, -10], [0, -3, 0, -20], [0, 0, 4, 30], [0, 0, 0, 1]])
        assert_array_equal(loaded.affine, affine[np.ix_(keep, keep)])
    if n == 4:
        assert_refused(path, "has 2 volumes")
        assert_refused(path, "got 2: the file has 2 volumes", volume=2)


@APART
@pytest.mark.parametrize("suffix", [".nrrd", ".mha"])
def test_truncated_itk_file(tmp_path, suffix):
    path, noise = tmp_path / f"a{suffix}", np.random.default_rng(0).integers(0, 999, (20, 20, 20))
    sitk.WriteImage(itk_image(noise.astype(np.int16)), str(path), useCompression=True)
    path.write_bytes(path.read_bytes()[:5000])
    assert_refused(path, DAMAGED)


@pytest.mark.parametrize(
    ("name", "image", "words"),
    [
        *(
            (name, sitk.Image([3, 4, 5], sitk.sitkVectorUInt8, 3), "one number per voxel, got 3")
            for name in ("a.nrrd", "a.mha")
        ),
        (
            "a.nrrd",
            sitk.Image([3, 4, 5], sitk.sitkComplexFloat32),
            "got complex ones|one number per voxel, got 2",
        ),
    ],
)
def test_vectors_are_refused(here, name, image, words):
    sitk.WriteImage(image, str(here / name))
    assert_refused(name, words)


@pytest.mark.parametrize(
    ("name", "package"),
    [("a.nrrd", "SimpleITK"), ("a.mha", "SimpleITK"), ("a.dcm", "pydicom"), ("folder", "pydicom")],
)
def test_without_a_library(tmp_path, monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    path = tmp_path / name
    path.mkdir() if name == "folder" else path.write_bytes(b"hello")
    assert_refused(path, f'pip install "{package}(>=[0-9.]+)?"')
    assert load_image(save_nifti(tmp_path / "a.nii", ramp(3, 4, 5))).shape == (3, 4, 5)


# --------------------------------------------------------------------------------------------------
# Pictures

ROWS = ramp(3, 5, dtype=np.uint8)
STRIPES = np.repeat(np.uint8([[0] * 16, [255] * 16]), 8, axis=0)
NOISE = np.random.default_rng(0).integers(0, 255, (64, 64)).astype(np.uint8)


def picture(rows, mode=None, kind="PNG", alpha=None):
    """The bytes of a file."""
    image, file = PIL.Image.fromarray(rows), BytesIO()
    image = image.convert(mode) if mode else image
    if alpha is not None:
        image.putalpha(PIL.Image.fromarray(np.full_like(rows, alpha)))
    image.save(file, kind)
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "rows", "mode", "kind"),
    [
        *((name, ROWS, None, "PNG") for name in ("a.png", "A.PNG")),
        *((name, ROWS, None, "TIFF") for name in ("a.tif", "a.tiff")),
        ("a.bmp", ROWS, None, "BMP"),
        # blocks of 8: no loss
        *((f"a.{each}", STRIPES, None, "JPEG") for each in ("jpg", "jpeg")),
        ("a.png", ROWS.astype(np.uint16) * 4000, None, "PNG"),
        ("a.tif", ROWS.astype(np.uint16) * 4000, None, "TIFF"),
        ("a.tif", ROWS.astype(np.int32) * 100000 - 7, None, "TIFF"),
        ("a.tif", ROWS.astype(np.float32) / 7, None, "TIFF"),
        ("a.png", ROWS % 2 == 1, None, "PNG"),
        *(("a.png", ROWS, mode, "PNG") for mode in ("RGB", "RGBA", "LA")),
        ("a.png", np.tile(np.arange(3100, dtype=np.uint8), (2, 1)), None, "PNG"),
    ],
)
def test_grey_picture(here, name, rows, mode, kind):
    """Of any size, which is not doubted; the bottom left pixel at the origin."""
    (here / name).write_bytes(picture(rows, mode, kind))
    image, said = read_warned(name)
    assert_array_equal(image.data, rows)
    assert_array_equal(image.affine, [[0, 1, 0], [-1, 0, len(rows) - 1], [0, 0, 1]])
    assert said == []


def test_frames_of_a_tiff(tmp_path):
    path = tmp_path / "a.tif"
    frames = [PIL.Image.fromarray(ROWS + k) for k in range(3)]
    frames[0].save(path, save_all=True, append_images=frames[1:])
    for k in range(3):
        assert_array_equal(load_image(path, volume=k).data, ROWS + k)
    pytest.importorskip("tifffile")
    assert_refused(path, "this stack of 3 slices states no voxel size")
    assert_refused(path, "got 3: the file has 3 volumes", volume=3)


# --------------------------------------------------------------------------------------------------
# Files that cannot be used

GARBAGE = b"hello " * 200
WHOLE = nifti(ramp(3, 4, 5))
NOT_FINITE = [np.where(ramp(3, 4, 5) == 34, bad, 1.0) for bad in (np.inf, -np.inf)]
COLOURS = np.stack([ROWS] * 3, axis=-1)
COLOURS[2, 4, 1] += 1  # one pixel, one step off grey
PAGE = b"\n<!DOCTYPE HTML>\n<html><body>Please log in</body></html>"
AXES = [
    nibabel.cifti2.ScalarAxis(["a"]),
    nibabel.cifti2.BrainModelAxis.from_mask(np.ones(7), name="CORTEX_LEFT"),
]
KNOWN = (
    ".nii.gz, .nii, .mgz, .mgh, .hdr, .img, .hdr.gz, .img.gz, .nrrd, .nhdr, .mha, .mhd, .zarr, "
    ".head, .brik, .brik.gz, .mnc, .gipl, .gipl.gz, .vtk, .vti, .npy, .dcm, .png, .tif, .tiff, "
    ".jpg, .jpeg, .bmp"
)
REFUSED = [
    *((name, None, "no such file or folder") for name in ("a.nii.gz", "a.xyz", "folder/a.nii")),
    ("a.xyz", GARBAGE, f"unknown image format.*{re.escape(KNOWN)}, or a folder of DICOM files"),
    *(
        (f"a.{suffix}", b"", "the file is empty")
        for suffix in ("nii", "nii.gz", "mgz", "nrrd", "dcm", "png")
    ),
    *(
        (f"a.{suffix}", GARBAGE, f"{DAMAGED}, or not an image of this kind")
        for suffix in ("nii", "mgh", "png", "jpg", "bmp")
    ),
    *(
        pytest.param(f"a.{suffix}", GARBAGE, DAMAGED, marks=APART)
        for suffix in ("tif", "nrrd", "nhdr", "mha", "mhd", "dcm")
    ),
    *(
        (f"a.{suffix}", PAGE, "this is an HTML page, not an image; download")
        for suffix in ("nii", "nii.gz", "mgz", "nrrd", "png")
    ),
    *(
        (
            name,
            gzip.compress(WHOLE, mtime=0),
            f"this is a gzip file; rename it to {re.escape(better)}$",
        )
        for name, better in (
            ("b.c.nii", "b.c.nii.gz"),
            ("b.mgh", "b.mgz"),
            ("b.IMG", "b.img.gz"),
        )
    ),
    ("a.nii.gz", WHOLE, r"not a gzip file; .* remove \.gz"),
    *(
        ("a.nii.gz", gzip.compress(nifti(NOISE), mtime=0)[:kept], f"{DAMAGED}; copy it again")
        for kept in (-9, 2000, 20)
    ),
    *(("a.nii", WHOLE[:kept], f"{DAMAGED}; copy it again") for kept in (-1, -100, 352)),
    *(
        (f"a.{suffix}", picture(NOISE, kind=kind)[:1000], DAMAGED)
        for suffix, kind in (("png", "PNG"), ("jpg", "JPEG"), ("bmp", "BMP"))
    ),
    pytest.param("a.tif", picture(NOISE, kind="TIFF")[:1000], DAMAGED, marks=APART),
    ("a.mgh", b"\0\0\0\1" + bytes(400), "not an image of this kind"),
    (
        "a.mhd",
        b"NDims = 3\nDimSize = 3 4 5\nElementType = MET_SHORT\nElementDataFile = gone.raw\n",
        DAMAGED,
    ),
    ("a.nii", nifti(ramp(3, 4, 5, dtype=np.complex64)), "complex"),
    ("a.nii", nifti(np.zeros((3, 4, 5), [(c, "u1") for c in "RGB"])), "convert RGB to grey"),
    *(("a.nii", nifti(data), r"1 voxels are infinite, .*\(1, 2, 3\)") for data in NOT_FINITE),
    *(
        (
            "a.nii",
            nifti(np.zeros(shape, np.int16)),
            "at least one voxel along every|expected voxels along every axis",
        )
        for shape in ((3, 0, 5), (3, 4, 5, 0))
    ),
    ("a.nii", nifti(ramp(7)), "expected 2 or 3 axes"),
    (
        "a.dscalar.nii",
        nibabel.Cifti2Image(np.zeros((1, 7)), AXES).to_bytes(),
        "voxel grid, got a Cifti2Image",
    ),
    ("a.png", picture(COLOURS), "colour .*RGB.*convert it to grey"),
    ("a.png", picture(ROWS, "P"), "mode P.*convert it to grey"),
    *(
        ("a.png", picture(ROWS, mode, alpha=254), "transparency.*convert it to grey")
        for mode in ("RGBA", "LA")
    ),
]


@pytest.mark.parametrize(("name", "raw", "words"), REFUSED)
def test_files_that_cannot_be_used(here, name, raw, words):
    if raw is not None:
        (here / name).write_bytes(raw)
    assert_refused(name, words)


def test_flipped_bit_in_a_compressed_file(tmp_path):
    """Stored, not deflated, blocks of 1 MiB in all, which are read at once: only the checksum
    behind the last voxel can tell.
    """
    data, path = ramp(32, 3, 10919, dtype=np.uint8), tmp_path / "a.nii.gz"
    packed = bytearray(gzip.compress(nifti(data), compresslevel=0))
    path.write_bytes(packed)
    assert_array_equal(load_image(path).data, data)
    packed[-20] ^= 1
    path.write_bytes(packed)
    assert_refused(path, f"{DAMAGED}; copy it again .*CRC")


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX permissions")
@pytest.mark.parametrize("name", ["a.nii", "folder"])
def test_permission_denied(tmp_path, name):
    path = tmp_path / name
    path.mkdir() if name == "folder" else path.write_bytes(WHOLE)
    path.chmod(0)
    # Root may read everything; be nobody for a moment.
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        for load in (load_image, sha256):
            assert_refused(path, "permission denied", load)
    finally:
        if is_root:
            os.seteuid(0)
        path.chmod(0o700)


@pytest.mark.parametrize(
    ("column", "match"),
    [([0.0, 0.0, 0.0], "singular"), ([-0.75, 0.12, 0.05], "singular"), ([np.nan] * 3, "finite")],
)
@pytest.mark.parametrize("shape", [(3, 4, 5), (3, 4)])
def test_singular_affine(tmp_path, column, match, shape):
    affine = OBLIQUE.copy()
    affine[:3, 1] = column
    rows = dict(zip(("srow_x", "srow_y", "srow_z"), affine, strict=False))
    path = save_nifti(tmp_path / "a.nii", ramp(*shape), None, sform_code=1, **rows)
    assert_refused(path, f"affine.*{match}")


# --------------------------------------------------------------------------------------------------
# Warnings

ONE = np.zeros((3, 4, 5), np.int16)
ONE[2, 3, 4] = 1
MGH = nibabel.MGHImage(ramp(3, 4, 5), np.eye(4)).to_bytes()


@pytest.mark.parametrize(
    ("name", "raw", "words"),
    [
        ("a.nii", nifti(ONE), None),
        (
            "a.nii",
            nifti(np.full_like(ONE, 7)),
            "the image is 7 everywhere, so E_D is 0 everywhere",
        ),
        (
            "a.nii",
            nifti(ONE, None),
            "has no orientation: position and left/right are nibabel's guess;",
        ),
        ("a.mgh", MGH, None),
        ("a.mgh", MGH[:28] + b"\0\0" + MGH[30:], "has no orientation: its voxel sizes"),
        *(
            ("a.nii", nifti(ONE, np.diag([step] * 3 + [1.0])), words and f"of its box is {words}")
            for step, words in ((800.0, "4000 mm"), (0.1, "0.5 mm"), (600.0, None), (0.2, None))
        ),
    ],
)
def test_warnings(here, name, raw, words):
    (here / name).write_bytes(raw)
    said = read_warned(name)[1]
    assert said == [] if words is None else words in said[0], said


def test_mended_header_is_a_warning_of_the_file(tmp_path, capfd):
    raw, path = bytearray(nifti(ramp(3, 4, 5), np.eye(4))), tmp_path / "a.nii"
    raw[88:92] = bytes(4)  # pixdim[3]
    path.write_bytes(raw)
    (said,) = read_warned(path)[1]
    assert said.startswith(
        "nibabel repaired its header (pixdim[1,2,3] should be non-zero; setting 0 dims to 1);"
    )
    raw[70:72] = (999).to_bytes(2, "little")  # datatype
    path.write_bytes(raw)
    assert_refused(path, "data code 999 not recognized")
    assert capfd.readouterr().err == ""  # nibabel's logger


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
        assert_array_equal(plane.to_world(index), image.to_world(whole)[others])
        assert plane.data[index] == image.data[tuple(whole)]
    assert not np.signbit(plane.affine[plane.affine == 0]).any()


TURN = np.array([[np.cos(0.2), 0, np.sin(0.2)], [0, 1, 0], [-np.sin(0.2), 0, np.cos(0.2)]])


@pytest.mark.parametrize(
    ("columns", "axis", "expected"),
    [
        # array axes along world z, x, y: the plane is (x, y), or (x, z)
        ([[0, -2, 0], [0, 0, 3], [-4, 0, 0]], 0, [[-2, 0, 5], [0, 3, 6], [0, 0, 1]]),
        ([[0, -2, 0], [0, 0, 3], [-4, 0, 0]], 2, [[0, -2, 5], [-4, 0, 7], [0, 0, 1]]),
        # a little oblique: a frame points along its largest component
        (TURN @ np.diag([-2.0, 3.0, 1.0]), 2, np.diag([-2.0, 3.0, 1.0])),
    ],
)
def test_axes_of_a_slice(columns, axis, expected):
    affine = np.eye(4)
    affine[:3, :3] = columns
    if np.all(columns == np.rint(columns)):
        affine[:3, 3] = [5, 6, 7]
    plane = image_slice(Image(ramp(3, 4, 5), affine), axis, 0)
    assert_allclose(plane.affine, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_oblique_slice_keeps_lengths_and_angles(axis):
    """Two slices differ in their origin by the in-plane part of the step between them."""
    image = Image(ramp(3, 4, 5), OBLIQUE)
    first, plane = image_slice(image, axis, 0), image_slice(image, axis, 1)
    assert_array_equal(plane.data, np.take(ramp(3, 4, 5), 1, axis))
    index = np.array(list(np.ndindex(plane.shape)))
    flat = plane.to_world(index)
    space = image.to_world(np.insert(index, axis, 1, axis=1))
    # All scalar products of differences, hence all lengths and angles.
    flat, space = flat - flat[0], space - space[0]
    assert_allclose(flat @ flat.T, space @ space.T, rtol=0, atol=1e-11)
    assert_array_equal(first.affine[:2, :2], plane.affine[:2, :2])
    in_plane = first.affine[:2, :2].T @ (plane.affine[:2, 2] - first.affine[:2, 2])
    others = np.delete(OBLIQUE[:3, :3], axis, axis=1)
    assert_allclose(in_plane, others.T @ OBLIQUE[:3, axis], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "axis", "index", "match"),
    [
        *(((3, 4, 5), axis, 0, f"axis 0, 1 or 2, got {axis}") for axis in (3, -1)),
        *(((3, 4, 5), 1, k, f"an index from 0 to 3 along axis 1, got {k}") for k in (4, -1)),
        ((3, 4), 0, 0, "slice: expected a 3-D image"),
    ],
)
def test_slice_out_of_range(shape, axis, index, match):
    with refusal(match):
        image_slice(Image(ramp(*shape)), axis, index)


# --------------------------------------------------------------------------------------------------
# Crops


@pytest.mark.parametrize(
    "bounds",
    [
        [(1, 3), (0, 2), (2, 5)],
        [(None, None), (1, None), (None, 4)],
        [(None, None)] * 3,
        [(1, 3), (2, None)],
    ],
)
def test_crop_leaves_voxels_where_they_are(bounds):
    n = len(bounds)
    image = Image(ramp(3, 4, 5) if n == 3 else ramp(4, 5), OBLIQUE[-n - 1 :, -n - 1 :])
    small = crop_image(image, bounds)
    assert_array_equal(small.data, image.data[tuple(slice(*each) for each in bounds)])
    index = np.array(list(np.ndindex(small.shape)))
    start = [low or 0 for low, _ in bounds]
    assert_allclose(small.to_world(index), image.to_world(index + start), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("bounds", "match"),
    [
        *(
            ([(None, None), ends, (None, None)], "expected 0 <= start < stop <= 4 along axis 1")
            for ends in ((2, 2), (3, 2), (-1, 2), (0, 5), (4, None), (None, 0), (None, -1))
        ),
        *(([(None, None)] * n, f"expected 3 ranges for shape .*, got {n}") for n in (0, 2, 4)),
    ],
)
def test_crop_out_of_range(bounds, match):
    with refusal(match):
        crop_image(Image(ramp(3, 4, 5)), bounds)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_load_with_volume_crop_and_slice(tmp_path, axis):
    """The same voxels at the same place as slicing the whole volume, with indices of the whole
    volume.
    """
    path = save_nifti(tmp_path / "a.nii", ramp(5, 6, 7, 2))
    bounds = [(1, 4), (2, None), (None, 6)]
    loaded = load_image(path, volume=1, crop=bounds, slice_=(axis, 3))
    plane = load_image(path, volume=1, slice_=(axis, 3))
    assert_array_equal(plane.data, ramp(5, 6, 7, 2)[..., 1].take(3, axis))
    expected = crop_image(plane, bounds[:axis] + bounds[axis + 1 :])
    assert_array_equal(loaded.data, expected.data)
    assert_array_equal(loaded.affine, expected.affine)
    # And the documented order: crop first, then the slice of the crop.
    start = bounds[axis][0] or 0
    other_way = image_slice(load_image(path, volume=1, crop=bounds), axis, 3 - start)
    assert_array_equal(loaded.data, other_way.data)
    assert_allclose(loaded.affine, other_way.affine, rtol=0, atol=1e-13)


OPEN = (None, None)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"slice_": (2, 7)}, "slice: expected an index from 0 to 6 along axis 2, got 7"),
        ({"crop": [(0, 9), OPEN, OPEN]}, "crop: expected .* <= 5 along axis 0, got 0:9"),
        ({"crop": [OPEN, OPEN]}, "crop: expected 3 ranges"),
        *(
            ({"crop": [OPEN, OPEN, (2, 5)], "slice_": (2, k)}, f"index {k} .*outside the crop 2:5")
            for k in (5, 1)
        ),
    ],
)
def test_load_with_bad_parts(tmp_path, options, match):
    assert_refused(save_nifti(tmp_path / "a.nii", ramp(5, 6, 7)), match, **options)


def test_picture_has_no_slices(here):
    (here / "a.png").write_bytes(picture(ROWS))
    assert_refused("a.png", "slice: expected a 3-D image", slice_=(0, 0))


# --------------------------------------------------------------------------------------------------
# Text and checksum


@pytest.mark.parametrize(
    ("parse", "text", "expected"),
    [
        (parse_crop, "10:100,:,5:", [(10, 100), (None, None), (5, None)]),
        (parse_crop, ":7,3:4", [(None, 7), (3, 4)]),
        (parse_crop, " 1 : 2 , : ", [(1, 2), (None, None)]),
        (parse_slice, "0=1", (0, 1)),
        (parse_slice, "1=20", (1, 20)),
        (parse_slice, "2=90", (2, 90)),
        (parse_slice, "i=1", (0, 1)),
        (parse_slice, "j=2", (1, 2)),
        (parse_slice, " k = 3 ", (2, 3)),
    ],
)
def test_parts_in_text(parse, text, expected):
    assert parse(text) == expected


CROPS = ["", "5", "1:2,", "-1:2", "1:2:3", "a:b", "1.5:2", "1-2,3-4", "²:3", "1:2;3:4", "\n"]
SLICES = ["", "2", "3=1", "x=1", "z=90", "2=-1", "2=1.5", "2=", "=5", "ij=1", "2:90", "2=²"]


@pytest.mark.parametrize(
    ("parse", "text", "match"),
    [
        *((parse_crop, text, 'such as "10:100,:,5:", got "') for text in CROPS),
        *((parse_slice, text, 'such as "2=90" or "k=90", got "') for text in SLICES),
    ],
)
def test_parts_that_are_none(parse, text, match):
    with refusal(match):
        parse(text)


def test_sha256_of_files(tmp_path):
    """Of a folder, those in it but not in its folders, in the order of their names."""
    with refusal(r"^nowhere: no such file or folder"):
        sha256(Path("nowhere"))
    for name, content in (("b", b"second"), ("c", b"third"), ("a", b"first")):
        (tmp_path / name).write_bytes(content)
    assert sha256(str(tmp_path / "a")) == hashlib.sha256(b"first").hexdigest()
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "d").write_bytes(b"not read")
    assert sha256(tmp_path) == hashlib.sha256(b"firstsecondthird").hexdigest()


@pytest.mark.parametrize("name", ["a.mhd", "a.nhdr"])
def test_sha256_of_a_header_is_that_of_its_voxels_too(tmp_path, name):
    """They lie in a file beside it, which may be another while the header stays the same."""
    sitk.WriteImage(sitk.GetImageFromArray(ramp(4, 5, 6)), str(tmp_path / name))
    whole = (tmp_path / name).read_bytes() + (tmp_path / "a.raw").read_bytes()
    assert sha256(tmp_path / name) == hashlib.sha256(whole).hexdigest()
    (tmp_path / name).write_bytes(b"no header")
    assert sha256(tmp_path / name) == hashlib.sha256(b"no header").hexdigest()


@pytest.mark.parametrize("name", ["~a.nii", "~a.nii.gz", "~root/a.nii", "~\udc80.nii.gz"])
def test_a_name_that_begins_with_a_tilde_is_no_home(here, name):
    """Not even of a user that there is: nibabel would read, and write, what lies there."""
    Path("~root").mkdir()
    save_image(name, Image(ramp(2, 3, 4).astype(float)))
    assert (here / name).is_file()
    assert_array_equal(load_image(name).data, ramp(2, 3, 4))
    assert file_shape(Path(name)) == (2, 3, 4)
