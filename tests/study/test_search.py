"""The search for a number of nodes: secants of log nodes over log factor, brackets, runs without
a mesh.
"""

import pytest

from tetopt.study.search import REQUEST_RESPONSE, is_near, tries
from tetopt.study.tetwild import TETWILD_RESPONSE


@pytest.mark.parametrize(
    ("response", "power", "first"),
    [
        (TETWILD_RESPONSE, -3.0, 4000),
        (TETWILD_RESPONSE, -6.0, 300),
        (TETWILD_RESPONSE, -9.0, 700),
        (REQUEST_RESPONSE, 1.0, 130),
        (REQUEST_RESPONSE, 0.7, 4000),
        (REQUEST_RESPONSE, 2.0, 900),
    ],
)
def test_power_mappings(response, power, first):
    """On a power law the second step is exact; the requested 1000 are reached in a few steps,
    the nearest run first.
    """
    factors = []

    def run(factor):
        factors.append(factor)
        return round(first * factor**power)

    done = tries(run, lambda made: made, 1000, response, most=6)
    assert is_near(done[0].n_nodes, 1000)
    assert done[0].result == done[0].n_nodes
    assert len(done) == len(factors) <= 5
    assert sorted(each.factor for each in done) == sorted(factors)


def test_a_run_without_a_mesh_counts():
    """The next is beside it; all failing is an empty list."""
    factors = []

    def run(factor):
        factors.append(factor)
        return None if len(factors) < 3 else 980

    (only,) = tries(run, lambda made: made, 1000, TETWILD_RESPONSE, first=2.0, most=6)
    assert factors == pytest.approx([2.0, 2.0 * 0.83, 2.0 * 0.83**2])
    assert (only.factor, only.n_nodes) == (factors[-1], 980)
    assert tries(lambda factor: None, int, 1000, TETWILD_RESPONSE, most=3) == []


def test_a_number_that_no_factor_meets():
    """Steps: brackets are kept, the runs are used up, the nearest comes first."""
    done = tries(lambda factor: 400 if factor < 1.3 else 1300, int, 1000, REQUEST_RESPONSE, most=5)
    assert len(done) == 5
    assert [each.n_nodes for each in done] == sorted(
        (each.n_nodes for each in done), key=lambda n: abs(n - 1200)
    )
    assert done[0].n_nodes == 1300
