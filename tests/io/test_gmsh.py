"""gmsh files: read by a parser after gmsh's manual, by meshio and by gmsh; all of the model is
there, bit by bit.
"""

import importlib.util
import json
import re
import subprocess
import sys

import meshio
import numpy as np
import pytest
from models import (
    ABOUT,
    bytes_of,
    each_once,
    labelled_model,
    quadratic_model,
    sample_image,
    sample_model,
    unlabelled,
    young_of,
)
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

import tetopt.io.gmsh
from tetopt.geometry.simplex import volumes
from tetopt.io.formats import save_model
from tetopt.io.gmsh import gmsh22, gmsh41, own_comments
from tetopt.io.meshes import load_mesh
from tetopt.model.build import build_model
from tetopt.model.loads import load_words
from tetopt.model.model import element_facets, elements, in_space, in_units
from tetopt.model.sets import FACE_NAMES, Sets, box_of, facet_triples

WRITERS = {"4.1": gmsh41, "2.2": gmsh22}
SUFFIXES = {"4.1": ".msh", "2.2": ".msh2"}
MODELS = [(3, 3), (3, None), (2, 3), (2, None)]
NODES_OF_TYPE = {1: 2, 2: 3, 4: 4, 8: 3, 9: 6, 11: 10}
DIM_OF_TYPE = {1: 1, 2: 2, 4: 3, 8: 1, 9: 2, 11: 3}
SWAPPED = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]  # gmsh's order of the middles of 10 nodes

# Reading, after the chapters "MSH file format" and "MSH file format version 2" of gmsh's manual


class Read:
    """What a file holds: points; elements by number; groups by dimension and name; views."""

    def __init__(self, raw):
        self.sections = [
            block.split("\n$End")[0].split("\n") for block in f"\n{raw.decode()}".split("\n$")[1:]
        ]
        self.sections = [lines for lines in self.sections if not lines[0].startswith("End")]
        (self.version, is_binary, size), *_ = self.section("MeshFormat")
        assert (is_binary, size) == ("0", "8")
        (self.n_names,), *names = self.section("PhysicalNames")
        assert int(self.n_names) == len(names)
        self.names = {(int(dim), int(tag)): name.strip('"') for dim, tag, name in names}
        self.elements = {}  # number -> (type, entity, nodes from 0)
        self.groups = {(dim, name): [] for (dim, _), name in self.names.items()}
        (self.read_41 if self.version == "4.1" else self.read_22)()
        self.views = {}
        for lines in self.sections:
            if lines[0] == "ElementData":
                self.read_view(lines[1:])

    def section(self, name):
        (section,) = [lines[1:] for lines in self.sections if lines[0] == name]
        return [line.split() for line in section]

    @property
    def comments(self):
        (section,) = [lines[1:] for lines in self.sections if lines[0] == "Comments"]
        return section

    def add(self, kind, number, entity, groups, nodes):
        assert number not in self.elements
        assert len(nodes) == NODES_OF_TYPE[kind]
        self.elements[number] = (kind, entity, [int(node) - 1 for node in nodes])
        for tag in groups:
            self.groups[DIM_OF_TYPE[kind], self.names[DIM_OF_TYPE[kind], tag]].append(number)

    def read_41(self):
        counts, *lines = self.section("Entities")
        self.entities = {}  # (dim, tag) -> (box, groups)
        for dim in range(4):
            for _ in range(int(counts[dim])):
                tag, *rest = lines.pop(0)
                n_groups = int(rest[6])
                groups = [int(group) for group in rest[7 : 7 + n_groups]]
                assert rest[7 + n_groups :] == ["0"]
                self.entities[dim, int(tag)] = (np.array(rest[:6], dtype=float), groups)
        assert not lines

        head, block, *lines = self.section("Nodes")
        n_points = int(head[1])
        assert head == ["1", str(n_points), "1", str(n_points)]
        assert tuple(map(int, block[:2])) in self.entities
        assert block[2:] == ["0", str(n_points)]
        assert len(lines) == 2 * n_points
        assert [int(line[0]) for line in lines[:n_points]] == list(range(1, n_points + 1))
        self.points = np.array(lines[n_points:], dtype=float)

        head, *lines = self.section("Elements")
        for _ in range(int(head[0])):
            dim, entity, kind, count = map(int, lines.pop(0))
            assert DIM_OF_TYPE[kind] == dim
            for number, *nodes in lines[:count]:
                self.add(kind, int(number), entity, self.entities[dim, entity][1], nodes)
            del lines[:count]
        assert not lines
        assert [int(x) for x in head[1:]] == [
            len(self.elements),
            min(self.elements),
            max(self.elements),
        ]

    def read_22(self):
        (count,), *lines = self.section("Nodes")
        assert [int(line[0]) for line in lines] == list(range(1, int(count) + 1))
        self.points = np.array([line[1:] for line in lines], dtype=float)
        (count,), *lines = self.section("Elements")
        assert int(count) == len(lines)
        for number, kind, n_tags, group, entity, *nodes in lines:
            assert n_tags == "2"
            self.add(int(kind), int(number), int(entity), [int(group)], nodes)

    def read_view(self, lines):
        assert [lines[0], *lines[2:7]] == ["1", "1", "0.0", "3", "0", "1"]
        assert int(lines[7]) == len(lines[8:])
        pairs = [line.split() for line in lines[8:]]
        self.views[lines[1].strip('"')] = {int(number): float(value) for number, value in pairs}

    def nodes(self, numbers):
        return np.array([self.elements[number][2] for number in numbers])

    def cells_of_set(self, name):
        """The cells that the comments say a set is made up of, by their entities."""
        return [k - 1 for k in self.elements_of_set(name, "cells")]

    def elements_of_set(self, name, what):
        lines = [re.fullmatch(rf"entity of {what} (\d+): (.*)", line) for line in self.comments]
        entities = {int(line[1]) for line in lines if line and name in line[2].split()}
        n = max(dim for dim, _ in self.groups) - (what == "facets")
        return [
            k
            for k, (kind, entity, _) in self.elements.items()
            if DIM_OF_TYPE[kind] == n and entity in entities
        ]


def cell_numbers(model):
    return list(range(1, len(model.mesh.cells) + 1))


@pytest.fixture(params=WRITERS)
def version(request):
    return request.param


@pytest.fixture
def read(version):
    """A model's file as `Read` has it, of either version."""
    return lambda model: Read(WRITERS[version](model))


# Everything, exactly


@pytest.mark.parametrize(("n", "bins"), MODELS)
def test_each_cell_without_label_is_in_the_one_group_of_its_material(read, n, bins):
    model = unlabelled(sample_model(n, bins))
    found, of_cell = read(model), model.materials.of_cell
    for k in range(len(model.materials.young)):
        assert found.names[n, k + 1] == f"material_{k + 1}"
        members = sorted(found.groups.pop((n, f"material_{k + 1}")))
        assert members == (np.flatnonzero(of_cell == k) + 1).tolist()
    assert {dim for dim, _ in found.groups} == {n - 1}


@pytest.mark.parametrize("suffix", [".msh", ".msh2", ".mesh", ".mfem"])
def test_labels_too_large_for_numbers_are_numbered_from_1_with_a_table(suffix, here):
    model, large = labelled_model(), [0, 1_073_741_823, 2**31 - 1]
    labels = np.resize(large, len(model.mesh.cells))
    model = model._replace(cell_data={"label": labels}, sets=Sets({}, {}), materials=None)
    save_model(f"a{suffix}", model)
    text = (here / f"a{suffix}").read_text()
    word = {".mesh": "reference", ".mfem": "attribute"}.get(suffix, "physical group")
    for number in (1, 2):
        assert f"{word} {number} is label {large[number]}\n" in text
    assert "label_2147483647" in text
    if suffix.startswith(".msh"):
        back = load_mesh(f"a{suffix}").cell_data["label"]
        assert_array_equal(np.sort(back), np.sort(labels))


def test_numbers_of_groups(read, n):
    """Those of cells are the labels; those of facets are free, and do not depend on the mesh."""
    model, numbers = labelled_model(n), ({}, {})
    for (dim, number), name in read(model).names.items():
        numbers[dim == n][name] = number
    assert numbers[1] == {"label_0": 8, "label_2": 2, "label_3": 3, "Right_kidney": 7}
    assert "physical groups of cells are the labels; label 0 is 8" in read(model).comments
    assert set(numbers[0]) == set(model.sets.facets)
    sides = [name for pair in FACE_NAMES[n] for name in pair]
    expected = {"boundary": 1999} | dict(zip(sides, range(1998 - len(sides), 1998), strict=True))
    expected |= {"interface_0_2": 1001, "interface_2_3": 1002, "interface_3_Right_kidney": 1003}
    assert numbers[0].items() >= expected.items()
    boundary = {"boundary": model.sets.facets["boundary"]}
    fewer = model._replace(sets=model.sets._replace(facets=boundary))
    assert (n - 1, 1999) in read(fewer).names
    labels = {"label": model.cell_data["label"] * 400}
    high = model._replace(cell_data=labels, sets=fewer.sets._replace(cells={}))
    # labels up to 2800 have the numbers below
    assert (n - 1, 19999) in read(high).names


@pytest.mark.parametrize(("n", "bins"), MODELS)
def test_facet_sets_are_groups(read, version, n, bins):
    """In 2.2 a facet is in the smallest of its sets; what a set is made up of, the comments
    tell.
    """
    model = sample_model(n, bins)
    found, smaller = read(model), set()
    for name, rows in sorted(model.sets.facets.items(), key=lambda item: len(item[1])):
        facets = set(each_once(facet_triples(model.mesh.cells, rows)))
        assert set(each_once(found.nodes(found.elements_of_set(name, "facets")))) == facets
        members = found.groups[n - 1, name]
        assert len(members) == len(facets - smaller)
        assert not members or set(each_once(found.nodes(members))) == facets - smaller
        smaller |= facets if version == "2.2" else set()


def test_41_facets_face_out_of_the_cell_of_the_first_set(n):
    model = sample_model(n)
    first = model.sets.facets["interface_0_1"]
    inner = each_once(facet_triples(model.mesh.cells, first))
    every = np.argwhere(np.ones(model.mesh.cells.shape))
    nodes = map(tuple, np.sort(facet_triples(model.mesh.cells, every)).tolist())
    both = every[[each in inner for each in nodes]]
    second = both[~(both[:, None] == first).all(axis=2).any(axis=1)]  # from the other side
    assert len(second) == len(first)
    for one, other in ((first, second), (second, first)):
        read = Read(gmsh41(model._replace(sets=Sets({"one": one, "other": other}, {}))))
        expected = sorted(facet_triples(model.mesh.cells, one).tolist())
        for name in ("one", "other"):
            assert sorted(read.nodes(read.groups[n - 1, name]).tolist()) == expected


def test_views_hold_each_column_and_the_facets_values(n):
    model = sample_model(n)
    several = np.random.default_rng(0).normal(size=(len(model.mesh.cells), 2))
    model = model._replace(cell_data={**model.cell_data, "contrast": several})
    read = Read(gmsh41(model))
    for k in (0, 1):
        view = read.views[f"contrast_{k}"]
        assert [view[number] for number in cell_numbers(model)] == several[:, k].tolist()
    for view in read.views.values():
        assert list(view) == list(read.elements)  # in their order, as meshio wants it
    of_facet = {
        tuple(sorted(nodes)): number
        for number, (_, _, nodes) in read.elements.items()
        if len(nodes) == n
    }
    # whose facets within are held by other sets before
    for name in set(model.sets.facets) - {"dark_surface"}:
        rows = model.sets.facets[name]
        values = [
            read.views["mean"][of_facet[nodes]]
            for nodes in map(tuple, np.sort(facet_triples(model.mesh.cells, rows)).tolist())
        ]
        assert values == model.cell_data["mean"][rows[:, 0]].tolist()


def test_comments_tell_image_units_constants_and_loads(read, version):
    model = in_units(sample_model(), "MPa")
    comments, table = read(model).comments, model.materials
    expected = {
        "coordinates: RAS+, mm",
        f"image: {ABOUT['image']}, sha256 {ABOUT['image_sha256']}",
        *(
            f"material_{k}: young {young!r} MPa, nu {nu!r}"
            for k, (young, nu) in enumerate(
                zip(table.young.tolist(), table.nu.tolist(), strict=True), 1
            )
        ),
    }
    assert set(comments) >= expected
    for load in model.loads:
        assert f"load (not supported by this format): {load_words(load)}" in "\n".join(comments)
    left_out = [line for line in comments if "cell data" in line]
    others = ", ".join(name for name in model.cell_data if name != "label")  # which the groups are
    assert [line.endswith(others) for line in left_out] == ([True] if version == "2.2" else [])


def test_boxes_of_entities_hold_their_elements():
    model = sample_model()
    read = Read(gmsh41(model))
    for (dim, tag), (box, _) in read.entities.items():
        numbers = [
            k for k, (kind, e, _) in read.elements.items() if (DIM_OF_TYPE[kind], e) == (dim, tag)
        ]
        corners = read.points[np.unique(read.nodes(numbers))]
        assert np.array_equal(box, [*corners.min(axis=0), *corners.max(axis=0)])


# Other models


def test_cells_of_no_set_are_unnamed(read):
    members = {"a": np.array([5]), "b": np.array([7, 9]), "c": np.array([9])}
    sets = Sets({"a": np.array([[0, 0]])}, members)
    model = unlabelled(sample_model())._replace(materials=None, sets=sets)
    found = read(model)
    assert [found.cells_of_set(name) for name in "ac"] == [[5], [9]]
    assert sorted(found.groups.pop((3, "b"))) == [8, 10]
    unnamed = sorted(found.groups.pop((3, "unnamed")))
    assert unnamed == [k for k in cell_numbers(model) if k not in (8, 10)]
    assert {dim for dim, _ in found.groups} == {2}


def test_many_materials_are_views_only(monkeypatch):
    monkeypatch.setattr(tetopt.io.gmsh, "MOST_MATERIAL_GROUPS", 3)
    model = sample_model()
    read = Read(gmsh41(model))
    assert {name for dim, name in read.groups if dim == 3} == {"label_0", "label_1"}
    young = young_of(model).tolist()
    assert [read.views["young"][number] for number in cell_numbers(model)] == young
    assert "4 materials: in the views young, kPa, and nu; not groups" in read.comments
    with refusal("at most 3 materials, as each becomes a group, got 4; group them with `bins` 32"):
        gmsh22(model)


def test_moduli_by_label_are_read_back(here):
    """Where groups are labels and materials at once; users of meshio find them as a view."""
    label = {"label": sample_model().cell_data["label"]}
    model = build_model(sample_model().mesh, young="1=10,*=2", cell_data=label)
    save_model("a.msh", model)
    back = load_mesh("a.msh").cell_data
    assert_array_equal(back["young"], np.where(back["label"] == 1, 10.0, 2.0))
    assert "young" in meshio.read("a.msh").cell_data


def test_a_set_and_cell_data_may_have_one_name(here):
    model, sets = sample_model(), sample_model().sets._replace(cells={"mean": np.array([1])})
    save_model("a.msh", model._replace(sets=sets))
    back = load_mesh("a.msh")
    (cell,) = back.sets.cells["mean"]  # of another number there, sorted by entity
    assert np.sort(back.mesh.cells[cell]).tolist() == np.sort(model.mesh.cells[1]).tolist()
    assert back.cell_data["mean"][cell] == model.cell_data["mean"][1]


# Our own reader


def test_numbers_and_names_survive_a_round_trip(version, tmp_path):
    first, second = (tmp_path / f"{name}{SUFFIXES[version]}" for name in "ab")
    save_model(first, labelled_model())
    save_model(second, build_model(load_mesh(first), box=box_of(sample_image())))
    one, other = (Read(path.read_bytes()) for path in (first, second))
    assert one.names == other.names
    for name, members in one.groups.items():
        others = other.groups[name]
        nodes = [
            sorted(map(sorted, read.nodes(k))) for read, k in ((one, members), (other, others))
        ]
        assert nodes[0] == nodes[1], name
        assert {one.elements[k][1] for k in members} == {other.elements[k][1] for k in others}


@pytest.mark.parametrize("names", ["", '$PhysicalNames\n1\n3 5 "grey matter"\n$EndPhysicalNames\n'])
def test_numbers_of_others_are_labels(names, here):
    """As SimNIBS has them, with or without names; written again they are the same."""
    _, _, text = gmsh22(labelled_model()).decode().partition("$EndPhysicalNames\n")
    text = re.sub(r"(?m)^(\d+ 4 2) 3 3 ", r"\1 5 5 ", text)
    (here / "a.msh").write_text("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n" + names + text)
    back = load_mesh("a.msh")
    assert np.unique(back.cell_data["label"]).tolist() == [2, 5, 7, 8]
    assert back.label_table.names[5] == ("grey matter" if names else "volume_5")
    save_model("b.msh2", build_model(back))
    read = Read((here / "b.msh2").read_bytes())
    expected = {k: f"volume_{k}" for k in (2, 5, 7, 8)} | ({5: "grey_matter"} if names else {})
    assert {number: name for (dim, number), name in read.names.items() if dim == 3} == expected
    for number, name in expected.items():
        assert len(read.groups[3, name]) == np.count_nonzero(back.cell_data["label"] == number)


def test_comments_that_gmsh_has_put_at_the_end(here):
    """As it does when it writes a file again; and here an entity is gone that they tell of."""
    model = sample_model()
    before, _, rest = gmsh22(in_space(model, "lps")).decode().partition("$Comments\n")
    comments, _, after = rest.partition("$EndComments\n")

    def load_with(words):
        (here / "a.msh").write_text(f"{before}{after}$Comments\n{words}$EndComments\n")
        return load_mesh("a.msh")

    comments += "entity of cells 999: dark\nentity of cells 998: gone\n"
    comments += "material_9: young 1.0 kPa, nu 0.3\n"
    back = load_with(comments)
    assert back.space == "lps"
    assert set(back.sets.cells) == set(model.sets.cells)
    assert_array_equal(back.sets.cells["dark"], model.sets.cells["dark"])
    assert_array_equal(back.cell_data["young"], young_of(model))
    # Without the constants of a material there are no moduli: what is left are the groups' names.
    back = load_with(re.sub(r"(?m)^material_1:.*\n", "", comments))
    assert "young" not in back.cell_data
    for k in (0, 1):
        members = np.flatnonzero(model.materials.of_cell == k)
        assert_array_equal(back.sets.cells[f"material_{k + 1}"], members)


def test_comments_of_others_are_not_ours():
    for lines in ([], ["made by hand", "coordinates: LPS+, mm"], ["tetopt was here"]):
        assert own_comments(lines) is None
    place = "coordinates: of the slice's plane, mm"
    read = own_comments(["tetopt", place, "image: a, b.nii, sha256 unknown"])
    assert read == ("ras", {"image": "a, b.nii"}, {}, {}, {}, None, {})


# Others' readers


# gmsh is GPL: its library is loaded by a process of its own
GMSH = """
import json, sys
import gmsh
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.logger.start()
gmsh.open(sys.argv[1])
mesh = gmsh.model.mesh
order, points, _ = mesh.getNodes()
groups, nodes, tags = {}, {}, {}
for dim, tag in gmsh.model.getPhysicalGroups():
    name = f"{dim} {gmsh.model.getPhysicalName(dim, tag)}"
    tags[name] = tag
    groups[name] = [
        (int(number), mesh.getElement(number)[1].tolist())
        for entity in gmsh.model.getEntitiesForPhysicalGroup(dim, tag)
        for number in mesh.getElements(dim, entity)[1][0]
    ]
    nodes[name] = mesh.getNodesForPhysicalGroup(dim, tag)[0].tolist()
views = {}
for view in gmsh.view.getTags():
    _, numbers, values, _, _ = gmsh.view.getModelData(view, 0)
    name = gmsh.option.getString(f"View[{gmsh.view.getIndex(view)}].Name")
    views[name] = list(zip(numbers.tolist(), [value[0] for value in values]))
dim = gmsh.model.getDimension()
determinants = []
for kind in mesh.getElementTypes(dim):
    places, _ = mesh.getIntegrationPoints(kind, "Gauss3")
    determinants += mesh.getJacobians(kind, places)[1].tolist()
said = [line for line in gmsh.logger.get() if not line.startswith("Info")]
of_entities = {each: mesh.getElements(*each)[2] for each in gmsh.model.getEntities()}
entities = {str(each): members[0].tolist() for each, members in of_entities.items() if len(members)}
found = [order.tolist(), points.tolist(), said, determinants, groups, nodes, views, tags, entities]
print(json.dumps(found))
"""


def read_by_gmsh(path, model):
    """What gmsh finds beside the nodes, after a look at these and at the size of cells anywhere
    within: it says whether their edges are where it has them.
    """
    if importlib.util.find_spec("gmsh") is None:
        pytest.skip("no gmsh (pip install gmsh)")
    child = subprocess.run(
        [sys.executable, "-c", GMSH, str(path)], capture_output=True, text=True, check=True
    )
    order, points, said, determinants, *rest = json.loads(child.stdout.splitlines()[-1])
    n, (own_points, own) = model.mesh.ndim, elements(model)
    assert said == []
    assert_array_equal(np.reshape(points, (-1, 3))[np.argsort(order)][:, :n], own_points)
    sizes = np.sort(np.reshape(determinants, (len(own), -1)) / [0, 0, 2, 6][n], axis=0)
    expected = np.sort(volumes(model.mesh.points, model.mesh.cells))
    assert_allclose(sizes, np.broadcast_to(expected[:, None], sizes.shape), rtol=1e-10)
    return rest


@pytest.mark.parametrize(("n", "bins", "order"), [(3, 3, 1), (2, None, 1), (3, 3, 2), (2, None, 2)])
def test_gmsh_reads_it(version, n, bins, order, tmp_path):
    """Cells, facets and their groups."""
    model = (sample_model if order == 1 else quadratic_model)(n, bins)
    own, path = elements(model)[1], tmp_path / "model.msh"
    path.write_bytes(bytes_of(f"a{SUFFIXES[version]}", model))
    groups, nodes, views, tags, _ = read_by_gmsh(path, model)
    smaller = set()
    for name, rows in sorted(model.sets.facets.items(), key=lambda item: len(item[1])):
        triples = [each for _, each in groups.pop(f"{n - 1} {name}", [])]
        expected = set(each_once(element_facets(own, rows))) - smaller
        assert len(triples) == len(expected)
        assert not triples or set(each_once(np.array(triples) - 1)) == expected
        of_set = {node + 1 for each in expected for node in each}
        assert sorted(nodes.get(f"{n - 1} {name}", [])) == sorted(of_set)
        smaller |= expected if version == "2.2" else set()
    swapped = SWAPPED if own.shape[1] == 10 else slice(None)
    for label, number in ((0, 2), (1, 1)):
        members = np.flatnonzero(model.cell_data["label"] == label)
        assert tags[f"{n} label_{label}"] == number
        numbers, found = zip(*sorted(groups.pop(f"{n} label_{label}")), strict=True)
        assert_array_equal(numbers, members + 1)
        assert_array_equal(np.array(found) - 1, own[members][:, swapped])
    assert groups == {}
    assert ("young" in views) == (version == "4.1")
    if version == "4.1":
        for name, values in (model.cell_data | {"young": young_of(model)}).items():
            assert [dict(views[name])[number] for number in cell_numbers(model)] == values.tolist()
