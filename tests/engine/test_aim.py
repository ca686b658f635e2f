"""The search for a mesh as a table: by an aim and the runs so far, the corners to request next and
the run that counts.
"""

import pytest

from tetopt.engine.aim import Aim, SearchRun, best_of, may_differ, needed_corners, next_corners

ERROR = Aim(target_error=0.02, nodes_max=50_000, mode="graded", most=10**6)
NODES = Aim(nodes=7200, order=2, mode="graded")


def runs_of(*rows, order=1):
    """Runs of (corners reached, error, or nodes for order 2), with the last one's end."""
    runs = [
        SearchRun(
            corners, corners, corners if order == 1 else number, float(order == 1) * number, "risen"
        )
        for corners, number in rows
    ]
    return runs


def cut(runs, ended="max_seconds"):
    return [*runs[:-1], runs[-1]._replace(ended=ended)]


# The error aimed at is .925 of the target: .0185.
HISTORIES = [
    # one run, without or with a number
    (Aim(nodes=300), [], 300),
    (Aim(spacing=4.0, order=2), [], 0),
    (Aim(nodes=300), runs_of((310, 0.5)), None),
    # order 2: 7.2 nodes a corner first, then as many as the last run had; 1 % is near enough
    (NODES, [], 1000),
    (NODES._replace(ndim=2), [], 1846),
    (NODES._replace(nodes=20), [], 16),
    (NODES, runs_of((1000, 8000), order=2), 900),
    (NODES, runs_of((1000, 7271), order=2), None),
    (NODES, runs_of((1000, 7273), order=2), 990),
    (NODES, cut(runs_of((1000, 8000), order=2)), None),
    (NODES, runs_of((1000, 8000), (900, 6600), order=2), 982),
    (NODES, runs_of((1000, 8000), (900, 6600), (982, 7500), order=2), None),
    # an error: few corners first, or as many as sizes require
    (ERROR, [], 1500),
    (ERROR._replace(ndim=2), [], 200),
    (ERROR._replace(fewest=2000), [], 2000),
    (ERROR._replace(nodes_max=900), [], 900),
    (ERROR._replace(nodes_max=7200, order=2), [], 1000),
    (ERROR._replace(nodes_max=900, fewest=901), [], None),
    # the rate of .6 after one run, then the image's own within .3 to 1
    (ERROR, runs_of((1500, 0.037)), 1500 * 2 ** (1 / 0.6)),
    (ERROR, runs_of((1500, 0.074), (6000, 0.037)), 24000),
    (ERROR, runs_of((1500, 0.074), (6000, 0.073)), 50_000),
    (ERROR, runs_of((1500, 0.074), (3000, 0.02775)), 4500),
    # between runs on either side of it
    (ERROR, runs_of((1000, 0.037), (4000, 0.00925)), 2000),
    (ERROR, runs_of((1500, 0.01)), 538),
    (ERROR, runs_of((1500, 0.0)), 32),
    (ERROR._replace(most=3000), runs_of((1500, 0.0369)), 3000),
    (ERROR._replace(fewest=600), runs_of((1500, 0.01)), 600),
    # the end: reached, at the most nodes, again the same, cut short, or six runs
    (ERROR, runs_of((1500, 0.017)), None),
    (ERROR, runs_of((1500, 0.02)), None),
    (ERROR, runs_of((1500, 0.0169)), 1290),
    (ERROR._replace(nodes_max=1510), runs_of((1500, 0.0369)), None),
    (ERROR._replace(nodes_max=1520), runs_of((1500, 0.0369)), 1520),
    (ERROR._replace(nodes_max=1510), runs_of((1500, 0.01)), 538),
    (ERROR, runs_of((1500, 0.03), (2000, 0.024), (1500, 0.03)), None),
    (ERROR._replace(fewest=1500), runs_of((1500, 0.01)), None),
    (ERROR, cut(runs_of((1500, 0.0369))), None),
    (ERROR, runs_of(*((1000 + n, 0.0369) for n in range(5))), 1004 * 1.9946 ** (1 / 0.3)),
    (ERROR, runs_of(*((1000 + n, 0.0369) for n in range(6))), None),
]


@pytest.mark.parametrize(("aim", "runs", "corners"), HISTORIES)
def test_next_corners(aim, runs, corners):
    assert next_corners(aim, runs) == (corners and pytest.approx(corners, abs=1))


def test_needed_corners_are_those_beyond_the_most():
    assert needed_corners(ERROR._replace(nodes_max=2000), runs_of((1500, 0.037))) == 4762


@pytest.mark.parametrize(
    ("aim", "runs", "best"),
    [
        (ERROR, runs_of((1500, 0.05)), 0),
        (ERROR, runs_of((1500, 0.05), (4000, 0.03)), 1),
        (ERROR, runs_of((1500, 0.05), (4000, 0.03), (5000, 0.04)), 1),
        (ERROR, runs_of((1500, 0.05), (9000, 0.01), (5000, 0.03)), 1),
        (ERROR, runs_of((9000, 0.01), (5000, 0.015)), 1),
        (ERROR, runs_of((5000, 0.015), (9000, 0.01)), 0),
        (ERROR, cut(runs_of((1500, 0.05), (4000, 0.03))), 1),
        (ERROR, cut(runs_of((4000, 0.03), (5000, 0.04))), 0),
        (ERROR, cut(runs_of((4000, 0.03), (9000, 0.01))), 1),
        (ERROR, cut(runs_of((9000, 0.01), (5000, 0.015))), 0),
        (NODES, runs_of((1000, 8000), (900, 6600), order=2), 1),
        (NODES, runs_of((900, 6600), (1000, 8000), order=2), 0),
        (NODES, cut(runs_of((1000, 8000), (900, 7200), order=2)), 0),
    ],
)
def test_the_run_that_counts(aim, runs, best):
    """That which meets an error with the fewest corners, or is nearest; one cut short only if it
    is nearer to an error that no run meets.
    """
    assert best_of(aim, runs) == best


@pytest.mark.parametrize(
    ("requested", "reached", "corners", "expected"),
    [
        (1000, 1000, 900, True),
        (1000, 890, 900, False),  # by less than 1 % of what was requested
        (1000, 892, 900, True),
        (900, 1011, 1000, False),
        (900, 950, 900, False),
    ],
)
def test_runs_that_may_differ(requested, reached, corners, expected):
    """From one initial mesh: where exchanges reached about the number that they were to reach."""
    run = SearchRun(requested, reached, reached, 0.0, "risen")
    assert may_differ(ERROR, run, corners) == expected
    assert not may_differ(ERROR._replace(mode="uniform"), run, corners)
