"""Onto cells and back: the error of a stiffness map on an oblique, anisotropic grid of its own.

    python benchmarks/stiffness_map.py MR.nii.gz [NODES ...]

The map is that of an elastography of the image's content: stiffness follows the image, blurred to
the map's voxels, with a stiff lesion and 10 % of noise. Its values go onto the cells of a mesh of
the image by three ways, and back to the map's voxels in the mesh: the average over the map's voxels
in each cell (`build_model`, mean), the voxel nearest to each cell's centroid, and linear between
voxel centres at the nodes, as solvers sample images: then linear in cells, or the mean of a cell's
corners. Printed is the root mean square of the differences from the map, and from the map without
noise, relative to the map's mean.
"""

import sys

import numpy as np
import scipy

import tetopt
from tetopt.energy.sampling import linear_values, nearest_values
from tetopt.model.build import build_model

SPACING = (1.2, 1.0, 1.8)  # mm, of the map
NOISE = 0.1  # of the stiffness


def stiffness_map(image, seed=0):
    """The map, kPa, with and without noise, as images around the middle of `image`."""
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", [20, -15, 35], degrees=True)
    shape = tuple(
        int(1.6 * n * s / d) for n, s, d in zip(image.shape, image.spacing, SPACING, strict=True)
    )
    affine = np.eye(4)
    affine[:3, :3] = turn.as_matrix() * SPACING
    middle = image.to_world((np.array(image.shape) - 1) / 2)
    affine[:3, 3] = middle - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    centres = tetopt.Image(np.zeros(shape), affine).to_world(np.indices(shape).reshape(3, -1).T)
    blur = np.mean(SPACING) / 2 / image.spacing
    smooth = tetopt.Image(scipy.ndimage.gaussian_filter(image.data, blur), image.affine)
    low, high = np.percentile(image.data, [2, 98])
    clean = 2.0 + 6.0 * np.clip((linear_values(smooth, centres) - low) / (high - low), 0, 1)
    clean[((centres - middle - [3, 2, 0]) ** 2).sum(axis=1) < 4.0**2] += 10.0
    noise = np.random.default_rng(seed).normal(1.0, NOISE, len(clean))
    return [tetopt.Image(v.reshape(shape), affine) for v in (clean * noise.clip(0.3), clean)]


def errors(image, nodes, seed=0):
    """The errors of the ways, by name: against the map, and against the map without noise."""
    mesh = tetopt.mesh_image(image, nodes).mesh
    mu, clean = stiffness_map(image, seed)
    at_nodes = linear_values(mu, mesh.points)
    model = build_model(mesh, young="mu", fields={"mu": mu}, average="mean", cell_data={})
    ways = {
        "mean of voxels": model.materials.young[model.materials.of_cell],
        "nearest voxel": nearest_values(mu, mesh.points[mesh.cells].mean(axis=1)),
        "linear at nodes, in cells": at_nodes,
        "linear at nodes, mean of corners": at_nodes[mesh.cells].mean(axis=1),
    }
    owned = tetopt.cell_of_voxel(mu, mesh) >= 0
    result = {}
    for name, values in ways.items():
        back = tetopt.field_on_image(mesh, values, mu)[owned]
        result[name] = [
            np.sqrt(np.mean((back - each.data[owned]) ** 2)) / clean.data[owned].mean()
            for each in (mu, clean)
        ]
    return len(mesh.points), len(mesh.cells), int(owned.sum()), result


if __name__ == "__main__":
    meshed = tetopt.load_image(sys.argv[1])
    for count in [int(text) for text in sys.argv[2:]] or [2000]:
        n_nodes, n_cells, n_voxels, rows = errors(meshed, count)
        print(f"{n_nodes} nodes, {n_cells} cells, {n_voxels} voxels of the map")
        for way, (of_map, of_clean) in rows.items():
            print(f"  {way:34} {of_map:.4f} {of_clean:.4f}")
