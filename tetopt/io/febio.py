"""FEBio input files, febio_spec 4.0: mesh, sets, materials, cell data and a static step.

Based on the sources and manuals of FEBio 4 and FEBio Studio 2, and read back with pyfebio; not yet
verified in FEBio.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.tags import named_materials
from tetopt.io.text import rows, xml_attribute, xml_comment
from tetopt.model.loads import Load, count_of_steps, spring_constants
from tetopt.model.materials import (
    axes_across,
    cells_of,
    density_of,
    engineering_constants,
    is_fibrous,
)
from tetopt.model.model import (
    STRESS_UNITS,
    Model,
    element_facets,
    elements,
    header_lines,
    mass_densities,
    traction_forces,
)
from tetopt.system.arrays import Floats, Ints

MOST_MATERIAL_PARTS = 100  # with more, FEBio Studio's list of parts is unusable
# FEBio's names of consistent systems of units
STUDIO_UNITS = {"kPa": "mm-kg-s", "MPa": "mm-N-s", "Pa": "SI"}
# Names of sets have no spaces, so that these names, and those of parts ("cells of liver"), never
# clash with them.
ALL_NODES, ALL_CELLS = "all nodes", "all cells"
# maps, and the constants that they have, of `tetopt.model.materials.engineering_constants` if these
# have fibres
YOUNG_MAP, NU_MAP, DENSITY_MAP = "E", "v", "density"
# parameters of a material by its type, and their constants
NEO_HOOKEAN, ORTHOTROPIC = "neo-Hookean", "orthotropic elastic"
PARAMETERS = {
    NEO_HOOKEAN: {"E": YOUNG_MAP, "v": NU_MAP},
    ORTHOTROPIC: {
        **{"E1": "E1", "E2": "E2", "E3": "E2", "v12": NU_MAP, "v23": NU_MAP, "v31": "v31"},
        **{"G12": "G12", "G23": "G23", "G31": "G12"},
    },
}
# the set of nodes with forces from tractions and weight, and the map of these forces
DEAD_FORCES = "dead forces"
GROUND_NODES = "ground nodes"  # the far ends of springs
# FEBio's springs act along their length, so that three of them represent one isotropic spring. With
# this length, in sizes of the mesh, transverse movement hardly stretches them.
SPRING_LENGTHS = 1000.0

# The settings of FEBio Studio, except for equal increments up to the whole displacement, which the
# solver may halve.
CONTROL_SECTION = """\
<Control>
<analysis>STATIC</analysis>
<time_steps>10</time_steps>
<step_size>0.1</step_size>
<time_stepper type="default">
<max_retries>5</max_retries>
<opt_iter>11</opt_iter>
<dtmin>0</dtmin>
<dtmax>0.1</dtmax>
</time_stepper>
<solver type="solid">
<symmetric_stiffness>symmetric</symmetric_stiffness>
</solver>
</Control>
"""
RAMP_SECTION = """\
<LoadData>
<load_controller id="1" type="loadcurve">
<interpolate>LINEAR</interpolate>
<extend>CONSTANT</extend>
<points>
<pt>0,0</pt>
<pt>1,1</pt>
</points>
</load_controller>
</LoadData>
"""
PLOT_VARIABLES = (
    "displacement",
    "stress",
    "Lagrange strain",
    "strain energy density",
    "reaction forces",
)


class _Part(NamedTuple):
    """Cells of one material."""

    name: str
    material: str  # its name
    kind: str  # of material
    constants: dict[str, str]  # by name: a number, or this name for a map
    cells: Ints


def febio(model: Model) -> bytes:
    """Return an FEBio input file (.feb), febio_spec 4.0.

    Linear (tet4) or quadratic (tet10) tetrahedra. Each facet set becomes a surface and a node set
    of its name, the latter including midside nodes; each cell set becomes an element set. A cell's
    id is its number in the mesh plus 1.

    Up to 100 materials become separate parts, named after their labels
    (`tetopt.io.tags.named_materials`): material "liver", part "cells of liver". Cells are written
    part by part. More materials become a single part, "all cells", with E, and v if it varies,
    mapped by element data. Cell data are written as element data, too, to be shown in FEBio Studio
    or mapped to parameters.

    The material is neo-Hookean: at small strains it equals linear elasticity with these moduli, as
    solved by `tetopt fem`, and it withstands large compression, where FEBio's "isotropic elastic"
    (St. Venant-Kirchhoff) softens until cells collapse. With fibres it is "orthotropic elastic",
    FEBio's only linear law with a direction, which softens likewise, with the axes of each cell as
    element data "mat_axis". Loads are applied in a static step of ten
    increments with large deformation. Pressures follow their surfaces; tractions and weight are
    nodal forces by `tetopt.model.loads.facet_weights`, with constant direction; the springs of a
    set are three long springs at each of its nodes. The plot file includes the strain energy
    density, whose integral over the undeformed volume is the total. Without loads there is no step;
    add one in FEBio Studio.

    Raises
    ------
    InputError
        The model is 2-D, has no materials or several steps, or has cell data with the name of a
        map.
    """
    _check(model)
    parts = _parts(model)
    sections = [
        _head(model),
        "<Globals>\n<Constants>\n<T>0</T>\n<P>0</P>\n<R>0</R>\n"
        "<Fc>0</Fc>\n</Constants>\n</Globals>\n",
        CONTROL_SECTION if model.loads else "",
        _materials(parts),
        *_mesh(model, parts),
        "<MeshDomains>\n",
        *(f'<SolidDomain name="{part.name}" mat="{part.material}"/>\n' for part in parts),
        "</MeshDomains>\n",
        *_mesh_data(model, parts),
        *_loads(model),
        '<Output>\n<plotfile type="febio">\n',
        *(f'<var type="{name}"/>\n' for name in PLOT_VARIABLES),
        "</plotfile>\n</Output>\n</febio_spec>\n",
    ]
    return "".join(sections).encode()


def _check(model: Model) -> None:
    if model.mesh.ndim == 2:
        raise InputError("febio: expected a tetrahedral mesh, got triangles; use .vtu")
    if model.materials is None:
        raise InputError("febio: a part needs a material; give a modulus mapping (`young`)")
    if (count := count_of_steps(model.loads)) > 1:  # each would continue from the previous one
        raise InputError(
            f"febio: expected one step, got {count}; write a file for each step with only its loads"
        )


def _parts(model: Model) -> list[_Part]:
    table = model.materials
    assert table is not None
    constants = _constants(model)
    if len(table.young) > MOST_MATERIAL_PARTS:
        texts = {
            name: name if np.ptp(values) > 0.0 or name == YOUNG_MAP else repr(float(values[0]))
            for name, values in constants.items()
        }
        kind = NEO_HOOKEAN if table.along is None else ORTHOTROPIC
        return [_Part(ALL_CELLS, ALL_CELLS, kind, texts, np.arange(len(table.of_cell)))]
    return [
        _Part(
            f"cells of {name}",
            name,
            ORTHOTROPIC if is_fibrous(table, members) else NEO_HOOKEAN,
            {each: repr(float(values[k])) for each, values in constants.items()},
            members,
        )
        for k, (name, members) in enumerate(
            zip(named_materials(model), cells_of(table), strict=True)
        )
        if len(members)
    ]


def _constants(model: Model) -> dict[str, Floats]:
    """Return the constants of each material, (K,), by name."""
    table = model.materials
    assert table is not None
    isotropic = {YOUNG_MAP: table.young, NU_MAP: table.nu, DENSITY_MAP: mass_densities(model)}
    return isotropic | engineering_constants(table)


def _head(model: Model) -> str:
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n{xml_comment(header_lines(model))}<febio_spec '
        'version="4.0">\n'
        f'<Module type="solid">\n<units>{STUDIO_UNITS[model.units]}</units>\n</Module>\n'
    )


def _materials(parts: list[_Part]) -> str:
    return "".join(
        [
            "<Material>\n",
            *(
                f'<material id="{k}" name="{part.material}" type="{part.kind}">\n'
                + "".join(
                    _parameter(tag, part.constants[name], name)
                    for tag, name in ({DENSITY_MAP: DENSITY_MAP} | PARAMETERS[part.kind]).items()
                )
                + "</material>\n"
                for k, part in enumerate(parts, start=1)
            ),
            "</Material>\n",
        ]
    )


def _parameter(tag: str, value: str, map_name: str) -> str:
    kind = ' type="map"' if value == map_name else ""
    return f"<{tag}{kind}>{value}</{tag}>\n"


def _mesh(model: Model, parts: list[_Part]) -> list[str]:
    points, cells = elements(model)
    surfaces = {name: element_facets(cells, members) for name, members in model.sets.facets.items()}
    return [
        f'<Mesh>\n<Nodes name="{ALL_NODES}">\n{_items("node", points)}</Nodes>\n',
        *_ground(model, points),
        *(
            f'<Elements type="tet{cells.shape[1]}" name="{part.name}">\n'
            f"{_items('elem', cells[part.cells] + 1, part.cells + 1)}</Elements>\n"
            for part in parts
        ),
        *(
            f'<Surface name="{name}">\n{_items(f"tri{nodes.shape[1]}", nodes + 1)}</Surface>\n'
            for name, nodes in surfaces.items()
        ),
        *(
            f'<ElementSet name="{name}">{_list(members)}</ElementSet>\n'
            for name, members in model.sets.cells.items()
        ),
        *(
            f'<NodeSet name="{name}">{_list(np.unique(nodes))}</NodeSet>\n'
            for name, nodes in surfaces.items()
        ),
        *_force_and_spring_sets(model, points),
        "</Mesh>\n",
    ]


def _mesh_data(model: Model, parts: list[_Part]) -> list[str]:
    """Return moduli by part, which FEBio joins by name, and axes of fibres: `lid` follows the order
    of the part's cells.

    FEBio reads no other element data, which would be nine tenths of a head's file. A set of all
    cells would not work: across parts, FEBio uses their order and not that of the set.
    """
    table = model.materials
    assert table is not None
    used = {DENSITY_MAP, *PARAMETERS[parts[0].kind].values()}
    fields = {
        name: values[table.of_cell]
        for name, values in _constants(model).items()
        if name in used and parts[0].constants[name] == name
    }
    data = [
        f'<ElementData name="{xml_attribute(name)}" elem_set="{part.name}" data_type="scalar">\n'
        f"{_items('elem', values[part.cells], number='lid')}</ElementData>\n"
        for name, values in fields.items()
        for part in parts
    ]
    if table.along is not None:
        data += [_axes(part, table.along.fibre) for part in parts if part.kind == ORTHOTROPIC]
    nodes, forces = _dead_forces(model)
    if len(nodes):
        data.append(
            f'<NodeData name="{DEAD_FORCES}" node_set="{DEAD_FORCES}" data_type="vec3">\n'
            f"{_items('node', forces, number='lid')}</NodeData>\n"
        )
    return ["<MeshData>\n", *data, "</MeshData>\n"] if data else []


def _axes(part: _Part, fibre: Floats) -> str:
    """Return the axes of a part's cells: the first along the fibres, the second in the plane of
    them and another vector; any where a cell is isotropic.
    """
    own = fibre[part.cells]
    own = np.where(own.any(axis=1, keepdims=True), own, [1.0, 0.0, 0.0])
    axes = zip(
        *(rows(each, separator=",").splitlines() for each in (own, axes_across(own))), strict=True
    )
    lines = "".join(
        f'<elem lid="{k}"><a>{a}</a><d>{d}</d></elem>\n' for k, (a, d) in enumerate(axes, start=1)
    )
    return f'<ElementData type="mat_axis" elem_set="{part.name}">\n{lines}</ElementData>\n'


def _loads(model: Model) -> list[str]:
    if not model.loads:
        return []
    pushes = [
        f'<surface_load name="pressure {load.set_name}" type="pressure" '
        f'surface="{load.set_name}">\n'
        f'<pressure lc="1">{float(load.numbers[0])!r}</pressure>\n<linear>0</linear>\n'
        "<symmetric_stiffness>1</symmetric_stiffness>\n</surface_load>\n"
        for load in model.loads
        if load.kind == "pressure"
    ]
    if len(_dead_forces(model)[0]):
        pushes.append(
            f'<nodal_load name="{DEAD_FORCES}" type="nodal_force" node_set="{DEAD_FORCES}">\n'
            f'<value lc="1" type="map">{DEAD_FORCES}</value>\n</nodal_load>\n'
        )
    conditions = [_condition(load) for load in model.loads if load.kind == "displacement"]
    constants = _springs(model)[1]
    if len(constants):
        conditions.append(_condition(Load("displacement", GROUND_NODES, np.zeros(3))))
    return [
        RAMP_SECTION,
        *(["<Boundary>\n", *conditions, "</Boundary>\n"] if conditions else []),
        *(["<Loads>\n", *pushes, "</Loads>\n"] if pushes else []),
        *(["<Discrete>\n", *_discrete(constants), "</Discrete>\n"] if len(constants) else []),
    ]


def _dead_forces(model: Model) -> tuple[Ints, Floats]:
    """Return the nodes with forces from tractions and weight, and these forces, (P, 3)."""
    total = traction_forces(model, model.loads)
    for load in model.loads:
        if load.kind == "gravity" and (table := model.materials) is not None:
            density = density_of(table)[table.of_cell]
            # imported here, as it loads scipy's solvers
            from tetopt.fem.solution import weight_forces

            # u mm make the numbers those of u^4 mN; a unit of force is u^2 kPa mm2
            units = STRESS_UNITS[model.units]
            forces = weight_forces(model.mesh, density, load.numbers, model.order)
            total += forces * (units.mm**2 / units.kPa)
    nodes = np.flatnonzero(total.any(axis=1))
    return nodes, total[nodes]


def _springs(model: Model) -> tuple[Ints, Floats]:
    """Return the nodes on springs, and their stiffness, (P,)."""
    total = np.zeros(len(elements(model)[0]))
    for load in model.loads:
        if load.kind == "spring":
            nodes, constants = spring_constants(model.mesh, model.sets, load, model.order)
            total[nodes] += constants
    nodes = np.flatnonzero(total)
    return nodes, total[nodes]


def _ground(model: Model, points: Floats) -> list[str]:
    """Return the far ends of springs, numbered after the nodes: along x, y and z from each node
    on springs.
    """
    nodes = _springs(model)[0]
    if len(nodes) == 0:
        return []
    length = SPRING_LENGTHS * float(np.ptp(points, axis=0).max())
    ends = (points[nodes][:, None] + length * np.eye(3)).reshape(-1, 3)
    lines = _items("node", ends, len(points) + 1 + np.arange(len(ends)))
    return [f'<Nodes name="far ends of springs">\n{lines}</Nodes>\n']


def _force_and_spring_sets(model: Model, points: Floats) -> list[str]:
    forced = _dead_forces(model)[0]
    sprung = _springs(model)[0]
    sets = [f'<NodeSet name="{DEAD_FORCES}">{_list(forced)}</NodeSet>\n'] if len(forced) else []
    if len(sprung) == 0:
        return sets
    ends = len(points) + np.arange(3 * len(sprung))
    sets.append(f'<NodeSet name="{GROUND_NODES}">{_list(ends)}</NodeSet>\n')
    for k, (node, three) in enumerate(
        zip(sprung.tolist(), ends.reshape(-1, 3).tolist(), strict=True), start=1
    ):
        pairs = "".join(f"<delem>{node + 1},{end + 1}</delem>\n" for end in three)
        sets.append(f'<DiscreteSet name="spring {k}">\n{pairs}</DiscreteSet>\n')
    return sets


def _discrete(constants: Floats) -> list[str]:
    """Return a material for each node on springs, and the assignment of springs to materials."""
    materials = [
        f'<discrete_material id="{k}" name="spring {k}" type="linear '
        f'spring">\n<E>{constant!r}</E>\n'
        "</discrete_material>\n"
        for k, constant in enumerate(constants.tolist(), start=1)
    ]
    return materials + [
        f'<discrete dmat="{k}" discrete_set="spring {k}"/>\n' for k in range(1, len(constants) + 1)
    ]


def _condition(load: Load) -> str:
    if (load.numbers == 0.0).all():
        return (
            f'<bc name="hold {load.set_name}" type="zero displacement" '
            f'node_set="{load.set_name}">\n'
            "<x_dof>1</x_dof>\n<y_dof>1</y_dof>\n<z_dof>1</z_dof>\n</bc>\n"
        )
    return "".join(
        f'<bc name="move {load.set_name} {dof}" type="prescribed displacement" '
        f'node_set="{load.set_name}">\n'
        f'<dof>{dof}</dof>\n<value lc="1">{value!r}</value>\n<relative>0</relative>\n</bc>\n'
        for dof, value in zip("xyz", load.numbers.tolist(), strict=True)
        if not np.isnan(value)
    )


def _items(tag: str, array: NDArray, ids: Ints | None = None, number: str = "id") -> str:
    """Return a line for each row of an array, numbered from 1 or by `ids`."""
    lines = rows(array, separator=",").splitlines()
    numbers = range(1, len(lines) + 1) if ids is None else ids.tolist()
    return "".join(
        f'<{tag} {number}="{k}">{line}</{tag}>\n' for k, line in zip(numbers, lines, strict=True)
    )


def _list(numbers: Ints) -> str:
    return ",".join(map(str, (numbers + 1).tolist()))
