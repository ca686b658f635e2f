"""One part of a mesh, from a file to a file: measured, optimised, or its cells' fields taken. This is what workers run.

A part lies on the whole mesh's grid of ticks, in which its own is only shifted by whole voxels; so the voxels that its
cells hold are those that they hold in the whole, to the last one, and its shared nodes stay to the last bit.
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

MARGIN_SIZE = 2  # voxels around a part's nodes: as far as the image is looked at beside a facet, and one more

Kind = Literal["measure", "improve", "fields"]


class PartSettings(NamedTuple):
    """What all parts of a run have in common."""

    k_D: float
    shape_power: float
    min_dihedral: float  # degrees
    tolerance: float
    iterations: int  # in all rounds together
    n_early: int  # the first of them, in which nodes are exchanged
    smallest: float  # mm, as of `Sizes`
    longest: float
    gradation: float | None
    shape: tuple[int, ...]  # of the whole image
    bits: int  # of its sampling grid
    noise: float  # variance of its noise
    E_G: float = 1.0  # of the initial mesh
    squares: float = 1.0


class Numbers(NamedTuple):
    """What came of a part, besides its mesh."""

    of: str  # checksum of what it was made of
    E: float  # its part of the whole's
    E_G: float
    E_D: float
    squares: float
    n_voxels: int
    n_nodes: int
    movement: float  # of the last iteration, as in a `IterationRecord`


def box_of_ticks(ticks: NDArray[np.int64], settings: PartSettings) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The voxels of a part, start to before stop (3,) each: those around its nodes, within the image."""
    index = ticks * 2.0**-settings.bits
    start = np.maximum(np.floor(index.min(axis=0)).astype(np.int64) - MARGIN_SIZE, 0)
    stop = np.minimum(np.ceil(index.max(axis=0)).astype(np.int64) + MARGIN_SIZE + 1, settings.shape)
    return tuple(start.tolist()), tuple(stop.tolist())


def work_on(name: str) -> Numbers:
    """Do what a part's file says, unless it is done already; the numbers, which stand in the other file, too.

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
    whole = Whole(start, settings.shape, settings.bits, settings.E_G, settings.squares, settings.noise)
    if text["kind"] == "fields":
        centroids = stored.to_world(arrays["ticks"] * 2.0**-settings.bits)[mesh.cells].mean(axis=1)
        nearest = nearest_voxels(stored, centroids) - np.array(start)
        result, numbers = _fields(image, mesh, whole, nearest), Numbers(of, 0.0, 0.0, 0.0, 0.0, 0, len(index), 0.0)
    else:
        result, numbers = _improved(image, mesh, whole, settings, text)
        numbers = numbers._replace(of=of)
    save_arrays(done_path(path), result, numbers._asdict())
    return numbers


def numbers_in(path: Path, of: str) -> Numbers | None:
    """The numbers of a part that is done, if it was made of what has this checksum, and is not damaged since."""
    if not path.exists():
        return None
    try:
        numbers = Numbers(**load_arrays(path)[1])
    except InputError:
        return None
    return numbers if numbers.of == of else None


def _fields(image: Image, mesh: Mesh, whole: Whole, nearest: NDArray[np.int64]) -> dict[str, NDArray]:
    """What the image is in each cell, as of `tetopt.model.fields.cell_fields`.

    `nearest`, (M, 3), are the voxels that stand for cells without any: those of the whole, since rounding goes to
    even numbers in the middle between two voxels, and which are even depends on where the part begins.
    """
    moments, (low, high) = cell_moments_and_ranges(image, mesh, whole.bits)
    is_empty = moments.n_voxels == 0
    for values in (moments.mean, low, high):
        values[is_empty] = image.data[tuple(nearest[is_empty].T)]
    return {**moments._asdict(), "min": low, "max": high}


def _improved(
    image: Image, mesh: Mesh, whole: Whole, settings: PartSettings, text: dict[str, Any]
) -> tuple[dict[str, NDArray], Numbers]:
    """The part after the iterations that are asked for, which may be none."""
    run = Run(plain(image), mesh, settings.k_D, settings.shape_power, is_graded=True, whole=whole)
    sizes = Sizes(settings.smallest, gradation=settings.gradation, longest=settings.longest).prepared(3)
    first, last = text["iterations"]
    course = Course(
        first, last, settings.iterations, settings.n_early, settings.min_dihedral, settings.tolerance, text["nodes"],
        sizes,
    )  # fmt: skip
    history, _ = followed(run, course, lambda: False, time.perf_counter(), None)
    E_G, squares = content_energies(run.state, run.content)
    numbers = Numbers(
        "", history[-1].E, E_G, history[-1].E_D, squares, history[-1].n_voxels, len(run.state.complex.ticks),
        history[-1].movement,
    )  # fmt: skip
    ticks = run.state.complex.ticks + (np.array(whole.start, dtype=np.int64) << whole.bits)
    return {"ticks": ticks, "cells": np.array(run.cells)}, numbers
