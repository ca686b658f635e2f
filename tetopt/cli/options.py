"""Options of the commands, as records of annotated fields, and how typer takes them.

A command is a function of records; `from_records` makes of it the function of single options that typer wants, each
record's options in a panel of the help. The help's words stand here alone.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache, wraps
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, cast, get_args, get_type_hints

import typer
from typer.models import OptionInfo

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
from tetopt.errors import InputError
from tetopt.io.files import checked_output, name_files
from tetopt.io.formats import FORMATS
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.model.materials import DEFAULT_NU
from tetopt.public import LARGEST_INTEGER
from tetopt.start.lattice import Kind

Lattice = Literal[Kind, "octree"]
Method = Literal["fast", "paper"]
DEFAULT_NODES = {2: 500, 3: 5000}  # by dimension; on small images a graded mesh has fewer


def option(metavar: str, text: str, *names: str, **more: Any) -> Any:
    """`typer.Option` in one line: what its value is called, and what the help says of it."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


IMAGE_FILES = "NIfTI, MGZ, NRRD, MetaImage, OME-Zarr, a DICOM folder, or a 2-D picture."
ImageArgument = Annotated[Path, typer.Argument(metavar="IMAGE", help=IMAGE_FILES)]
MeshArgument = Annotated[
    Path, typer.Argument(metavar="MESH", help="VTU, VTK or gmsh MSH file of tetrahedra or triangles.")
]
VolumeOption = Annotated[int | None, option("K", "Volume of a 4-D file, from 0.")]
CropOption = Annotated[str | None, option("A:B,C:D,E:F", "Keep these voxels, half open; an end may be empty.")]
JsonOption = Annotated[Path | None, option("FILE", "Write every number here.", "--json")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing outputs.")]
AVERAGE_OPTION = option(
    "WORD",
    "One modulus of those of a cell's voxels: mean (the paper's), geometric, harmonic, power:P, hill (between mean "
    f"and harmonic); or gauss (around each Gauss point of quadratic cells), nodes (linear between nodes); by default "
    f"{DEFAULT_AVERAGE}.",
)
AverageOption = Annotated[str, AVERAGE_OPTION]
LabelNamesOption = Annotated[
    Path | None,
    option(
        "TABLE",
        "Names and colours of labels: FreeSurfer, ITK-SNAP, 3D Slicer, BIDS' dseg.tsv, or CSV; the mesh's file keeps "
        "them.",
        "--label-names",
    ),
]
SpaceOption = Annotated[str, option("ras|lps", "Convention of the file's coordinates.")]


@dataclass(frozen=True, kw_only=True)
class BoxPart:
    """Which part of a volume file is read."""

    volume: VolumeOption = None
    crop: CropOption = None


@dataclass(frozen=True, kw_only=True)
class ImagePart(BoxPart):
    """Which part of an image file is read; a slice of it is an image in 2-D."""

    slice_: Annotated[str | None, option("AXIS=INDEX", "One slice, in 2-D; for example k=90.", "--slice")] = None

    def stated(self) -> dict[str, int | str | None]:
        """The part as files of numbers state it."""
        return {"volume": self.volume, "crop": self.crop, "slice": self.slice_}


@dataclass(frozen=True, kw_only=True)
class LabelledPart(ImagePart):
    """Which part of an image file is read, and what gives labels to a mesh that was made without."""

    labels: Annotated[
        Path | None, option("LABELS", "Label image: a cell gets the label of most of its voxels, for laws and sets.")
    ] = None


WHOLE_BOX, WHOLE_IMAGE = BoxPart(), ImagePart()


@dataclass(frozen=True, kw_only=True)
class NumberOptions:
    """The file of all numbers beside what a command prints."""

    json_path: JsonOption = None
    force: ForceOption = False

    def checked(self) -> Path | None:
        """The file, if there is to be one; InputError if it may not be written."""
        return None if self.json_path is None else checked_output(self.json_path, (".json",), self.force)


@dataclass(frozen=True, kw_only=True)
class SurfacePart:
    """Which surface `tetopt surface` writes, and how its points are."""

    below: Annotated[float | None, option("T", "Of the largest connected set of cells with a mean below T.")] = None
    label: Annotated[str | None, option("L", "Of all cells with this label, by number or name.")] = None
    cell_set: Annotated[str | None, option("NAME", "Of a named set of cells.", "--set")] = None
    boundary: Annotated[
        bool, typer.Option("--boundary", help="Of the whole mesh; with --interfaces, the boundary as well as these.")
    ] = False
    interface: Annotated[str | None, option("J,K", "What lies between two labels, out of J; it may be open.")] = None
    interfaces: Annotated[
        bool,
        typer.Option(
            "--interfaces",
            help="All interfaces of labels as one surface, each triangle with the labels on its two sides.",
        ),
    ] = False
    space: SpaceOption = "ras"
    label_names: LabelNamesOption = None


@dataclass(frozen=True, kw_only=True)
class ShownOptions:
    """How `tetopt view` shows a mesh, and where."""

    html: Annotated[Path | None, option("OUT.html", "Write one page for a browser, open no window.", "--html")] = None
    screenshot: Annotated[Path | None, option("OUT.png", "Write a picture of it, open no window.")] = None
    field: Annotated[
        str | None, option("NAME", "Colour by this at first: mean, label, von_mises, ... (default: the first).")
    ] = None
    limits: Annotated[
        str | None,
        option("LOW,HIGH", "What its colours go from and to (default: all but 1 % at either end).", "--range"),
    ] = None
    label_names: LabelNamesOption = None


@dataclass(frozen=True, kw_only=True)
class ContentOptions:
    """What of an image is meshed, and what lies beside it."""

    panel: ClassVar[str] = "What is meshed"
    mask: Annotated[
        Path | None, option("MASK", "Mesh this region only (0/1, or 0 to 1), its boundary on the mask's surface.")
    ] = None
    background: Annotated[
        str | None, option("VALUE|auto", "Leave out what is up to VALUE and reaches the box: the air.")
    ] = None
    keep_components: Annotated[
        bool, typer.Option("--keep-components", help="Keep small components of the mesh that the mask does not have.")
    ] = False
    labels: Annotated[Path | None, option("LABELS", "Label image: each cell is to be of one label.")] = None
    weights: Annotated[str | None, option("W,...", "How much each IMAGE counts (default 1 each; 0: not at all).")] = (
        None
    )
    smooth_interfaces: Annotated[
        float | None,
        option("W", "Tension of surfaces between labels, voxels, to 10 (default 0.3; 0 leaves voxels their stairs)."),
    ] = None
    label_weight: Annotated[
        float | None, option("W", "How much the labels count beside the first IMAGE (default 1).")
    ] = None
    part: ImagePart = WHOLE_IMAGE


@dataclass(frozen=True, kw_only=True)
class SourceOptions(ContentOptions):
    """What `tetopt mesh` meshes."""

    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="IMAGE...", help=f"{IMAGE_FILES} Further ones are contrasts, taken to the first one's grid."
        ),
    ]


@dataclass(frozen=True, kw_only=True)
class SizeOptions:
    """How many nodes there are, and how large cells may be."""

    panel: ClassVar[str] = "Number and size of cells"
    nodes: Annotated[
        int | None,
        option(
            "N",
            "Wanted number of nodes, with --order 2 mid-edge ones too "
            f"(default as sizes take, or {DEFAULT_NODES[3]}; {DEFAULT_NODES[2]} in 2-D).",
        ),
    ] = None
    target_error: Annotated[
        float | None, option("T", "As many nodes as leave this share of the image's variance in cells, instead.")
    ] = None
    size_min: Annotated[float | None, option("MM", "No edge is split into shorter ones.")] = None
    size_max: Annotated[
        float | None, option("MM", "Usual edge of cells, at most: longer ones are split as far as nodes go.")
    ] = None
    edge_max: Annotated[
        float | None, option("MM", "No longer edge is made (default 1.4 x a uniform mesh's; with --size-max none).")
    ] = None
    gradation: Annotated[
        float | None, option("G", "How gently sizes change: each is 1/G blocks wide, 0.05 to 1 (default).")
    ] = None
    sizing: Annotated[Path | None, option("SIZES.nii.gz", "Usual edge by place, mm; 0 or less: as elsewhere.")] = None


@dataclass(frozen=True, kw_only=True)
class StartOptions:
    """The mesh that a run begins with."""

    panel: ClassVar[str] = "The mesh it begins with"
    lattice: Annotated[
        Lattice | None,
        option(
            "KIND",
            "Initial mesh: octree (the default), with nodes where the image has detail; or uniform: bcc, five-tet, or "
            "in 2-D criss-cross.",
        ),
    ] = None
    uniform: Annotated[
        bool, typer.Option("--uniform", help="The paper's setting: a uniform lattice, bcc (criss-cross in 2-D).")
    ] = False
    spacing: Annotated[float | None, option("MM", "A uniform lattice of this spacing.")] = None
    start: Annotated[
        Path | None, option("MESH", "Improve this mesh, its boundary kept, instead of making a new one.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """How the mesh is optimised."""

    panel: ClassVar[str] = "Optimisation"
    k_D: Annotated[
        float | None,
        option(
            "K",
            "Weight of the image: 0 shape only; 0.9 image first "
            f"(default {GRADED_K_D:g}; --uniform {UNIFORM_K_D:g}; --start {START_K_D:g}).",
            "--k-d",
        ),
    ] = None
    iterations: Annotated[
        int | None,
        option(
            "I",
            "Sweeps over all nodes; 0 writes the initial mesh "
            f"(default {GRADED_ITERATIONS}; {UNIFORM_ITERATIONS} if uniform).",
            min=0,
        ),
    ] = None
    boundary: Annotated[
        Boundary | None, typer.Option(help="What the boundary's nodes may do (default slide; with --start fixed).")
    ] = None
    method: Annotated[
        Method, typer.Option(help="fast: gradients, flips, a floor on angles; paper: the scheme of the paper.")
    ] = "fast"
    shape_power: Annotated[
        float | None,
        option("P", f"Fast method: 1 is the paper's E_G; up to 10 punish flat cells more (default {SHAPE_POWER:g})."),
    ] = None
    min_dihedral: Annotated[
        float | None,
        option("DEG", f"Fast method, 3-D: smallest dihedral angle allowed, 0 (none) to 70 (default {MIN_DIHEDRAL:g})."),
    ] = None
    n_t: Annotated[
        int | None,
        option(
            "T",
            "Paper's method: connect anew in the first T iterations (default half; all for k_D = 0).",
            "--n-t",
            min=0,
        ),
    ] = None
    retessellate: Annotated[
        Retessellate | None,
        typer.Option(
            help="Paper's method: Delaunay anew in the first n_t iterations (the default), whenever it lowers E, never."
        ),
    ] = None
    threads: Annotated[int | None, option("N", "Threads; the result is the same for any number.")] = None
    max_seconds: Annotated[float | None, option("S", "Stop after S seconds with the mesh reached.")] = None
    max_gb: Annotated[float | None, option("GB", "Stop with the mesh reached before more than GB GB are taken.")] = None


WorkersOption = Annotated[
    int | None, option("N", "Tasks at a time, at most; of a --cluster its jobs.", "--workers", min=1)
]
SchedulerOption = Annotated[
    str | None, option("ADDRESS", "A scheduler of dask's that runs, with its workers: tcp://host:8786.")
]
ClusterOption = Annotated[
    Path | None, option("FILE.yaml", "A batch system (SLURM, PBS, LSF, SGE, ...), as dask-jobqueue is configured.")
]


@dataclass(frozen=True, kw_only=True)
class PartsOptions:
    """How a mesh is made in parts, and by whom."""

    panel: ClassVar[str] = "Beyond one memory"
    parts: Annotated[
        int | None,
        option("K", "In K parts or more, each on its own voxels (default 1, or as many as memory asks for).", min=1),
    ] = None
    count: WorkersOption = None
    worker_gb: Annotated[float | None, option("GB", "Memory of each worker on this machine, enforced.")] = None
    scheduler: SchedulerOption = None
    cluster: ClusterOption = None


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """What a solver is told besides the mesh."""

    panel: ClassVar[str] = "For the solver"
    young: Annotated[
        str | None,
        option(
            "LAW",
            'Young\'s modulus, kPa: a number, a formula of the intensity, "0.5 + 0.01*h", a table "0:1,100:5", '
            'by label "1=2.1,liver=1.9,*=5", or a file .toml or .csv of such columns.',
        ),
    ] = None
    nu: Annotated[str | None, option("LAW", f"Poisson's ratio, likewise (default {DEFAULT_NU:g}).")] = None
    density: Annotated[str | None, option("LAW", "Density, kg/m3, likewise (water's is 1000); gravity needs it.")] = (
        None
    )
    average: Annotated[str | None, AVERAGE_OPTION] = None
    bins: Annotated[
        str | None, option("K[:quantile|:log]", "Group cells into K materials, of equal width, by number, or log.")
    ] = None
    sets: Annotated[
        list[str] | None,
        option(
            "NAME=...",
            "A set more: NAME=below:T, NAME=point:X,Y,Z:D, NAME=plane:X,Y,Z:NX,NY,NZ:D (mm, RAS+). May be repeated.",
            "--set",
        ),
    ] = None
    written_sets: Annotated[
        str | None,
        option(
            "GROUP,...",
            "Which sets of every mesh the file gets: labels, interfaces, boundary; or all, or none.",
            "--sets",
        ),
    ] = None
    loads: Annotated[
        list[str] | None,
        option(
            "...",
            "compress:5%, hold:SET, move:SET:X,Y,Z (mm, or free), pressure:SET:P (kPa, inwards), traction:SET:X,Y,Z "
            "(kPa), spring:SET:K (kPa/mm), gravity:X,Y,Z (mm/s2; the earth's is 9810); 2/... is in step 2 alone. "
            "May be repeated.",
            "--load",
        ),
    ] = None
    label_names: LabelNamesOption = None
    order: Annotated[
        int | None, option("1|2", "2: quadratic cells, straight-edged; 1: linear. By default as the mesh read, else 1.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class SolverOptions(ModelOptions):
    """What the file tells a solver besides the mesh."""

    nonlinear: Annotated[
        bool, typer.Option("--nonlinear", help="The step is of large deformation (.inp; FEBio's always is).")
    ] = False
    units: Annotated[str, option("kPa|MPa", "Unit of stress in the file; --young is in kPa.")] = "kPa"
    space: SpaceOption = "ras"

    def are_any(self) -> bool:
        """Whether the file is to hold more than the mesh and what labels are called."""
        return replace(self, label_names=None) != SolverOptions()


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """What `tetopt mesh` writes."""

    mesh: Annotated[Path, option("MESH", f"The mesh to write: {', '.join(FORMATS)}.", "-o", "--output")]
    json_path: JsonOption = None
    figures: Annotated[
        Path | None, option("DIR", "Draw slice.png, rho.png, energies.png and others in this folder, made if need be.")
    ] = None
    predict: Annotated[
        bool, typer.Option("--predict", help="Tell how long the run takes and how much memory, and write nothing.")
    ] = False
    force: ForceOption = False


def option_name(name: str, kind: Any) -> str:
    """What a record's field is called on the command line, without hyphens before it, e.g. "k-d"."""
    own = get_args(kind)[1].default  # in an annotation typer takes the first name for a default
    return (own if isinstance(own, str) else name.replace("_", "-")).lstrip("-")


def given_options(*records: Any) -> dict[str, Any]:
    """What the records give that is not the default, by the names of the command line; of arguments, by the field's.

    Records of the same fields and values have equal dictionaries.
    """
    options: dict[str, Any] = {}
    for record in records:
        kinds = _kinds(record.__class__)
        for field in fields(record):
            value = getattr(record, field.name)
            if is_dataclass(value):
                options |= given_options(value)
            elif value != field.default:
                options[option_name(field.name, kinds[field.name])] = value
    return options


def option_words(options: dict[str, Any]) -> list[str]:
    """Options as `given_options` returns them, without arguments, as the words of a command."""
    words = []
    for name, value in options.items():
        if value is True:
            words.append(f"--{name}")
        else:
            words += [f"--{name}={each}" for each in (value if isinstance(value, list) else [value])]
    return words


SubjectsArgument = Annotated[
    Path,
    typer.Argument(metavar="SUBJECTS", help="A table, .tsv or .csv: subject, image, ...; or a BIDS folder."),
]


@dataclass(frozen=True, kw_only=True)
class CohortOptions:
    """What of a cohort is run, where, and by whom."""

    panel: ClassVar[str] = "The cohort"
    output: Annotated[
        Path, option("OUT", "The folder of all outputs; that of an earlier run goes on.", "-o", "--output")
    ]
    suffix: Annotated[
        str, option("WORD", 'Of a BIDS folder: the images\' suffix, with entities before it "acq-mprage_T1w".')
    ] = "T1w"
    participants: Annotated[
        list[str] | None, option("LABEL", "Of the subjects only this one. May be repeated.", "--participant-label")
    ] = None
    sessions: Annotated[
        list[str] | None, option("LABEL", "Of the sessions only this one. May be repeated.", "--session-label")
    ] = None
    mesh_format: Annotated[str, option("SUFFIX", f"Of the meshes' files: {', '.join(FORMATS)}.", "--format")] = ".vtu"
    write_table: Annotated[
        Path | None, option("TABLE", "Write what would be run as a table, .tsv or .csv, and run nothing.")
    ] = None
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Tell what would be run, why, and what it takes; run nothing.")
    ] = False
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Run only those that failed; what has changed stays as it is.")
    ] = False
    collect: Annotated[
        bool, typer.Option("--collect", help="Write the table and the page of what is there; run nothing.")
    ] = False
    count: Annotated[
        int | None, option("N", "So many subjects at a time, or jobs of a --cluster, at most.", "--workers", min=1)
    ] = None
    scheduler: SchedulerOption = None
    cluster: ClusterOption = None


class Records(NamedTuple):
    """All options of `tetopt mesh` but its images and outputs."""

    content: ContentOptions
    sizes: SizeOptions
    start: StartOptions
    engine: EngineOptions
    solver: SolverOptions

    def given(self) -> dict[str, Any]:
        """As `given_options`."""
        return given_options(*self)


@cache  # as is what else takes as long, since each of 20,000 subjects may have options of its own
def record_names() -> dict[str, bool]:
    """The options of `Records` by their names on the command line, and whether each is a switch, without a value."""
    kinds = [each for kind in get_type_hints(Records).values() for each in _leaves(kind)]
    return {option_name(name, kind): get_args(kind)[0] is bool for name, kind in kinds}


def _leaves(kind: Any) -> Iterator[tuple[str, Any]]:
    """The fields of a record and of those in it, with their annotations."""
    kinds = _kinds(kind)
    for field in fields(kind):
        if is_dataclass(kinds[field.name]):
            yield from _leaves(kinds[field.name])
        else:
            yield field.name, kinds[field.name]


def with_options(records: Records, texts: dict[str, str]) -> Records:
    """The records with other values of options, as texts by their names on the command line.

    A switch is on by "1", "true" or "yes" and off by "0", "false" or "no"; several values of an option that may be
    repeated stand between semicolons.

    Raises
    ------
    InputError
        An option that there is not, or a value that is none of it.
    """
    names = record_names()
    words = []
    for name, text in texts.items():
        if name not in names:
            near = get_close_matches(name, names, 1)
            raise InputError(f"{name}: is no option of tetopt mesh" + (f"; is {near[0]} meant?" if near else ""))
        if not names[name]:
            several = name in ("set", "load")
            parts = [part.strip() for part in text.split(";") if part.strip()] if several else [text]
            words += [f"--{name}={part}" for part in parts]
        elif text.lower() in ("1", "true", "yes"):
            words.append(f"--{name}")
        elif text.lower() not in ("0", "false", "no"):
            raise InputError(f'{name}: expected true or false, got "{text}"')
    try:
        parsed = _parsed(tuple(words))
    except InputError:
        raise InputError("; ".join(_wrong_values(texts))) from None
    return Records(*(_replaced(old, new, set(texts)) for old, new in zip(records, parsed, strict=True)))


def _wrong_values(texts: dict[str, str]) -> Iterator[str]:
    """Which of the options' texts are no values of theirs, in words."""
    for name, text in ((name, text) for name, text in texts.items() if not record_names()[name]):
        try:
            _parsed((f"--{name}={text}",))
        except InputError:
            point = text.replace(",", ".")
            is_comma = point != text and re.fullmatch(r"-?[0-9]*\.[0-9]+", point)
            yield f'{name}: "{text}" is no value of it' + (f"; write {point}" if is_comma else "")


def _replaced(old: Any, new: Any, names: set[str]) -> Any:
    """A record with the fields of another that have these names on the command line."""
    kinds = _kinds(old.__class__)
    changes = {}
    for field in fields(old):
        value, other = getattr(old, field.name), getattr(new, field.name)
        if is_dataclass(value):
            changes[field.name] = _replaced(value, other, names)
        elif option_name(field.name, kinds[field.name]) in names:
            changes[field.name] = other
    return replace(old, **changes)


def _parsed(words: tuple[str, ...]) -> Records:
    """The records that words of a command line come to."""
    parsed: list[Records] = []
    try:
        _parser()(list(words), standalone_mode=False, obj=parsed)
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        raise InputError(str(error.format_message())) from error
    return parsed[0]


@cache
def _kinds(kind: type) -> dict[str, Any]:
    """The fields of a record with their annotations."""
    return get_type_hints(kind, include_extras=True)


@cache
def _parser() -> Any:
    """A command that puts the records that its words come to into its context's list."""

    def command(
        context: typer.Context, content: ContentOptions, sizes: SizeOptions, start: StartOptions,
        engine: EngineOptions, solver: SolverOptions,
    ) -> int:  # fmt: skip
        context.obj.append(Records(content, sizes, start, engine, solver))
        return 0

    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(from_records(command))
    return typer.main.get_command(app)


def from_records(command: Callable[..., int]) -> Callable[..., int]:
    """The command as a function of single options, for typer: the fields of its records in the records' places.

    A record is a dataclass; the records in it count as part of it. Its `panel`, if it has one, is the title of its
    options in the help.
    """
    kinds = get_type_hints(command, include_extras=True)
    defaults = {name: each.default for name, each in inspect.signature(command).parameters.items()}

    @wraps(command)
    def called(**values: Any) -> int:
        name_files(values.values())
        for name, value in values.items():
            if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
                raise InputError(f"{name.replace('_', '-')}: expected a number that 64 bits hold, got a longer one")
        return command(**{name: _of_values(kinds[name], name, values) for name in defaults})

    parameters = [each for name, default in defaults.items() for each in _parameters(name, kinds[name], default)]
    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return called


def _parameters(name: str, kind: Any, default: Any, panel: str | None = None) -> Iterator[inspect.Parameter]:
    """The parameters that stand for one of a command, or for a field of a record."""
    if not is_dataclass(kind):
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=_in(panel, kind))
        return
    kinds, panel = get_type_hints(kind, include_extras=True), getattr(kind, "panel", panel)
    for field in fields(kind):
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        yield from _parameters(field.name, kinds[field.name], default, panel)


def _in(panel: str | None, kind: Any) -> Any:
    """The annotation with its option in a panel of the help; arguments have one of their own."""
    extras = get_args(kind)[1:]
    if panel is None or not isinstance(extras[0], OptionInfo):
        return kind
    moved = copy(extras[0])
    moved.rich_help_panel = panel
    return Annotated[get_args(kind)[0], moved]


def _of_values(kind: Any, name: str, values: dict[str, Any]) -> Any:
    """A parameter's value: one of `values`, or the record that is made of them."""
    if not is_dataclass(kind):
        return values[name]
    kinds = get_type_hints(kind)
    return cast(Callable[..., Any], kind)(
        **{field.name: _of_values(kinds[field.name], field.name, values) for field in fields(kind)}
    )
