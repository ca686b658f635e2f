"""Nodes that slide on the surface of a mask: the zero level of the function of `tetopt.target.domain`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tetopt.energy.sampling import SamplingGrid
from tetopt.engine.complex import Complex, Measure, NodeRings, has_node, load, outward
from tetopt.engine.descent import free_projections

STEPS = 6  # Newton steps onto the surface
NEAR = 1e-3  # voxel: as near as this is on the surface
OUTWARDS = 0.1  # cosine of the widest angle between a facet's normal and the way up the level at its moved node
ASIDE = 0.25  # voxel, on either side of a place: where the level is asked for its slope


class Sides(NamedTuple):
    """Where nodes may be put on the boundary: the box's sides, the mask's surface."""

    low: NDArray[np.int64]  # (3,) ticks of the box's sides
    high: NDArray[np.int64]
    is_fixed: bool  # whether boundary nodes stay where they are
    has_surface: bool  # whether what is not on the box's sides is on the mask's surface
    level: NDArray[np.float32]  # (s_0, s_1, s_2) its level function; (1, 1, 1) without
    projections: NDArray[np.float64]  # see `tetopt.engine.descent.free_projections`
    inverse: NDArray[np.float64]  # (3, 3) mm to index vectors


def sides_of(
    grid: SamplingGrid, matrix: NDArray[np.float64], is_fixed: bool, level: NDArray[np.float32] | None = None
) -> Sides:
    """Sides of the box of an image, `matrix` (3, 3) taking index vectors to mm, and the surface of a level function."""
    shape = np.array(grid.shape)
    low, high = (np.rint(at * 2.0**grid.bits).astype(np.int64) for at in (np.full(3, -0.5), shape - 0.5))
    has_surface = level is not None
    level = np.zeros((1, 1, 1), dtype=np.float32) if level is None else level.reshape(grid.shape)
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return Sides(low, high, is_fixed, has_surface, level, free_projections(matrix), inverse)


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
def _slope_at(slope: NDArray, row: int, ticks: NDArray, node: int, sides: Sides, measure: Measure) -> None:
    """Slope of the level at a node, per voxel along each axis, to slope[row]."""
    scale, L = 2.0**-measure.bits, sides.level
    i, j, k = ticks[node, 0] * scale, ticks[node, 1] * scale, ticks[node, 2] * scale
    slope[row, 0] = 2.0 * (level_at(L, i + ASIDE, j, k) - level_at(L, i - ASIDE, j, k))
    slope[row, 1] = 2.0 * (level_at(L, i, j + ASIDE, k) - level_at(L, i, j - ASIDE, k))
    slope[row, 2] = 2.0 * (level_at(L, i, j, k + ASIDE) - level_at(L, i, j, k - ASIDE))


@njit(cache=True, error_model="numpy")
def uphill_at(uphill: NDArray, ticks: NDArray, node: int, sides: Sides, measure: Measure) -> None:
    """The way up the level at a node, in mm, to uphill[0]; uphill (2, 3)."""
    _slope_at(uphill, 1, ticks, node, sides, measure)
    for m in range(3):
        uphill[0, m] = 0.0
        for c in range(3):
            uphill[0, m] += sides.inverse[c, m] * uphill[1, c]


@njit(cache=True, error_model="numpy")
def faces_up(
    x: NDArray, held: Complex, cell: int, k: int, old: int, new: int, uphill: NDArray, sides: Sides, measure: Measure
) -> bool:
    """Whether a facet of the boundary, with the node `new` for `old`, faces up the level, or lies on a side of the box.

    A node that slid, or was put, across a gap onto another part of the surface would turn it over.
    """
    t = held.ticks
    a, b, c = outward(held.cells, cell, k)
    a, b, c = new if a == old else a, new if b == old else b, new if c == old and c >= 0 else c
    for d in range(3):
        at = t[a, d]
        is_flat = t[b, d] == at and (c < 0 or t[c, d] == at)
        if is_flat and (at == sides.low[d] or at == sides.high[d]):
            return True
    load(x, 0, t, b, a, measure)
    if c < 0:
        n0, n1, n2 = 0.0, x[0, 2], -x[0, 1]
    else:
        load(x, 1, t, c, a, measure)
        n0 = x[0, 1] * x[1, 2] - x[0, 2] * x[1, 1]
        n1 = x[0, 2] * x[1, 0] - x[0, 0] * x[1, 2]
        n2 = x[0, 0] * x[1, 1] - x[0, 1] * x[1, 0]
    u = uphill[0]
    size = np.sqrt((n0 * n0 + n1 * n1 + n2 * n2) * (u[0] * u[0] + u[1] * u[1] + u[2] * u[2]))
    return n0 * u[0] + n1 * u[1] + n2 * u[2] > OUTWARDS * size


@njit(cache=True, error_model="numpy")
def ring_faces_up(
    x: NDArray, uphill: NDArray, held: Complex, rings: NodeRings, node: int, joined: int, sides: Sides, measure: Measure
) -> bool:
    """`faces_up` for all facets of the boundary around a node where it is, of cells that do not have `joined`."""
    uphill_at(uphill, held.ticks, node, sides, measure)
    for r in range(rings.start[node], rings.start[node + 1]):
        cell = rings.cells[r]
        if joined >= 0 and has_node(held.cells, cell, joined):
            continue
        for k in range(held.cells.shape[1]):
            is_outer = held.across[cell, k] < 0 and k != rings.corner[r]
            if is_outer and not faces_up(x, held, cell, k, node, node, uphill, sides, measure):
                return False
    return True


@njit(cache=True, error_model="numpy")
def normal_at(normal: NDArray, ticks: NDArray, node: int, is_frozen: NDArray, sides: Sides, measure: Measure) -> float:
    """The shortest way up the level from a node within its sides of the box, to `normal` (2, 3) in index units.

    Its first row is the slope of the level, its second the way; returned is the rise along it.
    """
    P = sides.projections[is_frozen[node, 0] + 2 * is_frozen[node, 1] + 4 * is_frozen[node, 2]]
    _slope_at(normal, 0, ticks, node, sides, measure)
    rise = 0.0
    for d in range(3):
        normal[1, d] = 0.0
        for m in range(3):
            in_mm = 0.0
            for c in range(3):
                in_mm += sides.inverse[c, m] * normal[0, c]
            normal[1, d] += P[d, m] * in_mm
    for d in range(3):
        rise += normal[0, d] * normal[1, d]
    return rise


@njit(cache=True, error_model="numpy")
def put_on_surface(
    normal: NDArray, ticks: NDArray, node: int, is_frozen: NDArray, sides: Sides, measure: Measure
) -> bool:
    """Move a node onto the surface, nearly the shortest way in its sides of the box; False if it is not reached."""
    scale = 2.0**-measure.bits
    for step in range(STEPS + 1):
        value = level_at(sides.level, ticks[node, 0] * scale, ticks[node, 1] * scale, ticks[node, 2] * scale)
        if abs(value) < NEAR:
            return True
        rise = normal_at(normal, ticks, node, is_frozen, sides, measure)
        if step == STEPS or not rise > 1e-12:
            return False
        for d in range(3):
            to = ticks[node, d] - np.int64(np.rint(value / rise * normal[1, d] / scale))
            ticks[node, d] = min(max(to, sides.low[d]), sides.high[d])
    return False
