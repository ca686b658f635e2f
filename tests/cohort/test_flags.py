"""What is flagged, and how seldom what is not odd."""

import re

import numpy as np
import pytest
from cohorts import run_of, save_cohort

from tetopt.cohort.flags import FEW_SUBJECTS, comparisons_left_out, deviations, flags_of, limit
from tetopt.cohort.numbers import Row, collect, with_numbers

OBLIQUE = np.diag([1.0, 1.0, 1.2, 1.0])
OBLIQUE[:3, :3] = [[0.9, -0.436, 0.0], [0.436, 0.9, 0.0], [0.0, 0.0, 1.2]]


def row_of(k, run):
    row = Row(f"sub-{k}", "done", "", (), {}, {}, {}, {}, {})
    return with_numbers(row, run | {"label_names": {"17": "hippocampus"}})


def rows_of(changes):
    """Rows of usual runs, each with its changes."""
    rng = np.random.default_rng(4)
    return [row_of(k, run_of(rng, **each)) for k, each in enumerate(changes)]


def rows_of_signs(*signs):
    """Rows of usual runs, of this orientation each."""
    return rows_of({"affine": np.diag([sign, sign, 1.2, 1.0])} for sign in signs)


def flagged(odd, n=20, **changes):
    """Columns and words of the flags of one odd subject among usual ones, which have none."""
    *rows, last = rows_of([{}] * (n - 1) + [odd])
    flags = flags_of([*rows, last._replace(**changes)])
    assert [each for each in flags[:-1] if each] == []
    assert all(flag.words.isprintable() for flag in flags[-1])
    return [(flag.column, flag.words) for flag in flags[-1]]


def test_each_kind_of_odd_subject():
    """With the reason in words."""
    lost = ("label", "lost label 17 (hippocampus): it has 3992 voxels but no cell")
    for odd, violated, flags in (
        ({}, (), []),
        (
            {"affine": np.diag([-1.0, -1.0, 1.2, 1.0])},
            (),
            [("grid.orientation", "orientation LPS: 19 of 20 have RAS")],
        ),
        ({"lost": 17}, (), [lost]),
        ({"lost": 17}, ("labels",), [("violated", "violated labels"), lost]),
        ({"absent": 53}, (), [("label", "no label 53 in its image: 19 of 20 have it")]),
        ({}, ("min_dihedral",), [("violated", "violated min_dihedral")]),
        (
            {"affine": OBLIQUE},
            (),
            [
                (
                    "grid.oblique_degrees",
                    "obliqueness is 25.8 degrees, far above the others' median 0 degrees (13 "
                    "robust deviations)",
                )
            ],
        ),
    ):
        assert flagged(odd, violated=violated) == flags


def test_a_small_mask_is_told_with_the_median():
    """In one unit, if that is short."""
    beside = r", far below the others' median 1.\d\d l \(\d+ robust deviations\)"
    for volume, words in ((0.4e6, "0.4 l"), (3.05e3, "3.05 ml")):
        flag = dict(flagged({"mask_volume": volume}))["mask.volume"]
        assert re.fullmatch(f"volume of the mask is {words}{beside}", flag)


def test_the_median_is_that_of_the_others():
    values = np.r_[np.full(4, 1.0), np.full(4, 1.02), 9.0]
    [flag] = flags_of_volumes(1e6 * values)[-1]
    assert "the others' median 1.01 l" in flag.words


def test_a_label_that_few_have():
    (row,) = rows_of([{}])
    flags = flagged({}, volumes={**row.volumes, 99: 5.0})
    assert flags == [("label", "label 99 in its image: 1 of 20 have it")]


def test_no_majority_no_odd_one():
    rows = rows_of_signs(1.0, 1.0, 1.0, -1.0, -1.0)
    assert flags_of(rows) == [[]] * 5  # three of five
    assert [bool(each) for each in flags_of(rows[1:4])] == [False, False, True]  # two of three
    assert flags_of(rows[2:4]) == [[], []]  # one of two


def test_a_mixed_cohort_says_that_it_is_not_judged():
    """By what has no majority alone; and of few subjects, that they are few."""
    rows = rows_of_signs(*[1.0] * 5, *[-1.0] * 4)
    [words] = comparisons_left_out(rows)
    assert re.match("The 9 3-D meshes are too mixed to judge by orientation: ", words)
    assert comparisons_left_out([rows[0], *rows[:4], *rows[:4]]) == []
    few, mixed = comparisons_left_out([rows[0], rows[-1]])
    assert few.startswith("2 3-D meshes are too ")
    assert mixed.startswith("The 2 3-D meshes are ")


def test_few_subjects_have_no_medians():
    assert flagged({"mask_volume": 1.0}, n=FEW_SUBJECTS - 1) == []
    assert flagged({"mask_volume": 1.0}, n=FEW_SUBJECTS) != []


def test_what_failed_says_nothing_of_others():
    assert flagged({"mask_volume": 1.0}, status="failed") == []


def test_planes_and_volumes_are_not_compared():
    rows = rows_of([{}] * 40)
    for row in rows[20:]:
        row.numbers["quality.ndim"] = 2
        row.numbers["mask.volume"] /= 1e3
    rows[30].numbers["mask.volume"] *= 1e3
    flags = flags_of(rows)
    assert [k for k, each in enumerate(flags) if each] == [30]
    assert "cm^2" in flags[30][0].words


def test_deviations_are_scaled_by_the_median_absolute_deviation():
    values = np.random.default_rng(0).normal(3.0, 2.0, 100_000)
    scaled = deviations(values, False, 1e-9)
    np.testing.assert_allclose(scaled, (values - 3.0) / 2.0, rtol=0.02, atol=0.02)
    np.testing.assert_allclose(deviations(np.exp(values), True, 1e-9), scaled, atol=1e-9)


def test_numbers_that_are_the_same_are_measured_by_the_least_scale():
    values = np.r_[np.ones(9), 1.2]
    assert deviations(values, False, 0.1)[-1] == pytest.approx(2.0)
    assert deviations(np.r_[np.ones(9), 0.0], True, 0.05)[-1] == -np.inf
    [flag] = flags_of_volumes(np.r_[np.ones(9), 0.0])[-1]
    assert flag.words == "volume of the mask is 0 mm^3, far below the others' median 1 mm^3"
    assert flags_of_volumes(np.zeros(10)) == [[]] * 10
    with np.errstate(all="raise"):
        assert flags_of_volumes(np.r_[np.zeros(6), np.ones(4)]) == [[]] * 10


def flags_of_volumes(values):
    """Of subjects of which nothing is known but the volumes of their masks."""
    row = Row("sub-1", "done", "", (), {}, {}, {}, {}, {})
    return flags_of(
        [row._replace(numbers={"quality.ndim": 3, "mask.volume": float(v)}) for v in values]
    )


@pytest.mark.parametrize("n", [8, 20, 500])
def test_usual_numbers_are_seldom_flagged(n):
    """At most 1 normal one of 1000, of Student's t with 5 degrees of freedom 5 of 1000."""
    rng = np.random.default_rng(n)
    columns = 50_000 // n
    for numbers, most in (
        (rng.normal(size=(columns, n)), 1e-3),
        (rng.standard_t(5, size=(columns, n)), 5e-3),
    ):
        far = [np.abs(deviations(row, False, 1e-9)) > limit(n) for row in numbers]
        assert np.mean(far) <= most


def test_what_was_put_in_is_flagged_and_little_else(tmp_path):
    rows = collect(tmp_path, save_cohort(tmp_path, 100))
    odd = {row.key for row, flags in zip(rows, flags_of(rows), strict=True) if flags}
    assert {"sub-0008", "sub-0020", "sub-0032", "sub-0044", "sub-0060"} <= odd
    assert len(odd) <= 7
