"""Splits and collapses: each leaves a mesh, measured as if afresh, and changes E by what was
said.
"""

from itertools import permutations

import naive
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from meshes import both_dimensions, dimensions, mesh_edges, seeds
from numpy.testing import assert_allclose, assert_array_equal
from shapes import ball_image, distance
from states import OBLIQUE, Engine, assumed_case, on_lattice, random_case

import tetopt
from tetopt import Image, check_mesh, optimize
from tetopt.energy.sampling import channel_grid
from tetopt.engine.complex import energies, node_stars, remeasure
from tetopt.engine.density import (
    EdgeMoves,
    Limits,
    _is_linked,
    best_collapses,
    best_splits,
    collapse_edge,
    compact_state,
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
from tetopt.geometry.check import manifold_problems
from tetopt.geometry.simplex import orient_cells, volumes
from tetopt.geometry.topology import boundary_facets
from tetopt.start.carve import part_of


def no_limits(n_nodes, **limits):
    free = np.full(n_nodes, np.inf)
    return Limits(0.0, free, 0.0, free)._replace(**limits)


def everyone(n_nodes):
    return np.ones(n_nodes, dtype=bool)


def exchanged(engine, n_nodes, most):
    made = exchange(engine.state, n_nodes, most, no_limits(len(engine.complex.ticks)))
    engine.state = made.state
    return made


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


def room_of(engine):
    """A state with room for more, and the stars of its nodes."""
    return roomy(engine.state, len(engine.complex.ticks), 200), node_stars(engine.state)


def swept_case(seed, n):
    engine = random_case(seed, n)
    engine.sweep()
    return engine


@both_dimensions
@pytest.mark.parametrize("is_fixed", [False, True])
@pytest.mark.parametrize("kind", ["split", "collapse"])
def test_worth_is_what_E_falls_by(n, is_fixed, kind):
    """The best split of every eighth node, or its best collapse, made alone."""
    count = 0
    for node in range(0, 40, 8):
        engine = swept_case(7, n)
        N, on_boundary = len(engine.complex.ticks), engine.complex.is_frozen.any(axis=1)
        if is_fixed:
            engine.state = engine.state._replace(sides=engine.state.sides._replace(is_fixed=True))
            engine.complex.is_frozen[on_boundary, :3] = True
        if node >= N:
            continue
        was_frozen, E = engine.complex.is_frozen, engine.E
        (room, stars), limits = room_of(engine), no_limits(N)
        best = (
            best_splits(room, stars, everyone(N), limits)
            if kind == "split"
            else best_collapses(room, stars, blocks(engine.complex.ticks), everyone(N), limits)
        )
        other = best.other[node]
        if other < 0:
            continue
        engine.state = room
        is_dirty = np.zeros(len(room.complex.cells), dtype=np.bool_)
        if kind == "split":
            none = EdgeMoves(everyone(N), np.full(N, -1), np.full(N, -np.inf))
            nodes = np.array([node]), np.empty(0, dtype=np.int64)
            made = make_exchanges(room, stars, best, none, *nodes, (1, 1, 0.0), is_dirty)
            assert made == (1, 0)
            is_frozen = room.complex.is_frozen
            assert (is_frozen[N] <= was_frozen[[node, other]].all(axis=0)).all()
            if is_fixed and is_frozen[N].any():
                assert is_frozen[N, :3].all()
            engine.change(ticks=room.complex.ticks[: N + 1], is_frozen=is_frozen[: N + 1])
        else:
            collapse_edge(room, stars, node, other, is_dirty)
            close_gaps(room, is_dirty)
            assert not (engine.cells == node).any()
            # out of the mesh: numbered away
            engine.complex.ticks[node] = engine.complex.ticks[N - 1]
            engine.complex.cells[engine.complex.cells == N - 1] = node
            engine.change(ticks=engine.complex.ticks[: N - 1])
        count += 1
        assert E - engine.E == pytest.approx(best.gain[node], rel=1e-6, abs=1e-9)
        engine.assert_sound()
    assert count > 0


def test_splits_make_no_edge_shorter_than_asked():
    """Of every node's best split, the halves and the edges to the other corners; some splits are
    refused for it.
    """
    engine = swept_case(5, 3)
    (room, stars), N = room_of(engine), len(engine.complex.ticks)
    points, cells = engine.mesh.points, engine.mesh.cells
    shortest = 0.45 * float(np.median(mesh_edges(engine.mesh)[1]))
    made = []
    for limit in (0.0, shortest):
        split = best_splits(room, stars, everyone(N), no_limits(N, shortest=limit)).other
        lengths = []
        for a in np.flatnonzero(split >= 0):
            star = cells[np.isin(cells, [a, split[a]]).sum(axis=1) == 2]
            middle = (points[a] + points[split[a]]) / 2.0
            lengths.append(np.linalg.norm(points[np.unique(star)] - middle, axis=1).min())
        made.append(min(lengths))
    assert made[0] < 0.95 * shortest
    assert made[1] >= shortest * (1 - 1e-3)  # ticks round the middle


@both_dimensions
def test_edges_too_long_for_their_targets_are_split_first(n):
    """The nodes that have one are the twin's; their splits come before all others, and raise E
    if they have to.
    """
    engine = swept_case(5, n)
    mesh, N = engine.mesh, len(engine.complex.ticks)
    ends, length = mesh_edges(mesh)
    target = np.random.default_rng(2).uniform(0.6, 0.8, N) * np.percentile(length, 90)
    expected = naive.too_long(mesh.points.tolist(), mesh.cells.tolist(), target.tolist())
    assert_array_equal(too_long(engine.state, target), expected)
    assert 0 < sum(expected) < N
    assert not too_long(engine.state, np.full(N, np.inf)).any()
    room, stars = room_of(engine)
    plain, sized = (
        best_splits(room, stars, everyone(N), each)
        for each in (no_limits(N), no_limits(N, target=target))
    )
    (is_one,) = np.nonzero(length > 2.0**0.5 * target[ends].mean(axis=1))
    long = set(map(frozenset, ends[is_one].tolist()))
    is_long = np.array([{a, b} in long for a, b in enumerate(sized.other.tolist())])
    for one, other in zip((sized.other, sized.gain), (plain.other, plain.gain), strict=True):
        assert_array_equal(one[~is_long], other[~is_long])
    assert 0 < is_long.sum() < np.count_nonzero(sized.other >= 0)
    assert sized.gain[is_long].min() > plain.gain.max() + 1e3
    made = exchange(engine.state, N, 2, no_limits(N, target=target))
    engine.state = made.state
    engine.assert_sound()
    assert made.n_split == made.n_collapsed == 2
    middles = mesh.points[ends[is_one]].mean(axis=1)
    for point in engine.mesh.points[made.source < 0]:
        assert np.linalg.norm(middles - point, axis=1).min() < 1e-2  # ticks round them


def test_pairs_of_collapses_on_a_mask_leave_its_surface_whole():
    """With as many splits, and alone: the boundary stays one closed surface around a ball, marked
    as such, and E changes as measured afresh.
    """
    ball = ball_image((20, 20, 20), (9.5, 9.5, 9.5), 7.3)
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
        assert [naive.euler(naive.faces_of(each)) for each in (outer, cells)] == [2, 1]
        assert state.complex.is_frozen[np.unique(outer), 3].all()
        remeasure(state)
        assert_allclose(state.complex.sums[:n_cells], sums, atol=1e-6 * sums.max())


def block_ring():
    """3 x 3 x 1 blocks of six tetrahedra without the middle one, and the numbers of their nodes."""
    number = np.arange(32).reshape(4, 4, 2)
    points = 4.0 * np.stack(np.unravel_index(number.ravel(), number.shape), axis=1) + 1.5
    cells = [
        [number[tuple(np.add(block, np.isin(range(3), way[:n])))] for n in range(4)]
        for block in np.ndindex(3, 3, 1)
        for way in permutations(range(3))
        if block != (1, 1, 0)
    ]
    return tetopt.Mesh(points, orient_cells(points, np.array(cells))), number


def test_two_collapses_do_not_close_a_tunnel_on_a_mask():
    """Opposite edges of its rim: each may be collapsed alone, both would pinch the boundary."""
    (mesh, number), mask = block_ring(), np.zeros((16, 16, 8))
    mask[2:14, 2:14, 2:6], mask[6:10, 6:10] = 1.0, 0.0
    target = tetopt.content(Image(mask), mask=Image(mask))
    state = state_of(target, mesh, channel_grid(target, mesh.points), 0.85, is_graded=True)
    stars, N = node_stars(state), len(mesh.points)
    (a, b), (c, d) = pairs = number[1:3, 1, 1], number[2:0:-1, 2, 1]
    assert all(_is_linked(state, stars, *pair) for pair in pairs)
    none = EdgeMoves(np.zeros(N, dtype=bool), np.full(N, -1), np.full(N, -np.inf))
    joined = none._replace(other=np.full(N, -1), gain=np.full(N, -np.inf))
    joined.other[[a, c]], joined.gain[[a, c]] = (b, d), 0.0
    is_dirty, nothing = np.zeros(len(state.complex.cells), dtype=bool), np.empty(0, dtype=np.int64)
    out, quota = np.array([a, c]), (-2, 0, -np.inf)
    made = make_exchanges(state, stars, none, joined, nothing, out, quota, is_dirty)
    assert made == (0, 1)
    left = compact_state(state, is_dirty).state.complex
    cells = left.cells[: int(left.n_cells[0])].copy()
    assert naive.euler(naive.faces_of(boundary_facets(cells))) == 0
    assert manifold_problems(tetopt.Mesh(1.0 * left.ticks, cells)) == []


@pytest.mark.parametrize("is_bounded", [False, True])
def test_collapses_are_the_best_of_all_neighbours(is_bounded):
    """Against meshes in which each node is joined to each neighbour, measured from nothing.

    Bounded: no new edge is longer than the bound at its ends, unless one as long was there.
    """
    engine = swept_case(11, 3)
    (_, stars), groups = room_of(engine), blocks(engine.complex.ticks)
    points, cells = engine.mesh.points, engine.mesh.cells
    is_frozen, ticks, N = engine.complex.is_frozen, engine.complex.ticks, len(points)
    longest = np.random.default_rng(0).uniform(8.0, 20.0, N) if is_bounded else np.full(N, np.inf)
    limits = no_limits(N, longest=longest)
    collapses = best_collapses(engine.state, stars, groups, everyone(N), limits)
    away = np.linalg.norm(points[:, None] - points, axis=2)
    joined, refused = 0, 0
    for a in range(N):
        costs, of_a = [], (cells == a).any(axis=1)
        near = np.setdiff1d(cells[of_a], [a])
        for b in near:
            most = np.maximum(np.minimum(longest[near], longest[b]), away[a, near].max())
            if (away[b, near] > most).any():
                refused += 1
                continue
            new = np.where(cells == a, b, cells)[~(of_a & (cells == b).any(axis=1))]
            volume = volumes(points, new)
            if (volume <= 1e-6 / 6.0).any() or abs(volume.sum() / engine.image.volume - 1) > 1e-9:
                continue
            if (is_frozen[a, :3] & ~(is_frozen[b, :3] & (ticks[a] == ticks[b]))).any():
                continue
            weights = engine.objective.geometry, engine.objective.image
            costs.append(np.dot(weights, energies(engine.fresh(new))) - engine.E)
        if costs:
            joined += 1
            assert -collapses.gain[a] == pytest.approx(min(costs), rel=1e-6, abs=1e-9)
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
    image, mesh = on_lattice(Image(100.0 * (distance((32, 32, 32), 20, 20, 20) < 7)), 5, 5, 5)
    E_D, nodes_near = [], []
    for does_exchange in (False, True):
        engine = Engine(image, mesh, 0.5, is_graded=True)
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
        away = np.linalg.norm(engine.image.to_index(engine.mesh.points) - 20, axis=1)
        nodes_near.append(int((np.abs(away - 7) < 2.5).sum()))
        E_D.append(energies(engine.state)[1])
        assert len(engine.complex.ticks) == N
        assert tetopt.quality(engine.mesh.points, engine.mesh.cells).min_dihedral >= 10.0
    assert nodes_near[1] > 1.3 * nodes_near[0]
    assert E_D[1] < 0.9 * E_D[0]


@pytest.mark.full
@pytest.mark.parametrize(("part", "boundary"), [("half", "fixed"), ("no octant", "slide")])
def test_a_part_of_the_box_stays_what_it_is(part, boundary):
    """Its faces off the box meet the box's in creases: new nodes stay on both."""
    noise = np.random.default_rng(1).normal(size=(24,) * 3)
    image, whole = on_lattice(
        Image(100.0 * (distance(noise.shape, 11, 11, 11) < 50**0.5) + noise), 4, 4, 4
    )
    centre = whole.points[whole.cells].mean(axis=1)
    start = part_of(whole, centre[:, 0] < 11.5 if part == "half" else (centre < 11.5).any(axis=1))
    result = optimize(
        image, start, k_D=0.75, nodes=3 * len(start.points), boundary=boundary, iterations=6
    )
    assert len(result.mesh.points) > 1.5 * len(start.points)
    assert check_mesh(result.mesh) == []
    assert result.mesh.cell_volumes.sum() == pytest.approx(start.cell_volumes.sum(), rel=1e-9)
    assert result.history[-1].n_voxels == result.history[0].n_voxels


@pytest.mark.full
def test_far_more_nodes():
    """From 35 nodes towards 8000: doubled at most at each exchange, none of them wrong."""
    noise = np.random.default_rng(1).normal(size=(20, 20, 20))
    image, mesh = on_lattice(Image(noise), 2, 2, 2)
    mesh = optimize(image, mesh, k_D=0.9, nodes=8000, iterations=6).mesh
    assert 50 < len(mesh.points) < 8000
    assert check_mesh(mesh, image) == []
