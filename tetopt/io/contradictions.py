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
from tetopt.io.volumes import note
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


def note_other_place(header: Any, shape: Sequence[int]) -> None:
    """Note a NIfTI header whose sform and qform, mm, place the voxels of a `shape` differently,
    beyond rounding.

    A sheared affine agrees with a rotated one next to it, because quaternions have no shear.
    """
    sform, sform_code = header.get_sform(coded=True)
    qform, qform_code = header.get_qform(coded=True)
    if sform is None or qform is None:
        return
    used = sform.astype(np.float64)
    other = qform.astype(np.float64)
    columns = used[:3, :3]
    others = other[:3, :3]
    steps = np.linalg.norm(columns, axis=0)
    if not (steps > 0.0).all() or not np.isfinite(used).all():
        return  # refused later
    left, _, right = np.linalg.svd(columns / steps)
    shear = columns - left @ right * steps
    ends = ([0.0, size - 1.0] for size in [*shape[:3], 1, 1][:3])
    corners = np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, 3)
    apart = np.linalg.norm(corners @ (columns - others).T + used[:3, 3] - other[:3, 3], axis=1)
    slack = SAME_VOXELS * steps.min() + SAME_FRACTION * np.linalg.norm(corners @ columns.T, axis=1)
    slack += 2.0 * np.linalg.norm(corners @ shear.T, axis=1)
    words = [f"place it differently, by up to {apart.max():.3g} mm"] * bool((apart > slack).any())
    if np.linalg.det(columns) * np.linalg.det(others) < 0.0:
        words.append("are mirror images of each other (left/right)")
    if words:
        spaces = [
            f" ({SPACES_OF_NIFTI.get(code, code)})" if sform_code != qform_code else ""
            for code in (sform_code, qform_code)
        ]
        note(
            f"the sform{spaces[0]} and the qform{spaces[1]} {', and '.join(words)}; "
            f"the sform{spaces[0]} is used, check it"
        )


def note_rest(rest: int, sizes: Sequence[int], value_bytes: int) -> None:
    """Note a file that goes on for a slice or more after the voxels that its header
    declares.
    """
    if rest >= value_bytes * math.prod(sizes[:2]):
        note(
            f"its header declares {' x '.join(map(str, sizes))} voxels, but the file has {rest} "
            "more bytes after them; check its sizes"
        )


def note_metaimage(fields: Mapping[str, str]) -> None:
    """Note oddities among the fields of a MetaImage header."""
    if "ElementSpacing" not in fields and "ElementSize" not in fields:
        note("has no voxel size: assuming 1 mm")
    matrix = next((_numbers(fields[key]) for key in DIRECTIONS if key in fields), np.zeros(0))
    # a row per axis of the voxels
    directions = matrix.reshape(3, 3) if len(matrix) == 9 else np.eye(3)
    letters = fields.get("AnatomicalOrientation", "").upper()
    if _is_other_orientation(letters, directions):
        along = "x".join(_along(directions, "LPS"))
        note(
            f"states directions {along}, which are used, and AnatomicalOrientation {letters}, "
            "which has other sides (left/right); check it"
        )


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


def note_nrrd(fields: Mapping[str, str], sizes: Sequence[int]) -> None:
    """Note oddities among the fields of an NRRD header, whose names are in lower case without
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
    space = fields.get("space", "")
    if "spacedirections" in fields:
        if space.lower() not in SPACES_OF_ITK:
            words = f'its space "{plain(space)}"' if space else "it has no space, which"
            note(
                f"{words} does not tell left from right: assuming left-posterior-superior, as ITK "
                "does"
            )
        return
    if space:
        raise InputError(
            f'its header has the space "{plain(space)}" but no "space directions"; add them'
        )
    n_axes = min(len(sizes), 3)  # a fourth axis, of components or times, may have none
    n_unknown = n_axes - int(np.isfinite(_numbers(fields.get("spacings", ""))).sum())
    if n_unknown > 0:
        along = "" if n_unknown == n_axes else f" along {n_unknown} of {n_axes} axes"
        note(f"has no voxel size{along}: assuming 1 mm")
    note(
        "it has no space, which leaves left and right open: assuming left-posterior-superior, as "
        "ITK does"
    )


def _numbers(text: str) -> Floats:
    """Parse numbers; empty if there are others, which the library will refuse."""
    try:
        return np.array([float(word) for word in text.split()])
    except ValueError:
        return np.zeros(0)
