"""`tetopt cohort` as a user runs it: interrupted, a worker killed, resumed, changed; nothing
lost or done twice.
"""

import csv
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import chdir, contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest
from cohorts import save_failure, save_run
from commands import exit_code, files_here, in_copy_of, numbers_in

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
COHORT = "cohort t.tsv -o out"
REQUEST = {"options": {}, "files": {}, "sha256": "1"}


def meshes():
    """The subjects' meshes that are there, with when they were written."""
    return {
        path.parent.name: path.stat().st_mtime_ns
        for path in sorted(Path("out").glob("sub-*/*.vtu"))
    }


def statuses(name="status"):
    with open("out/cohort.tsv", newline="") as stream:
        return {row["participant_id"]: row[name] for row in csv.DictReader(stream, delimiter="\t")}


def write_table(*rows, columns="subject image labels nodes"):
    lines = ["\t".join(row.split()) for row in (columns, *rows)]
    Path("t.tsv").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """An image and a table of two subjects with it."""
    with chdir(tmp_path_factory.mktemp("small")):
        assert exit_code("phantom sphere -o a.nii.gz --voxel-mm 6") == 0
        write_table("01 a.nii.gz 60", "02 a.nii.gz n/a", columns="subject image nodes")
        return Path.cwd()


here = in_copy_of("small")


@pytest.mark.full
def test_a_cohort_from_python_is_that_of_the_command():
    """The same folder: a rerun by either finds all done. What is no option, or no value of one,
    is refused at once.
    """
    table, out, events = Path("t.tsv"), Path("out"), []
    one = {"participants": ["01"], "iterations": 0, "on": events.append}
    assert tetopt.run_cohort(table, out, workers=1, **one) == {"sub-01": "done"}
    there = meshes()
    assert exit_code(COHORT, "--iterations 0 --participant-label 01") == 0
    assert meshes() == there
    tetopt.run_cohort(table, "out", **one, dry_run=True)
    assert events[-1] == ("note", "1 subject: 1 done; 0 to run", None)
    for wrong, words in (
        ({"noodes": 3}, "unknown option 'noodes'; did you mean nodes"),
        ({"nodes": "many"}, "^`nodes`: expected a whole number, got 'many'"),
    ):
        with pytest.raises(InputError, match=words):
            tetopt.run_cohort(table, out, **wrong)


def test_what_failed_is_a_row_and_a_rerun_would_make_what_changed_and_what_failed(capfd, scheduler):
    """Labels on another grid are taken to the image's."""
    image = tetopt.load_image("a.nii.gz")
    inside, far = 1.0 * (image.data > 50), np.array(image.affine)
    far[:3, 3] += 500.0
    coarse = image.affine @ np.diag([2.0, 2.0, 2.0, 1.0])
    tetopt.save_image("far.nii.gz", tetopt.Image(inside, far))
    tetopt.save_image("coarse.nii.gz", tetopt.Image(inside[::2, ::2, ::2], coarse))
    Path("cut.nii.gz").write_bytes(Path("a.nii.gz").read_bytes()[:300])
    command = f"{COHORT} --iterations 0 --nodes 300 --scheduler {scheduler}"
    write_table(
        "01 a.nii.gz coarse.nii.gz n/a 31 f",
        "02 cut.nii.gz n/a n/a 32.5 m",
        "03 a.nii.gz far.nii.gz n/a n/a f",
        "04 a.nii.gz no.nii.gz n/a 034 m",
        columns="subject image labels nodes age site",
    )
    capfd.readouterr()
    assert exit_code(command) == 1
    said = " ".join(capfd.readouterr().err.split())
    assert said.count("age, site") == 1
    assert re.search(r"line 5: labels: \S*no.nii.gz does not exist", said)
    failed = {f"sub-0{number}": "failed" for number in (2, 3, 4)}
    assert statuses() == {"sub-01": "done"} | failed
    assert list(statuses("table.age").values()) == ["31", "32.5", "n/a", "034"]
    assert list(statuses("table.site").values()) == ["f", "m", "f", "m"]
    logs, page = Path("out/logs"), Path("out/cohort.html").read_text()
    assert "resampled to the image's grid" in " ".join((logs / "sub-01.log").read_text().split())
    assert '"table.age"' in page
    for name, file in zip(failed, ("cut.nii.gz", "far.nii.gz", "no.nii.gz"), strict=True):
        failure = numbers_in(logs / f"{name}.failed.json")
        reason = failure["reason"]
        assert failure["command"].startswith(f"tetopt mesh -o {name}.vtu --")
        assert file in statuses("reason")[name] == reason in (logs / f"{name}.log").read_text()
        assert name in page
    assert list(meshes()) == ["sub-01"]
    # One has other options by now, one a whole image.
    write_table(
        "01 a.nii.gz coarse.nii.gz 320", "02 a.nii.gz n/a n/a", "03 a.nii.gz far.nii.gz n/a"
    )
    capfd.readouterr()
    assert exit_code(command, "--dry-run") == 0
    assert "1 changed: nodes was 300, now 320" in capfd.readouterr().err
    assert exit_code(command, "--dry-run --retry-failed") == 0
    said = capfd.readouterr()
    assert "1 subjects are out of date" in said.err
    assert "sub-02: " in said.out
    assert "sub-01: " not in said.out


def test_a_failure_is_forgotten_where_the_mesh_is_what_is_asked_for(monkeypatch, capfd):
    """Options that fail, and then those again of the mesh that is there: it is done, though
    nothing is run.
    """
    monkeypatch.setattr(cohort_plan, "job_request", lambda *_: REQUEST)
    begin(Path("out"))
    save_run(Path("out"), "sub-01", {"request": REQUEST, "violated": {}})
    save_failure(Path("out"), "sub-01", "too few nodes")
    assert exit_code(COHORT, "--participant-label 01") == 0
    assert "1 subject: 1 done; 0 to run" in capfd.readouterr().err
    assert statuses()["sub-01"] == "done"


def words_of_run():
    return Path("words.txt").read_text()


def workers_of(run):
    """Numbers of the processes of a run's workers."""
    return [
        child.pid
        for child in psutil.Process(run.pid).children()
        if "spawn_main" in " ".join(child.cmdline())
    ]


def begin_run(n_meshes, **options):
    """A run that has begun and has so many meshes, its words in a file."""
    command = [sys.executable, "-m", "tetopt", *f"{COHORT} --iterations 1 --nodes 60".split()]
    with open("words.txt", "w") as stream:
        run = subprocess.Popen(command, stdout=stream, stderr=stream, **options)
    end = time.monotonic() + WAIT_SECONDS
    while len(meshes()) < n_meshes:
        assert run.poll() is None, words_of_run()
        assert time.monotonic() < end, "no mesh in time"
        time.sleep(0.05)
    return run


@pytest.mark.deep
def test_ctrl_c_keeps_what_is_done_and_a_rerun_does_the_rest_though_a_worker_dies():
    write_table(*(f"0{number} a.nii.gz n/a n/a" for number in range(1, 6)))
    run = begin_run(1)
    run.send_signal(signal.SIGINT)
    assert run.wait(WAIT_SECONDS) == 130
    first = meshes()
    assert 1 <= len(first) < 5
    assert "to run only" in words_of_run()
    assert "Traceback" not in words_of_run()
    assert os.listdir("out/.work") == ["tetopt-lock"]
    run = begin_run(len(first) + 1)
    # of the workers, whose child is a run of `tetopt mesh`, or could be
    os.kill(workers_of(run)[0], signal.SIGKILL)
    assert run.wait(WAIT_SECONDS) == 0, words_of_run()
    second = meshes()
    assert list(second) == [f"sub-0{number}" for number in range(1, 6)]
    assert first.items() <= second.items()  # none is made again
    assert f"5 subjects: {len(first)} done" in words_of_run()


@pytest.mark.deep
def test_ctrl_c_while_workers_begin_is_one_line():
    """A terminal sends it to all processes at once."""
    run = begin_run(0, start_new_session=True)
    while not workers_of(run):
        assert run.poll() is None, words_of_run()
    os.killpg(run.pid, signal.SIGINT)
    assert run.wait(WAIT_SECONDS) == 130
    assert "Traceback" not in words_of_run()


def refused(capsys, options=""):
    """The lines by which a cohort is refused, and that nothing was made."""
    before = files_here()
    assert exit_code(COHORT, options) == 2
    assert files_here() == before
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("tetopt: ")]


def test_all_that_is_wrong_is_said_before_anything_is_run(capsys):
    write_table(
        "01 a.nii.gz -4 n/a n/a n/a",
        "02 b.nii.gz n/a n/a n/a n/a",
        "03 a.nii.gz many n/a n/a n/a",
        "0-1 a.nii.gz n/a n/a n/a n/a",
        "05 a.nii.gz n/a m.nii n/a n/a",
        "06 a.nii.gz n/a n/a 5 n/a",
        "07 a.nii.gz n/a n/a n/a 1.5",
        "08 a.nii.gz 60 n/a n/a 0.5",
        columns="subject image nodes mask nods k-d",
    )
    said = refused(capsys)
    places = [re.match(r"tetopt: t\.tsv, line (\d+): ", line) for line in said]
    assert sorted(int(place[1]) for place in places if place) == [2, 3, 4, 5, 6, 7, 8]
    assert any("nods" in line and "did you mean nodes?" in line for line in said)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--threads 0", "--threads: expected 1 or more"),
        ("--format docx", "--format: expected one of"),
        ("--mask m-{subject}.nii", "m-01.nii does not exist"),
        ("--mask m-{sub}.nii", "unknown placeholder {sub}; use {subject} and {session}"),
        ("--participant-label 9", "has no subject 9"),
        ("--mask a.nii.gz --background 3", "give only one of them"),
        ("--k-d 1.5", "t.tsv, line 2 and 1 more: --k-d: expected 0 <= k_D < 1, got 1.5"),
    ],
)
def test_options_of_all_that_cannot_be_are_refused(capsys, options, words):
    """The same fault of many subjects is said once."""
    assert sum(words in line for line in refused(capsys, options)) == 1


def entries_of(options):
    return cohort_plan.entries_of(read_table(Path("t.tsv")), options, Path("out"), ".vtu")


def test_words_of_a_run_mean_the_same_in_any_folder():
    """A worker of a scheduler that others started may be in another one."""
    Path("mapping.csv").write_text("intensity,young\n0,1\n100,5\n")
    entry, _ = entries_of(RunOptions(young="mapping.csv"))
    words = f"--nodes=60 --young={Path.cwd()}/mapping.csv -- {Path.cwd()}/a.nii.gz"
    assert " ".join(entry.words()) == words


def test_threads_are_of_all_subjects_and_a_volume_of_the_first_image_is_an_option(capsys):
    """Threads are a part of the machine; those of one subject would be passed over."""
    write_table("01 a.nii.gz 1", columns="subject image threads")
    assert "remove the column" in refused(capsys)[0]
    write_table("01 a.nii.gz:0 a.nii.gz:0", columns="subject image image_2")
    (line,) = refused(capsys)
    assert line.endswith("a.nii.gz:0 does not exist")


def test_files_and_places_that_cannot_be_are_all_said(capsys):
    """A link to nothing, an empty file, a mask where others leave the background out."""
    Path("link.nii").symlink_to("nothing")
    Path("empty.nii").touch()
    rows = "1 a.nii.gz n/a", "2 a.nii.gz a.nii.gz", "3 link.nii n/a", "4 empty.nii n/a"
    write_table(*rows, columns="subject image mask")
    said = refused(capsys, "--background 3")
    for line, words in zip(said, ("line 3: --mask", "datalad get", "is empty"), strict=True):
        assert words in line


def test_each_subject_has_files_of_its_own():
    """Though options that several share are checked once; threads are no words of a run, which
    gets its part.
    """
    for name in ("s1.nii", "s2.nii", "m1.nii", "m2.nii"):
        Path(name).write_bytes(b"1")
    write_table("1 a.nii.gz n/a", "2 a.nii.gz s1.nii", columns="subject image mask")
    files = {"mask": Path("m{subject}.nii"), "sizing": Path("s{subject}.nii")}
    first, second = entries_of(RunOptions(**files, threads=2))
    for entry, mask, sizing in ((first, "m1.nii", "s1.nii"), (second, "s1.nii", "s2.nii")):
        assert entry.plan.job.mask == Path(mask).absolute()
        assert entry.plan.job.sizing == Path(sizing).absolute()
    here = Path.cwd()
    words = f"--mask={here}/s1.nii --sizing={here}/s2.nii -- {here}/a.nii.gz"
    assert " ".join(second.words()) == words


@pytest.mark.parametrize(("only_failed", "keys"), [(False, ["b", "c", "d"]), (True, ["b"])])
def test_what_is_chosen(only_failed, keys):
    states = {"a": "done", "b": "failed", "c": "changed", "d": "missing", "e": "violated"}
    entries = [
        cohort_plan.PlannedSubject(None, key, None, SubjectState(each, ""))
        for key, each in states.items()
    ]
    assert [each.key for each in cohort_plan.choose_subjects(entries, only_failed)] == keys


def test_all_that_is_wrong_with_a_subject_is_one_line(capsys):
    write_table("01 a.nii.gz many 0,9 true", columns="subject image nodes k-d uniform")
    (line,) = refused(capsys)
    words = "--nodes: expected a whole number, got 'many'; --k-d: expected a number, got '0,9'; "
    assert f"{words}write 0.9" in line


def test_a_second_run_is_refused_before_it_plans(capsys, monkeypatch):
    begin(Path("out"))
    monkeypatch.delattr(cohort_module, "subjects_of")
    with lock_directory(Path("out/.work"), None):
        assert "another run is writing there" in refused(capsys)[0]


def test_the_table_of_what_would_be_run():
    for name in ("01", "02"):
        Path(f"m-{name}.nii.gz").write_bytes(Path("a.nii.gz").read_bytes())
    assert exit_code(COHORT, "--write-table u.tsv --mask m-{subject}.nii.gz") == 0
    assert Path("u.tsv").read_text().splitlines() == [
        "subject\timage\tmask\tnodes",
        "01\ta.nii.gz\tm-01.nii.gz\t60",
        "02\ta.nii.gz\tm-02.nii.gz\tn/a",
    ]
    assert not Path("out").exists()


def test_a_dry_run_tells_what_it_takes(capsys):
    assert exit_code(COHORT, "--dry-run") == 0
    words = capsys.readouterr().out
    assert re.search(r"sub-01: 0\.\d+ GB\n", words)
    assert re.search(r"2 subjects, up to about 0\.\d+ GB each; \d at a time", words)
    assert not Path("out").exists()


def test_what_is_larger_than_the_machine_takes_no_workers_from_others(monkeypatch):
    """It does not begin here; a worker of a scheduler may still have that memory."""
    monkeypatch.setattr(workers, "available_bytes", lambda: int(8e9))
    monkeypatch.setattr(estimate_module, "available_bytes", lambda: int(8e9))
    monkeypatch.setattr("dask.system.CPU_COUNT", 4)
    cohort = CohortOptions(output=Path("out"))
    assert estimate_module.share_for(9, {"a": 2e9, "b": 1e11}, cohort, None) == (2, 2, 4e9)


def test_the_page_of_a_run_under_way(monkeypatch):
    """It is written now and then: not at each subject, and again when its time has come."""
    begin(Path("out"))
    for is_due in (False, True):
        assert list(cohort_module._with_pages("ab", Path("out"))) == ["a", "b"]
        assert Path("out/cohort.html").exists() == is_due
        monkeypatch.setattr(cohort_module, "PAGE_SECONDS", 0.0)


def test_what_another_run_has_done_meanwhile_is_not_done_again(monkeypatch):
    """It may end between the plan of this one and its lock."""

    @contextmanager
    def locked(work, _keys):
        save_run(work.parent, "sub-01", {"request": REQUEST, "violated": {}})
        yield

    keys = []
    monkeypatch.setattr(cohort_module, "lock_directory", locked)
    monkeypatch.setattr(cohort_plan, "job_request", lambda *_: REQUEST)
    monkeypatch.setattr(cohort_module, "estimate_memory", lambda _: {})
    monkeypatch.setattr(
        cohort_module, "_run", lambda _, to_run: keys.extend(entry.key for entry in to_run)
    )
    exit_code(COHORT)
    assert keys == ["sub-02"]
