"""Nodes that slide on the surface of a mask: the zero level of the function of
`tetopt.contents.domain`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.domain import ON_SURFACE_VOXELS
from tetopt.engine.complex import NodeStars, State, facet_area, has_node, outward, place
from tetopt.geometry.vectors import cross, dot, row, scale_vector
from tetopt.system.arrays import Floats
from tetopt.system.kernels import Floats1, Floats2, Singles3, entry, helper, unit

# where several surfaces meet, a place whose levels are this close to 0 lies on all of them
NEAR_CURVE_VOXELS = 0.1
CURVE_STEP_VOXELS = 0.7  # longest step towards such a place, where levels bend
CURVE_STEPS = 16  # at most, onto a curve or a point
NEWTON_STEPS = 6  # at most, onto the surface
# cosine of the widest angle between a facet's normal and the way up the level at its moved node
OUTWARD_COSINE = 0.1
ASIDE_VOXELS = 0.25  # distance to either side of a place for the slope of the level
MOST_MEETING = 4  # most labels whose levels a node is moved onto; where more meet, four of them
# squared sine of the angle between ways up, below which two surfaces count as one
PARALLEL_FRACTION = 1e-3
LEVELS_RISE = 2.0  # of one label's level over another's, per voxel across their surface
FLAT_RISE = 1e-12  # least rise of a level along the way up that allows division


@helper
def is_among(label: int, labels: NDArray) -> bool:
    """True if a label is one of several."""
    is_one = False
    for other in labels:
        is_one = is_one or other == label
    return is_one


@helper
def insert_label(labels: NDArray, count: int, label: int) -> int:
    """Insert a label that is not yet among the first `count` of a row, in rising order, if there
    is room; return the number of labels.
    """
    if is_among(label, labels[: min(count, MOST_MEETING)]):
        return count
    if count < MOST_MEETING:
        m = count
        while m > 0 and labels[m - 1] > label:
            labels[m] = labels[m - 1]
            m -= 1
        labels[m] = label
    return count + 1


@entry
def level_at(level: Singles3, i: float, j: float, k: float) -> float:
    """The level at an index position, linear along each axis between voxel centres."""
    i = min(max(i, 0.0), level.shape[0] - 1.0)
    j = min(max(j, 0.0), level.shape[1] - 1.0)
    k = min(max(k, 0.0), level.shape[2] - 1.0)
    i0 = min(int(i), max(level.shape[0] - 2, 0))
    j0 = min(int(j), max(level.shape[1] - 2, 0))
    k0 = min(int(k), max(level.shape[2] - 2, 0))
    i1, j1 = min(i0 + 1, level.shape[0] - 1), min(j0 + 1, level.shape[1] - 1)
    k1 = min(k0 + 1, level.shape[2] - 1)
    u, v, w = i - i0, j - j0, k - k0
    near = (1.0 - v) * ((1.0 - w) * level[i0, j0, k0] + w * level[i0, j0, k1])
    near += v * ((1.0 - w) * level[i0, j1, k0] + w * level[i0, j1, k1])
    far = (1.0 - v) * ((1.0 - w) * level[i1, j0, k0] + w * level[i1, j0, k1])
    far += v * ((1.0 - w) * level[i1, j1, k0] + w * level[i1, j1, k1])
    return (1.0 - u) * near + u * far


@helper
def _slope_at(slope: NDArray, row: int, state: State, node: int) -> None:
    """Write the slope of the level at a node, per voxel along each axis, to slope[row]."""
    ticks, scale, L = state.complex.ticks, 2.0**-state.objective.bits, state.sides.level
    i, j, k = ticks[node, 0] * scale, ticks[node, 1] * scale, ticks[node, 2] * scale
    slope[row, 0] = 2.0 * (
        level_at(L, i + ASIDE_VOXELS, j, k) - level_at(L, i - ASIDE_VOXELS, j, k)
    )
    slope[row, 1] = 2.0 * (
        level_at(L, i, j + ASIDE_VOXELS, k) - level_at(L, i, j - ASIDE_VOXELS, k)
    )
    slope[row, 2] = 2.0 * (
        level_at(L, i, j, k + ASIDE_VOXELS) - level_at(L, i, j, k - ASIDE_VOXELS)
    )


@unit
def uphill_at(uphill: Floats2, state: State, node: int) -> None:
    """Write the way up the level at a node, in mm, to uphill[0]; uphill is (2, 3)."""
    _slope_at(uphill, 1, state, node)
    for m in range(3):
        uphill[0, m] = 0.0
        for c in range(3):
            uphill[0, m] += state.sides.inverse[c, m] * uphill[1, c]


@unit
def faces_up(state: State, cell: int, k: int, old: int, new: int, uphill: Floats2) -> bool:
    """True if a boundary facet, with the node `new` for `old`, faces up the level or lies on a side
    of the box.

    A node that slides or is put across a gap onto another part of the surface would reverse it.
    """
    t = state.complex.ticks
    a, b, c = outward(state.complex.cells, cell, k)
    a, b, c = new if a == old else a, new if b == old else b, new if c == old and c >= 0 else c
    for d in range(3):
        at = t[a, d]
        is_flat = t[b, d] == at and (c < 0 or t[c, d] == at)
        if is_flat and (at == state.sides.low[d] or at == state.sides.high[d]):
            return True
    u = place(t, b, a, state.objective)
    n = (0.0, u[2], -u[1]) if c < 0 else cross(u, place(t, c, a, state.objective))
    up = row(uphill, 0)
    return dot(n, up) > OUTWARD_COSINE * np.sqrt(dot(n, n) * dot(up, up))


@unit
def star_faces_up(uphill: Floats2, state: State, stars: NodeStars, node: int, joined: int) -> bool:
    """`faces_up` for all boundary facets around a node at its place, of cells without `joined`."""
    cells = state.complex.cells
    uphill_at(uphill, state, node)
    for r in range(stars.start[node], stars.start[node + 1]):
        cell = stars.cells[r]
        if joined >= 0 and has_node(cells, cell, joined):
            continue
        for k in range(cells.shape[1]):
            is_outer = state.complex.across[cell, k] < 0 and k != stars.corner[r]
            if is_outer and not faces_up(state, cell, k, node, node, uphill):
                return False
    return True


@helper
def projection_at(state: State, node: int) -> NDArray:
    """The map (3, 3) from a vector in mm to the index vector nearest to it along the axes on
    which a node may move.
    """
    is_frozen = state.complex.is_frozen
    return state.sides.projections[
        is_frozen[node, 0] + 2 * is_frozen[node, 1] + 4 * is_frozen[node, 2]
    ]


@helper
def _label_levels(state: State, node: int, m: int) -> tuple:
    """The level functions of the first and the m-th of the labels that meet at a node."""
    meeting, channel, levels = state.complex.meeting, state.sides.channel, state.sides.levels
    return levels[channel[meeting[node, 0]]], levels[channel[meeting[node, m]]]


@helper
def _add_slope(slope: NDArray, row: int, level: NDArray, at: tuple, sign: float) -> None:
    """Add the slope of a level at an index position, per voxel along each axis, to slope[row]."""
    i, j, k = at
    slope[row, 0] += (
        sign
        * 2.0
        * (level_at(level, i + ASIDE_VOXELS, j, k) - level_at(level, i - ASIDE_VOXELS, j, k))
    )
    slope[row, 1] += (
        sign
        * 2.0
        * (level_at(level, i, j + ASIDE_VOXELS, k) - level_at(level, i, j - ASIDE_VOXELS, k))
    )
    slope[row, 2] += (
        sign
        * 2.0
        * (level_at(level, i, j, k + ASIDE_VOXELS) - level_at(level, i, j, k - ASIDE_VOXELS))
    )


@unit
def constraint_values(normal: Floats2, state: State, node: int) -> int:
    """Write the values of a node's constraints to normal[6, :3]; return their number."""
    ticks, meeting, count = state.complex.ticks, state.complex.meeting, 0
    scale = 2.0**-state.objective.bits
    i, j, k = ticks[node, 0] * scale, ticks[node, 1] * scale, ticks[node, 2] * scale
    if state.complex.is_frozen[node, 3]:
        normal[6, 0] = level_at(state.sides.level, i, j, k)
        count = 1
    for m in range(1, MOST_MEETING):
        if meeting[node, m] >= 0 and count < 3:
            one, other = _label_levels(state, node, m)
            normal[6, count] = level_at(one, i, j, k) - level_at(other, i, j, k)
            count += 1
    normal[6, 0] -= state.complex.offset[node]
    return count


@unit
def normals_at(normal: Floats2, state: State, node: int) -> int:
    """Write slopes and shortest ways up of a node's constraints, in index units; return their
    number.

    Ways stay within the node's sides of the box. `normal` is (7, 3): slopes start in the first row,
    ways in the fourth.
    """
    P, ticks, scale, count = (
        projection_at(state, node),
        state.complex.ticks,
        2.0**-state.objective.bits,
        0,
    )
    at = ticks[node, 0] * scale, ticks[node, 1] * scale, ticks[node, 2] * scale
    normal[:6] = 0.0
    if state.complex.is_frozen[node, 3]:
        _add_slope(normal, 0, state.sides.level, at, 1.0)
        count = 1
    for m in range(1, MOST_MEETING):
        if state.complex.meeting[node, m] >= 0 and count < 3:
            one, other = _label_levels(state, node, m)
            _add_slope(normal, count, one, at, 1.0)
            _add_slope(normal, count, other, at, -1.0)
            count += 1
    for q in range(count):
        for d in range(3):
            for m in range(3):
                in_mm = 0.0
                for c in range(3):
                    in_mm += state.sides.inverse[c, m] * normal[q, c]
                normal[3 + q, d] += P[d, m] * in_mm
    return count


@unit
def combined_ways(
    normal: Floats2, count: int, r: tuple[float, float, float]
) -> tuple[bool, tuple[float, float, float]]:
    """The shortest index vector along which the constraints in `normal` (from `normals_at`) rise by
    r, (3,).

    The first result is True if there is one: not where a level is flat, or two levels rise the same
    way.
    """
    w = row(normal, 3)
    g00 = dot(row(normal, 0), w)
    if not g00 > FLAT_RISE:
        return False, w
    if count == 1:
        return True, scale_vector(r[0] / g00, w)
    v = row(normal, 4)
    g01, g11 = dot(row(normal, 0), v), dot(row(normal, 1), v)
    pair = g00 * g11 - g01 * g01
    if not (g11 > FLAT_RISE and pair > PARALLEL_FRACTION * g00 * g11):
        return False, w
    if count == 2:
        m0, m1 = (g11 * r[0] - g01 * r[1]) / pair, (g00 * r[1] - g01 * r[0]) / pair
        return True, (m0 * w[0] + m1 * v[0], m0 * w[1] + m1 * v[1], m0 * w[2] + m1 * v[2])
    u = row(normal, 5)
    g02, g12, g22 = dot(row(normal, 0), u), dot(row(normal, 1), u), dot(row(normal, 2), u)
    c0, c1 = g01 * g12 - g02 * g11, g01 * g02 - g00 * g12
    triple = g02 * c0 + g12 * c1 + g22 * pair
    if not (g22 > FLAT_RISE and triple > PARALLEL_FRACTION * pair * g22):
        return False, w
    # Cramer's rule, from the adjugate of the symmetric matrix of the g's.
    a00, a01, a11 = g11 * g22 - g12 * g12, g02 * g12 - g01 * g22, g00 * g22 - g02 * g02
    m0 = (a00 * r[0] + a01 * r[1] + c0 * r[2]) / triple
    m1 = (a01 * r[0] + a11 * r[1] + c1 * r[2]) / triple
    m2 = (c0 * r[0] + c1 * r[1] + pair * r[2]) / triple
    return True, (
        m0 * w[0] + m1 * v[0] + m2 * u[0],
        m0 * w[1] + m1 * v[1] + m2 * u[1],
        m0 * w[2] + m1 * v[2] + m2 * u[2],
    )


@helper
def band_of(state: State, node: int) -> float:
    """Allowed difference of two labels' levels at a node; 0 where a third label or a mask's
    surface meets them.
    """
    is_one = state.complex.meeting[node, 2] < 0 and not state.complex.is_frozen[node, 3]
    return LEVELS_RISE * state.complex.band[node] if is_one else 0.0


@helper
def is_on_surface(normal: NDArray, state: State, node: int) -> bool:
    """True if a node meets all of its constraints."""
    count = constraint_values(normal, state, node)
    far, band = 0.0, band_of(state, node)
    for q in range(count):
        far = max(far, abs(normal[6, q]) - band)
    return far < (ON_SURFACE_VOXELS if count == 1 else NEAR_CURVE_VOXELS)


@unit
def slides(normal: Floats2, state: State, node: int) -> bool:
    """True if a node is on its surfaces and stays there; a node between labels may not have
    reached them yet.
    """
    if state.complex.is_frozen[node, 3]:
        return True
    return state.complex.meeting[node, 1] >= 0 and is_on_surface(normal, state, node)


@unit
def put_on_surface(normal: Floats2, state: State, node: int) -> bool:
    """Move a node to meet its constraints, nearly the shortest way in its sides of the box; return
    False on failure.

    A place beyond the box first moves back to its side, as the level continues unchanged beyond the
    side and would have its zero there, too.
    """
    ticks, scale = state.complex.ticks, 2.0**-state.objective.bits
    _put_in_box(state, node)
    for step in range(CURVE_STEPS + 1):
        if is_on_surface(normal, state, node):
            return True
        if step == CURVE_STEPS or (step == NEWTON_STEPS and state.complex.meeting[node, 2] < 0):
            return False
        value, band = row(normal, 6), band_of(state, node)
        if band > 0.0:  # to the nearer end of the band
            value = (value[0] - np.copysign(band, value[0]), 0.0, 0.0)
        count = normals_at(normal, state, node)
        is_found, way = combined_ways(normal, count, value)
        if not is_found:
            return False
        size = np.sqrt(dot(way, way))
        if count > 1 and size > CURVE_STEP_VOXELS:
            way = scale_vector(CURVE_STEP_VOXELS / size, way)
        for d in range(3):
            ticks[node, d] -= np.int64(np.rint(way[d] / scale))
        _put_in_box(state, node)
    return False


@helper
def _put_in_box(state: State, node: int) -> None:
    """Move a node that is beyond a side of the box back to that side."""
    ticks, sides = state.complex.ticks, state.sides
    for d in range(3):
        ticks[node, d] = min(max(ticks[node, d], sides.low[d]), sides.high[d])


# A flat facet with its corners on a round surface cuts off what lies beyond it: nodes off the
# surface make up for it.


def _facet_places(n: int) -> tuple[Floats, Floats]:
    """Barycentric places (S, n) on a facet of n corners; weights (S, 2) of a mean over the facet
    and at its corners.

    Exact for quadratic functions: Simpson's rule on an edge, the middles of edges of a triangle's
    four parts.
    """
    corners = np.eye(n)
    if n == 2:
        return np.vstack([[0.5, 0.5], corners]), np.array(
            [[4.0, 0.0], [1.0, 3.0], [1.0, 3.0]]
        ) / 6.0
    middles = 0.5 * (corners + np.roll(corners, 1, axis=0))
    parts = [middles, *(0.5 * (corners + corner) for corner in corners)]
    places = np.vstack([*(middles @ part for part in parts), corners])
    return places, np.repeat([[1.0 / 12.0, 0.0], [0.0, 1.0 / 3.0]], [12, 3], axis=0)


def fill_offsets(state: State, most: Floats) -> None:
    """Set the values of nodes' first constraints at which facets cut off as much of a round surface
    as they add.

    The mean of a level over a facet minus that at its corners is what the facet cuts off: h^2 / 8R
    on a sphere of radius R, for an equilateral facet with edge h. A node's offset is minus the mean
    over the facets around it, of the mask's surface or between two labels, up to `most` (N,), in
    voxels; 0 where more labels meet. Nodes that lie within a band, and not in its middle, move the
    band until the level's mean over their facets is 0.
    """
    room = np.zeros((3, len(most)))
    _fill_offsets(state, most, room, *_facet_places(state.complex.cells.shape[1] - 1))


@entry
def _fill_offsets(
    state: State, most: Floats1, room: Floats2, places: Floats2, weights: Floats2
) -> None:
    mesh, n = state.complex, state.complex.cells.shape[1]
    area, mean, at_corners, corners = room[0], room[1], room[2], np.empty(3, dtype=np.int64)
    for cell in range(mesh.n_cells[0]):
        for k in range(n):
            other = mesh.across[cell, k]
            is_between = other > cell and mesh.labels[other] != mesh.labels[cell]
            corners[0], corners[1], corners[2] = outward(mesh.cells, cell, k)
            if not (is_between or (other < 0 and _is_on_mask(state, corners[: n - 1]))):
                continue
            whole, ends = _facet_means(state, cell, other, corners[: n - 1], places, weights)
            size = facet_area(mesh.ticks, corners[0], corners[1], corners[2], state.objective)
            for node in corners[: n - 1]:
                if mesh.is_frozen[node, 3] == (other < 0) and (
                    other < 0 or mesh.meeting[node, 2] < 0
                ):
                    area[node] += size
                    mean[node] += size * whole
                    at_corners[node] += size * ends
    for node in range(len(most)):
        if not area[node] > 0.0:
            mesh.offset[node] = 0.0
            continue
        limit = most[node] if mesh.is_frozen[node, 3] else LEVELS_RISE * most[node]
        middle = min(max((at_corners[node] - mean[node]) / area[node], -limit), limit)
        moved, band = mesh.offset[node] - mean[node] / area[node], band_of(state, node)
        mesh.offset[node] = min(max(moved, middle - band), middle + band)


@helper
def _is_on_mask(state: State, corners: NDArray) -> bool:
    """True if a facet's corners lie on the mask's surface, and the facet on no side of the box."""
    is_on = state.sides.has_surface
    for node in corners:
        is_on = is_on and state.complex.is_frozen[node, 3]
    for d in range(3):
        at, is_flat = state.complex.ticks[corners[0], d], len(corners) == 3 or d > 0
        for node in corners:
            is_flat = is_flat and state.complex.ticks[node, d] == at
        is_on = is_on and not (is_flat and (at == state.sides.low[d] or at == state.sides.high[d]))
    return is_on


@helper
def _facet_means(
    state: State, cell: int, other: int, corners: NDArray, places: NDArray, weights: NDArray
) -> tuple:
    """The mean of a facet's constraint over the facet, and its mean at the corners."""
    ticks, scale, whole, ends = state.complex.ticks, 2.0**-state.objective.bits, 0.0, 0.0
    one = beyond = state.sides.level
    if other >= 0:
        of_cell, of_other = state.complex.labels[cell], state.complex.labels[other]
        channel, levels = state.sides.channel, state.sides.levels
        one, beyond = (
            levels[channel[min(of_cell, of_other)]],
            levels[channel[max(of_cell, of_other)]],
        )
    for s in range(len(weights)):
        i, j, k = 0.0, 0.0, 0.0
        for m in range(len(corners)):
            i += places[s, m] * scale * ticks[corners[m], 0]
            j += places[s, m] * scale * ticks[corners[m], 1]
            k += places[s, m] * scale * ticks[corners[m], 2]
        value = level_at(one, i, j, k)
        if other >= 0:
            value -= level_at(beyond, i, j, k)
        whole += weights[s, 0] * value
        ends += weights[s, 1] * value
    return whole, ends
