"""`tetopt cohort` as a user runs it: interrupted, a worker killed, resumed, changed; nothing
lost or done twice.
"""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest
from cohorts import save_failure, save_run
from commands import exit_code

import tetopt
from tetopt import InputError, workers
from tetopt.cohort import cohort as cohort_module
from tetopt.cohort import cohort_plan
from tetopt.cohort import estimate as estimate_module
from tetopt.cohort.layout import begin
from tetopt.cohort.options import CohortOptions
from tetopt.cohort.subject_states import SubjectState
from tetopt.cohort.subjects import read_table
from tetopt.job.options import RunOptions
from tetopt.system.work_directory import lock_directory

pytestmark = pytest.mark.usefixtures("read_here")

WAIT_SECONDS = 240  # a machine with much else to do still gets there


def meshes(folder):
    """The subjects' meshes that are there, with when they were written."""
    return {
        path.parent.name: path.stat().st_mtime_ns
        for path in sorted((folder / "out").glob("sub-*/*.vtu"))
    }


def table_rows(folder):
    with open(folder / "out" / "cohort.tsv", newline="") as stream:
        return {row["participant_id"]: row for row in csv.DictReader(stream, delimiter="\t")}


def write_rows(folder, *rows):
    (folder / "t.tsv").write_text(
        "\n".join(["subject\timage\tlabels\tnodes", *map("\t".join, rows), ""])
    )


@pytest.fixture
def small(tmp_path):
    assert exit_code("phantom", "sphere", "-o", tmp_path / "a.nii.gz", "--voxel-mm", "6") == 0
    (tmp_path / "t.tsv").write_text("subject\timage\tnodes\n01\ta.nii.gz\t60\n02\ta.nii.gz\tn/a\n")
    return tmp_path


@pytest.mark.full
def test_a_cohort_from_python_is_that_of_the_command(small):
    """The same folder: a rerun by either finds all done. What is no option, or no value of one,
    is refused at once.
    """
    one = {"participants": ["01"], "iterations": 0}
    assert tetopt.run_cohort(
        small / "t.tsv", small / "out", on=lambda event: None, workers=1, **one
    ) == {"sub-01": "done"}
    command = [
        "cohort",
        small / "t.tsv",
        "-o",
        small / "out",
        "--iterations",
        "0",
        "--participant-label",
        "01",
    ]
    there = meshes(small)
    assert exit_code(*command) == 0
    assert meshes(small) == there
    events = []
    tetopt.run_cohort(small / "t.tsv", str(small / "out"), on=events.append, **one, dry_run=True)
    assert events[-1] == ("note", "1 subject: 1 done; 0 to run", None)
    with pytest.raises(InputError, match="unknown option 'noodes'; did you mean nodes"):
        tetopt.run_cohort(small / "t.tsv", small / "out", noodes=3)
    with pytest.raises(InputError, match=r"^`nodes`: expected a whole number, got 'many'"):
        tetopt.run_cohort(small / "t.tsv", small / "out", nodes="many")


def test_what_failed_is_a_row_and_a_rerun_would_make_what_changed_and_what_failed(
    small, capfd, scheduler
):
    """Labels on another grid are taken to the image's."""
    image = tetopt.load_image(small / "a.nii.gz")
    far = np.array(image.affine)
    far[:3, 3] += 500.0
    tetopt.save_image(small / "far.nii.gz", tetopt.Image(1.0 * (image.data > 50), far))
    coarse = tetopt.Image(
        1.0 * (image.data[::2, ::2, ::2] > 50), image.affine @ np.diag([2.0, 2.0, 2.0, 1.0])
    )
    tetopt.save_image(small / "coarse.nii.gz", coarse)
    (small / "cut.nii.gz").write_bytes((small / "a.nii.gz").read_bytes()[:300])
    command = ["cohort", small / "t.tsv", "-o", small / "out", "--iterations", 0, "--nodes", 300]
    command += ["--scheduler", scheduler]
    labelled, far = (
        ["01", "a.nii.gz", "coarse.nii.gz", "n/a"],
        ["03", "a.nii.gz", "far.nii.gz", "n/a"],
    )
    write_rows(small, labelled, ["02", "cut.nii.gz", "n/a", "n/a"], far)
    assert exit_code(*command) == 1
    rows, page = table_rows(small), (small / "out" / "cohort.html").read_text()
    assert {name: row["status"] for name, row in rows.items()} == {
        "sub-01": "done",
        "sub-02": "failed",
        "sub-03": "failed",
    }
    log = " ".join((small / "out" / "logs" / "sub-01.log").read_text().split())
    assert "resampled to the image's grid" in log
    for name, file in (("sub-02", "cut.nii.gz"), ("sub-03", "far.nii.gz")):
        failure = json.loads((small / "out" / "logs" / f"{name}.failed.json").read_text())
        reason = failure["reason"]
        assert failure["command"].startswith(f"tetopt mesh -o {name}.vtu --")
        assert (
            file
            in rows[name]["reason"]
            == reason
            in (small / "out" / "logs" / f"{name}.log").read_text()
        )
        assert name in page
    assert list(meshes(small)) == ["sub-01"]
    # One has other options by now, one a whole image.
    write_rows(small, [*labelled[:3], "320"], ["02", "a.nii.gz", "n/a", "n/a"], far)
    capfd.readouterr()
    assert exit_code(*command, "--dry-run") == 0
    assert "1 changed: nodes was 300, now 320" in capfd.readouterr().err
    assert exit_code(*command, "--dry-run", "--retry-failed") == 0
    said = capfd.readouterr()
    assert "1 subjects are out of date" in said.err
    assert "sub-02: " in said.out
    assert "sub-01: " not in said.out


def test_a_failure_is_forgotten_where_the_mesh_is_what_is_asked_for(small, monkeypatch, capfd):
    """Options that fail, and then those again of the mesh that is there: it is done, though
    nothing is run.
    """
    monkeypatch.setattr(cohort_plan, "job_request", lambda *_: {"sha256": "1"})
    begin(small / "out")
    save_run(
        small / "out",
        "sub-01",
        {"request": {"options": {}, "files": {}, "sha256": "1"}, "violated": {}},
    )
    save_failure(small / "out", "sub-01", "too few nodes")
    assert (
        exit_code("cohort", small / "t.tsv", "-o", small / "out", "--participant-label", "01") == 0
    )
    assert "1 subject: 1 done; 0 to run" in capfd.readouterr().err
    assert table_rows(small)["sub-01"]["status"] == "done"


def begun(folder):
    """A run that has begun, its words in a file."""
    command = [
        sys.executable,
        "-m",
        "tetopt",
        "cohort",
        folder / "t.tsv",
        "-o",
        folder / "out",
        "--iterations",
        "1",
    ]
    with open(folder / "words.txt", "w") as stream:
        return subprocess.Popen(
            [*command, "--nodes", "60"], stdout=stream, stderr=stream, cwd=folder
        )


def wait_for(folder, number, run):
    """Wait until so many meshes are there."""
    end = time.monotonic() + WAIT_SECONDS
    while len(meshes(folder)) < number:
        assert run.poll() is None, (folder / "words.txt").read_text()
        assert time.monotonic() < end, "no mesh in time"
        time.sleep(0.05)


def workers_of(pid):
    """The worker processes of a run: those that have a run of `tetopt mesh` for a child, or
    could have.
    """
    return [
        child.pid
        for child in psutil.Process(pid).children()
        if "spawn_main" in " ".join(child.cmdline())
    ]


@pytest.mark.deep
def test_ctrl_c_keeps_what_is_done_and_a_rerun_does_the_rest_though_a_worker_dies(small):
    write_rows(small, *([f"0{number}", "a.nii.gz", "n/a", "n/a"] for number in range(1, 6)))
    run = begun(small)
    wait_for(small, 1, run)
    run.send_signal(signal.SIGINT)
    assert run.wait(WAIT_SECONDS) == 130
    words, first = (small / "words.txt").read_text(), meshes(small)
    assert 1 <= len(first) < 5
    assert "to run only" in words
    assert "Traceback" not in words
    assert {path.name for path in (small / "out" / ".work").iterdir()} == {"tetopt-lock"}
    run = begun(small)
    wait_for(small, len(first) + 1, run)
    os.kill(workers_of(run.pid)[0], signal.SIGKILL)
    assert run.wait(WAIT_SECONDS) == 0, (small / "words.txt").read_text()
    second = meshes(small)
    assert sorted(second) == [f"sub-0{number}" for number in range(1, 6)]
    assert {name: second[name] for name in first} == first  # none is made again
    assert f"5 subjects: {len(first)} done" in (small / "words.txt").read_text()


def refused(folder, capsys, *options):
    """The lines by which a cohort is refused, and that nothing was made."""
    before = sorted(folder.rglob("*"))
    assert exit_code("cohort", folder / "t.tsv", "-o", folder / "out", *options) == 2
    assert sorted(folder.rglob("*")) == before
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("tetopt: ")]


def test_all_that_is_wrong_is_said_before_anything_is_run(small, capsys):
    lines = [
        "subject\timage\tnodes\tmask\tnods\tk-d",
        "01\ta.nii.gz\t-4\tn/a\tn/a\tn/a",
        "02\tb.nii.gz\tn/a\tn/a\tn/a\tn/a",
        "03\ta.nii.gz\tmany\tn/a\tn/a\tn/a",
        "0 1\ta.nii.gz\tn/a\tn/a\tn/a\tn/a",
        "05\ta.nii.gz\tn/a\tm.nii\tn/a\tn/a",
        "06\ta.nii.gz\tn/a\tn/a\t5\tn/a",
        "07\ta.nii.gz\tn/a\tn/a\tn/a\t1.5",
        "08\ta.nii.gz\t60\tn/a\tn/a\t0.5",
    ]
    (small / "t.tsv").write_text("\n".join(lines) + "\n")
    said = refused(small, capsys)
    places = [
        int(number)
        for line in said
        for number in re.findall(r"^tetopt: \S+t\.tsv, line (\d+): ", line)
    ]
    assert sorted(places) == [2, 3, 4, 5, 6, 7, 8]
    assert any("nods" in line and "did you mean nodes?" in line for line in said)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--threads", "0"), "--threads: expected 1 or more"),
        (("--format", "docx"), "--format: expected one of"),
        (("--mask", "m-{subject}.nii"), "m-01.nii does not exist"),
        (("--participant-label", "9"), "has no subject 9"),
        (("--mask", "a.nii.gz", "--background", "3"), "give only one of them"),
    ],
)
def test_options_of_all_that_cannot_be_are_refused(small, capsys, monkeypatch, options, words):
    monkeypatch.chdir(small)
    assert any(words in line for line in refused(small, capsys, *options))


def test_words_of_a_run_mean_the_same_in_any_folder(small, monkeypatch):
    """A worker of a scheduler that others started may be in another one."""
    (small / "mapping.csv").write_text("intensity,young\n0,1\n100,5\n")
    monkeypatch.chdir(small)
    options = RunOptions(young="mapping.csv")
    (entry, _) = cohort_plan.entries_of(read_table(Path("t.tsv")), options, small / "out", ".vtu")
    assert entry.words() == (
        "--nodes=60",
        f"--young={small / 'mapping.csv'}",
        "--",
        str(small / "a.nii.gz"),
    )


def test_threads_are_of_all_subjects_and_a_volume_of_the_first_image_is_an_option(small, capsys):
    """Threads are a part of the machine; those of one subject would be passed over."""
    (small / "t.tsv").write_text("subject\timage\tthreads\n01\ta.nii.gz\t1\n")
    assert "remove the column" in refused(small, capsys)[0]
    (small / "t.tsv").write_text("subject\timage\timage_2\n01\ta.nii.gz:0\ta.nii.gz:0\n")
    assert [line.rpartition("/")[2] for line in refused(small, capsys)] == [
        "a.nii.gz:0 does not exist"
    ]


def test_files_and_places_that_cannot_be_are_all_said(small, capsys):
    """A link to nothing, an empty file, a mask where others leave the background out."""
    (small / "link.nii").symlink_to("nothing")
    (small / "empty.nii").touch()
    lines = (
        "subject\timage\tmask",
        "1\ta.nii.gz\t",
        "2\ta.nii.gz\ta.nii.gz",
        "3\tlink.nii\t",
        "4\tempty.nii\t",
    )
    (small / "t.tsv").write_text("\n".join(lines) + "\n")
    said = refused(small, capsys, "--background", "3")
    assert len(said) == 3
    for line, words in zip(said, ("line 3: --mask", "datalad get", "is empty"), strict=True):
        assert words in line


def test_each_subject_has_files_of_its_own(small, monkeypatch):
    """Though options that several share are checked once; threads are no words of a run, which
    gets its part.
    """
    monkeypatch.chdir(small)
    for name in ("s1.nii", "s2.nii", "m1.nii", "m2.nii"):
        (small / name).write_bytes(b"1")
    options = RunOptions(mask=Path("m{subject}.nii"), sizing=Path("s{subject}.nii"), threads=2)
    (small / "t.tsv").write_text("subject\timage\tmask\n1\ta.nii.gz\t\n2\ta.nii.gz\ts1.nii\n")
    first, second = cohort_plan.entries_of(
        read_table(Path("t.tsv")), options, small / "out", ".vtu"
    )
    assert [each.plan.job.sizing for each in (first, second)] == [
        small / "s1.nii",
        small / "s2.nii",
    ]
    assert [each.plan.job.mask for each in (first, second)] == [small / "m1.nii", small / "s1.nii"]
    assert second.words() == (
        f"--mask={small / 's1.nii'}",
        f"--sizing={small / 's2.nii'}",
        "--",
        str(small / "a.nii.gz"),
    )


@pytest.mark.parametrize(("only_failed", "keys"), [(False, ["b", "c", "d"]), (True, ["b"])])
def test_what_is_chosen(only_failed, keys):
    states = {"a": "done", "b": "failed", "c": "changed", "d": "missing", "e": "violated"}
    entries = [
        cohort_plan.PlannedSubject(None, key, None, SubjectState(each, ""))
        for key, each in states.items()
    ]
    assert [each.key for each in cohort_plan.choose_subjects(entries, only_failed)] == keys


def test_the_same_fault_of_many_subjects_is_said_once(small, capsys):
    said = refused(small, capsys, "--k-d", "1.5")
    assert len(said) == 1
    assert "t.tsv, line 2 and 1 more: --k-d: expected 0 <= k_D < 1, got 1.5" in said[0]
    assert (
        "unknown placeholder {sub}; use {subject} and {session}"
        in refused(small, capsys, "--mask", "m-{sub}.nii")[0]
    )
    (small / "t.tsv").write_text(
        "subject\timage\tnodes\tk-d\tuniform\n01\ta.nii.gz\tmany\t0,9\ttrue\n"
    )
    (line,) = refused(small, capsys)
    assert (
        "--nodes: expected a whole number, got 'many'; --k-d: expected a number, got '0,9'; "
        "write 0.9" in line
    )


def test_a_second_run_is_refused_before_it_plans(small, capsys, monkeypatch):
    begin(small / "out")

    def fail(*_):
        raise AssertionError("planned")

    monkeypatch.setattr(cohort_module, "subjects_of", fail)
    with lock_directory(small / "out" / ".work"):
        assert "another run is writing there" in refused(small, capsys)[0]


def test_the_table_of_what_would_be_run(small, capsys):
    options = ("--mask", f"{small}/m-{{subject}}.nii.gz")
    for name in ("01", "02"):
        (small / f"m-{name}.nii.gz").write_bytes((small / "a.nii.gz").read_bytes())
    words = [
        "cohort",
        small / "t.tsv",
        "-o",
        small / "out",
        "--write-table",
        small / "u.tsv",
        *options,
    ]
    assert exit_code(*words) == 0
    lines = (small / "u.tsv").read_text().splitlines()
    assert lines == [
        "subject\timage\tmask\tnodes",
        "01\ta.nii.gz\tm-01.nii.gz\t60",
        "02\ta.nii.gz\tm-02.nii.gz\tn/a",
    ]
    assert not (small / "out").exists()


def test_a_dry_run_tells_what_it_takes(small, capsys):
    assert exit_code("cohort", small / "t.tsv", "-o", small / "out", "--dry-run") == 0
    words = capsys.readouterr().out
    assert re.search(r"sub-01: 0\.\d+ GB\n", words)
    assert re.search(r"2 subjects, up to about 0\.\d+ GB each; \d at a time", words)
    assert not (small / "out").exists()


def test_what_is_larger_than_the_machine_takes_no_workers_from_others(monkeypatch):
    """It does not begin here; a worker of a scheduler may still have that memory."""
    monkeypatch.setattr(workers, "available_bytes", lambda: int(8e9))
    monkeypatch.setattr(estimate_module, "available_bytes", lambda: int(8e9))
    monkeypatch.setattr("dask.system.CPU_COUNT", 4)
    estimate = {"a": 2e9, "b": 1e11}
    assert estimate_module.share_for(9, estimate, CohortOptions(output=Path("out")), None) == (
        2,
        2,
        4e9,
    )


def test_the_page_of_a_run_under_way(tmp_path, monkeypatch):
    """It is written now and then: not at each subject, and again when its time has come."""
    begin(tmp_path / "out")
    assert list(cohort_module._with_pages("ab", tmp_path / "out")) == ["a", "b"]
    assert not (tmp_path / "out" / "cohort.html").exists()
    monkeypatch.setattr(cohort_module, "PAGE_SECONDS", 0.0)
    assert list(cohort_module._with_pages("ab", tmp_path / "out")) == ["a", "b"]
    assert (tmp_path / "out" / "cohort.html").exists()


def test_what_another_run_has_done_meanwhile_is_not_done_again(small, monkeypatch):
    """It may end between the plan of this one and its lock."""

    @contextmanager
    def locked(work, _keys):
        save_run(
            work.parent,
            "sub-01",
            {"request": {"options": {}, "files": {}, "sha256": "1"}, "violated": {}},
        )
        yield

    keys = []
    monkeypatch.setattr(cohort_module, "lock_directory", locked)
    monkeypatch.setattr(cohort_plan, "job_request", lambda *_: {"sha256": "1"})
    monkeypatch.setattr(cohort_module, "estimate_memory", lambda _: {})
    monkeypatch.setattr(
        cohort_module, "_run", lambda _, to_run: keys.extend(entry.key for entry in to_run)
    )
    exit_code("cohort", small / "t.tsv", "-o", small / "out")
    assert keys == ["sub-02"]
