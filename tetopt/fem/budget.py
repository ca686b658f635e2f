"""Resolution of a reference's grid: as many degrees of freedom as fit a time and the free memory."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.fem.reference import DOF_BYTES, averaged, reference
from tetopt.fem.voxels import Grid, grid_of, multigrid_of, preconditioned, stiffness_product
from tetopt.image import Image
from tetopt.system.budget import available_bytes

STEP_GROWTH = 1.02  # ratio of successive voxel sizes tried for the grid, which misses the limit by less than 6 %
TRIAL_DOFS = 50_000  # of the grid for counting iterations; finer ones take hardly more
TIMED_DOFS = 3_000_000  # of the grid for timing an iteration: larger than the processor's caches
SOLUTION_RATIO = 1.6  # iterations of a whole reference (homogeneous block, half resolution) over those of its solution
LEAST_DOFS = 1_000  # minimum, however short the time
FREE_FRACTION = 0.8  # usable fraction of the free memory


class Budget(NamedTuple):
    """Result of `affordable_dofs`."""

    dofs: int  # that fit
    is_short_of_memory: bool  # True if memory set the limit, not time


def reference_shape(shape: Sequence[int], spacing: NDArray[np.float64], dofs: int) -> tuple[int, ...]:
    """The finest grid of nearly cubic voxels over the image's box with at most `dofs`, no finer than the image."""
    n = len(shape)
    size = np.array(shape) * spacing
    step = spacing.min()
    while True:
        coarse = np.clip(np.rint(size / np.maximum(step, spacing)), 1, shape).astype(int)
        if n * np.prod(coarse + 1) <= dofs:
            return tuple(int(c) for c in coarse)
        step *= STEP_GROWTH


def affordable_dofs(modulus: Image, nus: Sequence[float], seconds: float, percent: float = 1.0) -> Budget:
    """Number of degrees of freedom of references for all of `nus` that can be solved in about `seconds`.

    Iterations are counted on a small grid with the same moduli, since finer ones take hardly more, and one is timed on
    a large grid. So the result varies slightly from run to run; record it to repeat a run.

    Parameters
    ----------
    modulus : Image
        Young's moduli, kPa, at the image's resolution.
    nus : sequence of float
    seconds : float
        Wall time above 0, on this machine at its current load.
    percent : float
        As for `tetopt.fem.reference.reference`.

    Raises
    ------
    InputError
        `seconds` not above 0, or as for `reference`.
    """
    if not 0.0 < seconds < float("inf"):
        raise InputError(f"reference: expected more than 0 seconds, got {seconds}")
    whole = modulus.ndim * int(np.prod(np.array(modulus.shape) + 1))
    if whole <= LEAST_DOFS:
        return Budget(whole, False)
    trial = averaged(modulus, reference_shape(modulus.shape, modulus.spacing, TRIAL_DOFS))
    iterations = sum(reference(trial, nu, percent).work.iterations for nu in nus)
    timed = averaged(modulus, reference_shape(modulus.shape, modulus.spacing, TIMED_DOFS))
    in_time = seconds / (SOLUTION_RATIO * max(iterations, 1) * seconds_of_iteration(grid_of(timed, nus[0])))
    # All references stay in memory, with two fields each.
    in_memory = FREE_FRACTION * available_bytes() / (DOF_BYTES + 16.0 * (len(nus) - 1))
    return Budget(max(LEAST_DOFS, int(min(in_time, in_memory, whole))), bool(in_memory < min(in_time, whole)))


def seconds_of_iteration(grid: Grid) -> float:
    """Wall time of one iteration (a cycle and a product) per degree of freedom."""
    hierarchy, r = multigrid_of(grid), grid.nodes()
    r[:, 1:-1] = 1.0
    times = []
    for _ in range(4):
        begin = time.perf_counter()
        stiffness_product(grid, preconditioned(hierarchy, r, 1.0).astype(np.float64))
        times.append(time.perf_counter() - begin)
    return float(np.median(times[1:])) / r.size  # the first may compile
