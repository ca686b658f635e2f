"""Records of `report.json`."""

from __future__ import annotations

from typing import NamedTuple

from tetopt.engine.loop import UNIFORM_ITERATIONS, UNIFORM_K_D
from tetopt.fem.reference import Errors, OwnError
from tetopt.measure.fidelity import LabelFidelity
from tetopt.measure.quality import Quality
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.study.isosurfaces import OTSU_CLASSES
from tetopt.study.pipelines import PIPELINES
from tetopt.study.program import Program
from tetopt.system.arrays import Json

ORDER_WORDS = {1: "linear", 2: "quadratic"}
MESH_WORDS = {1: "", 2: ", quadratic"}  # after the title of a pipeline, by order


class Settings(NamedTuple):
    """Settings of a comparison, all of which are in the report."""

    nodes: int
    pipelines: tuple[str, ...] = tuple(PIPELINES)
    programs: tuple[Program, ...] = ()  # the user's own, among the pipelines by name
    repeats: int = 3  # of pipelines whose result changes from run to run
    classes: int = OTSU_CLASSES  # of the multi-Otsu segmentation, without labels
    k_D: float = UNIFORM_K_D
    iterations: int = UNIFORM_ITERATIONS
    nus: tuple[float, ...] = (0.3, 0.45)
    percent: float = 1.0  # of compression, of the box's height
    average: str = DEFAULT_AVERAGE  # of a cell's moduli
    # maximum of the averaged voxel grid; in a report the chosen size
    reference_dofs: int | None = None
    max_seconds: float = 3600.0  # of one run of a pipeline
    max_bytes: int | None = None  # of one run, resident


class ImageSource(NamedTuple):
    """The file that is meshed, and its selected part."""

    name: str
    sha256: str
    volume: int | None  # of a series
    crop: str | None


class LabelSource(NamedTuple):
    """The file of the labels."""

    name: str
    sha256: str
    # never modified; of the labels in the image that have one
    names: dict[int, str] = {}  # noqa: RUF012

    def words(self, label: int) -> str:
        """Return a label with its name, if it has one."""
        return f"{label} {self.names.get(label, '')}".rstrip()


class Histogram(NamedTuple):
    """Fractions between edges."""

    edges: list[float]  # one more than fractions
    fraction: list[float]


class Simulation(NamedTuple):
    """The compression test on a mesh for one Poisson's ratio, and its errors against the
    reference.
    """

    lambda_max: float
    cond: float
    cg_iterations: int
    strain_energy: float  # uJ
    errors: Errors
    seconds: float  # of the processor, for assembly and solve, without moduli and errors


class Measurement(NamedTuple):
    """All measures of a mesh, with cells of one order."""

    order: int  # 1: linear cells, 2: quadratic ones
    n_nodes: int  # in total, including mid-edge nodes of quadratic cells
    n_corners: int  # the mesh's own
    n_cells: int
    E_D: float
    E_D_fraction: float | None  # of the image's variance; None in an image without any
    n_missed_voxels: int
    n_empty_cells: int
    quality: Quality
    rho_histogram: Histogram
    dihedral_histogram: Histogram  # degrees
    labels: list[LabelFidelity]  # each cell has the label of most of its voxels
    own_labels: list[LabelFidelity]  # the same with the mesh's own labels of cells; empty without
    fem: dict[str, Simulation]  # by nu; empty if the mesh cannot be compressed
    not_compressed: str | None = None  # why


class PipelineRun(NamedTuple):
    """One execution of a pipeline that gave a mesh."""

    seconds: dict[str, float]  # by step
    seconds_total: float
    peak_bytes: int
    measurement: Measurement

    def as_json(self) -> Json:
        """Return the row of `report.json`, which has the measures among its own numbers."""
        *own, measured = self._asdict().items()
        return dict(own) | measured[1]._asdict()


class PipelineResult(NamedTuple):
    """All runs of a pipeline."""

    name: str
    title: str
    kind: str
    about: str
    failure: str | None  # the first, if a run failed
    notes: list[str]
    runs: list[PipelineRun]
    # the run of the median E_D, the lower of two; None if no run gave a mesh
    median: PipelineRun | None


class ImageFacts(NamedTuple):
    """The image that is meshed."""

    source: ImageSource
    shape: tuple[int, ...]
    spacing_mm: list[float]
    variance: float

    def as_json(self) -> Json:
        """Return the object of `report.json`, which has the source among its own facts."""
        source, *own = self._asdict().items()
        return source[1]._asdict() | dict(own)


class ReferenceEnergy(NamedTuple):
    """The reference's result for one Poisson's ratio."""

    strain_energy: float  # uJ
    own_error: OwnError  # of the solution at half the resolution against it
    iterations: int


class ReferenceGrid(NamedTuple):
    """The voxel grid whose solutions the errors are measured against."""

    shape: tuple[int, ...]
    n_dofs: int
    note: str
    by_nu: dict[str, ReferenceEnergy]

    def as_json(self) -> Json:
        """Return the object of `report.json`, which has the results by nu among its own facts."""
        *own, by_nu = self._asdict().items()
        return dict(own) | by_nu[1]


class Report(NamedTuple):
    """Content of `report.json`."""

    command: str
    image: ImageFacts
    labels: LabelSource | None
    mapping: str
    versions: dict[str, str]
    machine: dict[str, int | str | None]  # cores, load, processor and system
    date: str  # on which the comparison ended, UTC
    options: Settings
    reference: ReferenceGrid
    pipelines: list[PipelineResult]  # meshes of the requested number of nodes, with linear cells
    # the same pipelines' coarser meshes with quadratic cells, as many nodes in total
    quadratic: list[PipelineResult]
    seconds: float

    def meshes(self) -> list[tuple[str, PipelineResult]]:
        """Return the title and the result of each mesh, those of linear cells first."""
        of_order = {1: self.pipelines, 2: self.quadratic}
        return [
            (each.title + MESH_WORDS[order], each)
            for order, results in of_order.items()
            for each in results
        ]
