"""Colours of labels, suited to the colour-blind and the same in every picture of a volume; greys
of intensities.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.patches import Patch
from numpy.typing import NDArray

from tetopt.contents.labels import colours_by_number
from tetopt.io.text import plain
from tetopt.system.arrays import Floats, Ints

UNCOVERED_COLOUR = "#cfe3f5"  # where a mesh leaves the image uncovered
LISTED_LABELS = 12  # labels in a legend: more could not be distinguished by colour alone


def label_colours(
    labels: Ints, own: Mapping[int, tuple[float, float, float]] | None = None
) -> Floats:
    """Return the colour of each label.

    A label has the same colour in all pictures: its `own`, e.g. from
    `tetopt.model.label_names.LabelTable.colours`, or that of its number
    (`tetopt.contents.labels.colours_by_number`). 0, the background, is always light grey, although
    label tables make it black.

    Parameters
    ----------
    labels : (K,) int64
        Numbers from 0.
    own : mapping of label to red, green and blue, 0 to 1, optional

    Returns
    -------
    (K, 3) float64
        Red, green and blue, 0 to 1.
    """
    colours = colours_by_number(labels)
    for row, label in enumerate(labels.tolist()):
        if label > 0 and own and label in own:
            colours[row] = own[label]
    return colours


def plain_text(text: str) -> str:
    """Escape a text so that matplotlib draws its letters, and no formula between dollar signs."""
    return plain(text).replace("$", r"\$")


def grey_limits(values: Sequence[NDArray], brightest: float = 99.5) -> tuple[float, float]:
    """Return the values drawn black and white, always distinct: the 0.5 and the `brightest`
    percentile of `values`.
    """
    low, high = np.percentile(np.concatenate([part.ravel() for part in values]), [0.5, brightest])
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


def legend_patches(
    labels: Ints,
    colours: Floats,
    shown: NDArray[np.integer],
    names: Mapping[int, str],
) -> list[Patch]:
    """Return a legend's entries: the `LISTED_LABELS` labels that cover most, ascending, and the
    number of others.

    Parameters
    ----------
    labels : (K,) int64
        Numbers, ascending.
    colours : (K, 3) float64
        The result of `label_colours`.
    shown : (K,) integer
        Visible amount of each label, in any unit; labels with 0 are not listed.
    names : mapping of label to text
        Names of labels.
    """
    by_size = np.argsort(-shown, kind="stable")[: np.count_nonzero(shown)]
    entries = [
        Patch(
            facecolor=colours[row],
            edgecolor="black",
            linewidth=0.5,
            label=plain_text(f"{labels[row]} {names.get(int(labels[row]), '')}".strip()),
        )
        for row in np.sort(by_size[:LISTED_LABELS]).tolist()
    ]
    if len(by_size) > LISTED_LABELS:
        entries.append(Patch(facecolor="none", label=f"and {len(by_size) - LISTED_LABELS} more"))
    return entries
