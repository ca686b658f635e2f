"""Models as VTK's files: every bit, set, material and text comes back, by our reader, pyvista and meshio."""

import json

import meshio
import numpy as np
import pytest
import pyvista
from models import ABOUT, sample_model

from tetopt.io.formats import save_model
from tetopt.io.meshes import load_mesh
from tetopt.model.sets import nodes_of


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
@pytest.mark.parametrize(("n", "space"), [(2, "ras"), (3, "ras"), (3, "lps")])  # a slice has a plane of its own
def test_every_bit_comes_back(tmp_path, suffix, space, n):
    model, path = sample_model(n), tmp_path / f"a.{suffix}"
    save_model(path, model, space=space)
    back = load_mesh(path)
    assert back.mesh.points.tobytes() == model.mesh.points.tobytes()
    np.testing.assert_array_equal(back.mesh.cells, model.mesh.cells)
    assert (back.n_turned, back.n_left, back.space) == (0, 0, space)
    for kind in (0, 1):
        assert set(back.sets[kind]) == set(model.sets[kind])
        for name, members in model.sets[kind].items():
            np.testing.assert_array_equal(back.sets[kind][name], members)
    made = model.materials
    expected = dict(model.cell_data) | {
        "young": made.young[made.of_cell], "nu": made.nu[made.of_cell], "material": made.of_cell + 1
    }  # fmt: skip
    assert set(back.cell_data) == set(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(back.cell_data[name], values)
    texts = {name: str(back.field_data[name][0]) for name in (*ABOUT, "units", "space", "loads")}
    loads = [
        [load.set_name, (load.displacement * ([-1, -1, 1] if space == "lps" else 1)).tolist()] for load in model.loads
    ]
    assert json.loads(texts.pop("loads")) == [[name, [x + 0.0 for x in vector]] for name, vector in loads]
    assert texts == ABOUT | {"units": "kPa", "space": space}


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_other_readers_see_the_file_s_own_space_and_units(tmp_path, suffix):
    model, path = sample_model(3), tmp_path / f"a.{suffix}"
    save_model(path, model, space="lps", units="MPa")
    for points, young in (
        (pyvista.read(path).points, pyvista.read(path).cell_data["young"]),
        (meshio.read(path).points, meshio.read(path).cell_data["young"][0]),
    ):
        np.testing.assert_array_equal(points, model.mesh.points * [-1, -1, 1])
        np.testing.assert_allclose(young, model.materials.young[model.materials.of_cell] / 1000.0, rtol=1e-15)
    grid = pyvista.read(path)
    for name, rows in model.sets.facets.items():
        np.testing.assert_array_equal(np.flatnonzero(grid.point_data[f"on_{name}"]), nodes_of(model.mesh, rows))


def test_the_head_of_a_legacy_file_is_what_3d_slicer_looks_for(tmp_path):
    for space in ("ras", "lps"):
        save_model(tmp_path / "a.vtk", sample_model(3), space=space)
        lines = (tmp_path / "a.vtk").read_bytes().split(b"\n")[:3]
        assert lines == [b"# vtk DataFile Version 4.2", f"tetopt, mm, SPACE={space.upper()}".encode(), b"BINARY"]


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_a_file_of_3d_slicer_s_in_lps_is_turned(tmp_path, suffix):
    """As its vtkMRMLModelStorageNode writes them: a word in the head, or a string among the field data."""
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
    np.testing.assert_allclose(back.mesh.points, model.mesh.points, rtol=1e-9)


def test_sets_of_a_file_whose_cells_had_to_be_turned_are_not_trusted(tmp_path):
    """A row (cell, k) means another facet once two nodes of its cell are exchanged."""
    save_model(tmp_path / "a.vtu", sample_model(3))
    grid = pyvista.read(tmp_path / "a.vtu")
    grid.points[:, 0] *= -1.0
    grid.save(tmp_path / "b.vtu")
    back = load_mesh(tmp_path / "b.vtu")
    assert back.n_turned == len(back.mesh.cells)
    assert back.sets.facets == {}
    assert set(back.sets.cells) == set(sample_model(3).sets.cells)


def test_without_materials_and_loads(tmp_path):
    save_model(tmp_path / "a.vtu", sample_model(3)._replace(materials=None, loads=()))
    back = load_mesh(tmp_path / "a.vtu")
    assert not {"young", "nu", "material"} & set(back.cell_data)
    assert not {"units", "loads"} & set(back.field_data)
