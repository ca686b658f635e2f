"""Mmg (Dapogny, Dobrzynski, Frey, J. Comput. Phys. 262, 2014) through mmgpy, on a lattice with a
label for each cell.

The lattice is finer than the result, so that its cells resolve the labels; Mmg then smooths the
interfaces within a Hausdorff distance and coarsens the cells, which keep their labels.
"""

from __future__ import annotations

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides
from tetopt.geometry.quadratic import node_count
from tetopt.geometry.simplex import orient_cells
from tetopt.image import Image
from tetopt.measure.fidelity import cell_labels
from tetopt.mesh import Mesh
from tetopt.start.lattice import lattice_mesh
from tetopt.study.endings import import_peer
from tetopt.study.search import Response, corners_for, is_near, tries
from tetopt.study.tetwild import Filled, node_spacing
from tetopt.system.arrays import Floats, Ints

LATTICE_EDGE = 0.6  # edge of the lattice's cubes over that of regular cells
# distance of the interfaces from the lattice's, over the edge of regular cells
HAUSDORFF_FRACTION = 0.2
MMG_RUNS = 6  # of one search, at most
FIRST_FACTOR = 2.0  # interfaces take more nodes
# measured slopes are -1 to -4
MMG_RESPONSE = Response(-2.5, -4.0, -1.0, step=1.5, after_failure=0.83)


def remesh_image(
    image: Image, labels: Image, nodes: int, order: int, smoothing: float
) -> tuple[Filled, Ints]:
    """Fill the image's box with about `nodes` nodes, and with cells that keep labels.

    One factor scales the lattice, the edges and the Hausdorff distance. It is searched, by secants,
    until the number of nodes is within 5 % of the requested one, in at most 6 runs; the closest is
    used.

    Parameters
    ----------
    image, labels : Image
        3-D, on the same voxels; the box is filled exactly.
    nodes : int
        Requested number of nodes, 8 or more.
    order : {1, 2}
        Order of the cells whose nodes are counted.
    smoothing : float
        Factor on the Hausdorff distance.

    Returns
    -------
    Filled, (M,) int64
        Mesh in the world, and the label of each cell.

    Raises
    ------
    InputError
        mmgpy is not installed; Mmg built no mesh.
    """
    mmgpy = import_peer("mmgpy")
    spacing = node_spacing(image, corners_for(nodes, order))

    def run(factor: float) -> tuple[Mesh, Ints]:
        edge = factor * spacing
        lattice = lattice_mesh(image, spacing=edge * LATTICE_EDGE)
        values, rows = np.unique(cell_labels(labels, lattice), return_inverse=True)
        mesh = mmgpy.MmgMesh3D()
        mesh.set_mesh_size(vertices=len(lattice.points), tetrahedra=len(lattice.cells))
        mesh.set_vertices(lattice.points)
        # 0 stands for none
        mesh.set_tetrahedra(lattice.cells.astype(np.int32), rows.astype(np.int32) + 1)
        try:
            mesh.remesh(hsiz=edge, hausd=HAUSDORFF_FRACTION * smoothing * edge, verbose=-1)
        except RuntimeError as error:
            raise InputError(
                f"mmg: built no mesh ({error}); request another number of nodes"
            ) from error
        cells, numbers = mesh.get_tetrahedra_with_refs()
        points = _on_box(image, np.asarray(mesh.get_vertices(), dtype=np.float64))
        return Mesh(points, orient_cells(points, np.asarray(cells, dtype=np.int64))), values[
            np.ravel(numbers) - 1
        ]

    runs = tries(
        run,
        lambda made: node_count(made[0].points, made[0].cells, order),
        nodes,
        MMG_RESPONSE,
        first=FIRST_FACTOR,
        most=MMG_RUNS,
    )
    best = runs[0]
    is_missed = not is_near(best.n_nodes, nodes)
    notes = (
        [f"{best.n_nodes} nodes after {len(runs)} runs of Mmg; requested: {nodes}"]
        if is_missed
        else []
    )
    return Filled(
        best.result[0], len(runs), sum(each.seconds for each in runs[1:]), notes
    ), best.result[1]


def _on_box(image: Image, points: Floats) -> Floats:
    """Put the nodes of the box's faces onto them, to the last bit."""
    index = image.to_index(points)
    for side in box_sides(image.shape).T:
        index = np.where(np.abs(index - side) < ON_SIDE_VOXELS, side, index)
    return image.to_world(index)
