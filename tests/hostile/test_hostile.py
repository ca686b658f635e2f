"""Hostile inputs: refused in one clear line, or meshed well; and the harness sees it where that
is not so.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hostile.judge import GOOD
from hostile.sabotage import DEEDS

ROOT = Path(__file__).resolve().parents[2]
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
    path = os.pathsep.join((str(ROOT), str(ROOT / "tests")))
    command = [sys.executable, "-m", module, *map(str, words)]
    return subprocess.run(
        command,
        env=os.environ | {"PYTHONPATH": path, "PYTHONUTF8": "1"},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="slow as plain Python")
def test_hostile_inputs_end_well(tmp_path):
    done = run(
        "hostile",
        "--inputs",
        N_INPUTS,
        "--seed",
        1,
        "--failures",
        tmp_path / "failures",
        "--json",
        tmp_path / "c",
    )
    assert (tmp_path / "c").exists(), done.stderr[-3000:]
    report = json.loads((tmp_path / "c").read_text())
    bad = [row for row in report["counts"] if row[1] not in GOOD]
    assert bad == [], done.stdout
    assert done.returncode == 0
    assert report["inputs"] == N_INPUTS
    of_outcome = {
        good: sum(times for _, outcome, times in report["counts"] if outcome == good)
        for good in GOOD
    }
    # neither everything nor nothing is refused
    assert min(of_outcome["done"], of_outcome["refused"]) > N_INPUTS / 10


def test_the_harness_sees_every_kind_of_failure():
    done = run("hostile.sabotage")
    assert done.returncode == 0, done.stderr[-3000:]
    assert json.loads(done.stdout) == {deed: outcome for deed, (_, outcome) in DEEDS.items()}
