"""One sweep over the nodes: the paper's descent with numerical derivatives, or Lloyd's relocation.

A sweep takes the colours of the node graph in turn. Nodes of one colour share no cell, so each can be moved, and
the sums of its ring's cells rewritten, at the same time as the others; the result does not depend on the threads.
A move is made only if no cell of the ring loses its orientation (exactly, in integers) and the ring's energy falls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from tetopt.energy.geometric import volume_and_E_G
from tetopt.energy.sampling import cell_orientation, facet_flux, few_threads
from tetopt.engine.complex import FLAT_SHARE
from tetopt.kernel_cache import njit

LLOYD_HALVINGS = 4  # of a Lloyd step that inverts a cell or raises the ring's energy: then the node stays


class Tessellation(NamedTuple):
    """Nodes, cells and who touches whom, and what each cell and facet holds, kept in step with the nodes.

    The fast engine's complex holds the same by cell, each facet twice. On it and its ring energy, p = 1, the descent
    makes the same mesh to the last bit, but takes 1.14 times as long (MNI152 T1, 2,000 nodes): by the loop over
    channels within each flux, and by counting references to the arrays of what kernels hand one another.
    """

    ticks: NDArray[np.int64]  # (N, 3) node positions on the sampling grid; written
    cells: NDArray[np.int64]  # (M, n+1)
    is_frozen: NDArray[np.bool_]  # (N, 4) index axes along which a node may not move
    start: NDArray[np.int64]  # as of `tetopt.geometry.topology.Rings`
    ring: NDArray[np.int64]
    facets: NDArray[np.int64]  # nodes, of_cell and sign of `tetopt.geometry.topology.Facets`
    of_cell: NDArray[np.int64]
    sign: NDArray[np.int64]
    star_start: NDArray[np.int64]  # as of `tetopt.geometry.topology.Stars`
    star: NDArray[np.int64]
    place: NDArray[np.int64]
    sums: NDArray[np.float64]  # (M, 3) moment sums of each cell; written
    E_G: NDArray[np.float64]  # (M,) geometric energy of each cell, mm^(n+2); written
    fluxes: NDArray[np.float64]  # (F, 3) flux of each facet; written


class Scheme(NamedTuple):
    """What turns a cell's energies into its share of E, Eq. (4), and a node's neighbourhood into a step."""

    prefix: NDArray  # of the sampling grid
    bits: int
    hand: int  # sign of the cells' volumes in index space
    matrix: NDArray[np.float64]  # (3, 3) index vectors to mm
    projections: NDArray[np.float64]  # (8, 3, 3) see `free_projections`
    geometry: float  # (1 - k_D) / E_G0
    image: float  # k_D x voxel volume / E_D0
    step_ratio: float  # step length over the distance to the nearest cell centroid


def descend(mesh: Tessellation, nodes: NDArray[np.int64], scheme: Scheme) -> None:
    """Move each of `nodes`, all of one colour, along the image's axes to lower its ring's energy (Section 2.2).

    Per axis the ring's energy is measured at one step forwards and backwards, the step a ratio of the distance to
    the nearest centroid of the ring's cells; the vertex of the parabola through the three values is tried as well;
    the best of them is taken if it lies below the present energy.
    """
    with few_threads(len(nodes) * 100):
        _descend(mesh, nodes, scheme)


def relocate(mesh: Tessellation, nodes: NDArray[np.int64], scheme: Scheme) -> None:
    """Move each of `nodes`, all of one colour, to the minimiser of E_G over its ring (Section 2.1).

    Inside, that is the volume-weighted mean of the ring's circumcentres. A node on a face or an edge of the box
    goes to the minimiser within it. A step that inverts a cell or, by rounding, raises E_G is halved up to four
    times, then left out. Sums and fluxes are not kept up: at k_D = 0 the image has no say.
    """
    with few_threads(len(nodes) * 10):
        _relocate(mesh, nodes, scheme)


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
    """Whether a cell is thinner than the engines allow; E_G is volume times sum of squared edges over (n+1)(n+2)."""
    edges = E_G * (n_corners * (n_corners + 1)) / max(volume, 1e-300)
    return volume <= FLAT_SHARE * edges ** (0.5 * (n_corners - 1))


class Trial(NamedTuple):
    """What is measured of a node's ring of R cells and star of S facets, were it elsewhere."""

    x: NDArray[np.float64]  # (4, 3) room for a cell's corners
    cells: NDArray[np.float64]  # (R, 4) moment sums and E_G of each cell
    fluxes: NDArray[np.float64]  # (S, 3)


@njit(cache=True)
def _ring_energy(trial: Trial, limit: float, node: int, mesh: Tessellation, scheme: Scheme) -> float:
    """Energy of a node's ring as `ticks` stand; what is measured goes to `trial`.

    Infinite if a cell is flat or not oriented as `hand` says, or once the energy of the shapes alone is above `limit`.
    """
    first, last, n_corners = mesh.start[node], mesh.start[node + 1], mesh.cells.shape[1]
    ticks, cells, ring, place, x, rows = mesh.ticks, mesh.cells, mesh.ring, mesh.place, trial.x, trial.cells
    energy = 0.0
    for r in range(first, last):  # cheap refusals before any voxel is read
        if cell_orientation(ticks, cells, ring[r]) != scheme.hand:
            return np.inf
        _load(x, ticks, cells, ring[r], scheme.matrix, 2.0**-scheme.bits)
        cell_volume, rows[r - first, 3] = volume_and_E_G(x, n_corners)
        if _is_flat(cell_volume, rows[r - first, 3], n_corners):
            return np.inf
        energy += scheme.geometry * rows[r - first, 3]
    if energy > limit:
        return np.inf
    flux, fluxes, facets, prefix, bits = np.empty((1, 1, 3)), trial.fluxes, mesh.facets, scheme.prefix, scheme.bits
    for s in range(mesh.star_start[node], mesh.star_start[node + 1]):
        facet_flux(ticks, facets, mesh.star[s], bits, prefix, None, flux, 0)
        for d in range(3):
            fluxes[s - mesh.star_start[node], d] = flux[0, 0, d]
    sign, of_cell, present = mesh.sign, mesh.of_cell, mesh.fluxes
    for r in range(first, last):
        for d in range(3):
            total = 0.0
            for k in range(n_corners):
                if place[r, k] < 0:
                    total += sign[ring[r], k] * present[of_cell[ring[r], k], d]
                else:
                    total += sign[ring[r], k] * fluxes[place[r, k], d]
            rows[r - first, d] = scheme.hand * total
        energy += scheme.image * _image_energy(rows[r - first])
    return energy


@njit(cache=True)
def _nearest_centroid(x: NDArray, node: int, mesh: Tessellation, matrix: NDArray, scale: float) -> float:
    """Distance in mm from a node to the nearest centroid of its ring's cells."""
    ticks, cells = mesh.ticks, mesh.cells
    nearest = np.inf
    for r in range(mesh.start[node], mesh.start[node + 1]):
        _load(x, ticks, cells, mesh.ring[r], matrix, scale)
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


# numba drops what the body of a prange writes through a NamedTuple: such bodies are functions.
@njit(cache=True, parallel=True)
def _descend(mesh: Tessellation, nodes: NDArray, scheme: Scheme) -> None:
    for number in prange(len(nodes)):
        _descend_node(nodes[number], mesh, scheme)


@njit(cache=True)
def _descend_node(node: int, mesh: Tessellation, scheme: Scheme) -> None:
    """Move one node along the axes in turn, wherever that lowers its ring's energy."""
    ticks, matrix, scale = mesh.ticks, scheme.matrix, 2.0**-scheme.bits
    n_ring, n_star = mesh.start[node + 1] - mesh.start[node], mesh.star_start[node + 1] - mesh.star_start[node]
    x = np.empty((4, 3))
    trial = Trial(x, np.empty((n_ring, 4)), np.empty((n_star, 3)))
    best_trial = Trial(x, np.empty((n_ring, 4)), np.empty((n_star, 3)))
    energy = 0.0
    for r in range(mesh.start[node], mesh.start[node + 1]):
        cell = mesh.ring[r]
        energy += scheme.geometry * mesh.E_G[cell] + scheme.image * _image_energy(mesh.sums[cell])
    reach = scheme.step_ratio * _nearest_centroid(x, node, mesh, matrix, scale)
    for axis in range(4 - mesh.cells.shape[1], 3):
        length = np.sqrt(matrix[0, axis] ** 2 + matrix[1, axis] ** 2 + matrix[2, axis] ** 2)
        step = np.int64(np.rint(reach / (length * scale)))
        if mesh.is_frozen[node, axis] or step == 0:
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
            value = _ring_energy(trial, limit, node, mesh, scheme)
            if attempt == 0:
                forwards = value
            elif attempt == 1:
                backwards = value
            if value < best:
                best, best_there = value, there
                trial, best_trial = best_trial, trial
        ticks[node, axis] = best_there
        if best_there != here:
            energy = best
            _store(best_trial, node, mesh)


@njit(cache=True)
def _store(trial: Trial, node: int, mesh: Tessellation) -> None:
    """Write what was measured of a node's ring and star into the tessellation."""
    first = mesh.start[node]
    for r in range(first, mesh.start[node + 1]):
        for d in range(3):
            mesh.sums[mesh.ring[r], d] = trial.cells[r - first, d]
        mesh.E_G[mesh.ring[r]] = trial.cells[r - first, 3]
    first = mesh.star_start[node]
    for s in range(first, mesh.star_start[node + 1]):
        for d in range(3):
            mesh.fluxes[mesh.star[s], d] = trial.fluxes[s - first, d]


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
def _relocate(mesh: Tessellation, nodes: NDArray, scheme: Scheme) -> None:
    for number in prange(len(nodes)):
        _relocate_node(nodes[number], mesh, scheme)


@njit(cache=True)
def _relocate_node(node: int, mesh: Tessellation, scheme: Scheme) -> None:
    """Move one node to the minimiser of its ring's E_G, or as far towards it as no cell is inverted."""
    ticks, cells, ring, matrix, scale = mesh.ticks, mesh.cells, mesh.ring, scheme.matrix, 2.0**-scheme.bits
    first, last, n_corners = mesh.start[node], mesh.start[node + 1], cells.shape[1]
    x, gradient, step = np.empty((4, 3)), np.zeros(3), np.empty(3)
    energy, ring_volume = 0.0, 0.0
    for r in range(first, last):
        at = 0
        while cells[ring[r], at] != node:
            at += 1
        _load(x, ticks, cells, ring[r], matrix, scale)
        ring_volume += _add_gradient(gradient, x, at, n_corners)
        energy += mesh.E_G[ring[r]]
    frozen = mesh.is_frozen[node]
    project = scheme.projections[frozen[0] + 2 * frozen[1] + 4 * frozen[2]]
    for d in range(3):  # E_G over the ring is |Omega| / (n+1) |x - minimiser|^2 + constant
        step[d] = -(project[d, 0] * gradient[0] + project[d, 1] * gradient[1] + project[d, 2] * gradient[2])
        step[d] *= n_corners / (2.0 * ring_volume)
    here, trial = (ticks[node, 0], ticks[node, 1], ticks[node, 2]), np.empty(last - first)
    for halving in range(LLOYD_HALVINGS + 1):
        for d in range(3):
            ticks[node, d] = here[d] + np.int64(np.rint(step[d] * 0.5**halving / scale))
        moved = 0.0
        for r in range(first, last):
            _load(x, ticks, cells, ring[r], matrix, scale)
            cell_volume, trial[r - first] = volume_and_E_G(x, n_corners)
            is_flat = _is_flat(cell_volume, trial[r - first], n_corners)
            if is_flat or cell_orientation(ticks, cells, ring[r]) != scheme.hand:
                moved = np.inf
                break
            moved += trial[r - first]
        if moved < energy:
            for r in range(first, last):
                mesh.E_G[ring[r]] = trial[r - first]
            return
    for d in range(3):
        ticks[node, d] = here[d]
