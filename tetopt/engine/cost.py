"""What a run of `tetopt mesh` takes, seconds and memory, by sizes that are known before it.

Both are sums of terms, each a size times what one of it costs. The costs are fitted to measured runs of whole
processes by `scripts/benchmark.py` (non-negative least squares of relative errors) and stand in `cost.toml` beside this
module, with the machine, its speed, and the errors of runs that were left out of the fit.
"""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple


class RunSize(NamedTuple):
    """What a run's cost depends on."""

    n_read: int  # voxels of all files that are read: contrasts, mask, labels
    n_voxels: int  # that are meshed: those around a mask; divided ones, where labels are smooth and slices thick
    n_nodes: int  # corners of cells; of order 2 there are more nodes
    iterations: int  # sweeps, at most
    n_channels: int = 1  # functions of the voxels: contrasts, channels of labels, one more for a mask
    ndim: int = 3
    mode: str = "graded"  # as `tetopt.engine.meshing.Mode`
    order: int = 1
    runs: int = 1  # optimisations in turn, towards an error or a number of nodes of order 2
    has_region: bool = False  # a mask, or background left out
    has_memberships: bool = False  # labels with smooth interfaces
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
    parallel_share: float  # of the sweeps' seconds, that threads divide among them
    calibration_seconds: float  # of `calibration` on the machine of the fit
    seconds_factor: float  # within which nine of ten runs left out of the fit lay
    bytes_share: float  # likewise, of the measured


@cache
def cost_model() -> CostModel:
    """The costs that this version comes with."""
    table: dict[str, Any] = tomllib.loads((Path(__file__).with_name("cost.toml")).read_text(encoding="utf-8"))
    return CostModel(
        table["seconds"], table["bytes"], table["threads"]["parallel_share"], table["machine"]["calibration_seconds"],
        table["errors"]["seconds_factor"], table["errors"]["bytes_share"],
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
    share = model.parallel_share
    seconds = alone + divided * (1.0 - share + share / threads)
    n_bytes = sum(model.bytes[name] * value for name, value in memory_terms(size).items())
    return Prediction(seconds, alone + divided, n_bytes)


def once_terms(size: RunSize) -> dict[str, float]:
    """What takes time once a run, in units of its cost, by name."""
    return {
        "process": 1.0,  # Python, libraries, kernels loaded
        "pictures": float(size.is_drawn),
        "voxels_read": float(size.n_read),  # unpacked, aligned, summed up for their checksum
        "voxels": float(size.n_voxels * size.n_channels),  # the octree's and the sampler's sums
        "region_voxels": float(size.n_voxels * size.has_region),  # distances to the mask's surface
        "membership_voxels": float(size.n_voxels * size.has_memberships),  # labels' levels
        "nodes": float(size.n_nodes * size.runs),  # connected, measured, written
    }


def swept_terms(size: RunSize) -> dict[str, float]:
    """What takes time in each iteration, likewise."""
    sweeps = size.iterations * size.runs
    # Rows of voxels that the facets cross: as many facets as nodes, each as large as a cell's side.
    rows = size.n_nodes ** (1.0 / size.ndim) * size.n_voxels ** (1.0 - 1.0 / size.ndim)
    has_surface = size.has_region or size.has_memberships
    is_paper = size.mode == "paper"
    return {
        "sweep_nodes": float(sweeps * size.n_nodes * (not is_paper)),  # shapes, flips, exchanges
        "sweep_rows": float(sweeps * rows * size.n_channels * (not is_paper)),  # voxels sampled again
        "surface_nodes": float(sweeps * size.n_nodes * has_surface),  # steps along surfaces and back to them
        "paper_nodes": float(sweeps * size.n_nodes * is_paper),  # numerical derivatives, Delaunay each time
        "paper_rows": float(sweeps * rows * is_paper),
    }


def memory_terms(size: RunSize) -> dict[str, float]:
    """What takes memory at the same time, likewise."""
    return {
        "process": 1.0,
        "pictures": float(size.is_drawn),
        "voxels_read": float(size.n_read),
        "voxels": float(size.n_voxels),
        "channel_voxels": float(size.n_voxels * size.n_channels),  # in the octree, later prefix sums
        "membership_voxels": float(size.n_voxels * size.has_memberships),
        "nodes": float(size.n_nodes),  # six cells with fluxes and sums
    }
