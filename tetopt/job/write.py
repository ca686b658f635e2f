"""Outputs of a run: the mesh's file, every number, pictures."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any

import numpy as np

from tetopt.contents.content import continue_image
from tetopt.engine.label_state import crowded_nodes
from tetopt.engine.loop import MeshingResult
from tetopt.errors import Note, warn
from tetopt.job.events import note, warnings_heard
from tetopt.job.options import SolverOptions
from tetopt.job.plan import nodes_of_targets, stated_options
from tetopt.job.solver_files import (
    drop_early,
    keep_early,
    save_anyway,
    save_for_solver,
    solver_model,
    with_chosen_sets,
)
from tetopt.job.source import Source
from tetopt.job.task import Meshed, Shapes, Task
from tetopt.measure.measures import fidelity, measure_each
from tetopt.mesh import Mesh
from tetopt.model.fields import cell_fields, is_result
from tetopt.model.file import MASK_TEXT, MeshFile
from tetopt.model.label_names import (
    LABEL_FIELD,
    TABLE_TEXT,
    LabelTable,
    colour_labels,
    table_of_labels,
    table_words,
)
from tetopt.model.model import Model, grid_fields
from tetopt.model.sets import Sets, box_of, label_set_names, surviving_sets
from tetopt.report.summary import run_summary
from tetopt.start.sizes import edge_ratios
from tetopt.system.arrays import Arrays, Ints, Json
from tetopt.system.budget import peak_bytes, return_freed
from tetopt.system.files import kept_places, output_place, save_bytes


def model_with(
    task: Task,
    mesh: Mesh,
    solver: SolverOptions,
    about: Json,
    fields: Arrays | None = None,
    regions: Ints | None = None,
) -> Model:
    """Build the model of a mesh with the options; `fields` of its cells are computed if not
    given, and `regions` are those of its cells, if they are kept.
    """
    source = task.source
    started = task.started
    if fields is None:
        fields = source.fields(mesh, task.labels_of(regions))
    own = Sets({}, {})
    if started is not None:
        own = started.sets
        if not task.plan.job.keep_connectivity:
            own = surviving_sets(started.mesh, own, mesh, regions)
        _warn_of_losses(started, own, source.labels is not None)
    loaded = MeshFile(mesh, fields, {}, n_turned=0, sets=own)
    box = box_of(source.contrasts[0])
    return solver_model(loaded, source.image, solver, about, box, task.fields)


def _warn_of_losses(started: MeshFile, own: Sets, has_labels: bool) -> None:
    """Warn of what the input mesh's file has and the model of a new mesh, with the sets `own` of
    it, has not.
    """
    lost = [name for kind in (0, 1) for name in started.sets[kind] if name not in own[kind]]
    if has_labels:  # whose sets are rebuilt
        names = started.label_table.names
        rebuilt = set(label_set_names(names, names).values())
        lost = [
            name
            for name in lost
            if not name.startswith(("label_", "interface_")) and name not in rebuilt
        ]
    if lost:
        words = f"dropped sets whose cells or faces changed during remeshing: {', '.join(lost)}"
        warn(words, Note)
    has_results = any(is_result(name) for name in (*started.cell_data, *started.point_data))
    if "young" in started.cell_data or started.text("loads") is not None or has_results:
        words = "moduli, loads and results of the input mesh are not kept"
        warn(f"{words}; pass `young` and `loads`", Note)


def save_outcome(task: Task, outcome: Meshed, failed: dict[str, str]) -> tuple[Model, Json]:
    """Write the mesh, or save it elsewhere; return the model, and the files' statements about the
    run.

    Until its file is whole, a copy of the mesh is kept next to it, as cell fields are measured
    first, or in the file itself if the run was cut short. Measurements that fail are left out, and
    noted in `failed`.
    """
    plan = task.plan
    job = task.plan.job
    source = task.source
    result = outcome.result
    options = stated_options(plan, source.content.image.ndim)
    if job.target_error is not None:
        options["nodes"] = result.nodes
    about = {**source.about, "options": options}
    about |= {"violated": result.violated} if result.violated else {}
    places = islice(kept_places(job.output), 1) if outcome.early is None else [outcome.early]
    early = keep_early(result.mesh, result.labels, places)
    fields = _measured_fields(source, result, failed)
    try:
        with warnings_heard():
            whole = model_with(task, result.mesh, job, about, fields, outcome.regions)
        model = with_chosen_sets(whole, job.output, job)
        save_for_solver(job.output, model, job)
    except Exception as error:  # the mesh may have taken hours

        def bare() -> Model:
            with warnings.catch_warnings(action="ignore"):
                return model_with(
                    task, result.mesh, SolverOptions(), about, fields, outcome.regions
                )

        kept = early
        early = None
        save_anyway(job.output, result, bare, error, kept)
        raise
    finally:
        if early is not None and early != output_place(job.output):
            drop_early(early)
    return model, about


def _measured_fields(source: Source, result: MeshingResult, failed: dict[str, str]) -> Arrays:
    """Return the fields of the result's cells; only shapes and labels if the image's cannot be
    computed.
    """
    if measured := measure_each(
        {"fields": partial(source.fields, result.mesh, result.labels)}, failed
    ):
        return dict(measured["fields"])
    return cell_fields(result.mesh) | (
        {} if result.labels is None else {LABEL_FIELD: result.labels}
    )


def measures_of(task: Task, result: MeshingResult, model: Model, failed: dict[str, str]) -> Json:
    """Measure the fit to mask, labels, contrasts and sizes; of a stopped run, whose process may
    be ended soon, what takes seconds.
    """
    return_freed()  # by writing the mesh
    source = task.source
    if result.ended == "stopped":
        measured: Json = {"labels": list(result.extents)} if result.extents else {}
        if source.labels is not None or source.mask is not None:
            note("stopped: surfaces, distances and thickness are left to tetopt quality")
    else:
        measured = fidelity(
            source.labels,
            source.mask,
            result.mesh,
            model.cell_data.get(LABEL_FIELD),
            failed,
            source.content,
            result.extents,
        )
    if (table := _table_of(source)) is not None and table.names:
        measured["label_names"] = table.names
    counted = measure_each(_counts(task, result, model), failed)
    return measured | {name: value for name, value in counted.items() if value is not None}


def _table_of(source: Source) -> LabelTable | None:
    """Return names and colours of the labels present."""
    if source.labels is None:
        return None
    labels = np.unique(source.labels.data).astype(np.int64)
    return colour_labels(table_of_labels(source.table, labels.tolist()), labels)


def numbers_of(
    task: Task, outcome: Meshed, shapes: Shapes, model: Model, about: Json, seconds: float
) -> Json:
    """Return every number of a run except measurements: the begin of run.json."""
    source = task.source
    table = _table_of(source)
    # which is for the mesh's file
    texts = {name: text for name, text in about.items() if name != MASK_TEXT}
    texts |= {} if table is None else {TABLE_TEXT: table_words(table)}
    summary = run_summary(
        source.content,
        outcome.initial,
        outcome.result,
        texts,
        {**outcome.seconds, "all": seconds},
        shapes,
    )
    summary["request"] = task.request
    if task.by_label is not None:
        made = task.by_label
        rows = [
            {"label": row.label, "thickness": row.thickness, "target": row.edge}
            for row in made.layers
        ]
        summary["label_sizes"] = {"nodes": made.nodes, "scale": made.scale, "labels": rows}
    return summary | {"memory": {"peak_bytes": peak_bytes(), **outcome.memory}}


def _counts(task: Task, result: MeshingResult, model: Model) -> dict[str, Callable[[], Any]]:
    """Return further measures of a mesh, by name; their value is None if there is nothing to
    report.
    """
    source = task.source
    sizes = task.sizes
    mesh = result.mesh
    fields = model.cell_data
    measures: dict[str, Callable[[], Any]] = {}
    has_image = "n_voxels" in fields
    if has_image:
        measures["cells_without_voxel"] = lambda: int((fields["n_voxels"] == 0).sum())
    if has_image and not source.content.is_plain:
        measures["contrasts"] = lambda: source.by_contrast(fields)
    if sizes is not None and sizes.has_target:
        measures["edges_over_target"] = lambda: edge_ratios(mesh.points, mesh.cells, sizes)
        measures["nodes_of_sizes"] = lambda: nodes_of_targets(task.plan, source.content, sizes)
    if source.mask is not None:
        measures["dropped_components"] = lambda: result.n_dropped
        measures["dropped_volumes"] = lambda: {
            str(label): volume for label, volume in result.dropped.items()
        }
    if source.labels is not None and (labels := result.labels) is not None:
        measures["nodes_of_many_labels"] = lambda: crowded_nodes(mesh.cells, labels)
    return measures


def draw(task: Task, outcome: Meshed, model: Model) -> None:
    """Draw the pictures."""
    from tetopt.report import figures, thumbnail  # matplotlib loads slowly and is needed only here

    pictures = task.plan.pictures
    mesh = outcome.result.mesh
    source = task.source
    image = source.contrasts[0]
    own = continue_image(image, source.content.continuation)
    is_labels = source.labels is not None and np.array_equal(image.data, source.labels.data)
    figures.save_run_figures(
        pictures[:3],
        own,
        outcome.initial,
        outcome.result._replace(order=model.order),
        task.start_name,
        image,
        source.mask,
        source.table if is_labels else None,
        grid_fields(model)[0].get("fibre"),
    )
    of_cell = model.cell_data.get(LABEL_FIELD)
    # none for the mask of a mesh to start from
    if source.mask is not None and "boundary" in pictures[3].stem:
        figures.save_figure(
            figures.boundary_figure(image, source.mask, mesh, source.mask_word), pictures[3]
        )
    if source.labels is not None:
        other = None if is_labels else image
        figure = figures.label_figure(
            source.labels, mesh, of_cell, other, source.table, model.order
        )
        figures.save_figure(figure, pictures[-2])
    picture = thumbnail.thumbnail_png(
        image, mesh, source.mask, source.labels, of_cell, source.table
    )
    save_bytes(pictures[-1], picture)
