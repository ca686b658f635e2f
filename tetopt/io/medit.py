"""Meshes for medit (INRIA) and what reads its files: FreeFEM, Mmg, SfePy, libMeshb.

A tetrahedron (in 2-D a triangle) has one reference. So there is one for each combination of a material and cell sets,
by material: the material's number from 1 where no set divides one. A triangle's (in 2-D an edge's) stands in the same
way for a combination of facet sets, inside the mesh, too; a facet that two sets hold from opposite sides is turned as
in the first of them. Comments at the head tell the names that each reference stands for, coordinates, units, each
material's constants, and the loads. Vertices have the reference 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.io.tags import cell_tags, facet_tags, remarks, tag_lines, without_data
from tetopt.io.text import comment_lines, rows
from tetopt.model.model import Model, element_facets, elements

ELEMENT_KEYWORDS = {1: "Edges", 2: "Triangles", 3: "Tetrahedra"}


def medit(model: Model) -> bytes:
    """A .mesh file in double precision; see the module for what is where.

    Nodes, elements and their order are those of the mesh. There is no cell data, nor data at the nodes.

    Raises
    ------
    InputError
        A cell set that is called as a material is.
    """
    mesh = model.mesh
    points, nodes = elements(model)
    in_cells, on_facets = cell_tags(model), facet_tags(mesh, model.sets.facets)
    cells, sides = (f"{ELEMENT_KEYWORDS[dim]}{'P2' if model.order == 2 else ''}" for dim in (mesh.ndim, mesh.ndim - 1))
    comments = [*remarks(model), *without_data(model)]
    comments += tag_lines(in_cells.tags_of, f"{cells} ref") + tag_lines(on_facets.tags_of, f"{sides} ref")
    return "".join(
        [
            "MeshVersionFormatted 2\n\n",
            comment_lines(comments, "# "),
            f"\nDimension {mesh.ndim}\n",
            _section("Vertices", points, np.zeros(len(points), dtype=np.int64)),
            _section(cells, nodes + 1, in_cells.tags),
            _section(sides, element_facets(nodes, on_facets.items) + 1, on_facets.tags),
            "\nEnd\n",
        ]
    ).encode("utf-8", "backslashreplace")


def _section(keyword: str, values: NDArray, refs: NDArray[np.int64]) -> str:
    return f"\n{keyword}\n{len(values)}\n{rows(values, refs)}"
