"""Each step of writing made to fail once, by number, until a run passes: old or new file whole,
nothing else left.

With -s the table of what the faults left is printed. `make test-hostile` has all commands.
"""

import errno
import io
import json
import os
import re
import sys
import tempfile
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from commands import exit_code
from hostile.faults import Allocations, Steps, left_in
from models import sample_image

import tetopt
import tetopt.job.meshing
from tetopt.engine.meshing import Attempt, MeshSearch

pytestmark = [
    pytest.mark.deep,
    pytest.mark.skipif(sys.platform != "linux", reason="open files are told by /proc"),
]

ERRORS = {"full": errno.ENOSPC, "refused": errno.EACCES, "broken": errno.EIO}
MESH = ["mesh", "{in}/a.nii.gz", "--spacing", "8", "--iterations", "1"]
# What is run and what it writes; those of the suite, then those of `make test-hostile`.
COMMANDS = {
    "mesh, numbers": ([*MESH, "-o", "{out}/a.vtu", "--json", "{out}/a.json"], ["a.vtu", "a.json"]),
    "phantom": (
        [
            "phantom",
            "disc_2d",
            "--voxel-mm",
            "8",
            "-o",
            "{out}/p.nii.gz",
            "--labels",
            "{out}/l.nii.gz",
        ],
        ["p.nii.gz", "l.nii.gz"],
    ),
}
MORE_COMMANDS = {
    "mesh, solver": ([*MESH, "--young", "3", "-o", "{out}/a.inp"], ["a.inp"]),
    "mesh, pictures": (
        [*MESH, "-o", "{out}/a.vtu", "--figures", "{out}"],
        ["a.vtu", "slice.png", "rho.png", "energies.png", "thumbnail.png"],
    ),
    "convert": (
        ["convert", "{in}/m.vtu", "{out}/c.feb", "--young", "3", "--json", "{out}/c.json"],
        ["c.feb", "c.json"],
    ),
    "quality": (["quality", "{in}/m.vtu", "--json", "{out}/q.json"], ["q.json"]),
    "segment": (
        [
            "segment",
            "{in}/a.nii.gz",
            "{in}/m.vtu",
            "-o",
            "{out}/s.nii.gz",
            "--json",
            "{out}/s.json",
        ],
        ["s.nii.gz", "s.json"],
    ),
    "surface": (
        ["surface", "{in}/m.vtu", "--boundary", "-o", "{out}/s.stl", "--json", "{out}/s.json"],
        ["s.stl", "s.json"],
    ),
    "fem": (
        [
            "fem",
            "{in}/m.vtu",
            "--young",
            "3",
            "--load",
            "compress:1%",
            "-o",
            "{out}/f.vtu",
            "--json",
            "{out}/f.json",
        ],
        ["f.vtu", "f.json"],
    ),
    "view": (["view", "{in}/m.vtu", "--html", "{out}/v.html"], ["v.html"]),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A tiny image and its mesh."""
    folder = tmp_path_factory.mktemp("inputs")
    tetopt.save_image(folder / "a.nii.gz", sample_image(3))
    assert exit_code(*_filled(MESH, folder, folder), "-o", folder / "m.vtu") == 0
    return folder


@pytest.fixture(scope="module")
def table():
    """What each fault left, counted and printed in the end."""
    counts = Counter()
    yield counts
    print("\n| run | fault | step | exit code | left | times |\n|---|---|---|---|---|---|")
    for row, times in sorted(counts.items()):
        print(f"| {' | '.join(map(str, row))} | {times} |")


@pytest.fixture
def runs(monkeypatch):
    """The optimisation once; whether a mesh is there, which may then not be lost."""
    once = {}

    class Remembered(MeshSearch):
        def __iter__(self):
            if once:  # what is said and checked before goes on in each run
                yield Attempt(once["result"].initial, lambda **_: once["result"])
                self.result = once["result"]
            else:
                yield from super().__iter__()
                once["result"] = self.result
            once["is_there"] = True

    monkeypatch.setattr(tetopt.job.meshing, "MeshSearch", Remembered)
    return once


def _filled(words, source, out):
    return [str(word).replace("{in}", str(source)).replace("{out}", str(out)) for word in words]


def _said(command):
    """Exit code and standard error."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as said:
        code = exit_code(*command)
    return code, said.getvalue()


def _is_new(name, content, expected):
    """Whether a file is whole and of a run without faults; of numbers that a clock changes the
    keys are compared.
    """
    if name.endswith(".json"):
        return list(json.loads(content)) == list(json.loads(expected))
    return content == expected


def _without_fields(content):
    """A solver's file but for the comment that lists the fields of cells."""
    return re.sub(rb"\*\* cell data .*\n", b"", content)


def _check_left(out, other, outputs, before, expected, words):
    """Each output is old, new or not there; besides these there is nothing but a mesh that was
    kept. What is left.
    """
    states, there = [], left_in(out)
    for name in outputs:
        content = there.pop(name, None)
        if content is None:
            assert name not in before, f"{name} was lost ({words})"
            states.append("none")
        elif content == before.get(name):
            states.append("old")
        else:
            if "fields could not be measured" in words:  # it is as told without them
                content, whole = (_without_fields(each) for each in (content, expected[name]))
                is_whole = (
                    name.endswith(".vtu") and len(tetopt.load_mesh(out / name).mesh.cells) > 100
                )
                assert is_whole or _is_new(name, content, whole), f"{name} is not whole ({words})"
            else:
                assert _is_new(name, content, expected[name]), f"{name} is not whole ({words})"
            states.append("new")
    kept = [out / name for name in there if not Path(name).name.startswith(".")]
    kept += [other / name for name in left_in(other)]
    for path in kept:
        assert len(tetopt.load_mesh(path).mesh.cells) > 100
        assert str(path) in words
    hidden = [name for name in there if Path(name).name.startswith(".")]
    return states, kept, hidden


def _every_fault(
    name, command, outputs, inputs, tmp_path, runs, table, kind, is_replacing, steps=slice(1, 1000)
):
    """One command with each of its steps, or those of a slice, failing once."""
    other = tmp_path / "tmp"
    other.mkdir()
    expected, out = {}, tmp_path / "first"
    out.mkdir()
    assert _said(_filled(command, inputs, out))[0] == 0
    expected = left_in(out)
    assert sorted(expected) == sorted(outputs)
    for number in range(steps.start, steps.stop, steps.step or 1):
        out = tmp_path / str(number)
        out.mkdir()
        before = {each: f"old {each}".encode() for each in outputs} if is_replacing else {}
        for each, content in before.items():
            (out / each).write_bytes(content)

        def fail(_):
            raise OSError(ERRORS[kind], os.strerror(ERRORS[kind]))

        runs.pop("is_there", None)
        watch = Steps(out, number, fail)
        with watch.watched():
            code, words = _said(
                [*_filled(command, inputs, out), *(["--force"] if is_replacing else [])]
            )
        states, kept, hidden = _check_left(out, other, outputs, before, expected, words)
        if watch.reached is None:
            assert (code, states, kept, hidden) == (0, ["new"] * len(outputs), [], [])
            assert number > 10 * len(outputs)
            return
        assert code in (0, 2), (watch.reached, words)
        if code == 0:  # what went wrong does not matter
            assert states == ["new"] * len(outputs), watch.reached
        else:
            line = words.strip().splitlines()[-2 if "written before the error" in words else -1]
            assert line.startswith("tetopt: "), words
            assert any(str(out / each) in line for each in outputs), words
        if hidden:  # what cannot be removed
            assert watch.reached == "unlink", (watch.reached, hidden)
        if name.startswith("mesh") and "is_there" in runs:
            assert "new" in states[0] or kept, (watch.reached, words)
        left = [*states, *["kept elsewhere"] * len(kept), *["a hidden file"] * len(hidden)]
        table[
            name,
            f"{kind}, {'old files' if is_replacing else 'no files'}",
            watch.reached,
            code,
            ", ".join(left),
        ] += 1
        for path in kept:
            path.unlink()
    raise AssertionError("no end of steps")


@pytest.mark.parametrize("is_replacing", [False, True])
@pytest.mark.parametrize("name", COMMANDS)
def test_every_step_may_fail(name, is_replacing, inputs, tmp_path, runs, table, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    command, outputs = COMMANDS[name]
    # A mesh takes a second: every tenth of its steps, others with old files than without; `make
    # test-hostile` has all.
    steps = slice(1 + is_replacing, 1000, 10) if name.startswith("mesh") else slice(1, 1000)
    _every_fault(name, command, outputs, inputs, tmp_path, runs, table, "full", is_replacing, steps)


@pytest.mark.slow
@pytest.mark.parametrize("is_replacing", [False, True])
@pytest.mark.parametrize("kind", ERRORS)
@pytest.mark.parametrize("name", [*COMMANDS, *MORE_COMMANDS])
def test_every_step_of_every_command_may_fail(
    name, kind, is_replacing, inputs, tmp_path, runs, table, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    command, outputs = (COMMANDS | MORE_COMMANDS)[name]
    _every_fault(name, command, outputs, inputs, tmp_path, runs, table, kind, is_replacing)


def _every_allocation(name, inputs, tmp_path, runs, table, stride):
    """A command in which each array of tetopt's own code, or one in `stride`, does not fit once."""
    command, outputs = (COMMANDS | MORE_COMMANDS)[name]
    other = tmp_path / "tmp"
    other.mkdir()
    first = tmp_path / "first"
    first.mkdir()
    assert _said(_filled(command, inputs, first))[0] == 0
    expected = left_in(first)
    for number in range(1, 100000, stride):
        out = tmp_path / f"out{number}"
        out.mkdir()
        runs.pop("is_there", None)
        allocations = Allocations(number)
        with allocations.watched():
            code, words = _said(_filled(command, inputs, out))
        states, kept, hidden = _check_left(out, other, outputs, {}, expected, words)
        assert hidden == []
        if allocations.reached is None:
            assert (code, kept) == (0, [])
            return
        if code == 1:  # a number that could not be measured: the others are written
            assert states[0] == "new"
            assert re.search(
                "^tetopt: .* could not be (measured|checked): .*Memory", words, re.MULTILINE
            )
        # of the tiny run that prepares kernels, or of the copy that is kept until the file is
        # written
        elif code == 0:
            assert states == ["new"] * len(outputs), allocations.reached
        else:
            line = words.strip().splitlines()[-2 if "written before the error" in words else -1]
            assert (code, line[:8]) == (2, "tetopt: "), (allocations.reached, code, words)
            assert "emory" in line, (allocations.reached, words)
        if name.startswith("mesh") and "is_there" in runs:
            assert "new" in states[0] or kept, (allocations.reached, words)
        table[
            name,
            "memory",
            allocations.reached.split(":")[0],
            code,
            ", ".join([*states, *["kept"] * len(kept)]),
        ] += 1
        for path in kept:
            path.unlink()
    raise AssertionError("no end of arrays")


def test_arrays_may_not_fit(inputs, tmp_path, runs, table, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    _every_allocation("mesh, numbers", inputs, tmp_path, runs, table, 71)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*COMMANDS, *MORE_COMMANDS])
def test_no_array_may_fit(name, inputs, tmp_path, runs, table, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    _every_allocation(name, inputs, tmp_path, runs, table, 1)


def test_the_harness_sees_a_fault(tmp_path):
    """A write that is not whole, and a file that is left."""
    assert not _is_new("a.json", b"{}", b'{"a": 1}')
    np.testing.assert_equal(_is_new("a.vtu", b"a", b"a"), True)
    for content, hidden in ((b"half", []), (b"old a.vtu", ["x"])):
        (tmp_path / "a.vtu").write_bytes(content)
        for name in hidden:
            (tmp_path / f".{name}").write_bytes(b"")
        other = tmp_path / "none"
        if content == b"half":
            with pytest.raises(AssertionError, match="not whole"):
                _check_left(
                    tmp_path, other, ["a.vtu"], {"a.vtu": b"old a.vtu"}, {"a.vtu": b"new"}, ""
                )
        else:
            left = _check_left(
                tmp_path, other, ["a.vtu"], {"a.vtu": b"old a.vtu"}, {"a.vtu": b"new"}, ""
            )
            assert left == (["old"], [], [".x"])
