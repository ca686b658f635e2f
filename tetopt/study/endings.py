"""Failures of a peer: a crash, or a missing installation."""

from __future__ import annotations

from tetopt.errors import InputError

AFTER_CRASHES = "try another number of classes or nodes, or your own labels"


class NotInstalled(InputError):
    """A peer is not installed on this machine, and was never run."""


class Crashed(InputError):
    """A signal ended a program of a pipeline; another run may succeed."""
