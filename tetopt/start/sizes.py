"""How small and how large cells of a graded mesh may be: limits, a field of them, and how fast sizes may change."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numba import njit
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides
from tetopt.image import Image
from tetopt.start.lattice import near_cubes

# A graded mesh's longest edge over that of a uniform mesh with as many nodes, where no other is set (`docs/sizes.md`).
COARSEST_SHARE = 1.4
# By dimension, the shortest and the longest edge of the cells in a block over the block's own edge: from a corner to
# the centre, and, in 3-D, the diagonal of a block's side on the box's faces.
SHORTEST_IN_BLOCK = {2: 0.5**0.5, 3: 0.75**0.5}
LONGEST_IN_BLOCK = {2: 1.0, 3: 2.0**0.5}  # in 2-D the side itself is as long as the block
NO_BOUND_MM = 1e30  # stands for infinity in float32, to which steps can still be added
UNEVEN_SHARE = 1.5  # a cell's longest edge over the edge that gradation gives: edges of a good cell differ by a third


class Sizes(NamedTuple):
    """Limits on the edges of cells where `octree` and the exchanges of `optimize` put nodes in and take them out.

    Nodes move in between, which makes some edges longer or shorter: in the tests one in a hundred is more than 5 %
    longer than the largest. `quality` tells the longest and the shortest.

    Parameters
    ----------
    smallest : float
        No block and no split makes a shorter edge, mm. Where not both can be, this is kept rather than `largest`.
        Nodes then move nearer: in one run a tenth of the edges ended shorter.
    largest : float, optional
        No block and no collapse makes a longer edge, mm. By default `coarsest` times the longest edge of a uniform mesh
        with as many nodes: smaller cells in uniform regions do not represent the image any better, but the
        displacement. `inf` for none. Most edges are 0.6 times the longest, which are the diagonals of blocks on the
        box's faces.
    gradation : float
        How gently sizes change: each size of the octree, between the next smaller and the next larger one, is at least
        1 / gradation blocks wide; 1 to 0.05. Collapses make no edge longer than 1.5 times the size that grows from its
        surroundings by gradation x distance. Where there are hardly two sizes it changes little.
    coarsest : float
        Without `largest`: the longest edge over that of a uniform mesh with as many nodes.
    field : Image, optional
        Longest edge, mm, by place: an image that need not lie on the voxels of the one to be meshed. Outside of it, and
        where it is 0 or below, nothing but `largest` holds.
    """

    smallest: float = 0.0
    largest: float | None = None
    gradation: float = 1.0
    field: Image | None = None
    coarsest: float = COARSEST_SHARE

    def prepared(self, n: int) -> Sizes:
        """The same limits, checked; the field's steps are lowered to the gradation.

        Raises
        ------
        InputError
            A value out of range, or a field of another dimension than n.
        """
        if not 0.0 <= self.smallest < np.inf:
            raise InputError(f"size_min: expected 0 mm or more, got {self.smallest}")
        if self.largest is not None and not self.largest > 0.0:
            raise InputError(f"size_max: expected a length above 0 mm, got {self.largest}")
        if self.largest is not None and self.largest < self.smallest:
            raise InputError(f"size_max: {self.largest:g} mm is below the smallest size, {self.smallest:g} mm")
        if not 0.05 <= self.gradation <= 1.0:
            raise InputError(f"gradation: expected 0.05 (gentle) to 1, got {self.gradation}")
        if self.field is not None and self.field.ndim != n:
            raise InputError(f"sizing: expected a field in {n}-D, as the image, got {self.field.ndim}-D")
        if self.field is not None and not (self.field.data > 0.0).any():
            raise InputError("sizing: no voxel is above 0; give lengths in mm")
        return self if self.field is None else self._replace(field=_graded(self.field, self.gradation))

    def longest_edge(self, image: Image, nodes: int, volume: float | None = None) -> float:
        """The longest edge that any cell may have, mm; `volume`, mm^n, is that of the mesh, by default of the box."""
        if self.largest is not None:
            return self.largest
        lengths = image.spacing * image.shape
        kind, fewest = ("bcc", 9) if image.ndim == 3 else ("criss-cross", 5)
        if volume is not None:  # nodes of a lattice of the whole box
            nodes = int(nodes * image.volume / volume)
        uniform = float((lengths / near_cubes(kind, lengths, max(nodes, fewest))).max())
        return LONGEST_IN_BLOCK[image.ndim] * max(
            self.coarsest * uniform, self.smallest / SHORTEST_IN_BLOCK[image.ndim]
        )

    def on_voxels(self, image: Image) -> NDArray[np.float32] | None:
        """The field's value at each voxel's centre, of the image's shape, mm; `NO_BOUND_MM` outside of the field."""
        if self.field is None:
            return None
        to_field = np.linalg.inv(self.field.affine) @ image.affine
        return np.asarray(
            scipy.ndimage.affine_transform(
                self.field.data, to_field, output_shape=image.shape, order=0, mode="grid-constant", cval=NO_BOUND_MM
            )
        )

    def longest_edges(
        self, image: Image, nodes: int, points: NDArray, cells: NDArray, own: NDArray, volume: float | None = None
    ) -> NDArray[np.float64]:
        """The longest edge that a cell at each node may be given, (N,) mm; `own` (N,) is the mean size there now."""
        bound = np.full(len(points), self.longest_edge(image, nodes, volume))
        if self.field is not None:
            index, (low, high) = self.field.to_index(points), box_sides(self.field.shape).T
            is_in_field = ((index >= low - ON_SIDE_VOXELS) & (index <= high + ON_SIDE_VOXELS)).all(axis=1)
            voxel = np.clip(np.rint(index[is_in_field]).astype(np.int64), 0, np.array(self.field.shape) - 1)
            bound[is_in_field] = np.minimum(bound[is_in_field], self.field.data[tuple(voxel.T)])
        return np.minimum(bound, UNEVEN_SHARE * _around(own, points, cells, self.gradation))


def _graded(field: Image, gradation: float) -> Image:
    """The field with no value above a neighbour's by more than gradation x distance, neighbours across voxel faces."""
    data = np.where(field.data > 0.0, field.data, NO_BOUND_MM).astype(np.float32)
    shape = (1,) * (3 - field.ndim) + field.shape
    steps = np.concatenate([np.zeros(3 - field.ndim), gradation * field.spacing]).astype(np.float32)
    _lower(data.reshape(shape), steps)
    return Image(data, field.affine)


@njit(cache=True, error_model="numpy")
def _lower(data: NDArray, steps: NDArray) -> None:
    """Lower each voxel to its least neighbour's value and a step, going forwards, then backwards over the voxels.

    A shortest way may take all its steps forwards first, hence both.
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
    """The least of the other nodes' size + gradation x distance, along edges, (N,)."""
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
                    if most < reached[a] * (1.0 - 1e-12):
                        reached[a] = most
                        is_changed = True
    return reached
