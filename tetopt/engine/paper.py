"""The paper's optimisation: re-tessellate, move every node, measure, repeat."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tetopt.check import filled_share
from tetopt.energy.discretization import E_D_of_sums, combined
from tetopt.energy.geometric import cell_E_G
from tetopt.energy.sampling import (
    SamplingGrid,
    check_orientations,
    facet_fluxes,
    from_ticks,
    moment_sums,
    orientations,
    sampling_grid,
    sums_of_fluxes,
    to_ticks,
)
from tetopt.engine.complex import FLAT_SHARE
from tetopt.engine.descent import Scheme, Tessellation, descend, free_projections, relocate
from tetopt.engine.loop import (
    E_D_ROUNDING,
    UNIFORM_ITERATIONS,
    UNIFORM_K_D,
    Boundary,
    Optimized,
    Record,
    deadline,
    frozen_axes,
    relative_movement,
    side_ticks,
)
from tetopt.engine.promises import promised
from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides, facets_on_sides
from tetopt.geometry.simplex import squared_edges, volumes
from tetopt.geometry.topology import Facets, facets, greedy_colours, rings, stars
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.notebook import with_bar
from tetopt.start.delaunay import delaunay
from tetopt.target.content import plain

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
    callback: Callable[[Record], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Optimized:
    """Move the nodes of a mesh to lower E, by the paper's scheme.

    E = (1 - k_D) E_G + k_D E_D is Eq. (4), with each energy over its value on the initial mesh.

    Parameters
    ----------
    image : Image
        The intensities h.
    mesh : Mesh
        The initial mesh, which also normalises the two energies; for re-tessellation it must fill the image's
        box, as `tetopt.start.lattice.lattice` does.
    k_D : float
        Weight of the image, 0 <= k_D < 1. With 0 a node moves to the minimiser of E_G (Lloyd's relaxation),
        else by descent with numerical derivatives.
    iterations : int
        Number of sweeps over all nodes, at most.
    n_t : int, optional
        Re-tessellation happens in the first n_t iterations only. Default: all for k_D = 0, else half.
    retessellate : {"first", "accept", "never"}
        Take every Delaunay tessellation of the first n_t iterations; in all iterations those that lower E
        (Section 4); or none.
    boundary : {"slide", "fixed"}
        Boundary nodes move within the box's faces and edges, or not at all. Those not on the box are fixed.
    step_ratio : float
        Step of the numerical derivative over the distance to the nearest cell centroid.
    tolerance : float
        Converged when the relative movement of an iteration falls below it.
    max_seconds : float, optional
        Stop at the next colour of nodes after this time; the mesh is valid.
    callback : callable, optional
        Called with each `Record`.
    stop : callable, optional
        Asked between colours of nodes (several times a second on common meshes); True ends the run there.

    Returns
    -------
    Optimized
        Mesh, history and why it ended. The mesh covers the same domain and every cell is positively oriented.
        With the connectivity fixed E never rises, beyond rounding, from one record to the next.

    Raises
    ------
    InputError
        An option out of range, a mesh that the sampling cannot take (see `cell_moments`), with doubled cells, or,
        unless `retessellate` is "never", one that does not fill the image's box.

    See Also
    --------
    optimize : The default engine.

    Examples
    --------
    >>> image = tetopt.load_phantom("disc_2d").image(voxel_mm=4)
    >>> mesh = tetopt.lattice(image, nodes=100)
    >>> result = tetopt.optimize_paper(image, mesh, k_D=0.02, iterations=4)
    >>> [round(record.E, 2) for record in result.history]
    [1.0, 0.92, 0.91, 0.91, 0.91]
    """
    _check_options(k_D, iterations, n_t, retessellate, boundary, step_ratio)
    n_t = default_n_t(k_D, iterations) if n_t is None else n_t
    begin = time.perf_counter()
    is_over = deadline(begin, max_seconds, stop)

    grid = sampling_grid(image, mesh.points)
    tessellation = _initial(image, mesh, grid, boundary)
    if iterations > 0 and (retessellate == "accept" or (retessellate == "first" and n_t > 0)):
        _check_fills_box(image, mesh)
    # Where every cell is uniform, what rounding leaves of E_D must not become the unit that E_D is measured in.
    rounding = E_D_ROUNDING * float(np.var(image.data, dtype=np.float64)) * image.volume
    E_G0, E_D0 = _energies(tessellation, image, rounding)
    scheme = _scheme(image, grid, k_D, E_G0, E_D0, step_ratio)
    history: list[Record] = []

    def record(iteration: int, movement: float, is_new: bool) -> None:
        E_G, E_D = _energies(tessellation, image, rounding)
        E, n_voxels = combined(E_G, E_D, E_G0, E_D0, k_D), int(tessellation.sums[:, 0].sum())
        seconds = time.perf_counter() - begin
        history.append(Record(iteration, E, E_G, E_D, movement, is_new, len(tessellation.cells), n_voxels, seconds))
        if callback is not None:
            callback(history[-1])

    record(0, 0.0, False)
    ended = "iterations"
    for iteration in range(1, iterations + 1):
        # 1. Connect the nodes anew.
        is_new = False
        if retessellate == "accept" or (retessellate == "first" and iteration <= n_t):
            candidate = _retessellated(image, grid, tessellation, scheme.hand)
            limit = history[-1].E if retessellate == "accept" else np.inf
            if candidate and limit > combined(*_energies(candidate, image, rounding), E_G0, E_D0, k_D):
                is_new = not np.array_equal(candidate.cells, tessellation.cells)
                tessellation = candidate
        # 2. Move the nodes, one colour at a time.
        before = tessellation.ticks.copy()
        is_finished = _sweep(tessellation, scheme, relocate if k_D == 0.0 else descend, is_over)
        # 3. Measure.
        if k_D == 0.0:
            tessellation.sums[:] = moment_sums(grid, tessellation.ticks, tessellation.cells)
        movement = relative_movement(before, tessellation.ticks, image, grid, scheme.matrix)
        record(iteration, movement, is_new)
        if not is_finished:
            ended = "stopped" if stop is not None and stop() else "max_seconds"
            break
        if movement < tolerance and not is_new:
            ended = "converged"
            break
    points = image.to_world(from_ticks(tessellation.ticks, grid, image.ndim))
    return promised(Optimized(Mesh(points, tessellation.cells), history, ended), plain(image), 0.0, mesh)


def default_n_t(k_D: float, iterations: int) -> int:
    """Number of first iterations that connect the nodes anew: all for k_D = 0 (Lloyd's alternation), else half."""
    return iterations if k_D == 0.0 else (iterations + 1) // 2


def _check_options(
    k_D: float, iterations: int, n_t: int | None, retessellate: str, boundary: str, step_ratio: float
) -> None:
    if not 0.0 <= k_D < 1.0:
        raise InputError(f"k_D: expected 0 <= k_D < 1, got {k_D}")
    if iterations < 0:
        raise InputError(f"iterations: expected 0 or more, got {iterations}")
    if n_t is not None and n_t < 0:
        raise InputError(f"n_t: expected 0 or more, got {n_t}")
    if retessellate not in ("first", "accept", "never"):
        raise InputError(f"retessellate: expected first, accept or never, got {retessellate!r}")
    if boundary not in ("slide", "fixed"):
        raise InputError(f"boundary: expected slide or fixed, got {boundary!r}")
    if not 0.0 < step_ratio < 1.0:
        raise InputError(f"step_ratio: expected a number between 0 and 1, got {step_ratio}")


def _check_fills_box(image: Image, mesh: Mesh) -> None:
    """Delaunay fills the convex hull of the nodes: InputError for a mesh whose domain is not the image's box."""
    index = image.to_index(mesh.points)
    extent = np.column_stack([index.min(axis=0), index.max(axis=0)])
    is_box = np.abs(extent - box_sides(image.shape)).max() <= ON_SIDE_VOXELS
    if not is_box or abs(filled_share(mesh, image) - 1.0) > 1e-9:
        raise InputError(
            "mesh: re-tessellation needs a mesh that fills the image's box exactly, as a lattice does; "
            'pass retessellate="never" to keep the connectivity'
        )


def _initial(image: Image, mesh: Mesh, grid: SamplingGrid, boundary: Boundary) -> Tessellation:
    """The tessellation of the initial mesh."""
    ticks = to_ticks(image.to_index(mesh.points), grid)
    check_orientations(image, ticks, mesh.cells)
    is_frozen = frozen_axes(image, ticks, mesh.cells, grid, boundary)
    shared = facets(mesh.cells)
    if shared.n_cells.max() > 2:
        raise InputError("mesh: a facet is shared by more than two cells; remove doubled or overlapping cells")
    return _tessellation(image, grid, ticks, mesh.cells, is_frozen, shared)


def _tessellation(
    image: Image, grid: SamplingGrid, ticks: NDArray[np.int64], cells: NDArray[np.int64], is_frozen: NDArray[np.bool_],
    shared: Facets,
) -> Tessellation:  # fmt: skip
    """Everything that a sweep reads and writes, measured afresh; `shared` are the cells' facets."""
    points = image.to_world(from_ticks(ticks, grid, image.ndim))
    cells, around = np.ascontiguousarray(cells, dtype=np.int64), rings(cells, len(ticks))
    fluxes = facet_fluxes(grid, ticks, shared.nodes)
    return Tessellation(
        ticks,
        cells,
        is_frozen,
        *around,
        shared.nodes,
        shared.of_cell,
        shared.sign,
        *stars(shared, around),
        sums_of_fluxes(fluxes, shared, _hand(image)),
        cell_E_G(points, cells),
        fluxes,
    )


def _scheme(image: Image, grid: SamplingGrid, k_D: float, E_G0: float, E_D0: float, step_ratio: float) -> Scheme:
    """The scheme of plain numbers, as the kernels are compiled for."""
    matrix = np.eye(3)
    matrix[3 - image.ndim :, 3 - image.ndim :] = image.affine[:-1, :-1]
    weight = k_D * image.voxel_volume / E_D0 if E_D0 > 0.0 else 0.0
    weights = float((1.0 - k_D) / E_G0), float(weight), float(step_ratio)
    return Scheme(grid.prefix, int(grid.bits), _hand(image), matrix, free_projections(matrix), *weights)


def _hand(image: Image) -> int:
    """The sign in index space of the cells' volumes."""
    return 1 if np.linalg.det(image.affine[:-1, :-1]) > 0 else -1


def _energies(mesh: Tessellation, image: Image, rounding: float) -> tuple[float, float]:
    """E_G and E_D of the mesh; an E_D up to `rounding` is 0."""
    E_D = float(E_D_of_sums(mesh.sums, image.voxel_volume).sum())
    return float(mesh.E_G.sum()), E_D if E_D > rounding else 0.0


def _retessellated(image: Image, grid: SamplingGrid, mesh: Tessellation, hand: int) -> Tessellation | None:
    """The tessellation by Delaunay's cells; None where they would not be a mesh of the same box.

    Checked exactly: every cell oriented on the fixed-point grid, every facet in one or two cells, the boundary's
    facets on the box, and every voxel in one cell.
    """
    index = from_ticks(mesh.ticks, grid, image.ndim)
    cells = delaunay(index, image.affine)
    if cells is None:
        return None
    if (orientations(mesh.ticks, cells) != hand).any() or _is_flat(image.to_world(index), cells).any():
        return None
    shared = facets(cells)
    if shared.n_cells.max() > 2:
        return None
    outer = shared.nodes[shared.n_cells == 1]
    if not facets_on_sides(mesh.ticks, outer, side_ticks(grid), tolerance=0).any(axis=(1, 2)).all():
        return None
    candidate = _tessellation(image, grid, mesh.ticks, cells, mesh.is_frozen, shared)
    return candidate if candidate.sums[:, 0].sum() == image.data.size else None


def _is_flat(points: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Cells so thin that no optimisation may make them, (M,) bool; see `tetopt.engine.complex.FLAT_SHARE`."""
    size = squared_edges(points, cells).sum(axis=1) ** (points.shape[1] / 2)
    return volumes(points, cells) <= FLAT_SHARE * size


def _sweep(
    mesh: Tessellation,
    scheme: Scheme,
    move: Callable[[Tessellation, NDArray[np.int64], Scheme], None],
    is_over: Callable[[], bool],
) -> bool:
    """Move every node once; False if `is_over` cut it short, between two colours."""
    n, colours = mesh.cells.shape[1] - 1, greedy_colours(mesh.cells, mesh.start, mesh.ring)
    is_free = ~mesh.is_frozen[:, 3 - n : 3].all(axis=1)
    for colour in range(colours.max() + 1):
        if is_over():
            return False
        move(mesh, np.flatnonzero((colours == colour) & is_free), scheme)
    return True
