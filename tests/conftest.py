"""Fixtures shared by all tests."""

import os
from pathlib import Path

import numba
import pytest
from hypothesis import settings

# The same examples in every run; few where the kernels run as plain Python.
settings.register_profile("tetopt", deadline=None, derandomize=True, max_examples=4 if numba.config.DISABLE_JIT else 30)
settings.load_profile("tetopt")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real volumes: TETOPT_DATA, else ../shared/data beside the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TETOPT_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real test volumes in {folder}; set TETOPT_DATA")
    return folder
