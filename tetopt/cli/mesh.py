"""``tetopt mesh`` and ``tetopt demo``."""

from __future__ import annotations

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape

import tetopt
from tetopt import Image, InputError, Mesh
from tetopt.cli.console import log, out, print_fidelity, show_warning
from tetopt.cli.inputs import check_no_input, read_companion, read_mesh, results_folder, set_threads
from tetopt.cli.options import (
    BinsOption,
    CropOption,
    ForceOption,
    ImagesArgument,
    JsonOption,
    LabelsOption,
    LoadOption,
    MaskOption,
    Method,
    NuOption,
    OrderOption,
    SetOption,
    SliceOption,
    SpaceOption,
    ThreadsOption,
    UnitsOption,
    VolumeOption,
    YoungOption,
)
from tetopt.cli.promises import check_promises, warn_of_result
from tetopt.cli.run import watched_optimize
from tetopt.cli.solver import (
    NOTHING,
    Wishes,
    all_sets,
    built,
    check_early,
    checked_wishes,
    print_model,
    save_anyway,
    save_wished,
)
from tetopt.cli.source import Source, read_source
from tetopt.engine.fast import check_options
from tetopt.engine.loop import (
    GRADED_ITERATIONS,
    GRADED_K_D,
    MIN_DIHEDRAL,
    SHAPE_POWER,
    START_K_D,
    UNIFORM_ITERATIONS,
    UNIFORM_K_D,
    Optimized,
)
from tetopt.engine.meshing import FIRST_NODES, meshed_to_error
from tetopt.engine.paper import default_n_t
from tetopt.geometry.simplex import centroids, squared_edges
from tetopt.io.files import checked_output, save_json
from tetopt.io.formats import FORMATS, format_of
from tetopt.io.meshes import MeshFile
from tetopt.io.mni import mni_path
from tetopt.io.vtk import box_text
from tetopt.measure.fidelity import cell_labels
from tetopt.measure.quality import quality
from tetopt.model.fields import cell_fields
from tetopt.model.model import Model
from tetopt.model.sets import Sets, box_of, surviving_sets
from tetopt.report.summary import fidelity, model_summary, run_summary
from tetopt.report.tables import add_quality, new_table
from tetopt.start.clip import lattice_within
from tetopt.start.lattice import KINDS
from tetopt.start.octree import nearest_octree, octree
from tetopt.target.content import Content, continued

DEFAULT_NODES = {2: 500, 3: 5000}


class Lattice(StrEnum):  # noqa: D101
    bcc = "bcc"
    five_tet = "five-tet"
    criss_cross = "criss-cross"
    octree = "octree"


class Boundary(StrEnum):  # noqa: D101
    slide = "slide"
    fixed = "fixed"


class Retessellate(StrEnum):  # noqa: D101
    first = "first"
    accept = "accept"
    never = "never"


def mesh_command(
    image_paths: ImagesArgument,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="MESH", help=f"The mesh to write: {', '.join(FORMATS)}.")
    ],
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
    start: Annotated[
        Path | None,
        typer.Option(metavar="MESH", help="Improve this mesh, its boundary kept, instead of making a new one."),
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
            help="Weight of the image: 0 shape only; 0.9 image first (default 0.85; --uniform 0.2; --start 0.02).",
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
    boundary: Annotated[
        Boundary | None, typer.Option(help="What the boundary's nodes may do (default slide; with --start fixed).")
    ] = None,
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
    young: YoungOption = None,
    nu: NuOption = None,
    bins: BinsOption = None,
    sets: SetOption = None,
    loads: LoadOption = None,
    order: OrderOption = 1,
    units: UnitsOption = "kPa",
    space: SpaceOption = "ras",
    force: ForceOption = False,
) -> int:
    """Mesh an image: nodes where it has content (or a uniform lattice), optimised, for a solver or as VTU."""
    begin = time.perf_counter()
    format_of(output)
    output = checked_output(output, tuple(FORMATS), force)
    wishes = Wishes(young, nu, bins, list(sets or []), list(loads or []), order, units, space)
    checked_wishes(output, wishes)
    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    numbers = {"--nodes": nodes, "--spacing": spacing, "--target-error": target_error}
    if len(given := [name for name, value in numbers.items() if value is not None]) > 1:
        raise InputError(f"{' and '.join(given)}: give one of them")
    is_graded = _is_graded(lattice_kind, uniform, spacing, method) and start is None
    if start is not None:
        others = {**numbers, "--lattice": lattice_kind, "--mask": mask, "--background": background}
        _check_start(start, others, uniform, method)
        check_no_input(output, start)
    limits = {"--size-min": size_min, "--size-max": size_max, "--gradation": gradation, "--sizing": sizing}
    for name, value in {**limits, "--target-error": target_error}.items():
        if value is not None and not is_graded:
            raise InputError(
                f"{name}: only on a graded mesh; leave out --uniform, --spacing, --lattice, --method, --start"
            )
    if k_D is None:
        k_D = GRADED_K_D if is_graded else UNIFORM_K_D if start is None else START_K_D
    iterations = (GRADED_ITERATIONS if is_graded else UNIFORM_ITERATIONS) if iterations is None else iterations
    if not 0.0 <= k_D < 1.0:
        raise InputError(f"--k-d: expected 0 <= k_D < 1, got {k_D}")
    if max_seconds is not None and not max_seconds > 0.0:
        raise InputError(f"--max-seconds: expected more than 0, got {max_seconds}")
    if boundary is None:
        boundary = Boundary.slide if start is None else Boundary.fixed
    options: dict[str, Any] = {"k_D": k_D, "iterations": iterations, "boundary": boundary.value}
    _check_method(method, {"--n-t": n_t, "--retessellate": retessellate}, Method.paper)
    _check_method(method, {"--shape-power": shape_power, "--min-dihedral": min_dihedral}, Method.fast)
    if method is Method.paper:
        options["n_t"] = default_n_t(k_D, iterations) if n_t is None else n_t
        options["retessellate"] = Retessellate.first.value if retessellate is None else retessellate.value
    else:
        options["shape_power"] = SHAPE_POWER if shape_power is None else shape_power
        options["min_dihedral"] = MIN_DIHEDRAL if min_dihedral is None else min_dihedral
        check_options(**options)
    names = ["slice.png", "rho.png", "energies.png"]
    names += [] if mask is None and background is None else ["boundary.png"]
    names += [] if labels is None else ["labels.png"]
    pictures = [] if figures is None else [checked_output(figures / name, (".png",), force) for name in names]
    if method is Method.paper and (len(image_paths) > 1 or mask or background or labels):
        raise InputError("--method paper: takes one IMAGE and its whole box; leave out mask, labels and further ones")
    set_threads(threads)
    source = read_source(image_paths, volume, crop, slice_, mask, background, labels, weights, label_weight)
    wanted = source.wanted
    image = wanted.image
    started = None if start is None else read_mesh(start)
    initial: Mesh | None
    if started is not None:
        initial, kind = started.mesh, "start"
        _check_place(started.mesh, source.contrasts[0], str(start))
    elif is_graded:
        sizes = _sizes(size_min, size_max, gradation, sizing)
        if nodes is None and target_error is None:  # fewer on small images
            nodes = int(np.clip(wanted.n_voxels // 8, 2 ** (image.ndim + 2), DEFAULT_NODES[image.ndim]))
        if size_max is None and nodes is not None:  # what holds then is told with the other numbers
            size_max = (tetopt.Sizes() if sizes is None else sizes).longest_edge(image, nodes, wanted.volume)
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
        "start": None if start is None else start.name,
    }  # fmt: skip
    source.about["box"] = box_text(box_of(source.contrasts[0]))
    if wishes.are_any() or output.suffix.lower() != ".vtu":
        probe = nearest_octree(wanted, FIRST_NODES[image.ndim], sizes) if initial is None else initial
        check_early(output, wishes, image, lambda early: _model(source, probe, started, early, {}, is_told=False))
    return _mesh_files(source, initial, started, options, settings, wishes, output, json_path, pictures, begin)


def _check_start(start: Path, others: dict[str, Any], uniform: bool, method: Method) -> None:
    """InputError for options that ask for another mesh than the given one."""
    given = [name for name, value in (others | {"--uniform": uniform or None}).items() if value is not None]
    if given:
        raise InputError(f"--start and {given[0]}: {start} has its nodes and its boundary already; leave one out")
    if method is Method.paper:
        raise InputError("--start: only with --method fast, whose moves keep a boundary that is not convex")


def _check_place(mesh: Mesh, image: Image, path: str) -> None:
    """InputError for a mesh off the image, a warning for one that lies partly beside it."""
    if mesh.ndim != image.ndim:
        raise InputError(f"{path}: expected a {image.ndim}-D mesh, as the image is, got a {mesh.ndim}-D one")
    index = image.to_index(centroids(mesh.points, mesh.cells))
    is_in = ((index >= -0.5) & (index <= np.array(image.shape) - 0.5)).all(axis=1)
    if not is_in.any():
        raise InputError(f"{path}: lies beside the image; do both lie in the same world mm (RAS+)?")
    if not is_in.all():
        show_warning(f"{path}: {np.mean(~is_in):.1%} of its cells lie beside the image, where it has no say")


def _model(
    source: Source, mesh: Mesh, started: MeshFile | None, wishes: Wishes, about: dict[str, Any], is_told: bool = True
) -> Model:
    """The mesh with all that the options say of it."""
    fields = _fields(source, mesh)
    given = Sets({}, {}) if started is None else surviving_sets(started.mesh, started.sets, mesh)
    if started is not None and is_told:
        lost = [name for kind in (0, 1) for name in started.sets[kind] if name not in given[kind]]
        if source.labels is not None:  # of which these are made anew
            lost = [name for name in lost if not name.startswith(("label_", "interface_"))]
        if lost:
            log.print(escape(f"not kept, as their cells or facets are others now: the sets {', '.join(lost)}"))
        if "young" in started.cell_data or started.text("loads") is not None:
            log.print("moduli and loads of the mesh that is improved are not kept; give --young and --load")
    known = all_sets(mesh, box_of(source.contrasts[0]), fields, given, is_told)
    return built(mesh, source.wanted.image, wishes, fields, about, known)


def _check_method(method: Method, given: dict[str, Any], wanted: Method) -> None:
    """InputError for an option of the other method."""
    wrong = [name for name, value in given.items() if value is not None]
    if wrong and method is not wanted:
        raise InputError(f"{wrong[0]}: only with --method {wanted.value}, got --method {method.value}")


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
        None if sizing is None else read_companion(sizing),
    )  # fmt: skip


def _mesh_files(
    source: Source,
    initial: Mesh | None,
    started: MeshFile | None,
    options: dict[str, Any],
    settings: dict[str, Any],
    wishes: Wishes,
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
        result, is_interrupted = watched_optimize(wanted, mesh, Method(settings["method"]), ends, **options | graded)
        interrupted.append(is_interrupted)
        return result

    if initial is None:
        result = meshed_to_error(wanted, settings["target_error"], options["sizes"], run)
        options["nodes"], initial = result.nodes, result.initial
        assert initial is not None
    else:
        result = run(initial, options.get("nodes"))
    is_interrupted = any(interrupted)
    optimized = time.perf_counter()
    told = {name: value for name, value in (settings | options).items() if name != "sizes"}
    about = {**source.about, "options": told}
    try:
        model = _model(source, result.mesh, started, wishes, about)
        save_wished(output, model, wishes)
    except InputError as error:  # hours may have gone into the mesh
        bare = _model(source, result.mesh, started, NOTHING, about, is_told=False)
        raise save_anyway(output, bare, error) from error
    fields = model.cell_data
    found = fidelity(source.labels, source.mask, result.mesh, fields.get("label"))
    if not wanted.is_plain or wanted.region is not None:
        found["contrasts"] = _by_contrast(source, result.mesh, fields)
    if json_path is not None:
        seconds = {"load": loaded - begin, "optimize": optimized - loaded, "all": time.perf_counter() - begin}
        save_json(json_path, run_summary(wanted, initial, result, about, seconds) | found | model_summary(model))
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
    floor = options.get("min_dihedral", 0.0)
    code = check_promises(wanted, result, floor, settings["target_error"], found, started and started.mesh)
    code = 130 if is_interrupted else code
    n_empty = 0 if image.data.min() == image.data.max() else int((fields["n_voxels"] == 0).sum())
    asked = options.get("nodes") if settings["target_error"] is None else None
    warn_of_result(result, Method(settings["method"]), asked, n_empty)
    _print_comparison(wanted, initial, result, _start_name(settings["lattice"]))
    print_fidelity(found)
    if wishes.are_any() or output.suffix.lower() != ".vtu":
        print_model(output, model, wishes)
    else:
        out.print(escape(f"{output}: {len(result.mesh.points)} nodes, {len(result.mesh.cells)} cells"))
    if json_path is not None:
        out.print(escape(f"{json_path}: every number of the run"))
    for path in pictures:
        out.print(escape(str(path)))
    return code


def _described(source: Source, initial: Mesh, kind: str) -> str:
    image = source.contrasts[0]
    size = " x ".join(str(s) for s in image.shape)
    spacing = " x ".join(f"{s:.4g}" for s in image.spacing)
    start = f"{_start_name(kind)} of {len(initial.points)} nodes, {len(initial.cells)} cells"
    start += f", edges up to {np.sqrt(squared_edges(initial.points, initial.cells).max()):.3g} mm"
    more = [f"and {len(source.paths) - 1} more"] if len(source.paths) > 1 else []
    more += ["labels"] if source.labels is not None else []
    more += [f"within a mask of {source.wanted.n_voxels} voxels"] if source.mask is not None else []
    return ", ".join([f"{source.paths[0]}: {size} voxels of {spacing} mm", *more]) + f"; {start}"


def _start_name(kind: str) -> str:
    """What an initial mesh is called."""
    return kind if kind in (Lattice.octree.value, "start") else "lattice"


def _fields(source: Source, mesh: Mesh) -> dict[str, NDArray]:
    """What the file holds of each cell: as `cell_fields`, means of further contrasts, and the label."""
    fields = cell_fields(mesh, source.wanted.image)
    for number, contrast in enumerate(source.contrasts[1:], 2):
        moments = tetopt.cell_moments(continued(contrast, source.mask), mesh)
        fields |= {f"mean_{number}": moments.mean, f"variance_{number}": moments.variance}
    if source.labels is not None:
        fields["label"] = cell_labels(continued(source.labels, source.mask), mesh)
    return fields


def _by_contrast(source: Source, mesh: Mesh, fields: dict[str, NDArray]) -> list[dict[str, Any]]:
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
        results_folder(output) / "mesh.vtu",
        nodes=nodes,
        iterations=iterations,
        json_path=output / "run.json",
        figures=output,
        force=force,
    )
