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
from commands import (
    assert_done,
    assert_refused,
    exit_code,
    in_copy_of,
    numbers_in,
    separate,
)
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
import tetopt.cli.mesh
import tetopt.cli.phantom
import tetopt.engine.meshing
from tetopt import (
    Image,
    Mesh,
    Sizes,
    lattice_mesh,
    load_image,
    load_mesh,
    load_phantom,
    optimize,
    quality,
    save_image,
    save_mesh,
)
from tetopt.cli.app import COMMANDS, help_line, loaded_command
from tetopt.cli.console import show_error, show_event
from tetopt.geometry.simplex import volumes
from tetopt.job.advice import order_problems, sentences, tell, unmet_requirements
from tetopt.job.events import listen_with
from tetopt.measure.judge import ERROR_RATE
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


here = in_copy_of("inputs")
MESH = "mesh sphere.nii.gz -o a.vtu --json a.json"


@pytest.fixture(autouse=True)
def _same_threads_afterwards():
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with small images and a mesh."""
    folder = tmp_path_factory.mktemp("inputs")
    assert_done("phantom sphere -o", folder / "sphere.nii.gz", "--voxel-mm 4")
    assert_done("phantom disc_2d -o", folder / "disc.nii", "--voxel-mm 2")
    save_image(folder / "flat.nii", Image(np.full((5, 6, 7), 3.0)))
    save_mesh(folder / "lattice.vtu", lattice_mesh(load_image(folder / "sphere.nii.gz"), nodes=60))
    return folder


@pytest.fixture(scope="module")
def run(inputs, tmp_path_factory):
    """One run in 3-D with all its outputs: folder, run.json, mesh file, image."""
    folder = tmp_path_factory.mktemp("run")
    command = [
        "mesh",
        inputs / "sphere.nii.gz",
        "-o",
        folder / "mesh.vtu",
        "--nodes 150 --json",
        folder / "run.json",
        "--iterations 3 --k-d 0.3 --method paper --n-t 1",
    ]
    assert_done(*command)
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
    assert_allclose(mesh.points.min(axis=0), corners.min(axis=0), atol=1e-6)
    assert_allclose(mesh.points.max(axis=0), corners.max(axis=0), atol=1e-6)


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


def test_json_of_a_run(run):
    _, numbers, file, _ = run
    assert numbers["image"] == "sphere.nii.gz"
    assert numbers["image_sha256"] == hashlib.sha256(Path("sphere.nii.gz").read_bytes()).hexdigest()
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
    assert_array_equal(file.cell_data["n_voxels"], moments.n_voxels)
    assert_array_equal(file.cell_data["mean"], moments.mean)
    assert file.cell_data["n_voxels"].sum() == image.data.size
    assert (file.cell_data["n_voxels"] * file.cell_data["mean"]).sum() == pytest.approx(
        image.data.sum(), rel=1e-12
    )
    assert_array_equal(file.cell_data["volume"], volumes(file.mesh.points, file.mesh.cells))
    texts = {name: values[0] for name, values in file.field_data.items()}
    assert texts["tetopt"] == tetopt.__version__
    assert texts["image"] == "sphere.nii.gz"
    assert texts["image_sha256"] == numbers["image_sha256"]
    assert json.loads(texts["options"]) == numbers["options"]
    other = meshio.read(folder / "mesh.vtu")
    assert_array_equal(other.points, file.mesh.points)
    assert_array_equal(other.cells_dict["tetra"], file.mesh.cells)


def test_mesh_in_2d(here):
    assert_done("mesh disc.nii -o disc.vtu --nodes 80 --iterations 4")
    image, file = load_image("disc.nii"), load_mesh("disc.vtu")
    assert_covers(file.mesh, image)
    assert_round_trips(file.mesh.points, image)
    assert file.cell_data["n_voxels"].sum() == image.data.size
    # The disc of 20 mm, of intensity 100 on 20: what the cells hold of it lies in its place, (0,
    # 0).
    weight = file.cell_data["volume"] * (file.cell_data["mean"] - 20.0)
    assert weight.sum() / 80.0 == pytest.approx(np.pi * 20.0**2, rel=0.05)
    assert here() == ["disc.vtu"]


@pytest.mark.parametrize(
    "options",
    [
        "--method paper --boundary fixed --retessellate never",
        "--retessellate accept --n-t 0 --method paper",
        "--shape-power 1 --min-dihedral 0",
        "--k-d 0 --lattice five-tet",
        "--crop 2:14,:,1:15",
    ],
)
def test_other_options(options):
    assert_done(f"{MESH} --spacing 16 --iterations 1 {options}")
    image = load_image(
        "sphere.nii.gz",
        crop=[(2, 14), (None, None), (1, 15)] if "--crop" in options else None,
    )
    file = load_mesh("a.vtu")
    assert_covers(file.mesh, image)
    stated = numbers_in("a.json")["options"]
    for name, value in zip(*[iter(options.split())] * 2, strict=True):
        key = {"--k-d": "k_D"}.get(name, name[2:].replace("-", "_"))
        assert str(stated[key]) in (value, f"{value}.0")


@pytest.mark.parametrize(
    ("name", "size"),
    [("sphere.nii.gz", {"nodes": 100}), ("disc.nii", {"spacing": 9})],
)
def test_no_iterations_write_the_lattice_itself(name, size):
    ((option, value),) = size.items()
    assert_done(f"mesh {name} -o a.vtu --{option} {value} --uniform --iterations 0")
    expected = lattice_mesh(load_image(name), **size)
    mesh = load_mesh("a.vtu").mesh
    assert mesh.points.tobytes() == expected.points.tobytes()
    assert_array_equal(mesh.cells, expected.cells)


def test_the_table_shows_before_and_after_and_lines_the_progress(capsys):
    assert_done(f"{MESH} --nodes 150 --iterations 3")
    numbers, said = numbers_in("a.json"), capsys.readouterr()
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
        "a.json: every number of the run",
        f"all requirements are met; a.vtu: {nodes} nodes, {cells} cells",
    ]
    history, lines = numbers["history"], said.err.splitlines()
    words = (
        "16 x 16 x 16 voxels of 4 x 4 x 4 mm; octree of 148 nodes, 576 cells, edges up to 26.7 mm"
    )
    first = f"sphere.nii.gz: {words}"
    assert re.fullmatch(rf"{re.escape(first)}; about \d\.\d+ GB of memory", lines[0])
    progress = [line for line in lines[1:] if line.startswith("iteration")]
    assert len(progress) == 4
    for k, (line, row) in enumerate(zip(progress, history, strict=True)):
        E_D = row["E_D"] / history[0]["E_D"]
        assert line.startswith(f"iteration   {k}/3  E {row['E']:.4f}  E_G ")
        assert f"  E_D {E_D:.4f}  {row['n_cells']} cells  " in line
    assert not any("\x1b" in line for line in lines)  # no colours, no cursor movements


def test_a_constant_image_warns_and_works(capsys):
    assert_done("mesh flat.nii -o a.vtu --json a.json --nodes 50 --iterations 2")
    captured = capsys.readouterr()
    warning = "tetopt: warning: flat.nii: the image is 3 everywhere, so E_D is 0 everywhere"
    assert captured.err.splitlines()[0] == warning
    assert captured.err.count("warning") == 1
    assert "E_D" not in captured.out
    assert numbers_in("a.json")["energies"]["E_D_relative"] is None
    assert_covers(load_mesh("a.vtu").mesh, load_image_quietly("flat.nii"))


def load_image_quietly(path):
    with pytest.warns(UserWarning, match="everywhere"):
        return load_image(path)


def test_a_name_with_markup_and_letters(capsys):
    """Rich would take [red] for a colour and :cat: for a picture."""
    folder = Path("Schädel [red] :cat:")
    folder.mkdir()
    shutil.copy("disc.nii", folder / "ä[1].nii")
    command = [
        "mesh",
        folder / "ä[1].nii",
        "-o",
        folder / "a[b].vtu",
        "--nodes 30 --iterations 1",
    ]
    assert_done(*command)
    captured = capsys.readouterr()
    assert captured.err.startswith(f"{folder / 'ä[1].nii'}: 32 x 32 voxels")
    assert f"{folder / 'a[b].vtu'}: " in captured.out
    assert load_mesh(folder / "a[b].vtu").field_data["image"].tolist() == ["ä[1].nii"]
    assert_done("quality", folder / "a[b].vtu")
    assert capsys.readouterr().out.splitlines()[0].strip() == "a[b].vtu"


@pytest.mark.skipif(
    numba.config.NUMBA_NUM_THREADS < 2, reason="one core: there are no two thread counts to compare"
)
def test_the_same_bits_for_any_number_of_threads():
    hashes = []
    for threads in ("1", "2"):
        out = threads
        command = f"mesh sphere.nii.gz -o {out}.vtu --json {out}.json --nodes 400"
        assert_done(f"{command} --iterations 3 --threads {threads}")
        numbers = numbers_in(f"{out}.json")
        assert numbers["machine"]["threads"] == int(threads)
        hashes.append(numbers["mesh_sha256"])
        assert hashes[-1] == mesh_hash(load_mesh(f"{out}.vtu").mesh)
    assert hashes[0] == hashes[1]
    assert Path("1.vtu").read_bytes() == Path("2.vtu").read_bytes()


def test_max_seconds_leaves_a_valid_mesh(capsys):
    assert_done(f"{MESH} --nodes 400 --iterations 1000 --max-seconds 1e-6")
    numbers = numbers_in("a.json")
    assert numbers["ended"] == "max_seconds"
    assert numbers["options"]["max_seconds"] == 1e-6
    assert numbers["iterations_done"] < 1000
    mesh = load_mesh("a.vtu").mesh
    assert_covers(mesh, load_image("sphere.nii.gz"))
    assert numbers["mesh_sha256"] == mesh_hash(mesh)
    assert "out of time: the current mesh is kept" in capsys.readouterr().err


def test_what_is_violated_is_told_in_the_commands_options(capsys):
    violated = {
        "min_dihedral": "2 of 9 cells; allow a lower `k_D`, or a lower `min_dihedral`",
        "box": "k_D.nii lies beyond",
    }
    with listen_with(show_event):
        problems = order_problems(unmet_requirements(violated, {}))
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
        [sys.executable, "-m", "tetopt", *separate(arguments)],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        **options,
    )


@pytest.mark.deep
@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to one process")
def test_ctrl_c_leaves_a_valid_mesh(here):
    process = child([MESH, "--nodes 400 --iterations 100000 --k-d 0.9"])
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
    mesh = load_mesh("a.vtu").mesh
    assert_covers(mesh, load_image("sphere.nii.gz"))
    numbers = numbers_in("a.json")
    assert numbers["ended"] == "stopped"
    assert 2 <= numbers["iterations_done"] < 100000
    assert numbers["mesh_sha256"] == mesh_hash(mesh)
    assert here() == ["a.json", "a.vtu"]


@pytest.mark.deep
@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to one process")
def test_a_second_ctrl_c_gives_up(here, monkeypatch, capsys):
    def impatient(*_, stop, **__):
        signal.raise_signal(signal.SIGINT)
        assert stop()
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(tetopt.job.mesh_stage, "_prepare", lambda _: None)
    monkeypatch.setattr(
        tetopt.engine.meshing,
        "optimize",
        functools.wraps(tetopt.engine.meshing.optimize)(impatient),
    )
    before = signal.getsignal(signal.SIGINT)
    assert exit_code("mesh disc.nii -o a.vtu") == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert capsys.readouterr().err.splitlines()[-3:] == [
        "interrupted: finishing the current nodes, then writing the mesh (interrupt again to end "
        "at once)",
        "interrupted again: unwritten results are discarded",
        "ended by Ctrl-C; written: nothing",
    ]
    assert here() == []


@pytest.mark.deep
def test_ctrl_c_while_reading(here, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(tetopt.job.aligned, "load_image", interrupted)
    assert exit_code("mesh disc.nii -o a.vtu") == 130
    assert here() == []


# --------------------------------------------------------------------------------------------------
# Inputs to mend


BAD_OPTIONS = [  # of one image
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
    ("--lattice octree --method paper", "only with --method fast"),
    ("--lattice octree --spacing 3", "no single spacing"),
    ("--lattice octree --nodes 900000", "too many for 16 x 16 x 16 voxels; use at most 5000"),
    (
        "--lattice octree --target-error 1.5",
        "expected a fraction of the image's variance, 0 to 1, got 1.5",
    ),
    (
        "--lattice octree --edge-size 0.2",
        "sizes: the requested edges are so short that cells are smaller",
    ),
    (
        "--lattice octree --size-min 9 --edge-max 8",
        "--edge-max: 8 mm is below the smallest size, 9 mm",
    ),
    ("--lattice octree --edge-size -1", "--edge-size: expected a length above 0"),
    ("--lattice octree --gradation 3", "gradation: expected 0.05 (gentle) to 1, got 3"),
    ("--uniform --target-error 0.1", "--target-error: needs a graded mesh"),
    ("--spacing 8 --edge-size 9", "--edge-size: needs a graded mesh"),
    ("--method paper --edge-max 9", "--edge-max: needs a graded mesh"),
    ("--nodes-max 300", "--nodes-max: needs --target-error"),
    ("--nodes-max 300 --nodes 200", "--nodes-max: needs --target-error"),
    ("--nodes-max 300 --spacing 9", "--nodes-max: needs --target-error"),
    ("--nodes-max 4 --target-error 0.2", "--nodes-max: expected 5 or more, got 4"),
    (
        "--nodes-max 8 --target-error 0.2",
        "--nodes-max: expected a whole number, 9 or more in 3-D, got 8",
    ),
    ("--nodes-max 60 --target-error 0.2 --edge-max 9", "--nodes-max: sizes require about"),
    ("second.nii", "second.nii"),
]


@pytest.mark.parametrize(
    ("options", "said"), BAD_OPTIONS, ids=[options for options, _ in BAD_OPTIONS]
)
def test_bad_options_of_mesh(capfd, options, said):
    assert_refused(capfd, f"mesh sphere.nii.gz -o a.vtu {options}", said)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ("mesh no.nii -o a.vtu", "no.nii: no such file"),
        ("mesh disc.nii -o a.vtu --lattice bcc", "expected one of criss-cross in 2-D"),
        ("mesh disc.nii -o a.vtu --slice k=3", "slice"),
        ("mesh disc.nii -o a.vtu --crop 1:5,1:5,1:5", "crop"),
        ("mesh disc.nii -o a.obj", "unknown suffix; known suffixes are .vtu"),
        ("mesh disc.nii", "--output"),
        ("mesh -o a.vtu", r"Missing argument 'IMAGE\.\.\.'"),
        ("mesh lattice.vtu -o a.vtu", "unknown image format"),
        ("quality no.vtu", "no such file"),
        ("quality disc.nii", "expected a .vtu, .vtk, .msh or .msh2 mesh"),
        ("quality lattice.vtu --image no.nii", "no such file"),
        ("quality lattice.vtu --image disc.nii", "a 3-D image like the mesh, got a 2-D one"),
        ("quality", r"Missing argument '\[IMAGE\] MESH'"),
        ("phantom nothing -o a.nii", "phantom 'nothing': no such phantom; use one of constant"),
        ("phantom no.toml -o a.nii", "no.toml"),
        ("phantom sphere -o a.png", "ending in .nii or .nii.gz"),
        ("phantom sphere -o a.nii --labels ./a.nii", "or another output"),
        ("phantom sphere -o a.nii --voxel-mm 0", "--voxel-mm: "),
        ("phantom sphere -o a.nii --noise-sd -1", "--noise-sd: "),
        ("phantom sphere -o a.nii --seed x", "--seed"),
        ("refine", "No such command 'refine'"),
        ("demo -o disc.nii", "expected a folder"),
    ],
)
def test_bad_inputs(capfd, arguments, match):
    if arguments.startswith("demo"):
        pytest.importorskip("nilearn", reason="the demo's image comes in nilearn's wheel")
    assert_refused(capfd, arguments, match)


def test_existing_outputs_are_refused(capfd):
    names = ("a.nii", "b.nii", "a.json")
    for name in names:
        Path(name).write_text("old")
    assert_refused(capfd, MESH, "a.json: already exists; pass --force")
    assert_refused(capfd, "phantom sphere -o a.nii", "already exists")
    assert_refused(capfd, "phantom sphere -o new.nii --labels b.nii", "already exists")
    assert_refused(capfd, "quality lattice.vtu --json a.json", "already exists")
    assert [Path(name).read_text() for name in names] == ["old"] * 3


def test_the_systems_errors_take_one_line(monkeypatch, capfd):
    assert_refused(capfd, f"mesh disc.nii -o {'a' * 300}.vtu", "too long")

    def full_disk(*_):
        raise OSError(28, "No space left on device", "a[b].vtu")

    monkeypatch.setattr(tetopt.cli.phantom, "save_image", full_disk)
    assert_refused(
        capfd, "phantom disc_2d -o a.nii --voxel-mm 8", r"a\[b\].vtu: No space left on device"
    )


def test_the_checksum_is_of_what_was_read(monkeypatch):
    """The image may be gone, or another, when the optimisation ends."""
    expected = hashlib.sha256(Path("disc.nii").read_bytes()).hexdigest()

    @functools.wraps(optimize)
    def slow(*arguments, **options):
        Path("disc.nii").unlink()
        return optimize(*arguments, **options)

    monkeypatch.setattr(tetopt.job.mesh_stage, "_prepare", lambda _: None)
    monkeypatch.setattr(tetopt.engine.meshing, "optimize", slow)
    assert_done("mesh disc.nii -o a.vtu --nodes 30 --iterations 1")
    assert load_mesh("a.vtu").field_data["image_sha256"].tolist() == [expected]


# --------------------------------------------------------------------------------------------------
# Help and version


@pytest.mark.parametrize("width", ["80", "120"])
def test_help_names_no_value_of_a_switch_and_breaks_no_word(monkeypatch, capsys, width):
    monkeypatch.setenv("COLUMNS", width)
    for words in (("--help",), ("mesh", "--help"), ("mesh", "--help-all"), ("fem", "--help")):
        assert_done(*words)
        text = capsys.readouterr().out
        assert "bool" not in text
        assert re.search(r"--help(,--help-all)? +-h +Show this message", text)
        assert words != ("mesh", "--help-all") or {"octree", "bcc", "five-tet"} <= set(
            re.findall(r"[\w-]+", text)
        )


def groups_of_help(capsys, *words):
    """The names of the options that the help shows, by its groups."""
    assert_done(*words)
    groups = re.split(r"^╭─ (.+?) ─+╮$", capsys.readouterr().out, flags=re.M)[1:]
    pairs = zip(groups[::2], groups[1::2], strict=True)
    return {
        name: re.findall(r"^│ [ *]*(--[a-z-]+)", text, re.M)
        for name, text in pairs
        if name != "Arguments"
    }


def test_help_of_mesh_is_in_six_groups(monkeypatch, capsys):
    """Each of at most nineteen options, and the help; without `--help-all` the twenty that most
    users take.
    """
    monkeypatch.setenv("COLUMNS", "80")
    every = groups_of_help(capsys, "mesh", "--help-all")
    assert {name: len(options) for name, options in every.items()} == {
        "Options": 5,
        "Region and labels": 19,
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
    assert_done("--help")
    captured = capsys.readouterr()
    assert all(re.search(rf"\b{command}\b", captured.out) for command in COMMANDS)
    assert exit_code() == 2
    bare = capsys.readouterr()
    # the help, and no line of complaint
    assert (bare.out + bare.err).strip() == captured.out.strip()


def test_version_also_as_a_module(capsys):
    assert_done("--version")
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
def test_threads_that_cannot_be_are_refused(monkeypatch, capfd, threads):
    """numba ends with a traceback, or takes another number."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    command = ["mesh sphere.nii.gz -o a.vtu --nodes 60"]
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
def test_a_variable_of_a_library_with_a_bad_value_is_one_line(name, value, words):
    """In a process of its own, as numba and matplotlib read them once."""
    command = [sys.executable, "-m", "tetopt", "quality", "a.vtu"]
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


def test_quality_of_a_run(run, capsys):
    folder, numbers, file, image = run
    assert_done("quality", folder / "mesh.vtu", "--image sphere.nii.gz --all --json q.json")
    report = numbers_in("q.json")
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


def test_quality_of_a_mesh_elsewhere(run, capfd):
    _, _, file, _ = run
    save_mesh("far.vtu", Mesh(file.mesh.points + 1000.0, file.mesh.cells))
    command = ["quality far.vtu --image sphere.nii.gz"]
    assert_refused(capfd, command, "no voxel centre is inside the mesh")


def test_quality_of_triangles(capsys):
    image = load_image("disc.nii")
    save_mesh("a.vtu", lattice_mesh(image, nodes=60))
    assert_done("quality a.vtu --image disc.nii")
    assert re.search(r"^area, mm2 +4096.00$", capsys.readouterr().out, re.M)


# --------------------------------------------------------------------------------------------------
# phantom


@pytest.mark.parametrize("name", ["disc_2d", "two_spheres"])
def test_phantoms_with_labels(here, name, capsys):
    phantom = load_phantom(name)
    voxel = float(phantom.size_mm.max() / 16)
    assert_done(f"phantom {name} -o a.nii.gz --labels labels.nii.gz --voxel-mm {voxel!r}")
    expected, labels = phantom.image(voxel_mm=voxel), phantom.label_image(voxel_mm=voxel)
    written = nibabel.load("a.nii.gz")
    assert_array_equal(written.get_fdata().reshape(expected.shape), expected.data)
    assert_array_equal(nibabel.load("labels.nii.gz").get_fdata().reshape(labels.shape), labels.data)
    n = expected.ndim
    assert_allclose(written.affine[:n, :n], expected.affine[:n, :n], rtol=1e-6)
    captured = capsys.readouterr()
    size = " x ".join(map(str, expected.shape))
    assert captured.out.startswith(f"a.nii.gz: {name}, {size} voxels, ")
    assert captured.err == ""
    assert here() == ["a.nii.gz", "labels.nii.gz"]


# --------------------------------------------------------------------------------------------------
# Places in the world


def test_a_sphere_keeps_its_place_in_an_oblique_sheared_world():
    """Through the files: phantom -> image -> mesh -> where the cells' means say that the sphere is.

    A cell weighs its volume, or its number of voxels, times its mean over the background; it stands
    at the mean world place of the voxel centres that it holds.
    """
    Path("sphere.toml").write_text(OBLIQUE_TOML)
    assert_done("phantom sphere.toml -o a.nii.gz")
    assert_done("mesh a.nii.gz -o a.vtu --nodes 600 --iterations 4")
    image, file = load_image("a.nii.gz"), load_mesh("a.vtu")
    assert_covers(file.mesh, image)
    assert_round_trips(file.mesh.points, image)
    owner = tetopt.cell_of_voxel(image, file.mesh).ravel()
    place = image.to_world(np.indices(image.shape).reshape(3, -1).T)
    counts = np.bincount(owner, minlength=len(file.mesh.cells))
    assert_array_equal(counts, file.cell_data["n_voxels"])
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


def test_an_oblique_anisotropic_volume(data_dir):
    path = data_dir / "brain_flair_oblique_aniso.nii.gz"
    assert_done(f"mesh {path} -o a.vtu --nodes 300 --iterations 1")
    image, mesh = load_image(path), load_mesh("a.vtu").mesh
    off_axis = image.affine[:3, :3] / image.spacing
    assert np.abs(np.sort(np.abs(off_axis), axis=0)[1]).max() > 0.01  # oblique it is
    assert image.spacing.max() / image.spacing.min() > 2.0  # and anisotropic
    assert_covers(mesh, image)
    assert_round_trips(mesh.points, image)


def test_a_4d_file_needs_a_volume(data_dir, capfd):
    path = data_dir / "example4d.nii.gz"
    command = ["mesh", path, "-o a.vtu --nodes 100 --iterations 1"]
    assert_refused(capfd, command, "2 volumes; choose one")
    assert_refused(capfd, [*command, "--volume 2"], "expected a volume from 0 to 1, got 2")
    assert_done(*command, "--volume 1")
    file, image = load_mesh("a.vtu"), load_image(path, volume=1)
    assert_covers(file.mesh, image)
    total = (file.cell_data["n_voxels"] * file.cell_data["mean"]).sum()
    assert total == pytest.approx(image.data.sum(dtype=np.float64), rel=1e-9)
    other = load_image(path, volume=0).data.sum(dtype=np.float64)
    assert total != pytest.approx(other, rel=1e-6)
    assert_done(f"quality a.vtu --image {path} --volume 1")


# --------------------------------------------------------------------------------------------------
# demo


@pytest.mark.drawn
def test_demo():
    pytest.importorskip("nilearn", reason="the demo's image comes in nilearn's wheel")
    folder = Path("new/demo")
    assert_done(f"demo -o {folder} --nodes 300 --iterations 2")
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
    assert exit_code(f"demo -o {folder} --nodes 300 --iterations 2") == 2
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def test_demo_without_nilearn(monkeypatch, capfd):
    monkeypatch.setattr(tetopt.io.mni.importlib.util, "find_spec", lambda name: None)
    assert_refused(capfd, "demo -o demo", r'pip install "nilearn(>=[0-9.]+)?"')


# --------------------------------------------------------------------------------------------------
# what is allowed but hardly meant


@pytest.mark.deep
def test_a_reader_that_goes_away_loses_no_file():
    """`tetopt mesh ... | head -1`: mesh and numbers are written, and nothing complains."""
    command = f"{sys.executable} -m tetopt {MESH} --nodes 60 --iterations 1".split()
    run = subprocess.run(
        ["bash", "-c", '"$@" | true; exit "${PIPESTATUS[0]}"', "-", *command],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0
    assert "Traceback" not in run.stderr
    assert numbers_in("a.json")["quality"]["n_cells"] == len(load_mesh("a.vtu").mesh.cells)


def test_quality_of_overlapping_cells(capsys):
    mesh = lattice_mesh(load_image("sphere.nii.gz"), nodes=60)
    # Once more a few of them, and not all of the others: together they hold no more voxels than
    # there are.
    save_mesh("twice.vtu", Mesh(mesh.points, np.vstack([mesh.cells[3:], mesh.cells[4:5]])))
    assert exit_code("quality twice.vtu --image sphere.nii.gz --json q.json") == 1
    overlap = numbers_in("q.json")["fit"]["overlap"]
    assert overlap["cells"] == [1, len(mesh.cells) - 3]
    assert (
        f"cells 1 and {len(mesh.cells) - 3} both contain voxel {overlap['voxel']}"
        in capsys.readouterr().err
    )
    assert_refused(
        capsys, "segment sphere.nii.gz twice.vtu -o s.nii.gz", "twice.vtu: cells overlap: "
    )


def test_quality_with_another_image(capsys):
    assert_done(f"{MESH} --nodes 60 --iterations 0")
    other = load_phantom("two_spheres").image(voxel_mm=8.0)
    save_image("other.nii", other)
    save_image("crop.nii", Image(other.data[:-1], other.affine))
    capsys.readouterr()
    assert_done("quality a.vtu --image sphere.nii.gz")
    assert capsys.readouterr().err == ""
    assert_done("quality a.vtu --image other.nii")
    assert "a.vtu was built from a different image" in capsys.readouterr().err
    for words in ("crop.nii", "sphere.nii.gz --crop 1:,:,:"):
        assert exit_code(f"quality a.vtu --check --image {words}") == 2
        said = capsys.readouterr().err
        assert "expected the box of" in said
        assert "--check needs that image, with its crop" in said
        assert said.count("\n") == 1


@pytest.mark.parametrize("part", ["--slice k=4", "--crop 1:7,:,2:"])
def test_quality_of_a_part(part, capsys):
    """A mesh of a slice or a crop is measured against the same part: every voxel is inside."""
    assert_done(f"{MESH} --nodes 60 --iterations 1 {part}")
    capsys.readouterr()
    assert_done(f"quality a.vtu --image sphere.nii.gz {part}")
    inside, all_ = re.search(r"voxels inside +(\d+) of (\d+)", capsys.readouterr().out).groups()
    assert inside == all_


def test_folders_of_pictures_and_results_are_made_and_none_is_left_where_a_run_is_refused(capfd):
    mesh = "mesh sphere.nii.gz -o a.vtu --iterations 0 --spacing 16"
    assert_refused(capfd, f"{mesh} --figures new/deep --mask no.nii", "no.nii")
    assert_refused(capfd, "compare disc.nii -o new", "expected a volume")
    Path("file").write_text("a file")
    assert_refused(
        capfd, f"{mesh} --figures file", "expected a folder for the results, found a file"
    )
    assert_refused(capfd, f"{mesh} --figures file/a", "a: cannot create the folder for the results")
    assert_done(f"{mesh} --figures new/deep")
    names = {"slice.png", "rho.png", "energies.png", "thumbnail.png"}
    assert {each.name for each in Path("new/deep").iterdir()} == names


def test_nodes_too_few_for_limits_are_refused(capsys):
    assert exit_code(f"{MESH} --lattice octree --nodes 100 --edge-size 6") == 2
    assert (
        "100 nodes are too few for 16 x 16 x 16 voxels and these limits" in capsys.readouterr().err
    )
    assert not Path("a.vtu").exists()


def test_octree_mesh(capsys):
    """The number of nodes is met, and the terminal calls the start what it is."""
    assert_done(f"{MESH} --lattice octree --nodes 400")
    printed = capsys.readouterr()
    assert "octree of" in printed.err
    assert printed.out.split()[0] == "octree"
    loaded = load_mesh("a.vtu")
    assert len(loaded.mesh.points) == 400
    assert_done(f"{MESH} --lattice octree --nodes 400 --force --k-d 0 --iterations 1")
    n_nodes, err = len(load_mesh("a.vtu").mesh.points), capsys.readouterr().err
    assert (f"{n_nodes} nodes instead of 400" in err) == (abs(n_nodes - 400) > 4)


def test_mesh_with_limits(capfd):
    """They reach the mesh, and the numbers and a line tell them."""
    image = load_image("sphere.nii.gz")
    field = np.where(np.arange(16)[:, None, None] < 5, 13.0, 0.0) * np.ones((1, 16, 16))
    save_image("sizes.nii.gz", Image(field, image.affine))
    assert_done(f"{MESH} --nodes 500 --edge-size 30 --sizing sizes.nii.gz --gradation 0.9")
    mesh = load_mesh("a.vtu").mesh
    assert len(mesh.points) == 500
    numbers = numbers_in("a.json")
    options, met = numbers["options"], numbers["edges_over_target"]
    assert [options[name] for name in SIZES] == [None, 30.0, None, 0.9, "sizes.nii.gz"]
    sizes = Sizes(edge_size=30.0, field=Image(field, image.affine), gradation=0.9)
    assert met["mean"] == pytest.approx(edge_ratios(mesh.points, mesh.cells, sizes).mean)
    assert len(met["edges_of_bins"]) == len(met["fraction"]) + 1
    line = (
        f"ratio of edges to their target size: {met['mean']:.2f} on average; "
        f"{met['below']:.1%} are below 0.71"
    )
    assert line in capfd.readouterr().out
    assert_done(f"{MESH} --force --nodes 500 --edge-max 40")
    numbers = numbers_in("a.json")
    assert numbers["options"]["edge_max"] == 40.0
    assert "edges_over_target" not in numbers
    assert "target size" not in capfd.readouterr().out


def test_sizes_make_the_number_of_nodes():
    """Alone they say it; where only a part has a target, the rest gets its fraction of the usual
    number.
    """
    image = load_image("sphere.nii.gz")
    assert_done(f"{MESH} --iterations 6 --edge-size 14")
    needed = nodes_of_sizes(image, Sizes(edge_size=14.0))[0]
    assert numbers_in("a.json")["options"]["nodes"] == needed
    assert len(load_mesh("a.vtu").mesh.points) == needed
    field = Image(
        np.where(np.arange(16)[:, None, None] < 4, 14.0, 0.0) * np.ones((1, 16, 16)), image.affine
    )
    save_image("sizes.nii.gz", field)
    assert_done(f"{MESH} --iterations 6 --sizing sizes.nii.gz --force")
    of_part, fraction = nodes_of_sizes(image, Sizes(field=field))
    assert fraction == 0.25
    assert numbers_in("a.json")["options"]["nodes"] == round(of_part + 0.75 * 16**3 / 8)


def test_only_the_users_longest_edge_is_told_as_missed(monkeypatch, capsys):
    """Not that of cells of order 2, which a run chooses itself."""
    monkeypatch.setattr(tetopt.job.advice, "EDGE_MISS", -0.9)  # any edge is too long
    for words, is_told in (("", False), ("--edge-max 60", True)):
        assert_done(f"{MESH} --nodes 300 --iterations 1 --order 2 {words} --force")
        err = capsys.readouterr().err
        assert ("over --edge-max" in err) == is_told
        runs = re.findall(
            r"of up to 3: (\d+) of 300 nodes, including mid-edge nodes, ([\d.]+)%", err
        )
        assert len(runs) == err.count(" of up to 3: ") > 0
        for count, off in runs:
            assert float(off) == pytest.approx(abs(int(count) / 3.0 - 100.0), abs=0.06)
        assert numbers_in("a.json")["options"]["edge_max"] > 0.0


def test_target_error(capfd):
    """As many nodes as it takes, told in the numbers; the same as asking for that many. A miss
    exits 1.
    """
    assert_done(f"{MESH} --target-error 0.2")
    numbers = numbers_in("a.json")
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
    assert_done(f"{MESH} --force --nodes {nodes}")
    assert numbers_in("a.json")["mesh_sha256"] == numbers["mesh_sha256"]
    capfd.readouterr()
    assert exit_code(f"{MESH} --force --target-error 0.01 --size-min 32") == 1
    assert "of the image's variance is unexplained, more than 0.01" in capfd.readouterr().err


def test_target_error_with_the_most_nodes(capfd):
    """What the error takes is said before the run with the most nodes, which is that of as many;
    what it left, then.
    """
    x, y = np.indices((120, 100))
    save_image("sphere.nii.gz", Image(10.0 * np.sin(x / 9.0) * np.cos(y / 8.0) + x))
    assert exit_code(f"{MESH} --target-error 0.001 --nodes-max 230") == 1
    numbers, err = numbers_in("a.json"), capfd.readouterr().err
    (first, left), (last, reached) = re.findall(
        r"run \d of up to 6: (\d+) nodes leave ([\d.]+) of the variance", err
    )
    pattern = r"an error of 0.001 requires about (\d+) nodes; (more than .*? has \d+ nodes)"
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
    assert_done(f"{MESH} --force --nodes 230")
    assert numbers_in("a.json")["mesh_sha256"] == numbers["mesh_sha256"]


# --------------------------------------------------------------------------------------------------
# segment


def test_segment(capfd):
    """The labels written are the library's; Dice with the truth is printed for mesh and voxels."""
    phantom = load_phantom("sphere")
    save_image("image.nii.gz", phantom.image(voxel_mm=2.0))
    save_image("truth.nii.gz", phantom.label_image(voxel_mm=2.0))
    image = load_image("image.nii.gz")
    mesh = optimize(image, tetopt.lattice_mesh(image, nodes=400), k_D=0.5, iterations=4).mesh
    tetopt.save_mesh("mesh.vtu", mesh)
    command = "segment image.nii.gz mesh.vtu -o labels.nii.gz --classes 2 --json s.json"
    assert_done(f"{command} --truth truth.nii.gz")
    labels = load_image("labels.nii.gz")
    assert_array_equal(labels.data, segment(image, mesh, 2).data)
    assert_allclose(labels.affine, image.affine)
    numbers = numbers_in("s.json")
    overlaps = dice(labels, load_image("truth.nii.gz"))
    assert numbers["dice"]["mesh"] == {str(label): value for label, value in overlaps.items()}
    assert overlaps[1] > 0.8
    assert f"{overlaps[1]:.4f}" in capfd.readouterr().out
    assert_refused(capfd, command, "exists")


def test_segment_refuses_other_labels(capfd):
    command = "segment sphere.nii.gz lattice.vtu -o l.nii"
    other = load_phantom("sphere").label_image(voxel_mm=3.3)
    save_image("other.nii", other)
    assert_refused(capfd, f"{command} --truth other.nii", "expected labels on the image's grid")
    assert_refused(capfd, f"{command} --classes 300", "classes: 300 requested")


def test_segment_labels_must_lie_where_the_image_does(capfd):
    """Truth of the same shape but elsewhere is refused; truth is cut as the image is; a foreign
    mesh is told.
    """
    sphere = load_image("sphere.nii.gz")
    shifted = sphere.affine.copy()
    shifted[0, 3] += 3.0
    save_image("shifted.nii", Image(sphere.data > 50, shifted))
    save_image("truth.nii", Image(sphere.data > 50, sphere.affine))
    command = "segment sphere.nii.gz lattice.vtu -o l.nii"
    assert exit_code(f"{command} --truth shifted.nii") == 2
    capfd.readouterr()
    save_image("odd.nii", Image(np.where(sphere.data > 50, 1e30, 0.5), sphere.affine))
    assert_refused(capfd, f"{command} --truth odd.nii", "labels must be whole numbers")
    assert_done("mesh sphere.nii.gz --slice k=5 -o s.vtu --nodes 40 --iterations 0")
    cut = "segment sphere.nii.gz s.vtu --slice k=5 --truth truth.nii --classes 2 -o"
    assert_done(f"{cut} l.nii")
    kept = Path("truth.nii").read_bytes()
    assert exit_code(f"{cut} truth.nii --force") == 2
    assert Path("truth.nii").read_bytes() == kept


def test_an_error_of_a_million_letters_is_cut(capsys):
    show_error("a.txt, line 3: expected a label, got " + "x" * 1_000_000 + "; mend it")
    error = capsys.readouterr().err
    assert error.startswith("tetopt: a.txt, line 3: expected a label, got x")
    assert error.endswith("x; mend it\n")
    assert len(error) < 500
