"""XDMF for FEniCSx (dolfinx), ParaView and meshio: one text file with the mesh, its moduli and tags
of its sets.

The domain has one grid, "mesh", as meshio requires, with cell data: first `material` (from 1), then
`young` and `nu`. An <Information> in it contains the other grids: "facets" and "cells", if there
are such sets, with one integer for each facet or cell in any set. A tag represents one combination
of sets, so that a set has several tags: <Information Name="superior" Value="2 5"> in the grid lists
them. The tag of a cell is its label, or another number if sets divide the label
(`tetopt.io.tags.number_parts`). This program reads all data, on any number of processes::

    from xml.etree import ElementTree

    import numpy as np
    from dolfinx import fem
    from dolfinx.io import XDMFFile
    from mpi4py import MPI

    inner = "/Xdmf/Domain/Grid/Information/Grid"
    with XDMFFile(MPI.COMM_WORLD, "model.xdmf", "r", encoding=XDMFFile.Encoding.ASCII) as file:
        mesh = file.read_mesh(name="mesh")
        dim = mesh.topology.dim
        mesh.topology.create_connectivity(dim - 1, dim)
        facet_tags = file.read_meshtags(mesh, name="facets", xpath=inner)
        cell_tags = file.read_meshtags(mesh, name="cells", xpath=inner)
        material_tags = file.read_meshtags(mesh, name="mesh")

    root = ElementTree.parse("model.xdmf").getroot()

    def members(tags, grid, name):  # facets or cells of a set, in dolfinx's numbering
        of_set = root.find(f".//Grid[@Name='{grid}']/Information[@Name='{name}']").get("Value")
        return tags.indices[np.isin(tags.values, np.array(of_set.split(), dtype=int))]

    def on_cells(name):  # a field that is constant in each cell; dolfinx reorders cells
        text = root.find(f".//Grid[@Name='mesh']/Attribute[@Name='{name}']/DataItem").text
        field = fem.Function(fem.functionspace(mesh, ("DG", 0)))
        field.x.array[:] = np.array(text.split(), dtype=float)[mesh.topology.original_cell_index]
        return field

    young, nu = on_cells("young"), on_cells("nu")
    superior = members(facet_tags, "facets", "superior")

Before 0.7, `fem.functionspace` was `fem.FunctionSpace`; with this change the program also runs with
0.5.2. `read_meshtags` uses the first attribute of a grid, which is why `material` comes first. The
encoding must be given; otherwise dolfinx looks for an HDF5 file next to this one. dolfinx cannot
read floating-point cell data from XDMF, hence the parsing. Quadratic elements are chosen in
dolfinx, on cells of either order: a file of order 2 also has the nodes of order 2, and dolfinx
integrates its cells as curved, as those on interfaces may be.

In the grid "mesh", <Information Name="young"> and <Information Name="nu"> list the constants of
materials 1, 2, ..., <Information Name="load" Value="hold:superior"> is a load in the text form of
`tetopt.model.loads`, and <Information Name="about"> describes the origin of the file, its
coordinates and its units. With a test function `v` of a vector space `V`, the following continues
the program above and applies the loads of step 1::

    import ufl

    normal, ds = ufl.FacetNormal(mesh), ufl.Measure("ds", mesh, subdomain_data=facet_tags)
    per_mm3 = 1e-9  # kg in a kg/m3; 1e-12 t if moduli are in MPa
    conditions, forces, springs = [], [], []
    for load in root.findall("./Domain/Grid/Information[@Name='load']"):
        step, _, words = load.get("Value").rpartition("/")
        kind, *rest = words.split(":")
        if step not in ("", "1"):
            continue
        texts = "0 " * dim if kind == "hold" else rest[-1].replace("free", "nan").replace(",", " ")
        numbers = np.array(texts.split(), dtype=float)
        if kind == "gravity":
            weight = per_mm3 * on_cells("density") * fem.Constant(mesh, numbers)
            forces.append(ufl.inner(weight, v) * ufl.dx)
            continue
        if kind in ("hold", "move"):
            for d in np.flatnonzero(np.isfinite(numbers)):
                held = members(facet_tags, "facets", rest[0])
                dofs = fem.locate_dofs_topological(V.sub(d), dim - 1, held)
                conditions.append(fem.dirichletbc(numbers[d], dofs, V.sub(d)))
            continue
        of_set = root.find(f".//Grid[@Name='facets']/Information[@Name='{rest[0]}']").get("Value")
        on_set = ds(tuple(map(int, of_set.split())))
        if kind == "pressure":
            forces.append(-numbers[0] * ufl.inner(normal, v) * on_set)
        elif kind == "traction":
            forces.append(ufl.inner(fem.Constant(mesh, numbers), v) * on_set)
        else:  # a spring: its assembled vector is added to the diagonal of the matrix
            springs.append(numbers[0] * ufl.inner(fem.Constant(mesh, np.ones(dim)), v) * on_set)

Moduli that are linear within cells are the attribute `young_nodes`, one for each node.

VTK, and thus pyvista and ParaView, follows the grid's Reference to a tree of the same grids, which
it reads as blocks, if no list exceeds 10 MB, as that of the cells does from about 400 000
tetrahedra on: use .vtu for larger meshes. meshio ignores the Reference and reads the mesh and its
data, without sets.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.io.tags import (
    Tagged,
    as_columns,
    facet_tags,
    group_labels,
    number_parts,
    tag_sets,
)
from tetopt.io.text import rows, xml_attribute
from tetopt.model.fields import NODE_MODULI, node_field
from tetopt.model.loads import load_words
from tetopt.model.model import Model, element_facets, elements, header_lines, kind_lines
from tetopt.model.sets import Sets
from tetopt.system.arrays import Ints

# By dimension and order, with VTK's order of nodes; lines must state their number of nodes.
TOPOLOGY_TYPES = {
    (1, 1): '"PolyLine" NodesPerElement="2"',
    (2, 1): '"Triangle"',
    (3, 1): '"Tetrahedron"',
    (1, 2): '"Edge_3"',
    (2, 2): '"Triangle_6"',
    (3, 2): '"Tetrahedron_10"',
}
GEOMETRY_TYPES = {2: "XY", 3: "XYZ"}
ROW_TYPES = {(): "Scalar", (3,): "Vector", (9,): "Tensor"}  # by a row's shape
TREE_PATH = "/Xdmf/Domain/Grid/Information/Grid"
TIME_ELEMENT = '<Time Value="0"/>\n'  # pyvista 0.49 requires it in XDMF, meshio 5.3.5 rejects it
INFORMATION_TEXT = "&lt;main/&gt;"  # meshio parses an Information's text as XML


def xdmf(model: Model) -> bytes:
    """Return an XDMF file (.xdmf): mesh, cell data, materials, tags of facets and cells, and the
    loads as text.

    A facet is listed once, oriented outwards from its cell in the first of its sets; if another set
    holds it from the other side, its tag is also in <Information Name="NAME turned"/>. dolfinx
    itself does not orient facets. Cell data with 3 columns are written as vectors, with 9 as
    tensors, with other numbers of columns as separate fields NAME_0, NAME_1, ...; materials replace
    cell data with the names material, young, nu and density.

    Raises
    ------
    InputError
        Data of cells or points are not finite: VTK would stop reading there and invent the rest.
    """
    facets = _facet_grid(model) if model.sets.facets else ""
    cells = _cell_grid(model) if model.sets.cells else ""
    text = _mesh_grid(model, facets + cells)
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<Xdmf '
        f'Version="3.0">\n<Domain>\n{text}</Domain>\n</Xdmf>\n'
    ).encode()


def _mesh_grid(model: Model, others: str) -> str:
    """Return the domain's grid, with the tree of grids that VTK reads instead: itself by
    references, and `others`.
    """
    fields = model.cell_data
    named = [("about", line) for line in header_lines(model) + kind_lines(model)] + [
        ("load", load_words(load)) for load in model.loads
    ]
    if model.materials is not None:
        own = model.materials.fields()
        own = {"material": own["material"]} | own
        fields = own | {name: values for name, values in fields.items() if name not in own}
        moduli = (("young", model.materials.young), ("nu", model.materials.nu))
        named += [(name, " ".join(map(repr, values.tolist()))) for name, values in moduli]
    points, cells = elements(model)
    at_nodes = dict(model.point_data)
    if model.node_young is not None:
        young_nodes = node_field(model.node_young, model.mesh, model.order)
        at_nodes = {NODE_MODULI: young_nodes} | at_nodes
    columns = [(*item, "Cell") for item in as_columns(fields, tuple(ROW_TYPES)).items()]
    columns += [(*item, "Node") for item in as_columns(at_nodes, tuple(ROW_TYPES)).items()]
    whole = _body(model, model.mesh.ndim, cells, _item(cells), _item(points))
    whole += "".join(
        _attribute(name, values, center, _item(values)) for name, values, center in columns
    )
    shown = _body(model, model.mesh.ndim, cells, _reference("Topology"), _reference("Geometry"))
    shown += "".join(
        _attribute(name, values, center, _reference(f"Attribute[{k}]"))
        for k, (name, values, center) in enumerate(columns, 1)
    )
    tree = (
        '<Grid Name="all" GridType="Tree">\n<Grid '
        f'Name="mesh">\n{TIME_ELEMENT}{shown}</Grid>\n{others}</Grid>\n'
    )
    tree = f'<Information Name="grids">{INFORMATION_TEXT}\n{tree}</Information>\n'
    texts = "".join(_information(*each) for each in named)
    return (
        '<Grid Name="mesh" GridType="Uniform" '
        f'Reference="{TREE_PATH}">\n{texts}{whole}{tree}</Grid>\n'
    )


def _cell_grid(model: Model) -> str:
    """Return the grid of cells in sets; if they have labels, a tag is the label."""
    combined = tag_sets(model.sets.cells)
    if group_labels(model) is not None:
        part, _ = number_parts(model._replace(materials=None, sets=Sets({}, model.sets.cells)))
        combined = Tagged(combined.items, part.entities[combined.items], part.sets)
    return _tag_grid("cells", model, model.mesh.ndim, elements(model)[1][combined.items], combined)


def _facet_grid(model: Model) -> str:
    """Return the grid of facets in sets, with those that a set holds from the other side."""
    sets = model.sets.facets
    scale = (model.mesh.ndim + 1, 1)
    listed = facet_tags(model.mesh, sets).items @ scale
    turned = {
        f"{name} turned": others
        for name, members in sets.items()
        if len(others := members[~np.isin(members @ scale, listed)])
    }
    combined = facet_tags(model.mesh, sets | turned)
    nodes = element_facets(elements(model)[1], combined.items)
    return _tag_grid("facets", model, model.mesh.ndim - 1, nodes, combined)


def _tag_grid(name: str, model: Model, dim: int, nodes: Ints, combined: Tagged) -> str:
    named = "".join(
        _information(each, " ".join(map(str, those))) for each, those in combined.tags_of.items()
    )
    body = _body(model, dim, nodes, _item(nodes), _reference("Geometry"))
    tags = _attribute(name, combined.tags, "Cell", _item(combined.tags))
    return f'<Grid Name="{name}" GridType="Uniform">\n{named}{TIME_ELEMENT}{body}{tags}</Grid>\n'


def _body(model: Model, dim: int, nodes: Ints, node_item: str, point_item: str) -> str:
    return (
        f"<Topology TopologyType={TOPOLOGY_TYPES[dim, model.order]} "
        f'NumberOfElements="{len(nodes)}">\n'
        f"{node_item}</Topology>\n"
        f'<Geometry GeometryType="{GEOMETRY_TYPES[model.mesh.ndim]}">\n{point_item}</Geometry>\n'
    )


def _attribute(name: str, values: NDArray, center: str, item: str) -> str:
    return (
        f'<Attribute Name="{xml_attribute(name)}" '
        f'AttributeType="{ROW_TYPES[values.shape[1:]]}" '
        f'Center="{center}" Dimensions="{_sizes(values)}">\n{item}</Attribute>\n'
    )


def _reference(part: str) -> str:
    """Return a reference to an item of the domain's grid.

    XInclude, as dolfinx writes it, is not used: VTK 9.7 crashes on dolfinx's address for it.
    """
    return f'<DataItem Reference="XML">/Xdmf/Domain/Grid/{part}/DataItem</DataItem>\n'


def _sizes(values: NDArray) -> str:
    return " ".join(map(str, values.shape))


def _item(values: NDArray) -> str:
    is_float = values.dtype.kind == "f"
    exact = values.astype(np.float64 if is_float else np.int64)
    return (
        f'<DataItem Dimensions="{_sizes(values)}" NumberType="{"Float" if is_float else "Int"}" '
        f'Precision="8" Format="XML">\n{rows(exact)}</DataItem>\n'
    )


def _information(name: str, value: str) -> str:
    return (
        f'<Information Name="{xml_attribute(name)}" '
        f'Value="{xml_attribute(value)}">{INFORMATION_TEXT}</Information>\n'
    )
