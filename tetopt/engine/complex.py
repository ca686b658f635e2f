"""One cell complex in plain arrays, kept whole while nodes move and cells are exchanged.

A cell's facet k lies opposite its corner k. For each facet the complex holds the cell across it and the facet's flux
(see `tetopt.energy.sampling`), turned outwards and multiplied by the sign of index space, so that a cell's moment
sums are the plain sum over its facets and the two sides of a facet hold opposite numbers. Local operations then only
measure the facets that are new.

The D sums of a cell are the number of its voxels, the sum of the first channel's values, that of the squares of all
channels, the sums of the other channels' values and, if the mesh covers a mask only, the voxels outside of the mask
less those inside.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from tetopt.energy.sampling import SamplingGrid, few_threads, segment_flux, triangle_flux

CHUNK = 64
FLAT = 1e-7  # a cell's volume over (sum of squared edges)^(n/2); below, it counts as inverted: an angle of 1e-3 degrees


class Complex(NamedTuple):
    """Nodes, cells, who touches whom, and what each cell holds. Rows from `n_cells` on are room for more cells."""

    ticks: NDArray[np.int64]  # (N, 3) node positions on the sampling grid
    cells: NDArray[np.int64]  # (C, n+1) corners, positively oriented in the world
    across: NDArray[np.int64]  # (C, n+1) the cell beyond each facet; -1 outside
    fluxes: NDArray[np.float64]  # (C, n+1, D) of each facet, outwards
    sums: NDArray[np.float64]  # (C, D) moment sums: their sum over the facets
    E_shape: NDArray[np.float64]  # (C,) shape energy, see `shape_energy`
    n_cells: NDArray[np.int64]  # (1,) rows in use


class Measure(NamedTuple):
    """What turns a cell into an energy."""

    prefix: NDArray  # of the sampling grid
    bits: int
    hand: int  # sign of the cells' volumes in index space
    matrix: NDArray[np.float64]  # (3, 3) index vectors to mm
    geometry: float  # weight of the shape energy: (1 - k_D) / E_G0
    image: float  # weight of a cell's sum of squares: k_D x voxel volume / E_D0
    surface: float  # weight of a voxel on the wrong side of the mask's surface; 0 without a mask
    n_channels: int
    power: float  # p of the shape energy
    is_graded: bool  # whether every cell's shape counts the same, whatever its size
    is_kept: bool  # whether the boundary's facets stay as they are
    floor: float  # minus the cosine of the smallest dihedral angle that a move may leave; -1 for none
    safe: float  # a tetrahedron whose S^3 is up to this times its squared determinant is above the floor


def build(cells: NDArray[np.int64], ticks: NDArray[np.int64], measure: Measure) -> Complex:
    """The complex of a conforming mesh, everything measured.

    `ticks` is kept, not copied. The cells must be a mesh: at most two to a facet, see `tetopt.geometry.check`.
    """
    n_cells, n_corners = cells.shape
    room = n_cells + n_cells // 4 + 64
    held = Complex(
        ticks,
        np.full((room, n_corners), -1, dtype=np.int64),
        np.full((room, n_corners), -1, dtype=np.int64),
        np.zeros((room, n_corners, measure.prefix.shape[3] + 1)),
        np.zeros((room, measure.prefix.shape[3] + 1)),
        np.zeros(room),
        np.array([n_cells]),
    )
    held.cells[:n_cells] = cells
    fill_across(held.across, held.cells, n_cells, len(ticks))
    with few_threads(n_cells * 4):
        measure_all(held, measure)
    return held


def copied(held: Complex) -> Complex:
    """The complex in arrays of its own."""
    return Complex(
        held.ticks.copy(), held.cells.copy(), held.across.copy(), held.fluxes.copy(), held.sums.copy(),
        held.E_shape.copy(), held.n_cells.copy(),
    )  # fmt: skip


def grown(held: Complex, least: int = 64) -> Complex:
    """The complex with room for a quarter more cells, and for `least`."""
    more = held.n_cells[0] // 4 + least

    def wider(array: NDArray) -> NDArray:
        return np.concatenate([array, np.full((more, *array.shape[1:]), -1, dtype=array.dtype)])

    return Complex(
        held.ticks, wider(held.cells), wider(held.across), wider(held.fluxes), wider(held.sums), wider(held.E_shape),
        held.n_cells,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def fill_across(across: NDArray, cells: NDArray, n_cells: int, n_nodes: int) -> None:
    """The cell beyond each facet, by counting sort over the facets' lowest nodes."""
    n = cells.shape[1]
    start = np.zeros(n_nodes + 1, dtype=np.int64)
    for c in range(n_cells):
        for k in range(n):
            lowest = n_nodes
            for m in range(n):
                if m != k:
                    lowest = min(lowest, cells[c, m])
            start[lowest + 1] += 1
    for i in range(n_nodes):
        start[i + 1] += start[i]
    fill = start.copy()
    items = np.empty(start[n_nodes], dtype=np.int64)
    for c in range(n_cells):
        for k in range(n):
            lowest = n_nodes
            for m in range(n):
                if m != k:
                    lowest = min(lowest, cells[c, m])
            items[fill[lowest]] = c * n + k
            fill[lowest] += 1
    for i in range(n_nodes):
        for p in range(start[i], start[i + 1]):
            c, k = items[p] // n, items[p] % n
            if across[c, k] >= 0:
                continue
            for q in range(p + 1, start[i + 1]):
                d, m = items[q] // n, items[q] % n
                same = d != c
                for s in range(n):
                    if s != k and same:
                        found = False
                        for t in range(n):
                            if t != m and cells[d, t] == cells[c, s]:
                                found = True
                        same = found
                if same:
                    across[c, k] = d
                    across[d, m] = c
                    break


@njit(cache=True, error_model="numpy")
def facet_of(cells: NDArray, across: NDArray, cell: int, other: int) -> int:
    """The facet of `cell` beyond which `other` lies."""
    k = 0
    while across[cell, k] != other:
        k += 1
    return k


@njit(cache=True, error_model="numpy")
def corner_of(cells: NDArray, cell: int, node: int) -> int:
    """Which corner of `cell` is `node`."""
    k = 0
    while cells[cell, k] != node:
        k += 1
    return k


@njit(cache=True, error_model="numpy")
def has_node(cells: NDArray, cell: int, node: int) -> bool:
    """Whether `node` is a corner of `cell`."""
    found = False
    for k in range(cells.shape[1]):
        found = found or cells[cell, k] == node
    return found


@njit(cache=True, error_model="numpy")
def put_flux(out: NDArray, p: int, q: int, ticks: NDArray, a: int, b: int, c: int, measure: Measure) -> None:
    """Flux of the facet (a, b, c), or (a, b) with c < 0, times the sign of index space, to out[p, q, :]."""
    if c < 0:
        segment_flux(
            ticks[a, 1], ticks[a, 2], ticks[b, 1], ticks[b, 2], measure.bits, measure.prefix, None, 0, out, p, q
        )
    else:
        triangle_flux(
            ticks[a, 0], ticks[a, 1], ticks[a, 2], ticks[b, 0], ticks[b, 1], ticks[b, 2],
            ticks[c, 0], ticks[c, 1], ticks[c, 2], measure.bits, measure.prefix, None, 0, out, p, q,
        )  # fmt: skip
    if measure.hand < 0:
        for d in range(out.shape[2]):
            out[p, q, d] = -out[p, q, d]


@njit(cache=True, error_model="numpy")
def outward(cells: NDArray, cell: int, k: int) -> tuple:
    """Nodes of facet k of a cell, turned outwards; the third is -1 in 2-D."""
    if cells.shape[1] == 3:
        return cells[cell, (k + 1) % 3], cells[cell, (k + 2) % 3], -1
    if k == 0:
        return cells[cell, 1], cells[cell, 2], cells[cell, 3]
    if k == 1:
        return cells[cell, 0], cells[cell, 3], cells[cell, 2]
    if k == 2:
        return cells[cell, 0], cells[cell, 1], cells[cell, 3]
    return cells[cell, 0], cells[cell, 2], cells[cell, 1]


@njit(cache=True, error_model="numpy")
def image_energy(sums: NDArray, row: int, n_channels: int) -> float:
    """Sum of squares around the mean of one cell, over all channels, from its moment sums, a row of `sums`."""
    count = sums[row, 0]
    if count <= 0.0:
        return 0.0
    within = sums[row, 2] - sums[row, 1] * sums[row, 1] / count
    for d in range(3, 2 + n_channels):
        within -= sums[row, d] * sums[row, d] / count
    return max(within, 0.0)


@njit(cache=True, error_model="numpy")
def wrong_side(sums: NDArray, row: int, measure: Measure) -> float:
    """Weighted voxels outside of the mask less those inside, in one cell: what changes is the mask's misfit."""
    return measure.surface * sums[row, sums.shape[1] - 1] if measure.surface > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def shape_energy(x: NDArray, n_corners: int, power: float, is_graded: bool) -> float:
    """E_G of the cell with corners x (4, 3) times eta^(p - 1); infinite for one that is flat or inverted.

    eta = S / (12 (3 v)^(2/3)) in 3-D, S / (4 sqrt(3) v) in 2-D, S the sum of the squared edges and v the volume: 1 on
    the regular cell, infinite on a flat one. E_G,j is proportional to v^(5/3) eta, so it vanishes on a sliver; with
    p = 1 the energy is the paper's, and for p > 2.5 it grows without bound as a cell goes flat.

    On a graded mesh v^(5/3) would leave the shape to the largest cells: one of twice the edge weighs 32 times as much.
    Section 4 of the paper asks for a weight by the local mesh size there. With E_G,j over h^5, h^3 proportional to the
    cell's own volume, all sizes cancel, and what is left is eta^p: the same for every cell of that shape, so that the
    shape term has no wish for any size and E_D alone says where cells are small.

    Corners come from `load`, which subtracts in integers: rounding of the signed volume is far below `FLAT`, so a cell
    that passes is positively oriented exactly.
    """
    if n_corners == 3:
        u1, u2 = x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
        v1, v2 = x[2, 1] - x[0, 1], x[2, 2] - x[0, 2]
        volume = 0.5 * (u1 * v2 - u2 * v1)
        S = u1 * u1 + u2 * u2 + v1 * v1 + v2 * v2 + (u1 - v1) * (u1 - v1) + (u2 - v2) * (u2 - v2)
        if volume <= FLAT * S:
            return np.inf
        eta = S / (6.928203230275509 * volume)
        if is_graded:
            return eta**power
        E_G = volume * S / 12.0
        return E_G if power == 1.0 else E_G * eta ** (power - 1.0)
    determinant, S = determinant_and_squares(x)
    return tet_energy(determinant, S, power, is_graded)


@njit(cache=True, error_model="numpy")
def determinant_and_squares(x: NDArray) -> tuple:
    """Six times the signed volume of the tetrahedron x (4, 3), and the sum of its squared edges."""
    u0, u1, u2 = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
    v0, v1, v2 = x[2, 0] - x[0, 0], x[2, 1] - x[0, 1], x[2, 2] - x[0, 2]
    w0, w1, w2 = x[3, 0] - x[0, 0], x[3, 1] - x[0, 1], x[3, 2] - x[0, 2]
    determinant = u0 * (v1 * w2 - v2 * w1) + u1 * (v2 * w0 - v0 * w2) + u2 * (v0 * w1 - v1 * w0)
    # The sum over all pairs of four points is four times the sum over the points less that of their sum, squared.
    s0, s1, s2 = u0 + v0 + w0, u1 + v1 + w1, u2 + v2 + w2
    S = 4.0 * (u0 * u0 + u1 * u1 + u2 * u2 + v0 * v0 + v1 * v1 + v2 * v2 + w0 * w0 + w1 * w1 + w2 * w2)
    return determinant, S - (s0 * s0 + s1 * s1 + s2 * s2)


@njit(cache=True, error_model="numpy")
def tet_energy(determinant: float, S: float, power: float, is_graded: bool) -> float:
    """`shape_energy` of a tetrahedron from six times its volume and the sum of its squared edges."""
    volume = determinant / 6.0
    if volume <= 0.0 or volume * volume <= FLAT * FLAT * S * S * S:
        return np.inf
    if is_graded:
        cube = S * S * S / (432.0 * determinant * determinant)  # eta^3
        return cube if power == 3.0 else cube ** (power / 3.0)
    E_G = volume * S / 20.0
    if power == 1.0:
        return E_G
    if power == 3.0:  # the default, without the cubic root of a square: eta^2 = S^2 / (144 (3 v)^(4/3))
        t = 1.0 / np.cbrt(3.0 * volume)
        t *= t
        return E_G * S * S * t * t * (1.0 / 144.0)
    return E_G * (S / (12.0 * np.cbrt(9.0 * volume * volume))) ** (power - 1.0)


@njit(cache=True, error_model="numpy")
def load(x: NDArray, row: int, ticks: NDArray, node: int, base: int, measure: Measure) -> None:
    """A node's position relative to the node `base`, in mm, to a row of x; subtracted in integers, exactly."""
    scale = 2.0**-measure.bits
    M = measure.matrix
    t0 = scale * (ticks[node, 0] - ticks[base, 0])
    t1 = scale * (ticks[node, 1] - ticks[base, 1])
    t2 = scale * (ticks[node, 2] - ticks[base, 2])
    x[row, 0] = M[0, 0] * t0 + M[0, 1] * t1 + M[0, 2] * t2
    x[row, 1] = M[1, 0] * t0 + M[1, 1] * t1 + M[1, 2] * t2
    x[row, 2] = M[2, 0] * t0 + M[2, 1] * t1 + M[2, 2] * t2


@njit(cache=True, error_model="numpy")
def load_cell(x: NDArray, ticks: NDArray, cells: NDArray, cell: int, measure: Measure) -> None:
    """A cell's corners relative to its first, in mm."""
    for k in range(cells.shape[1]):
        load(x, k, ticks, cells[cell, k], cells[cell, 0], measure)


@njit(cache=True, error_model="numpy")
def shape_of_cell(x: NDArray, ticks: NDArray, cells: NDArray, cell: int, measure: Measure) -> float:
    """Shape energy of a cell of the complex; its corners are left in `x` (4, 3)."""
    load_cell(x, ticks, cells, cell, measure)
    return shape_energy(x, cells.shape[1], measure.power, measure.is_graded)


@njit(cache=True, error_model="numpy")
def shape_of_tet(x: NDArray, ticks: NDArray, a: int, b: int, c: int, d: int, measure: Measure) -> float:
    """Shape energy of the tetrahedron (a, b, c, d); infinite unless it is positively oriented."""
    load(x, 0, ticks, a, a, measure)
    load(x, 1, ticks, b, a, measure)
    load(x, 2, ticks, c, a, measure)
    load(x, 3, ticks, d, a, measure)
    return shape_energy(x, 4, measure.power, measure.is_graded)


@njit(cache=True, error_model="numpy")
def shape_of_triangle(x: NDArray, ticks: NDArray, a: int, b: int, c: int, measure: Measure) -> float:
    """Shape energy of the triangle (a, b, c); infinite unless it is positively oriented."""
    load(x, 0, ticks, a, a, measure)
    load(x, 1, ticks, b, a, measure)
    load(x, 2, ticks, c, a, measure)
    return shape_energy(x, 3, measure.power, measure.is_graded)


@njit(cache=True, error_model="numpy")
def content(x: NDArray, n_corners: int) -> float:
    """Signed volume of the cell with corners x (4, 3), times n!."""
    if n_corners == 3:
        return (x[1, 1] - x[0, 1]) * (x[2, 2] - x[0, 2]) - (x[1, 2] - x[0, 2]) * (x[2, 1] - x[0, 1])
    return determinant_and_squares(x)[0]


@njit(cache=True, error_model="numpy")
def least_cosine(x: NDArray) -> float:
    """Minus the cosine of the smallest dihedral angle of the tetrahedron x (4, 3): it grows with the angle; -1 if flat.

    Between faces with outward normals p and q the angle's cosine is -p.q / (|p| |q|).
    """
    n = np.empty((4, 3))
    for k in range(4):
        a, b, c = (k + 1) & 3, (k + 2) & 3, (k + 3) & 3
        u0, u1, u2 = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
        w0, w1, w2 = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
        n0, n1, n2 = u1 * w2 - u2 * w1, u2 * w0 - u0 * w2, u0 * w1 - u1 * w0
        size = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        if size == 0.0:
            return -1.0
        sign = -1.0 if k & 1 else 1.0  # (k+1, k+2, k+3) turns outwards for even k of a positive cell, inwards for odd
        n[k, 0], n[k, 1], n[k, 2] = sign * n0 / size, sign * n1 / size, sign * n2 / size
    worst = 1.0
    for i in range(3):
        for k in range(i + 1, 4):
            worst = min(worst, n[i, 0] * n[k, 0] + n[i, 1] * n[k, 1] + n[i, 2] * n[k, 2])
    return worst


@njit(cache=True, error_model="numpy")
def quality_up_to(x: NDArray, measure: Measure) -> float:
    """`least_cosine`, or just the floor for a tetrahedron that is above it by far: most are, and this costs a tenth."""
    determinant, S = determinant_and_squares(x)
    if determinant > 0.0 and S * S * S <= measure.safe * determinant * determinant:
        return measure.floor
    return least_cosine(x)


@njit(cache=True, error_model="numpy")
def cell_quality(x: NDArray, held: Complex, cell: int, measure: Measure) -> float:
    """Minus the cosine of a cell's smallest dihedral angle."""
    load_cell(x, held.ticks, held.cells, cell, measure)
    return least_cosine(x)


@njit(cache=True, error_model="numpy")
def tet_quality(x: NDArray, held: Complex, a: int, b: int, c: int, d: int, measure: Measure) -> float:
    """As `least_cosine`, of the tetrahedron (a, b, c, d); -2 if it is flat or inverted."""
    if not shape_of_tet(x, held.ticks, a, b, c, d, measure) < np.inf:
        return -2.0
    return least_cosine(x)


# numba (0.60 to 0.68) drops what the body of a prange writes through a NamedTuple: such bodies are functions.
@njit(cache=True, parallel=True, error_model="numpy")
def measure_all(held: Complex, measure: Measure) -> None:
    """Fluxes, sums and shape energies of all cells, afresh. Each facet is measured once, by its lower cell."""
    n_cells = held.n_cells[0]
    for chunk in prange((n_cells + CHUNK - 1) // CHUNK):
        _measure_chunk(held, measure, chunk * CHUNK, min((chunk + 1) * CHUNK, n_cells))
    for chunk in prange((n_cells + CHUNK - 1) // CHUNK):
        _sum_chunk(held, chunk * CHUNK, min((chunk + 1) * CHUNK, n_cells))


@njit(cache=True, error_model="numpy")
def _measure_chunk(held: Complex, measure: Measure, first: int, last: int) -> None:
    x = np.empty((4, 3))
    for cell in range(first, last):
        held.E_shape[cell] = shape_of_cell(x, held.ticks, held.cells, cell, measure)
        for k in range(held.cells.shape[1]):
            other = held.across[cell, k]
            if other > cell or other < 0:
                measure_facet(held, cell, k, measure)


@njit(cache=True, error_model="numpy")
def measure_facet(held: Complex, cell: int, k: int, measure: Measure) -> None:
    """Flux of facet k of a cell, as the ticks stand."""
    a, b, c = outward(held.cells, cell, k)
    put_flux(held.fluxes, cell, k, held.ticks, a, b, c, measure)


@njit(cache=True, error_model="numpy")
def _sum_chunk(held: Complex, first: int, last: int) -> None:
    for cell in range(first, last):
        for k in range(held.cells.shape[1]):
            other = held.across[cell, k]
            if 0 <= other < cell:
                m = facet_of(held.cells, held.across, other, cell)
                for d in range(held.fluxes.shape[2]):
                    held.fluxes[cell, k, d] = -held.fluxes[other, m, d]
        sum_up(held.sums, held.fluxes, cell)


@njit(cache=True, error_model="numpy")
def sum_up(sums: NDArray, fluxes: NDArray, cell: int) -> None:
    """A cell's moment sums from its facets."""
    for d in range(fluxes.shape[2]):
        total = 0.0
        for k in range(fluxes.shape[1]):
            total += fluxes[cell, k, d]
        sums[cell, d] = total if d == 0 or sums[cell, 0] > 0.0 else 0.0  # no rounding left without voxels


@njit(cache=True, error_model="numpy")
def cell_energy(held: Complex, cell: int, measure: Measure) -> float:
    """A cell's share of E, Eq. (4)."""
    return measure.geometry * held.E_shape[cell] + measure.image * image_energy(held.sums, cell, measure.n_channels)


def cell_squares(held: Complex, n_channels: int = 1) -> NDArray[np.float64]:
    """Sum of squares around its mean of each cell, (n_cells,)."""
    sums = held.sums[: held.n_cells[0]]
    within = sums[:, 2] - (sums[:, [1, *range(3, 2 + n_channels)]] ** 2).sum(axis=1) / np.maximum(sums[:, 0], 1.0)
    return np.where(sums[:, 0] > 0.0, np.maximum(within, 0.0), 0.0)


def energies(held: Complex, n_channels: int = 1) -> tuple[float, float]:
    """Shape energy and sum of squares of the whole complex, summed in the order of the cells."""
    return float(held.E_shape[: held.n_cells[0]].sum()), float(cell_squares(held, n_channels).sum())


# Rings: the cells around each node.


class NodeRings(NamedTuple):
    """The cells around each node, as compressed rows, and which of their facets are one and the same."""

    start: NDArray[np.int64]  # (N+1,)
    cells: NDArray[np.int64]  # (C(n+1),)
    corner: NDArray[np.int64]  # (C(n+1),) which corner of the cell is the node
    twin: NDArray[np.int64]  # (C(n+1), n+1) facet with the node: (entry in the row) (n+1) + its facet there; -1 outside


def node_rings(held: Complex) -> NodeRings:
    """The rings of a complex as it stands."""
    n_cells, n_corners = int(held.n_cells[0]), held.cells.shape[1]
    start = np.zeros(len(held.ticks) + 1, dtype=np.int64)
    cells = np.empty(n_cells * n_corners, dtype=np.int64)
    corner = np.empty(n_cells * n_corners, dtype=np.int64)
    twin = np.empty((n_cells * n_corners, n_corners), dtype=np.int64)
    _fill_rings(start, cells, corner, held.cells, n_cells)
    with few_threads(n_cells):
        _fill_twins(twin, start, cells, corner, held.cells, held.across)
    return NodeRings(start, cells, corner, twin)


@njit(cache=True, error_model="numpy")
def _fill_rings(start: NDArray, ring: NDArray, corner: NDArray, cells: NDArray, n_cells: int) -> None:
    n = cells.shape[1]
    for c in range(n_cells):
        for k in range(n):
            start[cells[c, k] + 1] += 1
    for i in range(len(start) - 1):
        start[i + 1] += start[i]
    fill = start.copy()
    for c in range(n_cells):
        for k in range(n):
            node = cells[c, k]
            ring[fill[node]] = c
            corner[fill[node]] = k
            fill[node] += 1


@njit(cache=True, parallel=True, error_model="numpy")
def _fill_twins(twin: NDArray, start: NDArray, ring: NDArray, corner: NDArray, cells: NDArray, across: NDArray) -> None:
    n = cells.shape[1]
    for chunk in prange((len(start) - 1 + CHUNK - 1) // CHUNK):
        for node in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(start) - 1)):
            for r in range(start[node], start[node + 1]):
                for k in range(n):
                    twin[r, k] = -1
                    other = across[ring[r], k]
                    if k == corner[r] or other < 0:
                        continue
                    s = start[node]
                    while ring[s] != other:
                        s += 1
                    twin[r, k] = (s - start[node]) * n + facet_of(cells, across, other, ring[r])


def measure_of(
    grid: SamplingGrid, hand: int, matrix: NDArray[np.float64], geometry: float, image: float, power: float,
    is_graded: bool = False, surface: float = 0.0, is_kept: bool = False,
) -> Measure:  # fmt: skip
    """A `Measure` of plain numbers, as the kernels are compiled for, without a floor."""
    return Measure(
        grid.prefix,
        int(grid.bits),
        int(hand),
        matrix,
        float(geometry),
        float(image),
        float(surface),
        int(grid.n_channels),
        float(power),
        bool(is_graded),
        bool(is_kept),
        *floor_of(0.0),
    )


def floor_of(degrees: float) -> tuple[float, float]:
    """`floor` and `safe` of a `Measure`, for a smallest dihedral angle; 0 for none.

    Of all tetrahedra with a dihedral angle t up to a regular one's, eta is least for the one that is symmetric about
    that edge and the opposite one: eta^3 = ((1 + s^2) / (s c))^2 / 8 with s, c = sin, cos(t / 2), and it falls as t
    grows. In terms of S and the determinant eta^3 = S^3 / (432 det^2).
    """
    if degrees <= 0.0:
        return -1.0, np.inf
    s, c = np.sin(np.radians(degrees) / 2.0), np.cos(np.radians(degrees) / 2.0)
    return -float(np.cos(np.radians(degrees))), float(432.0 / 8.0 * ((1.0 + s * s) / (s * c)) ** 2 * (1.0 - 1e-9))
