"""The table of a cohort: what is read from its folder, by which names, and how it is written."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from cohorts import HOSTILE, key_of, run_of, save_cohort, save_failure, save_run
from nibabel.orientations import aff2axcodes

import tetopt.cohort
from tetopt.cohort.layout import failure_path, numbers_path
from tetopt.cohort.numbers import (
    collect,
    column_names,
    description,
    field_text,
    flatten_run,
    oblique_degrees,
    orientation_code,
    save_table,
)
from tetopt.measure.fidelity import LabelFidelity, LabelInterface, MaskFidelity
from tetopt.measure.quality import Quality
from tetopt.system.incoming import toml_of

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    out = tmp_path_factory.mktemp("cohort")
    return collect(out, [*save_cohort(out, 10), "sub-none_ses-b"])


def test_rows_are_those_there_and_those_expected(cohort):
    assert [row.key for row in cohort] == [*map(key_of, range(10)), "sub-none_ses-b"]
    assert [row.status for row in cohort] == ["done"] * 2 + ["failed"] + ["done"] * 7 + ["missing"]
    assert cohort[2].reason == "image.nii.gz: expected a NIfTI image, got a file that ends early"
    assert cohort[2].files == {"log": "logs/sub-0003.log"}
    assert cohort[-1].files == {}
    first = "sub-0001/sub-0001_desc-tetopt_mesh"
    assert cohort[0].files == {
        "mesh": f"{first}.vtu",
        "numbers": f"{first}.json",
        "figures": "sub-0001/figures",
        "thumbnail": "sub-0001/figures/thumbnail.png",
    }


def test_sessions_and_what_is_no_subject(tmp_path):
    violated = {"min_dihedral": "two\nlines", "box": "out"}
    for key, words in (("sub-2_ses-b", {}), ("sub-10", {}), ("sub-2_ses-a", violated)):
        save_run(tmp_path, key, run_of(RNG, violated=words))
    save_failure(tmp_path, "sub-1", "x")
    save_failure(tmp_path, "other", "x")
    (tmp_path / "sub-<b>").mkdir()
    (tmp_path / "sub-7").mkdir()
    rows = collect(tmp_path)
    assert [row.key for row in rows] == ["sub-1", "sub-2_ses-a", "sub-2_ses-b", "sub-10"]
    assert rows[1].files["mesh"] == "sub-2/ses-a/sub-2_ses-a_desc-tetopt_mesh.vtu"
    assert (rows[1].status, rows[1].violated) == ("violated", ("min_dihedral", "box"))
    assert rows[1].reason == r"two\nlines; out"


@pytest.mark.parametrize("text", ["", "[]", "[" * 100_000, "\x00"])
def test_numbers_that_are_none_are_a_failure(tmp_path, text):
    save_run(tmp_path, "sub-1", run_of(RNG))
    numbers_path(tmp_path, "sub-1").write_text(text)
    [row] = collect(tmp_path)
    assert (row.status, row.numbers) == ("failed", {})
    assert row.reason == "its numbers cannot be read; run it again"


def test_a_failure_is_told_instead_of_an_older_mesh(tmp_path):
    save_run(tmp_path, "sub-1", run_of(RNG), b"")
    save_failure(tmp_path, "sub-1", HOSTILE)
    [row] = collect(tmp_path)
    assert (row.status, row.numbers, row.files) == ("failed", {}, {"log": "logs/sub-1.log"})
    assert row.reason.isprintable()
    failure_path(tmp_path, "sub-1").write_text("{")
    assert collect(tmp_path)[0].reason == "sub-1.failed.json cannot be read"


def test_numbers_without_a_mesh_are_a_failure(tmp_path):
    save_run(tmp_path, "sub-1", run_of(RNG), suffix=".inp")
    mesh = collect(tmp_path)[0].files["mesh"]
    assert mesh.endswith("_mesh.inp")
    (tmp_path / mesh).unlink()
    assert collect(tmp_path)[0].reason == "its numbers exist, but its mesh is missing; run it again"


def test_numbers_have_names_with_dots():
    run = run_of(RNG) | {
        "materials": {"young_kPa": [1.0, 2.0], "nu": [0.1] * 5, "binning": None},
        "dropped_components": 2,
        "contrasts": [{"image": "a", "weight": 2.0}] * 6,
    }
    run["labels"][1]["lost_components"] = [{"voxels": 50, "place": [0.0, 1.0, 2.0]}] * 6
    columns = flatten_run(run)
    assert [value for name, value in columns.items() if "lost_components" in name] == [6]
    expected = {
        "grid.orientation": "RAS",
        "grid.spacing_mm": "1 x 1 x 1.2",
        "grid.shape": "180 x 220 x 170",
        "quality.errors.mean": 0.09,
        "materials.young_kPa.2": 2.0,
        "contrasts.6.weight": 2.0,
        "dropped_components": 2,
        "labels.17.n_cells": 300,
        "interfaces.0.area": 1000.0,
        "request.options.young": "3.0",
    }
    assert columns | expected == columns
    assert columns["grid.volume_mm"] == pytest.approx(180 * 220 * 170 * 1.2)
    assert "request.options.nodes" not in columns
    left_out = (
        "history",
        "sets",
        "violated",
        "box",
        "label_names",
        "inputs.sha256",
        "labels.0.label",
        "materials.nu",
    )
    assert [name for name in columns if name.startswith(left_out)] == []


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 0, 2]])
@pytest.mark.parametrize("signs", [[1, 1, 1], [-1, 1, -1], [-1, -1, 1]])
def test_orientation_is_that_of_nibabel(order, signs):
    affine = np.eye(4)
    affine[:3, :3] = np.diag(signs)[order] + 0.1
    assert orientation_code(affine) == "".join(aff2axcodes(affine))


def test_oblique_degrees():
    affine = np.diag([1.0, 2.0, 3.0, 1.0])
    c, s = np.cos(np.radians(12.3)), np.sin(np.radians(12.3))
    affine[:2, :2] = [[c, -2 * s], [s, 2 * c]]
    assert oblique_degrees(affine) == 12.3


def test_the_table_reads_back(cohort, tmp_path):
    path = tmp_path / "cohort.tsv"
    save_table(path, cohort, [[HOSTILE, "b"], *([] for _ in cohort[1:])])
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") == len(cohort) + 1
    assert text.replace("\t", "").replace("\n", "").isprintable()
    rows = list(csv.DictReader(text.splitlines(), delimiter="\t"))
    assert [row["participant_id"] for row in rows] == [*map(key_of, range(10)), "sub-none"]
    assert [row["session_id"] for row in rows] == ["n/a"] * 10 + ["ses-b"]
    assert rows[0]["flags"].endswith("; b")
    for row, line in zip(cohort, rows, strict=True):
        for name in column_names(cohort):
            value = row.numbers.get(name, "n/a")
            if value == "n/a":
                assert line[name] == "n/a"
            elif isinstance(value, int | float) and not isinstance(value, bool):
                assert float(line[name]) == value  # to the last bit
    about = json.loads(path.with_suffix(".json").read_text())
    assert list(about) == list(rows[0])
    assert about["labels.17.volume"] == {
        "Description": "Label 17 (hippocampus): volume of its voxels",
        "Units": "mm^3",
    }


def test_no_text_is_a_formula():
    for first in "=+-@\uff1d":
        assert field_text(f"{first}1+1") == f"'{first}1+1"
    assert (field_text("\t=1"), field_text(-4.5)) == (r"\t=1", "-4.5")


def test_every_column_is_described():
    texts = [description(name)["Description"] for name in flatten_run(run_of(RNG))]
    assert [text for text in texts if text.endswith("of run.json")] == []
    assert description("options.k_D") == {"Description": "Option k_D"}
    assert description("quality_initial.min_edge")["Units"] == "mm"
    assert description("new.thing")["Description"] == "new.thing of run.json"


@pytest.mark.parametrize(
    ("beginning", "names"),
    [
        ("labels.N.", LabelFidelity(1).as_json()),
        ("interfaces.N.", LabelInterface._fields),
        ("mask.", MaskFidelity._fields),
        ("quality.", Quality._fields),
    ],
)
def test_what_is_measured_is_described(beginning, names):
    """A new number of a run has a line in the table of descriptions, and one that is gone has
    none.
    """
    table = toml_of(Path(tetopt.cohort.__file__).parent / "columns.toml", "table")
    described = {
        name.removeprefix(beginning).partition(".")[0]
        for name in table
        if name.startswith(beginning)
    }
    assert described == set(names) - {"label"}
