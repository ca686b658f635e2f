"""Many hostile inputs, each in a forked child of this process, which has everything loaded;
outcomes counted.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numba.np.ufunc.parallel as numba_threads
from fuzz.cases import KINDS, Case, case_of
from fuzz.judge import BAD, GOOD, Ending, Verdict, listing, page_words, verdict
from fuzz.seeds import SPARSE_SIZE, Seeds, load_seeds, special, write_seeds

from tetopt.cli import app

MOST_MEMORY = 3 << 30  # bytes of address space that a command may take beyond this process
LARGEST_FILE = 1 << 28  # bytes that it may write
MOST_CPU_SECONDS = 10
MOST_SECONDS = 120  # on a busy machine
# after which a child that has used no more than this fraction of them waits for ever
IDLE_SECONDS = 10
IDLE_FRACTION = 0.04
POLL_SECONDS = 0.002


class Running(NamedTuple):
    """A child at work."""

    number: int
    case: Case
    folder: Path
    before: dict[str, tuple]
    begin: float


def load_everything() -> None:
    """Import what any command imports, and link all kernels, without starting a thread that a
    fork would lose.
    """
    modules = [f"tetopt.cli.{module}" for module in app.COMMANDS.values()]
    modules += [f"tetopt.report.{name}" for name in ("exhibit", "explore", "figures")]
    modules += ["tetopt.fem.reference", "tetopt.fem.solution", "tetopt.measure.segmentation"]
    modules += ["SimpleITK", "pydicom.pixels", "PIL.Image", "meshio", "pyvista", "trimesh"]
    modules += ["zarr", "zarr.codecs"]
    for name in modules:
        import_module(name)
    kernels = import_module("tetopt.system.kernels")
    kernels.link(kernels.roots())


def in_child(work, folder: Path, log: Path) -> int:
    """Run a function in a forked child, in a folder, its words in a log; its process number."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        return child
    code = 71
    try:
        with contextlib.suppress(AttributeError):
            numba_threads._is_initialized = False  # the pool of the parent is not here
        os.setsid()
        os.chdir(folder)
        for descriptor, name in ((0, os.devnull), (1, f"{log}.out"), (2, f"{log}.err")):
            handle = os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
            os.dup2(handle, descriptor)
        code = work()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 70
    except BaseException:
        traceback.print_exc()
        code = 70
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(code if 0 <= code < 256 else 72)


def limited(words: tuple[str, ...], temporary: Path) -> int:
    """The command under limits of memory, time and file size; its exit code."""
    os.environ["TMPDIR"] = tempfile.tempdir = str(temporary)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY,) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_SECONDS, MOST_CPU_SECONDS + 2))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.argv = ["tetopt", *words]
    with contextlib.suppress(ImportError):  # an older tetopt reads in its own process
        child: Any = import_module("tetopt.system.child")
        child.subprocess = SimpleNamespace(Popen=ForkedReader, PIPE=None, DEVNULL=None)
    return app.main(list(words))


def laid_out(case: Case, folder: Path) -> None:
    """The files of a case, in `cwd`, and beside it one that nothing may touch."""
    (folder / "cwd").mkdir(parents=True)
    (folder / "tmp").mkdir()
    (folder / "outside.raw").write_bytes(bytes(1) * 10_000)
    for name, data in case.files.items():
        path = folder / "cwd" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if data.startswith(b"special:sparse:"):
            path.write_bytes(data[15:])
            os.truncate(path, SPARSE_SIZE)
        elif data.startswith(b"special:"):
            special(path, data[8:].decode())
        else:
            path.write_bytes(data)


def _is_hanging(child: int, seconds: float) -> bool:
    """Whether a child has had its time, or waits for something that does not come."""
    if seconds < IDLE_SECONDS:
        return False
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):  # its own children among them
        with contextlib.suppress(OSError):  # it may end just now
            fields = path.read_text().rpartition(")")[2].split()
            ticks += sum(map(int, fields[11:15])) if int(fields[3]) == child else 0
    return ticks / os.sysconf("SC_CLK_TCK") < IDLE_FRACTION * seconds or seconds > MOST_SECONDS


class ForkedReader:
    """In place of the process in which `tetopt.io.apart` reads: forked, so that it need not load
    the libraries.
    """

    def __init__(self, *_: Any, **__: Any) -> None:
        job, answer = os.pipe(), os.pipe()
        self.child = os.fork()
        if self.child == 0:
            os.dup2(job[0], 0)
            os.dup2(answer[1], 1)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            os.closerange(3, 100)
            try:
                import_module("tetopt.io.apart").main()
            finally:
                os._exit(1)
        os.close(job[0])
        os.close(answer[1])
        self.stdin, self.stdout = os.fdopen(job[1], "wb"), os.fdopen(answer[0], "rb")
        self.code: int | None = None

    def wait(self) -> int:
        """Its exit code."""
        if self.code is None:
            self.code = os.waitstatus_to_exitcode(os.waitpid(self.child, 0)[1])
        return self.code

    def kill(self) -> None:
        """End it, if it has not ended."""
        if self.code is None:
            os.kill(self.child, signal.SIGKILL)


class Campaign:
    """A run over many numbers of one seed."""

    def __init__(self, seed: int, workers: int, scratch: Path, failures: Path) -> None:
        self.seed, self.workers, self.scratch, self.failures = seed, workers, scratch, failures
        self.counts: Counter[tuple[str, str]] = Counter()
        self.reasons: Counter[str] = Counter()
        self.slowest: list[tuple[float, int]] = []
        self.running: dict[int, Running] = {}
        self.seeds = self.make_seeds()

    def make_seeds(self) -> Seeds:
        """The valid files, made in a child."""
        folder = self.scratch / "seeds"
        folder.mkdir()
        child = in_child(lambda: write_seeds(folder) or 0, folder, self.scratch / "seeds")
        if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0:
            raise SystemExit((self.scratch / "seeds.err").read_text()[-3000:])
        return load_seeds(folder)

    def run(self, numbers: list[int], max_seconds: float) -> int:
        """Run these cases, as far as the time goes; how many were run."""
        begin, waiting = time.monotonic(), list(reversed(numbers))
        while self.running or (waiting and time.monotonic() - begin < max_seconds):
            while (
                waiting
                and len(self.running) < self.workers
                and time.monotonic() - begin < max_seconds
            ):
                self._start(waiting.pop())
            self._reap()
        return len(numbers) - len(waiting)

    def _start(self, number: int) -> None:
        case = case_of(self.seeds, self.seed, number)
        folder = self.scratch / str(number)
        laid_out(case, folder)
        before = listing(folder)
        log = self.scratch / f"{number}.log"
        child = in_child(lambda: limited(case.words, folder / "tmp"), folder / "cwd", log)
        self.running[child] = Running(number, case, folder, before, time.monotonic())

    def _reap(self) -> None:
        for child in list(self.running):
            one = self.running[child]
            ended, status, usage = os.wait4(child, os.WNOHANG)
            is_killed = not ended and _is_hanging(child, time.monotonic() - one.begin)
            if is_killed:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child, signal.SIGKILL)
                _, status, usage = os.wait4(child, 0)
            if ended or is_killed:
                del self.running[child]
                self._count(one, os.waitstatus_to_exitcode(status), is_killed, usage)
        time.sleep(POLL_SECONDS)

    def _count(
        self, one: Running, code: int, is_killed: bool, usage: resource.struct_rusage
    ) -> None:
        log = self.scratch / f"{one.number}.log"
        texts = [
            Path(f"{log}.{end}").read_bytes().decode("utf-8", "backslashreplace")
            for end in ("out", "err")
        ]
        # Not ru_maxrss of its own, which begins at that of the program that has started it.
        own = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        used = max(usage.ru_maxrss * 1024 - own, 0)
        ending = Ending(code, is_killed, time.monotonic() - one.begin, used, *texts)
        judged = verdict(one.case, one.folder, one.before, ending)
        self.counts[one.case.kind, judged.outcome] += 1
        self.slowest = sorted([*self.slowest, (usage.ru_utime + usage.ru_stime, one.number)])[-5:]
        if judged.outcome not in GOOD:
            if self.reasons[judged.key] == 0:
                self._keep(one, judged, ending)
            self.reasons[judged.key] += 1
        shutil.rmtree(one.folder, ignore_errors=True)
        for end in ("out", "err"):
            Path(f"{log}.{end}").unlink()

    def _keep(self, one: Running, judged: Verdict, ending: Ending) -> None:
        """The input, with the command that runs it again, where somebody will look."""
        name = f"{judged.outcome.replace(' ', '-')}-{self.seed}-{one.number}"
        target = self.failures / name
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        for path, data in one.case.files.items():
            place = target / path
            with contextlib.suppress(OSError):
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(data if len(data) < 2_000_000 else data[:1000])
        lines = [
            f"outcome: {judged.outcome}: {judged.why}",
            f"input:   {one.case.kind}: {one.case.what}",
            f"command: tetopt {' '.join(shlex.quote(word) for word in one.case.words)}"[:3000],
            f"again:   PYTHONPATH=scripts python -m fuzz --seed {self.seed} --only "
            f"{one.number} --show",
            f"ended:   exit {ending.code} after {ending.seconds:.1f} s, "
            f"{ending.n_bytes / 1e6:.0f} MB more than before",
            "",
            *ending.output.splitlines()[-5:],
            *ending.errors.splitlines()[-25:],
        ]
        (self.failures / f"{name}.txt").write_text(
            "\n".join(page_words(line)[:400] for line in lines) + "\n", encoding="utf-8"
        )

    def table(self) -> list[str]:
        """Outcomes by kind of input, in Markdown."""
        shown = [
            outcome
            for outcome in (*GOOD, *BAD)
            if any(self.counts[kind, outcome] for kind in KINDS)
        ]
        rows = [f"| input | {' | '.join(shown)} |", f"|---|{'---:|' * len(shown)}"]
        rows += [
            f"| {kind} | {' | '.join(str(self.counts[kind, outcome] or '') for outcome in shown)} |"
            for kind in KINDS
            if any(self.counts[kind, outcome] for outcome in shown)
        ]
        sums = [sum(self.counts[kind, outcome] for kind in KINDS) for outcome in shown]
        return [*rows, f"| all | {' | '.join(map(str, sums))} |"]

    @property
    def n_bad(self) -> int:
        """How many cases ended in a way that none may."""
        return sum(count for (_, outcome), count in self.counts.items() if outcome not in GOOD)


def main() -> int:
    """Run a campaign from the command line; the exit code is 1 if any case ended badly."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=200, help="how many")
    parser.add_argument(
        "--seed",
        type=int,
        default=int(os.environ.get("HOSTILE_SEED", "1")),
        help="also HOSTILE_SEED",
    )
    parser.add_argument("--only", type=int, nargs="*", help="these numbers alone")
    parser.add_argument("--kind", choices=list(KINDS), help="of this kind alone")
    parser.add_argument("--first", type=int, default=0, help="the first number")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--max-seconds", type=float, default=1e9, help="start no more after this time"
    )
    parser.add_argument(
        "--failures",
        type=Path,
        default=Path(tempfile.gettempdir()) / "tetopt-hostile",
        help="where inputs go that ended badly",
    )
    parser.add_argument("--json", type=Path, help="write the counts here")
    parser.add_argument("--show", action="store_true", help="print the reports of what ended badly")
    chosen = parser.parse_args()
    begin = time.monotonic()
    load_everything()
    with tempfile.TemporaryDirectory(prefix="hostile-") as scratch:
        campaign = Campaign(chosen.seed, chosen.workers, Path(scratch), chosen.failures)
        if (numbers := chosen.only) is None:
            cases = (
                case_of(campaign.seeds, chosen.seed, number)
                for number in itertools.count(chosen.first)
            )
            own = (
                number
                for number, case in enumerate(cases, chosen.first)
                if chosen.kind in (None, case.kind)
            )
            numbers = list(itertools.islice(own, chosen.inputs))
        count = campaign.run(numbers, chosen.max_seconds)
    print("\n".join(campaign.table()))
    print(
        f"\n{count} inputs of seed {chosen.seed} in {time.monotonic() - begin:.0f} s, "
        f"{campaign.n_bad} ended badly"
    )
    for reason, times in campaign.reasons.most_common():
        print(f"{times:5d} x {page_words(reason)[:180]}")
    if campaign.reasons:
        print(f"each of them once, with its command, in {chosen.failures}")
    if chosen.show:
        for report in sorted(chosen.failures.glob("*.txt")):
            print(report.read_text(encoding="utf-8"))
    if chosen.json is not None:
        table = [
            [kind, outcome, times] for (kind, outcome), times in sorted(campaign.counts.items())
        ]
        chosen.json.write_text(
            json.dumps(
                {
                    "inputs": count,
                    "bad": campaign.n_bad,
                    "counts": table,
                    "reasons": campaign.reasons,
                }
            )
        )
    return 1 if campaign.n_bad else 0
