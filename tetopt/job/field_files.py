"""The fields that options name: NAME=FILE[:KIND[@FRAME]]."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError, prefix_errors
from tetopt.fields.field import Field, parse_kind
from tetopt.image import Image
from tetopt.io.components import load_field
from tetopt.job.aligned import read_companion
from tetopt.model.fields import check_field_name
from tetopt.model.formula import check_field_names


class FieldText(NamedTuple):
    """The parts of such a text."""

    name: str
    path: Path  # FILE:K for a volume of a scalar's file
    kind: str  # KIND[@FRAME]


def parse_field(text: str) -> FieldText:
    """Parse the text of a field.

    Raises
    ------
    InputError
        Without a name or a file; a name that formulas or other data of cells have; an unknown kind
        or frame.
    """
    match = re.fullmatch(r"([^=]+)=(.+?)(?::([a-z]+(?:@[a-z-]*)?))?", text)
    if match is None:
        raise InputError(
            "`fields`: expected NAME=FILE, NAME=FILE:KIND or NAME=FILE:KIND@FRAME, such as "
            f'V1=dti_V1.nii.gz:direction@fsl, got "{text[:80]}"'
        )
    name, file, kind = match[1].strip(), match[2], match[3] or "scalar"
    with prefix_errors("`fields`"):
        check_field_names([name])
        check_field_name(name)
        parse_kind(kind)
    return FieldText(name, Path(file), kind)


def parse_fields(texts: Iterable[str] | None) -> list[FieldText]:
    """Parse the texts of fields; raise InputError for the reasons of `parse_field`, and for a name
    that two have.
    """
    parsed = [parse_field(text) for text in texts or ()]
    names = [each.name for each in parsed]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f'`fields`: two are called "{twice[0]}"')
    return parsed


def scalar_names(texts: Iterable[str] | None) -> list[str]:
    """Return the names of the scalar fields, which formulas may use."""
    return [each.name for each in parse_fields(texts) if each.kind == "scalar"]


def read_fields(texts: Iterable[str] | None) -> dict[str, Image | Field]:
    """Read the fields by name; InputError for the reasons of `parse_fields` and `load_field`."""
    return {
        name: read_companion(path) if kind == "scalar" else load_field(path, kind)
        for name, path, kind in parse_fields(texts)
    }
