"""Dask's workers: how many, for whom, how safe, and what is left of them; jobs of batch systems as their scripts."""

import os
import signal
import socket
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import dask
import psutil
import pytest
from commands import exit_code
from distributed import KilledWorker, LocalCluster
from models import sample_image

from tetopt.cluster import jobs
from tetopt.cluster.crew import About, Folders, Need, Newcomers
from tetopt.cluster.jobs import cluster_of, configuration, request
from tetopt.cluster.workers import _threads_each, shares, workers
from tetopt.errors import InputError
from tetopt.io.images import save_image
from tetopt.system.interpreter import python_command, python_environment

GB = 1e9


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = Folders(*(tmp_path_factory.mktemp(name) for name in ("work", "logs")))
    return made


def running(need, folders, *, count=None, scheduler=None, cluster=None):
    return workers(need, folders, count=count, scheduler=scheduler, cluster=cluster)


def killed():
    os.kill(os.getpid(), signal.SIGKILL)


def noisy():
    os.write(2, b"a word of a worker\n")
    return os.getpid()


def processes():
    """Of this process: those that were started by it, and have not ended."""
    children = psutil.Process().children()
    return [" ".join(each.cmdline()) for each in children if each.status() != psutil.STATUS_ZOMBIE]


# ---- How many


@pytest.mark.parametrize(
    ("need", "count", "cores", "free", "expected"),
    [
        (Need(100, 0.0, None), None, 8, float("inf"), (8, 1)),  # cores
        (Need(100, 2 * GB, None), None, 8, 12 * GB, (4, 2)),  # memory: 2.85 GB each
        (Need(3, 2 * GB, None), None, 8, 100 * GB, (3, 2)),  # tasks
        (Need(100, 2 * GB, None), 2, 8, 100 * GB, (2, 4)),  # count
        (Need(100, 2 * GB, 4), None, 8, 100 * GB, (2, 4)),  # threads of each
        (Need(100, 20 * GB, None), 5, 2, 11 * GB, (1, 2)),  # none fits: one, which its own check refuses
    ],
)
def test_as_many_workers_as_cores_memory_and_subjects_allow(need, count, cores, free, expected):
    share = shares(need, count, cores, free)
    assert share[:2] == expected
    assert share.bytes < free / share.workers or free == float("inf")


def test_threads_of_a_subject_are_those_of_the_busiest_host():
    """Its cores by all that run there at a time, of several workers too."""
    abouts = [About("0", "3.11", "", host, cores, n_threads, 1.0) for host, cores, n_threads in
              (("a", 16, 1), ("a", 16, 3), ("b", 12, 2), ("c", 2, 1))]  # fmt: skip
    assert [_threads_each(some) for some in (abouts[:3], abouts, abouts[2:3], [])] == [4, 2, 6, 1]


# ---- Here


@pytest.mark.full
def test_workers_of_this_machine(folders, capfd):
    """A dead one costs its own task at once; nothing of them is on the terminal, nor left afterwards."""
    before = processes()
    with running(Need(2, 0.1 * GB, None), folders, count=1) as crew:
        assert crew.slots() == 1
        assert crew.words.startswith("1 worker of ")
        assert "http://127.0.0.1:" in crew.words
        addresses = [crew.client.scheduler.address, *crew.client.nthreads()]
        assert all(address.startswith("tls://127.0.0.1:") for address in addresses)
        # Another user of this machine, who knows the address but has no certificates.
        with (
            pytest.raises(InputError, match="does not answer"),
            running(Need(1, 0.0, None), folders, scheduler=addresses[0]),
        ):
            pass
        assert isinstance(crew.client.submit(killed, pure=False).exception(), KilledWorker)
        until(lambda: crew.slots() == 1)
        worker = crew.client.submit(noisy, pure=False).result()
        assert Path("/proc", str(worker)).exists()
    assert [words for words in processes() if words not in before and "resource_tracker" not in words] == []
    assert not Path("/proc", str(worker)).exists()
    assert list(folders.work.iterdir()) == []
    assert capfd.readouterr() == ("", "")
    log = (folders.logs / "dask.log").read_text()
    assert "a word of a worker" in log
    assert "killed" in log


# ---- A scheduler that runs


@pytest.fixture(scope="module")
def others():
    """A cluster of somebody else's, within this process: 2 workers with 2 tasks at a time and 8 GB each."""
    with LocalCluster(
        n_workers=2, threads_per_worker=2, processes=False, protocol="tcp://", memory_limit="8GB",
        dashboard_address="127.0.0.1:0", silence_logs=50,
    ) as cluster:  # fmt: skip
        yield cluster


def test_workers_of_a_scheduler_that_runs(others, folders):
    with running(Need(10, 3.9 * GB, None), folders, scheduler=others.scheduler.address) as crew:
        assert crew.slots() == 4
        assert (crew.bytes, crew.limit) == (4 * GB, 8 * GB)
        assert crew.threads == max(1, dask.system.CPU_COUNT // 4)
    with running(Need(10, 0.0, 3), folders, scheduler=others.scheduler.address) as crew:
        assert crew.threads == 3
    assert list(folders.work.iterdir()) == []
    assert len(others.scheduler.workers) == 2  # they go on


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://x", ""])
def test_a_scheduler_that_does_not_answer_is_refused_in_one_line(address, folders, monkeypatch, capfd):
    monkeypatch.setattr("tetopt.cluster.workers.CONNECT_SECONDS", 0.2)
    with pytest.raises(InputError, match="does not answer") as refusal:
        running(Need(1, 0.0, None), folders, scheduler=address).__enter__()
    assert "\n" not in str(refusal.value)
    assert capfd.readouterr() == ("", "")


@pytest.fixture
def silent():
    """The address of a socket that takes connections and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.full
def test_a_scheduler_that_says_nothing_is_refused_before_images_are_read(silent, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr("tetopt.cluster.workers.CONNECT_SECONDS", 0.3)
    save_image(tmp_path / "large.nii", sample_image(3))
    os.truncate(tmp_path / "large.nii", 400)  # a header alone
    (tmp_path / "t.tsv").write_text("task\timage\n1\tnone.nii\n")
    for command in (["cohort", tmp_path / "t.tsv"], ["mesh", tmp_path / "large.nii", "--parts", 2]):
        assert exit_code(*command, "-o", tmp_path / "out.vtu", "--nodes", 200, "--scheduler", silent) == 2
        said = capfd.readouterr()
        assert (said.out, said.err.count("\n")) == ("", 1)
        assert f"{silent} does not answer (no reply within 0.3 s)" in said.err
        assert not (tmp_path / "out.vtu").exists()


def test_another_service_at_the_address_is_no_scheduler(folders, capfd):
    """The first eight bytes of its answer, read as a length, are more than any memory."""

    def answer():
        connection, _ = server.accept()
        with connection:
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n" + bytes(1000))
            connection.recv(10**6)

    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as pool:
        server.settimeout(10)
        pool.submit(answer)
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(
            InputError, match=f"^`scheduler`: {address} is another service, not a dask scheduler"
        ) as refusal:
            running(Need(1, 0.0, None), folders, scheduler=address).__enter__()
    assert "\n" not in str(refusal.value)
    assert capfd.readouterr() == ("", "")


def test_a_missing_package_is_said_with_what_installs_it(folders, monkeypatch):
    monkeypatch.setitem(sys.modules, "dask_jobqueue", None)
    with pytest.raises(InputError, match=r'dask_jobqueue is not installed, .*; pip install .*"dask-jobqueue.*"'):
        running(Need(1, 0.0, None), folders).__enter__()


def test_nothing_is_written_where_workers_are_refused(tmp_path, capsys):
    save_image(tmp_path / "a.nii.gz", sample_image(3))
    (tmp_path / "t.tsv").write_text("task\timage\n1\ta.nii.gz\n")
    command = ["cohort", tmp_path / "t.tsv", "-o", tmp_path / "out", "--nodes", 60]
    assert exit_code(*command, "--cluster", written(tmp_path, "jobqueue: {slum: {}}")) == 2
    assert "expected one of htcondor" in capsys.readouterr().err
    assert exit_code(*command, "--scheduler", "tcp://127.0.0.1:1", "--cluster", tmp_path) == 2
    assert "--scheduler, --cluster: expected only one of them" in capsys.readouterr().err
    assert exit_code(*command, "--scheduler", "tcp://127.0.0.1:1", "--workers", 2) == 2
    assert "--workers: expected none with --scheduler" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": "0.0.1"}, r"expected tetopt .* as here, got 0.0.1"),
        ({"python": "3.9"}, r"expected Python .* as here, got 3.9"),
        ({"probe": None}, "cannot access .*; expected an output folder on a file system that all workers share"),
        ({"n_threads": 4, "n_bytes": 4 * GB}, r"has 1 GB for each of 4 tasks, .* needs about 3 GB; .*--nthreads 1"),
    ],
)
def test_a_worker_is_looked_at_when_it_comes(change, words, tmp_path):
    """Also after the start: clusters' workers come and go."""
    answers = {}
    client = SimpleNamespace(nthreads=lambda: dict.fromkeys(answers, 1), run=lambda *_, **__: answers)
    newcomers = Newcomers(client, Need(1, 3 * GB, None), tmp_path)
    assert newcomers.slots() == 0
    answers["tcp://good:1"] = About.of(newcomers.probe)
    assert newcomers.slots() == 1
    answers["tcp://bad:1"] = About.of(newcomers.probe)._replace(**change)
    with pytest.raises(InputError, match=words):
        newcomers.slots()


def test_a_worker_that_runs_several_tasks_in_one_process_is_refused(tmp_path):
    """Where it runs them itself: kernels take all threads of a process."""
    answers = {}
    client = SimpleNamespace(nthreads=lambda: dict.fromkeys(answers, 1), run=lambda *_, **__: answers)
    newcomers = Newcomers(client, Need(1, 3 * GB, None, is_within=True), tmp_path)
    good = About.of(newcomers.probe)._replace(n_bytes=4 * GB)
    answers["tcp://good:1"] = good
    assert newcomers.slots() == 1
    answers["tcp://bad:1"] = good._replace(n_bytes=3.4 * GB)
    with pytest.raises(InputError, match=r"has 2.83 GB for each of 1 tasks, but the largest needs about 3 GB"):
        newcomers.slots()
    answers["tcp://bad:1"] = good._replace(n_threads=4)
    with pytest.raises(InputError, match=r"runs one task at a time, got 4; .* --nthreads 1 --nworkers 4"):
        newcomers.slots()


def test_a_worker_without_tetopt_is_refused(tmp_path):
    error = ModuleNotFoundError("No module named 'tetopt'")
    client = SimpleNamespace(nthreads=lambda: {"tcp://a:1": 1}, run=lambda *_, **__: {"tcp://a:1": error})
    with pytest.raises(InputError, match=r"expected one with tetopt .* No module named 'tetopt'; install it there"):
        Newcomers(client, Need(1, 0.0, None), tmp_path).slots()


# ---- Batch systems


def written(folder, text):
    path = folder / "cluster.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected one batch system"),
        ("[1, 2]", "expected one batch system"),
        ("slurm: {queue: long}", "expected one batch system"),
        ("jobqueue: {slurm: {}, pbs: {}}", "expected one batch system"),
        ("jobqueue: {slurm: {}}\ndistributed: {}", "expected one batch system"),
        ("jobqueue: {slum: {}}", "expected one of htcondor, lsf, moab, oar, pbs, sge, slurm, got slum"),
        ("jobqueue: {slurm: [1]}", "slurm: expected key-value pairs"),
        ("jobqueue: {slurm: {qeue: long}}", "unknown key qeue; expected one of account, .*, walltime"),
        ("jobqueue: {slurm: {1: long}}", "unknown key 1;"),
        ("jobqueue: {slurm: {walltime: 12:00:00}}", 'walltime: expected a quoted time such as "12:00:00".*got 43200'),
        ("jobqueue: {slurm: {cores: two}}", "cores: expected a whole number above 0, got two"),
        ("jobqueue: {slurm: {cores: 0}}", "cores: expected a whole number above 0"),
        ("jobqueue: {slurm: {processes: true}}", "processes: expected a whole number above 0"),
        ("jobqueue: {slurm: {cores: .inf}}", "cores: expected a whole number above 0, got inf"),
        ("jobqueue: {slurm: {memory: lots}}", 'memory: expected an amount of memory such as "8 GB", got lots'),
        ("jobqueue: {slurm: {memory: .inf}}", 'memory: expected an amount of memory such as "8 GB", got inf'),
        ("jobqueue: {slurm: {memory: 1e400 GB}}", 'memory: expected an amount of memory such as "8 GB", got 1e400 GB'),
        (
            "jobqueue: {slurm: {job-script-prologue: module load python}}",
            "job-script-prologue: expected a list of strings",
        ),
        ("jobqueue: {slurm: {scheduler_options: 3}}", "scheduler-options: expected key-value pairs"),
        ("jobqueue: {slurm: {queue: [long]}}", "queue: expected one value"),
        ("jobqueue: {slurm: {queue: &a long, account: *a}}", "without aliases"),
        ("a: &a {x: 1}\nb: {<<: [*a, *a]}", "without aliases"),  # in one another they take all CPU time
        (
            "jobqueue: {slurm: !!python/object/apply:os.system ['touch owned']}",
            "expected YAML, got could not determine",
        ),
        ("jobqueue: {slurm: ", "expected YAML, got"),
        ("[" * 400, "expected YAML"),
        ("- " * 4000, "expected YAML"),
        ("[" * 600, "at most 500 brackets"),
        ("#" * 30_000, "at most 20000 characters"),
    ],
)
def test_a_file_that_is_no_configuration_is_refused(text, words, tmp_path):
    with pytest.raises(InputError, match=words) as refusal:
        configuration(written(tmp_path, text))
    assert "\n" not in str(refusal.value)
    assert not Path("owned").exists()


def test_a_configuration_that_is_not_there_is_said_so(tmp_path):
    with pytest.raises(InputError, match=r"^\S+c.yaml: no such file; expected a file of dask-jobqueue's configuration"):
        configuration(tmp_path / "c.yaml")


def requested(settings, need, kind="slurm"):
    pytest.importorskip("dask_jobqueue")  # which tells dask its configuration
    return request(Path("c.yaml"), kind, dask.config.get(f"jobqueue.{kind}") | settings, need)


def test_a_job_asks_for_what_a_subject_needs():
    plain = requested({}, Need(9, 4 * GB, None))
    assert (plain.cores, plain.processes, plain.threads) == (4, 1, 4)
    assert plain.bytes == pytest.approx(5.55 * GB)  # 1.35 times what is predicted, and the worker itself
    assert plain.task_bytes == pytest.approx(5.4 * GB)
    packed = requested({"cores": 8, "processes": 2}, Need(9, 4 * GB, None))
    assert (packed.cores, packed.threads) == (8, 4)
    assert packed.bytes == pytest.approx(11.1 * GB)
    assert requested({}, Need(9, 4 * GB, 2)).cores == 2
    assert requested({"memory": "8GB"}, Need(9, 4 * GB, 2)).bytes == 8 * GB


def test_a_job_whose_workers_run_tasks_themselves_has_their_limits():
    job = requested({"cores": 4, "processes": 2}, Need(9, GB, None, is_within=True))
    assert job.bytes == pytest.approx(2 * (1.35 + 0.4) / 0.95 * GB)
    assert job.task_bytes == pytest.approx(1.35 * GB)
    assert "export NUMBA_NUM_THREADS=2" in job.exports
    assert "export DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE=False" in job.exports
    assert requested({}, Need(9, GB, None)).exports == ("export PYTHONSAFEPATH=1",)


@pytest.mark.parametrize(
    ("kind", "settings", "need", "words"),
    [
        ("slurm", {"memory": "4GB"}, Need(1, 4 * GB, None), "memory: expected at least 4.15 GB .*, got 4GB"),
        ("slurm", {"memory": "6GB", "processes": 2}, Need(1, 4 * GB, None), "memory: expected at least 8.3 GB for 2"),
        ("slurm", {"job-mem": "1GB"}, Need(1, 4 * GB, None), "job-mem: expected at least"),
        ("lsf", {"mem": 10**9}, Need(1, 4 * GB, None), "mem: expected at least"),
        ("slurm", {"cores": 2}, Need(1, 1.0, 4), "cores: expected at least 4 for 1 tasks of 4 threads, got 2"),
        ("slurm", {"cores": 2, "processes": 3}, Need(1, 1.0, None), "cores: expected at least 3"),
        ("sge", {}, Need(1, 4 * GB, None), "expected resource-spec to request 5.55 GB per job"),
        ("oar", {}, Need(1, 4 * GB, None), "expected memory-per-core-property-name"),
    ],
)
def test_less_than_a_subject_needs_is_refused(kind, settings, need, words):
    with pytest.raises(InputError, match=words):
        requested(settings, need, kind)


@pytest.mark.parametrize(
    ("kind", "text", "lines"),
    [
        (
            "slurm",
            'queue: long, account: lab, walltime: "12:00:00", job_extra_directives: ["--gres=tmp:1"]',
            ["#SBATCH -p long", "#SBATCH -A lab", "#SBATCH -t 12:00:00", "#SBATCH --gres=tmp:1", "#SBATCH --mem=6G",
             "#SBATCH --cpus-per-task=2"],
        ),
        ("pbs", "queue: long", ["#PBS -q long", "#PBS -l select=1:ncpus=2:mem=5293MB"]),
        ("lsf", "queue: long, lsf-units: mb", ["#BSUB -q long", "#BSUB -n 2", "#BSUB -M 5550"]),
        ("sge", "queue: long, resource-spec: h_vmem=6G", ["#$ -q long", "#$ -l h_vmem=6G"]),
    ],
)  # fmt: skip
def test_scripts_of_jobs(kind, text, lines, folders):
    path = written(folders.work, f"jobqueue: {{{kind}: {{{text}, job-script-prologue: [module load x]}}}}")
    named, settings = configuration(path)
    with dask.config.set({f"jobqueue.{kind}.{key}": value for key, value in settings.items()}):
        job = request(path, named, dask.config.get(f"jobqueue.{kind}"), Need(9, 4 * GB, 2))
        job = job._replace(exports=("export NUMBA_NUM_THREADS=2",))
        with cluster_of(path, named, job, folders.work, folders.logs) as cluster:
            script = cluster.job_script()
            keys = [
                name
                for name in os.listdir(folders.work)
                if name.endswith(tuple("_abcdefghijklmnopqrstuvwxyz0123456789"))
            ]
            assert keys
            assert all(
                stat.S_IMODE((folders.work / name).stat().st_mode) == 0o600 for name in keys if ".worker." in name
            )
    rows = script.splitlines()
    assert set(lines) <= set(rows)
    assert rows.index("export NUMBA_NUM_THREADS=2") < rows.index("module load x")
    command = rows[-1].split() if rows[-1] else rows[-2].split()
    assert command[1:4] == ["-P", "-m", "distributed.cli.dask_worker"]
    assert command[4].startswith("tls://")
    assert command[len(command) - 1 - command[::-1].index("--nthreads") + 1] == "1"  # the last one is taken
    assert f"--tls-key {folders.work}/" in script
    path.unlink()
    assert list(folders.work.iterdir()) == []


@pytest.fixture
def batch(tmp_path, monkeypatch):
    """A folder of commands in front of all others; a test puts a batch system's there."""

    def put(name, text):
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setattr(jobs, "QUEUE_SECONDS", 0.1)
    return put


def test_a_cluster_that_takes_no_job_is_refused(batch, folders, tmp_path, capfd):
    batch("sbatch", "echo no such partition >&2; exit 1")
    path = written(tmp_path, "jobqueue: {slurm: {}}")
    with pytest.raises(InputError, match=r"the batch system rejects jobs: no such partition$"):
        running(Need(9, 1.0, None), folders, count=2, cluster=path).__enter__()
    assert list(folders.work.iterdir()) == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("count", [1, 4])
def test_a_cluster_all_of_whose_jobs_end_as_they_begin_is_given_up(count, batch, folders, tmp_path, capfd):
    batch("sbatch", f"sh $1 >/dev/null 2>&1; echo >> {tmp_path}/submitted; echo Submitted batch job 7")
    batch("scancel", "exit 0")
    path = written(tmp_path, "jobqueue: {slurm: {python: /bin/false}}")
    with running(Need(9, 1.0, None), folders, count=count, cluster=path) as crew:
        assert crew.words.startswith(f"up to {count} job")
        with pytest.raises(InputError, match="jobs ended right after starting; see their logs in"):
            until(lambda: crew.slots() > 0)
    assert 3 <= len((tmp_path / "submitted").read_text()) < 20
    assert list(folders.work.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_a_job_that_is_refused_beside_others_is_submitted_again_later(batch, folders, tmp_path, monkeypatch):
    """As where a user may have so many; the first one runs meanwhile."""
    submitted = tmp_path / "submitted"
    batch("sbatch", f"echo >> {submitted}; [ $(wc -l < {submitted}) = 1 ] || exit 1; echo Submitted batch job 7")
    batch("scancel", "exit 0")
    with running(Need(9, 1.0, None), folders, count=2, cluster=written(tmp_path, "jobqueue: {slurm: {}}")) as crew:
        until(lambda: crew.slots() == 0 and len(submitted.read_text()) == 2)
        time.sleep(0.5)  # some looks at the jobs
        assert len(submitted.read_text()) == 2
        monkeypatch.setattr(jobs, "AGAIN_SECONDS", 0.0)
        until(lambda: len(submitted.read_text()) > 2)


@pytest.mark.deep
def test_jobs_are_replaced_and_given_back(batch, folders, tmp_path, monkeypatch):
    """A batch system of two scripts. A job that is killed has a successor; one that nothing is left for goes."""
    mine = tmp_path / "jobs"
    mine.mkdir()
    copied = f"script={tmp_path}/$$.sh; cp $1 $script"  # as sbatch does: dask-jobqueue removes its own
    batch("sbatch", f"{copied}; setsid bash $script >/dev/null 2>&1 & touch {mine}/$!; echo Submitted batch job $!")
    batch("scancel", f"rm -f {mine}/$1; kill -9 -$1")
    monkeypatch.setattr(jobs, "IDLE_SECONDS", 2.0)
    path = written(tmp_path, "jobqueue: {slurm: {processes: 2, cores: 2}}")
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "1s"}),
        running(Need(5, 1.0, None), folders, count=1, cluster=path) as crew,
    ):
        until(lambda: crew.slots() == 2)
        (first,) = mine.iterdir()
        os.killpg(int(first.name), signal.SIGKILL)
        until(lambda: crew.slots() == 0)
        until(lambda: crew.slots() == 2)
        assert not first.exists()
    assert list(mine.iterdir()) == []
    path = written(tmp_path, "jobqueue: {slurm: {cores: 1}}")
    with running(Need(2, 1.0, None), folders, count=2, cluster=path) as crew:
        until(lambda: crew.slots() == 2)
        last = crew.client.submit(time.sleep, 6)
        until(lambda: len(list(mine.iterdir())) == 1)
        assert last.result() is None
        assert last.status == "finished"
        until(lambda: crew.slots() == 2)  # as many again, once there is something to begin
    assert list(mine.iterdir()) == []


def until(condition):
    ended = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < ended
        time.sleep(0.1)


def test_a_cluster_whose_commands_are_not_there_is_refused(folders, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="slurm: command sbatch not found; run this where jobs are submitted"):
        running(Need(9, 1.0, None), folders, cluster=written(tmp_path, "jobqueue: {slurm: {}}")).__enter__()


def test_folders_that_directives_do_not_take_are_refused(batch, tmp_path):
    batch("sbatch", "exit 1")
    spaced = Folders(tmp_path / "my work", tmp_path)
    with pytest.raises(InputError, match="the path of the output folder may contain only letters"):
        running(Need(9, 1.0, None), spaced, cluster=written(tmp_path, "jobqueue: {slurm: {}}")).__enter__()


@pytest.mark.deep
@pytest.mark.parametrize(
    ("is_within", "task"),
    [(False, "time.sleep"), (True, "ctypes.PyDLL(None).sleep")],  # the second as kernels are
)
def test_nothing_is_left_of_a_client_that_is_killed(is_within, task, tmp_path):
    program = (
        "import ctypes, os, sys, time; from pathlib import Path; from tetopt.cluster.workers import *\n"
        "from tetopt.cluster.crew import *\n"
        f"def task(mark): mark.touch(); {task}(100)\n"
        "if __name__ == '__main__':\n"
        "    one = Path(sys.argv[1])\n"
        f"    need = Need(2, 1.0, 1, {is_within})\n"
        "    with workers(need, Folders(one, one), count=2, scheduler=None, cluster=None) as crew:\n"
        "        future = crew.client.submit(task, one / 'mark')\n"
        "        while not (one / 'mark').exists(): time.sleep(0.01)\n"
        "        print('up', flush=True); time.sleep(100)\n"
    )
    script = tmp_path / "client.py"
    script.write_text(program)

    with subprocess.Popen(
        python_command(str(script), str(tmp_path)),
        env=python_environment(),
        stdout=subprocess.PIPE,
        start_new_session=True,
    ) as client:
        assert client.stdout.readline() == b"up\n"
        client.kill()
        client.wait()
        ended = time.monotonic() + 20
        while time.monotonic() < ended and (left := _of_session(client.pid)):
            time.sleep(0.1)
        assert left == []


def _of_session(number):
    rows = subprocess.run(["ps", "-eo", "sess=,stat=,args="], capture_output=True, text=True, check=True).stdout
    return [row for row in rows.splitlines() if row.split()[0] == str(number) and not row.split()[1].startswith("Z")]
