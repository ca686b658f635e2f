"""The fast engine: minimise the paper's energy by analytic gradients and energy-driven flips, above
a minimum angle.

Each iteration moves the nodes with an expected gain (`smooth`) and then exchanges cells wherever
that lowers E (`flips`), which replaces Delaunay re-tessellation. No move leaves a dihedral angle
below the minimum, and a lattice starts far above it, so E falls throughout, unless nodes are moved
onto interfaces. Cells of other initial meshes below the minimum are repaired at the end (`repair`),
if nothing else has lifted them. Keeping the minimum throughout costs as much E_D as lifting the
worst cells once E has settled (0.3587 of the initial value against 0.3560: MNI152 T1, 4,864 nodes,
k_D = 0.5), and E need not rise for it.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from tetopt.contents.content import Content, plain
from tetopt.contents.content import content as make_content
from tetopt.energy.sampling import cell_of_voxel, channel_grid, from_ticks
from tetopt.engine.complex import (
    NodeStars,
    State,
    copy_state,
    node_stars,
    remeasure,
    without_cells,
)
from tetopt.engine.density import Limits, compact_state, exchange
from tetopt.engine.flips import _evaluate_cells, _evaluate_triangles, flip
from tetopt.engine.label_state import follow_labels, meet_everywhere, mend_pinches, with_labels
from tetopt.engine.labelling import LabelVoxels, label_voxels
from tetopt.engine.loop import (
    MIN_DIHEDRAL,
    SHAPE_POWER,
    UNIFORM_ITERATIONS,
    UNIFORM_K_D,
    Boundary,
    IterationRecord,
    MeshingResult,
    check_common_options,
    deadline,
    grace,
    relative_movement,
)
from tetopt.engine.paper import optimize_paper
from tetopt.engine.repair import cell_cosines, n_cells_below, repair
from tetopt.engine.sliding import _fill_offsets, fill_offsets
from tetopt.engine.smooth import _attract, attract, blocks, sweep
from tetopt.engine.state import angle_limit_of, content_energies, state_of, with_min_dihedral
from tetopt.errors import InputError
from tetopt.geometry.check import check_unfolded, outside_fraction
from tetopt.geometry.manifold import OUTSIDE_LABEL
from tetopt.geometry.simplex import regular_edge, volumes
from tetopt.geometry.topology import compact, split_nodes
from tetopt.image import Image, transform_vectors
from tetopt.interop.notebook import with_bar
from tetopt.mesh import Mesh
from tetopt.start.carve import carve_mesh
from tetopt.start.lattice import lattice_mesh
from tetopt.start.sizes import Sizes
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernels import link, roots

# of the edge: distance that a node may be off its place at the surface between two labels
BAND_FRACTION = 0.1
MOST_OFFSET_FRACTION = 0.15  # of the edge: most that a node's place is off the surface
FLIP_EDGES = 0.05  # of an edge: nodes that moved less need no new flips
HOPE_FRACTION = 0.003  # of E over the number of nodes: least expected gain of a move
EARLY_HOPE_FRACTION = 0.05  # the same while nodes are exchanged, as cells around them change anyway
EXCHANGING_FRACTION = 0.7  # of the iterations: the first ones, which exchange nodes
EXCHANGED_FRACTION = 0.1  # of the requested nodes: most that are exchanged at once
EXCHANGE_SHAPE_WEIGHT = 0.1  # of the shape energy's weight, in an exchange; see `Run.exchange`
# iteration from which cells have labels: exchanges have resolved thin parts, but not yet folds
LABELLED_AT = 3
LABELLED_EVERY = 2  # iterations: labels are reassigned at this interval, before exchanges
# shortest edge that an exchange makes with labels, in addition to the limits on sizes
LEAST_EDGE_VOXELS = 1.0
# degrees: smallest allowed angle, if `min_dihedral` is no lower, until nodes lie on interfaces
ATTRACTED_MIN_DIHEDRAL = 4.0
# Most cells on a mask's boundary that may be removed if nothing lifts them: a fraction of all
# cells, or this number.
FLAT_CELLS_FRACTION, FLAT_CELLS = 0.005, 10
CONVERGED_FALL = 5e-4  # of E in an iteration: a run ends if E falls by less
MEND_ROUNDS = 3  # of lifting and removing cells, at the end
FAR_TICKS = -(1 << 40)  # a place far from any other


@with_bar
def optimize(
    image: Image | Content,
    mesh: Mesh,
    *,
    k_D: float = UNIFORM_K_D,
    iterations: int = UNIFORM_ITERATIONS,
    shape_power: float = SHAPE_POWER,
    min_dihedral: float = MIN_DIHEDRAL,
    boundary: Boundary = "slide",
    nodes: int | None = None,
    sizes: Sizes | None = None,
    max_seconds: float | None = None,
    callback: Callable[[IterationRecord], None] | None = None,
    stop: Callable[[], bool] | None = None,
    keep: Callable[[Mesh, Ints | None], None] | None = None,
    cell_labels: Ints | None = None,
    keep_connectivity: bool = False,
) -> MeshingResult:
    """Move and reconnect the nodes of a mesh to lower E.

    E = (1 - k_D) E_G + k_D E_D is Eq. (4), with each energy relative to its value on the initial
    mesh.

    Parameters
    ----------
    image : Image or Content
        The intensities h, or a content with several channels, over which E_D is summed, and a mask
        (`tetopt.content`).
    mesh : Mesh
        The initial mesh, any conforming mesh; it also normalises the two energies.
    k_D : float
        Weight of the image, 0 <= k_D < 1.
    iterations : int
        Maximum number of sweeps over all nodes.
    shape_power : float
        p >= 1: each cell's E_G is weighted by eta^(p - 1), where eta >= 1 is the cell's mean-edge
        shape measure (see `tetopt.engine.complex.shape_energy`). 1 is the paper's energy, which is
        blind to slivers; above 2.5 it grows without bound as a cell becomes flat.
    min_dihedral : float
        Smallest dihedral angle of a tetrahedron at the end, degrees, from 0 (no bound) to below 70.
        The caller must count cells below it (`tetopt.quality`). Meshes of triangles have no such
        bound.
    boundary : {"slide", "fixed"}
        "slide": boundary nodes move within the box's faces and edges; others are fixed or, with a
        mask, assumed to lie on its surface and slide on it. "fixed": the boundary's nodes and
        facets stay unchanged to the last bit.
    nodes : int, optional
        Insert nodes where they lower E most, towards this number, on a graded mesh such as
        `octree_mesh`. Every cell's shape then has the same weight, whatever its size (see
        `tetopt.engine.complex.shape_energy`), and nodes are exchanged in the first iterations if
        k_D > 0 or `sizes` has a target. An exchange at most doubles the nodes, so few iterations
        may miss a number far from that of `mesh`. By default the nodes of `mesh` are kept, and the
        shape energy is that of Eq. (1).
    sizes : Sizes, optional
        Targets and limits for the edges that exchanges make, with `nodes`.
    max_seconds : float, optional
        Stop at the next colour of nodes after this time; the mesh is valid. Lifting cells above the
        minimum dihedral angle may take another tenth of the run's time, or half a second; the
        iteration's flips and labels take more.
    callback : callable, optional
        Called with each `IterationRecord`, with the weighted E_G and with `is_retessellated` True
        if cells were exchanged. Without a callback, a notebook shows a progress bar.
    stop : callable, optional
        Called between colours of nodes; True ends the run.
    keep : callable, optional
        Called with the mesh and the labels of its cells, if they have any, as soon as the run is
        cut short: lifting cells takes more time.
    cell_labels : (M,) int, optional
        Label of each cell of `mesh`, for a content without labels. The cells of the result have
        labels, too; nodes and facets between two labels stay unchanged to the last bit.
    keep_connectivity : bool
        Only move nodes: nodes and cells keep their numbers, cells their `cell_labels`, whose
        interfaces follow those of the content's labels, if it has any. Its number of cells below
        `min_dihedral` may stay above 0.

    Returns
    -------
    MeshingResult
        Mesh, history and reason for the end, without a verdict: `violated` is that of `mesh_image`.
        The mesh covers the same domain, and every cell is positively oriented. E never rises
        between records, unless cells had to be lifted above the minimum dihedral angle (which may
        insert or remove nodes), or nodes were exchanged or moved onto interfaces; once cells have
        labels, E is defined differently. Results are the same to the last bit on any number of
        threads.

    Raises
    ------
    InputError
        An option out of range; a mesh that is invalid for sampling (see `tetopt.cell_moments`), is
        folded, has a facet in more than two cells, or a cell too flat for a shape energy; energies
        that overflow; or labels of cells beside those of the content, or beside a mask on whose
        surface nodes slide.

    See Also
    --------
    mesh_image : Make the initial mesh and optimise it.
    optimize_paper : Use the paper's scheme.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> result = tetopt.optimize(image, mesh, k_D=0.5, iterations=5)
    >>> print(f"E_D falls to {tetopt.E_D(image, result.mesh) / tetopt.E_D(image, mesh):.0%}")
    E_D falls to 10%
    >>> round(tetopt.quality(result.mesh.points, result.mesh.cells).min_dihedral) >= 12
    True
    """
    check_options(k_D, iterations, shape_power, min_dihedral, boundary, nodes)
    begin = time.perf_counter()
    is_over = deadline(begin, max_seconds, stop)
    content = plain(image)
    outside_fraction(mesh, content.given)
    sizes = (Sizes() if sizes is None else sizes).prepared(content.image.ndim)
    if keep_connectivity and nodes is not None:
        raise InputError("keep_connectivity: the nodes are those of the mesh; leave out nodes")
    is_graded = nodes is not None or keep_connectivity
    run = Run(content, mesh, k_D, shape_power, boundary, is_graded, cell_labels, keep_connectivity)
    min_dihedral = min_dihedral if run.n == 3 else 0.0
    # Iterations that may exchange nodes: shape alone does not determine where to add nodes.
    n_early = int(EXCHANGING_FRACTION * iterations) if k_D > 0.0 or sizes.has_target else 0
    course = Course(
        iterations,
        n_early,
        min_dihedral,
        nodes,
        sizes,
        carves=boundary != "fixed",
    )
    history, ended = follow_course(run, course, is_over, begin, callback, keep)
    if content.memberships is not None and not run.has_labels:  # too few iterations, or k_D is 0
        run.give_labels()
        run.mend_surfaces(False, min_dihedral)
    if ended == "over":
        ended = "stopped" if stop is not None and stop() else "max_seconds"
    return MeshingResult(
        run.mesh(),
        history,
        ended,
        mesh,
        labels=run.labels(),
        n_dropped=run.n_dropped,
        dropped=dict(run.dropped),
    )


class Course(NamedTuple):
    """The iterations of a run."""

    iterations: int
    n_early: int  # the first ones, which exchange nodes
    min_dihedral: float  # degrees
    nodes: int | None  # as of `optimize`
    sizes: Sizes
    carves: bool  # True if the last iteration removes cells at pinches of a mask's boundary


def follow_course(
    run: Run,
    course: Course,
    is_over: Callable[[], bool],
    begin: float,
    callback: Callable[[IterationRecord], None] | None,
    keep: Callable[[Mesh, Ints | None], None] | None = None,
) -> tuple[list[IterationRecord], str]:
    """Do the iterations of a course; return the records and "iterations", "converged", "risen"
    or "over".
    """
    history: list[IterationRecord] = []
    min_dihedral, nodes, E = course.min_dihedral, course.nodes, 0.0

    def record(iteration: int, movement: float, is_changed: bool) -> None:
        nonlocal E
        history.append(run.record(iteration, movement, is_changed, time.perf_counter() - begin))
        E = run.E()
        if callback is not None:
            callback(history[-1])

    record(0, 0.0, False)
    if course.iterations > 0:
        run.keep_min_dihedral(min_dihedral)
    is_late = grace(begin, is_over)
    has_labels = run.content.memberships is not None and run.state.objective.image > 0.0
    has_labels = has_labels and not run.keeps_cells
    for iteration in range(1, course.iterations + 1):
        before = run.state.complex.ticks.copy()
        # not of a run that ends here, whose mesh is first kept
        is_labelled = has_labels and gives_labels(iteration, course) and not is_over()
        if is_labelled:
            run.give_labels()
        stars = attract_nodes(run, course, iteration)
        # 1. Move the nodes.
        is_early = nodes is not None and iteration <= course.n_early
        is_finished = run.sweep(is_over, EARLY_HOPE_FRACTION if is_early else HOPE_FRACTION, stars)
        # 2. Exchange cells: if nodes are exchanged next, only at first, as cells around them change
        # anyway.
        does_exchange = is_early and is_finished and iteration % 2 == 1
        flips = is_finished and (iteration == 1 or not does_exchange) and not run.keeps_cells
        n_changes = run.flip() if flips else 0
        movement = run.movement(before)
        # E is defined differently: nothing has settled yet
        is_new = is_labelled or (has_labels and not run.has_labels)
        fall = np.inf if is_new else 1.0 - run.E() / E if E > 0.0 else 0.0
        # 3. Exchange nodes: in every second of the first iterations.
        if nodes is not None and does_exchange and not is_over():
            n_changes += run.exchange_towards(nodes, course.sizes, is_over)
        # 4. Lift flat cells and repair places that are not manifold: in the last iteration.
        is_finished = is_finished and (iteration == course.iterations or not is_over())
        if not is_finished and keep is not None:
            keep(run.mesh(), run.labels())
        is_last = (
            iteration == course.iterations
            or not is_finished
            or (fall < CONVERGED_FALL and not is_early)
        )
        n_lifted, n_gone = run.mend(course.carves, min_dihedral, is_late) if is_last else (0, 0)
        n_changes, fall = n_changes + n_lifted + n_gone, np.inf if n_lifted > 0 else fall
        # 5. Measure.
        record(iteration, movement, n_changes > 0)
        if not is_finished:
            return history, "over"
        if is_last and fall < CONVERGED_FALL:  # interfaces that follow their surfaces may raise E
            return history, "converged" if abs(fall) < CONVERGED_FALL else "risen"
    return history, "iterations"


def attract_nodes(run: Run, course: Course, iteration: int) -> NodeStars | None:
    """Move nodes to their places at surfaces, if there are any, and return the stars."""
    if not (run.has_labels or run.state.sides.has_surface):
        return None
    is_early = iteration <= course.n_early
    return run.attract(min(ATTRACTED_MIN_DIHEDRAL if is_early else 180.0, course.min_dihedral))


def gives_labels(iteration: int, course: Course) -> bool:
    """True if cells get labels from the voxels: first in `LABELLED_AT`, and again at intervals, not
    in the last.

    In between labels keep their topology. Labels assigned only once would keep holes of sheets
    thinner than the cells.
    """
    first = min(LABELLED_AT, course.iterations)
    return iteration == first or (
        first < iteration < course.iterations and (iteration - first) % LABELLED_EVERY == 0
    )


def prepare_kernels(
    image: Image | Content,
    k_D: float,
    method: Literal["fast", "paper"] = "fast",
    is_graded: bool = False,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Compile or load the kernels of a method for images of this kind, before a clock starts.

    Several processes compile the kernels missing from the cache, and report to `progress` like
    `tetopt.system.kernels.link`; a tiny run then loads the rest.
    """
    content = plain(image)
    image = content.image
    has_labels = content.memberships is not None
    if method == "fast":
        unused = {_evaluate_triangles if image.ndim == 3 else _evaluate_cells}
        if not has_labels and content.region is None:  # 4 of 79 s of compiling
            unused |= {_attract, _fill_offsets}
        purposes = {
            "density": is_graded or image.ndim == 3,
            "repair": image.ndim == 3,
            "interfaces": has_labels,
            "label_state": has_labels,
            "labelling": has_labels,
            "nearest": has_labels or content.region is not None,  # measures the result afterwards
            "paper_moves": False,
        }
        link(
            [
                kernel
                for kernel in roots()
                if kernel not in unused and purposes.get(kernel.room, True)
            ],
            progress,
        )
    step = 1.0 if not content.is_plain or image.is_whole else 0.1
    tiny = Image(np.zeros((3,) * image.ndim) + step * np.arange(3))
    mesh = lattice_mesh(tiny, blocks=(1,) * image.ndim)
    if has_labels:
        halves = Image((np.arange(3) > 0) * np.ones(tiny.shape))
        optimize(make_content(tiny, halves), mesh, k_D=k_D, iterations=1)
    if method == "paper":
        optimize_paper(tiny, mesh, k_D=k_D, iterations=1)
    elif is_graded:  # the first of two iterations exchanges nodes
        optimize(tiny, mesh, k_D=k_D, iterations=2, min_dihedral=0.0, nodes=len(mesh.points))
    else:
        optimize(tiny, mesh, k_D=k_D, iterations=1)


class Run:
    """State and steps of an optimisation."""

    def __init__(
        self,
        content: Content,
        mesh: Mesh,
        k_D: float,
        power: float = SHAPE_POWER,
        boundary: Boundary = "slide",
        is_graded: bool = False,
        cell_labels: Ints | None = None,
        keeps_cells: bool = False,
    ) -> None:
        """Take the arguments of `tetopt.engine.state.state_of`, and labels of cells to keep.

        With these, cells of different labels have nodes of their own, which stay where they are;
        if the run `keeps_cells`, they share nodes, which follow the content's labels if there are
        any.
        """
        self.content, self.image, self.n = content, content.image, content.image.ndim
        self.keeps_cells = keeps_cells
        self.kept_labels: Ints | None = None
        follows = keeps_cells and content.memberships is not None
        if follows:
            row_of_cell = check_followed(cell_labels, content, mesh)
        elif cell_labels is not None:
            check_cell_labels(cell_labels, content, mesh, boundary)
            self.kept_labels, part = np.unique(cell_labels, return_inverse=True)
            before, cells, is_shared = split_nodes(mesh.cells, part)
            if keeps_cells:
                is_shared = np.isin(np.arange(len(mesh.points)), before[is_shared])
            else:
                mesh = Mesh(mesh.points[before], cells)
        self.grid = channel_grid(content, mesh.points)
        self.state: State = state_of(content, mesh, self.grid, k_D, power, boundary, is_graded)
        if self.kept_labels is not None:
            self.state.complex.labels[: len(part)] = part
            self.state.complex.is_frozen[is_shared, :3] = True
        is_exact = boundary == "fixed" or self.kept_labels is not None
        ticks = self.state.complex.ticks
        is_kept = self.is_still if is_exact else np.zeros(len(ticks), dtype=bool)
        self.kept = dict(
            zip(map(tuple, ticks[is_kept].tolist()), mesh.points[is_kept], strict=True)
        )
        self.groups, self.edge = blocks(ticks), _edges(mesh.points, mesh.cells)
        self.has_labels = follows
        if content.smooth is not None and follows:
            self.state = follow_labels(self.state, content, content.smooth, row_of_cell)
        self.label_voxels: LabelVoxels | None = None  # computed when needed
        # Variance of the noise, estimated when first needed.
        self.image_noise: float | None = None
        # positions at which nodes' flips were last evaluated
        self.ticks_flipped = np.full_like(ticks, FAR_TICKS)
        # expected gain of each node's next move, (N,); see `sweep`
        self.hope = np.full(len(ticks), np.inf)
        self.n_dropped = 0  # removed connected components that the mask does not have
        self.dropped: Counter[int] = Counter()  # their volume by label, mm^n

    @property
    def is_still(self) -> Bools:
        """Nodes that may not move along any axis, (N,)."""
        return np.asarray(self.state.complex.is_frozen[:, 3 - self.n : 3].all(axis=1))

    @property
    def n_cells(self) -> int:
        """Cells in use."""
        return int(self.state.complex.n_cells[0])

    def E(self) -> float:
        """The combined energy that moves lower: Eq. (4), with labels that of their values."""
        E_G, squares = content_energies(self.state, self.content)
        return self.state.objective.geometry * E_G + self.state.objective.image * squares

    def sweep(
        self,
        is_over: Callable[[], bool] = lambda: False,
        fraction: float = HOPE_FRACTION,
        stars: NodeStars | None = None,
    ) -> bool:
        """Move the nodes with an expected gain; return False if `is_over` cut the sweep short.

        A node's expected gain is that of its last move plus its neighbours' mean gain in each sweep
        since. The node is skipped until this reaches a fraction of the mean E per node. It is
        infinite if the node's cells were exchanged.
        """
        gains = np.zeros(len(self.hope))
        is_active = (self.hope > fraction * self.E() / len(gains)) & ~self.is_still
        is_finished = sweep(
            self.state, stars or node_stars(self.state), self.groups, is_active, is_over, gains
        )
        around = np.bincount(
            self.cells.ravel(), np.repeat(gains[self.cells].sum(axis=1), self.n + 1), len(gains)
        )
        number = np.bincount(self.cells.ravel(), minlength=len(gains))
        self.hope = (
            np.where(is_active, gains, self.hope)
            + (around / np.maximum(number, 1) - gains) / self.n
        )
        return is_finished

    def flip(self) -> int:
        """Exchange cells around the nodes that have moved; return the number of exchanges."""
        moved = self._moved(self.ticks_flipped, FLIP_EDGES)
        is_dirty = moved[self.cells].any(axis=1)
        is_touched = np.zeros(len(moved), dtype=bool)
        self.state, n_flips = flip(self.state, np.asarray(is_dirty), is_touched=is_touched)
        self.hope[is_touched] = np.inf
        return n_flips

    def _moved(self, since: Ints, fraction: float) -> Bools:
        """Nodes more than a fraction of an edge away from `since`, which is updated for them."""
        matrix = self.state.objective.matrix
        way = transform_vectors(
            (self.state.complex.ticks - since).astype(np.float64), matrix * 2.0**-self.grid.bits
        )
        moved: Bools = (way**2).sum(axis=1) > (fraction * self.edge) ** 2
        since[moved] = self.state.complex.ticks[moved]
        return moved

    def exchange_towards(self, nodes: int, sizes: Sizes, is_over: Callable[[], bool]) -> int:
        """Exchange nodes once, or repeatedly towards targets while the number is far off; return
        the number of changes.

        Targets can be reached from any mesh, even one with a tenth of the nodes; moving nodes first
        would be futile.
        """
        n_changes = n_last = self.exchange(nodes, sizes)
        most = EXCHANGED_FRACTION * nodes
        while (
            sizes.has_target and n_last > 0 and abs(len(self.edge) - nodes) > most and not is_over()
        ):
            n_last = self.exchange(nodes, sizes)
            n_changes += n_last
        return n_changes

    def exchange(self, nodes: int, sizes: Sizes) -> int:
        """Split and collapse edges towards a number of nodes; return the number of inserted and
        removed nodes.

        Shape costs count a tenth, as most of them vanish when the surrounding nodes move again.
        """
        objective = self.state.objective
        if self.image_noise is None:
            self.image_noise = self.content.noise
        points = self.points()
        target = sizes.around(points, self.cells)
        longest = sizes.longest_edges(
            self.image, nodes, points, self.cells, self.edge, target, self.content.volume
        )
        # Resolving a voxel's step between labels always pays, although their surfaces have no such
        # fine detail.
        voxel = (
            self.image.voxel_volume ** (1.0 / self.n)
            if self.content.memberships is not None
            else 0.0
        )
        shortest = max(float(sizes.smallest), LEAST_EDGE_VOXELS * voxel)
        limits = Limits(shortest, longest, self.image_noise, target)
        eager = objective._replace(geometry=EXCHANGE_SHAPE_WEIGHT * objective.geometry)
        made = exchange(
            self.state._replace(objective=eager), nodes, int(EXCHANGED_FRACTION * nodes), limits
        )
        self._renumber(made.state._replace(objective=objective), made.source)
        self.hope[made.is_touched] = np.inf
        self.ticks_flipped[made.is_touched] = FAR_TICKS
        return made.n_split + made.n_collapsed

    def give_labels(self) -> None:
        """Assign a label to each cell, if the content has labels; nodes between labels slide
        from then on.
        """
        if self.content.smooth is None:
            return
        members = self.content.smooth.memberships
        if self.label_voxels is None:
            region, rows = self.content.region, members.partition
            rows = rows if region is None else np.where(region.inside, rows, OUTSIDE_LABEL)
            self.label_voxels = label_voxels(
                rows, self.image.spacing, len(members.labels), members.parts
            )
        self.state = with_labels(
            self.state, self.content, self.content.smooth, self.mesh(), self.label_voxels
        )
        self.has_labels = True
        self.hope[:] = np.inf
        self.ticks_flipped[:] = FAR_TICKS

    def attract(self, degrees: float) -> NodeStars:
        """Move nodes between labels, and those of a mask's surface, to their places there.

        No angle falls below `degrees`; within a mask, where `lift` may be undone, none falls below
        the minimum. Returns the stars, whose cells do not change.
        """
        ticks = self.state.complex.ticks.copy()
        stars = node_stars(self.state)
        if self.content.is_flat:
            edge = self.edge / self.image.voxel_volume ** (1.0 / self.n)
            self.state.complex.band[:] = BAND_FRACTION * edge
            fill_offsets(self.state, MOST_OFFSET_FRACTION * edge)
        lowest = angle_limit_of(degrees)[0]
        if self.content.region is not None:
            lowest = max(lowest, self.state.objective.angle_limit)
        attract(self.state, stars, self.groups, lowest)
        is_other = (self.state.complex.ticks != ticks).any(axis=1)[self.cells].any(axis=1)
        self.hope[self.cells[is_other]] = np.inf
        return stars

    def keep_min_dihedral(self, degrees: float) -> None:
        """Forbid moves that leave a dihedral angle below `degrees`, or lower one that is below
        it already.
        """
        self.state = with_min_dihedral(self.state, degrees)

    def n_below(self, degrees: float) -> int:
        """Number of tetrahedra with an angle below `degrees`."""
        return n_cells_below(self.state, degrees) if degrees > 0.0 else 0

    def mend(
        self, carves: bool, min_dihedral: float, is_late: Callable[[], bool]
    ) -> tuple[int, int]:
        """Lift cells above `min_dihedral`, degrees, and mend surfaces; repeat after cells were
        removed.

        Once `is_late` returns True, cells are no longer lifted, but surfaces are still mended.
        Returns the numbers of moves and of removed cells.
        """
        n_lifted = n_gone = 0
        for _ in range(1 if self.keeps_cells else MEND_ROUNDS):
            n_lifted += (
                self.lift(min_dihedral, carves, is_late) if self.n_below(min_dihedral) > 0 else 0
            )
            n_new = 0 if self.keeps_cells else self.mend_surfaces(carves, min_dihedral)
            n_gone += n_new
            if n_new == 0 or self.n_below(min_dihedral) == 0 or is_late():
                break
        return n_lifted, n_gone

    def lift(
        self, degrees: float, carves: bool = False, is_late: Callable[[], bool] = lambda: False
    ) -> int:
        """Lift the worst cells above `degrees`, or as far as possible; return the number of moves.
        E may rise.

        On the surface of a mask with details as small as the cells, it may make more cells overlap
        than may be removed (none, unless it `carves`). Then it is undone, and cells stay below the
        minimum dihedral angle.
        """
        before = self.state if self.content.region is None else copy_state(self.state)
        made = repair(self.state, degrees, is_late, reconnects=not self.keeps_cells)
        if self.content.region is not None:
            n_over = int(self._overlapping(made.state).sum())
            if n_over > (self.most_gone if carves else 0):
                self.state = before
                return 0
        self._renumber(made.state, made.source)
        self.hope[:] = np.inf
        return made.n_moves

    def mend_surfaces(self, carves: bool, min_dihedral: float = 0.0) -> int:
        """Mend overlaps and pinches: of a mask's boundary, if it `carves`, by removing cells; then
        of interfaces.

        Cells overlap where parts of the boundary slid through one another, across a gap of a voxel
        or two. The octree within a mask has no pinches, but a user's mesh may. A few cells on the
        boundary that nothing lifted above `min_dihedral`, degrees, are removed, too. Returns the
        number of removed cells.
        """
        n_gone = 0
        if carves and self.content.region is not None:
            n_gone = self._take_out(self._overlapping(self.state))
            if self.n == 3 and min_dihedral > 0.0:
                is_outer = (self.state.complex.across[: self.n_cells] < 0).any(axis=1)
                is_flat = is_outer & (cell_cosines(self.state) < angle_limit_of(min_dihedral)[0])
                if is_flat.sum() <= self.most_gone:
                    n_gone += self._take_out(is_flat)
            keeps, members = self.content.keeps_components, self.content.memberships
            kept = carve_mesh(self.mesh(), self.image, self.content.region, keeps, members)
            n_gone, self.n_dropped = (
                n_gone + self._take_out(~kept.is_kept),
                self.n_dropped + kept.n_dropped,
            )
            self.dropped.update(kept.volumes)
        if self.label_voxels is not None and self.content.memberships is not None:
            mend_pinches(
                self.state, self.image, self.content.memberships, self.mesh(), self.label_voxels
            )
        return n_gone

    @property
    def most_gone(self) -> float:
        """Largest number of flat cells that may be removed."""
        return max(FLAT_CELLS_FRACTION * self.n_cells, FLAT_CELLS)

    def _take_out(self, is_gone: Bools) -> int:
        if is_gone.any():
            made = compact_state(without_cells(self.state, is_gone))
            self._renumber(made.state, made.source)
            if self.has_labels:  # neighbours may have lost the last cell of a label
                meet_everywhere(self.state)
        return int(is_gone.sum())

    def _overlapping(self, state: State) -> Bools:
        """Mask of the cells, (M,), with a voxel centre that a previous cell contains, too."""
        points = self.image.to_world(from_ticks(state.complex.ticks, self.grid, self.n))
        mesh = Mesh(points, state.complex.cells[: int(state.complex.n_cells[0])].copy())
        owner = cell_of_voxel(self.image, mesh)
        n_owned = np.bincount(owner[owner >= 0], minlength=len(mesh.cells))
        if state.objective.image == 0.0:  # the moves have left the sums alone
            remeasure(state)
        return np.asarray(state.complex.sums[: len(n_owned), 0] > n_owned)

    def _renumber(self, state: State, source: Ints) -> None:
        """Adopt a state with other nodes; `source` is each node's previous number, -1 for new
        ones.
        """
        is_new = (source < 0)[:, None]
        self.state = state
        self.ticks_flipped = np.where(is_new, FAR_TICKS, self.ticks_flipped[source])
        self.hope = np.where(is_new[:, 0], np.inf, self.hope[source])
        self.groups, self.edge = blocks(state.complex.ticks), _edges(self.points(), self.cells)

    def movement(self, before: Ints) -> float:
        """Relative movement of the nodes since `before` (N, 3), in ticks; see
        `relative_movement`.
        """
        return relative_movement(
            before, self.state.complex.ticks, self.image, self.grid, self.state.objective.matrix
        )

    def record(
        self, iteration: int, movement: float, is_changed: bool, seconds: float
    ) -> IterationRecord:
        """The history's row for the current state; its E is comparable across the whole run."""
        if self.state.objective.image == 0.0:  # the moves have left the sums alone
            remeasure(self.state)
        E_G, squares = content_energies(self.state, self.content, self.content.n_channels)
        n_voxels = int(self.state.complex.sums[: self.n_cells, 0].sum())
        E = self.state.objective.geometry * E_G + self.state.objective.image * squares
        E_D = squares * self.content.unit * self.image.voxel_volume
        return IterationRecord(
            iteration, E, E_G, E_D, movement, is_changed, self.n_cells, n_voxels, seconds
        )

    def labels(self) -> Ints | None:
        """The label of each cell, (M,); None without labels."""
        members = self.content.memberships
        if self.kept_labels is not None:
            return self.kept_labels[self.state.complex.labels[: self.n_cells]]
        if members is None or not self.has_labels:
            return None
        return members.labels[self.state.complex.labels[: self.n_cells]]

    @property
    def cells(self) -> Ints:
        """The current cells, (M, n+1); a view."""
        return self.state.complex.cells[: self.n_cells]

    def points(self) -> Floats:
        """The current nodes, (N, n) mm."""
        points = self.image.to_world(from_ticks(self.state.complex.ticks, self.grid, self.n))
        if self.kept:  # fixed nodes keep their exact positions, not rounded to ticks
            for node, place in enumerate(self.state.complex.ticks.tolist()):
                points[node] = self.kept.get(tuple(place), points[node])
        return points

    def mesh(self) -> Mesh:
        """The current mesh; nodes of several labels at one place are one node."""
        points, cells = self.points(), self.cells
        if self.kept_labels is not None and not self.keeps_cells:
            _, first, number = np.unique(
                self.state.complex.ticks, axis=0, return_index=True, return_inverse=True
            )
            kept, cells = compact(first[number.ravel()][cells], len(points))
            points = points[kept]
        return Mesh(points, cells)


def _edges(points: Floats, cells: Ints) -> Floats:
    """Edge of the regular cell with the mean volume of the cells around each node, (N,) mm."""
    n, around = points.shape[1], cells.ravel()
    total = np.bincount(around, np.repeat(volumes(points, cells), n + 1), len(points))
    mean = total / np.maximum(np.bincount(around, minlength=len(points)), 1)
    return regular_edge(mean, n)


def check_followed(cell_labels: Ints | None, content: Content, mesh: Mesh) -> Ints:
    """Return the row of each cell's label among the content's labels, (M,), which it keeps.

    Raises InputError for cells without a label, or with one that the content lacks.
    """
    assert content.memberships is not None
    known = content.memberships.labels
    if cell_labels is None or cell_labels.shape != (len(mesh.cells),):
        raise InputError(
            "keep_connectivity: the image has labels, and the cells have none to keep; leave out "
            "`labels`, or give the mesh labels (`tetopt convert`)"
        )
    if len(lost := np.setdiff1d(cell_labels, known)):
        raise InputError(
            f"keep_connectivity: cells have the labels {lost[:5].tolist()}, which the image's "
            f"labels lack: {known[:20].tolist()}"
        )
    return np.searchsorted(known, cell_labels)


def check_cell_labels(cell_labels: Ints, content: Content, mesh: Mesh, boundary: str) -> None:
    """Raise InputError for labels of cells that do not fit a mesh, its content or its boundary."""
    if np.shape(cell_labels) != (len(mesh.cells),):
        raise InputError(
            f"cell_labels: expected {len(mesh.cells)} labels, one for each cell, got an array of "
            f"shape {np.shape(cell_labels)}"
        )
    if content.memberships is not None:
        raise InputError("cell_labels: the content has labels, too; give only one of them")
    has_several = len(np.unique(cell_labels)) > 1
    if has_several and content.region is not None and boundary != "fixed":
        raise InputError(
            "labels and cell sets of the initial mesh: within a mask, only with `boundary` fixed; "
            "or give `labels`"
        )
    check_unfolded(mesh)


def check_options(
    k_D: float,
    iterations: int,
    shape_power: float,
    min_dihedral: float,
    boundary: str,
    nodes: int | None = None,
) -> None:
    """Raise InputError for an option of `optimize` out of range."""
    check_common_options(k_D, iterations, boundary)
    if not 1.0 <= shape_power <= 10.0:
        raise InputError(f"shape_power: expected 1 (the paper's) to 10, got {shape_power}")
    if not 0.0 <= min_dihedral < 70.0:
        raise InputError(
            f"min_dihedral: expected 0 to below 70 degrees, got {min_dihedral}; a regular "
            "tetrahedron has 70.5"
        )
    if nodes is not None and not (isinstance(nodes, int | np.integer) and nodes > 2):
        raise InputError(
            "nodes: expected a whole number above 2, or None to keep the mesh's nodes, got "
            f"{nodes!r}"
        )
