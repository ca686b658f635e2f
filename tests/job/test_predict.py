"""`tetopt mesh --predict`, and the sizes of a run by which time and memory are predicted."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from commands import exit_code, labelled_lattice_words, mesh_words, numbers_in
from models import sample_image

import tetopt
from tetopt import Job
from tetopt.cli import mesh as cli_mesh
from tetopt.cli import predict as cli_predict
from tetopt.engine import cost
from tetopt.engine.cost import RunSize
from tetopt.job import predict
from tetopt.job.plan import plan
from tetopt.start.octree import nearest_octree
from tetopt.system.interpreter import python_command, python_environment


@pytest.fixture
def image_path(tmp_path):
    tetopt.save_image(tmp_path / "a.nii.gz", sample_image(3))
    return tmp_path / "a.nii.gz"


@pytest.fixture
def sizes(monkeypatch):
    """The sizes of each prediction, in place of what is printed."""
    rows = []
    monkeypatch.setattr(cli_mesh, "print_prediction", lambda task: rows.append(task.size))
    return rows


def plan_of(folder, images, **options):
    """A plan of options; nothing is read."""
    return plan(Job(images=images, output=folder / "a.vtu", **options))


def test_a_prediction_writes_nothing(image_path, tmp_path, monkeypatch, capsys):
    """Two lines on standard output, whatever files the command names; the machine is measured."""
    words = mesh_words(image_path, tmp_path, "--figures", tmp_path, "--threads", "1", "--predict")
    before = sorted(tmp_path.rglob("*"))
    assert exit_code(*words) == 0
    lines = capsys.readouterr().out.replace("\n", " ")
    assert "s on 1 thread, in nine of ten cases" in lines
    assert "MB of memory at peak" in lines or "GB of memory at peak" in lines
    assert sorted(tmp_path.rglob("*")) == before
    monkeypatch.setattr(cli_predict, "calibrated_speed", lambda: 1e-3)
    monkeypatch.setattr(cli_predict, "available_bytes", lambda: 1000)
    assert exit_code(*words[:2], "-o", tmp_path / "a.vtu", "--target-error", "0.5", "--predict") == 0
    said = capsys.readouterr()
    assert "assuming 4 runs with 5000 nodes" in said.out
    assert "only 0.001 MB of memory is free, less than this run needs" in said.err.replace("\n", " ")


def test_what_a_run_refuses_its_prediction_does(image_path, tmp_path, capsys):
    (tmp_path / "a.vtu").touch()
    assert exit_code(*mesh_words(image_path, tmp_path, "--predict")) == 2
    assert "--force" in capsys.readouterr().err
    assert exit_code(*mesh_words(tmp_path / "none.nii", tmp_path, "--predict", "--force")) == 2
    assert "no such file" in capsys.readouterr().err
    assert exit_code(*mesh_words(image_path, tmp_path, "--predict", "--force", "--k-d", "2")) == 2
    capsys.readouterr()
    limited = mesh_words(image_path, tmp_path, "--force", "--nodes", "60", "--edge-max", "3")
    assert exit_code(*limited) == exit_code(*limited, "--predict") == 2
    run, prediction = capsys.readouterr().err.split("which need at least")[1:]
    assert run.split(";")[0] == prediction.split(";")[0]


def test_a_target_error_with_limits_on_sizes_needs_their_nodes(image_path, tmp_path, sizes):
    """The prediction is for the nodes of the first octree, more than the default."""
    words = mesh_words(image_path, tmp_path, "--predict", "--target-error", "0.5", "--edge-max", "2.1")
    assert exit_code(*words) == 0
    octree = nearest_octree(sample_image(3), 1500, tetopt.Sizes(longest=2.1))
    assert sizes[0].n_nodes == len(octree.points) > 5_000


@pytest.mark.parametrize(
    "options",
    ["--nodes 500", "--nodes 300 --size-min 8", "--slice k=3 --nodes 500", "--parts 2 --nodes 2000",
     "--target-error 0.5 --edge-max 1.2", "--order 2 --nodes 720 --edge-max 0.4", "--nodes 50 --edge-max 0.4"],
)  # fmt: skip
def test_numbers_and_sizes_that_a_run_refuses(image_path, tmp_path, capsys, options):
    """The prediction refuses the same, in the same words."""
    words = mesh_words(image_path, tmp_path, *options.split())
    assert exit_code(*words) == exit_code(*words, "--predict") == 2
    run, prediction = (line for line in capsys.readouterr().err.splitlines() if line.startswith("tetopt: "))
    assert run == prediction


def test_sizes_of_order_2_need_their_nodes(image_path, tmp_path, sizes):
    """A run accepts them, with more corners than requested and without a second run; a spacing has its own number."""
    field = tetopt.Image(np.full((9, 8, 7), 3.0), sample_image(3).affine)
    tetopt.save_image(tmp_path / "f.nii.gz", field)
    words = mesh_words(image_path, tmp_path, "--predict", "--order", "2")
    for options in (["--edge-max", "5"], ["--sizing", tmp_path / "f.nii.gz"], ["--edge-size", "3"]):
        assert exit_code(*words, "--nodes", "720", *options) == 0
    assert exit_code(*words, "--spacing", "8") == exit_code(*words, "--spacing", "8", "--order", "1") == 0
    longest, *targets, quadratic, linear = sizes
    assert longest.n_nodes == len(nearest_octree(sample_image(3), 100, tetopt.Sizes(longest=5.0, gradation=0.5)).points)
    octree = nearest_octree(sample_image(3), 100, tetopt.Sizes(edge_size=3.0, gradation=0.5))
    assert [each.n_nodes for each in targets] == [pytest.approx(len(octree.points), rel=0.3)] * 2
    assert [each.runs for each in sizes] == [1] * 5
    assert quadratic.n_nodes == linear.n_nodes


def test_sizes_of_what_was_read(image_path, tmp_path, sizes):
    """Voxels of all files, those that are meshed, channels, corners of cells."""
    image = sample_image(3)
    n_voxels = image.data.size
    tetopt.save_image(tmp_path / "mask.nii.gz", tetopt.Image(np.ones(image.shape), image.affine))
    words = mesh_words(image_path, tmp_path, "--predict")
    assert exit_code(*words, "--nodes", "150", "--mask", tmp_path / "mask.nii.gz") == 0
    assert exit_code(*words, "--nodes", "720", "--order", "2", "--iterations", "3") == 0
    assert exit_code(*words, "--spacing", "8", "--figures", tmp_path) == 0
    assert exit_code(*words, "--slice", "k=3") == 0
    assert exit_code(*labelled_lattice_words(tmp_path), "-o", tmp_path / "a.vtu", "--predict") == 0
    masked, quadratic, lattice, slice_, labelled = sizes
    whole = RunSize(n_voxels, n_voxels, 150, 16)
    assert not any(size.is_fractional for size in sizes)
    assert masked == whole._replace(n_read=2 * n_voxels, n_channels=2, has_region=True, elongation=masked.elongation)
    assert (quadratic.n_nodes, quadratic.runs, quadratic.order, quadratic.iterations) == (100, 2, 2, 3)
    assert (lattice.mode, lattice.is_drawn, lattice.iterations) == ("uniform", True, 20)
    n_nodes = len(tetopt.lattice_mesh(image, spacing=8.0).points)
    assert 0.3 * n_nodes < lattice.n_nodes <= n_nodes
    assert (slice_.ndim, slice_.n_read, slice_.n_voxels) == (2, n_voxels, image.shape[0] * image.shape[1])
    assert labelled.has_memberships
    assert labelled.n_read == 2 * n_voxels
    assert labelled.n_channels > 1


def test_fractions_take_more(tmp_path, sizes):
    """Sums of what is no whole number take twice the bits; labels make whole numbers of all."""
    image = sample_image(3)
    tetopt.save_image(tmp_path / "a.nii.gz", tetopt.Image(image.data + 0.25, image.affine))
    assert exit_code(*mesh_words(tmp_path / "a.nii.gz", tmp_path, "--predict")) == 0
    assert sizes[0].is_fractional
    whole, fractional = (cost.predicted(sizes[0]._replace(is_fractional=each)).peak_bytes for each in (False, True))
    assert fractional > whole


def test_sizes_by_headers(image_path, tmp_path, monkeypatch):
    """Without voxels being read; what only these tell is as in a run whose files were read."""
    shape = sample_image(3).shape
    n_voxels = int(np.prod(shape))
    monkeypatch.setattr(predict, "read_image", None)
    plan = plan_of(tmp_path, [image_path], mask=image_path, labels=Path(f"{image_path}:0"), nodes=150)
    size = predict.size_by_headers(plan)
    assert size == RunSize(3 * n_voxels, n_voxels, 150, 16, 3, has_region=True, has_memberships=True)
    like = size._replace(n_read=10, n_voxels=2, n_nodes=7, n_channels=5, elongation=3.0, has_memberships=False)
    more = predict.size_by_headers(plan, like)
    assert more == like._replace(n_read=3 * n_voxels, n_voxels=round(0.6 * n_voxels), n_nodes=150)
    assert predict.size_by_headers(plan_of(tmp_path, [image_path]), like).n_nodes == 7
    assert predict.size_by_headers(plan_of(tmp_path, [image_path], crop="1:3,:,0:2", slice_="j=2")).n_voxels == 4
    with pytest.raises(tetopt.InputError, match="no such file"):
        predict.size_by_headers(plan_of(tmp_path, [tmp_path / "none.nii.gz"]))
    (tmp_path / "b.png").touch()
    monkeypatch.setattr(predict, "read_image", lambda path, part: tetopt.Image(np.eye(5)))
    assert predict.size_by_headers(plan_of(tmp_path, [tmp_path / "b.png"])).n_read == 25


@pytest.mark.deep
def test_memory_of_a_small_run(image_path, tmp_path, monkeypatch):
    """run.json states sizes and prediction; nothing is far off. In a process of its own, as the model is of these."""
    words = [str(word) for word in mesh_words(image_path, tmp_path, "--nodes", "100", "--iterations", "1")]
    subprocess.run(python_command("-m", "tetopt", *words), env=python_environment(), check=True, capture_output=True)
    numbers = numbers_in(tmp_path / "a.json")
    prediction, memory = numbers["prediction"], numbers["memory"]
    size = RunSize(**prediction["size"])
    assert size.n_nodes == 100
    assert prediction["peak_bytes"] == cost.predicted(size).peak_bytes
    assert 0.5 * memory["peak_bytes"] < prediction["peak_bytes"] < 2.0 * memory["peak_bytes"]
    assert memory["peak_bytes"] < 1.2 * memory["predicted_bytes"]
