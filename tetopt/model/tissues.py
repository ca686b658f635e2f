"""Merging of labels into tissues: by groups in text, in a file or of a known program, or by
shared names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tetopt.contents.labels import LARGEST_LABEL, check_labels
from tetopt.errors import InputError, prefix_errors
from tetopt.image import Image
from tetopt.model.label_names import labels_named
from tetopt.model.mappings import named_file
from tetopt.model.sets import Names
from tetopt.system.arrays import Ints, Json
from tetopt.system.incoming import rows_of, toml_of

REST = "*"  # all labels in no other group, except 0
UNGROUPED_LISTED = 20  # labels listed in a message
GROUP = re.compile(r"\s*(?:(\d{1,10})\s*:)?\s*([^=:;*]*[^=:;*\s])\s*=([^=;]*)")
RANGE = re.compile(r"(\d{1,10})(?:\s*-\s*(\d{1,10}))?")


class LabelGroup(NamedTuple):
    """Labels that are merged into one."""

    label: int
    name: str
    members: tuple[str, ...]  # numbers, ranges, names, `REST`


class Merged(NamedTuple):
    """Merged labels; returned by `merge_labels`.

    Parameters
    ----------
    labels : Image
        Image with the numbers of groups.
    names : dict of int to str
        Names of all groups, by number, including groups that the image does not have.
    numbers : dict of int to int
        The new number of each of the image's labels, by the old one.

    Examples
    --------
    >>> labels = tetopt.Image(np.array([[0.0, 2.0, 41.0, 4.0]]))
    >>> tetopt.merge_labels(labels, "aseg").numbers
    {0: 0, 2: 1, 4: 3, 41: 1}
    """

    labels: Image
    names: dict[int, str]
    numbers: dict[int, int]


def merge_labels(labels: Image, merge: str, names: Names | None = None) -> Merged:
    """Merge labels into tissues.

    Parameters
    ----------
    labels : Image
        Whole numbers from 0 to `tetopt.contents.labels.LARGEST_LABEL`.
    merge : str
        Groups as NAME=LABELS, separated by semicolons, which become labels 1, 2 and so on, or N for
        N:NAME=LABELS. LABELS are numbers, ranges (500-530) and names, separated by commas, or ``*``
        for all labels in no other group; 0 stays 0 unless a group has it. Alternatively the name of
        a preset: "aseg" (FreeSurfer), "synthseg", "simnibs"; or a file: .toml, with a line NAME =
        LABELS for each group, or .csv, with rows NAME,LABELS.
    names : dict of int to str, optional
        Names of the image's labels, for groups that list names.

    Returns
    -------
    Merged
        The labels with their new numbers, and the names of these.

    Raises
    ------
    InputError
        Labels are not such numbers; groups cannot be parsed; a label is in two groups, or in none.

    See Also
    --------
    content : Use the labels.

    Examples
    --------
    >>> labels = tetopt.Image(np.array([[0.0, 2.0, 41.0, 3.0, 507.0]]))
    >>> merged = tetopt.merge_labels(labels, "white=2,41; grey=3,42; 5:soft=*")
    >>> merged.labels.data.tolist(), merged.names
    ([[0.0, 1.0, 1.0, 2.0, 5.0]], {1: 'white', 2: 'grey', 5: 'soft'})
    """
    labels = check_labels("labels", labels)
    groups = groups_of(merge)
    present = np.unique(labels.data).astype(np.int64)
    owner, rest = _members(groups, names or {}, present)
    owner.setdefault(0, 0)
    lost = [label for label in present.tolist() if label not in owner]
    if lost and rest is None:
        listed = ", ".join(map(str, lost[:UNGROUPED_LISTED])) + (
            ", ..." if len(lost) > UNGROUPED_LISTED else ""
        )
        raise InputError(
            f"`merge`: expected each label of the image in a group, got no group for {listed}; add "
            f"them to a group, or give NAME={REST} for all others"
        )
    numbers = {label: owner.get(label, rest or 0) for label in present.tolist()}
    return Merged(
        renumber_labels(labels, numbers), {group.label: group.name for group in groups}, numbers
    )


def renumber_labels(labels: Image, numbers: Mapping[int, int]) -> Image:
    """Renumber labels; labels without a new number are unchanged."""
    present = np.unique(labels.data)
    new = np.array(
        [numbers.get(label, label) for label in present.astype(np.int64).tolist()], dtype=np.float64
    )
    return Image(new[np.searchsorted(present, labels.data)], labels.affine)


def numbers_by_name(names: Names) -> dict[int, int]:
    """Map each label to the smallest label of the same name, if that is another one."""
    first: dict[str, int] = {}
    for label in sorted(names):
        first.setdefault(names[label], label)
    return {label: first[name] for label, name in names.items() if first[name] != label}


def is_preset(merge: str) -> bool:
    """Return whether a text is the name of a preset of groups."""
    return merge.strip() in _presets()


def groups_of(merge: str) -> list[LabelGroup]:
    """Parse the groups for `merge_labels`.

    Raises
    ------
    InputError
        The text is invalid; a name or a number occurs twice; a file cannot be read.
    """
    if (file := named_file(merge)) is not None:
        with prefix_errors(file):
            return _of_rows(rows_of(file, "table of groups of labels", ("label", "labels")))
    if is_preset(merge):
        return _of_rows([(name, [labels]) for name, labels in _presets()[merge.strip()].items()])
    return _check_groups([_of_words(words) for words in merge.split(";") if words.strip()])


def _of_rows(rows: Sequence[tuple[str, Sequence[object]]]) -> list[LabelGroup]:
    """Return the groups in rows of a name and its labels; rows with the same name are merged."""
    groups: dict[str, list[object]] = {}
    for name, labels in rows:
        groups.setdefault(name, []).extend(labels)
    return _check_groups(
        [_of_words(f"{name}={','.join(map(str, labels))}") for name, labels in groups.items()]
    )


def _of_words(words: str) -> tuple[str | None, str, tuple[str, ...]]:
    """Parse the number, name and labels of NAME=LABELS."""
    match = GROUP.fullmatch(words)
    members = tuple(part.strip() for part in match[3].split(",")) if match else ()
    if match is None or not all(members):
        raise InputError(
            '`merge`: expected NAME=LABELS, separated by semicolons, such as "white=2,41; '
            'grey=3,42; soft=500-530", a '
            f'.toml or .csv file, or {", ".join(_presets())}, got "{words.strip()[:80]}"'
        )
    return match[1], " ".join(match[2].split()), members


def _check_groups(rows: list[tuple[str | None, str, tuple[str, ...]]]) -> list[LabelGroup]:
    """Return the groups with their numbers; numbers and names must be unique."""
    rows = rows or [_of_words("")]  # raises InputError
    groups = [
        LabelGroup(k if row[0] is None else int(row[0]), *row[1:]) for k, row in enumerate(rows, 1)
    ]
    for what in ("name", "label"):
        taken = [getattr(group, what) for group in groups]
        if twice := [each for each in taken if taken.count(each) > 1]:
            raise InputError(
                f"`merge`: expected a different {what} for each group, got {twice[0]} twice"
            )
    if max(group.label for group in groups) > LARGEST_LABEL:
        raise InputError(f"`merge`: expected group numbers up to {LARGEST_LABEL}")
    if sum(REST in group.members for group in groups) > 1:
        raise InputError(f"`merge`: expected {REST} in at most one group, got it in two")
    return groups


def _members(
    groups: list[LabelGroup], names: Names, present: Ints
) -> tuple[dict[int, int], int | None]:
    """Return the number of the group of each label, in ranges of those present, and that of all
    other labels.
    """
    owner: dict[int, int] = {}
    rest = None
    for group in groups:
        for word in group.members:
            if word == REST:
                rest = group.label
                continue
            for label in _labels_of(word, names, present):
                if owner.setdefault(label, group.label) != group.label:
                    other = next(each.name for each in groups if each.label == owner[label])
                    raise InputError(
                        f"`merge`: label {label} is in two groups, {other} and {group.name}; "
                        "list it once"
                    )
    return owner, rest


def _labels_of(word: str, names: Names, present: Ints) -> list[int]:
    """Return the labels that a number, a range or a name refers to."""
    if (match := RANGE.fullmatch(word)) is None:
        with prefix_errors("`merge`"):
            return labels_named(word, names)
    first = int(match[1])
    last = int(match[2] or match[1])
    if not first <= last <= LARGEST_LABEL:
        raise InputError(
            f"`merge`: expected labels or an increasing range up to {LARGEST_LABEL}, got {word}"
        )
    return [first] if first == last else present[(first <= present) & (present <= last)].tolist()


@cache
def _presets() -> dict[str, Json]:
    return toml_of(Path(__file__).with_name("tissues.toml"), "table of presets")
