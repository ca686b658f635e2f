"""Loads in words; a model in other units, another space, with quadratic cells."""

import numpy as np
import pytest
from models import sample_image, sample_model

import tetopt
from tetopt.errors import InputError
from tetopt.fem.elasticity import box_faces, push_of
from tetopt.geometry.quadratic import QUADRATIC_EDGES, quadratic, quadratic_facet_nodes
from tetopt.model.build import model_of
from tetopt.model.loads import parse_loads
from tetopt.model.model import (
    described,
    in_space,
    in_units,
)
from tetopt.model.sets import box_of, facet_triples, nodes_of, standard_sets


@pytest.mark.parametrize("n", [2, 3])
def test_a_compression_is_that_of_fem(n):
    """The same nodes, and the same push, on an oblique box."""
    image, model = sample_image(n), sample_model(n)
    low, high = box_faces(image, model.mesh)
    top, bottom = parse_loads(["compress:5%"], model.mesh, model.sets)
    np.testing.assert_array_equal(nodes_of(model.mesh, model.sets.facets[top.set_name]), high)
    np.testing.assert_array_equal(nodes_of(model.mesh, model.sets.facets[bottom.set_name]), low)
    assert not top.displacement.any()
    np.testing.assert_allclose(bottom.displacement, push_of(image, 5.0), atol=1e-12)


def test_a_sheared_box_is_pressed_along_its_faces_normal():
    affine = np.array([[1.0, 0, 0.2, 0], [0, 1, 0.1, 0], [0.1, 0, 1, 0], [0, 0, 0, 1]])
    image = tetopt.Image(np.zeros((4, 4, 4)), affine)
    mesh = tetopt.lattice(image, blocks=(1, 1, 1))
    (_, moved) = parse_loads(["compress:2.5%"], mesh, standard_sets(mesh, box_of(image)))
    np.testing.assert_allclose(moved.displacement, push_of(image, 2.5), atol=1e-12)


def test_held_and_moved_sets():
    model = sample_model(3)
    loads = parse_loads(["hold:left", "move:right:0.5,0,-1e-1"], model.mesh, model.sets)
    assert [(load.set_name, load.displacement.tolist()) for load in loads] == [
        ("left", [0.0, 0.0, 0.0]),
        ("right", [0.5, 0.0, -0.1]),
    ]
    assert parse_loads([], model.mesh, model.sets) == ()


@pytest.mark.parametrize(
    ("texts", "match"),
    [
        (["squeeze:5%"], "expected compress:5%, hold:SET"),
        (["compress:5"], "expected compress:P%"),
        (["compress:0%"], "expected compress:P%"),
        (["compress:51%"], "expected compress:P%"),
        (["compress:x%"], "expected compress:P%"),
        (["compress:nan%"], "expected compress:P%"),
        (["hold:nowhere"], 'no set of facets "nowhere"; there are boundary, left'),
        (["hold:Left"], "did you mean left"),
        (["hold:dark"], '"dark" is a set of cells; give one of facets, such as boundary'),
        (["move:left:0,0,1"], 'nothing but "left" is loaded'),
        (["hold:left"], "nothing moves"),
        (["hold:left", "move:right:1,2"], "3 numbers"),
        (["hold:left", "move:right"], "3 numbers"),
        (["hold:left", "move:right:1,2,inf"], "3 numbers"),
        (["hold:left", "move:superior:0,0,1"], "cannot go both ways"),
        (["compress:5%", "hold:superior"], "cannot go both ways"),
    ],
)
def test_loads_that_are_none(texts, match):
    model = sample_model(3)
    with pytest.raises(InputError, match=match) as caught:
        parse_loads(texts, model.mesh, model.sets)
    assert "\n" not in str(caught.value)


def test_no_face_to_press():
    image = sample_image(3)
    mesh = sample_model(3).mesh
    is_inner = (np.abs(image.to_index(mesh.points)[mesh.cells][:, :, 2] - 3.0) < 3.0).all(axis=1)
    used, cells = np.unique(mesh.cells[is_inner], return_inverse=True)
    part = tetopt.Mesh(mesh.points[used], cells.reshape(-1, 4))
    with pytest.raises(InputError, match="no facets on the box's face inferior and superior; give hold:SET"):
        parse_loads(["compress:5%"], part, standard_sets(part, box_of(image)))


# Units and space


def test_lps_turns_points_and_loads_about_z():
    model = sample_model(3)
    turned = in_space(
        model._replace(loads=parse_loads(["hold:left", "move:right:1,2,3"], model.mesh, model.sets)), "lps"
    )
    np.testing.assert_array_equal(turned.mesh.points, model.mesh.points * [-1, -1, 1])
    np.testing.assert_array_equal(turned.mesh.cells, model.mesh.cells)
    assert turned.loads[1].displacement.tolist() == [-1.0, -2.0, 3.0]
    assert turned.space == "lps"
    assert in_space(model, "ras") is model
    np.testing.assert_array_equal(in_space(turned, "ras").mesh.points, model.mesh.points)
    for wrong, match in (("las", "expected ras or lps"), ("lps", "leave out --space")):
        with pytest.raises(InputError, match=match):
            in_space(sample_model(2), wrong)


def test_units():
    model = sample_model(3)
    other = in_units(model, "MPa")
    np.testing.assert_allclose(other.materials.young, model.materials.young / 1000.0, rtol=1e-15)
    np.testing.assert_array_equal(other.materials.nu, model.materials.nu)
    assert described(model)[2] == "units: mm, kPa, mN, uJ, kg, s"
    assert described(other)[2] == "units: mm, MPa, N, mJ, t, s"
    np.testing.assert_allclose(in_units(other, "kPa").materials.young, model.materials.young, rtol=1e-15)
    with pytest.raises(InputError, match="expected kPa or MPa"):
        in_units(model, "Pa")


def test_the_head_is_of_single_lines():
    model = sample_model(3)._replace(about={"tetopt": "1", "image": "a\nb.nii", "image_sha256": "00"})
    assert described(model) == [
        "tetopt 1",
        "coordinates: RAS+, mm",
        "units: mm, kPa, mN, uJ, kg, s",
        "image: a b.nii, sha256 00",
        f"materials: bins, modulus off by {model.materials.binning.mean:.3%} in the mean by volume, "
        f"{model.materials.binning.largest:.3%} at most",
    ]
    assert "of the slice's plane" in described(sample_model(2))[1]


# Quadratic cells


def test_quadratic_cells_have_their_nodes_in_the_middle_of_edges():
    mesh = sample_model(3).mesh
    points, cells = quadratic(mesh.points, mesh.cells)
    np.testing.assert_array_equal(points[: len(mesh.points)], mesh.points)
    np.testing.assert_array_equal(cells[:, :4], mesh.cells)
    np.testing.assert_allclose(
        points[cells[:, 4:]], mesh.points[mesh.cells[:, QUADRATIC_EDGES]].mean(axis=2), rtol=1e-15
    )
    edges = {tuple(sorted(edge)) for cell in mesh.cells.tolist() for edge in np.array(cell)[QUADRATIC_EDGES].tolist()}
    assert len(points) == len(mesh.points) + len(edges)  # each once
    rows = sample_model(3).sets.facets["boundary"]
    facets = quadratic_facet_nodes(cells, rows)
    np.testing.assert_array_equal(facets[:, :3], facet_triples(mesh.cells, rows))
    for k in range(3):
        ends = points[facets[:, k]] + points[facets[:, (k + 1) % 3]]
        np.testing.assert_allclose(points[facets[:, 3 + k]], ends / 2.0, rtol=1e-15)


@pytest.mark.parametrize(("n", "order", "match"), [(3, 3, "expected 1 or 2"), (2, 2, "tetrahedra here")])
def test_orders_that_there_are_not(n, order, match):
    with pytest.raises(InputError, match=match):
        model_of(sample_model(n).mesh, order=order)


def test_bins_need_moduli():
    with pytest.raises(InputError, match="no moduli to group"):
        model_of(sample_model(3).mesh, bins=3)


def test_a_model_of_a_mesh_alone():
    mesh = sample_model(3).mesh
    model = model_of(mesh)
    assert (model.materials, model.loads, model.order) == (None, (), 1)
    assert list(model.cell_data) == ["volume", "rho", "min_dihedral"]
    assert "boundary" in model.sets.facets
