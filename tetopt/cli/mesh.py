"""``tetopt mesh`` and ``tetopt demo``."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

import tetopt
from tetopt import Image, InputError, Mesh
from tetopt.budget import BYTES_PER_GB, MemoryLimit, peak_bytes, resident_bytes
from tetopt.cli.console import log, out, print_fidelity, show_error, show_warning
from tetopt.cli.ending import is_ended, mesh_kept, signal_code
from tetopt.cli.inputs import label_table, read_mesh, set_threads
from tetopt.cli.options import (
    DEFAULT_NODES,
    EngineOptions,
    ForceOption,
    OutputOptions,
    PartsOptions,
    SizeOptions,
    SolverOptions,
    SourceOptions,
    StartOptions,
    option,
)
from tetopt.cli.parts import (
    StoredSource,
    chosen_parts,
    end_work,
    is_left_stored,
    print_parts,
    read_stored,
    run_in_parts,
)
from tetopt.cli.plan import Plan, planned, with_numbers
from tetopt.cli.predict import print_prediction, size_of_run, stated_prediction
from tetopt.cli.promises import check_promises, warn_of_result, warn_of_sizes
from tetopt.cli.request import requested
from tetopt.cli.run import prepare, waiting, watched_run
from tetopt.cli.solver import (
    all_sets,
    check_early,
    drop_early,
    keep_early,
    print_model,
    save_anyway,
    save_for_solver,
    solver_model,
    with_chosen_sets,
)
from tetopt.cli.source import Source, read_source, whose_variance
from tetopt.engine.cost import RunSize, next_bytes
from tetopt.engine.interfaces import crowded_nodes
from tetopt.engine.loop import Optimized
from tetopt.engine.meshing import (
    ERROR_REACHED,
    ERROR_RUNS,
    NODE_RUNS,
    NODES_NEAR,
    QUADRATIC_NODES,
    Run,
    bytes_of,
    check_memory_of,
    mesh_image,
)
from tetopt.geometry.box import box_sides
from tetopt.geometry.quadratic import node_count
from tetopt.geometry.simplex import centroids, squared_edges
from tetopt.io.files import TakenError, check_space, results_folder, save_json
from tetopt.io.formats import format_of
from tetopt.io.mni import mni_path
from tetopt.measure.quality import Quality, quality
from tetopt.model.fields import cell_fields, is_result
from tetopt.model.file import MeshFile
from tetopt.model.labels import TABLE_TEXT, coloured, table_of_labels, table_words
from tetopt.model.model import Model
from tetopt.model.sets import Sets, box_of, label_set_names, surviving_sets
from tetopt.report.summary import fidelity, image_summary, measured_each, model_summary, run_summary, size_summary
from tetopt.report.tables import add_quality, new_table, nodes_in_words
from tetopt.start.octree import nodes_of_sizes
from tetopt.start.sizes import edge_ratios
from tetopt.target.content import Content, StoredContent
from tetopt.target.domain import INSIDE_SHARE

CELL_BYTES = 40  # of a file, at least: a VTU with a cell's usual fields takes 48, other formats more


class Task(NamedTuple):
    """What a run works on: the plan, and the files that it names, as read."""

    plan: Plan
    source: Source | StoredSource
    started: MeshFile | None  # the mesh to start from
    sizes: tetopt.Sizes | None
    size: RunSize  # by which time and memory are predicted
    request: dict[str, Any] | None = None  # of `requested`, where the numbers are written
    parts: PartsOptions | None = None  # of a run in parts

    @property
    def start_name(self) -> str:
        """What the initial mesh is called."""
        return {"graded": "octree", "start": "start"}.get(self.plan.mode, "lattice")


class Outcome(NamedTuple):
    """What came of a run."""

    result: Optimized
    initial: Mesh
    seconds: dict[str, float]  # up to the optimisation, and of it
    predicted_bytes: float  # of memory, at most, before it began
    shapes: tuple[Quality | None, Quality | None]  # of the initial mesh and of the result, if they could be measured
    failed: dict[str, str]  # why what could not be measured could not, by its name in run.json


def mesh_command(
    source: SourceOptions,
    sizes: SizeOptions,
    start: StartOptions,
    engine: EngineOptions,
    parts: PartsOptions,
    solver: SolverOptions,
    output: OutputOptions,
) -> int:
    """Mesh an image: nodes where it has content (or a uniform lattice), optimised, for a solver or as VTU."""
    begin = time.perf_counter()
    plan = planned(source, sizes, start, engine, solver, output)
    set_threads(engine.threads)
    with waiting("reading and preparing the image, with its mask and labels"):
        task = _read(plan, chosen_parts(plan, parts))
    if output.predict:
        if task.parts is not None:
            print_parts(task.plan, task.source, task.parts)
        else:
            print_prediction(task.plan, task.size)
        return 0
    if output.json_path is not None:
        n_parts = None if task.parts is None else task.parts.parts
        task = task._replace(request=requested(source, sizes, start, engine, solver, output, n_parts))
    with mesh_kept() as begin_keeping:
        result, seconds, predicted, fields = _run(task, begin, begin_keeping)
        failed: dict[str, str] = {}
        model, about = _save(task, result, fields, failed)
        assert result.initial is not None
        # Only from here on, as nothing may fail before the mesh is written.
        meshes = {"quality_initial": result.initial, "quality": result.mesh}
        shapes = measured_each(
            {name: partial(quality, each.points, each.cells) for name, each in meshes.items()}, failed
        )
        outcome = Outcome(
            result, result.initial, seconds, predicted, (shapes.get("quality_initial"), shapes.get("quality")), failed
        )
        measured = _write(task, outcome, model, about, begin)
        code = _print(task, outcome, model, measured)
        if task.parts is not None:
            end_work(task.plan, result)
        return signal_code() if is_ended() else code


def _read(plan: Plan, parts: PartsOptions | None) -> Task:
    """The files that the plan names, and the defaults that depend on them."""
    if parts is not None and is_left_stored(plan):
        stored = read_stored(plan)
        plan, sizes = with_numbers(plan, stored.content)
        return Task(plan, stored, None, sizes, size_of_run(plan, stored.content, stored.content.image), parts=parts)
    source = read_source(plan.source, plan.solver.label_names)
    if parts is not None and source.content.image.ndim != 3:
        raise InputError("--parts: of a volume, and the image is a plane; leave it out")
    started = None
    if plan.start.start is not None:
        started = read_mesh(plan.start.start)
        _check_place(started.mesh, source.contrasts[0], str(plan.start.start))
        if plan.solver.order is None and started.order == 2 and format_of(plan.output.mesh).has_quadratic:
            plan = plan._replace(solver=replace(plan.solver, order=2))
        if source.labels is not None and not source.table.names:
            source = source.with_table(label_table(None, started))
    plan, sizes = with_numbers(plan, source.content)
    n_started = None if started is None else len(started.mesh.points)
    size = size_of_run(plan, source.content, source.contrasts[0], n_started)
    return Task(plan, source, started, sizes, size, parts=parts)


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
        show_warning(f"{path}: {np.mean(~is_in):.1%} of its cells lie beside the image, where it has no say")


Ran = tuple[Optimized, dict[str, float], float, dict[str, NDArray] | None]
"""A result, seconds by name, the bytes predicted, and fields of cells, if they are known."""


def _run(task: Task, begin: float, begin_keeping: Callable[[], None]) -> Ran:
    """The optimised mesh, what took how long, and the bytes predicted; a target error takes several runs in turn."""
    if task.parts is not None:
        return _run_in_parts(task, begin, begin_keeping)
    plan, content = task.plan, task.source.content
    assert isinstance(content, Content)
    solver, output, options = plan.solver, plan.output.mesh, plan.engine_options()
    ends = None if plan.engine.max_seconds is None else begin + plan.engine.max_seconds
    limit = _memory_limit(plan, content)
    before = peak_bytes(), resident_bytes()
    begun: list[float] = []
    shown, words = ExitStack(), "making the initial mesh"

    def watch(initial: Mesh, run: Run) -> Optimized:
        shown.close()
        if not begun and (solver.are_any() or output.suffix.lower() != ".vtu"):
            about = task.source.about

            def build(early: SolverOptions) -> Model:
                return _model(task, initial, early, about, is_told=False)

            check_early(output, solver, initial.ndim, task.source.low, build)
        check_space(output, CELL_BYTES * len(initial.cells))
        begun.append(time.perf_counter())
        log.print(escape(_described(task, initial)))
        prepare(content, options["k_D"], plan.mode)
        begin_keeping()
        result = watched_run(run, initial, options["iterations"], ends, limit)
        _say_search(task, len(begun), result)
        if plan.sizes.target_error is not None or solver.order == 2:  # of which there may be a next run
            shown.enter_context(waiting(words))
        return result

    kind = plan.kind(content.image.ndim) if plan.mode in ("uniform", "paper") else None
    start = None if task.started is None else task.started.mesh
    with shown:
        shown.enter_context(waiting(words))
        result = mesh_image(
            content, plan.sizes.nodes, target_error=plan.sizes.target_error, mode=plan.mode, start=start,
            spacing=plan.start.spacing, kind=kind, sizes=task.sizes, order=solver.order or 1, watch=watch, **options,
        )  # fmt: skip
    assert result.initial is not None
    seconds = {"load": begun[0] - begin, "optimize": time.perf_counter() - begun[0]}
    n_nodes = max(result.nodes or 0, len(result.initial.points))
    predicted = max(before[0], before[1] + bytes_of(content, n_nodes))
    return result, seconds, predicted, None


def _run_in_parts(task: Task, begin: float, begin_keeping: Callable[[], None]) -> Ran:
    """The same in parts, which take the fields of their cells as well."""
    assert task.parts is not None
    loaded = time.perf_counter() - begin

    def check(initial: Mesh) -> None:
        output, solver = task.plan.output.mesh, task.plan.solver
        if solver.are_any() or output.suffix.lower() != ".vtu":
            fields = cell_fields(initial)
            early = {name: np.zeros(len(initial.cells)) for name in ("mean", "variance", "n_voxels", "min", "max")}

            def build(options: SolverOptions) -> Model:
                return _model(task, initial, options, task.source.about, is_told=False, fields=early | fields)

            check_early(output, solver, initial.ndim, task.source.low, build)
        check_space(output, CELL_BYTES * len(initial.cells))

    parted, n_bytes = run_in_parts(task.plan, task.source, task.sizes, task.parts, check, begin_keeping, begin)
    seconds = {"load": loaded, "optimize": time.perf_counter() - begin - loaded}
    fields = {**parted.fields, **cell_fields(parted.result.mesh), "part": parted.part}
    return parted.result, seconds, n_bytes, fields


def _memory_limit(plan: Plan, content: Content) -> MemoryLimit | None:
    """The user's; InputError if the image alone, or the mesh to begin with, needs more."""
    if plan.engine.max_gb is None:
        return None
    n_bytes = plan.engine.max_gb * BYTES_PER_GB
    check_memory_of(content, 0, n_bytes)
    return MemoryLimit(n_bytes, next_bytes(plan.sizes.nodes or 0, content.image.ndim))


def _say_search(task: Task, number: int, result: Optimized) -> None:
    """A line for a run of several, which go on until one is near to an error, or to a number of nodes of order 2."""
    plan, content = task.plan, task.source.content
    n_nodes = node_count(result.mesh.points, result.mesh.cells, plan.solver.order or 1)
    if (target := plan.sizes.target_error) is not None:
        share = result.history[-1].E_D / (content.variance * content.volume or 1.0)
        log.print(
            f"run {number} of up to {ERROR_RUNS}: {n_nodes} nodes leave {share:.4g} of the variance in cells; "
            f"{ERROR_REACHED * target:.4g} to {target:.4g} is near enough"
        )
    elif plan.solver.order == 2 and plan.sizes.nodes is not None and plan.mode != "start":
        log.print(
            f"run {number} of up to {NODE_RUNS}: {n_nodes} nodes with those in the middle of edges, of "
            f"{plan.sizes.nodes}; {NODES_NEAR:.0%} off is near enough"
        )


def _described(task: Task, initial: Mesh) -> str:
    source = task.source
    assert isinstance(source, Source)
    image = source.contrasts[0]
    size = " x ".join(str(s) for s in image.shape)
    spacing = " x ".join(f"{s:.4g}" for s in image.spacing)
    start = f"{task.start_name} of {len(initial.points)} nodes, {len(initial.cells)} cells"
    start += f", edges up to {np.sqrt(squared_edges(initial.points, initial.cells).max()):.3g} mm"
    more = [f"and {len(source.paths) - 1} more"] if len(source.paths) > 1 else []
    more += ["labels"] if source.labels is not None else []
    if source.mask is not None:
        more += [f"within a {source.mask_word} of {int((source.mask.data >= INSIDE_SHARE).sum())} voxels"]
    return ", ".join([f"{source.paths[0]}: {size} voxels of {spacing} mm", *more]) + f"; {start}"


def _model(
    task: Task, mesh: Mesh, solver: SolverOptions, about: dict[str, Any], is_told: bool = True,
    labels: NDArray[np.int64] | None = None, fields: dict[str, NDArray] | None = None,
) -> Model:  # fmt: skip
    """The mesh with all that the options say of it; `fields` of its cells are found, if they are not known."""
    source, started = task.source, task.started
    if fields is None:
        assert isinstance(source, Source)
        fields = source.fields(mesh, labels)
    own = Sets({}, {}) if started is None else surviving_sets(started.mesh, started.sets, mesh)
    if started is not None and is_told:
        lost = [name for kind in (0, 1) for name in started.sets[kind] if name not in own[kind]]
        if source.labels is not None:  # of which these are made anew
            names = label_table(None, started).names
            of_labels = label_set_names(names, names).values()
            lost = [name for name in lost if not name.startswith(("label_", "interface_")) and name not in of_labels]
        if lost:
            log.print(escape(f"not kept, as their cells or facets are others now: the sets {', '.join(lost)}"))
        has_results = any(is_result(name) for name in (*started.cell_data, *started.point_data))
        if "young" in started.cell_data or started.text("loads") is not None or has_results:
            log.print("moduli, loads and results of the mesh that is improved are not kept; give --young and --load")
    known_sets = all_sets(mesh, box_of(source.contrasts[0]), fields, own, source.table.names, is_told=is_told)
    return solver_model(mesh, source.image, solver, fields, about, known_sets)


def _save(
    task: Task, result: Optimized, fields: dict[str, NDArray] | None, failed: dict[str, str]
) -> tuple[Model, dict[str, Any]]:
    """Write the mesh, or keep it elsewhere; the model, and what files say about the run.

    Until its file is there, the mesh is kept beside it, as what the file has of each cell is measured before. What of
    that could not be is left out, and noted in `failed`. A run in parts has its folder of work.
    """
    plan, source = task.plan, task.source
    solver, output = plan.solver, plan.output
    options = plan.stated(source.content.image.ndim)
    if plan.sizes.target_error is not None:
        options["nodes"] = result.nodes
    if task.parts is not None:
        options["parts"] = task.parts.parts or 1
    about = {**source.about, "options": options}
    early = None if task.parts is not None else keep_early(output.mesh, result.mesh, result.labels)
    if fields is None:
        fields = _measured_fields(source, result, failed)
    try:
        whole = _model(task, result.mesh, solver, about, labels=result.labels, fields=fields)
        model = with_chosen_sets(whole, output.mesh, solver)
        save_for_solver(output.mesh, model, solver)
    except TakenError:  # it is kept beside its name
        raise
    except Exception as error:  # hours may have gone into the mesh

        def bare() -> Model:
            options = SolverOptions()
            return _model(task, result.mesh, options, about, is_told=False, labels=result.labels, fields=fields)

        kept, early = early, None
        save_anyway(output.mesh, result.mesh, bare, error, kept)
        raise
    finally:
        if early is not None:
            drop_early(early)
    return model, about


def _measured_fields(source: Source | StoredSource, result: Optimized, failed: dict[str, str]) -> dict[str, NDArray]:
    """The fields of the result's cells; those of their shape and their labels alone, if the image's cannot be had."""
    assert isinstance(source, Source)
    if measured := measured_each({"fields": partial(source.fields, result.mesh, result.labels)}, failed):
        return dict(measured["fields"])
    return cell_fields(result.mesh) | ({} if result.labels is None else {"label": result.labels})


def _write(task: Task, outcome: Outcome, model: Model, about: dict[str, Any], begin: float) -> dict[str, Any]:
    """Write the numbers and the pictures; how well mask, labels and contrasts are met."""
    plan, source, result, output = task.plan, task.source, outcome.result, task.plan.output
    failed = outcome.failed
    measured = fidelity(source.labels, source.mask, result.mesh, model.cell_data.get("label"), failed)
    if source.labels is not None:
        labels = np.unique(source.labels.data).astype(np.int64)
        there = coloured(table_of_labels(source.table, labels.tolist()), labels)
        measured |= {"label_names": there.names} if there.names else {}
        about |= {TABLE_TEXT: table_words(there)}
    counted = measured_each(_counts(task, result, model), failed)
    measured |= {name: value for name, value in counted.items() if value is not None}
    if output.json_path is not None:
        seconds = {**outcome.seconds, "all": time.perf_counter() - begin}
        summary = run_summary(source.content, outcome.initial, result, about, seconds, outcome.shapes)
        if isinstance(source, Source) and source.image is not source.content.image:
            summary["image_properties"] = image_summary(source.image)  # on its own voxels, not on divided ones
        summary["request"] = task.request
        summary["memory"] = {"peak_bytes": peak_bytes()}
        if task.parts is None:
            summary["prediction"] = stated_prediction(task.size)
            summary["memory"] |= {"predicted_bytes": outcome.predicted_bytes}
        else:  # of each worker's largest task
            summary["prediction"] = {"task_bytes": outcome.predicted_bytes}
        missing = {name: None for name in (*failed, "cells_without_voxel") if name != "fields"}
        save_json(output.json_path, summary | missing | measured | {"failed": failed} | model_summary(model))
    if plan.pictures:
        _draw(task, outcome, model)
    return measured


def _counts(task: Task, result: Optimized, model: Model) -> dict[str, Callable[[], Any]]:
    """What else is measured of a mesh, by name; None where there is nothing to tell."""
    source, sizes, mesh, fields = task.source, task.sizes, result.mesh, model.cell_data
    measures: dict[str, Callable[[], Any]] = {}
    has_image = "n_voxels" in fields
    if has_image:
        measures["cells_without_voxel"] = lambda: int((fields["n_voxels"] == 0).sum())
    if has_image and isinstance(source, Source) and not (source.content.is_plain and source.content.region is None):
        measures["contrasts"] = lambda: source.by_contrast(fields)
    if sizes is not None and sizes.has_target:
        assert isinstance(source, Source), "no targets for the voxels of others"
        content, share = source.content, QUADRATIC_NODES[source.image.ndim] if model.order == 2 else 1.0
        measures["edges_over_target"] = lambda: edge_ratios(mesh.points, mesh.cells, sizes)
        measures["nodes_of_sizes"] = lambda: round(nodes_of_sizes(content, sizes)[0] * share)
    if source.mask is not None:
        measures["dropped_components"] = lambda: result.n_dropped
    if (labels := result.labels) is not None:
        measures["nodes_of_many_labels"] = lambda: crowded_nodes(mesh.cells, labels)
    return measures


def _draw(task: Task, outcome: Outcome, model: Model) -> None:
    """Draw the pictures."""
    from tetopt.report import figures, thumbnail  # matplotlib is slow to load, and only needed here

    pictures, mesh, source = task.plan.pictures, outcome.result.mesh, task.source
    if isinstance(source, StoredSource):
        image = source.coarse()
        figures.save_run_figures(pictures[:3], image, outcome.initial, outcome.result, task.start_name, image)
        thumbnail.save_thumbnail(pictures[-1], image, mesh)
        return
    image = source.contrasts[0]
    figures.save_run_figures(pictures[:3], source.image, outcome.initial, outcome.result, task.start_name, image)
    of_cell = model.cell_data.get("label")
    if source.mask is not None:
        figures.save_figure(figures.boundary_figure(image, source.mask, mesh, word=source.mask_word), pictures[3])
    if source.labels is not None:
        other = None if np.array_equal(image.data, source.labels.data) else image
        figure = figures.label_figure(source.labels, mesh, of_cell, other, source.table)
        figures.save_figure(figure, pictures[-2])
    thumbnail.save_thumbnail(pictures[-1], image, mesh, source.mask, source.labels, of_cell, source.table)


def _print(task: Task, outcome: Outcome, model: Model, measured: dict[str, Any]) -> int:
    """Say what is odd and print the comparison; the exit code.

    Everything is written by now, as what is printed may go into a pipe that closes.
    """
    plan, content, result = task.plan, task.source.content, outcome.result
    solver, output = plan.solver, plan.output
    code = check_promises(result, measured, task.source.mask_word)
    for name, reason in outcome.failed.items():
        left = "the mesh's file has no means of its cells" if name == "fields" else "all other numbers are written"
        show_error(f"{name} could not be measured: {reason}; {left}")
    if task.source.is_constant:
        measured = {**measured, "cells_without_voxel": 0}  # whose values are right all the same
    is_counted = plan.mode == "graded" and plan.sizes.target_error is None
    n_nodes = node_count(model.mesh.points, model.mesh.cells, model.order)
    asked_nodes = plan.sizes.nodes if is_counted else None
    spacing = task.source.contrasts[0].spacing
    warn_of_result(result, plan.engine.method, plan.mode, n_nodes, asked_nodes, measured, spacing)
    if task.sizes is not None and (edges := outcome.shapes[1]) is not None:
        warn_of_sizes(task.sizes, edges.min_edge, edges.max_edge, measured.get("edges_over_target"))
    _print_comparison(content, outcome, task.start_name, model.order, measured.get("cells_without_voxel", 0))
    print_fidelity(measured, model.mesh.ndim, task.source.mask_word)
    if solver.are_any() or output.mesh.suffix.lower() != ".vtu":
        print_model(output.mesh, model, solver)
    else:
        size = f"{nodes_in_words(model.mesh, model.order)}, {len(model.mesh.cells)} cells"
        out.print(escape(f"{output.mesh}: {size}"))
    if output.json_path is not None:
        out.print(escape(f"{output.json_path}: every number of the run"))
    for path in plan.pictures:
        out.print(escape(str(path)))
    return 1 if outcome.failed else code


def _print_comparison(content: Content | StoredContent, outcome: Outcome, start: str, order: int, n_empty: int) -> None:
    mesh, initial = outcome.result.mesh, outcome.initial
    first, last = outcome.result.history[0], outcome.result.history[-1]
    table = new_table("", start, "optimised")
    is_tense = outcome.result.labels is not None  # as soon as cells have labels
    table.add_row("E, combined, + tension at the end" if is_tense else "E, combined", f"{first.E:.4f}", f"{last.E:.4f}")
    table.add_row("E_G, of initial", "1.0000", f"{last.E_G / first.E_G:.4f}")
    if first.E_D > 0.0:
        table.add_row("E_D, of initial", "1.0000", f"{last.E_D / first.E_D:.4f}")
    if first.E_D > 0.0 and (spread := content.variance * content.volume) > 0.0:
        table.add_row(
            f"E_D, share of {whose_variance(content)}", f"{first.E_D / spread:.5f}", f"{last.E_D / spread:.5f}"
        )
    meshes = (initial, mesh)
    in_all = [size_summary(each, order)["n_nodes_in_all"] for each in meshes] if order == 2 else []
    first_shape, last_shape = outcome.shapes
    if first_shape is not None and last_shape is not None:
        add_quality(table, first_shape, last_shape, in_all=in_all)
    if n_empty:
        table.add_row("cells that hold no voxel centre", "", str(n_empty))
    out.print(table)


def demo_command(
    output: Annotated[Path, option("DIR", "Folder for the results.", "-o", "--output")] = Path("demo"),
    nodes: Annotated[int, option("N", "Wanted number of nodes.")] = DEFAULT_NODES[3],
    iterations: Annotated[int | None, option("I", "Sweeps over all nodes.", min=0)] = None,
    force: ForceOption = False,
) -> int:
    """Mesh the MNI152 T1 that nilearn's wheel carries; leave mesh, numbers and pictures in a folder."""
    source = SourceOptions(images=[mni_path("t1")])
    folder = results_folder(output)
    files = OutputOptions(mesh=folder / "mesh.vtu", json_path=folder / "run.json", figures=folder, force=force)
    return mesh_command(
        source, SizeOptions(nodes=nodes), StartOptions(), EngineOptions(iterations=iterations), PartsOptions(),
        SolverOptions(), files,
    )  # fmt: skip
