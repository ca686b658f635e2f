"""The harness seen to fail: in place of the command everything that none may do, each once;
prints the outcomes.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

if __name__ == "__main__":
    import fuzz.__main__  # noqa: F401 - one thread, before numpy comes

import nibabel
import numpy as np
from fuzz import campaign
from fuzz.cases import Case

SOUND = b"""# vtk DataFile Version 3.0
x
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 4 double
0 10 20 5 10 20 0 15 20 0 10 25
CELLS 1 5
4 0 1 2 3
CELL_TYPES 1
10
"""
WITH_FIFTH = SOUND.replace(b"POINTS 4", b"POINTS 5").replace(b"25\n", b"25 9 11 21\n")


def say(*lines: str) -> None:
    """Say something where refusals are said."""
    print(*lines, sep="\n", file=sys.stderr, flush=True)


def write(data: bytes = SOUND, name: str = "out.vtk") -> int:
    """Write a file, as a command that went well does."""
    Path(name).write_bytes(data)
    return 0


def refuse(line: str = "tetopt: i.nii: expected voxels, got none; copy it again") -> int:
    """Refuse as one should."""
    say(line)
    return 2


def write_in_temporary() -> int:
    """Leave a file where temporary files go."""
    Path(tempfile.gettempdir(), "left").touch()
    return refuse()


def allocate() -> int:
    """Take far more memory than the input has bytes."""
    return len(b"x" * 2_400_000_000) and refuse()


def spin() -> int:
    """Never come to an end."""
    while True:
        pass


# What is done, and the outcome that it must have.
DEEDS = {
    "done": (write, "done"),
    "refused": (refuse, "refused"),
    "requirement violated": (
        lambda: write() or say("tetopt: out.vtk: 3 cells are flat") or 1,
        "requirement violated",
    ),
    "exception": (lambda: 1 // 0, "traceback"),
    "deep recursion": (lambda: json.loads("[" * 100_000), "traceback"),
    "segmentation fault": (lambda: os.kill(os.getpid(), signal.SIGSEGV), "signal"),
    "abort": (os.abort, "signal"),
    "spinning": (spin, "hang"),
    "waiting": (lambda: time.sleep(1000), "hang"),
    "memory": (allocate, "memory"),
    "half a file": (lambda: write(SOUND[:100]), "invalid output"),
    "empty file": (lambda: write(b""), "invalid output"),
    "inverted cell": (lambda: write(SOUND.replace(b"4 0 1 2 3", b"4 0 2 1 3")), "invalid output"),
    "flat cell": (lambda: write(SOUND.replace(b"0 10 25", b"3 13 20")), "invalid output"),
    "unused node": (lambda: write(WITH_FIFTH), "invalid output"),
    "not a number": (lambda: write(SOUND.replace(b"0 10 25", b"0 nan 25")), "invalid output"),
    "beyond the box": (lambda: write(SOUND.replace(b"0 10 25", b"0 10 99")), "invalid output"),
    "not XML": (lambda: write(b"<VTKFile><a b='<'/></VTKFile>", "out.vtu"), "invalid output"),
    "markup": (
        lambda: write(b"<html><script>hostile()</script></html>", "v.html"),
        "invalid output",
    ),
    "infinity in JSON": (lambda: write(b'{"E": Infinity}', "o.json"), "invalid output"),
    "refused and written": (lambda: write() or refuse(), "half-written"),
    "temporary file left": (write_in_temporary, "stray file"),
    "beside the output": (lambda: write() or write(b"x", ".out.vtk.1234"), "stray file"),
    "input changed": (lambda: write(b"x", "i.nii") or refuse(), "stray file"),
    "outside touched": (lambda: write(b"x", "../outside.raw") or refuse(), "stray file"),
    "code run": (lambda: Path("PWNED").touch() or refuse(), "stray file"),
    "no line": (lambda: 2, "refused badly"),
    "two lines": (lambda: refuse() and refuse(), "refused badly"),
    "empty line": (lambda: refuse("tetopt: "), "refused badly"),
    "long line": (lambda: refuse("tetopt: " + "x" * 600), "refused badly"),
    "library's words": (
        lambda: say("ERROR: In vtkReader.cxx, line 7") or refuse(),
        "refused badly",
    ),
    "control characters": (
        lambda: refuse("tetopt: \x1b[2Ji.nii: expected voxels"),
        "refused badly",
    ),
    "nothing written": (lambda: 0, "wrong exit code"),
    "other code": (lambda: 3, "wrong exit code"),
}


def main() -> int:
    """Do each of the deeds in a child, and print the outcomes as JSON."""
    campaign.IDLE_SECONDS = 1
    deeds = list(DEEDS)
    place = np.diag([2.0, 2.0, 3.0, 1.0])
    place[:3, 3] = -5.0, 7.0, 11.0
    box = nibabel.Nifti1Image(np.zeros((12, 12, 12), np.uint8), place).to_bytes()
    outputs = ("out.vtk", "out.vtu", "v.html", "o.json")
    campaign.case_of = lambda seeds, seed, number: Case(  # type: ignore[assignment]
        "NIfTI", "", ("mesh", "box.nii", deeds[number]), {"i.nii": b"1", "box.nii": box}, outputs
    )
    campaign.app.main = lambda words: DEEDS[words[2]][0]()  # type: ignore[assignment]
    campaign.Campaign.make_seeds = lambda self: None  # type: ignore[method-assign]
    outcomes = {}
    with tempfile.TemporaryDirectory() as scratch:
        for number, deed in enumerate(deeds):
            # a slow machine takes seconds to fill memory
            campaign.MOST_CPU_SECONDS = 2 if deed == "spinning" else 60
            one = campaign.Campaign(1, 1, Path(scratch), Path(scratch) / "failures")
            one.run([number], 100.0)
            outcomes[deed] = next(outcome for _, outcome in one.counts)
    print(json.dumps(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
