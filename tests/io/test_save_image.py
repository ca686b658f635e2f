"""Images out: every voxel and its place come back from the file, bit for bit where NIfTI can
hold it.
"""

from pathlib import Path

import nibabel
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from tetopt.image import Image
from tetopt.io.images import load_image, save_image

# Columns are rotated, sheared and flipped, of 0.8, 0.8 and 5 mm.
OBLIQUE = np.array(
    [[-0.75, 0.31, 1.1, 12.5], [0.12, 0.68, -0.9, -33.0], [0.05, -0.22, 5.1, 7.25], [0, 0, 0, 1.0]]
)
SHEARED = np.array([[1.5, 0.4, -7.25], [-0.3, -0.8, 100.1], [0, 0, 1.0]])
AFFINES = {
    "identity-2": np.eye(3),
    "sheared-2": SHEARED,
    "identity-3": np.eye(4),
    "oblique-3": OBLIQUE,
    "far-3": OBLIQUE + np.array([[0, 0, 0, 1000.0]] * 3 + [[0, 0, 0, 0]]),
}
SHAPES = {3: (5, 7), 4: (4, 5, 6)}


def values(shape, dtype):
    """Noise; as float64 of a kind that float32 cannot hold."""
    noise = np.random.default_rng(0).normal(100.0, 30.0, shape)
    return noise.astype(dtype)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("affine", AFFINES.values(), ids=AFFINES)
def test_round_trip(here, affine, dtype, suffix):
    image = Image(values(SHAPES[len(affine)], dtype), affine)
    save_image(f"a{suffix}", image)
    back = load_image(f"a{suffix}")
    assert back.data.dtype == dtype
    assert_array_equal(back.data, image.data)
    # NIfTI's sform is float32.
    assert_array_equal(back.affine, affine.astype(np.float32).astype(np.float64))
    assert [p.name for p in here.iterdir()] == [f"a{suffix}"]


def test_a_plane_lies_at_z_0(here):
    save_image("a.nii", Image(values((5, 7), np.float32), SHEARED))
    file = nibabel.load(here / "a.nii")
    assert file.shape == (5, 7)
    assert_allclose(
        file.affine @ [2.0, 3.0, 0.0, 1.0], [*(SHEARED @ [2.0, 3.0, 1.0])[:2], 0.0, 1.0]
    )


@pytest.mark.parametrize("name", ["a", "a.mha", "a.nii.zip", "a.img", "a.hdr", "a.png", "nii"])
def test_a_name_of_another_format_is_refused(name, here):
    with refusal(r"expected a name ending in \.nii or \.nii\.gz"):
        save_image(name, Image(np.arange(24.0).reshape(2, 3, 4)))
    assert list(here.iterdir()) == []


@pytest.mark.parametrize("name", ["a.nii.gz", "A.NII"])
def test_an_image_that_reads_back_otherwise_does_not_replace_the_old_one(name, here, monkeypatch):
    image = Image(np.arange(24.0).reshape(2, 3, 4))
    save_image(name, image)
    before, write = (here / name).read_bytes(), Path.write_bytes
    for damaged in (lambda whole: whole[:-5], lambda whole: whole[:-1] + bytes([whole[-1] ^ 1])):
        monkeypatch.setattr(
            Path, "write_bytes", lambda self, whole, damaged=damaged: write(self, damaged(whole))
        )
        with pytest.raises(OSError, match="reads back differently"):
            save_image(name, image)
        assert (here / name).read_bytes() == before
    assert [path.name for path in here.iterdir()] == [name]


def test_an_axis_too_long_for_nifti_1_goes_into_nifti_2(here):
    image = Image(np.arange(32768.0 * 2).reshape(2, 32768), SHEARED)
    save_image("a.nii.gz", image)
    assert isinstance(nibabel.load(here / "a.nii.gz"), nibabel.Nifti2Image)
    back = load_image("a.nii.gz")
    assert_array_equal(back.data, image.data)
    assert_array_equal(back.affine, image.affine)
