"""Cells that a map inverts are untangled, and all else stays where the map has it."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tetopt import Image, InputError, lattice_mesh
from tetopt.geometry.simplex import volumes
from tetopt.geometry.untangle import untangle


@pytest.fixture
def mesh(n):
    return lattice_mesh(Image(np.zeros((8,) * n)), nodes=300 if n == 3 else 80)


def stretch(points):
    return 1.1 * points + 0.1 * np.sin(points)


def test_a_map_without_folds_stays_to_the_last_bit(mesh):
    places, n_inverted = untangle(mesh.points, stretch(mesh.points), mesh.cells)
    assert_array_equal(places, stretch(mesh.points))
    assert n_inverted == 0


def test_folded_cells_are_untangled_and_nodes_elsewhere_stay(mesh):
    moved = stretch(mesh.points)
    middle = np.argmin(((mesh.points - mesh.points.mean(axis=0)) ** 2).sum(axis=1))
    moved[middle] += 4.0
    is_inverted = volumes(moved, mesh.cells) <= 0.0
    places, n_inverted = untangle(mesh.points, moved, mesh.cells)
    assert n_inverted == is_inverted.sum() > 0
    assert (volumes(places, mesh.cells) > 0.0).all()
    is_same = (places == moved).all(axis=1)
    assert not is_same[middle]
    assert is_same.mean() > 0.5
    assert np.abs(places - stretch(mesh.points)).max() < 4.0


@pytest.mark.parametrize(
    ("move", "words"),
    [
        (lambda x: x * [-1.0] + 0.0 * x if x.shape[1] == 3 else x[:, ::-1], "it mirrors"),
        (lambda x: x + 3.0 * np.sin(40.0 * x), "is it for these two images"),
    ],
)
def test_mirrors_and_wild_maps_are_refused(mesh, move, words):
    with pytest.raises(InputError, match=rf"^inverts \d+ of \d+ cells: .*{words}"):
        untangle(mesh.points, move(mesh.points), mesh.cells)
