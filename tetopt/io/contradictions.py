"""Warnings of headers that state the place, side or size of their voxels twice, differently.

Each reader's library uses one of the statements, by a rule of its format. The other one may be the
true one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.text import plain

SAME_VOXELS = 0.05  # of a voxel's shortest edge: positions this close are equal
# of a distance: quaternions in 32 bits turn an image by up to 7e-4 near half a turn
SAME_FRACTION = 2e-3
SAME_SIZE = 1e-3  # relative: rounded voxel sizes
# NIfTI's codes of spaces.
SPACES_OF_NIFTI = {
    1: "scanner space",
    2: "aligned space",
    3: "Talairach space",
    4: "MNI space",
    5: "template space",
}
# Fields of MetaImage that state the same; MetaIO uses the first that is there.
DIRECTIONS = ("TransformMatrix", "Rotation", "Orientation")
META_FIELDS = {
    key: keys
    for keys in (("ElementSpacing", "ElementSize"), ("Origin", "Offset", "Position"), DIRECTIONS)
    for key in keys
}
SPACES_OF_ITK = (  # of NRRD: ITK turns their coordinates to LPS and takes all others as LPS
    "left-posterior-superior",
    "lps",
    "right-anterior-superior",
    "ras",
    "left-anterior-superior",
    "las",
)


def notes_of_places(
    names: tuple[str, str],
    used: NDArray[np.float64],
    other: NDArray[np.float64],
    shape: Sequence[int],
) -> list[str]:
    """Return a warning if two affines, (n+1, n+1), mm, place the voxels of a `shape` differently,
    beyond rounding.

    A sheared affine agrees with a rotated one next to it, because quaternions have no shear.
    """
    n = len(used) - 1
    columns, others = used[:n, :n], other[:n, :n]
    steps, other_steps = np.linalg.norm(columns, axis=0), np.linalg.norm(others, axis=0)
    if not (steps > 0.0).all() or not np.isfinite(used).all():
        return []  # refused later
    left, _, right = np.linalg.svd(columns / steps)
    shear = columns - left @ right * steps
    corners = np.stack(np.meshgrid(*([0.0, size - 1.0] for size in shape[:n])), axis=-1).reshape(
        -1, n
    )
    apart = np.linalg.norm(corners @ (columns - others).T + used[:n, n] - other[:n, n], axis=1)
    slack = SAME_VOXELS * steps.min() + SAME_FRACTION * np.linalg.norm(corners @ columns.T, axis=1)
    slack += 2.0 * np.linalg.norm(corners @ shear.T, axis=1)
    words = (
        [f"place it differently, by up to {apart.max():.3g} mm"] if (apart > slack).any() else []
    )
    if np.linalg.det(columns) * np.linalg.det(others) < 0.0:
        words.append("are mirror images of each other (left/right)")
    if (
        np.abs(steps - other_steps) > (SAME_SIZE + 2.0 * np.abs(shear).max() / steps.min()) * steps
    ).any():
        words.append(f"have voxels of {sizes_words(steps)} and {sizes_words(other_steps)} mm")
    return (
        [f"{names[0]} and {names[1]} {', and '.join(words)}; {names[0]} is used, check it"]
        if words
        else []
    )


def notes_of_nifti(header: Any, shape: Sequence[int]) -> list[str]:
    """Return warnings of a NIfTI header."""
    sform, sform_code = header.get_sform(coded=True)
    qform, qform_code = header.get_qform(coded=True)
    notes = []
    if sform is not None and qform is not None:
        spaces = (
            ("", "")
            if sform_code == qform_code
            else [f" ({SPACES_OF_NIFTI.get(k, k)})" for k in (sform_code, qform_code)]
        )
        names = (f"the sform{spaces[0]}", f"the qform{spaces[1]}")
        notes += notes_of_places(
            names, sform.astype(np.float64), qform.astype(np.float64), [*shape[:3], 1, 1][:3]
        )
    elif sform is not None:
        n = min(len(shape), 3)
        steps = np.linalg.norm(sform[:3, :n], axis=0)
        sizes = np.array(header["pixdim"][1 : n + 1], dtype=np.float64)
        if not _is_alike(steps, sizes):
            notes.append(
                _two(f"an sform of {sizes_words(steps)} mm", f"pixdim {sizes_words(sizes)}")
            )
    elif qform is None and header.get_sform()[:3, :3].any():
        notes.append("its sform has code 0 (unset) and is ignored; give it a code if it is right")
    return notes


def notes_of_rest(rest: int, sizes: Sequence[int], value_bytes: int) -> list[str]:
    """Return a warning if a file goes on for a slice or more after the voxels that its header
    declares.
    """
    if rest < value_bytes * math.prod(sizes[:2]):
        return []
    words = " x ".join(map(str, sizes))
    return [
        f"its header declares {words} voxels, but the file has {rest} more bytes after them; "
        "check its sizes"
    ]


def notes_of_metaimage(stated: Sequence[tuple[str, str]]) -> list[str]:
    """Return warnings of the fields of a MetaImage header, in their order."""
    fields, notes = dict(stated), []
    for key, value in stated:
        # A field that is stated twice has the last value.
        used = next(each for each in (*META_FIELDS.get(key, ()), key) if each in fields)
        if value.split() != fields[used].split() and not _is_alike(
            _numbers(fields[used]), _numbers(value)
        ):
            notes.append(_two(f"{used} = {plain(fields[used])}", f"{key} = {plain(value)}"))
    if "ElementSpacing" not in fields and "ElementSize" not in fields:
        notes.append("has no voxel size: assuming 1 mm")
    matrix = next((_numbers(fields[key]) for key in DIRECTIONS if key in fields), np.zeros(0))
    # a row per axis of the voxels
    directions = matrix.reshape(3, 3) if len(matrix) == 9 else np.eye(3)
    lengths = np.linalg.norm(directions, axis=1)
    if not _is_alike(lengths, np.ones(3)):
        words = f"directions of lengths {sizes_words(lengths)}, which scale its voxel sizes"
        notes.append(f"states {words}; check them")
    letters = fields.get("AnatomicalOrientation", "").upper()
    if _is_other_orientation(letters, directions):
        along = "x".join(_along(directions, "LPS"))
        letters = f"AnatomicalOrientation {letters}, which has other sides (left/right)"
        notes.append(_two(f"directions {along}", letters))
    return notes


def _along(directions: NDArray[np.float64], ends: str) -> list[str]:
    """Return a letter per row, of the end of the world axis that it runs along, by the ends of
    +x, +y and +z.
    """
    opposite = dict(zip("LRPASI", "RLAPIS", strict=True))
    rows = np.arange(3), np.abs(directions).argmax(axis=1)
    return [
        ends[k] if sign > 0.0 else opposite[ends[k]]
        for k, sign in zip(rows[1], directions[rows], strict=True)
    ]


def _is_other_orientation(letters: str, directions: NDArray[np.float64]) -> bool:
    """Return whether MetaImage's three letters fit the directions neither as ends nor as beginnings
    of the axes.

    MetaIO's documents mean the ends, and ITK writes the beginnings.
    """
    if re.fullmatch("(?=.*[LR])(?=.*[PA])(?=.*[SI])[LRPASI]{3}", letters) is None:
        return False
    return letters not in ("".join(_along(directions, "LPS")), "".join(_along(directions, "RAI")))


def notes_of_nrrd(fields: Mapping[str, str], sizes: Sequence[int]) -> list[str]:
    """Return warnings of the fields of an NRRD header, whose names are in lower case without
    blanks.

    Raises
    ------
    InputError
        Without a leading path: two fields exclude each other.
    """
    for one, others in (
        ("spacedirections", ("spacings", "axismins", "axismaxs", "units")),
        ("space", ("spacedimension",)),
    ):
        for other in others:
            if one in fields and re.search(
                "[0-9a-z]", re.sub("nan|none", "", fields.get(other, "").lower())
            ):
                raise InputError(
                    f'its header has both "{one}" ({plain(fields[one])[:60]}) and "{other}" '
                    f"({plain(fields[other])[:60]}), which NRRD excludes; remove the wrong one"
                )
    space, notes = fields.get("space", ""), []
    if "spacedirections" in fields and space.lower() not in SPACES_OF_ITK:
        words = f'its space "{plain(space)}"' if space else "it has no space, which"
        notes.append(
            f"{words} does not tell left from right: assuming left-posterior-superior, as ITK does"
        )
    if "spacedirections" in fields:
        return notes
    if space:
        raise InputError(
            f'its header has the space "{plain(space)}" but no "space directions"; add them'
        )
    spacings = _numbers(fields.get("spacings", ""))
    mins, maxs = (_numbers(fields.get(key, "")) for key in ("axismins", "axismaxs"))
    n_axes = min(len(sizes), 3)  # a fourth axis, of components or times, may have none
    n_unknown = n_axes - int(np.isfinite(spacings).sum())
    if n_unknown > 0:
        along = "" if n_unknown == n_axes else f" along {n_unknown} of {n_axes} axes"
        notes.append(f"has no voxel size{along}: assuming 1 mm")
    spacings = (
        np.where(np.isfinite(spacings), spacings, 1.0) if len(spacings) else np.ones(len(sizes))
    )
    if len(mins) == len(maxs) == len(spacings) == len(sizes):
        # of cells, of nodes
        steps = [(maxs - mins) / np.maximum(np.array(sizes) - k, 1) for k in (0, 1)]
        if not any(_is_alike(spacings, each) for each in steps):
            by_ends = f"axis mins and maxs of {sizes_words(steps[0])}"
            notes.append(_two(f"spacings {sizes_words(spacings)}", by_ends))
    notes.append(
        "it has no space, which leaves left and right open: assuming left-posterior-superior, as "
        "ITK does"
    )
    return notes


def _numbers(text: str) -> NDArray[np.float64]:
    """Parse numbers; empty if there are others, which the library will refuse."""
    try:
        return np.array([float(word) for word in text.split()])
    except ValueError:
        return np.zeros(0)


def _is_alike(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether two lists of numbers are the same but for rounding."""
    if len(one) != len(other) or not len(one):
        return False
    return bool((np.abs(one - other) <= SAME_SIZE * (np.abs(other) + np.abs(one).max())).all())


def _two(used: str, other: str) -> str:
    """Return a warning of two statements that differ."""
    return f"states {used}, which is used, and {other}; check it"


def sizes_words(values: NDArray[np.float64]) -> str:
    """Format lengths along axes."""
    return " x ".join(f"{value:.4g}" for value in values)
