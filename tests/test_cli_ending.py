"""How the command ends when a signal comes, when its streams are closed, full or gone, and when
memory is short.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from commands import assert_done, assert_refuses, exit_code, numbers_in, run_command
from models import sample_image

import tetopt
import tetopt.cli.mesh
import tetopt.cli.phantom
import tetopt.cli.run
import tetopt.job.source
import tetopt.measure.measures
from tetopt.cli.ending import is_ended, mesh_kept, signal_code, signals_heard
from tetopt.engine.meshing import search_mesh

pytestmark = pytest.mark.deep
NEEDS_SIGNALS = pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
NEEDS_FULL = pytest.mark.skipif(
    not os.path.exists("/dev/full"), reason="the system has no device that is always full"
)
LATE_SIGNALS = [signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)]
MESH = "mesh in/a.nii.gz -o out/a.vtu --json out/a.json --spacing 8 --iterations 2"
PHANTOM = "phantom disc_2d -o out/a.nii --voxel-mm 8"


@pytest.fixture(autouse=True)
def folders(here):
    """A folder with a tiny image, and one where outputs go."""
    Path("in").mkdir()
    Path("out").mkdir()
    tetopt.save_image("in/a.nii.gz", sample_image(3))


def written():
    return sorted(os.listdir("out"))


def failing(error):
    """A function that does nothing but raise."""

    def fail(*_, **__):
        raise error

    return fail


def before(owner, name, act, monkeypatch):
    """Do something each time before a function is called."""
    call = getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *arguments: (act(), call(*arguments))[1])


# --------------------------------------------------------------------------------------------------
# Signals


@pytest.fixture
def signals_not_ignored():
    """As in a terminal: under nohup SIGHUP is ignored, and SIGINT in the background of a script."""
    handlers = {number: signal.signal(number, signal.SIG_DFL) for number in LATE_SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


def name_of(number):
    return "Ctrl-C" if number == signal.SIGINT else number.name


@NEEDS_SIGNALS
@pytest.mark.parametrize("number", LATE_SIGNALS)
def test_a_signal_leaves_the_mesh_reached(monkeypatch, signals_not_ignored, number):
    @contextmanager
    def told(*_):
        yield lambda row: signal.raise_signal(number) if row.iteration == 1 else None

    monkeypatch.setattr(tetopt.cli.run, "_bar", told)
    handler = signal.getsignal(number)
    lines = run_command(f"{MESH} --iterations 200", code=128 + number).err.splitlines()
    assert signal.getsignal(number) is handler
    assert numbers_in("out/a.json")["iterations_done"] < 5
    assert len(tetopt.load_mesh("out/a.vtu").mesh.cells) > 100
    assert any(line.startswith("interrupted: the current mesh is kept") for line in lines)
    assert lines[-1] == f"ended by {name_of(number)}; written: out/a.vtu, out/a.json"


@NEEDS_SIGNALS
def test_after_a_signal_nothing_is_measured_that_takes_long(monkeypatch, signals_not_ignored):
    """What is judged is there, and quality has the rest."""
    image = sample_image(3)
    tetopt.save_image("in/l.nii.gz", tetopt.Image(1.0 * (image.data > 30), image.affine))

    @contextmanager
    def told(*_):
        yield lambda row: signal.raise_signal(signal.SIGTERM) if row.iteration == 1 else None

    monkeypatch.setattr(tetopt.cli.run, "_bar", told)
    said = run_command(f"{MESH} --labels in/l.nii.gz --iterations 200", code=143).err
    assert "tetopt quality" in " ".join(said.split())
    numbers = numbers_in("out/a.json")
    assert numbers["ended"] == "stopped"
    assert not {"interfaces", "contacts", "mask", "thickness"} & set(numbers)
    assert all(row["voxels"] and row["n_cells"] for row in numbers["labels"])
    run_command(
        "quality out/a.vtu --image in/a.nii.gz --labels in/l.nii.gz --json q.json", code=None
    )
    assert "interfaces" in numbers_in("q.json")


@NEEDS_SIGNALS
def test_a_signal_while_the_mesh_is_written_waits_for_it(monkeypatch):
    interrupt = partial(signal.raise_signal, signal.SIGTERM)
    before(tetopt.job.write, "save_for_solver", interrupt, monkeypatch)
    assert exit_code(MESH) == 143
    assert written() == ["a.json", "a.vtu"]


@NEEDS_SIGNALS
@pytest.mark.parametrize("number", LATE_SIGNALS)
def test_other_commands_end_at_once(monkeypatch, signals_not_ignored, number):
    monkeypatch.setattr(tetopt.cli.phantom, "save_image", lambda *_: signal.raise_signal(number))
    said = run_command(PHANTOM, code=128 + number).err
    assert written() == []
    assert said == f"ended by {name_of(number)}; written: nothing\n"


@NEEDS_SIGNALS
def test_an_ignored_signal_stays_ignored():
    """As nohup asks for, and shells of what runs in the background."""
    handler = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals_heard():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, handler)


# --------------------------------------------------------------------------------------------------
# Streams


@NEEDS_FULL
@pytest.mark.parametrize(("name", "code"), [("stderr", 0), ("stdout", 2)])
def test_full_streams_lose_no_file(monkeypatch, capsys, name, code):
    with open("/dev/full", "w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, name, stream)
        assert exit_code(MESH) == code
    monkeypatch.undo()
    assert written() == ["a.json", "a.vtu"]
    words = (
        "standard output cannot be written (No space left on device); the printed output is "
        "incomplete\n"
    )
    assert capsys.readouterr().err.endswith(words) == (name == "stdout")


def test_closed_streams_lose_no_file(monkeypatch):
    """Python has None for a stream that was closed before it began, and a closed one after."""
    closed = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, closed in the next line
    closed.close()
    for stream in (None, closed):
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, stream)
        assert_done(f"{MESH} --force")
        assert written() == ["a.json", "a.vtu"]


@NEEDS_SIGNALS
def test_closed_descriptors_are_not_taken_by_files(tmp_path):
    """Else what libraries print on standard error would go into the file that was opened next."""
    program = (
        "import os, sys; from tetopt.cli.console import open_streams; open_streams(); "
        f"f = open({str(tmp_path / 'a')!r}, 'w'); os.write(2, b'noise'); os.write(1, b'noise'); "
        "f.write('mine')"
    )
    child = os.fork()
    if child == 0:
        os.closerange(0, 3)
        os.execve(
            sys.executable,
            [sys.executable, "-c", program],
            os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        )
    assert os.waitpid(child, 0)[1] == 0
    assert (tmp_path / "a").read_text() == "mine"


@pytest.mark.skipif(sys.platform != "linux", reason="names are of bytes on Linux alone")
@pytest.mark.parametrize("suffix", ["vtu", "xdmf", "msh", "inp"])
def test_names_that_are_not_utf_8(suffix):
    name = os.fsdecode(b"caf\xe9\x1b[31m\n")
    os.rename("in/a.nii.gz", f"in/{name}.nii.gz")
    words = "--spacing 8 --iterations 0 --young 3 --json out/a.json -o"
    out = Path(f"out/{name}.{suffix}")
    said = "".join(run_command("mesh", Path(f"in/{name}.nii.gz"), words, out))
    assert numbers_in("out/a.json")["image"] == "caf\\udce9\x1b[31m\n.nii.gz"
    assert "\x1b" not in said
    assert r"caf\udce9\x1b[31m\n" in said
    assert b"caf\xe9" not in out.read_bytes()
    if suffix in ("vtu", "msh"):
        assert len(tetopt.load_mesh(out).mesh.cells) > 100


# --------------------------------------------------------------------------------------------------
# Memory, and places that have gone


# numpy's own, which was elsewhere before numpy 2.
ARRAY_MEMORY_ERROR = (
    np.core if np.__version__.startswith("1.") else np._core
)._exceptions._ArrayMemoryError


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "not enough memory; use"),
        (MemoryError("to lay out"), "not enough memory: to lay out; use"),
        (ARRAY_MEMORY_ERROR((10**6, 10**6), np.dtype(float)), "not enough memory: .*7.28 TiB"),
    ],
)
def test_short_memory_is_a_line(monkeypatch, error, words):
    monkeypatch.setattr(tetopt.cli.phantom, "save_image", failing(error))
    assert_refuses(PHANTOM, words)


@pytest.mark.parametrize(
    "error",
    [OSError(28, "No space left on device", "a.inp"), MemoryError("to lay out"), KeyError(7)],
)
def test_a_mesh_whose_file_fails_is_kept(monkeypatch, capsys, error):
    monkeypatch.setattr(tetopt.job.write, "save_for_solver", failing(error))
    command = "mesh in/a.nii.gz -o out/a.inp --spacing 8 --iterations 2"
    # a fault of ours is not hidden
    is_ours = isinstance(error, KeyError)
    with pytest.raises(KeyError) if is_ours else nullcontext():
        assert exit_code(command) == 2
    assert "the optimised mesh is in out/a.vtu: continue from there" in capsys.readouterr().err
    assert tetopt.load_mesh("out/a.vtu").cell_data["mean"].max() > 0.0


def test_a_mesh_whose_folder_has_gone_is_kept_elsewhere(tmp_path, monkeypatch):
    """Whatever else fails: the model of the mesh, then the mesh beside its name."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    before(tetopt.job.write, "save_for_solver", partial(shutil.rmtree, "out"), monkeypatch)
    said = run_command(MESH, code=2).err.splitlines()[-1]
    (kept,) = (tmp_path / "tmp").rglob("*.vtu")
    words = f"its folder does not exist; create it first; the optimised mesh is in {kept}"
    assert f"out/a.vtu: {words}" in said
    assert kept.parent.stat().st_mode & 0o077 == 0
    assert tetopt.load_mesh(kept).cell_data["mean"].max() > 0.0


def test_what_was_written_before_an_error_is_said(monkeypatch):
    full = OSError(28, "No space left on device", "out/a.json")
    monkeypatch.setattr(tetopt.job.run, "save_json", failing(full))
    assert run_command(MESH, code=2).err.splitlines()[-2:] == [
        "tetopt: out/a.json: No space left on device",
        "written before the error: out/a.vtu",
    ]


def test_a_mesh_that_the_disk_cannot_take_is_refused_before_the_run(monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 5000))
    monkeypatch.setattr(tetopt.job.mesh_stage, "watch_run", None)
    words = "a.vtu: needs at least 8640 bytes, but only 5000 are free; free some space first"
    assert words in run_command(MESH, code=2).err


def test_numbers_that_fail_lose_no_mesh(monkeypatch):
    monkeypatch.setattr(tetopt.job.write, "run_summary", failing(MemoryError()))
    assert exit_code(MESH) == 2
    assert written() == ["a.vtu"]


# --------------------------------------------------------------------------------------------------
# Measures that fail


ERRORS = [
    MemoryError(),
    IndexError("index 7 is out of bounds"),
    tetopt.InputError("mesh: too flat"),
]
MEASURES = {  # where each is called, and its keys in run.json
    "quality": (tetopt.job.run, {"quality_initial", "quality"}),
    "edge_ratios": (tetopt.job.write, {"edges_over_target"}),
    "nodes_of_targets": (tetopt.job.write, {"nodes_of_sizes"}),
    "crowded_nodes": (tetopt.job.write, {"nodes_of_many_labels"}),
    "mask_fidelity": (tetopt.measure.measures, {"mask"}),
    "label_fidelity": (tetopt.measure.measures, {"labels"}),
    "label_interfaces": (tetopt.measure.measures, {"interfaces"}),
    "label_contacts": (tetopt.measure.measures, {"contacts"}),
    "label_thickness": (tetopt.measure.measures, {"thickness"}),
    "by_contrast": (tetopt.job.source.Source, {"contrasts"}),
    "fields": (tetopt.job.source.Source, {"cells_without_voxel"}),
}


@pytest.fixture(scope="module")
def measured_run(tmp_path_factory):
    """Words of a run of which everything is measured, and the numbers; the optimisation is done
    once.
    """
    folder = tmp_path_factory.mktemp("measured")
    image = sample_image(3)
    for name, values in (("a", image.data), ("l", image.data > 30), ("m", np.ones(image.shape))):
        tetopt.save_image(f"{folder}/{name}.nii", tetopt.Image(1.0 * values, image.affine))
    words = f"mesh {folder}/a.nii --labels {folder}/l.nii --mask {folder}/m.nii --edge-size 9"
    words += " --nodes 60 --iterations 3"
    once = []

    def remembered(image, aim, attempt, *required, **options):
        if once:  # what is said and checked before goes on in each run
            attempt(lambda **_: once[0], once[0].initial, aim, [])
        else:
            once.append(search_mesh(image, aim, attempt, *required, **options))
        return once[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tetopt.job.mesh_stage, "search_mesh", remembered)
        exit_code(f"{words} -o {folder}/a.vtu --json {folder}/a.json")
        numbers = numbers_in(folder / "a.json")
        assert numbers["failed"] == {}
        yield words, numbers


@pytest.mark.parametrize(
    ("name", "error"), list(zip(MEASURES, 4 * ERRORS, strict=False)), ids=MEASURES
)
def test_a_measure_that_fails_is_a_line(measured_run, monkeypatch, name, error):
    """All other numbers are written, and the mesh as it is without the failure."""
    words, whole = measured_run
    where, keys = MEASURES[name]
    monkeypatch.setattr(where, name, failing(error))
    said = run_command(f"{words} -o out/a.vtu --json out/a.json", code=1).err
    assert written() == ["a.json", "a.vtu"]
    numbers = numbers_in("out/a.json")
    assert keys <= {key for key, value in numbers.items() if value is None}
    more = {"fields": {"contrasts"}, "label_contacts": {"contact_totals"}}.get(name, set())
    assert (set(numbers) | more) - {"thickness"} == set(whole)
    failed = {"fields"} if name == "fields" else keys
    assert set(numbers["failed"]) == failed
    assert list(numbers["violated"]) == list(numbers["failed"])
    known = {"failed", "violated", "seconds", "memory", "request", *keys}
    if name == "label_thickness":  # it is in the rows of labels
        assert all(row["thickness_mesh"] is None and row["dice"] > 0.0 for row in numbers["labels"])
        known |= {"labels"}
    assert all(numbers[key] == whole[key] for key in set(numbers) - known)
    reason = re.escape("MemoryError" if isinstance(error, MemoryError) else str(error))
    for key in failed:
        assert re.search(reason, numbers["failed"][key])
        lines = re.findall(rf"^tetopt: {key} could not be measured.*", said, re.MULTILINE)
        assert [bool(re.search(reason, line)) for line in lines] == [True]
    loaded = tetopt.load_mesh("out/a.vtu")
    assert len(loaded.mesh.cells) == whole["size"]["n_cells"]
    assert ("mean" in loaded.cell_data) == (name != "fields")
    assert "label" in loaded.cell_data


KILLED = """
import os, sys
import tetopt.job.source
from tetopt.cli import main
tetopt.job.source.Source.fields = lambda *_: os.kill(os.getpid(), 9)
main(sys.argv[1:])
"""


@NEEDS_SIGNALS
def test_a_process_that_is_killed_while_it_measures_leaves_the_mesh():
    """As the system does where memory is short, or a fault of compiled code."""
    command = [sys.executable, "-c", KILLED, *MESH.split()]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL
    assert written() == ["a_optimised_1.vtu"]
    assert len(tetopt.load_mesh("out/a_optimised_1.vtu").mesh.cells) > 100


def test_a_second_signal_gives_up():
    """The first one waits until the mesh is written."""
    with signals_heard(), mesh_kept() as begin:
        begin()
        signal.raise_signal(signal.SIGTERM)
        assert is_ended()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal_code() == 128 + signal.SIGTERM
