"""Runs of subjects: whole or not at all, the same bytes as `tetopt mesh`, and why they failed."""

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


def run_with(task, **options):
    return run_subject(task._replace(job=changed_options(task.job, **options)))


def log_of(task):
    return log_path(task.out, "sub-1").read_text()


def unfinished(task):
    return [each.name for each in (task.out / ".work").iterdir() if each.name != "tetopt-lock"]


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
    folder, alone = subject_folder(task.out, "sub-1"), tmp_path / "alone"
    alone.mkdir()
    mesh, numbers = (alone / f"sub-1_desc-tetopt_mesh{suffix}" for suffix in (".vtu", ".json"))
    command = ["mesh --nodes 60 --iterations 1 --figures", alone / "figures", "-o", mesh]
    assert exit_code(*command, "--json", numbers, image) == 0
    names, own = (
        sorted(str(path.relative_to(each)) for path in each.rglob("*")) for each in (alone, folder)
    )
    assert own == names
    for name in names:
        if name.endswith((".vtu", ".png")):
            assert (folder / name).read_bytes() == (alone / name).read_bytes(), name
    first, second = (numbers_in(each / numbers.name) for each in (folder, alone))
    assert ended.peak_bytes == first["memory"]["peak_bytes"]
    for numbers in (first, second):
        for key in ("seconds", "memory", "machine"):
            del numbers[key]
        numbers["history"] = [{**row, "seconds": 0} for row in numbers["history"]]
    assert first == second
    assert unfinished(task) == []
    assert "reading and preparing the image" in log_of(task)


def test_a_log_repeats_no_line(task, monkeypatch):
    def said(job, listener, is_stopped):
        for text in ("one", "one", "two"):
            listener(Event("progress", text))
        raise InputError("enough")

    monkeypatch.setattr(run_module, "run", said)
    run_subject(task)
    assert log_of(task) == "one\ntwo\nenough\n"


def test_a_subject_that_fails_is_one_line_and_what_was_there_stays(done, tmp_path):
    """A log that is a file of two names is another file afterwards."""
    task = done[0]._replace(out=shutil.copytree(done[0].out, tmp_path / "out"))
    before = numbers_path(task.out, "sub-1").read_bytes()
    (tmp_path / "notes.txt").write_text("years of work")
    log_path(task.out, "sub-1").unlink()
    os.link(tmp_path / "notes.txt", log_path(task.out, "sub-1"))
    ended = run_with(task, nodes=0)
    reason = "`nodes`: expected a whole number from 5 to 50000000, got 0"
    assert (ended.status, ended.reason) == ("failed", reason)
    assert log_of(task) == f"{reason}\n"
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
    ended = run_with(task, **thin)
    assert ended.status == "violated"
    assert "overlap with a Dice of only" in ended.reason
    violated = numbers_in(numbers_path(task.out, "sub-1"))["violated"]
    assert ended.reason == "; ".join(violated.values())
    assert "overlap with a Dice of only" in log_of(task)


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
    assert ("Traceback" in log_of(task)) == isinstance(error, KeyError)
    assert "half of it is empty" in log_of(task)
    assert unfinished(task) == []


def test_a_run_that_is_given_up_ends(task, monkeypatch):
    """As when Ctrl-C has ended the cohort: workers of a cluster do not hear it."""

    stages = []

    def run_and_clean(job, on, stop):
        def heard(event):
            stages.extend([event.data.name] if event.kind == "started" else [])
            if stages[-1:] == ["optimise"]:
                clean(task.out, None)

        return tetopt.run(job, heard, stop)

    monkeypatch.setattr(run_module, "run", run_and_clean)
    ended = run_with(task, iterations=500)
    assert (ended.status, "No such file" in ended.reason) == ("failed", True)
    assert stages[-1] == "optimise"  # it does not go on to write
    assert unfinished(task) == []
    assert not subject_folder(task.out, "sub-1").exists()


def test_a_subject_beyond_its_workers_memory_is_not_begun(task, monkeypatch):
    monkeypatch.setattr(run_module, "memory_limit", lambda: 2e9)
    ended = run_subject(task._replace(n_bytes=3e9))
    assert ended.status == "failed"
    assert ended.reason.startswith("needs 3 GB of memory, but a worker has 2 GB; ")


def test_failures_are_recorded_and_forgotten(monkeypatch, task):
    """Of a subject, of its worker, and of an earlier run."""
    tasks = [task._replace(key=f"sub-{k}") for k in range(3)]
    errors = [None, None, WorkerEnded("its worker ended, 2 times")]
    ended = [
        run_module.Ended("sub-0", "done", "", 1.0, 1),
        run_module.Ended("sub-1", "failed", "cut short", 1.0, 0),
        None,
    ]
    failure_path(task.out, "sub-0").write_text("{}")

    def run_tasks(pool, function, tasks, place):
        assert (function, place) == (run_subject, str(task.out))
        return zip(tasks, ended, errors, strict=True)

    monkeypatch.setattr(run_module, "run_tasks", run_tasks)
    outcomes = list(run_all(tasks, None, task.out))
    assert outcomes[:2] == ended[:2]
    assert outcomes[2][:3] == ("sub-2", "failed", "its worker ended, 2 times")
    assert [numbers_in(failure_path(task.out, each.key)) for each in outcomes[1:]] == [
        {"key": each.key, "reason": each.reason, "command": "tetopt mesh ..."}
        for each in outcomes[1:]
    ]
    assert not failure_path(task.out, "sub-0").exists()
