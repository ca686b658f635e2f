"""The request of a run, with checksums: equal for runs with the same mesh, and stored in their
run.json.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import tetopt
from tetopt.io.images import sha256, status_checksum
from tetopt.io.label_tables import is_preset_table
from tetopt.job.field_files import parse_fields
from tetopt.job.option_values import file_and_volume, tissue_files
from tetopt.job.options import (
    JobOptions,
    OutputOptions,
    given_options,
    kinds_of,
    option_name,
)
from tetopt.model.mappings import FILES_IN_TEXTS, named_file
from tetopt.system.arrays import Json

# Options that do not affect the outputs: names of outputs, and threads.
OPTIONS_IGNORED = ("threads", *(each.name for each in fields(OutputOptions)))


def job_request(job: JobOptions) -> Json:
    """Return all that determines the outputs of a run: options, the files' names and checksums, the
    version.

    Names of outputs and of folders, and the number of threads are not included.

    Returns
    -------
    dict
        `options`, the given ones, with `format`, the suffix of the mesh's file; `files`, for each
        option with files a list of [name, SHA-256]; `tetopt`, the version; and `sha256` of all
        this.

    Raises
    ------
    InputError
        A file is missing or unreadable.
    """
    kinds = kinds_of(JobOptions)
    left_out = {option_name(name, kinds[name]) for name in OPTIONS_IGNORED}
    options = {name: value for name, value in given_options(job).items() if name not in left_out}
    files = {name: each for name in list(options) if (each := _files(name, options[name]))}
    stated = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in options.items()
        if name not in files
    }
    if "field" in files:  # what they are called, and what their components mean
        stated["field"] = [f"{each.name}:{each.kind}" for each in parse_fields(options["field"])]
    whole: Json = {
        "options": {**stated, "format": job.output.suffix.lower()},
        "files": {
            name: [[path.name, checksum(path)] for path in paths] for name, paths in files.items()
        },
        "tetopt": tetopt.__version__,
    }
    return whole | {
        "sha256": hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
    }


def _files(name: str, value: Any) -> list[Path]:
    """Return the files among an option's values."""
    if name.replace("-", "_") in FILES_IN_TEXTS:
        return [] if (file := named_file(value)) is None else [file]
    if name == "field":
        return [each.path for each in parse_fields(value)]
    if name == "tissues":
        return tissue_files(value)
    return [
        each
        for each in (value if isinstance(value, list) else [value])
        if isinstance(each, Path) and not is_preset_table(each)
    ]


def checksum(path: Path) -> str:
    """SHA-256 of an option's file or folder, as hexadecimal digits; computed again only after a
    change.
    """
    file, _ = file_and_volume(path)
    return _kept_checksum(file, status_checksum(file))


@cache  # a thousand subjects may share an atlas's mask
def _kept_checksum(path: Path, _state: str) -> str:
    return sha256(path)
