"""Planning of a run: contradictions are rejected and defaults filled in, only here."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tetopt.contents.content import Content, check_weights
from tetopt.engine.aim import Mode, nodes_per_corner
from tetopt.engine.fast import check_options
from tetopt.engine.loop import DEFAULT_NODES, MIN_DIHEDRAL, SHAPE_POWER, TARGET_NODES_MAX
from tetopt.engine.meshing import (
    check_target_error,
    default_nodes,
    default_options,
    sizes_of_order,
    with_label_sizes,
)
from tetopt.engine.paper import default_n_t
from tetopt.errors import InputError
from tetopt.io.formats import FORMATS
from tetopt.io.images import check_bounds, file_shape, parse_crop, parse_slice, smaller_words
from tetopt.io.label_tables import NO_TABLE, LabelTable
from tetopt.job.aligned import read_companion
from tetopt.job.option_values import balance_of, label_sizes_of, number_of
from tetopt.job.options import JobOptions, MeshPart, Method, MoveOptions
from tetopt.job.solver_files import check_solver_options
from tetopt.model.mappings import named_file
from tetopt.model.tissues import groups_of
from tetopt.start.label_sizes import SizesByLabel
from tetopt.start.lattice import KINDS, MAX_NODES
from tetopt.start.memory import BOUND_MARGIN, CHANNEL_BYTES, meshing_bytes
from tetopt.start.octree import nodes_of_sizes
from tetopt.start.sizes import Sizes
from tetopt.system.arrays import Json
from tetopt.system.budget import check_memory
from tetopt.system.files import check_output, check_outputs, results_folder

VOXEL_BYTES = 16.0  # of an image that is read whole, in addition to meshing
FEWEST_NODES = 5  # of the smallest mesh, an octree in 2-D: a square's corners and its middle
EXCLUSIVE_OPTIONS = (("mask", "background"), ("keep_labels", "drop_labels"), ("labels", "tissues"))
LABEL_OPTIONS = (  # without a meaning if there are no labels
    "keep_labels",
    "drop_labels",
    "fill_holes",
    "label_names",
    "label_weight",
    "cells_across",
    "label_size",
    "free_volumes",
    "smooth_interfaces",
)
COUNT_OPTIONS = ("nodes", "spacing", "target_error")  # one of them states the number of nodes
SIZE_NAMES = (
    "size_min",
    "edge_size",
    "edge_max",
    "gradation",
    "sizing",
    "cells_across",
    "label_size",
)


# in this order, before those of the engine
STATED_OPTIONS = (
    *("nodes", "target_error", "nodes_max", "spacing", "lattice", "size_min", "edge_size"),
    *("edge_max", "gradation", "cells_across", "label_size", "sizing", "volume", "crop", "slice"),
    *("method", "max_seconds", "max_gb", "start"),
)


class Plan(NamedTuple):
    """A consistent run, with the defaults that do not depend on the image.

    Parameters
    ----------
    mode : {"graded", "uniform", "paper", "start"}
        As in `mesh_image`.
    job : JobOptions
        The options, with defaults.
    bare : JobOptions
        The options as given, without defaults.
    pictures : sequence of Path
        Pictures to draw: slice, rho, energies; with a mask, its boundary; with labels, the labels;
        a thumbnail.

    Examples
    --------
    >>> plan = tetopt.plan(tetopt.Job(images="brain.nii.gz", output="brain.vtu", nodes=5000))
    >>> plan.mode, plan.job.k_D, plan.bare.k_D
    ('graded', 0.85, None)
    """

    mode: Mode
    job: JobOptions
    bare: JobOptions
    pictures: Sequence[Path] = ()

    @property
    def order(self) -> int:
        """Order of the cells, 1 or 2; by default 1, linear."""
        return self.job.order or 1

    @property
    def has_sizes(self) -> bool:
        """True if sizes were requested; order 2 has sizes of its own."""
        return any(getattr(self.bare, name) is not None for name in SIZE_NAMES)

    @property
    def engine_options(self) -> Json:
        """Options of `mesh_image` except those of the initial mesh, in the order of run.json."""
        job = self.job
        options = {"k_D": job.k_D, "iterations": job.iterations, "boundary": job.boundary}
        if self.mode == "paper":
            return options | {"n_t": job.n_t, "retessellate": job.retessellate}
        options |= {"shape_power": job.shape_power, "min_dihedral": job.min_dihedral}
        return options | ({"keep_connectivity": True} if job.keep_connectivity else {})


def kind_of(plan: Plan, ndim: int) -> str:
    """Return the kind of the initial mesh: a kind of lattice, octree or start."""
    if plan.mode == "start":
        return "start"
    if plan.mode == "graded":
        return "octree"
    return plan.job.lattice or KINDS[ndim][0]


def check_volume(plan: Plan) -> None:
    """Raise InputError if the file's header states more voxels than memory can mesh; none is read.

    Only a run without a mask meshes them all; the reader checks the memory of reading.
    """
    job = plan.job
    if has_region(job) or job.slice_ is not None:
        return
    path = job.images[0]
    shape = (file_shape(path) or ())[:3]
    crop = [(None, None)] * 3 if job.crop is None else parse_crop(job.crop)
    if len(shape) < 3 or len(crop) != 3:  # the reader rejects such a crop
        return
    bounds = check_bounds(shape, crop)
    n_voxels = prod(stop - start for start, stop in bounds)
    fixed = meshing_bytes(0, 0, job.nodes or DEFAULT_NODES[3])
    each = VOXEL_BYTES + BOUND_MARGIN * CHANNEL_BYTES * len(job.images)
    check_memory(
        fixed + each * n_voxels,
        f"{path}: an image of {' x '.join(str(stop - start) for start, stop in bounds)} voxels",
        lambda room: smaller_words(path, bounds, (room - fixed) / each),
    )


def stated_options(plan: Plan, ndim: int) -> Json:
    """Return the options as the mesh's file and run.json state them; files by their names."""
    job = plan.job
    own = {"lattice": kind_of(plan, ndim), "slice": job.slice_}
    files = {"sizing": job.sizing, "start": job.start}
    own |= {name: None if file is None else file.name for name, file in files.items()}
    stated = {name: own[name] if name in own else getattr(job, name) for name in STATED_OPTIONS}
    return stated | plan.engine_options


def plan(job: JobOptions) -> Plan:
    """Check a job, and fill in defaults that do not depend on the image; no voxel is read.

    Parameters
    ----------
    job : Job
        The job to plan.

    Returns
    -------
    Plan
        The plan, with the pictures to draw.

    Raises
    ------
    InputError
        As for `Job`; or an output may not be written.

    See Also
    --------
    read : Also read the files, and fill in the defaults that depend on them.

    Examples
    --------
    >>> plan = tetopt.plan(tetopt.Job(images="brain.nii.gz", output="brain.vtu", spacing=4))
    >>> plan.mode, plan.job.iterations, plan.job.boundary
    ('uniform', 20, 'slide')
    """
    check_output(job.output, tuple(FORMATS), job.force)
    if job.json_path is not None:
        check_output(job.json_path, (".json",), job.force)
    return plan_job(job, reads_files=True)._replace(pictures=_pictures(job))


def plan_job(job: JobOptions, *, reads_files: bool) -> Plan:
    """Plan a job; of all files, those of mappings and sizes alone are read, and only if
    `reads_files`.

    Raises
    ------
    InputError
        Options contradict each other or are out of range, as far as no file has to be read.
    """
    _check_source(job)
    _check_numbers(job, reads_files)
    check_solver_options(job.output, job, reads_files=reads_files)
    mode = _mode(job)
    for name in (*SIZE_NAMES, "target_error"):
        if mode != "graded" and getattr(job, name) is not None:
            raise InputError(
                f"`{name}`: needs a graded mesh; leave out `uniform`, `spacing`, `lattice`, "
                "`method`, `start`"
            )
    completed = _complete_options(job, mode)
    is_plain = len(job.images) == 1 and not (has_region(job) or job.labels or job.tissues)
    if mode == "paper" and not is_plain:
        raise InputError(
            "`method` paper: needs one IMAGE and its whole box; leave out mask, labels and other "
            "images"
        )
    return Plan(mode, completed, job)


def changed_options(job: JobOptions, **values: Any) -> JobOptions:
    """Return the options with values of a plan, which are not checked."""
    return JobOptions(**(vars(job) | values))


def has_region(job: JobOptions) -> bool:
    """Return whether the options leave out a part of the image's box."""
    return any(
        each is not None for each in (job.mask, job.background, job.keep_labels, job.drop_labels)
    )


def _check_source(job: JobOptions) -> None:
    """Raise InputError for contradictions among the options of mask and labels."""
    if job.mask_label is not None and job.mask is None:
        raise InputError("`mask_label`: needs `mask`")
    for names in EXCLUSIVE_OPTIONS:
        if all(getattr(job, name) is not None for name in names):
            raise InputError(f"`{names[0]}` and `{names[1]}`: give only one of them")
    if job.keep_components and not has_region(job):
        raise InputError("`keep_components`: needs `mask` or `background`; leave it out")
    if job.merge is not None and job.labels is None:
        raise InputError("`merge`: needs `labels`")
    if job.labels is None and job.tissues is None:
        for name in LABEL_OPTIONS:
            is_of_mask = name == "label_names" and job.mask_label is not None
            if getattr(job, name) != getattr(JobOptions, name) and not is_of_mask:
                raise InputError(f"`{name}`: needs `labels`")
    if job.merge is not None and named_file(job.merge) is None:
        groups_of(job.merge)


def _check_numbers(job: JobOptions, reads_files: bool) -> None:
    """Raise InputError for numbers that are invalid for any image."""
    check_weights(len(job.images), *balance_of(job))
    if job.background not in (None, "auto"):
        number_of("`background`", str(job.background))
    if job.crop is not None:
        parse_crop(job.crop)
    if job.slice_ is not None:
        parse_slice(job.slice_)
    most = round(MAX_NODES * nodes_per_corner(3, job.order or 1))
    if job.nodes is not None and not FEWEST_NODES <= job.nodes <= most:
        raise InputError(
            f"`nodes`: expected a whole number from {FEWEST_NODES} to {most}, got {job.nodes}"
        )
    if job.spacing is not None and not 0.0 < job.spacing < np.inf:
        raise InputError(f"`spacing`: expected a length above 0 mm, got {job.spacing}")
    if job.target_error is not None:
        check_target_error(job.target_error)
    elif job.nodes_max is not None:
        raise InputError(
            "`nodes_max`: needs `target_error`; without it, `nodes` is the number of nodes"
        )
    _limits(changed_options(job, sizing=None, label_size=None))
    if job.label_size is not None and (reads_files or named_file(job.label_size) is None):
        label_sizes_of(job.label_size)


def _mode(job: JobOptions) -> Mode:
    """Return the mode that the options select; a graded mesh is the default."""
    counts = [name for name in COUNT_OPTIONS if getattr(job, name) is not None]
    if len(counts) > 1:
        raise InputError(f"{' and '.join(f'`{name}`' for name in counts)}: give only one of them")
    is_paper = job.method == "paper"
    if job.lattice == "octree":
        if job.uniform:
            raise InputError("`uniform` and `lattice` octree: give only one of them")
        if is_paper:
            raise InputError("`lattice` octree: only with `method` fast, got `method` paper")
        if job.spacing is not None:
            raise InputError(
                "`lattice` octree: has no single spacing; use `nodes` instead of `spacing`"
            )
    if job.start is not None:
        regions = ["lattice"]
        if not job.keep_connectivity:
            regions += ["mask", "background", "keep_labels", "drop_labels"]
        others = [*counts, *(name for name in regions if getattr(job, name) is not None)]
        if others := [*others, *["uniform"] * job.uniform]:
            raise InputError(
                f"`start` and `{others[0]}`: {job.start} already has nodes and a boundary; leave "
                "one out"
            )
        if is_paper:
            raise InputError(
                "`start`: only with `method` fast, which preserves a non-convex boundary"
            )
        return "start"
    of_start = vars(MeshPart()) | vars(MoveOptions()) | {"keep_connectivity": False}
    if stated := [name for name, none in of_start.items() if getattr(job, name) != none]:
        raise InputError(f"`{stated[0]}`: needs `start`")
    if is_paper:
        return "paper"
    is_lattice = job.uniform or job.spacing is not None or job.lattice not in (None, "octree")
    return "uniform" if is_lattice else "graded"


def _complete_options(job: JobOptions, mode: Mode) -> JobOptions:
    """Return the engine's options with the mode's defaults; raise InputError for invalid ones."""
    default = default_options(mode, job.keep_connectivity, has_region(job))
    k_D = default.k_D if job.k_D is None else job.k_D
    iterations = default.iterations if job.iterations is None else job.iterations
    if not 0.0 <= k_D < 1.0:
        raise InputError(f"`k_D`: expected 0 <= k_D < 1, got {k_D}")
    for name, most in (("max_seconds", job.max_seconds), ("max_gb", job.max_gb)):
        if most is not None and not most > 0.0:
            raise InputError(f"`{name}`: expected more than 0, got {most}")
    boundary = job.boundary or default.boundary
    job = changed_options(job, k_D=k_D, iterations=iterations, boundary=boundary)
    if job.target_error is not None:
        job = changed_options(job, nodes_max=job.nodes_max or TARGET_NODES_MAX)
    _check_method(job, "paper", ("n_t", "retessellate"))
    _check_method(job, "fast", ("shape_power", "min_dihedral"))
    if mode == "paper":
        n_t = default_n_t(k_D, iterations) if job.n_t is None else job.n_t
        return changed_options(job, n_t=n_t, retessellate=job.retessellate or "first")
    shape_power = SHAPE_POWER if job.shape_power is None else job.shape_power
    min_dihedral = MIN_DIHEDRAL if job.min_dihedral is None else job.min_dihedral
    check_options(k_D, iterations, shape_power, min_dihedral, boundary)
    return changed_options(job, shape_power=shape_power, min_dihedral=min_dihedral)


def _check_method(job: JobOptions, method: Method, names: tuple[str, ...]) -> None:
    """Raise InputError for an option of the other method."""
    wrong = [name for name in names if getattr(job, name) is not None]
    if wrong and job.method != method:
        raise InputError(f"`{wrong[0]}`: only with `method` {method}, got `method` {job.method}")


def _pictures(job: JobOptions) -> list[Path]:
    """Return the pictures to draw, after a check that they may be written."""
    if job.figures is None:
        return []
    names = ["slice.png", "rho.png", "energies.png"]
    names += ["boundary.png"] if has_region(job) else []
    names += [] if job.labels is None and job.tissues is None else ["labels.png"]
    names += ["thumbnail.png"]
    return list(check_outputs(results_folder(job.figures), names, job.force).values())


def with_numbers(
    plan: Plan, content: Content, table: LabelTable = NO_TABLE
) -> tuple[Plan, Sizes | None, SizesByLabel | None]:
    """Return the plan with the defaults that depend on the image, the sizes, and those by label;
    `table` names labels.

    The defaults are the number of nodes, as the sizes require or fewer on small images, and the
    longest edge, which applies anyway and is stated.
    """
    image = content.image
    job = plan.job
    is_counted = job.nodes is not None or job.target_error is not None or job.spacing is not None
    if plan.mode == "start":
        return plan, None, None
    if plan.mode != "graded":
        nodes = job.nodes if is_counted else DEFAULT_NODES[image.ndim]
        return plan._replace(job=changed_options(job, nodes=nodes)), None, None
    order = plan.order
    nodes = job.nodes
    limits = _limits(job, table)
    by_label = None
    if limits is not None:
        limits, by_label = with_label_sizes(limits, content, nodes, order)
    if not is_counted:
        nodes = default_nodes(content, limits, order)
    limits = sizes_of_order(content, nodes, limits, order)
    longest = job.edge_max
    if longest is None and nodes is not None:
        longest = (limits or Sizes()).longest_edge(image, nodes, content.volume)
        longest = longest if longest < np.inf else None
    return plan._replace(job=changed_options(job, nodes=nodes, edge_max=longest)), limits, by_label


def nodes_of_targets(plan: Plan, content: Content, sizes: Sizes | None) -> int | None:
    """Return the number of nodes that target sizes take, for order 2 with mid-edge nodes; None
    without targets.
    """
    if sizes is None or not sizes.has_target:
        return None
    return round(
        nodes_of_sizes(content, sizes)[0] * nodes_per_corner(content.image.ndim, plan.order)
    )


def expected_nodes(plan: Plan, content: Content) -> int:
    """Return the requested number of nodes, or the usual one if only the run can tell."""
    ndim = content.image.ndim
    spacing = plan.job.spacing
    if spacing is not None:
        # two per block, in five-tet lattices one
        return round(2.0 * content.volume / spacing**ndim)
    return plan.job.nodes or DEFAULT_NODES[ndim]


def _limits(job: JobOptions, table: LabelTable = NO_TABLE) -> Sizes | None:
    """Return the limits on sizes, if the options set any."""
    by_label = None if job.label_size is None else label_sizes_of(job.label_size, table)
    field = None if job.sizing is None else read_companion(job.sizing, job.spacing_mm)
    values = {
        "smallest": job.size_min,
        "edge_size": job.edge_size,
        "gradation": job.gradation,
        "field": field,
        "longest": job.edge_max,
        "cells_across": job.cells_across,
        "by_label": by_label,
    }
    limits: Json = {name: value for name, value in values.items() if value is not None}
    return Sizes(**limits) if limits else None
