"""The work on one part of a mesh, from file to file: measure it, optimise it, or compute its cell
fields.

Workers run this. A part lies on the whole mesh's grid of ticks, shifted only by whole voxels;
therefore its cells contain exactly the same voxels as in the whole mesh, and its shared nodes stay
the same to the last bit.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import plain
from tetopt.energy.sampling import cell_moments_and_ranges, nearest_voxels
from tetopt.engine.fast import Course, Run, followed
from tetopt.engine.loop import Whole
from tetopt.engine.state import content_energies
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.parts.work import checksum, done_path, load_arrays, open_volume, save_arrays
from tetopt.start.sizes import Sizes

# voxels around a part's nodes: the reach of the sampling around a facet, and one more
MARGIN_SIZE = 2

Kind = Literal["measure", "improve", "fields"]


class PartSettings(NamedTuple):
    """Settings shared by all parts of a run."""

    k_D: float
    shape_power: float
    min_dihedral: float  # degrees
    tolerance: float
    iterations: int  # total over all rounds
    n_early: int  # number of first iterations, which exchange nodes
    smallest: float  # mm, see `Sizes`
    longest: float
    gradation: float | None
    shape: tuple[int, ...]  # of the whole image
    bits: int  # of its sampling grid
    noise: float  # variance of its noise
    E_G: float = 1.0  # of the initial mesh
    squares: float = 1.0


class Numbers(NamedTuple):
    """The results of a part in addition to its mesh."""

    of: str  # checksum of its input
    E: float  # its contribution to that of the whole mesh
    E_G: float
    E_D: float
    squares: float
    n_voxels: int
    n_nodes: int
    movement: float  # of the last iteration, see `IterationRecord`


def box_of_ticks(
    ticks: NDArray[np.int64], settings: PartSettings
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the voxels around a part's nodes, within the image: start (inclusive) and stop
    (exclusive), (3,) each.
    """
    index = ticks * 2.0**-settings.bits
    start = np.maximum(np.floor(index.min(axis=0)).astype(np.int64) - MARGIN_SIZE, 0)
    stop = np.minimum(np.ceil(index.max(axis=0)).astype(np.int64) + MARGIN_SIZE + 1, settings.shape)
    return tuple(start.tolist()), tuple(stop.tolist())


def work_on(name: str) -> Numbers:
    """Process a part's file unless that is done already; return the numbers, which are also in the
    result file.

    Raises
    ------
    InputError
        The file is damaged, or voxels cannot be read.
    """
    path = Path(name)
    arrays, text = load_arrays(path)
    of = checksum(arrays, text)
    if (before := numbers_in(done_path(path), of)) is not None:
        return before
    settings = PartSettings(**text["settings"])
    start, stop = box_of_ticks(arrays["ticks"], settings)
    stored = open_volume(path.parents[1])
    image = stored.box(start, stop)
    index = arrays["ticks"] * 2.0**-settings.bits - np.array(start)
    mesh = Mesh(image.to_world(index), arrays["cells"])
    whole = Whole(
        start, settings.shape, settings.bits, settings.E_G, settings.squares, settings.noise
    )
    if text["kind"] == "fields":
        centroids = stored.to_world(arrays["ticks"] * 2.0**-settings.bits)[mesh.cells].mean(axis=1)
        nearest = nearest_voxels(stored, centroids) - np.array(start)
        result, numbers = (
            _fields(image, mesh, whole, nearest),
            Numbers(of, 0.0, 0.0, 0.0, 0.0, 0, len(index), 0.0),
        )
    else:
        result, numbers = _improved(image, mesh, whole, settings, text)
        numbers = numbers._replace(of=of)
    save_arrays(done_path(path), result, numbers._asdict())
    return numbers


def numbers_in(path: Path, of: str) -> Numbers | None:
    """Return the numbers of a finished part if its input had this checksum and its file is not
    damaged.
    """
    if not path.exists():
        return None
    try:
        numbers = Numbers(**load_arrays(path)[1])
    except InputError:
        return None
    return numbers if numbers.of == of else None


def _fields(
    image: Image, mesh: Mesh, whole: Whole, nearest: NDArray[np.int64]
) -> dict[str, NDArray]:
    """Return the image's fields of cells, see `tetopt.model.fields.cell_fields`.

    `nearest`, (M, 3), are the voxels that represent cells without any. They are computed for the
    whole mesh, because halfway between two voxels rounding goes to the even one, which depends on
    where the part begins.
    """
    moments, (low, high) = cell_moments_and_ranges(image, mesh, whole.bits)
    is_empty = moments.n_voxels == 0
    for values in (moments.mean, low, high):
        values[is_empty] = image.data[tuple(nearest[is_empty].T)]
    return {**moments._asdict(), "min": low, "max": high}


def _improved(
    image: Image, mesh: Mesh, whole: Whole, settings: PartSettings, text: dict[str, Any]
) -> tuple[dict[str, NDArray], Numbers]:
    """Return the part after the requested iterations, which may be none."""
    run = Run(plain(image), mesh, settings.k_D, settings.shape_power, is_graded=True, whole=whole)
    sizes = Sizes(
        settings.smallest, gradation=settings.gradation, longest=settings.longest
    ).prepared(3)
    first, last = text["iterations"]
    course = Course(
        first,
        last,
        settings.iterations,
        settings.n_early,
        settings.min_dihedral,
        settings.tolerance,
        text["nodes"],
        sizes,
    )
    history, _ = followed(run, course, lambda: False, time.perf_counter(), None)
    E_G, squares = content_energies(run.state, run.content)
    numbers = Numbers(
        "",
        history[-1].E,
        E_G,
        history[-1].E_D,
        squares,
        history[-1].n_voxels,
        len(run.state.complex.ticks),
        history[-1].movement,
    )
    ticks = run.state.complex.ticks + (np.array(whole.start, dtype=np.int64) << whole.bits)
    return {"ticks": ticks, "cells": np.array(run.cells)}, numbers
