"""The paper's optimisation: its laws on phantoms and real data, its options, its error messages."""

import sys
from functools import partial
from itertools import pairwise

import naive
import numpy as np
import pytest
from meshes import box_corners
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay
from states import CASES, ball, on_lattice

import tetopt
from tetopt import Image, InputError, Mesh, check_mesh, lattice_mesh
from tetopt.energy.sampling import sampling_grid, to_ticks
from tetopt.engine.loop import frozen_axes, side_ticks
from tetopt.engine.paper import default_n_t, optimize_paper
from tetopt.geometry.simplex import orient_cells, rho, volumes
from tetopt.geometry.topology import boundary_facets, facets
from tetopt.start.delaunay import delaunay

one_step = partial(optimize_paper, iterations=1, retessellate="never")


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("retessellate", ["first", "accept", "never"])
def test_mappings(name, retessellate):
    """Every iteration holds every voxel; E never rises on a fixed connectivity, nor at all with
    "accept"; that of the first 4 iterations changes, if any does.
    """
    image, mesh = CASES[name]
    result = optimize_paper(image, mesh, k_D=0.3, iterations=8, n_t=4, retessellate=retessellate)
    assert check_mesh(result.mesh, image) == []
    assert_laws(result, image, retessellate == "accept")
    assert result.history[-1].E < 0.99
    anew = [row.iteration for row in result.history if row.is_retessellated]
    if retessellate == "never":
        assert anew == []
        assert_array_equal(result.mesh.cells, mesh.cells)
    elif (name, retessellate) == ("3-D", "first"):
        assert anew
    if retessellate == "first":
        assert max(anew, default=0) <= 4


def assert_laws(result, image, always_falls=False):
    assert {row.n_voxels for row in result.history} == {image.data.size}
    for before, after in pairwise(result.history):
        if always_falls or not after.is_retessellated:
            assert after.E <= before.E * (1.0 + 1e-12)


def test_history_holds_the_energies_of_the_mesh():
    """The running totals of the last row are those of the returned mesh, measured afresh; the
    callback sees all.
    """
    image, mesh = CASES["oblique"]
    seen = []
    result = optimize_paper(image, mesh, k_D=0.4, iterations=5, callback=seen.append)
    assert seen == result.history
    first, last, mesh = result.history[0], result.history[-1], result.mesh
    assert last.E_G == pytest.approx(tetopt.E_G(mesh.points, mesh.cells), rel=1e-9)
    assert last.E_D == pytest.approx(tetopt.E_D(image, mesh), rel=1e-9)
    assert first.E == pytest.approx(1.0, rel=1e-14)
    E = 0.6 * last.E_G / first.E_G + 0.4 * last.E_D / first.E_D
    assert last.E == pytest.approx(E, rel=1e-12)
    assert last.n_cells == len(mesh.cells)


def test_the_image_pulls_the_mesh():
    """More weight for the image leaves less E_D and no less E_G; without weight E_D is not
    looked at.
    """
    run = partial(optimize_paper, *CASES["3-D"], iterations=10, retessellate="never")
    ends = [run(k_D=k_D).history for k_D in (0.0, 0.05, 0.3, 0.8)]
    E_D = [rows[-1].E_D / rows[0].E_D for rows in ends]
    E_G = [rows[-1].E_G / rows[0].E_G for rows in ends]
    assert E_D == sorted(E_D, reverse=True)
    assert E_G == sorted(E_G)
    assert E_D[2] < 0.7 < E_D[0]


def test_lloyd_reaches_a_stationary_mesh():
    """At k_D = 0, connectivity fixed, the gradient of E_G along the directions that are free
    goes to 0.
    """
    image, mesh = CASES["oblique"]
    index = image.to_index(mesh.points)
    grid = sampling_grid(image, mesh.points)
    frozen = frozen_axes(
        to_ticks(index, grid), boundary_facets(mesh.cells), side_ticks(grid), "slide", False
    )[:, :3]
    step = 0.12 * np.array(image.shape) / 4
    moves = np.random.default_rng(3).uniform(-step, step, index.shape)
    start = Mesh(image.to_world(index + ~frozen * moves), mesh.cells)
    result = optimize_paper(
        image, start, k_D=0.0, iterations=300, retessellate="never", tolerance=1e-7
    )
    assert result.ended == "converged"
    before, after = (
        np.abs(naive.E_G_gradient(each.points, mesh.cells) @ image.affine[:-1, :-1])[~frozen].max()
        for each in (start, result.mesh)
    )
    assert after < 2e-4 * before


def test_lloyd_moves_to_the_weighted_circumcentre():
    """One interior node: the volume-weighted mean of its star's circumcentres, in one step
    (Section 2.1).
    """
    image = Image(np.zeros((8, 8, 8)) + np.arange(8))
    points = np.vstack([box_corners(image.shape), [2.0, 3.1, 4.7]])
    cells = Delaunay(points).simplices
    cells = orient_cells(points, cells[np.abs(volumes(points, cells)) > 1e-9])
    star = cells[(cells == 8).any(axis=1)]
    v = volumes(points, star)
    expected = (v[:, None] * naive.circumcentres(points, star)).sum(0) / v.sum()
    result = one_step(image, Mesh(points, cells), k_D=0.0, boundary="fixed")
    assert_allclose(result.mesh.points[8], expected, atol=1e-6)


@pytest.mark.parametrize("boundary", ["slide", "fixed"])
def test_boundary_nodes(boundary):
    """Fixed: none moves. Slide: each keeps the coordinates across its faces, corners keep all,
    some do move.
    """
    image, mesh = CASES["oblique"]
    result = optimize_paper(
        image, mesh, k_D=0.5, iterations=4, retessellate="never", boundary=boundary
    )
    before, after = image.to_index(mesh.points), image.to_index(result.mesh.points)
    outer = np.unique(boundary_facets(mesh.cells))
    if boundary == "fixed":
        assert_allclose(after[outer], before[outer], atol=1e-6)
    else:
        is_on_face = np.isclose(before, -0.5) | np.isclose(before, np.array(image.shape) - 0.5)
        assert_allclose(after[is_on_face], before[is_on_face], atol=1e-9)
        assert np.abs(after[outer] - before[outer]).max() > 0.1


def test_nodes_inside_the_box_on_a_free_boundary_stay():
    """A mesh that ends inside the image keeps its boundary, sliding or not; it is not connected
    anew.
    """
    image = ball((24, 20, 22))
    small = lattice_mesh(Image(np.zeros((10, 10, 10))), blocks=(3, 3, 3))
    mesh = Mesh(small.points + 6.0, small.cells)
    run = partial(optimize_paper, image, mesh, k_D=0.5, iterations=3)
    result = run(retessellate="never")
    outer = np.unique(boundary_facets(mesh.cells))
    assert_allclose(result.mesh.points[outer], mesh.points[outer], atol=1e-6)
    assert result.history[-1].E < result.history[0].E
    with pytest.raises(InputError, match="never"):
        run()


def test_the_world_does_not_matter():
    """The same image in another place and attitude gives the same mesh there. Twice the voxel size
    and half the contrast: the same normalised energies, a mesh twice as large.
    """
    c, s = np.cos(0.6), np.sin(0.6)
    turn = np.array([[c, -s, 0, 40.0], [s, c, 0, -25.0], [0, 0, 1, 10.0], [0, 0, 0, 1]])
    plain = CASES["3-D"][0]
    turned = Image(plain.data, turn)
    scaled = Image(plain.data * 0.5, np.diag([2.0, 2.0, 2.0, 1.0]))
    own, of_turned, of_scaled = (
        optimize_paper(*on_lattice(image, 4, 3, 4), k_D=0.3, iterations=6)
        for image in (plain, turned, scaled)
    )
    assert_allclose(turned.to_index(of_turned.mesh.points), own.mesh.points, atol=1e-3)
    assert_allclose(of_scaled.mesh.points, 2.0 * own.mesh.points, atol=1e-4)
    E, E_G = own.history[-1].E, own.history[-1].E_G
    assert of_turned.history[-1].E == pytest.approx(E, rel=1e-6)
    assert of_scaled.history[-1].E == pytest.approx(E, rel=1e-9)
    assert of_scaled.history[-1].E_G == pytest.approx(2.0**5 * E_G, rel=1e-9)


def test_constant_image():
    """E_D is 0 all the way, and only the shapes move the nodes."""
    case = on_lattice(Image(np.full((12, 12, 12), 20.1)), 3, 3, 3)
    history = optimize_paper(*case, k_D=0.5, iterations=3).history
    assert {row.E_D for row in history} == {0.0}
    assert history[0].E == 0.5 >= history[-1].E


def test_converges():
    """It stops by itself once the nodes move less than the tolerance."""
    result = optimize_paper(*CASES["2-D"], k_D=0.2, iterations=500, n_t=5, tolerance=1e-4)
    assert result.ended == "converged"
    assert len(result.history) < 500
    assert result.history[-1].movement < 1e-4 <= result.history[-2].movement


def test_cut_short_in_the_middle_of_a_sweep():
    """Between two colours: some nodes have moved, and the mesh and its history are whole. Out of
    time: after one iteration.
    """
    image, mesh = CASES["3-D"]
    asked = []
    run = partial(optimize_paper, image, mesh, k_D=0.3, iterations=1000)
    stopped = run(stop=lambda: asked.append(1) or len(asked) > 2)
    late = run(max_seconds=1e-6)
    assert (stopped.ended, late.ended, len(late.history)) == ("stopped", "max_seconds", 2)
    assert stopped.history[-1].movement > 0.0
    for result in (stopped, late):
        assert check_mesh(result.mesh, image) == []
        E_D = tetopt.E_D(image, result.mesh)
        assert result.history[-1].E_D == pytest.approx(E_D, rel=1e-9)


def test_dimensions_must_agree():
    with pytest.raises(InputError, match="2-D mesh and a 3-D image"):
        optimize_paper(CASES["3-D"][0], CASES["2-D"][1])


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "nodes", "options", "falls_to"),
    [
        (
            "mni_icbm152_t1_tal_nlin_sym_09a_converted.nii.gz",
            1000,
            {"k_D": 0.2, "iterations": 6, "n_t": 2},
            0.55,
        ),
        (
            "prostate_t2_tra_prostatex0001.nii.gz",
            800,
            {"k_D": 0.3, "iterations": 2, "n_t": 1},
            0.9,
        ),
        ("ct_abdomen_3mm.nii.gz", 800, {"k_D": 0.3, "iterations": 2, "n_t": 1}, 0.9),
    ],
)
def test_real_volumes(data_dir, name, nodes, options, falls_to):
    """The MNI152 T1, an oblique prostate, a CT with negative values: the laws in world
    millimetres, E_D falls well, and cells keep their shapes.
    """
    image = tetopt.load_image(data_dir / name)
    result = optimize_paper(image, lattice_mesh(image, nodes=nodes), **options)
    assert_laws(result, image)
    assert result.history[-1].E_D < falls_to * result.history[0].E_D
    assert check_mesh(result.mesh, image) == []
    if nodes == 1000:
        assert rho(result.mesh.points, result.mesh.cells).mean() > 0.285


# After a hostile review.


def test_rounding_is_no_unit_of_E_D():
    """Every cell uniform, but of fractions that leave rounding in the sums: E_D0 is 0, as it is
    for whole numbers.
    """
    is_low = np.broadcast_to(np.arange(12)[:, None, None] < 6, (12, 12, 12))
    fractions, whole = (
        optimize_paper(
            image, lattice_mesh(image, "five-tet", blocks=(2, 2, 2)), k_D=0.2, iterations=4
        ).history
        for image in (Image(np.where(is_low, *values)) for values in ((0.1, 0.7), (1, 7)))
    )
    E = [row.E for row in whole]
    assert [row.E for row in fractions] == pytest.approx(E, rel=1e-9)
    assert (fractions[0].E_D, fractions[0].E) == (0.0, 0.8)


def test_accept_takes_what_lowers_E():
    """Moved nodes, connected as before, are not Delaunay: "accept" takes Delaunay's cells where
    "never" may not.
    """
    image = CASES["3-D"][0]
    mesh = lattice_mesh(image, "five-tet", blocks=(4, 3, 4))
    accept, never = (
        optimize_paper(image, mesh, k_D=0.05, iterations=6, retessellate=how).history
        for how in ("accept", "never")
    )
    assert any(row.is_retessellated for row in accept)
    assert accept[-1].E < never[-1].E


@pytest.mark.parametrize("n_t", [0, 3])
def test_accept_needs_a_full_box_for_any_n_t(n_t):
    image, mesh = CASES["3-D"]
    sides = facets(mesh.cells)
    inner = np.setdiff1d(np.arange(len(mesh.cells)), sides.cells[sides.n_cells == 1, 0])
    holed = Mesh(mesh.points, np.delete(mesh.cells, inner[0], axis=0))
    with pytest.raises(InputError, match="fills the image's box exactly"):
        optimize_paper(image, holed, iterations=2, retessellate="accept", n_t=n_t)


def test_doubled_and_overlapping_cells_are_refused():
    """Each cell twice; two triangles on the same side of an edge."""
    image, mesh = CASES["2-D"]
    folded = [[2.0, 2.0], [30.0, 2.0], [10.0, 20.0], [20.0, 20.0]], [[0, 1, 2], [0, 1, 3]]
    for spoiled in ((mesh.points, np.vstack([mesh.cells, mesh.cells])), folded):
        with pytest.raises(InputError, match="facets cells overlap"):
            one_step(image, Mesh(*spoiled))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda cells: cells[1:],
        lambda cells: np.vstack([cells, cells[:1]]),
        lambda cells: np.vstack([cells[:1, [1, 0, 2, 3]], cells[1:]]),
    ],
)
def test_spoiled_tessellations_are_not_taken(spoil, monkeypatch):
    """Delaunay cells with one left out, one twice or one turned: the old connectivity is kept."""
    image, mesh = CASES["3-D"]
    good = delaunay(image.to_index(mesh.points), image.affine)
    for cells, taken in ((spoil(good), mesh.cells), (good[::-1], good[::-1])):
        result = once_with(monkeypatch, cells, image, mesh, k_D=0.3)
        assert_array_equal(result.mesh.cells, taken)
        assert result.history[1].is_retessellated == (taken is not mesh.cells)


def once_with(monkeypatch, cells, *case, **options):
    """One iteration, whose Delaunay cells are these."""
    monkeypatch.setattr(sys.modules["tetopt.engine.paper"], "delaunay", lambda *_: cells)
    return optimize_paper(*case, iterations=1, n_t=1, **options)


def test_flat_cells_are_left_but_not_made(monkeypatch):
    """A mesh with a flat triangle is improved by moving its nodes; a tessellation that has one
    is not taken.
    """
    image = ball((12, 12))
    mesh = square(image, [5.5, -0.499997])
    result = once_with(monkeypatch, mesh.cells[::-1], image, mesh, k_D=0.0)
    assert_array_equal(result.mesh.cells, mesh.cells)
    assert not result.history[1].is_retessellated
    assert_allclose(result.mesh.points[4], [5.5, 5.5], atol=1e-5)


def square(image, node):
    """The box of an image in four triangles around a node."""
    points = np.vstack([box_corners(image.shape), node])
    return Mesh(points, [[0, 2, 4], [2, 3, 4], [3, 1, 4], [1, 0, 4]])


@pytest.mark.parametrize("ratio", [0.1, 0.3])
def test_step_length_is_a_ratio_of_the_nearest_centroid(ratio):
    """One free node in a square of four triangles, pushed along one axis only: it moves by the step
    or the parabola's part of it, never further, and the step is the ratio times the distance to the
    nearest of the four centroids.
    """
    edge = Image(np.where(np.arange(30)[:, None] < 18, 0.0, 100.0) * np.ones((30, 30)))
    mesh = square(edge, [10.0, 14.5])
    nearest = np.linalg.norm(mesh.points[mesh.cells].mean(axis=1) - mesh.points[4], axis=1).min()
    result = one_step(edge, mesh, k_D=0.95, boundary="fixed", step_ratio=ratio)
    moved = result.mesh.points[4, 0] - mesh.points[4, 0]
    assert moved == pytest.approx(ratio * nearest, abs=1e-5)


def test_default_n_t():
    """All iterations for Lloyd's alternation, half of them, rounded up, with an image; as with
    the number given.
    """
    assert [default_n_t(*each) for each in ((0.0, 7), (0.2, 7), (0.2, 6), (0.2, 0))] == [7, 4, 3, 0]
    run = partial(optimize_paper, *CASES["3-D"], k_D=0.4, iterations=6)
    plain, stated = ([row[:-1] for row in each.history] for each in (run(), run(n_t=3)))
    assert plain == stated


def test_movement_is_measured_from_the_middle_of_the_box():
    """|x^t - x^(t-1)| / |x^(t-1)|, so the same wherever the image lies in the world."""
    image, mesh = CASES["3-D"]
    result = one_step(image, mesh, k_D=0.4)
    middle = image.to_world((np.array(image.shape) - 1.0) / 2.0)
    moved = np.linalg.norm(result.mesh.points - mesh.points)
    assert result.history[1].movement == pytest.approx(
        moved / np.linalg.norm(mesh.points - middle), rel=1e-5
    )
