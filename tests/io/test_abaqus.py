"""Abaqus input files: read back by meshio, and by a parser of the manual's rules where meshio
skips.
"""

import io
import re
from collections import Counter

import meshio
import numpy as np
import pytest
from models import loaded_model, sample_model
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from tetopt import Mesh
from tetopt.geometry.quadratic import quadratic
from tetopt.io.abaqus import abaqus
from tetopt.model.loads import Load, facet_forces, spring_constants
from tetopt.model.materials import materials
from tetopt.model.model import Model, element_facets, elements, in_space, in_units
from tetopt.model.sets import Sets

# The manual's "Element node ordering" and "Element faces" of tetrahedra.
MIDPOINTS = [(1, 2), (2, 3), (3, 1), (1, 4), (2, 4), (3, 4)]  # nodes 5 to 10 of C3D10
FACES = {"S1": (1, 2, 3), "S2": (1, 4, 2), "S3": (2, 4, 3), "S4": (3, 4, 1)}

VARIANTS = {
    "bins": sample_model(),
    "a material a cell": sample_model(bins=None),
    "LPS": in_space(sample_model(), "lps"),
    "MPa": in_units(sample_model(), "MPa"),
    "quadratic": sample_model()._replace(order=2),
}


@pytest.fixture(params=VARIANTS)
def model(request):
    return VARIANTS[request.param]


def read_by_meshio(raw):
    return meshio.abaqus._abaqus.read_buffer(io.StringIO(raw.decode()))


def blocks_of(raw):
    """(keyword, parameters, data lines split at commas) of each keyword, by the manual's syntax
    rules.
    """
    blocks = []
    for line in raw.decode().splitlines():
        if line.startswith("**"):
            continue
        words = [word.strip() for word in line.split(",")]
        if line.startswith("*"):
            parameters = dict((part.strip() for part in word.split("=")) for word in words[1:])
            blocks.append((words[0], parameters, []))
        else:
            blocks[-1][2].append(words)
    return blocks


def named(raw, keyword):
    """Data lines of each block of a keyword, by the value of its first parameter."""
    return {
        next(iter(parameters.values())): data
        for word, parameters, data in blocks_of(raw)
        if word == keyword
    }


def test_meshio_reads_node_sets_back(model):
    file, cells = read_by_meshio(abaqus(model)), elements(model)[1]
    assert list(file.point_sets) == list(model.sets.facets)
    for name, rows in model.sets.facets.items():
        nodes = np.sort(file.point_sets[name])
        assert_array_equal(nodes, np.unique(element_facets(cells, rows)))
    assert_array_equal(file.cell_sets["all_cells"][0], np.arange(len(model.mesh.cells)))


def test_the_step_holds_and_moves_all_three_components():
    model = sample_model()
    moved = model._replace(
        loads=(
            Load("displacement", "superior", np.zeros(3)),
            Load("displacement", "inferior", np.array([0.5, -0.25, 1.0])),
        )
    )
    words = blocks_of(abaqus(moved))
    order = [word for word, _, _ in words]
    assert order[order.index("*STEP") :] == [
        *(
            "*STEP",
            "*STATIC",
            "*BOUNDARY",
            "*NODE FILE",
            "*EL FILE",
            "*EL PRINT",
            "*NODE PRINT",
            "*NODE PRINT",
        ),
        "*END STEP",
    ]
    (conditions,) = (data for word, _, data in words if word == "*BOUNDARY")
    expected = [["superior", d, d, "0.0"] for d in "123"]
    expected += [
        ["inferior", d, d, value] for d, value in zip("123", ("0.5", "-0.25", "1.0"), strict=True)
    ]
    assert conditions == expected
    assert [parameters["NSET"] for word, parameters, _ in words if word == "*NODE PRINT"] == [
        "superior",
        "inferior",
    ]


def test_without_loads_no_step_and_without_materials_no_sections():
    model = sample_model()._replace(loads=())
    words = {word for word, _, _ in blocks_of(abaqus(model))}
    mesh_only = {"*HEADING", "*NODE", "*NSET", "*ELEMENT", "*ELSET", "*SURFACE"}
    assert words == {*mesh_only, "*MATERIAL", "*ELASTIC", "*SOLID SECTION"}
    assert {word for word, _, _ in blocks_of(abaqus(model._replace(materials=None)))} == mesh_only


def test_head_states_coordinates_units_and_image():
    name = f"Kopf\n*STEP ü & <more> {'x' * 300}.nii"
    model = in_units(in_space(sample_model(), "lps"), "MPa")
    lines = abaqus(model._replace(about={**model.about, "image": name})).decode().splitlines()
    start = lines.index("*HEADING")
    assert all(line.startswith("** ") and len(line) <= 256 for line in lines[:start])
    head = "".join(line[2:] for line in lines[:start])
    for text in (
        "LPS+, mm",
        "mm, MPa, N, mJ, t, s",
        "Kopf *STEP ü & <more>",
        "ab" * 32,
        ", ".join(model.cell_data),
    ):
        assert text.replace(" ", "") in head.replace(" ", "")
    assert lines[start + 1] == "tetopt 0.1.0; coordinates: LPS+, mm; units: mm, MPa, N, mJ, t, s"
    assert [line for line in lines[start:] if line.startswith("*STEP")] == ["*STEP"]


def test_lines_keep_to_the_manual_s_limits(model):
    """256 characters a line, 16 entries, names of up to 80, told apart whatever their case;
    ASCII beside comments.
    """
    raw = abaqus(model)
    assert raw.endswith(b"\n")
    assert max(map(len, raw.splitlines())) <= 256
    names = Counter()
    for word, parameters, data in blocks_of(raw):
        assert re.fullmatch(r"\*[A-Z ]+", word)
        assert all(len(line) <= 16 for line in data)
        if word == "*HEADING":
            continue
        names.update(
            (word, key, value.lower())
            for key, value in parameters.items()
            if key in ("NSET", "ELSET", "NAME")
        )
        assert all(re.fullmatch(r"[A-Za-z0-9_.+-]{1,80}", text) for line in data for text in line)
        numbers = [text for line in data for text in line if re.match(r"[-0-9]", text)]
        assert max(map(len, numbers), default=0) <= 20
    assert max(names.values()) == 1


AWKWARD = [
    -1.2345678901234567e-05,
    -1.23456789012345e-05,
    -0.012345678901234567,
    -1.2345678901234567e-101,
    -1.5e17 / 7,
]


@pytest.mark.parametrize("value", AWKWARD)
def test_numbers_of_more_than_twenty_characters_are_rounded_to_fit(value):
    """Wherever they stand; CalculiX would stop or, worse, lose the last digit of an exponent."""
    size = abs(value)
    mesh = Mesh(np.array([[value, 0, 0], [size, 0, 0], [0, size, 0], [0, 0, size]]), [[0, 1, 2, 3]])
    side = np.array([[0, 3]])
    loads = (Load("displacement", "side", np.full(3, value)),)
    model = Model(
        mesh, {}, Sets({"side": side}, {}), materials(-11.0 * value, 1.0 / 30.0, 1), loads
    )
    raw = abaqus(model)
    written = {
        text
        for word, _, data in blocks_of(raw)
        if word != "*HEADING"
        for line in data
        for text in line
    }
    assert max(map(len, written)) <= 20
    assert_allclose(read_by_meshio(raw).points, mesh.points, rtol=5e-13, atol=0.0)
    ((young, nu),) = next(data for word, _, data in blocks_of(raw) if word == "*ELASTIC")
    assert_allclose([float(young), float(nu)], [-11.0 * value, 1.0 / 30.0], rtol=5e-13)
    (conditions,) = (data for word, _, data in blocks_of(raw) if word == "*BOUNDARY")
    assert_allclose([float(line[3]) for line in conditions], value, rtol=5e-13)


def test_what_the_format_cannot_carry_is_refused():
    with refusal("expected a tetrahedral mesh, got triangles"):
        abaqus(sample_model(2))
    with refusal("loads need materials"):
        abaqus(sample_model()._replace(materials=None))


def test_each_load_has_its_card_and_steps_begin_anew():
    words = [
        "hold:superior",
        "1/pressure:inferior:0.5",
        "1/gravity:0,0,-9810",
        "2/traction:inferior:0,0,2",
    ]
    model = loaded_model([*words, "spring:left:3"])
    blocks = blocks_of(abaqus(model))
    steps = [k for k, (word, _, _) in enumerate(blocks) if word == "*STEP"]
    first, second = blocks[steps[0] : steps[1]], blocks[steps[1] :]
    for step in (first, second):
        anew = [word for word, parameters, _ in step if parameters == {"OP": "NEW"}]
        assert anew == ["*BOUNDARY", "*CLOAD", "*DLOAD"]
    data = [{word: lines for word, _, lines in step} for step in (first, second)]
    assert not data[0]["*CLOAD"]
    assert not data[1]["*DLOAD"]
    weight, *faces = data[0]["*DLOAD"]
    rows = model.sets.facets["inferior"]
    assert [int(line[0]) - 1 for line in faces] == rows[:, 0].tolist()
    assert {line[2] for line in faces} == {"0.5"}
    assert weight == ["all_cells", "GRAV", "9810.0", "0.0", "0.0", "-1.0"]
    nodes, forces = facet_forces(model.mesh, model.sets, model.loads[3])
    assert [(int(node) - 1, dof, float(force)) for node, dof, force in data[1]["*CLOAD"]] == [
        (node, "3", force)
        for node, force in zip(nodes.tolist(), forces[:, 2].tolist(), strict=True)
    ]
    springs = [lines for word, _, lines in blocks if word == "*SPRING"]
    nodes, stiffness = spring_constants(model.mesh, model.sets, model.loads[4])
    assert [line[0][0] for line in springs] == ["1", "2", "3"] * len(nodes)
    assert [float(line[1][0]) for line in springs] == np.repeat(stiffness, 3).tolist()
    numbers = [
        int(lines[0][0]) for _, parameters, lines in blocks if parameters.get("TYPE") == "SPRING1"
    ]
    assert numbers == list(
        range(len(model.mesh.cells) + 1, len(model.mesh.cells) + 1 + 3 * len(nodes))
    )
    assert {lines[0][0] for word, _, lines in blocks if word == "*DENSITY"} == {"1e-06", "1.5e-06"}


def test_forces_on_one_node_add_up():
    """Those of two sets that share an edge."""
    model = loaded_model(["hold:superior", "traction:inferior:0,0,2", "traction:left:0,0,3"])
    (card,) = (lines for word, _, lines in blocks_of(abaqus(model)) if word == "*CLOAD")
    total = sum(
        facet_forces(model.mesh, model.sets, load)[1][:, 2].sum() for load in model.loads[1:]
    )
    assert sum(float(force) for _, _, force in card) == pytest.approx(total, rel=1e-12)
    assert len({node for node, _, _ in card}) == len(card)


def test_a_nonlinear_law_is_the_linear_one_at_small_strains():
    """By the manual: shear modulus 2 C10, bulk modulus 2 / D1."""
    model = loaded_model(["compress:5%"])._replace(is_nonlinear=True)
    found = re.findall(r"\*HYPERELASTIC, NEO HOOKE\n(\S+), (\S+)\n", abaqus(model).decode())
    young, nu = model.materials.young, model.materials.nu
    c10, d1 = np.array(found, dtype=float).T
    assert_allclose(2.0 * c10, young / (2.0 * (1.0 + nu)), rtol=1e-12)
    assert_allclose(2.0 / d1, young / (3.0 * (1.0 - 2.0 * nu)), rtol=1e-12)


def test_a_modulus_that_varies_is_one_that_depends_on_the_temperature(order):
    model = loaded_model(["hold:superior"], order=order, moduli="nodes")
    blocks = blocks_of(abaqus(model))
    tables = [np.array(lines, dtype=float) for word, _, lines in blocks if word == "*ELASTIC"]
    assert len(tables) == 2  # of one ratio and density each
    (degrees,) = (
        np.array(lines, dtype=float)[:, 1]
        for word, _, lines in blocks
        if word == "*INITIAL CONDITIONS"
    )
    for table in tables:
        young = np.interp(degrees, table[:, 2], table[:, 0])
        assert_allclose(young[: len(model.node_young)], model.node_young, rtol=1e-14)
    ends = model.mesh.cells[:, [0, 1]]
    if order == 2:
        middles = quadratic(model.mesh.points, model.mesh.cells)[1][:, 4]
        assert_allclose(degrees[middles], degrees[ends].mean(axis=1), rtol=1e-14)


def test_steps_that_a_file_cannot_tell_apart_are_refused():
    some = ["hold:superior", "1/spring:left:1", "2/pressure:left:1"]
    for words, nonlinear, match in (
        (some, False, "expected springs in all steps, got 1/spring:left:1"),
        (["1/hold:superior", "2/hold:inferior"], True, "one nonlinear step, got 2"),
    ):
        with refusal(match):
            abaqus(loaded_model(words)._replace(is_nonlinear=nonlinear))
