"""What is wrong with a mesh is one list: the command's exit code, run.json, its last line, and a
cohort's row agree.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from commands import in_copy_of, numbers_in, run_command
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

COARSE = "--spacing 12 --iterations 0"
here = in_copy_of("inputs")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """An image, and labels of which one is a plate of 576 voxels, more than two cells have, but too
    thin to be most of any.
    """
    folder = tmp_path_factory.mktemp("inputs")
    x = np.indices((24, 24, 24))[0]
    labels = np.where(x < 12, 1, 3)
    labels[6] = 2
    for name, data in (("l", labels), ("a", 10.0 * labels + x % 5), ("m", x > 4)):
        tetopt.save_image(f"{folder}/{name}.nii.gz", tetopt.Image(data))
    return folder


def failing(*_):
    raise ZeroDivisionError("no way")


CASES = {
    "labels": (f"--labels l.nii.gz {COARSE} --no-smooth-interfaces", None),  # lost
    "contacts": (f"--labels l.nii.gz {COARSE}", "label_contacts"),  # a measurement that fails
    "error": ("--target-error 1e-4 --size-min 20 --iterations 1", None),
}


def last_line(printed):
    return printed.out.splitlines()[-1]


@pytest.mark.parametrize("name", CASES)
def test_exit_code_and_files_and_cohort_agree(monkeypatch, name):
    words, measure = CASES[name]
    if measure is not None:
        monkeypatch.setattr(tetopt.measure.measures, measure, failing)
    place, key = Path("out"), "sub-1"
    subject_folder(place, key).mkdir(parents=True)
    mesh, path = subject_folder(place, key) / mesh_name(key, ".vtu"), numbers_path(place, key)
    said = run_command(f"mesh a.nii.gz -o {mesh} --json {path} {words}", code=1)
    violated = numbers_in(path)["violated"]
    assert name in violated
    assert last_line(said).startswith(f"requirements not met: {', '.join(violated)}; {mesh}: ")
    for sentence in violated.values():
        assert sentence.replace("`", "")[:40].split(";")[0] in said.err.replace("`", "")
    row = row_of(place, key)
    assert (row.status, row.violated) == ("violated", tuple(violated))
    assert state_of(place, key).status == "violated"
    (flags,) = flags_of([row])
    assert {flag.column for flag in flags} <= {"violated", "label"}
    assert len(flags) >= 1


def test_a_good_mesh_ends_with_a_verdict():
    said = run_command("mesh a.nii.gz -o a.vtu --json a.json --spacing 8 --iterations 0")
    numbers = numbers_in("a.json")
    assert numbers["violated"] == {}
    size = numbers["size"]
    words = f"all requirements are met; a.vtu: {size['n_nodes']} nodes, {size['n_cells']} cells"
    assert last_line(said) == words
    assert "warning" not in said.err
    assert last_line(run_command("quality a.vtu --image a.nii.gz --check")) == words


def test_a_verdict_is_not_without_what_requirements_allow():
    """A label of 180 voxels whose cells are too large for it; no speck of another without a cell,
    which only its row tells.
    """
    labels = np.ones((24, 24, 24))
    labels[8:13, 8:14, 8:14], labels[3, 3, 3], labels[16:, 16:, 16:] = 2.0, 3.0, 3.0
    tetopt.save_image("l.nii.gz", tetopt.Image(labels))
    mesh = "mesh l.nii.gz --labels l.nii.gz -o a.vtu --json a.json --spacing 6 --iterations 0"
    check = "quality a.vtu --image l.nii.gz --labels l.nii.gz --check"
    ends = [
        run_command(words).out.replace("\n  ", " ").splitlines()[-2:] for words in (mesh, check)
    ]
    assert ends[0] == ends[1]
    rows = {row["label"]: row for row in numbers_in("a.json")["labels"]}
    assert [each["voxels"] for each in rows[3]["lost_components"]] == [1]
    ratio = rows[2]["mesh_volume"] / 180.0
    assert not 0.85 <= ratio <= 1.15
    beyond, verdict = ends[0]
    assert beyond.startswith("labels: of 3, ")
    assert f"2 ({ratio:.3g})" in beyond
    assert "without a cell" not in beyond
    assert verdict.startswith(
        "all requirements are met, but not all labels fit: 1, 2 (above); a.vtu"
    )


def test_commands_tell_that_the_run_of_a_mesh_violated_requirements():
    run_command(f"mesh a.nii.gz -o a.vtu {CASES['error'][0]}", code=1)
    for source, out in pairwise(["a.vtu", "b.vtu", "b.msh", "b.msh2", "c.inp"]):  # also of a copy
        said = run_command(f"convert {source} {out} --young 1").err
        assert "the run that built this mesh violated requirements: error" in said
    run_command("quality a.vtu --json q.json")  # without --check, it only warns
    for path in ("a.vtu", "b.msh"):
        said = run_command(f"quality {path} --check --json q.json --force", code=1)
        violated = numbers_in("q.json")["violated"]
        assert "of the image's variance is unexplained" in violated["error"]
        assert f"requirement violated: error: {path}: when built, " in " ".join(said.err.split())
        assert last_line(said).startswith(f"requirements not met: error; {path}: ")
    run_command(f"mesh a.nii.gz -o a.vtu {COARSE} --force")
    assert "violated" not in run_command("convert a.vtu d.vtu").err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, ""),
        ({"mask": Path("m.nii.gz")}, ": nodes follow the surface of the mask"),
        ({"background": "25"}, ": nodes follow the surface of the foreground"),
        (
            {"mask": Path("m.nii.gz"), "labels": Path("l.nii.gz")},
            ": nodes follow the interfaces of labels",
        ),
    ],
)
def test_a_run_whose_energy_rises_says_what_nodes_follow(options, words):
    source = read_source(SourceOptions(images=[Path("a.nii.gz")], **options))
    ended = ended_words("risen", "the mesh", source.surface_words)
    assert ended == f"ended, as E no longer falls{words}"


def test_numbers_are_written_although_a_picture_fails(monkeypatch):
    """The run fails, but its numbers are there, and name the failure, too."""

    def full(*_):
        raise OSError(28, "No space left on device", "slice.png")

    monkeypatch.setattr(tetopt.job.run, "draw", full)
    command = f"mesh a.nii.gz -o a.vtu --json a.json {COARSE} --figures figures"
    said = run_command(command, code=2).err
    numbers = numbers_in("a.json")
    assert list(numbers["violated"]) == list(numbers["failed"]) == ["figures"]
    assert "slice.png: No space left" in said.splitlines()[-2]


def test_remedies_agree():
    """The worst decides: what it asks for is not contradicted by what follows."""
    more = Problem("a", "allow more nodes", wants="smaller")
    fewer = Problem("b", "reduce `nodes`", wants="larger")
    lost = Problem("c", "allow more nodes", "labels", "smaller")
    for problems, words in (
        ([more, fewer], ["a; allow more nodes", "b"]),
        ([fewer, more], ["b; reduce `nodes`", "a"]),
        ([fewer, Problem("d"), lost], ["c; allow more nodes", "b", "d"]),
    ):
        assert [each.words for each in order_problems(problems)] == words
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
def test_flat_cells_are_judged_without_iterations():
    """By the run and by `quality --check`, within a mask whose surface cuts the lattice."""
    mask = gaussian_filter(np.random.default_rng(1).normal(size=(24, 24, 24)), 2.0) > 0.0
    tetopt.save_image("a.nii.gz", tetopt.Image(np.indices(mask.shape)[0] + 20.0))
    tetopt.save_image("m.nii.gz", tetopt.Image(1.0 * mask))
    mesh = "mesh a.nii.gz --mask m.nii.gz -o a.vtu --json a.json --nodes 1200 --iterations 0"
    run_command(mesh, code=1)
    check = "quality a.vtu --image a.nii.gz --mask m.nii.gz --check --json q.json"
    assert "--iterations" in run_command(check, code=1).err
    numbers = numbers_in("a.json")
    assert numbers["quality"]["min_dihedral"] < 12.0
    assert list(numbers["violated"]) == ["min_dihedral"]
    assert numbers_in("q.json")["violated"] == numbers["violated"]
