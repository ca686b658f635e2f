"""A field of vectors, directions or tensors on voxels, and what a file's components mean.

A kind is written KIND[@FRAME]: "tensor@fsl". The frame is the axes of the components and, for
tensors, the order of the six; the name of a program stands for its own (`PROGRAMS`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError
from tetopt.image import Image, check_affine, transform_vectors
from tetopt.system.arrays import Floats, plain_array
from tetopt.system.slabs import over_slabs

Kind = Literal["scalar", "vector", "direction", "tensor"]
N_COMPONENTS = {"vector": 3, "direction": 3, "tensor": 6}
ROWS, COLUMNS = np.triu_indices(3)  # of a tensor's components here: xx, xy, xz, yy, yz, zz
NINE_OF_SIX = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])  # those of a tensor row by row
# Places in a file of the components xx, xy, xz, yy, yz, zz. `lower` are rows of the lower triangle,
# as the NIfTI standard has them (intent 1005): xx, xy, yy, xz, yz, zz; `diagonal` has it first.
ORDERS = {"upper": (0, 1, 2, 3, 4, 5), "lower": (0, 1, 3, 2, 4, 5), "diagonal": (0, 3, 4, 1, 5, 2)}
AXES = ("voxel", "fsl", "ras", "lps")
# Axes and order. FSL: those of the array, x flipped where the affine's determinant is positive. The
# orders are those of `dipy.reconst.utils.convert_tensors`; ITK's is that of its
# SymmetricSecondRankTensor.
PROGRAMS = {
    "fsl": ("fsl", "upper"),
    "dipy": ("ras", "lower"),
    "mrtrix": ("ras", "diagonal"),
    "itk": ("lps", "upper"),
}


class Convention(NamedTuple):
    """What components in a file mean; None where it is not stated."""

    axes: str | None = None  # one of AXES
    order: str | None = None  # one of ORDERS
    turn: Floats | None = None  # (3, 3) from components to RAS+ in place of axes


def parse_kind(text: str) -> tuple[Kind, Convention]:
    """Parse KIND[@FRAME], FRAME being AXES, AXES-ORDER or a program.

    Raises
    ------
    InputError
        An unknown word.

    Examples
    --------
    >>> parse_kind("tensor@fsl")
    ('tensor', Convention(axes='fsl', order='upper', turn=None))
    >>> parse_kind("direction@ras")[1].order is None
    True
    """
    kind, mark, words = text.partition("@")
    if kind not in get_args(Kind):
        raise InputError(f'kind: expected {", ".join(get_args(Kind))}, got "{kind}"')
    if not mark:
        return kind, Convention()  # type: ignore[return-value]
    axes, dash, order = words.partition("-")
    frame = Convention(*PROGRAMS.get(words, (axes, order or None)))
    is_known = frame.axes in AXES and (frame.order in ORDERS if dash or frame.order else True)
    if kind == "scalar" or not is_known or (dash and kind != "tensor"):
        words = "a scalar has no frame" if kind == "scalar" else f"expected {frame_words(kind)}"
        raise InputError(f'kind: {words}, got "{text}"')
    return kind, frame  # type: ignore[return-value]


def frame_words(kind: str) -> str:
    """Return the frames that exist for a kind, for a message."""
    names = ", ".join(f"@{name}" for name in dict.fromkeys((*PROGRAMS, *AXES)))
    return names + (f", or axes-order: @ras-{', @ras-'.join(ORDERS)}" if kind == "tensor" else "")


@dataclass(frozen=True, eq=False)
class Field:
    """Vectors, directions without sign, or symmetric tensors on a grid of voxels, in 3-D.

    Parameters
    ----------
    data : (s_0, s_1, s_2, C) array of real numbers
        Components along the world's axes, RAS+: x, y, z (C = 3), or of a tensor xx, xy, xz, yy, yz,
        zz (C = 6). A voxel with NaN has no data. Float64, read-only.
    affine : (4, 4) array
        Homogeneous map from index to world coordinates in mm. Float64, read-only.
    kind : {"vector", "direction", "tensor"}
        A direction is the same as its opposite, whatever its length.

    Raises
    ------
    InputError
        Another kind, shape or affine, infinite components, or no voxel with data.

    See Also
    --------
    load_field : Read one from a file.
    cell_field : Its values in the cells of a mesh.

    Examples
    --------
    >>> field = tetopt.Field(np.ones((4, 5, 6, 3)), np.eye(4), "direction")
    >>> field.shape
    (4, 5, 6)
    """

    data: Floats
    affine: Floats
    kind: Kind

    def __init__(self, data: ArrayLike, affine: ArrayLike, kind: Kind) -> None:
        if kind not in N_COMPONENTS:
            raise InputError(f'kind: expected {", ".join(N_COMPONENTS)}, got "{kind}"')
        values = np.array(plain_array("field", data), dtype=np.float64, order="C")
        if values.ndim != 4 or values.shape[-1] != N_COMPONENTS[kind] or 0 in values.shape:
            raise InputError(
                f"field: expected shape (s_0, s_1, s_2, {N_COMPONENTS[kind]}) for a {kind}, got "
                f"{values.shape}"
            )
        _check_finite(values)
        if np.isnan(values).any(axis=-1).all():
            raise InputError("field: expected data in some voxel, got NaN in all")
        values.setflags(write=False)
        vars(self).update(data=values, affine=check_affine(affine, 3), kind=kind)

    def __reduce__(self) -> tuple[Any, ...]:
        """Check and lock the arrays of a copy again, as `Image` does."""
        return Field, (self.data, self.affine, self.kind)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along each axis."""
        return self.data.shape[:3]

    @cached_property
    def grid(self) -> Image:
        """The voxels as an image, 0 everywhere."""
        return Image(np.zeros(self.shape, dtype=np.float32), self.affine)


def _check_finite(components: NDArray) -> None:
    if np.isinf(components).any():
        raise InputError("field: expected finite components, or NaN where there is no data")


def world_field(components: NDArray, affine: Floats, kind: Kind, frame: Convention) -> Field:
    """Return the field of a file's components (s_0, s_1, s_2, C) of a frame with axes and order."""
    _check_finite(components)
    turn = axes_of(frame.axes, affine) if frame.turn is None else frame.turn
    if kind == "tensor":  # each component of T = turn D turn^T is linear in the six of D
        assert frame.order is not None, "a tensor's components have an order"
        unit = np.eye(6)[:, NINE_OF_SIX].reshape(6, 3, 3)
        by_component = np.einsum("ia,kab,jb->ijk", turn, unit, turn)[ROWS, COLUMNS]
        turn = np.empty((6, 6))
        turn[:, ORDERS[frame.order]] = by_component
    world = np.empty(components.shape)

    def fill(first: int, stop: int) -> None:
        part = components[first:stop].astype(np.float64)
        world[first:stop] = transform_vectors(part, turn)

    over_slabs(fill, len(world), world.size)
    return Field(world, affine, kind)


def axes_of(axes: str | None, affine: Floats) -> Floats:
    """Return the unit vectors of a frame's axes in RAS+, (3, 3), one per column.

    Those of the array are the directions of the affine's columns, at right angles or not.
    """
    if axes == "ras":
        return np.eye(3)
    if axes == "lps":
        return np.diag([-1.0, -1.0, 1.0])
    steps = affine[:3, :3]
    turn = steps / np.linalg.norm(steps, axis=0)
    if axes == "fsl" and np.linalg.det(steps) > 0.0:
        turn = turn * [-1.0, 1.0, 1.0]
    return turn
