"""The modulus of a cell: the mean of the mapping over its voxels."""

import numpy as np
import pytest
from models import young_of
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from tetopt import Image, cell_moments, cell_of_voxel, lattice_mesh
from tetopt.fem.solution import gauss_moduli, solve
from tetopt.geometry.quadratic import gauss_rule
from tetopt.model.averages import (
    cell_values,
    cell_young,
    element_young,
    gauss_young,
    node_young,
    parse_average,
)
from tetopt.model.build import build_model
from tetopt.model.model import in_units
from tetopt.start.carve import part_of


def noise(shape, seed=0, affine=None):
    return Image(np.random.default_rng(seed).integers(0, 200, shape).astype(np.uint8), affine)


def law(h):
    return 1.0 + h


AVERAGES = {
    "mean": lambda values: values.mean(),
    "geometric": lambda values: np.exp(np.log(values).mean()),
    "harmonic": lambda values: 1.0 / (1.0 / values).mean(),
    "power:2": lambda values: np.sqrt((values**2).mean()),
    "power:-0.5": lambda values: (values**-0.5).mean() ** -2.0,
    # of which it is 1e-9 times a variance away
    "power:1e-9": lambda values: np.exp(np.log(values).mean()),
    "hill": lambda values: 0.5 * (values.mean() + 1.0 / (1.0 / values).mean()),
}


@pytest.mark.parametrize("average", AVERAGES)
@pytest.mark.parametrize("shape", [(12, 13), (14, 12, 13)])
def test_averages_over_ten_orders_of_magnitude(average, shape):
    """Against each cell's voxels one cell after the other; a cell without any has the modulus at
    its centroid.
    """
    image = Image(np.random.default_rng(0).uniform(-11.5, 11.5, shape))
    mesh = lattice_mesh(image, nodes=60 if len(shape) == 2 else 700)
    young, owner = cell_young(image, mesh, np.exp, average), cell_of_voxel(image, mesh)
    centroids = image.to_index(mesh.points[mesh.cells].mean(axis=1))
    n_empty = 0
    for cell, at in enumerate(np.rint(centroids).astype(int)):
        values = np.exp(image.data[owner == cell])
        if len(values) == 0:
            n_empty += 1
            assert young[cell] == np.exp(image.data[tuple(at)])
            continue
        assert values.min() <= young[cell] <= values.max()
        rel = 1e-7 if "e-9" in average else 1e-12
        assert young[cell] == pytest.approx(AVERAGES[average](values), rel=rel)
    assert n_empty > 0 or len(shape) == 2


def test_averages_of_one_value_are_that_value():
    image = noise((14, 12, 13))
    mesh = lattice_mesh(image, nodes=80)
    for each in [*AVERAGES, "nodes", "gauss"]:
        assert (cell_young(image, mesh, lambda h: 0.7 + 0.0 * h, each) == 0.7).all()
        for order in (1, 2):
            assert (element_young(image, mesh, lambda h: 0.7 + 0.0 * h, each, order) == 0.7).all()
    assert_allclose(cell_young(image, mesh), cell_moments(image, mesh).mean, rtol=1e-14)


def test_empty_space_in_a_cell():
    """A modulus of 0 counts in means of powers above 0; of others it would be all that counts,
    and is refused.
    """
    image = noise((10, 10, 10))
    mesh = lattice_mesh(image, nodes=40)
    owner = cell_of_voxel(image, mesh)
    mapping = [(99.0, 0.0), (199.0, 10.0)]
    assert (cell_young(image, mesh, mapping) > 0.0).all()
    roots = cell_young(image, mesh, mapping, "power:0.5")
    values = np.interp(image.data[owner == 0], [99.0, 199.0], [0.0, 10.0])
    assert roots[0] == pytest.approx((values**0.5).mean() ** 2, rel=1e-12)
    assert (cell_young(image, mesh, lambda h: 0.0 * h, "power:0.5") == 0.0).all()
    for each in ("geometric", "harmonic", "hill", "nodes", "gauss", "power:-2", "power:-0.5"):
        with refusal(rf"above 0 kPa for {each}, got 0 in \d+ voxels of the mesh.*`average` mean"):
            cell_young(image, mesh, mapping, each)


@pytest.mark.parametrize("average", ["mean", "geometric", "gauss", "nodes"])
def test_a_mapping_need_not_be_one_for_voxels_beside_the_mesh(average):
    """As of the air around an organ; within it everything is as with a mapping that holds
    everywhere.
    """
    image = noise((12, 12, 12))
    mesh = lattice_mesh(image, nodes=200)
    part = part_of(mesh, mesh.points[mesh.cells].max(axis=1)[:, 0] < 7.0)
    is_air = (cell_of_voxel(image, part) < 0) & (np.indices(image.shape)[0] > 8)
    air = Image(np.where(is_air, -1000.0, image.data))
    moduli = element_young(air, part, law, average, 2)
    assert_array_equal(moduli, element_young(image, part, law, average, 2))
    assert_array_equal(cell_values(air, part, np.sqrt), cell_values(image, part, np.sqrt))
    with refusal("expected 0 kPa or more"):
        element_young(air, mesh, law, average, 2)


@pytest.mark.parametrize(
    "text", ["", "voigt", "power", "power:", "power:x", "power:nan", "power:11", "mean:1", "Mean"]
)
def test_words_that_are_no_average(text):
    with refusal(r'average: expected mean, .*power:P with P from -10 to 10.*got "'):
        parse_average(text)
    with refusal("average: expected"):
        build_model(lattice_mesh(noise((4, 4, 4)), blocks=(1, 1, 1)), average=text)


def test_words_of_averages():
    powers = {"mean": 1.0, "geometric": 0.0, "harmonic": -1.0, "power:0.5": 0.5, "hill": None}
    assert {each: parse_average(each).power for each in powers} == powers
    assert parse_average(" power:+5e-1 ") == parse_average("power:0.5")
    places = {"nodes": "nodes", "gauss": "gauss", "hill": "cells"}
    assert {each: parse_average(each).place for each in places} == places


@pytest.mark.parametrize("shape", [(24, 20), (14, 12, 10)])
def test_moduli_of_nodes(shape):
    """The weighted geometric mean, hat function by hat function; within the range of the voxels
    around.
    """
    image = noise(shape)
    mesh = lattice_mesh(image, blocks=(2,) * len(shape))
    young = node_young(image, mesh, law)
    owner = cell_of_voxel(image, mesh)
    index = np.argwhere(owner >= 0)
    weight, total = np.zeros(len(mesh.points)), np.zeros(len(mesh.points))
    for place in index:
        corners = mesh.cells[owner[tuple(place)]]
        frame = np.vstack([mesh.points[corners].T, np.ones(len(corners))])
        hats = np.linalg.solve(frame, [*image.to_world(place[None].astype(float))[0], 1.0])
        weight[corners] += hats
        total[corners] += hats * np.log(1.0 + image.data[tuple(place)])
    assert_allclose(young, np.exp(total / weight), rtol=1e-9)
    assert_allclose(
        cell_young(image, mesh, law, "nodes"),
        young[mesh.cells].mean(axis=1),
        rtol=1e-15,
    )


def test_a_node_without_voxels_has_the_nearest_one_s_modulus():
    image = noise((3, 3, 3))
    mesh = lattice_mesh(image, blocks=(9, 9, 9))
    young = node_young(image, mesh, law)
    counts = np.bincount(cell_of_voxel(image, mesh).ravel(), minlength=len(mesh.cells))
    is_empty = np.bincount(mesh.cells.ravel(), np.repeat(counts, 4)) == 0
    assert is_empty.sum() > 100
    index = np.clip(np.rint(image.to_index(mesh.points)).astype(int), 0, 2)
    assert_array_equal(young[is_empty], 1.0 + image.data[tuple(index[is_empty].T)])


def test_moduli_at_gauss_points_are_linear_in_the_cell(n, order):
    """Exact for a linear field; their weighted sum is the mean over the cell; equal corners give
    that very number.
    """
    image = noise((8,) * n)
    mesh = lattice_mesh(image, blocks=(2,) * n)
    places, weights = gauss_rule(n, order)
    slope = np.array([0.3, -0.7, 0.2])[:n]
    young = 20.0 + mesh.points @ slope
    moduli = gauss_young(young, mesh, order)
    at = np.einsum("qa,cai->cqi", places, mesh.points[mesh.cells])
    assert_allclose(moduli, 20.0 + at @ slope, rtol=1e-13)
    assert_allclose(moduli @ weights, young[mesh.cells].mean(axis=1), rtol=1e-13)
    assert (gauss_young(np.full(len(mesh.points), 0.7), mesh, order) == 0.7).all()


def test_a_model_has_moduli_of_nodes():
    image = noise((8, 9, 10))
    mesh = lattice_mesh(image, blocks=(2, 2, 2))
    mapping = [(0.0, 1.0), (200.0, 10.0)]
    model = build_model(mesh, image, young=mapping, average="nodes")
    assert_array_equal(model.node_young, node_young(image, mesh, mapping))
    assert_array_equal(young_of(model), gauss_young(model.node_young, mesh, 1)[:, 0])
    assert_array_equal(
        build_model(mesh, image, young="1 + 0.045*h", average="nodes").node_young,
        node_young(image, mesh, lambda h: 1.0 + 0.045 * h),
    )
    assert build_model(mesh, image, young=mapping).node_young is None
    assert build_model(mesh, image, young="3", average="nodes").node_young is None  # nothing varies
    means = {"mean": np.ones(len(mesh.cells))}
    for source, options, words in (
        (image, {"bins": 3}, "bins: moduli that vary within cells cannot.*other than nodes"),
        (None, {"cell_data": means}, "average: nodes needs the image's voxels; give the image"),
    ):
        with refusal(words):
            build_model(mesh, source, young=mapping, average="nodes", **options)


@pytest.mark.parametrize("shape", [(24, 20), (14, 12, 10)])
def test_moduli_around_gauss_points(shape):
    """Each has the geometric mean of the cell's voxels nearest to its corner; empty ones that of
    the cell.
    """
    n = len(shape)
    image = noise(shape)
    mesh = lattice_mesh(image, blocks=(12 - 2 * n,) * n)
    young = element_young(image, mesh, law, "gauss", 2)
    assert young.shape == (len(mesh.cells), n + 1)
    owner = cell_of_voxel(image, mesh)
    of_part, h = {}, 1.0 + image.data.astype(float)
    for place in np.argwhere(owner >= 0):
        corners = mesh.points[mesh.cells[owner[tuple(place)]]]
        centre = image.to_world(place[None].astype(float))[0]
        hats = np.linalg.solve(np.vstack([corners.T, np.ones(n + 1)]), [*centre, 1.0])
        if np.diff(np.sort(hats)[-2:])[0] < 1e-9:  # on the border of two parts: either may have it
            of_part[owner[tuple(place)], -1] = []
        of_part.setdefault((owner[tuple(place)], int(np.argmax(hats))), []).append(h[tuple(place)])
    n_full, n_empty = 0, 0
    of_cell = cell_young(image, mesh, law, "geometric")
    for cell in range(len(mesh.cells)):
        if (cell, -1) in of_part:
            continue
        for part in range(n + 1):
            values = of_part.get((cell, part), [])
            expected = np.exp(np.log(values).mean()) if values else of_cell[cell]
            assert young[cell, part] == pytest.approx(expected, rel=1e-12)
            n_full, n_empty = n_full + bool(values), n_empty + (not values)
    assert n_full > 20
    assert n_empty > 0
    assert_array_equal(
        element_young(image, mesh, law, "gauss"),
        cell_young(image, mesh, law, "geometric"),
    )


def test_a_model_has_moduli_at_gauss_points():
    """Solved as they are; its materials, for files, have the geometric means; linear cells have
    no others.
    """
    image = noise((8, 9, 10))
    mesh = lattice_mesh(image, blocks=(2, 2, 2))
    mapping = [(0.0, 1.0), (200.0, 10.0)]
    model = build_model(mesh, image, young=mapping, average="gauss", order=2, loads="compress:1%")
    assert_array_equal(gauss_moduli(model), element_young(image, mesh, mapping, "gauss", 2))
    assert_array_equal(gauss_moduli(in_units(model, "MPa")), gauss_moduli(model) * 1e-3)
    assert_array_equal(young_of(model), cell_young(image, mesh, mapping, "geometric"))
    assert build_model(mesh, image, young=mapping, average="gauss").gauss_young is None
    one = solve(model)
    other = solve(model._replace(gauss_young=None))
    assert abs(one.strain_energy / other.strain_energy - 1.0) > 1e-4
    groups = build_model(mesh, image, young=mapping, average="gauss", order=2, bins=3)
    assert (groups.gauss_young, len(groups.materials.young)) == (None, 3)


def test_voxels_are_taken_in_parts(monkeypatch):
    """Seven at a time, as a large image's are by the million: the same moduli."""
    image = Image(np.random.default_rng(5).uniform(1.0, 9.0, (6, 5, 7)), np.eye(4))
    mesh = lattice_mesh(image, blocks=(2, 2, 2))
    whole = element_young(image, mesh, average="gauss", order=2), node_young(image, mesh)
    monkeypatch.setattr("tetopt.model.averages.VOXELS_PER_CHUNK", 7)
    parts = element_young(image, mesh, average="gauss", order=2), node_young(image, mesh)
    for one, other in zip(whole, parts, strict=True):
        assert_allclose(one, other, rtol=1e-13)
