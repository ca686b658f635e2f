"""Fields of a mesh on an image's voxels, and an image moved by one, against closed forms."""

import numpy as np
from models import sample_image
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from scipy.spatial import Delaunay

import tetopt
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.simplex import orient_cells

MATRICES = {2: [[1.5, -0.4], [0.3, 1.1]], 3: [[1.5, -0.4, 0.1], [0.3, 1.1, -0.2], [0.0, 0.3, -0.9]]}


def oblique(n, shape=(9, 8, 7)):
    """An image with oblique, anisotropic voxels."""
    affine = np.eye(n + 1)
    affine[:-1, :-1], affine[:-1, -1] = MATRICES[n], 30.0
    return tetopt.Image(np.random.default_rng(3).uniform(0, 100, shape[:n]), affine)


def centres(image):
    return image.to_world(np.argwhere(np.ones(image.shape)))


def moved_mesh(image, n_nodes=60):
    """A mesh of most of an image's box, with interior nodes off the lattice."""
    mesh = tetopt.lattice_mesh(image, nodes=n_nodes)
    points = mesh.points.mean(axis=0) + 0.85 * (mesh.points - mesh.points.mean(axis=0))
    return tetopt.Mesh(points, mesh.cells)


def test_a_voxel_has_the_value_of_its_cell_to_the_last_bit(n):
    image = oblique(n)
    mesh = moved_mesh(image)
    owner, mean = tetopt.cell_of_voxel(image, mesh), tetopt.cell_moments(image, mesh).mean
    values = tetopt.field_on_image(mesh, mean, image)
    inside = owner >= 0
    assert 0.4 < inside.mean() < 1.0
    assert_array_equal(values[inside], mean[owner[inside]])
    assert np.isnan(values[~inside]).all()
    tensors = np.arange(9.0 * len(mean)).reshape(-1, 3, 3)
    stacked = tetopt.field_on_image(mesh, tensors, image, at="cells", outside=-1.0)
    assert stacked.shape == (*image.shape, 3, 3)
    assert_array_equal(stacked[inside], tensors[owner[inside]])
    assert (stacked[~inside] == -1.0).all()


def test_fields_of_nodes_are_exact_up_to_their_order(n):
    """A linear field of order 1, a quadratic one of order 2, at voxels of a finer grid, too."""
    image = oblique(n)
    mesh = moved_mesh(image)
    step = np.append(np.full(n, 0.5), 1.0)
    fine = tetopt.Image(np.zeros([2 * size for size in image.shape]), image.affine * step)
    for grid in (image, fine):
        places = centres(grid).reshape(*grid.shape, n)
        linear = tetopt.field_on_image(mesh, mesh.points, grid)
        inside = np.isfinite(linear[..., 0])
        assert_allclose(linear[inside], places[inside], rtol=0.0, atol=1e-12 * np.abs(places).max())
        nodes = quadratic(mesh.points, mesh.cells)[0]
        curved = tetopt.field_on_image(mesh, (nodes**2).sum(axis=1), grid)
        expected = (places**2).sum(axis=-1)
        assert_allclose(curved[inside], expected[inside], rtol=1e-12)


def test_curved_cells_are_isoparametric(n):
    """Their nodes' coordinates, as a field, give back the voxels' centres; a straight map would
    miss them.
    """
    image = oblique(n)
    straight = moved_mesh(image)
    nodes, n_corners = quadratic(straight.points, straight.cells)[0], len(straight.points)
    bent = nodes + 0.25 * np.sin(nodes[:, ::-1])
    mesh = tetopt.Mesh(straight.points, straight.cells, bent[n_corners:])
    bent = np.concatenate([straight.points, bent[n_corners:]])
    found = tetopt.field_on_image(mesh, bent, image)
    inside = np.isfinite(found[..., 0])
    places = centres(image).reshape(*image.shape, n)
    assert_allclose(found[inside], places[inside], rtol=0.0, atol=1e-9)
    unbent = tetopt.field_on_image(straight, bent, image)
    assert np.nanmax(np.abs(unbent - places)) > 0.05


def test_an_image_moves_with_its_displacement():
    """By whole voxels exactly, by nothing not at all, and the inverse way back; labels stay
    labels.
    """
    image = sample_image()
    mesh = tetopt.lattice_mesh(image, nodes=100)
    still = tetopt.warped_image(mesh, np.zeros_like(mesh.points), image)
    assert_allclose(still.data, image.data, atol=1e-9)
    along = image.affine[:3, 0]
    moved = tetopt.warped_image(
        mesh, np.tile(2.0 * along, (len(mesh.points), 1)), image, outside=-5.0
    )
    assert_allclose(moved.data[2:], image.data[:-2], atol=1e-9)
    assert (moved.data[:2] == -5.0).all()
    middle = mesh.points.mean(axis=0)
    grown = tetopt.warped_image(mesh, 0.25 * (mesh.points - middle), image)
    index = image.to_index(middle + (centres(image) - middle) / 1.25)
    labels = tetopt.Image(1.0 + (image.data > np.median(image.data)), image.affine)
    of_labels = tetopt.warped_image(mesh, 0.25 * (mesh.points - middle), labels, is_nearest=True)
    assert set(np.unique(of_labels.data)) <= {1.0, 2.0}
    nearest = labels.data[
        tuple(np.clip(np.rint(index).astype(int), 0, np.array(image.shape) - 1).T)
    ]
    assert (of_labels.data.ravel() == nearest).mean() > 0.97  # but for ties
    from scipy.ndimage import map_coordinates

    assert_allclose(grown.data.ravel(), map_coordinates(image.data, index.T, order=1), atol=1e-6)
    nodes = quadratic(mesh.points, mesh.cells)[0]
    bent = tetopt.warped_image(mesh, 0.25 * (nodes - middle), image)  # the same, of order 2
    assert_allclose(bent.data, grown.data, atol=1e-6)


def test_other_rows_and_displacements_are_rejected():
    image = oblique(3)
    mesh = moved_mesh(image)
    for rows in (5, len(mesh.points) + 1):
        with refusal(f"values: expected a row for each of .* got {rows}"):
            tetopt.field_on_image(mesh, np.zeros(rows), image)
    with refusal("values: expected an array of numbers"):
        tetopt.field_on_image(mesh, ["a"] * len(mesh.cells), image)
    with refusal("inverted"):
        tetopt.warped_image(mesh, -2.0 * mesh.points, image)
    with refusal("3 numbers for each node"):
        tetopt.warped_image(mesh, mesh.points[:, :2], image)
    far = tetopt.Image(np.zeros((3, 3, 3)), np.diag([1.0, 1.0, 1.0, 1.0]) + 1e4 * np.eye(4, k=3))
    with refusal("image: no voxel of it is inside the mesh"):
        tetopt.warped_image(mesh, np.zeros_like(mesh.points), far, image)
    part = tetopt.Image(
        1.0 + image.data[3:], image.affine @ np.array([[1, 0, 0, 3], *np.eye(4)[1:].tolist()])
    )
    moved = tetopt.warped_image(mesh, np.zeros_like(mesh.points), part, image, outside=-1.0)
    assert (moved.data[:2] == -1.0).all()  # not the edge of what there is
    assert (moved.data[3:] > 0.0).any()
    with refusal("expected a 3-D image like the mesh, got a 2-D one"):
        tetopt.warped_image(mesh, np.zeros_like(mesh.points), oblique(2), image)
    points = np.array([[-4.0, -4], [4, -4], [4, 4], [-4, 4], [-1, 0], [1, 0]])
    mesh = tetopt.Mesh(points, orient_cells(points, Delaunay(points).simplices))
    grid = tetopt.Image(np.zeros((9, 9)), [[1, 0, -4], [0, 1, -4], [0, 0, 1]])
    numbers = np.arange(6.0)
    with refusal('6 cells and as many nodes; pass at="cells" or at="nodes"'):
        tetopt.field_on_image(mesh, numbers, grid)
    of_cells, of_nodes = (
        tetopt.field_on_image(mesh, numbers, grid, at=at) for at in ("cells", "nodes")
    )
    inside = np.isfinite(of_cells)
    assert (of_cells[inside] % 1.0 == 0.0).all()
    assert (of_nodes[inside] % 1.0 != 0.0).any()
