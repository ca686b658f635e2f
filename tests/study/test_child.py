"""A pipeline in a child process: same bits, limits kept, each failure one clear line."""

import os
import pipes
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

import tetopt
from tetopt.job.events import Event, listen_with
from tetopt.study.endings import AFTER_CRASHES
from tetopt.study.pipeline_process import run_in_child
from tetopt.study.pipelines import PIPELINES, PipelineInput
from tetopt.system.child import signal_words

IMAGE = tetopt.load_phantom("sphere").image(voxel_mm=4.0)
JOB = PipelineInput(IMAGE, None, 300, classes=2, iterations=3)


@pytest.mark.deep
def test_same_bits_as_in_process():
    labels = tetopt.Image((IMAGE.data > 50) + (np.indices(IMAGE.shape)[0] > 12), IMAGE.affine)
    job, pipeline = JOB._replace(labels=labels), PIPELINES["tetopt-uniform"].function
    outcome, here = outcome_of(pipeline, job, max_seconds=300.0), pipeline(job)
    assert outcome.failure is None
    assert outcome.mesh.points.tobytes() == here.mesh.points.tobytes()
    assert outcome.mesh.cells.tobytes() == here.mesh.cells.tobytes()
    np.testing.assert_array_equal(outcome.labels, here.labels)
    assert list(outcome.seconds) == list(here.seconds)
    assert outcome.notes == here.notes
    assert 2e7 < outcome.peak_bytes < 4e9


def outcome_of(pipeline, job=JOB, max_seconds=60.0, max_bytes=None):
    return run_in_child(pipeline, job, "mine", max_seconds=max_seconds, max_bytes=max_bytes)


def test_job_arrives_whole():
    """Affine, labels, seconds in their order, and notes."""
    affine = np.array([[0, -2.0, 0, 5], [3, 0, 0.5, 1], [0, 0, 1.5, 2], [0, 0, 0, 1]])
    image = tetopt.Image(IMAGE.data + 0.1, affine)
    labels = tetopt.Image((IMAGE.data > 50).astype(int), affine)
    outcome = outcome_of(pipes.fine, PipelineInput(image, labels, 200))
    assert outcome.mesh.points.tobytes() == tetopt.lattice_mesh(image, nodes=200).points.tobytes()
    assert list(outcome.seconds.items()) == [("first", 1.5), ("second", 0.25)]
    assert outcome.notes == ["a note"]


@pytest.mark.deep
@pytest.mark.parametrize(
    ("pipeline", "line"),
    [
        (pipes.refuse, "thing: expected a, got b; do c"),
        (pipes.crash, f"twice crashed: signal 11, SIGSEGV; {AFTER_CRASHES}"),
        (pipes.wrap, f"twice mine crashed (signal 11, SIGSEGV); {AFTER_CRASHES}"),
        (pipes.quit_early, "ended with exit code 0 and no message"),
        (pipes.divide, "ZeroDivisionError: division by zero"),
        (pipes.leave, "ended with exit code 3 and no message"),
    ],
)
def test_failure_is_one_line(pipeline, line):
    outcome = outcome_of(pipeline)
    assert outcome.mesh is None
    assert outcome.failure == line


@pytest.mark.deep
def test_a_crash_is_repeated_once(tmp_path, monkeypatch):
    """And said; what is not installed is not repeated."""
    monkeypatch.setenv("PIPES_PID", str(tmp_path / "pid"))
    events = []
    with listen_with(events.append):
        outcome = outcome_of(pipes.crash_once)
    said = "mine: crashed: signal 11, SIGSEGV; running it again, with smoother surfaces"
    assert events == [Event("note", said)]
    assert (outcome.failure, outcome.is_crash) == (None, False)
    first, last = outcome.notes
    assert first.startswith("the first run crashed: signal 11, SIGSEGV; this is the second")
    assert last == "smoothing 2"
    (tmp_path / "pid").unlink()
    outcome = outcome_of(pipes.crash_and_refuse)
    assert outcome.failure == "crashed: signal 11, SIGSEGV; then thing: expected a, got b; do c"
    events.clear()
    with listen_with(events.append):
        outcome = outcome_of(pipes.absent)
    assert (outcome.failure, events) == ("thing: not installed", [])


@pytest.mark.deep
def test_modules_of_the_current_folder_are_not_run(tmp_path, monkeypatch):
    """An untrusted image may lie in one with a numpy.py."""
    for name in ("numpy", "json", "tempfile"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w')\n")
    monkeypatch.chdir(tmp_path)
    assert outcome_of(pipes.fine).failure is None
    assert not (tmp_path / "executed").exists()


def test_signals_in_words():
    """A shell's 130 and 143 are of somebody who ended it, not of a crash."""
    words = {
        -11: "signal 11, SIGSEGV",
        139: "signal 11, SIGSEGV",
        -15: "signal 15, SIGTERM",
        -99: "signal 99",
    }
    assert {code: signal_words(code) for code in words} == words
    assert {signal_words(code) for code in (0, 1, 127, 130, 143, 255)} == {None}


def processes_of(pipeline, path, n):
    """The n processes whose ids stand in a file, after the pipeline ran out of time."""
    for most in (4.0, 16.0, 64.0):  # a busy machine may not have started them earlier
        outcome = outcome_of(pipeline, max_seconds=most)
        assert outcome.failure == f"out of time: killed after {most:g} s"
        pids = path.read_text().split() if path.exists() else []
        if len(pids) >= n:
            break
    assert len(pids) >= n
    return [int(pid) for pid in pids]


@pytest.mark.deep
def test_what_escapes_its_group_ends_too(tmp_path, monkeypatch):
    """Orphans in sessions of their own end with the child; the temporary folder has gone."""
    monkeypatch.setenv("PIPES_PID", str(tmp_path / "pid"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    pids = processes_of(pipes.escape, tmp_path / "pid", 2)
    assert [pid for pid in pids if is_running(pid)] == []
    assert [path.name for path in tmp_path.iterdir()] == ["pid"]


@pytest.mark.deep
def test_memory_of_a_session_below_counts():
    outcome = outcome_of(pipes.hoard_below, max_bytes=600_000_000)
    assert outcome.failure.startswith("too much memory: ")


@pytest.mark.deep
def test_time_out_kills_the_whole_group(tmp_path, monkeypatch):
    monkeypatch.setenv("PIPES_PID", str(tmp_path / "pid"))
    (pid,) = processes_of(pipes.sleep, tmp_path / "pid", 1)
    assert not is_running(pid)


@pytest.mark.deep
def test_too_much_memory():
    outcome = outcome_of(pipes.hoard, max_bytes=600_000_000)
    assert outcome.failure.startswith("too much memory: ")
    assert outcome.failure.endswith(" MB resident, 600 MB allowed")
    assert 600e6 < outcome.peak_bytes < 1500e6


@pytest.mark.deep
def test_peak_is_the_childs_own():
    """Not that of a large parent, which ru_maxrss would begin with."""
    hoard = np.ones(100_000_000)
    outcome = outcome_of(pipes.fine)
    assert outcome.peak_bytes < 0.7 * hoard.nbytes


@pytest.mark.deep
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL], ids=["Ctrl-C", "kill -9"])
def test_the_end_of_the_parent_ends_the_child(tmp_path, sent):
    """And what it started; and takes the temporary folder away."""
    program = (
        "import pipes, tetopt; from tetopt.study.pipeline_process import run_in_child\n"
        "from tetopt.study.pipelines import PipelineInput\n"
        "image = tetopt.load_phantom('sphere').image(voxel_mm=4.0)\n"
        "job = PipelineInput(image, None, 300)\n"
        "run_in_child(pipes.sleep, job, 'mine', max_seconds=300.0, max_bytes=None)"
    )
    pid_file, temporary = tmp_path / "pid", tmp_path / "temporary"
    temporary.mkdir()
    paths = [str(Path(__file__).parent), str(Path(tetopt.__file__).parents[1])]
    environment = os.environ | {
        "PIPES_PID": str(pid_file),
        "PYTHONPATH": os.pathsep.join(paths),
        "TMPDIR": str(temporary),
    }
    parent = subprocess.Popen(
        [sys.executable, "-c", program], env=environment, stderr=subprocess.PIPE
    )
    try:
        wait_for(lambda: pid_file.exists() and pid_file.read_text(), 60.0)
        assert len(list(temporary.iterdir())) == 1
        parent.send_signal(sent)
        errors = parent.communicate(timeout=20.0)[1]
        assert b"KeyboardInterrupt" in errors or sent == signal.SIGKILL
    finally:
        parent.kill()
    assert not is_running(int(pid_file.read_text()))
    wait_for(lambda: not list(temporary.iterdir()), 20.0)


def is_running(pid):
    """Whether a process lives; killed ones may stay a moment, and as zombies if nobody collects
    them.
    """
    for _ in range(40):
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX":
                return False
        except OSError:
            return False
        time.sleep(0.05)
    return True


def wait_for(is_there, seconds):
    deadline = time.monotonic() + seconds
    while not is_there():
        assert time.monotonic() < deadline
        time.sleep(0.05)
