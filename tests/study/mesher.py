"""A mesher as a program of its own: what `tetopt compare --pipeline` runs in the tests.

    python mesher.py KIND IMAGE LABELS NODES OUTPUT [LOG]

It makes a lattice of the image's box with two thirds of the nodes; KIND says what goes wrong: nothing ("fine"), the
boundary lies half a voxel outside of the box ("wide"), or far inside it ("small"), it makes the same mesh whatever it
is asked for ("stubborn"), it ends without a mesh ("none"), with a message ("fails"), only at the second run
("once"), or writes a mesh of triangles ("flat").
"""

import sys
from pathlib import Path

import numpy as np

import tetopt


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
    mesh = tetopt.lattice(image, nodes=400 if kind == "stubborn" else round(2 / 3 * int(nodes)))
    if kind == "flat":
        mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    if kind in ("wide", "small"):
        middle = (np.array(image.shape) - 1) / 2
        factor = (np.array(image.shape) + (1 if kind == "wide" else -6)) / image.shape
        mesh = tetopt.Mesh(image.to_world(middle + factor * (image.to_index(mesh.points) - middle)), mesh.cells)
    tetopt.save_mesh(output, mesh)


if __name__ == "__main__":
    main(*sys.argv[1:])
