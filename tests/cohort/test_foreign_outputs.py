"""Links, pipes and files of others in a cohort's folder: refused in a line with nothing touched, or of no harm."""

import json
import shutil

import numpy as np
import pytest
from attacks import content, outside, planted
from cohorts import run_of, save_run, thumbnail
from commands import assert_refused, exit_code

from tetopt.cohort import plan as cohort_plan
from tetopt.cohort.layout import begin, clean, log_path, numbers_path, publish, thumbnail_path
from tetopt.cohort.numbers import collect
from tetopt.cohort.page import save_cohort_files
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
    rng = np.random.default_rng(1)
    run = run_of(rng)
    run["request"]["files"] = {}
    save_run(out, KEY, run, thumbnail(rng))
    log_path(out, KEY).write_text("all went well")
    save_cohort_files(out, collect(out))
    (out / ".work" / "lock").touch()
    return out


def words(out, *options):
    return ["cohort", out.parent / "t.tsv", "-o", out, *options]


def pictures(out):
    """Those that the page has, by the places of their subjects."""
    page = (out / "cohort.html").read_text()
    return json.loads(page.partition('"pictures":')[2].partition("}")[0] + "}")


ATTACKS = [
    *((".work", kind) for kind in ("file link", "folder link", "pipe", "file")),
    *((".work/lock", kind) for kind in ("hard link", "file link", "pipe", "folder")),
    (".work/tetopt-manifest", "device link"), (".work/...run-1", "folder"), (".work/sub-01.lock", "file link"),
    (".work/sub-01.run-1", "folder link"), (".work/other", "folder link"), (".work/run-1", "pipe"),
    (".work/thesis.txt", "file"), (".work/thesis", "folder"),
    *(("logs", kind) for kind in ("folder link", "file")),
    *(("logs/sub-01.log", kind) for kind in ("file link", "pipe", "folder")),
    *(("logs/sub-01.failed.json", kind) for kind in ("file link", "device link", "pipe")),
    *(("logs/other.log", kind) for kind in ("file link", "pipe")),
    *((f"cohort.{each}", kind) for each in ("tsv", "json", "html") for kind in ("hanging link", "pipe")),
    *((f"{KEY}/{KEY}_desc-tetopt_mesh.json", kind) for kind in ("file link", "device link", "pipe")),
    *((f"{KEY}/figures/thumbnail.png", kind) for kind in ("file link", "device link", "pipe")),
    (f"{KEY}/figures", "folder link"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), ATTACKS)
def test_what_is_not_tetopts_is_one_line_and_stays(out, capfd, name, kind):
    planted(kind, out / name, outside(out.parent))
    before = content(out.parent)
    for options in (["--collect"], []):
        assert exit_code(*words(out, *options)) == 2
        captured = capfd.readouterr()
        (line,) = [each for each in captured.err.splitlines() if each.startswith("tetopt: ")]
        assert line.startswith(f"tetopt: {out / name}: "), line
        assert captured.out == ""
        assert content(out.parent) == before


def test_a_description_that_is_a_link_is_not_taken_for_a_cohorts(out, capfd):
    elsewhere = outside(out.parent)
    shutil.move(out / "dataset_description.json", elsewhere / "notes.txt")
    planted("file link", out / "dataset_description.json", elsewhere)
    before = content(out.parent)
    assert_refused(capfd, words(out, "--collect"), "dataset_description.json: expected a regular file, got a link")
    assert content(out.parent) == before


def test_a_folder_of_a_version_without_manifests_is_refused(out, capfd):
    (out / ".work" / "tetopt-manifest").unlink()
    before = content(out.parent)
    assert_refused(capfd, words(out, "--collect"), r"\.work: not a work directory of this version of tetopt")
    assert content(out.parent) == before
    shutil.rmtree(out / ".work")  # as the line advises
    assert exit_code(*words(out, "--collect")) == 0


def test_an_empty_work_directory_is_taken(out):
    shutil.rmtree(out / ".work")
    (out / ".work").mkdir()
    for _ in range(2):
        assert exit_code(*words(out, "--collect")) == 0


def moved(out, place):
    """A folder of results, moved to another disk, and a link in its place."""
    elsewhere = outside(out.parent)
    (place / "results.frd").write_text("of a solver")
    shutil.move(place, elsewhere / "disk")
    place.symlink_to(elsewhere / "disk")
    return elsewhere


def test_a_subjects_folder_that_is_a_link_is_read_and_not_replaced(out, capfd, monkeypatch):
    elsewhere = moved(out, out / KEY)
    before = content(elsewhere)
    assert exit_code(*words(out, "--collect")) == 0
    with monkeypatch.context() as patch:  # what is asked for is what is there
        patch.setattr(cohort_plan, "requested", lambda *_: json.loads(numbers_path(out, KEY).read_text())["request"])
        assert exit_code(*words(out)) == 0
    assert "1 subject: 1 done; 0 to run" in capfd.readouterr().err
    whole = content(out.parent)
    assert exit_code(*words(out)) == 2
    assert f"tetopt: {out / KEY}: expected the subject's folder, got a link to" in capfd.readouterr().err
    assert content(out.parent) == whole
    with pytest.raises(InputError, match=f"^{out / KEY}: expected the subject's folder"):
        publish(out / ".work" / "sub-01.run-1", out, KEY)
    assert content(elsewhere) == before


def test_sessions_of_a_subject_that_is_a_link_are_not_replaced(out, image, capfd):
    place = out / "sub-02"
    (place / "ses-a").mkdir(parents=True)
    shutil.move(place, outside(out.parent) / "disk")
    place.symlink_to(out.parent / "outside" / "disk")
    (out.parent / "t.tsv").write_text(f"subject\tsession\timage\n02\ta\t{image}\n02\tb\t{image}\n")
    before = content(out.parent)
    assert exit_code(*words(out)) == 2
    assert capfd.readouterr().err.count(f"tetopt: {place}: expected the subject's folder, got a link to") == 1
    assert content(out.parent) == before


def test_links_that_a_user_has_put_beside_a_mesh_stay_links(out):
    elsewhere = outside(out.parent)
    (out / KEY / "results").symlink_to(elsewhere)
    before = content(elsewhere)
    work = out / ".work" / "sub-01.run-1"
    work.mkdir()
    (work / "a.txt").write_text("new")
    publish(work, out, KEY)
    assert (out / KEY / "results").readlink() == elsewhere
    assert content(elsewhere) == before


def test_foreign_files_that_come_during_a_run_do_not_keep_it_from_its_end(out):
    (out / ".work" / "thesis.txt").write_text("mine")
    (out / ".work" / "sub-01.run-1").mkdir()
    clean(out)
    assert sorted(each.name for each in (out / ".work").iterdir()) == ["lock", "tetopt-manifest", "thesis.txt"]


@pytest.mark.parametrize("kind", ["file link", "pipe", "folder link"])
def test_a_picture_of_another_table_that_is_a_link_is_not_in_the_page(out, kind):
    """Its subject is no subject of this run's, which therefore does not refuse it."""
    (out.parent / "t.tsv").write_text("subject\timage\n02\tb.nii.gz\n")
    assert exit_code(*words(out, "--collect")) == 1
    assert len(pictures(out)) == 1
    elsewhere, picture = outside(out.parent), thumbnail_path(out, KEY)
    for name in ("notes.txt", picture.name):
        (elsewhere / name).write_bytes(picture.read_bytes())
    planted(kind, picture.parent if kind == "folder link" else picture, elsewhere)
    assert exit_code(*words(out, "--collect")) == 1
    assert pictures(out) == {}


def test_a_picture_that_is_no_png_is_not_in_the_page(out):
    thumbnail_path(out, KEY).write_text("a password")
    assert exit_code(*words(out, "--collect")) == 0
    assert pictures(out) == {}


@pytest.mark.parametrize("kind", ["file link", "pipe"])
def test_numbers_of_another_table_that_are_a_link_are_not_read(out, kind):
    (out.parent / "t.tsv").write_text("subject\timage\n02\tb.nii.gz\n")
    elsewhere = outside(out.parent)
    (elsewhere / "notes.txt").write_bytes(numbers_path(out, KEY).read_bytes())
    planted(kind, numbers_path(out, KEY), elsewhere)
    assert collect(out, [KEY])[0].status in ("failed", "missing")
