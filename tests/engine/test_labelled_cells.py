"""Cells with labels: interfaces smooth, whole and manifold, and what every move keeps of them."""

import numba
import numpy as np
import pytest

import tetopt
from tetopt.contents.content import content
from tetopt.energy.discretization import combine_energies
from tetopt.energy.sampling import channel_grid, from_ticks
from tetopt.engine.complex import cell_squares, energies, node_stars, remeasure
from tetopt.engine.density import Limits, _put_middle, best_splits, exchange, roomy, worth_of_split
from tetopt.engine.flips import flip
from tetopt.engine.label_state import with_labels
from tetopt.engine.labelling import label_voxels
from tetopt.engine.loop import GRADED_K_D
from tetopt.engine.repair import repair
from tetopt.engine.sliding import combined_ways, constraint_values
from tetopt.engine.smooth import attract, blocks, sweep
from tetopt.engine.state import state_of, with_min_dihedral
from tetopt.measure.interfaces import label_interfaces


def ball_in_ball(n=32, spacing=(1.0, 1.0, 1.0)):
    """Labels 5 in 2 in 0: an off-centre ball in a ball, exactly known."""
    at = np.stack(np.meshgrid(*[np.arange(n) - (n - 1) / 2] * 3, indexing="ij"), axis=-1)
    inner = np.linalg.norm(at - [2.1, 0.0, -1.3], axis=-1) < 5.0
    data = np.where(inner, 5.0, np.where(np.linalg.norm(at, axis=-1) < 11.5, 2.0, 0.0))
    return tetopt.Image(data, np.diag([*spacing, 1.0]))


def quarters(n=20):
    """Three labels that meet along a line: a half of the box, and two quarters."""
    data = np.zeros((n, n, n))
    data[n // 2 :] = 1.0
    data[: n // 2, n // 2 :] = 2.0
    return tetopt.Image(data)


CASES = {"balls": ball_in_ball(), "quarters": quarters()}


def voxels_of(target):
    """Information on the voxels of a content's labels."""
    members = target.memberships
    return label_voxels(members.partition, target.image.spacing, len(members.labels), members.parts)


@pytest.fixture(scope="module")
def labelled_state():
    """A state with labels, some moves on, of each case; a function, as tests change it."""

    def made(name, nodes=500):
        target = content(CASES[name], labels=CASES[name], weights=[0.0])
        mesh = tetopt.octree_mesh(target, nodes)
        grid = channel_grid(target, mesh.points)
        state = with_min_dihedral(state_of(target, mesh, grid, 0.85, is_graded=True), 12.0)
        return with_labels(state, target, target.smooth, mesh, voxels_of(target)), target, grid

    return made


def parts(state, target, grid):
    """Mesh, label of each cell, and the labels' rows in `label_interfaces`."""
    n_cells = int(state.complex.n_cells[0])
    points = target.image.to_world(from_ticks(state.complex.ticks, grid, 3))
    mesh = tetopt.Mesh(points, state.complex.cells[:n_cells].copy())
    labels = target.memberships.labels[state.complex.labels[:n_cells]]
    return mesh, labels, label_interfaces(target.image, mesh, labels)


def topology(state, target, grid):
    return [
        (row.label, row.mesh_euler, row.nonmanifold_edges, row.nonmanifold_nodes)
        for row in parts(state, target, grid)[2]
    ]


def meeting_labels(state):
    """The labels around each node, plainly."""
    n_cells = int(state.complex.n_cells[0])
    around = [set() for _ in state.complex.ticks]
    for cell, label in zip(
        state.complex.cells[:n_cells], state.complex.labels[:n_cells], strict=True
    ):
        for node in cell:
            around[node].add(int(label))
    return [labels if len(labels) > 1 else set() for labels in around]


def stated_labels(state):
    """The labels stated for each node, which are in rising order."""
    rows = [row[row >= 0].tolist() for row in state.complex.meeting]
    assert rows == [sorted(row) for row in rows]
    return [set(row) for row in rows]


def swept(state):
    n_nodes = len(state.complex.ticks)
    sweep(state, node_stars(state), blocks(state.complex.ticks), np.ones(n_nodes, dtype=bool))
    return state


def attracted(state):
    attract(state, node_stars(state), blocks(state.complex.ticks), -0.99)
    return state


def exchanged(state):
    n_nodes = len(state.complex.ticks)
    return exchange(
        state, n_nodes - 30, 60, Limits(1.0, np.full(n_nodes, 1e3), 0.0, np.full(n_nodes, np.inf))
    ).state


MOVES = {
    "sweep": swept,
    "attract": attracted,
    "flip": lambda state: flip(state)[0],
    "exchange": exchanged,
    "repair": lambda state: repair(state, 25.0).state,
}


@pytest.mark.parametrize("name", CASES)
def test_every_move_keeps_labels_topology_and_sums(labelled_state, name):
    """Euler numbers and manifoldness of every label, which labels meet at a node, and all sums
    measured afresh.
    """
    state, target, grid = labelled_state(name)
    state = MOVES["attract"](state)
    before = topology(state, target, grid)
    for move in ("sweep", "flip", "exchange", "attract", "sweep", "exchange", "flip", "repair"):
        n_cells = int(state.complex.n_cells[0])
        old = (
            state.complex.cells[:n_cells].copy(),
            state.complex.labels[:n_cells].copy(),
            state.complex.ticks.copy(),
        )
        state = MOVES[move](state)
        n_cells = int(state.complex.n_cells[0])
        new = state.complex.cells[:n_cells], state.complex.labels[:n_cells], state.complex.ticks
        if move in ("sweep", "flip", "exchange"):
            assert any(
                a.shape != b.shape or (a != b).any() for a, b in zip(old, new, strict=True)
            ), move
        assert topology(state, target, grid) == before, move
        assert stated_labels(state) == meeting_labels(state), move
        sums, E_shape = state.complex.sums[:n_cells].copy(), state.complex.E_shape[:n_cells].copy()
        remeasure(state)
        np.testing.assert_allclose(
            state.complex.sums[:n_cells], sums, atol=1e-6 * np.abs(sums).max(), err_msg=move
        )
        np.testing.assert_allclose(
            state.complex.E_shape[:n_cells], E_shape, rtol=1e-9, err_msg=move
        )


@pytest.mark.parametrize("has_mask", [False, True])
@pytest.mark.parametrize("has_labels", [False, True])
def test_splits_are_the_best_of_all_edges(has_mask, has_labels):
    """Of each node: none of its other edges would have gained more, though few are evaluated in
    full.
    """
    image = CASES["balls"]
    target = content(
        image, image if has_labels else None, tetopt.Image(image.data > 0.0) if has_mask else None
    )
    mesh = tetopt.octree_mesh(target, 200)
    state = state_of(target, mesh, channel_grid(target, mesh.points), 0.85, is_graded=True)
    if has_labels:
        state = with_labels(state, target, target.smooth, mesh, voxels_of(target))
    N, stars = len(state.complex.ticks), node_stars(state)
    room, x = roomy(state, N, 0), np.empty((4, 3))
    splits = best_splits(
        room,
        stars,
        np.ones(N, dtype=bool),
        Limits(0.0, np.full(N, np.inf), 0.0, np.full(N, np.inf)),
    )
    energy = state.objective.geometry * state.complex.E_shape[: len(mesh.cells)]
    energy = energy + state.objective.image * cell_squares(state)
    n_fitted = 0
    for a in range(N):
        around = stars.cells[stars.start[a] : stars.start[a + 1]]
        near = np.unique(mesh.cells[around])
        gains = [
            worth_of_split(x, room, stars, a, b, N + a, -np.inf)
            for b in near[near > a]
            if _put_middle(room, stars, a, b, N + a)
        ]
        assert splits.gain[a] == pytest.approx(max(gains, default=-np.inf), rel=1e-9)
        n_fitted += (
            splits.gain[a]
            > energy[around[(mesh.cells[around] == splits.other[a]).any(axis=1)]].sum()
        )
    # whose misfit falls by more than the energy of the cells around
    assert (n_fitted > 5) == has_mask


def lengths(state, target, grid):
    """Edges (a, b), their lengths, and the mean length of each node's edges, as many times as
    they have cells.
    """
    mesh = parts(state, target, grid)[0]
    pairs = np.concatenate([mesh.cells[:, [k, m]] for k in range(4) for m in range(k)])
    length = np.linalg.norm(mesh.points[pairs[:, 0]] - mesh.points[pairs[:, 1]], axis=1)
    return (
        pairs,
        length,
        np.bincount(pairs.ravel(), np.repeat(length, 2)) / np.bincount(pairs.ravel()),
    )


@pytest.mark.parametrize("name", CASES)
def test_nodes_do_not_meet_on_the_way_to_a_surface(labelled_state, name):
    """No edge becomes shorter than about a third of those around it; means change while
    neighbours move.
    """
    state, target, grid = labelled_state(name, 700)
    pairs, before, mean = lengths(state, target, grid)
    assert (before > 0.45 * mean[pairs].min(axis=1)).all()
    pairs, after, mean = lengths(attracted(state), target, grid)
    assert (after != before).any()
    assert (after > 0.3 * mean[pairs].min(axis=1)).all()


def test_energy_falls_with_labels(labelled_state):
    """Sweeps and flips never raise E, voxels of other labels with it."""
    state, _, _ = labelled_state("balls")
    state = MOVES["attract"](state)

    def E():
        E_G, squares = energies(state)
        return state.objective.geometry * E_G + state.objective.image * squares

    last = E()
    for move in ("sweep", "flip", "sweep", "flip"):
        state = MOVES[move](state)
        assert last * (1.0 + 1e-9) >= E(), move
        last = E()


def test_squares_count_voxels_of_other_labels(labelled_state):
    """Of labels alone: a voxel of label b in a cell of label a costs a's squared value and b's."""
    state, target, grid = labelled_state("balls")
    mesh, _, _ = parts(state, target, grid)
    owner = tetopt.energy.sampling.cell_of_voxel(target.image, mesh).ravel()
    own, there = state.complex.labels[owner], target.memberships.partition.ravel()
    value = target.smooth.own_value.astype(float) ** 2
    cost = np.where(own != there, value[own] + value[there], 0.0)
    np.testing.assert_allclose(
        cell_squares(state), np.bincount(owner, cost, len(mesh.cells)), rtol=1e-9, atol=1e-6
    )
    assert cost.sum() > 0.0


@pytest.mark.kernel
def test_combined_ways_are_the_shortest():
    """As least squares have them, for one to three constraints; none where two are parallel."""
    rng = np.random.default_rng(0)
    for count in (1, 2, 3):
        slopes, rise = rng.normal(size=(count, 3)), rng.normal(size=count)
        normal = np.zeros((7, 3))
        normal[:count] = normal[3 : 3 + count] = slopes
        is_found, way = combined_ways(normal, count, (*rise, 0.0, 0.0)[:3])
        assert is_found
        np.testing.assert_allclose(way, np.linalg.lstsq(slopes, rise, rcond=None)[0], rtol=1e-9)
    normal[1] = normal[4] = 2.0 * normal[0]
    assert not combined_ways(normal, 2, (1.0, 1.0, 0.0))[0]


@pytest.fixture(scope="module")
def balls():
    return tetopt.mesh_image(content(CASES["balls"], labels=CASES["balls"], weights=[0.0]), 1500)


FACET_PLACES = np.array(
    [[1, 1, 1], [2, 2, 0], [0, 2, 2], [2, 0, 2], [4, 1, 1], [1, 4, 1], [1, 1, 4]]
)
FACET_PLACES = FACET_PLACES / FACET_PLACES.sum(axis=1, keepdims=True)


@pytest.mark.full
def test_balls(balls):
    """Two nested balls: their surfaces are near, whole, manifold and without folds."""
    rows = {row.label: row for row in label_interfaces(CASES["balls"], balls.mesh, balls.labels)}
    for label in (2, 5):
        row = rows[label]
        assert (row.nonmanifold_edges, row.nonmanifold_nodes) == (0, 0)
        assert (row.mesh_euler, row.mesh_cavities) == (row.euler, row.cavities)
        assert row.folded < 0.03
    shared = tetopt.geometry.topology.facets(balls.mesh.cells)
    labels = balls.labels[shared.cells]
    for pair, centre, radius in (((0, 2), 15.5, 11.5), ((2, 5), np.array([17.6, 15.5, 14.2]), 5.0)):
        is_between = (shared.cells >= 0).all(axis=1) & (np.sort(labels, axis=1) == pair).all(axis=1)
        corners = balls.mesh.points[shared.nodes[is_between]]
        # Over the facets, as nodes lie off the surface by what these cut off: by .14 voxel on the
        # small ball.
        off = np.abs(
            np.linalg.norm(np.einsum("pk,fkd->fpd", FACET_PLACES, corners) - centre, axis=2)
            - radius
        )
        assert off.mean() < 0.08
        assert np.quantile(off, 0.95) < 0.2
        assert off.max() < 0.45
        a, b, c = np.moveaxis(corners, 1, 0)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        assert area == pytest.approx(4.0 * np.pi * radius**2, rel=0.03)
    assert tetopt.quality(balls.mesh.points, balls.mesh.cells).min_dihedral >= 12.0


@pytest.mark.full
def test_same_bits_on_any_number_of_threads():
    before, runs = numba.get_num_threads(), []
    try:
        for threads in (before, 1):
            numba.set_num_threads(threads)
            target = content(CASES["balls"], labels=CASES["balls"], weights=[0.0])
            runs.append(tetopt.mesh_image(target, 400, iterations=4))
    finally:
        numba.set_num_threads(before)
    many, one = runs
    np.testing.assert_array_equal(one.mesh.points, many.mesh.points)
    np.testing.assert_array_equal(one.mesh.cells, many.mesh.cells)
    np.testing.assert_array_equal(one.labels, many.labels)


@pytest.mark.full
def test_E_of_the_history_is_comparable_throughout():
    """Eq. (4) in every row, also where cells have labels, whose own values moves follow."""
    phantom = tetopt.load_phantom("sphere")
    what = tetopt.content(phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=4))
    result = tetopt.mesh_image(what, 300, iterations=4)
    first = result.history[0]
    assert result.labels is not None
    for row in result.history:
        assert row.E == pytest.approx(
            combine_energies(row.E_G, row.E_D, first.E_G, first.E_D, GRADED_K_D), rel=1e-9
        )


def test_nodes_of_three_labels_lie_on_their_curve(labelled_state):
    """Where three labels meet along a line, nodes between them come to it, and stay on it."""
    state, _, _ = labelled_state("quarters")
    for _ in range(4):
        state = MOVES["attract"](state)
        state = MOVES["sweep"](state)
        state = MOVES["flip"](state)
    is_curve = state.complex.meeting[:, 2] >= 0
    assert is_curve.sum() > 5
    at = state.complex.ticks[is_curve] * 2.0**-state.objective.bits
    # levels are smooth: the edge of a quarter is rounded off
    assert np.abs(at[:, :2] - 9.5).max() < 0.8
    normal = np.zeros((7, 3))
    for node in np.flatnonzero(is_curve):
        assert constraint_values(normal, state, node) == 2


@pytest.mark.full
def test_thick_slices_do_not_show():
    """A ball on slices four times as thick as voxels: no fold between slices, and half of the
    steps' area is gone.
    """
    fine = ball_in_ball(32)
    data = np.where(fine.data > 0.0, 1.0, 0.0)[:, :, 1::3]
    thick = tetopt.Image(data, np.diag([1.0, 1.0, 3.0, 1.0]))
    target = content(thick, labels=thick, weights=[0.0])
    assert target.image.shape == (32, 32, 3 * data.shape[2])
    np.testing.assert_allclose(target.image.volume, thick.volume)
    result = tetopt.mesh_image(target, 1200, iterations=8)
    row = label_interfaces(thick, result.mesh, result.labels)[1]
    assert row.folded < 0.08
    assert row.area == pytest.approx(4.0 * np.pi * 11.5**2, rel=0.08)
    rough = tetopt.mesh_image(
        content(thick, labels=thick, weights=[0.0], smooth_interfaces=False), 1200, iterations=8
    )
    assert rough.labels is None
    before = label_interfaces(thick, rough.mesh, tetopt.cell_labels(thick, rough.mesh))[1]
    assert before.folded > 4.0 * row.folded


def test_triangles():
    """A disc in the plane: its outline is one circle."""
    at = np.stack(np.meshgrid(*[np.arange(40) - 19.5] * 2, indexing="ij"), axis=-1)
    disc = tetopt.Image((np.linalg.norm(at, axis=-1) < 12.0).astype(float))
    result = tetopt.mesh_image(content(disc, labels=disc, weights=[0.0]), 200)
    facets = tetopt.geometry.topology.facets(result.mesh.cells)
    labels = result.labels[facets.cells]
    is_between = (facets.cells >= 0).all(axis=1) & (labels[:, 0] != labels[:, 1])
    nodes, count = np.unique(facets.nodes[is_between], return_counts=True)
    assert (count == 2).all()
    assert np.abs(np.linalg.norm(result.mesh.points[nodes] - 19.5, axis=1) - 12.0).max() < 0.4


def patches(seed, n, count):
    """Labels of the nearest of some random places: many of them meet at a node of large cells."""
    at = np.indices((n,) * 3).reshape(3, -1).T
    places = np.random.default_rng(seed).uniform(0, n, (count, 3))
    nearest = ((at[:, None] - places) ** 2).sum(axis=-1).argmin(axis=1)
    return tetopt.Image(nearest.reshape((n,) * 3).astype(float))


def test_collapses_keep_labels_as_small_as_a_cell(labelled_state):
    """Where labels are as small as cells: no cell between two interfaces goes with a node, nor
    one of five labels.
    """
    image = patches(27, 14, 6)
    target = content(image, labels=image, weights=[0.0])
    mesh = tetopt.octree_mesh(target, 300)
    grid = channel_grid(target, mesh.points)
    state = with_labels(
        with_min_dihedral(state_of(target, mesh, grid, 0.85, is_graded=True), 12.0),
        target,
        target.smooth,
        mesh,
        voxels_of(target),
    )
    before = None
    for move in ("attract", "sweep", "flip", "exchange"):
        before = topology(state, target, grid)
        state = MOVES[move](state)
        assert topology(state, target, grid) == before, move
    for stated, there in zip(stated_labels(state), meeting_labels(state), strict=True):
        assert stated == there or (len(stated) == 4 and stated < there)


@pytest.mark.full
def test_uniform_meshes_go_on_with_labels():
    """The energy that falls is another one once cells have labels, and higher: that is not yet
    the end.
    """
    at = np.stack(np.meshgrid(*[np.arange(40) - 19.5] * 2, indexing="ij"), axis=-1)
    disc = tetopt.Image((np.linalg.norm(at, axis=-1) < 12.0).astype(float))
    result = tetopt.mesh_image(content(disc, labels=disc, weights=[0.0]), 200, mode="uniform")
    assert result.history[-1].iteration > 3
    few = tetopt.mesh_image(
        content(disc, labels=disc, weights=[0.0]), 200, mode="uniform", tolerance=0.9
    )
    assert few.labels is not None


@pytest.mark.full
def test_the_minimum_dihedral_angle_within_a_mask():
    """Nodes are brought between labels without a flat cell, which might not be lifted again."""
    image = patches(2, 12, 20)
    at = np.stack(np.meshgrid(*[np.arange(12) - 5.5] * 3, indexing="ij"), axis=-1)
    mask = tetopt.Image((np.linalg.norm(at, axis=-1) < 5.2).astype(float))
    result = tetopt.mesh_image(content(image, labels=image, mask=mask, weights=[0.0]), 300)
    assert tetopt.quality(result.mesh.points, result.mesh.cells).min_dihedral >= 12.0
