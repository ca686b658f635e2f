"""Places of a cohort's files: whose folder it is, who may write, and what a crash leaves."""

import json
import subprocess
import sys

import pytest

from tetopt.cohort.layout import begin, check_out, locked, publish, restore, subject_folder
from tetopt.errors import InputError


@pytest.fixture
def out(tmp_path):
    begin(tmp_path / "out", ["/bids"])
    return tmp_path / "out"


def work_of(out, key, text):
    folder = out / ".work" / f"{key}.run-1.7"
    folder.mkdir()
    (folder / "a.txt").write_text(text)
    return folder


def test_a_folder_is_new_empty_or_a_cohorts(out, tmp_path):
    check_out(out)
    check_out(tmp_path / "new")
    (tmp_path / "empty").mkdir()
    check_out(tmp_path / "empty")
    assert json.loads((out / "dataset_description.json").read_text())["DatasetType"] == "derivative"


@pytest.mark.parametrize(
    "text", ["{}", "[]", "not JSON", '{"GeneratedBy": [{"Name": "fMRIPrep"}]}', '{"GeneratedBy": 3}']
)
def test_a_folder_of_something_else_is_refused(tmp_path, text):
    (tmp_path / "dataset_description.json").write_text(text)
    with pytest.raises(InputError, match="not a cohort folder"):
        check_out(tmp_path)


def test_a_file_and_no_folder_are_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="got a file"):
        check_out(tmp_path / "file")
    with pytest.raises(InputError, match="does not exist"):
        check_out(tmp_path / "no" / "out")


def test_what_is_published_takes_the_place_of_what_was_there(out):
    for text in ("first", "second"):
        publish(work_of(out, "sub-1_ses-a", text), out, "sub-1_ses-a")
        assert (out / "sub-1" / "ses-a" / "a.txt").read_text() == text
    assert not [each for each in (out / ".work").iterdir() if each.is_dir()]


def test_a_crash_between_renamings_loses_nothing(out):
    publish(work_of(out, "sub-1", "first"), out, "sub-1")
    subject_folder(out, "sub-1").rename(out / ".work" / "sub-1.before")
    work_of(out, "sub-1", "never finished")
    restore(out)
    assert (out / "sub-1" / "a.txt").read_text() == "first"
    assert not [each for each in (out / ".work").iterdir() if each.is_dir()]


def test_only_what_is_named_is_restored(out):
    work_of(out, "sub-1", "mine")
    other = work_of(out, "sub-2", "another run's")
    restore(out, ["sub-1"])
    assert [each for each in (out / ".work").iterdir() if each.is_dir()] == [other]


def locks(out, keys):
    """Whether another process gets the lock."""
    code = "import sys; from pathlib import Path; from tetopt.cohort.layout import locked\n"
    code += "with locked(Path(sys.argv[1]), eval(sys.argv[2])): pass"
    done = subprocess.run([sys.executable, "-c", code, str(out), repr(keys)], capture_output=True, text=True)
    assert done.returncode == 0 or "another run is writing there (process" in done.stderr, done.stderr
    return done.returncode == 0


def test_two_runs_do_not_write_to_one_folder(out):
    with locked(out):
        assert not locks(out, None)
        assert not locks(out, ["sub-1"])
    assert locks(out, None)


def test_runs_of_other_subjects_go_side_by_side(out):
    with locked(out, ["sub-1", "sub-2"]):
        assert locks(out, ["sub-3"])
        assert not locks(out, ["sub-2"])


def test_what_a_killed_run_went_on_by_is_taken_away(out):
    """Workers of a cluster that still run its subjects then give up, and the next run has the folder for itself."""
    for name in ("run-1", "lock", "sub-1.lock"):
        (out / ".work" / name).touch()
    restore(out, ["sub-1"])
    assert len(list((out / ".work").iterdir())) == 4
    restore(out)
    assert sorted(each.name for each in (out / ".work").iterdir()) == ["lock", "sub-1.lock", "tetopt-manifest"]


def test_what_a_user_has_put_beside_a_mesh_stays(out):
    publish(work_of(out, "sub-1", "first"), out, "sub-1")
    place = subject_folder(out, "sub-1")
    (place / "sub-1_desc-tetopt_mesh.inp").write_text("of another format")
    (place / "results").mkdir()
    (place / "results" / "stress.frd").write_text("mine")
    work = work_of(out, "sub-1", "second")
    (work / "a.txt").rename(work / "sub-1_desc-tetopt_mesh.vtu")
    publish(work, out, "sub-1")
    assert sorted(each.name for each in place.iterdir()) == ["a.txt", "results", "sub-1_desc-tetopt_mesh.vtu"]
    assert (place / "results" / "stress.frd").read_text() == "mine"


@pytest.mark.parametrize("is_published_again", [False, True])
def test_what_a_user_has_put_beside_a_mesh_outlives_a_crash(out, is_published_again):
    """It may come when the new mesh is in its place and the user's files are not yet."""
    publish(work_of(out, "sub-1", "new"), out, "sub-1")
    aside = work_of(out, "sub-1", "old").rename(out / ".work" / "sub-1.before")
    (aside / "note.txt").write_text("mine")
    if is_published_again:
        publish(work_of(out, "sub-1", "newer"), out, "sub-1")
    restore(out)
    place = subject_folder(out, "sub-1")
    assert (place / "note.txt").read_text() == "mine"
    assert (place / "a.txt").read_text() == ("newer" if is_published_again else "new")
    assert not aside.exists()
