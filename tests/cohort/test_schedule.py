"""The loop of tasks in flight: without processes, each future's end and each number of slots as a test says."""

import json
import threading
import time

import distributed
import pytest
from distributed import Client, KilledWorker, LocalCluster

from tetopt.cluster import tasks
from tetopt.cluster.tasks import SchedulerLost
from tetopt.cohort.layout import begin, failure_path
from tetopt.cohort.run import Ended, SubjectTask
from tetopt.cohort.schedule import run_all

GB = 1e9


class Future:
    """One that ends when the client lets it."""

    def __init__(self, key, end):
        self.key, self.end, self.status = key, end, "pending"

    def result(self):
        return self.end

    def exception(self):
        return self.end


class FakeClient:
    """Ends of tasks by key and attempt; each look at them ends those in flight, the first or all."""

    def __init__(self, ends=None, is_one_by_one=False):
        self.ends, self.is_one_by_one = ends or {}, is_one_by_one
        self.status, self.submitted, self.pending, self.most = "running", [], [], 0

    def submit(self, task, job, key, pure):
        assert not pure
        self.submitted.append(key)
        attempt = int(key.rpartition("-")[2])
        future = Future(key, self.ends.get((job.key, attempt), Ended(job.key, "done", "", 1.0, 0)))
        self.pending.append(future)
        self.most = max(self.most, len(self.pending))
        return future

    def wait(self, futures, timeout, return_when):
        assert futures, "nothing to wait for"
        assert return_when == "FIRST_COMPLETED"
        for future in self.pending[: 1 if self.is_one_by_one else None]:
            if future.end == "lost":
                self.status = "connecting"
                future.status = "cancelled"
            elif isinstance(future.end, Ended):
                future.status = "finished"
            else:
                future.status = "cancelled" if future.end == "cancelled" else "error"
            self.pending.remove(future)
            if future.status == "cancelled":
                raise distributed.CancelledError


@pytest.fixture
def play(tmp_path, monkeypatch):
    """A function that runs subjects a, b, ... through the loop: how they ended."""
    begin(tmp_path / "out")

    def run(client, letters="abcd", slots=lambda: 2, room=GB, n_bytes=None):
        monkeypatch.setattr(distributed, "wait", client.wait)
        sizes = n_bytes or {}
        jobs = [
            SubjectTask(f"sub-{x}", (), str(tmp_path / "out"), ".vtu", 1, sizes.get(x, 1.0), "run-1") for x in letters
        ]
        return list(run_all(jobs, client, slots, room))

    return run


def failure(tmp_path, key):
    path = failure_path(tmp_path / "out", key)
    return json.loads(path.read_text()) if path.exists() else None


def killed():
    return KilledWorker("task", None, 1)


@pytest.mark.parametrize("is_one_by_one", [True, False])
def test_each_runs_once_in_order_and_no_more_than_there_is_room_for(play, is_one_by_one):
    client = FakeClient(is_one_by_one=is_one_by_one)
    assert [ended.key for ended in play(client, "abcde")] == [f"sub-{x}" for x in "abcde"]
    assert client.submitted == [f"sub-{x}-run-1-1" for x in "abcde"]
    assert client.most == 2


@pytest.mark.parametrize("end", [killed(), "cancelled"])
def test_what_a_worker_takes_with_it_is_run_once_more_and_first(play, tmp_path, end):
    client = FakeClient({("sub-a", 1): end}, is_one_by_one=True)
    assert {ended.key: ended.status for ended in play(client)} == dict.fromkeys(
        ["sub-a", "sub-b", "sub-c", "sub-d"], "done"
    )
    assert client.submitted[:3] == ["sub-a-run-1-1", "sub-b-run-1-1", "sub-a-run-1-2"]
    assert failure(tmp_path, "sub-a") is None


@pytest.mark.parametrize(("end", "words"), [
    (killed(), "its worker ended, 2 times"), ("cancelled", "its worker ended, 2 times"),
    (ValueError("first\nlast\x1b[2J"), "ValueError: first last"),
])  # fmt: skip
def test_what_fails_twice_is_a_row(play, tmp_path, end, words):
    ended = play(FakeClient({("sub-b", 1): end, ("sub-b", 2): end}))
    failed = [each for each in ended if each.status == "failed"]
    assert [each.key for each in failed] == ["sub-b"]
    assert len(ended) == 4
    record = failure(tmp_path, "sub-b")
    assert (record["reason"], record["attempts"]) == (failed[0].reason, 2)
    assert "\n" not in record["reason"]
    assert "\x1b" not in record["reason"]
    assert words in record["reason"]


def test_a_subject_that_does_not_fit_does_not_begin(play, tmp_path):
    client = FakeClient()
    ended = play(client, "abc", room=GB, n_bytes={"a": GB, "b": 1.001 * GB})
    assert client.submitted == ["sub-a-run-1-1", "sub-c-run-1-1"]
    assert {each.key: each.status for each in ended} == {"sub-a": "done", "sub-b": "failed", "sub-c": "done"}
    record = failure(tmp_path, "sub-b")
    assert record["attempts"] == 0
    assert "needs 1 GB of memory, but a worker has 1 GB" in record["reason"]


def test_where_there_is_no_worker_it_waits_and_where_there_are_more_it_uses_them(play, monkeypatch):
    """Jobs of a batch system come after hours: until then nothing turns round and round."""
    slept, numbers = [], iter([0, 0, 1, 0, 3])
    monkeypatch.setattr(time, "sleep", slept.append)
    client = FakeClient()
    assert len(play(client, "abcd", slots=lambda: next(numbers))) == 4
    assert slept == [tasks.WAIT_SECONDS] * 3
    assert client.most == 3


def test_fewer_slots_take_nothing_away_from_what_runs(play):
    numbers = iter([3, 1, 1, 1])
    client = FakeClient(is_one_by_one=True)
    assert len(play(client, "abcde", slots=lambda: next(numbers, 1))) == 5
    assert client.submitted[:4] == [f"sub-{x}-run-1-1" for x in "abcd"]


@pytest.mark.parametrize("status", ["connecting", "closed"])
def test_a_scheduler_that_is_lost_ends_the_run_and_no_subject_fails_by_it(play, tmp_path, status):
    client = FakeClient({("sub-a", 1): "lost", ("sub-b", 1): "lost"})
    with pytest.raises(SchedulerLost):
        play(client)
    assert not list((tmp_path / "out" / "logs").iterdir())
    client = FakeClient({("sub-a", 1): killed(), ("sub-a", 2): "lost"})
    with pytest.raises(SchedulerLost):
        play(client)
    assert failure(tmp_path, "sub-a") is None
    client = FakeClient()
    client.status = status
    with pytest.raises(SchedulerLost):
        play(client)
    assert client.submitted == []


def test_a_scheduler_that_is_lost_while_it_is_asked_is_said_so(play, tmp_path):
    def no_answer():
        raise ConnectionResetError(104, "in <TCP (closed) ConnectionPool.gather>: Connection reset by peer")

    with pytest.raises(SchedulerLost, match="no longer answers"):
        play(FakeClient(), slots=no_answer)
    assert not list((tmp_path / "out" / "logs").iterdir())


def slow(job):
    time.sleep(0.4)
    return Ended(job.key, "done", "", 0.4, 0)


def test_what_dask_itself_cancels_is_run_again(tmp_path):
    """Dask says so by an error of the wait, not only of the future."""
    jobs = [SubjectTask(f"sub-{x}", (), str(tmp_path), ".vtu", 1, 1.0, "run-1") for x in "ab"]
    cancelled = []

    def cancel(client):
        while not client.futures:
            time.sleep(0.01)
        cancelled.extend(client.futures)
        client.cancel([distributed.Future(cancelled[0], client)], force=True)

    with (
        LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster) as client,
    ):
        thread = threading.Thread(target=cancel, args=[client])
        thread.start()
        ended = list(run_all(jobs, client, lambda: 1, GB, slow))
        thread.join()
    assert cancelled == ["sub-a-run-1-1"]
    assert [each.key for each in ended] == ["sub-a", "sub-b"]
