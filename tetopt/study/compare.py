"""tetopt against the conventional pipelines: run, measured alike, and set side by side.

Every pipeline runs in a process of its own on the same image for the same number of nodes, and every mesh is measured
by the same functions: the sampler, the shape measures, and the compression test against a voxel grid's solution.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.engine.loop import UNIFORM_ITERATIONS, UNIFORM_K_D
from tetopt.errors import InputError
from tetopt.fem.conditioning import conditioning
from tetopt.fem.elasticity import box_faces, compression, push_of
from tetopt.fem.reference import Reference, averaged, compare, nearest, reference
from tetopt.geometry.simplex import dihedral_angles
from tetopt.image import Image
from tetopt.io.files import save_json
from tetopt.io.meshes import load_mesh, save_mesh
from tetopt.measure.fidelity import cell_labels, label_fidelity
from tetopt.measure.quality import quality, rho_histogram
from tetopt.mesh import Mesh
from tetopt.model.averages import cell_young, young_image
from tetopt.model.fields import cell_fields
from tetopt.model.laws import Law
from tetopt.report.summary import image_summary, versions
from tetopt.study.child import run_in_child
from tetopt.study.pipelines import UNTIMED, Job
from tetopt.study.tradeoff import tradeoff

Say = Callable[[str], None]


class Pipeline(NamedTuple):
    """How a pipeline is shown, and whether its result changes from run to run."""

    title: str
    kind: str  # "tetopt", "peer" or "control"
    about: str
    is_random: bool = False


SHOWN = {
    "tetopt": Pipeline(
        "tetopt", "tetopt", "tetopt mesh with its defaults: nodes where the image, or labels given, have content"
    ),
    "tetopt-uniform": Pipeline(
        "tetopt, uniform", "tetopt", "tetopt mesh --uniform: BCC lattice, fast engine, with labels that are given"
    ),
    "tetopt-paper": Pipeline("tetopt, paper's scheme", "tetopt", "tetopt mesh --method paper, of the image alone"),
    "pytetwild": Pipeline(
        "pytetwild", "peer", "classes by multi-Otsu or the labels given, their surfaces, fTetWild sized by them", True
    ),
    "cleaver": Pipeline("itk-cleaver", "peer", "the same labels, Cleaver"),
    "bcc": Pipeline("BCC lattice", "control", "the uniform lattice, untouched"),
    "odt": Pipeline("ODT, image-blind", "control", "the lattice optimised for shape alone, k_D = 0"),
}  # fmt: skip


class Settings(NamedTuple):
    """What is compared and how; all of it is in the report."""

    nodes: int
    pipelines: tuple[str, ...] = tuple(SHOWN)
    repeats: int = 3  # of pipelines whose result changes from run to run
    classes: int = 4  # of the multi-Otsu segmentation, without labels
    k_D: float = UNIFORM_K_D
    iterations: int = UNIFORM_ITERATIONS
    nus: tuple[float, ...] = (0.3, 0.45)
    percent: float = 1.0  # of compression
    reference_dofs: int = 300_000  # the voxel grid is averaged until it has no more
    curve: tuple[float, ...] = (0.25, 0.5, 2.0)  # node counts of the error curves, of `nodes`, besides `nodes` itself
    tradeoff: bool = False  # whether tetopt's options are swept around its defaults
    max_seconds: float = 3600.0  # of one pipeline
    max_bytes: int | None = None


class Setting(NamedTuple):
    """What all meshes are measured against."""

    image: Image
    labels: Image  # materials, on the image's voxels
    modulus: Image  # kPa, of the reference's grid, piecewise constant
    modulus_fine: Image  # the same field at the image's voxels
    coarse_labels: NDArray  # of the reference's voxels
    references: dict[str, Reference]  # by nu


def default_law(image: Image) -> tuple[Law, str]:
    """A modulus from any image: 1 to 10 kPa between its 0.5th and 99.5th percentile, and the words for it."""
    low, high = (float(p) for p in np.percentile(image.data, [0.5, 99.5]))
    if high <= low:
        raise InputError("image: hardly any contrast between its percentiles; give --young")
    return [
        (low, 1.0),
        (high, 10.0),
    ], f"1 kPa at intensity {low:g} and below, 10 kPa at {high:g} and above, linear between"


def reference_shape(shape: Sequence[int], spacing: NDArray[np.float64], dofs: int) -> tuple[int, ...]:
    """The finest grid of nearly cubic voxels over the image's box of `dofs` or fewer, no finer than the image."""
    n = len(shape)
    size = np.array(shape) * spacing
    step = spacing.min()
    while True:
        coarse = np.clip(np.rint(size / np.maximum(step, spacing)), 1, shape).astype(int)
        if n * np.prod(coarse + 1) <= dofs:
            return tuple(int(c) for c in coarse)
        step *= 1.02


def prepared(image: Image, labels: Image, law: Law, settings: Settings, say: Say) -> Setting:
    """The reference solutions, which take a while.

    Raises
    ------
    InputError
        As `tetopt.model.laws.young_from` and `tetopt.fem.reference.reference`.
    """
    fine = young_image(image, law)
    modulus = averaged(fine, reference_shape(image.shape, image.spacing, settings.reference_dofs))
    references = {}
    for nu in settings.nus:
        say(f"reference: {' x '.join(map(str, modulus.shape))} voxels, nu = {nu:g}")
        references[f"{nu:g}"] = reference(modulus, nu, settings.percent)
    return Setting(image, labels, modulus, nearest(modulus, fine), nearest(labels, modulus).data, references)


# One mesh, measured.


def measured(setting: Setting, mesh: Mesh, percent: float) -> dict[str, Any]:
    """Everything that is compared of a mesh, as `report.json` holds it of each run.

    E_D and its share of the image's variance; shape; histograms; by label how well the mesh shows it
    (`tetopt.measure.fidelity.label_fidelity`), the voxels painted back by its cells and E_D's share; and by nu what the
    compression test finds and its errors (`tetopt.fem.reference.Errors`).
    """
    image = setting.image
    moments = cell_moments(image, mesh)
    owner = cell_of_voxel(image, mesh)
    total = image_summary(image)["total_variation"]
    E_D = float((moments.n_voxels * moments.variance).sum()) * image.voxel_volume
    share, edges = rho_histogram(mesh.points, mesh.cells, bins=20)
    angles, angle_edges = np.histogram(dihedral_angles(mesh.points, mesh.cells), bins=36, range=(0.0, 180.0))
    return {
        "n_nodes": len(mesh.points),
        "n_cells": len(mesh.cells),
        "E_D": E_D,
        "E_D_share": E_D / total if total > 0.0 else None,
        "n_missed_voxels": int((owner < 0).sum()),
        "n_empty_cells": int((moments.n_voxels == 0).sum()),
        "quality": quality(mesh.points, mesh.cells)._asdict(),
        "rho_histogram": {"edges": edges, "share": share},
        "dihedral_histogram": {"edges": angle_edges, "share": angles / angles.sum()},
        "labels": _by_label(setting, mesh, moments.mean, owner),
        "fem": {nu: _simulated(setting, mesh, found, percent) for nu, found in setting.references.items()},
    }


def _by_label(
    setting: Setting, mesh: Mesh, means: NDArray[np.float64], owner: NDArray[np.int64]
) -> list[dict[str, Any]]:
    """A row for each label of the image: `LabelFidelity`, the voxels of its cells, E_D's share."""
    of_cell = cell_labels(setting.labels, mesh)
    label = setting.labels.data.ravel().astype(np.int64)
    # Outside of the mesh there is label 0, as `label_fidelity` has it.
    shown = np.bincount(np.where(owner >= 0, of_cell[owner], 0).ravel(), minlength=int(label.max()) + 1)
    h = setting.image.data.ravel().astype(np.float64)
    squares = np.bincount(label, np.where(owner.ravel() >= 0, (h - means[owner.ravel()]) ** 2, 0.0))
    total = float(((h - h.mean()) ** 2).sum())
    return [
        {
            "label": row.label, "voxels": row.voxels, "mesh_voxels": int(shown[row.label]), "dice": row.dice,
            "E_D_share": float(squares[row.label]) / total if total > 0.0 else None, "is_lost": row.is_lost,
            "volume_mm3": row.volume, "mesh_volume_mm3": row.mesh_volume,
            "surface_mean_mm": row.distance_mean, "surface_p95_mm": row.distance_p95,
            "components": row.components, "mesh_components": row.mesh_components,
        }
        for row in label_fidelity(setting.labels, mesh, of_cell)
    ]  # fmt: skip


def _simulated(setting: Setting, mesh: Mesh, found: Reference, percent: float) -> dict[str, Any]:
    """The compression test on a mesh, and how far it is from the reference."""
    young = cell_young(setting.modulus_fine, mesh)
    bottom, top = box_faces(setting.image, mesh)
    push = push_of(setting.image, percent)
    pressed = compression(mesh, young, found.nu, fixed_nodes=top, pushed_nodes=bottom, displacement=push)
    system = conditioning(pressed.system)
    errors = compare(found, mesh, pressed.u, pressed.strain_energy, setting.coarse_labels)
    return {
        "lambda_max": system.lambda_max, "cond": system.cond, "cg_iterations": system.cg_iterations,
        "strain_energy": pressed.strain_energy, "errors": errors._asdict(),
    }  # fmt: skip


# All pipelines.


def run(
    folder: Path, about: dict[str, Any], image: Image, labels: Image | None, classes: Image, law: Law,
    settings: Settings, say: Say, *, resume: bool = False,
) -> tuple[dict[str, Any], dict[str, Mesh]]:  # fmt: skip
    """Run and measure every pipeline; what `report.json` holds, and the mesh of each pipeline's first run.

    Parameters
    ----------
    folder : Path
        Each run leaves its numbers and its mesh in `folder/runs`.
    about : dict
        Of the report: "image", "labels", "law" and "command".
    image : Image
    labels : Image or None
        Given to the pipelines that segment, and to tetopt's own besides the image; None lets the former find
        `settings.classes` classes.
    classes : Image
        Materials for the rows by label and the interfaces: the labels given, or classes of the voxels.
    law : Law
        From intensity to kPa.
    settings : Settings
    say : callable
        Told what is being done.
    resume : bool
        Keep finished runs of the same image, settings and versions.
    """
    begin = time.perf_counter()
    runs = folder / "runs"
    key = _key(about, settings)
    if resume:
        _check_resumable(folder, about, settings)
    runs.mkdir(exist_ok=True)
    setting = prepared(image, classes, law, settings, say)
    pipelines, meshes = [], {}
    for name in settings.pipelines:
        job = Job(image, labels, settings.nodes, settings.classes, settings.k_D, settings.iterations)
        repeats = settings.repeats if SHOWN[name].is_random else 1
        found = []
        for repeat in range(repeats):
            path = runs / f"{name}-{settings.nodes}-{repeat + 1}.json"
            found.append(_one_run(name, job, setting, settings, path, key, resume, say))
            if found[-1]["failure"] is not None:
                break
        done = [row for row in found if row["failure"] is None]
        if done:
            first = found.index(done[0]) + 1
            meshes[name] = load_mesh(runs / f"{name}-{settings.nodes}-{first}.vtu").mesh
        pipelines.append(_summed_up(name, found))
    curves = [_curve(pipeline, setting, settings, image, labels, runs, key, resume, say) for pipeline in pipelines]
    swept = (
        tradeoff(image, settings.nodes, lambda mesh: measured(setting, mesh, settings.percent), say)
        if settings.tradeoff
        else []
    )
    results = {
        **about,
        "versions": versions() | _peers(),
        "machine": {"cores": os.cpu_count(), "system": platform.platform()},
        "image": about["image"] | _image_words(image),
        "options": settings._asdict(),
        "reference": _reference_words(setting),
        "pipelines": pipelines,
        "tradeoff": swept,
        "curves": [curve for curve in curves if curve["points"]],
        "seconds": time.perf_counter() - begin,
    }
    return results, meshes


def _check_resumable(folder: Path, about: dict[str, Any], settings: Settings) -> None:
    """InputError if the folder holds the report of another comparison, which resuming would replace."""
    path = folder / "report.json"
    if not path.is_file():
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        same = before["options"]["nodes"] == settings.nodes and before["image"]["sha256"] == about["image"]["sha256"]
    except (ValueError, KeyError, TypeError):
        same = False
    if not same:
        raise InputError(f"{path}: is of another comparison (image or --nodes); take another folder, or --force")


def _peers() -> dict[str, str]:
    """Versions of the peers that are installed."""
    found = {}
    for name in ("pytetwild", "itk-cleaver"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _key(about: dict[str, Any], settings: Settings) -> str:
    """Changes with everything that a finished run's numbers depend on, but not with what else is compared."""
    same = settings._replace(
        pipelines=(), repeats=0, curve=(), nodes=0, tradeoff=False, max_seconds=0.0, max_bytes=None
    )
    facts = {"image": about["image"], "labels": about["labels"], "law": about["law"]}
    tools = versions() | _peers()
    return hashlib.sha256(json.dumps([facts, same, tools], sort_keys=True, default=str).encode()).hexdigest()


def _kept(path: Path, key: str) -> dict[str, Any] | None:
    """A finished run's numbers, if they are whole, of the same key and of the mesh that lies beside them."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        mesh = path.with_suffix(".vtu").read_bytes()
    except (OSError, ValueError):
        return None
    return kept if kept.get("key") == key and kept.get("mesh_file_sha256") == _sha256(mesh) else None


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _one_run(
    name: str, job: Job, setting: Setting, settings: Settings, path: Path, key: str, resume: bool, say: Say
) -> dict[str, Any]:
    """One pipeline once, from its file if that is finished and of the same key."""
    kept = _kept(path, key) if resume else None
    if kept is not None:
        say(f"{SHOWN[name].title}, {job.nodes} nodes: kept from before")
        return kept
    say(f"{SHOWN[name].title}, {job.nodes} nodes")
    outcome = run_in_child(name, job, max_seconds=settings.max_seconds, max_bytes=settings.max_bytes)
    row: dict[str, Any] = {
        "key": key, "failure": outcome.failure, "notes": outcome.notes, "seconds": outcome.seconds,
        "seconds_total": sum(seconds for step, seconds in outcome.seconds.items() if step not in UNTIMED),
        "peak_bytes": outcome.peak_bytes,
    }  # fmt: skip
    if outcome.mesh is None:
        say(f"{SHOWN[name].title}: {outcome.failure}")
        return row
    try:
        row |= measured(setting, outcome.mesh, settings.percent)
    except (InputError, RuntimeError, ArithmeticError, np.linalg.LinAlgError) as error:
        row["failure"] = f"its mesh cannot be measured: {error}"
        say(f"{SHOWN[name].title}: {row['failure']}")
        return row
    mesh_path = path.with_suffix(".vtu")
    save_mesh(mesh_path, outcome.mesh, cell_fields(outcome.mesh, setting.image))
    save_json(path, row | {"mesh_file_sha256": _sha256(mesh_path.read_bytes())})
    done: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    share = "none" if done["E_D_share"] is None else f"{done['E_D_share']:.4f}"
    say(f"{SHOWN[name].title}: {done['n_nodes']} nodes, E_D share {share}, {done['seconds_total']:.0f} s")
    return done


def _summed_up(name: str, found: list[dict[str, Any]]) -> dict[str, Any]:
    """A pipeline's entry in the report."""
    shown = SHOWN[name]
    done = [
        {k: v for k, v in row.items() if k not in ("key", "failure", "notes", "mesh_file_sha256")}
        for row in found
        if row["failure"] is None
    ]
    failures = [row["failure"] for row in found if row["failure"] is not None]
    notes = list(dict.fromkeys(note for row in found for note in row["notes"]))
    entry: dict[str, Any] = {
        "name": name, "title": shown.title, "kind": shown.kind, "about": shown.about,
        "failure": failures[0] if failures else None, "notes": notes, "runs": done,
    }  # fmt: skip
    if done:
        for word, of in (("median", np.median), ("low", np.min), ("high", np.max)):
            entry[word] = _elementwise(done, of)
    return entry


def _elementwise(rows: list[Any], of: Callable[[Any], Any]) -> Any:
    """Nested numbers of several runs made one by `of`; what is no number, or missing in one, is the first's."""
    first = rows[0]
    if isinstance(first, dict):
        return {k: _elementwise([row[k] for row in rows], of) for k in first if all(k in row for row in rows)}
    if isinstance(first, list):
        same = all(len(row) == len(first) for row in rows)
        return [_elementwise(list(parts), of) for parts in zip(*rows, strict=True)] if same else first
    if isinstance(first, bool) or any(not isinstance(row, int | float) for row in rows):
        return first
    value = float(of(rows))
    return int(value) if all(isinstance(row, int) for row in rows) and value.is_integer() else value


def _curve(
    pipeline: dict[str, Any], setting: Setting, settings: Settings, image: Image, labels: Image | None, runs: Path,
    key: str, resume: bool, say: Say,
) -> dict[str, Any]:  # fmt: skip
    """Errors against the number of nodes; one run a count besides the main one."""
    name = pipeline["name"]
    rows = [pipeline["median"]] if "median" in pipeline else []
    counts = sorted({max(round(factor * settings.nodes), 20) for factor in settings.curve} - {settings.nodes})
    for nodes in counts if rows else ():
        job = Job(image, labels, nodes, settings.classes, settings.k_D, settings.iterations)
        row = _one_run(name, job, setting, settings, runs / f"{name}-{nodes}-1.json", key, resume, say)
        if row["failure"] is None:
            rows.append(row)
        else:
            pipeline["notes"].append(f"at {nodes} nodes: {row['failure']}")
    points = [
        {
            "n_nodes": row["n_nodes"], "E_D_share": row["E_D_share"],
            "errors": {nu: fem["errors"] for nu, fem in row["fem"].items()},
        }
        for row in sorted(rows, key=lambda row: row["n_nodes"])
    ]  # fmt: skip
    return {"name": name, "title": pipeline["title"], "points": points}


def _image_words(image: Image) -> dict[str, Any]:
    return {"shape": image.shape, "spacing_mm": image.spacing, "variance": float(np.var(image.data, dtype=np.float64))}


def _reference_words(setting: Setting) -> dict[str, Any]:
    first = next(iter(setting.references.values()))
    is_same = setting.modulus.shape == setting.image.shape
    note = "a hexahedron to every voxel" if is_same else "the modulus averaged over a coarser grid, for meshes too"
    rows = {nu: {"strain_energy": found.strain_energy} for nu, found in setting.references.items()}
    return {"shape": setting.modulus.shape, "n_dofs": first.n_dofs, "note": note, **rows}
