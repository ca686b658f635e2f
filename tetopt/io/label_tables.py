"""Label tables with names and colours: FreeSurfer, ITK-SNAP, 3D Slicer, BIDS, or any CSV,
recognised by content.

- FreeSurfer (FreeSurferColorLUT.txt) and 3D Slicer (.ctbl, .txt): label, name, red, green, blue,
  opacity, 0 to 255.
- ITK-SNAP: label, red, green, blue, opacity (0 to 1), two switches, and the name in quotation
  marks.
- 3D Slicer's segmentations (.seg.nrrd) and DICOM's (SEG): the names and colours of their segments.
- BIDS (`*_dseg.tsv`), 3D Slicer's .csv, and other tables with column names in the first row,
  separated by tabs, commas or semicolons: columns for the label, the name, and optionally the
  colour, as "#rrggbb" or as three numbers.

Lines that are empty or begin with # are skipped. Opacities are ignored.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tetopt.contents.labels import LARGEST_LABEL, hex_colour
from tetopt.errors import InputError, prefix_errors
from tetopt.io.itk_headers import NRRD_SUFFIXES, read_header
from tetopt.io.read_dicom import dicom_file, read_segments_table
from tetopt.io.segments import segments_of, segments_table
from tetopt.io.text import plain
from tetopt.model.label_names import NO_TABLE, LabelTable
from tetopt.system.incoming import irregular, text_of

__all__ = ["NO_TABLE", "LabelTable", "load_label_table"]

SNAP_LINE = re.compile(
    r'\s*(\d{1,10})\s+(\d+)\s+(\d+)\s+(\d+)\s+([\d.eE+-]+)\s+([01])\s+([01])\s+"(.*)"\s*'
)
LUT_LINE = re.compile(r"\s*(\d{1,10})\s+(\S.*?)\s+(\d+)\s+(\d+)\s+(\d+)(?:\s+([\d.]+))?\s*")
# Names of columns, in lower case without blanks; the first one present is used.
LABEL_COLUMNS = ("labelvalue", "index", "id", "value", "labelid", "label", "labels")
NAME_COLUMNS = (
    "name",
    "labelname",
    "structure",
    "structures",
    "region",
    "type_codemeaning",
    "label",
)
HEX_COLUMNS = ("color", "colour", "hex")
RGB_COLUMNS = (("r", "g", "b"), ("red", "green", "blue"), ("color_r", "color_g", "color_b"))
NO_NAMES = ("", "(none)", "n/a")  # missing names in 3D Slicer and BIDS


class LabelEntry(NamedTuple):
    """A label in a line of the file."""

    line: int  # from 1
    label: int
    name: str
    colour: tuple[float, float, float] | None


def load_label_table(path: str | Path) -> LabelTable:
    """Load names and colours of labels from a file.

    Colour tables of FreeSurfer and 3D Slicer, label descriptions of ITK-SNAP, BIDS's `*_dseg.tsv`
    and any CSV with column names in the first row are recognised by their content;
    `tetopt.io.label_tables` lists the columns. So are segmentations with names of their own: 3D
    Slicer's (.seg.nrrd) and DICOM's.

    Parameters
    ----------
    path : str or Path
        A text file, or a segmentation.

    Returns
    -------
    LabelTable
        Names and colours by label.

    Raises
    ------
    InputError
        The file does not exist or has another format; a line differs from the others; a label has
        two names or two colours.

    Examples
    --------
    >>> from pathlib import Path
    >>> text = "label,name,color\\n1,liver,#b02020\\n2,spleen,#802060\\n"
    >>> _ = Path("labels.csv").write_text(text)
    >>> table = tetopt.load_label_table("labels.csv")
    >>> table.names
    {1: 'liver', 2: 'spleen'}
    """
    path = Path(path)
    if (table := own_label_table(path)).names:
        return table
    if path.name.lower().endswith(NRRD_SUFFIXES) or dicom_file(path) is not None:
        raise InputError(f"{path}: expected names of segments in this file, found none")
    text = text_of(path, "table of labels' names")
    lines = [(number, line.strip(" ")) for number, line in enumerate(text.split("\n"), 1)]
    lines = [(number, line) for number, line in lines if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path}: expected a label and its name on each line, found no lines")
    table = LabelTable({}, {})
    of_label: dict[int, LabelEntry] = {}
    for entry in _entries(path, lines):
        if entry.label > LARGEST_LABEL:
            raise InputError(
                f"{path}, line {entry.line}: expected a label up to {LARGEST_LABEL}, got "
                f"{entry.label}; correct it"
            )
        first = of_label.setdefault(entry.label, entry)
        if first._replace(line=entry.line) != entry:
            raise InputError(
                f'{path}, line {entry.line}: label {entry.label} is "{entry.name}", but '
                f'"{first.name}" on line '
                f"{first.line}; list each label only once"
            )
        if entry.name not in NO_NAMES:
            table.names[entry.label] = entry.name
        if entry.colour is not None:
            table.colours[entry.label] = entry.colour
    if not table.names:
        raise InputError(f"{path}: expected names of labels, found none")
    return table


def own_label_table(path: Path) -> LabelTable:
    """Return the names and colours that a segmentation's own file has; empty for a file without
    any.

    Raises
    ------
    InputError
        The file is such a segmentation and cannot be read.
    """
    with prefix_errors(path):
        if (file := dicom_file(path)) is not None:
            return read_segments_table(file)
        if not path.name.lower().endswith(NRRD_SUFFIXES) or irregular(path) is not None:
            return NO_TABLE
        return segments_table(segments_of(read_header(path).texts))


def _entries(path: Path, lines: list[tuple[int, str]]) -> Iterator[LabelEntry]:
    """Yield the labels of the lines, all in the format of the first line."""
    first = lines[0][1]
    if SNAP_LINE.fullmatch(first):
        yield from _match_lines(
            path, lines, SNAP_LINE, 'label, red, green, blue, opacity, 1, 1, "name", as in ITK-SNAP'
        )
    elif LUT_LINE.fullmatch(first):
        words = "label, name, red, green, blue, opacity, as in FreeSurfer and 3D Slicer"
        yield from _match_lines(path, lines, LUT_LINE, words)
    else:
        yield from _of_columns(path, lines)


def _match_lines(
    path: Path, lines: list[tuple[int, str]], pattern: re.Pattern[str], form: str
) -> Iterator[LabelEntry]:
    for number, line in lines:
        if (match := pattern.fullmatch(line)) is None:
            raise InputError(f'{path}, line {number}: expected {form}, got "{line}"')
        parts = match.groups()
        tones, name = (
            (parts[1:4], parts[7]) if pattern is SNAP_LINE else (parts[2:5], parts[1].strip('"'))
        )
        yield LabelEntry(
            number, int(parts[0]), _one_line(name), _colour(path, number, tones, 255.0)
        )


def _of_columns(path: Path, lines: list[tuple[int, str]]) -> Iterator[LabelEntry]:
    """Yield the labels of a table with column names in the first row."""
    head = lines[0][1]
    separator = max("\t,;", key=head.count)
    rows = [_cells(path, number, line, separator) for number, line in lines]
    columns = {re.sub(r"\s", "", name).lower(): k for k, name in reversed(list(enumerate(rows[0])))}
    label = next((name for name in LABEL_COLUMNS if name in columns), None)
    name = next((each for each in NAME_COLUMNS if each in columns and each != label), None)
    if label is None or name is None:
        raise InputError(
            f"{path}, line {lines[0][0]}: expected a label table of FreeSurfer, ITK-SNAP or 3D "
            "Slicer, or a row of "
            f'column names with "label" (or "index") and "name", got "{head[:60]}"'
        )
    tones = next((each for each in RGB_COLUMNS if all(part in columns for part in each)), ())
    texts = [row[columns[part]] for row in rows[1:] for part in tones if columns[part] < len(row)]
    whole = 1.0 if any("." in text for text in texts) else 255.0  # decimals mean a range of 0 to 1
    code = next((each for each in HEX_COLUMNS if each in columns), None)
    for (number, line), row in zip(lines[1:], rows[1:], strict=True):
        cells = {each: row[k].strip() for each, k in columns.items() if k < len(row)}
        if label not in cells or name not in cells:
            raise InputError(
                f"{path}, line {number}: expected {len(rows[0])} columns, as in the first row, "
                f'got "{line}"'
            )
        if re.fullmatch(r"\d{1,10}(\.0*)?", cells[label]) is None:
            raise InputError(
                f"{path}, line {number}: expected a whole number from 0 in column {label}, got "
                f'"{cells[label]}"'
            )
        colour = None
        if tones and any(cells.get(part, "") not in NO_NAMES for part in tones):
            colour = _colour(path, number, [cells.get(part, "") for part in tones], whole)
        elif code is not None and (text := cells.get(code, "")) not in NO_NAMES:
            colour = hex_colour(text)
            if colour is None:
                raise InputError(
                    f'{path}, line {number}: expected a colour as #rrggbb, got "{text}"'
                )
        yield LabelEntry(number, int(float(cells[label])), _one_line(cells[name]), colour)


def _cells(path: Path, number: int, line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator))
    except csv.Error as error:
        raise InputError(f"{path}, line {number}: cannot be read ({error})") from error


def _one_line(name: str) -> str:
    return plain(" ".join(name.split()))


def _colour(
    path: Path, line: int, texts: list[str] | tuple[str, ...], whole: float
) -> tuple[float, float, float]:
    """Parse a colour of three numbers from 0 to `whole`."""
    try:
        red, green, blue = (float(text) / whole for text in texts)
    except ValueError:
        red = green = blue = -1.0
    if not all(0.0 <= part <= 1.0 for part in (red, green, blue)):
        raise InputError(
            f"{path}, line {line}: expected red, green and blue from 0 to {whole:g}, got "
            f"{', '.join(texts)}"
        )
    return red, green, blue
