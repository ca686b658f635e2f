"""Curved mid-edge nodes on their way back from files; `test_writers.py` has them in each format."""

import numpy as np
import pytest
import pyvista
from models import curved_model
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt import load_mesh, save_model
from tetopt.geometry.quadratic import cell_edges, quadratic
from tetopt.model.model import Model


@pytest.mark.parametrize("suffix", [".vtu", ".msh"])
def test_they_come_back_and_go_on(suffix, n, here):
    model = curved_model(n)
    save_model(f"a{suffix}", model)
    back = load_mesh(f"a{suffix}")
    assert_allclose(back.mesh.midpoints, model.mesh.midpoints, rtol=1e-14, atol=1e-13)
    assert any("edges are curved by up to" in note for note in back.notes)
    assert tetopt.build_model(back).order == 2
    tetopt.save_mesh("b.vtu", back.mesh, order=2)
    assert_array_equal(load_mesh("b.vtu").mesh.midpoints, back.mesh.midpoints)


def test_turned_to_lps_and_back(here):
    mesh = curved_model().mesh
    save_model("a.vtu", curved_model(), space="lps")
    turned = pyvista.read("a.vtu").points[len(mesh.points) :]
    assert_array_equal(turned, mesh.midpoints * (-1.0, -1.0, 1.0))
    assert_array_equal(load_mesh("a.vtu").mesh.midpoints, mesh.midpoints)


def test_cells_turned_by_the_reader_keep_their_midpoints(here):
    """A file whose cells are inverted: the same edges, the same nodes on them."""
    mesh = curved_model().mesh
    nodes, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    inverted = cells[:, [1, 0, 2, 3, 4, 6, 5, 8, 7, 9]]
    pyvista.UnstructuredGrid({24: inverted}, nodes).save("a.vtu")
    back = load_mesh("a.vtu")
    assert back.n_turned == len(cells)
    theirs, of_cells = quadratic(back.mesh.points, back.mesh.cells, back.mesh.midpoints)
    for local, (a, b) in enumerate(cell_edges(3), start=4):
        pairs = np.sort(back.mesh.cells[:, [a, b]], axis=1)
        for cell, pair in zip(of_cells[:20, local], pairs[:20], strict=True):
            which, place = np.argwhere(
                (np.sort(cells[:, :4][:, cell_edges(3)], axis=2) == pair).all(axis=2)
            )[0]
            assert_array_equal(theirs[cell], nodes[cells[which, 4 + place]])


def test_order_1_leaves_them_out():
    mesh = curved_model().mesh
    linear, n_corners = Model(mesh, {}, curved_model().sets), len(mesh.points)
    assert len(linear.to_pyvista().points) == n_corners
    assert len(linear._replace(order=2).to_meshio().points) == n_corners + len(mesh.midpoints)
