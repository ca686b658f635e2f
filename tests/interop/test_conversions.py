"""Meshes to pyvista, meshio, scikit-fem and trimesh, and back."""

import sys

import meshio
import numpy as np
import pytest
import pyvista
import skfem
from models import quadratic_model, sample_model
from numpy.testing import assert_allclose
from refusals import refusal
from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid

import tetopt
from tetopt import Mesh
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.simplex import volumes
from tetopt.interop.conversions import add_array

VTK_NUMBERS = {
    2: (pyvista.CellType.TRIANGLE, pyvista.CellType.QUADRATIC_TRIANGLE),
    3: (pyvista.CellType.TETRA, pyvista.CellType.QUADRATIC_TETRA),
}
THERE_AND_BACK = {
    "pyvista": lambda mesh: Mesh.from_pyvista(mesh.to_pyvista()),
    "meshio": lambda mesh: Mesh.from_meshio(mesh.to_meshio()),
    "skfem": lambda mesh: Mesh.from_skfem(mesh.to_skfem()),
}


def in_space(points):
    """Points with z = 0, where they have none."""
    return np.column_stack([points, np.zeros((len(points), 3 - points.shape[1]))])


@pytest.mark.parametrize("name", THERE_AND_BACK)
def test_there_and_back_is_the_same_mesh(name, n):
    mesh = sample_model(n).mesh
    back = THERE_AND_BACK[name](mesh)
    assert back.points.tobytes() == mesh.points.tobytes()
    if (name, n) == ("skfem", 2):  # which sorts the nodes of a triangle
        assert (np.sort(back.cells, axis=1) == np.sort(mesh.cells, axis=1)).all()
    else:
        assert back.cells.tobytes() == mesh.cells.tobytes()


def test_data_go_with_the_mesh(n):
    mesh, rng = sample_model(n).mesh, np.random.default_rng(n)
    on_cells = {
        "mean": rng.normal(size=len(mesh.cells)),
        "is_in": rng.random(len(mesh.cells)) < 0.5,
    }
    on_nodes = {"moved": rng.normal(size=mesh.points.shape), "count": np.arange(len(mesh.points))}
    grid, other = mesh.to_pyvista(on_cells, on_nodes), mesh.to_meshio(on_cells, on_nodes)
    assert (grid.points == in_space(mesh.points)).all()
    assert (other.points == mesh.points).all()
    assert set(grid.celltypes) == {VTK_NUMBERS[n][0]}
    for name, values in on_cells.items():
        assert (grid.cell_data[name] == values).all()
        assert (other.cell_data[name][0] == values).all()
    for name, values in on_nodes.items():
        assert (grid.point_data[name] == values).all()
        assert (other.point_data[name] == values).all()
    assert (grid.cell_data.active_scalars_name, grid.point_data.active_scalars_name) == (
        "mean",
        "moved",
    )
    other.points[:] = 0.0  # copies
    grid.points[:] = 0.0
    assert np.ptp(mesh.points) > 0


@pytest.mark.parametrize("convert", ["to_pyvista", "to_meshio"])
def test_data_that_do_not_fit_are_one_line(convert):
    """More cases of the check that writers share are in test_formats."""
    mesh = sample_model().mesh
    rows = r"expected an array of numbers with \d+ rows"
    for data, words in (
        ({"cell_data": {"a\nb": [1.0, 2.0]}}, rf"cell_data: 'a\\nb': {rows}, got "),
        ({"point_data": {"u": np.zeros(len(mesh.cells) + 1)}}, f"point_data: 'u': {rows}"),
        ({"point_data": np.zeros(len(mesh.points))}, "point_data: expected a dict of arrays"),
    ):
        with refusal(f"^{words}"):
            getattr(mesh, convert)(**data)


@pytest.mark.parametrize("kind", [">f8", ">f4", ">i4", ">u2", "f2", "g"])
def test_numbers_of_any_bytes_are_the_same_numbers(kind, here):
    """As files of other machines have them; VTK would take their bytes for others."""
    mesh = sample_model().mesh
    values = np.arange(len(mesh.cells)).astype(kind)
    assert mesh.to_pyvista({"a": values}).cell_data["a"].tolist() == values.tolist()
    tetopt.save_mesh("a.vtu", mesh, {"a": values})
    assert tetopt.load_mesh("a.vtu").cell_data["a"].tolist() == values.tolist()


def test_of_quadratic_cells_the_corners_are_taken(n):
    mesh = sample_model(n).mesh
    points, cells = quadratic(mesh.points, mesh.cells)
    kind = {2: "triangle6", 3: "tetra10"}[n]
    curved = (skfem.MeshTri2 if n == 2 else skfem.MeshTet2).from_mesh(mesh.to_skfem())
    backs = [
        Mesh.from_pyvista(pyvista.UnstructuredGrid({VTK_NUMBERS[n][1]: cells}, in_space(points))),
        Mesh.from_meshio(meshio.Mesh(points, [(kind, cells)])),
        Mesh.from_skfem(curved),
    ]
    for back in backs:
        assert (back.points == mesh.points).all()
        assert (np.sort(back.cells, axis=1) == np.sort(mesh.cells, axis=1)).all()


def test_inverted_cells_are_turned_and_others_left_out():
    mesh = sample_model().mesh
    cells = mesh.cells.copy()
    cells[::2] = cells[::2][:, [1, 0, 2, 3]]
    points = np.vstack([np.full((1, 3), 99.0), mesh.points])  # the first is used by none
    blocks = [
        ("triangle", cells[:3, :3] + 1),
        ("tetra", cells[:7] + 1),
        ("vertex", np.array([[0]])),
        ("tetra", cells[7:] + 1),
    ]
    other = meshio.Mesh(points, blocks)
    for back in (Mesh.from_meshio(other), Mesh.from_pyvista(pyvista.from_meshio(other))):
        assert (back.points == mesh.points).all()
        assert (volumes(back.points, back.cells) > 0.0).all()
        assert (np.sort(back.cells, axis=1) == np.sort(mesh.cells, axis=1)).all()


def test_a_surface_in_the_plane_is_a_mesh():
    sheet = pyvista.Plane(i_resolution=3, j_resolution=2).triangulate()
    assert len(Mesh.from_pyvista(sheet).cells) == 12
    with refusal("from_pyvista: a triangle mesh must lie in the plane z = 0"):
        Mesh.from_pyvista(pyvista.Sphere())


TETRA = ("tetra", [[0, 1, 2, 3]])
CORNERS = np.vstack([np.zeros(3), np.eye(3), np.ones((6, 3))])


@pytest.mark.parametrize(
    ("convert", "other", "message"),
    [
        ("pyvista", pyvista.ImageData(dimensions=(2, 2, 2)), "of order 1 or 2, found voxel"),
        ("pyvista", pyvista.PolyData(), "found no cells"),
        ("pyvista", pyvista.MultiBlock(), "expected a pyvista or VTK grid, got MultiBlock"),
        ("pyvista", CORNERS, "expected a pyvista or VTK grid, got ndarray"),
        ("pyvista", "a.vtu", "expected a pyvista or VTK grid, got str"),
        ("pyvista", None, "expected a pyvista or VTK grid, got NoneType"),
        *(
            ("meshio", meshio.Mesh(CORNERS, cells), message)
            for cells, message in [
                ([TETRA, ("hexahedron", [range(8)])], "found hexahedron"),
                ([TETRA, ("tetra10", [range(10)])], "found tetra cells of both order 1 and"),
                ([("line", [[0, 1]])], "found line"),
                ([], "found no cells"),
                ([("tetra", [[0, 1, 2, 44]])], r"uses? nodes 0\.\.44, but it has 0\.\.9"),
                ([("tetra", [[0.0, 1.0, 2.5, 3.0]])], "4 integers each, got float64"),
                ([("tetra", [[0, 1, 2]])], r"tetra cells of 4 integers each, got .*1, 3"),
                ([("tetra10", [range(9)])], r"tetra10 cells of 10 integers"),
            ]
        ),
        *(
            ("meshio", meshio.Mesh(points, [TETRA]), message)
            for points, message in [
                (np.zeros((10, 4)), r"two or three real coordinates, got float64 of shape \(10, 4"),
                (CORNERS[:, :1], "two or three real coordinates"),
                (CORNERS * 1j, "real coordinates, got complex128"),
                ([["a"] * 3] * 4, "points of real numbers"),
            ]
        ),
        # one off it
        (
            "meshio",
            meshio.Mesh(np.eye(3), [("triangle", [[0, 1, 2]])]),
            "must lie in the plane z = 0",
        ),
        ("meshio", 3, "expected a meshio.Mesh, got int"),
        ("skfem", skfem.MeshQuad(), "expected a scikit-fem MeshTri or MeshTet, got MeshQuad"),
        ("skfem", skfem.MeshLine(), "got MeshLine"),
        (
            "skfem",
            skfem.MeshTet(np.zeros((3, 4)), np.zeros((4, 0), dtype=int)),
            r"4 integers each.*\(0, 4\)",
        ),
        ("skfem", sample_model().mesh, "got Mesh"),
    ],
)
def test_what_is_no_mesh_is_refused_in_one_line(convert, other, message):
    with refusal(rf"^from_{convert}: .*{message}"):
        getattr(Mesh, f"from_{convert}")(other)


def test_the_boundary_in_trimesh():
    mesh = sample_model().mesh
    boundary = mesh.to_trimesh()
    assert boundary.is_watertight
    assert boundary.is_winding_consistent
    assert_allclose(boundary.volume, volumes(mesh.points, mesh.cells).sum(), rtol=1e-12)
    with refusal("to_trimesh: expected tetrahedra"):
        sample_model(2).mesh.to_trimesh()


@pytest.mark.parametrize(
    ("name", "package", "convert"),
    [
        ("skfem", "scikit-fem", lambda mesh: mesh.to_skfem()),
        ("trimesh", "trimesh", lambda mesh: mesh.to_trimesh()),
        ("meshio", "meshio", Mesh.from_meshio),
        ("pyvista", "pyvista", lambda mesh: mesh.to_pyvista()),
    ],
)
def test_a_library_that_is_missing_is_named(monkeypatch, name, package, convert):
    monkeypatch.setitem(sys.modules, name, None)
    with refusal(f'{package} is not installed; pip install "{package}[^ ]*"$'):
        convert(sample_model().mesh)


@pytest.mark.parametrize(
    "model", [sample_model(2), sample_model(), quadratic_model(2), quadratic_model()]
)
def test_a_model_has_its_sets_and_materials_with_it(model, here):
    """As a file of ours that is read by the library has them, but sets of cells, which files
    have in words of ours.
    """
    tetopt.save_model("a.vtu", model)
    saved, grid, other = pyvista.read("a.vtu"), model.to_pyvista(), model.to_meshio()
    assert (grid.points == saved.points).all()
    assert (grid.cells == saved.cells).all()
    assert set(grid.celltypes) == {VTK_NUMBERS[model.mesh.ndim][model.order - 1]}
    of_sets = {f"in_{name}" for name in model.sets.cells}
    assert set(grid.cell_data.keys()) - of_sets == set(saved.cell_data.keys())
    assert set(grid.point_data.keys()) == set(saved.point_data.keys())
    for name in saved.cell_data:
        assert (grid.cell_data[name] == saved.cell_data[name]).all()
        assert (other.cell_data[name][0] == saved.cell_data[name]).all()
    for name in saved.point_data:
        assert (grid.point_data[name] == saved.point_data[name]).all()
    for name, members in model.sets.cells.items():
        assert np.flatnonzero(grid.cell_data[f"in_{name}"]).tolist() == members.tolist()
        assert other.cell_sets[name][0].tolist() == members.tolist()
    for name in model.sets.facets:
        assert (
            other.point_sets[name].tolist()
            == np.flatnonzero(saved.point_data[f"on_{name}"]).tolist()
        )
    assert (
        other.cells[0].data == grid.cells_dict[VTK_NUMBERS[model.mesh.ndim][model.order - 1]]
    ).all()
    assert (Mesh.from_meshio(other).cells == model.mesh.cells).all()


def test_arrays_of_no_rows_keep_their_columns():
    """As those of an empty set, which VTK's own conversion takes no width of."""
    grid = vtkUnstructuredGrid()
    add_array(grid.GetFieldData(), "none", np.empty((0, 2), dtype=np.int64))
    array = grid.GetFieldData().GetArray("none")
    assert (array.GetNumberOfTuples(), array.GetNumberOfComponents()) == (0, 2)
