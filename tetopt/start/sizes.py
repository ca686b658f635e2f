"""Sizes of the cells of a graded mesh: targets by place, bounds, and gradation."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides
from tetopt.image import Image
from tetopt.start.lattice import MAX_NODES, near_cubes
from tetopt.system.arrays import Bools, Floats
from tetopt.system.kernel_cache import njit

# Default ratio of a graded mesh's longest edge to that of a uniform mesh with as many nodes
# (`docs/understand/sizes.md`).
COARSEST_RATIO = 1.4
# By dimension, the shortest, mean and longest edge of the cells in a block over the block's edge:
# from a corner to the centre; over 8 of these and 6 sides (in 2-D 4 and 2); and, in 3-D, the
# diagonal of a block's side on the box's faces.
SHORTEST_IN_BLOCK = {2: 0.5**0.5, 3: 0.75**0.5}
USUAL_IN_BLOCK = {2: (2.0 * 0.5**0.5 + 1.0) / 3.0, 3: (4.0 * 0.75**0.5 + 3.0) / 7.0}
LONGEST_IN_BLOCK = {2: 1.0, 3: 2.0**0.5}  # in 2-D the longest is the block's side
# Nodes of equilateral cells by dimension, times edge^n per volume. In 3-D a cell has edge^3 / (6
# sqrt 2), and the solid angle 3 arccos(1/3) - pi at each of its corners, of the 4 pi around a node.
EQUILATERAL_NODES = {
    2: 2.0 / 3.0**0.5,
    3: 6.0 * 2.0**0.5 * (3.0 * np.arccos(1.0 / 3.0) - np.pi) / np.pi,
}
# mean ratio, over all directions, of a surface to its voxels' sides
STAIRCASE_RATIO = {2: np.pi / 4.0, 3: 2.0 / 3.0}
# nodes that targets take: cells of an image are neither regular nor uniform
SIZED_OVER_EQUILATERAL = 1.5
# ratio to the target above which an edge is split, as in MMG, since its halves are nearer to it
LONG_EDGE = 2.0**0.5
SHORT_EDGE_FRACTION = 0.5**0.5  # ratio to the target below which the image has made an edge
# edge over target: 1/8 to 4, four per doubling
RATIO_BINS = tuple(0.5 ** (0.25 * k) for k in range(12, -9, -1))
NO_BOUND_MM = 1e30  # infinity for float32, to which steps can still be added
# longest edge of a cell over the edge from gradation: edges of a good cell differ by a third
UNEVEN_RATIO = 1.5


class Sizes(NamedTuple):
    """Targets and limits for the edges of cells in `octree_mesh` and the exchanges of `optimize`.

    A target (`edge_size`, `field`) is for the usual edge: octrees start near it, edges longer than
    sqrt 2 times the target are split while nodes are available, and no collapse makes such an edge.
    Cells are smaller where the image has detail. This takes up to 1.5 times the nodes of
    equilateral cells (`nodes_of_sizes`). `smallest` and `longest` are bounds. Nodes move
    afterwards, which makes some edges longer or shorter: in the tests, one in a hundred is more
    than 5 % longer than `longest`. `quality` reports the longest and the shortest.

    Parameters
    ----------
    smallest : float
        No block and no split makes a shorter edge, mm, and no target is below it. It takes
        precedence over `longest`. Nodes may move nearer afterwards.
    edge_size : float, optional
        Target everywhere, mm, and upper limit of `field`; `inf` for none.
    gradation : float, optional
        Rate at which sizes may change, 0.05 (gentle) to 1, the default. Between the next smaller
        and the next larger size, each size of the octree is at least 1 / gradation blocks wide.
        Targets grow by at most gradation x distance, and collapses make no edge longer than 1.5
        times the size that grows from its surroundings at this rate. It has little effect if there
        are hardly two sizes.
    field : Image, optional
        Target by place, mm: an image that need not share the voxels of the meshed image. Outside
        its box, and where it is 0 or below, only `edge_size` applies.
    coarsest : float, optional
        Ratio of the longest edge to that of a uniform mesh with as many nodes, used without
        `edge_size` and `longest`; by default 1.4.
    longest : float, optional
        No block and no collapse makes a longer edge, mm; `inf` for no limit. By default, without
        `edge_size`, `coarsest` times the longest edge of a uniform mesh with as many nodes: smaller
        cells in uniform regions improve the displacement, not the image. Most edges are 0.6 times
        the longest, which are diagonals of blocks on the box's faces.
    cells_across : float, optional
        Number of cells across a label where it is thin: the target is its local thickness divided
        by this number (`sizes_by_label`), not below `smallest` or a voxel. Label 0 is background
        and has no such target.
    by_label : mapping of int to float, str or LabelSize, optional
        Targets by label, with "*" for all others including 0: mm, or a fraction of the local
        thickness t, such as "0.6t", or "0.6t[1:10]" with bounds in mm.

    Raises
    ------
    InputError
        At use: a value out of range, contradictory sizes, or a field of another dimension.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> sizes = tetopt.Sizes(edge_size=16.0)
    >>> len(tetopt.mesh_image(image, sizes=sizes, iterations=4).mesh.points)
    227
    """

    smallest: float = 0.0
    edge_size: float | None = None
    gradation: float | None = None
    field: Image | None = None
    coarsest: float | None = None
    longest: float | None = None
    cells_across: float | None = None
    by_label: Mapping[int | str, Any] | None = None

    @property
    def slope(self) -> float:
        """The gradation, or its default."""
        return 1.0 if self.gradation is None else self.gradation

    @property
    def has_target(self) -> bool:
        """True if there is a target anywhere."""
        return self.field is not None or (self.edge_size is not None and self.edge_size < np.inf)

    def prepared(self, n: int) -> Sizes:
        """Check the sizes, and lower the field's steps to the gradation.

        Parameters
        ----------
        n : {2, 3}
            Dimension of the image.

        Returns
        -------
        Sizes
            The same, with a field whose neighbouring voxels differ by at most gradation x distance.

        Raises
        ------
        InputError
            A value out of range, or a field whose dimension is not n.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> fine_in_ball = np.where(image.data > 60.0, 6.0, 20.0)
        >>> sizes = tetopt.Sizes(field=tetopt.Image(fine_in_ball, image.affine))
        >>> place = np.array([[26.0, 2.0, 2.0]])  # 8 mm from the last fine voxel
        >>> sizes.at(place).tolist(), sizes.prepared(3).at(place).tolist()
        ([20.0], [14.0])
        """
        names = ("smallest", "edge_size", "gradation", "coarsest", "longest")
        lengths = {name: each for name in names if (each := getattr(self, name)) is not None}
        if wrong := [name for name, each in lengths.items() if not isinstance(each, Real)]:
            got = type(lengths[wrong[0]]).__name__
            raise TypeError(f"sizes: {wrong[0]}: expected a number, got {got}")
        plain: dict[str, Any] = {name: float(each) for name, each in lengths.items()}
        self = self._replace(**plain)
        if not 0.0 <= self.smallest < np.inf:
            raise InputError(f"smallest: expected 0 mm or more, got {self.smallest}")
        for name, value in (("edge_size", self.edge_size), ("longest", self.longest)):
            if value is not None and not value > 0.0:
                raise InputError(f"{name}: expected a length above 0 mm, got {value}")
            if value is not None and value < self.smallest:
                raise InputError(
                    f"{name}: {value:g} mm is below the smallest size, {self.smallest:g} mm"
                )
        if not 0.05 <= self.slope <= 1.0:
            raise InputError(f"gradation: expected 0.05 (gentle) to 1, got {self.gradation}")
        if self.cells_across is not None or self.by_label:
            raise InputError(
                "sizes: cells_across and by_label depend on labels; call `sizes_by_label` first"
            )
        if self.field is not None and self.field.ndim != n:
            raise InputError(
                f"field: expected a {n}-D field like the image, got a {self.field.ndim}-D one"
            )
        if self.field is not None and not (self.field.data > 0.0).any():
            raise InputError("field: expected lengths above 0 mm, got none")
        return (
            self
            if self.field is None
            else self._replace(field=_grade_field(self.field, self.slope))
        )

    def longest_edge(self, image: Image, nodes: int, volume: float | None = None) -> float:
        """The longest edge that any cell may have, mm.

        Parameters
        ----------
        image : Image
            The image whose box the mesh covers.
        nodes : int
            Number of nodes of the mesh.
        volume : float, optional
            Volume of the mesh, mm^n; by default that of the box.

        Returns
        -------
        float
            mm; `inf` if every place has a target.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> both = tetopt.Sizes(), tetopt.Sizes(longest=20.0)
        >>> [round(sizes.longest_edge(image, 300), 1) for sizes in both]
        [31.7, 20.0]
        """
        if self.longest is not None:
            return self.longest
        if self.edge_size is not None:
            return np.inf
        lengths = image.spacing * image.shape
        kind, fewest = ("bcc", 9) if image.ndim == 3 else ("criss-cross", 5)
        if volume is not None:  # nodes for a lattice of the whole box
            nodes = int(nodes * image.volume / volume)
        uniform = float(
            (lengths / near_cubes(kind, lengths, min(max(nodes, fewest), MAX_NODES))).max()
        )
        coarsest = COARSEST_RATIO if self.coarsest is None else self.coarsest
        return LONGEST_IN_BLOCK[image.ndim] * max(
            coarsest * uniform, self.smallest / SHORTEST_IN_BLOCK[image.ndim]
        )

    def on_voxels(self, image: Image) -> NDArray[np.float32]:
        """The target at each voxel's centre.


        Parameters
        ----------
        image : Image
            Image with the target voxels.

        Returns
        -------
        (s_0, ..., s_{n-1}) float32
            Targets in the image's shape, mm; `NO_BOUND_MM` where there is none.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> targets = tetopt.Sizes(edge_size=12.0).on_voxels(image)
        >>> targets.shape, float(targets.max())
        ((16, 16, 16), 12.0)
        """
        largest = np.float32(
            NO_BOUND_MM if self.edge_size is None else np.clip(self.edge_size, 1e-30, NO_BOUND_MM)
        )
        smallest = np.float32(self.smallest)
        if self.field is None:
            return np.broadcast_to(np.maximum(largest, smallest), image.shape)
        by_place = self.field.data
        if by_place.shape != image.shape or not np.array_equal(self.field.affine, image.affine):
            to_field = np.linalg.inv(self.field.affine) @ image.affine
            by_place = scipy.ndimage.affine_transform(
                by_place, to_field, output_shape=image.shape, order=0, mode="grid-constant"
            )
        return np.asarray(
            np.clip(np.where(by_place > 0.0, by_place, NO_BOUND_MM), smallest, largest)
        )

    def at(self, points: NDArray) -> Floats:
        """The target at points.

        Parameters
        ----------
        points : (N, n) array of float64
            World mm.

        Returns
        -------
        (N,) float64
            mm; `inf` where there is none.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> fine_in_ball = np.where(image.data > 60.0, 6.0, 0.0)
        >>> field = tetopt.Image(fine_in_ball, image.affine)
        >>> sizes = tetopt.Sizes(edge_size=20.0, field=field)
        >>> sizes.at(np.array([[0.0, 0.0, 0.0], [30.0, 30.0, 30.0]])).tolist()
        [6.0, 20.0]
        """
        target = np.full(len(points), np.inf if self.edge_size is None else self.edge_size)
        if self.field is not None:
            index, (low, high) = self.field.to_index(points), box_sides(self.field.shape).T
            is_in_field = ((index >= low - ON_SIDE_VOXELS) & (index <= high + ON_SIDE_VOXELS)).all(
                axis=1
            )
            voxel = np.clip(
                np.rint(index[is_in_field]).astype(np.int64), 0, np.array(self.field.shape) - 1
            )
            by_place = self.field.data[tuple(voxel.T)]
            target[is_in_field] = np.minimum(
                target[is_in_field], np.where(by_place > 0.0, by_place, np.inf)
            )
        return np.maximum(target, self.smallest)

    def around(self, points: NDArray, cells: NDArray) -> Floats:
        """The target at nodes; without one, the size that grows from other targets.

        Parameters
        ----------
        points : (N, n) array of float64
            World mm.
        cells : (M, n+1) array of int64
            Cells along whose edges it grows.

        Returns
        -------
        (N,) float64
            mm.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> mesh = tetopt.lattice_mesh(image, nodes=300)
        >>> field = tetopt.Image(np.where(image.data > 60.0, 6.0, 0.0), image.affine)
        >>> targets = tetopt.Sizes(field=field).around(mesh.points, mesh.cells)
        >>> float(targets.min()), bool(np.isfinite(targets).all())
        (6.0, True)
        """
        target = self.at(points)
        if not np.isfinite(target).any() or np.isfinite(target).all():
            return target
        return np.minimum(target, _around(target, points, cells, self.slope))

    def longest_edges(
        self,
        image: Image,
        nodes: int,
        points: NDArray,
        cells: NDArray,
        own: NDArray,
        target: NDArray,
        volume: float | None = None,
    ) -> Floats:
        """Longest edge allowed for a cell at each node.

        Parameters
        ----------
        image : Image
            The image whose box the mesh covers.
        nodes : int
            Number of nodes of the mesh.
        points, cells : (N, n) float64, (M, n+1) int64
            Nodes in world mm, and the cells' node indices.
        own : (N,) float64
            Current mean size there, mm.
        target : (N,) float64
            Target size there, mm (`around`).
        volume : float, optional
            Volume of the mesh, mm^n; by default that of the box.

        Returns
        -------
        (N,) float64
            mm.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> mesh = tetopt.lattice_mesh(image, nodes=300)
        >>> sizes, own = tetopt.Sizes(edge_size=12.0), np.full(len(mesh.points), 16.0)
        >>> target = sizes.around(mesh.points, mesh.cells)
        >>> longest = sizes.longest_edges(image, 300, mesh.points, mesh.cells, own, target)
        >>> bool((longest <= 1.5 * 12.0).all())
        True
        """
        bound = np.minimum(self.longest_edge(image, nodes, volume), LONG_EDGE * target)
        return np.minimum(bound, UNEVEN_RATIO * _around(own, points, cells, self.slope))


def equilateral_nodes(target: NDArray, image: Image, inside: Bools | None = None) -> float:
    """Number of nodes of a mesh of equilateral cells whose edges are the targets at voxels, mm.

    `target` has the image's shape and counts up to `NO_BOUND_MM`; `inside` is the mask of the
    voxels to mesh. Nodes on the boundary have only half of their space inside, so nodes are added
    in proportion to its area over that of a triangle (in 2-D its length over that of an edge).
    """
    n = image.ndim
    is_in = target < NO_BOUND_MM if inside is None else inside & (target < NO_BOUND_MM)
    edge = np.where(is_in, target, np.inf).astype(np.float64)
    # Powers are taken only where they are not 0, and below only at steps: a fifth of the time.
    density = np.power(edge, -n, where=is_in, out=np.zeros(edge.shape))
    nodes = EQUILATERAL_NODES[n] * image.voxel_volume * float(density.sum())
    of_facet = 0.5 * (EQUILATERAL_NODES[2] if n == 3 else 1.0)
    # ratio of a voxel's sides to its volume
    across = np.linalg.norm(np.linalg.inv(image.affine[:n, :n]), axis=1)
    for axis in range(n):
        area = of_facet * (image.voxel_volume * float(across[axis]))
        along = np.moveaxis(edge, axis, 0)
        nodes += float((area * along[0] ** (1 - n)).sum() + (area * along[-1] ** (1 - n)).sum())
        if inside is not None:
            whole = np.moveaxis(inside, axis, 0)
            up, down = along[1:][whole[1:] & ~whole[:-1]], along[:-1][whole[:-1] & ~whole[1:]]
            steps = (area * up ** (1 - n)).sum() + (area * down ** (1 - n)).sum()
            nodes += STAIRCASE_RATIO[n] * float(steps)
    return nodes


class EdgeRatios(NamedTuple):
    """Ratios of edges to their targets, for edges with targets at both ends."""

    mean: float
    above: float  # fraction of edges over sqrt 2 times their target, for which nodes were lacking
    below: float  # fraction of edges under 1 / sqrt 2 times their target, which the image has made
    # bounds of edge over target, B + 1, ascending; end bins include values beyond
    edges_of_bins: tuple[float, ...]
    fraction: list[float]  # (B,) fraction of the edges in each bin


def edge_ratios(points: NDArray, cells: NDArray, sizes: Sizes) -> EdgeRatios | None:
    """Ratios of the edges of a mesh to the targets of sizes; None if no edge has a target."""
    n, target = points.shape[1], sizes.prepared(points.shape[1]).at(points)
    first, second = np.triu_indices(n + 1, 1)
    a, b = cells[:, first].ravel(), cells[:, second].ravel()
    a, b = np.divmod(np.unique(np.minimum(a, b) * len(points) + np.maximum(a, b)), len(points))
    wish = 0.5 * (target[a] + target[b])
    length = np.linalg.norm(points[b] - points[a], axis=1)
    ratio = (length / wish)[np.isfinite(wish)]
    if len(ratio) == 0:
        return None
    counts = np.histogram(np.clip(ratio, RATIO_BINS[0], RATIO_BINS[-1]), RATIO_BINS)[0]
    above, below = float((ratio > LONG_EDGE).mean()), float((ratio < SHORT_EDGE_FRACTION).mean())
    return EdgeRatios(float(ratio.mean()), above, below, RATIO_BINS, (counts / len(ratio)).tolist())


def _grade_field(field: Image, gradation: float) -> Image:
    """Limit the field so that no value exceeds a face neighbour's by more than gradation x
    distance.

    Sizes grow across voxels of 0 or less, which stay without a size.
    """
    has_one = field.data > 0.0
    data = np.where(has_one, field.data, NO_BOUND_MM).astype(np.float32)
    shape = (1,) * (3 - field.ndim) + field.shape
    steps = np.concatenate([np.zeros(3 - field.ndim), gradation * field.spacing]).astype(np.float32)
    _lower(data.reshape(shape), steps)
    return Image(np.where(has_one, data, np.float32(0.0)), field.affine)


@njit(cache=True, error_model="numpy")
def _lower(data: NDArray, steps: NDArray) -> None:
    """Lower each voxel to its neighbours' least value plus a step, in a forward and a backward
    pass.

    A shortest way may take all its forward steps first, hence both passes.
    """
    s0, s1, s2 = data.shape
    for way in (1, -1):
        for count0 in range(s0):
            i = count0 if way > 0 else s0 - 1 - count0
            for count1 in range(s1):
                j = count1 if way > 0 else s1 - 1 - count1
                for count2 in range(s2):
                    k = count2 if way > 0 else s2 - 1 - count2
                    least = data[i, j, k]
                    if 0 <= i - way < s0:
                        least = min(least, data[i - way, j, k] + steps[0])
                    if 0 <= j - way < s1:
                        least = min(least, data[i, j - way, k] + steps[1])
                    if 0 <= k - way < s2:
                        least = min(least, data[i, j, k - way] + steps[2])
                    data[i, j, k] = least


@njit(cache=True, error_model="numpy")
def _around(size: NDArray, points: NDArray, cells: NDArray, gradation: float) -> NDArray:
    """The least value of another node's size + gradation x distance along edges, (N,)."""
    reached = np.full(len(size), np.inf)
    is_changed = True
    while is_changed:
        is_changed = False
        for c in range(len(cells)):
            for i in range(cells.shape[1]):
                for j in range(cells.shape[1]):
                    a, b = cells[c, i], cells[c, j]
                    if a == b:
                        continue
                    square = 0.0
                    for d in range(points.shape[1]):
                        square += (points[a, d] - points[b, d]) ** 2
                    most = min(size[b], reached[b]) + gradation * np.sqrt(square)
                    # 1e-12, chosen: far above the rounding of a sum, so that the sweep ends
                    if most < reached[a] * (1.0 - 1e-12):
                        reached[a] = most
                        is_changed = True
    return reached
