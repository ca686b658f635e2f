"""The command, run as a user runs it: files in, files out, exit codes, one line for every bad
input.
"""

import functools
import hashlib
import inspect
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import nibabel
import numba
import numpy as np
import PIL.Image
import pytest
from commands import (
    assert_done,
    assert_refuses,
    exit_code,
    in_copy_of,
    numbers_in,
    refusals,
    run_command,
)
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
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
from tetopt.cli.app import COMMANDS, SHOWN_OPTIONS, help_line, loaded_command
from tetopt.cli.console import show_error, show_event
from tetopt.job.advice import order_problems, sentences, tell, unmet_requirements
from tetopt.job.events import listen_with
from tetopt.measure.judge import ERROR_RATE, Requirements
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


UNSET = (
    "spacing volume crop slice start max_seconds max_gb target_error nodes_max size_min edge_size"
)
UNSET += " edge_max gradation sizing"

here = in_copy_of("inputs")
MESH = "mesh sphere.nii.gz -o a.vtu --json a.json"


@pytest.fixture(autouse=True)
def _same_threads_afterwards():
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with small images, meshes, and one run in 3-D with all its outputs."""
    folder = tmp_path_factory.mktemp("inputs")
    assert_done(f"phantom sphere -o {folder}/sphere.nii.gz --voxel-mm 4")
    assert_done(f"phantom disc_2d -o {folder}/disc.nii --voxel-mm 2")
    save_image(f"{folder}/flat.nii", Image(np.full((5, 6, 7), 3.0)))
    mesh = lattice_mesh(load_image(f"{folder}/sphere.nii.gz"), nodes=60)
    save_mesh(f"{folder}/lattice.vtu", mesh)
    # Nearly a cell once more, and not all others: together they hold no more voxels than there are.
    again = mesh.points[mesh.cells[4]]
    points = np.vstack([mesh.points, again + 0.01 * (again.mean(axis=0) - again)])
    cells = np.vstack([mesh.cells[3:], len(mesh.points) + np.arange(4)])
    save_mesh(f"{folder}/twice.vtu", Mesh(points, cells))
    save_mesh(f"{folder}/far.vtu", Mesh(mesh.points + 1000.0, mesh.cells))
    sphere = load_image(f"{folder}/sphere.nii.gz")
    shifted = sphere.affine.copy()
    shifted[0, 3] += 3.0
    for name, values, affine in (
        ("truth", sphere.data > 50, sphere.affine),
        ("shifted", sphere.data > 50, shifted),
        ("odd", np.where(sphere.data > 50, 1e30, 0.5), sphere.affine),
    ):
        save_image(f"{folder}/{name}.nii", Image(values, affine))
    (folder / "a_file").write_text("a file")
    run = f"mesh {folder}/sphere.nii.gz -o {folder}/run.vtu --json {folder}/run.json"
    assert_done(f"{run} --nodes 150 --iterations 3 --k-d 0.3 --method paper --n-t 1")
    return folder


def assert_covers(mesh, image):
    """The mesh fills the image's box; places in the world are those of voxels within 1e-6 mm."""
    assert tetopt.check_mesh(mesh, image) == []
    assert mesh.cell_volumes.sum() == pytest.approx(image.volume, rel=1e-9)
    assert_allclose(image.to_world(image.to_index(mesh.points)), mesh.points, rtol=0, atol=1e-6)


# --------------------------------------------------------------------------------------------------
# mesh


def test_numbers_and_file_of_a_run():
    numbers, file, image = (
        numbers_in("run.json"),
        load_mesh("run.vtu"),
        load_image("sphere.nii.gz"),
    )
    assert_covers(file.mesh, image)
    assert abs(len(file.mesh.points) - 150) <= 5
    assert numbers["energies"]["E_D_relative"] < 0.5  # the sphere is found
    checksum = hashlib.sha256(Path("sphere.nii.gz").read_bytes()).hexdigest()
    assert (numbers["image"], numbers["image_sha256"]) == ("sphere.nii.gz", checksum)
    given = {"method": "paper", "n_t": 1, "nodes": 150, "k_D": 0.3, "iterations": 3}
    defaults = {"retessellate": "first", "lattice": "bcc", "boundary": "slide"} | dict.fromkeys(
        UNSET.split()
    )
    assert numbers["options"].items() >= (given | defaults).items()
    assert numbers["versions"]["tetopt"] == tetopt.__version__
    assert numbers["versions"]["numba"] == numba.__version__
    assert numbers["machine"]["threads"] == numba.get_num_threads()
    assert (numbers["ended"], numbers["iterations_done"]) == ("iterations", 3)
    rows = [(row["iteration"], row["n_voxels"]) for row in numbers["history"]]
    assert rows == [(k, 16**3) for k in range(4)]
    E = [row["E"] for row in numbers["history"]]
    assert E[0] == 1.0
    assert E[2] >= E[3] == numbers["energies"]["E"]  # the connectivity is fixed from 2 on
    assert numbers["mesh_sha256"] == mesh_hash(file.mesh)
    measured = quality(file.mesh.points, file.mesh.cells)
    assert numbers["quality"]["n_nodes"] == len(file.mesh.points)
    assert numbers["quality"]["errors"] == measured.errors._asdict()
    assert numbers["quality"]["min_dihedral"] == measured.min_dihedral
    assert set(numbers["seconds"]) == {"load", "optimize", "all"}
    assert numbers["seconds"]["all"] >= numbers["seconds"]["optimize"] > 0.0
    fields, moments = file.cell_data, tetopt.cell_moments(image, file.mesh)
    names = "mean variance n_voxels min max volume rho min_dihedral"
    assert list(fields) == names.split()
    assert_array_equal(fields["n_voxels"], moments.n_voxels)
    assert_array_equal(fields["mean"], moments.mean)
    assert fields["n_voxels"] @ fields["mean"] == pytest.approx(image.data.sum(), rel=1e-12)
    assert_array_equal(fields["volume"], file.mesh.cell_volumes)
    texts = {name: values[0] for name, values in file.field_data.items()}
    assert texts["tetopt"] == tetopt.__version__
    assert (texts["image"], texts["image_sha256"]) == ("sphere.nii.gz", checksum)
    assert json.loads(texts["options"]) == numbers["options"]


def test_mesh_in_2d(here):
    assert_done("mesh disc.nii -o disc.vtu --nodes 80 --iterations 4")
    image, file = load_image("disc.nii"), load_mesh("disc.vtu")
    assert_covers(file.mesh, image)
    assert file.cell_data["n_voxels"].sum() == image.data.size
    # The disc of 20 mm, of intensity 100 on 20: what the cells hold of it lies in its place, (0,
    # 0).
    area = file.cell_data["volume"] @ (file.cell_data["mean"] - 20.0) / 80.0
    assert area == pytest.approx(np.pi * 20.0**2, rel=0.05)
    assert here() == ["disc.vtu"]
    area = run_command("quality disc.vtu --image disc.nii").out
    assert re.search(r"^area, mm2 +4096.00$", area, re.M)


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


def test_the_table_shows_before_and_after_and_lines_the_progress():
    said, numbers = run_command(f"{MESH} --nodes 150 --iterations 3"), numbers_in("a.json")
    lines = said.out.splitlines()
    assert lines[0].split() == ["octree", "optimised"]
    table = dict(re.findall(r"^(.+?)\s{2,}(.*\S)", said.out, re.M))
    for row, of, key, digits in (
        ("E_D, fraction of the image's variance", "energies", "E_D_fraction_of_variance", 5),
        ("rho, mean", "quality", "mean_rho", 4),
        ("smallest angle, degrees", "quality", "min_dihedral", 2),
    ):
        before, after = (
            [numbers[of][f"{key}_initial"], numbers[of][key]]
            if of == "energies"
            else [numbers[f"{of}_initial"][key], numbers[of][key]]
        )
        assert before != after
        assert table[row].split() == [f"{before:.{digits}f}", f"{after:.{digits}f}"]
    nodes, cells = numbers["quality"]["n_nodes"], numbers["quality"]["n_cells"]
    assert lines[-2:] == [
        "a.json: every number of the run",
        f"all requirements are met; a.vtu: {nodes} nodes, {cells} cells",
    ]
    first, *lines = said.err.splitlines()
    words = (
        "16 x 16 x 16 voxels of 4 x 4 x 4 mm; octree of 148 nodes, 576 cells, edges up to 26.7 mm"
    )
    assert re.fullmatch(rf"sphere.nii.gz: {words}; about \d\.\d+ GB of memory", first)
    history = numbers["history"]
    progress = [line for line in lines if line.startswith("iteration")]
    for k, (line, row) in enumerate(zip(progress, history, strict=True)):
        E_D = row["E_D"] / history[0]["E_D"]
        assert line.startswith(f"iteration   {k}/3  E {row['E']:.4f}  E_G ")
        assert f"  E_D {E_D:.4f}  {row['n_cells']} cells  " in line
    assert "\x1b" not in said.err  # no colours, no cursor movements


def test_a_constant_image_warns_and_works():
    said = run_command("mesh flat.nii -o a.vtu --json a.json --nodes 50 --iterations 2")
    warning = "tetopt: warning: flat.nii: the image is 3 everywhere, so E_D is 0 everywhere"
    assert said.err.splitlines()[0] == warning
    assert said.err.count("warning") == 1
    assert "E_D" not in said.out
    assert numbers_in("a.json")["energies"]["E_D_relative"] is None
    with pytest.warns(UserWarning, match="everywhere"):
        assert_covers(load_mesh("a.vtu").mesh, load_image("flat.nii"))


def test_a_name_with_markup_and_letters():
    """Rich would take [red] for a colour and :cat: for a picture."""
    folder = Path("Schädel [red] :cat:")
    folder.mkdir()
    shutil.copy("disc.nii", folder / "ä[1].nii")
    mesh = folder / "a[b].vtu"
    said = run_command("mesh", folder / "ä[1].nii", "-o", mesh, "--nodes 30 --iterations 1")
    assert said.err.startswith(f"{folder / 'ä[1].nii'}: 32 x 32 voxels")
    assert f"{mesh}: " in said.out
    assert load_mesh(mesh).field_data["image"].tolist() == ["ä[1].nii"]
    assert run_command("quality", mesh).out.splitlines()[0].strip() == "a[b].vtu"


@pytest.mark.skipif(
    numba.config.NUMBA_NUM_THREADS < 2, reason="one core: there are no two thread counts to compare"
)
def test_the_same_bits_for_any_number_of_threads():
    for threads in (1, 2):
        command = f"mesh sphere.nii.gz -o {threads}.vtu --json {threads}.json --nodes 400"
        assert_done(f"{command} --iterations 3 --threads {threads}")
        assert numbers_in(f"{threads}.json")["machine"]["threads"] == threads
    assert Path("1.vtu").read_bytes() == Path("2.vtu").read_bytes()


def test_max_seconds_leaves_a_valid_mesh():
    said = run_command(f"{MESH} --nodes 400 --iterations 1000 --max-seconds 1e-6").err
    assert "out of time: the current mesh is kept" in said
    numbers, mesh = numbers_in("a.json"), load_mesh("a.vtu").mesh
    assert (numbers["ended"], numbers["options"]["max_seconds"]) == ("max_seconds", 1e-6)
    assert numbers["iterations_done"] < 1000
    assert_covers(mesh, load_image("sphere.nii.gz"))
    assert numbers["mesh_sha256"] == mesh_hash(mesh)


def test_what_is_violated_is_told_in_the_commands_options(capsys):
    violated = {
        "min_dihedral": "2 of 9 cells; allow a lower `k_D`, or a lower `min_dihedral`",
        "box": "k_D.nii lies beyond",
    }
    with listen_with(show_event):
        problems = order_problems(unmet_requirements(violated, {}, Requirements()))
        assert sentences(problems) == violated
        tell(problems)
    assert capsys.readouterr().err == (
        "tetopt: requirement violated: min_dihedral: 2 of 9 cells; allow a lower --k-d, or a "
        "lower --min-dihedral\n"
        "tetopt: requirement violated: box: k_D.nii lies beyond\n"
    )


# --------------------------------------------------------------------------------------------------
# Ctrl-C


@pytest.mark.deep
@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to one process")
def test_a_second_ctrl_c_gives_up(here, monkeypatch):
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
    said = run_command("mesh disc.nii -o a.vtu", code=130).err
    assert signal.getsignal(signal.SIGINT) is before
    assert said.splitlines()[-3:] == [
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


test_refused = refusals(
    r"""
mesh sphere.nii.gz -o a.vtu --nodes 6
    9 or more in 3-D, got 6
mesh sphere.nii.gz -o a.vtu --uniform --nodes 6
    expected 9 to 50000000 nodes
mesh sphere.nii.gz -o a.vtu --nodes 1000000000
    --nodes: expected a whole number from 5 to 50000000, got 1000000000
mesh sphere.nii.gz -o a.vtu --nodes 1e9
    --nodes: expected a whole number from 5 to 50000000, got 1000000000
mesh sphere.nii.gz -o a.vtu --nodes many
    --nodes: expected a whole number, got 'many'
mesh sphere.nii.gz -o a.vtu --nodes -5
    --nodes: expected a whole number from 5 to 50000000, got -5
mesh sphere.nii.gz -o a.vtu --spacing 0
    --spacing: expected a length above 0 mm
mesh sphere.nii.gz -o a.vtu --k-d 1
    --k-d: expected 0 <= k_D < 1, got 1.0
mesh sphere.nii.gz -o a.vtu --k-d abc
    --k-d: expected a number, got 'abc'
mesh sphere.nii.gz -o a.vtu --iterations -1
    --iterations: expected 0 or more, got -1
mesh sphere.nii.gz -o a.vtu --threads 10000
    --threads: expected 1 to .* got 10000
mesh sphere.nii.gz -o a.vtu --max-seconds 0
    --max-seconds: expected more than 0
mesh sphere.nii.gz -o a.vtu --lattice criss-cross
    expected one of bcc, five-tet in 3-D
mesh sphere.nii.gz -o a.vtu --method fast --n-t 2
    --n-t: only with --method paper
mesh sphere.nii.gz -o a.vtu --method paper --shape-power 3
    --shape-power: only with --method fast
mesh sphere.nii.gz -o a.vtu --min-dihedral 80
    --min-dihedral: expected 0 to below 70
mesh sphere.nii.gz -o a.vtu --shape-power 0.5
    --shape-power: expected 1
mesh sphere.nii.gz -o a.vtu --retessellate always
    --retessellate
mesh sphere.nii.gz -o a.vtu --slice z
    slice: expected .* got "z"
mesh sphere.nii.gz -o a.vtu --slice k=99
    slice: expected an index from 0 to 15 along axis 2, got 99
mesh sphere.nii.gz -o a.vtu --crop 0:100:5
    crop: expected .* got "0:100:5"
mesh sphere.nii.gz -o a.vtu --crop 0:99,:,:
    crop
mesh sphere.nii.gz -o a.vtu --volume 1
    got 1: the file has one volume
mesh sphere.nii.gz -o a.vtu --json no/such/run.json
    folder does not exist
mesh sphere.nii.gz -o a.vtu --json run.txt
    ending in .json
mesh sphere.nii.gz -o a.vtu --unknown
    No such option: --unknown
mesh sphere.nii.gz -o a.vtu --lattice octree --method paper
    only with --method fast
mesh sphere.nii.gz -o a.vtu --lattice octree --spacing 3
    no single spacing
mesh sphere.nii.gz -o a.vtu --lattice octree --nodes 900000
    too many for 16 x 16 x 16 voxels; use at most 5000
mesh sphere.nii.gz -o a.vtu --lattice octree --target-error 1.5
    expected a fraction of the image's variance, 0 to 1, got 1.5
mesh sphere.nii.gz -o a.vtu --lattice octree --edge-size 0.2
    sizes: the requested edges are so short that cells are smaller
mesh sphere.nii.gz -o a.vtu --lattice octree --size-min 9 --edge-max 8
    --edge-max: 8 mm is below the smallest size, 9 mm
mesh sphere.nii.gz -o a.vtu --lattice octree --edge-size -1
    --edge-size: expected a length above 0
mesh sphere.nii.gz -o a.vtu --lattice octree --gradation 3
    gradation: expected 0.05 (gentle) to 1, got 3
mesh sphere.nii.gz -o a.vtu --uniform --target-error 0.1
    --target-error: needs a graded mesh
mesh sphere.nii.gz -o a.vtu --spacing 8 --edge-size 9
    --edge-size: needs a graded mesh
mesh sphere.nii.gz -o a.vtu --method paper --edge-max 9
    --edge-max: needs a graded mesh
mesh sphere.nii.gz -o a.vtu --nodes-max 300
    --nodes-max: needs --target-error
mesh sphere.nii.gz -o a.vtu --nodes-max 300 --nodes 200
    --nodes-max: needs --target-error
mesh sphere.nii.gz -o a.vtu --nodes-max 300 --spacing 9
    --nodes-max: needs --target-error
mesh sphere.nii.gz -o a.vtu --nodes-max 4 --target-error 0.2
    --nodes-max: expected 5 or more, got 4
mesh sphere.nii.gz -o a.vtu --nodes-max 8 --target-error 0.2
    --nodes-max: expected a whole number, 9 or more in 3-D, got 8
mesh sphere.nii.gz -o a.vtu --nodes-max 60 --target-error 0.2 --edge-max 9
    --nodes-max: sizes require about
mesh sphere.nii.gz -o a.vtu second.nii
    second.nii
mesh no.nii -o a.vtu
    no.nii: no such file
mesh disc.nii -o a.vtu --lattice bcc
    expected one of criss-cross in 2-D
mesh disc.nii -o a.vtu --slice k=3
    slice
mesh disc.nii -o a.vtu --crop 1:5,1:5,1:5
    crop
mesh disc.nii -o a.obj
    unknown suffix; known suffixes are .vtu
mesh disc.nii
    --output
mesh -o a.vtu
    Missing argument 'IMAGE\.\.\.'
mesh lattice.vtu -o a.vtu
    unknown image format
quality no.vtu
    no such file
quality disc.nii
    expected a .vtu, .* or .xdmf mesh
quality lattice.vtu --image no.nii
    no such file
quality lattice.vtu --image disc.nii
    a 3-D image like the mesh, got a 2-D one
quality
    Missing argument '\[IMAGE\] MESH'
phantom nothing -o a.nii
    phantom 'nothing': no such phantom; use one of constant
phantom no.toml -o a.nii
    no.toml
phantom sphere -o a.png
    ending in .nii or .nii.gz
phantom sphere -o a.nii --labels ./a.nii
    or another output
phantom sphere -o a.nii --voxel-mm 0
    --voxel-mm:
phantom sphere -o a.nii --noise-sd -1
    --noise-sd:
phantom sphere -o a.nii --seed x
    --seed
refine
    No such command 'refine'
mesh sphere.nii.gz -o a.vtu --figures new/deep --mask no.nii
    no.nii
mesh sphere.nii.gz -o a.vtu --figures a_file
    expected a folder for the results, found a file
mesh sphere.nii.gz -o a.vtu --figures a_file/a
    a: cannot create the folder for the results
compare disc.nii -o new
    expected a volume
mesh sphere.nii.gz -o a.vtu --json run.json
    run.json: already exists; pass --force
phantom sphere -o odd.nii
    already exists
phantom sphere -o new.nii --labels odd.nii
    already exists
quality lattice.vtu --json run.json
    already exists
segment sphere.nii.gz lattice.vtu -o odd.nii
    exists
quality far.vtu --image sphere.nii.gz
    lies outside the image
segment sphere.nii.gz lattice.vtu -o l.nii --truth shifted.nii
    expected labels on the image's grid
segment sphere.nii.gz lattice.vtu -o l.nii --truth disc.nii
    disc.nii
segment sphere.nii.gz lattice.vtu -o l.nii --classes 300
    classes: 300 requested
segment sphere.nii.gz lattice.vtu -o l.nii --truth odd.nii
    labels must be whole numbers
"""
)


def test_demo_needs_nilearn_and_a_folder(monkeypatch):
    pytest.importorskip("nilearn", reason="the demo's image comes in nilearn's wheel")
    assert_refuses("demo -o disc.nii", "expected a folder")
    monkeypatch.setattr(tetopt.io.mni.importlib.util, "find_spec", lambda name: None)
    assert_refuses("demo -o demo", r'pip install "nilearn(>=[0-9.]+)?"')


def test_the_systems_errors_take_one_line(monkeypatch):
    assert_refuses(f"mesh disc.nii -o {'a' * 300}.vtu", "too long")

    def full_disk(*_):
        raise OSError(28, "No space left on device", "a[b].vtu")

    monkeypatch.setattr(tetopt.cli.phantom, "save_image", full_disk)
    assert_refuses("phantom disc_2d -o a.nii --voxel-mm 8", r"a\[b\].vtu: No space left on device")


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
@pytest.mark.parametrize("words", ["--help", "mesh --help", "mesh --help-all", "fem --help-all"])
def test_help_names_no_value_of_a_switch_and_breaks_no_word(monkeypatch, words, width):
    monkeypatch.setenv("COLUMNS", width)
    text = run_command(words).out
    assert "bool" not in text
    assert re.search(r"--help(,--help-all)? +-h +Show this message", text)
    assert words != "mesh --help-all" or {"octree", "bcc", "five-tet"} <= set(
        re.findall(r"[\w-]+", text)
    )


def groups_of_help(words):
    """The names of the options that the help shows, by its groups."""
    groups = re.split(r"^╭─ (.+?) ─+╮$", run_command(words).out, flags=re.M)[1:]
    return {
        name: re.findall(r"^│ [ *]*(--[a-z-]+)", text, re.M)
        for name, text in zip(groups[::2], groups[1::2], strict=True)
        if name != "Arguments"
    }


def test_help_of_mesh_has_the_options_that_most_users_take(monkeypatch):
    """In groups of at most nineteen, with the others by `--help-all`."""
    monkeypatch.setenv("COLUMNS", "80")
    every, shown = (groups_of_help(f"mesh {word}") for word in ("--help-all", "--help"))
    assert max(map(len, every.values())) <= 19
    assert sum(map(len, shown.values())) == 22 + 1
    assert all(
        set(options) < set(every[name]) or name == "Options" for name, options in shown.items()
    )
    assert {"--output", "--mask", "--nodes", "--young", "--load"} <= set().union(*shown.values())
    # has no shorter one
    assert groups_of_help("cohort --help-all")["Optimisation"] == every["Optimisation"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_no_command_has_more_than_a_page_of_options(monkeypatch, command):
    """Each of many options shows those that most users take, each of which there is."""
    monkeypatch.setenv("COLUMNS", "80")
    groups = groups_of_help(f"{command} --help").values()
    assert sum(map(len, groups)) <= 26 + 1
    known = inspect.signature(loaded_command(command)).parameters
    assert set(SHOWN_OPTIONS.get(command, ())) <= set(known)
    if len(known) > 26:
        every = groups_of_help(f"{command} --help-all").values()
        assert sum(map(len, every)) >= len(known) - 2


@pytest.mark.parametrize("more", ["", "--target-error 0.2", "--edge-size 5"])
def test_a_dry_run_meshes_and_writes_nothing(here, more):
    words = f"mesh disc.nii -o d.vtu --json d.json --figures f --k-d 0.3 {more} --dry-run"
    said = run_command(words).out
    lines = dict(line.split(": ", 1) for line in said.replace("\n  ", " ").splitlines())
    assert here() == []
    assert "disc.nii" in lines["reads"]
    assert all(name in lines["writes"] for name in ("d.vtu", "d.json", "slice.png"))
    assert re.search(r"\d", lines["nodes"])
    assert re.search(r"\d [MG]B", lines["memory"])
    assert "k_D 0.3" in lines["options"]
    assert lines["options"].count("0.3") == 1
    assert "unknown" in lines["time"]
    assert_refuses(f"{words} --nodes -1", "nodes")


def test_help_lists_the_commands():
    text = run_command("--help").out
    assert all(re.search(rf"\b{command}\b", text) for command in COMMANDS)
    # the help, and no line of complaint
    assert "".join(run_command(code=2)).strip() == text.strip()
    for name in COMMANDS:
        assert loaded_command(name).__doc__.splitlines()[0] == help_line(name)


def run_python(*words, **names):
    """A program in a process of its own, with variables of the environment."""
    return subprocess.run(
        [sys.executable, *words],
        env=os.environ | {"PYTHONPATH": str(Path(tetopt.__file__).parents[1])} | names,
        capture_output=True,
        text=True,
        check=False,
    )


def test_version_also_as_a_module():
    done = run_python("-m", "tetopt", "--version")
    assert run_command("--version") == (done.stdout, done.stderr)
    assert done.stdout == f"tetopt {tetopt.__version__}\n"


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
        (
            "import numpy; from tetopt.contents import padding; "
            "print(padding.replace_padding(numpy.zeros((4, 4, 4))))",
            "",
        ),
    ],
)
def test_nothing_is_loaded_before_it_is_used(code, needed):
    loaded = f"print(*(name for name in {HEAVY!r}.split() if name in sys.modules))"
    assert run_python("-c", f"{code}; import sys; {loaded}").stdout.splitlines()[-1] == needed


@pytest.mark.parametrize("threads", ["0", "1.5", "9" * 5000])
def test_threads_that_cannot_be_are_refused(monkeypatch, threads):
    """numba ends with a traceback, or takes another number."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    assert_refuses(
        MESH, "NUMBA_NUM_THREADS: expected a whole number of threads from 1 to 9999, got"
    )


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("NUMBA_THREADING_LAYER", "NUMBA_THREADING_LAYER: expected .*workqueue.*, got foo"),
        (
            "NUMBA_THREADING_LAYER_PRIORITY",
            "NUMBA_THREADING_LAYER_PRIORITY: expected omp tbb workqueue",
        ),
        ("NUMBA_OPT", "environment: .*'NUMBA_OPT'.*'foo' could not be parsed; check NUMBA_OPT"),
        ("MPLBACKEND", "environment: .*'foo' is not a valid value for backend; check MPLBACKEND"),
    ],
)
def test_a_variable_of_a_library_with_a_bad_value_is_one_line(name, words):
    """In a process of its own, as numba and matplotlib read them once."""
    ended = run_python("-m", "tetopt", "quality", "a.vtu", **{name: "foo"})
    assert ended.returncode == 2
    assert re.fullmatch(f"tetopt: {words}.*\n", ended.stderr), ended.stderr


def test_every_public_name_is_there():
    for name in dir(tetopt):
        assert getattr(tetopt, name) is not None
    with pytest.raises(AttributeError, match="octre"):
        tetopt.octre  # noqa: B018


# --------------------------------------------------------------------------------------------------
# quality


def test_quality_of_a_run():
    said = run_command("quality run.vtu --image sphere.nii.gz --all --json q.json")
    numbers, report = numbers_in("run.json"), numbers_in("q.json")
    assert report["quality"] == numbers["quality"]
    assert report["n_turned"] == 0
    n = load_image("sphere.nii.gz").data.size
    assert (
        report["fit"].items()
        >= {
            "E_D": pytest.approx(numbers["history"][-1]["E_D"], rel=1e-6),
            "E_D_fraction_of_variance": pytest.approx(
                numbers["energies"]["E_D_fraction_of_variance"], rel=1e-6
            ),
            "n_voxels": n,
            "n_empty_cells": (load_mesh("run.vtu").cell_data["n_voxels"] == 0).sum(),
        }.items()
    )
    assert said.err == ""
    assert re.search(rf"^voxels inside +{n} of {n}$", said.out, re.M)
    assert re.search(rf"^nodes +{numbers['quality']['n_nodes']}$", said.out, re.M)


# --------------------------------------------------------------------------------------------------
# phantom


@pytest.mark.parametrize("name", ["disc_2d", "two_spheres"])
def test_phantoms_with_labels(here, name):
    phantom = load_phantom(name)
    voxel = float(phantom.size_mm.max() / 16)
    said = run_command(f"phantom {name} -o a.nii.gz --labels labels.nii.gz --voxel-mm {voxel!r}")
    for path, image in (
        ("a.nii.gz", phantom.image(voxel_mm=voxel)),
        ("labels.nii.gz", phantom.label_image(voxel_mm=voxel)),
    ):
        written, n = nibabel.load(path), image.ndim
        assert_array_equal(written.get_fdata().reshape(image.shape), image.data)
        assert_allclose(written.affine[:n, :n], image.affine[:n, :n], rtol=1e-6)
    assert said.out.startswith(f"a.nii.gz: {name}, {' x '.join(map(str, image.shape))} voxels, ")
    assert said.err == ""
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
    owner = tetopt.cell_of_voxel(image, file.mesh).ravel()
    place = image.to_world(np.indices(image.shape).reshape(3, -1).T)
    counts = np.bincount(owner, minlength=len(file.mesh.cells))
    assert_array_equal(counts, file.cell_data["n_voxels"])
    sums = np.stack([np.bincount(owner, x, minlength=len(counts)) for x in place.T], axis=1)
    is_held = counts > 0
    centroids = image.to_index(sums[is_held] / counts[is_held, None])
    true = image.to_index([14.3, -10.1, 28.7])
    contrast = file.cell_data["mean"] - 20.0
    for name, allowed in (("volume", 0.05), ("n_voxels", 0.02)):  # voxels
        weights = (file.cell_data[name] * contrast)[is_held]
        assert np.linalg.norm(weights @ centroids / weights.sum() - true) < allowed
    expected = 80.0 * 4 / 3 * np.pi * 9.0**3
    assert file.cell_data["volume"] @ contrast == pytest.approx(expected, rel=0.02)


def test_a_volume_of_a_4d_file(data_dir):
    path = data_dir / "example4d.nii.gz"
    command = f"mesh {path} -o a.vtu --nodes 100 --iterations 1"
    assert_refuses(command, "2 volumes; choose one")
    assert_refuses(f"{command} --volume 2", "expected a volume from 0 to 1, got 2")
    assert_done(f"{command} --volume 1")
    fields, sums = (
        load_mesh("a.vtu").cell_data,
        [load_image(path, volume=k).data.sum(dtype=np.float64) for k in (0, 1)],
    )
    assert fields["n_voxels"] @ fields["mean"] == pytest.approx(sums[1], rel=1e-9)
    assert sums[0] != pytest.approx(sums[1], rel=1e-6)
    assert_done(f"quality a.vtu --image {path} --volume 1")


# --------------------------------------------------------------------------------------------------
# demo


@pytest.mark.drawn
def test_demo():
    pytest.importorskip("nilearn", reason="the demo's image comes in nilearn's wheel")
    command, folder = "demo -o new/demo --nodes 300 --iterations 2", Path("new/demo")
    assert_done(command)
    pictures = {"slice.png", "rho.png", "energies.png", "thumbnail.png"}
    assert {path.name for path in folder.iterdir()} == pictures | {"mesh.vtu", "run.json"}
    for name in pictures:
        with PIL.Image.open(folder / name) as picture:
            assert np.asarray(picture.convert("L")).std() > 10.0
    numbers, file = numbers_in(folder / "run.json"), load_mesh(folder / "mesh.vtu")
    assert numbers["mesh_sha256"] == mesh_hash(file.mesh)
    assert numbers["energies"]["E_D_relative"] < 0.8
    image = numbers["image_properties"]
    assert file.cell_data["n_voxels"].sum() == np.prod(image["shape"])
    assert file.cell_data["volume"].sum() == pytest.approx(image["volume_mm"], rel=1e-9)
    assert_refuses(command, "new/demo")


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


def test_segments_of_overlapping_cells():
    said = run_command("segment sphere.nii.gz twice.vtu -o s.nii.gz", code=2).err
    assert "tetopt: twice.vtu: cells overlap:" in said
    assert not Path("s.nii.gz").exists()


def test_quality_of_overlapping_cells():
    said = run_command("quality twice.vtu --image sphere.nii.gz --json q.json", code=1).err
    overlap, last = numbers_in("q.json")["fit"]["overlap"], len(load_mesh("twice.vtu").mesh.cells)
    assert overlap["cells"] == [1, last - 1]
    assert f"cells 1 and {last - 1} both contain voxel {overlap['voxel']}" in said


def test_quality_with_another_image():
    other = load_phantom("two_spheres").image(voxel_mm=8.0)
    save_image("other.nii", other)
    save_image("crop.nii", Image(other.data[:-1], other.affine))
    assert run_command("quality run.vtu --image sphere.nii.gz").err == ""
    said = run_command("quality run.vtu --image other.nii").err
    assert "run.vtu was built from a different image" in said
    for words in ("crop.nii", "sphere.nii.gz --crop 1:,:,:"):
        assert_refuses(
            f"quality run.vtu --check --image {words}",
            "expected the box of.*--check needs that image, with its crop",
        )


@pytest.mark.parametrize("part", ["--slice k=4", "--crop 1:7,:,2:"])
def test_quality_of_a_part(part):
    """A mesh of a slice or a crop is measured against the same part: every voxel is inside."""
    assert_done(f"{MESH} --nodes 60 --iterations 1 {part}")
    said = run_command(f"quality a.vtu --image sphere.nii.gz {part}").out
    inside, every = re.search(r"voxels inside +(\d+) of (\d+)", said).groups()
    assert inside == every


def test_folders_of_pictures_are_made():
    assert_done("mesh sphere.nii.gz -o a.vtu --iterations 0 --spacing 16 --figures new/deep")
    names = {"slice.png", "rho.png", "energies.png", "thumbnail.png"}
    assert {each.name for each in Path("new/deep").iterdir()} == names


def test_octree_mesh():
    """The number of nodes is met, and the terminal calls the start what it is."""
    said = run_command(f"{MESH} --lattice octree --nodes 400")
    assert "octree of" in said.err
    assert said.out.split()[0] == "octree"
    assert len(load_mesh("a.vtu").mesh.points) == 400
    said = run_command(f"{MESH} --lattice octree --nodes 400 --force --k-d 0 --iterations 1").err
    n_nodes = len(load_mesh("a.vtu").mesh.points)
    assert (f"{n_nodes} nodes instead of 400" in said) == (abs(n_nodes - 400) > 4)
    said = run_command("mesh sphere.nii.gz -o b.vtu --nodes 100 --edge-size 6", code=2).err
    assert "100 nodes are too few for 16 x 16 x 16 voxels and these limits" in said


def sizes_to(x, size):
    """The sphere's image with a target size up to an index along the first axis."""
    field = np.zeros((16, 16, 16))
    field[:x] = size
    return Image(field, load_image("sphere.nii.gz").affine)


def test_mesh_with_limits():
    """They reach the mesh, and the numbers and a line tell them."""
    field = sizes_to(5, 13.0)
    save_image("sizes.nii.gz", field)
    said = run_command(
        f"{MESH} --nodes 500 --edge-size 30 --sizing sizes.nii.gz --gradation 0.9"
    ).out
    mesh, numbers = load_mesh("a.vtu").mesh, numbers_in("a.json")
    assert len(mesh.points) == 500
    limits = {"edge_size": 30.0, "gradation": 0.9, "sizing": "sizes.nii.gz"}
    limits |= {"size_min": None, "edge_max": None}
    assert numbers["options"].items() >= limits.items()
    met, sizes = numbers["edges_over_target"], Sizes(edge_size=30.0, field=field, gradation=0.9)
    assert met["mean"] == pytest.approx(edge_ratios(mesh.points, mesh.cells, sizes).mean)
    assert len(met["edges_of_bins"]) == len(met["fraction"]) + 1
    line = f"{met['mean']:.2f} on average; {met['below']:.1%} are below 0.71"
    assert f"ratio of edges to their target size: {line}" in said
    said = run_command(f"{MESH} --force --nodes 500 --edge-max 40").out
    numbers = numbers_in("a.json")
    assert numbers["options"]["edge_max"] == 40.0
    assert "edges_over_target" not in numbers
    assert "target size" not in said


def test_sizes_make_the_number_of_nodes():
    """Alone they say it; where only a part has a target, the rest gets its fraction of the usual
    number.
    """
    image, field = load_image("sphere.nii.gz"), sizes_to(4, 14.0)
    assert_done(f"{MESH} --iterations 6 --edge-size 14")
    needed = nodes_of_sizes(image, Sizes(edge_size=14.0))[0]
    assert numbers_in("a.json")["options"]["nodes"] == needed
    assert len(load_mesh("a.vtu").mesh.points) == needed
    save_image("sizes.nii.gz", field)
    assert_done(f"{MESH} --iterations 6 --sizing sizes.nii.gz --force")
    of_part, fraction = nodes_of_sizes(image, Sizes(field=field))
    assert fraction == 0.25
    assert numbers_in("a.json")["options"]["nodes"] == round(of_part + 0.75 * 16**3 / 8)


def test_only_the_users_longest_edge_is_told_as_missed(monkeypatch):
    """Not that of cells of order 2, which a run chooses itself."""
    monkeypatch.setattr(tetopt.job.advice, "EDGE_MISS", -0.9)  # any edge is too long
    for words, is_told in (("", False), ("--edge-max 60", True)):
        err = run_command(f"{MESH} --nodes 300 --iterations 1 --order 2 {words} --force").err
        assert ("over --edge-max" in err) == is_told
        runs = re.findall(
            r"of up to 3: (\d+) of 300 nodes, including mid-edge nodes, ([\d.]+)%", err
        )
        assert len(runs) == err.count(" of up to 3: ") > 0
        for count, off in runs:
            assert float(off) == pytest.approx(abs(int(count) / 3.0 - 100.0), abs=0.06)
        assert numbers_in("a.json")["options"]["edge_max"] > 0.0


RUNS = r"run \d of up to 6: (\d+) nodes leave ([\d.]+) of the variance"


def test_target_error():
    """As many nodes as it takes, told in the numbers; the same as asking for that many. A miss
    exits 1.
    """
    said, numbers = run_command(f"{MESH} --target-error 0.2").err, numbers_in("a.json")
    assert re.findall(r"run (\d)", said) == [str(k + 1) for k in range(len(re.findall(RUNS, said)))]
    error, options = numbers["energies"]["E_D_fraction_of_variance"], numbers["options"]
    assert float(re.findall(RUNS, said)[-1][1]) == pytest.approx(error, rel=1e-3)
    assert error <= 0.2 == options["target_error"]
    assert_done(f"{MESH} --force --nodes {options['nodes']}")
    assert numbers_in("a.json")["mesh_sha256"] == numbers["mesh_sha256"]
    said = run_command(f"{MESH} --force --target-error 0.01 --size-min 32", code=1).err
    assert "of the image's variance is unexplained, more than 0.01" in said


def test_target_error_with_the_most_nodes():
    """What the error takes is said before the run with the most nodes, which is that of as many;
    what it left, then.
    """
    x, y = np.indices((120, 100))
    save_image("sphere.nii.gz", Image(10.0 * np.sin(x / 9.0) * np.cos(y / 8.0) + x))
    err = run_command(f"{MESH} --target-error 0.001 --nodes-max 230", code=1).err
    (first, left), (last, reached) = re.findall(RUNS, err)
    assert (first, last) == ("200", "230")
    words = "more than --nodes-max, so that the next run has 230 nodes"
    (predicted,) = re.findall(rf"an error of 0.001 requires about (\d+) nodes; {words}", err)
    needed = 200.0 * (float(left) / (0.925 * 0.001)) ** (1.0 / ERROR_RATE)
    assert int(predicted) == pytest.approx(needed, rel=0.01)
    assert err.index(words) < err.index(f"{last} nodes leave")
    left = (
        f"{reached} of the image's variance is unexplained, more than 0.001, which requires about "
    )
    assert left in err
    assert "allow more (--nodes-max)" in err
    numbers = numbers_in("a.json")
    options = numbers["options"]
    assert list(numbers["violated"]) == ["error"]
    assert (options["nodes"], options["nodes_max"], numbers["size"]["n_nodes"]) == (230, 230, 230)
    assert_done(f"{MESH} --force --nodes 230")
    assert numbers_in("a.json")["mesh_sha256"] == numbers["mesh_sha256"]


# --------------------------------------------------------------------------------------------------
# segment


def test_segment():
    """The labels written are the library's; Dice with the truth is printed for mesh and voxels."""
    truth = load_phantom("sphere").label_image(voxel_mm=4.0)
    save_image("truth.nii.gz", truth)
    command = "segment sphere.nii.gz run.vtu -o labels.nii.gz --classes 2 --json s.json"
    said = run_command(f"{command} --truth truth.nii.gz").out
    image, labels = load_image("sphere.nii.gz"), load_image("labels.nii.gz")
    assert_array_equal(labels.data, segment(image, load_mesh("run.vtu").mesh, 2).data)
    assert_allclose(labels.affine, image.affine)
    overlaps = dice(labels, load_image("truth.nii.gz"))
    written = {str(label): value for label, value in overlaps.items()}
    assert numbers_in("s.json")["dice"]["mesh"] == written
    assert overlaps[1] > 0.7
    assert f"{overlaps[1]:.4f}" in said


def test_segment_cuts_the_truth_as_the_image_and_never_replaces_it():
    assert_done("mesh sphere.nii.gz --slice k=5 -o s.vtu --nodes 40 --iterations 0")
    cut = "segment sphere.nii.gz s.vtu --slice k=5 --truth truth.nii --classes 2 -o"
    assert_done(f"{cut} l.nii")
    assert_refuses(f"{cut} truth.nii --force", "truth.nii")


def test_an_error_of_a_million_letters_is_cut(capsys):
    show_error("a.txt, line 3: expected a label, got " + "x" * 1_000_000 + "; mend it")
    error = capsys.readouterr().err
    assert error.startswith("tetopt: a.txt, line 3: expected a label, got x")
    assert error.endswith("x; mend it\n")
    assert len(error) < 500
