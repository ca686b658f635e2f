"""A model in other units, another space, with quadratic cells."""

import numpy as np
import pytest
from models import sample_model
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from tetopt.geometry.quadratic import QUADRATIC_EDGES, quadratic, quadratic_facet_nodes
from tetopt.mesh import Mesh
from tetopt.model.build import build_model
from tetopt.model.loads import parse_loads
from tetopt.model.model import Model, header_lines, in_space, in_units, mass_densities
from tetopt.model.sets import Sets, facet_triples

# Units and space


def test_lps_turns_points_and_loads_about_z():
    model = sample_model()
    turned = in_space(
        model._replace(
            loads=parse_loads(["hold:left", "move:right:1,2,3"], model.mesh, model.sets)
        ),
        "lps",
    )
    assert_array_equal(turned.mesh.points, model.mesh.points * [-1, -1, 1])
    assert_array_equal(turned.mesh.cells, model.mesh.cells)
    assert turned.loads[1].numbers.tolist() == [-1.0, -2.0, 3.0]
    assert turned.space == "lps"
    assert in_space(model, "ras") is model
    assert_array_equal(in_space(turned, "ras").mesh.points, model.mesh.points)
    for wrong, match in (("las", "expected ras or lps"), ("lps", "omit `space`")):
        with refusal(match):
            in_space(sample_model(2), wrong)


def test_units():
    model = sample_model()
    other = in_units(model, "MPa")
    assert_allclose(other.materials.young, model.materials.young / 1000.0, rtol=1e-15)
    assert_array_equal(other.materials.nu, model.materials.nu)
    assert header_lines(model)[2] == "units: mm, kPa, mN, uJ, kg, s"
    assert header_lines(other)[2] == "units: mm, MPa, N, mJ, t, s"
    assert_allclose(in_units(other, "kPa").materials.young, model.materials.young, rtol=1e-15)
    with refusal("expected one of kPa, MPa, Pa, got psi"):
        in_units(model, "psi")


def test_with_pascals_lengths_are_in_metres():
    """Each quantity by the powers of its unit; and back."""
    kinds = [
        "hold:inferior",
        "move:superior:free,0,-2",
        "pressure:left:3",
        "spring:right:5",
        "gravity:0,0,-9810",
    ]
    model = build_model(sample_model().mesh, young=4.0, density=1000.0, loads=kinds)
    n_cells, n_nodes = len(model.mesh.cells), len(model.mesh.points)
    model = model._replace(
        cell_data={
            "volume": np.full(n_cells, 7.0),
            "rho": np.full(n_cells, 0.3),
            "stress_step2": np.full((n_cells, 9), 2.0),
        },
        point_data={"displacement": np.full((n_nodes, 3), 5.0)},
    )
    other = in_units(model, "Pa")
    assert header_lines(other)[1:3] == ["coordinates: RAS+, m", "units: m, Pa, N, J, kg, s"]
    assert_allclose(other.mesh.points, model.mesh.points / 1000.0, rtol=1e-15)
    assert other.materials.young.tolist() == [4000.0]
    assert mass_densities(other).tolist() == [1000.0]
    numbers = [load.numbers.tolist() for load in other.loads]
    expected = [[0.0, 0.0, 0.0], [np.nan, 0.0, -0.002], [3000.0], [5e6], [0.0, 0.0, -9.81]]
    for found, right in zip(numbers, expected, strict=True):
        assert_allclose(found, right, rtol=1e-15)
    found = {
        name: float(values.ravel()[0])
        for name, values in (other.cell_data | other.point_data).items()
    }
    assert found == pytest.approx(
        {"volume": 7e-9, "rho": 0.3, "stress_step2": 2000.0, "displacement": 0.005}, rel=1e-15
    )
    corner = Mesh([[0, 0], [2, 0], [0, 2]], [[0, 1, 2]], [[1.0, 0.0], [0.0, 1.0], [1.1, 1.1]])
    curved = in_units(Model(corner, {}, Sets({}, {}), order=2), "Pa").mesh
    assert_allclose(curved.midpoints, corner.midpoints / 1000.0, rtol=1e-15)
    back = in_units(other, "kPa")
    assert_allclose(back.mesh.points, model.mesh.points, rtol=1e-15)
    for one, two in zip(back.loads, model.loads, strict=True):
        assert_allclose(one.numbers, two.numbers, rtol=1e-15)


def test_the_head_is_of_single_lines():
    model = sample_model()._replace(
        about={"tetopt": "1", "image": "a\nb.nii", "image_sha256": "00"}
    )
    assert header_lines(model) == [
        "tetopt 1",
        "coordinates: RAS+, mm",
        "units: mm, kPa, mN, uJ, kg, s",
        "image: a b.nii, sha256 00",
        f"materials: bins, error of the modulus {model.materials.binning.mean:.3%} (mean by "
        "volume), "
        f"{model.materials.binning.largest:.3%} (largest)",
        "label 0: label_0",
        "label 1: label_1",
    ]
    assert "of the slice's plane" in header_lines(sample_model(2))[1]


# Quadratic cells


def test_quadratic_cells_have_their_nodes_in_the_middle_of_edges():
    mesh = sample_model().mesh
    points, cells = quadratic(mesh.points, mesh.cells)
    assert_array_equal(points[: len(mesh.points)], mesh.points)
    assert_array_equal(cells[:, :4], mesh.cells)
    assert_allclose(
        points[cells[:, 4:]], mesh.points[mesh.cells[:, QUADRATIC_EDGES]].mean(axis=2), rtol=1e-15
    )
    edges = {
        tuple(sorted(edge))
        for cell in mesh.cells.tolist()
        for edge in np.array(cell)[QUADRATIC_EDGES].tolist()
    }
    assert len(points) == len(mesh.points) + len(edges)  # each once
    rows = sample_model().sets.facets["boundary"]
    facets = quadratic_facet_nodes(cells, rows)
    assert_array_equal(facets[:, :3], facet_triples(mesh.cells, rows))
    for k in range(3):
        ends = points[facets[:, k]] + points[facets[:, (k + 1) % 3]]
        assert_allclose(points[facets[:, 3 + k]], ends / 2.0, rtol=1e-15)


@pytest.mark.parametrize("order", [0, 3])
def test_orders_that_there_are_not(order):
    with refusal("expected 1 or 2"):
        build_model(sample_model().mesh, order=order)


def test_bins_need_moduli():
    with refusal("no moduli to group"):
        build_model(sample_model().mesh, bins=3)


def test_a_model_of_a_mesh_alone():
    mesh = sample_model().mesh
    model = build_model(mesh)
    assert (model.materials, model.loads, model.order) == (None, (), 1)
    assert list(model.cell_data) == ["volume", "rho", "min_dihedral"]
    assert "boundary" in model.sets.facets
