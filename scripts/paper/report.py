"""All of the paper's experiments in one run: `paper.json`, a picture per figure, and
`paper.html`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from paper import experiments
from paper.figures import landscape_figure, relaxation_figure
from paper.scenes import (
    dark_structure_surface,
    isosurface_before_slices,
    slices_in_mesh,
    structure_before_slices,
)
from paper.tissue import mni_tissue
from tetopt.commands.beside import image_and_labels
from tetopt.contents.labels import check_labels
from tetopt.contents.phantom import load_phantom
from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.errors import InputError
from tetopt.geometry.simplex import rho
from tetopt.geometry.topology import largest_component
from tetopt.image import Image
from tetopt.io.images import sha256
from tetopt.io.mni import mni_path
from tetopt.job.events import note
from tetopt.job.options import WHOLE_BOX
from tetopt.measure.segmentation import dice, segment, threshold_image
from tetopt.mesh import Mesh
from tetopt.report.figures import save_figure, slice_figure
from tetopt.report.page import render_page, write_page
from tetopt.report.scene import save_scenes
from tetopt.report.summary import versions
from tetopt.system.files import check_outputs, results_folder, save_json

PAPER_PICTURES = (
    "fig1.png",
    "fig2.png",
    "fig2b.png",
    "fig3ab.png",
    "fig3cd.png",
    "fig3e.png",
    "fig3f.png",
)
PAPER_FILES = ("paper.json", "paper.html", *PAPER_PICTURES)
SNR_DB = (None, 30.0, 20.0)  # of the strain in Fig. 3(c, d); None: without noise
CHANGE_WORDS = {  # of quantities compared before and after, by name in paper.json
    "lambda_max": "largest eigenvalue",
    "cond": "condition number",
    "cg_iterations": "CG iterations",
    "strain_energy": "strain energy",
}


def reproduce(
    output: Path, image: Path | None, labels: Path | None, seeds: int, force: bool = False
) -> tuple[Path, float]:
    """Run every experiment, and write the files `PAPER_FILES` into a folder; return the page and
    the seconds taken.

    Parameters
    ----------
    output : Path
    image : Path or None
        A brain MR volume with dark CSF, for Fig. 3(a, b, e, f) and the segmentation; None:
        nilearn's MNI152.
    labels : Path or None
        Its tissue labels, on the same voxels; None: those of the MNI152, or no section on
        segmentation.
    seeds : int
        Number of random meshes for Fig. 1.
    force : bool
        Replace the files of an earlier run.

    Raises
    ------
    InputError
        Files cannot be read or written, or the volume is too small or uniform for the figures.
    """
    if seeds < 1:
        raise InputError(f"--seeds: expected 1 or more, got {seeds}")
    source = mni_path("t1") if image is None else image
    volume, tissue = image_and_labels(source, labels, WHOLE_BOX)
    labels_name = None if labels is None else labels.name
    if image is None and labels is None:
        tissue, labels_name = mni_tissue(), "MNI152 tissue"
    if min(volume.shape) < 16 or volume.range[0] == volume.range[1]:
        raise InputError(
            "paper: expected a brain volume of 16 voxels or more along each axis, got "
            f"{volume.shape}"
        )
    if tissue is None:
        note("the section on approximate segmentation is left out, as there are no --labels")
    else:
        tissue = check_labels("labels", tissue)
    paths = check_outputs(results_folder(output), PAPER_FILES, force)
    about = {"image": source.name, "image_sha256": sha256(source), "labels": labels_name}
    begin = time.perf_counter()
    steps: dict[str, Callable[[], dict[str, Any]]] = {
        "fig1": lambda: _figure_1(paths, seeds),
        "fig2": lambda: _figure_2(paths),
        "fig2b": lambda: _figure_2b(paths),
        "fig3ab": lambda: _figure_3ab(paths, volume),
        "fig3cd": lambda: _figure_3cd(paths),
        "fig3ef": lambda: _figure_3ef(paths, volume),
    }
    if tissue is not None:
        steps["segmentation"] = lambda: _segmentation(volume, tissue)
    sections = []
    for name, step in steps.items():
        note(experiments.printed_numbers()["sections"][name]["title"])
        sections.append(step())
    seconds = time.perf_counter() - begin
    results = about | {
        "seeds": seeds,
        "versions": versions(),
        "seconds": seconds,
        "sections": sections,
    }
    save_json(paths["paper.json"], results)
    _write_page(paths, results)
    return paths["paper.html"], seconds


def _section(name: str, **values: float) -> dict[str, Any]:
    """Return title and text of an experiment, with these numbers."""
    said = experiments.printed_numbers()["sections"][name]
    return {"title": said["title"], "text": said["text"].format(**values)}


def _row(name: str, ours: Any, geometric_mean: float) -> dict[str, Any]:
    """Return a row of Table 1: printed and reproduced numbers."""
    return {
        "name": name,
        **experiments.printed_numbers()["table1"][name],
        "ours": list(ours),
        "geometric_mean": geometric_mean,
    }


def _row_of(name: str, mesh: Mesh) -> dict[str, Any]:
    return _row(name, experiments.errors_of(mesh), experiments.geometric_mean_error(mesh))


def _mesh_row(name: str, mesh: Mesh) -> dict[str, Any]:
    return {
        "name": name,
        "paper": experiments.printed_numbers()["meshes"][name],
        "ours": [len(mesh.points), len(mesh.cells)],
    }


def _figure_1(paths: dict[str, Path], seeds: int) -> dict[str, Any]:
    case = experiments.figure_1(0)
    save_figure(relaxation_figure(case), paths["fig1.png"])
    spread = experiments.figure_1_spread(seeds)
    rows = []
    for name, errors in spread.items():
        low, middle, high = np.percentile(errors, [5, 50, 95], axis=0)
        rows.append(_row(name, middle[:4], middle[4]) | {"p5": low, "p95": high})
    return _section("fig1", seeds=seeds) | {
        "errors": rows,
        "pictures": [["fig1.png", "Fig. 1, seed 0"]],
    }


def _figure_2(paths: dict[str, Path]) -> dict[str, Any]:
    cases = [experiments.figure_2(k_D) for k_D in (0.05, 0.30)]
    initial = cases[0].initial
    meshes = [("initial", initial)] + [(case.title, case.result.mesh) for case in cases]
    save_figure(slice_figure(cases[0].image, meshes), paths["fig2.png"])
    rows = [_row_of("fig2a", initial)]
    rows += [
        _row_of(name, c.result.mesh) for name, c in zip(("fig2c", "fig2d"), cases, strict=True)
    ]
    truth = load_phantom("fig2_2d").label_image()
    overlaps = {
        "voxels": dice(threshold_image(cases[1].image, 4), truth),
        "initial mesh": dice(segment(cases[1].image, initial, 4), truth),
        "k_D = 0.3": dice(segment(cases[1].image, cases[1].result.mesh, 4), truth),
    }
    worst = cases[1].result.mesh
    flat = np.sort((0.5 - rho(worst.points, worst.cells)) ** 2)[-2:]
    return _section("fig2", flat=flat.sum()) | {
        "errors": rows,
        "meshes": [_mesh_row("fig2a", initial)],
        "dice": overlaps,
        "E_D_relative": {case.title: _E_D_relative(case) for case in cases},
        "pictures": [
            ["fig2.png", "Fig. 2(a, c, d): mesh over the phantom, and the mean in each cell"]
        ],
    }


def _simulate(image: Image, mesh: Mesh) -> dict[str, float]:
    simulated = experiments.simulate(image, mesh)[0]
    return {name: getattr(simulated, name) for name in CHANGE_WORDS}


def _E_D_relative(case: experiments.Case) -> float:
    return case.result.history[-1].E_D / case.result.history[0].E_D


def _figure_2b(paths: dict[str, Path]) -> dict[str, Any]:
    landscapes = [experiments.figure_2b(k_D) for k_D in (0.05, 0.3, 0.8)]
    save_figure(landscape_figure(landscapes), paths["fig2b.png"])
    minima = [
        {"k_D": each.k_D, "lowest": each.E.min(), "found": each.E_minimum} for each in landscapes
    ]
    return _section("fig2b") | {
        "minima": minima,
        "pictures": [["fig2b.png", "Fig. 2(b), the descent's end in red"]],
    }


def _figure_3ab(paths: dict[str, Path], volume: Image) -> dict[str, Any]:
    case = experiments.figure_3ab(volume)
    save_figure(
        slice_figure(case.image, [("initial", case.initial), ("k_D = 0.2", case.result.mesh)]),
        paths["fig3ab.png"],
    )
    return _section("fig3ab") | {
        "meshes": [_mesh_row("fig3a", case.initial)],
        "E_D_relative": {"k_D = 0.2": _E_D_relative(case)},
        "pictures": [["fig3ab.png", "Fig. 3(a, b): 128 nodes, before and after 20 iterations"]],
    }


def _figure_3cd(paths: dict[str, Path]) -> dict[str, Any]:
    cases = [experiments.figure_3cd(snr) for snr in SNR_DB]
    shown = cases[1]
    save_figure(
        slice_figure(shown.image, [("initial", shown.initial), (shown.title, shown.result.mesh)]),
        paths["fig3cd.png"],
    )
    rows = [_row_of("fig3c", shown.initial)]
    rows += [_row_of("fig3d", case.result.mesh) | {"case": case.title} for case in cases]
    changes = []
    for case in cases:
        before, after = (_simulate(case.image, mesh) for mesh in (case.initial, case.result.mesh))
        change = {name: after[name] / before[name] - 1.0 for name in after}
        changes.append({"case": case.title, "before": before, "after": after, "change": change})
    return _section("fig3cd") | {
        "errors": rows,
        "meshes": [_mesh_row("fig3c", shown.initial)],
        "simulation": changes,
        "printed_change": experiments.printed_numbers()["change"],
        "pictures": [
            [
                "fig3cd.png",
                "Fig. 3(c, d): approximate modulus, SNR 30 dB, before and after 15 iterations",
            ]
        ],
    }


def _figure_3ef(paths: dict[str, Path], volume: Image) -> dict[str, Any]:
    case = experiments.figure_3ef(volume)
    image, initial, mesh = case.image, case.initial, case.result.mesh
    below = 0.6 * float(np.median(image.data[image.data > image.data.mean()]))
    before, after = (
        largest_component(m.cells, cell_moments(image, m).mean < below) for m in (initial, mesh)
    )
    surface = dark_structure_surface(image, below, np.isin(cell_of_voxel(image, mesh), after))
    scenes = [("slices and part of the initial mesh", slices_in_mesh(image, initial))]
    save_scenes(
        paths["fig3e.png"],
        [*scenes, ("surface from the voxels", isosurface_before_slices(image, surface))],
    )
    shown = [("initial mesh", initial, before), ("optimised mesh", mesh, after)]
    save_scenes(
        paths["fig3f.png"],
        [(title, structure_before_slices(image, m, cells)) for title, m, cells in shown],
    )
    return _section("fig3ef", below=below) | {
        "meshes": [_mesh_row("fig3e", initial)],
        "E_D_relative": {"k_D = 0.3": _E_D_relative(case)},
        "structure": {"below": below, "n_cells_initial": len(before), "n_cells": len(after)},
        "pictures": [
            [
                "fig3e.png",
                "Fig. 3(e): slices embedded in the initial mesh, of which the lower part is "
                "drawn; surface",
            ],
            [
                "fig3f.png",
                "Fig. 3(f): largest set of tetrahedra below the threshold, before and after",
            ],
        ],
    }


def _segmentation(volume: Image, tissue: Image) -> dict[str, Any]:
    case = experiments.segmentation_case(volume)
    overlaps = {
        f"{classes} classes, {name}": dice(labels, tissue)
        for classes in (4, 8)
        for name, labels in (
            ("voxels", threshold_image(volume, classes)),
            ("lattice", segment(volume, case.initial, classes)),
            ("optimised", segment(volume, case.result.mesh, classes)),
        )
    }
    ratio = volume.data.size / len(case.initial.cells)
    return _section("segmentation", ratio=ratio, nodes=len(case.initial.points)) | {
        "dice": overlaps,
        "E_D_relative": {"k_D = 0.3": _E_D_relative(case)},
    }


def _write_page(paths: dict[str, Path], results: dict[str, Any]) -> None:
    words, sections = experiments.printed_numbers()["page"], results["sections"]
    intro = words["intro"].format(version=results["versions"]["tetopt"], image=results["image"])
    if not any("dice" in section and "Section 5" in section["title"] for section in sections):
        intro += words["no_labels"]
    content = render_page(
        Path(__file__).with_name("paper.html"),
        intro=intro,
        sections=sections,
        change_words=CHANGE_WORDS,
        folder=paths["paper.html"].parent,
    )
    write_page(paths["paper.html"], "The paper's figures and table, reproduced", content)
