"""Sizes: targets that a run comes near to, limits that it keeps but for a few edges; what they
are made of.
"""

import re
import sys
from functools import partial

import numpy as np
import pytest
from meshes import mesh_edges
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from shapes import ball_image, grid
from test_octree import OBLIQUE, ball, filled

import tetopt
from tetopt import E_D, Image, InputError, check_mesh, lattice_mesh, mesh_image, optimize
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


@pytest.fixture(scope="module")
def image():
    """The ball that most tests mesh."""
    return ball(48, 40, 44)


def run_edges(image, nodes, iterations=8, **options):
    """Lengths of the edges of a run."""
    return mesh_edges(mesh_image(image, nodes, iterations=iterations, **options).mesh)[1]


@pytest.mark.full
@pytest.mark.parametrize(("shape", "affine"), [((48, 40, 44), OBLIQUE), ((90, 70), None)])
def test_largest(shape, affine):
    """No edge of the octree is longer; of the run's, one in a hundred by 5 %. It holds cells
    back that would grow.
    """
    image, nodes = ball(*shape, affine=affine), 1000 if len(shape) == 3 else 500
    free = Sizes(longest=np.inf)
    largest = 0.65 * octree_edges(image, nodes, free).max()
    sizes = Sizes(longest=largest)
    # blocks are parallelepipeds, whose diagonals are longer
    slant = 1.3 if affine is not None else 1.0
    longest = octree_edges(image, nodes, sizes).max()
    assert 0.6 * largest < longest <= largest * slant * (1 + 1e-9)
    after, unbounded = (run_edges(image, nodes, sizes=each) for each in (sizes, free))
    assert np.percentile(after, 99) <= 1.05 * slant * largest
    assert unbounded.max() > 1.1 * after.max()


def octree_edges(*arguments):
    return mesh_edges(octree_mesh(*arguments))[1]


def test_default_largest(image):
    """1.4 times the edges of a uniform mesh; larger where more nodes are not wanted."""
    uniform = mesh_edges(lattice_mesh(image, nodes=1500))[1].max()
    assert Sizes().longest_edge(image, 1500) == pytest.approx(1.4 * uniform, rel=0.05)
    assert octree_edges(image, 1500).max() <= 1.4 * 1.05 * uniform


@pytest.mark.full
def test_smallest(image):
    """No block is below it, and no edge is split below it."""
    smallest = 1.6 * octree_edges(image, 1000).min()
    sizes = Sizes(smallest=smallest)
    # from a block's corner to its centre
    assert octree_edges(image, 1000, sizes).min() > 0.85 * smallest
    fine, coarse = (
        np.percentile(run_edges(image, 1000, 6, sizes=each), 2) for each in (None, sizes)
    )
    assert coarse > 1.2 * fine


def half_sized(image, size, stretch=1.0):
    """A field on voxels of another size, with `size` in the half of low x and none in the other."""
    affine = np.diag([*[stretch] * image.ndim, 1.0])
    affine[:-1, -1] = 0.5 * (stretch - 1.0)
    field = Image(np.zeros(np.ceil(np.divide(image.shape, stretch)).astype(int)), affine)
    place = image.to_world(field.to_world(grid(field.shape)))
    middle = image.to_world((np.array(image.shape) - 1.0) / 2.0)
    is_low = place[..., 0] < middle[0]
    return Image(np.where(is_low, size, 0.0), image.affine @ affine)


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
    sizes = Sizes(field=half_sized(image, 5.0 if len(shape) == 3 else 4.0, stretch))
    nodes, fraction = nodes_of_sizes(image, sizes)
    assert fraction == pytest.approx(0.5, abs=0.04)
    result = mesh_image(image, nodes, sizes=sizes, k_D=k_D)
    mesh, last = result.mesh, result.history[-1]
    assert_sized(image, mesh, sizes, nodes, 1.03, 0.02)
    assert last.n_voxels == image.data.size
    assert last.E_D == pytest.approx(E_D(image, mesh), rel=1e-9)
    ends, length = mesh_edges(mesh)
    has_none = (sizes.prepared(len(shape)).at(mesh.points)[ends] == np.inf).all(axis=1)
    assert length[has_none].mean() > 1.2 * length[~has_none].mean()
    with pytest.raises(InputError, match=r"too few for .* use"):
        mesh_image(image, nodes // 3, sizes=sizes)


def assert_sized(image, mesh, sizes, nodes, most, above):
    """A mesh of the box with so many nodes, and edges about as long as their targets."""
    assert check_mesh(mesh, image) == []
    assert len(mesh.points) == nodes
    ratios = edge_ratios(mesh.points, mesh.cells, sizes)
    assert 0.75 < ratios.mean < most
    assert ratios.above < above


@pytest.mark.full
@pytest.mark.parametrize("largest", [np.inf, 500.0])
def test_targets_ask_for_nothing_that_is_there(image, largest):
    """Where they are longer than all edges, or infinite, they say no more than that there is no
    bound.
    """
    free, mesh = (
        mesh_image(image, 400, sizes=sizes, iterations=3).mesh
        for sizes in (Sizes(longest=np.inf), Sizes(edge_size=largest))
    )
    assert mesh.points.tobytes() == free.points.tobytes()


@pytest.mark.full
@pytest.mark.parametrize("count", [150, 2500])
def test_targets_from_any_mesh(image, count):
    """A lattice with a fifth of the nodes, or twice as many, ends with the number and its edges."""
    sizes = Sizes(edge_size=6.0)
    nodes = nodes_of_sizes(image, sizes)[0]
    start = lattice_mesh(image, nodes=count)
    mesh = optimize(image, start, k_D=0.85, nodes=nodes, sizes=sizes, iterations=16).mesh
    assert_sized(image, mesh, sizes, nodes, 1.0, 0.03)


@pytest.mark.full
def test_nodes_follow_from_sizes():
    """Without a number of nodes; a bound of the longest edge says nothing of it, nor does a
    field of one half.
    """
    image, sizes, usual = ball(30, 30, 30), Sizes(edge_size=6.0), 30**3 // 8
    half = Sizes(field=half_sized(image, 6.0))
    nodes = partial(mesh_image, image, iterations=4)
    result = nodes(sizes=sizes)
    assert result.nodes == nodes_of_sizes(image, sizes)[0] == len(result.mesh.points)
    assert nodes(sizes=sizes, order=2).nodes == pytest.approx(7.2 * result.nodes, rel=1e-3)
    needed, fraction = nodes_of_sizes(image, half)
    of_half = round(needed + (1.0 - fraction) * usual)
    found = [nodes(sizes=each, iterations=0).nodes for each in (Sizes(longest=20.0), half)]
    assert found == [usual, of_half]


@pytest.mark.parametrize("n", [2, 3])
def test_equilateral_nodes(n):
    """Those inside, in closed form, and half of a boundary's; in 2-D a strip of triangles that
    can be counted.
    """
    shape = (60, 52, 45)[:n]
    image = Image(np.zeros(shape), np.diag([*(1.0, 2.0, 0.5)[:n], 1.0]))
    lengths = image.spacing * shape
    if n == 2:
        density, half_a_side, sides = 2.0 / 3.0**0.5 / 9.0, 0.5 / 3.0, 2.0 * lengths.sum()
    else:
        density = 6.0 * 2.0**0.5 / (4.0 * np.pi / 0.551285598 / 4.0) / 27.0
        half_a_side, sides = 1.0 / 3.0**0.5 / 9.0, 2.0 * (image.volume / lengths).sum()
    expected = density * image.volume + half_a_side * sides
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
    mask = ball_image(shape, 0.5 * (np.array(shape) - 1.0), radius)
    target, inside = np.full(shape, 4.0, dtype=np.float32), mask.data > 0.0
    whole = equilateral_nodes(target, Image(np.zeros(shape)), inside)
    body = EQUILATERAL_NODES[n] * inside.sum() / 4.0**n
    circle = 2.0 * np.pi * radius / 4.0
    around = 0.5 * circle if n == 2 else EQUILATERAL_NODES[2] * circle * radius / 4.0
    assert whole - body == pytest.approx(around, rel=0.05)
    content = tetopt.content(mask, mask=mask)
    assert nodes_of_sizes(content, Sizes(edge_size=4.0))[0] == pytest.approx(1.5 * whole, abs=1.0)


def test_edge_ratios():
    """Each edge once, over the mean of the targets at its ends, and only where both have one."""
    image = ball(20, 20, 20)
    mesh = lattice_mesh(image, "five-tet", blocks=(4, 4, 4))

    def ratios(**sizes):
        return edge_ratios(mesh.points, mesh.cells, Sizes(**sizes))

    n_short, n_long = 3 * 4 * 25, 6 * 4 * 4 * 5 // 2
    share, own, tight = n_short / (n_short + n_long), ratios(edge_size=5.0), ratios(edge_size=4.0)
    assert own.mean == pytest.approx(share + 2.0**0.5 * (1.0 - share))
    assert sum(own.fraction) == pytest.approx(1.0)
    assert own.fraction[RATIO_BINS.index(1.0)] == pytest.approx(share)
    assert (own.above, own.below) == (0.0, 0.0)
    assert tight.above == pytest.approx(1.0 - share)
    assert ratios(edge_size=8.0).below == pytest.approx(share)
    n_short, n_long = 2 * 25 + 2 * 2 * 4 * 5, 4 * 4 * 2 + 2 * (2 * 4 * 5)
    share = n_short / (n_short + n_long)
    in_half = ratios(field=half_sized(image, 5.0))
    assert in_half.mean == pytest.approx(share + 2.0**0.5 * (1.0 - share), rel=0.05)
    assert ratios(longest=5.0) is None


@pytest.mark.parametrize("rings", [1, 2, 3])
def test_blocks_around_a_divided_one(rings):
    """As many of its size exist in every direction, that is, their parents are divided; and no
    other.
    """
    error = [np.zeros((s, s)) for s in (8, 16, 32)]
    error[1][7, 9] = 1.0
    levels = [_Blocks(e, np.zeros(e.shape, bool), np.ones(e.shape, bool)) for e in error]
    divided = _divide_blocks(levels, 0.5, rings)
    assert np.argwhere(divided[1]).tolist() == [[7, 9]]
    around = np.indices((2 * rings + 1,) * 2).reshape(2, -1).T + np.array([7 - rings, 9 - rings])
    assert np.argwhere(divided[0]).tolist() == np.unique(around // 2, axis=0).tolist()


@pytest.mark.parametrize("shape", [(9, 8), (7, 6, 5)])
def test_field_is_lowered_to_its_gradation(shape):
    """Against shortest ways over the faces of voxels, found for every pair; voxels without a
    size stay so.
    """
    n = len(shape)
    data = np.random.default_rng(0).uniform(1.0, 30.0, shape)
    data[data > 28.0] = 0.0
    spacing = np.arange(1.0, n + 1.0)
    field = Image(data, np.diag([*spacing, 1.0]))
    lowered = Sizes(gradation=0.3, field=field).prepared(n).field.data
    place = grid(shape).reshape(-1, n) * spacing
    ways = 0.3 * np.abs(place[:, None] - place[None]).sum(-1)
    value = np.where(data > 0.0, data, np.inf).ravel()
    expected = np.where(np.isfinite(value), (value[None] + ways).min(axis=1), 0.0)
    assert (expected == 0.0).any()
    assert_allclose(lowered.ravel(), expected, rtol=1e-5)


def test_sizes_around_are_the_twin_s():
    """The least of the other nodes' sizes + gradation x way along edges: against Dijkstra's
    algorithm.
    """
    mesh = octree_mesh(ball(30, 30, 30), 300)
    (ends, length), n = mesh_edges(mesh), len(mesh.points)
    own = np.random.default_rng(1).uniform(1.0, 10.0, n)
    ways = dijkstra(coo_array((0.3 * length, tuple(ends.T)), shape=(n, n)), directed=False)
    np.fill_diagonal(ways, np.inf)
    # A way may lead away from a node and back to it: twice the shortest edge.
    back = np.full(n, np.inf)
    np.minimum.at(back, ends.ravel(), np.repeat(0.6 * length, 2))
    expected = np.minimum((own[None] + ways).min(axis=1), own + back)
    assert_allclose(_around(own, mesh.points, mesh.cells, 0.3), expected, rtol=1e-9)


@pytest.mark.parametrize("sizes", [Sizes(longest=4.0), Sizes(longest=7.0), Sizes(edge_size=5.0)])
def test_a_refusal_names_a_number_that_will_do(sizes):
    image = Image(100.0 * (np.indices((30, 30, 30)).sum(0) > 40))
    with pytest.raises(InputError, match="; use ") as refusal:
        octree_mesh(image, 60, sizes)
    nodes = int(re.search(r"; use (\d+)", str(refusal.value))[1])
    assert len(octree_mesh(image, nodes, sizes).points) > 0.5 * nodes


@pytest.mark.parametrize("sizes", [Sizes(longest=4.0), Sizes(longest=7.0, gradation=0.2)])
def test_the_coarsest_octree_is_counted_without_blocks(monkeypatch, sizes):
    """To the last node in a box, anisotropic as well; in a mask about."""
    image = ball(30, 24, 14, affine=np.diag([1.0, 1.0, 2.0, 1.0]))
    content = tetopt.content(image, mask=Image(1.0 * (image.data > 50), image.affine))
    limits = octree._block_limits(content, 60, sizes)
    count = len(nearest_octree(image, 60, sizes).points)
    within = len(octree._clipped_octree(content, 60, limits, content.region).points)
    monkeypatch.setattr(octree, "_blocks_by_depth", None)
    assert count > 100
    with pytest.raises(InputError, match=f"; use {count}, "):
        octree_mesh(image, 60, sizes)
    assert 0.5 * within < octree._coarsest_nodes(content, 60, limits) < 1.1 * within


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
        (Sizes(field=filled((4, 4), 1.0)), "field: expected a 3-D field"),
        (Sizes(field=filled((4, 4, 4), 0.0)), "field: expected lengths above 0 mm"),
        (Sizes(smallest=100.0), "smallest: 100 mm is longer than the box, 30 mm"),
        (Sizes(edge_size=1e-6), "cells are smaller than voxels"),
        (Sizes(field=filled((30, 30, 30), 1e-20)), "cells are smaller than voxels"),
        (Sizes(field=filled((9, 9, 9), 1.0, np.eye(4) + 99 * np.eye(4, k=3))), "no voxel above 0"),
    ],
)
def test_limits_that_cannot_be(sizes, words):
    image = ball(30, 30, 30)
    with pytest.raises(InputError, match=words):
        octree_mesh(image, 500, sizes)
    with pytest.raises(InputError, match=words):
        mesh_image(image, 500, sizes=sizes)


def test_smallest_before_largest():
    """Where not both can be, the smallest is kept."""
    sizes = Sizes(smallest=5.0, longest=5.0)
    assert octree_edges(ball(30, 30, 30), 320, sizes).min() >= 5.0 * (1 - 1e-9)


def test_longest_at_nodes():
    """The least of the longest, sqrt 2 of the target, and what grows from the sizes around."""
    image = ball(30, 30, 30)
    mesh = octree_mesh(image, 300)
    places, own = (mesh.points, mesh.cells), np.linspace(1, 3, len(mesh.points))
    field = half_sized(image, 7.0, stretch=3.0)
    sizes = Sizes(longest=20.0, field=field).prepared(3)
    at, target = sizes.at(mesh.points), sizes.around(*places)
    voxel = np.rint(field.to_index(mesh.points)).astype(int).clip(0, 9)
    assert_array_equal(at == 7.0, field.data[tuple(voxel.T)] > 0.0)
    assert_allclose(target[at == 7.0], 7.0)
    assert_array_equal(target, np.minimum(at, _around(at, *places, 1.0)))
    assert target.max() > 15.0
    longest = sizes.longest_edges(image, 300, *places, 100.0 + 0.0 * own, target)
    assert_allclose(longest, np.minimum(20.0, 2.0**0.5 * target))
    sizes, free = Sizes(longest=np.inf, gradation=0.2), np.full(len(own), np.inf)
    assert_array_equal(sizes.around(*places), free)
    longest = sizes.longest_edges(image, 300, *places, own, free)
    assert_allclose(longest, 1.5 * _around(own, *places, 0.2))


# As many nodes as an error takes.


@pytest.mark.full
@pytest.mark.parametrize(("stops_at", "has_error"), [(1, False), (3, True)])
def test_a_stop_keeps_what_has_the_error(stops_at, has_error):
    """A run cut short does not replace a mesh that has the error already; without one it is what
    there is.
    """
    image, initials = ball(40, 40, 40), []

    def attempt(run, initial, _, runs):
        initials.append(initial)
        return run(stop=lambda: len(runs) + 1 >= stops_at)

    result = search_mesh(image, Aim(target_error=0.0005), attempt, iterations=8)
    assert len(initials) == stops_at
    assert (result.history[-1].E_D <= 0.0005 * total(image)) == has_error
    assert result.ended == "stopped"
    assert (result.initial is initials[-1]) != has_error


def total(image):
    """E_D without a mesh."""
    return float(np.var(image.data, dtype=np.float64)) * image.volume


@pytest.mark.full
@pytest.mark.parametrize(
    ("shape", "noise", "target"), [((30, 28, 26), 3.0, 0.1), ((80, 70), 0.0, 0.03)]
)
def test_target_error(shape, noise, target):
    """Reached, without far more nodes than it takes."""
    image = ball(*shape, noise=noise)
    mesh = mesh_image(image, target_error=target).mesh
    fewer = mesh_image(image, len(mesh.points) // 2).mesh
    assert E_D(image, mesh) <= target * total(image)
    assert E_D(image, fewer) > 1.05 * target * total(image)
    assert check_mesh(mesh, image) == []


@pytest.mark.deep
def test_target_error_within_limits():
    """Limits on sizes that ask for more nodes than the error does, or for fewer, have the last
    word.
    """
    image = ball(40, 40, 40)
    fine, sized, coarse = (
        mesh_image(image, target_error=error, sizes=sizes)
        for error, sizes in (
            (0.5, Sizes(longest=9.0)),
            (0.5, Sizes(edge_size=6.0)),
            (0.001, Sizes(smallest=9.0, longest=40.0)),
        )
    )
    assert mesh_edges(fine.mesh)[1].max() < 11.0
    assert fine.history[-1].E_D < 0.1 * total(image)
    assert sized.nodes == nodes_of_sizes(image, Sizes(edge_size=6.0))[0] == len(sized.mesh.points)
    assert mesh_edges(coarse.mesh)[1].mean() > 9.0
    assert coarse.history[-1].E_D > 0.001 * total(image)


@pytest.mark.parametrize(
    ("image", "arguments", "words"),
    [
        (ball(30, 30, 30), {"nodes": 100, "target_error": 0.1}, "only one of"),
        (ball(30, 30, 30), {"target_error": 1.0}, "a fraction .* 0 to 1"),
        (ball(30, 30, 30), {"target_error": float("nan")}, "a fraction"),
        (filled((30, 30, 30), 1.0), {"target_error": 0.1}, "the image is constant"),
        (ball(30, 30, 30, noise=20.0), {"target_error": 0.1}, "below the noise fraction"),
    ],
)
def test_targets_that_cannot_be(image, arguments, words):
    with pytest.raises(InputError, match=words):
        mesh_image(image, **arguments)


@pytest.mark.full
def test_exchanges_do_not_follow_noise(monkeypatch):
    """In noise alone hardly a node is exchanged, if its level is known."""
    image = Image(np.random.default_rng(1).normal(0.0, 10.0, (32, 32, 32)))
    fast, made = sys.modules["tetopt.engine.fast"], []
    start, exchange = octree_mesh(image, 800), fast.exchange

    def counted(*arguments):
        done = exchange(*arguments)
        made.append(min(done.n_split, done.n_collapsed))
        return done

    def count():
        made.clear()
        optimize(image, start, k_D=0.85, nodes=len(start.points), iterations=3)
        return sum(made)

    monkeypatch.setattr(fast, "exchange", counted)
    known = count()
    monkeypatch.setattr("tetopt.contents.content.noise_level", lambda data, inside: 0.0)
    unknown = count()
    assert unknown > 30
    assert known < 0.1 * unknown
