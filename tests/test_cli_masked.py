"""A mesh built within a mask: no voxel outside counts, in any command and in Python, whatever is
passed with it.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from commands import assert_done, assert_refuses, in_copy_of, numbers_in, refusals, run_command
from numpy.testing import assert_array_equal

import tetopt
from tetopt import (
    Image,
    InputError,
    build_model,
    cell_fields,
    content,
    lattice_mesh,
    load_image,
    load_mesh,
    save_image,
    save_mesh,
    segment,
)
from tetopt.model.file import MASK_TEXT
from tetopt.report import figures

pytestmark = pytest.mark.full
LAW = "4+0.02*max(h,-190)"  # 0.2 in the air around, 10 to 26 in the organ
MAPPED = f"--young {LAW} --average mean"


here = in_copy_of("organ")


@pytest.fixture(scope="module")
def organ(tmp_path_factory):
    """A ball in air, masks, labels, the image elsewhere; a mesh within the mask with moduli, one
    without the background, one whose file has lost the mask, and some of the box and beside it.
    """
    folder = tmp_path_factory.mktemp("organ")
    place = np.indices((20, 18, 16)) - np.array([9.5, 8.5, 7.5])[:, None, None, None]
    inside = (place**2).sum(axis=0) <= 36.0
    image = Image(np.where(inside, 700.0 + 100.0 * place[0], -500.0), np.diag([1.0, 1.0, 1.5, 1.0]))
    moved, far = image.affine.copy(), image.affine.copy()
    moved[0, 3], far[0, 3] = 3.0, 303.0
    for name, data, affine in (
        ("ct", image.data, image.affine),
        ("m", inside, image.affine),
        ("l", 1.0 + inside, image.affine),
        ("t2", 2.0 * image.data, image.affine),
        ("other", image.data > 800.0, image.affine),
        ("corner", np.indices(image.shape).sum(axis=0) < 8, image.affine),
        ("moved", image.data, moved),
        ("far", image.data, far),
    ):
        save_image(f"{folder}/{name}.nii.gz", Image(1.0 * data, affine))
    mesh = f"mesh {folder}/ct.nii.gz --nodes 90 --iterations 1 {MAPPED}"
    for name, region in (("organ", f"--mask {folder}/m.nii.gz"), ("b", "--background -400")):
        out = f"{folder}/{name}"
        run_command(f"{mesh} {region} -o {out}.vtu --json {out}.json --figures {out}", code=None)
    lost = load_mesh(f"{folder}/organ.vtu")
    save_mesh(f"{folder}/lost.vtu", lost.mesh, about={"inputs": lost.text("inputs")})
    save_mesh(f"{folder}/w.vtu", lattice_mesh(image, nodes=150))
    side = lattice_mesh(image.box((17, 0, 0), image.shape), nodes=50)
    save_mesh(f"{folder}/side.vtu", side)
    return folder


def moduli(path):
    """Those of all cells, ascending: MSH files have the cells by material."""
    return np.sort(load_mesh(path).cell_data["young"])


def moduli_of(mesh, image):
    materials = build_model(mesh, image, young=LAW, average="mean").materials
    return np.sort(materials.young[materials.of_cell])


@pytest.mark.parametrize("name", ["organ", "b"])
def test_no_voxel_outside_the_mask_counts(name):
    """Moduli are the run's to the last bit, also after formats that keep the mask, and of
    results.
    """
    first, law = f"{name}.vtu", f"--image ct.nii.gz {MAPPED}"
    expected = moduli(first)
    assert_array_equal(moduli_of(load_mesh(first), load_image("ct.nii.gz")), expected)
    for second in ("c.vtk", "d.msh", "e.msh2", "f.vtu"):
        assert_done(f"convert {first} {second} {law}")
        if second != "e.msh2":
            assert_array_equal(moduli(second), expected)
        first = second
    assert_done(f"fem {first} {law} --load compress:1% -o s.vtu")
    assert_array_equal(moduli("s.vtu"), expected)
    assert MASK_TEXT in load_mesh("s.vtu").field_data


def test_a_content_takes_its_mask_along():
    image, mask = (load_image(f"{name}.nii.gz") for name in ("ct", "m"))
    labels = Image(1.0 + (image.data > 700.0), image.affine)
    loaded = load_mesh("organ.vtu")
    for what in (content(image, mask=mask), content([image, labels], labels, mask)):
        model = build_model(loaded.mesh, what, young=LAW, average="mean")
        assert_array_equal(moduli_of(loaded.mesh, what), moduli("organ.vtu"))
        assert model.sets.facets.keys() == loaded.sets.facets.keys()
        fields = cell_fields(loaded.mesh, what)
        assert_array_equal(fields["mean"], loaded.cell_data["mean"])
    tetopt.save_model("m.vtu", model)  # knows it, too
    assert_done(f"convert m.vtu n.vtu --image ct.nii.gz {MAPPED}")
    assert_array_equal(moduli("n.vtu"), moduli("organ.vtu"))
    assert segment(what, loaded.mesh, 2).shape == image.shape


def test_other_masks_labels_and_images():
    """Another mask is warned of; labels count within the mask; a mesh without it needs it, if it
    knows that.
    """
    loaded = load_mesh("organ.vtu")
    convert = f"convert organ.vtu a.vtu --force --young {LAW} --image"
    assert "differs" not in run_command(f"{convert} ct.nii.gz --mask m.nii.gz").err
    said = run_command(f"{convert} ct.nii.gz --mask other.nii.gz").err
    assert "other.nii.gz: differs in " in said
    assert_done(f"{convert} t2.nii.gz")
    again = load_mesh("a.vtu")
    assert_array_equal(again.cell_data["mean"], 2.0 * loaded.cell_data["mean"])
    assert again.text("image") == "t2.nii.gz"
    assert MASK_TEXT in again.field_data
    assert_done("convert organ.vtu l.vtu --labels l.nii.gz --young 1=1,2=9")
    assert set(load_mesh("l.vtu").cell_data["label"]) == {2}
    image = load_image("ct.nii.gz")
    what = content(image, mask=load_image("other.nii.gz"))
    for call, words in (
        (lambda: build_model(loaded, what, young=LAW), "mask differs in [0-9]+ voxels"),
        (lambda: build_model(loaded.mesh, what), "built within another mask"),
        (lambda: cell_fields(loaded.mesh, what), "built within another mask"),
        (lambda: segment(what, loaded.mesh, 2), "built within another mask"),
    ):
        with pytest.warns(UserWarning, match=words):
            call()
    with pytest.raises(InputError, match="pass `mask`"):
        build_model(load_mesh("lost.vtu"), image, young=LAW)
    words = f"fem lost.vtu --image ct.nii.gz --mask m.nii.gz {MAPPED}"
    assert_done(f"{words} --load compress:1% -o s.vtu")
    assert_array_equal(moduli("s.vtu"), moduli("organ.vtu"))


LOST = "the mesh was built within the mask m.nii.gz, which its file does not contain"
test_refused = refusals(
    f"""
convert lost.vtu no.vtu --image ct.nii.gz
    {LOST}
quality lost.vtu --image ct.nii.gz
    {LOST}
fem lost.vtu --image ct.nii.gz
    {LOST}
view lost.vtu --html no.html --image ct.nii.gz
    {LOST}
segment lost.vtu -o no.nii --image ct.nii.gz
    {LOST}
mesh ct.nii.gz --start lost.vtu -o no.vtu
    {LOST}
quality side.vtu --image ct.nii.gz --mask corner.nii.gz
    side.vtu: the mesh lies outside the mask and its surroundings
quality organ.vtu --mask m.nii.gz
    --mask: needs --image
quality organ.vtu --registered
    --registered: needs --image
quality organ.vtu --crop 1:,:,:
    --crop: needs --image
view organ.vtu --html v.html --mask m.nii.gz
    --mask: needs --image
view organ.vtu --html v.html --registered
    --registered: needs --image
view organ.vtu --html v.html --crop 1:,:,:
    --crop: needs --image
"""
)


IMAGE_FIRST = [
    ("quality", ""),
    ("fem", "--load compress:1%"),
    ("segment", "-o a.nii --force"),
    ("view", "--html a.html --force"),
    ("convert", "a.vtu --force"),
]


@pytest.mark.parametrize(("command", "more"), IMAGE_FIRST)
def test_the_image_before_the_mesh_or_as_an_option(command, more):
    """One of another place is refused, before the mask is read."""
    image, mesh = "ct.nii.gz", "organ.vtu"
    lines = f"{image} {mesh} {more}", f"{mesh} {more} --image {image}"
    printed = [run_command(f"{command} {words}", code=None).out for words in lines]
    assert printed[0] == printed[1]
    for words, said in (
        (f"{image} {mesh} {more} --image {image}", "MESH and one image (--image), got 3 files"),
        (
            f"{mesh} {mesh} {more}",
            f"{mesh}: expected an image beside {mesh}, got a mesh; give one mesh at a time",
        ),
        (f"{mesh} {more} --image moved.nii.gz", "moved.nii.gz: expected the box of"),
    ):
        assert_refuses(f"{command} {words}", said)
    if command != "quality":
        words = f"{command} {mesh} {more} --image far.nii.gz --mask m.nii.gz"
        assert_refuses(words, "far.nii.gz: expected the box of")


def test_an_image_in_another_place():
    """An improved mesh is warned of, since it may be registered, unless the user says so."""
    said = run_command("quality organ.vtu --image moved.nii.gz --registered").err
    assert "was built from a different image, not" not in said
    words = "mesh moved.nii.gz --start organ.vtu -o n.vtu --iterations 1"
    assert "moved.nii.gz: its box was" in run_command(words, code=None).err


def test_a_mask_for_a_mesh_of_the_whole_box():
    """Its cells are not those of the mask: told, with the Dice of the whole mesh, by commands
    and in Python.
    """
    words = "--image ct.nii.gz --mask corner.nii.gz"
    said = run_command(f"convert w.vtu c.vtu {words} --young {LAW}").err
    assert re.search("overlap with a Dice of only 0.0[0-9]+, .* built within another mask", said)
    # on the voxels of image and labels, or of labels alone
    for more in (words, "--mask corner.nii.gz"):
        said = run_command(f"convert w.vtu d.vtu {more} --labels l.nii.gz --force").err
        assert said.count("overlap with a Dice") == 1
    run_command(f"quality w.vtu {words} --check --json q.json", code=1)
    numbers, image = numbers_in("q.json"), load_image("ct.nii.gz")
    assert set(numbers["violated"]) == {"mask"}  # and not "box", which is the image's
    assert f"Dice of only {numbers['mask']['dice']:.3f}" in numbers["violated"]["mask"]
    assert numbers["fit"]["n_voxels"] == image.data.size
    what = content(image, mask=load_image("corner.nii.gz"))
    with pytest.warns(UserWarning, match="within none"):
        build_model(load_mesh("w.vtu"), what, young=LAW)


def test_python_knows_the_place_of_a_mesh_file_s_image():
    """It warns of an image elsewhere, and refuses one of another dimension by its own name."""
    moved, loaded = load_image("moved.nii.gz"), load_mesh("organ.vtu")
    mask = Image(load_image("m.nii.gz").data, moved.affine)
    for what in (moved, content(moved, mask=mask)):
        with pytest.warns(UserWarning, match="image: its box differs"):
            build_model(loaded, what, young=LAW)
    with pytest.raises(InputError, match="expected a 3-D image like the mesh"):
        build_model(loaded, Image(moved.data[0]), young=LAW)


def test_a_check_without_the_image_judges_angles():
    save_image("a.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    for options, code, said in (
        ("--min-dihedral 60", 1, "requirements not met: min_dihedral"),
        ("--force", 0, "requirements that need no image are met"),
    ):
        mesh = f"mesh a.nii.gz -o a.vtu --nodes 60 --iterations 0 {options}"
        run_command(mesh, code=code)
        assert said in run_command("quality a.vtu --check", code=code).out


def test_a_mesh_within_a_mask_is_improved_within_it():
    words = f"mesh ct.nii.gz --start organ.vtu --iterations 0 {MAPPED}"
    assert_done(f"{words} -o a.vtu --json a.json --figures .")
    assert_array_equal(moduli("a.vtu"), moduli("organ.vtu"))
    one, other = (numbers_in(path)["mask"] for path in ("a.json", "organ.json"))
    assert one.pop("lost_components") == other.pop("lost_components") == []
    assert one == pytest.approx(other)
    assert not Path("boundary.png").exists()


def test_numbers_are_of_the_voxels_that_are_meshed():
    """One unexplained variance, of the voxels in cells, and an image's properties without what
    is outside.
    """
    numbers, loaded = numbers_in("organ.json"), load_mesh("organ.vtu")
    h = np.float64(load_image("ct.nii.gz").data)[load_image("m.nii.gz").data > 0.0]
    expected = {
        "mean": h.mean(),
        "min": h.min(),
        "max": h.max(),
        "volume_mm": 1.5 * h.size,
        "total_variation": 1.5 * h.size * h.var(),
    }
    properties = numbers["image_properties"]
    assert {name: properties[name] for name in expected} == pytest.approx(expected, rel=1e-6)
    assert properties["shape"] == [20, 18, 16]

    def fraction(fields):
        n, mean, variance = (fields[name] for name in ("n_voxels", "mean", "variance"))
        between = n @ (mean - np.average(mean, weights=n)) ** 2
        return pytest.approx(n @ variance / (n @ variance + between), rel=1e-6)

    save_mesh("bare.vtu", loaded.mesh)  # knows of no mask
    of_all = cell_fields(loaded.mesh, load_image("ct.nii.gz"))
    of_run = numbers["energies"]["E_D_fraction_of_variance"]
    assert of_run == fraction(loaded.cell_data)
    for words, expected in (
        ("organ.vtu", pytest.approx(of_run, rel=1e-9)),
        ("organ.vtu --mask m.nii.gz", pytest.approx(of_run, rel=1e-9)),
        ("bare.vtu", fraction(of_all)),
    ):
        run_command(f"quality {words} --image ct.nii.gz --json q.json --force", code=None)
        assert numbers_in("q.json")["fit"]["E_D_fraction_of_variance"] == expected


def test_pictures_have_the_grey_window_of_the_voxels_in_the_mask():
    image, mask = (load_image(f"{name}.nii.gz") for name in ("ct", "m"))
    mesh, affine = load_mesh("organ.vtu").mesh, image.affine.copy()
    affine[2, 3] -= 24 * 1.5
    beyond = ((0, 0), (0, 0), (24, 0))
    moved = (Image(np.pad(each.data, beyond, mode="edge"), affine) for each in (image, mask))
    for whole, inside in ((image, mask), moved):  # in the second, the middle slice is all air
        view = figures.slice_figure(whole, [("", mesh)], mask=inside).axes[0]
        low, high = view.images[0].get_clim()
        assert 0.0 < low < 300.0
        assert high > 1100.0
        assert view.collections[0].get_paths()
