"""A cell complex in plain arrays, kept consistent while nodes move and cells are exchanged.

A cell's facet k lies opposite its corner k. For each facet the complex stores the cell across it
and the facet's outward flux (see `tetopt.energy.sampling`) times the sign of index space, so that a
cell's moment sums are the plain sum over its facets and the two sides of a facet have opposite
numbers. Local operations then only measure new facets.

The D sums of a cell are the number of its voxels, the sum of the first channel's values, the sum of
all channels' squares, the sums of the other channels' values and, if the mesh covers only a mask,
the voxels outside the mask minus those inside.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.energy.sampling import CELLS_PER_CHUNK, Volume
from tetopt.energy.sampling import put_flux as sampled_flux
from tetopt.geometry.vectors import (
    cross,
    difference,
    dot,
    minus,
    over,
    put_row,
    scale_vector,
    times,
)
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernels import (
    Bools2,
    Floats1,
    Floats2,
    Floats3,
    Ints1,
    Ints2,
    Singles3,
    Singles4,
    entry,
    helper,
    inlined,
    pack_record,
    run,
    unit,
)

# A cell's volume over (sum of squared edges)^(n/2), below which it counts as inverted: an angle of
# 1e-3 degrees.
FLAT_FRACTION = 1e-7
# fields of a `Complex` with one row per node
NODE_ROWS = ("ticks", "is_frozen", "meeting", "band", "offset")
# fields of a `Complex` with one row per cell
CELL_ROWS = ("cells", "labels", "across", "fluxes", "sums", "E_shape")


class Complex(NamedTuple):
    """Nodes, cells, their adjacency, and each cell's sums. Rows from `n_cells` are space for
    more cells.
    """

    ticks: Ints2  # (N, 3) node positions on the sampling grid
    # (N, 4) axes along which each node is fixed; last column: on the mask's surface
    is_frozen: Bools2
    meeting: Ints2  # (N, 4) labels of the cells around each node if there are two or more; else -1
    # (N,) distance that each node may be off its place at the surface between two labels, voxels
    band: Floats1
    # (N,) value of each node's first constraint at its place; see `surface.fill_offsets`
    offset: Floats1
    cells: Ints2  # (C, n+1) corners, positively oriented in the world
    # (C,) each cell's label, a row of the memberships; all 0 until labels are assigned
    labels: Ints1
    across: Ints2  # (C, n+1) the cell beyond each facet; -1 outside
    fluxes: Floats3  # (C, n+1, D) outward flux of each facet
    sums: Floats2  # (C, D) moment sums: their sum over the facets
    E_shape: Floats1  # (C,) shape energy, see `shape_energy`
    n_cells: Ints1  # (1,) rows in use


class Objective(NamedTuple):
    """Weights and parameters of a cell's energy."""

    volume: Volume  # the sampling grid's volume
    bits: int
    hand: int  # sign of the cells' volumes in index space
    matrix: Floats2  # (3, 3) index vectors to mm
    geometry: float  # weight of the shape energy: (1 - k_D) / E_G0
    image: float  # weight of a cell's sum of squares: k_D x voxel volume / E_D0
    surface: float  # weight of a voxel on the wrong side of the mask's surface; 0 without a mask
    n_channels: int
    power: float  # p of the shape energy
    is_graded: bool  # True if every cell's shape has the same weight, whatever its size
    angle_limit: float  # minus the cosine of the minimum dihedral angle; -1 for none
    # a tetrahedron is above that angle if its S^3 is at most this times its squared determinant
    safe: float
    rounding: float  # a total sum of squares up to this is only rounding
    # penalty of a voxel on the wrong side of the mask's surface, in squares; see `surface`
    wrong_side: float
    # leading channels for which a cell has its mean; in the others its label sets the value
    n_means: int
    own_column: Ints1  # (K,) column of a cell's sums for each label's channel
    own_value: Floats1  # (K,) the label's value there; 0 in the other channels of labels


class Sides(NamedTuple):
    """Places of boundary nodes: the box's sides and the mask's surface."""

    low: Ints1  # (3,) ticks of the box's sides
    high: Ints1
    is_fixed: bool  # True if boundary nodes are fixed
    has_surface: bool  # True if boundary nodes off the box's sides lie on the mask's surface
    level: Singles3  # (s_0, s_1, s_2) level function of the mask; (1, 1, 1) without one
    levels: Singles4  # (L, s_0, s_1, s_2) level functions of labels; (1, 1, 1, 1) without any
    channel: Ints1  # (K,) level function of each label
    projections: Floats3  # see `tetopt.engine.state.free_projections`
    inverse: Floats2  # (3, 3) mm to index vectors


class State(NamedTuple):
    """Complex, objective and boundary for the kernels; made by `tetopt.engine.state.state_of`."""

    complex: Complex
    objective: Objective
    sides: Sides


def build(
    cells: Ints,
    ticks: Ints,
    is_frozen: Bools,
    objective: Objective,
    sides: Sides,
) -> State:
    """Build the state of a conforming mesh and measure everything.

    `ticks` and `is_frozen` are kept, not copied. At most two cells may share a facet
    (`check_mesh`).
    """
    n_cells, n_corners = cells.shape
    room = n_cells + n_cells // 4 + 64
    n_sums = objective.volume.long.shape[3] + 1
    complex_ = Complex(
        ticks,
        is_frozen,
        np.full((len(ticks), 4), -1, dtype=np.int64),
        np.zeros(len(ticks)),
        np.zeros(len(ticks)),
        np.full((room, n_corners), -1, dtype=np.int64),
        np.zeros(room, dtype=np.int64),
        np.full((room, n_corners), -1, dtype=np.int64),
        np.zeros((room, n_corners, n_sums)),
        np.zeros((room, n_sums)),
        np.zeros(room),
        np.array([n_cells]),
    )
    complex_.cells[:n_cells] = cells
    fill_across(complex_.across, complex_.cells, n_cells, len(ticks))
    state = State(complex_, objective, sides)
    remeasure(state)
    return state


def remeasure(state: State) -> None:
    """Recompute fluxes, sums and shape energies of all cells."""
    n_cells, laid_out = int(state.complex.n_cells[0]), pack_record(state)
    for task in (_measure_cells, _sum_cells):
        run(task, -(-n_cells // CELLS_PER_CHUNK), laid_out, 4 * n_cells)


def copy_state(state: State) -> State:
    """Copy the state, with a complex in separate arrays."""
    return state._replace(complex=Complex._make(array.copy() for array in state.complex))


def grow_state(state: State, least: int = 64) -> State:
    """The state with space for a quarter more cells, and at least `least`; of zeros, as rows that
    are never used take no memory then.
    """
    more = int(state.complex.n_cells[0]) // 4 + least

    def wider(array: NDArray) -> NDArray:
        wide = np.zeros((len(array) + more, *array.shape[1:]), dtype=array.dtype)
        wide[: len(array)] = array
        return wide

    mesh = state.complex
    wide = {name: wider(getattr(mesh, name)) for name in CELL_ROWS}
    return state._replace(complex=mesh._replace(**wide))


def without_cells(state: State, is_gone: Bools) -> State:
    """The state without some cells, (M,); nodes stay, and those on the new boundary count as on
    the mask's surface.
    """
    mesh, n_cells = state.complex, len(is_gone)
    kept = np.flatnonzero(~is_gone)
    rows = np.append(kept, np.arange(n_cells, len(mesh.cells)))
    number = np.full(n_cells + 1, -1, dtype=np.int64)  # the last row stands for -1, the outside
    number[kept] = np.arange(len(kept))
    beyond = mesh.cells[:n_cells][is_gone]
    complex_ = mesh._replace(
        **{name: getattr(mesh, name)[rows] for name in CELL_ROWS}, n_cells=np.array([len(kept)])
    )
    complex_.across[: len(kept)] = number[complex_.across[: len(kept)]]
    is_frozen = mesh.is_frozen.copy()
    is_frozen[beyond.ravel(), 3] = True
    return state._replace(complex=complex_._replace(is_frozen=is_frozen))


@entry
def fill_across(across: Ints2, cells: Ints2, n_cells: int, n_nodes: int) -> None:
    """Fill in the cell beyond each facet, by counting sort over the facets' lowest nodes."""
    n = cells.shape[1]
    start = np.zeros(n_nodes + 1, dtype=np.int64)
    for c in range(n_cells):
        for k in range(n):
            start[_lowest_node(cells, c, k) + 1] += 1
    for i in range(n_nodes):
        start[i + 1] += start[i]
    fill = start.copy()
    items = np.empty(start[n_nodes], dtype=np.int64)
    for c in range(n_cells):
        for k in range(n):
            lowest = _lowest_node(cells, c, k)
            items[fill[lowest]] = c * n + k
            fill[lowest] += 1
    for i in range(n_nodes):
        for p in range(start[i], start[i + 1]):
            c, k = items[p] // n, items[p] % n
            if across[c, k] >= 0:
                continue
            for q in range(p + 1, start[i + 1]):
                d, m = items[q] // n, items[q] % n
                if d != c and _is_one_facet(cells, c, k, d, m):
                    across[c, k] = d
                    across[d, m] = c
                    break


@helper
def _lowest_node(cells: NDArray, cell: int, k: int) -> int:
    """The lowest node of facet k of a cell."""
    lowest = cells[cell, 1 if k == 0 else 0]
    for m in range(cells.shape[1]):
        if m != k:
            lowest = min(lowest, cells[cell, m])
    return lowest


@helper
def _is_one_facet(cells: NDArray, c: int, k: int, d: int, m: int) -> bool:
    """True if facet k of cell c has the same nodes as facet m of cell d."""
    for s in range(cells.shape[1]):
        if s != k and (cells[c, s] == cells[d, m] or not has_node(cells, d, cells[c, s])):
            return False
    return True


@helper
def facet_of(across: NDArray, cell: int, other: int) -> int:
    """The facet of `cell` beyond which `other` lies."""
    k = 0
    while across[cell, k] != other:
        k += 1
    return k


@helper
def corner_of(cells: NDArray, cell: int, node: int) -> int:
    """The corner of `cell` that is `node`."""
    k = 0
    while cells[cell, k] != node:
        k += 1
    return k


@helper
def has_node(cells: NDArray, cell: int, node: int) -> bool:
    """True if `node` is a corner of `cell`."""
    is_corner = False
    for k in range(cells.shape[1]):
        is_corner = is_corner or cells[cell, k] == node
    return is_corner


@helper
def put_flux(
    out: Floats3, p: int, q: int, ticks: Ints2, a: int, b: int, c: int, objective: Objective
) -> None:
    """Write the flux of the facet (a, b, c), or (a, b) if c < 0, times the sign of index space,
    to out[p, q, :].
    """
    sampled_flux(out, p, q, ticks, a, b, c, objective.volume)
    if objective.hand < 0:
        for d in range(out.shape[2]):
            out[p, q, d] = -out[p, q, d]


@helper
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


@helper
def image_energy(sums: NDArray, row: int, label: int, objective: Objective) -> float:
    """Sum of squares around the values of one cell, over all channels, from its moment sums, a row
    of `sums`.

    A cell's value is its mean; in the channels of labels, once cells have labels, it is its label's
    value, so that voxels of other labels in a cell count as errors however the cell is divided.
    """
    count = sums[row, 0]
    if count <= 0.0:
        return 0.0
    within = sums[row, 2]
    if objective.n_means > 0:
        within -= sums[row, 1] * sums[row, 1] / count
    for d in range(3, 2 + objective.n_means):
        within -= sums[row, d] * sums[row, d] / count
    if objective.n_means < objective.n_channels:
        value = objective.own_value[label]
        within += value * (value * count - 2.0 * sums[row, objective.own_column[label]])
    return max(within, 0.0)


@helper
def cell_value(sums: NDArray, cell: int, label: int, channel: int, objective: Objective) -> float:
    """Value of a cell with voxels in a channel: its mean, or its label's value; see
    `image_energy`.
    """
    column = 1 if channel == 0 else 2 + channel
    if channel < objective.n_means:
        return sums[cell, column] / sums[cell, 0]
    return objective.own_value[label] if objective.own_column[label] == column else 0.0


@helper
def wrong_side(sums: NDArray, row: int, objective: Objective) -> float:
    """Weighted voxels outside the mask minus those inside, in one cell; its changes are those of
    the mask's misfit.
    """
    return objective.surface * sums[row, sums.shape[1] - 1] if objective.surface > 0.0 else 0.0


@helper
def shape_energy(x: NDArray, n_corners: int, power: float, is_graded: bool) -> float:
    """E_G of the cell with corners x (4, 3) times eta^(p - 1); infinite for a flat or inverted
    cell.

    eta = S / (12 (3 v)^(2/3)) in 3-D and S / (4 sqrt(3) v) in 2-D, with S the sum of the squared
    edges and v the volume: 1 for the regular cell, infinite for a flat one. E_G,j is proportional
    to v^(5/3) eta, so it vanishes for a sliver. With p = 1 the energy is the paper's; for p > 2.5
    it grows without bound as a cell becomes flat.

    On a graded mesh v^(5/3) would give all weight to the largest cells: a cell with twice the edge
    weighs 32 times as much. Section 4 of the paper suggests a weight by the local mesh size. With
    E_G,j over h^5, and h^3 proportional to the cell's own volume, all sizes cancel and eta^p
    remains: the same for every cell of that shape, so that the shape term favours no size and E_D
    alone determines where cells are small.

    Corners come from `load`, which subtracts in integers: the rounding error of the signed volume
    is far below `FLAT_FRACTION`, so that a cell that passes is exactly positively oriented.
    """
    if n_corners == 3:
        u, v = difference(x, 1, 0), difference(x, 2, 0)
        w = minus(u, v)
        volume = 0.5 * cross(u, v)[0]
        S = u[1] * u[1] + u[2] * u[2] + v[1] * v[1] + v[2] * v[2] + w[1] * w[1] + w[2] * w[2]
        if volume <= FLAT_FRACTION * S:
            return np.inf
        # 4 sqrt(3): eta of an equilateral triangle is 1
        eta = S / (6.928203230275509 * volume)
        if is_graded:
            return eta**power
        E_G = volume * S / 12.0
        return E_G if power == 1.0 else E_G * eta ** (power - 1.0)
    determinant, S = determinant_and_squares(x)
    return tet_energy(determinant, S, power, is_graded)


@helper
def determinant_and_squares(x: NDArray) -> tuple:
    """Six times the signed volume of the tetrahedron x (4, 3), and the sum of its squared edges."""
    u, v, w = difference(x, 1, 0), difference(x, 2, 0), difference(x, 3, 0)
    # The sum of squares over all pairs of four points is four times that over the points minus the
    # square of their sum.
    s = u[0] + v[0] + w[0], u[1] + v[1] + w[1], u[2] + v[2] + w[2]
    S = u[0] * u[0] + u[1] * u[1] + u[2] * u[2] + v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    S = 4.0 * (S + w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    return dot(u, cross(v, w)), S - dot(s, s)


@helper
def tet_energy(determinant: float, S: float, power: float, is_graded: bool) -> float:
    """`shape_energy` of a tetrahedron from six times its volume and the sum of its squared
    edges.
    """
    volume = determinant / 6.0
    if volume <= 0.0 or volume * volume <= FLAT_FRACTION * FLAT_FRACTION * S * S * S:
        return np.inf
    if is_graded:
        # 432: eta of a regular tetrahedron is 1
        cube = S * S * S / (432.0 * determinant * determinant)  # eta^3
        return cube if power == 3.0 else cube ** (power / 3.0)
    # 20 = (n+1) (n+2) for n = 3
    E_G = volume * S / 20.0
    if power == 1.0:
        return E_G
    # the default, without the cube root of a square: eta^2 = S^2 / (144 (3 v)^(4/3))
    if power == 3.0:
        t = 1.0 / np.cbrt(3.0 * volume)
        t *= t
        # 144 = 12^2
        return E_G * S * S * t * t * (1.0 / 144.0)
    return E_G * (S / (12.0 * np.cbrt(9.0 * volume * volume))) ** (power - 1.0)


# Inlined like `cell_energy`: a pass of flips took 70 ms, not 96 (with `tet_energy`, too, which
# alone gains little).
@inlined
def load(x: NDArray, row: int, ticks: NDArray, node: int, base: int, objective: Objective) -> None:
    """Write a node's position relative to the node `base`, mm, to a row of x; the subtraction is
    exact, in integers.
    """
    put_row(
        x,
        row,
        times(objective.matrix, scale_vector(2.0**-objective.bits, difference(ticks, node, base))),
    )


@helper
def place(ticks: NDArray, node: int, base: int, objective: Objective) -> tuple:
    """A node's position relative to the node `base`, mm, as `load` writes it."""
    return times(
        objective.matrix, scale_vector(2.0**-objective.bits, difference(ticks, node, base))
    )


@helper
def load_cell(x: NDArray, ticks: NDArray, cells: NDArray, cell: int, objective: Objective) -> None:
    """Write a cell's corners relative to its first, mm, to x."""
    for k in range(cells.shape[1]):
        load(x, k, ticks, cells[cell, k], cells[cell, 0], objective)


@helper
def shape_of_cell(
    x: NDArray, ticks: NDArray, cells: NDArray, cell: int, objective: Objective
) -> float:
    """Shape energy of a cell of the complex; its corners are written to `x` (4, 3)."""
    load_cell(x, ticks, cells, cell, objective)
    return shape_energy(x, cells.shape[1], objective.power, objective.is_graded)


@unit
def shape_of_tet(
    x: Floats2, ticks: Ints2, a: int, b: int, c: int, d: int, objective: Objective
) -> float:
    """Shape energy of the tetrahedron (a, b, c, d); infinite unless it is positively oriented."""
    load(x, 0, ticks, a, a, objective)
    load(x, 1, ticks, b, a, objective)
    load(x, 2, ticks, c, a, objective)
    load(x, 3, ticks, d, a, objective)
    return shape_energy(x, 4, objective.power, objective.is_graded)


@helper
def shape_of_triangle(
    x: NDArray, ticks: NDArray, a: int, b: int, c: int, objective: Objective
) -> float:
    """Shape energy of the triangle (a, b, c); infinite unless it is positively oriented."""
    load(x, 0, ticks, a, a, objective)
    load(x, 1, ticks, b, a, objective)
    load(x, 2, ticks, c, a, objective)
    return shape_energy(x, 3, objective.power, objective.is_graded)


@entry
def signed_volume(x: Floats2, n_corners: int) -> float:
    """Signed volume of the cell with corners x (4, 3), times n!."""
    if n_corners == 3:
        return cross(difference(x, 1, 0), difference(x, 2, 0))[0]
    return determinant_and_squares(x)[0]


@unit
def worst_cosine(x: Floats2) -> float:
    """Minus the cosine of the smallest dihedral angle of the tetrahedron x (4, 3), which grows with
    it; -1 if flat.

    Between faces with outward normals p and q the angle's cosine is -p.q / (|p| |q|).
    """
    n_0, n_1, n_2, n_3 = (
        _face_normal(x, 0),
        _face_normal(x, 1),
        _face_normal(x, 2),
        _face_normal(x, 3),
    )
    size_0, size_1 = np.sqrt(dot(n_0, n_0)), np.sqrt(dot(n_1, n_1))
    size_2, size_3 = np.sqrt(dot(n_2, n_2)), np.sqrt(dot(n_3, n_3))
    if size_0 == 0.0 or size_1 == 0.0 or size_2 == 0.0 or size_3 == 0.0:
        return -1.0
    p, q = over(n_0, size_0), over(n_1, size_1)
    r, s = over(n_2, size_2), over(n_3, size_3)
    return min(1.0, dot(p, q), dot(p, r), dot(p, s), dot(q, r), dot(q, s), dot(r, s))


@helper
def _face_normal(x: NDArray, k: int) -> tuple:
    """An outward normal of the face opposite a corner of a tetrahedron."""
    a, b, c = (k + 1) & 3, (k + 2) & 3, (k + 3) & 3
    # (k+1, k+2, k+3) faces outwards for even k of a positive cell, inwards for odd k.
    return scale_vector(-1.0 if k & 1 else 1.0, cross(difference(x, b, a), difference(x, c, a)))


@entry
def cosine_up_to_limit(x: Floats2, objective: Objective) -> float:
    """`worst_cosine`, or the limit for a tetrahedron far above it: most are, and this takes a
    tenth of the time.
    """
    determinant, S = determinant_and_squares(x)
    if determinant > 0.0 and S * S * S <= objective.safe * determinant * determinant:
        return objective.angle_limit
    return worst_cosine(x)


@helper
def cell_cosine(x: NDArray, state: State, cell: int) -> float:
    """`worst_cosine` of a cell of the complex."""
    load_cell(x, state.complex.ticks, state.complex.cells, cell, state.objective)
    return worst_cosine(x)


@helper
def tet_cosine(x: NDArray, state: State, a: int, b: int, c: int, d: int) -> float:
    """`worst_cosine` of the tetrahedron (a, b, c, d); -2 if it is flat or inverted."""
    if not shape_of_tet(x, state.complex.ticks, a, b, c, d, state.objective) < np.inf:
        return -2.0
    return worst_cosine(x)


@unit
def _measure_cells(state: State, chunk: int) -> None:
    """Measure each facet once, from its lower cell."""
    first = chunk * CELLS_PER_CHUNK
    x, cells, across = np.empty((4, 3)), state.complex.cells, state.complex.across
    for cell in range(first, min(first + CELLS_PER_CHUNK, state.complex.n_cells[0])):
        state.complex.E_shape[cell] = shape_of_cell(
            x, state.complex.ticks, cells, cell, state.objective
        )
        for k in range(cells.shape[1]):
            if across[cell, k] > cell or across[cell, k] < 0:
                measure_facet(state, cell, k)


@helper
def measure_facet(state: State, cell: int, k: int) -> None:
    """Measure the flux of facet k of a cell at the current ticks."""
    a, b, c = outward(state.complex.cells, cell, k)
    put_flux(state.complex.fluxes, cell, k, state.complex.ticks, a, b, c, state.objective)


@unit
def _sum_cells(state: State, chunk: int) -> None:
    complex_, first = state.complex, chunk * CELLS_PER_CHUNK
    cells, across, fluxes = complex_.cells, complex_.across, complex_.fluxes
    for cell in range(first, min(first + CELLS_PER_CHUNK, complex_.n_cells[0])):
        for k in range(cells.shape[1]):
            other = across[cell, k]
            if 0 <= other < cell:
                m = facet_of(across, other, cell)
                for d in range(fluxes.shape[2]):
                    fluxes[cell, k, d] = -fluxes[other, m, d]
        sum_up(complex_.sums, fluxes, cell)


@helper
def sum_up(sums: NDArray, fluxes: NDArray, cell: int) -> None:
    """Compute a cell's moment sums from its facets."""
    for d in range(fluxes.shape[2]):
        total = 0.0
        for k in range(fluxes.shape[1]):
            total += fluxes[cell, k, d]
        # without voxels no rounding error remains
        sums[cell, d] = total if d == 0 or sums[cell, 0] > 0.0 else 0.0


@unit
def settle(x: Floats2, state: State, cell: int) -> None:
    """Compute shape energy and sums of a cell with known corners and fluxes; write its corners
    to `x` (4, 3).
    """
    mesh = state.complex
    mesh.E_shape[cell] = shape_of_cell(x, mesh.ticks, mesh.cells, cell, state.objective)
    sum_up(mesh.sums, mesh.fluxes, cell)


@inlined
def cell_energy(state: State, cell: int) -> float:
    """A cell's contribution to E, Eq. (4)."""
    objective = state.objective
    squares = image_energy(state.complex.sums, cell, state.complex.labels[cell], objective)
    return objective.geometry * state.complex.E_shape[cell] + objective.image * squares


def cell_squares(state: State, n_means: int | None = None) -> Floats:
    """Each cell's sum of squares around its values, (n_cells,), or around means if `n_means` is
    all channels.
    """
    n_cells, objective = int(state.complex.n_cells[0]), state.objective
    n_means = objective.n_means if n_means is None else n_means
    sums, labels = state.complex.sums[:n_cells], state.complex.labels[:n_cells]
    firsts = sums[:, [1, *range(3, 2 + objective.n_channels)]][:, :n_means]
    within = sums[:, 2] - (firsts**2).sum(axis=1) / np.maximum(sums[:, 0], 1.0)
    if n_means < objective.n_channels:
        value, own = (
            objective.own_value[labels],
            sums[np.arange(n_cells), objective.own_column[labels]],
        )
        within += value * (value * sums[:, 0] - 2.0 * own)
    return np.where(sums[:, 0] > 0.0, np.maximum(within, 0.0), 0.0)


@helper
def is_interface(complex_: Complex, cell: int, k: int) -> bool:
    """True if a facet lies between two labels."""
    other = complex_.across[cell, k]
    return other >= 0 and complex_.labels[other] != complex_.labels[cell]


@helper
def facet_area(ticks: NDArray, a: int, b: int, c: int, objective: Objective) -> float:
    """Area of the facet (a, b, c), mm^2, or length of the segment (a, b) if c < 0, mm."""
    u = place(ticks, b, a, objective)
    if c < 0:
        return np.sqrt(dot(u, u))
    n = cross(u, place(ticks, c, a, objective))
    return 0.5 * np.sqrt(dot(n, n))


def energies(state: State, n_means: int | None = None) -> tuple[float, float]:
    """Shape energy and sum of squares (`cell_squares`) of the whole complex, summed in the order
    of the cells.
    """
    E_shape = state.complex.E_shape[: state.complex.n_cells[0]]
    return float(E_shape.sum()), float(cell_squares(state, n_means).sum())


# Stars: the cells around each node.


class NodeStars(NamedTuple):
    """The cells around each node, as compressed rows, and the pairs of their facets that
    coincide.
    """

    start: Ints1  # (N+1,)
    cells: Ints1  # (C(n+1),)
    corner: Ints1  # (C(n+1),) corner of the cell that is the node
    # (C(n+1), n+1) facet with the node: (entry in the row) (n+1) + its facet there; -1 outside
    twin: Ints2


def node_stars(state: State) -> NodeStars:
    """The current stars of a complex."""
    n_cells, n_corners = int(state.complex.n_cells[0]), state.complex.cells.shape[1]
    start = np.zeros(len(state.complex.ticks) + 1, dtype=np.int64)
    cells = np.empty(n_cells * n_corners, dtype=np.int64)
    corner = np.empty(n_cells * n_corners, dtype=np.int64)
    twin = np.empty((n_cells * n_corners, n_corners), dtype=np.int64)
    _fill_stars(start, cells, corner, state.complex.cells, n_cells)
    stars = NodeStars(start, cells, corner, twin)
    n_chunks = -(-len(state.complex.ticks) // CELLS_PER_CHUNK)
    run(_fill_twins, n_chunks, Twins(stars, state.complex.across), n_cells)
    return stars


@entry
def _fill_stars(start: Ints1, star: Ints1, corner: Ints1, cells: Ints2, n_cells: int) -> None:
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
            star[fill[node]] = c
            corner[fill[node]] = k
            fill[node] += 1


class Twins(NamedTuple):
    """Data from which `twin` is filled in."""

    stars: NodeStars
    across: Ints2  # as of the complex


@unit
def _fill_twins(work: Twins, chunk: int) -> None:
    across, start, star, corner, twin = (
        work.across,
        work.stars.start,
        work.stars.cells,
        work.stars.corner,
        work.stars.twin,
    )
    n = across.shape[1]
    for node in range(chunk * CELLS_PER_CHUNK, min((chunk + 1) * CELLS_PER_CHUNK, len(start) - 1)):
        for r in range(start[node], start[node + 1]):
            for k in range(n):
                twin[r, k] = -1
                other = across[star[r], k]
                if k == corner[r] or other < 0:
                    continue
                s = start[node]
                while star[s] != other:
                    s += 1
                twin[r, k] = (s - start[node]) * n + facet_of(across, other, star[r])
