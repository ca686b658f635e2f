"""Move nodes by Newton steps on E of their stars, one colour of groups at a time.

The shape energy's derivative has a closed form. For fixed connectivity, that of E_D needs only the
facets around the node: with hbar_j the mean of cell j, dE_D/dx_a is the sum over the cells of the
integral of (h - hbar_j)^2 phi_a n over their facets, where phi_a is the node's hat function and n
the outward normal; the change of hbar drops out, because hbar is the minimiser. Two cells share a
facet with opposite normals, which leaves (h - hbar_j)^2 - (h - hbar_i)^2. The second derivative of
the shape energy is exact; for E_D only the change of h across facets is used.

Groups of nodes of one colour share no cell, so they are processed, and their stars rewritten, in
parallel; the result does not depend on the threads. A move is made only if no cell of the star
loses its orientation (exactly, in integers) and the star's measured energy falls, so E never rises.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.energy.geometric import volume_and_E_G, volume_gradient
from tetopt.engine.complex import (
    NodeStars,
    Objective,
    State,
    cell_energy,
    cell_value,
    cosine_up_to_limit,
    determinant_and_squares,
    has_node,
    image_energy,
    load_cell,
    outward,
    place,
    put_flux,
    shape_of_cell,
    sum_up,
    tet_energy,
    worst_cosine,
    wrong_side,
)
from tetopt.engine.sliding import (
    band_of,
    combined_ways,
    is_on_surface,
    normals_at,
    projection_at,
    put_on_surface,
    slides,
    star_faces_up,
)
from tetopt.geometry.topology import greedy_colours
from tetopt.geometry.vectors import cross, difference, dot, minus, put_row, row, scale_vector, times
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernels import (
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
    pack_record,
    run,
    unit,
)

FACET_PARTS = 8  # most parts of a facet's edge for integrating h over it; four times as many in 2-D
PART_VOXELS = 3.0  # voxels between the points of this integration
# distance to either side at which h is sampled: E falls by less per sweep at 0.05 and at 0.5
FACET_ASIDE = 0.25
# of the image's curvature: jumps of h end within voxels, and steps are longer than that
BEND_FRACTION = 0.4
# least determinant of a curvature over the product of its diagonal that allows division
FLAT_BEND = 1e-9
# longest first step, of the distance to the nearest centroid of the star's cells
FIRST_STEP_FRACTION = 0.4
AXIS_STEP_FRACTION = 0.1  # of that distance: search step of a stalled node along the axes
BLOCK_NODES = 128  # nodes in a group, at most: their data fit into the cache
APPROACH_TRIALS = 4  # fractions of the way to a surface: all of it, a half, ...
# of the mean of a node's edges: shorter ones are not made on the way to a surface. Without it, 97
# edges, not 49, are shorter than a third of those around them (CT with 41 labels, 4,000 nodes)
SHORTEST_FRACTION = 1.0 / 3.0
# energies measured along the step: a third one gains a twentieth of the search along the axes
LINE_TRIALS = 2


class Blocks(NamedTuple):
    """Groups of neighbouring nodes."""

    nodes: Ints1  # (N,) nodes, group by group
    start: Ints1  # (B+1,) start of each group
    of_node: Ints1  # (N,) the group of each node


def blocks(ticks: Ints) -> Blocks:
    """Group nodes along a Z-order curve (Morton 1966), which gives equal groups on a graded
    mesh, too.
    """
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
    stars: NodeStars,
    groups: Blocks,
    may_move: Bools,
    is_over: Callable[[], bool] = lambda: False,
    gains: Floats | None = None,
) -> bool:
    """Move the nodes in `may_move` (N,), each along the axes and on the surfaces that `is_frozen`
    allows.

    The reduction of E by each move is written to `gains` (N,). Groups of one colour share no cell
    and are processed in parallel, their nodes one after the other. These read the same voxels from
    the cache, 1.5 to 2 times faster than nodes of one colour all over the volume. Returns False if
    `is_over` cut the sweep short, between two colours.
    """
    gains = np.zeros(len(may_move)) if gains is None else gains
    laid_out = pack_record(state), pack_record(stars), pack_record(groups)
    n_moving = np.add.reduceat(may_move[groups.nodes], groups.start[:-1], dtype=np.int64)
    for chosen in colours_of(state, stars, groups):
        if is_over():
            return False
        # the longest first, so that no thread is left with one at the end
        chosen = chosen[np.argsort(-n_moving[chosen], kind="stable")]
        work = Sweep(*laid_out, chosen, may_move, gains)
        run(_sweep, len(chosen), work, len(chosen) * BLOCK_NODES * 100)
    return True


def colours_of(state: State, stars: NodeStars, groups: Blocks) -> list[Ints]:
    """The groups of each colour; groups of one colour share no cell."""
    start, cells = _block_stars(groups.nodes, groups.start, stars.start, stars.cells)
    colours = greedy_colours(
        groups.of_node[state.complex.cells[: state.complex.n_cells[0]]], start, cells
    )
    return [np.flatnonzero(colours == colour) for colour in range(int(colours.max()) + 1)]


@entry
def _block_stars(
    nodes: Ints1, start: Ints1, star_start: Ints1, star_cells: Ints1
) -> tuple[Ints1, Ints1]:
    """The cells around the nodes of each group, as `Stars`; cells may occur several times."""
    first = np.zeros(len(start), dtype=np.int64)
    cells = np.empty(len(star_cells), dtype=np.int64)
    count = 0
    for block in range(len(start) - 1):
        for at in range(start[block], start[block + 1]):
            for r in range(star_start[nodes[at]], star_start[nodes[at] + 1]):
                cells[count] = star_cells[r]
                count += 1
        first[block + 1] = count
    return first, cells


@unit
def _facet_moments(
    moment: Floats2,
    ticks: Ints2,
    node: int,
    b: int,
    c: int,
    aside: tuple[float, float, float],
    objective: Objective,
) -> float:
    """Means of phi, h phi and phi^2 dh over the facet (node, b, c) or segment (node, b), with hat
    function phi.

    h is the mean of the values at a place plus and minus `aside`, in voxels, minus the grid's
    shift, and dh is their difference. moment (2, n_channels) gets the means of h phi and of phi^2
    dh; the mean of phi, 1/3 (1/2 in 2-D), is returned.
    """
    if objective.volume.is_short:
        return _moments_of(moment, objective.volume.short, ticks, node, b, c, aside, objective)
    return _moments_of(moment, objective.volume.long, ticks, node, b, c, aside, objective)


@helper
def _moments_of(
    moment: NDArray,
    prefix: NDArray,
    ticks: NDArray,
    node: int,
    b: int,
    c: int,
    aside: tuple,
    objective: Objective,
) -> float:
    scale, weight = 2.0**-objective.bits, 0.0
    moment[:] = 0.0
    a = scale_vector(scale, row(ticks, node))
    e = minus(scale_vector(scale, row(ticks, b)), a)
    if c < 0:
        parts = min(max(int(np.sqrt(dot(e, e)) / PART_VOXELS) + 1, 2), 4 * FACET_PARTS)
        for p in range(parts):
            s = (p + 0.5) / parts
            weight += 1.0 - s
            _add_sample(
                moment,
                prefix,
                (a[0], a[1] + s * e[1], a[2] + s * e[2]),
                aside,
                1.0 - s,
                1.0 / parts,
            )
        return weight / parts
    f = minus(scale_vector(scale, row(ticks, c)), a)
    parts = min(max(int(np.sqrt(max(dot(e, e), dot(f, f))) / PART_VOXELS) + 1, 2), FACET_PARTS)
    fraction = 1.0 / (parts * parts)
    for p in range(parts):
        for q in range(parts - p):
            for half in range(2):
                if half == 1 and p + q == parts - 1:
                    continue
                s = (p + (1.0 + half) / 3.0) / parts
                t = (q + (1.0 + half) / 3.0) / parts
                weight += 1.0 - s - t
                at = (
                    a[0] + s * e[0] + t * f[0],
                    a[1] + s * e[1] + t * f[1],
                    a[2] + s * e[2] + t * f[2],
                )
                _add_sample(moment, prefix, at, aside, 1.0 - s - t, fraction)
    return weight * fraction


@helper
def _add_sample(
    moment: NDArray, prefix: NDArray, at: tuple, aside: tuple, phi: float, fraction: float
) -> None:
    """Add a fraction of phi h and of phi^2 dh at a place, in voxels, to the rows of `moment`;
    see `_facet_moments`.
    """
    most_i, most_j, most_k = prefix.shape[0] - 1, prefix.shape[1] - 1, prefix.shape[2] - 2
    i = min(max(int(np.rint(at[0] + aside[0])), 0), most_i)
    j = min(max(int(np.rint(at[1] + aside[1])), 0), most_j)
    k = min(max(int(np.rint(at[2] + aside[2])), 0), most_k)
    p = min(max(int(np.rint(at[0] - aside[0])), 0), most_i)
    q = min(max(int(np.rint(at[1] - aside[1])), 0), most_j)
    r = min(max(int(np.rint(at[2] - aside[2])), 0), most_k)
    for channel in range(moment.shape[1]):
        d = 0 if channel == 0 else 1 + channel
        beyond = prefix[i, j, k + 1, d] - prefix[i, j, k, d]
        before = prefix[p, q, r + 1, d] - prefix[p, q, r, d]
        moment[0, channel] += fraction * phi * 0.5 * (beyond + before)
        moment[1, channel] += fraction * phi * phi * (beyond - before)


@unit
def _add_image_gradient(g: Floats1, H: Floats2, state: State, stars: NodeStars, node: int) -> None:
    """Add the derivative of the weighted E_D by a node's position to g (3,), and its curvature to H
    (3, 3), per voxel.

    As a facet moves by phi along its normal, the jump of (h - hbar)^2 across it changes with h. As
    in a Gauss-Newton step, only this part of the curvature is used, and only if it is positive.
    """
    cells, sums, ticks, objective = (
        state.complex.cells,
        state.complex.sums,
        state.complex.ticks,
        state.objective,
    )
    n, first, scale = cells.shape[1], stars.start[node], 2.0**-objective.bits
    every, means = np.empty((2, objective.n_channels)), np.empty((2, objective.n_means))
    for r in range(first, stars.start[node + 1]):
        cell = stars.cells[r]
        for k in range(n):
            twin = stars.twin[r, k]
            if k == stars.corner[r] or twin < 0 or twin // n < r - first:
                # not a facet of the node, on the boundary, along which the node slides, or already
                # done
                continue
            other = stars.cells[first + twin // n]
            label_1, label_2 = state.complex.labels[cell], state.complex.labels[other]
            if _has_same_values(sums, cell, other, label_1, label_2, objective):
                continue
            a, b, c = outward(cells, cell, k)
            e = scale_vector(scale, difference(ticks, b, a))
            if n == 3:  # the segment (a, b), its normal to the right; phi of `node`
                normal = (0.0, e[2], -e[1])
                b = a if b == node else b
            else:
                normal = scale_vector(0.5, cross(e, scale_vector(scale, difference(ticks, c, a))))
                if b == node:
                    b, c = c, a
                elif c == node:
                    b, c = a, b
            normal, area = scale_vector(float(objective.hand), normal), np.sqrt(dot(normal, normal))
            # cells of one label differ only in their means
            moment = means if label_1 == label_2 else every
            weight = _facet_moments(
                moment, ticks, node, b, c, scale_vector(FACET_ASIDE / area, normal), objective
            )
            jump, rise = 0.0, 0.0
            for channel in range(moment.shape[1]):
                value_1 = cell_value(sums, cell, label_1, channel, objective)
                value_2 = cell_value(sums, other, label_2, channel, objective)
                jump += (value_2 - value_1) * (
                    2.0 * moment[0, channel] - (value_1 + value_2) * weight
                )
                rise += (value_2 - value_1) * moment[1, channel]
            bend = BEND_FRACTION * max(rise, 0.0) / (FACET_ASIDE * area)
            for d in range(3):
                g[d] += objective.image * jump * normal[d]
                for m in range(3):
                    H[d, m] += objective.image * bend * normal[d] * normal[m]


@helper
def _has_same_values(
    sums: NDArray, cell: int, other: int, label_1: int, label_2: int, objective: Objective
) -> bool:
    """True if two cells have equal values in all channels, as in the background, or one contains
    no voxel.
    """
    count_1, count_2 = sums[cell, 0], sums[other, 0]
    if count_1 <= 0.0 or count_2 <= 0.0:
        return True
    is_same = label_1 == label_2
    for channel in range(objective.n_means):
        d = 1 if channel == 0 else 2 + channel
        is_same = is_same and sums[cell, d] * count_2 == sums[other, d] * count_1
    return is_same


@unit
def _add_shape_gradient(
    g: Floats1, H: Floats2, x: Floats2, state: State, stars: NodeStars, node: int
) -> tuple[float, float]:
    """Add the weighted shape energy's derivatives to g (3,), per mm, and H (3, 3), per mm^2.

    Returns the distance in mm to the nearest centroid of the star's cells, and the star's worst
    cosine, up to the angle limit.
    """
    cells, objective = state.complex.cells, state.objective
    n, power = cells.shape[1], objective.power
    dim, nearest, least = n - 1, np.inf, objective.angle_limit
    # W is proportional to v^alpha S^p with alpha = 1 - 2 (p - 1) / n, on a graded mesh alpha = -2 p
    # / n. The volume is linear in the corner's place, and S has the second derivative 2 n along
    # each axis.
    alpha = -2.0 * power / dim if objective.is_graded else 1.0 - 2.0 * (power - 1.0) / dim
    for r in range(stars.start[node], stars.start[node + 1]):
        cell, at = stars.cells[r], stars.corner[r]
        load_cell(x, state.complex.ticks, cells, cell, objective)
        volume, S = _volume_and_squares(x, n)
        W = objective.geometry * state.complex.E_shape[cell]
        apart = (0.0, 0.0, 0.0)
        for k in range(n):
            apart = minus(apart, difference(x, k, at))
        nearest = min(nearest, dot(apart, apart))
        v, w = scale_vector(1.0 / volume, volume_gradient(x, at, n)), scale_vector(2.0 / S, apart)
        for d in range(3):
            slope = alpha * v[d] + power * w[d]
            g[d] += W * slope
            H[d, d] += W * power * 2.0 * dim / S
            for m in range(3):
                H[d, m] += W * (
                    slope * (alpha * v[m] + power * w[m])
                    - alpha * v[d] * v[m]
                    - power * w[d] * w[m]
                )
        if n == 4 and least > -1.0:
            least = min(least, cosine_up_to_limit(x, objective))
    return np.sqrt(nearest) / n, least


@helper
def _volume_and_squares(x: NDArray, n_corners: int) -> tuple:
    """Volume and sum of squared edges of the cell x (4, 3)."""
    if n_corners == 4:
        determinant, S = determinant_and_squares(x)
        return abs(determinant) / 6.0, S
    volume, E_G = volume_and_E_G(x, n_corners)
    return volume, E_G * (n_corners * (n_corners + 1)) / volume


class Trial(NamedTuple):
    """Results of `star_energy` for a node's star of R cells."""

    x: Floats2  # (4, 3) space for a cell's corners
    shapes: Floats1  # (R,) shape energy of each cell; -1 if it is removed
    fluxes: Floats3  # (R, n+1, D) outward fluxes of its facets around the node


TrialByValue = Annotated[Trial, by_value(Trial)]  # made by the kernels, several per move


@helper
def trial_of(state: State, stars: NodeStars, node: int) -> Trial:
    """Space for measurements of a node's star."""
    size, fluxes = stars.start[node + 1] - stars.start[node], state.complex.fluxes
    return Trial(
        np.empty((4, 3)), np.empty(size), np.empty((size, fluxes.shape[1], fluxes.shape[2]))
    )


@inlined
def star_misfit(state: State, stars: NodeStars, node: int) -> tuple:
    """Minus the star's weighted misfit to the mask before a move, and True if a move may change
    it.
    """
    misfit, has_misfit = 0.0, False
    if state.objective.surface > 0.0:
        for r in range(stars.start[node], stars.start[node + 1]):
            misfit -= wrong_side(state.complex.sums, stars.cells[r], state.objective)
            for k in range(state.complex.cells.shape[1]):
                has_misfit = has_misfit or (k != stars.corner[r] and stars.twin[r, k] < 0)
    return misfit, has_misfit


@inlined
def star_shape(
    trial: Trial, limit: float, least: float, node: int, state: State, stars: NodeStars, joined: int
) -> float:
    """Weighted shape energy of a node's star at the current ticks; each cell's is written to
    `trial.shapes`.

    It is infinite if a cell is flat or inverted or has a cosine below `least`, or once the energy
    exceeds `limit`. Cells with the node `joined`, at whose place the node is, count as removed.
    """
    cells, objective = state.complex.cells, state.objective
    has_limit = cells.shape[1] == 4 and least > -1.0
    first, energy = stars.start[node], 0.0
    for r in range(first, stars.start[node + 1]):
        if joined >= 0 and has_node(cells, stars.cells[r], joined):
            trial.shapes[r - first] = -1.0
            continue
        if has_limit:  # of tetrahedra; one determinant serves both checks
            load_cell(trial.x, state.complex.ticks, cells, stars.cells[r], objective)
            determinant, S = determinant_and_squares(trial.x)
            shape = tet_energy(determinant, S, objective.power, objective.is_graded)
            is_safe = shape < np.inf and S * S * S <= objective.safe * determinant * determinant
            if not (is_safe or (shape < np.inf and worst_cosine(trial.x) >= least)):
                return np.inf
        else:
            shape = shape_of_cell(trial.x, state.complex.ticks, cells, stars.cells[r], objective)
        trial.shapes[r - first] = shape
        energy += objective.geometry * shape
        if energy > limit:
            return np.inf
    return energy


@inlined
def star_image(
    sums: NDArray,
    trial: Trial,
    energy: float,
    misfit: float,
    bound: float,
    node: int,
    state: State,
    stars: NodeStars,
) -> tuple:
    """Add the image energy of a node's star at the current ticks to `energy`, and its misfit to the
    misfit.

    It is infinite once the energy exceeds `bound`. Fluxes are written to `trial`, whose `shapes`
    are negative for removed cells; `sums` (1, D) is work space for a cell's sums.
    """
    cells, objective, shapes, fluxes = (
        state.complex.cells,
        state.objective,
        trial.shapes,
        trial.fluxes,
    )
    n, D, first = cells.shape[1], fluxes.shape[2], stars.start[node]
    for r in range(first, stars.start[node + 1]):
        if shapes[r - first] < 0.0:
            continue
        cell = stars.cells[r]
        for d in range(D):
            sums[0, d] = 0.0
        for k in range(n):
            if k == stars.corner[r]:
                for d in range(D):
                    sums[0, d] += state.complex.fluxes[cell, k, d]
                continue
            twin = stars.twin[r, k]
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
            return np.inf, misfit
    return energy, misfit


@unit
def star_energy(
    trial: TrialByValue,
    limit: float,
    least: float,
    node: int,
    state: State,
    stars: NodeStars,
    joined: int,
) -> float:
    """Energy of a node's star at the current ticks, with details in `trial`; infinite as for
    `star_shape`.

    It includes the growth of the star's misfit to the mask.
    """
    misfit, has_misfit = star_misfit(state, stars, node)
    # partial sums are meaningless until they include all of the misfit
    bound = np.inf if has_misfit else limit
    # cheap rejections before any voxel is read
    energy = star_shape(trial, bound, least, node, state, stars, joined)
    if energy == np.inf or state.objective.image == 0.0:
        return energy
    sums = np.empty((1, trial.fluxes.shape[2]))
    energy, misfit = star_image(sums, trial, energy, misfit, bound, node, state, stars)
    if has_misfit:
        energy += misfit
    return energy if energy <= limit else np.inf


@unit
def store(trial: TrialByValue, node: int, state: State, stars: NodeStars) -> None:
    """Write the results of `star_energy` for a node's star to the complex."""
    first, fluxes = stars.start[node], state.complex.fluxes
    for r in range(first, stars.start[node + 1]):
        cell = stars.cells[r]
        state.complex.E_shape[cell] = trial.shapes[r - first]
        if state.objective.image > 0.0:
            for k in range(fluxes.shape[1]):
                if k != stars.corner[r]:
                    for d in range(fluxes.shape[2]):
                        fluxes[cell, k, d] = trial.fluxes[r - first, k, d]
            sum_up(state.complex.sums, fluxes, cell)


class Sweep(NamedTuple):
    """The groups of one colour, whose nodes may move."""

    state: State
    stars: NodeStars
    groups: Blocks
    chosen: Ints1  # (G,) the groups
    may_move: Bools1  # (N,)
    gains: Floats1  # (N,) reduction of E by each node's move; unused by `attract`


@unit
def _sweep(work: Sweep, number: int) -> None:
    groups, block = work.groups, work.chosen[number]
    for at in range(groups.start[block], groups.start[block + 1]):
        if work.may_move[groups.nodes[at]]:
            work.gains[groups.nodes[at]] = _move(groups.nodes[at], work.state, work.stars)


class Search(NamedTuple):
    """The best place of a node so far, and space for two trials: slot[0] is the best, the other
    one the next.
    """

    x: Floats  # (4, 3) room for a cell's corners
    normal: Floats  # (7, 3) see `tetopt.engine.sliding.normals_at`
    is_sliding: bool  # True if the node stays on its surfaces
    best: Floats  # (1,) the least energy of the star
    place: Ints  # (1, 3) its place, ticks
    slot: Ints  # (1,)
    shapes: Floats  # (2, R) as in `Trial`
    fluxes: Floats  # (2, R, n+1, D)


# Its steps and those of `star_energy` are inlined: compared with one long function, a sweep took 12
# % longer with calls, and 3 to 8 % longer with inlined steps (MNI152 T1, 5,000 nodes, one thread).
@unit
def _move(node: int, state: State, stars: NodeStars) -> float:
    """Move one node towards the least energy of its star, if that lowers it; return the
    reduction.
    """
    ticks, fluxes, has_image = (
        state.complex.ticks,
        state.complex.fluxes,
        state.objective.image > 0.0,
    )
    x, normal, g, H = np.empty((4, 3)), np.zeros((7, 3)), np.zeros(3), np.zeros((3, 3))
    # A star with flat cells may stay as it is, but not get worse, hence its own `least`.
    nearest, least = _add_shape_gradient(g, H, x, state, stars, node)
    _turn_to_index(g, H, state.objective.matrix)
    if has_image:
        _add_image_gradient(g, H, state, stars, node)
    is_sliding = slides(normal, state, node)
    is_bound = is_sliding and not band_of(state, node) > 0.0
    step = _sliding_step(normal, g, node, state) if is_bound else _newton_step(g, H, node, state)
    moved, slope = (
        times(state.objective.matrix, step),
        g[0] * step[0] + g[1] * step[1] + g[2] * step[2],
    )
    square = dot(moved, moved)  # mm^2
    if not (square > 0.0 and slope < 0.0):
        return 0.0
    energy, size = 0.0, stars.start[node + 1] - stars.start[node]
    for r in range(stars.start[node], stars.start[node + 1]):
        energy += cell_energy(state, stars.cells[r])
    search = Search(
        x,
        normal,
        is_sliding,
        np.empty(1),
        np.empty((1, 3), dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        np.empty((2, size)),
        np.empty((2, size, fluxes.shape[1], fluxes.shape[2])),
    )
    search.best[0] = energy
    put_row(search.place, 0, row(ticks, node))
    length, bend = FIRST_STEP_FRACTION * nearest / np.sqrt(square), dot(step, times(H, step))
    if bend > 0.0:
        length = min(length, -slope / bend)
    _search_line(search, step, length, slope, least, node, state, stars)
    if not search.best[0] < energy and has_image:
        _search_axes(search, step, AXIS_STEP_FRACTION * nearest, least, node, state, stars)
    put_row(ticks, node, row(search.place, 0))
    if search.best[0] < energy:
        slot = search.slot[0]
        store(Trial(x, search.shapes[slot], search.fluxes[slot]), node, state, stars)
    return energy - search.best[0]


@inlined
def _turn_to_index(g: NDArray, H: NDArray, matrix: NDArray) -> None:
    """Convert first and second derivatives per mm, g (3,) and H (3, 3), to index units."""
    u, A = (g[0], g[1], g[2]), H.copy()
    for d in range(3):
        g[d] = matrix[0, d] * u[0] + matrix[1, d] * u[1] + matrix[2, d] * u[2]
        for m in range(3):
            H[d, m] = 0.0
            for p in range(3):
                for q in range(3):
                    H[d, m] += matrix[p, d] * A[p, q] * matrix[q, m]


@inlined
def _per_mm(g: NDArray, state: State) -> tuple:
    """Convert derivatives per index unit, g (3,), to mm."""
    M = state.sides.inverse
    return (
        M[0, 0] * g[0] + M[1, 0] * g[1] + M[2, 0] * g[2],
        M[0, 1] * g[0] + M[1, 1] * g[1] + M[2, 1] * g[2],
        M[0, 2] * g[0] + M[1, 2] * g[1] + M[2, 2] * g[2],
    )


@helper
def _newton_step(g: NDArray, H: NDArray, node: int, state: State) -> tuple:
    """-H^-1 g, in index units, over the axes along which a node may move; down the gradient if H is
    not positive.

    The rows of the other axes are cleared.
    """
    trace = H[0, 0] + H[1, 1] + H[2, 2]
    for d in range(3):
        if state.complex.is_frozen[node, d]:
            g[d] = 0.0
            H[d, :] = 0.0
            H[:, d] = 0.0
            H[d, d] = trace
    # Cramer's rule, from the adjugate.
    c00, c11 = H[1, 1] * H[2, 2] - H[1, 2] * H[1, 2], H[0, 0] * H[2, 2] - H[0, 2] * H[0, 2]
    c22, c01 = H[0, 0] * H[1, 1] - H[0, 1] * H[0, 1], H[0, 2] * H[1, 2] - H[0, 1] * H[2, 2]
    c02, c12 = H[0, 1] * H[1, 2] - H[0, 2] * H[1, 1], H[0, 1] * H[0, 2] - H[0, 0] * H[1, 2]
    determinant = H[0, 0] * c00 + H[0, 1] * c01 + H[0, 2] * c02
    if H[0, 0] > 0.0 and c22 > 0.0 and determinant > FLAT_BEND * H[0, 0] * H[1, 1] * H[2, 2]:
        u = scale_vector(-1.0 / determinant, (g[0], g[1], g[2]))
        return dot((c00, c01, c02), u), dot((c01, c11, c12), u), dot((c02, c12, c22), u)
    return scale_vector(-1.0, times(projection_at(state, node), _per_mm(g, state)))


@helper
def _sliding_step(normal: NDArray, g: NDArray, node: int, state: State) -> tuple:
    """Down the gradient g (3,), along the axes and on the surfaces on which a node may move;
    index units.
    """
    step = scale_vector(-1.0, times(projection_at(state, node), _per_mm(g, state)))
    count = normals_at(normal, state, node)
    rise = dot(row(normal, 0), step), dot(row(normal, 1), step), dot(row(normal, 2), step)
    is_found, way = combined_ways(normal, count, rise)
    return minus(step, way) if is_found else (0.0, 0.0, 0.0)


@inlined
def _try_place(
    search: Search,
    place: tuple,
    limit: float,
    least: float,
    node: int,
    state: State,
    stars: NodeStars,
) -> float:
    """Energy of the star with the node at a place in ticks, or on the surface next to it; stores
    the best place.
    """
    put_row(state.complex.ticks, node, place)
    if search.is_sliding and not slide_node(search.normal, state, stars, node):
        return np.inf
    slot = 1 - search.slot[0]
    value = star_energy(
        Trial(search.x, search.shapes[slot], search.fluxes[slot]),
        limit,
        least,
        node,
        state,
        stars,
        -1,
    )
    if value < search.best[0]:
        search.best[0], search.slot[0] = value, slot
        put_row(search.place, 0, row(state.complex.ticks, node))
    return value


@inlined
def _search_line(
    search: Search,
    step: tuple,
    t: float,
    slope: float,
    least: float,
    node: int,
    state: State,
    stars: NodeStars,
) -> None:
    """Try the place t steps ahead, then the vertex of the parabola through the measured values.

    `slope` is the initial change of E per step.
    """
    energy, scale = search.best[0], 2.0**-state.objective.bits
    here = row(search.place, 0)
    for trial in range(LINE_TRIALS):
        place = (
            here[0] + np.int64(np.rint(t * step[0] / scale)),
            here[1] + np.int64(np.rint(t * step[1] / scale)),
            here[2] + np.int64(np.rint(t * step[2] / scale)),
        )
        limit = np.inf if trial == 0 else search.best[0]
        value = _try_place(search, place, limit, least, node, state, stars)
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
def _search_axes(
    search: Search,
    step: tuple,
    length: float,
    least: float,
    node: int,
    state: State,
    stars: NodeStars,
) -> None:
    """Search by a length, mm, along each free axis in turn, towards the step first, and continue
    where E is lower.

    The gradient is that of the continuous image, the energy that of its voxels: a stalled node may
    still lower E so.
    """
    M = state.objective.matrix
    for axis in range(4 - state.complex.cells.shape[1], 3):
        if state.complex.is_frozen[node, axis]:
            continue
        spacing = np.sqrt(M[0, axis] ** 2 + M[1, axis] ** 2 + M[2, axis] ** 2)
        shift = np.int64(np.rint(length / (spacing * 2.0**-state.objective.bits)))
        if step[axis] < 0.0:
            shift = -shift
        here, energy = row(search.place, 0), search.best[0]
        for _ in range(2):
            place = (
                here[0] + (shift if axis == 0 else 0),
                here[1] + (shift if axis == 1 else 0),
                here[2] + (shift if axis == 2 else 0),
            )
            if _try_place(search, place, search.best[0], least, node, state, stars) < energy:
                break
            shift = -shift


@unit
def slide_node(normal: Floats2, state: State, stars: NodeStars, node: int) -> bool:
    """Return a moved node to its surfaces; True if it gets there and the mask's facets keep
    facing outwards.
    """
    is_there = put_on_surface(normal, state, node)
    return is_there and (
        not state.complex.is_frozen[node, 3] or star_faces_up(normal, state, stars, node, -1)
    )


# Move nodes of a mask's surface, or between labels, to their places there, where they will slide.


def attract(state: State, stars: NodeStars, groups: Blocks, angle_limit: float) -> None:
    """Move nodes to their places at surfaces, or as far as no cell becomes flatter than
    `angle_limit`.

    A cell that is flatter already may not get worse. E may rise. `angle_limit` is minus a cosine,
    as in `Objective`.
    """
    lowered = state._replace(objective=state.objective._replace(angle_limit=angle_limit))
    is_beside = (state.complex.meeting[:, 1] >= 0) | state.complex.is_frozen[:, 3]
    laid_out = pack_record(lowered), pack_record(stars), pack_record(groups)
    for chosen in colours_of(state, stars, groups):
        work = Sweep(*laid_out, chosen, is_beside, np.zeros(0))
        run(_attract, len(chosen), work, len(chosen) * BLOCK_NODES * 20)


@unit
def _attract(work: Sweep, number: int) -> None:
    groups, block = work.groups, work.chosen[number]
    for at in range(groups.start[block], groups.start[block + 1]):
        if work.may_move[groups.nodes[at]]:
            _approach(groups.nodes[at], work.state, work.stars)


@unit
def _approach(node: int, state: State, stars: NodeStars) -> None:
    ticks, normal, x = state.complex.ticks, np.zeros((7, 3)), np.empty((4, 3))
    if is_on_surface(normal, state, node):
        return
    least = state.objective.angle_limit
    for r in range(stars.start[node], stars.start[node + 1]):
        load_cell(x, ticks, state.complex.cells, stars.cells[r], state.objective)
        if state.complex.cells.shape[1] == 4:
            least = min(least, cosine_up_to_limit(x, state.objective))
    here = row(ticks, node)
    shortest = min(SHORTEST_FRACTION, _shortest(node, state, stars))
    put_on_surface(normal, state, node)
    way, fraction, trial = minus(row(ticks, node), here), 1.0, trial_of(state, stars, node)
    for _ in range(APPROACH_TRIALS):
        put_row(
            ticks,
            node,
            (
                here[0] + np.int64(np.rint(fraction * way[0])),
                here[1] + np.int64(np.rint(fraction * way[1])),
                here[2] + np.int64(np.rint(fraction * way[2])),
            ),
        )
        is_free = not state.complex.is_frozen[node, 3] or star_faces_up(
            normal, state, stars, node, -1
        )
        is_free = is_free and _shortest(node, state, stars) >= shortest
        if is_free and star_energy(trial, np.inf, least, node, state, stars, -1) < np.inf:
            store(trial, node, state, stars)
            return
        fraction *= 0.5
    put_row(ticks, node, here)


@helper
def _shortest(node: int, state: State, stars: NodeStars) -> float:
    """Length of a node's shortest edge over the mean of all, each counted once for each of its
    cells.
    """
    least, total, count = np.inf, 0.0, 0
    for r in range(stars.start[node], stars.start[node + 1]):
        for k in range(state.complex.cells.shape[1]):
            other = state.complex.cells[stars.cells[r], k]
            if other != node:
                way = place(state.complex.ticks, other, node, state.objective)
                length = np.sqrt(dot(way, way))
                least, total, count = min(least, length), total + length, count + 1
    return least * count / total
