"""A mesh built within a mask: no voxel outside counts, in any command and in Python, whatever is
passed with it.
"""

import re

import numpy as np
import pytest
from commands import exit_code, numbers_in

import tetopt
from tetopt.model.file import MASK_TEXT
from tetopt.report import figures

pytestmark = pytest.mark.full
LAW = "4 + 0.02*max(h,-190)"  # 0.2 in the air around, 10 to 26 in the organ


@pytest.fixture(scope="module")
def organ(tmp_path_factory):
    """A ball in air, its mask, a mesh within it with moduli, and one without the background."""
    folder = tmp_path_factory.mktemp("organ")
    place = np.indices((20, 18, 16)) - np.array([9.5, 8.5, 7.5])[:, None, None, None]
    inside = (place**2).sum(axis=0) <= 36.0
    image = tetopt.Image(
        np.where(inside, 700.0 + 100.0 * place[0], -500.0), np.diag([1.0, 1.0, 1.5, 1.0])
    )
    tetopt.save_image(folder / "ct.nii.gz", image)
    tetopt.save_image(folder / "m.nii.gz", tetopt.Image(1.0 * inside, image.affine))
    tetopt.save_image(folder / "l.nii.gz", tetopt.Image(1.0 + inside, image.affine))
    tetopt.save_image(folder / "t2.nii.gz", tetopt.Image(2.0 * image.data, image.affine))
    mesh = [
        "mesh",
        folder / "ct.nii.gz",
        "--nodes",
        "90",
        "--iterations",
        "1",
        "--young",
        LAW,
        "--average",
        "mean",
    ]
    for name, region in (("a", ["--mask", folder / "m.nii.gz"]), ("b", ["--background", "-400"])):
        words = [*mesh, *region, "-o", folder / f"{name}.vtu", "--json", folder / f"{name}.json"]
        assert exit_code(*words, "--figures", folder / name) in (0, 1)
    return folder


def moduli(path):
    """Those of all cells, ascending: MSH files have the cells by material."""
    return np.sort(tetopt.load_mesh(path).cell_data["young"])


@pytest.mark.parametrize("name", ["a", "b"])
def test_no_voxel_outside_the_mask_counts(organ, tmp_path, name):
    """Moduli are the run's to the last bit, also after formats that keep the mask, and of
    results.
    """
    expected = moduli(organ / f"{name}.vtu")
    law = ["--image", organ / "ct.nii.gz", "--young", LAW, "--average", "mean"]
    first = organ / f"{name}.vtu"
    for second in ("c.vtk", "d.msh", "e.msh2", "f.vtu"):
        assert exit_code("convert", first, tmp_path / second, *law) == 0
        if second != "e.msh2":
            np.testing.assert_array_equal(moduli(tmp_path / second), expected)
        first = tmp_path / second
    loads = ["--load", "compress:1%", "-o", tmp_path / "s.vtu"]
    assert exit_code("fem", first, *law, *loads) == 0
    np.testing.assert_array_equal(moduli(tmp_path / "s.vtu"), expected)
    assert MASK_TEXT in tetopt.load_mesh(tmp_path / "s.vtu").field_data
    loaded, image = tetopt.load_mesh(organ / f"{name}.vtu"), tetopt.load_image(organ / "ct.nii.gz")
    mapped = tetopt.build_model(loaded, image, young=LAW, average="mean").materials
    np.testing.assert_array_equal(np.sort(mapped.young[mapped.of_cell]), expected)


def test_a_content_takes_its_mask_along(organ, tmp_path):
    image, mask = (tetopt.load_image(organ / f"{name}.nii.gz") for name in ("ct", "m"))
    labels = tetopt.Image(1.0 + (image.data > 700.0), image.affine)
    loaded = tetopt.load_mesh(organ / "a.vtu")
    for what in (tetopt.content(image, mask=mask), tetopt.content([image, labels], labels, mask)):
        model = tetopt.build_model(loaded.mesh, what, young=LAW, average="mean")
        np.testing.assert_array_equal(
            np.sort(model.materials.young[model.materials.of_cell]), moduli(organ / "a.vtu")
        )
        assert model.sets.facets.keys() == loaded.sets.facets.keys()
        fields = tetopt.cell_fields(loaded.mesh, what)
        np.testing.assert_array_equal(fields["mean"], loaded.cell_data["mean"])
    tetopt.save_model(tmp_path / "m.vtu", model)  # knows it, too
    words = [
        "convert",
        tmp_path / "m.vtu",
        tmp_path / "n.vtu",
        "--image",
        organ / "ct.nii.gz",
        "--young",
        LAW,
    ]
    assert exit_code(*words, "--average", "mean") == 0
    np.testing.assert_array_equal(moduli(tmp_path / "n.vtu"), moduli(organ / "a.vtu"))
    classes = tetopt.segment(what, loaded.mesh, 2)
    assert classes.shape == image.shape


def test_other_masks_labels_and_images(organ, tmp_path, capsys):
    """Another mask is warned of; labels count within the mask; a mesh without it needs it, if it
    knows that.
    """
    image = tetopt.load_image(organ / "ct.nii.gz")
    tetopt.save_image(
        tmp_path / "other.nii.gz", tetopt.Image(1.0 * (image.data > 800.0), image.affine)
    )
    convert = ["convert", organ / "a.vtu", tmp_path / "a.vtu", "--force", "--young", LAW]
    assert exit_code(*convert, "--image", organ / "ct.nii.gz", "--mask", organ / "m.nii.gz") == 0
    assert "differs" not in capsys.readouterr().err
    assert (
        exit_code(*convert, "--image", organ / "ct.nii.gz", "--mask", tmp_path / "other.nii.gz")
        == 0
    )
    assert "other.nii.gz: differs in " in capsys.readouterr().err
    assert exit_code(*convert, "--image", organ / "t2.nii.gz") == 0
    again = tetopt.load_mesh(tmp_path / "a.vtu")
    np.testing.assert_array_equal(
        again.cell_data["mean"], 2.0 * tetopt.load_mesh(organ / "a.vtu").cell_data["mean"]
    )
    assert again.text("image") == "t2.nii.gz"
    assert MASK_TEXT in again.field_data
    labels = [
        "convert",
        organ / "a.vtu",
        tmp_path / "l.vtu",
        "--labels",
        organ / "l.nii.gz",
        "--young",
        "1=1,2=9",
    ]
    assert exit_code(*labels) == 0
    assert set(tetopt.load_mesh(tmp_path / "l.vtu").cell_data["label"].tolist()) == {2}
    what = tetopt.content(image, mask=tetopt.load_image(tmp_path / "other.nii.gz"))
    with pytest.warns(UserWarning, match="the content's mask differs in [0-9]+ voxels"):
        tetopt.build_model(tetopt.load_mesh(organ / "a.vtu"), what, young=LAW)
    for function in (tetopt.build_model, tetopt.cell_fields):
        with pytest.warns(UserWarning, match="built within another mask"):
            function(tetopt.load_mesh(organ / "a.vtu").mesh, what)
    with pytest.warns(UserWarning, match="built within another mask"):
        tetopt.segment(what, tetopt.load_mesh(organ / "a.vtu").mesh, 2)
    lost = tetopt.load_mesh(organ / "a.vtu")
    tetopt.save_mesh(tmp_path / "lost.vtu", lost.mesh, about={"inputs": lost.text("inputs")})
    capsys.readouterr()
    with_image = ["--image", organ / "ct.nii.gz"]
    for words in (
        ["convert", tmp_path / "lost.vtu", tmp_path / "no.vtu"],
        ["quality", tmp_path / "lost.vtu"],
        ["fem", tmp_path / "lost.vtu"],
        ["view", tmp_path / "lost.vtu", "--html", tmp_path / "no.html"],
        ["segment", tmp_path / "lost.vtu", "-o", tmp_path / "no.nii"],
        ["mesh", organ / "ct.nii.gz", "--start", tmp_path / "lost.vtu", "-o", tmp_path / "no.vtu"],
    ):
        assert exit_code(*words, *([] if words[0] == "mesh" else with_image)) == 2
        assert (
            "the mesh was built within the mask m.nii.gz, which its file does not contain"
            in capsys.readouterr().err
        )
    with pytest.raises(tetopt.InputError, match="pass `mask`"):
        tetopt.build_model(tetopt.load_mesh(tmp_path / "lost.vtu"), image, young=LAW)
    words = [
        "fem",
        tmp_path / "lost.vtu",
        *with_image,
        "--mask",
        organ / "m.nii.gz",
        "--young",
        LAW,
    ]
    assert (
        exit_code(*words, "--average", "mean", "--load", "compress:1%", "-o", tmp_path / "s.vtu")
        == 0
    )
    np.testing.assert_array_equal(moduli(tmp_path / "s.vtu"), moduli(organ / "a.vtu"))


def test_an_image_in_another_place(organ, tmp_path, capsys):
    """Commands that take voxels of it refuse; an improved mesh is warned of, since it may be
    registered.
    """
    image = tetopt.load_image(organ / "ct.nii.gz")
    affine = image.affine.copy()
    affine[0, 3] += 3.0 * image.spacing[0]
    moved, mesh = tmp_path / "moved.nii.gz", organ / "a.vtu"
    tetopt.save_image(moved, tetopt.Image(image.data, affine))
    affine[0, 3] += 300.0
    far = tmp_path / "far.nii.gz"
    tetopt.save_image(far, tetopt.Image(image.data, affine))
    for words in (
        ["quality", mesh],
        ["segment", mesh, "-o", tmp_path / "s.nii"],
        ["view", mesh, "--html", tmp_path / "v.html"],
        ["convert", mesh, tmp_path / "c.vtu"],
        ["fem", mesh],
    ):
        assert exit_code(*words, "--image", moved) == 2
        assert "moved.nii.gz: expected the box of" in capsys.readouterr().err
        if words[0] != "quality":
            # before it reads the mask
            assert exit_code(*words, "--image", far, "--mask", organ / "m.nii.gz") == 2
            assert "far.nii.gz: expected the box of" in capsys.readouterr().err
    assert exit_code("quality", mesh, "--image", moved, "--registered") == 0
    assert "was built from a different image, not" in capsys.readouterr().err
    words = ["mesh", moved, "--start", mesh, "-o", tmp_path / "b.vtu", "--iterations", "1"]
    assert exit_code(*words) in (0, 1)
    assert "moved.nii.gz: its box was" in " ".join(capsys.readouterr().err.split())


def test_a_mask_for_a_mesh_of_the_whole_box(organ, tmp_path, capsys):
    """Its cells are not those of the mask: told, with the Dice of the whole mesh, by commands
    and in Python.
    """
    image, whole = tetopt.load_image(organ / "ct.nii.gz"), tmp_path / "w.vtu"
    tetopt.save_mesh(whole, tetopt.lattice_mesh(image, nodes=150))
    corner = np.indices(image.shape).sum(axis=0) < 8
    tetopt.save_image(tmp_path / "corner.nii.gz", tetopt.Image(1.0 * corner, image.affine))
    words = ["--image", organ / "ct.nii.gz", "--mask", tmp_path / "corner.nii.gz"]
    capsys.readouterr()
    assert exit_code("convert", whole, tmp_path / "c.vtu", *words, "--young", LAW) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert re.search("overlap with a Dice of only 0.0[0-9]+, .* built within another mask", said)
    for more in (words, words[2:]):  # on the voxels of image and labels, or of labels alone
        assert (
            exit_code(
                "convert",
                whole,
                tmp_path / "d.vtu",
                *more,
                "--labels",
                organ / "l.nii.gz",
                "--force",
            )
            == 0
        )
        assert capsys.readouterr().err.count("overlap with a Dice") == 1
    assert exit_code("quality", whole, *words, "--check", "--json", tmp_path / "q.json") == 1
    numbers = numbers_in(tmp_path / "q.json")
    assert set(numbers["violated"]) == {"mask"}  # and not "box", which is the image's
    assert f"Dice of only {numbers['mask']['dice']:.3f}" in numbers["violated"]["mask"]
    assert numbers["fit"]["n_voxels"] == image.data.size
    tetopt.save_mesh(
        tmp_path / "side.vtu", tetopt.lattice_mesh(image.box((17, 0, 0), image.shape), nodes=50)
    )
    assert exit_code("quality", tmp_path / "side.vtu", *words) == 2
    assert (
        "side.vtu: the mesh lies outside the mask and its surroundings" in capsys.readouterr().err
    )
    what = tetopt.content(image, mask=tetopt.Image(1.0 * corner, image.affine))
    with pytest.warns(UserWarning, match="within none"):
        tetopt.build_model(tetopt.load_mesh(whole), what, young=LAW)


def test_python_knows_the_place_of_a_mesh_file_s_image(organ):
    """It warns of an image elsewhere, and refuses one of another dimension by its own name."""
    image, loaded = tetopt.load_image(organ / "ct.nii.gz"), tetopt.load_mesh(organ / "a.vtu")
    affine = image.affine.copy()
    affine[0, 3] += 3.0
    moved = tetopt.Image(image.data, affine)
    mask = tetopt.Image(tetopt.load_image(organ / "m.nii.gz").data, affine)
    for what in (moved, tetopt.content(moved, mask=mask)):
        with pytest.warns(UserWarning, match="image: its box differs"):
            tetopt.build_model(loaded, what, young=LAW)
    with pytest.raises(tetopt.InputError, match="expected a 3-D image like the mesh"):
        tetopt.build_model(loaded, tetopt.Image(image.data[0]), young=LAW)


def test_a_check_without_the_image_judges_angles(tmp_path, capsys):
    tetopt.save_image(tmp_path / "a.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    words = [
        "mesh",
        tmp_path / "a.nii.gz",
        "-o",
        tmp_path / "a.vtu",
        "--nodes",
        60,
        "--iterations",
        0,
    ]
    assert exit_code(*words, "--min-dihedral", 60) == 1
    assert exit_code("quality", tmp_path / "a.vtu", "--check") == 1
    assert "requirements not met: min_dihedral" in capsys.readouterr().out
    assert exit_code(*words, "--force") == 0
    assert exit_code("quality", tmp_path / "a.vtu", "--check") == 0
    assert "requirements that need no image are met" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["quality", "view"])
def test_options_of_an_image_need_one(organ, tmp_path, capsys, command):
    words = [
        command,
        organ / "a.vtu",
        *(["--html", tmp_path / "v.html"] if command == "view" else []),
    ]
    for options in (["--mask", organ / "m.nii.gz"], ["--registered"], ["--crop", "1:,:,:"]):
        assert exit_code(*words, *options) == 2
        assert f"{options[0]}: needs --image" in capsys.readouterr().err


def test_a_mesh_within_a_mask_is_improved_within_it(organ, tmp_path):
    words = [
        "mesh",
        organ / "ct.nii.gz",
        "--start",
        organ / "a.vtu",
        "--iterations",
        "0",
        "--young",
        LAW,
    ]
    out = [
        "--average",
        "mean",
        "-o",
        tmp_path / "a.vtu",
        "--json",
        tmp_path / "a.json",
        "--figures",
        tmp_path,
    ]
    assert exit_code(*words, *out) == 0
    np.testing.assert_array_equal(moduli(tmp_path / "a.vtu"), moduli(organ / "a.vtu"))
    one, other = (numbers_in(folder / "a.json")["mask"] for folder in (tmp_path, organ))
    assert one.pop("lost_components") == other.pop("lost_components") == []
    assert one == pytest.approx(other)
    assert not (tmp_path / "boundary.png").exists()


def test_numbers_are_of_the_voxels_that_are_meshed(organ, tmp_path):
    """One unexplained variance, of the voxels in cells, and an image's properties without what
    is outside.
    """
    numbers, fields = numbers_in(organ / "a.json"), tetopt.load_mesh(organ / "a.vtu").cell_data
    h = np.float64(tetopt.load_image(organ / "ct.nii.gz").data)[
        tetopt.load_image(organ / "m.nii.gz").data > 0.0
    ]
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
    words = ["--image", organ / "ct.nii.gz", "--json", tmp_path / "q.json", "--force"]
    for mask in ([], ["--mask", organ / "m.nii.gz"]):
        assert exit_code("quality", organ / "a.vtu", *words, *mask) in (0, 1)
        assert numbers_in(tmp_path / "q.json")["fit"]["E_D_fraction_of_variance"] == pytest.approx(
            numbers["energies"]["E_D_fraction_of_variance"], rel=1e-9
        )
    bare = tetopt.load_mesh(organ / "a.vtu").mesh
    tetopt.save_mesh(tmp_path / "bare.vtu", bare)  # knows of no mask
    assert exit_code("quality", tmp_path / "bare.vtu", *words) in (0, 1)
    of_all = tetopt.cell_fields(bare, tetopt.load_image(organ / "ct.nii.gz"))
    assert numbers_in(tmp_path / "q.json")["fit"]["E_D_fraction_of_variance"] == pytest.approx(
        fraction(of_all), rel=1e-6
    )


def test_pictures_have_the_grey_window_of_the_voxels_in_the_mask(organ):
    image, mask = (tetopt.load_image(organ / f"{name}.nii.gz") for name in ("ct", "m"))
    mesh, affine = tetopt.load_mesh(organ / "a.vtu").mesh, image.affine.copy()
    affine[2, 3] -= 24 * 1.5
    beyond = ((0, 0), (0, 0), (24, 0))
    moved = (tetopt.Image(np.pad(each.data, beyond, mode="edge"), affine) for each in (image, mask))
    for whole, inside in ((image, mask), moved):  # in the second, the middle slice is all air
        view = figures.slice_figure(whole, [("", mesh)], mask=inside).axes[0]
        low, high = view.images[0].get_clim()
        assert 0.0 < low < 300.0
        assert high > 1100.0
        assert view.collections[0].get_paths()


@pytest.mark.parametrize("command", ["quality", "fem", "segment", "view", "convert"])
def test_the_image_before_the_mesh_or_as_an_option(organ, tmp_path, command, capsys):
    image, mesh = organ / "ct.nii.gz", organ / "a.vtu"
    more = {
        "fem": ["--load", "compress:1%"],
        "segment": ["-o", tmp_path / "a.nii", "--force"],
        "view": ["--html", tmp_path / "a.html", "--force"],
        "convert": [tmp_path / "a.vtu", "--force"],
        "quality": [],
    }[command]
    printed = []
    for words in ([image, mesh, *more], [mesh, *more, "--image", image]):
        assert exit_code(command, *words) in (0, 1)
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]
    assert exit_code(command, image, mesh, *more, "--image", image) == 2
    assert "expected MESH and one image (--image), got 3 files" in capsys.readouterr().err
    assert exit_code(command, mesh, mesh, *more) == 2
    assert (
        f"{mesh}: expected an image beside {mesh}, got a mesh; give one mesh at a time"
        in capsys.readouterr().err
    )
