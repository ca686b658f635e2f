"""Facets, stars, colours and components, against their twins and against the divergence theorem."""

import naive
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import FIVE_TET_CUBE, split_box

import tetopt
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import (
    boundary_facets,
    components,
    facets,
    folded_groups,
    greedy_colours,
    largest_component,
    stars,
)

pytestmark = pytest.mark.kernel

seeds = st.integers(0, 2**32 - 1)
dimensions = st.sampled_from([2, 3])


def random_mesh(seed, n):
    """A conforming mesh of a box, its nodes and cells in random order."""
    rng = np.random.default_rng(seed)
    points, cells = split_box(rng, (4,) * n, int(rng.integers(0, 12)))
    order = rng.permutation(len(points))
    place = np.argsort(order)
    return points[order], rng.permutation(place[cells])


# Stars


@given(seeds, dimensions)
def test_stars_are_those_of_the_twin(seed, n):
    points, cells = random_mesh(seed, n)
    around = stars(cells, len(points) + 2)  # the last two nodes are in no cell
    assert len(around.start) == len(points) + 3
    listed = [
        around.cells[a:b].tolist() for a, b in zip(around.start, around.start[1:], strict=False)
    ]
    assert listed == naive.stars(cells, len(points) + 2)
    assert listed[-2:] == [[], []]


# Facets


@given(seeds, dimensions)
def test_facets_are_those_of_the_twin(seed, n):
    _, cells = random_mesh(seed, n)
    shared, twin = facets(cells), naive.facets(cells)
    assert [tuple(row) for row in shared.nodes.tolist()] == sorted(twin)
    for nodes, sides, count in zip(
        shared.nodes.tolist(), shared.cells.tolist(), shared.n_cells, strict=True
    ):
        assert [side for side in sides if side >= 0] == twin[tuple(nodes)]
        assert count == len(twin[tuple(nodes)])


@pytest.mark.parametrize("factor", [10, 3_000_000, 2**40])
def test_facets_do_not_depend_on_how_large_the_node_numbers_are(factor):
    """Three numbers over 2^21 do not fit one of 63 bits."""
    _, cells = FIVE_TET_CUBE
    sides, far = facets(cells), facets(cells * factor)
    np.testing.assert_array_equal(far.nodes, sides.nodes * factor)
    for ours, theirs in zip(sides[1:], far[1:], strict=True):
        np.testing.assert_array_equal(ours, theirs)


@given(seeds, dimensions)
def test_facets_know_where_each_cell_holds_them(seed, n):
    """`of_cell` by the opposite node, `sign` by the exact side on which that node lies."""
    points, cells = random_mesh(seed, n)
    sides = facets(cells)
    exact = naive.exactly(points)
    for cell, of_cell, signs in zip(cells.tolist(), sides.of_cell, sides.sign, strict=True):
        for node, facet, side in zip(cell, of_cell, signs, strict=True):
            nodes = sides.nodes[facet].tolist()
            assert nodes == sorted(set(cell) - {node})
            behind = naive.sign(naive.signed_volume([exact[a] for a in [*nodes, node]]))
            # 2-D: left of the edge; 3-D: under the triangle
            assert side == (behind if n == 2 else -behind)


def test_facets_of_cells_that_do_not_conform_are_counted():
    """Three triangles on the edge 0 1."""
    sides = facets(np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]]))
    assert sides.nodes[0].tolist() == [0, 1]
    assert sides.n_cells.tolist() == [3, 1, 1, 1, 1, 1, 1]
    assert sides.cells[0].tolist() == [0, 1]
    assert (sides.cells[1:, 1] == -1).all()
    assert [0, 1] not in np.sort(
        boundary_facets(np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]]))
    ).tolist()


# Boundary


def enclosed_volume(points, outward):
    """By the divergence theorem, 1/n times the integral of x . normal: sum of det(corners) / n!."""
    n = points.shape[1]
    return float(np.linalg.det(points[outward]).sum()) / (2 if n == 2 else 6)


@given(seeds, dimensions)
def test_boundary_facets_enclose_the_mesh(seed, n):
    points, cells = random_mesh(seed, n)
    outward = boundary_facets(cells)
    assert enclosed_volume(points, outward) == pytest.approx(4.0**n, rel=1e-12)
    twin = naive.facets(cells)
    assert sorted(map(sorted, outward.tolist())) == sorted(
        list(k) for k, shared in twin.items() if len(shared) == 1
    )
    # The boundary of a part of the mesh encloses that part.
    part = cells[: max(1, len(cells) // 2)]
    assert enclosed_volume(points, boundary_facets(part)) == pytest.approx(
        volumes(points, part).sum(), rel=1e-12
    )


# Colours


def colours_of(cells, n_nodes):
    around = stars(cells, n_nodes)
    return greedy_colours(np.ascontiguousarray(cells), around.start, around.cells)


@given(seeds, dimensions)
def test_colours_are_proper_and_those_of_the_twin(seed, n):
    points, cells = random_mesh(seed, n)
    colours = colours_of(cells, len(points))
    assert colours.tolist() == naive.node_colours(cells, len(points))
    of_cells = np.sort(colours[cells], axis=1)
    assert (np.diff(of_cells, axis=1) > 0).all()
    neighbours = max(
        len({a for c in star for a in cells[c].tolist()})
        for star in naive.stars(cells, len(points))
    )
    assert colours.max() < neighbours
    # Nodes of one colour have stars without a common cell.
    for colour in range(colours.max() + 1):
        touched = [
            cell
            for node in np.flatnonzero(colours == colour)
            for cell in naive.stars(cells, len(points))[node]
        ]
        assert len(touched) == len(set(touched))


def test_a_node_without_cells_gets_colour_0():
    assert colours_of(np.array([[0, 2, 3]]), 5).tolist() == [0, 0, 1, 2, 0]


# Components


@given(seeds, dimensions)
def test_components_are_those_of_the_twin(seed, n):
    _, cells = random_mesh(seed, n)
    rng = np.random.default_rng(seed)
    chosen = np.flatnonzero(rng.random(len(cells)) < 0.4)
    chosen = chosen if len(chosen) else np.array([0])
    assert components(cells[chosen]).tolist() == naive.components(cells[chosen])


@given(seeds, dimensions)
def test_largest_component_is_that_of_the_twin(seed, n):
    _, cells = random_mesh(seed, n)
    is_chosen = np.random.default_rng(seed).random(len(cells)) < 0.4
    chosen = np.flatnonzero(is_chosen)
    sets = {}
    for cell, number in zip(chosen.tolist(), naive.components(cells[chosen]), strict=True):
        sets.setdefault(number, []).append(cell)
    expected = max(sets.values(), key=len, default=[])  # the first of equals
    assert largest_component(cells, is_chosen).tolist() == expected
    assert largest_component(cells, np.zeros(len(cells), dtype=bool)).tolist() == []


@pytest.mark.parametrize("n", [2, 3])
def test_folded(n):
    """A conforming mesh has no fold; a node pulled through its star makes one; a third cell at a
    facet is one.
    """
    mesh = tetopt.lattice_mesh(tetopt.Image(np.zeros((4,) * n)), blocks=(2,) * n)
    assert folded_groups(mesh.cells).shape == (0, 2)
    first = mesh.cells[0]
    flipped = mesh.cells.copy()
    flipped[0] = first[[1, 0, *range(2, n + 1)]]
    pairs = folded_groups(flipped)
    inner = [pair for pair in facets(mesh.cells).cells.tolist() if 0 in pair and -1 not in pair]
    assert sorted(map(sorted, pairs.tolist())) == sorted(map(sorted, inner))
    assert len(folded_groups(np.vstack([mesh.cells, first]))) >= n
