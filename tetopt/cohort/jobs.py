"""Jobs of a batch system as dask's workers, by dask-jobqueue."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from tetopt.cohort.crew import Folders, Need, Workers
from tetopt.errors import InputError


def submitted(stack: ExitStack, need: Need, folders: Folders, path: Path, count: int | None) -> Workers:
    """Workers that are jobs of a batch system."""
    raise InputError(f"--cluster: {path}: expected --scheduler or none of both; batch systems follow")
