"""SOFA scenes read back as XML, with SOFA's links followed; no SOFA is at hand to run them."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from models import LOAD_CASES, displaced, loaded_model, sample_model

from tetopt.errors import InputError
from tetopt.fem.solution import solve
from tetopt.io.sofa import REQUIRED_PLUGINS, sofa
from tetopt.model.materials import materials
from tetopt.model.model import described, in_space, in_units
from tetopt.model.sets import facet_triples, nodes_of

# The plugin of every component, from SOFA's documentation; None for what is always there.
PLUGIN_OF = {
    "ConstantForceField": "Sofa.Component.MechanicalLoad",
    "DefaultAnimationLoop": None,
    "DiagonalMass": "Sofa.Component.Mass",
    "EulerImplicitSolver": "Sofa.Component.ODESolver.Backward",
    "FixedProjectiveConstraint": "Sofa.Component.Constraint.Projective",
    "LinearMovementProjectiveConstraint": "Sofa.Component.Constraint.Projective",
    "MechanicalObject": "Sofa.Component.StateContainer",
    "Node": None,
    "PartialFixedProjectiveConstraint": "Sofa.Component.Constraint.Projective",
    "PointsFromIndices": "Sofa.Component.Engine.Select",
    "RequiredPlugin": None,
    "RestShapeSpringsForceField": "Sofa.Component.SolidMechanics.Spring",
    "SparseLDLSolver": "Sofa.Component.LinearSolver.Direct",
    "TetrahedronFEMForceField": "Sofa.Component.SolidMechanics.FEM.Elastic",
    "TetrahedronSetGeometryAlgorithms": "Sofa.Component.Topology.Container.Dynamic",
    "TetrahedronSetTopologyContainer": "Sofa.Component.Topology.Container.Dynamic",
    "TriangleSetTopologyContainer": "Sofa.Component.Topology.Container.Dynamic",
    "VisualStyle": "Sofa.Component.Visual",
}


def table(element, name, dtype=np.int64, width=None):
    values = np.array([dtype(text) for text in element.get(name).split()])
    return values if width is None else values.reshape(-1, width)


def solid_of(raw):
    return ET.fromstring(raw).find("Node[@name='solid']")


def assert_same(solid, model):
    mesh, moduli = model.mesh, model.materials
    topology = solid.find("TetrahedronSetTopologyContainer")
    assert table(topology, "position", float, 3).tobytes() == mesh.points.tobytes()
    np.testing.assert_array_equal(table(topology, "tetrahedra", width=4), mesh.cells)
    law = solid.find("TetrahedronFEMForceField")
    np.testing.assert_array_equal(table(law, "youngModulus", float), moduli.young[moduli.of_cell])
    np.testing.assert_array_equal(table(law, "poissonRatio", float), moduli.nu[moduli.of_cell])
    sets = {node.get("name"): node for node in solid.find("Node[@name='sets']")}
    assert list(sets) == [*model.sets.facets, *model.sets.cells]
    for name, facets in model.sets.facets.items():
        assert [(part.tag, part.get("name")) for part in sets[name]] == [
            ("PointsFromIndices", "nodes"),
            ("TriangleSetTopologyContainer", "facets"),
        ]
        np.testing.assert_array_equal(table(sets[name][0], "indices"), nodes_of(mesh, facets))
        np.testing.assert_array_equal(table(sets[name][1], "triangles", width=3), facet_triples(mesh.cells, facets))
    for name, cells in model.sets.cells.items():
        assert [(part.tag, part.get("name")) for part in sets[name]] == [("TetrahedronSetTopologyContainer", "cells")]
        np.testing.assert_array_equal(table(sets[name][0], "tetrahedra", width=4), mesh.cells[cells])


@pytest.mark.parametrize("bins", [3, None])
@pytest.mark.parametrize("space", ["ras", "lps"])
def test_everything_comes_back(bins, space):
    model = in_space(sample_model(3, bins), space)
    raw = sofa(model)
    assert_same(solid_of(raw), model)
    head = raw.decode().split("\n-->")[0].splitlines()[2:]
    assert head[: len(described(model))] == described(model)
    assert head[-1].endswith(": " + ", ".join(model.cell_data))


def test_every_component_has_its_plugin():
    root = ET.fromstring(sofa(sample_model()))
    needed = {PLUGIN_OF[element.tag] for element in root.iter()} - {None}
    listed = [element.get("name") for element in root.iter("RequiredPlugin")]
    assert sorted(needed) == sorted(listed) == sorted(REQUIRED_PLUGINS)
    tags = [element.tag for element in root]
    assert max(k for k, tag in enumerate(tags) if tag == "RequiredPlugin") < tags.index("VisualStyle")


def test_every_link_leads_to_a_component_that_is_there_already():
    """SOFA makes all components of a node in their order, and then those of its nodes."""
    root = ET.fromstring(sofa(sample_model()))
    earlier, n_links = [], 0
    pending = [[root]]  # nodes with those above them
    while pending:
        path = pending.pop(0)
        for element in path[-1]:
            for value in element.attrib.values():
                if value.startswith("@"):
                    ups, name, data = re.fullmatch(r"@((?:\.\./)*)(\w+)(?:\.(\w+))?", value).groups()
                    (target,) = path[-1 - ups.count("/")].findall(f"*[@name='{name}']")
                    assert target in earlier
                    assert data is None or data in target.attrib
                    n_links += 1
            if element.tag == "Node":
                pending.append([*path, element])
            else:
                earlier.append(element)
    assert n_links > 10


def test_constraints_are_the_loads():
    model = sample_model()
    solid = solid_of(sofa(model))
    assert len(model.loads) == 2
    for load in model.loads:
        nodes = nodes_of(model.mesh, model.sets.facets[load.set_name])
        kind = ("Fixed", "hold") if not load.numbers.any() else ("LinearMovement", "move")
        (constraint,) = solid.findall(f"{kind[0]}ProjectiveConstraint")
        assert constraint.get("name") == f"{kind[1]}_{load.set_name}"
        np.testing.assert_array_equal(table(constraint, "indices"), nodes)
        if kind[1] == "move":
            whole = load.numbers.tolist()
            assert table(constraint, "movements", float, 3).tolist() == [[0.0, 0.0, 0.0], whole, whole]
            assert table(constraint, "keyTimes", float).tolist() == [0.0, 1.0, 1e9]
    assert not [e for e in solid_of(sofa(model._replace(loads=()))) if e.tag.endswith("Constraint")]


def test_one_ratio_is_one_number():
    model = sample_model(3, None)
    moduli = model.materials
    one = materials(moduli.young[moduli.of_cell], 0.4, len(moduli.of_cell))
    law = solid_of(sofa(model._replace(materials=one))).find("TetrahedronFEMForceField")
    assert table(law, "poissonRatio", float).tolist() == [0.4]
    np.testing.assert_array_equal(table(law, "youngModulus", float), moduli.young[moduli.of_cell])


def test_units_are_consistent_with_mm():
    for units, density in (("kPa", 1e-6), ("MPa", 1e-9)):
        model = in_units(sample_model(), units)
        solid = solid_of(sofa(model))
        assert_same(solid, model)
        assert float(solid.find("DiagonalMass").get("massDensity")) == density


def test_awkward_names():
    raw = sofa(sample_model()._replace(about={"image": "a---b-- <é> & 'c'.nii"}))
    assert "image: a- - -b- - <é> & 'c'.nii" in raw.decode().split("\n-->")[0]
    assert_same(solid_of(raw), sample_model())


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (sample_model(2), "tetrahedra, got triangles"),
        (sample_model()._replace(order=2), "linear cells"),
        (sample_model()._replace(materials=None, loads=()), "needs materials"),
        (sample_model()._replace(materials=materials(1.0, -0.1, len(sample_model().mesh.cells))), "got -0.1"),
    ],
)
def test_what_it_cannot_carry(model, message):
    with pytest.raises(InputError, match=message) as caught:
        sofa(model)
    assert "\n" not in str(caught.value)


SOFA_CASES = LOAD_CASES.keys() - {"free components"}


@pytest.mark.parametrize("case", sorted(SOFA_CASES))
def test_what_the_scene_says_is_what_fem_solves(case):
    """Masses, forces, springs and constraints taken from the scene, by our own matrix."""
    model = loaded_model(case)
    root = ET.fromstring(sofa(model))
    solid, shape = root.find("Node[@name='solid']"), model.mesh.points.shape
    is_prescribed, prescribed = np.zeros(shape, dtype=bool), np.zeros(shape)
    mass = table(solid.find("DiagonalMass"), "vertexMass", float)
    forces = mass[:, None] * table(root, "gravity", float)
    springs = np.zeros(len(mass))
    for element in solid:
        if element.tag == "ConstantForceField":
            forces[table(element, "indices")] += table(element, "forces", float, 3)
        elif element.tag == "RestShapeSpringsForceField":
            springs[table(element, "points")] += table(element, "stiffness", float)
        elif element.tag.endswith("ProjectiveConstraint"):
            nodes = table(element, "indices")
            is_prescribed[nodes] = True
            prescribed[nodes] = table(element, "movements", float, 3)[-1] if element.get("movements") else 0.0
    u = displaced(model, is_prescribed, prescribed, forces, springs)
    np.testing.assert_allclose(u, solve(model).u, atol=1e-9 * np.abs(u).max())
    plugins = {element.get("name") for element in root.iter("RequiredPlugin")}
    assert plugins >= {PLUGIN_OF[element.tag] for element in root.iter()} - {None}


def test_components_that_are_free_and_steps():
    model = loaded_model(["move:left:0,free,0", "pressure:right:1"])
    (constraint,) = solid_of(sofa(model)).findall("PartialFixedProjectiveConstraint")
    assert constraint.get("fixedDirections") == "1 0 1"
    for words, match in (
        (["move:left:1,free,0"], "instead of free"),
        (["1/hold:left", "2/hold:left"], "one step, got 2"),
    ):
        with pytest.raises(InputError, match=match):
            sofa(loaded_model(words))
