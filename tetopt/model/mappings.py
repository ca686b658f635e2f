"""Modulus mappings from an intensity, named fields or a label to a value such as Young's modulus,
as text, files or arrays.
"""

from __future__ import annotations

import contextlib
import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError, prefix_errors
from tetopt.model.formula import INTENSITY, Formula, Named, parse_formula, parse_range
from tetopt.system.arrays import Bools, Floats
from tetopt.system.incoming import text_of, toml_of

MODULI = ("young", "young_along", "shear_along")  # quantities in units of stress
MAPPED_OPTIONS = (*MODULI, "nu", "density")  # options of commands whose text is a mapping
FILES_IN_TEXTS = (*MAPPED_OPTIONS, "merge", "label_size")  # options whose text may name a file
NAMED_SUFFIXES = (".toml", ".csv")  # of that file
BY_LABEL = re.compile("(?<![<>=!])=(?!=)")  # not a comparison
MODULUS_UNITS = {"Pa": 1e-3, "kPa": 1.0, "MPa": 1e3, "GPa": 1e6}  # kPa
# not the end of a name, as in h*hPa
UNIT_AT_END = re.compile(rf"(.*[\d.)\s])\s*({'|'.join(MODULUS_UNITS)})\s*", re.I | re.S)
RANGE_AT_END = re.compile(r"(.*\S)\s+for\s+(.*)", re.S)  # "for" is no name in formulas
COLUMN_WITH_UNIT = re.compile(rf"young[\s_]*[\[(]?({'|'.join(MODULUS_UNITS)})[\])]?", re.I)

ModulusMapping = (
    Callable[[Floats], ArrayLike] | Sequence[Sequence[float]] | NDArray[np.floating] | None
)


class ByLabel(NamedTuple):
    """A value for each label instead of a mapping of the intensity.

    Parameters
    ----------
    values : dict of int or str to float
        Values by label, or by a label's name (`tetopt.model.materials.by_label`).
    rest : float, optional
        The value of all other labels.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> labels = phantom.label_image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(labels, nodes=300)
    >>> data = {"label": tetopt.cell_labels(labels, mesh)}
    >>> model = tetopt.build_model(mesh, young=tetopt.ByLabel({1: 10.0}, rest=2.0), cell_data=data)
    >>> model.materials.young.tolist()
    [2.0, 10.0]
    """

    values: dict[int | str, float]
    rest: float | None = None


def mapped_values(mapping: ModulusMapping, intensities: ArrayLike | Named) -> Floats:
    """Apply a mapping to intensities, or a formula to values by name; returns float64 values of the
    same shape.

    Parameters
    ----------
    mapping : callable, (K, 2) table or None
        A function of a float64 array; or pairs (intensity, value) with strictly increasing
        intensities, interpolated linearly and constant beyond the ends; or None for the intensity
        itself.
    intensities : array of real numbers, or dict of arrays
        Of all names in a formula (`tetopt.model.formula.Formula`), in the same places.

    Raises
    ------
    InputError
        The table is invalid, or the function returns another shape.
    """
    if isinstance(intensities, Mapping):
        assert isinstance(mapping, Formula), "only formulas name their values"
        return mapping.at(intensities)
    intensities = np.asarray(intensities, dtype=np.float64)
    if mapping is None:
        return intensities.copy()
    if not callable(mapping):
        table = _check_table(mapping)
        return np.interp(intensities, table[:, 0], table[:, 1])
    values = np.asarray(mapping(intensities), dtype=np.float64)
    if values.shape != intensities.shape:
        raise InputError(
            "mapping: expected a function that returns one value for each intensity, got shape "
            f"{values.shape} for shape {intensities.shape}"
        )
    return values


def young_from(mapping: ModulusMapping, intensities: ArrayLike | Named) -> Floats:
    """Map intensities, or values by name, to Young's moduli, kPa, float64 of the same shape:
    `mapped_values`, checked.

    Raises
    ------
    InputError
        For the reasons of `mapped_values`; a modulus is negative or not finite. A modulus of 0 is
        accepted, as empty space inside a cell; a cell with only such voxels is rejected when the
        stiffness matrix is built.

    Examples
    --------
    >>> young_from([(0, 1.0), (100, 5.0)], [-10, 50, 100, 300])
    array([1., 3., 5., 5.])
    """
    young = mapped_values(mapping, intensities)
    is_bad = ~(np.isfinite(young) & (young >= 0.0))
    if is_bad.any():
        first = ", ".join(
            f"{young[is_bad][k]:g} at {at}" for k, at in _places(intensities, is_bad).items()
        )
        undefined = (
            " (undefined, as the root or fractional power of a negative number: write max(h, 0))"
            if np.isnan(young).any()
            else ""
        )
        where = "in the whole mesh"
        if not isinstance(intensities, Mapping):
            where = f"from {np.min(intensities):g} to {np.max(intensities):g}"
        raise InputError(
            f"modulus: expected 0 kPa or more, got {int(is_bad.sum())} invalid values, such as "
            f"{first}{undefined}; give a modulus mapping (`young`) that is positive {where}, or "
            "leave out other tissue (`mask`)"
        )
    return young


def finite_values(mapping: ModulusMapping, intensities: ArrayLike | Named) -> Floats:
    """Map intensities, or values by name, to another quantity: `mapped_values`, checked.

    Raises
    ------
    InputError
        For the reasons of `mapped_values`; a value is not finite.
    """
    values = mapped_values(mapping, intensities)
    if not (is_good := np.isfinite(values)).all():
        at, *_ = _places(intensities, ~is_good).values()
        raise InputError(
            f"mapping: no value at {at}; give a mapping (`nu`, `density`) defined in the whole mesh"
        )
    return values


def _places(intensities: ArrayLike | Named, is_bad: Bools) -> dict[int, str]:
    """Return up to three different places, in words, by their numbers among those that are bad."""
    is_named = isinstance(intensities, Mapping)
    named = intensities if isinstance(intensities, Mapping) else {"intensity": intensities}
    bad = np.column_stack([np.asarray(values)[is_bad] for values in named.values()])
    _, first = np.unique(bad, axis=0, return_index=True)
    return {
        k: ", ".join(
            f"{name} {'= ' * is_named}{x:g}" for name, x in zip(named, bad[k], strict=True)
        )
        for k in first[:3].tolist()
    }


def parse_table(text: str) -> list[tuple[float, float]]:
    """Parse pairs of intensity and modulus from a command line, for `young_from`.

    Raises
    ------
    InputError
        The text does not consist of such pairs.

    Examples
    --------
    >>> parse_table("0:1, 100:5.5")
    [(0.0, 1.0), (100.0, 5.5)]
    """
    try:
        pairs = [tuple(float(number) for number in pair.split(":")) for pair in text.split(",")]
    except ValueError:
        pairs = []
    if not pairs or any(len(pair) != 2 for pair in pairs):
        raise InputError(
            f'mapping: expected pairs intensity:value, such as "0:1,100:5.5", got "{text}"'
        )
    return [(pair[0], pair[1]) for pair in pairs]


def without_unit(text: str, units: str = "kPa") -> tuple[str, str]:
    """Return the text of a modulus or pressure without a unit at its end, and this unit or
    `units`.

    Examples
    --------
    >>> without_unit("2017*h**2.5 MPa"), without_unit("3", "Pa")
    (('2017*h**2.5', 'MPa'), ('3', 'Pa'))
    """
    if (match := UNIT_AT_END.fullmatch(text)) is None:
        return text, units
    return match[1].rstrip(), _unit_named(match[2])


def _unit_named(text: str) -> str:
    return next(unit for unit in MODULUS_UNITS if unit.lower() == text.lower())


def _scale_mapping(mapping: Any, factor: float) -> Any:
    """Multiply the values of a mapping, of any form but one by label."""
    if factor == 1.0:
        return mapping
    if isinstance(mapping, Formula):
        return replace(mapping, function=lambda values: factor * mapping.function(values))
    return factor * mapping if isinstance(mapping, float) else [(h, factor * v) for h, v in mapping]


def parse_labels(text: str, units: str | None = None) -> ByLabel:
    """Parse values by label or by labels' names from a command line, `*` for all others; with
    `units`, of those without a unit of their own, the values are moduli.

    Raises
    ------
    InputError
        The text does not consist of such pairs, names a label twice, or has units for some values
        only.

    Examples
    --------
    >>> parse_labels("1=2.1, 2=1.9, *=0.5")
    ByLabel(values={1: 2.1, 2: 1.9}, rest=0.5)
    >>> parse_labels("left lung=5,*=20")
    ByLabel(values={'left lung': 5.0}, rest=20.0)
    """
    pairs = [pair.partition("=") for pair in text.split(",")]
    try:
        if units and len({UNIT_AT_END.fullmatch(value) is None for _, _, value in pairs}) > 1:
            raise InputError(
                f'values by label: expected a unit for all values or for none, got "{text}"'
            )
        return _by_label([(label, _value(value, units)) for label, _, value in pairs])
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f'values by label: expected pairs such as "1=2.1,2=1.9,*=0.5", got "{text}"'
        ) from None


def _by_label(pairs: list[tuple[str, float]]) -> ByLabel:
    """Convert pairs to values by label; ValueError for an invalid label, InputError for a label
    named twice.
    """
    values: dict[int | str, float] = {}
    rest: float | None = None
    for text, value in pairs:
        label = text.strip()
        is_rest = label == "*"
        key = _label_of(label)
        if (rest is not None) if is_rest else (key in values):
            raise InputError(f"values by label: label {label} has two values; give each once")
        if is_rest:
            rest = value
        else:
            values[key] = value
    return ByLabel(values, rest)


def _label_of(text: str) -> int | str:
    """Parse a label or the name of one; ValueError for an empty text and for a number that is
    not whole.
    """
    if not text:
        raise ValueError("a label without a name")
    try:
        float(text)
    except ValueError:
        return text
    return int(text)


def parse_mapping(text: str) -> ModulusMapping:
    """Parse a mapping of the intensity from a command line, see `parse_any_mapping`.

    Raises
    ------
    InputError
        For the reasons of `parse_any_mapping`; the text gives values by label.
    """
    mapping = parse_any_mapping(text)
    if isinstance(mapping, ByLabel):
        raise InputError(
            f'mapping: expected a mapping of the intensity, got values by label, "{text}"'
        )
    return parse_formula(repr(mapping)) if isinstance(mapping, float) else mapping


def parse_any_mapping(
    text: str, quantity: str = "young", units: str = "kPa", fields: Iterable[str] = ()
) -> ModulusMapping | ByLabel | float:
    """Parse a mapping from a command line.

    Parameters
    ----------
    text : str
        A number; a table of intensities, "0:1,100:5.5"; values by label or name,
        "1=2.1,liver=1.9,*=0.5"; a formula of h and fields (`parse_formula`); or a file named .toml
        or .csv (`load_mapping`). Moduli may name their unit: "3 MPa", "2017*h**2.5 MPa",
        "1=2 kPa,2=1 GPa". Formulas and tables may state the range in which they hold,
        "2017*h**2.5 MPa for 0.1 < h < 1.8"; outside of it they are used, too, and
        `tetopt.build_model` warns.
    quantity : str
        The file's column; `MODULI` are returned in kPa.
    units : {"Pa", "kPa", "MPa", "GPa"}
        Of moduli without a unit.
    fields : iterable of str
        Names of fields that formulas may use.

    Raises
    ------
    InputError
        For the reasons of `parse_table`, `parse_labels`, `parse_formula`, `parse_range` and
        `load_mapping`.
    """
    if (file := named_file(text)) is not None:
        return load_mapping(file, quantity, units)
    if BY_LABEL.search(text):
        return parse_labels(text, units if quantity in MODULI else None)
    ranged = RANGE_AT_END.fullmatch(text)
    law = text if ranged is None else ranged[1]
    unit = "kPa"
    if quantity in MODULI:
        law, unit = without_unit(law, units)
    mapping = _scale_mapping(_parse_by_intensity(law, fields), MODULUS_UNITS[unit])
    return mapping if ranged is None else _within_range(mapping, ranged[2].strip(), fields)


def _within_range(
    mapping: ModulusMapping | float, text: str, fields: Iterable[str]
) -> ModulusMapping:
    """Return a number, table or formula as a formula with the range in which it holds."""
    outside = parse_range(text, fields)
    if isinstance(mapping, float):
        mapping = parse_formula(repr(mapping))
    if not isinstance(mapping, Formula):
        table = mapping
        mapping = Formula(
            frozenset({INTENSITY}), lambda values: mapped_values(table, values[INTENSITY])
        )
    names = mapping.names or outside.names  # a number's: it is the same on all grids
    return replace(mapping, names=names, outside=outside, range_text=text)


def _parse_by_intensity(text: str, fields: Iterable[str]) -> ModulusMapping | float:
    """Parse a number, a table or a formula."""
    with contextlib.suppress(ValueError):
        if np.isfinite(value := float(text)):
            return value
    return _check_pairs(parse_table(text)) if ":" in text else parse_formula(text, fields)


def named_file(text: str) -> Path | None:
    """Return the file that the text of an option in `FILES_IN_TEXTS` names; None if it names no
    file.
    """
    return Path(text) if text.lower().endswith(NAMED_SUFFIXES) else None


def load_mapping(
    path: Path, quantity: str = "young", units: str = "kPa"
) -> ModulusMapping | ByLabel:
    """Load a mapping from a file with two or more columns: lists in TOML, or CSV with names in the
    first row.

    Commas, semicolons or tabs separate the columns of CSV.

    One column is "intensity", or "label" (numbers or names, "*" for all others), or "name" instead;
    another is the quantity, such as "young" or "nu". Moduli are in `units` unless the column of
    young is named "young [MPa]" or similar, whose unit is that of all moduli, or a value has its
    own unit, and are returned in kPa.

    Raises
    ------
    InputError
        The file does not exist or has another format; columns are missing, differ in length or are
        not numbers; intensities do not increase.
    """
    try:
        with prefix_errors(path):
            return _mapping_in(path, quantity, units)
    except InputError:
        raise
    except (ValueError, TypeError, csv.Error, RecursionError) as error:
        raise InputError(
            f"{path}: expected columns of numbers ({' '.join(str(error).split())})"
        ) from error


def _mapping_in(path: Path, quantity: str, units: str) -> ModulusMapping | ByLabel:
    columns, unit = _columns(path)
    keys: list[str] = [name for name in ("intensity", "label") if name in columns]
    if not keys and "name" in columns:
        keys = ["name"]
    if len(keys) != 1 or quantity not in columns:
        raise InputError(
            f'expected columns "{quantity}" and one of "intensity", "label" and "name", found '
            f"{', '.join(map(str, columns)) or 'none'}"
        )
    if len(columns[keys[0]]) != len(columns[quantity]):
        counts = f"{len(columns[keys[0]])} of {keys[0]} and {len(columns[quantity])} of {quantity}"
        raise InputError(f"expected columns of the same length, got {counts}")
    units_of = (unit or units) if quantity in MODULI else None
    numbers = [_value(value, units_of) for value in columns[quantity]]
    pairs = list(zip(columns[keys[0]], numbers, strict=True))
    if keys != ["intensity"]:
        return _by_label([(str(label), value) for label, value in pairs])
    return _check_pairs([(_number(h), value) for h, value in pairs])


def _number(value: Any) -> float:
    """Convert to float; InputError for a decimal comma, which is common in CSV files."""
    if isinstance(value, str) and re.fullmatch(r"\s*[+-]?\d+,\d+\s*", value):
        text = value.strip()
        raise InputError(
            f"expected numbers with a decimal point; write {text.replace(',', '.')} for {text}"
        )
    return float(value)


def _value(value: Any, units: str | None) -> float:
    """Convert to float; with `units` a modulus, whose unit may follow it in a text, to kPa."""
    if units is None:
        return _number(value)
    number, unit = without_unit(value, units) if isinstance(value, str) else (value, units)
    return _number(number) * MODULUS_UNITS[unit]


def has_column(text: str, name: str) -> bool:
    """Return whether a mapping's text names a file with this column.

    Raises
    ------
    InputError
        For the reasons of `load_mapping` on files.
    """
    if (file := named_file(text)) is None:
        return False
    try:
        return name in _columns(file)[0]
    except (ValueError, RecursionError):  # reported when the required column is read
        return False


def _columns(path: Path) -> tuple[dict[str, list[Any]], str | None]:
    """Return the columns of a file, and the unit that the name of "young" has."""
    columns = _toml_columns(path) if path.suffix.lower() == ".toml" else _csv_columns(path)
    of_young = {name: match for name in columns if (match := COLUMN_WITH_UNIT.fullmatch(name))}
    if not of_young:
        return columns, None
    if len(of_young) > 1 or "young" in columns:
        raise InputError(f"{path}: expected one column of young, found {', '.join(columns)}")
    ((name, match),) = of_young.items()
    return columns | {"young": columns[name]}, _unit_named(match[1])


def _toml_columns(path: Path) -> dict[str, list[Any]]:
    columns = toml_of(path, "table")
    if wrong := [name for name, column in columns.items() if not isinstance(column, list)]:
        raise InputError(
            f'{path}: expected lists of numbers, but "{wrong[0]}" is '
            f"{type(columns[wrong[0]]).__name__}"
        )
    return columns


def _csv_columns(path: Path) -> dict[str, list[Any]]:
    lines = [line for line in text_of(path, "table").splitlines() if line.strip()]
    separator = max(",;\t", key=lines[0].count) if lines else ","
    rows = [row for row in csv.reader(lines, delimiter=separator) if row]
    if not rows or any(len(row) != len(rows[0]) for row in rows):
        comma = "" if separator != "," else "; if it has decimal commas, write 2.1 for 2,1"
        raise InputError(f"{path}: expected a row of names, then rows with as many numbers{comma}")
    names = [name.strip().lower() for name in rows[0]]
    if len(set(names)) != len(names):
        raise InputError(f"{path}: expected each column once, found {', '.join(names)}")
    return {name: [row[number] for row in rows[1:]] for number, name in enumerate(names)}


def _check_pairs(pairs: list[tuple[float, float]]) -> list[tuple[float, float]]:
    _check_table(pairs)
    return pairs


def check_young(young: Floats) -> Floats:
    """Return the moduli of cells, (M,); InputError unless all are above 0."""
    hint = 'give empty space a small modulus, as in `young` "max(3*h, 0.1)"'
    return check_cells("young", young, young > 0.0, "moduli above 0 kPa", hint)


def check_nu(nu: Floats) -> Floats:
    """Return the Poisson's ratios of cells, (M,); InputError unless a material can have them."""
    hint = "for nearly incompressible tissue use 0.45 to 0.49"
    return check_cells("nu", nu, (nu > -1.0) & (nu < 0.5), "-1 < nu < 0.5", hint)


def check_cells(name: str, values: Floats, is_good: Bools, expected: str, hint: str) -> Floats:
    """Return the values of cells, (M,); InputError unless all are good, (M,), and finite."""
    bad = np.flatnonzero(~(np.isfinite(values) & is_good))
    if len(bad):
        first = ", ".join(f"{values[j]:g} in cell {j}" for j in bad[:3])
        raise InputError(
            f"{name}: expected {expected}, got {len(bad)} invalid values, the first {first}; {hint}"
        )
    return values


def _check_table(mapping: ArrayLike) -> Floats:
    """Return the (K, 2) table as float64; InputError unless finite and increasing."""
    try:
        table = np.asarray(mapping, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"mapping: expected pairs (intensity, kPa), got {mapping!r}") from error
    if table.ndim != 2 or table.shape[1] != 2 or len(table) == 0:
        raise InputError(
            f"mapping: expected pairs (intensity, kPa), got an array of shape {table.shape}"
        )
    if not np.isfinite(table).all():
        raise InputError(f"mapping: expected finite intensities and moduli, got {table.tolist()}")
    falls = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
    if len(falls):
        k = int(falls[0])
        raise InputError(
            f"mapping: intensities must increase, got {table[k, 0]:g} and then "
            f"{table[k + 1, 0]:g}; sort the pairs and give each intensity once"
        )
    return table
