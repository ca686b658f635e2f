"""The files that a run names, read and set beside one another."""

from __future__ import annotations

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.box import box_sides
from tetopt.geometry.simplex import centroids
from tetopt.image import Image
from tetopt.io.formats import format_of
from tetopt.job.advice import tell_label_sizes
from tetopt.job.events import started, warning
from tetopt.job.in_parts import left_source, with_parts
from tetopt.job.inputs import label_table, read_mesh, set_threads
from tetopt.job.job import Job
from tetopt.job.plan import Plan, changed, plan, with_numbers
from tetopt.job.predict import size_of_run
from tetopt.job.request import requested
from tetopt.job.source import read_source
from tetopt.job.task import Task
from tetopt.mesh import Mesh


def read(job: Job) -> Task:
    """What a job asks for, planned and read, with its threads set: what `tetopt.run` begins with.

    Parameters
    ----------
    job : Job
        What is asked for.

    Returns
    -------
    Task
        The plan with its defaults, and the files beside one another. Nothing is written.

    Raises
    ------
    InputError
        As `plan`; a file that cannot be read, or does not go with the others; options that parts do not have, where
        the mesh is to be made in some.

    See Also
    --------
    plan : The first half of it, which reads no voxels.
    run : Goes on with it.

    Examples
    --------
    >>> tetopt.save_image("small.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=4))
    >>> task = tetopt.read(tetopt.Job(images="small.nii.gz", output="small.vtu"))
    >>> task.source.content.n_voxels, task.size.n_nodes
    (4096, 512)
    """
    checked = plan(job)
    set_threads(job.threads)
    started("read", "reading and preparing the image, with its mask and labels")
    return read_planned(with_parts(checked))


def read_planned(plan: Plan) -> Task:
    """The files that a plan names, and the defaults that depend on them."""
    source = left_source(plan) or read_source(plan.job, plan.job.label_names)
    plan.division.check_image(source.content.image)
    begun = None
    if plan.job.start is not None:
        begun = read_mesh(plan.job.start)
        _check_place(begun.mesh, source.contrasts[0], str(plan.job.start))
        if plan.job.order is None and begun.order == 2 and format_of(plan.job.output).has_quadratic:
            plan = plan._replace(job=changed(plan.job, order=2))
        if source.labels is not None and not source.table.names:
            source = source.with_table(label_table(None, begun))
    plan, sizes, by_label = with_numbers(plan, source.content, source.table)
    if by_label is not None:
        tell_label_sizes(by_label, plan.job.cells_across, source.table)
    n_started = None if begun is None else len(begun.mesh.points)
    size = size_of_run(plan, source.content, source.contrasts[0], n_started)
    # With the checksums of the files as they are now.
    request = requested(changed(plan.bare, parts=plan.division.n_parts))
    return Task(plan, source, begun, sizes, size, request, by_label)


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
