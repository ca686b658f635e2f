"""`tetopt quality --check` and `tetopt surface` of meshes with labels, made by hand, as a user
types them.
"""

from pathlib import Path

import numpy as np
import pytest
import pyvista
import trimesh
from commands import assert_done, assert_refuses, numbers_in, run_command
from numpy.testing import assert_allclose

import tetopt
from tetopt import Image, lattice_mesh, save_mesh
from tetopt.measure.fidelity import cell_labels

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]


def save_blocks(name, labels, voxel=1.0):
    """The labels, and a mesh with a block of cells in each voxel, as files of a name; the mesh and
    the label of each cell.
    """
    image = Image(labels, np.diag([voxel, voxel, voxel, 1.0]))
    mesh = lattice_mesh(image, "five-tet", blocks=image.shape)
    of_cell = cell_labels(image, mesh)
    tetopt.save_image(f"{name}.nii.gz", image)
    save_mesh(f"{name}.vtu", mesh, {"label": of_cell})
    return mesh, of_cell


def test_a_boundary_that_is_no_manifold():
    """Two voxels of label 1 that share an edge, among 0. It is a fault, also where the mask's
    voxels touch like that; of an interface that no run smoothed it is said.
    """
    labels = np.zeros((4, 4, 4))
    labels[1, 1, 1] = labels[2, 2, 1] = 1
    mesh, of_cell = save_blocks("all", labels)
    used, cells = np.unique(mesh.cells[of_cell == 1], return_inverse=True)
    save_mesh("ones.vtu", tetopt.Mesh(mesh.points[used], cells.reshape(-1, 4)))
    check = "--check --json q.json --force"
    said = run_command(f"quality ones.vtu {check}", code=1).err
    problem = numbers_in("q.json")["problems"][-1]
    words = "edges where the boundary has more than two facets; nodes: 1, the first"
    assert problem.startswith(words)
    assert problem in said
    masked = f"quality ones.vtu {check} --image all.nii.gz --mask all.nii.gz"
    assert run_command(masked, code=1).err.count("more than two facets") == 1
    assert numbers_in("q.json")["problems"] == [problem]
    said = run_command(f"quality all.vtu {check} --image all.nii.gz")
    numbers = numbers_in("q.json")
    assert numbers["problems"] == []
    (remark,) = numbers["remarks"]
    assert remark.startswith(
        "edges where the interface of two labels has more than two facets (0 and 1 at 1); nodes: 1"
    )
    assert remark in said.err
    assert "checked: conforming, oriented, in one piece, fills the box" in said.out


# Surfaces


@pytest.fixture
def slabs(here):
    """Slabs of labels 1, 2, 4 and 1 again, each 4 x 3 voxels wide and one or two thick, 2 mm a
    voxel.
    """
    labels = np.zeros((4, 3, 6))
    labels[:] = [1, 1, 2, 4, 4, 1]
    Path("names.csv").write_text("label,name\n2,bone\n4,left lung\n")
    return save_blocks("slabs", labels, 2.0)[0]


SLAB = 4 * 3 * 4.0  # mm2
SUFFIXES = pytest.mark.parametrize("suffix", [".stl", ".ply", ".vtp", ".vtk"])


def normals_of(corners):
    """As long as the triangles are large."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0


def corners_in(path):
    """Of each triangle, by the class of VTK that 3D Slicer takes."""
    read = pyvista.read(path)
    return np.asarray(read.points, dtype=np.float64)[read.regular_faces]


def labels_in(path):
    """Labels inside and outside of each triangle, by readers that share no code with ours."""
    names = "label_inside", "label_outside"
    if path.endswith(".ply"):
        data = trimesh.load_mesh(path, process=False).metadata["_ply_raw"]["face"]["data"]
    else:
        data = pyvista.read(path).cell_data
    return np.column_stack([np.asarray(data[name]) for name in names])


@pytest.mark.parametrize("suffix", [".ply", ".vtp", ".vtk"])
@pytest.mark.parametrize("has_boundary", [False, True])
def test_all_interfaces_with_the_labels_of_both_sides(slabs, suffix, has_boundary):
    """Each lies in its plane, in its area, and faces out of its smaller label; so does the
    boundary.
    """
    out, more = f"all{suffix}", "--boundary" * has_boundary
    words = f"--interfaces {more} -o {out} --json a.json --label-names names.csv"
    said = run_command(f"surface slabs.vtu {words}").out
    corners, sides = corners_in(out), labels_in(out)
    normals = normals_of(corners)
    pairs = {(1, 2): (3.0, 1), (2, 4): (5.0, 1), (1, 4): (9.0, -1)}
    for pair, (z, up) in pairs.items():
        mine = (sides == pair).all(axis=1)
        assert_allclose(corners[mine][..., 2], z)
        assert_allclose(normals[mine].sum(axis=0), [0.0, 0.0, up * SLAB], atol=1e-9)
    outer = sides[:, 1] == -1
    outside = {(label, -1) for label in (1, 2, 4)} if has_boundary else set()
    assert set(map(tuple, sides.tolist())) == {*pairs, *outside}
    towards = corners[outer].mean(axis=1) - [3.0, 2.0, 5.0]
    assert ((normals[outer] * towards).sum(axis=1) > 0.0).all()
    area = (2 * 12 + 2 * 24 + 2 * 18) * 4.0 * has_boundary
    assert np.linalg.norm(normals[outer], axis=1).sum() == pytest.approx(area)
    numbers = numbers_in("a.json")
    rows = {
        (row["label_inside"], row["label_outside"]): row["area_mm2"]
        for row in numbers["interfaces"]
    }
    assert rows.keys() == {*pairs, *outside}
    assert [rows[pair] for pair in pairs] == pytest.approx([SLAB] * 3)
    # Around each interface its rim: 14 edges of voxels, to which the boundary adds two triangles.
    edges = (0, 3 * 14) if has_boundary else (3 * 14, 0)
    counts = numbers["n_triangles"], numbers["n_rim_edges"], numbers["n_seam_edges"]
    assert counts == (len(corners), *edges)
    assert "2 (bone) to 4 (left lung)" in said
    assert ("2 (bone) to outside" in said) == has_boundary


@SUFFIXES
def test_one_interface(slabs, suffix):
    """Out of the label that is named first, by number or name."""
    for sides, up in (("2,4", 1.0), ("left lung,bone", -1.0)):
        words = f"--interface '{sides}' -o one{suffix} --force --label-names names.csv"
        assert_done(f"surface slabs.vtu {words}")
        corners = corners_in(f"one{suffix}")
        assert_allclose(normals_of(corners).sum(axis=0), [0.0, 0.0, up * SLAB], atol=1e-5)
        assert_allclose(corners[..., 2], 5.0)


@SUFFIXES
def test_the_whole_boundary(slabs, suffix):
    out = f"b{suffix}"
    said = run_command(f"surface slabs.vtu --boundary -o {out}").out
    assert "watertight, normals out" in said
    surface = pyvista.read(out)
    assert surface.volume == pytest.approx(4 * 3 * 6 * 8.0)
    closed = trimesh.Trimesh(surface.points, surface.regular_faces)
    assert closed.is_watertight
    assert closed.area == pytest.approx(108 * 4.0)


def test_one_label_has_no_interfaces(slabs):
    save_mesh("one.vtu", slabs, {"label": np.ones(len(slabs.cells), dtype=int)})
    assert_refuses(
        "surface one.vtu --interfaces -o x.ply",
        "all cells have one label, so there are no interfaces",
    )
