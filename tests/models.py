"""One model for the tests of every format: materials, overlapping sets, a load, labels, an oblique box."""

from functools import cache

import numpy as np

import tetopt
from tetopt.geometry.simplex import volumes
from tetopt.model.loads import parse_loads
from tetopt.model.materials import binned, materials
from tetopt.model.model import Model
from tetopt.model.sets import box_of, standard_sets, with_requested

ABOUT = {"tetopt": "0.1.0", "image": "two spheres & <more>.nii.gz", "image_sha256": "ab" * 32}


@cache
def sample_image(n=3):
    """Two values with a gradient, turned and shifted in the world."""
    shape = (9, 8, 7)[:n]
    index = np.stack(np.meshgrid(*(np.arange(s) for s in shape), indexing="ij"), axis=-1)
    ball = ((index - np.array([4, 3, 3])[:n]) ** 2).sum(axis=-1) < 6
    affine = np.eye(n + 1)
    turn = np.array([[0.96, -0.28, 0.0], [0.28, 0.96, 0.0], [0.0, 0.0, 1.0]])[:n, :n]
    affine[:n, :n] = turn * np.array([2.0, 2.5, 3.0])[:n]
    affine[:n, n] = np.array([-31.7, 12.3, 101.1])[:n]
    return tetopt.Image(50.0 * ball + index.sum(axis=-1), affine)


@cache
def sample_model(n=3, bins=3):
    """A model in RAS and kPa with `bins` materials (None: as many as cells have), a compression by 5 %."""
    image = sample_image(n)
    mesh = tetopt.lattice(image, nodes=60)
    fields = tetopt.cell_fields(mesh, image)
    labels = (fields["mean"] > 25.0).astype(np.int64)
    fields["label"] = labels
    sets = standard_sets(mesh, box_of(image), labels)
    corner = ",".join(str(x) for x in mesh.points[0])
    sets = with_requested(mesh, sets, ["dark=below:20", f"corner=point:{corner}:12"], fields["mean"])
    made = materials(1.0 + fields["mean"] / 7.0, np.where(labels == 1, 0.3, 0.45), len(mesh.cells))
    if bins is not None:
        made = binned(made, volumes(mesh.points, mesh.cells), bins)
    loads = parse_loads(["compress:5%"], mesh, sets)
    return Model(mesh, fields, sets, made, loads, about=dict(ABOUT))
