"""Segmentations of 3D Slicer (.seg.nrrd): named segments in one or more layers of an NRRD file.

A segment is the voxels of its layer with its label value. Within a layer segments do not overlap;
those of different layers may, and may have the same value. Numbering and names depend on the header
alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.labels import LARGEST_LABEL
from tetopt.errors import InputError
from tetopt.io.text import list_names, plain
from tetopt.io.volumes import note
from tetopt.model.label_names import LabelTable

SEGMENT_FIELD = re.compile(r"Segment(\d{1,6})_(\w+)")


class Segment(NamedTuple):
    """A segment in the file, and its number in the label image."""

    name: str
    layer: int
    value: int
    label: int
    colour: tuple[float, float, float] | None


def segments_of(texts: Mapping[str, str]) -> list[Segment]:
    """Return the segments that an NRRD header's key:=value pairs describe; empty for other files.

    Labels are the file's own values, or if segments share values, the order of the segments from 1.

    Raises
    ------
    InputError
        Without a leading path: a segment's layer or value is not a whole number.
    """
    tables: dict[int, dict[str, str]] = {}
    for key, value in texts.items():
        if match := SEGMENT_FIELD.fullmatch(key):
            tables.setdefault(int(match[1]), {})[match[2]] = value.strip()
    # Files of Slicer before 4.11 have neither: each segment is a layer of ones.
    is_old = not any("Layer" in each or "LabelValue" in each for each in tables.values())
    described = []
    for order, (number, table) in enumerate(sorted(tables.items())):
        name = plain(
            " ".join((table.get("Name") or table.get("ID") or f"segment {number}").split())
        )
        layer = _whole(name, "Layer", table.get("Layer", str(order) if is_old else "0"), 0)
        label = _whole(name, "LabelValue", table.get("LabelValue", "1"), 1)
        described.append(Segment(name, layer, label, label, _colour(table.get("Color", ""))))
    values = [segment.value for segment in described]
    is_shared = len(set(values)) < len(values) and len({segment.layer for segment in described}) > 1
    return (
        [each._replace(label=order) for order, each in enumerate(described, 1)]
        if is_shared
        else described
    )


def segments_table(segments: list[Segment]) -> LabelTable:
    """Return the names and colours of segments by label; a label of several segments has all
    their names.
    """
    names: dict[int, str] = {}
    for each in segments:
        names[each.label] = (
            f"{names[each.label]} / {each.name}" if each.label in names else each.name
        )
    return LabelTable(
        names, {each.label: each.colour for each in segments if each.colour is not None}
    )


def labels_of_layers(layers: NDArray, segments: list[Segment]) -> NDArray:
    """Return the label of each voxel, from its values in the layers, which are on the last axis.

    Where segments overlap, the later layer wins; overlaps, shared values and values of no segment
    are noted.

    Raises
    ------
    InputError
        Without a leading path: a segment's layer does not exist.
    """
    n_layers = layers.shape[-1]
    for each in segments:
        if each.layer >= n_layers:
            raise InputError(
                f'segment "{each.name}" is in layer {each.layer}, but the file has {n_layers}; '
                "export it again"
            )
    names = segments_table(segments).names
    if len(names) < len(segments):
        doubled = ", ".join(f'"{name}"' for name in names.values() if " / " in name)
        note(f"segments of one layer share a label value and cannot be told apart: {doubled}")
    if [each.label for each in segments] != [each.value for each in segments]:
        note(
            "its segments share label values; they are numbered in order: "
            f"{list_names([f'{label} {name}' for label, name in names.items()])}"
        )
    labels = np.zeros(layers.shape[:-1], np.int32)
    is_free = (layers != 0).any(axis=-1)
    for each in sorted(segments, key=lambda each: each.layer):
        is_here = layers[..., each.layer] == each.value
        covered = np.column_stack(np.unique(labels[is_here], return_counts=True)).tolist()
        below = [
            f'{count} of the {np.count_nonzero(labels == label)} voxels of "{names[label]}"'
            for label, count in covered
            if label not in (0, each.label)
        ]
        if below:
            note(f'segment "{each.name}" covers {", ".join(below)}; later layers win')
        labels[is_here] = each.label
        is_free &= ~is_here
    if is_free.any():
        described = np.unique(layers[is_free]).tolist()
        note(f"{is_free.sum()} voxels have values of no segment ({described[:8]}) and get label 0")
    return labels


def _whole(name: str, field: str, text: str, least: int) -> int:
    if re.fullmatch(r"\d{1,10}", text) is None or not least <= int(text) <= LARGEST_LABEL:
        raise InputError(
            f'segment "{name}": expected a whole number from {least} as its {field}, got '
            f'"{plain(text[:40])}"'
        )
    return int(text)


def _colour(text: str) -> tuple[float, float, float] | None:
    """Parse three numbers from 0 to 1; None for anything else, as colours do not matter."""
    words = text.split()
    if len(words) != 3 or not all(
        re.fullmatch(r"[01]?\.?\d*(e-\d+)?", word) and word[0] != "e" for word in words
    ):
        return None
    red, green, blue = (min(float(word), 1.0) for word in words)
    return red, green, blue
