"""The paper's optimisation: re-tessellate, move every node, measure, repeat."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

import numpy as np

from tetopt.contents.content import plain
from tetopt.energy.discretization import combine_energies
from tetopt.energy.geometric import cell_E_G
from tetopt.energy.sampling import (
    SamplingGrid,
    from_ticks,
    moment_sums,
    orientations,
    sampling_grid,
)
from tetopt.engine.complex import State, build, cell_squares, node_stars
from tetopt.engine.loop import (
    UNIFORM_ITERATIONS,
    UNIFORM_K_D,
    Boundary,
    IterationRecord,
    MeshingResult,
    check_common_options,
    deadline,
    relative_movement,
    side_ticks,
)
from tetopt.engine.paper_moves import Moves, descend, relocate
from tetopt.engine.state import unweighted_state, weigh_state
from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides, facets_on_sides
from tetopt.geometry.check import filled_fraction
from tetopt.geometry.topology import facets, folded_groups, greedy_colours
from tetopt.image import Image
from tetopt.interop.notebook import with_bar
from tetopt.mesh import Mesh
from tetopt.start.delaunay import delaunay
from tetopt.system.arrays import Ints
from tetopt.system.kernels import pack_record

Retessellate = Literal["first", "accept", "never"]


@with_bar
def optimize_paper(
    image: Image,
    mesh: Mesh,
    *,
    k_D: float = UNIFORM_K_D,
    iterations: int = UNIFORM_ITERATIONS,
    n_t: int | None = None,
    retessellate: Retessellate = "first",
    boundary: Boundary = "slide",
    step_ratio: float = 0.25,
    tolerance: float = 1e-5,
    max_seconds: float | None = None,
    callback: Callable[[IterationRecord], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> MeshingResult:
    """Move the nodes of a mesh to lower E by the paper's scheme.

    E = (1 - k_D) E_G + k_D E_D is Eq. (4), with each energy relative to its value on the initial
    mesh.

    Parameters
    ----------
    image : Image
        The intensities h.
    mesh : Mesh
        The initial mesh, which also normalises the two energies; for re-tessellation it must fill
        the image's box, as `tetopt.start.lattice.lattice_mesh` does.
    k_D : float
        Weight of the image, 0 <= k_D < 1. With 0 a node moves to the minimiser of E_G (Lloyd's
        relaxation); otherwise it moves by descent with numerical derivatives.
    iterations : int
        Maximum number of sweeps over all nodes.
    n_t : int, optional
        Number of first iterations with re-tessellation. Default: all for k_D = 0, else half.
    retessellate : {"first", "accept", "never"}
        "first": accept every Delaunay tessellation of the first n_t iterations. "accept": in all
        iterations, accept those that lower E (Section 4). "never": keep the connectivity.
    boundary : {"slide", "fixed"}
        Boundary nodes move within the box's faces and edges, or not at all. Those off the box are
        fixed.
    step_ratio : float
        Step of the numerical derivative over the distance to the nearest cell centroid.
    tolerance : float
        The run has converged if the relative movement of an iteration falls below this.
    max_seconds : float, optional
        Stop at the next colour of nodes after this time; the mesh is valid.
    callback : callable, optional
        Called with each `IterationRecord`.
    stop : callable, optional
        Called between colours of nodes (several times a second on common meshes); True ends the
        run.

    Returns
    -------
    MeshingResult
        Mesh, history and reason for the end. The mesh covers the same domain and every cell is
        positively oriented. With fixed connectivity, E never rises between records, except by
        rounding.

    Raises
    ------
    InputError
        An option out of range; a mesh that is invalid for sampling (see `cell_moments`) or has
        cells that overlap at a facet; or, unless `retessellate` is "never", a mesh that does not
        fill the image's box.

    See Also
    --------
    optimize : The default engine.

    Examples
    --------
    >>> image = tetopt.load_phantom("disc_2d").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=100)
    >>> result = tetopt.optimize_paper(image, mesh, k_D=0.02, iterations=4)
    >>> [round(record.E, 2) for record in result.history]
    [1.0, 0.92, 0.91, 0.91, 0.91]
    """
    _check_options(k_D, iterations, n_t, retessellate, boundary, step_ratio)
    n_t = default_n_t(k_D, iterations) if n_t is None else n_t
    begin = time.perf_counter()
    is_over = deadline(begin, max_seconds, stop)

    grid = sampling_grid(image, mesh.points)
    state = _initial(image, mesh, grid, k_D, boundary)
    if iterations > 0 and (retessellate == "accept" or (retessellate == "first" and n_t > 0)):
        _check_fills_box(image, mesh)
    E_G0, E_D0 = _energies(state, image)
    history: list[IterationRecord] = []

    def record(iteration: int, movement: float, is_new: bool) -> None:
        E_G, E_D = _energies(state, image)
        n_cells, seconds = len(_cells(state)), time.perf_counter() - begin
        E, n_voxels = (
            combine_energies(E_G, E_D, E_G0, E_D0, k_D),
            int(state.complex.sums[:n_cells, 0].sum()),
        )
        history.append(
            IterationRecord(iteration, E, E_G, E_D, movement, is_new, n_cells, n_voxels, seconds)
        )
        if callback is not None:
            callback(history[-1])

    record(0, 0.0, False)
    ended = "iterations"
    for iteration in range(1, iterations + 1):
        # 1. Reconnect the nodes.
        is_new = False
        if retessellate == "accept" or (retessellate == "first" and iteration <= n_t):
            candidate = _retessellate(image, grid, state)
            limit = history[-1].E if retessellate == "accept" else np.inf
            if candidate and limit > combine_energies(
                *_energies(candidate, image), E_G0, E_D0, k_D
            ):
                is_new = not np.array_equal(_cells(candidate), _cells(state))
                state = candidate
        # 2. Move the nodes, one colour at a time.
        before = state.complex.ticks.copy()
        is_finished = _sweep(state, step_ratio, k_D, is_over)
        # 3. Measure.
        if state.objective.image == 0.0:  # moves did not update the sums
            state.complex.sums[: len(_cells(state))] = moment_sums(
                grid, state.complex.ticks, _cells(state)
            )
        movement = relative_movement(
            before, state.complex.ticks, image, grid, state.objective.matrix
        )
        record(iteration, movement, is_new)
        if not is_finished:
            ended = "stopped" if stop is not None and stop() else "max_seconds"
            break
        if movement < tolerance and not is_new:
            ended = "converged"
            break
    points = image.to_world(from_ticks(state.complex.ticks, grid, image.ndim))
    return MeshingResult(Mesh(points, _cells(state)), history, ended, mesh)


def _cells(state: State) -> Ints:
    """The cells of a state, (M, n+1)."""
    return state.complex.cells[: int(state.complex.n_cells[0])]


def default_n_t(k_D: float, iterations: int) -> int:
    """Number of first iterations that reconnect the nodes: all for k_D = 0 (Lloyd's
    alternation), else half.
    """
    return iterations if k_D == 0.0 else (iterations + 1) // 2


def _check_options(
    k_D: float,
    iterations: int,
    n_t: int | None,
    retessellate: str,
    boundary: str,
    step_ratio: float,
) -> None:
    check_common_options(k_D, iterations, boundary)
    if n_t is not None and n_t < 0:
        raise InputError(f"n_t: expected 0 or more, got {n_t}")
    if retessellate not in ("first", "accept", "never"):
        raise InputError(f"retessellate: expected first, accept or never, got {retessellate!r}")
    if not 0.0 < step_ratio < 1.0:
        raise InputError(f"step_ratio: expected a number between 0 and 1, got {step_ratio}")


def _check_fills_box(image: Image, mesh: Mesh) -> None:
    """Raise InputError unless the mesh fills the image's box, as Delaunay fills the convex hull
    of the nodes.
    """
    index = image.to_index(mesh.points)
    extent = np.column_stack([index.min(axis=0), index.max(axis=0)])
    is_box = np.abs(extent - box_sides(image.shape)).max() <= ON_SIDE_VOXELS
    if not is_box or abs(filled_fraction(mesh, image) - 1.0) > 1e-9:
        raise InputError(
            "mesh: re-tessellation requires a mesh that fills the image's box exactly, as a "
            "lattice does; "
            'pass retessellate="never" to keep the connectivity'
        )


def _initial(image: Image, mesh: Mesh, grid: SamplingGrid, k_D: float, boundary: Boundary) -> State:
    """The state of the initial mesh, which normalises the two energies."""
    state = _with_E_G(unweighted_state(plain(image), mesh, grid, 1.0, boundary), image, grid)
    E_G0, E_D0 = _energies(state, image)
    if k_D == 0.0:
        return weigh_state(state, 1.0, 0.0)
    weight = k_D * image.voxel_volume / E_D0 if E_D0 > 0.0 else 0.0
    return weigh_state(state, float((1.0 - k_D) / E_G0), float(weight))


def _with_E_G(state: State, image: Image, grid: SamplingGrid) -> State:
    """The state with E_G of its cells as in `tetopt.energy.geometric`."""
    points, cells = image.to_world(from_ticks(state.complex.ticks, grid, image.ndim)), _cells(state)
    state.complex.E_shape[: len(cells)] = cell_E_G(points, cells)
    return state


def _energies(state: State, image: Image) -> tuple[float, float]:
    """E_G and E_D of the mesh; an E_D that is only rounding is 0."""
    E_G = state.complex.E_shape[: len(_cells(state))].sum()
    E_D = (cell_squares(state) * image.voxel_volume).sum()
    return float(E_G), float(E_D) if E_D > state.objective.rounding * image.voxel_volume else 0.0


def _retessellate(image: Image, grid: SamplingGrid, state: State) -> State | None:
    """The state with Delaunay cells; None if they are not a mesh of the same box.

    The checks are exact: every cell is oriented on the fixed-point grid, every facet lies between
    two cells or on the box, every voxel is in one cell, and no cell is flat.
    """
    mesh = state.complex
    cells = delaunay(from_ticks(mesh.ticks, grid, image.ndim), image.affine)
    if cells is None or (orientations(mesh.ticks, cells) != state.objective.hand).any():
        return None
    shared = facets(cells)
    outer = shared.nodes[shared.n_cells == 1]
    is_on_box = facets_on_sides(mesh.ticks, outer, side_ticks(grid), tolerance=0).any(axis=(1, 2))
    if len(folded_groups(cells, shared)) or not is_on_box.all():
        return None
    candidate = build(cells, mesh.ticks, mesh.is_frozen, state.objective, state.sides)
    is_flat = ~np.isfinite(candidate.complex.E_shape[: len(cells)])
    if is_flat.any() or candidate.complex.sums[: len(cells), 0].sum() != image.data.size:
        return None
    return _with_E_G(candidate, image, grid)


def _sweep(state: State, step_ratio: float, k_D: float, is_over: Callable[[], bool]) -> bool:
    """Move every node once; return False if `is_over` cut it short, between two colours."""
    stars, cells = node_stars(state), _cells(state)
    colours = greedy_colours(cells, stars.start, stars.cells)
    is_free = ~state.complex.is_frozen[:, 4 - cells.shape[1] : 3].all(axis=1)
    move = relocate if k_D == 0.0 else descend
    laid_out = pack_record(state), pack_record(stars)
    for colour in range(colours.max() + 1):
        if is_over():
            return False
        move(Moves(*laid_out, np.flatnonzero((colours == colour) & is_free), step_ratio))
    return True
