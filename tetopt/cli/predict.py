"""``tetopt mesh --predict``: how long a run takes and how much memory, by its sizes, before it begins."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tetopt.budget import available_bytes, memory_words
from tetopt.cli.console import log, out, show_warning
from tetopt.cli.inputs import file_and_volume
from tetopt.cli.options import DEFAULT_NODES
from tetopt.cli.plan import Plan
from tetopt.engine.cost import RunSize, calibrated_speed, cost_model, predicted
from tetopt.engine.meshing import QUADRATIC_NODES
from tetopt.image import VoxelGrid
from tetopt.io.images import file_shape, load_image, parse_crop, parse_slice
from tetopt.io.zarr_images import is_zarr
from tetopt.target.content import Content, StoredContent

SEARCH_RUNS = 4  # towards an error, mostly, each of about the default number of nodes
QUADRATIC_RUNS = 2  # towards a number of nodes of order 2: the second mostly meets it
SAMPLED_VALUES = 10_000  # of an image: one that is no whole number tells that most are none


def size_of_run(
    plan: Plan, content: Content | StoredContent, whole: VoxelGrid, n_started: int | None = None
) -> RunSize:
    """The sizes of a run whose files have been read.

    Parameters
    ----------
    plan : Plan
        With the numbers that depend on the image (`tetopt.cli.plan.with_numbers`).
    content : Content
        What is meshed.
    whole : Image
        The first contrast as it was read.
    n_started : int, optional
        Nodes, corners of cells, of a mesh to start from.
    """
    nodes, spacing = plan.sizes.nodes, plan.start.spacing
    if nodes is None and spacing is not None:
        per_block = 1 if plan.start.lattice == "five-tet" else 2
        nodes = max(round(per_block * content.volume / spacing**content.image.ndim), 1)
    size = _size(plan, whole.shape, nodes)
    if isinstance(content, StoredContent):
        elongation = _elongation(whole.spacing)
        return size._replace(elongation=elongation, is_fractional=not content.statistics.is_whole)
    return size._replace(
        n_voxels=content.image.data.size,
        n_nodes=size.n_nodes if n_started is None else n_started,
        n_channels=len(content.values) + (content.region is not None),
        elongation=_elongation(content.image.spacing),
        has_memberships=content.memberships is not None,
        is_fractional=content.is_plain and not np.array_equal(np.rint(some := _sample(content)), some),
    )


def size_by_headers(plan: Plan, like: RunSize | None = None) -> RunSize:
    """The same, of files of which only the headers are read.

    What shows only in the voxels is taken from a run with the same options, `like`, whose files have been read: the
    share of the voxels that a mask leaves, the channels of labels, nodes where no number is asked for. Without one it
    is all voxels, one channel for all labels, and the default number.

    Raises
    ------
    InputError
        As `tetopt.io.images.file_shape`, or `load_image` of a picture or DICOM, which is read.
    """
    part, path = plan.source.part, plan.source.images[0]
    shape = cropped_shape(plan, (file_shape(path) or load_image(path, volume=part.volume).shape)[:3])
    if part.slice_ is not None:
        axis, _ = parse_slice(part.slice_)
        shape = shape[:axis] + shape[axis + 1 :]
    size = _size(plan, shape, plan.sizes.nodes)
    if like is None:
        return size
    n_voxels = round(size.n_read * like.n_voxels / like.n_read)
    n_nodes = like.n_nodes if plan.sizes.nodes is None else size.n_nodes
    return size._replace(
        n_voxels=n_voxels, n_nodes=n_nodes, n_channels=like.n_channels, elongation=like.elongation,
        has_memberships=like.has_memberships, is_fractional=like.is_fractional,
    )  # fmt: skip


def cropped_shape(plan: Plan, shape: tuple[int, ...]) -> tuple[int, ...]:
    """What the crop that is asked for leaves of voxels of this shape."""
    if plan.source.part.crop is None:
        return shape
    bounds = zip(shape, parse_crop(plan.source.part.crop), strict=False)
    return tuple(len(range(length)[slice(*ends)]) for length, ends in bounds)


def _sample(content: Content) -> NDArray:
    """Some of the image's voxels."""
    return content.image.data.ravel()[:: max(content.image.data.size // SAMPLED_VALUES, 1)]


def _elongation(spacing: Sequence[float] | NDArray[np.float64]) -> float:
    """Of voxels with these edges, mm."""
    *across, along = (float(edge) for edge in spacing)
    return along / prod(across) ** (1.0 / len(across))


def _size(plan: Plan, shape: tuple[int, ...], nodes: int | None) -> RunSize:
    """What the options and headers tell of a run on voxels of this shape; each file is a channel."""
    source, order, ndim = plan.source, plan.solver.order or 1, len(shape)
    files = [*source.images, *(path for path in (source.mask, source.labels) if path is not None)]
    runs = SEARCH_RUNS if plan.sizes.target_error is not None else 1
    corners = float(DEFAULT_NODES[ndim] if nodes is None else nodes)
    if order == 2 and plan.mode != "start":
        corners /= QUADRATIC_NODES[ndim] if nodes is not None else 1.0
        runs = runs if plan.start.spacing is not None else max(runs, QUADRATIC_RUNS)
    n_read = sum(prod(shape if is_zarr(path) else file_shape(file_and_volume(path)[0]) or shape) for path in files)
    has_region = source.mask is not None or source.background is not None
    return RunSize(
        n_read=n_read, n_voxels=prod(shape), n_nodes=round(corners), iterations=plan.engine.iterations or 0,
        n_channels=len(source.images) + (source.labels is not None) + has_region, ndim=ndim, mode=plan.mode,
        order=order, runs=runs, has_region=has_region, has_memberships=source.labels is not None,
        is_drawn=bool(plan.pictures),
    )  # fmt: skip


def stated_prediction(size: RunSize) -> dict[str, Any]:
    """The sizes and what they come to, on the machine of the fit, as run.json states them."""
    return {"size": size, **predicted(size, numba.get_num_threads())._asdict()}


def print_prediction(plan: Plan, size: RunSize) -> None:
    """Say what the run takes on this machine, and how sure that is; warn where there is less memory."""
    log.print("measuring this machine, about a second")
    threads, model = numba.get_num_threads(), cost_model()
    prediction = predicted(size, threads, calibrated_speed())
    seconds, factor = prediction.seconds, model.seconds_factor
    out.print(
        f"{_seconds(seconds)} on {threads} thread{'s' if threads > 1 else ''}, in nine of ten cases "
        f"{_seconds(seconds / factor)} to {_seconds(seconds * factor)}, if nothing else runs and the kernels are "
        "compiled"
    )
    n_bytes, share = prediction.peak_bytes, model.bytes_share
    out.print(f"{memory_words(n_bytes)} of memory at its peak, in nine of ten cases {share:.0%} less or more")
    if plan.sizes.target_error is not None:
        out.print(f"of {size.runs} runs with {size.n_nodes} nodes: how many an error takes shows only in the run")
    free = available_bytes()
    if free is not None and n_bytes > free:
        show_warning(f"{memory_words(free)} of memory are free, less than this run takes; ask for fewer nodes, or crop")


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if value < 100.0 else f"{value:.0f} s"
