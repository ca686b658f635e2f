"""Tables of labels' names and colours, recognised by content.

- FreeSurfer (FreeSurferColorLUT.txt, also with tissue types) and 3D Slicer (.ctbl, .txt): label,
  name, red, green, blue, opacity, 0 to 255, or 0 to 1 with decimals.
- MRtrix: label, abbreviation, name, red, green, blue, opacity.
- ITK-SNAP: label, red, green, blue, opacity (0 to 1), two switches, and the name in quotation
  marks.
- Two columns: label and name, separated by blanks, tabs, commas or semicolons.
- BIDS (`*_dseg.tsv`), 3D Slicer's .csv, and other tables with column names in the first row,
  separated by tabs, commas or semicolons: columns for the label, the name, and optionally the
  colour, as "#rrggbb" or as three numbers.
- nnU-Net's dataset.json: names by label, or labels by name.
- FSL's atlas files (.xml): a label's number is its `value`, or else its `index`, plus 1 for a
  probabilistic atlas, as in the atlas's maxprob images.
- Segmentations with names of their own: 3D Slicer's (.seg.nrrd), DICOM's (SEG), and NIfTI with
  names in a header extension, as of TotalSegmentator and Connectome Workbench.
- The name of a program, for the table that it always uses (label_tables.toml).

Lines that are empty or begin with # are skipped. Opacities are ignored. A label with two names has
none.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from tetopt.contents.labels import LARGEST_LABEL, hex_colour
from tetopt.errors import InputError, Note, prefix_errors, warn
from tetopt.io.itk_headers import NRRD_SUFFIXES, read_header
from tetopt.io.nifti import NIFTI, label_text
from tetopt.io.read_dicom import dicom_file, read_segments_table
from tetopt.io.segments import segments_of, segments_table
from tetopt.io.text import plain
from tetopt.model.label_names import NO_TABLE, LabelTable
from tetopt.system.arrays import Json
from tetopt.system.incoming import irregular, json_of, regular_file, text_of, toml_of

__all__ = ["NO_TABLE", "LabelTable", "load_label_table"]

SNAP_LINE = re.compile(
    r'\s*(\d{1,10})\s+(\d+)\s+(\d+)\s+(\d+)\s+([\d.eE+-]+)\s+([01])\s+([01])\s+"(.*)"\s*'
)
# A name has no separator, and does not end in two numbers, which would be further columns.
PAIR_LINE = re.compile(
    r'\s*(\d{1,10})(?:\s*[,;\t]\s*|\s+)(?!.*\s[\d.]+\s+[\d.]+\s*$)"?([^,;\t"]*[^,;\t"\s])"?\s*'
)
# A label, a name that may have blanks, and all numbers after it.
LUT_LINE = re.compile(r"\s*(\d{1,10})[\s,;]+(\S.{0,1000}?)((?:[\s,;]+-?\d+(?:\.\d*)?){3,9})\s*")
COMMENT = re.compile(r'\s+#\s+[^\W\d][^"]*$')  # after a name, which may have a # in it
ABBREVIATION = re.compile(r"\W.*|.*[._-].*")  # MRtrix's, such as L.BSTS
TISSUE_TYPES = frozenset(range(-1, 10))  # FreeSurfer's types
USUAL_OPACITIES = frozenset((0, 1, 255))  # usual ones
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
    """A label in the file."""

    where: str  # its line, or what else finds it
    label: int
    name: str
    colour: tuple[float, float, float] | None = None


def load_label_table(path: str | Path) -> LabelTable:
    """Load names and colours of labels from a file.

    `tetopt.io.label_tables` lists the formats, which are recognised by content.

    Parameters
    ----------
    path : str or Path
        A text file, a segmentation, or the name of a program: "totalsegmentator",
        "totalsegmentator_v1", "totalsegmentator_mr", "aseg" (FreeSurfer, SynthSeg) or "simnibs".

    Returns
    -------
    LabelTable
        Names and colours by label.

    Raises
    ------
    InputError
        The file does not exist or has another format; a line differs from the others.

    Warns
    -----
    UserWarning
        A label has two names, and gets none.

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
    if is_preset_table(path):
        return LabelTable({int(label): name for label, name in _presets()[str(path)].items()}, {})
    if (table := own_label_table(path)).names:
        return table
    if path.name.lower().endswith((*NRRD_SUFFIXES, *NIFTI.suffixes)) or dicom_file(path):
        raise InputError(f"{path}: expected names of segments in this file, found none")
    text = text_of(path, "table of labels' names")
    parse = {"<": _of_xml, "{": _of_json}.get(text.lstrip()[:1], _of_text)
    table = _table_of(path, parse(path, text))
    if not table.names:
        raise InputError(f"{path}: expected names of labels, found none")
    return table


def is_preset_table(path: Path) -> bool:
    """Return whether a path is no file but the name of a program with a fixed table of labels."""
    return str(path) in _presets() and not path.exists()


@cache
def _presets() -> dict[str, Json]:
    return toml_of(Path(__file__).with_suffix(".toml"), "table of presets")


def _table_of(path: Path, entries: Iterable[LabelEntry]) -> LabelTable:
    """Return the names and colours of entries; a label with two names has none."""
    table = LabelTable({}, {})
    first: dict[int, LabelEntry] = {}
    doubled = {}
    for entry in entries:
        if entry.label > LARGEST_LABEL:
            raise InputError(
                f"{path}, {entry.where}: expected a label up to {LARGEST_LABEL}, got "
                f"{entry.label}; correct it"
            )
        former = first.setdefault(entry.label, entry)
        if former.name != entry.name:
            words = (f'"{each.name}" ({each.where})' for each in (former, entry))
            doubled[entry.label] = f"{entry.label}, {' and '.join(words)}"
        if entry.name not in NO_NAMES:
            table.names[entry.label] = entry.name
        if entry.colour is not None:
            table.colours.setdefault(entry.label, entry.colour)
    if doubled:
        warn(f"{path}: labels with two names get none: {'; '.join(doubled.values())}")
    return table._replace(names={k: v for k, v in table.names.items() if k not in doubled})


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
        name = path.name.lower()
        if name.endswith(NIFTI.suffixes) and not path.is_dir():
            text = label_text(regular_file(path, "image"))
            try:
                return _table_of(path, _of_xml(path, text)) if text else NO_TABLE
            except InputError as error:
                warn(f"{error}; names of labels in its header are ignored")
                return NO_TABLE
        if not name.endswith(NRRD_SUFFIXES) or irregular(path) is not None:
            return NO_TABLE
        return segments_table(segments_of(read_header(path).texts))


def _of_json(path: Path, text: str) -> Iterator[LabelEntry]:
    """Yield the labels of nnU-Net's dataset.json: {"1": "liver"} or {"liver": 1}."""
    try:
        words = json_of(text)
    except ValueError as error:
        raise InputError(f"{path}: expected JSON, got {error}") from error
    labels = words.get("labels", words)
    for key, value in labels.items() if isinstance(labels, dict) else ():
        is_number = re.fullmatch(r"\d{1,10}", key) and isinstance(value, str)
        label, name = (key, value) if is_number else (value, key)
        if isinstance(label, bool) or re.fullmatch(r"\d{1,10}", str(label)) is None:
            raise InputError(
                f'{path}: expected one label for "{name}", as in nnU-Net\'s dataset.json, got '
                f"{label}; regions have no names: give a table with the labels of the file"
            )
        yield LabelEntry(f'"{key}"', int(label), _one_line(name))


def _of_xml(path: Path, text: str) -> Iterator[LabelEntry]:
    """Yield the labels of FSL's atlas files, or of a CaretExtension."""
    try:
        root = ElementTree.fromstring(text)
        kind = (root.findtext("header/type") or "").strip().lower()
        is_shifted = kind.startswith("prob")
        for each in root.iter():
            if each.tag.lower() != "label":
                continue
            name = _one_line("".join(each.itertext()))
            number = each.get("Key") or each.get("value")
            label = int(number or each.attrib["index"]) + (is_shifted and not number)
            tones = [each.get(tone, "") for tone in ("Red", "Green", "Blue")]
            colour = _colour(path, name, tones, 1.0) if "" not in tones else None
            yield LabelEntry(f'"{name}"', label, name, colour)
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: expected labels with numbers, as in FSL's atlas files, got {error}"
        ) from error
    if is_shifted:
        warn(f"{path}: a probabilistic atlas: labels are index + 1, as in its maxprob images", Note)


def _of_text(path: Path, text: str) -> Iterator[LabelEntry]:
    """Yield the labels of the lines, all in the format of the first line."""
    lines = [
        (number, COMMENT.sub("", line).strip(" "))
        for number, line in enumerate(re.split(r"\r\n?|\n", text), 1)
    ]
    lines = [(number, line) for number, line in lines if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path}: expected a label and its name on each line, found no lines")
    first = lines[0][1]
    if SNAP_LINE.fullmatch(first):
        words = 'label, red, green, blue, opacity, 1, 1, "name", as in ITK-SNAP'
        for where, (label, *tones, _, _, _, name) in _match_lines(path, lines, SNAP_LINE, words):
            colour = _colour(path, where, tones, 255.0)
            yield LabelEntry(where, int(label), _one_line(name), colour)
    elif PAIR_LINE.fullmatch(first):
        for where, (label, name) in _match_lines(path, lines, PAIR_LINE, "a label and its name"):
            yield LabelEntry(where, int(label), _one_line(name))
    elif LUT_LINE.fullmatch(first):
        words = "label, name, red, green, blue, opacity, as in FreeSurfer and 3D Slicer"
        rows = list(_match_lines(path, lines, LUT_LINE, words))
        split = next(filter(None, (_split_names(path, lines, each) for each in "\t,;")), None)
        yield from _of_colours(path, split or rows, split is not None, "mrtrix" in text.lower())
    else:
        yield from _of_columns(path, lines)


def _match_lines(
    path: Path, lines: list[tuple[int, str]], pattern: re.Pattern[str], form: str
) -> Iterator[tuple[str, tuple[str, ...]]]:
    for number, line in lines:
        if (match := pattern.fullmatch(line)) is None:
            raise InputError(f'{path}, line {number}: expected {form}, got "{line}"')
        yield f"line {number}", match.groups()


def _split_names(
    path: Path, lines: list[tuple[int, str]], separator: str
) -> list[tuple[str, tuple[str, ...]]]:
    """Return label, name and numbers where a separator is around all names; none elsewhere."""
    rows: list[tuple[str, tuple[str, ...]]] = []
    for number, line in lines:
        cells = [each.strip() for each in _cells(path, number, line, separator)]
        label, name = [*cells, "", ""][:2]
        match = LUT_LINE.fullmatch(f"{label} x {' '.join(cells[2:])}")
        if match is None or match[2] != "x" or not name:
            return []
        rows.append((f"line {number}", (label, name, match[3])))
    return rows


def _of_colours(
    path: Path, lines: list[tuple[str, tuple[str, ...]]], is_split: bool, is_mrtrix: bool
) -> Iterator[LabelEntry]:
    """Yield the labels of lines with a label, a name and numbers: a colour, and what programs add
    to it. Without separators around names, the first numbers may belong to these.
    """
    rows = [
        (where, label, name.split(), re.split(r"[\s,;]+", numbers.strip(" \t,;")))
        for where, (label, name, numbers) in lines
    ]
    has_types = is_split or _has_types(path, rows)
    # Names of two words may differ in both, as abbreviations and names do.
    pairs = [words for *_, words, numbers in rows if (len(words), len(numbers)) == (2, 4)]
    has_short = (
        not is_split
        and 1 < len(rows) == len(pairs)
        and all(len(set(each)) == len(rows) for each in zip(*pairs, strict=True))
        and (is_mrtrix or all(ABBREVIATION.fullmatch(short) for short, _ in pairs))
    )
    if has_short:
        warn(f"{path}: read as MRtrix's: label, abbreviation, name, colour", Note)
    whole = 1.0 if any("." in number for *_, numbers in rows for number in numbers[:3]) else 255.0
    for where, label, words, numbers in rows:
        n_kept = 0 if has_types else max(len(numbers) - 4, 0)
        name = " ".join(words[has_short:] + numbers[:n_kept]).strip('"')
        colour = _colour(path, where, numbers[n_kept:][:3], whole)
        yield LabelEntry(where, int(label), _one_line(name), colour)


def _has_types(path: Path, rows: Sequence[tuple[str, str, list[str], list[str]]]) -> bool:
    """Return whether the fifth numbers are tissue types, as in FreeSurfer's, and not opacities
    after names that end in numbers, such as "rib 3".

    Raises
    ------
    InputError
        They may be both; or only some lines have opacities, or those may be part of the colours.
    """
    long = [(words, [*map(float, numbers)]) for *_, words, numbers in rows if len(numbers) > 4]
    counts = {len(numbers) for *_, numbers in rows}
    names = {(label, *words) for _, label, words, _ in rows}
    is_doubled = len({each[1:] for each in names}) < len(names)
    opacities = {float(numbers[3]) for *_, numbers in rows if len(numbers) == 4}
    is_unclear = 3 in counts and len(counts) > 1
    is_unclear |= counts == {4} and is_doubled and not opacities <= USUAL_OPACITIES
    lasts = {values[-1] for _, values in long}
    has_types = bool(long) and lasts <= TISSUE_TYPES and all(len(values) == 5 for _, values in long)
    if has_types and lasts <= USUAL_OPACITIES:
        has_types = False
        is_unclear |= all(
            len(words) == 1 and values[3] in USUAL_OPACITIES for words, values in long
        )
    if is_unclear:
        raise InputError(
            f"{path}: the numbers may end names or be colours; separate the columns by tabs, "
            "or name them in the first row"
        )
    return has_types


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
            "Slicer, a label and its name on each line, or a row of "
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
            tones_here = [cells.get(part, "") for part in tones]
            colour = _colour(path, f"line {number}", tones_here, whole)
        elif code is not None and (text := cells.get(code, "")) not in NO_NAMES:
            colour = hex_colour(f"#{text.removeprefix('#')}")
            if colour is None:
                raise InputError(
                    f'{path}, line {number}: expected a colour as #rrggbb, got "{text}"'
                )
        yield LabelEntry(f"line {number}", int(float(cells[label])), _one_line(cells[name]), colour)


def _cells(path: Path, number: int, line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator))
    except csv.Error as error:
        raise InputError(f"{path}, line {number}: cannot be read ({error})") from error


def _one_line(name: str) -> str:
    return plain(" ".join(name.split()))


def _colour(
    path: Path, where: str, texts: Sequence[str], whole: float
) -> tuple[float, float, float]:
    """Parse a colour of three numbers from 0 to `whole`."""
    try:
        red, green, blue = (float(text) / whole for text in texts)
    except ValueError:
        red = green = blue = -1.0
    if not all(0.0 <= part <= 1.0 for part in (red, green, blue)):
        raise InputError(
            f"{path}, {where}: expected red, green and blue from 0 to {whole:g}, got "
            f"{', '.join(texts)}"
        )
    return red, green, blue
