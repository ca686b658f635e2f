"""Tables of labels' names and colours: FreeSurfer, ITK-SNAP, 3D Slicer, BIDS, or any CSV; told apart by what they hold.

- FreeSurfer (FreeSurferColorLUT.txt) and 3D Slicer (.ctbl, .txt): label, name, red, green, blue, opacity, in 0 to 255.
- ITK-SNAP: label, red, green, blue, opacity (0 to 1), two switches, and the name in quotation marks.
- BIDS (`*_dseg.tsv`), 3D Slicer's .csv, and other tables with a first row of names, between tabs, commas or semicolons:
  columns for the label, the name, and, if there are any, the colour, as "#rrggbb" or as three numbers.

Lines that are empty, or begin with #, are comments. Opacities are left out.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tetopt.contents.labels import hex_colour
from tetopt.errors import InputError
from tetopt.model.labels import NO_TABLE, LabelTable
from tetopt.system.incoming import text_of

__all__ = ["NO_TABLE", "LabelTable", "load_label_table"]

SNAP_LINE = re.compile(r'\s*(\d{1,9})\s+(\d+)\s+(\d+)\s+(\d+)\s+([\d.eE+-]+)\s+([01])\s+([01])\s+"(.*)"\s*')
LUT_LINE = re.compile(r"\s*(\d{1,9})\s+(\S.*?)\s+(\d+)\s+(\d+)\s+(\d+)(?:\s+([\d.]+))?\s*")
# Columns of tables with a first row, in small letters without blanks; the first that there is is taken.
LABEL_COLUMNS = ("labelvalue", "index", "id", "value", "labelid", "label", "labels")
NAME_COLUMNS = ("name", "labelname", "structure", "structures", "region", "type_codemeaning", "label")
HEX_COLUMNS = ("color", "colour", "hex")
RGB_COLUMNS = (("r", "g", "b"), ("red", "green", "blue"), ("color_r", "color_g", "color_b"))
NO_NAMES = ("", "(none)", "n/a")  # what stands for none: 3D Slicer's, BIDS'


class LabelEntry(NamedTuple):
    """A label as a line of the file has it."""

    line: int  # from 1
    label: int
    name: str
    colour: tuple[float, float, float] | None


def load_label_table(path: str | Path) -> LabelTable:
    """Names and colours of labels from a file.

    FreeSurfer's and 3D Slicer's tables of colours, ITK-SNAP's descriptions, BIDS's `*_dseg.tsv` and any CSV with a
    first row of names are told apart by what they hold; `tetopt.io.label_tables` has the columns.

    Parameters
    ----------
    path : str or Path
        A text file.

    Returns
    -------
    LabelTable
        Names and colours by label.

    Raises
    ------
    InputError
        No such file, one that is not of these kinds, a line that is not like the others, or a label with two names or
        two colours.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("labels.csv").write_text("label,name,color\\n1,liver,#b02020\\n2,spleen,#802060\\n")
    >>> table = tetopt.load_label_table("labels.csv")
    >>> table.names
    {1: 'liver', 2: 'spleen'}
    """
    path = Path(path)
    text = text_of(path, "table of labels' names")
    lines = [(number, line.strip(" ")) for number, line in enumerate(text.split("\n"), 1)]
    lines = [(number, line) for number, line in lines if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path}: expected a label and its name on each line, found none")
    table = LabelTable({}, {})
    of_label: dict[int, LabelEntry] = {}
    for entry in _entries(path, lines):
        first = of_label.setdefault(entry.label, entry)
        if first._replace(line=entry.line) != entry:
            raise InputError(
                f'{path}, line {entry.line}: label {entry.label} is "{entry.name}", but on line {first.line} it is '
                f'"{first.name}"; give each label once'
            )
        if entry.name not in NO_NAMES:
            table.names[entry.label] = entry.name
        if entry.colour is not None:
            table.colours[entry.label] = entry.colour
    if not table.names:
        raise InputError(f"{path}: expected names of labels, found none")
    return table


def _entries(path: Path, lines: list[tuple[int, str]]) -> Iterator[LabelEntry]:
    """The labels of the lines, all of the kind that the first line is of."""
    first = lines[0][1]
    if SNAP_LINE.fullmatch(first):
        yield from _matched(
            path, lines, SNAP_LINE, 'label, red, green, blue, opacity, 1, 1, "name", as ITK-SNAP has it'
        )
    elif LUT_LINE.fullmatch(first):
        words = "label, name, red, green, blue, opacity, as FreeSurfer and 3D Slicer have it"
        yield from _matched(path, lines, LUT_LINE, words)
    else:
        yield from _of_columns(path, lines)


def _matched(path: Path, lines: list[tuple[int, str]], pattern: re.Pattern[str], form: str) -> Iterator[LabelEntry]:
    for number, line in lines:
        if (match := pattern.fullmatch(line)) is None:
            raise InputError(f'{path}, line {number}: expected {form}, got "{line}"')
        parts = match.groups()
        tones, name = (parts[1:4], parts[7]) if pattern is SNAP_LINE else (parts[2:5], parts[1].strip('"'))
        yield LabelEntry(number, int(parts[0]), _one_line(name), _colour(path, number, tones, 255.0))


def _of_columns(path: Path, lines: list[tuple[int, str]]) -> Iterator[LabelEntry]:
    """The labels of a table with a first row of names."""
    head = lines[0][1]
    separator = max("\t,;", key=head.count)
    rows = [_cells(path, number, line, separator) for number, line in lines]
    columns = {re.sub(r"\s", "", name).lower(): k for k, name in reversed(list(enumerate(rows[0])))}
    label = next((name for name in LABEL_COLUMNS if name in columns), None)
    name = next((each for each in NAME_COLUMNS if each in columns and each != label), None)
    if label is None or name is None:
        raise InputError(
            f"{path}, line {lines[0][0]}: expected a table of labels of FreeSurfer, ITK-SNAP or 3D Slicer, or a row of "
            f'names with "label" (or "index") and "name", got "{head[:60]}"'
        )
    tones = next((each for each in RGB_COLUMNS if all(part in columns for part in each)), ())
    texts = [row[columns[part]] for row in rows[1:] for part in tones if columns[part] < len(row)]
    whole = 1.0 if any("." in text for text in texts) else 255.0  # fractions are of 1
    code = next((each for each in HEX_COLUMNS if each in columns), None)
    for (number, line), row in zip(lines[1:], rows[1:], strict=True):
        cells = {each: row[k].strip() for each, k in columns.items() if k < len(row)}
        if label not in cells or name not in cells:
            raise InputError(
                f'{path}, line {number}: expected {len(rows[0])} columns, as in the first row, got "{line}"'
            )
        if re.fullmatch(r"\d{1,9}(\.0*)?", cells[label]) is None:
            raise InputError(
                f'{path}, line {number}: expected a label, a whole number from 0, got "{cells[label]}" under {label}'
            )
        colour = None
        if tones and any(cells.get(part, "") not in NO_NAMES for part in tones):
            colour = _colour(path, number, [cells.get(part, "") for part in tones], whole)
        elif code is not None and (text := cells.get(code, "")) not in NO_NAMES:
            colour = hex_colour(text)
            if colour is None:
                raise InputError(f'{path}, line {number}: expected a colour as #rrggbb, got "{text}"')
        yield LabelEntry(number, int(float(cells[label])), _one_line(cells[name]), colour)


def _cells(path: Path, number: int, line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator))
    except csv.Error as error:
        raise InputError(f"{path}, line {number}: cannot be read ({error})") from error


def _one_line(name: str) -> str:
    return " ".join(name.split())


def _colour(path: Path, line: int, texts: list[str] | tuple[str, ...], whole: float) -> tuple[float, float, float]:
    """A colour of three numbers from 0 to `whole`."""
    try:
        red, green, blue = (float(text) / whole for text in texts)
    except ValueError:
        red = green = blue = -1.0
    if not all(0.0 <= part <= 1.0 for part in (red, green, blue)):
        raise InputError(
            f"{path}, line {line}: expected red, green and blue from 0 to {whole:g}, got {', '.join(texts)}"
        )
    return red, green, blue
