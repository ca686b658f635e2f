"""The mesh in scikit-fem: the same nodes, cells and sets, and the side of every facet."""

import sys

import numpy as np
import pytest
from models import sample_model, with_two_sides
from refusals import refusal

from tetopt.geometry.topology import facets
from tetopt.model.model import in_space
from tetopt.model.sets import Sets, area_vectors, facet_triples

skfem = pytest.importorskip("skfem", reason="no scikit-fem (pip install scikit-fem)")


MODELS = {
    "3-D": lambda: with_two_sides(sample_model()),
    "2-D": lambda: with_two_sides(sample_model(2)),
    "LPS": lambda: in_space(with_two_sides(sample_model()), "lps"),
}


@pytest.fixture(params=list(MODELS))
def model(request):
    return MODELS[request.param]()


def test_nodes_and_cells_are_the_same_in_the_same_order(model):
    mesh = model.to_skfem()
    assert isinstance(mesh, skfem.MeshTet if model.mesh.ndim == 3 else skfem.MeshTri)
    assert np.array_equal(mesh.p.T, model.mesh.points)
    cells = model.mesh.cells if model.mesh.ndim == 3 else np.sort(model.mesh.cells, axis=1)
    assert np.array_equal(mesh.t.T, cells)


def test_sets_are_boundaries_and_subdomains_of_their_names(model):
    mesh = model.to_skfem()
    assert list(mesh.boundaries) == list(model.sets.facets)
    for name, rows in model.sets.facets.items():
        nodes = mesh.facets[:, mesh.boundaries[name]].T
        assert np.array_equal(
            np.sort(nodes, axis=1), np.sort(facet_triples(model.mesh.cells, rows), axis=1)
        ), name
    assert list(mesh.subdomains) == list(model.sets.cells)
    for name, cells in model.sets.cells.items():
        assert np.array_equal(mesh.subdomains[name], cells), name


def test_a_facet_between_two_cells_is_held_by_the_sets_own(model):
    mesh = model.to_skfem()
    shared = facets(model.mesh.cells)
    element = skfem.ElementTetP1() if model.mesh.ndim == 3 else skfem.ElementTriP1()
    for name, rows in model.sets.facets.items():
        is_inner = shared.n_cells[shared.of_cell[rows[:, 0], rows[:, 1]]] == 2
        side = getattr(mesh.boundaries[name], "ori", np.zeros(len(rows), dtype=int))
        assert hasattr(mesh.boundaries[name], "ori") == is_inner.any()
        assert np.array_equal(mesh.f2t[side, mesh.boundaries[name]], rows[:, 0]), name
        normals = skfem.FacetBasis(mesh, element, facets=name).normals[:, :, 0].T
        areas = area_vectors(model.mesh, rows)
        outward = areas / np.linalg.norm(areas, axis=1, keepdims=True)
        assert np.abs(normals - outward).max() < 1e-12, name
    there, back = (mesh.boundaries[name] for name in ("interface_0_1", "bright"))
    assert set(there) <= set(back)
    assert (np.unique(there.ori) == [0, 1]).all()  # or else the sides were never asked for


def test_a_model_without_sets_has_none():
    model = sample_model()
    mesh = model._replace(sets=Sets({}, {}), loads=()).to_skfem()
    assert not mesh.boundaries
    assert not mesh.subdomains


def test_what_cannot_be_had_is_said(monkeypatch):
    with refusal(r"^to_skfem: expected linear cells, got order 2; .*P2 elements in scikit-fem$"):
        sample_model()._replace(order=2).to_skfem()
    monkeypatch.setitem(sys.modules, "skfem", None)
    words = r'^to_skfem: scikit-fem is not installed; pip install "scikit-fem(>=[0-9.]+)?"$'
    with refusal(words):
        sample_model().to_skfem()


def test_nothing_is_shared_with_the_model():
    model = sample_model()
    before = model.sets.cells["label_0"].copy()
    converted = model.to_skfem()
    converted.subdomains["label_0"][:] = 7
    assert np.array_equal(model.sets.cells["label_0"], before)
