"""Whether the seams of a run in parts are seen in its mesh, beside one in one piece: `python
tests/parts/seams.py`.

A seam layer is where cells had a node that parts shared in a round, which stayed where it was then.
The error of each voxel there, its squared deviation from its cell's mean, is summed up in both
runs' meshes, and rho is averaged over the cells of its voxels. A layer of whole cells of one mesh
is where that mesh has large ones, as a voxel is sooner in a large cell: E_D over the other mesh's
is more than elsewhere by that alone. So what it is beside seams stands beside what it is in layers
of the same kind, along planes where no seam ever was.
"""

import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from parted import recorded_run, request, shared_nodes

import tetopt
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine.meshing import mesh_image
from tetopt.geometry.simplex import rho
from tetopt.parts.cut import ROUND_SHIFTS, Shared, counts_of, cut, joined
from tetopt.parts.part import PartSettings
from tetopt.parts.rounds import _weights

# Half-way between those of rounds.
OTHER_SHIFTS = tuple(shift + 0.125 for shift in ROUND_SHIFTS)


class Layer(NamedTuple):
    """What a mesh is like in some voxels."""

    E_D: float  # sum of squared deviations over them
    rho: float  # mean over them


def seam_layers(image, rounds):
    """Voxels of cells with a node that parts shared in a round and left where it was, (R,) and
    the image's shape.
    """
    result = []
    for parts in rounds:
        if parts[0].text["kind"] == "improve":
            mesh = joined(
                [part.after["ticks"] for part in parts], [part.after["cells"] for part in parts]
            )
            beside = shared_nodes(Shared(*mesh))[mesh.cells].any(axis=1)
            points = image.to_world(mesh.ticks * 2.0 ** -parts[0].text["settings"]["bits"])
            result.append(beside[cell_of_voxel(image, tetopt.Mesh(points, mesh.cells))])
    return np.array(result)


def other_layers(image, mesh, rounds):
    """Likewise of cells of the mesh along planes between those where parts met."""
    settings = PartSettings(**rounds[0][0].text["settings"])
    index = image.to_index(mesh.points)
    # As many along each axis as in the first round, which is not shifted.
    counts = counts_of(len(rounds[0]), tuple(image.spacing * image.shape))
    owner, result = cell_of_voxel(image, mesh), []
    for shift in OTHER_SHIFTS:
        part = cut(index[mesh.cells].mean(axis=1), _weights(index, mesh.cells), counts, shift)
        ticks = np.rint(index * 2.0**settings.bits).astype(np.int64)
        result.append(shared_nodes(Shared(ticks, mesh.cells, part))[mesh.cells].any(axis=1)[owner])
    return np.array(result)


def layer_of(image, mesh, is_there):
    """Of a mesh where voxels are true."""
    owner = cell_of_voxel(image, mesh).ravel()
    values = image.data.ravel().astype(np.float64)
    count = np.maximum(np.bincount(owner, minlength=len(mesh.cells)), 1)
    mean = np.bincount(owner, values, len(mesh.cells)) / count
    owner, values = owner[is_there.ravel()], values[is_there.ravel()]
    return Layer(
        float(((values - mean[owner]) ** 2).sum()),
        float(rho(mesh.points, mesh.cells)[owner].mean()),
    )


def beside_one_piece(image, mesh, one, is_there):
    """E_D over that of one piece, and rho less it, where voxels are true."""
    ours, other = layer_of(image, mesh, is_there), layer_of(image, one, is_there)
    return ours.E_D / other.E_D, ours.rho - other.rho


def compared(image, nodes, n_parts):
    """Numbers of a run in parts beside one in one piece, by name."""
    begin = time.process_time()
    one = mesh_image(image, nodes=nodes)
    middle = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        parted, rounds = recorded_run(Path(folder), image, request(nodes, n_parts))
    end = time.process_time()
    mesh = parted.result.mesh
    seams = seam_layers(image, rounds)
    others = other_layers(image, mesh, rounds)
    layers = {f"seams of round {number}": layer for number, layer in enumerate(seams, 1)}
    layers |= {
        f"other planes, {shift}": layer for shift, layer in zip(OTHER_SHIFTS, others, strict=True)
    }
    rhos = [rho(each.points, each.cells) for each in (mesh, one.mesh)]
    return {
        "nodes": len(mesh.points),
        "nodes of one piece": len(one.mesh.points),
        "cells": len(mesh.cells),
        "parts by round": [len(parts) for parts in rounds],
        "E_D over one piece": parted.result.history[-1].E_D / one.history[-1].E_D,
        "E over one piece": parted.result.history[-1].E / one.history[-1].E,
        "mean rho": float(rhos[0].mean()),
        "mean rho of one piece": float(rhos[1].mean()),
        "1st percentile of rho": float(np.percentile(rhos[0], 1)),
        "the same of one piece": float(np.percentile(rhos[1], 1)),
        "violated": dict(parted.result.violated),
        "CPU seconds": end - middle,
        "CPU seconds of one piece": middle - begin,
        "layers": {
            name: (float(layer.mean()), *beside_one_piece(image, mesh, one.mesh, layer))
            for name, layer in layers.items()
        },
    }


if __name__ == "__main__":
    from tetopt.io.images import load_image
    from tetopt.io.mni import mni_path

    words = [int(word) for word in sys.argv[1:]] or [40_000, 4]
    numbers = compared(load_image(mni_path("t1")), *words)
    for name, number in numbers.items():
        if name != "layers":
            print(f"{name:26} {number:.5g}" if isinstance(number, float) else f"{name:26} {number}")
    print(f"{'layer':22} voxels  E_D over one piece  rho less one piece's")
    for name, (fraction, E_D, rho_less) in numbers["layers"].items():
        print(f"{name:22} {fraction:6.3f}  {E_D:18.4f}  {rho_less:+.5f}")
