"""Splits and collapses: each leaves a mesh, measured as if afresh, and changes E by what was said."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from test_fast import OBLIQUE, Held, dimensions, random_case, seeds

import tetopt
from tetopt.engine.complex import build, energies, floor_of, measure_all, node_rings
from tetopt.engine.density import (
    Limits,
    best_collapses,
    best_splits,
    collapse_edge,
    exchange,
    make_exchanges,
    mend,
    roomy,
)
from tetopt.engine.flips import close_gaps
from tetopt.engine.repair import qualities
from tetopt.engine.smooth import blocks
from tetopt.geometry.simplex import volumes


def sides_of(held, is_fixed=False):
    return held.sides._replace(is_fixed=is_fixed)


def no_limits(n_nodes):
    return Limits(0.0, np.full(n_nodes, np.inf), 0.0)


def exchanged(held, n_nodes, most, is_fixed=False):
    limits = no_limits(len(held.complex.ticks))
    done = exchange(held.complex, held.is_frozen, held.measure, sides_of(held, is_fixed), n_nodes, most, limits)
    held.complex, held.is_frozen = done.held, done.is_frozen
    return done


@settings(max_examples=40, deadline=None)
@given(seeds, dimensions, st.booleans(), st.booleans(), st.integers(-6, 12))
def test_exchanges_leave_a_mesh(seed, n, turned, is_graded, more):
    held = random_case(seed, n, OBLIQUE if turned and n == 3 else None, 3.0)
    held.measure = held.measure._replace(is_graded=is_graded)
    measure_all(held.complex, held.measure)
    assume(np.isfinite(held.E))
    for _ in range(3):
        before, E = len(held.complex.ticks), held.E
        done = exchanged(held, before + more, 5)
        held.assert_sound()
        assert len(held.complex.ticks) - before == done.n_split - done.n_collapsed
        assert min(done.n_split, done.n_collapsed) <= 5
        kept = done.source[done.source >= 0]
        assert len(kept) == before - done.n_collapsed
        assert (np.diff(kept) > 0).all()
        if more == 0:
            assert held.E <= E * (1 + 1e-12)
        held.sweep()
        held.flip()
        held.assert_sound()


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("is_fixed", [False, True])
def test_worth_is_what_E_falls_by(n, is_fixed):
    """Every node's best split, and every node's best collapse, made alone."""
    count = 0
    for node in range(40):
        for kind in ("split", "collapse"):
            held = random_case(7, n)
            held.sweep()
            N = len(held.complex.ticks)
            if is_fixed:
                held.is_frozen[held.is_frozen.any(axis=1), :3] = True
            if node >= N:
                continue
            rings, groups, sides = node_rings(held.complex), blocks(held.complex.ticks), sides_of(held, is_fixed)
            room = roomy(held.complex, N, 200)
            is_frozen = np.concatenate([held.is_frozen, np.zeros_like(held.is_frozen)])
            E = held.E
            is_dirty = np.zeros(len(room.cells), dtype=np.bool_)
            nobody = np.empty(0, dtype=np.int64)
            if kind == "split":
                gain, split = best_splits(room, rings, is_frozen, held.measure, sides, np.ones(N, dtype=bool), 0.0)
                if split[node] < 0:
                    continue
                done = make_exchanges(
                    room,
                    rings,
                    is_frozen,
                    held.measure,
                    sides,
                    np.array([node]),
                    split,
                    gain,
                    nobody,
                    nobody,
                    gain,
                    1,
                    1,
                    0.0,
                    is_dirty,
                )
                assert done == (1, 0)
                expected = gain[node]
                was_on = held.is_frozen[[node, split[node]]]
                assert (is_frozen[N] <= was_on.all(axis=0)).all()
                if is_fixed and is_frozen[N].any():
                    assert is_frozen[N, :3].all()
                held.complex = room._replace(ticks=room.ticks[: N + 1])
            else:
                cost, collapse = best_collapses(
                    room,
                    rings,
                    groups,
                    is_frozen,
                    held.measure,
                    sides,
                    np.inf,
                    np.ones(N, dtype=bool),
                    np.full(N, np.inf),
                )
                if collapse[node] < 0:
                    continue
                collapse_edge(room, rings, node, collapse[node], is_dirty, held.measure)
                close_gaps(room, is_dirty)
                expected = -cost[node]
                held.complex = room
                assert not (held.complex.cells[: held.complex.n_cells[0]] == node).any()
                held.complex.ticks[node] = held.complex.ticks[N - 1]  # out of the mesh: numbered away
                cells = held.complex.cells
                cells[cells == N - 1] = node
                held.complex = held.complex._replace(ticks=held.complex.ticks[: N - 1])
            count += 1
            assert E - held.E == pytest.approx(expected, rel=1e-6, abs=1e-9)
            held.assert_sound()
    assert count > 20


def test_splits_make_no_edge_shorter_than_asked():
    """Of every node's best split, the halves and the edges to the other corners; some splits are refused for it."""
    held = random_case(5, 3)
    held.sweep()
    N, everyone = len(held.complex.ticks), np.ones(len(held.complex.ticks), dtype=bool)
    rings, sides = node_rings(held.complex), sides_of(held)
    room = roomy(held.complex, N, 200)
    is_frozen = np.concatenate([held.is_frozen, np.zeros_like(held.is_frozen)])
    points, cells = held.mesh.points, held.mesh.cells
    shortest = 0.45 * float(np.median(np.linalg.norm(points[cells[:, 0]] - points[cells[:, 1]], axis=1)))
    made = []
    for limit in (0.0, shortest):
        _, split = best_splits(room, rings, is_frozen, held.measure, sides, everyone, limit)
        lengths = []
        for a in np.flatnonzero(split >= 0):
            ring = cells[(cells == a).any(axis=1) & (cells == split[a]).any(axis=1)]
            middle = (points[a] + points[split[a]]) / 2.0
            lengths.append(np.linalg.norm(points[np.unique(ring)] - middle, axis=1).min())
        made.append(np.array(lengths))
    assert made[0].min() < 0.95 * shortest
    assert len(made[1]) > 0
    assert made[1].min() >= shortest * (1 - 1e-3)  # ticks round the middle


@pytest.mark.parametrize("is_bounded", [False, True])
def test_collapses_are_the_best_of_all_neighbours(is_bounded):
    """Against meshes in which each node is joined to each neighbour, measured from nothing.

    Bounded: no new edge is longer than the bound at its ends, unless one as long was there.
    """
    held = random_case(11, 3)
    held.sweep()
    N, cells = len(held.complex.ticks), held.mesh.cells
    rings, groups = node_rings(held.complex), blocks(held.complex.ticks)
    points = held.mesh.points
    longest = np.random.default_rng(0).uniform(8.0, 20.0, N) if is_bounded else np.full(N, np.inf)
    cost, collapse = best_collapses(
        held.complex, rings, groups, held.is_frozen, held.measure, held.sides, np.inf, np.ones(N, dtype=bool), longest
    )
    size = np.linalg.det(held.mesh.points[cells[:, 1:]] - held.mesh.points[cells[:, :1]]).sum()
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
            new = np.where(cells == a, b, cells)[~((cells == a).any(axis=1) & (cells == b).any(axis=1))]
            volume = np.linalg.det(held.mesh.points[new[:, 1:]] - held.mesh.points[new[:, :1]])
            if (volume <= 1e-6).any() or abs(volume.sum() / size - 1) > 1e-9:
                continue
            if (
                held.is_frozen[a, :3] & ~(held.is_frozen[b, :3] & (held.complex.ticks[a] == held.complex.ticks[b]))
            ).any():
                continue
            fresh = build(new, held.complex.ticks, held.measure)
            E_G, squares = energies(fresh)
            best = min(best, held.measure.geometry * E_G + held.measure.image * squares - held.E)
        if best < np.inf:
            joined += 1
            assert cost[a] == pytest.approx(best, rel=1e-6, abs=1e-9)
        else:
            assert collapse[a] == -1
    assert joined > 5
    assert (refused > 20) == is_bounded


@settings(max_examples=25, deadline=None)
@given(seeds, st.booleans())
def test_mending_by_nodes(seed, turned):
    """Nodes taken out and put in at the worst cells: fewer cells below the floor, none worse, and a mesh still."""
    held = random_case(seed, 3, OBLIQUE if turned else None)
    assume(np.isfinite(held.E))
    target = -np.cos(np.radians(20.0))
    for _ in range(3):
        quality = qualities(held.complex, held.measure)
        bad = np.flatnonzero(quality < target)
        bad = bad[np.argsort(quality[bad], kind="stable")]
        if len(bad) == 0:
            break
        done = mend(held.complex, held.is_frozen, held.measure, held.sides, bad, target)
        held.complex, held.is_frozen = done.held, done.is_frozen
        held.assert_sound()
        assert qualities(held.complex, held.measure).min() >= min(quality.min(), target)
        if done.n_split + done.n_collapsed == 0:
            break


def test_nodes_go_where_the_image_is():
    """A ball in a large box, exchanged at the same number of nodes: more of them near its surface, and less E_D."""
    index = np.stack(np.meshgrid(*[np.arange(32)] * 3, indexing="ij"), -1)
    image = tetopt.Image(100.0 * (((index - 20) ** 2).sum(-1) < 49))
    E_D, nodes_near = {}, {}
    for does_exchange in (False, True):
        held = Held(image, tetopt.lattice(image, blocks=(5, 5, 5)), 0.5)
        floor, safe = floor_of(10.0)
        held.measure = held.measure._replace(is_graded=True, floor=floor, safe=safe)
        held.complex = build(held.mesh.cells, held.complex.ticks, held.measure)
        E_G, squares = energies(held.complex)
        held.measure = held.measure._replace(geometry=0.5 / E_G, image=0.5 / squares)
        N = len(held.complex.ticks)
        for _ in range(8):
            held.sweep()
            held.flip()
            if does_exchange:  # most of a shape's cost goes when the nodes around move again
                eager = held.measure._replace(geometry=0.1 * held.measure.geometry)
                done = exchange(held.complex, held.is_frozen, eager, held.sides, N, N // 10, no_limits(N))
                held.complex, held.is_frozen = done.held, done.is_frozen
        for _ in range(3):
            held.sweep()
            held.flip()
        held.assert_sound()
        distance = np.sqrt(((held.image.to_index(held.mesh.points) - 20) ** 2).sum(axis=1))
        nodes_near[does_exchange] = int((np.abs(distance - 7) < 2.5).sum())
        E_D[does_exchange] = energies(held.complex)[1]
        assert len(held.complex.ticks) == N
        assert tetopt.quality(held.mesh.points, held.mesh.cells).min_dihedral >= 10.0
    assert nodes_near[True] > 1.3 * nodes_near[False]
    assert E_D[True] < 0.9 * E_D[False]


@pytest.mark.parametrize("part", ["half", "slab", "no octant"])
@pytest.mark.parametrize("boundary", ["slide", "fixed"])
def test_a_part_of_the_box_stays_what_it_is(part, boundary):
    """Its faces off the box meet the box's in creases: new nodes stay on both."""
    index = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), -1)
    noise = np.random.default_rng(1).normal(size=(24,) * 3)
    image = tetopt.Image(100.0 * (((index - 11) ** 2).sum(-1) < 50) + noise)
    whole = tetopt.lattice(image, blocks=(4, 4, 4))
    centre = whole.points[whole.cells].mean(axis=1)
    kept = {
        "half": centre[:, 0] < 11.5,
        "slab": (centre[:, 0] > 5.5) & (centre[:, 0] < 17.5),
        "no octant": ~(centre > 11.5).all(axis=1),
    }[part]
    used, cells = np.unique(whole.cells[kept], return_inverse=True)
    start = tetopt.Mesh(whole.points[used], cells.reshape(-1, 4))
    result = tetopt.optimize(image, start, k_D=0.75, nodes=3 * len(used), boundary=boundary, iterations=8)
    assert len(result.mesh.points) > 1.5 * len(used)
    assert tetopt.check_mesh(result.mesh) == []
    assert volumes(result.mesh.points, result.mesh.cells).sum() == pytest.approx(
        volumes(start.points, start.cells).sum(), rel=1e-9
    )
    assert result.history[-1].n_voxels == result.history[0].n_voxels


@pytest.mark.parametrize("nodes", [0, -5, 189.5, "x"])
def test_numbers_of_nodes_that_are_none(nodes):
    image = tetopt.Image(np.random.default_rng(1).normal(size=(10, 10, 10)))
    with pytest.raises(tetopt.InputError, match="nodes: expected a whole number"):
        tetopt.optimize(image, tetopt.lattice(image, blocks=(2, 2, 2)), nodes=nodes)


def test_far_more_nodes():
    """From 35 nodes towards 8000: doubled at most at each exchange, none of them wrong."""
    image = tetopt.Image(np.random.default_rng(1).normal(size=(20, 20, 20)))
    result = tetopt.optimize(image, tetopt.lattice(image, blocks=(2, 2, 2)), k_D=0.9, nodes=8000, iterations=6)
    assert 50 < len(result.mesh.points) < 8000
    assert tetopt.check_mesh(result.mesh, image) == []
