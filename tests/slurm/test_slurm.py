"""A real SLURM of one node, this machine: Debian's slurm-wlm and munge, started by hand in a folder
of ours.

Run by `make test-slurm`, which installs them. There are no control groups (linuxproc, task/none),
so that SLURM grants memory and counts it but does not enforce it, and no database, so that
`scontrol` tells of jobs, not `sacct`.
"""

import getpass
import os
import re
import secrets
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import exit_code, numbers_in

from tetopt.cohort.layout import numbers_path
from tetopt.io.meshes import load_mesh

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        "TETOPT_SLURM" not in os.environ, reason="starts daemons; run by make test-slurm"
    ),
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
ROOT = Path(__file__).parents[2]


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def told(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


@pytest.fixture(scope="module")
def slurm():
    """Munge, the controller and one node; all of them end with the tests."""
    missing = [
        name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name) is None
    ]
    assert missing == [], f"{missing}: install slurm-wlm and munge"
    # Short, as a socket's path may have 108 letters; for the owner alone, as munge demands.
    folder = Path("/tmp") / f"tetopt-slurm-{secrets.token_hex(4)}"
    folder.mkdir(mode=0o755)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    (folder / "munge.key").write_bytes(secrets.token_bytes(1024))
    (folder / "munge.key").chmod(0o600)
    megabytes = (
        int(re.search(r"MemTotal: +(\d+)", Path("/proc/meminfo").read_text()).group(1)) // 1024
        - 500
    )
    (folder / "slurm.conf").write_text(
        CONFIGURATION.format(
            host=socket.gethostname().split(".")[0],
            user=getpass.getuser(),
            folder=folder,
            ports=(free_port(), free_port()),
            cores=os.cpu_count(),
            megabytes=megabytes,
        )
    )
    names = [
        f"--{name}={folder}/munge.{name.split('-')[0]}"
        for name in ("key-file", "socket", "pid-file", "log-file")
    ]
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
        while (
            subprocess.run(
                ["sinfo", "-h", "-o", "%T"], capture_output=True, text=True
            ).stdout.strip()
            != "idle"
        ):
            assert time.monotonic() < ended, "\n".join(
                path.read_text() for path in folder.glob("*.log")
            )
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
    """All jobs since the start, by number: time, cores, memory."""
    text = told("scontrol", "--oneliner", "show", "job")
    pattern = r"JobId=(\d+) .*?TimeLimit=([\d:]+) .*?TRES=cpu=(\d+),mem=(\w+)"
    return {int(job): request for job, *request in re.findall(pattern, text)}


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    path = tmp_path_factory.mktemp("image") / "sphere.nii.gz"
    assert exit_code("phantom", "sphere", "-o", path, "--voxel-mm", "3") == 0
    return path


@pytest.fixture
def study(image, tmp_path):
    """A table of six subjects, and what a run of each takes beside."""
    rows = [f"{k}\t{image}" for k in range(1, 7)]
    (tmp_path / "subjects.tsv").write_text("\n".join(["subject\timage", *rows, ""]))
    return tmp_path


def code_of(language, *changes):
    """The page's block of a language that names SLURM, with other words in place of some of its
    own.
    """
    page = (ROOT / "docs" / "howto" / "clusters.md").read_text(encoding="utf-8")
    (code,) = [
        each
        for each in re.findall(rf"```{language}\n(.*?)```", page, re.S)
        if "slurm" in each.lower()
    ]
    for old, new in changes:
        assert code.count(old) == 1, old
        code = code.replace(old, new)
    return code


def checked(out):
    """All six are done."""
    for k in range(1, 7):
        path = numbers_path(out, f"sub-{k}")
        assert numbers_in(path)["violated"] == {}
        assert load_mesh(path.with_suffix(".vtu")).mesh.cells.shape[0] > 500
    assert (out / "cohort.html").is_file()


def test_the_program_of_the_page(slurm, study):
    """Two jobs as workers; one is cancelled while its subject runs, which runs again, and a job
    takes its place.
    """
    port = free_port()
    program = code_of(
        "python",
        ('cores=4, processes=4, memory="16GB"', 'cores=1, processes=1, memory="2GB"'),
        ('"port": 8786', f'"port": {port}'),
        ("minimum_jobs=20, maximum_jobs=20", "minimum_jobs=2, maximum_jobs=2"),
    )
    (study / "scheduler.py").write_text(program)
    before, out = set(jobs_of_slurm()), study / "out"
    command = [sys.executable, "scheduler.py"]
    with subprocess.Popen(
        command, cwd=study, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as scheduler:
        try:
            address = f"tcp://127.0.0.1:{port}"
            assert f":{port}: press Enter" in scheduler.stdout.readline()
            words = [
                "cohort",
                "subjects.tsv",
                "-o",
                out,
                "--nodes",
                500,
                "--iterations",
                3,
                "--scheduler",
                address,
            ]
            with subprocess.Popen(
                [sys.executable, "-m", "tetopt", *map(str, words)], cwd=study
            ) as run:
                (job, *_) = until(lambda: under_way(out) and set(jobs_of_slurm()) - before)
                subprocess.run(["scancel", str(job)], check=True)
                assert run.wait(600) == 0
            # The six may be done before the next job is requested; two are kept as long as the
            # scheduler runs.
            until(lambda: len(set(jobs_of_slurm()) - before) >= 3)
        finally:
            scheduler.communicate("\n", timeout=60)
    checked(out)
    requests = [request for job, request in jobs_of_slurm().items() if job not in before]
    assert all(request == ["12:00:00", "1", "2G"] for request in requests), requests


def under_way(out):
    """Two subjects run, one in each job."""
    return len(list((out / ".work").glob("sub-*.run-*"))) == 2


def until(condition):
    end = time.monotonic() + 300
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.2)
    return found


def test_the_job_array_of_the_page(slurm, study):
    """Six jobs into one folder, a subject each."""
    script = code_of(
        "bash",
        ("1-50", "1-6"),
        ("--cpus-per-task=4 --mem=8G", "--cpus-per-task=1 --mem=1G"),
        ("--nodes 20000", "--nodes 500 --iterations 3"),
        ("--threads 4", "--threads 1"),
    )
    assert script.count("tetopt cohort") == 1
    (study / "array.sh").write_text(script)
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    subprocess.run(
        ["sbatch", "--wait", "array.sh"], cwd=study, env=environment, check=True, timeout=600
    )
    words = [study / "subjects.tsv", "-o", study / "OUT", "--collect"]
    assert exit_code("cohort", *words) == 0, "\n".join(
        path.read_text() for path in study.glob("slurm-*.out")
    )
    checked(study / "OUT")
