"""Displacement error of meshes of a head under shear, beside an element to every voxel of the same labels.

    python head_shear.py LABELS.nii.gz MESH.vtu ... [--young 1=2,2=2.5,3=0.02,...] [--nu 0.45] [-o SHEAR.json]

LABELS fills its box: air is a label, too. The top of the box is fixed, its bottom moves along the first axis by 2 % of
the height. Each MESH has `label` in its cells, and its nodes within `--near` mm of the two faces are held: meshes of
other programs do not lie on them to the last bit. Told for each mesh and order: the root mean square of the error over
the voxels of the labels of `--judged`, over that of the reference less the same of one modulus everywhere.
"""

import argparse
import json
from pathlib import Path

import numpy as np

import tetopt
from tetopt.energy.sampling import cell_of_voxel
from tetopt.fem.elasticity import compression, elements_of
from tetopt.fem.reference import _compressed, _displacements, _places, at_centres
from tetopt.geometry.topology import facets

SHEAR_FRACTION = 0.02


def plates(image: tetopt.Image, mesh: tetopt.Mesh, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes on the boundary near the top and the bottom of the box."""
    made = facets(mesh.cells)
    outer = np.unique(made.nodes[made.cells[:, 1] < 0])
    height = image.to_index(mesh.points[outer])[:, 2]
    way = near / image.spacing[2]
    return outer[height > image.shape[2] - 0.5 - way], outer[height < -0.5 + way]


def main() -> None:
    """Solve the reference and each mesh, and print the errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("labels")
    parser.add_argument("meshes", nargs="+")
    parser.add_argument("--young", default="1=2,2=2.5,3=0.02,4=200,5=5,6=0.002", help="kPa by label")
    parser.add_argument("--nu", type=float, default=0.45)
    parser.add_argument("--judged", default="1,2,3")
    parser.add_argument("--near", type=float, default=0.75)
    parser.add_argument("--orders", default="1,2")
    parser.add_argument("-o", "--output")
    options = parser.parse_args()
    image = tetopt.load_image(options.labels)
    young = {int(k): float(v) for k, v in (pair.split("=") for pair in options.young.split(","))}
    of_label = np.zeros(max(young) + 1)
    of_label[list(young)] = list(young.values())
    labels = image.data.astype(np.int64)
    modulus = tetopt.Image(of_label[labels], image.affine)
    push = np.array([SHEAR_FRACTION * image.spacing[2] * image.shape[2], 0.0, 0.0])
    u_ref, work = _compressed(modulus, options.nu, push)
    u_even, _ = _compressed(tetopt.Image(np.ones(image.shape), image.affine), options.nu, push)
    print(f"reference: {work}", flush=True)
    is_judged = np.isin(labels.ravel(), [int(k) for k in options.judged.split(",")])
    rows = []
    for path in options.meshes:
        file = tetopt.load_mesh(path)
        mesh = tetopt.Mesh(file.mesh.points, file.mesh.cells)
        of_cell = np.asarray(file.cell_data["label"]).astype(np.int64)
        top, bottom = plates(image, mesh, options.near)
        owner = cell_of_voxel(image, mesh).ravel()
        inside = np.flatnonzero((owner >= 0) & is_judged)
        there = at_centres(image, u_ref, inside)[0]
        scale = ((there - at_centres(image, u_even, inside)[0]) ** 2).sum()
        for order in map(int, options.orders.split(",")):
            made = compression(
                mesh,
                of_label[of_cell],
                options.nu,
                fixed_nodes=top,
                pushed_nodes=bottom,
                displacement=push,
                order=order,
            )
            elements = elements_of(mesh, order)
            found = _displacements(
                elements, order, made.u, owner[inside], _places(image, elements, owner[inside], inside)
            )
            error = float(np.sqrt(((found - there) ** 2).sum() / scale))
            row = {"mesh": Path(path).name, "nodes": len(mesh.points), "order": order, "displacement": error}
            row["covered"] = float((owner >= 0).mean())
            print(json.dumps(row), flush=True)
            rows.append(row)
    if options.output:
        Path(options.output).write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
