"""The ``tetopt`` command: file in, file out. Thin: every number comes from the library."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shlex
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NamedTuple

import numba
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

import tetopt
from tetopt import (
    Image,
    InputError,
    Mesh,
    load_image,
    load_mesh,
    load_phantom,
    save_image,
    save_mesh,
)
from tetopt.align import (
    aligned_contrast,
    aligned_labels,
    aligned_mask,
    background_level,
    foreground,
    is_same_grid,
)
from tetopt.content import Content, check_labels, content, continued
from tetopt.domain import lattice_within
from tetopt.fidelity import cell_labels
from tetopt.geometry.quality import quality
from tetopt.geometry.simplex import dihedral_angles, squared_edges, volumes
from tetopt.io.files import checked_output, save_json
from tetopt.io.images import parse_crop, parse_slice, part_of, sha256
from tetopt.io.meshes import MeshFile, cell_fields
from tetopt.io.mni import mni_path, mni_tissue
from tetopt.lattice import KINDS
from tetopt.optimize.fast import (
    GRADED_ITERATIONS,
    GRADED_K_D,
    check_options,
    meshed_to_error,
    optimize,
    prepare_kernels,
)
from tetopt.optimize.octree import octree
from tetopt.optimize.paper import Optimized, Record, default_n_t, optimize_paper
from tetopt.report.summary import fidelity, run_summary, versions
from tetopt.report.tables import add_quality, label_table, mask_table, new_table

MISSED = 0.9  # Dice of a mesh with its mask: below, the mesh is not of the mask
POOR = 0.5  # Dice of a label that its cells hardly show
INSIDE = 0.95  # of a mask or of labels that lies in the image, to expect
LARGE = 200  # voxels: a label of more may not be without cells
DEFAULT_NODES = {2: 500, 3: 5000}


class _Console(Console):
    """A console that falls silent when the reader of its pipe has gone, and lets the command end in its own way."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


log = _Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
out = _Console(highlight=False, soft_wrap=True, emoji=False)
app = typer.Typer(
    name="tetopt",
    help="From a medical volume straight to an image-aligned tetrahedral mesh, without segmentation.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


class Lattice(StrEnum):  # noqa: D101
    bcc = "bcc"
    five_tet = "five-tet"
    criss_cross = "criss-cross"
    octree = "octree"


class Method(StrEnum):  # noqa: D101
    fast = "fast"
    paper = "paper"


class Baseline(StrEnum):  # noqa: D101
    pytetwild = "pytetwild"
    cleaver = "cleaver"


class Boundary(StrEnum):  # noqa: D101
    slide = "slide"
    fixed = "fixed"


class Retessellate(StrEnum):  # noqa: D101
    first = "first"
    accept = "accept"
    never = "never"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit code: 0 done, 1 a promise of the mesh missed, 2 an input to mend, 130 Ctrl-C."""
    with warnings.catch_warnings(), _silent_plot_fonts():
        warnings.showwarning = _show_warning
        try:
            arguments = list(sys.argv[1:] if argv is None else argv)
            return app(args=arguments, obj=arguments, standalone_mode=False) or 0
        except InputError as error:
            log.print(f"[bold red]tetopt:[/] {escape(str(error))}")
            return 2
        except typer.Exit as ended:
            return ended.exit_code
        except (typer.Abort, KeyboardInterrupt):  # newer versions of typer return 130 themselves
            return 130
        except OSError as error:  # a full disk, a folder that may not be written to
            log.print(f"[bold red]tetopt:[/] {escape(str(error))}")
            return 2
        except Exception as error:
            if type(error).__module__.split(".")[0] not in ("click", "typer") or not hasattr(error, "format_message"):
                raise
            if error.format_message():  # empty after the help that a bare `tetopt` prints
                log.print(f"[bold red]tetopt:[/] {escape(error.format_message())} (see --help)")
            return 2


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    log.print(f"[yellow]tetopt: warning:[/] {escape(str(message))}")


@contextlib.contextmanager
def _silent_plot_fonts() -> Iterator[None]:
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # its font-cache notice is not the user's business
    yield


def _version(wanted: bool) -> None:
    if wanted:
        out.print(f"tetopt {tetopt.__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


ImageArgument = Annotated[
    Path,
    typer.Argument(metavar="IMAGE", help="NIfTI, MGZ, NRRD, MetaImage, a DICOM folder, or a 2-D picture."),
]
ImagesArgument = Annotated[
    list[Path],
    typer.Argument(metavar="IMAGE...", help="As for the other commands; further contrasts go to the first one's grid."),
]
MaskOption = Annotated[
    Path | None,
    typer.Option(metavar="MASK", help="Mesh this region only (0/1, or 0 to 1), its boundary on the mask's surface."),
]
LabelsOption = Annotated[
    Path | None, typer.Option("--labels", metavar="LABELS", help="Label image: each cell is to be of one label.")
]
VolumeOption = Annotated[int | None, typer.Option("--volume", metavar="K", help="Volume of a 4-D file, from 0.")]
CropOption = Annotated[
    str | None,
    typer.Option("--crop", metavar="A:B,C:D,E:F", help="Keep these voxels, half open; an end may be empty."),
]
SliceOption = Annotated[
    str | None, typer.Option("--slice", metavar="AXIS=INDEX", help="One slice, in 2-D; for example k=90.")
]
JsonOption = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write every number here.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing outputs.")]
ThreadsOption = Annotated[
    int | None, typer.Option("--threads", metavar="N", help="Threads; the result is the same for any number.")
]


@app.command("mesh")
def mesh_command(
    image_paths: ImagesArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MESH.vtu", help="The mesh to write.")],
    nodes: Annotated[
        int | None, typer.Option(metavar="N", help="Wanted number of nodes (default 5000; 500 in 2-D).")
    ] = None,
    target_error: Annotated[
        float | None,
        typer.Option(metavar="T", help="As many nodes as leave this share of the image's variance in cells, instead."),
    ] = None,
    size_min: Annotated[float | None, typer.Option(metavar="MM", help="No edge is split into shorter ones.")] = None,
    size_max: Annotated[
        float | None,
        typer.Option(metavar="MM", help="No cell is made with a longer edge (default 1.4 x a uniform mesh's)."),
    ] = None,
    gradation: Annotated[
        float | None,
        typer.Option(metavar="G", help="How gently sizes change: each is 1/G blocks wide, 0.05 to 1 (default)."),
    ] = None,
    sizing: Annotated[
        Path | None, typer.Option(metavar="SIZES.nii.gz", help="Longest edge by place, mm; 0 or less: as elsewhere.")
    ] = None,
    mask: MaskOption = None,
    background: Annotated[
        str | None,
        typer.Option(metavar="VALUE|auto", help="Leave out what is up to VALUE and reaches the box: the air."),
    ] = None,
    labels: LabelsOption = None,
    weights: Annotated[
        str | None, typer.Option(metavar="W,...", help="How much each IMAGE counts (default 1 each; 0: not at all).")
    ] = None,
    label_weight: Annotated[
        float | None, typer.Option(metavar="W", help="How much the labels count beside the first IMAGE (default 1).")
    ] = None,
    uniform: Annotated[
        bool, typer.Option("--uniform", help="The paper's setting: a uniform lattice, bcc (criss-cross in 2-D).")
    ] = False,
    spacing: Annotated[float | None, typer.Option(metavar="MM", help="A uniform lattice of this spacing.")] = None,
    lattice_kind: Annotated[
        Lattice | None,
        typer.Option(
            "--lattice",
            help="Initial mesh. octree, the default, puts nodes where the image has content; the others are uniform.",
        ),
    ] = None,
    k_D: Annotated[
        float | None,
        typer.Option(
            "--k-d",
            metavar="K",
            help="Weight of the image: 0 shape only; 0.9 image first (default 0.85; 0.2 on a uniform lattice).",
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            metavar="I", min=0, help="Sweeps over all nodes; 0 writes the initial mesh (default 16; 20 if uniform)."
        ),
    ] = None,
    n_t: Annotated[
        int | None,
        typer.Option(
            "--n-t",
            metavar="T",
            min=0,
            help="Paper's method: connect anew in the first T iterations (default half; all for k_D = 0).",
        ),
    ] = None,
    retessellate: Annotated[
        Retessellate | None,
        typer.Option(
            help="Paper's method: Delaunay anew in the first n_t iterations (the default), whenever it lowers E, never."
        ),
    ] = None,
    method: Annotated[
        Method, typer.Option(help="fast: gradients, flips, a floor on angles; paper: the scheme of the paper.")
    ] = Method.fast,
    shape_power: Annotated[
        float | None,
        typer.Option(
            metavar="P", help="Fast method: 1 is the paper's E_G; up to 10 punish flat cells more (default 3)."
        ),
    ] = None,
    min_dihedral: Annotated[
        float | None,
        typer.Option(
            metavar="DEG", help="Fast method, 3-D: smallest dihedral angle allowed, 0 (none) to 70 (default 12)."
        ),
    ] = None,
    boundary: Annotated[Boundary, typer.Option(help="What the boundary's nodes may do.")] = Boundary.slide,
    threads: ThreadsOption = None,
    max_seconds: Annotated[
        float | None, typer.Option(metavar="S", help="Stop after S seconds with the mesh reached.")
    ] = None,
    volume: VolumeOption = None,
    crop: CropOption = None,
    slice_: SliceOption = None,
    json_path: JsonOption = None,
    figures: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Draw slice.png, rho.png, energies.png and others in this folder."),
    ] = None,
    force: ForceOption = False,
) -> int:
    """Mesh an image: nodes where it has content (or a uniform lattice), optimised, as a VTU file."""
    begin = time.perf_counter()
    output = checked_output(output, (".vtu",), force)
    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    wishes = {"--nodes": nodes, "--spacing": spacing, "--target-error": target_error}
    if len(given := [name for name, value in wishes.items() if value is not None]) > 1:
        raise InputError(f"{' and '.join(given)}: give one of them")
    is_graded = _is_graded(lattice_kind, uniform, spacing, method)
    limits = {"--size-min": size_min, "--size-max": size_max, "--gradation": gradation, "--sizing": sizing}
    for name, value in {**limits, "--target-error": target_error}.items():
        if value is not None and not is_graded:
            raise InputError(f"{name}: only on a graded mesh; leave out --uniform, --spacing, --lattice and --method")
    k_D = (GRADED_K_D if is_graded else 0.2) if k_D is None else k_D
    iterations = (GRADED_ITERATIONS if is_graded else 20) if iterations is None else iterations
    if not 0.0 <= k_D < 1.0:
        raise InputError(f"--k-d: expected 0 <= k_D < 1, got {k_D}")
    if max_seconds is not None and not max_seconds > 0.0:
        raise InputError(f"--max-seconds: expected more than 0, got {max_seconds}")
    options: dict[str, Any] = {"k_D": k_D, "iterations": iterations, "boundary": boundary.value}
    _check_method(method, {"--n-t": n_t, "--retessellate": retessellate}, Method.paper)
    _check_method(method, {"--shape-power": shape_power, "--min-dihedral": min_dihedral}, Method.fast)
    if method is Method.paper:
        options["n_t"] = default_n_t(k_D, iterations) if n_t is None else n_t
        options["retessellate"] = Retessellate.first.value if retessellate is None else retessellate.value
    else:
        options["shape_power"] = 3.0 if shape_power is None else shape_power
        options["min_dihedral"] = 12.0 if min_dihedral is None else min_dihedral
        check_options(**options)
    names = ["slice.png", "rho.png", "energies.png"]
    names += [] if mask is None and background is None else ["boundary.png"]
    names += [] if labels is None else ["labels.png"]
    pictures = [] if figures is None else [checked_output(figures / name, (".png",), force) for name in names]
    if method is Method.paper and (len(image_paths) > 1 or mask or background or labels):
        raise InputError("--method paper: takes one IMAGE and its whole box; leave out mask, labels and further ones")
    _set_threads(threads)
    source = _source(image_paths, volume, crop, slice_, mask, background, labels, weights, label_weight)
    wanted = source.wanted
    image = wanted.image
    if is_graded:
        sizes = _sizes(size_min, size_max, gradation, sizing)
        if nodes is None and target_error is None:  # fewer on small images
            nodes = int(np.clip(wanted.n_voxels // 8, 2 ** (image.ndim + 2), DEFAULT_NODES[image.ndim]))
        if size_max is None and nodes is not None:  # what holds then is told with the other numbers
            size_max = (tetopt.Sizes() if sizes is None else sizes).at_most(image, nodes, wanted.volume)
        initial, kind = None if nodes is None else octree(wanted, nodes, sizes), Lattice.octree.value
        options |= {"nodes": nodes, "sizes": sizes}
    else:
        if nodes is None and spacing is None:
            nodes = DEFAULT_NODES[image.ndim]
        kind = KINDS[image.ndim][0] if lattice_kind is None else lattice_kind.value
        initial = lattice_within(image, wanted.region, kind, nodes=nodes, spacing=spacing)
    settings = {
        "nodes": nodes, "target_error": target_error, "spacing": spacing, "lattice": kind, "size_min": size_min,
        "size_max": size_max, "gradation": gradation, "sizing": None if sizing is None else sizing.name,
        "volume": volume, "crop": crop, "slice": slice_, "method": method.value, "max_seconds": max_seconds,
    }  # fmt: skip
    return _mesh_files(source, initial, options, settings, output, json_path, pictures, begin)


class _Source(NamedTuple):
    """What is meshed, and the files that it comes from."""

    paths: list[Path]  # of the contrasts
    wanted: Content
    contrasts: list[Image]  # on the first one's voxels
    labels: Image | None  # likewise
    mask: Image | None
    about: dict[str, Any]  # names, checksums and weights


def _source(
    paths: list[Path], volume: int | None, crop: str | None, slice_: str | None, mask_path: Path | None,
    background: str | None, labels_path: Path | None, weights: str | None, label_weight: float | None,
) -> _Source:  # fmt: skip
    """Images, labels and mask as the options ask for them, on the voxels of the first image."""
    if mask_path is not None and background is not None:
        raise InputError("--mask and --background: give one of them")
    if label_weight is not None and labels_path is None:
        raise InputError("--label-weight: there are no --labels")
    image, beside = _image_and_others(paths[0], volume, crop, slice_)
    contrasts = [image, *(beside(path, aligned_contrast) for path in paths[1:])]
    labels = None if labels_path is None else beside(labels_path, aligned_labels)
    mask = None if mask_path is None else beside(mask_path, aligned_mask)
    level = None
    if background is not None:
        level = background_level(image) if background == "auto" else _number("--background", background)
        mask = foreground(image, level)
        log.print(
            f"background: up to {level:g}, as far as it reaches the box; {mask.data.mean():.1%} of the voxels are left"
        )
    counts = [1.0] * len(paths) if weights is None else [_number("--weights", part) for part in weights.split(",")]
    if weights is None and labels is not None and len(paths) == 1 and np.array_equal(labels.data, image.data):
        log.print("the image is its own labels: only these count")
        counts = [0.0]
    wanted = content(
        contrasts, labels, mask, weights=counts, label_weight=1.0 if label_weight is None else label_weight
    )
    about: dict[str, Any] = {"image": paths[0].name, "image_sha256": sha256(paths[0])}
    files = [*paths[1:], *(path for path in (mask_path, labels_path) if path is not None)]
    about["inputs"] = {
        "images": [path.name for path in paths], "weights": counts,
        "mask": None if mask_path is None else mask_path.name, "background": level,
        "labels": None if labels_path is None else labels_path.name,
        "label_weight": None if labels is None else label_weight,
        "sha256": {path.name: sha256(_file_and_volume(path)[0]) for path in files},
    }  # fmt: skip
    return _Source(paths, wanted, contrasts, labels, mask, about)


def _image_and_others(
    path: Path, volume: int | None, crop: str | None, slice_: str | None
) -> tuple[Image, Callable[[Path, Callable[[Image, Image, str], Image]], Image]]:
    """The image as the options ask for it, and a function that reads files beside it and aligns them to its voxels."""
    image = _image(path, volume, crop, slice_)
    # A slice has lost its place across it: what goes with it is aligned to the whole image and sliced like that.
    whole = image if slice_ is None else _image(path, volume, None, None)

    def beside(other: Path, aligned: Callable[[Image, Image, str], Image]) -> Image:
        given = _companion(other)
        moved = aligned(given, whole, str(other))
        if not is_same_grid(given, whole):
            _say_resampled(other, given, moved, is_contrast=aligned is aligned_contrast)
        return (
            moved if slice_ is None else part_of(moved, parse_slice(slice_), None if crop is None else parse_crop(crop))
        )

    return image, beside


def _say_resampled(path: Path, given: Image, moved: Image, is_contrast: bool) -> None:
    """That a file lay on another grid, and how much of a mask or of labels is in the image."""
    if is_contrast:
        log.print(escape(f"{path}: taken to the image's voxels, linearly"))
        return
    whole, there = (np.count_nonzero(each.data) * each.voxel_volume for each in (given, moved))
    log.print(escape(f"{path}: taken to the image's voxels, nearest neighbour"))
    if there < INSIDE * whole:
        _show_warning(f"{path}: only {there / whole:.0%} of it lies in the image; is it of the same scan?")


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f'{name}: expected a number, got "{text}"') from None


def _is_graded(kind: Lattice | None, uniform: bool, spacing: float | None, method: Method) -> bool:
    """Whether the options ask for an octree; it is the default."""
    if kind is not Lattice.octree:
        return kind is None and not uniform and spacing is None and method is Method.fast
    if uniform:
        raise InputError("--uniform and --lattice octree: give one of them")
    if method is Method.paper:
        raise InputError("--lattice octree: only with --method fast, got --method paper")
    if spacing is not None:
        raise InputError("--lattice octree: has no one spacing; give --nodes instead of --spacing")
    return True


def _sizes(
    size_min: float | None, size_max: float | None, gradation: float | None, sizing: Path | None
) -> tetopt.Sizes | None:
    """The limits on sizes as the options ask for them."""
    if size_min is None and size_max is None and gradation is None and sizing is None:
        return None
    return tetopt.Sizes(
        0.0 if size_min is None else size_min, size_max, 1.0 if gradation is None else gradation,
        None if sizing is None else _companion(sizing),
    )  # fmt: skip


def _file_and_volume(path: Path) -> tuple[Path, int | None]:
    """A file beside the first image, and the volume of it that `FILE:K` names."""
    name, colon, volume = str(path).rpartition(":")
    if colon and volume.isdecimal() and not path.exists():
        return Path(name), int(volume)
    return path, None


def _companion(path: Path) -> Image:
    """A file beside the image; one value everywhere, which would be odd in an image, is not in sizes or a mask."""
    file, volume = _file_and_volume(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_image(file, volume=volume)


def _check_method(method: Method, given: dict[str, Any], wanted: Method) -> None:
    """InputError for an option of the other method."""
    wrong = [name for name, value in given.items() if value is not None]
    if wrong and method is not wanted:
        raise InputError(f"{wrong[0]}: only with --method {wanted.value}, got --method {method.value}")


def _mesh_files(
    source: _Source,
    initial: Mesh | None,
    options: dict[str, Any],
    settings: dict[str, Any],
    output: Path,
    json_path: Path | None,
    pictures: list[Path],
    begin: float,
) -> int:
    """Optimise, write the mesh, the numbers and the pictures, print the comparison; the exit code."""
    wanted, image = source.wanted, source.wanted.image
    loaded = time.perf_counter()
    ends = None if settings["max_seconds"] is None else begin + settings["max_seconds"]
    interrupted: list[bool] = []

    def run(mesh: Mesh, nodes: int | None) -> Optimized:
        log.print(escape(_described(source, mesh, settings["lattice"])))
        graded = {} if nodes is None else {"nodes": nodes}
        result, is_interrupted = _optimized(wanted, mesh, Method(settings["method"]), ends, **options | graded)
        interrupted.append(is_interrupted)
        return result

    if initial is None:
        options["nodes"], initial, result = meshed_to_error(wanted, settings["target_error"], options["sizes"], run)
    else:
        result = run(initial, options.get("nodes"))
    is_interrupted = any(interrupted)
    optimized = time.perf_counter()
    told = {name: value for name, value in (settings | options).items() if name != "sizes"}
    about = {**source.about, "options": told}
    fields = _fields(source, result.mesh)
    save_mesh(output, result.mesh, fields, {"tetopt": tetopt.__version__, **about})
    found = fidelity(source.labels, source.mask, result.mesh, fields.get("label"))
    if not wanted.is_plain or wanted.region is not None:
        found["contrasts"] = _by_contrast(source, result.mesh, fields)
    if json_path is not None:
        seconds = {"load": loaded - begin, "optimize": optimized - loaded, "all": time.perf_counter() - begin}
        save_json(json_path, run_summary(wanted, initial, result, about, seconds) | found)
    if pictures:
        from tetopt.report import figures  # matplotlib is slow to load, and only needed here

        start = _start_name(settings["lattice"])
        figures.save_run_figures(pictures[:3], image, initial, result, start, source.contrasts[0])
        if source.mask is not None:
            drawn = figures.boundary_figure(source.contrasts[0], source.mask, result.mesh)
            figures.save_figure(drawn, pictures[3])
        if source.labels is not None:
            figures.save_figure(figures.label_figure(source.labels, result.mesh, fields["label"]), pictures[-1])
    # Everything is written; what is printed may go into a pipe that closes.
    code = _promises(wanted, result, options.get("min_dihedral", 0.0), settings["target_error"], found)
    code = 130 if is_interrupted else code
    n_empty = 0 if image.data.min() == image.data.max() else int((fields["n_voxels"] == 0).sum())
    asked = options.get("nodes") if settings["target_error"] is None else None
    _warn(result, Method(settings["method"]), asked, n_empty)
    _print_comparison(wanted, initial, result, _start_name(settings["lattice"]))
    _print_fidelity(found)
    out.print(escape(f"{output}: {len(result.mesh.points)} nodes, {len(result.mesh.cells)} cells"))
    if json_path is not None:
        out.print(escape(f"{json_path}: every number of the run"))
    for path in pictures:
        out.print(escape(str(path)))
    return code


def _fields(source: _Source, mesh: Mesh) -> dict[str, NDArray]:
    """What the file holds of each cell: as `cell_fields`, means of further contrasts, and the label."""
    fields = cell_fields(mesh, source.wanted.image)
    for number, contrast in enumerate(source.contrasts[1:], 2):
        moments = tetopt.cell_moments(continued(contrast, source.mask), mesh)
        fields |= {f"mean_{number}": moments.mean, f"variance_{number}": moments.variance}
    if source.labels is not None:
        fields["label"] = cell_labels(continued(source.labels, source.mask), mesh)
    return fields


def _by_contrast(source: _Source, mesh: Mesh, fields: dict[str, NDArray]) -> list[dict[str, Any]]:
    """How well each contrast is represented: the share of its variance left within cells."""
    rows = []
    weights = source.about["inputs"]["weights"]
    for number, (path, weight) in enumerate(zip(source.paths, weights, strict=True), 1):
        mean, variance = (fields[name if number == 1 else f"{name}_{number}"] for name in ("mean", "variance"))
        count = fields["n_voxels"]
        within = float((count * variance).sum())
        total = within + float((count * (mean - (count * mean).sum() / count.sum()) ** 2).sum())
        rows.append(
            {"image": path.name, "weight": weight, "E_D_share_of_variance": within / total if total > 0.0 else None}
        )
    return rows


def _print_fidelity(found: dict[str, Any]) -> None:
    for row in found.get("contrasts", []):
        share = "constant" if row["E_D_share_of_variance"] is None else f"{row['E_D_share_of_variance']:.5f}"
        out.print(escape(f"{row['image']}: weight {row['weight']:g}, share of its own variance in cells {share}"))
    if "mask" in found:
        _print_wide(mask_table(found["mask"]))
    if "labels" in found:
        _print_wide(label_table(found["labels"]))


def _print_wide(table: Table) -> None:
    """A table as wide as it is, also where a pipe has no width."""
    _Console(file=out.file, width=max(out.width, 120), highlight=False, emoji=False).print(table)


def _warn(result: Optimized, method: Method, nodes: int | None, n_empty: int) -> None:
    """Say what is allowed but hardly meant; `nodes` were asked of a graded mesh, `n_empty` cells hold no voxel."""
    found = len(result.mesh.points)
    if nodes is not None and abs(found - nodes) > 0.01 * nodes:
        _show_warning(f"{found} nodes instead of {nodes}: more iterations, or a --k-d above 0, come nearer")
    lowest, last = min(row.E for row in result.history), result.history[-1].E
    if last > lowest * (1.0 + 1e-3) and method is Method.paper:
        _show_warning(
            f"E ended at {last:.4f}, above {lowest:.4f} on the way: a tessellation taken in the first n_t iterations "
            "raised it; --retessellate accept takes only those that lower it"
        )
    if n_empty > 0.02 * len(result.mesh.cells):
        _show_warning(
            f"{n_empty} of {len(result.mesh.cells)} cells hold no voxel centre: E_D does not see them, and their "
            "values are the nearest voxel's; ask for fewer nodes"
        )


def _image(path: Path, volume: int | None, crop: str | None, slice_: str | None) -> Image:
    """The image as the options ask for it."""
    return load_image(
        path,
        volume=volume,
        slice_=None if slice_ is None else parse_slice(slice_),
        crop=None if crop is None else parse_crop(crop),
    )


def _mesh_file(path: Path) -> MeshFile:
    """A mesh of the user's, with a warning if its cells had to be turned."""
    loaded = load_mesh(path)
    if loaded.n_turned:
        _show_warning(f"{path}: {loaded.n_turned} cells were inverted in the file and have been turned")
    return loaded


def _warn_of_other_image(loaded: MeshFile, mesh_path: Path, image_path: Path) -> None:
    made_from = loaded.field_data.get("image_sha256")
    if made_from is not None and str(made_from[0]) != sha256(image_path):
        _show_warning(f"{mesh_path} was made from another image than {image_path}")


def _check_no_input(output: Path, *inputs: Path | None) -> None:
    """InputError if the output, which --force may replace, is one of the inputs."""
    for path in inputs:
        if path is not None and output.exists() and path.exists() and output.samefile(path):
            raise InputError(f"{output}: is an input of this command too; write somewhere else")


def _set_threads(threads: int | None) -> None:
    if threads is None:
        return
    most = int(numba.config.NUMBA_NUM_THREADS)
    if not 1 <= threads <= most:
        raise InputError(f"--threads: expected 1 to {most} on this machine, got {threads}")
    numba.set_num_threads(threads)


def _start_name(kind: str) -> str:
    """What an initial mesh is called."""
    return kind if kind == Lattice.octree.value else "lattice"


def _described(source: _Source, initial: Mesh, kind: str) -> str:
    image = source.contrasts[0]
    size = " x ".join(str(s) for s in image.shape)
    spacing = " x ".join(f"{s:.4g}" for s in image.spacing)
    start = f"{_start_name(kind)} of {len(initial.points)} nodes, {len(initial.cells)} cells"
    start += f", edges up to {np.sqrt(squared_edges(initial.points, initial.cells).max()):.3g} mm"
    more = [f"and {len(source.paths) - 1} more"] if len(source.paths) > 1 else []
    more += ["labels"] if source.labels is not None else []
    more += [f"within a mask of {source.wanted.n_voxels} voxels"] if source.mask is not None else []
    return ", ".join([f"{source.paths[0]}: {size} voxels of {spacing} mm", *more]) + f"; {start}"


def _promises(
    wanted: Content, result: Optimized, min_dihedral: float, target_error: float | None, found: dict[str, Any]
) -> int:
    """0 if the mesh covers what it should, keeps the floor on angles and has the error asked; else 1, said aloud."""
    image = wanted.image
    below = 0
    if image.ndim == 3 and result.history[-1].iteration > 0:
        angles = dihedral_angles(result.mesh.points, result.mesh.cells).min(axis=1)
        below = int((angles < min_dihedral - 1e-6).sum())
    if below:
        log.print(
            f"[bold red]tetopt:[/] {below} of {len(angles)} cells have an angle under {min_dihedral:g} degrees, "
            f"down to {angles.min():.2f}; allow more nodes, a lower --k-d, or a lower --min-dihedral"
        )
    share = result.history[-1].E_D / (wanted.variance * wanted.volume or 1.0)
    is_above = target_error is not None and share > target_error
    if is_above:
        log.print(
            f"[bold red]tetopt:[/] {share:.4g} of the image's variance is left in the cells, more than "
            f"{target_error:g}; allow smaller cells or more --iterations, or ask for a number of --nodes"
        )
    is_lost = _says_what_is_lost(found)
    if wanted.region is not None:
        n_voxels = result.history[-1].n_voxels
        overlapping = n_voxels - int((tetopt.cell_of_voxel(image, result.mesh) >= 0).sum())
        if overlapping:
            log.print(
                f"[bold red]tetopt:[/] cells overlap: together they hold {overlapping} voxels twice; allow more nodes, "
                "and please report this"
            )
        return 1 if below or is_above or is_lost or overlapping else 0
    covered = float(volumes(result.mesh.points, result.mesh.cells).sum())
    missed = image.data.size - result.history[-1].n_voxels
    if missed == 0 and abs(covered / image.volume - 1.0) < 1e-9:
        return 1 if below or is_above or is_lost else 0
    log.print(
        f"[bold red]tetopt:[/] the mesh does not cover the image: {missed} voxels are outside, "
        f"its volume is {covered:.9g} of {image.volume:.9g} mm^{image.ndim}; please report this"
    )
    return 1


def _says_what_is_lost(found: dict[str, Any]) -> bool:
    """Name labels of more than 200 voxels that no cell carries, or hardly any, and say where a mask is not met.

    Whether a promise is missed: such a label is lost, or the mesh has little in common with the mask.
    """
    lost = [row for row in found.get("labels", []) if row["is_lost"]]
    large = [str(row["label"]) for row in lost if row["voxels"] > LARGE]
    if large:
        log.print(
            f"[bold red]tetopt:[/] no cell has label {', '.join(large)}, of more than {LARGE} voxels; allow more "
            "nodes, or a higher --label-weight"
        )
    if small := [str(row["label"]) for row in lost if row["voxels"] <= LARGE]:
        _show_warning(f"no cell has label {', '.join(small)}, of {LARGE} voxels or fewer")
    poor = [str(row["label"]) for row in found.get("labels", []) if row["voxels"] > LARGE and row["dice"] < POOR]
    if poor := [label for label in poor if label not in large]:
        first = ", ".join(poor[:5]) + (f" and {len(poor) - 5} more" if len(poor) > 5 else "")
        _show_warning(f"Dice below {POOR} for label {first}: cells are too large for them, or these are no labels")
    mask = found.get("mask")
    if mask is not None and mask["dice"] < MISSED:
        log.print(
            f"[bold red]tetopt:[/] the mesh and the mask overlap only by Dice {mask['dice']:.3f}: cells are larger "
            "than parts of the mask; allow more nodes"
        )
        return True
    if mask is not None and mask["components"] != mask["mesh_components"]:
        _show_warning(
            f"the mask has {mask['components']} pieces, the mesh {mask['mesh_components']}: cells are as large "
            "as parts, or gaps, of the mask; allow more nodes"
        )
    return bool(large)


def _optimized(
    wanted: Content, initial: Mesh, method: Method, ends: float | None, **options: Any
) -> tuple[Optimized, bool]:
    """`optimize` with progress shown, ended in good order at a time or by Ctrl-C; whether by that."""
    iterations = options["iterations"]
    _prepare_kernels(wanted, options["k_D"], method, "nodes" in options)
    run: Callable[..., Optimized] = optimize if method is Method.fast else optimize_paper
    max_seconds = None if ends is None else max(ends - time.perf_counter(), 1e-9)
    with _graceful_interrupt() as is_interrupted, _progress(iterations) as show:
        image = wanted if method is Method.fast else wanted.image
        result = run(image, initial, max_seconds=max_seconds, callback=show, stop=is_interrupted, **options)
        was_interrupted = is_interrupted()
    if iterations == 0:  # the lattice itself, not its nodes put on the sampling grid
        result = result._replace(mesh=initial)
    if result.ended != "iterations":
        words = {
            "converged": "converged: hardly anything changes any more",
            "max_seconds": "out of time: the mesh so far is kept",
            "stopped": "interrupted: the mesh so far is kept",
        }
        log.print(f"{words[result.ended]} (iteration {result.history[-1].iteration} of {iterations})")
    return result, was_interrupted


def _prepare_kernels(image: Content, k_D: float, method: Method, is_graded: bool) -> None:
    """Load the compiled kernels, or compile them, before the clock of the first iteration starts."""
    begin = time.perf_counter()
    with log.status("preparing the kernels (the first run compiles them, one to two minutes) ..."):
        prepare_kernels(image, k_D, method.value, is_graded)
    seconds = time.perf_counter() - begin
    if seconds > 3.0:
        log.print(f"kernels compiled in {seconds:.0f} s; later runs on images of this kind load them from the cache")


@contextlib.contextmanager
def _graceful_interrupt() -> Iterator[Callable[[], bool]]:
    """The first Ctrl-C only raises a flag, which the returned function tells; the second ends the program."""
    pressed: list[int] = []

    def on_interrupt(number: int, frame: FrameType | None) -> None:
        if pressed:
            log.print("interrupted again: no mesh is written")
            raise KeyboardInterrupt
        pressed.append(number)
        log.print("interrupted: finishing the current nodes, then writing the mesh (again to give up)")

    try:
        before = signal.signal(signal.SIGINT, on_interrupt)
    except ValueError:  # not in the main thread, where signals do not arrive either
        yield lambda: False
        return
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _progress(iterations: int) -> Iterator[Callable[[Record], None]]:
    """A function that shows each record: a bar with the remaining time on a terminal, else a line."""
    first: list[Record] = []

    def words(row: Record) -> str:
        first.append(row)
        E_D = f"  E_D {row.E_D / first[0].E_D:.4f}" if first[0].E_D > 0.0 else ""
        return f"E {row.E:.4f}  E_G {row.E_G / first[0].E_G:.4f}{E_D}"

    if log.is_terminal:
        columns = (
            TextColumn("optimising"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            TextColumn("{task.fields[energies]}"),
        )  # fmt: skip
        with Progress(*columns, console=log, transient=True) as bar:
            task = bar.add_task("", total=iterations, energies="")
            yield lambda row: bar.update(task, completed=row.iteration, energies=words(row))
    else:
        yield lambda row: log.print(
            f"iteration {row.iteration:3d}/{iterations}  {words(row)}  {row.n_cells} cells  {row.seconds:.1f} s"
        )


def _print_comparison(wanted: Content, initial: Mesh, result: Optimized, start: str) -> None:
    first, last = result.history[0], result.history[-1]
    before = quality(initial.points, initial.cells)
    after = quality(result.mesh.points, result.mesh.cells)
    table = new_table("", start, "optimised")
    table.add_row("E, combined", f"{first.E:.4f}", f"{last.E:.4f}")
    table.add_row("E_G, of initial", "1.0000", f"{last.E_G / first.E_G:.4f}")
    if first.E_D > 0.0:
        table.add_row("E_D, of initial", "1.0000", f"{last.E_D / first.E_D:.4f}")
    if first.E_D > 0.0 and (spread := wanted.variance * wanted.volume) > 0.0:
        whose = "the image's variance" if wanted.is_plain and wanted.region is None else "all channels' variance"
        table.add_row(f"E_D, share of {whose}", f"{first.E_D / spread:.5f}", f"{last.E_D / spread:.5f}")
    add_quality(table, before, after)
    out.print(table)


@app.command("quality")
def quality_command(
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU or VTK file of tetrahedra or triangles.")],
    image_path: Annotated[
        Path | None, typer.Option("--image", metavar="IMAGE", help="Measure E_D against this image, too.")
    ] = None,
    mask_path: Annotated[
        Path | None, typer.Option("--mask", metavar="MASK", help="How well the boundary follows it; with --image.")
    ] = None,
    labels_path: Annotated[
        Path | None, typer.Option("--labels", metavar="LABELS", help="How well cells keep to them; with --image.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Is it a mesh? With --image, does it fill the box? Exit 1 if not.")
    ] = False,
    volume: VolumeOption = None,
    crop: CropOption = None,
    slice_: SliceOption = None,
    json_path: JsonOption = None,
    force: ForceOption = False,
) -> int:
    """Measure a mesh: shape, angles, bad cells, and how well its cells fit an image."""
    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    if image_path is None and (mask_path is not None or labels_path is not None):
        raise InputError("--mask and --labels: give the --image, too, on whose voxels they are compared")
    loaded = _mesh_file(mesh_path)
    measured = quality(loaded.mesh.points, loaded.mesh.cells)
    found: dict[str, Any] = {}
    content: dict[str, Any] = {"mesh": mesh_path.name, "quality": measured, "n_turned": loaded.n_turned}
    table = new_table("", escape(mesh_path.name))
    add_quality(table, measured)
    if image_path is not None:
        image, beside = _image_and_others(image_path, volume, crop, slice_)
        labels = None if labels_path is None else beside(labels_path, aligned_labels)
        mask = None if mask_path is None else beside(mask_path, aligned_mask)
        fit = _fit(continued(image, mask), loaded.mesh)
        found = fidelity(labels, mask, loaded.mesh, loaded.cell_data.get("label"))
        content |= found
        _warn_of_other_image(loaded, mesh_path, image_path)
        content |= {"image": image_path.name, "fit": fit}
        table.add_row("E_D", f"{fit['E_D']:.6g}")
        if fit["E_D_share_of_variance"] is not None:
            table.add_row("E_D, share of the variance inside", f"{fit['E_D_share_of_variance']:.5f}")
        table.add_row("voxels inside", f"{fit['n_voxels']} of {image.data.size}")
        table.add_row("cells without a voxel", str(fit["n_empty_cells"]))
    is_masked = mask_path is not None or _was_masked(loaded)
    is_box = image_path is not None and not is_masked
    problems = []
    if check:
        problems = tetopt.check_mesh(loaded.mesh, image if is_box else None, is_whole=not is_masked)
    if check:
        content["problems"] = problems
    if json_path is not None:
        save_json(json_path, content)
    out.print(table)
    _print_fidelity(found)
    for problem in problems:
        log.print(f"[bold red]tetopt:[/] {escape(str(mesh_path))}: {escape(problem)}")
    if check and not problems:
        words = ", in one piece, fills the box" if is_box else ", in one piece"
        words = "; made within a mask, which may have pieces" if is_masked else words
        out.print(f"checked: conforming, oriented{words}")
    if problems:
        return 1
    if image_path is not None and fit["n_voxels"] > image.data.size:
        log.print(
            f"[bold red]tetopt:[/] cells overlap: together they hold {fit['n_voxels']} voxels, more than there are"
        )
        return 1
    return 0


def _was_masked(loaded: MeshFile) -> bool:
    """Whether the file says that it was made within a mask or without a background."""
    if "inputs" not in loaded.field_data:
        return False
    inputs = json.loads(str(loaded.field_data["inputs"][0]))
    return inputs.get("mask") is not None or inputs.get("background") is not None


def _fit(image: Image, mesh: Mesh) -> dict[str, Any]:
    """E_D of a mesh, absolute and as share of the variance of the voxels that it covers."""
    moments = tetopt.cell_moments(image, mesh)
    E_D = float((moments.n_voxels * moments.variance).sum()) * image.voxel_volume
    n_voxels = int(moments.n_voxels.sum())
    if n_voxels == 0:
        raise InputError("mesh and image: no voxel centre lies inside the mesh; do both lie in the same world mm?")
    mean = float((moments.n_voxels * moments.mean).sum()) / n_voxels
    spread = E_D + float((moments.n_voxels * (moments.mean - mean) ** 2).sum()) * image.voxel_volume
    return {
        "E_D": E_D,
        "E_D_share_of_variance": E_D / spread if spread > 0.0 else None,
        "n_voxels": n_voxels,
        "n_empty_cells": int((moments.n_voxels == 0).sum()),
    }


@app.command("phantom")
def phantom_command(
    name: Annotated[str, typer.Argument(metavar="NAME_OR_TOML", help="A phantom's name, or a TOML file of your own.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="IMAGE.nii.gz", help="The image to write.")],
    voxel_mm: Annotated[float | None, typer.Option(metavar="MM", help="Voxel size instead of the phantom's.")] = None,
    blur_mm: Annotated[float | None, typer.Option(metavar="MM", help="Standard deviation of a Gaussian blur.")] = None,
    noise_sd: Annotated[float | None, typer.Option(metavar="SD", help="Standard deviation of added noise.")] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of the noise.")] = None,
    labels: Annotated[
        Path | None,
        typer.Option(metavar="LABELS.nii.gz", help="Write the label of each voxel's centre, too."),
    ] = None,
    force: ForceOption = False,
) -> int:
    """Write a phantom as an image: known shapes, known intensities."""
    suffixes = (".nii", ".nii.gz")
    output = checked_output(output, suffixes, force)
    if labels is not None:
        labels = checked_output(labels, suffixes, force)
        if labels.resolve() == output.resolve():
            raise InputError(f"{labels}: --labels and --output name the same file")
    phantom = load_phantom(name)
    image = phantom.image(voxel_mm=voxel_mm, blur_mm=blur_mm, noise_sd=noise_sd, seed=seed)
    save_image(output, image)
    if labels is not None:
        save_image(labels, phantom.label_image(voxel_mm=voxel_mm))
    size = " x ".join(str(s) for s in image.shape)
    out.print(escape(f"{output}: {phantom.name}, {size} voxels, {image.data.min():g} to {image.data.max():g}"))
    return 0


@app.command("fem")
def fem_command(
    image_path: ImageArgument,
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU or VTK file that fills the image's box.")],
    young: Annotated[
        str | None,
        typer.Option(
            metavar="LAW",
            help='Modulus in kPa by intensity: a table "0:1,100:5", interpolated, or a formula of h, such as '
            '"0.5 + 0.01*h" or "1/max(abs(h), 0.001)" of a strain image. Default: the intensity.',
        ),
    ] = None,
    nu: Annotated[float, typer.Option(metavar="NU", help="Poisson's ratio, above -1 and below 0.5.")] = 0.45,
    compress: Annotated[float, typer.Option(metavar="PERCENT", help="How far the bottom is pushed in.")] = 1.0,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="PRESSED.vtu", help="Write the mesh with displacements and strains."),
    ] = None,
    volume: VolumeOption = None,
    crop: CropOption = None,
    slice_: SliceOption = None,
    json_path: JsonOption = None,
    force: ForceOption = False,
) -> int:
    """Compress a mesh, one modulus a cell: conditioning of the stiffness matrix, strain energy, CG iterations.

    The face of the image's box with the largest z is held, the one opposite is pushed in along z; both are bonded:
    their nodes cannot slide sideways. In 2-D y takes the place of z, in plane stress, 1 mm thick. Linear cells lock
    near nu = 0.5: above 0.49 they are far too stiff.
    """
    from tetopt.experiments.paper import simulate
    from tetopt.fem.elasticity import strains
    from tetopt.fem.materials import parse_law

    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    if output is not None:
        output = checked_output(output, (".vtu",), force)
        _check_no_input(output, mesh_path)
    if not 0.0 < compress <= 50.0:
        raise InputError(f"--compress: expected a percentage above 0 and up to 50, got {compress:g}")
    law = None if young is None else parse_law(young)
    image = _image(image_path, volume, crop, slice_)
    loaded = _mesh_file(mesh_path)
    try:
        found, pressed = simulate(image, loaded.mesh, nu=nu, percent=compress, law=law)
    except RuntimeError as error:
        raise InputError(f"{error}; the moduli differ too much, or nu is too near 0.5, for this mesh") from error
    if output is not None:
        fields = {"young": found.young, "strain": strains(loaded.mesh, pressed.u).reshape(len(found.young), -1)}
        save_mesh(output, loaded.mesh, fields, {"tetopt": tetopt.__version__}, {"displacement": pressed.u})
    table = new_table("", escape(mesh_path.name))
    table.add_row("nodes", str(len(loaded.mesh.points)))
    table.add_row("modulus of the cells, kPa", f"{found.young.min():.4g} to {found.young.max():.4g}")
    unit = "mN/mm" if loaded.mesh.ndim == 3 else "mN/mm per mm of thickness"
    table.add_row(f"largest eigenvalue of the stiffness, {unit}", f"{found.lambda_max:.6g}")
    table.add_row("condition number, 2-norm", f"{found.cond:.6g}")
    table.add_row("Jacobi CG iterations to 1e-10", str(found.cg_iterations))
    table.add_row(f"strain energy at {compress:g} %, uJ", f"{found.strain_energy:.6g}")
    out.print(table)
    if json_path is not None:
        options = {
            "young": young, "nu": nu, "compress_percent": compress, "volume": volume, "crop": crop, "slice": slice_
        }  # fmt: skip
        files = {"image": image_path.name, "image_sha256": sha256(image_path), "mesh": mesh_path.name}
        size = {"n_nodes": len(loaded.mesh.points), "n_cells": len(loaded.mesh.cells)}
        numbers = {key: value for key, value in found._asdict().items() if key != "young"}
        moduli = {"young_kPa_min": found.young.min(), "young_kPa_max": found.young.max()}
        units = {"lambda_max": "mN/mm", "strain_energy": "uJ"}
        save_json(
            json_path,
            {**files, "versions": versions(), "options": options, **size, **moduli, **numbers, "units": units},
        )
    return 0


@app.command("segment")
def segment_command(
    image_path: ImageArgument,
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU or VTK file over the image.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LABELS.nii.gz", help="The labels to write.")],
    classes: Annotated[int, typer.Option(metavar="K", min=2, help="Number of classes, by rising mean.")] = 4,
    truth_path: Annotated[
        Path | None, typer.Option("--truth", metavar="LABELS", help="True labels: print the Dice overlap with them.")
    ] = None,
    volume: VolumeOption = None,
    crop: CropOption = None,
    slice_: SliceOption = None,
    json_path: JsonOption = None,
    force: ForceOption = False,
) -> int:
    """Segment an image by its mesh, fast and roughly: cells grouped by mean into K classes, painted to the voxels."""
    from tetopt.segmentation import dice, segmented, stands_for, thresholded

    output = checked_output(output, (".nii", ".nii.gz"), force)
    _check_no_input(output, image_path, truth_path)
    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    image = _image(image_path, volume, crop, slice_)
    truth = None if truth_path is None else (truth_path.name, _labels(truth_path, image, crop, slice_))
    loaded = _mesh_file(mesh_path)
    _warn_of_other_image(loaded, mesh_path, image_path)
    if tetopt.cell_moments(image, loaded.mesh).n_voxels.sum() > image.data.size:
        raise InputError(f"{mesh_path}: its cells overlap: together they hold more voxels than there are")
    outside = int((tetopt.cell_of_voxel(image, loaded.mesh) < 0).sum())
    if outside == image.data.size:
        raise InputError(f"{mesh_path}: no voxel of {image_path} lies in it; was it made from another image?")
    if outside:
        _show_warning(f"{outside} of {image.data.size} voxels lie outside the mesh and get class 0")
    labels = segmented(image, loaded.mesh, classes)
    share = np.bincount(labels.data.astype(np.int64).ravel(), minlength=classes) / labels.data.size
    content: dict[str, Any] = {
        "image": image_path.name, "mesh": mesh_path.name, "classes": classes, "share_of_voxels": share
    }  # fmt: skip
    means = [float(image.data[labels.data == number].mean()) if part else None for number, part in enumerate(share)]
    content["mean_intensity"] = means
    table = new_table(
        "class", "share of the voxels", "mean intensity", *([] if truth is None else ["stands for label"])
    )
    meaning = {} if truth is None else stands_for(labels, truth[1])
    for number, part in enumerate(share):
        mean = "" if means[number] is None else f"{means[number]:.4g}"
        table.add_row(str(number), f"{part:.4f}", mean, *([] if truth is None else [str(meaning.get(number, "none"))]))
    overlaps = new_table("label", "Dice, mesh", "Dice, thresholded voxels")
    if truth is not None:
        by_mesh, by_voxels = dice(labels, truth[1]), dice(thresholded(image, classes), truth[1])
        content |= {"truth": truth[0], "stands_for": meaning, "dice": {"mesh": by_mesh, "voxels": by_voxels}}
        lost = [str(label) for label in by_mesh if label not in meaning.values()]
        if lost:
            _show_warning(f"no class stands for label {', '.join(lost)}: its Dice is 0; try more --classes")
        for label in by_mesh:
            overlaps.add_row(str(label), f"{by_mesh[label]:.4f}", f"{by_voxels[label]:.4f}")
    save_image(output, labels)
    if json_path is not None:
        save_json(json_path, content)
    out.print(table)
    if truth is not None:
        out.print(overlaps)
    out.print(escape(f"{output}: {classes} classes on {labels.data.size} voxels"))
    return 0


@app.command("paper")
def paper_command(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")],
    image_path: Annotated[
        Path | None, typer.Option("--image", metavar="T1", help="Brain MR volume (default: nilearn's MNI152 T1).")
    ] = None,
    labels_path: Annotated[
        Path | None, typer.Option("--labels", metavar="LABELS", help="Tissue labels of IMAGE, for Dice.")
    ] = None,
    seeds: Annotated[int, typer.Option(metavar="N", help="Random meshes for Fig. 1.")] = 200,
    force: ForceOption = False,
) -> int:
    """Run the paper's figures and table again: paper.json, pictures, a page with each printed number beside ours."""
    from tetopt.experiments import run_paper

    if seeds < 1:
        raise InputError(f"--seeds: expected 1 or more, got {seeds}")
    volume = _volume(mni_path("t1") if image_path is None else image_path, None, None)
    tissue = None if labels_path is None else _labels(labels_path, volume)
    if image_path is None and labels_path is None:
        tissue = mni_tissue()
    run_paper.check_inputs(volume, tissue)
    if tissue is None:
        log.print("no --labels: the section on approximate segmentation is left out")
    paths = run_paper.outputs(_results_folder(output), force)
    source = mni_path("t1") if image_path is None else image_path
    about = {
        "image": source.name,
        "image_sha256": sha256(source),
        "labels": None if tissue is None else "MNI152 tissue",
    }
    if labels_path is not None:
        about["labels"] = labels_path.name
    results = run_paper.run(paths, about, volume, tissue, seeds, lambda text: log.print(escape(text)))
    out.print(escape(f"{paths['paper.html']}: the paper's numbers beside ours, in {results['seconds']:.0f} s"))
    return 0


def _labels(path: Path, image: Image, crop: str | None = None, slice_: str | None = None) -> Image:
    """A label image, cut as the image was; InputError unless it lies on the image's voxels."""
    labels = _image(path, None, crop, slice_)
    if labels.shape != image.shape or not np.allclose(labels.affine, image.affine, atol=1e-4):
        raise InputError(
            f"{path}: expected labels on the image's own voxels, {image.shape} with its affine, got {labels.shape}; "
            "resample them to the image first"
        )
    check_labels(str(path), labels)
    return labels


@app.command("baseline")
def baseline_command(
    image_path: ImageArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MESH.vtu", help="The mesh to write.")],
    pipeline: Annotated[Baseline, typer.Option(help="The mesher of the conventional pipeline.")] = Baseline.pytetwild,
    nodes: Annotated[int, typer.Option(metavar="N", min=20, help="Wanted number of nodes.")] = 5000,
    labels_path: Annotated[
        Path | None, typer.Option("--labels", metavar="LABELS", help="Label image instead of a segmentation of IMAGE.")
    ] = None,
    classes: Annotated[int, typer.Option(metavar="K", min=2, help="Classes of the segmentation (multi-Otsu).")] = 4,
    volume: VolumeOption = None,
    crop: CropOption = None,
    json_path: JsonOption = None,
    force: ForceOption = False,
) -> int:
    """Mesh an image the conventional way, to compare with: segment, extract surfaces, tetrahedralise."""
    from tetopt.baseline.pipelines import PIPELINES, Job

    output = checked_output(output, (".vtu",), force)
    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    image = _volume(image_path, volume, crop)
    labels = None if labels_path is None else _labels(labels_path, image, crop)
    made = PIPELINES[pipeline.value](Job(image, labels, nodes, classes))
    measured = quality(made.mesh.points, made.mesh.cells)
    options = {"pipeline": pipeline.value, "nodes": nodes, "classes": classes}
    about = {"image": image_path.name, "image_sha256": sha256(image_path), "options": options}
    save_mesh(output, made.mesh, cell_fields(made.mesh, image), {"tetopt": tetopt.__version__, **about})
    if json_path is not None:
        fit = _fit(image, made.mesh)
        save_json(json_path, about | {"seconds": made.seconds, "notes": made.notes, "fit": fit, "quality": measured})
    for note in made.notes:
        log.print(escape(f"note: {note}"))
    table = new_table("", escape(output.name))
    add_quality(table, measured)
    for step, seconds in made.seconds.items():
        table.add_row(f"seconds, {step}", f"{seconds:.1f}")
    out.print(table)
    return 0


@app.command("compare")
def compare_command(
    context: typer.Context,
    image_path: ImageArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")],
    nodes: Annotated[int, typer.Option(metavar="N", min=20, help="Wanted number of nodes, of every mesh.")] = 5000,
    labels_path: Annotated[
        Path | None,
        typer.Option("--labels", metavar="LABELS", help="Label image, for tetopt and the pipelines that segment."),
    ] = None,
    repeats: Annotated[int, typer.Option(metavar="R", min=1, help="Runs of a mesher whose result varies.")] = 3,
    pipelines: Annotated[
        str,
        typer.Option(
            metavar="A,B,...",
            help="Of tetopt, tetopt-uniform, tetopt-paper, pytetwild, cleaver, bcc, odt: which, in order.",
        ),
    ] = "tetopt,tetopt-uniform,tetopt-paper,pytetwild,cleaver,bcc,odt",
    k_D: Annotated[float, typer.Option("--k-d", metavar="K", help="Weight of the image on uniform meshes.")] = 0.2,
    classes: Annotated[int, typer.Option(metavar="K", min=2, help="Classes of the segmentation (multi-Otsu).")] = 4,
    young: Annotated[
        str | None,
        typer.Option(metavar="LAW", help="Modulus by intensity, as for `fem`. Default: 1 to 10 kPa over its range."),
    ] = None,
    curve: Annotated[
        str, typer.Option(metavar="F,...", help="Node counts of the error curves, as parts of N; empty for none.")
    ] = "0.25,0.5,2",
    tradeoff: Annotated[
        bool, typer.Option("--tradeoff", help="Sweep tetopt's options around its defaults: some 20 more runs.")
    ] = False,
    reference_dofs: Annotated[
        int, typer.Option(metavar="D", min=1000, help="Size of the voxel grid that is the truth of the simulation.")
    ] = 300_000,
    max_seconds: Annotated[float, typer.Option(metavar="S", help="Time limit of one run of a pipeline.")] = 3600.0,
    max_gb: Annotated[float | None, typer.Option(metavar="GB", help="Memory limit of one run of a pipeline.")] = None,
    volume: VolumeOption = None,
    crop: CropOption = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep the finished runs of an interrupted comparison.")
    ] = False,
    force: ForceOption = False,
) -> int:
    """Set tetopt beside the conventional pipelines on a volume: fidelity, shape, simulation accuracy, time."""
    from tetopt.experiments import compare, run_compare
    from tetopt.fem.materials import parse_law

    if not 0.0 <= k_D < 1.0:
        raise InputError(f"--k-d: expected 0 <= k_D < 1, got {k_D}")
    for name, limit in (("--max-seconds", max_seconds), ("--max-gb", max_gb)):
        if limit is not None and not 0.0 < limit < float("inf"):
            raise InputError(f"{name}: expected more than 0, got {limit}")
    image = _volume(image_path, volume, crop)
    labels = None if labels_path is None else _labels(labels_path, image, crop)
    law, law_words = compare.default_law(image) if young is None else (parse_law(young), young)
    settings = compare.Settings(
        nodes=nodes, pipelines=tuple(name.strip() for name in pipelines.split(",")), repeats=repeats, classes=classes,
        k_D=k_D, reference_dofs=reference_dofs, curve=_parse_curve(curve), tradeoff=tradeoff, max_seconds=max_seconds,
        max_bytes=None if max_gb is None else int(max_gb * 1e9),
    )  # fmt: skip
    about = {
        "command": f"tetopt {' '.join(map(shlex.quote, context.obj))}",
        "image": {"name": image_path.name, "sha256": sha256(image_path), "volume": volume, "crop": crop},
        "labels": None
        if labels_path is None
        else {"name": labels_path.name, "kind": "given", "sha256": sha256(labels_path)},
        "law": law_words,
    }
    paths = run_compare.outputs(_results_folder(output), force or resume)
    if (output / "runs").is_dir() and not (resume or force):
        raise InputError(f"{output / 'runs'}: finished runs are there; --resume keeps them, --force starts over")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the child is ended with us
    try:
        results = run_compare.run(
            paths, about, image, labels, law, settings, lambda text: log.print(escape(text)), resume=resume
        )
    except KeyboardInterrupt:
        log.print(f"interrupted: {escape(str(output / 'runs'))} keeps the finished runs, --resume goes on from there")
        return 130
    failed = [p["title"] for p in results["pipelines"] if p["failure"] is not None]
    words = f", of which failed: {', '.join(failed)}" if failed else ""
    out.print(escape(f"{paths['report.html']}: {len(settings.pipelines)} pipelines{words}, {results['seconds']:.0f} s"))
    return 0


def _volume(path: Path, volume: int | None, crop: str | None) -> Image:
    """A 3-D image; InputError for a picture."""
    image = _image(path, volume, crop, None)
    if image.ndim != 3:
        raise InputError(f"{path}: expected a volume, got a {image.ndim}-D image")
    return image


def _parse_curve(text: str) -> tuple[float, ...]:
    try:
        factors = tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        factors = (0.0,)
    if any(not 0.0 < factor < 100.0 for factor in factors):
        raise InputError(f'--curve: expected parts of the node count, such as "0.25,0.5,2", got "{text}"')
    return factors


@app.command("demo")
def demo_command(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.")] = Path(
        "demo"
    ),
    nodes: Annotated[int, typer.Option(metavar="N", help="Wanted number of nodes.")] = 5000,
    iterations: Annotated[int | None, typer.Option(metavar="I", min=0, help="Sweeps over all nodes.")] = None,
    force: ForceOption = False,
) -> int:
    """Mesh the MNI152 T1 that nilearn's wheel carries; leave mesh, numbers and pictures in a folder."""
    source = mni_path("t1")
    return mesh_command(
        [source],
        _results_folder(output) / "mesh.vtu",
        nodes=nodes,
        iterations=iterations,
        json_path=output / "run.json",
        figures=output,
        force=force,
    )


def _results_folder(path: Path) -> Path:
    """`path`, made if it is not there."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: expected a folder for the results, found a file")
    path.mkdir(parents=True, exist_ok=True)
    return path
