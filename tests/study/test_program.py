"""A program of the user's own as a pipeline: its files, the number of nodes, the box, and every
refusal.
"""

import os
import shlex
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, exit_code, numbers_in
from numpy.testing import assert_array_equal
from test_child import is_running, wait_for

import tetopt
from tetopt.fem.elasticity import check_fills_box
from tetopt.geometry.simplex import orient_cells
from tetopt.study.isosurfaces import class_labels
from tetopt.study.pipelines import PipelineInput
from tetopt.study.program import by_program, parse_program, put_on_sides

IMAGE = tetopt.load_phantom("sphere").image(voxel_mm=4.0)
JOB = PipelineInput(IMAGE, None, 1000, classes=3)
PYTHON = shlex.quote(sys.executable)
# Each run notes what it is told, keeps what it is to mesh, and gives out the next of the files
# beside it.
SCRIPT = (
    'cd "$(dirname "$0")"; echo "$@" >> log; cp "$1" kept.nii.gz; cp "$(wc -l < '
    'log).${2##*.}" "$2"\n'
)


def mesher(folder, *meshes, words="{labels} {output} {nodes} {size} '$HOME;'", **data):
    """A program that gives out these meshes, one a run, and then fails."""
    script = folder / "a mesher.sh"
    script.write_text(SCRIPT)
    for number, mesh in enumerate(meshes, 1):
        tetopt.save_mesh(folder / f"{number}.vtu", mesh, data)
        if mesh.ndim == 3:
            tetopt.save_model(folder / f"{number}.msh", tetopt.build_model(mesh, IMAGE))
    return parse_program(f"mine=sh '{script}' {words}")


def lattice(nodes):
    return tetopt.lattice_mesh(IMAGE, nodes=nodes)


def scaled(mesh, voxels):
    """The mesh made wider by so many voxels."""
    middle = (np.array(IMAGE.shape) - 1) / 2
    factor = 1 + voxels / np.array(IMAGE.shape)
    return tetopt.Mesh(
        IMAGE.to_world(middle + factor * (IMAGE.to_index(mesh.points) - middle)), mesh.cells
    )


def covered(mesh):
    """The mesh with two cells more: a cell on the lowest side has one more node, a little inside
    the facet there, and under the node a last cell that is all but flat.
    """
    is_low = mesh.points[:, 2] == mesh.points[:, 2].min()
    n, is_on_side = len(mesh.points), is_low[mesh.cells].sum(axis=1) == 3
    split = np.flatnonzero(is_on_side)[0]
    corners = mesh.cells[split]
    facet, top = corners[is_low[corners]], corners[~is_low[corners]][0]
    points = np.vstack([mesh.points, mesh.points[facet].mean(axis=0) + np.array([0.0, 0.0, 2e-4])])
    parts = [[*edge, n, top] for edge in combinations(facet, 2)]
    cells = np.vstack([np.delete(mesh.cells, split, axis=0), *parts, [*facet, n]])
    return tetopt.Mesh(points, orient_cells(points, cells))


def test_number_of_nodes_is_corrected(tmp_path):
    """Asked again with a corrected number, and a size that shrinks by its cube root; no shell
    reads the words.
    """
    few, enough = lattice(670), lattice(1000)
    made = by_program(JOB, mesher(tmp_path, few, enough))
    assert_array_equal(made.mesh.points, enough.points)
    assert list(made.seconds) == ["program", "search"]
    assert made.notes == ["2 runs"]
    said = [line.split() for line in (tmp_path / "log").read_text().splitlines()]
    (first, size), (second, smaller) = ((int(words[2]), float(words[3])) for words in said)
    assert first == 1000
    assert second == pytest.approx(1000 * 1000 / len(few.points), abs=1)
    assert smaller / size == pytest.approx((first / second) ** (1 / 3), rel=1e-5)
    assert {words[4] for words in said} == {"$HOME;"}
    assert_array_equal(
        tetopt.load_image(tmp_path / "kept.nii.gz").data, class_labels(IMAGE, 3).data
    )


def test_labels_go_to_the_program_and_come_back(tmp_path):
    """Those of the image, on the cells that are left when flat ones are taken off; not others,
    nor without labels.
    """
    given = tetopt.Image(7 * class_labels(IMAGE, 2).data, IMAGE.affine)
    mesh = covered(scaled(lattice(300), 1))
    number = np.arange(len(mesh.cells))
    labels = np.where(number % 2 == 0, 7 * (number // 2 % 2), 99)
    program = mesher(tmp_path, mesh, mesh, words="{labels} {output}", label=labels)
    made = by_program(JOB._replace(labels=given), program)
    assert_array_equal(tetopt.load_image(tmp_path / "kept.nii.gz").data, given.data)
    n = len(made.mesh.cells)
    assert n < len(mesh.cells)
    assert_array_equal(made.labels, np.where(number % 2 == 0, labels, -1)[:n])
    n_used = (number[:n] % 2 == 0).sum()
    assert made.notes[-1] == f'{n_used} of {n} cells use the "label" in their file'
    assert by_program(JOB, program).labels is None


def test_other_suffixes(tmp_path):
    """gmsh's own format, and a mesh that no number steers: one run, and a note."""
    made = by_program(JOB, mesher(tmp_path, lattice(400), words="{image} {output}.msh"))
    n = len(made.mesh.points)
    assert made.notes == ["1 runs", f"{n} nodes instead of 1000; the runs gave {n}"]
    assert_array_equal(tetopt.load_image(tmp_path / "kept.nii.gz").data, IMAGE.data)


def test_a_count_that_cannot_be_met_is_told(tmp_path):
    """The same mesh twice, and then failures, which are notes."""
    mesh = lattice(400)
    made = by_program(JOB, mesher(tmp_path, mesh, mesh))
    n = len(mesh.points)
    first, *failures, last = made.notes
    assert (first, last) == ("2 runs", f"{n} nodes instead of 1000; the runs gave {n}, {n}")
    assert len(failures) == 3
    assert all("nodes: mine ended with exit code 1: cp: " in line for line in failures)


@pytest.mark.parametrize(("shape", "n_more"), [(lambda mesh: mesh, 0), (covered, 2)])
def test_a_boundary_near_the_box_is_put_on_it(shape, n_more):
    """Also one whose nodes lie a little inside, under cells that are all but flat: these are
    taken off.
    """
    whole = lattice(300)
    mesh, kept, notes = put_on_sides(IMAGE, shape(scaled(whole, 1)))
    check_fills_box(IMAGE, mesh)
    assert len(mesh.cells) == len(kept) == len(whole.cells) + n_more
    assert notes == ["its boundary was moved by up to 0.5 voxels onto the sides of the image's box"]


def test_a_boundary_far_from_the_box_stays():
    mesh, _, notes = put_on_sides(IMAGE, scaled(lattice(300), -6))
    assert notes == ["its boundary lies up to 3 voxels from the sides of the image's box"]
    assert IMAGE.to_index(mesh.points).min() == pytest.approx(2.5)


def test_failures(tmp_path):
    flat = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    for program, words in (
        (mesher(tmp_path, flat), "mine: expected tetrahedra, got triangles"),
        (mesher(tmp_path), "mine ended with exit code 1: cp: "),
        (
            parse_program("mine=true {image} {output}"),
            "mine wrote no mesh, with nothing on its standard error",
        ),
    ):
        with pytest.raises(tetopt.InputError, match=f"^{words}"):
            by_program(JOB, program)


@pytest.mark.deep
def test_sigterm_ends_the_comparison_and_its_programs(tmp_path):
    """As a scheduler sends it: nothing is left running, and no temporary folder or report stays."""
    tetopt.save_image(tmp_path / "image.nii.gz", IMAGE)
    script, pid_file, temporary = tmp_path / "slow.sh", tmp_path / "pid", tmp_path / "temporary"
    script.write_text(f"echo $$ > {pid_file}.new; mv {pid_file}.new {pid_file}; exec sleep 600\n")
    temporary.mkdir()
    words = "compare image.nii.gz -o out --nodes 150 --reference-dofs 1000 --pipelines bcc"
    program = f"mine=sh {script} {{image}} {{output}}"
    paths = os.pathsep.join([str(Path(tetopt.__file__).parents[1]), *filter(None, sys.path)])
    command = subprocess.Popen(
        [sys.executable, "-m", "tetopt", *words.split(), "--pipeline", program],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": paths, "TMPDIR": str(temporary)},
    )
    try:
        wait_for(pid_file.exists, 300.0)  # kernels may have to be compiled
        command.terminate()
        command.communicate(timeout=30.0)
    finally:
        command.kill()
    assert command.returncode == 143
    assert not is_running(int(pid_file.read_text()))
    wait_for(lambda: not list(temporary.iterdir()), 10.0)
    assert not list(tmp_path.glob("out/*"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sh {image} {output}", "expected NAME='program"),
        ("a b=sh {image} {output}", "a name of letters"),
        ("a=sh '{image} {output}", "unbalanced quotes"),
        ("a=", "expected {output}, and {image}"),
        ("a=sh {output}", "expected {output}, and {image}"),
        ("a=sh {image}", "expected {output}, and {image}"),
        ("a=sh {image} {output} {seed}", "unknown placeholder {seed}"),
        (
            "a=sh {image} {output}.stl",
            "must end in .vtu, .vtk, .msh, .msh2, .inp, .feb, .mesh, .xdmf, got {output}.stl",
        ),
        (
            "a=tetopt-no-such-program {image} {output}",
            'no executable program "tetopt-no-such-program"',
        ),
        ("tetopt=sh {image} {output}", 'expected unique names, got "tetopt" again'),
    ],
)
def test_bad_commands(text, words, here, capsys):
    """One line, exit 2, before anything runs."""
    tetopt.save_image("image.nii.gz", IMAGE)
    command = f"compare image.nii.gz -o out --pipeline {shlex.quote(text)}"
    assert_refused(capsys, command, words)


@pytest.mark.slow
def test_programs_in_the_comparison(here, opengl):
    """A row as the others have; one that does not fill the box has all but the compression."""
    tetopt.save_image("image.nii.gz", IMAGE)
    Path("mesher.py").write_text(
        "import sys, tetopt\nimage = tetopt.load_image(sys.argv[2])\n"
        "mesh = tetopt.lattice_mesh(image, nodes=round(2 / 3 * int(sys.argv[3])))\n"
        "tetopt.save_mesh(sys.argv[4], tetopt.Mesh(float(sys.argv[1]) * mesh.points, mesh.cells))\n"
    )
    programs = {
        name: f"{PYTHON} {here}/mesher.py {factor} {{image}} {{nodes}} {{output}}"
        for name, factor in (("mine", 1), ("other", 0.7))
    }
    words = "compare image.nii.gz -o out --nodes 300 --reference-dofs 6000 --pipelines bcc"
    for name, program in programs.items():
        words += f" --pipeline {shlex.quote(f'{name}={program}')}"
    assert exit_code(words) == 0
    report = numbers_in("out/report.json")
    bcc, mine, other = report["pipelines"]
    about = [mine["kind"], mine["title"], mine["about"]]
    assert about == ["peer", "mine", f"a program: {programs['mine']}"]
    assert report["options"]["programs"] == [
        {"name": name, "command": program} for name, program in programs.items()
    ]
    n_nodes = [each["median"]["n_nodes"] for each in report["quadratic"]]
    assert n_nodes == pytest.approx([300] * 3, rel=0.2)
    mine, bcc, other = (each["median"] for each in (mine, bcc, other))
    assert set(mine["fem"]) == set(bcc["fem"]) == {"0.3", "0.45"}
    assert mine["E_D_fraction"] == pytest.approx(bcc["E_D_fraction"], rel=0.1)
    assert other["fem"] == {}
    assert "of its boundary facets lie off" in other["not_compressed"]
    assert 0.0 < other["labels"][0]["dice"] < 1.0
    assert "other: not compressed: " in Path("out/report.html").read_text()
