"""Places of a cohort's files: whose folder it is, and what a crash leaves."""

import json
import os

import pytest

from tetopt.cohort.layout import begin, check_out, clean, mesh_name, publish, subject_folder
from tetopt.errors import InputError


@pytest.fixture
def out(tmp_path):
    begin(tmp_path / "out", ["/bids"])
    return tmp_path / "out"


def work_of(out, key, text, *endings):
    """Unfinished outputs of a subject: a file of this text, and others of its mesh's name."""
    folder = out / ".work" / f"{key}.run-1"
    folder.mkdir(exist_ok=True)
    (folder / "a.txt").write_text(text)
    for ending in endings:
        (folder / mesh_name(key, ending)).touch()
    return folder


def test_a_folder_is_new_empty_or_a_cohorts(out, tmp_path):
    check_out(out)
    check_out(tmp_path / "new")
    (tmp_path / "empty").mkdir()
    check_out(tmp_path / "empty")
    assert json.loads((out / "dataset_description.json").read_text())["DatasetType"] == "derivative"


@pytest.mark.parametrize(
    "text",
    ["{}", "[]", "not JSON", '{"GeneratedBy": [{"Name": "fMRIPrep"}]}', '{"GeneratedBy": 3}'],
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
    """A crash before its numbers are there leaves a subject without any, which is run again."""
    key = "sub-1_ses-a"
    place, numbers = subject_folder(out, key), mesh_name(key, ".json")
    for text in ("first", "second"):
        work = work_of(out, key, text, ".json")
        (work / "figures").mkdir(exist_ok=True)
        (work / "figures" / f"{text}.png").touch()
        publish(work, out, key)
        names = ["a.txt", "figures", f"figures/{text}.png", numbers]
        assert sorted(str(each.relative_to(place)) for each in place.rglob("*")) == names
        assert (place / "a.txt").read_text() == text


def test_numbers_come_last(out, monkeypatch):
    publish(work_of(out, "sub-1", "first", ".json"), out, "sub-1")
    work = work_of(out, "sub-1", "second", ".json", "_z.txt")
    moved = []
    monkeypatch.setattr(os, "replace", lambda old, _: moved.append(old.name))
    publish(work, out, "sub-1")
    assert moved[-1] == mesh_name("sub-1", ".json")
    assert len(moved) == 3
    assert os.listdir(subject_folder(out, "sub-1")) == ["a.txt"]


def test_what_ended_runs_have_left_is_removed(out):
    """Of the named subjects alone; of a scheduler's workers that still run them, which then give
    up.
    """
    work_of(out, "sub-1", "mine")
    other = work_of(out, "sub-2", "another run's")
    (out / ".work" / "sub-1.lock").touch()
    clean(out, ["sub-1"])
    assert set(os.listdir(out / ".work")) == {"sub-1.lock", other.name, "tetopt-lock"}
    clean(out, None)
    assert not other.exists()


def test_what_a_user_has_put_beside_a_mesh_stays(out):
    publish(work_of(out, "sub-1", "first"), out, "sub-1")
    place = subject_folder(out, "sub-1")
    (place / "sub-1_desc-tetopt_mesh.inp").write_text("of another format")
    (place / "results").mkdir()
    (place / "results" / "stress.frd").write_text("mine")
    work = work_of(out, "sub-1", "second", ".vtu")
    publish(work, out, "sub-1")
    assert set(os.listdir(place)) == {"a.txt", "results", "sub-1_desc-tetopt_mesh.vtu"}
    assert (place / "results" / "stress.frd").read_text() == "mine"
