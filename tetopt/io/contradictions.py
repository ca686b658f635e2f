"""Warnings of headers that state the place or the sides of their voxels twice, differently, or not
at all.

Each reader's library uses one of the statements, by a rule of its format. The other one may be the
true one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tetopt.errors import InputError
from tetopt.io.text import plain
from tetopt.system.arrays import Floats

SAME_VOXELS = 0.05  # of a voxel's shortest edge: positions this close are equal
# of a distance: quaternions in 32 bits turn an image by up to 7e-4 near half a turn
SAME_FRACTION = 2e-3
# NIfTI's codes of spaces.
SPACES_OF_NIFTI = {
    1: "scanner space",
    2: "aligned space",
    3: "Talairach space",
    4: "MNI space",
    5: "template space",
}
# Fields of MetaImage; MetaIO uses the first that is there.
DIRECTIONS = ("TransformMatrix", "Rotation", "Orientation")
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
    used: Floats,
    other: Floats,
    shape: Sequence[int],
) -> list[str]:
    """Return a warning if two affines, (n+1, n+1), mm, place the voxels of a `shape` differently,
    beyond rounding.

    A sheared affine agrees with a rotated one next to it, because quaternions have no shear.
    """
    n = len(used) - 1
    columns, others = used[:n, :n], other[:n, :n]
    steps = np.linalg.norm(columns, axis=0)
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
    return (
        [f"{names[0]} and {names[1]} {', and '.join(words)}; {names[0]} is used, check it"]
        if words
        else []
    )


def notes_of_nifti(header: Any, shape: Sequence[int]) -> list[str]:
    """Return a warning if the sform and the qform of a NIfTI header differ."""
    sform, sform_code = header.get_sform(coded=True)
    qform, qform_code = header.get_qform(coded=True)
    if sform is None or qform is None:
        return []
    spaces = [
        f" ({SPACES_OF_NIFTI.get(code, code)})" if sform_code != qform_code else ""
        for code in (sform_code, qform_code)
    ]
    names = (f"the sform{spaces[0]}", f"the qform{spaces[1]}")
    return notes_of_places(
        names, sform.astype(np.float64), qform.astype(np.float64), [*shape[:3], 1, 1][:3]
    )


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


def notes_of_metaimage(fields: Mapping[str, str]) -> list[str]:
    """Return warnings of the fields of a MetaImage header."""
    notes = []
    if "ElementSpacing" not in fields and "ElementSize" not in fields:
        notes.append("has no voxel size: assuming 1 mm")
    matrix = next((_numbers(fields[key]) for key in DIRECTIONS if key in fields), np.zeros(0))
    # a row per axis of the voxels
    directions = matrix.reshape(3, 3) if len(matrix) == 9 else np.eye(3)
    letters = fields.get("AnatomicalOrientation", "").upper()
    if _is_other_orientation(letters, directions):
        along = "x".join(_along(directions, "LPS"))
        notes.append(
            f"states directions {along}, which are used, and AnatomicalOrientation {letters}, "
            "which has other sides (left/right); check it"
        )
    return notes


def _along(directions: Floats, ends: str) -> list[str]:
    """Return a letter per row, of the end of the world axis that it runs along, by the ends of
    +x, +y and +z.
    """
    opposite = dict(zip("LRPASI", "RLAPIS", strict=True))
    rows = np.arange(3), np.abs(directions).argmax(axis=1)
    return [
        ends[k] if sign > 0.0 else opposite[ends[k]]
        for k, sign in zip(rows[1], directions[rows], strict=True)
    ]


def _is_other_orientation(letters: str, directions: Floats) -> bool:
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
    n_axes = min(len(sizes), 3)  # a fourth axis, of components or times, may have none
    n_unknown = n_axes - int(np.isfinite(spacings).sum())
    if n_unknown > 0:
        along = "" if n_unknown == n_axes else f" along {n_unknown} of {n_axes} axes"
        notes.append(f"has no voxel size{along}: assuming 1 mm")
    notes.append(
        "it has no space, which leaves left and right open: assuming left-posterior-superior, as "
        "ITK does"
    )
    return notes


def _numbers(text: str) -> Floats:
    """Parse numbers; empty if there are others, which the library will refuse."""
    try:
        return np.array([float(word) for word in text.split()])
    except ValueError:
        return np.zeros(0)
