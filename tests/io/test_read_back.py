"""What tetopt writes, in every format that it reads: nodes, cells, labels, sets, fields equal."""

from pathlib import Path

import numpy as np
import pytest
from models import (
    curved_model,
    labelled_model,
    quadratic_model,
    sample_model,
    unlabelled,
)
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from tetopt import load_mesh
from tetopt.io.formats import FORMATS, save_model
from tetopt.io.meshes import MESH_SUFFIXES

MODELS = {
    "labels and materials": sample_model,
    "many materials": lambda n=3: sample_model(n, None),
    "no labels": lambda n=3: unlabelled(sample_model(n)),
    "named labels": labelled_model,
    "order 2": quadratic_model,
    "curved": curved_model,
}
WITH_FIELDS = (".vtk", ".xdmf", ".msh")
OTHERS = [suffix for suffix in MESH_SUFFIXES if suffix != ".vtu"]


def dense(model):
    """The model with a density for each material."""
    table = model.materials
    density = None if table is None else 1000.0 + 10.0 * np.arange(len(table.young))
    return model if table is None else model._replace(materials=table._replace(density=density))


def is_writable(model, suffix, n):
    if n == 2 and suffix in (".inp", ".feb"):
        return False
    return model.materials is not None or suffix != ".feb"


def assert_equal_files(path, whole, model):
    """The file of a suffix and the .vtu file hold the same."""
    one, other = load_mesh(path), load_mesh(whole)
    assert_allclose(one.mesh.points, other.mesh.points, rtol=1e-13, atol=1e-13)
    assert_array_equal(one.mesh.cells, other.mesh.cells)
    assert (one.space, one.order) == (other.space, other.order)
    assert (one.mesh.midpoints is None) == (other.mesh.midpoints is None)
    if one.mesh.midpoints is not None:
        assert_allclose(one.mesh.midpoints, other.mesh.midpoints, rtol=1e-13, atol=1e-13)
    assert one.n_turned == 0
    assert (one.labels is None) == (other.labels is None)
    if one.labels is not None:
        assert_array_equal(one.labels, other.labels)
        names = {label: name.replace(" ", "_") for label, name in other.label_table.names.items()}
        mine = {label: name.replace(" ", "_") for label, name in one.label_table.names.items()}
        assert {k: mine.get(k) for k in names} == names
    for mine, theirs in zip(one.sets, other.sets, strict=True):
        assert mine.keys() >= theirs.keys()
        assert all(name.startswith("label_") for name in mine.keys() - theirs.keys())
        for name, rows in theirs.items():
            assert_array_equal(mine[name], rows)
    if model.materials is not None and path.suffix != ".msh2":
        names = ("young", "nu") if path.suffix == ".msh" else ("young", "nu", "density")
        for name in names:
            assert_allclose(one.cell_data[name], other.cell_data[name], rtol=1e-12)
    if path.suffix in WITH_FIELDS:
        names = {name for name, rows in model.cell_data.items() if rows.ndim == 1}
        for name in names:
            assert_allclose(one.cell_data[name], other.cell_data[name], rtol=1e-12)
        for name, rows in other.point_data.items():
            rows = rows.reshape(len(rows), -1)
            columns = [f"{name}_{k}" for k in range(rows.shape[1])]  # where no vectors fit
            mine = [one.point_data[each] for each in columns if each in one.point_data]
            mine = np.column_stack(mine or [one.point_data[name]])
            assert_allclose(mine[:, : rows.shape[1]], rows)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("suffix", OTHERS)
def test_every_format_is_read_back(suffix, n, name, here):
    model = dense(MODELS[name](n))
    if not is_writable(model, suffix, n):
        pytest.skip("the format does not support the model")
    kinds = [("ras", "kPa"), ("lps", "Pa")] if n == 3 else [("ras", "MPa")]
    for space, units in kinds:
        for path in (f"a{suffix}", "a.vtu"):
            save_model(path, model, space=space, units=units)
        assert_equal_files(Path(f"a{suffix}"), Path("a.vtu"), model)


def test_every_format_is_read_or_refused(here):
    assert {*MESH_SUFFIXES, ".mfem"} == {*FORMATS}
    for name in ("a.mfem", "a.stl", "a.ply"):
        Path(name).write_text("x")
        with refusal("ParaView"):
            load_mesh(name)
