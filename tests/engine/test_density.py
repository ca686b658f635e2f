"""Splits and collapses: each leaves a mesh, measured as if afresh, and changes E by what was
said.
"""

import naive
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from states import OBLIQUE, Engine, assumed_case, random_case
from test_fast import dimensions, seeds

import tetopt
from tetopt.energy.sampling import channel_grid
from tetopt.engine.complex import energies, node_stars, remeasure
from tetopt.engine.density import (
    EdgeMoves,
    Limits,
    best_collapses,
    best_splits,
    collapse_edge,
    exchange,
    make_exchanges,
    mend,
    roomy,
    too_long,
)
from tetopt.engine.flips import close_gaps
from tetopt.engine.repair import cell_cosines
from tetopt.engine.smooth import blocks
from tetopt.engine.state import state_of
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import boundary_facets
from tetopt.start.carve import part_of


def no_limits(n_nodes):
    return Limits(0.0, np.full(n_nodes, np.inf), 0.0, np.full(n_nodes, np.inf))


def exchanged(engine, n_nodes, most):
    made = exchange(engine.state, n_nodes, most, no_limits(len(engine.complex.ticks)))
    engine.state = made.state
    return made


def fix_boundary(engine):
    engine.state = engine.state._replace(sides=engine.state.sides._replace(is_fixed=True))
    engine.complex.is_frozen[engine.complex.is_frozen.any(axis=1), :3] = True


@settings(max_examples=6, deadline=None)
@given(seeds, dimensions, st.booleans(), st.booleans(), st.integers(-6, 12))
def test_exchanges_leave_a_mesh(seed, n, turned, is_graded, more):
    engine = assumed_case(seed, n, OBLIQUE if turned and n == 3 else None, 3.0)
    engine.change(is_graded=is_graded)
    engine.remeasure()
    assume(np.isfinite(engine.E))
    for _ in range(3):
        before, E = len(engine.complex.ticks), engine.E
        made = exchanged(engine, before + more, 5)
        engine.assert_sound()
        assert len(engine.complex.ticks) - before == made.n_split - made.n_collapsed
        assert min(made.n_split, made.n_collapsed) <= 5
        kept = made.source[made.source >= 0]
        assert len(kept) == before - made.n_collapsed
        assert (np.diff(kept) > 0).all()
        if more == 0:
            assert engine.E <= E * (1 + 1e-12)
        engine.sweep()
        engine.flip()
        engine.assert_sound()


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("is_fixed", [False, True])
def test_worth_is_what_E_falls_by(n, is_fixed):
    """The best split of every eighth node, and its best collapse, made alone."""
    count = 0
    for node in range(0, 40, 8):
        for kind in ("split", "collapse"):
            engine = random_case(7, n)
            engine.sweep()
            N = len(engine.complex.ticks)
            if is_fixed:
                fix_boundary(engine)
            if node >= N:
                continue
            stars, groups = node_stars(engine.state), blocks(engine.complex.ticks)
            was_frozen, E, everyone = engine.complex.is_frozen, engine.E, np.ones(N, dtype=bool)
            room = roomy(engine.state, N, 200)
            is_dirty = np.zeros(len(room.complex.cells), dtype=np.bool_)
            if kind == "split":
                splits = best_splits(room, stars, everyone, no_limits(N))
                if splits.other[node] < 0:
                    continue
                nobody = np.empty(0, dtype=np.int64)
                none = EdgeMoves(everyone, np.full(N, -1), np.full(N, -np.inf))
                made = make_exchanges(
                    room, stars, splits, none, np.array([node]), nobody, (1, 1, 0.0), is_dirty
                )
                assert made == (1, 0)
                expected = splits.gain[node]
                was_on, is_frozen = was_frozen[[node, splits.other[node]]], room.complex.is_frozen
                assert (is_frozen[N] <= was_on.all(axis=0)).all()
                if is_fixed and is_frozen[N].any():
                    assert is_frozen[N, :3].all()
                engine.state = room
                engine.change(ticks=room.complex.ticks[: N + 1], is_frozen=is_frozen[: N + 1])
            else:
                collapses = best_collapses(room, stars, groups, everyone, no_limits(N))
                if collapses.other[node] < 0:
                    continue
                collapse_edge(room, stars, node, collapses.other[node], is_dirty)
                close_gaps(room, is_dirty)
                expected = collapses.gain[node]
                engine.state = room
                assert not (engine.cells == node).any()
                # out of the mesh: numbered away
                engine.complex.ticks[node] = engine.complex.ticks[N - 1]
                engine.complex.cells[engine.complex.cells == N - 1] = node
                engine.change(ticks=engine.complex.ticks[: N - 1])
            count += 1
            assert E - engine.E == pytest.approx(expected, rel=1e-6, abs=1e-9)
            engine.assert_sound()
    assert count > 2


def test_splits_make_no_edge_shorter_than_asked():
    """Of every node's best split, the halves and the edges to the other corners; some splits are
    refused for it.
    """
    engine = random_case(5, 3)
    engine.sweep()
    N = len(engine.complex.ticks)
    stars, room = node_stars(engine.state), roomy(engine.state, N, 200)
    points, cells = engine.mesh.points, engine.mesh.cells
    shortest = 0.45 * float(
        np.median(np.linalg.norm(points[cells[:, 0]] - points[cells[:, 1]], axis=1))
    )
    made = []
    for limit in (0.0, shortest):
        split = best_splits(
            room, stars, np.ones(N, dtype=bool), no_limits(N)._replace(shortest=limit)
        ).other
        lengths = []
        for a in np.flatnonzero(split >= 0):
            star = cells[(cells == a).any(axis=1) & (cells == split[a]).any(axis=1)]
            middle = (points[a] + points[split[a]]) / 2.0
            lengths.append(np.linalg.norm(points[np.unique(star)] - middle, axis=1).min())
        made.append(np.array(lengths))
    assert made[0].min() < 0.95 * shortest
    assert len(made[1]) > 0
    assert made[1].min() >= shortest * (1 - 1e-3)  # ticks round the middle


@pytest.mark.parametrize("n", [2, 3])
def test_edges_too_long_for_their_targets_are_split_first(n):
    """The nodes that have one are the twin's; their splits come before all others, and raise E
    if they have to.
    """
    engine = random_case(5, n)
    engine.sweep()
    N = len(engine.complex.ticks)
    points, cells = engine.mesh.points, engine.mesh.cells
    ends = np.array([cells[:, [i, j]] for i in range(n + 1) for j in range(i)]).reshape(-1, 2)
    length = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    target = np.random.default_rng(2).uniform(0.6, 0.8, N) * np.percentile(length, 90)
    expected = naive.too_long(points.tolist(), cells.tolist(), target.tolist())
    np.testing.assert_array_equal(too_long(engine.state, target), expected)
    assert 0 < sum(expected) < N
    assert not too_long(engine.state, np.full(N, np.inf)).any()
    stars, room = node_stars(engine.state), roomy(engine.state, N, 200)
    limits = no_limits(N)._replace(target=target)
    plain, sized = (
        best_splits(room, stars, np.ones(N, dtype=bool), each) for each in (no_limits(N), limits)
    )
    is_long = np.zeros(N, dtype=bool)
    for a in np.flatnonzero(sized.other >= 0):
        b = sized.other[a]
        is_long[a] = (
            np.linalg.norm(points[a] - points[b]) > 2.0**0.5 * (target[a] + target[b]) / 2.0
        )
        if not is_long[a]:
            assert (sized.other[a], sized.gain[a]) == (plain.other[a], plain.gain[a])
    assert is_long.any()
    assert not is_long.all()
    assert sized.gain[is_long].min() > plain.gain.max() + 1e3
    made = exchange(engine.state, N, 2, limits)
    engine.state = made.state
    engine.assert_sound()
    assert made.n_split == made.n_collapsed == 2
    is_one = length > 2.0**0.5 * target[ends].mean(axis=1)
    middles = points[ends[is_one]].mean(axis=1)
    for point in engine.mesh.points[made.source < 0]:
        assert np.linalg.norm(middles - point, axis=1).min() < 1e-2  # ticks round them


def test_pairs_of_collapses_on_a_mask_leave_its_surface_whole():
    """With as many splits, and alone: the boundary stays one closed surface around a ball, marked
    as such, and E changes as measured afresh.
    """
    at = np.stack(np.meshgrid(*[np.arange(20) - 9.5] * 3, indexing="ij"), axis=-1)
    ball = tetopt.Image((np.linalg.norm(at, axis=-1) < 7.3).astype(float))
    target = tetopt.content(ball, mask=ball)
    mesh = tetopt.octree_mesh(target, 300)
    state = state_of(target, mesh, channel_grid(target, mesh.points), 0.85, is_graded=True)
    for fewer in (0, 20):
        n_nodes = len(state.complex.ticks)
        made = exchange(state, n_nodes - fewer, 30, no_limits(n_nodes))
        assert made.n_collapsed - made.n_split == fewer
        assert made.n_collapsed > 0
        state, n_cells = made.state, int(made.state.complex.n_cells[0])
        cells, sums = state.complex.cells[:n_cells], state.complex.sums[:n_cells].copy()
        outer = boundary_facets(cells)
        assert naive.euler(naive.faces_of(outer)) == 2
        assert naive.euler(naive.faces_of(cells)) == 1
        assert state.complex.is_frozen[np.unique(outer), 3].all()
        remeasure(state)
        np.testing.assert_allclose(state.complex.sums[:n_cells], sums, atol=1e-6 * sums.max())


@pytest.mark.parametrize("is_bounded", [False, True])
def test_collapses_are_the_best_of_all_neighbours(is_bounded):
    """Against meshes in which each node is joined to each neighbour, measured from nothing.

    Bounded: no new edge is longer than the bound at its ends, unless one as long was there.
    """
    engine = random_case(11, 3)
    engine.sweep()
    N, cells = len(engine.complex.ticks), engine.mesh.cells
    stars, groups = node_stars(engine.state), blocks(engine.complex.ticks)
    points = engine.mesh.points
    longest = np.random.default_rng(0).uniform(8.0, 20.0, N) if is_bounded else np.full(N, np.inf)
    collapses = best_collapses(
        engine.state, stars, groups, np.ones(N, dtype=bool), no_limits(N)._replace(longest=longest)
    )
    size = np.linalg.det(engine.mesh.points[cells[:, 1:]] - engine.mesh.points[cells[:, :1]]).sum()
    joined, refused = 0, 0
    for a in range(N):
        best = np.inf
        near = np.setdiff1d(cells[(cells == a).any(axis=1)], [a])
        old = np.linalg.norm(points[near] - points[a], axis=1).max()
        for b in near:
            new_edges = np.linalg.norm(points[near] - points[b], axis=1)
            if (new_edges > np.maximum(np.minimum(longest[near], longest[b]), old)).any():
                refused += 1
                continue
            new = np.where(cells == a, b, cells)[
                ~((cells == a).any(axis=1) & (cells == b).any(axis=1))
            ]
            volume = np.linalg.det(engine.mesh.points[new[:, 1:]] - engine.mesh.points[new[:, :1]])
            if (volume <= 1e-6).any() or abs(volume.sum() / size - 1) > 1e-9:
                continue
            is_frozen, ticks = engine.complex.is_frozen, engine.complex.ticks
            if (is_frozen[a, :3] & ~(is_frozen[b, :3] & (ticks[a] == ticks[b]))).any():
                continue
            E_G, squares = energies(engine.fresh(new))
            best = min(
                best, engine.objective.geometry * E_G + engine.objective.image * squares - engine.E
            )
        if best < np.inf:
            joined += 1
            assert -collapses.gain[a] == pytest.approx(best, rel=1e-6, abs=1e-9)
        else:
            assert collapses.other[a] == -1
    assert joined > 5
    assert (refused > 20) == is_bounded


@settings(max_examples=10, deadline=None)
@given(seeds, st.booleans())
def test_mending_by_nodes(seed, turned):
    """Nodes taken out and put in at the worst cells: fewer flat cells, none worse, and a mesh
    still.
    """
    engine = assumed_case(seed, 3, OBLIQUE if turned else None)
    target = -np.cos(np.radians(20.0))
    for _ in range(3):
        cosines = cell_cosines(engine.state)
        bad = np.flatnonzero(cosines < target)
        bad = bad[np.argsort(cosines[bad], kind="stable")]
        if len(bad) == 0:
            break
        mended = mend(engine.state, bad, target)
        engine.state = mended.state
        engine.assert_sound()
        assert cell_cosines(engine.state).min() >= min(cosines.min(), target)
        if mended.n_split + mended.n_collapsed == 0:
            break


@pytest.mark.full
def test_nodes_go_where_the_image_is():
    """A ball in a large box, exchanged at the same number of nodes: more of them near its
    surface, and less E_D.
    """
    index = np.stack(np.meshgrid(*[np.arange(32)] * 3, indexing="ij"), -1)
    image = tetopt.Image(100.0 * (((index - 20) ** 2).sum(-1) < 49))
    E_D, nodes_near = {}, {}
    for does_exchange in (False, True):
        engine = Engine(image, tetopt.lattice_mesh(image, blocks=(5, 5, 5)), 0.5, is_graded=True)
        engine.keep_min_dihedral(10.0)
        N, geometry = len(engine.complex.ticks), engine.objective.geometry
        for _ in range(8):
            engine.sweep()
            engine.flip()
            if does_exchange:  # most of a shape's cost goes when the nodes around move again
                engine.change(geometry=0.1 * geometry)
                exchanged(engine, N, N // 10)
                engine.change(geometry=geometry)
        for _ in range(3):
            engine.sweep()
            engine.flip()
        engine.assert_sound()
        distance = np.sqrt(((engine.image.to_index(engine.mesh.points) - 20) ** 2).sum(axis=1))
        nodes_near[does_exchange] = int((np.abs(distance - 7) < 2.5).sum())
        E_D[does_exchange] = energies(engine.state)[1]
        assert len(engine.complex.ticks) == N
        assert tetopt.quality(engine.mesh.points, engine.mesh.cells).min_dihedral >= 10.0
    assert nodes_near[True] > 1.3 * nodes_near[False]
    assert E_D[True] < 0.9 * E_D[False]


@pytest.mark.full
@pytest.mark.parametrize(("part", "boundary"), [("half", "fixed"), ("no octant", "slide")])
def test_a_part_of_the_box_stays_what_it_is(part, boundary):
    """Its faces off the box meet the box's in creases: new nodes stay on both."""
    index = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), -1)
    noise = np.random.default_rng(1).normal(size=(24,) * 3)
    image = tetopt.Image(100.0 * (((index - 11) ** 2).sum(-1) < 50) + noise)
    whole = tetopt.lattice_mesh(image, blocks=(4, 4, 4))
    centre = whole.points[whole.cells].mean(axis=1)
    kept = centre[:, 0] < 11.5 if part == "half" else ~(centre > 11.5).all(axis=1)
    start = part_of(whole, kept)
    result = tetopt.optimize(
        image, start, k_D=0.75, nodes=3 * len(start.points), boundary=boundary, iterations=6
    )
    assert len(result.mesh.points) > 1.5 * len(start.points)
    assert tetopt.check_mesh(result.mesh) == []
    assert volumes(result.mesh.points, result.mesh.cells).sum() == pytest.approx(
        volumes(start.points, start.cells).sum(), rel=1e-9
    )
    assert result.history[-1].n_voxels == result.history[0].n_voxels


@pytest.mark.parametrize("nodes", [0, 189.5])
def test_numbers_of_nodes_that_are_none(nodes):
    image = tetopt.Image(np.random.default_rng(1).normal(size=(10, 10, 10)))
    with pytest.raises(tetopt.InputError, match="nodes: expected a whole number"):
        tetopt.optimize(image, tetopt.lattice_mesh(image, blocks=(2, 2, 2)), nodes=nodes)


@pytest.mark.full
def test_far_more_nodes():
    """From 35 nodes towards 8000: doubled at most at each exchange, none of them wrong."""
    image = tetopt.Image(np.random.default_rng(1).normal(size=(20, 20, 20)))
    result = tetopt.optimize(
        image, tetopt.lattice_mesh(image, blocks=(2, 2, 2)), k_D=0.9, nodes=8000, iterations=6
    )
    assert 50 < len(result.mesh.points) < 8000
    assert tetopt.check_mesh(result.mesh, image) == []
