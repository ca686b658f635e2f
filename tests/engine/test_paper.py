"""The paper's optimisation: its laws on phantoms and real data, its options, its error messages."""

import sys

import naive
import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay
from states import CASES, ball

import tetopt
from tetopt.energy.sampling import sampling_grid, to_ticks
from tetopt.engine.loop import frozen_axes, side_ticks
from tetopt.engine.paper import default_n_t, optimize_paper
from tetopt.geometry.simplex import orient_cells, rho, volumes
from tetopt.geometry.topology import boundary_facets, facets, stars
from tetopt.start.delaunay import delaunay


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("retessellate", ["first", "accept", "never"])
def test_mappings(name, retessellate):
    """Every iteration holds every voxel; E never rises on a fixed connectivity, nor at all with
    "accept".
    """
    image, blocks = CASES[name]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    result = optimize_paper(image, mesh, k_D=0.3, iterations=8, n_t=4, retessellate=retessellate)
    assert tetopt.check_mesh(result.mesh, image) == []
    assert {row.n_voxels for row in result.history} == {image.data.size}
    for before, after in zip(result.history, result.history[1:], strict=False):
        if retessellate != "first" or not after.is_retessellated:
            assert after.E <= before.E * (1.0 + 1e-12)
    assert result.history[-1].E < 0.99
    assert any(row.is_retessellated for row in result.history) <= (retessellate != "never")
    if retessellate == "never":
        assert_array_equal(result.mesh.cells, mesh.cells)


def test_history_holds_the_energies_of_the_mesh():
    """The running totals of the last row are those of the returned mesh, measured afresh; the
    callback sees all.
    """
    image, blocks = CASES["oblique"]
    seen = []
    result = optimize_paper(
        image,
        tetopt.lattice_mesh(image, blocks=blocks),
        k_D=0.4,
        iterations=5,
        callback=seen.append,
    )
    assert seen == result.history
    last, first = result.history[-1], result.history[0]
    assert last.E_G == pytest.approx(tetopt.E_G(result.mesh.points, result.mesh.cells), rel=1e-9)
    assert last.E_D == pytest.approx(tetopt.E_D(image, result.mesh), rel=1e-9)
    assert first.E == pytest.approx(1.0, rel=1e-14)
    assert last.E == pytest.approx(
        0.6 * last.E_G / first.E_G + 0.4 * last.E_D / first.E_D, rel=1e-12
    )
    assert last.n_cells == len(result.mesh.cells)


def test_the_image_pulls_the_mesh():
    """More weight for the image leaves less E_D and no less E_G; without weight E_D is not
    looked at.
    """
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    runs = [
        optimize_paper(image, mesh, k_D=k_D, iterations=10, retessellate="never")
        for k_D in (0.0, 0.05, 0.3, 0.8)
    ]
    E_D = [run.history[-1].E_D / run.history[0].E_D for run in runs]
    E_G = [run.history[-1].E_G / run.history[0].E_G for run in runs]
    assert E_D == sorted(E_D, reverse=True)
    assert E_G == sorted(E_G)
    assert E_D[2] < 0.7 < E_D[0]


def test_lloyd_reaches_a_stationary_mesh():
    """At k_D = 0, connectivity fixed, the gradient of E_G along the directions that are free
    goes to 0.
    """
    image, blocks = CASES["oblique"]
    n = image.ndim
    rng = np.random.default_rng(3)
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    grid = sampling_grid(image, mesh.points)
    ticks = to_ticks(image.to_index(mesh.points), grid)
    frozen = frozen_axes(ticks, boundary_facets(mesh.cells), side_ticks(grid), "slide", False)[
        :, 3 - n : 3
    ]
    step = 0.12 * np.array(image.shape) / np.array(blocks)
    start = image.to_world(
        image.to_index(mesh.points) + ~frozen * rng.uniform(-step, step, mesh.points.shape)
    )
    mesh = tetopt.Mesh(start, mesh.cells)
    result = optimize_paper(
        image, mesh, k_D=0.0, iterations=300, retessellate="never", tolerance=1e-7
    )
    assert result.ended == "converged"
    along = [
        np.where(frozen, 0.0, naive.E_G_gradient(p, mesh.cells) @ image.affine[:-1, :-1])
        for p in (start, result.mesh.points)
    ]
    assert np.abs(along[1]).max() < 2e-4 * np.abs(along[0]).max()


def test_lloyd_moves_to_the_weighted_circumcentre():
    """One interior node: the volume-weighted mean of its star's circumcentres, in one step
    (Section 2.1).
    """
    image = tetopt.Image(np.zeros((8, 8, 8)) + np.arange(8))
    corner = np.array(np.meshgrid([-0.5, 7.5], [-0.5, 7.5], [-0.5, 7.5])).reshape(3, -1).T
    points = np.vstack([corner, [2.0, 3.1, 4.7]])
    cells = Delaunay(points).simplices
    cells = orient_cells(points, cells[np.abs(volumes(points, cells)) > 1e-9])
    star = cells[stars(cells, 9).cells[stars(cells, 9).start[8] :]]
    v = volumes(points, star)
    expected = (v[:, None] * naive.circumcentres(points, star)).sum(0) / v.sum()
    result = optimize_paper(
        image,
        tetopt.Mesh(points, cells),
        k_D=0.0,
        iterations=1,
        retessellate="never",
        boundary="fixed",
    )
    assert_allclose(result.mesh.points[8], expected, atol=1e-6)


@pytest.mark.parametrize("boundary", ["slide", "fixed"])
def test_boundary_nodes(boundary):
    """Fixed: none moves. Slide: each keeps the coordinates across its faces, corners keep all,
    some do move.
    """
    image, blocks = CASES["oblique"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    result = optimize_paper(
        image, mesh, k_D=0.5, iterations=4, retessellate="never", boundary=boundary
    )
    before, after = image.to_index(mesh.points), image.to_index(result.mesh.points)
    outer = np.unique(boundary_facets(mesh.cells))
    if boundary == "fixed":
        assert_allclose(after[outer], before[outer], atol=1e-6)
        return
    is_on_face = np.isclose(before, -0.5) | np.isclose(before, np.array(image.shape) - 0.5)
    assert_allclose(after[is_on_face], before[is_on_face], atol=1e-9)
    assert np.abs(after[outer] - before[outer]).max() > 0.1


def test_nodes_inside_the_box_on_a_free_boundary_stay():
    """A mesh that ends inside the image keeps its boundary, sliding or not; it is not connected
    anew.
    """
    image = ball((24, 20, 22))
    small = tetopt.lattice_mesh(
        tetopt.Image(np.zeros((10, 10, 10)) + np.arange(10), np.eye(4)), blocks=(3, 3, 3)
    )
    mesh = tetopt.Mesh(small.points + 6.0, small.cells)
    result = optimize_paper(image, mesh, k_D=0.5, iterations=3, retessellate="never")
    outer = np.unique(boundary_facets(mesh.cells))
    assert_allclose(result.mesh.points[outer], mesh.points[outer], atol=1e-6)
    assert result.history[-1].E < result.history[0].E
    with pytest.raises(tetopt.InputError, match=r"fills the image's box exactly.*never"):
        optimize_paper(image, mesh, k_D=0.5, iterations=3)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads to compare")
@pytest.mark.full
def test_same_bits_on_one_and_two_threads():
    image = ball((40, 44, 36))
    mesh = tetopt.lattice_mesh(image, nodes=1500)
    results = []
    for threads in (1, 2, 2):
        numba.set_num_threads(threads)
        results.append(optimize_paper(image, mesh, k_D=0.3, iterations=4))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    for other in results[1:]:
        assert other.mesh.points.tobytes() == results[0].mesh.points.tobytes()
        assert other.mesh.cells.tobytes() == results[0].mesh.cells.tobytes()
        assert [row[:-1] for row in other.history] == [row[:-1] for row in results[0].history]


def test_turned_world_turned_mesh():
    """The same image in another place and attitude gives the same mesh there: rotate, run,
    rotate back.
    """
    shape, blocks = (24, 20, 22), (4, 3, 4)
    angle = 0.6
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:3, 3] = (40.0, -25.0, 10.0)
    plain = ball(shape)
    turned = ball(shape, turn)
    results = [
        optimize_paper(i, tetopt.lattice_mesh(i, blocks=blocks), k_D=0.3, iterations=6)
        for i in (plain, turned)
    ]
    assert_allclose(turned.to_index(results[1].mesh.points), results[0].mesh.points, atol=1e-3)
    assert results[1].history[-1].E == pytest.approx(results[0].history[-1].E, rel=1e-6)


def test_scaled_world_scaled_mesh():
    """Twice the voxel size and half the contrast: the same normalised energies, a mesh twice as
    large.
    """
    shape, blocks = (24, 20, 22), (4, 3, 4)
    plain = ball(shape)
    scaled = tetopt.Image(plain.data * 0.5, np.diag([2.0, 2.0, 2.0, 1.0]))
    results = [
        optimize_paper(i, tetopt.lattice_mesh(i, blocks=blocks), k_D=0.3, iterations=6)
        for i in (plain, scaled)
    ]
    assert_allclose(results[1].mesh.points, 2.0 * results[0].mesh.points, atol=1e-4)
    assert results[1].history[-1].E == pytest.approx(results[0].history[-1].E, rel=1e-9)
    assert results[1].history[-1].E_G == pytest.approx(
        2.0**5 * results[0].history[-1].E_G, rel=1e-9
    )


def test_constant_image():
    """E_D is 0 all the way, and only the shapes move the nodes."""
    image = tetopt.Image(np.full((12, 12, 12), 20.1))
    result = optimize_paper(
        image, tetopt.lattice_mesh(image, blocks=(3, 3, 3)), k_D=0.5, iterations=3
    )
    assert [row.E_D for row in result.history] == [0.0] * len(result.history)
    assert result.history[0].E == 0.5
    assert result.history[-1].E <= 0.5


def test_converges():
    """It stops by itself once the nodes move less than the tolerance."""
    image, blocks = CASES["2-D"]
    result = optimize_paper(
        image,
        tetopt.lattice_mesh(image, blocks=blocks),
        k_D=0.2,
        iterations=500,
        n_t=5,
        tolerance=1e-4,
    )
    assert result.ended == "converged"
    assert len(result.history) < 500
    assert result.history[-1].movement < 1e-4 <= result.history[-2].movement


def test_retessellation_ends_after_n_t():
    image, blocks = CASES["3-D"]
    result = optimize_paper(
        image, tetopt.lattice_mesh(image, blocks=blocks), k_D=0.5, iterations=8, n_t=3
    )
    anew = [row.iteration for row in result.history if row.is_retessellated]
    assert anew
    assert max(anew) <= 3


def test_ended_early_with_a_valid_mesh():
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    result = optimize_paper(image, mesh, k_D=0.3, iterations=1000, max_seconds=1e-6)
    assert result.ended == "max_seconds"
    assert len(result.history) == 2
    assert tetopt.check_mesh(result.mesh, image) == []


def test_stopped_in_the_middle_of_a_sweep():
    """Between two colours: some nodes have moved, and the mesh and its history are whole."""
    image, blocks = CASES["3-D"]
    asked = []
    result = optimize_paper(
        image,
        tetopt.lattice_mesh(image, blocks=blocks),
        k_D=0.3,
        iterations=50,
        stop=lambda: asked.append(1) or len(asked) > 2,
    )
    assert result.ended == "stopped"
    assert result.history[-1].movement > 0.0
    assert tetopt.check_mesh(result.mesh, image) == []
    assert result.history[-1].E_D == pytest.approx(tetopt.E_D(image, result.mesh), rel=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"k_D": 1.0}, r"k_D: expected 0 <= k_D < 1, got 1.0"),
        ({"k_D": float("nan")}, r"k_D: expected 0 <= k_D < 1, got nan"),
        ({"iterations": -1}, r"iterations: expected 0 or more, got -1"),
        ({"n_t": -1}, r"n_t: expected 0 or more, got -1"),
        ({"retessellate": "often"}, r"retessellate: expected first, accept or never, got 'often'"),
        ({"boundary": "open"}, r"boundary: expected slide or fixed, got 'open'"),
        ({"step_ratio": 0.0}, r"step_ratio: expected a number between 0 and 1, got 0.0"),
    ],
)
def test_bad_options(options, words):
    image, blocks = CASES["2-D"]
    with pytest.raises(tetopt.InputError, match=words):
        optimize_paper(image, tetopt.lattice_mesh(image, blocks=blocks), **options)


def test_dimensions_must_agree():
    with pytest.raises(tetopt.InputError, match="same dimension, got a 2-D mesh and a 3-D image"):
        optimize_paper(CASES["3-D"][0], tetopt.lattice_mesh(CASES["2-D"][0], blocks=(2, 2)))


@pytest.mark.full
def test_real_volume(data_dir):
    """Laws on the MNI152 T1: every voxel in one cell after every iteration, E never rises, E_D
    falls well.
    """
    image = tetopt.load_image(data_dir / "mni_icbm152_t1_tal_nlin_sym_09a_converted.nii.gz")
    result = optimize_paper(
        image, tetopt.lattice_mesh(image, nodes=1000), k_D=0.2, iterations=6, n_t=2
    )
    assert {row.n_voxels for row in result.history} == {image.data.size}
    for before, after in zip(result.history, result.history[1:], strict=False):
        if not after.is_retessellated:
            assert after.E <= before.E * (1.0 + 1e-12)
    assert result.history[-1].E_D < 0.55 * result.history[0].E_D
    assert rho(result.mesh.points, result.mesh.cells).mean() > 0.285
    assert tetopt.check_mesh(result.mesh, image) == []


@pytest.mark.full
@pytest.mark.parametrize("name", ["prostate_t2_tra_prostatex0001.nii.gz", "ct_abdomen_3mm.nii.gz"])
def test_real_oblique_and_anisotropic(data_dir, name):
    """An oblique prostate, a CT with negative values: the same laws in world millimetres."""
    image = tetopt.load_image(data_dir / name)
    result = optimize_paper(
        image, tetopt.lattice_mesh(image, nodes=800), k_D=0.3, iterations=2, n_t=1
    )
    assert {row.n_voxels for row in result.history} == {image.data.size}
    assert result.history[-1].E_D < 0.9 * result.history[0].E_D
    assert tetopt.check_mesh(result.mesh, image) == []


# After a hostile review.


def test_rounding_is_no_unit_of_E_D():
    """Every cell uniform, but of fractions that leave rounding in the sums: E_D0 is 0, as it is
    for whole numbers.
    """
    data = np.where(np.arange(12) < 6, 0.1, 0.7)[:, None, None] * np.ones((12, 12, 12))
    histories = []
    for values in (data, np.where(data > 0.5, 7.0, 1.0)):
        image = tetopt.Image(values)
        histories.append(
            optimize_paper(
                image,
                tetopt.lattice_mesh(image, "five-tet", blocks=(2, 2, 2)),
                k_D=0.2,
                iterations=4,
            ).history
        )
    for fractions, whole in zip(*histories, strict=True):
        assert fractions.E == pytest.approx(whole.E, rel=1e-9)
    assert histories[0][0].E_D == 0.0
    assert histories[0][0].E == 0.8


def test_accept_takes_what_lowers_E():
    """Moved nodes, connected as before, are not Delaunay: "accept" takes Delaunay's cells where
    "never" may not.
    """
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, "five-tet", blocks=blocks)
    result = optimize_paper(image, mesh, k_D=0.05, iterations=6, retessellate="accept")
    taken = [row.iteration for row in result.history if row.is_retessellated]
    assert taken
    assert (
        result.history[-1].E
        < optimize_paper(image, mesh, k_D=0.05, iterations=6, retessellate="never").history[-1].E
    )


def test_accept_needs_a_full_box_for_any_n_t():
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    inner = np.flatnonzero(
        ~np.isin(
            np.arange(len(mesh.cells)), facets(mesh.cells).cells[facets(mesh.cells).n_cells == 1, 0]
        )
    )
    holed = tetopt.Mesh(mesh.points, np.delete(mesh.cells, inner[0], axis=0))
    for n_t in (0, 3):
        with pytest.raises(tetopt.InputError, match="fills the image's box exactly"):
            optimize_paper(image, holed, iterations=2, retessellate="accept", n_t=n_t)


def test_doubled_and_overlapping_cells_are_refused():
    """Each cell twice; two triangles on the same side of an edge."""
    image, blocks = CASES["2-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    doubled = tetopt.Mesh(mesh.points, np.vstack([mesh.cells, mesh.cells]))
    folded = tetopt.Mesh(
        [[2.0, 2.0], [30.0, 2.0], [10.0, 20.0], [20.0, 20.0]], [[0, 1, 2], [0, 1, 3]]
    )
    for spoiled in (doubled, folded):
        with pytest.raises(tetopt.InputError, match="facets cells overlap"):
            optimize_paper(image, spoiled, iterations=1, retessellate="never")


def missing_cell(cells):
    return cells[1:]


def doubled_cell(cells):
    return np.vstack([cells, cells[:1]])


def turned_cell(cells):
    return np.vstack([cells[:1, [1, 0, *range(2, cells.shape[1])]], cells[1:]])


@pytest.mark.parametrize("spoil", [missing_cell, doubled_cell, turned_cell])
def test_spoiled_tessellations_are_not_taken(spoil, monkeypatch):
    """Delaunay cells with one left out, one twice or one turned: the old connectivity is kept."""
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    good = delaunay(image.to_index(mesh.points), image.affine)
    monkeypatch.setattr(sys.modules["tetopt.engine.paper"], "delaunay", lambda *_: spoil(good))
    result = optimize_paper(image, mesh, k_D=0.3, iterations=1, n_t=1)
    assert_array_equal(result.mesh.cells, mesh.cells)
    assert not any(row.is_retessellated for row in result.history)
    monkeypatch.setattr(sys.modules["tetopt.engine.paper"], "delaunay", lambda *_: good[::-1])
    assert_array_equal(
        optimize_paper(image, mesh, k_D=0.3, iterations=1, n_t=1).mesh.cells, good[::-1]
    )


def test_flat_cells_are_left_but_not_made(monkeypatch):
    """A mesh with a flat triangle is improved by moving its nodes; a tessellation that has one
    is not taken.
    """
    points = np.array([[-0.5, -0.5], [11.5, -0.5], [11.5, 11.5], [-0.5, 11.5], [5.5, -0.499997]])
    image, mesh = ball((12, 12)), tetopt.Mesh(points, [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    monkeypatch.setattr(sys.modules["tetopt.engine.paper"], "delaunay", lambda *_: mesh.cells[::-1])
    result = optimize_paper(image, mesh, k_D=0.0, iterations=1, n_t=1)
    assert_array_equal(result.mesh.cells, mesh.cells)
    assert not result.history[1].is_retessellated
    assert_allclose(result.mesh.points[4], [5.5, 5.5], atol=1e-5)


def test_step_length_is_a_ratio_of_the_nearest_centroid():
    """One free node in a square of four triangles, pushed along one axis only: it moves by the step
    or the parabola's part of it, never further, and the step is the ratio times the distance to the
    nearest of the four centroids.
    """
    size = 30
    edge = tetopt.Image(np.where(np.arange(size)[:, None] < 18, 0.0, 100.0) * np.ones((size, size)))
    points = np.array([[-0.5, -0.5], [29.5, -0.5], [29.5, 29.5], [-0.5, 29.5], [10.0, 14.5]])
    mesh = tetopt.Mesh(points, [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    nearest = np.linalg.norm(points[mesh.cells].mean(axis=1) - points[4], axis=1).min()
    for ratio in (0.1, 0.3):
        result = optimize_paper(
            edge,
            mesh,
            k_D=0.95,
            iterations=1,
            retessellate="never",
            boundary="fixed",
            step_ratio=ratio,
        )
        moved = result.mesh.points[4] - points[4]
        assert moved[0] == pytest.approx(ratio * nearest, abs=1e-5)


def test_default_n_t():
    """All iterations for Lloyd's alternation, half of them, rounded up, with an image; as with
    the number given.
    """
    assert [default_n_t(0.0, 7), default_n_t(0.2, 7), default_n_t(0.2, 6), default_n_t(0.2, 0)] == [
        7,
        4,
        3,
        0,
    ]
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    plain, given = (
        optimize_paper(image, mesh, k_D=0.4, iterations=6),
        optimize_paper(image, mesh, k_D=0.4, iterations=6, n_t=3),
    )
    assert [row[:-1] for row in plain.history] == [row[:-1] for row in given.history]


def test_movement_is_measured_from_the_middle_of_the_box():
    """|x^t - x^(t-1)| / |x^(t-1)|, so the same wherever the image lies in the world."""
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    result = optimize_paper(image, mesh, k_D=0.4, iterations=1, retessellate="never")
    middle = image.to_world((np.array(image.shape) - 1.0) / 2.0)
    moved = np.linalg.norm(result.mesh.points - mesh.points)
    assert result.history[1].movement == pytest.approx(
        moved / np.linalg.norm(mesh.points - middle), rel=1e-5
    )
