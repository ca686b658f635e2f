"""Images of AFNI, MINC, Analyze, GIPL, VTK and numpy, and lists of volumes in NRRD: each voxel
where the library that wrote the file has it, or a refusal.
"""

import gzip
from pathlib import Path

import nibabel
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from readers import OBLIQUE, ramp, read_warned
from refusals import assert_refused

from tetopt import Image, load_image, save_image
from tetopt.io.images import file_shape, image_files, save_voxels

pytestmark = [pytest.mark.usefixtures("here"), pytest.mark.apart]
DATA = ramp(4, 5, 6)
TURNED = np.eye(4)
TURNED[:3, :3] = np.linalg.qr(OBLIQUE[:3, :3])[0] * [1.2, 1.1, 1.5]
TURNED[:3, 3] = [5.0, -6.0, 7.0]
STRAIGHT = np.diag([1.2, 1.1, 1.5, 1.0])
STRAIGHT[:3, 3] = TURNED[:3, 3]
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def assert_read(name, affine, said, data=DATA, **options):
    image, heard = read_warned(name, **options)
    assert_array_equal(image.data, data)
    assert_allclose(image.affine, affine, atol=1e-5)
    assert [text for text in heard if said in text] == heard
    assert bool(heard) == bool(said)


@pytest.mark.parametrize("name", ["a.img", "a.hdr"])
def test_analyze(here, name):
    nibabel.save(nibabel.AnalyzeImage(DATA, np.diag([-1.2, 1.1, 1.5, 1.0])), "a.img")
    assert_read(name, nibabel.load("a.img").affine, "Analyze")
    (here / "a.mat").write_bytes(b"1")
    assert_refused("a.hdr", "SPM")


AFFINE_WORDS = " ".join(map(repr, (LPS @ TURNED)[:3].ravel().tolist()))


@pytest.mark.parametrize("name", ["a+orig.HEAD", "a+orig.BRIK"])
def test_afni(here, name):
    rows = [
        ("integer", "DATASET_RANK", "3 2"),
        ("integer", "DATASET_DIMENSIONS", "4 5 6 0 0"),
        ("integer", "BRICK_TYPES", "1 1"),
        ("float", "BRICK_FLOAT_FACS", "0 2.0"),
        ("float", "DELTA", "1.2 1.1 1.5"),
        ("float", "IJK_TO_DICOM_REAL", AFFINE_WORDS),
        ("integer", "SCENE_DATA", "0 2 0"),
    ]
    text = "".join(
        f"type = {kind}-attribute\nname = {key}\ncount = {len(words.split())}\n {words}\n\n"
        for kind, key, words in rows
    )
    text += "type = string-attribute\nname = BYTEORDER_STRING\ncount = 10\n'LSB_FIRST~\n\n"
    text += "type = string-attribute\nname = BRICK_LABS\ncount = 4\n'a~b~\n"
    (here / "a+orig.HEAD").write_text(text)
    both = np.stack([DATA, DATA], axis=-1).astype("<i2")
    (here / "a+orig.BRIK").write_bytes(both.tobytes(order="F"))
    assert_read(name, TURNED, "", data=2.0 * DATA, volume=1)
    assert_refused(name, "2 volumes")
    assert sorted(image_files(here / name)) == ["a+orig.BRIK", "a+orig.HEAD"]


def test_minc(here):
    h5py = pytest.importorskip("h5py")
    with h5py.File("a.mnc", "w") as file:
        for k, axis in enumerate("xyz"):
            row = file.create_dataset(f"minc-2.0/dimensions/{axis}space", data=0)
            row.attrs["step"], row.attrs["length"] = [1.2, 1.1, 1.5][k], DATA.shape[k]
            row.attrs["start"] = [5.0, -6.0, 7.0][k]
        image = file.create_dataset("minc-2.0/image/0/image", data=DATA.T.astype("i2"))
        image.attrs["dimorder"] = np.bytes_("zspace,yspace,xspace")
        image.attrs["valid_range"] = [-32768.0, 32767.0]
        for name, value in (("min", -32768.0), ("max", 32767.0)):
            each = file.create_dataset(f"minc-2.0/image/0/image-{name}", data=np.float64(value))
            each.attrs["dimorder"] = np.bytes_("")
    image = load_image("a.mnc")
    assert_allclose(image.data, DATA.T, atol=1e-6)
    assert_allclose(image.affine @ [1, 2, 3, 1], STRAIGHT @ [3, 2, 1, 1], atol=1e-6)


@pytest.mark.parametrize("name", ["a.vtk", "a.gipl", "a.gipl.gz"])
def test_files_of_itk(name):
    sitk = pytest.importorskip("SimpleITK")
    image = sitk.GetImageFromArray(DATA.T.copy())
    image.SetSpacing((1.2, 1.1, 1.5))
    image.SetOrigin((5.0, -6.0, 7.0))
    sitk.WriteImage(image, name)
    assert_read(name, LPS @ STRAIGHT, "LPS")


@pytest.mark.parametrize("at", ["point", "cell"])
def test_images_of_vtk(at):
    import pyvista

    shift = 0.5 * (at == "cell")
    grid = pyvista.ImageData(
        dimensions=np.add(DATA.shape, int(2 * shift)),
        spacing=(1.2, 1.1, 1.5),
        origin=TURNED[:3, 3],
    )
    grid.direction_matrix = TURNED[:3, :3] / [1.2, 1.1, 1.5]
    getattr(grid, f"{at}_data")["v"] = DATA.ravel(order="F")
    grid.save("a.vti")
    affine = TURNED.copy()
    affine[:3, 3] += TURNED[:3, :3] @ np.full(3, shift)
    assert_read("a.vti", affine, "RAS")
    grid.extract_subset((1, 3, 1, 3, 2, 4)).save("part.vti")
    affine[:3, 3] = (affine @ [1, 1, 2, 1])[:3]
    stop = 4 if at == "point" else 3
    assert_read("part.vti", affine, "RAS", data=DATA[1:stop, 1:stop, 2 : stop + 1])
    getattr(grid, f"{at}_data")["w"] = 2 * DATA.ravel(order="F")
    grid.save("a.vti")
    assert_refused("a.vti", f"2 volumes along v of {at}, w of {at}")
    assert load_image("a.vti", volume=1).data.max() == 240.0


@pytest.mark.parametrize("at", [("cell",), ("cell", "point")])
def test_values_of_cells_are_not_read_as_those_of_points(at):
    pytest.importorskip("SimpleITK")
    import pyvista

    grid = pyvista.ImageData(dimensions=np.add(DATA.shape, 1))
    for each in at:
        n = grid.n_cells if each == "cell" else grid.n_points
        getattr(grid, f"{each}_data")["v"] = np.arange(n, dtype=np.uint8 if n < 256 else np.int16)
    grid.save("a.vtk")
    assert_refused("a.vtk", "CELL_DATA.*vti")


def test_colours_of_vtk_are_no_image():
    import pyvista

    grid = pyvista.ImageData(dimensions=DATA.shape)
    grid.point_data["tint"] = np.zeros((DATA.size, 3), np.uint8)
    grid.save("a.vti")
    assert_refused("a.vti", "one number per point or cell.*tint")


def test_arrays():
    np.save("a.npy", np.stack([DATA, 2 * DATA], axis=-1))
    np.save("b.npy", DATA[0])
    assert_read(
        "a.npy", np.diag([1.2, 1.1, 1.5, 1]), "no place", spacing_mm=[1.2, 1.1, 1.5], volume=0
    )
    assert_read("b.npy", np.diag([2.0, 2.0, 1.0]), "no place", data=DATA[0], spacing_mm=2.0)
    assert_refused("b.npy", "spacing_mm")
    assert_refused("a.npy", "2 volumes", spacing_mm=1.0)
    np.save("c.npy", np.array([{}]), allow_pickle=True)
    assert_refused("c.npy", "damaged", spacing_mm=1.0)


def test_others_are_refused_with_a_program(here):
    (here / "a.mif").write_text("mrtrix image\n")
    assert_refused("a.mif", "mrconvert .*mif")


# Lists of volumes in NRRD


def nrrd(values, axis, kind, encoding="raw", name="a.nrrd", data_file=""):
    steps = [f"({','.join(map(repr, row))})" for row in (LPS @ TURNED)[:3, :3].T.tolist()]
    kinds = ["domain"] * 3
    steps.insert(axis, "none")
    kinds.insert(axis, kind)
    origin = ",".join(map(repr, (LPS @ TURNED)[:3, 3].tolist()))
    head = (
        f"NRRD0004\n# a comment\ntype: short\ndimension: 4\nspace: left-posterior-superior\n"
        f"sizes: {' '.join(map(str, values.shape))}\nspace directions: {' '.join(steps)}\n"
        f"space origin: ({origin})\nendian: little\nencoding: {encoding}\n"
    )
    head += f"kinds: {' '.join(kinds)}\n" if kind else ""
    voxels = values.astype("<i2").tobytes(order="F")
    voxels = gzip.compress(voxels) if encoding == "gzip" else voxels
    with open(name, "wb") as file:
        file.write((head + (f"data file: {data_file}\n" if data_file else "") + "\n").encode())
        if not data_file:
            file.write(voxels)
    if data_file:
        with open(data_file, "wb") as file:
            file.write(voxels)


@pytest.mark.parametrize(
    ("axis", "kind", "encoding"),
    [
        (0, "list", "raw"),
        (0, "time", "gzip"),
        (3, "list", "gzip"),
        (3, "time", "raw"),
        (3, "domain", "raw"),
        (1, "???", "raw"),
        (3, "", "raw"),
    ],
)
def test_a_list_of_volumes(here, axis, kind, encoding):
    pytest.importorskip("SimpleITK")
    values = np.moveaxis(np.stack([DATA, 2 * DATA, 3 * DATA]), 0, axis)
    nrrd(values, axis, kind, encoding)
    assert_read("a.nrrd", TURNED, "", data=2 * DATA, volume=1)
    assert file_shape("a.nrrd") == (4, 5, 6, 3)
    assert_refused("a.nrrd", "3 volumes")
    nrrd(values, axis, kind, encoding, "b.nhdr", "b b.raw")
    assert_read("b.nhdr", TURNED, "", data=3 * DATA, volume=2)


@pytest.mark.parametrize("kind", ["RGB-color", "vector", "3-vector"])
def test_components_are_no_volumes(kind):
    pytest.importorskip("SimpleITK")
    nrrd(np.stack([DATA] * 3), 0, kind)
    assert_refused("a.nrrd", "one number per voxel, got 3", volume=1)


# What is written


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.mgz", "a.nrrd"])
@pytest.mark.parametrize("kind", [np.int16, np.float32])
def test_images_come_back(name, kind):
    pytest.importorskip("SimpleITK")
    data = (DATA * (1.0 if kind is np.int16 else 0.37)).astype(kind)
    save_image(name, Image(data, OBLIQUE if name != "a.mgz" else TURNED))
    image, said = read_warned(name)
    assert_array_equal(image.data, data)
    assert_allclose(image.affine, OBLIQUE if name != "a.mgz" else TURNED, atol=1e-4)
    assert said == []


@pytest.mark.parametrize("name", ["a.mgz", "a.nrrd"])
def test_vectors_and_gaps_are_written(name):
    pytest.importorskip("SimpleITK")
    import SimpleITK as sitk

    values = np.stack([DATA, 2.0 * DATA, np.where(DATA < 3, np.nan, 3.0 * DATA)], axis=-1)
    save_voxels(Path(name), values, Image(DATA, TURNED))
    if name.endswith("nrrd"):
        back = np.moveaxis(sitk.GetArrayFromImage(sitk.ReadImage(name)), (0, 1, 2), (2, 1, 0))
    else:
        back = nibabel.load(name).get_fdata()
    assert_array_equal(back, values)
    assert_refused("b" + name, "2-D", lambda path: save_image(path, Image(DATA[0])))
