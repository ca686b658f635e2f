"""``tetopt mesh`` in parts: what it refuses, a stored image to a file of pieces, a run cut short
that goes on.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from attacks import KINDS, content, outside, planted
from commands import assert_refused, exit_code

import tetopt
from tetopt import load_mesh
from tetopt.errors import InputError
from tetopt.io.images import load_image, save_image
from tetopt.job import in_parts, read
from tetopt.model.fields import cell_fields
from tetopt.parts.work import save_volume


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A ball in noise, 24 x 26 x 28 voxels of 16 bits in a sheared place, as .nii, and as
    .nii.gz.
    """
    folder = tmp_path_factory.mktemp("inputs")
    place = np.indices((24, 26, 28)) - np.array([12.0, 13.0, 14.0])[:, None, None, None]
    h = np.rint(
        400.0 * ((place**2).sum(axis=0) < 60.0)
        + np.random.default_rng(5).normal(500.0, 9.0, place[0].shape)
    )
    affine = np.array(
        [[-2.0, 0.3, 0.0, 20.0], [0.0, 2.1, 0.0, -5.0], [0.0, 0.2, 2.4, 3.0], [0.0, 0.0, 0.0, 1.0]]
    )
    for name in ("ball.nii", "ball.nii.gz"):
        save_image(folder / name, tetopt.Image(h, affine))
    return folder


REFUSED = [
    ("--parts 0", "--parts"),
    ("--parts 2 --uniform", "--parts: needs a graded mesh"),
    ("--parts 2 --mask ball.nii.gz", "--mask: needs all cells or voxels together"),
    ("--parts 2 --edge-size 9", "--edge-size: needs all"),
    ("--parts 2 --order 2", "--order: needs all"),
    ("ball.nii.gz --parts 2", "--parts: expected one IMAGE, got 2"),
    ("--parts 4", "--parts: expected at most 3 for 300 nodes .100 each., got 4$"),
    ("--parts 2 --worker-gb 0", "--worker-gb: expected more than 0"),
    (
        "--parts 2 --worker-gb 2 --scheduler tcp://127.0.0.1:9",
        "--worker-gb: only for workers on this machine",
    ),
    (
        "--parts 2 --workers 2 --scheduler tcp://127.0.0.1:9",
        "--workers: expected none with --scheduler",
    ),
]


@pytest.mark.parametrize(("options", "match"), REFUSED, ids=[options for options, _ in REFUSED])
def test_refused(tmp_path, inputs, monkeypatch, capfd, options, match):
    monkeypatch.chdir(inputs)
    assert_refused(
        capfd,
        ["mesh", "ball.nii", *options.split(), "-o", tmp_path / "a.vtu", "--nodes", 300],
        match,
    )
    assert list(tmp_path.iterdir()) == []


def test_planes_are_refused(tmp_path, capfd):
    save_image(tmp_path / "plane.nii.gz", tetopt.Image(np.arange(400.0).reshape(20, 20)))
    command = ["mesh", tmp_path / "plane.nii.gz", "--parts", 2, "-o", tmp_path / "a.vtu"]
    assert_refused(capfd, command, "--parts: expected a 3-D image, got a 2-D one; omit the option")


OF_TWO = ["--nodes", 300, "--parts", 2, "--iterations", 3, "--workers", 1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory, inputs):
    """A run in one go: its mesh and its numbers."""
    folder = tmp_path_factory.mktemp("whole")
    command = [
        "mesh",
        inputs / "ball.nii",
        *OF_TWO,
        "-o",
        folder / "a.vtu",
        "--json",
        folder / "a.json",
    ]
    assert exit_code(*command) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["a.json", "a.vtu"]
    return load_mesh(folder / "a.vtu"), json.loads((folder / "a.json").read_text())


@pytest.mark.deep
def test_stored_images_are_meshed_as_those_in_memory(tmp_path, inputs, whole, monkeypatch):
    """Left in its file and read whole, on one worker and on two: the same mesh, and the same
    numbers of its cells.
    """
    monkeypatch.setattr(in_parts, "MOST_LOADED", 0)
    files = ["-o", tmp_path / "b.vtu", "--json", tmp_path / "b.json", "--young", "2 + 0.01*h"]
    command = ["mesh", inputs / "ball.nii", *OF_TWO[:-1], 2, "--worker-gb", 2, *files]
    assert exit_code(*command) == 0
    one, other = whole[1], json.loads((tmp_path / "b.json").read_text())
    assert one["mesh_sha256"] == other["mesh_sha256"]
    for name, value in one["image_properties"].items():
        assert np.allclose(value, other["image_properties"][name], rtol=1e-12), name
    assert one["options"]["parts"] == 2
    assert one["memory"].keys() == {"peak_bytes", "task_bytes"}
    assert one["memory"]["task_bytes"] > 1e5
    loaded = load_mesh(tmp_path / "b.vtu")
    direct = cell_fields(loaded.mesh, load_image(inputs / "ball.nii"))
    assert np.array_equal(loaded.cell_data["n_voxels"], direct["n_voxels"])
    assert np.array_equal(loaded.cell_data["max"], direct["max"])
    np.testing.assert_allclose(loaded.cell_data["mean"], direct["mean"], rtol=1e-12)
    assert set(loaded.cell_data["part"]) == {0, 1}
    assert not list(tmp_path.glob("*.work"))


@pytest.mark.full
def test_images_beyond_the_memory_are_meshed_in_parts(tmp_path, inputs, monkeypatch, capfd):
    command = ["mesh", inputs / "ball.nii", "-o", tmp_path / "a.vtu", "--nodes", 300]
    for module in (read, in_parts):
        monkeypatch.setattr(module, "available_bytes", lambda: 1000)
    chosen = []
    monkeypatch.setattr(
        in_parts, "run_in_parts", lambda *arguments, **_: chosen.append(arguments) or 1 / 0
    )
    with pytest.raises(ZeroDivisionError):
        exit_code(*command)
    assert "meshing in one piece would take" in capfd.readouterr().err
    assert chosen[0][0].request["options"]["parts"] == 1
    # What parts do not do is tried in one piece, as ever: the bound on its memory is a rough one.
    assert exit_code(*command, "--order", 2, "--iterations", 1) == 0


@pytest.mark.deep
def test_a_run_out_of_time_goes_on(tmp_path, inputs, whole, monkeypatch, capfd):
    """It leaves the mesh of the last complete round, and the same request goes on from there, no
    other.
    """
    folder, other = tmp_path / "a.vtu.work", tmp_path / "ball.nii"
    folder.mkdir()
    # of a run that was killed before it had a mesh
    save_volume(folder, tetopt.Image(np.full((9, 9, 9), 3.0)))
    command = ["mesh", inputs / "ball.nii.gz", *OF_TWO]
    assert exit_code(*command, "-o", tmp_path / "a.vtu", "--max-seconds", "1e-6") == 2
    assert (
        "a.vtu.work: ended before the first round was complete; run this again"
        in capfd.readouterr().err
    )
    assert not (tmp_path / "a.vtu").exists()
    image = load_image(inputs / "ball.nii.gz")
    save_image(other, tetopt.Image(image.data[::-1], image.affine))
    changes = [
        ("--k-d", 0.5),
        ("--nodes", 310),
        ("--iterations", 9),
        ("--size-min", 3),
        ("--crop", "0:22,:,:"),
    ]
    for each in [[*command, *change] for change in changes] + [["mesh", other, *command[2:]]]:
        assert exit_code(*each, "-o", tmp_path / "a.vtu") == 2, each
        assert "a.vtu.work: work directory of another, unfinished run" in capfd.readouterr().err
    # A file that comes during the run stays.
    monkeypatch.setattr(
        in_parts, "prepare_kernels", lambda *_, **__: (folder / "note.txt").write_text("mine")
    )
    assert exit_code(*command, "-o", tmp_path / "a.vtu") == 0
    assert (
        "a.vtu.work was not removed, as it contains foreign files: note.txt"
        in capfd.readouterr().err
    )
    assert content(folder) == {"note.txt": b"mine", "tetopt-lock": b""}
    loaded = load_mesh(tmp_path / "a.vtu")
    assert np.array_equal(loaded.mesh.points, whole[0].mesh.points)
    assert np.array_equal(loaded.mesh.cells, whole[0].mesh.cells)
    assert np.array_equal(loaded.cell_data["max"], whole[0].cell_data["max"])


def test_what_was_refused_leaves_nothing_and_stands_in_no_way(tmp_path, inputs, monkeypatch, capfd):
    """Before there is an octree, by what a solver is told of it, and by the memory of the
    workers.
    """
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


@pytest.mark.deep
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
    assert_refused(capfd, command, r"a\.vtu\.work: [^\n]*; move it away and run this again")
    assert content(tmp_path) == before


@pytest.mark.parametrize(("n_parts", "nodes"), [(1, 5), (2, 2 * in_parts.FEWEST_NODES_EACH)])
def test_as_many_parts_as_have_nodes_of_their_own(n_parts, nodes):
    assert in_parts.checked_number(n_parts, nodes) == n_parts
    with pytest.raises(
        InputError,
        match=rf"`parts`: expected at most {n_parts} for {nodes} nodes \(100 each\), got",
    ):
        in_parts.checked_number(n_parts + 1, nodes)


def test_the_level_that_is_drawn_is_of_the_same_volume(tmp_path, monkeypatch):
    zarr = pytest.importorskip("zarr")
    group, h = (
        zarr.open_group(tmp_path / "a.zarr", mode="w"),
        np.arange(2048, dtype=np.int16).reshape(2, 16, 8, 8),
    )
    levels = [("0", h, 1.0), ("1", h[:, ::2, ::2, ::2], 2.0)]
    for name, voxels, _ in levels:
        group.create_array(name, data=voxels)
    axes = [
        {"name": "c", "type": "channel"},
        *({"name": name, "unit": "millimeter"} for name in "xyz"),
    ]
    scales = [
        {
            "path": name,
            "coordinateTransformations": [{"type": "scale", "scale": [1.0, *[step] * 3]}],
        }
        for name, _, step in levels
    ]
    group.attrs["ome"] = {"version": "0.5", "multiscales": [{"axes": axes, "datasets": scales}]}
    monkeypatch.setattr(in_parts, "MOST_LOADED", 0)
    monkeypatch.setattr(in_parts, "MOST_DRAWN", 200)
    files = {
        "images": tmp_path / "a.zarr",
        "output": tmp_path / "a.vtu",
        "figures": tmp_path / "figures",
    }
    with pytest.warns(UserWarning, match="has no orientation"):
        task = tetopt.read(tetopt.Job(**files, volume=1, parts=2, nodes=200))
    assert np.array_equal(task.source.drawn.data, levels[1][1][1])
    assert np.array_equal(task.source.contrasts[0].read((0, 0, 0), (16, 8, 8)), h[1])


def test_an_ordinary_image_loads_neither_parts_nor_workers(tmp_path, inputs):
    words = [
        "mesh",
        str(inputs / "ball.nii"),
        "-o",
        str(tmp_path / "a.vtu"),
        "--nodes",
        "300",
        "--iterations",
        "0",
    ]
    code = (
        f"import sys, tetopt.cli; print(tetopt.cli.main({words!r})); print('loaded:', *sys.modules)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(tetopt.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    loaded = {
        name.split(".")[1]
        for name in done.stdout.splitlines()[-1].split()
        if name.startswith("tetopt.")
    }
    assert {"job", "engine"} <= loaded
    assert not loaded & {"cohort", "parts", "study", "workers"}


def test_options_of_parts_have_no_say_in_one_piece(tmp_path, inputs, capfd):
    command = [
        "mesh",
        inputs / "ball.nii",
        "-o",
        tmp_path / "a.vtu",
        "--nodes",
        300,
        "--iterations",
        0,
    ]
    assert exit_code(*command, "--worker-gb", 2) == 0
    assert "--worker-gb is ignored: the mesh is built in one piece" in capfd.readouterr().err


def test_places_on_the_network_are_refused(tmp_path, capfd):
    words = ["mesh", "s3://bucket/x.zarr", "-o", tmp_path / "a.vtu"]
    assert_refused(
        capfd, words, "s3:/bucket/x.zarr: expected a local file or folder, got a URL; download it"
    )
