"""`tetopt quality --check` and `tetopt surface` of meshes with labels, made by hand, as a user types them."""

import numpy as np
import pytest
from commands import exit_code, numbers_in

import tetopt
from tetopt.measure.fidelity import cell_labels


def block_mesh(labels):
    """An image of labels, a mesh with a block of cells in each voxel, and the label of each cell."""
    image = tetopt.Image(labels)
    mesh = tetopt.lattice(image, "five-tet", blocks=image.shape)
    return image, mesh, cell_labels(image, mesh)


@pytest.fixture
def touching(tmp_path):
    """Two voxels of label 1 that share an edge, among 0: labels, their mesh, and the mesh of label 1 alone."""
    labels = np.zeros((4, 4, 4))
    labels[1, 1, 1] = labels[2, 2, 1] = 1
    image, mesh, of_cell = block_mesh(labels)
    tetopt.save_image(tmp_path / "labels.nii.gz", image)
    tetopt.save_mesh(tmp_path / "all.vtu", mesh, {"label": of_cell})
    used, cells = np.unique(mesh.cells[of_cell == 1], return_inverse=True)
    tetopt.save_mesh(tmp_path / "ones.vtu", tetopt.Mesh(mesh.points[used], cells.reshape(-1, 4)))
    return tmp_path


def test_a_boundary_that_is_no_manifold(touching, capsys):
    """It is a fault, unless the mask is like that; of an interface it is only said."""
    check = ["--check", "--json", touching / "q.json", "--force"]
    assert exit_code("quality", touching / "ones.vtu", *check) == 1
    problems = numbers_in(touching / "q.json")["problems"]
    assert problems[-1].startswith("edges where the boundary has more than two facets; nodes: 1, the first")
    assert problems[-1] in capsys.readouterr().err

    beside = ["--image", touching / "labels.nii.gz", "--mask", touching / "labels.nii.gz"]
    assert exit_code("quality", touching / "ones.vtu", *check, *beside) == 0
    numbers = numbers_in(touching / "q.json")
    assert numbers["problems"] == []
    (remark,) = numbers["remarks"]
    assert remark == f"{problems[-1]}; the mask's voxels touch like that at 1 edges and corners"
    assert remark in capsys.readouterr().err

    assert exit_code("quality", touching / "all.vtu", *check, "--image", touching / "labels.nii.gz") == 0
    numbers = numbers_in(touching / "q.json")
    assert numbers["problems"] == []
    (remark,) = numbers["remarks"]
    assert remark.startswith(
        "edges where the interface of two labels has more than two facets (0 and 1 at 1); nodes: 1"
    )
    said = capsys.readouterr()
    assert remark in said.err
    assert "checked: conforming, oriented, in one piece, fills the box" in said.out


def test_a_mask_that_is_a_manifold_excuses_nothing(touching):
    mask = np.zeros((4, 4, 4))
    mask[1:3, 1:3, 1] = 1
    tetopt.save_image(touching / "mask.nii.gz", tetopt.Image(mask))
    beside = ["--image", touching / "labels.nii.gz", "--mask", touching / "mask.nii.gz"]
    assert exit_code("quality", touching / "ones.vtu", "--check", *beside) == 1
