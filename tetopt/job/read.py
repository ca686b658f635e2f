"""Reading and alignment of the files of a run."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np

from tetopt.errors import InputError
from tetopt.io.formats import format_of
from tetopt.job.advice import tell_label_sizes
from tetopt.job.events import note, start_stage, warnings_heard
from tetopt.job.field_files import read_fields
from tetopt.job.job import Job
from tetopt.job.mesh_file import check_mesh_place, label_table, read_mesh, warn_of_other_image
from tetopt.job.moved import move_file, tell_fit
from tetopt.job.plan import (
    Plan,
    changed_options,
    check_volume,
    nodes_of_targets,
    plan,
    with_numbers,
)
from tetopt.job.request import job_request
from tetopt.job.source import read_source
from tetopt.job.task import Task
from tetopt.model.sets import regions_of


def read(job: Job) -> Task:
    """Plan a job, set its threads and read its files; the first step of `tetopt.run`.

    Parameters
    ----------
    job : Job
        The job to read.

    Returns
    -------
    Task
        The plan with its defaults, and the aligned files. Nothing is written.

    Raises
    ------
    InputError
        As for `plan`; a file cannot be read, or does not match the others; meshing the image would
        take more memory than is free.

    See Also
    --------
    plan : The first half, which reads no voxels.
    run : Run the task.

    Examples
    --------
    >>> tetopt.save_image("small.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=4))
    >>> task = tetopt.read(tetopt.Job(images="small.nii.gz", output="small.vtu"))
    >>> task.source.content.n_voxels, task.plan.job.nodes
    (4096, 512)
    """
    checked = plan(job)
    set_threads(job.threads)
    start_stage("read", "reading and preparing the image, with its mask and labels")
    check_volume(checked)
    return read_planned(checked)


def read_planned(plan: Plan) -> Task:
    """Read the files of a plan, and fill in the defaults that depend on them."""
    start = regions = None
    if plan.job.start is not None:
        unmoved = read_mesh(plan.job.start, plan.job)
        start = move_file(unmoved, plan.job, plan.job.images[0])
    with warnings_heard():
        fields = read_fields(plan.job.fields)
    source = read_source(plan.job, plan.job.label_names, loaded=start)
    if start is not None:
        image = source.contrasts[0]
        path = Path(str(plan.job.start))
        check_mesh_place(path, start.mesh, image)
        if plan.job.transform:
            tell_fit(unmoved, start.mesh, source.content, path)
        warn_of_other_image(start, path, source.paths[0], image, is_registered=None)
        if plan.job.order is None and start.order == 2 and format_of(plan.job.output).has_quadratic:
            plan = plan._replace(job=changed_options(plan.job, order=2))
        if not source.table.names and (source.labels is not None or start.labels is not None):
            source = source.with_table(label_table(None, start))
        if plan.job.keep_connectivity:
            note(f"{path}: its cells, labels and sets stay, and nodes move")
        elif source.labels is None:
            regions = regions_of(start.labels, start.sets, len(start.mesh.cells))
        if regions is not None:
            n_regions = len(np.unique(regions))
            fixed = f"; nodes between these {n_regions} regions are fixed" * (n_regions > 1)
            note(f"{path}: its labels and cell sets stay{fixed}")
        elif start.labels is not None and not plan.job.keep_connectivity:
            note(f"{path}: its labels are dropped for those of the image")
    plan, sizes, by_label = with_numbers(plan, source.content, source.table)
    if by_label is not None:
        tell_label_sizes(by_label)
    elif (needed := nodes_of_targets(plan, source.content, sizes)) is not None:
        note(f"sizes require about {needed} nodes")
    # With the files' current checksums.
    request = job_request(plan.bare)
    return Task(plan, source, start, sizes, request, by_label, regions, fields)


def set_threads(threads: int | None) -> None:
    """Set the number of threads, or leave it; raise InputError for more than the machine has."""
    if threads is None:
        return
    most = int(numba.config.NUMBA_NUM_THREADS)
    if not 1 <= threads <= most:
        raise InputError(f"`threads`: expected 1 to {most} on this machine, got {threads}")
    numba.set_num_threads(threads)
