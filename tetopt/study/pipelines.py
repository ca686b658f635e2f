"""Seven pipelines from an image to a mesh of its box with a requested number of nodes, with one
signature.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

from tetopt.contents.content import Content, content
from tetopt.engine.aim import Mode
from tetopt.engine.fast import prepare_kernels
from tetopt.engine.loop import UNIFORM_ITERATIONS, UNIFORM_K_D
from tetopt.engine.meshing import MODE_DEFAULTS, mesh_image
from tetopt.geometry.quadratic import node_count
from tetopt.image import Image
from tetopt.measure.segmentation import threshold_image
from tetopt.mesh import Mesh
from tetopt.start.lattice import lattice_mesh
from tetopt.study.isosurfaces import OTSU_CLASSES, interfaces
from tetopt.study.mmg import remesh_image
from tetopt.study.search import LEAST_REQUEST, REQUEST_RESPONSE, corners_for, tries
from tetopt.study.tetwild import Filled, fill_image, node_spacing
from tetopt.system.arrays import Ints
from tetopt.system.extras import install_hint

# of the search for a lattice of order 2, at most; few are so coarse, and a run takes milliseconds
LATTICE_RUNS = 4


class PipelineInput(NamedTuple):
    """Input of every pipeline."""

    image: Image  # 3-D
    # a given segmentation, on the image's voxels; without it, pipelines segment themselves
    labels: Image | None
    nodes: int  # requested, in all
    classes: int = OTSU_CLASSES
    k_D: float = UNIFORM_K_D  # of uniform meshes; the graded one has its own
    iterations: int = UNIFORM_ITERATIONS  # of uniform meshes
    order: int = 1  # of the cells whose nodes are counted: order 2 has mid-edge nodes
    smoothing: float = 1.0  # of the surfaces that a peer fills: larger where it crashed


class Produced(NamedTuple):
    """Result of every pipeline."""

    mesh: Mesh  # fills the image's box, unless a note says otherwise
    seconds: dict[str, float]  # by step, in their order
    notes: list[str]
    # (M,) of each cell, from the job's; -1, or None: those of most voxels
    labels: Ints | None = None


UNTIMED_STEPS = {  # steps that a run's total leaves out, and why
    "kernels": "loading compiled code, not in the total",
    "search": "other runs, to reach the number of nodes; not in the total",
}


@contextmanager
def _time_step(seconds: dict[str, float], step: str) -> Iterator[None]:
    """Store the wall time of a block in `seconds`."""
    begin = time.perf_counter()
    yield
    seconds[step] = time.perf_counter() - begin


def bcc(job: PipelineInput) -> Produced:
    """Build the body-centred cubic lattice, without optimisation.

    Raises
    ------
    InputError
        As `tetopt.start.lattice.lattice_mesh`.
    """
    seconds: dict[str, float] = {}
    with _time_step(seconds, "lattice"):
        first = corners_for(job.nodes, job.order) / job.nodes
        runs = tries(
            lambda factor: lattice_mesh(
                job.image, nodes=max(round(factor * job.nodes), LEAST_REQUEST)
            ),
            lambda mesh: node_count(mesh.points, mesh.cells, job.order),
            job.nodes,
            REQUEST_RESPONSE,
            first=first,
            most=1 if job.order == 1 else LATTICE_RUNS,
        )
    return Produced(runs[0].result, seconds, [])


def ours(job: PipelineInput, mode: Mode) -> Produced:
    """Run `tetopt.mesh_image`: graded with its defaults, else by the job; the paper's scheme uses
    only the image.

    Raises
    ------
    InputError
        As `tetopt.mesh_image` and `tetopt.contents.content.content`.
    """
    seconds: dict[str, float] = {}
    k_D, iterations = MODE_DEFAULTS[mode][:2] if mode == "graded" else (job.k_D, job.iterations)
    content, notes = (job.image, list[str]()) if mode == "paper" else _content(job, seconds)
    with _time_step(seconds, "kernels"):
        prepare_kernels(
            content, k_D, "paper" if mode == "paper" else "fast", is_graded=mode == "graded"
        )
    result = mesh_image(
        content, job.nodes, mode=mode, k_D=k_D, iterations=iterations, order=job.order
    )
    seconds["octree" if mode == "graded" else "lattice"] = result.seconds_start
    seconds["optimize"] = result.seconds_run
    # The reference supports only straight edges, which the other pipelines' meshes have.
    mesh = Mesh(result.mesh.points, result.mesh.cells)
    return Produced(mesh, seconds, [f"ended by: {result.ended}", *notes], result.labels)


def _content(job: PipelineInput, seconds: dict[str, float]) -> tuple[Image | Content, list[str]]:
    """Return the content of the mesh, and notes on it: the image, with labels if given."""
    if job.labels is None:
        return job.image, []
    with _time_step(seconds, "labels"):
        if np.array_equal(job.image.data, job.labels.data):
            # Label numbers are meaningless as intensities: label 9 is no farther from 1 than label
            # 2.
            return content(job.image, labels=job.labels, weights=[0.0]), [
                "the image is a label map: meshed as labels"
            ]
        return content(job.image, labels=job.labels), [
            "meshed from the image and the given labels, equally weighted"
        ]


def pytetwild(job: PipelineInput) -> Produced:
    """Extract interfaces of classes or labels, and run fTetWild with a sizing field around them;
    see `tetwild`.

    Raises
    ------
    InputError
        As `tetopt.study.isosurfaces.interfaces` and `tetopt.study.tetwild.fill_image`.
    """
    seconds: dict[str, float] = {}
    size = node_spacing(job.image, corners_for(job.nodes, job.order))
    with _time_step(seconds, "surfaces"):
        surfaces = interfaces(
            job.image, size, classes=job.classes, labels=job.labels, smoothing=job.smoothing
        )
    with _time_step(seconds, "tetrahedra"):
        result = fill_image(job.image, surfaces, job.nodes, job.order)
    return _search_result(result, seconds, surfaces.notes)


def mmg(job: PipelineInput) -> Produced:
    """Label a fine lattice by classes or labels, and coarsen it by Mmg, which keeps them; see
    `mmg`.

    Raises
    ------
    InputError
        As `tetopt.study.mmg.remesh_image`.
    """
    seconds: dict[str, float] = {}
    labels = threshold_image(job.image, job.classes) if job.labels is None else job.labels
    with _time_step(seconds, "tetrahedra"):
        result, of_cell = remesh_image(job.image, labels, job.nodes, job.order, job.smoothing)
    return _search_result(result, seconds, [])._replace(
        labels=None if job.labels is None else of_cell
    )


def _search_result(result: Filled, seconds: dict[str, float], notes: list[str]) -> Produced:
    """Return a peer's result, with the search for the number of nodes as a separate step."""
    seconds["tetrahedra"] -= result.search_seconds
    seconds["search"] = result.search_seconds
    return Produced(result.mesh, seconds, [*notes, f"{result.n_runs} runs", *result.notes])


class Pipeline(NamedTuple):
    """A pipeline: its title and description, its function, and whether its result varies between
    runs.
    """

    title: str
    kind: str  # "tetopt", "peer" or "control"
    about: str
    function: Callable[[PipelineInput], Produced]
    is_random: bool = False
    packages: tuple[str, ...] = ()  # that it needs
    hint: str = ""  # how to install them

    @property
    def missing(self) -> str | None:
        """How to install what the pipeline needs and this machine lacks, in words."""
        return (
            None
            if all(map(find_spec, self.packages))
            else f"{self.title}: not installed; {self.hint}"
        )


PIPELINES = {
    "tetopt": Pipeline(
        "tetopt",
        "tetopt",
        "tetopt mesh with its defaults: nodes where the image, or given labels, have detail",
        partial(ours, mode="graded"),
    ),
    "tetopt-uniform": Pipeline(
        "tetopt, uniform",
        "tetopt",
        "tetopt mesh --uniform: BCC lattice, fast engine, with given labels",
        partial(ours, mode="uniform"),
    ),
    "tetopt-paper": Pipeline(
        "tetopt, paper's scheme",
        "tetopt",
        "tetopt mesh --method paper, from the image alone",
        partial(ours, mode="paper"),
    ),
    "pytetwild": Pipeline(
        "pytetwild",
        "peer",
        "surfaces of multi-Otsu classes or of given labels, meshed by fTetWild",
        pytetwild,
        is_random=True,
        packages=("pytetwild",),
        hint=f"install it with: {install_hint('pytetwild')}",
    ),
    "mmg": Pipeline(
        "Mmg",
        "peer",
        "a lattice labelled by multi-Otsu classes or given labels, coarsened by Mmg, which keeps "
        "labels",
        mmg,
        packages=("mmgpy",),
        hint=f"install it with: {install_hint('mmgpy')}",
    ),
    "bcc": Pipeline("BCC lattice", "control", "the uniform lattice, not optimised", bcc),
}
