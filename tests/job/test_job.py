"""A job: every option once, checked when it is made, in JSON and back."""

import inspect
import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from commands import assert_refuses

import tetopt
from tetopt import InputError, Job
from tetopt.job.options import JobOptions, RunOptions, given_options, kinds_of, option_of
from tetopt.job.texts import option_words

FILES = {"images": "a.nii", "output": "a.vtu"}


def test_values_are_brought_to_the_kinds_of_their_options():
    job = Job(
        images=Path("a.nii"),
        output="a.vtu",
        nodes=np.int64(300),
        k_D=np.float32(0.5),
        young=3,
        background=0,
        loads="compress:5%",
        iterations=4.0,
    )
    assert (job.images, job.output, job.loads) == ([Path("a.nii")], Path("a.vtu"), ["compress:5%"])
    assert (job.nodes, job.k_D, job.young, job.background, job.iterations) == (
        300,
        0.5,
        "3",
        "0",
        4,
    )
    assert type(job.nodes) is type(job.iterations) is int


@pytest.mark.parametrize(("value", "is_on"), [(True, True), (0.3, True), (0, False), (0.0, False)])
def test_smooth_interfaces_were_a_number_of_voxels(value, is_on):
    job = Job.from_json(json.dumps({**FILES, "labels": "l.nii", "smooth_interfaces": value}))
    assert job.smooth_interfaces is is_on
    assert given_options(job).get("smooth-interfaces", True) is is_on
    assert option_words(given_options(job)).count("--no-smooth-interfaces") == (not is_on)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"nodes": "30"}, "`nodes`: expected a whole number, got '30'"),
        ({"nodes": 30.5}, "`nodes`: expected a whole number, got 30.5"),
        ({"nodes": True}, "`nodes`: expected a whole number, got True"),
        ({"nodes": 2**63}, "`nodes`: expected a whole number, got 9223372036854775808"),
        ({"nodes": float("inf")}, "`nodes`: expected a whole number, got inf"),
        ({"nodes": 3}, "`nodes`: expected a whole number from 5 to 50000000, got 3"),
        ({"k_D": 2}, "`k_D`: expected 0 <= k_D < 1, got 2.0"),
        ({"iterations": -1}, "`iterations`: expected 0 or more, got -1"),
        ({"images": []}, r"`images`: expected a path or a list of them, got \[\]"),
        ({"mask": ""}, "`mask`: expected a path, got ''"),
        ({"mask": "a\0b"}, "`mask`: expected a path, got"),
        ({"lattice": "x"}, "`lattice`: expected bcc or five-tet or criss-cross or octree, got 'x'"),
        ({"force": "yes"}, "`force`: expected True or False, got 'yes'"),
        ({"units": None}, "`units`: expected a string, got None"),
        ({"nodes": 30, "spacing": 2.0}, "`nodes` and `spacing`: give only one of them"),
        ({"mask": "m.nii", "background": 3}, "`mask` and `background`: give only one of them"),
        ({"output": "a.docx"}, "a.docx: unknown suffix"),
        ({"young": "x" * 5000}, "`young`: formula: expected numbers"),
    ],
)
def test_what_cannot_be_is_refused_by_name(options, words):
    with pytest.raises(InputError, match=words) as caught:
        Job(**{**FILES, **options})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def test_numbers_of_numpy_are_texts_that_are_read_back_to_the_last_bit():
    names = {"images": ["a.nii", "b.nii"], "output": "a.vtu"}
    job = Job(
        **names,
        young=np.float64(3.5),
        bins=np.int64(4),
        background=np.float32(0.1),
        weights=[2, 2 / 3],
    )
    assert (job.young, job.bins, float(job.background)) == ("3.5", "4", float(np.float32(0.1)))
    assert [float(each) for each in job.weights.split(",")] == [2.0, 2 / 3]


def test_a_job_opens_no_file_and_its_plan_refuses_missing_ones(here):
    files = {"images": "a.nii.gz", "labels": "l.nii.gz", "output": "a.vtu"}
    missing = {"young": "missing.csv", "label_size": "missing.toml"}
    for name, path in missing.items():
        job = Job(**files, **{name: path})  # though there is no such file
        for read in (tetopt.plan, tetopt.run):
            with pytest.raises(InputError, match=f"{path}: no such file"):
                read(job)
        words = "mesh a.nii.gz --labels l.nii.gz -o a.vtu"
        assert_refuses(f"{words} --{name.replace('_', '-')} {path}", f"{path}: no such file")
    assert Job(**files, **missing).young is not None


def test_json_gives_the_job_back():
    job = Job(
        images=["a.nii", "b.nii"],
        output="a.inp",
        weights=[1, 0.5],
        loads=["compress:5%", "hold:left"],
        young="1 + h",
        labels="l.nii",
        json_path="a.json",
        slice_=None,
        nonlinear=True,
        nodes=300,
    )
    assert Job.from_json(job.to_json()) == job
    assert "weights" in job.to_json()
    assert "slice_" not in job.to_json()  # what is the default


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("3", "expected an object of options, got int"),
        ("{", "expected JSON"),
        ("[" * 100_000, "nested too deeply"),
        ('{"images": ["a"]}', "missing output"),
        ('{"images": ["a"], "output": "b.vtu", "nods": 3}', "did you mean nodes"),
        (
            '{"images": ["a"], "output": "b.vtu", "nodes": "3"}',
            "`nodes`: expected a whole number, got '3'",
        ),
    ],
)
def test_json_that_is_no_job(text, words):
    with pytest.raises(InputError, match=words) as caught:
        Job.from_json(text)
    assert len(str(caught.value)) < 300


def test_every_option_has_its_kind_and_its_help():
    for name, kind in kinds_of(JobOptions).items():
        assert option_of(kind).text.endswith("."), name
    shared, every = ({field.name for field in fields(each)} for each in (RunOptions, JobOptions))
    assert shared < every == set(inspect.signature(Job).parameters)
    assert given_options(Job(**FILES)) == {"images": [Path("a.nii")], "output": Path("a.vtu")}
    words = option_of(kinds_of(Job)["nodes"]).text[:40]
    assert f"\nnodes : int, optional\n    {words}" in inspect.getdoc(tetopt.Job)
