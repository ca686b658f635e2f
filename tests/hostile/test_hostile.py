"""Hostile inputs: refused in one clear line, or meshed well; and the harness sees it where that
is not so.
"""

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from fuzz.judge import GOOD
from fuzz.sabotage import DEEDS

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
N_INPUTS = 40  # of `make test-hostile`'s 10,000

pytestmark = [
    pytest.mark.deep,
    pytest.mark.skipif(
        not hasattr(os, "fork") or not Path("/proc/self").exists(), reason="forks, reads /proc"
    ),
]


def run(module, *words):
    """Run a module of the harness in a process of its own, since this one has threads that a
    fork would lose.
    """
    return subprocess.run(
        [sys.executable, "-m", module, *map(str, words)],
        env=os.environ | {"PYTHONPATH": str(SCRIPTS), "PYTHONUTF8": "1"},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="slow as plain Python")
def test_hostile_inputs_end_well(tmp_path):
    out = tmp_path / "counts.json"
    words = f"--inputs {N_INPUTS} --seed 1 --failures {tmp_path / 'failures'} --json {out}"
    done = run("fuzz", *words.split())
    assert out.exists(), done.stderr[-3000:]
    report = json.loads(out.read_text())
    assert [row for row in report["counts"] if row[1] not in GOOD] == [], done.stdout
    assert (done.returncode, report["inputs"]) == (0, N_INPUTS)
    times = Counter()
    for _, outcome, count in report["counts"]:
        times[outcome] += count
    # neither everything nor nothing is refused
    assert min(times["done"], times["refused"]) > N_INPUTS / 10


def test_the_harness_sees_every_kind_of_failure():
    done = run("fuzz.sabotage")
    assert done.returncode == 0, done.stderr[-3000:]
    assert json.loads(done.stdout) == {deed: outcome for deed, (_, outcome) in DEEDS.items()}
