"""Runs of subjects: whole or not at all, the same bytes as `tetopt mesh`, and why they failed."""

import contextlib
import json
import os
import shutil
import signal
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from commands import exit_code, numbers_in

import tetopt
from tetopt.cohort import run as run_module
from tetopt.cohort.layout import begin, failure_path, log_path, numbers_path, subject_folder
from tetopt.cohort.run import Ended, SubjectTask, _reason, run_all, run_subject
from tetopt.workers import Share, workers

WORDS = ("--nodes=60", "--iterations=1", "--")


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "sphere.nii.gz"
    assert exit_code("phantom", "sphere", "-o", path, "--voxel-mm", "5") == 0
    return path


def job_in(out, image):
    begin(out)
    (out / ".work" / "run-1").touch()
    return SubjectTask("sub-1", (*WORDS, str(image)), str(out), ".vtu", 1, 0.0, "run-1")


@pytest.fixture
def job(tmp_path, image):
    return job_in(tmp_path / "out", image)


@pytest.fixture(scope="module")
def done(tmp_path_factory, image):
    """A subject that was run, and how it ended."""
    job = job_in(tmp_path_factory.mktemp("done") / "out", image)
    failure_path(Path(job.out), "sub-1").write_text("{}")  # of a run before
    return job, run_subject(job)


@pytest.mark.full
def test_a_subject_is_what_mesh_alone_writes(done, image, tmp_path):
    """To the byte, but for what differs from run to run: seconds, memory."""
    job, ended = done
    out = Path(job.out)
    assert (ended.status, ended.reason) == ("done", "")
    folder, alone, name = subject_folder(out, "sub-1"), tmp_path / "alone", "sub-1_desc-tetopt_mesh"
    (alone / "figures").mkdir(parents=True)
    outputs = ["-o", alone / f"{name}.vtu", "--json", alone / f"{name}.json", "--figures", alone / "figures"]
    assert exit_code("mesh", *WORDS[:-1], *outputs, "--threads", "1", image) == 0
    names = sorted(str(path.relative_to(alone)) for path in alone.rglob("*"))
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) == names
    for path in [alone / each for each in names if each.endswith((".vtu", ".png"))]:
        assert (folder / path.relative_to(alone)).read_bytes() == path.read_bytes(), path
    first, second = (numbers_in(each / f"{name}.json") for each in (folder, alone))
    for numbers in (first, second):
        for key in ("seconds", "memory", "machine"):
            del numbers[key]
        numbers["history"] = [{**row, "seconds": 0} for row in numbers["history"]]
    assert first == second
    assert not [each for each in (out / ".work").iterdir() if each.is_dir()]
    assert not failure_path(out, "sub-1").exists()


@pytest.mark.full
def test_a_subject_that_fails_is_one_line_and_what_was_there_stays(done, image, tmp_path):
    """A log that is a file of two names is another file afterwards."""
    job = done[0]._replace(out=str(shutil.copytree(done[0].out, tmp_path / "out")))
    out = Path(job.out)
    before = numbers_path(out, "sub-1").read_bytes()
    (tmp_path / "notes.txt").write_text("years of work")
    log_path(out, "sub-1").unlink()
    os.link(tmp_path / "notes.txt", log_path(out, "sub-1"))
    ended = run_subject(job._replace(words=("--nodes=0", *job.words[1:])))
    assert ended.status == "failed"
    assert "nodes" in ended.reason
    failure = json.loads(failure_path(out, "sub-1").read_text())
    assert (failure["reason"], failure["attempts"]) == (ended.reason, 1)
    assert ended.reason in log_path(out, "sub-1").read_text()
    assert numbers_path(out, "sub-1").read_bytes() == before
    assert (tmp_path / "notes.txt").read_text() == "years of work"


@pytest.mark.full
def test_a_mesh_that_violates_a_requirement_is_a_mesh(job, tmp_path):
    """A mask of two thin plates, and too few nodes for it: `tetopt mesh` ends with 1."""
    inside = np.zeros((24, 24, 24))
    inside[4:20, 4:20, 11:13] = inside[11:13, 4:20, 4:20] = 1.0
    tetopt.save_image(tmp_path / "thin.nii.gz", tetopt.Image(100.0 * inside + np.arange(24.0)))
    tetopt.save_image(tmp_path / "mask.nii.gz", tetopt.Image(inside))
    words = (f"--mask={tmp_path}/mask.nii.gz", *WORDS, str(tmp_path / "thin.nii.gz"))
    ended = run_subject(job._replace(words=words))
    assert ended.status == "violated"
    assert "overlap with a Dice of only" in ended.reason
    assert subject_folder(tmp_path / "out", "sub-1").is_dir()
    assert not failure_path(tmp_path / "out", "sub-1").exists()


@pytest.mark.parametrize(("text", "reason"), [
    ("tetopt: a.nii: too short\ntetopt: warning: slow\nTraceback\n", "a.nii: too short"),
    ("one\nlast words\n\n", "last words"), ("", "ended with exit code 2 and no message"),
])  # fmt: skip
def test_the_reason_is_the_last_line_that_says_one(tmp_path, text, reason):
    (tmp_path / "a.log").write_text(text)
    assert _reason(tmp_path / "a.log", 2) == reason


def processes_of(folder):
    """The runs of a cohort's folder that are under way."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            words = process.cmdline()
            if "mesh" in words and any(word.startswith(folder) for word in words):
                found.append(process.pid)
    return found


def with_a_run_under_way(job, action):
    """How a long run ends with which something is done; `action` takes the process."""
    ended = []
    words = ("--nodes=3000", "--iterations=500", *job.words[2:])
    runner = threading.Thread(target=lambda: ended.append(run_subject(job._replace(words=words))))
    runner.start()
    seen = set()
    while runner.is_alive():
        for process in set(processes_of(job.out)) - seen:
            seen.add(process)
            action(process)
        time.sleep(0.05)
    return ended[0], len(seen)


@pytest.mark.deep
def test_a_killed_run_is_repeated_once(job, tmp_path):
    ended, n_runs = with_a_run_under_way(job, lambda process: os.kill(process, signal.SIGKILL))
    assert n_runs == 2
    assert ended.status == "failed"
    assert "ended by signal 9, SIGKILL" in ended.reason
    assert json.loads(failure_path(tmp_path / "out", "sub-1").read_text())["attempts"] == 2
    assert not [each for each in (tmp_path / "out" / ".work").iterdir() if each.is_dir()]


@pytest.mark.deep
def test_a_run_that_is_given_up_ends(job, tmp_path):
    """As when Ctrl-C has ended the cohort: workers of a cluster do not hear it."""
    ended, n_runs = with_a_run_under_way(job, lambda _: (tmp_path / "out" / ".work" / "run-1").unlink())
    assert (ended.status, n_runs) == ("given up", 1)
    assert [each.name for each in (tmp_path / "out" / ".work").iterdir()] == ["tetopt-manifest"]
    assert not processes_of(job.out)
    assert not failure_path(tmp_path / "out", "sub-1").exists()


@pytest.mark.full
@pytest.mark.parametrize(("n_bytes", "limit", "reason", "attempts"), [
    (3e9, 2e9, "needs 3 GB of memory, but a worker has 2 GB; reduce the number of nodes", 0),
    (0.0, 5e7, "exceeded its worker's memory limit of 50 MB; reduce the number of nodes, or use larger workers", 1),
])  # fmt: skip
def test_a_subject_beyond_its_workers_memory_is_a_row(job, tmp_path, monkeypatch, n_bytes, limit, reason, attempts):
    """Not begun where that is predicted, and ended where it is measured."""
    monkeypatch.setattr(run_module, "memory_limit", lambda: limit)
    ended = run_subject(job._replace(n_bytes=n_bytes))
    record = json.loads(failure_path(tmp_path / "out", "sub-1").read_text())
    assert ended.status == "failed"
    assert reason in ended.reason == record["reason"]
    assert record["attempts"] == attempts
    assert not [each for each in (tmp_path / "out" / ".work").iterdir() if each.is_dir()]
    assert not processes_of(job.out)


def of_four(job):
    """One that fails, one that kills its workers, two that are done."""
    if job.key == "sub-2":
        raise ValueError("first\nlast\x1b[2J")
    if job.key == "sub-3":
        os.kill(os.getpid(), signal.SIGKILL)
    return Ended(job.key, "done", "", 0.0, 0)


@pytest.mark.full
def test_of_a_cohort_one_fails_and_one_kills_its_workers_and_the_others_are_done(tmp_path, capfd):
    out = tmp_path / "out"
    begin(out)
    jobs = [SubjectTask(f"sub-{k}", (), str(out), ".vtu", 1, 1.0, "run-1") for k in range(1, 5)]
    with workers(Share(2, 1, 4e8), None, None) as pool:
        ended = {each.key: each for each in run_all(jobs, pool, out, of_four)}
    assert {key: each.status for key, each in ended.items()} == {
        "sub-1": "done", "sub-2": "failed", "sub-3": "failed", "sub-4": "done"
    }  # fmt: skip
    records = [json.loads(failure_path(out, key).read_text()) for key in ("sub-2", "sub-3")]
    assert [each["attempts"] for each in records] == [1, 2]
    assert [each["reason"] for each in records] == [ended["sub-2"].reason, ended["sub-3"].reason]
    assert ended["sub-2"].reason.startswith("ValueError: first last")
    assert "\x1b" not in ended["sub-2"].reason
    assert ended["sub-3"].reason == "its worker ended, 2 times, possibly because it exceeded its limit of 0.4 GB"
    assert capfd.readouterr() == ("", "")
