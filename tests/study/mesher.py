"""A mesher as a program of its own: what `tetopt compare --pipeline` runs in the tests.

    python mesher.py KIND IMAGE LABELS NODES OUTPUT [LOG]

It makes a lattice of the image's box with two thirds of the nodes; KIND says what goes wrong: nothing ("fine"), the
boundary lies half a voxel outside of the box ("wide"), there with a flat cell over a node ("rough"), or far inside it
("small"), it makes the same mesh whatever it
is asked for ("stubborn"), it ends without a mesh ("none"), with a message ("fails"), only at the second run
("once"), or writes a mesh of triangles ("flat"). With "labelled" in it the cells
have labels, 0 and 1 in turn, and every second one 99.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

import tetopt
from tetopt.geometry.simplex import oriented, volumes
from tetopt.geometry.topology import boundary_facets


def main(kind, image_path, labels_path, nodes, output, log=None):
    if log is not None:
        with open(log, "a") as lines:
            lines.write(f"{nodes} {np.unique(tetopt.load_image(labels_path).data).astype(int).tolist()}\n")
    if kind == "none":
        return
    if kind == "fails" or (kind == "once" and Path(output).with_name("done").exists()):
        sys.exit("warming up\nthe mesher's own words")
    Path(output).with_name("done").touch()
    image = tetopt.load_image(image_path)
    mesh = tetopt.lattice_mesh(image, nodes=400 if kind == "stubborn" else round(2 / 3 * int(nodes)))
    if kind == "flat":
        mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    if kind in ("wide", "rough", "rough-labelled", "small"):
        middle = (np.array(image.shape) - 1) / 2
        factor = (np.array(image.shape) + (-6 if kind == "small" else 1)) / image.shape
        mesh = tetopt.Mesh(image.to_world(middle + factor * (image.to_index(mesh.points) - middle)), mesh.cells)
    if kind.startswith("rough"):  # a node on a side goes in, and the hole that this leaves is filled by flat cells
        mesh = covered(mesh)
    number = np.arange(len(mesh.cells))
    labels = {"label": np.where(number % 2 == 0, number // 2 % 2, 99)} if "labelled" in kind else {}
    tetopt.save_mesh(output, mesh, labels)


def covered(mesh):
    """The mesh with a node on its lowest side a little further in, and under it cells that fill the dent."""
    points = mesh.points.copy()
    low = points[:, 2].min()
    middle = points[:, :2].mean(axis=0)
    on_side = np.flatnonzero(points[:, 2] == low)
    node = on_side[np.argmin(np.linalg.norm(points[on_side, :2] - middle, axis=1))]
    points[node, 2] += 2e-4
    facets = boundary_facets(mesh.cells)
    around = facets[(facets == node).any(axis=1)]
    rim = np.unique(around[around != node])
    turns = np.arctan2(*(points[rim, :2] - points[node, :2]).T)
    rim = rim[np.argsort(turns)]
    fans = [np.roll(rim, -k) for k in range(len(rim))]  # from a corner of the rim two of its triangles have no area
    lids = [np.array([[node, fan[0], *pair] for pair in pairwise(fan[1:])]) for fan in fans]
    best = max(lids, key=lambda cells: np.abs(volumes(points, cells)).min())
    cells = np.vstack([mesh.cells, best])
    return tetopt.Mesh(points, oriented(points, cells))


if __name__ == "__main__":
    main(*sys.argv[1:])
