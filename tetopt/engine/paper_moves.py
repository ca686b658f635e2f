"""The two moves of the paper's scheme: descent with numerical derivatives, and Lloyd's relocation.

Nodes of one colour share no cell and move at the same time, so the result does not depend on the
threads. A node moves only if no cell of its star loses its orientation (exactly, in integers) and
the star's energy falls. The state's shape energy is E_G, measured as `tetopt.energy.geometric`
measures it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.energy.geometric import volume_and_E_G, volume_gradient
from tetopt.energy.sampling import cell_orientation
from tetopt.engine.complex import FLAT_FRACTION, NodeStars, State, cell_energy
from tetopt.engine.sliding import projection_at
from tetopt.engine.smooth import Trial, TrialByValue, star_image, store, trial_of
from tetopt.geometry.vectors import difference, minus, put_row, row, scale_vector, times
from tetopt.system.kernels import Floats2, Ints1, helper, run, unit

# of a Lloyd step that inverts a cell or raises the star's energy, before the node stays
LLOYD_HALVINGS = 4


class Moves(NamedTuple):
    """The nodes of one colour, and inputs and outputs of their moves."""

    state: State
    stars: NodeStars
    nodes: Ints1
    step_ratio: float  # step length of the descent over the distance to the nearest cell centroid


def descend(moves: Moves) -> None:
    """Move nodes along the image's axes to lower the energy of their stars (Section 2.2).

    For each axis the star's energy is measured one step forwards and backwards, where the step is a
    fraction of the distance to the nearest centroid of the star's cells, and at the vertex of the
    parabola through the three values. The node moves to the best of these if that lowers the
    energy.
    """
    run(_descend, len(moves.nodes), moves, len(moves.nodes) * 100)


def relocate(moves: Moves) -> None:
    """Move nodes to the minimisers of E_G over their stars (Section 2.1), with weights 1 and 0 in
    the objective.

    Inside, this is the volume-weighted mean of the star's circumcentres. A node on a face or an
    edge of the box moves to the minimiser within it. A step that inverts a cell or, by rounding,
    raises E_G is halved up to four times, then skipped. Sums and fluxes are not updated.
    """
    run(_relocate, len(moves.nodes), moves, len(moves.nodes) * 10)


@helper
def _load_cell(x: NDArray, state: State, cell: int) -> None:
    """Write a cell's corners, mm from the middle of the first voxel, to x (4, 3)."""
    mesh, objective = state.complex, state.objective
    for k in range(mesh.cells.shape[1]):
        place = scale_vector(2.0**-objective.bits, row(mesh.ticks, mesh.cells[cell, k]))
        put_row(x, k, times(objective.matrix, place))


@helper
def _shape(x: NDArray, state: State, cell: int) -> float:
    """E_G of a cell; infinite if it is flat or inverted."""
    mesh, n_corners = state.complex, state.complex.cells.shape[1]
    if cell_orientation(mesh.ticks, mesh.cells, cell) != state.objective.hand:
        return np.inf
    _load_cell(x, state, cell)
    volume, E_G = volume_and_E_G(x, n_corners)
    # 1e-300, chosen: against division by 0
    squares = E_G * (n_corners * (n_corners + 1)) / max(volume, 1e-300)
    return np.inf if volume <= FLAT_FRACTION * squares ** (0.5 * (n_corners - 1)) else E_G


@unit
def _star_energy(
    trial: TrialByValue, limit: float, node: int, state: State, stars: NodeStars
) -> float:
    """Energy of a node's star at the current ticks; measured values are written to `trial`.

    It is infinite if a cell is flat or inverted, or once the energy exceeds `limit`.
    """
    first, energy = stars.start[node], 0.0
    for r in range(first, stars.start[node + 1]):  # cheap rejections before any voxel is read
        trial.shapes[r - first] = _shape(trial.x, state, stars.cells[r])
        if trial.shapes[r - first] == np.inf:
            return np.inf
        energy += state.objective.geometry * trial.shapes[r - first]
    if energy > limit:
        return np.inf
    if state.objective.image > 0.0:
        sums = np.empty((1, trial.fluxes.shape[2]))
        energy, _ = star_image(sums, trial, energy, 0.0, limit, node, state, stars)
    return energy


@unit
def _nearest_centroid(x: Floats2, node: int, state: State, stars: NodeStars) -> float:
    """Distance in mm from a node to the nearest centroid of its star's cells."""
    nearest, n_corners = np.inf, state.complex.cells.shape[1]
    for r in range(stars.start[node], stars.start[node + 1]):
        _load_cell(x, state, stars.cells[r])
        squared = 0.0
        for d in range(3):
            mean = 0.0
            for k in range(n_corners):
                mean += x[k, d] / n_corners
            squared += (mean - x[stars.corner[r], d]) ** 2
        nearest = min(nearest, squared)
    return np.sqrt(nearest)


@unit
def _descend(moves: Moves, number: int) -> None:
    """Move one node along the axes in turn, wherever that lowers its star's energy."""
    node, state, stars = moves.nodes[number], moves.state, moves.stars
    ticks, matrix, fluxes = state.complex.ticks, state.objective.matrix, state.complex.fluxes
    size, x = stars.start[node + 1] - stars.start[node], np.empty((4, 3))
    # Two trials: the best so far is in row `kept`, the next is written to the other.
    shapes, sides, kept = (
        np.empty((2, size)),
        np.empty((2, size, fluxes.shape[1], fluxes.shape[2])),
        0,
    )
    energy = 0.0
    for r in range(stars.start[node], stars.start[node + 1]):
        energy += cell_energy(state, stars.cells[r])
    reach = moves.step_ratio * _nearest_centroid(x, node, state, stars)
    for axis in range(4 - state.complex.cells.shape[1], 3):
        length = np.sqrt(matrix[0, axis] ** 2 + matrix[1, axis] ** 2 + matrix[2, axis] ** 2)
        step = np.int64(np.rint(reach / (length * 2.0**-state.objective.bits)))
        if state.complex.is_frozen[node, axis] or step == 0:
            continue
        here = ticks[node, axis]
        best, best_there = energy, here
        forwards, backwards = np.inf, np.inf
        for attempt in range(3):
            if attempt < 2:  # the numerical derivative: one step forwards, one backwards
                there = here + step * (1 - 2 * attempt)
                limit = np.inf  # the parabola needs both values in full
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
            value = _star_energy(
                Trial(x, shapes[1 - kept], sides[1 - kept]), limit, node, state, stars
            )
            if attempt == 0:
                forwards = value
            elif attempt == 1:
                backwards = value
            if value < best:
                best, best_there, kept = value, there, 1 - kept
        ticks[node, axis] = best_there
        if best_there != here:
            energy = best
            store(Trial(x, shapes[kept], sides[kept]), node, state, stars)


@unit
def _relocate(moves: Moves, number: int) -> None:
    """Move one node to the minimiser of its star's E_G, or as far towards it as no cell inverts."""
    node, state, stars = moves.nodes[number], moves.state, moves.stars
    ticks, n_corners, trial = (
        state.complex.ticks,
        state.complex.cells.shape[1],
        trial_of(state, stars, node),
    )
    weight, gradient, energy, star_volume = (
        1.0 / (n_corners * (n_corners + 1)),
        np.zeros(3),
        0.0,
        0.0,
    )
    for r in range(stars.start[node], stars.start[node + 1]):
        _load_cell(trial.x, state, stars.cells[r])
        volume, E_G = volume_and_E_G(trial.x, n_corners)
        edges, slope = E_G / (volume * weight), volume_gradient(trial.x, stars.corner[r], n_corners)
        apart = (0.0, 0.0, 0.0)
        for k in range(n_corners):
            apart = minus(apart, difference(trial.x, k, stars.corner[r]))
        for d in range(3):
            gradient[d] += weight * (slope[d] * edges + 2.0 * volume * apart[d])
        star_volume += volume
        energy += state.complex.E_shape[stars.cells[r]]
    # E_G over the star is |Omega| / (n+1) |x - minimiser|^2 + constant.
    step, here = times(projection_at(state, node), gradient), row(ticks, node)
    step = scale_vector(-n_corners / (2.0 * star_volume), step)
    for halving in range(LLOYD_HALVINGS + 1):
        for d in range(3):
            ticks[node, d] = here[d] + np.int64(
                np.rint(step[d] * 0.5**halving / 2.0**-state.objective.bits)
            )
        if _star_energy(trial, np.inf, node, state, stars) < energy:
            store(trial, node, state, stars)
            return
    put_row(ticks, node, here)
