"""Initial meshes with nodes where the image has detail: an octree of the box (in 2-D a quadtree).

The box is divided into a few equal blocks as near to cubes as possible, and blocks are divided
repeatedly into 2^n, those with the largest sum of squared deviations from their mean first. This
sum is the error E_D of a mesh with one value per block, so the remaining error is spread evenly
over the leaves. The part of each block's sum that noise of the image's strength would cause is
subtracted, so that a noisy but uniform region stays coarse. Neighbouring leaves differ by at most
one division, also across edges and corners (2:1), and nodes lie at their corners and centres: a
lattice of body-centred cubes that coarsens in steps of two, whose cells are templates
(`tetopt.start.leaves`). Sizes (`tetopt.Sizes`) take precedence: blocks with edges longer than
allowed are divided regardless of their content, and those whose halves would be too short are not.
Since blocks halve, a target for the usual edge lies between two block sizes: as many blocks are
divided, here and there, as give the target's number of nodes, and the exchanges of `optimize` do
the rest.

The depth of a block is the number of divisions that lead to it: 0 for the undivided blocks, the
roots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import prod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, plain
from tetopt.contents.domain import Region
from tetopt.contents.smoothing import largest_around
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.start.carve import carve_mesh, part_of
from tetopt.start.clip import clip_cells, hole_numbers, lost_fraction, misfit_of_holes
from tetopt.start.lattice import MAX_NODES, near_cubes
from tetopt.start.leaves import leaf_cells, leaf_nodes
from tetopt.start.sizes import (
    LONGEST_IN_BLOCK,
    NO_BOUND_MM,
    SHORTEST_IN_BLOCK,
    SIZED_OVER_EQUILATERAL,
    USUAL_IN_BLOCK,
    Sizes,
    equilateral_nodes,
)
from tetopt.start.sums import (
    BlockSums,
    Channels,
    block_starts,
    block_sums,
    channels_of,
    halve_totals,
)
from tetopt.system.arrays import Bools, Floats, Ints, whole_number
from tetopt.system.budget import MemoryShortage, at_most, check_memory

# Ratios of the undivided blocks' nodes to the requested number, tried in turn, the largest blocks
# first.
ROOT_FRACTIONS = tuple(1.0 / k for k in (60, 45, 30, 20, 12, 8, 6, 4, 2.5, 1.6, 1))
# Fractions of the requested number of nodes by which an octree may miss it:
BISECTION_MISS = 0.002  # within this, no other threshold is tried;
TRIAL_MISS = 0.05  # within this, no other size of the undivided blocks is tried;
LARGEST_MISS = 0.1  # beyond this it is an error,
LARGEST_MISS_NODES = 40  # unless the difference is so small: about the nodes of one block.
BISECTION_STEPS = 60  # at most, for the threshold, which is then exact to the last bit
TARGET_MISS = 0.25  # excess over the requested nodes at which targets within a mask are enlarged
LIGHTER_TRIALS = 5  # factors tried on targets that force too many nodes within a mask, by counts
MASK_TRIALS = 5  # octrees tried for the number of nodes within a mask
# of a mask's volume, apart from what flat facets cut off; with .01, walls end with a tenth less
MOST_LOST = 0.007
# of nodes, for a mask that loses more: up to 7.6 times, which exchanges remove
FINER_STEPS, FINER_RATIO = 5, 1.5
# of a mask's volume, and of the least that octrees lose: if some in a row lose less than the one
# but more than the other, as of a rough mask, finer cells are no remedy; a single one loses a wall
# by chance, as coarse ones do
SMALL_LOSS, STALLED_FRACTION, STALLED_STEPS = 0.1, 0.9, 2
# of what the first octree loses: if a finer one loses no less, it is not worth its nodes
LESS_LOST = 0.5
ALWAYS_ALLOWED_NODES = 5000  # allowed even on images with fewer voxels
# least edge of a leaf along the smallest voxel edge; a quarter of it along the largest
LEAF_VOXELS = 2.0
# of the image's variance: a base error of each voxel, to reach any number of nodes
SPREAD_OF_VARIANCE = 1e-3
# the same, of the noise's variance, so that chance does not decide which noise is divided first
SPREAD_OF_NOISE = 0.03
NOISE_SIGMAS = 2.0  # standard deviations of a sum of squared noise that do not count as content
# Ratio to a target's blocks, to the n-th power, up to which larger ones stay whole, as a lattice
# seldom fits exactly.
TARGET_SLACK = 0.25
# six cells of four node numbers, assembled and sorted: 600; as many for clipping
OCTREE_NODE_BYTES = 1200.0
BLOCK_FIELD_BYTES = 8.0  # per smallest block and field
# in addition to the sums: targets, the errors of all depths, and half a field during halving
OTHER_FIELDS = 4
# Limit for the summed blocks, whose halves are the smallest leaves that content can cause: 0.5 GB.
# 1024^3 voxels never reach it; with 2048^3 voxels, leaves have at least 4 voxels.
MOST_BLOCKS = 2**24
# processed at a time: half a megabyte per field, which fits into a processor's cache
LAYER_BLOCKS = 2**16
# the plastic number's powers -1 to -3
UNEVEN_FACTORS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)
# of the requested nodes: if there are more leaves, nodes are not counted one by one
SKIPPED_RATIO = 2.0
NODES_OF_LEAF = 9  # its corners and its centre, in 3-D
TIE_SPREAD = 0.05  # of a block's error: decides between blocks that are alike


def octree_mesh(
    image: Image | Content,
    nodes: int,
    sizes: Sizes | None = None,
    is_over: Callable[[], bool] = lambda: False,
) -> Mesh:
    """Make a graded mesh of the image's box, or of the mask's region.

    Blocks of voxels are divided where that lowers E_D most, and filled with conforming cells
    (`tetopt.start.octree`).

    Parameters
    ----------
    image : Image or Content
        The mesh covers its box, index -0.5 to shape - 0.5 along each axis, exactly; with a mask, it
        covers the mask's region, with nodes on its surface.
    nodes : int
        Desired number of nodes. The nearest octree differs by a few per cent, or by a few dozen of
        a small number; it has up to eight times as many where a mask is thinner than its cells.
    sizes : Sizes, optional
        Targets and limits for the blocks' edges.
    is_over : callable, optional
        Once it returns True, no finer octree is tried for a mask's thin walls.

    Returns
    -------
    Mesh
        A conforming, positively oriented mesh without unused nodes, with the volume of the box.

    Raises
    ------
    InputError
        More nodes than leaves of 2 voxels, or of the smallest size, can have; fewer nodes than the
        sizes need; or intensities whose squares overflow.

    See Also
    --------
    lattice_mesh : Make a uniform mesh.
    optimize : Move and exchange the mesh's nodes.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.octree_mesh(image, 300)
    >>> numbers = tetopt.quality(mesh.points, mesh.cells)
    >>> numbers.n_nodes, round(numbers.max_edge / numbers.min_edge, 1)
    (303, 3.3)
    """
    content, nodes = plain(image), whole_number("nodes", nodes)
    limits = _block_limits(content, nodes, sizes)
    _check_enough(content, nodes, sizes, limits)
    mesh = _octree_within(content, nodes, limits, is_over)
    count = len(mesh.points)
    # Exchanges correct the number within a mask or with targets.
    if is_near(count, nodes) or content.inside is not None or limits.target is not None:
        return mesh
    raise InputError(
        f"octree: {nodes} nodes are too {'many' if count < nodes else 'few'} for "
        f"{_input_words(content, sizes)}; the "
        f"nearest octree found has {count}: use about as many, or a uniform mesh"
    )


def _check_enough(content: Content, nodes: int, sizes: Sizes | None, limits: _BlockLimits) -> None:
    by_target = _target_nodes(content, limits)
    least = max(_fewest_nodes(content, limits), by_target)
    if least > (1.0 + LARGEST_MISS) * nodes + LARGEST_MISS_NODES:
        enough = max(_coarsest_nodes(content, nodes, limits), SIZED_OVER_EQUILATERAL * by_target)
        raise InputError(
            f"octree: {nodes} nodes are too few for {_input_words(content, sizes)}, which need at "
            f"least {least:.4g}; "
            f"use {np.ceil(enough):.0f}, or allow longer edges"
        )


def _coarsest_nodes(content: Content, nodes: int, limits: _BlockLimits) -> float:
    """Number of nodes of the coarsest octree within the limits, disregarding targets; in a mask
    an estimate.
    """
    fitting = _fitting_roots(content, nodes, limits)
    blocks = min(([count << depth for count in roots] for roots, depth in fitting), key=prod)
    return (prod(blocks) + prod(each + 1 for each in blocks)) * (
        content.volume / content.image.volume
    )


def _input_words(content: Content, sizes: Sizes | None) -> str:
    """The image and the sizes, in words."""
    limited = "" if sizes is None or sizes == Sizes() else " and these limits on sizes"
    return f"{' x '.join(map(str, content.image.shape))} voxels{limited}"


class _BlockLimits(NamedTuple):
    """Targets and limits for the blocks' edges, mm, and the number of equal blocks side by side."""

    largest: float
    target: NDArray[np.float32] | None  # of the image's shape: usual edge of cells at each voxel
    smallest: float  # takes precedence if both cannot be met
    n_rings: int  # blocks of its size around a divided block, in every direction


def _block_limits(content: Content, nodes: int, sizes: Sizes | None) -> _BlockLimits:
    """The limits from the number of nodes and the sizes; raise InputError if they cannot be met."""
    image = content.image
    n = image.ndim
    fewest = 2**n + 1
    if not (isinstance(nodes, int | np.integer) and nodes >= fewest):
        raise InputError(
            f"octree: expected a whole number of nodes, {fewest} or more in {n}-D, got {nodes!r}"
        )
    if nodes > (most := max(prod(image.shape), ALWAYS_ALLOWED_NODES)):
        shape = " x ".join(map(str, image.shape))
        raise InputError(
            f"octree: {nodes} nodes are too many for {shape} voxels; use at most {most}"
        )
    need = OCTREE_NODE_BYTES * nodes
    check_memory(need, f"octree: {nodes} nodes", lambda room: at_most(room / OCTREE_NODE_BYTES))
    sizes = (Sizes() if sizes is None else sizes).prepared(n)
    longest_side = float((image.spacing * image.shape).max())
    if sizes.smallest > longest_side:
        raise InputError(
            f"smallest: {sizes.smallest:g} mm is longer than the box, {longest_side:.4g} mm"
        )
    smallest = sizes.smallest / SHORTEST_IN_BLOCK[n]
    largest = max(sizes.longest_edge(image, nodes, content.volume) / LONGEST_IN_BLOCK[n], smallest)
    target = _target(image, sizes) if sizes.has_target else None
    return _BlockLimits(largest, target, smallest, int(np.ceil(1.0 / sizes.slope - 1e-9)))


def _target(image: Image, sizes: Sizes) -> NDArray[np.float32]:
    """The target by voxel, mm; raise InputError if a field has none."""
    target = sizes.on_voxels(image)
    if target.min() >= NO_BOUND_MM:
        raise InputError(
            "field: no voxel above 0 lies in the image's box; do both use the same world "
            "coordinates?"
        )
    return target


def nodes_of_sizes(image: Image | Content, sizes: Sizes) -> tuple[int, float]:
    """Number of nodes that targets take (1.5 times those of equilateral cells), and the fraction of
    the mesh with one.

    With any target the number is at least 2^(n + 2), the fewest nodes of any mesh.

    Raises
    ------
    InputError
        Sizes out of range or below voxels, or a field outside the image.
    """
    content = plain(image)
    sizes = sizes.prepared(content.image.ndim)
    if not sizes.has_target:
        return 0, 0.0
    target = _target(content.image, sizes)
    inside = None if content.region is None else content.region.inside
    needed = equilateral_nodes(target, content.image, inside)
    _check_not_below_voxels(content.image, needed)
    has_one = target < NO_BOUND_MM
    enough = max(int(np.ceil(SIZED_OVER_EQUILATERAL * needed)), 2 ** (content.image.ndim + 2))
    return enough, float(np.mean(has_one if inside is None else has_one[inside]))


def _fewest_nodes(content: Content, limits: _BlockLimits) -> float:
    """Lower bound of the nodes that the limits need: two for each block of the largest allowed
    size.
    """
    with np.errstate(over="ignore"):  # a bound of 1e300 mm needs none
        return float(2.0 * content.volume / np.float64(limits.largest) ** content.image.ndim)


def _target_nodes(content: Content, limits: _BlockLimits) -> float:
    """Number of nodes of equilateral cells with the targets' edges; 0 without targets."""
    if limits.target is None:
        return 0.0
    return equilateral_nodes(limits.target, content.image, content.inside)


def _check_not_below_voxels(image: Image, nodes: float) -> None:
    """Raise InputError if there are more nodes than voxels."""
    if nodes > max(prod(image.shape), ALWAYS_ALLOWED_NODES):
        raise InputError(
            "sizes: the requested edges are so short that cells are smaller than voxels; allow "
            "longer ones"
        )


def is_near(count: int, nodes: int) -> bool:
    """True if a mesh of `count` nodes has about as many as requested."""
    return abs(count - nodes) <= max(LARGEST_MISS * nodes, LARGEST_MISS_NODES)


def is_for_walls(count: int, nodes: int) -> bool:
    """True if an initial mesh within a mask has so many nodes as only walls thinner than the
    cells cause.
    """
    return count > (1.0 - LARGEST_MISS) * FINER_RATIO * nodes + LARGEST_MISS_NODES


def nearest_octree(
    image: Image | Content,
    nodes: int,
    sizes: Sizes | None = None,
    is_over: Callable[[], bool] = lambda: False,
) -> Mesh:
    """Like `octree_mesh`, but accept any number of nodes if the image or the sizes allow no
    nearer one.
    """
    content = plain(image)
    return _octree_within(content, nodes, _block_limits(content, nodes, sizes), is_over)


def _octree_within(
    content: Content, nodes: int, limits: _BlockLimits, is_over: Callable[[], bool]
) -> Mesh:
    """The octree within the limits with the nearest number of nodes, clipped at the mask's surface.

    Where that would lose walls thinner than its cells, or tear holes into them, it has more nodes,
    if these keep them or lose, or tear, at most half as much; exchanges remove nodes.
    """
    if content.region is None:
        return _octree_of_box(content, nodes, limits)
    tried = _finer_octrees(content, nodes, limits, content.region, is_over)
    first = next(tried)
    best = min(tried, key=lambda octree: octree.faults, default=first)
    return (best if best.is_worth(first) else first).mesh


class _Tried(NamedTuple):
    """An octree clipped at a mask's surface."""

    mesh: Mesh
    lost: float  # fraction of the mask's volume
    n_torn: int  # `misfit_of_holes`

    @property
    def faults(self) -> tuple[float, int]:
        """What a finer octree may have less of."""
        return self.lost if self.lost > MOST_LOST else 0.0, self.n_torn

    def is_worth(self, first: _Tried) -> bool:
        """True if it has so much less of the faults of the first that it is worth its nodes."""
        is_kept = self.lost <= max(MOST_LOST, LESS_LOST * first.lost)
        return is_kept and (first.lost > MOST_LOST or self.n_torn <= LESS_LOST * first.n_torn)


def _finer_octrees(
    content: Content,
    nodes: int,
    limits: _BlockLimits,
    region: Region,
    is_over: Callable[[], bool],
) -> Iterator[_Tried]:
    """Octrees of ever more nodes, while they lose or tear walls, but less than all before, until
    `is_over` returns True.
    """
    # The leaves that the region touches have about as many nodes, to a few per cent, as the clipped
    # mesh.
    limits, least, n_stalled = _lighter(content, nodes, limits), (np.inf, np.inf), 0
    for step in range(FINER_STEPS + 1):
        ratio = FINER_RATIO**step
        largest = max(limits.largest / ratio ** (1.0 / content.image.ndim), limits.smallest)
        try:
            mesh = _clipped_octree(
                content, round(nodes * ratio), limits._replace(largest=largest), region
            )
        except MemoryShortage:  # or the mesh would depend on free memory
            raise
        except InputError:  # cells would be smaller than voxels
            if step == 0:
                raise
            return
        kept = carve_mesh(
            mesh, content.image, region, content.keeps_components, content.memberships
        )
        numbers = hole_numbers(part_of(mesh, kept.is_kept), content.image, region)
        octree = _Tried(mesh, lost_fraction(mesh, content.image, region), misfit_of_holes(numbers))
        yield octree
        faults = octree.faults
        is_larger = STALLED_FRACTION * least[0] < faults[0] < SMALL_LOSS
        n_stalled = n_stalled + 1 if is_larger or least <= faults < (SMALL_LOSS,) else 0
        # cells that keep the volume but hardly tear less than those before: the mask is rough
        is_rough = faults[0] == 0.0 < least[0] < 1.0 and faults[1] > LESS_LOST * least[1]
        least = min(least, faults)
        if faults == (0.0, 0) or is_rough or n_stalled == STALLED_STEPS or is_over():
            return


def _clipped_octree(content: Content, nodes: int, limits: _BlockLimits, region: Region) -> Mesh:
    """The octree with the nearest number of nodes within a region."""
    image = content.image
    nearest, in_box, fewest = list[Mesh](), nodes, 2**image.ndim + 1
    for trial in range(MASK_TRIALS):
        try:
            tree = _octree_of_box(content, in_box, limits)
        except InputError as error:  # cells would be smaller than voxels
            if not nearest or isinstance(error, MemoryShortage):
                raise
            break
        try:
            mesh = clip_cells(tree, image, region)
        except InputError:  # the region is thinner than the cells
            if not nearest and trial == MASK_TRIALS - 1:
                raise
            in_box *= 2
            continue
        count = len(mesh.points)
        if nearest and abs(count - nodes) >= abs(len(nearest[0].points) - nodes):
            break
        nearest = [mesh]
        if abs(count - nodes) <= LARGEST_MISS * nodes:
            break
        in_box = int(np.clip(in_box * nodes / count, max(fewest, in_box / 2), 2 * in_box))
    return nearest[0]


def _lighter(content: Content, nodes: int, limits: _BlockLimits) -> _BlockLimits:
    """The limits with larger targets, if these alone divide the region's blocks into far more nodes
    than requested.

    A block follows its least target. The factor is found by counts, as meshes take longer.
    """
    if limits.target is None:
        return limits
    roots = next(_root_counts(content, nodes, limits))
    channels = channels_of(content)
    for _ in range(LIGHTER_TRIALS):
        blocks = _blocks_by_depth(content, channels, roots, limits)
        regions = [
            at_depth.is_in_region for at_depth in blocks if at_depth.is_in_region is not None
        ]
        count = len(
            leaf_nodes(_divide_blocks(blocks, np.inf, limits.n_rings), roots, regions).codes
        )
        if count <= (1.0 + TARGET_MISS) * nodes:
            break
        limits = limits._replace(
            target=limits.target * np.float32((count / nodes) ** (1.0 / content.image.ndim))
        )
    return limits


def _octree_of_box(content: Content, nodes: int, limits: _BlockLimits) -> Mesh:
    """The octree of the whole box with the nearest number of nodes."""
    image = content.image
    roots, divided = _best_division(content, nodes, limits)
    joined = leaf_nodes(divided, roots)
    points = image.to_world(joined.places() / np.array(roots) * image.shape - 0.5)
    return Mesh(points, leaf_cells(divided, roots, joined, points))


class _Blocks(NamedTuple):
    """The blocks of one depth."""

    error: Floats  # sums of squared deviations minus the noise's, plus the spread
    is_too_large: Bools  # must be divided
    is_in_region: Bools | None  # at least in part; None without a mask


def _blocks_by_depth(
    content: Content, channels: Channels, roots: tuple[int, ...], limits: _BlockLimits
) -> list[_Blocks]:
    """The blocks of each depth, the coarsest first, with their errors and those that exceed the
    limits.
    """
    image = content.image
    edge = image.spacing * image.shape / np.array(roots)
    depth, n_by_content = _depths(edge, roots, image.spacing, limits)
    # Errors decide on division: the smallest blocks need none, only whether a mask covers them.
    summed = depth if content.inside is not None else max(n_by_content - 1, 0)
    n_blocks, n_summed = (float(prod(roots)) * 2.0 ** (image.ndim * d) for d in (depth, summed))
    n_fields = len(channels.means) + 1 + (content.inside is not None) + OTHER_FIELDS
    need = BLOCK_FIELD_BYTES * (n_summed * n_fields + n_blocks * (limits.target is not None))
    check_memory(need, f"octree: {n_blocks:.3g} blocks", "allow longer edges, or crop the image")
    sums = block_sums(content, channels, np.array(roots) << summed)
    spread = (
        SPREAD_OF_VARIANCE * float(sums.second.sum() / content.n_voxels)
        + SPREAD_OF_NOISE * channels.noise
    )
    target = (
        None if limits.target is None else _least_targets(limits.target, np.array(roots) << depth)
    )
    blocks = []
    for d in range(depth, -1, -1):
        shape = tuple(root << d for root in roots)
        is_too_large = np.broadcast_to(_is_too_large(edge, d, limits), shape)
        if target is not None and d < depth and _may_be_divided(edge, d, limits):
            is_too_large = is_too_large | _divided_for(
                target, float(np.prod(edge)) ** (1 / image.ndim) / 2**d
            )
        is_in_region = None if sums.inside is None else sums.inside > 0.0
        if is_in_region is not None:
            is_too_large = is_too_large & is_in_region
        error = _errors(sums, channels, spread) if d < n_by_content else np.broadcast_to(0.0, shape)
        blocks.append(_Blocks(error, is_too_large, is_in_region))
        if 0 < d <= summed:
            sums = sums.coarser()
        target = None if target is None or d == 0 else halve_totals(target, np.minimum)
    return blocks[::-1]


def _errors(sums: BlockSums, channels: Channels, spread: float) -> Floats:
    """Error of each block: its sum of squared deviations minus the noise's, plus the spread;
    layer by layer.
    """
    errors = np.empty(sums.second.shape)
    others = tuple(slice(0, size) for size in sums.second.shape[1:])
    step = max(LAYER_BLOCKS // prod(errors.shape[1:]), 1)
    for start in range(0, len(errors), step):
        layers = slice(start, min(start + step, len(errors)))
        voxels = sums.voxels(layers)
        count = voxels if sums.inside is None else sums.inside[layers]
        free = np.maximum(count - 1.0, 0.0)
        # A chi-squared sum plus some of its standard deviations.
        noise = channels.noise * (free + NOISE_SIGMAS * np.sqrt(2.0 * free))
        squares = sum(first[layers] ** 2 for first in sums.firsts)
        error = np.maximum(sums.second[layers] - squares / np.maximum(count, 1.0) - noise, 0.0)
        if sums.inside is not None:
            error += channels.step * count * (voxels - count) / np.maximum(voxels, 1.0)
        place = np.ogrid[layers, *others]
        errors[layers] = (error + spread * count) * _uneven_factors(*place)
    return errors


def _may_be_divided(edge: Floats, depth: int, limits: _BlockLimits) -> bool:
    """True if halves of blocks of this depth are long enough; `edge` (n,) are the roots' edges,
    mm.
    """
    return bool(edge.min() / 2 ** (depth + 1) >= limits.smallest)


def _is_too_large(edge: Floats, depth: int, limits: _BlockLimits) -> bool:
    """True if all blocks of this depth must be divided."""
    return bool(limits.largest * (1.0 + 1e-9) < edge.max() / 2**depth) and _may_be_divided(
        edge, depth, limits
    )


def _depths(
    edge: Floats,
    roots: tuple[int, ...],
    spacing: Floats,
    limits: _BlockLimits,
) -> tuple[int, int]:
    """Largest depths to which roots with edges (n,), mm, may be divided at all, and for their
    content.
    """
    n_by_content = 0
    while True:
        half = edge / 2 ** (n_by_content + 1)
        voxels = half / spacing
        if (
            voxels.max() < LEAF_VOXELS
            or voxels.min() < 0.25 * LEAF_VOXELS
            or half.min() < limits.smallest
        ):
            break
        if prod(roots) * 2 ** (len(roots) * n_by_content) > MOST_BLOCKS:
            break
        n_by_content += 1
    depth = n_by_content
    while (edge / 2**depth).max() > _least_edge(limits, len(edge)) * (1.0 + 1e-9):
        half = edge / 2 ** (depth + 1)
        if half.min() < limits.smallest or (half / spacing).max() < 1.0:
            break
        depth += 1
    return depth, n_by_content


def _least_edge(limits: _BlockLimits, n: int) -> float:
    """The least edge, mm, that blocks may need."""
    return min(
        limits.largest,
        np.inf if limits.target is None else float(limits.target.min()) / USUAL_IN_BLOCK[n],
    )


def _divided_for(target: NDArray, edge: float) -> Bools:
    """Mask of the blocks with this edge to divide for their targets for the usual edge of cells,
    mm.

    A divided block has 2^n times the nodes. For k times as many, one in (2^n - 1) / (k - 1) is
    divided, selected by `_uneven_factors`.
    """
    n = target.ndim
    more = (USUAL_IN_BLOCK[n] * edge / target) ** n - 1.0
    fraction = (
        _uneven_factors(*np.ogrid[tuple(slice(0, size) for size in target.shape)]) - 1.0
    ) / TIE_SPREAD
    return np.asarray(more > np.maximum((2**n - 1) * fraction, TARGET_SLACK))


def _uneven_factors(*index: Ints) -> Floats:
    """Distinct factors from 1 to 1 + `TIE_SPREAD`, so that blocks that are alike are not all
    divided at once.

    `index` holds the blocks' positions along each axis. The fractional parts of multiples of the
    plastic number's powers fill any region evenly (Roberts 2018).
    """
    place = sum(factor * along for factor, along in zip(UNEVEN_FACTORS, index, strict=False))
    return 1.0 + TIE_SPREAD * np.mod(place, 1.0)


def _least_targets(data: NDArray, counts: Ints) -> NDArray:
    """Minima over equal blocks: a voxel belongs to the block of its centre; a block without
    centres has no target.
    """
    for axis, count in enumerate(counts):
        size = data.shape[axis]
        start = block_starts(size, count)
        length = np.diff(start, append=size)
        # The first voxel of each block, then the second of each that has one, ...: five times as
        # fast as `reduceat`.
        data = np.moveaxis(data, axis, 0)
        least = data[np.minimum(start, size - 1)]
        least[length == 0] = NO_BOUND_MM
        for k in range(1, length.max()):
            longer = length > k
            least[longer] = np.minimum(least[longer], data[start[longer] + k])
        data = np.moveaxis(least, 0, axis)
    return data


def _best_division(
    content: Content, nodes: int, limits: _BlockLimits
) -> tuple[tuple[int, ...], list[Bools]]:
    """Numbers of roots along each axis, and the divided blocks, of the octree with the nearest
    number of nodes.

    If many blocks are alike, all or none of them are divided, and some numbers cannot be reached
    from one size of undivided blocks. Then other sizes are tried, finally the lattice that has the
    number undivided.
    """
    best: tuple[int, tuple[int, ...], list[Bools]] | None = None
    image, channels = content.image, channels_of(content)
    for roots, _ in _fitting_roots(content, nodes, limits):
        if (np.array(image.shape) / roots).max() < LEAF_VOXELS and best is not None:
            break
        blocks = _blocks_by_depth(content, channels, roots, limits)
        count, divided = _division(blocks, roots, nodes, limits.n_rings)
        if best is None or abs(count - nodes) < abs(best[0] - nodes):
            best = count, roots, divided
        if abs(count - nodes) <= TRIAL_MISS * nodes:
            break
    assert best is not None
    return best[1:]


def _fitting_roots(
    content: Content, nodes: int, limits: _BlockLimits
) -> list[tuple[tuple[int, ...], int]]:
    """Numbers of roots to try that can be divided within the limits, each with the least depth of
    all blocks.

    Raise InputError without any, or for cells below voxels.
    """
    image, fitting = content.image, list[tuple[tuple[int, ...], int]]()
    _check_not_below_voxels(
        image, max(_fewest_nodes(content, limits), _target_nodes(content, limits))
    )
    for roots in _root_counts(content, nodes, limits):
        edge = image.spacing * image.shape / np.array(roots)
        depths = range(_depths(edge, roots, image.spacing, limits)[0] + 1)
        fitting += [(roots, depth) for depth in depths if not _is_too_large(edge, depth, limits)][
            :1
        ]
    if not fitting:
        least = LONGEST_IN_BLOCK[image.ndim] * _least_edge(limits, image.ndim)
        raise InputError(
            f"sizes: the requested edges of {least:.3g} mm need blocks smaller than a voxel "
            f"({image.spacing.max():.3g} mm); allow longer ones"
        )
    return fitting


def _root_counts(content: Content, nodes: int, limits: _BlockLimits) -> Iterator[tuple[int, ...]]:
    """Numbers of roots along each axis to try, within the limits, the largest blocks first.

    With a region, the last is the lattice that has the nodes within it: if leaves may not be
    smaller, no coarser one has as many.
    """
    image, largest, smallest = content.image, limits.largest, limits.smallest
    lengths = image.spacing * image.shape
    kind = "bcc" if image.ndim == 3 else "criss-cross"
    coarse = [
        near_cubes(kind, lengths, max(2**image.ndim + 1, int(nodes * fraction)))
        for fraction in ROOT_FRACTIONS
    ]
    if content.inside is not None:
        within = near_cubes(kind, lengths, min(int(nodes / content.inside.mean()), MAX_NODES))
        finest = np.maximum(np.array(image.shape) / LEAF_VOXELS, coarse[-1])
        coarse.append(tuple(int(c) for c in np.minimum(within, finest)))
    edges = [lengths / roots for roots in coarse]
    fit = [e.max() <= largest * (1.0 + 1e-9) and e.min() >= smallest for e in edges]
    if limits.target is not None and (widest := float(limits.target.max())) < NO_BOUND_MM:
        fitting = np.clip(np.rint(lengths * USUAL_IN_BLOCK[image.ndim] / widest), 1, None)
        if (lengths / fitting).max() <= largest * (1.0 + 1e-9) and (
            lengths / fitting
        ).min() >= smallest:
            yield tuple(int(c) for c in fitting)
    if not all(fit):
        fewest, finest = np.ceil(lengths / largest - 1e-9), lengths / max(smallest, 1e-300)
        yield tuple(
            int(c) for c in np.maximum(np.minimum(fewest, np.floor(finest * (1.0 + 1e-9))), 1)
        )
    yield from (roots for roots, is_fit in zip(coarse, fit, strict=True) if is_fit)


def _division(
    blocks: list[_Blocks], roots: tuple[int, ...], nodes: int, n_rings: int
) -> tuple[int, list[Bools]]:
    """The number of nodes nearest to `nodes`, and the divided blocks, whose error exceeds a
    threshold.

    The threshold is found by bisection.
    """
    # A finer block may have the largest error, as noise is subtracted from coarser ones, too.
    above = [at_depth.error[at_depth.error > 0.0] for at_depth in blocks[:-1]]
    ends = [(float(errors.min()), float(errors.max())) for errors in above if len(errors)]
    low, high = (0.5 * min(ends)[0], 2.0 * max(high for _, high in ends)) if ends else (1.0, 1.0)
    del above
    regions = [at_depth.is_in_region for at_depth in blocks if at_depth.is_in_region is not None]
    best_count, best, is_bound = -1, [], False
    for _ in range(BISECTION_STEPS):
        middle = np.sqrt(max(low, 1e-300) * high)
        divided = _divide_blocks(blocks, middle, n_rings)
        # For far too many leaves, each with its centre, a bound of the nodes suffices: it is no
        # nearer than any counted number, and it rises as the threshold falls.
        n_leaves = prod(roots) + (2 ** len(roots) - 1) * sum(
            int(np.count_nonzero(each)) for each in divided
        )
        is_skipped = not regions and n_leaves > SKIPPED_RATIO * nodes
        count = (
            NODES_OF_LEAF * n_leaves
            if is_skipped
            else len(leaf_nodes(divided, roots, regions).codes)
        )
        if best_count < 0 or abs(count - nodes) < abs(best_count - nodes):
            best_count, best, is_bound = count, divided, is_skipped
        if abs(count - nodes) <= BISECTION_MISS * nodes or high <= low * (1.0 + 1e-9):
            break
        low, high = (middle, high) if count > nodes else (low, middle)
    return len(leaf_nodes(best, roots).codes) if is_bound else best_count, best


def _divide_blocks(blocks: list[_Blocks], threshold: float, n_rings: int) -> list[Bools]:
    """Masks of the blocks to divide at each depth, if those above the threshold or too large are
    divided.

    A divided block is surrounded by `n_rings` blocks of its size in every direction: with one,
    neighbours differ by at most one division.
    """
    divided = [(at_depth.error > threshold) | at_depth.is_too_large for at_depth in blocks[:-1]]
    for depth in range(len(divided) - 1, 0, -1):
        # These blocks must exist:
        near = largest_around(divided[depth], n_rings)
        for axis in range(near.ndim):
            near = np.asarray(
                near.reshape(*near.shape[:axis], -1, 2, *near.shape[axis + 1 :]).any(axis=axis + 1)
            )
        divided[depth - 1] |= near
    return divided
