"""Models as VTK's files: every bit, set, material and text comes back, by our reader, pyvista
and meshio.
"""

import json

import meshio
import numpy as np
import pytest
import pyvista
from models import quadratic_model, sample_model, young_of
from numpy.testing import assert_allclose, assert_array_equal

from tetopt.io.formats import save_model
from tetopt.io.meshes import load_mesh
from tetopt.io.vtk import model_grid
from tetopt.model.model import element_facets, elements


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_other_readers_see_nodes_of_sets_and_quadratic_cells(tmp_path, n, order, suffix):
    """VTK finds a quadratic field exactly in the middle of cells, so that nodes and edges go
    together; sets have their middle nodes, too.
    """
    model, path = quadratic_model(n)._replace(order=order), tmp_path / f"a.{suffix}"
    nodes, cells = elements(model)
    middle = nodes.mean(axis=0)
    field = ((nodes - middle) ** 2).sum(axis=1)
    save_model(path, model._replace(point_data={"square": field}), space="ras", units="MPa")
    other, grid = meshio.read(path), pyvista.read(path)
    assert_allclose(other.cell_data["young"][0], young_of(model) / 1000.0, rtol=1e-15)
    for name, rows in model.sets.facets.items():
        on_set = np.unique(element_facets(cells, rows))
        for at_nodes in (grid.point_data, other.point_data):
            assert_array_equal(np.flatnonzero(at_nodes[f"on_{name}"]), on_set)
    centres = model.mesh.points[model.mesh.cells].mean(axis=1)
    expected = ((centres - middle) ** 2).sum(axis=1)
    places = pyvista.PolyData(np.column_stack([centres, np.zeros((len(centres), 3 - n))]))
    # VTK looks for a place in a cell by iteration. Were two edges exchanged, values would be off by
    # 1.
    if order == 2:
        assert_allclose(places.sample(grid)["square"], expected, rtol=0, atol=0.01)


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "msh"])
def test_results_are_turned_and_scaled_with_the_file(tmp_path, suffix):
    """In LPS and MPa for whoever reads the file, and back in RAS and kPa for us, tensors whole;
    also of a second step. The cells of gmsh's files have another order.
    """
    rng, model, path = np.random.default_rng(5), quadratic_model(), tmp_path / f"a.{suffix}"
    n_nodes = len(model.point_data["displacement"])
    tensor, moves = rng.normal(size=(len(model.mesh.cells), 3, 3)), rng.normal(size=(n_nodes, 3))
    stress = tensor.reshape(-1, 9)
    cell_data = {"stress": stress, "strain_step2": stress, "von_mises": tensor[:, 0, 0]}
    point_data = {"displacement_step2": moves, "stress_nodes": rng.normal(size=(n_nodes, 9))}
    model = model._replace(cell_data=cell_data, point_data=point_data, materials=None)
    save_model(path, model, space="lps", units="MPa")
    if suffix != "msh":
        grid, turn = pyvista.read(path), np.diag([-1.0, -1.0, 1.0])
        turned = (turn @ tensor @ turn.T).reshape(-1, 9)
        for values, expected in (
            (grid.cell_data["stress"], turned / 1000.0),
            (grid.cell_data["strain_step2"], turned),
            (grid.cell_data["von_mises"], tensor[:, 0, 0] / 1000.0),
            (grid.point_data["displacement_step2"], moves @ turn),
        ):
            assert_allclose(values, expected, rtol=1e-14)
    back = load_mesh(path)
    place = {tuple(cell): k for k, cell in enumerate(model.mesh.cells.tolist())}
    of_cell = [place[tuple(cell)] for cell in back.mesh.cells.tolist()]
    for fields, expected, rows in (
        (back.cell_data, cell_data, of_cell),
        (back.point_data, point_data, slice(None)),
    ):
        assert set(fields) == set(expected)
        for name, values in expected.items():
            assert_allclose(fields[name], values[rows], rtol=1e-14, err_msg=name)


def load_with(path, grid, name, values):
    """The grid through a file, with more field data."""
    grid.field_data[name] = values
    grid.save(path)
    return load_mesh(path)


def test_stresses_of_an_unknown_unit_are_left_out(tmp_path):
    model = quadratic_model()
    ones = np.ones(len(model.mesh.points))
    model = model._replace(point_data={"von_mises_nodes": ones, "kept": ones})
    back = load_with(tmp_path / "a.vtu", pyvista.wrap(model_grid(model)), "units", ["psi"])
    assert list(back.point_data) == ["kept"]
    assert not {"young", "nu", "material"} & set(back.cell_data)
    assert back.notes == (
        'dropped moduli and stresses, as their unit is none of kPa, MPa, Pa: "psi"',
    )


@pytest.mark.parametrize("space", ["ras", "lps"])
def test_the_head_of_a_legacy_file_is_what_3d_slicer_looks_for(here, space):
    save_model("a.vtk", sample_model(), space=space)
    head = f"# vtk DataFile Version 4.2\ntetopt, mm, SPACE={space.upper()}\nBINARY\n"
    assert (here / "a.vtk").read_bytes().startswith(head.encode())


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_a_file_of_3d_slicer_s_in_lps_is_turned(tmp_path, suffix):
    """As its vtkMRMLModelStorageNode writes them: a word in the head, or a string among the
    field data.
    """
    model, path = sample_model(), tmp_path / f"a.{suffix}"
    grid = pyvista.UnstructuredGrid({10: model.mesh.cells}, model.mesh.points * [-1, -1, 1])
    if suffix == "vtu":
        grid.field_data["SPACE"] = ["LPS"]
        grid.save(path)
    else:
        grid.save(path, binary=False)
        lines = path.read_text().split("\n")
        path.write_text("\n".join([lines[0], "3D Slicer output. SPACE=LPS", *lines[2:]]))
    back = load_mesh(path)
    assert back.space == "lps"
    assert_allclose(back.mesh.points, model.mesh.points, rtol=1e-9)


def with_cells(grid, cells):
    """Other cells, all else as it was."""
    other = pyvista.UnstructuredGrid({10: cells}, grid.points)
    other.field_data.update({name: grid.field_data[name] for name in grid.field_data})
    return other


CHANGES = {
    # mirrored: a row (cell, k) means another facet once two nodes of its cell are exchanged
    "turned": lambda grid: grid.scale([-1.0, 1.0, 1.0]),
    "fewer": lambda grid: grid.threshold(20, scalars="mean"),
    "reordered": lambda grid: with_cells(grid, grid.cells_dict[10][::-1]),
    "no checksum": lambda grid: grid.field_data.remove("cells_sha256") or grid,
    "no text": lambda grid: grid.field_data.update({"cells_sha256": np.array([1.5])}) or grid,
}


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
@pytest.mark.parametrize("change", CHANGES)
def test_sets_are_dropped_unless_the_cells_are_those_they_were_written_for(
    tmp_path, change, suffix
):
    model, path = sample_model(), tmp_path / f"a.{suffix}"
    save_model(path, model)
    grid = CHANGES[change](pyvista.read(path))
    assert "facets:left" in grid.field_data
    grid.save(path)
    back = load_mesh(path)
    assert back.sets == ({}, {})
    (note,) = back.notes
    assert note.startswith("dropped sets, as the cells may have changed")
    assert set(note.split(": ")[1].split(", ")) == {*model.sets.facets, *model.sets.cells}


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("facets:odd", np.array([1, 2, 3])),
        ("facets:fifth", np.array([[0, 4]])),
        ("facets:floats", np.array([[0.0, 1.0]])),
        ("facets:backwards", np.array([[3, 1], [3, 0]])),
        ("cells:beyond", np.array([0, 10**6])),
        ("cells:negative", np.array([-1, 3])),
        ("cells:twice", np.array([3, 3])),
        ("cells:text", ["3"]),
        ("cells:bytes", np.frombuffer(b"3", dtype=np.uint8)),  # which is text
        ("cells:has space", np.array([1, 2])),
        ("cells:LEFT", np.array([1, 2])),
    ],
)
def test_sets_that_cannot_be_ours_are_dropped(here, name, values):
    save_model("a.vtu", sample_model())
    grid = pyvista.read("a.vtu")
    back = load_with(here / "b.vtu", grid, name, values)
    assert [set(each) for each in back.sets] == [set(each) for each in sample_model().sets]
    assert [note.split(": ")[1] for note in back.notes] == [name.partition(":")[2]]


BOX = {"shape": [9, 8, 7], "affine": np.diag([2.0, 2.0, 3.0, 1.0]).tolist()}


@pytest.mark.parametrize(
    "box",
    [
        np.array([0.0, 1.0, 0.0, 1.0]),
        np.empty(0),
        ["no JSON"],
        *(
            [json.dumps(each)]
            for each in (
                [1, 2],
                3,
                None,
                {"shape": [9, 8, 7]},
                BOX | {"shape": 9},
                BOX | {"shape": [9, 8]},
                BOX | {"shape": [9, 8, 0]},
                BOX | {"shape": [9.5, 8, 7]},
                BOX | {"shape": ["9", "8", "7"]},
                BOX | {"affine": None},
                BOX | {"affine": "x"},
                BOX | {"affine": [[1.0]]},
                BOX | {"affine": np.diag([1.0, 0.0, 1.0, 1.0]).tolist()},
                BOX | {"affine": [[10**400] * 4] * 4},
                {"shape": [9, 8], "affine": np.eye(3).tolist()},
            )
        ),
    ],
)
def test_a_box_of_another_program_s_is_none(tmp_path, box):
    assert load_with(tmp_path / "a.vtu", sample_model().mesh.to_pyvista(), "box", box).box is None


def test_the_box_of_ours_comes_back(here):
    save_model("a.vtu", sample_model()._replace(about={"box": BOX}))
    box = load_mesh("a.vtu").box
    assert box.shape == (9, 8, 7)
    assert_array_equal(box.affine, BOX["affine"])


def test_meshio_reads_a_legacy_file_of_data_that_came_from_a_vtu_file(here):
    """What VTK has read are "long long", which it writes as "vtktypeint64", unknown to meshio
    5.3.5.
    """
    model = sample_model()
    big = {"big": np.resize([2**40, -1], len(model.mesh.cells))}
    save_model("a.vtu", model._replace(cell_data=model.cell_data | big))
    fields = load_mesh("a.vtu").cell_data
    assert fields["n_voxels"].dtype == np.int64
    save_model("b.vtk", model._replace(cell_data=fields, materials=None))
    assert b"vtktypeint64" not in (here / "b.vtk").read_bytes()
    other = meshio.read("b.vtk")
    assert set(other.cell_data) == set(fields)
    for name, values in fields.items():
        assert_array_equal(other.cell_data[name][0].ravel(), values)
        kind = np.int32 if name in ("n_voxels", "label", "material") else np.float64
        assert other.cell_data[name][0].dtype.newbyteorder("=") == kind


@pytest.mark.parametrize("values", [np.array([1.5]), np.empty(0)])
def test_a_space_that_is_no_text_is_not_looked_at(tmp_path, values):
    back = load_with(tmp_path / "a.vtu", sample_model().mesh.to_pyvista(), "space", values)
    assert back.space == "ras"
