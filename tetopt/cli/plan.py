"""What a run of `tetopt mesh` is to do: contradictions are refused, defaults are filled in, once and here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import tetopt
from tetopt import InputError
from tetopt.cli.inputs import checked_outputs, number_of, read_companion, weights_of
from tetopt.cli.options import (
    DEFAULT_NODES,
    EngineOptions,
    Method,
    OutputOptions,
    SizeOptions,
    SolverOptions,
    SourceOptions,
    StartOptions,
)
from tetopt.cli.solver import check_solver_options
from tetopt.engine.fast import check_options
from tetopt.engine.loop import MIN_DIHEDRAL, SHAPE_POWER
from tetopt.engine.meshing import MODE_DEFAULTS, QUADRATIC_NODES, Mode, check_target_error, sizes_of_order
from tetopt.engine.paper import default_n_t
from tetopt.io.files import checked_output, results_folder
from tetopt.io.formats import FORMATS, format_of
from tetopt.io.images import parse_crop, parse_slice
from tetopt.start.lattice import KINDS
from tetopt.start.octree import nodes_of_sizes
from tetopt.target.content import SMOOTH_INTERFACES, Content, StoredContent, check_weights

FEWEST_NODES = 5  # of the smallest mesh that there is, an octree in 2-D: a square's corners and its middle


class Plan(NamedTuple):
    """A run without contradictions: options whose default does not depend on the image have their value."""

    mode: Mode
    source: SourceOptions
    sizes: SizeOptions
    start: StartOptions
    engine: EngineOptions
    solver: SolverOptions
    output: OutputOptions
    pictures: list[Path]  # slice, rho, energies, with a mask its boundary, with labels these, last a thumbnail

    def kind(self, ndim: int) -> str:
        """What the initial mesh is: a kind of lattice, octree or start."""
        if self.mode == "start":
            return "start"
        if self.mode == "graded":
            return "octree"
        return self.start.lattice or KINDS[ndim][0]

    def engine_options(self) -> dict[str, Any]:
        """Options of `mesh_image` besides those of the mesh to begin with, in the order of run.json."""
        engine = self.engine
        options = {"k_D": engine.k_D, "iterations": engine.iterations, "boundary": engine.boundary}
        if self.mode == "paper":
            return options | {"n_t": engine.n_t, "retessellate": engine.retessellate}
        return options | {"shape_power": engine.shape_power, "min_dihedral": engine.min_dihedral}

    def stated(self, ndim: int) -> dict[str, Any]:
        """The options as the mesh's file and run.json state them; files by their names."""
        sizes, start, part = self.sizes, self.start, self.source.part
        return {
            "nodes": sizes.nodes, "target_error": sizes.target_error, "spacing": start.spacing,
            "lattice": self.kind(ndim), "size_min": sizes.size_min, "size_max": sizes.size_max,
            "edge_max": sizes.edge_max, "gradation": sizes.gradation,
            "sizing": None if sizes.sizing is None else sizes.sizing.name,
            **part.stated(), "method": self.engine.method, "max_seconds": self.engine.max_seconds,
            "max_gb": self.engine.max_gb,
            "start": None if start.start is None else start.start.name, **self.engine_options(),
        }  # fmt: skip


def planned(
    source: SourceOptions, sizes: SizeOptions, start: StartOptions, engine: EngineOptions, solver: SolverOptions,
    output: OutputOptions,
) -> Plan:  # fmt: skip
    """The run that the options ask for.

    Raises
    ------
    InputError
        Options that contradict each other or are out of range, as far as they tell without any file being read; an
        output that may not be written.
    """
    _check_source(source, solver)
    _check_numbers(source, sizes, start)
    format_of(output.mesh)
    checked_output(output.mesh, tuple(FORMATS), output.force)
    check_solver_options(output.mesh, solver)
    if output.json_path is not None:
        checked_output(output.json_path, (".json",), output.force)
    mode = _mode(source, sizes, start, engine)
    for name in ("size_min", "size_max", "edge_max", "gradation", "sizing", "target_error"):
        if mode != "graded" and getattr(sizes, name) is not None:
            raise InputError(
                f"--{name.replace('_', '-')}: only on a graded mesh; leave out --uniform, --spacing, --lattice, "
                "--method, --start"
            )
    engine = _completed(engine, mode)
    pictures = _pictures(source, output)
    is_plain = len(source.images) == 1 and not (source.mask or source.background or source.labels)
    if mode == "paper" and not is_plain:
        raise InputError("--method paper: takes one IMAGE and its whole box; leave out mask, labels and further ones")
    return Plan(mode, source, sizes, start, engine, solver, output, pictures)


def _check_source(source: SourceOptions, solver: SolverOptions) -> None:
    """InputError for what of mask and labels contradicts itself."""
    if source.mask is not None and source.background is not None:
        raise InputError("--mask and --background: give one of them")
    if source.keep_components and source.mask is None and source.background is None:
        raise InputError("--keep-components: needs --mask or --background; leave it out")
    if source.labels is None:
        beside = {**vars(source), "label_names": solver.label_names}
        for name in ("label_names", "label_weight", "smooth_interfaces"):
            if beside[name] is not None:
                raise InputError(f"--{name.replace('_', '-')}: there are no --labels")


def _check_numbers(source: SourceOptions, sizes: SizeOptions, start: StartOptions) -> None:
    """InputError for numbers that are none of their options', whatever the image is."""
    tension = SMOOTH_INTERFACES if source.smooth_interfaces is None else source.smooth_interfaces
    check_weights(len(source.images), weights_of(source), source.label_weight or 0.0, tension)
    if source.background not in (None, "auto"):
        number_of("--background", str(source.background))
    if source.part.crop is not None:
        parse_crop(source.part.crop)
    if source.part.slice_ is not None:
        parse_slice(source.part.slice_)
    if sizes.nodes is not None and sizes.nodes < FEWEST_NODES:
        raise InputError(f"--nodes: expected a whole number, {FEWEST_NODES} or more, got {sizes.nodes}")
    if start.spacing is not None and not 0.0 < start.spacing < np.inf:
        raise InputError(f"--spacing: expected a length above 0 mm, got {start.spacing}")
    if sizes.target_error is not None:
        check_target_error(sizes.target_error)
    _limits(replace(sizes, sizing=None))


def _mode(source: SourceOptions, sizes: SizeOptions, start: StartOptions, engine: EngineOptions) -> Mode:
    """Which of the four ways the options ask for; a graded mesh is the default."""
    numbers = {"--nodes": sizes.nodes, "--spacing": start.spacing, "--target-error": sizes.target_error}
    if len(names := [name for name, value in numbers.items() if value is not None]) > 1:
        raise InputError(f"{' and '.join(names)}: give one of them")
    is_paper = engine.method == "paper"
    if start.lattice == "octree":
        if start.uniform:
            raise InputError("--uniform and --lattice octree: give one of them")
        if is_paper:
            raise InputError("--lattice octree: only with --method fast, got --method paper")
        if start.spacing is not None:
            raise InputError("--lattice octree: has no one spacing; give --nodes instead of --spacing")
    if start.start is not None:
        others = {**numbers, "--lattice": start.lattice, "--mask": source.mask, "--background": source.background}
        others["--uniform"] = start.uniform or None
        if names := [name for name, value in others.items() if value is not None]:
            raise InputError(
                f"--start and {names[0]}: {start.start} has its nodes and its boundary already; leave one out"
            )
        if is_paper:
            raise InputError("--start: only with --method fast, whose moves keep a boundary that is not convex")
        return "start"
    if is_paper:
        return "paper"
    is_lattice = start.uniform or start.spacing is not None or start.lattice not in (None, "octree")
    return "uniform" if is_lattice else "graded"


def _completed(engine: EngineOptions, mode: Mode) -> EngineOptions:
    """The engine's options with the defaults of the mode; InputError where they cannot be."""
    k_D, iterations = MODE_DEFAULTS[mode]
    k_D = k_D if engine.k_D is None else engine.k_D
    iterations = iterations if engine.iterations is None else engine.iterations
    if not 0.0 <= k_D < 1.0:
        raise InputError(f"--k-d: expected 0 <= k_D < 1, got {k_D}")
    if engine.max_seconds is not None and not engine.max_seconds > 0.0:
        raise InputError(f"--max-seconds: expected more than 0, got {engine.max_seconds}")
    if engine.max_gb is not None and not engine.max_gb > 0.0:
        raise InputError(f"--max-gb: expected more than 0, got {engine.max_gb}")
    boundary = engine.boundary or ("fixed" if mode == "start" else "slide")
    engine = replace(engine, k_D=k_D, iterations=iterations, boundary=boundary)
    _check_method(engine, "paper", ("n_t", "retessellate"))
    _check_method(engine, "fast", ("shape_power", "min_dihedral"))
    if mode == "paper":
        n_t = default_n_t(k_D, iterations) if engine.n_t is None else engine.n_t
        return replace(engine, n_t=n_t, retessellate=engine.retessellate or "first")
    shape_power = SHAPE_POWER if engine.shape_power is None else engine.shape_power
    min_dihedral = MIN_DIHEDRAL if engine.min_dihedral is None else engine.min_dihedral
    check_options(k_D, iterations, shape_power, min_dihedral, boundary)
    return replace(engine, shape_power=shape_power, min_dihedral=min_dihedral)


def _check_method(engine: EngineOptions, method: Method, names: tuple[str, ...]) -> None:
    """InputError for an option of the other method."""
    wrong = [name for name in names if getattr(engine, name) is not None]
    if wrong and engine.method != method:
        option = wrong[0].replace("_", "-")
        raise InputError(f"--{option}: only with --method {method}, got --method {engine.method}")


def _pictures(source: SourceOptions, output: OutputOptions) -> list[Path]:
    """The pictures to draw, as far as they may be written."""
    if output.figures is None:
        return []
    names = ["slice.png", "rho.png", "energies.png"]
    names += [] if source.mask is None and source.background is None else ["boundary.png"]
    names += [] if source.labels is None else ["labels.png"]
    names += ["thumbnail.png"]
    return list(checked_outputs(results_folder(output.figures), names, output.force).values())


def with_numbers(plan: Plan, content: Content | StoredContent) -> tuple[Plan, tetopt.Sizes | None]:
    """The plan with the defaults that depend on the image, and the sizes.

    These are the number of nodes, as many as the sizes take or fewer on small images, and the longest edge, which holds
    anyway and is stated.
    """
    image, sizes = content.image, plan.sizes
    is_counted = sizes.nodes is not None or sizes.target_error is not None or plan.start.spacing is not None
    if plan.mode == "start":
        return plan, None
    if plan.mode != "graded":
        nodes = sizes.nodes if is_counted else DEFAULT_NODES[image.ndim]
        return plan._replace(sizes=replace(sizes, nodes=nodes)), None
    order, nodes, limits = plan.solver.order or 1, sizes.nodes, _limits(sizes)
    if not is_counted:
        nodes = _default_nodes(content, limits, QUADRATIC_NODES[image.ndim] if order == 2 else 1.0)
    limits = sizes_of_order(content, nodes, limits, order)
    longest = sizes.edge_max
    if longest is None and nodes is not None:
        longest = (limits or tetopt.Sizes()).longest_edge(image, nodes, content.volume)
        longest = longest if longest < np.inf else None
    return plan._replace(sizes=replace(sizes, nodes=nodes, edge_max=longest)), limits


def _default_nodes(content: Content | StoredContent, limits: tetopt.Sizes | None, many: float) -> int:
    """As many nodes as the targets take, where there are any, and elsewhere their share of the usual number.

    `many` are the nodes in all to a corner of cells.
    """
    corners = float(
        np.clip(content.n_voxels // 8, 2 ** (content.image.ndim + 2), DEFAULT_NODES[content.image.ndim] / many)
    )
    if limits is not None and limits.has_target and isinstance(content, Content):
        needed, share = nodes_of_sizes(content, limits)
        corners = needed + (1.0 - share) * corners
    return int(np.rint(many * corners))


def _limits(sizes: SizeOptions) -> tetopt.Sizes | None:
    """The limits on sizes, if the options ask for any."""
    field = None if sizes.sizing is None else read_companion(sizes.sizing)
    values = {
        "smallest": sizes.size_min, "largest": sizes.size_max, "gradation": sizes.gradation, "field": field,
        "longest": sizes.edge_max,
    }  # fmt: skip
    limits: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    return tetopt.Sizes(**limits) if limits else None
