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
from collections.abc import Callable, Generator, Iterator
from difflib import get_close_matches
from functools import partial
from math import ceil, prod
from operator import index
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, plain
from tetopt.contents.content import content as make_content
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
)
from tetopt.engine.paper import optimize_paper
from tetopt.errors import InputError
from tetopt.geometry.quadratic import node_count
from tetopt.image import Image
from tetopt.measure.judge import (
    ERROR_AIM,
    ERROR_RATE,
    ERROR_REACHED,
    Requirements,
    judge,
    measure,
    nodes_ratio,
    unexplained_by,
)
from tetopt.mesh import Mesh
from tetopt.start.carve import carve_mesh, part_of
from tetopt.start.clip import lattice_within
from tetopt.start.label_sizes import SizesByLabel, sizes_by_label
from tetopt.start.memory import LABEL_BYTES, PROCESS_BYTES, READ_BYTES, REGION_BYTES, bytes_of
from tetopt.start.octree import is_near, nearest_octree, nodes_of_sizes, octree_mesh
from tetopt.start.sizes import Sizes
from tetopt.system.budget import at_most, check_memory

Mode = Literal["graded", "uniform", "paper", "start"]
# points of the initial mesh, and nodes requested and reached
EarlierRuns = list[tuple[NDArray, int, int]]
# an optimisation ready to start; takes further options of `optimize`
Run = Callable[..., MeshingResult]


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
MODE_ARGUMENTS: dict[Mode, tuple[str, ...]] = {  # arguments that determine the initial mesh
    "graded": ("nodes", "target_error", "nodes_max", "sizes"),
    "uniform": ("nodes", "spacing", "kind"),
    "paper": ("nodes", "spacing", "kind"),
    "start": ("start",),
}
# In the order in which they are checked.
AIM_NAMES = ("nodes", "target_error", "nodes_max", "spacing", "kind", "start", "sizes")
# nodes of order 2 per corner, by dimension, in graded meshes of the MNI152 T1
QUADRATIC_NODES = {2: 3.9, 3: 7.2}
NODES_NEAR = 0.01  # of the number of nodes of order 2: a run this near is accepted
NODE_RUNS = 3  # towards a number of nodes of order 2, at most; the second usually meets it
# in the first run towards an error, by dimension: few enough to take hardly any time
FIRST_NODES = {2: 200, 3: 1500}
# of the nodes of equilateral cells: targets are met down to these (docs/understand/sizes.md)
SIZES_MET = 0.9
RATE_LIMITS = (0.3, 1.0)  # of a measured `ERROR_RATE`
ERROR_RUNS = 6  # towards an error, at most
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
        The mesh to improve. Its boundary stays unchanged, unless `boundary="slide"`.
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
    nodes = None if nodes is None else index(nodes)
    if labels is not None or mask is not None:
        if isinstance(image, Content):
            raise InputError(
                "mesh_image: give labels and mask to tetopt.content, or an image instead of a "
                "content"
            )
        image = make_content(image, labels, mask)
    image = plain(image)
    aim = Aim(nodes, target_error, sizes, order, mode, start, spacing, kind, nodes_max)
    search = MeshSearch(image, aim, k_D=k_D, iterations=iterations, **options)
    for attempt in search:
        search.tell(attempt.run())
    return search.result._replace(content=image, order=order)


class Aim(NamedTuple):
    """The mesh that `mesh_image` is to make, by its arguments."""

    nodes: int | None = None
    target_error: float | None = None
    sizes: Sizes | None = None
    order: int = 1
    mode: Mode | None = None
    start: Mesh | None = None
    spacing: float | None = None
    kind: str | None = None
    nodes_max: int | None = None


class Attempt(NamedTuple):
    """A run of a search; `predicted` corners, by the runs before it, take the target error."""

    initial: Mesh
    run: Run
    predicted: int | None = None


# yields attempts, and returns the result that counts
Search = Generator[Attempt, None, MeshingResult]
# one attempt, with the number of nodes that exchanges lead to, and that predicted
Attempted = Callable[..., Search]


class MeshSearch:
    """The runs that lead to a mesh: iterate over the attempts, and `tell` the result of each; then
    take the `result`.

    Parameters are those of `mesh_image`, which raises the same errors; `required` has words for the
    verdict.
    """

    result: MeshingResult
    _told: MeshingResult  # of the last attempt

    def __init__(
        self,
        image: Image | Content,
        aim: Aim,
        required: Requirements = Requirements(),  # noqa: B008 - a tuple
        **options: Any,
    ) -> None:
        self._required = required
        self._begin, self._seconds = time.perf_counter(), 0.0  # in attempts
        content = plain(image)
        mode = ("graded" if aim.start is None else "start") if aim.mode is None else aim.mode
        _check_names(options, optimize_paper if mode == "paper" else optimize)
        aim = aim._replace(mode=mode)
        _check_aim(content, aim)
        if mode == "graded" and aim.sizes is not None:
            aim = aim._replace(sizes=with_label_sizes(aim.sizes, content, aim.nodes, aim.order)[0])
        if (
            aim.nodes is None
            and aim.target_error is None
            and aim.spacing is None
            and mode != "start"
        ):
            is_graded = mode == "graded"
            nodes = (
                default_nodes(content, aim.sizes, aim.order)
                if is_graded
                else DEFAULT_NODES[content.image.ndim]
            )
            aim = aim._replace(nodes=nodes)
        if aim.target_error is not None and aim.nodes_max is None:
            aim = aim._replace(nodes_max=TARGET_NODES_MAX)
        self._options = _with_defaults(mode, options)
        if mode == "graded":
            aim = aim._replace(sizes=sizes_of_order(content, aim.nodes, aim.sizes, aim.order))
        self._content, self._aim = content._replace(is_flat=content.is_flat and aim.order == 1), aim

    def __iter__(self) -> Iterator[Attempt]:
        """Yield the attempts, each once the result of the last one is told."""
        result = yield from _search_mesh(self._content, self._aim, self._attempted)
        self.result = self._finished(result)

    def tell(self, result: MeshingResult) -> None:
        """Take the result of the attempt."""
        self._told = result

    def _attempted(self, initial: Mesh, nodes: int | None, predicted: int | None = None) -> Search:
        """Yield the attempt with an initial mesh, and return its result."""
        initial, n_dropped, dropped = self._carved(initial)
        check_memory_of(self._content, max(nodes or 0, len(initial.points)))
        start_of_run = time.perf_counter()
        yield Attempt(initial, partial(self._optimised, initial, nodes), predicted)
        self._seconds += time.perf_counter() - start_of_run
        return _with_dropped(self._told, n_dropped, dropped)._replace(initial=initial, nodes=nodes)

    def _carved(self, initial: Mesh) -> tuple[Mesh, int, Counter[int]]:
        """Carve an initial mesh within a mask; also return the number and volumes of dropped
        components.
        """
        content = self._content
        if content.region is None or self._aim.mode == "start":
            return initial, 0, Counter()
        carving = carve_mesh(
            initial, content.image, content.region, content.keeps_components, content.memberships
        )
        return part_of(initial, carving.is_kept), carving.n_dropped, Counter(carving.volumes)

    def _optimised(self, initial: Mesh, nodes: int | None, **more: Any) -> MeshingResult:
        """Optimise an initial mesh with further options."""
        options, mode = (
            self._options | _time_left(self._options, self._begin) | more,
            self._aim.mode,
        )
        if mode == "paper":
            return optimize_paper(self._content.image, initial, **options)
        exchanged = nodes if mode == "graded" else None
        return optimize(self._content, initial, nodes=exchanged, sizes=self._aim.sizes, **options)

    def _finished(self, result: MeshingResult) -> MeshingResult:
        """Judge the result by the aim, and curve its surfaces for order 2."""
        content, aim = self._content, self._aim
        if aim.order == 2:
            mesh, curving = curve_mesh(result.mesh, content, result.labels)
            result = result._replace(mesh=mesh, curving=curving)
        result = self._with_verdict(result)
        seconds = time.perf_counter() - self._begin
        return result._replace(seconds_start=seconds - self._seconds, seconds_run=self._seconds)

    def _with_verdict(self, result: MeshingResult) -> MeshingResult:
        """Measure the mesh, and add the requirements that it violates."""
        content, aim, options = self._content, self._aim, self._options
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
        required = self._required._replace(
            min_dihedral=options.get("min_dihedral", MIN_DIHEDRAL) if has_angles else 0.0,
            target_error=aim.target_error,
            cut_short=result.ended if result.ended in CUT_SHORT else "",
            is_initial=last.iteration == 0,
        )
        fraction = None if isinstance(rows["error"], Exception) else rows["error"]
        return result._replace(violated=judge(rows, required), fraction=fraction)


def _search_mesh(content: Content, aim: Aim, attempted: Attempted) -> Search:
    """Search for the mesh of an aim."""
    if aim.target_error is not None:
        return meshed_to_error(content, aim, attempted)
    if aim.start is not None:
        return attempted(aim.start, None)
    if aim.order == 2 and aim.nodes is not None:
        return meshed_in_all(content, aim, attempted)
    return attempted(_initial(content, aim, aim.nodes), aim.nodes)


def _initial(content: Content, aim: Aim, corners: int | None) -> Mesh:
    """Build the initial mesh with a number of corners."""
    if aim.mode == "graded":
        # The longest edge of order 2 may allow no octree with so few corners: exchanges remove as
        # many as they can.
        return (octree_mesh if aim.order == 1 else nearest_octree)(content, corners or 0, aim.sizes)
    return lattice_within(
        content.image, content.region, aim.kind, nodes=corners, spacing=aim.spacing
    )


def _time_left(options: dict[str, Any], begin: float) -> dict[str, float]:
    """The remaining `max_seconds` for a run, if time is limited, out of that for all runs and
    initial meshes.
    """
    if options.get("max_seconds") is None:
        return {}
    return {
        "max_seconds": max(options["max_seconds"] - (time.perf_counter() - begin), SHORTEST_SECONDS)
    }


def _with_dropped(result: MeshingResult, number: int, by_label: Counter[int]) -> MeshingResult:
    """Add components dropped from the initial mesh to those that a run dropped."""
    return result._replace(
        n_dropped=number + result.n_dropped, dropped=by_label + Counter(result.dropped)
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


def check_memory_of(content: Content, nodes: int, limit: float | None = None) -> None:
    """Raise InputError for more nodes than fit into memory, or into `limit` bytes in total."""
    shape = " x ".join(map(str, content.image.shape))
    what = f"an image of {shape} voxels" + (
        f" of {content.n_channels} channels" if content.n_channels > 1 else ""
    )
    bare, need = bytes_of(content, 0), bytes_of(content, nodes)
    check_memory(bare, what, "mesh a part of it (`crop`), or raise the memory limit", limit)
    each = (need - bare) / max(nodes, 1) or 1.0
    check_memory(
        need, f"{nodes} nodes on {what}", lambda room: at_most((room - bare) / each, "nodes"), limit
    )


def _with_defaults(mode: Mode, options: dict[str, Any]) -> dict[str, Any]:
    """The options of an optimisation; the defaults of the mode for those that are None or
    missing.
    """
    defaults = MODE_DEFAULTS[mode]._asdict()
    return defaults | {
        name: each for name, each in options.items() if each is not None or name not in defaults
    }


def _check_names(options: dict[str, Any], optimisation: Run) -> None:
    """Raise TypeError, like Python's own calls, for options unknown to `mesh_image` and the
    optimisation.
    """
    known = inspect.signature(optimisation).parameters
    for name in options:
        if name not in known:
            near = get_close_matches(name, [*inspect.signature(mesh_image).parameters, *known], 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise TypeError(f"mesh_image() got an unexpected keyword argument {name!r}{hint}")


def nodes_per_corner(ndim: int, order: int) -> float:
    """Usual number of nodes of an order per corner of a graded mesh."""
    return QUADRATIC_NODES[ndim] if order == 2 else 1.0


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


def corners_of(nodes: int, ndim: int, ratio: float) -> int:
    """Number of corners to request for `nodes` in all of order 2, `ratio` times as many."""
    return max(round(nodes / ratio), 2 ** (ndim + 1))


def _is_repeated(runs: EarlierRuns, initial: Mesh, nodes: int, has_exchanges: bool = True) -> bool:
    """True if a run would end as an earlier one: the same initial mesh, and exchanges, if any,
    cannot come nearer.
    """
    for points, earlier, reached in runs:
        low, high = (
            (1.0 - NODES_NEAR) * min(earlier, nodes),
            (1.0 + NODES_NEAR) * max(earlier, nodes),
        )
        may_differ = has_exchanges and earlier != nodes and low <= reached <= high
        if not may_differ and np.array_equal(points, initial.points):
            return True
    return False


def meshed_in_all(content: Content, aim: Aim, attempted: Attempted) -> Search:
    """Repeat runs with other numbers of corners until corners and mid-edge nodes together are the
    aim's nodes.

    Returns the result of the nearest run, or of one that was cut short.
    """
    nodes, ndim, has_exchanges = int(aim.nodes or 0), content.image.ndim, aim.mode == "graded"
    ratio, runs = QUADRATIC_NODES[ndim], EarlierRuns()
    nearest: list[tuple[float, MeshingResult]] = []  # the one so far: no more results are kept
    for _ in range(NODE_RUNS):
        initial = _initial(content, aim, corners := corners_of(nodes, ndim, ratio))
        if _is_repeated(runs, initial, corners, has_exchanges):
            break
        result = (yield from attempted(initial, corners))._replace(nodes=nodes)
        runs.append((initial.points, corners, len(result.mesh.points)))
        if nearest and result.ended in CUT_SHORT:
            return nearest[0][1]._replace(ended=result.ended)
        count = node_count(result.mesh.points, result.mesh.cells, 2)
        ratio = count / len(result.mesh.points)
        miss = abs(count / nodes - 1.0)
        nearest = [min([*nearest, (miss, result)], key=lambda each: each[0])]
        if miss <= NODES_NEAR or result.ended in CUT_SHORT:
            break
    return nearest[0][1]


def meshed_to_error(content: Content, aim: Aim, attempted: Attempted) -> Search:
    """Repeat runs with up to `nodes_max` nodes until the unexplained variance is just below a
    target.

    Returns the result, with the octree and the number of nodes, of the run with the fewest nodes
    that meets the target; if none does, of the run with the least error, or of one that was cut
    short. It is the same as with that number of nodes from the start, unless limits on sizes forbid
    it. At least 2^(n + 2) nodes are tried, and at least as many as targets of sizes require.

    Raises
    ------
    InputError
        As for `_check_reachable` and `octree_mesh`; or sizes require more than `nodes_max`.
    """
    target_error, nodes_max, sizes = aim.target_error or 0.0, aim.nodes_max or 0, aim.sizes
    _check_reachable(content, target_error)
    fewest = 0 if sizes is None else nodes_of_sizes(content, sizes)[0]
    nodes, predicted, ratio = (
        FIRST_NODES[content.image.ndim],
        None,
        nodes_per_corner(content.image.ndim, aim.order),
    )
    if SIZES_MET * fewest <= nodes_max / ratio < fewest:
        fewest = round(nodes_max / ratio)
    fractions = dict[int, float]()  # unexplained variance by number of nodes
    best: list[MeshingResult] = []  # the one so far: no more results are kept
    runs = EarlierRuns()
    for _ in range(ERROR_RUNS):
        most = round(nodes_max / ratio)
        if (nodes := max(min(nodes, most), fewest)) <= most:
            initial = nearest_octree(content, nodes, sizes)
            # Limits on sizes may take more nodes than the error, or allow fewer; a mask's octree is
            # only roughly near.
            if content.region is None and not is_near(len(initial.points), nodes):
                nodes = len(initial.points)
        if nodes > most and not best:
            raise _beyond(nodes_max, round(ratio * nodes))
        if nodes > most or _is_repeated(runs, initial, nodes):
            break
        result = yield from attempted(initial, nodes, predicted)
        count, fraction = (
            len(result.mesh.points),
            unexplained_by(content, result.mesh, *result.history[-1].counted),
        )
        runs.append((initial.points, nodes, count))
        if result.ended in CUT_SHORT:
            is_worse = bool(best) and fractions[len(best[0].mesh.points)] <= max(
                target_error, fraction
            )
            return best[0]._replace(ended=result.ended) if is_worse else result
        if count in fractions:
            break
        fractions[count] = fraction
        if not best or _is_better(count, len(best[0].mesh.points), fractions, target_error):
            best = [result]
        if ERROR_REACHED * target_error <= fraction <= target_error:
            return result
        nodes = predicted = max(_next_nodes(content.image, fractions, target_error), fewest)
        ratio = (total := node_count(result.mesh.points, result.mesh.cells, aim.order)) / count
        if nodes in fractions or (
            total > (1.0 - NODES_NEAR) * nodes_max and fraction > target_error
        ):
            break
    return best[0]


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


def _beyond(nodes_max: int, needed: int) -> InputError:
    return InputError(
        f"nodes_max: sizes require about {needed} nodes, got {nodes_max}; allow as many, or "
        "larger cells"
    )


def _is_better(new: int, old: int, fractions: dict[int, float], target: float) -> bool:
    """True if a number of nodes is better than another: it meets the target with fewer, or is
    nearer to it.
    """
    if (fractions[new] <= target) != (fractions[old] <= target):
        return fractions[new] <= target
    return new < old if fractions[new] <= target else fractions[new] < fractions[old]


def _next_nodes(image: Image, fractions: dict[int, float], target: float) -> int:
    """The number of nodes to try next: between the nearest ones on either side, or beyond the
    nearest.
    """
    above = max((n for n, fraction in fractions.items() if fraction > target), default=None)
    below = min((n for n, fraction in fractions.items() if fraction <= target), default=None)
    aim = ERROR_AIM * target
    least = 0.03 * aim  # the error may be 0
    if above is not None and below is not None and above < below:
        part = np.log(fractions[above] / aim) / np.log(
            fractions[above] / max(fractions[below], least)
        )
        return int(above * (below / above) ** part)
    nearest = min(fractions) if above is None else above
    rate, other = ERROR_RATE, max((n for n in fractions if n < nearest), default=None)
    if above is not None and other is not None:  # the rate of this image, by its last two runs
        rate = float(
            np.clip(
                np.log(fractions[other] / fractions[nearest]) / np.log(nearest / other),
                *RATE_LIMITS,
            )
        )
    number = nearest * nodes_ratio(max(fractions[nearest], least), target, rate)
    return int(np.clip(number, 2 ** (image.ndim + 2), max(prod(image.shape) // 8, 64)))
