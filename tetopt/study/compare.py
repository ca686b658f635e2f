"""Comparison of tetopt with the conventional pipelines, with the same measures for all.

Every pipeline runs in a separate process on the same image for the same number of nodes, and the same functions
measure every mesh: the sampler, the shape measures, and the compression test against a voxel grid's solution.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.errors import InputError
from tetopt.fem.budget import affordable_dofs, reference_shape
from tetopt.fem.conditioning import conditioning
from tetopt.fem.elasticity import box_faces, check_fills_box, compression, push_of
from tetopt.fem.reference import Reference, averaged, compare, nearest, reference, refined
from tetopt.geometry.quadratic import node_count
from tetopt.geometry.simplex import dihedral_angles
from tetopt.image import Image
from tetopt.io.formats import save_mesh
from tetopt.io.images import sha256
from tetopt.io.meshes import load_mesh
from tetopt.job.events import note, warning
from tetopt.measure.fidelity import cell_labels, label_fidelity, unexplained_of
from tetopt.measure.interfaces import label_interfaces
from tetopt.measure.quality import quality, rho_histogram
from tetopt.measure.thin import contact_totals, label_contacts
from tetopt.mesh import Mesh
from tetopt.model.averages import element_young, young_image
from tetopt.model.fields import cell_fields
from tetopt.model.mappings import ModulusMapping
from tetopt.report.summary import versions
from tetopt.study import compare_report as records
from tetopt.study.child import run_in_child
from tetopt.study.compare_report import Attempt, Measurement, Report, Settings, as_json, averages_of, from_json
from tetopt.study.pipelines import UNTIMED_STEPS, Pipeline, PipelineInput
from tetopt.study.program import file_checksums, pipelines_with
from tetopt.study.tradeoff import tradeoff
from tetopt.system.files import save_json
from tetopt.system.incoming import own_bytes, text_of
from tetopt.system.work_directory import LOCK_NAME, Layout, locked

Facts = dict[str, Any]  # inputs of a comparison in addition to its settings, as JSON values
# Settings that do not affect a finished run's numbers: the other pipelines, and limits that it has met. Its own number
# of nodes and its program are part of its key, and so is the reference's size, once decided.
FREE_SETTINGS = {
    "nodes", "pipelines", "programs", "repeats", "curve", "tradeoff", "max_seconds", "max_bytes", "reference_seconds"
}  # fmt: skip

RUNS_NAME = "runs"  # the work directory
RUNS = Layout("a comparison", rf"{LOCK_NAME}|reference\.json|[\w-]+-\d+(-quadratic)?-\d+\.(json|vtu)")


class Comparison(NamedTuple):
    """Inputs of a comparison, with their descriptions for the report."""

    image: Image
    labels: Image | None  # for tetopt's own pipelines, with the image, and for those that segment
    mapping: ModulusMapping  # from intensity to kPa
    settings: Settings
    image_source: records.ImageSource
    label_source: records.LabelSource | None
    mapping_words: str
    command: str


class Standard(NamedTuple):
    """The reference that all meshes are measured against."""

    image: Image
    labels: Image  # materials, on the image's voxels
    modulus: Image  # kPa, of the reference's grid, piecewise constant
    modulus_fine: Image  # the same field on about as many voxels as the image
    coarse_labels: NDArray  # of the reference's voxels
    references: dict[str, Reference]  # by nu
    averages: tuple[str, ...]  # of a cell's moduli


class Bench(NamedTuple):
    """Data that all runs of a comparison share."""

    comparison: Comparison
    standard: Standard
    pipelines: dict[str, Pipeline]
    folder: Path  # of the runs' files
    resume: bool
    facts: Facts


def default_mapping(image: Image) -> tuple[ModulusMapping, str]:
    """Return a modulus mapping for any image, 1 to 10 kPa from its 0.5th to 99.5th percentile, and its description."""
    low, high = (float(p) for p in np.percentile(image.data, [0.5, 99.5]))
    if high <= low:
        raise InputError("image: too little contrast between its percentiles; pass `young`")
    words = f"1 kPa at intensity {low:g} and below, 10 kPa at {high:g} and above, linear between"
    return [(low, 1.0), (high, 10.0)], words


def prepared(image: Image, labels: Image, mapping: ModulusMapping, settings: Settings) -> Standard:
    """Compute the reference solutions, which may take minutes.

    Raises
    ------
    InputError
        As `tetopt.model.mappings.young_from` and `tetopt.fem.reference.reference`.
    """
    fine = young_image(image, mapping)
    dofs = settings.reference_dofs
    if dofs is None:
        dofs = reference_dofs(image, mapping, settings)
    modulus = averaged(fine, reference_shape(image.shape, image.spacing, dofs))
    references = {}
    for nu in settings.nus:
        note(f"reference: {' x '.join(map(str, modulus.shape))} voxels, nu = {nu:g}")
        references[f"{nu:g}"] = reference(modulus, nu, settings.percent)
    return Standard(
        image,
        labels,
        modulus,
        refined(modulus, fine.shape),
        nearest(labels, modulus).data,
        references,
        averages_of(settings),
    )


def reference_dofs(image: Image, mapping: ModulusMapping, settings: Settings) -> int:
    """Return the reference size that `reference_seconds` and the memory allow, which differs slightly between runs."""
    budget = affordable_dofs(young_image(image, mapping), settings.nus, settings.reference_seconds, settings.percent)
    limit = "the free memory" if budget.is_short_of_memory else f"{settings.reference_seconds:g} s"
    note(f"reference: up to {budget.dofs} unknowns in {limit}; `reference_dofs` {budget.dofs} repeats it")
    return budget.dofs


def _settled(comparison: Comparison, facts: Facts, runs: Path, *, resume: bool) -> Comparison:
    """Decide the size of the reference, and store it in the runs' folder for `resume`."""
    settings, path = comparison.settings, runs / "reference.json"
    if settings.reference_dofs is None:
        choice = facts | as_json({key: getattr(settings, key) for key in ("nus", "percent", "reference_seconds")})
        before = _read_back(path) if resume else None
        dofs = None if before is None or before[0] != choice else before[1]
        if dofs is None:
            dofs = reference_dofs(comparison.image, comparison.mapping, settings)
            _write_down(path, [choice, dofs])
        comparison = comparison._replace(settings=settings._replace(reference_dofs=dofs))
    return comparison


def _write_down(path: Path, content: Any) -> None:
    """Write a file for `_read_back`, with a checksum, as files may be cut off or edited before they are resumed."""
    save_json(path, {"content": content})
    content = json.loads(path.read_text(encoding="utf-8"))["content"]  # as it will be read: non-finite numbers are null
    save_json(path, {"content": content, "sha256": _checksum(content)})


def _read_back(path: Path) -> Any:
    """Read a file of `_write_down`; return None if it is missing or has changed."""
    try:
        row = json.loads(own_bytes(path))
        return row["content"] if row["sha256"] == _checksum(row["content"]) else None
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None


def _checksum(content: Any) -> str:
    """Return the checksum of a JSON file's content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


# Measures of one mesh.


def measured(
    standard: Standard, mesh: Mesh, percent: float, order: int = 1, of_cell: NDArray[np.int64] | None = None
) -> Measurement:
    """Measure everything that is compared of a mesh with cells of this order, compressed by `percent` of its height.

    `of_cell` (M,) are the labels that its pipeline gives the cells; where -1, or if None, those of most voxels.
    """
    image = standard.image
    moments = cell_moments(image, mesh)
    owner = cell_of_voxel(image, mesh)
    E_D = float((moments.n_voxels * moments.variance).sum()) * image.voxel_volume
    fraction, edges = rho_histogram(mesh.points, mesh.cells, bins=20)
    angles, angle_edges = np.histogram(dihedral_angles(mesh.points, mesh.cells), bins=36, range=(0.0, 180.0))
    try:
        check_fills_box(image, mesh)
        not_compressed = None
    except InputError as error:
        not_compressed = str(error)
    references = standard.references if not_compressed is None else {}
    return Measurement(
        order=order,
        n_nodes=node_count(mesh.points, mesh.cells, order),
        n_corners=len(mesh.points),
        n_cells=len(mesh.cells),
        E_D=E_D,
        E_D_fraction=unexplained_of(*moments),
        n_missed_voxels=int((owner < 0).sum()),
        n_empty_cells=int((moments.n_voxels == 0).sum()),
        quality=quality(mesh.points, mesh.cells),
        rho_histogram=records.Histogram(edges.tolist(), fraction.tolist()),
        dihedral_histogram=records.Histogram(angle_edges.tolist(), (angles / angles.sum()).tolist()),
        labels=_label_rows(standard, mesh, of_cell, moments.mean, owner),
        fem={nu: _simulation(standard, mesh, order, each, percent) for nu, each in references.items()},
        not_compressed=not_compressed,
    )


def _label_rows(
    standard: Standard,
    mesh: Mesh,
    of_cell: NDArray[np.int64] | None,
    means: NDArray[np.float64],
    owner: NDArray[np.int64],
) -> list[records.LabelRow]:
    """Return a row for each label: `LabelFidelity`, `LabelInterface`, contact, voxels of its cells, E_D in it."""
    of_voxels = cell_labels(standard.labels, mesh)
    of_cell = of_voxels if of_cell is None else np.where(of_cell < 0, of_voxels, of_cell)
    place = np.unique(standard.labels.data, return_inverse=True)[1].ravel()  # in the order of the rows
    # Outside the mesh the label is 0, as in `label_fidelity`.
    painted = np.where(owner >= 0, of_cell[owner], 0)
    h = standard.image.data.ravel().astype(np.float64)
    squares = np.bincount(place, np.where(owner.ravel() >= 0, (h - means[owner.ravel()]) ** 2, 0.0))
    total = float(np.var(h[owner.ravel() >= 0])) * np.count_nonzero(owner >= 0)
    contacts = label_contacts(standard.labels, mesh, of_cell)
    return [
        records.LabelRow(
            label=row.label, voxels=row.voxels, mesh_voxels=int(np.count_nonzero(painted == row.label)), dice=row.dice,
            E_D_fraction=float(square) / total if total > 0.0 else None, is_lost=row.is_lost,
            volume_mm3=row.volume, mesh_volume_mm3=row.mesh_volume,
            surface_mean_mm=row.distance_mean, surface_p95_mm=row.distance_p95,
            components=row.components, mesh_components=row.mesh_components,
            area_ratio=surface.area_ratio, folded=surface.folded, nonmanifold_edges=surface.nonmanifold_edges,
            nonmanifold_edges_two_labels=surface.nonmanifold_edges_two_labels,
            one_layer_fraction=row.one_layer_fraction,
            excess_contact_mm2=contact_totals([each for each in contacts if row.label in each.labels])["excess_mm2"],
        )
        for row, surface, square in zip(
            label_fidelity(standard.labels, mesh, of_cell), label_interfaces(standard.labels, mesh, of_cell),
            squares, strict=True,
        )
    ]  # fmt: skip


def _simulation(standard: Standard, mesh: Mesh, order: int, against: Reference, percent: float) -> records.Simulation:
    """Run the compression test on a mesh, and measure its errors against the reference, for each average of moduli."""
    bottom, top = box_faces(standard.image, mesh)
    push = push_of(standard.image, percent)
    averages: dict[str, records.Solved] = {}
    for average in standard.averages:
        young = element_young(standard.modulus_fine, mesh, None, average, order)
        begin = time.thread_time()
        # By multigrid for any size, so that all times are of one solver.
        pressed = compression(
            mesh, young, against.nu, fixed_nodes=top, pushed_nodes=bottom, displacement=push, order=order, method="amg"
        )
        seconds = time.thread_time() - begin
        errors = compare(against, mesh, pressed.u, pressed.strain_energy, standard.coarse_labels)
        averages[average] = records.Solved(pressed.strain_energy, errors, seconds)
    system = conditioning(pressed.system)  # for the last, the average that is set
    return records.Simulation(system.lambda_max, system.cond, system.cg_iterations, averages)


# All pipelines.


def run(
    folder: Path, comparison: Comparison, classes: Image, *, resume: bool = False
) -> tuple[Report, dict[int, dict[str, Mesh]]]:
    """Run and measure every pipeline, for linear and for quadratic cells.

    Return the content of `report.json`, and the mesh of each pipeline's first run by order of the cells and by name.

    Parameters
    ----------
    folder : Path
        Each run writes its numbers and its mesh to `folder/runs`.
    comparison : Comparison
        Without labels, the pipelines that segment use `settings.classes` classes.
    classes : Image
        Materials for the rows by label and the interfaces: given labels, or classes of the voxels.
    resume : bool
        Keep finished runs of the same image, settings and versions.

    Raises
    ------
    InputError
        As `prepared`; `folder` has the report of another comparison, which `resume` would replace; another run uses
        `folder/runs`, or it contains foreign files.
    """
    if resume:
        _check_resumable(folder, comparison)
    runs = folder / RUNS_NAME
    with locked(runs, RUNS, runs):
        return _run(runs, comparison, classes, resume=resume)


def _run(
    runs: Path, comparison: Comparison, classes: Image, *, resume: bool
) -> tuple[Report, dict[int, dict[str, Mesh]]]:
    """Run the comparison, with the work directory of its runs."""
    begin = time.perf_counter()
    known = pipelines_with(comparison.settings.programs)
    for name in comparison.settings.pipelines:  # before the hours that the others may take
        if (words := known[name].missing) is not None:
            warning(words)
    facts = _facts(comparison)
    comparison = _settled(comparison, facts, runs, resume=resume)
    image, settings = comparison.image, comparison.settings
    standard = prepared(image, classes, comparison.mapping, settings)
    pipelines = pipelines_with(settings.programs)
    bench = Bench(comparison, standard, pipelines, runs, resume, facts)
    results: dict[int, list[records.PipelineResult]] = {1: [], 2: []}
    meshes: dict[int, dict[str, Mesh]] = {1: {}, 2: {}}
    curves = []
    for name, order in product(settings.pipelines, results):
        attempts = _attempts(bench, name, order)
        results[order].append(_summed_up(name, pipelines[name], attempts))
        first = next((number for number, attempt in enumerate(attempts, 1) if attempt.run is not None), None)
        if first is not None:
            path = _run_path(bench, name, order, settings.nodes, first)
            meshes[order][name] = load_mesh(path.with_suffix(".vtu")).mesh
        curves.append(_curve(bench, results[order][-1], order))
    sweep: list[records.TradeoffRow] = []
    for order in results if settings.tradeoff else ():
        sweep += tradeoff(image, settings.nodes, order, lambda mesh, of: measured(standard, mesh, settings.percent, of))
    report = Report(
        command=comparison.command,
        image=records.ImageFacts(comparison.image_source, image.shape, image.spacing.tolist(), image.variance),
        labels=comparison.label_source,
        mapping=comparison.mapping_words,
        versions=versions() | _peers() | _programs(settings),
        machine=_machine(),
        date=time.strftime("%Y-%m-%d", time.gmtime()),
        options=settings,
        reference=_reference_grid(standard),
        pipelines=results[1],
        quadratic=results[2],
        tradeoff=sweep,
        curves=[curve for curve in curves if curve.points],
        seconds=time.perf_counter() - begin,
    )
    return report, meshes


def _machine() -> dict[str, int | str | None]:
    """Describe the machine and its load: times are unreliable if the load exceeds the number of cores."""
    load = f"{os.getloadavg()[2]:.1f}" if hasattr(os, "getloadavg") else None
    return {
        "cores": os.cpu_count(), "load, mean of 15 minutes": load, "processor": _processor(),
        "system": platform.platform(),
    }  # fmt: skip


def _processor() -> str:
    """Return the processor's name, on Linux from /proc, as `platform` often lacks it."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        for line in lines:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _check_resumable(folder: Path, comparison: Comparison) -> None:
    """Raise InputError if the folder has the report of another comparison, which resuming would replace."""
    path = folder / "report.json"
    if not path.is_file():
        return
    try:
        before = json.loads(text_of(path, "report"))
        earlier = before["options"]["nodes"], before["image"]["sha256"]
    except (ValueError, KeyError, TypeError, RecursionError):
        earlier = None
    if earlier != (comparison.settings.nodes, comparison.image_source.sha256):
        raise InputError(f"{path}: belongs to another comparison (image or `nodes`); use another folder, or `force`")


def _peers() -> dict[str, str]:
    """Return the versions of the installed peers."""
    installed = {}
    for name in ("pytetwild",):
        with contextlib.suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def _programs(settings: Settings) -> dict[str, str]:
    """Return checksums of the files in the command lines of the user's programs, in place of versions."""
    return {f"{each.name}, SHA-256 of its files": ", ".join(file_checksums(each)) for each in settings.programs}


def _facts(comparison: Comparison) -> Facts:
    """Return image, labels, moduli and versions, without the mapping's text, which may name a file that has changed."""
    source = comparison.label_source
    modulus = young_image(comparison.image, comparison.mapping).data
    facts = {
        "image": as_json(comparison.image_source),
        "labels": as_json(source and source._replace(names={})),
        "modulus_sha256": hashlib.sha256(modulus.tobytes()).hexdigest(),
        "versions": versions() | _peers(),
    }
    return json.loads(json.dumps(facts))


def _key(bench: Bench, name: str) -> str:
    """Return a checksum of everything that a finished run's numbers depend on, without the other pipelines."""
    settings = bench.comparison.settings
    same = {key: value for key, value in as_json(settings._asdict()).items() if key not in FREE_SETTINGS}
    program = [[each.command, file_checksums(each)] for each in settings.programs if each.name == name]
    return _checksum([bench.facts, same, program])


def _run_path(bench: Bench, name: str, order: int, nodes: int, repeat: int) -> Path:
    """Return the path of a run's numbers; its mesh is next to it."""
    return bench.folder / f"{name}-{nodes}{'-quadratic' if order == 2 else ''}-{repeat}.json"


def _attempts(bench: Bench, name: str, order: int) -> list[Attempt]:
    """Run a pipeline, several times if its result varies, until the first failure."""
    settings = bench.comparison.settings
    attempts: list[Attempt] = []
    while len(attempts) < (settings.repeats if bench.pipelines[name].is_random else 1):
        attempts.append(_attempt(bench, name, order, settings.nodes, len(attempts) + 1))
        if attempts[-1].failure is not None:
            break
    return attempts


def _kept(path: Path, key: str) -> Attempt | None:
    """Return a finished run's numbers if they are complete and belong to the same key and to the mesh next to them."""
    content = _read_back(path)
    if not isinstance(content, dict) or content.get("key") != key:
        return None
    try:
        is_same = content["mesh_file_sha256"] == sha256(path.with_suffix(".vtu"))
        return from_json(Attempt, content) if is_same else None
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None


def _attempt(bench: Bench, name: str, order: int, nodes: int, repeat: int) -> Attempt:
    """Run a pipeline once, or read its file if that is finished and has the same key."""
    path = _run_path(bench, name, order, nodes, repeat)
    title = bench.pipelines[name].title + (", quadratic" if order == 2 else "")
    key = _key(bench, name)
    kept = _kept(path, key) if bench.resume else None
    if kept is not None:
        note(f"{title}, {nodes} nodes: already finished")
        return kept
    note(f"{title}, {nodes} nodes")
    comparison, settings = bench.comparison, bench.comparison.settings
    job = PipelineInput(
        comparison.image, comparison.labels, nodes, settings.classes, settings.k_D, settings.iterations, order
    )  # fmt: skip
    outcome = run_in_child(
        bench.pipelines[name].function, job, title, max_seconds=settings.max_seconds, max_bytes=settings.max_bytes
    )
    failure = outcome.failure and outcome.failure.removeprefix(f"{bench.pipelines[name].title}: ")
    attempt = Attempt(key, failure, outcome.notes, None, outcome.reason, list(outcome.crashes))
    if outcome.mesh is not None:
        try:
            measurement = measured(bench.standard, outcome.mesh, settings.percent, order, outcome.labels)
        except (InputError, RuntimeError, ArithmeticError, MemoryError, np.linalg.LinAlgError) as error:
            attempt = attempt._replace(failure=f"its mesh cannot be measured: {error}", reason="error")
    if outcome.mesh is None or attempt.failure is not None:
        note(f"{title}: {attempt.failure}")
        return attempt
    mesh_path = path.with_suffix(".vtu")
    fields = cell_fields(outcome.mesh, comparison.image)
    fields |= {} if outcome.labels is None else {"label": outcome.labels}
    save_mesh(mesh_path, outcome.mesh, fields)
    total = sum(seconds for step, seconds in outcome.seconds.items() if step not in UNTIMED_STEPS)
    done = records.PipelineRun(outcome.seconds, total, outcome.peak_bytes, measurement)
    _write_down(path, as_json(attempt._replace(run=done, mesh_file_sha256=sha256(mesh_path))))
    fraction = "none" if measurement.E_D_fraction is None else f"{measurement.E_D_fraction:.4f}"
    note(f"{title}: {measurement.n_nodes} nodes, E_D fraction {fraction}, {total:.0f} s")
    # Read back, so that a kept run and a new one are equal: non-finite numbers are None in both.
    return from_json(Attempt, _read_back(path))


def _summed_up(name: str, shown: Pipeline, attempts: list[Attempt]) -> records.PipelineResult:
    """Return a pipeline's entry in the report."""
    runs = [attempt.run for attempt in attempts if attempt.run is not None]
    failures = [attempt.failure for attempt in attempts if attempt.failure is not None]
    notes = list(dict.fromkeys(note for attempt in attempts for note in attempt.notes))
    crashes = [crash for attempt in attempts for crash in attempt.crashes]
    reason = next((attempt.reason for attempt in attempts if attempt.failure is not None), None)
    failure = failures[0] if failures else None
    result = records.PipelineResult(name, shown.title, shown.kind, shown.about, failure, reason, crashes, notes, runs)
    if not runs:
        return result
    median, low, high = (elementwise(runs, of) for of in (np.median, np.min, np.max))
    return result._replace(median=median, low=low, high=high)


def elementwise(rows: list[Any], of: Callable[[Any], Any]) -> Any:
    """Combine nested numbers of several runs by `of`; anything else, or missing in one run, comes from the first."""
    first = rows[0]
    if hasattr(first, "_fields"):
        return type(first)(*(elementwise(list(parts), of) for parts in zip(*rows, strict=True)))
    if isinstance(first, dict):
        return {k: elementwise([row[k] for row in rows], of) for k in first if all(k in row for row in rows)}
    if isinstance(first, list):
        same = all(len(row) == len(first) for row in rows)
        return [elementwise(list(parts), of) for parts in zip(*rows, strict=True)] if same else first
    if isinstance(first, bool) or any(not isinstance(row, int | float) for row in rows):
        return first
    value = float(of(rows))
    return int(value) if all(isinstance(row, int) for row in rows) and value.is_integer() else value


def _curve(bench: Bench, result: records.PipelineResult, order: int) -> records.Curve:
    """Return errors by number of nodes, with one run per further number; failures are noted in `result`."""
    runs = [] if result.median is None else [result.median]
    settings = bench.comparison.settings
    counts = sorted({max(round(factor * settings.nodes), 20) for factor in settings.curve} - {settings.nodes})
    for nodes in counts if runs else ():
        attempt = _attempt(bench, result.name, order, nodes, 1)
        if attempt.run is not None:
            runs.append(attempt.run)
        else:
            result.notes.append(f"at {nodes} nodes: {attempt.failure}")
    points = [
        records.CurvePoint(each.n_nodes, each.E_D_fraction, each.fem)
        for each in sorted((run.measurement for run in runs), key=lambda each: each.n_nodes)
    ]
    return records.Curve(result.name, result.title, order, points)


def _reference_grid(standard: Standard) -> records.ReferenceGrid:
    first = next(iter(standard.references.values()))
    is_same = standard.modulus.shape == standard.image.shape
    note = "one hexahedron per voxel" if is_same else "the modulus averaged over a coarser grid, also for meshes"
    by_nu = {
        nu: records.ReferenceEnergy(each.strain_energy, each.own_error, each.work.iterations)
        for nu, each in standard.references.items()
    }
    return records.ReferenceGrid(standard.modulus.shape, first.n_dofs, note, by_nu)
