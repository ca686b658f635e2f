"""Options of a run: each once, with its type, its unit, its default, and a line of help.

Records group options that belong together, and commands share them; a `Job` has all of them.
Messages and help texts put an option's name between backticks, which the command line replaces by
its own name.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args, get_type_hints

from tetopt.engine.loop import (
    DEFAULT_NODES,
    GRADED_ITERATIONS,
    GRADED_K_D,
    MIN_DIHEDRAL,
    SHAPE_POWER,
    START_K_D,
    TARGET_NODES_MAX,
    UNIFORM_ITERATIONS,
    UNIFORM_K_D,
    Boundary,
)
from tetopt.engine.paper import Retessellate
from tetopt.io.formats import FORMATS
from tetopt.model.averages import DEFAULT_AVERAGE
from tetopt.model.materials import DEFAULT_NU
from tetopt.start.lattice import Kind
from tetopt.system.arrays import Json

Lattice = Literal[Kind, "octree"]
Method = Literal["fast", "paper"]
LengthUnit = Literal["m", "cm", "mm", "um"]


class Option(NamedTuple):
    """Description of an option, in addition to its type and default."""

    metavar: str | None  # placeholder of its value; None for switches and choices
    text: str  # its help
    name: str = ""  # on the command line, if it differs from its own name with hyphens
    least: int | None = None
    letter: str = ""  # its short name on the command line
    is_argument: bool = False


IMAGE_FILES = (
    "NIfTI, MGZ, NRRD, MetaImage, AFNI, MINC, GIPL, VTK, .npy, OME-Zarr, a TIFF stack, a folder "
    "of slices, a DICOM file or folder, or a 2-D picture."
)
JsonOption = Annotated[Path | None, Option("FILE", "Write every number here.", "json")]
ForceOption = Annotated[bool, Option(None, "Replace existing outputs.")]
AVERAGE_OPTION = Option(
    "WORD",
    "Average of a cell's voxel moduli: mean (the paper's), geometric, harmonic, power:P, hill "
    "(between mean and harmonic); or gauss (one per Gauss point of quadratic cells), nodes "
    "(linear between nodes), linear (mean of the image linear between voxels, for cells smaller "
    f"than these) (default {DEFAULT_AVERAGE}).",
)
LabelNamesOption = Annotated[
    Path | None,
    Option(
        "TABLE",
        "Names and colours of labels, kept in the mesh's file: a table of FreeSurfer, ITK-SNAP, "
        "3D Slicer, MRtrix, BIDS, nnU-Net or FSL, or CSV; a segmentation with names of its own; or "
        "totalsegmentator, totalsegmentator_v1, totalsegmentator_mr, aseg, simnibs (default: those "
        "in the file of labels).",
    ),
]
FieldsOption = Annotated[
    list[str] | None,
    Option(
        "NAME=FILE[:KIND[@FRAME]]",
        "Add a field on a grid of its own to the cells: a scalar (default), whose name formulas "
        "may use, vector, direction or tensor. FRAME is what components mean, if the file does "
        "not state it: fsl, dipy, mrtrix, itk; or the axes voxel, fsl, ras, lps, of tensors with "
        "-upper, -lower or -diagonal. May be repeated.",
        "field",
    ),
]
SpaceOption = Annotated[str, Option("ras|lps", "Coordinate convention of the file.")]


@dataclass(frozen=True, kw_only=True)
class BoxPart:
    """Selected part of a volume file."""

    volume: Annotated[int | None, Option("K", "Volume of a 4-D file, from 0.")] = None
    crop: Annotated[
        str | None, Option("A:B,C:D,E:F", "Keep voxels A to B - 1 and so on; an end may be empty.")
    ] = None
    spacing_mm: Annotated[
        str | None,
        Option(
            "MM|X,Y,Z",
            "Voxel sizes of arrays (.npy), TIFF stacks and folders of slices that state none.",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class ImagePart(BoxPart):
    """Selected part of an image file; a slice is a 2-D image."""

    slice_: Annotated[
        str | None, Option("AXIS=INDEX", "One slice, as a 2-D image; for example k=90.", "slice")
    ] = None


MaskLabelOption = Annotated[
    str | None,
    Option(
        "LABEL,...", "Labels of the `mask`, a label image, that are in the mask: numbers or names."
    ),
]


@dataclass(frozen=True, kw_only=True)
class MeshPart:
    """Properties of another program's mesh that its file does not state."""

    label_field: Annotated[
        str | None,
        Option("NAME", "Cell field of the mesh with its labels (default: one of a known name)."),
    ] = None
    mesh_units: Annotated[
        LengthUnit | None,
        Option(None, "Length unit of the mesh's file (default: as it states, or mm)."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class MaskPart(MeshPart):
    """Mask of the voxels that count for a mesh's file, and whether the image may be another than
    the mesh's.
    """

    mask: Annotated[
        Path | None,
        Option(
            "MASK",
            "The mask that the mesh was built within, unless its file contains it: no other "
            "voxel counts.",
        ),
    ] = None
    mask_label: MaskLabelOption = None
    registered: Annotated[
        bool,
        Option(
            None,
            "Accept an image other than the mesh's, registered to it, even if its box differs.",
        ),
    ] = False


@dataclass(frozen=True, kw_only=True)
class MaskedPart(MaskPart, ImagePart):
    """Selected part of an image file, and the voxels in it that count for a mesh's file."""


@dataclass(frozen=True, kw_only=True)
class LabelledPart(MaskedPart):
    """Voxels of an image that count for a mesh's file, and labels for a mesh without them."""

    labels: Annotated[
        Path | None,
        Option(
            "LABELS",
            "Label image: each cell gets its voxels' majority label, for modulus mappings and "
            "sets.",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class VoxelOptions:
    """A mesh's field on the voxels of an image, in place of a solver's file."""

    like: Annotated[Path | None, Option("IMAGE", "The image whose voxels get the field.")] = None
    outside: Annotated[
        float | None,
        Option("VALUE", "Value of voxels outside the mesh (default NaN; 0 with `warp`)."),
    ] = None
    warp: Annotated[
        Path | None,
        Option(
            "IMAGE",
            "Write this image moved by `written_fields`, a displacement, linear between voxels.",
        ),
    ] = None
    nearest: Annotated[
        bool, Option(None, "With `warp`: take the nearest voxel's value, as for labels.")
    ] = False


@dataclass(frozen=True, kw_only=True)
class LabelChoice:
    """The labels that stay, by numbers or names."""

    keep_labels: Annotated[
        str | None,
        Option(
            "LABEL,...", "Keep only cells of these labels, numbers or names; the rest is left out."
        ),
    ] = None
    drop_labels: Annotated[str | None, Option("LABEL,...", "Leave out these labels.")] = None


WHOLE_BOX, WHOLE_IMAGE, ALL_LABELS = BoxPart(), MaskedPart(), LabelChoice()


@dataclass(frozen=True, kw_only=True)
class RegionOptions(LabelChoice):
    """Region to mesh, with its labels and weights."""

    mask: Annotated[
        Path | None,
        Option(
            "MASK",
            "Mesh only this region (0/1, or 0 to 1), with its boundary on the mask's surface.",
        ),
    ] = None
    mask_label: MaskLabelOption = None
    background: Annotated[
        str | None,
        Option(
            "VALUE|auto",
            "Leave out the air: voxels up to VALUE connected to the box's sides. Labels above 0 "
            "stay.",
        ),
    ] = None
    fill_holes: Annotated[
        str | None,
        Option(
            "LABEL",
            "Give this label, a number or name, to voxels of label 0 that other labels enclose.",
        ),
    ] = None
    keep_components: Annotated[
        bool, Option(None, "Keep small components of the mesh that the mask does not have.")
    ] = False
    labels: Annotated[Path | None, Option("LABELS", "Label image: each cell gets one label.")] = (
        None
    )
    tissues: Annotated[
        Path | None,
        Option(
            "FILE,...",
            "Tissue probabilities instead of labels: one file each, or a 4-D file; 0 is the "
            "remainder.",
        ),
    ] = None
    merge: Annotated[
        str | None,
        Option(
            "GROUPS",
            'Merge labels: "white=2,41; grey=3,42; soft=500-530; other=*", aseg, synthseg or '
            "simnibs, or a .toml or .csv file.",
        ),
    ] = None
    weights: Annotated[
        str | None, Option("W,...", "Weight of each IMAGE (default 1 each; 0: ignored).")
    ] = None
    smooth_interfaces: Annotated[
        bool, Option(None, "Smooth the surfaces between labels, or keep their voxel steps.")
    ] = True
    free_volumes: Annotated[
        bool,
        Option(
            None,
            "Do not make up for the volume that labels thinner than cells lose (by default, in "
            "part).",
        ),
    ] = False
    label_weight: Annotated[
        float | None, Option("W", "Weight of the labels relative to the first IMAGE (default 1).")
    ] = None


@dataclass(frozen=True, kw_only=True)
class ContentOptions(ImagePart, RegionOptions):
    """Meshed part of an image, and the files that accompany it."""

    panel: ClassVar[str] = "Region and labels"


@dataclass(frozen=True, kw_only=True)
class SourceOptions(ContentOptions):
    """Inputs of `tetopt mesh`."""

    images: Annotated[
        list[Path],
        Option(
            "IMAGE...",
            f"{IMAGE_FILES} Further images are contrasts, resampled to the first.",
            is_argument=True,
        ),
    ]


@dataclass(frozen=True, kw_only=True)
class SizeOptions:
    """Number of nodes, and sizes of cells."""

    panel: ClassVar[str] = "Number and size of cells"
    nodes: Annotated[
        int | None,
        Option(
            "N",
            "Target number of nodes, with `order` 2 including mid-edge nodes "
            f"(default: as sizes require, or {DEFAULT_NODES[3]}; {DEFAULT_NODES[2]} in 2-D).",
        ),
    ] = None
    target_error: Annotated[
        float | None,
        Option(
            "T",
            "Instead of a number of nodes: the fraction of the image's variance left unexplained.",
        ),
    ] = None
    nodes_max: Annotated[
        int | None,
        Option(
            "N",
            f"With `target_error`: the most nodes that it may take (default {TARGET_NODES_MAX}).",
            least=5,
        ),
    ] = None
    size_min: Annotated[float | None, Option("MM", "Minimum edge length produced by splits.")] = (
        None
    )
    edge_size: Annotated[
        float | None,
        Option("MM", "Target edge length: longer edges are split while nodes are available."),
    ] = None
    edge_max: Annotated[
        float | None,
        Option(
            "MM", "Maximum edge length (default 1.4 x a uniform mesh's; with `edge_size` none)."
        ),
    ] = None
    gradation: Annotated[
        float | None,
        Option(
            "G", "Gradation, 0.05 (gentle) to 1 (default): each size is 1/G or more blocks wide."
        ),
    ] = None
    cells_across: Annotated[
        float | None,
        Option(
            "N", "Number of cells across thin labels: target edges are the local thickness / N."
        ),
    ] = None
    label_size: Annotated[
        str | None,
        Option(
            "LABEL=SIZE,...",
            "Target edge by label or name, mm or a fraction of the local thickness t: "
            '"fluid=1.5,bone=0.6t[1:10],*=6", '
            "or a .toml or .csv file.",
        ),
    ] = None
    sizing: Annotated[
        Path | None, Option("SIZES.nii.gz", "Image of target edges, mm; 0 or less: no target.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class StartOptions(MeshPart):
    """The initial mesh of a run."""

    panel: ClassVar[str] = "Initial mesh"
    lattice: Annotated[
        Lattice | None,
        Option(
            "KIND",
            "Initial mesh: octree (default), with nodes where the image has detail, or the uniform "
            "bcc, five-tet or, in 2-D, criss-cross.",
        ),
    ] = None
    uniform: Annotated[
        bool, Option(None, "Use the paper's uniform lattice, bcc (criss-cross in 2-D).")
    ] = False
    spacing: Annotated[float | None, Option("MM", "Use a uniform lattice of this spacing.")] = None
    start: Annotated[
        Path | None,
        Option("MESH", "Improve this mesh and keep its boundary, instead of building a new one."),
    ] = None
    keep_connectivity: Annotated[
        bool,
        Option(
            None,
            "With `start`: only move its nodes; cells keep their labels, and boundary and "
            "interfaces follow `mask` and `labels`.",
        ),
    ] = False


@dataclass(frozen=True, kw_only=True)
class MoveOptions:
    """The transform of a registration that moves a mesh from the fixed to the moving image."""

    panel: ClassVar[str] = "Registration"
    transform: Annotated[
        list[Path] | None,
        Option(
            "FILE",
            "Move the mesh by the map that resamples images from the moving to the fixed image, "
            "whose mesh it is (ITK, ANTs, FSL, AFNI, SPM); repeated in the order of "
            "antsApplyTransforms: nodes pass the first file first.",
        ),
    ] = None
    inverse: Annotated[
        bool, Option(None, "Move by the inverse: the mesh is of the registration's moving image.")
    ] = False
    fixed: Annotated[
        Path | None, Option("IMAGE", "The registration's fixed image, for FSL's matrix.")
    ] = None


UNMOVED = MoveOptions()


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """Settings of the optimisation."""

    panel: ClassVar[str] = "Optimisation"
    k_D: Annotated[
        float | None,
        Option(
            "K",
            "Weight of the image: 0 shape only; 0.9 image first "
            f"(default {GRADED_K_D:g}; `uniform` {UNIFORM_K_D:g}; `start` {START_K_D:g} without "
            "`keep_connectivity`).",
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
        Boundary | None,
        Option(None, "Motion of boundary nodes (default slide; with `start` fixed)."),
    ] = None
    method: Annotated[
        Method,
        Option(
            None, "fast: gradients, flips, a minimum dihedral angle; paper: the paper's scheme."
        ),
    ] = "fast"
    shape_power: Annotated[
        float | None,
        Option(
            "P",
            "Fast method: 1 is the paper's E_G, 10 penalises flat cells most (default "
            f"{SHAPE_POWER:g}).",
        ),
    ] = None
    min_dihedral: Annotated[
        float | None,
        Option(
            "DEG",
            "Fast method, 3-D: smallest dihedral angle allowed, 0 (none) to 70 (default "
            f"{MIN_DIHEDRAL:g}).",
        ),
    ] = None
    n_t: Annotated[
        int | None,
        Option(
            "T",
            "Paper's method: retessellate in the first T iterations (default half; all for k_D = "
            "0).",
            "n-t",
            least=0,
        ),
    ] = None
    retessellate: Annotated[
        Retessellate | None,
        Option(
            None,
            "Paper's method: retessellate in the first n_t iterations (default), only if that "
            "lowers E, or never.",
        ),
    ] = None
    threads: Annotated[
        int | None, Option("N", "Number of threads; the result does not depend on it.")
    ] = None
    max_seconds: Annotated[
        float | None, Option("S", "Stop after S seconds and write the current mesh.")
    ] = None
    max_gb: Annotated[
        float | None, Option("GB", "Stop before exceeding this memory and write the current mesh.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Materials, sets and loads for a solver."""

    panel: ClassVar[str] = "For the solver"
    young: Annotated[
        str | None,
        Option(
            "MAPPING",
            'Young\'s modulus, kPa or the unit that it names, "3 MPa": a number, a formula of the '
            'intensity, "0.5 + 0.01*h", "where(h < 1.2, 2*h**2.5, 2*h**1.6)", a '
            'table "0:1,100:5", '
            'by label "1=2.1,liver=1.9,*=5", or a .toml or .csv file with such columns.',
        ),
    ] = None
    nu: Annotated[
        str | None,
        Option("MAPPING", f"Poisson's ratio, in the same forms (default {DEFAULT_NU:g})."),
    ] = None
    density: Annotated[
        str | None,
        Option("MAPPING", "Density, kg/m3, in the same forms (water: 1000); needed for gravity."),
    ] = None
    fibre: Annotated[
        str | None,
        Option(
            "NAME",
            "Directions of fibres: data of cells with three numbers. `young` and `nu` then hold "
            "across them.",
        ),
    ] = None
    young_along: Annotated[
        str | None, Option("MAPPING", "Young's modulus along fibres, in the forms of `young`.")
    ] = None
    shear_along: Annotated[
        str | None,
        Option(
            "MAPPING",
            "Shear modulus along fibres, in the forms of `young` (default: as across them).",
        ),
    ] = None
    average: Annotated[str | None, AVERAGE_OPTION] = None
    bins: Annotated[
        str | None,
        Option(
            "K[:quantile|:log]",
            "Group cells into K materials: bins of equal width, equal count or log width.",
        ),
    ] = None
    fields: FieldsOption = None
    sets: Annotated[
        list[str] | None,
        Option(
            "NAME=...",
            "Add a set: NAME=below:T, NAME=point:X,Y,Z:D, NAME=plane:X,Y,Z:NX,NY,NZ:D (mm, RAS+), "
            "NAME=facing:NX,NY,NZ:DEGREES, NAME=box:X,Y,Z:X,Y,Z, or of other sets: NAME=A-B, "
            'NAME=outer:A-B, NAME=inner:A-B; what is in several: "NAME=A & B". May be repeated.',
            "set",
        ),
    ] = None
    written_sets: Annotated[
        str | None,
        Option(
            "GROUP,...",
            "Standard sets to write: labels, interfaces, boundary; or all, or none.",
            "sets",
        ),
    ] = None
    loads: Annotated[
        list[str] | None,
        Option(
            "...",
            "compress:5%, hold:SET, move:SET:X,Y,Z (mm, or free), pressure:SET:P (kPa, inwards), "
            "traction:SET:X,Y,Z (kPa), spring:SET:K (kPa/mm), gravity:X,Y,Z (mm/s2; the earth's is "
            "9810); 2/... acts in step 2 only. May be repeated.",
            "load",
        ),
    ] = None
    label_names: LabelNamesOption = None
    order: Annotated[
        int | None,
        Option(
            "1|2",
            "2: quadratic cells, curved along the surfaces of labels or a mask; 1: linear cells "
            "(default: as in the input mesh, else 1).",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class SolverOptions(ModelOptions):
    """Settings of a solver's file."""

    nonlinear: Annotated[
        bool, Option(None, "Make the step a large-deformation one (.inp; FEBio always does).")
    ] = False
    units: Annotated[
        str,
        Option(
            "kPa|MPa|Pa",
            "Unit of stress in the file, and of moduli and pressures in `young` and `loads` that "
            "name none; with Pa, the file's lengths are in m.",
        ),
    ] = "kPa"
    written_fields: Annotated[
        str | None,
        Option(
            "none|mean|all|NAME",
            "Fields of cells to write besides labels and results (default none in .msh; all in "
            ".vtu, .vtk, .xdmf); to an image (.nii, .nii.gz, .mgz, .nrrd), the field of nodes or "
            "cells of this name.",
            "fields",
        ),
    ] = None
    space: SpaceOption = "ras"


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Outputs of a run."""

    panel: ClassVar[str] = ""  # with those of the command
    output: Annotated[Path, Option("MESH", f"The mesh to write: {', '.join(FORMATS)}.", letter="o")]
    json_path: JsonOption = None
    figures: Annotated[
        Path | None,
        Option("DIR", "Folder for slice.png, rho.png, energies.png and others; created if needed."),
    ] = None
    force: ForceOption = False


@dataclass(frozen=True, kw_only=True)
class RunOptions(
    SolverOptions, EngineOptions, MoveOptions, StartOptions, SizeOptions, ContentOptions
):
    """Options of the runs of many subjects: all except images, outputs and workers."""


@dataclass(frozen=True, kw_only=True)
class JobOptions(
    OutputOptions,
    SolverOptions,
    EngineOptions,
    MoveOptions,
    StartOptions,
    SizeOptions,
    SourceOptions,
):
    """Every option of a run; `tetopt.job.plan` checks that they are consistent."""


def stated_part(part: ImagePart) -> dict[str, int | str | None]:
    """Return the selected part of an image as files of numbers state it."""
    return {"volume": part.volume, "crop": part.crop, "slice": part.slice_}


def has_model(options: SolverOptions) -> bool:
    """Return whether a file contains more than the mesh and the names of labels."""
    return any(
        getattr(options, each.name) != each.default
        for each in fields(SolverOptions)
        if each.name != "label_names"
    )


def near_hint(name: str, names: Iterable[str]) -> str:
    """Return a suggestion for the end of a message if one of the names resembles the unknown
    one.
    """
    near = get_close_matches(name, list(names), 1)
    return f"; did you mean {near[0]}?" if near else ""


def kinds_of(record: Any) -> Json:
    """Return the fields of a record class with their annotations."""
    return _known_kinds(record)


@cache  # whose argument mypy would not take for hashable
def _known_kinds(record: Any) -> Json:
    kinds = get_type_hints(record, include_extras=True)
    return {field.name: kinds[field.name] for field in fields(record)}


def has_option(kind: Any) -> bool:
    """Return whether an annotation describes an option."""
    return any(isinstance(each, Option) for each in get_args(kind)[1:])


def option_of(kind: Any) -> Option:
    """Return the option described by an annotation."""
    return next(each for each in get_args(kind)[1:] if isinstance(each, Option))


def option_name(name: str, kind: Any) -> str:
    """Return the name of a record's field on the command line, without leading hyphens, e.g.
    "k-d".
    """
    return option_of(kind).name or name.replace("_", "-").lower()


def given_options(record: Any) -> Json:
    """Return a record's values that differ from the default, by command-line names; arguments by
    their fields' names.

    Records of the same fields and values have equal dictionaries.
    """
    kinds = kinds_of(type(record))
    values = ((field, getattr(record, field.name)) for field in fields(record))
    return {
        option_name(field.name, kinds[field.name]): value
        for field, value in values
        if value != field.default
    }
