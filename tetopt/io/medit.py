"""Meshes for medit (INRIA) and programs that read its files: FreeFEM, Mmg, SfePy, libMeshb.

A tetrahedron (in 2-D a triangle) has one reference, a number of `tetopt.io.tags.number_parts`:
its label, or without labels its material's number. If materials or cell sets divide a label, each
part has its own reference. Similarly, the reference of a triangle (in 2-D an edge) represents a
combination of facet sets, also inside the mesh; a facet that two sets hold from opposite sides is
oriented as in the first of them. Comments in the header list the names of each reference,
coordinates, units, each material's constants, and the loads. Vertices have the reference 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.io.tags import number_parts, part_comments
from tetopt.io.text import rows
from tetopt.model.model import Model, element_facets, elements
from tetopt.system.arrays import Ints

ELEMENT_KEYWORDS = {1: "Edges", 2: "Triangles", 3: "Tetrahedra"}


def medit(model: Model) -> bytes:
    """Return a .mesh file in double precision; the module describes its layout.

    Nodes, elements and their order are those of the mesh. The file has no cell data or point data.

    Raises
    ------
    InputError
        For the reasons of `tetopt.io.tags.number_parts`.
    """
    mesh = model.mesh
    points, nodes = elements(model)
    in_cells, on_facets = number_parts(model)
    cells, sides = (
        f"{ELEMENT_KEYWORDS[dim]}{'P2' if model.order == 2 else ''}"
        for dim in (mesh.ndim, mesh.ndim - 1)
    )
    return "".join(
        [
            "MeshVersionFormatted 2\n\n",
            part_comments(model, in_cells, on_facets, "reference", f"{cells} ref", f"{sides} ref"),
            f"\nDimension {mesh.ndim}\n",
            _section("Vertices", points, np.zeros(len(points), dtype=np.int64)),
            _section(cells, nodes + 1, in_cells.entities),
            _section(sides, element_facets(nodes, on_facets.rows) + 1, on_facets.entities),
            "\nEnd\n",
        ]
    ).encode("utf-8", "backslashreplace")


def _section(keyword: str, values: NDArray, refs: Ints) -> str:
    return f"\n{keyword}\n{len(values)}\n{rows(values, refs)}"
