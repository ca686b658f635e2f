"""Every number of every subject, read from the outputs of their runs, and as one table for other
programs.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from sys import intern
from typing import Any, NamedTuple

import numpy as np

from tetopt.cohort.layout import (
    KEY_PATTERN,
    LOGS_NAME,
    failure_path,
    log_path,
    notes_path,
    numbers_path,
    table_in,
    thumbnail_path,
)
from tetopt.cohort.subject_states import Status, mesh_of, state_of
from tetopt.geometry.box import world_axes
from tetopt.io.text import plain
from tetopt.system.files import save_json, written_whole
from tetopt.system.incoming import toml_of

Value = float | int | str | bool | None
# Parts of run.json that are not in the table: rows by iteration; sizes of sets, as `labels` has
# those of labels; pairs of labels, as there are sums; names and loads as texts; values with columns
# of other names; the sentences in `reason`.
UNLISTED_NUMBERS = (
    "history",
    "sets",
    "label_names",
    "loads",
    "box",
    "image_properties.affine",
    "inputs.sha256",
    "violated",
    "interfaces",
    "labels",
    "contacts",
    "thickness",
    "request",
)
# numbers of a list with a column each, as spacings and sides; longer lists are hundreds of moduli
SHORT_LIST = 4
OF_LABEL = re.compile(r"(labels|interfaces)\.(\d+)\..*")  # columns of a label
NOT_AVAILABLE = "n/a"  # BIDS' text for a missing value
# First letters of texts that spreadsheets read as formulas (OWASP, "CSV Injection"), in all widths.
FORMULA_LETTERS = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")
OBLIQUE_DIGITS = 1  # of degrees: the precision of an affine's float32 numbers
NUMBER = re.compile(r"-?(0|[1-9][0-9]{0,15})(\.[0-9]+)?")
NOTE_BEGINNING = "table."  # of columns that the table of subjects has beside options
COLUMN_GROUPS = {
    "table": "Of the table of subjects: ",
    "options": "Option ",
    "request": "Option ",
    "versions": "Version of ",
    "machine": "Of the machine: ",
}


class Row(NamedTuple):
    """One subject, from the outputs of its run."""

    key: str  # "sub-01_ses-a"
    status: Status  # never "changed"
    reason: str  # failure or violated requirements, on one line; "" for a subject that is done
    violated: tuple[str, ...]  # the names of these requirements
    # "mesh", "numbers", "log", "thumbnail", "figures": existing paths, relative to OUT
    files: dict[str, str]
    numbers: dict[str, Value]  # by column
    label_names: dict[int, str]  # of its labels with a name
    volumes: dict[int, float]  # of its labels' voxels, mm^n
    n_lost: dict[int, int]  # voxels of its labels without a cell


def collect(out: Path, expected: Sequence[str] = ()) -> list[Row]:
    """Collect the rows of all subjects in a cohort's folder, and of expected ones, in the order of
    their names.

    Parameters
    ----------
    out : Path
        A cohort's folder: `sub-X[/ses-Y]/sub-X[_ses-Y]_desc-tetopt_mesh.json`, `logs/`.
    expected : sequence of str
        Keys, as "sub-01_ses-a".

    Returns
    -------
    list of Row
        A subject with unreadable files counts as failed. If a run failed, the numbers of an older
        mesh are left out.
    """
    keys = set(expected)
    for path_of, folder in (
        (numbers_path, "sub-*"),
        (numbers_path, "sub-*/ses-*"),
        (failure_path, LOGS_NAME),
    ):
        ending = path_of(out, "").name
        for path in out.glob(f"{folder}/sub-*{ending}"):
            key = path.name.removesuffix(ending)
            if KEY_PATTERN.fullmatch(key) and path == path_of(out, key):
                keys.add(key)
    return [row_of(out, key) for key in sorted(keys, key=natural_order)]


def natural_order(text: str) -> list[tuple[int, str]]:
    """Return a sort key of names, so that "sub-2" comes before "sub-10"."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", text)
    ]


def row_of(out: Path, key: str) -> Row:
    """Return the row of one subject, by its key; see `collect`."""
    status, reason = state_of(out, key)
    places = {"log": log_path(out, key)}
    row = Row(key, status, reason, (), {}, {}, {}, {}, {})
    notes = {
        f"{NOTE_BEGINNING}{plain(name)}": _number_or_text(text)
        for name, text in (table_in(notes_path(out, key)) or {}).items()
    }
    if status in ("done", "violated"):
        numbers = numbers_path(out, key)
        places |= {
            "mesh": mesh_of(out, key) or numbers,
            "numbers": numbers,
            "thumbnail": thumbnail_path(out, key),
        }
        places["figures"] = places["thumbnail"].parent
        row = with_numbers(row, table_in(numbers) or {})
    files = {
        name: path.relative_to(out).as_posix() for name, path in places.items() if path.exists()
    }
    return row._replace(files=files, numbers=notes | row.numbers)


def _number_or_text(text: str) -> Value:
    """Return a decimal number as such; others, as codes with leading zeros, as text."""
    if NUMBER.fullmatch(text) is None:
        return plain(text)
    return float(text) if "." in text else int(text)


def with_numbers(row: Row, run: dict[str, Any]) -> Row:
    """Return the row with the numbers of run.json."""
    labels, names = run.get("labels") or [], run.get("label_names") or {}
    return row._replace(
        violated=tuple(map(plain, run.get("violated") or {})),
        numbers=flatten_run(run),
        label_names={int(number): plain(name) for number, name in names.items()},
        volumes={each["label"]: each["volume"] for each in labels},
        n_lost={each["label"]: each["voxels"] for each in labels if each["is_lost"]},
    )


def flatten_run(run: dict[str, Any]) -> dict[str, Value]:
    """Return the numbers and texts of run.json by column, in its order.

    Names of nested objects are joined by dots. Labels have a column per number, `labels.17.dice`
    and `interfaces.17.area`; contrasts have `contrasts.1.weight` and so on; short lists of numbers
    have one column each (`spacing_mm.1`), and lists of texts are joined. Given options that are not
    among `options` are in `request.options`. Orientation and sides of the image come from its
    affine. Lost components are counted. `UNLISTED_NUMBERS` and lists of more than four numbers are
    left out.
    """
    columns = _grid(run["box"]) if run.get("box") else {}
    for name, value in run.items():
        _put(columns, plain(name), value)
    request = run.get("request") or {}
    columns["request.sha256"] = request.get("sha256")
    known = {name.lower() for name in columns}  # "k-d" on the command line is k_D
    for name, value in request.get("options", {}).items():
        if f"options.{name.replace('-', '_')}".lower() not in known:
            _put(columns, f"request.options.{name}", value)
    for name in ("labels", "interfaces"):
        for each in run.get(name) or ():
            _put(
                columns,
                f"{name}.{each['label']}",
                {key: value for key, value in each.items() if key != "label"},
            )
    return columns


def _put(columns: dict[str, Value], name: str, value: Any) -> None:
    """Add a value, or its nested values."""
    if name in UNLISTED_NUMBERS:
        return
    if isinstance(value, dict):
        for key, item in value.items():
            _put(columns, f"{name}.{plain(key)}", item)
    elif name.endswith(".lost_components"):
        columns[intern(name)] = len(value)
    elif isinstance(value, list):
        if all(isinstance(item, str) for item in value):
            columns[intern(name)] = "; ".join(map(plain, value))
        elif len(value) <= SHORT_LIST or isinstance(value[0], dict):
            for number, item in enumerate(value, start=1):
                _put(columns, f"{name}.{number}", item)
    else:
        columns[intern(name)] = plain(value) if isinstance(value, str) else value


def _grid(box: dict[str, Any]) -> dict[str, Value]:
    """Return the image's orientation, obliquity, spacing and shape."""
    affine, shape = np.array(box["affine"]), box["shape"]
    steps = np.linalg.norm(affine[:-1, :-1], axis=0)
    return {
        "grid.orientation": orientation_code(affine),
        "grid.oblique_degrees": oblique_degrees(affine),
        "grid.spacing_mm": " x ".join(f"{step:.4g}" for step in steps),
        "grid.volume_mm": abs(float(np.linalg.det(affine[:-1, :-1]))) * float(np.prod(shape)),
        "grid.shape": " x ".join(map(str, shape)),
    }


def orientation_code(affine: np.ndarray) -> str:
    """Return the closest world direction of each index axis, as "RAS" or "LPS"; in 2-D as "+x+y".

    Examples
    --------
    >>> orientation_code(np.diag([-1.0, -1.0, 2.0, 1.0])), orientation_code(np.eye(3))
    ('LPS', '+x+y')
    """
    letters = (
        (("L", "R"), ("P", "A"), ("I", "S")) if len(affine) == 4 else (("-x", "+x"), ("-y", "+y"))
    )
    return "".join(
        letters[world][int(affine[world, a] > 0.0)] for a, world in enumerate(world_axes(affine))
    )


def oblique_degrees(affine: np.ndarray) -> float:
    """Return the largest angle between an index axis and its world axis, degrees, to a tenth.

    Examples
    --------
    >>> oblique_degrees(np.array([[0.0, 2.0, 0.0], [-1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]))
    45.0
    """
    columns = affine[:-1, :-1] / np.linalg.norm(affine[:-1, :-1], axis=0)
    cosines = [abs(columns[world, a]) for a, world in enumerate(world_axes(affine))]
    return round(float(np.degrees(np.arccos(np.clip(min(cosines), 0.0, 1.0)))), OBLIQUE_DIGITS)


def column_names(rows: Sequence[Row]) -> list[str]:
    """Return the columns of all rows, in the order of run.json, with those of labels last and by
    number.
    """
    names = dict.fromkeys(name for row in rows for name in row.numbers)
    matches = {name: match for name in names if (match := OF_LABEL.fullmatch(name)) is not None}
    of_labels = sorted(
        matches, key=lambda name: (matches[name][1] == "interfaces", int(matches[name][2]))
    )
    return [*(name for name in names if name not in matches), *of_labels]


def save_table(path: Path, rows: Sequence[Row], flags: Sequence[Sequence[str]]) -> None:
    """Write every number of every subject as tab-separated text, whole or not at all, and a
    description.

    Parameters
    ----------
    path : Path
        Path of the table, `.tsv`; as in BIDS, a `.json` file of the same name describes its
        columns.
    rows : sequence of Row
    flags : sequence of sequence of str
        Flags of each row.
    """
    names = column_names(rows)
    heads = ["participant_id", "session_id", "status", "reason", "flags"]
    with (
        written_whole(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as stream,
    ):
        stream.write("\t".join(map(field_text, [*heads, *names])) + "\n")
        for row, reasons in zip(rows, flags, strict=True):
            subject, _, session = row.key.partition("_")
            fixed = [subject, session, row.status, row.reason, "; ".join(reasons)]
            stream.write(
                "\t".join(map(field_text, chain(fixed, map(row.numbers.get, names)))) + "\n"
            )
    labels = {number: name for row in reversed(rows) for number, name in row.label_names.items()}
    dimensions = {row.numbers.get("quality.ndim") for row in rows} - {None}
    ndim = dimensions.pop() if len(dimensions) == 1 else "n"
    about = {name: description(name, labels) for name in (*heads, *names)}
    for words in about.values():
        if words.get("Units") == "mm^n":
            words["Units"] = f"mm^{ndim}"
    save_json(path.with_suffix(".json"), about)


def field_text(value: Value) -> str:
    r"""Format a value as a field of a table that pandas, R and spreadsheets read equally.

    Texts are on one line and without tabs (`tetopt.io.text.plain`); texts with quotes are quoted,
    as in CSV; texts that a spreadsheet would read as a formula begin with an apostrophe.

    Examples
    --------
    >>> [field_text(each) for each in (None, 0.1, 3, True, "", "=1+1", 'a "b" c')]
    ['n/a', '0.1', '3', 'true', 'n/a', "'=1+1", '"a ""b"" c"']
    """
    if value is None or value == "":
        return NOT_AVAILABLE
    if isinstance(value, bool):
        return json.dumps(value)
    if not isinstance(value, str):
        return repr(value)
    text = plain(value)
    text = f"'{text}" if text.startswith(FORMULA_LETTERS) else text
    return '"' + text.replace('"', '""') + '"' if '"' in text else text


@cache
def _descriptions() -> dict[str, list[str]]:
    return dict(toml_of(Path(__file__).with_name("columns.toml"), "table of columns"))


def description(column: str, label_names: dict[int, str] | None = None) -> dict[str, str]:
    """Describe a column of the table and its unit, as in BIDS' sidecars: "Description", "Units".

    Descriptions of labels include their `label_names`. An unknown column is described by its name
    alone.
    """
    known, general = _descriptions(), re.sub(r"\.\d+(?=\.|$)", ".N", column)
    first, _, rest = general.partition(".")
    if first == "quality_initial" and f"quality.{rest}" in known:
        words, unit = known[f"quality.{rest}"]
        words = f"Initial mesh: {words}"
    else:
        beginning = COLUMN_GROUPS.get(first)
        words, unit = known.get(general) or [
            f"{column} of run.json" if beginning is None else beginning + rest,
            "",
        ]
    if (match := OF_LABEL.fullmatch(column)) is not None:
        name = (label_names or {}).get(int(match[2]), "")
        words = f"Label {match[2]}{f' ({name})' if name else ''}: {words}"
    return {"Description": words} | ({"Units": unit} if unit else {})


def present(values: Iterable[Value]) -> list[float]:
    """Return the numbers among some values."""
    return [
        float(each)
        for each in values
        if isinstance(each, int | float) and not isinstance(each, bool)
    ]
