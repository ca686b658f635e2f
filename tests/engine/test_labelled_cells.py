"""Cells with labels: interfaces smooth, whole and manifold, and what every move keeps of them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapes import ball_image, distance, labels_alone

import tetopt
from tetopt import Image, mesh_image, quality
from tetopt.contents.content import content
from tetopt.energy.discretization import combine_energies
from tetopt.energy.sampling import channel_grid, from_ticks
from tetopt.engine.complex import cell_squares, energies, node_stars, remeasure
from tetopt.engine.density import Limits, _put_middle, best_splits, exchange, roomy, worth_of_split
from tetopt.engine.fast import Run
from tetopt.engine.flips import flip
from tetopt.engine.label_state import with_labels
from tetopt.engine.labelling import label_voxels
from tetopt.engine.loop import GRADED_K_D
from tetopt.engine.repair import repair
from tetopt.engine.sliding import combined_ways, constraint_values
from tetopt.engine.smooth import attract, blocks, sweep
from tetopt.engine.state import state_of, with_min_dihedral
from tetopt.geometry.topology import facets
from tetopt.measure.interfaces import label_interfaces


def ball_in_ball(n=32):
    """Labels 5 in 2 in 0: an off-centre ball in a ball, exactly known."""
    middle, shape = np.full(3, (n - 1) / 2), (n,) * 3
    inner = distance(shape, *(middle + np.array([2.1, 0.0, -1.3]))) < 5.0
    return Image(np.where(inner, 5.0, np.where(distance(shape, *middle) < 11.5, 2.0, 0.0)))


def quarters(n=20):
    """Three labels that meet along a line: a half of the box, and two quarters."""
    data = np.zeros((n, n, n))
    data[n // 2 :] = 1.0
    data[: n // 2, n // 2 :] = 2.0
    return Image(data)


CASES = {"balls": ball_in_ball(), "quarters": quarters()}


def state_for(target, nodes):
    """The state of an octree mesh, with labels if the content has some; the mesh and its grid."""
    mesh = tetopt.octree_mesh(target, nodes)
    grid, members = channel_grid(target, mesh.points), target.memberships
    state = state_of(target, mesh, grid, 0.85, is_graded=True)
    if members is not None:
        state = with_min_dihedral(state, 12.0)
        voxels = label_voxels(
            members.partition, target.image.spacing, len(members.labels), members.parts
        )
        state = with_labels(state, target, target.smooth, mesh, voxels)
    return state, mesh, grid


def labelled_state(name, nodes=500):
    """A state with labels of a case, its content and grid."""
    target = labels_alone(CASES[name])
    state, _, grid = state_for(target, nodes)
    return state, target, grid


def mesh_of(state, target, grid):
    """The mesh, and the label of each cell."""
    n_cells = int(state.complex.n_cells[0])
    points = target.image.to_world(from_ticks(state.complex.ticks, grid, 3))
    mesh = tetopt.Mesh(points, state.complex.cells[:n_cells].copy())
    return mesh, target.memberships.labels[state.complex.labels[:n_cells]]


def topology(state, target, grid):
    return [
        (row.label, row.mesh_euler, row.nonmanifold_edges, row.nonmanifold_nodes)
        for row in label_interfaces(target.image, *mesh_of(state, target, grid))
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


def measured(state):
    """Copies of the numbers of all cells, by their names."""
    n_cells = int(state.complex.n_cells[0])
    return {
        name: getattr(state.complex, name)[:n_cells].copy()
        for name in ("cells", "labels", "sums", "E_shape")
    }


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
def test_every_move_keeps_labels_topology_and_sums(name):
    """Euler numbers and manifoldness of every label, which labels meet at a node, and all sums
    measured afresh.
    """
    state, target, grid = labelled_state(name)
    state = MOVES["attract"](state)
    before = topology(state, target, grid)
    for move in ("sweep", "flip", "exchange", "attract", "sweep", "exchange", "flip", "repair"):
        old = [measured(state)["cells"], measured(state)["labels"], state.complex.ticks.copy()]
        state = MOVES[move](state)
        new = measured(state)
        if move in ("sweep", "flip", "exchange"):
            there = [new["cells"], new["labels"], state.complex.ticks]
            assert not all(map(np.array_equal, old, there)), move
        assert topology(state, target, grid) == before, move
        assert stated_labels(state) == meeting_labels(state), move
        remeasure(state)
        afresh, size = measured(state), np.abs(new["sums"]).max()
        assert_allclose(afresh["sums"], new["sums"], atol=1e-6 * size, err_msg=move)
        assert_allclose(afresh["E_shape"], new["E_shape"], rtol=1e-9, err_msg=move)


@pytest.mark.parametrize("has_mask", [False, True])
@pytest.mark.parametrize("has_labels", [False, True])
def test_splits_are_the_best_of_all_edges(has_mask, has_labels):
    """Of each node: none of its other edges would have gained more, though few are evaluated in
    full.
    """
    image = CASES["balls"]
    target = content(
        image, image if has_labels else None, Image(image.data > 0.0) if has_mask else None
    )
    state, mesh, _ = state_for(target, 200)
    N, stars = len(state.complex.ticks), node_stars(state)
    room, x = roomy(state, N, 0), np.empty((4, 3))
    free = np.full(N, np.inf)
    splits = best_splits(room, stars, np.ones(N, dtype=bool), Limits(0.0, free, 0.0, free))
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
        of_edge = around[(mesh.cells[around] == splits.other[a]).any(axis=1)]
        n_fitted += splits.gain[a] > energy[of_edge].sum()
    # whose misfit falls by more than the energy of the cells around
    assert (n_fitted > 5) == has_mask


def edge_lengths(mesh):
    """Lengths of edges, as many times as they have cells, and the mean length of the edges at the
    end of each where that is shorter.
    """
    pairs = np.concatenate([mesh.cells[:, [k, m]] for k in range(4) for m in range(k)])
    length = np.linalg.norm(mesh.points[pairs[:, 0]] - mesh.points[pairs[:, 1]], axis=1)
    mean = np.bincount(pairs.ravel(), np.repeat(length, 2)) / np.bincount(pairs.ravel())
    return length, mean[pairs].min(axis=1)


@pytest.mark.parametrize("name", CASES)
def test_nodes_do_not_meet_on_the_way_to_a_surface(name):
    """No edge becomes shorter than about a third of those around it; means change while
    neighbours move.
    """
    state, target, grid = labelled_state(name, 700)
    before, around = edge_lengths(mesh_of(state, target, grid)[0])
    assert (before > 0.45 * around).all()
    after, around = edge_lengths(mesh_of(attracted(state), target, grid)[0])
    assert (after != before).any()
    assert (after > 0.3 * around).all()


def test_energy_falls_with_labels():
    """Sweeps and flips never raise E, voxels of other labels with it."""
    state = MOVES["attract"](labelled_state("balls")[0])

    def E(state):
        return np.dot((state.objective.geometry, state.objective.image), energies(state))

    for move in ("sweep", "flip", "sweep", "flip"):
        before, state = E(state), MOVES[move](state)
        assert E(state) <= before * (1.0 + 1e-9), move


def test_squares_count_voxels_of_other_labels():
    """Of labels alone: a voxel of label b in a cell of label a costs a's squared value and b's."""
    state, target, grid = labelled_state("balls")
    mesh = mesh_of(state, target, grid)[0]
    owner = tetopt.cell_of_voxel(target.image, mesh).ravel()
    own, there = state.complex.labels[owner], target.memberships.partition.ravel()
    value = target.smooth.own_value.astype(float) ** 2
    cost = np.where(own != there, value[own] + value[there], 0.0)
    expected = np.bincount(owner, cost, len(mesh.cells))
    assert_allclose(cell_squares(state), expected, rtol=1e-9, atol=1e-6)
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
        assert_allclose(way, np.linalg.lstsq(slopes, rise, rcond=None)[0], rtol=1e-9)
    normal[1] = normal[4] = 2.0 * normal[0]
    assert not combined_ways(normal, 2, (1.0, 1.0, 0.0))[0]


@pytest.fixture(scope="module")
def balls():
    return mesh_image(labels_alone(CASES["balls"]), 1500)


def between(mesh, labels, *pair):
    """Nodes of the facets between cells of two labels."""
    shared = facets(mesh.cells)
    of_sides = np.sort(labels[shared.cells], axis=1)
    return shared.nodes[(shared.cells >= 0).all(axis=1) & (of_sides == pair).all(axis=1)]


FACET_PLACES = np.array(
    [[1, 1, 1], [2, 2, 0], [0, 2, 2], [2, 0, 2], [4, 1, 1], [1, 4, 1], [1, 1, 4]]
)
FACET_PLACES = FACET_PLACES / FACET_PLACES.sum(axis=1, keepdims=True)


@pytest.mark.full
def test_balls(balls):
    """Two nested balls: their surfaces are near, whole, manifold and without folds."""
    rows = {row.label: row for row in label_interfaces(CASES["balls"], balls.mesh, balls.labels)}
    for row in (rows[2], rows[5]):
        assert (row.nonmanifold_edges, row.nonmanifold_nodes) == (0, 0)
        assert (row.mesh_euler, row.mesh_cavities) == (row.euler, row.cavities)
        assert row.folded < 0.03
    for pair, centre, radius in (((0, 2), 15.5, 11.5), ((2, 5), np.array([17.6, 15.5, 14.2]), 5.0)):
        corners = balls.mesh.points[between(balls.mesh, balls.labels, *pair)]
        # Over the facets, as nodes lie off the surface by what these cut off: by .14 voxel on the
        # small ball.
        at = np.einsum("pk,fkd->fpd", FACET_PLACES, corners)
        off = np.abs(np.linalg.norm(at - centre, axis=2) - radius)
        assert off.mean() < 0.08
        assert np.quantile(off, 0.95) < 0.2
        assert off.max() < 0.45
        a, b, c = np.moveaxis(corners, 1, 0)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        assert area == pytest.approx(4.0 * np.pi * radius**2, rel=0.03)
    assert quality(balls.mesh.points, balls.mesh.cells).min_dihedral >= 12.0


@pytest.mark.full
def test_E_of_the_history_is_comparable_throughout():
    """Eq. (4) in every row, also where cells have labels, whose own values moves follow."""
    phantom = tetopt.load_phantom("sphere")
    what = content(phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=4))
    result = mesh_image(what, 300, iterations=4)
    assert result.labels is not None
    first, history = result.history[0], result.history
    expected = [
        combine_energies(row.E_G, row.E_D, first.E_G, first.E_D, GRADED_K_D) for row in history
    ]
    assert [row.E for row in history] == pytest.approx(expected, rel=1e-9)


def test_nodes_of_three_labels_lie_on_their_curve():
    """Where three labels meet along a line, nodes between them come to it, and stay on it."""
    state = labelled_state("quarters")[0]
    for move in ("attract", "sweep", "flip") * 4:
        state = MOVES[move](state)
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
    data = 1.0 * (ball_in_ball().data > 0.0)[:, :, 1::3]
    thick = Image(data, np.diag([1.0, 1.0, 3.0, 1.0]))
    target = labels_alone(thick)
    assert target.image.shape == (32, 32, 3 * data.shape[2])
    assert_allclose(target.image.volume, thick.volume)
    smooth, rough = (
        mesh_image(each, 1200, iterations=8)
        for each in (target, labels_alone(thick, smooth_interfaces=False))
    )
    assert rough.labels is None
    row, before = (
        label_interfaces(thick, mesh, labels)[1]
        for mesh, labels in (
            (smooth.mesh, smooth.labels),
            (rough.mesh, tetopt.cell_labels(thick, rough.mesh)),
        )
    )
    assert row.folded < 0.08
    assert row.area == pytest.approx(4.0 * np.pi * 11.5**2, rel=0.08)
    assert before.folded > 4.0 * row.folded


DISC = ball_image((40, 40), (19.5, 19.5), 12.0)


def test_triangles():
    """A disc in the plane: its outline is one circle."""
    result = mesh_image(labels_alone(DISC), 200)
    nodes, count = np.unique(between(result.mesh, result.labels, 0, 1), return_counts=True)
    assert (count == 2).all()
    assert np.abs(np.linalg.norm(result.mesh.points[nodes] - 19.5, axis=1) - 12.0).max() < 0.4


def patches(seed, n, count):
    """Labels of the nearest of some random places: many of them meet at a node of large cells."""
    places = np.random.default_rng(seed).uniform(0, n, (count, 3))
    away = [distance((n,) * 3, *place) for place in places]
    return Image(np.argmin(away, axis=0).astype(float))


def test_collapses_keep_labels_as_small_as_a_cell():
    """Where labels are as small as cells: no cell between two interfaces goes with a node, nor
    one of five labels.
    """
    target = labels_alone(patches(27, 14, 6))
    state, _, grid = state_for(target, 300)
    for move in ("attract", "sweep", "flip", "exchange"):
        before = topology(state, target, grid)
        state = MOVES[move](state)
        assert topology(state, target, grid) == before, move
    for stated, there in zip(stated_labels(state), meeting_labels(state), strict=True):
        assert stated == there or (len(stated) == 4 and stated < there)


@pytest.mark.full
def test_uniform_meshes_go_on_with_labels(monkeypatch):
    """The energy that falls is another one once cells have labels, and higher: that is not yet
    the end.
    """
    result = mesh_image(labels_alone(DISC), 200, mode="uniform")
    monkeypatch.setattr("tetopt.engine.fast.CONVERGED_FALL", 0.9)
    few = mesh_image(labels_alone(DISC), 200, mode="uniform")
    assert result.history[-1].iteration > 3
    assert few.labels is not None


@pytest.mark.full
def test_the_minimum_dihedral_angle_within_a_mask():
    """Nodes are brought between labels without a flat cell, which might not be lifted again."""
    target = labels_alone(patches(2, 12, 20), mask=ball_image((12,) * 3, (5.5,) * 3, 5.2))
    mesh = mesh_image(target, 300).mesh
    assert quality(mesh.points, mesh.cells).min_dihedral >= 12.0


def test_labels_meet_as_before_where_cells_were_removed():
    """Of the boundary of a mask: nodes that keep one label slide no more on the way to another."""
    target = labels_alone(CASES["quarters"], mask=ball_image((20,) * 3, (9.5,) * 3, 8.0))
    run = Run(target, tetopt.octree_mesh(target, 500), 0.85, is_graded=True)
    run.give_labels()
    is_outer = (run.state.complex.across[: run.n_cells] < 0).any(axis=1)
    before = sum(map(bool, stated_labels(run.state)))
    assert run._take_out(is_outer & (run.state.complex.labels[: run.n_cells] == 1)) > 0
    assert stated_labels(run.state) == meeting_labels(run.state)
    assert sum(map(bool, stated_labels(run.state))) < before
