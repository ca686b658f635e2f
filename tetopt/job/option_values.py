"""Values that the texts of options stand for: numbers, sizes by label, files of tissues."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError, prefix_errors
from tetopt.io.images import file_shape
from tetopt.io.label_tables import LabelTable
from tetopt.io.text import list_names
from tetopt.job.options import SourceOptions
from tetopt.model.mappings import named_file
from tetopt.start.label_sizes import EVERY_LABEL, LabelSize, parse_label_sizes
from tetopt.system.incoming import rows_of

# headings of the column of sizes in a table
SIZE_HEADS = ("size", "size_mm", "mm", "edge", "length")


SizesByName = dict[int | str, LabelSize]  # by labels' names or numbers


def file_and_volume(path: Path) -> tuple[Path, int | None]:
    """Split `FILE:K` into a file and the volume that K names."""
    name, colon, volume = str(path).rpartition(":")
    if colon and re.fullmatch("[0-9]{1,18}", volume) and not path.exists():
        return Path(name), int(volume)
    return path, None


def tissue_files(path: Path | None) -> list[Path]:
    """Split an option into the files of tissues, separated by commas."""
    return [] if path is None else [Path(name.strip()) for name in str(path).split(",")]


def tissue_volumes(path: Path) -> dict[str, Path]:
    """Return the files of tissues, or `FILE:K` for each volume of one, by the tissues' names;
    raise InputError.
    """
    files = tissue_files(path)
    if Path() in files or len(set(files)) < len(files):
        raise InputError(f"`tissues`: expected different files, separated by commas, got {path}")
    shape = file_shape(files[0]) if len(files) == 1 else None
    if (
        shape is not None
        and len(shape) > 3
        and shape[3] > 1
        and file_and_volume(files[0])[1] is None
    ):
        return {f"tissue {k + 1}": Path(f"{path}:{k}") for k in range(shape[3])}
    names = [file_and_volume(file)[0].name.split(".")[0] for file in files]
    numbered = [
        name if names.count(name) == 1 else f"{name} {k}" for k, name in enumerate(names, 1)
    ]
    return dict(zip(numbered, files, strict=True))


def number_of(name: str, text: str) -> float:
    """Convert an option's text to a number; raise InputError with the option's name if it is not
    one.
    """
    try:
        return float(text)
    except ValueError:
        raise InputError(f'{name}: expected a number, got "{text}"') from None


class Balance(NamedTuple):
    """Weights of images and labels."""

    weights: list[float]
    label_weight: float


def balance_of(options: SourceOptions) -> Balance:
    """Return the requested balance, with defaults."""
    weights = [1.0] * len(options.images)
    if options.weights is not None:
        weights = [number_of("`weights`", part) for part in options.weights.split(",")]
    return Balance(weights, 1.0 if options.label_weight is None else options.label_weight)


def label_sizes_of(text: str, table: LabelTable | None = None) -> SizesByName:
    """Parse sizes by label, from an option or a file; a table of labels, if any, converts names
    to numbers.
    """
    file = named_file(text)
    if file is not None:
        text = ",".join(
            f"{name}={''.join(cells[:1])}"
            for name, cells in rows_of(file, "table of sizes", SIZE_HEADS)
        )
    with prefix_errors(file or ""):
        sizes = parse_label_sizes(text)
        return sizes if table is None else _by_number(sizes, table)


def _by_number(sizes: SizesByName, table: LabelTable) -> SizesByName:
    """Return the sizes by the labels' numbers instead of names."""
    numbers = {name: label for label, name in table.names.items()}
    known = {
        name: size
        for name, size in sizes.items()
        if isinstance(name, int) or name in (*numbers, EVERY_LABEL)
    }
    if unknown := [name for name in sizes if name not in known]:
        raise InputError(
            f'label_size: no label has the name "{unknown[0]}"; '
            f"{list_names([*numbers]) or 'the labels have no names'}"
        )
    by_label: SizesByName = {}
    for name, size in known.items():
        label = numbers.get(str(name), name)
        if label in by_label:
            raise InputError(f"label_size: label {label} has two sizes")
        by_label[label] = size
    return by_label
