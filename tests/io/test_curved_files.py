"""Curved mid-edge nodes in the files of each format, as independent readers have them, and on
their way back.
"""

import xml.etree.ElementTree as ElementTree

import meshio
import numpy as np
import pytest
import pyvista
from meshes import with_bent_edges
from models import quadratic_model
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt import load_mesh, save_model
from tetopt.geometry.quadratic import cell_edges, quadratic
from tetopt.model.model import Model


def curved_model(n=3):
    model = quadratic_model(n)
    return model._replace(mesh=with_bent_edges(model.mesh, 0.05))


def febio(path):
    """Nodes and elements of FEBio's file, from 0."""
    root = ElementTree.parse(path)
    nodes = {
        int(node.get("id")): [float(x) for x in node.text.split(",")]
        for node in root.iter("node")
        if node.text
    }
    cells = [[int(k) for k in each.text.split(",")] for each in root.findall(".//Elements/elem")]
    places = {number: k for k, number in enumerate(nodes)}
    return np.array(list(nodes.values())), np.array([[places[k] for k in cell] for cell in cells])


def read(path, n):
    if path.suffix == ".feb":
        return febio(path)
    if path.suffix in (".vtu", ".vtk"):
        grid = pyvista.read(path)
        return np.asarray(grid.points)[:, :n], next(iter(grid.cells_dict.values()))
    other = meshio.read(path)
    name = {3: "tetra10", 2: "triangle6"}[n]
    return other.points[:, :n], other.cells_dict[name]


@pytest.mark.parametrize("n", [3, 2])
@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".xdmf", ".inp", ".feb"])
def test_others_read_the_curved_nodes(suffix, n, tmp_path):
    """Each cell has its own mid-edge nodes between its corners, whatever the order of nodes in
    the format.
    """
    if n == 2 and suffix in (".inp", ".feb"):
        pytest.skip("3-D only")
    model = curved_model(n)
    path = tmp_path / f"model{suffix}"
    save_model(path, model)
    points, cells = read(path, n)
    nodes, ours = quadratic(model.mesh.points, model.mesh.cells, model.mesh.midpoints)
    assert (
        np.abs(
            model.mesh.midpoints
            - quadratic(model.mesh.points, model.mesh.cells)[0][len(model.mesh.points) :]
        ).max()
        > 0.1
    )
    theirs = points[cells]
    if suffix in (".vtu", ".vtk"):
        theirs = theirs[:, : ours.shape[1]]
    order = np.lexsort(theirs[:, : n + 1].mean(axis=1).T)
    own = np.lexsort(nodes[ours][:, : n + 1].mean(axis=1).T)
    assert_allclose(theirs[order], nodes[ours][own], rtol=1e-6, atol=1e-6)


def test_mfem_and_medit_have_them_too(tmp_path):
    model = curved_model()
    wanted = {tuple(row) for row in np.round(model.mesh.midpoints, 6).tolist()}
    for suffix in (".mfem", ".mesh"):
        path = tmp_path / f"model{suffix}"
        save_model(path, model)
        found = set()
        for line in path.read_text().splitlines():
            try:
                numbers = [float(word) for word in line.split()]
            except ValueError:
                continue
            if len(numbers) >= 3:
                found.add(tuple(np.round(numbers[:3], 6).tolist()))
        assert wanted <= found


@pytest.mark.parametrize("n", [3, 2])
@pytest.mark.parametrize("suffix", [".vtu", ".msh"])
def test_they_come_back_and_go_on(suffix, n, tmp_path):
    model = curved_model(n)
    save_model(tmp_path / f"a{suffix}", model)
    back = load_mesh(tmp_path / f"a{suffix}")
    assert_allclose(back.mesh.midpoints, model.mesh.midpoints, rtol=1e-14, atol=1e-13)
    assert any("edges are curved by up to" in note for note in back.notes)
    assert tetopt.build_model(back).order == 2
    tetopt.save_mesh(tmp_path / "b.vtu", back.mesh, order=2)
    assert_array_equal(load_mesh(tmp_path / "b.vtu").mesh.midpoints, back.mesh.midpoints)


def test_turned_to_lps_and_back(tmp_path):
    model = curved_model()
    save_model(tmp_path / "a.vtu", model, space="lps")
    turned = np.asarray(pyvista.read(tmp_path / "a.vtu").points)[len(model.mesh.points) :]
    assert_array_equal(turned, model.mesh.midpoints * (-1.0, -1.0, 1.0))
    assert_array_equal(load_mesh(tmp_path / "a.vtu").mesh.midpoints, model.mesh.midpoints)


def test_cells_turned_by_the_reader_keep_their_midpoints(tmp_path):
    """A file whose cells are inverted: the same edges, the same nodes on them."""
    mesh = with_bent_edges(quadratic_model().mesh, 0.05)
    nodes, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    inverted = cells[:, [1, 0, 2, 3, 4, 6, 5, 8, 7, 9]]
    pyvista.UnstructuredGrid({24: inverted}, nodes).save(tmp_path / "a.vtu")
    back = load_mesh(tmp_path / "a.vtu")
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
    model = curved_model()
    linear = Model(model.mesh, {}, model.sets)
    assert len(linear.to_pyvista().points) == len(model.mesh.points)
    assert len(linear._replace(order=2).to_meshio().points) == len(model.mesh.points) + len(
        model.mesh.midpoints
    )
