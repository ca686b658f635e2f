"""The files that a run names, read and set beside one another."""

from __future__ import annotations

from typing import Any

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.box import box_sides
from tetopt.geometry.simplex import centroids
from tetopt.image import Image
from tetopt.io.formats import format_of
from tetopt.job.events import started, warning
from tetopt.job.in_parts import is_left_stored, read_stored, with_parts
from tetopt.job.inputs import label_table, read_mesh, set_threads
from tetopt.job.job import Job
from tetopt.job.plan import Plan, changed, planned, with_numbers
from tetopt.job.predict import size_of_run
from tetopt.job.request import requested
from tetopt.job.source import read_source
from tetopt.job.task import Task
from tetopt.mesh import Mesh


def task_of(job: Job) -> Task:
    """What a job asks for, planned and read, with its threads set.

    Raises
    ------
    InputError
        As `planned`, `with_parts` and `read`.
    """
    plan = planned(job)
    set_threads(job.threads)
    started("read", "reading and preparing the image, with its mask and labels")
    return read(with_parts(plan))


def read(plan: Plan) -> Task:
    """The files that a plan names, and the defaults that depend on them.

    Raises
    ------
    InputError
        A file that cannot be read, or does not go with the others.
    """
    if plan.n_parts is not None and is_left_stored(plan):
        stored = read_stored(plan)
        plan, sizes = with_numbers(plan, stored.content)
        size = size_of_run(plan, stored.content, stored.content.image)
        return Task(plan, stored, None, sizes, size, _request_of(plan))
    source = read_source(plan.job, plan.job.label_names)
    if plan.n_parts is not None and source.content.image.ndim != 3:
        raise InputError("`parts`: of a volume, and the image is a plane; leave it out")
    begun = None
    if plan.job.start is not None:
        begun = read_mesh(plan.job.start)
        _check_place(begun.mesh, source.contrasts[0], str(plan.job.start))
        if plan.job.order is None and begun.order == 2 and format_of(plan.job.output).has_quadratic:
            plan = plan.with_job(order=2)
        if source.labels is not None and not source.table.names:
            source = source.with_table(label_table(None, begun))
    plan, sizes = with_numbers(plan, source.content)
    n_started = None if begun is None else len(begun.mesh.points)
    size = size_of_run(plan, source.content, source.contrasts[0], n_started)
    return Task(plan, source, begun, sizes, size, _request_of(plan))


def _request_of(plan: Plan) -> dict[str, Any]:
    """What decides the outputs, with the checksums of the files as they are now."""
    return requested(changed(plan.bare, parts=plan.n_parts))


def _check_place(mesh: Mesh, image: Image, path: str) -> None:
    """InputError for a mesh off the image, a warning for one that lies partly beside it."""
    if mesh.ndim != image.ndim:
        raise InputError(f"{path}: expected a {image.ndim}-D mesh, as the image is, got a {mesh.ndim}-D one")
    index = image.to_index(centroids(mesh.points, mesh.cells))
    low, high = box_sides(image.shape).T
    is_in = ((index >= low) & (index <= high)).all(axis=1)
    if not is_in.any():
        raise InputError(f"{path}: lies beside the image; do both lie in the same world mm (RAS+)?")
    if not is_in.all():
        warning(f"{path}: {np.mean(~is_in):.1%} of its cells lie beside the image, where it has no say")
