"""A small share of what `make test-random` runs: random worlds, whose meshes must keep what is promised."""

import numpy as np
import pytest
from worlds import random_world

import tetopt


@pytest.mark.parametrize("seed", [10, 11, 14, 15, 36])
def test_no_node_leaves_a_box_that_a_mask_touches(seed):
    """Sheared, flipped, with thick slices: there nodes slid on the level's continuation, up to 2.6 voxels away."""
    rng = np.random.default_rng([19, seed])
    world = random_world(rng, needs_mask=True)
    nodes, k_D = int(rng.integers(80, 250)), float(rng.choice([0.02, 0.2, 0.85, 0.95]))
    result = tetopt.mesh_image(world.content(), nodes, iterations=6, k_D=k_D)
    assert tetopt.check_mesh(result.mesh, world.image, is_whole=False, is_filled=False, is_manifold=False) == []
    assert "box" not in result.missed
