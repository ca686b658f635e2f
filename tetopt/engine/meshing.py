"""The main entry point: from an image to an optimised mesh, for all initial meshes and engines.

graded   an octree of the image's content, then the fast engine with exchanges of nodes
uniform  a lattice, then the fast engine
paper    a lattice, then the paper's scheme
start    the user's mesh, improved by the fast engine within its boundary
"""

from __future__ import annotations

import inspect
import time
from collections import Counter
from collections.abc import Callable
from difflib import get_close_matches
from functools import partial
from math import ceil, prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, plain
from tetopt.contents.content import content as make_content
from tetopt.engine.aim import (
    QUADRATIC_NODES,
    Aim,
    Mode,
    SearchRun,
    best_of,
    may_differ,
    most_corners,
    next_corners,
    nodes_per_corner,
)
from tetopt.engine.curving import curve_mesh
from tetopt.engine.fast import optimize
from tetopt.engine.loop import (
    CUT_SHORT,
    DEFAULT_NODES,
    GRADED_ITERATIONS,
    GRADED_K_D,
    MIN_DIHEDRAL,
    QUADRATIC_GRADATION,
    QUADRATIC_RATIO,
    START_K_D,
    TARGET_NODES_MAX,
    UNIFORM_ITERATIONS,
    UNIFORM_K_D,
    Boundary,
    MeshingResult,
    deadline,
)
from tetopt.engine.paper import optimize_paper
from tetopt.errors import InputError, Note, warn
from tetopt.geometry.check import check_place
from tetopt.geometry.quadratic import node_count
from tetopt.image import Image
from tetopt.measure.judge import (
    ERROR_REACHED,
    Requirements,
    judge,
    measure,
    unexplained_by,
)
from tetopt.mesh import Mesh
from tetopt.start.carve import carve_mesh, part_of
from tetopt.start.clip import lattice_within
from tetopt.start.label_sizes import SizesByLabel, sizes_by_label
from tetopt.start.memory import LABEL_BYTES, PROCESS_BYTES, READ_BYTES, REGION_BYTES, bytes_of
from tetopt.start.octree import is_near, nearest_octree, nodes_of_sizes, octree_mesh
from tetopt.start.sizes import Sizes
from tetopt.system.arrays import whole_number
from tetopt.system.budget import at_most, check_memory, limit_memory

# an optimisation ready to start; takes further options of `optimize`
Optimisation = Callable[..., MeshingResult]
# makes a run with an optimisation, its initial mesh, the aim and the runs before
Conduct = Callable[[Optimisation, Mesh, Aim, list[SearchRun]], MeshingResult]


class ModeDefaults(NamedTuple):
    """Options of an optimisation that depend on the mode."""

    k_D: float
    iterations: int
    boundary: Boundary = "slide"


MODE_DEFAULTS: dict[Mode, ModeDefaults] = {
    "graded": ModeDefaults(GRADED_K_D, GRADED_ITERATIONS),
    "uniform": ModeDefaults(UNIFORM_K_D, UNIFORM_ITERATIONS),
    "paper": ModeDefaults(UNIFORM_K_D, UNIFORM_ITERATIONS),
    "start": ModeDefaults(START_K_D, UNIFORM_ITERATIONS, "fixed"),
}


def default_options(mode: Mode, keeps_cells: bool, has_region: bool) -> ModeDefaults:
    """Return a mode's defaults; with fixed connectivity those of a graded mesh's last iterations,
    whose boundary follows a mask.
    """
    if keeps_cells:
        return ModeDefaults(GRADED_K_D, UNIFORM_ITERATIONS, "slide" if has_region else "fixed")
    return MODE_DEFAULTS[mode]


MODE_ARGUMENTS: dict[Mode, tuple[str, ...]] = {  # arguments that determine the initial mesh
    "graded": ("nodes", "target_error", "nodes_max", "sizes"),
    "uniform": ("nodes", "spacing", "kind"),
    "paper": ("nodes", "spacing", "kind"),
    "start": ("start",),
}
# In the order in which they are checked.
AIM_NAMES = ("nodes", "target_error", "nodes_max", "spacing", "kind", "start", "sizes")
# of the nodes of equilateral cells: targets are met down to these (docs/understand/sizes.md)
SIZES_MET = 0.9
SHORTEST_SECONDS = 1e-9  # of a run for which the initial mesh leaves no time


def mesh_image(
    image: Image | Content,
    nodes: int | None = None,
    *,
    labels: Image | None = None,
    mask: Image | None = None,
    target_error: float | None = None,
    nodes_max: int | None = None,
    sizes: Sizes | None = None,
    order: int = 1,
    mode: Mode | None = None,
    start: Mesh | None = None,
    spacing: float | None = None,
    kind: str | None = None,
    k_D: float | None = None,
    iterations: int | None = None,
    **options: Any,
) -> MeshingResult:
    """Mesh an image's box with nodes where the image has detail; or uniformly, or improve a mesh.

    Parameters
    ----------
    image : Image or Content
        The intensities h; or a content with several contrasts, weights, labels and a mask
        (`tetopt.content`).
    nodes : int
        Number of nodes, for order 2 including mid-edge nodes; by default as for `tetopt mesh`: what
        `sizes` require, or 5000 (500 in 2-D), fewer for a small image. A graded mesh meets it (to 1
        % for order 2) unless the run is cut short, k_D is 0, cells must be lifted above the minimum
        dihedral angle, or no more nodes can be removed.
    labels : Image
        Whole numbers from 0 on the same voxels: each cell gets one. 0 is a label like the others.
    mask : Image
        0 to 1 on the same voxels: the region to mesh.
    target_error : float
        Instead of `nodes`, for a graded mesh: the unexplained fraction of the image's variance, 0
        to 1. A few runs find the required number of nodes. `violated` reports a run that ends above
        the target.
    nodes_max : int
        With `target_error`, the most nodes to request, for order 2 including mid-edge nodes; by
        default 50,000. If the target takes more, the mesh has these, and `violated` states the
        error that they reach.
    sizes : Sizes
        Targets and limits for the edges of a graded mesh's cells; by default up to 1.4 times a
        uniform mesh's, with order 2 up to 1.15 times with a gradation of 0.5.
    order : {1, 2}
        Intended order of the cells (`tetopt.geometry.quadratic`). With 2, `nodes` includes mid-edge
        nodes: about a seventh of the nodes are corners (a quarter in 2-D), whose number takes up to
        three runs to find. With a mask or smooth labels, the result's mesh has `midpoints`:
        mid-edge nodes on the smooth surfaces (see `curving`).
    mode : {"graded", "uniform", "paper", "start"}
        "graded", the default: `octree_mesh`, then `optimize` with exchanges of nodes. "uniform":
        `lattice_mesh`, clipped at a mask, then `optimize`. "paper": `lattice_mesh`, then
        `optimize_paper`, for a single image without labels or mask. "start", the default if `start`
        is given: `optimize` on that mesh.
    start : Mesh
        The mesh to improve. Its boundary stays unchanged, unless `boundary="slide"`; with
        `keep_connectivity`, which only moves nodes, it follows a mask.
    spacing : float
        Instead of `nodes`, for a lattice: edge length of a block, mm.
    kind : str
        Kind of lattice, as for `tetopt.lattice_mesh`.
    k_D : float
        Weight of the image; by default 0.85 for a graded mesh, 0.2 for a uniform one, 0.02 with
        `start`. On a graded mesh, cells of all sizes share the shape energy, and the octree that
        normalises E_D already has a small E_D, so larger weights than on a uniform mesh are usual.
    iterations : int
        As for `optimize`, by default 16 for a graded mesh, else 20; nodes are exchanged in the
        first 0.7 of them.
    **options
        Further options of `optimize` or `optimize_paper`. `max_seconds` counts from the call, over
        all runs.

    Returns
    -------
    MeshingResult
        As for `optimize`; its first record is that of the initial mesh, which it contains, too. A
        run that does not meet all requirements still returns its mesh, and `violated` has a
        sentence for each violated one, by name (`min_dihedral`, `box`, `cover`, `overlap`, `mask`,
        `labels`, `error`; see `tetopt.measure.judge`).

    Raises
    ------
    InputError
        As for `optimize` or `optimize_paper`; options that do not apply to the mode; both of
        `nodes` and `target_error`, or of `nodes` and `spacing`; `nodes_max` without `target_error`,
        or below what sizes require; labels or a mask beside a content; a number of nodes that
        exceeds the image's detail (see `octree_mesh`) or the memory; or an error below the image's
        noise.
    TypeError
        An unknown option.

    See Also
    --------
    content : Combine several contrasts, labels and a mask.
    save_mesh, build_model : Use the mesh.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> result = tetopt.mesh_image(image, 300)
    >>> uniform = tetopt.mesh_image(image, 300, mode="uniform")
    >>> ratio = tetopt.E_D(image, uniform.mesh) / tetopt.E_D(image, result.mesh)
    >>> len(result.mesh.points), dict(result.violated), ratio > 100
    (300, {}, True)

    Find the nodes for an error, here a fifth of the image's variance:

    >>> result = tetopt.mesh_image(image, target_error=0.2, iterations=4)
    >>> print(f"{tetopt.E_D(image, result.mesh) / (image.data.var() * image.volume):.2f}")
    0.14

    Improve an existing mesh:

    >>> result = tetopt.mesh_image(image, start=tetopt.lattice_mesh(image, nodes=300), iterations=3)
    >>> result.history[-1].E < 1
    True
    """
    nodes = None if nodes is None else whole_number("nodes", nodes)
    if labels is not None or mask is not None:
        if isinstance(image, Content):
            raise InputError(
                "mesh_image: give labels and mask to tetopt.content, or an image instead of a "
                "content"
            )
        image = make_content(image, labels, mask)
    image = plain(image)
    if start is not None:
        check_place(start, image.given)
    aim = Aim(nodes, target_error, sizes, order, mode, start, spacing, kind, nodes_max)
    result = search_mesh(image, aim, k_D=k_D, iterations=iterations, **options)
    return result._replace(content=image, order=order)


def search_mesh(
    image: Image | Content,
    aim: Aim,
    attempt: Conduct = lambda optimisation, *_: optimisation(),
    required: Requirements = Requirements(),  # noqa: B008 - a tuple
    most_bytes: float | None = None,
    **options: Any,
) -> MeshingResult:
    """Return the mesh of an aim, by as many runs as `next_corners` asks for; only the best mesh so
    far is kept.

    `attempt` makes each run, and `required` has words for the verdict; no initial mesh takes more
    than `most_bytes`; `options` are those of `mesh_image`, which raises the same errors.
    """
    begin, seconds = time.perf_counter(), 0.0  # in runs
    content = plain(image)
    mode = aim.mode or ("graded" if aim.start is None else "start")
    _check_names(options, optimize_paper if mode == "paper" else optimize)
    aim = _complete_aim(content, aim._replace(mode=mode))
    keeps_cells = bool(options.get("keep_connectivity"))
    defaults = default_options(mode, keeps_cells, content.region is not None)
    options = _with_defaults(defaults._asdict(), options)
    content = content._replace(is_flat=content.is_flat and aim.order == 1)
    runs, starts, best = list[SearchRun](), list[NDArray](), list[MeshingResult]()
    is_over = deadline(begin, options.get("max_seconds"), options.get("stop"))
    ended = ""
    while (corners := next_corners(aim, runs)) is not None:
        with limit_memory(most_bytes):
            initial, n_dropped, dropped = _initial(content, aim, corners, is_over)
            check_memory_of(content, max(corners, len(initial.points)))
        # Limits on sizes may take more nodes than the error, or allow fewer; a mask's octree is
        # only roughly near.
        count = len(initial.points)
        if aim.target_error is not None and content.region is None and not is_near(count, corners):
            corners = count
        if corners > most_corners(aim, runs) or any(
            np.array_equal(initial.points, points) and not may_differ(aim, run, corners)
            for points, run in zip(starts, runs, strict=True)
        ):
            break
        optimisation = partial(_optimise, content, aim, options, begin, initial, corners)
        begin_of_run = time.perf_counter()
        result = attempt(optimisation, initial, aim, runs)
        seconds += time.perf_counter() - begin_of_run
        starts.append(initial.points)
        runs.append(_run_of(content, aim, corners, result))
        ended = result.ended
        if best_of(aim, runs) == len(runs) - 1:
            best = [
                result._replace(
                    initial=initial,
                    nodes=aim.nodes or corners or None,
                    n_dropped=n_dropped + result.n_dropped,
                    dropped=dropped + Counter(result.dropped),
                )
            ]
    if not best:
        raise _beyond(aim, aim.fewest if corners is None else corners)
    result = best[0]._replace(ended=ended) if ended in CUT_SHORT else best[0]
    if aim.order == 2:
        mesh, curving = curve_mesh(result.mesh, content, result.labels)
        result = result._replace(mesh=mesh, curving=curving)
    result = _with_verdict(result, content, aim, required, options)
    if aim.target_error is not None and (result.fraction or 0.0) < ERROR_REACHED * aim.target_error:
        warn(
            f"target_error: {result.fraction:.4g} of the variance is unexplained, far below "
            f"{aim.target_error:g}: none of {len(runs)} runs came nearer with fewer nodes",
            Note,
        )
    return result._replace(seconds_start=time.perf_counter() - begin - seconds, seconds_run=seconds)


def _initial(
    content: Content, aim: Aim, corners: int, is_over: Callable[[], bool]
) -> tuple[Mesh, int, Counter[int]]:
    """Build the initial mesh with a number of corners, carved within a mask; also return the number
    and volumes of dropped components.

    Once `is_over` returns True, no finer octrees are tried.
    """
    if aim.start is not None:
        return aim.start, 0, Counter()
    if aim.mode == "graded":
        # The longest edge of order 2 may allow no octree with so few corners: exchanges remove as
        # many as they can.
        is_exact = aim.order == 1 and aim.target_error is None
        make = octree_mesh if is_exact else nearest_octree
        initial = make(content, corners, aim.sizes, is_over)
    else:
        initial = lattice_within(
            content.image, content.region, aim.kind, nodes=corners or None, spacing=aim.spacing
        )
    if content.region is None:
        return initial, 0, Counter()
    carving = carve_mesh(
        initial, content.image, content.region, content.keeps_components, content.memberships
    )
    return part_of(initial, carving.is_kept), carving.n_dropped, Counter(carving.volumes)


def _optimise(
    content: Content,
    aim: Aim,
    options: dict[str, Any],
    begin: float,
    initial: Mesh,
    corners: int,
    **more: Any,
) -> MeshingResult:
    """Optimise an initial mesh with further options; `max_seconds` counts from `begin`, over all
    runs and initial meshes.
    """
    if options.get("max_seconds") is not None:
        left = options["max_seconds"] - (time.perf_counter() - begin)
        options = options | {"max_seconds": max(left, SHORTEST_SECONDS)}
    options = options | more
    if aim.mode == "paper":
        return optimize_paper(content.image, initial, **options)
    nodes = corners if aim.mode == "graded" else None
    return optimize(content, initial, nodes=nodes, sizes=aim.sizes, **options)


def _run_of(content: Content, aim: Aim, corners: int, result: MeshingResult) -> SearchRun:
    """Return the numbers of a run of a search."""
    mesh, error = result.mesh, 0.0
    if aim.target_error is not None:
        error = unexplained_by(content, mesh, *result.history[-1].counted)
    nodes = node_count(mesh.points, mesh.cells, aim.order)
    return SearchRun(corners, len(mesh.points), nodes, error, result.ended)


def _with_verdict(
    result: MeshingResult,
    content: Content,
    aim: Aim,
    required: Requirements,
    options: dict[str, Any],
) -> MeshingResult:
    """Measure the mesh, and add the requirements that it violates."""
    first, last = result.history[0], result.history[-1]
    rows = measure(
        result.mesh,
        content,
        result.labels,
        is_filled=aim.mode != "start" and content.region is None,
        initial=result.initial,
        n_initial=first.n_voxels,
        counted=last.counted,
    )
    has_angles = aim.mode != "paper"
    required = required._replace(
        min_dihedral=options.get("min_dihedral", MIN_DIHEDRAL) if has_angles else 0.0,
        target_error=aim.target_error,
        cut_short=result.ended if result.ended in CUT_SHORT else "",
        is_initial=last.iteration == 0,
    )
    measured = {name: row for name, row in rows.items() if not isinstance(row, Exception)}
    return result._replace(
        violated=judge(rows, required),
        extents=measured.get("labels", ()),
        fraction=measured.get("error"),
    )


def process_bytes(content: Content, nodes: int) -> float:
    """Memory of a whole process that reads the files of a content and meshes it with `nodes`
    nodes.
    """
    of_voxel = READ_BYTES
    of_voxel += 0.0 if content.region is None else REGION_BYTES
    of_voxel += 0.0 if content.memberships is None else LABEL_BYTES
    return PROCESS_BYTES + of_voxel * prod(content.image.shape) + bytes_of(content, nodes)


def check_target_error(target_error: float) -> None:
    """Raise InputError unless the target error is a fraction."""
    if not 0.0 < target_error < 1.0:
        raise InputError(
            f"target_error: expected a fraction of the image's variance, 0 to 1, got {target_error}"
        )


def check_memory_of(content: Content, nodes: int) -> None:
    """Raise InputError for an image that does not fit into memory or the user's limit, or more
    nodes than fit into memory: a run ends at the limit.
    """
    shape = " x ".join(map(str, content.image.shape))
    what = f"an image of {shape} voxels" + (
        f" of {content.n_channels} channels" if content.n_channels > 1 else ""
    )
    bare, need = bytes_of(content, 0), bytes_of(content, nodes)
    check_memory(bare, what, "mesh a part of it (`crop`), or raise the memory limit")
    each = (need - bare) / max(nodes, 1) or 1.0
    check_memory(
        need,
        f"{nodes} nodes on {what}",
        lambda room: at_most((room - bare) / each, "nodes"),
        can_stop=True,
    )


def _with_defaults(defaults: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """The options of an optimisation; the defaults for those that are None or missing."""
    return defaults | {
        name: each for name, each in options.items() if each is not None or name not in defaults
    }


def _check_names(options: dict[str, Any], optimisation: Optimisation) -> None:
    """Raise TypeError, like Python's own calls, for options unknown to `mesh_image` and the
    optimisation.
    """
    known = inspect.signature(optimisation).parameters
    for name in options:
        if name not in known:
            near = get_close_matches(name, [*inspect.signature(mesh_image).parameters, *known], 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise TypeError(f"mesh_image() got an unexpected keyword argument {name!r}{hint}")


def default_nodes(content: Content, sizes: Sizes | None, order: int) -> int:
    """Number of nodes, including mid-edge ones for order 2, that targets require, and elsewhere a
    part of the usual.

    The usual number is `DEFAULT_NODES`, or one per eight voxels of a small image.
    """
    n = content.image.ndim
    many = nodes_per_corner(n, order)
    corners = float(np.clip(content.n_voxels // 8, 2 ** (n + 2), DEFAULT_NODES[n] / many))
    if sizes is not None and sizes.has_target:
        needed, fraction = nodes_of_sizes(content, sizes)
        corners = needed + (1.0 - fraction) * corners
    return int(np.rint(many * corners))


def with_label_sizes(
    sizes: Sizes, content: Content, nodes: int | None, order: int
) -> tuple[Sizes, SizesByLabel | None]:
    """Convert sizes by label to targets by place; also return the labels' sizes, if any.

    `nodes` is the mesh's number, for order 2 including mid-edge nodes.
    """
    many = nodes_per_corner(content.image.ndim, order)
    made = sizes_by_label(sizes, content, None if nodes is None else round(nodes / many))
    return (
        (sizes, None)
        if made is None
        else (made.sizes, made._replace(nodes=round(many * made.nodes)))
    )


def _complete_aim(content: Content, aim: Aim) -> Aim:
    """Check the aim, and fill in its defaults and the numbers of its image."""
    _check_aim(content, aim)
    image, sizes, nodes = content.image, aim.sizes, aim.nodes
    if aim.mode == "graded" and sizes is not None:
        sizes = with_label_sizes(sizes, content, nodes, aim.order)[0]
    if aim.mode != "start" and (nodes, aim.target_error, aim.spacing) == (None, None, None):
        nodes = (
            default_nodes(content, sizes, aim.order)
            if aim.mode == "graded"
            else DEFAULT_NODES[image.ndim]
        )
    if aim.mode == "graded":
        sizes = sizes_of_order(content, nodes, sizes, aim.order)
    most = max(prod(image.shape) // 8, 64)
    aim = aim._replace(nodes=nodes, sizes=sizes, ndim=image.ndim, most=most)
    if aim.target_error is None:
        return aim
    _check_reachable(content, aim.target_error)
    aim = aim._replace(nodes_max=aim.nodes_max or TARGET_NODES_MAX)
    fewest = 0 if sizes is None else nodes_of_sizes(content, sizes)[0]
    corners = most_corners(aim, [])
    return aim._replace(fewest=int(corners) if SIZES_MET * fewest <= corners < fewest else fewest)


def _check_aim(content: Content, aim: Aim) -> None:
    """Raise InputError for an unknown mode, and for arguments that do not apply to it."""
    mode, order, ndim = aim.mode, aim.order, content.image.ndim
    if mode not in MODE_DEFAULTS:
        raise InputError(f"mesh_image: expected mode {', '.join(MODE_DEFAULTS)}, got {mode!r}")
    if order not in (1, 2):
        raise InputError(f"mesh_image: expected order 1 or 2, got {order!r}")
    names = [name for name in AIM_NAMES if getattr(aim, name) is not None]
    if unknown := [name for name in names if name not in MODE_ARGUMENTS[mode]]:
        takes = ", ".join(MODE_ARGUMENTS[mode])
        raise InputError(f"mesh_image: mode {mode!r} takes {takes}, not {unknown[0]}")
    if mode == "graded" and "nodes" in names and "target_error" in names:
        raise InputError("mesh_image: give only one of nodes and target_error")
    if aim.nodes_max is not None:
        if aim.target_error is None:
            raise InputError(
                "mesh_image: nodes_max needs target_error; without it, give the number of nodes "
                "itself"
            )
        fewest = ceil(nodes_per_corner(ndim, order) * (2**ndim + 1))
        if not (isinstance(aim.nodes_max, int | np.integer) and aim.nodes_max >= fewest):
            raise InputError(
                f"nodes_max: expected a whole number, {fewest} or more in {ndim}-D, got "
                f"{aim.nodes_max!r}"
            )
    if mode in ("uniform", "paper") and "nodes" in names and "spacing" in names:
        raise InputError("mesh_image: give only one of nodes and spacing")
    if mode == "start" and not names:
        raise InputError("mesh_image: mode 'start' requires a mesh to start from")
    if mode == "paper" and not (content.is_plain and content.region is None):
        raise InputError("mesh_image: the paper's scheme takes one image, without labels or mask")


def sizes_of_order(
    content: Content, nodes: int | None, sizes: Sizes | None, order: int
) -> Sizes | None:
    """Limits on sizes of a graded mesh for cells of an order; with `nodes` of order 2 including
    the longest edge.
    """
    if order == 1:
        return sizes
    sizes = Sizes() if sizes is None else sizes
    if sizes.coarsest is None:
        sizes = sizes._replace(coarsest=QUADRATIC_RATIO)
    if sizes.gradation is None:
        sizes = sizes._replace(gradation=QUADRATIC_GRADATION)
    if nodes is None:
        return sizes
    corners = round(nodes / QUADRATIC_NODES[content.image.ndim])
    return sizes._replace(longest=sizes.longest_edge(content.image, corners, content.volume))


def _check_reachable(content: Content, target_error: float) -> None:
    """Raise InputError for a fraction out of range, or below that of the image's noise, which no
    mesh should follow.
    """
    check_target_error(target_error)
    variance = content.variance
    if variance == 0.0:
        raise InputError(
            "target_error: the image is constant, so the error of every mesh is 0; give a number "
            "of nodes"
        )
    noise = content.noise * content.unit / variance
    if target_error <= noise:
        raise InputError(
            f"target_error: {target_error:g} of the variance is below the noise fraction, "
            f"estimated as {noise:.3g}, "
            "so cells would have to follow the noise; use a larger fraction, or denoise the image"
        )


def _beyond(aim: Aim, corners: int) -> InputError:
    needed = round(nodes_per_corner(aim.ndim, aim.order) * corners)
    return InputError(
        f"nodes_max: sizes require about {needed} nodes, got {aim.nodes_max}; allow as many, or "
        "larger cells"
    )
