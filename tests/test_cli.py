"""The command, run as a user runs it: files in, files out, exit codes, one line for every bad
input.
"""

import functools
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from itertools import product
from pathlib import Path

import meshio
import nibabel
import numba
import numpy as np
import PIL.Image
import pytest
from commands import assert_refused, exit_code, mesh_words, numbers_in

import tetopt
import tetopt.cli.mesh
import tetopt.cli.phantom
import tetopt.engine.meshing
from tetopt import (
    Image,
    Mesh,
    lattice_mesh,
    load_image,
    load_mesh,
    load_phantom,
    quality,
    save_image,
    save_mesh,
)
from tetopt.cli.app import COMMANDS, help_line, loaded_command
from tetopt.cli.console import show_error, show_event
from tetopt.engine.requirements import ERROR_RATE
from tetopt.geometry.simplex import volumes
from tetopt.job.advice import agreed, sentences, tell, unmet
from tetopt.job.events import listened
from tetopt.measure.segmentation import dice, segment
from tetopt.report.summary import mesh_hash
from tetopt.start.octree import nodes_of_sizes
from tetopt.start.sizes import edge_ratios

pytestmark = pytest.mark.full
OBLIQUE_TOML = """
name = "oblique"
description = "A sphere of 9 mm off the middle of thick, oblique, sheared, flipped slices"
size_mm = [32, 36, 40]
voxel_mm = [0.5, 0.5, 1.25]
center_mm = [12, -8, 30]
axes = [[-0.94, 0.34, 0.05], [0.34, 0.93, 0.17], [0.10, -0.40, 0.91]]
background = { intensity = 20, label = 0 }

[[shape]]
kind = "ellipsoid"
center_mm = [14.3, -10.1, 28.7]
radii_mm = 9
intensity = 100
label = 1
"""


@pytest.fixture(autouse=True)
def _same_threads_afterwards():
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with small images and a mesh."""
    folder = tmp_path_factory.mktemp("inputs")
    assert exit_code("phantom", "sphere", "-o", folder / "sphere.nii.gz", "--voxel-mm", "4") == 0
    assert exit_code("phantom", "disc_2d", "-o", folder / "disc.nii", "--voxel-mm", "2") == 0
    save_image(folder / "flat.nii", Image(np.full((5, 6, 7), 3.0)))
    save_mesh(folder / "lattice.vtu", lattice_mesh(load_image(folder / "sphere.nii.gz"), nodes=60))
    return folder


@pytest.fixture(scope="module")
def run(inputs, tmp_path_factory):
    """One run in 3-D with all its outputs: folder, run.json, mesh file, image."""
    folder = tmp_path_factory.mktemp("run")
    command = ["mesh", inputs / "sphere.nii.gz", "-o", folder / "mesh.vtu", "--nodes", "150"]
    command += ["--json", folder / "run.json", "--iterations", "3", "--k-d", "0.3"]
    command += ["--method", "paper", "--n-t", "1"]
    assert exit_code(*command) == 0
    return (
        folder,
        numbers_in(folder / "run.json"),
        load_mesh(folder / "mesh.vtu"),
        load_image(inputs / "sphere.nii.gz"),
    )


def box_corners(image):
    return image.to_world(np.array(list(product(*[(-0.5, s - 0.5) for s in image.shape]))))


def assert_covers(mesh, image):
    """The mesh fills the image's box: its volume, and every corner is a node."""
    v = volumes(mesh.points, mesh.cells)
    assert v.min() > 0.0
    assert v.sum() == pytest.approx(image.volume, rel=1e-9)
    corners = box_corners(image)
    distance = np.linalg.norm(mesh.points[:, None] - corners[None], axis=2).min(axis=0)
    assert distance.max() < 1e-6
    np.testing.assert_allclose(mesh.points.min(axis=0), corners.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(mesh.points.max(axis=0), corners.max(axis=0), atol=1e-6)


def assert_round_trips(points, image):
    """World -> voxel -> world within 1e-6 mm."""
    assert np.abs(image.to_world(image.to_index(points)) - points).max() < 1e-6


# --------------------------------------------------------------------------------------------------
# mesh


def test_mesh_in_3d(run):
    folder, numbers, file, image = run
    assert sorted(p.name for p in folder.iterdir()) == ["mesh.vtu", "run.json"]
    assert_covers(file.mesh, image)
    assert_round_trips(file.mesh.points, image)
    assert file.n_turned == 0
    assert file.mesh.ndim == 3
    assert numbers["quality"]["n_nodes"] == len(file.mesh.points)
    assert abs(len(file.mesh.points) - 150) <= 5
    assert numbers["energies"]["E_D_relative"] < 0.5  # the sphere is found


SIZES = ("size_min", "edge_size", "edge_max", "gradation", "sizing")


def test_json_of_a_run(run, inputs):
    _, numbers, file, _ = run
    assert numbers["image"] == "sphere.nii.gz"
    assert (
        numbers["image_sha256"]
        == hashlib.sha256((inputs / "sphere.nii.gz").read_bytes()).hexdigest()
    )
    options = numbers["options"]
    assert (options["method"], options["n_t"], options["retessellate"]) == ("paper", 1, "first")
    assert (options["nodes"], options["lattice"], options["boundary"]) == (150, "bcc", "slide")
    assert (options["k_D"], options["iterations"]) == (0.3, 3)
    for name in (
        "spacing",
        "volume",
        "crop",
        "slice",
        "start",
        "max_seconds",
        "max_gb",
        "target_error",
        "nodes_max",
        *SIZES,
    ):
        assert options[name] is None
    assert numbers["versions"]["tetopt"] == tetopt.__version__
    assert numbers["versions"]["numba"] == numba.__version__
    assert numbers["machine"]["threads"] == numba.get_num_threads()
    assert numbers["ended"] == "iterations"
    assert numbers["iterations_done"] == 3
    assert [row["iteration"] for row in numbers["history"]] == [0, 1, 2, 3]
    assert [row["n_voxels"] for row in numbers["history"]] == [16**3] * 4
    E = [row["E"] for row in numbers["history"]]
    assert E[0] == 1.0
    assert E[2] >= E[3]  # the connectivity is fixed from iteration 2 on
    assert numbers["energies"]["E"] == E[-1]
    assert numbers["mesh_sha256"] == mesh_hash(file.mesh)
    measured = quality(file.mesh.points, file.mesh.cells)
    assert numbers["quality"]["errors"] == measured.errors._asdict()
    assert numbers["quality"]["min_dihedral"] == measured.min_dihedral
    assert set(numbers["seconds"]) == {"load", "optimize", "all"}
    assert numbers["seconds"]["all"] >= numbers["seconds"]["optimize"] > 0.0


def test_mesh_file_of_a_run(run):
    folder, numbers, file, image = run
    assert list(file.cell_data) == [
        "mean",
        "variance",
        "n_voxels",
        "min",
        "max",
        "volume",
        "rho",
        "min_dihedral",
    ]
    moments = tetopt.cell_moments(image, file.mesh)
    np.testing.assert_array_equal(file.cell_data["n_voxels"], moments.n_voxels)
    np.testing.assert_array_equal(file.cell_data["mean"], moments.mean)
    assert file.cell_data["n_voxels"].sum() == image.data.size
    assert (file.cell_data["n_voxels"] * file.cell_data["mean"]).sum() == pytest.approx(
        image.data.sum(), rel=1e-12
    )
    np.testing.assert_array_equal(
        file.cell_data["volume"], volumes(file.mesh.points, file.mesh.cells)
    )
    texts = {name: values[0] for name, values in file.field_data.items()}
    assert texts["tetopt"] == tetopt.__version__
    assert texts["image"] == "sphere.nii.gz"
    assert texts["image_sha256"] == numbers["image_sha256"]
    assert json.loads(texts["options"]) == numbers["options"]
    other = meshio.read(folder / "mesh.vtu")
    np.testing.assert_array_equal(other.points, file.mesh.points)
    np.testing.assert_array_equal(other.cells_dict["tetra"], file.mesh.cells)


def test_mesh_in_2d(tmp_path, inputs):
    out = tmp_path / "disc.vtu"
    assert (
        exit_code("mesh", inputs / "disc.nii", "-o", out, "--nodes", "80", "--iterations", "4") == 0
    )
    image, file = load_image(inputs / "disc.nii"), load_mesh(out)
    assert_covers(file.mesh, image)
    assert_round_trips(file.mesh.points, image)
    assert file.cell_data["n_voxels"].sum() == image.data.size
    # The disc of 20 mm, of intensity 100 on 20: what the cells hold of it lies in its place, (0,
    # 0).
    weight = file.cell_data["volume"] * (file.cell_data["mean"] - 20.0)
    assert weight.sum() / 80.0 == pytest.approx(np.pi * 20.0**2, rel=0.05)
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize(
    "options",
    [
        ["--method", "paper", "--boundary", "fixed", "--retessellate", "never"],
        ["--retessellate", "accept", "--n-t", "0", "--method", "paper"],
        ["--shape-power", "1", "--min-dihedral", "0"],
        ["--k-d", "0", "--lattice", "five-tet"],
        ["--crop", "2:14,:,1:15"],
    ],
    ids=lambda options: options[0],
)
def test_other_options(tmp_path, inputs, options):
    command = mesh_words(inputs / "sphere.nii.gz", tmp_path)
    assert exit_code(*command, "--spacing", "16", "--iterations", "1", *options) == 0
    image = load_image(
        inputs / "sphere.nii.gz",
        crop=[(2, 14), (None, None), (1, 15)] if "--crop" in options else None,
    )
    file = load_mesh(tmp_path / "a.vtu")
    assert_covers(file.mesh, image)
    stated = numbers_in(tmp_path / "a.json")["options"]
    for name, value in zip(options[::2], options[1::2], strict=True):
        key = {"--k-d": "k_D"}.get(name, name[2:].replace("-", "_"))
        assert str(stated[key]) in (value, f"{value}.0")


@pytest.mark.parametrize(
    ("name", "size"),
    [("sphere.nii.gz", ["--nodes", "100", "--uniform"]), ("disc.nii", ["--spacing", "9"])],
)
def test_no_iterations_write_the_lattice_itself(tmp_path, inputs, name, size):
    assert (
        exit_code("mesh", inputs / name, "-o", tmp_path / "a.vtu", *size, "--iterations", "0") == 0
    )
    expected = lattice_mesh(load_image(inputs / name), **{size[0][2:]: int(size[1])})
    mesh = load_mesh(tmp_path / "a.vtu").mesh
    assert mesh.points.tobytes() == expected.points.tobytes()
    np.testing.assert_array_equal(mesh.cells, expected.cells)


def test_the_table_shows_before_and_after_and_lines_the_progress(tmp_path, inputs, capsys):
    command = mesh_words(inputs / "sphere.nii.gz", tmp_path)
    assert exit_code(*command, "--nodes", "150", "--iterations", "3") == 0
    numbers, said = numbers_in(tmp_path / "a.json"), capsys.readouterr()
    lines = said.out.splitlines()
    table = {
        row[0]: row[1:]
        for row in (re.split(r"\s{2,}", line.strip()) for line in lines)
        if len(row) == 3
    }
    first, last = numbers["quality_initial"], numbers["quality"]
    assert lines[0].split() == ["octree", "optimised"]
    energies = numbers["energies"]
    fractions = [energies[f"E_D_fraction_of_variance{when}"] for when in ("_initial", "")]
    assert table["E_D, fraction of the image's variance"] == [
        f"{fraction:.5f}" for fraction in fractions
    ]
    assert table["rho, mean"] == [f"{first['mean_rho']:.4f}", f"{last['mean_rho']:.4f}"]
    assert table["smallest angle, degrees"] == [
        f"{first['min_dihedral']:.2f}",
        f"{last['min_dihedral']:.2f}",
    ]
    assert table["rho, mean"][0] != table["rho, mean"][1]
    nodes, cells = last["n_nodes"], last["n_cells"]
    assert lines[-2:] == [
        f"{tmp_path / 'a.json'}: every number of the run",
        f"all requirements are met; {tmp_path / 'a.vtu'}: {nodes} nodes, {cells} cells",
    ]
    history, lines = numbers["history"], said.err.splitlines()
    words = (
        "16 x 16 x 16 voxels of 4 x 4 x 4 mm; octree of 148 nodes, 576 cells, edges up to 26.7 mm"
    )
    first = f"{inputs / 'sphere.nii.gz'}: {words}"
    assert re.fullmatch(rf"{re.escape(first)}; about \d\.\d+ GB of memory", lines[0])
    progress = [line for line in lines[1:] if line.startswith("iteration")]
    assert len(progress) == 4
    for k, (line, row) in enumerate(zip(progress, history, strict=True)):
        E_D = row["E_D"] / history[0]["E_D"]
        assert line.startswith(f"iteration   {k}/3  E {row['E']:.4f}  E_G ")
        assert f"  E_D {E_D:.4f}  {row['n_cells']} cells  " in line
    assert not any("\x1b" in line for line in lines)  # no colours, no cursor movements


def test_a_constant_image_warns_and_works(tmp_path, inputs, capsys):
    command = mesh_words(inputs / "flat.nii", tmp_path)
    assert exit_code(*command, "--nodes", "50", "--iterations", "2") == 0
    captured = capsys.readouterr()
    warning = (
        f"tetopt: warning: {inputs / 'flat.nii'}: the image is 3 everywhere, so E_D is 0 everywhere"
    )
    assert captured.err.splitlines()[0] == warning
    assert captured.err.count("warning") == 1
    assert "E_D" not in captured.out
    assert numbers_in(tmp_path / "a.json")["energies"]["E_D_relative"] is None
    assert_covers(load_mesh(tmp_path / "a.vtu").mesh, load_image_quietly(inputs / "flat.nii"))


def load_image_quietly(path):
    with pytest.warns(UserWarning, match="everywhere"):
        return load_image(path)


def test_a_name_with_markup_and_letters(tmp_path, inputs, capsys):
    """Rich would take [red] for a colour and :cat: for a picture."""
    folder = tmp_path / "Schädel [red] :cat:"
    folder.mkdir()
    shutil.copy(inputs / "disc.nii", folder / "ä[1].nii")
    command = [
        "mesh",
        folder / "ä[1].nii",
        "-o",
        folder / "a[b].vtu",
        "--nodes",
        "30",
        "--iterations",
        "1",
    ]
    assert exit_code(*command) == 0
    captured = capsys.readouterr()
    assert captured.err.startswith(f"{folder / 'ä[1].nii'}: 32 x 32 voxels")
    assert f"{folder / 'a[b].vtu'}: " in captured.out
    assert load_mesh(folder / "a[b].vtu").field_data["image"].tolist() == ["ä[1].nii"]
    assert exit_code("quality", folder / "a[b].vtu") == 0
    assert capsys.readouterr().out.splitlines()[0].strip() == "a[b].vtu"


@pytest.mark.skipif(
    numba.config.NUMBA_NUM_THREADS < 2, reason="one core: there are no two thread counts to compare"
)
def test_the_same_bits_for_any_number_of_threads(tmp_path, inputs):
    hashes = []
    for threads in ("1", "2"):
        out = tmp_path / threads
        command = [
            "mesh",
            inputs / "sphere.nii.gz",
            "-o",
            f"{out}.vtu",
            "--json",
            f"{out}.json",
            "--nodes",
            "400",
        ]
        assert exit_code(*command, "--iterations", "3", "--threads", threads) == 0
        numbers = json.loads(Path(f"{out}.json").read_text())
        assert numbers["machine"]["threads"] == int(threads)
        hashes.append(numbers["mesh_sha256"])
        assert hashes[-1] == mesh_hash(load_mesh(f"{out}.vtu").mesh)
    assert hashes[0] == hashes[1]
    assert Path(tmp_path / "1.vtu").read_bytes() == Path(tmp_path / "2.vtu").read_bytes()


def test_max_seconds_leaves_a_valid_mesh(tmp_path, inputs, capsys):
    command = mesh_words(inputs / "sphere.nii.gz", tmp_path)
    assert (
        exit_code(*command, "--nodes", "400", "--iterations", "1000", "--max-seconds", "1e-6") == 0
    )
    numbers = numbers_in(tmp_path / "a.json")
    assert numbers["ended"] == "max_seconds"
    assert numbers["options"]["max_seconds"] == 1e-6
    assert numbers["iterations_done"] < 1000
    mesh = load_mesh(tmp_path / "a.vtu").mesh
    assert_covers(mesh, load_image(inputs / "sphere.nii.gz"))
    assert numbers["mesh_sha256"] == mesh_hash(mesh)
    assert "out of time: the current mesh is kept" in capsys.readouterr().err


def test_what_is_violated_is_told_in_the_commands_options(capsys):
    violated = {
        "min_dihedral": "2 of 9 cells; allow a lower `k_D`, or a lower `min_dihedral`",
        "box": "k_D.nii lies beyond",
    }
    with listened(show_event):
        problems = agreed(unmet(violated, {}))
        assert sentences(problems) == violated
        tell(problems)
    said = capsys.readouterr().err
    assert said == (
        "tetopt: requirement violated: min_dihedral: 2 of 9 cells; allow a lower --k-d, or a "
        "lower --min-dihedral\n"
        "tetopt: requirement violated: box: k_D.nii lies beyond\n"
    )


# --------------------------------------------------------------------------------------------------
# Ctrl-C


def child(arguments, **options):
    environment = os.environ | {"PYTHONPATH": str(Path(tetopt.__file__).parents[1])}
    return subprocess.Popen(
        [sys.executable, "-m", "tetopt", *map(str, arguments)],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        **options,
    )


@pytest.mark.deep
@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to one process")
def test_ctrl_c_leaves_a_valid_mesh(tmp_path, inputs):
    command = mesh_words(inputs / "sphere.nii.gz", tmp_path)
    process = child([*command, "--nodes", "400", "--iterations", "100000", "--k-d", "0.9"])
    try:
        for line in process.stderr:
            if line.startswith("iteration   2/100000"):
                break
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "interrupted: the current mesh is kept" in errors
    assert "Traceback" not in errors
    mesh = load_mesh(tmp_path / "a.vtu").mesh
    assert_covers(mesh, load_image(inputs / "sphere.nii.gz"))
    numbers = numbers_in(tmp_path / "a.json")
    assert numbers["ended"] == "stopped"
    assert 2 <= numbers["iterations_done"] < 100000
    assert numbers["mesh_sha256"] == mesh_hash(mesh)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "a.vtu"]


@pytest.mark.deep
@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to one process")
def test_a_second_ctrl_c_gives_up(tmp_path, inputs, monkeypatch, capsys):
    def impatient(*_, stop, **__):
        signal.raise_signal(signal.SIGINT)
        assert stop()
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(tetopt.job.meshing, "_prepare", lambda _: None)
    monkeypatch.setattr(
        tetopt.engine.meshing,
        "optimize",
        functools.wraps(tetopt.engine.meshing.optimize)(impatient),
    )
    before = signal.getsignal(signal.SIGINT)
    assert exit_code("mesh", inputs / "disc.nii", "-o", tmp_path / "a.vtu") == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert capsys.readouterr().err.splitlines()[-3:] == [
        "interrupted: finishing the current nodes, then writing the mesh (interrupt again to end "
        "at once)",
        "interrupted again: unwritten results are discarded",
        "ended by Ctrl-C; written: nothing",
    ]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.deep
def test_ctrl_c_while_reading(tmp_path, inputs, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(tetopt.job.inputs, "load_image", interrupted)
    assert exit_code("mesh", inputs / "disc.nii", "-o", tmp_path / "a.vtu") == 130
    assert list(tmp_path.iterdir()) == []


# --------------------------------------------------------------------------------------------------
# Inputs to mend


BAD_OPTIONS = [
    ("--nodes 6", "9 or more in 3-D, got 6"),
    ("--uniform --nodes 6", "expected 9 to 50000000 nodes"),
    ("--nodes 1000000000", "--nodes: expected a whole number from 5 to 50000000, got 1000000000"),
    ("--nodes 1e9", "--nodes: expected a whole number from 5 to 50000000, got 1000000000"),
    ("--nodes many", "--nodes: expected a whole number, got 'many'"),
    ("--nodes -5", "--nodes: expected a whole number from 5 to 50000000, got -5"),
    ("--spacing 0", "--spacing: expected a length above 0 mm"),
    ("--k-d 1", "--k-d: expected 0 <= k_D < 1, got 1.0"),
    ("--k-d abc", "--k-d: expected a number, got 'abc'"),
    ("--iterations -1", "--iterations: expected 0 or more, got -1"),
    ("--threads 10000", "--threads: expected 1 to .* got 10000"),
    ("--max-seconds 0", "--max-seconds: expected more than 0"),
    ("--lattice criss-cross", "expected one of bcc, five-tet in 3-D"),
    ("--method fast --n-t 2", "--n-t: only with --method paper"),
    ("--method paper --shape-power 3", "--shape-power: only with --method fast"),
    ("--min-dihedral 80", "--min-dihedral: expected 0 to below 70"),
    ("--shape-power 0.5", "--shape-power: expected 1"),
    ("--retessellate always", "--retessellate"),
    ("--slice z", 'slice: expected .* got "z"'),
    ("--slice k=99", "slice: expected an index from 0 to 15 along axis 2, got 99"),
    ("--crop 0:100:5", 'crop: expected .* got "0:100:5"'),  # :100: is an emoji to rich
    ("--crop 0:99,:,:", "crop"),
    ("--volume 1", "got 1: the file has one volume"),
    ("--json no/such/run.json", "folder does not exist"),
    ("--json run.txt", "ending in .json"),
    ("--unknown", "No such option: --unknown"),
    ("second.nii", "second.nii"),
]


@pytest.mark.parametrize(
    ("options", "match"), BAD_OPTIONS, ids=[options for options, _ in BAD_OPTIONS]
)
def test_bad_options_of_mesh(tmp_path, inputs, monkeypatch, capfd, options, match):
    monkeypatch.chdir(tmp_path)
    assert_refused(
        capfd, ["mesh", inputs / "sphere.nii.gz", "-o", "a.vtu", *options.split()], match
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ("mesh no.nii -o a.vtu", "no.nii: no such file"),
        ("mesh {disc} -o a.vtu --lattice bcc", "expected one of criss-cross in 2-D"),
        ("mesh {disc} -o a.vtu --slice k=3", "slice"),
        ("mesh {disc} -o a.vtu --crop 1:5,1:5,1:5", "crop"),
        ("mesh {disc} -o a.obj", "unknown suffix; known suffixes are .vtu"),
        ("mesh {disc}", "--output"),
        ("mesh -o a.vtu", r"Missing argument 'IMAGE\.\.\.'"),
        ("mesh {lattice} -o a.vtu", "unknown image format"),
        ("quality no.vtu", "no such file"),
        ("quality {disc}", "expected a .vtu, .vtk, .msh or .msh2 mesh"),
        ("quality {lattice} --image no.nii", "no such file"),
        ("quality {lattice} --image {disc}", "a 3-D image like the mesh, got a 2-D one"),
        ("quality", r"Missing argument '\[IMAGE\] MESH'"),
        ("phantom nothing -o a.nii", "phantom 'nothing': no such phantom; use one of constant"),
        ("phantom no.toml -o a.nii", "no.toml"),
        ("phantom sphere -o a.png", "ending in .nii or .nii.gz"),
        ("phantom sphere -o a.nii --labels ./a.nii", "or another output"),
        ("phantom sphere -o a.nii --voxel-mm 0", "--voxel-mm: "),
        ("phantom sphere -o a.nii --noise-sd -1", "--noise-sd: "),
        ("phantom sphere -o a.nii --seed x", "--seed"),
        ("refine", "No such command 'refine'"),
        ("demo -o {disc}", "expected a folder"),
    ],
)
def test_bad_inputs(tmp_path, inputs, monkeypatch, capfd, arguments, match):
    if "{disc}" in arguments and arguments.startswith("demo"):
        pytest.importorskip("nilearn", reason="the demo's image comes in nilearn's wheel")
    monkeypatch.chdir(tmp_path)
    paths = {"disc": inputs / "disc.nii", "lattice": inputs / "lattice.vtu"}
    assert_refused(capfd, [a.format(**paths) for a in arguments.split()], match)
    assert list(tmp_path.iterdir()) == []


def test_existing_outputs_are_refused(tmp_path, inputs, capfd):
    for name in ("a.nii", "b.nii", "a.json"):
        (tmp_path / name).write_text("old")
    new, mesh = tmp_path / "new.nii", mesh_words(inputs / "sphere.nii.gz", tmp_path)
    assert_refused(capfd, mesh, "a.json: already exists; pass --force")
    assert_refused(capfd, ["phantom", "sphere", "-o", tmp_path / "a.nii"], "already exists")
    assert_refused(
        capfd, ["phantom", "sphere", "-o", new, "--labels", tmp_path / "b.nii"], "already exists"
    )
    assert_refused(
        capfd, ["quality", inputs / "lattice.vtu", "--json", tmp_path / "a.json"], "already exists"
    )
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == dict.fromkeys(
        ("a.nii", "b.nii", "a.json"), "old"
    )


def test_the_systems_errors_take_one_line(tmp_path, inputs, monkeypatch, capfd):
    assert_refused(
        capfd, ["mesh", inputs / "disc.nii", "-o", tmp_path / f"{'a' * 300}.vtu"], "too long"
    )

    def full_disk(*_):
        raise OSError(28, "No space left on device", "a[b].vtu")

    monkeypatch.setattr(tetopt.cli.phantom, "save_image", full_disk)
    command = ["phantom", "disc_2d", "-o", tmp_path / "a.nii", "--voxel-mm", "8"]
    assert_refused(capfd, command, r"a\[b\].vtu: No space left on device")


def test_the_checksum_is_of_what_was_read(tmp_path, inputs, monkeypatch):
    """The image may be gone, or another, when the optimisation ends."""
    shutil.copy(inputs / "disc.nii", tmp_path / "disc.nii")

    @functools.wraps(tetopt.optimize)
    def slow(*arguments, **options):
        (tmp_path / "disc.nii").unlink()
        return tetopt.optimize(*arguments, **options)

    monkeypatch.setattr(tetopt.job.meshing, "_prepare", lambda _: None)
    monkeypatch.setattr(tetopt.engine.meshing, "optimize", slow)
    command = [
        "mesh",
        tmp_path / "disc.nii",
        "-o",
        tmp_path / "a.vtu",
        "--nodes",
        "30",
        "--iterations",
        "1",
    ]
    assert exit_code(*command) == 0
    expected = hashlib.sha256((inputs / "disc.nii").read_bytes()).hexdigest()
    assert load_mesh(tmp_path / "a.vtu").field_data["image_sha256"].tolist() == [expected]


# --------------------------------------------------------------------------------------------------
# Help and version


@pytest.mark.parametrize("width", ["80", "120"])
def test_help_names_no_value_of_a_switch_and_breaks_no_word(monkeypatch, capsys, width):
    monkeypatch.setenv("COLUMNS", width)
    for words in (("--help",), ("mesh", "--help"), ("mesh", "--help-all"), ("fem", "--help")):
        assert exit_code(*words) == 0
        text = capsys.readouterr().out
        assert "bool" not in text
        assert re.search(r"--help(,--help-all)? +-h +Show this message", text)
        assert words != ("mesh", "--help-all") or {"octree", "bcc", "five-tet"} <= set(
            re.findall(r"[\w-]+", text)
        )


def groups_of_help(capsys, *words):
    """The names of the options that the help shows, by its groups."""
    assert exit_code(*words) == 0
    groups = re.split(r"^╭─ (.+?) ─+╮$", capsys.readouterr().out, flags=re.M)[1:]
    pairs = zip(groups[::2], groups[1::2], strict=True)
    return {
        name: re.findall(r"^│ [ *]*(--[a-z-]+)", text, re.M)
        for name, text in pairs
        if name != "Arguments"
    }


def test_help_of_mesh_is_in_six_groups(monkeypatch, capsys):
    """Each of at most eighteen options, and the help; without `--help-all` the twenty that most
    users take.
    """
    monkeypatch.setenv("COLUMNS", "80")
    every = groups_of_help(capsys, "mesh", "--help-all")
    assert {name: len(options) for name, options in every.items()} == {
        "Options": 5,
        "Region and labels": 18,
        "Number and size of cells": 10,
        "Initial mesh": 4,
        "Optimisation": 11,
        "For the solver": 14,
    }
    shown = groups_of_help(capsys, "mesh", "--help")
    assert sum(map(len, shown.values())) == 20 + 1
    assert all(
        set(options) < set(every[name]) or name == "Options" for name, options in shown.items()
    )
    assert {"--output", "--mask", "--nodes", "--young", "--load"} <= {
        each for group in shown.values() for each in group
    }
    # has no shorter one
    assert groups_of_help(capsys, "cohort", "--help")["Optimisation"] == every["Optimisation"]


def test_help_lists_the_commands(capsys):
    assert exit_code("--help") == 0
    captured = capsys.readouterr()
    assert all(re.search(rf"\b{command}\b", captured.out) for command in COMMANDS)
    assert exit_code() == 2
    bare = capsys.readouterr()
    # the help, and no line of complaint
    assert (bare.out + bare.err).strip() == captured.out.strip()


def test_version_also_as_a_module(capsys):
    assert exit_code("--version") == 0
    assert capsys.readouterr() == (f"tetopt {tetopt.__version__}\n", "")
    assert child(["--version"]).communicate(timeout=60) == (f"tetopt {tetopt.__version__}\n", "")


# Libraries that take time to load; the order is that of the printed line.
HEAVY = (
    "matplotlib meshio nibabel numba PIL pyvista scipy.linalg scipy.ndimage scipy.sparse "
    "scipy.spatial vtkmodules"
)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("code", "needed"),
    [
        ("import tetopt", ""),
        ("import tetopt.cli; tetopt.cli.main(['--help'])", ""),
        ("import tetopt.cli; tetopt.cli.main(['--version'])", ""),
        ("import tetopt.cli; tetopt.cli.main(['msh'])", ""),
        # The rest is loaded where a run comes to it.
        # nibabel loads pydicom where it is installed, and that PIL
        ("import tetopt.cli.mesh", "nibabel numba PIL"),
        ("import tetopt; tetopt.mesh_image", "numba"),
    ],
)
def test_nothing_is_loaded_before_it_is_used(code, needed):
    environment = os.environ | {"PYTHONPATH": str(Path(tetopt.__file__).parents[1])}
    code += (
        f"; import sys; print('loaded:', *(name for name in {HEAVY!r}.split() if name in "
        "sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1].split()[1:] == sorted(
        needed.split(), key=HEAVY.split().index
    )


@pytest.mark.parametrize("threads", ["0", "1.5", "9" * 5000])
def test_threads_that_cannot_be_are_refused(inputs, tmp_path, monkeypatch, capfd, threads):
    """numba ends with a traceback, or takes another number."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    command = ["mesh", inputs / "sphere.nii.gz", "-o", tmp_path / "a.vtu", "--nodes", "60"]
    assert_refused(
        capfd, command, "NUMBA_NUM_THREADS: expected a whole number of threads from 1 to 9999, got"
    )


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("NUMBA_THREADING_LAYER", "foo", "NUMBA_THREADING_LAYER: expected .*workqueue.*, got foo"),
        (
            "NUMBA_THREADING_LAYER_PRIORITY",
            "foo",
            "NUMBA_THREADING_LAYER_PRIORITY: expected omp tbb workqueue",
        ),
        (
            "NUMBA_OPT",
            "foo",
            "environment: .*'NUMBA_OPT'.*'foo' could not be parsed; check NUMBA_OPT",
        ),
        (
            "MPLBACKEND",
            "foo",
            "environment: .*'foo' is not a valid value for backend; check MPLBACKEND",
        ),
    ],
)
def test_a_variable_of_a_library_with_a_bad_value_is_one_line(tmp_path, name, value, words):
    """In a process of its own, as numba and matplotlib read them once."""
    command = [sys.executable, "-m", "tetopt", "quality", str(tmp_path / "a.vtu")]
    ended = subprocess.run(
        command, env=os.environ | {name: value}, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    assert re.fullmatch(f"tetopt: {words}.*\n", ended.stderr), ended.stderr


def test_the_list_of_commands_has_their_first_lines():
    for name in COMMANDS:
        assert loaded_command(name).__doc__.splitlines()[0] == help_line(name)


def test_every_public_name_is_there():
    for name in dir(tetopt):
        assert getattr(tetopt, name) is not None
    with pytest.raises(AttributeError, match="octre"):
        tetopt.octre  # noqa: B018


# --------------------------------------------------------------------------------------------------
# quality


def test_quality_of_a_run(run, inputs, tmp_path, capsys):
    folder, numbers, file, image = run
    command = ["quality", folder / "mesh.vtu", "--image", inputs / "sphere.nii.gz", "--all"]
    assert exit_code(*command, "--json", tmp_path / "q.json") == 0
    report = numbers_in(tmp_path / "q.json")
    assert report["quality"] == numbers["quality"]
    assert report["n_turned"] == 0
    assert report["fit"]["E_D"] == pytest.approx(numbers["history"][-1]["E_D"], rel=1e-6)
    assert report["fit"]["E_D_fraction_of_variance"] == pytest.approx(
        numbers["energies"]["E_D_fraction_of_variance"], rel=1e-6
    )
    assert report["fit"]["n_voxels"] == image.data.size
    assert report["fit"]["n_empty_cells"] == int((file.cell_data["n_voxels"] == 0).sum())
    captured = capsys.readouterr()
    assert captured.err == ""
    assert re.search(
        rf"^voxels inside +{image.data.size} of {image.data.size}$", captured.out, re.M
    )
    assert re.search(rf"^nodes +{len(file.mesh.points)}$", captured.out, re.M)


def test_quality_of_a_mesh_elsewhere(run, inputs, tmp_path, capfd):
    _, _, file, _ = run
    save_mesh(tmp_path / "far.vtu", Mesh(file.mesh.points + 1000.0, file.mesh.cells))
    command = ["quality", tmp_path / "far.vtu", "--image", inputs / "sphere.nii.gz"]
    assert_refused(capfd, command, "no voxel centre is inside the mesh")


def test_quality_of_triangles(inputs, tmp_path, capsys):
    image = load_image(inputs / "disc.nii")
    save_mesh(tmp_path / "a.vtu", lattice_mesh(image, nodes=60))
    assert exit_code("quality", tmp_path / "a.vtu", "--image", inputs / "disc.nii") == 0
    assert re.search(r"^area, mm2 +4096.00$", capsys.readouterr().out, re.M)


# --------------------------------------------------------------------------------------------------
# phantom


@pytest.mark.parametrize("name", ["disc_2d", "two_spheres"])
def test_phantoms_with_labels(tmp_path, name, capsys):
    phantom = load_phantom(name)
    voxel = float(phantom.size_mm.max() / 16)
    image_path, label_path = tmp_path / "a.nii.gz", tmp_path / "labels.nii.gz"
    command = ["phantom", name, "-o", image_path, "--labels", label_path, "--voxel-mm", repr(voxel)]
    assert exit_code(*command) == 0
    expected, labels = phantom.image(voxel_mm=voxel), phantom.label_image(voxel_mm=voxel)
    written = nibabel.load(image_path)
    np.testing.assert_array_equal(written.get_fdata().reshape(expected.shape), expected.data)
    np.testing.assert_array_equal(
        nibabel.load(label_path).get_fdata().reshape(labels.shape), labels.data
    )
    n = expected.ndim
    np.testing.assert_allclose(written.affine[:n, :n], expected.affine[:n, :n], rtol=1e-6)
    captured = capsys.readouterr()
    size = " x ".join(map(str, expected.shape))
    assert captured.out.startswith(f"{image_path}: {name}, {size} voxels, ")
    assert captured.err == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.nii.gz", "labels.nii.gz"]


# --------------------------------------------------------------------------------------------------
# Places in the world


def test_a_sphere_keeps_its_place_in_an_oblique_sheared_world(tmp_path):
    """Through the files: phantom -> image -> mesh -> where the cells' means say that the sphere is.

    A cell weighs its volume, or its number of voxels, times its mean over the background; it stands
    at the mean world place of the voxel centres that it holds.
    """
    (tmp_path / "sphere.toml").write_text(OBLIQUE_TOML)
    assert exit_code("phantom", tmp_path / "sphere.toml", "-o", tmp_path / "a.nii.gz") == 0
    command = ["mesh", tmp_path / "a.nii.gz", "-o", tmp_path / "a.vtu", "--nodes", "600"]
    assert exit_code(*command, "--iterations", "4") == 0
    image, file = load_image(tmp_path / "a.nii.gz"), load_mesh(tmp_path / "a.vtu")
    assert_covers(file.mesh, image)
    assert_round_trips(file.mesh.points, image)
    owner = tetopt.cell_of_voxel(image, file.mesh).ravel()
    place = image.to_world(np.indices(image.shape).reshape(3, -1).T)
    counts = np.bincount(owner, minlength=len(file.mesh.cells))
    np.testing.assert_array_equal(counts, file.cell_data["n_voxels"])
    is_held = counts > 0
    sums = np.stack(
        [np.bincount(owner, place[:, k], minlength=len(counts)) for k in range(3)], axis=1
    )
    centroids = sums[is_held] / counts[is_held, None]
    true = image.to_index([14.3, -10.1, 28.7])
    for name, allowed in (("volume", 0.05), ("n_voxels", 0.02)):  # voxels
        weights = (file.cell_data[name] * (file.cell_data["mean"] - 20.0))[is_held]
        centre = (weights[:, None] * centroids).sum(axis=0) / weights.sum()
        assert np.linalg.norm(image.to_index(centre) - true) < allowed
    contrast = (file.cell_data["volume"] * (file.cell_data["mean"] - 20.0)).sum()
    assert contrast == pytest.approx(80.0 * 4 / 3 * np.pi * 9.0**3, rel=0.02)


def test_an_oblique_anisotropic_volume(tmp_path, data_dir):
    path = data_dir / "brain_flair_oblique_aniso.nii.gz"
    command = ["mesh", path, "-o", tmp_path / "a.vtu", "--nodes", "300", "--iterations", "1"]
    assert exit_code(*command) == 0
    image, mesh = load_image(path), load_mesh(tmp_path / "a.vtu").mesh
    off_axis = image.affine[:3, :3] / image.spacing
    assert np.abs(np.sort(np.abs(off_axis), axis=0)[1]).max() > 0.01  # oblique it is
    assert image.spacing.max() / image.spacing.min() > 2.0  # and anisotropic
    assert_covers(mesh, image)
    assert_round_trips(mesh.points, image)


def test_a_4d_file_needs_a_volume(tmp_path, data_dir, capfd):
    path = data_dir / "example4d.nii.gz"
    command = ["mesh", path, "-o", tmp_path / "a.vtu", "--nodes", "100", "--iterations", "1"]
    assert_refused(capfd, command, "2 volumes; choose one")
    assert_refused(capfd, [*command, "--volume", "2"], "expected a volume from 0 to 1, got 2")
    assert list(tmp_path.iterdir()) == []
    assert exit_code(*map(str, command), "--volume", "1") == 0
    file, image = load_mesh(tmp_path / "a.vtu"), load_image(path, volume=1)
    assert_covers(file.mesh, image)
    total = (file.cell_data["n_voxels"] * file.cell_data["mean"]).sum()
    assert total == pytest.approx(image.data.sum(dtype=np.float64), rel=1e-9)
    other = load_image(path, volume=0).data.sum(dtype=np.float64)
    assert total != pytest.approx(other, rel=1e-6)
    command = ["quality", tmp_path / "a.vtu", "--image", path, "--volume", "1"]
    assert exit_code(*command) == 0


# --------------------------------------------------------------------------------------------------
# demo


@pytest.mark.drawn
def test_demo(tmp_path):
    pytest.importorskip("nilearn", reason="the demo's image comes in nilearn's wheel")
    folder = tmp_path / "new" / "demo"
    assert exit_code("demo", "-o", folder, "--nodes", "300", "--iterations", "2") == 0
    pictures = ["slice.png", "rho.png", "energies.png", "thumbnail.png"]
    assert sorted(p.name for p in folder.iterdir()) == sorted(["mesh.vtu", "run.json", *pictures])
    for name in pictures:
        with PIL.Image.open(folder / name) as picture:
            assert np.asarray(picture.convert("L")).std() > 10.0
    numbers, file = numbers_in(folder / "run.json"), load_mesh(folder / "mesh.vtu")
    assert numbers["mesh_sha256"] == mesh_hash(file.mesh)
    assert numbers["energies"]["E_D_relative"] < 0.8
    assert file.cell_data["n_voxels"].sum() == np.prod(numbers["image_properties"]["shape"])
    assert file.cell_data["volume"].sum() == pytest.approx(
        numbers["image_properties"]["volume_mm"], rel=1e-9
    )
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert exit_code("demo", "-o", folder, "--nodes", "300", "--iterations", "2") == 2
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def test_demo_without_nilearn(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(tetopt.io.mni.importlib.util, "find_spec", lambda name: None)
    assert_refused(capfd, ["demo", "-o", tmp_path / "demo"], r'pip install "nilearn(>=[0-9.]+)?"')
    assert list(tmp_path.iterdir()) == []


# --------------------------------------------------------------------------------------------------
# what is allowed but hardly meant


def small_run(inputs, folder, iterations):
    command = ["mesh", inputs / "sphere.nii.gz", "-o", folder / "a.vtu", "--nodes", "60"]
    return [*command, "--iterations", iterations]


@pytest.mark.deep
def test_a_reader_that_goes_away_loses_no_file(tmp_path, inputs):
    """`tetopt mesh ... | head -1`: mesh and numbers are written, and nothing complains."""
    command = [
        sys.executable,
        "-m",
        "tetopt",
        "mesh",
        inputs / "sphere.nii.gz",
        "-o",
        tmp_path / "a.vtu",
    ]
    command += ["--json", tmp_path / "a.json", "--nodes", "60", "--iterations", "1"]
    run = subprocess.run(
        ["bash", "-c", '"$@" | true; exit "${PIPESTATUS[0]}"', "-", *command],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0
    assert "Traceback" not in run.stderr
    assert numbers_in(tmp_path / "a.json")["quality"]["n_cells"] == len(
        load_mesh(tmp_path / "a.vtu").mesh.cells
    )


def test_quality_of_overlapping_cells(tmp_path, inputs, capsys):
    mesh = lattice_mesh(load_image(inputs / "sphere.nii.gz"), nodes=60)
    # Once more a few of them, and not all of the others: together they hold no more voxels than
    # there are.
    save_mesh(
        tmp_path / "twice.vtu", Mesh(mesh.points, np.vstack([mesh.cells[3:], mesh.cells[4:5]]))
    )
    words = [tmp_path / "twice.vtu", "--image", inputs / "sphere.nii.gz"]
    assert exit_code("quality", *words, "--json", tmp_path / "q.json") == 1
    overlap = numbers_in(tmp_path / "q.json")["fit"]["overlap"]
    assert overlap["cells"] == [1, len(mesh.cells) - 3]
    assert (
        f"cells 1 and {len(mesh.cells) - 3} both contain voxel {overlap['voxel']}"
        in capsys.readouterr().err
    )
    assert exit_code("segment", words[2], words[0], "-o", tmp_path / "s.nii.gz") == 2
    assert "twice.vtu: cells overlap: " in capsys.readouterr().err
    assert not (tmp_path / "s.nii.gz").exists()


def test_quality_with_another_image(tmp_path, inputs, capsys):
    command = small_run(inputs, tmp_path, 0)
    assert exit_code(*command) == 0
    other = load_phantom("two_spheres").image(voxel_mm=8.0)
    save_image(tmp_path / "other.nii", other)
    save_image(tmp_path / "crop.nii", Image(other.data[:-1], other.affine))
    capsys.readouterr()
    assert exit_code("quality", tmp_path / "a.vtu", "--image", inputs / "sphere.nii.gz") == 0
    assert capsys.readouterr().err == ""
    assert exit_code("quality", tmp_path / "a.vtu", "--image", tmp_path / "other.nii") == 0
    assert "a.vtu was built from a different image" in capsys.readouterr().err
    for words in ([tmp_path / "crop.nii"], [inputs / "sphere.nii.gz", "--crop", "1:,:,:"]):
        assert exit_code("quality", tmp_path / "a.vtu", "--check", "--image", *words) == 2
        said = capsys.readouterr().err
        assert "expected the box of" in said
        assert "--check needs that image, with its crop" in said
        assert said.count("\n") == 1


@pytest.mark.parametrize("part", [["--slice", "k=4"], ["--crop", "1:7,:,2:"]])
def test_quality_of_a_part(tmp_path, inputs, part, capsys):
    """A mesh of a slice or a crop is measured against the same part: every voxel is inside."""
    image = ["--image", inputs / "sphere.nii.gz", *part]
    command = small_run(inputs, tmp_path, 1)
    assert exit_code(*command, *part) == 0
    capsys.readouterr()
    assert exit_code("quality", tmp_path / "a.vtu", *image) == 0
    inside, all_ = re.search(r"voxels inside +(\d+) of (\d+)", capsys.readouterr().out).groups()
    assert inside == all_


def test_folders_of_pictures_and_results_are_made_and_none_is_left_where_a_run_is_refused(
    tmp_path, inputs, capfd
):
    mesh = [
        "mesh",
        inputs / "sphere.nii.gz",
        "-o",
        tmp_path / "a.vtu",
        "--iterations",
        "0",
        "--spacing",
        "16",
    ]
    assert_refused(
        capfd,
        [*mesh, "--figures", tmp_path / "new" / "deep", "--mask", tmp_path / "no.nii"],
        "no.nii",
    )
    assert_refused(
        capfd, ["compare", inputs / "disc.nii", "-o", tmp_path / "new"], "expected a volume"
    )
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("a file")
    assert_refused(
        capfd,
        [*mesh, "--figures", tmp_path / "file"],
        "expected a folder for the results, found a file",
    )
    assert_refused(
        capfd,
        [*mesh, "--figures", tmp_path / "file" / "a"],
        "a: cannot create the folder for the results",
    )
    assert exit_code(*mesh, "--figures", tmp_path / "new" / "deep") == 0
    names = {"slice.png", "rho.png", "energies.png", "thumbnail.png"}
    assert {each.name for each in (tmp_path / "new" / "deep").iterdir()} == names


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--method", "paper"], "only with --method fast"),
        (["--spacing", "3"], "no single spacing"),
        (["--nodes", "900000"], "too many for 16 x 16 x 16 voxels; use at most 5000"),
        (["--target-error", "1.5"], "expected a fraction of the image's variance, 0 to 1, got 1.5"),
        (
            ["--nodes", "100", "--edge-size", "6"],
            "100 nodes are too few for 16 x 16 x 16 voxels and these limits",
        ),
        (["--edge-size", "0.2"], "sizes: the requested edges are so short that cells are smaller"),
        (
            ["--size-min", "9", "--edge-max", "8"],
            "--edge-max: 8 mm is below the smallest size, 9 mm",
        ),
        (["--edge-size", "-1"], "--edge-size: expected a length above 0"),
        (["--gradation", "3"], "gradation: expected 0.05 (gentle) to 1, got 3"),
    ],
)
def test_octree_options(tmp_path, inputs, capsys, extra, words):
    """What an octree cannot do is one line, exit 2, and no file."""
    path = tmp_path / "a.vtu"
    assert (
        exit_code("mesh", inputs / "sphere.nii.gz", "-o", path, "--lattice", "octree", *extra) == 2
    )
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert words in error
    assert not path.exists()


def test_octree_mesh(tmp_path, inputs, capsys):
    """The number of nodes is met, and the terminal calls the start what it is."""
    path = tmp_path / "a.vtu"
    words = ["mesh", inputs / "sphere.nii.gz", "-o", path, "--lattice", "octree", "--nodes", "400"]
    assert exit_code(*words) == 0
    printed = capsys.readouterr()
    assert "octree of" in printed.err
    assert printed.out.split()[0] == "octree"
    loaded = tetopt.load_mesh(path)
    assert len(loaded.mesh.points) == 400
    assert exit_code(*words, "--force", "--k-d", "0", "--iterations", "1") == 0
    n_nodes, err = len(tetopt.load_mesh(path).mesh.points), capsys.readouterr().err
    assert (f"{n_nodes} nodes instead of 400" in err) == (abs(n_nodes - 400) > 4)


@pytest.mark.parametrize(
    ("word", "option"),
    [
        ("--uniform", "--target-error 0.1"),
        ("--spacing 8", "--edge-size 9"),
        ("--method paper", "--edge-max 9"),
    ],
)
def test_limits_are_for_graded_meshes(tmp_path, inputs, capfd, word, option):
    command = [
        "mesh",
        inputs / "sphere.nii.gz",
        "-o",
        tmp_path / "a.vtu",
        *word.split(),
        *option.split(),
    ]
    assert_refused(capfd, command, f"{option.split()[0]}: needs a graded mesh")


def test_mesh_with_limits(tmp_path, inputs, capfd):
    """They reach the mesh, and the numbers and a line tell them."""
    image = load_image(inputs / "sphere.nii.gz")
    field = np.where(np.arange(16)[:, None, None] < 5, 13.0, 0.0) * np.ones((1, 16, 16))
    save_image(tmp_path / "sizes.nii.gz", Image(field, image.affine))
    command = mesh_words(inputs / "sphere.nii.gz", tmp_path)
    words = [
        "--nodes",
        "500",
        "--edge-size",
        "30",
        "--sizing",
        tmp_path / "sizes.nii.gz",
        "--gradation",
        "0.9",
    ]
    assert exit_code(*command, *words) == 0
    mesh = load_mesh(tmp_path / "a.vtu").mesh
    assert len(mesh.points) == 500
    numbers = numbers_in(tmp_path / "a.json")
    options, met = numbers["options"], numbers["edges_over_target"]
    assert [options[name] for name in SIZES] == [None, 30.0, None, 0.9, "sizes.nii.gz"]
    sizes = tetopt.Sizes(edge_size=30.0, field=Image(field, image.affine), gradation=0.9)
    assert met["mean"] == pytest.approx(edge_ratios(mesh.points, mesh.cells, sizes).mean)
    assert len(met["edges_of_bins"]) == len(met["fraction"]) + 1
    line = (
        f"ratio of edges to their target size: {met['mean']:.2f} on average; "
        f"{met['below']:.1%} are below 0.71"
    )
    assert line in capfd.readouterr().out
    assert exit_code(*command, "--force", "--nodes", "500", "--edge-max", "40") == 0
    numbers = numbers_in(tmp_path / "a.json")
    assert numbers["options"]["edge_max"] == 40.0
    assert "edges_over_target" not in numbers
    assert "target size" not in capfd.readouterr().out


def test_sizes_make_the_number_of_nodes(tmp_path, inputs):
    """Alone they say it; where only a part has a target, the rest gets its fraction of the usual
    number.
    """
    image = load_image(inputs / "sphere.nii.gz")
    command = [*mesh_words(inputs / "sphere.nii.gz", tmp_path), "--iterations", "6", "--force"]
    assert exit_code(*command, "--edge-size", "14") == 0
    needed = nodes_of_sizes(image, tetopt.Sizes(edge_size=14.0))[0]
    assert numbers_in(tmp_path / "a.json")["options"]["nodes"] == needed
    assert len(load_mesh(tmp_path / "a.vtu").mesh.points) == needed
    field = Image(
        np.where(np.arange(16)[:, None, None] < 4, 14.0, 0.0) * np.ones((1, 16, 16)), image.affine
    )
    save_image(tmp_path / "sizes.nii.gz", field)
    assert exit_code(*command, "--sizing", tmp_path / "sizes.nii.gz") == 0
    of_part, fraction = nodes_of_sizes(image, tetopt.Sizes(field=field))
    assert fraction == 0.25
    assert numbers_in(tmp_path / "a.json")["options"]["nodes"] == round(of_part + 0.75 * 16**3 / 8)


def test_only_the_users_longest_edge_is_told_as_missed(tmp_path, inputs, monkeypatch, capsys):
    """Not that of cells of order 2, which a run chooses itself."""
    monkeypatch.setattr(tetopt.job.advice, "LENGTH_ROUNDING", -0.9)  # any edge is too long
    command = mesh_words(inputs / "sphere.nii.gz", tmp_path)
    quadratic = ["--nodes", "300", "--iterations", "1", "--order", "2"]
    for words, is_told in (([], False), (["--edge-max", "60"], True)):
        assert exit_code(*command, *quadratic, *words, "--force") == 0
        err = capsys.readouterr().err
        assert ("over --edge-max" in err) == is_told
        pattern = r"run \d of up to 3: (\d+) of 300 nodes, including .* ([\d.]+)% off; aim: 1%"
        runs = re.findall(pattern, err)
        assert len(runs) == err.count(" of up to 3: ") > 0
        for count, off in runs:
            assert float(off) == pytest.approx(abs(int(count) / 3.0 - 100.0), abs=0.06)
        assert numbers_in(tmp_path / "a.json")["options"]["edge_max"] > 0.0


def test_target_error(tmp_path, inputs, capfd):
    """As many nodes as it takes, told in the numbers; the same as asking for that many. A miss
    exits 1.
    """
    command = mesh_words(inputs / "sphere.nii.gz", tmp_path)
    assert exit_code(*command, "--target-error", "0.2") == 0
    numbers = numbers_in(tmp_path / "a.json")
    runs = re.findall(
        r"run (\d) of up to 6: (\d+) nodes leave ([\d.]+) of the variance", capfd.readouterr().err
    )
    assert [int(number) for number, _, _ in runs] == list(range(1, len(runs) + 1))
    assert float(runs[-1][2]) == pytest.approx(
        numbers["energies"]["E_D_fraction_of_variance"], rel=1e-3
    )
    assert numbers["energies"]["E_D_fraction_of_variance"] <= 0.2
    nodes = numbers["options"]["nodes"]
    assert numbers["options"]["target_error"] == 0.2
    assert exit_code(*command, "--force", "--nodes", nodes) == 0
    assert numbers_in(tmp_path / "a.json")["mesh_sha256"] == numbers["mesh_sha256"]
    capfd.readouterr()
    assert exit_code(*command, "--force", "--target-error", "0.01", "--size-min", "32") == 1
    assert "of the image's variance is unexplained, more than 0.01" in capfd.readouterr().err


def test_target_error_with_the_most_nodes(tmp_path, capfd):
    """What the error takes is said before the run with the most nodes, which is that of as many;
    what it left, then.
    """
    x, y = np.indices((120, 100))
    save_image(tmp_path / "a.nii.gz", Image(10.0 * np.sin(x / 9.0) * np.cos(y / 8.0) + x))
    command = mesh_words(tmp_path / "a.nii.gz", tmp_path)
    assert exit_code(*command, "--target-error", "0.001", "--nodes-max", "230") == 1
    numbers, err = numbers_in(tmp_path / "a.json"), " ".join(capfd.readouterr().err.split())
    (first, left), (last, reached) = re.findall(
        r"run \d of up to 6: (\d+) nodes leave ([\d.]+) of the variance", err
    )
    pattern = (
        r"an error of 0.001 requires about (\d+) nodes, \d+ s and [\d.]+ [MG]B of memory; "
        r"(more than .*? has \d+ nodes)"
    )
    ((predicted, words),) = re.findall(pattern, err)
    assert (int(first), int(last), words) == (
        200,
        230,
        "more than --nodes-max, so that the next run has 230 nodes",
    )
    assert int(predicted) == pytest.approx(
        200.0 * (float(left) / (0.925 * 0.001)) ** (1.0 / ERROR_RATE), rel=0.01
    )
    assert err.index(words) < err.index(f"{last} nodes leave")
    assert (
        f"{reached} of the image's variance is unexplained, more than 0.001, which requires about "
        in err
    )
    assert "allow more (--nodes-max)" in err
    options = numbers["options"]
    assert list(numbers["violated"]) == ["error"]
    assert (options["nodes"], options["nodes_max"], numbers["size"]["n_nodes"]) == (230, 230, 230)
    assert exit_code(*command, "--force", "--nodes", 230) == 0
    assert numbers_in(tmp_path / "a.json")["mesh_sha256"] == numbers["mesh_sha256"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--nodes-max 300", "--nodes-max: needs --target-error"),
        ("--nodes-max 300 --nodes 200", "--nodes-max: needs --target-error"),
        ("--nodes-max 300 --spacing 9", "--nodes-max: needs --target-error"),
        ("--nodes-max 4 --target-error 0.2", "--nodes-max: expected 5 or more, got 4"),
        (
            "--nodes-max 8 --target-error 0.2",
            "--nodes-max: expected a whole number, 9 or more in 3-D, got 8",
        ),
        ("--nodes-max 60 --target-error 0.2 --edge-max 9", "--nodes-max: sizes require about"),
    ],
)
def test_the_most_nodes_are_those_for_an_error(tmp_path, inputs, capfd, options, words):
    command = ["mesh", inputs / "sphere.nii.gz", "-o", tmp_path / "a.vtu", *options.split()]
    assert_refused(capfd, command, words)


# --------------------------------------------------------------------------------------------------
# segment


def test_segment(tmp_path, inputs, capfd):
    """The labels written are the library's; Dice with the truth is printed for mesh and voxels."""
    phantom = tetopt.load_phantom("sphere")
    tetopt.save_image(tmp_path / "image.nii.gz", phantom.image(voxel_mm=2.0))
    tetopt.save_image(tmp_path / "truth.nii.gz", phantom.label_image(voxel_mm=2.0))
    image = tetopt.load_image(tmp_path / "image.nii.gz")
    mesh = tetopt.optimize(image, tetopt.lattice_mesh(image, nodes=400), k_D=0.5, iterations=4).mesh
    tetopt.save_mesh(tmp_path / "mesh.vtu", mesh)
    files = [tmp_path / name for name in ("image.nii.gz", "mesh.vtu")]
    options = ["-o", tmp_path / "labels.nii.gz", "--classes", "2", "--json", tmp_path / "s.json"]
    assert exit_code("segment", *files, *options, "--truth", tmp_path / "truth.nii.gz") == 0
    labels = tetopt.load_image(tmp_path / "labels.nii.gz")
    np.testing.assert_array_equal(labels.data, segment(image, mesh, 2).data)
    np.testing.assert_allclose(labels.affine, image.affine)
    numbers = numbers_in(tmp_path / "s.json")
    overlaps = dice(labels, tetopt.load_image(tmp_path / "truth.nii.gz"))
    assert numbers["dice"]["mesh"] == {str(label): value for label, value in overlaps.items()}
    assert overlaps[1] > 0.8
    assert f"{overlaps[1]:.4f}" in capfd.readouterr().out
    assert exit_code("segment", *files, *options) == 2
    assert "exists" in capfd.readouterr().err


def test_segment_refuses_other_labels(tmp_path, inputs, capfd):
    command = [
        "segment",
        inputs / "sphere.nii.gz",
        inputs / "lattice.vtu",
        "-o",
        tmp_path / "l.nii",
    ]
    other = tetopt.load_phantom("sphere").label_image(voxel_mm=3.3)
    tetopt.save_image(tmp_path / "other.nii", other)
    assert exit_code(*command, "--truth", tmp_path / "other.nii") == 2
    assert "expected labels on the image's grid" in capfd.readouterr().err
    assert exit_code(*command, "--classes", "300") == 2
    assert "classes: 300 requested" in capfd.readouterr().err
    assert not (tmp_path / "l.nii").exists()


def test_segment_labels_must_lie_where_the_image_does(tmp_path, inputs, capfd):
    """Truth of the same shape but elsewhere is refused; truth is cut as the image is; a foreign
    mesh is told.
    """
    sphere = load_image(inputs / "sphere.nii.gz")
    shifted = sphere.affine.copy()
    shifted[0, 3] += 3.0
    save_image(tmp_path / "shifted.nii", Image(sphere.data > 50, shifted))
    save_image(tmp_path / "truth.nii", Image(sphere.data > 50, sphere.affine))
    command = [
        "segment",
        inputs / "sphere.nii.gz",
        inputs / "lattice.vtu",
        "-o",
        tmp_path / "l.nii",
    ]
    assert exit_code(*command, "--truth", tmp_path / "shifted.nii") == 2
    capfd.readouterr()
    save_image(tmp_path / "odd.nii", Image(np.where(sphere.data > 50, 1e30, 0.5), sphere.affine))
    assert exit_code(*command, "--truth", tmp_path / "odd.nii") == 2
    assert "labels must be whole numbers" in capfd.readouterr().err
    mesh = [
        "mesh",
        inputs / "sphere.nii.gz",
        "--slice",
        "k=5",
        "-o",
        tmp_path / "s.vtu",
        "--nodes",
        "40",
    ]
    assert exit_code(*mesh, "--iterations", "0") == 0
    cut = [
        "segment",
        inputs / "sphere.nii.gz",
        tmp_path / "s.vtu",
        "-o",
        tmp_path / "l.nii",
        "--slice",
        "k=5",
    ]
    assert exit_code(*cut, "--truth", tmp_path / "truth.nii", "--classes", "2") == 0
    kept = (tmp_path / "truth.nii").read_bytes()
    over = [
        *cut[:4],
        tmp_path / "truth.nii",
        *cut[5:],
        "--truth",
        tmp_path / "truth.nii",
        "--force",
    ]
    assert exit_code(*over) == 2
    assert (tmp_path / "truth.nii").read_bytes() == kept


def test_an_error_of_a_million_letters_is_cut(capsys):
    show_error("a.txt, line 3: expected a label, got " + "x" * 1_000_000 + "; mend it")
    error = capsys.readouterr().err
    assert error.startswith("tetopt: a.txt, line 3: expected a label, got x")
    assert error.endswith("x; mend it\n")
    assert len(error) < 500
