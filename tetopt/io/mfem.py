"""Meshes for MFEM and programs based on it: mesh format v1.3, with named sets of attributes (read
by MFEM 4.10).

An element has one attribute, a number of `tetopt.io.tags.number_parts`: its label, or without
labels its material's number. If materials or cell sets divide a label, each part has its own
attribute. The named sets of the labels, "material_1", ... and those of the cell sets list their
attributes. Similarly, the attribute of a boundary element represents a combination of facet sets.
Facets inside the mesh that are in a set are boundary elements, too, as MFEM allows; one that two
sets hold from opposite sides is oriented as in the first of them.

A mesh of order 2 has a nodal function of MFEM's quadratic H1 space, as created by
`Mesh::SetCurvature(2)`: vertices, then the middles of edges in the order of their first occurrence
in the elements. MFEM treats elements with such a function as curved, as those on interfaces may be.

The comments in the header list coordinates, units, each material's constants and attributes, and
the loads. `mesh.bdr_attribute_sets.GetAttributeSetMarker(name)` returns the marker of a boundary
condition.
"""

from __future__ import annotations

import numpy as np

from tetopt.io.tags import all_sets, number_parts, part_comments
from tetopt.io.text import blocks, rows
from tetopt.mesh import Mesh
from tetopt.model.model import Model
from tetopt.model.sets import facet_triples
from tetopt.system.arrays import Ints

# MFEM's numbers of simplices by dimension: segment, triangle, tetrahedron
ELEMENT_GEOMETRIES = {1: 1, 2: 2, 3: 4}
# Local corners of an element's edges in MFEM's order (fem/geom.cpp), by dimension.
ELEMENT_EDGES = {
    2: np.array([(0, 1), (1, 2), (2, 0)]),
    3: np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]),
}


def mfem(model: Model) -> bytes:
    """Return an MFEM mesh file; the module describes its layout.

    Nodes, elements and their order are those of the mesh. The file has no cell data or point data.

    Raises
    ------
    InputError
        For the reasons of `tetopt.io.tags.number_parts`.
    """
    mesh = model.mesh
    in_cells, on_facets = number_parts(model)
    cell_sets = all_sets(in_cells)
    return "".join(
        [
            "MFEM mesh v1.3\n\n",
            part_comments(
                model, in_cells, on_facets, "attribute", "attribute", "boundary attribute"
            ),
            f"\ndimension\n{mesh.ndim}\n",
            "\nelements\n",
            _elements(in_cells.entities, mesh.ndim, mesh.cells),
            "\nattribute_sets\n",
            _sets(cell_sets),
            "\nboundary\n",
            _elements(on_facets.entities, mesh.ndim - 1, facet_triples(mesh.cells, on_facets.rows)),
            "\nbdr_attribute_sets\n",
            _sets(on_facets.sets),
            f"\nvertices\n{len(mesh.points)}\n",
            f"{mesh.ndim}\n{rows(mesh.points)}" if model.order == 1 else _nodes(mesh),
            "\nmfem_mesh_end\n",
        ]
    ).encode("utf-8", "backslashreplace")


def _elements(attributes: Ints, dim: int, nodes: Ints) -> str:
    return f"{len(nodes)}\n" + rows(attributes, np.full(len(nodes), ELEMENT_GEOMETRIES[dim]), nodes)


def _nodes(mesh: Mesh) -> str:
    """Return the nodal function of order 2, node by node."""
    ends = np.sort(mesh.cells[:, ELEMENT_EDGES[mesh.ndim]], axis=2).reshape(-1, 2)
    _, first, number = np.unique(
        ends[:, 0] * len(mesh.points) + ends[:, 1], return_index=True, return_inverse=True
    )
    straight = mesh.points[ends[np.sort(first)]].mean(axis=1)
    middles = straight if mesh.midpoints is None else mesh.midpoints[number.ravel()[np.sort(first)]]
    head = (
        f"FiniteElementSpace\nFiniteElementCollection: H1_{mesh.ndim}D_P2\nVDim: "
        f"{mesh.ndim}\nOrdering: 1\n"
    )
    return f"\nnodes\n{head}\n{rows(np.concatenate([mesh.points, middles]))}"


def _sets(tags_of: dict[str, list[int]]) -> str:
    """Return the number of sets, then the name, the number of attributes and the attributes of
    each.
    """
    lists = (f'"{name}"\n{len(tags)}\n{blocks(np.array(tags))}' for name, tags in tags_of.items())
    return f"{len(tags_of)}\n" + "".join(lists)
