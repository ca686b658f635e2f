"""``tetopt mesh`` in parts: what it refuses, a stored image to a file of pieces, a run cut short that goes on."""

import json

import numpy as np
import pytest
from attacks import KINDS, content, outside, planted
from commands import assert_refused, exit_code

import tetopt
from tetopt import load_mesh
from tetopt.io.images import load_image, save_image
from tetopt.job import in_parts
from tetopt.model.fields import cell_fields
from tetopt.parts.work import save_volume


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A ball in noise, 24 x 26 x 28 voxels of 16 bits in a sheared place, as .nii, and as .nii.gz."""
    folder = tmp_path_factory.mktemp("inputs")
    place = np.indices((24, 26, 28)) - np.array([12.0, 13.0, 14.0])[:, None, None, None]
    h = np.rint(400.0 * ((place**2).sum(axis=0) < 60.0) + np.random.default_rng(5).normal(500.0, 9.0, place[0].shape))
    affine = np.array([[-2.0, 0.3, 0.0, 20.0], [0.0, 2.1, 0.0, -5.0], [0.0, 0.2, 2.4, 3.0], [0.0, 0.0, 0.0, 1.0]])
    for name in ("ball.nii", "ball.nii.gz"):
        save_image(folder / name, tetopt.Image(h, affine))
    return folder


REFUSED = [
    ("--parts 0", "--parts"),
    ("--parts 2 --uniform", "--parts: of a graded mesh"),
    ("--parts 2 --mask ball.nii.gz", "--mask: looks at all cells or voxels at once"),
    ("--parts 2 --labels ball.nii.gz", "--labels: looks at all"),
    ("--parts 2 --background auto", "--background: looks at all"),
    ("--parts 2 --slice 2=9", "--slice: looks at all"),
    ("--parts 2 --target-error 0.1", "--target-error: looks at all"),
    ("--parts 2 --edge-size 9", "--edge-size: looks at all"),
    ("--parts 2 --order 2", "--order: looks at all"),
    ("--parts 2 --boundary fixed", "--boundary: looks at all"),
    ("--parts 2 --max-gb 3", "--max-gb: looks at all"),
    ("ball.nii.gz --parts 2", "--parts: expected one IMAGE, got 2"),
    ("--parts 4", "--parts: expected up to 3 of 300 nodes, 100 each, got 4; ask for fewer"),
    ("--parts 4 --predict", "--parts: expected up to 3 of 300 nodes"),
    ("--parts 2 --worker-gb 0", "--worker-gb: expected more than 0"),
    ("--parts 2 --worker-gb 2 --scheduler tcp://127.0.0.1:9", "--worker-gb: of workers on this machine"),
    ("--parts 2 --workers 2 --scheduler tcp://127.0.0.1:9", "--workers: expected none with --scheduler"),
]


@pytest.mark.parametrize(("options", "match"), REFUSED, ids=[options for options, _ in REFUSED])
def test_refused(tmp_path, inputs, monkeypatch, capfd, options, match):
    monkeypatch.chdir(inputs)
    number = [] if "--target-error" in options else ["--nodes", "300"]
    assert_refused(capfd, ["mesh", "ball.nii", *options.split(), "-o", tmp_path / "a.vtu", *number], match)
    assert list(tmp_path.iterdir()) == []


def test_planes_are_refused(tmp_path, capfd):
    save_image(tmp_path / "plane.nii.gz", tetopt.Image(np.arange(400.0).reshape(20, 20)))
    command = ["mesh", tmp_path / "plane.nii.gz", "--parts", 2, "-o", tmp_path / "a.vtu"]
    assert_refused(capfd, command, "--parts: of a volume, and the image is a plane; leave it out")


def test_stored_images_are_meshed_as_those_in_memory(tmp_path, inputs, monkeypatch):
    """Left in its file and read whole, on one worker and on two: the same mesh, and the same numbers of its cells."""
    command = ["mesh", inputs / "ball.nii", "--nodes", 300, "--parts", 2, "--iterations", 3]
    assert exit_code(*command, "-o", tmp_path / "a.vtu", "--json", tmp_path / "a.json", "--workers", 1) == 0
    monkeypatch.setattr(in_parts, "MOST_LOADED", 0)
    files = ["-o", tmp_path / "b.vtkhdf", "--json", tmp_path / "b.json"]
    assert exit_code(*command, *files, "--workers", 2, "--worker-gb", 2, "--young", "2 + 0.01*h") == 0
    one, other = (json.loads((tmp_path / name).read_text()) for name in ("a.json", "b.json"))
    assert one["mesh_sha256"] == other["mesh_sha256"]
    for name, value in one["image_properties"].items():
        assert np.allclose(value, other["image_properties"][name], rtol=1e-12), name
    assert one["options"]["parts"] == 2
    assert one["prediction"]["task_bytes"] > 1e5
    assert one["memory"].keys() == {"peak_bytes"}
    loaded = load_mesh(tmp_path / "b.vtkhdf")
    direct = cell_fields(loaded.mesh, load_image(inputs / "ball.nii"))
    assert np.array_equal(loaded.cell_data["n_voxels"], direct["n_voxels"])
    assert np.array_equal(loaded.cell_data["max"], direct["max"])
    np.testing.assert_allclose(loaded.cell_data["mean"], direct["mean"], rtol=1e-12)
    assert set(loaded.cell_data["part"]) == {0, 1}
    assert not list(tmp_path.glob("*.work"))


def test_images_beyond_the_memory_are_meshed_in_parts(tmp_path, inputs, monkeypatch, capfd):
    monkeypatch.setattr(in_parts, "available_bytes", lambda: 1000)
    chosen = []
    monkeypatch.setattr("tetopt.job.meshing.run_in_parts", lambda *arguments: chosen.append(arguments) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        exit_code("mesh", inputs / "ball.nii", "-o", tmp_path / "a.vtu", "--nodes", 300)
    assert "in one piece it would take" in capfd.readouterr().err
    assert chosen[0][0].plan.division.n_parts == 1  # as run.json's request has it
    # What parts do not do is tried in one piece, as ever: the bound on its memory is a rough one.
    assert exit_code("mesh", inputs / "ball.nii", "-o", tmp_path / "a.vtu", "--nodes", 300, "--order", 2) == 0


def test_a_run_out_of_time_goes_on(tmp_path, inputs, capfd):
    """One that is cut short leaves the mesh of the last complete round, and the same request goes on from there."""
    command = ["mesh", inputs / "ball.nii.gz", "--nodes", 300, "--parts", 2, "--iterations", 6, "--workers", 1]
    assert exit_code(*command, "-o", tmp_path / "whole.vtu") == 0
    assert exit_code(*command, "-o", tmp_path / "a.vtu", "--max-seconds", "1e-6") == 2
    assert "a.vtu.work: ended before the first round was complete; run this again" in capfd.readouterr().err
    assert not (tmp_path / "a.vtu").exists()
    other = tmp_path / "ball.nii.gz"
    save_image(
        other, tetopt.Image(load_image(inputs / "ball.nii.gz").data[::-1], load_image(inputs / "ball.nii.gz").affine)
    )
    changes = [
        ("--k-d", 0.5), ("--nodes", 310), ("--parts", 3), ("--iterations", 9), ("--shape-power", 2),
        ("--min-dihedral", 9), ("--size-min", 3), ("--edge-max", 20), ("--gradation", 0.2), ("--crop", "0:22,:,:"),
    ]  # fmt: skip
    for each in [[*command, *change] for change in changes] + [["mesh", other, *command[2:]]]:
        assert exit_code(*each, "-o", tmp_path / "a.vtu") == 2, each
        assert "a.vtu.work: work directory of another run" in capfd.readouterr().err
    assert exit_code(*command, "-o", tmp_path / "a.vtu") == 0
    one, other = (load_mesh(tmp_path / name).mesh for name in ("whole.vtu", "a.vtu"))
    assert np.array_equal(one.points, other.points)
    assert np.array_equal(one.cells, other.cells)
    assert not list(tmp_path.glob("*.work"))


OF_TWO = ["--nodes", 300, "--parts", 2, "--iterations", 3, "--workers", 1]


def test_what_was_refused_leaves_nothing_and_stands_in_no_way(tmp_path, inputs, monkeypatch, capfd):
    """Before there is an octree, by what a solver is told of it, and by the memory of the workers."""
    command = ["mesh", inputs / "ball.nii.gz", *OF_TWO, "-o", tmp_path / "a.vtu"]
    for more, match in [
        (["--nodes", 50000], "--nodes: 50000 nodes are too many for 24 x 26 x 28 voxels"),
        (["--young", "2", "--load", "hold:nowhere"], "nowhere"),
    ]:
        assert_refused(capfd, [*command, *more], match)
        assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(in_parts, "prepare_kernels", lambda *_, **__: None)
    assert exit_code(*command, "--worker-gb", 0.3) == 2
    assert "tetopt: a part needs about 1." in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_voxels_that_a_run_without_an_octree_left_are_not_those_of_another_image(tmp_path, inputs, capfd):
    """What a run had noted, that was killed before it had a mesh, is noted anew."""
    folder = tmp_path / "a.vtu.work"
    folder.mkdir()
    save_volume(folder, tetopt.Image(np.full((9, 9, 9), 3.0)))
    assert exit_code("mesh", inputs / "ball.nii.gz", *OF_TWO, "-o", tmp_path / "a.vtu") == 0
    loaded = load_mesh(tmp_path / "a.vtu")
    direct = cell_fields(loaded.mesh, load_image(inputs / "ball.nii.gz"))
    assert np.array_equal(loaded.cell_data["max"], direct["max"])
    assert not folder.exists()


@pytest.mark.parametrize("kind", [*KINDS, "a lock"])
def test_what_has_the_name_of_the_work_directory_stays(tmp_path, inputs, capfd, kind):
    place, elsewhere = tmp_path / "a.vtu.work", outside(tmp_path)
    if kind == "a lock":  # of another program's
        place.mkdir()
        (place / "lock").write_text("mine")
    else:
        planted(kind, place, elsewhere)
    before = content(tmp_path)
    command = ["mesh", inputs / "ball.nii.gz", *OF_TWO, "-o", tmp_path / "a.vtu"]
    assert_refused(capfd, command, r"a\.vtu\.work: [^\n]*; move it away, and run this again")
    assert content(tmp_path) == before


@pytest.mark.parametrize(("name", "kind"), [
    ("lock", "hard link"), ("lock", "file link"), ("lock", "pipe"), ("voxels.npy", "file link"), ("voxels.npy", "pipe"),
    ("volume.json", "device link"), ("state.json", "device link"), ("state.json", "pipe"), ("round-0", "folder link"),
    ("round-0/done-0.npz", "pipe"), ("mesh-0.npz", "file link"), ("thesis.txt", "file"), ("dask", "folder link"),
    ("logs/dask.log", "file link"),
])  # fmt: skip
def test_what_lies_in_the_work_directory_and_is_not_tetopts_stays(tmp_path, inputs, capfd, name, kind):
    place, elsewhere = tmp_path / "a.vtu.work", outside(tmp_path)
    save_volume(place, tetopt.Image(np.full((9, 9, 9), 3.0)))
    (place / name).parent.mkdir(exist_ok=True)
    planted(kind, place / name, elsewhere)
    before = content(tmp_path)
    command = ["mesh", inputs / "ball.nii.gz", *OF_TWO, "-o", tmp_path / "a.vtu"]
    assert_refused(capfd, command, rf"{place / name}: [^\n]*; move it away, and run this again")
    assert content(tmp_path) == before


def test_a_file_that_comes_into_the_work_directory_during_the_run_stays(tmp_path, inputs, monkeypatch, capfd):
    folder = tmp_path / "a.vtu.work"
    monkeypatch.setattr(in_parts, "prepare_kernels", lambda *_, **__: (folder / "note.txt").write_text("mine"))
    assert exit_code("mesh", inputs / "ball.nii.gz", *OF_TWO, "-o", tmp_path / "a.vtu") == 0
    assert "a.vtu.work: stays with what is not tetopt's in it: note.txt" in capfd.readouterr().err
    assert content(folder) == {"note.txt": b"mine"}


def test_options_of_parts_have_no_say_in_one_piece(tmp_path, inputs, capfd):
    command = ["mesh", inputs / "ball.nii", "-o", tmp_path / "a.vtu", "--nodes", 300, "--predict"]
    assert exit_code(*command, "--worker-gb", 2) == 0
    captured = capfd.readouterr()
    assert "--worker-gb: has no say, as the mesh is made in one piece" in captured.err
    assert "at its peak" in captured.out


def test_predicted_parts(tmp_path, inputs, capfd):
    command = ["mesh", inputs / "ball.nii", "-o", tmp_path / "a.vtu", "--nodes", 300, "--predict", "--parts", 2]
    assert exit_code(*command, "--worker-gb", 0.1) == 0
    captured = capfd.readouterr()
    assert captured.out.startswith("about 2 parts in a round, each of up to ")
    assert "--worker-gb 0.1: less than a worker takes" in captured.err
    assert list(tmp_path.iterdir()) == []


def test_places_on_the_network_are_refused(tmp_path, capfd):
    words = ["mesh", "s3://bucket/x.zarr", "-o", tmp_path / "a.vtu"]
    assert_refused(capfd, words, "s3:/bucket/x.zarr: is not on this machine; download it")
