"""kill -9 within the window of writing leaves the old file or the new one, whole, and confuses
no later run.
"""

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.deep,
    pytest.mark.skipif(sys.platform != "linux", reason="open files are told by /proc"),
]


def test_a_killed_process_leaves_a_whole_file(tmp_path):
    """Old or new; and at most one temporary file, of a hidden name."""
    done = subprocess.run(
        [sys.executable, "-m", "hostile.kills", tmp_path],
        env=os.environ | {"PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "tests")))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    counts = Counter()
    for window, rows in json.loads(done.stdout).items():
        states = ["none" if "new" in window else "old", "new"]
        assert len(rows) > 8, window
        for row in rows:
            step, state, n_hidden, others, is_whole_again = row
            assert state in states, (window, row)
            assert (n_hidden <= 1, others, is_whole_again) == (True, [], True), (window, row)
            counts[step or "none", state, "a hidden file" if n_hidden else ""] += 1
        assert rows[-1][:3] == [None, "new", 0], window
        order = [states.index(row[1]) for row in rows]
        assert order == sorted(order), window
    print("\n| killed before | file | besides | times |\n|---|---|---|---|")
    for row, times in sorted(counts.items()):
        print(f"| {' | '.join(row)} | {times} |")
    assert {state for _, state, _ in counts} == {"none", "old", "new"}
