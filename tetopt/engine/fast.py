"""The fast engine: the paper's energy, minimised by analytic gradients and energy-driven flips, with a floor on angles.

Each iteration moves every node down the gradient of its ring's energy (`smooth`) and then exchanges cells wherever
that lowers E (`flips`), which takes the place of Delaunay re-tessellation. No move takes a dihedral angle under the
floor, and a lattice starts far above it, so E falls from first to last. Cells of other initial meshes that are under
the floor are mended at the end (`repair`), if nothing else has lifted them. Keeping the floor all along costs as much
E_D as lifting the worst cells once E has settled (0.3587 of the initial one against 0.3560: MNI152 T1, 4,864 nodes,
k_D = 0.5), and E need not rise for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tetopt.check import check_unfolded
from tetopt.energy.sampling import (
    cell_moments,
    cell_of_voxel,
    channel_grid,
    check_orientations,
    few_threads,
    from_ticks,
    to_ticks,
)
from tetopt.engine.complex import (
    Complex,
    Measure,
    build,
    copied,
    energies,
    floor_of,
    measure_all,
    measure_of,
    node_rings,
)
from tetopt.engine.density import Limits, exchange
from tetopt.engine.flips import flip, make_moves
from tetopt.engine.loop import (
    MIN_DIHEDRAL,
    NOISE,
    SHAPE_POWER,
    UNIFORM_ITERATIONS,
    UNIFORM_K_D,
    Boundary,
    Optimized,
    Record,
    deadline,
    frozen_axes,
    relative_movement,
)
from tetopt.engine.paper import optimize_paper
from tetopt.engine.repair import repair, worst_angles
from tetopt.engine.smooth import blocks, sweep
from tetopt.engine.surface import sides_of
from tetopt.errors import InputError
from tetopt.geometry.simplex import volumes
from tetopt.image import Image, transformed
from tetopt.mesh import Mesh
from tetopt.start.lattice import lattice
from tetopt.start.sizes import Sizes
from tetopt.target.content import Content, plain

STILL = 0.05  # of an edge: nodes that moved less need no new flips
QUIET = 0.02  # of an edge: nodes around which none moved more are not moved again
EXCHANGES = 0.7  # of the iterations: those after which nodes are exchanged
EXCHANGED = 0.1  # of the nodes wanted: the most that are exchanged at once
EAGER = 0.1  # see `_Run.exchange`
FAR = -(1 << 40)  # ticks from anywhere


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
    tolerance: float = 5e-4,
    max_seconds: float | None = None,
    callback: Callable[[Record], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Optimized:
    """Move the nodes of `mesh`, and connect them anew, to lower E = (1 - k_D) E_G + k_D E_D, Eq. (4).

    Parameters
    ----------
    image : Image or Content
        The intensities h; or several channels, over which E_D is summed, and a mask (`tetopt.content`).
    mesh : Mesh
        The initial mesh, which also normalises the two energies: any conforming mesh.
    k_D : float
        Weight of the image, 0 <= k_D < 1.
    iterations : int
        Sweeps over all nodes, at most.
    shape_power : float
        p >= 1: each cell's E_G is weighted by eta^(p - 1), eta >= 1 the cell's mean-edge shape measure (see
        `tetopt.engine.complex.shape_energy`). 1 is the paper's energy, which does not see slivers; above 2.5 it grows
        without bound as a cell goes flat.
    min_dihedral : float
        The smallest dihedral angle that a tetrahedron may have at the end, degrees, 0 (no floor) to below 70. How many
        cells miss it is for the caller to count (`tetopt.quality`); meshes of triangles have no floor.
    boundary : {"slide", "fixed"}
        Boundary nodes move within the box's faces and edges, those not on the box are fixed or, with a mask, whose
        surface they are taken to lie on, slide on that; or the boundary stays as it is, node for node and facet for
        facet, to the last bit.
    nodes : int, optional
        Put nodes where they lower E most, towards this number of them: on a graded mesh, such as `octree`. Every
        cell's shape then counts the same, whatever its size (see `tetopt.engine.complex.shape_energy`), and nodes
        are exchanged in the first iterations, if k_D > 0. An exchange doubles them at most, so that few iterations, or
        a number far from that of `mesh`, may miss it; count them. By default the nodes of `mesh` are kept, and the
        shape energy is that of Eq. (1).
    sizes : Sizes, optional
        Limits on the edges that exchanges make, with `nodes`.
    tolerance : float
        Converged when E falls by less, relatively, in an iteration.
    max_seconds : float, optional
        Stop at the next colour of nodes after this time; the mesh is valid, and its floor is seen to, which, like the
        flips of an iteration, takes its time besides.
    callback : callable, optional
        Called with each `Record`. Its E_G is the weighted one, its `is_retessellated` whether cells were exchanged.
    stop : callable, optional
        Asked between colours of nodes; True ends the run there.

    Returns
    -------
    Optimized
        Mesh, history and why it ended. The mesh covers the same domain, every cell is positively oriented. E never
        rises from one record to the next, unless cells of the initial mesh had to be lifted over the floor, for which
        nodes may be put in or taken out, or nodes were exchanged. The same bits on any number of threads.

    Raises
    ------
    InputError
        An option out of range; a mesh that the sampling cannot take (see `tetopt.cell_moments`), that is folded or
        has a facet in more than two cells, or a cell too flat to have a shape energy; or energies that overflow.
    """
    check_options(k_D, iterations, shape_power, min_dihedral, boundary, nodes)
    begin = time.perf_counter()
    is_over = deadline(begin, max_seconds, stop)
    wanted = plain(image)
    image = wanted.image
    sizes = (Sizes() if sizes is None else sizes).prepared(image.ndim)
    run = _Run(wanted, mesh, k_D, shape_power, boundary, is_graded=nodes is not None)
    history: list[Record] = []

    def record(iteration: int, movement: float, is_changed: bool) -> None:
        history.append(run.record(iteration, movement, is_changed, time.perf_counter() - begin))
        if callback is not None:
            callback(history[-1])

    record(0, 0.0, False)
    ended = "iterations"
    floor = min_dihedral if run.n == 3 else 0.0
    if iterations > 0:
        run.keep_floor(floor)
    for iteration in range(1, iterations + 1):
        before = run.held.ticks.copy()
        is_finished = run.sweep(is_over)
        is_changed = run.flip() > 0 if is_finished else False
        is_early = nodes is not None and k_D > 0.0 and iteration <= EXCHANGES * iterations
        movement = relative_movement(before, run.held.ticks, image, run.grid, run.matrix)
        fall = 1.0 - run.E() / history[-1].E if history[-1].E > 0.0 else 0.0
        is_last = iteration == iterations or not is_finished or (fall < tolerance and not is_early)
        if nodes is not None and is_early and not is_last and iteration % 2 == 1:
            is_changed |= run.exchange(nodes, sizes) > 0
        if is_last and run.n_below(floor) > 0 and run.lift(floor) > 0:
            is_changed, fall = True, np.inf
        record(iteration, movement, is_changed)
        if not is_finished:
            ended = "stopped" if stop is not None and stop() else "max_seconds"
            break
        if is_last and fall < tolerance:
            ended = "converged"
            break
    return Optimized(run.mesh(), history, ended)


def prepare_kernels(
    image: Image | Content, k_D: float, method: Literal["fast", "paper"] = "fast", is_graded: bool = False
) -> None:
    """Compile the kernels of a method for images of this kind, or load them, before a clock starts.

    The sampling has kernels of its own for whole-number images whose sums fit 32 bits; see `sampling_grid`. The repair
    is left to be compiled when a mesh wants it.
    """
    wanted = plain(image)
    image = wanted.image
    is_whole = not wanted.is_plain or np.array_equal(np.rint(image.data), image.data)
    step = 1.0 if is_whole else 0.1
    tiny = Image(np.zeros((3,) * image.ndim) + step * np.arange(3))
    mesh = lattice(tiny, blocks=(1,) * image.ndim)
    if method == "paper":
        optimize_paper(tiny, mesh, k_D=k_D, iterations=1)
        return
    optimize(tiny, mesh, k_D=k_D, iterations=1)
    run = _Run(plain(tiny), mesh, k_D, SHAPE_POWER, "slide")
    none = np.empty(0, dtype=np.int64)  # nothing can be gained on so small a mesh, so that no move is made of itself
    make_moves(none, none, np.zeros(len(run.held.cells), dtype=np.bool_), run.held, run.measure)
    if is_graded:
        run.exchange(len(mesh.points), Sizes())


class _Run:
    """What one optimisation works on, and its steps."""

    def __init__(
        self, wanted: Content, mesh: Mesh, k_D: float, power: float, boundary: Boundary, is_graded: bool = False
    ) -> None:
        self.wanted, image = wanted, wanted.image
        self.image, self.n = image, image.ndim
        self.grid = channel_grid(wanted, mesh.points)
        ticks = to_ticks(image.to_index(mesh.points), self.grid)
        check_orientations(image, ticks, mesh.cells)
        check_unfolded(mesh)
        region = wanted.region
        self.is_frozen = frozen_axes(image, ticks, mesh.cells, self.grid, boundary, region is not None)
        self.is_still = self.is_frozen[:, 3 - self.n : 3].all(axis=1)
        is_kept = self.is_still if boundary == "fixed" else np.zeros(len(ticks), dtype=bool)
        self.kept = dict(zip(map(tuple, ticks[is_kept].tolist()), mesh.points[is_kept], strict=True))
        self.matrix = np.eye(3)
        self.matrix[3 - self.n :, 3 - self.n :] = image.affine[:-1, :-1]
        level = None if region is None else region.level
        self.sides = sides_of(self.grid, self.matrix, boundary == "fixed", level)
        hand = 1 if np.linalg.det(image.affine[:-1, :-1]) > 0 else -1
        unit = measure_of(self.grid, hand, self.matrix, 1.0, 1.0, power, is_graded)
        self.held: Complex = build(mesh.cells, ticks, unit)
        flat = np.flatnonzero(~np.isfinite(self.held.E_shape[: len(mesh.cells)]))
        if len(flat):
            raise InputError(
                f"mesh: {len(flat)} cells are too flat to be improved, the first are {flat[:5].tolist()}; "
                "remove them or move their nodes apart"
            )
        # Where every cell is uniform, what rounding leaves of E_D must not become the unit that E_D is measured in.
        self.noise = NOISE * wanted.variance / wanted.unit * wanted.n_voxels
        self.E_G0, self.squares0 = self.energies()
        weight = k_D / self.squares0 if self.squares0 > 0.0 else 0.0
        if not (0.0 < self.E_G0 < np.inf and np.isfinite(self.squares0) and np.isfinite(weight)):
            raise InputError(
                "mesh and image: their energies overflow; are lengths in mm and intensities of usual size?"
            )
        self.measure: Measure = measure_of(
            self.grid, hand, self.matrix, (1.0 - k_D) / self.E_G0, weight, power, is_graded,
            0.0 if region is None else weight * wanted.wrong_side, boundary == "fixed",
        )  # fmt: skip
        self.groups = blocks(ticks)
        self.edge = _edges(mesh)
        self.image_noise: float | None = None  # its variance, found when it is wanted
        self.seen = np.full_like(ticks, FAR)  # where nodes were when their flips were last looked at
        self.tried = np.full_like(ticks, FAR)  # and when the nodes around them were moved because of it

    def energies(self) -> tuple[float, float]:
        """Shape energy and sum of squares, with the mask's misfit; squares that are only rounding count as 0."""
        E_G, squares = energies(self.held, self.grid.n_channels)
        if self.wanted.region is not None:
            squares += self.wanted.wrong_side * self.n_misfits()
        return E_G, squares if squares > self.noise else 0.0

    def n_misfits(self) -> int:
        """Voxels of the mask outside of the mesh, and others inside of it."""
        return self.wanted.n_voxels + int(self.held.sums[: int(self.held.n_cells[0]), -1].sum())

    def E(self) -> float:
        E_G, squares = self.energies()
        return self.measure.geometry * E_G + self.measure.image * squares

    def sweep(self, is_over: Callable[[], bool]) -> bool:
        """Move every node whose ring has changed since it was last moved; False if `is_over` cut it short."""
        is_near = np.zeros(len(self.tried), dtype=bool)
        cells = self.held.cells[: int(self.held.n_cells[0])]
        is_near[cells[self._moved(self.tried, QUIET)[cells].any(axis=1)]] = True
        return sweep(
            self.held, node_rings(self.held), self.groups, is_near & ~self.is_still, self.is_frozen, self.measure,
            self.sides, is_over,
        )  # fmt: skip

    def flip(self) -> int:
        """Exchange cells around the nodes that have moved; the number of exchanges."""
        moved = self._moved(self.seen, STILL)
        is_dirty = moved[self.held.cells[: int(self.held.n_cells[0])]].any(axis=1)
        is_touched = np.zeros(len(moved), dtype=bool)
        self.held, made = flip(self.held, self.measure, np.asarray(is_dirty), is_touched=is_touched)
        self.tried[is_touched] = FAR
        return made

    def _moved(self, since: NDArray[np.int64], share: float) -> NDArray[np.bool_]:
        """Nodes that are more than a share of an edge away from `since`, which is brought up to date for them."""
        way = transformed((self.held.ticks - since).astype(np.float64), self.matrix * 2.0**-self.grid.bits)
        moved: NDArray[np.bool_] = (way**2).sum(axis=1) > (share * self.edge) ** 2
        since[moved] = self.held.ticks[moved]
        return moved

    def exchange(self, nodes: int, sizes: Sizes) -> int:
        """Splits and collapses towards a number of nodes; how many nodes were put in or taken out.

        A shape's cost is counted at a tenth: most of it goes when the nodes around move again.
        """
        eager = self.measure._replace(geometry=EAGER * self.measure.geometry)
        most, mesh = int(EXCHANGED * nodes), self.mesh()
        if self.image_noise is None:
            self.image_noise = self.wanted.noise
        longest = sizes.longest_edges(self.image, nodes, mesh.points, mesh.cells, self.edge, self.wanted.volume)
        limits = Limits(float(sizes.smallest), longest, self.image_noise)
        done = exchange(self.held, self.is_frozen, eager, self.sides, nodes, most, limits)
        self._renumber(done.held, done.is_frozen, done.source)
        self.tried[done.is_touched] = FAR
        self.seen[done.is_touched] = FAR
        return done.n_split + done.n_collapsed

    def keep_floor(self, degrees: float) -> None:
        """Let no move leave a dihedral angle under `degrees`, nor one that is under it already any smaller."""
        floor, safe = floor_of(degrees)
        self.measure = self.measure._replace(floor=floor, safe=safe)

    def n_below(self, degrees: float) -> int:
        """Tetrahedra with an angle under `degrees`."""
        return worst_angles(self.held, self.measure, degrees) if degrees > 0.0 else 0

    def lift(self, degrees: float) -> int:
        """Lift the worst cells over `degrees`, or as far as they go; the number of moves. It may raise E.

        On the surface of a mask whose details are as small as the cells it may lay cells over one another; then none
        of it is done, and the floor is missed.
        """
        before = self.held if self.wanted.region is None else copied(self.held)
        done = repair(self.held, self.is_frozen, self.measure, self.sides, degrees)
        if self.wanted.region is not None and self._overlaps(done.held):
            self.held = before
            return 0
        self._renumber(done.held, done.is_frozen, done.source)
        self.tried[:] = FAR
        return done.n_moves

    def _overlaps(self, held: Complex) -> bool:
        """Whether a voxel centre lies in two cells."""
        points = self.image.to_world(from_ticks(held.ticks, self.grid, self.n))
        mesh = Mesh(points, held.cells[: int(held.n_cells[0])].copy())
        covered = int((cell_of_voxel(self.image, mesh) >= 0).sum())
        return int(cell_moments(self.image, mesh).n_voxels.sum()) != covered

    def _renumber(self, held: Complex, is_frozen: NDArray[np.bool_], source: NDArray[np.int64]) -> None:
        """Take over a complex with other nodes: where each comes from, -1 for new ones."""
        is_new = (source < 0)[:, None]
        self.held, self.is_frozen = held, is_frozen
        self.is_still = is_frozen[:, 3 - self.n : 3].all(axis=1)
        self.seen, self.tried = (np.where(is_new, FAR, since[source]) for since in (self.seen, self.tried))
        self.groups, self.edge = blocks(held.ticks), _edges(self.mesh())

    def record(self, iteration: int, movement: float, is_changed: bool, seconds: float) -> Record:
        if self.measure.image == 0.0:  # the moves have left the sums alone
            with few_threads(int(self.held.n_cells[0]) * 4):
                measure_all(self.held, self.measure)
        E_G, squares = self.energies()
        n_cells = int(self.held.n_cells[0])
        n_voxels = int(self.held.sums[:n_cells, 0].sum())
        error = squares * self.wanted.unit * self.image.voxel_volume
        return Record(iteration, self.E(), E_G, error, movement, is_changed, n_cells, n_voxels, seconds)

    def mesh(self) -> Mesh:
        points = self.image.to_world(from_ticks(self.held.ticks, self.grid, self.n))
        if self.kept:  # nodes that may not move come back to the last bit, not rounded to ticks
            for node, place in enumerate(self.held.ticks.tolist()):
                points[node] = self.kept.get(tuple(place), points[node])
        return Mesh(points, self.held.cells[: int(self.held.n_cells[0])].copy())


def _edges(mesh: Mesh) -> NDArray[np.float64]:
    """Edge of the regular cell that has the mean volume of the cells around each node, (N,) mm."""
    n, around = mesh.ndim, mesh.cells.ravel()
    total = np.bincount(around, np.repeat(volumes(mesh.points, mesh.cells), n + 1), len(mesh.points))
    mean = total / np.maximum(np.bincount(around, minlength=len(mesh.points)), 1)
    return (2.0**0.5 * 6.0 * mean) ** (1 / 3) if n == 3 else (4.0 / 3.0**0.5 * mean) ** 0.5


def check_options(
    k_D: float, iterations: int, shape_power: float, min_dihedral: float, boundary: str, nodes: int | None = None
) -> None:
    """InputError for an option of `optimize` out of range."""
    if not 0.0 <= k_D < 1.0:
        raise InputError(f"k_D: expected 0 <= k_D < 1, got {k_D}")
    if iterations < 0:
        raise InputError(f"iterations: expected 0 or more, got {iterations}")
    if not 1.0 <= shape_power <= 10.0:
        raise InputError(f"shape_power: expected 1 (the paper's) to 10, got {shape_power}")
    if not 0.0 <= min_dihedral < 70.0:
        raise InputError(
            f"min_dihedral: expected 0 to below 70 degrees, got {min_dihedral}; a regular tetrahedron has 70.5"
        )
    if nodes is not None and not (isinstance(nodes, int | np.integer) and nodes > 2):
        raise InputError(f"nodes: expected a whole number above 2, or None to keep those of the mesh, got {nodes!r}")
    if boundary not in ("slide", "fixed"):
        raise InputError(f"boundary: expected slide or fixed, got {boundary!r}")
