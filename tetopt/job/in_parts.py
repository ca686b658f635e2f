"""A run in parts: requested, or chosen because an image does not fit into memory."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import tetopt
from tetopt.contents.content import Content
from tetopt.contents.statistics import statistics
from tetopt.engine.fast import prepare_kernels
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.engine.memory import meshing_bytes
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.images import file_shape, parse_crop
from tetopt.io.label_tables import NO_TABLE
from tetopt.io.stored_images import STORED_SUFFIXES, check_local, coarse_image, open_stored
from tetopt.io.text import counted, plain
from tetopt.job.events import KERNEL_WORDS, ended_words, note, progress, started, warning
from tetopt.job.options import DEFAULT_NODES, JobOptions, PartsOptions, stated_part
from tetopt.job.plan import Plan
from tetopt.job.request import checksum
from tetopt.job.source import Source
from tetopt.job.task import Task
from tetopt.mesh import Mesh
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.model.sets import box_of, box_text
from tetopt.parts.division import Division, work_folder
from tetopt.parts.part import work_on
from tetopt.parts.rounds import Parted, PartsRequest, Round, Runner, mesh_in_parts
from tetopt.parts.work import STATE_NAME, VOLUME_NAME, VolumeFile, identity, removed
from tetopt.system.budget import BYTES_PER_GB, available_bytes, memory_words
from tetopt.workers import MEMORY_MARGIN, WorkerEnded, check_workers, run_tasks, share_of, workers

MOST_LOADED = 2**28  # voxels of an image that a run in parts reads whole, with all features of a run in one piece
MOST_DRAWN = 2**27  # voxels of the image level that is drawn
OWN_BYTES = 4e8  # of a worker: 240 MB with all kernels loaded, its nanny, zarr and buffers of threads
TERMINATE_FRACTION = 0.95  # of a worker's memory limit, where dask ends it
MORE_MEMORY = "give workers more memory, or increase `parts`"
VOXEL_BYTES = 16.0  # of an image that is read whole, in addition to meshing
# Options that need all cells or voxels at once, and the values, other than none, that parts accept.
PARTS_TAKE: dict[str, Any] = {
    "mask": None, "background": None, "labels": None, "tissues": None, "slice_": None, "target_error": None,
    "edge_size": None, "sizing": None, "max_gb": None, "order": 1, "boundary": "slide",
}  # fmt: skip
LEFT_TAKE: dict[str, Any] = {"average": DEFAULT_AVERAGE}  # the same, if the image stays in its file


def with_parts(plan: Plan) -> Plan:
    """Return the plan with a number of parts if the run is in parts: on request, or for lack of memory.

    Raises
    ------
    InputError
        Options that runs in parts do not support, or that only they support; dask is not installed.
    """
    job, unsupported = plan.job, _unsupported_option(plan)
    if job.parts is None:
        needed, free = _whole_bytes(plan), available_bytes()
        if needed <= free or unsupported is not None:
            names = (field.name for field in dataclasses.fields(PartsOptions) if getattr(job, field.name) is not None)
            if (name := next(names, None)) is not None:
                note(f"`{name}` is ignored: the mesh is built in one piece (use `parts` to partition it)")
            return plan
        note(
            f"meshing in one piece would take {memory_words(needed)} of memory, but only {memory_words(free)} is free: "
            "building the mesh in parts"
        )
    elif unsupported is not None:
        raise InputError(unsupported)
    if job.worker_gb is not None and not job.worker_gb > 0.0:
        raise InputError(f"`worker_gb`: expected more than 0, got {job.worker_gb}")
    if job.worker_gb is not None and job.scheduler is not None:
        raise InputError("`worker_gb`: only for workers on this machine; those of `scheduler` have their own limits")
    check_workers(job.workers, job.scheduler, "zarr")
    file = VolumeFile(job.images[0], job.volume, None if job.crop is None else parse_crop(job.crop))
    return plan._replace(division=Division(job.parts or 1), left=file if _is_left(plan) else None)


def _is_storable(path: Path) -> bool:
    return path.name.lower().endswith(STORED_SUFFIXES)


def _whole_bytes(plan: Plan) -> float:
    """Return the bytes that a graded mesh of an image that could stay in its file takes in one piece; 0 for others."""
    path = plan.job.images[0]
    check_local(path)
    if not _is_storable(path) or plan.job.slice_ is not None or plan.mode != "graded":
        return 0.0
    n_voxels = _n_voxels(plan)
    nodes = plan.job.nodes or DEFAULT_NODES[3]
    return VOXEL_BYTES * n_voxels + meshing_bytes(n_voxels, len(plan.job.images), nodes)


def _n_voxels(plan: Plan) -> int:
    """Return the number of voxels of the cropped image, by its header."""
    shape = (file_shape(plan.job.images[0]) or (0,))[:3]
    if plan.job.crop is None:
        return prod(shape)
    bounds = zip(shape, parse_crop(plan.job.crop), strict=False)
    return prod(len(range(length)[slice(*ends)]) for length, ends in bounds)


def _unsupported_option(plan: Plan) -> str | None:
    """Return the message for an option that parts do not support; None if there is none."""
    job = plan.job
    if plan.mode != "graded":
        return "`parts`: needs a graded mesh; omit it, or `uniform`, `spacing`, `lattice`, `method` and `start`"
    if len(job.images) > 1:
        return f"`parts`: expected one IMAGE, got {len(job.images)}; omit the others, or `parts`"
    return _whole_only(plan, PARTS_TAKE)


def _whole_only(plan: Plan, taken: dict[str, Any]) -> str | None:
    """Return the message for the first option whose value is neither none nor the accepted one; None without any."""
    for name, value in taken.items():
        if getattr(plan.job, name) not in (None, value):
            return f"`{name}`: needs all cells or voxels together, which parts do not have; leave it out, or `parts`"
    return None


def _is_left(plan: Plan) -> bool:
    """Return whether the image of a run in parts stays in its file, being large or not fitting into memory."""
    if not _is_storable(plan.job.images[0]):
        return False
    return _n_voxels(plan) > MOST_LOADED or _whole_bytes(plan) > available_bytes()


def left_source(plan: Plan) -> Source | None:
    """Return the image of a run in parts that stays in its file, with statistics from one pass; None for others."""
    if plan.left is None:
        return None
    path = plan.left.path
    if (unsupported := _whole_only(plan, LEFT_TAKE)) is not None:
        raise InputError(unsupported)
    if plan.job.young is not None:
        note("`young`: a formula or a table is applied to cell means, as the voxels stay in their file")
    level = coarse_image(path, MOST_DRAWN) if plan.pictures and plan.job.crop is None else None
    if plan.pictures and level is None:
        raise InputError(
            f"`figures`: {path} is cropped, or has no level of {MOST_DRAWN:.3g} voxels or fewer; leave out `figures`"
        )
    image = open_stored(path, volume=plan.left.volume, crop=plan.left.crop)
    note(f"{path}: {' x '.join(map(str, image.shape))} voxels, which stay in the file")
    about = {
        "image": path.name, "image_sha256": checksum(path), "box": box_text(box_of(image)),
        "inputs": {"images": [path.name], "weights": [1.0], "mask": None, "background": None, "labels": None,
                   "label_weight": None, "sha256": {}},
    }  # fmt: skip
    content = Content(image, statistics=statistics(image))
    return Source([path], [1.0], content, [image], None, None, about, NO_TABLE, image if level is None else level)


class PartsProgress(NamedTuple):
    """Progress of a run in parts."""

    now: Round
    history: list[IterationRecord]  # of the finished rounds


def run_in_parts(
    task: Task, check: Callable[[Mesh], None], stop: Callable[[], bool], ends: float | None
) -> tuple[Parted, float]:  # fmt: skip
    """Run or resume a mesh in parts; return the result, and the memory of each worker's largest task, bytes.

    `check` gets the initial mesh before a part begins; the run ends once `stop` returns true, or at the time `ends` of
    `time.perf_counter`.
    """
    source, folder, request = task.source, work_folder(task.plan.job.output), _request(task)
    task_bytes = 0.0

    def is_over() -> bool:
        return stop() or (ends is not None and time.perf_counter() > ends)

    @contextlib.contextmanager
    def crew(n_parts: int, n_bytes: float) -> Iterator[Runner]:
        nonlocal task_bytes
        task_bytes = n_bytes
        note(f"{counted(n_parts, 'part')} or more per round, each up to {memory_words(n_bytes)}")
        started("kernels", KERNEL_WORDS)
        prepare_kernels(Image(np.zeros((3, 3, 3)) + np.arange(3)), request.k_D, is_graded=True, progress=progress)
        started("parts", "optimising in parts")
        with _runner(task.plan.job, folder, n_parts, n_bytes) as runner:
            yield runner

    started("parts", "optimising in parts")
    try:
        parted = mesh_in_parts(
            request, folder, source.content.statistics, volume=task.plan.left or source.contrasts[0],
            check=check, crew=crew, is_over=is_over,
            watch=lambda now, history: progress(
                f"{now.done} of {counted(now.n_parts, 'part')} of a round", PartsProgress(now, history)
            ),
        )  # fmt: skip
    except BaseException:  # Ctrl-C among them
        if task_bytes > 0.0 and (folder / STATE_NAME).exists():  # workers have begun
            note(f"{folder} keeps the finished parts: run the same command again to continue, or remove it")
        raise
    started("optimised", "optimised")
    result = parted.result
    if result.ended == "stopped" and not stop():
        parted = parted._replace(result=result._replace(ended="max_seconds"))
    if parted.result.ended != "iterations":
        note(ended_words(parted.result.ended, "the mesh of the last complete round"))
    return parted, task_bytes


def worker_bytes(part_bytes: float) -> float:
    """Return the memory of a worker with a part of this size."""
    return (part_bytes + OWN_BYTES) / TERMINATE_FRACTION


@contextlib.contextmanager
def _runner(job: JobOptions, folder: Path, n_parts: int, n_bytes: float) -> Iterator[Runner]:
    """Start the workers of a job for this number of parts and bytes; raise InputError for too little memory."""
    most = float("inf") if job.worker_gb is None else job.worker_gb * BYTES_PER_GB
    share = share_of(n_parts, worker_bytes(MEMORY_MARGIN * n_bytes), job.workers, job.threads, most)
    if job.scheduler is None and share.bytes < worker_bytes(n_bytes):
        raise InputError(
            f"a part needs about {memory_words(n_bytes)} of memory, and its worker "
            f"{memory_words(worker_bytes(n_bytes))} in total, more than available; increase `parts`, reduce "
            "`workers`, or give them more memory"
        )
    with workers(share, job.scheduler, job.threads) as pool:
        note(pool.words())

        def run(names: Sequence[str]) -> Iterator[Any]:
            places = [str(Path(name).absolute()) for name in names]  # workers elsewhere have other current folders
            for name, numbers, error in run_tasks(pool, _worked_on, places, str((folder / VOLUME_NAME).absolute())):
                if isinstance(error, WorkerEnded):
                    raise InputError(f"{plain(name)}: {error}; {MORE_MEMORY}")
                if error is not None:
                    raise error
                yield numbers

        yield run


def _worked_on(name: str) -> Any:
    """Work on a part in a worker."""
    try:
        return work_on(name)
    except MemoryError as error:
        raise InputError(f"{plain(name)}: an allocation failed ({plain(str(error))}); {MORE_MEMORY}") from error
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise InputError(f"{plain(str(error))}; free some space, and run this again") from error


def _request(task: Task) -> PartsRequest:
    """Return the request for a mesh in parts, with a checksum of everything that the mesh depends on."""
    plan, sizes = task.plan, task.sizes
    engine, nodes = plan.engine_options, plan.job.nodes or 0
    values: dict[str, Any] = {
        "nodes": nodes, "n_parts": plan.division.checked_number(nodes), "k_D": engine["k_D"],
        "iterations": engine["iterations"], "shape_power": engine["shape_power"],
        "min_dihedral": engine["min_dihedral"], "tolerance": 5e-4,
    }  # fmt: skip
    of_image, place = identity(plan.left, task.source.about["image_sha256"])
    whole = {
        **values, "image": of_image, "part": stated_part(plan.job), "tetopt": tetopt.__version__,
        "sizes": None if sizes is None else [sizes.smallest, sizes.longest, sizes.gradation],
        "place": place,
    }  # fmt: skip
    digest = hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
    return PartsRequest(**values, sizes=sizes, checksum=digest)


def end_parts(mesh: Path, result: MeshingResult) -> None:
    """Remove the work directory of a complete run; report on that of an incomplete one."""
    folder = work_folder(mesh)
    if result.ended in ("iterations", "converged"):
        if left := removed(folder):
            warning(f"{folder} was not removed, as it contains foreign files: {', '.join(left)}")
    else:
        note(f"{folder}: run the same command again with `force` to continue, or remove it")
