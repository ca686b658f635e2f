"""Facets, stars, colours and components, against their twins and against the divergence theorem."""

import naive
import numpy as np
import pytest
from hypothesis import given
from meshes import FIVE_TET_CUBE, dimensions, seeds, split_box
from numpy.testing import assert_array_equal

import tetopt
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import (
    boundary_facets,
    cell_euler,
    components,
    facets,
    folded_groups,
    greedy_colours,
    largest_component,
    stars,
)

pytestmark = pytest.mark.kernel


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
    n_nodes = len(points) + 2  # the last two are in no cell
    around, twin = stars(cells, n_nodes), naive.stars(cells, n_nodes)
    assert twin[-2:] == [[], []]
    assert around.start.tolist() == [0, *np.cumsum([len(star) for star in twin])]
    assert around.cells.tolist() == [cell for star in twin for cell in star]


# Facets


@given(seeds, dimensions)
def test_facets_are_those_of_the_twin(seed, n):
    """`of_cell` by the opposite node, `sign` by the exact side on which that node lies."""
    points, cells = random_mesh(seed, n)
    sides, twin, exact = facets(cells), naive.facets(cells), naive.exactly(points)
    assert [tuple(row) for row in sides.nodes.tolist()] == sorted(twin)
    rows = zip(sorted(twin), sides.cells.tolist(), sides.n_cells, strict=True)
    for nodes, of_facet, count in rows:
        assert [side for side in of_facet if side >= 0] == twin[nodes]
        assert count == len(twin[nodes])
    for cell, of_cell, signs in zip(cells.tolist(), sides.of_cell, sides.sign, strict=True):
        for node, facet, side in zip(cell, of_cell, signs, strict=True):
            nodes = sides.nodes[facet].tolist()
            assert nodes == sorted(set(cell) - {node})
            behind = naive.sign(naive.signed_volume([exact[a] for a in [*nodes, node]]))
            # 2-D: left of the edge; 3-D: under the triangle
            assert side == (behind if n == 2 else -behind)


@pytest.mark.parametrize("factor", [10, 3_000_000, 2**40])
def test_facets_do_not_depend_on_how_large_the_node_numbers_are(factor):
    """Three numbers over 2^21 do not fit one of 63 bits."""
    _, cells = FIVE_TET_CUBE
    sides, far = facets(cells), facets(cells * factor)
    assert_array_equal(far.nodes, sides.nodes * factor)
    for ours, theirs in zip(sides[1:], far[1:], strict=True):
        assert_array_equal(ours, theirs)


def test_facets_of_cells_that_do_not_conform_are_counted():
    """Three triangles on the edge 0 1."""
    cells = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]])
    sides = facets(cells)
    assert sides.nodes[0].tolist() == [0, 1]
    assert sides.n_cells.tolist() == [3, 1, 1, 1, 1, 1, 1]
    assert sides.cells[0].tolist() == [0, 1]
    assert (sides.cells[1:, 1] == -1).all()
    assert [0, 1] not in np.sort(boundary_facets(cells)).tolist()


# Boundary


@given(seeds, dimensions)
def test_boundary_facets_enclose_the_mesh(seed, n):
    """And that of a part of the mesh encloses that part, by the divergence theorem: 1/n times the
    integral of x . normal, the sum of det(corners) / n!.
    """
    points, cells = random_mesh(seed, n)
    twin = naive.facets(cells)
    listed = sorted(map(sorted, boundary_facets(cells).tolist()))
    assert listed == sorted(list(nodes) for nodes, shared in twin.items() if len(shared) == 1)
    assert volumes(points, cells).sum() == pytest.approx(4.0**n, rel=1e-12)
    for part in (cells, cells[: max(1, len(cells) // 2)]):
        enclosed = np.linalg.det(points[boundary_facets(part)]).sum() / (2 if n == 2 else 6)
        assert enclosed == pytest.approx(volumes(points, part).sum(), rel=1e-12)


# Colours


def colours_of(cells, n_nodes):
    around = stars(cells, n_nodes)
    return greedy_colours(np.ascontiguousarray(cells), around.start, around.cells)


@given(seeds, dimensions)
def test_colours_are_proper_and_those_of_the_twin(seed, n):
    points, cells = random_mesh(seed, n)
    colours, twin = colours_of(cells, len(points)), naive.stars(cells, len(points))
    assert colours.tolist() == naive.node_colours(cells, len(points))
    assert (np.diff(np.sort(colours[cells], axis=1), axis=1) > 0).all()
    assert colours.max() < max(len(np.unique(cells[star])) for star in twin)
    # Nodes of one colour have stars without a common cell.
    for colour in range(colours.max() + 1):
        touched = [cell for node in np.flatnonzero(colours == colour) for cell in twin[node]]
        assert len(touched) == len(set(touched))


def test_a_node_without_cells_gets_colour_0():
    assert colours_of(np.array([[0, 2, 3]]), 5).tolist() == [0, 0, 1, 2, 0]


# Components


@given(seeds, dimensions)
def test_components_are_those_of_the_twin(seed, n):
    """The largest, too: the first of equals."""
    _, cells = random_mesh(seed, n)
    is_chosen = np.random.default_rng(seed).random(len(cells)) < 0.4
    is_chosen[0] |= not is_chosen.any()
    chosen, twin = np.flatnonzero(is_chosen), np.array(naive.components(cells[is_chosen]))
    assert_array_equal(components(cells[is_chosen]), twin)
    largest = chosen[twin == np.bincount(twin).argmax()]
    assert_array_equal(largest_component(cells, is_chosen), largest)
    assert len(largest_component(cells, np.zeros(len(cells), dtype=bool))) == 0


@given(seeds, dimensions)
def test_the_euler_number_of_cells_is_that_of_the_twin(seed, n):
    """Of the open solid: what is on the boundary does not connect cells."""
    _, cells = random_mesh(seed, n)
    cells = cells[np.random.default_rng(seed).random(len(cells)) < 0.6]
    if len(cells):
        inner = naive.faces_of(cells) - naive.faces_of(boundary_facets(cells))
        assert cell_euler(cells) == 2 * (-1) ** n * naive.euler(inner)


@pytest.mark.parametrize("n", [2, 3])
def test_folded(n):
    """A conforming mesh has no fold; a node pulled through its star makes one; a third cell at a
    facet is one.
    """
    cells = tetopt.lattice_mesh(tetopt.Image(np.zeros((4,) * n)), blocks=(2,) * n).cells
    assert folded_groups(cells).shape == (0, 2)
    flipped = cells.copy()
    flipped[0, :2] = flipped[0, 1::-1]
    inner = [pair for pair in facets(cells).cells.tolist() if 0 in pair and -1 not in pair]
    assert sorted(map(sorted, folded_groups(flipped).tolist())) == sorted(map(sorted, inner))
    assert len(folded_groups(np.vstack([cells, cells[0]]))) >= n
