"""What there is of a subject, by its files alone: each status, why, and what a rerun makes of
it.
"""

import json

import pytest
from cohorts import save_failure, save_run

from tetopt.cohort.layout import begin, mesh_name, numbers_path, subject_folder
from tetopt.cohort.subject_states import SubjectState, differences, state_of

KEY = "sub-1"


def request(**changes):
    whole = {
        "options": {"nodes": 60, "format": ".vtu"},
        "files": {"images": [["a.nii", "0"]]},
        "tetopt": "0.1.0",
    }
    return {**whole, **changes, "sha256": json.dumps({**whole, **changes})}


@pytest.fixture
def out(tmp_path):
    begin(tmp_path / "out")
    return tmp_path / "out"


def saved(out, key=KEY, suffix=".vtu", violated=None, **changes):
    save_run(out, key, {"request": request(**changes), "violated": violated or {}}, suffix=suffix)


def status(out, now=None, key=KEY):
    return state_of(out, key, now if now is not None else request())


def test_each_status_has_its_reason(out):
    assert status(out) == SubjectState("missing", "not run yet")
    saved(out)
    assert status(out) == SubjectState("done", "")
    other = request(options={"nodes": 70, "format": ".vtu"})
    assert status(out, other) == SubjectState("changed", "nodes was 60, now 70")
    assert state_of(out, KEY) == SubjectState("done", "")
    saved(out, violated={"min_dihedral": "too flat", "mask": "too coarse"})
    assert status(out) == SubjectState("violated", "too flat; too coarse")


def test_a_failure_counts_until_there_is_what_is_asked_for(out):
    save_failure(out, KEY, "cut short")
    assert status(out) == SubjectState("failed", "cut short")
    saved(out, tetopt="0.0.9")
    assert status(out) == SubjectState("failed", "cut short")
    saved(out)
    assert status(out) == SubjectState("done", "")


@pytest.mark.parametrize(
    "harm",
    [
        lambda mesh, numbers: mesh.unlink(),
        lambda mesh, numbers: numbers.unlink(),
        lambda mesh, numbers: numbers.write_text('{"request": '),
        lambda mesh, numbers: numbers.write_text("[]"),
        lambda mesh, numbers: numbers.write_bytes(b""),
        lambda mesh, numbers: mesh.write_bytes(b""),
        lambda mesh, numbers: numbers.write_text('{"request": 3}'),
        lambda mesh, numbers: numbers.write_text('{"request": {"format": 3}, "violated": 4}'),
    ],
)
def test_what_is_damaged_is_made_again(out, harm):
    saved(out)
    harm(subject_folder(out, KEY) / mesh_name(KEY, ".vtu"), numbers_path(out, KEY))
    assert status(out).status in ("missing", "failed", "changed")


def test_a_mesh_of_another_format_is_a_change(out):
    saved(out, suffix=".inp", options={"nodes": 60, "format": ".inp"})
    assert status(out) == SubjectState("changed", "format was .inp, now .vtu")


def test_differences_are_said_and_the_line_is_short():
    before = request()
    assert differences(before, request(files={"images": [["a.nii", "1"]]})) == "another image"
    assert (
        differences(before, request(files={**before["files"], "mask": [["m", "1"]]}))
        == "another mask"
    )
    assert differences(before, request(tetopt="0.2.0")) == "tetopt was 0.1.0, now 0.2.0"
    many = request(options={"nodes": 60, "format": ".vtu"} | {f"o{k}": k for k in range(6)})
    assert differences(before, many) == (
        "o0 was none, now 0; o1 was none, now 1; o2 was none, now 2; o3 was none, now 3 and 2 more"
    )
