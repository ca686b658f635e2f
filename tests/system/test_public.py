"""Public names: what nouns and functions refuse, and whom warnings name."""

from pathlib import Path

import nibabel
import numpy as np
import pytest

import tetopt

IMAGE = tetopt.Image(np.random.default_rng(0).normal(size=(6, 7, 8)))
MESH = tetopt.Mesh([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4]], [[0, 1, 2, 3]])


@pytest.mark.parametrize(
    "what",
    ["a.nii", None, np.zeros((3, 4, 5)), nibabel.Nifti1Image(np.zeros((3, 4, 5)), np.eye(4))],
)
def test_what_is_no_image_is_told_how_to_become_one(what):
    words = r"image: expected Image, got \w+; use tetopt\.load_image"
    for call in (
        lambda image: tetopt.mesh_image(image, 500),
        lambda image: tetopt.octree_mesh(image, 500),
        lambda image: tetopt.lattice_mesh(image, nodes=500),
        lambda image: tetopt.E_D(image, MESH),
        lambda image: tetopt.field_on_image(MESH, MESH.points, image),
    ):
        with pytest.raises(TypeError, match=words):
            call(what)
    if what is not None:  # which is no argument then
        for call in (
            lambda image: tetopt.content([image]),
            lambda image: tetopt.content(IMAGE, image),
            lambda image: tetopt.content(IMAGE, mask=image),
            lambda image: tetopt.build_model(MESH, image),
            lambda image: tetopt.cell_fields(MESH, image),
            lambda image: tetopt.cell_labels(image, MESH),
        ):
            with pytest.raises(TypeError, match=r"expected Image, got \w+; use"):
                call(what)


def test_a_bare_array_is_no_content():
    with pytest.raises(TypeError, match="images: expected Image, got ndarray"):
        tetopt.content(IMAGE.data)


@pytest.mark.parametrize("factor", [1j, 1 + 1j, 1 + 0j])
def test_complex_numbers_keep_no_part_of_themselves(factor):
    """None is dropped in silence, wherever arrays come in."""
    for call in (
        lambda: tetopt.Image(IMAGE.data * factor),
        lambda: tetopt.Image(IMAGE.data, IMAGE.affine * factor),
        lambda: tetopt.Mesh(MESH.points * factor, MESH.cells),
        lambda: tetopt.build_model(MESH, young=np.ones(1) * factor),
        lambda: tetopt.field_on_image(MESH, MESH.points * factor, IMAGE),
    ):
        with pytest.raises(tetopt.InputError, match="real numbers"):
            call()


def test_a_file_in_a_folder_that_is_not_there_is_one_line(tmp_path):
    for call in (
        lambda: tetopt.save_mesh(tmp_path / "no" / "a.vtu", MESH),
        lambda: tetopt.save_image(tmp_path / "no" / "a.nii", IMAGE),
        lambda: tetopt.save_model(tmp_path / "no" / "a.inp", tetopt.build_model(MESH)),
    ):
        with pytest.raises(tetopt.InputError, match="folder does not exist"):
            call()


def test_sizes_that_are_no_numbers_are_refused():
    for name in ("smallest", "edge_size", "gradation", "coarsest", "longest"):
        with pytest.raises(TypeError, match=f"sizes: {name}: expected a number, got str"):
            tetopt.octree_mesh(IMAGE, 100, tetopt.Sizes(**{name: "5"}))


@pytest.mark.parametrize(
    "arrays",
    [("x", [[0, 1, 2]]), ([[0, 0], [1]], [[0, 1, 2]]), (None, None), ({}, set()), (dict, 1)],
)
def test_a_mesh_of_anything(arrays):
    with pytest.raises(tetopt.InputError, match="mesh"):
        tetopt.Mesh(*arrays)


@pytest.mark.parametrize(
    "value",
    ["x.nii", Path("x.nii"), None, [1, 2], [[1, 2], [3]], 500, True, 10**5000, dict, {1}],
    ids=lambda value: type(value).__name__,
)
def test_an_image_of_anything(value):
    with pytest.raises(tetopt.InputError, match="image data: "):
        tetopt.Image(value)


def test_hidden_numbers_of_masked_arrays_are_not_used():
    labels = tetopt.Image(np.ones((6, 7, 8)))

    def masked(shape):
        return np.ma.masked_array(np.ones(shape), np.ones(shape))

    for call in (
        lambda: tetopt.extract_surface(MESH.points, MESH.cells, masked(1).astype(int)),
        lambda: tetopt.field_on_image(MESH, masked((4, 3)), IMAGE),
        lambda: tetopt.warped_image(MESH, masked((4, 3)), IMAGE),
        lambda: tetopt.build_model(MESH, young=masked(1)),
        lambda: tetopt.label_contacts(labels, MESH, masked(1)),
    ):
        with pytest.raises(tetopt.InputError, match=r"got \d+ masked values"):
            call()


def warning_calls(folder):
    """Calls that warn, at several depths within tetopt."""
    tetopt.save_image(folder / "even.nii", tetopt.Image(np.ones((3, 4, 5))))
    tetopt.save_image(
        folder / "large.nii", tetopt.Image(IMAGE.data, np.diag([900.0, 900.0, 900.0, 1.0]))
    )
    sets, loads = ["low=plane:0,0,0:0,0,1:0.1"], ["hold:low"]
    tetopt.save_model(folder / "a.vtu", tetopt.build_model(MESH, young=3.0, sets=sets, loads=loads))
    loaded = tetopt.load_mesh(folder / "a.vtu")
    own = loaded._replace(sets=loaded.sets._replace(facets={}))
    return {
        "save_model": lambda: tetopt.save_model(
            folder / "a.inp", tetopt.build_model(MESH, young=3.0, nu=0.46)
        ),
        "save_mesh": lambda: tetopt.save_mesh(folder / "b.vtk", MESH, {"a\nb": np.ones(1)}),
        "load_image": lambda: tetopt.load_image(folder / "even.nii"),
        "load_image, of a large one": lambda: tetopt.load_image(folder / "large.nii"),
        "build_model": lambda: tetopt.build_model(own),
    }


def test_a_warning_names_the_line_of_who_called(tmp_path):
    """Whichever of tetopt's functions issued it."""
    for name, call in warning_calls(tmp_path).items():
        with pytest.warns(UserWarning, match=r"\w: ") as caught:
            call()
        assert {Path(each.filename) for each in caught} == {Path(__file__)}, name


@pytest.mark.parametrize(
    ("points", "cells", "message"),
    [
        (MESH.points * np.nan, MESH.cells, "points: expected finite coordinates"),
        (MESH.points, MESH.cells + 1, r"cells: expected indices in 0\.\.3, got 1\.\.4"),
        (MESH.points, MESH.cells[:, :3], r"cells: expected shape \(M, 4\)"),
        (MESH.points[:, :1], MESH.cells, r"points: expected shape .*, got \(4, 1\)"),
        (MESH.points[:0], MESH.cells, r"cells: expected indices in 0\.\.-1"),
    ],
)
def test_points_and_cells_that_do_not_fit_are_refused(points, cells, message):
    """As by `Mesh`, in tests/test_mesh.py."""
    for name, chosen in (("quality", {}), ("E_G", {}), ("extract_surface", {"chosen": [True]})):
        with pytest.raises(tetopt.InputError, match=f"^{name}: {message}") as caught:
            getattr(tetopt, name)(points=points, cells=cells, **chosen)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int16, np.uint64])
def test_numbers_of_any_width_are_the_same_number(kind):
    """As 100 * 100 overflows 8 bits."""
    plain = tetopt.lattice_mesh(IMAGE, nodes=100)
    assert np.array_equal(tetopt.lattice_mesh(IMAGE, nodes=kind(100)).cells, plain.cells)
    tree = tetopt.octree_mesh(IMAGE, 120, tetopt.Sizes(gradation=1.0))
    for width in (kind, np.float16, np.longdouble):
        sizes = tetopt.Sizes(gradation=width(1))
        assert np.array_equal(tetopt.octree_mesh(IMAGE, kind(120), sizes).points, tree.points)
    assert tetopt.lattice_mesh(IMAGE, blocks=[kind(2), kind(3), kind(4)]).cells.shape == (288, 4)
    job = tetopt.Job(images="a.nii", output="a.vtu", nodes=kind(100), max_seconds=kind(2))
    assert (type(job.nodes), type(job.max_seconds)) == (int, float)


@pytest.mark.parametrize("value", ["7", 0.5, np.float32(7), np.array(7.0)])
def test_what_is_no_whole_number_is_refused(value):
    for call in (tetopt.lattice_mesh, tetopt.octree_mesh, tetopt.mesh_image):
        with pytest.raises(TypeError):
            call(IMAGE, nodes=value)
