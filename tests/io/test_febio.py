"""FEBio files read back as XML by the rules of FEBio 4's own reader, and checked against pyfebio's
models of the spec.

No FEBio is at hand to run them.
"""

import xml.etree.ElementTree as ET

import numpy as np
import pyfebio
import pytest
from models import LOAD_CASES, displaced, fibre_model, loaded_model, sample_model, young_of
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from tetopt.fem.solution import solve
from tetopt.geometry.simplex import volumes
from tetopt.io.febio import MOST_MATERIAL_PARTS, febio
from tetopt.model.materials import Along, along_of, materials
from tetopt.model.model import elements, header_lines, in_space, in_units


def with_moduli(nu):
    """A model with more materials than become parts: one for each cell."""
    model = sample_model()
    n_cells = len(model.mesh.cells)
    assert n_cells > MOST_MATERIAL_PARTS
    return model._replace(materials=materials(1.0 + np.arange(n_cells)[::-1] / 7.0, nu, n_cells))


def sample(kind):
    """Few materials, or one for each cell and ratios that vary, too."""
    return (
        sample_model()
        if kind == "parts"
        else with_moduli(np.linspace(0.1, 0.45, len(sample_model().mesh.cells)))
    )


KINDS = ["parts", "maps"]


def rows_of(section, tag, number="id"):
    """Ids and rows of the children, every one of which has this tag."""
    assert {child.tag for child in section} == {tag}
    table = np.array([[float(x) for x in child.text.split(",")] for child in section])
    return np.array([int(child.get(number)) for child in section]), table


def numbers(element):
    return [float(x) for x in element.text.split(",")]


def listed(element):
    return np.array([int(x) for x in element.text.split(",")])


class Feb:
    """What FEBio holds after reading."""

    def __init__(self, raw):
        self.root = ET.fromstring(raw)
        mesh = self.root.find("Mesh")
        self.node_ids, self.points = rows_of(mesh.find("Nodes"), "node")
        self.parts, nodes_of_id = {}, {}
        for part in mesh.findall("Elements"):
            self.type = part.get("type")
            self.parts[part.get("name")], table = rows_of(part, "elem")
            nodes_of_id |= dict(
                zip(self.parts[part.get("name")].tolist(), table.astype(np.int64), strict=True)
            )
        self.cells = np.array([nodes_of_id[k + 1] for k in range(len(nodes_of_id))]) - 1
        self.surfaces = {
            surface.get("name"): rows_of(surface, surface[0].tag)[1].astype(np.int64) - 1
            for surface in mesh.findall("Surface")
        }
        self.node_sets = {
            element.get("name"): listed(element) - 1 for element in mesh.findall("NodeSet")
        }
        self.cell_sets = {
            element.get("name"): listed(element) - 1 for element in mesh.findall("ElementSet")
        }
        self.data = {}
        for entry in self.root.findall("MeshData/ElementData[@name]"):
            lid, values = rows_of(entry, "elem", "lid")
            of_cell = self.data.setdefault(entry.get("name"), np.full(len(self.cells), np.inf))
            of_cell[self.parts[entry.get("elem_set")][lid - 1] - 1] = values[:, 0]

    def moduli(self, tag):
        """A parameter of every cell, from its material or through the map that it names; NaN if
        its material has none.
        """
        material_of = {m.get("name"): m for m in self.root.find("Material")}
        result = np.full(len(self.cells), np.nan)
        for domain in self.root.find("MeshDomains"):
            parameter, ids = (
                material_of[domain.get("mat")].find(tag),
                self.parts[domain.get("name")],
            )
            if parameter is None:
                continue
            result[ids - 1] = (
                self.data[parameter.text][ids - 1]
                if parameter.get("type") == "map"
                else float(parameter.text)
            )
        return result


def test_no_name_is_taken_twice():
    """FEBio refuses a second node or element set of a name, and Nodes and Elements make one
    each.
    """
    for kind in KINDS:
        mesh = ET.fromstring(febio(sample(kind))).find("Mesh")
        for tags in (("Nodes", "NodeSet"), ("Elements", "ElementSet"), ("Surface",)):
            names = [element.get("name").lower() for element in mesh if element.tag in tags]
            assert len(set(names)) == len(names) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_few_materials_are_parts_and_many_are_maps(kind):
    model = in_space(sample(kind), "lps")
    raw = febio(model)
    feb = Feb(raw)
    assert len(feb.parts) == (len(model.materials.young) if kind == "parts" else 1)
    assert set(feb.data) <= {"E", "v", "density"}
    assert_array_equal(feb.moduli("v"), model.materials.nu[model.materials.of_cell])
    head = raw.decode().split("-->")[0]
    assert [line for line in head.splitlines() if line][2:] == header_lines(model)


def test_one_ratio_is_no_map():
    feb = Feb(febio(with_moduli(0.4)))
    assert set(feb.moduli("v")) == {0.4}
    assert feb.root.find("Material/material/v").attrib == {}
    assert "v" not in feb.data


def test_conditions_grow_with_time():
    """From nothing to the whole; which node moves how far, the comparison with `fem` tells."""
    root = ET.fromstring(febio(sample_model()))
    (controller,) = root.findall("LoadData/load_controller")
    values = root.findall("Boundary/bc/value")
    assert {each.get("lc") for each in values} == {"1"} == {controller.get("id")}
    assert [pt.text for pt in root.iter("pt")] == ["0,0", "1,1"]
    steps = root.find("Control")
    assert int(steps.find("time_steps").text) * float(steps.find("step_size").text) == 1.0


def test_sections_are_those_of_pyfebio():
    """Sections, parameters, types and the forms of numbers, none unknown to the spec as pyfebio
    models it.

    pyfebio knows neither <units> nor names of conditions, which FEBio Studio writes, and reads no 0
    or 1 back: what has them is compared with what it writes.
    """
    for kind in KINDS:
        model = sample(kind)
        root = ET.fromstring(febio(model))
        root.find("Module").remove(root.find("Module/units"))
        control, boundary = (root.find(tag) for tag in ("Control", "Boundary"))
        root.remove(control)
        root.remove(boundary)
        read = pyfebio.model.Model.from_xml(ET.tostring(root))
        assert (
            len(read.mesh_.elements)
            == len(read.meshdomains_.solid_domains)
            == len(read.material_.all_materials)
        )
        assert read.mesh_.nodes[0].all_nodes[-1].id == len(model.mesh.points)
        known = ET.fromstring(pyfebio.control.Control().to_xml())
        assert {e.tag for e in control.iter()} <= {e.tag for e in known.iter()}
        assert {e.tag: e.text for e in known if len(e) == 0}.items() >= {
            e.tag: e.text for e in control if len(e) == 0
        }.items()
        for bc in boundary:
            del bc.attrib["name"]
            bc.text = bc[0].tail = None
            for child in bc:
                child.tail = None
        expected = []
        for load in model.loads:
            if not load.numbers.any():
                condition = pyfebio.boundary.BCZeroDisplacement(
                    node_set=load.set_name, x_dof=1, y_dof=1, z_dof=1
                )
                expected.append(condition.to_xml())
                continue
            for dof, value in zip("xyz", load.numbers.tolist(), strict=True):
                moved = pyfebio.boundary.Value(lc=1, text=value)
                expected.append(
                    pyfebio.boundary.BCPrescribedDisplacement(
                        node_set=load.set_name, dof=dof, value=moved
                    ).to_xml()
                )
        assert [
            ET.canonicalize(ET.tostring(bc, encoding="unicode").strip()) for bc in boundary
        ] == [ET.canonicalize(text.decode()) for text in expected]


def test_units_are_consistent_with_mm():
    for units, name, density in (("kPa", "mm-kg-s", 1e-6), ("MPa", "mm-N-s", 1e-9)):
        model = in_units(sample_model(), units)
        feb = Feb(febio(model))
        assert_array_equal(feb.moduli("E"), young_of(model))
        assert feb.root.find("Module/units").text == name
        assert {float(element.text) for element in feb.root.iter("density")} == {density}


def test_weight_is_in_the_unit_of_forces():
    """mN or N, of a density in kg/m3; in m, too."""
    model = loaded_model(["hold:superior", "gravity:0,0,-9810"])
    of_cell = model.materials.density[model.materials.of_cell]
    weight = 9810.0 * 1e-9 * float((of_cell * volumes(model.mesh.points, model.mesh.cells)).sum())
    for units, factor in (("kPa", 1.0), ("MPa", 1e-3), ("Pa", 1e-3)):
        data = ET.fromstring(febio(in_units(model, units))).find("MeshData/NodeData")
        assert sum(numbers(node)[2] for node in data) == pytest.approx(-factor * weight, rel=1e-9)


def test_awkward_names():
    model = sample_model()._replace(
        about={"tetopt": "0.1.0", "image": "a---b-- <é> & 'c'.nii"},
        cell_data={
            'a "b" <c> & d': np.arange(len(sample_model().mesh.cells)),
            "rgb": np.eye(3)[sample_model().materials.of_cell % 3],
        },
    )
    raw = febio(model)
    feb = Feb(raw)
    assert "image: a- - -b- - <é> & 'c'.nii" in raw.decode().split("\n-->")[0]
    assert feb.data == {}  # FEBio would not read them
    assert "MeshData" not in raw.decode()


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (sample_model(2), "tetrahedral mesh, got triangles"),
        (sample_model()._replace(materials=None, loads=()), "needs a material"),
    ],
)
def test_what_it_cannot_carry(model, message):
    with refusal(message):
        febio(model)


@pytest.mark.parametrize("case", LOAD_CASES)
def test_what_the_file_says_is_what_fem_solves(case, order):
    """Pressures on the file's own surfaces, forces, springs at small displacements, conditions;
    by our own matrix.
    """
    model = loaded_model(case, order=order)
    root = ET.fromstring(febio(model))
    nodes = {node.get("id"): numbers(node) for nodes in root.iter("Nodes") for node in nodes}
    points = np.array(list(nodes.values()))
    sets = {each.get("name"): listed(each) - 1 for each in root.iter("NodeSet")}
    is_prescribed, prescribed = np.zeros(points.shape, dtype=bool), np.zeros(points.shape)
    for bc in root.find("Boundary") or ():
        dofs = (
            [0, 1, 2]
            if bc.get("type") == "zero displacement"
            else ["xyz".index(bc.find("dof").text)]
        )
        for dof in dofs:
            is_prescribed[sets[bc.get("node_set")], dof] = True
            prescribed[sets[bc.get("node_set")], dof] = float(bc.findtext("value") or 0.0)
    forces = np.zeros(points.shape)
    for load in root.find("Loads") or ():
        if load.get("type") == "nodal_force":
            assert (load.find("value").get("type"), load.find("value").get("lc")) == ("map", "1")
            (data,) = (
                each
                for each in root.iter("NodeData")
                if each.get("name") == load.find("value").text
            )
            assert (data.get("node_set"), data.get("data_type")) == (load.get("node_set"), "vec3")
            assert [node.get("lid") for node in data] == list(map(str, range(1, len(data) + 1)))
            forces[sets[load.get("node_set")]] += np.array([numbers(node) for node in data])
            continue
        assert load.get("type") == "pressure"
        (surface,) = (
            each for each in root.iter("Surface") if each.get("name") == load.get("surface")
        )
        for facet in surface:
            corners = listed(facet) - 1
            a, b, c = points[corners[:3]]
            push = -float(load.findtext("pressure")) * np.cross(b - a, c - a) / 6.0
            forces[corners[-3:]] += push  # corners of a linear facet; midpoints of a quadratic one
    springs = np.zeros((len(points), 3, 3))
    stiffness = {
        each.get("id"): float(each.findtext("E")) for each in root.iter("discrete_material")
    }
    for each in root.iter("discrete"):
        (pairs,) = (
            one for one in root.iter("DiscreteSet") if one.get("name") == each.get("discrete_set")
        )
        for pair in pairs:
            here, there = listed(pair) - 1
            along = (points[there] - points[here]) / np.linalg.norm(points[there] - points[here])
            assert is_prescribed[there].all()
            springs[here] += stiffness[each.get("dmat")] * np.outer(along, along)
    n = len(elements(model)[0])
    # the same in all directions
    assert_allclose(springs, springs[:, :1, :1] * np.eye(3), atol=1e-12)
    u = displaced(model, is_prescribed[:n], prescribed[:n], forces[:n], springs[:n, 0, 0])
    assert_allclose(u, solve(model).u, atol=1e-9 * np.abs(u).max())


def test_several_steps_are_several_files():
    with refusal("febio: expected one step, got 2"):
        febio(loaded_model(["1/hold:left", "2/hold:left"]))


def test_loads_are_those_of_pyfebio():
    """Every tag and type of the loads is known to the spec as pyfebio models it."""
    root = ET.fromstring(febio(loaded_model("all")))
    known = ET.fromstring(pyfebio.loads.PressureLoad(surface="left").to_xml())
    pressures = [load for load in root.find("Loads") if load.get("type") == "pressure"]
    assert len(pressures) == 2
    for load in pressures:
        assert {child.tag for child in load} <= {child.tag for child in known}
        assert load.tag == known.tag
    (force,) = (load for load in root.find("Loads") if load.get("type") == "nodal_force")
    known = ET.fromstring(pyfebio.loads.NodalForce(node_set="left").to_xml())
    assert (force.tag, force[0].tag) == (known.tag, known[-1].tag)
    data = next(root.iter("NodeData"))
    assert pyfebio.meshdata.NodeData.from_xml(ET.tostring(data)).data_type == "vec3"
    sets = [
        pyfebio.mesh.DiscreteSet.from_xml(ET.tostring(each)) for each in root.iter("DiscreteSet")
    ]
    assert (
        len(sets)
        == len(
            pyfebio.discrete.Discrete.from_xml(
                ET.tostring(root.find("Discrete"))
            ).discrete_materials
        )
        > 3
    )


# Fibres


def with_fibres(kind):
    """Directions in cells of few materials, some isotropic; or in those of as many materials."""
    model = fibre_model()
    if kind == "parts":
        return model
    n_cells = len(model.mesh.cells)
    along = Along(9.0, 2.5, model.materials.along.fibre)
    young = 1.0 + np.arange(n_cells)[::-1] / n_cells
    return model._replace(materials=materials(young, 0.4, n_cells, along=along))


@pytest.mark.parametrize("kind", KINDS)
def test_fibres_are_axes_of_elements(kind):
    """By the rules of FEBio's reader and of its "orthotropic elastic": axes from a and d, by the
    place of an element in its part; cells without a direction are isotropic.
    """
    model = with_fibres(kind)
    feb, table = Feb(febio(model)), model.materials
    along = along_of(table)
    young, nu = young_of(model), table.nu[table.of_cell]
    is_along = along.fibre.any(axis=1)
    axes = np.zeros_like(along.fibre)
    for entry in feb.root.findall("MeshData/ElementData[@type='mat_axis']"):
        assert {child.tag for elem in entry for child in elem} == {"a", "d"}
        lid = np.array([int(elem.get("lid")) for elem in entry])
        a, d = (np.array([numbers(elem.find(tag)) for elem in entry]) for tag in "ad")
        assert (np.linalg.norm(np.cross(a, d), axis=1) > 0.5).all()
        axes[feb.parts[entry.get("elem_set")][lid - 1] - 1] = a
    assert_array_equal(axes[is_along], along.fibre[is_along])
    expected = {
        **{"E1": along.young_along, "E2": young, "E3": young, "v12": nu, "v23": nu},
        **{"v31": nu * young / along.young_along, "G12": along.shear_along},
        **{"G23": young / (2.0 + 2.0 * nu), "G31": along.shear_along},
    }
    for tag, values in expected.items():
        assert_allclose(feb.moduli(tag)[is_along], values[is_along], rtol=1e-14)
    tags = ("E", "v") if kind == "parts" else ("E2", "v12")
    for tag, values in zip(tags, (young, nu), strict=True):
        assert_array_equal(feb.moduli(tag)[~is_along], values[~is_along])
    if kind == "maps":
        assert_allclose(feb.moduli("E1")[~is_along], young[~is_along])
        assert_allclose(feb.moduli("G12")[~is_along], (young / (2.0 + 2.0 * nu))[~is_along])


@pytest.mark.parametrize("kind", KINDS)
def test_fibres_are_those_of_pyfebio(kind):
    """Materials and maps as pyfebio reads them, and the axes of each part's first cell.

    pyfebio has no element data of axes; those of a material have the same form.
    """
    model = with_fibres(kind)._replace(loads=())
    root = ET.fromstring(febio(model))
    root.find("Module").remove(root.find("Module/units"))
    data = root.find("MeshData")
    of_axes = data.findall("ElementData[@type='mat_axis']")
    for entry in of_axes:
        data.remove(entry)
        name = root.find(f"MeshDomains/SolidDomain[@name='{entry.get('elem_set')}']").get("mat")
        material = root.find(f"Material/material[@name='{name}']")
        ET.SubElement(material, "mat_axis", type="vector").extend(entry[0])
    read = pyfebio.model.Model.from_xml(ET.tostring(root))
    table = model.materials
    is_fibres = [np.any(table.along.fibre[table.of_cell == k]) for k in range(len(table.young))]
    kinds = {False: "neo-Hookean", True: "orthotropic elastic"}
    all_materials = read.material_.all_materials
    axes = [each.mat_axis for each in all_materials if each.type == "orthotropic elastic"]
    expected = [tuple(child.text for child in entry[0]) for entry in of_axes]
    assert [(each.a, each.d) for each in axes] == expected
    assert expected
    if kind == "maps":
        (each,) = all_materials
        assert (each.E1.type, each.E2.type, each.v12.text) == ("map", "map", 0.4)
        by_name = {entry.name: entry for entry in read.meshdata_.element_data}
        values = [float(elem.text) for elem in by_name[each.E2.text].all_elements]
        assert_array_equal(values, young_of(model))
        return
    assert [each.type for each in all_materials] == [kinds[bool(each)] for each in is_fibres]
    for k, each in enumerate(all_materials):
        young = each.E if each.type == "neo-Hookean" else each.E2
        assert young.text == table.young[k]
        if each.type != "neo-Hookean":
            assert (each.E1.text, each.G12.text) == (
                table.along.young_along[k],
                table.along.shear_along[k],
            )
