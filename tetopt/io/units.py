"""Units of length in the headers of images, converted to millimetres: the same words for all
formats.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from tetopt.errors import InputError
from tetopt.io.text import plain
from tetopt.io.volumes import note
from tetopt.system.arrays import Floats

# NGFF's units of length, with names of UDUNITS-2, in mm.
PREFIXES = "yocto zepto atto femto pico nano micro milli  kilo mega giga tera peta exa zetta yotta"
MM_PER_LENGTH = {
    f"{prefix}meter": float(f"1e{power}")
    for prefix, power in zip(PREFIXES.split(" "), range(-21, 30, 3), strict=True)
} | {
    "angstrom": 1e-7,
    "centimeter": 10.0,
    "decimeter": 100.0,
    "hectometer": 1e5,
    "inch": 25.4,
    "foot": 304.8,
    "yard": 914.4,
    "mile": 1609344.0,
    "parsec": 3.0856775814913674e19,
}
# Other words for them, in lower case, without a plural's s; "MM" and "Um" are written by programs
# for mm and um.
SHORT_WORDS = {
    "m": "meter",
    "dm": "decimeter",
    "cm": "centimeter",
    "mm": "millimeter",
    "um": "micrometer",
    "nm": "nanometer",
    "pm": "picometer",
    "km": "kilometer",
    "micron": "micrometer",
    "in": "inch",
    "inche": "inch",
    "ft": "foot",
    "feet": "foot",
}
# words for a missing unit
NO_UNITS = ("", "?", "none", "n/a", "unknown", "unit", "unitless", "pixel", "voxel")
# The micro sign and the Greek letter, also as UTF-8 read as Latin-1, and as ImageJ's escape.
MICRO = re.compile(r"\\u00b5|\\u03bc|\xc2\xb5|\xce\xbc|\xb5|\u03bc", re.IGNORECASE)
# mm, longest side of an image's box: a body is shorter than the first; beyond these, the unit is
# probably not mm.
LONGEST_BOX, SHORTEST_BOX = 3000.0, 1.0


def mm_of_unit(word: str, name: str = "unit") -> float | None:
    """Return the length of a unit, mm; None for a word that means that there is no unit.

    Raises
    ------
    InputError
        The word is not a length; the message begins with `name`.

    Examples
    --------
    >>> mm_of_unit("microns"), mm_of_unit("Millimetres"), mm_of_unit("pixel")
    (0.001, 1.0, None)
    """
    key = MICRO.sub("u", word.strip()).lower().replace("metre", "meter")
    for each in (key, key.removesuffix("s") or key):
        if each in NO_UNITS:
            return None
        if (mm := MM_PER_LENGTH.get(SHORT_WORDS.get(each, each))) is not None:
            return mm
    raise InputError(
        f'{name}: expected a length such as "mm" or "um", got "{plain(word[:40])}"; correct the '
        "header"
    )


def mm_of_axes(words: Sequence[str], name: str) -> Floats | None:
    """Return the length of each axis's unit, mm, assuming mm where one is missing; None if all are
    missing.

    Adds a note if only some are missing, or a word stands there that is not a unit, such as
    "pixel".

    Raises
    ------
    InputError
        A word is not a length.
    """
    lengths = [mm_of_unit(word, name) for word in words]
    missing = [axis for axis, mm in enumerate(lengths) if mm is None]
    is_whole = len(missing) == len(words)
    if missing and (not is_whole or any(words)):
        listed = ", ".join(f'axis {axis}: "{plain(words[axis])}"' for axis in missing)
        note(f"{name}: expected a unit of length, got none for {listed}; assuming mm")
    return None if is_whole else np.array([1.0 if mm is None else mm for mm in lengths])


def note_size(shape: Sequence[int], affine: Floats, lengths: Floats | None) -> None:
    """Note an unusual longest side of the image's box.

    `lengths` are those of the axes' units, mm; None if the file states no unit, which may then be
    another than mm.
    """
    steps = np.linalg.norm(affine[:-1, :-1], axis=0)
    longest = max(float(step) * size for step, size in zip(steps, shape, strict=False))
    if SHORTEST_BOX <= longest <= LONGEST_BOX or (lengths is not None and (lengths != 1.0).any()):
        return
    voxel = " x ".join(f"{step:.4g}" for step in steps)
    rest = (
        f"; are its voxels {voxel} mm, or in another unit?"
        if lengths is None
        else ", in the unit that its header states"
    )
    note(f"the longest side of its box is {longest:.4g} mm{rest}")
