"""A run: read, plan, mesh, measure, write."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from tetopt.engine.loop import MeshingResult
from tetopt.errors import error_words
from tetopt.geometry.quadratic import node_count
from tetopt.job.advice import (
    Problem,
    failures,
    has_most_empty,
    of_empty,
    of_layers,
    of_result,
    of_sizes,
    order_problems,
    sentences,
    tell,
    unmet_requirements,
)
from tetopt.job.events import Listener, listen_with, start_stage
from tetopt.job.field_files import scalar_names
from tetopt.job.job import Job
from tetopt.job.mesh_stage import mesh_task
from tetopt.job.read import read
from tetopt.job.task import Meshed, Shapes, Task
from tetopt.job.write import draw, measures_of, numbers_of, save_outcome
from tetopt.measure.judge import judge
from tetopt.measure.measures import measure_each
from tetopt.measure.quality import quality
from tetopt.mesh import Mesh
from tetopt.model.mappings import parse_any_mapping
from tetopt.model.model import Model
from tetopt.report.summary import model_summary
from tetopt.system.arrays import Json
from tetopt.system.budget import BYTES_PER_GB, limit_memory
from tetopt.system.files import outputs_of_run, save_json


class Result(NamedTuple):
    """The result of a run.

    Parameters
    ----------
    mesh : Mesh
        The optimised mesh, as in its file.
    model : Model
        The mesh with its fields, sets, materials and loads.
    numbers : dict
        Every number of the run, as in run.json.
    violated : dict of str to str
        By name, a sentence on each violated requirement and on each failed measurement; empty if
        the mesh meets all requirements.
    task : Task
        The task, with all defaults, and the files as read.
    meshed : Meshed
        The optimisation: its history, the initial mesh, seconds.
    shapes : tuple of Quality
        Quality of the initial mesh and of the result; None if a measurement failed.
    measured : dict
        Fit to mask, labels, contrasts and sizes.

    Examples
    --------
    >>> tetopt.save_image("small.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    >>> job = tetopt.Job(images="small.nii.gz", output="small.vtu", nodes=60, iterations=1)
    >>> result = tetopt.run(job)
    >>> result.model.mesh is result.mesh
    True
    >>> result.numbers["size"]["n_nodes"] == len(result.mesh.points)
    True
    """

    mesh: Mesh
    model: Model
    numbers: Json
    violated: dict[str, str]
    task: Task
    meshed: Meshed
    shapes: Shapes
    measured: Json

    @property
    def optimized(self) -> MeshingResult:
        """The result of the optimisation."""
        return self.meshed.result


def run(job: Job, on: Listener | None = None, stop: Callable[[], bool] | None = None) -> Result:
    """Mesh images and write outputs as a job specifies, with the same bytes as `tetopt mesh`.

    Parameters
    ----------
    job : Job
        The job to run.
    on : callable, optional
        Called with each `Event`; without it, warnings and violated requirements are Python's
        warnings.
    stop : callable, optional
        Called between colours of nodes; True ends the run with the current mesh.

    Returns
    -------
    Result
        Mesh, model and numbers.

    Raises
    ------
    InputError
        As for `Job`; files cannot be read or do not belong together; an output may not or cannot be
        written, and the message says where the mesh is.

    See Also
    --------
    mesh_image : Mesh an image in memory, without files.

    Notes
    -----
    For processes of your own, use
    ``multiprocessing.get_context("spawn")``: a pool that forks after a run never ends, as OpenMP's
    threads do not survive a fork.

    Ctrl-C raises KeyboardInterrupt, and an unwritten mesh is lost; to keep the current mesh, return
    True from `stop`.

    Examples
    --------
    >>> tetopt.save_image("ball.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=4))
    >>> job = tetopt.Job(images="ball.nii.gz", output="ball.vtu", nodes=300, iterations=4)
    >>> result = tetopt.run(job)
    >>> len(result.mesh.points), result.violated, result.numbers["ended"]
    (300, {}, 'iterations')
    """
    begin = time.perf_counter()
    with listen_with(on), outputs_of_run(vars(job).values()):
        with limit_memory(None if job.max_gb is None else job.max_gb * BYTES_PER_GB):
            task = read(job)
        outcome = mesh_task(task, stop or (lambda: False), begin)
        start_stage("write", "writing and measuring the mesh")
        failed: dict[str, str] = {}
        model, about = save_outcome(task, outcome, failed)
        # Only now, as nothing may fail before the mesh is written.
        shapes = _shapes(outcome, failed)
        measured = measures_of(task, outcome.result, model, failed)
        numbers = numbers_of(task, outcome, shapes, model, about, time.perf_counter() - begin)
        missing = {name: None for name in (*failed, "cells_without_voxel") if name != "fields"}
        numbers |= missing | measured | model_summary(model)
        result = Result(outcome.result.mesh, model, numbers, {}, task, outcome, shapes, measured)
        undrawn = _draw_pictures(result, failed)
        # One list for all: what is told, the exit code, run.json and a cohort's table.
        problems = _problems(result, failed)
        result = result._replace(violated=sentences(problems))
        tell(problems)
        numbers |= {"violated": result.violated, "failed": failed}
        if job.json_path is not None:
            save_json(job.json_path, numbers)
        if undrawn is not None:
            raise undrawn
        return result


def _draw_pictures(result: Result, failed: dict[str, str]) -> Exception | None:
    """Draw the pictures; return the error if that fails, which the numbers state, too, as they
    are written first.
    """
    try:
        if result.task.plan.pictures:
            draw(result.task, result.meshed, result.model)
    except Exception as error:
        failed["figures"] = error_words(error)
        return error
    return None


def _shapes(outcome: Meshed, failed: dict[str, str]) -> Shapes:
    meshes = {"quality_initial": outcome.initial, "quality": outcome.result.mesh}
    shapes = measure_each(
        {
            name: partial(quality, each.points, each.cells, each.midpoints)
            for name, each in meshes.items()
        },
        failed,
    )
    return shapes.get("quality_initial"), shapes.get("quality")


def _problems(result: Result, failed: dict[str, str]) -> list[Problem]:
    """Return violated requirements, failed measurements and oddities, worst first."""
    task = result.task
    outcome = result.meshed
    measured = result.measured
    required = dict(outcome.result.violated)
    if outcome.result.labels is None:  # but its file gives each cell that of most voxels
        of_labels = {name: rows for name, rows in measured.items() if name == "labels"}
        required |= judge(of_labels, task.source.required)
    problems = list(unmet_requirements(required, measured, task.source.required))
    problems += failures(failed, problems)
    job = task.plan.job
    mode = task.plan.mode
    expected = job.nodes if mode == "graded" and job.target_error is None else None
    n_nodes = node_count(result.model.mesh.points, result.model.mesh.cells, result.model.order)
    spacing = task.source.contrasts[0].spacing
    # their values are right anyway
    n_empty = 0 if task.source.is_constant else measured.get("cells_without_voxel", 0)
    # else fewer nodes hardly help cells that follow labels
    is_most = has_most_empty(outcome.result, n_empty)
    is_free = mode != "start" and (is_most or task.source.labels is None)
    is_free &= measured.get("nodes_of_sizes", 0) <= n_nodes
    names = scalar_names(job.fields)
    mapping = None if job.young is None else parse_any_mapping(job.young, fields=names)
    has_moduli = (callable(mapping) or isinstance(mapping, list)) and job.average != "linear"
    is_masked = task.source.mask is not None
    empty = list(of_empty(outcome.result, is_free, n_empty, spacing, is_masked, has_moduli))
    problems = [*empty, *problems] if is_most else problems
    if job.cells_across is not None:
        problems += of_layers(
            measured.get("labels", []), job.cells_across, measured.get("label_names", {})
        )
    has_sizes = task.plan.has_sizes
    problems += of_result(
        outcome.result, job.method, mode, n_nodes, expected, measured, job.k_D, has_sizes
    )
    if task.sizes is not None and (edges := result.shapes[1]) is not None:
        sizes = task.sizes._replace(longest=task.plan.bare.edge_max)  # without a default
        problems += of_sizes(
            sizes, edges.min_edge, edges.max_edge, measured.get("edges_over_target")
        )
    return order_problems(problems if is_most else [*problems, *empty])
