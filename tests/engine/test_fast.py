"""The fast engine: its gradients, its moves, its minimum angle, and its laws on phantoms."""

import itertools

import naive
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import split_box
from scipy.spatial import Delaunay
from states import CASES, OBLIQUE, Engine, assumed_case, ball, random_case

import tetopt
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
from tetopt.geometry.simplex import dihedral_angles, orient_cells
from tetopt.geometry.topology import boundary_facets

seeds = st.integers(0, 2**32 - 1)
dimensions = st.sampled_from([2, 3])


def smooth_image(shape, affine=None):
    """A sum of waves long against a voxel."""
    index = np.stack(np.meshgrid(*[np.arange(s) / s for s in shape], indexing="ij"), -1)
    data = np.sin(4.0 * index[..., 0] + 1.0) * np.cos(3.0 * index[..., -1]) + 0.7 * np.sin(
        5.0 * index.sum(-1)
    )
    return tetopt.Image(100.0 * data, affine)


def test_cells_that_are_surely_above_a_minimum_dihedral_angle():
    """The bound by the shape measure never lets one through that is below, and lets most regular
    ones through.
    """
    rng = np.random.default_rng(4)
    corners = rng.normal(size=(800, 4, 3))
    corners[:400] = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]] + 0.5 * corners[:400]
    corners[200:300, :, 0] *= 0.2  # flat ones
    # and the very ones that the bound is sharp for
    half = np.radians(rng.uniform(1.0, 70.0, 200)) / 2.0
    edge = 0.5 * np.sqrt(1.0 + np.sin(half) ** 2)
    zero = np.zeros_like(half)
    ends = np.stack([np.stack([zero, zero, s * edge], 1) for s in (1, -1)], 1)
    others = np.stack([np.stack([np.cos(half), s * np.sin(half), zero], 1) for s in (-1, 1)], 1)
    corners = np.concatenate([corners, np.concatenate([ends, others], axis=1)])
    mirrored = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    corners[mirrored] = corners[mirrored][:, [1, 0, 2, 3]]
    angles = dihedral_angles(
        corners.reshape(-1, 3), np.arange(4 * len(corners)).reshape(-1, 4)
    ).min(axis=1)
    objective = random_case(1, 3).objective
    for min_dihedral in (5.0, 12.0, 40.0):
        cosine, safe = angle_limit_of(min_dihedral)
        cosines = np.array(
            [
                cosine_up_to_limit(x, objective._replace(angle_limit=cosine, safe=safe))
                for x in corners
            ]
        )
        assert (angles[cosines >= cosine] >= min_dihedral * (1 - 1e-12)).all()
        np.testing.assert_allclose(
            cosines[cosines < cosine], -np.cos(np.radians(angles[cosines < cosine])), atol=1e-9
        )
    objective = objective._replace(angle_limit=-0.97, safe=angle_limit_of(12.0)[1])
    assert (
        np.array([cosine_up_to_limit(x, objective) for x in corners[:160]]) == -0.97
    ).mean() > 0.5


@pytest.mark.parametrize("n", [2, 3])
def test_squares_of_cells(n):
    """E_D of each cell; and by hand, of no voxel, one, three (1, 2 and 6) and a rounding below
    0.
    """
    engine = random_case(5, n)
    squares = cell_squares(engine.state) * engine.image.voxel_volume
    np.testing.assert_allclose(
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


@pytest.mark.parametrize("power", [1.0, 2.2, 3.0])
@pytest.mark.parametrize("n", [2, 3])
def test_shape_gradient(n, power):
    """Against central differences; with p = 1 also against E_G's own gradient."""
    engine = random_case(5, n, OBLIQUE if n == 3 else None, power)
    shape, _ = gradients(engine.state)
    mesh = engine.mesh

    def energy(points):
        v_E_G = cell_E_G(points, mesh.cells)
        v = np.abs(np.linalg.det(points[mesh.cells][:, 1:] - points[mesh.cells][:, :1])) / (
            2.0 if n == 2 else 6.0
        )
        S = v_E_G * (n + 1) * (n + 2) / v
        eta = S / (4 * np.sqrt(3) * v) if n == 2 else S / (12 * (3 * v) ** (2 / 3))
        return engine.objective.geometry * float((v_E_G * eta ** (power - 1)).sum())

    for node in range(0, len(mesh.points), 5):
        for d in range(n):
            ends = []
            for sign in (1, -1):
                moved = mesh.points.copy()
                moved[node, d] += sign * 1e-5
                ends.append(energy(moved))
            assert shape[node, 3 - n + d] == pytest.approx(
                (ends[0] - ends[1]) / 2e-5, rel=1e-5, abs=1e-9
            )
    if power == 1.0:
        expected = engine.objective.geometry * naive.E_G_gradient(mesh.points, mesh.cells)
        np.testing.assert_allclose(shape[:, 3 - n :], expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("is_graded", [False, True])
@pytest.mark.parametrize("n", [2, 3])
def test_shape_curvature(n, is_graded):
    """Against central differences of the gradient."""
    engine = random_case(5, n, OBLIQUE if n == 3 else None, 2.2)
    state = engine.state._replace(objective=engine.objective._replace(is_graded=is_graded))
    # mm per tick
    stars, matrix = node_stars(state), state.objective.matrix * 2.0**-state.objective.bits
    step = int(1e-4 / np.abs(matrix).max())

    def derivatives(node):
        g, H = np.zeros(3), np.zeros((3, 3))
        remeasure(state)
        _add_shape_gradient(g, H, np.empty((4, 3)), state, stars, node)
        return g, H

    for node in range(0, len(state.complex.ticks), 5):
        expected, here = np.zeros((3, 3)), state.complex.ticks[node].copy()
        _, H = derivatives(node)
        for axis in range(3 - n, 3):
            ends = []
            for sign in (1, -1):
                state.complex.ticks[node, axis] = here[axis] + sign * step
                ends.append(derivatives(node)[0])
            state.complex.ticks[node] = here
            expected[axis] = (ends[0] - ends[1]) / (2 * step)  # per tick along the axis
        got = (matrix.T @ H)[3 - n :, 3 - n :]
        np.testing.assert_allclose(
            got, expected[3 - n :, 3 - n :], rtol=1e-5, atol=1e-7 * np.abs(expected).max()
        )


@pytest.mark.full
def test_image_curvature_at_a_step():
    """Where the image steps across a facet that is nearly there already, E_D bends; in a uniform
    image it does not.
    """
    data = np.where(np.arange(40)[:, None, None] > 20, 100.0, 20.0) * np.ones((40, 36, 32))
    image = tetopt.Image(data)
    mesh = tetopt.lattice_mesh(image, blocks=(2, 2, 2))
    engine = Engine(image, mesh, 0.5)
    stars = node_stars(engine.state)
    for node in range(len(mesh.points)):
        g, H = np.zeros(3), np.zeros((3, 3))
        _add_image_gradient(g, H, engine.state, stars, node)
        assert np.linalg.eigvalsh(H).min() >= -1e-12 * np.abs(H).max()
        if abs(mesh.points[node, 0] - 20.0) < 1.0:
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
    image = smooth_image(shape, None if not turned else np.diag([1.0, -0.5, 2.0, 1.0]))
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    engine = Engine(image, mesh, 0.5)
    _, image_gradient = gradients(engine.state)
    inner = np.flatnonzero(~engine.complex.is_frozen[:, 3 - n : 3].any(axis=1))[
        :: 3 if n == 2 else 6
    ]
    expected = np.zeros((len(inner), n))
    for row, node in enumerate(inner):
        for d in range(n):
            step = reach * image.spacing[d]
            ends = []
            for sign in (1, -1):
                moved = mesh.points.copy()
                moved[node, d] += sign * step
                ends.append(tetopt.E_D(image, tetopt.Mesh(moved, mesh.cells)) / image.voxel_volume)
            expected[row, d] = engine.objective.image * (ends[0] - ends[1]) / (2.0 * step)
    error = (image_gradient[inner, 3 - n :] - expected) * image.spacing
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
    affine = OBLIQUE if turned and n == 3 else None
    engine = assumed_case(seed, n, affine, power, k_D)
    E = engine.E
    for _ in range(3):
        engine.sweep()
        assert engine.E <= E * (1 + 1e-12)
        E = engine.E
        engine.flip()
        assert engine.E <= E * (1 + 1e-12)
        E = engine.E
    if k_D == 0.0:  # then the image is not measured on the way
        engine.remeasure()
    engine.assert_sound()
    if n == 3:
        before = n_cells_below(engine.state, 15.0)
        repaired = engine.repair(15.0)
        assert repaired.n_below == n_cells_below(engine.state, 15.0) <= before
        if k_D == 0.0:
            engine.remeasure()
        engine.assert_sound()
        engine.keep_min_dihedral(15.0)
        engine.sweep()
        engine.flip()
        assert n_cells_below(engine.state, 15.0) <= repaired.n_below


@pytest.mark.full
@pytest.mark.parametrize("n", [2, 3])
def test_flips_at_k_D_0_tend_to_delaunay(n):
    """The lifted surface's interpolation error is E_G, least for Delaunay.

    In 2-D flips reach that from any mesh (Lawson 1972). In 3-D they may stop short of it, but not
    if they start, as in an optimisation, from Delaunay's cells with the nodes moved: by a quarter
    of their distance here.
    """
    rng = np.random.default_rng(2)
    shape = (30, 30, 30)[:n]
    image = tetopt.Image(np.zeros(shape))
    if n == 2:
        points, cells = split_box(rng, shape, 60)
    else:
        mesh = tetopt.lattice_mesh(image, nodes=800)
        frozen = Engine(image, mesh, 0.0, 1.0).complex.is_frozen[:, :3]
        step = 0.12 * image.volume ** (1 / 3) / 800 ** (1 / 3) * 1.5
        points = mesh.points + np.where(frozen, 0.0, rng.uniform(-step, step, mesh.points.shape))
        cells = mesh.cells
    engine = Engine(image, tetopt.Mesh(points, cells), 0.0, 1.0)
    begin = energies(engine.state)[0]
    assert engine.flip(passes=500) > 0
    best = orient_cells(points, Delaunay(points).simplices)
    v = np.abs(np.linalg.det(points[best][:, 1:] - points[best][:, :1]))
    best = best[v > 1e-9]
    least, now = float(cell_E_G(points, best).sum()), energies(engine.state)[0]
    flipped = {tuple(sorted(c)) for c in engine.mesh.cells.tolist()}
    true = {tuple(sorted(c)) for c in best.tolist()}
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
    image, blocks = CASES[name]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    result = tetopt.optimize(image, mesh, k_D=k_D, iterations=8, boundary=boundary)
    assert tetopt.check_mesh(result.mesh, image) == []
    assert all(row.n_voxels == image.data.size for row in result.history)
    E = np.array([row.E for row in result.history])
    assert (np.diff(E) <= 1e-12).all()
    assert E[-1] < E[0]
    assert tetopt.E_D(image, result.mesh) == pytest.approx(
        result.history[-1].E_D, rel=1e-9, abs=1e-6
    )
    assert len(result.mesh.cells) == result.history[-1].n_cells
    if boundary == "fixed":
        outer = np.unique(boundary_facets(mesh.cells))
        np.testing.assert_allclose(result.mesh.points[outer], mesh.points[outer], atol=1e-5)
    if image.ndim == 3:
        assert dihedral_angles(result.mesh.points, result.mesh.cells).min() >= 12.0 - 1e-6


@pytest.mark.full
def test_reaches_lower_than_the_paper():
    """With the paper's own energy (p = 1, no minimum angle) the same iterations end lower."""
    image, blocks = CASES["oblique"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    paper = tetopt.optimize_paper(image, mesh, k_D=0.5, iterations=8)
    fast = tetopt.optimize(image, mesh, k_D=0.5, iterations=8, shape_power=1.0, min_dihedral=0.0)
    assert fast.history[-1].E < paper.history[-1].E


@pytest.mark.full
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads to compare")
def test_same_bits_for_any_number_of_threads():
    image = ball((40, 44, 36))
    mesh = tetopt.lattice_mesh(image, nodes=1500)
    results = []
    for threads in (1, 2, 2):
        numba.set_num_threads(threads)
        results.append(tetopt.optimize(image, mesh, k_D=0.4, iterations=6))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    for other in results[1:]:
        assert other.mesh.points.tobytes() == results[0].mesh.points.tobytes()
        assert other.mesh.cells.tobytes() == results[0].mesh.cells.tobytes()
        assert [row[:-1] for row in other.history] == [row[:-1] for row in results[0].history]


@pytest.mark.full
def test_the_minimum_dihedral_angle():
    """Higher ones are reached too, up to what a coarse ball allows; without one, worse cells are
    left.
    """
    image, _ = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, nodes=250)
    worst = {}
    for min_dihedral in (0.0, 12.0, 20.0):
        made = tetopt.optimize(image, mesh, k_D=0.5, min_dihedral=min_dihedral).mesh
        worst[min_dihedral] = dihedral_angles(made.points, made.cells).min()
    assert worst[0.0] < 12.0 <= worst[12.0] + 1e-6
    assert worst[20.0] >= 20.0 - 1e-6


def squashed(image, blocks):
    """A lattice some of whose cells have been pressed flat: angles of about 2 degrees, at inner
    nodes.
    """
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    points = mesh.points.copy()
    index = image.to_index(points)
    inner = ((index > 1.0) & (index < np.array(image.shape) - 2.0)).all(axis=1)
    for node in np.flatnonzero(inner)[::9]:
        cell = mesh.cells[(mesh.cells == node).any(axis=1)][0]
        others = cell[cell != node]
        points[node] += 0.8 * (points[others].mean(axis=0) - points[node])
    return tetopt.Mesh(points, mesh.cells)


@pytest.mark.parametrize("options", [{"iterations": 6}, {"max_seconds": 1e-9}])
def test_a_bad_start_is_lifted_even_if_time_is_short(options, monkeypatch):
    """Flat cells are lifted at the end, whatever ends the run; where E rises, it is for that."""
    monkeypatch.setattr(loop, "GRACE_SECONDS", 600.0)  # however busy the machine is
    image, _ = CASES["3-D"]
    mesh = squashed(image, (5, 5, 5))
    assert dihedral_angles(mesh.points, mesh.cells).min() < 9.0
    result = tetopt.optimize(image, mesh, k_D=0.3, **options)
    assert dihedral_angles(result.mesh.points, result.mesh.cells).min() >= 12.0 - 1e-6
    assert tetopt.check_mesh(result.mesh, image) == []


def test_flips_leave_nothing_to_gain():
    """After `flip` no facet and no edge is worth a move, each looked at alone."""
    engine = random_case(17, 3)
    engine.flip()
    assert engine.flip() == 0
    image, blocks = CASES["3-D"]
    run = Run(plain(image), tetopt.lattice_mesh(image, blocks=blocks), 0.5)
    # looked for only around the nodes that moved, little is left for a look at all of them
    for _ in range(4):
        run.sweep()
        run.flip()
    assert flips.flip(run.state)[1] <= 2


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

    engine = random_case(23, 3)
    work = flips.cavity(0, 3)
    ring, around = work.ring, work.around
    cells, across, is_all = (
        engine.complex.cells,
        engine.complex.across,
        np.ones(len(engine.cells), dtype=bool),
    )
    edges = gained = 0
    for cell in range(0, len(engine.cells), 6):
        for i, j in flips.TET_EDGES:
            m, is_open = flips.ring_of_edge(ring, around, cells, across, cell, i, j, is_all)
            if not 3 <= m <= 7 or is_open:  # of 8 there are 132 triangulations
                continue
            a, b = engine.complex.cells[cell, i], engine.complex.cells[cell, j]
            worth = flips._worth_of_edge(work, engine.state, a, b, m, is_open)
            old = sum(energy_of(engine, engine.complex.cells[around[:m]]))
            best = np.inf
            for triangles in triangulations(0, m - 1):
                tets = []
                for p, q, r in triangles:
                    tets += [[ring[p], ring[q], ring[r], b], [ring[p], ring[r], ring[q], a]]
                best = min(best, sum(energy_of(engine, np.array(tets))))
            edges += 1
            if best < old * (1 - 1e-9):
                gained += 1
                assert worth == pytest.approx(old - best, rel=1e-6)
            else:
                assert worth == -np.inf
    assert edges > 20
    assert gained > 2


def energy_of(engine, tets):
    """Energies of tetrahedra given by their corners, from the library's numpy functions;
    infinite if inverted.
    """
    points = engine.image.to_world(from_ticks(engine.complex.ticks, engine.grid, 3))
    corners = points[tets]
    v = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    if (v <= 0).any():
        return [np.inf]
    mesh = tetopt.Mesh(points, tets)
    E_G = cell_E_G(points, tets)
    eta = E_G * 20 / v / (12 * (3 * v) ** (2 / 3))
    squares = np.zeros(len(tets))
    for k in range(len(tets)):
        one = tetopt.Mesh(points[tets[k]], [[0, 1, 2, 3]])
        try:
            squares[k] = tetopt.E_D(engine.image, one) / engine.image.voxel_volume
        except tetopt.InputError:  # too flat to be sampled
            return [np.inf]
    assert len(mesh.cells) == len(tets)
    return list(engine.objective.geometry * E_G * eta**2 + engine.objective.image * squares)


def test_edges_with_many_cells_are_left_alone():
    """Twelve tetrahedra around one edge, closed and open: no polygon, and nothing written past
    its room.
    """
    for is_open in (False, True):
        angles = np.linspace(0.0, np.pi if is_open else 2.0 * np.pi, 13)
        rim = np.column_stack([3.0 * np.cos(angles), 3.0 * np.sin(angles), np.zeros(13)])
        rim = rim if is_open else rim[:-1]
        points = np.vstack([[[0, 0, -3.0], [0, 0, 3.0]], rim]) + 5.0
        n = len(rim)
        cells = np.array([[0, 1, 2 + k, 2 + (k + 1) % n] for k in range(12)])
        engine = Engine(
            tetopt.Image(np.arange(1000.0).reshape(10, 10, 10)), tetopt.Mesh(points, cells)
        )
        room = np.full(flips.POLYGON_CORNERS + 5, -7)
        ring, around = room[: flips.POLYGON_CORNERS], np.full(flips.POLYGON_CORNERS, -7)
        for cell in range(12):
            for i, j in flips.TET_EDGES:
                m, _ = flips.ring_of_edge(
                    ring,
                    around,
                    engine.complex.cells,
                    engine.complex.across,
                    cell,
                    i,
                    j,
                    np.zeros(0, dtype=bool),
                )
                is_axis = set(engine.complex.cells[cell, [i, j]].tolist()) == {0, 1}
                assert m == 0 if is_axis else m in (2, 3)
        assert (room[flips.POLYGON_CORNERS :] == -7).all()


def test_refuses_flat_and_folded_starts():
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    a, b, c, d = mesh.cells[0]
    points = np.vstack(
        [mesh.points, mesh.points[[a, b, c]].mean(axis=0) * (1 - 1e-7) + 1e-7 * mesh.points[d]]
    )
    e = len(mesh.points)
    flat = tetopt.Mesh(
        points,
        np.vstack([mesh.cells[1:], [[a, b, c, e], [a, b, e, d], [a, e, c, d], [e, b, c, d]]]),
    )
    with pytest.raises(tetopt.InputError, match=r"too flat|flat or inverted"):
        tetopt.optimize(image, flat, iterations=1)
    folded = mesh.points.copy()
    index = image.to_index(folded)
    inner = np.flatnonzero(((index > 1.0) & (index < np.array(image.shape) - 2.0)).all(axis=1))[0]
    folded[inner] += 1.7 * (folded[mesh.cells[0]].mean(axis=0) - folded[inner])
    cells = mesh.cells.copy()
    wrong = np.linalg.det(folded[cells][:, 1:] - folded[cells][:, :1]) < 0
    cells[wrong] = cells[wrong][:, [1, 0, 2, 3]]
    if wrong.any():
        with pytest.raises(tetopt.InputError, match="cells overlap"):
            tetopt.optimize(image, tetopt.Mesh(folded, cells), iterations=1)


@pytest.mark.parametrize(
    ("rise", "ended"), [(0.0, "converged"), (1e-5, "converged"), (0.01, "risen")]
)
def test_a_run_whose_energy_rises_has_not_converged(rise, ended, monkeypatch):
    """As it may where interfaces follow their surfaces."""
    image, blocks = CASES["3-D"]
    energies_seen = itertools.count()
    monkeypatch.setattr(Run, "E", lambda _: 1.0 + rise * next(energies_seen))
    assert (
        tetopt.optimize(image, tetopt.lattice_mesh(image, blocks=blocks), iterations=4).ended
        == ended
    )


def test_stops_and_tells_why():
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice_mesh(image, blocks=blocks)
    assert tetopt.optimize(image, mesh, iterations=1).ended == "iterations"
    late = tetopt.optimize(image, mesh, max_seconds=1e-9)
    assert late.ended == "max_seconds"
    assert tetopt.check_mesh(late.mesh, image) == []
    seen = []
    stopped = tetopt.optimize(image, mesh, callback=seen.append, stop=lambda: len(seen) > 2)
    assert stopped.ended == "stopped"
    assert [row.iteration for row in seen] == list(range(len(seen)))
    assert tetopt.optimize(image, mesh, iterations=60).ended == "converged"
    none = tetopt.optimize(image, mesh, iterations=0)
    np.testing.assert_allclose(none.mesh.points, mesh.points, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"k_D": 1.0}, "k_D"),
        ({"k_D": np.nan}, "k_D"),
        ({"iterations": -1}, "iterations"),
        ({"shape_power": 0.9}, "shape_power"),
        ({"min_dihedral": 71.0}, "min_dihedral"),
        ({"boundary": "free"}, "boundary"),
    ],
)
def test_refuses(options, words):
    image, blocks = CASES["3-D"]
    with pytest.raises(tetopt.InputError, match=words):
        tetopt.optimize(image, tetopt.lattice_mesh(image, blocks=blocks), **options)


def test_run_measures_what_it_has():
    """After iterations with lifts and flips, the run's complex is what a fresh measurement
    finds.
    """
    image, blocks = CASES["oblique"]
    run = Run(plain(image), tetopt.lattice_mesh(image, blocks=blocks), 0.5)
    for _ in range(3):
        run.sweep()
        run.flip()
    run.lift(20.0)
    run.keep_min_dihedral(20.0)
    run.sweep()
    run.flip()
    now, n_cells = run.state.complex, run.n_cells
    fresh = build(
        now.cells[:n_cells], now.ticks, now.is_frozen, run.state.objective, run.state.sides
    ).complex
    np.testing.assert_array_equal(now.sums[:n_cells], fresh.sums[:n_cells])
    np.testing.assert_array_equal(now.across[:n_cells], fresh.across[:n_cells])
