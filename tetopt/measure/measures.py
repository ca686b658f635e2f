"""Measures of a mesh against mask and labels, computed at the same time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cache, partial
from threading import Lock
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, content, continue_image
from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.measure.fidelity import (
    LabelFidelity,
    cell_labels,
    label_fidelity,
    mask_fidelity,
    voxels_of,
)
from tetopt.measure.interfaces import label_interfaces
from tetopt.measure.thin import contact_totals, label_contacts, label_thickness
from tetopt.mesh import Mesh

# around mask and mesh: their surfaces end at no side of this box but the image's own
AROUND_VOXELS = 2


def fidelity(
    labels: Image | None,
    mask: Image | None,
    mesh: Mesh,
    of_cell: NDArray | None,
    failed: dict[str, str] | None = None,
    what: Content | None = None,
    extents: Sequence[LabelFidelity] = (),
) -> dict[str, Any]:
    """Measure how well a mesh represents a mask and labels.

    Returns a `MaskFidelity` as `mask`; for each label a whole `LabelFidelity` in `labels`, and its
    surface in `interfaces`, too; for each pair of labels a `LabelContact` in `contacts`, and their
    sums in `contact_totals`. Entries of missing images are omitted. With a mask, labels count only
    inside it. `of_cell` (M,) is the label of each cell, by default that of most of its voxels; for
    `failed` see `measure_each`; `what` is the content with the levels of these labels, and
    `extents` are their volumes and components, if known.
    """
    measures: dict[str, Callable[[], Any]] = {}
    whole = partial(_with_levels, what, labels, mask)
    if mask is not None:
        labels, mask = _around(labels, mask, mesh)
    if mask is not None:
        measures["mask"] = lambda: mask_fidelity(mask, mesh)
    if labels is not None:
        own = (
            _once(lambda: cell_labels(continue_image(labels, mask), mesh))
            if of_cell is None
            else lambda: of_cell
        )
        measures["labels"] = lambda: label_fidelity(labels, mesh, own(), mask, extents)
        # made before the threads that share it
        if sum(box is not None for box in voxels_of(labels, mask).boxes) > 1:
            measures["thickness"] = lambda: label_thickness(whole(), mesh, own())
        measures["interfaces"] = lambda: label_interfaces(labels, mesh, own(), mask)
        measures["contacts"] = lambda: label_contacts(labels, mesh, own(), mask)
    # First and alone: it takes all threads, and the most memory.
    alone = {name: measures.pop(name) for name in ("thickness",) if name in measures}
    thickness = measure_each(alone, failed).get("thickness", {})
    measured = measure_each(measures, failed)
    if "labels" in measured:
        surfaces = {each.label: each for each in measured.get("interfaces", [])}
        measured["labels"] = [
            row._replace(
                thickness=thickness.get(row.label, row.thickness),
                surface=surfaces.get(row.label),
            )
            for row in measured["labels"]
        ]
    if "contacts" in measured:
        measured["contact_totals"] = contact_totals(measured["contacts"])
    return measured


def _once(make: Callable[[], NDArray]) -> Callable[[], NDArray]:
    """Return a function that computes an array at its first call alone, on any thread, and then
    returns the same.
    """
    lock, made = Lock(), cache(make)

    def get() -> NDArray:
        with lock:
            return made()

    return get


def _around(labels: Image | None, mask: Image, mesh: Mesh) -> tuple[Image | None, Image]:
    """Return the part of labels and a mask around the mask and the mesh: no measure counts what is
    beyond.

    For a brain in its head this is half of the voxels, of the time and of the memory.
    """
    if labels is not None and labels.shape != mask.shape:
        return labels, mask  # an error of the measures
    inside, index = mask.data >= INSIDE_FRACTION, mask.to_index(mesh.straight_pieces()[0].points)
    others = [tuple(d for d in range(mask.ndim) if d != axis) for axis in range(mask.ndim)]
    within = [
        np.append(np.flatnonzero(inside.any(axis=rest)), along)
        for rest, along in zip(others, index.T, strict=True)
    ]
    if not inside.any():
        return labels, mask
    start = [max(int(each.min()) - AROUND_VOXELS, 0) for each in within]
    stop = [
        min(int(each.max()) + AROUND_VOXELS + 2, size)
        for each, size in zip(within, mask.shape, strict=True)
    ]
    return None if labels is None else labels.box(start, stop), mask.box(start, stop)


def _with_levels(what: Content | None, labels: Image | None, mask: Image | None) -> Content:
    """Return the content if it has levels of labels, or else create one of the labels alone with
    levels.
    """
    if what is not None and what.memberships is not None:
        return what
    assert labels is not None
    return content(labels, labels, mask)


def measure_each(
    measures: Mapping[str, Callable[[], Any]], failed: dict[str, str] | None
) -> dict[str, Any]:
    """Compute measures in parallel; return their results by name.

    With `failed`, a measure that raises an error is omitted and its reason is noted there, so that
    the others complete.
    """
    measured, n_threads = {}, numba.get_num_threads()

    def limited(measure: Callable[[], Any]) -> Any:
        numba.set_num_threads(n_threads)  # which numba keeps for each thread of Python
        return measure()

    threads = ThreadPoolExecutor(n_threads)
    try:
        taken = {
            name: threads.submit(copy_context().run, limited, measure)
            for name, measure in measures.items()
        }
        for name, each in taken.items():
            try:
                measured[name] = each.result()
            except Exception as error:
                if failed is None:
                    raise
                words = (
                    str(error)
                    if isinstance(error, InputError)
                    else f"{type(error).__name__}: {error}"
                )
                failed[name] = words.removesuffix(": ")
    finally:  # an interrupted run, or one that failed, does not begin the rest
        threads.shutdown(wait=False, cancel_futures=True)
    return measured
