"""Prediction of a run's time and memory from its sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import prod
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.engine.cost import RunSize, predicted
from tetopt.engine.meshing import QUADRATIC_NODES, corners_of
from tetopt.image import Image
from tetopt.io.images import file_shape, parse_crop, parse_slice
from tetopt.io.zarr_images import is_zarr
from tetopt.job.inputs import file_and_volume, read_image, tissue_files
from tetopt.job.options import DEFAULT_NODES
from tetopt.job.plan import Plan
from tetopt.start.octree import is_near, least_nodes, nodes_of_sizes
from tetopt.start.sizes import Sizes

SEARCH_RUNS = 4  # for a target error, mostly, each with about the default number of nodes
QUADRATIC_RUNS = 2  # for a number of nodes of order 2: the second mostly reaches it
SAMPLED_VALUES = 10_000  # of an image: if one is not a whole number, most are not


def size_of_run(
    plan: Plan, content: Content, whole: Image, n_started: int | None = None, sizes: Sizes | None = None
) -> RunSize:  # fmt: skip
    """Return the sizes of a run whose files have been read.

    Parameters
    ----------
    plan : Plan
        With the numbers that depend on the image (`tetopt.job.plan.with_numbers`).
    content : Content
        The content to mesh.
    whole : Image
        The first contrast as read.
    n_started : int, optional
        Number of corner nodes of a mesh to start from.
    sizes : Sizes, optional
        Sizes of cells, which may need more nodes than requested.

    Raises
    ------
    InputError
        No initial mesh is within the sizes; its own builder raises the same.
    """
    size, spacing = _size(plan, whole.shape, plan.job.nodes), plan.job.spacing
    if spacing is not None:
        per_block = 1 if plan.job.lattice == "five-tet" else 2
        size = size._replace(n_nodes=max(round(per_block * content.volume / spacing**content.image.ndim), 1))
    if plan.mode == "graded":
        if plan.job.target_error is not None and sizes is not None:
            size = size._replace(n_nodes=max(size.n_nodes, nodes_of_sizes(content, sizes)[0]))
        if (least := round(least_nodes(content, size.n_nodes, sizes))) > size.n_nodes:
            is_bound = plan.job.target_error is None and not is_near(least, size.n_nodes)
            size = size._replace(n_nodes=least, runs=1 if is_bound else size.runs)  # other runs would be the same
    return size._replace(
        n_voxels=prod(content.image.shape),
        n_nodes=size.n_nodes if n_started is None else n_started,
        n_channels=content.n_channels + (content.region is not None),
        elongation=_elongation(content.image.spacing),
        has_memberships=content.memberships is not None,
        is_fractional=content.is_plain and not _is_whole(content),
    )


def size_by_headers(plan: Plan, like: RunSize | None = None) -> RunSize:
    """Return the sizes of a run from the headers of its files.

    Quantities that depend on the voxels come from a run `like` with the same options, whose files have been read: the
    fraction of voxels within a mask, the channels of labels, and the number of nodes if none is requested. Without
    such a run, these are all voxels, one channel for all labels, and the default number.

    Raises
    ------
    InputError
        As for `tetopt.io.images.file_shape`, or `load_image` for a picture or DICOM, which is read.
    """
    job, path = plan.job, plan.job.images[0]
    shape = cropped_shape(plan, (file_shape(path) or read_image(path, replace(job, slice_=None, crop=None)).shape)[:3])
    if job.slice_ is not None:
        axis, _ = parse_slice(job.slice_)
        shape = shape[:axis] + shape[axis + 1 :]
    size = _size(plan, shape, job.nodes)
    if like is None:
        return size
    n_voxels = round(size.n_read * like.n_voxels / like.n_read)
    n_nodes = like.n_nodes if job.nodes is None else max(like.n_nodes, size.n_nodes)
    return size._replace(
        n_voxels=n_voxels, n_nodes=n_nodes, n_channels=like.n_channels, elongation=like.elongation,
        has_memberships=like.has_memberships, is_fractional=like.is_fractional,
    )  # fmt: skip


def cropped_shape(plan: Plan, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of voxels after the requested crop."""
    if plan.job.crop is None:
        return shape
    bounds = zip(shape, parse_crop(plan.job.crop), strict=False)
    return tuple(len(range(length)[slice(*ends)]) for length, ends in bounds)


def _is_whole(content: Content) -> bool:
    """Return whether the image has whole numbers: in all voxels if known, else in a sample of them."""
    if content.statistics is not None:
        return content.statistics.is_whole
    data = content.image.data.ravel()
    some = data[:: max(data.size // SAMPLED_VALUES, 1)]
    return np.array_equal(np.rint(some), some)


def _elongation(spacing: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the elongation of voxels with these edges, mm."""
    *across, along = (float(edge) for edge in spacing)
    return along / prod(across) ** (1.0 / len(across))


def _size(plan: Plan, shape: tuple[int, ...], nodes: int | None) -> RunSize:
    """Return the sizes of a run on voxels of this shape, from options and headers; each file is a channel."""
    job, order, ndim = plan.job, plan.order, len(shape)
    files = [*job.images, *(path for path in (job.mask, job.labels, *tissue_files(job.tissues)) if path is not None)]
    runs = SEARCH_RUNS if plan.job.target_error is not None else 1
    corners = DEFAULT_NODES[ndim] if nodes is None else nodes
    if order == 2 and plan.mode != "start":
        corners = corners if nodes is None else corners_of(nodes, ndim, QUADRATIC_NODES[ndim])
        runs = runs if plan.job.spacing is not None else max(runs, QUADRATIC_RUNS)
    n_read = sum(prod(shape if is_zarr(path) else file_shape(file_and_volume(path)[0]) or shape) for path in files)
    has_region = job.mask is not None or job.background is not None
    is_labelled = job.labels is not None or job.tissues is not None
    return RunSize(
        n_read=n_read, n_voxels=prod(shape), n_nodes=corners, iterations=plan.job.iterations or 0,
        n_channels=len(job.images) + is_labelled + has_region, ndim=ndim, mode=plan.mode,
        order=order, runs=runs, has_region=has_region, has_memberships=is_labelled,
        is_drawn=job.figures is not None,
    )  # fmt: skip


def stated_prediction(size: RunSize) -> dict[str, Any]:
    """Return the sizes and the prediction, on the machine of the fit, as run.json states them."""
    return {"size": size, **predicted(size, numba.get_num_threads())._asdict()}
