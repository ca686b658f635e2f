"""Outputs that appear whole or not at all, and never over something else by accident."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tetopt.errors import InputError


def checked_output(path: str | Path, suffixes: tuple[str, ...], force: bool = False) -> Path:
    """`path` if a file may be written there, asked before the work starts.

    Raises
    ------
    InputError
        A suffix not among `suffixes` (of any case), a missing or read-only folder, a folder in the file's place,
        or an existing file without `force`.
    """
    path = Path(path)
    if not path.name.lower().endswith(suffixes):
        raise InputError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")
    if path.is_dir():
        raise InputError(f"{path}: expected a file to write, found a folder")
    if not path.parent.is_dir():
        raise InputError(f"{path}: its folder does not exist; make it first")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: its folder cannot be written to")
    if os.path.lexists(path) and not force:
        raise InputError(f"{path}: exists already; pass --force (force=True) to replace it")
    return path


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, with its suffix, that takes its place when the block ends without error.

    Left behind by an error or an interruption is nothing but what was there before.
    """
    suffix = "".join(path.suffixes[-2:])[-20:]  # short, as the name of `path` may be as long as names can be
    handle, name = tempfile.mkstemp(prefix=f".{path.name[:40]}.", suffix=suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)  # mkstemp's 0600 would keep colleagues out
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def save_json(path: Path, value: Any) -> None:
    """Write `value` as JSON, whole or not at all; numpy numbers and arrays, NamedTuples and paths are taken."""
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(_plain(value), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """`value` in JSON's own types; what is not finite becomes null, which JSON has no number for."""
    if hasattr(value, "_asdict"):
        return {key: _plain(item) for key, item in value._asdict().items()}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value
