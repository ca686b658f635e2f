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
from tetopt.model.fields import check_field_name, check_other_names


class FieldText(NamedTuple):
    """The parts of such a text."""

    name: str
    path: Path  # FILE:K for a volume of a scalar's file
    kind: str  # KIND[@FRAME]


def parse_fields(texts: Iterable[str] | None) -> list[FieldText]:
    """Parse the texts of fields.

    Raises
    ------
    InputError
        One without a name or a file; a name that formulas or other data of cells have, or two; an
        unknown kind or frame.
    """
    parsed: dict[str, FieldText] = {}
    for text in texts or ():
        match = re.fullmatch(r"([^=]+)=(.+?)(?::([a-z]+(?:@[a-z-]*)?))?", text)
        if match is None:
            raise InputError(
                "`fields`: expected NAME=FILE, NAME=FILE:KIND or NAME=FILE:KIND@FRAME, such as "
                f'V1=dti_V1.nii.gz:direction@fsl, got "{text[:80]}"'
            )
        name, kind = match[1].strip(), match[3] or "scalar"
        with prefix_errors("`fields`"):
            check_field_name(name)
            parse_kind(kind)
            if name in parsed:
                raise InputError(f'two are called "{name}"')
        parsed[name] = FieldText(name, Path(match[2]), kind)
    with prefix_errors("`fields`"):
        check_other_names({name: each.kind.partition("@")[0] for name, each in parsed.items()})
    return list(parsed.values())


def scalar_names(texts: Iterable[str] | None) -> list[str]:
    """Return the names of the scalar fields, which formulas may use."""
    return [each.name for each in parse_fields(texts) if each.kind == "scalar"]


def read_fields(texts: Iterable[str] | None) -> dict[str, Image | Field]:
    """Read the fields by name; InputError for the reasons of `parse_fields` and `load_field`."""
    return {
        name: read_companion(path) if kind == "scalar" else load_field(path, kind)
        for name, path, kind in parse_fields(texts)
    }
