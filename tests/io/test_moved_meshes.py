"""Meshes of tetopt's whose nodes another program has moved, or has not."""

import numpy as np
import pytest
import pyvista
from commands import assert_done, exit_code, in_copy_of
from refusals import refusal

from tetopt import Image, build_model, load_mesh, save_image


def sample():
    """12 mm a side."""
    return Image(np.random.default_rng(0).normal(size=(12, 12, 12)), np.eye(4))


MODEL = "--young 3 --space lps --units Pa --order 2"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A ball meshed within its mask, b.vtu, and a whole box, w.vtu."""
    folder = tmp_path_factory.mktemp("built")
    image = sample()
    is_in = np.linalg.norm(np.indices((12, 12, 12)) - 5.5, axis=0) < 5.0
    save_image(folder / "i.nii.gz", image)
    save_image(folder / "m.nii.gz", Image(is_in.astype(np.uint8), image.affine))
    words = ["mesh", folder / "i.nii.gz", "--nodes 150 --iterations 0 -o"]
    exit_code(*words, folder / "b.vtu", "--mask", folder / "m.nii.gz")
    exit_code(*words, folder / "w.vtu")
    return folder


here = in_copy_of("built")


def move(name, new, by=0.4):
    grid = pyvista.read(name)
    grid.points = np.asarray(grid.points) + by
    grid.save(new)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".msh2"])
@pytest.mark.parametrize("options", ["", MODEL])
def test_a_mesh_in_its_place_keeps_its_mask(suffix, options, capsys):
    assert_done("convert b.vtu", f"c{suffix}", options)
    assert_done("convert", f"c{suffix}", "d.vtu --image i.nii.gz --young 3+h**2")
    loaded = load_mesh("d.vtu")
    assert "mask" in loaded.field_data
    assert not loaded.is_moved
    assert "moved" not in capsys.readouterr().err


def test_single_precision_moves_no_nodes():
    grid = pyvista.read("b.vtu")
    grid.points = np.asarray(grid.points).astype(np.float32)
    grid.save("f.vtu")
    assert "mask" in load_mesh("f.vtu").field_data


def test_cells_that_are_left_out_move_no_nodes():
    pyvista.read("b.vtu").extract_cells(np.arange(40)).save("f.vtu")
    assert "mask" in load_mesh("f.vtu").field_data


def test_a_moved_mesh_needs_its_mask_again(capsys):
    move("b.vtu", "n.vtu")
    assert exit_code("convert n.vtu c.vtu --image i.nii.gz --young 3+h**2") == 2
    assert "--mask" in capsys.readouterr().err
    assert_done("convert n.vtu c.vtu")  # which stays moved
    assert exit_code("fem c.vtu --image i.nii.gz --young 3+h**2 --load hold:left") == 2
    assert "moved" in capsys.readouterr().err
    with refusal("moved.*mask"):
        build_model(load_mesh("n.vtu"), sample(), young="3+h**2")
    assert_done("convert n.vtu e.vtu --image i.nii.gz --mask m.nii.gz --young 3+h**2")


@pytest.mark.parametrize("name", ["b", "w"])
@pytest.mark.parametrize("options", ["", "--check"])
def test_the_quality_of_a_moved_mesh(name, options, capsys):
    move(f"{name}.vtu", "n.vtu")
    mask = "--mask m.nii.gz" if name == "b" else ""
    exit_code("quality n.vtu --image i.nii.gz", mask, options)
    said = " ".join(capsys.readouterr().err.split())
    assert "moved after meshing" in said
    assert "report this" not in said
    assert "--nodes" not in said
    assert "more nodes" not in said
