"""Labels: whole numbers with a colour each, and their distribution among channels."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.smoothing import largest_around
from tetopt.errors import InputError, warn
from tetopt.image import Image, check_image, transform_vectors
from tetopt.system.arrays import Bools, Floats, Ints
from tetopt.system.kernel_cache import njit

# largest signed 32-bit integer, the widest type of labels in most programs
LARGEST_LABEL = 2**31 - 1
# by which values may differ from whole numbers: interpolated or scaled headers leave less
ROUNDING_DISTANCE = 1e-3
# A grey image: among neighbouring voxels, both not 0, the equal ones are hardly more than those
# that differ by one of its values. The fraction of the first less twice that of the second, on 27
# volumes: label images .39 or more, also on voxels eight times as large; grey ones .32 or less,
# also rounded to 18 to 255 values, unless three quarters are equal.
LEAST_JUDGED_PAIRS = 2000  # fewer are by chance
MOST_FEW_VALUES = 16  # a segmentation by thresholds has no more
LEAST_EQUAL = 0.35  # that fraction; chosen
SURELY_EQUAL = 0.75  # fraction of equal pairs that is enough by itself, and quick
APART_VOXELS = 4  # labels at least this far from one another may share a channel

# Okabe and Ito's, then always the colour farthest in CIELAB from all before, and twice as far from
# the background, black and white, as seen with normal, no red or no green cones (Machado et al.
# 2009): any two are 10 or more apart, of the first 20 any two 14, and all are 20 from the
# background.
LABEL_PALETTE = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#56b4e9",
    "#cc79a7",
    "#f0e442",
    "#0000ff",
    "#6969ff",
    "#5a00b4",
    "#963c1e",
    "#87d269",
    "#781e78",
    "#7896ff",
    "#f02d5a",
    "#a51e69",
    "#d200b4",
    "#004bff",
    "#b40f4b",
    "#f07887",
    "#e15a3c",
    "#690f96",
    "#3cf096",
    "#f0964b",
    "#1e4b2d",
    "#2d6978",
    "#c32d00",
    "#a52dd2",
    "#3c00d2",
    "#e178d2",
    "#f0d25a",
    "#a569d2",
    "#78b496",
    "#d2a5d2",
    "#870f2d",
    "#d2a578",
    "#965a3c",
    "#78d2f0",
    "#a569a5",
    "#d21e87",
)
# variants of the palette as it repeats: unchanged, mixed with black, mixed with white
LABEL_TINTS = (0.0, -0.4, 0.4)
ABSENT_LISTED = 5  # labels without a voxel in an image or mask
BACKGROUND_LABEL = 0  # the label outside all tissues
COMPONENT_VOXELS = 50  # a face-connected component of a label or mask of as many must have a cell
BACKGROUND_COLOUR = "#e6e6e6"  # of that label


def check_labels(name: str, labels: Image, *, is_map: bool = False) -> Image:
    """Return labels as whole numbers from 0 to `LARGEST_LABEL`, 0 for NaN; round values within 1e-3
    of these, with a warning.

    Raises
    ------
    InputError
        Other values; with `is_map`, also the values of a grey image.
    """
    labels = check_image(name, labels).with_zeros()
    data = labels.data
    whole = np.rint(data)
    is_off = whole != data
    # in 32 bits, not exact without 1
    if is_off.any() or data.min() < 0.0 or data.max() >= LARGEST_LABEL + 1:
        wrong = np.argwhere(
            (whole < 0.0)
            | (whole >= LARGEST_LABEL + 1)
            | (np.abs(data - whole) > ROUNDING_DISTANCE)
        )
        if len(wrong):
            first = tuple(int(i) for i in wrong[0])
            raise InputError(
                f"{name}: labels must be whole numbers from 0 to {LARGEST_LABEL}; {len(wrong)} "
                "voxels have other "
                f"values, the first {data[first]:.10g} at {first}: is it a label image?"
            )
        warn(
            f"{name}: {np.count_nonzero(is_off)} voxels were rounded to whole numbers (by up to "
            f"{np.abs(data - whole).max():.2g})"
        )
        labels = Image(whole + 0.0, labels.affine)  # no -0
    if is_map and is_grey(labels.data):
        raise InputError(
            f"{name}: expected a label image, got {len(np.unique(labels.data))} values, which "
            "change from voxel to voxel as in a grey image: is it a label image?"
        )
    return labels


def is_label_map(image: Image) -> bool:
    """Return whether an image's values are labels: whole numbers from 0, and not those of a grey
    image.
    """
    return image.is_whole and image.range[0] >= 0.0 and not is_grey(image.data)


def is_grey(data: NDArray[np.floating]) -> bool:
    """Return whether whole numbers are those of a grey image, whose neighbouring voxels differ, or
    differ by one value.
    """
    n_pairs, n_equal = _pairs_apart(data, data, 0)
    if n_pairs < LEAST_JUDGED_PAIRS or n_equal >= SURELY_EQUAL * n_pairs:
        return False
    values, ranks = np.unique(data, return_inverse=True)
    _, n_by_one = _pairs_apart(data, ranks.reshape(data.shape), 1)
    return len(values) > MOST_FEW_VALUES and n_equal - 2 * n_by_one < LEAST_EQUAL * n_pairs


def _pairs_apart(data: NDArray, ranks: NDArray, step: int) -> tuple[int, int]:
    """Return the number of pairs of neighbouring voxels, both not 0, and of those whose ranks
    differ by a step.
    """
    n_pairs = n_apart = 0
    for axis in range(data.ndim):
        one, other = (np.moveaxis(data, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        is_pair = (one != 0.0) & (other != 0.0)
        apart = np.moveaxis(np.diff(ranks, axis=axis), axis, 0)
        n_pairs += int(np.count_nonzero(is_pair))
        n_apart += int(np.count_nonzero(is_pair & (np.abs(apart) == step)))
    return n_pairs, n_apart


def warn_of_absent(name: str, labels: Image, is_kept: Bools, where: str) -> None:
    """Warn of labels above 0 none of whose voxels is kept, as it lies in the image or mask; the
    largest first.
    """
    gone, counts = np.unique(
        labels.data[~is_kept & (labels.data > BACKGROUND_LABEL)], return_counts=True
    )
    is_absent = (
        ~np.isin(gone, np.unique(labels.data[is_kept])) if len(gone) else np.zeros(0, dtype=bool)
    )
    if is_absent.any():
        rows = sorted(zip((-counts[is_absent]).tolist(), gone[is_absent].tolist(), strict=True))
        words = ", ".join(
            f"{label:.10g} ({-voxels} voxel{'s' * (voxels < -1)})"
            for voxels, label in rows[:ABSENT_LISTED]
        )
        more = f" and {len(rows) - ABSENT_LISTED} more" * (len(rows) > ABSENT_LISTED)
        warn(f"{name}labels without a voxel in the {where}: {words}{more}")


class LostComponent(NamedTuple):
    """A face-connected component of a label's or mask's voxels, none of which lies in a cell of it.

    Parameters
    ----------
    voxels : int
        Number of its voxels.
    place : tuple of float
        World coordinates of the voxel nearest to their mean, mm.
    size_in_cells : float, optional
        Its volume, relative to the mean cell around it; None if not measured.

    Examples
    --------
    >>> LostComponent(60, (12.0, 4.5, 7.0)).voxels
    60
    """

    voxels: int
    place: tuple[float, ...]
    size_in_cells: float | None = None


def voxel_components(
    inside: Bools,
    is_met: Bools,
    affine: Floats,
    box: Sequence[slice] = (),
    shares: Floats | None = None,
) -> tuple[int, tuple[LostComponent, ...]]:
    """Number of face-connected components of voxels, and those without one that `is_met`, the
    largest first.

    The voxels are in a `box` of the grid with this affine, by default at its corner; `shares` is
    the volume of each relative to that of its cell.
    """
    n_components, lost = component_runs(inside, is_met)
    component, row, begin, end = lost.T
    start, length = [side.start for side in box] or 0, end - begin
    of_voxel = np.repeat(np.unique(component, return_inverse=True)[1], length)
    along = np.repeat(begin - np.cumsum(length) + length, length) + np.arange(len(of_voxel))
    index = np.column_stack(
        np.unravel_index(np.repeat(row, length) * inside.shape[-1] + along, inside.shape)
    )
    sizes = np.bincount(of_voxel)
    sums = np.column_stack([np.bincount(of_voxel, column) for column in index.T])
    middle = sums / sizes[:, None]
    order = np.lexsort((((index - middle[of_voxel]) ** 2).sum(axis=1), of_voxel, -sizes[of_voxel]))
    near = order[np.sort(np.unique(of_voxel[order], return_index=True)[1])]  # the first of each
    places = transform_vectors(index[near] + start, affine[:-1, :-1]) + affine[:-1, -1]
    columns = [sizes[of_voxel[near]].tolist(), map(tuple, places.tolist())]
    if shares is not None:
        in_cells = np.bincount(of_voxel, shares[tuple(index.T)])
        columns.append(in_cells[of_voxel[near]].tolist())
    return n_components, tuple(map(LostComponent, *columns))


def voxel_euler(is_label: Bools) -> int:
    """Euler number of the closed surface of voxels that are connected by faces: 2 (components -
    holes + cavities).

    It is twice the Euler number of the enclosed solid: voxels, minus pairs that share a face, plus
    groups of four around an edge, minus groups of eight around a corner, for 6 neighbours inside
    and 26 outside (Kong and Rosenfeld 1989). In 2-D: pixels, minus pairs, plus groups of four.
    """
    n, total = is_label.ndim, 0
    for is_joined in itertools.product((False, True), repeat=n):
        together = is_label
        for axis in np.flatnonzero(is_joined):
            first, second = [slice(None)] * n, [slice(None)] * n
            first[axis], second[axis] = slice(None, -1), slice(1, None)
            together = together[tuple(first)] & together[tuple(second)]
        total += (-1) ** sum(is_joined) * int(np.count_nonzero(together))
    return 2 * total


def component_runs(inside: Bools, is_met: Bools, *, has_corners: bool = False) -> tuple[int, Ints]:
    """Number of components of voxels that faces connect, or corners, too, and the runs of those of
    which none is met.

    A run (L, 4) of voxels along the last axis has the number of its component, the number of its
    row, the first column, and the one after its last.
    """
    whole = (1,) * (3 - inside.ndim) + inside.shape
    n_components, lost = _component_runs(
        inside.reshape(whole), is_met.reshape(whole), int(has_corners)
    )
    return int(n_components), lost


@njit(cache=True, nogil=True)
def _component_runs(inside: NDArray, is_met: NDArray, reach: int) -> tuple[int, NDArray]:
    """`component_runs`: each run joins the runs of earlier rows that it touches, within `reach`
    columns.
    """
    n_planes, n_rows, n_columns = inside.shape
    first, n_runs = np.zeros(n_planes * n_rows + 1, dtype=np.int64), 0
    for at in range(n_planes * n_rows):
        own, was = inside[at // n_rows, at % n_rows], False
        for k in range(n_columns):
            n_runs += own[k] and not was
            was = own[k]
        first[at + 1] = n_runs
    # the run's root is in the first column later
    runs, root = np.empty((n_runs, 4), dtype=np.int64), np.arange(n_runs)
    has_met, number = np.zeros(n_runs, dtype=np.bool_), -1
    for at in range(n_planes * n_rows):
        i, j, was = at // n_rows, at % n_rows, False
        for k in range(n_columns):
            if inside[i, j, k]:
                number += not was
                runs[number, 1], runs[number, 2], runs[number, 3] = (
                    at,
                    runs[number, 2] if was else k,
                    k + 1,
                )
                has_met[number] |= is_met[i, j, k]
            was = inside[i, j, k]
        for a, b in ((i, j - 1), (i - 1, j - 1), (i - 1, j), (i - 1, j + 1)):
            if a < 0 or b < 0 or b == n_rows or (a != i and b != j and reach == 0):
                continue
            other, stop = first[a * n_rows + b], first[a * n_rows + b + 1]
            for run in range(first[at], first[at + 1]):
                while other < stop and runs[other, 3] + reach <= runs[run, 2]:
                    other += 1
                touched = other
                while touched < stop and runs[touched, 2] < runs[run, 3] + reach:
                    one, two = _root(root, run), _root(root, touched)
                    root[max(one, two)] = min(one, two)
                    touched += 1
    for run in range(n_runs):
        runs[run, 0] = _root(root, run)
        has_met[runs[run, 0]] |= has_met[run]
    return (root == np.arange(n_runs)).sum(), runs[~has_met[runs[:, 0]]]


@njit(cache=True, nogil=True)
def _root(root: NDArray, run: int) -> int:
    """The first run of a run's component, so far; ways to it are halved."""
    while root[run] != run:
        root[run] = root[root[run]]
        run = root[run]
    return run


def label_channels(number: NDArray[np.integer], n_labels: int) -> Ints:
    """A channel for each label: labels within `APART_VOXELS` voxels of one another have
    different ones.
    """
    shape = tuple(-(-s // APART_VOXELS) for s in number.shape)
    is_in, block = (
        np.zeros((n_labels, int(np.prod(shape))), dtype=bool),
        np.arange(np.prod(shape)).reshape(shape),
    )
    # the voxels of all blocks in turn
    for place in itertools.product(range(APART_VOXELS), repeat=number.ndim):
        part = number[tuple(slice(first, None, APART_VOXELS) for first in place)]
        is_in[part, block[tuple(slice(n) for n in part.shape)]] = True
    is_beside = np.stack([largest_around(row.reshape(shape), 1).ravel() for row in is_in])
    touches = is_beside.astype(np.float32) @ is_in.T.astype(np.float32) > 0.0
    channel = np.full(n_labels, -1, dtype=np.int64)
    for label in np.argsort(-touches.sum(axis=1), kind="stable"):
        taken = set(channel[touches[label]].tolist())
        channel[label] = next(c for c in range(n_labels) if c not in taken)
    return channel


def hex_colour(text: Any) -> tuple[float, float, float] | None:
    """Red, green and blue, 0 to 1, of "#rrggbb"; None for any other text."""
    if not isinstance(text, str) or len(text) != 7 or text[0] != "#":
        return None
    try:
        parts = bytes.fromhex(text[1:])
    except ValueError:
        return None
    return (parts[0] / 255.0, parts[1] / 255.0, parts[2] / 255.0)


def colours_by_number(labels: Ints) -> Floats:
    """Default colours (K, 3) of labels from 0: red, green and blue, 0 to 1; label 0 is light grey.

    They depend only on the number, so that a label has the same colour in every picture and file.
    Any two of as many successive labels as three palettes have different colours.
    """
    palette = np.array([hex_colour(text) for text in LABEL_PALETTE])
    rounds, place = np.divmod(labels - 1, len(palette))
    tint = np.array(LABEL_TINTS)[rounds % len(LABEL_TINTS)][:, None]
    mixed = (1.0 - np.abs(tint)) * palette[place] + np.maximum(tint, 0.0)
    mixed[labels == BACKGROUND_LABEL] = hex_colour(BACKGROUND_COLOUR)
    return np.rint(255.0 * mixed) / 255.0
