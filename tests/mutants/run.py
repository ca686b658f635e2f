"""Whether the tests see small faults: without any mutant of the lists beside this file they pass,
with each they fail.

Run as ``python tests/mutants/run.py [--jobs N] [LIST ...]``. Mutants are put into copies of the
tree, one for each job, never into the tree itself.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[2]
COPIES = ROOT / ".mutants"  # of always the same places: numba's cache goes by paths
PYTEST = ["-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider"]
MOST_SECONDS = 900.0  # of a selection of tests, on a busy machine
SHOWN_SECONDS = 60.0  # a longer run is a selection of tests to narrow

free_copies: SimpleQueue[Path] = SimpleQueue()


def make_copy(folder: Path) -> None:
    """Copy the files that git knows, with their times, to a folder."""
    names = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split("\n")
    shutil.rmtree(folder, ignore_errors=True)
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def run_tests(copy: Path, words: list[str], is_plain: bool) -> tuple[int, float]:
    """Run pytest in a copy as it is: exit code and seconds."""
    begin = time.monotonic()
    environment = os.environ | {
        "PYTHONPATH": str(copy),
        "PYTHONUTF8": "1",
        "MPLBACKEND": "agg",
        "PYTEST_ADDOPTS": "",
        "NUMBA_CACHE_DIR": str(ROOT / ".numba_cache" / "mutants"),
    }
    if is_plain:
        environment["NUMBA_DISABLE_JIT"] = "1"
    try:
        run = subprocess.run(
            [sys.executable, *PYTEST, "-m", "not slow", *words],
            cwd=copy,
            env=environment,
            capture_output=True,
            text=True,
            timeout=MOST_SECONDS,
        )
    except subprocess.TimeoutExpired:  # tests that run without end fail
        return 1, MOST_SECONDS
    if run.returncode not in (0, 1):  # 2 to 5: no tests, or they could not be collected
        raise SystemExit(f"{words}: pytest exited with {run.returncode}\n{run.stdout[-2000:]}")
    return run.returncode, time.monotonic() - begin


def run_sound(file: str, selections: set[str], is_plain: bool) -> None:
    """Run all selections of a file of tests, which must pass without a mutant."""
    words = [file] if "" in selections else [file, "-k", " or ".join(sorted(selections))]
    copy = free_copies.get()
    try:
        if run_tests(copy, words, is_plain)[0] != 0:
            raise SystemExit(f"{words}: expected to pass without a mutant")
    finally:
        free_copies.put(copy)


def run_mutated(mutant: dict[str, str]) -> tuple[int, float]:
    """Run the tests of a mutant with it: exit code and seconds."""
    copy = free_copies.get()
    path = copy / mutant["file"]
    text, status = path.read_text(encoding="utf-8"), path.stat()
    try:
        if text.count(mutant["old"]) != 1:
            raise SystemExit(
                f"{mutant['file']}: expected {mutant['old']!r} once, got "
                f"{text.count(mutant['old'])} times"
            )
        path.write_text(text.replace(mutant["old"], mutant["new"]), encoding="utf-8")
        return run_tests(copy, mutant["tests"].split(), bool(mutant.get("plain")))
    finally:
        path.write_text(text, encoding="utf-8")
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
        free_copies.put(copy)


def main() -> int:
    """Print a line a mutant, in the order of the lists; 1 if one survives.

    Keys of a mutant are file, old (which is there once), new, tests (a file, and -k with a word),
    and plain, which is true where kernels are to run as Python.
    """
    parser = argparse.ArgumentParser(prog="run.py", description=__doc__)
    parser.add_argument("--jobs", type=int, default=1, help="how many mutants at a time")
    parser.add_argument("lists", nargs="*", type=Path)
    chosen = parser.parse_args()
    mutants = [
        mutant
        for path in chosen.lists or sorted(Path(__file__).parent.glob("*.toml"))
        for mutant in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]
    ]
    for job in range(chosen.jobs):
        make_copy(COPIES / str(job))
        free_copies.put(COPIES / str(job))
    selections: dict[tuple[str, bool], set[str]] = {}
    for mutant in mutants:
        file, _, word = mutant["tests"].partition(" -k ")
        selections.setdefault((file, bool(mutant.get("plain"))), set()).add(word)
    n_killed = 0
    with ThreadPoolExecutor(chosen.jobs) as pool:
        try:
            sound = [
                pool.submit(run_sound, file, words, is_plain)
                for (file, is_plain), words in selections.items()
            ]
            runs = [pool.submit(run_mutated, mutant) for mutant in mutants]
            for run in sound:
                run.result()
            for mutant, run in zip(mutants, runs, strict=True):
                code, seconds = run.result()
                n_killed += code
                line = next(iter(mutant["new"].strip().splitlines()), "(taken out)")
                notice = f" [{seconds:.0f} s]" if seconds > SHOWN_SECONDS else ""
                outcome = "killed  " if code else "SURVIVED"
                print(outcome, mutant["file"], line[:80] + notice, flush=True)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    print(f"{n_killed} of {len(mutants)} mutants killed")
    return int(n_killed < len(mutants))


if __name__ == "__main__":
    sys.exit(main())
