"""Loads in words, and what those on facets do to nodes."""

import re
import warnings

import numpy as np
import pytest
from models import ball_mesh, sample_image, sample_model
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from scipy.spatial.transform import Rotation

import tetopt
from tetopt.fem.elasticity import box_faces, push_of
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.simplex import volumes
from tetopt.model.loads import (
    Load,
    count_of_steps,
    facet_forces,
    facet_weights,
    in_step,
    load_words,
    parse_load,
    parse_loads,
    spring_constants,
)
from tetopt.model.sets import (
    FACE_NAMES,
    area_vectors,
    box_of,
    facet_triples,
    nodes_of,
    standard_sets,
    with_requested,
)

SHEARED = np.array([[1.0, 0, 0.2, 0], [0, 1, 0.1, 0], [0.1, 0, 1, 0], [0, 0, 0, 1]])


def tilted(degrees):
    """An affine turned so far that another axis may do as well for the upright one."""
    axis = np.random.default_rng(degrees).normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    affine = np.diag([1.0, 1.5, 2.0, 1.0])
    affine[:3, :3] = turn @ affine[:3, :3]
    return affine


@pytest.mark.parametrize(
    "affine",
    [sample_image(2).affine, sample_image().affine, SHEARED, tilted(30), tilted(50), tilted(70)],
)
def test_a_compression_is_that_of_fem(affine):
    """The same nodes, and the same push along the faces' normal."""
    n = len(affine) - 1
    image = tetopt.Image(np.zeros((4, 5, 6)[:n]), affine)
    mesh = tetopt.lattice_mesh(image, blocks=(2,) * n)
    low, high = box_faces(image, mesh)
    sets = standard_sets(mesh, box_of(image))
    top, bottom = parse_loads(["compress:2.5%"], mesh, sets)
    assert [bottom.set_name, top.set_name] == list(FACE_NAMES[n][-1])
    assert_array_equal(nodes_of(mesh, sets.facets[top.set_name]), high)
    assert_array_equal(nodes_of(mesh, sets.facets[bottom.set_name]), low)
    assert not top.numbers.any()
    assert_allclose(bottom.numbers, push_of(image, 2.5), atol=1e-12)


WORDS = {  # and what they mean in 3-D
    "hold:left": ("displacement", "left", [0.0, 0.0, 0.0], 0),
    "move:right:0.5,0,-1e-1": ("displacement", "right", [0.5, 0.0, -0.1], 0),
    "2/move:right:free, 0 ,free": ("displacement", "right", [np.nan, 0.0, np.nan], 2),
    "pressure:superior:1.5": ("pressure", "superior", [1.5], 0),
    "1/pressure:superior:-2": ("pressure", "superior", [-2.0], 1),
    "traction:superior:0,0,0.25": ("traction", "superior", [0.0, 0.0, 0.25], 0),
    "spring:anterior:0.1": ("spring", "anterior", [0.1], 0),
    "12/gravity:0,0,-9810": ("gravity", "", [0.0, 0.0, -9810.0], 12),
}


def loads_of(*texts):
    model = sample_model()
    return parse_loads(texts, model.mesh, model.sets)


def plain(load):
    return load.kind, load.set_name, load.numbers.tolist(), load.step


@pytest.mark.parametrize("text", WORDS)
def test_words_and_back(text):
    load = parse_load(text, 3)
    assert repr(plain(load)) == repr(WORDS[text])  # NaN is not equal to itself
    assert repr(plain(parse_load(load_words(load), 3))) == repr(plain(load))


def test_words_in_two_dimensions():
    assert plain(parse_load("move:x_min:1,free", 2))[2][0] == 1.0
    assert plain(parse_load("gravity:0,-9810", 2)) == ("gravity", "", [0.0, -9810.0], 0)
    for text in ("gravity:0,0,-9810", "traction:x_min:1,2,3"):
        with refusal("2 finite numbers"):
            parse_load(text, 2)


def test_a_model_may_hold_without_pushing():
    (load,) = loads_of("hold:left")
    assert plain(load) == ("displacement", "left", [0.0, 0.0, 0.0], 0)
    assert len(loads_of("gravity:0,0,1")) == 1
    assert loads_of() == ()


def test_step_1_may_have_the_loads_of_all_steps_alone():
    """As weight in all, and a pressure from step 2 on."""
    loads = loads_of("hold:left", "2/pressure:right:1")
    assert count_of_steps(loads) == 2
    assert [load.kind for load in in_step(loads, 1)] == ["displacement"]
    assert [load.kind for load in in_step(loads, 2)] == ["displacement", "pressure"]


def test_components_and_steps_keep_displacements_apart():
    """The same nodes may be held along one axis by one load and along another by the next, or in
    other steps.
    """
    sliding = ["move:left:0,free,free", "move:superior:free,free,0", "move:inferior:free,0,1"]
    assert len(loads_of(*sliding)) == 3
    loads = loads_of("hold:superior", "1/move:inferior:0,0,1", "2/move:inferior:0,1,0")
    assert count_of_steps(loads) == 2
    for step, numbers in ((1, [0, 0, 1]), (2, [0, 1, 0])):
        assert in_step(loads, step)[1].numbers.tolist() == numbers
    assert count_of_steps(()) == 1


@pytest.mark.parametrize(
    ("texts", "match"),
    [
        (["squeeze:5%"], "expected compress:5%, hold:SET"),
        (["compress:5"], "expected compress:P%"),
        (["compress:51%"], "expected compress:P%"),
        (["hold:nowhere"], 'no set of facets "nowhere"; known sets are boundary, left'),
        (["hold:lft"], "did you mean left"),
        (["hold:dark"], '"dark" is a set of cells; give a set of facets, such as boundary'),
        (["hold:left", "move:right:1,2"], "3 finite numbers in mm or free"),
        (["hold:left", "move:right:1,2,inf"], "3 finite numbers"),
        (["move:right:free,free,free"], "3 finite numbers"),
        (["pressure:left:x"], "expected pressure:SET:P with 1 finite number in kPa"),
        (["traction:left:1"], "expected traction:SET:X,Y,Z with 3 finite numbers in kPa"),
        (["spring:left:0"], "stiffness above 0"),
        (["spring:left:inf"], "1 finite number in kPa/mm"),
        (["gravity:9810"], "expected gravity:X,Y,Z with 3 finite numbers in mm/s2"),
        (["pressure:interface_0_1:1"], 'of "interface_0_1" lie between two cells'),
        (["0/hold:left"], "a step of 1 or more"),
        (["first/hold:left"], "a step of 1 or more"),
        (["9" * 5000 + "/hold:left"], "a step of 1 or more"),
        (["1/hold:left", "9999/hold:left"], "in step 9999, but none in step 2"),
        (["hold:left", "3/pressure:right:1"], "in step 3, but none in step 2"),
        (
            ["hold:left", "2/move:left:0,0,1", "1/pressure:right:1"],
            "already have a prescribed displacement",
        ),
        (
            ["move:left:free,0,free", "move:posterior:1,2,free"],
            "already have a prescribed displacement",
        ),
        (["compress:5%", "hold:superior"], "already have a prescribed displacement"),
    ],
)
def test_loads_that_are_none(texts, match):
    with refusal(match):
        loads_of(*texts)


def test_an_organ_is_pressed_along_the_world_axis(n):
    """Between its own outermost nodes, though the areas of neither side sum up to exactly that
    direction.
    """
    mesh = ball_mesh(n)
    turn = np.eye(n)
    turn[-2:, -2:] = [[0.8, 0.6], [-0.6, 0.8]]
    mesh = tetopt.Mesh((mesh.points * np.linspace(1.0, 0.7, n)) @ turn, mesh.cells)
    top, bottom = parse_loads(["compress:5%"], mesh, standard_sets(mesh))
    assert [top.set_name, bottom.set_name] == list(FACE_NAMES[n][-1])[::-1]
    assert not top.numbers.any()
    assert_allclose(bottom.numbers, 0.05 * np.ptp(mesh.points, axis=0) * np.eye(n)[-1], rtol=1e-12)


def test_a_side_where_the_box_cuts_a_stem_is_told(n):
    """The body's upper side is the face of the box, its lower one that of a stem, of one of many
    blocks: too small.

    Sets of the user's may be as small as they are.
    """
    k = {2: 40, 3: 12}[n]
    image = tetopt.Image(np.zeros((2 * k,) * n))
    whole = tetopt.lattice_mesh(image, blocks=(k,) * n)
    centres = whole.points[whole.cells].mean(axis=1) + 0.5  # blocks have 2 mm
    is_kept = (centres[:, -1] > 4.0) | (np.floor(centres[:, :-1] / 2.0) == 4.0).all(axis=1)
    nodes, cells = np.unique(whole.cells[is_kept], return_inverse=True)
    mesh = tetopt.Mesh(whole.points[nodes], cells.reshape(-1, n + 1))
    known, (low, high) = standard_sets(mesh, box_of(image)), FACE_NAMES[n][-1]
    with pytest.warns(UserWarning, match=f'"{low}" has .*: {len(known.facets[low])} facet') as told:
        parse_loads(["compress:5%"], mesh, known)
    assert len(told) == 1
    percent = float(re.search("has (.*) % of the area that", str(told[0].message))[1])
    # cut cells at the stem's root show a little more
    assert percent == pytest.approx(100.0 * k ** (1.0 - n), rel=0.05)
    request = str(told[0].message).split('"')[-2]
    wider = with_requested(mesh, known, [request], None)
    assert len(wider.facets["base"]) > len(known.facets[low])
    small = with_requested(
        mesh, known, [f"tip=point:{','.join(['8.5'] * (n - 1) + ['-0.5'])}:1.5"], None
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parse_loads(
            ["move:base:" + ",".join("1" * n), f"hold:{high}", "gravity:" + ",".join("1" * n)],
            mesh,
            wider,
        )
        parse_loads(["hold:tip"], mesh, small)


def test_a_side_beside_its_counterpart_is_told(n):
    """The lowest part hangs from the body's right half, as a vertebra's process behind it: of
    area enough, but beside the upper side, which the left half has.
    """
    k = {2: 40, 3: 10}[n]
    image = tetopt.Image(np.zeros((2 * k,) * n))
    whole = tetopt.lattice_mesh(image, blocks=(k,) * n)
    across, *_, up = (whole.points[whole.cells].mean(axis=1) + 0.5).T
    is_kept = ((up > k) & (across < 1.2 * k)) | ((up < 1.4 * k) & (across > 1.2 * k))
    nodes, cells = np.unique(whole.cells[is_kept], return_inverse=True)
    mesh = tetopt.Mesh(whole.points[nodes], cells.reshape(-1, n + 1))
    known, (low, high) = standard_sets(mesh), FACE_NAMES[n][-1]
    with pytest.warns(UserWarning, match=f'"{low}" lies beside "{high}"') as told:
        parse_loads([f"hold:{high}", f"pressure:{low}:1"], mesh, known)
    words = str(told[0].message)
    assert re.search(rf"x {1.2 * k - 0.5:g} to {2 * k - 0.5:g}", words)
    wider = with_requested(mesh, known, [words.split('"')[-2]], None)
    centres = mesh.points[facet_triples(mesh.cells, wider.facets["base"])].mean(axis=1)
    assert (np.abs(centres[:, -1] - (k - 0.5)) < 2.0).mean() > 0.8
    assert centres[:, 0].max() <= 1.2 * k
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parse_loads([f"pressure:{low}:1"], mesh, known)


def test_no_side_to_press():
    """A tetrahedron has a tip and no top; the sets that it has are named."""
    mesh = tetopt.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    with refusal(r"the mesh has no facets superior; .* boundary, left, posterior, inferior"):
        parse_loads(["compress:5%"], mesh, standard_sets(mesh))


# Forces on facets


def nodes_and_cells(mesh, order):
    return (mesh.points, mesh.cells) if order == 1 else quadratic(mesh.points, mesh.cells)


def test_weights_integrate_what_cells_of_the_order_can_be(n, order):
    """Linear functions, and of order 2 quadratic ones, over a closed surface: Gauss's theorem."""
    model = sample_model(n)
    mesh, rows = model.mesh, model.sets.facets["boundary"]
    points = nodes_and_cells(mesh, order)[0]
    nodes, weights = facet_weights(mesh, rows, order)
    areas = area_vectors(mesh, rows)
    normals = areas / np.linalg.norm(areas, axis=1)[:, None]
    volume = volumes(mesh.points, mesh.cells).sum()
    # of each coordinate's unit vector
    flux = np.einsum("kw,ki,kwj->ij", weights, normals, points[nodes])
    assert_allclose(flux, volume * np.eye(n), atol=1e-10 * volume)
    if order == 2:
        centre = volumes(mesh.points, mesh.cells) @ mesh.points[mesh.cells].mean(axis=1) / volume
        squares = np.einsum("kw,ki,kwi->i", weights, normals, points[nodes] ** 2)
        assert_allclose(squares, 2.0 * volume * centre, rtol=1e-12)


def test_each_order_s_parts_of_a_facet():
    """A right triangle of area 1/2, and an edge of length 2."""
    solid = tetopt.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    bottom = np.array([[0, 3]])
    nodes, weights = facet_weights(solid, bottom, 1)
    assert (sorted(nodes[0].tolist()), weights.tolist()) == ([0, 1, 2], [[1 / 6] * 3])
    nodes, weights = facet_weights(solid, bottom, 2)
    assert_allclose(weights, [[0, 0, 0, 1 / 6, 1 / 6, 1 / 6]])
    middles = quadratic(solid.points, solid.cells)[0][nodes[0, 3:]]
    assert sorted(middles.tolist()) == [[0, 0.5, 0], [0.5, 0, 0], [0.5, 0.5, 0]]
    plate = tetopt.Mesh([[0, 0], [2, 0], [0, 1]], [[0, 1, 2]])
    nodes, weights = facet_weights(plate, np.array([[0, 2]]), 2)
    assert_allclose(weights, [[1 / 3, 1 / 3, 4 / 3]])
    assert quadratic(plate.points, plate.cells)[0][nodes[0, 2]].tolist() == [1.0, 0.0]


def test_forces_add_up_to_stress_times_area(n, order):
    model = sample_model(n)
    mesh, sets = model.mesh, model.sets
    name = "superior" if n == 3 else "y_max"
    areas = area_vectors(mesh, sets.facets[name])
    area = np.linalg.norm(areas, axis=1).sum()
    nodes, forces = facet_forces(mesh, sets, Load("pressure", name, np.array([2.0])), order)
    assert_allclose(forces.sum(axis=0), -2.0 * areas.sum(axis=0), atol=1e-9)
    pull = np.array([1.0, -2.0, 0.5])[:n]
    also, forces = facet_forces(mesh, sets, Load("traction", name, pull), order)
    assert_allclose(forces.sum(axis=0), area * pull)
    assert_array_equal(nodes, also)
    which, stiffness = spring_constants(mesh, sets, Load("spring", name, np.array([0.3])), order)
    assert_array_equal(nodes, which)
    assert stiffness.sum() == pytest.approx(0.3 * area)
    assert (stiffness > 0.0).all()
    corners = nodes_of(mesh, sets.facets[name])
    if order == 1:
        assert_array_equal(nodes, corners)
    elif n == 3:
        assert (nodes >= len(mesh.points)).all()  # corners get nothing
    # A pressure on all of the boundary pushes a body nowhere, and does not turn it.
    nodes, forces = facet_forces(mesh, sets, Load("pressure", "boundary", np.array([1.0])), order)
    assert_allclose(forces.sum(axis=0), 0.0, atol=1e-9)
    places = nodes_and_cells(mesh, order)[0][nodes] - mesh.points.mean(axis=0)
    moments = np.einsum("ki,kj->ij", places, forces)
    assert_allclose(moments, moments.T, atol=1e-7)
