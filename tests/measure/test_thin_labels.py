"""Thickness, layers and contact of labels: shells and slabs of known size, sums taken one by
one.
"""

from collections import defaultdict
from itertools import combinations

import numba
import numpy as np
import pytest
import pyvista
from label_rows import label_row
from meshes import both_dimensions
from shapes import OBLIQUE

import tetopt
from tetopt.contents.thickness import local_thickness
from tetopt.geometry.simplex import volumes
from tetopt.measure.fidelity import Thickness, label_fidelity
from tetopt.measure.thin import (
    LabelContact,
    contact_totals,
    label_contacts,
    label_thickness,
)
from tetopt.report.tables import contact_table, contacts_in_words, thin_table


def blocky(labels, affine=None):
    """An image of labels, a mesh with a block of cells in each voxel, and the label of each
    cell.
    """
    image = tetopt.Image(np.asarray(labels, dtype=float), affine)
    mesh = tetopt.lattice_mesh(
        image, "criss-cross" if image.ndim == 2 else "five-tet", blocks=image.shape
    )
    return image, mesh, tetopt.cell_labels(image, mesh)


def slabs(size, n=3):
    """Label 2 between 1 and 3, so many voxels thick, across the first axis."""
    labels = np.ones((20,) + (14,) * (n - 1))
    labels[8:], labels[8 + size :] = 2, 3
    return labels


@pytest.mark.parametrize(
    ("affine", "shape", "stairs"), [(OBLIQUE, (5, 4, 6), 2 / 3), (None, (7, 6), np.pi / 4)]
)
def test_facets_between_blocks_are_the_faces_between_voxels(affine, shape, stairs):
    """Which smooth surfaces have less of, by a factor that is known in the mean over directions."""
    image, mesh, of_cell = blocky(np.random.default_rng(3).integers(0, 4, shape), affine)
    contacts = label_contacts(image, mesh, of_cell)
    assert [each.labels for each in contacts] == list(combinations(range(4), 2))
    if affine is None or np.allclose(
        affine[:-1, :-1].T @ affine[:-1, :-1], np.diag(image.spacing**2)
    ):
        np.testing.assert_allclose([each.ratio for each in contacts], 1.0 / stairs)
    area = defaultdict(float)
    for axis in range(image.ndim):
        along = np.moveaxis(image.data, axis, 0)
        for pair in zip(along[:-1].ravel(), along[1:].ravel(), strict=True):
            area[tuple(sorted(pair))] += stairs * np.prod(image.spacing) / image.spacing[axis]
    np.testing.assert_allclose(
        [each.voxels_mm2 for each in contacts], [area[each.labels] for each in contacts]
    )


def test_contact_that_the_voxels_do_not_have():
    """A layer that a mesh tears is between two labels in the voxels, and a hole in the layer's
    contact with each.
    """
    image, mesh, of_cell = blocky(slabs(1))
    x = mesh.points[mesh.cells].mean(axis=1)
    hole = (of_cell == 2) & (np.abs(x[:, 1:] - 7.0) < 2.0).all(axis=1)
    torn = of_cell.copy()
    torn[hole] = 1
    contacts = {each.labels: each for each in label_contacts(image, mesh, torn)}
    assert contacts[1, 3].voxels_mm2 == 0.0
    assert np.isnan(contacts[1, 3].ratio)
    assert contacts[1, 3].mesh_mm2 == pytest.approx(16.0)
    assert contacts[2, 3].mesh_mm2 == pytest.approx(14.0**2 - 16.0)
    assert contact_totals(list(contacts.values())) == pytest.approx(
        {
            "false_mm2": 16.0,
            "excess_mm2": 16.0 + contacts[1, 2].mesh_mm2 + 180.0 - 1.2 * 14.0**2 * 4.0 / 3.0,
        }
    )


def test_only_voxels_in_the_mask_touch():
    labels = slabs(3)
    mask = tetopt.Image(np.indices(labels.shape)[0] < 11)
    image, mesh, of_cell = blocky(labels)
    assert [
        each.labels for each in label_contacts(image, mesh, of_cell, mask) if each.voxels_mm2
    ] == [(1, 2)]
    with pytest.raises(tetopt.InputError, match=r"mask: expected the labels' shape"):
        label_contacts(image, mesh, of_cell, tetopt.Image(np.ones((3, 3, 3))))


@both_dimensions
def test_layers_are_cells_without_an_inner_node(n):
    image, mesh, of_cell = blocky(slabs(1, n))
    # 2-D: centres
    assert label_fidelity(image, mesh, of_cell)[1].extent.one_layer_fraction == (
        1.0 if n == 3 else 0.0
    )
    image, mesh, of_cell = blocky(slabs(4, n)[5:15, :5])
    rows = {row.label: row for row in label_fidelity(image, mesh, of_cell)}
    beside = defaultdict(list)
    for nodes, label in zip(mesh.cells.tolist(), of_cell, strict=True):
        for facet in combinations(sorted(nodes), n):
            beside[facet].append(label)
    size = volumes(mesh.points, mesh.cells)
    for label in (1, 2, 3):
        on = {i for facet, labels in beside.items() if labels.count(label) == 1 for i in facet}
        own = [cell for cell in range(len(mesh.cells)) if of_cell[cell] == label]
        part = sum(size[cell] for cell in own if set(mesh.cells[cell]) <= on)
        assert rows[label].extent.one_layer_fraction == pytest.approx(
            part / sum(size[cell] for cell in own)
        )
        assert (part > 0.0) == (n == 3)


@pytest.mark.parametrize("size", [0.6, 1.5, 2.0, 3.0, 5.0])
@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.5, 0.9, 1.1)])
def test_a_shell_between_facets_is_as_thick_as_it_is(size, spacing, monkeypatch):
    """Also one thinner than a voxel, where a voxel's centre is in it at all."""
    spacing = np.array(spacing)
    centre, shape = np.full(3, 21.3), np.ceil(44.0 / spacing).astype(int)
    place = np.moveaxis(np.indices(shape), 0, -1) * spacing - centre
    r = np.linalg.norm(place, axis=-1)
    balls = [
        pyvista.Sphere(radius=radius, theta_resolution=90, phi_resolution=90)
        for radius in (14.0, 14.0 + size)
    ]
    corners = np.concatenate([b.points[b.regular_faces].astype(float) for b in balls]) + centre
    rows = np.where(r > 14.0 + size, 0, np.where(r > 14.0, 1, 2))
    whole = local_thickness(rows, corners, spacing, 10.0)
    thickness = whole[rows == 1]
    assert np.median(thickness) == pytest.approx(size, rel=0.005)
    assert np.percentile(thickness, 95) < 1.1 * size
    monkeypatch.setattr(numba, "get_num_threads", lambda: 3)
    np.testing.assert_array_equal(local_thickness(rows, corners, spacing, 10.0), whole)


@both_dimensions
@pytest.mark.parametrize("size", [2, 3, 5])
def test_voxels_and_cells_of_the_same_surfaces_are_as_thick(n, size):
    image, mesh, of_cell = blocky(slabs(size, n))
    voxels, cells, *_ = label_thickness(tetopt.content(image, image), mesh, of_cell)[2]
    assert cells == pytest.approx((size, size, size, 10.0), abs=1e-4)
    assert voxels == pytest.approx(cells, rel=0.03)


def test_edges_are_those_of_the_labels_own_cells():
    image, mesh, of_cell = blocky(slabs(3, 3))
    row = label_thickness(tetopt.content(image, image), mesh, of_cell)[2]
    # each voxel's centre is in the middle one of its five cells
    assert row.edge == pytest.approx(np.sqrt(2.0))
    assert row.cells_across == pytest.approx(row.of_voxels.p50 / row.edge, rel=1e-6)


def test_only_voxels_of_the_cells_label_count_as_its_layers():
    """Cells of label 2 also hold five layers of voxels of label 1, which is 8 mm thick."""
    image, mesh, of_cell = blocky(slabs(3, 3))
    wide = np.where(
        mesh.points[mesh.cells].mean(axis=1)[:, 0] > 2.5, np.maximum(of_cell, 2), of_cell
    )
    row = label_thickness(tetopt.content(image, image), mesh, wide)[2]
    assert row.cells_across == pytest.approx(3.0 / np.sqrt(2.0), rel=0.03)


def test_percentiles_are_over_the_voxels():
    x, y = np.indices((20, 20))
    size = np.choose(np.searchsorted([6, 16], y, side="right"), [2, 4, 6])
    image, mesh, of_cell = blocky(np.where((x >= 6) & (x < 6 + size), 2, 1))
    row = label_thickness(tetopt.content(image, image), mesh, of_cell)[2]
    for each in (row.of_voxels, row.of_cells):
        assert each == pytest.approx((2.0, 4.0, 6.0, 10.0), abs=0.5)


def test_a_label_that_is_in_one_of_them_alone():
    image, mesh, of_cell = blocky(slabs(1))
    found = label_thickness(tetopt.content(image, image), mesh, np.where(of_cell == 2, 7, of_cell))
    assert (found[2].of_cells, found[7].of_voxels) == (None, None)
    assert found[7].of_cells.p50 == pytest.approx(1.0, abs=1e-4)
    with pytest.raises(tetopt.InputError, match="expected labels with smooth interfaces, got none"):
        label_thickness(tetopt.content(image), mesh, of_cell)


@pytest.mark.full
def test_a_mesh_of_nested_shells_is_as_thick_as_its_voxels():
    r = np.linalg.norm(np.indices((36,) * 3) - 17.6, axis=0)
    labels = tetopt.Image(np.searchsorted([7.0, 10.0, 14.0], r).astype(float))
    what = tetopt.content(labels, labels)
    result = tetopt.mesh_image(what, 4000, iterations=8)
    found = label_thickness(what, result.mesh, result.labels)
    for label, size in ((1, 3.0), (2, 4.0)):
        voxels, cells, *_ = found[label]
        assert (voxels.p50, cells.p50) == pytest.approx((size,) * 2, rel=0.045)
        assert cells == pytest.approx(voxels, rel=0.06)
    (shell,) = [
        each for each in label_contacts(labels, result.mesh, result.labels) if each.labels == (1, 2)
    ]
    assert shell.mesh_mm2 == pytest.approx(4.0 * np.pi * 10.0**2, rel=0.035)
    assert shell.ratio == pytest.approx(1.0, abs=0.05)


def texts(table):
    """Cells of a table, row by row."""
    return list(zip(*(list(column.cells) for column in table.columns), strict=True))


def labels_of(table):
    return [int(row[0].split()[0]) for row in texts(table)]


def test_a_thin_table_has_the_worst_five_alone():
    """Neither the background nor what is two cells across, or as thick as is looked for."""

    def row_of(label, fraction, thickness=(1.0, 2.0, 3.0, 3.0), **numbers):
        numbers |= {"one_layer_fraction": fraction, "thickness_voxels": Thickness(*thickness)}
        return label_row(label, n_cells=9, **numbers)

    fractions = np.random.default_rng(2).permutation(41) / 41.0
    rows = [row_of(label, fraction) for label, fraction in enumerate(fractions, start=1)]
    names, worst = {1: "bone [l]"}, 1 + np.argsort(-fractions)[:5]
    table = thin_table(rows, names)
    assert labels_of(table) == worst.tolist()
    shown = (f"{100 * fractions.max():.1f}", "2.00 (1.00 to >= 3.00)", "-", "-", "-")
    assert texts(table)[0][1:] == shown
    across, thick = row_of(1, 1.0, cells_across=2.0), row_of(1, 1.0, (1.0, 3.0, 3.0, 3.0))
    for row in (row_of(0, 1.0), across, thick):
        assert texts(thin_table([row, *rows], names)) == texts(table)
    assert thin_table([across], {}) is thin_table([thick], {}) is None
    alike = [row_of(label, 1.0, (0.0, label % 7, 9.0)) for label in range(1, 42)]
    assert labels_of(thin_table(alike, {})) == [7, 14, 21, 28, 35]


def test_a_contact_table_has_the_worst_five_alone():
    contacts = [LabelContact((1, k), 100.0 + k, 50.0 + k, 2.0) for k in range(2, 42)]
    contacts += [LabelContact((2, 3), 90.0, 0.0, np.nan), LabelContact((2, 4), 149.0, 100.0, 1.49)]
    shown = texts(contact_table(contacts, {3: "fluid"}, 2))
    assert shown[0] == ("2, 3 fluid", "90.0", "0.0", "false")
    assert [row[0] for row in shown[1:]] == ["1, 2", "1, 3 fluid", "1, 4", "1, 5"]
    assert contact_table(contacts[-1:], {}, 3) is None
    more = [LabelContact((7, 8), 25.0, 1.0, 25.0), LabelContact((7, 9), 40.0, 10.0, 4.0)]
    pairs = [row[0] for row in texts(contact_table([*contacts, *more], {}, 2))]
    assert pairs == ["2, 3", "1, 2", "1, 3", "1, 4", "7, 9"]
    assert texts(contact_table(more, {}, 2))[0][0] == "7, 9"
    words = contacts_in_words(contact_totals(contacts[-2:]), 2)
    assert "1.2 times that of the voxels: 119.0 mm, including 90.0 mm between labels" in words
