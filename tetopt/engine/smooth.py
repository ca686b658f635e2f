"""Moving nodes along the analytic gradient of E, groups of one colour at a time.

The shape energy's derivative is in closed form. That of E_D, connectivity fixed, needs only the facets around the
node: with hbar_j the mean of cell j, dE_D/dx_a is the sum over the cells of the integral of (h - hbar_j)^2 phi_a n
over their facets, phi_a the node's hat function and n the outward normal; hbar's own change drops out, because it is
the minimiser. Two cells share a facet with opposite normals, so what counts is (h - hbar_j)^2 - (h - hbar_i)^2.

Groups of nodes of one colour share no cell, so each is worked on, and its rings rewritten, at the same time as the
others; the result does not depend on the threads. A move is made only if no cell of the ring loses its orientation
(exactly, in integers) and the ring's measured energy falls, so E never rises.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.energy.geometric import volume_and_E_G, volume_gradient
from tetopt.energy.sampling import few_threads
from tetopt.engine.complex import (
    NodeRings,
    Objective,
    State,
    cell_energy,
    cell_value,
    cosine_up_to_floor,
    facet_area,
    has_node,
    image_energy,
    is_interface,
    load_cell,
    outward,
    pair_tension,
    place,
    put_flux,
    shape_of_cell,
    sum_up,
    wrong_side,
)
from tetopt.engine.surface import (
    combined_ways,
    is_on_surface,
    normals_at,
    projection_at,
    put_on_surface,
    ring_faces_up,
    slides,
)
from tetopt.geometry.topology import greedy_colours
from tetopt.geometry.vectors import cross, difference, dot, minus, put_row, row, scaled, times
from tetopt.kernels import (
    Bools1,
    Floats1,
    Floats2,
    Floats3,
    Ints1,
    Ints2,
    by_value,
    entry,
    helper,
    inlined,
    packed,
    run,
    unit,
)

FACET_PARTS = 8  # most parts that a facet's edge is cut into when h is integrated over it; four times as many in 2-D
PART_VOXELS = 2.0  # voxels between the points at which h is then taken
FIRST_STEP_SHARE = 0.5  # of the distance to the nearest centroid of the ring's cells: the longest first step
PROBE_SHARE = 0.3  # of that step: how far a stalled node looks along the axes
BLOCK_NODES = 128  # nodes in a group, at most: what they read fits the cache
APPROACH_TRIALS = 4  # of the way to a surface: all of it, a half, ...
LINE_TRIALS = 3  # energies measured along the gradient, at most


class Blocks(NamedTuple):
    """Nodes in groups that lie together."""

    nodes: Ints1  # (N,) one group after the other
    start: Ints1  # (B+1,) where each begins
    of_node: Ints1  # (N,) the group of each node


def blocks(ticks: NDArray[np.int64]) -> Blocks:
    """Groups of nodes along a Z-order curve (Morton 1966), so that a graded mesh gets groups of equal number."""
    size = max(1, min(BLOCK_NODES, len(ticks) // 64))
    low, high = ticks.min(axis=0), ticks.max(axis=0)
    cell = (ticks - low) * 1023 // np.maximum(high - low, 1)
    code = np.zeros(len(ticks), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    nodes = np.argsort(code, kind="stable")
    start = np.append(np.arange(0, len(nodes), size), len(nodes))
    of_node = np.empty(len(nodes), dtype=np.int64)
    of_node[nodes] = np.repeat(np.arange(len(start) - 1), np.diff(start))
    return Blocks(nodes, start, of_node)


def sweep(
    state: State,
    rings: NodeRings,
    groups: Blocks,
    may_move: NDArray[np.bool_],
    is_over: Callable[[], bool] = lambda: False,
) -> bool:
    """Move the nodes that may, `may_move` (N,), each along the axes, and on the surface, that `is_frozen` leaves it.

    Groups of one colour share no cell, and are worked on at the same time, their nodes one after the other: those read
    the same voxels, 1.5 to 2 times faster from the cache than nodes of one colour all over the volume. Returns False if
    `is_over` cut it short, between two colours.
    """
    laid_out = packed(state), packed(rings), packed(groups)
    for chosen in colours_of(state, rings, groups):
        if is_over():
            return False
        with few_threads(len(chosen) * BLOCK_NODES * 100):
            run(_sweep, len(chosen), Sweep(*laid_out, chosen, may_move))
    return True


def colours_of(state: State, rings: NodeRings, groups: Blocks) -> list[NDArray[np.int64]]:
    """The groups of each colour: none shares a cell with another of its colour."""
    start, cells = _block_rings(groups.nodes, groups.start, rings.start, rings.cells)
    colours = greedy_colours(groups.of_node[state.complex.cells[: state.complex.n_cells[0]]], start, cells)
    return [np.flatnonzero(colours == colour) for colour in range(int(colours.max()) + 1)]


@entry
def _block_rings(nodes: NDArray, start: NDArray, ring_start: NDArray, ring_cells: NDArray) -> tuple:
    """The cells around the nodes of each group, as `Rings`; cells may be named several times."""
    first = np.zeros(len(start), dtype=np.int64)
    cells = np.empty(len(ring_cells), dtype=np.int64)
    count = 0
    for block in range(len(start) - 1):
        for at in range(start[block], start[block + 1]):
            for r in range(ring_start[nodes[at]], ring_start[nodes[at] + 1]):
                cells[count] = ring_cells[r]
                count += 1
        first[block + 1] = count
    return first, cells


def gradient(state: State, rings: NodeRings) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of the two weighted terms of E by every node's position, (N, 3) each, per mm: shape and image."""
    shape, image = np.zeros((len(state.complex.ticks), 3)), np.zeros((len(state.complex.ticks), 3))
    run(_gradients, len(shape), Gradients(shape, image, state, rings))
    return shape, image


@unit
def _facet_moments(moment: Floats1, ticks: Ints2, node: int, b: int, c: int, objective: Objective) -> float:
    """Means of phi and h phi over the facet (node, b, c), or the segment (node, b), phi the node's hat function.

    Those of h phi go to `moment` (n_channels,), h a voxel's values less the grid's shift; 1/3 (1/2 in 2-D) is the mean
    of phi itself.
    """
    if objective.is_short:
        return _moments_of(moment, objective.short_prefix, ticks, node, b, c, objective)
    return _moments_of(moment, objective.prefix, ticks, node, b, c, objective)


@helper
def _moments_of(
    moment: NDArray, prefix: NDArray, ticks: NDArray, node: int, b: int, c: int, objective: Objective
) -> float:
    n_more, scale = objective.n_channels - 1, 2.0**-objective.bits
    for d in range(1 + n_more):
        moment[d] = 0.0
    a = scaled(scale, row(ticks, node))
    e = minus(scaled(scale, row(ticks, b)), a)
    most_i, most_j, most_k = prefix.shape[0] - 1, prefix.shape[1] - 1, prefix.shape[2] - 2
    weight, first = 0.0, 0.0
    if c < 0:
        parts = min(max(int(np.sqrt(dot(e, e)) / PART_VOXELS) + 1, 2), 4 * FACET_PARTS)
        for p in range(parts):
            s = (p + 0.5) / parts
            j = min(max(int(np.rint(a[1] + s * e[1])), 0), most_j)
            k = min(max(int(np.rint(a[2] + s * e[2])), 0), most_k)
            phi = 1.0 - s
            weight += phi
            first += phi * (prefix[0, j, k + 1, 0] - prefix[0, j, k, 0])
            for d in range(n_more):
                moment[1 + d] += phi * (prefix[0, j, k + 1, 2 + d] - prefix[0, j, k, 2 + d]) / parts
        moment[0] = first / parts
        return weight / parts
    f = minus(scaled(scale, row(ticks, c)), a)
    parts = min(max(int(np.sqrt(max(dot(e, e), dot(f, f))) / PART_VOXELS) + 1, 2), FACET_PARTS)
    for p in range(parts):
        for q in range(parts - p):
            for half in range(2):
                if half == 1 and p + q == parts - 1:
                    continue
                s = (p + (1.0 + half) / 3.0) / parts
                t = (q + (1.0 + half) / 3.0) / parts
                i = min(max(int(np.rint(a[0] + s * e[0] + t * f[0])), 0), most_i)
                j = min(max(int(np.rint(a[1] + s * e[1] + t * f[1])), 0), most_j)
                k = min(max(int(np.rint(a[2] + s * e[2] + t * f[2])), 0), most_k)
                phi = 1.0 - s - t
                weight += phi
                first += phi * (prefix[i, j, k + 1, 0] - prefix[i, j, k, 0])
                for d in range(n_more):
                    moment[1 + d] += phi * (prefix[i, j, k + 1, 2 + d] - prefix[i, j, k, 2 + d]) / (parts * parts)
    moment[0] = first / (parts * parts)
    return weight / (parts * parts)


@unit
def _add_image_gradient(g: Floats1, state: State, rings: NodeRings, node: int) -> None:
    """Add the derivative of the weighted E_D by a node's position to g (3,), per mm."""
    cells, sums, ticks, objective = state.complex.cells, state.complex.sums, state.complex.ticks, state.objective
    n, first, scale = cells.shape[1], rings.start[node], 2.0**-objective.bits
    moment = np.empty(objective.n_channels)
    g0, g1, g2 = 0.0, 0.0, 0.0  # per voxel along each axis
    for r in range(first, rings.start[node + 1]):
        cell = rings.cells[r]
        for k in range(n):
            twin = rings.twin[r, k]
            if k == rings.corner[r] or twin < 0 or twin // n < r - first:
                continue  # not a facet of the node; on the boundary, along which the node slides; or done
            other = rings.cells[first + twin // n]
            label_1, label_2 = state.complex.labels[cell], state.complex.labels[other]
            if _has_same_values(sums, cell, other, label_1, label_2, objective):
                continue
            a, b, c = outward(cells, cell, k)
            if n == 3:  # the segment (a, b), its normal to the right; phi of `node`
                weight = _facet_moments(moment, ticks, node, b if a == node else a, -1, objective)
                e = scaled(scale, difference(ticks, b, a))
                normal = (0.0, e[2], -e[1])
            else:
                if b == node:
                    a, b, c = b, c, a
                elif c == node:
                    a, b, c = c, a, b
                weight = _facet_moments(moment, ticks, node, b, c, objective)
                e, f = scaled(scale, difference(ticks, b, a)), scaled(scale, difference(ticks, c, a))
                normal = scaled(0.5, cross(e, f))
            jump = 0.0
            for channel in range(objective.n_channels):
                value_1 = cell_value(sums, cell, label_1, channel, objective)
                value_2 = cell_value(sums, other, label_2, channel, objective)
                jump += (value_2 - value_1) * (2.0 * moment[channel] - (value_1 + value_2) * weight)
            g0 += jump * normal[0]
            g1 += jump * normal[1]
            g2 += jump * normal[2]
    factor, inverse = objective.image * objective.hand, state.sides.inverse
    for d in range(3):
        g[d] += factor * (inverse[0, d] * g0 + inverse[1, d] * g1 + inverse[2, d] * g2)


@helper
def _has_same_values(sums: NDArray, cell: int, other: int, label_1: int, label_2: int, objective: Objective) -> bool:
    """Whether two cells have the same value in all channels, as those of the background, or one holds no voxel."""
    count_1, count_2 = sums[cell, 0], sums[other, 0]
    if count_1 <= 0.0 or count_2 <= 0.0:
        return True
    is_same = label_1 == label_2
    for channel in range(objective.n_means):
        d = 1 if channel == 0 else 2 + channel
        is_same = is_same and sums[cell, d] * count_2 == sums[other, d] * count_1
    return is_same


@unit
def _add_tension_gradient(g: Floats1, state: State, rings: NodeRings, node: int) -> None:
    """Add the derivative of what the interfaces around a node cost to g (3,), per mm."""
    mesh, objective = state.complex, state.objective
    for r in range(rings.start[node], rings.start[node + 1]):
        cell = rings.cells[r]
        for k in range(mesh.cells.shape[1]):
            other = mesh.across[cell, k]
            if k == rings.corner[r] or other < cell or not is_interface(mesh, cell, k):
                continue
            weight = pair_tension(objective, mesh.labels[cell], mesh.labels[other])
            a, b, c = outward(mesh.cells, cell, k)
            if c < 0:
                way = place(mesh.ticks, a if b == node else b, node, objective)
                way = scaled(-1.0 / np.sqrt(dot(way, way)), way)
            else:
                if b == node:
                    a, b, c = b, c, a
                elif c == node:
                    a, b, c = c, a, b
                u, v = place(mesh.ticks, b, a, objective), place(mesh.ticks, c, a, objective)
                n = cross(u, v)
                way = scaled(0.5 / np.sqrt(dot(n, n)), cross(n, minus(v, u)))
            for d in range(3):
                g[d] += weight * way[d]


@unit
def ring_tension(state: State, rings: NodeRings, node: int) -> float:
    """What the interfaces around a node cost as the ticks stand."""
    mesh, total = state.complex, 0.0
    if not (state.objective.tension > 0.0 and mesh.meeting[node, 1] >= 0):
        return 0.0
    for r in range(rings.start[node], rings.start[node + 1]):
        cell = rings.cells[r]
        for k in range(mesh.cells.shape[1]):
            other = mesh.across[cell, k]
            if k != rings.corner[r] and other > cell and is_interface(mesh, cell, k):
                a, b, c = outward(mesh.cells, cell, k)
                weight = pair_tension(state.objective, mesh.labels[cell], mesh.labels[other])
                total += weight * facet_area(mesh.ticks, a, b, c, state.objective)
    return total


@unit
def _add_shape_gradient(
    g: Floats1, x: Floats2, state: State, rings: NodeRings, node: int
) -> tuple[float, float, float]:
    """Add the derivative of the weighted shape energy to g (3,), per mm.

    Returns a bound of its curvature, the distance in mm to the nearest centroid of the ring's cells, and the ring's
    worst cosine, up to the floor.
    """
    cells, objective = state.complex.cells, state.objective
    n, power = cells.shape[1], objective.power
    dim = n - 1
    curvature, nearest, least = 0.0, np.inf, objective.floor
    for r in range(rings.start[node], rings.start[node + 1]):
        cell, at = rings.cells[r], rings.corner[r]
        load_cell(x, state.complex.ticks, cells, cell, objective)
        volume, E_G = volume_and_E_G(x, n)
        W = state.complex.E_shape[cell]
        S = E_G * (n * (n + 1)) / volume
        v = volume_gradient(x, at, n)
        # W is proportional to v^alpha S^p with alpha = 1 - 2 (p - 1) / n, on a graded mesh alpha = -2 p / n.
        alpha = -2.0 * power / dim if objective.is_graded else 1.0 - 2.0 * (power - 1.0) / dim
        of_volume, of_edges = alpha / volume, power / S
        squared = 0.0
        for d in range(3):
            apart = 0.0
            for k in range(n):
                apart += x[at, d] - x[k, d]
            squared += apart * apart
            g[d] += objective.geometry * W * (of_volume * v[d] + of_edges * 2.0 * apart)
        curvature += objective.geometry * W * of_edges * 2.0 * n
        nearest = min(nearest, squared)
        if n == 4 and least > -1.0:
            least = min(least, cosine_up_to_floor(x, objective))
    return curvature, np.sqrt(nearest) / n, least


class Gradients(NamedTuple):
    """What `gradient` fills."""

    shape: Floats2  # (N, 3)
    image: Floats2  # (N, 3)
    state: State
    rings: NodeRings


@unit
def _gradients(work: Gradients, node: int) -> None:
    _add_shape_gradient(work.shape[node], np.empty((4, 3)), work.state, work.rings, node)
    _add_image_gradient(work.image[node], work.state, work.rings, node)


class Trial(NamedTuple):
    """What `ring_energy` measures of a node's ring of R cells."""

    x: Floats2  # (4, 3) room for a cell's corners
    shapes: Floats1  # (R,) shape energy of each cell; -1 if it is gone
    fluxes: Floats3  # (R, n+1, D) of its facets around the node, outwards


TrialByValue = Annotated[Trial, by_value(Trial)]  # it is made by the kernels, several a move


@helper
def trial_of(state: State, rings: NodeRings, node: int) -> Trial:
    """Room for what is measured of a node's ring."""
    size, fluxes = rings.start[node + 1] - rings.start[node], state.complex.fluxes
    return Trial(np.empty((4, 3)), np.empty(size), np.empty((size, fluxes.shape[1], fluxes.shape[2])))


@inlined
def ring_misfit(state: State, rings: NodeRings, node: int) -> tuple:
    """The ring's weighted misfit to the mask before a move, times -1, and whether a move may change it."""
    misfit, has_misfit = 0.0, False
    if state.objective.surface > 0.0:
        for r in range(rings.start[node], rings.start[node + 1]):
            misfit -= wrong_side(state.complex.sums, rings.cells[r], state.objective)
            for k in range(state.complex.cells.shape[1]):
                has_misfit = has_misfit or (k != rings.corner[r] and rings.twin[r, k] < 0)
    return misfit, has_misfit


@inlined
def ring_shape(
    trial: Trial, limit: float, least: float, node: int, state: State, rings: NodeRings, joined: int
) -> float:
    """Weighted shape energy of a node's ring as the ticks stand; each cell's goes to `trial.shapes`.

    Infinite if a cell is flat or inverted or has a cosine under `least`, or once the energy is above `limit`. Cells
    that have the node `joined`, at whose place the node is, count as gone.
    """
    cells, objective = state.complex.cells, state.objective
    has_floor = cells.shape[1] == 4 and least > -1.0
    first, energy = rings.start[node], 0.0
    for r in range(first, rings.start[node + 1]):
        if joined >= 0 and has_node(cells, rings.cells[r], joined):
            trial.shapes[r - first] = -1.0
            continue
        shape = shape_of_cell(trial.x, state.complex.ticks, cells, rings.cells[r], objective)
        trial.shapes[r - first] = shape
        if has_floor and (shape == np.inf or cosine_up_to_floor(trial.x, objective) < least):
            return np.inf
        energy += objective.geometry * shape
        if energy > limit:
            return np.inf
    return energy


@unit
def ring_energy(
    trial: TrialByValue, limit: float, least: float, node: int, state: State, rings: NodeRings, joined: int
) -> float:
    """Energy of a node's ring as the ticks stand, all that was measured in `trial`; infinite as `ring_shape`.

    What the ring's misfit to the mask is more than it was is added.
    """
    cells, objective, shapes, fluxes = state.complex.cells, state.objective, trial.shapes, trial.fluxes
    n, D, first = cells.shape[1], fluxes.shape[2], rings.start[node]
    misfit, has_misfit = ring_misfit(state, rings, node)
    bound = np.inf if has_misfit else limit  # no sum says anything before all of the misfit is in it
    energy = ring_shape(trial, bound, least, node, state, rings, joined)  # cheap refusals before any voxel is read
    if energy == np.inf or objective.image == 0.0:
        return energy
    energy += ring_tension(state, rings, node)
    sums = np.empty((1, D))
    for r in range(first, rings.start[node + 1]):
        if shapes[r - first] < 0.0:
            continue
        cell = rings.cells[r]
        for d in range(D):
            sums[0, d] = 0.0
        for k in range(n):
            if k == rings.corner[r]:
                for d in range(D):
                    sums[0, d] += state.complex.fluxes[cell, k, d]
                continue
            twin = rings.twin[r, k]
            if not (0 <= twin and twin // n < r - first and shapes[twin // n] >= 0.0):
                a, b, c = outward(cells, cell, k)
                put_flux(fluxes, r - first, k, state.complex.ticks, a, b, c, objective)
                if twin >= 0:
                    for d in range(D):
                        fluxes[twin // n, twin % n, d] = -fluxes[r - first, k, d]
            for d in range(D):
                sums[0, d] += fluxes[r - first, k, d]
        energy += objective.image * image_energy(sums, 0, state.complex.labels[cell], objective)
        misfit += wrong_side(sums, 0, objective)
        if energy > bound:
            return np.inf
    if has_misfit:
        energy += misfit
    return energy if energy <= limit else np.inf


@unit
def store(trial: TrialByValue, node: int, state: State, rings: NodeRings) -> None:
    """Write what `ring_energy` measured of a node's ring into the complex."""
    first, fluxes = rings.start[node], state.complex.fluxes
    for r in range(first, rings.start[node + 1]):
        cell = rings.cells[r]
        state.complex.E_shape[cell] = trial.shapes[r - first]
        if state.objective.image > 0.0:
            for k in range(fluxes.shape[1]):
                if k != rings.corner[r]:
                    for d in range(fluxes.shape[2]):
                        fluxes[cell, k, d] = trial.fluxes[r - first, k, d]
            sum_up(state.complex.sums, fluxes, cell)


class Sweep(NamedTuple):
    """The groups of one colour, whose nodes are to be moved."""

    state: State
    rings: NodeRings
    groups: Blocks
    chosen: Ints1  # (G,) the groups
    may_move: Bools1  # (N,)


@unit
def _sweep(work: Sweep, number: int) -> None:
    groups, block = work.groups, work.chosen[number]
    for at in range(groups.start[block], groups.start[block + 1]):
        if work.may_move[groups.nodes[at]]:
            _move(groups.nodes[at], work.state, work.rings)


class Search(NamedTuple):
    """The best place of a node so far, and room for two trials: slot[0] is that of the best, the other the next."""

    x: NDArray[np.float64]  # (4, 3) room for a cell's corners
    normal: NDArray[np.float64]  # (7, 3) see `tetopt.engine.surface.normals_at`
    is_sliding: bool  # whether the node stays on its surfaces
    best: NDArray[np.float64]  # (1,) the least energy of the ring
    place: NDArray[np.int64]  # (1, 3) where that is, ticks
    slot: NDArray[np.int64]  # (1,)
    shapes: NDArray[np.float64]  # (2, R) as of `Trial`
    fluxes: NDArray[np.float64]  # (2, R, n+1, D)


# Its steps, and those of `ring_energy`, are inlined: a sweep of calls took 12 % longer than one long function did,
# inlined steps 3 to 8 % (MNI152 T1, 5,000 nodes, one thread).
@unit
def _move(node: int, state: State, rings: NodeRings) -> None:
    """Move one node down the gradient of its ring's energy, if that lowers it."""
    ticks, fluxes = state.complex.ticks, state.complex.fluxes
    x, normal, g = np.empty((4, 3)), np.zeros((7, 3)), np.zeros(3)
    # A ring below the floor may stay as it is, but not get worse: hence the ring's own `least`.
    curvature, nearest, least = _add_shape_gradient(g, x, state, rings, node)
    if state.objective.image > 0.0:
        _add_image_gradient(g, state, rings, node)
        if state.objective.tension > 0.0 and state.complex.meeting[node, 1] >= 0:
            _add_tension_gradient(g, state, rings, node)
    is_sliding = slides(normal, state, node)
    step = _descent_step(normal, g, is_sliding, node, state)
    moved = times(state.objective.matrix, step)  # mm
    square = dot(moved, moved)
    if not square > 0.0:
        return
    energy, size = ring_tension(state, rings, node), rings.start[node + 1] - rings.start[node]
    for r in range(rings.start[node], rings.start[node + 1]):
        energy += cell_energy(state, rings.cells[r])
    search = Search(
        x, normal, is_sliding, np.empty(1), np.empty((1, 3), dtype=np.int64), np.zeros(1, dtype=np.int64),
        np.empty((2, size)), np.empty((2, size, fluxes.shape[1], fluxes.shape[2]))
    )  # fmt: skip
    search.best[0] = energy
    put_row(search.place, 0, row(ticks, node))
    reach = FIRST_STEP_SHARE * nearest
    length = min(1.0 / curvature, reach / np.sqrt(square))
    _search_line(search, step, length, square, least, node, state, rings)
    if not search.best[0] < energy and state.objective.image > 0.0:
        _probe_axes(search, PROBE_SHARE * reach, least, node, state, rings)
    put_row(ticks, node, row(search.place, 0))
    if search.best[0] < energy:
        slot = search.slot[0]
        store(Trial(x, search.shapes[slot], search.fluxes[slot]), node, state, rings)


@inlined
def _descent_step(normal: NDArray, g: NDArray, is_sliding: bool, node: int, state: State) -> tuple:
    """Down the gradient g (3,), per mm, along the axes and the surface on which the node may move; in index units."""
    down = times(projection_at(state, node), (g[0], g[1], g[2]))
    step = (-down[0], -down[1], -down[2])
    if is_sliding:
        count = normals_at(normal, state, node)
        rise = dot(row(normal, 0), step), dot(row(normal, 1), step), dot(row(normal, 2), step)
        is_found, way = combined_ways(normal, count, rise)
        if not is_found:
            return 0.0, 0.0, 0.0
        step = minus(step, way)
    return step


@inlined
def _try_place(
    search: Search, place: tuple, limit: float, least: float, node: int, state: State, rings: NodeRings
) -> float:
    """Energy of the ring with the node at a place, ticks, or on the surface beside it; the best is kept in mind."""
    put_row(state.complex.ticks, node, place)
    if search.is_sliding and not slid(search.normal, state, rings, node):
        return np.inf
    slot = 1 - search.slot[0]
    value = ring_energy(Trial(search.x, search.shapes[slot], search.fluxes[slot]), limit, least, node, state, rings, -1)
    if value < search.best[0]:
        search.best[0], search.slot[0] = value, slot
        put_row(search.place, 0, row(state.complex.ticks, node))
    return value


@inlined
def _search_line(
    search: Search, step: tuple, t: float, square: float, least: float, node: int, state: State, rings: NodeRings
) -> None:
    """Look t steps ahead, then where the parabola through what was measured has its vertex.

    `square` is the squared length of the step, mm^2: E falls by that much per step to begin with.
    """
    energy, slope, scale = search.best[0], -square, 2.0**-state.objective.bits
    here = row(search.place, 0)
    for trial in range(LINE_TRIALS):
        place = (
            here[0] + np.int64(np.rint(t * step[0] / scale)),
            here[1] + np.int64(np.rint(t * step[1] / scale)),
            here[2] + np.int64(np.rint(t * step[2] / scale)),
        )
        limit = np.inf if trial == 0 else search.best[0]
        value = _try_place(search, place, limit, least, node, state, rings)
        is_lower = search.best[0] < energy
        if trial > 0 and is_lower:
            return
        if not np.isfinite(value):
            t *= 0.35
            continue
        # The vertex of the parabola with the slope at 0 through this value.
        bend = value - energy - slope * t
        vertex = -0.5 * slope * t * t / bend if bend > 0.0 else 2.0 * t
        if is_lower:
            vertex = min(vertex, 2.0 * t)
            if abs(vertex - t) < 0.25 * t:
                return
            t = vertex
        else:
            t = min(max(vertex, 0.1 * t), 0.5 * t)


@inlined
def _probe_axes(search: Search, length: float, least: float, node: int, state: State, rings: NodeRings) -> None:
    """Look a length, mm, along each free axis both ways.

    The gradient is of the continuous image, the energy of its voxels: a node may stall where this still lowers E.
    """
    M, here = state.objective.matrix, row(search.place, 0)
    for axis in range(4 - state.complex.cells.shape[1], 3):
        if state.complex.is_frozen[node, axis]:
            continue
        spacing = np.sqrt(M[0, axis] ** 2 + M[1, axis] ** 2 + M[2, axis] ** 2)
        for sign in (1, -1):
            shift = sign * np.int64(np.rint(length / (spacing * 2.0**-state.objective.bits)))
            place = (
                here[0] + (shift if axis == 0 else 0),
                here[1] + (shift if axis == 1 else 0),
                here[2] + (shift if axis == 2 else 0),
            )
            _try_place(search, place, search.best[0], least, node, state, rings)


@unit
def slid(normal: Floats2, state: State, rings: NodeRings, node: int) -> bool:
    """Bring a moved node back to its surfaces; whether it got there, and the mask's facets face as they should."""
    is_there = put_on_surface(normal, state, node)
    return is_there and (not state.complex.is_frozen[node, 3] or ring_faces_up(normal, state, rings, node, -1))


# Nodes between labels are brought to the surface that they are to slide on.


def attract(state: State, rings: NodeRings, groups: Blocks, floor: float) -> None:
    """Move nodes between labels to where those meet, or as far as no cell is left flatter than `floor`, degrees.

    A cell that is flatter already may get no worse. E may rise. `floor` is minus a cosine, as of an `Objective`.
    """
    lowered, is_between = (
        state._replace(objective=state.objective._replace(floor=floor)),
        state.complex.meeting[:, 1] >= 0,
    )
    laid_out = packed(lowered), packed(rings), packed(groups)
    for chosen in colours_of(state, rings, groups):
        with few_threads(len(chosen) * BLOCK_NODES * 20):
            run(_attract, len(chosen), Sweep(*laid_out, chosen, is_between))


@unit
def _attract(work: Sweep, number: int) -> None:
    groups, block = work.groups, work.chosen[number]
    for at in range(groups.start[block], groups.start[block + 1]):
        if work.may_move[groups.nodes[at]]:
            _approach(groups.nodes[at], work.state, work.rings)


@unit
def _approach(node: int, state: State, rings: NodeRings) -> None:
    ticks, normal, x = state.complex.ticks, np.zeros((7, 3)), np.empty((4, 3))
    if is_on_surface(normal, state, node):
        return
    least = state.objective.floor
    for r in range(rings.start[node], rings.start[node + 1]):
        load_cell(x, ticks, state.complex.cells, rings.cells[r], state.objective)
        if state.complex.cells.shape[1] == 4:
            least = min(least, cosine_up_to_floor(x, state.objective))
    here = row(ticks, node)
    put_on_surface(normal, state, node)
    way, share, trial = minus(row(ticks, node), here), 1.0, trial_of(state, rings, node)
    for _ in range(APPROACH_TRIALS):
        put_row(
            ticks, node,
            (
                here[0] + np.int64(np.rint(share * way[0])),
                here[1] + np.int64(np.rint(share * way[1])),
                here[2] + np.int64(np.rint(share * way[2])),
            ),
        )  # fmt: skip
        if ring_energy(trial, np.inf, least, node, state, rings, -1) < np.inf:
            store(trial, node, state, rings)
            return
        share *= 0.5
    put_row(ticks, node, here)
