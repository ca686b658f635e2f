"""``tetopt warm-up``: compile all kernels in advance."""

from __future__ import annotations

import time

import numpy as np

from tetopt import (
    Image,
    InputError,
    cell_fields,
    cell_labels,
    label_fidelity,
    label_thickness,
    mask_fidelity,
    mesh_image,
)
from tetopt.cli.console import print_line
from tetopt.cli.run import compiling
from tetopt.contents.content import content
from tetopt.system.cache import place_cache
from tetopt.system.kernels import link, roots

BALL_VOXELS = 24  # along each axis of the meshed image: an octree of 300 nodes needs this many
BALL_NODES = {2: 60, 3: 300}  # by number of axes


def warm_up_command() -> int:
    """Compile all kernels in advance, for example for a container image; later runs load them
    from the cache.
    """
    place = place_cache()
    if place.notice is not None:
        raise InputError(f"warm-up cannot store compiled kernels: {place.notice}")
    begin = time.perf_counter()
    with compiling("compiling all kernels (a minute on two cores)") as progress:
        link(roots(), progress)
        for n in (3, 2):
            _mesh_balls(n)
    seconds = time.perf_counter() - begin
    print_line(f"all kernels are ready after {seconds:.0f} s, stored in {place.folder}")
    return 0


def _mesh_balls(n: int) -> None:
    """Build and measure tiny meshes of all kinds, which compiles functions that no kernel calls."""
    radius = np.sqrt(((np.indices((BALL_VOXELS,) * n) - 0.5 * (BALL_VOXELS - 1)) ** 2).sum(axis=0))
    balls = Image((radius < 0.4 * BALL_VOXELS) + 1.0 * (radius < 0.2 * BALL_VOXELS))
    nodes = BALL_NODES[n]
    mesh_image(Image(np.exp(-radius)), nodes, iterations=2)
    mesh_image(balls, nodes, mode="paper", iterations=2)
    inside = Image((radius < 0.45 * BALL_VOXELS).astype(float))
    mesh_image(content(balls, mask=inside), nodes, mode="uniform", iterations=2)
    what = content(balls, labels=balls)
    mesh = mesh_image(what, nodes, iterations=4).mesh
    cell_fields(mesh, balls)
    label_fidelity(balls, mesh)
    label_thickness(what, mesh, cell_labels(balls, mesh))
    mask_fidelity(inside, mesh)
