"""Runs of subjects: whole or not at all, the same bytes as `tetopt mesh`, and why they failed."""

import json
import os
import shutil
import warnings

import numpy as np
import pytest
from commands import exit_code, numbers_in

import tetopt
from tetopt.cohort import subject_runs as run_module
from tetopt.cohort.layout import begin, clean, failure_path, log_path, numbers_path, subject_folder
from tetopt.cohort.subject_runs import SubjectTask, run_all, run_subject
from tetopt.errors import InputError
from tetopt.job.events import Event
from tetopt.job.options import JobOptions
from tetopt.job.plan import changed_options
from tetopt.workers import WorkerEnded

pytestmark = pytest.mark.usefixtures("read_here")


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "sphere.nii.gz"
    assert exit_code("phantom", "sphere", "-o", path, "--voxel-mm", "6") == 0
    return path


def task_in(out, image):
    begin(out)
    job = JobOptions(images=[image], output="mesh.vtu", nodes=60, iterations=1)
    return SubjectTask("sub-1", job, ".vtu", out, 0.0, "tetopt mesh ...")


def with_options(task, **options):
    return task._replace(job=changed_options(task.job, **options))


@pytest.fixture
def task(tmp_path, image):
    return task_in(tmp_path / "out", image)


@pytest.fixture(scope="module")
def done(tmp_path_factory, image):
    """A subject that was run, and how it ended."""
    task = task_in(tmp_path_factory.mktemp("done") / "out", image)
    return task, run_subject(task)


def test_a_subject_is_what_mesh_alone_writes(done, image, tmp_path):
    """To the byte, but for what differs from run to run: seconds, memory."""
    task, ended = done
    assert (ended.status, ended.reason) == ("done", "")
    folder, alone, name = (
        subject_folder(task.out, "sub-1"),
        tmp_path / "alone",
        "sub-1_desc-tetopt_mesh",
    )
    outputs = [
        "-o",
        alone / f"{name}.vtu",
        "--json",
        alone / f"{name}.json",
        "--figures",
        alone / "figures",
    ]
    alone.mkdir()
    assert exit_code("mesh", "--nodes", 60, "--iterations", 1, *outputs, image) == 0
    names = sorted(str(path.relative_to(alone)) for path in alone.rglob("*"))
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) == names
    for path in [alone / each for each in names if each.endswith((".vtu", ".png"))]:
        assert (folder / path.relative_to(alone)).read_bytes() == path.read_bytes(), path
    first, second = (numbers_in(each / f"{name}.json") for each in (folder, alone))
    assert ended.peak_bytes == first["memory"]["peak_bytes"]
    for numbers in (first, second):
        for key in ("seconds", "memory", "machine"):
            del numbers[key]
        numbers["history"] = [{**row, "seconds": 0} for row in numbers["history"]]
    assert first == second
    assert not [each for each in (task.out / ".work").iterdir() if each.is_dir()]
    assert "reading and preparing the image" in log_path(task.out, "sub-1").read_text()


def test_a_log_repeats_no_line(task, monkeypatch):
    def said(job, listener, is_stopped):
        for text in ("compiling, 1 of 2", "compiling, 1 of 2", "compiling, 2 of 2"):
            listener(Event("progress", text))
        raise InputError("enough")

    monkeypatch.setattr(run_module, "run", said)
    run_subject(task)
    assert (
        log_path(task.out, "sub-1").read_text() == "compiling, 1 of 2\ncompiling, 2 of 2\nenough\n"
    )


def test_a_subject_that_fails_is_one_line_and_what_was_there_stays(done, tmp_path):
    """A log that is a file of two names is another file afterwards."""
    task = done[0]._replace(out=shutil.copytree(done[0].out, tmp_path / "out"))
    before = numbers_path(task.out, "sub-1").read_bytes()
    (tmp_path / "notes.txt").write_text("years of work")
    log_path(task.out, "sub-1").unlink()
    os.link(tmp_path / "notes.txt", log_path(task.out, "sub-1"))
    ended = run_subject(with_options(task, nodes=0))
    assert (ended.status, ended.reason) == (
        "failed",
        "`nodes`: expected a whole number from 5 to 50000000, got 0",
    )
    assert log_path(task.out, "sub-1").read_text() == f"{ended.reason}\n"
    assert numbers_path(task.out, "sub-1").read_bytes() == before
    assert (tmp_path / "notes.txt").read_text() == "years of work"


def test_a_mesh_that_violates_a_requirement_is_a_mesh(task, tmp_path):
    """A mask of two thin plates, and too few nodes for it: `tetopt mesh` ends with 1. Warnings
    are in its log.
    """
    inside = np.zeros((24, 24, 24))
    inside[4:20, 4:20, 11] = inside[11, 4:20, 4:20] = 1.0
    tetopt.save_image(tmp_path / "thin.nii.gz", tetopt.Image(100.0 * inside + np.arange(24.0)))
    tetopt.save_image(tmp_path / "mask.nii.gz", tetopt.Image(inside))
    thin = {"images": [tmp_path / "thin.nii.gz"], "mask": tmp_path / "mask.nii.gz"}
    ended = run_subject(with_options(task, **thin))
    assert ended.status == "violated"
    assert "overlap with a Dice of only" in ended.reason
    assert ended.reason == "; ".join(
        numbers_in(numbers_path(task.out, "sub-1"))["violated"].values()
    )
    assert "overlap with a Dice of only" in log_path(task.out, "sub-1").read_text()


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (KeyError("first\nlast\x1b[2J"), "KeyError: 'first\\nlast\\x1b[2J'"),
        (FileNotFoundError(2, "No such file", "a.nii"), "a.nii: No such file"),
        (InputError("a: b\n c"), "a: b c"),
        (
            MemoryError("of 3 GB"),
            "not enough memory: of 3 GB; use fewer nodes, a part of the image or `max_gb`",
        ),
    ],
)
def test_an_error_is_a_line_and_one_of_a_programmer_a_traceback_in_the_log(
    task, monkeypatch, error, reason
):
    def failing(job, on, _):
        warnings.warn("half of it is empty", stacklevel=1)
        raise error

    monkeypatch.setattr(run_module, "run", failing)
    assert run_subject(task)[:3] == ("sub-1", "failed", reason)
    log = log_path(task.out, "sub-1").read_text()
    assert ("Traceback" in log) == isinstance(error, KeyError)
    assert "half of it is empty" in log
    assert not [each for each in (task.out / ".work").iterdir() if each.is_dir()]


def test_a_run_that_is_given_up_ends(task, monkeypatch):
    """As when Ctrl-C has ended the cohort: workers of a cluster do not hear it."""

    stages = []

    def run_and_clean(job, on, stop):
        def heard(event):
            stages.extend([event.data.name] if event.kind == "started" else [])
            if stages[-1:] == ["optimise"]:
                clean(task.out)

        return tetopt.run(job, heard, stop)

    monkeypatch.setattr(run_module, "run", run_and_clean)
    ended = run_subject(with_options(task, iterations=500))
    assert (ended.status, "No such file" in ended.reason) == ("failed", True)
    assert stages[-1] == "optimise"  # it does not go on to write
    assert [each.name for each in (task.out / ".work").iterdir()] == ["tetopt-lock"]
    assert not subject_folder(task.out, "sub-1").exists()


def test_a_subject_beyond_its_workers_memory_is_not_begun(task, monkeypatch):
    monkeypatch.setattr(run_module, "memory_limit", lambda: 2e9)
    ended = run_subject(task._replace(n_bytes=3e9))
    words = (
        "needs 3 GB of memory, but a worker has 2 GB; reduce the number of nodes, or use "
        "larger workers"
    )
    assert (ended.status, ended.reason) == ("failed", words)


def test_failures_are_recorded_and_forgotten(tmp_path, monkeypatch, task):
    """Of a subject, of its worker, and of an earlier run."""
    names = [task._replace(key=f"sub-{k}") for k in range(3)]
    errors = {
        "sub-1": None,
        "sub-2": WorkerEnded(
            "its worker ended, 2 times, possibly because it exceeded its limit of 0.4 GB"
        ),
        "sub-0": None,
    }
    ended = [
        run_module.Ended("sub-0", "done", "", 1.0, 1),
        run_module.Ended("sub-1", "failed", "cut short", 1.0, 0),
    ]
    failure_path(task.out, "sub-0").write_text("{}")

    def run_tasks(pool, function, tasks, place):
        assert (function, place) == (run_subject, str(task.out))
        return zip(tasks, [*ended, None], [errors[each.key] for each in tasks], strict=True)

    monkeypatch.setattr(run_module, "run_tasks", run_tasks)
    outcomes = list(run_all(names, None, task.out))
    reason = "its worker ended, 2 times, possibly because it exceeded its limit of 0.4 GB"
    assert [each[:3] for each in outcomes] == [
        *(each[:3] for each in ended),
        ("sub-2", "failed", reason),
    ]
    records = [json.loads(failure_path(task.out, key).read_text()) for key in ("sub-1", "sub-2")]
    assert records[0] == {"key": "sub-1", "reason": "cut short", "command": "tetopt mesh ..."}
    assert records[1]["reason"] == reason
    assert not failure_path(task.out, "sub-0").exists()
