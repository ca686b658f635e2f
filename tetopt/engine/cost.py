"""Predict time and memory of a run of `tetopt mesh` from sizes that are known in advance.

Both are sums of terms, each a size times its unit cost. `tests/benchmarks/fit_cost.py` fits the costs to measured runs
of whole processes (non-negative least squares of relative errors). They are stored in `cost.toml` next to this module,
with the machine, its speed, and the errors of runs excluded from the fit.
"""

from __future__ import annotations

import time
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

MODEL_FILE = Path(__file__).with_name("cost.toml")
CALIBRATION_VOXELS = 96  # along each axis of a cube, whose sums, 28 MB, exceed most caches
CALIBRATION_NODES = 9_000  # of a lattice over which they are summed repeatedly
CALIBRATION_TURNS = 30  # repetitions, of which the fastest counts: about a second in all
KERNEL_BYTES = 2.5e8  # numba's compiler, all kernels if not yet loaded, and buffers: at most 220 MB
BOUND_MARGIN = 1.5  # factor on predicted memory, so that it exceeds the peaks of all measured runs
# Per voxel of a part's box: values as stored and as an image, their sums, and a field of doubles. Measured were 32 for
# doubles, 28 for single precision, 20 for 16-bit integers (parts of 8 to 27 million voxels).
PART_VOXEL_BYTES = 34.0
NEXT_FRACTION = 0.3  # of the cells' memory: the additional memory of an exchange or the end of a run
CELLS_PER_NODE = {2: 2, 3: 6}  # in large meshes, by dimension


class RunSize(NamedTuple):
    """Sizes that determine the cost of a run."""

    n_read: int  # voxels of all files read: contrasts, mask, labels
    n_voxels: int  # voxels meshed: those around a mask; divided ones if labels are smooth and slices thick
    n_nodes: int  # corners of cells; order 2 has more nodes
    iterations: int  # sweeps, at most
    n_channels: int = 1  # functions of the voxels: contrasts, channels of labels, one more for a mask
    elongation: float = 1.0  # length of a voxel along the last axis, over its mean length across
    ndim: int = 3
    mode: str = "graded"  # a `tetopt.engine.meshing.Mode`
    order: int = 1
    runs: int = 1  # successive optimisations, towards an error or a number of nodes of order 2
    has_region: bool = False  # a mask, or excluded background
    has_memberships: bool = False  # labels with smooth interfaces
    is_fractional: bool = False  # one image that is not of whole numbers, whose sums take 64 bits
    is_drawn: bool = False  # pictures


class Prediction(NamedTuple):
    """Predicted time and memory of a run."""

    seconds: float  # wall-clock time, if nothing else uses the threads
    cpu_seconds: float  # total over all threads
    peak_bytes: float  # memory of the whole process


class CostModel(NamedTuple):
    """The fitted costs and their accuracy; see `cost.toml`."""

    seconds: dict[str, float]  # by term
    bytes: dict[str, float]  # by term
    parallel_fraction: float  # fraction of the sweeps' seconds that threads share
    calibration_seconds: float  # `calibration` on the machine of the fit
    seconds_factor: float  # factor within which 90 % of runs excluded from the fit lay
    bytes_fraction: float  # the same for memory, as a fraction of the measured value


@cache
def cost_model(path: Path = MODEL_FILE) -> CostModel:
    """Load the costs from a file, by default those of this version."""
    table: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    return CostModel(
        table["seconds"], table["bytes"], table["threads"]["parallel_fraction"],
        table["machine"]["calibration_seconds"],
        table["errors"]["seconds_factor"], table["errors"]["bytes_fraction"],
    )  # fmt: skip


def predicted(size: RunSize, threads: int = 1, speed: float = 1.0) -> Prediction:
    """Predict the seconds and memory of a run of these sizes.

    Parameters
    ----------
    size : RunSize
        Sizes of the run.
    threads : int
        Number of threads.
    speed : float
        Speed of the machine relative to that of the fit: `calibrated_speed`.
    """
    model = cost_model()
    once, swept = once_terms(size), swept_terms(size)
    alone = sum(model.seconds[name] * value for name, value in once.items()) / speed
    divided = sum(model.seconds[name] * value for name, value in swept.items()) / speed
    fraction = model.parallel_fraction
    seconds = alone + divided * (1.0 - fraction + fraction / threads)
    n_bytes = sum(model.bytes[name] * value for name, value in memory_terms(size).items())
    return Prediction(seconds, alone + divided, n_bytes)


def calibrated_speed() -> float:
    """Return this machine's speed relative to that of the fit, measured in about a second."""
    return cost_model().calibration_seconds / calibration()


def calibration() -> float:
    """CPU time, in seconds, of a fixed sample of the engine's work on one thread: summing voxels, measuring cells."""
    import numba  # imported late: predictions for another machine need no kernels
    import numpy as np

    from tetopt.energy.sampling import cell_moments
    from tetopt.image import Image
    from tetopt.start.lattice import lattice_mesh

    voxels = np.arange(CALIBRATION_VOXELS**3, dtype=np.int64).reshape((CALIBRATION_VOXELS,) * 3)
    image = Image((voxels * voxels % 1009).astype(np.float32))  # as irregular as an image
    mesh = lattice_mesh(image, nodes=CALIBRATION_NODES)
    threads, seconds = numba.get_num_threads(), []
    numba.set_num_threads(1)
    try:
        cell_moments(image, mesh)  # loads its kernels
        for _ in range(CALIBRATION_TURNS):
            begin = time.process_time()
            cell_moments(image, mesh)
            seconds.append(time.process_time() - begin)
    finally:
        numba.set_num_threads(threads)
    return min(seconds)


def once_terms(size: RunSize) -> dict[str, float]:
    """Terms of the time spent once per run, in units of their costs, by name."""
    return {
        "process": 1.0,  # Python, libraries, kernels loaded
        "pictures": float(size.is_drawn),
        "voxels_read": float(size.n_read),  # unpacked, aligned, read for their checksum
        "membership_voxels": float(size.n_voxels * size.has_memberships),  # labels' levels
        "cells": float(_cells(size) * size.runs),  # made, measured, written
    }


def swept_terms(size: RunSize) -> dict[str, float]:
    """Terms of the time spent in each iteration, in units of their costs, by name."""
    sweeps, cells = size.iterations * size.runs, _cells(size)
    # Rows of voxels along the last axis that facets cross: as many facets as nodes, each the size of a cell's side.
    fraction = 1.0 / size.ndim
    rows = size.n_nodes**fraction * (size.n_voxels * size.elongation) ** (1.0 - fraction)
    has_surface = size.has_region or size.has_memberships
    is_graded, is_paper = size.mode == "graded", size.mode == "paper"
    return {
        "graded_cells": float(sweeps * cells * is_graded),  # shapes, flips, exchanges
        "graded_rows": float(sweeps * rows * is_graded),  # voxels resampled, also with each move
        "uniform_cells": float(sweeps * cells * (not is_graded and not is_paper)),  # no exchanges, small moves: no rows
        "paper_cells": float(sweeps * cells * is_paper),  # Delaunay each time
        "paper_rows": float(sweeps * rows * is_paper),  # numerical derivatives
        "channel_rows": float(sweeps * rows * (size.n_channels - 1)),  # of each channel but the first
        "surface_cells": float(sweeps * cells * has_surface),  # steps along surfaces and back to them
    }


def memory_terms(size: RunSize) -> dict[str, float]:
    """Terms of the memory in use at the same time, in units of their costs, by name."""
    return {
        "process": 1.0,
        "pictures": float(size.is_drawn),
        "voxels_read": float(size.n_read),
        "channel_voxels": float(size.n_voxels * size.n_channels),  # in the octree, later prefix sums
        "fractional_voxels": float(size.n_voxels * size.is_fractional),
        "region_voxels": float(size.n_voxels * size.has_region),
        "membership_voxels": float(size.n_voxels * size.has_memberships),
        "cells": float(_cells(size)),  # with fluxes and sums
    }


def meshing_bytes(n_voxels: int, n_channels: int, n_nodes: int, ndim: int = 3) -> float:
    """Upper bound of the peak memory of meshing beyond that in use once files are read; above all measured runs.

    Parameters
    ----------
    n_voxels, n_channels : int
        Numbers of meshed voxels and channels.
    n_nodes : int
        Number of nodes of the mesh of order 1; 0 for the memory of the image alone.
    ndim : int
        Dimension of the image.
    """
    size = RunSize(0, n_voxels, n_nodes, 0, n_channels, ndim=ndim)
    terms, costs = memory_terms(size), cost_model().bytes
    n_bytes = sum(costs[name] * terms[name] for name in ("channel_voxels", "cells"))
    return KERNEL_BYTES + BOUND_MARGIN * n_bytes


def part_bytes(n_voxels: int, n_cells: int) -> float:
    """Upper bound of the peak memory of a part of a mesh beyond that of a process that runs parts.

    Parameters
    ----------
    n_voxels : int
        Number of voxels of the box around its cells.
    n_cells : int
    """
    return PART_VOXEL_BYTES * n_voxels + BOUND_MARGIN * cost_model().bytes["cells"] * n_cells


def next_bytes(n_nodes: int, ndim: int = 3) -> float:
    """Upper bound of the additional memory of the next steps of a run with `n_nodes` nodes."""
    return NEXT_FRACTION * (meshing_bytes(0, 0, n_nodes, ndim) - KERNEL_BYTES)


def _cells(size: RunSize) -> int:
    return CELLS_PER_NODE[size.ndim] * size.n_nodes
