"""Nodes that slide on the surface of a mask: the zero level of the function of `tetopt.target.domain`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tetopt.engine.complex import NodeRings, State, has_node, outward, place
from tetopt.geometry.vectors import cross, dot, row
from tetopt.target.domain import ON_SURFACE_VOXELS

NEWTON_STEPS = 6  # onto the surface, at most
OUTWARD_COSINE = 0.1  # cosine of the widest angle between a facet's normal and the way up the level at its moved node
ASIDE_VOXELS = 0.25  # on either side of a place: where the level is taken for its slope
FLAT_RISE = 1e-12  # where the level rises less along the way up, steps would be divided by nothing


@njit(cache=True, error_model="numpy")
def level_at(level: NDArray, i: float, j: float, k: float) -> float:
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


@njit(cache=True, error_model="numpy")
def _slope_at(slope: NDArray, row: int, state: State, node: int) -> None:
    """Slope of the level at a node, per voxel along each axis, to slope[row]."""
    ticks, scale, L = state.complex.ticks, 2.0**-state.objective.bits, state.sides.level
    i, j, k = ticks[node, 0] * scale, ticks[node, 1] * scale, ticks[node, 2] * scale
    slope[row, 0] = 2.0 * (level_at(L, i + ASIDE_VOXELS, j, k) - level_at(L, i - ASIDE_VOXELS, j, k))
    slope[row, 1] = 2.0 * (level_at(L, i, j + ASIDE_VOXELS, k) - level_at(L, i, j - ASIDE_VOXELS, k))
    slope[row, 2] = 2.0 * (level_at(L, i, j, k + ASIDE_VOXELS) - level_at(L, i, j, k - ASIDE_VOXELS))


@njit(cache=True, error_model="numpy")
def uphill_at(uphill: NDArray, state: State, node: int) -> None:
    """The way up the level at a node, in mm, to uphill[0]; uphill (2, 3)."""
    _slope_at(uphill, 1, state, node)
    for m in range(3):
        uphill[0, m] = 0.0
        for c in range(3):
            uphill[0, m] += state.sides.inverse[c, m] * uphill[1, c]


@njit(cache=True, error_model="numpy")
def faces_up(state: State, cell: int, k: int, old: int, new: int, uphill: NDArray) -> bool:
    """Whether a facet of the boundary, with the node `new` for `old`, faces up the level, or lies on a side of the box.

    A node that slid, or was put, across a gap onto another part of the surface would turn it over.
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


@njit(cache=True, error_model="numpy")
def ring_faces_up(uphill: NDArray, state: State, rings: NodeRings, node: int, joined: int) -> bool:
    """`faces_up` for all facets of the boundary around a node where it is, of cells that do not have `joined`."""
    cells = state.complex.cells
    uphill_at(uphill, state, node)
    for r in range(rings.start[node], rings.start[node + 1]):
        cell = rings.cells[r]
        if joined >= 0 and has_node(cells, cell, joined):
            continue
        for k in range(cells.shape[1]):
            is_outer = state.complex.across[cell, k] < 0 and k != rings.corner[r]
            if is_outer and not faces_up(state, cell, k, node, node, uphill):
                return False
    return True


@njit(cache=True, error_model="numpy")
def projection_at(state: State, node: int) -> NDArray:
    """The map (3, 3) from a vector in mm to the index vector nearest to it along the axes on which a node may move."""
    is_frozen = state.complex.is_frozen
    return state.sides.projections[is_frozen[node, 0] + 2 * is_frozen[node, 1] + 4 * is_frozen[node, 2]]


@njit(cache=True, error_model="numpy")
def normal_at(normal: NDArray, state: State, node: int) -> float:
    """The shortest way up the level from a node within its sides of the box, to `normal` (2, 3) in index units.

    Its first row is the slope of the level, its second the way; returned is the rise along it.
    """
    P = projection_at(state, node)
    _slope_at(normal, 0, state, node)
    rise = 0.0
    for d in range(3):
        normal[1, d] = 0.0
        for m in range(3):
            in_mm = 0.0
            for c in range(3):
                in_mm += state.sides.inverse[c, m] * normal[0, c]
            normal[1, d] += P[d, m] * in_mm
    for d in range(3):
        rise += normal[0, d] * normal[1, d]
    return rise


@njit(cache=True, error_model="numpy")
def put_on_surface(normal: NDArray, state: State, node: int) -> bool:
    """Move a node onto the surface, nearly the shortest way in its sides of the box; False if it is not reached."""
    ticks, sides, scale = state.complex.ticks, state.sides, 2.0**-state.objective.bits
    for step in range(NEWTON_STEPS + 1):
        value = level_at(sides.level, ticks[node, 0] * scale, ticks[node, 1] * scale, ticks[node, 2] * scale)
        if abs(value) < ON_SURFACE_VOXELS:
            return True
        rise = normal_at(normal, state, node)
        if step == NEWTON_STEPS or not rise > FLAT_RISE:
            return False
        for d in range(3):
            to = ticks[node, d] - np.int64(np.rint(value / rise * normal[1, d] / scale))
            ticks[node, d] = min(max(to, sides.low[d]), sides.high[d])
    return False
