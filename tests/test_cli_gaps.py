"""Voxels without a value (NaN), and padding: nothing outside a mask, or a mesh, counts, and nothing
within is passed over, in every command and in Python.
"""

import nibabel
import numpy as np
import pytest
import scipy
from commands import assert_done, assert_refuses, in_copy_of, numbers_in, run_command
from numpy.testing import assert_allclose, assert_array_equal
from readers import read_warned
from refusals import refusal

import tetopt
from tetopt import Image, content, foreground_mask, load_image, load_mesh, save_image
from tetopt.contents.align import background_level, resample_contrast, resample_mask
from tetopt.contents.probabilities import tissue_labels
from tetopt.io.images import save_voxels

pytestmark = pytest.mark.full
AFFINE = np.diag([1.2, -1.1, 1.5, 1.0])
here = in_copy_of("maps")
SHAPE = (16, 15, 14)
PLACE = np.indices(SHAPE) - np.array([7.0, 7.0, 6.0])[:, None, None, None]
ORGAN = (PLACE**2).sum(axis=0) <= 25.0
STIFF = np.where(ORGAN, 2000.0 + 100.0 * PLACE[0], np.nan)
WITHIN = r"NaN.*index \[7, 7, 6\], \(8.4, -7.7, 9\) mm.*mask"
FEW = "--nodes 90 --iterations 1 --force"


def with_gap():
    """The map, and no value in the organ's middle."""
    return np.where((PLACE == 0.0).all(axis=0), np.nan, STIFF)


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A map of an organ, its mask, with NaN for 0, and labels; the map with a gap within the
    organ; a mesh within the mask, and one of another program around fewer voxels.
    """
    folder = tmp_path_factory.mktemp("maps")
    image = Image(STIFF, AFFINE)
    for name, data in (
        ("stiff", STIFF),
        ("gap", with_gap()),
        ("organ", 1.0 * ORGAN),
        ("nan_mask", np.where(ORGAN, 1.0, np.nan)),
        ("nan_labels", np.where(ORGAN, 1.0 + (PLACE[0] > 0.0), np.nan)),
        ("whole", np.where(ORGAN, 5.0, 1.0)),
        ("sizes", np.where(ORGAN, 9.0, np.nan)),
    ):
        save_voxels(folder / f"{name}.nii.gz", data.astype(np.float32), image)
    assert_done(f"mesh {folder}/stiff.nii.gz --mask {folder}/organ.nii.gz -o {folder}/a.vtu {FEW}")
    small = image.box((4, 4, 4), (11, 11, 9))
    tetopt.save_mesh(folder / "other.vtu", tetopt.lattice_mesh(small, nodes=60))
    return folder


@pytest.mark.parametrize("mask", ["organ", "nan_mask"])
def test_outside_a_mask_no_value_is_needed(mask):
    assert_done(f"mesh stiff.nii.gz --mask {mask}.nii.gz -o b.vtu --young h/1000 {FEW}")
    mesh = load_mesh("b.vtu")
    x = mesh.mesh.points[mesh.mesh.cells].mean(axis=1)[:, 0] / 1.2 - 7.0
    assert_allclose(mesh.cell_data["young"], 2.0 + 0.1 * x, atol=0.2)
    assert mesh.mesh.cell_volumes.sum() == pytest.approx(ORGAN.sum() * 1.98, rel=0.05)


@pytest.mark.parametrize(
    "words",
    [
        "mesh gap.nii.gz --mask organ.nii.gz -o b.vtu",
        "mesh whole.nii.gz gap.nii.gz --mask organ.nii.gz -o b.vtu",
        "convert a.vtu b.vtu --image gap.nii.gz --young h/1000",
        "convert other.vtu b.vtu --image gap.nii.gz --young h/1000",
        "quality other.vtu --image gap.nii.gz",
        "segment gap.nii.gz other.vtu -o b.nii.gz",
    ],
)
def test_a_gap_within_is_refused_with_its_place(words, here):
    ended = run_command(words, code=2)
    with refusal(WITHIN):
        raise tetopt.InputError(ended.err.splitlines()[-1])
    assert here() == []


def test_without_a_mask_the_place_and_the_remedy_are_told():
    assert_refuses("mesh stiff.nii.gz -o b.vtu", r"NaN.*index \[0, 0, 0\].*`?-?-?mask")


@pytest.mark.parametrize(
    "words",
    [
        "quality other.vtu --image stiff.nii.gz --json n.json",
        "quality a.vtu --image stiff.nii.gz --json n.json",
        "convert other.vtu n.vtu --image stiff.nii.gz --young h/1000 --average harmonic",
        "mesh stiff.nii.gz --background auto -o n.vtu --nodes 90 --iterations 1",
        "mesh nan_labels.nii.gz --labels nan_labels.nii.gz -o n.vtu --nodes 90 --iterations 1",
        "mesh whole.nii.gz --tissues nan_mask.nii.gz -o n.vtu --nodes 90 --iterations 1",
        "mesh whole.nii.gz --sizing sizes.nii.gz -o n.vtu --nodes 90 --iterations 1",
    ],
)
def test_beyond_a_mesh_and_in_labels_no_value_is_needed(words):
    run_command(words, code=None)
    if "n.json" in words:
        assert 0.0 <= numbers_in("n.json")["fit"]["E_D"] < np.inf


def test_our_own_images_of_fields_are_read():
    assert_done("convert a.vtu own.nii.gz --like whole.nii.gz --fields mean")
    own = load_image("own.nii.gz")
    assert own.has_gaps
    save_image("valued.nii.gz", Image(1.0 * ~np.isnan(own.data), own.affine))
    run_command(f"mesh own.nii.gz --mask valued.nii.gz -o b.vtu {FEW}", code=None)
    run_command(f"mesh own.nii.gz --background auto -o c.vtu {FEW}", code=None)
    for name in "bc":
        volume = load_mesh(f"{name}.vtu").mesh.cell_volumes.sum()
        assert volume == pytest.approx(np.isfinite(own.data).sum() * 1.98, rel=0.05)


@pytest.mark.parametrize("suffix", [".nii", ".mgz", ".nrrd"])
def test_the_grid_of_any_volume_in_any_format(suffix):
    four = nibabel.Nifti1Image(np.zeros((*SHAPE, 3), "i2"), AFFINE)
    nibabel.save(four, "four.nii.gz")
    assert_done("convert a.vtu own.nii.gz --like whole.nii.gz --fields mean")
    is_gap = np.isnan(load_image("own.nii.gz").data)
    assert_refuses("convert a.vtu b.mha --like whole.nii.gz --fields mean", r"\.vtu.*\.mgz, \.nrrd")
    for like in ("whole.nii.gz", "four.nii.gz:1", "four.nii.gz"):
        assert_done(f"convert a.vtu own{suffix} --like {like} --fields mean --force")
        image = load_image(f"own{suffix}")
        assert image.shape == SHAPE
        assert_allclose(image.affine, AFFINE, atol=1e-6)
        assert_array_equal(np.isnan(image.data), is_gap)


def test_from_python():
    image, mask = Image(STIFF, AFFINE), Image(1.0 * ORGAN, AFFINE)
    gap = Image(with_gap(), AFFINE)
    mesh = load_mesh("other.vtu").mesh
    assert image.has_gaps
    assert image.range == (1500.0, 2500.0)
    assert content(image, mask=mask).spread.low == 1500.0
    assert tetopt.cell_fields(mesh, image)["mean"].min() >= 1500.0
    assert tetopt.build_model(mesh, image=image, young="h/1000").materials.young.min() >= 1.5
    for refused in (
        lambda: content(gap, mask=mask),
        lambda: content([image, gap], mask=mask),
        lambda: tetopt.cell_moments(gap, mesh),
        lambda: tetopt.build_model(mesh, image=gap, young="h/1000"),
    ):
        with refusal(WITHIN):
            refused()
    with refusal(r"NaN.*index \[0, 0, 0\]"):
        tetopt.mesh_image(image, 50)
    with refusal("infinite"):
        Image(np.array([[0.0, np.inf]]))
    with refusal("NaN in all"):
        Image(np.full((3, 3), np.nan))


def test_where_a_mask_or_a_map_has_no_value():
    tissues = [Image(np.array([row])) for row in ([0.2, np.nan, 0.6], [np.nan, 0.8, np.nan])]
    assert tissue_labels(tissues).data.tolist() == [[0.0, 2.0, 1.0]]
    image = Image(STIFF, AFFINE)
    assert_array_equal(foreground_mask(image).data, ORGAN)
    mask = resample_mask(Image(np.where(ORGAN, 1.0, np.nan), AFFINE), image)
    assert_array_equal(mask.data, ORGAN)


def test_a_value_reaches_half_way_to_a_voxel_without_one():
    row = Image(np.array([[2.0, 4.0, np.nan, np.nan]] * 3), np.eye(3))
    fine = Image(np.zeros((3, 16)), [[1, 0, 0], [0, 0.25, -0.375], [0, 0, 1]])
    moved = resample_contrast(row, fine).data[1]
    assert_allclose(moved[4:8], [3.25, 3.75, 4.0, 4.0])
    assert np.isnan(moved).tolist() == [False] * 8 + [True] * 8


# Padding


def scan(outside, beyond=11.0, noise=10.0, body=6.0):
    """A CT of a body in air, with padding beyond a radius."""
    r = np.hypot(*(np.indices((26, 26, 12))[:2] - 12.5))
    h = np.where(r < body, 40.0, -1000.0) + np.random.default_rng(0).normal(0.0, noise, r.shape)
    h[r > beyond] = outside
    return np.round(h), r


@pytest.mark.parametrize("value", [-3024.0, -2000.0, -1500.0, -32768.0])
def test_padding_of_ct_counts_as_air(tmp_path, value):
    h, r = scan(value)
    save_image(tmp_path / "a.nii.gz", Image(h, AFFINE))
    image, said = read_warned(tmp_path / "a.nii.gz")
    assert "padding" in said[0]
    assert f"{value:g}" in said[0]
    is_padding = r > 11.0
    assert_array_equal(image.data[~is_padding], h[~is_padding])
    assert np.abs(image.data[is_padding] + 1000.0).max() < 45.0
    assert image.data[is_padding].std() == pytest.approx(10.0, rel=0.1)
    assert_array_equal(foreground_mask(image).data, r < 6.0)


def test_padding_that_was_interpolated():
    h, r = scan(-3024.0)
    h[(r > 11.0) & (r < 11.8)] = -2000.0
    save_image("a.nii.gz", Image(h, AFFINE))
    assert read_warned("a.nii.gz")[0].range[0] > -1100.0


@pytest.mark.parametrize("order", [1, 3, 5])
def test_padding_of_a_resampled_scan(order):
    """Splines overshoot at its edge, by a fifth of the step, and ripple in the air beside it."""
    h = scipy.ndimage.zoom(np.kron(scan(-3024.0)[0], np.ones((4, 4, 1))), 1.5, order=order)
    save_image("a.nii.gz", Image(h, AFFINE))
    image, said = read_warned("a.nii.gz")
    assert "padding" in said[0]
    assert image.data.min() > -1400.0


@pytest.mark.parametrize("kind", ["lower", "mixed"])
def test_padding_beside_other_values(tmp_path, kind):
    h, r = scan(-3024.0)
    if kind == "lower":
        h[12, 12, 6] = -5000.0
    else:
        h[(r <= 11.0) & (np.arange(12) % 2 > 0)] = 40.0
    save_image(tmp_path / "a.nii.gz", Image(h, AFFINE))
    image, said = read_warned(tmp_path / "a.nii.gz")
    assert "padding" in said[0]
    assert np.mean(image.data < -1100.0) < 0.001


@pytest.mark.parametrize(
    "data",
    [
        scan(-1024.0, noise=20.0)[0],  # no lower than the noise of air
        scan(-3024.0, beyond=50.0)[0],  # none
        np.maximum(-1500.0 + 10.0 * np.indices((60, 8, 8))[0] - 100.0, -1500.0),  # distances
        np.round(np.linspace(-1500.0, 1000.0, 60 * 64)).reshape(60, 8, 8),
        np.where(scan(0.0)[1] < 5.0, 300.0, 0.0),
        np.where(scan(0.0)[1] < 5.0, 1.0, -5.0),
        np.where((scan(0.0)[1] < 2.0) & (np.arange(12) % 11 > 0), -3024.0, -1000.0),  # within it
    ],
)
def test_images_without_padding_are_as_they_are(tmp_path, data):
    save_image(tmp_path / "a.nii.gz", Image(data, AFFINE))
    image, said = read_warned(tmp_path / "a.nii.gz")
    assert_array_equal(image.data, data)
    assert said == []


def test_the_background_beside_constant_padding_has_the_noise_of_air():
    image = Image(np.pad(scan(-1000.0)[0], 4, constant_values=-1000.0), AFFINE)
    assert -1000.0 < background_level(image) < -900.0
    body = np.pad(scan(0.0)[1] < 6.0, 4)
    assert_array_equal(foreground_mask(image).data, body)


def test_the_background_of_an_organ_that_was_cut_out_is_its_value():
    h, r = scan(-3024.0, beyond=5.0)
    save_image("a.nii.gz", Image(h, AFFINE))
    image, said = read_warned("a.nii.gz")
    assert_array_equal(image.data, h)
    assert "down to -3024, without air beside them: exclude them by `mask` or" in said[0]
    assert_array_equal(foreground_mask(Image(h, AFFINE)).data, r <= 5.0)
    assert background_level(Image(h, AFFINE)) == -3024.0
