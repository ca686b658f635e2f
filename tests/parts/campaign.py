"""Runs in parts that are killed, interrupted or out of disk on dask's workers: the same bytes
(`make test-parts`).

python tests/parts/campaign.py [NODES [PARTS]]: the MNI152 T1 by `tetopt mesh`, 8000 nodes in 4
parts or more. Prints a table, and ends with 1 where a row of it is not as it should be. What goes
wrong is done from outside: tetopt knows nothing of it.
"""

import contextlib
import hashlib
import os
import re
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from tetopt.io.mni import mni_path

LEAVE_SECONDS = 60.0  # until a killed client's workers have gone
RUN_SECONDS = 1500.0  # of a run, after which it hangs
FREE_BYTES = 64e6  # of a small disk before it is filled: the voxels and three rounds of 8000 nodes
MARK = "TETOPT_CAMPAIGN"  # in the environment of a run and of all that it starts
SCHEDULER = """
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=":0") as cluster:
        print(cluster.scheduler_address, flush=True)
        input()
"""


class Run:
    """A run of the command, what it says, and the processes that it starts."""

    def __init__(self, out, size, *options, texts=None):
        """`texts` is the folder of what it says, if not the mesh's."""
        self.out, self.mark, self.text = (
            out,
            secrets.token_hex(8),
            (texts or out.parent) / f"{out.stem}.txt",
        )
        words = [
            "mesh",
            mni_path("t1"),
            "-o",
            out,
            "--nodes",
            size[0],
            "--parts",
            size[1],
            *options,
        ]
        with self.text.open("ab") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tetopt", *map(str, words)],
                stdout=stream,
                stderr=stream,
                env=os.environ | {MARK: self.mark},
            )

    @property
    def work(self):
        return self.out.with_name(self.out.name + ".work")

    def round(self):
        """The number of the round whose parts are under way, and how many of it are done; None
        before and after.
        """
        numbers = [int(path.name.partition("-")[2]) for path in self.work.glob("round-*")]
        if not numbers or not (folder := self.work / f"round-{max(numbers)}").is_dir():
            return None
        return (
            max(numbers),
            len(list(folder.glob("done-*.npz"))),
            len(list(folder.glob("part-*.npz"))),
        )

    def wait_for(self, number, n_done=1):
        """Until in a round so many parts are done and others are not; whether that was seen."""
        while self.process.poll() is None:
            now = self.round()
            if now is not None and (now[0] > number or (now[0] == number and now[1] >= n_done)):
                return now[0] == number and now[1] < now[2]
            time.sleep(0.005)
        return False

    def workers(self):
        """The numbers of its worker processes."""
        return [number for number, words in processes(self.mark).items() if "spawn_main" in words]

    def end(self):
        """Its exit code."""
        return self.process.wait(RUN_SECONDS)

    def last_line(self):
        return self.text.read_text().strip().rpartition("\n")[2]


def processes(mark):
    """Processes of a run, by number: their words."""
    result = {}
    for each in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if each.environ().get(MARK) == mark:
                result[each.pid] = " ".join(each.cmdline())
    return result


def gone_after(run):
    """Seconds until nothing that a run started is there."""
    begin = time.monotonic()
    while left := processes(run.mark):
        assert time.monotonic() - begin < LEAVE_SECONDS, f"still there: {left}"
        time.sleep(0.05)
    return time.monotonic() - begin


def bytes_of(path):
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else None


def checked(run, expected, code=0):
    """What is wrong with the end of a run."""
    wrong = [] if (ended := run.end()) == code else [f"exit code {ended}: {run.last_line()}"]
    if expected is not None and bytes_of(run.out) != expected:
        wrong.append("other bytes")
    if code == 0 and run.work.exists():
        wrong.append(f"{run.work.name} is left")
    return wrong


@contextlib.contextmanager
def three_workers():
    """The address of a scheduler with three workers."""
    with subprocess.Popen(
        [sys.executable, "-c", SCHEDULER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        yield child.stdout.readline().strip()
        child.stdin.write("\n")
        child.stdin.flush()


def worker_killed(folder, size, n_rounds, expected):
    """One worker killed in each round that improves the mesh."""
    run, killed = Run(folder / "worker.vtu", size, "--workers", "2"), []
    for number in range(1, n_rounds + 1):
        if run.wait_for(number) and (workers := run.workers()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(max(workers), signal.SIGKILL)
                killed.append(number)
    wrong = checked(run, expected) + ([] if len(killed) == n_rounds else ["not in every round"])
    return f"in rounds {', '.join(map(str, killed))}", wrong


def client_killed(folder, size, n_rounds, expected):
    """The client, with its scheduler, killed in the middle of a round, and a run that goes on."""
    first = Run(folder / "client.vtu", size, "--workers", "2")
    middle = n_rounds // 2
    wrong = [] if first.wait_for(middle, 2) else ["not in the middle of a round"]
    first.process.kill()
    first.end()
    seconds, before = gone_after(first), first.round()
    second = Run(folder / "client.vtu", size, "--workers", "2")
    words = (
        f"with {before[1]} of {before[2]} parts of round {before[0]} done, all gone in "
        f"{seconds:.1f} s"
    )
    wrong += checked(second, expected)
    rounds = re.findall(r"^(?:round (\d+)|measuring)", second.text.read_text(), re.M)
    if rounds.count(str(middle)) != 2 or rounds.count("1") != 1:
        wrong.append(f"rounds {rounds}")
    return words, wrong


def disk_full(folder, size, n_rounds, expected):
    """The disk of the folder of work filled in a round, emptied, and a run that goes on; only
    where one may mount.
    """
    disk = folder / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={FREE_BYTES:.0f}", "tmpfs", disk]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        return "not tried: no file system may be mounted here", []
    try:
        first = Run(disk / "full.vtu", size, "--workers", "2", texts=folder)
        wrong = [] if first.wait_for(2) else ["not in the middle of a round"]
        filler = disk / "filler"
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as stream:
            while first.process.poll() is None:
                stream.write(bytes(4096))
        wrong += checked(first, None, code=2)
        if "No space left" not in first.last_line():
            wrong.append(f"said: {first.last_line()}")
        gone_after(first)
        filler.unlink()
        wrong += (
            [] if first.work.exists() and not first.out.exists() else ["something half-written"]
        )
        wrong += checked(Run(disk / "full.vtu", size, "--workers", "2", texts=folder), expected)
        return "in round 2: one line, nothing lost", wrong
    finally:
        subprocess.run(["umount", disk], check=True)


def interrupted(folder, size, n_rounds, expected):
    """Ctrl-C: the mesh of the last complete round, and a run that goes on."""
    first = Run(folder / "interrupted.vtu", size, "--workers", "2")
    wrong = [] if first.wait_for(3) else ["not in the middle of a round"]
    first.process.send_signal(signal.SIGINT)
    wrong += checked(first, None, code=130)
    if not first.out.exists() or bytes_of(first.out) == expected:
        wrong.append("no mesh of the last complete round")
    gone_after(first)
    second = Run(folder / "interrupted.vtu", size, "--workers", "2", "--force")
    return "in round 3: a mesh, then the whole run's", wrong + checked(second, expected)


def campaign(folder, size):
    """Rows of what was tried: words, what came, whether it is as it should be."""
    begin = time.monotonic()
    run = Run(folder / "one.vtu", size, "--workers", "1")
    wrong, expected = checked(run, None), bytes_of(run.out)
    n_rounds = int(re.findall(r"round \d+ of (\d+)", run.text.read_text())[-1])
    yield (
        "1 worker",
        f"{time.monotonic() - begin:.0f} s, {n_rounds} rounds, sha256 {str(expected)[:12]}",
        wrong,
    )
    begin = time.monotonic()
    wrong = checked(Run(folder / "two.vtu", size, "--workers", "2"), expected)
    yield "2 workers", f"{time.monotonic() - begin:.0f} s, the same bytes", wrong
    with three_workers() as address:
        wrong = checked(Run(folder / "three.vtu", size, "--scheduler", address), expected)
    yield "3 workers of another scheduler", "the same bytes", wrong
    for title, part in (
        ("a worker killed -9", worker_killed),
        ("the client and scheduler killed -9", client_killed),
        ("the disk full", disk_full),
        ("Ctrl-C", interrupted),
    ):
        yield title, *part(folder, size, n_rounds, expected)


def main(size):
    is_good = True
    with tempfile.TemporaryDirectory(prefix="campaign-") as name:
        lines = []
        print(f"{size[0]} nodes in {size[1]} parts, in {name}", flush=True)
        for title, words, wrong in campaign(Path(name), size):
            lines.append(f"{'as it should be' if not wrong else 'WRONG':16} {title:36} {words}")
            print(lines[-1], *wrong, sep="\n  ", flush=True)
            is_good &= not wrong
    print("", *lines, sep="\n")
    return 0 if is_good else 1


if __name__ == "__main__":
    # ignored where a shell runs this in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)
    numbers = [int(word) for word in sys.argv[1:]]
    sys.exit(main((*numbers, *(8000, 4)[len(numbers) :])))
