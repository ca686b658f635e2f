"""Failures of a peer: a crash, or a missing installation."""

from __future__ import annotations

import importlib
from typing import Any

from tetopt.errors import InputError
from tetopt.system.extras import install_hint

AFTER_CRASHES = "try another number of classes or nodes, or your own labels"


class NotInstalled(InputError):
    """A peer is not installed on this machine, and was never run."""


class Crashed(InputError):
    """A signal ended a program of a pipeline; another run may succeed."""


def imported(package: str) -> Any:
    """Return the module of a peer; raise NotInstalled without it, and InputError if it cannot be imported."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        hint = f"install it with: {install_hint('compare', package)}"
        if isinstance(error, ModuleNotFoundError) and error.name == package:
            raise NotInstalled(f"{package}: not installed; {hint}") from error
        raise InputError(f"{package}: cannot be imported ({error}); {hint}") from error
