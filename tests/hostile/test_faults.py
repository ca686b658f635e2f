"""Each step of writing made to fail once, by number, until a run passes: old or new file whole,
nothing else left; and each array.

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

import pytest
from commands import exit_code
from hostile.faults import Fault, arrays_count, left_in, steps_count
from models import sample_image

import tetopt
import tetopt.job.mesh_stage
from tetopt.engine.meshing import search_mesh

pytestmark = [
    pytest.mark.deep,
    pytest.mark.skipif(sys.platform != "linux", reason="open files are told by /proc"),
]

ERRORS = {"full": errno.ENOSPC, "refused": errno.EACCES, "broken": errno.EIO}
MESH = "mesh {in}/a.nii.gz --spacing 8 --iterations 1"
# What is run, which writes what stands in its words; those of the suite, then those of `make
# test-hostile`.
COMMANDS = {
    "mesh, numbers": f"{MESH} -o {{out}}/a.vtu --json {{out}}/a.json",
    "phantom": "phantom disc_2d --voxel-mm 8 -o {out}/p.nii.gz --labels {out}/l.nii.gz",
    "mesh, solver": f"{MESH} --young 3 -o {{out}}/a.inp",
    "mesh, pictures": f"{MESH} -o {{out}}/a.vtu --figures {{out}}",
    "convert": "convert {in}/m.vtu {out}/c.feb --young 3 --json {out}/c.json",
    "quality": "quality {in}/m.vtu --json {out}/q.json",
    "segment": "segment {in}/a.nii.gz {in}/m.vtu -o {out}/s.nii.gz --json {out}/s.json",
    "surface": "surface {in}/m.vtu --boundary -o {out}/s.stl --json {out}/s.json",
    "fem": "fem {in}/m.vtu --young 3 --load compress:1% -o {out}/f.vtu --json {out}/f.json",
    "view": "view {in}/m.vtu --html {out}/v.html",
}
PICTURES = ["slice.png", "rho.png", "energies.png", "thumbnail.png"]


def _outputs(command):
    """Names of what a command writes."""
    names = re.findall(r"\{out\}/(\S+)", command)
    return names + PICTURES if "--figures" in command else names


def _cases():
    """Command, kind of fault, whether there are old files, numbers of the steps that fail."""
    # A mesh takes a second: every tenth of its steps, others with old files than without, and one
    # array in 71; `make test-hostile` has all.
    for has_old in (False, True):
        yield "mesh, numbers", "full", has_old, range(1 + has_old, 1000, 10)
        yield "phantom", "full", has_old, range(1, 1000)
    yield "mesh, numbers", "memory", False, range(1, 100_000, 71)
    for name in COMMANDS:
        cases = [(kind, has_old, range(1, 1000)) for kind in ERRORS for has_old in (False, True)]
        for case in [*cases, ("memory", False, range(1, 100_000))]:
            yield pytest.param(name, *case, marks=pytest.mark.slow)


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

    def remembered(image, aim, attempt, *required, **options):
        if "result" in once:  # what is said and checked before goes on in each run
            attempt(lambda **_: once["result"], once["result"].initial, aim, [])
        else:
            once["result"] = search_mesh(image, aim, attempt, *required, **options)
        once["is_there"] = True
        return once["result"]

    monkeypatch.setattr(tetopt.job.mesh_stage, "search_mesh", remembered)
    return once


def _filled(command, source, out):
    return command.replace("{in}", str(source)).replace("{out}", str(out)).split()


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
        elif content != before.get(name):
            whole, is_whole = expected[name], False
            if "fields could not be measured" in words:  # it is as told without them
                content, whole = _without_fields(content), _without_fields(whole)
                is_whole = (
                    name.endswith(".vtu") and len(tetopt.load_mesh(out / name).mesh.cells) > 100
                )
            assert is_whole or _is_new(name, content, whole), f"{name} is not whole ({words})"
        is_old = content == before.get(name)
        states.append("none" if content is None else "old" if is_old else "new")
    hidden = [name for name in there if Path(name).name.startswith(".")]
    kept = [out / name for name in there if name not in hidden]
    kept += [other / name for name in left_in(other)]
    for path in kept:
        assert len(tetopt.load_mesh(path).mesh.cells) > 100
        assert str(path) in words
    return states, kept, hidden


@pytest.mark.parametrize(("name", "kind", "has_old", "numbers"), _cases())
def test_every_step_may_fail(
    name, kind, has_old, numbers, inputs, tmp_path, runs, table, monkeypatch
):
    """Of a command, once each."""
    command, outputs = COMMANDS[name], _outputs(COMMANDS[name])
    other, first = tmp_path / "tmp", tmp_path / "first"
    other.mkdir()
    first.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(other))
    assert _said(_filled(command, inputs, first))[0] == 0
    expected = left_in(first)
    assert sorted(expected) == sorted(outputs)
    before = {each: f"old {each}".encode() for each in outputs} if has_old else {}
    is_memory = kind == "memory"

    def fail(step):
        if is_memory:
            raise MemoryError(f"Unable to allocate an array ({step})")
        raise OSError(ERRORS[kind], os.strerror(ERRORS[kind]))

    for number in numbers:
        out = tmp_path / str(number)
        out.mkdir()
        for each, content in before.items():
            (out / each).write_bytes(content)
        runs.pop("is_there", None)
        fault = Fault(number, fail)
        with arrays_count(fault) if is_memory else steps_count(fault, out):
            code, words = _said([*_filled(command, inputs, out), *["--force"] * has_old])
        states, kept, hidden = _check_left(out, other, outputs, before, expected, words)
        step = fault.reached
        if step is None:
            assert (code, states, kept, hidden) == (0, ["new"] * len(outputs), [], [])
            assert is_memory or number > 10 * len(outputs)
            return
        # What cannot be removed is left.
        assert hidden == [] or step == "unlink", (step, hidden)
        _check_words(code, words, states, (step, words), out, outputs, is_memory)
        if name.startswith("mesh") and "is_there" in runs:
            assert "new" in states[0] or kept, (step, words)
        left = [*states, *["kept elsewhere"] * len(kept), *["a hidden file"] * len(hidden)]
        fault_of_row = f"{kind}, {'old files' if has_old else 'no files'}"
        table[name, fault_of_row, step.split(":")[0], code, ", ".join(left)] += 1
        for path in kept:
            path.unlink()
    raise AssertionError("no end of steps")


def _check_words(code, words, states, where, out, outputs, is_memory):
    """The exit code fits what is left, and a refusal is a line that names the fault."""
    if code == 0:  # what went wrong does not matter
        assert set(states) == {"new"}, where
    elif code == 1 and is_memory:  # a number could not be measured: the others are written
        assert states[0] == "new", where
        pattern = "^tetopt: .* could not be (measured|checked): .*Memory"
        assert re.search(pattern, words, re.MULTILINE), where
    else:
        line = words.strip().splitlines()[-2 if "written before the error" in words else -1]
        assert (code, line[:8]) == (2, "tetopt: "), where
        causes = ["emory"] if is_memory else [str(out / each) for each in outputs]
        assert any(cause in line for cause in causes), where


def test_the_harness_sees_a_fault(tmp_path):
    """A write that is not whole, and a file that is left."""
    assert not _is_new("a.json", b"{}", b'{"a": 1}')
    assert _is_new("a.vtu", b"a", b"a")

    def check():
        before, expected = {"a.vtu": b"old a.vtu"}, {"a.vtu": b"new"}
        return _check_left(tmp_path, tmp_path / "none", ["a.vtu"], before, expected, "")

    (tmp_path / "a.vtu").write_bytes(b"half")
    with pytest.raises(AssertionError, match="not whole"):
        check()
    (tmp_path / "a.vtu").write_bytes(b"old a.vtu")
    (tmp_path / ".x").touch()
    assert check() == (["old"], [], [".x"])
