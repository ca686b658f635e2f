"""A mesh built within a mask: no voxel outside counts, in any command and in Python, whatever is
passed with it.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from commands import assert_done, assert_refused, exit_code, in_copy_of, numbers_in
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


here = in_copy_of("organ")


@pytest.fixture(scope="module")
def organ(tmp_path_factory):
    """A ball in air, its mask, a mesh within it with moduli, and one without the background."""
    folder = tmp_path_factory.mktemp("organ")
    place = np.indices((20, 18, 16)) - np.array([9.5, 8.5, 7.5])[:, None, None, None]
    inside = (place**2).sum(axis=0) <= 36.0
    image = Image(np.where(inside, 700.0 + 100.0 * place[0], -500.0), np.diag([1.0, 1.0, 1.5, 1.0]))
    save_image(folder / "ct.nii.gz", image)
    save_image(folder / "m.nii.gz", Image(1.0 * inside, image.affine))
    save_image(folder / "l.nii.gz", Image(1.0 + inside, image.affine))
    save_image(folder / "t2.nii.gz", Image(2.0 * image.data, image.affine))
    mesh = [
        "mesh",
        folder / "ct.nii.gz",
        "--nodes 90 --iterations 1 --young",
        LAW,
        "--average mean",
    ]
    for name, region in (("organ", ["--mask", folder / "m.nii.gz"]), ("b", ["--background -400"])):
        words = [*mesh, *region, "-o", folder / f"{name}.vtu", "--json", folder / f"{name}.json"]
        assert exit_code(*words, "--figures", folder / name) in (0, 1)
    return folder


def moduli(path):
    """Those of all cells, ascending: MSH files have the cells by material."""
    return np.sort(load_mesh(path).cell_data["young"])


@pytest.mark.parametrize("name", ["organ", "b"])
def test_no_voxel_outside_the_mask_counts(name):
    """Moduli are the run's to the last bit, also after formats that keep the mask, and of
    results.
    """
    expected = moduli(f"{name}.vtu")
    law = f"--image ct.nii.gz --young {LAW} --average mean"
    first = f"{name}.vtu"
    for second in ("c.vtk", "d.msh", "e.msh2", "f.vtu"):
        assert_done(f"convert {first} {second} {law}")
        if second != "e.msh2":
            assert_array_equal(moduli(second), expected)
        first = second
    assert_done(f"fem {first} {law} --load compress:1% -o s.vtu")
    assert_array_equal(moduli("s.vtu"), expected)
    assert MASK_TEXT in load_mesh("s.vtu").field_data
    loaded, image = load_mesh(f"{name}.vtu"), load_image("ct.nii.gz")
    mapped = build_model(loaded, image, young=LAW, average="mean").materials
    assert_array_equal(np.sort(mapped.young[mapped.of_cell]), expected)


def test_a_content_takes_its_mask_along():
    image, mask = (load_image(f"{name}.nii.gz") for name in ("ct", "m"))
    labels = Image(1.0 + (image.data > 700.0), image.affine)
    loaded = load_mesh("organ.vtu")
    for what in (content(image, mask=mask), content([image, labels], labels, mask)):
        model = build_model(loaded.mesh, what, young=LAW, average="mean")
        assert_array_equal(
            np.sort(model.materials.young[model.materials.of_cell]), moduli("organ.vtu")
        )
        assert model.sets.facets.keys() == loaded.sets.facets.keys()
        fields = cell_fields(loaded.mesh, what)
        assert_array_equal(fields["mean"], loaded.cell_data["mean"])
    tetopt.save_model("m.vtu", model)  # knows it, too
    assert_done(f"convert m.vtu n.vtu --image ct.nii.gz --young {LAW} --average mean")
    assert_array_equal(moduli("n.vtu"), moduli("organ.vtu"))
    classes = segment(what, loaded.mesh, 2)
    assert classes.shape == image.shape


def test_other_masks_labels_and_images(capsys):
    """Another mask is warned of; labels count within the mask; a mesh without it needs it, if it
    knows that.
    """
    image = load_image("ct.nii.gz")
    save_image("other.nii.gz", Image(1.0 * (image.data > 800.0), image.affine))
    convert = ["convert organ.vtu a.vtu --force --young", LAW]
    assert_done(*convert, "--image ct.nii.gz --mask m.nii.gz")
    assert "differs" not in capsys.readouterr().err
    assert_done(*convert, "--image ct.nii.gz --mask other.nii.gz")
    assert "other.nii.gz: differs in " in capsys.readouterr().err
    assert_done(*convert, "--image t2.nii.gz")
    again = load_mesh("a.vtu")
    assert_array_equal(again.cell_data["mean"], 2.0 * load_mesh("organ.vtu").cell_data["mean"])
    assert again.text("image") == "t2.nii.gz"
    assert MASK_TEXT in again.field_data
    labels = "convert organ.vtu l.vtu --labels l.nii.gz --young 1=1,2=9"
    assert_done(labels)
    assert set(load_mesh("l.vtu").cell_data["label"].tolist()) == {2}
    what = content(image, mask=load_image("other.nii.gz"))
    with pytest.warns(UserWarning, match="the content's mask differs in [0-9]+ voxels"):
        build_model(load_mesh("organ.vtu"), what, young=LAW)
    for function in (build_model, cell_fields):
        with pytest.warns(UserWarning, match="built within another mask"):
            function(load_mesh("organ.vtu").mesh, what)
    with pytest.warns(UserWarning, match="built within another mask"):
        segment(what, load_mesh("organ.vtu").mesh, 2)
    lost = load_mesh("organ.vtu")
    save_mesh("lost.vtu", lost.mesh, about={"inputs": lost.text("inputs")})
    capsys.readouterr()
    for words in (
        "convert lost.vtu no.vtu --image ct.nii.gz",
        "quality lost.vtu --image ct.nii.gz",
        "fem lost.vtu --image ct.nii.gz",
        "view lost.vtu --html no.html --image ct.nii.gz",
        "segment lost.vtu -o no.nii --image ct.nii.gz",
        "mesh ct.nii.gz --start lost.vtu -o no.vtu",
    ):
        assert_refused(
            capsys,
            words,
            "the mesh was built within the mask m.nii.gz, which its file does not contain",
        )
    with pytest.raises(InputError, match="pass `mask`"):
        build_model(load_mesh("lost.vtu"), image, young=LAW)
    words = f"fem lost.vtu --image ct.nii.gz --mask m.nii.gz --young {LAW} --average mean"
    assert_done(f"{words} --load compress:1% -o s.vtu")
    assert_array_equal(moduli("s.vtu"), moduli("organ.vtu"))


def test_an_image_in_another_place(capsys):
    """Commands that take voxels of it refuse; an improved mesh is warned of, since it may be
    registered.
    """
    image = load_image("ct.nii.gz")
    affine = image.affine.copy()
    affine[0, 3] += 3.0 * image.spacing[0]
    save_image("moved.nii.gz", Image(image.data, affine))
    affine[0, 3] += 300.0
    save_image("far.nii.gz", Image(image.data, affine))
    for words in (
        "quality organ.vtu",
        "segment organ.vtu -o s.nii",
        "view organ.vtu --html v.html",
        "convert organ.vtu c.vtu",
        "fem organ.vtu",
    ):
        assert_refused(capsys, f"{words} --image moved.nii.gz", "moved.nii.gz: expected the box of")
        if words != "quality organ.vtu":
            # before it reads the mask
            assert_refused(
                capsys,
                f"{words} --image far.nii.gz --mask m.nii.gz",
                "far.nii.gz: expected the box of",
            )
    assert_done("quality organ.vtu --image moved.nii.gz --registered")
    assert "was built from a different image, not" in capsys.readouterr().err
    assert exit_code("mesh moved.nii.gz --start organ.vtu -o n.vtu --iterations 1") in (0, 1)
    assert "moved.nii.gz: its box was" in capsys.readouterr().err


def test_a_mask_for_a_mesh_of_the_whole_box(capsys):
    """Its cells are not those of the mask: told, with the Dice of the whole mesh, by commands
    and in Python.
    """
    image = load_image("ct.nii.gz")
    save_mesh("w.vtu", lattice_mesh(image, nodes=150))
    corner = np.indices(image.shape).sum(axis=0) < 8
    save_image("corner.nii.gz", Image(1.0 * corner, image.affine))
    words = "--image ct.nii.gz --mask corner.nii.gz"
    capsys.readouterr()
    assert_done(f"convert w.vtu c.vtu {words} --young {LAW}")
    said = capsys.readouterr().err
    assert re.search("overlap with a Dice of only 0.0[0-9]+, .* built within another mask", said)
    # on the voxels of image and labels, or of labels alone
    for more in (words, "--mask corner.nii.gz"):
        assert_done(f"convert w.vtu d.vtu {more} --labels l.nii.gz --force")
        assert capsys.readouterr().err.count("overlap with a Dice") == 1
    assert exit_code(f"quality w.vtu {words} --check --json q.json") == 1
    numbers = numbers_in("q.json")
    assert set(numbers["violated"]) == {"mask"}  # and not "box", which is the image's
    assert f"Dice of only {numbers['mask']['dice']:.3f}" in numbers["violated"]["mask"]
    assert numbers["fit"]["n_voxels"] == image.data.size
    save_mesh("side.vtu", lattice_mesh(image.box((17, 0, 0), image.shape), nodes=50))
    assert_refused(
        capsys,
        f"quality side.vtu {words}",
        "side.vtu: the mesh lies outside the mask and its surroundings",
    )
    what = content(image, mask=Image(1.0 * corner, image.affine))
    with pytest.warns(UserWarning, match="within none"):
        build_model(load_mesh("w.vtu"), what, young=LAW)


def test_python_knows_the_place_of_a_mesh_file_s_image():
    """It warns of an image elsewhere, and refuses one of another dimension by its own name."""
    image, loaded = load_image("ct.nii.gz"), load_mesh("organ.vtu")
    affine = image.affine.copy()
    affine[0, 3] += 3.0
    moved = Image(image.data, affine)
    mask = Image(load_image("m.nii.gz").data, affine)
    for what in (moved, content(moved, mask=mask)):
        with pytest.warns(UserWarning, match="image: its box differs"):
            build_model(loaded, what, young=LAW)
    with pytest.raises(InputError, match="expected a 3-D image like the mesh"):
        build_model(loaded, Image(image.data[0]), young=LAW)


def test_a_check_without_the_image_judges_angles(capsys):
    save_image("a.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    words = "mesh a.nii.gz -o a.vtu --nodes 60 --iterations 0"
    assert exit_code(f"{words} --min-dihedral 60") == 1
    assert exit_code("quality a.vtu --check") == 1
    assert "requirements not met: min_dihedral" in capsys.readouterr().out
    assert_done(f"{words} --force")
    assert_done("quality a.vtu --check")
    assert "requirements that need no image are met" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["quality organ.vtu", "view organ.vtu --html v.html"])
def test_options_of_an_image_need_one(capsys, command):
    for option, value in (("--mask", "m.nii.gz"), ("--registered", ""), ("--crop", "1:,:,:")):
        assert_refused(capsys, f"{command} {option} {value}", f"{option}: needs --image")


def test_a_mesh_within_a_mask_is_improved_within_it():
    words = f"mesh ct.nii.gz --start organ.vtu --iterations 0 --young {LAW} --average mean"
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
    numbers, fields = numbers_in("organ.json"), load_mesh("organ.vtu").cell_data
    h = np.float64(load_image("ct.nii.gz").data)[load_image("m.nii.gz").data > 0.0]
    expected = {
        "mean": h.mean(),
        "min": h.min(),
        "max": h.max(),
        "volume_mm": 1.5 * h.size,
        "total_variation": 1.5 * h.size * h.var(),
    }
    assert {name: numbers["image_properties"][name] for name in expected} == pytest.approx(
        expected, rel=1e-6
    )
    assert numbers["image_properties"]["shape"] == [20, 18, 16]

    def fraction(fields):
        n, mean, variance = (fields[name] for name in ("n_voxels", "mean", "variance"))
        within = (n * variance).sum()
        return within / (within + (n * (mean - np.average(mean, weights=n)) ** 2).sum())

    assert numbers["energies"]["E_D_fraction_of_variance"] == pytest.approx(
        fraction(fields), rel=1e-6
    )
    words = "--image ct.nii.gz --json q.json --force"
    for mask in ("", "--mask m.nii.gz"):
        assert exit_code(f"quality organ.vtu {words} {mask}") in (0, 1)
        assert numbers_in("q.json")["fit"]["E_D_fraction_of_variance"] == pytest.approx(
            numbers["energies"]["E_D_fraction_of_variance"], rel=1e-9
        )
    bare = load_mesh("organ.vtu").mesh
    save_mesh("bare.vtu", bare)  # knows of no mask
    assert exit_code(f"quality bare.vtu {words}") in (0, 1)
    of_all = cell_fields(bare, load_image("ct.nii.gz"))
    assert numbers_in("q.json")["fit"]["E_D_fraction_of_variance"] == pytest.approx(
        fraction(of_all), rel=1e-6
    )


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


@pytest.mark.parametrize(
    ("command", "more"),
    [
        ("quality", ""),
        ("fem", "--load compress:1%"),
        ("segment", "-o a.nii --force"),
        ("view", "--html a.html --force"),
        ("convert", "a.vtu --force"),
    ],
)
def test_the_image_before_the_mesh_or_as_an_option(command, more, capsys):
    image, mesh = "ct.nii.gz", "organ.vtu"
    printed = []
    for words in (f"{image} {mesh} {more}", f"{mesh} {more} --image {image}"):
        assert exit_code(f"{command} {words}") in (0, 1)
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]
    assert_refused(
        capsys,
        f"{command} {image} {mesh} {more} --image {image}",
        "expected MESH and one image (--image), got 3 files",
    )
    assert_refused(
        capsys,
        f"{command} {mesh} {mesh} {more}",
        f"{mesh}: expected an image beside {mesh}, got a mesh; give one mesh at a time",
    )
