"""Comparison of tetopt with the conventional pipelines, with the same measures for all.

Every pipeline runs in a separate process on the same image for the same number of nodes, and the
same functions measure every mesh: the sampler, the shape measures, and the compression test against
a voxel grid's solution.
"""

from __future__ import annotations

import os
import platform
import time
from importlib.metadata import version
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.errors import InputError
from tetopt.fem.conditioning import conditioning
from tetopt.fem.elasticity import box_faces, check_fills_box, compression, push_of
from tetopt.fem.reference import (
    Reference,
    average_voxels,
    compare,
    nearest,
    reference,
    reference_shape,
    refine_voxels,
)
from tetopt.geometry.quadratic import node_count
from tetopt.geometry.simplex import dihedral_angles
from tetopt.image import Image
from tetopt.job.events import note, warning
from tetopt.measure.fidelity import cell_labels, label_fidelity, unexplained_of
from tetopt.measure.quality import quality, rho_histogram
from tetopt.mesh import Mesh
from tetopt.model.averages import element_young, young_image
from tetopt.model.mappings import ModulusMapping
from tetopt.report.summary import versions
from tetopt.study import compare_report as records
from tetopt.study.compare_report import Measurement, Report, Settings
from tetopt.study.pipeline_process import Outcome, run_in_child
from tetopt.study.pipelines import PIPELINES, UNTIMED_STEPS, Pipeline, PipelineInput
from tetopt.study.program import pipelines_with
from tetopt.system.arrays import Ints

DEFAULT_REFERENCE_DOFS = 300_000  # 1.4 GB, and 2.5 minutes for both of `Settings.nus`


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


class MadeMesh(NamedTuple):
    """The mesh of a pipeline's median run."""

    mesh: Mesh
    labels: Ints | None  # (M,) its own, if it sets any


class Standard(NamedTuple):
    """The reference that all meshes are measured against."""

    image: Image
    labels: Image  # materials, on the image's voxels
    modulus: Image  # kPa, of the reference's grid, piecewise constant
    modulus_fine: Image  # the same field on about as many voxels as the image
    coarse_labels: NDArray  # of the reference's voxels
    references: dict[str, Reference]  # by nu
    average: str  # of a cell's moduli
    dofs: int  # at most, of the reference


def default_mapping(image: Image) -> tuple[ModulusMapping, str]:
    """Return a modulus mapping for any image, 1 to 10 kPa from its 0.5th to 99.5th percentile,
    and its description.
    """
    low, high = (float(p) for p in np.percentile(image.data, [0.5, 99.5]))
    if high <= low:
        raise InputError("image: too little contrast between its percentiles; pass `young`")
    words = f"1 kPa at intensity {low:g} and below, 10 kPa at {high:g} and above, linear between"
    return [(low, 1.0), (high, 10.0)], words


def prepare_references(
    image: Image, labels: Image, mapping: ModulusMapping, settings: Settings
) -> Standard:
    """Compute the reference solutions, which may take minutes.

    Raises
    ------
    InputError
        As `tetopt.model.mappings.young_from` and `tetopt.fem.reference.reference`.
    """
    fine = young_image(image, mapping)
    dofs = settings.reference_dofs or DEFAULT_REFERENCE_DOFS
    modulus = average_voxels(fine, reference_shape(image.shape, image.spacing, dofs))
    references = {}
    for nu in settings.nus:
        note(f"reference: {' x '.join(map(str, modulus.shape))} voxels, nu = {nu:g}")
        references[f"{nu:g}"] = reference(modulus, nu, settings.percent)
    return Standard(
        image,
        labels,
        modulus,
        refine_voxels(modulus, fine.shape),
        nearest(labels, modulus).data,
        references,
        settings.average,
        dofs,
    )


# Measures of one mesh.


def measure_mesh(
    standard: Standard,
    mesh: Mesh,
    percent: float,
    order: int = 1,
    own: Ints | None = None,
) -> Measurement:
    """Measure everything that is compared of a mesh with cells of this order, compressed by
    `percent` of its height.

    `own` (M,) are the labels that its pipeline gives the cells; -1 is a cell without.
    """
    image, labels = standard.image, standard.labels
    moments = cell_moments(image, mesh)
    fraction, edges = rho_histogram(mesh.points, mesh.cells, bins=20)
    angles, angle_edges = np.histogram(
        dihedral_angles(mesh.points, mesh.cells), bins=36, range=(0.0, 180.0)
    )
    try:
        check_fills_box(image, mesh)
        not_compressed = None
    except InputError as error:
        not_compressed = str(error)
    references = standard.references if not_compressed is None else {}
    majority = cell_labels(labels, mesh)
    own = None if own is None else np.where(own < 0, majority, own)
    return Measurement(
        order=order,
        n_nodes=node_count(mesh.points, mesh.cells, order),
        n_corners=len(mesh.points),
        n_cells=len(mesh.cells),
        E_D=float((moments.n_voxels * moments.variance).sum()) * image.voxel_volume,
        E_D_fraction=unexplained_of(*moments),
        n_missed_voxels=int((cell_of_voxel(image, mesh) < 0).sum()),
        n_empty_cells=int((moments.n_voxels == 0).sum()),
        quality=quality(mesh.points, mesh.cells, mesh.midpoints),
        rho_histogram=records.Histogram(edges.tolist(), fraction.tolist()),
        dihedral_histogram=records.Histogram(
            angle_edges.tolist(), (angles / angles.sum()).tolist()
        ),
        labels=label_fidelity(labels, mesh, majority),
        own_labels=[] if own is None else label_fidelity(labels, mesh, own),
        fem={
            nu: _simulation(standard, mesh, order, each, percent) for nu, each in references.items()
        },
        not_compressed=not_compressed,
    )


def _simulation(
    standard: Standard, mesh: Mesh, order: int, against: Reference, percent: float
) -> records.Simulation:
    """Run the compression test on a mesh, and measure its errors against the reference."""
    bottom, top = box_faces(standard.image, mesh)
    push = push_of(standard.image, percent)
    young = element_young(standard.modulus_fine, mesh, None, standard.average, order)
    begin = time.thread_time()
    # By multigrid for any size, so that all times are of one solver.
    pressed = compression(
        mesh,
        young,
        against.nu,
        fixed_nodes=top,
        pushed_nodes=bottom,
        displacement=push,
        order=order,
        method="amg",
    )
    seconds = time.thread_time() - begin
    errors = compare(against, mesh, pressed.u, pressed.strain_energy, standard.coarse_labels)
    system = conditioning(pressed.system)
    return records.Simulation(
        system.lambda_max, system.cond, system.cg_iterations, pressed.strain_energy, errors, seconds
    )


# All pipelines.


def run(comparison: Comparison, classes: Image) -> tuple[Report, dict[int, dict[str, MadeMesh]]]:
    """Run and measure every pipeline, for linear and for quadratic cells.

    Return the content of `report.json`, and each pipeline's mesh by order of the cells and by name.

    Parameters
    ----------
    comparison : Comparison
        Without labels, the pipelines that segment use `settings.classes` classes.
    classes : Image
        Materials for the rows by label and the interfaces: given labels, or classes of the voxels.

    Raises
    ------
    InputError
        As `prepare_references`.
    """
    begin = time.perf_counter()
    settings = comparison.settings
    known = pipelines_with(settings.programs)
    for name in settings.pipelines:  # before the hours that the others may take
        if (words := known[name].missing) is not None:
            warning(words)
    standard = prepare_references(comparison.image, classes, comparison.mapping, settings)
    results: dict[int, list[records.PipelineResult]] = {1: [], 2: []}
    made: dict[int, dict[str, MadeMesh]] = {1: {}, 2: {}}
    for name, order in product(settings.pipelines, results):
        result, median = _result(comparison, standard, name, known[name], order)
        results[order].append(result)
        if median is not None:
            made[order][name] = median
    image = comparison.image
    report = Report(
        command=comparison.command,
        image=records.ImageFacts(
            comparison.image_source, image.shape, image.spacing.tolist(), image.variance
        ),
        labels=comparison.label_source,
        mapping=comparison.mapping_words,
        versions=versions() | _peers(),
        machine=_machine(),
        date=time.strftime("%Y-%m-%d", time.gmtime()),
        options=settings._replace(reference_dofs=standard.dofs),
        reference=_reference_grid(standard),
        pipelines=results[1],
        quadratic=results[2],
        seconds=time.perf_counter() - begin,
    )
    return report, made


def _result(
    comparison: Comparison, standard: Standard, name: str, pipeline: Pipeline, order: int
) -> tuple[records.PipelineResult, MadeMesh | None]:
    """Run a pipeline, several times if its result varies, until the first failure; return the
    median run's mesh.
    """
    outcomes: list[Outcome] = []
    done: list[tuple[records.PipelineRun, MadeMesh]] = []
    while len(outcomes) < (comparison.settings.repeats if pipeline.is_random else 1):
        outcome, made = _attempt(comparison, standard, pipeline, order)
        outcomes.append(outcome)
        if made is None:
            break
        done.append(made)
    # The lower of the two in the middle, so that the numbers are those of one mesh.
    median = (
        sorted(done, key=lambda each: each[0].measurement.E_D)[(len(done) - 1) // 2]
        if done
        else (None, None)
    )
    result = records.PipelineResult(
        name,
        pipeline.title,
        pipeline.kind,
        pipeline.about,
        outcomes[-1].failure,
        notes=list(dict.fromkeys(note for each in outcomes for note in each.notes)),
        runs=[run for run, _ in done],
        median=median[0],
    )
    return result, median[1]


def _attempt(
    comparison: Comparison, standard: Standard, pipeline: Pipeline, order: int
) -> tuple[Outcome, tuple[records.PipelineRun, MadeMesh] | None]:
    """Run a pipeline once and measure its mesh; return the outcome, and the run unless it
    failed.
    """
    settings, title = comparison.settings, pipeline.title + records.MESH_WORDS[order]
    note(f"{title}, {settings.nodes} nodes")
    job = PipelineInput(
        comparison.image,
        comparison.labels,
        settings.nodes,
        settings.classes,
        settings.k_D,
        settings.iterations,
        order,
    )
    made = run_in_child(
        pipeline.function,
        job,
        title,
        max_seconds=settings.max_seconds,
        max_bytes=settings.max_bytes,
    )
    if made.mesh is not None:
        try:
            measurement = measure_mesh(standard, made.mesh, settings.percent, order, made.labels)
        except (
            InputError,
            RuntimeError,
            ArithmeticError,
            MemoryError,
            np.linalg.LinAlgError,
        ) as error:
            made = made._replace(mesh=None, failure=f"its mesh cannot be measured: {error}")
    if made.mesh is None:
        made = made._replace(failure=(made.failure or "").removeprefix(f"{pipeline.title}: "))
        note(f"{title}: {made.failure}")
        return made, None
    total = sum(seconds for step, seconds in made.seconds.items() if step not in UNTIMED_STEPS)
    note(f"{title}: {measurement.n_nodes} nodes, {total:.0f} s")
    run = records.PipelineRun(made.seconds, total, made.peak_bytes, measurement)
    return made, (run, MadeMesh(made.mesh, made.labels))


def _machine() -> dict[str, int | str | None]:
    """Describe the machine and its load: times are unreliable if the load exceeds the number of
    cores.
    """
    load = f"{os.getloadavg()[2]:.1f}" if hasattr(os, "getloadavg") else None
    return {
        "cores": os.cpu_count(),
        "load, mean of 15 minutes": load,
        "system": platform.platform(),
        "processor": platform.processor() or platform.machine(),
    }


def _peers() -> dict[str, str]:
    """Return the versions of the installed peers."""
    installed = (each for each in PIPELINES.values() if each.missing is None)
    return {package: version(package) for each in installed for package in each.packages}


def _reference_grid(standard: Standard) -> records.ReferenceGrid:
    first = next(iter(standard.references.values()))
    is_same = standard.modulus.shape == standard.image.shape
    note = (
        "one hexahedron per voxel"
        if is_same
        else "the modulus averaged over a coarser grid, also for meshes"
    )
    by_nu = {
        nu: records.ReferenceEnergy(each.strain_energy, each.own_error, each.n_iterations)
        for nu, each in standard.references.items()
    }
    return records.ReferenceGrid(standard.modulus.shape, first.n_dofs, note, by_nu)
