"""A program of the user's own as a pipeline: its files, the number of nodes, the box, and every refusal."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_child import is_running, wait_for

import tetopt
from tetopt.cli import main
from tetopt.fem.elasticity import check_fills_box
from tetopt.io.images import sha256
from tetopt.study.child import run_in_child
from tetopt.study.interfaces import class_labels
from tetopt.study.pipelines import PipelineInput
from tetopt.study.program import by_program, file_checksums, parse_program, pipelines_with

PHANTOM = tetopt.load_phantom("sphere")
IMAGE = PHANTOM.image(voxel_mm=4.0)
JOB = PipelineInput(IMAGE, None, 1000, classes=3)
PYTHON, MESHER = shlex.quote(sys.executable), shlex.quote(str(Path(__file__).with_name("mesher.py")))


def command(kind, *more):
    return " ".join(["mine=" + PYTHON, MESHER, kind, "{image} {labels} {nodes} {output}", *more])


def test_number_of_nodes_is_corrected(tmp_path):
    """Asked again with a corrected number, until it is met; with given labels, else with the classes."""
    log = tmp_path / "log"
    made = by_program(JOB, parse_program(command("fine", str(log))))
    assert abs(len(made.mesh.points) / 1000 - 1.0) <= 0.05
    check_fills_box(IMAGE, made.mesh)
    lines = log.read_text().splitlines()
    assert lines[0] == "1000 [0, 1, 2]"
    assert float(lines[1].split()[0]) > 1100
    assert list(made.seconds) == ["program", "search"]
    assert made.notes == [f"{len(lines)} runs"]
    log.unlink()
    labels = tetopt.Image(7 * class_labels(IMAGE, 2).data, IMAGE.affine)
    by_program(JOB._replace(labels=labels), parse_program(command("fine", str(log))))
    assert log.read_text().splitlines()[0] == "1000 [0, 7]"


@pytest.mark.parametrize("kind", ["labelled", "rough-labelled"])
def test_cells_have_the_labels_of_the_program(kind):
    """Those of the image, on the cells that are left when flat ones are taken off; not others, nor without labels."""
    made = by_program(JOB._replace(labels=class_labels(IMAGE, 2)), parse_program(command(kind)))
    number = np.arange(len(made.mesh.cells))
    np.testing.assert_array_equal(made.labels, np.where(number % 2 == 0, number // 2 % 2, -1))
    n_known = (number % 2 == 0).sum()
    assert made.notes[-1] == f'{n_known} of {len(number)} cells count for the "label" that its file gives them'
    assert by_program(JOB, parse_program(command(kind))).labels is None


def test_sizes_instead_of_numbers(tmp_path):
    """{size} shrinks as the number grows, by its cube root; no shell reads the words."""
    script = tmp_path / "by size.py"
    script.write_text(
        "import sys, tetopt\nimage = tetopt.load_image(sys.argv[1])\n"
        "assert sys.argv[2] == '$HOME;'\n"
        "mesh = tetopt.lattice_mesh(image, nodes=round(image.volume / float(sys.argv[3]) ** 3))\n"
        "tetopt.save_mesh(sys.argv[4], mesh)\n"
    )
    words = f"mine={PYTHON} '{script}' {{image}} '$HOME;' {{size}} {{output}}"
    made = by_program(JOB, parse_program(words))
    assert abs(len(made.mesh.points) / 1000 - 1.0) <= 0.05


def test_other_suffixes(tmp_path):
    """gmsh's own format, and a mesh that no number steers: one run, and a note."""
    script = tmp_path / "msh.py"
    script.write_text(
        "import sys, tetopt\nimage = tetopt.load_image(sys.argv[1])\n"
        "assert sys.argv[2].endswith('/mesh.msh')\n"
        "tetopt.save_model(sys.argv[2], tetopt.build_model(tetopt.lattice_mesh(image, nodes=400), image))\n"
    )
    made = by_program(JOB, parse_program(f"mine={PYTHON} {script} {{image}} {{output}}.msh"))
    n = len(made.mesh.points)
    assert made.notes == ["1 runs", f"{n} nodes, 1000 were asked for; its runs gave {n}"]


def test_a_count_that_cannot_be_met_is_told():
    made = by_program(JOB, parse_program(command("stubborn")))
    n = len(made.mesh.points)
    assert made.notes == ["5 runs", f"{n} nodes, 1000 were asked for; its runs gave {n}, {n}, {n}, {n}, {n}"]


def test_a_failure_after_a_success_is_a_note():
    made = by_program(JOB, parse_program(command("once")))
    assert len(made.mesh.points) < 700
    assert made.notes[1].endswith("nodes: mine ended with exit code 1: the mesher's own words")


def test_a_boundary_near_the_box_is_put_on_it():
    made = by_program(JOB, parse_program(command("wide")))
    check_fills_box(IMAGE, made.mesh)
    assert made.notes[1] == "its boundary was moved by up to 0.5 voxels onto the sides of the image's box"


def test_flat_cells_on_the_sides_are_taken_off():
    """As where points of a side are found roughly: a node a little inside, under a cell that is all but flat."""
    made, smooth = (by_program(JOB, parse_program(command(kind))) for kind in ("rough", "wide"))
    check_fills_box(IMAGE, made.mesh)
    assert len(made.mesh.cells) == len(smooth.mesh.cells)
    assert made.notes[1] == "its boundary was moved by up to 0.5 voxels onto the sides of the image's box"


def test_a_boundary_far_from_the_box_stays():
    made = by_program(JOB, parse_program(command("small")))
    assert made.notes[1] == "its boundary lies up to 3 voxels off the sides of the image's box"
    index = IMAGE.to_index(made.mesh.points)
    assert index.min() == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("fails", "mine ended with exit code 1: the mesher's own words"),
        ("none", "mine wrote no mesh, and wrote nothing on its standard error"),
        ("flat", "mine: expected tetrahedra, got triangles"),
    ],
)
def test_failures(kind, words):
    with pytest.raises(tetopt.InputError, match=f"^{words}$"):
        by_program(JOB, parse_program(command(kind)))


def test_limits_hold_for_what_it_starts(tmp_path):
    """A program that never ends is killed with the child, and its files are gone."""
    script = tmp_path / "slow.py"
    script.write_text(f"import sys, time\nopen({str(tmp_path / 'path')!r}, 'w').write(sys.argv[2])\ntime.sleep(600)\n")
    pipeline = pipelines_with([parse_program(f"mine={PYTHON} {script} {{image}} {{output}}")])["mine"]
    outcome = run_in_child(pipeline.function, JOB, max_seconds=8.0)
    assert outcome.failure == "out of time: killed after 8 s"
    assert not Path((tmp_path / "path").read_text()).parent.exists()


def test_sigterm_ends_the_comparison_and_its_programs(tmp_path):
    """As a scheduler sends it: nothing is left running, no temporary folder stays, and finished runs are kept."""
    tetopt.save_image(tmp_path / "image.nii.gz", IMAGE)
    script, pid_file, temporary = tmp_path / "slow.sh", tmp_path / "pid", tmp_path / "temporary"
    script.write_text(f"echo $$ > {pid_file}.new; mv {pid_file}.new {pid_file}; exec sleep 600\n")
    temporary.mkdir()
    words = ["compare", str(tmp_path / "image.nii.gz"), "-o", str(tmp_path / "out"), "--nodes", "150", "--curve", ""]
    words += ["--reference-dofs", "1000", "--pipelines", "bcc", "--pipeline", f"mine=sh {script} {{image}} {{output}}"]
    paths = os.pathsep.join([str(Path(tetopt.__file__).parents[1]), *filter(None, sys.path)])
    command = subprocess.Popen(
        [sys.executable, "-m", "tetopt", *words], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": paths, "TMPDIR": str(temporary)},
    )  # fmt: skip
    try:
        wait_for(pid_file.exists, 300.0)  # kernels may have to be compiled
        command.terminate()
        said = command.communicate(timeout=30.0)[1].decode()
    finally:
        command.kill()
    assert command.returncode == 143
    assert "--resume goes on from there" in said
    assert not is_running(int(pid_file.read_text()))
    wait_for(lambda: not list(temporary.iterdir()), 10.0)
    assert (tmp_path / "out" / "runs" / "bcc-150-1.json").is_file()
    assert not (tmp_path / "out" / "report.json").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sh {image} {output}", "expected NAME='program"),
        ("a b=sh {image} {output}", "a name of letters"),
        ("a=sh '{image} {output}", "its quotes do not match"),
        ("a=", "expected {output}, and {image}"),
        ("a=sh {output}", "expected {output}, and {image}"),
        ("a=sh {image}", "expected {output}, and {image}"),
        ("a=sh {image} {output} {seed}", "got {seed}"),
        ("a=sh {image} {output}.stl", "must be named .vtu, .vtk, .vtkhdf, .msh, .msh2, got {output}.stl"),
        ("a=tetopt-no-such-program {image} {output}", 'no program "tetopt-no-such-program"'),
        ("tetopt=sh {image} {output}", 'a pipeline named "tetopt" already'),
    ],
)
def test_bad_commands(text, words, tmp_path, capsys):
    """One line, exit 2, before anything runs."""
    tetopt.save_image(tmp_path / "image.nii.gz", IMAGE)
    assert main(["compare", str(tmp_path / "image.nii.gz"), "-o", str(tmp_path / "out"), "--pipeline", text]) == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]
    assert not (tmp_path / "out" / "runs").exists()


def test_two_of_one_name(tmp_path, capsys):
    tetopt.save_image(tmp_path / "image.nii.gz", IMAGE)
    twice = ["--pipeline", "a=sh {image} {output}"] * 2
    assert main(["compare", str(tmp_path / "image.nii.gz"), "-o", str(tmp_path / "out"), *twice]) == 2
    assert 'named "a" already' in capsys.readouterr().err


@pytest.mark.slow
def test_programs_in_the_comparison(tmp_path, opengl):
    """A row as the others have; one that does not fill the box has all but the compression; resumed by its words."""
    tetopt.save_image(tmp_path / "image.nii.gz", IMAGE)
    out = tmp_path / "out"
    options = ["--nodes", "300", "--reference-dofs", "6000", "--curve", "", "--pipelines", "bcc"]
    fine, small = command("fine"), command("small").replace("mine=", "other=")
    words = ["compare", str(tmp_path / "image.nii.gz"), "-o", str(out), *options]
    assert main([*words, "--pipeline", fine, "--pipeline", small]) == 0
    report = json.loads((out / "report.json").read_text())
    bcc, mine, other = report["pipelines"]
    assert [mine["kind"], mine["title"], mine["about"]] == ["peer", "mine", f"a program: {fine.partition('=')[2]}"]
    assert report["options"]["programs"] == [
        {"name": name, "command": text.partition("=")[2]} for name, text in (("mine", fine), ("other", small))
    ]
    assert report["versions"]["mine, SHA-256 of its files"].split(", ")[-1] == sha256(Path(shlex.split(MESHER)[0]))
    assert [abs(each["median"]["n_nodes"] / 300 - 1) < 0.2 for each in report["quadratic"]] == [True] * 3
    assert set(mine["median"]["fem"]) == set(bcc["median"]["fem"]) == {"0.3", "0.45"}
    assert mine["median"]["E_D_fraction"] == pytest.approx(bcc["median"]["E_D_fraction"], rel=0.1)
    assert other["median"]["fem"] == {}
    assert "of its boundary facets lie off" in other["median"]["not_compressed"]
    assert 0.0 < other["median"]["labels"][0]["dice"] < 1.0
    page = (out / "report.html").read_text()
    assert "other was not compressed" in page
    before = np.array([mine["median"]["E_D"]])
    (out / "runs" / "other-300-1.json").unlink()
    assert (
        main([*words, "--pipeline", fine, "--pipeline", command("stubborn").replace("mine=", "other="), "--resume"])
        == 0
    )
    _, mine, other = json.loads((out / "report.json").read_text())["pipelines"]
    assert np.array_equal([mine["median"]["E_D"]], before)
    assert set(other["median"]["fem"]) == {"0.3", "0.45"}


def test_checksums_are_of_the_files_of_a_command_line(tmp_path):
    """The program and every file; a shell's whole script, too long to be a file's name, is none."""
    (tmp_path / "a.txt").write_text("x")
    script = shlex.quote("echo hello; " * 100)
    program = parse_program(f"mine={PYTHON} -c {script} {tmp_path / 'a.txt'} {{image}} {{output}}")
    assert file_checksums(program) == [sha256(Path(sys.executable)), sha256(tmp_path / "a.txt")]
