"""Failures of a peer: a crash, or a missing installation."""

from __future__ import annotations

import importlib
from typing import Any

from tetopt.errors import InputError
from tetopt.system.extras import install_hint

AFTER_CRASHES = "try another number of classes or nodes, or your own labels"


class Crashed(InputError):
    """A signal ended a program of a pipeline; another run may succeed."""


def import_peer(package: str) -> Any:
    """Return the module of a peer; raise InputError if it is not installed or cannot be
    imported.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        hint = f"install it with: {install_hint(package)}"
        is_absent = isinstance(error, ModuleNotFoundError) and error.name == package
        words = "not installed" if is_absent else f"cannot be imported ({error})"
        raise InputError(f"{package}: {words}; {hint}") from error
