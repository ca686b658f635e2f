"""A small part of what `make test-random` runs: random worlds, whose meshes must meet the
requirements.
"""

import numpy as np
import pytest
from operations import operations
from runs import labelled_world, runs
from worlds import random_world

from tetopt import check_mesh, mesh_image, quality

pytestmark = pytest.mark.full


@pytest.mark.parametrize("seed", [11, 36])
def test_no_node_leaves_a_box_that_a_mask_touches(seed):
    """Sheared, flipped, with thick slices: there nodes slid on the level's continuation, up to
    2.6 voxels away.
    """
    rng = np.random.default_rng([19, seed])
    world = random_world(rng, needs_mask=True)
    nodes, k_D = int(rng.integers(80, 250)), float(rng.choice([0.02, 0.2, 0.85, 0.95]))
    result = mesh_image(world.content(), nodes, iterations=6, k_D=k_D)
    assert (
        check_mesh(result.mesh, world.image, is_whole=False, is_filled=False, is_manifold=False)
        == []
    )
    assert "box" not in result.violated


def test_operations_leave_a_mesh_and_exact_sums():
    made, n_checks, faults, _ = operations(3, 5_000)
    assert faults == []
    assert made.total() >= 5_000
    assert n_checks >= 3
    assert all(
        made[kind] > 0
        for kind in ("moves", "flips", "splits and collapses", "lifts", "moves to interfaces")
    )


def test_runs_meet_their_requirements_or_say_so():
    outcomes, violations, faults = runs(1, 5)
    assert faults == []
    assert outcomes["done"] >= 3
    assert sum(violations.values()) <= 3


def test_the_last_flat_cells_may_leave_their_interface():
    """Of this world five cells were left under 22 degrees, all of their nodes on interfaces."""
    world = labelled_world(np.random.default_rng([21, 9, 7]))
    result = mesh_image(world.content(), 200, iterations=5, min_dihedral=22.0)
    assert result.violated == {}
    assert quality(result.mesh.points, result.mesh.cells).min_dihedral >= 22.0 - 1e-6


def test_a_few_cells_on_a_mask_s_boundary_go_where_nothing_lifts_them():
    """Three of 644 were left in the corners of this world's mask, down to 9 degrees."""
    target = labelled_world(np.random.default_rng([21, 7, 57])).content()
    result = mesh_image(target, 280)
    assert "min_dihedral" not in result.violated
    assert quality(result.mesh.points, result.mesh.cells).min_dihedral >= 12.0 - 1e-6
    assert check_mesh(result.mesh, is_whole=False) == []


def test_parts_of_a_boundary_do_not_touch_in_one_place():
    """Two nodes of this world's mask slid into one place."""
    target = labelled_world(np.random.default_rng([21, 7, 263])).content()
    result = mesh_image(target, 135)
    assert check_mesh(result.mesh, is_whole=False) == []
