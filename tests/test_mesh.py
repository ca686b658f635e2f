"""The mesh: what is accepted, what is kept, and every message."""

import copy
import pickle

import numpy as np
import pytest
from meshes import ALL_SMALL, BAD_TETS, REGULAR_TET, SQUARE, single
from numpy.testing import assert_array_equal

import tetopt
from tetopt import Image, InputError, Mesh
from tetopt.geometry.simplex import edge_pairs

TRIANGLE = [[0, 0], [1, 0], [0, 1]]


@pytest.mark.parametrize("arrays", ALL_SMALL)
def test_small_meshes_are_held_as_given(arrays):
    points, cells = arrays
    mesh = Mesh(points, cells)
    assert mesh.ndim == points.shape[1]
    assert_array_equal(mesh.points, points)
    assert_array_equal(mesh.cells, cells)


@pytest.mark.parametrize("kind", BAD_TETS)
def test_very_thin_cells_are_a_mesh(kind):
    assert len(Mesh(*single(BAD_TETS[kind](1e-9))).cells) == 1


def test_lists_and_small_types_become_float64_and_int64():
    mesh = Mesh(np.array(TRIANGLE, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.uint8))
    assert mesh.points.dtype == np.float64
    assert mesh.cells.dtype == np.int64
    assert Mesh(TRIANGLE, [[0, 1, 2]]).cells.tolist() == [[0, 1, 2]]


def test_arrays_are_copied_contiguous_and_read_only():
    given = [np.asfortranarray(array) for array in SQUARE]
    mesh = Mesh(*given)
    for array, kept, expected in zip(given, (mesh.points, mesh.cells), SQUARE, strict=True):
        array[:] = 0
        assert_array_equal(kept, expected)
        assert kept.flags.c_contiguous
        with pytest.raises(ValueError, match="read-only"):
            kept[0, 0] = 1
    with pytest.raises(AttributeError):
        mesh.points = given[0]


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda noun: pickle.loads(pickle.dumps(noun))]
)
def test_copies_of_nouns_are_locked_and_equal(again):
    middles = 0.5 * (np.array(TRIANGLE)[[0, 0, 1]] + np.array(TRIANGLE)[[1, 2, 2]])
    phantom = tetopt.load_phantom("sphere")
    for noun, names in (
        (Mesh(TRIANGLE, [[0, 1, 2]], middles), ("points", "cells", "midpoints")),
        (Image(np.arange(6.0).reshape(2, 3), np.diag([2.0, 3.0, 1.0])), ("data", "affine")),
        (phantom, ("size_mm", "axes")),
        (phantom.shapes[0], ("center", "half")),
    ):
        other = again(noun)
        assert repr(other) == repr(noun)
        for name in names:
            assert_array_equal(getattr(other, name), getattr(noun, name))
            assert not getattr(other, name).flags.writeable


def test_an_unpickled_mesh_is_checked():
    kind, (points, cells, _) = Mesh(TRIANGLE, [[0, 1, 2]]).__reduce__()
    with pytest.raises(InputError, match=r"indices in 0\.\.2, got 1\.\.3"):
        kind(points, cells + 1, None)


def hide(array, value):
    return np.ma.masked_equal(np.array(array, dtype=float), value)


@pytest.mark.parametrize(
    ("call", "arrays", "words"),
    [
        (Image, [hide(np.eye(3), 0.0)], "image data: got 6 masked values; .*filled"),
        (Image, [np.zeros((2, 2)), hide(np.diag([2, 3, 1]), 3)], "affine: got 1 masked values"),
        (Mesh, [hide(TRIANGLE, 1), [[0, 1, 2]]], "mesh points: got 2 masked values"),
        (Mesh, [TRIANGLE, np.ma.masked_equal([[0, 1, 2]], 1)], "mesh cells: got 1 masked values"),
        (tetopt.quality, [hide(TRIANGLE, 1), [[0, 1, 2]]], "quality: points: got 2 masked values"),
    ],
)
def test_masked_values_are_refused(call, arrays, words):
    """Numpy would take the numbers behind the mask; a mask that hides nothing is fine."""
    with pytest.raises(InputError, match=f"^{words}"):
        call(*arrays)
    assert Image(hide(np.zeros((2, 3)), 1)).data.shape == (2, 3)


def test_unused_nodes_are_allowed():
    assert len(Mesh([*TRIANGLE, [5, 5]], [[0, 1, 2]]).points) == 4


@pytest.mark.parametrize(
    ("points", "cells", "message"),
    [
        (np.zeros((4, 4)), [[0, 1, 2, 3]], r"expected shape \(N, 2\) or \(N, 3\), got \(4, 4\)"),
        (np.zeros(4), [[0, 1, 2]], r"expected shape \(N, 2\) or \(N, 3\), got \(4,\)"),
        (TRIANGLE, [[0, 1]], r"expected shape \(M, 3\)"),
        (TRIANGLE, [0, 1, 2], r"expected shape \(M, 3\)"),
        (TRIANGLE, [[0, 1, 2, 2]], r"expected shape \(M, 3\)"),
        (TRIANGLE, np.empty((0, 3), dtype=int), "M > 0"),
        (TRIANGLE, [[0.0, 1.0, 2.0]], "expected integers, got float64"),
        (TRIANGLE, [[True, False, True]], "expected integers, got bool"),
        (TRIANGLE, [[0, 1, 3]], r"expected indices in 0\.\.2, got 0\.\.3"),
        (TRIANGLE, [[-1, 1, 2]], r"expected indices in 0\.\.2, got -1\.\.2"),
        ([[0, 0], [1, np.nan], [0, 1]], [[0, 1, 2]], r"node 1 is \[1\.0, nan\]"),
        ([[0, 0], [1, 0], [np.inf, 1]], [[0, 1, 2]], r"node 2 is \[inf, 1\.0\]"),
        (TRIANGLE, [[0, 1, 2], [0, 2, 1]], r"1 of 2 are flat or inverted, such as \[1\]"),
        (TRIANGLE, [[0, 1, 1]], "1 of 1 are flat or inverted"),
        ([[0, 0], [1, 1], [2, 2]], [[0, 1, 2]], "1 of 1 are flat or inverted"),
        (
            REGULAR_TET[0],
            [[1, 0, 2, 3]] * 7,
            r"7 of 7 are flat or inverted, such as \[0, 1, 2, 3, 4\]",
        ),
    ],
)
def test_what_is_no_mesh_is_refused(points, cells, message):
    with pytest.raises(InputError, match=message):
        Mesh(points, cells)


def test_moved_nodes_and_midpoints_keep_their_cells(n):
    points = np.vstack([np.zeros(n), np.eye(n)])
    midpoints = np.array([(points[a] + points[b]) / 2 for a, b in edge_pairs(n)]) + 0.01
    mesh = Mesh(points, [np.arange(n + 1)], midpoints)
    A = np.eye(n + 1) + 0.1 * np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    A[n] = np.eye(n + 1)[n]
    for transform in (A, lambda x: x @ A[:n, :n].T + A[:n, n]):
        moved = mesh.moved(transform)
        for before, after in ((points, moved.points), (midpoints, moved.midpoints)):
            np.testing.assert_allclose(after, before @ A[:n, :n].T + A[:n, n], rtol=1e-14)
        np.testing.assert_array_equal(moved.cells, mesh.cells)


@pytest.mark.parametrize(
    ("transform", "words"),
    [
        (np.eye(2), r"matrix of 3 x 3 numbers .* got an array of shape \(2, 2\)"),
        (2 * np.eye(3), r"with the last row \[0.0, 0.0, 1.0\]"),
        ("affine.mat", "expected a callable or a matrix"),
        (lambda x: x[:2], r"expected \(3, 2\) coordinates of the points, got \(2, 2\)"),
        (np.diag([-1, 1, 1]), "Mesh.moved: mesh cells: 1 of 1 are flat or inverted"),
        (lambda x: x + np.inf, "Mesh.moved: mesh points: .*finite"),
    ],
)
def test_maps_that_leave_no_mesh_are_refused(transform, words):
    with pytest.raises(InputError, match=words):
        Mesh(TRIANGLE, [[0, 1, 2]]).moved(transform)
