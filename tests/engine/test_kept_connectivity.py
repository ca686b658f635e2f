"""With `keep_connectivity` nodes move, and cells and labels stay: boundary and interfaces follow
those of another image.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import tetopt
from tetopt import Image, InputError, content, mask_fidelity, mesh_image, optimize, quality

SHAPE = (20, 20, 20)
INDEX = np.moveaxis(np.indices(SHAPE), 0, -1).astype(float)


def ball(centre, radii):
    return Image(1.0 * ((((INDEX - centre) / radii) ** 2).sum(axis=-1) <= 1.0))


def halves(height):
    """Labels 1 below a tilted plane and 3 above it."""
    return Image(1.0 + 2.0 * (INDEX @ [0.2, 0.1, 1.0] > height))


HERE, THERE = ball([9.5] * 3, [7.0] * 3), ball([10.5, 9.0, 9.5], [8.0, 6.2, 7.0])
IMAGE = Image(INDEX.sum(axis=-1) % 5)


def least_dice(labels, mesh, of_cell):
    """Of the labels within `THERE`, by the voxels in their cells."""
    owner = tetopt.cell_of_voxel(IMAGE, mesh)
    painted = np.where(owner >= 0, of_cell[owner], 0)
    true = labels.data * THERE.data
    pairs = [(painted == label, true == label) for label in (1, 3)]
    return min(2.0 * (one & other).sum() / (one.sum() + other.sum()) for one, other in pairs)


@pytest.fixture(scope="module")
def template():
    """The mesh of a ball, with two labels."""
    return mesh_image(content(IMAGE, halves(12.5), HERE), 400, iterations=6)


@pytest.mark.full
def test_the_boundary_follows_another_mask(template):
    target = content(IMAGE, mask=THERE)
    kept = mesh_image(target, start=template.mesh, keep_connectivity=True)
    assert_array_equal(kept.mesh.cells, template.mesh.cells)
    before, after = (mask_fidelity(THERE, each).dice for each in (template.mesh, kept.mesh))
    assert before < 0.88 < 0.95 < after
    assert quality(kept.mesh.points, kept.mesh.cells).min_dihedral >= 12.0
    assert kept.violated == {}


@pytest.mark.full
def test_interfaces_follow_other_labels_and_cells_keep_theirs(template):
    labels = halves(14.0)
    target = content(IMAGE, labels, THERE)
    options = {"keep_connectivity": True, "cell_labels": template.labels}
    kept = mesh_image(target, start=template.mesh, **options)
    assert_array_equal(kept.mesh.cells, template.mesh.cells)
    assert_array_equal(kept.labels, template.labels)
    before, after = (
        least_dice(labels, mesh, template.labels) for mesh in (template.mesh, kept.mesh)
    )
    assert before < 0.85 < 0.93 < after
    assert quality(kept.mesh.points, kept.mesh.cells).min_dihedral >= 12.0


def test_labels_that_the_image_lacks_stay_with_the_nodes_between_them(n):
    image = Image(np.arange(8.0**n).reshape((8,) * n) % 5)
    mesh = tetopt.lattice_mesh(image, nodes=200 if n == 3 else 60)
    labels = (mesh.points[mesh.cells].mean(axis=1)[:, 0] > 3.5).astype(int)
    kept = optimize(image, mesh, cell_labels=labels, keep_connectivity=True, iterations=3)
    assert_array_equal(kept.mesh.cells, mesh.cells)
    assert_array_equal(kept.labels, labels)
    is_shared = np.isin(np.arange(len(mesh.points)), mesh.cells[labels == 0])
    is_shared &= np.isin(np.arange(len(mesh.points)), mesh.cells[labels == 1])
    is_same = (kept.mesh.points == mesh.points).all(axis=1)
    assert is_same[is_shared].all()
    assert not is_same.all()


def test_cells_that_were_flat_are_lifted_by_their_nodes_alone():
    image = Image(np.zeros((8, 8, 8)))
    mesh = tetopt.lattice_mesh(image, nodes=300)
    points = mesh.points.copy()
    inner = np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1))
    star = mesh.cells[(mesh.cells == inner).any(axis=1)]
    points[inner] += 0.95 * (points[star[0][star[0] != inner]].mean(axis=0) - points[inner])
    flat = tetopt.Mesh(points, mesh.cells)
    assert quality(flat.points, flat.cells).min_dihedral < 12.0
    kept = optimize(image, flat, keep_connectivity=True, iterations=2, k_D=0.0)
    assert_array_equal(kept.mesh.cells, mesh.cells)
    assert quality(kept.mesh.points, kept.mesh.cells).min_dihedral >= 12.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"nodes": 300}, "keep_connectivity: the nodes are those of the mesh"),
        ({}, "the image has labels, and the cells have none to keep"),
        (
            {"cell_labels": 7},
            r"the labels \[7\], which the image's labels lack: \[1, 3\]",
        ),
    ],
)
def test_what_cannot_be_kept_is_refused(options, words):
    mesh = tetopt.lattice_mesh(IMAGE, nodes=100)
    if "cell_labels" in options:
        options = {"cell_labels": np.full(len(mesh.cells), options["cell_labels"])}
    with pytest.raises(InputError, match=words):
        optimize(content(IMAGE, halves(12.5)), mesh, keep_connectivity=True, **options)
