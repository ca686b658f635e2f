"""Mid-edge nodes on smooth levels: nearer to the true surface, no cell folded, nothing else
moved.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import tetopt
from tetopt import Image, load_phantom, mesh_image
from tetopt.engine.curving import LEAST_JACOBIAN, MOST_BENT, curve_mesh
from tetopt.fem.elasticity import gauss_volumes
from tetopt.geometry.quadratic import (
    curved_rule,
    jacobian_bounds,
    numbered_edges,
    quadratic,
    quadratic_facet_nodes,
    shape_values,
)
from tetopt.geometry.topology import facets
from tetopt.model.sets import boundary_rows, facet_triples

SPHERE_MM = 20.0


def straight(mesh):
    return tetopt.Mesh(mesh.points, mesh.cells)


def off_the_sphere(mesh, rows, radius=SPHERE_MM):
    """The mean distance of quadratic facets (K, 2) from a sphere (a circle) around the origin,
    mm.
    """
    nodes, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    places, weights = curved_rule(mesh.ndim - 1)
    on_facets = np.einsum(
        "qa,kai->kqi", shape_values(places, 2), nodes[quadratic_facet_nodes(cells, rows)]
    )
    return (np.abs(np.linalg.norm(on_facets, axis=2) - radius) @ weights).mean()


def interface(mesh, labels):
    """Facets (K, 2) of cells of label 1 towards others."""
    shared = facets(mesh.cells)
    pairs = shared.cells[shared.of_cell]
    own = np.arange(len(labels))[:, None]
    other = np.where(pairs[..., 0] == own, pairs[..., 1], pairs[..., 0])
    return np.argwhere((labels[:, None] == 1) & (other >= 0) & (labels[other] != 1))


def sphere_labels(voxel_mm):
    return load_phantom("sphere").label_image(voxel_mm=voxel_mm)


@pytest.fixture(scope="module")
def sphere():
    """A sphere of 20 mm as labels of 1 mm voxels in a box, of order 2; its result and content."""
    labels = sphere_labels(1)
    content = tetopt.content(labels, labels)
    return mesh_image(content, 3000, order=2), content


def rounder(mesh, rows):
    """How far quadratic facets are off the sphere (circle), over how far straight ones are."""
    return off_the_sphere(mesh, rows) / off_the_sphere(straight(mesh), rows)


def test_a_labelled_sphere_is_round(sphere):
    """Straight edges are 0.33 mm off in the mean and lose 5 % of the volume; curved ones 0.04
    mm, and win 0.1 %.
    """
    result, content = sphere
    mesh, labels, curving = result.mesh, result.labels, result.curving
    assert rounder(mesh, interface(mesh, labels)) < 0.2
    true = 4.0 / 3.0 * np.pi * SPHERE_MM**3
    size, flat = (gauss_volumes(each, 2)[labels == 1].sum() for each in (mesh, straight(mesh)))
    assert abs(size / true - 1.0) < 0.1 * abs(flat / true - 1.0)
    assert curving.n_edges == curving.n_on_level + curving.n_part_way + curving.n_straight
    assert curving.n_on_level > 0.9 * curving.n_edges
    assert curving.least_jacobian >= LEAST_JACOBIAN
    # The bound holds in all cells, and the box is as full as with straight edges.
    assert least_bound(mesh) == pytest.approx(curving.least_jacobian)
    assert gauss_volumes(mesh, 2).sum() == pytest.approx(content.image.volume, rel=1e-12)


def least_bound(mesh):
    return jacobian_bounds(*quadratic(mesh.points, mesh.cells, mesh.midpoints)).min()


def test_only_edges_on_the_interface_are_curved(sphere):
    mesh, labels, curving = sphere[0].mesh, sphere[0].labels, sphere[0].curving
    edges, number = numbered_edges(mesh.cells)
    ends = mesh.points[edges]
    off = np.linalg.norm(mesh.midpoints - ends.mean(axis=1), axis=1)
    is_between = np.isin(
        range(len(edges)), np.intersect1d(number[labels == 0], number[labels == 1])
    )
    assert is_between.sum() == curving.n_edges
    assert (off[~is_between] == 0.0).all()
    assert off.max() == pytest.approx(curving.farthest)
    assert (off <= MOST_BENT * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)).all()


def test_edges_of_cells_that_would_fold_go_part_of_the_way(sphere, monkeypatch):
    result, content = sphere
    monkeypatch.setattr("tetopt.engine.curving.LEAST_JACOBIAN", 0.8)
    mesh, curving = curve_mesh(straight(result.mesh), content, result.labels)
    assert curving.n_part_way > 50
    assert curving.n_straight >= result.curving.n_straight
    assert curving.n_on_level < result.curving.n_on_level
    assert min(curving.least_jacobian, least_bound(mesh)) >= 0.8


def test_edges_whose_ends_are_off_the_level_stay_straight(monkeypatch):
    """A lattice does not follow its labels: the level is near many edges, but they do not begin
    and end there.
    """
    labels = load_phantom("disc_2d").label_image(voxel_mm=2)
    content = tetopt.content(labels, labels)
    lattice = tetopt.lattice_mesh(labels, nodes=400)
    of_cell = tetopt.cell_labels(labels, lattice)
    mesh, curving = curve_mesh(lattice, content, of_cell)
    assert mesh is lattice
    assert curving == (curving.n_edges, 0, 0, curving.n_edges, 0.0, 1.0)
    monkeypatch.setattr("tetopt.engine.curving.ENDS_VOXELS", 99.0)
    assert curve_mesh(lattice, content, of_cell)[1].n_straight < 0.5 * curving.n_edges


def test_edges_on_a_side_of_a_sheared_box_stay_there():
    labels = sphere_labels(4)
    shear = np.eye(4)
    shear[0, 1] = 0.4
    half = Image(labels.data[8:], labels.affine @ shear)
    mesh = mesh_image(tetopt.content(half, half), 800, order=2, iterations=8).mesh
    ends = half.to_index(mesh.points)[numbered_edges(mesh.cells)[0]]
    on_side = (np.abs(ends[..., 0] + 0.5) < 1e-9).all(axis=1)
    middles, straight_ones = half.to_index(mesh.midpoints)[on_side], ends[on_side].mean(axis=1)
    assert (np.abs(middles - straight_ones) > 0.05).any(axis=1).sum() > 5
    assert_allclose(middles[:, 0], -0.5, atol=1e-12)


def test_a_mask_and_its_box():
    """Half of a sphere, a mask of fractions, cut off by the box: its surface is curved, its
    sides stay flat.
    """
    image = load_phantom("sphere").image(voxel_mm=2)
    affine = image.affine.copy()
    affine[:3, 3] = image.to_world([16, 0, 0])
    half = Image((image.data[16:] - 20.0) / 80.0, affine)
    result = mesh_image(tetopt.content(half, mask=half), 1500, order=2)
    mesh = result.mesh
    rows = boundary_rows(mesh)
    is_flat = (np.abs(mesh.points[facet_triples(mesh.cells, rows)][..., 0]) < 1e-6).all(axis=1)
    assert 20 < is_flat.sum() < 0.5 * len(rows)
    assert rounder(mesh, rows[~is_flat]) < 0.45
    ends = mesh.points[numbered_edges(mesh.cells)[0]]
    on_side = (np.abs(ends[..., 0]) < 1e-6).all(axis=1)
    assert_allclose(mesh.midpoints[on_side, 0], 0.0, atol=1e-9)
    rim = on_side & (np.linalg.norm(ends, axis=2) > 19.0).all(axis=1)
    assert rim.sum() > 10
    assert np.linalg.norm(mesh.midpoints[rim], axis=1) == pytest.approx(SPHERE_MM, abs=0.25)
    assert result.curving.n_on_level > 0.9 * result.curving.n_edges


def test_a_disc_in_the_plane():
    labels = load_phantom("disc_2d").label_image()
    result = mesh_image(tetopt.content(labels, labels), 300, order=2)
    assert result.curving.n_on_level == result.curving.n_edges > 10
    assert rounder(result.mesh, interface(result.mesh, result.labels)) < 0.3


def test_without_a_mask_and_labels_nothing_changes():
    """Nor with labels in order 1."""
    image, labels = load_phantom("sphere").image(voxel_mm=4), sphere_labels(4)
    for content, nodes, order in ((image, 1500, 2), (tetopt.content(labels, labels), 300, 1)):
        result = mesh_image(content, nodes, order=order, iterations=2)
        assert (result.mesh.midpoints, result.curving) == (None, None)
