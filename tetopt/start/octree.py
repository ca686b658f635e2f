"""Initial meshes with nodes where the image has content: an octree of the box (in 2-D a quadtree).

The box is divided into a few equal blocks as near to cubes as it allows, and blocks into 2^n again and again, first
those that hold the largest sum of squared deviations from their mean: that is the error E_D of a mesh with one value a
block, so what is left is spread evenly over the leaves. Noise has no say: of each block's sum, what noise of the
image's own level would leave is taken off, so that a noisy but uniform region stays coarse. Neighbouring leaves differ
by one level at most, also across edges and corners (2:1), and nodes are put at their corners and centres: a lattice of
body-centred cubes that coarsens by steps of two, joined by Delaunay. Limits on sizes (`tetopt.Sizes`) have the first
say: blocks with longer edges are divided, whatever they hold, and those whose halves would be too short are not.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from tetopt.errors import InputError
from tetopt.geometry.simplex import volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.start.clip import clipped
from tetopt.start.delaunay import delaunay
from tetopt.start.lattice import near_cubes
from tetopt.start.sizes import DIAGONAL, NO_BOUND, SHORT, Sizes
from tetopt.target.content import Content, plain

# Undivided blocks' nodes, of those wanted: tried in turn.
ROOTS = tuple(1.0 / k for k in (60, 45, 30, 20, 12, 8, 6, 4, 2.5, 1.6, 1))
ENOUGH = 0.05  # of the nodes wanted: a miss that ends the trials
SMALLEST = 2.0  # voxels along a leaf's edge, at least, where voxels are smallest; a quarter where they are largest
SPREAD = 1e-3  # of the image's variance: what every voxel counts besides, so that any number of nodes is reached
SPREAD_OF_NOISE = 0.03  # of the noise's: so much that chance does not decide which noise is divided first
MARGIN = 2.0  # standard deviations of a sum of squared noise that are not taken for content
STEPS = 60  # of the bisection for the number of nodes
TIE_BREAKS = (1e-5, 1e-4, 1e-3)  # see `delaunay`, tried in turn: with 1e-7, 2 of 88,661 cells were flat
FLAT = 1e-6  # of the mean volume: such a cell is flat
TIE = 0.05  # of a block's error: what decides between blocks that are alike
MISS = 0.1  # of the nodes wanted: a larger miss is an error
AGAIN = 5  # octrees tried for the number of nodes within a mask
MOST_ANYHOW = 5000  # nodes that even images of few voxels may get
FEW = 40  # nodes, about what one block more or less makes
NEAR = 0.002  # of the nodes wanted: a miss that is good enough


def octree(image: Image | Content, nodes: int, sizes: Sizes | None = None) -> Mesh:
    """A graded mesh of the image's box, or of the mask's region.

    Parameters
    ----------
    image : Image or Content
        Its box, index -0.5 to shape - 0.5 along each axis, is covered exactly; or, with a mask, its region up to the
        surface, on which nodes are put.
    nodes : int
        Wanted number of nodes. The octree that comes nearest has a few per cent more or less, of few a few dozen.
    sizes : Sizes, optional
        Limits on the blocks' edges.

    Returns
    -------
    Mesh
        Triangles or tetrahedra: conforming, positively oriented, every node used, the volume that of the box.

    Raises
    ------
    InputError
        More nodes than leaves of 2 voxels, or of the smallest size, can have, or fewer than the largest sizes need; or
        intensities whose squares overflow.
    """
    wanted = plain(image)
    shape = " x ".join(map(str, wanted.image.shape))
    limits = "" if sizes is None or sizes == Sizes() else " and these limits on sizes"
    asked = _limits(wanted, nodes, sizes)
    needed = _needed(wanted, asked)
    if needed > (1.0 + MISS) * nodes + FEW:
        raise InputError(
            f"octree: {nodes} nodes are too few for {shape} voxels{limits}: they need {needed:.4g} or more; ask for as "
            "many, or allow longer edges"
        )
    mesh = _built(wanted, nodes, asked)
    count = len(mesh.points)
    if is_near(count, nodes) or wanted.region is not None:  # exchanges take care of the rest
        return mesh
    raise InputError(
        f"octree: {nodes} nodes are too {'many' if count < nodes else 'few'} for {shape} voxels{limits}: the nearest "
        f"octree found has {count}; ask for about as many, or for a uniform mesh"
    )


class _Limits(NamedTuple):
    """On the blocks: edges, mm, and how many of a size lie beside one another."""

    most: float
    bound: NDArray[np.float32] | None  # the largest at each voxel
    smallest: float  # has the last word
    rings: int


def _limits(wanted: Content, nodes: int, sizes: Sizes | None) -> _Limits:
    """What the number of nodes and the sizes ask for; InputError where they cannot be."""
    image = wanted.image
    n = image.ndim
    fewest = 2**n + 1
    if not (isinstance(nodes, int | np.integer) and nodes >= fewest):
        raise InputError(f"octree: expected a whole number of nodes, {fewest} or more in {n}-D, got {nodes!r}")
    if nodes > max(image.data.size, MOST_ANYHOW):
        shape = " x ".join(map(str, image.shape))
        raise InputError(f"octree: {nodes} nodes are too many for {shape} voxels; ask for fewer")
    sizes = (Sizes() if sizes is None else sizes).prepared(n)
    longest_side = float((image.spacing * image.shape).max())
    if sizes.smallest > longest_side:
        raise InputError(f"size_min: {sizes.smallest:g} mm is longer than the box, {longest_side:.4g} mm")
    smallest = sizes.smallest / SHORT[n]
    most = max(sizes.at_most(image, nodes, wanted.volume) / DIAGONAL[n], smallest)
    bound = sizes.on_voxels(image)
    if bound is not None:
        if bound.min() >= NO_BOUND:
            raise InputError("sizing: no voxel above 0 lies in the image's box; do both lie in the same world mm?")
        bound = np.maximum(bound / DIAGONAL[n], smallest).astype(np.float32)
    return _Limits(most, bound, smallest, int(np.ceil(1.0 / sizes.gradation - 1e-9)))


def _needed(wanted: Content, asked: _Limits) -> float:
    """A lower bound of the nodes that the limits ask for: two for each block as large as it may be."""
    n = wanted.image.ndim
    if asked.bound is None:
        return 2.0 * wanted.volume / asked.most**n
    with np.errstate(over="ignore"):
        bound = asked.bound if wanted.region is None else asked.bound[wanted.region.inside]
        edges = np.minimum(bound, asked.most).astype(np.float64)
        return 2.0 * wanted.image.voxel_volume * float((edges**-n).sum())


def is_near(count: int, nodes: int) -> bool:
    """Whether a number of nodes is about the one wanted."""
    return abs(count - nodes) <= max(MISS * nodes, FEW)


def nearest_octree(image: Image | Content, nodes: int, sizes: Sizes | None = None) -> Mesh:
    """As `octree`, but with any number of nodes, if the image or the limits on sizes allow no nearer one."""
    return _built(plain(image), nodes, _limits(plain(image), nodes, sizes))


def _built(wanted: Content, nodes: int, asked: _Limits) -> Mesh:
    """The octree within the limits that has nearly as many nodes as wanted, cut off at the mask's surface."""
    if wanted.region is None:
        return _of_box(wanted, nodes, asked)
    # The surface takes away nodes and adds others; how many is seen afterwards.
    best, asked_for, fewest = None, nodes, 2**wanted.image.ndim + 1
    for attempt in range(AGAIN):
        try:
            mesh = clipped(_of_box(wanted, asked_for, asked), wanted.image, wanted.region)
        except InputError:  # thinner than the cells
            if best is None and attempt == AGAIN - 1:
                raise
            asked_for *= 2
            continue
        count = len(mesh.points)
        if best is None or abs(count - nodes) < abs(len(best.points) - nodes):
            best = mesh
        if abs(count - nodes) <= ENOUGH * nodes:
            break
        asked_for = int(np.clip(asked_for * nodes / count, max(fewest, asked_for / 2), 2 * asked_for))
    assert best is not None
    return best


def _of_box(wanted: Content, nodes: int, asked: _Limits) -> Mesh:
    image = wanted.image
    if _needed(wanted, asked) > max(image.data.size, MOST_ANYHOW):
        raise InputError(
            "sizes: so short edges are asked for that cells are below voxels, and see nothing; allow longer ones"
        )
    roots, divided = _closest(wanted, nodes, asked)
    index = _places(divided, roots) / np.array(roots) * image.shape - 0.5
    points = image.to_world(index)
    for tie_break in TIE_BREAKS:
        cells = delaunay(index, image.affine, tie_break)
        if cells is not None and (size := volumes(points, cells)).min() > FLAT * size.mean():
            return Mesh(points, cells)
    raise InputError(f"octree: Delaunay left flat cells on {len(index)} nodes; ask for another number")


class _Voxels(NamedTuple):
    """What blocks are summed over."""

    sums: list[NDArray[np.float64]]  # of each voxel: 1, all channels' squares, and each channel; 0 outside of the mask
    outside: NDArray[np.float64] | None  # 1 for each voxel outside of the mask
    noise: float  # variance
    step: float  # squared difference between the two sides of the mask's surface


def _voxels(wanted: Content) -> _Voxels:
    """The channels less their means, at most 1: numbers of nodes do not depend on the unit of intensity."""
    channels = [v.astype(np.float64) - float(np.mean(v, dtype=np.float64)) for v in wanted.values]
    scale = max(float(np.abs(channel).max()) for channel in channels)
    if not np.isfinite(scale * scale * channels[0].size):
        raise InputError(f"image: squares of deviations up to {scale:.3g} overflow; rescale it first")
    scale = scale or 1.0
    inside = np.ones(wanted.image.shape) if wanted.region is None else wanted.region.inside.astype(np.float64)
    channels = [inside * channel / scale for channel in channels]
    square = sum(channel * channel for channel in channels)
    step = wanted.wrong_side / scale**2
    # The noise is that of values at most 1, too: its estimate rounds differently otherwise.
    noise = wanted._replace(values=np.stack(channels)).noise
    return _Voxels([inside, square, *channels], None if wanted.region is None else 1.0 - inside, noise, step)


class _Blocks(NamedTuple):
    """The blocks of one level."""

    error: NDArray[np.float64]  # sums of squared deviations less the noise's, and the spread
    is_too_large: NDArray[np.bool_]  # must be divided
    is_wanted: NDArray[np.bool_]  # whether it lies in the mask, in part at least


def _levels(
    image: Image, voxels: _Voxels, roots: tuple[int, ...], bound: NDArray | None, most: float, smallest: float
) -> list[_Blocks]:  # fmt: skip
    """The blocks of each level, the coarsest first; their edges are to be up to `bound` at each voxel, and `most`."""
    edge = image.spacing * image.shape / np.array(roots)
    least = most if bound is None else min(most, float(bound.min()))
    n_levels, n_content = 0, 0  # levels of blocks that exist, and that content may ask for
    while _may_be(edge / 2 ** (n_levels + 1), image.spacing, smallest):
        n_levels, n_content = n_levels + 1, n_content + 1
    while (
        (edge / 2**n_levels).max() > least * (1.0 + 1e-9)
        and (half := edge / 2 ** (n_levels + 1)).min() >= smallest
        and (half / image.spacing).max() >= 1.0
    ):
        n_levels += 1
    variance = voxels.noise
    spread = SPREAD * float(voxels.sums[1].sum() / voxels.sums[0].sum()) + SPREAD_OF_NOISE * variance
    every = voxels.sums if voxels.outside is None else [*voxels.sums, voxels.outside]
    sums = [_blocks(total, np.array(roots) << n_levels, np.add) for total in every]
    longest = np.full(sums[0].shape, most)
    if bound is not None:
        longest = np.minimum(most, _blocks(bound, np.array(roots) << n_levels, np.minimum, NO_BOUND))
    found = []
    for level in range(n_levels, -1, -1):
        count, second, *firsts = sums[: len(voxels.sums)]
        free = np.maximum(count - 1.0, 0.0)
        noise = variance * (free + MARGIN * np.sqrt(2.0 * free))  # a chi-squared sum, and deviations of it
        squares = sum(first**2 for first in firsts)
        error = np.maximum(second - squares / np.maximum(count, 1.0) - noise, 0.0)
        if voxels.outside is not None:
            error += voxels.step * count * sums[-1] / np.maximum(count + sums[-1], 1.0)
        may_be_divided = edge.min() / 2 ** (level + 1) >= smallest
        is_too_large = (longest * (1.0 + 1e-9) < edge.max() / 2**level) & may_be_divided
        is_wanted = count > 0.0 if voxels.outside is not None else np.ones(count.shape, dtype=bool)
        error = (error + spread * count) * _uneven(error.shape) * (level < n_content)
        found.append(_Blocks(error, is_too_large & is_wanted, is_wanted))
        if level > 0:
            half = np.array(count.shape) // 2
            sums = [_blocks(total, half, np.add) for total in sums]
            longest = _blocks(longest, half, np.minimum)
    return found[::-1]


def _may_be(edge: NDArray[np.float64], spacing: NDArray[np.float64], smallest: float) -> bool:
    """Whether blocks of these edges are not too small for the voxels, and as large as asked."""
    voxels = edge / spacing
    return bool(voxels.max() >= SMALLEST and voxels.min() >= 0.25 * SMALLEST and edge.min() >= smallest)


def _uneven(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Factors 1 to 1 + `TIE`, all different: blocks that are alike are divided one after the other, here and there.

    The fractional parts of multiples of the plastic number's powers fill any region evenly (Roberts 2018).
    """
    place = np.stack(np.meshgrid(*[np.arange(s) for s in shape], indexing="ij"), axis=-1)
    return 1.0 + TIE * np.mod(
        place @ np.array([0.8191725133961645, 0.6710436067037893, 0.5497004779019703])[: place.shape[-1]], 1.0
    )


def _blocks(data: NDArray, counts: NDArray[np.int64], total_of: np.ufunc, empty: float = 0.0) -> NDArray:
    """Sums, or minima, over equal blocks: a voxel counts where its centre is; a block without centres is `empty`."""
    for axis, count in enumerate(counts):
        size = data.shape[axis]
        start = np.ceil(np.arange(count) * (size / count) - 0.5).astype(np.int64)
        stop = np.append(start[1:], size)
        total = total_of.reduceat(data, np.minimum(start, size - 1), axis=axis)
        is_empty = np.expand_dims(start == stop, [d for d in range(data.ndim) if d != axis])
        data = np.where(is_empty, empty, total)
    return data


def _closest(wanted: Content, nodes: int, asked: _Limits) -> tuple[tuple[int, ...], list[NDArray[np.bool_]]]:
    """Blocks undivided and those divided, of the octree that has nearly as many nodes as wanted.

    Where many blocks are alike, they are all divided or none, and some numbers cannot be reached from one size of
    undivided blocks: then others are tried, at last the lattice that has the number by itself.
    """
    best: tuple[int, tuple[int, ...], list[NDArray[np.bool_]]] | None = None
    image, voxels = wanted.image, _voxels(wanted)
    most, bound, smallest, rings = asked
    for roots in _roots(image, nodes, most, smallest):
        if (np.array(image.shape) / roots).max() < SMALLEST and best is not None:
            break
        levels = _levels(image, voxels, roots, bound, most, smallest)
        if levels[-1].is_too_large.any():
            continue
        count, divided = _nearest(levels, roots, nodes, rings)
        if best is None or abs(count - nodes) < abs(best[0] - nodes):
            best = count, roots, divided
        if abs(count - nodes) <= ENOUGH * nodes:
            break
    if best is None:
        least = DIAGONAL[image.ndim] * (most if bound is None else min(most, float(bound.min())))
        raise InputError(
            f"sizes: edges of {least:.3g} mm are asked for, but blocks below a voxel ({image.spacing.max():.3g} mm) "
            "see nothing; allow longer ones"
        )
    return best[1:]


def _roots(image: Image, nodes: int, most: float, smallest: float) -> Iterator[tuple[int, ...]]:
    """Numbers of undivided blocks along each axis to try, of edges up to `most`: the largest blocks first."""
    lengths = image.spacing * image.shape
    kind = "bcc" if image.ndim == 3 else "criss-cross"
    coarse = [near_cubes(kind, lengths, max(2**image.ndim + 1, int(nodes * share))) for share in ROOTS]
    edges = [lengths / roots for roots in coarse]
    fit = [e.max() <= most * (1.0 + 1e-9) and e.min() >= smallest for e in edges]
    if not all(fit):
        fewest, finest = np.ceil(lengths / most - 1e-9), lengths / max(smallest, 1e-300)
        yield tuple(int(c) for c in np.maximum(np.minimum(fewest, np.floor(finest * (1.0 + 1e-9))), 1))
    yield from (roots for roots, is_fit in zip(coarse, fit, strict=True) if is_fit)


def _nearest(
    levels: list[_Blocks], roots: tuple[int, ...], nodes: int, rings: int
) -> tuple[int, list[NDArray[np.bool_]]]:
    """The threshold of error above which blocks are divided, by bisection: nodes, and the blocks divided."""
    # A finer level may hold the largest error: noise is taken off the coarser ones, too.
    above = np.concatenate([blocks.error[blocks.error > 0.0] for blocks in levels])
    low, high = (0.5 * float(above.min()), 2.0 * float(above.max())) if len(above) else (0.5, 1.0)
    best, found = -1, []
    for _ in range(STEPS):
        middle = np.sqrt(max(low, 1e-300) * high)
        divided = _divided(levels, middle, rings)
        count = len(_places(divided, roots, [blocks.is_wanted for blocks in levels]))
        if best < 0 or abs(count - nodes) < abs(best - nodes):
            best, found = count, divided
        if abs(count - nodes) <= NEAR * nodes or high <= low * (1.0 + 1e-9):
            break
        low, high = (middle, high) if count > nodes else (low, middle)
    return best, found


def _divided(levels: list[_Blocks], threshold: float, rings: int) -> list[NDArray[np.bool_]]:
    """Which blocks of each level are divided, if those above the threshold or too large are.

    Around a divided block, `rings` blocks of its size exist in every direction: one keeps neighbours within a level.
    """
    divided = [(blocks.error > threshold) | blocks.is_too_large for blocks in levels[:-1]]
    for level in range(len(divided) - 1, 0, -1):
        near = maximum_filter(divided[level], size=2 * rings + 1, mode="nearest")  # these blocks have to exist
        for axis in range(near.ndim):
            near = near.reshape(*near.shape[:axis], -1, 2, *near.shape[axis + 1 :]).any(axis=axis + 1)
        divided[level - 1] |= near
    return divided


def _places(
    divided: list[NDArray[np.bool_]], roots: tuple[int, ...], is_wanted: list[NDArray[np.bool_]] | None = None
) -> NDArray[np.float64]:
    """Corners and centres of the leaves, (N, n), in units of an undivided block; each once, in lexicographic order.

    Only of those leaves that are wanted, by level, where that is given.
    """
    n, depth = len(roots), len(divided)
    corner = np.stack(np.meshgrid(*[[0, 2]] * n, indexing="ij"), axis=-1).reshape(-1, n)
    of_leaf = np.vstack([corner, np.ones((1, n), dtype=np.int64)])  # in halves of a leaf
    exists = np.ones(roots, dtype=bool)
    ticks = []  # in halves of the smallest leaves
    for level in range(depth + 1):
        is_divided = divided[level] if level < depth else np.zeros(exists.shape, dtype=bool)
        is_leaf = exists & ~is_divided
        leaves = np.argwhere(is_leaf if is_wanted is None else is_leaf & is_wanted[level])
        ticks.append(((2 * leaves[:, None, :] + of_leaf) << (depth - level)).reshape(-1, n))
        exists = is_divided
        for axis in range(n):
            exists = np.repeat(exists, 2, axis=axis)
    every = np.concatenate(ticks)
    size = (np.array(roots) << (depth + 1)) + 1
    code = np.unique(np.ravel_multi_index(tuple(every.T), tuple(size)))
    return np.stack(np.unravel_index(code, tuple(size)), axis=-1) / 2.0 ** (depth + 1)
