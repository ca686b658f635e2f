"""One run in parts that the tests of this folder look at."""

import pytest
from parted import SKEW, balls, one_thread, recorded_run, request


@pytest.fixture(scope="session")
def image():
    return balls((40, 36, 30), SKEW)


@pytest.fixture(scope="session")
def run(image, tmp_path_factory):
    """A run of 1500 nodes in 4 parts, or 9, of four rounds: what came of it, and its parts by
    round.
    """
    with one_thread():
        return recorded_run(tmp_path_factory.mktemp("run"), image, request(1500, 4, iterations=12))
