"""Named sets: the box's faces by their anatomical names, interfaces, what is asked for in words."""

from itertools import permutations

import numpy as np
import pytest
from models import ball_mesh, sample_image, sample_model
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

import tetopt
from tetopt.geometry.box import world_axes
from tetopt.geometry.simplex import volumes
from tetopt.model.file import sets_beside
from tetopt.model.sets import (
    FACE_NAMES,
    Box,
    Sets,
    area_vectors,
    boundary_rows,
    box_of,
    enclosing_facets,
    facet_triples,
    merged_sets,
    nodes_of,
    rows_of,
    standard_sets,
    surviving_sets,
    with_requested,
)
from tetopt.start.carve import part_of

NAMES = (("left", "right"), ("posterior", "anterior"), ("inferior", "superior"))


def outward_areas(mesh, rows):
    """Area vectors of facets, from their nodes as listed."""
    a, b, c = np.moveaxis(mesh.points[facet_triples(mesh.cells, rows)], 1, 0)
    return np.cross(b - a, c - a) / 2.0


def test_facets_face_out_of_their_cell():
    for n in (2, 3):
        mesh = sample_model(n).mesh
        every = np.argwhere(np.ones(mesh.cells.shape, dtype=bool))
        nodes = facet_triples(mesh.cells, every)
        opposite = mesh.cells[every[:, 0], every[:, 1]]
        assert (
            np.sort(np.column_stack([nodes, opposite])) == np.sort(mesh.cells[every[:, 0]])
        ).all()
        inward = mesh.points[opposite] - mesh.points[nodes[:, 0]]
        assert ((inward * area_vectors(mesh, every)).sum(axis=1) < 0.0).all()
        if n == 3:
            assert_allclose(outward_areas(mesh, every), area_vectors(mesh, every), atol=1e-9)


@pytest.mark.parametrize("order", list(permutations(range(3))))
@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, -1)])
def test_faces_are_named_by_the_world(order, signs):
    """Whatever index axis runs from left to right, and which way: "left" is where x is smallest."""
    affine = np.eye(4)
    affine[:3, :3] = 0.0
    for axis, (world, sign) in enumerate(zip(order, signs, strict=True)):
        affine[world, axis] = 2.0 * sign
    affine[:3, 3] = (10.0, -20.0, 30.0)
    image = tetopt.Image(np.zeros((3, 4, 5)), affine)
    mesh = tetopt.lattice_mesh(image, blocks=(2, 2, 2))
    sets = standard_sets(mesh, box_of(image)).facets
    assert world_axes(affine) == order
    for axis, (low, high) in enumerate(NAMES):
        assert (mesh.points[nodes_of(mesh, sets[low])][:, axis] == mesh.points[:, axis].min()).all()
        assert (
            mesh.points[nodes_of(mesh, sets[high])][:, axis] == mesh.points[:, axis].max()
        ).all()
        size = np.ptp(mesh.points, axis=0)
        for name, sign in ((low, -1.0), (high, 1.0)):
            area = np.zeros(3)
            area[axis] = sign * np.prod(size) / size[axis]
            assert_allclose(outward_areas(mesh, sets[name]).sum(axis=0), area, atol=1e-9)
    assert len(sets["boundary"]) == sum(len(sets[name]) for pair in NAMES for name in pair)
    assert "mask_surface" not in sets
    assert [name for name in standard_sets(mesh).facets] == [
        "boundary",
        *(name for pair in NAMES for name in pair),
    ]


def test_an_oblique_box_is_known_by_its_affine_alone():
    image, mesh = sample_image(), sample_model().mesh
    with_box = standard_sets(mesh, box_of(image)).facets
    assert sum(len(with_box[name]) for pair in NAMES for name in pair) == len(with_box["boundary"])
    # turned about z, so that only those two faces lie in planes of the world
    without = standard_sets(mesh).facets
    for name in ("inferior", "superior"):
        assert_array_equal(without[name], with_box[name])
    # what is outermost along the world's axes
    for name in ("left", "right", "posterior", "anterior"):
        assert 0 < len(without[name]) < len(with_box[name])


def test_the_surface_of_a_mask_is_the_boundary_off_the_box():
    image = tetopt.Image(np.zeros((4, 4, 4)))
    mesh = tetopt.lattice_mesh(image, blocks=(2, 2, 2))
    lower = part_of(mesh, mesh.points[mesh.cells].mean(axis=1)[:, 2] < 1.5)
    sets = standard_sets(lower, box_of(image)).facets
    assert (lower.points[nodes_of(lower, sets["mask_surface"])][:, 2] > -0.5).all()
    assert_allclose(outward_areas(lower, sets["inferior"]).sum(axis=0), [0.0, 0.0, -16.0])
    assert len(sets["boundary"]) == sum(
        len(rows) for name, rows in sets.items() if name != "boundary"
    )


def test_a_ball_within_the_box_has_sides_by_its_own_extent(n):
    """Caps a tenth of it deep, each a tenth of a ball's surface, which face their side; no facet
    is on two.
    """
    mesh = ball_mesh(n)
    box = Box((60,) * n, np.eye(n + 1))
    sets = standard_sets(mesh, box).facets
    assert_array_equal(sets.pop("mask_surface"), sets["boundary"])
    assert {name: rows.tolist() for name, rows in sets.items()} == {
        name: rows.tolist() for name, rows in standard_sets(mesh).facets.items()
    }
    centre, size = 30.0, np.sqrt((area_vectors(mesh, sets.pop("boundary")) ** 2).sum(axis=1)).sum()
    assert list(sets) == [name for pair in FACE_NAMES[n] for name in pair]
    for axis, pair in enumerate(FACE_NAMES[n]):
        for name, sign in zip(pair, (-1.0, 1.0), strict=True):
            areas = area_vectors(mesh, sets[name])
            assert (sign * areas[:, axis] >= np.abs(areas).max(axis=1)).all()
            fraction = np.sqrt((areas**2).sum(axis=1)).sum() / size
            # by whole facets
            assert fraction == pytest.approx(0.1 if n == 3 else np.arccos(0.8) / np.pi, rel=0.35)
            assert (
                sign * (mesh.points[nodes_of(mesh, sets[name])][:, axis] - centre) > 0.6 * 20.0
            ).all()
    rows = np.concatenate(list(sets.values()))
    assert len(np.unique(rows, axis=0)) == len(rows)


def test_sides_by_extent_make_way_for_sets_of_the_mesh():
    """A set "superior" that came with an organ keeps its name, and its members."""
    mesh = ball_mesh()
    own = Sets({"superior": boundary_rows(mesh)[:5]}, {})
    sets, renamed = sets_beside(mesh, None, {}, own, {})
    assert renamed == {}
    assert_array_equal(sets.facets["superior"], own.facets["superior"])


def test_interfaces_are_held_by_the_smaller_label():
    for n in (2, 3):
        model = sample_model(n)
        labels = model.cell_data["label"]
        rows = model.sets.facets["interface_0_1"]
        assert (labels[rows[:, 0]] == 0).all()
        nodes = np.sort(facet_triples(model.mesh.cells, rows), axis=1).tolist()
        zero, one = (
            {
                tuple(sorted(set(cell) - {cell[k]}))
                for cell in model.mesh.cells[labels == label].tolist()
                for k in range(n + 1)
            }
            for label in (0, 1)
        )
        assert {tuple(row) for row in nodes} == zero & one
        assert len(nodes) == len(zero & one)
        for label in (0, 1):
            assert_array_equal(model.sets.cells[f"label_{label}"], np.flatnonzero(labels == label))


def test_three_labels_have_an_interface_for_each_pair_that_touches():
    mesh = tetopt.lattice_mesh(tetopt.Image(np.zeros((6, 4))), blocks=(3, 1))
    labels = np.floor((mesh.points[mesh.cells].mean(axis=1)[:, 0] + 0.5) / 2.0).astype(int) * 5
    sets = standard_sets(mesh, labels=labels)
    assert [name for name in sets.facets if "interface" in name] == [
        "interface_0_5",
        "interface_5_10",
    ]
    assert list(sets.cells) == ["label_0", "label_5", "label_10"]


@pytest.mark.parametrize("labels", [[0.5] * 192, [-1] * 192, [1] * 191])
def test_labels_that_are_none(labels):
    with refusal("labels: expected"):
        standard_sets(sample_model().mesh, labels=np.array(labels))


# Asked for in words


def requested(text, n=3, mean=None):
    model = sample_model(n)
    base = standard_sets(model.mesh)
    return model.mesh, with_requested(
        model.mesh, base, [text], model.cell_data["mean"] if mean is None else mean
    )


def test_below_is_the_largest_connected_part_and_its_surface():
    mesh, sets = requested("dark=below:12")
    mean = sample_model().cell_data["mean"]
    chosen = tetopt.geometry.topology.largest_component(mesh.cells, mean < 12)
    assert_array_equal(sets.cells["dark"], chosen)
    rows = sets.facets["dark_surface"]
    assert set(rows[:, 0]) <= set(chosen.tolist())
    assert_allclose(outward_areas(mesh, rows).sum(axis=0), 0.0, atol=1e-9)  # closed
    centres = mesh.points[facet_triples(mesh.cells, rows)].mean(axis=1)
    enclosed = (centres * outward_areas(mesh, rows)).sum() / 3.0
    assert_allclose(enclosed, volumes(mesh.points, mesh.cells[chosen]).sum())
    assert_array_equal(rows, enclosing_facets(mesh, chosen))


def test_near_a_point_and_a_plane():
    model = sample_model()
    mesh, points = model.mesh, model.mesh.points
    every = boundary_rows(mesh)
    here = points[0]
    text = ",".join(map(str, here.tolist()))
    for words, distance in (
        (f"p=point:{text}:12", np.linalg.norm(points - here, axis=1)),
        (f"p=plane:{text}:0,0,-2:1.5", np.abs(points[:, 2] - here[2])),
    ):
        _, sets = requested(words)
        reach = float(words.rpartition(":")[2])
        expected = every[(distance[facet_triples(mesh.cells, every)] <= reach).all(axis=1)]
        assert 0 < len(expected) < len(every)
        assert_array_equal(sets.facets["p"], expected)
        assert "p" not in sets.cells


@pytest.mark.parametrize("n", [2, 3])
def test_in_a_direction_and_within_a_box(n):
    mesh = ball_mesh(n)
    every = boundary_rows(mesh)
    nodes = facet_triples(mesh.cells, every)
    areas = area_vectors(mesh, every)
    down = -areas[:, -1] / np.linalg.norm(areas, axis=1) >= np.cos(np.radians(50.0))
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    high[0] = mesh.points[:, 0].mean()
    is_left = (mesh.points <= high).all(axis=1)[nodes].all(axis=1)
    direction, *corners = (
        ",".join(map(repr, each.tolist())) for each in (-3.0 * np.eye(n)[-1], high, low)
    )
    texts = [f"d=facing:{direction}:50", f"b=box:{corners[0]}:{corners[1]}"]
    texts += [f"both={texts[0][2:]} & {texts[1][2:]}", f"same={texts[1][2:]} & d"]
    texts += ["rest=d-both & boundary"]
    known = with_requested(mesh, standard_sets(mesh), texts, None).facets
    for name, expected in {
        "d": down,
        "b": is_left,
        "both": down & is_left,
        "same": down & is_left,
        "rest": down & ~is_left,
    }.items():
        assert 0 < expected.sum() < len(every)
        assert_array_equal(known[name], every[expected])


def test_a_part_of_an_interface():
    model = sample_model()
    mesh = model.mesh
    labels = (mesh.points[mesh.cells].mean(axis=1)[:, 0] > mesh.points[:, 0].mean()).astype(int)
    known = standard_sets(mesh, labels=labels)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    low[1] = mesh.points[:, 1].mean()
    box = ":".join(",".join(map(repr, each.tolist())) for each in (low, high))
    part = with_requested(mesh, known, [f"a=interface_0_1 & box:{box}"], None).facets["a"]
    rows = known.facets["interface_0_1"]
    assert 0 < len(part) < len(rows)
    assert {*map(tuple, part.tolist())} <= {*map(tuple, rows.tolist())}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("p=facing:0,0,0:30", "expected a normal other than 0"),
        ("p=facing:0,0,1:-3", "an angle of 0 or more"),
        ("p=box:0,0,0:1,1", "expected 3 numbers"),
        ("p=left & below:3", "beside &"),
        ("p=left & right", "no facet in common"),
        ("p=left & ", "NAME=A & B"),
        ("dark", "expected NAME=below:T"),
        ("dark=below:x", "expected 1 number"),
        ("dark=below:-5", "no cell has a mean below -5"),
        ("1a=below:12", "set: expected a name of up to 72 letters, .*, the first a letter"),
        ("LEFT=point:0,0,0:1", r'a set "left" already exists|no boundary facet'),
        ("Boundary=below:12", 'a set "boundary" already exists'),
        ("p=point:0,0:1", "expected 3 numbers"),
        ("p=point:0,0,0", "expected point:X,Y,Z:D"),
        ("p=plane:0,0,0:1", "expected plane:X,Y,Z:NX,NY,NZ:D"),
        ("p=plane:0,0,0:0,0,0:1", "expected a normal other than 0"),
        ("p=point:0,0,0:0.1", "the nearest one lies within"),
    ],
)
def test_words_that_are_refused(text, match):
    with refusal(match):
        requested(text)


def test_a_surface_takes_its_name_too():
    model = sample_model()
    with refusal('"dark_surface" already exists'):
        with_requested(
            model.mesh,
            Sets({"dark_surface": boundary_rows(model.mesh)}, {}),
            ["dark=below:12"],
            model.cell_data["mean"],
        )


def test_below_needs_means():
    mesh = sample_model().mesh
    with refusal("has no cell means"):
        with_requested(mesh, Sets({}, {}), ["dark=below:12"], None)


# Sets of other meshes


def test_rows_of_nodes_in_any_order():
    mesh = sample_model().mesh
    rows = boundary_rows(mesh)
    nodes = facet_triples(mesh.cells, rows)[:, [2, 0, 1]]
    assert_array_equal(rows_of(mesh, nodes[::-1]), rows)
    assert len(rows_of(mesh, np.array([[0, 0, 1], [-1, 2, 3]]))) == 0


def test_sets_on_the_boundary_are_carried_to_an_improved_mesh():
    model = sample_model()
    image = sample_image()
    after = tetopt.optimize(image, model.mesh, boundary="fixed", iterations=3).mesh
    assert (after.points != model.mesh.points).any()
    sets = Sets(
        {"skin": boundary_rows(model.mesh), "inner": model.sets.facets["interface_0_1"]},
        {"all": np.arange(9)},
    )
    survivors = surviving_sets(model.mesh, sets, after).facets
    assert "inner" not in survivors
    assert surviving_sets(model.mesh, sets, after).cells == {}
    places = [
        {
            frozenset(map(tuple, corners))
            for corners in mesh.points[facet_triples(mesh.cells, rows)].tolist()
        }
        for mesh, rows in ((model.mesh, sets.facets["skin"]), (after, survivors["skin"]))
    ]
    assert places[0] == places[1]


def test_sets_of_a_mesh_join_the_standard_ones():
    mesh = sample_model().mesh
    standard = standard_sets(mesh, box_of(sample_image()))
    some = standard.facets["left"][:3]
    own = Sets(
        {"left": some, "right": standard.facets["right"], "skin": some}, {"Boundary": np.arange(4)}
    )
    merged, renamed = merged_sets(standard, own)
    assert renamed == {"left": "left_2", "Boundary": "Boundary_2"}
    assert set(merged.facets) == {*standard.facets, "left_2", "skin"}
    assert_array_equal(merged.facets["left"], standard.facets["left"])
    assert_array_equal(merged.facets["left_2"], some)
    assert_array_equal(merged.cells["Boundary_2"], np.arange(4))
    assert "left_2" not in standard.facets  # which are left as they were
