"""Fidelity to labels and masks: against cases whose numbers are known, and slow twins."""

from collections import Counter

import naive
import numpy as np
import pytest
import pyvista
from meshes import both_dimensions, random_affine, random_rotation
from numpy.testing import assert_allclose, assert_array_equal
from shapes import distance

import tetopt
from tetopt.geometry.simplex import centroids, orient_cells
from tetopt.measure.fidelity import (
    MOST_POINTS,
    FacetSurface,
    _distances,
    cell_labels,
    evenly_spread,
    half_level_surface,
    label_fidelity,
    mask_fidelity,
    painted_voxels,
    surface_areas,
    surface_distances,
    voxel_cells,
)


def blocky(image, blocks):
    """A lattice whose blocks' faces are planes of facets."""
    return tetopt.lattice_mesh(
        image, "criss-cross" if image.ndim == 2 else "five-tet", blocks=blocks
    )


def slabs(n, affine=None):
    """An image of 8^n voxels, label 0 in its half of x < 3.5, else 1; a lattice, a plane of
    facets at each 1/2 of x.
    """
    labels = np.zeros((8,) * n)
    labels[4:] = 1
    image = tetopt.Image(labels, affine)
    mesh = blocky(image, (8, 3, 2)[:n])
    return image, mesh, image.to_index(centroids(mesh.points, mesh.cells))[:, 0]


def moved_affine(rng, n):
    """Voxels of 1.5, .5 and 3 mm, rotated, flipped and moved."""
    affine = np.eye(n + 1)
    affine[:n, :n] = random_rotation(rng, n) @ np.diag([1.5, 0.5, -3.0][:n])
    affine[:n, n] = rng.uniform(-100.0, 100.0, n)
    return affine


def ball(n, radius, centre):
    """Cones from the centre over a polygon or polyhedron with its corners on the sphere."""
    if n == 2:
        turn = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
        around = np.column_stack([np.cos(turn), np.sin(turn)])
        facets = np.column_stack([np.arange(200), np.roll(np.arange(200), -1)])
    else:
        sphere = pyvista.Icosphere(radius=1.0, nsub=4)
        around, facets = np.asarray(sphere.points, dtype=np.float64), sphere.regular_faces
    points = np.vstack([around * radius, np.zeros(n)]) + centre
    cells = np.column_stack([facets, np.full(len(facets), len(around))])
    return points, cells


def ball_field(n, size, radius, centre):
    """1 inside, 0 outside, linear over four voxels across the sphere, on which it is 1/2."""
    return np.clip((radius - distance((size,) * n, *[centre] * n)) / 4.0 + 0.5, 0.0, 1.0)


# Cells' labels


@both_dimensions
def test_cell_labels_against_twin(n):
    """Counted voxel by voxel, on a mesh that leaves voxels out and has cells without voxels, and
    with many ties.
    """
    rng = np.random.default_rng(n)
    labels = tetopt.Image(rng.choice([0, 2, 7], (9, 8, 7)[:n]), random_affine(rng, n))
    whole = tetopt.lattice_mesh(labels, blocks=(5, 4, 4) if n == 3 else (6, 5))
    mesh = tetopt.Mesh(whole.points, whole.cells[len(whole.cells) // 4 :])
    owner, of_cell = tetopt.cell_of_voxel(labels, mesh), cell_labels(labels, mesh)
    nearest = np.rint(labels.to_index(centroids(mesh.points, mesh.cells))).astype(int)
    n_ties = n_empty = 0
    for cell, label in enumerate(of_cell):
        count = Counter(labels.data[owner == cell].astype(int).tolist())
        most = [each for each, c in count.items() if c == max(count.values())]
        n_ties += len(most) > 1
        n_empty += not most
        assert label == (min(most) if most else labels.data[tuple(nearest[cell])])
    assert of_cell.dtype == np.int64
    assert min(n_ties, n_empty) > 3
    assert (owner < 0).any()
    shown = painted_voxels(owner, of_cell, -1)
    assert_array_equal(shown, np.where(owner < 0, -1, of_cell[owner]))


# Surfaces


@both_dimensions
@pytest.mark.parametrize(
    ("level", "place"),
    [
        (lambda labels: labels == 1, 3.5),
        (lambda labels: np.indices(labels.shape)[0] / 8.0 + 0.0625, 3.5),
        (lambda labels: labels * 0.8, 3.625),
    ],
)
def test_half_level_of_a_plane(n, level, place):
    """It runs from face to face of the box, has no part on them, and lies where the field is
    1/2.
    """
    image, _, _ = slabs(n, random_affine(np.random.default_rng(n), n))
    surface = half_level_surface(level(image.data), np.eye(n + 1))
    points = surface.points
    assert surface.facets.shape[1] == n
    assert_allclose(points[:, 0], place, atol=1e-5)
    assert_array_equal(points[:, 1:].min(axis=0), -0.5)
    assert_array_equal(points[:, 1:].max(axis=0), 7.5)
    assert surface_areas(surface).sum() == pytest.approx(8.0 ** (n - 1), rel=1e-6)
    in_world = half_level_surface(level(image.data), image.affine)
    assert_allclose(image.to_index(in_world.points), points, atol=1e-9)
    assert_array_equal(in_world.facets, surface.facets)


@both_dimensions
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_no_half_level(n, value):
    surface = half_level_surface(np.full((3,) * n, value), np.eye(n + 1))
    assert surface.points.shape == surface.facets.shape == (0, n)


@both_dimensions
def test_distances_against_twin(n):
    """Large, small and flat facets; points near and far."""
    rng = np.random.default_rng(n)
    sizes = 10.0 ** rng.uniform(-2.0, 1.0, (25, 1, 1))
    corners = rng.normal(size=(25, n, n)) * sizes + rng.normal(0.0, 10.0, (25, 1, n))
    corners[0, 1] = corners[0, 0]
    corners[1, -1] = 0.25 * corners[1, 0] + 0.75 * corners[1, -2]
    corners[2, 1:] = corners[2, 0]
    facets = np.arange(25 * n).reshape(25, n)
    points = np.vstack(
        [rng.normal(0.0, 20.0, (60, n)), corners[:, 0] + rng.normal(0.0, 0.1, (25, n))]
    )
    distances = surface_distances(points, FacetSurface(corners.reshape(-1, n), facets))
    expected = [min(naive.facet_distance(p, c) for c in corners) for p in points]
    assert_allclose(distances, expected, rtol=1e-9, atol=1e-9)


@both_dimensions
def test_points_are_spread_evenly(n):
    """Each facet has its fraction of the points to within two, uniformly dense by their mean and
    covariance.
    """
    corners = np.random.default_rng(n).normal(size=(3, n, n)) + 10.0 * np.arange(3)[:, None, None]
    surface = FacetSurface(corners.reshape(-1, n), np.arange(3 * n).reshape(3, n))
    points = evenly_spread(surface, 3000)
    apart = np.array(
        [surface_distances(points, surface._replace(facets=row[None])) for row in surface.facets]
    )
    assert apart.min(axis=0).max() < 1e-9
    own, areas = apart.argmin(axis=0), surface_areas(surface)
    assert np.abs(np.bincount(own, minlength=3) - 3000 * areas / areas.sum()).max() < 2.0
    for k, of_facet in enumerate(corners):
        inside, middle = points[own == k], of_facet.mean(axis=0)
        assert_allclose(inside.mean(axis=0), middle, atol=0.02)
        # of a uniform density on a simplex
        offset = of_facet - middle
        spread = np.cov(inside.T, bias=True)
        assert_allclose(spread, offset.T @ offset / (n * (n + 1)), atol=0.03)
    assert_array_equal(points, evenly_spread(surface, 3000))


def test_no_side_of_a_plate_is_left_out():
    """Its equal facets come in turn from one side and the other, two for each point."""
    level = np.zeros((65, 3))
    level[:, 1] = 1.0
    curve = half_level_surface(level, np.eye(3))
    side = evenly_spread(curve, len(curve.facets) // 2)[:, 1] > 1.0
    assert 0.45 < side.mean() < 0.55


def test_no_more_points_than_allowed():
    image = slabs(3)[0]
    plane = half_level_surface(image.data == 1, image.affine)
    half = plane._replace(facets=plane.facets[: len(plane.facets) // 2])
    there, back = _distances(plane, half, 1e-9)
    assert len(there) == MOST_POINTS
    assert MOST_POINTS / 2 - 1 <= len(back) <= MOST_POINTS / 2 + 1
    assert sum(len(d) for d in _distances(plane, plane, 1e9)) == 2000


# Labels


def assert_numbers(row, **expected):
    """Of a label, by their names in run.json."""
    found = row.as_json()
    own = {name: found[name] for name in expected}
    assert own == pytest.approx(expected, rel=1e-9, abs=1e-9, nan_ok=True)


@both_dimensions
@pytest.mark.parametrize("shift", [0, 1, -2])
def test_shifted_plane(n, shift):
    """Every number by hand; the box's faces, which both surfaces end at, count for nothing."""
    image, mesh, x = slabs(n, moved_affine(np.random.default_rng(n), n))
    of_cell = (x > 3.5 + shift).astype(int)
    layer, voxel = 8 ** (n - 1), [0.75, 2.25][n - 2]
    rows = label_fidelity(image, mesh, of_cell)
    assert [row.label for row in rows] == [0, 1]
    for row, layers in zip(rows, (4 + shift, 4 - shift), strict=True):
        assert_numbers(
            row,
            voxels=4 * layer,
            volume=4 * layer * voxel,
            mesh_volume=layers * layer * voxel,
            n_cells=(of_cell == row.label).sum(),
            dice=2 * min(layers, 4) / (layers + 4),
            distance_mean=1.5 * abs(shift),
            distance_p95=1.5 * abs(shift),
            components=1,
            mesh_components=1,
        )
        assert not row.extent.is_lost


@both_dimensions
def test_distances_are_pooled_by_area(n):
    """A stripe with two sides of which the mesh has one: of three equal areas one is 4 voxels
    away.
    """
    image, mesh, x = slabs(n)
    stripe = np.zeros(image.shape)
    stripe[2:6] = 3
    row = label_fidelity(tetopt.Image(stripe), mesh, np.where(x > 1.5, 3, 0))[1]
    assert row.distance.mean == pytest.approx(4 / 3, rel=6e-3)
    assert row.distance.p95 == row.distance.max == 4.0


def test_lost_label():
    """A voxel that no cell is small enough for."""
    labels = np.zeros((8, 8, 8))
    labels[4, 4, 4] = 1
    image = tetopt.Image(labels)
    background, speck = label_fidelity(image, blocky(image, (1, 1, 1)))
    assert (background.extent.is_lost, speck.extent.is_lost) == (False, True)
    nothing = dict.fromkeys(("n_cells", "mesh_volume", "dice", "mesh_components"), 0)
    none = dict.fromkeys(("distance_mean", "distance_p95"), np.nan)
    assert_numbers(speck, voxels=1, components=1, **nothing, **none)
    assert_numbers(background, dice=2 * 511 / (511 + 512))


def test_cells_without_a_voxel():
    """Five cells to a block of half a voxel along x: of two blocks one may hold the centre, on
    their common side.
    """
    labels = np.zeros((4, 4, 4))
    labels[2:] = 3
    image = tetopt.Image(labels)
    mesh = blocky(image, (8, 4, 4))
    rows = label_fidelity(image, mesh)
    is_empty = tetopt.cell_moments(image, mesh).n_voxels == 0
    of_cell = cell_labels(image, mesh)
    assert [row.extent.n_empty_cells for row in rows] == [
        is_empty[of_cell == row.label].sum() for row in rows
    ]
    assert 0 < is_empty.sum() < len(mesh.cells)


def test_label_that_fills_the_box_has_no_distance():
    (row,) = label_fidelity(
        tetopt.Image(np.ones((4, 4))), tetopt.lattice_mesh(tetopt.Image(np.ones((4, 4))), nodes=20)
    )
    assert np.isnan(row.distance.mean)
    assert (row.label, row.overlap.dice, row.extent.is_lost) == (1, 1.0, False)


def test_outside_of_the_mesh_is_background():
    """The mesh of a mask: label 0 has no cell, and yet is where it should be."""
    image, mesh, x = slabs(3)
    half = tetopt.Mesh(mesh.points, mesh.cells[x > 2.5])
    background, inside = label_fidelity(image, half, np.ones(len(half.cells)))
    assert background.extent.n_cells == 0
    assert not background.extent.is_lost
    assert background.overlap.dice == pytest.approx(2 * 3 / (3 + 4))
    assert inside.overlap.dice == pytest.approx(2 * 4 / (4 + 5))
    assert background.distance.mean == inside.distance.mean == pytest.approx(1.0)
    assert label_fidelity(image, mesh, np.ones(len(mesh.cells)))[0].extent.is_lost


@both_dimensions
def test_components(n):
    """Voxels that meet at an edge or corner only are apart; so are cells."""
    labels = np.zeros((6,) * n)
    labels[(0,) * n] = labels[(1,) * n] = labels[(3,) * n] = labels[(4,) + (3,) * (n - 1)] = 1
    image = tetopt.Image(labels)
    background, spots = label_fidelity(image, blocky(image, (6,) * n))
    assert (spots.pieces.components, spots.pieces.mesh_components) == (3, 3)
    assert (background.pieces.components, background.pieces.mesh_components) == (1, 1)


@pytest.mark.parametrize(
    ("of_cell", "words"),
    [
        (np.zeros(3), r"one label for each of the mesh's 8 cells, got shape \(3,\)"),
        (np.full(8, 0.5), "whole numbers from 0 to 2147483647, got 0.5 to 0.5"),
        (np.full(8, -1), "got -1 to -1"),
        (np.full(8, 2.0**31), r"got 2\.14748e\+09 to"),
        (np.full(8, np.nan), "got nan to nan"),
    ],
)
def test_bad_cell_labels(of_cell, words):
    image = tetopt.Image(np.zeros((4, 2)))
    mesh = tetopt.lattice_mesh(image, blocks=(2, 1))
    with pytest.raises(tetopt.InputError, match=words):
        label_fidelity(image, mesh, of_cell)


def test_extents_of_other_labels():
    image, mesh, _ = slabs(2)
    rows = [row._replace(label=5 * row.label) for row in label_fidelity(image, mesh)]
    with pytest.raises(tetopt.InputError, match="label 5 is not in"):
        label_fidelity(image, mesh, extents=rows)


def test_bad_labels():
    image = tetopt.Image(np.full((4, 2), 0.5))
    mesh = tetopt.lattice_mesh(image, blocks=(2, 1))
    for function in (cell_labels, label_fidelity):
        with pytest.raises(tetopt.InputError, match="is it a label image"):
            function(image, mesh)


# Masks


@both_dimensions
def test_mask_of_a_shifted_plane(n):
    """2 voxels of 1.5 mm; faces of the box count on neither side; the plane ends at the box, as
    a disc does.
    """
    image, mesh, x = slabs(n, moved_affine(np.random.default_rng(n), n))
    fidelity = mask_fidelity(image, tetopt.Mesh(mesh.points, mesh.cells[x > 1.5]))
    layer = 8 ** (n - 1)
    assert fidelity.voxels == 4 * layer
    assert fidelity.volume == pytest.approx(4 * layer * image.voxel_volume)
    assert fidelity.mesh_volume == pytest.approx(6 * layer * image.voxel_volume)
    assert fidelity.dice == pytest.approx(2 * 4 / (4 + 6))
    assert_allclose(fidelity[4:8], 2.0, atol=1e-9)
    assert_allclose(fidelity[8:12], 3.0, atol=1e-9)
    assert fidelity[12:] == (1, 1, 2, 2, ())


@both_dimensions
def test_mask_of_a_ball(n):
    """Its half level is a sphere of radius 10 voxels; the mesh's of 11.5; in voxels of unequal
    size, sheared.
    """
    image = tetopt.Image(ball_field(n, 32, 10.0, 15.2), random_affine(np.random.default_rng(n), n))
    points, cells = ball(n, 11.5, np.full(n, 15.2))
    points = image.to_world(points)
    mesh = tetopt.Mesh(points, orient_cells(points, cells))
    fidelity = mask_fidelity(image, mesh)
    assert fidelity.mesh_volume == pytest.approx(mesh.cell_volumes.sum())
    assert_allclose(fidelity[4:8], 1.5, atol=0.03)
    most, *_, least = 1.5 * np.linalg.svd(image.affine[:n, :n])[1]
    assert least < fidelity.distance_mean_mm < most
    assert least < fidelity.reverse_p95_mm < most * 1.55 / 1.5
    assert fidelity[12:] == (1, 1, 2, 2, ())


def test_mask_reverse_is_another_distance():
    """Half a mask without a mesh: far from it, while the mesh is near the mask."""
    level = np.zeros((20, 8))
    level[2:5] = level[12:15] = 1.0
    image = tetopt.Image(level, np.diag([2.0, 2.0, 1.0]))
    mesh = blocky(image, (20, 4))
    x = image.to_index(centroids(mesh.points, mesh.cells))[:, 0]
    fidelity = mask_fidelity(image, tetopt.Mesh(mesh.points, mesh.cells[(x > 1.5) & (x < 4.5)]))
    assert fidelity.distance_p95 == pytest.approx(0.0, abs=1e-9)
    assert fidelity.reverse_mean == pytest.approx((0 + 0 + 7 + 10) / 4, rel=6e-3)
    assert fidelity.reverse_p95 == pytest.approx(10.0)
    assert (fidelity.distance_p95_mm, fidelity.reverse_p95_mm) == (
        pytest.approx(0.0, abs=1e-9),
        pytest.approx(20.0),
    )
    assert (fidelity.components, fidelity.mesh_components) == (2, 1)
    assert (fidelity.euler, fidelity.mesh_euler) == (4, 2)


def test_mesh_of_the_whole_box_has_a_closed_surface_and_none_off_the_box():
    image, mesh, _ = slabs(2)
    fidelity = mask_fidelity(image, mesh)
    assert np.isnan(fidelity[4:12]).all()
    assert fidelity.dice == pytest.approx(2 * 4 / (4 + 8))
    assert (fidelity.euler, fidelity.mesh_euler) == (2, 2)


def test_half_counts_as_inside():
    """In voxels as in Dice; empty masks overlap with nothing."""
    image, mesh, _ = slabs(2)
    assert mask_fidelity(tetopt.Image(image.data * 0.5), mesh).voxels == 32
    empty = mask_fidelity(tetopt.Image(image.data * 0.4), mesh)
    assert (empty.voxels, empty.dice, empty.components) == (0, 0.0, 0)


def test_bad_mask():
    image, mesh, _ = slabs(2)
    for data, other, words in (
        (image.data * 255, mesh, "values from 0 to 1, got 0 to 255"),
        (image.data - 1, mesh, "got -1 to 0"),
        (image.data, slabs(3)[1], "same dimension"),
    ):
        with pytest.raises(tetopt.InputError, match=words):
            mask_fidelity(tetopt.Image(data), other)


def test_volume_dice_does_not_depend_on_the_unit():
    """A thousandth of a cubic millimetre overlaps as well as a litre."""
    labels = np.zeros((12, 12, 12))
    labels[4:8, 4:8, 4:8] = 1.0
    dice = []
    for voxel in (1.0, 0.01):
        image = tetopt.Image(labels, np.diag([voxel] * 3 + [1.0]))
        dice.append(
            [
                row.overlap.volume_dice
                for row in label_fidelity(image, tetopt.lattice_mesh(image, blocks=(6, 6, 6)))
            ]
        )
    assert_allclose(dice[0], dice[1], rtol=1e-6)
    assert 0.5 < dice[0][1] < 1.0


@both_dimensions
@pytest.mark.parametrize("is_masked", [False, True])
def test_dice_by_majority(n, is_masked):
    """Dice of the labels that most of the voxels in each cell have, whatever labels the cells
    have.
    """
    rng = np.random.default_rng(3)
    coarse = rng.integers(0, 4, (5,) * n)
    image = tetopt.Image(np.kron(coarse, np.ones((3, 4, 2)[:n])), random_affine(rng, n))
    mask = tetopt.Image(rng.random(image.shape) < 0.7, image.affine) if is_masked else None
    mesh = tetopt.lattice_mesh(image, nodes=100)
    mesh = tetopt.Mesh(mesh.points, mesh.cells[: len(mesh.cells) // 2])  # the rest is outside
    owner = tetopt.cell_of_voxel(image, mesh)
    inside = np.ones(image.shape, bool) if mask is None else mask.data > 0
    painted = np.full(image.shape, -1 if is_masked else 0)
    for cell in range(len(mesh.cells)):
        own = image.data[inside & (owner == cell)].astype(int)
        painted[owner == cell] = np.argmax(np.bincount(own)) if len(own) else 3
    for row in label_fidelity(image, mesh, np.full(len(mesh.cells), 3), mask):
        one, other = inside & (image.data == row.label), painted == row.label
        dice = 2 * (one & other).sum() / (one.sum() + other.sum())
        assert row.overlap.dice_majority == dice != row.overlap.dice


def test_cells_of_voxels_that_a_mesh_keeps_cannot_be_changed():
    image = tetopt.Image(np.zeros((8, 8, 8)))
    mesh = tetopt.lattice_mesh(image, nodes=60)
    with pytest.raises(ValueError, match="read-only"):
        voxel_cells(image, mesh)[0, 0, 0] = -1
    assert voxel_cells(image, mesh) is voxel_cells(image, mesh)
