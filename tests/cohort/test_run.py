"""One subject's run: whole or not at all, the same bytes as `tetopt mesh`, and why it failed."""

import json
import os
import signal
import threading
import time

import numpy as np
import pytest
from commands import exit_code, numbers_in

import tetopt
from tetopt.cohort.layout import begin, failure_path, log_path, numbers_path, subject_folder
from tetopt.cohort.run import SubjectTask, _reason, run_subject

WORDS = ("--nodes=60", "--iterations=1", "--")


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "sphere.nii.gz"
    assert exit_code("phantom", "sphere", "-o", path, "--voxel-mm", "5") == 0
    return path


@pytest.fixture
def job(tmp_path, image):
    out = tmp_path / "out"
    begin(out)
    (out / ".work" / "run-1").touch()
    return SubjectTask("sub-1", (*WORDS, str(image)), str(out), ".vtu", 1, 0.0, 0.0, "run-1")


def test_a_subject_is_what_mesh_alone_writes(job, image, tmp_path):
    """To the byte, but for what differs from run to run: seconds, memory."""
    out = tmp_path / "out"
    ended = run_subject(job)
    assert (ended.status, ended.reason) == ("done", "")
    folder = subject_folder(out, "sub-1")
    alone = tmp_path / "alone"
    (alone / "figures").mkdir(parents=True)
    name = "sub-1_desc-tetopt_mesh"
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


def test_a_refused_subject_is_one_line_and_no_files(job, tmp_path):
    image = tmp_path / "cut.nii.gz"
    image.write_bytes(b"\x1f\x8b\x08 no more")
    ended = run_subject(job._replace(words=(*WORDS, str(image))))
    assert ended.status == "failed"
    assert ended.reason.startswith(f"{image}: ")
    out = tmp_path / "out"
    assert not subject_folder(out, "sub-1").exists()
    failure = json.loads(failure_path(out, "sub-1").read_text())
    assert (failure["reason"], failure["attempts"]) == (ended.reason, 1)
    assert ended.reason in log_path(out, "sub-1").read_text()


def test_a_mesh_that_violates_a_requirement_is_a_mesh(job, tmp_path):
    """A mask of two thin plates, and too few nodes for it: `tetopt mesh` ends with 1."""
    inside = np.zeros((24, 24, 24))
    inside[4:20, 4:20, 11:13] = inside[11:13, 4:20, 4:20] = 1.0
    tetopt.save_image(tmp_path / "thin.nii.gz", tetopt.Image(100.0 * inside + np.arange(24.0)))
    tetopt.save_image(tmp_path / "mask.nii.gz", tetopt.Image(inside))
    words = (f"--mask={tmp_path}/mask.nii.gz", *WORDS, str(tmp_path / "thin.nii.gz"))
    ended = run_subject(job._replace(words=words))
    assert ended.status == "violated"
    assert "overlap only by Dice" in ended.reason
    assert subject_folder(tmp_path / "out", "sub-1").is_dir()
    assert not failure_path(tmp_path / "out", "sub-1").exists()


@pytest.mark.parametrize(("text", "reason"), [
    ("tetopt: a.nii: too short\ntetopt: warning: slow\nTraceback\n", "a.nii: too short"),
    ("one\nlast words\n\n", "last words"), ("", "ended with exit code 2 and no message"),
])  # fmt: skip
def test_the_reason_is_the_last_line_that_says_one(tmp_path, text, reason):
    (tmp_path / "a.log").write_text(text)
    assert _reason(tmp_path / "a.log", 2) == reason


def test_what_was_there_stays_where_a_run_fails(job, tmp_path):
    out = tmp_path / "out"
    run_subject(job)
    before = numbers_path(out, "sub-1").read_bytes()
    assert run_subject(job._replace(words=("--nodes=0", *job.words[1:]))).status == "failed"
    assert numbers_path(out, "sub-1").read_bytes() == before
    assert run_subject(job).status == "done"
    assert not failure_path(out, "sub-1").exists()


def test_a_log_with_a_second_name_is_not_written_to(job, tmp_path):
    (tmp_path / "notes.txt").write_text("years of work")
    os.link(tmp_path / "notes.txt", log_path(tmp_path / "out", "sub-1"))
    assert run_subject(job._replace(words=("--nodes=0", *job.words[1:]))).status == "failed"
    assert (tmp_path / "notes.txt").read_text() == "years of work"


def processes_of(folder):
    """The runs of a cohort's folder that are under way."""
    found = []
    for process in os.listdir("/proc"):
        if process.isdigit():
            try:
                with open(f"/proc/{process}/cmdline", "rb") as stream:
                    words = stream.read()
            except OSError:
                continue
            if b"tetopt\0mesh" in words and os.fsencode(folder) in words:
                found.append(int(process))
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


def test_a_killed_run_is_repeated_once(job, tmp_path):
    ended, n_runs = with_a_run_under_way(job, lambda process: os.kill(process, signal.SIGKILL))
    assert n_runs == 2
    assert ended.status == "failed"
    assert "ended by signal 9, SIGKILL" in ended.reason
    assert json.loads(failure_path(tmp_path / "out", "sub-1").read_text())["attempts"] == 2
    assert not [each for each in (tmp_path / "out" / ".work").iterdir() if each.is_dir()]


def test_a_run_that_is_given_up_ends(job, tmp_path):
    """As when Ctrl-C has ended the cohort: workers of a cluster do not hear it."""
    ended, n_runs = with_a_run_under_way(job, lambda _: (tmp_path / "out" / ".work" / "run-1").unlink())
    assert (ended.status, n_runs) == ("given up", 1)
    assert [each.name for each in (tmp_path / "out" / ".work").iterdir()] == ["tetopt-manifest"]
    assert not processes_of(job.out)
    assert not failure_path(tmp_path / "out", "sub-1").exists()
