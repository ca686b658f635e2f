"""What can be asked of a run: each option once, with its type, its unit, its default, and a line of help.

Records are options that belong together; commands that take some of them alone share these. Of all of them a `Job` is
made. What a message, or a help, says of an option has its name between backticks, which the command line turns into
what it calls it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args, get_type_hints

from tetopt.engine.loop import (
    GRADED_ITERATIONS,
    GRADED_K_D,
    MIN_DIHEDRAL,
    SHAPE_POWER,
    START_K_D,
    UNIFORM_ITERATIONS,
    UNIFORM_K_D,
    Boundary,
)
from tetopt.engine.paper import Retessellate
from tetopt.errors import FORMER_NAMES
from tetopt.io.formats import FORMATS
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.model.materials import DEFAULT_NU
from tetopt.start.lattice import Kind

Lattice = Literal[Kind, "octree"]
Method = Literal["fast", "paper"]
DEFAULT_NODES = {2: 500, 3: 5000}  # by dimension; on small images a graded mesh has fewer


class Option(NamedTuple):
    """What is said of an option beside its type and its default."""

    metavar: str | None  # what its value is called; None of a switch, and where choices speak for themselves
    text: str  # its help
    name: str = ""  # on the command line, if that is not its own with hyphens
    least: int | None = None
    letter: str = ""  # its short name there
    is_argument: bool = False


IMAGE_FILES = "NIfTI, MGZ, NRRD, MetaImage, OME-Zarr, a DICOM folder, or a 2-D picture."
JsonOption = Annotated[Path | None, Option("FILE", "Write every number here.", "json")]
ForceOption = Annotated[bool, Option(None, "Replace existing outputs.")]
AVERAGE_OPTION = Option(
    "WORD",
    "One modulus of those of a cell's voxels: mean (the paper's), geometric, harmonic, power:P, hill (between mean "
    f"and harmonic); or gauss (around each Gauss point of quadratic cells), nodes (linear between nodes); by default "
    f"{DEFAULT_AVERAGE}.",
)
LabelNamesOption = Annotated[
    Path | None,
    Option(
        "TABLE",
        "Names and colours of labels: FreeSurfer, ITK-SNAP, 3D Slicer, BIDS' dseg.tsv, or CSV; the mesh's file keeps "
        "them.",
    ),
]
SpaceOption = Annotated[str, Option("ras|lps", "Convention of the file's coordinates.")]


@dataclass(frozen=True, kw_only=True)
class BoxPart:
    """Which part of a volume file is read."""

    volume: Annotated[int | None, Option("K", "Volume of a 4-D file, from 0.")] = None
    crop: Annotated[str | None, Option("A:B,C:D,E:F", "Keep these voxels, half open; an end may be empty.")] = None


@dataclass(frozen=True, kw_only=True)
class ImagePart(BoxPart):
    """Which part of an image file is read; a slice of it is an image in 2-D."""

    slice_: Annotated[str | None, Option("AXIS=INDEX", "One slice, in 2-D; for example k=90.", "slice")] = None


@dataclass(frozen=True, kw_only=True)
class LabelledPart(ImagePart):
    """Which part of an image file is read, and what gives labels to a mesh that was made without."""

    labels: Annotated[
        Path | None,
        Option("LABELS", "Label image: a cell gets the label of most of its voxels, for modulus mappings and sets."),
    ] = None


WHOLE_BOX, WHOLE_IMAGE = BoxPart(), ImagePart()


@dataclass(frozen=True, kw_only=True)
class RegionOptions:
    """Which region is meshed, and what counts there."""

    mask: Annotated[
        Path | None, Option("MASK", "Mesh this region only (0/1, or 0 to 1), its boundary on the mask's surface.")
    ] = None
    background: Annotated[
        str | None, Option("VALUE|auto", "Leave out what is up to VALUE and reaches the box: the air.")
    ] = None
    keep_components: Annotated[bool, Option(None, "Keep small components of the mesh that the mask does not have.")] = (
        False
    )
    labels: Annotated[Path | None, Option("LABELS", "Label image: each cell is to be of one label.")] = None
    tissues: Annotated[
        Path | None,
        Option("FILE,...", "Tissue probabilities instead of labels: a file each, or one in 4-D; 0 is what they leave."),
    ] = None
    merge: Annotated[
        str | None,
        Option(
            "GROUPS",
            'Merge labels: "white=2,41; grey=3,42; soft=500-530; other=*", aseg, synthseg or simnibs, or a file of '
            "these, .toml or .csv.",
        ),
    ] = None
    weights: Annotated[str | None, Option("W,...", "How much each IMAGE counts (default 1 each; 0: not at all).")] = (
        None
    )
    smooth_interfaces: Annotated[
        float | None,
        Option("W", "Tension of surfaces between labels, voxels, to 10 (default 0.3; 0 leaves voxels their stairs)."),
    ] = None
    free_volumes: Annotated[
        bool, Option(None, "Labels thinner than cells may lose volume; by default cells are theirs for as much.")
    ] = False
    label_weight: Annotated[
        float | None, Option("W", "How much the labels count beside the first IMAGE (default 1).")
    ] = None


@dataclass(frozen=True, kw_only=True)
class ContentOptions(ImagePart, RegionOptions):
    """What of an image is meshed, and what lies beside it."""

    panel: ClassVar[str] = "What is meshed"


@dataclass(frozen=True, kw_only=True)
class SourceOptions(ContentOptions):
    """What `tetopt mesh` meshes."""

    images: Annotated[
        list[Path],
        Option(
            "IMAGE...", f"{IMAGE_FILES} Further ones are contrasts, taken to the first one's grid.", is_argument=True
        ),
    ]


@dataclass(frozen=True, kw_only=True)
class SizeOptions:
    """How many nodes there are, and how large cells may be."""

    panel: ClassVar[str] = "Number and size of cells"
    nodes: Annotated[
        int | None,
        Option(
            "N",
            "Wanted number of nodes, with `order` 2 mid-edge ones too "
            f"(default as sizes take, or {DEFAULT_NODES[3]}; {DEFAULT_NODES[2]} in 2-D).",
        ),
    ] = None
    target_error: Annotated[
        float | None, Option("T", "As many nodes as leave this fraction of the image's variance in cells, instead.")
    ] = None
    size_min: Annotated[float | None, Option("MM", "No edge is split into shorter ones.")] = None
    edge_size: Annotated[
        float | None, Option("MM", "Target for the usual edge: longer ones are split as far as nodes go.")
    ] = None
    edge_max: Annotated[
        float | None, Option("MM", "No longer edge is made (default 1.4 x a uniform mesh's; with `edge_size` none).")
    ] = None
    gradation: Annotated[
        float | None, Option("G", "How gently sizes change: each is 1/G blocks wide, 0.05 to 1 (default).")
    ] = None
    cells_across: Annotated[
        float | None, Option("N", "Cells across each label where it is thin: edges of its local thickness / N.")
    ] = None
    label_size: Annotated[
        str | None,
        Option(
            "LABEL=SIZE,...",
            'Usual edge by label or name, mm, or a part of the local thickness t: "fluid=1.5,bone=0.6t[1:10],*=6"; or '
            "a file .toml or .csv of these.",
        ),
    ] = None
    sizing: Annotated[Path | None, Option("SIZES.nii.gz", "Usual edge by place, mm; 0 or less: as elsewhere.")] = None


@dataclass(frozen=True, kw_only=True)
class StartOptions:
    """The mesh that a run begins with."""

    panel: ClassVar[str] = "The mesh it begins with"
    lattice: Annotated[
        Lattice | None,
        Option(
            "KIND",
            "Initial mesh: octree (the default), with nodes where the image has detail; or uniform: bcc, five-tet, or "
            "in 2-D criss-cross.",
        ),
    ] = None
    uniform: Annotated[bool, Option(None, "The paper's setting: a uniform lattice, bcc (criss-cross in 2-D).")] = False
    spacing: Annotated[float | None, Option("MM", "A uniform lattice of this spacing.")] = None
    start: Annotated[
        Path | None, Option("MESH", "Improve this mesh, its boundary kept, instead of making a new one.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """How the mesh is optimised."""

    panel: ClassVar[str] = "Optimisation"
    k_D: Annotated[
        float | None,
        Option(
            "K",
            "Weight of the image: 0 shape only; 0.9 image first "
            f"(default {GRADED_K_D:g}; `uniform` {UNIFORM_K_D:g}; `start` {START_K_D:g}).",
        ),
    ] = None
    iterations: Annotated[
        int | None,
        Option(
            "I",
            "Sweeps over all nodes; 0 writes the initial mesh "
            f"(default {GRADED_ITERATIONS}; {UNIFORM_ITERATIONS} if uniform).",
            least=0,
        ),
    ] = None
    boundary: Annotated[
        Boundary | None, Option(None, "What the boundary's nodes may do (default slide; with `start` fixed).")
    ] = None
    method: Annotated[
        Method, Option(None, "fast: gradients, flips, a minimum dihedral angle; paper: the scheme of the paper.")
    ] = "fast"
    shape_power: Annotated[
        float | None,
        Option("P", f"Fast method: 1 is the paper's E_G; up to 10 punish flat cells more (default {SHAPE_POWER:g})."),
    ] = None
    min_dihedral: Annotated[
        float | None,
        Option("DEG", f"Fast method, 3-D: smallest dihedral angle allowed, 0 (none) to 70 (default {MIN_DIHEDRAL:g})."),
    ] = None
    n_t: Annotated[
        int | None,
        Option(
            "T",
            "Paper's method: connect anew in the first T iterations (default half; all for k_D = 0).",
            "n-t",
            least=0,
        ),
    ] = None
    retessellate: Annotated[
        Retessellate | None,
        Option(
            None,
            "Paper's method: Delaunay anew in the first n_t iterations (the default), whenever it lowers E, never.",
        ),
    ] = None
    threads: Annotated[int | None, Option("N", "Threads; the result is the same for any number.")] = None
    max_seconds: Annotated[float | None, Option("S", "Stop after S seconds with the mesh reached.")] = None
    max_gb: Annotated[float | None, Option("GB", "Stop with the mesh reached before more than GB GB are taken.")] = None


WorkersOption = Annotated[int | None, Option("N", "Tasks at a time, at most; of a `cluster` its jobs.", least=1)]
SchedulerOption = Annotated[
    str | None, Option("ADDRESS", "A scheduler of dask's that runs, with its workers: tcp://host:8786.")
]
ClusterOption = Annotated[
    Path | None, Option("FILE.yaml", "A batch system (SLURM, PBS, LSF, SGE, ...), as dask-jobqueue is configured.")
]


@dataclass(frozen=True, kw_only=True)
class PartsOptions:
    """How a mesh is made in parts, and by whom."""

    panel: ClassVar[str] = "Beyond one memory"
    parts: Annotated[
        int | None,
        Option("K", "In K parts or more, each on its own voxels (default 1, or as many as memory asks for).", least=1),
    ] = None
    workers: WorkersOption = None
    worker_gb: Annotated[float | None, Option("GB", "Memory of each worker on this machine, enforced.")] = None
    scheduler: SchedulerOption = None
    cluster: ClusterOption = None


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """What a solver is told besides the mesh."""

    panel: ClassVar[str] = "For the solver"
    young: Annotated[
        str | None,
        Option(
            "MAPPING",
            'Young\'s modulus, kPa: a number, a formula of the intensity, "0.5 + 0.01*h", a table "0:1,100:5", '
            'by label "1=2.1,liver=1.9,*=5", or a file .toml or .csv of such columns.',
        ),
    ] = None
    nu: Annotated[str | None, Option("MAPPING", f"Poisson's ratio, likewise (default {DEFAULT_NU:g}).")] = None
    density: Annotated[
        str | None, Option("MAPPING", "Density, kg/m3, likewise (water's is 1000); gravity needs it.")
    ] = None
    average: Annotated[str | None, AVERAGE_OPTION] = None
    bins: Annotated[
        str | None, Option("K[:quantile|:log]", "Group cells into K materials, of equal width, by number, or log.")
    ] = None
    sets: Annotated[
        list[str] | None,
        Option(
            "NAME=...",
            "A set more: NAME=below:T, NAME=point:X,Y,Z:D, NAME=plane:X,Y,Z:NX,NY,NZ:D (mm, RAS+). May be repeated.",
            "set",
        ),
    ] = None
    written_sets: Annotated[
        str | None,
        Option(
            "GROUP,...",
            "Which sets of every mesh the file gets: labels, interfaces, boundary; or all, or none.",
            "sets",
        ),
    ] = None
    loads: Annotated[
        list[str] | None,
        Option(
            "...",
            "compress:5%, hold:SET, move:SET:X,Y,Z (mm, or free), pressure:SET:P (kPa, inwards), traction:SET:X,Y,Z "
            "(kPa), spring:SET:K (kPa/mm), gravity:X,Y,Z (mm/s2; the earth's is 9810); 2/... is in step 2 alone. "
            "May be repeated.",
            "load",
        ),
    ] = None
    label_names: LabelNamesOption = None
    order: Annotated[
        int | None,
        Option(
            "1|2",
            "2: quadratic cells, whose edges a run with labels or a mask curves along their surfaces; 1: linear. By "
            "default as the mesh read, else 1.",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class SolverOptions(ModelOptions):
    """What the file tells a solver besides the mesh."""

    nonlinear: Annotated[bool, Option(None, "The step is of large deformation (.inp; FEBio's always is).")] = False
    units: Annotated[str, Option("kPa|MPa", "Unit of stress in the file; `young` is in kPa.")] = "kPa"
    space: SpaceOption = "ras"


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """What a run writes."""

    panel: ClassVar[str] = ""  # beside those of the command
    output: Annotated[Path, Option("MESH", f"The mesh to write: {', '.join(FORMATS)}.", letter="o")]
    json_path: JsonOption = None
    figures: Annotated[
        Path | None, Option("DIR", "Draw slice.png, rho.png, energies.png and others in this folder, made if need be.")
    ] = None
    force: ForceOption = False


@dataclass(frozen=True, kw_only=True)
class RunOptions(SolverOptions, EngineOptions, StartOptions, SizeOptions, ContentOptions):
    """What can be asked of the runs of many subjects: all but images, outputs, and who works."""


@dataclass(frozen=True, kw_only=True)
class JobOptions(OutputOptions, SolverOptions, PartsOptions, EngineOptions, StartOptions, SizeOptions, SourceOptions):
    """Every option of a run; that they go together is for `tetopt.job.plan` to say."""


def stated_part(part: ImagePart) -> dict[str, int | str | None]:
    """The part of an image as files of numbers state it."""
    return {"volume": part.volume, "crop": part.crop, "slice": part.slice_}


def has_model(options: SolverOptions) -> bool:
    """Whether a file is to hold more than the mesh and what labels are called."""
    own = {each.name: getattr(options, each.name) for each in fields(SolverOptions) if each.name != "label_names"}
    return SolverOptions(**own) != SolverOptions()


def near_hint(name: str, names: Iterable[str]) -> str:
    """Words for the end of a message, if one of the names is near to the one that there is not."""
    plain = {each.strip("-").replace("-", "_"): each for each in names}
    former = plain.get(FORMER_NAMES.get(name.strip("-").replace("-", "_"), ""))
    near = [former] if former is not None else get_close_matches(name, plain.values(), 1)
    return f"; is {near[0]} meant?" if near else ""


def kinds_of(record: Any) -> dict[str, Any]:
    """The fields of a kind of record with their annotations."""
    return _known_kinds(record)


@cache
def _known_kinds(record: Any) -> dict[str, Any]:
    kinds = get_type_hints(record, include_extras=True)
    return {field.name: kinds[field.name] for field in fields(record)}


def has_option(kind: Any) -> bool:
    """Whether an annotation says anything of an option."""
    return any(isinstance(each, Option) for each in get_args(kind)[1:])


def option_of(kind: Any) -> Option:
    """What an annotation says of its option."""
    return next(each for each in get_args(kind)[1:] if isinstance(each, Option))


def option_name(name: str, kind: Any) -> str:
    """What a record's field is called on the command line, without hyphens before it, e.g. "k-d"."""
    return option_of(kind).name or name.replace("_", "-").lower()


def given_options(record: Any) -> dict[str, Any]:
    """What a record gives that is not the default, by the names of the command line; of arguments, by the field's.

    Records of the same fields and values have equal dictionaries.
    """
    kinds = kinds_of(type(record))
    values = ((field, getattr(record, field.name)) for field in fields(record))
    return {option_name(field.name, kinds[field.name]): value for field, value in values if value != field.default}
