"""Sizes: targets that a run comes near to, limits that it keeps but for a few edges; what they
are made of.
"""

import re
import sys

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from shapes import grid
from test_octree import OBLIQUE, ball

import tetopt
from tetopt.engine.aim import Aim
from tetopt.engine.meshing import search_mesh
from tetopt.start import octree
from tetopt.start.octree import _Blocks, _divide_blocks, nearest_octree, nodes_of_sizes, octree_mesh
from tetopt.start.sizes import (
    EQUILATERAL_NODES,
    RATIO_BINS,
    Sizes,
    _around,
    edge_ratios,
    equilateral_nodes,
)


def edges(mesh):
    """Ends and lengths of a mesh's edges."""
    n = mesh.cells.shape[1]
    pairs = np.vstack([mesh.cells[:, [i, j]] for i in range(n) for j in range(i)])
    ends = np.unique(np.sort(pairs, axis=1), axis=0)
    return ends, np.linalg.norm(mesh.points[ends[:, 0]] - mesh.points[ends[:, 1]], axis=1)


@pytest.mark.full
@pytest.mark.parametrize(("shape", "affine"), [((48, 40, 44), OBLIQUE), ((90, 70), None)])
def test_largest(shape, affine):
    """No edge of the octree is longer; of the run's, one in a hundred by 5 %. It holds cells
    back that would grow.
    """
    image, nodes = ball(*shape, affine=affine), 1000 if len(shape) == 3 else 500
    free = octree_mesh(image, nodes, Sizes(longest=np.inf))
    largest = 0.65 * edges(free)[1].max()
    sizes = Sizes(longest=largest)
    mesh = octree_mesh(image, nodes, sizes)
    # blocks are parallelepipeds, whose diagonals are longer
    slant = 1.3 if affine is not None else 1.0
    assert edges(mesh)[1].max() <= largest * slant * (1 + 1e-9)
    assert edges(mesh)[1].max() > 0.6 * largest
    after = edges(tetopt.mesh_image(image, nodes, sizes=sizes, iterations=8).mesh)[1]
    assert np.percentile(after, 99) <= 1.05 * slant * largest
    unbounded = edges(
        tetopt.mesh_image(image, nodes, sizes=Sizes(longest=np.inf), iterations=8).mesh
    )[1]
    assert unbounded.max() > 1.1 * after.max()


def test_default_largest():
    """1.4 times the edges of a uniform mesh; larger where more nodes are not wanted."""
    image = ball(48, 40, 44)
    uniform = edges(tetopt.lattice_mesh(image, nodes=1500))[1].max()
    assert Sizes().longest_edge(image, 1500) == pytest.approx(1.4 * uniform, rel=0.05)
    assert edges(octree_mesh(image, 1500))[1].max() <= 1.4 * 1.05 * uniform


@pytest.mark.full
def test_smallest():
    """No block is below it, and no edge is split below it."""
    image = ball(48, 40, 44)
    sizes = Sizes(smallest=1.6 * edges(octree_mesh(image, 1000))[1].min())
    assert (
        edges(octree_mesh(image, 1000, sizes))[1].min() > 0.85 * sizes.smallest
    )  # from a block's corner to its centre
    fine = edges(tetopt.mesh_image(image, 1000, iterations=6).mesh)[1]
    coarse = edges(tetopt.mesh_image(image, 1000, sizes=sizes, iterations=6).mesh)[1]
    assert np.percentile(coarse, 2) > 1.2 * np.percentile(fine, 2)


def half_sized(image, size, elsewhere=0.0, stretch=1.0):
    """A field on voxels of another size, with `size` in the half of low x."""
    affine = np.diag([*[stretch] * image.ndim, 1.0])
    affine[:-1, -1] = 0.5 * (stretch - 1.0)
    shape = tuple(int(np.ceil(s / stretch)) for s in image.shape)
    low = tetopt.Image(np.zeros(shape), image.affine @ affine).to_world(grid(shape))[..., 0]
    middle = 0.5 * (image.affine[0, 0] * (image.shape[0] - 1)) + image.affine[0, -1]
    return tetopt.Image(np.where(low < middle, size, elsewhere), image.affine @ affine)


@pytest.mark.full
@pytest.mark.parametrize(
    ("shape", "stretch", "k_D"),
    [((48, 40, 44), 2.5, 0.85), ((48, 40, 44), 1.0, 0.0), ((90, 70), 1.0, 0.85)],
)
def test_targets_in_one_half(shape, stretch, k_D):
    """With 1.5 times the nodes of equilateral cells the mean edge is no longer than its target,
    hardly any over sqrt 2.

    So many nodes come out; the other half, which has no target, has longer edges.
    """
    image = ball(*shape)
    field = half_sized(image, 5.0 if len(shape) == 3 else 4.0, stretch=stretch)
    sizes = Sizes(field=field)
    nodes, fraction = nodes_of_sizes(image, sizes)
    assert fraction == pytest.approx(0.5, abs=0.04)
    result = tetopt.mesh_image(image, nodes, sizes=sizes, k_D=k_D)
    mesh = result.mesh
    assert len(mesh.points) == nodes
    assert tetopt.check_mesh(mesh, image) == []
    assert result.history[-1].n_voxels == image.data.size
    assert result.history[-1].E_D == pytest.approx(tetopt.E_D(image, mesh), rel=1e-9)
    ratios = edge_ratios(mesh.points, mesh.cells, sizes)
    assert 0.75 < ratios.mean < 1.03
    assert ratios.above < 0.02
    ends, length = edges(mesh)
    has_none = (sizes.prepared(len(shape)).at(mesh.points)[ends] == np.inf).all(axis=1)
    assert length[has_none].mean() > 1.2 * length[~has_none].mean()
    with pytest.raises(
        tetopt.InputError, match=r"nodes are too few for .* voxels and these limits .* use"
    ):
        tetopt.mesh_image(image, nodes // 3, sizes=sizes)


@pytest.mark.full
def test_targets_ask_for_nothing_that_is_there():
    """Where they are longer than all edges, or infinite, they say no more than that there is no
    bound.
    """
    image = ball(48, 40, 44)
    free = tetopt.mesh_image(image, 400, sizes=Sizes(longest=np.inf), iterations=3).mesh
    for largest in (np.inf, 500.0):
        mesh = tetopt.mesh_image(image, 400, sizes=Sizes(edge_size=largest), iterations=3).mesh
        assert mesh.points.tobytes() == free.points.tobytes()


@pytest.mark.full
@pytest.mark.parametrize("count", [150, 2500])
def test_targets_from_any_mesh(count):
    """A lattice with a fifth of the nodes, or twice as many, ends with the number and its edges."""
    image, sizes = ball(48, 40, 44), Sizes(edge_size=6.0)
    nodes = nodes_of_sizes(image, sizes)[0]
    start = tetopt.lattice_mesh(image, nodes=count)
    mesh = tetopt.optimize(image, start, k_D=0.85, nodes=nodes, sizes=sizes, iterations=16).mesh
    assert len(mesh.points) == nodes
    assert tetopt.check_mesh(mesh, image) == []
    ratios = edge_ratios(mesh.points, mesh.cells, sizes)
    assert ratios.mean < 1.0
    assert ratios.above < 0.03


@pytest.mark.full
def test_nodes_follow_from_sizes():
    """Without a number of nodes; a bound of the longest edge says nothing of it, nor does a
    field of one half.
    """
    image = ball(30, 30, 30)
    sizes = Sizes(edge_size=6.0)
    result = tetopt.mesh_image(image, sizes=sizes, iterations=6)
    assert result.nodes == nodes_of_sizes(image, sizes)[0] == len(result.mesh.points)
    in_all = tetopt.mesh_image(image, sizes=sizes, iterations=4, order=2).nodes
    assert in_all == pytest.approx(7.2 * result.nodes, rel=1e-3)
    usual = 30**3 // 8
    assert tetopt.mesh_image(image, sizes=Sizes(longest=20.0), iterations=0).nodes == usual
    half = Sizes(field=half_sized(image, 6.0))
    needed, fraction = nodes_of_sizes(image, half)
    assert tetopt.mesh_image(image, sizes=half, iterations=0).nodes == round(
        needed + (1.0 - fraction) * usual
    )
    with pytest.raises(tetopt.InputError, match="give only one of nodes and target_error"):
        tetopt.mesh_image(image, 300, target_error=0.1, sizes=sizes)


@pytest.mark.parametrize("n", [2, 3])
def test_equilateral_nodes(n):
    """Those inside, in closed form, and half of a boundary's; in 2-D a strip of triangles that
    can be counted.
    """
    shape = (60, 52, 45)[:n]
    image = tetopt.Image(np.zeros(shape), np.diag([*(1.0, 2.0, 0.5)[:n], 1.0]))
    lengths = image.spacing * shape
    density = (
        2.0 / 3.0**0.5 / 9.0
        if n == 2
        else 6.0 * 2.0**0.5 / (4.0 * np.pi / 0.551285598 / 4.0) / 27.0
    )
    half_a_side = 0.5 / 3.0 if n == 2 else 1.0 / 3.0**0.5 / 9.0
    sides = (
        2.0 * lengths.sum()
        if n == 2
        else 2.0 * sum(np.prod(np.delete(lengths, d)) for d in range(3))
    )
    expected = density * np.prod(lengths) + half_a_side * sides
    target = np.full(shape, 3.0, dtype=np.float32)
    assert equilateral_nodes(target, image) == pytest.approx(expected, rel=1e-6)
    target[:20] = 1e30
    assert equilateral_nodes(target, image) < 0.75 * expected
    if n == 2:
        rows, columns = 1 + 104 / (3.0 * 0.75**0.5), 1 + 60 / 3.0
        assert expected == pytest.approx(rows * columns, rel=0.02)


@pytest.mark.parametrize("shape", [(90, 80), (50, 48, 46)])
def test_equilateral_nodes_of_a_mask(shape):
    """A ball's boundary is not that of its voxels' stairs."""
    n, radius = len(shape), 20.0
    inside = ((grid(shape) - 0.5 * (np.array(shape) - 1.0)) ** 2).sum(-1) < radius**2
    image = tetopt.Image(np.zeros(shape))
    target = np.full(shape, 4.0, dtype=np.float32)
    whole = equilateral_nodes(target, image, inside)
    body = EQUILATERAL_NODES[n] * inside.sum() / 4.0**n
    around = (
        0.5 * 2.0 * np.pi * radius / 4.0
        if n == 2
        else EQUILATERAL_NODES[2] * 2.0 * np.pi * radius**2 / 16.0
    )
    assert whole - body == pytest.approx(around, rel=0.05)
    content = tetopt.content(tetopt.Image(1.0 * inside), mask=tetopt.Image(1.0 * inside))
    assert nodes_of_sizes(content, Sizes(edge_size=4.0))[0] == pytest.approx(1.5 * whole, abs=1.0)


def test_edge_ratios():
    """Each edge once, over the mean of the targets at its ends, and only where both have one."""
    image = ball(20, 20, 20)
    mesh = tetopt.lattice_mesh(image, "five-tet", blocks=(4, 4, 4))
    ratios = edge_ratios(mesh.points, mesh.cells, Sizes(edge_size=5.0))
    n_short, n_long = 3 * 4 * 25, 6 * 4 * 4 * 5 // 2
    assert ratios.mean == pytest.approx((n_short + 2.0**0.5 * n_long) / (n_short + n_long))
    assert sum(ratios.fraction) == pytest.approx(1.0)
    assert ratios.fraction[RATIO_BINS.index(1.0)] == pytest.approx(n_short / (n_short + n_long))
    assert (ratios.above, ratios.below) == (0.0, 0.0)
    tight = edge_ratios(mesh.points, mesh.cells, Sizes(edge_size=4.0))
    assert tight.above == pytest.approx(n_long / (n_short + n_long))
    assert edge_ratios(mesh.points, mesh.cells, Sizes(edge_size=8.0)).below == pytest.approx(
        1.0 - tight.above
    )
    in_half = edge_ratios(mesh.points, mesh.cells, Sizes(field=half_sized(image, 5.0)))
    n_short, n_long = 2 * 25 + 2 * 2 * 4 * 5, 4 * 4 * 2 + 2 * (2 * 4 * 5)
    assert in_half.mean == pytest.approx(
        (n_short + 2.0**0.5 * n_long) / (n_short + n_long), rel=0.05
    )
    assert edge_ratios(mesh.points, mesh.cells, Sizes(longest=5.0)) is None


@pytest.mark.parametrize("rings", [1, 2, 3])
def test_blocks_around_a_divided_one(rings):
    """As many of its size exist in every direction, that is, their parents are divided; and no
    other.
    """
    sizes = [8, 16, 32]
    error = [np.zeros((s, s)) for s in sizes]
    error[1][7, 9] = 1.0
    levels = [
        _Blocks(e, np.zeros(e.shape, dtype=bool), np.ones(e.shape, dtype=bool)) for e in error
    ]
    divided = _divide_blocks(levels, 0.5, rings)
    assert np.argwhere(divided[1]).tolist() == [[7, 9]]
    parents = {
        (i // 2, j // 2) for i in range(7 - rings, 8 + rings) for j in range(9 - rings, 10 + rings)
    }
    assert {(int(i), int(j)) for i, j in np.argwhere(divided[0])} == parents


@pytest.mark.parametrize("shape", [(9, 8), (7, 6, 5)])
def test_field_is_lowered_to_its_gradation(shape):
    """Against shortest ways over the faces of voxels, found for every pair; voxels without a
    size stay so.
    """
    rng = np.random.default_rng(0)
    data = rng.uniform(1.0, 30.0, shape)
    data[data > 28.0] = 0.0
    spacing = np.arange(1.0, len(shape) + 1.0)
    field = tetopt.Image(data, np.diag([*spacing, 1.0]))
    lowered = Sizes(gradation=0.3, field=field).prepared(len(shape)).field.data
    place = grid(shape).reshape(-1, len(shape)) * spacing
    ways = 0.3 * np.abs(place[:, None] - place[None]).sum(-1)
    value = np.where(data > 0.0, data, np.inf).ravel()
    expected = np.where(np.isfinite(value), (value[None] + ways).min(axis=1), 0.0)
    assert (expected == 0.0).any()
    np.testing.assert_allclose(lowered.ravel(), expected, rtol=1e-5)


def test_sizes_around_are_the_twin_s():
    """The least of the other nodes' sizes + gradation x way along edges: against Dijkstra's
    algorithm.
    """
    mesh = octree_mesh(ball(30, 30, 30), 300)
    ends, length = edges(mesh)
    n = len(mesh.points)
    own = np.random.default_rng(1).uniform(1.0, 10.0, n)
    graph = coo_array((0.3 * length, tuple(ends.T)), shape=(n, n)).tocsr()
    ways = dijkstra(graph, directed=False)
    np.fill_diagonal(ways, np.inf)
    # A way may lead away from a node and back to it: twice the shortest edge.
    back = np.full(n, np.inf)
    np.minimum.at(back, ends.ravel(), np.repeat(0.6 * length, 2))
    expected = np.minimum((own[None] + ways).min(axis=1), own + back)
    np.testing.assert_allclose(_around(own, mesh.points, mesh.cells, 0.3), expected, rtol=1e-9)


@pytest.mark.parametrize("sizes", [Sizes(longest=4.0), Sizes(longest=7.0), Sizes(edge_size=5.0)])
def test_a_refusal_names_a_number_that_will_do(sizes):
    image = tetopt.Image(100.0 * (np.indices((30, 30, 30)).sum(0) > 40))
    with pytest.raises(tetopt.InputError, match="; use ") as refusal:
        tetopt.octree_mesh(image, 60, sizes)
    nodes = int(re.search(r"; use (\d+)", str(refusal.value))[1])
    assert len(tetopt.octree_mesh(image, nodes, sizes).points) > 0.5 * nodes


@pytest.mark.parametrize("sizes", [Sizes(longest=4.0), Sizes(longest=7.0, gradation=0.2)])
def test_the_coarsest_octree_is_counted_without_blocks(monkeypatch, sizes):
    """To the last node in a box, anisotropic as well; in a mask about."""
    image = ball(30, 24, 14, affine=np.diag([1.0, 1.0, 2.0, 1.0]))
    content = tetopt.content(image, mask=tetopt.Image(1.0 * (image.data > 50), image.affine))
    limits = octree._block_limits(content, 60, sizes)
    count = len(nearest_octree(image, 60, sizes).points)
    within = len(octree._clipped_octree(content, 60, limits, content.region).points)
    monkeypatch.setattr(octree, "_blocks_by_depth", None)
    assert count > 100
    with pytest.raises(
        tetopt.InputError, match=f"which need at least .*; use {count}, or allow longer edges"
    ):
        octree_mesh(image, 60, sizes)
    enough = octree._coarsest_nodes(content, 60, limits)
    assert 0.5 * within < enough < 1.1 * within


def test_the_longest_edge_of_any_number_of_nodes():
    """In a small mask the lattice of the box has more than lattices may."""
    image = ball(30, 30, 30)
    assert Sizes().longest_edge(image, 10**6, image.volume / 1000.0) > 0.0


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        (Sizes(smallest=-1.0), "smallest: expected 0 mm or more, got -1"),
        (Sizes(edge_size=float("nan")), "edge_size: expected a length above 0 mm"),
        (Sizes(longest=0.0), "longest: expected a length above 0 mm"),
        (Sizes(smallest=5.0, longest=4.0), "longest: 4 mm is below the smallest size, 5 mm"),
        (Sizes(longest=0.3), "cells are smaller than voxels"),
        (Sizes(smallest=5.0, edge_size=4.0), "edge_size: 4 mm is below the smallest size, 5 mm"),
        (Sizes(gradation=2.0), "gradation: expected 0.05"),
        (Sizes(field=tetopt.Image(np.ones((4, 4)))), "field: expected a 3-D field"),
        (Sizes(field=tetopt.Image(np.zeros((4, 4, 4)))), "field: expected lengths above 0 mm"),
        (Sizes(smallest=100.0), "smallest: 100 mm is longer than the box, 30 mm"),
        (Sizes(edge_size=1e-6), "cells are smaller than voxels"),
        (Sizes(field=tetopt.Image(np.full((30, 30, 30), 1e-20))), "cells are smaller than voxels"),
        (
            Sizes(
                field=tetopt.Image(np.ones((9, 9, 9)), np.diag([1, 1, 1, 1]) + 99 * np.eye(4, k=3))
            ),
            "no voxel above 0",
        ),
    ],
)
def test_limits_that_cannot_be(sizes, words):
    image = ball(30, 30, 30)
    with pytest.raises(tetopt.InputError, match=words):
        octree_mesh(image, 500, sizes)
    with pytest.raises(tetopt.InputError, match=words):
        tetopt.mesh_image(image, 500, sizes=sizes)


def test_smallest_before_largest():
    """Where not both can be, the smallest is kept."""
    mesh = octree_mesh(ball(30, 30, 30), 320, Sizes(smallest=5.0, longest=5.0))
    assert edges(mesh)[1].min() >= 5.0 * (1 - 1e-9)


def test_longest_at_nodes():
    """The least of the longest, sqrt 2 of the target, and what grows from the sizes around."""
    image = ball(30, 30, 30)
    mesh = octree_mesh(image, 300)
    own = np.full(len(mesh.points), 100.0)
    field = half_sized(image, 7.0, stretch=3.0)
    sizes = Sizes(longest=20.0, field=field).prepared(3)
    has_one = sizes.at(mesh.points) == 7.0
    np.testing.assert_array_equal(
        has_one,
        field.data[tuple(np.rint(field.to_index(mesh.points)).astype(int).clip(0, 9).T)] > 0.0,
    )
    target = sizes.around(mesh.points, mesh.cells)
    np.testing.assert_allclose(target[has_one], 7.0)
    grown = np.minimum(
        sizes.at(mesh.points), _around(sizes.at(mesh.points), mesh.points, mesh.cells, 1.0)
    )
    np.testing.assert_array_equal(target, grown)
    assert target.max() > 15.0
    longest = sizes.longest_edges(image, 300, mesh.points, mesh.cells, own, target)
    np.testing.assert_allclose(longest, np.minimum(20.0, 2.0**0.5 * target))
    own = np.linspace(1.0, 3.0, len(mesh.points))
    sizes, free = Sizes(longest=np.inf, gradation=0.2), np.full(len(mesh.points), np.inf)
    assert (sizes.around(mesh.points, mesh.cells) == np.inf).all()
    longest = sizes.longest_edges(image, 300, mesh.points, mesh.cells, own, free)
    np.testing.assert_allclose(longest, 1.5 * _around(own, mesh.points, mesh.cells, 0.2))


# As many nodes as an error takes.


@pytest.mark.full
def test_a_stop_keeps_what_has_the_error():
    """A run cut short does not replace a mesh that has the error already; without one it is what
    there is.
    """
    image = ball(40, 40, 40)
    for stops_at, has_error in ((1, False), (3, True)):
        initials = []

        def attempt(run, initial, _, runs, initials=initials, stops_at=stops_at):
            initials.append(initial)
            return run(stop=lambda: len(runs) + 1 >= stops_at)

        result = search_mesh(image, Aim(target_error=0.0005), attempt, iterations=8)
        assert len(initials) == stops_at
        fraction = result.history[-1].E_D / (
            float(np.var(image.data, dtype=np.float64)) * image.volume
        )
        assert (fraction <= 0.0005) == has_error
        assert result.ended == "stopped"
        assert (result.initial is initials[-1]) != has_error


@pytest.mark.full
@pytest.mark.parametrize(("shape", "noise"), [((30, 28, 26), 3.0), ((80, 70), 0.0)])
def test_target_error(shape, noise):
    """Reached, without far more nodes than it takes."""
    image = ball(*shape, noise=noise)
    target = 0.1 if len(shape) == 3 else 0.03
    mesh = tetopt.mesh_image(image, target_error=target).mesh
    total = float(np.var(image.data, dtype=np.float64)) * image.volume
    assert tetopt.E_D(image, mesh) <= target * total
    fewer = tetopt.mesh_image(image, len(mesh.points) // 2).mesh
    assert tetopt.E_D(image, fewer) > 1.05 * target * total
    assert tetopt.check_mesh(mesh, image) == []


@pytest.mark.deep
def test_target_error_within_limits():
    """Limits on sizes that ask for more nodes than the error does, or for fewer, have the last
    word.
    """
    image = ball(40, 40, 40)
    total = float(np.var(image.data, dtype=np.float64)) * image.volume
    fine = tetopt.mesh_image(image, target_error=0.5, sizes=Sizes(longest=9.0))
    assert edges(fine.mesh)[1].max() < 11.0
    assert fine.history[-1].E_D < 0.1 * total
    sized = tetopt.mesh_image(image, target_error=0.5, sizes=Sizes(edge_size=6.0))
    assert sized.nodes == nodes_of_sizes(image, Sizes(edge_size=6.0))[0] == len(sized.mesh.points)
    coarse = tetopt.mesh_image(image, target_error=0.001, sizes=Sizes(smallest=9.0, longest=40.0))
    assert edges(coarse.mesh)[1].mean() > 9.0
    assert coarse.history[-1].E_D > 0.001 * total


@pytest.mark.parametrize(
    ("image", "arguments", "words"),
    [
        (ball(30, 30, 30), {"nodes": 100, "target_error": 0.1}, "only one of"),
        (
            ball(30, 30, 30),
            {"target_error": 1.0},
            "expected a fraction of the image's variance, 0 to 1",
        ),
        (ball(30, 30, 30), {"target_error": float("nan")}, "expected a fraction"),
        (tetopt.Image(np.ones((30, 30, 30))), {"target_error": 0.1}, "the image is constant"),
        (ball(30, 30, 30, noise=20.0), {"target_error": 0.1}, "below the noise fraction"),
    ],
)
def test_targets_that_cannot_be(image, arguments, words):
    with pytest.raises(tetopt.InputError, match=words):
        tetopt.mesh_image(image, **arguments)


@pytest.mark.full
def test_exchanges_do_not_follow_noise(monkeypatch):
    """In noise alone hardly a node is exchanged, if its level is known."""
    image = tetopt.Image(np.random.default_rng(1).normal(0.0, 10.0, (32, 32, 32)))
    fast = sys.modules["tetopt.engine.fast"]
    start = octree_mesh(image, 800)
    count = {}
    for known in (True, False):
        made = []
        plain = fast.exchange

        def counted(*arguments, made=made, plain=plain):
            done = plain(*arguments)
            made.append(min(done.n_split, done.n_collapsed))
            return done

        with monkeypatch.context() as patched:
            patched.setattr(fast, "exchange", counted)
            if not known:
                patched.setattr(
                    sys.modules["tetopt.contents.content"], "noise_level", lambda data, inside: 0.0
                )
            tetopt.optimize(image, start, k_D=0.85, nodes=len(start.points), iterations=3)
        count[known] = sum(made)
    assert count[False] > 30
    assert count[True] < 0.1 * count[False]
