"""What a run of `tetopt mesh` takes, seconds and memory, by sizes that are known before it.

Both are sums of terms, each a size times what one of it costs. The costs are fitted to measured runs of whole
processes by `tests/benchmarks/fit_cost.py` (non-negative least squares of relative errors) and stand in `cost.toml`
beside this module, with the machine, its speed, and the errors of runs that were left out of the fit.
"""

from __future__ import annotations

import time
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

MODEL_FILE = Path(__file__).with_name("cost.toml")
CALIBRATION_VOXELS = 96  # along each axis of a cube, whose sums, 28 MB, are more than most caches have
CALIBRATION_NODES = 9_000  # of a lattice, in which they are summed up again and again
CALIBRATION_TURNS = 30  # of which the fastest counts: about a second in all
KERNEL_BYTES = 2.5e8  # numba's compiler and all kernels, if they are not loaded yet, and buffers: 220 MB at most
BOUND_MARGIN = 1.5  # on what sizes take: above the peaks of all runs that were measured
# Of a part's box: its values as stored and as an image's, their sums, and a field of doubles besides. 32 were measured
# of doubles, 28 of single precision, 20 of whole numbers of 16 bits (parts of 8 to 27 million voxels).
PART_VOXEL_BYTES = 34.0
NEXT_FRACTION = 0.3  # of what cells take: what an exchange or the end of a run takes besides
CELLS_PER_NODE = {2: 2, 3: 6}  # of large meshes, by dimension


class RunSize(NamedTuple):
    """What a run's cost depends on."""

    n_read: int  # voxels of all files that are read: contrasts, mask, labels
    n_voxels: int  # that are meshed: those around a mask; divided ones, where labels are smooth and slices thick
    n_nodes: int  # corners of cells; of order 2 there are more nodes
    iterations: int  # sweeps, at most
    n_channels: int = 1  # functions of the voxels: contrasts, channels of labels, one more for a mask
    elongation: float = 1.0  # of voxels: how long they are along the last axis, to the mean across
    ndim: int = 3
    mode: str = "graded"  # as `tetopt.engine.meshing.Mode`
    order: int = 1
    runs: int = 1  # optimisations in turn, towards an error or a number of nodes of order 2
    has_region: bool = False  # a mask, or background left out
    has_memberships: bool = False  # labels with smooth interfaces
    is_fractional: bool = False  # one image, not of whole numbers, whose sums take 64 bits
    is_drawn: bool = False  # pictures


class Prediction(NamedTuple):
    """What a run is expected to take."""

    seconds: float  # of the clock, if nothing else uses the threads
    cpu_seconds: float  # of all threads together
    peak_bytes: float  # of memory, of the whole process


class CostModel(NamedTuple):
    """The fitted costs, and what they are worth; see `cost.toml`."""

    seconds: dict[str, float]  # by term
    bytes: dict[str, float]  # by term
    parallel_fraction: float  # of the sweeps' seconds, that threads divide among them
    calibration_seconds: float  # of `calibration` on the machine of the fit
    seconds_factor: float  # within which nine of ten runs left out of the fit lay
    bytes_fraction: float  # likewise, of the measured


@cache
def cost_model(path: Path = MODEL_FILE) -> CostModel:
    """The costs in a file, by default those that this version comes with."""
    table: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    return CostModel(
        table["seconds"], table["bytes"], table["threads"]["parallel_fraction"],
        table["machine"]["calibration_seconds"],
        table["errors"]["seconds_factor"], table["errors"]["bytes_fraction"],
    )  # fmt: skip


def predicted(size: RunSize, threads: int = 1, speed: float = 1.0) -> Prediction:
    """Seconds and memory that a run of these sizes takes.

    Parameters
    ----------
    size : RunSize
        What is known of the run.
    threads : int
        That it computes on.
    speed : float
        Of the machine, in that on which the costs were fitted: `calibrated_speed`.
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
    """Speed of this machine, in that of the one on which the costs were fitted; it takes about a second."""
    return cost_model().calibration_seconds / calibration()


def calibration() -> float:
    """Seconds of CPU time of a fixed piece of the engine's work, on one thread: voxels summed up and cells measured."""
    import numba  # not before it is needed: who predicts for another machine loads no kernels
    import numpy as np

    from tetopt.energy.sampling import cell_moments
    from tetopt.image import Image
    from tetopt.start.lattice import lattice_mesh

    voxels = np.arange(CALIBRATION_VOXELS**3, dtype=np.int64).reshape((CALIBRATION_VOXELS,) * 3)
    image = Image((voxels * voxels % 1009).astype(np.float32))  # as irregular as an image is
    mesh = lattice_mesh(image, nodes=CALIBRATION_NODES)
    threads, seconds = numba.get_num_threads(), []
    numba.set_num_threads(1)
    try:
        cell_moments(image, mesh)  # its kernels are loaded then
        for _ in range(CALIBRATION_TURNS):
            begin = time.process_time()
            cell_moments(image, mesh)
            seconds.append(time.process_time() - begin)
    finally:
        numba.set_num_threads(threads)
    return min(seconds)


def once_terms(size: RunSize) -> dict[str, float]:
    """What takes time once a run, in units of its cost, by name."""
    return {
        "process": 1.0,  # Python, libraries, kernels loaded
        "pictures": float(size.is_drawn),
        "voxels_read": float(size.n_read),  # unpacked, aligned, summed up for their checksum
        "membership_voxels": float(size.n_voxels * size.has_memberships),  # labels' levels
        "cells": float(_cells(size) * size.runs),  # made, measured, written
    }


def swept_terms(size: RunSize) -> dict[str, float]:
    """What takes time in each iteration, likewise."""
    sweeps, cells = size.iterations * size.runs, _cells(size)
    # Rows of voxels, along the last axis, that facets cross: as many facets as nodes, each as large as a cell's side.
    fraction = 1.0 / size.ndim
    rows = size.n_nodes**fraction * (size.n_voxels * size.elongation) ** (1.0 - fraction)
    has_surface = size.has_region or size.has_memberships
    is_graded, is_paper = size.mode == "graded", size.mode == "paper"
    return {
        "graded_cells": float(sweeps * cells * is_graded),  # shapes, flips, exchanges
        "graded_rows": float(sweeps * rows * is_graded),  # voxels sampled again, and again with each move
        "uniform_cells": float(sweeps * cells * (not is_graded and not is_paper)),  # no exchanges, small moves: no rows
        "paper_cells": float(sweeps * cells * is_paper),  # Delaunay each time
        "paper_rows": float(sweeps * rows * is_paper),  # numerical derivatives
        "channel_rows": float(sweeps * rows * (size.n_channels - 1)),  # of each channel but the first
        "surface_cells": float(sweeps * cells * has_surface),  # steps along surfaces and back to them
    }


def memory_terms(size: RunSize) -> dict[str, float]:
    """What takes memory at the same time, likewise."""
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
    """What meshing takes at its peak besides what there is once the files are read: above all that was measured.

    Parameters
    ----------
    n_voxels, n_channels : int
        Of what is meshed.
    n_nodes : int
        Of the mesh, of order 1; 0 for what the image takes alone.
    ndim : int
        Of the image.
    """
    size = RunSize(0, n_voxels, n_nodes, 0, n_channels, ndim=ndim)
    terms, costs = memory_terms(size), cost_model().bytes
    n_bytes = sum(costs[name] * terms[name] for name in ("channel_voxels", "cells"))
    return KERNEL_BYTES + BOUND_MARGIN * n_bytes


def part_bytes(n_voxels: int, n_cells: int) -> float:
    """What a part of a mesh takes at its peak besides what a process that runs parts has, above all that was measured.

    Parameters
    ----------
    n_voxels : int
        Of the box around its cells.
    n_cells : int
    """
    return PART_VOXEL_BYTES * n_voxels + BOUND_MARGIN * cost_model().bytes["cells"] * n_cells


def next_bytes(n_nodes: int, ndim: int = 3) -> float:
    """What the next steps of a run with so many nodes take besides what there is, at most."""
    return NEXT_FRACTION * (meshing_bytes(0, 0, n_nodes, ndim) - KERNEL_BYTES)


def _cells(size: RunSize) -> int:
    return CELLS_PER_NODE[size.ndim] * size.n_nodes
