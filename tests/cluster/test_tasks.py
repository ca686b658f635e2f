"""Tasks that workers run themselves: again where a worker dies, within limits, with their errors in one line."""

import ctypes
import errno
import mmap
import os
import signal
import subprocess
import sys
import time
from functools import partial

import numba
import numpy as np
import pytest

from tetopt.cluster.crew import Folders, Need
from tetopt.cluster.tasks import SchedulerLost, run_tasks
from tetopt.cluster.workers import workers
from tetopt.errors import InputError
from tetopt.system.budget import PROC_FOLDER
from tetopt.system.interpreter import python_command, python_environment

pytestmark = pytest.mark.full
LIMIT = 0.8e9  # of a worker, which has 0.24 GB with numba loaded


@pytest.fixture(scope="module")
def crew(tmp_path_factory):
    """Two workers of one thread and 0.8 GB."""
    folders = Folders(*(tmp_path_factory.mktemp(name) for name in ("work", "logs")))
    need = Need(9, 0.0, 1, is_within=True, most_bytes=LIMIT)
    with workers(need, folders, count=2, scheduler=None, cluster=None) as some:
        yield some


@pytest.fixture
def run(crew):
    """A function that runs tasks on them: what is done, by name."""

    crew.client.wait_for_workers(2, timeout=60)  # one of the test before may be starting again

    def all_done(function, names, **options):
        return {done.name: done for done in run_tasks(crew, function, names, **options)}

    return all_done


def threads(_name):
    return numba.config.NUMBA_NUM_THREADS, numba.get_num_threads(), os.environ.get("OPENBLAS_NUM_THREADS")


def test_each_name_is_run_with_its_part_of_the_threads_and_measured(run, crew, monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "7")  # of the user's own, for this process
    done = run(threads, list("abcd"))
    assert {name: each.result[:2] for name, each in done.items()} == dict.fromkeys("abcd", (1, 1))
    assert {each.worker for each in done.values()} <= set(crew.client.nthreads())
    if PROC_FOLDER.exists():
        assert all(5e7 < each.peak_bytes < LIMIT for each in done.values())


def test_threads_are_those_of_the_environment_though_numba_was_loaded_before_it_was_set():
    """A main program that loads kernels is loaded in workers, too, before their environment is set."""
    program = (
        "import os, numba; os.environ['NUMBA_NUM_THREADS'] = '1'\n"
        "from tetopt.cluster.tasks import limit_threads; limit_threads(2)\n"
        "numba.njit(lambda: 0)(); print(numba.config.NUMBA_NUM_THREADS, numba.get_num_threads())\n"
    )
    environment = {name: text for name, text in python_environment().items() if name != "NUMBA_NUM_THREADS"}
    answer = subprocess.run(python_command("-c", program), env=environment, capture_output=True, text=True, check=True)
    assert answer.stdout == "1 1\n"


def death_signal():
    """Of the thread that asks: that in which workers begin."""
    number = ctypes.c_int()
    ctypes.CDLL(None).prctl(2, ctypes.byref(number))  # PR_GET_PDEATHSIG
    return number.value


@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's")
def test_the_system_ends_a_worker_with_its_nanny(run, crew):
    assert set(crew.client.run(death_signal).values()) == {signal.SIGKILL}


def begun(folder, name):
    """Leaves one more file for each time that it is begun; how many there were."""
    count = len(list(folder.glob(f"{name}.*")))
    (folder / f"{name}.{count}").touch()
    return count


def deadly(folder, n_deaths, name):
    if begun(folder, name) < n_deaths and name == "b":
        os.kill(os.getpid(), signal.SIGKILL)
    return name


@pytest.mark.deep
def test_what_a_killed_worker_took_with_it_is_run_again(run, tmp_path):
    done = run(partial(deadly, tmp_path, 2), list("abc"))
    assert {name: each.result for name, each in done.items()} == {"a": "a", "b": "b", "c": "c"}
    names = {path.name for path in tmp_path.iterdir()}
    assert {name for name in names if name[0] == "b"} == {"b.0", "b.1", "b.2"}
    # Others begin again only if they were on a worker that died: at most once for each of the two deaths.
    others = names - {"b.0", "b.1", "b.2"}
    assert {"a.0", "c.0"} <= others <= {f"{name}.{count}" for name in "ac" for count in range(3)}


@pytest.mark.deep
def test_what_ends_its_worker_three_times_is_said_in_a_line(run, tmp_path):
    with pytest.raises(InputError, match=r"^b: its worker ended, 3 times, possibly because") as refusal:
        run(partial(deadly, tmp_path, 9), list("abc"))
    assert "\n" not in str(refusal.value)
    assert len(list(tmp_path.glob("b.*"))) == 3


def failing(folder, error, name):
    begun(folder, name)
    raise error


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (InputError("part 3: expected this, got that"), InputError, "^part 3: expected this, got that$"),
        (KeyError("of a programmer"), KeyError, "of a programmer"),
        (OSError(errno.ENOSPC, "No space left on device", "x\x1b"), InputError, r"^p.1: .*No space left.*free some"),
        (OSError(errno.EACCES, "Permission denied", "x"), PermissionError, "Permission denied"),
        (
            MemoryError(),
            InputError,
            r"^p.1: needs, with its worker, more memory than a worker's limit of 0.8 GB \(an alloc",
        ),
    ],
)
def test_an_error_of_the_function_is_the_clients_at_once(error, kind, words, run, tmp_path):
    with pytest.raises(kind, match=words) as refusal:
        run(partial(failing, tmp_path, error), ["p.1"])
    assert "\x1b" not in str(refusal.value) or kind is not InputError
    assert len(list(tmp_path.iterdir())) == 1


def asking(folder, name):
    """Asks for as much as the limit, which its worker has a part of already."""
    begun(folder, name)
    return np.empty(int(LIMIT)).nbytes


@pytest.mark.skipif(not PROC_FOLDER.exists(), reason="RLIMIT_DATA is Linux's")
def test_more_memory_than_a_worker_may_take_is_refused_where_it_is_asked_for(run, crew, tmp_path):
    """In a line that names the limit, and the worker goes on."""
    before = set(crew.client.nthreads())
    with pytest.raises(
        InputError,
        match=r"^p: needs, with its worker, more memory than a worker's limit of 0.8 GB \(Unable to",
    ):
        run(partial(asking, tmp_path), ["p"])
    assert before <= set(crew.client.nthreads())
    assert len(list(tmp_path.iterdir())) == 1


def filling(folder, name):
    """Takes the limit little by little, as pages that are shared, which the system does not count as data."""
    begun(folder, name)
    pages = mmap.mmap(-1, int(LIMIT))
    while pages.tell() < LIMIT:
        pages.write(bytes(10**7))
        time.sleep(0.02)
    time.sleep(5)


@pytest.mark.deep
def test_a_worker_over_its_limit_is_ended_by_its_nanny_and_the_limit_named(run, tmp_path):
    with pytest.raises(
        InputError, match=r"^p: needs, with its worker, more memory than a worker's limit of 0.8 GB; give"
    ):
        run(partial(filling, tmp_path), ["p"], attempts=1)
    assert len(list(tmp_path.iterdir())) == 1


def appeared(path):
    """Wait for a file, a minute at most."""
    end = time.monotonic() + 60
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.02)


def waiting(folder, name):
    """The short one ends once the long one has begun, which ends with the test."""
    (folder / name).touch()
    appeared(folder / {"short": "long", "long": "end"}[name])
    return name


def test_once_it_is_over_nothing_begins_and_the_last_are_waited_for(run, tmp_path):
    done = run(
        partial(waiting, tmp_path), ["short", "long", "c", "d"], last_seconds=5,
        is_over=lambda: len(list(tmp_path.iterdir())) == 2,
    )  # fmt: skip
    assert list(done) == ["short"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["long", "short"]
    (tmp_path / "end").touch()


@pytest.mark.deep
def test_a_scheduler_that_is_lost_is_said_so(tmp_path):
    folders = Folders(tmp_path, tmp_path)
    with workers(Need(1, 0.0, 1, is_within=True), folders, count=1, scheduler=None, cluster=None) as crew:
        begun_tasks = run_tasks(crew, time.sleep, [0.0, 0.0])
        assert next(begun_tasks).name == 0.0
        crew.client.close()
        with pytest.raises(SchedulerLost, match="no longer answers"):
            next(begun_tasks)
