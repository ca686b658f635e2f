"""A program of the user's own as a pipeline: its files, the number of nodes, the box, and every
refusal.
"""

import json
import os
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from test_child import is_running, wait_for

import tetopt
from tetopt.cli import main
from tetopt.fem.elasticity import check_fills_box
from tetopt.geometry.simplex import orient_cells, volumes
from tetopt.geometry.topology import boundary_facets
from tetopt.study.isosurfaces import class_labels
from tetopt.study.pipeline_process import run_in_child
from tetopt.study.pipelines import PipelineInput
from tetopt.study.program import by_program, parse_program, pipelines_with, put_on_sides

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
    """The mesh with a node on its lowest side a little further in, and under it cells that fill
    the dent.
    """
    points = mesh.points.copy()
    low = points[:, 2].min()
    middle = points[:, :2].mean(axis=0)
    on_side = np.flatnonzero(points[:, 2] == low)
    node = on_side[np.argmin(np.linalg.norm(points[on_side, :2] - middle, axis=1))]
    points[node, 2] += 2e-4
    facets = boundary_facets(mesh.cells)
    around = facets[(facets == node).any(axis=1)]
    rim = np.unique(around[around != node])
    turns = np.arctan2(*(points[rim, :2] - points[node, :2]).T)
    rim = rim[np.argsort(turns)]
    # from a corner of the rim two of its triangles have no area
    fans = [np.roll(rim, -k) for k in range(len(rim))]
    lids = [np.array([[node, fan[0], *pair] for pair in pairwise(fan[1:])]) for fan in fans]
    best = max(lids, key=lambda cells: np.abs(volumes(points, cells)).min())
    return tetopt.Mesh(points, np.vstack([mesh.cells, orient_cells(points, best)]))


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
    given, mesh = (
        tetopt.Image(7 * class_labels(IMAGE, 2).data, IMAGE.affine),
        covered(scaled(lattice(300), 1)),
    )
    number = np.arange(len(mesh.cells))
    labels = np.where(number % 2 == 0, 7 * (number // 2 % 2), 99)
    program = mesher(tmp_path, mesh, mesh, words="{labels} {output}", label=labels)
    made = by_program(JOB._replace(labels=given), program)
    assert_array_equal(tetopt.load_image(tmp_path / "kept.nii.gz").data, given.data)
    n = len(made.mesh.cells)
    assert n < len(mesh.cells)
    assert_array_equal(made.labels, np.where(number % 2 == 0, labels, -1)[:n])
    assert (
        made.notes[-1]
        == f'{(number[:n] % 2 == 0).sum()} of {n} cells use the "label" in their file'
    )
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


@pytest.mark.parametrize("shape", [lambda mesh: mesh, covered])
def test_a_boundary_near_the_box_is_put_on_it(shape):
    """Also one whose nodes lie a little inside, under cells that are all but flat: these are
    taken off.
    """
    mesh, kept, notes = put_on_sides(IMAGE, shape(scaled(lattice(300), 1)))
    check_fills_box(IMAGE, mesh)
    assert len(mesh.cells) == len(kept) == len(lattice(300).cells)
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
def test_limits_hold_for_what_it_starts(tmp_path):
    """A program that never ends is killed with the child, and its files are gone."""
    script = tmp_path / "slow.sh"
    script.write_text(f'echo "$2" > {tmp_path / "path"}; exec sleep 600\n')
    pipeline = pipelines_with([parse_program(f"mine=sh {script} {{image}} {{output}}")])["mine"]
    outcome = run_in_child(pipeline.function, JOB, max_seconds=8.0)
    assert outcome.failure == "out of time: killed after 8 s"
    assert not Path((tmp_path / "path").read_text().strip()).parent.exists()


@pytest.mark.deep
def test_sigterm_ends_the_comparison_and_its_programs(tmp_path):
    """As a scheduler sends it: nothing is left running, and no temporary folder or report stays."""
    tetopt.save_image(tmp_path / "image.nii.gz", IMAGE)
    script, pid_file, temporary = tmp_path / "slow.sh", tmp_path / "pid", tmp_path / "temporary"
    script.write_text(f"echo $$ > {pid_file}.new; mv {pid_file}.new {pid_file}; exec sleep 600\n")
    temporary.mkdir()
    words = [
        "compare",
        str(tmp_path / "image.nii.gz"),
        "-o",
        str(tmp_path / "out"),
        "--nodes",
        "150",
    ]
    words += [
        "--reference-dofs",
        "1000",
        "--pipelines",
        "bcc",
        "--pipeline",
        f"mine=sh {script} {{image}} {{output}}",
    ]
    paths = os.pathsep.join([str(Path(tetopt.__file__).parents[1]), *filter(None, sys.path)])
    command = subprocess.Popen(
        [sys.executable, "-m", "tetopt", *words],
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
        ("a=sh {image} {output}.stl", "must end in .vtu, .vtk, .msh, .msh2, got {output}.stl"),
        (
            "a=tetopt-no-such-program {image} {output}",
            'no executable program "tetopt-no-such-program"',
        ),
        ("tetopt=sh {image} {output}", 'expected unique names, got "tetopt" again'),
    ],
)
def test_bad_commands(text, words, tmp_path, capsys):
    """One line, exit 2, before anything runs."""
    tetopt.save_image(tmp_path / "image.nii.gz", IMAGE)
    assert (
        main(
            [
                "compare",
                str(tmp_path / "image.nii.gz"),
                "-o",
                str(tmp_path / "out"),
                "--pipeline",
                text,
            ]
        )
        == 2
    )
    assert words in capsys.readouterr().err.strip().splitlines()[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_programs_in_the_comparison(tmp_path, opengl):
    """A row as the others have; one that does not fill the box has all but the compression."""
    tetopt.save_image(tmp_path / "image.nii.gz", IMAGE)
    script, out = tmp_path / "mesher.py", tmp_path / "out"
    script.write_text(
        "import sys, tetopt\nimage = tetopt.load_image(sys.argv[2])\n"
        "mesh = tetopt.lattice_mesh(image, nodes=round(2 / 3 * int(sys.argv[3])))\n"
        "tetopt.save_mesh(sys.argv[4], tetopt.Mesh(float(sys.argv[1]) * mesh.points, mesh.cells))\n"
    )
    options = ["--nodes", "300", "--reference-dofs", "6000", "--pipelines", "bcc"]
    fine, small = (
        f"{name}={PYTHON} {script} {factor} {{image}} {{nodes}} {{output}}"
        for name, factor in (("mine", "1"), ("other", "0.7"))
    )
    words = ["compare", str(tmp_path / "image.nii.gz"), "-o", str(out), *options]
    assert main([*words, "--pipeline", fine, "--pipeline", small]) == 0
    report = json.loads((out / "report.json").read_text())
    bcc, mine, other = report["pipelines"]
    assert [mine["kind"], mine["title"], mine["about"]] == [
        "peer",
        "mine",
        f"a program: {fine.partition('=')[2]}",
    ]
    assert report["options"]["programs"] == [
        {"name": name, "command": text.partition("=")[2]}
        for name, text in (("mine", fine), ("other", small))
    ]
    assert [abs(each["median"]["n_nodes"] / 300 - 1) < 0.2 for each in report["quadratic"]] == [
        True
    ] * 3
    assert set(mine["median"]["fem"]) == set(bcc["median"]["fem"]) == {"0.3", "0.45"}
    assert mine["median"]["E_D_fraction"] == pytest.approx(bcc["median"]["E_D_fraction"], rel=0.1)
    assert other["median"]["fem"] == {}
    assert "of its boundary facets lie off" in other["median"]["not_compressed"]
    assert 0.0 < other["median"]["labels"][0]["dice"] < 1.0
    assert "other: not compressed: " in (out / "report.html").read_text()
