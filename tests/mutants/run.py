"""Whether the tests see small faults: without any mutant of the lists beside this file they pass,
with each they fail.

Run as ``python tests/mutants/run.py [LIST ...]``. Mutants are put into a copy of the tree, never
into the tree itself.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COPY = ROOT / ".mutants"  # of always the same place: numba's cache goes by paths


def copied() -> None:
    """Copy the files that git knows, with their times, to COPY."""
    names = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split("\n")
    shutil.rmtree(COPY, ignore_errors=True)
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (COPY / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, COPY / name)


@cache
def exit_code(tests: str, is_plain: bool, mutant: str = "") -> int:
    """That of pytest, of these files and options, in COPY as it is; `mutant` tells one state of
    it from another.
    """
    environment = os.environ | {
        "PYTHONPATH": str(COPY),
        "PYTHONUTF8": "1",
        "MPLBACKEND": "agg",
        "PYTEST_ADDOPTS": "",
    }
    environment |= {"NUMBA_CACHE_DIR": str(ROOT / ".numba_cache" / "mutants")}
    environment |= {"NUMBA_DISABLE_JIT": "1"} if is_plain else {}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-n0",
        "-p",
        "no:cacheprovider",
        "-m",
        "not slow",
    ]
    run = subprocess.run(
        [*command, *tests.split()], cwd=COPY, env=environment, capture_output=True, text=True
    )
    if run.returncode not in (0, 1):  # 2 to 5: no tests, or they could not be collected
        raise SystemExit(
            f"{mutant or tests}: pytest exited with {run.returncode}\n{run.stdout[-2000:]}"
        )
    return run.returncode


def is_killed(mutant: dict[str, str]) -> bool:
    """Whether the tests of a mutant pass without it, and fail with it.

    Keys are file, old (which is there once), new, tests (files, and options of pytest), and plain,
    which is true where kernels are to run as Python.
    """
    path, tests, is_plain = COPY / mutant["file"], mutant["tests"], bool(mutant.get("plain"))
    text = path.read_text(encoding="utf-8")
    if text.count(mutant["old"]) != 1:
        raise SystemExit(
            f"{mutant['file']}: expected {mutant['old']!r} once, got {text.count(mutant['old'])} "
            "times"
        )
    if exit_code(tests, is_plain) != 0:
        raise SystemExit(f"{tests}: expected to pass without a mutant")
    status = path.stat()
    path.write_text(text.replace(mutant["old"], mutant["new"]), encoding="utf-8")
    try:
        return exit_code(tests, is_plain, f"{mutant['file']}: {mutant['new']}") == 1
    finally:
        path.write_text(text, encoding="utf-8")
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def main() -> int:
    """Print a line a mutant; 1 if one survives."""
    lists = [Path(name) for name in sys.argv[1:]] or sorted(Path(__file__).parent.glob("*.toml"))
    copied()
    killed = []
    for path in lists:
        for mutant in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]:
            killed.append(is_killed(mutant))
            line = next(iter(mutant["new"].strip().splitlines()), "(taken out)")
            print("killed  " if killed[-1] else "SURVIVED", mutant["file"], line[:80], flush=True)
    print(f"{sum(killed)} of {len(killed)} mutants killed")
    return int(not all(killed))


if __name__ == "__main__":
    sys.exit(main())
