"""From voxels to cells: the cell that contains each voxel centre, and the sums of h over each cell.

The contract: every voxel centre inside the mesh belongs to *exactly one* cell. Rounding cannot
break it, because nothing here rounds. Nodes are mapped to voxel-index space and onto a fixed-point
grid of 2**-bits voxels (`to_ticks`; about 1e-6 voxel for a brain), so that the side of a facet on
which a voxel centre lies is the sign of an integer. A centre exactly on a facet, edge or node
belongs to the cell that would contain it if it were shifted by (eps^3, eps^2, eps) along the axes,
with eps infinitely small: one rule for all cells (simulation of simplicity, Edelsbrunner and Muecke
1990), under which no centre ever lies on a facet.

Sums over a cell are taken on its facets, as in the divergence theorem. Along a row of voxels (the
last axis) let P(k) be the sum over the row's first k voxels. A row that meets a cell enters it
through one facet and leaves it through another; if the first voxel beyond each is k_in and k_out,
the cell contains voxels k_in ... k_out - 1 of the row, and their sum is P(k_out) - P(k_in). So each
facet has a *flux*, the sum of P(k) over the rows that cross it, signed by the side it faces, and
the sum over a cell is the signed sum of its facets' fluxes. A facet's flux is computed once for its
two cells; one cell gains what the other loses, so that totals are exact by construction; and when a
node moves, only the facets around it change. P is kept for 1, h and h^2.

The place where a facet cuts a row is computed in float64, and in integers if it is too close to a
voxel centre. The facets of triangles are segments and are treated alike; a 2-D image gets a leading
axis of length 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, log2, prod
from typing import Any, NamedTuple

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.contents.content import Content, check_values, continue_image
from tetopt.errors import InputError
from tetopt.geometry.topology import Facets, facets
from tetopt.geometry.vectors import cross, difference, dot, row
from tetopt.image import Image, check_image
from tetopt.mesh import Mesh
from tetopt.system.arrays import Floats, Ints
from tetopt.system.budget import check_memory
from tetopt.system.kernel_cache import njit
from tetopt.system.kernels import (
    Floats1,
    Floats2,
    Floats3,
    Floats4,
    Ints1,
    Ints2,
    Ints3,
    Ints4,
    Shorts4,
    Singles3,
    entry,
    helper,
    run,
    unit,
)
from tetopt.system.slabs import over_slabs

# voxels: between its ends, the error of an edge's cut is far below the remainder to 0.5
EDGE_MARGIN = 0.5 - 1e-9
SUM_BYTES = 12.0  # per prefix sum and voxel: 8, and temporary arrays
ONE_CELL = 1 << 40  # counts one cell in sums of cell numbers from 1; see `_visit_voxels`
OWNER_SLABS = 2  # per thread, in finding the cell of each voxel: each slab looks for its facets
CELLS_PER_CHUNK = 64  # cells, facets or nodes that a parallel task handles at once


class CellMoments(NamedTuple):
    """Moments of the image over each cell, one row per cell.

    Parameters
    ----------
    n_voxels : (M,) int64
        Voxel centres inside.
    mean : (M,) float64
        Mean of h, intensity; in a cell without voxel centre, h at the centroid.
    variance : (M,) float64
        Variance of h, normalised by `n_voxels`, intensity^2; 0 without voxel centre.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> moments = tetopt.cell_moments(image, mesh)
    >>> energy = image.voxel_volume * float((moments.n_voxels * moments.variance).sum())
    >>> bool(np.isclose(energy, tetopt.E_D(image, mesh)))
    True
    """

    n_voxels: Ints
    mean: Floats
    variance: Floats


def cell_moments(image: Image, mesh: Mesh) -> CellMoments:
    """Count, mean and variance of the voxels whose centres lie in each cell.

    The mean is the single value that represents the cell in a finite-element model (Eq. 2). A cell
    smaller than a voxel may contain no voxel centre: its mean is h at the centroid (the nearest
    voxel's value) and its variance 0.

    Parameters
    ----------
    image : Image
        The intensities h, 2-D or 3-D as the mesh is.
    mesh : Mesh
        Points in world coordinates, mm; curved edges count as straight.

    Returns
    -------
    CellMoments
        Arrays `n_voxels`, `mean` and `variance`, (M,) each.

    Raises
    ------
    InputError
        Mesh and image of different dimension, a cell that is flat or inverted at the sampling's
        resolution, or a mesh far larger than the image.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> moments = tetopt.cell_moments(image, mesh)
    >>> int(moments.n_voxels.sum()) == image.data.size  # each voxel is in one cell
    True
    >>> float(moments.mean.min()), float(moments.mean.max())
    (20.0, 100.0)
    """
    image = without_gaps(image, mesh)
    return _moments(image, mesh, _sample_cells(image, mesh))


def cell_moments_and_ranges(image: Image, mesh: Mesh) -> tuple[CellMoments, tuple[Floats, Floats]]:
    """`cell_moments`, and the least and greatest intensity in each cell, (M,) each; in a cell
    without voxel centre the nearest voxel's.
    """
    image = without_gaps(image, mesh)
    sampled = _sample_cells(image, mesh)
    return _moments(image, mesh, sampled), _ranges(image, mesh, sampled)


class _Sampled(NamedTuple):
    """A mesh on the grid of an image."""

    grid: SamplingGrid
    ticks: Ints  # (N, 3)
    sides: Facets


def _sample_cells(image: Image, mesh: Mesh) -> _Sampled:
    return _on_grid(image, mesh, sampling_grid(check_image("image", image), mesh.points))


def _place_cells(image: Image, mesh: Mesh) -> _Sampled:
    """Like `_sample_cells`, but without values: only the places of cells."""
    shape = (1,) * (3 - check_image("image", image).ndim) + image.shape
    return _on_grid(
        image,
        mesh,
        SamplingGrid(np.empty((*shape[:2], shape[2] + 1, 0)), grid_bits(image, mesh.points), 0),
    )


def _on_grid(image: Image, mesh: Mesh, grid: SamplingGrid) -> _Sampled:
    ticks = to_ticks(image.to_index(mesh.points), grid)
    check_orientations(image, ticks, mesh.cells)
    return _Sampled(grid, ticks, facets(mesh.cells))


def _moments(image: Image, mesh: Mesh, sampled: _Sampled) -> CellMoments:
    grid = sampled.grid
    sums = moment_sums(grid, sampled.ticks, mesh.cells, sampled.sides)
    n_voxels = sums[:, 0].astype(np.int64)
    is_empty = n_voxels == 0
    count = np.maximum(sums[:, 0], 1.0)
    # unlike multiplying by 1 / count, gives the exact mean of equal whole numbers
    offset = sums[:, 1] / count
    mean = grid.shift + offset
    variance = np.maximum(sums[:, 2] / count - offset**2, 0.0)
    mean[is_empty] = nearest_values(image, mesh.points[mesh.cells[is_empty]].mean(axis=1))
    return CellMoments(n_voxels, mean, variance)


def cell_of_voxel(image: Image, mesh: Mesh) -> Ints:
    """Number of the cell that contains each voxel centre.

    Parameters
    ----------
    image : Image
        The intensities h, 2-D or 3-D as the mesh is.
    mesh : Mesh
        Points in world coordinates, mm; curved edges count as straight.

    Returns
    -------
    (s_0, ..., s_{n-1}) int64
        Cell numbers in the image's shape; -1 outside the mesh. Where cells overlap, the first that
        contains the voxel.

    Raises
    ------
    InputError
        As for `cell_moments`.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> cell = tetopt.cell_of_voxel(image, mesh)
    >>> painted = tetopt.Image(tetopt.cell_moments(image, mesh).mean[cell], image.affine)
    >>> painted.shape
    (16, 16, 16)
    """
    return _visit_voxels(mesh, _place_cells(image, mesh)).owner.reshape(image.shape)


def mask_of_values(image: Image, mesh: Mesh) -> Image | None:
    """Return a mask of the voxels with values; None if all have one.

    Raises
    ------
    InputError
        A voxel in a cell has no value; as for `cell_moments`.
    """
    if not check_image("image", image).has_gaps:
        return None
    check_values(image, cell_of_voxel(image, mesh) >= 0)
    return Image(~np.isnan(image.data), image.affine)


def without_gaps(image: Image, mesh: Mesh) -> Image:
    """Return an image whose voxels without a value, all outside the cells, have the nearest one's;
    itself without any. InputError as for `mask_of_values`.
    """
    return continue_image(image, mask_of_values(image, mesh))


class Overlap(NamedTuple):
    """Voxels whose centre lies in several cells of a mesh."""

    n_voxels: int
    voxel: tuple[int, ...]  # the index of one of them
    cells: tuple[int, int]  # two cells that contain it

    def __str__(self) -> str:
        """Return a sentence for a message."""
        return (
            f"cells overlap: {self.n_voxels} voxels lie in several cells; cells {self.cells[0]} "
            f"and {self.cells[1]} "
            f"both contain voxel {list(self.voxel)}"
        )


def overlap_of(image: Image, mesh: Mesh) -> Overlap | None:
    """Return the voxels that lie in several cells, with two of these; None if there is none.

    Raises
    ------
    InputError
        As for `cell_moments`.
    """
    n_voxels, *rest = _visit_voxels(mesh, _place_cells(image, mesh)).shared.tolist()
    voxel, cells = rest[3 - image.ndim : 3], rest[3:]
    return Overlap(n_voxels, tuple(voxel), (min(cells), max(cells))) if n_voxels else None


class _Visited(NamedTuple):
    """Results of visiting each cell's voxels."""

    # (s_0, s_1, s_2) the cell of each voxel, the first of several; -1 for none
    owner: Ints
    low: Floats  # (M,) least intensity of each cell's voxels, inf without any
    high: Floats  # (M,) greatest intensity, -inf without any
    # (6,) number of voxels in several cells, the index of one, and two of its cells
    shared: Ints


def _visit_voxels(mesh: Mesh, sampled: _Sampled, h: NDArray[np.floating] | None = None) -> _Visited:
    """Find the voxels of each cell, and the range of their intensities `h`, by default 0."""
    grid, ticks, sides = sampled
    n_cells, hand = len(mesh.cells), _hand(ticks, mesh.cells)
    low, high, shared = (
        np.full(n_cells, np.inf),
        np.full(n_cells, -np.inf),
        np.zeros(6, dtype=np.int64),
    )
    # Crossing a facet upwards, a row changes from the cells below to the cells above. The changes
    # of the cells' count and of the sum of their numbers, accumulated along the row, give those of
    # the cells that contain each voxel.
    of_cell, signs = sides.of_cell.ravel(), -hand * sides.sign
    numbers = signs * np.arange(1, n_cells + 1)[:, None]
    # Sums of whole numbers below 2^53 are exact in float64.
    number, count = (
        np.bincount(of_cell, weights.ravel(), len(sides.nodes)) for weights in (numbers, signs)
    )
    change = number.astype(np.int64) + ONE_CELL * count.astype(np.int64)
    along = ticks[sides.nodes, 0]
    bottom, top = along.min(axis=1), along.max(axis=1)
    owner = np.empty(grid.shape, dtype=np.int64)

    def fill(first: int, stop: int) -> tuple[Floats, Floats, int]:
        """Find the owners in some planes, as in a volume of these alone."""
        is_near = (top >= first << grid.bits) & (bottom <= stop << grid.bits)
        steps, volume = _volume_of(
            owner[first:stop], None if h is None else h.reshape(grid.shape)[first:stop]
        )
        moved = ticks - [first << grid.bits, 0, 0]
        _scatter_changes(
            steps, change[is_near], moved, sides.nodes[is_near], grid.bits, steps[..., None]
        )
        least, most = (low, high) if h is None else (low.copy(), high.copy())
        return (
            least,
            most,
            _fill_owners(owner[first:stop], least, most, steps, volume, h is not None),
        )

    slabs = over_slabs(fill, len(owner), owner.size, OWNER_SLABS * numba.get_num_threads())
    shared[0] = sum(n_shared for *_, n_shared in slabs)
    for least, most, _ in slabs:
        np.minimum(low, least, out=low)
        np.maximum(high, most, out=high)
    if shared[0] > 0:  # sums of several numbers are meaningless
        steps, volume = _volume_of(owner, None if h is None else h.reshape(grid.shape))
        owner[:], low[:], high[:] = -1, np.inf, -np.inf
        cells = _Cells(
            ticks, np.ascontiguousarray(mesh.cells), sides.nodes, sides.of_cell, signs, grid.bits
        )
        _visit_cells(owner, low, high, shared, cells, volume, steps, steps[..., None])
    return _Visited(owner, low, high, shared)


def _volume_of(owner: Ints, h: NDArray[np.floating] | None) -> tuple[Ints, NDArray[np.float32]]:
    """Steps of 0 along the rows of a volume, whose shape alone matters as prefix sums, and its
    intensities or 0.
    """
    steps = np.zeros((*owner.shape[:2], owner.shape[2] + 1), dtype=np.int64)
    return steps, np.zeros(owner.shape, dtype=np.float32) if h is None else h


def _ranges(image: Image, mesh: Mesh, sampled: _Sampled) -> tuple[Floats, Floats]:
    _, low, high, _ = _visit_voxels(mesh, sampled, image.data)
    is_empty = low > high
    low[is_empty] = high[is_empty] = nearest_values(
        image, mesh.points[mesh.cells[is_empty]].mean(axis=1)
    )
    return low, high


def ranges_of(owner: Ints, h: NDArray[np.floating], n_cells: int) -> tuple[Floats, Floats]:
    """Least and greatest of the values (K,) that each cell owns, (M,) float64; inf and -inf if
    it owns none.
    """
    # Runs of voxels of one cell are reduced first: `ufunc.at` by voxel takes twice as long (MNI152
    # T1, 15,000 nodes).
    start = np.flatnonzero(np.concatenate([[True], owner[1:] != owner[:-1]]))
    inside = owner[start] >= 0
    cell = owner[start][inside]
    low, high = np.full(n_cells, np.inf), np.full(n_cells, -np.inf)
    np.minimum.at(low, cell, np.minimum.reduceat(h, start)[inside])
    np.maximum.at(high, cell, np.maximum.reduceat(h, start)[inside])
    return low, high


def nearest_values(image: Image, points: Floats) -> Floats:
    """Value of the voxel nearest to each world point, (K,) float64; points outside get the
    border's value.
    """
    return image.data[tuple(nearest_voxels(image, points).T)].astype(np.float64)


def linear_values(image: Image, points: Floats) -> Floats:
    """Value of the image, linear between voxel centres, at each world point (K, n), (K,) float64;
    points beyond the outermost centres get the value of the nearest place between them.
    """
    return np.asarray(
        scipy.ndimage.map_coordinates(
            image.data, image.to_index(points).T, np.float64, order=1, mode="nearest"
        )
    )


def nearest_voxels(image: Image, points: Floats) -> Ints:
    """Index of the voxel nearest to each world point, (K, n) int64; points outside get the
    border's voxel.
    """
    index = np.rint(image.to_index(points)).astype(np.int64)
    return np.clip(index, 0, np.array(image.shape) - 1)


class SamplingGrid(NamedTuple):
    """An image prepared for the kernels."""

    # (s_0, s_1, s_2 + 1, 2) sums of h - shift and its square over a row's first k voxels
    prefix: NDArray
    bits: int  # node coordinates are integers in units of 2**-bits voxel
    shift: float  # subtracted from h before squaring, so that sums of squares lose no digits
    n_channels: int = 1  # see `channel_grid`

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along each axis; the first is 1 for a 2-D image."""
        return self.prefix.shape[0], self.prefix.shape[1], self.prefix.shape[2] - 1


def sampling_grid(image: Image, points: Floats) -> SamplingGrid:
    """The image and the fixed-point grid for nodes near `points`, (N, n) world mm.

    Differences of coordinates stay below 2**29 units, so that their products, areas and
    determinants are exact in 64- and 128-bit integers. On an image of whole numbers whose sums of
    squares along a row stay below 2**31 (8-bit and most 16-bit images), every sum is exact, too; on
    others sums are as exact as float64 sums along a row.

    Raises
    ------
    InputError
        Mesh and image differ in dimension, or the mesh reaches 2**20 voxels or more.
    """
    bits = grid_bits(image, points)
    shape = (1,) * (3 - image.ndim) + image.shape
    (low, high), mean, is_whole = image.range, image.mean, image.is_whole
    # constants become 0, whole numbers stay whole
    shift = low if low == high else round(mean) if is_whole else mean
    largest = max(high - shift, shift - low)
    # Whole numbers whose sums fit take half the memory, whose access limits the sampling of small
    # cells:
    # 1.4 times faster at 200 k tetrahedra.
    is_short = is_whole and shape[2] * max(largest, largest * largest) < 2**31
    _check_grid(shape, 2)
    prefix = np.empty(
        (shape[0], shape[1], shape[2] + 1, 2), dtype=np.int32 if is_short else np.float64
    )
    data: Any = image.data.reshape(shape)
    is_single, nothing = data.dtype == np.float32, np.zeros((1, 1, 1))
    single = data if is_single else nothing.astype(np.float32)
    work = _Filling(
        _volume(prefix, bits), nothing if is_single else data, single, is_single, float(shift)
    )
    run(_fill_prefix, shape[0], work, image.data.size // 50)
    return SamplingGrid(prefix, bits, float(shift))


def grid_bits(image: Image, points: Floats) -> int:
    """The bits of the fixed-point grid for nodes near points, (N, n) world mm; InputError as for
    `sampling_grid`.
    """
    if points.shape[1] != image.ndim:
        raise InputError(
            f"mesh and image: expected the same dimension, got a {points.shape[1]}-D mesh and a "
            f"{image.ndim}-D image"
        )
    reach = max(float(np.abs(image.to_index(points)).max()), float(max(image.shape))) + 1.0
    bits = 28 - ceil(log2(reach))
    if bits < 8:
        raise InputError(
            f"mesh and image: the mesh reaches {reach:.3g} voxels from the image's origin; are "
            "its points in mm?"
        )
    return bits


def channel_grid(content: Content, points: Floats) -> SamplingGrid:
    """`sampling_grid` of all channels of a content: sums of the first, of all channels' squares,
    and of the others.

    With a region, the last sums count 1 for each voxel outside it and -1 for each inside.

    Raises
    ------
    InputError
        As for `sampling_grid`.
    """
    if content.is_plain and content.region is None:
        return sampling_grid(content.image, points)
    n_channels, n, region = content.n_channels, content.image.ndim, content.region
    shape = (1,) * (3 - n) + content.image.shape
    _check_grid(shape, n_channels + 2)
    inside = None if region is None else region.inside.reshape(shape)

    def channels(first: int, stop: int) -> list[NDArray]:
        """All channels in some planes."""
        part = (slice(first, stop),) if n == 3 else ()
        return [
            content.channel(number, part).reshape(-1, *shape[1:]) for number in range(n_channels)
        ]

    if content.is_plain:
        grid = sampling_grid(content.image, points)
        shift, bits, is_short = grid.shift, grid.bits, grid.prefix.dtype == np.int32
    else:
        grid, shift = None, 0.0
        bits = grid_bits(content.image, points)
        # No channel's sums are larger than those of the squares of its whole numbers.
        largest = over_slabs(
            lambda a, b: _squares(channels(a, b)).sum(axis=-1).max(),
            shape[0],
            n_channels * prod(shape),
        )
        is_short = max(largest) < 2**31
    n_sums = (2 if grid is not None else n_channels + 1) + (inside is not None)
    prefix = np.zeros(
        (*shape[:2], shape[2] + 1, n_sums), dtype=np.int32 if is_short else np.float64
    )

    def fill(first: int, stop: int) -> None:
        sums = prefix[first:stop]
        if grid is not None:
            sums[..., :2] = grid.prefix[first:stop]
        part = channels(first, stop) if grid is None else []
        rows = [part[0], _squares(part), *part[1:]] if grid is None else []
        rows += [] if inside is None else [np.where(inside[first:stop], np.int8(-1), np.int8(1))]
        for number, each in enumerate(rows, n_sums - len(rows)):
            np.cumsum(each, axis=2, out=sums[:, :, 1:, number], dtype=prefix.dtype)

    over_slabs(fill, shape[0], prefix.size)
    return SamplingGrid(prefix, bits, shift, n_channels)


def _squares(values: Sequence[NDArray[np.int32]]) -> Floats:
    """Squares of channels, summed over the channels."""
    return np.asarray(sum(part.astype(np.float64) ** 2 for part in values))


def _check_grid(shape: Sequence[int], n_sums: int) -> None:
    """Raise InputError if prefix sums do not fit into memory: 64 bits each, and as much while
    they are computed.
    """
    n_voxels = prod(shape)
    what = f"image: {n_sums} sums of {' x '.join(map(str, shape))} voxels"
    check_memory(
        SUM_BYTES * n_sums * n_voxels, what, "crop the image, or resample it to larger voxels"
    )


def to_ticks(index: Floats, grid: SamplingGrid) -> Ints:
    """Fixed-point coordinates, (N, 3) int64, of index coordinates (N, n); 2-D gets a leading 0."""
    ticks = np.zeros((len(index), 3), dtype=np.int64)
    ticks[:, 3 - index.shape[1] :] = np.rint(index * 2.0**grid.bits).astype(np.int64)
    return ticks


def from_ticks(ticks: Ints, grid: SamplingGrid, n: int) -> Floats:
    """Index coordinates, (N, n) float64, of fixed-point ones (N, 3); exact."""
    return ticks[:, 3 - n :].astype(np.float64) * 2.0**-grid.bits


def check_orientations(image: Image, ticks: Ints, cells: Ints) -> None:
    """Raise InputError unless every cell, positive in the world, is positive on the fixed-point
    grid, too.
    """
    hand = 1 if np.linalg.det(image.affine[:-1, :-1]) > 0 else -1
    wrong = np.flatnonzero(orientations(ticks, cells) != hand)
    if len(wrong):
        raise InputError(
            f"mesh: {len(wrong)} cells are flat or inverted to within a millionth of a voxel, "
            "such as "
            f"{wrong[:5].tolist()}; remove or repair them before sampling"
        )


def orientations(ticks: Ints, cells: Ints) -> Ints:
    """Sign of each cell's volume in index space, (M,) int64 in {-1, 0, 1}; exact."""
    return _orientations(ticks, np.ascontiguousarray(cells, dtype=np.int64))


def moment_sums(
    grid: SamplingGrid,
    ticks: Ints,
    cells: Ints,
    sides: Facets | None = None,
) -> Floats:
    """Voxel count, sum of (h - shift) and of its square over each cell, (M, 3) float64; with more
    channels, (M, D).

    They are additive: the sums of a set of cells are the sum of their rows. Counts are exact whole
    numbers. `sides` are the cells' facets, if already known.
    """
    sides = facets(cells) if sides is None else sides
    n_sums = grid.prefix.shape[3] + 1
    fluxes, sums = np.empty((len(sides.nodes), 1, n_sums)), np.empty((len(cells), n_sums))
    work = _Fluxes(fluxes, ticks, np.ascontiguousarray(sides.nodes), volume_of(grid))
    run(_fill_fluxes, -(-len(fluxes) // CELLS_PER_CHUNK), work, len(fluxes))
    summed = _Sums(sums, fluxes[:, 0], sides.of_cell, sides.sign, _hand(ticks, cells))
    run(_fill_sums, -(-len(sums) // CELLS_PER_CHUNK), summed, len(sums))
    return sums


def _hand(ticks: Ints, cells: Ints) -> int:
    """Sign of the first cell's volume in index space, which all cells of a valid mesh share."""
    return int(_orientations(ticks, np.ascontiguousarray(cells[:1], dtype=np.int64))[0])


# Kernels.


class Volume(NamedTuple):
    """A sampling grid for kernels: prefix sums of 32 or 64 bits, with an empty array for the
    other kind.
    """

    long: Floats4
    short: Shorts4
    is_short: bool
    bits: int


def volume_of(grid: SamplingGrid) -> Volume:
    """The volume of a grid."""
    return _volume(grid.prefix, grid.bits)


def _volume(prefix: NDArray, bits: int) -> Volume:
    is_short, nothing = prefix.dtype == np.int32, np.zeros((1, 1, 1, prefix.shape[3]))
    return Volume(
        nothing if is_short else prefix,
        prefix if is_short else nothing.astype(np.int32),
        is_short,
        bits,
    )


class _Filling(NamedTuple):
    """The sums to fill in, and their inputs."""

    volume: Volume
    data: Floats3  # prefix sums of 64 bits, or one empty voxel if they have 32
    single: Singles3  # prefix sums of 32 bits, or one empty voxel
    is_single: bool  # True if they have 32 bits
    shift: float


@unit
def _fill_prefix(work: _Filling, i: int) -> None:
    if work.volume.is_short:
        _fill_rows(work.volume.short, work, i)
    else:
        _fill_rows(work.volume.long, work, i)


@helper
def _fill_rows(prefix: NDArray, work: _Filling, i: int) -> None:
    n_k = prefix.shape[2] - 1
    for j in range(prefix.shape[1]):
        first, second = 0.0, 0.0
        for k in range(n_k):
            prefix[i, j, k, 0] = first
            prefix[i, j, k, 1] = second
            h = (float(work.single[i, j, k]) if work.is_single else work.data[i, j, k]) - work.shift
            first += h
            second += h * h
        prefix[i, j, n_k, 0] = first
        prefix[i, j, n_k, 1] = second


@njit(cache=True)
def dot_sign(n: tuple, d: tuple) -> int:
    """Exact sign of n . d, with |n| < 2**60 and |d| < 2**30: the products need up to 90 bits.

    Each n is split into a high part and 30 low bits, and the two dot products are added with carry.
    """
    mask = (1 << 30) - 1
    low = dot((n[0] & mask, n[1] & mask, n[2] & mask), d)
    high = dot((n[0] >> 30, n[1] >> 30, n[2] >> 30), d) + (low >> 30)
    if high > 0:
        return 1
    if high < 0:
        return -1
    return 1 if (low & mask) > 0 else 0


@njit(cache=True)
def cell_orientation(ticks: NDArray, cells: NDArray, cell: int) -> int:
    """Sign of a cell's volume in index space; exact."""
    a, b, c = cells[cell, 0], cells[cell, 1], cells[cell, 2]
    n = cross(difference(ticks, b, a), difference(ticks, c, a))
    if cells.shape[1] == 3:
        return 1 if n[0] > 0 else (-1 if n[0] < 0 else 0)
    return dot_sign(n, difference(ticks, cells[cell, 3], a))


@njit(cache=True)
def _orientations(ticks: NDArray, cells: NDArray) -> NDArray:
    signs = np.empty(len(cells), dtype=np.int64)
    for cell in range(len(cells)):
        signs[cell] = cell_orientation(ticks, cells, cell)
    return signs


@njit(cache=True)
def _exact_edge_threshold(cut: float, p0: int, p1: int, d0: int, d1: int, bits: int, i: int) -> int:
    """The first voxel along axis 1, on line i of axis 0, on or beyond the edge from p along d;
    `cut` is near it.
    """
    threshold = np.int64(np.rint(cut))
    if ((threshold << bits) - p1) * d0 < ((i << bits) - p0) * d1:
        threshold += 1
    return int(threshold)


@njit(cache=True)
def _exact_facet_threshold(
    n: tuple, a: tuple, bits: int, i: int, j: int, low: int, high: int
) -> int:
    """The first voxel in [low, high] of row (i, j) on or above the facet through a with normal
    n, n[2] > 0.
    """
    d0, d1 = (i << bits) - a[0], (j << bits) - a[1]
    while low < high:
        middle = (low + high) >> 1
        if dot_sign(n, (d0, d1, (middle << bits) - a[2])) >= 0:
            high = middle
        else:
            low = middle + 1
    return low


@njit(cache=True)
def _by_first_axis(a: tuple, b: tuple, c: tuple) -> tuple:
    """Three places in the order of their first coordinates."""
    if b[0] < a[0]:
        a, b = b, a
    if c[0] < b[0]:
        b, c = c, b
        if b[0] < a[0]:
            a, b = b, a
    return a, b, c


# In registers: with six more channels a facet takes 180 ns, not 218 (with 40 rows 400, not 533).
@njit(cache=True)
def _with_row(more: tuple, prefix: NDArray, i: int, j: int, k: int, n_more: int) -> tuple:
    """Add one row to the sums of up to six more channels."""
    s, t, u, v, w, x = more
    s += prefix[i, j, k, 2]
    if n_more > 1:
        t += prefix[i, j, k, 3]
    if n_more > 2:
        u += prefix[i, j, k, 4]
    if n_more > 3:
        v += prefix[i, j, k, 5]
    if n_more > 4:
        w += prefix[i, j, k, 6]
    if n_more > 5:
        x += prefix[i, j, k, 7]
    return s, t, u, v, w, x


@njit(cache=True)
def triangle_flux(
    ticks: NDArray,
    nodes: tuple,
    bits: int,
    prefix: NDArray,
    scatter: tuple | None,
    out: NDArray,
    place: tuple,
) -> None:
    """Flux of the triangle of three nodes: sums of k and of each P(k) over the rows that cross it.

    It is positive if the triangle, with its nodes as listed, faces up the last axis, and is written
    to out[p, q, :], where `place` is (p, q), with one entry more than `prefix` has. If `scatter` is
    an array of steps and a change, the change, signed like the flux, is added to the steps at each
    crossing instead. All is one function, as its loops share most of their numbers.
    """
    (node_a, node_b, node_c), (p, q) = nodes, place
    n_more = out.shape[2] - 3
    out[p, q, :] = 0.0
    n = cross(difference(ticks, node_b, node_a), difference(ticks, node_c, node_a))
    if n[2] == 0:  # it is parallel to the rows, so none crosses it
        return
    sign = 1 if n[2] > 0 else -1
    n = (sign * n[0], sign * n[1], sign * n[2])
    # With corners in the order of axis 0, each line has one cut on the long edge a-c, the other on
    # a-b, then on b-c.
    a, b, c = _by_first_axis(row(ticks, node_a), row(ticks, node_b), row(ticks, node_c))
    n_i, n_j, n_k, scale = prefix.shape[0], prefix.shape[1], prefix.shape[2] - 1, 2.0**-bits
    first, last = max(-((-a[0]) >> bits), 0), min(-((-c[0]) >> bits), n_i)
    middle = min(max(-((-b[0]) >> bits), first), last)
    # The facet cuts row (i, j) at a2 + slope0 (i - a0) + slope1 (j - a1), with terms no larger than
    # `size`.
    slope0, slope1 = -(n[0] / n[2]), -(n[1] / n[2])
    at = (a[0] * scale, a[1] * scale, a[2] * scale)
    size = abs(slope0) * (c[0] - a[0]) + abs(slope1) * (abs(b[1] - a[1]) + abs(c[1] - a[1]))
    # voxels: rounding of about 20 operations in double precision, and a floor, chosen
    error = 1e-9 + 4e-15 * scale * size
    margin = 0.5 - error if error < 0.25 else -1.0
    lowest, highest = min(a[2], b[2], c[2]) >> bits, -((-max(a[2], b[2], c[2])) >> bits)
    zero = np.int64(0) * prefix[0, 0, 0, 0]  # of 64 bits for integer sums, in plain Python, too
    count, sum_1, sum_2 = 0, zero, zero
    more = (zero, zero, zero, zero, zero, zero)
    long0, long1 = c[0] - a[0], c[1] - a[1]
    long_slope = scale * (long1 / long0)
    for part in range(2):
        u, v, begin, end = (a, b, first, middle) if part == 0 else (b, c, middle, last)
        d0, d1 = v[0] - u[0], v[1] - u[1]
        slope, base = scale * (d1 / max(d0, 1)), scale * u[1]
        for i in range(begin, end):
            # Computing both cuts first, and exact ones in a call, takes two thirds of the time.
            cut_1, cut_2 = (
                at[1] + ((i << bits) - a[0]) * long_slope,
                base + ((i << bits) - u[0]) * slope,
            )
            up_1, up_2 = np.ceil(cut_1), np.ceil(cut_2)
            one: Any = np.int64(up_1)
            other: Any = np.int64(up_2)
            if abs(up_1 - cut_1 - 0.5) > EDGE_MARGIN:
                one = _exact_edge_threshold(cut_1, a[0], a[1], long0, long1, bits, i)
            if abs(up_2 - cut_2 - 0.5) > EDGE_MARGIN:
                other = _exact_edge_threshold(cut_2, u[0], u[1], d0, d1, bits, i)
            line = at[2] + slope0 * (i - at[0])
            for j in range(max(min(one, other), 0), min(max(one, other), n_j)):
                cut = line + slope1 * (j - at[1])
                up = np.ceil(cut)
                k: Any = np.int64(up)
                if abs(up - cut - 0.5) > margin:
                    k = _exact_facet_threshold(n, a, bits, i, j, lowest, highest)
                k = min(max(k, 0), n_k)
                if scatter is None:  # numba compiles only the branch taken
                    count += k
                    sum_1 += prefix[i, j, k, 0]
                    sum_2 += prefix[i, j, k, 1]
                    if n_more > 0:
                        more = _with_row(more, prefix, i, j, k, n_more)
                    for d in range(6, n_more):
                        out[p, q, 3 + d] += sign * prefix[i, j, k, 2 + d]
                else:
                    scatter[0][i, j, k] += sign * scatter[1]
    out[p, q, 0], out[p, q, 1], out[p, q, 2] = (
        float(sign * count),
        float(sign * sum_1),
        float(sign * sum_2),
    )
    for d in range(min(n_more, 6)):
        out[p, q, 3 + d] = float(sign * more[d])


@njit(cache=True)
def segment_flux(
    ticks: NDArray,
    nodes: tuple,
    bits: int,
    prefix: NDArray,
    scatter: tuple | None,
    out: NDArray,
    place: tuple,
) -> None:
    """Flux of the segment of two nodes of a 2-D mesh, which lies along axes 1 and 2; like
    `triangle_flux`.
    """
    (node_a, node_b), (p, q) = nodes, place
    n_more = out.shape[2] - 3
    for d in range(3 + n_more):
        out[p, q, d] = 0.0
    a, b = row(ticks, node_a), row(ticks, node_b)
    if a[1] == b[1]:
        return
    sign = -1 if b[1] > a[1] else 1  # it faces to the right of a -> b
    if b[1] < a[1]:
        a, b = b, a
    scale = 2.0**-bits
    slope, base = scale * ((b[2] - a[2]) / (b[1] - a[1])), scale * a[2]
    n_k = prefix.shape[2] - 1
    count, sum_1, sum_2 = 0, 0.0, 0.0
    for j in range(max(-((-a[1]) >> bits), 0), min(-((-b[1]) >> bits), prefix.shape[1])):
        cut = base + ((j << bits) - a[1]) * slope
        up = np.ceil(cut)
        k: Any = np.int64(up)
        if abs(up - cut - 0.5) > EDGE_MARGIN:
            k = _exact_edge_threshold(cut, a[1], a[2], b[1] - a[1], b[2] - a[2], bits, j)
        k = min(max(k, 0), n_k)
        if scatter is None:
            count += k
            sum_1 += prefix[0, j, k, 0]
            sum_2 += prefix[0, j, k, 1]
            for d in range(n_more):
                out[p, q, 3 + d] += sign * prefix[0, j, k, 2 + d]
        else:
            scatter[0][0, j, k] += sign * scatter[1]
    out[p, q, 0], out[p, q, 1], out[p, q, 2] = float(sign * count), sign * sum_1, sign * sum_2


@njit(cache=True)
def facet_flux(
    ticks: NDArray,
    nodes: NDArray,
    facet: int,
    bits: int,
    prefix: NDArray,
    scatter: tuple | None,
    out: NDArray,
    p: int,
) -> None:
    """Write the flux of one of the facets `nodes` (F, n) to out[p, 0, :]; see `triangle_flux`."""
    a, b = nodes[facet, 0], nodes[facet, 1]
    if nodes.shape[1] == 2:
        segment_flux(ticks, (a, b), bits, prefix, scatter, out, (p, 0))
    else:
        triangle_flux(ticks, (a, b, nodes[facet, 2]), bits, prefix, scatter, out, (p, 0))


class _Fluxes(NamedTuple):
    """The fluxes to fill in, and their inputs."""

    fluxes: Floats3
    ticks: Ints2
    nodes: Ints2
    volume: Volume


@unit
def put_flux(
    out: Floats3, p: int, q: int, ticks: Ints2, a: int, b: int, c: int, volume: Volume
) -> None:
    """Write the flux of the facet (a, b, c), or (a, b) if c < 0, to out[p, q, :]."""
    if c < 0:
        if volume.is_short:
            segment_flux(ticks, (a, b), volume.bits, volume.short, None, out, (p, q))
        else:
            segment_flux(ticks, (a, b), volume.bits, volume.long, None, out, (p, q))
    elif volume.is_short:
        triangle_flux(ticks, (a, b, c), volume.bits, volume.short, None, out, (p, q))
    else:
        triangle_flux(ticks, (a, b, c), volume.bits, volume.long, None, out, (p, q))


@unit
def _fill_fluxes(work: _Fluxes, chunk: int) -> None:
    nodes = work.nodes
    for facet in range(chunk * CELLS_PER_CHUNK, min((chunk + 1) * CELLS_PER_CHUNK, len(nodes))):
        c = nodes[facet, 2] if nodes.shape[1] == 3 else -1
        put_flux(
            work.fluxes, facet, 0, work.ticks, nodes[facet, 0], nodes[facet, 1], c, work.volume
        )


class _Sums(NamedTuple):
    """The sums to fill in, and their inputs."""

    sums: Floats2
    fluxes: Floats2
    of_cell: Ints2
    sign: Ints2
    hand: int


@unit
def _fill_sums(work: _Sums, chunk: int) -> None:
    sums, fluxes, of_cell, sign = work.sums, work.fluxes, work.of_cell, work.sign
    for cell in range(chunk * CELLS_PER_CHUNK, min((chunk + 1) * CELLS_PER_CHUNK, len(sums))):
        for d in range(sums.shape[1]):
            total = 0.0
            for k in range(of_cell.shape[1]):
                total += sign[cell, k] * fluxes[of_cell[cell, k], d]
            is_rounding = d > 0 and sums[cell, 0] <= 0.0  # residue of a cell without voxels
            sums[cell, d] = 0.0 if is_rounding else work.hand * total


@entry
def _scatter_changes(
    steps: Ints3, change: Ints1, ticks: Ints2, nodes: Ints2, bits: int, rows: Ints4
) -> None:
    unused = np.empty((1, 1, 3))
    for facet in range(len(nodes)):
        facet_flux(ticks, nodes, facet, bits, rows, (steps, change[facet]), unused, 0)


@entry
def _fill_owners(
    owner: Ints3, low: Floats1, high: Floats1, steps: Ints3, volume: Singles3, has_range: bool
) -> int:
    """Find the cell of each voxel, and each cell's range, from the steps along rows, in half the
    time of passes.

    Also count the voxels in several cells: if there are any, the other results are invalid.
    """
    n_shared = 0
    for i in range(volume.shape[0]):
        for j in range(volume.shape[1]):
            total = 0
            for k in range(volume.shape[2]):
                total += steps[i, j, k]
                cell = (total & (ONE_CELL - 1)) - 1
                owner[i, j, k] = cell
                if total >= 2 * ONE_CELL:
                    n_shared += 1
                elif cell >= 0 and has_range:
                    h = float(volume[i, j, k])
                    low[cell], high[cell] = min(low[cell], h), max(high[cell], h)
    return n_shared


class _Cells(NamedTuple):
    """Cells and their facets on the sampling grid."""

    ticks: Ints2
    cells: Ints2
    nodes: Ints2  # nodes of the facets
    of_cell: Ints2  # its facets
    # change of the number of times a row is in the cell as it passes up through each facet
    signs: Ints2
    bits: int


@helper
def _span(mesh: _Cells, cell: int, axis: int, n: int) -> tuple:
    """The first and last of the n voxels along an axis where a cell's facets can cross rows."""
    ticks, cells, bits = mesh.ticks, mesh.cells, mesh.bits
    low = high = ticks[cells[cell, 0], axis]
    for k in range(1, cells.shape[1]):
        low, high = min(low, ticks[cells[cell, k], axis]), max(high, ticks[cells[cell, k], axis])
    return min(max(low >> bits, 0), n), min(max(-((-high) >> bits), 0), n)


@entry
def _visit_cells(
    owner: Ints3,
    low: Floats1,
    high: Floats1,
    shared: Ints1,
    mesh: _Cells,
    volume: Singles3,
    steps: Ints3,
    rows: Ints4,
) -> None:
    """Find the voxels of overlapping cells by each cell's own facets, in four times the time.

    `owner` is -1 before, and `steps` is 0 before and after.
    """
    unused = np.empty((1, 1, 3))
    n_i, n_j, n_k = volume.shape
    for cell in range(len(mesh.cells) - 1, -1, -1):
        for k in range(mesh.cells.shape[1]):
            change = steps, mesh.signs[cell, k]
            facet_flux(
                mesh.ticks, mesh.nodes, mesh.of_cell[cell, k], mesh.bits, rows, change, unused, 0
            )
        first_i, last_i = _span(mesh, cell, 0, n_i)
        first_j, last_j = _span(mesh, cell, 1, n_j)
        first_k, last_k = _span(mesh, cell, 2, n_k)
        for i in range(first_i, min(last_i + 1, n_i)):
            for j in range(first_j, min(last_j + 1, n_j)):
                is_in = 0
                for k in range(first_k, last_k + 1):
                    is_in += steps[i, j, k]
                    steps[i, j, k] = 0
                    if is_in == 0 or k == n_k:
                        continue
                    if owner[i, j, k] >= 0:
                        shared[1], shared[2], shared[3], shared[4], shared[5] = (
                            i,
                            j,
                            k,
                            cell,
                            owner[i, j, k],
                        )
                    owner[i, j, k] = cell
                    h = float(volume[i, j, k])
                    low[cell], high[cell] = min(low[cell], h), max(high[cell], h)
