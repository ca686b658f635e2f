"""What is wrong with a mesh is one list: the command's exit code, run.json, its last line, and a
cohort's row agree.
"""

from itertools import pairwise

import numpy as np
import pytest
from commands import exit_code, numbers_in
from label_rows import label_row
from scipy.ndimage import gaussian_filter

import tetopt
import tetopt.job.run
import tetopt.measure.measures
from tetopt.cohort.flags import flags_of
from tetopt.cohort.layout import mesh_name, numbers_path, subject_folder
from tetopt.cohort.numbers import row_of
from tetopt.cohort.subject_states import state_of
from tetopt.job.advice import Problem, of_layers, order_problems, sentences
from tetopt.job.events import ended_words
from tetopt.job.options import SourceOptions
from tetopt.job.source import read_source

COARSE = ["--spacing", "12", "--iterations", "0"]
FINE = ["--spacing", "6", "--iterations", "0"]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """An image, and labels of which one has 512 voxels that are apart, which large cells cannot
    have.
    """
    folder = tmp_path_factory.mktemp("inputs")
    x = np.indices((24, 24, 24))[0]
    labels = np.where(x < 12, 1, 3)
    labels[::3, ::3, ::3] = 2
    tetopt.save_image(folder / "l.nii.gz", tetopt.Image(labels))
    tetopt.save_image(folder / "a.nii.gz", tetopt.Image(10.0 * labels + x % 5))
    return folder


def failing(*_):
    raise ZeroDivisionError("no way")


CASES = {
    "labels": (["--labels", "l.nii.gz", *COARSE, "--no-smooth-interfaces"], None),  # lost
    "contacts": (["--labels", "l.nii.gz", *COARSE], "label_contacts"),  # a measurement that fails
    "error": (["--target-error", "1e-4", "--size-min", "20", "--iterations", "1"], None),
}


@pytest.mark.parametrize("name", CASES)
def test_exit_code_and_files_and_cohort_agree(inputs, tmp_path, monkeypatch, capsys, name):
    words, measure = CASES[name]
    monkeypatch.chdir(inputs)
    if measure is not None:
        monkeypatch.setattr(tetopt.measure.measures, measure, failing)
    key = "sub-1"
    subject_folder(tmp_path, key).mkdir(parents=True)
    mesh, numbers = (
        subject_folder(tmp_path, key) / mesh_name(key, ".vtu"),
        numbers_path(tmp_path, key),
    )
    assert exit_code("mesh", "a.nii.gz", "-o", mesh, "--json", numbers, *words) == 1
    violated = numbers_in(numbers)["violated"]
    assert name in violated
    said = capsys.readouterr()
    assert said.out.splitlines()[-1].startswith(
        f"requirements not met: {', '.join(violated)}; {mesh}: "
    )
    for key_of, sentence in violated.items():
        assert sentence.replace("`", "")[:40].split(";")[0] in said.err.replace("`", ""), key_of
    row = row_of(tmp_path, key)
    assert (row.status, row.violated) == ("violated", tuple(violated))
    assert state_of(tmp_path, key).status == "violated"
    (flags,) = flags_of([row])
    assert {flag.column for flag in flags} <= {"violated", "label"}
    assert len(flags) >= 1


def test_a_good_mesh_ends_with_a_verdict(inputs, tmp_path, capsys):
    out = tmp_path / "a.vtu"
    command = [
        "mesh",
        inputs / "a.nii.gz",
        "-o",
        out,
        "--json",
        tmp_path / "a.json",
        "--spacing",
        "8",
    ]
    assert exit_code(*command, "--iterations", "0") == 0
    assert numbers_in(tmp_path / "a.json")["violated"] == {}
    said = capsys.readouterr()
    size = numbers_in(tmp_path / "a.json")["size"]
    words = f"all requirements are met; {out}: {size['n_nodes']} nodes, {size['n_cells']} cells"
    assert said.out.splitlines()[-1] == words
    assert "warning" not in said.err
    assert exit_code("quality", out, "--image", inputs / "a.nii.gz", "--check") == 0
    assert capsys.readouterr().out.splitlines()[-1] == words


def test_a_verdict_is_not_without_what_requirements_allow(tmp_path, capsys):
    """A label of 180 voxels whose cells are too large for it, and a speck of another without a
    cell.
    """
    labels = np.ones((24, 24, 24))
    labels[8:13, 8:14, 8:14], labels[3, 3, 3], labels[16:, 16:, 16:] = 2.0, 3.0, 3.0
    tetopt.save_image(tmp_path / "l.nii.gz", tetopt.Image(labels))
    out, path = tmp_path / "a.vtu", tmp_path / "a.json"
    files = ["--labels", tmp_path / "l.nii.gz"]
    assert exit_code("mesh", tmp_path / "l.nii.gz", *files, "-o", out, "--json", path, *FINE) == 0
    rows = {row["label"]: row for row in numbers_in(path)["labels"]}
    assert [each["voxels"] for each in rows[3]["lost_components"]] == [1]
    *_, beyond, verdict = capsys.readouterr().out.replace("\n  ", " ").splitlines()
    ratio = rows[2]["mesh_volume"] / 180.0
    assert not 0.85 <= ratio <= 1.15
    assert beyond.startswith("labels: of 3, ")
    assert f"2 ({ratio:.3g})" in beyond
    assert beyond.endswith("1 with components without a cell: 3 (1 of 2, voxels: 1)")
    assert verdict.startswith(f"all requirements are met, but not all labels fit (above); {out}: ")
    assert exit_code("quality", out, "--image", tmp_path / "l.nii.gz", *files, "--check") == 0
    assert capsys.readouterr().out.replace("\n  ", " ").splitlines()[-2:] == [beyond, verdict]


def test_commands_tell_that_the_run_of_a_mesh_violated_requirements(inputs, tmp_path, capsys):
    mesh = tmp_path / "a.vtu"
    assert exit_code("mesh", inputs / "a.nii.gz", "-o", mesh, *CASES["error"][0]) == 1
    files = [mesh, *(tmp_path / name for name in ("b.vtu", "b.msh", "b.msh2", "c.inp"))]
    for source, out in pairwise(files):  # also of a copy
        capsys.readouterr()
        assert exit_code("convert", source, out, "--young", "1") == 0
        assert (
            "the run that built this mesh violated requirements: error" in capsys.readouterr().err
        )
    # without --check, it only warns
    assert exit_code("quality", mesh, "--json", tmp_path / "q.json") == 0
    for path in (mesh, tmp_path / "b.msh"):
        assert exit_code("quality", path, "--check", "--json", tmp_path / "q.json", "--force") == 1
        said = capsys.readouterr()
        assert (
            "of the image's variance is unexplained"
            in numbers_in(tmp_path / "q.json")["violated"]["error"]
        )
        assert f"requirement violated: error: {path}: when built, " in " ".join(said.err.split())
        assert said.out.splitlines()[-1].startswith(f"requirements not met: error; {path}: ")
    assert exit_code("mesh", inputs / "a.nii.gz", "-o", mesh, *COARSE, "--force") == 0
    assert exit_code("convert", mesh, tmp_path / "d.vtu") == 0
    assert "violated" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, ""),
        ({"mask": "m.nii.gz"}, ": nodes follow the surface of the mask"),
        ({"background": "25"}, ": nodes follow the surface of the foreground"),
        ({"mask": "m.nii.gz", "labels": "l.nii.gz"}, ": nodes follow the interfaces of labels"),
    ],
)
def test_a_run_whose_energy_rises_says_what_nodes_follow(inputs, options, words):
    tetopt.save_image(inputs / "m.nii.gz", tetopt.Image(np.indices((24, 24, 24))[0] > 4))
    files = {name: inputs / file if file.endswith("gz") else file for name, file in options.items()}
    source = read_source(SourceOptions(images=[inputs / "a.nii.gz"], **files))
    assert (
        ended_words("risen", "the mesh", source.surface_words)
        == f"ended, as E no longer falls{words}"
    )


def test_numbers_are_written_although_a_picture_fails(inputs, tmp_path, monkeypatch, capsys):
    """The run fails, but its numbers are there, and name the failure, too."""

    def full(*_):
        raise OSError(28, "No space left on device", "slice.png")

    monkeypatch.setattr(tetopt.job.run, "draw", full)
    command = [
        "mesh",
        inputs / "a.nii.gz",
        "-o",
        tmp_path / "a.vtu",
        "--json",
        tmp_path / "a.json",
        *COARSE,
    ]
    assert exit_code(*command, "--figures", tmp_path) == 2
    numbers = numbers_in(tmp_path / "a.json")
    assert list(numbers["violated"]) == list(numbers["failed"]) == ["figures"]
    assert "slice.png: No space left" in capsys.readouterr().err.splitlines()[-2]


def test_remedies_agree():
    """The worst decides: what it asks for is not contradicted by what follows."""
    more, fewer = (
        Problem("a", "allow more nodes", wants="smaller"),
        Problem("b", "reduce `nodes`", wants="larger"),
    )
    lost = Problem("c", "allow more nodes", "labels", "smaller")
    assert [each.words for each in order_problems([more, fewer])] == ["a; allow more nodes", "b"]
    assert [each.words for each in order_problems([fewer, more])] == ["b; reduce `nodes`", "a"]
    assert [each.words for each in order_problems([fewer, Problem("d"), lost])] == [
        "c; allow more nodes",
        "b",
        "d",
    ]
    assert sentences([lost, more, lost._replace(text="e")]) == {
        "labels": "c; allow more nodes; e; allow more nodes"
    }


def test_cells_across_are_those_of_the_mesh():
    across = {3: (3.6, 1.2), 4: (3.6, 1.9), 5: (5.0, 0.8), 0: (3.6, 1.2)}
    rows = [label_row(k, edge=edge, cells_across=n) for k, (edge, n) in across.items()]
    (problem,) = of_layers(rows, 2.0, {3: "fluid"})
    assert (
        problem.text
        == "fewer than 2 cells across: 5 0.8 (edges 5 mm), 3 (fluid) 1.2 (edges 3.6 mm)"
    )
    assert list(of_layers(rows[1:2], 2.0, {})) == []


@pytest.mark.full
def test_flat_cells_are_judged_without_iterations(tmp_path, capsys):
    """By the run and by `quality --check`, within a mask whose surface cuts the lattice."""
    mask = gaussian_filter(np.random.default_rng(1).normal(size=(24, 24, 24)), 2.0) > 0.0
    tetopt.save_image(tmp_path / "a.nii.gz", tetopt.Image(np.indices(mask.shape)[0] + 20.0))
    tetopt.save_image(tmp_path / "m.nii.gz", tetopt.Image(1.0 * mask))
    out, numbers = tmp_path / "a.vtu", tmp_path / "a.json"
    words = [
        "mesh",
        tmp_path / "a.nii.gz",
        "--mask",
        tmp_path / "m.nii.gz",
        "-o",
        out,
        "--json",
        numbers,
    ]
    assert exit_code(*words, "--nodes", "1200", "--iterations", "0") == 1
    assert numbers_in(numbers)["quality"]["min_dihedral"] < 12.0
    assert list(numbers_in(numbers)["violated"]) == ["min_dihedral"]
    again = [
        "quality",
        out,
        "--image",
        tmp_path / "a.nii.gz",
        "--mask",
        tmp_path / "m.nii.gz",
        "--check",
    ]
    capsys.readouterr()
    assert exit_code(*again, "--json", tmp_path / "q.json") == 1
    assert numbers_in(tmp_path / "q.json")["violated"] == numbers_in(numbers)["violated"]
    assert "--iterations" in capsys.readouterr().err
