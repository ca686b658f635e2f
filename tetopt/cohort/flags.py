"""Flags of odd subjects: violated requirements, lost labels, another grid, outlying numbers."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np

from tetopt.cohort.numbers import Row, Value, present
from tetopt.model.label_names import label_words

# A normal number exceeds this distance from the median in 1 case of 1.7 million; cohorts have
# longer tails.
FAR_DEVIATIONS = 5.0
# The MAD of n numbers is itself uncertain: the limit is (1 + 8 / n) times as far. In simulations
# (`tests/cohort/test_flags.py`), normal numbers are flagged in at most 1 case of 1000 for every n
# from 8 on.
FEW_SUBJECTS = 8  # with fewer, numbers are not judged; also the 8 above
# standard deviations of normal numbers to one MAD: 1 / Phi^-1(3/4)
MAD_OF_NORMAL = 1.482602218505602
MAJORITY_FRACTION = 2 / 3  # of subjects that agree: with fewer there is no common value
COMMON_FRACTION = 0.9  # of subjects that have what others lack: with fewer it is a choice
SHORT_RATIO = 20.0  # of two numbers in one unit: beyond, the smaller one has too many leading zeros
FLOAT_ROUNDING = 1e-9  # tolerance in deviations for a number at the limit

Side = Literal["both", "above", "below"]


class Flag(NamedTuple):
    """A flag of a subject."""

    column: str  # from `tetopt.cohort.numbers`, or "violated" or "label"
    words: str  # the reason, on one line
    score: float  # robust deviations; inf for oddities that are not numbers


class Quantity(NamedTuple):
    """A number in which subjects are compared."""

    column: str
    words: str  # its name, which may precede its value
    unit: str  # "mm": volume by dimension; "s", "bytes", "" or any other word
    side: Side
    is_log: bool  # ratios count, not differences
    least: float  # of the scale: lower limit of a robust deviation, of the logarithm if `is_log`


# The least scales are differences too small to inspect an image: 5 % of a volume, 1 degree, 0.002
# of rho.
QUANTITIES = (
    Quantity(
        "energies.E_D_fraction_of_variance",
        "E_D's fraction of the variance",
        "",
        "both",
        True,
        0.05,
    ),
    Quantity("quality.mean_rho", "mean rho", "", "both", False, 0.002),
    Quantity("quality.min_dihedral", "smallest angle", "degrees", "below", False, 1.0),
    Quantity("grid.volume_mm", "volume of the image", "mm", "both", True, 0.05),
    Quantity("mask.volume", "volume of the mask", "mm", "both", True, 0.05),
    Quantity("mask.dice", "Dice of mesh and mask", "", "below", False, 0.005),
    Quantity("grid.oblique_degrees", "obliqueness", "degrees", "above", False, 2.0),
    Quantity("size.n_cells", "number of cells", "", "both", True, 0.1),
    Quantity("seconds.all", "time", "s", "above", True, 0.2),
    Quantity("memory.peak_bytes", "memory", "bytes", "above", True, 0.1),
)
GRID_COLUMNS = {
    "grid.orientation": "orientation",
    "grid.spacing_mm": "voxels in mm",
    "grid.shape": "voxels along the axes",
    "versions.tetopt": "version of tetopt",
}


def label_quantities(number: int, names: dict[int, str]) -> tuple[Quantity, Quantity]:
    """Return volume and Dice of a label as quantities."""
    words = label_words(number, names)
    return (
        Quantity(f"labels.{number}.volume", f"volume of label {words}", "mm", "both", True, 0.05),
        Quantity(f"labels.{number}.dice", f"Dice of label {words}", "", "below", False, 0.02),
    )


def flags_of(rows: Sequence[Row]) -> list[list[Flag]]:
    """Return the flags of each row, the oddest first; none without a mesh.

    Parameters
    ----------
    rows : sequence of Row

    Returns
    -------
    list of list of Flag
        For each row: violated requirements; labels without a cell, and labels that 9 of 10 others
        have and its image lacks, or vice versa; another orientation, spacing or shape than two
        thirds have; with 8 or more subjects, numbers more than `limit` robust deviations from the
        median. 2-D and 3-D meshes are compared separately.
    """
    flags: list[list[Flag]] = [[] for _ in rows]
    for ndim, places in _groups(rows).items():
        own = [rows[place] for place in places]
        names = {number: name for row in reversed(own) for number, name in row.label_names.items()}
        for flagged_by in (_violations, _absent, _grids):
            for place, flag in flagged_by(own, names):
                flags[places[place]].append(flag)
        dimension = 2 if ndim == 2 else 3
        for place, flag in _far(own, names, dimension):
            flags[places[place]].append(flag)
    return [sorted(each, key=lambda flag: -flag.score) for each in flags]


def comparisons_left_out(rows: Sequence[Row]) -> list[str]:
    """Return, a sentence each, comparisons that are not made: too few rows, or values too mixed to
    have outliers.

    Parameters
    ----------
    rows : sequence of Row

    Returns
    -------
    list of str
        For all 2-D and all 3-D meshes, as in `flags_of`.
    """
    sentences = []
    for ndim, places in _groups(rows).items():
        own, kind = [rows[place] for place in places], f"{'2-D' if ndim == 2 else '3-D'} meshes"
        if len(own) < FEW_SUBJECTS:
            sentences.append(
                f"{len(own)} {kind} are too few to compare their numbers ({FEW_SUBJECTS} needed)."
            )
        mixed = [
            words for column, words in GRID_COLUMNS.items() if _is_mixed(_values_of(own, column))
        ]
        if mixed:
            sentences.append(
                f"The {len(own)} {kind} are too mixed to judge by {', '.join(mixed)}: no value "
                "is common to "
                "two thirds of them."
            )
    return sentences


def _groups(rows: Sequence[Row]) -> dict[Value, list[int]]:
    """Return the places of rows with a mesh, by dimension."""
    groups: dict[Value, list[int]] = defaultdict(list)
    for place, row in enumerate(rows):
        if row.status in ("done", "violated"):
            groups[row.numbers.get("quality.ndim")].append(place)
    return groups


def _values_of(rows: Sequence[Row], column: str) -> list[Value]:
    return [text for row in rows if (text := row.numbers.get(column)) is not None]


def _is_mixed(texts: Sequence[Value]) -> bool:
    """Return whether there are several values without a majority; two different values are
    mixed.
    """
    if len(set(texts)) < 2:
        return False
    count = Counter(texts).most_common(1)[0][1]
    return len(texts) < 3 or count < MAJORITY_FRACTION * len(texts) - FLOAT_ROUNDING


Flagged = Iterator[tuple[int, Flag]]


def _violations(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    for place, row in enumerate(rows):
        for name in row.violated:
            yield place, Flag("violated", f"violated {name}", np.inf)
        for number, n_voxels in row.n_lost.items():
            words = f"lost label {label_words(number, names)}"
            yield place, Flag("label", f"{words}: it has {n_voxels} voxels but no cell", np.inf)


def _absent(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    """Yield flags of labels that nearly all others have, or nearly none."""
    labelled = [place for place, row in enumerate(rows) if row.volumes]
    counts = Counter(number for place in labelled for number in rows[place].volumes)
    for number, count in counts.items():
        words = label_words(number, names)
        beside = f"{count} of {len(labelled)} have it"
        if COMMON_FRACTION * len(labelled) <= count < len(labelled):
            for place in labelled:
                if number not in rows[place].volumes:
                    yield place, Flag("label", f"no label {words} in its image: {beside}", np.inf)
        elif (
            len(labelled) >= FEW_SUBJECTS
            and count <= (1.0 - COMMON_FRACTION) * len(labelled) + FLOAT_ROUNDING
        ):
            for place in labelled:
                if number in rows[place].volumes:
                    yield place, Flag("label", f"label {words} in its image: {beside}", np.inf)


def _grids(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    """Yield flags of orientations and the like that differ from a majority."""
    for column, words in GRID_COLUMNS.items():
        texts, known = [row.numbers.get(column) for row in rows], _values_of(rows, column)
        if len(set(known)) < 2 or _is_mixed(known):
            continue
        usual, count = Counter(known).most_common(1)[0]
        for place, text in enumerate(texts):
            if text is not None and text != usual:
                yield (
                    place,
                    Flag(column, f"{words} {text}: {count} of {len(known)} have {usual}", np.inf),
                )


def _far(rows: Sequence[Row], names: dict[int, str], ndim: int) -> Flagged:
    """Yield flags of numbers far from the median."""
    numbers = sorted({number for row in rows for number in row.volumes if number > 0})
    of_labels = [each for number in numbers for each in label_quantities(number, names)]
    for quantity in (*QUANTITIES, *of_labels):
        yield from _far_in(quantity, [row.numbers.get(quantity.column) for row in rows], ndim)


def _far_in(quantity: Quantity, values: Sequence[Value], ndim: int) -> Flagged:
    known = np.array(present(values))
    if len(known) < FEW_SUBJECTS or (quantity.is_log and not (known > 0.0).any()):
        return
    scores = deviations(known, quantity.is_log, quantity.least)
    far = limit(len(known))
    written = units(quantity.unit, ndim)
    places = [place for place, value in enumerate(values) if present([value])]
    for k, (place, value, score) in enumerate(
        zip(places, known.tolist(), scores.tolist(), strict=True)
    ):
        side = "above" if score > 0.0 else "below"
        if abs(score) > far and quantity.side in ("both", side):
            usual = float(np.median(np.delete(known, k)))
            measure = f" ({abs(score):.0f} robust deviations)" if np.isfinite(score) else ""
            beside = f"far {side} the others' median {written(usual, value)}{measure}"
            yield (
                place,
                Flag(
                    quantity.column,
                    f"{quantity.words} is {written(value, usual)}, {beside}",
                    abs(score),
                ),
            )


def deviations(values: np.ndarray, is_log: bool, least: float) -> np.ndarray:
    """Return the distances of numbers from their median, in robust standard deviations.

    Parameters
    ----------
    values : (K,) float
        At least one.
    is_log : bool
        Use logarithms; a number without one is at -inf.
    least : float
        Lower limit of a deviation, above 0, as the MAD is 0 if most numbers are equal.

    Returns
    -------
    (K,) float
        (x - median) / max(1.4826 MAD, least), with MAD the median of |x - median| (Rousseeuw and
        Croux, Alternatives to the Median Absolute Deviation, J. Am. Stat. Assoc. 88, 1993).

    Examples
    --------
    >>> deviations(np.array([1.0, 1.0, 1.0, 2.0]), False, 0.1).tolist()
    [0.0, 0.0, 0.0, 10.0]
    """
    # if most are at -inf: nan, which is not far
    with np.errstate(divide="ignore", invalid="ignore"):
        x = np.log(np.maximum(values, 0.0)) if is_log else values
        distance = x - np.median(x[np.isfinite(x)])
        return distance / max(MAD_OF_NORMAL * float(np.median(np.abs(distance))), least)


def limit(n: int) -> float:
    """Return the robust deviations from which one of n numbers is far.

    Examples
    --------
    >>> limit(8), limit(80)
    (10.0, 5.5)
    """
    return FAR_DEVIATIONS * (1.0 + FEW_SUBJECTS / n)


def units(unit: str, ndim: int) -> Callable[..., str]:
    """Return a formatter for numbers of a unit: volumes in mm^n as ml or l, bytes as MB or GB,
    seconds as min or h.

    It takes the number and, optionally, a number shown with it: if neither is `SHORT_RATIO` times
    the other, both are written in the larger one's unit.

    Examples
    --------
    >>> units("mm", 3)(1.43e6), units("bytes", 3)(2.5e9), units("s", 3)(90.0), units("", 3)(0.1234)
    ('1.43 l', '2.5 GB', '1.5 min', '0.123')
    >>> units("mm", 3)(4e5, 1.43e6), units("mm", 3)(1.43e6, 4e5), units("mm", 3)(3e3, 1.43e6)
    ('0.4 l', '1.43 l', '3 ml')
    """
    steps = {
        "mm": [(1e6, "l"), (1e3, "ml"), (1.0, "mm^3")]
        if ndim == 3
        else [(1e2, "cm^2"), (1.0, "mm^2")],
        "bytes": [(1e9, "GB"), (1e6, "MB"), (1.0, "bytes")],
        "s": [(3600.0, "h"), (60.0, "min"), (1.0, "s")],
    }.get(unit, [(1.0, unit)])

    def written(value: float, beside: float = 0.0) -> str:
        size = max(abs(value), abs(beside) if abs(beside) < SHORT_RATIO * abs(value) else 0.0)
        factor, word = next((step for step in steps if size >= step[0]), steps[-1])
        number = value / factor
        return (
            f"{number:.3g} {word}".strip() if abs(number) < 1e3 else f"{number:,.0f} {word}".strip()
        )

    return written
