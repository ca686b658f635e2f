"""Surfaces through files: closed for a reader that welds by place, every bit but in STL, RAS in
the header.
"""

import numpy as np
import pytest
import pyvista
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from meshes import CUBE_CORNER, TWO_TETS
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from shapes import n_pieces, volume_and_area
from vtkmodules.vtkIOGeometry import vtkSTLReader
from vtkmodules.vtkIOPLY import vtkPLYReader

from tetopt.geometry.simplex import volumes
from tetopt.geometry.surface import Surface, extract_surface
from tetopt.geometry.topology import boundary_facets
from tetopt.image import Image
from tetopt.io.surfaces import check_surface, save_surface
from tetopt.start.lattice import lattice_mesh

# Two cells that share the edge 0 1, far from the origin
EDGE = (
    np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]])
    + np.array([150.1, -230.2, 310.3]),
    np.array([[0, 2, 3, 1], [0, 4, 5, 1]]),
)
SUFFIXES = pytest.mark.parametrize("suffix", [".STL", ".ply", ".vtp", ".vtk"])


def some_surface(seed, fraction=0.5):
    """The surface of some cells of a lattice out where coordinates have few bits left, and the
    cells' volume.
    """
    mesh = lattice_mesh(Image(np.zeros((7, 8, 9)), np.diag([1.1, 0.9, 1.3, 1.0])), nodes=100)
    rng = np.random.default_rng(seed)
    points = mesh.points + rng.normal(0.0, 0.05, mesh.points.shape) + rng.uniform(-400.0, 400.0, 3)
    chosen = np.append(np.flatnonzero(rng.random(len(mesh.cells)) < fraction), 0)
    return extract_surface(points, mesh.cells, chosen), volumes(
        points, mesh.cells[np.unique(chosen)]
    ).sum()


@SUFFIXES
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), fraction=st.sampled_from([0.05, 0.3, 0.6, 0.9]))
def test_any_surface_is_closed_when_read_back(here, suffix, seed, fraction):
    surface, expected = some_surface(seed, fraction)
    save_surface(f"a{suffix}", surface)
    check = check_surface(f"a{suffix}")
    volume, area = volume_and_area(surface)
    assert check[:2] == (True, True)
    assert check.n_pieces == n_pieces(surface)
    # STL's float32 moves a node by 1.5e-5 mm in each direction at 400 mm.
    places = 3e-5 * area if suffix.lower() == ".stl" else 1e-9
    assert check.volume == pytest.approx(volume, abs=places)
    assert check.area == pytest.approx(area, rel=1e-4 if suffix.lower() == ".stl" else 1e-9)
    assert check.volume == pytest.approx(expected, abs=1.01 * surface.largest_shift * area + places)
    assert check.volume > 0.0


@SUFFIXES
def test_cells_that_touch_are_closed_only_once_they_are_parted(here, suffix):
    points, cells = EDGE
    save_surface(f"raw{suffix}", Surface(points, boundary_facets(cells), 0, 0.0))
    assert not check_surface(f"raw{suffix}").is_watertight
    save_surface(f"a{suffix}", extract_surface(points, cells, [0, 1]))
    check = check_surface(f"a{suffix}")
    assert (check.is_watertight, check.is_winding_consistent, check.n_pieces) == (True, True, 2)
    assert check.volume == pytest.approx(1 / 3, rel=3e-3)


@SUFFIXES
def test_a_triangle_turned_over_or_left_out_is_seen(here, suffix):
    surface = extract_surface(*TWO_TETS, [0, 1])
    turned = surface.triangles.copy()
    turned[0] = turned[0, ::-1]
    save_surface(f"turned{suffix}", surface._replace(triangles=turned))
    assert check_surface(f"turned{suffix}")[:2] == (True, False)
    save_surface(f"open{suffix}", surface._replace(triangles=surface.triangles[1:]))
    assert not check_surface(f"open{suffix}").is_watertight


def test_every_bit_and_the_order_come_back_from_ply(here):
    surface, _ = some_surface(3)
    save_surface("a.ply", surface)
    back = trimesh.load_mesh("a.ply", process=False)
    assert np.asarray(back.vertices, dtype=np.float64).tobytes() == surface.points.tobytes()
    assert_array_equal(back.faces, surface.triangles)
    assert [p.name for p in here.iterdir()] == ["a.ply"]


def test_stl_holds_the_nearest_float32_and_unit_normals(here):
    surface, _ = some_surface(3)
    save_surface("a.stl", surface)
    back = trimesh.load_mesh("a.stl", process=False)
    assert_array_equal(
        np.asarray(back.vertices, dtype=np.float32),
        surface.points[surface.triangles].reshape(-1, 3).astype(np.float32),
    )
    corners = surface.points[surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    stored = (
        np.frombuffer((here / "a.stl").read_bytes()[84:], np.uint8)
        .reshape(-1, 50)[:, :12]
        .copy()
        .view("<f4")
    )
    assert_allclose(np.linalg.norm(stored, axis=1), 1.0, rtol=1e-6)
    assert_allclose((stored * normals).sum(axis=1), np.linalg.norm(normals, axis=1), rtol=1e-6)


def test_the_header_says_ras_where_slicer_looks(here):
    """3D Slicer reads both with these classes of VTK, and looks in the STL's header and in each
    PLY comment.
    """
    surface = extract_surface(*CUBE_CORNER, [0])
    about = "solid.nii\nmean below 43, Schädel " + "x" * 90
    save_surface("a.stl", surface, about)
    save_surface("a.ply", surface, about)
    assert (here / "a.stl").stat().st_size == 84 + 4 * 50
    assert not (here / "a.stl").read_bytes().startswith(b"solid")

    stl, ply = vtkSTLReader(), vtkPLYReader()
    for reader, name in ((stl, "a.stl"), (ply, "a.ply")):
        reader.SetFileName(str(here / name))
        reader.Update()
        assert reader.GetOutput().GetNumberOfCells() == 4
    said = "solid.nii mean below 43, Sch?del " + "x" * 90
    assert stl.GetHeader() == f"tetopt SPACE=RAS mm {said}"[:80]
    comments = ply.GetComments()
    assert [comments.GetValue(k) for k in range(comments.GetNumberOfValues())] == [
        "SPACE=RAS",
        f"tetopt; mm {said}",
    ]


@pytest.mark.parametrize("space", ["ras", "lps"])
def test_vtk_files_say_their_space_and_hold_every_bit(here, space):
    """Where Slicer looks: in the head of a VTK file, in a text SPACE of a VTP file."""
    surface, _ = some_surface(5)
    labels = {
        "label_inside": np.arange(len(surface.triangles)),
        "label_outside": np.full(len(surface.triangles), -1),
    }
    for suffix in (".vtp", ".vtk"):
        save_surface(f"a{suffix}", surface, "solid.nii\nmean " + "x" * 300, space, labels)
        back = pyvista.read(f"a{suffix}")
        sign = np.array([1.0, 1.0, 1.0]) if space == "ras" else np.array([-1.0, -1.0, 1.0])
        assert np.asarray(back.points).tobytes() == (surface.points * sign).tobytes()
        assert_array_equal(back.regular_faces, surface.triangles)
        for name, values in labels.items():
            assert_array_equal(back.cell_data[name], values)
    assert (
        (here / "a.vtk")
        .read_bytes()
        .splitlines()[1]
        .startswith(f"tetopt, SPACE={space.upper()} mm ".encode())
    )
    assert list(pyvista.read("a.vtp").field_data["SPACE"]) == [space.upper()]


def test_stl_has_no_room_for_labels(here):
    with refusal(r"STL cannot store labels of triangles; use \.ply or \.vtp or \.vtk"):
        save_surface(
            "a.stl",
            extract_surface(*CUBE_CORNER, [0]),
            labels={"label": np.zeros(4, dtype=int)},
        )
    assert list(here.iterdir()) == []


def test_one_line_for_every_bad_file(here):
    with refusal(r"a\.obj: expected a name ending in \.stl or \.ply or \.vtp or \.vtk"):
        save_surface("a.obj", extract_surface(*CUBE_CORNER, [0]))
    with refusal("no such surface file"):
        check_surface("none.stl")
    save_surface("a.ply", extract_surface(*CUBE_CORNER, [0]))
    whole = (here / "a.ply").read_bytes()
    for name, content in {
        "cut.ply": whole[:-20],
        "noise.stl": b"\x93" * 300,
        "empty.stl": b"",
        "0.stl": bytes(84),
    }.items():
        (here / name).write_bytes(content)
        with refusal(f"{name}: .*damaged\\?$"):
            check_surface(name)


@SUFFIXES
def test_a_name_that_is_not_utf8_is_read_back(here, suffix):
    points, cells = TWO_TETS
    save_surface(f"caf\udce9{suffix}", extract_surface(points, cells, np.arange(2)), "two")
    assert check_surface(f"caf\udce9{suffix}").is_watertight
