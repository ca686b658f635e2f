"""The optimised mesh of a run in this process; a target error, or order 2, takes several
successive runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from tetopt.contents.content import Content
from tetopt.contents.domain import INSIDE_FRACTION
from tetopt.engine.aim import (
    ERROR_RUNS,
    NODE_RUNS,
    NODES_NEAR,
    Aim,
    SearchRun,
    needed_corners,
)
from tetopt.engine.fast import prepare_kernels
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.engine.meshing import Optimisation, check_memory_of, search_mesh
from tetopt.geometry.quadratic import node_count
from tetopt.geometry.simplex import squared_edges
from tetopt.job.events import (
    KERNEL_WORDS,
    ended_words,
    note,
    progress,
    start_stage,
    time_words,
    warnings_heard,
)
from tetopt.job.options import SolverOptions, has_model
from tetopt.job.plan import kind_of
from tetopt.job.solver_files import check_early, keep_early
from tetopt.job.task import Meshed, Task
from tetopt.job.write import model_with
from tetopt.measure.fidelity import cell_labels
from tetopt.measure.judge import ERROR_REACHED, unexplained_by
from tetopt.mesh import Mesh
from tetopt.model.model import Model
from tetopt.report.tables import curving_in_words
from tetopt.start.memory import bytes_of, next_bytes
from tetopt.start.octree import is_for_walls
from tetopt.system.arrays import Ints
from tetopt.system.budget import (
    BYTES_PER_GB,
    MemoryLimit,
    limit_memory,
    memory_words,
    peak_bytes,
    resident_bytes,
    return_freed,
)
from tetopt.system.files import check_space, kept_places

# of a file, at least: a VTU with the usual cell fields takes 48, other formats more
CELL_BYTES = 40
# iteration after which the time left is told: the first ones, with most exchanges, take longer
FIRST_TOLD = 3
PACE_OF = 2  # iterations: the last ones, by which it is estimated
START_WORDS = "building the initial mesh"


def mesh_task(task: Task, stop: Callable[[], bool], begin: float) -> Meshed:
    """Build the optimised mesh; `begin` is the run's start time by `time.perf_counter`."""
    job = task.plan.job
    content = task.source.content
    options = task.plan.engine_options
    kept = task.kept_labels if job.keep_connectivity else task.regions
    options |= {} if kept is None else {"cell_labels": kept}
    ends = None if job.max_seconds is None else begin + job.max_seconds
    left = None if ends is None else ends - time.perf_counter()
    options |= {"max_seconds": left, "stop": stop}
    limit = _memory_limit(task, content)
    before = peak_bytes(), resident_bytes()
    begins = list[float]()
    early = list[Path]()

    def most_bytes(nodes: int) -> float:
        return max(before[0], before[1] + bytes_of(content, nodes))

    def keep(mesh: Mesh, labels: Ints | None) -> None:
        labels = labels if task.regions is None else task.labels_of(labels)
        if labels is None and task.source.labels is not None:
            labels = cell_labels(task.source.labels, mesh)
        beside = islice(kept_places(job.output), 1)
        place = keep_early(mesh, labels, early[-1:] or (job.output, *beside))
        early.extend([] if place is None else [place])

    def attempt(run: Optimisation, initial: Mesh, aim: Aim, runs: list[SearchRun]) -> MeshingResult:
        if not runs:
            _check_initial(task, initial)
        check_space(job.output, CELL_BYTES * len(initial.cells))
        begins.append(time.perf_counter())
        start_stage("kernels", KERNEL_WORDS)
        _say_needed(aim, runs)
        nodes = max((job.nodes or 0) if aim.order == 1 else 0, len(initial.points))
        note(f"{_start_words(task, initial)}; about {memory_words(most_bytes(nodes))} of memory")
        _prepare(task)
        left = None if ends is None else ends - time.perf_counter()
        start_stage("optimise", "optimising", options["iterations"], left)
        run = run if aim.mode == "paper" else partial(run, keep=keep)
        followed = task.source.surface_words
        result = watch_run(run, initial, options["iterations"], ends, stop, limit, followed)
        _say_run(task, len(runs) + 1, result)
        if aim.target_error is not None or aim.order == 2:  # a next run may follow
            start_stage("start", START_WORDS)
        return result

    start_stage("start", START_WORDS)
    most = None if limit is None else limit.n_bytes
    with warnings_heard():
        result = search_mesh(content, _aim(task), attempt, task.source.required, most, **options)
    regions = None if task.regions is None else result.labels
    if regions is not None:
        result = result._replace(labels=task.labels_of(regions))
    _tell_curving(task, result)
    seconds = {"load": begins[0] - begin, "optimize": time.perf_counter() - begins[0]}
    return_freed()  # by the search
    n_nodes = max(result.nodes or 0, len(result.initial.points))
    memory = {"predicted_bytes": most_bytes(n_nodes)}
    early_file = early[-1] if early else None
    return Meshed(result, result.initial, seconds, memory, early_file, regions)


def _tell_curving(task: Task, result: MeshingResult) -> None:
    """Note what became of the edges of order 2."""
    if result.curving is not None:
        note(curving_in_words(result.curving))
    elif (
        task.started is not None
        and task.started.mesh.midpoints is not None
        and result.mesh.midpoints is None
    ):
        note(
            "`start`: curved edges become straight, as there are no labels or mask for their "
            "nodes to follow"
        )


def _check_initial(task: Task, initial: Mesh) -> None:
    """Raise InputError for what the writer would reject after the run, as far as the initial
    mesh shows.
    """
    job = task.plan.job
    if not has_model(job) and job.output.suffix.lower() == ".vtu":
        return

    def build(early: SolverOptions) -> Model:
        return model_with(task, initial, early, task.source.about, regions=task.regions)

    check_early(job.output, job, initial.ndim, task.source.low, build)


def _memory_limit(task: Task, content: Content) -> MemoryLimit | None:
    """Return the user's limit; raise InputError if the image alone, or the initial mesh, needs
    more.
    """
    job = task.plan.job
    if job.max_gb is None:
        return None
    n_bytes = job.max_gb * BYTES_PER_GB
    with limit_memory(n_bytes):
        check_memory_of(content, 0)
    return MemoryLimit(n_bytes, next_bytes(job.nodes or 0, content.image.ndim))


def _aim(task: Task) -> Aim:
    """Return the mesh that the run is to make."""
    plan = task.plan
    job = task.plan.job
    kind = (
        kind_of(plan, task.source.content.image.ndim) if plan.mode in ("uniform", "paper") else None
    )
    start = None if task.started is None else task.started.mesh
    return Aim(
        job.nodes,
        job.target_error,
        task.sizes,
        plan.order,
        plan.mode,
        start,
        job.spacing,
        kind,
        job.nodes_max,
    )


def _prepare(task: Task) -> None:
    """Load the compiled kernels, or compile them, before the clock of the first iteration
    starts.
    """
    return_freed()  # temporaries of the contents and the initial mesh
    content = task.source.content
    k_D = task.plan.engine_options["k_D"]
    mode = task.plan.mode
    prepare_kernels(
        content, k_D, "paper" if mode == "paper" else "fast", mode == "graded", progress
    )


def watch_run(
    run: Optimisation,
    initial: Mesh,
    iterations: int,
    ends: float | None,
    stop: Callable[[], bool],
    limit: MemoryLimit | None = None,
    followed: str = "",
) -> MeshingResult:
    """Run and report the records; end early at a time, before a limit of memory, or once `stop`
    returns true.

    `followed` names the surfaces that nodes follow, if there are any.
    """
    max_seconds = None if ends is None else max(ends - time.perf_counter(), 1e-9)

    def is_stopped() -> bool:
        return stop() or (limit is not None and limit.is_reached())

    history: list[IterationRecord] = []

    def recorded(row: IterationRecord) -> None:
        history.append(row)
        left = left_words(history, iterations, max_seconds)
        progress(f"iteration {row.iteration} of {iterations}: E {row.E:.4f}{left}", row)

    result = run(max_seconds=max_seconds, callback=recorded, stop=is_stopped)
    if iterations == 0:  # the initial mesh itself, not with nodes rounded to the sampling grid
        result = result._replace(mesh=initial)
    if result.ended == "stopped" and not stop():
        result = result._replace(ended="max_gb")
    if result.ended != "iterations":
        start_stage("optimised", "optimised")
        words = ended_words(result.ended, "the current mesh", followed)
        note(f"{words} (iteration {result.history[-1].iteration} of {iterations})")
    return result


def left_words(
    history: Sequence[IterationRecord], iterations: int, most_seconds: float | None
) -> str:
    """Return the time left at the pace of the last iterations, from the third on; before, an
    empty text.
    """
    last = history[-1]
    if last.iteration < FIRST_TOLD or last.iteration == iterations:
        return ""
    pace = (last.seconds - history[-1 - PACE_OF].seconds) / PACE_OF
    left = pace * (iterations - last.iteration)
    if most_seconds is not None:
        left = min(left, max(most_seconds - last.seconds, 0.0))
    return f", about {time_words(left)} left, then measuring"


def _say_run(task: Task, number: int, result: MeshingResult) -> None:
    """Report one of several runs, repeated until the error, or the number of nodes of order 2,
    is close enough.
    """
    job = task.plan.job
    content = task.source.content
    n_nodes = node_count(result.mesh.points, result.mesh.cells, task.plan.order)
    if (target := job.target_error) is not None:
        fraction = unexplained_by(content, result.mesh, *result.history[-1].counted)
        note(
            f"run {number} of up to {ERROR_RUNS}: {n_nodes} nodes leave {fraction:.4g} of the "
            f"variance unexplained; aim: {ERROR_REACHED * target:.4g} to {target:.4g}"
        )
    elif job.order == 2 and job.nodes is not None and task.plan.mode != "start":
        note(
            f"run {number} of up to {NODE_RUNS}: {n_nodes} of {job.nodes} nodes, including "
            "mid-edge nodes, "
            f"{abs(n_nodes / job.nodes - 1.0):.1%} off; aim: {NODES_NEAR:.0%} or less"
        )


def _say_needed(aim: Aim, runs: list[SearchRun]) -> None:
    """Report the number of nodes that a target error requires, by the runs so far."""
    if aim.target_error is None or not runs:
        return
    nodes = round(needed_corners(aim, runs) * runs[-1].nodes / runs[-1].reached)
    words = f"an error of {aim.target_error:g} requires about {nodes} nodes"
    if nodes > (most := aim.nodes_max or nodes):
        words += f"; more than `nodes_max`, so that the next run has {most} nodes"
    note(words)


def _start_words(task: Task, initial: Mesh) -> str:
    source = task.source
    image = source.contrasts[0]
    size = " x ".join(str(s) for s in image.shape)
    spacing = " x ".join(f"{s:.4g}" for s in image.spacing)
    start = f"{task.start_name} of {len(initial.points)} nodes, {len(initial.cells)} cells"
    job = task.plan.job
    plan = task.plan
    if (
        plan.mode == "graded"
        and plan.order == 1
        and source.mask is not None
        and job.nodes is not None
    ):
        start += ", to keep thin walls" if is_for_walls(len(initial.points), job.nodes) else ""
    start += f", edges up to {np.sqrt(squared_edges(initial.points, initial.cells).max()):.3g} mm"
    more = [f"and {len(source.paths) - 1} more"] if len(source.paths) > 1 else []
    more += ["labels"] if source.labels is not None else []
    if source.mask is not None:
        more += [
            f"within a {source.mask_word} of {int((source.mask.data >= INSIDE_FRACTION).sum())} "
            "voxels"
        ]
    return ", ".join([f"{source.paths[0]}: {size} voxels of {spacing} mm", *more]) + f"; {start}"
