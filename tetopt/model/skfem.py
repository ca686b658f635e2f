"""Conversion of meshes with their sets to scikit-fem, without a file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tetopt.mesh import Mesh
from tetopt.model.sets import Sets
from tetopt.system.arrays import Ints

if TYPE_CHECKING:
    import skfem


def skfem_mesh(mesh: Mesh, sets: Sets) -> skfem.Mesh:
    """Convert a mesh with its sets to scikit-fem.

    Nodes and cells keep their order, so that cell data, such as `young[of_cell]` of the materials,
    remain valid; scikit-fem sorts the three nodes of a triangle, though. Facet sets become
    `boundaries`; those with facets between two cells become an `OrientedBoundary`, whose normals
    point out of the cells in the set. Cell sets become `subdomains`. A 2-D mesh becomes a
    `MeshTri`, a 3-D one a `MeshTet`.

    Raises
    ------
    InputError
        scikit-fem is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> from tetopt import Mesh
    >>> from tetopt.model.sets import standard_sets
    >>> mesh = Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    >>> converted = skfem_mesh(mesh, standard_sets(mesh, labels=np.array([7])))
    >>> converted.p[:, converted.facets[:, converted.boundaries["x_min"]]].tolist()
    [[[0.0], [0.0]], [[0.0], [1.0]]]
    >>> converted.subdomains["label_7"].tolist()
    [0]
    """
    bare = mesh.to_skfem()
    boundaries = {name: _boundary(bare, mesh.cells, rows) for name, rows in sets.facets.items()}
    subdomains = {name: cells.copy() for name, cells in sets.cells.items()}
    return bare.with_boundaries(boundaries).with_subdomains(subdomains)


def _boundary(mesh: skfem.Mesh, cells: Ints, rows: Ints) -> NDArray[np.integer]:
    """Return scikit-fem's numbers of the facets (K, 2)."""
    from skfem.generic_utils import OrientedBoundary

    cell = rows[:, 0]
    node = cells[rows[:, 0], rows[:, 1]]
    of_cell = mesh.t2f[:, cell]  # (n+1, K)
    is_opposite = (mesh.facets[:, of_cell] != node).all(axis=0)
    numbers = of_cell[is_opposite.argmax(axis=0), np.arange(len(rows))]
    if (mesh.f2t[1, numbers] < 0).all():
        return numbers
    return OrientedBoundary(numbers, (mesh.f2t[0, numbers] != cell).astype(np.int64))
