"""Graded starts: where the nodes are, how many, and the hard cases; and the mesh that comes of
them.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import ndimage
from shapes import ball_image, distance, grid

import tetopt
from tetopt import E_D, Image, InputError, Sizes, check_mesh, mesh_image, quality
from tetopt.contents.noise import noise_level
from tetopt.start import octree
from tetopt.start.clip import hole_numbers, lost_fraction
from tetopt.start.octree import octree_mesh
from tetopt.system import budget

OBLIQUE = np.array(
    [[0.9, 0.3, 0.2, -7.0], [-0.25, 1.1, 0.1, 3.0], [0.0, 0.4, -1.5, 11.0], [0.0, 0.0, 0.0, 1.0]]
)


def ball(*shape, affine=None, noise=0.0):
    place = grid(shape) - 0.4 * np.array(shape)
    data = 100.0 * ((place**2).sum(-1) < (0.2 * shape[0]) ** 2)
    return Image(data + np.random.default_rng(0).normal(0.0, noise, shape), affine)


def filled(shape, value, affine=None):
    """An image of one value."""
    return Image(np.full(shape, value), affine)


def layered(*values, shape=(48, 40, 40), at=(24, 25)):
    """Slabs along the first axis that begin where is said."""
    layer = np.searchsorted(at, np.arange(shape[0]), side="right")
    return Image(np.array(values)[layer][:, None, None] * np.ones(shape))


def noise(*shape):
    return Image(np.random.default_rng(1).normal(0, 10, shape))


IMAGES = {
    "noisy ball": (ball(48, 40, 44, noise=10.0), 1500),
    "oblique": (ball(48, 40, 30, affine=OBLIQUE), 1500),
    "one-voxel sheet": (layered(0.0, 100.0, 0.0), 1500),
    "surfaces a voxel apart": (layered(60.0, 0.0, 120.0, at=(20, 21)), 1500),
    "touching the box": (Image(100.0 * (grid((40, 40, 40)).sum(-1) < 30.0)), 1500),
    "noise only": (noise(40, 40, 40), 1500),
    "constant": (filled((40, 40, 40), 7.0), 1500),
    "0.5 x 0.5 x 5 mm": (ball(80, 80, 16, affine=np.diag([0.5, 0.5, 5.0, 1.0])), 1500),
    "2-D": (ball(90, 70), 500),
    "2-D noise": (noise(90, 70), 500),
}


def assert_same_mesh(first, second):
    assert_array_equal(first.points, second.points)
    assert_array_equal(first.cells, second.cells)


@pytest.mark.parametrize(
    "name", ["noisy ball", "oblique", "surfaces a voxel apart", "touching the box", "2-D"]
)
def test_octree_is_a_good_mesh_of_the_box(name):
    image, nodes = IMAGES[name]
    mesh = octree_mesh(image, nodes)
    assert check_mesh(mesh, image) == []
    assert abs(len(mesh.points) - nodes) <= 0.08 * nodes
    if image.ndim == 3:
        assert quality(mesh.points, mesh.cells).min_dihedral > 10.0
    assert_same_mesh(octree_mesh(image, nodes), mesh)


@pytest.mark.full
@pytest.mark.parametrize(
    "name", ["oblique", "one-voxel sheet", "constant", "0.5 x 0.5 x 5 mm", "2-D noise"]
)
def test_mesh_image(name):
    """The whole way: no flat cell, that many nodes, every voxel in one cell, no more E_D than
    before.
    """
    image, nodes = IMAGES[name]
    result = mesh_image(image, nodes, iterations=8)
    mesh, first, last = result.mesh, result.history[0], result.history[-1]
    assert check_mesh(mesh, image) == []
    assert abs(len(mesh.points) - nodes) <= 0.01 * nodes or first.E_D == 0.0
    assert last.n_voxels == image.data.size
    assert last.E_D == pytest.approx(E_D(image, mesh), rel=1e-9, abs=1e-6)
    assert last.E_D <= first.E_D * (1.0 if name in ("2-D noise", "constant") else 0.6)
    if image.ndim == 3:
        assert quality(mesh.points, mesh.cells).min_dihedral >= 12.0 * (1 - 1e-9)


@pytest.mark.full
def test_less_error_than_a_uniform_mesh():
    """At the same number of nodes, from start to end, and at a comparable shape."""
    image = ball(40, 38, 36, noise=2.0)
    uniform = tetopt.optimize(image, tetopt.lattice_mesh(image, nodes=1000), k_D=0.5).mesh
    graded = mesh_image(image, len(uniform.points)).mesh
    assert abs(len(graded.points) - len(uniform.points)) <= 2
    assert E_D(image, graded) < 0.6 * E_D(image, uniform)
    assert quality(graded.points, graded.cells).mean_rho > 0.23


def test_nodes_do_not_follow_noise(monkeypatch):
    """Noise everywhere, a wave in half of the box: more nodes go to the wave if noise is known
    for what it is.
    """
    data = np.random.default_rng(2).normal(0.0, 20.0, (64, 40, 40))
    data[:32] += 30.0 * np.sin(np.arange(40)[:, None] / 3.0)

    def fraction_in_wave():
        mesh = octree_mesh(Image(data), 2000, Sizes(longest=np.inf))
        return (mesh.points[:, 0] < 31.5).mean()

    known = fraction_in_wave()
    monkeypatch.setattr("tetopt.start.sums.sampled_noise", lambda *sample: 0.0)
    assert fraction_in_wave() < 0.7 < 0.75 < known


def test_noise_alone_gets_a_uniform_mesh():
    """Two sizes of blocks at most, and as many nodes in each half of the box."""
    mesh = octree_mesh(*IMAGES["noise only"])
    # 8 times for a level; a block's corner is cut into unequal cells
    assert mesh.cell_volumes.max() < 17.0 * np.median(mesh.cell_volumes)
    halves = (mesh.points < 19.5).mean(axis=0)
    assert (np.abs(halves - 0.5) < 0.1).all()


@pytest.mark.parametrize("shape", [(60, 60), (40, 40, 40)])
@pytest.mark.parametrize("sigma", [0.5, 5.0])
def test_noise_level(shape, sigma):
    """Found within 8 %, beside structure ten times as strong, and with a background cut out."""
    rng = np.random.default_rng(3)
    noisy = 10.0 * sigma * np.sin(grid(shape).sum(-1) / 6.0) + rng.normal(0.0, sigma, shape)
    for _ in range(2):
        assert noise_level(noisy) == pytest.approx(sigma, rel=0.08)
        noisy[: shape[0] // 2] = 0.0
    fine = ndimage.gaussian_filter(rng.normal(size=shape), 1.5)
    labels = np.round(fine / fine.std())
    assert noise_level(np.zeros(shape)) == noise_level(labels) == 0.0


@pytest.mark.parametrize(
    ("shape", "nodes", "words"),
    [
        ((30, 30, 30), 3, "9 or more in 3-D, got 3"),
        ((30, 30, 30), 500_000, "too many for 30 x 30 x 30 voxels; use at most 27000$"),
        ((200, 2, 2), 10, "too few for 200 x 2 x 2 voxels; the nearest octree found has 89"),
    ],
)
def test_impossible_numbers_of_nodes(shape, nodes, words):
    with pytest.raises(InputError, match=words):
        octree_mesh(ball(*shape), nodes)
    with pytest.raises(TypeError, match="nodes: expected a whole number, got"):
        octree_mesh(ball(*shape), nodes + 0.5)


@pytest.mark.full
@pytest.mark.parametrize("nodes", [50, 1500])
@pytest.mark.parametrize(
    "data",
    [
        100.0 * ball_image((32,) * 3, (15.5,) * 3, 9).data,
        np.ones((32,) * 3),
        np.random.default_rng(0).normal(size=(32,) * 3),
        50.0 * ball_image((32,) * 3, (9,) * 3, 0.5).data,
    ],
    ids=["ball", "constant", "noise", "voxel"],
)
def test_every_number_of_nodes(data, nodes):
    """Where many blocks are alike, too: a ball in the middle, nothing, noise, one bright voxel."""
    count = len(octree_mesh(Image(data), nodes).points)
    assert abs(count - nodes) <= max(0.07 * nodes, 30)


def test_scale_of_intensities():
    image = ball(30, 30, 30, noise=3.0)
    expected = octree_mesh(image, 800)
    for scale in (1e-150, 1e-30, 1e100):
        assert_same_mesh(octree_mesh(Image(image.data * scale), 800), expected)
    with pytest.raises(InputError, match="overflow"):
        octree_mesh(Image(image.data * 1e200), 800)


def test_a_bound_beyond_all_boxes_bounds_nothing():
    """Its cube overflows, which is no error and no warning: the mesh is that under a bound that
    just holds the box.
    """
    image = noise(6, 6, 6)
    meshes = [
        mesh_image(image, 50, iterations=0, sizes=Sizes(longest=mm)).mesh for mm in (1e3, 1e300)
    ]
    assert_same_mesh(*meshes)


def masked(inside):
    mask = Image(1.0 * inside)
    return tetopt.content(mask, mask=mask)


def shell(size, radius):
    """A mask of a sphere's wall of two voxels."""
    return masked(np.abs(distance((size,) * 3, *[0.5 * (size - 1)] * 3) - radius) < 1.0)


def tube(middle, half):
    """A mask of the wall of a tube of 20 voxels' radius, 50 long."""
    off = np.abs(distance((60, 60), middle, middle) - 20.0) < half
    return masked(off[..., None] & (np.abs(np.arange(60) - middle) < 25.0))


def lost(content, mesh):
    return lost_fraction(mesh, content.image, content.region)


def kept_fraction(content, mesh):
    return mesh.cell_volumes.sum() / content.region.inside.sum()


def test_a_wall_thinner_than_the_cells_is_whole():
    """Of a shell of two voxels, an octree of 500 nodes would lose a third; it has more, which the
    run removes.

    With the bound on edges of 500 nodes, 1440 would be needed.
    """
    content, ideal = shell(26, 9.0), 4.0 / 3.0 * np.pi * (10.0**3 - 8.0**3)
    start = octree_mesh(content, 500)
    assert 500 < len(start.points) < 1200
    assert octree.is_for_walls(len(start.points), 500)
    assert start.cell_volumes.sum() == pytest.approx(ideal, rel=0.02)
    # at the ends of collapsed edges nothing else may change: 16 iterations leave 518
    result = mesh_image(content, nodes=500, iterations=20)
    assert len(result.mesh.points) == 500
    assert result.mesh.cell_volumes.sum() == pytest.approx(ideal, rel=0.015)
    assert result.violated == {}


def test_facets_across_a_torn_wall_do_not_make_up_for_it(monkeypatch):
    """Those of a torn tube lie deep in its wall, as if they cut off what is torn."""
    content = tube(29.5, 2.5)
    assert kept_fraction(content, octree_mesh(content, 1500)) == pytest.approx(1.0, rel=0.02)
    monkeypatch.setattr(octree, "FINER_STEPS", 0)
    torn = octree_mesh(content, 1500)
    # some facets cross it obliquely
    assert 0.1 < 1.0 - kept_fraction(content, torn) < lost(content, torn) + 0.05


def test_one_octree_that_loses_more_by_chance_does_not_end_the_search():
    """Of this tube, the third octree loses more than the second, the fourth next to nothing."""
    content = tube(30.0, 1.5)
    assert kept_fraction(content, octree_mesh(content, 1500)) == pytest.approx(1.0, rel=0.02)


def test_a_wall_with_holes_too_small_to_lose_volume_has_a_finer_octree(monkeypatch):
    """Of a sphere's wall of 5 mm, on voxels of .7 x .7 x 2 mm."""
    spacing, shape = np.array([0.7, 0.7, 2.0]), (36, 36, 13)
    place = (np.indices(shape).T - 0.5 * np.array(shape) + 0.5) * spacing
    inside = np.abs(np.linalg.norm(place, axis=-1).T - 9.0) < 2.5
    mask = Image(1.0 * inside, np.diag([*spacing, 1.0]))
    content = tetopt.content(mask, mask=mask)
    whole = octree_mesh(content, 200)
    assert hole_numbers(whole, mask, content.region) == (-1, -1)
    monkeypatch.setattr(octree, "misfit_of_holes", lambda numbers: 0)
    torn = octree_mesh(content, 200)
    assert lost(content, torn) < octree.MOST_LOST
    assert hole_numbers(torn, mask, content.region) == (1, -1)


def test_tears_that_hardly_become_fewer_ask_for_no_more_cells_than_the_volume(monkeypatch):
    """As of the cortex of a brain, which has hundreds."""
    content, meshes = shell(26, 9.0), []
    for torn in ([*range(300, 400, 10)], [0] * 9):
        monkeypatch.setattr(octree, "misfit_of_holes", lambda _, left=torn: left.pop())
        meshes.append(octree_mesh(content, 500))
    assert_same_mesh(*meshes)


@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_facets_of_a_ball_cut_off_what_it_lacks(monkeypatch, sigma):
    """Also of a blurred one, whose level rises by an eighth per voxel, not by 1, so that depths
    count for less.
    """
    monkeypatch.setattr(octree, "FINER_STEPS", 0)
    ball = ball_image((40, 40, 40), (19.5, 19.5, 19.5), 14.0).data
    content = masked(ndimage.gaussian_filter(ball, sigma))
    mesh = octree_mesh(content, 300)
    assert lost(content, mesh) < 0.9 * (1.0 - kept_fraction(content, mesh))


def test_a_wall_that_no_octree_keeps_has_the_one_that_loses_least():
    """Nearly all would be lost with the requested nodes; twice as many keep it."""
    content = shell(34, 13.0)
    assert octree.MOST_LOST < lost(content, octree_mesh(content, 300)) < 0.06
    assert lost(content, octree_mesh(content, 600)) < octree.MOST_LOST


def test_a_mask_that_finer_octrees_hardly_keep_better_has_the_nearest_number_of_nodes(monkeypatch):
    content, meshes = shell(60, 25.0), []
    for steps in (2, 0):
        monkeypatch.setattr(octree, "FINER_STEPS", steps)
        meshes.append(octree_mesh(content, 300))
    assert_same_mesh(*meshes)


def test_a_run_whose_time_is_over_tries_no_finer_octrees(monkeypatch):
    content = shell(26, 9.0)
    whole = octree_mesh(content, 300)
    short = mesh_image(content, 300, max_seconds=1e-9).initial
    monkeypatch.setattr(octree, "FINER_STEPS", 0)
    # from which carving has removed what the mask has not
    assert len(short.points) <= len(octree_mesh(content, 300).points) < len(whole.points)


def test_the_same_mesh_at_half_of_the_free_memory_or_a_refusal(monkeypatch):
    """Of a wall, for which finer octrees are tried: each of their steps that memory ends, ends all.

    Whichever check finds too little, no coarser octree stands in; with what the largest takes, the
    mesh is that of all memory.
    """
    content, needs = shell(26, 9.0), []
    with monkeypatch.context() as patch:
        patch.setattr(octree, "check_memory", lambda n_bytes, *words: needs.append(n_bytes))
        expected = octree_mesh(content, 200)
    for number in range(len(needs)):
        later = iter(range(len(needs)))

        def short(n_bytes, what, remedy, number=number, later=later):
            if next(later) == number:
                raise budget.MemoryShortage(f"{what}: {remedy}")

        with monkeypatch.context() as patch:
            patch.setattr(octree, "check_memory", short)
            with pytest.raises(budget.MemoryShortage):
                octree_mesh(content, 200)
    most = int(max(needs))
    monkeypatch.setattr(budget, "available_bytes", lambda: most - 1)
    with pytest.raises(InputError, match=r"octree: .* memory"):
        octree_mesh(content, 200)
    for free in (most + 1, 2 * most):
        monkeypatch.setattr(budget, "available_bytes", lambda free=free: free)
        assert_same_mesh(octree_mesh(content, 200), expected)


def test_a_run_that_loses_a_wall_asks_for_more_nodes(monkeypatch):
    monkeypatch.setattr(octree, "FINER_STEPS", 1)
    result = mesh_image(shell(26, 9.0), nodes=300, iterations=0)
    assert result.violated["mask"].endswith("allow more nodes")
