"""`tetopt quality --check` and `tetopt surface` of meshes with labels, made by hand, as a user
types them.
"""

from pathlib import Path

import numpy as np
import pytest
import pyvista
import trimesh
from commands import assert_done, assert_refused, exit_code, numbers_in
from numpy.testing import assert_allclose

import tetopt
from tetopt import Image, lattice_mesh, save_mesh
from tetopt.measure.fidelity import cell_labels

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]


def block_mesh(labels):
    """An image of labels, a mesh with a block of cells in each voxel, and the label of each
    cell.
    """
    image = Image(labels)
    mesh = lattice_mesh(image, "five-tet", blocks=image.shape)
    return image, mesh, cell_labels(image, mesh)


@pytest.fixture(autouse=True)
def touching(here):
    """Two voxels of label 1 that share an edge, among 0: labels, their mesh, and the mesh of
    label 1 alone.
    """
    labels = np.zeros((4, 4, 4))
    labels[1, 1, 1] = labels[2, 2, 1] = 1
    image, mesh, of_cell = block_mesh(labels)
    tetopt.save_image("labels.nii.gz", image)
    save_mesh("all.vtu", mesh, {"label": of_cell})
    used, cells = np.unique(mesh.cells[of_cell == 1], return_inverse=True)
    save_mesh("ones.vtu", tetopt.Mesh(mesh.points[used], cells.reshape(-1, 4)))


def test_a_boundary_that_is_no_manifold(capsys):
    """It is a fault, also where the mask's voxels touch like that; of an interface that no run
    smoothed it is said.
    """
    check = "--check --json q.json --force"
    assert exit_code(f"quality ones.vtu {check}") == 1
    problems = numbers_in("q.json")["problems"]
    assert problems[-1].startswith(
        "edges where the boundary has more than two facets; nodes: 1, the first"
    )
    assert problems[-1] in capsys.readouterr().err

    assert exit_code(f"quality ones.vtu {check} --image labels.nii.gz --mask labels.nii.gz") == 1
    assert numbers_in("q.json")["problems"] == problems[-1:]
    assert capsys.readouterr().err.count("more than two facets") == 1

    assert_done(f"quality all.vtu {check} --image labels.nii.gz")
    numbers = numbers_in("q.json")
    assert numbers["problems"] == []
    (remark,) = numbers["remarks"]
    assert remark.startswith(
        "edges where the interface of two labels has more than two facets (0 and 1 at 1); nodes: 1"
    )
    said = capsys.readouterr()
    assert remark in said.err
    assert "checked: conforming, oriented, in one piece, fills the box" in said.out


# Surfaces


@pytest.fixture(autouse=True)
def slabs(here):
    """Slabs of labels 1, 2, 4 and 1 again, each 4 x 3 voxels wide and one or two thick, 2 mm a
    voxel.
    """
    labels = np.zeros((4, 3, 6))
    labels[:] = [1, 1, 2, 4, 4, 1]
    mesh = lattice_mesh(Image(labels, np.diag([2.0, 2.0, 2.0, 1.0])), "five-tet", blocks=(4, 3, 6))
    of_cell = cell_labels(Image(labels, np.diag([2.0, 2.0, 2.0, 1.0])), mesh)
    save_mesh("slabs.vtu", mesh, {"label": of_cell})
    Path("names.csv").write_text("label,name\n2,bone\n4,left lung\n")


SLAB = 4 * 3 * 4.0  # mm2


def labels_in(path):
    """Places of the corners, labels inside and outside of each triangle, by readers that share
    no code with ours.
    """
    if path.endswith(".ply"):
        read = trimesh.load_mesh(path, process=False)
        corners = read.vertices[read.faces]
        sides = [
            read.metadata["_ply_raw"]["face"]["data"][f"label_{side}"]
            for side in ("inside", "outside")
        ]
        # by the class of VTK that 3D Slicer takes
        assert pyvista.read(path).n_cells == len(corners)
    else:
        read = pyvista.read(path)
        corners = np.asarray(read.points)[read.regular_faces]
        sides = [np.asarray(read.cell_data[f"label_{side}"]) for side in ("inside", "outside")]
    return corners, np.column_stack(sides)


@pytest.mark.parametrize("suffix", [".ply", ".vtp", ".vtk"])
@pytest.mark.parametrize("has_boundary", [False, True])
def test_all_interfaces_with_the_labels_of_both_sides(suffix, has_boundary, capsys):
    """Each lies in its plane, in its area, and faces out of its smaller label; so does the
    boundary.
    """
    out, more = f"all{suffix}", "--boundary" * has_boundary
    assert_done(
        f"surface slabs.vtu --interfaces {more} -o {out} --json a.json --label-names names.csv"
    )
    corners, sides = labels_in(out)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
    for (inside, outside), z, up in (((1, 2), 3.0, 1), ((2, 4), 5.0, 1), ((1, 4), 9.0, -1)):
        mine = (sides == (inside, outside)).all(axis=1)
        assert_allclose(corners[mine][..., 2], z)
        assert_allclose(normals[mine].sum(axis=0), [0.0, 0.0, up * SLAB])
    outer = sides[:, 1] == -1
    assert set(sides[outer, 0]) == ({1, 2, 4} if has_boundary else set())
    centre = np.array([3.0, 2.0, 5.0])
    assert ((normals[outer] * (corners[outer].mean(axis=1) - centre)).sum(axis=1) > 0.0).all()
    assert np.linalg.norm(normals[outer], axis=1).sum() == pytest.approx(
        (2 * 12 + 2 * 24 + 2 * 18) * 4.0 * has_boundary
    )
    assert (sides[:, 0] != sides[:, 1]).all()

    numbers = numbers_in("a.json")
    rows = {
        (row["label_inside"], row["label_outside"]): row["area_mm2"]
        for row in numbers["interfaces"]
    }
    assert rows[1, 2] == rows[2, 4] == rows[1, 4] == pytest.approx(SLAB)
    assert set(rows) == {(1, 2), (1, 4), (2, 4)} | (
        {(1, -1), (2, -1), (4, -1)} if has_boundary else set()
    )
    assert numbers["n_triangles"] == len(corners)
    # Around each interface its rim: 14 edges of voxels, to which the boundary adds two triangles.
    edges = (0, 3 * 14) if has_boundary else (3 * 14, 0)
    assert (numbers["n_rim_edges"], numbers["n_seam_edges"]) == edges
    said = capsys.readouterr().out
    assert "2 (bone) to 4 (left lung)" in said
    assert ("2 (bone) to outside" in said) == has_boundary


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".vtp", ".vtk"])
def test_one_interface(suffix):
    """Out of the label that is named first, by number or name."""
    for sides, up in (("2,4", 1.0), ("left lung,bone", -1.0)):
        out = f"one{suffix}"
        words = f"surface slabs.vtu --interface '{sides}' -o {out} --force"
        assert_done(f"{words} --label-names names.csv")
        surface = pyvista.read(out)
        corners = np.asarray(surface.points, dtype=np.float64)[surface.regular_faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
        assert_allclose(normals.sum(axis=0), [0.0, 0.0, up * SLAB], atol=1e-5)
        assert_allclose(corners[..., 2], 5.0)


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".vtp", ".vtk"])
def test_the_whole_boundary(suffix, capsys):
    out = f"b{suffix}"
    assert_done(f"surface slabs.vtu --boundary -o {out}")
    assert "watertight, normals out" in capsys.readouterr().out
    surface = pyvista.read(out)
    assert surface.volume == pytest.approx(4 * 3 * 6 * 8.0)
    closed = trimesh.Trimesh(surface.points, surface.regular_faces)
    assert closed.is_watertight
    assert closed.area == pytest.approx(108 * 4.0)


def test_one_label_has_no_interfaces(capsys):
    mesh = tetopt.load_mesh("slabs.vtu").mesh
    save_mesh("one.vtu", mesh, {"label": np.ones(len(mesh.cells), dtype=int)})
    assert_refused(
        capsys,
        "surface one.vtu --interfaces -o x.ply",
        "all cells have one label, so there are no interfaces",
    )
