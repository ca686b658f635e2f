"""A real SLURM of one node, this machine: Debian's slurm-wlm and munge, started by hand in a folder of ours.

Run by `make test-slurm`, which installs them. There are no control groups (linuxproc, task/none), so that SLURM grants
memory and counts it but does not enforce it, and no database, so that `scontrol` tells of jobs, not `sacct`.
"""

import getpass
import os
import re
import secrets
import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest
from commands import exit_code, numbers_in

from tetopt.cluster.crew import Folders, Need
from tetopt.cluster.workers import workers
from tetopt.cohort.layout import begin, numbers_path
from tetopt.cohort.run import Ended, SubjectTask
from tetopt.cohort.schedule import run_all
from tetopt.io.meshes import load_mesh

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("TETOPT_SLURM" not in os.environ, reason="starts daemons; run by make test-slurm"),
]
CONFIGURATION = """
ClusterName=tetopt
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
MpiDefault=none
ReturnToService=2
MinJobAge=3600
SchedulerParameters=sched_interval=2
KillWait=5
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={megabytes} State=UNKNOWN
PartitionName=long Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
YAML = """
jobqueue:
  slurm:
    queue: long
    cores: 1
    walltime: "{walltime}"
"""


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def told(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


@pytest.fixture(scope="module")
def slurm():
    """Munge, the controller and one node; all of them end with the tests."""
    missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]
    assert missing == [], f"{missing}: install slurm-wlm and munge"
    # Short, as a socket's path may have 108 letters; for the owner alone, as munge demands.
    folder = Path("/tmp") / f"tetopt-slurm-{secrets.token_hex(4)}"
    folder.mkdir(mode=0o755)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    (folder / "munge.key").write_bytes(secrets.token_bytes(1024))
    (folder / "munge.key").chmod(0o600)
    megabytes = int(re.search(r"MemTotal: +(\d+)", Path("/proc/meminfo").read_text()).group(1)) // 1024 - 500
    (folder / "slurm.conf").write_text(
        CONFIGURATION.format(
            host=socket.gethostname().split(".")[0], user=getpass.getuser(), folder=folder,
            ports=(free_port(), free_port()), cores=os.cpu_count(), megabytes=megabytes,
        )
    )  # fmt: skip
    names = [f"--{name}={folder}/munge.{name.split('-')[0]}" for name in ("key-file", "socket", "pid-file", "log-file")]
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    daemons = []
    try:
        for command in (
            ["munged", "--force", "--foreground", *names, f"--seed-file={folder}/munge.seed"],
            ["slurmctld", "-D", "-f", str(folder / "slurm.conf")],
            ["slurmd", "-D", "-f", str(folder / "slurm.conf")],
        ):
            log = (folder / f"{command[0]}.out").open("wb")
            daemons.append(subprocess.Popen(command, stdout=log, stderr=log))
            log.close()
            time.sleep(1)
        ended = time.monotonic() + 60
        while subprocess.run(["sinfo", "-h", "-o", "%T"], capture_output=True, text=True).stdout.strip() != "idle":
            assert time.monotonic() < ended, "\n".join(path.read_text() for path in folder.glob("*.log"))
            time.sleep(0.5)
        yield folder
        ended = time.monotonic() + 30  # a job that was cancelled completes
        while (left := told("squeue", "-h")) and time.monotonic() < ended:
            time.sleep(0.5)
        assert left == ""
    finally:
        for daemon in reversed(daemons):
            daemon.terminate()
            daemon.wait(30)
        del os.environ["SLURM_CONF"]
        shutil.rmtree(folder)


def jobs_of_slurm():
    """All jobs since the start: number, state, cores, megabytes, minutes."""
    text = told("scontrol", "--oneliner", "show", "job")
    pattern = r"JobId=(\d+) .*?JobState=(\w+) .*?TimeLimit=([\d:]+) .*?TRES=cpu=(\d+),mem=(\d+)M"
    return {int(row[0]): (row[1], int(row[3]), int(row[4]), row[2]) for row in re.findall(pattern, text)}


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "sphere.nii.gz"
    assert exit_code("phantom", "sphere", "-o", path, "--voxel-mm", "3") == 0
    return path


def file_of(folder, walltime="00:10:00"):
    path = folder / "cluster.yaml"
    path.write_text(YAML.format(walltime=walltime))
    return path


def test_six_subjects(slurm, image, tmp_path):
    """In two jobs; each asks for what a subject is predicted to need, a quarter more, and the worker's own."""
    rows = [f"{k}\t{image}" for k in range(1, 7)]
    (tmp_path / "subjects.tsv").write_text("\n".join(["subject\timage", *rows, ""]))
    out, before = tmp_path / "out", set(jobs_of_slurm())
    words = ["--workers", 2, "--cluster", file_of(tmp_path), "--nodes", 500, "--iterations", 3]
    assert exit_code("cohort", tmp_path / "subjects.tsv", "-o", out, *words) == 0
    peak = max(numbers_in(numbers_path(out, f"sub-{k}"))["memory"]["peak_bytes"] for k in range(1, 7))
    requested = {number: row for number, row in jobs_of_slurm().items() if number not in before}
    assert len(requested) == 2
    assert {(cores, time) for _, cores, _, time in requested.values()} == {(1, "00:10:00")}
    (megabytes,) = {row[2] for row in requested.values()}
    assert peak + 1.5e8 < megabytes * 2**20 < 2 * (peak + 1.5e8)
    for k in range(1, 7):
        path = numbers_path(out, f"sub-{k}")
        numbers = numbers_in(path)
        assert numbers["violated"] == {}
        assert load_mesh(path.with_suffix(".vtu")).mesh.cells.shape[0] > 500
    assert (out / "cohort.html").is_file()
    assert {path.name for path in (out / ".work").iterdir()} <= {"lock", "tetopt-manifest"}
    # Nothing left to do, and so nothing is submitted.
    assert exit_code("cohort", tmp_path / "subjects.tsv", "-o", out, *words) == 0
    assert set(jobs_of_slurm()) == before | set(requested)


def test_jobs_that_end_are_replaced(slurm, tmp_path):
    """One is cancelled while its subject runs: the subject runs again, in a job that takes its place."""

    def cancelled_once(job):  # in here, so that it is sent as it is: jobs cannot import this module
        mark = Path(job.out) / "cancelled"
        if job.key == "sub-2" and not mark.exists():
            mark.touch()
            subprocess.run(["scancel", os.environ["SLURM_JOB_ID"]], check=True)
            time.sleep(60)
        return Ended(job.key, "done", os.environ["SLURM_JOB_ID"], 0.0, 0)

    out = tmp_path / "out"
    begin(out)
    jobs = [SubjectTask(f"sub-{k}", (), str(out), ".vtu", 1, 1.0, "run-1") for k in range(1, 5)]
    before = set(jobs_of_slurm())
    folders = Folders(out / ".work", out / "logs")
    with workers(Need(4, 1.0, None), folders, count=1, scheduler=None, cluster=file_of(tmp_path)) as crew:
        ended = list(run_all(jobs, crew.client, crew.slots, crew.bytes, task=cancelled_once))
        after = {number: row for number, row in jobs_of_slurm().items() if number not in before}
    assert sorted((each.key, each.status) for each in ended) == [(f"sub-{k}", "done") for k in range(1, 5)]
    assert [row[0] for _, row in sorted(after.items())] == ["CANCELLED", "RUNNING"]
    # Told of by dask, and so counted: a subject that outlasts its job's wall time is not begun for ever.
    assert "sub-2-run-1-1 marked as failed because 1 workers died" in (folders.logs / "dask.log").read_text()
    first, second = sorted(after)
    assert {each.key: int(each.reason) for each in ended} == {
        "sub-1": first, "sub-2": second, "sub-3": second, "sub-4": second
    }  # fmt: skip
