"""What is odd about a subject beside the others: violated requirements, lost labels, another grid, numbers far off."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np

from tetopt.cohort.numbers import Row, Value, present
from tetopt.model.labels import label_words

# A normal number is further from the median than this in 1 case of 1.7 million; those of cohorts have longer tails.
FAR_DEVIATIONS = 5.0
# The MAD of n numbers is itself uncertain: with n of them the limit is (1 + 8 / n) times as far. Flagged by drawing
# (`tests/cohort/test_flags.py`): normal numbers are flagged in at most 1 case of 1000 at every n from 8 on.
FEW_SUBJECTS = 8  # with fewer, nothing is said of numbers; also the 8 above
MAD_OF_NORMAL = 1.482602218505602  # standard deviations of normal numbers to one MAD: 1 / Phi^-1(3/4)
MAJORITY_FRACTION = 2 / 3  # of subjects that agree: with fewer there is nothing that the others differ from
COMMON_FRACTION = 0.9  # of subjects that have what the others lack: in fewer it is a matter of choice
LEAST_LIKENESS = 0.01  # of the scale of correlations: heads of one size, in one place, differ by as much
# Of correlations, by which a picture is more like the others' turned over: those of a symmetric head, meshed anew, lie
# within 0.001 on either side, those of heads with back and front exchanged at 0.01 (whole) to 0.12 (brains).
TURN_MARGIN = 0.005
# Turned over, the others' median would be about as far on the other side of 0; what is cut off is at a fifth of that.
TURN_FRACTION = 1 / 3
SIDED_DEVIATIONS = 1.5  # by which the others' median is below 0: normal numbers are there in 9 of 10 at least
TURN_DEVIATIONS = 2.5  # beyond the median: 6 of 1000 normal numbers, most of which are below the margin
SHORT_RATIO = 20.0  # of two numbers in one unit: beyond, the smaller one has too many zeros behind the point
FLOAT_ROUNDING = 1e-9  # deviations by which a number may be beside the limit that it is at

Side = Literal["both", "above", "below"]


class Flag(NamedTuple):
    """One odd thing about a subject."""

    column: str  # of `tetopt.cohort.numbers`, or "violated", "label", "duplicate"
    words: str  # the reason, on one line
    score: float  # robust deviations; inf for what is odd without measuring


class Quantity(NamedTuple):
    """A number in which subjects are compared."""

    column: str
    words: str  # what it is, after which its value can stand
    unit: str  # "mm": volume by dimension; "s", "bytes", "" or any other word
    side: Side
    is_log: bool  # ratios count, not differences
    least: float  # of the scale: a robust deviation is never taken for less, of the logarithm if `is_log`


# The least scales are differences that nobody would look at an image for: 5 % of a volume, 1 degree, 0.002 of rho.
QUANTITIES = (
    Quantity("thumbnail.likeness", "likeness of its picture to the others'", "", "below", False, LEAST_LIKENESS),
    Quantity("energies.E_D_fraction_of_variance", "E_D's fraction of the variance", "", "both", True, 0.05),
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
    "grid.orientation": "orientation", "grid.spacing_mm": "voxels in mm", "grid.shape": "voxels along the axes",
    "versions.tetopt": "version of tetopt",
}  # fmt: skip
TURN_WORDS = {
    "thumbnail.left_right": "left and right exchanged", "thumbnail.back_front": "back and front exchanged",
    "thumbnail.upside_down": "up and down exchanged",
}  # fmt: skip


def label_quantities(number: int, names: dict[int, str]) -> tuple[Quantity, Quantity]:
    """Volume and Dice of a label."""
    words = label_words(number, names)
    return (
        Quantity(f"labels.{number}.volume", f"volume of label {words}", "mm", "both", True, 0.05),
        Quantity(f"labels.{number}.dice", f"Dice of label {words}", "", "below", False, 0.02),
    )


def flags_of(rows: Sequence[Row]) -> list[list[Flag]]:
    """What is odd about each of the rows, the oddest first; nothing of those without a mesh.

    Parameters
    ----------
    rows : sequence of Row

    Returns
    -------
    list of list of Flag
        Of each row: requirements that its mesh violates; labels that no cell carries, and labels that 9 of 10 others
        have and its image has not, or the other way round; an image that another subject has, too; another orientation,
        spacing or shape than two thirds have; of 8 or more subjects, a picture that is clearly more like the others'
        turned over, and numbers more than `limit` robust deviations from the median. 2-D and 3-D meshes are compared
        each with their like.
    """
    flags: list[list[Flag]] = [[] for _ in rows]
    for ndim, places in _groups(rows).items():
        own = [rows[place] for place in places]
        names = {number: name for row in reversed(own) for number, name in row.label_names.items()}
        for flagged_by in (_violations, _lost, _absent, _doubled, _grids, _turned):
            for place, flag in flagged_by(own, names):
                flags[places[place]].append(flag)
        dimension = 2 if ndim == 2 else 3
        for place, flag in _far(own, names, dimension):
            flags[places[place]].append(flag)
    return [sorted(each, key=lambda flag: -flag.score) for each in flags]


def unjudged(rows: Sequence[Row]) -> list[str]:
    """What rows are not compared in, a sentence each: they are too few, or so mixed that none of them is the odd one.

    Parameters
    ----------
    rows : sequence of Row

    Returns
    -------
    list of str
        Of all 2-D and all 3-D meshes, as of `flags_of`.
    """
    sentences = []
    for ndim, places in _groups(rows).items():
        own, kind = [rows[place] for place in places], f"{'2-D' if ndim == 2 else '3-D'} meshes"
        if len(own) < FEW_SUBJECTS:
            sentences.append(f"{len(own)} {kind} are too few to compare their numbers; {FEW_SUBJECTS} are enough.")
        mixed = [words for column, words in GRID_COLUMNS.items() if _is_mixed(_known(own, column))]
        if mixed:
            sentences.append(
                f"The {len(own)} {kind} are too mixed to judge by {', '.join(mixed)}: no value is shared by "
                "two thirds of them."
            )
    return sentences


def _groups(rows: Sequence[Row]) -> dict[Value, list[int]]:
    """Places of the rows that have a mesh, by its dimension."""
    groups: dict[Value, list[int]] = defaultdict(list)
    for place, row in enumerate(rows):
        if row.status in ("done", "violated"):
            groups[row.numbers.get("quality.ndim")].append(place)
    return groups


def _known(rows: Sequence[Row], column: str) -> list[Value]:
    return [text for row in rows if (text := row.numbers.get(column)) is not None]


def _is_mixed(texts: Sequence[Value]) -> bool:
    """Whether there are several, and no one is that of a majority; two against each other are mixed."""
    if len(set(texts)) < 2:
        return False
    count = Counter(texts).most_common(1)[0][1]
    return len(texts) < 3 or count < MAJORITY_FRACTION * len(texts) - FLOAT_ROUNDING


Flagged = Iterator[tuple[int, Flag]]


def _violations(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    for place, row in enumerate(rows):
        for name in row.violated:
            if not (name == "labels" and row.n_lost):
                yield place, Flag("violated", f"violated {name}", np.inf)


def _lost(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    for place, row in enumerate(rows):
        for number, n_voxels in row.n_lost.items():
            words = f"lost label {label_words(number, names)}"
            yield place, Flag("label", f"{words}: no cell has it, {n_voxels} voxels do", np.inf)


def _absent(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    """Labels that nearly all others have, or nearly none."""
    labelled = [place for place, row in enumerate(rows) if row.volumes]
    counts = Counter(number for place in labelled for number in rows[place].volumes)
    for number, count in counts.items():
        words = label_words(number, names)
        beside = f"{count} of {len(labelled)} have it"
        if COMMON_FRACTION * len(labelled) <= count < len(labelled):
            for place in labelled:
                if number not in rows[place].volumes:
                    yield place, Flag("label", f"no label {words} in its image: {beside}", np.inf)
        elif len(labelled) >= FEW_SUBJECTS and count <= (1.0 - COMMON_FRACTION) * len(labelled) + FLOAT_ROUNDING:
            for place in labelled:
                if number in rows[place].volumes:
                    yield place, Flag("label", f"label {words} in its image: {beside}", np.inf)


def _doubled(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    """Images that several subjects have."""
    same: dict[Value, list[int]] = defaultdict(list)
    for place, row in enumerate(rows):
        if row.numbers.get("image_sha256") is not None:
            same[_whole_image(row)].append(place)
    for places in same.values():
        for place in places if len(places) > 1 else ():
            other = rows[next(each for each in places if each != place)].key
            more = f" and {len(places) - 2} more" if len(places) > 2 else ""
            yield place, Flag("duplicate", f"the same image as {other}{more}", np.inf)


def _whole_image(row: Row) -> str:
    """The image that is meshed: the file's checksum, and which part of it."""
    part = [row.numbers.get(f"options.{name}") for name in ("volume", "crop", "slice")]
    return f"{row.numbers['image_sha256']} {part}"


def _grids(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    """Orientations and the like that a majority does not have."""
    for column, words in GRID_COLUMNS.items():
        texts, known = [row.numbers.get(column) for row in rows], _known(rows, column)
        if len(set(known)) < 2 or _is_mixed(known):
            continue
        usual, count = Counter(known).most_common(1)[0]
        for place, text in enumerate(texts):
            if text is not None and text != usual:
                yield place, Flag(column, f"{words} {text}: {count} of {len(known)} have {usual}", np.inf)


def _turned(rows: Sequence[Row], names: dict[int, str]) -> Flagged:
    """Pictures that are more like the others' turned over, where the others are clearly less so."""
    for column, words in TURN_WORDS.items():
        places = [place for place, row in enumerate(rows) if present([row.numbers.get(column)])]
        values = np.array(present(row.numbers.get(column) for row in rows))
        n_usual = int((values < 0.0).sum())
        if len(values) < FEW_SUBJECTS or n_usual < MAJORITY_FRACTION * len(values) - FLOAT_ROUNDING:
            continue  # few, or no telling which of them are turned over
        middle = float(np.median(values))
        spread = MAD_OF_NORMAL * float(np.median(np.abs(values - middle)))
        if middle + SIDED_DEVIATIONS * spread > -TURN_MARGIN:
            continue  # of a shape that tells no sides apart
        least = max(TURN_MARGIN, -TURN_FRACTION * middle, middle + TURN_DEVIATIONS * spread)
        likeness = present(row.numbers.get("thumbnail.likeness") for row in rows)
        for k in np.flatnonzero(values >= least).tolist():
            if _is_like(rows[places[k]], values[k], likeness):
                reason = f"its picture is more like the others' with {words}; {n_usual} of {len(values)} are less so"
                yield places[k], Flag(column, reason, np.inf)


def _is_like(row: Row, margin: float, likeness: list[float]) -> bool:
    """Whether a picture that is turned over is as like the others' as those are: one that is cut off is not."""
    turned = present([row.numbers.get("thumbnail.likeness")])[0] + margin
    score = deviations(np.array([*likeness, turned]), False, LEAST_LIKENESS)[-1]
    return bool(score > -limit(len(likeness)))


def _far(rows: Sequence[Row], names: dict[int, str], ndim: int) -> Flagged:
    """Numbers far from the median."""
    for quantity in QUANTITIES:
        yield from _far_in(quantity, [row.numbers.get(quantity.column) for row in rows], ndim)
    numbers = sorted({number for row in rows for number in row.volumes if number > 0})
    for number in numbers:
        for quantity in label_quantities(number, names):
            yield from _far_in(quantity, [row.numbers.get(quantity.column) for row in rows], ndim)


def _far_in(quantity: Quantity, values: Sequence[Value], ndim: int) -> Flagged:
    known = np.array(present(values))
    if len(known) < FEW_SUBJECTS or (quantity.is_log and not (known > 0.0).any()):
        return
    scores = deviations(known, quantity.is_log, quantity.least)
    far = limit(len(known))
    written = units(quantity.unit, ndim)
    places = [place for place, value in enumerate(values) if present([value])]
    for k, (place, value, score) in enumerate(zip(places, known.tolist(), scores.tolist(), strict=True)):
        side = "above" if score > 0.0 else "below"
        if abs(score) > far and quantity.side in ("both", side):
            usual = float(np.median(np.delete(known, k)))
            measure = f" ({abs(score):.0f} robust deviations)" if np.isfinite(score) else ""
            beside = f"far {side} the others' median {written(usual, value)}{measure}"
            yield place, Flag(quantity.column, f"{quantity.words} is {written(value, usual)}, {beside}", abs(score))


def deviations(values: np.ndarray, is_log: bool, least: float) -> np.ndarray:
    """How far numbers are from their median, in robust standard deviations.

    Parameters
    ----------
    values : (K,) float
        At least one.
    is_log : bool
        Of their logarithms; a number that has none is at -inf.
    least : float
        What a deviation counts at least, above 0: where most of the numbers are the same, the MAD is 0.

    Returns
    -------
    (K,) float
        (x - median) / max(1.4826 MAD, least), with MAD the median of |x - median| (Rousseeuw and Croux, Alternatives to
        the Median Absolute Deviation, J. Am. Stat. Assoc. 88, 1993).

    Examples
    --------
    >>> deviations(np.array([1.0, 1.0, 1.0, 2.0]), False, 0.1).tolist()
    [0.0, 0.0, 0.0, 10.0]
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # most at -inf: nan, which is not far
        x = np.log(np.maximum(values, 0.0)) if is_log else values
        distance = x - np.median(x[np.isfinite(x)])
        return distance / max(MAD_OF_NORMAL * float(np.median(np.abs(distance))), least)


def limit(n: int) -> float:
    """From how many robust deviations on one of n numbers is far.

    Examples
    --------
    >>> limit(8), limit(80)
    (10.0, 5.5)
    """
    return FAR_DEVIATIONS * (1.0 + FEW_SUBJECTS / n)


def units(unit: str, ndim: int) -> Callable[..., str]:
    """How a number of that unit is written: volumes in mm^n as ml or l, bytes as MB or GB, seconds as min or h.

    What is returned takes the number, and as a second one, if there is one, what it stands beside: of two numbers of
    which neither is `SHORT_RATIO` times the other both are written in the larger one's unit.

    Examples
    --------
    >>> units("mm", 3)(1.43e6), units("bytes", 3)(2.5e9), units("s", 3)(90.0), units("", 3)(0.123456)
    ('1.43 l', '2.5 GB', '1.5 min', '0.123')
    >>> units("mm", 3)(4e5, 1.43e6), units("mm", 3)(1.43e6, 4e5), units("mm", 3)(3e3, 1.43e6)
    ('0.4 l', '1.43 l', '3 ml')
    """
    steps = {
        "mm": [(1e6, "l"), (1e3, "ml"), (1.0, "mm^3")] if ndim == 3 else [(1e2, "cm^2"), (1.0, "mm^2")],
        "bytes": [(1e9, "GB"), (1e6, "MB"), (1.0, "bytes")],
        "s": [(3600.0, "h"), (60.0, "min"), (1.0, "s")],
    }.get(unit, [(1.0, unit)])

    def written(value: float, beside: float = 0.0) -> str:
        size = max(abs(value), abs(beside) if abs(beside) < SHORT_RATIO * abs(value) else 0.0)
        factor, word = next((step for step in steps if size >= step[0]), steps[-1])
        number = value / factor
        return f"{number:.3g} {word}".strip() if abs(number) < 1e3 else f"{number:,.0f} {word}".strip()

    return written
