"""Overview page of a cohort: failures, distributions, and a table of all subjects with pictures."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tetopt.cohort.flags import (
    QUANTITIES,
    Flag,
    Quantity,
    comparisons_left_out,
    flags_of,
    label_quantities,
    units,
)
from tetopt.cohort.layout import PAGE_NAME, TABLE_NAME
from tetopt.cohort.numbers import NOTE_BEGINNING, Row, Value, description, present, save_table
from tetopt.io.text import count_text
from tetopt.report.page import data_html, package_text, render_page, script_html, write_page

PAGE_PICTURES = 600  # thumbnails of about 8 kB, 6 MB in base64
LISTED_FAILURES = 100  # reasons, and subjects per reason, above the full table
LISTED_FLAGS = 6  # per subject; the TSV table has all
SHOWN_DIGITS = 4  # of numbers in the page
LISTED_VALUES = 6  # of an option that differs; with more, only their number is shown
PICTURE_WORDS = (
    "axial, with the patient's left on the left, and sagittal, with the back on the left"
)
COLOUR_WORDS = "Orange is the mesh, blue the outline of the mask, other colours are labels."
# Columns of the page in addition to `QUANTITIES`, with their titles.
PAGE_COLUMNS = {
    "grid.orientation": "orientation",
    "grid.spacing_mm": "voxels, mm",
    "grid.shape": "voxels",
    "size.n_nodes_in_all": "nodes",
    "quality.max_dihedral": "largest angle",
    "quality.n_under_10_degrees": "cells with angles below 10 degrees",
    "cells_without_voxel": "cells without a voxel centre",
    "energies.E": "E",
    "iterations_done": "iterations",
    "ended": "ended",
    "mask.distance_p95_mm": "distance to the mask, mm, 95 %",
    "mask.components": "components of the mask",
    "mask.mesh_components": "components of the mesh",
    "memory.predicted_bytes": "predicted memory",
    "image": "image",
    "versions.tetopt": "version",
}
# Columns shown initially; those of the other quantities and of labels can be selected.
FIRST_COLUMNS = (
    "grid.orientation",
    "energies.E_D_fraction_of_variance",
    "quality.mean_rho",
    "quality.min_dihedral",
    "mask.volume",
    "seconds.all",
    "memory.peak_bytes",
)
OPTION_BEGINNINGS = ("options.", "request.options.")  # of the columns of a run's options
# tell the script which files exist
FILE_LETTERS = {"numbers": "n", "log": "l", "figures": "f", "thumbnail": "t"}
STATUS_WORDS: dict[str, str] = {
    "done": "done",
    "violated": "with a violated requirement",
    "failed": "failed",
    "missing": "not run",
}


def save_cohort_files(out: Path, rows: Sequence[Row]) -> None:
    """Write `cohort.tsv`, `cohort.json` with descriptions of its columns, and `cohort.html` to a
    cohort's folder.

    Each is written whole or not at all, replacing an existing file. The page contains everything
    except linked files, and forbids all network access. Its numbers are rounded to four digits.
    """
    flags = flags_of(rows)
    save_table(out / TABLE_NAME, rows, [[flag.words for flag in each] for each in flags])
    pictures = _pictures(out, rows, flags)
    is_solid = any(row.numbers.get("quality.ndim") == 3 for row in rows)
    note = f"Pictures are {PICTURE_WORDS}, with the mesh over the image. " if is_solid else ""
    note += COLOUR_WORDS if pictures else ""
    if len(pictures) < sum("thumbnail" in row.files for row in rows):
        note += (
            f" The page has {len(pictures)} of them, flagged subjects first; the rest are linked."
        )
    reasons = _failures(rows)
    content = render_page(
        "cohort/cohort.html",
        summary=_summary(rows, flags),
        reasons=reasons,
        most=LISTED_FAILURES,
        quote=quote,
        n_failed=sum(len(failed) for _, failed in reasons),
        note=note,
        data=data_html("data", _data(rows, flags, pictures, _columns(rows))),
        script=script_html("cohort"),
    )
    write_page(
        out / PAGE_NAME, f"Cohort {out.resolve().name}", content, package_text("cohort/cohort.css")
    )


def _summary(rows: Sequence[Row], flags: Sequence[Sequence[Flag]]) -> list[str]:
    """Summarise the subjects' statuses, their time, and their common options."""
    counts = Counter[str](row.status for row in rows)
    words = [
        f"{counts[status]} {words}" for status, words in STATUS_WORDS.items() if counts[status]
    ]
    text = f"{count_text(len(rows), 'subject')}: {', '.join(words) or 'none'}."
    if n_odd := sum(bool(each) for each in flags):
        text += f" {n_odd} {'is' if n_odd == 1 else 'are'} flagged, see below."
    if seconds := present(row.numbers.get("seconds.all") for row in rows):
        text += (
            f" Meshing took {units('s', 3)(sum(seconds))} of computing time, excluding "
            "start-up and pictures."
        )
    if peaks := present(row.numbers.get("memory.peak_bytes") for row in rows):
        text += f" The largest run used {units('bytes', 3)(max(peaks))} of memory."
    options = _options(rows)
    common = [
        f"{_option(name)} {_round_value(next(iter(each)))}"
        for name, each in options.items()
        if len(each) == 1
    ]
    different = [
        f"{_option(name)}: {_count_values(each)}" for name, each in options.items() if len(each) > 1
    ]
    lines = [text, *comparisons_left_out(rows)]
    if common:
        lines.append(f"Common to all meshes: {', '.join(common)}.")
    if different:
        lines.append(f"Differences, with numbers of subjects: {'; '.join(different)}.")
    return lines


def _option(name: str) -> str:
    """Return an option's name on the command line, or the program of a version."""
    return name.rpartition(".")[2]


def _count_values(counts: Counter[Value]) -> str:
    """Format values with their numbers of subjects, the most frequent first."""
    if len(counts) > LISTED_VALUES:
        return f"{len(counts)} values"
    return ", ".join(
        f"{'none' if value is None else _round_value(value)} ({n})"
        for value, n in counts.most_common()
    )


def _options(rows: Sequence[Row]) -> dict[str, Counter[Value]]:
    """Count the values of version and options over the meshes; None if not stated."""
    meshes = [row.numbers for row in rows if row.status in ("done", "violated")]
    stated = dict.fromkeys(
        name for numbers in meshes for name in numbers if name.startswith(OPTION_BEGINNINGS)
    )
    counts = {
        name: Counter(numbers.get(name) for numbers in meshes)
        for name in ("versions.tetopt", *stated)
    }
    return {name: each for name, each in counts.items() if set(each) != {None}}


def _failures(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """Group the failed subjects by reason, the most frequent first."""
    reasons: dict[str, list[Row]] = {}
    for row in rows:
        if row.status == "failed":
            reasons.setdefault(row.reason, []).append(row)
    return sorted(reasons.items(), key=lambda each: -len(each[1]))


def _pictures(out: Path, rows: Sequence[Row], flags: Sequence[Sequence[Flag]]) -> dict[str, str]:
    """Return thumbnails in base64 of `PAGE_PICTURES` rows at most, by place, the flagged ones
    first.
    """
    places = [place for place, row in enumerate(rows) if "thumbnail" in row.files]
    places.sort(key=lambda place: -flags[place][0].score if flags[place] else 0.0)
    pictures = {}
    for place in places[:PAGE_PICTURES]:
        with suppress(OSError):  # the page does without it
            png = (out / rows[place].files["thumbnail"]).read_bytes()
            pictures[str(place)] = base64.b64encode(png).decode("ascii")
    return pictures


def _columns(rows: Sequence[Row]) -> dict[str, Quantity]:
    """Return the page's columns, by name."""
    known = {name for row in rows for name in row.numbers}
    quantities = {each.column: each for each in QUANTITIES}
    columns = {
        name: quantities.get(name)
        for name in dict.fromkeys((*FIRST_COLUMNS, *quantities, *PAGE_COLUMNS))
    }
    shown = {
        name: quantity
        or Quantity(
            name, PAGE_COLUMNS[name], "bytes" if name.endswith("_bytes") else "", "both", False, 0.0
        )
        for name, quantity in columns.items()
        if name in known
    }
    for name, each in sorted(_options(rows).items()):
        if name.startswith(OPTION_BEGINNINGS) and len(each) > 1:
            shown[name] = Quantity(name, _option(name), "", "both", False, 0.0)
    for name in sorted(known):
        if name.startswith(NOTE_BEGINNING):
            shown[name] = Quantity(name, _option(name), "", "both", False, 0.0)
    labels = sorted({number for row in rows for number in row.volumes if number > 0})
    names = {number: name for row in reversed(rows) for number, name in row.label_names.items()}
    return shown | {
        each.column: each for number in labels for each in label_quantities(number, names)
    }


def _data(
    rows: Sequence[Row],
    flags: Sequence[Sequence[Flag]],
    pictures: dict[str, str],
    columns: dict[str, Quantity],
) -> dict[str, Any]:
    """Return the script's data."""
    is_flat = any(row.numbers.get("quality.ndim") == 2 for row in rows)
    return {
        "columns": [
            {
                "name": name,
                "title": quantity.words,
                "unit": quantity.unit,
                "isLog": quantity.is_log,
                "isFirst": name in FIRST_COLUMNS,
                "about": description(name)["Description"],
                "isChart": name in {each.column for each in QUANTITIES}
                or name == "grid.orientation"
                or name.endswith(".volume"),
            }
            for name, quantity in columns.items()
        ],
        "volume": "mm^2" if is_flat else "mm^3",
        "rows": [_row_data(row, own, columns) for row, own in zip(rows, flags, strict=True)],
        "pictures": pictures,
    }


def _row_data(row: Row, flags: Sequence[Flag], columns: Iterable[str]) -> list[Any]:
    """Return a row for the script."""
    letters = "".join(letter for name, letter in FILE_LETTERS.items() if name in row.files)
    own = [[flag.words, flag.column] for flag in flags[:LISTED_FLAGS]]
    fixed = [row.key, row.status, row.reason, own, len(flags), row.files.get("mesh", ""), letters]
    return [*fixed, *(_round_value(row.numbers.get(name)) for name in columns)]


def _round_value(value: Value) -> Value:
    """Round a float for the page."""
    return float(f"{value:.{SHOWN_DIGITS}g}") if isinstance(value, float) else value
