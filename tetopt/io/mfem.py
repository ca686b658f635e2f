"""Meshes for MFEM and what is built on it: mesh format v1.3, with named sets of attributes (read by MFEM 4.10).

An element has one attribute. So there is one for each combination of a material and cell sets, by material: the
material's number where no set divides one. The named sets "material_1", ... and those of the cell sets tell which
attributes make them up. A boundary element's attribute stands in the same way for a combination of facet sets. Facets
inside the mesh that are in a set are boundary elements, too, as MFEM allows; one that two sets hold from opposite sides
is turned as in the first of them.

The comments at the head tell coordinates, units, each material's constants and attributes, and the loads.
`mesh.bdr_attribute_sets.GetAttributeSetMarker(name)` marks where a condition holds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.tags import cell_tags, facet_tags, remarks, tag_lines, without_data
from tetopt.io.text import blocks, rows
from tetopt.model.model import Model
from tetopt.model.sets import facet_triples

ELEMENT_GEOMETRIES = {1: 1, 2: 2, 3: 4}  # MFEM's numbers for the simplex of a dimension: segment, triangle, tetrahedron


def mfem(model: Model) -> bytes:
    """An MFEM mesh file; see the module for what is where.

    Nodes, elements and their order are those of the mesh. There is no cell data.

    Raises
    ------
    InputError
        A cell set that is called as a material is, or order 2: MFEM asks for the order when it makes its space.
    """
    if model.order != 1:
        raise InputError(
            "order 2: a MFEM mesh with straight edges has none, the solver's space does; leave out --order"
        )
    mesh = model.mesh
    in_cells, on_facets = cell_tags(model), facet_tags(mesh, model.sets.facets)
    comments = [*remarks(model), *without_data(model)]
    comments += tag_lines(in_cells.tags_of, "attribute") + tag_lines(on_facets.tags_of, "boundary attribute")
    return "".join(
        [
            "MFEM mesh v1.3\n\n",
            *(f"# {line}\n" for line in comments),
            f"\ndimension\n{mesh.ndim}\n",
            "\nelements\n",
            _elements(in_cells.tags, mesh.ndim, mesh.cells),
            "\nattribute_sets\n",
            _sets(in_cells.tags_of),
            "\nboundary\n",
            _elements(on_facets.tags, mesh.ndim - 1, facet_triples(mesh.cells, on_facets.items)),
            "\nbdr_attribute_sets\n",
            _sets(on_facets.tags_of),
            f"\nvertices\n{len(mesh.points)}\n{mesh.ndim}\n",
            rows(mesh.points),
            "\nmfem_mesh_end\n",
        ]
    ).encode()


def _elements(attributes: NDArray[np.int64], dim: int, nodes: NDArray[np.int64]) -> str:
    return f"{len(nodes)}\n" + rows(attributes, np.full(len(nodes), ELEMENT_GEOMETRIES[dim]), nodes)


def _sets(tags_of: dict[str, list[int]]) -> str:
    """How many, then of each the name, how many attributes, and which."""
    lists = (f'"{name}"\n{len(tags)}\n{blocks(np.array(tags))}' for name, tags in tags_of.items())
    return f"{len(tags_of)}\n" + "".join(lists)
