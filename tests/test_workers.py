"""Workers of dask and their tasks: how many, whose, what a death of one costs, and what is
refused.
"""

import os
import signal
import socket
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import dask.system
import psutil
import pytest
from commands import assert_refuses
from distributed import LocalCluster
from models import sample_image

from tetopt import workers as module
from tetopt.errors import InputError
from tetopt.io.images import save_image
from tetopt.system.interpreter import python_command, python_environment
from tetopt.workers import (
    SchedulerLost,
    Share,
    UnfitWorker,
    WorkerEnded,
    check_workers,
    memory_limit,
    run_tasks,
    share_of,
    workers,
)

GB = 1e9
LIMIT = 0.4e9  # of a worker, which has 0.1 GB
# Of a cluster of somebody else's, without processes of its own.
IN_PROCESS = {
    "processes": False,
    "protocol": "tcp://",
    "dashboard_address": "127.0.0.1:0",
    "silence_logs": 50,
}


@pytest.mark.parametrize(
    ("n_tasks", "need", "count", "threads", "cores", "free", "expected"),  # GB
    [
        (100, 0.1, None, None, 8, 80, (8, 1, 10)),  # cores
        (100, 3, None, None, 8, 12, (4, 2, 3)),  # memory
        (3, 3, None, None, 8, 90, (3, 2, 30)),  # tasks
        (100, 3, 2, None, 8, 90, (2, 4, 45)),  # count
        (100, 3, None, 4, 8, 90, (2, 4, 45)),  # threads of each
        (100, 20, 5, None, 2, 11, (1, 2, 11)),  # none fits: one
    ],
)
def test_as_many_workers_as_cores_memory_and_tasks_allow(
    n_tasks, need, count, threads, cores, free, expected, monkeypatch
):
    monkeypatch.setattr(dask.system, "CPU_COUNT", cores)
    monkeypatch.setattr(module, "available_bytes", lambda: int(free * GB))
    share = share_of(n_tasks, need * GB, count, threads)
    assert (*share[:2], share[2] / GB) == expected


# ---- Here


@pytest.fixture(scope="module")
def pool():
    """Two workers of three threads and 0.4 GB."""
    with workers(Share(2, 3, LIMIT), None, None) as some:
        yield some


@pytest.fixture
def run(pool, tmp_path):
    """A function that runs tasks on them: their results or errors by name."""
    pool.client.wait_for_workers(2, timeout=60)  # one of the test before may be starting again

    def outcomes(function, names):
        return {
            name: error or done
            for name, done, error in run_tasks(pool, function, names, str(tmp_path))
        }

    return outcomes


def processes():
    """Those that this process has started, and that have not ended."""
    children = psutil.Process().children()
    return {each.pid for each in children if each.status() != psutil.STATUS_ZOMBIE}


def settings(name):
    return name, os.environ["NUMBA_NUM_THREADS"], memory_limit()


@pytest.mark.deep
def test_workers_here_have_their_threads_and_memory_and_leave_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "7")  # of the user's own, for this process
    before = processes()
    with workers(Share(1, 3, LIMIT), None, None) as one:
        assert one.words() == "1 task at a time, each of 3 threads"
        assert one.client.scheduler.address.split("://")[1].startswith("127.0.0.1:")
        ended = list(run_tasks(one, settings, list("bca"), str(tmp_path)))
    # in their order
    assert [done for _, done, _ in ended] == [(name, "3", LIMIT) for name in "bca"]
    assert not any(
        "spawn_main" in " ".join(psutil.Process(pid).cmdline()) for pid in processes() - before
    )
    assert capfd.readouterr() == ("", "")


@pytest.mark.full
def test_other_users_of_the_machine_are_kept_out():
    pytest.importorskip("cryptography")
    with workers(Share(1, 1, LIMIT), None, None) as one:
        address = one.client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        with pytest.raises(InputError, match="does not answer"):
            check_workers(None, address)


def begun(folder, name):
    """Leaves one more file for each time that it is begun; how many there were."""
    count = len(list(folder.glob(f"{name}.*")))
    (folder / f"{name}.{count}").touch()
    return count


def deadly(folder, n_deaths, name):
    if begun(folder, name) < n_deaths and name == "b":
        os.kill(os.getpid(), signal.SIGKILL)
    if name == "error":
        raise KeyError("of a programmer")
    return name


@pytest.mark.deep
def test_a_task_whose_worker_dies_is_run_again(run, tmp_path, capfd):
    ended = run(partial(deadly, tmp_path, 1), list("abc"))
    assert ended == {"a": "a", "b": "b", "c": "c"}
    assert {path.name for path in tmp_path.glob("b.*")} == {"b.0", "b.1"}
    assert capfd.readouterr() == ("", "")


@pytest.mark.deep
def test_a_task_that_ends_its_workers_or_fails_takes_no_others_with_it(run, tmp_path, capfd):
    ended = run(partial(deadly, tmp_path, 9), ["a", "b", "error", *"cdef"])
    error = ended.pop("b")
    assert isinstance(ended.pop("error"), KeyError)
    assert ended == {name: name for name in "acdef"}
    assert isinstance(error, WorkerEnded)
    assert len(list(tmp_path.glob("b.*"))) == 2
    assert (
        str(error) == "its worker ended, 2 times, possibly because it exceeded its limit of 0.4 GB"
    )
    assert capfd.readouterr() == ("", "")


def filling(_name):
    """Takes the limit little by little."""
    kept = []
    for _ in range(100):
        kept.append(bytearray(b"1" * 10**7))
        time.sleep(0.02)
    time.sleep(5)


@pytest.mark.deep
def test_a_worker_over_its_limit_is_ended_and_the_limit_named(run):
    (ended,) = run(filling, ["p"]).values()
    assert str(ended) == "its worker ended, 2 times, because it exceeded its limit of 0.4 GB"


@pytest.mark.deep
def test_nothing_is_left_of_a_client_that_is_killed(tmp_path):
    program = (
        "import sys, time; from pathlib import Path; from tetopt.workers import *\n"
        "def task(mark): mark.touch(); time.sleep(100)\n"
        "if __name__ == '__main__':\n"
        "    one = Path(sys.argv[1])\n"
        "    with workers(Share(2, 1, 4e8), None, None) as pool:\n"
        "        for each in run_tasks(pool, task, [one / 'mark'], str(one)): pass\n"
    )
    (tmp_path / "client.py").write_text(program)
    command = python_command(str(tmp_path / "client.py"), str(tmp_path))
    with subprocess.Popen(command, env=python_environment(), start_new_session=True) as client:
        end = time.monotonic() + 60
        while not (tmp_path / "mark").exists():
            assert time.monotonic() < end
            time.sleep(0.05)
        client.kill()
        client.wait()
        while left := of_session(client.pid):
            assert time.monotonic() < end, left
            time.sleep(0.1)


def of_session(number):
    rows = subprocess.run(
        ["ps", "-eo", "sess=,stat=,args="], capture_output=True, text=True, check=True
    ).stdout
    return [
        row
        for row in rows.splitlines()
        if row.split()[0] == str(number) and not row.split()[1].startswith("Z")
    ]


# ---- A scheduler that runs


@pytest.fixture(scope="module")
def others():
    """A cluster of somebody else's, within this process: 2 workers with 8 GB each."""
    with LocalCluster(
        n_workers=2, threads_per_worker=1, memory_limit="8GB", **IN_PROCESS
    ) as cluster:
        yield cluster


NOTHING = Share(1, 1, 0.0)  # of this machine


def limit_of(_name):
    return memory_limit()


def test_workers_of_a_scheduler_that_runs(others, tmp_path):
    with workers(NOTHING, others.scheduler.address, None) as pool:
        assert (pool.slots(), pool.threads) == (2, 1)
        ended = run_tasks(pool, limit_of, range(9), str(tmp_path))
        assert [each for _, each, _ in ended] == [8 * GB] * 9
    with workers(NOTHING, others.scheduler.address, 3) as pool:
        assert pool.words() == "2 tasks at a time, each of 3 threads"
    assert len(others.scheduler.workers) == 2  # they go on
    assert memory_limit() == float("inf")


def test_workers_that_cannot_run_tasks_are_refused(others, tmp_path, monkeypatch):
    """Each at its first task, as workers come and go."""

    def assert_unfit(pool, words, folder=tmp_path):
        with pytest.raises(UnfitWorker, match=words):
            list(run_tasks(pool, limit_of, "a", str(folder)))

    with workers(NOTHING, others.scheduler.address, None) as pool:
        words = r"cannot access .*no; expected an output folder on a file system that"
        assert_unfit(pool, words, tmp_path / "no")
        versions = iter(["tetopt 9 and Python 3.11", "tetopt 8 and Python 3.11"])
        monkeypatch.setattr(module, "_versions", lambda: next(versions, "tetopt 8 and Python 3.11"))
        assert_unfit(pool, r"expected tetopt 9 and Python 3.11 as here, got tetopt 8 and")
    with (
        LocalCluster(n_workers=1, threads_per_worker=2, **IN_PROCESS) as cluster,
        workers(NOTHING, cluster.scheduler.address, None) as pool,
    ):
        assert_unfit(pool, r"expected one task at a time, got 2; .* --nthreads 1 --nworkers 2")


def test_tasks_wait_for_workers_and_a_lost_scheduler_is_said(tmp_path):
    """Jobs of a batch system come after hours."""
    with (
        LocalCluster(n_workers=0, threads_per_worker=1, **IN_PROCESS) as cluster,
        workers(NOTHING, cluster.scheduler.address, None) as pool,
    ):
        assert pool.slots() == 0
        with ThreadPoolExecutor(1) as executor:
            tasks = executor.submit(lambda: list(run_tasks(pool, limit_of, "ab", str(tmp_path))))
            time.sleep(0.3)
            assert not tasks.done()
            cluster.scale(1)
            assert len(tasks.result(timeout=60)) == 2
        ended = run_tasks(pool, time.sleep, [0.0, 2.0, 2.0, 2.0], str(tmp_path))
        assert next(ended) == (0.0, None, None)
        cluster.close()
        with pytest.raises(SchedulerLost, match="no longer answers"):
            next(ended)


def assert_no_scheduler(address, capfd):
    """One line says that it does not answer."""
    with pytest.raises(InputError, match=f"^`scheduler`: {address} does not answer") as refusal:
        check_workers(None, address)
    assert "\n" not in str(refusal.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://x", ""])
def test_a_scheduler_that_does_not_answer_is_refused_in_one_line(address, monkeypatch, capfd):
    monkeypatch.setattr(module, "CONNECT_SECONDS", 0.2)
    assert_no_scheduler(address, capfd)


def test_another_service_at_the_address_is_no_scheduler(capfd):
    """The first eight bytes of its answer, read as a length, are more than any memory."""

    def answer():
        connection, _ = server.accept()
        with connection:
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n" + bytes(1000))
            connection.recv(10**6)

    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as executor:
        server.settimeout(10)
        executor.submit(answer)
        assert_no_scheduler(f"tcp://127.0.0.1:{server.getsockname()[1]}", capfd)


COHORT = "cohort t.tsv -o out --nodes 60"


@pytest.mark.full
def test_a_scheduler_that_says_nothing_is_refused_before_images_are_read(here, monkeypatch):
    monkeypatch.setattr(module, "CONNECT_SECONDS", 0.3)
    Path("t.tsv").write_text("task\timage\n1\tnone.nii\n")
    with socket.create_server(("127.0.0.1", 0)) as server:  # takes connections
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        words = f"--scheduler: {address} does not answer (no reply of dask's within 0.3 s)"
        assert_refuses(f"{COHORT} --scheduler {address}", words)


def test_what_is_missing_or_contradictory_is_said_before_anything_is_written(here, monkeypatch):
    save_image("a.nii.gz", sample_image(3))
    Path("t.tsv").write_text("task\timage\n1\ta.nii.gz\n")
    words = "--workers: expected none with --scheduler"
    assert_refuses(f"{COHORT} --scheduler tcp://127.0.0.1:1 --workers 2", words)
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    words = "distributed is not installed, but dask needs it to run tasks; pip install"
    assert_refuses(COHORT, f'{words} "distributed"')
