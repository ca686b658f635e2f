"""`tetopt.run` from Python: the files of the command, to the byte, and what it tells meanwhile."""

import errno
import os
import warnings
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from commands import exit_code, numbers_in, run_command
from models import sample_image

import tetopt
from tetopt.engine.fast import Run
from tetopt.io.formats import FORMATS
from tetopt.job.events import listen_with, note
from tetopt.job.source import Source

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]

UNLIKE = ("seconds", "memory")  # in run.json and in its rows, from run to run


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """An image of 3-D with a mask, labels and a second contrast, one of 2-D, a
    mesh to start from.
    """
    folder = tmp_path_factory.mktemp("inputs")
    image = sample_image(3)
    values = {
        "a": image.data,
        "b": image.data**2,
        "l": image.data > 30,
        "m": image.data > -np.inf,
        "p": sample_image(2).data,
    }
    for name, data in values.items():
        affine = image.affine if data.ndim == 3 else None
        tetopt.save_image(f"{folder}/{name}.nii.gz", tetopt.Image(1.0 * data, affine))
    run_command(f"mesh {folder}/a.nii.gz -o {folder}/s.vtu --nodes 60 --iterations 1")
    return folder


KINDS = {
    "image": ("a.nii.gz", {"figures": "f"}),
    "mask": ("a.nii.gz", {"mask": "m.nii.gz", "keep_components": True}),
    "labels": ("a.nii.gz", {"labels": "l.nii.gz", "free_volumes": True, "figures": "f"}),
    "contrasts": (["a.nii.gz", "b.nii.gz"], {"weights": [1.0, 0.5]}),
    "order 2": ("a.nii.gz", {"order": 2, "nodes": 300}),
    "start": ("a.nii.gz", {"start": "s.vtu", "nodes": None}),
    "plane": ("p.nii.gz", {}),
    "paper": ("a.nii.gz", {"method": "paper"}),
    "target error": ("a.nii.gz", {"target_error": 0.5, "nodes": None}),
}
FILES = {"mask", "labels", "start"}  # options that are files
LONG = ("order 2", "target error")  # several runs each
OF_FORMAT = {
    ".inp": {"young": "1+0.01*h", "loads": "compress:5%"},
    ".feb": {"young": "2", "loads": ["hold:superior"]},
}


def words_of(options):
    """Options of a job as those of the command."""
    for name, value in options.items():
        option = {"loads": "load"}.get(name, name.replace("_", "-"))
        if name == "weights":
            value = ",".join(f"{each:g}" for each in value)
        if value is True:
            yield f"--{option}"
        elif value is not None:
            yield from (
                f"--{option}={text}" for text in (value if isinstance(value, list) else [value])
            )


def both(inputs, images, options, name="x.vtu"):
    """The exit code of the command, and the result of the same run from Python, each in a folder
    of its own.
    """
    paths = [inputs / each for each in ([images] if isinstance(images, str) else images)]
    options = {"nodes": 60, "iterations": 2} | {
        key: inputs / value if key in FILES else value for key, value in options.items()
    }
    events = []
    for place in ("command", "python"):
        Path(place).mkdir()
        with chdir(place):
            if place == "command":
                code = exit_code("mesh", *paths, "-o", name, "--json r.json", *words_of(options))
            else:
                job = tetopt.Job(images=paths, output=name, json_path="r.json", **options)
                result = tetopt.run(job, on=events.append)
    return code, result, events


def files_in(folder):
    return {
        str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()
    }


def alike(value):
    """What of numbers is the same from run to run."""
    if isinstance(value, list):
        return [alike(each) for each in value]
    if isinstance(value, dict):
        return {key: alike(each) for key, each in value.items() if key not in UNLIKE}
    return value


def assert_equal_files():
    """Those of both, but for what differs from run to run."""
    command, python = (files_in(Path(place)) for place in ("command", "python"))
    assert list(command) == list(python)
    assert len(command) >= 2
    for name in command:
        if name == "r.json":
            one, other = (alike(numbers_in(files[name])) for files in (command, python))
            assert one == other
            assert list(one) == list(other)
        elif name != "f/energies.png":  # whose axis is time
            assert command[name].read_bytes() == python[name].read_bytes(), name


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.deep] if kind in LONG else []) for kind in KINDS]
)
def test_a_run_leaves_the_files_of_the_command(inputs, kind):
    code, result, events = both(inputs, *KINDS[kind])
    assert_equal_files()
    assert code == bool(result.violated)
    numbers = numbers_in("python/r.json")
    assert numbers["size"]["n_cells"] == len(result.mesh.cells)
    assert set(numbers) == set(result.numbers)
    stages = [event.data.name for event in events if event.kind == "started"]
    assert stages[0] == "read"
    assert {"optimise", "write"} <= set(stages)
    sentences = {event.data: event.text for event in events if event.kind == "violated"}
    assert sentences == {
        name: f"requirement violated: {name}: {words}" for name, words in result.violated.items()
    }
    assert all(event.text for event in events)


@pytest.mark.parametrize("suffix", sorted(set(FORMATS) - {".vtu"}))
def test_a_run_writes_every_format_as_the_command_does(inputs, suffix):
    both(inputs, "a.nii.gz", {"iterations": 0, **OF_FORMAT.get(suffix, {})}, f"x{suffix}")
    assert_equal_files()


def job_of(inputs, **options):
    """A job of the image, to x.vtu."""
    return tetopt.Job(**{"images": inputs / "a.nii.gz", "output": "x.vtu", "nodes": 60} | options)


def test_without_a_listener_warnings_are_pythons_and_within_one_they_are_its_events(inputs):
    job = job_of(inputs, iterations=1, min_dihedral=65)
    with pytest.warns(UserWarning, match="requirement violated: min_dihedral: "):
        assert "min_dihedral" in tetopt.run(job).violated
    events = []
    with listen_with(events.append):
        note("one")
        with listen_with(None):
            note("two")
    assert [event.text for event in events] == ["one", "two"]


def test_an_input_is_no_output_and_a_refused_run_leaves_no_folder(inputs):
    tetopt.run(job_of(inputs, iterations=0))
    before = Path("x.vtu").read_bytes()
    with pytest.raises(tetopt.InputError, match="is also an input"):
        tetopt.run(job_of(inputs, start="x.vtu", nodes=None, force=True))
    assert Path("x.vtu").read_bytes() == before
    with pytest.raises(tetopt.InputError, match="no such file"):
        tetopt.run(job_of(inputs, images="no.nii", output="y.vtu", figures="pictures"))
    assert os.listdir() == ["x.vtu"]


def test_the_library_prints_nothing(inputs, capfd):
    with warnings.catch_warnings(action="ignore"):
        tetopt.run(job_of(inputs, iterations=1))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".vtu", ".inp", ".feb"])
def test_a_run_cut_short_writes_its_mesh_before_anything_else(monkeypatch, suffix):
    """Before cells are lifted and measured, which takes minutes for many; FEBio takes no mesh
    without moduli.
    """
    phantom = tetopt.load_phantom("sphere")
    tetopt.save_image("a.nii", phantom.image(voxel_mm=4))
    tetopt.save_image("l.nii", phantom.label_image(voxel_mm=4))
    place = Path("out.vtu" if suffix == ".feb" else f"out{suffix}")
    asks, seen = [], []

    def stop():
        asks.append(True)
        return len(asks) > 3

    def looking(call):
        def look(*arguments):
            if len(asks) > 3:  # not as kernels are prepared, and the initial mesh is tried
                seen.append(tetopt.load_mesh(place) if suffix != ".inp" else place.stat().st_size)
            return call(*arguments)

        return look

    monkeypatch.setattr(Run, "mend", looking(Run.mend))
    monkeypatch.setattr(Source, "fields", looking(Source.fields))
    options = {"nodes": 300, "young": "3", "nu": "0.3"}
    job = tetopt.Job(images="a.nii", labels="l.nii", output=f"out{suffix}", **options)
    result = tetopt.run(job, lambda event: None, stop=stop)
    assert (result.numbers["ended"], len(seen) >= 2) == ("stopped", True)
    if suffix != ".inp":
        assert set(np.unique(seen[0].cell_data["label"])) == {0, 1}
        assert len(seen[-1].mesh.cells) == len(result.mesh.cells)
    assert sorted(os.listdir()) == ["a.nii", "l.nii", f"out{suffix}"]


@pytest.mark.parametrize("suffix", [".vtu", ".inp"])
@pytest.mark.parametrize("is_short", [True, False])
def test_files_that_appear_during_a_run_stay_and_the_run_is_beside_them(suffix, is_short):
    """Mesh, numbers and pictures; also of a run that keeps its mesh early, and of two runs."""
    tetopt.save_image("a.nii", sample_image(3))
    outputs = {"output": f"a{suffix}", "json_path": "a.json", "figures": "f"}
    job = tetopt.Job(images="a.nii", nodes=60, iterations=2, **outputs)
    names = [f"a{suffix}", "a.json", "f/slice.png"]
    asks = []

    def appear(event):
        if event.kind == "started" and event.data.name == "optimise":
            for name in names:
                Path(name).write_text("other")

    with pytest.raises(tetopt.InputError, match="appeared") as told:
        tetopt.run(job, appear, stop=lambda: is_short and (asks.append(1) or len(asks) > 3))
    assert [Path(name).read_text() for name in names] == ["other"] * 3
    others = [f"a_1{suffix}", "a_1.json", "f/slice_1.png"]
    assert all(name in str(told.value) for name in others)
    assert numbers_in("a_1.json")["ended"] == ("stopped" if is_short else "iterations")
    assert b"other" not in [Path(name).read_bytes() for name in others]
    assert {name for name in os.listdir() if name[0] == "a"} == {"a.nii", *names[:2], *others[:2]}


def test_a_full_disk_leaves_the_first_copy_of_the_mesh_and_one_line_says_where(monkeypatch):
    """It has the labels of its cells; what needs more room does not replace it."""
    phantom = tetopt.load_phantom("sphere")
    tetopt.save_image("a.nii", phantom.image(voxel_mm=8))
    tetopt.save_image("l.nii", phantom.label_image(voxel_mm=8))
    write, sizes, told = Path.write_bytes, [], []

    def full(path, data):
        sizes.append(len(data))
        if len(sizes) > 1:  # than the first copy needs
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    job = tetopt.Job(images="a.nii", labels="l.nii", output="a.vtu", nodes=100, iterations=1)
    with pytest.raises(tetopt.InputError, match=r"is in a_optimised_1\.vtu"):
        tetopt.run(job, lambda event: told.append(event.text))
    loaded = tetopt.load_mesh("a_optimised_1.vtu")
    assert set(np.unique(loaded.cell_data["label"])) == {0, 1}
    assert not any("cannot be saved" in text for text in told)
