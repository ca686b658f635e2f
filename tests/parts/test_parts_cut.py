"""Meshes divided into parts, and put together again."""

from collections import Counter

import numpy as np
import pytest
from meshes import delaunay_box

from tetopt.geometry.simplex import volumes
from tetopt.parts.cut import ROUND_SHIFTS, Shared, counts_of, cut, joined, pieces

PLACES = np.random.default_rng(5).uniform(0.0, 30.0, (4000, 3)) ** [1.0, 1.5, 1.0]
EVEN = np.ones(len(PLACES))
UNEVEN = np.random.default_rng(6).uniform(0.1, 1.0, len(PLACES))


def shared_mesh(seed, part_of):
    """A random mesh of a box of whole ticks, and its parts by a function of its centroids (M,
    3), 0 to 1.
    """
    rng = np.random.default_rng(seed)
    index, cells = delaunay_box(rng, (14, 12, 11), 60)
    ticks = np.rint(index * 1024).astype(np.int64)
    centroids = (index[cells].mean(axis=1) + 0.5) / (14, 12, 11)
    return Shared(
        ticks, cells.astype(np.int64), np.unique(part_of(centroids), return_inverse=True)[1]
    )


# Two planes of a chessboard touch in edges and nodes alone; single cells touch anyhow.
WAYS = {
    "one part": lambda places: np.zeros(len(places)),
    "slabs": lambda places: np.floor(places[:, 0] * 3),
    "pinched": lambda places: np.floor(places * 3).sum(axis=1) % 2,
    "by chance": lambda places: np.random.default_rng(7).integers(0, 5, len(places)),
    "a cell each": lambda places: np.arange(len(places)),
}


@pytest.fixture(params=list(WAYS))
def mesh(request):
    return shared_mesh(1, WAYS[request.param])


def by_places(ticks, cells):
    """Cells as the places of their nodes, how often each is there."""
    return Counter(frozenset(map(tuple, cell)) for cell in ticks[cells].tolist())


@pytest.mark.parametrize("weights", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("shift", ROUND_SHIFTS)
@pytest.mark.parametrize("counts", [(1, 1, 1), (2, 1, 1), (2, 3, 2)])
def test_parts_are_numbered_without_gaps_and_are_of_equal_weight(counts, shift, weights):
    part = cut(PLACES, weights, counts, shift)
    fractions = np.bincount(part, weights) / weights.sum()
    # Shifted there is one more along each axis that is divided, and the first and last are `1 -
    # shift` and `shift`.
    widths = [
        np.array([1.0])
        if count == 1
        else np.full(count, 1.0 / count)
        if shift == 0.0
        else np.array([shift, *[1.0] * (count - 1), 1.0 - shift]) / count
        for count in counts
    ]
    expected = np.einsum("i,j,k->ijk", *widths).ravel()
    assert part.shape == (len(PLACES),)
    assert len(fractions) == len(expected)
    # A cell more or less at each of three divisions.
    np.testing.assert_allclose(
        fractions, expected, rtol=0.0, atol=3.0 * weights.max() / weights.sum()
    )


def test_a_part_is_a_box_of_centroids():
    part = cut(PLACES, UNEVEN, (2, 2, 1), 0.25)
    first = [PLACES[part == k, 0] for k in range(part.max() + 1)]
    # three along the second axis in each of three along the first
    for some in range(0, len(first), 3):
        assert all(np.ptp(each) > 0.0 for each in first[some : some + 3])
        if some + 3 < len(first):
            assert max(map(np.max, first[some : some + 3])) <= min(
                map(np.min, first[some + 3 : some + 6])
            )


def test_more_parts_than_cells_are_a_cell_each():
    assert sorted(cut(PLACES[:3], EVEN[:3], (4, 4, 4), 0.5)) == [0, 1, 2]
    assert sorted(cut(PLACES[:3], EVEN[:3], (4, 4, 4), 0.0)) == [0, 1, 2]


def test_ties_go_by_the_number_of_the_cell():
    alike = np.zeros((10, 3))
    np.testing.assert_array_equal(cut(alike, np.ones(10), (2, 1, 1), 0.0), [0] * 5 + [1] * 5)


@pytest.mark.parametrize("n_parts", [1, 3, 8, 100])
def test_there_are_as_many_parts_as_asked_for_at_least_and_they_are_near_to_cubes(n_parts):
    lengths = np.array([200.0, 230.0, 190.0])
    counts = np.array(counts_of(n_parts, lengths))
    assert np.prod(counts) >= n_parts
    assert np.prod(counts - (counts == counts.max())) < n_parts
    assert (lengths / counts).max() <= 2.1 * (lengths / counts).min()


def test_each_cell_is_in_one_piece_with_its_nodes_in_their_order(mesh):
    some = pieces(mesh)
    assert len(some) == mesh.part.max() + 1
    for number, piece in enumerate(some):
        np.testing.assert_array_equal(piece.ticks, mesh.ticks[piece.nodes])
        np.testing.assert_array_equal(piece.nodes[piece.cells], mesh.cells[mesh.part == number])
        assert (np.diff(piece.nodes) > 0).all()


def test_pieces_that_are_joined_are_the_mesh_again(mesh):
    some = pieces(mesh)
    again = joined([piece.ticks for piece in some], [piece.cells for piece in some])
    assert len(again.ticks) == len(mesh.ticks) == len(set(map(tuple, again.ticks.tolist())))
    assert by_places(again.ticks, again.cells) == by_places(mesh.ticks, mesh.cells)
    np.testing.assert_array_equal(again.part, np.sort(mesh.part))
    # A cell's nodes come in their order, by which it has its orientation.
    order = np.argsort(mesh.part, kind="stable")
    np.testing.assert_array_equal(again.ticks[again.cells], mesh.ticks[mesh.cells[order]])
    assert (volumes(1.0 * again.ticks, again.cells) > 0.0).all()


def test_nodes_that_are_joined_are_numbered_as_they_come():
    ticks = [
        np.array([[5, 5, 5], [0, 0, 0], [0, 0, 7], [0, 7, 0]]),
        np.array([[9, 9, 9], [0, 0, 0], [0, 0, 7], [-9, 0, 2]]),
    ]
    again = joined(ticks, [np.array([[0, 1, 2, 3]]), np.array([[0, 1, 2, 3]])])
    np.testing.assert_array_equal(again.cells, [[0, 1, 2, 3], [4, 1, 2, 5]])
    np.testing.assert_array_equal(again.ticks[4:], [[9, 9, 9], [-9, 0, 2]])
