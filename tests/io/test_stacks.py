"""TIFF stacks and folders of slices: voxel sizes, order, and what is refused."""

from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from commands import assert_refused as assert_command_refused
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from tetopt.io.images import load_image

tifffile = pytest.importorskip("tifffile")
pytestmark = pytest.mark.usefixtures("here")
VOXELS = np.arange(10 * 5 * 7, dtype=np.uint16).reshape(10, 5, 7)  # slices, rows, columns


def stack(voxels=VOXELS, path="a.tif", **options):
    tifffile.imwrite(path, voxels, **options)
    return Path(path)


def folder_of(folder, numbers, suffix=".tif"):
    for number in numbers:
        PIL.Image.fromarray((VOXELS[number % 10] % 256).astype(np.uint8)).save(
            folder / f"scan_v2_{number}{suffix}"
        )
    return folder


IMAGEJ = {"spacing": 30, "unit": "um", "axes": "ZYX"}
CALIBRATED = {  # options of tifffile, voxel sizes
    "ImageJ, um": (
        {"imagej": True, "resolution": (0.05, 0.025), "metadata": IMAGEJ},
        [0.02, 0.04, 0.03],
    ),
    "ImageJ, channels": (
        {"imagej": True, "resolution": (20, 20), "metadata": {"spacing": 0.05, "unit": "mm"}},
        [0.05] * 3,
    ),
    "OME, um": (
        {
            "ome": True,
            "metadata": {
                "axes": "ZYX",
                "PhysicalSizeX": 20,
                "PhysicalSizeY": 20,
                "PhysicalSizeZ": 0.03,
                "PhysicalSizeZUnit": "mm",
            },
        },
        [0.02, 0.02, 0.03],
    ),
}


@pytest.mark.parametrize("name", CALIBRATED)
def test_calibrated_stack(name):
    options, steps = CALIBRATED[name]
    path = stack(**options)
    image = load_image(path)
    assert_array_equal(image.data, VOXELS.T)
    assert_allclose(image.affine, np.diag([-steps[0], -steps[1], steps[2], 1.0]))
    assert load_image(path, spacing_mm=steps).shape == (7, 5, 10)
    assert_refused(path, r"but `spacing_mm` is 0\.1 x 0\.1 x 0\.1", spacing_mm=0.1)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"resolution": (500, 500), "resolutionunit": 3},
        {"imagej": True, "resolution": (20, 20), "metadata": {"unit": "mm", "axes": "ZYX"}},
        {"imagej": True, "metadata": {"unit": "pixel", "spacing": 2.0, "axes": "ZYX"}},
    ],
)
def test_stack_without_voxel_size(options):
    path = stack(**options)
    assert_refused(path, r"this stack of 10 slices states no voxel size .*unknown mm.*`spacing_mm`")
    if options.get("imagej") is None:
        assert load_image(path, spacing_mm=[0.02, 0.02, 0.05]).spacing.tolist() == [
            0.02,
            0.02,
            0.05,
        ]


@pytest.mark.parametrize(
    ("voxels", "options", "match"),
    [
        (VOXELS[:, None], {"imagej": True, "metadata": {"axes": "TZYX"}}, "got 10 time points"),
        (
            np.stack([VOXELS] * 2, 1),
            {"imagej": True, "metadata": {"axes": "ZCYX"}},
            "got 2 channels",
        ),
        (np.stack([VOXELS] * 3, -1), {"photometric": "rgb"}, "got 3 colours"),
        (VOXELS, {"ome": True, "metadata": {"axes": "TYX"}}, "got 10 time points"),
    ],
)
def test_stacks_of_no_volume(voxels, options, match):
    assert_refused(stack(voxels, **options), match, spacing_mm=1.0)


def test_truncated_stack():
    path = stack()
    path.write_bytes(path.read_bytes()[:500])
    assert_refused(path, "truncated or damaged; copy it again", spacing_mm=1.0)


@pytest.mark.parametrize("suffix", [".tif", ".png", ".bmp"])
def test_folder_of_slices(tmp_path, suffix):
    """In the order of their numbers, 8, 9, 10, 11."""
    path = folder_of(tmp_path, range(8, 12), suffix)
    image = load_image(path, spacing_mm=0.02)
    assert_array_equal(image.data, (VOXELS[[8, 9, 0, 1]] % 256).T)
    assert_allclose(image.affine, np.diag([-0.02, -0.02, 0.02, 1.0]))
    assert_refused(path, "this folder of 4 slices states no voxel size")
    (path / f"scan_v2_10{suffix}").unlink()
    assert_refused(
        path,
        f"got scan_v2_9{suffix} followed by scan_v2_11{suffix}; a slice is missing",
        spacing_mm=0.02,
    )


def sliced(voxels=VOXELS, **options):
    folder = Path("d")
    folder.mkdir(exist_ok=True)
    for k, plane in enumerate(voxels):
        stack(plane, folder / f"s{k}.tif", **options)
    return folder


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    "options",
    [{"photometric": "miniswhite"}, *({"extratags": [(274, 3, 1, k, True)]} for k in (2, 3, 4))],
)
def test_stack_and_folder_of_the_same_slices_agree(kind, options):
    """Values are as stored, and the first voxel is where Orientation says."""
    voxels = VOXELS.astype(kind)
    images = [
        load_image(each, spacing_mm=1)
        for each in (stack(voxels, **options), sliced(voxels, **options))
    ]
    right = {2: voxels[:, :, ::-1], 3: voxels[:, ::-1, ::-1], 4: voxels[:, ::-1]}.get(
        options.get("extratags", [[0] * 4])[0][3], voxels
    )
    for image in images:
        assert_array_equal(image.data, right.T)
    assert_array_equal(*(image.affine for image in images))


def test_order_of_ome_and_its_full_level():
    planes = "".join(f'<TiffData IFD="{k}" FirstZ="{9 - k}" PlaneCount="1"/>' for k in range(10))
    words = (
        '<?xml version="1.0"?><OME '
        'xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        '<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" SizeX="7" SizeY="5" '
        'SizeZ="10" SizeC="1" SizeT="1" '
        f'PhysicalSizeX="20" PhysicalSizeY="20" PhysicalSizeZ="20">{planes}</Pixels></Image></OME>'
    )
    with tifffile.TiffWriter("a.ome.tif") as writer:
        for k, plane in enumerate(VOXELS):
            writer.write(
                plane, description=words if k == 0 else None, contiguous=False, metadata=None
            )
    assert_array_equal(load_image("a.ome.tif").data, VOXELS[::-1].T)
    with tifffile.TiffWriter("b.ome.tif", ome=True) as writer:
        writer.write(VOXELS, subifds=1, metadata={"axes": "ZYX"})
        writer.write(VOXELS[:, ::2, ::2], subfiletype=1)
    assert_array_equal(load_image("b.ome.tif", spacing_mm=1).data, VOXELS.T)


def test_calibrated_values_of_imagej():
    """As signed numbers of 16 bits, which ImageJ stores without a sign; a page and a folder have
    them, too.
    """
    line = {"cf": 0, "c0": -32768.0, "c1": 2.0}
    options = {
        "imagej": True,
        "resolution": (20, 10),
        "metadata": IMAGEJ | line | {"unit": "mm", "spacing": 0.5},
    }
    path = stack(**options)
    assert_array_equal(load_image(path).data, 2.0 * VOXELS.T - 32768)
    page = load_image(path, volume=3)
    assert_array_equal(page.data, 2.0 * VOXELS[3] - 32768)
    assert page.spacing.tolist() == pytest.approx([0.1, 0.05])
    assert_refused(
        path, r"voxels of 0\.05 x 0\.1 mm, but `spacing_mm` is 1 x 1", volume=3, spacing_mm=1
    )
    options["metadata"].pop("axes")
    folder = load_image(sliced(**options))
    assert_array_equal(folder.data, 2.0 * VOXELS.T - 32768)
    assert folder.spacing.tolist() == pytest.approx([0.05, 0.1, 0.5])
    assert_refused("d", r"0\.05 x 0\.1 x 0\.5 mm, but `spacing_mm` is 1 x 1 x 1", spacing_mm=1)
    stack(VOXELS[2], "d/s2.tif", **options | {"resolution": (20, 20)})
    assert_refused("d", r"s2\.tif: expected the pixel size and calibration of s0\.tif")
    options["metadata"] |= IMAGEJ | {"cf": 3}
    with pytest.warns(
        UserWarning, match="calibration of them is no straight line and is not applied"
    ):
        assert_array_equal(load_image(stack(**options)).data, VOXELS.T)


def test_slices_written_one_by_one():
    with tifffile.TiffWriter("a.tif") as writer:
        for plane in VOXELS:
            writer.write(plane)
    assert_array_equal(load_image("a.tif", spacing_mm=1).data, VOXELS.T)
    with tifffile.TiffWriter("b.tif") as writer:
        for plane in VOXELS[0], VOXELS[1, :3]:
            writer.write(plane)
    assert_refused("b.tif", "expected slices of one size and type, got 5 x 7, 3 x 7", spacing_mm=1)


def test_slices_that_differ(tmp_path):
    path = folder_of(tmp_path, range(4))
    PIL.Image.fromarray(VOXELS[0].astype(np.uint8)).save(path / "preview.png")
    with pytest.warns(
        UserWarning, match="preview.png does not belong to the series of scan_v2_0.tif"
    ):
        load_image(path, spacing_mm=1.0)
    PIL.Image.fromarray(VOXELS[0, :3].astype(np.uint8)).save(path / "scan_v2_2.tif")
    assert_refused(
        path, r"scan_v2_2.tif: expected 5 x 7 pixels of uint8, .* got 3 x 7", spacing_mm=1.0
    )
    folder_of(path, range(3), ".png")
    assert_refused(path, "expected one series of numbered slices", spacing_mm=1.0)


def test_a_command_names_its_option(capfd):
    path = stack()
    assert_command_refused(
        capfd, ["mesh", path, "-o a.vtu"], "states no voxel size .* --spacing-mm"
    )
    assert_command_refused(
        capfd,
        ["mesh", path, "-o a.vtu", "--spacing-mm", "x"],
        'expected one number or three, .*got "x"',
    )
