"""A run in parts: asked for, or chosen where an image does not fit into memory."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import tetopt
from tetopt.cluster.crew import Folders, Need, Workers, counted
from tetopt.cluster.tasks import run_tasks
from tetopt.cluster.workers import check_choice, local_share, workers
from tetopt.contents.content import Content
from tetopt.contents.statistics import statistics
from tetopt.engine.cost import meshing_bytes
from tetopt.engine.fast import prepare_kernels
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.images import file_shape, parse_crop
from tetopt.io.label_tables import NO_TABLE
from tetopt.io.stored_images import STORED_SUFFIXES, check_local, coarse_image, open_stored
from tetopt.job.events import KERNEL_WORDS, ended_words, note, progress, started, warning
from tetopt.job.options import DEFAULT_NODES, JobOptions, PartsOptions, stated_part
from tetopt.job.plan import Plan
from tetopt.job.predict import cropped_shape
from tetopt.job.request import checksum
from tetopt.job.source import Source
from tetopt.job.task import Task
from tetopt.mesh import Mesh
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.model.sets import box_of, box_text
from tetopt.parts.division import Division, work_folder
from tetopt.parts.part import work_on
from tetopt.parts.rounds import Parted, PartsRequest, Round, Runner, mesh_in_parts
from tetopt.parts.work import LOGS_NAME, STATE_NAME, VolumeFile, identity, removed
from tetopt.system.budget import BYTES_PER_GB, available_bytes, memory_words

MOST_LOADED = 2**28  # voxels of an image that a run in parts reads whole: with it all that one piece offers is there
MOST_DRAWN = 2**27  # voxels of the level of an image that pictures are drawn of
VOXEL_BYTES = 16.0  # of an image that is read whole, besides what meshing takes
# Options that look at all cells or voxels at once, and the values of them that parts take besides none at all.
PARTS_TAKE: dict[str, Any] = {
    "mask": None, "background": None, "labels": None, "tissues": None, "slice_": None, "target_error": None,
    "edge_size": None, "sizing": None, "max_gb": None, "order": 1, "boundary": "slide",
}  # fmt: skip
LEFT_TAKE: dict[str, Any] = {"average": DEFAULT_AVERAGE}  # likewise, if the image is left in its file


def with_parts(plan: Plan) -> Plan:
    """The plan with a number of parts, if it is to be made in some: as asked for, or for want of memory.

    Raises
    ------
    InputError
        Options that parts do not have, or that only they have; dask not installed.
    """
    job, unsupported = plan.job, _unsupported_option(plan)
    if job.parts is None:
        needed, free = _whole_bytes(plan), available_bytes()
        if needed <= free or unsupported is not None:
            names = (field.name for field in dataclasses.fields(PartsOptions) if getattr(job, field.name) is not None)
            if (name := next(names, None)) is not None:
                note(f"`{name}`: has no say, as the mesh is made in one piece; `parts` asks for parts")
            return plan
        note(
            f"in one piece it would take {memory_words(needed)} of memory, {memory_words(free)} are free: it is made "
            "in parts"
        )
    elif unsupported is not None:
        raise InputError(unsupported)
    if job.worker_gb is not None and not job.worker_gb > 0.0:
        raise InputError(f"`worker_gb`: expected more than 0, got {job.worker_gb}")
    if job.worker_gb is not None and (job.scheduler or job.cluster):
        raise InputError("`worker_gb`: of workers on this machine; those of `scheduler` and `cluster` have their own")
    check_choice(job.workers, job.scheduler, job.cluster, "blocks")
    file = VolumeFile(job.images[0], job.volume, None if job.crop is None else parse_crop(job.crop))
    return plan._replace(division=Division(job.parts or 1), left=file if _is_left(plan) else None)


def _is_storable(path: Path) -> bool:
    return path.name.lower().endswith(STORED_SUFFIXES)


def _whole_bytes(plan: Plan) -> float:
    """What a graded mesh of an image that could be left in its file takes in one piece; 0 of others."""
    path = plan.job.images[0]
    check_local(path)
    if not _is_storable(path) or plan.job.slice_ is not None or plan.mode != "graded":
        return 0.0
    n_voxels = _n_voxels(plan)
    nodes = plan.job.nodes or DEFAULT_NODES[3]
    return VOXEL_BYTES * n_voxels + meshing_bytes(n_voxels, len(plan.job.images), nodes)


def _n_voxels(plan: Plan) -> int:
    """Of the image, by its header, cropped."""
    return prod(cropped_shape(plan, (file_shape(plan.job.images[0]) or (0,))[:3]))


def _unsupported_option(plan: Plan) -> str | None:
    """What a mesh in parts cannot be, in words; None if there is nothing."""
    job = plan.job
    if plan.mode != "graded":
        return "`parts`: of a graded mesh; leave out `uniform`, `spacing`, `lattice`, `method`, `start`, or `parts`"
    if len(job.images) > 1:
        return f"`parts`: expected one IMAGE, got {len(job.images)}; leave the others out, or `parts`"
    return _whole_only(plan, PARTS_TAKE)


def _whole_only(plan: Plan, taken: dict[str, Any]) -> str | None:
    """The first of the options that has another value than none and the one that is taken, in words."""
    for name, value in taken.items():
        if getattr(plan.job, name) not in (None, value):
            return f"`{name}`: looks at all cells or voxels at once, parts do not; leave it out, or `parts`"
    return None


def _is_left(plan: Plan) -> bool:
    """Whether the image of a run in parts is left in its file: a large one, or one that does not fit into memory."""
    if not _is_storable(plan.job.images[0]):
        return False
    return _n_voxels(plan) > MOST_LOADED or _whole_bytes(plan) > available_bytes()


def left_source(plan: Plan) -> Source | None:
    """The image of a run in parts that is left in its file, of which one pass takes the statistics; None of others."""
    if plan.left is None:
        return None
    path = plan.left.path
    if (unsupported := _whole_only(plan, LEFT_TAKE)) is not None:
        raise InputError(unsupported)
    if plan.job.young is not None:
        note("`young`: a formula or a table is taken of each cell's mean, as the voxels stay in their file")
    level = coarse_image(path, MOST_DRAWN) if plan.pictures and plan.job.crop is None else None
    if plan.pictures and level is None:
        raise InputError(
            f"`figures`: {path} has no level of {MOST_DRAWN:.3g} voxels or fewer to draw, or is cropped; leave it out"
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
    """How far a run in parts is."""

    now: Round
    history: list[IterationRecord]  # of the rounds that are done


def run_in_parts(
    task: Task, check: Callable[[Mesh], None], stop: Callable[[], bool], ends: float | None
) -> tuple[Parted, float]:  # fmt: skip
    """Run, or go on with, a mesh in parts; what came of it, and the memory predicted for each worker's task, bytes.

    `check` is given the initial mesh before a part begins; `stop` says when to end, and so does the clock at `ends`, as
    of `time.perf_counter`.
    """
    source, folder, request = task.source, work_folder(task.plan.job.output), _request(task)
    task_bytes = 0.0

    def is_over() -> bool:
        return stop() or (ends is not None and time.perf_counter() > ends)

    @contextlib.contextmanager
    def crew(n_parts: int, n_bytes: float) -> Iterator[Runner]:
        nonlocal task_bytes
        task_bytes = n_bytes
        note(f"{counted(n_parts, 'part')} or more in a round, each of up to {memory_words(n_bytes)}")
        started("kernels", KERNEL_WORDS)
        prepare_kernels(Image(np.zeros((3, 3, 3)) + np.arange(3)), request.k_D, is_graded=True, progress=progress)
        started("parts", "optimising in parts")
        with _team(task.plan.job, folder, n_parts, n_bytes) as team:

            def run(names: Sequence[str]) -> Iterator[Any]:
                return run_tasks(team, work_on, [str(Path(name).absolute()) for name in names], is_over=is_over)

            yield run

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
        if task_bytes > 0.0 and (folder / STATE_NAME).exists():  # there were workers
            note(f"{folder} has what is done: run this again to go on, or remove it")
        raise
    started("optimised", "optimised")
    result = parted.result
    if result.ended == "stopped" and not stop():
        parted = parted._replace(result=result._replace(ended="max_seconds"))
    if parted.result.ended != "iterations":
        note(ended_words(parted.result.ended, "the mesh of the last complete round"))
    return parted, task_bytes


@contextlib.contextmanager
def _team(job: JobOptions, folder: Path, n_parts: int, n_bytes: float) -> Iterator[Workers]:
    """The workers that a job asks for, for so many parts of up to so many bytes; InputError for too little room."""
    most = None if job.worker_gb is None else job.worker_gb * BYTES_PER_GB
    need = Need(n_parts, n_bytes, job.threads, is_within=True, most_bytes=most)
    here = folder.absolute()  # workers that others started have folders of their own to begin with
    folders = Folders(here, here / LOGS_NAME)
    folders.logs.mkdir(exist_ok=True)
    if job.scheduler is None and job.cluster is None:
        _check_room(need, local_share(need, job.workers).bytes)  # with too little a worker does not even start
    with workers(need, folders, count=job.workers, scheduler=job.scheduler, cluster=job.cluster) as team:
        note(team.words)
        _check_room(need, team.bytes)
        yield team


def _check_room(need: Need, room: float) -> None:
    """InputError if a part needs more memory than a worker has for it."""
    if need.task_bytes > room:
        raise InputError(
            f"a part needs about {memory_words(need.task_bytes)} of memory, its worker "
            f"{memory_words(need.limit_for(need.task_bytes))} in all, and has too little; ask for more `parts`, for "
            "fewer `workers`, or give them more memory"
        )


def _request(task: Task) -> PartsRequest:
    """What is asked for, with a checksum of all on which the mesh depends."""
    plan, sizes = task.plan, task.sizes
    engine, nodes = plan.engine_options, task.size.n_nodes
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
    """Remove the work directory of a run that is complete; say what becomes of that of another."""
    folder = work_folder(mesh)
    if result.ended in ("iterations", "converged"):
        if left := removed(folder):
            warning(f"{folder}: stays with what is not tetopt's in it: {', '.join(left)}")
    else:
        note(f"{folder}: run this again with `force` to go on, or remove it")
