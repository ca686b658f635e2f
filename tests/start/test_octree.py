"""Graded starts: where the nodes are, how many, and the hard cases; and the mesh that comes of
them.
"""

import sys

import numba
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import ndimage
from shapes import grid

import tetopt
from tetopt.contents.noise import noise_level
from tetopt.start import octree
from tetopt.start.clip import lost_fraction
from tetopt.start.octree import octree_mesh
from tetopt.system import budget

OBLIQUE = np.array(
    [[0.9, 0.3, 0.2, -7.0], [-0.25, 1.1, 0.1, 3.0], [0.0, 0.4, -1.5, 11.0], [0.0, 0.0, 0.0, 1.0]]
)


def ball(*shape, affine=None, noise=0.0):
    place = grid(shape) - 0.4 * np.array(shape)
    data = 100.0 * ((place**2).sum(-1) < (0.2 * shape[0]) ** 2)
    return tetopt.Image(data + np.random.default_rng(0).normal(0.0, noise, shape), affine)


def sheet():
    data = np.zeros((48, 40, 40))
    data[24] = 100.0
    return tetopt.Image(data)


def close_surfaces():
    data = np.zeros((48, 40, 40))
    data[:20], data[21:] = 60.0, 120.0
    return tetopt.Image(data)


def touching():
    return tetopt.Image(100.0 * (grid((40, 40, 40)).sum(-1) < 30.0))


IMAGES = {
    "noisy ball": (ball(48, 40, 44, noise=10.0), 1500),
    "oblique": (ball(48, 40, 30, affine=OBLIQUE), 1500),
    "one-voxel sheet": (sheet(), 1500),
    "surfaces a voxel apart": (close_surfaces(), 1500),
    "touching the box": (touching(), 1500),
    "noise only": (tetopt.Image(np.random.default_rng(1).normal(0, 10, (40, 40, 40))), 1500),
    "constant": (tetopt.Image(np.full((40, 40, 40), 7.0)), 1500),
    "0.5 x 0.5 x 5 mm": (ball(80, 80, 16, affine=np.diag([0.5, 0.5, 5.0, 1.0])), 1500),
    "2-D": (ball(90, 70), 500),
    "2-D noise": (tetopt.Image(np.random.default_rng(1).normal(0, 10, (90, 70))), 500),
}


@pytest.mark.parametrize(
    "name", ["noisy ball", "oblique", "surfaces a voxel apart", "touching the box", "2-D"]
)
def test_octree_is_a_good_mesh_of_the_box(name):
    image, nodes = IMAGES[name]
    mesh = octree_mesh(image, nodes)
    assert tetopt.check_mesh(mesh, image) == []
    assert abs(len(mesh.points) - nodes) <= 0.08 * nodes
    shape = tetopt.quality(mesh.points, mesh.cells)
    if image.ndim == 3:
        assert shape.min_dihedral > 10.0
    again = octree_mesh(image, nodes)
    assert_array_equal(again.points, mesh.points)
    assert_array_equal(again.cells, mesh.cells)


@pytest.mark.full
@pytest.mark.parametrize(
    "name", ["oblique", "one-voxel sheet", "constant", "0.5 x 0.5 x 5 mm", "2-D noise"]
)
def test_mesh_image(name):
    """The whole way: no flat cell, that many nodes, every voxel in one cell, no more E_D than
    before.
    """
    image, nodes = IMAGES[name]
    result = tetopt.mesh_image(image, nodes, iterations=8)
    first, last = result.history[0], result.history[-1]
    assert tetopt.check_mesh(result.mesh, image) == []
    assert abs(len(result.mesh.points) - nodes) <= 0.01 * nodes or first.E_D == 0.0
    assert last.n_voxels == image.data.size
    assert last.E_D == pytest.approx(tetopt.E_D(image, result.mesh), rel=1e-9, abs=1e-6)
    assert last.E_D <= first.E_D
    if "nois" not in name and name != "constant":
        assert last.E_D < 0.6 * first.E_D
    if image.ndim == 3:
        assert tetopt.quality(result.mesh.points, result.mesh.cells).min_dihedral >= 12.0 * (
            1 - 1e-9
        )


@pytest.mark.full
def test_less_error_than_a_uniform_mesh():
    """At the same number of nodes, from start to end, and at a comparable shape."""
    image = ball(40, 38, 36, noise=2.0)
    uniform = tetopt.optimize(image, tetopt.lattice_mesh(image, nodes=1000), k_D=0.5).mesh
    graded = tetopt.mesh_image(image, len(uniform.points)).mesh
    assert abs(len(graded.points) - len(uniform.points)) <= 2
    assert tetopt.E_D(image, graded) < 0.6 * tetopt.E_D(image, uniform)
    assert tetopt.quality(graded.points, graded.cells).mean_rho > 0.23


def test_nodes_do_not_follow_noise(monkeypatch):
    """Noise everywhere, a wave in half of the box: more nodes go to the wave if noise is known
    for what it is.
    """
    rng = np.random.default_rng(2)
    data = rng.normal(0.0, 20.0, (64, 40, 40))
    data[:32] += 30.0 * np.sin(grid((64, 40, 40))[:32, ..., 1] / 3.0)

    def fraction_in_wave():
        image = tetopt.Image(data)
        index = image.to_index(octree_mesh(image, 2000, tetopt.Sizes(longest=np.inf)).points)
        return float((index[:, 0] < 31.5).sum()) / len(index)

    known = fraction_in_wave()
    monkeypatch.setattr(sys.modules["tetopt.start.sums"], "sampled_noise", lambda *sample: 0.0)
    assert known > 0.75
    assert fraction_in_wave() < 0.7


def test_noise_alone_gets_a_uniform_mesh():
    """Two sizes of blocks at most, and as many nodes in each half of the box."""
    image = IMAGES["noise only"][0]
    mesh = octree_mesh(image, 1500)
    volume = np.abs(np.linalg.det(mesh.points[mesh.cells[:, 1:]] - mesh.points[mesh.cells[:, :1]]))
    # 8 times for a level; a block's corner is cut into unequal cells
    assert volume.max() < 17.0 * np.median(volume)
    halves = (image.to_index(mesh.points) < 19.5).mean(axis=0)
    assert (np.abs(halves - 0.5) < 0.1).all()


@pytest.mark.parametrize("shape", [(60, 60), (40, 40, 40)])
@pytest.mark.parametrize("sigma", [0.5, 5.0])
def test_noise_level(shape, sigma):
    """Found within 8 %, beside structure ten times as strong, and with a background cut out."""
    rng = np.random.default_rng(3)
    structure = 10.0 * sigma * np.sin(grid(shape).sum(-1) / 6.0)
    noisy = structure + rng.normal(0.0, sigma, shape)
    assert noise_level(noisy) == pytest.approx(sigma, rel=0.08)
    noisy[: shape[0] // 2] = 0.0
    assert noise_level(noisy) == pytest.approx(sigma, rel=0.08)
    assert noise_level(np.zeros(shape)) == 0.0
    fine = ndimage.gaussian_filter(rng.normal(size=shape), 1.5)
    assert noise_level(np.round(fine / fine.std())) == 0.0  # labels


@pytest.mark.parametrize(
    ("shape", "nodes", "words"),
    [
        ((30, 30, 30), 3, "9 or more in 3-D, got 3"),
        ((30, 30, 30), 500_000, "too many for 30 x 30 x 30 voxels; use at most 27000$"),
        ((200, 2, 2), 10, "too few for 200 x 2 x 2 voxels; the nearest octree found has 89"),
    ],
)
def test_impossible_numbers_of_nodes(shape, nodes, words):
    with pytest.raises(tetopt.InputError, match=words):
        octree_mesh(ball(*shape), nodes)
    with pytest.raises(TypeError, match="nodes: expected a whole number, got"):
        octree_mesh(ball(*shape), nodes + 0.5)


@pytest.mark.full
@pytest.mark.parametrize("nodes", [50, 1500])
@pytest.mark.parametrize("kind", ["ball", "constant", "noise", "voxel"])
def test_every_number_of_nodes(kind, nodes):
    """Where many blocks are alike, too: a ball in the middle, nothing, noise, one bright voxel."""
    shape = (32, 32, 32)
    data = {
        "ball": 100.0 * (((grid(shape) - 15.5) ** 2).sum(-1) < 81),
        "constant": np.ones(shape),
        "noise": np.random.default_rng(0).normal(size=shape),
        "voxel": np.where((grid(shape) == 9).all(-1), 50.0, 0.0),
    }[kind]
    count = len(octree_mesh(tetopt.Image(data), nodes).points)
    assert abs(count - nodes) <= max(0.07 * nodes, 30)


@pytest.mark.parametrize("scale", [1e-150, 1e-30, 1e100])
def test_scale_of_intensities(scale):
    image = ball(30, 30, 30, noise=3.0)
    expected = octree_mesh(image, 800).points
    assert_array_equal(octree_mesh(tetopt.Image(image.data * scale), 800).points, expected)


def test_intensities_that_overflow():
    with pytest.raises(tetopt.InputError, match="overflow"):
        octree_mesh(tetopt.Image(ball(30, 30, 30, noise=1.0).data * 1e200), 800)


@pytest.mark.full
def test_same_bits_for_any_number_of_threads():
    image = ball(48, 40, 44, noise=3.0)
    threads = numba.get_num_threads()
    results = []
    try:
        for count in {1, min(2, numba.config.NUMBA_NUM_THREADS)}:
            numba.set_num_threads(count)
            results.append(tetopt.mesh_image(image, 1500, iterations=4).mesh)
    finally:
        numba.set_num_threads(threads)
    for other in results[1:]:
        assert_array_equal(other.points, results[0].points)
        assert_array_equal(other.cells, results[0].cells)


def test_a_bound_beyond_all_boxes_bounds_nothing():
    """Its cube overflows, which is no error and no warning: the mesh is that under a bound that
    just holds the box.
    """
    image = tetopt.Image(np.random.default_rng(1).normal(size=(6, 6, 6)))
    meshes = [
        tetopt.mesh_image(image, 50, iterations=0, sizes=tetopt.Sizes(longest=mm)).mesh
        for mm in (1e3, 1e300)
    ]
    assert_array_equal(meshes[0].points, meshes[1].points)


def shell(size, radius):
    """A mask of a sphere's wall of two voxels."""
    off = np.abs(np.linalg.norm(grid((size, size, size)) - 0.5 * (size - 1), axis=-1) - radius)
    mask = tetopt.Image(1.0 * (off < 1.0))
    return tetopt.content(mask, mask=mask)


def lost(content, mesh):
    return lost_fraction(mesh, content.image, content.region)


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
    result = tetopt.mesh_image(content, nodes=500)
    assert len(result.mesh.points) == 500
    assert result.mesh.cell_volumes.sum() == pytest.approx(ideal, rel=0.015)
    assert result.violated == {}


def test_facets_across_a_torn_wall_do_not_make_up_for_it(monkeypatch):
    """Those of a torn tube lie deep in its wall, as if they cut off what is torn."""
    along = grid((60, 60, 60)) - 29.5
    is_wall = np.abs(np.linalg.norm(along[..., :2], axis=-1) - 20.0) < 2.5
    mask = tetopt.Image(1.0 * (is_wall & (np.abs(along[..., 2]) < 25.0)))
    content = tetopt.content(mask, mask=mask)
    assert octree_mesh(content, 1500).cell_volumes.sum() == pytest.approx(mask.data.sum(), rel=0.02)
    monkeypatch.setattr(octree, "FINER_STEPS", 0)
    torn = octree_mesh(content, 1500)
    missing = 1.0 - torn.cell_volumes.sum() / mask.data.sum()
    assert 0.1 < missing < lost(content, torn) + 0.05  # some facets cross it obliquely


def test_one_octree_that_loses_more_by_chance_does_not_end_the_search():
    """Of this tube, the third octree loses more than the second, the fourth next to nothing."""
    along = grid((60, 60, 60)) - 30.0
    is_wall = np.abs(np.linalg.norm(along[..., :2], axis=-1) - 20.0) < 1.5
    mask = tetopt.Image(1.0 * (is_wall & (np.abs(along[..., 2]) < 25.0)))
    mesh = octree_mesh(tetopt.content(mask, mask=mask), 1500)
    assert mesh.cell_volumes.sum() == pytest.approx(mask.data.sum(), rel=0.02)


@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_facets_of_a_ball_cut_off_what_it_lacks(monkeypatch, sigma):
    """Also of a blurred one, whose level rises by an eighth per voxel, not by 1, so that depths
    count for less.
    """
    monkeypatch.setattr(octree, "FINER_STEPS", 0)
    ball = np.linalg.norm(grid((40, 40, 40)) - 19.5, axis=-1) < 14.0
    mask = tetopt.Image(ndimage.gaussian_filter(1.0 * ball, sigma))
    content = tetopt.content(mask, mask=mask)
    mesh = octree_mesh(content, 300)
    assert lost(content, mesh) < 0.9 * (1.0 - mesh.cell_volumes.sum() / content.region.inside.sum())


def test_a_wall_that_no_octree_keeps_has_the_one_that_loses_least():
    """Nearly all would be lost with the requested nodes; twice as many keep it."""
    content = shell(34, 13.0)
    assert octree.MOST_LOST < lost(content, octree_mesh(content, 300)) < 0.06
    assert lost(content, octree_mesh(content, 600)) < octree.MOST_LOST


def test_a_mask_that_finer_octrees_hardly_keep_better_has_the_nearest_number_of_nodes(monkeypatch):
    content = shell(60, 25.0)
    monkeypatch.setattr(octree, "FINER_STEPS", 2)
    mesh = octree_mesh(content, 300)
    monkeypatch.setattr(octree, "FINER_STEPS", 0)
    assert_array_equal(mesh.points, octree_mesh(content, 300).points)


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

        monkeypatch.setattr(octree, "check_memory", short)
        with pytest.raises(budget.MemoryShortage):
            octree_mesh(content, 200)
    monkeypatch.setattr(octree, "check_memory", budget.check_memory)
    most = int(max(needs))
    monkeypatch.setattr(budget, "available_bytes", lambda: most - 1)
    with pytest.raises(tetopt.InputError, match=r"octree: .* of memory, but only"):
        octree_mesh(content, 200)
    for free in (most + 1, 2 * most):
        monkeypatch.setattr(budget, "available_bytes", lambda free=free: free)
        mesh = octree_mesh(content, 200)
        assert mesh.points.tobytes() == expected.points.tobytes()
        assert mesh.cells.tobytes() == expected.cells.tobytes()


def test_a_run_that_loses_a_wall_asks_for_more_nodes(monkeypatch):
    monkeypatch.setattr(octree, "FINER_STEPS", 1)
    result = tetopt.mesh_image(shell(26, 9.0), nodes=300, iterations=0)
    assert result.violated["mask"].endswith("allow more nodes")
