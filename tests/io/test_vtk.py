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

from tetopt.errors import InputError
from tetopt.geometry.quadratic import quadratic, quadratic_facet_nodes
from tetopt.io.formats import save_model
from tetopt.io.meshes import load_mesh
from tetopt.io.vtk import model_grid, vtu
from tetopt.model.sets import nodes_of


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_other_readers_see_the_file_s_own_space_and_units(tmp_path, suffix):
    model, path = sample_model(3), tmp_path / f"a.{suffix}"
    save_model(path, model, space="lps", units="MPa")
    for points, young in (
        (pyvista.read(path).points, pyvista.read(path).cell_data["young"]),
        (meshio.read(path).points, meshio.read(path).cell_data["young"][0]),
    ):
        assert_array_equal(points, model.mesh.points * [-1, -1, 1])
        assert_allclose(young, young_of(model) / 1000.0, rtol=1e-15)
    grid = pyvista.read(path)
    for name, rows in model.sets.facets.items():
        assert_array_equal(
            np.flatnonzero(grid.point_data[f"on_{name}"]), nodes_of(model.mesh, rows)
        )


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
@pytest.mark.parametrize("n", [2, 3])
def test_other_readers_see_quadratic_cells(tmp_path, n, suffix):
    """VTK finds a quadratic field exactly in the middle of cells, so that nodes and edges go
    together; sets have their middle nodes, too.
    """
    model, path = quadratic_model(n), tmp_path / f"a.{suffix}"
    nodes, cells = quadratic(model.mesh.points, model.mesh.cells)
    middle = nodes.mean(axis=0)
    field = ((nodes - middle) ** 2).sum(axis=1)
    save_model(path, model._replace(point_data={"square": field}))
    other, grid = meshio.read(path), pyvista.read(path)
    for name, rows in model.sets.facets.items():
        on_set = np.unique(quadratic_facet_nodes(cells, rows))
        assert_array_equal(np.flatnonzero(grid.point_data[f"on_{name}"]), on_set)
        assert_array_equal(np.flatnonzero(other.point_data[f"on_{name}"]), on_set)
    centres = model.mesh.points[model.mesh.cells].mean(axis=1)
    expected = ((centres - middle) ** 2).sum(axis=1)
    places = pyvista.PolyData(np.column_stack([centres, np.zeros((len(centres), 3 - n))]))
    # VTK looks for a place in a cell by iteration. Were two edges exchanged, values would be off by
    # 1.
    assert_allclose(places.sample(grid)["square"], expected, rtol=0, atol=0.01)


def test_point_data_of_another_length_is_refused():
    model = quadratic_model(3)
    for values in (np.ones(5), np.ones(len(model.point_data["displacement"]) + 1)):
        with pytest.raises(
            InputError,
            match=r"^point data: expected one row per corner node \(\d+\) or per node \(\d+\)",
        ):
            vtu(model._replace(point_data={"odd": values}))


def test_results_are_turned_and_scaled_with_the_file(tmp_path):
    """In LPS and MPa for whoever reads the file, and back in RAS and kPa for us; also of a
    second step.
    """
    rng, model = np.random.default_rng(5), sample_model(3)
    tensor = rng.normal(size=(len(model.mesh.cells), 3, 3))
    cell_data = {
        "stress": tensor.reshape(-1, 9),
        "strain_step2": tensor.reshape(-1, 9),
        "von_mises": tensor[:, 0, 0],
    }
    point_data = {
        "displacement_step2": model.mesh.points + 1.0,
        "stress_nodes": np.ones((len(model.mesh.points), 9)),
    }
    model = model._replace(cell_data=cell_data, point_data=point_data, materials=None)
    save_model(tmp_path / "a.vtu", model, space="lps", units="MPa")
    grid, turn = pyvista.read(tmp_path / "a.vtu"), np.diag([-1.0, -1.0, 1.0])
    there = turn @ tensor @ turn.T
    assert_allclose(grid.cell_data["stress"], there.reshape(-1, 9) / 1000.0, rtol=1e-14)
    assert_allclose(grid.cell_data["strain_step2"], there.reshape(-1, 9), rtol=1e-14)
    assert_allclose(grid.cell_data["von_mises"], tensor[:, 0, 0] / 1000.0, rtol=1e-14)
    assert_allclose(
        grid.point_data["displacement_step2"], (model.mesh.points + 1.0) @ turn, rtol=1e-14
    )
    back = load_mesh(tmp_path / "a.vtu")
    for fields, expected in ((back.cell_data, cell_data), (back.point_data, point_data)):
        assert set(fields) == set(expected)
        for name, values in expected.items():
            assert_allclose(fields[name], values, rtol=1e-14, err_msg=name)


def test_stresses_of_an_unknown_unit_are_left_out(tmp_path):
    model = quadratic_model(3)
    ones = np.ones(len(model.mesh.points))
    grid = pyvista.wrap(
        model_grid(model._replace(point_data={"von_mises_nodes": ones, "kept": ones}))
    )
    grid.field_data["units"] = ["psi"]
    grid.save(tmp_path / "a.vtu")
    back = load_mesh(tmp_path / "a.vtu")
    assert list(back.point_data) == ["kept"]
    assert not {"young", "nu", "material"} & set(back.cell_data)
    assert back.notes == (
        'dropped moduli and stresses, as their unit is none of kPa, MPa, Pa: "psi"',
    )


def test_the_head_of_a_legacy_file_is_what_3d_slicer_looks_for(tmp_path):
    for space in ("ras", "lps"):
        save_model(tmp_path / "a.vtk", sample_model(3), space=space)
        lines = (tmp_path / "a.vtk").read_bytes().split(b"\n")[:3]
        assert lines == [
            b"# vtk DataFile Version 4.2",
            f"tetopt, mm, SPACE={space.upper()}".encode(),
            b"BINARY",
        ]


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_a_file_of_3d_slicer_s_in_lps_is_turned(tmp_path, suffix):
    """As its vtkMRMLModelStorageNode writes them: a word in the head, or a string among the
    field data.
    """
    model, path = sample_model(3), tmp_path / f"a.{suffix}"
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


def turned(grid):
    """Mirrored: a row (cell, k) means another facet once two nodes of its cell are exchanged."""
    grid.points[:, 0] *= -1.0
    return grid


def without_checksum(grid):
    del grid.field_data["cells_sha256"]
    return grid


def no_text(grid):
    grid.field_data["cells_sha256"] = np.array([1.5])
    return grid


CHANGES = {
    "turned": turned,
    "fewer": lambda grid: grid.threshold(20, scalars="mean"),
    "reordered": lambda grid: with_cells(grid, grid.cells_dict[10][::-1]),
    "no checksum": without_checksum,
    "no text": no_text,
}


def with_cells(grid, cells):
    """Other cells, all else as it was."""
    other = pyvista.UnstructuredGrid({10: cells}, grid.points)
    other.field_data.update({name: grid.field_data[name] for name in grid.field_data})
    return other


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
@pytest.mark.parametrize("change", CHANGES)
def test_sets_are_dropped_unless_the_cells_are_those_they_were_written_for(
    tmp_path, change, suffix
):
    save_model(tmp_path / f"a.{suffix}", sample_model(3))
    grid = CHANGES[change](pyvista.read(tmp_path / f"a.{suffix}"))
    assert "facets:left" in grid.field_data
    grid.save(tmp_path / f"b.{suffix}")
    back = load_mesh(tmp_path / f"b.{suffix}")
    assert back.sets == ({}, {})
    (note,) = back.notes
    assert note.startswith("dropped sets, as the cells may have changed")
    assert set(note.split(": ")[1].split(", ")) == {
        *sample_model(3).sets.facets,
        *sample_model(3).sets.cells,
    }


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
def test_sets_that_cannot_be_ours_are_dropped(tmp_path, name, values):
    save_model(tmp_path / "a.vtu", sample_model(3))
    grid = pyvista.read(tmp_path / "a.vtu")
    grid.field_data[name] = values
    grid.save(tmp_path / "b.vtu")
    back = load_mesh(tmp_path / "b.vtu")
    assert set(back.sets.cells) == set(sample_model(3).sets.cells)
    assert set(back.sets.facets) == set(sample_model(3).sets.facets)
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
    grid = sample_model(3).mesh.to_pyvista()
    grid.field_data["box"] = box
    grid.save(tmp_path / "a.vtu")
    assert load_mesh(tmp_path / "a.vtu").box is None


def test_the_box_of_ours_comes_back(tmp_path):
    save_model(tmp_path / "a.vtu", sample_model(3)._replace(about={"box": BOX}))
    box = load_mesh(tmp_path / "a.vtu").box
    assert box.shape == (9, 8, 7)
    assert_array_equal(box.affine, BOX["affine"])


def test_meshio_reads_a_legacy_file_of_data_that_came_from_a_vtu_file(tmp_path):
    """What VTK has read are "long long", which it writes as "vtktypeint64", unknown to meshio
    5.3.5.
    """
    big = {
        "big": np.array([2**40, -1] * len(sample_model(3).mesh.cells))[
            : len(sample_model(3).mesh.cells)
        ]
    }
    save_model(
        tmp_path / "a.vtu", sample_model(3)._replace(cell_data=sample_model(3).cell_data | big)
    )
    fields = load_mesh(tmp_path / "a.vtu").cell_data
    assert fields["n_voxels"].dtype == np.int64
    save_model(tmp_path / "b.vtk", sample_model(3)._replace(cell_data=fields, materials=None))
    assert b"vtktypeint64" not in (tmp_path / "b.vtk").read_bytes()
    other = meshio.read(tmp_path / "b.vtk")
    assert set(other.cell_data) == set(fields)
    for name, values in fields.items():
        assert_array_equal(other.cell_data[name][0].ravel(), values)
        kind = np.int32 if name in ("n_voxels", "label", "material") else np.float64
        assert other.cell_data[name][0].dtype.newbyteorder("=") == kind


@pytest.mark.parametrize("values", [np.array([1.5]), np.empty(0)])
def test_a_space_that_is_no_text_is_not_looked_at(tmp_path, values):
    grid = sample_model(3).mesh.to_pyvista()
    grid.field_data["space"] = values
    grid.save(tmp_path / "a.vtu")
    assert load_mesh(tmp_path / "a.vtu").space == "ras"
