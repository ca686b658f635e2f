"""The paper's four errors to the digits of Table 1, histograms, kinds of bad cells, and the
summary.
"""

from math import acos, atan, degrees, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import (
    ALL_SMALL,
    BAD_TETS,
    CUBE_CORNER,
    EQUILATERAL,
    FIVE_TET_CUBE,
    REGULAR_TET,
    RIGHT_TRIANGLE,
    SINGLE,
    TWO_TETS,
    TWO_TRIANGLES,
    random_rotation,
    seeds,
    single,
)

from tetopt import Image, lattice_mesh
from tetopt.geometry.simplex import dihedral_angles, rho, squared_edges, volumes
from tetopt.measure import quality as measure
from tetopt.measure.quality import quality, quality_errors, rho_histogram

# The four errors


def test_third_row_of_table_1():
    """Fig. 2(a): 7 x 7 squares cut into four, 113 nodes and 196 triangles; every digit of the
    row.
    """
    mesh = lattice_mesh(Image(np.zeros((70, 70))), blocks=(7, 7))
    assert (len(mesh.points), len(mesh.cells)) == (113, 196)
    errors = quality_errors(mesh.points, mesh.cells)
    assert [round(error, 4) for error in errors] == [0.0858, 0.0858, 1.4424, 0.0858]


def test_errors_of_two_different_cells():
    """3-4-5 and isosceles right triangle: errors 0.1 and 1.5 - sqrt 2."""
    points = np.vstack([RIGHT_TRIANGLE[0], [[0.0, 0], [1, 0], [0, 1]]])
    cells = np.array([[0, 1, 2], [3, 4, 5]])
    a, b = 0.1, 1.5 - sqrt(2)
    expected = ((a + b) / 2, 2 * a * b / (a + b), a * a + b * b, a)
    assert quality_errors(points, cells) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("mesh", [EQUILATERAL, REGULAR_TET])
def test_regular_cells_have_no_error_and_none_below_0(mesh):
    rng = np.random.default_rng(0)
    points, cells = mesh
    for _ in range(50):
        turned = points @ random_rotation(rng, points.shape[1]).T * rng.uniform(0.1, 10)
        errors = quality_errors(turned, cells)
        assert 0 <= min(errors) <= max(errors) < 1e-14


def test_harmonic_mean_is_0_when_one_error_is():
    """REGULAR_TET has whole coordinates, and rho a rounding above 1/3."""
    assert rho(*REGULAR_TET)[0] >= 1 / 3
    points = np.vstack([REGULAR_TET[0], CUBE_CORNER[0]])
    with np.errstate(all="raise"):
        errors = quality_errors(points, np.array([[0, 1, 2, 3], [4, 5, 6, 7]]))
    assert errors.harmonic_mean == 0
    assert errors.worst == pytest.approx(1 / 3 - rho(*CUBE_CORNER)[0])
    assert errors.mean == pytest.approx(errors.worst / 2)


# Histogram


def test_histogram_is_fractions_over_0_to_1_over_n():
    fraction, edges = rho_histogram(*FIVE_TET_CUBE, bins=3)
    assert edges == pytest.approx([0, 1 / 9, 2 / 9, 1 / 3])
    assert fraction.tolist() == [0, 0, 1]
    fraction, _ = rho_histogram(*FIVE_TET_CUBE, bins=30)  # rho 1/3 once, 0.2440 four times
    assert fraction[[29, int(0.2440 * 90)]] == pytest.approx([0.2, 0.8])
    fraction, edges = rho_histogram(*EQUILATERAL)
    assert fraction.tolist() == [0] * 39 + [1]
    assert (len(edges), edges[-1]) == (41, 0.5)


# Kinds


def cell_kinds(points, cells):
    return measure.cell_kinds(points, cells, rho(points, cells))


@pytest.mark.parametrize("kind", BAD_TETS)
@pytest.mark.parametrize("t", [0.1, 0.03, 1e-3, 1e-6])
def test_kind_of_each_archetype(kind, t):
    assert cell_kinds(*single(BAD_TETS[kind](t))).tolist() == [kind]


@pytest.mark.parametrize(
    "mesh", [*SINGLE[2], *SINGLE[3][:2], TWO_TETS, FIVE_TET_CUBE, TWO_TRIANGLES]
)
def test_good_cells_are_good(mesh):
    assert set(cell_kinds(*mesh)) == {"good"}


def test_kinds_of_triangles():
    points = np.array([[0.0, 0], [1, 0], [0.5, 0.05], [1, 0.1], [0.5, 0.5]])
    cells = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    assert cell_kinds(points, cells).tolist() == ["cap", "needle", "good"]


@given(seeds, st.sampled_from(sorted(BAD_TETS)))
def test_kind_does_not_change_with_rotation_scale_reflection_or_order(seed, kind):
    rng = np.random.default_rng(seed)
    shape = BAD_TETS[kind](np.exp(rng.uniform(np.log(1e-4), np.log(0.1))))
    points, cells = single(shape + rng.normal(scale=1e-6, size=(4, 3)))
    assert cell_kinds(points, cells).tolist() == [kind]
    scale, turned = np.exp(rng.uniform(-5, 5)), points @ random_rotation(rng, 3).T
    moved = scale * rng.choice([-1, 1]) * turned + rng.normal(size=3)
    assert cell_kinds(moved, rng.permuted(cells, axis=1)).tolist() == [kind]


@pytest.mark.parametrize("kind", ["sliver", "cap", "spade", "needle"])
def test_flat_cells_have_a_kind(kind):
    points = np.arange(4.0)[:, None] * np.ones(3) if kind == "needle" else BAD_TETS[kind](0.0)
    assert cell_kinds(points, np.array([[0, 1, 2, 3]])).tolist() == [kind]


# Angles of the archetypes in closed form


# The summary


def test_quality_of_the_cube_of_five():
    measured = quality(*FIVE_TET_CUBE)
    corner_rho, corner_angle = 2 / (3 + 3 * sqrt(3)), degrees(acos(1 / sqrt(3)))
    expected = {
        "n_nodes": 8,
        "n_cells": 5,
        "volume": 1,
        "smallest_volume": 1 / 6,
        "mean_rho": (1 / 3 + 4 * corner_rho) / 5,
        "min_rho": corner_rho,
        "p1_rho": corner_rho,
        "min_dihedral": corner_angle,
        "p1_dihedral": corner_angle,
        "max_dihedral": 90,
        "n_under_10_degrees": 0,
    }
    assert {name: getattr(measured, name) for name in expected} == pytest.approx(expected)
    assert measured.errors == quality_errors(*FIVE_TET_CUBE)
    assert measured.kinds == dict.fromkeys(BAD_TETS, 0)


def test_quality_of_good_and_bad_cells():
    """99 cube corners and one of each archetype: percentiles between the best and the worst."""
    shapes = [CUBE_CORNER[0]] * 99 + [make(0.02) for make in BAD_TETS.values()]
    points = np.vstack(shapes)
    cells = np.array([row + 4 * k for k, shape in enumerate(shapes) for row in single(shape)[1]])
    measured = quality(points, cells)
    assert measured.kinds == {kind: 1 for kind in BAD_TETS}
    assert measured.n_under_10_degrees == 5
    angles = dihedral_angles(points, cells)
    assert measured.min_dihedral == angles.min() == pytest.approx(degrees(2 * atan(0.01 / sqrt(3))))
    assert measured.max_dihedral == angles.max() > 170
    assert measured.p1_dihedral == np.percentile(angles.min(axis=1), 1)
    assert measured.p1_rho == np.percentile(rho(points, cells), 1)
    assert measured.smallest_volume == volumes(points, cells).min()


@pytest.mark.parametrize("mesh", ALL_SMALL)
def test_kinds_are_named_by_dimension(mesh):
    kinds = quality(*mesh).kinds
    assert set(kinds) == ({"needle", "cap"} if mesh[0].shape[1] == 2 else set(BAD_TETS))
    assert sum(kinds.values()) == (cell_kinds(*mesh) != "good").sum()


def test_quality_by_blocks_of_cells_is_that_of_all(monkeypatch):
    """Blocks bound the memory, and each of them has its say."""
    points, cells = FIVE_TET_CUBE
    points = points + 0.1 * np.random.default_rng(1).random(points.shape)
    whole = quality(points, cells)
    monkeypatch.setattr("tetopt.measure.quality.BLOCK_CELLS", 2)
    assert quality(points, cells) == whole
    assert whole.max_dihedral == dihedral_angles(points, cells).max()
    assert whole.max_edge == pytest.approx(np.sqrt(squared_edges(points, cells).max()))
