"""What curved edges win: distance from a sphere, and volumes of labels, with straight and with
curved cells.

    python benchmarks/curved_cells.py -o curved.json [LABELS.nii.gz]

The labels of a sphere of 20 mm on voxels of 1 mm are meshed with order 2, and so is the image of
labels, if named. The distance is the mean over the facets between labels, at the seven points of
Radon's rule; volumes are relative to the voxels'. Straight cells are the same cells with their
midpoints removed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import tetopt
from tetopt.geometry.quadratic import curved_rule, quadratic, shape_slopes, shape_values
from tetopt.geometry.topology import facets
from tetopt.system.files import check_output, save_json

RADIUS, HALF = 20.0, 32  # of the sphere, mm; and half of its image, voxels of 1 mm
NODES, NODES_OF_LABELS = (3_000, 8_000), 5_000  # in all


def sphere() -> tetopt.Image:
    """Label 1 within the sphere, 0 around it."""
    centre = np.stack(np.meshgrid(*3 * [np.arange(2 * HALF) - HALF + 0.5], indexing="ij"))
    return tetopt.Image(
        (np.sqrt((centre**2).sum(axis=0)) < RADIUS).astype(float), origin_at_centre()
    )


def origin_at_centre() -> np.ndarray:
    """Affine (4, 4) that puts the sphere's centre at 0."""
    affine = np.eye(4)
    affine[:3, 3] = 0.5 - HALF
    return affine


def meshed(labels: tetopt.Image, nodes: int) -> tuple[tetopt.Mesh, np.ndarray]:
    """The mesh of order 2 of labels, and the label of each cell."""
    result = tetopt.mesh_image(tetopt.content(labels, labels, weights=[0.0]), nodes, order=2)
    return result.mesh, np.asarray(result.labels)


def distance(mesh: tetopt.Mesh, label: np.ndarray, is_curved: bool) -> float:
    """Mean distance between the sphere and the facets between labels, mm."""
    nodes, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints if is_curved else None)
    sides = facets(mesh.cells)
    shared = np.flatnonzero(
        (sides.cells[:, 1] >= 0) & (label[sides.cells[:, 0]] != label[sides.cells[:, 1]])
    )
    cell = sides.cells[shared, 0]
    opposite = np.argmax(sides.of_cell[cell] == shared[:, None], axis=1)
    points, weights = curved_rule(2)
    off, area = np.empty((2, len(shared), len(points)))
    for corner in range(4):
        here = opposite == corner
        places = np.insert(points, corner, 0.0, axis=1)
        own = nodes[cells[cell[here]]]
        at = np.einsum("qa,mai->mqi", shape_values(places, 2), own)
        off[here] = np.abs(np.linalg.norm(at, axis=2) - RADIUS)
        a, b, c = np.delete(
            np.einsum("qak,mai->kmqi", shape_slopes(places, 2), own), corner, axis=0
        )
        # per area of the flat reference, at each point
        area[here] = np.linalg.norm(np.cross(b - a, c - a), axis=2)
    return float(np.average(off, weights=area * weights))


def main(argv: list[str] | None = None) -> None:
    """Mesh, measure, save the rows and print them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("labels", type=Path, nargs="?", metavar="LABELS.nii.gz")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="JSON file for every number"
    )
    options = parser.parse_args(argv)
    output = check_output(options.output, (".json",), True)
    rows, kinds = dict[str, object](), {"straight": False, "curved": True}
    for nodes in NODES:
        mesh, label = meshed(sphere(), nodes)
        off = {kind: distance(mesh, label, curved) for kind, curved in kinds.items()}
        rows[f"distance from the sphere, mm, {nodes} nodes"] = off
    if options.labels is not None:
        image = tetopt.load_image(options.labels)
        mesh, label = meshed(image, NODES_OF_LABELS)
        of_voxels = np.bincount(image.data.astype(int).ravel()) * np.prod(image.spacing)
        rows["volumes of labels, relative to the voxels' and less 1"] = {
            kind: (np.bincount(label, each.cell_volumes) / of_voxels - 1.0)[1:].tolist()
            for kind, each in (("straight", tetopt.Mesh(mesh.points, mesh.cells)), ("curved", mesh))
        }
    save_json(output, rows)
    for name, row in rows.items():
        print(f"{name}: {row}")


if __name__ == "__main__":
    main()
