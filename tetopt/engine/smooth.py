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
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from tetopt.energy.geometric import volume_and_E_G
from tetopt.energy.sampling import few_threads
from tetopt.engine.complex import (
    Complex,
    Measure,
    NodeRings,
    cell_energy,
    has_node,
    image_energy,
    load_cell,
    outward,
    put_flux,
    quality_up_to,
    shape_of_cell,
    sum_up,
    wrong_side,
)
from tetopt.engine.surface import Sides, normal_at, put_on_surface, ring_faces_up
from tetopt.geometry.topology import greedy_colours

POINTS = 8  # most parts that a facet's edge is cut into when h is integrated over it
SPACING = 2.0  # voxels between such points
REACH = 0.5  # of the distance to the nearest centroid of the ring's cells: the longest first step
PROBE = 0.3  # of that step: how far a stalled node looks along the axes
BLOCK = 128  # nodes in a group, at most
TRIES = 3  # energies measured along the gradient, at most


class Blocks(NamedTuple):
    """Nodes in groups that lie together."""

    nodes: NDArray[np.int64]  # (N,) one group after the other
    start: NDArray[np.int64]  # (B+1,) where each begins
    of_node: NDArray[np.int64]  # (N,) the group of each node


def blocks(ticks: NDArray[np.int64]) -> Blocks:
    """Groups of nodes along a Z-order curve (Morton 1966), so that a graded mesh gets groups of equal number."""
    size = max(1, min(BLOCK, len(ticks) // 64))
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
    held: Complex, rings: NodeRings, groups: Blocks, is_wanted: NDArray[np.bool_], is_frozen: NDArray[np.bool_],
    measure: Measure, sides: Sides, is_over: Callable[[], bool] = lambda: False,
) -> bool:  # fmt: skip
    """Move the nodes that are wanted, (N,); `is_frozen` (N, 4): axes along which each stays, whether on the surface.

    Groups of one colour share no cell, and are worked on at the same time, their nodes one after the other: those read
    the same voxels, 1.5 to 2 times faster from the cache than nodes of one colour all over the volume. Returns False if
    `is_over` cut it short, between two colours.
    """
    for chosen in colours_of(held, rings, groups):
        if is_over():
            return False
        with few_threads(len(chosen) * BLOCK * 100):
            _sweep(held, rings, groups, chosen, is_wanted, is_frozen, measure, sides)
    return True


def colours_of(held: Complex, rings: NodeRings, groups: Blocks) -> list[NDArray[np.int64]]:
    """The groups of each colour: none shares a cell with another of its colour."""
    start, cells = _block_rings(groups.nodes, groups.start, rings.start, rings.cells)
    colours = greedy_colours(groups.of_node[held.cells[: held.n_cells[0]]], start, cells)
    return [np.flatnonzero(colours == colour) for colour in range(int(colours.max()) + 1)]


@njit(cache=True)
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


def gradient(held: Complex, rings: NodeRings, measure: Measure) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of the two weighted terms of E by every node's position, (N, 3) each, per mm: shape and image."""
    shape, image = np.zeros((len(held.ticks), 3)), np.zeros((len(held.ticks), 3))
    _gradients(shape, image, held, rings, measure, np.linalg.inv(measure.matrix))
    return shape, image


@njit(cache=True, error_model="numpy")
def _facet_moments(moment: NDArray, ticks: NDArray, node: int, b: int, c: int, measure: Measure) -> float:
    """Means of phi and h phi over the facet (node, b, c), or the segment (node, b), phi the node's hat function.

    Those of h phi go to `moment` (n_channels,), h a voxel's values less the grid's shift; 1/3 (1/2 in 2-D) is the mean
    of phi itself.
    """
    prefix = measure.prefix
    n_more = measure.n_channels - 1
    for d in range(1 + n_more):
        moment[d] = 0.0
    scale = 2.0**-measure.bits
    a0, a1, a2 = ticks[node, 0] * scale, ticks[node, 1] * scale, ticks[node, 2] * scale
    e0, e1, e2 = ticks[b, 0] * scale - a0, ticks[b, 1] * scale - a1, ticks[b, 2] * scale - a2
    most_i, most_j, most_k = prefix.shape[0] - 1, prefix.shape[1] - 1, prefix.shape[2] - 2
    weight, first = 0.0, 0.0
    if c < 0:
        length = np.sqrt(e1 * e1 + e2 * e2)
        parts = min(max(int(length / SPACING) + 1, 2), 4 * POINTS)
        for p in range(parts):
            s = (p + 0.5) / parts
            j = min(max(int(np.rint(a1 + s * e1)), 0), most_j)
            k = min(max(int(np.rint(a2 + s * e2)), 0), most_k)
            phi = 1.0 - s
            weight += phi
            first += phi * (prefix[0, j, k + 1, 0] - prefix[0, j, k, 0])
            for d in range(n_more):
                moment[1 + d] += phi * (prefix[0, j, k + 1, 2 + d] - prefix[0, j, k, 2 + d]) / parts
        moment[0] = first / parts
        return weight / parts
    f0, f1, f2 = ticks[c, 0] * scale - a0, ticks[c, 1] * scale - a1, ticks[c, 2] * scale - a2
    longest = max(e0 * e0 + e1 * e1 + e2 * e2, f0 * f0 + f1 * f1 + f2 * f2)
    parts = min(max(int(np.sqrt(longest) / SPACING) + 1, 2), POINTS)
    for p in range(parts):
        for q in range(parts - p):
            for half in range(2):
                if half == 1 and p + q == parts - 1:
                    continue
                s = (p + (1.0 + half) / 3.0) / parts
                t = (q + (1.0 + half) / 3.0) / parts
                i = min(max(int(np.rint(a0 + s * e0 + t * f0)), 0), most_i)
                j = min(max(int(np.rint(a1 + s * e1 + t * f1)), 0), most_j)
                k = min(max(int(np.rint(a2 + s * e2 + t * f2)), 0), most_k)
                phi = 1.0 - s - t
                weight += phi
                first += phi * (prefix[i, j, k + 1, 0] - prefix[i, j, k, 0])
                for d in range(n_more):
                    moment[1 + d] += phi * (prefix[i, j, k + 1, 2 + d] - prefix[i, j, k, 2 + d]) / (parts * parts)
    moment[0] = first / (parts * parts)
    return weight / (parts * parts)


@njit(cache=True, error_model="numpy")
def _add_image_gradient(
    g: NDArray, held: Complex, rings: NodeRings, node: int, measure: Measure, inverse: NDArray
) -> None:
    """Add the derivative of the weighted E_D by a node's position to g (3,), per mm."""
    n = held.cells.shape[1]
    scale = 2.0**-measure.bits
    first = rings.start[node]
    t = held.ticks
    moment = np.empty(measure.n_channels)
    g0, g1, g2 = 0.0, 0.0, 0.0
    for r in range(first, rings.start[node + 1]):
        cell = rings.cells[r]
        for k in range(n):
            twin = rings.twin[r, k]
            if k == rings.corner[r] or twin < 0 or twin // n < r - first:
                continue  # not a facet of the node; on the boundary, along which the node slides; or done
            other = rings.cells[first + twin // n]
            count_1, count_2 = held.sums[cell, 0], held.sums[other, 0]
            if count_1 <= 0.0 or count_2 <= 0.0:
                continue
            is_same = True  # as between cells of the background
            for channel in range(measure.n_channels):
                d = 1 if channel == 0 else 2 + channel
                is_same = is_same and held.sums[cell, d] * count_2 == held.sums[other, d] * count_1
            if is_same:
                continue
            a, b, c = outward(held.cells, cell, k)
            if n == 3:  # the segment (a, b), its normal to the right; phi of `node`
                far = b if a == node else a
                weight = _facet_moments(moment, t, node, far, -1, measure)
                n1, n2 = (t[b, 2] - t[a, 2]) * scale, -(t[b, 1] - t[a, 1]) * scale
                n0 = 0.0
            else:
                if b == node:
                    a, b, c = b, c, a
                elif c == node:
                    a, b, c = c, a, b
                weight = _facet_moments(moment, t, node, b, c, measure)
                e0, e1, e2 = (t[b, 0] - t[a, 0]) * scale, (t[b, 1] - t[a, 1]) * scale, (t[b, 2] - t[a, 2]) * scale
                f0, f1, f2 = (t[c, 0] - t[a, 0]) * scale, (t[c, 1] - t[a, 1]) * scale, (t[c, 2] - t[a, 2]) * scale
                n0, n1, n2 = 0.5 * (e1 * f2 - e2 * f1), 0.5 * (e2 * f0 - e0 * f2), 0.5 * (e0 * f1 - e1 * f0)
            jump = 0.0
            for channel in range(measure.n_channels):
                d = 1 if channel == 0 else 2 + channel
                mean_1, mean_2 = held.sums[cell, d] / count_1, held.sums[other, d] / count_2
                jump += (mean_2 - mean_1) * (2.0 * moment[channel] - (mean_1 + mean_2) * weight)
            g0 += jump * n0
            g1 += jump * n1
            g2 += jump * n2
    factor = measure.image * measure.hand
    for d in range(3):
        g[d] += factor * (inverse[0, d] * g0 + inverse[1, d] * g1 + inverse[2, d] * g2)


@njit(cache=True, error_model="numpy")
def _add_shape_gradient(g: NDArray, x: NDArray, held: Complex, rings: NodeRings, node: int, measure: Measure) -> tuple:
    """Add the derivative of the weighted shape energy to g (3,), per mm.

    Returns a bound of its curvature, the distance in mm to the nearest centroid of the ring's cells, and the ring's
    worst quality, up to the floor.
    """
    n = held.cells.shape[1]
    dim = n - 1
    power = measure.power
    curvature, nearest, least = 0.0, np.inf, measure.floor
    for r in range(rings.start[node], rings.start[node + 1]):
        cell, at = rings.cells[r], rings.corner[r]
        load_cell(x, held.ticks, held.cells, cell, measure)
        volume, E_G = volume_and_E_G(x, n)
        W = held.E_shape[cell]
        S = E_G * (n * (n + 1)) / volume
        if n == 4:
            a, b, c = (at + 1) & 3, (at + 2) & 3, (at + 3) & 3
            u0, u1, u2 = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
            w0, w1, w2 = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
            v0, v1, v2 = (u1 * w2 - u2 * w1) / 6.0, (u2 * w0 - u0 * w2) / 6.0, (u0 * w1 - u1 * w0) / 6.0
        else:
            a, b = (at + 1) % 3, (at + 2) % 3
            v0, v1, v2 = 0.0, (x[b, 2] - x[a, 2]) / 2.0, (x[a, 1] - x[b, 1]) / 2.0
        side = v0 * (x[at, 0] - x[a, 0]) + v1 * (x[at, 1] - x[a, 1]) + v2 * (x[at, 2] - x[a, 2])
        sign = 1.0 if side > 0.0 else -1.0
        # W is proportional to v^alpha S^p with alpha = 1 - 2 (p - 1) / n, on a graded mesh alpha = -2 p / n.
        alpha = -2.0 * power / dim if measure.is_graded else 1.0 - 2.0 * (power - 1.0) / dim
        of_volume = sign * alpha / volume
        of_edges = power / S
        squared = 0.0
        for d in range(3):
            apart = 0.0
            for k in range(n):
                apart += x[at, d] - x[k, d]
            squared += apart * apart
            g[d] += measure.geometry * W * (of_volume * (v0, v1, v2)[d] + of_edges * 2.0 * apart)
        curvature += measure.geometry * W * of_edges * 2.0 * n
        nearest = min(nearest, squared)
        if n == 4 and least > -1.0:
            least = min(least, quality_up_to(x, measure))
    return curvature, np.sqrt(nearest) / n, least


@njit(cache=True, parallel=True, error_model="numpy")
def _gradients(
    shape: NDArray, image: NDArray, held: Complex, rings: NodeRings, measure: Measure, inverse: NDArray
) -> None:
    for node in prange(len(shape)):
        x = np.empty((4, 3))
        _add_shape_gradient(shape[node], x, held, rings, node, measure)
        _add_image_gradient(image[node], held, rings, node, measure, inverse)


@njit(cache=True, error_model="numpy")
def ring_energy(
    limit: float, least: float, trial: NDArray, fluxes: NDArray, x: NDArray, node: int, held: Complex,
    rings: NodeRings, measure: Measure, joined: int = -1,
) -> float:  # fmt: skip
    """Energy of a node's ring as the ticks stand; shapes and facet fluxes go to `trial` (R,), `fluxes` (R, n+1, D).

    Infinite if a cell is flat or inverted or has a quality under `least`, or once the energy is above `limit`. Cells
    that have the node `joined`, at whose place the node is, count as gone; their shape is -1. What the ring's misfit
    to the mask is more than it was is added.
    """
    n, D = held.cells.shape[1], held.sums.shape[1]
    first, last = rings.start[node], rings.start[node + 1]
    energy, misfit, has_misfit = 0.0, 0.0, False
    if measure.surface > 0.0:
        for r in range(first, last):
            misfit -= wrong_side(held.sums, rings.cells[r], measure)
            for k in range(n):
                has_misfit = has_misfit or (k != rings.corner[r] and rings.twin[r, k] < 0)
    up_to = limit
    if has_misfit:  # no sum says anything before all of the misfit is in it
        limit = np.inf
    for r in range(first, last):  # cheap refusals before any voxel is read
        if joined >= 0 and has_node(held.cells, rings.cells[r], joined):
            trial[r - first] = -1.0
            continue
        trial[r - first] = shape_of_cell(x, held.ticks, held.cells, rings.cells[r], measure)
        if n == 4 and least > -1.0 and (trial[r - first] == np.inf or quality_up_to(x, measure) < least):
            return np.inf
        energy += measure.geometry * trial[r - first]
        if energy > limit:
            return np.inf
    if measure.image == 0.0:
        return energy
    sums = np.empty((1, D))
    for r in range(first, last):
        if trial[r - first] < 0.0:
            continue
        cell = rings.cells[r]
        for d in range(D):
            sums[0, d] = 0.0
        for k in range(n):
            if k == rings.corner[r]:
                for d in range(D):
                    sums[0, d] += held.fluxes[cell, k, d]
                continue
            twin = rings.twin[r, k]
            if not (0 <= twin and twin // n < r - first and trial[twin // n] >= 0.0):
                a, b, c = outward(held.cells, cell, k)
                put_flux(fluxes, r - first, k, held.ticks, a, b, c, measure)
                if twin >= 0:
                    for d in range(D):
                        fluxes[twin // n, twin % n, d] = -fluxes[r - first, k, d]
            for d in range(D):
                sums[0, d] += fluxes[r - first, k, d]
        energy += measure.image * image_energy(sums, 0, measure.n_channels)
        misfit += wrong_side(sums, 0, measure)
        if energy > limit:
            return np.inf
    if has_misfit:
        energy += misfit
    return energy if energy <= up_to else np.inf


@njit(cache=True, parallel=True, error_model="numpy")
def _sweep(
    held: Complex, rings: NodeRings, groups: Blocks, chosen: NDArray, is_wanted: NDArray, is_frozen: NDArray,
    measure: Measure, sides: Sides,
) -> None:  # fmt: skip
    for number in prange(len(chosen)):
        block = np.int64(chosen[number])
        for at in range(groups.start[block], groups.start[block + 1]):
            if is_wanted[groups.nodes[at]]:
                _move(groups.nodes[at], held, rings, is_frozen, measure, sides)


@njit(cache=True, error_model="numpy")
def _move(node: int, held: Complex, rings: NodeRings, is_frozen: NDArray, measure: Measure, sides: Sides) -> None:
    """Move one node down the gradient of its ring's energy, if that lowers it."""
    n = held.cells.shape[1]
    scale = 2.0**-measure.bits
    M = measure.matrix
    first, last = rings.start[node], rings.start[node + 1]
    x, g = np.empty((4, 3)), np.zeros(3)
    step, moved = np.empty(3), np.empty(3)
    curvature, nearest, least = _add_shape_gradient(g, x, held, rings, node, measure)
    if measure.image > 0.0:
        _add_image_gradient(g, held, rings, node, measure, sides.inverse)
    P = sides.projections[is_frozen[node, 0] + 2 * is_frozen[node, 1] + 4 * is_frozen[node, 2]]
    for d in range(3):
        step[d] = -(P[d, 0] * g[0] + P[d, 1] * g[1] + P[d, 2] * g[2])  # index units
    normal, slides = np.empty((2, 3)), is_frozen[node, 3]
    if slides:  # along the surface
        rise = normal_at(normal, held.ticks, node, is_frozen, sides, measure)
        if not rise > 1e-12:
            return
        across = (normal[0, 0] * step[0] + normal[0, 1] * step[1] + normal[0, 2] * step[2]) / rise
        for d in range(3):
            step[d] -= across * normal[1, d]
    for d in range(3):
        moved[d] = M[d, 0] * step[0] + M[d, 1] * step[1] + M[d, 2] * step[2]  # mm
    square = moved[0] * moved[0] + moved[1] * moved[1] + moved[2] * moved[2]
    if not square > 0.0:
        return
    slope = -square
    reach = REACH * nearest
    t = min(1.0 / curvature, reach / np.sqrt(square))
    energy = 0.0
    for r in range(first, last):
        energy += cell_energy(held, rings.cells[r], measure)
    # A ring below the floor may stay as it is, but not get worse: hence the ring's own `least`.
    here0, here1, here2 = held.ticks[node, 0], held.ticks[node, 1], held.ticks[node, 2]
    there0, there1, there2 = here0, here1, here2
    best, best_t = energy, 0.0
    trial, best_trial = np.empty(last - first), np.empty(last - first)
    D = held.fluxes.shape[2]
    fluxes, best_fluxes = np.empty((last - first, n, D)), np.empty((last - first, n, D))
    for attempt in range(TRIES):
        held.ticks[node, 0] = here0 + np.int64(np.rint(t * step[0] / scale))
        held.ticks[node, 1] = here1 + np.int64(np.rint(t * step[1] / scale))
        held.ticks[node, 2] = here2 + np.int64(np.rint(t * step[2] / scale))
        limit = np.inf if attempt == 0 else best
        value = np.inf
        if not slides or slid(x, normal, held, rings, node, is_frozen, sides, measure):
            value = ring_energy(limit, least, trial, fluxes, x, node, held, rings, measure)
        if value < best:
            best, best_t = value, t
            there0, there1, there2 = held.ticks[node, 0], held.ticks[node, 1], held.ticks[node, 2]
            trial, best_trial = best_trial, trial
            fluxes, best_fluxes = best_fluxes, fluxes
        if attempt > 0 and best_t > 0.0:
            break
        if not np.isfinite(value):
            t *= 0.35
            continue
        # The vertex of the parabola with the slope at 0 through this value.
        bend = value - energy - slope * t
        vertex = -0.5 * slope * t * t / bend if bend > 0.0 else 2.0 * t
        if best_t > 0.0:
            vertex = min(vertex, 2.0 * t)
            if abs(vertex - t) < 0.25 * t:
                break
            t = vertex
        else:
            t = min(max(vertex, 0.1 * t), 0.5 * t)
    if best_t == 0.0 and measure.image > 0.0:
        # The gradient is of the continuous image, the energy of its voxels: where a node stalls, ask along the axes.
        for axis in range(4 - n, 3):
            if is_frozen[node, axis]:
                continue
            length = np.sqrt(M[0, axis] ** 2 + M[1, axis] ** 2 + M[2, axis] ** 2)
            for sign in (1, -1):
                shift = sign * np.int64(np.rint(PROBE * reach / (length * scale)))
                held.ticks[node, 0] = here0 + (shift if axis == 0 else 0)
                held.ticks[node, 1] = here1 + (shift if axis == 1 else 0)
                held.ticks[node, 2] = here2 + (shift if axis == 2 else 0)
                if slides and not slid(x, normal, held, rings, node, is_frozen, sides, measure):
                    continue
                value = ring_energy(best, least, trial, fluxes, x, node, held, rings, measure)
                if value < best:
                    best, best_t = value, 1.0
                    there0, there1, there2 = held.ticks[node, 0], held.ticks[node, 1], held.ticks[node, 2]
                    trial, best_trial = best_trial, trial
                    fluxes, best_fluxes = best_fluxes, fluxes
    held.ticks[node, 0], held.ticks[node, 1], held.ticks[node, 2] = there0, there1, there2
    if best_t > 0.0:
        store(held, rings, node, best_trial, best_fluxes, measure)


@njit(cache=True, error_model="numpy")
def slid(
    x: NDArray, normal: NDArray, held: Complex, rings: NodeRings, node: int, is_frozen: NDArray, sides: Sides,
    measure: Measure,
) -> bool:  # fmt: skip
    """Bring a moved node back to the surface; whether it got there, and the facets around it face as they should."""
    if not put_on_surface(normal, held.ticks, node, is_frozen, sides, measure):
        return False
    return ring_faces_up(x, normal, held, rings, node, -1, sides, measure)


@njit(cache=True, error_model="numpy")
def store(held: Complex, rings: NodeRings, node: int, shapes: NDArray, fluxes: NDArray, measure: Measure) -> None:
    """Write what `ring_energy` found of a node's ring into the complex."""
    first = rings.start[node]
    for r in range(first, rings.start[node + 1]):
        cell = rings.cells[r]
        held.E_shape[cell] = shapes[r - first]
        if measure.image > 0.0:
            for k in range(held.cells.shape[1]):
                if k != rings.corner[r]:
                    for d in range(held.fluxes.shape[2]):
                        held.fluxes[cell, k, d] = fluxes[r - first, k, d]
            sum_up(held.sums, held.fluxes, cell)
