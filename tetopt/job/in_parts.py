"""A run in parts: requested, or chosen because an image does not fit into memory."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import tetopt
from tetopt.contents.content import Content
from tetopt.contents.statistics import statistics
from tetopt.engine.fast import prepare_kernels
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.images import parse_crop
from tetopt.io.label_tables import NO_TABLE
from tetopt.io.stored_images import STORED_SUFFIXES, coarse_image, open_stored
from tetopt.io.text import counted, plain
from tetopt.job.events import KERNEL_WORDS, ended_words, note, progress, started, warning
from tetopt.job.meshing import START_WORDS, check_initial, check_room
from tetopt.job.options import JobOptions, PartsOptions, stated_part
from tetopt.job.plan import Plan, changed, voxels_in_file, whole_bytes, with_numbers
from tetopt.job.request import checksum, requested
from tetopt.job.source import Source, read_source
from tetopt.job.task import Meshed, Task
from tetopt.mesh import Mesh
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.model.fields import cell_fields
from tetopt.model.sets import box_of, box_text
from tetopt.parts.part import work_on
from tetopt.parts.rounds import PartsRequest, Round, Runner, mesh_in_parts
from tetopt.parts.work import STATE_NAME, VOLUME_NAME, VolumeFile, identity, removed
from tetopt.system.budget import BYTES_PER_GB, available_bytes, memory_words
from tetopt.workers import MEMORY_MARGIN, WorkerEnded, check_workers, run_tasks, share_of, workers

# voxels of an image that a run in parts reads whole, with all features of a run in one piece
MOST_LOADED = 2**28
MOST_DRAWN = 2**27  # voxels of the image level that is drawn
FEWEST_NODES_EACH = 100  # per part: half of 150 nodes are shared and fixed
WORK_SUFFIX = ".work"  # of the work directory next to the mesh, appended to its name
# of a worker: 240 MB with all kernels loaded, its nanny, zarr and buffers of threads
OWN_BYTES = 4e8
TERMINATE_FRACTION = 0.95  # of a worker's memory limit, where dask ends it
MORE_MEMORY = "give workers more memory, or increase `parts`"
# Options that need all cells or voxels at once, and the values, other than none, that parts accept.
PARTS_TAKE: dict[str, Any] = {
    "mask": None,
    "background": None,
    "labels": None,
    "tissues": None,
    "slice_": None,
    "target_error": None,
    "edge_size": None,
    "sizing": None,
    "max_gb": None,
    "order": 1,
    "boundary": "slide",
}
LEFT_TAKE: dict[str, Any] = {"average": DEFAULT_AVERAGE}  # the same, if the image stays in its file


def read_in_parts(plan: Plan) -> Task | None:
    """Read the image of a run in parts, on request or for lack of memory; None if it is to be in
    one piece.

    Raises
    ------
    InputError
        Options that runs in parts do not support, or that only they support; dask is not installed.
    """
    job, unsupported = plan.job, _unsupported_option(plan)
    if job.parts is None:
        needed, free = whole_bytes(plan), available_bytes()
        if needed <= free or unsupported is not None:
            names = (
                field.name
                for field in dataclasses.fields(PartsOptions)
                if getattr(job, field.name) is not None
            )
            if (name := next(names, None)) is not None:
                note(
                    f"`{name}` is ignored: the mesh is built in one piece (use `parts` to "
                    "partition it)"
                )
            return None
        note(
            f"meshing in one piece would take {memory_words(needed)} of memory, but only "
            f"{memory_words(free)} is free: "
            "building the mesh in parts"
        )
    elif unsupported is not None:
        raise InputError(unsupported)
    if job.worker_gb is not None and not job.worker_gb > 0.0:
        raise InputError(f"`worker_gb`: expected more than 0, got {job.worker_gb}")
    if job.worker_gb is not None and job.scheduler is not None:
        raise InputError(
            "`worker_gb`: only for workers on this machine; those of `scheduler` have their own "
            "limits"
        )
    check_workers(job.workers, job.scheduler)
    plan = plan._replace(job=changed(job, parts=job.parts or 1))
    left = VolumeFile(job.images[0], job.volume, None if job.crop is None else parse_crop(job.crop))
    source = _left_source(plan, left) if _is_left(plan) else read_source(job, job.label_names)
    image = source.contrasts[0]
    if image.ndim != 3:
        raise InputError("`parts`: expected a 3-D image, got a 2-D one; omit the option")
    plan, sizes, _ = with_numbers(plan, source.content)
    request = requested(changed(plan.bare, parts=plan.job.parts))
    return Task(
        plan,
        source,
        None,
        sizes,
        request,
        partial(run_in_parts, volume=left if image.is_stored else image),
    )


def _unsupported_option(plan: Plan) -> str | None:
    """Return the message for an option that parts do not support; None if there is none."""
    job = plan.job
    if plan.mode != "graded":
        return (
            "`parts`: needs a graded mesh; omit it, or `uniform`, `spacing`, `lattice`, "
            "`method` and `start`"
        )
    if len(job.images) > 1:
        return f"`parts`: expected one IMAGE, got {len(job.images)}; omit the others, or `parts`"
    return _whole_only(plan, PARTS_TAKE)


def _whole_only(plan: Plan, taken: dict[str, Any]) -> str | None:
    """Return the message for the first option whose value is neither none nor the accepted one;
    None without any.
    """
    for name, value in taken.items():
        if getattr(plan.job, name) not in (None, value):
            return (
                f"`{name}`: needs all cells or voxels together, which parts do not have; "
                "leave it out, or `parts`"
            )
    return None


def _is_left(plan: Plan) -> bool:
    """Return whether the image of a run in parts stays in its file, being large or not fitting
    into memory.
    """
    if not plan.job.images[0].name.lower().endswith(STORED_SUFFIXES):
        return False
    return voxels_in_file(plan) > MOST_LOADED or whole_bytes(plan) > available_bytes()


def _left_source(plan: Plan, left: VolumeFile) -> Source:
    """Return an image that stays in its file, with statistics from one pass."""
    path, crop = left.path, left.crop
    if (unsupported := _whole_only(plan, LEFT_TAKE)) is not None:
        raise InputError(unsupported)
    if plan.job.young is not None:
        note(
            "`young`: a formula or a table is applied to cell means, as the voxels stay in their "
            "file"
        )
    level = (
        coarse_image(path, MOST_DRAWN, volume=left.volume)
        if plan.pictures and crop is None
        else None
    )
    if plan.pictures and level is None:
        raise InputError(
            f"`figures`: {path} is cropped, or has no level of {MOST_DRAWN:.3g} voxels or fewer; "
            "leave out `figures`"
        )
    image = open_stored(path, volume=left.volume, crop=crop)
    note(f"{path}: {' x '.join(map(str, image.shape))} voxels, which stay in the file")
    about = {
        "image": path.name,
        "image_sha256": checksum(path),
        "box": box_text(box_of(image)),
        "inputs": {
            "images": [path.name],
            "weights": [1.0],
            "mask": None,
            "background": None,
            "labels": None,
            "label_weight": None,
            "sha256": {},
        },
    }
    content = Content(image, statistics=statistics(image))
    return Source(
        [path],
        [1.0],
        content,
        [image],
        None,
        None,
        about,
        NO_TABLE,
        image if level is None else level,
    )


def run_in_parts(
    task: Task, stop: Callable[[], bool], begin: float, volume: VolumeFile | Image
) -> Meshed:
    """Run or resume a mesh in parts on workers, which also compute the cell fields; see
    `tetopt.job.meshing.meshed`.
    """
    job = task.plan.job
    request, folder, loaded = (
        _request(task, volume),
        work_folder(job.output),
        time.perf_counter() - begin,
    )
    ends = None if job.max_seconds is None else begin + job.max_seconds
    largest: list[float] = []  # bytes of the largest task, once workers begin

    def check(initial: Mesh) -> None:
        early = {
            name: np.zeros(len(initial.cells))
            for name in ("mean", "variance", "n_voxels", "min", "max")
        }
        check_initial(task, initial, early | cell_fields(initial))
        check_room(task, initial)

    def is_over() -> bool:
        return stop() or (ends is not None and time.perf_counter() > ends)

    def watch(now: Round, history: list[IterationRecord]) -> None:
        parts = counted(now.n_parts, "part")
        if now.done > 0:
            progress(f"{now.done} of {parts} done", now.done)
        elif not history:
            started("measure", f"measuring: {parts}", now.n_parts)
        else:
            name = (
                f"round {now.number} of {now.n_rounds - 2}"
                if now.kind == "improve"
                else "cell fields"
            )
            started("round", f"{name}, E {history[-1].E:.4f}: {parts}", now.n_parts)

    @contextlib.contextmanager
    def crew(n_parts: int, n_bytes: float) -> Iterator[Runner]:
        largest.append(n_bytes)
        note(f"{counted(n_parts, 'part')} or more per round, each up to {memory_words(n_bytes)}")
        started("kernels", KERNEL_WORDS)
        prepare_kernels(
            Image(np.zeros((3, 3, 3)) + np.arange(3)),
            request.k_D,
            is_graded=True,
            progress=progress,
        )
        started("start", "starting the workers")
        with _runner(job, folder, n_parts, n_bytes) as runner:
            yield runner

    started("start", START_WORDS)
    try:
        parted = mesh_in_parts(
            request,
            folder,
            task.source.content.statistics,
            volume=volume,
            check=check,
            crew=crew,
            is_over=is_over,
            watch=watch,
        )
    except BaseException:  # Ctrl-C among them
        if largest and (folder / STATE_NAME).exists():  # workers have begun
            note(
                f"{folder} keeps the finished parts: run the same command again to continue, or "
                "remove it"
            )
        raise
    started("optimised", "optimised")
    result = parted.result
    if result.ended == "stopped" and not stop():
        result = result._replace(ended="max_seconds")
    if result.ended != "iterations":
        note(ended_words(result.ended, "the mesh of the last complete round"))
    seconds = {"load": loaded, "optimize": time.perf_counter() - begin - loaded}
    fields = {**parted.fields, **cell_fields(result.mesh), "part": parted.part}
    end = partial(_end, folder, result)
    return Meshed(result, result.initial, seconds, {"task_bytes": largest[0]}, fields, end)


def work_folder(mesh: Path) -> Path:
    """Return the work directory of a run in parts, given the mesh's file."""
    return mesh.with_name(mesh.name + WORK_SUFFIX)


def worker_bytes(part_bytes: float) -> float:
    """Return the memory of a worker with a part of this size."""
    return (part_bytes + OWN_BYTES) / TERMINATE_FRACTION


@contextlib.contextmanager
def _runner(job: JobOptions, folder: Path, n_parts: int, n_bytes: float) -> Iterator[Runner]:
    """Start the workers of a job for this number of parts and bytes; raise InputError for too
    little memory.
    """
    most = float("inf") if job.worker_gb is None else job.worker_gb * BYTES_PER_GB
    share = share_of(n_parts, worker_bytes(MEMORY_MARGIN * n_bytes), job.workers, job.threads, most)
    if job.scheduler is None and share.bytes < worker_bytes(n_bytes):
        raise InputError(
            f"a part needs about {memory_words(n_bytes)} of memory, and its worker "
            f"{memory_words(worker_bytes(n_bytes))} in total, more than available; increase "
            "`parts`, reduce "
            "`workers`, or give them more memory"
        )
    with workers(share, job.scheduler, job.threads) as pool:
        note(pool.words())

        def run(names: Sequence[str]) -> Iterator[Any]:
            # workers elsewhere have other current folders
            places = [str(Path(name).absolute()) for name in names]
            for name, numbers, error in run_tasks(
                pool, _worked_on, places, str((folder / VOLUME_NAME).absolute())
            ):
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
        raise InputError(
            f"{plain(name)}: an allocation failed ({plain(str(error))}); {MORE_MEMORY}"
        ) from error
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise InputError(f"{plain(str(error))}; free some space, and run this again") from error


def _request(task: Task, volume: VolumeFile | Image) -> PartsRequest:
    """Return the request for a mesh in parts, with a checksum of everything that the mesh
    depends on.
    """
    plan, sizes = task.plan, task.sizes
    engine, nodes = plan.engine_options, plan.job.nodes or 0
    values: dict[str, Any] = {
        "nodes": nodes,
        "n_parts": checked_number(plan.job.parts or 1, nodes),
        "k_D": engine["k_D"],
        "iterations": engine["iterations"],
        "shape_power": engine["shape_power"],
        "min_dihedral": engine["min_dihedral"],
        "tolerance": 5e-4,
    }
    file = None if isinstance(volume, Image) else volume
    of_image, place = identity(file, task.source.about["image_sha256"])
    whole = {
        **values,
        "image": of_image,
        "part": stated_part(plan.job),
        "tetopt": tetopt.__version__,
        "sizes": None if sizes is None else [sizes.smallest, sizes.longest, sizes.gradation],
        "place": place,
    }
    digest = hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
    return PartsRequest(**values, sizes=sizes, checksum=digest)


def checked_number(n_parts: int, nodes: int) -> int:
    """Return the minimum number of parts; InputError if nearly all nodes would be shared."""
    most = max(nodes // FEWEST_NODES_EACH, 1)
    if n_parts > most:
        raise InputError(
            f"`parts`: expected at most {most} for {nodes} nodes ({FEWEST_NODES_EACH} each), got "
            f"{n_parts}"
        )
    return n_parts


def _end(folder: Path, result: MeshingResult) -> None:
    """Remove the work directory of a complete run; report on that of an incomplete one."""
    if result.ended not in ("iterations", "converged"):
        note(f"{folder}: run the same command again with `force` to continue, or remove it")
    elif left := removed(folder):
        warning(f"{folder} was not removed, as it contains foreign files: {', '.join(left)}")
