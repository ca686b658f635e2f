"""The fast engine: its gradients, its moves, its minimum angle, and its laws on phantoms."""

import itertools
from functools import partial

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import REGULAR_TET, both_dimensions, dimensions, seeds, split_box
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay
from states import CASES, OBLIQUE, Engine, assumed_case, on_lattice, random_case

import tetopt
from tetopt import Image, InputError, Mesh, check_mesh, lattice_mesh, optimize
from tetopt.contents.content import plain
from tetopt.energy.discretization import cell_E_D
from tetopt.energy.geometric import cell_E_G
from tetopt.energy.sampling import from_ticks
from tetopt.engine import flips, loop
from tetopt.engine.complex import (
    build,
    cell_squares,
    cosine_up_to_limit,
    energies,
    node_stars,
    remeasure,
)
from tetopt.engine.fast import Run
from tetopt.engine.repair import n_cells_below
from tetopt.engine.smooth import _add_image_gradient, _add_shape_gradient
from tetopt.engine.state import angle_limit_of
from tetopt.geometry.simplex import dihedral_angles, orient_cells, volumes
from tetopt.geometry.topology import boundary_facets


def smooth_image(shape, affine=None):
    """A sum of waves long against a voxel."""
    index = np.stack(np.meshgrid(*[np.arange(s) / s for s in shape], indexing="ij"), -1)
    data = np.sin(4.0 * index[..., 0] + 1.0) * np.cos(3.0 * index[..., -1]) + 0.7 * np.sin(
        5.0 * index.sum(-1)
    )
    return Image(100.0 * data, affine)


def test_cells_that_are_surely_above_a_minimum_dihedral_angle():
    """The bound by the shape measure never lets one through that is below, and lets most regular
    ones through.
    """
    rng, sharp = np.random.default_rng(4), np.zeros((200, 4, 3))
    corners = rng.normal(size=(800, 4, 3))
    corners[:400] = REGULAR_TET[0] + 0.5 * corners[:400]
    corners[200:300, :, 0] *= 0.2  # flat ones
    # and the very ones that the bound is sharp for
    half = np.radians(rng.uniform(1.0, 70.0, 200)) / 2.0
    sharp[:, :2, 2] = np.outer(0.5 * np.sqrt(1.0 + np.sin(half) ** 2), [1, -1])
    sharp[:, 2:, 0], sharp[:, 2:, 1] = np.cos(half)[:, None], np.outer(np.sin(half), [-1, 1])
    points = np.concatenate([corners, sharp]).reshape(-1, 3)
    cells = orient_cells(points, np.arange(len(points)).reshape(-1, 4))
    angles, objective = dihedral_angles(points, cells).min(axis=1), random_case(1, 3).objective

    def cosines(limit, safe):
        limited = objective._replace(angle_limit=limit, safe=safe)
        return np.array([cosine_up_to_limit(x, limited) for x in points[cells]])

    for min_dihedral in (5.0, 12.0, 40.0):
        limit, safe = angle_limit_of(min_dihedral)
        found = cosines(limit, safe)
        is_below = found < limit
        assert (angles[~is_below] >= min_dihedral * (1 - 1e-12)).all()
        assert_allclose(found[is_below], -np.cos(np.radians(angles[is_below])), atol=1e-9)
    assert (cosines(-0.97, angle_limit_of(12.0)[1])[:160] == -0.97).mean() > 0.5


@both_dimensions
def test_squares_of_cells(n):
    """E_D of each cell; and by hand, of no voxel, one, three (1, 2 and 6) and a rounding below
    0.
    """
    engine = random_case(5, n)
    squares = cell_squares(engine.state) * engine.image.voxel_volume
    assert_allclose(
        squares, cell_E_D(engine.image, engine.mesh), rtol=1e-9, atol=1e-9 * squares.max()
    )
    engine.complex.sums[:4] = [[0.0, 0, 0], [1, 5, 25], [3, 9, 41], [2, 2, 2 - 1e-15]]
    assert cell_squares(engine.state)[:4].tolist() == [0, 0, 14, 0]


# Gradients.


def gradients(state):
    """Derivatives of the weighted shape and image terms of E by each node's position, (N, 3) each,
    per mm.
    """
    stars, (shape, image) = node_stars(state), np.zeros((2, len(state.complex.ticks), 3))
    for node in range(len(shape)):
        H = np.zeros((3, 3))
        _add_shape_gradient(shape[node], H, np.empty((4, 3)), state, stars, node)
        _add_image_gradient(image[node], H, state, stars, node)
    return shape, image @ state.sides.inverse


def derivatives(function, places, node, axes, step):
    """Central differences of a function of all places by coordinates of one node."""
    slopes = []
    for axis in axes:
        ends = []
        for move in (step, -step):
            moved = places.copy()
            moved[node, axis] += move
            ends.append(function(moved))
        slopes.append((ends[0] - ends[1]) / (2.0 * step))
    return np.array(slopes)


@pytest.mark.parametrize("power", [1.0, 2.2, 3.0])
@both_dimensions
def test_shape_gradient(n, power):
    """Against central differences; with p = 1 also against E_G's own gradient."""
    engine = random_case(5, n, OBLIQUE if n == 3 else None, power)
    shape, mesh = gradients(engine.state)[0][:, 3 - n :], engine.mesh

    def energy(points):
        v_E_G = cell_E_G(points, mesh.cells)
        v = np.abs(volumes(points, mesh.cells))
        S = v_E_G * (n + 1) * (n + 2) / v
        eta = S / (4 * np.sqrt(3) * v) if n == 2 else S / (12 * (3 * v) ** (2 / 3))
        return engine.objective.geometry * float((v_E_G * eta ** (power - 1)).sum())

    for node in range(0, len(mesh.points), 5):
        expected = derivatives(energy, mesh.points, node, range(n), 1e-5)
        assert shape[node] == pytest.approx(expected, rel=1e-5, abs=1e-9)
    if power == 1.0:
        expected = engine.objective.geometry * naive.E_G_gradient(mesh.points, mesh.cells)
        assert_allclose(shape, expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("is_graded", [False, True])
@both_dimensions
def test_shape_curvature(n, is_graded):
    """Against central differences of the gradient."""
    engine = random_case(5, n, OBLIQUE if n == 3 else None, 2.2)
    engine.change(is_graded=is_graded)
    state, ticks = engine.state, engine.complex.ticks.copy()
    # mm per tick
    stars, matrix = node_stars(state), state.objective.matrix * 2.0**-state.objective.bits

    def gradient(places, node, H):
        state.complex.ticks[:] = places
        remeasure(state)
        g = np.zeros(3)
        _add_shape_gradient(g, H, np.empty((4, 3)), state, stars, node)
        return g

    for node in range(0, len(ticks), 5):
        H, of_node = np.zeros((3, 3)), partial(gradient, node=node, H=np.zeros((3, 3)))
        gradient(ticks, node, H)
        step = int(1e-4 / np.abs(matrix).max())
        expected = derivatives(of_node, ticks, node, range(3 - n, 3), step)[:, 3 - n :]
        assert_allclose(
            (matrix.T @ H)[3 - n :, 3 - n :],
            expected,  # per tick along the axis
            rtol=1e-5,
            atol=1e-7 * np.abs(expected).max(),
        )


@pytest.mark.full
def test_image_curvature_at_a_step():
    """Where the image steps across a facet that is nearly there already, E_D bends; in a uniform
    image it does not.
    """
    data = np.where(np.arange(40)[:, None, None] > 20, 100.0, 20.0) * np.ones((40, 36, 32))
    image, mesh = on_lattice(Image(data), 2, 2, 2)
    state = Engine(image, mesh, 0.5).state
    stars = node_stars(state)
    for node, place in enumerate(mesh.points):
        g, H = np.zeros(3), np.zeros((3, 3))
        _add_image_gradient(g, H, state, stars, node)
        assert np.linalg.eigvalsh(H).min() >= -1e-12 * np.abs(H).max()
        if abs(place[0] - 20.0) < 1.0:
            assert H[0, 0] > 0.0
            assert H[0, 0] >= max(H[1, 1], H[2, 2])


@pytest.mark.full
@pytest.mark.parametrize(("n", "turned"), [(2, False), (3, True)])
def test_image_gradient_on_smooth_images(n, turned):
    """The face integrals against central differences of the sampled E_D, at some of the nodes.

    The differences are taken over many voxels, so that the sampling's own noise averages out; what
    is left of it, and of the third derivative, is the band: 3e-3 of the largest derivative in 2-D,
    8e-3 in 3-D, whose volumes are smaller.
    """
    shape, blocks, reach = (
        ((2400, 2000), (3, 3), 16.0) if n == 2 else ((200, 180, 190), (3, 3, 3), 8.0)
    )
    image, mesh = on_lattice(
        smooth_image(shape, np.diag([1.0, -0.5, 2.0, 1.0]) if turned else None), *blocks
    )
    engine = Engine(image, mesh, 0.5)
    of_image = gradients(engine.state)[1][:, 3 - n :]

    def energy(points):
        E_D = tetopt.E_D(image, Mesh(points, mesh.cells))
        return engine.objective.image * E_D / image.voxel_volume

    is_free = ~engine.complex.is_frozen[:, 3 - n : 3].any(axis=1)
    inner = np.flatnonzero(is_free)[:: 3 if n == 2 else 6]
    expected = [
        [derivatives(energy, mesh.points, node, [d], reach * image.spacing[d])[0] for d in range(n)]
        for node in inner
    ]
    error = (of_image[inner] - expected) * image.spacing
    size = np.abs(expected * image.spacing).max()
    assert np.sqrt((error**2).mean()) < (3e-3 if n == 2 else 8e-3) * size


# Moves.


@settings(max_examples=15, deadline=None)
@given(
    seeds, dimensions, st.sampled_from([0.0, 0.3, 0.9]), st.sampled_from([1.0, 3.0]), st.booleans()
)
def test_thousands_of_moves_leave_a_mesh(seed, n, k_D, power, turned):
    """Sweeps, flips and repairs of random meshes over noise: E falls by what was said, and
    everything stays sound.
    """
    engine = assumed_case(seed, n, OBLIQUE if turned and n == 3 else None, power, k_D)

    def assert_sound():
        if k_D == 0.0:  # then the image is not measured on the way
            engine.remeasure()
        engine.assert_sound()

    for move in (engine.sweep, engine.flip) * 3:
        E = engine.E
        move()
        assert engine.E <= E * (1 + 1e-12)
    assert_sound()
    if n == 3:
        before = n_cells_below(engine.state, 15.0)
        repaired = engine.repair(15.0)
        assert repaired.n_below == n_cells_below(engine.state, 15.0) <= before
        assert_sound()
        engine.keep_min_dihedral(15.0)
        engine.sweep()
        engine.flip()
        assert n_cells_below(engine.state, 15.0) <= repaired.n_below


@pytest.mark.full
@both_dimensions
def test_flips_at_k_D_0_tend_to_delaunay(n):
    """The lifted surface's interpolation error is E_G, least for Delaunay.

    In 2-D flips reach that from any mesh (Lawson 1972). In 3-D they may stop short of it, but not
    if they start, as in an optimisation, from Delaunay's cells with the nodes moved: by a quarter
    of their distance here.
    """
    rng = np.random.default_rng(2)
    image = Image(np.zeros((30,) * n))
    if n == 2:
        points, cells = split_box(rng, image.shape, 60)
    else:
        mesh = lattice_mesh(image, nodes=800)
        frozen = Engine(image, mesh, 0.0, 1.0).complex.is_frozen[:, :3]
        step = 0.12 * (image.volume / 800) ** (1 / 3) * 1.5
        points = mesh.points + np.where(frozen, 0.0, rng.uniform(-step, step, mesh.points.shape))
        cells = mesh.cells
    engine = Engine(image, Mesh(points, cells), 0.0, 1.0)
    begin = energies(engine.state)[0]
    assert engine.flip(passes=500) > 0
    best = orient_cells(points, Delaunay(points).simplices)
    best = best[volumes(points, best) > 1e-9 / 6.0]
    least, now = float(cell_E_G(points, best).sum()), energies(engine.state)[0]
    flipped, true = ({tuple(sorted(c)) for c in of.tolist()} for of in (engine.mesh.cells, best))
    assert (now - least) / (begin - least) < (1e-9 if n == 2 else 0.05)
    # Nodes on the box's faces are cospherical with many, so that not every cell is settled.
    assert len(flipped & true) > (0.97 if n == 2 else 0.9) * len(true)


def test_a_flip_is_worth_what_it_says():
    """One pass on noise lowers E by the sum of the gains of the moves made."""
    engine = random_case(11, 3)
    n_cells, room = len(engine.cells), len(engine.complex.cells)
    gain, move = np.zeros(n_cells), np.full(n_cells, -1)
    flips._evaluate(gain, move, np.arange(n_cells), np.ones(room, dtype=bool), engine.state)
    best = int(np.argmax(gain))
    E = engine.E
    work = flips.cavity(room, engine.complex.fluxes.shape[2])
    assert (
        flips.make_moves(np.array([best]), move, np.zeros(room, dtype=bool), engine.state, work)
        == 1
    )
    assert E - engine.E == pytest.approx(gain[best], rel=1e-9)
    engine.assert_sound()


# The whole engine.


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("k_D", [0.0, 0.3])
@pytest.mark.parametrize("boundary", ["slide", "fixed"])
def test_mappings(name, k_D, boundary):
    """A mesh of the box with every voxel; E falls but where cells were lifted; the history is of
    the mesh.
    """
    image, start = CASES[name]
    result = optimize(image, start, k_D=k_D, iterations=8, boundary=boundary)
    mesh, last = result.mesh, result.history[-1]
    assert check_mesh(mesh, image) == []
    assert {row.n_voxels for row in result.history} == {image.data.size}
    E = np.array([row.E for row in result.history])
    assert (np.diff(E) <= 1e-12).all()
    assert E[-1] < E[0]
    assert tetopt.E_D(image, mesh) == pytest.approx(last.E_D, rel=1e-9, abs=1e-6)
    assert len(mesh.cells) == last.n_cells
    if boundary == "fixed":
        outer = np.unique(boundary_facets(start.cells))
        assert_allclose(mesh.points[outer], start.points[outer], atol=1e-5)
    if image.ndim == 3:
        assert worst_angle(mesh) >= 12.0 - 1e-6


def worst_angle(mesh):
    return dihedral_angles(mesh.points, mesh.cells).min()


@pytest.mark.full
def test_reaches_lower_than_the_paper():
    """With the paper's own energy (p = 1, no minimum angle) the same iterations end lower."""
    case, options = CASES["oblique"], {"k_D": 0.5, "iterations": 8}
    paper = tetopt.optimize_paper(*case, **options)
    fast = optimize(*case, **options, shape_power=1.0, min_dihedral=0.0)
    assert fast.history[-1].E < paper.history[-1].E


@pytest.mark.full
def test_the_minimum_dihedral_angle():
    """Higher ones are reached too, up to what a coarse ball allows; without one, worse cells are
    left.
    """
    image = CASES["3-D"][0]
    mesh = lattice_mesh(image, nodes=250)
    none, usual, high = (
        worst_angle(optimize(image, mesh, k_D=0.5, min_dihedral=angle).mesh)
        for angle in (0.0, 12.0, 20.0)
    )
    assert none < 12.0 <= usual + 1e-6
    assert high >= 20.0 - 1e-6


def inner_nodes(image, mesh):
    """Those more than a voxel within the box."""
    index = image.to_index(mesh.points)
    return np.flatnonzero(((index > 1.0) & (index < np.array(image.shape) - 2.0)).all(axis=1))


@pytest.mark.parametrize("options", [{"iterations": 6}, {"max_seconds": 1e-9}])
def test_a_bad_start_is_lifted_even_if_time_is_short(options, monkeypatch):
    """Flat cells, pressed to about 2 degrees at inner nodes, are lifted at the end, whatever ends
    the run; where E rises, it is for that.
    """
    monkeypatch.setattr(loop, "GRACE_SECONDS", 600.0)  # however busy the machine is
    image, lattice = on_lattice(CASES["3-D"][0], 5, 5, 5)
    points = lattice.points.copy()
    for node in inner_nodes(image, lattice)[::9]:
        cell = lattice.cells[(lattice.cells == node).any(axis=1)][0]
        points[node] += 0.8 * (points[cell[cell != node]].mean(axis=0) - points[node])
    mesh = Mesh(points, lattice.cells)
    assert worst_angle(mesh) < 9.0
    result = optimize(image, mesh, k_D=0.3, **options)
    assert worst_angle(result.mesh) >= 12.0 - 1e-6
    assert check_mesh(result.mesh, image) == []


def test_flips_leave_nothing_to_gain():
    """After `flip` no facet and no edge is worth a move, each looked at alone."""
    engine = random_case(17, 3)
    engine.flip()
    assert engine.flip() == 0
    run = run_of("3-D")
    # looked for only around the nodes that moved, little is left for a look at all of them
    for _ in range(4):
        run.sweep()
        run.flip()
    assert flips.flip(run.state)[1] <= 2


def run_of(name):
    image, mesh = CASES[name]
    return Run(plain(image), mesh, 0.5)


@pytest.mark.full
def test_removing_an_edge_takes_the_best_triangulation():
    """Edges of a random mesh against all triangulations of its polygon, each measured afresh."""

    def triangulations(i, j):
        if j == i + 1:
            yield ()
        for k in range(i + 1, j):
            for left in triangulations(i, k):
                for right in triangulations(k, j):
                    yield ((i, k, j), *left, *right)

    engine, work = random_case(23, 3), flips.cavity(0, 3)
    ring, around, cells = work.ring, work.around, engine.complex.cells
    is_all = np.ones(len(engine.cells), dtype=bool)
    edges = gained = 0
    for cell in range(0, len(engine.cells), 6):
        for i, j in flips.TET_EDGES:
            m, is_open = flips.ring_of_edge(
                ring, around, cells, engine.complex.across, cell, i, j, is_all
            )
            if not 3 <= m <= 7 or is_open:  # of 8 there are 132 triangulations
                continue
            a, b = cells[cell, [i, j]]
            worth = flips._worth_of_edge(work, engine.state, a, b, m, is_open)
            old, best = energy_of(engine, cells[around[:m]]), np.inf
            for triangles in triangulations(0, m - 1):
                tets = []
                for p, q, r in triangles:
                    tets += [[ring[p], ring[q], ring[r], b], [ring[p], ring[r], ring[q], a]]
                best = min(best, energy_of(engine, np.array(tets)))
            edges += 1
            if best < old * (1 - 1e-9):
                gained += 1
                assert worth == pytest.approx(old - best, rel=1e-6)
            else:
                assert worth == -np.inf
    assert edges > 20
    assert gained > 2


def energy_of(engine, tets):
    """Energy of tetrahedra given by their corners, from the library's numpy functions; infinite
    if one is inverted.
    """
    points = engine.image.to_world(from_ticks(engine.complex.ticks, engine.grid, 3))
    v = volumes(points, tets)
    if (v <= 0).any():
        return np.inf
    E_G = cell_E_G(points, tets)
    eta = E_G * 20 / v / (12 * (3 * v) ** (2 / 3))
    try:
        squares = sum(
            tetopt.E_D(engine.image, Mesh(corners, [[0, 1, 2, 3]])) for corners in points[tets]
        )
    except InputError:  # too flat to be sampled
        return np.inf
    weights = engine.objective
    return weights.geometry * (E_G * eta**2).sum() + weights.image * squares / (
        engine.image.voxel_volume
    )


@pytest.mark.parametrize("is_open", [False, True])
def test_edges_with_many_cells_are_left_alone(is_open):
    """Twelve tetrahedra around one edge, closed and open: no polygon, and nothing written past
    its room.
    """
    turns = np.linspace(0.0, np.pi if is_open else 2.0 * np.pi, 13)[: 12 + is_open]
    rim = np.column_stack([3.0 * np.cos(turns), 3.0 * np.sin(turns), 0.0 * turns])
    points = np.vstack([[[0, 0, -3.0], [0, 0, 3.0]], rim]) + 5.0
    cells = [[0, 1, 2 + k, 2 + (k + 1) % len(rim)] for k in range(12)]
    made = Engine(Image(np.arange(1000.0).reshape(10, 10, 10)), Mesh(points, cells)).complex
    most, nothing = flips.POLYGON_CORNERS, np.zeros(0, dtype=bool)
    room, around = np.full(most + 5, -7), np.full(most, -7)
    for cell, (i, j) in itertools.product(range(12), flips.TET_EDGES):
        m, _ = flips.ring_of_edge(room[:most], around, made.cells, made.across, cell, i, j, nothing)
        is_axis = set(made.cells[cell, [i, j]]) == {0, 1}
        assert m in ((0,) if is_axis else (2, 3))
    assert (room[most:] == -7).all()


def test_refuses_flat_and_folded_starts():
    image, mesh = CASES["3-D"]
    a, b, c, d = mesh.cells[0]
    e = len(mesh.points)
    apex = mesh.points[[a, b, c]].mean(axis=0) * (1 - 1e-7) + 1e-7 * mesh.points[d]
    flat = Mesh(
        np.vstack([mesh.points, apex]),
        np.vstack([mesh.cells[1:], [[a, b, c, e], [a, b, e, d], [a, e, c, d], [e, b, c, d]]]),
    )
    with pytest.raises(InputError, match=r"too flat|flat or inverted"):
        optimize(image, flat, iterations=1)
    points, inner = mesh.points.copy(), inner_nodes(image, mesh)[0]
    points[inner] += 1.7 * (points[mesh.cells[0]].mean(axis=0) - points[inner])
    folded = Mesh(points, orient_cells(points, mesh.cells))
    assert (folded.cells != mesh.cells).any()
    with pytest.raises(InputError, match="cells overlap"):
        optimize(image, folded, iterations=1)


@pytest.mark.parametrize(
    ("rise", "ended"), [(0.0, "converged"), (1e-5, "converged"), (0.01, "risen")]
)
def test_a_run_whose_energy_rises_has_not_converged(rise, ended, monkeypatch):
    """As it may where interfaces follow their surfaces."""
    energies_seen = itertools.count()
    monkeypatch.setattr(Run, "E", lambda _: 1.0 + rise * next(energies_seen))
    assert optimize(*CASES["3-D"], iterations=4).ended == ended


def test_stops_and_tells_why():
    image, mesh = CASES["3-D"]
    run = partial(optimize, image, mesh)
    late, seen = run(max_seconds=1e-9), []
    assert check_mesh(late.mesh, image) == []
    stopped = run(callback=seen.append, stop=lambda: len(seen) > 2)
    assert [row.iteration for row in seen] == list(range(len(seen)))
    ends = [each.ended for each in (run(iterations=1), late, stopped, run(iterations=60))]
    assert ends == ["iterations", "max_seconds", "stopped", "converged"]
    assert_allclose(run(iterations=0).mesh.points, mesh.points, atol=1e-5)


def test_run_measures_what_it_has():
    """After iterations with lifts and flips, the run's complex is what a fresh measurement
    finds.
    """
    run = run_of("oblique")
    for _ in range(3):
        run.sweep()
        run.flip()
    run.lift(20.0)
    run.keep_min_dihedral(20.0)
    run.sweep()
    run.flip()
    now, state, n_cells = run.state.complex, run.state, run.n_cells
    fresh = build(now.cells[:n_cells], now.ticks, now.is_frozen, state.objective, state.sides)
    for name in ("sums", "across"):
        there, afresh = (getattr(each, name)[:n_cells] for each in (now, fresh.complex))
        assert_array_equal(there, afresh)
