import warnings

import numpy as np
import pytest
from models import sample_image
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import binary_opening, map_coordinates
from shapes import OBLIQUE, ball_image, distance, grid, shaped

import tetopt
from tetopt import Image, Mesh, lattice_mesh
from tetopt.contents.domain import Region, _open_mask, levels, region_of
from tetopt.geometry.topology import boundary_facets
from tetopt.measure.fidelity import mask_fidelity
from tetopt.start.clip import clip_cells, lattice_within, lost_fraction, onto_surface


def test_voxels_stay_on_their_side():
    rng = np.random.default_rng(1)
    mask = rng.random((12, 13, 14)) < 0.4
    region = region_of(Image(1.0 * mask))
    assert_array_equal(region.level < 0.0, mask)
    assert_array_equal(region.inside, mask)


@pytest.mark.parametrize("thickness", [2.0, 3.0, 5.0])
@pytest.mark.parametrize("kind", ["shell", "tube", "plate"])
def test_walls_have_the_volume_of_their_voxels(kind, thickness):
    """Within 1 %; smoothing of each voxel by itself took 2 % from two voxels and added 4 % at
    three.
    """
    at = grid((34, 34, 34)) - [16.7, 16.4, 16.6]
    if kind == "plate":
        off = at @ (np.array([0.3, 0.17, 1.0]) / np.linalg.norm([0.3, 0.17, 1.0]))
    else:
        off = np.linalg.norm(at[..., : 3 if kind == "shell" else 2], axis=-1) - 11.0
    inside = np.abs(off) < 0.5 * thickness
    places = 0.25 * grid((136, 136, 136)).reshape(-1, 3) - 0.375  # 64 in each voxel
    level = levels(region_of(Image(1.0 * inside)).level, places)
    assert (level < 0.0).sum() == pytest.approx(64 * inside.sum(), rel=0.01)


@pytest.mark.parametrize("fraction", [1.0, 0.9])
def test_far_from_the_surface_the_level_counts_voxels(fraction):
    """Of masks of two values, and of fractions."""
    mask = distance((40, 24, 25), 8.0, 11.0, 12.0) < 5.0
    level = region_of(Image(fraction * mask)).level[:, 11, 12]
    assert_allclose(level[12:], np.arange(12, 40) - 12.6, atol=1.0)
    assert_allclose(np.diff(level[20:]), 1.0)


def test_fractions_have_their_own_surface():
    part = np.clip(12.7 - np.arange(20.0), 0.0, 1.0)  # 0.7 at 12, 0 at 13: a half at 12 + 2 / 7
    level = region_of(Image(np.broadcast_to(part, (6, 7, 20)))).level
    z = 12.0 + 2.0 / 7.0 + np.array([0.0, 3.0, -3.0])
    on, above, below = levels(level, np.column_stack([[2.0] * 3, [3.0] * 3, z]))
    assert on == pytest.approx(0.0, abs=1e-6)
    assert above > 1.0
    assert below < -1.0


def test_all_inside_has_no_surface():
    image = Image(np.ones((6, 7, 8)))
    mesh = lattice_mesh(image, nodes=100)
    assert_array_equal(clip_cells(mesh, image, region_of(image)).cells, mesh.cells)


def test_levels_are_linear_between_centres():
    level = np.random.default_rng(0).normal(size=(5, 6, 7)).astype(np.float32)
    at = np.random.default_rng(1).uniform(-0.5, 6.0, size=(50, 3))
    assert_allclose(
        levels(level, at), map_coordinates(level.astype(float), at.T, order=1, mode="nearest")
    )


@pytest.mark.parametrize("n", [2, 3])
def test_the_way_onto_the_surface_is_the_shortest_in_mm(n):
    affine = OBLIQUE if n == 3 else OBLIQUE[np.ix_([0, 2, 3], [0, 2, 3])]
    image = Image(np.zeros((20,) * n), affine)
    normal = np.array([1.0, 2.0, -0.5])[:n]  # of a plane, in index space
    level = (grid(image.shape) - 9.3) @ normal
    at = np.random.default_rng(0).uniform(6.0, 12.0, size=(40, n))
    there, is_there = onto_surface(at, image, Region(level < 0, level.astype(np.float32)))
    assert is_there.all()
    # In the world the normal of the plane is the index normal by the inverse transposed; the way is
    # along it.
    world = normal @ np.linalg.inv(affine[:-1, :-1])
    way = (there - at) @ affine[:-1, :-1].T
    side = way - np.outer(way @ world, world) / (world @ world)
    assert np.abs(side).max() < 1e-3 * np.abs(way).max()
    assert_allclose((there - 9.3) @ normal, 0.0, atol=2e-3)


def test_nodes_on_the_box_stay_on_it():
    image, mask = shaped("touching")
    mesh = clip_cells(lattice_mesh(image, nodes=900), image, region_of(mask))
    index, outer = image.to_index(mesh.points), boundary_facets(mesh.cells)
    assert (index >= -0.5).all()
    assert (index[:, 0] == -0.5).sum() > 20
    on_box = (index[outer][:, :, 0] == -0.5).all(axis=1)
    assert on_box.any()
    # the rest lies on the surface, or as good as
    level = np.abs(levels(region_of(mask).level, index[np.unique(outer[~on_box])]))
    assert level.max() < 0.35


@pytest.mark.parametrize("kind", ["pieces", "hole", "touching"])
def test_clipped(kind):
    image, mask = shaped(kind)
    mesh = lattice_within(image, region_of(mask), spacing=2.5)
    assert tetopt.check_mesh(mesh, is_whole=False) == []
    assert tetopt.quality(mesh.points, mesh.cells).min_dihedral > 1.0
    fidelity = mask_fidelity(mask, mesh)
    assert fidelity.dice > 0.97
    assert fidelity.mesh_components == fidelity.components
    assert fidelity.mesh_euler == fidelity.euler
    assert fidelity.distance_mean < 0.25


def test_a_wall_as_thick_as_its_cells_is_whole():
    """Inside a thin wall the level is flat, so that its values alone would put nodes in the
    middle on the surface.
    """
    wall = np.abs(distance((34, 34, 34), 16.7, 16.4, 16.6) - 11.0) < 1.5
    image = Image(1.0 * wall)
    mesh = lattice_within(image, region_of(image), spacing=3.0)
    assert mesh.cell_volumes.sum() == pytest.approx(wall.sum(), rel=0.04)


@pytest.mark.parametrize(("shape", "spacing"), [((44, 22, 22), 4.0), ((44, 22), 6.0)])
def test_what_flat_facets_cut_off_is_not_lost(shape, spacing):
    """Of two balls, neither is lost in a coarse mesh; without the cells of one, half is."""
    n = len(shape)
    affine = np.diag([-2.0, 1.0, 1.0, 1.0][-n - 1 :])  # mirrored in 3-D
    first, second = (distance(shape, x, *[10.6] * (n - 1)) for x in (10.6, 32.6))
    inside = np.minimum(first, second) < 8.0
    image = Image(1.0 * inside, affine)
    region = region_of(image)
    mesh = lattice_within(image, region, spacing=spacing)
    assert mesh.cell_volumes.sum() < 0.97 * inside.sum() * image.voxel_volume
    assert abs(lost_fraction(mesh, image, region)) < 0.01
    half = image.to_index(mesh.points)[mesh.cells].mean(axis=1)[:, 0] < 22.0
    one = Mesh(mesh.points, mesh.cells[half])
    assert lost_fraction(one, image, region) == pytest.approx(0.5, abs=0.01)


def test_bridged_gaps_do_not_make_up_for_what_is_lost():
    """A block whose slots of one voxel are filled has as much too much as the slab beside it has
    voxels.
    """
    inside = np.zeros((40, 20, 20))
    inside[:20] = inside[30:35] = 1.0
    inside[1:20:4] = 0.0
    image = Image(inside)
    box = lattice_mesh(image, "five-tet", blocks=(8, 4, 4))
    mesh = Mesh(box.points, box.cells[box.points[box.cells].mean(axis=1)[:, 0] < 19.5])
    assert mesh.cell_volumes.sum() == inside.sum()
    assert lost_fraction(mesh, image, region_of(image)) == pytest.approx(0.25, abs=0.01)


@pytest.mark.full
@pytest.mark.parametrize("nodes", [200, 600, 1500])
def test_wanted_nodes_within_a_mask(nodes):
    image, mask = shaped("ball")
    points = lattice_within(image, region_of(mask), nodes=nodes).points
    assert len(points) == pytest.approx(nodes, rel=0.1)


def test_too_thin_for_its_cells():
    image = ball_image((30, 30, 30), (15, 15, 15), 0.5)
    mesh = lattice_mesh(image, blocks=(1, 1, 1))
    moved = Mesh(mesh.points + np.where(mesh.points == 14.5, 3.0, 0.0), mesh.cells)
    with pytest.raises(tetopt.InputError, match="no cell is left inside"):
        clip_cells(moved, image, region_of(image))


@pytest.mark.parametrize("shape", [(13, 15, 11), (20, 31), (9, 1, 12)])
def test_voxels_in_cubes_of_two_are_scipys(shape):
    rng = np.random.default_rng(0)
    for fraction in (0.7, 0.9, 0.97):
        inside = rng.random(shape) < fraction
        assert_array_equal(_open_mask(inside), binary_opening(inside, np.ones((2,) * len(shape))))


def test_a_mask_of_all_voxels_is_meshed_without_a_word():
    image = sample_image(3)
    whole = tetopt.content(image, mask=Image(np.ones(image.shape), image.affine))
    with warnings.catch_warnings(action="error"):
        result = tetopt.mesh_image(whole, 60, iterations=0)
    assert result.mesh.cell_volumes.sum() == pytest.approx(image.volume)
