"""Label tables with names and colours, and the labels that a name refers to."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.labels import BACKGROUND_LABEL, colours_by_number, hex_colour
from tetopt.errors import InputError, prefix_errors
from tetopt.model.sets import Names, label_set_names
from tetopt.system.arrays import Ints

# key in a mesh's file and in a model's `about` for the result of `table_words`
LABEL_FIELD = "label"  # cell data in files: the label of each cell
TABLE_TEXT = "label_table"

LABEL_DIGITS = 18  # of a number that fits into 64 bits; a longer one counts as a name


class LabelTable(NamedTuple):
    """Names and colours of labels; a label may lack either or both.

    Parameters
    ----------
    names : dict of int to str
        Any one-line text; two labels may have the same name.
    colours : dict of int to (float, float, float)
        Red, green and blue, 0 to 1.

    Examples
    --------
    >>> tetopt.LabelTable({1: "liver", 2: "spleen"}, {1: (0.7, 0.1, 0.1)}).names[1]
    'liver'
    """

    names: dict[int, str]
    colours: dict[int, tuple[float, float, float]]


NO_TABLE = LabelTable({}, {})  # for labels that only have numbers


def count_of_labels(labels: Collection[int], noun: str = "") -> str:
    """Count labels, and name label 0 beside them, which is no tissue.

    Examples
    --------
    >>> count_of_labels([0, 3, 7], " labels")
    '2 labels and label 0'
    """
    return f"{len(labels) - (BACKGROUND_LABEL in labels)}{noun}" + " and label 0" * (
        BACKGROUND_LABEL in labels
    )


def label_words(label: int, names: Names) -> str:
    """Format a label: "5 (liver)", or "5" if it has no name."""
    return f"{label} ({names[label]})" if label in names else f"{label}"


def labels_named(text: str, names: Names) -> list[int]:
    """Return the labels, ascending, that a text refers to: those with this name, or the one whose
    set has this name.

    Case is ignored if no label has exactly this name. A whole number refers to the label with this
    number.

    Raises
    ------
    InputError
        No label has such a name; the message lists similar ones.

    Examples
    --------
    >>> labels_named("liver", {5: "liver", 6: "stomach"}), labels_named("6", {})
    ([5], [6])
    >>> labels_named("left_lung", {10: "Left lung"})
    [10]
    """
    text = text.strip()
    if text.isdecimal() and len(text) <= LABEL_DIGITS:
        return [int(text)]
    of_sets = label_set_names(names, names)
    for known in (names, of_sets):
        for same in (str, str.lower):
            if labels := sorted(
                label for label, name in known.items() if same(name.strip()) == same(text)
            ):
                return labels
    if not names:
        raise InputError(
            f'label "{text}": labels have no names; give a table of names (`label_names`)'
        )
    lower = {name.lower(): name for name in (*of_sets.values(), *names.values())}
    near = [lower[each] for each in difflib.get_close_matches(text.lower(), lower, 3)]
    first = ", ".join(list(names.values())[:8]) + (", ..." if len(names) > 8 else "")
    hint = f"did you mean {' or '.join(near)}?" if near else f"known names are {first}"
    raise InputError(f'label "{text}": no label has this name; {hint}')


def kept_labels(
    keep: str | None, drop: str | None, present: Sequence[int], names: Names
) -> list[int]:
    """Return the labels, of those present, that stay: those of a text "2,liver", and none of a
    second one.

    Raises
    ------
    InputError
        Not exactly one text; a label that is not present, or has no such name; none or all labels
        would stay.
    """
    option, text = ("keep_labels", keep) if keep is not None else ("drop_labels", drop)
    if text is None or (keep is not None and drop is not None):
        raise InputError("`keep_labels` and `drop_labels`: give only one of them")
    chosen: set[int] = set()
    for word in text.split(","):
        with prefix_errors(f"`{option}`"):
            labels = labels_named(word, names)
        if not chosen.union(labels) & set(present).intersection(labels):
            listed = ", ".join(label_words(label, names) for label in present[:8]) + ", ..." * (
                len(present) > 8
            )
            raise InputError(f'`{option}`: there is no label "{word.strip()}"; there are {listed}')
        chosen |= set(labels)
    kept = [label for label in present if (label in chosen) == (keep is not None)]
    if not kept:
        raise InputError(
            f"`{option}`: no label would be left of {', '.join(map(str, present[:8]))}"
        )
    return kept


def labels_of(cell_data: Mapping[str, NDArray], n_cells: int) -> Ints | None:
    """Return the field "label", (M,) int64, if it exists and holds whole numbers from 0; other
    programs' may not.
    """
    labels = cell_data.get(LABEL_FIELD)
    if labels is None or labels.shape != (n_cells,) or not np.isfinite(labels).all():
        return None
    whole = labels.astype(np.int64)
    return whole if (whole == labels).all() and whole.min() >= 0 else None


def table_words(table: LabelTable) -> dict[str, dict[str, str]]:
    """Convert a table to JSON's types: by label, its "name" and "colour" ("#rrggbb") if it has
    them.
    """
    words: dict[str, dict[str, str]] = {
        str(label): {} for label in sorted({*table.names, *table.colours})
    }
    for label, name in table.names.items():
        words[str(label)]["name"] = name
    for label, colour in table.colours.items():
        words[str(label)]["colour"] = "#" + "".join(f"{round(255.0 * part):02x}" for part in colour)
    return words


def table_of_words(words: Any) -> LabelTable:
    """Convert the result of `table_words` back to a table, with colours to 1/255; invalid
    entries are ignored.
    """
    names = {}
    colours = {}
    for label, entry in words.items() if isinstance(words, dict) else ():
        if re.fullmatch(r"\d{1,10}", str(label)) is None or not isinstance(entry, dict):
            continue
        if isinstance(name := entry.get("name"), str) and name.strip():
            names[int(label)] = " ".join(name.split())
        if (colour := hex_colour(entry.get("colour"))) is not None:
            colours[int(label)] = colour
    return LabelTable(names, colours)


def colour_labels(table: LabelTable, labels: Ints) -> LabelTable:
    """Add the colours that labels have in pictures to the table; 0, the background, is light
    grey.
    """
    those = np.unique(labels)
    by_number = dict(
        zip(those.tolist(), map(tuple, colours_by_number(those).tolist()), strict=True)
    )
    return LabelTable(
        table.names, by_number | {label: own for label, own in table.colours.items() if label != 0}
    )


def table_of_labels(table: LabelTable, labels: Iterable[int]) -> LabelTable:
    """Return a table with only the entries of these labels."""
    few = set(labels)
    return LabelTable(
        {label: name for label, name in table.names.items() if label in few},
        {label: colour for label, colour in table.colours.items() if label in few},
    )
