"""The fast engine: its gradients, its moves, its floor, and its laws on phantoms."""

import numba
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from meshes import delaunay_box, split_box
from scipy.spatial import Delaunay

import tetopt
from tetopt.energy.geometric import E_G_gradient, cell_E_G
from tetopt.energy.sampling import from_ticks, sampling_grid, to_ticks
from tetopt.engine.complex import build, energies, floor_of, measure_all, measure_of, node_rings, quality_up_to
from tetopt.engine.fast import _Run
from tetopt.engine.flips import flip
from tetopt.engine.loop import frozen_axes
from tetopt.engine.repair import repair, worst_angles
from tetopt.engine.smooth import blocks, gradient, sweep
from tetopt.engine.surface import sides_of
from tetopt.geometry.simplex import dihedral_angles, oriented
from tetopt.geometry.topology import boundary_facets
from tetopt.target.content import plain

OBLIQUE = np.array([[0.9, 0.3, 0.2, -7.0], [-0.25, 1.1, 0.1, 3.0], [0.0, 0.4, -2.5, 11.0], [0.0, 0.0, 0.0, 1.0]])
seeds = st.integers(0, 2**32 - 1)
dimensions = st.sampled_from([2, 3])


def smooth_image(shape, affine=None):
    """A sum of waves long against a voxel."""
    index = np.stack(np.meshgrid(*[np.arange(s) / s for s in shape], indexing="ij"), -1)
    data = np.sin(4.0 * index[..., 0] + 1.0) * np.cos(3.0 * index[..., -1]) + 0.7 * np.sin(5.0 * index.sum(-1))
    return tetopt.Image(100.0 * data, affine)


def ball(shape, affine=None):
    index = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, s) for s in shape], indexing="ij"), -1)
    data = 100.0 * ((index**2).sum(-1) < 0.4) + 5.0 * index[..., 0] + np.round(3.0 * index[..., -1])
    return tetopt.Image(data, affine)


CASES = {
    "2-D": (ball((40, 30)), (6, 5)),
    "3-D": (ball((24, 20, 22)), (4, 3, 4)),
    "oblique": (ball((24, 20, 10), OBLIQUE), (4, 4, 4)),
}


class Held:
    """A complex with all that its kernels want."""

    def __init__(self, image, mesh, k_D=0.5, power=3.0):
        self.image, self.n = image, image.ndim
        self.grid = sampling_grid(image, mesh.points)
        ticks = to_ticks(image.to_index(mesh.points), self.grid)
        self.matrix = np.eye(3)
        self.matrix[3 - self.n :, 3 - self.n :] = image.affine[:-1, :-1]
        hand = 1 if np.linalg.det(image.affine[:-1, :-1]) > 0 else -1
        unit = measure_of(self.grid, hand, self.matrix, 1.0, 1.0, power)
        self.complex = build(mesh.cells, ticks, unit)
        E_G, squares = energies(self.complex)
        self.measure = measure_of(self.grid, hand, self.matrix, (1 - k_D) / E_G, k_D / squares if k_D else 0.0, power)
        self.is_frozen = frozen_axes(image, ticks, mesh.cells, self.grid, "slide")
        self.sides = sides_of(self.grid, self.matrix, False)

    @property
    def E(self):
        E_G, squares = energies(self.complex)
        return self.measure.geometry * E_G + self.measure.image * squares

    @property
    def mesh(self):
        points = self.image.to_world(from_ticks(self.complex.ticks, self.grid, self.n))
        return tetopt.Mesh(points, self.complex.cells[: int(self.complex.n_cells[0])])

    def sweep(self):
        ticks = self.complex.ticks
        everyone = np.ones(len(ticks), dtype=bool)
        rings, groups = node_rings(self.complex), blocks(ticks)
        sweep(self.complex, rings, groups, everyone, self.is_frozen, self.measure, self.sides)

    def flip(self, passes=50):
        self.complex, made = flip(self.complex, self.measure, passes=passes)
        return made

    def assert_sound(self):
        """A mesh of the box; neighbours, fluxes, sums and shapes as if measured afresh; every voxel in one cell."""
        assert tetopt.check_mesh(self.mesh, self.image) == []
        fresh = build(self.mesh.cells, self.complex.ticks, self.measure)
        n_cells = int(self.complex.n_cells[0])
        for name in ("across", "fluxes", "sums", "E_shape"):
            np.testing.assert_array_equal(getattr(self.complex, name)[:n_cells], getattr(fresh, name)[:n_cells], name)
        assert self.complex.sums[:n_cells, 0].sum() == self.image.data.size


def test_cells_that_are_surely_above_a_floor():
    """The bound by the shape measure never lets one through that is below, and lets most regular ones through."""
    rng = np.random.default_rng(4)
    corners = rng.normal(size=(20_000, 4, 3))
    corners[:10_000] = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]] + 0.5 * corners[:10_000]
    corners[5_000:7_500, :, 0] *= 0.2  # flat ones
    half = np.radians(rng.uniform(1.0, 70.0, 5_000)) / 2.0  # and the very ones that the bound is sharp for
    edge = 0.5 * np.sqrt(1.0 + np.sin(half) ** 2)
    zero = np.zeros_like(half)
    ends = np.stack([np.stack([zero, zero, s * edge], 1) for s in (1, -1)], 1)
    others = np.stack([np.stack([np.cos(half), s * np.sin(half), zero], 1) for s in (-1, 1)], 1)
    corners = np.concatenate([corners, np.concatenate([ends, others], axis=1)])
    mirrored = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    corners[mirrored] = corners[mirrored][:, [1, 0, 2, 3]]
    angles = dihedral_angles(corners.reshape(-1, 3), np.arange(4 * len(corners)).reshape(-1, 4)).min(axis=1)
    measure = random_case(1, 3).measure
    for floor in (5.0, 12.0, 40.0):
        cosine, safe = floor_of(floor)
        given_floor = measure._replace(floor=cosine, safe=safe)
        found = np.array([quality_up_to(x, given_floor) for x in corners])
        assert (angles[found >= cosine] >= floor * (1 - 1e-12)).all()
        np.testing.assert_allclose(found[found < cosine], -np.cos(np.radians(angles[found < cosine])), atol=1e-9)
    assert (
        np.array([quality_up_to(x, measure._replace(floor=-0.97, safe=floor_of(12.0)[1])) for x in corners[:2000]])
        == -0.97
    ).mean() > 0.5


def random_case(seed, n, affine=None, power=3.0, k_D=0.5):
    rng = np.random.default_rng(seed)
    shape = (14, 12, 11)[:n]
    image = tetopt.Image(rng.integers(0, 50, shape), affine)
    index, cells = delaunay_box(rng, shape, 12 if n == 2 else 25)
    points = image.to_world(index)
    if affine is not None and np.linalg.det(affine[:-1, :-1]) < 0:
        cells = cells[:, [1, 0, *range(2, n + 1)]]
    return Held(image, tetopt.Mesh(points, cells), k_D, power)


# Gradients.


@pytest.mark.parametrize("power", [1.0, 2.2, 3.0])
@pytest.mark.parametrize("n", [2, 3])
def test_shape_gradient(n, power):
    """Against central differences; with p = 1 also against E_G's own gradient."""
    held = random_case(5, n, OBLIQUE if n == 3 else None, power)
    shape, _ = gradient(held.complex, node_rings(held.complex), held.measure)
    mesh = held.mesh

    def energy(points):
        v_E_G = cell_E_G(points, mesh.cells)
        v = np.abs(np.linalg.det(points[mesh.cells][:, 1:] - points[mesh.cells][:, :1])) / (2.0 if n == 2 else 6.0)
        S = v_E_G * (n + 1) * (n + 2) / v
        eta = S / (4 * np.sqrt(3) * v) if n == 2 else S / (12 * (3 * v) ** (2 / 3))
        return held.measure.geometry * float((v_E_G * eta ** (power - 1)).sum())

    for node in range(0, len(mesh.points), 5):
        for d in range(n):
            ends = []
            for sign in (1, -1):
                moved = mesh.points.copy()
                moved[node, d] += sign * 1e-5
                ends.append(energy(moved))
            assert shape[node, 3 - n + d] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-5, abs=1e-9)
    if power == 1.0:
        expected = held.measure.geometry * E_G_gradient(mesh.points, mesh.cells)
        np.testing.assert_allclose(shape[:, 3 - n :], expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(("n", "turned"), [(2, False), (3, False), (3, True)])
def test_image_gradient_on_smooth_images(n, turned):
    """The face integrals against central differences of the sampled E_D.

    The differences are taken over many voxels, so that the sampling's own noise averages out; what is left of it, and
    of the third derivative, is the band: 3e-3 of the largest derivative in 2-D, 8e-3 in 3-D, whose volumes are smaller.
    """
    shape, blocks, reach = ((2400, 2000), (3, 3), 16.0) if n == 2 else ((200, 180, 190), (3, 3, 3), 8.0)
    image = smooth_image(shape, None if not turned else np.diag([1.0, -0.5, 2.0, 1.0]))
    mesh = tetopt.lattice(image, blocks=blocks)
    held = Held(image, mesh, 0.5)
    _, found = gradient(held.complex, node_rings(held.complex), held.measure)
    inner = np.flatnonzero(~held.is_frozen[:, 3 - n : 3].any(axis=1))
    expected = np.zeros((len(inner), n))
    for row, node in enumerate(inner):
        for d in range(n):
            step = reach * image.spacing[d]
            ends = []
            for sign in (1, -1):
                moved = mesh.points.copy()
                moved[node, d] += sign * step
                ends.append(tetopt.E_D(image, tetopt.Mesh(moved, mesh.cells)) / image.voxel_volume)
            expected[row, d] = held.measure.image * (ends[0] - ends[1]) / (2.0 * step)
    error = (found[inner, 3 - n :] - expected) * image.spacing
    size = np.abs(expected * image.spacing).max()
    assert np.sqrt((error**2).mean()) < (3e-3 if n == 2 else 8e-3) * size


def test_image_gradient_in_the_mean_on_noise():
    """On a noisy step the two still point the same way: their correlation over all nodes is high."""
    rng = np.random.default_rng(0)
    data = np.where(np.arange(60)[:, None, None] > 29, 100.0, 20.0) + rng.normal(0, 10, (60, 56, 52))
    image = tetopt.Image(data)
    mesh = tetopt.lattice(image, blocks=(5, 5, 5))
    held = Held(image, mesh, 0.5)
    _, found = gradient(held.complex, node_rings(held.complex), held.measure)
    inner = np.flatnonzero(~held.is_frozen.any(axis=1))
    expected = []
    for node in inner:
        ends = []
        for sign in (1, -1):
            moved = mesh.points.copy()
            moved[node, 0] += sign * 1.5
            ends.append(tetopt.E_D(image, tetopt.Mesh(moved, mesh.cells)))
        expected.append(held.measure.image * (ends[0] - ends[1]) / 3.0)
    assert np.corrcoef(found[inner, 0], expected)[0, 1] > 0.97


# Moves.


@settings(max_examples=40, deadline=None)
@given(seeds, dimensions, st.sampled_from([0.0, 0.3, 0.9]), st.sampled_from([1.0, 3.0]), st.booleans())
def test_thousands_of_moves_leave_a_mesh(seed, n, k_D, power, turned):
    """Sweeps, flips and repairs of random meshes over noise: E falls by what was said, and everything stays sound."""
    affine = OBLIQUE if turned and n == 3 else None
    held = random_case(seed, n, affine, power, k_D)
    E = held.E
    assume(np.isfinite(E))  # a flat cell to begin with has no shape energy; `optimize` refuses it
    for _ in range(3):
        held.sweep()
        assert held.E <= E * (1 + 1e-12)
        E = held.E
        held.flip()
        assert held.E <= E * (1 + 1e-12)
        E = held.E
    if k_D == 0.0:  # then the image is not measured on the way
        measure_all(held.complex, held.measure)
    held.assert_sound()
    if n == 3:
        before = worst_angles(held.complex, held.measure, 15.0)
        done = repair(held.complex, held.is_frozen, held.measure, held.sides, 15.0)
        held.is_frozen = done.is_frozen
        held.complex = done.held
        assert done.n_below == worst_angles(held.complex, held.measure, 15.0) <= before
        if k_D == 0.0:
            measure_all(held.complex, held.measure)
        held.assert_sound()
        floor, safe = floor_of(15.0)
        held.measure = held.measure._replace(floor=floor, safe=safe)
        held.sweep()
        held.flip()
        assert worst_angles(held.complex, held.measure, 15.0) <= done.n_below


def test_nodes_stay_on_their_faces():
    held = random_case(3, 3)
    before = held.complex.ticks.copy()
    for _ in range(3):
        held.sweep()
        held.flip()
    moved = held.complex.ticks != before
    assert moved.any()
    assert not (moved & held.is_frozen[:, :3]).any()


@pytest.mark.parametrize("n", [2, 3])
def test_flips_at_k_D_0_tend_to_delaunay(n):
    """The lifted surface's interpolation error is E_G, least for Delaunay.

    In 2-D flips reach that from any mesh (Lawson 1972). In 3-D they may stop short of it, but not if they start, as in
    an optimisation, from Delaunay's cells with the nodes moved: by a quarter of their distance here.
    """
    rng = np.random.default_rng(2)
    shape = (30, 30, 30)[:n]
    image = tetopt.Image(np.zeros(shape))
    if n == 2:
        points, cells = split_box(rng, shape, 120)
    else:
        mesh = tetopt.lattice(image, nodes=800)
        frozen = Held(image, mesh, 0.0, 1.0).is_frozen[:, :3]
        step = 0.12 * image.volume ** (1 / 3) / 800 ** (1 / 3) * 1.5
        points = mesh.points + np.where(frozen, 0.0, rng.uniform(-step, step, mesh.points.shape))
        cells = mesh.cells
    held = Held(image, tetopt.Mesh(points, cells), 0.0, 1.0)
    begin = energies(held.complex)[0]
    assert held.flip(passes=500) > 0
    best = oriented(points, Delaunay(points).simplices)
    v = np.abs(np.linalg.det(points[best][:, 1:] - points[best][:, :1]))
    best = best[v > 1e-9]
    least, now = float(cell_E_G(points, best).sum()), energies(held.complex)[0]
    found = {tuple(sorted(c)) for c in held.mesh.cells.tolist()}
    true = {tuple(sorted(c)) for c in best.tolist()}
    assert (now - least) / (begin - least) < (1e-9 if n == 2 else 0.05)
    # Nodes on the box's faces are cospherical with many, so that not every cell is settled.
    assert len(found & true) > (0.97 if n == 2 else 0.9) * len(true)


def test_a_flip_is_worth_what_it_says():
    """One pass on noise lowers E by the sum of the gains of the moves made."""
    from tetopt.engine import flips

    held = random_case(11, 3)
    n_cells = int(held.complex.n_cells[0])
    gain, move = np.zeros(n_cells), np.full(n_cells, -1)
    flips._evaluate(gain, move, np.ones(len(held.complex.cells), dtype=bool), held.complex, held.measure)
    best = int(np.argmax(gain))
    E = held.E
    made = flips.make_moves(
        np.array([best]), move, np.zeros(len(held.complex.cells), dtype=bool), held.complex, held.measure
    )
    assert made == 1
    assert E - held.E == pytest.approx(gain[best], rel=1e-9)
    held.assert_sound()


# The whole engine.


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("k_D", [0.0, 0.3])
@pytest.mark.parametrize("boundary", ["slide", "fixed"])
def test_laws(name, k_D, boundary):
    """A mesh of the box with every voxel; E falls but where the floor was lifted; the history is of the mesh."""
    image, blocks = CASES[name]
    mesh = tetopt.lattice(image, blocks=blocks)
    result = tetopt.optimize(image, mesh, k_D=k_D, iterations=8, boundary=boundary)
    assert tetopt.check_mesh(result.mesh, image) == []
    assert all(row.n_voxels == image.data.size for row in result.history)
    E = np.array([row.E for row in result.history])
    assert (np.diff(E) <= 1e-12).all()
    assert E[-1] < E[0]
    assert tetopt.E_D(image, result.mesh) == pytest.approx(result.history[-1].E_D, rel=1e-9, abs=1e-6)
    assert len(result.mesh.cells) == result.history[-1].n_cells
    if boundary == "fixed":
        outer = np.unique(boundary_facets(mesh.cells))
        np.testing.assert_allclose(result.mesh.points[outer], mesh.points[outer], atol=1e-5)
    if image.ndim == 3:
        assert dihedral_angles(result.mesh.points, result.mesh.cells).min() >= 12.0 - 1e-6


@pytest.mark.parametrize("name", ["3-D", "oblique"])
def test_reaches_lower_than_the_paper(name):
    """With the paper's own energy (p = 1, no floor) the same iterations end lower."""
    image, blocks = CASES[name]
    mesh = tetopt.lattice(image, blocks=blocks)
    paper = tetopt.optimize_paper(image, mesh, k_D=0.5, iterations=20)
    fast = tetopt.optimize(image, mesh, k_D=0.5, iterations=20, shape_power=1.0, min_dihedral=0.0)
    assert fast.history[-1].E < paper.history[-1].E


def test_same_bits_for_any_number_of_threads():
    image = ball((40, 44, 36))
    mesh = tetopt.lattice(image, nodes=1500)
    results = []
    for threads in (1, 2, 2):
        numba.set_num_threads(threads)
        results.append(tetopt.optimize(image, mesh, k_D=0.4, iterations=6))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    for other in results[1:]:
        assert other.mesh.points.tobytes() == results[0].mesh.points.tobytes()
        assert other.mesh.cells.tobytes() == results[0].mesh.cells.tobytes()
        assert [row[:-1] for row in other.history] == [row[:-1] for row in results[0].history]


def test_floor():
    """Higher floors are reached too, up to what a coarse ball allows; without one, worse cells are left."""
    image, _ = CASES["3-D"]
    mesh = tetopt.lattice(image, nodes=400)
    worst = {}
    for floor in (0.0, 12.0, 20.0):
        made = tetopt.optimize(image, mesh, k_D=0.5, min_dihedral=floor).mesh
        worst[floor] = dihedral_angles(made.points, made.cells).min()
    assert worst[0.0] < 12.0 <= worst[12.0] + 1e-6
    assert worst[20.0] >= 20.0 - 1e-6


def squashed(image, blocks):
    """A lattice some of whose cells have been pressed flat: angles of about 2 degrees, at inner nodes."""
    mesh = tetopt.lattice(image, blocks=blocks)
    points = mesh.points.copy()
    index = image.to_index(points)
    inner = ((index > 1.0) & (index < np.array(image.shape) - 2.0)).all(axis=1)
    for node in np.flatnonzero(inner)[::9]:
        cell = mesh.cells[(mesh.cells == node).any(axis=1)][0]
        others = cell[cell != node]
        points[node] += 0.8 * (points[others].mean(axis=0) - points[node])
    return tetopt.Mesh(points, mesh.cells)


@pytest.mark.parametrize("options", [{"iterations": 6}, {"max_seconds": 1e-9}])
def test_a_bad_start_is_lifted_even_if_time_is_short(options):
    """The floor is seen to at the end, whatever ends the run; where E rises, it is for that."""
    image, _ = CASES["3-D"]
    mesh = squashed(image, (5, 5, 5))
    assert dihedral_angles(mesh.points, mesh.cells).min() < 9.0
    result = tetopt.optimize(image, mesh, k_D=0.3, **options)
    assert dihedral_angles(result.mesh.points, result.mesh.cells).min() >= 12.0 - 1e-6
    assert tetopt.check_mesh(result.mesh, image) == []


def test_flips_leave_nothing_to_gain():
    """After `flip` no facet and no edge is worth a move, asked of each alone."""
    held = random_case(17, 3)
    held.flip()
    assert held.flip() == 0
    run = _Run(plain(CASES["3-D"][0]), tetopt.lattice(*[CASES["3-D"][0]], blocks=CASES["3-D"][1]), 0.5, 3.0, "slide")
    for _ in range(4):  # asked only around the nodes that moved, little is left for a look at all of them
        run.sweep(lambda: False)
        run.flip()
    run.held, left = flip(run.held, run.measure)
    assert left <= 2


def test_removing_an_edge_takes_the_best_triangulation():
    """Every edge of random meshes against all triangulations of its polygon, each measured afresh."""
    from tetopt.engine import flips

    def triangulations(i, j):
        if j == i + 1:
            yield ()
        for k in range(i + 1, j):
            for left in triangulations(i, k):
                for right in triangulations(k, j):
                    yield ((i, k, j), *left, *right)

    held = random_case(23, 3)
    work = flips.cavity(0, 3)
    ring, around = work.ring, work.around
    asked = gained = 0
    for cell in range(int(held.complex.n_cells[0])):
        for i, j in flips.EDGES:
            m, is_open = flips.ring_of_edge(ring, around, held.complex, cell, i, j, True)
            if m < 3 or is_open:
                continue
            a, b = held.complex.cells[cell, i], held.complex.cells[cell, j]
            worth = flips._worth_of_edge(work, held.complex, a, b, m, is_open, held.measure)
            old = sum(energy_of(held, held.complex.cells[around[:m]]))
            best = np.inf
            for triangles in triangulations(0, m - 1):
                tets = []
                for p, q, r in triangles:
                    tets += [[ring[p], ring[q], ring[r], b], [ring[p], ring[r], ring[q], a]]
                best = min(best, sum(energy_of(held, np.array(tets))))
            asked += 1
            if best < old * (1 - 1e-9):
                gained += 1
                assert worth == pytest.approx(old - best, rel=1e-6)
            else:
                assert worth == -np.inf
    assert asked > 30
    assert gained > 5


def energy_of(held, tets):
    """Energies of tetrahedra given by their corners, from the library's numpy functions; infinite if inverted."""
    points = held.image.to_world(from_ticks(held.complex.ticks, held.grid, 3))
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
            squares[k] = tetopt.E_D(held.image, one) / held.image.voxel_volume
        except tetopt.InputError:  # too flat to be sampled
            return [np.inf]
    assert len(mesh.cells) == len(tets)
    return list(held.measure.geometry * E_G * eta**2 + held.measure.image * squares)


def test_edges_with_many_cells_are_left_alone():
    """Twelve tetrahedra around one edge, closed and open: no polygon, and nothing written past its room."""
    from tetopt.engine import flips

    for is_open in (False, True):
        angles = np.linspace(0.0, np.pi if is_open else 2.0 * np.pi, 13)
        rim = np.column_stack([3.0 * np.cos(angles), 3.0 * np.sin(angles), np.zeros(13)])
        rim = rim if is_open else rim[:-1]
        points = np.vstack([[[0, 0, -3.0], [0, 0, 3.0]], rim]) + 5.0
        n = len(rim)
        cells = np.array([[0, 1, 2 + k, 2 + (k + 1) % n] for k in range(12)])
        held = Held(tetopt.Image(np.arange(1000.0).reshape(10, 10, 10)), tetopt.Mesh(points, cells))
        room = np.full(flips.MOST + 5, -7)
        ring, around = room[: flips.MOST], np.full(flips.MOST, -7)
        for cell in range(12):
            for i, j in flips.EDGES:
                m, _ = flips.ring_of_edge(ring, around, held.complex, cell, i, j)
                is_axis = set(held.complex.cells[cell, [i, j]].tolist()) == {0, 1}
                assert m == 0 if is_axis else m in (2, 3)
        assert (room[flips.MOST :] == -7).all()


def test_refuses_flat_and_folded_starts():
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice(image, blocks=blocks)
    a, b, c, d = mesh.cells[0]
    points = np.vstack([mesh.points, mesh.points[[a, b, c]].mean(axis=0) * (1 - 1e-7) + 1e-7 * mesh.points[d]])
    e = len(mesh.points)
    flat = tetopt.Mesh(points, np.vstack([mesh.cells[1:], [[a, b, c, e], [a, b, e, d], [a, e, c, d], [e, b, c, d]]]))
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
        with pytest.raises(tetopt.InputError, match="overlap there"):
            tetopt.optimize(image, tetopt.Mesh(folded, cells), iterations=1)


def test_refuses_energies_that_overflow():
    image, blocks = CASES["3-D"]
    far = tetopt.Image(image.data, np.diag([1e60, 1e60, 1e60, 1.0]))
    with pytest.raises(tetopt.InputError, match=r"overflow|too flat"):
        tetopt.optimize(far, tetopt.lattice(far, blocks=blocks), k_D=0.5, iterations=1)


def test_stops_and_tells_why():
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice(image, blocks=blocks)
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


def test_constant_image():
    image = tetopt.Image(np.full((9, 8, 7), 5.0))
    mesh = tetopt.lattice(image, blocks=(3, 3, 3))
    result = tetopt.optimize(image, mesh, k_D=0.5, iterations=4)
    assert result.history[0].E == pytest.approx(0.5)
    assert all(row.E_D == 0.0 and row.n_voxels == image.data.size for row in result.history)


def test_any_conforming_mesh(tmp_path):
    """A mesh of part of the box, with a reentrant corner: its outside nodes stay, E falls, it stays a mesh."""
    image, blocks = CASES["3-D"]
    whole = tetopt.lattice(image, blocks=blocks)
    centre = image.to_index(whole.points[whole.cells].mean(axis=1))
    cells = whole.cells[~(centre > np.array(image.shape) / 2).all(axis=1)]
    used, compact = np.unique(cells, return_inverse=True)
    part = tetopt.Mesh(whole.points[used], compact.reshape(cells.shape))
    result = tetopt.optimize(image, part, k_D=0.3, iterations=5)
    assert tetopt.check_mesh(result.mesh) == []
    assert result.history[-1].E < result.history[0].E
    assert {row.n_voxels for row in result.history} == {result.history[0].n_voxels}
    volume = [tetopt.quality(m.points, m.cells).volume for m in (part, result.mesh)]
    assert volume[0] == pytest.approx(volume[1], rel=1e-9)


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
        tetopt.optimize(image, tetopt.lattice(image, blocks=blocks), **options)


def test_refuses_doubled_cells():
    image, blocks = CASES["3-D"]
    mesh = tetopt.lattice(image, blocks=blocks)
    with pytest.raises(tetopt.InputError, match="or more than two"):
        tetopt.optimize(image, tetopt.Mesh(mesh.points, np.vstack([mesh.cells, mesh.cells[:1]])))


def test_run_measures_what_it_holds():
    """After iterations with floor and flips, the run's complex is what a fresh measurement finds."""
    image, blocks = CASES["oblique"]
    run = _Run(plain(image), tetopt.lattice(image, blocks=blocks), 0.5, 3.0, "slide")
    for _ in range(3):
        run.sweep(lambda: False)
        run.flip()
    run.lift(20.0)
    run.keep_floor(20.0)
    run.sweep(lambda: False)
    run.flip()
    n_cells = int(run.held.n_cells[0])
    fresh = build(run.held.cells[:n_cells], run.held.ticks, run.measure)
    np.testing.assert_array_equal(run.held.sums[:n_cells], fresh.sums[:n_cells])
    np.testing.assert_array_equal(run.held.across[:n_cells], fresh.across[:n_cells])
