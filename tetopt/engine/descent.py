"""One sweep over the nodes: the paper's descent with numerical derivatives, or Lloyd's relocation.

A sweep takes the colours of the node graph in turn. Nodes of one colour share no cell, so each can be moved, and
the sums of its ring's cells rewritten, at the same time as the others; the result does not depend on the threads.
A move is made only if no cell of the ring loses its orientation (exactly, in integers) and the ring's energy falls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from tetopt.energy.geometric import volume_and_E_G
from tetopt.energy.sampling import SamplingGrid, cell_orientation, facet_flux, few_threads
from tetopt.geometry.topology import Facets, Rings, Stars

FLAT = 1e-7  # a cell's volume over (sum of squared edges)^(n/2); below, it counts as inverted: an angle of 1e-3 degrees
HALVINGS = 4  # of a Lloyd step that inverts a cell or raises the ring's energy


class State(NamedTuple):
    """Everything a sweep reads and writes; `sums`, `E_G` and `fluxes` are kept in step with the nodes."""

    ticks: NDArray[np.int64]  # (N, 3) node positions on the sampling grid; written
    cells: NDArray[np.int64]  # (M, n+1)
    rings: Rings
    sides: Facets
    stars: Stars
    is_frozen: NDArray[np.bool_]  # (N, 3) index axes along which a node may not move
    hand: int  # sign of the cells' volumes in index space
    sums: NDArray[np.float64]  # (M, 3) moment sums of each cell; written
    E_G: NDArray[np.float64]  # (M,) geometric energy of each cell, mm^(n+2); written
    fluxes: NDArray[np.float64]  # (F, 3) flux of each facet; written


class Weights(NamedTuple):
    """What turns a cell's energies into its share of E, Eq. (4), and a node's neighbourhood into a step."""

    geometry: float  # (1 - k_D) / E_G0
    image: float  # k_D x voxel volume / E_D0
    step_ratio: float  # step length over the distance to the nearest cell centroid


def descend(
    state: State, nodes: NDArray[np.int64], grid: SamplingGrid, matrix: NDArray[np.float64], weights: Weights
) -> None:
    """Move each of `nodes`, all of one colour, along the image's axes to lower its ring's energy (Section 2.2).

    Per axis the ring's energy is measured at one step forwards and backwards, the step a ratio of the distance to
    the nearest centroid of the ring's cells; the vertex of the parabola through the three values is tried as well;
    the best of them is taken if it lies below the present energy. `matrix` (3, 3) takes index vectors to mm.
    """
    sides = (state.sides.nodes, state.sides.of_cell, state.sides.sign, *state.stars)
    kept = (state.is_frozen, state.hand, state.sums, state.E_G, state.fluxes)
    with few_threads(len(nodes) * 100):
        _descend(state.ticks, state.cells, *state.rings, *sides, *kept, nodes, grid.prefix, grid.bits, matrix, *weights)


def relocate(
    state: State,
    nodes: NDArray[np.int64],
    grid: SamplingGrid,
    matrix: NDArray[np.float64],
    projections: NDArray[np.float64],
) -> None:
    """Move each of `nodes`, all of one colour, to the minimiser of E_G over its ring (Section 2.1).

    Inside, that is the volume-weighted mean of the ring's circumcentres. A node on a face or an edge of the box
    goes to the minimiser within it. A step that inverts a cell or, by rounding, raises E_G is halved up to four
    times, then left out. `projections` are `free_projections(matrix)`. Sums and fluxes are not kept up: at k_D = 0
    the image has no say.
    """
    kept = (state.is_frozen, state.hand, state.E_G)
    with few_threads(len(nodes) * 10):
        _relocate(state.ticks, state.cells, *state.rings, *kept, nodes, grid.bits, matrix, projections)


def free_projections(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """For each set of frozen axes (bit d: axis d), the (3, 3) map from a vector in mm to the index vector along
    the free axes that comes nearest to it: least squares in mm, so right for oblique and sheared axes.
    """
    maps = np.zeros((8, 3, 3))
    for frozen in range(8):
        free = [d for d in range(3) if not frozen >> d & 1]
        maps[frozen, free] = np.linalg.pinv(matrix[:, free])
    return maps


@njit(cache=True)
def _load(x: NDArray, ticks: NDArray, cells: NDArray, cell: int, matrix: NDArray, scale: float) -> None:
    """A cell's corners in mm."""
    for k in range(cells.shape[1]):
        node = cells[cell, k]
        for d in range(3):
            x[k, d] = scale * (
                matrix[d, 0] * ticks[node, 0] + matrix[d, 1] * ticks[node, 1] + matrix[d, 2] * ticks[node, 2]
            )


@njit(cache=True)
def _image_energy(sums: NDArray) -> float:
    """Within-cell sum of squares of one cell."""
    if sums[0] <= 0.0:
        return 0.0
    return max(sums[2] - sums[1] * sums[1] / sums[0], 0.0)


@njit(cache=True)
def _is_flat(volume: float, E_G: float, n_corners: int) -> bool:
    """Whether a cell is thinner than `FLAT` allows; E_G is volume times sum of squared edges over (n+1)(n+2)."""
    edges = E_G * (n_corners * (n_corners + 1)) / max(volume, 1e-300)
    return volume <= FLAT * edges ** (0.5 * (n_corners - 1))


@njit(cache=True)
def _ring_energy(
    limit: float, trial: NDArray, trial_fluxes: NDArray, x: NDArray, node: int, ticks: NDArray, cells: NDArray,
    start: NDArray, ring: NDArray, nodes_of: NDArray, of_cell: NDArray, sign: NDArray, star_start: NDArray,
    star: NDArray, place: NDArray, hand: int, fluxes: NDArray, prefix: NDArray, bits: int, matrix: NDArray,
    geometry: float, image: float,
) -> float:  # fmt: skip
    """Energy of a node's ring as `ticks` stand.

    Its cells' sums and E_G go to the rows of `trial` (R, 4), its facets' fluxes to `trial_fluxes`. Infinite if a
    cell is flat or not oriented as `hand` says, or once the energy of the shapes alone is above `limit`.
    """
    first, last = start[node], start[node + 1]
    flux = np.empty((1, 1, 3))
    energy = 0.0
    for r in range(first, last):  # cheap refusals before any voxel is read
        if cell_orientation(ticks, cells, ring[r]) != hand:
            return np.inf
        _load(x, ticks, cells, ring[r], matrix, 2.0**-bits)
        cell_volume, trial[r - first, 3] = volume_and_E_G(x, cells.shape[1])
        if _is_flat(cell_volume, trial[r - first, 3], cells.shape[1]):
            return np.inf
        energy += geometry * trial[r - first, 3]
    if energy > limit:
        return np.inf
    for s in range(star_start[node], star_start[node + 1]):
        facet_flux(ticks, nodes_of, star[s], bits, prefix, None, 0, flux, 0)
        for d in range(3):
            trial_fluxes[s - star_start[node], d] = flux[0, 0, d]
    for r in range(first, last):
        for d in range(3):
            total = 0.0
            for k in range(cells.shape[1]):
                if place[r, k] < 0:
                    total += sign[ring[r], k] * fluxes[of_cell[ring[r], k], d]
                else:
                    total += sign[ring[r], k] * trial_fluxes[place[r, k], d]
            trial[r - first, d] = hand * total
        energy += image * _image_energy(trial[r - first])
    return energy


@njit(cache=True)
def _nearest_centroid(
    x: NDArray, node: int, ticks: NDArray, cells: NDArray, start: NDArray, ring: NDArray, matrix: NDArray, scale: float
) -> float:
    """Distance in mm from a node to the nearest centroid of its ring's cells."""
    nearest = np.inf
    for r in range(start[node], start[node + 1]):
        _load(x, ticks, cells, ring[r], matrix, scale)
        squared = 0.0
        for d in range(3):
            here = scale * (
                matrix[d, 0] * ticks[node, 0] + matrix[d, 1] * ticks[node, 1] + matrix[d, 2] * ticks[node, 2]
            )
            mean = 0.0
            for k in range(cells.shape[1]):
                mean += x[k, d] / cells.shape[1]
            squared += (mean - here) ** 2
        nearest = min(nearest, squared)
    return np.sqrt(nearest)


@njit(cache=True, parallel=True)
def _descend(
    ticks: NDArray, cells: NDArray, start: NDArray, ring: NDArray, nodes_of: NDArray, of_cell: NDArray, sign: NDArray,
    star_start: NDArray, star: NDArray, place: NDArray, is_frozen: NDArray, hand: int, sums: NDArray, E_G: NDArray,
    fluxes: NDArray, nodes: NDArray, prefix: NDArray, bits: int, matrix: NDArray, geometry: float, image: float,
    step_ratio: float,
) -> None:  # fmt: skip
    scale = 2.0**-bits
    for number in prange(len(nodes)):
        node = nodes[number]
        first, last = start[node], start[node + 1]
        star_first, star_last = star_start[node], star_start[node + 1]
        x = np.empty((4, 3))
        trial, best_trial = np.empty((last - first, 4)), np.empty((last - first, 4))
        trial_fluxes, best_fluxes = np.empty((star_last - star_first, 3)), np.empty((star_last - star_first, 3))
        energy = 0.0
        for r in range(first, last):
            energy += geometry * E_G[ring[r]] + image * _image_energy(sums[ring[r]])
        reach = step_ratio * _nearest_centroid(x, node, ticks, cells, start, ring, matrix, scale)
        for axis in range(4 - cells.shape[1], 3):
            if is_frozen[node, axis]:
                continue
            length = np.sqrt(matrix[0, axis] ** 2 + matrix[1, axis] ** 2 + matrix[2, axis] ** 2)
            step = np.int64(np.rint(reach / (length * scale)))
            if step == 0:
                continue
            here = ticks[node, axis]
            best, best_there = energy, here
            forwards, backwards = np.inf, np.inf
            for attempt in range(3):
                if attempt < 2:  # the numerical derivative: one step forwards, one backwards
                    there = here + step * (1 - 2 * attempt)
                    limit = np.inf  # the parabola needs both values whole
                else:  # the vertex of the parabola through the three values
                    bend = forwards + backwards - 2.0 * energy
                    if not (np.isfinite(bend) and bend > 0.0):
                        break
                    vertex = 0.5 * (backwards - forwards) / bend
                    there = here + np.int64(np.rint(min(max(vertex, -1.0), 1.0) * step))
                    limit = best
                    if there == here:
                        break
                ticks[node, axis] = there
                value = _ring_energy(
                    limit, trial, trial_fluxes, x, node, ticks, cells, start, ring, nodes_of, of_cell, sign,
                    star_start, star, place, hand, fluxes, prefix, bits, matrix, geometry, image,
                )  # fmt: skip
                if attempt == 0:
                    forwards = value
                elif attempt == 1:
                    backwards = value
                if value < best:
                    best, best_there = value, there
                    trial, best_trial = best_trial, trial
                    trial_fluxes, best_fluxes = best_fluxes, trial_fluxes
            ticks[node, axis] = best_there
            if best_there != here:
                energy = best
                for r in range(first, last):
                    for d in range(3):
                        sums[ring[r], d] = best_trial[r - first, d]
                    E_G[ring[r]] = best_trial[r - first, 3]
                for s in range(star_first, star_last):
                    for d in range(3):
                        fluxes[star[s], d] = best_fluxes[s - star_first, d]


@njit(cache=True)
def _add_gradient(gradient: NDArray, x: NDArray, at: int, n_corners: int) -> float:
    """Add the derivative of one cell's E_G by its corner `at` to `gradient` (3,); returns the cell's volume."""
    volume, E_G = volume_and_E_G(x, n_corners)
    weight = 1.0 / (n_corners * (n_corners + 1))
    edges = E_G / (volume * weight)
    # The volume's gradient points from the opposite face to the corner, as long as the face's area over n.
    if n_corners == 4:
        a, b, c = (at + 1) & 3, (at + 2) & 3, (at + 3) & 3
        u0, u1, u2 = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
        w0, w1, w2 = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
        g0, g1, g2 = (u1 * w2 - u2 * w1) / 6.0, (u2 * w0 - u0 * w2) / 6.0, (u0 * w1 - u1 * w0) / 6.0
    else:
        a, b = (at + 1) % 3, (at + 2) % 3
        g0, g1, g2 = 0.0, (x[b, 2] - x[a, 2]) / 2.0, (x[a, 1] - x[b, 1]) / 2.0
    side = g0 * (x[at, 0] - x[a, 0]) + g1 * (x[at, 1] - x[a, 1]) + g2 * (x[at, 2] - x[a, 2])
    sign = 1.0 if side > 0.0 else -1.0
    for d in range(3):
        apart = 0.0
        for k in range(n_corners):
            apart += x[at, d] - x[k, d]
        gradient[d] += weight * (sign * (g0, g1, g2)[d] * edges + 2.0 * volume * apart)
    return volume


@njit(cache=True, parallel=True)
def _relocate(
    ticks: NDArray, cells: NDArray, start: NDArray, ring: NDArray, is_frozen: NDArray, hand: int, E_G: NDArray,
    nodes: NDArray, bits: int, matrix: NDArray, projections: NDArray,
) -> None:  # fmt: skip
    n_corners = cells.shape[1]
    scale = 2.0**-bits
    for number in prange(len(nodes)):
        node = nodes[number]
        first, last = start[node], start[node + 1]
        x = np.empty((4, 3))
        gradient, step = np.zeros(3), np.empty(3)
        trial = np.empty(last - first)
        energy, ring_volume = 0.0, 0.0
        for r in range(first, last):
            at = 0
            while cells[ring[r], at] != node:
                at += 1
            _load(x, ticks, cells, ring[r], matrix, scale)
            ring_volume += _add_gradient(gradient, x, at, n_corners)
            energy += E_G[ring[r]]
        project = projections[is_frozen[node, 0] + 2 * is_frozen[node, 1] + 4 * is_frozen[node, 2]]
        for d in range(3):  # E_G over the ring is |Omega| / (n+1) |x - minimiser|^2 + constant
            step[d] = -(project[d, 0] * gradient[0] + project[d, 1] * gradient[1] + project[d, 2] * gradient[2])
            step[d] *= n_corners / (2.0 * ring_volume)
        here = (ticks[node, 0], ticks[node, 1], ticks[node, 2])
        is_better = False
        for halving in range(HALVINGS + 1):
            for d in range(3):
                ticks[node, d] = here[d] + np.int64(np.rint(step[d] * 0.5**halving / scale))
            moved = 0.0
            for r in range(first, last):
                _load(x, ticks, cells, ring[r], matrix, scale)
                cell_volume, trial[r - first] = volume_and_E_G(x, n_corners)
                is_flat = _is_flat(cell_volume, trial[r - first], n_corners)
                if is_flat or cell_orientation(ticks, cells, ring[r]) != hand:
                    moved = np.inf
                    break
                moved += trial[r - first]
            is_better = moved < energy
            if is_better:
                break
        if is_better:
            for r in range(first, last):
                E_G[ring[r]] = trial[r - first]
        else:
            for d in range(3):
                ticks[node, d] = here[d]
