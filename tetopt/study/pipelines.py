"""Seven ways from an image to a mesh of its box with a requested number of nodes, under one signature."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from tetopt.engine.fast import prepare_kernels
from tetopt.engine.loop import GRADED_ITERATIONS, GRADED_K_D, UNIFORM_ITERATIONS, UNIFORM_K_D
from tetopt.engine.meshing import Mode, mesh_image
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.start.lattice import lattice
from tetopt.study.interfaces import OTSU_CLASSES
from tetopt.target.content import Content, content


class Job(NamedTuple):
    """What every pipeline gets."""

    image: Image  # 3-D
    labels: Image | None  # a given segmentation, on the image's voxels; without one, those who need it make their own
    nodes: int  # requested
    classes: int = OTSU_CLASSES
    k_D: float = UNIFORM_K_D  # of uniform meshes; the graded one has its own
    iterations: int = UNIFORM_ITERATIONS  # likewise


class Produced(NamedTuple):
    """What every pipeline returns."""

    mesh: Mesh  # fills the image's box, unless a note says otherwise
    seconds: dict[str, float]  # by step, in their order
    notes: list[str]


UNTIMED_STEPS = {  # steps that a run's total does not count, and why
    "kernels": "loading compiled code, not in the total",
    "search": "other runs, made to meet the number of nodes; not in the total",
}


class _Clock:
    """Wall time by step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - begin


def bcc(job: Job) -> Produced:
    """The body-centred cubic lattice, untouched.

    Raises
    ------
    InputError
        As `tetopt.start.lattice.lattice`.
    """
    clock = _Clock()
    with clock.step("lattice"):
        mesh = lattice(job.image, nodes=job.nodes)
    return Produced(mesh, clock.seconds, [])


def odt(job: Job) -> Produced:
    """The lattice relaxed to the best shapes, whatever the image shows: the paper's scheme with k_D = 0.

    Raises
    ------
    InputError
        As `tetopt.mesh_image`.
    """
    return _by_mesh_image(job, "paper", 0.0, job.iterations)


def tetopt(job: Job) -> Produced:
    """`tetopt.mesh_image` with its defaults: nodes where the image, and labels that are given, have content.

    Raises
    ------
    InputError
        As `tetopt.mesh_image` and `tetopt.target.content.content`.
    """
    return _by_mesh_image(job, "graded", GRADED_K_D, GRADED_ITERATIONS)


def tetopt_uniform(job: Job) -> Produced:
    """The lattice and the fast engine, as `tetopt mesh --uniform`; labels that are given have their say too.

    Raises
    ------
    InputError
        As `tetopt.mesh_image` and `tetopt.target.content.content`.
    """
    return _by_mesh_image(job, "uniform", job.k_D, job.iterations)


def tetopt_paper(job: Job) -> Produced:
    """The lattice and the paper's own scheme, as `tetopt mesh --method paper`.

    Raises
    ------
    InputError
        As `tetopt.mesh_image`.
    """
    return _by_mesh_image(job, "paper", job.k_D, job.iterations)


def pytetwild(job: Job) -> Produced:
    """Interfaces of the classes or labels, and fTetWild with a sizing field around them; see `tetwild`.

    Raises
    ------
    InputError
        As `tetopt.study.interfaces.interfaces` and `tetopt.study.tetwild.filled`.
    """
    from tetopt.study.interfaces import interfaces
    from tetopt.study.tetwild import filled, node_spacing

    clock = _Clock()
    with clock.step("surfaces"):
        surfaces = interfaces(job.image, node_spacing(job.image, job.nodes), classes=job.classes, labels=job.labels)
    with clock.step("tetrahedra"):
        result = filled(job.image, surfaces, job.nodes)
    clock.seconds["tetrahedra"] -= result.search_seconds
    clock.seconds["search"] = result.search_seconds
    return Produced(result.mesh, clock.seconds, [*surfaces.notes, f"{result.n_runs} runs", *result.notes])


def cleaver(job: Job) -> Produced:
    """Labels, given or by thresholds, and Cleaver's lattice stuffing; see `cleaver`.

    Raises
    ------
    InputError
        As `tetopt.study.cleaver.stuffed`.
    """
    from tetopt.study.cleaver import stuffed
    from tetopt.study.interfaces import class_labels

    clock = _Clock()
    with clock.step("labels"):
        labels = class_labels(job.image, job.classes) if job.labels is None else job.labels
    with clock.step("tetrahedra"):
        result = stuffed(job.image, labels, job.nodes)
    clock.seconds["tetrahedra"] -= result.search_seconds
    clock.seconds["search"] = result.search_seconds
    return Produced(result.mesh, clock.seconds, [f"{result.n_runs} runs", *result.notes])


def _content(job: Job, clock: _Clock) -> tuple[Image | Content, list[str]]:
    """What the mesh is to represent, and what to note of it: the image, with labels if they are given."""
    if job.labels is None:
        return job.image, []
    with clock.step("labels"):
        if np.array_equal(job.image.data, job.labels.data):
            # As intensities the numbers of labels mean nothing: label 9 is no farther from 1 than 2 is.
            return content(job.image, labels=job.labels, weights=[0.0]), ["the image is its labels: meshed as labels"]
        return content(job.image, labels=job.labels), ["meshed from the image and the labels given, equally weighted"]


def _by_mesh_image(job: Job, mode: Mode, k_D: float, iterations: int) -> Produced:
    """A mesh of ours; the paper's scheme takes the image alone."""
    clock = _Clock()
    content, notes = (job.image, list[str]()) if mode == "paper" else _content(job, clock)
    with clock.step("kernels"):
        prepare_kernels(content, k_D, "paper" if mode == "paper" else "fast", is_graded=mode == "graded")
    result = mesh_image(content, job.nodes, mode=mode, k_D=k_D, iterations=iterations)
    start = "octree" if mode == "graded" else "lattice"
    seconds = {**clock.seconds, start: result.seconds_start, "optimize": result.seconds_run}
    return Produced(result.mesh, seconds, [f"ended by: {result.ended}", *notes])


class Pipeline(NamedTuple):
    """How a pipeline is shown, what it does, and whether its result changes from run to run."""

    title: str
    kind: str  # "tetopt", "peer" or "control"
    about: str
    function: Callable[[Job], Produced]
    is_random: bool = False


PIPELINES = {
    "tetopt": Pipeline(
        "tetopt", "tetopt", "tetopt mesh with its defaults: nodes where the image, or labels given, have content",
        tetopt,
    ),
    "tetopt-uniform": Pipeline(
        "tetopt, uniform", "tetopt", "tetopt mesh --uniform: BCC lattice, fast engine, with labels that are given",
        tetopt_uniform,
    ),
    "tetopt-paper": Pipeline(
        "tetopt, paper's scheme", "tetopt", "tetopt mesh --method paper, of the image alone", tetopt_paper
    ),
    "pytetwild": Pipeline(
        "pytetwild", "peer", "classes by multi-Otsu or the labels given, their surfaces, fTetWild sized by them",
        pytetwild, is_random=True,
    ),
    "cleaver": Pipeline("itk-cleaver", "peer", "the same labels, Cleaver", cleaver),
    "bcc": Pipeline("BCC lattice", "control", "the uniform lattice, untouched", bcc),
    "odt": Pipeline("ODT, image-blind", "control", "the lattice optimised for shape alone, k_D = 0", odt),
}  # fmt: skip
