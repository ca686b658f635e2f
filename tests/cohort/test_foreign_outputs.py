"""Links and files of the user's in a cohort's folder: refused in a line with nothing touched, or
of no harm.
"""

import json
import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from attacks import KINDS, content, outside, planted
from cohorts import run_of, save_run, thumbnail
from commands import assert_refused, exit_code, numbers_in

from tetopt.cohort import cohort_plan
from tetopt.cohort.cohort_page import save_cohort_files
from tetopt.cohort.layout import begin, clean, log_path, numbers_path, publish, thumbnail_path
from tetopt.cohort.numbers import collect
from tetopt.errors import InputError

pytestmark = pytest.mark.deep
KEY = "sub-01"


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "a.nii.gz"
    assert exit_code("phantom", "sphere", "-o", path, "--voxel-mm", "8") == 0
    return path


@pytest.fixture
def out(tmp_path, image):
    """A cohort of one subject, meshed with other options, and its table beside."""
    (tmp_path / "t.tsv").write_text(f"subject\timage\n01\t{image}\n")
    out = tmp_path / "out"
    begin(out)
    run = run_of(np.random.default_rng(1))
    run["request"]["files"] = {}
    save_run(out, KEY, run, thumbnail(1))
    log_path(out, KEY).write_text("all went well")
    save_cohort_files(out, collect(out))
    return out


def words(out, *options):
    return ["cohort", out.parent / "t.tsv", "-o", out, *options]


@contextmanager
def unchanged(folder):
    before = content(folder)
    yield
    assert content(folder) == before


def said_of(capfd):
    """The line of each fault, where nothing else was said."""
    captured = capfd.readouterr()
    assert captured.out == ""
    return [line for line in captured.err.splitlines() if line.startswith("tetopt: ")]


ATTACKS = [
    *((".work", kind) for kind in KINDS),
    *(("logs", kind) for kind in ("folder link", "hanging link")),
    ("logs/sub-01.log", "file link"),
    ("logs/sub-01.failed.json", "device link"),
    ("logs/other.log", "file link"),
    *((f"cohort.{each}", "hanging link") for each in ("tsv", "json", "html")),
]


@pytest.mark.parametrize(("name", "kind"), ATTACKS)
def test_what_is_not_tetopts_is_one_line_and_stays(out, capfd, name, kind):
    planted(kind, out / name, outside(out.parent))
    for options in (["--collect"], []):
        with unchanged(out.parent):
            assert exit_code(*words(out, *options)) == 2
        (line,) = said_of(capfd)
        assert line.startswith(f"tetopt: {out / name}: "), line


def test_a_description_that_is_a_link_is_not_taken_for_a_cohorts(out, capfd):
    elsewhere = outside(out.parent)
    shutil.move(out / "dataset_description.json", elsewhere / "notes.txt")
    planted("file link", out / "dataset_description.json", elsewhere)
    with unchanged(out.parent):
        said = "dataset_description.json: expected no link"
        assert_refused(capfd, words(out, "--collect"), said)


def moved(out, place):
    """A folder of results, moved to another disk, and a link in its place."""
    elsewhere = outside(out.parent)
    (place / "results.frd").write_text("of a solver")
    shutil.move(place, elsewhere / "disk")
    place.symlink_to(elsewhere / "disk")
    return elsewhere


@pytest.mark.parametrize("name", [KEY, f"{KEY}/figures"])
def test_a_subjects_folder_that_is_a_link_is_read_and_not_replaced(out, capfd, monkeypatch, name):
    expected = f"{out / name}: expected the subject's folder, got a link to"
    with unchanged(moved(out, out / name)):
        assert exit_code(*words(out, "--collect")) == 0
        request = numbers_in(numbers_path(out, KEY))["request"]
        with monkeypatch.context() as patch:  # what is asked for is what is there
            patch.setattr(cohort_plan, "job_request", lambda *_: request)
            assert exit_code(*words(out)) == 0
        assert "1 subject: 1 done; 0 to run" in capfd.readouterr().err
        with unchanged(out.parent):
            assert exit_code(*words(out)) == 2
            assert f"tetopt: {expected}" in capfd.readouterr().err
        with pytest.raises(InputError, match=f"^{expected}"):
            publish(out / ".work" / "sub-01.run-1", out, KEY)


def test_sessions_of_a_subject_that_is_a_link_are_not_replaced(out, image, capfd):
    place = out / "sub-02"
    (place / "ses-a").mkdir(parents=True)
    shutil.move(place, outside(out.parent) / "disk")
    place.symlink_to(out.parent / "outside" / "disk")
    (out.parent / "t.tsv").write_text(f"subject\tsession\timage\n02\ta\t{image}\n02\tb\t{image}\n")
    with unchanged(out.parent):
        assert exit_code(*words(out)) == 2
    (line,) = said_of(capfd)
    assert line.startswith(f"tetopt: {place}: expected the subject's folder, got a link to")


def test_links_that_a_user_has_put_beside_a_mesh_stay_links(out):
    elsewhere = outside(out.parent)
    (out / KEY / "results").symlink_to(elsewhere)
    work = out / ".work" / "sub-01.run-1"
    work.mkdir()
    (work / "a.txt").write_text("new")
    with unchanged(elsewhere):
        publish(work, out, KEY)
    assert (out / KEY / "results").readlink() == elsewhere


def test_foreign_files_in_the_work_directory_stay(out):
    elsewhere = outside(out.parent)
    mine = {"thesis.txt": b"mine", "sub-01.run-3": str(elsewhere), "tetopt-lock": b""}
    (out / ".work" / "thesis.txt").write_text("mine")
    (out / ".work" / "sub-01.run-1").mkdir()
    (out / ".work" / "sub-01.run-1" / "link").symlink_to(elsewhere)
    (out / ".work" / "sub-01.run-3").symlink_to(elsewhere)
    with unchanged(elsewhere):
        clean(out, None)
    assert content(out / ".work") == mine


def test_outputs_that_are_links_are_read_and_replaced(out):
    """As those of a folder under version control."""
    elsewhere, paths = outside(out.parent), (numbers_path(out, KEY), thumbnail_path(out, KEY))
    for number, path in enumerate(paths):
        shutil.move(path, elsewhere / str(number))
        path.symlink_to(elsewhere / str(number))
    with unchanged(elsewhere):
        assert exit_code(*words(out, "--collect")) == 0
        page = (out / "cohort.html").read_text()
        assert len(json.loads(page.partition('"pictures":')[2].partition("}")[0] + "}")) == 1
        work = out / ".work" / "sub-01.run-1"
        (work / "figures").mkdir(parents=True)
        for path in paths:
            (work / path.relative_to(out / KEY)).write_text("new")
        publish(work, out, KEY)
        assert [path.read_text() for path in paths] == ["new", "new"]
        assert not paths[0].is_symlink()


def test_a_description_that_is_no_file_is_not_read(out, capfd):
    planted("pipe", out / "dataset_description.json", outside(out.parent))
    assert_refused(capfd, words(out, "--collect"), "is not a cohort folder")
